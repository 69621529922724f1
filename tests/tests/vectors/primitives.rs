//! Encodings, exponentials and poses.

use raygrad_compiler::autodiff::vjp;
use raygrad_compiler::functions::lie::{se2_exp, se3_exp, sl3_exp, so2_exp, so3_exp};
use raygrad_compiler::functions::matrix::{compose_poses, invert_pose, join_affine};
use raygrad_compiler::functions::posenc::{coarse_to_fine_weights, positional_encoding};
use raygrad_compiler::graph::{Axis, Tensor};
use raygrad_tests::vectors::{Bound, Case, cases, numbers};

#[test]
fn positional_encodings() {
    for case in cases("posenc") {
        let mut bound = Bound::default();
        let (size, bands) = (case.sizes("x"), case.count("L"));
        let row = Axis::new("row", size[0]);
        let x = bound.data("x", &[&row], size[1], case.numbers("x"));
        let g = bound.data("g", &[&row], case.sizes("g")[1], case.numbers("g"));
        let progress = bound.data("progress", &[], 1, vec![case.number("progress")]);
        let window = case.input("c2f");
        let weights = (!window.is_null()).then(|| {
            let window = numbers(window);
            coarse_to_fine_weights(&progress, bands, window[0], window[1])
        });
        let encoding = positional_encoding(&x, bands, weights.as_ref());
        let slope = vjp(&encoding, &g, &[&x]).remove(0);
        let found = bound.run(&[encoding, slope]);
        case.check("encoding", &found[0]);
        case.check("grad_x", &found[1]);
        if let Some(w) = weights {
            case.check("weights", &bound.run(&[w])[0]);
        }
    }
}

#[test]
fn exponentials() {
    for case in cases("lie") {
        let exp = match case.name.as_str() {
            "so3_exp" => so3_exp,
            "se3_exp" => se3_exp,
            "so2_exp" => so2_exp,
            "se2_exp" => se2_exp,
            "sl3_exp" => sl3_exp,
            _ => continue,
        };
        let mut bound = Bound::default();
        let (size, matrix) = (case.sizes("x"), case.sizes("g"));
        let row = Axis::new("row", size[0]);
        let x = bound.data("x", &[&row], size[1], case.numbers("x"));
        let g = bound.data("g", &[&row], (matrix[1], matrix[2]), case.numbers("g"));
        let y = exp(&x);
        let slope = vjp(&y, &g, &[&x]).remove(0);
        let found = bound.run(&[y, slope]);
        case.check("y", &found[0]);
        case.check("grad_in", &found[1]);
    }
}

fn poses(case: &Case, bound: &mut Bound, key: &str, row: &Axis) -> Tensor {
    bound.data(key, &[row], (3, 4), case.numbers(key))
}

#[test]
fn poses_and_their_noise() {
    for case in cases("lie") {
        let mut bound = Bound::default();
        let b = &mut bound;
        let row = Axis::new("row", 2);
        let (output, pose) = match case.name.as_str() {
            "pose_invert" => ("P_inv", invert_pose(&poses(&case, b, "P", &row))),
            "pose_compose_list_A_B" => ("P", compose_poses(&poses(&case, b, "B", &row), &poses(&case, b, "A", &row))),
            "noise_barf_original" => {
                let twist = b.data("twist", &[&row], 6, case.numbers("twist"));
                ("noisy", compose_poses(&poses(&case, b, "pose_gt", &row), &se3_exp(&twist)))
            }
            "noise_l2g" => {
                let rotation = so3_exp(&b.data("rotvec", &[&row], 3, case.numbers("rotvec")));
                let offset = b.data("trans", &[&row], 3, case.numbers("trans"));
                ("noisy", compose_poses(&join_affine(&rotation, &offset), &poses(&case, b, "pose_gt", &row)))
            }
            "learned_correction" => {
                let xi = b.data("xi", &[&row], 6, case.numbers("xi"));
                ("P", compose_poses(&poses(&case, b, "P0", &row), &se3_exp(&xi)))
            }
            _ => continue,
        };
        case.check(output, &bound.run(&[pose])[0]);
    }
}
