//! The floor of a start: a host that knows at which rate the sensor is, says what has to be said, and waits for the
//! first scan. No search, no retry but for a request that was dropped, no shared memory.

use std::path::Path;

use lms::command::Request;
use lms::framer::{Found, Framer};
use lms::variant::Baud;

use super::line::Line;
use super::{Outcome, clock};

/// Starts the sensor at `port`, which is at `rate`, as a hub would that knew that; prints when its stream was promised and
/// when its first scan was there.
pub(crate) fn start(port: &Path, rate: u32) -> Outcome<()> {
    stream(port, rate, &[Request::Status], &[Request::Type, Request::Configuration])
}

/// The same without a question: the least that can be said.
pub(crate) fn start_blindly(port: &Path, rate: u32) -> Outcome<()> {
    stream(port, rate, &[], &[])
}

fn stream(port: &Path, rate: u32, before: &[Request], after: &[Request]) -> Outcome<()> {
    let mut host = Host { line: Line::open(port, rate)?, framer: Framer::default(), rate };
    before.iter().try_for_each(|&request| host.ask(request))?;
    if rate != STREAM.rate() {
        host.ask(Request::Baud(STREAM))?;
        host.line.set_rate(STREAM.rate())?;
        host.rate = STREAM.rate();
        clock::rest(clock::now() + SETTLE);
    }
    after.iter().chain(&[Request::Stream]).try_for_each(|&request| host.ask(request))?;
    println!("streaming {}", clock::now());
    host.hear(lms::measured::MEASURED, clock::now() + PATIENCE)?.then_some(()).ok_or("no scan")?;
    println!("scan {}", clock::now());
    Ok(())
}

struct Host {
    line: Line,
    framer: Framer,
    rate: u32,
}

impl Host {
    /// Says `request` until it is answered.
    fn ask(&mut self, request: Request) -> Outcome<()> {
        for _ in 0..TRIES {
            let byte_time = lms::line_time(1, self.rate) + GAP;
            for &byte in request.encode(0).bytes() {
                let next = clock::now() + byte_time;
                self.line.write(byte)?;
                clock::rest(next);
            }
            if self.hear(request.command() | lms::telegram::REPLY, clock::now() + REPLY_PATIENCE)? {
                return Ok(());
            }
        }
        Err(format!("no answer to {request:?}").into())
    }

    /// Whether a telegram with `command` comes until `until`.
    fn hear(&mut self, command: u8, until: u64) -> Outcome<bool> {
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
/// Between two bytes of a request, in ns: the sensor wants at least 55 us.
const GAP: u64 = 80_000;
/// After a change of rate, in ns, as in the hub.
const SETTLE: u64 = 20_000_000;
/// A reply takes less, in ns.
const REPLY_PATIENCE: u64 = 300_000_000;
/// The first scan takes less, in ns.
const PATIENCE: u64 = 2_000_000_000;
const TRIES: u32 = 10;
