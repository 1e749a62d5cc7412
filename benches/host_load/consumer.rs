//! Consumers, each a process that follows both sensors with a thread for each: of raw bytes, of datagrams, of the hub's
//! scans, of its results. Every few scans they say how many they have had, so that a load is never that of consumers who
//! fell behind.

use std::hint::black_box;
use std::path::Path;
use std::thread;

use lms::telegram::Telegram;
use lms::variant::Unit;
use rustix::fs::{OFlags, fcntl_setfl};
use schema::{Foreground, Scan, Zones};

use crate::line::account::Parser;
use crate::rivals::Discarding;
use crate::support::consumer::subscribe;
use crate::support::line::Line;
use crate::support::stage::SENSORS;
use crate::support::{Outcome, clock};
use crate::unit;
use crate::work::Work;

/// Reads two serial lines, at most `most` bytes at once, by the plainest of programs: a thread for each line sleeps in
/// `read`, so that there is no call beside that one, and finds telegrams with six states. One byte is what programs for
/// a UART of 16 bytes do; more than 16 are never there.
pub(crate) fn bytes(ports: [&str; 2], most: usize) -> Outcome<()> {
    for_both(|number, progress| {
        let line = Line::open(Path::new(ports[number]), RATE)?;
        fcntl_setfl(&line, OFlags::RDWR)?;
        let header = lms::measured::encode(0, Unit::Mm, &[0; BEAMS], 0x10).bytes()[..7].try_into()?;
        let (mut parser, mut work, mut bytes) = (Discarding::new(header), Work::new(), vec![0; most]);
        loop {
            let len = line.read(&mut bytes)?;
            parser.read(&bytes[..len], &mut |accepted| {
                if Telegram::check(accepted.bytes).is_some_and(|telegram| work.take(telegram)) {
                    progress.note();
                }
            });
        }
    })
}

/// Receives the bare telegrams of a unit at `port` for the first sensor, and the next one for the second.
pub(crate) fn datagrams(port: u16) -> Outcome<()> {
    for_both(|number, progress| {
        let (ear, mut work) = (unit::ear(port + number as u16)?, Work::new());
        let mut datagram = [0; 2048];
        loop {
            let len = ear.recv(&mut datagram)?;
            if Telegram::check(&datagram[..len]).is_some_and(|telegram| work.take(telegram)) {
                progress.note();
            }
        }
    })
}

/// Follows the hub's scans and looks at every range.
pub(crate) fn scans(domain: &str) -> Outcome<()> {
    for_both(|number, progress| {
        let mut scans = subscribe::<Scan>(domain, SENSORS[number])?;
        loop {
            let Some(scan) = scans.next()? else { continue };
            black_box(scan.ranges().iter().map(|&range| u32::from(range)).sum::<u32>());
            progress.note();
        }
    })
}

/// Follows the hub's verdicts and what stands before the background, and looks at both.
pub(crate) fn results(domain: &str) -> Outcome<()> {
    for_both(|number, progress| {
        let mut foreground = subscribe::<Foreground>(domain, SENSORS[number])?;
        let mut zones = subscribe::<Zones>(domain, SENSORS[number])?;
        loop {
            let Some(foreground) = foreground.next()? else { continue };
            black_box((foreground.beams, foreground.segments().len()));
            // Those of the same scan, and what was said of silences before.
            while let Some(zones) = zones.try_next()? {
                black_box((zones.verdict(), zones.nearest()));
                if zones.header().seq >= foreground.header().seq {
                    break;
                }
            }
            progress.note();
        }
    })
}

/// Runs `follow` for both sensors; it ends only by an error.
fn for_both(follow: impl Fn(usize, &mut Progress) -> Outcome<()> + Sync) -> Outcome<()> {
    let follow_or_end = |number: usize| {
        let mut progress = Progress { sensor: SENSORS[number], count: 0 };
        if let Err(error) = follow(number, &mut progress) {
            eprintln!("consumer of {}: {error}", SENSORS[number]);
            std::process::exit(1);
        }
    };
    thread::scope(|scope| {
        scope.spawn(|| follow_or_end(1));
        follow_or_end(0);
    });
    Ok(())
}

/// How many scans of a sensor a consumer has had.
struct Progress {
    sensor: &'static str,
    count: u64,
}

impl Progress {
    /// One more. Now and then says so: `had SENSOR COUNT NS`.
    fn note(&mut self) {
        self.count += 1;
        if self.count.is_multiple_of(SAID_EVERY) {
            println!("had {} {} {}", self.sensor, self.count, clock::now());
        }
    }
}

/// Beams of a scan of 180 degrees in halves.
const BEAMS: usize = 361;
/// The simulated sensors stream at this rate.
const RATE: u32 = 500_000;
/// Somewhat less than a second.
const SAID_EVERY: u64 = 32;
