//! A scanner of Slamtec and its line in virtual time: what a host asks goes in, what it sends comes out.

use scanhub_schema::{MILLIS, Nanos, line_time};
use scanhub_sim::Arrival;
use scanhub_sim::device::{Device as _, Part};
use scanhub_sim::fault::Faults;
use scanhub_sim::room::Room;
use scanhub_sim::rplidar::{RplidarSettings, RplidarSimulator};
use scanhub_sim::wire::LineModel;
use scanhub_sim::world::World;

pub(crate) const SECOND: Nanos = 1_000 * MILLIS;

/// A telegram that left.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Sent {
    pub(crate) bytes: Vec<u8>,
    pub(crate) is_reply: bool,
    /// What happened to it on its way.
    pub(crate) fault: Option<&'static str>,
    pub(crate) at: Nanos,
}

pub(crate) struct Bench {
    pub(crate) unit: RplidarSimulator,
    wire: LineModel,
    pub(crate) now: Nanos,
    /// What arrived, byte for byte.
    pub(crate) line: Vec<u8>,
    pub(crate) sent: Vec<Sent>,
    fault: Option<&'static str>,
}

impl Bench {
    pub(crate) fn new(settings: RplidarSettings, world: &World, faults: &str) -> Bench {
        let faults: Faults = faults.parse().expect("faults");
        let seed = settings.seed;
        let settings = RplidarSettings { faults, quirks: faults.quirks(), ..settings };
        Bench {
            unit: RplidarSimulator::new(settings, Room::new(world, seed)),
            wire: LineModel::new(&faults, seed),
            now: 0,
            line: Vec::new(),
            sent: Vec::new(),
            fault: None,
        }
    }

    /// Until `until`.
    pub(crate) fn run(&mut self, until: Nanos) {
        loop {
            while let Some(carried) = self.wire.poll_transmit(&mut self.unit, self.now) {
                self.fault = self.fault.or(carried.fault.map(|fault| fault.name()));
                self.line.extend(carried.bytes);
                if let Some(Part::End(sent)) = carried.part {
                    let (fault, at) = (self.fault.take(), self.now);
                    self.sent.push(Sent { bytes: sent.telegram, is_reply: sent.is_reply, fault, at });
                }
            }
            let next = self.wire.poll_timeout(&self.unit, self.now).filter(|&at| at <= until);
            match next {
                Some(at) => self.now = at.max(self.now),
                None => break,
            }
        }
        self.now = until;
    }

    /// For `span`.
    pub(crate) fn pass(&mut self, span: Nanos) {
        self.run(self.now + span);
    }

    /// Says `request` at the pace of the line, and returns what was sent as replies within 20 ms behind it.
    pub(crate) fn ask(&mut self, request: &[u8]) -> Vec<Vec<u8>> {
        let before = self.sent.len();
        for &byte in request {
            self.pass(line_time(1, self.unit.rate()));
            self.wire.receive(&mut self.unit, byte, Arrival::at(self.now));
        }
        self.pass(20 * MILLIS);
        self.sent[before..].iter().filter(|sent| sent.is_reply).map(|sent| sent.bytes.clone()).collect()
    }

    /// Asks for the value of `key` of mode `mode`; what came.
    pub(crate) fn configuration(&mut self, key: u8, mode: u8) -> Vec<Vec<u8>> {
        self.ask(&with_payload(0x84, &[key, 0, 0, 0, mode, 0]))
    }

    /// Data, in the order in which it left.
    pub(crate) fn data(&self) -> Vec<Vec<u8>> {
        self.sent.iter().filter(|sent| !sent.is_reply).map(|sent| sent.bytes.clone()).collect()
    }

    /// `byte` of a request arrives.
    pub(crate) fn say(&mut self, byte: u8) {
        self.wire.receive(&mut self.unit, byte, Arrival::at(self.now));
    }

    pub(crate) fn cycle_power(&mut self) {
        self.wire.cycle_power(&mut self.unit, self.now);
    }
}

/// A request with a payload: its length before it and the XOR of everything behind it.
pub(crate) fn with_payload(command: u8, payload: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0xA5, command, payload.len() as u8];
    bytes.extend(payload);
    bytes.push(bytes.iter().fold(0, |sum, byte| sum ^ byte));
    bytes
}

/// The request for the stream of mode number `mode`.
pub(crate) fn start(mode: usize) -> Vec<u8> {
    match mode {
        0 => vec![0xA5, 0x20],
        _ => with_payload(0x82, &[mode as u8, 0, 0, 0, 0]),
    }
}
