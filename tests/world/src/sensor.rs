//! A simulated scanner and the line between the scanner and a port. Bytes of the host and of the scanner are delivered
//! in order of time.

use std::collections::VecDeque;

use scanhub_schema::{MICROS, Nanos, line_time};
use scanhub_sim::Arrival;
use scanhub_sim::fault::Faults;
use scanhub_sim::ld::TruePoint;
use scanhub_sim::line_model::{Delivery, LineModel};

use crate::family::{Scanner, ScannerFault};
use crate::scenario::Action;

/// A scanner at the end of its line.
pub(crate) struct Sensor {
    scanner: Box<dyn Scanner>,
    line: LineModel,
    /// Bytes from the host in transit to the scanner: time of arrival, value and baud rate.
    outgoing: VecDeque<(Nanos, u8, u32)>,
    now: Nanos,
    /// Number of EEPROM writes that earlier scanners at this line received.
    eeprom_writes: u64,
}

/// An event at a scanner or its line.
pub(crate) enum SensorEvent {
    /// The line delivers bytes.
    Arrived(Delivery),
    /// The scanner measured these points.
    Measured(Vec<TruePoint>),
}

impl Sensor {
    /// Creates a sensor with `scanner` and a line without faults.
    pub(crate) fn new(scanner: Box<dyn Scanner>) -> Sensor {
        Sensor {
            scanner,
            line: LineModel::new(&Faults::default(), 0),
            outgoing: VecDeque::new(),
            now: 0,
            eeprom_writes: 0,
        }
    }

    /// Returns the time of the next possible event.
    pub(crate) fn next_ns(&self) -> Option<Nanos> {
        let received_at = self.outgoing.front().map(|(at, ..)| *at);
        self.line.poll_timeout(self.scanner.device(), self.now).into_iter().chain(received_at).min()
    }

    /// Advances the time to `to`. If the time is already later than `to`, it does not change. Calls `on_event` for
    /// bytes that arrive and points that are measured until `to`.
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
                // The scanner cannot read a byte that the host sent at another rate.
                if self.scanner.device().rate() == rate {
                    self.line.receive(self.scanner.device_mut(), byte, Arrival::at(at));
                }
            }
        }
        self.now = self.now.max(to);
    }

    /// Sends `byte` from the host at `now`, at baud rate `rate`.
    pub(crate) fn write(&mut self, now: Nanos, byte: u8, rate: u32) {
        let free = self.outgoing.back().map_or(now, |(at, ..)| now.max(*at));
        self.outgoing.push_back((free + line_time(1, rate), byte, rate));
    }

    /// Discards the bytes in transit to the scanner, because the cable was unplugged.
    pub(crate) fn drop_outgoing(&mut self) {
        self.outgoing.clear();
    }

    /// Sets the target speed of the head, as a share of its usual speed.
    pub(crate) fn set_speed(&mut self, share: f64) {
        self.scanner.set_speed(share);
    }

    /// Interrupts the power supply for a moment.
    pub(crate) fn power_cycle(&mut self) {
        self.scanner.device_mut().power_cycle(self.now);
    }

    /// Makes the voltage of the scanner dip.
    pub(crate) fn brown_out(&mut self) {
        self.scanner.brown_out(self.now);
    }

    /// Replaces the scanner as `action` specifies.
    pub(crate) fn exchange(&mut self, action: &Action) {
        self.eeprom_writes += self.scanner.device().eeprom_writes();
        let sent = self.scanner.exchange(action, self.now);
        let (rate, mut at) = (self.scanner.device().rate(), self.now);
        for byte in sent {
            at += line_time(1, rate) + BYTE_INTERVAL;
            self.outgoing.push_back((at, byte, rate));
        }
    }

    /// Replaces the faults of the line.
    pub(crate) fn set_faults(&mut self, faults: &Faults, seed: u64) {
        self.line.set_faults(faults, seed);
    }

    /// Starts the misbehavior that `action` specifies. With `None`, ends all misbehavior.
    pub(crate) fn misbehave(&mut self, action: Option<&Action>) {
        self.scanner.misbehave(action);
    }

    /// Injects a fault into the scanner.
    pub(crate) fn inject_fault(&mut self, fault: ScannerFault) {
        self.scanner.inject_fault(fault, self.now);
    }

    /// Returns whether the scanner sends data without a request.
    pub(crate) fn is_streaming(&self) -> bool {
        self.scanner.device().streams()
    }

    /// Returns the number of received requests that write the EEPROM.
    pub(crate) fn eeprom_writes(&self) -> u64 {
        self.eeprom_writes + self.scanner.device().eeprom_writes()
    }
}

/// Time between two bytes that a host sends to start a stream.
const BYTE_INTERVAL: Nanos = 60 * MICROS;
