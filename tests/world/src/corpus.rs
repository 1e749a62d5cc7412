//! Plans that once ended in a violation, each with what it was: a world that is mended stays so.

use crate::plan::Plan;

/// All of them, with what was wrong.
///
/// # Panics
///
/// If the file is no corpus.
pub fn corpus() -> Vec<(String, Plan)> {
    let plans = CORPUS.split("\n\n").filter(|text| text.lines().any(|line| !line.starts_with('#')));
    let parse = |text: &str| {
        let (why, plan): (Vec<&str>, Vec<&str>) = text.lines().partition(|line| line.starts_with('#'));
        let plan = plan.join("\n");
        let why = why.iter().map(|line| line.trim_start_matches("# ")).collect::<Vec<_>>().join(" ");
        let plan = plan.parse().unwrap_or_else(|error| panic!("{why}: {error}"));
        (why, plan)
    };
    plans.map(parse).collect()
}

/// Plans as text, an empty line between two, each behind lines that say why.
const CORPUS: &str = include_str!("corpus.txt");
