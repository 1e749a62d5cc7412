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
#[path = "../support/figures.rs"]
#[allow(dead_code)] // Benches of time use more of it.
mod figures;
mod method;
mod play;
mod rivals;
mod score;
#[path = "../support/seen.rs"]
mod seen;

use std::ops::Range;
use std::process::ExitCode;

use lms::variant::{Unit, Variant};
use preprocess::background::{Method as Kind, Settings, Start};

use boxes::Boxes;
use bytes::Bytes;
use figures::{Cell, Figure, Target};
use method::{Hub, Method};
use play::{Scene, play};
use rivals::{Mixtures, TeachIn};
use score::Score;

const SCENES: [Scene; 11] = [
    Scene { name: "Fig. 8", world: "fig8", unit: Unit::Mm, mixed: true },
    Scene { name: "Fig. 8, no mixed pixels", world: "fig8", unit: Unit::Mm, mixed: false },
    Scene { name: "corridor, in cm", world: "corridor", unit: Unit::Cm, mixed: true },
    Scene { name: "somebody walks at the sensor", world: "approach", unit: Unit::Mm, mixed: true },
    Scene { name: "somebody stands there first", world: "standing", unit: Unit::Mm, mixed: true },
    Scene { name: "a door opens", world: "door", unit: Unit::Mm, mixed: true },
    Scene { name: "a chair is moved", world: "chair", unit: Unit::Mm, mixed: true },
    Scene { name: "a glass wall", world: "glass", unit: Unit::Mm, mixed: true },
    Scene { name: "a wall seldom seen", world: "faint", unit: Unit::Mm, mixed: true },
    Scene { name: "sun", world: "sun", unit: Unit::Mm, mixed: true },
    Scene { name: "a crowd", world: "crowd", unit: Unit::Mm, mixed: true },
];

/// What `multi` should reach, by row and table.
const TARGETS: [(&str, &str, &str, Target); 11] = [
    ("recall in Fig. 8", "Fig. 8", RECALL, Target::Least(0.99)),
    ("precision in Fig. 8", "Fig. 8", PRECISION, Target::Least(0.95)),
    ("wrong beams a scan in Fig. 8", "Fig. 8", WRONG, Target::Most(0.2)),
    ("recall in a corridor", "corridor, in cm", RECALL, Target::Least(0.95)),
    ("wrong beams a scan in a corridor", "corridor, in cm", WRONG, Target::Most(0.4)),
    ("recall at the sensor", "somebody walks at the sensor", RECALL, Target::Least(0.95)),
    ("wrong beams a scan at the sensor", "somebody walks at the sensor", WRONG, Target::Most(0.4)),
    ("precision before a wall seldom seen", "a wall seldom seen", PRECISION, Target::Least(0.9)),
    ("wrong beams a scan before a wall seldom seen", "a wall seldom seen", WRONG, Target::Most(0.25)),
    ("percent of a box new after N", NEW, BOX, Target::Most(0.0)),
    ("percent of a box left after 2N", LEFT, BOX, Target::Most(0.0)),
];
const BOX: &str = "of a box in Fig. 8";
const NEW: &str = "put down: new after N scans";
const LEFT: &str = "taken away: left after 2N";
const RECALL: &str = "recall";
const PRECISION: &str = "precision";
const WRONG: &str = "wrong beams a scan";

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
        None if name == "teach-in" => Box::new(TeachIn::new(Variant::HALF.beams())),
        None => Box::new(Mixtures::new(Variant::HALF.beams())),
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
    let mut cells = Vec::new();
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
        cells.extend(METHODS.iter().zip(&scores).flat_map(|(name, score)| scored(scene, name, score)));
    }
    // A table for each of the three, though they are counted scene by scene.
    cells.sort_by_key(|cell| [RECALL, PRECISION, WRONG].iter().position(|table| cell.table == *table));
    for (name, boxes) in METHODS.iter().zip(&boxes) {
        let rows = [NEW, "taken away: left after N", LEFT];
        let values = rows.into_iter().zip(boxes.percents());
        cells.extend(values.map(|(row, percent)| cell(BOX, row, name, "%", percent)));
    }
    for (name, bytes) in METHODS.iter().zip(&bytes).filter(|(name, _)| settings(name).is_some()) {
        let rows = ["scans", "foreground", "foreground when empty"];
        let values = rows.into_iter().zip(bytes.per_second());
        cells.extend(values.map(|(row, bytes)| cell("payloads in Fig. 8", row, name, "B/s", bytes)));
    }
    let value = |table: &str, row: &str| {
        let is_it = |cell: &&Cell| cell.table == table && cell.row == row && cell.column == METHODS[0];
        cells.iter().find(is_it).map_or(Vec::new(), |cell| cell.values.clone())
    };
    let figure = |name, hub, target| Figure { name, unit: "1", hub, floor: Vec::new(), target };
    let mut figures =
        Vec::from(TARGETS.map(|(name, row, table, target)| figure(name, value(table, row), target)));
    let [scans, foreground, _] = bytes[0].per_second();
    figures.push(figure(
        "bytes of scans for one of foreground",
        vec![scans / foreground],
        Target::Least(10.0),
    ));
    if !options.json {
        println!("seeds {}..{}", options.seeds.start, options.seeds.end);
    }
    figures::print("foreground", options.json, &figures);
    figures::print_cells("foreground", options.json, &cells);
}

fn scored(scene: &Scene, method: &str, score: &Score) -> [Cell; 3] {
    [(RECALL, score.recall()), (PRECISION, score.precision()), (WRONG, score.wrong_per_scan())]
        .map(|(table, value)| cell(table, scene.name, method, "1", value))
}

fn cell(table: &str, row: &str, method: &str, unit: &'static str, value: f64) -> Cell {
    // Without anybody to tell, or nothing told, a share is no number.
    let values = if value.is_finite() { vec![value] } else { Vec::new() };
    Cell { table: table.into(), row: row.into(), column: method.into(), unit, values }
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
