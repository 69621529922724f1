//! One transform a point, from a network that sees the point and the frame's code (L2G-NeRF, CVPR 2023).
//!
//! (u, theta) = MLP([x, e]), y = Exp(u, theta) x. Where the global transform is a homography, each point still moves
//! rigidly; for translations and rotations it moves by one of those. In 3D the motion of a ray is a twist.

use super::global::move_points;
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
        LocalWarp { network, code: settings.code, global: settings.dof, solver: settings.solver }
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
        let motion = self.network.apply(&concat([&at.xy, code]));
        move_points(local_group(self.global), &motion, &at.position)
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
