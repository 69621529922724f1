//! The presets, embedded so that the command needs no files beside it.

/// A built-in settings file.
#[derive(Clone, Copy, Debug)]
pub struct Preset {
    pub name: &'static str,
    pub text: &'static str,
}

impl Preset {
    pub fn find(name: &str) -> Option<Preset> {
        PRESETS.iter().copied().find(|p| p.name == name)
    }
    /// The comment at the top of the file, as one line.
    pub fn summary(&self) -> String {
        let lines = self.text.lines().map_while(|l| l.strip_prefix('#'));
        lines.map(str::trim).collect::<Vec<_>>().join(" ")
    }
}

macro_rules! presets {
    ($($name:literal),* $(,)?) => {
        /// Every preset, in the order in which `raygrad presets` lists them.
        pub const PRESETS: &[Preset] =
            &[$(Preset { name: $name, text: include_str!(concat!("../../../presets/", $name, ".toml")) }),*];
    };
}

presets!(
    "planar-l2g-small",
    "planar-barf-small",
    "planar-naive-small",
    "planar-inn-small",
    "planar-multi-inn-small",
    "planar-l2g",
    "planar-barf",
    "planar-naive",
    "planar-inn",
    "planar-multi-inn",
    "planar-mlp",
    "planar-implicit-mlp",
    "planar-noenc",
    "planar-none",
    "planar-l2g-noglobal",
    "planar-barf-original",
    "planar-l2g-rigid",
    "planar-barf-rigid",
    "planar-naive-rigid",
    "planar-l2g-rotation",
    "planar-l2g-translation",
    "l2g-small",
    "barf-small",
    "nerf-small",
    "inn-small",
    "multi-inn-small",
    "mlp-small",
    "implicit-mlp-small",
    "se3-field-small",
    "garf-small",
    "naive-small",
    "l2g-blender",
    "l2g-noglobal-blender",
    "barf-blender",
    "barf-blender-original",
    "naive-blender",
    "nerf-blender",
    "l2g-llff",
    "barf-llff",
    "l2g-noglobal-llff",
    "naive-llff",
    "nerf-llff",
    "nerf-blender-repr",
    "nerf-llff-repr",
    "l2g-iphone",
    "barf-iphone",
    "garf-llff",
    "garf-llff-se3",
    "nerf-gaussian-llff",
    "inn-blender",
    "inn-llff",
    "inn-dtu",
    "l2g-dtu",
    "barf-dtu",
    "nerf-dtu",
    "inn-llff-frozen-network",
    "inn-llff-frozen-code",
    "inn-llff-posenc",
    "inn-llff-extrinsic",
    "inn-llff-channels",
    "inn-llff-no-anneal",
    "multi-inn-llff",
    "mlp-llff",
    "implicit-mlp-llff",
    "se3-field-llff",
);
