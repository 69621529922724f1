//! The settings of an experiment. Field docs are in `presets/planar-l2g.toml`, which sets every one of them.

use super::values::*;
use raygrad_compiler::functions::mlp::Activation;
use serde::{Deserialize, Serialize};

/// Everything that determines a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// In 2D: the picture and its patches.
    #[serde(default, skip_serializing_if = "Data::is_absent")]
    pub data: Data,
    /// In 3D: images and cameras.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene: Option<SceneSettings>,
    /// In 3D: rays and samples of a step.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub train: Option<TrainSettings>,
    /// In 3D: what the field adds to the picture's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub radiance: Option<RadianceSettings>,
    pub noise: Noise,
    pub warp: WarpSettings,
    pub field: FieldSettings,
    pub loss: Loss,
    pub optim: Optim,
    pub run: Run,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Data {
    /// `builtin` or a file.
    pub image: String,
    pub image_size: ImageSize,
    /// Rows, columns.
    pub patch_crop: [usize; 2],
    pub patches: usize,
    pub points_per_patch: Count,
    /// `drawn` or a file.
    pub perturbation: String,
}

impl Data {
    /// Whether there is no picture: a 3D experiment.
    pub fn is_absent(&self) -> bool {
        self.patches == 0
    }
}

impl Default for Data {
    /// No picture.
    fn default() -> Data {
        let (image, perturbation) = (String::new(), String::new());
        let (image_size, points_per_patch) = (ImageSize::Photo, Count::All);
        Data { image, image_size, patch_crop: [0, 0], patches: 0, points_per_patch, perturbation }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneSettings {
    /// A folder of a known layout.
    pub path: String,
    /// Which one, by its name, or `auto`.
    pub layout: String,
    /// Which views of a DTU scan are for testing, by the name of a [`DtuSplit`](crate::scene::DtuSplit).
    pub dtu_split: String,
    /// Rows, columns.
    pub image_size: [usize; 2],
    pub train_views: Count,
    pub val_views: Count,
    pub test_views: Count,
    /// `truth`, `identity`, `noisy`, `auto`, or a file of poses.
    pub poses: String,
    /// In pixels of the image file; 0 where it is not given.
    pub focal: f64,
    pub published_rotations: bool,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainSettings {
    /// Of one step, over all views.
    pub rays: usize,
    /// Of one ray.
    pub samples: usize,
    /// More of one ray, for a second field; 0 for none.
    pub fine_samples: usize,
    pub shared_pixels: bool,
    /// Cells along a side of the maps of errors that choose pixels; 0 for none.
    pub error_map: usize,
    pub stratified: bool,
    pub depth: DepthSettings,
    /// Near, far; inverse depths for `inverse`.
    pub range: [f64; 2],
    /// Rays in normalised device coordinates.
    pub ndc: bool,
    pub density_noise: f64,
    pub opaque_background: bool,
    pub refine_steps: usize,
    pub refine_lens: RefineLens,
    /// Trains a shear of the world against which all cameras turn.
    #[serde(default)]
    pub shear: bool,
    /// Pixels along a side of the grid on which poses are fitted once more before they are measured; 0 for those of the last step.
    pub fit_grid: usize,
    /// Steps between two searches for lost cameras; 0 for none.
    pub relocalise_every: usize,
    /// Steps between two looks at a validation view; 0 for none.
    pub validate_every: usize,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RadianceSettings {
    pub skip: Vec<usize>,
    pub color_layers: Vec<usize>,
    pub view_dependent: bool,
    pub view_bands: usize,
    pub density: Density,
    pub init: FieldInit,
    #[serde(default)]
    pub stop_below: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DepthSettings {
    Metric,
    Inverse,
    /// Metric, near and far following the cameras' spread.
    Auto,
    /// What the scene's layout says.
    Scene,
}

/// Which parts of the lenses are trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RefineLens {
    None,
    Focal,
    /// Focal lengths and principal points.
    All,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Density {
    Softplus,
    Relu,
}

/// How the weights of a radiance field start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FieldInit {
    /// Uniform by inputs and outputs, biases zero: TensorFlow's.
    Glorot,
    /// Uniform by inputs, biases too: PyTorch's.
    FanIn,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Noise {
    pub kind: NoiseKind,
    pub homography: f64,
    pub rotation: f64,
    pub translation: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WarpSettings {
    pub method: Method,
    /// The type of the program's own warp that takes the place of `method`'s.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub own: String,
    pub dof: Dof,
    pub fix_first: bool,
    pub code: usize,
    pub layers: Vec<usize>,
    pub skip: Vec<usize>,
    pub bands: usize,
    pub activation: ActivationKind,
    /// Of rotations, and of translations.
    pub output_scale: [f64; 2],
    /// In 3D, the point of the world about which the warp turns cameras.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub origin: [f64; 3],
    pub solver: Solver,
    pub inn: InnSettings,
}

/// Pictures have no such setting.
fn is_zero(origin: &[f64; 3]) -> bool {
    *origin == [0.0; 3]
}

/// The invertible networks ("invertible", "multi-invertible").
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InnSettings {
    pub blocks: usize,
    pub hidden: usize,
    pub lift: Lift,
    pub code: CodeKind,
    pub anneal: Anneal,
    pub anneal_steps: usize,
    pub train_network: bool,
    pub train_code: bool,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldSettings {
    pub kind: FieldKind,
    pub sigma: f64,
    pub omega: f64,
    pub layers: Vec<usize>,
    pub bands: usize,
    pub encoding: Encoding,
    pub window: [f64; 2],
}

impl FieldSettings {
    /// What follows the hidden layers.
    pub fn activation(&self) -> Activation {
        match self.kind {
            FieldKind::Relu => Activation::Relu,
            FieldKind::Gaussian => Activation::Gaussian(self.sigma),
            FieldKind::Siren => Activation::Sine(self.omega),
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Loss {
    pub alignment: f64,
    pub cycle: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Optim {
    /// Of the schedule.
    pub steps: usize,
    /// Steps after which training ends, before the schedule does; 0: with it.
    pub stop_after: usize,
    pub lr: f64,
    pub lr_end: f64,
    pub lr_warp: f64,
    pub lr_warp_end: f64,
    pub warmup_pose: usize,
    /// Steps, at most a third of all, that the averages of trained values remember, with which a run ends; 0: it ends with the
    /// values themselves.
    #[serde(default)]
    pub average: usize,
}

impl Optim {
    /// The steps that are taken.
    pub fn taken(&self) -> usize {
        if self.stop_after == 0 { self.steps } else { self.stop_after.min(self.steps) }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Run {
    pub seed: u32,
    pub device: DeviceChoice,
    pub threads: Count,
    #[serde(default)]
    pub precision: Precision,
    #[serde(default)]
    pub autotune: bool,
    #[serde(default)]
    pub networks: Networks,
    pub log_every: usize,
    pub picture_every: usize,
    pub checkpoint_every: usize,
}
