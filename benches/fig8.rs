//! The four pictures of Fig. 8 of the paper, from the simulated room with the same name. `cargo bench --bench fig8 --
//! --draw DIR` writes the pictures as SVG. `-- --method paper` uses the method of the paper, and `-- --seed 3` changes
//! the random numbers of the simulation. Without `--draw`, the bench only prints what the pictures would show.

#[path = "../tests/testkit/decoded_scan.rs"]
mod decoded_scan;

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use scanhub_drivers::lms::variant::{MIRROR_PERIOD, Unit, Variant};
use scanhub_preprocess::background::{BackgroundModel, Method, Settings};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::{Background, Foreground, Nanos, Pose, Scan};
use scanhub_sim::room::Room;

/// Number of scans, as in the figure of the paper.
const SCAN_COUNT: u64 = 2_000;
/// Time between two scans.
const SCAN_PERIOD_NS: Nanos = 2 * MIRROR_PERIOD;
/// Time until which nothing in the room changes. Box 1 is put down at 15 s.
const UNCHANGED_UNTIL_NS: Nanos = 14_900_000_000;
/// Time of the snapshot. At this time, the person is in the room, and box 1 is still foreground.
const SNAPSHOT_NS: Nanos = 19_000_000_000;
/// Minimum difference between two backgrounds that is drawn, in millimeters. It equals the threshold of the methods.
const MIN_DIFFERENCE_MM: u16 = 30;

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
                // Cargo passes this argument to every bench.
                "--bench" => {}
                _ => return Err(format!("{word}? --draw DIR, --method paper|multi, --seed NUMBER")),
            }
        }
        Ok(options)
    }
}

/// Results of the run.
#[derive(Default)]
struct RoomRun {
    /// Positions that were background at any time.
    models: Vec<Position>,
    /// Positions that were foreground at any time.
    foreground: Vec<Position>,
    before: Vec<u16>,
    after: Vec<u16>,
    snapshot: Option<(Vec<u16>, Box<Foreground>)>,
    /// The last scan. All scans have beams at the same angles.
    scan: Box<Scan>,
}

impl RoomRun {
    fn new(options: &Options) -> RoomRun {
        let mut run = RoomRun::default();
        let beams = Variant::HALF.beams();
        let mut model =
            BackgroundModel::new(Settings { method: options.method, ..Settings::default() }, beams);
        let mut cutter = Segmenter::new(Pose::default(), beams);
        let mut foreground = Foreground::of(beams);
        let mut background = Background::zeroed(Background::len(beams));
        let room = Room::new(&"fig8".parse().expect("a built-in world"), options.seed);
        for end_ns in (1..=SCAN_COUNT).map(|number| number * SCAN_PERIOD_NS) {
            let scan = scan(&room, end_ns);
            model.update(&scan, &mut foreground);
            cutter.update(&scan, &mut foreground);
            model.write(&mut background);
            let ranges = background.ranges();
            if ranges != run.after {
                run.models.extend(positions(&scan, ranges));
                run.after = ranges.to_vec();
            }
            run.foreground.extend(foreground.readings().map(|(i, range)| Position::of(&scan, i, range)));
            if end_ns < UNCHANGED_UNTIL_NS {
                run.before.clone_from(&run.after);
            }
            if end_ns >= SNAPSHOT_NS && run.snapshot.is_none() {
                run.snapshot = Some((run.after.clone(), foreground.clone()));
            }
            run.scan = scan;
        }
        run
    }

    /// Returns the positions in `other` whose range differs from that in `model`.
    fn differences(&self, model: &[u16], other: &[u16]) -> Vec<Position> {
        let differs = |i: &usize| is_known(other[*i]) && model[*i].abs_diff(other[*i]) > MIN_DIFFERENCE_MM;
        (0..model.len()).filter(differs).map(|i| Position::of(&self.scan, i, other[i])).collect()
    }

    fn overlay(&self) -> FloorPlan {
        let mut picture = FloorPlan::new("all models and all foreground of 2000 scans");
        picture.dots("background", &self.models);
        picture.dots("foreground", &self.foreground);
        picture
    }

    fn before(&self) -> FloorPlan {
        let mut picture = FloorPlan::new("the model before anything changed");
        picture.dots("background", &positions(&self.scan, &self.before));
        picture
    }

    fn after(&self) -> FloorPlan {
        let mut picture = FloorPlan::new("the model at the end, and what is different");
        picture.dots("background", &positions(&self.scan, &self.after));
        picture.dots("gone", &self.differences(&self.after, &self.before));
        picture.dots("new", &self.differences(&self.before, &self.after));
        picture
    }

    fn snapshot(&self) -> FloorPlan {
        let mut picture = FloorPlan::new("one scan: foreground before its model, in segments");
        if let Some((model, foreground)) = &self.snapshot {
            picture.dots("background", &positions(&self.scan, model));
            let dots = foreground.readings().map(|(i, range)| Position::of(&self.scan, i, range));
            picture.dots("foreground", &dots.collect::<Vec<_>>());
            for segment in foreground.segments() {
                picture.ring(Position { right_mm: -segment.y_mm, ahead_mm: segment.x_mm }, segment.width);
            }
        }
        picture
    }
}

/// Returns the scan that the hub would publish for the measurement that ended at `end_ns`.
fn scan(room: &Room, end_ns: Nanos) -> Box<Scan> {
    decoded_scan::scan(&room.scan(Variant::HALF, Unit::Mm, decoded_scan::MODE, end_ns), Unit::Mm)
}

/// Returns whether the background of a beam is a range, and not unknown or far.
fn is_known(range: u16) -> bool {
    range != Background::UNKNOWN && range != Background::FAR
}

fn positions(scan: &Scan, ranges: &[u16]) -> Vec<Position> {
    let known = ranges.iter().enumerate().filter(|(_, range)| is_known(**range));
    known.map(|(i, &range)| Position::of(scan, i, range)).collect()
}

fn draw(run: &RoomRun, directory: &Path) -> std::io::Result<()> {
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
    let run = RoomRun::new(&options);
    let known = |model: &[u16]| model.iter().filter(|range| is_known(**range)).count();
    println!("fig8, seed {}, {:?}, {} scans", options.seed, options.method, SCAN_COUNT);
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

/// A position in the frame of the sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Position {
    right_mm: i32,
    ahead_mm: i32,
}

impl Position {
    /// Returns the position at which beam `i` of `scan` ends if its range is `range`, which is in the unit of the scan.
    fn of(scan: &Scan, i: usize, range: u16) -> Position {
        let mm = f64::from(range) * f64::from(scan.unit_um) / 1000.0;
        let (left, ahead) = scan.angle(i).sin_cos();
        Position { right_mm: (-mm * left).round() as i32, ahead_mm: (mm * ahead).round() as i32 }
    }

    /// Returns the position on the picture, in pixels. A pixel is one centimeter.
    fn pixel(self) -> (i32, i32) {
        let centimeters = |mm: i32| (f64::from(mm) / 10.0).round() as i32;
        (LEFT + centimeters(self.right_mm), BOTTOM - centimeters(self.ahead_mm))
    }
}

/// A floor plan as SVG, seen from above, with the sensor at the bottom. It has dots of several classes, rings and a
/// scale. The dots of one class are drawn as one path on a grid of one centimeter, so that the file is small. The
/// picture has no background and no extreme colors, so it is readable on light and on dark pages.
struct FloorPlan {
    body: String,
    legend: Vec<&'static str>,
    title: &'static str,
}

impl FloorPlan {
    /// Creates an empty picture.
    fn new(title: &'static str) -> FloorPlan {
        FloorPlan { body: String::new(), legend: Vec::new(), title }
    }

    /// Draws a dot at each of `positions`, in the color of `class`, which is one of [`CLASSES`].
    fn dots(&mut self, class: &'static str, positions: &[Position]) {
        let pixels: BTreeSet<(i32, i32)> = positions.iter().map(|place| place.pixel()).collect();
        let _ = write!(self.body, "<path class=\"{class}\" d=\"");
        let mut pen: Option<(i32, i32)> = None;
        for (x, y) in pixels {
            let _ = match pen {
                None => write!(self.body, "M{x} {y}h0"),
                Some((px, py)) => write!(self.body, "m{} {}h0", x - px, y - py),
            };
            pen = Some((x, y));
        }
        self.body.push_str("\"/>\n");
        self.legend.push(class);
    }

    /// Draws a ring around an object that is `width_mm` wide.
    fn ring(&mut self, center: Position, width_mm: u16) {
        let (x, y) = center.pixel();
        let radius = width_mm / 20 + 9;
        let _ = writeln!(self.body, "<circle class=\"ring\" cx=\"{x}\" cy=\"{y}\" r=\"{radius}\"/>");
    }

    /// Returns the SVG.
    fn finish(self) -> String {
        let (x, y) = (Position { right_mm: 0, ahead_mm: 0 }).pixel();
        let mut text = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" font-family=\"sans-serif\" \
             font-size=\"15\">\n<title>{}</title>\n<style>path{{fill:none;stroke-width:3;stroke-linecap:round}}\
             text{{fill:#808080}}.ring{{fill:none;stroke:#d9534f;stroke-width:1.5}}",
            self.title
        );
        for (class, color) in CLASSES {
            let _ = write!(text, ".{class}{{stroke:{color}}}");
        }
        text.push_str("</style>\n");
        text.push_str(&self.body);
        let _ = writeln!(text, "<path d=\"M{} {y}h20l-10 -14z\" fill=\"#808080\"/>", x - 10);
        let _ = writeln!(
            text,
            "<path d=\"M20 {y}h100\" stroke=\"#808080\"/><text x=\"20\" y=\"{}\">1 m</text>",
            y - 8
        );
        let _ = writeln!(text, "<text x=\"20\" y=\"24\">{}</text>", self.title);
        for (row, class) in self.legend.iter().enumerate() {
            let y = 48 + 20 * row as i32;
            let _ = writeln!(
                text,
                "<path class=\"{class}\" d=\"M20 {}h20\"/><text x=\"48\" y=\"{y}\">{class}</text>",
                y - 5
            );
        }
        text.push_str("</svg>\n");
        text
    }
}

/// Classes of dots with their colors.
const CLASSES: [(&str, &str); 4] =
    [("background", "#808080"), ("foreground", "#e67e22"), ("new", "#d9534f"), ("gone", "#3498db")];
/// Size of the picture, and position of the sensor in it, in pixels. The picture shows the room of 6.3 by 5.5 m and the
/// corridor behind the room's door.
const WIDTH: i32 = 760;
const HEIGHT: i32 = 730;
const LEFT: i32 = 350;
const BOTTOM: i32 = 705;
