//! Figures with their spread: a series of values, one per run, next to those of the baseline, with the ratio run by
//! run; or cells of tables. They are printed as tables, or with `--json` as one line each (`SPREAD` is `{median, least,
//! most}` or null):
//!
//! - `{class: "measurement", bench, name, unit, runs, hub: SPREAD, baseline: SPREAD, ratio: SPREAD, target, met}`
//! - `{class: "cell", bench, table, row, column, value: SPREAD, unit}`

use serde_json::{Value, json};

/// A figure with one value per run.
pub(crate) struct Figure {
    pub(crate) name: &'static str,
    pub(crate) unit: &'static str,
    /// One value per run.
    pub(crate) hub: Vec<f64>,
    /// One value per run of the baseline; empty if the figure has none.
    pub(crate) baseline: Vec<f64>,
    pub(crate) target: Target,
}

/// A cell of a table of several mechanisms or conditions. Tables, rows and columns are printed in order of appearance.
#[derive(Clone, Debug)]
pub(crate) struct Cell {
    pub(crate) table: String,
    pub(crate) row: String,
    pub(crate) column: String,
    pub(crate) unit: &'static str,
    /// One value per run; empty if it could not be measured.
    pub(crate) values: Vec<f64>,
}

/// Target of a figure.
#[derive(Clone, Copy)]
pub(crate) enum Target {
    /// No target.
    None,
    /// Maximum of the hub's median.
    Most(f64),
    /// Minimum of the hub's median.
    Least(f64),
    /// Maximum of the median of the ratios.
    Ratio(f64),
}

/// Median, minimum and maximum of a series.
pub(crate) struct Spread(f64, f64, f64);

impl Spread {
    /// Returns the spread of `values`, in any order; `None` if there are none.
    pub(crate) fn of(values: &[f64]) -> Option<Spread> {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        Some(Spread(percentile(&sorted, 0.5)?, *sorted.first()?, *sorted.last()?))
    }

    /// Returns the spread as it is in tables.
    pub(crate) fn text(&self) -> String {
        let Spread(middle, least, most) = self;
        if least == most {
            return short(*middle);
        }
        format!("{} [{} .. {}]", short(*middle), short(*least), short(*most))
    }

    /// Returns the spread as it is in lines of JSON.
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

    /// Returns the target as text, and whether it was met.
    fn verdict(&self) -> Option<(String, bool)> {
        match self.target {
            Target::None => None,
            Target::Most(most) => Some((format!("<= {most}"), Spread::of(&self.hub)?.0 <= most)),
            Target::Least(least) => Some((format!(">= {least}"), Spread::of(&self.hub)?.0 >= least)),
            Target::Ratio(most) => Some((format!("ratio <= {most}"), Spread::of(&self.ratios())?.0 <= most)),
        }
    }
}

/// Prints `figures` of `bench`.
pub(crate) fn print(bench: &str, json: bool, figures: &[Figure]) {
    if !json {
        println!("{:34} {:>30} {:>30} {:>22}  target", bench, "hub", "baseline", "ratio");
    }
    for figure in figures {
        let spreads = [&figure.hub, &figure.baseline, &figure.ratios()].map(|series| Spread::of(series));
        let verdict = figure.verdict();
        if json {
            let [hub, baseline, ratio] = spreads.map(|spread| spread.map(|spread| spread.json()));
            let line = json!({
                "class": "measurement", "bench": bench, "name": figure.name, "unit": figure.unit,
                "runs": figure.hub.len(), "hub": hub, "baseline": baseline, "ratio": ratio,
                "target": verdict.as_ref().map(|(words, _)| words), "met": verdict.as_ref().map(|(_, met)| met),
            });
            println!("{line}");
        } else {
            let [hub, baseline, ratio] =
                spreads.map(|spread| spread.map_or("-".into(), |spread| spread.text()));
            let verdict = verdict.map_or(String::new(), |(words, met)| {
                format!("{words}: {}", if met { "met" } else { "MISSED" })
            });
            let name = format!("{}, {}", figure.name, figure.unit);
            println!("{name:34} {hub:>30} {baseline:>30} {ratio:>22}  {verdict}");
        }
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
    for table in appearing(cells.iter().map(|cell| &cell.table)) {
        let cells: Vec<&Cell> = cells.iter().filter(|cell| cell.table == *table).collect();
        let columns = appearing(cells.iter().map(|cell| &cell.column));
        println!("{bench}: {table}");
        let heads = columns.iter().map(|column| format!(" {column:>26}"));
        println!("{:28}{}", "", heads.collect::<String>());
        for row in appearing(cells.iter().map(|cell| &cell.row)) {
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

/// Returns each name once, in order of appearance.
fn appearing<'a>(names: impl Iterator<Item = &'a String>) -> Vec<&'a String> {
    let mut found = Vec::new();
    for name in names {
        if !found.contains(&name) {
            found.push(name);
        }
    }
    found
}

/// Returns the value below which `part` of the `sorted` values lie: nearest rank, and for the median the mean of the
/// middle two.
pub(crate) fn percentile(sorted: &[f64], part: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    if part == 0.5 {
        return Some((sorted[last / 2] + sorted[last.div_ceil(2)]) / 2.0);
    }
    let rank = (part * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1).min(last)).copied()
}

fn short(value: f64) -> String {
    match value.abs() {
        size if size >= 100.0 || value == value.trunc() => format!("{value:.0}"),
        size if size >= 10.0 => format!("{value:.1}"),
        size if size >= 1.0 => format!("{value:.2}"),
        _ => format!("{value:.3}"),
    }
}
