//! Measures figures on revolutions of rotating scanners for docs/measured.md, on the scans that a whole hub publishes
//! in virtual time. The tables cover:
//!
//! - each model in each mode for ten minutes,
//! - a hundred lines that lose bytes in bursts,
//! - a hundred hubs whose process stops for half a second at a time,
//! - the time until a scanner streams, whatever its state was when the hub started.
//!
//! Run it with `cargo run --release -p scanhub-world --example revolutions`. Each argument after `--` is a prefix; the
//! tables whose names start with one of the prefixes are selected.

use std::fmt::Write as _;

use scanhub_world::{Detail, RevolutionFigures, Scenario, run};

const LD_MODELS: [&str; 5] = ["ld06", "ld19", "stl19p", "stl27l", "ld14p"];
/// All modes of each RPLIDAR model.
const RPLIDAR_MODELS: [(&str, &[&str]); 8] = [
    ("a1", &["standard", "express", "boost", "sensitivity", "stability"]),
    ("a2m8", &["standard", "express", "boost", "sensitivity", "stability"]),
    ("a2m12", &["standard", "express", "boost", "sensitivity", "stability"]),
    ("a3", &["standard", "express", "boost", "sensitivity", "stability"]),
    ("s1", &["standard", "express", "denseboost"]),
    ("s2", &["standard", "denseboost"]),
    ("s3", &["standard", "denseboost", "ultradense"]),
    ("c1", &["standard", "denseboost"]),
];
/// One model and mode for each packet format.
const PACKET_KINDS: [&str; 5] = ["a1:standard", "a1:express", "a1:boost", "s1:denseboost", "s3:ultradense"];

/// Prefixes of the names of the selected tables. An empty list selects all tables.
struct Tables(Vec<String>);

impl Tables {
    /// Runs worlds with `model` and `actions` for `seconds` each, and prints their figures and violations as one row of
    /// `table`.
    fn measure(&self, table: &str, model: &str, seeds: std::ops::Range<u64>, seconds: u64, actions: &str) {
        if !self.0.is_empty() && !self.0.iter().any(|expected| table.starts_with(expected.as_str())) {
            return;
        }
        let (mut figures, mut broken, worlds) =
            (RevolutionFigures::default(), Vec::new(), seeds.end - seeds.start);
        for seed in seeds {
            let text = format!("seed {seed} seconds {seconds} {model}\n{actions}");
            let scenario: Scenario = text.parse().expect("a scenario");
            let outcome = run(&scenario, Detail::Nothing);
            figures.add(&outcome.figures);
            broken.extend(outcome.violations.into_iter().map(|violation| format!("{seed}: {violation}")));
        }
        let RevolutionFigures { scans, incomplete, points, angle_deg, range_mm, wrong, lost, .. } = figures;
        let ms = |ns: u64| ns as f64 / 1e6;
        println!(
            "{table}, {model}: {worlds} worlds, {scans} scans, {incomplete} incomplete, {lost} packets lost, {points} points, \
             {wrong} wrong unmarked; at most {angle_deg:.3} degrees, {range_mm:.2} mm, stamps {:.2} ms off and {:.2} ms uneven; \
             data after {:.0} ms, scans after {:.0} ms; {} broken promises",
            ms(figures.stamp_ns),
            ms(figures.uneven_ns),
            ms(figures.data_ns),
            ms(figures.scan_ns),
            broken.len()
        );
        broken.iter().take(5).for_each(|broken| println!("  {broken}"));
    }
}

/// Returns actions that repeat `action` every `every_ms` milliseconds, from 3 s to 48 s.
fn repeated_action(every_ms: u64, action: &str) -> String {
    let mut actions = String::new();
    for at_ms in (3_000..48_000).step_by(every_ms as usize) {
        let _ = writeln!(actions, "{at_ms} {action}");
    }
    actions
}

fn main() {
    let tables = Tables(std::env::args().skip(1).collect());
    for model in LD_MODELS {
        tables.measure("ld ten minutes", model, 1..2, 600, "");
    }
    for (model, modes) in RPLIDAR_MODELS {
        for mode in modes {
            tables.measure("rplidar ten minutes", &format!("{model}:{mode}"), 1..2, 600, "");
        }
    }
    let loss =
        repeated_action(10_000, "noise sensor=0 loss=135 flip=0 insert=0 double=0 burst=2 span_ms=9900");
    tables.measure("ld burst loss", "ld19", 0..100, 60, &loss);
    PACKET_KINDS.iter().for_each(|model| tables.measure("rplidar burst loss", model, 0..100, 60, &loss));
    let stalls = repeated_action(5_000, "stall span_ms=500");
    tables.measure("ld hub stands still for 0.5 s", "ld19", 0..100, 60, &stalls);
    for model in PACKET_KINDS {
        tables.measure("rplidar hub stands still for 0.5 s", model, 0..20, 60, &stalls);
    }
    let stalls = repeated_action(6_000, "stall span_ms=2000");
    tables.measure("ld hub stands still for 2 s", "ld19", 0..100, 60, &stalls);
    for (model, _) in RPLIDAR_MODELS {
        for state in ["idle", "streaming", "off", "error"] {
            tables.measure("rplidar start", &format!("{model}::{state}"), 0..20, 5, "");
        }
    }
}
