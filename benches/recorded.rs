//! What pre-processing makes of real sensors: each recording of SCANHUB_DATA (else `../shared/data`) runs through all
//! processors as in the hub. Lists reflectors that were seen again and again, with how far they strayed, and what zones
//! and background say. Nothing of the recordings is part of the project; without them it says so and ends.

#![allow(missing_docs)] // A bench is no library.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use daemon::scanner;
use lms::measured::Measured;
use lms::telegram::Telegram;
use lms::variant::{Mode, Unit};
use preprocess::{background, marks, segments, zones};
use recording::{Encoding, Frame, Recording};
use schema::limits::TopicLimits;
use schema::{Background, Foreground, Mark, Marks, Pose, Scan, Verdict, Zones};

fn main() -> ExitCode {
    let beside = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let data = std::env::var_os("SCANHUB_DATA").map_or(beside, PathBuf::from);
    if !data.is_dir() {
        println!("no recordings of real sensors at {}", data.display());
        return ExitCode::SUCCESS;
    }
    for (name, mode) in RECORDINGS {
        match run(&data.join(name), mode) {
            Ok(account) => account.print(name),
            Err(error) => {
                eprintln!("{name}: {error}");
                return ExitCode::FAILURE;
            }
        }
    }
    ExitCode::SUCCESS
}

/// The recordings, and the measuring mode where they do not tell it.
const RECORDINGS: [(&str, Mode); 6] = [
    ("captures/reflector_levels_cm_18s.bin", Mode(1)),
    ("captures/lms200_38400.bin", Mode(1)),
    ("carmen/aces-corrected.log.gz", Mode(0)),
    ("carmen/freiburg-079-corrected.log.gz", Mode(0)),
    ("carmen/intel-corrected.log.gz", Mode(0)),
    ("carmen/orebro-corrected.log.gz", Mode(0)),
];

/// What was seen in one recording.
#[derive(Default)]
struct Account {
    scans: usize,
    available: usize,
    marks: usize,
    verdicts: [usize; Verdict::ALL.len()],
    foreground_beams: usize,
    segments: usize,
    taught: u16,
    beams: u16,
    reflectors: Vec<Reflector>,
}

/// Marks of several scans at one place.
struct Reflector(Vec<Mark>);

fn run(path: &Path, fallback: Mode) -> Result<Account, Box<dyn std::error::Error>> {
    let recording = Recording::open(path)?;
    let unit = recording.contents().unit.unwrap_or(Unit::Mm);
    let mode = recording.contents().mode.unwrap_or(fallback);
    let TopicLimits { beams, contents, .. } = TopicLimits::default();
    let mut zones = zones::Check::new(Pose::default(), &zones::Settings::default(), beams);
    let mut marks = marks::MarkDetector::new(marks::Settings::default());
    let mut model = background::Model::new(background::Settings::default(), beams);
    let mut cutter = segments::Segmenter::new(Pose::default(), beams);
    let mut scan = Scan::zeroed(Scan::len(beams, contents));
    let (mut found, mut near) = (Marks::default(), Zones::default());
    let mut foreground = Foreground::of(beams);
    let mut shown = Background::zeroed(Background::len(beams));
    let mut account = Account::default();
    for frame in recording.telegrams(Encoding { unit, mode })?.filter(Frame::is_scan) {
        let telegram = Telegram::check(&frame.telegram).ok_or("a telegram with a wrong CRC")?;
        let Some(measured) = Measured::decode(telegram) else { continue };
        scanner::decode(&measured, mode, &mut scan);
        marks.update(&scan, &mut found);
        zones.update(&scan, &mut near);
        model.update(&scan, &mut foreground);
        cutter.update(&scan, &mut foreground);
        account.scans += 1;
        account.available += usize::from(found.is_available());
        account.marks += found.marks().len();
        found.marks().iter().for_each(|mark| account.note(mark));
        account.verdicts[near.verdict() as usize] += 1;
        account.foreground_beams += usize::from(foreground.beams);
        account.segments += foreground.segments().len();
    }
    model.show(&mut shown);
    (account.taught, account.beams) = (shown.taught, shown.count);
    Ok(account)
}

impl Account {
    /// Puts `mark` to those at the same place, if there are any.
    fn note(&mut self, mark: &Mark) {
        let is_near = |seen: &Mark| {
            seen.angle_mdeg.abs_diff(mark.angle_mdeg) <= NEAR_MDEG
                && seen.range_dmm.abs_diff(mark.range_dmm) <= NEAR_DMM
        };
        match self.reflectors.iter_mut().find(|reflector| is_near(&reflector.0[0])) {
            Some(reflector) => reflector.0.push(*mark),
            None => self.reflectors.push(Reflector(vec![*mark])),
        }
    }

    fn print(&self, name: &str) {
        let per_scan = |count: usize| count as f64 / self.scans.max(1) as f64;
        println!("\n{name}: {} scans", self.scans);
        if self.available == 0 {
            println!("  marks: unavailable, the mode has no reflector bits");
        } else {
            println!("  marks: {:.2} a scan", per_scan(self.marks));
        }
        let verdicts = Verdict::ALL.map(|verdict| {
            format!("{} {:.1} %", verdict.name(), 100.0 * per_scan(self.verdicts[verdict as usize]))
        });
        println!("  zones: {}", verdicts.join(", "));
        println!(
            "  foreground: {:.1} beams and {:.2} segments a scan; {} of {} beams known at the end",
            per_scan(self.foreground_beams),
            per_scan(self.segments),
            self.taught,
            self.beams
        );
        let mut often: Vec<_> =
            self.reflectors.iter().filter(|reflector| per_scan(reflector.0.len()) >= OFTEN).collect();
        often.sort_by_key(|reflector| reflector.0[0].angle_mdeg);
        if !often.is_empty() {
            println!(
                "  {:>6} {:>22} {:>24} {:>5}",
                "scans", "angle, deg (sd, span)", "range, mm (sd, span)", "peak"
            );
        }
        for Reflector(marks) in often {
            let (angle, range) = (
                Spread::of(marks.iter().map(|mark| f64::from(mark.angle_mdeg) / 1000.0)),
                Spread::of(marks.iter().map(|mark| f64::from(mark.range_dmm) / 10.0)),
            );
            let peak = marks.iter().map(|mark| mark.peak).max().unwrap_or_default();
            println!(
                "  {:>5.1}% {:>8.3} ({:.3}, {:.3}) {:>10.0} ({:.1}, {:.0}) {peak:>5}",
                100.0 * per_scan(marks.len()),
                angle.mean,
                angle.deviation,
                angle.span,
                range.mean,
                range.deviation,
                range.span
            );
        }
    }
}

/// Mean, standard deviation, and greatest less least.
struct Spread {
    mean: f64,
    deviation: f64,
    span: f64,
}

impl Spread {
    fn of(values: impl Iterator<Item = f64> + Clone) -> Spread {
        let count = values.clone().count().max(1) as f64;
        let mean = values.clone().sum::<f64>() / count;
        let variance = values.clone().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
        let (least, most) = values.fold((f64::MAX, f64::MIN), |(a, b), value| (a.min(value), b.max(value)));
        Spread { mean, deviation: variance.sqrt(), span: (most - least).max(0.0) }
    }
}

/// A reflector that is in so many scans is no chance.
const OFTEN: f64 = 0.2;
/// Marks so near to the first one are the same reflector: two half-degree beams, and 20 cm, as far as a glossy surface
/// strays.
const NEAR_MDEG: u32 = 1_000;
const NEAR_DMM: u32 = 2_000;
