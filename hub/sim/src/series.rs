//! Scans that were measured once and are told again and again, for simulations in which hours pass in seconds: to measure a
//! scan takes far longer than to send it. Knows no geometry, and nothing of who sends them.

use scanhub_drivers::lms::variant::{MIRROR_TURN, Mode, Unit, Variant};
use schema::Nanos;

use crate::room::Room;

/// Some scans of each of a few rooms, between which the view changes at fixed times. No two scans within [`Series::ALIKE`]
/// mirror turns are equal: the first beam counts them.
#[derive(Clone, Debug)]
pub struct Series {
    settings: (Variant, Unit, Mode),
    rooms: Vec<(Room, Vec<Vec<u16>>)>,
}

/// A series as one sensor sees it: which of its rooms, from when on.
#[derive(Clone, Debug, Default)]
pub struct Changes(Vec<(Nanos, usize)>);

impl Series {
    /// After so many mirror turns the first beam's count begins again: 4096, 54 s.
    pub const ALIKE: u64 = 4_096;

    /// Measures `count` scans (at least one) of each of `rooms` (at least one) by a sensor of `variant` that tells `unit` in
    /// `mode`. To sensors that are set otherwise each scan is measured when it is asked for.
    pub fn new(rooms: Vec<Room>, count: usize, variant: Variant, unit: Unit, mode: Mode) -> Series {
        let measured = |room: Room| {
            let scans = (0..count as Nanos).map(|i| room.scan(variant, unit, mode, i * PERIOD)).collect();
            (room, scans)
        };
        Series { settings: (variant, unit, mode), rooms: rooms.into_iter().map(measured).collect() }
    }

    /// The scan that ended at `end_ns`, of the room in which `changes` have the sensor then.
    pub(crate) fn scan(
        &self,
        changes: &Changes,
        (variant, unit, mode): (Variant, Unit, Mode),
        end_ns: Nanos,
    ) -> Vec<u16> {
        let (room, scans) = self.at(changes, end_ns);
        if (variant, unit, mode) != self.settings {
            return room.scan(variant, unit, mode, end_ns);
        }
        let turn = end_ns / MIRROR_TURN;
        let mixed = turn.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32;
        let mut words = scans[(mixed % scans.len() as u64) as usize].clone();
        words[0] = FAR + (turn % Series::ALIKE) as u16;
        words
    }

    /// The room in which `changes` have the sensor at `time_ns`.
    pub(crate) fn room(&self, changes: &Changes, time_ns: Nanos) -> &Room {
        &self.at(changes, time_ns).0
    }

    /// All rooms.
    pub(crate) fn rooms(&self) -> impl Iterator<Item = &Room> {
        self.rooms.iter().map(|(room, _)| room)
    }

    /// The number of the one in which `changes` have the sensor at `time_ns`.
    pub(crate) fn number(&self, changes: &Changes, time_ns: Nanos) -> usize {
        changes.at(time_ns).min(self.rooms.len() - 1)
    }

    fn at(&self, changes: &Changes, time_ns: Nanos) -> &(Room, Vec<Vec<u16>>) {
        &self.rooms[self.number(changes, time_ns)]
    }
}

impl Changes {
    /// In the first room at first; from each of these times on in the room with this number. In the order of time.
    pub fn new(changes: Vec<(Nanos, usize)>) -> Changes {
        Changes(changes)
    }

    fn at(&self, time_ns: Nanos) -> usize {
        let begun = self.0.partition_point(|&(from, _)| from <= time_ns);
        begun.checked_sub(1).map_or(0, |last| self.0[last].1)
    }
}

/// Between the measured scans: any time will do.
const PERIOD: Nanos = 26_640_000;
/// The first beam counts from here on, in the unit of the range; with the count it fits 13 bits, below all codes.
const FAR: u16 = 2_000;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    const SETTINGS: (Variant, Unit, Mode) = (Variant::HALF, Unit::Mm, Mode(1));

    #[test]
    fn each_scan_is_one_of_its_room_and_no_two_are_equal() {
        let (variant, unit, mode) = SETTINGS;
        let rooms = ["bare", "wall640"].map(|name| Room::new(&name.parse().unwrap(), 1)).to_vec();
        let series = Arc::new(Series::new(rooms.clone(), 4, variant, unit, mode));
        let changes = Changes::new(vec![(1_000_000_000, 1), (2_000_000_000, 0)]);
        let room = Room::of_series(series, changes);
        let mut met = std::collections::HashSet::new();
        for i in 0..100 {
            let end_ns = i * PERIOD;
            let words = room.scan(variant, unit, mode, end_ns);
            let is_wall = words[1..].iter().all(|&word| word == 640);
            assert_eq!((words.len(), is_wall), (361, (38..76).contains(&i)), "{i}");
            assert!(met.insert(words));
        }
        let cm = room.scan(variant, Unit::Cm, mode, 500_000_000);
        assert_eq!(cm, rooms[0].scan(variant, Unit::Cm, mode, 500_000_000));
    }
}
