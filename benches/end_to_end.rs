//! Does everything that two sensors send arrive, in order, bit for bit and in time? 2 x 1500 telegrams pass from ptys
//! at 500 kBd through the running hub into a process per sensor, and are compared with the log of the simulator. How
//! long does a start take with an idle sensor at each of the four rates, compared with a bare host that knows the rate?
//! Damaged bytes are left to the tests of the framer.
//!
//! The baseline of a start knows the rate. At 9,600 baud it requests the status, which takes 0.17 s there. The hub
//! first waits for a running stream, and then tries one rate after the other, 19,200 baud last.

mod support;

use scanhub_drivers::lms;
use std::process::ExitCode;

use support::figures::{self, Figure, Target};
use support::stage::{Child, PATIENCE, SENSORS, Stage};
use support::truth::Truth;
use support::{Options, Outcome};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let mut figures = transport(options.count(1500))?;
    for (rate, streaming, first) in STARTS {
        figures.extend(starts(options.pairs(), rate, streaming, first)?);
    }
    figures::print("end_to_end", options.json, &figures);
    Ok(())
}

/// `count` telegrams of each sensor through the hub; each figure has a value per sensor.
fn transport(count: usize) -> Outcome<Vec<Figure>> {
    let stage = Stage::new()?;
    let start = |sensor: &&str| {
        let consumer = stage.consumer("telegram", sensor, &[&count.to_string()])?;
        consumer.await_line("attaching", PATIENCE)?;
        Ok(consumer)
    };
    // Whoever listens from the beginning can tell whether something was lost: the sensors come last.
    let consumers: Vec<Child> = SENSORS.iter().map(start).collect::<Outcome<_>>()?;
    let hub = stage.hub(&SENSORS)?;
    hub.await_line("ready", PATIENCE)?;
    let simulator = stage.simulate(&SENSORS, 500_000)?;
    let mut received = Vec::new();
    for consumer in &consumers {
        received.push(consumer.lines_until("end", PATIENCE + count as u32 * PATIENCE / 400)?);
    }
    drop(hub);
    drop(simulator);
    let mut found = [const { Vec::new() }; 6];
    for (sensor, lines) in SENSORS.iter().zip(&received) {
        let truth = Truth::read(&stage.truth(), sensor)?;
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
            // All that was sent up to the last one received.
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
        figure("lost", "1", lost, Target::Most(0.0)),
        figure("not bit for bit", "1", altered, Target::Most(0.0)),
        figure("out of order", "1", disordered, Target::Most(0.0)),
        figure("sent before the first received", "1", before, Target::Most(0.0)),
        Figure { baseline: vec![NOMINAL_HZ; 2], ..figure("rate", "Hz", hz, Target::None) },
    ])
}

/// Starts of the hub and of the baseline, each with a sensor that was just powered on at `rate`.
fn starts(pairs: usize, rate: u32, streaming: &'static str, first: &'static str) -> Outcome<[Figure; 2]> {
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

/// Milliseconds from exec of the hub to the state streaming and to the first scan in a consumer's hands.
fn start_hub(rate: u32) -> Outcome<[f64; 2]> {
    let stage = Stage::new()?;
    let _simulator = stage.simulate(&ONE, rate)?;
    let statuses = stage.consumer("status", ONE[0], &[])?;
    let scans = stage.consumer("scan", ONE[0], &[])?;
    statuses.await_line("attaching", PATIENCE)?;
    scans.await_line("attaching", PATIENCE)?;
    let hub = stage.hub(&ONE)?;
    let since = |at: u64| (at - hub.started_ns) as f64 / 1e6;
    let first = since(scans.await_line("scan", PATIENCE)?.number(2)?);
    let streaming = since(statuses.await_line("status front streaming", PATIENCE)?.number(3)?);
    Ok([streaming, first])
}

/// The same of a host that knows the rate.
fn start_baseline(rate: u32) -> Outcome<[f64; 2]> {
    let stage = Stage::new()?;
    let _simulator = stage.simulate(&ONE, rate)?;
    let host = stage.part(&["host", &stage.port(ONE[0]), &rate.to_string()])?;
    let since = |at: u64| (at - host.started_ns) as f64 / 1e6;
    let streaming = since(host.await_line("streaming", PATIENCE)?.number(1)?);
    Ok([streaming, since(host.await_line("scan", PATIENCE)?.number(1)?)])
}

/// Rate at power-on, and the names of its figures.
const STARTS: [(u32, &str, &str); 4] = [
    (500_000, "500000 Bd to streaming", "500000 Bd to first scan"),
    (38_400, "38400 Bd to streaming", "38400 Bd to first scan"),
    (19_200, "19200 Bd to streaming", "19200 Bd to first scan"),
    (9_600, "9600 Bd to streaming", "9600 Bd to first scan"),
];
const ONE: [&str; 1] = ["front"];
/// 180 degrees in halves: two turns of the mirror.
const NOMINAL_HZ: f64 = 1e9 / (2.0 * lms::variant::MIRROR_TURN as f64);
