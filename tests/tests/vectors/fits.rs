//! Closed-form fits with gradients through the solver, and the 3D global alignment.

use raygrad_compiler::autodiff::{grad, vjp};
use raygrad_compiler::functions::homography::{Solver, fit_homography};
use raygrad_compiler::functions::lie::se3_exp;
use raygrad_compiler::functions::matrix::{apply, compose_poses, identity, join_affine, split_pose};
use raygrad_compiler::functions::rigid_fit::{fit_rigid_2d, fit_rigid_3d, fit_rotation_2d};
use raygrad_compiler::graph::{Axes, Axis, Tensor};
use raygrad_tests::vectors::{Bound, cases, numbers};

#[test]
fn rigid_fits() {
    for case in cases("l2g_fit") {
        let mut bound = Bound::default();
        let size = case.sizes("x");
        let (frame, point) = (Axis::new("frame", size[0]), Axis::new("point", size[1]));
        let n = size[2];
        let x = bound.data("x", &[&frame, &point], n, case.numbers("x"));
        let y = bound.data("y", &[&frame, &point], n, case.numbers("y"));
        let over = Axes::new([point.clone()]);
        let g_rotation = bound.data("gR", &[&frame], (n, n), case.numbers("gR"));
        let vectors = case.function == "rigid_vectors_registration";
        let (fit, upstream) = if vectors {
            (fit_rotation_2d(&x, &y, &over), g_rotation)
        } else {
            let g_offset = bound.data("gt", &[&frame], n, case.numbers("gt"));
            let fit = if n == 2 { fit_rigid_2d(&x, &y, &over) } else { fit_rigid_3d(&[(&x, &y)], &over) };
            (fit, join_affine(&g_rotation, &g_offset))
        };
        let slopes = vjp(&fit, &upstream, &[&x, &y]);
        let scalar = (&fit * &upstream).sum_channels().sum(&[&frame]);
        if vectors {
            case.check("R", &bound.run(&[fit])[0]);
        } else {
            let (rotation, offset) = split_pose(&fit);
            let found = bound.run(&[rotation, offset]);
            case.check("R", &found[0]);
            case.check("t", &found[1]);
        }
        let found = bound.run(&[scalar, slopes[0].clone(), slopes[1].clone()]);
        case.check("scalar", &found[0]);
        // The released solver damps the inverse in its gradient: that shows at 1e-9 of it, and at 1e-7 near a reflection.
        let damped = if case.name.contains("reflection") { 1e-7 } else { 2e-9 };
        case.check_within("grad_x", &found[1], damped);
        case.check_within("grad_y", &found[2], damped);
    }
}

#[test]
fn homographies() {
    for case in cases("homography_dlt") {
        let mut bound = Bound::default();
        let size = case.sizes("x");
        let (frame, point) = (Axis::new("frame", size[0]), Axis::new("point", size[1]));
        let x = bound.data("x", &[&frame, &point], 2, case.numbers("x"));
        let y = bound.data("y", &[&frame, &point], 2, case.numbers("y"));
        let g = bound.data("gH", &[&frame], (3, 3), case.numbers("gH"));
        let solver = match case.text("solver") {
            "svd" => Solver::Eigen,
            _ => Solver::InverseIteration,
        };
        let h = fit_homography(&x, &y, &Axes::new([point.clone()]), solver, None);
        let scalar = (&h * &g).sum_channels().sum(&[&frame]);
        let slopes = vjp(&h, &g, &[&x, &y]);
        let found = bound.run(&[h, scalar, slopes[0].clone(), slopes[1].clone()]);
        case.check("H", &found[0]);
        case.check("scalar", &found[1]);
        if case.has_output("grad_x") {
            case.check("grad_x", &found[2]);
            case.check("grad_y", &found[3]);
        }
    }
}

#[test]
fn global_alignment_of_poses() {
    for case in cases("global_alignment").iter().filter(|c| c.name.starts_with("nerf")) {
        let mut bound = Bound::default();
        let size = case.sizes("twist");
        let (frame, ray) = (Axis::new("frame", size[0]), Axis::new("ray", size[1]));
        let (k, width) = (case.numbers("intr"), case.number("W"));
        let mut plane = vec![];
        for camera in k.chunks(9) {
            for index in case.numbers("ray_idx") {
                let (u, v) = (index % width + 0.5, (index / width).floor() + 0.5);
                plane.extend([(u - camera[2]) / camera[0], (v - camera[5]) / camera[4], 1.0]);
            }
        }
        let points = bound.data("points", &[&frame, &ray], 3, plane);
        let twist = bound.data("twist", &[&frame, &ray], 6, case.numbers("twist"));
        let start = if case.input("pose_gt").is_null() {
            join_affine(&identity(3), &Tensor::constant(&[0.0; 3])).broadcast_to(&Axes::new([frame.clone()]))
        } else {
            let truth = bound.data("pose_gt", &[&frame], (3, 4), numbers(case.input("pose_gt")));
            compose_poses(&bound.data("pose_noise", &[&frame], (3, 4), numbers(case.input("pose_noise"))), &truth)
        };
        let local = compose_poses(&start, &se3_exp(&twist));
        let (rotation, offset) = split_pose(&local);
        let back = rotation.transpose();
        let world = apply(&back, &(&points - &offset));
        let centres = apply(&back, &-&offset);
        let over = Axes::new([ray.clone()]);
        let origin = Tensor::constant(&[0.0; 3]);
        let fit = fit_rigid_3d(&[(&world, &points), (&centres, &origin)], &over);
        let (fit_rotation, fit_offset) = split_pose(&fit);
        let fit_back = fit_rotation.transpose();
        let far = &world - apply(&fit_back, &(&points - &fit_offset));
        let near = &centres - apply(&fit_back, &-&fit_offset);
        let loss = ((&far * &far).mean_all() + (&near * &near).mean_all()) * 0.5;
        let slope = grad(&loss, &[&twist]).remove(0);
        let found = bound.run(&[loss, slope, local, points, world, centres, fit]);
        let outputs =
            ["loss", "grad_twist", "local_pose", "camera_points", "world_points", "world_centres", "fitted_pose"];
        for (output, value) in outputs.iter().zip(&found) {
            case.check(output, value);
        }
    }
}
