//! The growing pool of values and how operands are chosen from it.

use super::{Recipe, SMALL};
use crate::Rng;
use raygrad_compiler::graph::{Axes, Axis, Channels, Shape, Tensor};
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::reference::{Array, Bindings};
use raygrad_compiler::scalar::DType;

/// A float tensor and what is known of its values.
#[derive(Clone, Debug)]
pub(super) struct Float {
    pub t: Tensor,
    /// No magnitude is above it.
    pub bound: f64,
    /// All values are multiples of this power of two, on every backend.
    pub unit: Option<f64>,
}

#[derive(Clone, Debug)]
pub(super) enum Value {
    Float(Float),
    Integer(Tensor),
}

/// Most lanes of a value.
const MAX_LANES: usize = 40_000;
/// Exact values stay below this many units: sums and products of f32 are exact far beyond.
const MAX_UNITS: f64 = 262_144.0;

pub(super) struct Builder {
    pub rng: Rng,
    pub axes: Vec<Axis>,
    /// The axis gathers point along.
    pub slot: Axis,
    /// One place a node; left out nodes have none.
    pub values: Vec<Option<Value>>,
    pub bindings: Bindings,
    /// Inputs that gradients are taken of.
    pub parameters: Vec<Tensor>,
    /// Parameters that may be updated: no comparison depends on their values.
    pub free: Vec<Tensor>,
    /// Name of the next input.
    pub next: String,
}

impl Builder {
    pub fn new(recipe: &Recipe) -> Builder {
        let names = ["frame", "ray", "sample"];
        let (last, sizes) = recipe.sizes.split_last().expect("a recipe has sizes");
        let axes: Vec<Axis> = sizes.iter().zip(names).map(|(size, name)| Axis::new(name, *size)).collect();
        let slot = Axis::new("slot", *last);
        Builder {
            rng: Rng(0),
            axes,
            slot,
            values: vec![],
            bindings: Bindings::new(),
            parameters: vec![],
            free: vec![],
            next: String::new(),
        }
    }

    /// One node; `None` where nothing fits.
    pub fn node(&mut self, at: usize) -> Option<Value> {
        self.next = format!("n{at}");
        if at < 3 {
            return self.input_node();
        }
        match self.rng.below(100) {
            0..8 => self.input_node(),
            8..17 => self.unary(),
            17..29 => self.binary(),
            29..33 => self.kink(),
            33..44 => self.channels(),
            44..55 => self.layer(),
            55..64 => self.line(),
            64..68 => self.product(),
            68..76 => self.reduction(),
            76..80 => self.scan(),
            80..86 => self.gather(),
            86..93 => self.integer(),
            93..95 => self.choice(),
            95..97 => self.eigen(),
            _ => self.marker(),
        }
    }

    /// Every axis kept with a chance of its own; `slot` rarely.
    pub fn some_axes(&mut self) -> Vec<Axis> {
        let keep = [0.2, 0.5, 0.8, 1.0][self.rng.below(4)];
        let mut axes: Vec<Axis> = self.axes.clone().into_iter().filter(|_| self.rng.chance(keep)).collect();
        if self.rng.chance(0.12) {
            axes.push(self.slot.clone());
        }
        axes
    }

    pub fn some_width(&mut self) -> usize {
        [1, 1, 1, 2, 2, 3, 3, 4, 5, 8, 9, 16, 17, 33][self.rng.below(14)]
    }

    /// A new input of 3 digits after the point, in -1..1. Exact inputs are multiples of 1/8.
    pub fn input(&mut self, name: &str, axes: &[Axis], channels: impl Into<Channels>, exact: bool) -> Float {
        let shape = Shape::of(Axes::new(axes.iter().cloned()), channels, DType::F32);
        let role = match self.rng.below(6) {
            0 => Role::Data,
            1 => Role::State,
            _ => Role::Parameter,
        };
        let unit = if exact { 8.0 } else { 1024.0 };
        let values = (0..shape.lanes()).map(|_| (self.rng.uniform(-1.0, 1.0) * unit).round() / unit).collect();
        self.bindings.insert(name.into(), Array::floats(&shape, values));
        let t = Tensor::input(name, role, shape);
        if role != Role::Data {
            self.parameters.push(t.clone());
            if !exact {
                self.free.push(t.clone());
            }
        }
        Float { t, bound: 1.0, unit: exact.then_some(1.0 / unit) }
    }

    fn input_node(&mut self) -> Option<Value> {
        let name = self.next.clone();
        // Wide and without axes: what parameter updates look like.
        let wide = self.rng.chance(0.08);
        let (axes, width) =
            if wide { (vec![], 256 + self.rng.below(300)) } else { (self.some_axes(), self.some_width()) };
        let exact = self.rng.chance(0.35);
        let elements: usize = axes.iter().map(Axis::size).product();
        if elements * width > MAX_LANES {
            return None;
        }
        let x = self.input(&name, &axes, width, exact);
        Some(Value::Float(x))
    }

    /// A value of at least what `fits` asks for, recent ones preferred.
    fn find<T>(&mut self, fits: impl Fn(&Value) -> Option<T>) -> Option<T> {
        let n = self.values.len();
        if n == 0 {
            return None;
        }
        let recent = self.rng.uniform(0.0, 1.0).powi(2);
        let start = n - 1 - ((n as f64 * recent) as usize).min(n - 1);
        (0..n).rev().map(|i| (start + i + 1) % n).find_map(|i| self.values[i].as_ref().and_then(&fits))
    }

    pub fn float_where(&mut self, fits: impl Fn(&Float) -> bool) -> Option<Float> {
        self.find(|v| match v {
            Value::Float(f) if fits(f) => Some(f.clone()),
            _ => None,
        })
    }
    pub fn float(&mut self) -> Option<Float> {
        self.float_where(|_| true)
    }
    pub fn integer_where(&mut self, fits: impl Fn(&Tensor) -> bool) -> Option<Tensor> {
        self.find(|v| match v {
            Value::Integer(t) if fits(t) => Some(t.clone()),
            _ => None,
        })
    }

    /// A value whose channels broadcast with those of `x`.
    pub fn matching(&mut self, x: &Tensor) -> Option<Float> {
        let channels = x.channels();
        let one = Channels::Vector(1);
        self.float_where(|f| f.t.channels() == channels || f.t.channels() == one || channels == one)
    }

    /// A result, scaled into bounds; `None` if it is too large a tensor.
    pub fn result(&self, t: Tensor, bound: f64, unit: Option<f64>) -> Option<Value> {
        assert!(t.error().is_none(), "the generator recorded a misfit: {}", t.error()?);
        if t.shape().lanes() > MAX_LANES || t.axes().elements() > 12 * SMALL {
            return None;
        }
        let float = scaled(Float { t, bound, unit });
        Some(Value::Float(float))
    }

    /// `x` mapped affinely into `low..high`; exactness is lost.
    pub fn fit(&self, x: &Float, low: f64, high: f64) -> Tensor {
        if x.bound > 0.0 && low <= -x.bound && x.bound <= high {
            return x.t.clone();
        }
        let scale = (high - low) / 2.0 / x.bound.max(1e-3);
        &x.t * scale + (low + high) / 2.0
    }
}

/// Scaled by a power of two so that the bound is at most 4; no longer exact if it has too many units.
pub(super) fn scaled(mut x: Float) -> Float {
    if x.bound > 4.0 {
        let factor = (2.0 / x.bound).log2().floor().exp2();
        x = Float { t: x.t * factor, bound: x.bound * factor, unit: x.unit.map(|u| u * factor) };
    }
    x.unit = x.unit.filter(|u| x.bound / u < MAX_UNITS);
    x
}
