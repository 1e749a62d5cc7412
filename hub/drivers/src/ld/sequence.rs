//! Position of each packet in its stream: the first packet of a sequence, the next packet, a repeated packet, or an
//! outlier.
//!
//! An 8-bit checksum alone does not prove that bytes are a packet, so the angles, the speed and the milliseconds of
//! consecutive packets must also agree. The sequencer counts missing packets. It also computes times in the scanner's
//! clock that are finer than the milliseconds in the packets. The scanner's clock starts at 0 when the scanner starts,
//! so the clock also reveals [restarts](Restarts) of the scanner.

use scanhub_schema::{MILLIS, Nanos};

use crate::ld::packet::{CLOCK_PERIOD_MS, FULL_CIRCLE, POINTS_PER_PACKET, Packet};

/// State of a stream: its last packet, its rate of points, and its packet counters.
#[derive(Clone, Debug)]
pub(crate) struct PacketSequencer {
    last: Option<LastPacket>,
    /// Last packet that did not continue the sequence. If the next packet continues from the outlier, a new sequence
    /// starts.
    outlier: Option<LastPacket>,
    /// Number of consecutive outliers.
    outliers: u32,
    points_per_second: f32,
    /// Number of packets from which `points_per_second` was estimated, up to [`WINDOW_PACKETS`].
    learned_packets: u32,
    received: u64,
    lost: u64,
}

#[derive(Clone, Copy, Debug)]
struct LastPacket {
    start: u16,
    span: u16,
    speed: u16,
    millis: u16,
    /// Angle of the first point, in degrees clockwise, cumulative over all revolutions.
    angle: f64,
    /// Time of the last point in the scanner's clock. `whole` is a whole number of milliseconds, as in the packet, and
    /// `time` is the best estimate.
    whole: Nanos,
    time: Nanos,
}

/// Position of a packet in its stream.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum PacketPosition {
    /// The packet starts a new sequence, with a new clock.
    First {
        /// Time of the packet's last point, in the scanner's clock.
        time: Nanos,
        /// Angle of the packet's first point, in degrees clockwise, cumulative over all revolutions.
        angle: f64,
    },
    /// The packet continues the sequence.
    Next {
        /// Time of the packet's last point, in the scanner's clock.
        time: Nanos,
        /// Angle of the packet's first point, in degrees clockwise, cumulative over all revolutions.
        angle: f64,
        /// Number of packets that are missing between the previous packet and this one.
        missing: u32,
        /// Angle of the previous packet's last point, in degrees clockwise, cumulative over all revolutions.
        from: f64,
    },
    /// The packet equals the previous packet.
    Repeated,
    /// The packet does not fit into the sequence.
    Outlier,
}

impl PacketPosition {
    /// Returns the time of the packet's last point, in the scanner's clock. Returns `None` for a packet that is not
    /// part of the sequence.
    pub(crate) fn time(self) -> Option<Nanos> {
        match self {
            PacketPosition::First { time, .. } | PacketPosition::Next { time, .. } => Some(time),
            PacketPosition::Repeated | PacketPosition::Outlier => None,
        }
    }
}

/// Difference between two packets of a sequence.
struct PacketStep {
    /// Number of packets from the first to the second packet. This number is 1 if the second packet directly follows
    /// the first one, and 0 if the two packets are the same.
    packets: u32,
    /// Angle from the first point of the first packet to the first point of the second packet, in hundredths of a
    /// degree.
    advance: f32,
    millis: u16,
}

impl PacketSequencer {
    pub(crate) fn new() -> Self {
        PacketSequencer {
            last: None,
            outlier: None,
            outliers: 0,
            points_per_second: 0.0,
            learned_packets: 0,
            received: 0,
            lost: 0,
        }
    }

    /// Ends the stream. The next packet starts a new sequence.
    pub(crate) fn end(&mut self) {
        (self.last, self.outlier, self.outliers, self.learned_packets) = (None, None, 0, 0);
    }

    /// Returns the number of points that the scanner measures per second. Returns `None` until enough packets have
    /// arrived.
    pub(crate) fn points_per_second(&self) -> Option<f32> {
        (self.learned_packets >= LEARNING_PACKETS).then_some(self.points_per_second)
    }

    /// Returns the estimated time from one point to the next, in nanoseconds; 0 if it is unknown.
    pub(crate) fn point_ns(&self) -> f32 {
        if self.learned_packets > 0 { 1e9 / self.points_per_second } else { 0.0 }
    }

    /// Returns the last known time from one packet to the next, in nanoseconds, or 0 if this time was never known. The
    /// end of the stream does not reset it.
    pub(crate) fn packet_ns(&self) -> f64 {
        if self.points_per_second > 0.0 {
            POINTS_PER_PACKET as f64 * 1e9 / f64::from(self.points_per_second)
        } else {
            0.0
        }
    }

    /// Returns the number of packets that arrived, and the number of missing packets between them.
    pub(crate) fn received_and_lost(&self) -> (u64, u64) {
        (self.received, self.lost)
    }

    /// Returns the position of the next received packet, and counts the packet.
    pub(crate) fn locate(&mut self, packet: &Packet<'_>) -> PacketPosition {
        self.received += 1;
        let Some(last) = self.last else { return self.locate_first(packet) };
        if let Some(step) = self.step_from(&last, packet) {
            if step.packets == 0 {
                self.received -= 1;
                return PacketPosition::Repeated;
            }
            return self.locate_next(&last, packet, &step);
        }
        let continues =
            |outlier: &LastPacket| self.step_from(outlier, packet).is_some_and(|step| step.packets > 0);
        if self.outlier.as_ref().is_some_and(continues) {
            return self.locate_first(packet);
        }
        self.outlier = Some(LastPacket::first(packet));
        self.outliers += 1;
        PacketPosition::Outlier
    }

    fn locate_first(&mut self, packet: &Packet<'_>) -> PacketPosition {
        let first = LastPacket::first(packet);
        (self.last, self.outlier, self.outliers) = (Some(first), None, 0);
        PacketPosition::First { time: first.time, angle: first.angle }
    }

    fn locate_next(&mut self, last: &LastPacket, packet: &Packet<'_>, step: &PacketStep) -> PacketPosition {
        let missing = step.packets - 1;
        if missing == 0 {
            self.estimate_rate(packet);
        }
        let whole = last.whole + Nanos::from(step.millis) * MILLIS;
        let passed = self.point_ns() * (POINTS_PER_PACKET as u32 * step.packets) as f32;
        // The clock in packets has whole milliseconds, but points are evenly spaced in time.
        let time = (last.time + passed as Nanos).clamp(whole, whole + MILLIS - 1);
        self.lost += u64::from(missing.saturating_sub(self.outliers));
        (self.outlier, self.outliers) = (None, 0);
        let (start, estimate) =
            (f64::from(packet.start()) / 100.0, last.angle + f64::from(step.advance) / 100.0);
        let angle = start + 360.0 * ((estimate - start) / 360.0 + 0.5) as u64 as f64;
        self.last = Some(LastPacket { angle, whole, time, ..LastPacket::first(packet) });
        PacketPosition::Next { time, angle, missing, from: last.angle + f64::from(last.span) / 100.0 }
    }

    /// Returns the difference from `last` to `packet`. Returns `None` if `packet` does not fit into the sequence.
    fn step_from(&self, last: &LastPacket, packet: &Packet<'_>) -> Option<PacketStep> {
        let (full_circle, clock_turn) = (f32::from(FULL_CIRCLE), u32::from(CLOCK_PERIOD_MS));
        let millis = ((u32::from(packet.millis()) + clock_turn - u32::from(last.millis)) % clock_turn) as u16;
        if millis > MAX_GAP_MS || packet.span().abs_diff(last.span) > last.span / 4 + 30 {
            return None;
        }
        // Speed in hundredths of a degree per millisecond.
        let speed = f32::from(last.speed) / 10.0;
        let expected = speed * f32::from(millis);
        let off = (f32::from(packet.start()) - f32::from(last.start) - expected) % full_circle;
        let off = if off > full_circle / 2.0 { off - full_circle } else { off };
        let off = if off < -full_circle / 2.0 { off + full_circle } else { off };
        if off.abs() > 1.2 * speed + 0.05 * expected + 50.0 {
            return None;
        }
        let advance = expected + off;
        let packet_angle = f32::from(last.span) * POINTS_PER_PACKET as f32 / (POINTS_PER_PACKET - 1) as f32;
        let packets = match self.points_per_second() {
            // Over a long gap, the clock gives the number of packets more exactly than the angles.
            Some(rate) if millis >= LONG_GAP_MS => {
                f32::from(millis) * rate / (1_000 * POINTS_PER_PACKET) as f32
            }
            _ if packet_angle < 1.0 => 1.0,
            _ => advance / packet_angle,
        };
        Some(PacketStep { packets: (packets + 0.5).max(0.0) as u32, advance, millis })
    }

    /// Updates the estimated number of points per second with the speed in `packet` and the angle between its points.
    fn estimate_rate(&mut self, packet: &Packet<'_>) {
        if packet.span() == 0 || packet.speed() == 0 {
            return;
        }
        let step = f32::from(packet.span()) / (POINTS_PER_PACKET - 1) as f32;
        let rate = f32::from(packet.speed()) * 100.0 / step;
        self.learned_packets = (self.learned_packets + 1).min(WINDOW_PACKETS);
        self.points_per_second += (rate - self.points_per_second) / self.learned_packets as f32;
    }
}

impl LastPacket {
    fn first(packet: &Packet<'_>) -> LastPacket {
        let whole = Nanos::from(packet.millis()) * MILLIS;
        LastPacket {
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

/// Number of packets after which the number of points per second is known. The moving average of this number covers
/// `WINDOW_PACKETS` packets.
const LEARNING_PACKETS: u32 = 16;
const WINDOW_PACKETS: u32 = 256;
/// Minimum duration of a gap whose missing packets are counted with the clock, in milliseconds. The head rotates by a
/// tenth of a revolution or more in this time.
const LONG_GAP_MS: u16 = 30;
/// Maximum gap within a sequence, in milliseconds. A session restarts after one second without a packet, so a later
/// packet belongs to a new stream.
const MAX_GAP_MS: u16 = 1_500;

/// Detector that counts the restarts of a scanner.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Restarts {
    /// Milliseconds in the last packet of a sequence, and the time of the hub's clock by which this packet had arrived.
    last: Option<(u16, Nanos)>,
    /// Whether the clock in the new sequence does not continue the clock in the previous one, so that the scanner seems
    /// to have restarted. The second packet of the new sequence confirms the restart.
    is_suspected: bool,
    pub(crate) count: u64,
}

impl Restarts {
    /// Handles the first packet of a sequence. The clock in the packet shows `millis`. `arrival` contains the earliest
    /// and the latest time at which the packet can have arrived. It is `None` if these times are unknown.
    pub(crate) fn note_first(&mut self, millis: u16, arrival: Option<(Nanos, Nanos)>) {
        let known = self.last.zip(arrival);
        self.is_suspected = known.is_some_and(|((last, at), (earliest, latest))| {
            let passed = (earliest.saturating_sub(at), latest.saturating_sub(at));
            has_restarted(last, millis, passed)
        });
    }

    /// Handles a packet that continues a sequence. The clock in the packet shows `millis`. The packet had arrived by
    /// the time `at`.
    pub(crate) fn note_next(&mut self, millis: u16, at: Nanos) {
        self.count += u64::from(core::mem::take(&mut self.is_suspected));
        self.last = Some((millis, at));
    }
}

/// Returns whether a scanner's clock restarted between two packets. The clock showed `last` milliseconds in the first
/// packet and `millis` milliseconds in the second one. The time between the packets was `min_passed` to `max_passed`
/// nanoseconds.
fn has_restarted(last: u16, millis: u16, (min_passed, max_passed): (Nanos, Nanos)) -> bool {
    let clock_period = Nanos::from(CLOCK_PERIOD_MS) * MILLIS;
    let tolerance = ARRIVAL_JITTER + max_passed / DRIFT_DIVISOR;
    let began_since = Nanos::from(millis) * MILLIS <= min_passed + ARRIVAL_JITTER;
    let advance = (clock_period + Nanos::from(millis) * MILLIS - Nanos::from(last) * MILLIS) % clock_period;
    let missing = min_passed.saturating_sub(tolerance).saturating_sub(advance);
    let continued = advance + missing.next_multiple_of(clock_period);
    began_since && continued > max_passed + tolerance
}

/// Maximum error of the difference between an arrival time and the milliseconds in a packet.
const ARRIVAL_JITTER: Nanos = 30 * MILLIS;
/// Inverse of the maximum drift between the scanner's clock and the hub's clock.
const DRIFT_DIVISOR: Nanos = 100;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ld::packet::{PACKET_LEN, PacketContents};

    /// Returns packet number `n` of a scanner that rotates 10 times per second and measures 4500 points per second.
    fn packet(n: u32) -> [u8; PACKET_LEN] {
        let start = n * 960;
        PacketContents {
            speed: 3_600,
            start: (start % 36_000) as u16,
            points: [(1_000, 9); POINTS_PER_PACKET],
            end: ((start + 880) % 36_000) as u16,
            millis: ((29_900.0 + f64::from(n) * 8.0 / 3.0) % 30_000.0) as u16,
        }
        .encode()
    }

    fn place(sequence: &mut PacketSequencer, bytes: &[u8; PACKET_LEN]) -> PacketPosition {
        sequence.locate(&Packet::check(bytes).expect("intact"))
    }

    #[test]
    fn consecutive_packets_have_evenly_spaced_points() {
        let mut sequence = PacketSequencer::new();
        let mut before: Option<Nanos> = None;
        for n in 0..2_000 {
            let place = place(&mut sequence, &packet(n));
            let time = place.time().expect("timed");
            if let (PacketPosition::Next { missing, angle, from, .. }, Some(before)) = (place, before) {
                assert_eq!(missing, 0);
                assert!((angle - from - 0.8).abs() < 0.01, "{angle} {from}");
                assert!((angle - f64::from(n) * 9.6).abs() < 0.02, "{n}: {angle}");
                let passed = time - before;
                assert!(n < 100 || passed.abs_diff(2_666_667) < 20_000, "{n}: {passed}");
            }
            before = Some(time);
        }
        assert!((sequence.points_per_second().expect("learned") - 4_500.0).abs() < 5.0);
        assert_eq!(sequence.received_and_lost(), (2_000, 0));
    }

    #[test]
    fn counts_missing_packets_of_any_gap() {
        for gap in [1, 2, 5, 36, 37, 38, 75, 190, 370] {
            let mut sequence = PacketSequencer::new();
            (0..100).for_each(|n| {
                place(&mut sequence, &packet(n));
            });
            let PacketPosition::Next { missing, angle, from, .. } = place(&mut sequence, &packet(100 + gap))
            else {
                panic!("{gap}");
            };
            assert_eq!(missing, gap);
            assert!((angle - from - f64::from(gap * 960 + 80) / 100.0).abs() < 0.2, "{gap}: {angle} {from}");
            assert_eq!(sequence.received_and_lost(), (101, u64::from(gap)));
        }
    }

    #[test]
    fn drops_odd_packet_and_restarts_at_its_successor() {
        let mut sequence = PacketSequencer::new();
        (0..50).for_each(|n| {
            place(&mut sequence, &packet(n));
        });
        let alien = PacketContents {
            speed: 3_600,
            start: 100,
            points: [(1, 1); POINTS_PER_PACKET],
            end: 900,
            millis: 17_000,
        };
        assert_eq!(place(&mut sequence, &alien.encode()), PacketPosition::Outlier);
        assert_eq!(place(&mut sequence, &packet(49)), PacketPosition::Repeated);
        assert!(matches!(place(&mut sequence, &packet(50)), PacketPosition::Next { missing: 0, .. }));
        assert_eq!(place(&mut sequence, &packet(5_000)), PacketPosition::Outlier);
        assert!(matches!(place(&mut sequence, &packet(5_001)), PacketPosition::First { .. }));
        assert!(matches!(place(&mut sequence, &packet(5_002)), PacketPosition::Next { missing: 0, .. }));
        assert_eq!(sequence.received_and_lost().1, 0);
    }

    #[test]
    fn stopped_head_has_no_point_rate() {
        let mut sequence = PacketSequencer::new();
        for n in 0..100 {
            let still = PacketContents {
                speed: 0,
                start: 77,
                points: [(1, 1); POINTS_PER_PACKET],
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
    fn continuous_scanner_clock_is_not_a_restart() {
        for last in [0, 1, 12_345, 29_999] {
            for passed in
                [0, 3 * MILLIS, 400 * MILLIS, 12 * SECOND, 29_990 * MILLIS, 31 * SECOND, 125 * SECOND]
            {
                for drift in [-2, 0, 2] {
                    let advance = (passed as i64 + drift * passed as i64 / 1_000) / MILLIS as i64;
                    let millis = ((i64::from(last) + advance) % i64::from(CLOCK_PERIOD_MS)) as u16;
                    assert!(!has_restarted(last, millis, after(passed)), "{last} {passed} {drift}");
                }
            }
        }
    }

    #[test]
    fn scanner_clock_reset_is_a_restart() {
        for last in [5_000, 12_345, 29_000] {
            for (passed, millis) in [(350, 300), (1_200, 800), (2_300, 2_000), (40_000, 2_000)] {
                assert!(has_restarted(last, millis, after(passed * MILLIS)), "{last} {passed} {millis}");
            }
        }
    }

    #[test]
    fn backlog_of_the_host_is_not_a_restart() {
        // The hub's process was stopped for 9 s and then read a packet. The scanner measured this packet at an unknown
        // time in these 9 s.
        for advance in [100, 2_000, 8_900] {
            assert!(!has_restarted(1_000, 1_000 + advance, (0, 9 * SECOND)), "{advance}");
        }
        // The host was suspended, so the host's clock did not count the time of the suspension.
        assert!(!has_restarted(1_000, 17_000, after(500 * MILLIS)));
    }

    #[test]
    fn restart_needs_two_consecutive_packets() {
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
