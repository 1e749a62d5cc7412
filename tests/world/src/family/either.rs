//! Two rotating scanners of different families that take turns at one port: an exchange connects the other scanner.
//! Packets of an LDROBOT are recognized by their header; all other bytes belong to the other family.

use std::rc::Rc;

use scanhub_schema::{Family as Name, Nanos, Scan};
use scanhub_sim::device::Device;
use scanhub_sim::ld::TruePoint;
use scanhub_sim::room::Changes;

use super::{Ailment, Begin, Exactness, Family, Scanner, is_ld_packet};
use crate::plan::Action;

/// Both scanners. The link has the keys of the first one.
pub(super) struct Either {
    /// The scanner that is connected at the start.
    pub(super) first: Rc<dyn Family>,
    /// The scanner that the first exchange connects.
    pub(super) second: Rc<dyn Family>,
}

impl Either {
    /// Returns the family of these bytes.
    fn of(&self, bytes: &[u8]) -> &dyn Family {
        let is_ld = bytes.chunks(scanhub_drivers::ld::packet::LEN).all(is_ld_packet) && !bytes.is_empty();
        let is_first = (self.first.families() == [Name::Ld]) == is_ld;
        if is_first { &*self.first } else { &*self.second }
    }
}

impl Family for Either {
    fn keys(&self) -> Vec<String> {
        self.first.keys()
    }

    fn auto(&self) -> Rc<dyn Family> {
        Rc::new(Either { first: self.first.auto(), second: self.second.auto() })
    }

    fn families(&self) -> Vec<Name> {
        [self.first.families(), self.second.families()].concat()
    }

    fn rates(&self) -> Vec<u32> {
        [self.first.rates(), self.second.rates()].concat()
    }

    fn times(&self) -> (Nanos, Nanos) {
        let (first, second) = (self.first.times(), self.second.times());
        (first.0.max(second.0), first.1.max(second.1))
    }

    fn found(&self, changes: Changes) -> Box<dyn Scanner> {
        let (first, second) = (self.first.found(changes.clone()), self.second.found(changes));
        Box::new(AtLine { connected: first, other: second })
    }

    fn units<'a>(&self, sample: &'a [u8]) -> Vec<&'a [u8]> {
        self.of(sample).units(sample)
    }

    fn most_units(&self) -> usize {
        self.first.most_units().max(self.second.most_units())
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

    fn turns(&self) -> bool {
        true
    }

    fn begin(&self, unit: &[u8]) -> Option<Begin> {
        self.of(unit).begin(unit)
    }

    fn exactness(&self, unit: &[u8]) -> Exactness {
        self.of(unit).exactness(unit)
    }
}

/// The scanner at the line, and the one that takes its place.
struct AtLine {
    connected: Box<dyn Scanner>,
    other: Box<dyn Scanner>,
}

impl Scanner for AtLine {
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

    fn suffer(&mut self, ailment: Ailment, now: Nanos) {
        self.connected.suffer(ailment, now);
    }

    fn set_pace(&mut self, share: f64) {
        self.connected.set_pace(share);
        self.other.set_pace(share);
    }

    fn measured(&mut self) -> Vec<TruePoint> {
        self.connected.measured()
    }
}
