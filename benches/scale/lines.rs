//! What sensors on lines cost the hub: 1 to 16 of them, each a simulator of its own at the other end of a pty, each with a
//! consumer of its scans. The rate tells whether simulators and hub, on the same processors, keep the sensors' pace.

use std::thread;
use std::time::Duration;

use crate::support::child::Child;
use crate::support::figures::percentile;
use crate::support::memory::{Resident, segments};
use crate::support::options::Options;
use crate::support::stage::{PATIENCE, Stage};
use crate::support::truth::Truth;
use crate::support::work::Work;
use crate::support::{Outcome, clock};
use crate::sweep::{Quantity, Sweep};

/// 1 to 16 sensors.
pub(crate) fn sensors(options: &Options) -> Outcome<()> {
    let quantity = |name, unit, linear| Quantity { name, unit, linear };
    let quantities = vec![
        quantity("processor time per telegram", "us", Some(0.0)),
        quantity("last byte read to consumer, p50", "us", Some(0.0)),
        quantity("last byte read to consumer, p99", "us", Some(0.0)),
        quantity("own memory of the hub", "kB", Some(1.0)),
        quantity("shared memory touched by it", "kB", Some(1.0)),
        quantity("shared memory of the domain", "kB", Some(1.0)),
        quantity("rate of the slowest sensor", "Hz", None),
    ];
    let mut sweep = Sweep::new("sensors on ptys", "sensors", quantities);
    for sensors in SENSORS {
        for _ in 0..options.pairs().min(3) {
            match run(sensors, options.seconds(10)) {
                Ok(values) => sweep.add(sensors, &values),
                Err(error) => eprintln!("{sensors} sensors on ptys: {error}"),
            }
        }
    }
    sweep.tell(options, 3, "scale-ptys.svg")
}

/// The values of the sweep.
fn run(sensors: usize, seconds: u64) -> Outcome<[f64; 7]> {
    let stage = Stage::new()?;
    let names: Vec<String> = (0..sensors).map(|number| format!("s{number}")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let _simulators: Vec<Child> =
        names.iter().map(|name| stage.simulate_one(name, &["--baud", "500000"])).collect::<Outcome<_>>()?;
    let hub = stage.hub(&names)?;
    hub.await_line("ready", PATIENCE)?;
    let count = SETTLING + (seconds as f64 * RATE) as usize;
    let start = |name: &&str| stage.part(&["ages", "scan", stage.domain.name(), name, &count.to_string()]);
    let consumers: Vec<Child> = names.iter().map(start).collect::<Outcome<_>>()?;
    let patience = PATIENCE + Duration::from_secs(4 * seconds);
    // Once all stream and the rhythm of each line is learned.
    for consumer in &consumers {
        consumer.await_line("attaching", PATIENCE)?;
    }
    thread::sleep(Duration::from_millis((SETTLING as f64 / RATE * 1e3) as u64));
    let look = || -> Outcome<(u64, Work)> { Ok((clock::now(), Work::of(hub.guard.pid(), |_| true)?)) };
    let before = look()?;
    thread::sleep(Duration::from_secs(seconds));
    let after = look()?;
    let memory = Resident::of(hub.guard.pid())?;
    let shared: f64 = segments(&stage.domain)?.values().map(|(_, bytes)| bytes).sum();
    let mut ages = Vec::new();
    for consumer in &consumers {
        let lines = consumer.lines_until("end", patience)?;
        for line in lines.iter().filter(|line| line.text.starts_with("aged")).skip(SETTLING) {
            ages.push(line.number(2)? as f64 / 1e3);
        }
    }
    ages.sort_by(f64::total_cmp);
    let mut counts = Vec::new();
    for name in &names {
        counts.push(Truth::read(&stage.own_truth(name), name)?.count(before.0, after.0));
    }
    let slowest = *counts.iter().min().ok_or("no sensor")? as f64 / ((after.0 - before.0) as f64 / 1e9);
    let telegrams = counts.iter().sum::<usize>() as f64;
    let at = |part| percentile(&ages, part).ok_or("no scan came");
    Ok([
        after.1.since(before.1).busy_ns as f64 / 1e3 / telegrams,
        at(0.5)?,
        at(0.99)?,
        memory.own / 1024.0,
        memory.shared / 1024.0,
        shared / 1024.0,
        slowest,
    ])
}

const SENSORS: [usize; 5] = [1, 2, 4, 8, 16];
/// Scans of a sensor before it counts.
const SETTLING: usize = 80;
/// Scans a second of a sensor with half degrees.
const RATE: f64 = 37.5;
