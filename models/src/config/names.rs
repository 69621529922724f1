//! What papers call a run: its method, its scene, and where its poses started.

use super::{
    CodeKind, Dof, Encoding, FieldKind, ImageSize, Layered, Method, NoiseKind, Origin, SceneSettings, Settings,
};
use crate::scene::Layout;
use std::path::Path;

impl Settings {
    /// `barf`, `garf`, `naive`, `noenc`, `l2g`, `l2g-noglobal`, `inn`, `multi-inn`, `mlp`, `implicit-mlp`, `se3-field`, `reference`,
    /// `gaussian-reference`, or `fixed` where poses are neither true nor learned. Variants of a method that the papers compare
    /// with it have names of their own: `inn-frozen-network`, `inn-frozen-code`, `inn-posenc`, `inn-extrinsic`.
    /// A warp of a program's own has the name of its type.
    pub fn method_name(&self) -> &str {
        if !self.warp.own.is_empty() {
            return self.warp.own.rsplit("::").next().unwrap_or(&self.warp.own);
        }
        let (inn, encoding) = (&self.warp.inn, self.field.encoding);
        match self.warp.method {
            Method::None if self.scene.as_ref().is_some_and(|s| s.poses_in(s.layout()) != "truth") => "fixed",
            Method::None if self.field.kind == FieldKind::Gaussian => "gaussian-reference",
            Method::None => "reference",
            Method::Global if encoding == Encoding::Windowed => "barf",
            Method::Global if self.field.kind == FieldKind::Gaussian => "garf",
            Method::Global if encoding == Encoding::Full => "naive",
            Method::Global => "noenc",
            Method::Local if self.loss.alignment > 0.0 => "l2g",
            Method::Local => "l2g-noglobal",
            Method::Invertible if !inn.train_network => "inn-frozen-network",
            Method::Invertible if !inn.train_code => "inn-frozen-code",
            Method::Invertible if inn.code == CodeKind::Posenc => "inn-posenc",
            Method::Invertible if inn.code == CodeKind::Extrinsic => "inn-extrinsic",
            Method::Invertible => "inn",
            Method::MultiInvertible => "multi-inn",
            Method::Mlp => "mlp",
            Method::ImplicitMlp => "implicit-mlp",
            Method::Se3Field => "se3-field",
        }
    }

    /// The scene's folder without those above it (`lego`; `scan24` of `dtu_scan24`), or the photo without its ending.
    pub fn scene_name(&self) -> String {
        let (path, part): (&str, fn(&Path) -> Option<&std::ffi::OsStr>) = match &self.scene {
            Some(scene) => (&scene.path, Path::file_name),
            None => (&self.data.image, Path::file_stem),
        };
        // `.` and `..` are called what they are from further up.
        let whole = || Some(part(&Path::new(path).canonicalize().ok()?)?.to_string_lossy().into_owned());
        let name = part(Path::new(path)).map(|n| n.to_string_lossy().into_owned()).or_else(whole);
        let name = name.unwrap_or_else(|| path.into());
        match name.rsplit_once('_') {
            Some((_, scan)) if is_scan(scan) => scan.to_string(),
            _ => name,
        }
    }

    /// Where poses or patches started, as `published.toml` has it; nothing where the true ones are known.
    pub fn start_name(&self) -> Option<String> {
        let noise = &self.noise;
        let of_scene = self.scene.as_ref().map(|s| (s.poses_in(s.layout()), noise.kind));
        match of_scene {
            None if self.warp.method == Method::None => None,
            None => Some(self.patches_name()),
            Some(("truth", _)) if self.warp.method == Method::None => None,
            Some(("truth", _)) => Some("truth".to_string()),
            Some(("identity", _)) => Some("identity".to_string()),
            Some(("noisy", NoiseKind::Barf)) => Some(format!("noise {}", noise.rotation)),
            Some(("noisy", NoiseKind::L2g)) if self.has_noise_of_scene() => Some("noise per scene".to_string()),
            Some(("noisy", NoiseKind::L2g)) => Some(format!("noise {}, {}", noise.rotation, noise.translation)),
            Some((path, _)) if path.ends_with(".json") => Some("file".to_string()),
            Some(_) => Some("colmap".to_string()),
        }
    }

    /// Where patches started, and what else an error in pixels hangs on where it is not as published.
    fn patches_name(&self) -> String {
        let (data, noise) = (&self.data, &self.noise);
        let mut name = format!("homography {}, translation {}", noise.homography, noise.translation);
        let published = data.image_size == ImageSize::Photo || data.image_size == ImageSize::Fixed([360, 480]);
        let others = [
            (!published || data.patch_crop != [180, 180], "another size"),
            (self.warp.dof != Dof::Homography, "a smaller group"),
            (data.perturbation != "drawn", "a file"),
        ];
        for (_, other) in others.into_iter().filter(|(is, _)| *is) {
            name += &format!(", {other}");
        }
        name
    }

    /// Whether poses are disturbed as much as the L2G-NeRF paper disturbed those of this scene.
    fn has_noise_of_scene(&self) -> bool {
        let of_paper = Layered::load("l2g-blender").map(|mut paper| {
            let path = self.scene.as_ref().map_or("", |s| s.path.as_str());
            paper.set_text("scene.path", path, Origin::Option("scene.path".into()));
            paper.settings.noise
        });
        of_paper.is_ok_and(|noise| noise == self.noise)
    }
}

/// `scan24`.
fn is_scan(name: &str) -> bool {
    name.strip_prefix("scan").is_some_and(|n| !n.is_empty() && n.chars().all(|c| c.is_ascii_digit()))
}

impl SceneSettings {
    /// The layout of the scene. The built-in one, and what cannot be read, is as good as a synthetic one.
    pub fn layout(&self) -> Layout {
        let found = || Layout::of(Path::new(&self.path)).unwrap_or(Layout::Blender);
        if self.path == "builtin" { Layout::Blender } else { Layout::from_name(&self.layout).unwrap_or_else(found) }
    }

    /// `poses`, with "auto" replaced by what it means for a scene of this layout: the identity for captures.
    pub fn poses_in(&self, layout: Layout) -> &str {
        match self.poses.as_str() {
            "auto" if layout.is_capture() => "identity",
            "auto" => "noisy",
            other => other,
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::config::Layered;

    #[test]
    fn names_of_presets_are_those_of_the_papers() {
        for (preset, method, start) in [
            ("barf-blender-original", "barf", Some("noise 0.15")),
            ("inn-llff-frozen-code", "inn-frozen-code", Some("identity")),
            ("nerf-gaussian-llff", "gaussian-reference", None),
            ("naive-blender", "naive", Some("noise per scene")),
            ("l2g-noglobal-blender", "l2g-noglobal", Some("noise per scene")),
            ("inn-llff", "inn", Some("identity")),
            ("nerf-blender", "reference", None),
            ("garf-llff", "garf", Some("identity")),
            ("planar-barf-original", "barf", Some("homography 0.1, translation 0.2")),
            ("planar-multi-inn", "multi-inn", Some("homography 0.1, translation 0.2")),
        ] {
            let settings = Layered::load(preset).unwrap().settings;
            assert_eq!((settings.method_name(), settings.start_name().as_deref()), (method, start), "{preset}");
        }
        let scene = |preset: &str, set: &str| {
            let mut layered = Layered::load(preset).unwrap();
            layered.set(set).unwrap();
            layered.settings.scene_name()
        };
        let mut other = Layered::load("l2g-blender").unwrap();
        other.set("noise.rotation=0.5").unwrap();
        assert_eq!(other.settings.start_name().as_deref(), Some("noise 0.5, 0.5"));
        let mut fixed = Layered::load("nerf-small").unwrap();
        fixed.set("scene.poses=noisy").unwrap();
        assert_eq!(fixed.settings.method_name(), "fixed");
        assert_eq!(scene("barf-blender", "scene.path=data/lego/"), "lego");
        assert_eq!(scene("inn-dtu", "scene.path=data/dtu_scan24"), "scan24");
        assert_eq!(scene("inn-dtu", "scene.path=kitchen_scan"), "kitchen_scan");
        assert_eq!(scene("planar-barf", "data.image=photos/cat.jpg"), "cat");
        let here = std::env::current_dir().unwrap();
        let here = here.file_name().unwrap().to_string_lossy();
        assert_eq!(scene("barf-blender", "scene.path=."), here);
        assert_eq!(scene("barf-blender", "scene.path=src/.."), here);
        let mut known = Layered::load("barf-blender").unwrap();
        known.set("scene.poses=truth").unwrap();
        assert_eq!(known.settings.start_name().as_deref(), Some("truth"));
    }
}
