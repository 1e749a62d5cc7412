//! Position of a packet in its stream: the next one, one after a gap, a repetition, or an outlier. Angles, speed and
//! milliseconds of two packets of one head have to agree, because a checksum of 8 bits alone does not prove a packet. The
//! sequence counts the packets that are missing between two, and dates packets by the scanner's clock more finely than by
//! its milliseconds. The clock, which starts at 0 with the scanner, also shows [restarts](Restarts).

use scanhub_schema::{MILLIS, Nanos};

use crate::ld::packet::{CLOCK_TURN, POINTS, Packet, TURN};

/// The packets of one stream.
#[derive(Clone, Debug)]
pub(crate) struct Sequence {
    last: Option<Seen>,
    /// One that did not belong there: the next one may tell that it did.
    odd: Option<Seen>,
    /// Of those in a row.
    odds: u32,
    points_per_second: f32,
    /// Packets that it was learned from.
    lessons: u32,
    came: u64,
    lost: u64,
}

#[derive(Clone, Copy, Debug)]
struct Seen {
    start: u16,
    span: u16,
    speed: u16,
    millis: u16,
    /// Degrees of the first point, clockwise over all turns.
    angle: f64,
    /// The scanner's clock since the sequence began, in whole milliseconds and as fine as it is known.
    whole: Nanos,
    time: Nanos,
}

/// The place of a packet in its stream.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Place {
    /// A new sequence begins with it, and with it a new clock.
    First {
        /// When its last point was measured, by the scanner's clock.
        time: Nanos,
        /// Degrees of its first point, clockwise over all turns.
        angle: f64,
    },
    /// It goes on.
    Next {
        /// As in [`Place::First`].
        time: Nanos,
        /// As in [`Place::First`].
        angle: f64,
        /// Packets between the last one and this one.
        missing: u32,
        /// Where the last one's last point was.
        from: f64,
    },
    /// The last one came again.
    Again,
    /// It does not belong here.
    Odd,
}

impl Place {
    /// When its last point was measured, by the scanner's clock; nothing if that is not known.
    pub(crate) fn time(self) -> Option<Nanos> {
        match self {
            Place::First { time, .. } | Place::Next { time, .. } => Some(time),
            Place::Again | Place::Odd => None,
        }
    }
}

/// How a packet follows another one.
struct Step {
    /// 1 for the next one; 0 for the same.
    packets: u32,
    /// Between their first points.
    advance: f32,
    millis: u16,
}

impl Sequence {
    pub(crate) fn new() -> Self {
        Sequence { last: None, odd: None, odds: 0, points_per_second: 0.0, lessons: 0, came: 0, lost: 0 }
    }

    /// The stream ended: the next packet is the first one of another.
    pub(crate) fn end(&mut self) {
        (self.last, self.odd, self.odds, self.lessons) = (None, None, 0, 0);
    }

    /// Points that the scanner measures in a second; nothing before enough packets told.
    pub(crate) fn points_per_second(&self) -> Option<f32> {
        (self.lessons >= LESSONS).then_some(self.points_per_second)
    }

    /// Nanoseconds from one point to the next, as far as they are known.
    pub(crate) fn point_ns(&self) -> f32 {
        if self.lessons > 0 { 1e9 / self.points_per_second } else { 0.0 }
    }

    /// Returns the last known time from one packet to the next, in nanoseconds. It outlives its stream; 0 is unknown.
    pub(crate) fn packet_ns(&self) -> f64 {
        if self.points_per_second > 0.0 {
            POINTS as f64 * 1e9 / f64::from(self.points_per_second)
        } else {
            0.0
        }
    }

    /// Packets that came, and those that did not although the ones before and after them did.
    pub(crate) fn came_and_lost(&self) -> (u64, u64) {
        (self.came, self.lost)
    }

    /// `packet` came.
    pub(crate) fn place(&mut self, packet: &Packet<'_>) -> Place {
        self.came += 1;
        let Some(last) = self.last else { return self.first(packet) };
        if let Some(step) = self.step(&last, packet) {
            if step.packets == 0 {
                self.came -= 1;
                return Place::Again;
            }
            return self.next(&last, packet, &step);
        }
        let goes_on = |odd: &Seen| self.step(odd, packet).is_some_and(|step| step.packets > 0);
        if self.odd.as_ref().is_some_and(goes_on) {
            return self.first(packet);
        }
        self.odd = Some(Seen::first(packet));
        self.odds += 1;
        Place::Odd
    }

    fn first(&mut self, packet: &Packet<'_>) -> Place {
        let seen = Seen::first(packet);
        (self.last, self.odd, self.odds) = (Some(seen), None, 0);
        Place::First { time: seen.time, angle: seen.angle }
    }

    fn next(&mut self, last: &Seen, packet: &Packet<'_>, step: &Step) -> Place {
        let missing = step.packets - 1;
        if missing == 0 {
            self.learn(packet);
        }
        let whole = last.whole + Nanos::from(step.millis) * MILLIS;
        let passed = self.point_ns() * (POINTS as u32 * step.packets) as f32;
        // The milliseconds are cut off, and points come evenly.
        let time = (last.time + passed as Nanos).clamp(whole, whole + MILLIS - 1);
        self.lost += u64::from(missing.saturating_sub(self.odds));
        (self.odd, self.odds) = (None, 0);
        let (start, about) =
            (f64::from(packet.start()) / 100.0, last.angle + f64::from(step.advance) / 100.0);
        let angle = start + 360.0 * ((about - start) / 360.0 + 0.5) as u64 as f64;
        self.last = Some(Seen { angle, whole, time, ..Seen::first(packet) });
        Place::Next { time, angle, missing, from: last.angle + f64::from(last.span) / 100.0 }
    }

    /// How `packet` follows `last`; nothing if it cannot.
    fn step(&self, last: &Seen, packet: &Packet<'_>) -> Option<Step> {
        let (turn, clock_turn) = (f32::from(TURN), u32::from(CLOCK_TURN));
        let millis = ((u32::from(packet.millis()) + clock_turn - u32::from(last.millis)) % clock_turn) as u16;
        if millis > LONGEST_GAP || packet.span().abs_diff(last.span) > last.span / 4 + 30 {
            return None;
        }
        // Hundredths of a degree in a millisecond.
        let speed = f32::from(last.speed) / 10.0;
        let expected = speed * f32::from(millis);
        let off = (f32::from(packet.start()) - f32::from(last.start) - expected) % turn;
        let off = if off > turn / 2.0 { off - turn } else { off };
        let off = if off < -turn / 2.0 { off + turn } else { off };
        if off.abs() > 1.2 * speed + 0.05 * expected + 50.0 {
            return None;
        }
        let advance = expected + off;
        let own = f32::from(last.span) * POINTS as f32 / (POINTS - 1) as f32;
        let packets = match self.points_per_second() {
            // Over a long time the clock knows better how many there were.
            Some(rate) if millis >= LONG => f32::from(millis) * rate / (1_000 * POINTS) as f32,
            _ if own < 1.0 => 1.0,
            _ => advance / own,
        };
        Some(Step { packets: (packets + 0.5).max(0.0) as u32, advance, millis })
    }

    /// How many points a head measures in a second that turns so fast, so far apart.
    fn learn(&mut self, packet: &Packet<'_>) {
        if packet.span() == 0 || packet.speed() == 0 {
            return;
        }
        let step = f32::from(packet.span()) / (POINTS - 1) as f32;
        let rate = f32::from(packet.speed()) * 100.0 / step;
        self.lessons = (self.lessons + 1).min(WINDOW);
        self.points_per_second += (rate - self.points_per_second) / self.lessons as f32;
    }
}

impl Seen {
    fn first(packet: &Packet<'_>) -> Seen {
        let whole = Nanos::from(packet.millis()) * MILLIS;
        Seen {
            start: packet.start(),
            span: packet.span(),
            speed: packet.speed(),
            millis: packet.millis(),
            angle: f64::from(packet.start()) / 100.0,
            whole,
            time: whole + MILLIS / 2,
        }
    }
}

/// Packets that tell how many points there are in a second, and those of which the mean counts.
const LESSONS: u32 = 16;
const WINDOW: u32 = 256;
/// Over so many milliseconds packets are counted by the clock: a turn's tenth and more.
const LONG: u16 = 30;
/// A session without a packet begins again after a second: what comes later is something new.
const LONGEST_GAP: u16 = 1_500;

/// The restarts of one scanner.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Restarts {
    /// Milliseconds of the last packet of a sequence, and the hub's time at which it had arrived.
    last: Option<(u16, Nanos)>,
    /// Whether the sequence that has just begun does not fit the one before it. Its second packet confirms it.
    is_suspected: bool,
    pub(crate) count: u64,
}

impl Restarts {
    /// Notes the first packet of a sequence with its milliseconds. It arrived between the times of `arrival`, which are
    /// `None` if they are unknown.
    pub(crate) fn note_first(&mut self, millis: u16, arrival: Option<(Nanos, Nanos)>) {
        let known = self.last.zip(arrival);
        self.is_suspected = known.is_some_and(|((last, at), (earliest, latest))| {
            let passed = (earliest.saturating_sub(at), latest.saturating_sub(at));
            began_again(last, millis, passed)
        });
    }

    /// Notes a packet that follows another one in its sequence, with its milliseconds and the time `at` which it had arrived.
    pub(crate) fn note_next(&mut self, millis: u16, at: Nanos) {
        self.count += u64::from(core::mem::take(&mut self.is_suspected));
        self.last = Some((millis, at));
    }
}

/// Returns whether a clock that showed `last` milliseconds began again and then showed `millis`, between `least` and `most`
/// nanoseconds later.
fn began_again(last: u16, millis: u16, (least, most): (Nanos, Nanos)) -> bool {
    let turn = Nanos::from(CLOCK_TURN) * MILLIS;
    let tolerance = JITTER + most / DRIFT;
    let began_since = Nanos::from(millis) * MILLIS <= least + JITTER;
    let advance = (turn + Nanos::from(millis) * MILLIS - Nanos::from(last) * MILLIS) % turn;
    let missing = least.saturating_sub(tolerance).saturating_sub(advance);
    let continued = advance + missing.next_multiple_of(turn);
    began_since && continued > most + tolerance
}

/// Error of a time of arrival, and of milliseconds that are cut off.
const JITTER: Nanos = 30 * MILLIS;
/// Two clocks differ by at most one part in this many.
const DRIFT: Nanos = 100;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ld::packet::{Contents, LEN};

    /// Packet number `n` of a head that turns 10 times and measures 4500 points a second.
    fn packet(n: u32) -> [u8; LEN] {
        let start = n * 960;
        Contents {
            speed: 3_600,
            start: (start % 36_000) as u16,
            points: [(1_000, 9); POINTS],
            end: ((start + 880) % 36_000) as u16,
            millis: ((29_900.0 + f64::from(n) * 8.0 / 3.0) % 30_000.0) as u16,
        }
        .encode()
    }

    fn place(sequence: &mut Sequence, bytes: &[u8; LEN]) -> Place {
        sequence.place(&Packet::check(bytes).expect("intact"))
    }

    #[test]
    fn packets_follow_each_other_and_points_come_evenly() {
        let mut sequence = Sequence::new();
        let mut before: Option<Nanos> = None;
        for n in 0..2_000 {
            let place = place(&mut sequence, &packet(n));
            let time = place.time().expect("timed");
            if let (Place::Next { missing, angle, from, .. }, Some(before)) = (place, before) {
                assert_eq!(missing, 0);
                assert!((angle - from - 0.8).abs() < 0.01, "{angle} {from}");
                assert!((angle - f64::from(n) * 9.6).abs() < 0.02, "{n}: {angle}");
                let passed = time - before;
                assert!(n < 100 || passed.abs_diff(2_666_667) < 20_000, "{n}: {passed}");
            }
            before = Some(time);
        }
        assert!((sequence.points_per_second().expect("learned") - 4_500.0).abs() < 5.0);
        assert_eq!(sequence.came_and_lost(), (2_000, 0));
    }

    #[test]
    fn gaps_are_counted_however_long() {
        for gap in [1, 2, 5, 36, 37, 38, 75, 190, 370] {
            let mut sequence = Sequence::new();
            (0..100).for_each(|n| {
                place(&mut sequence, &packet(n));
            });
            let Place::Next { missing, angle, from, .. } = place(&mut sequence, &packet(100 + gap)) else {
                panic!("{gap}");
            };
            assert_eq!(missing, gap);
            assert!((angle - from - f64::from(gap * 960 + 80) / 100.0).abs() < 0.2, "{gap}: {angle} {from}");
            assert_eq!(sequence.came_and_lost(), (101, u64::from(gap)));
        }
    }

    #[test]
    fn what_does_not_belong_there_is_left_out_and_what_goes_on_from_it_is_new() {
        let mut sequence = Sequence::new();
        (0..50).for_each(|n| {
            place(&mut sequence, &packet(n));
        });
        let alien = Contents { speed: 3_600, start: 100, points: [(1, 1); POINTS], end: 900, millis: 17_000 };
        assert_eq!(place(&mut sequence, &alien.encode()), Place::Odd);
        assert_eq!(place(&mut sequence, &packet(49)), Place::Again);
        assert!(matches!(place(&mut sequence, &packet(50)), Place::Next { missing: 0, .. }));
        assert_eq!(place(&mut sequence, &packet(5_000)), Place::Odd);
        assert!(matches!(place(&mut sequence, &packet(5_001)), Place::First { .. }));
        assert!(matches!(place(&mut sequence, &packet(5_002)), Place::Next { missing: 0, .. }));
        assert_eq!(sequence.came_and_lost().1, 0);
    }

    #[test]
    fn a_head_that_stands_still_is_no_error() {
        let mut sequence = Sequence::new();
        for n in 0..100 {
            let still = Contents {
                speed: 0,
                start: 77,
                points: [(1, 1); POINTS],
                end: 77,
                millis: (n * 8 / 3) as u16,
            };
            place(&mut sequence, &still.encode());
        }
        assert_eq!(sequence.points_per_second(), None);
    }

    const SECOND: Nanos = 1_000 * MILLIS;

    fn after(passed: Nanos) -> (Nanos, Nanos) {
        (passed.saturating_sub(5 * MILLIS), passed)
    }

    #[test]
    fn a_clock_that_continues_is_not_a_restart() {
        for last in [0, 1, 12_345, 29_999] {
            for passed in
                [0, 3 * MILLIS, 400 * MILLIS, 12 * SECOND, 29_990 * MILLIS, 31 * SECOND, 125 * SECOND]
            {
                for drift in [-2, 0, 2] {
                    let advance = (passed as i64 + drift * passed as i64 / 1_000) / MILLIS as i64;
                    let millis = ((i64::from(last) + advance) % i64::from(CLOCK_TURN)) as u16;
                    assert!(!began_again(last, millis, after(passed)), "{last} {passed} {drift}");
                }
            }
        }
    }

    #[test]
    fn a_clock_that_begins_again_is_a_restart() {
        for last in [5_000, 12_345, 29_000] {
            for (passed, millis) in [(350, 300), (1_200, 800), (2_300, 2_000), (40_000, 2_000)] {
                assert!(began_again(last, millis, after(passed * MILLIS)), "{last} {passed} {millis}");
            }
        }
    }

    #[test]
    fn bytes_that_waited_in_the_host_are_not_a_restart() {
        // A host that stood still for 9 s read then what was measured at some time since.
        for advance in [100, 2_000, 8_900] {
            assert!(!began_again(1_000, 1_000 + advance, (0, 9 * SECOND)), "{advance}");
        }
        // A host that was suspended: its own clock did not count that time.
        assert!(!began_again(1_000, 17_000, after(500 * MILLIS)));
    }

    #[test]
    fn one_packet_alone_proves_nothing() {
        let mut restarts = Restarts::default();
        restarts.note_first(100, Some((0, 0)));
        restarts.note_next(20_000, SECOND);
        assert_eq!(restarts.count, 0, "first contact");
        let arrival = Some((2 * SECOND, 2 * SECOND));
        restarts.note_first(500, arrival);
        assert_eq!(restarts.count, 0);
        restarts.note_first(21_000, arrival);
        restarts.note_next(21_003, 2 * SECOND);
        assert_eq!(restarts.count, 0, "the one before was a chance match");
        restarts.note_first(500, None);
        restarts.note_next(503, 4 * SECOND);
        assert_eq!(restarts.count, 0, "when it arrived is not known");
        restarts.note_first(300, Some((5 * SECOND, 5 * SECOND)));
        restarts.note_next(303, 5 * SECOND);
        assert_eq!(restarts.count, 1);
    }
}
