//! The ops, one file each: shape rule, f64 reference, gradient as IR, lowering, cost, and samples for the tests.
//!
//! An op's file ends in `samples()`: inputs on which shape errors, reference against kernels, and first and second
//! derivatives are checked for it, with no further code. The list at the bottom of this page is the registry.

use crate::cost::Work;
use crate::graph::{Channels, Misfit, Shape, Tensor};
use crate::reference::Array;
use crate::scalar::{DType, ScalarProgram};
use std::any::Any;
use std::fmt::Debug;
use std::sync::Arc;

pub mod pointwise;
pub use pointwise::{Pointwise, map};

/// What a recorded op is.
pub trait Op: Any + Debug + Send + Sync {
    /// Name in errors and plans.
    fn name(&self) -> &'static str;

    /// Shape of the result, or why the operands do not fit.
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit>;

    /// How the compiler sees it.
    fn form(&self) -> Form;

    /// The f64 reference. `out` is the result of [`Op::shape`]; operands are not broadcast yet.
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array;

    /// Gradients with respect to the inputs, given that of the output, as IR; `None` where there is none.
    ///
    /// A rule may return a gradient with more axes or channels than the operand has: the operand was broadcast, and
    /// [`crate::autodiff`] sums over what it lacks.
    fn vjp(&self, inputs: &[Tensor], output: &Tensor, grad: &Tensor) -> Vec<Option<Tensor>>;

    /// Arithmetic per element of the op's domain, given the operand shapes, for the cost model.
    fn work(&self, inputs: &[Shape], out: &Shape) -> Work {
        match self.form() {
            Form::Pointwise(p) => Work::others(p.flops() * out.channels.count() as u64),
            Form::Linear { .. } => Work::products(inputs[1].channels.count()),
            Form::Outer => Work::products(out.channels.count()),
            Form::SymEig { n } => Work::others(60 * (n * n * n) as u64),
            _ => Work::default(),
        }
    }

    /// Text that tells two ops of one name apart; equal keys on equal inputs are one computation.
    fn key(&self) -> String {
        format!("{self:?}")
    }
}

/// The few structural kinds that stages after recording distinguish. A pointwise op is its scalar program and no more.
#[derive(Clone, Debug, PartialEq)]
pub enum Form {
    /// A named buffer.
    Input,
    /// Constant channels without axes, as lane bits.
    Const(Arc<[u32]>),
    /// Lane by lane; operands with 1 channel or fewer axes are broadcast.
    Pointwise(Arc<ScalarProgram>),
    /// Output channel `c` is channel `pick[c].1` of operand `pick[c].0`.
    Pick(Arc<[(u32, u32)]>),
    /// Output channel `j` is the sum of the input channels in `groups[j]`.
    ChannelSum(Arc<[Vec<u32>]>),
    /// Maximum over channels.
    ChannelMax,
    /// The operand itself: reshaped channels, stop-gradient, custom adjoint (operand 0).
    Identity,
    /// `y_o = sum_i x_i W_io`, or `x_i = sum_o y_o W_io` if transposed. Operands x, W.
    Linear { transposed: bool },
    /// `W_io = sum x_i d_o` over the axes of x and d that the output lacks. Operands x, d.
    Outer,
    /// Reduction over the axes that the output lacks.
    Reduce(Reduction),
    /// Exclusive cumulative sum along an axis.
    CumSum { axis: crate::graph::Axis, reverse: bool },
    /// `y[i] = x[i - by]` along an axis, 0 outside.
    Shift { axis: crate::graph::Axis, by: i64 },
    /// Position along an axis, `u32`.
    Index { axis: crate::graph::Axis },
    /// `table[.., index, ..]`: operands table (has the axis), index (`u32`, 1 channel).
    Take { axis: crate::graph::Axis },
    /// Sum of values into the slots of a new axis given by an index: operands values, index. The adjoint of `Take`.
    Scatter { axis: crate::graph::Axis },
    /// Eigenvalues (ascending) and eigenvectors (columns, row by row) of a symmetric `(n, n)` matrix.
    SymEig { n: usize },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Reduction {
    Sum,
    Max,
}

/// One test case of an op: how to record it and on what.
pub struct Sample {
    pub name: String,
    pub inputs: Vec<SampleInput>,
    pub build: Build,
    /// Whether central differences make sense here (smooth on the domain).
    pub differentiable: bool,
}

/// Records the op on the sample's inputs.
pub type Build = Box<dyn Fn(&[Tensor]) -> Tensor + Send + Sync>;

/// An operand of a sample, drawn uniformly from `low..high`.
pub struct SampleInput {
    pub shape: Shape,
    pub low: f64,
    pub high: f64,
}

impl SampleInput {
    pub fn new(shape: Shape, low: f64, high: f64) -> SampleInput {
        SampleInput { shape, low, high }
    }
}

impl Sample {
    pub fn new(
        name: impl Into<String>,
        inputs: Vec<SampleInput>,
        build: impl Fn(&[Tensor]) -> Tensor + Send + Sync + 'static,
    ) -> Sample {
        Sample { name: name.into(), inputs, build: Box::new(build), differentiable: true }
    }
    /// Marks a sample whose derivative is zero or undefined almost everywhere.
    pub fn not_differentiable(mut self) -> Sample {
        self.differentiable = false;
        self
    }
}

/// The channels two elementwise operands share: equal, or one of them 1.
pub(crate) fn common_channels(a: Channels, b: Channels) -> Result<Channels, Misfit> {
    if a == b || b == Channels::Vector(1) {
        Ok(a)
    } else if a == Channels::Vector(1) {
        Ok(b)
    } else {
        Err(Misfit::new(
            format!("channels {a} and {b} do not match"),
            format!("both operands need {a} channels, or one of them 1"),
        ))
    }
}

pub(crate) fn expect_dtype(shape: &Shape, dtype: DType, operand: usize) -> Result<(), Misfit> {
    if shape.dtype == dtype {
        return Ok(());
    }
    let (want, hint) = match dtype {
        DType::F32 => ("f32", "convert it with .to_f32()"),
        DType::U32 => ("u32", "convert it with .to_u32()"),
    };
    Err(Misfit::new(format!("operand {} must be {want}, found {shape}", operand + 1), hint))
}

macro_rules! registry {
    ($($module:ident),* $(,)?) => {
        $(pub mod $module;)*

        /// The samples of every op.
        pub fn registry() -> Vec<Sample> {
            let mut all = vec![];
            $(all.extend($module::samples());)*
            all
        }
    };
}

registry!(
    input,
    constant,
    add,
    sub,
    mul,
    div,
    neg,
    min,
    max,
    clamp,
    compare,
    select,
    cast,
    relu,
    exp,
    expm1,
    floor,
    channel_sum,
    pick,
    identity,
    linear,
    outer,
    reduce,
    index,
    cumsum,
    shift,
    take,
    scatter,
    sym_eig,
    integer,
    abs,
    log,
    log1p,
    pow,
    sqrt,
    sin,
    cos,
    tanh,
    sigmoid,
    softplus,
    gaussian,
    atan2,
    asin,
    acos,
    channel_max,
    custom,
    random
);
