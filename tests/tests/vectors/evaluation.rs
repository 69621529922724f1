//! Alignment of poses, errors of poses, pictures and depths, LPIPS, and the novel-view path.

use raygrad::evaluation::{
    Alignment, Lpips, Picture, Similarity, depth_errors, mse, novel_view_path, pose_errors, psnr,
    released_depth_errors, rotation_angle, ssim,
};
use raygrad::geometry::Pose;
use raygrad_tests::vectors::{Case, cases, numbers};
use safetensors::tensor::{Dtype, TensorView};

fn poses(case: &Case, key: &str) -> Vec<Pose> {
    case.numbers(key).chunks(12).map(Pose::from_rows).collect()
}

fn rows(poses: &[Pose]) -> Vec<f64> {
    poses.iter().flat_map(|p| p.to_rows()).collect()
}

fn entries(m: &nalgebra::Matrix3<f64>) -> Vec<f64> {
    m.transpose().iter().copied().collect()
}

#[test]
fn alignment_on_centres() {
    for case in cases("pose_metrics").iter().filter(|c| c.function.starts_with("prealign_cameras")) {
        let (predicted, truth) = (poses(case, "pose_pred"), poses(case, "pose_gt"));
        let found = Alignment::Procrustes.fit(&predicted, &truth).unwrap();
        let output = |key: &str| numbers(case.output(&format!("sim3/{key}")));
        let (t0, t1) = (output("t0"), output("t1"));
        case.check("sim3/R", &entries(&found.rotation));
        let scale = output("s0")[0] / output("s1")[0];
        assert!((found.scale - scale).abs() < 4e-9, "{}: scale {} not {scale}", case.name, found.scale);
        let mapped = found.apply(&nalgebra::Vector3::from_column_slice(&t1));
        assert!((mapped - nalgebra::Vector3::from_column_slice(&t0)).norm() < 4e-9, "{}", case.name);
        check_aligned(case, &found, &predicted, &truth, false);
        let errors = pose_errors(&found.align(&predicted), &truth).unwrap();
        assert!((errors.mean_rotation_deg() - numbers(case.output("mean_R_deg"))[0]).abs() < 1e-6);
        assert!((errors.mean_translation() - numbers(case.output("mean_t"))[0]).abs() < 1e-8);
    }
}

#[test]
fn alignment_by_least_squares_and_by_pairs() {
    for case in cases("pose_metrics").iter().filter(|c| c.has_output("s")) {
        let (predicted, truth) = (poses(case, "pose_pred"), poses(case, "pose_gt"));
        let found = Alignment::of_inn(truth.len()).fit(&predicted, &truth).unwrap();
        case.check("R", &entries(&found.rotation));
        case.check("t", found.translation.as_slice());
        case.check("s", &[found.scale]);
        check_aligned(case, &found, &predicted, &truth, true);
    }
}

fn check_aligned(case: &Case, found: &Similarity, predicted: &[Pose], truth: &[Pose], centers: bool) {
    let aligned = found.align(predicted);
    case.check("pose_aligned", &rows(&aligned));
    let errors = pose_errors(&aligned, truth).unwrap();
    // At the clamp the angle turns the last digits of a trace into a millionth.
    case.check_within("error_R", &errors.rotation, 1e-9);
    case.check("error_t", if centers { &errors.center } else { &errors.translation });
    if case.has_output("test_pose_in_learned_frame") {
        let moved: Vec<Pose> = poses(case, "test_pose_gt").iter().map(|p| found.to_learned(p)).collect();
        case.check("test_pose_in_learned_frame", &rows(&moved));
    }
}

#[test]
fn rotation_distances() {
    for case in cases("pose_metrics").iter().filter(|c| c.name == "rotation_distance") {
        let matrices = |key: &str| -> Vec<nalgebra::Matrix3<f64>> {
            case.numbers(key).chunks(9).map(nalgebra::Matrix3::from_row_slice).collect()
        };
        let pairs = matrices("R1").into_iter().zip(matrices("R2"));
        case.check("angle", &pairs.map(|(a, b)| rotation_angle(&a, &b)).collect::<Vec<f64>>());
    }
}

#[test]
fn depths() {
    for case in cases("pose_metrics").iter().filter(|c| c.name == "depth_error") {
        let map = |key: &str| -> Vec<f32> { case.numbers(key).iter().map(|x| *x as f32).collect() };
        let (depth, truth) = (map("depth"), map("depth_gt"));
        let valid: Vec<bool> = case.numbers("valid").iter().map(|x| *x > 0.0).collect();
        let unscaled = depth_errors(&depth, &truth, &valid, 1.0).unwrap();
        case.check("abs_unscaled", &[unscaled.abs]);
        case.check("rms_unscaled", &[unscaled.rms]);
        let released = released_depth_errors(&depth, &truth, &valid, case.number("scale")).unwrap();
        case.check("abs_returned_with_scale", &[released.abs]);
        case.check("rms_returned_with_scale", &[released.rms]);
    }
}

/// A picture of the vectors, `[channel, row, column]`, with the colours of a pixel together.
fn interleaved(planes: &[f64]) -> Vec<f32> {
    let pixels = planes.len() / 3;
    (0..planes.len()).map(|i| planes[i % 3 * pixels + i / 3] as f32).collect()
}

#[test]
fn pictures() {
    for case in cases("image_metrics").iter().filter(|c| c.has_output("ssim")) {
        let size = case.sizes("a");
        let (a, b) = (interleaved(&case.numbers("a")), interleaved(&case.numbers("b")));
        let (a, b) = (Picture::new(size[2], size[1], &a).unwrap(), Picture::new(size[2], size[1], &b).unwrap());
        case.check("mse", &[mse(&a, &b).unwrap()]);
        case.check("psnr", &[psnr(&a, &b).unwrap()]);
        case.check("ssim", &[ssim(&a, &b).unwrap()]);
    }
}

#[test]
fn perceptual_distances() {
    for case in cases("image_metrics").iter().filter(|c| c.has_output("lpips")) {
        let parameters = case.input("parameters").as_object().expect("named tensors");
        let bytes: Vec<(&String, Vec<usize>, Vec<u8>)> = parameters
            .iter()
            .map(|(name, v)| (name, raygrad_tests::vectors::sizes(v), little_endian(&numbers(v))))
            .collect();
        let views = bytes
            .iter()
            .map(|(name, shape, data)| (name.as_str(), TensorView::new(Dtype::F32, shape.clone(), data).unwrap()));
        let lpips = Lpips::from_bytes(&safetensors::serialize(views, None).unwrap()).unwrap();
        let size = case.sizes("a");
        let (a, d) = (case.numbers("a"), case.numbers("d"));
        let b: Vec<f64> = a.iter().zip(&d).map(|(a, d)| 0.75 * a + 0.25 * d).collect();
        let (a, b) = (interleaved(&a), interleaved(&b));
        let (a, b) = (Picture::new(size[2], size[1], &a).unwrap(), Picture::new(size[2], size[1], &b).unwrap());
        case.check("per_layer", &lpips.per_layer(&a, &b).unwrap());
        case.check("lpips", &[lpips.distance(&a, &b).unwrap()]);
        case.check("identical", &[lpips.distance(&a, &a).unwrap()]);
    }
}

fn little_endian(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|x| (*x as f32).to_le_bytes()).collect()
}

#[test]
fn novel_views() {
    for case in cases("rays").iter().filter(|c| c.name == "novel_view_path") {
        let anchor = Pose::from_rows(&case.numbers("anchor"));
        let path = novel_view_path(&anchor, case.count("N"), case.number("scale"));
        let wanted: Vec<Pose> = case.numbers("frames").iter().map(|i| path[*i as usize]).collect();
        case.check("poses", &rows(&wanted));
    }
}
