//! Curves over training, drawn as SVG.

use plotters::prelude::*;

/// One line of a plot.
#[derive(Clone, Debug)]
pub struct Curve {
    pub label: String,
    pub color: [u8; 3],
    /// Width of the line.
    pub width: u32,
    /// (step, value) pairs.
    pub points: Vec<(f64, f64)>,
}

/// A plot that could not be drawn.
#[derive(Debug, thiserror::Error)]
#[error("cannot draw the plot of {what}: {problem}")]
pub struct PlotError {
    what: String,
    problem: String,
}

impl PlotError {
    pub(crate) fn new(what: &str, problem: &str) -> PlotError {
        PlotError { what: what.to_string(), problem: problem.to_string() }
    }
}

const SIZE: (u32, u32) = (640, 340);
const GRID: RGBColor = RGBColor(0xe8, 0xea, 0xee);
const AXIS: RGBColor = RGBColor(0x9a, 0xa1, 0xab);
const FONT: &str = "system-ui, sans-serif";

/// An SVG of the curves, with a logarithmic vertical axis if asked for and possible.
pub fn plot(what: &str, curves: &[Curve], logarithmic: bool) -> Result<String, PlotError> {
    let values: Vec<f64> = curves.iter().flat_map(|c| &c.points).map(|p| p.1).filter(|v| v.is_finite()).collect();
    let positive = values.iter().copied().filter(|v| *v > 0.0).fold(f64::INFINITY, f64::min);
    let (low, high) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
    let last = curves.iter().flat_map(|c| &c.points).map(|p| p.0).fold(1.0, f64::max);
    let mut svg = String::new();
    let drawn = if values.is_empty() {
        Ok(())
    } else if logarithmic && positive.is_finite() && high > 10.0 * positive {
        draw(&mut svg, what, curves, last, (positive * 0.8, high * 1.25), true)
    } else {
        let margin = ((high - low) * 0.05).max(1e-9);
        draw(&mut svg, what, curves, last, (low - margin, high + margin), false)
    };
    drawn.map_err(|e| PlotError::new(what, &e.to_string()))?;
    Ok(svg)
}

type Drawn = Result<(), Box<dyn std::error::Error>>;

fn draw(svg: &mut String, what: &str, curves: &[Curve], last: f64, (low, high): (f64, f64), log: bool) -> Drawn {
    let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let mut builder = ChartBuilder::on(&root);
    builder.margin(12).x_label_area_size(38).y_label_area_size(66);
    // The two kinds of axes are different types, so these lines cannot be shared as a function.
    macro_rules! lines {
        ($chart:expr) => {{
            let mut chart = $chart;
            let mut mesh = chart.configure_mesh();
            mesh.label_style((FONT, 13)).light_line_style(WHITE).bold_line_style(GRID).axis_style(AXIS);
            mesh.x_label_formatter(&|x| format!("{x:.0}")).y_label_formatter(&|y| number(*y));
            mesh.x_desc("step").y_desc(what).draw()?;
            for curve in curves {
                let style = style(curve);
                let points = curve.points.iter().copied().map(|(x, y)| (x, y.max(low)));
                let drawn = chart.draw_series(LineSeries::new(points, style))?;
                // A single curve is named by its axis.
                if curves.len() > 1 {
                    drawn.label(&curve.label).legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], style));
                }
            }
            if curves.len() > 1 {
                let height = |y: f64| if log { (y / low).ln() / (high / low).ln() } else { (y - low) / (high - low) };
                let mut labels = chart.configure_series_labels();
                labels.position(corner(curves, last, height)).label_font((FONT, 13));
                labels.background_style(WHITE.mix(0.85)).draw()?;
            }
        }};
    }
    if log {
        lines!(builder.build_cartesian_2d(0.0..last, (low..high).log_scale())?);
    } else {
        lines!(builder.build_cartesian_2d(0.0..last, low..high)?);
    }
    root.present()?;
    Ok(())
}

/// The corner of a plot where the fewest points lie under the labels of its curves. `height`: of a value, from 0 to 1.
fn corner(curves: &[Curve], last: f64, height: impl Fn(f64) -> f64) -> SeriesLabelPosition {
    use SeriesLabelPosition::{LowerLeft, LowerRight, UpperLeft, UpperRight};
    // About a quarter of the width, and a line of text for each curve.
    let (wide, tall) = (0.25, 0.06 * curves.len() as f64 + 0.04);
    let under = |right: bool, upper: bool| {
        let points = curves.iter().flat_map(|c| &c.points).map(|(x, y)| (x / last, height(*y)));
        let inside = points.filter(|(x, y)| {
            (if right { *x > 1.0 - wide } else { *x < wide }) && (if upper { *y > 1.0 - tall } else { *y < tall })
        });
        inside.count()
    };
    let corners =
        [(UpperRight, true, true), (LowerRight, true, false), (UpperLeft, false, true), (LowerLeft, false, false)];
    let least = corners.into_iter().min_by_key(|(_, right, upper)| under(*right, *upper));
    least.map_or(UpperRight, |(position, ..)| position)
}

fn style(curve: &Curve) -> ShapeStyle {
    let [r, g, b] = curve.color;
    RGBColor(r, g, b).stroke_width(curve.width)
}

/// A number on an axis: short, without trailing zeros.
fn number(y: f64) -> String {
    match y.abs() {
        a if a != 0.0 && !(1e-3..1e5).contains(&a) => format!("{y:.0e}"),
        a if a < 1.0 => format!("{}", (y * 1e5).round() / 1e5),
        _ => format!("{}", (y * 100.0).round() / 100.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_lie_where_curves_do_not() {
        let curve = |slope: f64| {
            let points = (0..=100).map(|i| (f64::from(i), 50.0 + slope * f64::from(i - 50))).collect();
            Curve { label: "a".into(), color: [0; 3], width: 2, points }
        };
        let of = |curves: &[Curve]| corner(curves, 100.0, |y| y / 100.0);
        assert!(matches!(of(&[curve(1.0), curve(0.9)]), SeriesLabelPosition::LowerRight));
        assert!(matches!(of(&[curve(-1.0), curve(-0.9)]), SeriesLabelPosition::UpperRight));
        let flat = |y: f64| Curve { points: vec![(100.0, y), (90.0, y)], ..curve(0.0) };
        assert!(matches!(of(&[flat(0.0), flat(100.0), curve(0.0)]), SeriesLabelPosition::UpperLeft));
    }

    #[test]
    fn plots_of_anything_finite_or_not() {
        let curve = |points: Vec<(f64, f64)>| Curve { label: "a".into(), color: [0; 3], width: 2, points };
        let cases = [vec![], vec![(1.0, 0.0)], vec![(1.0, 0.5), (2.0, 0.01)], vec![(1.0, f64::NAN), (2.0, 1.0)]];
        for points in cases {
            for logarithmic in [false, true] {
                let svg = plot("loss", &[curve(points.clone()), curve(vec![])], logarithmic).unwrap();
                assert!(points.is_empty() || svg.starts_with("<svg"));
            }
        }
    }
}
