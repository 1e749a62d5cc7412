//! Where the points of a scan were measured, if not where it says.

use scanhub_schema::{MILLIS, Nanos};

use super::points::{Point, Told};
use super::{NEAR, OfSensor};
use crate::family::Exactness;

impl OfSensor {
    /// The point that `told` is, if it was measured `shift` after what is told, or less than `lenience` beside.
    pub(super) fn find(&self, told: &Told, shift: i64, lenience: Nanos) -> Option<&Point> {
        let at_ns = told.at_ns.saturating_add_signed(shift);
        let begin = self.points.partition_point(|point| point.truth.at_ns + lenience < at_ns);
        let near = self.points.range(begin..).take_while(|point| point.truth.at_ns <= at_ns + lenience);
        near.into_iter().find(|point| point.is(told, &self.exactness))
    }

    /// Whether all of `told` were measured one or several turns of `period` later than told, the same for all.
    pub(super) fn is_of_later_turn(
        &self,
        told: &[Told],
        period: Nanos,
        lenience: impl Fn(&Told) -> Nanos,
    ) -> bool {
        let shift = self.shift(told);
        shift > period as i64 / 2 && told.iter().all(|told| self.find(told, shift, lenience(told)).is_some())
    }

    /// How many points of `told` are where nothing was measured within 5 cm.
    pub(super) fn wrong(&self, told: &[Told], shift: i64) -> u64 {
        let exactness = Exactness { angle_deg: 1.0, range_mm: 50.0, ..self.exactness };
        let is_wrong = |told: &&Told| {
            let at_ns = told.at_ns.saturating_add_signed(shift);
            let begin = self.points.partition_point(|point| point.truth.at_ns + FAR_NS < at_ns);
            let mut near = self.points.range(begin..).take_while(|point| point.truth.at_ns <= at_ns + FAR_NS);
            !near.any(|point| point.is(told, &exactness))
        };
        told.iter().filter(is_wrong).count() as u64
    }

    /// By how much most points were measured later than is told. From turn to turn a head is nearly where it was before: of the
    /// turns that fit, the one that fits best.
    pub(super) fn shift(&self, told: &[Told]) -> i64 {
        let Some(first) = told.iter().find(|told| told.range_mm.is_some()) else { return 0 };
        let fit = |told: &mut dyn Iterator<Item = &Told>, shift: i64| {
            told.filter(|told| self.find(told, shift, NEAR).is_some()).count()
        };
        let some = told.len().div_ceil(16);
        let candidates = self.points.iter().filter(|point| point.is(first, &self.exactness));
        let shifts = candidates.map(|point| point.truth.at_ns as i64 - first.at_ns as i64);
        let mut shifts: Vec<_> =
            shifts.map(|shift| (fit(&mut told.iter().step_by(some), shift), shift)).collect();
        let most = shifts.iter().map(|(count, _)| *count).max().unwrap_or(0);
        shifts.retain(|(count, _)| count + 1 >= most);
        let best = shifts.iter().max_by_key(|(_, shift)| (fit(&mut told.iter(), *shift), -shift.abs()));
        best.map_or(0, |(_, shift)| *shift)
    }
}

/// A wrong point is where nothing was measured in so long.
const FAR_NS: Nanos = 15 * MILLIS;
