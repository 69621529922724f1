//! Planar registration at a small size: the real graphs on a few patches of made-up colours.

use crate::backend::load;
use crate::{Rng, seed};
use raygrad::config::Layered;
use raygrad::geometry::Grid;
use raygrad::planar::PlanarModel;
use raygrad::planar::model::{GRID, TARGET};
use raygrad::training::{Rates, optimise::STEP};
use raygrad::warps;
use raygrad_compiler::Step;
use raygrad_compiler::functions::mlp::Init;
use raygrad_compiler::graph::{Shape, Tensor, topological};
use raygrad_compiler::ops::input::{Input, Role};
use raygrad_compiler::reference::{Array, Bindings, evaluate};
use raygrad_compiler::scalar::DType;
use raygrad_runtime::Device;

/// A model and values of all its inputs.
pub struct Planar {
    pub name: String,
    pub model: PlanarModel,
    pub bindings: Bindings,
}

/// What makes a model small: three patches of 8 x 10 pixels and networks of 16 channels.
pub const SMALL: [&str; 7] = [
    "data.patches=3",
    "data.patch_crop=[8,10]",
    "warp.code=5",
    "warp.layers=[16,16,16]",
    "warp.skip=[2]",
    "field.layers=[16,16]",
    "field.bands=3",
];

/// The same graph with networks so narrow that software drivers compile its kernels in seconds.
pub const TINY: [&str; 7] = [
    "data.patches=3",
    "data.patch_crop=[8,10]",
    "warp.code=3",
    "warp.layers=[6,6]",
    "warp.skip=[1]",
    "field.layers=[6,6]",
    "field.bands=2",
];

impl Planar {
    /// A preset with some settings changed.
    pub fn new(preset: &str, set: &[&str]) -> Planar {
        let mut layered = Layered::load(preset).unwrap_or_else(|e| panic!("{e}"));
        for text in set {
            layered.set(text).unwrap_or_else(|e| panic!("{e}"));
        }
        let settings = layered.settings;
        let [rows, columns] = settings.data.patch_crop;
        let grid = Grid { height: 2 * rows, width: 2 * columns, crop: [rows, columns] };
        let model = PlanarModel::new(&settings, grid, warps::of_settings(&settings, settings.data.patches));
        let name = set.iter().fold(preset.to_string(), |name, s| format!("{name} {s}"));
        let mut planar = Planar { name, model, bindings: Bindings::new() };
        planar.fill();
        planar
    }

    /// A preset's model as it is, at the size of the built-in photo's grid, without values.
    pub fn recorded(preset: &str) -> PlanarModel {
        let settings = Layered::load(preset).unwrap_or_else(|e| panic!("{e}")).settings;
        let grid = Grid { height: 360, width: 480, crop: settings.data.patch_crop };
        PlanarModel::new(&settings, grid, warps::of_settings(&settings, settings.data.patches))
    }

    fn fill(&mut self) {
        let step = self.model.train_step();
        let mut rng = Rng(seed("planar"));
        let inputs = topological(step.roots().into_iter().chain(step.updates.iter().map(|(t, _)| t.clone())));
        for input in inputs.iter().filter_map(|t| t.op_as::<Input>()) {
            let lanes = input.shape.lanes();
            if input.shape.dtype == DType::U32 {
                self.bindings.insert(input.name.clone(), Array::zeros(&input.shape));
                continue;
            }
            let values = match (&*input.name, input.role) {
                (GRID, _) => self.model.grid.crop_points().concat(),
                (TARGET, _) => self.colours(),
                ("warp.truth", _) => {
                    let entry = |i: usize| if (i % 9).is_multiple_of(4) { 1.0 } else { 0.0 } + rng.uniform(-0.1, 0.1);
                    (0..lanes).map(entry).collect()
                }
                (_, Role::Parameter) => self.initial(&input.name, lanes, &mut rng),
                // Gradients of steps before: moments that are no longer zero.
                (name, Role::State) if name.starts_with("adam.v") => {
                    (0..lanes).map(|_| rng.uniform(1e-4, 1e-3)).collect()
                }
                _ => (0..lanes).map(|_| rng.uniform(-1e-3, 1e-3)).collect(),
            };
            self.bindings.insert(input.name.clone(), Array::floats(&input.shape, values));
        }
        self.at_step(1000);
    }

    /// Smooth colours, different in every patch.
    fn colours(&self) -> Vec<f64> {
        let points = self.model.grid.crop_points();
        let patch = |b: usize| {
            let phase = b as f64;
            let colour = move |[x, y]: [f64; 2]| {
                [(5.0 * x + phase).sin(), (4.0 * y - 2.0 * x).cos(), (3.0 * x * y + phase).sin()].map(|c| 0.5 + 0.4 * c)
            };
            points.clone().into_iter().flat_map(colour)
        };
        (0..self.model.settings.data.patches).flat_map(patch).collect()
    }

    fn initial(&self, name: &str, lanes: usize, rng: &mut Rng) -> Vec<f64> {
        let all = self.model.parameters();
        let parameter = all.iter().find(|p| p.tensor.input_name() == Some(name)).expect("a parameter of the model");
        let bound = match parameter.init {
            // Training starts at zero; derivatives are less special off it.
            Init::Zero => 0.15,
            Init::Uniform(bound) => bound,
            Init::Normal(deviation) => deviation,
            Init::NormalRows { deviation, .. } => deviation,
            Init::ColumnNorms { .. } => 1.0,
        };
        (0..lanes).map(|_| rng.uniform(-bound, bound)).collect()
    }

    /// Sets the values of step `it`.
    pub fn at_step(&mut self, it: usize) {
        for (name, value) in Rates::at(&self.model.settings.optim, it).inputs() {
            let value = Array::floats(&Shape::new(&[], 1), vec![f64::from(value as f32)]);
            self.bindings.insert(name.into(), value);
        }
    }

    pub fn parameters(&self) -> Vec<Tensor> {
        self.model.parameters().into_iter().map(|p| p.tensor).collect()
    }
}

/// An output of a step.
pub fn output(step: &Step, name: &str) -> Tensor {
    let found = step.outputs.iter().find(|(n, _)| n == name);
    found.unwrap_or_else(|| panic!("the step has no output `{name}`")).1.clone()
}

/// The combinations of warp, degrees of freedom, solver and encoding.
pub fn combinations() -> Vec<Planar> {
    let warps = [
        ("none", "8", "eigen"),
        ("global", "1", "eigen"),
        ("global", "2", "eigen"),
        ("global", "3", "eigen"),
        ("global", "8", "eigen"),
        ("local", "1", "eigen"),
        ("local", "2", "eigen"),
        ("local", "3", "eigen"),
        ("local", "8", "eigen"),
        ("local", "8", "inverse-iteration"),
    ];
    let mut all = vec![];
    for (method, dof, solver) in warps {
        for encoding in ["none", "full", "windowed"] {
            let own =
                [("warp.method", method), ("warp.dof", dof), ("warp.solver", solver), ("field.encoding", encoding)];
            let own = own.map(|(key, value)| format!("{key}={value}"));
            let set: Vec<&str> = SMALL.into_iter().chain(own.iter().map(String::as_str)).collect();
            let mut planar = Planar::new("planar-l2g", &set);
            planar.name = format!("{method} {dof} {solver} {encoding}");
            all.push(planar);
        }
    }
    all
}

/// Losses of `steps` training steps from the model's values, and all inputs after the last one.
pub struct Trajectory {
    pub losses: Vec<Vec<f64>>,
    pub after: Bindings,
}

/// Names of the losses a training step gives.
pub fn losses(step: &Step) -> Vec<String> {
    let known = ["render", "alignment", "penalty", "total"];
    step.outputs.iter().map(|(n, _)| n.clone()).filter(|n| known.contains(&&**n)).collect()
}

/// Training steps on a device.
pub fn train(device: &Device, planar: &mut Planar, steps: usize) -> Trajectory {
    let step = planar.model.train_step();
    let (mut session, id) = load(device, &step, &planar.bindings);
    let mut found = vec![];
    for it in 0..steps {
        for (name, value) in Rates::at(&planar.model.settings.optim, it).inputs() {
            if session.inputs().any(|(known, _)| known == name) {
                session.set(name, &[value as f32]).unwrap_or_else(|e| panic!("{e}"));
            }
        }
        if session.inputs().any(|(known, _)| known == STEP) {
            session.set_u32(STEP, &[it as u32]).unwrap_or_else(|e| panic!("{e}"));
        }
        session.run(id).unwrap_or_else(|e| panic!("{e}"));
        let read = |name: &String| session.read(id, name).unwrap_or_else(|e| panic!("{e}"))[0] as f64;
        found.push(losses(&step).iter().map(read).collect());
    }
    let mut after = planar.bindings.clone();
    let inputs: Vec<_> = session.inputs().map(|(n, i)| (n.to_string(), i.shape.clone())).collect();
    for (name, shape) in inputs.into_iter().filter(|(_, s)| s.dtype == DType::F32) {
        let values = session.get(&name).unwrap_or_else(|e| panic!("{e}"));
        after.insert(name, Array::floats(&shape, values.into_iter().map(f64::from).collect()));
    }
    Trajectory { losses: found, after }
}

/// The same steps in the f64 reference.
pub fn train_reference(planar: &mut Planar, steps: usize) -> Trajectory {
    let step = planar.model.train_step();
    let start = planar.bindings.clone();
    let mut found = vec![];
    for it in 0..steps {
        planar.at_step(it);
        let values = evaluate(&step.roots(), &planar.bindings).unwrap_or_else(|e| panic!("{e}"));
        let (outputs, updates) = values.split_at(step.outputs.len());
        for ((input, _), value) in step.updates.iter().zip(updates) {
            let whole = Array::from_fn(input.shape(), |e, c| value.lane(input.shape(), e, c));
            planar.bindings.insert(input.input_name().unwrap_or_default().into(), whole);
        }
        let read = |name: &String| outputs[step.outputs.iter().position(|(n, _)| n == name).unwrap_or(0)].f()[0];
        found.push(losses(&step).iter().map(read).collect());
    }
    Trajectory { losses: found, after: std::mem::replace(&mut planar.bindings, start) }
}
