//! What a packet is to the one before it: the next one, one after a gap, or something that does not belong there. Packets have
//! no counter. But a head turns evenly, so the angle from packet to packet is known, and how many are missing in a gap is
//! that angle's share of it; how many turns are missing besides, only the time tells. Knows no bytes.

/// The packets of one stream: of several points each, or of one.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sequence {
    last: Option<Seen>,
    /// One that did not belong there: the next one may tell that it did.
    odd: Option<f32>,
    odds: u32,
    /// Degrees from one packet to the next, and packets that it was learned from.
    advance: f64,
    lessons: u32,
    /// Of packets of one point: where a full turn is counted from, and how many came since.
    counted: (f64, u32),
    is_whole: bool,
    /// As many points as bytes between them may have been that came since.
    doubtful: u32,
    came: u64,
    lost: u64,
}

#[derive(Clone, Copy, Debug)]
struct Seen {
    start: f32,
    angle: f64,
    time: f64,
}

/// The place of a packet in its stream.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Place {
    /// How it follows.
    pub(crate) step: Step,
    /// Degrees of its first point, clockwise over all turns.
    pub(crate) angle: f64,
    /// When its first point was measured, by the scanner's clock in nanoseconds.
    pub(crate) time: f64,
}

/// How a packet follows the last one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Step {
    /// A new sequence begins with it, and with it a new clock.
    First,
    /// It is the next one.
    Next,
    /// Others are missing between, or may be: the last one was at `from`.
    Gap {
        /// Degrees, as in [`Place::angle`].
        from: f64,
        /// So long it took, in nanoseconds, by the packets that were counted.
        ns: f64,
    },
    /// It does not belong here.
    Odd,
}

/// A packet that came.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Came {
    /// Degrees of its first point, clockwise.
    pub(crate) start: f32,
    /// Bytes between it and the last one that are in nothing.
    pub(crate) skipped: u32,
    /// Nanoseconds from one packet to the next.
    pub(crate) packet_ns: f64,
}

impl Came {
    fn adjoins(&self) -> bool {
        self.skipped == 0
    }
}

impl Sequence {
    pub(crate) fn new() -> Self {
        Sequence {
            last: None,
            odd: None,
            odds: 0,
            advance: 0.0,
            lessons: 0,
            counted: (0.0, 0),
            is_whole: true,
            doubtful: 0,
            came: 0,
            lost: 0,
        }
    }

    /// The stream ended: the next packet is the first one of another.
    pub(crate) fn end(&mut self) {
        (self.last, self.odd, self.odds, self.lessons) = (None, None, 0, 0);
    }

    /// Whether a packet came since the stream began.
    pub(crate) fn is_begun(&self) -> bool {
        self.last.is_some()
    }

    /// Packets that came, and those that did not although the ones before and after them did.
    pub(crate) fn came_and_lost(&self) -> (u64, u64) {
        (self.came, self.lost)
    }

    /// Degrees from one packet to the next; nothing before that is known, or if the head stands still.
    pub(crate) fn advance(&self) -> Option<f64> {
        (self.lessons >= LESSONS && self.advance > STILL).then_some(self.advance)
    }

    /// A packet of several points came; `late` says by how many nanoseconds more than usual, if its first point was
    /// measured at that time, and whether it is behind a gap.
    pub(crate) fn place(&mut self, came: Came, late: impl Fn(f64, bool) -> f64) -> Place {
        self.came += 1;
        let Some(last) = self.last else { return self.first(came.start) };
        let angle = clockwise(last.start, came.start);
        let Some(advance) = self.advance() else {
            let is_even = (angle - self.advance).abs() <= 0.25 * self.advance + 1.0;
            if angle > WIDEST || !came.adjoins() || (self.lessons > 0 && !is_even) {
                return self.first(came.start);
            }
            self.lessons += 1;
            self.advance += (angle - self.advance) / f64::from(self.lessons.min(8));
            return self.next(last, came, angle, 1.0, Step::Next);
        };
        let turn = Turn { advance, packet_ns: came.packet_ns };
        let is_next = came.adjoins() && self.odds == 0 && (angle - advance).abs() <= 0.25 * advance;
        if is_next && turn.missing(late(last.time + came.packet_ns, false)) == 0.0 {
            let is_even = (angle - advance).abs() <= 0.08 * advance;
            self.lessons = if is_even { self.lessons + 1 } else { LESSONS };
            self.advance += (angle - advance) / 4.0;
            return self.next(last, came, angle, 1.0, Step::Next);
        }
        let late = |time: f64| late(time, true);
        let angle = angle + 360.0 * turn.missing(late(last.time + turn.time(angle)));
        let packets = f64::from((angle / advance + 0.5) as u32);
        // In a long gap a head may have changed its speed: then the time tells better how many there were.
        let most = f64::from((0.1 * packets) as u32);
        let late_by = late(last.time + packets * came.packet_ns) / came.packet_ns;
        let off = (late_by + 0.5f64.copysign(late_by)).clamp(-most, most) as i32;
        let packets = packets + f64::from(off);
        let tolerance = advance * ((0.25 + 0.01 * packets).min(0.5) + f64::from(off.abs()));
        let late = late(last.time + packets * came.packet_ns);
        if packets < 1.0 || (angle - packets * advance).abs() > tolerance || turn.is_early(late, angle) {
            return self.odd(came);
        }
        if turn.is_apart(late) {
            return self.first(came.start);
        }
        let ns = packets * came.packet_ns;
        self.next(last, came, angle, packets, Step::Gap { from: last.angle, ns })
    }

    /// A packet of one point came: such points may lie before ones that came before them.
    pub(crate) fn place_point(&mut self, came: Came, late: impl Fn(f64, bool) -> f64) -> Place {
        self.came += 1;
        let Some(last) = self.last else { return self.first(came.start) };
        let angle = clockwise(last.start, came.start);
        let angle = if angle > 360.0 - BACK { angle - 360.0 } else { angle };
        self.is_whole &= came.adjoins();
        // What is left of points that lost bytes, or had one too many; what took less time than points do was none.
        let points = f64::from(1 + (came.skipped + 3) / POINT);
        let early = if came.adjoins() { 0.0 } else { -late(last.time + points * came.packet_ns, false) };
        let points = f64::from((points - early.max(0.0) / came.packet_ns).max(1.0) as u32);
        let Some(advance) = self.advance() else {
            if angle > WIDEST {
                return self.first(came.start);
            }
            return self.next_point(last, came, angle, points, Step::Next);
        };
        let turn = Turn { advance, packet_ns: came.packet_ns };
        let late = |time: f64| late(time, angle > AHEAD);
        let due = last.time + turn.time(angle.max(advance));
        let turns = turn.missing(late(due));
        if angle <= AHEAD && turns == 0.0 {
            self.doubtful += (came.skipped + 3) / POINT;
            let is_gap = !came.adjoins() && self.doubtful > GAP;
            let ns = points * came.packet_ns;
            let step = if is_gap { Step::Gap { from: last.angle, ns } } else { Step::Next };
            return self.next_point(last, came, angle, points, step);
        }
        let late = late(due + turn.time(360.0 * turns));
        if turn.is_early(late, angle) || (came.adjoins() && turns == 0.0) {
            return self.odd(came);
        }
        if turn.is_apart(late) {
            return self.first(came.start);
        }
        let angle = angle + 360.0 * turns;
        let points = (angle / advance + 0.5) as u32;
        let is_gap = points > GAP;
        let ns = f64::from(points) * came.packet_ns;
        let step = if is_gap { Step::Gap { from: last.angle, ns } } else { Step::Next };
        self.next_point(last, came, angle, f64::from(points.max(1)), step)
    }

    fn first(&mut self, start: f32) -> Place {
        let (angle, time) = (f64::from(start), BEGIN);
        (self.counted, self.doubtful) = ((angle, 0), 0);
        self.last = Some(Seen { start, angle, time });
        (self.odd, self.odds, self.lessons, self.advance) = (None, 0, 0, 0.0);
        Place { step: Step::First, angle, time }
    }

    /// It came `packets` packets and `angle` degrees after `last`.
    fn next(&mut self, last: Seen, came: Came, angle: f64, packets: f64, step: Step) -> Place {
        let is_steady = self.lessons >= STEADY;
        let missing = if is_steady { (packets - 1.0).max(0.0) as u64 } else { 0 };
        self.lost += missing.saturating_sub(u64::from(self.odds));
        (self.odd, self.odds) = (None, 0);
        let (angle, time) = (last.angle + angle, last.time + packets * came.packet_ns);
        self.last = Some(Seen { start: came.start, angle, time });
        Place { step, angle, time }
    }

    fn next_point(&mut self, last: Seen, came: Came, angle: f64, packets: f64, step: Step) -> Place {
        let place = self.next(last, came, angle, packets, step);
        self.counted.1 += packets as u32;
        let (from, count) = self.counted;
        let passed = place.angle - from;
        // A turn in which the head stood still is none.
        if self.advance().is_some_and(|advance| f64::from(count) > (passed + 90.0) / advance) {
            return self.first(came.start);
        }
        if passed < 360.0 {
            return place;
        }
        (self.counted, self.doubtful) = ((place.angle, 0), 0);
        let whole = core::mem::replace(&mut self.is_whole, true);
        match self.advance() {
            // What is missing without a jump of the angle.
            Some(advance) if !whole => {
                let missing = passed / advance - f64::from(count);
                if missing >= 2.0 {
                    self.lost += missing as u64;
                    self.last.iter_mut().for_each(|last| last.time += missing * came.packet_ns);
                }
            }
            known => {
                let is = passed / f64::from(count);
                let even = known.filter(|advance| (is - advance).abs() <= 0.1 * advance);
                self.lessons = if even.is_some() { STEADY } else { LESSONS };
                self.advance = even.map_or(is, |advance| advance + (is - advance) / 4.0);
            }
        }
        place
    }

    /// It does not belong here, unless it goes on from the last one that did not.
    fn odd(&mut self, came: Came) -> Place {
        let follows = self.odd.is_some_and(|odd| clockwise(odd, came.start) < WIDEST);
        if follows && came.adjoins() && self.odds + 1 >= LESSONS {
            return self.first(came.start);
        }
        self.odd = Some(came.start);
        self.odds += 1;
        Place { step: Step::Odd, angle: 0.0, time: 0.0 }
    }
}

/// Degrees from one angle to another, 0 to 360.
fn clockwise(from: f32, to: f32) -> f64 {
    let angle = f64::from(to) - f64::from(from);
    if angle < 0.0 { angle + 360.0 } else { angle }
}

/// How fast a head turns.
#[derive(Clone, Copy)]
struct Turn {
    /// Degrees from one packet to the next, and nanoseconds.
    advance: f64,
    packet_ns: f64,
}

impl Turn {
    /// Nanoseconds that `angle` degrees take.
    fn time(self, angle: f64) -> f64 {
        angle / self.advance * self.packet_ns
    }

    /// How many turns are missing where a packet comes later than usual by `late`.
    fn missing(self, late: f64) -> f64 {
        f64::from((late.max(0.0) / self.time(360.0) + 0.5) as u32)
    }

    /// Whether a packet that is `angle` degrees behind the last one comes before it was measured: clocks differ by little.
    fn is_early(self, late: f64, angle: f64) -> bool {
        late < -(EARLY + MOST_DRIFT * self.time(angle))
    }

    /// Whether a packet comes so much later than its angle says that the scanner did not send for a while.
    fn is_apart(self, late: f64) -> bool {
        late > 0.15 * self.time(360.0)
    }
}

/// Packets that agree before it is believed how far they are apart; and those in a row that may be wrong.
const LESSONS: u32 = 3;
/// Packets that agree before it is believed that what does not come is missing: a head gets up to its speed.
const STEADY: u32 = 12;
/// Degrees of the widest packet: a head that turns so fast measures less than four of them in a turn.
const WIDEST: f64 = 100.0;
/// Degrees of a packet of a head that stands still.
const STILL: f64 = 0.02;
/// The scanner's clock begins so late that nothing is before it, in nanoseconds.
const BEGIN: f64 = 1e10;
/// Degrees by which a point may lie before one that came before it, and behind it without a gap.
const BACK: f64 = 25.0;
const AHEAD: f64 = 25.0;
/// Nanoseconds by which nothing comes before its time, and the share of the time since the last packet by which two clocks
/// may differ.
const EARLY: f64 = 3e6;
const MOST_DRIFT: f64 = 0.02;
/// Bytes of a packet of one point.
const POINT: u32 = 5;
/// So many points of a stream of single ones may be missing without a word.
const GAP: u32 = 30;

#[cfg(test)]
mod tests {
    use super::*;

    /// Packets of a head that gets up to its speed within 200 of them, and goes on.
    #[test]
    fn nothing_is_lost_while_a_head_gets_up_to_its_speed() {
        for steps in [20.0, 60.0, 200.0] {
            let (mut sequence, mut start, mut begun) = (Sequence::new(), 0.0f64, 0.0);
            for n in 0..400 {
                let at = BEGIN + f64::from(n) * 8e6;
                let came = Came { start: (start % 360.0) as f32, skipped: 0, packet_ns: 8e6 };
                let place = sequence.place(came, |time, _| at - begun - time);
                if place.step == Step::First {
                    begun = at - BEGIN;
                }
                assert!(n < 300 || place.step == Step::Next, "{steps} {n}: {place:?}");
                start += 21.4 * (f64::from(n) / steps).min(1.0);
            }
            assert_eq!(sequence.came_and_lost(), (400, 0), "{steps}");
        }
    }

    /// Packets are counted by the time where the angle leaves it open, to the nearest.
    #[test]
    fn over_a_long_gap_the_time_tells_how_many_packets_there_were() {
        let (mut sequence, packet_ns, advance) = (Sequence::new(), 12e6, 32.57);
        let mut place = |n: f64, angle: f64| {
            let came = Came { start: (angle % 360.0) as f32, skipped: 0, packet_ns };
            sequence.place(came, |time, _| BEGIN + n * packet_ns - time)
        };
        (0..40).map(f64::from).for_each(|n| {
            place(n, n * advance);
        });
        // The head turned by 0.2 % slower.
        let behind = place(39.0 + 256.8, (39.0 + 256.4) * advance);
        assert!(matches!(behind.step, Step::Gap { .. }), "{behind:?}");
        assert_eq!(((behind.time - BEGIN) / packet_ns).round(), 39.0 + 257.0);
    }

    #[test]
    fn what_a_line_puts_between_points_are_no_points() {
        let (mut sequence, packet_ns, advance) = (Sequence::new(), 217e3, 0.78);
        let mut place = |n: u32, skipped: u32| {
            let start = (f64::from(n) * advance % 360.0) as f32;
            let came = Came { start, skipped, packet_ns };
            sequence.place_point(came, |time, _| BEGIN + f64::from(n) * packet_ns - time)
        };
        (0..3_000).for_each(|n| {
            place(n, 0);
        });
        // 12 bytes after each point, then 4,693 at once, and a piece of ten points that are gone.
        let steps: [Step; 49] = core::array::from_fn(|i| place(3_001 + i as u32, 12).step);
        assert!(matches!(steps, [Step::Next, .., Step::Gap { .. }]), "so many may have been points");
        place(3_051, 4_693);
        let last = place(3_060, 43);
        assert!(((last.time - BEGIN) / packet_ns - 3_060.0).abs() < 1.5, "{last:?}");
        assert_eq!(sequence.came_and_lost().1, 2 + 8);
    }
}
