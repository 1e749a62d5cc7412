//! A simulated sensor and the line to a port, in the order of time: what a host writes goes in, what arrives comes out. Refuses
//! to know what a port does with it.

use std::collections::VecDeque;

use scanhub_schema::{MICROS, Nanos, line_time};
use scanhub_sim::Arrival;
use scanhub_sim::fault::Faults;
use scanhub_sim::ld::TruePoint;
use scanhub_sim::line_model::{Delivery, LineModel};

use crate::family::{Scanner, ScannerFault};
use crate::scenario::Action;

/// A sensor at the end of its line.
pub(crate) struct Sensor {
    scanner: Box<dyn Scanner>,
    line: LineModel,
    /// Bytes of the host on their way: when they are through, and their rate.
    outgoing: VecDeque<(Nanos, u8, u32)>,
    now: Nanos,
    /// Requests to write the EEPROM that sensors heard which are not there any more.
    eeprom_writes: u64,
}

/// What happens at a sensor and its line.
pub(crate) enum SensorEvent {
    /// Bytes come out of the line.
    Arrived(Delivery),
    /// The scanner measured these points.
    Measured(Vec<TruePoint>),
}

impl Sensor {
    /// `scanner`, and a line without faults.
    pub(crate) fn new(scanner: Box<dyn Scanner>) -> Sensor {
        Sensor {
            scanner,
            line: LineModel::new(&Faults::default(), 0),
            outgoing: VecDeque::new(),
            now: 0,
            eeprom_writes: 0,
        }
    }

    /// When something may come next.
    pub(crate) fn next_ns(&self) -> Option<Nanos> {
        let received_at = self.outgoing.front().map(|(at, ..)| *at);
        self.line.poll_timeout(self.scanner.device(), self.now).into_iter().chain(received_at).min()
    }

    /// Lets the time be `to`, unless it is later already; what arrives or is measured meanwhile goes to `draw`.
    pub(crate) fn advance(&mut self, to: Nanos, mut on_event: impl FnMut(Nanos, SensorEvent)) {
        while let Some(at) = self.next_ns().filter(|&at| at <= to) {
            self.now = self.now.max(at);
            loop {
                let carried = self.line.poll_transmit(self.scanner.device_mut(), self.now);
                let points = self.scanner.measured();
                if !points.is_empty() {
                    on_event(self.now, SensorEvent::Measured(points));
                }
                let Some(carried) = carried else { break };
                on_event(self.now, SensorEvent::Arrived(carried));
            }
            while self.outgoing.front().is_some_and(|(at, ..)| *at <= self.now)
                && let Some((at, byte, rate)) = self.outgoing.pop_front()
            {
                // At another rate it hears something else, which is no request.
                if self.scanner.device().rate() == rate {
                    self.line.receive(self.scanner.device_mut(), byte, Arrival::at(at));
                }
            }
        }
        self.now = self.now.max(to);
    }

    /// A host writes `byte` at `now`, at `rate`.
    pub(crate) fn write(&mut self, now: Nanos, byte: u8, rate: u32) {
        let free = self.outgoing.back().map_or(now, |(at, ..)| now.max(*at));
        self.outgoing.push_back((free + line_time(1, rate), byte, rate));
    }

    /// The cable is pulled out: what is on its way does not arrive.
    pub(crate) fn drop_outgoing(&mut self) {
        self.outgoing.clear();
    }

    /// Its head turns at this share of its usual speed.
    pub(crate) fn set_speed(&mut self, share: f64) {
        self.scanner.set_speed(share);
    }

    /// Its power goes off and on.
    pub(crate) fn power_cycle(&mut self) {
        self.scanner.device_mut().power_cycle(self.now);
    }

    /// Lets the voltage of the scanner dip.
    pub(crate) fn brown_out(&mut self) {
        self.scanner.brown_out(self.now);
    }

    /// Another one is there instead, as `action` says.
    pub(crate) fn exchange(&mut self, action: &Action) {
        self.eeprom_writes += self.scanner.device().eeprom_writes();
        let sent = self.scanner.exchange(action, self.now);
        let (rate, mut at) = (self.scanner.device().rate(), self.now);
        for byte in sent {
            at += line_time(1, rate) + BYTE_INTERVAL;
            self.outgoing.push_back((at, byte, rate));
        }
    }

    /// The line has these faults from now on.
    pub(crate) fn set_faults(&mut self, faults: &Faults, seed: u64) {
        self.line.set_faults(faults, seed);
    }

    /// It behaves badly as `action` says, or well again.
    pub(crate) fn misbehave(&mut self, action: Option<&Action>) {
        self.scanner.misbehave(action);
    }

    /// Something happens to it.
    pub(crate) fn inject_fault(&mut self, fault: ScannerFault) {
        self.scanner.inject_fault(fault, self.now);
    }

    /// Whether it sends unasked.
    pub(crate) fn is_streaming(&self) -> bool {
        self.scanner.device().streams()
    }

    /// Requests heard that would write the EEPROM.
    pub(crate) fn eeprom_writes(&self) -> u64 {
        self.eeprom_writes + self.scanner.device().eeprom_writes()
    }
}

/// Who makes a sensor stream pauses so long after each byte.
const BYTE_INTERVAL: Nanos = 60 * MICROS;
