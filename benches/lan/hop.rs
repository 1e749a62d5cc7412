//! From shared memory to an application behind the loopback, beside an eventfd and a datagram of the same length.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime};

use rustix::event::{EventfdFlags, eventfd};
use schema::Topic;
use schema::datagram::{Datagram, HEAD, Packed};

use crate::source::{self, SENSOR, Source};
use crate::support::figures::{Figure, Target, percentile};
use crate::support::stage::{PATIENCE, Stage};
use crate::support::{Outcome, clock};
use crate::wire;

/// Samples of a run, and before them those that do not count.
const COUNT: usize = 800;
const SETTLING: usize = 80;
/// Two sensors at 37.5 Hz take 13 ms a telegram; here it is somewhat faster, so that runs are short.
const PERIOD_NS: u64 = 7_000_000;
/// Where in the header the stamp is.
const STAMP: std::ops::Range<usize> = 24..32;

/// p50 and p99 of runs that take turns.
pub(crate) fn figures(pairs: usize) -> Outcome<Vec<Figure>> {
    let (mut hub, mut floor) = (Vec::new(), Vec::new());
    for pair in 0..pairs {
        if pair % 2 == 0 {
            hub.push(through_gateway()?);
            floor.push(bare()?);
        } else {
            floor.push(bare()?);
            hub.push(through_gateway()?);
        }
    }
    let figure = |name, part| {
        let at = |runs: &[Vec<f64>]| runs.iter().filter_map(|run| percentile(run, part)).collect();
        Figure { name, unit: "us", hub: at(&hub), floor: at(&floor), target: Target::Ratio(1.5) }
    };
    Ok(vec![figure("hop: p50", 0.5), figure("hop: p99", 0.99)])
}

fn through_gateway() -> Outcome<Vec<f64>> {
    let stage = Stage::new()?;
    let mut source = Source::open(&stage.domain)?;
    let gateway = wire::gateway(&stage, "lo", &[format!("--topic={SENSOR}/scan")])?;
    // It finds the hub and its sensor.
    let wake = clock::now() + ATTACHING_NS;
    while clock::now() < wake {
        clock::rest(clock::now() + PERIOD_NS);
        source.publish(wall_ns())?;
    }
    let application = application(|bytes| {
        let datagram = Datagram::read(bytes).ok()?;
        (datagram.head.topic == Topic::Scan.number()).then_some(datagram.head.stamp_ns)
    })?;
    paced(|| source.publish(wall_ns()))?;
    drop(gateway.end()?);
    ages(application)
}

fn bare() -> Outcome<Vec<f64>> {
    let (wake, mouth) = (eventfd(0, EventfdFlags::CLOEXEC)?, wire::mouth()?);
    let mut datagram = vec![0; HEAD + source::scan().pack(&mut [0; 2048]).unwrap_or_default()];
    let application = application(|bytes| Some(u64::from_le_bytes(bytes.get(STAMP)?.try_into().ok()?)))?;
    let stamps: Arc<[AtomicU64]> = (0..SETTLING + COUNT).map(|_| AtomicU64::new(0)).collect();
    let (reading, theirs) = (wake.try_clone()?, stamps.clone());
    let sender = thread::spawn(move || -> std::io::Result<()> {
        let mut left = theirs.iter();
        while left.len() > 0 {
            let mut told = [0; 8];
            rustix::io::read(&reading, &mut told)?;
            // Who was late finds several.
            for stamp in left.by_ref().take(u64::from_ne_bytes(told) as usize) {
                datagram[STAMP].copy_from_slice(&stamp.load(Ordering::Acquire).to_le_bytes());
                mouth.send_to(&datagram, wire::address(Topic::Scan))?;
            }
        }
        Ok(())
    });
    let mut next = stamps.iter();
    paced(|| {
        next.next().ok_or("one too many")?.store(wall_ns(), Ordering::Release);
        rustix::io::write(&wake, &1u64.to_ne_bytes())?;
        Ok(())
    })?;
    sender.join().map_err(|_| "the sender panicked")??;
    ages(application)
}

/// A thread that collects the ages, in ns, of datagrams in which `stamp` finds when they were made.
fn application(stamp: impl Fn(&[u8]) -> Option<u64> + Send + 'static) -> Outcome<JoinHandle<Vec<u64>>> {
    let ear = wire::ear()?;
    Ok(thread::spawn(move || {
        let mut ages = Vec::with_capacity(SETTLING + COUNT);
        let mut bytes = [0; 2048];
        let mut heard_at = Instant::now();
        while ages.len() < SETTLING + COUNT && heard_at.elapsed() < PATIENCE {
            if let Ok(len) = ear.recv(&mut bytes) {
                ages.extend(stamp(&bytes[..len]).map(|stamp_ns| wall_ns().saturating_sub(stamp_ns)));
                heard_at = Instant::now();
            }
        }
        ages
    }))
}

fn ages(application: JoinHandle<Vec<u64>>) -> Outcome<Vec<f64>> {
    let ages = application.join().map_err(|_| "the application panicked")?;
    if ages.len() < SETTLING + COUNT {
        return Err(format!("{} of {} came", ages.len(), SETTLING + COUNT).into());
    }
    let mut ages: Vec<_> = ages[SETTLING..].iter().map(|&age| age as f64 / 1e3).collect();
    ages.sort_by(f64::total_cmp);
    Ok(ages)
}

fn paced(mut tell: impl FnMut() -> Outcome<()>) -> Outcome<()> {
    let begin = clock::now();
    (0..(SETTLING + COUNT) as u64).try_for_each(|n| {
        clock::rest(begin + n * PERIOD_NS);
        tell()
    })
}

fn wall_ns() -> u64 {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    now.unwrap_or(Duration::ZERO).as_nanos() as u64
}

/// The gateway looks for sensors so long after a hub came.
const ATTACHING_NS: u64 = 6_000_000_000;
