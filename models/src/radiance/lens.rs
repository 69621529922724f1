//! Lenses that are trained with the poses.
//!
//! All views have the same corrections of the lenses that were given, since one camera took them: with a, b, u, v trained,
//!
//! ```text
//! fx' = fx exp(a)    fy' = fy exp(b)    cx' = cx + u fx    cy' = cy + v fy
//! ```
//!
//! where only focal lengths are refined, a = b and u = v = 0. They learn at the warp's rate.

use crate::config::RefineLens;
use crate::evaluation::FoundLens;
use raygrad_compiler::functions::mlp::{Init, Parameter};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::{Shape, Tensor};

/// The parameter: `[] x 1` (a) or `[] x 4` (a, b, u, v).
pub const LENS: &str = "camera.lens";

/// What is trained of the lenses.
#[derive(Clone, Debug)]
pub struct Lens {
    pub correction: Option<Parameter>,
}

impl Lens {
    pub fn new(refined: RefineLens) -> Lens {
        let of = |width| Parameter::new(LENS, Shape::new(&[], width), Init::Zero);
        let correction = match refined {
            RefineLens::None => None,
            RefineLens::Focal => Some(of(1)),
            RefineLens::All => Some(of(4)),
        };
        Lens { correction }
    }

    /// The lenses as they are now, fx, fy, cx and cy like the given ones.
    pub fn corrected(&self, given: &Tensor) -> Tensor {
        let Some(correction) = self.correction.as_ref().map(|p| &p.tensor) else { return given.clone() };
        let (focal, center) = (given.slice(0..2), given.slice(2..4));
        if correction.width() == 1 {
            return concat([&(focal * correction.exp()), &center]);
        }
        concat([&(&focal * correction.slice(0..2).exp()), &(center + correction.slice(2..4) * focal)])
    }
}

/// What the values of [`LENS`] say.
pub fn found(correction: &[f32]) -> FoundLens {
    let x = |i: usize| correction.get(i).copied().map_or(0.0, f64::from);
    let [a, b] = if correction.len() == 1 { [x(0); 2] } else { [x(0), x(1)] };
    FoundLens { focal_scale: [a.exp(), b.exp()], principal_shift: [x(2), x(3)] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::Experiment;
    use crate::radiance::model::INTRINSICS;
    use crate::scene::Intrinsics;
    use crate::training::Training;
    use raygrad_compiler::reference::{Array, Bindings, evaluate};

    /// What is told of a lens is what the graph computes with.
    #[test]
    fn a_found_lens_is_the_graphs() {
        let given = Intrinsics { fx: 40.0, fy: 44.0, cx: 15.0, cy: 12.0, height: 24, width: 32, distortion: None };
        for (refined, values) in [(RefineLens::Focal, vec![0.1f32]), (RefineLens::All, vec![0.1, -0.2, 0.05, -0.03])] {
            let lens = Lens::new(refined);
            let tensor = Tensor::data("given", Shape::new(&[], 4));
            let correction = lens.correction.clone().unwrap().tensor;
            let array = |t: &Tensor, values: Vec<f64>| Array::floats(t.shape(), values);
            let bound: Bindings = [
                ("given".to_string(), array(&tensor, vec![given.fx, given.fy, given.cx, given.cy])),
                (LENS.to_string(), array(&correction, values.iter().map(|x| f64::from(*x)).collect())),
            ]
            .into_iter()
            .collect();
            let graph = evaluate(&[lens.corrected(&tensor)], &bound).unwrap().remove(0);
            let told = found(&values).of(&given);
            for (a, b) in graph.f().iter().zip([told.fx, told.fy, told.cx, told.cy]) {
                assert!((a - b).abs() < 1e-9, "{graph:?} {told:?}");
            }
        }
    }

    /// A field that was learned with the right lenses tells that they are wrong, and by how much.
    #[test]
    fn wrong_focal_lengths_are_found() {
        let sets = [
            "scene.image_size=[24,24]",
            "scene.train_views=20",
            "scene.poses=truth",
            "train.rays=240",
            "train.samples=24",
            "train.refine_lens=focal",
            "field.layers=[32,32]",
            "field.bands=4",
            "radiance.color_layers=[]",
            "optim.lr=5e-3",
            "optim.lr_end=5e-5",
            "optim.lr_warp=5e-3",
            "optim.lr_warp_end=5e-3",
            "optim.warmup_pose=0",
            "optim.steps=800",
            "run.device=cpu",
        ];
        let preset = Experiment::preset("nerf-small").unwrap();
        let mut explorer = sets.iter().fold(preset, |e, text| e.set(text).unwrap()).explorer().unwrap();
        let right: Vec<f32> = explorer.learner_mut().session.get(INTRINSICS).unwrap();
        for _ in 0..500 {
            explorer.step().unwrap();
            explorer.learner_mut().set(LENS, &[0.0]).unwrap();
        }
        let wrong: Vec<f32> = right.iter().enumerate().map(|(i, x)| if i % 4 < 2 { x / 1.1 } else { *x }).collect();
        explorer.learner_mut().set(INTRINSICS, &wrong).unwrap();
        for _ in 0..300 {
            explorer.step().unwrap();
        }
        let [x, y] = explorer.found_lens().unwrap().unwrap().focal_scale;
        assert!(x == y && (x - 1.1).abs() < 0.03, "{x}");
    }
}
