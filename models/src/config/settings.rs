//! The settings of an experiment. Field docs are in `presets/planar-l2g.toml`, which sets every one of them.

use raygrad_compiler::functions::mlp::Activation;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use std::fmt;
use std::str::FromStr;

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
    /// Rows, columns.
    pub image_size: [usize; 2],
    pub train_views: Count,
    pub val_views: Count,
    pub test_views: Count,
    /// `truth`, `identity`, `noisy`, `auto`, or a file of poses.
    pub poses: String,
    /// In pixels of the image file; 0 where it is not given.
    pub focal: f64,
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
    pub stratified: bool,
    pub depth: DepthSettings,
    /// Near, far; inverse depths for `inverse`.
    pub range: [f64; 2],
    /// Rays in normalised device coordinates.
    pub ndc: bool,
    pub density_noise: f64,
    pub opaque_background: bool,
    pub refine_steps: usize,
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
    pub dof: Dof,
    pub fix_first: bool,
    pub code: usize,
    pub layers: Vec<usize>,
    pub skip: Vec<usize>,
    pub bands: usize,
    pub activation: ActivationKind,
    pub solver: Solver,
    pub inn: InnSettings,
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
    pub steps: usize,
    pub lr: f64,
    pub lr_end: f64,
    pub lr_warp: f64,
    pub lr_warp_end: f64,
    pub warmup_pose: usize,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Run {
    pub seed: u32,
    pub device: DeviceChoice,
    pub threads: Count,
    pub log_every: usize,
    pub picture_every: usize,
    pub checkpoint_every: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NoiseKind {
    L2g,
    Barf,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    None,
    Global,
    Local,
    Invertible,
    MultiInvertible,
    Mlp,
    ImplicitMlp,
    Se3Field,
}

/// What follows the hidden layers of a warp's network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ActivationKind {
    Relu,
    Softplus,
    Silu,
    Elu,
    Sine,
    Gaussian,
}

impl ActivationKind {
    /// With the constants of the invertible warp's paper.
    pub fn of_warps(self) -> Activation {
        match self {
            ActivationKind::Relu => Activation::Relu,
            ActivationKind::Softplus => Activation::Softplus(100.0),
            ActivationKind::Silu => Activation::Silu,
            ActivationKind::Elu => Activation::Elu,
            ActivationKind::Sine => Activation::Sine(10.0),
            ActivationKind::Gaussian => Activation::Gaussian(1.0),
        }
    }
}

/// How an invertible network maps the plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Lift {
    /// It maps (x, y, 1), and the third coordinate divides.
    Homogeneous,
    /// It maps (x, y).
    Plane,
}

/// What a frame's code is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CodeKind {
    Free,
    Posenc,
    Extrinsic,
}

/// How the frequencies of an invertible network open.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Anneal {
    None,
    Channels,
    PointSlots,
}

/// What a field's hidden layers are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FieldKind {
    Relu,
    Gaussian,
    Siren,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Solver {
    InverseIteration,
    Eigen,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Encoding {
    None,
    Full,
    Windowed,
}

/// Which global transform a patch has, by its degrees of freedom.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "u64", into = "u64")]
pub enum Dof {
    Rotation,
    Translation,
    Rigid,
    /// A rigid motion of space.
    Pose,
    Homography,
}

impl Dof {
    pub fn count(self) -> usize {
        match self {
            Dof::Rotation => 1,
            Dof::Translation => 2,
            Dof::Rigid => 3,
            Dof::Pose => 6,
            Dof::Homography => 8,
        }
    }
}

impl From<Dof> for u64 {
    fn from(dof: Dof) -> u64 {
        dof.count() as u64
    }
}
impl TryFrom<u64> for Dof {
    type Error = String;
    fn try_from(n: u64) -> Result<Dof, String> {
        match n {
            1 => Ok(Dof::Rotation),
            2 => Ok(Dof::Translation),
            3 => Ok(Dof::Rigid),
            6 => Ok(Dof::Pose),
            8 => Ok(Dof::Homography),
            _ => {
                Err(format!("expected 1 (rotation), 2 (translation), 3 (rigid), 6 (pose) or 8 (homography), found {n}"))
            }
        }
    }
}
impl fmt::Display for Dof {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Dof::Rotation => "rotation",
            Dof::Translation => "translation",
            Dof::Rigid => "rigid",
            Dof::Pose => "pose",
            Dof::Homography => "homography",
        })
    }
}

/// A number or `"all"`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Count {
    All,
    Of(usize),
}

impl Count {
    /// The number, given what "all" means.
    pub fn of(self, all: usize) -> usize {
        match self {
            Count::All => all,
            Count::Of(n) => n,
        }
    }
    pub fn limit(self) -> Option<usize> {
        match self {
            Count::All => None,
            Count::Of(n) => Some(n),
        }
    }
}

impl Serialize for Count {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        match self {
            Count::All => s.serialize_str("all"),
            Count::Of(n) => s.serialize_u64(*n as u64),
        }
    }
}
impl<'de> Deserialize<'de> for Count {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Count, D::Error> {
        struct Visitor;
        impl de::Visitor<'_> for Visitor {
            type Value = Count;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a whole number from 1 on, or \"all\"")
            }
            fn visit_i64<E: de::Error>(self, n: i64) -> Result<Count, E> {
                match usize::try_from(n) {
                    Ok(n) if n > 0 => Ok(Count::Of(n)),
                    _ => Err(E::invalid_value(de::Unexpected::Signed(n), &self)),
                }
            }
            fn visit_u64<E: de::Error>(self, n: u64) -> Result<Count, E> {
                self.visit_i64(i64::try_from(n).unwrap_or(i64::MAX))
            }
            fn visit_str<E: de::Error>(self, s: &str) -> Result<Count, E> {
                if s == "all" { Ok(Count::All) } else { Err(E::invalid_value(de::Unexpected::Str(s), &self)) }
            }
        }
        d.deserialize_any(Visitor)
    }
}

/// Rows and columns of the working grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageSize {
    /// The photo's own size.
    Photo,
    /// Rows, columns.
    Fixed([usize; 2]),
}

impl Serialize for ImageSize {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        match self {
            ImageSize::Photo => s.serialize_str("photo"),
            ImageSize::Fixed(size) => size.serialize(s),
        }
    }
}
impl<'de> Deserialize<'de> for ImageSize {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<ImageSize, D::Error> {
        struct Visitor;
        impl<'de> de::Visitor<'de> for Visitor {
            type Value = ImageSize;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("[rows, columns], or \"photo\"")
            }
            fn visit_str<E: de::Error>(self, s: &str) -> Result<ImageSize, E> {
                if s == "photo" { Ok(ImageSize::Photo) } else { Err(E::invalid_value(de::Unexpected::Str(s), &self)) }
            }
            fn visit_seq<A: de::SeqAccess<'de>>(self, seq: A) -> Result<ImageSize, A::Error> {
                <[usize; 2]>::deserialize(de::value::SeqAccessDeserializer::new(seq)).map(ImageSize::Fixed)
            }
        }
        d.deserialize_any(Visitor)
    }
}

/// Where a run computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceChoice {
    Auto,
    Cpu,
    /// The given adapter of `raygrad devices`, or the best one.
    Wgpu(Option<usize>),
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            DeviceChoice::Auto => f.write_str("auto"),
            DeviceChoice::Cpu => f.write_str("cpu"),
            DeviceChoice::Wgpu(None) => f.write_str("wgpu"),
            DeviceChoice::Wgpu(Some(n)) => write!(f, "wgpu:{n}"),
        }
    }
}
impl FromStr for DeviceChoice {
    type Err = String;
    fn from_str(s: &str) -> Result<DeviceChoice, String> {
        let refused =
            || format!("expected `auto`, `cpu`, `wgpu` or `wgpu:N`, found `{s}`; `raygrad devices` lists them");
        match s {
            "auto" => Ok(DeviceChoice::Auto),
            "cpu" => Ok(DeviceChoice::Cpu),
            "wgpu" => Ok(DeviceChoice::Wgpu(None)),
            _ => {
                let n = s.strip_prefix("wgpu:").ok_or_else(refused)?;
                n.parse().map(|n| DeviceChoice::Wgpu(Some(n))).map_err(|_| refused())
            }
        }
    }
}
impl Serialize for DeviceChoice {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.collect_str(self)
    }
}
impl<'de> Deserialize<'de> for DeviceChoice {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<DeviceChoice, D::Error> {
        String::deserialize(d)?.parse().map_err(de::Error::custom)
    }
}
