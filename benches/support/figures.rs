//! Figures with their spread. A figure has a series with one value per run, the values of the baseline, and the ratio
//! for each run. This module also has figures of programs that ran at the same time, and cells of tables. It prints all
//! of them as tables, or with `--json` as one line each. In these lines, `SPREAD` is `{median, least, most}` or null:
//!
//! - `{class: "measurement", bench, name, unit, runs, hub: SPREAD, baseline: SPREAD, ratio: SPREAD, target, met}`
//! - the same line with more keys, for each program that ran at the same time as the hub: `sensors`, `program` (its
//!   name), and `difference` (hub minus program) and `quotient` (hub divided by program), each `{mean, error}`.
//!   `baseline` is the spread of this program, and `error` is the standard error of the mean, or null after one round.
//! - `{class: "cell", bench, table, row, column, value: SPREAD, unit}`

use serde_json::{Value, json};

/// A figure with one value per run.
pub(crate) struct Figure {
    pub(crate) name: &'static str,
    pub(crate) unit: &'static str,
    /// One value per run.
    pub(crate) hub: Vec<f64>,
    /// Values of the baseline, one per run. Empty if the figure has no baseline.
    pub(crate) baseline: Vec<f64>,
    pub(crate) target: Target,
}

/// A figure of programs that ran at the same time. The first program is the hub, and the second one is the baseline.
pub(crate) struct SimultaneousFigure {
    pub(crate) name: &'static str,
    pub(crate) unit: &'static str,
    /// One series for each program, with one value per round. A series is empty if the figure does not exist for the
    /// program.
    pub(crate) programs: Vec<Vec<f64>>,
    pub(crate) target: Target,
}

/// A cell of a table that compares several mechanisms or conditions. Tables, rows and columns are printed in the order
/// of their first cells.
#[derive(Clone, Debug)]
pub(crate) struct Cell {
    pub(crate) table: String,
    pub(crate) row: String,
    pub(crate) column: String,
    pub(crate) unit: &'static str,
    /// One value per run. Empty if the cell could not be measured.
    pub(crate) values: Vec<f64>,
}

/// Target of a figure.
#[derive(Clone, Copy)]
pub(crate) enum Target {
    /// No target.
    None,
    /// Maximum that the hub's median may have.
    Max(f64),
    /// Minimum that the hub's median must have.
    Min(f64),
    /// Maximum that the median of the ratios to the baseline may have.
    Ratio(f64),
}

/// Median, minimum and maximum of a series, in this order.
pub(crate) struct Spread(f64, f64, f64);

impl Spread {
    /// Returns the spread of `values`, which may have any order. Returns `None` if there are no values.
    pub(crate) fn of(values: &[f64]) -> Option<Spread> {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        Some(Spread(percentile(&sorted, 0.5)?, *sorted.first()?, *sorted.last()?))
    }

    /// Returns the text of the spread in tables.
    pub(crate) fn text(&self) -> String {
        let Spread(middle, minimum, maximum) = self;
        if minimum == maximum {
            return short_number(*middle);
        }
        format!("{} [{} .. {}]", short_number(*middle), short_number(*minimum), short_number(*maximum))
    }

    /// Returns the value of the spread in lines of JSON.
    pub(crate) fn json(&self) -> Value {
        json!({ "median": self.0, "least": self.1, "most": self.2 })
    }
}

impl Figure {
    fn ratios(&self) -> Vec<f64> {
        self.hub
            .iter()
            .zip(&self.baseline)
            .filter(|(_, baseline)| **baseline > 0.0)
            .map(|(hub, baseline)| hub / baseline)
            .collect()
    }

    /// Returns the spreads of the hub, of the baseline and of the ratios.
    fn spreads(&self) -> [Option<Spread>; 3] {
        [&self.hub, &self.baseline, &self.ratios()].map(|series| Spread::of(series))
    }

    /// Returns the figure as a line of JSON.
    fn json(&self, bench: &str) -> Value {
        let [hub, baseline, ratio] = self.spreads().map(|spread| spread.map(|spread| spread.json()));
        let verdict = self.verdict();
        json!({
            "class": "measurement", "bench": bench, "name": self.name, "unit": self.unit,
            "runs": self.hub.len(), "hub": hub, "baseline": baseline, "ratio": ratio,
            "target": verdict.as_ref().map(|(words, _)| words), "met": verdict.as_ref().map(|(_, is_met)| is_met),
        })
    }

    /// Returns the target and the result as text for tables.
    fn verdict_text(&self) -> String {
        self.verdict().map_or(String::new(), |(words, is_met)| {
            format!("{words}: {}", if is_met { "met" } else { "MISSED" })
        })
    }

    /// Returns the text of the target, and whether it is met.
    fn verdict(&self) -> Option<(String, bool)> {
        match self.target {
            Target::None => None,
            Target::Max(maximum) => Some((format!("<= {maximum}"), Spread::of(&self.hub)?.0 <= maximum)),
            Target::Min(minimum) => Some((format!(">= {minimum}"), Spread::of(&self.hub)?.0 >= minimum)),
            Target::Ratio(maximum) => {
                Some((format!("ratio <= {maximum}"), Spread::of(&self.ratios())?.0 <= maximum))
            }
        }
    }
}

/// Prints `figures` of `bench`.
pub(crate) fn print(bench: &str, json: bool, figures: &[Figure]) {
    if !json {
        println!("{:34} {:>30} {:>30} {:>22}  target", bench, "hub", "baseline", "ratio");
    }
    for figure in figures {
        if json {
            println!("{}", figure.json(bench));
        } else {
            let [hub, baseline, ratio] =
                figure.spreads().map(|spread| spread.map_or("-".into(), |spread| spread.text()));
            let verdict = figure.verdict_text();
            let name = format!("{}, {}", figure.name, figure.unit);
            println!("{name:34} {hub:>30} {baseline:>30} {ratio:>22}  {verdict}");
        }
    }
}

impl SimultaneousFigure {
    /// Returns the figure in which the program with the index `number` is the baseline. The figure has a target only if
    /// this is the second program, which is the usual baseline.
    fn against(&self, number: usize) -> Figure {
        Figure {
            name: self.name,
            unit: self.unit,
            hub: self.programs[0].clone(),
            baseline: self.programs[number].clone(),
            target: if number == 1 { self.target } else { Target::None },
        }
    }

    /// Returns the mean difference between the values of the hub and those of the program with the index `number`.
    fn difference(&self, number: usize) -> Option<Mean> {
        let pairs = self.programs[0].iter().zip(&self.programs[number]);
        Mean::of(&pairs.map(|(hub, program)| hub - program).collect::<Vec<_>>())
    }
}

/// Prints `figures` of programs that ran at the same time. `names` are the names of these programs.
pub(crate) fn print_simultaneous(
    bench: &str,
    sensors: usize,
    json: bool,
    names: &[&str],
    figures: &[SimultaneousFigure],
) {
    if !json {
        let title = format!("{bench}, sensors: {sensors}");
        println!("{title:42} {:>26} {:>20} {:>20}  target", "median", "hub minus it", "hub / it");
    }
    for figure in figures {
        if json {
            for (number, name) in names.iter().enumerate().skip(1) {
                let against = figure.against(number);
                let mut line = against.json(bench);
                line["sensors"] = json!(sensors);
                line["program"] = json!(name);
                line["difference"] = json!(figure.difference(number).map(|mean| mean.json()));
                line["quotient"] = json!(Mean::of(&against.ratios()).map(|mean| mean.json()));
                println!("{line}");
            }
            continue;
        }
        let title = format!("{}, {}", figure.name, figure.unit);
        println!("{}", format!("{title:113}{}", figure.against(1).verdict_text()).trim_end());
        for (number, (name, values)) in names.iter().zip(&figure.programs).enumerate() {
            let against = figure.against(number);
            let text = |mean: Option<Mean>| mean.map_or("-".into(), |mean| mean.text());
            let [difference, ratio] = match number {
                0 => [String::new(), String::new()],
                _ => [text(figure.difference(number)), text(Mean::of(&against.ratios()))],
            };
            let median = Spread::of(values).map_or("-".into(), |spread| spread.text());
            println!("  {name:40} {median:>26} {difference:>20} {ratio:>20}");
        }
    }
}

/// Mean of a series, and the standard error of the mean. The error is `None` for fewer than two values.
struct Mean(f64, Option<f64>);

impl Mean {
    /// Returns the mean of `values`, or `None` if there are no values.
    fn of(values: &[f64]) -> Option<Mean> {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let error = (values.len() > 1).then(|| (squares / (count - 1.0) / count).sqrt());
        (!values.is_empty()).then_some(Mean(mean, error))
    }

    fn text(&self) -> String {
        let error = self.1.map_or(String::new(), |error| format!(" +- {}", short_number(error)));
        format!("{}{error}", short_number(self.0))
    }

    fn json(&self) -> Value {
        json!({ "mean": self.0, "error": self.1 })
    }
}

/// Prints the tables of `bench`.
pub(crate) fn print_cells(bench: &str, json: bool, cells: &[Cell]) {
    if json {
        for Cell { table, row, column, unit, values } in cells {
            let value = Spread::of(values).map(|spread| spread.json());
            let line = json!({
                "class": "cell", "bench": bench, "table": table, "row": row, "column": column, "value": value, "unit": unit,
            });
            println!("{line}");
        }
        return;
    }
    for table in in_order_of_appearance(cells.iter().map(|cell| &cell.table)) {
        let cells: Vec<&Cell> = cells.iter().filter(|cell| cell.table == *table).collect();
        let columns = in_order_of_appearance(cells.iter().map(|cell| &cell.column));
        println!("{bench}: {table}");
        let heads = columns.iter().map(|column| format!(" {column:>26}"));
        println!("{:28}{}", "", heads.collect::<String>());
        for row in in_order_of_appearance(cells.iter().map(|cell| &cell.row)) {
            let text = |column: &&String| {
                let cell = cells.iter().find(|cell| cell.row == *row && cell.column == **column);
                let spread = cell.and_then(|cell| Some((Spread::of(&cell.values)?, cell.unit)));
                let text = spread.map_or("-".into(), |(spread, unit)| match unit {
                    "1" => spread.text(),
                    _ => format!("{} {unit}", spread.text()),
                });
                format!(" {text:>26}")
            };
            println!("{row:28}{}", columns.iter().map(text).collect::<String>());
        }
    }
}

/// Returns each name once, in the order in which the names first occur.
fn in_order_of_appearance<'a>(names: impl Iterator<Item = &'a String>) -> Vec<&'a String> {
    let mut found = Vec::new();
    for name in names {
        if !found.contains(&name) {
            found.push(name);
        }
    }
    found
}

/// Returns the percentile of the `sorted` values for the share `part` (0 to 1), by nearest rank. The median of an even
/// number of values is the mean of the two values in the middle.
pub(crate) fn percentile(sorted: &[f64], part: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    if part == 0.5 {
        return Some((sorted[last / 2] + sorted[last.div_ceil(2)]) / 2.0);
    }
    let rank = (part * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1).min(last)).copied()
}

fn short_number(value: f64) -> String {
    match value.abs() {
        size if size >= 100.0 || value == value.trunc() => format!("{value:.0}"),
        size if size >= 10.0 => format!("{value:.1}"),
        size if size >= 1.0 => format!("{value:.2}"),
        _ => format!("{value:.3}"),
    }
}
