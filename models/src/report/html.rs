//! The page: headline numbers, pictures, plots, numbers per patch, settings.

use super::plots::{Curve, PlotError, plot};
use crate::evaluation::{Evaluation, Metric, Stage};
use crate::pictures::patch_color;
use crate::run::metrics::{Entry, Measured, Metrics};
use base64::{Engine, prelude::BASE64_STANDARD};
use std::fmt::Write;

/// A PNG with its caption.
#[derive(Clone, Debug)]
pub struct Picture<'a> {
    pub title: &'a str,
    pub caption: &'a str,
    pub png: &'a [u8],
}

/// What the page shows.
#[derive(Clone, Debug)]
pub struct Report<'a> {
    pub title: &'a str,
    pub device: &'a str,
    pub metrics: &'a Metrics,
    pub evaluation: &'a Evaluation,
    pub pictures: Vec<Picture<'a>>,
    /// Drawings (SVG), after their captions.
    pub drawings: Vec<(&'a str, &'a str)>,
    /// The resolved settings.
    pub config: &'a str,
}

const STYLE: &str = "
:root{color-scheme:light}
body{font:16px/1.6 system-ui,-apple-system,'Segoe UI',Roboto,sans-serif;color:#1c1e21;background:#f6f7f9;margin:0}
main{max-width:1080px;margin:0 auto;padding:2.5rem 1.5rem 4rem}
h1{font-size:1.9rem;line-height:1.2;margin:0 0 .2rem;letter-spacing:-.01em}
h2{font-size:1.15rem;margin:2.6rem 0 .8rem}
.note{color:#9a3412}
.sub{color:#5c6470;margin:0 0 1.6rem}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(150px,1fr));gap:.9rem}
.card,figure,table,pre{background:#fff;border:1px solid #e3e6ea;border-radius:10px}
.card{padding:.9rem 1.1rem}
.card b{display:block;font-size:1.55rem;font-weight:650;font-variant-numeric:tabular-nums}
.card span{color:#5c6470;font-size:.86rem}
.grid{display:grid;grid-template-columns:repeat(auto-fit,minmax(440px,1fr));gap:1rem}
figure{margin:0;padding:.9rem}
figure img,figure svg{width:100%;height:auto;display:block;border-radius:4px}
figcaption{color:#5c6470;font-size:.9rem;margin-top:.6rem}
figcaption b{color:#1c1e21}
table{border-collapse:separate;border-spacing:0;font-variant-numeric:tabular-nums}
th,td{padding:.45rem 1.2rem;text-align:right}
th{color:#5c6470;font-weight:500;font-size:.86rem}
td+td,th+th{border-left:1px solid #eef0f3}
.dot{display:inline-block;width:.75em;height:.75em;border-radius:50%;margin-right:.45em;box-shadow:inset 0 0 0 1px #0003}
pre{padding:1rem 1.2rem;overflow:auto;font:13px/1.5 ui-monospace,Menlo,Consolas,monospace}
";

impl Report<'_> {
    /// The whole page.
    pub fn to_html(&self) -> Result<String, PlotError> {
        let mut page = String::new();
        let title = escape(self.title);
        // Writing to a string cannot fail.
        let _ = write!(
            page,
            "<!doctype html><html lang=en><head><meta charset=utf-8>\
             <meta name=viewport content=\"width=device-width,initial-scale=1\"><title>{title}</title>\
             <style>{STYLE}</style></head><body><main><h1>{title}</h1><p class=sub>{} · raygrad {}</p>",
            escape(self.device),
            env!("CARGO_PKG_VERSION")
        );
        page.push_str(&self.headline());
        page.push_str("<h2>Pictures</h2><div class=grid>");
        for p in &self.pictures {
            let data = BASE64_STANDARD.encode(p.png);
            let (title, caption) = (escape(p.title), escape(p.caption));
            let _ = write!(
                page,
                "<figure><img alt=\"{title}\" src=\"data:image/png;base64,{data}\">\
                 <figcaption><b>{title}.</b> {caption}</figcaption></figure>"
            );
        }
        for (caption, svg) in &self.drawings {
            let _ = write!(page, "<figure>{svg}<figcaption>{caption}</figcaption></figure>");
        }
        page.push_str("</div><h2>Training</h2><div class=grid>");
        for (caption, svg) in self.plots()? {
            let _ = write!(page, "<figure>{svg}<figcaption>{caption}</figcaption></figure>");
        }
        page.push_str("</div>");
        page.push_str(&self.patches());
        let _ = writeln!(page, "<h2>Settings</h2><pre>{}</pre></main></body></html>", escape(self.config));
        Ok(page)
    }

    fn headline(&self) -> String {
        let Some(last) = &self.metrics.last else { return String::new() };
        let mut cards: Vec<(String, String)> = vec![];
        for metric in Metric::ALL {
            let shown = |value: f64| format!("{value:.*}", metric.decimals());
            let of_cameras = self.evaluation.cameras.mean.get(metric);
            cards.extend(of_cameras.map(|v| (shown(v), metric.heading().to_string())));
            for (stage, when) in [(Stage::Before, "test views"), (Stage::After, "test views, refined")] {
                let of_views = self.evaluation.stage(stage).and_then(|m| m.mean.get(metric));
                cards.extend(of_views.map(|v| (shown(v), format!("{}, {when}", metric.heading()))));
            }
        }
        if matches!(last.entry.measured, Measured::Space { .. }) {
            cards.push((format!("{:.2}", last.entry.psnr_db()), "PSNR (dB), last training pixels".into()));
        }
        cards.extend([(duration(last.seconds), "time".into()), (last.entry.step.to_string(), "steps".into())]);
        let cards =
            cards.iter().map(|(value, what)| format!("<div class=card><b>{value}</b><span>{what}</span></div>"));
        let notes = self.evaluation.notes();
        let notes = notes.iter().map(|note| format!("<p class=note>Note: {}.</p>", escape(note)));
        format!("<div class=cards>{}</div>{}", cards.collect::<String>(), notes.collect::<String>())
    }

    fn plots(&self) -> Result<Vec<(&'static str, String)>, PlotError> {
        let steps = &self.metrics.steps;
        let curve = |label: &str, color, width, value: &dyn Fn(&Entry) -> Option<f64>| Curve {
            label: label.to_string(),
            color,
            width,
            points: steps.iter().filter_map(|e| Some((e.step as f64, value(e)?))).collect(),
        };
        let palette = [[0x1c, 0x1e, 0x21], [0x25, 0x63, 0xeb], [0xd9, 0x48, 0x0f], [0x2b, 0x8a, 0x3e]];
        let terms = ["total", "render", "alignment", "penalty"].into_iter().zip(palette);
        // Without a second term the sum is the first.
        let summed = steps.iter().any(|e| e.loss.get("total") != e.loss.get("render"));
        let losses: Vec<Curve> = terms
            .filter(|(name, _)| summed || *name != "total")
            .map(|(name, color)| curve(name, color, 2, &|e| e.loss.get(name).copied()))
            .filter(|c| !c.points.is_empty())
            .collect();
        let mut psnr = vec![curve("PSNR", palette[1], 2, &|e| Some(e.psnr_db()))];
        let validation = curve("validation view", palette[2], 2, &Entry::validation_psnr_db);
        psnr.extend((!validation.points.is_empty()).then_some(validation));
        let mut plots = vec![
            ("Loss terms before weighting, and their weighted sum.", plot("loss", &losses, true)?),
            ("PSNR of the rendered pixels.", plot("dB", &psnr, false)?),
        ];
        let patches = steps.first().and_then(Entry::corners).map_or(0, |c| c.per_patch.len());
        let of_patch = |i: usize| move |e: &Entry| e.corners()?.per_patch.get(i).copied();
        let mut corners: Vec<Curve> = (0..patches)
            .map(|i| curve(&format!("patch {i}"), patch_color(i), 1, &of_patch(i)))
            .filter(|c| c.points.iter().any(|p| p.1 > 1e-3))
            .collect();
        if patches > 0 {
            corners.push(curve("mean", palette[0], 3, &|e| Some(e.corners()?.mean)));
            let caption = "Distance between estimated and true patch corners.";
            plots.push((caption, plot("corner error, px", &corners, true)?));
        }
        type Value = fn(&Entry) -> Option<f64>;
        let errors: [(&str, &str, Value); 2] = [
            ("Rotation error of the training views, after alignment.", "degrees", |e| match e.measured {
                Measured::Space { rotation_error_deg, .. } => rotation_error_deg,
                Measured::Planar { .. } => None,
            }),
            ("Translation error of the training views, times 100.", "x 100", |e| match e.measured {
                Measured::Space { translation_error_x100, .. } => translation_error_x100,
                Measured::Planar { .. } => None,
            }),
        ];
        for (caption, what, value) in errors {
            let error = [curve(what, palette[2], 2, &value)];
            if !error[0].points.is_empty() {
                plots.push((caption, plot(what, &error, true)?));
            }
        }
        Ok(plots)
    }

    fn patches(&self) -> String {
        let Some(corners) = self.metrics.last.as_ref().and_then(|last| last.entry.corners()) else {
            return String::new();
        };
        let (mut head, mut row) = (String::new(), String::new());
        for (i, error) in corners.per_patch.iter().enumerate() {
            let [r, g, b] = patch_color(i);
            let _ = write!(head, "<th><span class=dot style=\"background:rgb({r},{g},{b})\"></span>patch {i}</th>");
            let _ = write!(row, "<td>{error:.3} px</td>");
        }
        format!("<h2>Corner errors</h2><table><tr>{head}</tr><tr>{row}</tr></table>")
    }
}

/// The middle one of some numbers, of two the larger; 0 of none.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

/// 75 seconds as `1:15 min`.
pub fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        ..60 => format!("{seconds:.1} s"),
        60..7200 => format!("{}:{:02} min", whole / 60, whole % 60),
        _ => format!("{}:{:02} h", whole / 3600, whole / 60 % 60),
    }
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
