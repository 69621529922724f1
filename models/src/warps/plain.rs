//! What the invertible warp is compared with: plain networks of points, and a network of frames.
//!
//! | warp | map |
//! |---|---|
//! | [`MlpWarp`] | y = MLP([gamma(x), code]) |
//! | [`ImplicitMlpWarp`] | the same, and a second network learns the way back: + lambda mean \|x - MLP'([gamma(y), code])\|^2 |
//! | [`Se3Field`] | y = x under the pose Exp(MLP(code)) of the frame |
//!
//! The first two are the baselines of the invertible warp's planar experiment, whose weights and widths are not published.
//! The third is the pose network that was published together with its code.

use super::global::{move_points, scaled};
use super::{Points, Warp};
use crate::config::{ActivationKind, Dof, Solver, WarpSettings};
use raygrad_compiler::functions::lie::se3_exp;
use raygrad_compiler::functions::loss::mean_squared_error;
use raygrad_compiler::functions::mlp::{Activation, Mlp, MlpSpec, Parameter};
use raygrad_compiler::functions::posenc::{encoded_width, positional_encoding};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::{Axis, Tensor};

/// A network of points and codes.
#[derive(Clone, Debug)]
struct PointNetwork {
    network: Mlp,
    bands: usize,
}

impl PointNetwork {
    #[track_caller]
    fn new(prefix: &str, settings: &WarpSettings) -> PointNetwork {
        let coordinates = coordinates(settings.dof);
        let mut widths = vec![encoded_width(coordinates, settings.bands) + settings.code];
        widths.extend(&settings.layers);
        widths.push(coordinates);
        let spec = MlpSpec::new(prefix, &widths).skip(&settings.skip).hidden(settings.activation.of_warps());
        PointNetwork { network: Mlp::new(spec), bands: settings.bands }
    }

    #[track_caller]
    fn apply(&self, points: &Tensor, code: &Tensor) -> Tensor {
        self.network.apply(&concat([&positional_encoding(points, self.bands, None), code]))
    }
}

fn coordinates(dof: Dof) -> usize {
    if dof == Dof::Pose { 3 } else { 2 }
}

/// A network that maps points.
#[derive(Clone, Debug)]
pub struct MlpWarp {
    forward: PointNetwork,
    code: usize,
    dof: Dof,
    solver: Solver,
}

impl MlpWarp {
    #[track_caller]
    pub fn new(settings: &WarpSettings) -> MlpWarp {
        let forward = PointNetwork::new("warp", settings);
        MlpWarp { forward, code: settings.code, dof: settings.dof, solver: settings.solver }
    }
}

impl Warp for MlpWarp {
    fn map(&self, at: &Points, code: &Tensor) -> Tensor {
        self.forward.apply(&at.position, code)
    }
    fn code_width(&self) -> usize {
        self.code
    }
    fn parameters(&self) -> Vec<Parameter> {
        self.forward.network.parameters.clone()
    }
    fn dof(&self) -> Dof {
        self.dof
    }
    fn solver(&self) -> Solver {
        self.solver
    }
}

/// A network that maps points and one that maps them back.
#[derive(Clone, Debug)]
pub struct ImplicitMlpWarp {
    forward: MlpWarp,
    backward: PointNetwork,
    cycle: f64,
}

impl ImplicitMlpWarp {
    /// `cycle` is the weight of the round trip in the loss.
    #[track_caller]
    pub fn new(settings: &WarpSettings, cycle: f64) -> ImplicitMlpWarp {
        let backward = PointNetwork::new("warp.back", settings);
        ImplicitMlpWarp { forward: MlpWarp::new(settings), backward, cycle }
    }
}

impl Warp for ImplicitMlpWarp {
    fn map(&self, at: &Points, code: &Tensor) -> Tensor {
        self.forward.map(at, code)
    }
    fn code_width(&self) -> usize {
        self.forward.code_width()
    }
    fn parameters(&self) -> Vec<Parameter> {
        self.forward.parameters().into_iter().chain(self.backward.network.parameters.clone()).collect()
    }
    fn penalty(&self, at: &Points, code: &Tensor, mapped: &Tensor) -> Option<(Tensor, f64)> {
        Some((mean_squared_error(&at.position, &self.backward.apply(mapped, code)), self.cycle))
    }
    fn dof(&self) -> Dof {
        self.forward.dof()
    }
    fn solver(&self) -> Solver {
        self.forward.solver()
    }
}

/// Deviation of the Gaussian activation in the published pose network.
const POSE_SIGMA: f64 = 0.3;

/// A pose a frame, from a network that sees the frame's code.
#[derive(Clone, Debug)]
pub struct Se3Field {
    network: Mlp,
    code: usize,
    output_scale: [f64; 2],
}

impl Se3Field {
    #[track_caller]
    pub fn new(settings: &WarpSettings) -> Se3Field {
        let mut widths = vec![settings.code];
        widths.extend(&settings.layers);
        widths.push(Dof::Pose.count());
        let activation = match settings.activation {
            ActivationKind::Gaussian => Activation::Gaussian(POSE_SIGMA),
            other => other.of_warps(),
        };
        let spec = MlpSpec::new("warp", &widths).skip(&settings.skip).hidden(activation);
        Se3Field { network: Mlp::new(spec), code: settings.code, output_scale: settings.output_scale }
    }

    #[track_caller]
    fn twist(&self, code: &Tensor) -> Tensor {
        scaled(Dof::Pose, &self.network.apply(code), self.output_scale)
    }
}

impl Warp for Se3Field {
    fn map(&self, at: &Points, code: &Tensor) -> Tensor {
        move_points(Dof::Pose, &self.twist(code), &at.position)
    }
    fn code_width(&self) -> usize {
        self.code
    }
    fn parameters(&self) -> Vec<Parameter> {
        self.network.parameters.clone()
    }
    fn global(&self, _: &Axis, code: &Tensor) -> Option<Tensor> {
        Some(se3_exp(&self.twist(code)))
    }
    fn dof(&self) -> Dof {
        Dof::Pose
    }
}
