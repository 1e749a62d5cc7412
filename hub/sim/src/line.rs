//! The thread of one port: paces sensor and line by their deadlines, and adds what happens at the host's port: another
//! rate, nobody there, nobody reading, unplugged. Keeps the truth of each telegram.

use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};

use schema::{Failure, MILLIS, Nanos};

use crate::device::{Device, Part};
use crate::fault::{Fault, Faults};
use crate::mount::{Encoder, Report};
use crate::noise::Mistuned;
use crate::pty::{Wake, now_ns, wait};
use crate::request_decoder::Arrival;
use crate::socket::Socket;
use crate::truth::{Record, Summary};
use crate::wire::{Carried, Wire};

/// A sensor on its line.
pub(crate) struct Line<'a> {
    /// Of the port, from 0.
    pub(crate) number: usize,
    /// The port as the user named it, of a server as it is found.
    pub(crate) port: PathBuf,
    /// What is there to be opened; nothing while the adapter is unplugged.
    pub(crate) socket: Option<Socket>,
    pub(crate) machine: Box<dyn Device + Send>,
    pub(crate) wire: Wire,
    pub(crate) time: Time,
    /// Where the truth goes.
    pub(crate) tell: &'a (dyn Fn(&Record) -> Result<(), Failure> + Sync),
    /// What is done to it next from outside, if anything.
    pub(crate) event: &'a (dyn Fn(&Path) -> Option<Event> + Sync),
    /// What says how its mount stands, if it has one; reports have times of the clock.
    pub(crate) encoder: Option<Encoder>,
    /// Where that goes.
    pub(crate) say: &'a (dyn Fn(usize, Report) + Sync),
    /// Whether bytes wait while the host's buffer is full. Otherwise they are lost, as in a UART that no program reads.
    pub(crate) lossless: bool,
}

/// Something that is done to a simulated sensor from outside while it runs.
#[derive(Clone, Debug)]
pub enum Event {
    /// Its power goes off and on.
    PowerCycle,
    /// The host's adapter is pulled out for so long, in nanoseconds; then it is another terminal under the same name.
    Unplug(Nanos),
    /// The line does this to bytes from now on, with random numbers of this seed; times count from now.
    Faults(Box<Faults>, u64),
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
    /// The host's port, where it runs at another rate.
    mistuned: Mistuned,
    sent: u64,
    /// Bytes that wait for room in the host's buffer; only on a lossless line.
    held: Vec<u8>,
}

impl Line<'_> {
    /// Runs until one of `stops` is readable.
    pub(crate) fn run(mut self, stops: [BorrowedFd<'_>; 2]) -> Result<Summary, Failure> {
        let mut way = Way::default();
        let mut buffer = [0; 64];
        // Before this time of the clock there was nothing to read.
        let mut quiet_ns = now_ns();
        loop {
            let read_ns = now_ns();
            let count = self.look(&mut way, &mut buffer)?;
            let now_ns = now_ns();
            self.slip(now_ns);
            let machine_ns = self.time.of_machine(now_ns);
            while let Some(event) = (self.event)(&self.port) {
                self.suffer(event, machine_ns);
            }
            while let Some(report) = self.encoder.as_mut().and_then(|encoder| encoder.poll(machine_ns)) {
                let [stamp_ns, arrives_ns] =
                    [report.stamp_ns, report.arrives_ns].map(|at| self.time.of_clock(at));
                let rate_rad_s = report.rate_rad_s * self.time.speed;
                (self.say)(self.number, Report { stamp_ns, arrives_ns, rate_rad_s, ..report });
            }
            while let Some(carried) = self.wire.poll_transmit(&mut *self.machine, machine_ns) {
                self.hand_over(carried, &mut way)?;
            }
            if self.wait_for_room(&mut way, stops)? == Wake::Stop {
                return Ok(self.summary(&way));
            }
            if count > 0 && self.is_tuned() {
                let arrival = Arrival {
                    not_before: self.time.of_machine(quiet_ns.saturating_sub(PTY_DELAY_NS)),
                    not_after: self.time.of_machine(now_ns),
                };
                for &byte in &buffer[..count] {
                    self.wire.receive(&mut *self.machine, byte, arrival);
                    if let Some(dropped) = self.machine.take_dropped() {
                        tracing::warn!("{}: {dropped}", self.port.display());
                    }
                }
            }
            if count == 0 {
                quiet_ns = read_ns;
            }
            if self.wire.is_plugged() != self.socket.is_some() {
                self.socket = None;
                way.is_open = false;
                self.socket = self.wire.is_plugged().then(|| Socket::new(&self.port)).transpose()?;
            }
            let due = self.wire.poll_timeout(&*self.machine, machine_ns);
            let due = due.into_iter().chain(self.encoder.as_ref().map(Encoder::poll_timeout)).min();
            let due_ns = due.map_or(Nanos::MAX, |at| self.time.of_clock(at));
            let look_ns = if self.socket.is_some() { now_ns + LOOK_NS } else { Nanos::MAX };
            let watched = self.socket.as_ref().and_then(|socket| socket.waits_for(way.is_open));
            if wait(stops, watched, due_ns.min(look_ns)) == Wake::Stop {
                return Ok(self.summary(&way));
            }
        }
    }

    fn summary(self, way: &Way) -> Summary {
        Summary { eeprom_writes: self.machine.eeprom_writes(), port: self.port, sent: way.sent }
    }

    /// Waits until the host has taken all held bytes or has closed its side. The sensor's time stands still meanwhile.
    fn wait_for_room(&mut self, way: &mut Way, stops: [BorrowedFd<'_>; 2]) -> Result<Wake, Failure> {
        let begun_ns = now_ns();
        while !way.held.is_empty() {
            let Some(socket) = self.socket.as_mut().filter(|_| way.is_open) else { break };
            let taken = socket.write(&way.held)?;
            way.held.drain(..taken);
            if way.held.is_empty() {
                break;
            }
            if wait(stops, None, now_ns() + ROOM_NS) == Wake::Stop {
                return Ok(Wake::Stop);
            }
            way.is_open = socket.is_open(true);
        }
        way.held.clear();
        self.time.zero_ns += now_ns() - begun_ns;
        Ok(Wake::Line)
    }

    fn suffer(&mut self, event: Event, machine_ns: Nanos) {
        match event {
            Event::PowerCycle => self.wire.cycle_power(&mut *self.machine, machine_ns),
            Event::Unplug(span_ns) => self.wire.unplug(machine_ns, span_ns),
            Event::Faults(mut faults, seed) => {
                let now_s = machine_ns as f64 / 1e9;
                let times = [&mut faults.silence_at, &mut faults.stall_at, &mut faults.power_at];
                times.into_iter().filter(|at| **at > 0.0).for_each(|at| *at += now_s);
                self.wire.set_faults(&faults, seed);
            }
        }
    }

    /// Whether a host is there, and what it has written.
    fn look(&mut self, way: &mut Way, buffer: &mut [u8]) -> Result<usize, Failure> {
        let Some(socket) = &mut self.socket else { return Ok(0) };
        way.is_open = socket.is_open(way.is_open);
        socket.read(buffer)
    }

    /// Whether the host's port has the sensor's rate.
    fn is_tuned(&self) -> bool {
        let rate = self.socket.as_ref().and_then(Socket::rate);
        rate.is_none_or(|rate| same_rate(rate, self.machine.rate()))
    }

    /// A line never brings more at once than it carries: where this thread was kept from running for long, the
    /// sensor's time stood still too.
    fn slip(&mut self, now_ns: Nanos) {
        let machine_ns = self.time.of_machine(now_ns);
        let Some(due_ns) = self.wire.poll_timeout(&*self.machine, machine_ns) else { return };
        let latest_ns = self.time.of_clock(due_ns + MOST_LATE_NS);
        self.time.zero_ns += now_ns.saturating_sub(latest_ns);
    }

    fn hand_over(&mut self, carried: Carried, way: &mut Way) -> Result<(), Failure> {
        let is_telegram = carried.is_telegram();
        let Carried { mut bytes, rate, idle_after, part, mut fault } = carried;
        match self.socket.as_mut().filter(|_| way.is_open) {
            Some(socket) => {
                let rates = (rate, socket.rate().unwrap_or(rate));
                if same_rate(rates.1, rates.0) {
                    way.mistuned.tune();
                } else {
                    fault = fault.or(Some(Fault::Baud));
                    bytes = way.mistuned.receive(rates, &bytes, idle_after);
                }
                if self.lossless {
                    way.held.append(&mut bytes);
                    let taken = socket.write(&way.held)?;
                    way.held.drain(..taken);
                } else if socket.write(&bytes)? < bytes.len() {
                    fault = fault.or(Some(Fault::Overrun));
                }
            }
            None => fault = fault.or(Some(Fault::Unread)),
        }
        // Before the hash, which takes longer than a host that waits for this byte.
        let sent_ns = now_ns();
        if is_telegram {
            way.fault = way.fault.or(fault);
        }
        if let Some(Part::End(sent)) = part {
            (self.tell)(&Record {
                port: self.port.clone(),
                index: way.sent,
                is_reply: sent.is_reply,
                length: sent.telegram.len(),
                sha256: Record::hash(&sent.telegram),
                sent_ns,
                fault: way.fault.take(),
            })?;
            way.sent += 1;
        }
        Ok(())
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
/// Interval at which a lossless line checks for room in the host's buffer.
const ROOM_NS: Nanos = MILLIS;
/// How often the port is looked at even if nothing happens: nothing announces that it was opened, and how well it is
/// known when a byte came depends on it. At 9600, where every host begins, this proves to a strict sensor that a request
/// was written without gaps.
const LOOK_NS: Nanos = 4 * MILLIS;
