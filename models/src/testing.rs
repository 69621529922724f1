//! Tests of a warp in two lines.
//!
//! [`check_gradients`] compares first and second derivatives with central differences of the f64 reference, and what
//! every device computes with the reference itself. [`kernels`] is the text of everything the warp compiles to, for a
//! snapshot test.

use crate::config::Dof;
use crate::data::Random;
use crate::warps::{CODE, Points, Registration, Warp, code_tensor, codes, move_by};
use raygrad_compiler::autodiff::{grad, zeros_like};
use raygrad_compiler::functions::mlp::Init;
use raygrad_compiler::graph::topological;
use raygrad_compiler::ops::input::Input;
use raygrad_compiler::reference::{Array, Bindings, Data, Direction, EvalError, central_difference, evaluate};
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Axis, Program, Shape, Step, StepError, Target, Tensor, compile};
use raygrad_runtime::{Device, DeviceError, RunError, Session};

/// A derivative or a device that disagrees with the reference.
#[derive(Debug, thiserror::Error)]
pub enum TestError {
    #[error("{order} derivative by `{input}`: the graph gives {found}, central differences give {expected}")]
    Gradient { order: &'static str, input: String, found: f64, expected: f64 },
    #[error(
        "`{promise}` is not what `Warp::map` does: it puts a point at {expected:?}, the map at {found:?}. `Warp::global` gives the \
         homography from sensor to field, in space the pose (3, 4) that takes field points back to `at.position`"
    )]
    Promise { promise: &'static str, found: Vec<f64>, expected: Vec<f64> },
    #[error("`{output}` on {device}: {found}, in the reference {expected}")]
    Device { device: String, output: String, found: f64, expected: f64 },
    #[error(transparent)]
    Evaluate(#[from] EvalError),
    #[error(transparent)]
    Compile(#[from] StepError),
    #[cfg(feature = "gpu")]
    #[error(transparent)]
    Lower(#[from] raygrad_kernels::gpu::LowerError),
    #[error(transparent)]
    Open(#[from] DeviceError),
    #[error(transparent)]
    Run(#[from] RunError),
}

const FRAMES: usize = 3;
const POINTS: usize = 7;
/// The step number, for warps that change while training goes on.
const STEP: u32 = 3;
/// Steps of the central differences, and what may be lost to them, relative to the derivative.
const STEPS: [f64; 3] = [1e-4, 1e-5, 1e-6];
const TOLERANCE: f64 = 1e-5;
/// Relative tolerance of f32 on a device.
const SINGLE: f64 = 2e-4;

/// A warp on a few random points, and a scalar that depends on every number it gives.
struct Bench {
    scalar: Tensor,
    local: Tensor,
    /// What the map is to be the same as, by the name of what says so, with a code of zeros or as it is.
    promises: Vec<(&'static str, Tensor, bool)>,
    /// Points, code and parameters.
    inputs: Vec<Tensor>,
    bindings: Bindings,
}

impl Bench {
    fn new(warp: &dyn Warp) -> Result<Bench, TestError> {
        let frame = warp.frame().cloned().unwrap_or_else(|| Axis::new("frame", FRAMES));
        let point = Axis::new("point", POINTS);
        let xy = Tensor::parameter("points", Shape::new(&[&frame, &point], 2));
        let planar = Points::planar(frame.clone(), point.clone(), xy.clone());
        let (at, expected) = if warp.dof() == Dof::Pose {
            let shape = Shape::new(&[&frame, &point], 3);
            let position = Tensor::parameter("positions", shape.clone());
            (Points { position, ..planar }, shape)
        } else {
            (planar, xy.shape().clone())
        };
        // The rays of a frame end in its camera's centre.
        let position = Tensor::parameter("centers", Shape::new(&[&frame], 3));
        let centers = (warp.dof() == Dof::Pose).then(|| Points { position, first: POINTS, ..at.clone() });
        let code = codes(warp, &frame);
        let found = Registration::new(warp, &at, centers.as_ref(), &code_tensor(code.as_ref()), false);
        let mut promises = vec![];
        if found.residual.is_none() {
            promises.push(("Warp::global", move_by(warp.dof(), &found.transform, &at.position), false));
        }
        if warp.zero_code_is_identity() {
            promises.push(("Warp::zero_code_is_identity", at.position.clone(), true));
        }
        let mut random = Random::new(0, "testing");
        let mut bindings = Bindings::new();
        let upstream = Tensor::data("upstream", expected);
        let mut scalar = (&found.local * upstream).sum_channels().sum_over(found.local.axes());
        if let Some(residual) = &found.residual {
            scalar = scalar + residual;
        }
        if let Some(centers) = &found.centers {
            scalar = scalar + centers.sin().sum_channels().sum_over(centers.axes());
        }
        if let Some((penalty, weight)) = &found.penalty {
            scalar = scalar + penalty * *weight;
        }
        for t in topological([scalar.clone()].into_iter().chain(promises.iter().map(|(_, t, _)| t.clone()))) {
            let Some(Input { name, shape, .. }) = t.op_as::<Input>() else { continue };
            let array = match shape.dtype {
                DType::F32 => Array::floats(shape, (0..shape.lanes()).map(|_| 0.5 * random.normal()).collect()),
                DType::U32 => Array::integers(shape, vec![STEP; shape.lanes()]),
            };
            bindings.insert(name.clone(), array);
        }
        let parameters: Vec<_> = code.into_iter().chain(warp.parameters()).collect();
        for p in &parameters {
            let spread = match p.init {
                Init::Zero => 0.1,
                Init::Uniform(bound) => bound,
                Init::Normal(deviation) => 0.3 * deviation,
                Init::NormalRows { deviation, .. } => deviation,
                Init::ColumnNorms { .. } => 1.0,
            };
            let values = (0..p.tensor.shape().lanes()).map(|_| spread * (2.0 * random.uniform() - 1.0)).collect();
            bindings
                .insert(p.tensor.input_name().unwrap_or_default().to_string(), Array::floats(p.tensor.shape(), values));
        }
        // A warp that does not look where on the sensor a point lies has nothing to say about `points` in 3D.
        let used = |t: &Tensor| bindings.contains_key(t.input_name().unwrap_or_default());
        let points = [xy, at.position].into_iter().chain(centers.map(|c| c.position)).filter(used);
        let mut inputs: Vec<Tensor> = vec![];
        points.for_each(|t| {
            if !inputs.iter().any(|known| known.id() == t.id()) {
                inputs.push(t)
            }
        });
        let inputs = inputs.into_iter().chain(parameters.into_iter().map(|p| p.tensor)).collect();
        Ok(Bench { scalar, local: found.local, promises, inputs, bindings })
    }

    /// Compares the map with what the warp says of it.
    fn check_promises(&self) -> Result<(), TestError> {
        for (promise, expected, without_code) in &self.promises {
            let mut bindings = self.bindings.clone();
            if let (true, Some(code)) = (without_code, bindings.get_mut(CODE)) {
                code.f_mut().fill(0.0);
            }
            let axes = self.local.axes().union(expected.axes());
            let both = [self.local.broadcast_to(&axes), expected.broadcast_to(&axes)];
            let [found, expected] = [0, 1].map(|i| evaluate(&both[i..=i], &bindings));
            let (found, expected, width) = (found?.remove(0), expected?.remove(0), self.local.width());
            for (found, expected) in found.f().chunks(width).zip(expected.f().chunks(width)) {
                let agree = |(a, b): (&f64, &f64)| (a - b).abs() <= TOLERANCE * (1.0 + b.abs());
                if !found.iter().zip(expected).all(agree) {
                    let (found, expected) = (found.to_vec(), expected.to_vec());
                    return Err(TestError::Promise { promise, found, expected });
                }
            }
        }
        Ok(())
    }

    /// Compares the derivatives of `scalar` along a random direction of each input with central differences. The sum of
    /// these derivatives, as a graph, with its directions in the bindings: what the next order differentiates.
    fn check(
        &self,
        order: &'static str,
        scalar: &Tensor,
        bindings: &mut Bindings,
        random: &mut Random,
    ) -> Result<Tensor, TestError> {
        let gradients = grad(scalar, &self.inputs.iter().collect::<Vec<_>>());
        let (mut slopes, mut directions) = (vec![], vec![]);
        for (input, gradient) in self.inputs.iter().zip(gradients) {
            let name = format!("{order} direction.{}", input.input_name().unwrap_or_default());
            let direction: Vec<f64> = (0..input.shape().lanes()).map(|_| random.normal()).collect();
            bindings.insert(name.clone(), Array::floats(input.shape(), direction.clone()));
            let along = gradient * Tensor::data(name, input.shape().clone());
            slopes.push(along.reshape(input.width()).sum_channels().sum_over(input.axes()));
            directions.push(direction);
        }
        let found = evaluate(&slopes, bindings)?;
        for ((input, direction), found) in self.inputs.iter().zip(&directions).zip(found) {
            let (name, found) = (input.input_name().unwrap_or_default(), found.f()[0]);
            let differences = |step| central_difference(scalar, bindings, name, &Direction::Along(direction), step);
            let agrees = |expected: f64| (found - expected).abs() <= TOLERANCE * (1.0 + expected.abs());
            // A difference across a kink (of a rectifier) is no derivative: a shorter one does not reach it.
            let expected = differences(STEPS[0])?;
            if !agrees(expected) && !agrees(differences(STEPS[1])?) && !agrees(differences(STEPS[2])?) {
                return Err(TestError::Gradient { order, input: name.to_string(), found, expected });
            }
        }
        Ok(slopes.into_iter().reduce(|a, b| a + b).unwrap_or_else(|| Tensor::scalar(0.0)))
    }

    /// Values and gradients as one step.
    fn step(&self) -> Step {
        let gradients = grad(&self.scalar, &self.inputs.iter().collect::<Vec<_>>());
        let named = self.inputs.iter().zip(gradients).map(|(input, g)| {
            let g = g.broadcast_to(input.axes()) + zeros_like(input);
            (format!("gradient of {}", input.input_name().unwrap_or_default()), g)
        });
        Step {
            outputs: [("points".to_string(), self.local.clone())].into_iter().chain(named).collect(),
            updates: vec![],
        }
    }
}

/// Checks that a warp does what its `global` and `zero_code_is_identity` say, its derivatives, first and second order, and its
/// values and gradients on every device there is.
pub fn check_gradients(warp: &dyn Warp) -> Result<(), TestError> {
    check_gradients_on(warp, &devices()?)
}

/// The same with values and gradients on these devices, which have names for messages: a warp of many kernels takes minutes
/// on a software GPU.
pub fn check_gradients_on(warp: &dyn Warp, devices: &[(String, Device)]) -> Result<(), TestError> {
    let bench = Bench::new(warp)?;
    bench.check_promises()?;
    let (mut bindings, mut random) = (bench.bindings.clone(), Random::new(1, "testing"));
    let slope = bench.check("first", &bench.scalar, &mut bindings, &mut random)?;
    bench.check("second", &slope, &mut bindings, &mut random)?;
    let step = bench.step();
    let expected = evaluate(&step.roots(), &bench.bindings)?;
    for (name, device) in devices {
        let mut session = Session::new(device.clone())?;
        let program = session.add(compile(&step, &device.target())?)?;
        for (input, value) in &bench.bindings {
            if session.inputs().any(|(known, _)| known == input) {
                match &value.data {
                    Data::F(v) => session.set(input, &v.iter().map(|v| *v as f32).collect::<Vec<_>>())?,
                    Data::U(v) => session.set_u32(input, v)?,
                }
            }
        }
        session.run(program)?;
        for ((output, _), expected) in step.outputs.iter().zip(&expected) {
            let scale = expected.f().iter().fold(1.0, |m: f64, v| m.max(v.abs()));
            for (found, expected) in session.read(program, output)?.iter().zip(expected.f()) {
                let (device, output, found) = (name.clone(), output.clone(), f64::from(*found));
                // Written so that a value that is not a number fails too.
                if (found - expected).abs() <= SINGLE * scale {
                    continue;
                }
                return Err(TestError::Device { device, output, found, expected: *expected });
            }
        }
    }
    Ok(())
}

/// Everything a warp with its gradients compiles to, plans for CPU and GPU and the GPU's kernels as WGSL: what a snapshot
/// test compares.
pub fn kernels(warp: &dyn Warp) -> Result<String, TestError> {
    let mut bench = Bench::new(warp)?;
    // Data in training, so no gradient goes there.
    bench.inputs.retain(|t| !matches!(t.input_name(), Some("points" | "positions" | "centers")));
    let step = bench.step();
    let (cpu, gpu) = (compile(&step, &Target::cpu())?, compile(&step, &Target::gpu())?);
    Ok(format!("cpu\n{cpu}\ngpu\n{gpu}\n{}", wgsl(&gpu)?))
}

#[cfg(feature = "gpu")]
fn wgsl(program: &Program) -> Result<String, TestError> {
    use raygrad_kernels::gpu::{Inputs, Limits, lower};
    let lowered = lower(program, &mut Inputs::default(), &Limits::default())?;
    let sources = lowered.launches.iter().flat_map(|l| &l.kernels);
    sources.map(|k| Ok(format!("// {}\n{}", k.name, k.wgsl()?))).collect()
}
#[cfg(not(feature = "gpu"))]
fn wgsl(_: &Program) -> Result<String, TestError> {
    Ok(String::new())
}

/// The CPU, and the best adapter of each backend for GPUs, if there is one.
pub fn devices() -> Result<Vec<(String, Device)>, DeviceError> {
    let mut devices = vec![("cpu".to_string(), Device::cpu(Some(1))?)];
    devices.extend(Device::wgpu(None).ok().map(|d| ("wgpu".to_string(), d)));
    devices.extend(Device::vulkan(None).ok().map(|d| ("vulkan".to_string(), d)));
    Ok(devices)
}

/// Compares [`testing::kernels`](crate::testing::kernels) of a warp with a reviewed snapshot; the calling crate needs
/// `insta`.
#[macro_export]
macro_rules! assert_kernels {
    ($name:expr, $warp:expr) => {
        match $crate::testing::kernels($warp) {
            Ok(kernels) => insta::assert_snapshot!($name, kernels),
            Err(error) => panic!("{error}"),
        }
    };
}
