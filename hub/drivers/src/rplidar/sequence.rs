//! Position of a packet in its stream: the next one, one after a gap, or an outlier.
//!
//! Packets have no counter. But a head rotates evenly, so the angle from packet to packet is known. The number of
//! missing packets follows from the angle of the gap, and the number of missing revolutions from the time.

/// The packets of one stream: of several points each, or of one.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PacketSequencer {
    last: Option<LastPacket>,
    /// Angle of the last outlier. The next packet may show that it was none.
    outlier: Option<f32>,
    outliers: u32,
    /// Degrees from one packet to the next, and number of packets that it was measured with.
    advance: f64,
    learned_packets: u32,
    /// For packets of one point: angle at which a full revolution began, and number of packets since.
    revolution: (f64, u32),
    is_whole: bool,
    /// Number of points that the bytes between packets since then may have been.
    uncertain_points: u32,
    received: u64,
    lost: u64,
}

#[derive(Clone, Copy, Debug)]
struct LastPacket {
    start: f32,
    angle: f64,
    time: f64,
}

/// The place of a packet in its stream.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PacketPosition {
    /// Relation to the last packet.
    pub(crate) step: Step,
    /// Degrees of its first point, clockwise over all revolutions.
    pub(crate) angle: f64,
    /// Time of its first point, by the scanner's clock in nanoseconds.
    pub(crate) time: f64,
}

/// Relation of a packet to the last one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Step {
    /// The packet begins a new sequence, and with it a new clock.
    First,
    /// The packet is the next one.
    Next,
    /// Packets are missing between the two, or may be. The last one was at `from`.
    Gap {
        /// Degrees, as in [`PacketPosition::angle`].
        from: f64,
        /// Duration in nanoseconds, by the counted packets.
        ns: f64,
    },
    /// The packet is an outlier.
    Outlier,
}

/// A received packet.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ReceivedPacket {
    /// Degrees of its first point, clockwise.
    pub(crate) start: f32,
    /// Number of discarded bytes between it and the last one.
    pub(crate) skipped: u32,
    /// Nanoseconds from one packet to the next.
    pub(crate) packet_ns: f64,
}

impl ReceivedPacket {
    fn is_adjacent(&self) -> bool {
        self.skipped == 0
    }
}

impl PacketSequencer {
    pub(crate) fn new() -> Self {
        PacketSequencer {
            last: None,
            outlier: None,
            outliers: 0,
            advance: 0.0,
            learned_packets: 0,
            revolution: (0.0, 0),
            is_whole: true,
            uncertain_points: 0,
            received: 0,
            lost: 0,
        }
    }

    /// Ends the sequence: the next packet is the first one of another.
    pub(crate) fn end(&mut self) {
        (self.last, self.outlier, self.outliers, self.learned_packets) = (None, None, 0, 0);
    }

    /// Returns whether a packet has arrived since the sequence began.
    pub(crate) fn has_begun(&self) -> bool {
        self.last.is_some()
    }

    /// Returns the numbers of received packets, and of lost ones between them.
    pub(crate) fn received_and_lost(&self) -> (u64, u64) {
        (self.received, self.lost)
    }

    /// Returns the degrees from one packet to the next. `None` until they are known, and if the head stands still.
    pub(crate) fn advance(&self) -> Option<f64> {
        (self.learned_packets >= LEARNING_PACKETS && self.advance > MIN_PACKET_DEG).then_some(self.advance)
    }

    /// Places a packet of several points. `late` returns the nanoseconds by which it arrived later than usual if its
    /// first point was measured at the given time. Its second argument is whether there is a gap before.
    pub(crate) fn locate(
        &mut self,
        packet: ReceivedPacket,
        delay: impl Fn(f64, bool) -> f64,
    ) -> PacketPosition {
        self.received += 1;
        let Some(last) = self.last else { return self.locate_first(packet.start) };
        let angle = clockwise(last.start, packet.start);
        let Some(advance) = self.advance() else {
            let is_even = (angle - self.advance).abs() <= 0.25 * self.advance + 1.0;
            if angle > MAX_PACKET_DEG || !packet.is_adjacent() || (self.learned_packets > 0 && !is_even) {
                return self.locate_first(packet.start);
            }
            self.learned_packets += 1;
            self.advance += (angle - self.advance) / f64::from(self.learned_packets.min(8));
            return self.locate_next(last, packet, angle, 1.0, Step::Next);
        };
        let speed = RotationSpeed { advance, packet_ns: packet.packet_ns };
        let is_next = packet.is_adjacent() && self.outliers == 0 && (angle - advance).abs() <= 0.25 * advance;
        if is_next && speed.missing_revolutions(delay(last.time + packet.packet_ns, false)) == 0.0 {
            let is_even = (angle - advance).abs() <= 0.08 * advance;
            self.learned_packets = if is_even { self.learned_packets + 1 } else { LEARNING_PACKETS };
            self.advance += (angle - advance) / 4.0;
            return self.locate_next(last, packet, angle, 1.0, Step::Next);
        }
        let late = |time: f64| delay(time, true);
        let angle = angle + 360.0 * speed.missing_revolutions(late(last.time + speed.time(angle)));
        let packets = f64::from((angle / advance + 0.5) as u32);
        // In a long gap, a head may have changed its speed. Then the time indicates the number of packets better.
        let max_correction = f64::from((0.1 * packets) as u32);
        let late_by = late(last.time + packets * packet.packet_ns) / packet.packet_ns;
        let off = (late_by + 0.5f64.copysign(late_by)).clamp(-max_correction, max_correction) as i32;
        let packets = packets + f64::from(off);
        let tolerance = advance * ((0.25 + 0.01 * packets).min(0.5) + f64::from(off.abs()));
        let late = late(last.time + packets * packet.packet_ns);
        if packets < 1.0 || (angle - packets * advance).abs() > tolerance || speed.is_early(late, angle) {
            return self.handle_outlier(packet);
        }
        if speed.is_after_pause(late) {
            return self.locate_first(packet.start);
        }
        let ns = packets * packet.packet_ns;
        self.locate_next(last, packet, angle, packets, Step::Gap { from: last.angle, ns })
    }

    /// Places a packet of one point, whose angle may be smaller than that of an earlier one.
    pub(crate) fn locate_point(
        &mut self,
        packet: ReceivedPacket,
        delay: impl Fn(f64, bool) -> f64,
    ) -> PacketPosition {
        self.received += 1;
        let Some(last) = self.last else { return self.locate_first(packet.start) };
        let angle = clockwise(last.start, packet.start);
        let angle = if angle > 360.0 - MAX_BACKWARD_DEG { angle - 360.0 } else { angle };
        self.is_whole &= packet.is_adjacent();
        // The skipped bytes may be points that lost bytes or had additional ones, but not if they took less time than
        // points.
        let points = f64::from(1 + (packet.skipped + 3) / POINT_LEN);
        let early =
            if packet.is_adjacent() { 0.0 } else { -delay(last.time + points * packet.packet_ns, false) };
        let points = f64::from((points - early.max(0.0) / packet.packet_ns).max(1.0) as u32);
        let Some(advance) = self.advance() else {
            if angle > MAX_PACKET_DEG {
                return self.locate_first(packet.start);
            }
            return self.locate_next_point(last, packet, angle, points, Step::Next);
        };
        let speed = RotationSpeed { advance, packet_ns: packet.packet_ns };
        let late = |time: f64| delay(time, angle > MAX_FORWARD_DEG);
        let due = last.time + speed.time(angle.max(advance));
        let revolutions = speed.missing_revolutions(late(due));
        if angle <= MAX_FORWARD_DEG && revolutions == 0.0 {
            self.uncertain_points += (packet.skipped + 3) / POINT_LEN;
            let is_gap = !packet.is_adjacent() && self.uncertain_points > MAX_MISSING_POINTS;
            let ns = points * packet.packet_ns;
            let step = if is_gap { Step::Gap { from: last.angle, ns } } else { Step::Next };
            return self.locate_next_point(last, packet, angle, points, step);
        }
        let late = late(due + speed.time(360.0 * revolutions));
        if speed.is_early(late, angle) || (packet.is_adjacent() && revolutions == 0.0) {
            return self.handle_outlier(packet);
        }
        if speed.is_after_pause(late) {
            return self.locate_first(packet.start);
        }
        let angle = angle + 360.0 * revolutions;
        let points = (angle / advance + 0.5) as u32;
        let is_gap = points > MAX_MISSING_POINTS;
        let ns = f64::from(points) * packet.packet_ns;
        let step = if is_gap { Step::Gap { from: last.angle, ns } } else { Step::Next };
        self.locate_next_point(last, packet, angle, f64::from(points.max(1)), step)
    }

    fn locate_first(&mut self, start: f32) -> PacketPosition {
        let (angle, time) = (f64::from(start), CLOCK_START_NS);
        (self.revolution, self.uncertain_points) = ((angle, 0), 0);
        self.last = Some(LastPacket { start, angle, time });
        (self.outlier, self.outliers, self.learned_packets, self.advance) = (None, 0, 0, 0.0);
        PacketPosition { step: Step::First, angle, time }
    }

    /// Places a packet `packets` packets and `angle` degrees after `last`.
    fn locate_next(
        &mut self,
        last: LastPacket,
        packet: ReceivedPacket,
        angle: f64,
        packets: f64,
        step: Step,
    ) -> PacketPosition {
        let is_steady = self.learned_packets >= STEADY_PACKETS;
        let missing = if is_steady { (packets - 1.0).max(0.0) as u64 } else { 0 };
        self.lost += missing.saturating_sub(u64::from(self.outliers));
        (self.outlier, self.outliers) = (None, 0);
        let (angle, time) = (last.angle + angle, last.time + packets * packet.packet_ns);
        self.last = Some(LastPacket { start: packet.start, angle, time });
        PacketPosition { step, angle, time }
    }

    fn locate_next_point(
        &mut self,
        last: LastPacket,
        packet: ReceivedPacket,
        angle: f64,
        packets: f64,
        step: Step,
    ) -> PacketPosition {
        let position = self.locate_next(last, packet, angle, packets, step);
        self.revolution.1 += packets as u32;
        let (from, count) = self.revolution;
        let passed = position.angle - from;
        // A revolution in which the head stood still does not count.
        if self.advance().is_some_and(|advance| f64::from(count) > (passed + 90.0) / advance) {
            return self.locate_first(packet.start);
        }
        if passed < 360.0 {
            return position;
        }
        (self.revolution, self.uncertain_points) = ((position.angle, 0), 0);
        let whole = core::mem::replace(&mut self.is_whole, true);
        match self.advance() {
            // Points are missing without a jump of the angle.
            Some(advance) if !whole => {
                let missing = passed / advance - f64::from(count);
                if missing >= 2.0 {
                    self.lost += missing as u64;
                    self.last.iter_mut().for_each(|last| last.time += missing * packet.packet_ns);
                }
            }
            known => {
                let measured = passed / f64::from(count);
                let steady = known.filter(|advance| (measured - advance).abs() <= 0.1 * advance);
                self.learned_packets = if steady.is_some() { STEADY_PACKETS } else { LEARNING_PACKETS };
                self.advance = steady.map_or(measured, |advance| advance + (measured - advance) / 4.0);
            }
        }
        position
    }

    /// Handles an outlier, unless enough of them follow each other.
    fn handle_outlier(&mut self, packet: ReceivedPacket) -> PacketPosition {
        let is_continued =
            self.outlier.is_some_and(|outlier| clockwise(outlier, packet.start) < MAX_PACKET_DEG);
        if is_continued && packet.is_adjacent() && self.outliers + 1 >= LEARNING_PACKETS {
            return self.locate_first(packet.start);
        }
        self.outlier = Some(packet.start);
        self.outliers += 1;
        PacketPosition { step: Step::Outlier, angle: 0.0, time: 0.0 }
    }
}

/// Returns the degrees from one angle to another, 0 to 360.
fn clockwise(from: f32, to: f32) -> f64 {
    let angle = f64::from(to) - f64::from(from);
    if angle < 0.0 { angle + 360.0 } else { angle }
}

/// Speed of a head.
#[derive(Clone, Copy)]
struct RotationSpeed {
    /// Degrees and nanoseconds from one packet to the next.
    advance: f64,
    packet_ns: f64,
}

impl RotationSpeed {
    /// Returns the nanoseconds for `angle` degrees.
    fn time(self, angle: f64) -> f64 {
        angle / self.advance * self.packet_ns
    }

    /// Returns the number of missing revolutions before a packet that is `late` nanoseconds later than usual.
    fn missing_revolutions(self, late: f64) -> f64 {
        f64::from((late.max(0.0) / self.time(360.0) + 0.5) as u32)
    }

    /// Returns whether a packet `angle` degrees after the last one arrived before it was measured. The clocks differ by
    /// little.
    fn is_early(self, late: f64, angle: f64) -> bool {
        late < -(MAX_EARLY_NS + MAX_DRIFT * self.time(angle))
    }

    /// Returns whether the scanner did not send for a while, because a packet is much later than its angle indicates.
    fn is_after_pause(self, late: f64) -> bool {
        late > 0.15 * self.time(360.0)
    }
}

/// Number of packets in agreement until the angle between them counts, and of outliers in a row until they do.
const LEARNING_PACKETS: u32 = 3;
/// Number of packets in agreement until missing ones count as lost. Before, the head may not have its speed yet.
const STEADY_PACKETS: u32 = 12;
/// Maximum degrees of a packet. A faster head measures less than four of them in a revolution.
const MAX_PACKET_DEG: f64 = 100.0;
/// Maximum degrees of a packet of a head that stands still.
const MIN_PACKET_DEG: f64 = 0.02;
/// Beginning of the scanner's clock in nanoseconds, so late that no time is negative.
const CLOCK_START_NS: f64 = 1e10;
/// Degrees by which a point may be before the previous one, and after it without a gap.
const MAX_BACKWARD_DEG: f64 = 25.0;
const MAX_FORWARD_DEG: f64 = 25.0;
/// Nanoseconds by which a packet may be early, and share of the time since the last packet by which two clocks may
/// differ.
const MAX_EARLY_NS: f64 = 3e6;
const MAX_DRIFT: f64 = 0.02;
/// Length of a packet of one point, in bytes.
const POINT_LEN: u32 = 5;
/// Number of single points that may be missing without a gap.
const MAX_MISSING_POINTS: u32 = 30;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_no_loss_during_spin_up() {
        for steps in [20.0, 60.0, 200.0] {
            let (mut sequence, mut start, mut begun) = (PacketSequencer::new(), 0.0f64, 0.0);
            for n in 0..400 {
                let at = CLOCK_START_NS + f64::from(n) * 8e6;
                let came = ReceivedPacket { start: (start % 360.0) as f32, skipped: 0, packet_ns: 8e6 };
                let place = sequence.locate(came, |time, _| at - begun - time);
                if place.step == Step::First {
                    begun = at - CLOCK_START_NS;
                }
                assert!(n < 300 || place.step == Step::Next, "{steps} {n}: {place:?}");
                start += 21.4 * (f64::from(n) / steps).min(1.0);
            }
            assert_eq!(sequence.received_and_lost(), (400, 0), "{steps}");
        }
    }

    #[test]
    fn counts_packets_of_a_long_gap_by_time() {
        let (mut sequence, packet_ns, advance) = (PacketSequencer::new(), 12e6, 32.57);
        let mut place = |n: f64, angle: f64| {
            let came = ReceivedPacket { start: (angle % 360.0) as f32, skipped: 0, packet_ns };
            sequence.locate(came, |time, _| CLOCK_START_NS + n * packet_ns - time)
        };
        (0..40).map(f64::from).for_each(|n| {
            place(n, n * advance);
        });
        // The head was slower by 0.2 %.
        let behind = place(39.0 + 256.8, (39.0 + 256.4) * advance);
        assert!(matches!(behind.step, Step::Gap { .. }), "{behind:?}");
        assert_eq!(((behind.time - CLOCK_START_NS) / packet_ns).round(), 39.0 + 257.0);
    }

    #[test]
    fn inserted_bytes_are_not_counted_as_points() {
        let (mut sequence, packet_ns, advance) = (PacketSequencer::new(), 217e3, 0.78);
        let mut place = |n: u32, skipped: u32| {
            let start = (f64::from(n) * advance % 360.0) as f32;
            let came = ReceivedPacket { start, skipped, packet_ns };
            sequence.locate_point(came, |time, _| CLOCK_START_NS + f64::from(n) * packet_ns - time)
        };
        (0..3_000).for_each(|n| {
            place(n, 0);
        });
        // 12 bytes after each point, then 4,693 at once, and a fragment of ten lost points.
        let steps: [Step; 49] = core::array::from_fn(|i| place(3_001 + i as u32, 12).step);
        assert!(matches!(steps, [Step::Next, .., Step::Gap { .. }]), "that many bytes may have been points");
        place(3_051, 4_693);
        let last = place(3_060, 43);
        assert!(((last.time - CLOCK_START_NS) / packet_ns - 3_060.0).abs() < 1.5, "{last:?}");
        assert_eq!(sequence.received_and_lost().1, 2 + 8);
    }
}
