//! Time until a sensor streams. At the start of the hub, the sensor is in one of these states:
//!
//! - idle, streaming or left in installation mode, at each of the four rates
//! - just powered on, with quick replies. The baseline is a host that has the sensor's rate and sends no requests for
//!   information
//! - power-cycled in the middle of a scan while another sensor streams
//!
//! The bench does not measure how long a real sensor needs from power-on to its boot message, which is up to a minute.
//!
//! The simulated sensor takes 55 to 145 ms to reply, like recorded real sensors. If a stream already runs, the hub
//! publishes telegrams at once. Scans follow when the sensor has reported its identity and the encoding of its values.
//! The baseline for a sensor that was just powered on only changes the rate and starts the stream.

mod support;

use std::collections::HashSet;
use std::process::ExitCode;

use scanhub_drivers::lms::reply::Reply;
use serde_json::Value;
use support::environment::{BenchEnvironment, OutputLine, STEP_TIMEOUT};
use support::figures::{self, Figure, Target};
use support::truth::{SensorTruth, hash};
use support::{Options, Outcome};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let mut figures = Vec::new();
    for (rate, state, name) in START_CASES {
        let times = (0..options.pairs()).map(|_| start(rate, state)).collect::<Outcome<Vec<f64>>>()?;
        let maximum = if (rate, state) == ("500000", "streaming") { 500.0 } else { 5_000.0 };
        figures.push(Figure {
            name,
            unit: "ms",
            hub: times,
            baseline: Vec::new(),
            target: Target::Max(maximum),
        });
    }
    figures.extend(cold_starts(options.pairs())?);
    figures.push(measure_adoption(options.pairs())?);
    figures.extend(power_cycles(options.pairs())?);
    figures::print("start_states", options.json, &figures);
    Ok(())
}

/// Returns the time from exec of the hub to the first scan at a subscriber, in ms.
fn start(rate: &str, state: &str) -> Outcome<f64> {
    let environment = BenchEnvironment::new()?;
    let _simulator = environment.simulate_one("front", &["--baud", rate, "--state", state])?;
    let scans = environment.start_subscriber("scan", "front", &[])?;
    scans.wait_for_line("attaching", STEP_TIMEOUT)?;
    let hub = environment.start_hub(&["front"])?;
    Ok((scans.wait_for_line("scan", STEP_TIMEOUT)?.number(2)? - hub.started_ns) as f64 / 1e6)
}

/// Measures starts with an idle sensor at 9600 baud that replies after 60 ms. Three kinds of starts alternate. They are
/// the first start of the hub, the next start with the state that the first hub has saved, and the baseline with the
/// shortest possible dialog.
fn cold_starts(count: usize) -> Outcome<[Figure; 2]> {
    let (mut first, mut again, mut shortest) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..count {
        let environment = BenchEnvironment::new()?;
        for times in [&mut first, &mut again] {
            let _simulator = environment.simulate_one("front", &QUICK_FLAGS)?;
            let scans = environment.start_subscriber("scan", "front", &[])?;
            scans.wait_for_line("attaching", STEP_TIMEOUT)?;
            let hub = environment.start_hub(&["front"])?;
            times.push((scans.wait_for_line("scan", STEP_TIMEOUT)?.number(2)? - hub.started_ns) as f64 / 1e6);
        }
        drop(environment);
        let stage = BenchEnvironment::new()?;
        let _simulator = stage.simulate_one("front", &QUICK_FLAGS)?;
        let host = stage.start_part(&["host", "blindly", &stage.port("front"), "9600"])?;
        shortest.push((host.wait_for_line("scan", STEP_TIMEOUT)?.number(1)? - host.started_ns) as f64 / 1e6);
    }
    let figure = |name, hub, maximum| Figure {
        name,
        unit: "ms",
        hub,
        baseline: shortest.clone(),
        target: Target::Max(maximum),
    };
    Ok([figure("power on, quick answers", first, 700.0), figure("the same, the next start", again, 700.0)])
}

/// Measures the time from exec of the hub until its status reports that it has adopted an abandoned stream at the
/// target rate.
fn measure_adoption(count: usize) -> Outcome<Figure> {
    let mut hub = Vec::new();
    for _ in 0..count {
        let environment = BenchEnvironment::new()?;
        let _simulator = environment.simulate_one("front", &["--baud", "500000", "--state", "streaming"])?;
        let statuses = environment.start_subscriber("status", "front", &[])?;
        statuses.wait_for_line("attaching", STEP_TIMEOUT)?;
        let process = environment.start_hub(&["front"])?;
        let adopted = statuses.wait_for_line("status front streaming", STEP_TIMEOUT)?.number(3)?;
        hub.push((adopted - process.started_ns) as f64 / 1e6);
    }
    let target = Target::Max(150.0);
    Ok(Figure { name: "500000 Bd, streaming, adopted", unit: "ms", hub, baseline: Vec::new(), target })
}

/// Cycles the power of one of two sensors. Measures the time from this sensor's boot message to its first telegram, and
/// the losses of the other sensor.
fn power_cycles(count: usize) -> Outcome<[Figure; 3]> {
    let (mut back, mut lost, mut writes) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..count {
        let environment = BenchEnvironment::new()?;
        let follow = |sensor| environment.start_subscriber("telegram", sensor, &["0"]);
        let (front, rear) = (follow("front")?, follow("rear")?);
        for subscriber in [&front, &rear] {
            subscriber.wait_for_line("attaching", STEP_TIMEOUT)?;
        }
        let hub = environment.start_hub(&["front", "rear"])?;
        hub.wait_for_line("ready", STEP_TIMEOUT)?;
        let healthy = environment.simulate_one("rear", &["--state", "streaming", "--baud", "500000"])?;
        let cycled = ["--state", "streaming", "--baud", "500000", "--boot", "1s", "--fault", "power_at=2"];
        let cycled = environment.simulate_one("front", &cycled)?;
        let banner = wait_for_boot_message(&environment)?;
        let mut received = Vec::new();
        while received.last().is_none_or(|line: &OutputLine| line.number(2).is_ok_and(|at| at < banner)) {
            received.push(front.wait_for_line("telegram", STEP_TIMEOUT)?);
        }
        let first = received[received.len() - 1].number(2)?;
        back.push((first - banner) as f64 / 1e6);
        // Wait until the last telegrams of the other sensor have been received.
        drop(healthy);
        let truth = SensorTruth::read(&environment.own_truth("rear"), "rear")?;
        let last = truth.sent.last().map(|sent| sent.hash.clone()).unwrap_or_default();
        let mut hashes = HashSet::new();
        while !hashes.contains(&last) {
            let line = rear.wait_for_line("telegram", STEP_TIMEOUT)?;
            hashes.insert(line.words().get(6).copied().unwrap_or_default().to_owned());
        }
        let missing = truth.sent.iter().filter(|sent| !hashes.contains(&sent.hash)).count();
        lost.push(missing as f64);
        drop((cycled, hub));
        let eeprom = ["front", "rear"].map(|sensor| {
            SensorTruth::read(&environment.own_truth(sensor), sensor)
                .ok()
                .and_then(|truth| truth.eeprom_writes)
        });
        writes.push(eeprom.into_iter().flatten().sum::<u64>() as f64);
    }
    let figure = |name, unit, hub, maximum| Figure {
        name,
        unit,
        hub,
        baseline: Vec::new(),
        target: Target::Max(maximum),
    };
    Ok([
        figure("power cycle: boot message to telegram", "ms", back, 5_000.0),
        figure("power cycle: lost of the other", "1", lost, 0.0),
        figure("EEPROM writes", "1", writes, 0.0),
    ])
}

/// Waits for the boot message of the sensor, and returns the time at which its last byte was written.
fn wait_for_boot_message(environment: &BenchEnvironment) -> Outcome<u64> {
    let banner = Reply::PowerOn(b"LMS200;301063;V02.30").encode(0, 0x10).ok_or("no boot message")?;
    let banner = hash(banner.bytes());
    let give_up_at = support::clock::now() + STEP_TIMEOUT.as_nanos() as u64;
    loop {
        for line in std::fs::read_to_string(environment.own_truth("front"))?.lines() {
            let Ok(value) = serde_json::from_str::<Value>(line) else { continue };
            if value["sha256"] == banner.as_str() {
                return Ok(value["sent_ns"].as_u64().unwrap_or_default());
            }
        }
        if support::clock::now() > give_up_at {
            return Err("the sensor's power did not come on".into());
        }
        support::clock::sleep_until(support::clock::now() + 20_000_000);
    }
}

/// Flags of a sensor that is idle at 9600 baud and replies 60 ms after its ACK.
const QUICK_FLAGS: [&str; 4] = ["--baud", "9600", "--fault", "answer=0.06"];

/// Rate of the line, state of the sensor, and name of the figure, for each case.
const START_CASES: [(&str, &str, &str); 12] = [
    ("500000", "idle", "500000 Bd, idle"),
    ("500000", "streaming", "500000 Bd, streaming"),
    ("500000", "installation", "500000 Bd, installation mode"),
    ("38400", "idle", "38400 Bd, idle"),
    ("38400", "streaming", "38400 Bd, streaming"),
    ("38400", "installation", "38400 Bd, installation mode"),
    ("19200", "idle", "19200 Bd, idle"),
    ("19200", "streaming", "19200 Bd, streaming"),
    ("19200", "installation", "19200 Bd, installation mode"),
    ("9600", "idle", "9600 Bd, idle"),
    ("9600", "streaming", "9600 Bd, streaming"),
    ("9600", "installation", "9600 Bd, installation mode"),
];
