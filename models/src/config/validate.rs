//! What single types cannot say about settings: ranges and values that must fit each other.

use super::error::ConfigError;
use super::layers::Layered;
use super::{Anneal, CodeKind, Count, DepthSettings, Dof, Encoding, FieldKind, ImageSize, Method, NoiseKind};
use crate::scene::{DtuSplit, Layout};

/// Widest layer and most bands a configuration may ask for: more is a typing error, not an experiment.
const MAX_WIDTH: usize = 4096;
const MAX_BANDS: usize = 20;
const MAX_BLOCKS: usize = 64;
const MAX_PATCHES: usize = 1000;
const MAX_SIDE: usize = 16384;
/// Most pixels along a side of a grid on which poses are fitted: all views' at once, in memory.
const MOST_FITTED: usize = 128;
/// Most cells along a side of a view's map of errors.
const MOST_CELLS: usize = 1024;
/// Most samples of a ray.
const MAX_SAMPLES: usize = 1024;

impl Layered {
    /// Checks every value that needs no other file.
    pub fn validate(&self) -> Result<(), ConfigError> {
        match &self.settings.scene {
            None => {
                self.data()?;
                self.plane()?;
            }
            Some(_) => self.space()?,
        }
        self.networks()?;
        self.invertible()?;
        self.numbers()?;
        self.loss()
    }

    fn data(&self) -> Result<(), ConfigError> {
        let d = &self.settings.data;
        self.at_least("data.patches", d.patches, 1)?;
        if d.patches > MAX_PATCHES {
            return Err(self.refuse("data.patches", format!("expected at most {MAX_PATCHES}, found {}", d.patches)));
        }
        if self.settings.noise.kind == NoiseKind::Barf && d.patches > 5 {
            let text = format!("the noise kind \"barf\" has shifts for at most 5 patches, found {}", d.patches);
            return Err(self.refuse("data.patches", text));
        }
        let [rows, columns] = d.patch_crop;
        if rows == 0 || columns == 0 || rows % 2 == 1 || columns % 2 == 1 {
            let text = format!("a patch has an even number of rows and columns, found {rows} x {columns}");
            return Err(self.refuse("data.patch_crop", text));
        }
        if let ImageSize::Fixed([h, w]) = d.image_size {
            if h == 0 || w == 0 || h > MAX_SIDE || w > MAX_SIDE {
                return Err(self
                    .refuse("data.image_size", format!("expected 1 to {MAX_SIDE} rows and columns, found {h} x {w}")));
            }
            self.check_crop([h, w])?;
        }
        if let Count::Of(n) = d.points_per_patch {
            // Four correspondences are the least that determine a homography.
            self.at_least("data.points_per_patch", n, 4)?;
        }
        Ok(())
    }

    fn space(&self) -> Result<(), ConfigError> {
        let s = &self.settings;
        let (Some(scene), Some(train), Some(radiance)) = (&s.scene, &s.train, &s.radiance) else {
            return Err(self.refuse("scene.path", "a 3D experiment has the sections scene, train and radiance"));
        };
        let [h, w] = scene.image_size;
        if h == 0 || w == 0 || h > MAX_SIDE || w > MAX_SIDE {
            let text = format!("expected 1 to {MAX_SIDE} rows and columns, found {h} x {w}");
            return Err(self.refuse("scene.image_size", text));
        }
        if scene.layout != "auto" && Layout::from_name(&scene.layout).is_none() {
            let known: Vec<&str> = Layout::ALL.iter().map(|l| l.name()).collect();
            let text = format!("expected \"auto\" or one of {}, found \"{}\"", known.join(", "), scene.layout);
            return Err(self.refuse("scene.layout", text));
        }
        if DtuSplit::from_name(&scene.dtu_split).is_none() {
            let known: Vec<&str> = DtuSplit::ALL.iter().map(|s| s.name()).collect();
            let text = format!("expected one of {}, found \"{}\"", known.join(", "), scene.dtu_split);
            return Err(self.refuse("scene.dtu_split", text));
        }
        if !(scene.focal >= 0.0 && scene.focal.is_finite()) {
            let text = format!("expected a focal length in pixels, or 0 for none, found {}", scene.focal);
            return Err(self.refuse("scene.focal", text));
        }
        self.at_least("train.rays", train.rays, 1)?;
        self.at_least("train.samples", train.samples, 2)?;
        if train.samples > MAX_SAMPLES {
            let text = format!("expected 2 to {MAX_SAMPLES} samples, found {}", train.samples);
            return Err(self.refuse("train.samples", text));
        }
        let [near, far] = train.range;
        let ordered = match train.depth {
            DepthSettings::Metric => 0.0 <= near && near < far && far.is_finite(),
            DepthSettings::Inverse => near > far && far >= 0.0 && near.is_finite(),
            DepthSettings::Auto | DepthSettings::Scene => true,
        };
        if !ordered {
            let rule = match train.depth {
                DepthSettings::Inverse => "[near, far] as inverse depths, near > far >= 0",
                _ => "[near, far] with 0 <= near < far",
            };
            return Err(self.refuse("train.range", format!("expected {rule}, found [{near}, {far}]")));
        }
        if train.samples + train.fine_samples > MAX_SAMPLES {
            let text = format!(
                "expected at most {MAX_SAMPLES} samples of a ray, found {} and {} more",
                train.samples, train.fine_samples
            );
            return Err(self.refuse("train.fine_samples", text));
        }
        if train.ndc && train.depth != DepthSettings::Metric {
            let text = "normalised device coordinates (`train.ndc`) have depths of their own: expected \"metric\"";
            return Err(self.refuse("train.depth", text));
        }
        if train.ndc && far > 1.0 {
            let text = format!(
                "depths in normalised device coordinates (`train.ndc`) go from 0, the near plane, to 1, infinity; \
                 found [{near}, {far}]"
            );
            return Err(self.refuse("train.range", text));
        }
        if train.shear && train.relocalise_every > 0 {
            let text = "cameras that turn against a shear (`train.shear`) cannot be put elsewhere: expected 0, found";
            return Err(self.refuse("train.relocalise_every", format!("{text} {}", train.relocalise_every)));
        }
        if train.error_map > MOST_CELLS {
            let text = format!("expected at most {MOST_CELLS} cells along a side, found {}", train.error_map);
            return Err(self.refuse("train.error_map", text));
        }
        if train.fit_grid > MOST_FITTED {
            let text = format!("expected at most {MOST_FITTED} pixels along a side, found {}", train.fit_grid);
            return Err(self.refuse("train.fit_grid", text));
        }
        if !train.validate_every.is_multiple_of(s.run.log_every.max(1)) {
            let (every, found) = (s.run.log_every, train.validate_every);
            let text = format!("expected a multiple of `run.log_every`, {every}, as it is logged; found {found}");
            return Err(self.refuse("train.validate_every", text));
        }
        if s.warp.method != Method::None && s.warp.dof != Dof::Pose {
            return Err(
                self.refuse("warp.dof", format!("a camera has 6 degrees of freedom, found {}", s.warp.dof.count()))
            );
        }
        if let Some(bad) = radiance.skip.iter().find(|k| **k == 0 || **k >= s.field.layers.len()) {
            let text = format!("layer {bad} cannot skip: expected 1 to {}", s.field.layers.len().saturating_sub(1));
            return Err(self.refuse("radiance.skip", text));
        }
        if radiance.color_layers.iter().any(|n| *n == 0 || *n > MAX_WIDTH) {
            let text = format!("expected layers 1 to {MAX_WIDTH} wide, found {:?}", radiance.color_layers);
            return Err(self.refuse("radiance.color_layers", text));
        }
        if radiance.view_bands > MAX_BANDS {
            let text = format!("expected at most {MAX_BANDS} bands, found {}", radiance.view_bands);
            return Err(self.refuse("radiance.view_bands", text));
        }
        if !(0.0..1.0).contains(&radiance.stop_below) {
            let text = format!("expected a share of the light, 0 or more and below 1, found {}", radiance.stop_below);
            return Err(self.refuse("radiance.stop_below", text));
        }
        if !(train.density_noise >= 0.0 && train.density_noise.is_finite()) {
            return Err(
                self.refuse("train.density_noise", format!("expected 0 or more, found {}", train.density_noise))
            );
        }
        Ok(())
    }

    /// The patches must fit into an image of `size` rows and columns.
    pub fn check_crop(&self, size: [usize; 2]) -> Result<(), ConfigError> {
        let crop = self.settings.data.patch_crop;
        if crop[0] > size[0] || crop[1] > size[1] {
            let text = format!(
                "a patch of {} x {} (rows x columns) is larger than the image of {} x {}",
                crop[0], crop[1], size[0], size[1]
            );
            return Err(self.refuse("data.patch_crop", text));
        }
        Ok(())
    }

    /// What registers cameras does not register patches of a picture.
    fn plane(&self) -> Result<(), ConfigError> {
        let warp = &self.settings.warp;
        if warp.dof == Dof::Pose {
            let text = "expected 1 (rotation), 2 (translation), 3 (rigid) or 8 (homography) for patches of a picture, \
                        found 6 (pose)";
            return Err(self.refuse("warp.dof", text));
        }
        if warp.method == Method::Se3Field {
            let text = "\"se3-field\" moves cameras in space; patches of a picture have \"global\", for example";
            return Err(self.refuse("warp.method", text));
        }
        Ok(())
    }

    fn networks(&self) -> Result<(), ConfigError> {
        let (warp, field) = (&self.settings.warp, &self.settings.field);
        for (key, layers) in [("warp.layers", &warp.layers), ("field.layers", &field.layers)] {
            if layers.is_empty() || layers.iter().any(|n| *n == 0 || *n > MAX_WIDTH) {
                let text = format!("expected at least one hidden layer, each 1 to {MAX_WIDTH} wide, found {layers:?}");
                return Err(self.refuse(key, text));
            }
        }
        if let Some(bad) = warp.skip.iter().find(|s| **s == 0 || **s > warp.layers.len()) {
            let text =
                format!("layer {bad} cannot skip: expected 1 to {}, the layers after the first", warp.layers.len());
            return Err(self.refuse("warp.skip", text));
        }
        let coded = [Method::Local, Method::Mlp, Method::ImplicitMlp, Method::Se3Field].contains(&warp.method);
        if (coded && warp.code == 0) || warp.code > MAX_WIDTH {
            return Err(self.refuse("warp.code", format!("expected 1 to {MAX_WIDTH} channels, found {}", warp.code)));
        }
        if warp.output_scale.iter().any(|x| !(*x > 0.0 && x.is_finite())) {
            let text = format!("expected two factors above 0, found {:?}", warp.output_scale);
            return Err(self.refuse("warp.output_scale", text));
        }
        if !warp.origin.iter().all(|x| x.is_finite()) {
            return Err(self.refuse("warp.origin", format!("expected a point, found {:?}", warp.origin)));
        }
        if warp.bands > MAX_BANDS {
            return Err(self.refuse("warp.bands", format!("expected 0 to {MAX_BANDS} bands, found {}", warp.bands)));
        }
        for (kind, key, value) in
            [(FieldKind::Gaussian, "field.sigma", field.sigma), (FieldKind::Siren, "field.omega", field.omega)]
        {
            if field.kind == kind && !(value > 0.0 && value.is_finite()) {
                return Err(self.refuse(key, format!("expected a number above 0, found {value}")));
            }
        }
        if field.encoding != Encoding::None && (field.bands == 0 || field.bands > MAX_BANDS) {
            return Err(self.refuse("field.bands", format!("expected 1 to {MAX_BANDS} bands, found {}", field.bands)));
        }
        let [start, end] = field.window;
        if !(0.0 <= start && start < end && end <= 1.0) {
            let text = format!("expected [start, end] with 0 <= start < end <= 1, found [{start}, {end}]");
            return Err(self.refuse("field.window", text));
        }
        Ok(())
    }

    fn invertible(&self) -> Result<(), ConfigError> {
        let (warp, inn) = (&self.settings.warp, &self.settings.warp.inn);
        if !matches!(warp.method, Method::Invertible | Method::MultiInvertible) {
            return Ok(());
        }
        for (key, value, most) in [("blocks", inn.blocks, MAX_BLOCKS), ("hidden", inn.hidden, MAX_WIDTH)] {
            if value == 0 || value > most {
                return Err(self.refuse(&format!("warp.inn.{key}"), format!("expected 1 to {most}, found {value}")));
            }
        }
        if inn.anneal != Anneal::None {
            self.at_least("warp.inn.anneal_steps", inn.anneal_steps, 1)?;
        }
        let shared = warp.method == Method::Invertible;
        if shared && inn.code == CodeKind::Posenc && (warp.code < 2 || warp.code % 2 == 1) {
            let text = format!(
                "the code \"posenc\" is pairs of sine and cosine: expected an even number, found {}",
                warp.code
            );
            return Err(self.refuse("warp.code", text));
        }
        let code_moves = shared && inn.train_code && inn.code != CodeKind::Posenc && warp.code > 0;
        if !inn.train_network && !code_moves {
            let text = "nothing of the warp is trained: expected true, or codes that are";
            return Err(self.refuse("warp.inn.train_network", text));
        }
        Ok(())
    }

    fn numbers(&self) -> Result<(), ConfigError> {
        let (optim, noise, run) = (&self.settings.optim, &self.settings.noise, &self.settings.run);
        let rates = [
            ("optim.lr", optim.lr),
            ("optim.lr_end", optim.lr_end),
            ("optim.lr_warp", optim.lr_warp),
            ("optim.lr_warp_end", optim.lr_warp_end),
        ];
        for (key, value) in rates {
            if !(value > 0.0 && value.is_finite()) {
                return Err(self.refuse(key, format!("expected a learning rate above 0, found {value}")));
            }
        }
        let deviations = [
            ("noise.homography", noise.homography),
            ("noise.rotation", noise.rotation),
            ("noise.translation", noise.translation),
        ];
        for (key, value) in deviations {
            if !(value >= 0.0 && value.is_finite()) {
                return Err(self.refuse(key, format!("expected 0 or more, found {value}")));
            }
        }
        self.at_least("optim.steps", optim.steps, 1)?;
        if optim.steps > 1 << 24 {
            return Err(self.refuse("optim.steps", format!("expected at most {}, found {}", 1 << 24, optim.steps)));
        }
        self.at_least("run.log_every", run.log_every, 1)
    }

    fn loss(&self) -> Result<(), ConfigError> {
        let loss = &self.settings.loss;
        for (key, weight) in [("loss.alignment", loss.alignment), ("loss.cycle", loss.cycle)] {
            if !(weight >= 0.0 && weight.is_finite()) {
                return Err(self.refuse(key, format!("expected a weight of 0 or more, found {weight}")));
            }
        }
        Ok(())
    }

    fn at_least(&self, key: &str, value: usize, least: usize) -> Result<(), ConfigError> {
        if value >= least { Ok(()) } else { Err(self.refuse(key, format!("expected {least} or more, found {value}"))) }
    }
}
