//! Costs of many subscribers to one sensor: CPU time of the hub, time until the last subscriber has a scan, and memory
//! of a hub with 200 subscribers. Subscribers sleep on the doorbell or on the event. The simulated sensor is at the
//! other end of a pty, and sends at its real rate.

use std::collections::BTreeMap;
use std::sync::Barrier;
use std::thread;
use std::time::Duration;

use scanhub_client::Wait;
use scanhub_schema::Scan;

use crate::growth::{ParameterRange, Quantity};
use crate::support::environment::{BenchEnvironment, Child, SENSORS, STEP_TIMEOUT};
use crate::support::figures::{self, Cell, Figure, Target, percentile};
use crate::support::subscriber::builder;
use crate::support::truth::SensorTruth;
use crate::support::usage::{ResidentMemory, ThreadUsage, segments};
use crate::support::{Options, Outcome, clock};

/// Measures 1 to 200 subscribers, for each way to wait.
pub(crate) fn measure_subscribers(options: &Options) -> Outcome<()> {
    let environment = BenchEnvironment::new()?;
    let _simulator = environment.simulate(&[SENSOR], 500_000)?;
    for wait in ["doorbell", "event"] {
        let quantity = |name, unit, linear| Quantity { name, unit, linear };
        let quantities = vec![
            quantity("CPU time per telegram", "us", Some(1.0)),
            quantity("last subscriber, p50", "us", Some(1.0)),
            quantity("last subscriber, p99", "us", Some(1.0)),
            quantity("own memory of the hub", "kB", Some(1.0)),
            quantity("shared memory touched by it", "kB", Some(1.0)),
            quantity("shared memory of the domain", "kB", Some(1.0)),
            quantity("missed", "1", None),
        ];
        let mut sweep = ParameterRange::new(
            &format!("subscribers of one sensor, waiting for the {wait}"),
            "subscribers",
            quantities,
        );
        for _ in 0..options.pairs().min(3) {
            // Use the same hub for all numbers of subscribers, because the memory of a subscriber is free after it has
            // left.
            let hub = environment.hub_with_many_slots(&[SENSOR])?;
            hub.wait_for_line("ready", STEP_TIMEOUT)?;
            let mut runs = Vec::new();
            for count in SUBSCRIBER_COUNTS {
                match run(&environment, &hub, count, options.seconds(8), wait) {
                    Ok(values) => runs.push((count, values)),
                    // On an overloaded machine, too few subscribers wake in time.
                    Err(error) => eprintln!("{count} subscribers, waiting for the {wait}: {error}"),
                }
            }
            runs.into_iter().for_each(|(count, values)| sweep.add(count, &values));
            hub.guard.kill()?;
        }
        sweep.print(options.json);
    }
    Ok(())
}

/// Attaches `count` subscribers to the scans of `sensor`. After each subscriber has received a scan, they receive for
/// `seconds` seconds. Prints a line `last SEQ COUNT AGE_NS` for each scan. COUNT is the number of subscribers that
/// received the scan, and AGE_NS is the age of the scan at the last of them. Finally prints `missed COUNT`.
pub(crate) fn subscribe_many(
    domain: &str,
    sensor: &str,
    count: usize,
    seconds: u64,
    wait: &str,
) -> Outcome<()> {
    let wait = if wait == "event" { Wait::Event } else { Wait::Doorbell };
    let all = Barrier::new(count + 1);
    let follow = || -> Result<(Vec<(u64, u64)>, u64), String> {
        let attached = builder::<Scan>(domain, sensor).wait(wait).timeout(STEP_TIMEOUT).open();
        let attached = attached.map_err(Into::into).and_then(|mut scans| -> Outcome<_> {
            scans.next()?.map(drop).map_or(Err("no scan arrived".into()), |()| Ok(scans))
        });
        // Wait even after an error, because a subscriber that fails must not block the others.
        all.wait();
        let mut scans = attached.map_err(|error| error.to_string())?;
        let words = |error: scanhub_client::Error| error.to_string();
        // Samples that were queued or missed while other subscribers attached do not count.
        while scans.try_next().map_err(words)?.is_some() {}
        let end = clock::now() + seconds * 1_000_000_000;
        let (mut ages, mut missed) = (Vec::with_capacity(50 * seconds as usize), 0);
        while clock::now() < end {
            let scan = scans.next().map_err(words)?.ok_or("no scan arrived")?;
            let header = scan.header();
            ages.push((header.seq, clock::now().saturating_sub(header.stamp_last_ns)));
            missed += scan.missed;
        }
        Ok((ages, missed))
    };
    thread::scope(|scope| {
        let threads: Vec<_> = (0..count).map(|_| scope.spawn(follow)).collect();
        all.wait();
        println!("following {count}");
        let (mut last, mut all_missed) = (BTreeMap::<u64, (usize, u64)>::new(), 0);
        for thread in threads {
            let (ages, missed) = thread.join().map_err(|_| "a subscriber panicked")??;
            all_missed += missed;
            for (seq, age) in ages {
                let entry = last.entry(seq).or_default();
                *entry = (entry.0 + 1, entry.1.max(age));
            }
        }
        last.iter().for_each(|(seq, (count, age))| println!("last {seq} {count} {age}"));
        println!("missed {all_missed}");
        println!("end");
        Ok(())
    })
}

/// Starts `count` subscribers in a few processes, and waits until each subscriber has a scan.
fn start(
    environment: &BenchEnvironment,
    sensor: &str,
    count: usize,
    seconds: u64,
    wait: &str,
) -> Outcome<Vec<Child>> {
    let processes = PROCESS_COUNT.min(count);
    let part = |number: usize| {
        let share = (count * (number + 1) / processes - count * number / processes).to_string();
        environment.start_part(&[
            "followers",
            environment.domain.name(),
            sensor,
            &share,
            &seconds.to_string(),
            wait,
        ])
    };
    let children: Vec<Child> = (0..processes).map(part).collect::<Outcome<_>>()?;
    children.iter().try_for_each(|child| child.wait_for_line("following", STEP_TIMEOUT).map(drop))?;
    Ok(children)
}

/// Measures `count` subscribers. Returns one value for each quantity of the table.
fn run(
    environment: &BenchEnvironment,
    hub: &Child,
    count: usize,
    seconds: u64,
    wait: &str,
) -> Outcome<[f64; 7]> {
    let children = start(environment, SENSOR, count, seconds, wait)?;
    // The measurement takes 0.9 times as long as the subscribers run, so it ends before the first of them leaves.
    let look =
        || -> Outcome<(u64, ThreadUsage)> { Ok((clock::now(), ThreadUsage::of(hub.guard.pid(), |_| true)?)) };
    let before = look()?;
    thread::sleep(Duration::from_millis(900 * seconds));
    let after = look()?;
    let memory = ResidentMemory::of(hub.guard.pid())?;
    let shared: f64 = segments(&environment.domain)?.values().map(|(_, bytes)| bytes).sum();
    let telegrams = SensorTruth::read(&environment.truth(), SENSOR)?.count(before.0, after.0);
    let (mut last, mut missed) = (BTreeMap::<u64, (u64, u64)>::new(), 0);
    for child in &children {
        for line in child.lines_until("end", STEP_TIMEOUT + Duration::from_secs(seconds))? {
            if line.text.starts_with("missed") {
                missed += line.number(1)?;
                continue;
            }
            let entry = last.entry(line.number(1)?).or_default();
            *entry = (entry.0 + line.number(2)?, entry.1.max(line.number(3)?));
        }
    }
    let of_all = last.values().filter(|(got, _)| *got == count as u64);
    let mut ages: Vec<f64> = of_all.map(|(_, age)| *age as f64 / 1e3).collect();
    ages.sort_by(f64::total_cmp);
    let at = |part| percentile(&ages, part).ok_or("no scan reached all subscribers");
    Ok([
        after.1.since(before.1).busy_ns as f64 / 1e3 / telegrams as f64,
        at(0.5)?,
        at(0.99)?,
        memory.heap_and_stacks / 1024.0,
        memory.shared / 1024.0,
        shared / 1024.0,
        missed as f64,
    ])
}

const SENSOR: &str = "front";
const SUBSCRIBER_COUNTS: [usize; 5] = [1, 4, 16, 64, 200];
const PROCESS_COUNT: usize = 4;

/// Number of files and total number of bytes in these files, by the extension of the file name.
type SegmentSizes = BTreeMap<String, (usize, f64)>;

/// Measures the memory of a hub with two links and 100 subscribers to the scans of each.
pub(crate) fn measure_memory(options: &Options) -> Outcome<()> {
    let environment = BenchEnvironment::new()?;
    let _simulator = environment.simulate(&SENSORS, 500_000)?;
    let hub = environment.hub_with_many_slots(&SENSORS)?;
    hub.wait_for_line("ready", STEP_TIMEOUT)?;
    let alone = segments(&environment.domain)?;
    // The subscribers run until the bench ends them, so that the first ones are still attached when the last ones
    // attach.
    let (seconds, long) = (options.seconds(8), 3600);
    let children: Vec<_> = SENSORS
        .iter()
        .map(|sensor| start(&environment, sensor, 100, long, "doorbell"))
        .collect::<Outcome<_>>()?;
    thread::sleep(Duration::from_secs(seconds));
    let resident = ResidentMemory::of(hub.guard.pid())?;
    let full = segments(&environment.domain)?;
    drop(children);
    let figure = |name, bytes: f64, target| {
        let hub = vec![bytes / 1024.0 / 1024.0];
        Figure { name, unit: "MiB", hub, baseline: Vec::new(), target }
    };
    let sum = |kinds: &SegmentSizes| kinds.values().map(|(_, bytes)| bytes).sum();
    let rows = [
        figure("resident, 2 links, 200 subscribers", resident.all, Target::Max(16.0)),
        figure("of this, own", resident.heap_and_stacks, Target::None),
        figure("of this, program and libraries", resident.files, Target::None),
        figure("of this, shared memory touched", resident.shared, Target::None),
        figure("shared memory, no subscriber", sum(&alone), Target::None),
        figure("shared memory, 200 subscribers", sum(&full), Target::None),
    ];
    figures::print("subscribers", options.json, &rows);
    figures::print_cells("subscribers", options.json, &cells("no subscriber", &alone));
    figures::print_cells("subscribers", options.json, &cells("200 subscribers", &full));
    Ok(())
}

fn cells(when: &str, segments: &SegmentSizes) -> Vec<Cell> {
    let cell = |kind: &String, column: &str, unit, value| Cell {
        table: format!("shared memory of two links, {when}"),
        row: format!(".{kind}"),
        column: column.to_owned(),
        unit,
        values: vec![value],
    };
    let row = |(kind, (count, bytes)): (&String, &(usize, f64))| {
        [cell(kind, "segments", "1", *count as f64), cell(kind, "taken", "kB", bytes / 1024.0)]
    };
    segments.iter().flat_map(row).collect()
}
