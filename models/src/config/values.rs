//! What single settings can be: choices among names, and numbers that may be words.

use raygrad_compiler::functions::mlp::Activation;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use std::fmt;
use std::str::FromStr;

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
    /// The number, given how many there are.
    pub fn of(self, all: usize) -> usize {
        match self {
            Count::All => all,
            Count::Of(n) => n.min(all),
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

/// How precise a run computes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    #[default]
    F32,
    /// Matrix products of halves: f16 with a scaled loss on GPUs, bf16 on the CPU.
    Mixed,
}

impl From<Precision> for raygrad_runtime::Precision {
    fn from(p: Precision) -> raygrad_runtime::Precision {
        match p {
            Precision::F32 => raygrad_runtime::Precision::F32,
            Precision::Mixed => raygrad_runtime::Precision::Mixed,
        }
    }
}

/// How a GPU runs networks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Networks {
    /// As `Resident`, unless `Layered` should be clearly faster by the device's rates; with `run.autotune` what is faster. Layer by
    /// layer on drivers in software.
    #[default]
    Auto,
    /// A layer is a launch.
    Layered,
    /// Rows of narrow ones stay in a workgroup through all layers, and rays of rendered views are followed whole.
    Resident,
}

/// Where a run computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceChoice {
    Auto,
    Cpu,
    /// The given adapter of `raygrad devices`, or the best one.
    Wgpu(Option<usize>),
    /// The same, of the Vulkan backend.
    Vulkan(Option<usize>),
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            DeviceChoice::Auto => f.write_str("auto"),
            DeviceChoice::Cpu => f.write_str("cpu"),
            DeviceChoice::Wgpu(None) => f.write_str("wgpu"),
            DeviceChoice::Wgpu(Some(n)) => write!(f, "wgpu:{n}"),
            DeviceChoice::Vulkan(None) => f.write_str("vulkan"),
            DeviceChoice::Vulkan(Some(n)) => write!(f, "vulkan:{n}"),
        }
    }
}
impl FromStr for DeviceChoice {
    type Err = String;
    fn from_str(s: &str) -> Result<DeviceChoice, String> {
        let of_backend = |backend: &str| match s.strip_prefix(backend)? {
            "" => Some(None),
            number => number.strip_prefix(':')?.parse().ok().map(Some),
        };
        match s {
            "auto" => Ok(DeviceChoice::Auto),
            "cpu" => Ok(DeviceChoice::Cpu),
            _ => {
                let wgpu = of_backend("wgpu").map(DeviceChoice::Wgpu);
                wgpu.or_else(|| of_backend("vulkan").map(DeviceChoice::Vulkan)).ok_or_else(|| {
                    let known = "`auto`, `cpu`, `wgpu`, `vulkan`, `wgpu:N` or `vulkan:N`";
                    format!("expected {known}, found `{s}`; `raygrad devices` lists them")
                })
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
