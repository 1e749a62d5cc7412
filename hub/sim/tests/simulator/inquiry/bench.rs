//! A conversation that comes to an end and a simulated sensor at the two ends of a line, with a clock that only this file
//! moves.

use std::collections::VecDeque;

use scanhub_drivers::line::{Output, Protocol};
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::telegram::{Encoded, FRAME};
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};
use scanhub_sim::Arrival;
use scanhub_sim::device::{Device as _, Part};
use scanhub_sim::fault::Faults;
use scanhub_sim::machine::{LmsSimulator, Settings};
use scanhub_sim::operating::Source;
use scanhub_sim::room::Room;
use scanhub_sim::wire::BaudMismatch;
use scanhub_sim::wire::{Delivery, LineModel};

/// What becomes of bytes on their way.
pub(crate) type Way = Box<dyn FnMut(Vec<u8>) -> Vec<u8>>;

/// Both ends and the line.
pub(crate) struct Bench<C> {
    pub(crate) talk: C,
    pub(crate) machine: LmsSimulator,
    pub(crate) now: Nanos,
    /// What goes wrong on the line by itself.
    pub(crate) wire: LineModel,
    pub(crate) to_host: Way,
    pub(crate) to_sensor: Way,
    /// Telegrams that were said.
    pub(crate) said: Vec<Vec<u8>>,
    port: Baud,
    inbox: VecDeque<u8>,
    mistuned: BaudMismatch,
    request: Vec<u8>,
    last: Nanos,
}

/// A sensor in a room, at this rate.
pub(crate) fn sensor(baud: Baud) -> LmsSimulator {
    machine(Settings { baud, seed: 1, ..Settings::default() })
}

/// A sensor in a room.
pub(crate) fn machine(settings: Settings) -> LmsSimulator {
    LmsSimulator::new(settings, Source::Room(Room::new(&"room".parse().unwrap(), 1)))
}

/// Says `request` to `machine` as a host does that is gone; returns the time.
pub(crate) fn say(machine: &mut LmsSimulator, request: &Encoded) -> Nanos {
    let mut now = 10 * MILLIS;
    for &byte in request.bytes() {
        now += line_time(1, machine.baud().rate()) + 60 * MICROS;
        machine.receive(byte, Arrival::at(now));
    }
    now += 2_000 * MILLIS;
    while machine.poll_transmit(now).is_some() {}
    now
}

/// Makes `machine` stream.
pub(crate) fn make_stream(machine: &mut LmsSimulator) -> Nanos {
    say(machine, &Request::Stream.encode(0))
}

impl<C: Protocol> Bench<C> {
    /// The conversation begins at `now` of the machine's time, at a port with the rate `port`.
    pub(crate) fn new(talk: C, port: Baud, machine: LmsSimulator, now: Nanos) -> Self {
        Bench {
            talk,
            machine,
            now,
            wire: LineModel::new(&Faults::default(), 0),
            to_host: Box::new(|bytes| bytes),
            to_sensor: Box::new(|bytes| bytes),
            said: Vec::new(),
            port,
            inbox: VecDeque::new(),
            mistuned: BaudMismatch::default(),
            request: Vec::new(),
            last: now,
        }
    }

    /// Runs until it is over, which must be within `span`; returns the time it took.
    pub(crate) fn finish(&mut self, span: Nanos) -> Nanos {
        let begun = self.now;
        while let Some(until) = self.drain() {
            assert!(self.now < begun + span, "not over within {} ms", span / MILLIS);
            self.wait(until);
            let spare = self.talk.spare();
            let len = spare.len().min(self.inbox.len());
            for (place, byte) in spare.iter_mut().zip(self.inbox.drain(..len)) {
                *place = byte;
            }
            self.talk.commit(self.now, len);
            if len == 0 && self.now >= until {
                self.talk.handle_timeout(self.now);
            }
        }
        self.now - begun
    }

    /// What the sensor sends in `span`, nobody asking: telegrams that end in it.
    pub(crate) fn overhear(&mut self, span: Nanos) -> Vec<Vec<u8>> {
        let mut sent = Vec::new();
        let end = self.now + span;
        while let Some(at) = self.wire.poll_timeout(&self.machine, self.now).filter(|&at| at <= end) {
            self.now = self.now.max(at);
            while let Some(carried) = self.wire.poll_transmit(&mut self.machine, self.now) {
                if let Some(Part::End(whole)) = carried.part {
                    sent.push(whole.telegram);
                }
            }
        }
        self.now = end;
        sent
    }

    fn drain(&mut self) -> Option<Nanos> {
        loop {
            match self.talk.poll_output() {
                Output::SetRate(rate) => {
                    self.port = Baud::of_rate(rate).expect("a rate of an LMS");
                    self.inbox.clear();
                }
                Output::Transmit { bytes, not_before } => {
                    let &[byte] = bytes else { panic!("no gaps between {bytes:?}") };
                    self.transmit(byte, not_before);
                }
                Output::Wait { until } => return (!self.talk.is_done()).then_some(until),
                output => panic!("{output:?}"),
            }
        }
    }

    fn wait(&mut self, until: Nanos) {
        while self.inbox.is_empty() {
            match self.wire.poll_timeout(&self.machine, self.now) {
                Some(at) if at <= until => self.advance(at),
                _ => return self.advance(until.max(self.now) + WAKE),
            }
        }
        self.advance(self.now + WAKE);
    }

    fn transmit(&mut self, byte: u8, not_before: Nanos) {
        self.advance(not_before);
        let byte_ns = line_time(1, self.port.rate());
        if !self.request.is_empty() {
            let gap = self.now - self.last - byte_ns;
            assert!((55 * MICROS..=6 * MILLIS).contains(&gap), "{gap} ns between two bytes of a request");
        }
        self.last = self.now;
        self.request.push(byte);
        if let [_, _, low, high, ..] = self.request[..]
            && self.request.len() == usize::from(u16::from_le_bytes([low, high])) + FRAME
        {
            self.said.push(std::mem::take(&mut self.request));
        }
        self.talk.transmitted(self.now);
        self.advance(self.now + byte_ns);
        for byte in (self.to_sensor)(vec![byte]) {
            if self.machine.baud() == self.port {
                self.wire.receive(&mut self.machine, byte, Arrival::at(self.now));
            }
        }
    }

    fn advance(&mut self, to: Nanos) {
        while let Some(at) = self.wire.poll_timeout(&self.machine, self.now).filter(|&at| at <= to) {
            self.now = self.now.max(at);
            while let Some(carried) = self.wire.poll_transmit(&mut self.machine, self.now) {
                self.carry(carried);
            }
        }
        self.now = self.now.max(to);
    }

    fn carry(&mut self, carried: Delivery) {
        let Delivery { bytes, rate, idle_after, .. } = carried;
        let mut bytes = (self.to_host)(bytes);
        if rate != self.port.rate() {
            bytes = self.mistuned.receive((rate, self.port.rate()), &bytes, idle_after);
        }
        self.inbox.extend(bytes);
    }
}

/// From what it waits for to a running host.
const WAKE: Nanos = 50 * MICROS;
