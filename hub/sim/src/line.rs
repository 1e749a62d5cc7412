//! The thread of one port: paces the sensor by its deadlines, and puts what happens on the way between it and the host:
//! lost bytes, another rate at the host, nobody there, nobody reading. Keeps the truth of each telegram.

use std::os::fd::BorrowedFd;
use std::path::PathBuf;

use lms::{MILLIS, Nanos};
use schema::Failure;

use crate::ear::Arrival;
use crate::fault::{Fault, Loss};
use crate::machine::{Chunk, Machine, Part};
use crate::noise::Receiver;
use crate::pty::{Pty, Wake, now_ns};
use crate::truth::{Record, Summary};

/// A sensor on its line.
pub(crate) struct Line<'a> {
    /// The port as the user named it.
    pub(crate) port: PathBuf,
    pub(crate) pty: Pty,
    pub(crate) machine: Machine,
    pub(crate) loss: Loss,
    pub(crate) time: Time,
    /// Where the truth goes.
    pub(crate) tell: &'a (dyn Fn(&Record) -> Result<(), Failure> + Sync),
}

/// The machine's time: from 0 on, `speed` times as fast as the clock.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Time {
    pub(crate) zero_ns: Nanos,
    pub(crate) speed: f64,
}

impl Time {
    fn of_machine(self, clock_ns: Nanos) -> Nanos {
        (clock_ns.saturating_sub(self.zero_ns) as f64 * self.speed) as Nanos
    }

    fn of_clock(self, machine_ns: Nanos) -> Nanos {
        // One more nanosecond: a deadline must not lie before the time it stands for.
        self.zero_ns + (machine_ns as f64 / self.speed) as Nanos + 1
    }
}

/// What the line remembers between two chunks.
#[derive(Default)]
struct Way {
    is_open: bool,
    /// Of the telegram on the line.
    fault: Option<Fault>,
    /// The host's port at another rate: the rates, and what it makes of the line.
    garbled: Option<((u32, u32), Receiver)>,
    sent: u64,
}

impl Line<'_> {
    /// Runs until one of `stops` is readable.
    pub(crate) fn run(mut self, stops: [BorrowedFd<'_>; 2]) -> Result<Summary, Failure> {
        let mut way = Way::default();
        let mut buffer = [0; 64];
        // Before this time of the clock there was nothing to read.
        let mut quiet_ns = now_ns();
        loop {
            let was_open = std::mem::replace(&mut way.is_open, self.pty.is_open());
            if was_open && !way.is_open {
                self.pty.clean_up_after_close();
            }
            let read_ns = now_ns();
            let count = self.pty.read(&mut buffer)?;
            let now_ns = now_ns();
            self.slip(now_ns);
            while let Some(chunk) = self.machine.poll_transmit(self.time.of_machine(now_ns)) {
                self.hand_over(chunk, &mut way)?;
            }
            if count > 0 && same_rate(self.pty.rate(), self.machine.baud().rate()) {
                let arrival = Arrival {
                    not_before: self.time.of_machine(quiet_ns.saturating_sub(PTY_DELAY_NS)),
                    not_after: self.time.of_machine(now_ns),
                };
                for &byte in &buffer[..count] {
                    self.machine.receive(byte, arrival);
                }
            }
            if count == 0 {
                quiet_ns = read_ns;
            }
            let due_ns = self.machine.poll_timeout().map_or(Nanos::MAX, |at| self.time.of_clock(at));
            let look_ns = now_ns + LOOK_NS;
            if self.pty.wait(stops, way.is_open, due_ns.min(look_ns)) == Wake::Stop {
                let eeprom_writes = self.machine.eeprom_writes();
                return Ok(Summary { port: self.port, sent: way.sent, eeprom_writes });
            }
        }
    }

    /// A line never brings more at once than it carries: where this thread was kept from running for long, the
    /// sensor's time stood still too.
    fn slip(&mut self, now_ns: Nanos) {
        let Some(due_ns) = self.machine.poll_timeout() else { return };
        let latest_ns = self.time.of_clock(due_ns + MOST_LATE_NS);
        self.time.zero_ns += now_ns.saturating_sub(latest_ns);
    }

    fn hand_over(&mut self, mut chunk: Chunk, way: &mut Way) -> Result<(), Failure> {
        let mut fault = self.loss.apply(&mut chunk.bytes).then_some(Fault::Loss);
        if way.is_open {
            let rates = (chunk.baud.rate(), self.pty.rate());
            if same_rate(rates.1, rates.0) {
                way.garbled = None;
            } else {
                fault = fault.or(Some(Fault::Baud));
                chunk.bytes = way.garble(rates, &chunk);
            }
            if !self.pty.write(&chunk.bytes)? {
                fault = fault.or(Some(Fault::Overrun));
            }
        } else {
            fault = fault.or(Some(Fault::Unread));
        }
        // Before the hash, which takes longer than a host that waits for this byte.
        let sent_ns = now_ns();
        way.fault = way.fault.or(fault);
        match chunk.part {
            Part::Telegram => {}
            Part::Acknowledge => way.fault = None,
            Part::End(sent) => {
                let fault = if sent.aborted { Some(Fault::Aborted) } else { way.fault };
                (self.tell)(&Record {
                    port: self.port.clone(),
                    index: way.sent,
                    is_reply: sent.is_reply,
                    length: sent.telegram.len(),
                    sha256: Record::hash(&sent.telegram),
                    sent_ns,
                    fault,
                })?;
                way.sent += 1;
                way.fault = None;
            }
        }
        Ok(())
    }
}

impl Way {
    /// What a port at the second of `rates` makes of a chunk sent at the first.
    fn garble(&mut self, rates: (u32, u32), chunk: &Chunk) -> Vec<u8> {
        if self.garbled.as_ref().is_none_or(|(known, _)| *known != rates) {
            self.garbled = Some((rates, Receiver::new(rates.0, rates.1)));
        }
        self.garbled
            .as_mut()
            .map_or(Vec::new(), |(_, receiver)| receiver.receive(&chunk.bytes, chunk.idle_after))
    }
}

/// Whether a UART at `a` bits per second understands one at `b`: within 3 %.
fn same_rate(a: u32, b: u32) -> bool {
    u64::from(a.abs_diff(b)) * 100 <= 3 * u64::from(b)
}

/// How late the sensor may be, in its own time: 5 kB at its highest rate, a quarter of what a pty holds.
const MOST_LATE_NS: Nanos = 100 * MILLIS;
/// A byte may lie in the kernel for so long before it can be read: a worker thread carries it over.
const PTY_DELAY_NS: Nanos = 2 * MILLIS;
/// How often the port is looked at even if nothing happens: nothing announces that it was opened, and how well it is
/// known when a byte came depends on it. At 9600, where every host begins, this proves that a request was written
/// without gaps.
const LOOK_NS: Nanos = 4 * MILLIS;
