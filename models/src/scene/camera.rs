//! The cameras of camera files in JSON: at the top, or in a frame, where they win.

use super::check::same_shape;
use super::{Intrinsics, SceneError, json};
use serde::Deserialize;
use std::path::Path;

/// Every field apart from the frames' others, so that errors of types name the field.
#[derive(Clone, Deserialize)]
struct Camera {
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

#[derive(Deserialize)]
struct Frames {
    frames: Vec<Camera>,
}

/// The cameras of a file.
pub(super) struct Cameras<'a> {
    path: &'a Path,
    file: Camera,
    frames: Vec<Camera>,
}

const KNOWN: [&str; 6] = ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "perspective"];

impl Cameras<'_> {
    pub fn read(path: &Path) -> Result<Cameras<'_>, SceneError> {
        let Frames { frames } = json::read(path)?;
        Ok(Cameras { path, file: json::read(path)?, frames })
    }

    /// The camera of a frame, for an image of a size, which may differ from the size that the file speaks of.
    pub fn intrinsics(&self, i: usize, [height, width]: [usize; 2]) -> Result<Intrinsics, SceneError> {
        let (own, file) = (&self.frames[i], &self.file);
        let refuse = |field: &str, in_frame: bool, expected: &str, found: String| {
            let field = if in_frame { format!("frames[{i}].{field}") } else { field.to_string() };
            Err(SceneError::Field { path: self.path.into(), field, expected: expected.into(), found })
        };
        // What a frame says, else what the file says, and whether a frame says it.
        let either = |of: &dyn Fn(&Camera) -> Option<f64>| of(own).map_or((of(file), false), |x| (Some(x), true));
        for (camera, in_frame) in [(own, true), (file, false)] {
            if let Some(model) = camera.camera_model.as_deref().filter(|m| !KNOWN.contains(m)) {
                return refuse("camera_model", in_frame, &format!("one of {}", KNOWN.join(", ")), model.into());
            }
            if camera.is_fisheye == Some(true) {
                return refuse("is_fisheye", in_frame, "false, fisheye lenses being none of the models", "true".into());
            }
        }
        let ((w, w_own), (h, h_own)) = (either(&|c| c.w), either(&|c| c.h));
        let (columns, rows) = (width as f64, height as f64);
        let w = w.or(h.map(|h| (h * columns / rows).round())).unwrap_or(columns);
        let h = h.unwrap_or((w * rows / columns).round());
        for (field, value, own) in [("w", w, w_own), ("h", h, h_own)] {
            if !(1.0..1e6).contains(&value) {
                return refuse(field, own, "a number of pixels", value.to_string());
            }
        }
        if !same_shape([h as usize, w as usize], [height, width]) {
            let expected = format!("the size of the image, {height} x {width}, or that resized");
            return refuse("w", w_own, &expected, format!("h x w of {h} x {w}"));
        }
        let angles = [either(&|c| c.camera_angle_x), either(&|c| c.camera_angle_y)];
        for (field, (angle, own)) in ["camera_angle_x", "camera_angle_y"].into_iter().zip(angles) {
            if let Some(angle) = angle.filter(|a| !(*a > 0.0 && *a < std::f64::consts::PI)) {
                return refuse(field, own, "an angle in radians between 0 and pi", angle.to_string());
            }
        }
        let focal = |(angle, _): (Option<f64>, bool), size: f64| angle.map(|a| 0.5 * size / (0.5 * a).tan());
        let (by_angle, by_angle_y) = (focal(angles[0], w), focal(angles[1], h));
        let ((fl_x, x_own), (fl_y, y_own)) = (either(&|c| c.fl_x), either(&|c| c.fl_y));
        let Some(fx) = fl_x.or(by_angle) else {
            return refuse("fl_x", false, "a focal length in pixels, or `camera_angle_x`", "neither".into());
        };
        // Focal lengths in pixels win over angles, on both axes.
        let fy = fl_y.or(by_angle_y.filter(|_| fl_x.is_none())).unwrap_or(fx);
        let name = if fl_x.is_some() { ("fl_x", x_own) } else { ("camera_angle_x", angles[0].1) };
        for ((field, own), value) in [(name, fx), (("fl_y", y_own), fy)] {
            if !(value > 0.0 && value < 1e9) {
                return refuse(field, own, "a positive focal length below 1e9 pixels", value.to_string());
            }
        }
        let ((cx, cx_own), (cy, cy_own)) = (either(&|c| c.cx), either(&|c| c.cy));
        let (cx, cy) = (cx.unwrap_or(w / 2.0), cy.unwrap_or(h / 2.0));
        for (field, value, most, own) in [("cx", cx, w, cx_own), ("cy", cy, h, cy_own)] {
            if !(value > 0.0 && value < most) {
                return refuse(field, own, &format!("a place inside the image, 0 to {most}"), value.to_string());
            }
        }
        for (field, (value, own)) in [("k3", either(&|c| c.k3)), ("k4", either(&|c| c.k4))] {
            if let Some(k) = value.filter(|k| *k != 0.0) {
                return refuse(field, own, "0, the model having k1, k2, p1 and p2 only", k.to_string());
            }
        }
        let lens = [either(&|c| c.k1), either(&|c| c.k2), either(&|c| c.p1), either(&|c| c.p2)];
        let lens = lens.map(|(k, _)| k.unwrap_or_default());
        let distortion = Some(lens).filter(|d| d.iter().any(|k| *k != 0.0));
        let camera = Intrinsics { fx, fy, cx, cy, height: h as usize, width: w as usize, distortion };
        Ok(camera.resized(height, width))
    }
}
