//! Points to turns. A turn begins half a step of the grid before the scanner's zero, so that the beam ahead is measured in
//! one piece, and each point belongs to the turn that its own angle says: it may come after points that lie behind it. So a
//! turn is over only when the head is past its end by more than a point can be late, and until then there are two. Knows
//! no bytes and no hub's clock.

use crate::line::grid::{NO_RETURN, Point};
use schema::Nanos;

/// The turn that is being measured, and the next one, of `N` points at the most.
#[derive(Clone, Debug)]
pub struct Turns<const N: usize> {
    points: [[Point; N]; 2],
    /// Which of both holds the points of the first one.
    at: usize,
    open: [Open; 2],
    /// The number of the first one since the sequence began; nothing before that is known.
    number: Option<i64>,
    /// The same among all turns; the second one has the next.
    serial: u64,
    /// The last turn of which it is known that points are missing.
    lacking: i64,
    /// Degrees from the edge of a turn to the zero.
    edge: f64,
    counts: TurnCounts,
}

#[derive(Clone, Copy, Debug, Default)]
struct Open {
    len: usize,
    /// By the scanner's clock, in nanoseconds, at its edge and of its last point.
    first: Option<f64>,
    last: f64,
    incomplete: bool,
    reasons: u8,
}

/// A turn that is over, with times of the scanner's clock; its points stay until the next point comes.
#[derive(Clone, Copy, Debug)]
pub struct Closed {
    /// Which one: no other has this number, not even one that came to no end.
    pub number: u64,
    points: usize,
    len: usize,
    /// When it began: at its edge.
    pub first: Nanos,
    /// When its last point was measured.
    pub last: Nanos,
    /// How long it took.
    pub period: Nanos,
    /// Whether points of it are missing.
    pub incomplete: bool,
    /// Why its points are suspect, bits of [`crate::line::suspect`].
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

/// How fast the head turns past points.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    /// Degrees from one point to the next.
    pub step: f64,
    /// Nanoseconds from one point to the next.
    pub point_ns: f64,
}

impl Pace {
    /// Points of a whole turn.
    fn due(&self) -> f64 {
        360.0 / self.step.max(1e-3)
    }

    /// How long one takes, in nanoseconds.
    fn turn_ns(&self) -> f64 {
        self.due() * self.point_ns
    }
}

impl<const N: usize> Turns<N> {
    /// Nothing is known yet.
    #[expect(clippy::new_without_default, reason = "turns of which nothing is known are no default")]
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

    /// From now on turns are for a grid of so many beams; the open ones are given up.
    pub fn begin(&mut self, beams: usize) {
        self.edge = 180.0 / beams as f64;
        self.give_up();
    }

    /// How many there were of which kind.
    pub fn counts(&self) -> TurnCounts {
        self.counts
    }

    /// The first of the turns that are being measured, as if it ended here.
    pub fn begun(&self, pace: Pace) -> Option<Closed> {
        let open = &self.open[0];
        Some(self.end(open, open.first?, pace.turn_ns()))
    }

    /// The points of a turn that was closed just now, or that is being measured.
    pub fn points(&self, closed: &Closed) -> &[Point] {
        &self.points[closed.points][..closed.len]
    }

    /// The open turns come to no end, and no angle that is known goes on.
    pub fn give_up(&mut self) {
        self.counts.short += u64::from(self.open[0].len > 0);
        self.open = [Open::default(); 2];
        self.serial += 2;
        (self.number, self.lacking) = (None, i64::MIN);
    }

    /// A point at `angle`, in degrees clockwise over all turns, measured at `time`.
    pub fn put(&mut self, angle: f64, time: f64, range: u16, intensity: u8, reasons: u8, pace: Pace) {
        let turn = self.turn_of(angle);
        // Turns are measured from their edge on.
        let number = *self.number.get_or_insert(turn + 1);
        let Some(which) = usize::try_from(turn - number).ok().filter(|which| *which < 2) else {
            // Whoever did not reach it before its points come loses them.
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
        // Where the first points are missing, the edge is dated as if they were there.
        let points = if pace.step > 0.0 { (within + self.edge) / pace.step } else { 0.0 };
        open.first.get_or_insert((time - points * pace.point_ns).max(0.0));
    }

    /// Between these angles points are missing.
    pub fn lacks(&mut self, from: f64, to: f64) {
        let Some(number) = self.number else { return };
        let (from, to) = (self.turn_of(from), self.turn_of(to));
        for (turn, open) in (number..).zip(&mut self.open) {
            open.incomplete |= (from..=to).contains(&turn);
        }
        self.lacking = self.lacking.max(to);
    }

    /// Of the turn that is being measured something may be missing, nobody knows where.
    pub fn doubt(&mut self) {
        self.open[0].incomplete |= self.number.is_some();
    }

    /// All points before `angle` were put. The turn that is over with it, if there is one; then this is to be called
    /// once more.
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
            // A head may change its speed: from edge to edge is what this turn took.
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

    /// The first of the open turns, which began at `first` and takes so many nanoseconds.
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
        // Towards less, also below zero.
        let whole = turns as i64;
        if (whole as f64) > turns { whole - 1 } else { whole }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_takes_the_time_from_its_edge_to_the_next_one() {
        let mut turns = Turns::<400>::new();
        turns.begin(360);
        // Points of a degree each; the head is faster as soon as the turn is over.
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
    fn a_turn_of_which_points_came_before_it_was_reached_lacks_them() {
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
        let (mut told, mut count) = ([(0, false); 2], 0);
        for at in 1_086..1_450 {
            while let Some(closed) = turns.reach(f64::from(at), pace) {
                told[count] = (closed.len, closed.incomplete);
                count += 1;
            }
            put(&mut turns, at, at + 1);
        }
        assert_eq!(told, [(240, true), (354, true)]);
    }
}
