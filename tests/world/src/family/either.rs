//! Two rotating scanners, an LDROBOT and a scanner of another family, at one port. An exchange replaces the connected
//! scanner with the other one. Packets of the LDROBOT are recognized by their header. All other bytes belong to the
//! other family.

use std::rc::Rc;

use scanhub_schema::{Family as Name, Nanos, Scan};
use scanhub_sim::device::Device;
use scanhub_sim::ld::TruePoint;
use scanhub_sim::room::Changes;

use super::{Family, FirstPoint, PointAccuracy, Scanner, ScannerFault, is_ld_packet};
use crate::scenario::Action;

/// The two scanners. The link has the keys of `first`.
pub(super) struct TwoFamilies {
    /// The scanner that is connected at the start.
    pub(super) first: Rc<dyn Family>,
    /// The scanner that the first exchange connects.
    pub(super) second: Rc<dyn Family>,
}

impl TwoFamilies {
    /// Returns the family to which these bytes belong.
    fn of(&self, bytes: &[u8]) -> &dyn Family {
        let is_ld =
            bytes.chunks(scanhub_drivers::ld::packet::PACKET_LEN).all(is_ld_packet) && !bytes.is_empty();
        let is_first = (self.first.families() == [Name::Ld]) == is_ld;
        if is_first { &*self.first } else { &*self.second }
    }
}

impl Family for TwoFamilies {
    fn keys(&self) -> Vec<String> {
        self.first.keys()
    }

    fn auto(&self) -> Rc<dyn Family> {
        Rc::new(TwoFamilies { first: self.first.auto(), second: self.second.auto() })
    }

    fn families(&self) -> Vec<Name> {
        [self.first.families(), self.second.families()].concat()
    }

    fn baud_rates(&self) -> Vec<u32> {
        [self.first.baud_rates(), self.second.baud_rates()].concat()
    }

    fn scan_times(&self) -> (Nanos, Nanos) {
        let (first, second) = (self.first.scan_times(), self.second.scan_times());
        (first.0.max(second.0), first.1.max(second.1))
    }

    fn initial_scanner(&self, changes: Changes) -> Box<dyn Scanner> {
        let (first, second) =
            (self.first.initial_scanner(changes.clone()), self.second.initial_scanner(changes));
        Box::new(ConnectedScanners { connected: first, other: second })
    }

    fn telegrams<'a>(&self, sample: &'a [u8]) -> Vec<&'a [u8]> {
        self.of(sample).telegrams(sample)
    }

    fn max_telegrams(&self) -> usize {
        self.first.max_telegrams().max(self.second.max_telegrams())
    }

    fn is_data(&self, unit: &[u8]) -> bool {
        self.of(unit).is_data(unit)
    }

    fn is_scan_of(&self, scan: &Scan, sample: &[u8]) -> bool {
        self.of(sample).is_scan_of(scan, sample)
    }

    fn is_collision(&self, got: &[u8], damaged: &mut dyn Iterator<Item = &[u8]>) -> bool {
        self.of(got).is_collision(got, damaged)
    }

    fn is_rotating(&self) -> bool {
        true
    }

    fn first_point(&self, unit: &[u8]) -> Option<FirstPoint> {
        self.of(unit).first_point(unit)
    }

    fn point_accuracy(&self, unit: &[u8]) -> PointAccuracy {
        self.of(unit).point_accuracy(unit)
    }
}

/// The connected scanner, and the scanner that replaces it at the next exchange.
struct ConnectedScanners {
    connected: Box<dyn Scanner>,
    other: Box<dyn Scanner>,
}

impl Scanner for ConnectedScanners {
    fn device(&self) -> &dyn Device {
        self.connected.device()
    }

    fn device_mut(&mut self) -> &mut dyn Device {
        self.connected.device_mut()
    }

    fn exchange(&mut self, action: &Action, now: Nanos) -> Vec<u8> {
        std::mem::swap(&mut self.connected, &mut self.other);
        self.connected.exchange(action, now)
    }

    fn brown_out(&mut self, now: Nanos) {
        self.connected.brown_out(now);
    }

    fn misbehave(&mut self, action: Option<&Action>) {
        self.connected.misbehave(action);
        self.other.misbehave(action);
    }

    fn inject_fault(&mut self, fault: ScannerFault, now: Nanos) {
        self.connected.inject_fault(fault, now);
    }

    fn set_speed(&mut self, share: f64) {
        self.connected.set_speed(share);
        self.other.set_speed(share);
    }

    fn measured(&mut self) -> Vec<TruePoint> {
        self.connected.measured()
    }
}
