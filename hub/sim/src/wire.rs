//! The line between sensor and port with all its faults; time is an argument: the sensor's chunks go in, what arrives
//! and why it differs comes out. One implementation for ptys and for tests in virtual time.
//!
//! Drive it like a [`Device`]: call [`Wire::poll_transmit`] until it returns `None`, pass the host's bytes, call again
//! at [`Wire::poll_timeout`]. What the host's port does (another rate, no reader) comes after it.

use std::collections::VecDeque;

use schema::Nanos;

use crate::device::{Chunk, Device, Part, Sent};
use crate::fault::{ByteOutcome, Delay, Extra, Fault, Faults, Noise, Schedule, TelegramFaults, Window};
use crate::request_decoder::Arrival;

/// What arrives at once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Carried {
    /// The bytes, with what arrived between them; none if all of them were lost.
    pub bytes: Vec<u8>,
    /// The rate they were sent at, in bits per second.
    pub rate: u32,
    /// Whether the line is idle after them.
    pub idle_after: bool,
    /// What was sent; `None` where nothing was.
    pub part: Option<Part>,
    /// The first cause why the telegram's bytes among them did not arrive as sent.
    pub fault: Option<Fault>,
}

/// The line.
#[derive(Clone, Debug)]
pub struct Wire {
    noise: Noise,
    telegram_faults: TelegramFaults,
    extras: [Extra; 2],
    silence: Window,
    delay: Delay,
    unplug: Window,
    power: Schedule,
    brownouts: Schedule,
    /// Whether nothing gets through at [`RS422_RATE`] or more.
    is_rs232: bool,
    /// Whether the adapter is in its socket.
    plugged: bool,
    /// Bytes of the telegram on the line that were sent, the last of them, and why they did not arrive as they were.
    position: usize,
    last: u8,
    fault: Option<Fault>,
    /// Whether the power broke it off.
    power_broke: bool,
    /// Bytes of each telegram, if they all have as many.
    telegram_len: Option<usize>,
    /// How the last telegram of measured values began.
    header: Vec<u8>,
    /// What has not arrived yet, with the time at which it does.
    queue: VecDeque<(Nanos, Carried)>,
}

impl Wire {
    /// A line with `faults`, drawn with `seed`.
    pub fn new(faults: &Faults, seed: u64) -> Wire {
        Wire {
            noise: Noise::new(faults, seed),
            telegram_faults: TelegramFaults::new(faults, seed),
            extras: [Extra::floods(faults, seed), Extra::walls(faults, seed)],
            silence: Window::silences(faults, seed),
            delay: Delay::new(faults, seed),
            unplug: Window::unplugs(faults, seed),
            power: Schedule::power_cycles(faults, seed),
            brownouts: Schedule::brownouts(faults, seed),
            is_rs232: faults.rs232 > 0.0,
            plugged: true,
            position: 0,
            last: 0,
            fault: None,
            power_broke: false,
            telegram_len: None,
            header: Vec::new(),
            queue: VecDeque::new(),
        }
    }

    /// Uses other faults from now on, with new random numbers; what is on its way does not change.
    pub fn set_faults(&mut self, faults: &Faults, seed: u64) {
        let fresh = Wire::new(faults, seed);
        let delay = fresh.delay.after(&self.delay);
        let (queue, header) = (std::mem::take(&mut self.queue), std::mem::take(&mut self.header));
        let Wire { position, last, fault, power_broke, .. } = *self;
        *self = Wire { delay, position, last, fault, power_broke, queue, header, ..fresh };
    }

    /// The host's adapter is out of its socket from `now` on for `span`, whatever the faults say of it.
    pub fn unplug(&mut self, now: Nanos, span: Nanos) {
        self.unplug = Window::once(now, span);
    }

    /// The power of `machine` goes off and on at `now`.
    pub fn cycle_power(&mut self, machine: &mut dyn Device, now: Nanos) {
        self.power_broke |= machine.power_cycle(now);
    }

    /// Whether the host's adapter is in its socket, as of the last poll.
    pub fn is_plugged(&self) -> bool {
        self.plugged
    }

    /// A byte of the host, if it gets through. Call it after [`Wire::poll_transmit`] answered `None`.
    pub fn receive(&mut self, machine: &mut dyn Device, byte: u8, arrival: Arrival) {
        if self.plugged && self.carries(machine.rate()) {
            machine.receive(byte, arrival);
        }
    }

    /// The next bytes that arrive at `now`.
    pub fn poll_transmit(&mut self, machine: &mut dyn Device, now: Nanos) -> Option<Carried> {
        self.plugged = !self.unplug.holds(now);
        if self.power.take(now).is_some() {
            self.cycle_power(machine, now);
        }
        if self.brownouts.take(now).is_some() {
            self.power_broke |= machine.brown_out(now);
        }
        loop {
            if self.queue.front().is_some_and(|(at, _)| *at <= now)
                && let Some((_, mut carried)) = self.queue.pop_front()
            {
                if !self.plugged && !std::mem::take(&mut carried.bytes).is_empty() {
                    carried.fault = carried.fault.or(carried.is_telegram().then_some(Fault::Unplug));
                }
                return Some(carried);
            }
            match machine.poll_transmit(now) {
                Some(chunk) => self.carry(machine, chunk, now),
                None => {
                    if self.position > 0 {
                        return None;
                    }
                    let bytes = Some(self.garbage(now, false)?.0);
                    let bytes = bytes.filter(|_| !self.is_silent(machine.rate(), now)).unwrap_or_default();
                    let rate = machine.rate();
                    self.push(now, Carried { bytes, rate, idle_after: true, part: None, fault: None });
                }
            }
        }
    }

    /// When there will be something to poll, seen from `now`.
    pub fn poll_timeout(&self, machine: &dyn Device, now: Nanos) -> Option<Nanos> {
        let extras = self.extras.iter().filter(|_| self.position == 0).map(|extra| extra.due_ns(false));
        extras
            .chain(machine.poll_timeout())
            .chain(self.queue.front().map(|(at, _)| *at))
            .chain([self.power.next_ns(), self.brownouts.next_ns(), self.unplug.next_ns(now)])
            .filter(|&at| at < Nanos::MAX)
            .min()
    }

    /// Puts what becomes of a chunk that is through on its way to the host.
    fn carry(&mut self, machine: &mut dyn Device, chunk: Chunk, now: Nanos) {
        let Chunk { bytes, rate, idle_after, part } = chunk;
        let is_silent = self.is_silent(rate, now);
        self.telegram_len = machine.telegram_len();
        let (arrived, mut fault) = match &part {
            Part::Acknowledge => (self.carry_acknowledge(&bytes), None),
            Part::Telegram => self.carry_telegram(&bytes, usize::MAX, is_silent, now),
            Part::End(sent) => self.carry_telegram(&bytes, sent.telegram.len(), is_silent, now),
        };
        let arrived = if is_silent { Vec::new() } else { arrived };
        let mut copy = None;
        if let Part::End(sent) = &part {
            let cause = if std::mem::take(&mut self.power_broke) { Fault::Power } else { Fault::Aborted };
            fault = fault.or(sent.aborted.then_some(cause));
            copy = self.end(sent, fault);
        } else if machine.streams() && self.telegram_faults.breaks_at(self.position) {
            machine.break_off(now);
        }
        self.push(now, Carried { bytes: arrived, rate, idle_after, part: Some(part), fault });
        if let Some(sent) = copy {
            let bytes = sent.telegram.clone();
            self.push(now, Carried { bytes, rate, idle_after, part: Some(Part::End(sent)), fault: None });
        }
    }

    /// Returns whether the line carries bytes at `rate`, in bits per second.
    fn carries(&self, rate: u32) -> bool {
        !self.is_rs232 || rate < RS422_RATE
    }

    /// Returns whether nothing sent at `rate` arrives at `now`.
    fn is_silent(&mut self, rate: u32, now: Nanos) -> bool {
        self.silence.holds(now) || !self.carries(rate)
    }

    fn carry_acknowledge(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut arrived = Vec::new();
        for &byte in bytes {
            let ByteOutcome { before, lost, flipped, doubled } = self.noise.next();
            arrived.extend(before);
            let copies = if lost { 0 } else { 1 + usize::from(doubled) };
            arrived.extend(std::iter::repeat_n(byte ^ flipped, copies));
        }
        arrived
    }

    /// What becomes of bytes of a telegram that has `len` (if that is known yet), and the first cause.
    fn carry_telegram(
        &mut self,
        bytes: &[u8],
        len: usize,
        is_silent: bool,
        now: Nanos,
    ) -> (Vec<u8>, Option<Fault>) {
        let mut arrived = Vec::with_capacity(bytes.len());
        let mut fault = None;
        for &byte in bytes {
            let position = self.position;
            self.position += 1;
            if position == 0 {
                self.telegram_faults.begin(self.telegram_len);
                self.fault = None;
                self.last = byte;
            }
            fault = fault.or(is_silent.then_some(Fault::Silence));
            let between = (position > 0).then(|| (std::mem::replace(&mut self.last, byte), byte));
            if let Some((garbage, cause)) = self.garbage(now, position > 0) {
                arrived.extend(foreign(garbage, between));
                fault = fault.or(between.map(|_| cause));
            }
            let ByteOutcome { before, lost, flipped, doubled } = self.noise.next();
            let (blemished, blemish) = self.telegram_faults.apply(position, byte);
            fault = fault.or((position > 0 && !before.is_empty()).then_some(Fault::Insert));
            arrived.extend(foreign(before, between));
            fault = fault.or(blemish).or(lost.then_some(Fault::Loss));
            let Some(byte) = blemished.filter(|_| !lost) else { continue };
            fault = fault.or((flipped != 0).then_some(Fault::Flip));
            // A copy of the first byte comes before a whole telegram, one of the last behind it.
            let splits = doubled && position > 0 && position + 1 < len;
            fault = fault.or(splits.then_some(Fault::Double));
            arrived.extend(std::iter::repeat_n(byte ^ flipped, 1 + usize::from(doubled)));
        }
        self.fault = self.fault.or(fault);
        (arrived, fault)
    }

    /// A telegram has left; returns its copy, if it comes twice.
    fn end(&mut self, sent: &Sent, fault: Option<Fault>) -> Option<Sent> {
        self.position = 0;
        if !sent.is_reply {
            self.header = sent.telegram[..HEADER.min(sent.telegram.len())].to_vec();
        }
        let is_whole = self.fault.or(fault).is_none();
        (is_whole && self.telegram_faults.repeats()).then(|| sent.clone())
    }

    /// Garbage that is due, inside a telegram or between two, and its name.
    fn garbage(&mut self, now: Nanos, inside: bool) -> Option<(Vec<u8>, Fault)> {
        if self.extras.iter().all(|extra| extra.due_ns(inside) > now) {
            return None;
        }
        let header = &self.header;
        self.extras.iter_mut().find_map(|extra| Some((extra.take(now, inside, header)?, extra.fault)))
    }

    fn push(&mut self, now: Nanos, carried: Carried) {
        self.queue.push_back((self.delay.release_ns(now), carried));
    }
}

impl Carried {
    /// Whether bytes of a telegram are among those that were sent.
    pub fn is_telegram(&self) -> bool {
        matches!(self.part, Some(Part::Telegram | Part::End(_)))
    }
}

/// Foreign bytes that came `between` two of a telegram, none of which can stand for one of them: else the telegram
/// would be whole, shifted by as many.
fn foreign(mut bytes: Vec<u8>, between: Option<(u8, u8)>) -> Vec<u8> {
    if let (Some((before, after)), [first, rest @ ..]) = (between, &mut bytes[..]) {
        let last = rest.last_mut();
        let is_alone = last.is_none();
        if let Some(last) = last.filter(|last| **last == before) {
            *last ^= 1;
        }
        while *first == after || (is_alone && *first == before) {
            *first = first.wrapping_add(1);
        }
    }
    bytes
}

/// Lowest rate that RS-232 does not carry, in bits per second.
const RS422_RATE: u32 = 500_000;
/// Bytes of a stream's header: STX to count word.
const HEADER: usize = 7;
