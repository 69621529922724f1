//! One invertible network for all frames and a code a frame (INN: Chng, Garg, Saratchandran, Lucey, Invertible neural
//! warp for NeRF, ECCV 2024), or a network a frame without codes.
//!
//! A block moves one coordinate f by an amount that depends on the others o, and then the others by a rotation about a
//! point that depends on f. Each half is undone by subtraction, so the map has an exact inverse for any weights:
//!
//! ```text
//! c  = phi + W phi + w                         the frame's code, as the block sees it
//! f' = f - g_a(gamma(o), c)
//! o' = A(theta) (o - delta),   (theta, delta) = g_b(gamma(f'), c),   A(theta) = [[cos, sin], [-sin, cos]]
//! ```
//!
//! The blocks take z, y, x for f in turn; from the fourth on x, y, z. Each g has one weight-normalised hidden layer. Output
//! layers start at zero, so the map starts as the identity. In the plane the network either maps (x, y, 1), and the third
//! coordinate divides, or it maps (x, y) in the order y, x, y with `o' = o - g_b(gamma(f'), c)`.

use super::{Points, Warp};
use crate::config::{Anneal, CodeKind, Dof, InnSettings, Lift, Solver, WarpSettings};
use crate::training::optimise::STEP;
use raygrad_compiler::functions::lie::so2_exp;
use raygrad_compiler::functions::matrix::apply;
use raygrad_compiler::functions::mlp::{Activation, Init, Parameter};
use raygrad_compiler::functions::posenc::{
    coarse_to_fine_weights, encoded_width, frequency_encoding, positional_encoding,
};
use raygrad_compiler::functions::weight_norm::NormalisedLayer;
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Axes, Axis, Channels, Shape, Tensor};

/// Frequencies of the encoding of an extrinsic code, whose rotation and translation have three numbers each.
const EXTRINSIC_BANDS: usize = 10;
/// Keeps the third coordinate, which divides, off zero.
const DIVISOR: f64 = 1e-8;

/// The blocks and what they see.
#[derive(Clone, Debug)]
pub struct InvertibleWarp {
    blocks: Vec<Block>,
    settings: InnSettings,
    /// Numbers of a frame's code as the network sees it; 0 for none.
    code: usize,
    bands: usize,
    dof: Dof,
    solver: Solver,
    frame: Option<Axis>,
}

/// One block: two networks and the projection of the code.
#[derive(Clone, Debug)]
struct Block {
    /// The coordinate f, and the others o.
    single: usize,
    others: Vec<usize>,
    a: Coupling,
    b: Coupling,
    /// W and w.
    projection: Option<[Parameter; 2]>,
}

/// g_a or g_b: a hidden layer and an output layer.
#[derive(Clone, Debug)]
struct Coupling {
    hidden: NormalisedLayer,
    activation: Activation,
    weight: Parameter,
    bias: Parameter,
}

impl InvertibleWarp {
    /// One network for all frames, which sees the frame's code; or, with `frame`, one network a frame and no code.
    #[track_caller]
    pub fn new(settings: &WarpSettings, frame: Option<Axis>) -> InvertibleWarp {
        let inn = &settings.inn;
        let code = match inn.code {
            _ if frame.is_some() => 0,
            CodeKind::Free => settings.code,
            CodeKind::Posenc => 2 * (settings.code / 2),
            CodeKind::Extrinsic => 2 * encoded_width(3, EXTRINSIC_BANDS),
        };
        let axes = Axes::new(frame.clone());
        let coordinates = if settings.dof == Dof::Pose || inn.lift == Lift::Homogeneous { 3 } else { 2 };
        let block = |b: usize| {
            let single = single_coordinate(b, coordinates);
            let others: Vec<usize> = (0..coordinates).filter(|c| *c != single).collect();
            let coupling = |name: &str, inputs: usize, outputs: usize| {
                let width = encoded_width(inputs, settings.bands) + code;
                Coupling::new(&format!("warp.{b}.{name}"), [inputs, width, inn.hidden, outputs], settings, &axes)
            };
            // A rotation by an angle about a point, or in the plane a shift.
            let moved = if coordinates == 3 { 3 } else { 1 };
            let (a, b_net) = (coupling("a", others.len(), 1), coupling("b", 1, moved));
            let projection = (code > 0).then(|| {
                let name = |what: &str| format!("warp.{b}.code.{what}");
                let weight = Parameter::new(name("weight"), Shape::new(&[], (code, code)), Init::Zero);
                [weight, Parameter::new(name("bias"), Shape::new(&[], code), Init::Zero)]
            });
            Block { single, others, a, b: b_net, projection }
        };
        InvertibleWarp {
            blocks: (0..inn.blocks).map(block).collect(),
            settings: inn.clone(),
            code,
            bands: settings.bands,
            dof: settings.dof,
            solver: settings.solver,
            frame,
        }
    }

    /// Coordinates of the points that the network maps: 3, or 2 where it maps the plane itself.
    pub fn coordinates(&self) -> usize {
        self.blocks.first().map_or(0, |b| 1 + b.others.len())
    }

    /// The network's map of `points`, with [`InvertibleWarp::coordinates`] channels, which lie along the axes of `at`.
    #[track_caller]
    pub fn forward(&self, at: &Points, points: &Tensor, code: &Tensor) -> Tensor {
        let code = self.code_of(at, code);
        self.blocks.iter().fold(points.clone(), |p, block| {
            let seen = block.project(code.as_ref());
            let (f, o) = block.split(&p);
            let f = f - block.a.apply(&self.encode(at, &o), seen.as_ref());
            let moved = block.b.apply(&self.encode(at, &f), seen.as_ref());
            let o = match moved.width() {
                1 => o - moved,
                _ => apply(&so2_exp(&moved.ch(0)).transpose(), &(o - moved.slice(1..3))),
            };
            block.join(&f, &o)
        })
    }

    /// The points that [`InvertibleWarp::forward`] takes to `mapped`. With annealing by point slots they must be the
    /// points of `at` in the same order.
    #[track_caller]
    pub fn inverse(&self, at: &Points, mapped: &Tensor, code: &Tensor) -> Tensor {
        let code = self.code_of(at, code);
        self.blocks.iter().rev().fold(mapped.clone(), |p, block| {
            let seen = block.project(code.as_ref());
            let (f, o) = block.split(&p);
            let moved = block.b.apply(&self.encode(at, &f), seen.as_ref());
            let o = match moved.width() {
                1 => o + moved,
                _ => apply(&so2_exp(&moved.ch(0)), &o) + moved.slice(1..3),
            };
            let f = f + block.a.apply(&self.encode(at, &o), seen.as_ref());
            block.join(&f, &o)
        })
    }

    /// gamma: the encoding of some coordinates, at this step of the annealing.
    #[track_caller]
    fn encode(&self, at: &Points, v: &Tensor) -> Tensor {
        if self.bands == 0 || self.settings.anneal == Anneal::None {
            return frequency_encoding(v, self.bands, None);
        }
        let step = Tensor::per_step(STEP, Shape::new(&[], 1).with_dtype(DType::U32));
        let alpha = step.to_f32() * (1.0 / self.settings.anneal_steps as f64);
        let weights = coarse_to_fine_weights(&alpha, self.bands, 0.0, 1.0);
        match self.settings.anneal {
            Anneal::PointSlots => frequency_encoding(v, self.bands, None) * slot_weights(at, v.width(), &weights),
            Anneal::None | Anneal::Channels => frequency_encoding(v, self.bands, Some(&weights)),
        }
    }

    /// The frames' codes as the network sees them.
    #[track_caller]
    fn code_of(&self, at: &Points, code: &Tensor) -> Option<Tensor> {
        if self.code == 0 {
            return None;
        }
        Some(match self.settings.code {
            CodeKind::Free => code.clone(),
            CodeKind::Posenc => {
                let time = (Tensor::index(&at.frame).to_f32() + 1.0) * (1.0 / at.frame.size() as f64);
                positional_encoding(&time, self.code / 2, None).slice(1..1 + self.code)
            }
            CodeKind::Extrinsic => {
                let half = |part: std::ops::Range<usize>| positional_encoding(&code.slice(part), EXTRINSIC_BANDS, None);
                concat([&half(0..3), &half(3..6)])
            }
        })
    }
}

/// The coordinate f of block `b`.
fn single_coordinate(b: usize, coordinates: usize) -> usize {
    match (coordinates, b / 3 % 2) {
        (2, _) => 1 - b % 2,
        (_, 0) => 2 - b % 3,
        _ => b % 3,
    }
}

/// What the published code does instead of weighting frequencies: it weights points. Counted over all points of a frame,
/// pixels first and centres after them, point s has the weight of channel s of the encoding of `inputs` coordinates; the
/// points beyond have 1.
#[track_caller]
fn slot_weights(at: &Points, inputs: usize, weights: &Tensor) -> Tensor {
    let slot = Tensor::index(&at.point).wrapping_add(&Tensor::integers(&[at.first as u32]));
    let first = |band: usize| (inputs * (1 + 2 * band)) as u32;
    let starts: Vec<u32> = (0..weights.width()).map(first).collect();
    let ends: Vec<u32> = (1..=weights.width()).map(first).collect();
    let inside = slot.greater_equal(&Tensor::integers(&starts)).bit_and(&slot.less_than(&Tensor::integers(&ends)));
    inside.select(&(weights - 1.0), &Tensor::scalar(0.0)).sum_channels() + 1.0
}

impl Block {
    /// c.
    #[track_caller]
    fn project(&self, code: Option<&Tensor>) -> Option<Tensor> {
        let (code, [weight, bias]) = (code?, self.projection.as_ref()?);
        Some(code + code.linear(&weight.tensor) + &bias.tensor)
    }

    /// f and o.
    #[track_caller]
    fn split(&self, points: &Tensor) -> (Tensor, Tensor) {
        (points.ch(self.single), points.pick(&self.others))
    }

    #[track_caller]
    fn join(&self, f: &Tensor, o: &Tensor) -> Tensor {
        let place = |c: usize| self.others.iter().position(|other| *other == c).map_or(0, |i| i + 1);
        let order: Vec<usize> = (0..=self.others.len()).map(place).collect();
        concat([f, o]).pick(&order)
    }

    fn parameters(&self) -> impl Iterator<Item = Parameter> {
        let projection = self.projection.clone().into_iter().flatten();
        self.a.parameters().into_iter().chain(self.b.parameters()).chain(projection)
    }
}

impl Coupling {
    /// With so many raw coordinates, inputs in all, hidden channels, and outputs.
    #[track_caller]
    fn new(prefix: &str, widths: [usize; 4], settings: &WarpSettings, axes: &Axes) -> Coupling {
        let [raw, inputs, hidden, outputs] = widths;
        let init = Init::NormalRows { rows: raw, deviation: (2.0 / hidden as f64).sqrt() };
        let shape = |channels: Channels| Shape::new(&[], 1).with_channels(channels).with_axes(axes.clone());
        let name = |what: &str| format!("{prefix}.out.{what}");
        Coupling {
            hidden: NormalisedLayer::new(&format!("{prefix}.hidden"), inputs, hidden, init, axes),
            activation: settings.activation.of_warps(),
            weight: Parameter::new(name("weight"), shape((hidden, outputs).into()), Init::Zero),
            bias: Parameter::new(name("bias"), shape(outputs.into()), Init::Zero),
        }
    }

    #[track_caller]
    fn apply(&self, encoded: &Tensor, code: Option<&Tensor>) -> Tensor {
        let input = concat([encoded].into_iter().chain(code));
        self.activation.apply(&self.hidden.apply(&input)).linear(&self.weight.tensor) + &self.bias.tensor
    }

    fn parameters(&self) -> Vec<Parameter> {
        let mut all = self.hidden.parameters();
        all.extend([self.weight.clone(), self.bias.clone()]);
        all
    }
}

impl Warp for InvertibleWarp {
    fn map(&self, at: &Points, code: &Tensor) -> Tensor {
        if self.coordinates() == at.position.width() {
            return self.forward(at, &at.position, code);
        }
        let mapped = self.forward(at, &concat([&at.position, &Tensor::scalar(1.0)]), code);
        mapped.slice(0..2) / (mapped.ch(2) + DIVISOR)
    }
    fn code_width(&self) -> usize {
        match self.settings.code {
            CodeKind::Free => self.code,
            CodeKind::Extrinsic if self.code > 0 => 6,
            CodeKind::Posenc | CodeKind::Extrinsic => 0,
        }
    }
    fn code_trained(&self) -> bool {
        self.settings.train_code
    }
    fn parameters(&self) -> Vec<Parameter> {
        let trained = self.settings.train_network;
        self.blocks.iter().flat_map(Block::parameters).map(|p| p.trained(trained)).collect()
    }
    fn frame(&self) -> Option<&Axis> {
        self.frame.as_ref()
    }
    fn dof(&self) -> Dof {
        self.dof
    }
    fn solver(&self) -> Solver {
        self.solver
    }
}
