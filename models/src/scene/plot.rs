//! A plot of a scene's cameras, a pyramid each, from above and from the side.

use super::{Scene, View};
use crate::geometry::Pose;
use crate::pictures::{Canvas, PictureError};
use crate::report::PlotError;
use nalgebra::Vector3;
use plotters::prelude::*;

const TRAIN: [u8; 3] = [0x1f, 0x6f, 0xeb];
const TEST: [u8; 3] = [0xe6, 0x7e, 0x22];
const MARK: [u8; 3] = [0x9a, 0xa1, 0xab];
/// Width and height of one half of the plot, and the space around the cameras in it, in pixels.
const HALF: u32 = 480;
const MARGIN: f64 = 36.0;

/// A straight line in the plot, in pixels.
struct Line {
    ends: [[f64; 2]; 2],
    color: [u8; 3],
}

/// An SVG of the cameras: from above on the left, from the side on the right.
pub fn svg(scene: &Scene) -> Result<String, PlotError> {
    let mut text = String::new();
    draw(&mut text, scene).map_err(|e| PlotError::new("the cameras", &e.to_string()))?;
    Ok(text)
}

fn draw(text: &mut String, scene: &Scene) -> Result<(), Box<dyn std::error::Error>> {
    let root = SVGBackend::with_string(text, (2 * HALF, HALF)).into_drawing_area();
    root.fill(&WHITE)?;
    for line in lines(scene) {
        let [r, g, b] = line.color;
        let ends = line.ends.map(|[x, y]| (x.round() as i32, y.round() as i32));
        root.draw(&PathElement::new(ends, RGBColor(r, g, b).stroke_width(1)))?;
    }
    let label = ("system-ui, sans-serif", 14).into_font();
    for (x, what) in [(12, "from above"), (HALF as i32 + 12, "from the side")] {
        root.draw(&Text::new(what, (x, 10), label.clone()))?;
    }
    root.present()?;
    Ok(())
}

/// The same plot as a PNG, without words.
pub fn png(scene: &Scene) -> Result<Vec<u8>, PictureError> {
    let mut canvas = Canvas::new(2 * HALF as usize, HALF as usize, [255; 3]);
    for line in lines(scene) {
        canvas.line(line.ends[0], line.ends[1], 1.2, line.color);
    }
    canvas.to_png()
}

fn lines(scene: &Scene) -> Vec<Line> {
    let posed = |views: &[View], color: [u8; 3]| -> Vec<(Pose, f64, f64, [u8; 3])> {
        let one = |v: &View| {
            let c = &v.intrinsics;
            Some((v.pose?, c.width as f64 / (2.0 * c.fx), c.height as f64 / (2.0 * c.fy), color))
        };
        views.iter().filter_map(one).collect()
    };
    let cameras = [posed(&scene.test, TEST), posed(&scene.train, TRAIN)].concat();
    let centers: Vec<Vector3<f64>> = cameras.iter().map(|c| c.0.center()).collect();
    let up = up(&cameras.iter().map(|c| c.0).collect::<Vec<_>>());
    let right = up.cross(&least_along(&up)).normalize();
    let ahead = up.cross(&right);
    let origin = Vector3::zeros();
    let reach = |p: &Vector3<f64>| right.dot(p).abs().max(ahead.dot(p).abs()).max(up.dot(p).abs());
    // The origin is in the middle, so that rings of cameras look round.
    let extent = centers.iter().map(reach).fold(0.0, f64::max).max(1e-9);
    let size = 0.12 * extent;
    let scale = (f64::from(HALF) / 2.0 - MARGIN) / (extent + size);
    let middle = f64::from(HALF) / 2.0;
    let place = |half: usize, p: &Vector3<f64>| {
        let vertical = if half == 0 { ahead.dot(p) } else { up.dot(p) };
        [middle + scale * right.dot(p) + f64::from(HALF) * half as f64, middle - scale * vertical]
    };
    let mut lines = vec![];
    for half in 0..2 {
        let mut line = |a: &Vector3<f64>, b: &Vector3<f64>, color| {
            lines.push(Line { ends: [place(half, a), place(half, b)], color });
        };
        for axis in [right, ahead, up] {
            line(&(origin - size * axis), &(origin + size * axis), MARK);
        }
        for (pose, x, y, color) in &cameras {
            let corner = |sx: f64, sy: f64| pose.inverse().apply(&(size * Vector3::new(sx * x, sy * y, 1.0)));
            let corners = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
            for (i, c) in corners.iter().enumerate() {
                line(&pose.center(), c, *color);
                line(c, &corners[(i + 1) % 4], *color);
            }
        }
    }
    lines
}

/// The cameras' mean up direction, straightened to the nearest axis of the world; z where there is none.
fn up(poses: &[Pose]) -> Vector3<f64> {
    let mean: Vector3<f64> = poses.iter().map(|p| -p.rotation.row(1).transpose()).sum();
    if poses.is_empty() || mean.norm() < 1e-9 {
        return Vector3::z();
    }
    let axis = mean.iamax();
    let mut up = Vector3::zeros();
    up[axis] = mean[axis].signum();
    up
}

/// An axis of the world across `up`.
fn least_along(up: &Vector3<f64>) -> Vector3<f64> {
    let mut axis = Vector3::zeros();
    axis[up.iamin()] = 1.0;
    axis
}
