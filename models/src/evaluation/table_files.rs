//! Tables as text for a terminal, CSV, LaTeX and JSON.

use super::scores::{Evaluation, Measured, Metric, Scores, Stage};
use super::table::{Cell, Row, Table};
use std::fmt::Write;

/// Below a table with such rows.
const NOTE: &str = "* quoted, not verified against the paper";

impl Table {
    /// For a terminal.
    pub fn to_text(&self) -> String {
        let mut lines = vec![self.head(["", "method"])];
        let rows = self.rows();
        let mut last = String::new();
        for row in &rows {
            let heading = row.heading();
            let shown = if heading == last { String::new() } else { heading.clone() };
            last = heading;
            let cells = row.cells().map(|v| number(row.metric, v));
            lines.push([shown, row.label()].into_iter().chain(cells).collect());
        }
        let mut out = if self.title.is_empty() { String::new() } else { format!("{}\n", self.title) };
        out += &aligned(&lines);
        if rows.iter().any(|r| !r.verified) {
            out += &format!("{NOTE}\n");
        }
        self.notes().iter().for_each(|note| out += &format!("{note}\n"));
        out
    }

    /// What is to be said of runs, once for all seeds.
    fn notes(&self) -> Vec<String> {
        let mut notes: Vec<String> = vec![];
        for run in &self.evaluations {
            let of_run = run.notes().into_iter().map(|note| format!("{} on {}: {note}", run.method, run.scene));
            let new: Vec<String> = of_run.filter(|n| !notes.contains(n)).collect();
            notes.extend(new);
        }
        notes.extend(self.fewer_runs());
        notes
    }

    /// Comma-separated, with a head line. Where any cell is of several runs, each column is followed by its spread.
    pub fn to_csv(&self) -> String {
        let rows = self.rows();
        let spreads = rows.iter().flat_map(Row::cells).flatten().any(|c| c.spread.is_some());
        let first = ["metric", "stage", "method", "source", "verified"];
        let head = self.head(first).into_iter().enumerate().flat_map(|(i, name)| {
            let spread = (spreads && i >= first.len()).then(|| format!("{name} spread"));
            [Some(name), spread].into_iter().flatten()
        });
        let mut out = csv_line(&head.collect::<Vec<String>>());
        for row in rows {
            let stage = row.stage.map_or("", Stage::name).to_string();
            let source = row.source.clone().unwrap_or_else(|| "ours".into());
            let head = [row.metric.key().to_string(), stage, row.method.clone(), source, row.verified.to_string()];
            let cells = row.cells().flat_map(|c| {
                let text = |v: Option<f64>| v.map(|v| v.to_string()).unwrap_or_default();
                let both = [text(c.map(|c| c.mean)), text(c.and_then(|c| c.spread))];
                both.into_iter().take(if spreads { 2 } else { 1 })
            });
            out += &csv_line(&head.into_iter().chain(cells).collect::<Vec<String>>());
        }
        out
    }

    /// Every view of our runs, comma-separated: scene, method, stage (`cameras`, `before`, `after`), view, metrics.
    pub fn views_csv(&self) -> String {
        let metrics = Metric::ALL.iter().map(|m| m.key().to_string());
        let head = ["scene", "method", "stage", "view"].map(String::from);
        let mut out = csv_line(&head.into_iter().chain(metrics).collect::<Vec<String>>());
        let mut line = |run: &Evaluation, stage: &str, view: &str, scores: &Scores| {
            let head = [run.scene.as_str(), run.method.as_str(), stage, view].map(String::from);
            let values = Metric::ALL.iter().map(|m| scores.get(*m).map(|v| v.to_string()).unwrap_or_default());
            out += &csv_line(&head.into_iter().chain(values).collect::<Vec<String>>());
        };
        for run in &self.evaluations {
            let stages =
                [("cameras", Some(&run.cameras)), ("before", run.before.as_ref()), ("after", run.after.as_ref())];
            let present: Vec<(&str, &Measured)> = stages.into_iter().filter_map(|(n, m)| Some((n, m?))).collect();
            for (stage, measured) in present.into_iter().filter(|(_, m)| !m.views.is_empty()) {
                measured.views.iter().for_each(|v| line(run, stage, &v.view, &v.scores));
                line(run, stage, "mean", &measured.mean);
            }
        }
        out
    }

    /// A LaTeX `tabular`, the best of each group and column bold, of those that find the poses.
    pub fn to_latex(&self) -> String {
        let rows = self.rows();
        let columns = "r".repeat(self.scenes().len() + 1);
        let mut out = format!("\\begin{{tabular}}{{ll{columns}}}\n\\hline\n");
        let head = self.head(["", "method"]);
        out += &format!("{} \\\\\n", head.iter().map(|h| latex(h)).collect::<Vec<String>>().join(" & "));
        let mut last = String::new();
        for row in &rows {
            let heading = row.heading();
            let first = heading != last;
            if first {
                out += "\\hline\n";
            }
            // Who is given the poses does not compete.
            let given = ["reference", "gaussian-reference", "fixed"];
            let competes = |r: &Row| !given.contains(&r.method.as_str()) && !r.method.starts_with("nerf-");
            let group: Vec<&Row> =
                rows.iter().filter(|r| (r.metric, r.stage) == (row.metric, row.stage) && competes(r)).collect();
            let cells = row.cells().enumerate().map(|(i, v)| {
                let text = number(row.metric, v).replace('±', "$\\pm$");
                // A mean over scenes competes with those over the same ones.
                let comparable = |r: &Row| i < r.values.len() || r.values.iter().all(Option::is_some);
                let group = group.iter().filter(|r| comparable(r)).map(|r| r.cells().nth(i).flatten());
                if competes(row) && comparable(row) && is_best(row.metric, v, group) {
                    format!("\\textbf{{{text}}}")
                } else {
                    text
                }
            });
            let cells: Vec<String> = cells.collect();
            let shown = if first { latex(&heading) } else { String::new() };
            let _ = writeln!(out, "{shown} & {} & {} \\\\", latex(&row.label()), cells.join(" & "));
            last = heading;
        }
        out += "\\hline\n\\end{tabular}\n";
        if rows.iter().any(|r| !r.verified) {
            out += &format!("% {NOTE}\n");
        }
        self.notes().iter().for_each(|note| out += &format!("% {note}\n"));
        out
    }

    /// Title, runs with every view, and the papers' tables; reads back with serde.
    pub fn to_json(&self) -> String {
        // Numbers, strings and lists always have a JSON form.
        serde_json::to_string_pretty(self).unwrap_or_default()
    }

    fn head<const N: usize>(&self, first: [&str; N]) -> Vec<String> {
        first.map(String::from).into_iter().chain(self.scenes()).chain(["mean".to_string()]).collect()
    }
}

fn is_best(metric: Metric, value: Option<Cell>, group: impl Iterator<Item = Option<Cell>>) -> bool {
    let group: Vec<f64> = group.flatten().map(|c| c.mean).collect();
    let best = if metric.lower_is_better() { f64::min } else { f64::max };
    group.len() > 1 && value.is_some() && value.map(|c| c.mean) == group.into_iter().reduce(best)
}

/// "0.123", or "0.123 ± 0.010" over several runs.
fn number(metric: Metric, cell: Option<Cell>) -> String {
    let shown = |v: f64| format!("{v:.*}", metric.decimals());
    match cell {
        None => "-".into(),
        Some(Cell { mean, spread: None }) => shown(mean),
        Some(Cell { mean, spread: Some(spread) }) => format!("{} ± {}", shown(mean), shown(spread)),
    }
}

/// Columns two spaces apart; the first two to the left, numbers to the right.
fn aligned(lines: &[Vec<String>]) -> String {
    let columns = lines.iter().map(Vec::len).max().unwrap_or(0);
    let width = |i: usize| lines.iter().filter_map(|l| l.get(i)).map(|c| c.chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut out = String::new();
    for line in lines {
        let cells = line.iter().enumerate().map(|(i, cell)| match i {
            0 | 1 => format!("{cell:<0$}", widths[i]),
            _ => format!("{cell:>0$}", widths[i]),
        });
        let _ = writeln!(out, "{}", cells.collect::<Vec<String>>().join("  ").trim_end());
    }
    out
}

fn csv_line(fields: &[String]) -> String {
    let quoted = |f: &String| {
        if f.contains([',', '"', '\n', '\r']) { format!("\"{}\"", f.replace('"', "\"\"")) } else { f.clone() }
    };
    format!("{}\n", fields.iter().map(quoted).collect::<Vec<String>>().join(","))
}

/// Text with the characters LaTeX takes for commands made plain.
fn latex(text: &str) -> String {
    let plain = |c: char| match c {
        '\\' => "\\textbackslash{}".to_string(),
        '~' => "\\textasciitilde{}".to_string(),
        '^' => "\\textasciicircum{}".to_string(),
        '&' | '%' | '$' | '#' | '_' | '{' | '}' => format!("\\{c}"),
        other => other.to_string(),
    };
    text.chars().map(plain).collect()
}

#[cfg(test)]
mod tests {
    use super::super::published::{PublishedRow, PublishedTable, published_of};
    use super::super::scores::ViewScores;
    use super::*;

    fn run(scene: &str, method: &str, degrees: f64, psnr: [f64; 2]) -> Evaluation {
        let view = |view: &str, scores| ViewScores { view: view.into(), scores };
        let camera = Scores { rotation_error_deg: Some(degrees), ..Scores::default() };
        let picture = |psnr_db| Scores { psnr_db: Some(psnr_db), ..Scores::default() };
        Evaluation {
            undetermined: false,
            common_turn_deg: None,
            lens: None,
            scene: scene.into(),
            method: method.into(),
            cameras: Measured::new(vec![view("cam, 1", camera)]),
            before: Some(Measured::new(psnr.map(|p| view("t", picture(p))).to_vec())),
            after: None,
        }
    }

    fn table() -> Table {
        let row = |metric, stage, method: &str, verified, values: [f64; 2]| PublishedRow {
            metric,
            stage,
            method: method.into(),
            verified,
            mean: (values[0] + values[1]) / 2.0,
            spread: None,
            values: values.to_vec(),
        };
        let published = PublishedTable {
            paper: "P".into(),
            table: "T".into(),
            dataset: "d".into(),
            start: "identity".into(),
            scenes: vec!["fern".into(), "other".into()],
            rows: vec![row(Metric::RotationErrorDeg, None, "barf", false, [0.125, 7.0])],
        };
        Table {
            title: "two scenes".into(),
            evaluations: vec![run("fern", "l2g", 0.25, [20.0, 22.0]), run("a_b", "l2g", 0.75, [30.0, 31.0])],
            published: vec![published],
        }
    }

    #[test]
    fn text_has_scenes_as_columns_and_means() {
        let expected = "two scenes\n\
                                         method         fern    a_b   mean\n\
                        rotation (deg)     l2g           0.250  0.750  0.500\n\
                                           barf [P, T] * 0.125      -      -\n";
        let squeeze =
            |s: &str| s.lines().map(|l| l.split_whitespace().collect::<Vec<_>>().join(" ")).collect::<Vec<_>>();
        let text = table().to_text();
        assert_eq!(squeeze(&text)[..4], squeeze(expected)[..4], "{text}");
        assert!(text.contains("PSNR (dB), before") && text.contains("21.00  30.50  25.75"), "{text}");
        assert!(text.ends_with(&format!("{NOTE}\n")));
        let lines: Vec<&str> = text.lines().skip(1).take(3).collect();
        assert!(lines.iter().all(|l| l.len() == lines[0].len()), "columns do not line up:\n{text}");
    }

    #[test]
    fn csv_quotes_and_latex_escapes() {
        let csv = table().to_csv();
        assert!(csv.starts_with("metric,stage,method,source,verified,fern,a_b,mean\n"), "{csv}");
        assert!(csv.contains("rotation_error_deg,,barf,\"P, T\",false,0.125,,\n"), "{csv}");
        let views = table().views_csv();
        assert!(views.contains("fern,l2g,cameras,\"cam, 1\",0.25,,,,,,,,,,,,,\n"), "{views}");
        assert!(views.contains("fern,l2g,before,mean,,,21,,,,,,,,,,,\n"), "{views}");
        let latex = table().to_latex();
        assert!(latex.contains("a\\_b") && latex.contains("\\textbf{0.125}"), "{latex}");
        assert!(latex.starts_with("\\begin{tabular}{llrrr}\n") && latex.contains("\\end{tabular}"), "{latex}");
    }

    #[test]
    fn an_alignment_that_is_not_determined_is_told_once() {
        let one = Evaluation { undetermined: true, ..run("fern", "l2g", 0.25, [20.0; 2]) };
        let table = Table { evaluations: vec![one.clone(), one, run("a_b", "l2g", 0.5, [20.0; 2])], ..table() };
        for text in [table.to_text(), table.to_latex()] {
            let told = text.lines().filter(|l| l.contains("lie in one point or on one line"));
            let told: Vec<&str> = told.map(|l| l.trim_start_matches("% ")).collect();
            assert!(told.len() == 1 && told[0].starts_with("l2g on fern: "), "{text}");
        }
        assert_eq!(serde_json::from_str::<Table>(&table.to_json()).unwrap(), table);
    }

    /// A method that lacks a scene or a run does not win by that.
    #[test]
    fn means_over_other_scenes_do_not_compete() {
        let runs = [("fern", "l2g", 0.25), ("fern", "l2g", 0.35), ("a_b", "l2g", 0.75), ("fern", "inn", 0.5)];
        let evaluations = runs.map(|(scene, method, degrees)| run(scene, method, degrees, [20.0; 2])).to_vec();
        let table = Table { evaluations, ..table() };
        let rows = table.rows();
        let mean = |method: &str| rows.iter().find(|r| r.method == method).unwrap().mean.map(|c| c.mean);
        assert_eq!((mean("l2g"), mean("inn"), mean("barf")), (Some(0.525), None, None));
        // A mean over all scenes of a paper is none over these.
        let mut whole = table.published[0].clone();
        whole.scenes.clear();
        let row = |values: &[f64]| PublishedRow { values: values.to_vec(), mean: 0.01, ..whole.rows[0].clone() };
        let rows = vec![row(&[])];
        let mut both = Table { published: vec![PublishedTable { rows, ..whole.clone() }], ..table.clone() };
        both.evaluations.extend(["fern", "a_b"].map(|scene| run(scene, "mlp", 0.9, [20.0; 2])));
        let latex = both.to_latex();
        assert!(latex.contains("\\textbf{0.525}") && latex.contains("& 0.010"), "{latex}");
        let latex = table.to_latex();
        assert!(!latex.contains("\\textbf{0.525}"), "nothing compares with it: {latex}");
        for text in [table.to_text(), latex] {
            for note in ["l2g on a_b: 1 of 2 runs", "inn on fern: 1 of 2 runs", "inn on a_b: 0 of 2 runs"] {
                assert!(text.contains(note), "{text}");
            }
        }
        assert_eq!(
            super::super::Table { evaluations: table.evaluations[..2].to_vec(), ..table.clone() }.fewer_runs(),
            [""; 0]
        );
        let mut planar = table.evaluations[..2].to_vec();
        (planar[0].cameras.mean.success, planar[1].cameras.mean.success) = (Some(1.0), Some(0.0));
        let rows = Table { evaluations: planar, ..table }.rows();
        let success = rows.iter().find(|r| r.metric == Metric::Success).unwrap().values[0].unwrap();
        assert_eq!((success.mean, success.spread), (0.5, None));
    }

    #[test]
    fn several_runs_make_a_mean_and_a_spread() {
        let runs = [0.25, 0.5, 0.75].map(|degrees| run("fern", "l2g", degrees, [20.0; 2]));
        let table = Table { evaluations: runs.to_vec(), ..table() };
        let text = table.to_text();
        assert!(text.contains("0.500 ± 0.250  0.500 ± 0.250") && text.contains("0.125"), "{text}");
        let csv = table.to_csv();
        assert!(csv.starts_with("metric,stage,method,source,verified,fern,fern spread,mean,mean spread\n"), "{csv}");
        assert!(csv.contains("rotation_error_deg,,l2g,ours,true,0.5,0.25,0.5,0.25\n"), "{csv}");
        assert!(csv.contains("rotation_error_deg,,barf,\"P, T\",false,0.125,,0.125,\n"), "{csv}");
        assert!(table.to_latex().contains("0.500 $\\pm$ 0.250"), "{}", table.to_latex());
    }

    #[test]
    fn json_reads_back_and_has_the_fields() {
        let json = table().to_json();
        assert_eq!(serde_json::from_str::<Table>(&json).unwrap(), table());
        let value: serde_json::Value = serde_json::from_str(&json).unwrap();
        assert_eq!(value["evaluations"][0]["before"]["mean"]["psnr_db"], 21.0);
        assert_eq!(value["evaluations"][0]["before"]["views"][1]["psnr_db"], 22.0);
        assert_eq!(value["evaluations"][1]["cameras"]["mean"]["rotation_error_deg"], 0.75);
    }

    #[test]
    fn papers_alone_make_a_table_and_nothing_makes_an_empty_one() {
        let papers = Table { published: published_of("llff"), ..Table::default() };
        assert_eq!(papers.scenes()[0], "fern");
        let text = papers.to_text();
        assert!(text.contains("inn [INN, Supplement, Table 7]") && text.contains("0.310"), "{text}");
        // Of a table of eight scenes, two are shown: the mean is theirs.
        let ours = Table { evaluations: vec![run("fern", "l2g", 0.2, [20.0; 2])], ..papers };
        let row = ours.rows().into_iter().find(|r| r.method == "inn" && r.metric == Metric::RotationErrorDeg).unwrap();
        let cell = Some(Cell { mean: 0.19, spread: None });
        assert_eq!((row.values, row.mean), (vec![cell], cell));
        assert_eq!(Table::default().rows(), []);
        assert_eq!(Table::default().to_text(), "  method  mean\n");
    }
}
