//! Cameras as a drawing (SVG): frusta of predicted and reference poses, and lines between matching centres.
//!
//! The views are those of the published plots: a full circle of cameras from 45 degrees above at an azimuth of 35,
//! forward-facing ones from behind (x right, y down) and from above (x right, z up the page).

use super::align::{PoseSetError, check_poses};
use crate::geometry::Pose;
use nalgebra::Vector3;
use plotters::prelude::*;

/// What the cameras look at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraLayout {
    /// All around an object (Blender, DTU): one view a panel.
    Orbit,
    /// All in about one direction (LLFF): two views a panel.
    ForwardFacing,
}

/// One state of the cameras, say before or after optimisation.
#[derive(Clone, Debug)]
pub struct CameraPanel {
    pub title: String,
    /// Poses aligned to the reference.
    pub predicted: Vec<Pose>,
    /// As many, or none.
    pub reference: Vec<Pose>,
}

#[derive(Debug, thiserror::Error)]
pub enum CameraPlotError {
    #[error(transparent)]
    Poses(#[from] PoseSetError),
    #[error("cannot draw the cameras: {0}")]
    Draw(String),
}

/// A direction to look from, as matplotlib names it: elevation and azimuth in degrees.
struct View {
    name: &'static str,
    elevation: f64,
    azimuth: f64,
}

const ORBIT: [View; 1] = [View { name: "", elevation: 45.0, azimuth: 35.0 }];
const FORWARD: [View; 2] = [
    View { name: "forward-facing", elevation: -90.0, azimuth: -90.0 },
    View { name: "top-down", elevation: 0.0, azimuth: -90.0 },
];

impl View {
    /// Where a point comes to on the page.
    fn project(&self, p: &Vector3<f64>) -> (f64, f64) {
        let ((se, ce), (sa, ca)) = (self.elevation.to_radians().sin_cos(), self.azimuth.to_radians().sin_cos());
        (-sa * p.x + ca * p.y, -se * ca * p.x - se * sa * p.y + ce * p.z)
    }
}

const SIDE: u32 = 520;
const PREDICTED: RGBColor = RGBColor(0, 153, 179);
const REFERENCE: RGBColor = RGBColor(179, 51, 179);
const LINK: RGBColor = RGBColor(255, 0, 0);
const FONT: &str = "system-ui, sans-serif";

/// An SVG with a row for each panel.
///
/// # Errors
/// If a panel has no poses, something that is none, or another number of reference poses.
pub fn camera_plot(layout: CameraLayout, panels: &[CameraPanel]) -> Result<String, CameraPlotError> {
    for panel in panels {
        check_poses("predicted", &panel.predicted)?;
        if !panel.reference.is_empty() {
            super::align::check_pairs(&panel.predicted, &panel.reference)?;
        }
    }
    if panels.is_empty() {
        return Err(PoseSetError::Empty.into());
    }
    let (views, depth, least): (&[View], f64, f64) = match layout {
        CameraLayout::Orbit => (&ORBIT, 0.5, 3.0),
        CameraLayout::ForwardFacing => (&FORWARD, 0.2, 1.0),
    };
    // The published limits, or more where the cameras need it; one scale for all panels, so that they compare.
    let poses = panels.iter().flat_map(|p| p.predicted.iter().chain(&p.reference));
    let reach = poses.map(|p| p.center().norm() + 1.3 * depth).fold(least, f64::max);
    let mut svg = String::new();
    draw(&mut svg, views, panels, depth, reach).map_err(|e| CameraPlotError::Draw(e.to_string()))?;
    Ok(svg)
}

type Drawn = Result<(), Box<dyn std::error::Error>>;

fn draw(svg: &mut String, views: &[View], panels: &[CameraPanel], depth: f64, reach: f64) -> Drawn {
    let size = (SIDE * views.len() as u32, SIDE * panels.len() as u32);
    let root = SVGBackend::with_string(svg, size).into_drawing_area();
    root.fill(&WHITE)?;
    let areas = root.split_evenly((panels.len(), views.len()));
    let places = panels.iter().flat_map(|p| views.iter().map(move |v| (p, v)));
    for (area, (panel, view)) in areas.iter().zip(places) {
        let title = if view.name.is_empty() { panel.title.clone() } else { format!("{}, {}", panel.title, view.name) };
        let mut builder = ChartBuilder::on(area);
        builder.margin(12).caption(title, (FONT, 15));
        let mut chart = builder.build_cartesian_2d(-reach..reach, -reach..reach)?;
        let frusta = |poses: &[Pose], color: RGBColor| -> Vec<PathElement<(f64, f64)>> {
            let lines = poses.iter().flat_map(|p| frustum(p, depth));
            lines.map(|l| PathElement::new(l.map(|x| view.project(&x)), color.stroke_width(1))).collect()
        };
        let pairs = panel.predicted.iter().zip(&panel.reference);
        let link =
            |(a, b): (&Pose, &Pose)| PathElement::new([a, b].map(|p| view.project(&p.center())), LINK.stroke_width(2));
        chart.draw_series(pairs.map(link))?;
        chart.draw_series(frusta(&panel.reference, REFERENCE))?;
        chart.draw_series(frusta(&panel.predicted, PREDICTED))?;
    }
    root.present()?;
    Ok(())
}

/// The eight edges of the pyramid from a camera's centre to its image plane.
fn frustum(pose: &Pose, depth: f64) -> Vec<[Vector3<f64>; 2]> {
    let world = pose.inverse();
    let corners = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)];
    let corners = corners.map(|(x, y)| world.apply(&(Vector3::new(x, y, 1.0) * depth)));
    let around = (0..4).map(|i| [corners[i], corners[(i + 1) % 4]]);
    around.chain(corners.map(|c| [world.translation, c])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_of_the_published_plots() {
        let p = Vector3::new(0.3, 0.5, -0.7);
        let near = |(a, b): (f64, f64), (c, d): (f64, f64)| (a - c).abs() < 1e-12 && (b - d).abs() < 1e-12;
        assert!(near(FORWARD[0].project(&p), (0.3, -0.5)), "x right, y down");
        assert!(near(FORWARD[1].project(&p), (0.3, -0.7)), "x right, z up");
        // The z axis points up the page, shortened by the elevation.
        assert!(near(ORBIT[0].project(&Vector3::z()), (0.0, 0.5f64.sqrt())));
    }

    #[test]
    fn panels_hold_a_frustum_for_every_camera() {
        let poses: Vec<Pose> = (0..3).map(|i| Pose::exp(&[0.1, 0.2 * f64::from(i), 0.0, 0.0, 0.0, 4.0])).collect();
        let panel = |title: &str, reference: &[Pose]| CameraPanel {
            title: title.into(),
            predicted: poses.clone(),
            reference: reference.to_vec(),
        };
        let count = |svg: &str| svg.matches("<polyline").count();
        let alone = camera_plot(CameraLayout::Orbit, &[panel("before", &[])]).unwrap();
        assert_eq!(count(&alone), 3 * 8);
        let both = [panel("before", &poses), panel("after", &poses)];
        let svg = camera_plot(CameraLayout::ForwardFacing, &both).unwrap();
        assert_eq!(count(&svg), 2 * 2 * (3 * 8 * 2 + 3));
        assert!(svg.contains("after, top-down"));
    }

    #[test]
    fn nothing_to_draw_is_refused() {
        assert!(camera_plot(CameraLayout::Orbit, &[]).is_err());
        let mut broken = Pose::identity();
        broken.translation.x = f64::INFINITY;
        let panel = |predicted: Vec<Pose>, reference| CameraPanel { title: "x".into(), predicted, reference };
        assert!(camera_plot(CameraLayout::Orbit, &[panel(vec![broken], vec![])]).is_err());
        let one = Pose::identity();
        assert!(camera_plot(CameraLayout::Orbit, &[panel(vec![one], vec![one, one])]).is_err());
    }
}
