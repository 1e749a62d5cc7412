//! Figures with their spread: a series per run, beside that of the floor, and the ratio run by run. Printed as a table
//! for people or as a line of JSON each. Says whether a target was met; refuses to fail because of it.

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

/// What a figure should be.
#[derive(Clone, Copy)]
pub(crate) enum Target {
    /// Whatever it is.
    None,
    /// The hub's median at most so.
    Most(f64),
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
        size if size >= 100.0 => format!("{value:.0}"),
        size if size >= 10.0 => format!("{value:.1}"),
        _ => format!("{value:.2}"),
    }
}
