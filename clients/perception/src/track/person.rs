//! One person as the tracker follows him: filter, and what speaks for him and against him. Refuses to know other persons.

use scanhub_schema::TrackState;

use crate::track::filter::{Filter, Side};
use crate::track::geometry::Point;
use crate::track::sight::Leg;

/// One person.
pub(crate) struct Person {
    pub(crate) id: u64,
    pub(crate) filter: Filter,
    /// What the filter holds for, in ns.
    pub(crate) at_ns: u64,
    pub(crate) born_ns: u64,
    /// Where he was first seen.
    pub(crate) born_at: Point,
    pub(crate) life: Life,
    /// When a leg of his was seen last.
    pub(crate) seen_ns: u64,
    /// Time at which a leg of theirs was last seen outside the ignored areas.
    pub(crate) free_ns: u64,
    /// When each sensor saw him last; 0 never.
    pub(crate) seen_by_ns: [u64; crate::track::site::SENSORS],
    /// Scans that spoke for him, at most [`MOST_SUPPORT`]; one of a slow sensor counts up to twice.
    pub(crate) support: f64,
    /// Scans that showed both legs.
    pub(crate) pairs: f64,
    /// For how many seconds he was seen through.
    pub(crate) absent_s: f64,
    /// How fast he walks when he does.
    pub(crate) pace: f64,
    pub(crate) room: Option<usize>,
    /// The door by which he came into that room, if he was seen to.
    pub(crate) came_by: Option<usize>,
    /// Share of the scans that see him and show both legs, of late.
    pub(crate) both: f64,
}

/// Where a person is in his life.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Life {
    Tentative,
    Known,
    /// Out of sight since then, having gone through that door.
    Away {
        since_ns: u64,
        door: usize,
    },
}

/// So many scans make somebody known.
const ENOUGH: f64 = 8.0;
pub(crate) const MOST_SUPPORT: f64 = 20.0;
/// Longest time between two scans of a sensor of which each counts as one. Those of a slower one count up to twice: else
/// somebody would not be known for a second at 7.5 Hz.
const FULL_S: f64 = 0.0625;
/// Beams on a leg that is certainly not the leg of a chair.
const CLEAR_BEAMS: usize = 4;
/// Weight of a leg of fewer beams, compared with a sensor that sees through the place.
pub(crate) const COARSE: f64 = 0.5;
/// Nobody is known sooner.
const SOONEST_NS: u64 = 300_000_000;
/// Who was seen within this time is not hidden.
const LATELY_NS: u64 = 250_000_000;

impl Person {
    pub(crate) fn new(id: u64, at_ns: u64, legs: &[Leg]) -> Person {
        let mut filter = Filter::of_leg(legs[0].at, legs[0].sigma_m);
        if let Some(other) = legs.get(1) {
            filter.correct(Side::Minus, other.at, other.sigma_m);
        }
        Person {
            id,
            born_at: filter.place(),
            filter,
            at_ns,
            born_ns: at_ns,
            life: Life::Tentative,
            seen_ns: at_ns,
            free_ns: at_ns,
            seen_by_ns: [0; crate::track::site::SENSORS],
            support: 1.0,
            pairs: if legs.len() > 1 { 1.0 } else { 0.0 },
            absent_s: 0.0,
            pace: 1.1,
            room: None,
            came_by: None,
            both: if legs.len() > 1 { 1.0 } else { 0.0 },
        }
    }

    /// Moves the filter to `at_ns`.
    pub(crate) fn predict(&mut self, at_ns: u64) {
        if at_ns > self.at_ns {
            let dt = (at_ns - self.at_ns) as f64 * 1e-9;
            let fades = at_ns - self.seen_ns > LATELY_NS;
            self.filter.predict(dt, fades);
            self.at_ns = at_ns;
        }
    }

    /// Handles a scan of `sensor`, `since_s` after its last one, that showed `legs` of the person, one of them with this number of
    /// `beams`.
    pub(crate) fn seen(&mut self, sensor: usize, since_s: f64, legs: usize, beams: usize) {
        self.seen_ns = self.at_ns;
        self.seen_by_ns[sensor] = self.at_ns;
        // A few beams may also be on the leg of a chair, so another sensor may contradict.
        self.absent_s = if beams < CLEAR_BEAMS { (self.absent_s - COARSE * since_s).max(0.0) } else { 0.0 };
        let both = if legs > 1 { 1.0 } else { 0.0 };
        self.pairs += both;
        self.both += 0.05 * (both - self.both);
        self.support = (self.support + (since_s / FULL_S).clamp(1.0, 2.0)).min(MOST_SUPPORT);
        let speed = self.speed();
        if speed > 0.5 {
            // Who turns or gives way is slower than his pace.
            self.pace += if speed > self.pace { 0.03 } else { 0.01 } * (speed - self.pace);
        }
    }

    pub(crate) fn speed(&self) -> f64 {
        let [x, y] = self.filter.velocity();
        (x * x + y * y).sqrt()
    }

    /// He is a person: he is seen often enough, and has two legs, or moves as no thing does.
    pub(crate) fn is_sure(&self) -> bool {
        let way = crate::track::geometry::distance(self.filter.place(), self.born_at);
        self.support >= ENOUGH && self.at_ns - self.born_ns >= SOONEST_NS && (self.pairs >= 3.0 || way > 0.3)
    }

    pub(crate) fn is_known(&self) -> bool {
        self.life == Life::Known
    }

    pub(crate) fn state(&self, now_ns: u64) -> TrackState {
        match self.life {
            Life::Tentative => TrackState::Tentative,
            Life::Away { .. } => TrackState::BetweenRooms,
            Life::Known if now_ns.saturating_sub(self.seen_ns) > LATELY_NS => TrackState::Hidden,
            Life::Known => TrackState::Confirmed,
        }
    }

    /// Sensors that saw him within a quarter of a second, as bits.
    pub(crate) fn sensors(&self, now_ns: u64) -> u32 {
        let lately = |&at: &u64| at > 0 && now_ns.saturating_sub(at) <= LATELY_NS;
        (0..)
            .zip(&self.seen_by_ns)
            .filter(|(_, at)| lately(at))
            .map(|(sensor, _): (u32, _)| 1 << sensor)
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::track::sight::AtDoor;

    #[test]
    fn somebody_is_known_after_eight_scans_or_fewer_of_a_slow_sensor() {
        const MS: u64 = 1_000_000;
        let legs = [-0.1, 0.1].map(|y| Leg {
            at: [2.0, y],
            sigma_m: 0.03,
            is_fresh: true,
            is_ignored: false,
            is_solid: true,
            beams: 5,
            is_free: true,
            at_door: AtDoor::Clear,
        });
        let known_after_ms = |every_ms: u64| {
            let mut person = Person::new(1, MS, &legs);
            let mut after_ms = 0;
            while !person.is_sure() {
                after_ms += every_ms;
                person.predict(MS * (1 + after_ms));
                person.seen(0, every_ms as f64 * 1e-3, 2, 5);
            }
            after_ms
        };
        assert_eq!(known_after_ms(10), 300);
        assert_eq!(known_after_ms(50), 350);
        assert_eq!(known_after_ms(60), 420);
        assert_eq!(known_after_ms(100), 500);
        assert_eq!(known_after_ms(133), 532);
        assert_eq!(known_after_ms(200), 800);
    }
}
