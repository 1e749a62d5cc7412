//! Assembles points into revolutions.
//!
//! A revolution begins half a grid step before the scanner's zero, so that all points of the beam ahead belong to the
//! same revolution. A point belongs to the revolution that contains its angle, and may arrive after points with larger
//! angles. A revolution is therefore complete only when the angle from the end of the revolution to the head exceeds
//! the angle by which a point can be late. Until then, this revolution and the next one are open. Times are in the
//! scanner's clock.

use crate::line::{NO_RETURN, Point};
use scanhub_schema::Nanos;

/// The two open revolutions: the one that is being measured, and the next one. Each has room for `N` points.
#[derive(Clone, Debug)]
pub struct RevolutionAssembler<const N: usize> {
    points: [[Point; N]; 2],
    /// Index of the buffer that holds the points of the first open revolution.
    at: usize,
    open: [OpenRevolution; 2],
    /// Index of the first open revolution, counted from the start of the sequence of angles. `None` before the first
    /// point.
    number: Option<i64>,
    /// Serial number of the first open revolution among all revolutions. The second open revolution has the next
    /// number.
    serial: u64,
    /// Index of the last revolution that lacks points.
    last_incomplete: i64,
    /// Angle from the edge of a revolution to the scanner's zero, in degrees.
    edge: f64,
    counts: RevolutionCounts,
}

#[derive(Clone, Copy, Debug, Default)]
struct OpenRevolution {
    len: usize,
    /// Time at the edge where the revolution begins, in nanoseconds. `last` is the time of the last point.
    first: Option<f64>,
    last: f64,
    incomplete: bool,
    reasons: u8,
}

/// A complete revolution, in time of the scanner's clock. Its points stay valid until the next point is added.
#[derive(Clone, Copy, Debug)]
pub struct ClosedRevolution {
    /// Serial number. No other revolution has the same number, not even a discarded revolution.
    pub number: u64,
    points: usize,
    len: usize,
    /// Time at the edge where the revolution begins.
    pub first: Nanos,
    /// Time of the last point.
    pub last: Nanos,
    /// Duration from edge to edge, in nanoseconds.
    pub period: Nanos,
    /// Whether points are missing.
    pub incomplete: bool,
    /// Reasons why the revolution is suspect: bits of [`crate::line::suspect`]; 0 means clean.
    pub reasons: u8,
}

/// Counts of revolutions by kind. They only increase.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RevolutionCounts {
    /// Revolutions that were returned, including incomplete ones.
    pub returned: u64,
    /// Returned revolutions that lack points.
    pub incomplete: u64,
    /// Revolutions that were not returned: less than half of their points arrived, or the assembler discarded them.
    pub short: u64,
    /// Revolutions for which no point arrived.
    pub missed: u64,
}

/// Speed of the head, as the angle and the time from one point to the next.
#[derive(Clone, Copy, Debug)]
pub struct RotationRate {
    /// Angle from one point to the next, in degrees.
    pub step: f64,
    /// Time from one point to the next, in nanoseconds.
    pub point_ns: f64,
}

impl RotationRate {
    /// Returns the number of points in a revolution.
    fn points_per_revolution(&self) -> f64 {
        360.0 / self.step.max(1e-3)
    }

    /// Returns the duration of a revolution, in nanoseconds.
    fn revolution_ns(&self) -> f64 {
        self.points_per_revolution() * self.point_ns
    }
}

impl<const N: usize> RevolutionAssembler<N> {
    /// Creates an assembler without open revolutions.
    #[expect(clippy::new_without_default, reason = "the start of a stream is not a default value")]
    pub fn new() -> Self {
        const NONE: Point = Point { angle: 0.0, range: NO_RETURN, intensity: 0 };
        RevolutionAssembler {
            points: [[NONE; N]; 2],
            at: 0,
            open: [OpenRevolution::default(); 2],
            number: None,
            serial: 0,
            last_incomplete: i64::MIN,
            edge: 0.0,
            counts: RevolutionCounts::default(),
        }
    }

    /// Starts to assemble revolutions for a grid of `beams` beams, and discards the open revolutions.
    pub fn begin(&mut self, beams: usize) {
        self.edge = 180.0 / beams as f64;
        self.discard();
    }

    /// Returns the counts of revolutions.
    pub fn counts(&self) -> RevolutionCounts {
        self.counts
    }

    /// Returns the first open revolution with its points so far. Returns `None` if it has no point.
    pub fn partial_revolution(&self, rate: RotationRate) -> Option<ClosedRevolution> {
        let open = &self.open[0];
        Some(self.close(open, open.first?, rate.revolution_ns()))
    }

    /// Returns the points of `revolution`, which is the last complete revolution or the first open revolution.
    pub fn points(&self, revolution: &ClosedRevolution) -> &[Point] {
        &self.points[revolution.points][..revolution.len]
    }

    /// Discards the open revolutions. The next point starts a new sequence of angles.
    pub fn discard(&mut self) {
        self.counts.short += u64::from(self.open[0].len > 0);
        self.open = [OpenRevolution::default(); 2];
        self.serial += 2;
        (self.number, self.last_incomplete) = (None, i64::MIN);
    }

    /// Adds a point. `angle` is in degrees, clockwise, and increases beyond 360 degrees. `time` is in nanoseconds, and
    /// `range` in millimeters. `reasons` are bits of [`crate::line::suspect`].
    pub fn add_point(
        &mut self,
        angle: f64,
        time: f64,
        range: u16,
        intensity: u8,
        reasons: u8,
        rate: RotationRate,
    ) {
        let revolution = self.revolution_at(angle);
        // The first point is somewhere inside its revolution, so this revolution lacks points. The next revolution is
        // the first one with all points.
        let number = *self.number.get_or_insert(revolution + 1);
        let Some(which) = usize::try_from(revolution - number).ok().filter(|which| *which < 2) else {
            // This revolution is not open. Either it is already closed, or the caller has not yet called `close_before`
            // for the revolutions before it. The revolution lacks this point.
            self.last_incomplete = self.last_incomplete.max(revolution);
            return;
        };
        let Some(slot) = self.points[self.at ^ which].get_mut(self.open[which].len) else {
            self.open[which].incomplete = true;
            return;
        };
        let within = angle - revolution as f64 * 360.0;
        let range = if (1..NO_RETURN).contains(&range) { range } else { NO_RETURN };
        *slot = Point { angle: -(within as f32).to_radians(), range, intensity };
        let open = &mut self.open[which];
        open.len += 1;
        open.last = open.last.max(time);
        open.reasons |= reasons;
        // Extrapolate the time at the edge, because the first points of the revolution may be missing.
        let edge = self.edge;
        open.first.get_or_insert_with(|| {
            let points = if rate.step > 0.0 { (within + edge) / rate.step } else { 0.0 };
            (time - points * rate.point_ns).max(0.0)
        });
    }

    /// Records that points are missing between the angles `from` and `to`, in degrees.
    pub fn mark_gap(&mut self, from: f64, to: f64) {
        let Some(number) = self.number else { return };
        let (from, to) = (self.revolution_at(from), self.revolution_at(to));
        for (revolution, open) in (number..).zip(&mut self.open) {
            open.incomplete |= (from..=to).contains(&revolution);
        }
        self.last_incomplete = self.last_incomplete.max(to);
    }

    /// Records that the revolution that is being measured may lack points.
    pub fn mark_incomplete(&mut self) {
        self.open[0].incomplete |= self.number.is_some();
    }

    /// Closes the first open revolution if it ends before `angle`, in degrees. All points before this angle must have
    /// been added. The caller repeats the call until it returns `None`.
    pub fn close_before(&mut self, angle: f64, rate: RotationRate) -> Option<ClosedRevolution> {
        let revolution = self.revolution_at(angle);
        while let Some(number) = self.number.filter(|number| revolution > *number) {
            let open = self.open[0];
            if open.len == 0 && self.open[1].len == 0 {
                self.counts.missed += (revolution - number) as u64;
                self.number = Some(revolution);
                self.serial += 2;
                self.open = [self.new_revolution(revolution), self.new_revolution(revolution + 1)];
                return None;
            }
            // Measure the duration from edge to edge, because the speed of the head may change.
            let usual = rate.revolution_ns();
            let duration = open.first.zip(self.open[1].first).map(|(first, next)| next - first);
            let duration = duration.filter(|took| (0.5 * usual..2.0 * usual).contains(took));
            let is_enough = open.len as f64 >= rate.points_per_revolution() / 2.0;
            let closed = open
                .first
                .filter(|_| is_enough)
                .map(|first| self.close(&open, first, duration.unwrap_or(usual)));
            self.at ^= 1;
            self.serial += 1;
            self.open = [self.open[1], self.new_revolution(number + 2)];
            self.number = Some(number + 1);
            let Some(closed) = closed else {
                self.counts.short += u64::from(open.len > 0);
                self.counts.missed += u64::from(open.len == 0);
                continue;
            };
            self.counts.returned += 1;
            self.counts.incomplete += u64::from(open.incomplete);
            return Some(closed);
        }
        None
    }

    /// Converts the first open revolution to a complete revolution that began at `first` and takes `period`
    /// nanoseconds.
    fn close(&self, open: &OpenRevolution, first: f64, period: f64) -> ClosedRevolution {
        ClosedRevolution {
            number: self.serial,
            points: self.at,
            len: open.len,
            first: first as Nanos,
            last: open.last.max(first) as Nanos,
            period: period as Nanos,
            incomplete: open.incomplete,
            reasons: open.reasons,
        }
    }

    fn new_revolution(&self, revolution: i64) -> OpenRevolution {
        OpenRevolution { incomplete: revolution <= self.last_incomplete, ..OpenRevolution::default() }
    }

    fn revolution_at(&self, angle: f64) -> i64 {
        let revolutions = (angle + self.edge) / 360.0;
        // The conversion to an integer rounds toward zero. Round down, so that angles below zero belong to revolution
        // -1.
        let whole = revolutions as i64;
        if (whole as f64) > revolutions { whole - 1 } else { whole }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn revolution_lasts_from_edge_to_edge() {
        let mut turns = RevolutionAssembler::<400>::new();
        turns.begin(360);
        // The points are 1 degree apart. The head rotates faster after the second revolution.
        for n in 0..735 {
            let angle = f64::from(n);
            let time = 1e6 * angle.min(722.0) + 0.9e6 * (angle - 722.0).max(0.0);
            turns.add_point(angle, time, 1_000, 0, 0, RotationRate { step: 1.0, point_ns: 1e6 });
        }
        let pace = RotationRate { step: 1.0, point_ns: 0.9e6 };
        let closed = turns.close_before(735.0, pace).expect("a turn");
        assert_eq!((closed.len, closed.period), (360, 360_000_000));
    }

    #[test]
    fn revolutions_with_missing_points_are_incomplete() {
        let mut turns = RevolutionAssembler::<400>::new();
        turns.begin(360);
        let pace = RotationRate { step: 1.0, point_ns: 1e6 };
        let put = |turns: &mut RevolutionAssembler<400>, from: u32, to: u32| {
            (from..to).map(f64::from).for_each(|at| turns.add_point(at, 1e6 * at, 1_000, 0, 0, pace));
        };
        put(&mut turns, 0, 600);
        // The gap contains an edge. The next edge has points on both sides.
        turns.mark_gap(601.0, 1_074.0);
        put(&mut turns, 1_075, 1_086);
        let (mut closed_turns, mut count) = ([(0, false); 2], 0);
        for at in 1_086..1_450 {
            while let Some(closed) = turns.close_before(f64::from(at), pace) {
                closed_turns[count] = (closed.len, closed.incomplete);
                count += 1;
            }
            put(&mut turns, at, at + 1);
        }
        assert_eq!(closed_turns, [(240, true), (354, true)]);
    }
}
