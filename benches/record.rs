//! What does recording everything from two sensors cost, how much is a scan in the file, and what does a `kill -9` of the
//! recorder cost the recording? It does not tell what a slow disk does: that is what tests/it/record_disk.rs is for.

mod support;

use std::path::Path;
use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use mcap::MessageStream;
use mcap::read::Options as Reading;
use serde_json::Value;
use support::child::Child;
use support::figures::{self, Figure, Target};
use support::memory::Resident;
use support::options::Options;
use support::stage::{PATIENCE, SENSORS, Stage};
use support::work::Work;
use support::{Outcome, clock};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let _simulator = stage.simulate(&SENSORS, 500_000)?;
    let hub = stage.hub(&SENSORS)?;
    hub.await_line("ready", PATIENCE)?;
    for sensor in SENSORS {
        stage.consumer("telegram", sensor, &["1"])?.lines_until("end", PATIENCE)?;
    }
    let file = stage.file("record.mcap");
    let run = run(&stage, &file, options.seconds(30))?;
    let kills =
        (0..options.count(20)).map(|number| kill(&stage, &file, number)).collect::<Outcome<Vec<_>>>()?;
    let worst = kills.iter().copied().fold(0.0, f64::max);
    let figure =
        |name, unit, values: Vec<f64>, target| Figure { name, unit, hub: values, floor: Vec::new(), target };
    let figures = [
        figure("processor time", "%", vec![run.percent], Target::Most(1.0)),
        figure("of it where files are written", "%", vec![run.disk_percent], Target::None),
        figure("samples recorded", "1", vec![run.samples], Target::None),
        figure("samples lost or left out", "1", vec![run.lost], Target::Most(0.0)),
        figure("bytes per scan, all topics", "B", vec![run.bytes_per_scan], Target::None),
        figure("memory of its own at the end", "MB", vec![run.megabytes], Target::None),
        figure("kill: age of the last telegram", "ms", kills, Target::None),
        figure("kill: the worst of them", "ms", vec![worst], Target::Most(200.0)),
    ];
    figures::print("record", options.json, &figures);
    Ok(())
}

/// What a recording of some time cost.
struct Run {
    percent: f64,
    disk_percent: f64,
    samples: f64,
    lost: f64,
    bytes_per_scan: f64,
    megabytes: f64,
}

fn recorder(stage: &Stage, file: &Path, words: &[&str]) -> Outcome<Child> {
    let file = file.display().to_string();
    let all = ["record", "--all", "--json", "--force", "-o", &file, "--domain", stage.domain.name()];
    let words: Vec<String> = all.iter().chain(words).map(|word| word.to_string()).collect();
    Child::start(env!("CARGO_BIN_EXE_scanhub"), &words)
}

/// Records for so long; the account is of the time in which all topics are followed.
fn run(stage: &Stage, file: &Path, seconds: u64) -> Outcome<Run> {
    let recorder = recorder(stage, file, &["--for", &format!("{}s", seconds + 2)])?;
    thread::sleep(Duration::from_secs(1));
    let pid = recorder.guard.pid();
    let (all, disk) = (|_: &str| true, |name: &str| name == "disk");
    let (before, disk_before) = (Work::of(pid, all)?, Work::of(pid, disk)?);
    thread::sleep(Duration::from_secs(seconds));
    let (work, disk_work) = (Work::of(pid, all)?.since(before), Work::of(pid, disk)?.since(disk_before));
    let megabytes = Resident::of(pid)?.own / 1e6;
    let line = recorder.await_line("{\"class\":\"recorded\"", PATIENCE)?;
    let end: Value = serde_json::from_str(&line.text)?;
    let number = |key: &str| end[key].as_f64().ok_or_else(|| format!("no {key}: {end}"));
    let scans = messages(file)?.iter().filter(|(topic, _)| topic.ends_with("/scan")).count();
    let percent = |busy_ns: u64| 100.0 * busy_ns as f64 / 1e9 / seconds as f64;
    Ok(Run {
        percent: percent(work.busy_ns),
        disk_percent: percent(disk_work.busy_ns),
        samples: number("samples")?,
        lost: number("lost")? + number("left_out")?,
        bytes_per_scan: number("bytes")? / scans.max(1) as f64,
        megabytes,
    })
}

/// Kills a recorder while it records; how old the newest telegram was that can be read, the older one of the two sensors', in
/// ms.
fn kill(stage: &Stage, file: &Path, number: usize) -> Outcome<f64> {
    let recorder = recorder(stage, file, &[])?;
    recorder.await_line("{\"class\":\"recording\"", PATIENCE)?;
    // Anywhere in the time between two chunks.
    thread::sleep(Duration::from_millis(1900 + 37 * number as u64));
    let now_ns = clock::now();
    recorder.guard.kill()?;
    let messages = messages(file)?;
    let newest = |sensor: &&str| {
        let topic = format!("{sensor}/telegram");
        let stamps = messages.iter().filter(|(other, _)| *other == topic).map(|(_, stamp_ns)| *stamp_ns);
        stamps.max().map(|stamp_ns| now_ns.saturating_sub(stamp_ns)).ok_or("nothing was recorded")
    };
    let ages: Vec<u64> = SENSORS.iter().map(newest).collect::<Result<_, _>>()?;
    Ok(ages.into_iter().max().unwrap_or_default() as f64 / 1e6)
}

/// Topic and stamp of the last byte, in ns of CLOCK_MONOTONIC, of all that can be read.
fn messages(file: &Path) -> Outcome<Vec<(String, u64)>> {
    let bytes = std::fs::read(file)?;
    let messages = MessageStream::new_with_options(&bytes, Reading::IgnoreEndMagic.into())?;
    let told = messages.map_while(Result::ok).map(|message| {
        let stamp = message.data[24..32].try_into().map(u64::from_le_bytes);
        Ok((message.channel.topic.clone(), stamp?))
    });
    told.collect()
}
