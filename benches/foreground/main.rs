//! How well is told what stands before the background? The hub's two methods beside plain ones, in scenes of the
//! simulated world whose truth is known beam by beam: `cargo bench --bench foreground`, `-- --json` for a line each,
//! `-- --seeds 0..10` for others than 10 to 19 (those up to 9 were there to tune on), `-- --quick` for two seeds.
//!
//! Due is a beam that meets a person with all of its spot. Wrong is one told that meets what always stood there, what
//! stood behind a thing that was taken away, or a thing put down or moved more than 20 s ago. Left out are beams that
//! graze a person or a moved thing, beams without a reading, and what was put down or moved in the last 20 s. Recall is
//! told of due; precision is due of told; wrong is per scan, over all 2000 scans, the first ones too.

mod boxes;
mod bytes;
mod method;
mod play;
mod rivals;
mod score;
#[path = "../support/seen.rs"]
mod seen;

use std::fmt;
use std::io::{Write, stdout};
use std::ops::Range;
use std::process::{ExitCode, exit};

use lms::variant::Unit;
use preprocess::background::{Method as Kind, Settings, Start};
use serde_json::json;

use boxes::Boxes;
use bytes::Bytes;
use method::{Hub, Method};
use play::{Scene, play};
use rivals::{Mixtures, TeachIn};
use score::Score;

const SCENES: [Scene; 10] = [
    Scene { name: "Fig. 8", world: "fig8", unit: Unit::Mm, mixed: true },
    Scene { name: "Fig. 8, no mixed pixels", world: "fig8", unit: Unit::Mm, mixed: false },
    Scene { name: "corridor, in cm", world: "corridor", unit: Unit::Cm, mixed: true },
    Scene { name: "somebody walks at the sensor", world: "approach", unit: Unit::Mm, mixed: true },
    Scene { name: "somebody stands there first", world: "standing", unit: Unit::Mm, mixed: true },
    Scene { name: "a door opens", world: "door", unit: Unit::Mm, mixed: true },
    Scene { name: "a chair is moved", world: "chair", unit: Unit::Mm, mixed: true },
    Scene { name: "a glass wall", world: "glass", unit: Unit::Mm, mixed: true },
    Scene { name: "sun", world: "sun", unit: Unit::Mm, mixed: true },
    Scene { name: "a crowd", world: "crowd", unit: Unit::Mm, mixed: true },
];

/// Recall, precision and wrong beams per scan that `multi` should reach; what is not named has no target.
const TARGETS: [(&str, [f64; 3]); 3] = [
    ("Fig. 8", [0.99, 0.95, 0.2]),
    ("corridor, in cm", [0.95, 0.0, 0.4]),
    ("somebody walks at the sensor", [0.95, 0.0, 0.4]),
];

const METHODS: [&str; 5] = ["multi", "paper", "paper, first scan", "teach-in", "mixtures (MOG2)"];

fn settings(name: &str) -> Option<Settings> {
    let paper = Settings { method: Kind::Paper, ..Settings::default() };
    match name {
        "multi" => Some(Settings { method: Kind::Multi, ..Settings::default() }),
        "paper" => Some(paper),
        "paper, first scan" => Some(Settings { start: Start::FirstScan, ..paper }),
        _ => None,
    }
}

fn method(name: &str) -> Box<dyn Method> {
    match settings(name) {
        Some(settings) => Box::new(Hub::new(settings)),
        None if name == "teach-in" => Box::new(TeachIn::new(schema::BEAMS)),
        None => Box::new(Mixtures::new(schema::BEAMS)),
    }
}

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    match Options::parse(&words) {
        Ok(options) => measure(&options),
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::from(2);
        }
    }
    ExitCode::SUCCESS
}

fn measure(options: &Options) {
    let mut boxes = [Boxes::default(); METHODS.len()];
    let mut bytes = [Bytes::default(); METHODS.len()];
    if !options.json {
        say(format_args!(
            "seeds {}..{}{:>34} {:>9} {:>11}",
            options.seeds.start, options.seeds.end, "recall", "precision", "wrong/scan"
        ));
    }
    for (number, scene) in SCENES.iter().enumerate() {
        let mut scores = [Score::default(); METHODS.len()];
        for seed in options.seeds.clone() {
            let frames = play(scene, seed);
            for (m, name) in METHODS.into_iter().enumerate() {
                scores[m] += Score::of(&mut *method(name), &frames);
                if number == 0 {
                    boxes[m].add(|| method(name), &frames);
                    if let Some(settings) = settings(name) {
                        bytes[m].add(settings, &frames);
                    }
                }
            }
        }
        print_scores(scene, &scores, options.json);
    }
    print_boxes(&boxes, options.json);
    print_bytes(&bytes, options.json);
}

fn print_scores(scene: &Scene, scores: &[Score], json: bool) {
    if !json {
        say(format_args!("{}", scene.name));
    }
    for (name, score) in METHODS.iter().zip(scores) {
        let (recall, precision, wrong) = (score.recall(), score.precision(), score.wrong_per_scan());
        let target = TARGETS.iter().find(|target| *name == "multi" && target.0 == scene.name);
        let is_met =
            target.map(|(_, least)| recall >= least[0] && precision >= least[1] && wrong <= least[2]);
        if json {
            let line = json!({
                "class": "foreground_bench", "scene": scene.name, "world": scene.world, "mixed": scene.mixed,
                "method": name, "recall": recall, "precision": precision, "wrong_per_scan": wrong, "met": is_met,
            });
            say(format_args!("{line}"));
        } else {
            let verdict = is_met.map_or("", |met| if met { "met" } else { "missed" });
            say(format_args!("  {name:<34} {recall:>8.4} {precision:>9.4} {wrong:>11.3}  {verdict}"));
        }
    }
}

fn print_boxes(boxes: &[Boxes], json: bool) {
    if !json {
        say(format_args!("of a box, %{:>33} {:>17} {:>12}", "new after N", "left of it: N", "2N"));
    }
    for (name, boxes) in METHODS.iter().zip(boxes) {
        let [new, gone, long_gone] = boxes.percents();
        if json {
            let line = json!({
                "class": "foreground_bench_box", "method": name, "scans": 375, "foreground_after_n_percent": new,
                "background_after_n_percent": gone, "background_after_2n_percent": long_gone,
            });
            say(format_args!("{line}"));
        } else {
            say(format_args!("  {name:<34} {new:>8.2} {gone:>17.2} {long_gone:>12.2}"));
        }
    }
}

fn print_bytes(bytes: &[Bytes], json: bool) {
    if !json {
        say(format_args!(
            "bytes a second in Fig. 8{:>18} {:>11} {:>7} {:>12}",
            "scans", "foreground", "ratio", "when empty"
        ));
    }
    for (name, bytes) in METHODS.iter().zip(bytes).filter(|(name, _)| settings(name).is_some()) {
        let [scans, foreground, empty] = bytes.per_second();
        let ratio = scans / foreground;
        if json {
            let line = json!({
                "class": "foreground_bench_bytes", "method": name, "scan_bytes_per_s": scans,
                "foreground_bytes_per_s": foreground, "empty_bytes_per_s": empty, "ratio": ratio,
            });
            say(format_args!("{line}"));
        } else {
            say(format_args!("  {name:<32} {scans:>8.0} {foreground:>11.0} {ratio:>7.2} {empty:>12.0}"));
        }
    }
}

/// A line on stdout; who reads no further wants no more.
fn say(line: fmt::Arguments<'_>) {
    if writeln!(stdout(), "{line}").is_err() {
        exit(0);
    }
}

struct Options {
    json: bool,
    seeds: Range<u64>,
}

impl Options {
    fn parse(words: &[String]) -> Result<Options, String> {
        let mut options = Options { json: false, seeds: 10..20 };
        let mut words = words.iter();
        while let Some(word) = words.next() {
            match word.as_str() {
                "--json" => options.json = true,
                "--quick" => options.seeds = 10..12,
                "--seeds" => {
                    let ends = words.next().and_then(|ends| ends.split_once(".."));
                    let seeds = ends.and_then(|(from, to)| Some(from.parse().ok()?..to.parse().ok()?));
                    options.seeds = seeds
                        .filter(|seeds: &Range<u64>| !seeds.is_empty())
                        .ok_or("--seeds needs two numbers, the greater one last: 10..20")?;
                }
                // Cargo says so to every bench.
                "--bench" => {}
                _ => return Err(format!("{word}? --json, --quick, --seeds FROM..TO")),
            }
        }
        Ok(options)
    }
}
