//! Assembles points into revolutions.
//!
//! A revolution begins half a step of the grid before the scanner's zero, so that the beam ahead is measured in one
//! piece. A point belongs to the revolution of its angle, and may arrive after points with larger angles. So a
//! revolution is complete only when the head is past its end by more than a point can be late, and until then there are
//! two. Times are those of the scanner's clock.

use crate::line::{NO_RETURN, Point};
use scanhub_schema::Nanos;

/// The revolution that is being measured, and the next one, with at most `N` points each.
#[derive(Clone, Debug)]
pub struct Turns<const N: usize> {
    points: [[Point; N]; 2],
    /// Index of the buffer with the points of the first one.
    at: usize,
    open: [Open; 2],
    /// Number of the first one since the sequence began, once it is known.
    number: Option<i64>,
    /// Number of the first one among all revolutions. The second one has the next number.
    serial: u64,
    /// The last revolution with missing points.
    lacking: i64,
    /// Degrees from the edge of a revolution to the zero.
    edge: f64,
    counts: TurnCounts,
}

#[derive(Clone, Copy, Debug, Default)]
struct Open {
    len: usize,
    /// Times at its edge and of its last point, in nanoseconds.
    first: Option<f64>,
    last: f64,
    incomplete: bool,
    reasons: u8,
}

/// A complete revolution, in time of the scanner's clock. Its points stay valid until the next point is added.
#[derive(Clone, Copy, Debug)]
pub struct Closed {
    /// Number that no other revolution has, not even one that was given up.
    pub number: u64,
    points: usize,
    len: usize,
    /// Time at its edge, where it begins.
    pub first: Nanos,
    /// Time of its last point.
    pub last: Nanos,
    /// Duration.
    pub period: Nanos,
    /// Whether points are missing.
    pub incomplete: bool,
    /// Reasons for suspicion: bits of [`crate::line::suspect`]; 0 is clean.
    pub reasons: u8,
}

/// Numbers of revolutions by kind. They only increase.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TurnCounts {
    /// Returned revolutions, including incomplete ones.
    pub turns: u64,
    /// Returned revolutions that are incomplete.
    pub incomplete: u64,
    /// Revolutions that were not returned, because less than half of the points arrived.
    pub short: u64,
    /// Revolutions without a packet.
    pub missed: u64,
}

/// Speed of the head, from point to point.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    /// Degrees from one point to the next.
    pub step: f64,
    /// Nanoseconds from one point to the next.
    pub point_ns: f64,
}

impl Pace {
    /// Returns the number of points of a revolution.
    fn due(&self) -> f64 {
        360.0 / self.step.max(1e-3)
    }

    /// Returns the duration of a revolution, in nanoseconds.
    fn turn_ns(&self) -> f64 {
        self.due() * self.point_ns
    }
}

impl<const N: usize> Turns<N> {
    /// Creates it before any point.
    #[expect(clippy::new_without_default, reason = "the start of a stream is not a default value")]
    pub fn new() -> Self {
        const NONE: Point = Point { angle: 0.0, range: NO_RETURN, intensity: 0 };
        Turns {
            points: [[NONE; N]; 2],
            at: 0,
            open: [Open::default(); 2],
            number: None,
            serial: 0,
            lacking: i64::MIN,
            edge: 0.0,
            counts: TurnCounts::default(),
        }
    }

    /// Begins revolutions for a grid of `beams` beams, and gives up the open ones.
    pub fn begin(&mut self, beams: usize) {
        self.edge = 180.0 / beams as f64;
        self.give_up();
    }

    /// Returns the numbers of revolutions by kind.
    pub fn counts(&self) -> TurnCounts {
        self.counts
    }

    /// Returns the first of the open revolutions, as if it ended here.
    pub fn begun(&self, pace: Pace) -> Option<Closed> {
        let open = &self.open[0];
        Some(self.end(open, open.first?, pace.turn_ns()))
    }

    /// Returns the points of the revolution that was completed last, or that is being measured.
    pub fn points(&self, closed: &Closed) -> &[Point] {
        &self.points[closed.points][..closed.len]
    }

    /// Gives up the open revolutions. The next point begins a new sequence of angles.
    pub fn give_up(&mut self) {
        self.counts.short += u64::from(self.open[0].len > 0);
        self.open = [Open::default(); 2];
        self.serial += 2;
        (self.number, self.lacking) = (None, i64::MIN);
    }

    /// Adds a point at `angle`, in degrees clockwise over all revolutions, measured at `time`.
    pub fn put(&mut self, angle: f64, time: f64, range: u16, intensity: u8, reasons: u8, pace: Pace) {
        let turn = self.turn_of(angle);
        // Only the next revolution is measured from its edge on.
        let number = *self.number.get_or_insert(turn + 1);
        let Some(which) = usize::try_from(turn - number).ok().filter(|which| *which < 2) else {
            // The caller has not called `reach` for it before its points.
            self.lacking = self.lacking.max(turn);
            return;
        };
        let Some(place) = self.points[self.at ^ which].get_mut(self.open[which].len) else {
            self.open[which].incomplete = true;
            return;
        };
        let within = angle - turn as f64 * 360.0;
        let range = if (1..NO_RETURN).contains(&range) { range } else { NO_RETURN };
        *place = Point { angle: -(within as f32).to_radians(), range, intensity };
        let open = &mut self.open[which];
        open.len += 1;
        open.last = open.last.max(time);
        open.reasons |= reasons;
        // If the first points are missing, the time at the edge is extrapolated.
        let edge = self.edge;
        open.first.get_or_insert_with(|| {
            let points = if pace.step > 0.0 { (within + edge) / pace.step } else { 0.0 };
            (time - points * pace.point_ns).max(0.0)
        });
    }

    /// Records that points are missing between two angles.
    pub fn lacks(&mut self, from: f64, to: f64) {
        let Some(number) = self.number else { return };
        let (from, to) = (self.turn_of(from), self.turn_of(to));
        for (turn, open) in (number..).zip(&mut self.open) {
            open.incomplete |= (from..=to).contains(&turn);
        }
        self.lacking = self.lacking.max(to);
    }

    /// Records that points may be missing somewhere in the revolution that is being measured.
    pub fn doubt(&mut self) {
        self.open[0].incomplete |= self.number.is_some();
    }

    /// Handles that all points before `angle` were added. Returns a revolution that is complete now. Then call it
    /// again, until it returns `None`.
    pub fn reach(&mut self, angle: f64, pace: Pace) -> Option<Closed> {
        let turn = self.turn_of(angle);
        while let Some(number) = self.number.filter(|number| turn > *number) {
            let open = self.open[0];
            if open.len == 0 && self.open[1].len == 0 {
                self.counts.missed += (turn - number) as u64;
                self.number = Some(turn);
                self.serial += 2;
                self.open = [self.fresh(turn), self.fresh(turn + 1)];
                return None;
            }
            // The duration is that from edge to edge, because a head may change its speed.
            let usual = pace.turn_ns();
            let took = open.first.zip(self.open[1].first).map(|(first, next)| next - first);
            let took = took.filter(|took| (0.5 * usual..2.0 * usual).contains(took));
            let is_enough = open.len as f64 >= pace.due() / 2.0;
            let closed =
                open.first.filter(|_| is_enough).map(|first| self.end(&open, first, took.unwrap_or(usual)));
            self.at ^= 1;
            self.serial += 1;
            self.open = [self.open[1], self.fresh(number + 2)];
            self.number = Some(number + 1);
            let Some(closed) = closed else {
                self.counts.short += u64::from(open.len > 0);
                self.counts.missed += u64::from(open.len == 0);
                continue;
            };
            self.counts.turns += 1;
            self.counts.incomplete += u64::from(open.incomplete);
            return Some(closed);
        }
        None
    }

    /// Returns the first of the open revolutions, which began at `first` and takes `period` nanoseconds.
    fn end(&self, open: &Open, first: f64, period: f64) -> Closed {
        Closed {
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

    fn fresh(&self, turn: i64) -> Open {
        Open { incomplete: turn <= self.lacking, ..Open::default() }
    }

    fn turn_of(&self, angle: f64) -> i64 {
        let turns = (angle + self.edge) / 360.0;
        // Round down, even below zero.
        let whole = turns as i64;
        if (whole as f64) > turns { whole - 1 } else { whole }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn revolution_lasts_from_edge_to_edge() {
        let mut turns = Turns::<400>::new();
        turns.begin(360);
        // Points of one degree each. The head is faster after the first revolutions.
        for n in 0..735 {
            let angle = f64::from(n);
            let time = 1e6 * angle.min(722.0) + 0.9e6 * (angle - 722.0).max(0.0);
            turns.put(angle, time, 1_000, 0, 0, Pace { step: 1.0, point_ns: 1e6 });
        }
        let pace = Pace { step: 1.0, point_ns: 0.9e6 };
        let closed = turns.reach(735.0, pace).expect("a turn");
        assert_eq!((closed.len, closed.period), (360, 360_000_000));
    }

    #[test]
    fn lacks_points_that_arrived_before_it_was_reached() {
        let mut turns = Turns::<400>::new();
        turns.begin(360);
        let pace = Pace { step: 1.0, point_ns: 1e6 };
        let put = |turns: &mut Turns<400>, from: u32, to: u32| {
            (from..to).map(f64::from).for_each(|at| turns.put(at, 1e6 * at, 1_000, 0, 0, pace));
        };
        put(&mut turns, 0, 600);
        // A gap over an edge, and points on both sides of the next one.
        turns.lacks(601.0, 1_074.0);
        put(&mut turns, 1_075, 1_086);
        let (mut closed_turns, mut count) = ([(0, false); 2], 0);
        for at in 1_086..1_450 {
            while let Some(closed) = turns.reach(f64::from(at), pace) {
                closed_turns[count] = (closed.len, closed.incomplete);
                count += 1;
            }
            put(&mut turns, at, at + 1);
        }
        assert_eq!(closed_turns, [(240, true), (354, true)]);
    }
}
