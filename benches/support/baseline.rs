//! Minimal programs that the hub is compared with.
//!
//! [`chain`] is a hub that only streams: the system calls that a late reader of a pty cannot avoid, and one wake-up of
//! a sleeping process per telegram. No framing, no CRC, no counters, no shared memory. A telegram is the next 732 bytes
//! after a pause that is longer than the one within a telegram.
//!
//! [`start`] is a hub that only starts a scanner whose rate it knows: it sends the requests and waits for the first
//! scan. It does not search, and repeats a request only if it was lost.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;

use rustix::event::{EventfdFlags, eventfd};
use rustix::fs::{Mode, OFlags, open};
use rustix::io::Errno;
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use scanhub_drivers::lms;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::framer::{Found, Framer};
use scanhub_drivers::lms::variant::Baud;

use super::stage::Guard;
use super::{Outcome, PART, clock, truth};

/// Reads `count` telegrams (0: forever) from each of `ports` in a separate thread, and wakes one process per port. It
/// wakes up `lead` nanoseconds before the expected end of a telegram, or, with 0, as long before it as the hub does. The
/// first line says that it is up; at the end it prints the hash of each telegram and when it was read.
pub(crate) fn chain(ports: &[&str], count: usize, lead: u64) -> Outcome<()> {
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
        .map(|(line, wake)| thread::spawn(move || read_or_end(&line, &wake, count, lead)))
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

/// Sleeps on the eventfd that is its stdin until `count` telegrams were reported (0: forever), and then prints the time
/// of each wake-up. With 0 it prints the first one at once.
pub(crate) fn sleeper(number: &str, count: usize) -> Outcome<()> {
    let wake = rustix::stdio::stdin();
    let mut times = Vec::with_capacity(count);
    let mut is_reported = false;
    while count == 0 || times.len() < count {
        if clock::readable(wake, None)? {
            let mut count_read = [0; 8];
            rustix::io::read(wake, &mut count_read)?;
            let now = clock::now();
            if count == 0 && !std::mem::replace(&mut is_reported, true) {
                println!("woken {number} {now}");
            }
            times.extend((0..u64::from_ne_bytes(count_read)).map(|_| now).take(count));
        }
    }
    times.iter().for_each(|time| println!("woken {number} {time}"));
    Ok(())
}

/// Starts a process that sleeps on `wake` until `count` wake-ups have arrived, see [`sleeper`].
pub(crate) fn start_sleeper(number: usize, count: usize, wake: OwnedFd) -> Outcome<Guard> {
    let words = [PART, "sleeper", &number.to_string(), &count.to_string()].map(String::from);
    let process = Command::new(std::env::current_exe()?).args(words).stdin(Stdio::from(wake)).spawn()?;
    Ok(Guard::new(process))
}

/// Reads, and ends the whole process on an error: with one reader less, the baseline would be too low.
fn read_or_end(line: &Line, wake: &OwnedFd, count: usize, lead: u64) -> Vec<([u8; LENGTH], u64)> {
    read(line, wake, count, lead).unwrap_or_else(|error| {
        eprintln!("baseline: {error}");
        std::process::exit(1)
    })
}

/// The read loop. What it keeps of each telegram, it keeps after the wake-up, in the pause before the next telegram.
fn read(line: &Line, wake: impl AsFd, count: usize, lead: u64) -> Result<Vec<([u8; LENGTH], u64)>, String> {
    let words = |error: Box<dyn std::error::Error>| error.to_string();
    line.await_pause(PAUSE).map_err(words)?;
    let mut kept = Vec::with_capacity(count);
    let mut own_lead = lms::Lead::default();
    let mut duration = TelegramDuration::default();
    let mut telegram = [0; LENGTH];
    while count == 0 || kept.len() < count {
        let mut filled = 0;
        let mut first = 0;
        let mut reads_near_end = 0;
        while filled < LENGTH {
            clock::readable(line, None).map_err(|error| error.to_string())?;
            let len = line.read(&mut telegram[filled..]).map_err(words)?;
            let fresh = filled == 0 && len > 0;
            filled += len;
            reads_near_end += u32::from(reads_near_end > 0 && len > 0);
            if fresh {
                first = clock::now();
                if let Some(duration) = duration.known.filter(|_| filled < LENGTH) {
                    clock::rest(first + duration - if lead > 0 { lead } else { own_lead.nanos() });
                    // As in the hub: bytes have certainly arrived, so there is no need to poll.
                    filled += line.read(&mut telegram[filled..]).map_err(words)?;
                    reads_near_end = 1;
                }
            }
        }
        let last = clock::now();
        if telegram[0] != lms::telegram::STX {
            // The pause was not the one between two telegrams: the sender was descheduled.
            line.await_pause(PAUSE).map_err(words)?;
            continue;
        }
        rustix::io::write(&wake, &1u64.to_ne_bytes()).map_err(|error| error.to_string())?;
        duration.learn(last - first);
        if reads_near_end > 0 {
            own_lead.adapt(reads_near_end);
        }
        if count > 0 {
            kept.push((telegram, last));
        }
    }
    Ok(kept)
}

/// Duration of a telegram, estimated like in the hub: the minimum of several.
#[derive(Default)]
struct TelegramDuration {
    known: Option<u64>,
    minimum: Option<u64>,
    counted: u32,
}

impl TelegramDuration {
    fn learn(&mut self, took: u64) {
        self.minimum = Some(self.minimum.map_or(took, |minimum| minimum.min(took)));
        self.counted += 1;
        if self.counted >= if self.known.is_none() { 3 } else { 16 } {
            *self = TelegramDuration {
                known: self.minimum.filter(|&minimum| minimum > 2 * LEAD),
                ..TelegramDuration::default()
            };
        }
    }
}

/// Baud rate that the hub sets.
const RATE: u32 = 500_000;
/// Length of a telegram of 361 beams, in bytes.
const LENGTH: usize = 732;
/// Time before the expected end of a telegram at which the baseline wakes up, in ns. The hub learns its
/// own; this one stays as it is, so that ratios can be compared with earlier ones.
pub(crate) const LEAD: u64 = 600_000;
/// Longer than the 3.2 ms within a telegram and shorter than the 8.8 ms after it, in ns.
const PAUSE: u64 = 6_000_000;

/// Starts the scanner at `port`, which is at `rate`, as a hub that knew the rate would. Prints when the scanner
/// confirmed the stream and when the first scan had arrived.
pub(crate) fn start(port: &Path, rate: u32) -> Outcome<()> {
    stream(port, rate, &[Request::Status], &[Request::Type, Request::Configuration])
}

/// Does the same without any request for information: the shortest possible dialog.
pub(crate) fn start_blindly(port: &Path, rate: u32) -> Outcome<()> {
    stream(port, rate, &[], &[])
}

fn stream(port: &Path, rate: u32, before: &[Request], after: &[Request]) -> Outcome<()> {
    let mut host = Host { line: Line::open(port, rate)?, framer: Framer::default(), rate };
    before.iter().try_for_each(|&request| host.request(request))?;
    if rate != STREAM.rate() {
        host.request(Request::Baud(STREAM))?;
        host.line.set_rate(STREAM.rate())?;
        host.rate = STREAM.rate();
        clock::rest(clock::now() + SETTLE);
    }
    after.iter().chain(&[Request::Stream]).try_for_each(|&request| host.request(request))?;
    println!("streaming {}", clock::now());
    host.receive(lms::measured::MEASURED, clock::now() + SCAN_TIMEOUT)?.then_some(()).ok_or("no scan")?;
    println!("scan {}", clock::now());
    Ok(())
}

struct Host {
    line: Line,
    framer: Framer,
    rate: u32,
}

impl Host {
    /// Sends `request` until the scanner replies.
    fn request(&mut self, request: Request) -> Outcome<()> {
        for _ in 0..TRIES {
            let byte_time = scanhub_schema::line_time(1, self.rate) + GAP;
            for &byte in request.encode(0).bytes() {
                let next = clock::now() + byte_time;
                self.line.write(byte)?;
                clock::rest(next);
            }
            if self.receive(request.command() | lms::telegram::REPLY, clock::now() + REPLY_TIMEOUT)? {
                return Ok(());
            }
        }
        Err(format!("no answer to {request:?}").into())
    }

    /// Returns whether a telegram with `command` arrives before `until`.
    fn receive(&mut self, command: u8, until: u64) -> Outcome<bool> {
        loop {
            while let Some(found) = self.framer.poll() {
                if let Found::Telegram(framed) = found
                    && framed.telegram.command() == command
                {
                    return Ok(true);
                }
            }
            let end = self.framer.hold().map_or(until, |hold| until.min(clock::now() + hold));
            if clock::readable(&self.line, Some(end))? {
                let len = self.line.read(self.framer.spare())?;
                self.framer.commit(len);
            } else if clock::now() >= until {
                return Ok(false);
            } else {
                self.framer.release(lms::framer::VETO_HOLD);
            }
        }
    }
}

const STREAM: Baud = Baud::B500000;
/// Gap between two bytes of a request, in ns. The scanner needs at least 55 us.
const GAP: u64 = 80_000;
/// Pause after a change of the rate, in ns, as in the hub.
const SETTLE: u64 = 20_000_000;
/// Timeout of a reply, in ns.
const REPLY_TIMEOUT: u64 = 300_000_000;
/// Timeout of the first scan, in ns.
const SCAN_TIMEOUT: u64 = 2_000_000_000;
const TRIES: u32 = 10;

/// An open line, without any system call that is not needed.
pub(crate) struct Line(OwnedFd);

impl Line {
    /// Opens the line at `path`, raw, at `rate` bits per second.
    pub(crate) fn open(path: &Path, rate: u32) -> Outcome<Line> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let line = Line(open(path, flags, Mode::empty())?);
        line.set_rate(rate)?;
        Ok(line)
    }

    /// Sets the rate.
    pub(crate) fn set_rate(&self, rate: u32) -> Outcome<()> {
        let mut termios = tcgetattr(&self.0)?;
        termios.make_raw();
        termios.set_speed(rate)?;
        Ok(tcsetattr(&self.0, OptionalActions::Now, &termios)?)
    }

    /// Reads the bytes that have arrived; returns 0 if there are none.
    pub(crate) fn read(&self, buffer: &mut [u8]) -> Outcome<usize> {
        match rustix::io::read(&self.0, buffer) {
            Ok(0) => Err("the line is gone".into()),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            other => Ok(other?),
        }
    }

    /// Writes one byte.
    pub(crate) fn write(&self, byte: u8) -> Outcome<()> {
        rustix::io::write(&self.0, &[byte])?;
        Ok(())
    }

    /// Discards bytes until none has arrived for `pause` nanoseconds.
    pub(crate) fn await_pause(&self, pause: u64) -> Outcome<()> {
        let mut buffer = [0; 1024];
        while clock::readable(self, Some(clock::now() + pause))? {
            self.read(&mut buffer)?;
        }
        Ok(())
    }
}

impl AsFd for Line {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}
