//! Minimal programs with which the hub is compared.
//!
//! [`run_baseline`] acts like a hub that only streams. It makes the system calls that are necessary to read a telegram
//! late from a pty, and wakes a sleeping process once per telegram. It has no framing, no CRC, no counters and no
//! shared memory. It takes the next 732 bytes after a pause for a telegram. This pause is longer than any pause within
//! a telegram.
//!
//! [`start_scanner`] acts like a hub that only starts a scanner and has the scanner's rate from the beginning. It sends
//! the necessary requests and waits for the first scan. It does not search, and repeats a request only if no reply
//! arrives.

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
use scanhub_drivers::lms::framer::{Framer, FramerEvent};
use scanhub_drivers::lms::variant::Baud;

use super::environment::GuardedProcess;
use super::{Outcome, PART_WORD, clock, truth};

/// Reads `count` telegrams (0: forever) from each of `ports` in a separate thread, and wakes one process per port. Each
/// thread wakes up `wake_ahead_ns` nanoseconds before the expected end of a telegram. If `wake_ahead_ns` is 0, it wakes
/// up as long before the end as the hub does. First prints `ready`. At the end, prints the hash of each telegram and
/// the time at which the telegram was read.
pub(crate) fn run_baseline(ports: &[&str], count: usize, wake_ahead_ns: u64) -> Outcome<()> {
    let mut sleepers = Vec::new();
    let mut ends = Vec::new();
    for (number, port) in ports.iter().enumerate() {
        let wake = eventfd(0, EventfdFlags::CLOEXEC)?;
        sleepers.push(start_sleeper(number, count, wake.try_clone()?)?);
        ends.push((SerialLine::open(Path::new(port), BAUD_RATE)?, wake));
    }
    println!("ready");
    let threads: Vec<_> = ends
        .into_iter()
        .map(|(line, wake)| thread::spawn(move || read_or_end(&line, &wake, count, wake_ahead_ns)))
        .collect();
    for (number, thread) in threads.into_iter().enumerate() {
        let telegrams = thread.join().map_err(|_| "a reader panicked")?;
        for (telegram, at) in telegrams {
            println!("read {number} {} {at}", truth::hash(&telegram));
        }
    }
    sleepers.into_iter().try_for_each(GuardedProcess::wait)?;
    println!("end");
    Ok(())
}

/// Sleeps on the eventfd that is its stdin until `count` telegrams were reported (0: forever). Then prints the time of
/// each wake-up. If `count` is 0, prints only the time of the first wake-up, at once.
pub(crate) fn run_sleeper(number: &str, count: usize) -> Outcome<()> {
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

/// Starts a process that runs [`run_sleeper`] on `wake` until `count` wake-ups have arrived.
pub(crate) fn start_sleeper(number: usize, count: usize, wake: OwnedFd) -> Outcome<GuardedProcess> {
    let words = [PART_WORD, "sleeper", &number.to_string(), &count.to_string()].map(String::from);
    let process = Command::new(std::env::current_exe()?).args(words).stdin(Stdio::from(wake)).spawn()?;
    Ok(GuardedProcess::new(process))
}

/// Reads the telegrams of one line. Ends the whole process on an error, because the load of the baseline would be too
/// low without one of its readers.
fn read_or_end(
    line: &SerialLine,
    wake: &OwnedFd,
    count: usize,
    wake_ahead_ns: u64,
) -> Vec<([u8; TELEGRAM_LEN], u64)> {
    read(line, wake, count, wake_ahead_ns).unwrap_or_else(|error| {
        eprintln!("baseline: {error}");
        std::process::exit(1)
    })
}

/// Runs the read loop. Returns each telegram with the time at which it was complete. The loop stores a telegram only
/// after it has woken the process, in the pause before the next telegram.
fn read(
    line: &SerialLine,
    wake: impl AsFd,
    count: usize,
    wake_ahead_ns: u64,
) -> Result<Vec<([u8; TELEGRAM_LEN], u64)>, String> {
    let words = |error: Box<dyn std::error::Error>| error.to_string();
    line.wait_for_pause(TELEGRAM_PAUSE_NS).map_err(words)?;
    let mut telegrams = Vec::with_capacity(count);
    let mut own_lead = lms::WakeLead::default();
    let mut duration = TelegramDuration::default();
    let mut telegram = [0; TELEGRAM_LEN];
    while count == 0 || telegrams.len() < count {
        let mut filled = 0;
        let mut first = 0;
        let mut reads_near_end = 0;
        while filled < TELEGRAM_LEN {
            clock::readable(line, None).map_err(|error| error.to_string())?;
            let len = line.read(&mut telegram[filled..]).map_err(words)?;
            let fresh = filled == 0 && len > 0;
            filled += len;
            reads_near_end += u32::from(reads_near_end > 0 && len > 0);
            if fresh {
                first = clock::now();
                if let Some(duration) = duration.duration_ns.filter(|_| filled < TELEGRAM_LEN) {
                    clock::sleep_until(
                        first + duration - if wake_ahead_ns > 0 { wake_ahead_ns } else { own_lead.nanos() },
                    );
                    // Read without a call of `poll`, because the bytes have certainly arrived. The hub does the same.
                    filled += line.read(&mut telegram[filled..]).map_err(words)?;
                    reads_near_end = 1;
                }
            }
        }
        let last = clock::now();
        if telegram[0] != lms::telegram::STX {
            // The pause was within a telegram, because the sender was not scheduled. Wait for the next pause.
            line.wait_for_pause(TELEGRAM_PAUSE_NS).map_err(words)?;
            continue;
        }
        rustix::io::write(&wake, &1u64.to_ne_bytes()).map_err(|error| error.to_string())?;
        duration.learn(last - first);
        if reads_near_end > 0 {
            own_lead.adapt(reads_near_end);
        }
        if count > 0 {
            telegrams.push((telegram, last));
        }
    }
    Ok(telegrams)
}

/// Time from the start to the end of a telegram on the line. As in the hub, the estimate is the minimum of several
/// measured times.
#[derive(Default)]
struct TelegramDuration {
    duration_ns: Option<u64>,
    minimum: Option<u64>,
    counted: u32,
}

impl TelegramDuration {
    fn learn(&mut self, duration_ns: u64) {
        self.minimum = Some(self.minimum.map_or(duration_ns, |minimum| minimum.min(duration_ns)));
        self.counted += 1;
        if self.counted >= if self.duration_ns.is_none() { 3 } else { 16 } {
            *self = TelegramDuration {
                duration_ns: self.minimum.filter(|&minimum| minimum > 2 * WAKE_AHEAD_NS),
                ..TelegramDuration::default()
            };
        }
    }
}

/// Baud rate that the hub uses.
const BAUD_RATE: u32 = 500_000;
/// Length of a telegram of 361 beams, in bytes.
const TELEGRAM_LEN: usize = 732;
/// Time before the expected end of a telegram at which the baseline wakes up, in nanoseconds. The hub adapts this time
/// to the machine. For the baseline, it is constant, so that ratios can be compared with those of earlier measurements.
pub(crate) const WAKE_AHEAD_NS: u64 = 600_000;
/// Minimum pause that ends a telegram, in nanoseconds. It is longer than the pause of 3.2 ms within a telegram, and
/// shorter than the pause of 8.8 ms after a telegram.
const TELEGRAM_PAUSE_NS: u64 = 6_000_000;

/// Starts the scanner at `port`, whose baud rate is `rate`, like a hub that has this rate from the beginning. Prints
/// the time at which the scanner had confirmed the stream, and the time at which the first scan had arrived.
pub(crate) fn start_scanner(port: &Path, rate: u32) -> Outcome<()> {
    stream(port, rate, &[Request::Status], &[Request::Type, Request::Configuration])
}

/// Starts the scanner like [`start_scanner`], but sends no requests for information. This is the shortest possible
/// dialog.
pub(crate) fn start_scanner_unchecked(port: &Path, rate: u32) -> Outcome<()> {
    stream(port, rate, &[], &[])
}

fn stream(port: &Path, rate: u32, before: &[Request], after: &[Request]) -> Outcome<()> {
    let mut host = LmsHost { line: SerialLine::open(port, rate)?, framer: Framer::default(), rate };
    before.iter().try_for_each(|&request| host.request(request))?;
    if rate != STREAM_BAUD.rate() {
        host.request(Request::Baud(STREAM_BAUD))?;
        host.line.set_rate(STREAM_BAUD.rate())?;
        host.rate = STREAM_BAUD.rate();
        clock::sleep_until(clock::now() + SETTLE_TIME_NS);
    }
    after.iter().chain(&[Request::Stream]).try_for_each(|&request| host.request(request))?;
    println!("streaming {}", clock::now());
    host.receive(lms::measured::MEASURED, clock::now() + SCAN_TIMEOUT)?.then_some(()).ok_or("no scan")?;
    println!("scan {}", clock::now());
    Ok(())
}

struct LmsHost {
    line: SerialLine,
    framer: Framer,
    rate: u32,
}

impl LmsHost {
    /// Sends `request` until the scanner replies.
    fn request(&mut self, request: Request) -> Outcome<()> {
        for _ in 0..MAX_TRIES {
            let byte_time = scanhub_schema::line_time(1, self.rate) + BYTE_GAP_NS;
            for &byte in request.encode(0).bytes() {
                let next = clock::now() + byte_time;
                self.line.write(byte)?;
                clock::sleep_until(next);
            }
            if self.receive(request.command() | lms::telegram::REPLY, clock::now() + REPLY_TIMEOUT)? {
                return Ok(());
            }
        }
        Err(format!("no reply to {request:?}").into())
    }

    /// Waits for a telegram with `command` until `until`, and returns whether it arrived.
    fn receive(&mut self, command: u8, until: u64) -> Outcome<bool> {
        loop {
            while let Some(found) = self.framer.poll() {
                if let FramerEvent::Telegram(framed) = found
                    && framed.telegram.command() == command
                {
                    return Ok(true);
                }
            }
            let end = self.framer.hold_time().map_or(until, |hold| until.min(clock::now() + hold));
            if clock::readable(&self.line, Some(end))? {
                let len = self.line.read(self.framer.read_buffer())?;
                self.framer.commit(len);
            } else if clock::now() >= until {
                return Ok(false);
            } else {
                self.framer.release(lms::framer::VETO_HOLD_TIME);
            }
        }
    }
}

const STREAM_BAUD: Baud = Baud::B500000;
/// Pause between two bytes of a request, in nanoseconds. The scanner needs at least 55 us.
const BYTE_GAP_NS: u64 = 80_000;
/// Pause after a change of the baud rate, in nanoseconds. It is as long as in the hub.
const SETTLE_TIME_NS: u64 = 20_000_000;
/// Timeout of a reply, in nanoseconds.
const REPLY_TIMEOUT: u64 = 300_000_000;
/// Timeout of the first scan, in nanoseconds.
const SCAN_TIMEOUT: u64 = 2_000_000_000;
const MAX_TRIES: u32 = 10;

/// An open serial line. Its functions make only the necessary system calls.
pub(crate) struct SerialLine(OwnedFd);

impl SerialLine {
    /// Opens the line at `path` in raw mode, at `rate` baud.
    pub(crate) fn open(path: &Path, rate: u32) -> Outcome<SerialLine> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let line = SerialLine(open(path, flags, Mode::empty())?);
        line.set_rate(rate)?;
        Ok(line)
    }

    /// Sets the baud rate.
    pub(crate) fn set_rate(&self, rate: u32) -> Outcome<()> {
        let mut termios = tcgetattr(&self.0)?;
        termios.make_raw();
        termios.set_speed(rate)?;
        Ok(tcsetattr(&self.0, OptionalActions::Now, &termios)?)
    }

    /// Reads the bytes that have arrived. Returns the number of bytes, which is 0 if none have arrived.
    pub(crate) fn read(&self, buffer: &mut [u8]) -> Outcome<usize> {
        match rustix::io::read(&self.0, buffer) {
            Ok(0) => Err("the line was closed".into()),
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
    pub(crate) fn wait_for_pause(&self, pause: u64) -> Outcome<()> {
        let mut buffer = [0; 1024];
        while clock::readable(self, Some(clock::now() + pause))? {
            self.read(&mut buffer)?;
        }
        Ok(())
    }
}

impl AsFd for SerialLine {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}
