//! Latency of subscribers in other languages than Rust. Latency is the time from the last byte of a scan that the hub
//! read until a process has the scan. This process is the only subscriber. The runs of the languages alternate. The
//! baseline is a subscriber in Rust that sleeps on the doorbell, which is the default. The bench does not measure the
//! time in which a program processes the scan.
//!
//! The bench also measures the time in which Python reads ten minutes of two sensors from a recording into numpy
//! arrays. The baseline is a loop in Rust that reads the same scans. Neither time includes the start of the process.

mod support;

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;
use std::process::{Command, ExitCode, Stdio};
use std::time::{Duration, Instant};

use scanhub_config::Sources;
use scanhub_daemon::{ReadOptions, RecordingReader};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{MIRROR_PERIOD, Mode, Unit, Variant};
use scanhub_schema::file::Writer;
use scanhub_schema::{Header, Scan, Topic};
use scanhub_sim::room::Room;
use support::environment::{BenchEnvironment, Child, STEP_TIMEOUT};
use support::figures::{self, Figure, Target, percentile};
use support::{Options, Outcome};

/// A language that is compared with Rust.
struct Language {
    figures: [&'static str; 3],
    /// Maximum ratio of the language's median latency to that of Rust.
    max_ratio: f64,
    /// Returns the program and the first arguments of the language's subscriber. If this machine cannot run it, prints
    /// the reason and returns `None`. Domain, sensor and number of scans follow as arguments. The subscriber prints
    /// `aged SENSOR NS` for each scan, and then `end`.
    subscriber_command: fn() -> Outcome<Option<Vec<String>>>,
}

const LANGUAGES: [Language; 2] = [
    Language {
        figures: ["Python, p50", "Python, p90", "Python, p99"],
        max_ratio: 3.0,
        subscriber_command: python_subscriber,
    },
    Language { figures: ["C, p50", "C, p90", "C, p99"], max_ratio: 1.1, subscriber_command: c_subscriber },
];

fn main() -> ExitCode {
    support::main_with(run_part, measure)
}

fn run_part(words: &[&str]) -> Outcome<()> {
    match *words {
        ["read", file] => read(file.as_ref()),
        _ => support::run_part(words),
    }
}

fn measure(options: &Options) -> Outcome<()> {
    let environment = BenchEnvironment::new()?;
    let _simulator = environment.simulate(&[SENSOR], 500_000)?;
    let hub = environment.start_hub(&[SENSOR])?;
    hub.wait_for_line("ready", STEP_TIMEOUT)?;
    let count = options.count(800);
    let rust = || {
        environment.start_part(&[
            "ages",
            environment.domain.name(),
            SENSOR,
            &(count + SKIPPED_SCANS).to_string(),
        ])
    };
    let mut figures = Vec::new();
    for Language { figures: names, max_ratio, subscriber_command: subscriber } in LANGUAGES {
        let Some(words) = subscriber()? else { continue };
        let own = || {
            let last =
                [environment.domain.name(), SENSOR, &(count + SKIPPED_SCANS).to_string()].map(str::to_owned);
            Child::start(&words[0], &[&words[1..], &last].concat())
        };
        let (mut others, mut baselines) = (Vec::new(), Vec::new());
        for pair in 0..options.pairs() {
            if pair % 2 == 0 {
                others.push(ages(&own()?, count)?);
                baselines.push(ages(&rust()?, count)?);
            } else {
                baselines.push(ages(&rust()?, count)?);
                others.push(ages(&own()?, count)?);
            }
        }
        let targets = [(0.5, Target::Ratio(max_ratio)), (0.9, Target::None), (0.99, Target::None)];
        for (name, (part, target)) in names.into_iter().zip(targets) {
            let at = |runs: &[Vec<f64>]| runs.iter().filter_map(|run| percentile(run, part)).collect();
            figures.push(Figure { name, unit: "us", hub: at(&others), baseline: at(&baselines), target });
        }
    }
    figures.extend(measure_reading(&environment, options)?);
    figures::print("languages", options.json, &figures);
    Ok(())
}

/// Returns the ages of `count` scans in microseconds, sorted. Leaves out the first scans.
fn ages(subscriber: &Child, count: usize) -> Outcome<Vec<f64>> {
    let lines = subscriber.lines_until("end", STEP_TIMEOUT + Duration::from_millis(50) * count as u32)?;
    let aged = lines.iter().filter(|line| line.text.starts_with("aged")).skip(SKIPPED_SCANS);
    let mut ages: Vec<f64> = aged.map(|line| Ok(line.number(2)? as f64 / 1e3)).collect::<Outcome<_>>()?;
    ages.sort_by(f64::total_cmp);
    Ok(ages)
}

/// Measures the time that it takes to read a recording.
fn measure_reading(environment: &BenchEnvironment, options: &Options) -> Outcome<Option<Figure>> {
    let Some(mut words) = python_subscriber()? else { return Ok(None) };
    let file = environment.file("read.mcap");
    record(&file, options.seconds(600))?;
    let file = file.display().to_string();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/languages/read.py");
    words.truncate(words.len() - 1);
    words.extend([script.display().to_string(), file.clone()]);
    let run = |child: Child| -> Outcome<f64> {
        let lines = child.lines_until("end", STEP_TIMEOUT + Duration::from_secs(60))?;
        let read_line =
            lines.iter().find(|line| line.text.starts_with("took")).ok_or("the program printed no time")?;
        Ok(read_line.number(1)? as f64 / 1e6)
    };
    let (mut pythons, mut rusts) = (Vec::new(), Vec::new());
    for _ in 0..options.pairs() {
        pythons.push(run(Child::start(&words[0], &words[1..])?)?);
        rusts.push(run(environment.start_part(&["read", &file])?)?);
    }
    let name = "Python, reading a recording into numpy";
    Ok(Some(Figure { name, unit: "ms", hub: pythons, baseline: rusts, target: Target::Ratio(1.3) }))
}

/// Writes a recording of two sensors. After a while, the scans in it repeat.
fn record(file: &Path, seconds: u64) -> Outcome<()> {
    let room = Room::new(&"room".parse()?, 1);
    let period_ns = Variant::HALF.revolutions() * MIRROR_PERIOD;
    let telegram = |number| {
        let words = room.scan(Variant::HALF, Unit::Mm, Mode(1), number * period_ns);
        lms::measured::encode(0, Unit::Mm, &words, 0x10)
    };
    let telegrams: Vec<_> = (0..200).map(telegram).collect();
    let mode = lms::reply::configuration_reply(0, Mode(1), Unit::Mm, 0x10);
    let mut writer = Writer::begin(File::create(file)?, "", BTreeMap::new())?;
    for seq in 0..seconds * 1_000_000_000 / period_ns {
        for (number, sensor) in RECORDED.iter().enumerate() {
            let end_ns = 1_000_000_000 + seq * period_ns + number as u64 * 9_000_000;
            let mut header = Header {
                seq,
                topic_seq: seq,
                stamp_first_ns: end_ns - 14_640_000,
                stamp_last_ns: end_ns,
                wall_ns: 1_700_000_000_000_000_000 + end_ns,
                boot: 7,
                sensor: number as u8,
                period_us: (period_ns / 1000) as u32,
                ..Header::default()
            };
            header.set_sent_at(end_ns + 100_000);
            let telegram = if seq == 0 { &mode } else { &telegrams[seq as usize % telegrams.len()] };
            writer.write_sample(sensor, Topic::Telegram, &header, telegram.bytes())?;
        }
        if seq % 40 == 0 {
            writer.close_chunk()?;
        }
    }
    writer.finish()?;
    Ok(())
}

/// Reads the scans of a recording into arrays, and prints the time that this took.
fn read(file: &Path) -> Outcome<()> {
    let begin = Instant::now();
    let mut beams = 0;
    for sensor in RECORDED {
        let sources = Sources::default();
        let options = ReadOptions {
            file,
            sensor: Some(sensor),
            family: None,
            sources: &sources,
            topics: &[Topic::Scan],
        };
        let (mut ranges, mut stamps) = (Vec::new(), Vec::new());
        for sample in RecordingReader::open(&options)? {
            let scan = Scan::of_words(bytemuck::cast_slice(&sample.words));
            ranges.extend((0..scan.beams()).map(|i| scan.distance_m(i).unwrap_or(f64::NAN)));
            stamps.push(sample.header.stamp_first_ns as i64);
        }
        beams += ranges.len();
    }
    println!("took {} {beams}", begin.elapsed().as_nanos());
    println!("end");
    Ok(())
}

fn python_subscriber() -> Outcome<Option<Vec<String>>> {
    let top = Path::new(env!("CARGO_MANIFEST_DIR"));
    let made = || top.join("target/venv/bin/python").display().to_string();
    let python = std::env::var("SCANHUB_PYTHON").unwrap_or_else(|_| made());
    let mut imports = Command::new(&python);
    imports.args(["-c", "import scanhub"]).stderr(Stdio::null());
    if !imports.status().is_ok_and(|status| status.success()) {
        eprintln!("{python} is not a Python with the package scanhub; clients/python/build.sh makes one");
        return Ok(None);
    }
    let script = top.join("benches/languages/age.py").display().to_string();
    Ok(Some(vec![python, "-B".into(), script]))
}

/// Compiles the subscriber in C with the library that Cargo built for this bench.
fn c_subscriber() -> Outcome<Option<Vec<String>>> {
    let top = Path::new(env!("CARGO_MANIFEST_DIR"));
    let own = std::env::current_exe()?;
    let library = own.parent().ok_or("a bench is in a directory")?.join("libscanhub.so");
    let place = Path::new(env!("CARGO_TARGET_TMPDIR")).join("languages");
    std::fs::create_dir_all(&place)?;
    // Names under which the linker and the dynamic loader search for the library.
    for name in ["libscanhub.so", "libscanhub.so.0"] {
        let _ = std::fs::remove_file(place.join(name));
        std::os::unix::fs::symlink(&library, place.join(name))?;
    }
    let program = place.join("age").display().to_string();
    let mut cc = Command::new("cc");
    cc.args(["-std=c99", "-D_DEFAULT_SOURCE", "-O2", "-I"]).arg(top.join("clients/c/include"));
    cc.arg(top.join("benches/languages/age.c")).args(["-o", &program, "-lscanhub", "-L"]).arg(&place);
    match cc.arg(format!("-Wl,-rpath,{}", place.display())).status() {
        Ok(status) if status.success() => Ok(Some(vec![program])),
        Ok(_) => Err("benches/languages/age.c does not compile".into()),
        Err(_) => {
            eprintln!("there is no C compiler (cc)");
            Ok(None)
        }
    }
}

const SENSOR: &str = "front";
/// Sensors in the recording.
const RECORDED: [&str; 2] = ["front", "rear"];
/// Number of scans at the start of a run that do not count.
const SKIPPED_SCANS: usize = 40;
