//! The four pictures of the paper's Fig. 8, from the simulated room of that name: `cargo bench --bench fig8 -- --draw DIR`
//! writes them as SVG, `-- --method paper` for the paper's method, `-- --seed 3` for another run. Without `--draw` it
//! only says what they would show.

mod picture;
#[path = "../support/seen.rs"]
mod seen;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use lms::Nanos;
use lms::variant::{MIRROR_TURN, Unit, Variant};
use preprocess::background::{Method, Model, Settings};
use preprocess::segments::Segmenter;
use schema::{Background, Foreground, Pose, Scan};

use sim::room::Room;

use picture::{Picture, Place};

/// As many as the paper's figure has.
const SCANS: u64 = 2_000;
/// Time between two of them.
const SCAN_NS: Nanos = 2 * MIRROR_TURN;
/// The model before anything in the room changes: box 1 is put down at 15 s.
const BEFORE_NS: Nanos = 14_900_000_000;
/// The moment of the snapshot: the walker is inside, and box 1 is still news.
const SNAPSHOT_NS: Nanos = 19_000_000_000;
/// What two models must differ by to be drawn as different, in mm: the threshold of the methods.
const DIFFERENT_MM: u16 = 30;

struct Options {
    draw: Option<PathBuf>,
    method: Method,
    seed: u64,
}

impl Options {
    fn parse(words: impl Iterator<Item = String>) -> Result<Options, String> {
        let mut options = Options { draw: None, method: Settings::default().method, seed: 10 };
        let mut words = words;
        while let Some(word) = words.next() {
            let mut value = || words.next().ok_or(format!("{word} needs a value"));
            match word.as_str() {
                "--draw" => options.draw = Some(value()?.into()),
                "--seed" => options.seed = value()?.parse().map_err(|_| "--seed needs a number")?,
                "--method" => {
                    options.method = match value()?.as_str() {
                        "paper" => Method::Paper,
                        "multi" => Method::Multi,
                        other => return Err(format!("--method {other}? paper or multi")),
                    }
                }
                // Cargo says so to every bench.
                "--bench" => {}
                _ => return Err(format!("{word}? --draw DIR, --method paper|multi, --seed NUMBER")),
            }
        }
        Ok(options)
    }
}

/// What is kept of the run.
#[derive(Default)]
struct Run {
    /// Every place that was ever background, and every one that was foreground.
    models: Vec<Place>,
    foreground: Vec<Place>,
    before: Vec<u16>,
    after: Vec<u16>,
    snapshot: Option<(Vec<u16>, Box<Foreground>)>,
    /// The shape of all scans.
    scan: Box<Scan>,
}

impl Run {
    fn new(options: &Options) -> Run {
        let mut run = Run::default();
        let beams = Variant::HALF.beams();
        let mut model = Model::new(Settings { method: options.method, ..Settings::default() }, beams);
        let mut cutter = Segmenter::new(Pose::default(), beams);
        let mut foreground = Foreground::of(beams);
        let mut background = Background::zeroed(Background::len(beams));
        let room = Room::new(&"fig8".parse().expect("a world that the program brings along"), options.seed);
        for end_ns in (1..=SCANS).map(|number| number * SCAN_NS) {
            let scan = scan(&room, end_ns);
            model.update(&scan, &mut foreground);
            cutter.update(&scan, &mut foreground);
            model.show(&mut background);
            let ranges = background.ranges();
            if ranges != run.after {
                run.models.extend(places(&scan, ranges));
                run.after = ranges.to_vec();
            }
            run.foreground.extend(foreground.readings().map(|(i, range)| Place::of(&scan, i, range)));
            if end_ns < BEFORE_NS {
                run.before.clone_from(&run.after);
            }
            if end_ns >= SNAPSHOT_NS && run.snapshot.is_none() {
                run.snapshot = Some((run.after.clone(), foreground.clone()));
            }
            run.scan = scan;
        }
        run
    }

    /// Where `other` differs from `model`.
    fn differences(&self, model: &[u16], other: &[u16]) -> Vec<Place> {
        let differs = |i: &usize| known(other[*i]) && model[*i].abs_diff(other[*i]) > DIFFERENT_MM;
        (0..model.len()).filter(differs).map(|i| Place::of(&self.scan, i, other[i])).collect()
    }

    fn overlay(&self) -> Picture {
        let mut picture = Picture::new("all models and all foreground of 2000 scans");
        picture.dots("background", &self.models);
        picture.dots("foreground", &self.foreground);
        picture
    }

    fn before(&self) -> Picture {
        let mut picture = Picture::new("the model before anything changed");
        picture.dots("background", &places(&self.scan, &self.before));
        picture
    }

    fn after(&self) -> Picture {
        let mut picture = Picture::new("the model at the end, and what is different");
        picture.dots("background", &places(&self.scan, &self.after));
        picture.dots("gone", &self.differences(&self.after, &self.before));
        picture.dots("new", &self.differences(&self.before, &self.after));
        picture
    }

    fn snapshot(&self) -> Picture {
        let mut picture = Picture::new("one scan: foreground before its model, in segments");
        if let Some((model, foreground)) = &self.snapshot {
            picture.dots("background", &places(&self.scan, model));
            let dots = foreground.readings().map(|(i, range)| Place::of(&self.scan, i, range));
            picture.dots("foreground", &dots.collect::<Vec<_>>());
            for segment in foreground.segments() {
                picture.ring(Place { right_mm: -segment.y_mm, ahead_mm: segment.x_mm }, segment.width);
            }
        }
        picture
    }
}

/// What the hub publishes of the scan that ended at `end_ns`.
fn scan(room: &Room, end_ns: Nanos) -> Box<Scan> {
    seen::scan(&room.scan(Variant::HALF, Unit::Mm, seen::MODE, end_ns), Unit::Mm)
}

/// Whether a model's range is one.
fn known(range: u16) -> bool {
    range != Background::UNTAUGHT && range != Background::FAR
}

fn places(scan: &Scan, ranges: &[u16]) -> Vec<Place> {
    let known = ranges.iter().enumerate().filter(|(_, range)| known(**range));
    known.map(|(i, &range)| Place::of(scan, i, range)).collect()
}

fn draw(run: &Run, directory: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(directory)?;
    for (name, picture) in [
        ("overlay", run.overlay()),
        ("before", run.before()),
        ("after", run.after()),
        ("snapshot", run.snapshot()),
    ] {
        let path = directory.join(format!("fig8-{name}.svg"));
        let text = picture.finish();
        std::fs::write(&path, &text)?;
        println!("{}: {} bytes", path.display(), text.len());
    }
    Ok(())
}

fn main() -> ExitCode {
    let options = match Options::parse(std::env::args().skip(1)) {
        Ok(options) => options,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::from(2);
        }
    };
    let run = Run::new(&options);
    let known = |model: &[u16]| model.iter().filter(|range| known(**range)).count();
    println!("fig8, seed {}, {:?}, {} scans", options.seed, options.method, SCANS);
    println!("  foreground readings in all      {:>6}", run.foreground.len());
    println!("  beams of the model before       {:>6}", known(&run.before));
    println!("  beams of the model at the end   {:>6}", known(&run.after));
    println!("  beams whose model changed       {:>6}", run.differences(&run.before, &run.after).len());
    let Some(directory) = &options.draw else {
        println!("  no picture: name a directory with --draw DIR");
        return ExitCode::SUCCESS;
    };
    match draw(&run, directory) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{}: {error}", directory.display());
            ExitCode::FAILURE
        }
    }
}
