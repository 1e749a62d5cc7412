//! What consumers of one sensor cost the hub, and when the last of them has a scan: 1 to 200, threads of four processes, who
//! sleep at the bell or at the event. The sensor keeps its pace at the other end of a pty.

use std::collections::BTreeMap;
use std::sync::Barrier;
use std::thread;
use std::time::Duration;

use scanhub_client::Wait;
use schema::Scan;

use crate::support::child::Child;
use crate::support::consumer::subscribe;
use crate::support::figures::percentile;
use crate::support::memory::{Resident, segments};
use crate::support::options::Options;
use crate::support::stage::{PATIENCE, Stage};
use crate::support::truth::Truth;
use crate::support::work::Work;
use crate::support::{Outcome, clock};
use crate::sweep::{Quantity, Sweep};

/// 1 to 200 consumers, by each way to wait.
pub(crate) fn consumers(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let _simulator = stage.simulate(&[SENSOR], 500_000)?;
    for wait in ["doorbell", "event"] {
        let quantity = |name, unit, linear| Quantity { name, unit, linear };
        let quantities = vec![
            quantity("processor time per telegram", "us", Some(1.0)),
            quantity("last consumer, p50", "us", Some(1.0)),
            quantity("last consumer, p99", "us", Some(1.0)),
            quantity("own memory of the hub", "kB", Some(1.0)),
            quantity("shared memory touched by it", "kB", Some(1.0)),
            quantity("shared memory of the domain", "kB", Some(1.0)),
            quantity("missed", "1", None),
        ];
        let mut sweep =
            Sweep::new(&format!("consumers of one sensor, asleep at the {wait}"), "consumers", quantities);
        for _ in 0..options.pairs().min(3) {
            // One hub for all numbers: what leaves gives its memory back.
            let hub = stage.hub_for_crowd(&[SENSOR])?;
            hub.await_line("ready", PATIENCE)?;
            let mut runs = Vec::new();
            for count in CONSUMERS {
                runs.push((count, run(&stage, &hub, count, options.seconds(8), wait)?));
            }
            runs.into_iter().for_each(|(count, values)| sweep.add(count, &values));
            hub.guard.kill()?;
        }
        sweep.tell(options, 3, &format!("scale-consumers-{wait}.svg"))?;
    }
    Ok(())
}

/// Follows the scans of `sensor` with `count` consumers for `seconds` from when all of them have one, then prints for each
/// scan how many got it and when the last one had it, `last SEQ COUNT AGE_NS`, and `missed COUNT`.
pub(crate) fn follow(domain: &str, sensor: &str, count: usize, seconds: u64, wait: &str) -> Outcome<()> {
    let wait = if wait == "event" { Wait::Event } else { Wait::Doorbell };
    let all = Barrier::new(count + 1);
    let follow = || -> Result<(Vec<(u64, u64)>, u64), String> {
        let attached = subscribe::<Scan>(domain, sensor).map(|scans| scans.wait_by(wait).timeout(PATIENCE));
        let attached = attached
            .and_then(|mut scans| scans.next()?.map(drop).map_or(Err("nothing came".into()), |()| Ok(scans)));
        // One that cannot come is not waited for by the others.
        all.wait();
        let mut scans = attached.map_err(|error| error.to_string())?;
        let words = |failure: schema::Failure| failure.to_string();
        // What queued up while the others came is none of the count, nor what was missed then.
        while scans.try_next().map_err(words)?.is_some() {}
        let end = clock::now() + seconds * 1_000_000_000;
        let (mut ages, mut missed) = (Vec::with_capacity(50 * seconds as usize), 0);
        while clock::now() < end {
            let scan = scans.next().map_err(words)?.ok_or("nothing came")?;
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
            let (ages, missed) = thread.join().map_err(|_| "a consumer panicked")??;
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

/// `count` consumers that have a scan each, in as many processes.
pub(crate) fn start(
    stage: &Stage,
    sensor: &str,
    count: usize,
    seconds: u64,
    wait: &str,
) -> Outcome<Vec<Child>> {
    let processes = PROCESSES.min(count);
    let part = |number: usize| {
        let share = (count * (number + 1) / processes - count * number / processes).to_string();
        stage.part(&["followers", stage.domain.name(), sensor, &share, &seconds.to_string(), wait])
    };
    let crowd: Vec<Child> = (0..processes).map(part).collect::<Outcome<_>>()?;
    crowd.iter().try_for_each(|child| child.await_line("following", PATIENCE).map(drop))?;
    Ok(crowd)
}

/// The values of the sweep.
fn run(stage: &Stage, hub: &Child, count: usize, seconds: u64, wait: &str) -> Outcome<[f64; 7]> {
    let crowd = start(stage, SENSOR, count, seconds, wait)?;
    // None has left before the end.
    let look = || -> Outcome<(u64, Work)> { Ok((clock::now(), Work::of(hub.guard.pid(), |_| true)?)) };
    let before = look()?;
    thread::sleep(Duration::from_millis(900 * seconds));
    let after = look()?;
    let memory = Resident::of(hub.guard.pid())?;
    let shared: f64 = segments(&stage.domain)?.values().map(|(_, bytes)| bytes).sum();
    let telegrams = Truth::read(&stage.truth(), SENSOR)?.count(before.0, after.0);
    let (mut last, mut missed) = (BTreeMap::<u64, (u64, u64)>::new(), 0);
    for child in &crowd {
        for line in child.lines_until("end", PATIENCE + Duration::from_secs(seconds))? {
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
    let at = |part| percentile(&ages, part).ok_or("no scan that all had");
    Ok([
        after.1.since(before.1).busy_ns as f64 / 1e3 / telegrams as f64,
        at(0.5)?,
        at(0.99)?,
        memory.own / 1024.0,
        memory.shared / 1024.0,
        shared / 1024.0,
        missed as f64,
    ])
}

const SENSOR: &str = "front";
const CONSUMERS: [usize; 5] = [1, 4, 16, 64, 200];
const PROCESSES: usize = 4;
