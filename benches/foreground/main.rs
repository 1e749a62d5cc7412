//! How well is told what stands before the background? The hub's two methods beside plain ones, in scenes of the
//! simulated world whose truth is known beam by beam: `cargo bench --bench foreground`, `-- --json` for a line each,
//! `-- --seeds 0..10` for others than 10 to 19 (those up to 9 were there to tune on), `-- --quick` for two seeds.

mod play;
mod rivals;
mod score;

use std::ops::Range;
use std::process::ExitCode;

use lms::variant::Unit;
use preprocess::background::{Method as Kind, Settings, Start};

use play::{Scene, play};
use rivals::{Hub, Method, Mixtures, TeachIn};
use score::Score;

const SCENES: [Scene; 2] = [
    Scene { world: "fig8", unit: Unit::Mm, scans: 2_000, mixed: true },
    Scene { world: "fig8", unit: Unit::Mm, scans: 2_000, mixed: false },
];

const METHODS: [&str; 5] = ["multi", "paper", "paper, first scan", "teach-in", "mixtures (MOG2)"];

fn method(name: &str) -> Box<dyn Method> {
    let paper = Settings { method: Kind::Paper, ..Settings::default() };
    match name {
        "multi" => Box::new(Hub::new(Settings { method: Kind::Multi, ..Settings::default() })),
        "paper" => Box::new(Hub::new(paper)),
        "paper, first scan" => Box::new(Hub::new(Settings { start: Start::FirstScan, ..paper })),
        "teach-in" => Box::new(TeachIn::new(schema::BEAMS)),
        _ => Box::new(Mixtures::new(schema::BEAMS)),
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
                    let ends = ends.and_then(|(from, to)| Some(from.parse().ok()?..to.parse().ok()?));
                    options.seeds = ends.ok_or("--seeds needs two numbers, as in 10..20")?;
                }
                // Cargo says so to every bench.
                "--bench" => {}
                _ => return Err(format!("{word}? --json, --quick, --seeds FROM..TO")),
            }
        }
        Ok(options)
    }
}

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let options = match Options::parse(&words) {
        Ok(options) => options,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::from(2);
        }
    };
    for scene in &SCENES {
        let mut scores = [Score::default(); METHODS.len()];
        for seed in options.seeds.clone() {
            let frames = play(scene, seed);
            for (score, name) in scores.iter_mut().zip(METHODS) {
                *score += Score::of(&mut *method(name), &frames);
            }
        }
        println!("{} {}", scene.world, if scene.mixed { "mixed" } else { "" });
        for (score, name) in scores.iter().zip(METHODS) {
            println!(
                "  {name:<20} {:.4} {:.4} {:.3}",
                score.recall(),
                score.precision(),
                score.wrong_per_scan()
            );
        }
    }
    ExitCode::SUCCESS
}
