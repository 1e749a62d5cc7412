//! Quality of the results that the hub computes from scans: foreground, lines, motion, and foreground of a moving
//! robot. Each result is compared with those of simple methods. The scenes are simulated, with known correct results.
//! Recordings of real sensors are used, too, if they exist. The command line is `cargo bench --bench perception [--
//! [foreground|lines|motion|moving ..] [--json] [--quick] [--seeds FROM..TO]]`.
//!
//! The bench `preprocess` measures the CPU time that these results cost in the hub.

mod foreground;
mod lines;
mod motion;
mod moving;
mod recordings;

#[path = "../support/figures.rs"]
#[allow(dead_code)] // Benches that measure processes use more items.
mod figures;
#[path = "../../tests/testkit/foreground.rs"]
mod scenes;
#[path = "../../hub/preprocess/tests/drives/mod.rs"]
mod worlds;

use std::ops::Range;
use std::process::ExitCode;

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let options = match Options::parse(&words) {
        Ok(options) => options,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::from(2);
        }
    };
    let Options { parts, is_json, is_quick, seeds } = options;
    for part in parts {
        match part {
            Part::Foreground => foreground::measure(seeds.clone(), is_json),
            Part::Lines => lines::measure(is_quick, is_json),
            Part::Motion => motion::measure(is_quick, is_json),
            Part::Moving => moving::measure(seeds.clone(), is_json),
        }
    }
    ExitCode::SUCCESS
}

#[derive(Clone, Copy)]
enum Part {
    Foreground,
    Lines,
    Motion,
    Moving,
}

struct Options {
    /// Parts to run, in this order.
    parts: Vec<Part>,
    is_json: bool,
    is_quick: bool,
    /// Seeds of simulated scenes and drives. Seeds below 10 were used to tune parameters.
    seeds: Range<u64>,
}

impl Options {
    fn parse(words: &[String]) -> Result<Options, String> {
        let (mut parts, mut seeds) = (Vec::new(), None);
        let (mut is_json, mut is_quick) = (false, false);
        let mut words = words.iter();
        while let Some(word) = words.next() {
            match word.as_str() {
                "foreground" => parts.push(Part::Foreground),
                "lines" => parts.push(Part::Lines),
                "motion" => parts.push(Part::Motion),
                "moving" => parts.push(Part::Moving),
                "--json" => is_json = true,
                "--quick" => is_quick = true,
                "--seeds" => {
                    let ends = words.next().and_then(|ends| ends.split_once(".."));
                    let range = ends.and_then(|(from, to)| Some(from.parse().ok()?..to.parse().ok()?));
                    let range = range.filter(|range: &Range<u64>| !range.is_empty());
                    seeds = Some(range.ok_or("--seeds needs a range such as 10..20")?);
                }
                // Cargo passes this argument to every bench.
                "--bench" => {}
                _ => {
                    return Err(format!(
                        "{word} is not known; use foreground, lines, motion, moving, --json, --quick, --seeds FROM..TO"
                    ));
                }
            }
        }
        if parts.is_empty() {
            parts = vec![Part::Foreground, Part::Lines, Part::Motion, Part::Moving];
        }
        let seeds = seeds.unwrap_or(if is_quick { 10..12 } else { 10..20 });
        Ok(Options { parts, is_json, is_quick, seeds })
    }
}
