//! The floor of a hub that streams: the system calls that a late reader of a pty cannot do without, and a wake-up of
//! one sleeping process per telegram. No framing, no CRC, no counters, no shared memory: a telegram is the next 732
//! bytes after a pause that is longer than the one within a telegram.

use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;

use rustix::event::{EventfdFlags, eventfd};

use super::child::Guard;
use super::line::Line;
use super::{Outcome, PART, clock, truth};

/// Reads `count` telegrams (0: for ever) from each of `ports` in a thread of its own, waking a process per port, then
/// prints the hash of each and when it was read. The first line says that it is up.
pub(crate) fn chain(ports: &[&str], count: usize) -> Outcome<()> {
    let mut sleepers = Vec::new();
    let mut ends = Vec::new();
    for (number, port) in ports.iter().enumerate() {
        let wake = eventfd(0, EventfdFlags::CLOEXEC)?;
        sleepers.push(start_sleeper(number, count, wake.try_clone()?)?);
        ends.push((Line::open(Path::new(port), RATE)?, wake));
    }
    println!("ready");
    let threads: Vec<_> = ends
        .into_iter()
        .map(|(line, wake)| thread::spawn(move || read_or_end(&line, &wake, count)))
        .collect();
    for (number, thread) in threads.into_iter().enumerate() {
        let telegrams = thread.join().map_err(|_| "a reader panicked")?;
        for (telegram, at) in telegrams {
            println!("read {number} {} {at}", truth::hash(&telegram));
        }
    }
    sleepers.into_iter().try_for_each(Guard::wait)?;
    println!("end");
    Ok(())
}

/// Sleeps at the eventfd that is its stdin until `count` telegrams were told (0: for ever, and says the first), then
/// prints when it was told of each.
pub(crate) fn sleeper(number: &str, count: usize) -> Outcome<()> {
    let wake = rustix::stdio::stdin();
    let mut times = Vec::with_capacity(count);
    let mut said = false;
    while count == 0 || times.len() < count {
        if clock::readable(wake, None)? {
            let mut told = [0; 8];
            rustix::io::read(wake, &mut told)?;
            let now = clock::now();
            if count == 0 && !std::mem::replace(&mut said, true) {
                println!("woken {number} {now}");
            }
            times.extend((0..u64::from_ne_bytes(told)).map(|_| now).take(count));
        }
    }
    times.iter().for_each(|time| println!("woken {number} {time}"));
    Ok(())
}

/// A process that sleeps at `wake` until `count` wake-ups came, see [`sleeper`].
pub(crate) fn start_sleeper(number: usize, count: usize, wake: OwnedFd) -> Outcome<Guard> {
    let words = [PART, "sleeper", &number.to_string(), &count.to_string()].map(String::from);
    let process = Command::new(std::env::current_exe()?).args(words).stdin(Stdio::from(wake)).spawn()?;
    Ok(Guard::new(process))
}

/// One reader less would be a floor too low: if one ends early, all do.
fn read_or_end(line: &Line, wake: &OwnedFd, count: usize) -> Vec<([u8; LENGTH], u64)> {
    read(line, wake, count).unwrap_or_else(|error| {
        eprintln!("floor: {error}");
        std::process::exit(1)
    })
}

/// The loop. What it keeps of each telegram is kept after the wake-up, in the pause before the next one.
fn read(line: &Line, wake: impl AsFd, count: usize) -> Result<Vec<([u8; LENGTH], u64)>, String> {
    let words = |error: Box<dyn std::error::Error>| error.to_string();
    line.await_pause(PAUSE).map_err(words)?;
    let mut kept = Vec::with_capacity(count);
    let mut duration = Duration::default();
    let mut telegram = [0; LENGTH];
    while count == 0 || kept.len() < count {
        let mut filled = 0;
        let mut first = 0;
        while filled < LENGTH {
            clock::readable(line, None).map_err(|error| error.to_string())?;
            let len = line.read(&mut telegram[filled..]).map_err(words)?;
            let fresh = filled == 0 && len > 0;
            filled += len;
            if fresh {
                first = clock::now();
                if let Some(duration) = duration.known.filter(|_| filled < LENGTH) {
                    clock::rest(first + duration - LEAD);
                    // As in the hub: bytes are there for sure, no need to ask.
                    filled += line.read(&mut telegram[filled..]).map_err(words)?;
                }
            }
        }
        let last = clock::now();
        if telegram[0] != lms::telegram::STX {
            // A pause that was none: whoever writes was kept from running.
            line.await_pause(PAUSE).map_err(words)?;
            continue;
        }
        rustix::io::write(&wake, &1u64.to_ne_bytes()).map_err(|error| error.to_string())?;
        duration.learn(last - first);
        if count > 0 {
            kept.push((telegram, last));
        }
    }
    Ok(kept)
}

/// How long a telegram takes, learned as the hub learns it: the least of some.
#[derive(Default)]
struct Duration {
    known: Option<u64>,
    least: Option<u64>,
    counted: u32,
}

impl Duration {
    fn learn(&mut self, took: u64) {
        self.least = Some(self.least.map_or(took, |least| least.min(took)));
        self.counted += 1;
        if self.counted >= if self.known.is_none() { 3 } else { 16 } {
            *self = Duration { known: self.least.filter(|&least| least > 2 * LEAD), ..Duration::default() };
        }
    }
}

/// Rate at which the hub leaves the sensors.
const RATE: u32 = 500_000;
/// A telegram of 361 values.
const LENGTH: usize = 732;
/// The hub's lead, in ns.
const LEAD: u64 = 600_000;
/// Longer than the 3.2 ms within a telegram, shorter than the 8.8 ms after it, in ns.
const PAUSE: u64 = 6_000_000;
