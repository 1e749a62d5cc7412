//! From shared memory to an application behind the loopback, beside an eventfd and a datagram of the same length.

use std::io::Read;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, SystemTime};

use rustix::event::{EventfdFlags, eventfd};
use rustix::process::{Signal, set_parent_process_death_signal};
use schema::Topic;
use schema::datagram::{Datagram, HEAD, Packed};

use crate::source::{self, SENSOR, Source};
use crate::support::child::Guard;
use crate::support::figures::{Figure, Target, percentile};
use crate::support::stage::Stage;
use crate::support::{Outcome, clock};
use crate::wire;

/// Samples of a run, and before them those that do not count.
const COUNT: usize = 800;
const SETTLING: usize = 80;
/// Two sensors at 37.5 Hz take 13 ms a telegram; here it is somewhat faster, so that runs are short.
const PERIOD_NS: u64 = 7_000_000;
/// Where in the header the number is.
const NUMBER: std::ops::Range<usize> = 20..24;
/// The words that make this program the sender of a bare run.
pub(crate) const PART: [&str; 2] = ["part", "sender"];

/// p50 and p99 of runs that take turns.
pub(crate) fn figures(pairs: usize) -> Outcome<Vec<Figure>> {
    let (mut hub, mut floor): (Vec<Run>, Vec<Run>) = Default::default();
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
        let at = |runs: &[Run]| runs.iter().filter_map(|(ages, _)| percentile(ages, part)).collect();
        Figure { name, unit: "us", hub: at(&hub), floor: at(&floor), target: Target::Ratio(1.5) }
    };
    let absent = |runs: &[Run]| runs.iter().map(|(_, absent)| *absent).collect();
    let (hub, floor) = (absent(&hub), absent(&floor));
    let absent = Figure { name: "hop: did not come", unit: "1", hub, floor, target: Target::None };
    Ok(vec![figure("hop: p50", 0.5), figure("hop: p99", 0.99), absent])
}

fn through_gateway() -> Outcome<Run> {
    let stage = Stage::new()?;
    let mut source = Source::open(&stage.domain)?;
    let gateway = wire::gateway(&stage, "lo", &[format!("--topic={SENSOR}/scan")])?;
    // It finds the hub and its sensor.
    let wake = clock::now() + ATTACHING_NS;
    while clock::now() < wake {
        clock::rest(clock::now() + PERIOD_NS);
        source.publish(wall_ns())?;
    }
    let application = Application::start(|bytes| {
        let datagram = Datagram::read(bytes).ok()?;
        (datagram.head.topic == Topic::Scan.number()).then_some(datagram.head.stamp_ns)
    })?;
    paced(|| source.publish(wall_ns()))?;
    drop(gateway.end()?);
    application.end()
}

fn bare() -> Outcome<Run> {
    let wake = eventfd(0, EventfdFlags::CLOEXEC)?;
    let stamps: Arc<[AtomicU64]> = (0..SETTLING + COUNT).map(|_| AtomicU64::new(0)).collect();
    let theirs = stamps.clone();
    let application = Application::start(move |bytes| {
        let number = u32::from_le_bytes(bytes.get(NUMBER)?.try_into().ok()?);
        Some(theirs.get(number as usize)?.load(Ordering::Acquire))
    })?;
    let mut command = Command::new(std::env::current_exe()?);
    let mut sender = command.args(PART).stdin(wake.try_clone()?).stdout(Stdio::piped()).spawn()?;
    let stdout = sender.stdout.take();
    let sender = Guard::new(sender);
    stdout.ok_or("no pipe")?.read_exact(&mut [0; 1])?;
    let mut next = stamps.iter();
    paced(|| {
        next.next().ok_or("one too many")?.store(wall_ns(), Ordering::Release);
        rustix::io::write(&wake, &1u64.to_ne_bytes())?;
        Ok(())
    })?;
    sender.wait()?;
    application.end()
}

/// The process that a bare run wakes: sends a datagram with the next number each time that the eventfd, its stdin, tells.
pub(crate) fn sender() -> Outcome<()> {
    set_parent_process_death_signal(Some(Signal::TERM))?;
    let mouth = wire::mouth()?;
    let mut datagram = vec![0; HEAD + source::scan().pack(&mut [0; 2048]).unwrap_or_default()];
    println!("ready");
    let mut numbers = 0..(SETTLING + COUNT) as u32;
    while !numbers.is_empty() {
        let mut told = [0; 8];
        rustix::io::read(rustix::stdio::stdin(), &mut told)?;
        // Who was late finds several.
        for number in numbers.by_ref().take(u64::from_ne_bytes(told) as usize) {
            datagram[NUMBER].copy_from_slice(&number.to_le_bytes());
            mouth.send_to(&datagram, wire::address(Topic::Scan))?;
        }
    }
    Ok(())
}

/// Ages in us, sorted, and how many did not come.
type Run = (Vec<f64>, f64);

/// A thread that collects the ages of datagrams.
struct Application {
    /// No more will be sent.
    is_over: Arc<AtomicBool>,
    thread: JoinHandle<Vec<u64>>,
}

impl Application {
    /// `stamp` finds in a datagram when it was made, in ns.
    fn start(stamp: impl Fn(&[u8]) -> Option<u64> + Send + 'static) -> Outcome<Application> {
        let (ear, is_over) = (wire::ear()?, Arc::new(AtomicBool::new(false)));
        let flag = is_over.clone();
        let thread = thread::spawn(move || {
            let (mut ages, mut bytes) = (Vec::with_capacity(SETTLING + COUNT), [0; 2048]);
            loop {
                match ear.recv(&mut bytes) {
                    Ok(len) => {
                        ages.extend(stamp(&bytes[..len]).map(|stamp_ns| wall_ns().saturating_sub(stamp_ns)));
                    }
                    Err(_) if flag.load(Ordering::Relaxed) => return ages,
                    Err(_) => {}
                }
            }
        });
        Ok(Application { is_over, thread })
    }

    /// What came; a hub does not wait for who is kept from running.
    fn end(self) -> Outcome<Run> {
        self.is_over.store(true, Ordering::Relaxed);
        let ages = self.thread.join().map_err(|_| "the application panicked")?;
        let absent = (SETTLING + COUNT).saturating_sub(ages.len()) as f64;
        let mut ages: Vec<_> = ages.iter().skip(SETTLING).map(|&age| age as f64 / 1e3).collect();
        ages.sort_by(f64::total_cmp);
        Ok((ages, absent))
    }
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
