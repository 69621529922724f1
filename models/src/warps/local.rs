//! One transform a point, from a network that sees the point and the frame's code (L2G-NeRF, CVPR 2023).
//!
//! (u, theta) = MLP([x, e]), y = Exp(u, theta) x. Where the global transform is a homography, each point still moves
//! rigidly; for translations and rotations it moves by one of those. In 3D the motion of a ray is a twist. The network's
//! rotations and translations may each have a factor (`warp.output_scale`; the published L2G baseline on DTU has 0.01).

use super::global::{move_points, scaled};
use super::{Points, Warp};
use crate::config::{Dof, Solver, WarpSettings};
use raygrad_compiler::Tensor;
use raygrad_compiler::functions::mlp::{Mlp, MlpSpec, Parameter};
use raygrad_compiler::ops::pick::concat;

/// The network and the groups it moves points and frames by.
#[derive(Clone, Debug)]
pub struct LocalWarp {
    network: Mlp,
    code: usize,
    output_scale: [f64; 2],
    global: Dof,
    solver: Solver,
}

impl LocalWarp {
    pub fn new(settings: &WarpSettings) -> LocalWarp {
        let mut widths = vec![2 + settings.code];
        widths.extend(&settings.layers);
        widths.push(local_group(settings.dof).count());
        let network =
            Mlp::new(MlpSpec::new("warp", &widths).skip(&settings.skip).hidden(settings.activation.of_warps()));
        LocalWarp {
            network,
            code: settings.code,
            output_scale: settings.output_scale,
            global: settings.dof,
            solver: settings.solver,
        }
    }
}

/// The group of a single point's motion.
fn local_group(global: Dof) -> Dof {
    match global {
        Dof::Homography => Dof::Rigid,
        other => other,
    }
}

impl Warp for LocalWarp {
    fn map(&self, at: &Points, code: &Tensor) -> Tensor {
        let group = local_group(self.global);
        let motion = scaled(group, &self.network.apply(&concat([&at.xy, code])), self.output_scale);
        move_points(group, &motion, &at.position)
    }
    fn code_width(&self) -> usize {
        self.code
    }
    fn parameters(&self) -> Vec<Parameter> {
        self.network.parameters.clone()
    }
    fn dof(&self) -> Dof {
        self.global
    }
    fn solver(&self) -> Solver {
        self.solver
    }
}
