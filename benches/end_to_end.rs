//! Transport of telegrams through the hub, and start of the hub. For the transport, 1500 telegrams of each of two
//! sensors pass from ptys at 500 kBd through the hub to one process per sensor. The bench compares the received
//! telegrams with the log of the simulator: all of them must arrive in order, bit for bit and in time. The start is
//! measured with an idle sensor at each of the four rates. The baseline of the start is a minimal host that has the
//! right rate from the beginning. This bench sends no damaged bytes. The tests of the framer cover them.
//!
//! At 9,600 baud, the baseline requests the status, which takes 0.17 s at this rate. The hub first waits for a running
//! stream, and then tries one rate after the other, 19,200 baud last.

mod support;

use scanhub_drivers::lms;
use std::process::ExitCode;

use support::environment::{BenchEnvironment, Child, SENSORS, STEP_TIMEOUT};
use support::figures::{self, Figure, Target};
use support::truth::SensorTruth;
use support::{Options, Outcome};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let mut figures = measure_transport(options.count(1500))?;
    for (rate, streaming, first) in START_CASES {
        figures.extend(measure_starts(options.pairs(), rate, streaming, first)?);
    }
    figures::print("end_to_end", options.json, &figures);
    Ok(())
}

/// Receives `count` telegrams of each sensor through the hub. Each figure has one value per sensor.
fn measure_transport(count: usize) -> Outcome<Vec<Figure>> {
    let environment = BenchEnvironment::new()?;
    let start = |sensor: &&str| {
        let subscriber = environment.start_subscriber("telegram", sensor, &[&count.to_string()])?;
        subscriber.wait_for_line("attaching", STEP_TIMEOUT)?;
        Ok(subscriber)
    };
    // Start the sensors last. A subscriber can detect every loss only if it attaches before the sensors start.
    let subscribers: Vec<Child> = SENSORS.iter().map(start).collect::<Outcome<_>>()?;
    let hub = environment.start_hub(&SENSORS)?;
    hub.wait_for_line("ready", STEP_TIMEOUT)?;
    let simulator = environment.simulate(&SENSORS, 500_000)?;
    let mut received = Vec::new();
    for subscriber in &subscribers {
        received.push(subscriber.lines_until("end", STEP_TIMEOUT + count as u32 * STEP_TIMEOUT / 400)?);
    }
    drop(hub);
    drop(simulator);
    let mut found = [const { Vec::new() }; 6];
    for (sensor, lines) in SENSORS.iter().zip(&received) {
        let truth = SensorTruth::read(&environment.truth(), sensor)?;
        let hashes: Vec<&str> = lines.iter().filter_map(|line| line.words().get(6).copied()).collect();
        let times: Vec<u64> = lines.iter().map(|line| line.number(2)).collect::<Outcome<_>>()?;
        let places: Vec<Option<usize>> =
            hashes.iter().map(|hash| truth.sent.iter().position(|sent| sent.hash == *hash)).collect();
        let first = places.first().copied().flatten().unwrap_or(0);
        let span = (times[times.len() - 1] - times[0]) as f64 / 1e9;
        let known: Vec<usize> = places.iter().copied().flatten().collect();
        let sent = known.iter().max().map_or(0, |last| last + 1);
        let values = [
            hashes.len() as f64,
            // Number of telegrams that did not arrive, although the sensor sent them before the last telegram that was
            // received.
            (sent - known.len()) as f64,
            places.iter().filter(|place| place.is_none()).count() as f64,
            known.windows(2).filter(|pair| pair[0] >= pair[1]).count() as f64,
            first as f64,
            (times.len() - 1) as f64 / span,
        ];
        found.iter_mut().zip(values).for_each(|(series, value)| series.push(value));
    }
    let [received, lost, altered, disordered, before, hz] = found;
    let figure = |name, unit, hub, target| Figure { name, unit, hub, baseline: Vec::new(), target };
    Ok(vec![
        figure("telegrams received", "1", received, Target::None),
        figure("lost", "1", lost, Target::Max(0.0)),
        figure("not bit for bit", "1", altered, Target::Max(0.0)),
        figure("out of order", "1", disordered, Target::Max(0.0)),
        figure("sent before the first received", "1", before, Target::Max(0.0)),
        Figure { baseline: vec![NOMINAL_HZ; 2], ..figure("rate", "Hz", hz, Target::None) },
    ])
}

/// Measures starts of the hub and of the baseline, each with a sensor that was just powered on at `rate`.
fn measure_starts(
    pairs: usize,
    rate: u32,
    streaming: &'static str,
    first: &'static str,
) -> Outcome<[Figure; 2]> {
    let new = |name| Figure { name, unit: "ms", hub: Vec::new(), baseline: Vec::new(), target: Target::None };
    let mut figures = [new(streaming), new(first)];
    for _ in 0..pairs {
        let start = start_hub(rate)?;
        figures.iter_mut().zip(start).for_each(|(figure, value)| figure.hub.push(value));
        let start = start_baseline(rate)?;
        figures.iter_mut().zip(start).for_each(|(figure, value)| figure.baseline.push(value));
    }
    Ok(figures)
}

/// Starts a hub. Returns two times in milliseconds: from exec of the hub to the state `streaming`, and from exec to the
/// first scan at a subscriber.
fn start_hub(rate: u32) -> Outcome<[f64; 2]> {
    let environment = BenchEnvironment::new()?;
    let _simulator = environment.simulate(&ONE_SENSOR, rate)?;
    let statuses = environment.start_subscriber("status", ONE_SENSOR[0], &[])?;
    let scans = environment.start_subscriber("scan", ONE_SENSOR[0], &[])?;
    statuses.wait_for_line("attaching", STEP_TIMEOUT)?;
    scans.wait_for_line("attaching", STEP_TIMEOUT)?;
    let hub = environment.start_hub(&ONE_SENSOR)?;
    let since = |at: u64| (at - hub.started_ns) as f64 / 1e6;
    let first = since(scans.wait_for_line("scan", STEP_TIMEOUT)?.number(2)?);
    let streaming = since(statuses.wait_for_line("status front streaming", STEP_TIMEOUT)?.number(3)?);
    Ok([streaming, first])
}

/// Returns the same two times for a host that has the right rate from the beginning.
fn start_baseline(rate: u32) -> Outcome<[f64; 2]> {
    let environment = BenchEnvironment::new()?;
    let _simulator = environment.simulate(&ONE_SENSOR, rate)?;
    let host = environment.start_part(&["host", &environment.port(ONE_SENSOR[0]), &rate.to_string()])?;
    let since = |at: u64| (at - host.started_ns) as f64 / 1e6;
    let streaming = since(host.wait_for_line("streaming", STEP_TIMEOUT)?.number(1)?);
    Ok([streaming, since(host.wait_for_line("scan", STEP_TIMEOUT)?.number(1)?)])
}

/// Rates at power-on, each with the names of its figures.
const START_CASES: [(u32, &str, &str); 4] = [
    (500_000, "500000 Bd to streaming", "500000 Bd to first scan"),
    (38_400, "38400 Bd to streaming", "38400 Bd to first scan"),
    (19_200, "19200 Bd to streaming", "19200 Bd to first scan"),
    (9_600, "9600 Bd to streaming", "9600 Bd to first scan"),
];
const ONE_SENSOR: [&str; 1] = ["front"];
/// Scans per second at 180 degrees and 0.5 degrees: a scan takes two revolutions of the mirror.
const NOMINAL_HZ: f64 = 1e9 / (2.0 * lms::variant::MIRROR_PERIOD as f64);
