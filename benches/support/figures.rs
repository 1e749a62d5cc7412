//! Figures with their spread: a series per run, beside that of the floor, and the ratio run by run; or cells of tables.
//! Printed as a table for people or as a line of JSON each. Says whether a target was met; refuses to fail because of it.
//!
//! The lines, from which the tables of benches/README.md are made (`SPREAD` is `{median, least, most}` or null; further
//! keys may stand in any of them):
//! `{class: "measurement", bench, name, unit, runs, hub: SPREAD, floor: SPREAD, ratio: SPREAD, target, met}`
//! `{class: "cell", bench, table, row, column, value: SPREAD, unit}`

use serde_json::{Value, json};

/// What was measured under one name.
pub(crate) struct Figure {
    pub(crate) name: &'static str,
    pub(crate) unit: &'static str,
    /// One value per run.
    pub(crate) hub: Vec<f64>,
    /// One value per run of the floor; empty if the figure has none.
    pub(crate) floor: Vec<f64>,
    pub(crate) target: Target,
}

/// A place in a table of several mechanisms or conditions. Tables, rows and columns stand in order of appearance.
#[derive(Clone, Debug)]
pub(crate) struct Cell {
    pub(crate) table: String,
    pub(crate) row: String,
    pub(crate) column: String,
    pub(crate) unit: &'static str,
    /// One value per run; none where nothing could be measured.
    pub(crate) values: Vec<f64>,
}

/// What a figure should be.
#[derive(Clone, Copy)]
pub(crate) enum Target {
    /// Whatever it is.
    None,
    /// The hub's median at most so.
    Most(f64),
    /// The hub's median at least so.
    Least(f64),
    /// The median of the ratios at most so.
    Ratio(f64),
}

/// The middle, the least and the greatest of a series.
struct Spread(f64, f64, f64);

impl Spread {
    fn of(values: &[f64]) -> Option<Spread> {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        Some(Spread(percentile(&sorted, 0.5)?, *sorted.first()?, *sorted.last()?))
    }

    fn text(&self) -> String {
        let Spread(middle, least, most) = self;
        if least == most {
            return short(*middle);
        }
        format!("{} [{} .. {}]", short(*middle), short(*least), short(*most))
    }

    fn json(&self) -> Value {
        json!({ "median": self.0, "least": self.1, "most": self.2 })
    }
}

impl Figure {
    fn ratios(&self) -> Vec<f64> {
        self.hub
            .iter()
            .zip(&self.floor)
            .filter(|(_, floor)| **floor > 0.0)
            .map(|(hub, floor)| hub / floor)
            .collect()
    }

    /// The target in words, and whether it was met.
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
        println!("{:34} {:>30} {:>30} {:>22}  target", bench, "hub", "floor", "ratio");
    }
    for figure in figures {
        let spreads = [&figure.hub, &figure.floor, &figure.ratios()].map(|series| Spread::of(series));
        let verdict = figure.verdict();
        if json {
            let [hub, floor, ratio] = spreads.map(|spread| spread.map(|spread| spread.json()));
            let line = json!({
                "class": "measurement", "bench": bench, "name": figure.name, "unit": figure.unit,
                "runs": figure.hub.len(), "hub": hub, "floor": floor, "ratio": ratio,
                "target": verdict.as_ref().map(|(words, _)| words), "met": verdict.as_ref().map(|(_, met)| met),
            });
            println!("{line}");
        } else {
            let [hub, floor, ratio] = spreads.map(|spread| spread.map_or("-".into(), |spread| spread.text()));
            let verdict = verdict.map_or(String::new(), |(words, met)| {
                format!("{words}: {}", if met { "met" } else { "MISSED" })
            });
            let name = format!("{}, {}", figure.name, figure.unit);
            println!("{name:34} {hub:>30} {floor:>30} {ratio:>22}  {verdict}");
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

/// Each name once, in order of appearance.
fn appearing<'a>(names: impl Iterator<Item = &'a String>) -> Vec<&'a String> {
    let mut found = Vec::new();
    for name in names {
        if !found.contains(&name) {
            found.push(name);
        }
    }
    found
}

/// The value below which `part` of the `sorted` values lie: nearest rank, the middle of two for the median.
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
