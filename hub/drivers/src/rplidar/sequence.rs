//! Position of each packet in its stream: the first packet of a sequence, the next packet, the first packet after a
//! gap, or an outlier.
//!
//! Packets have no counter. A head rotates at a constant speed, so the angle from one packet to the next is known. The
//! number of missing packets follows from the angle of the gap. The number of missing revolutions follows from the
//! duration of the gap.

/// State of a stream: its last packet, the speed of the head, and the packet counters. A packet has one point or
/// several.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PacketSequencer {
    last: Option<LastPacket>,
    /// Angle of the last outlier, in degrees. If the next packets continue from this angle, a new sequence starts.
    outlier: Option<f32>,
    outliers: u32,
    /// Angle from one packet to the next in degrees, and the number of packets from which this angle was measured.
    advance: f64,
    learned_packets: u32,
    /// For packets of one point: the angle at which the measurement of a revolution started, and the number of packets
    /// since then.
    revolution: (f64, u32),
    is_whole: bool,
    /// Number of points that the discarded bytes in this revolution may have been.
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

/// Position of a packet in its stream.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PacketPosition {
    /// Relation to the last packet.
    pub(crate) step: Step,
    /// Angle of the first point, in degrees clockwise, cumulative over all revolutions.
    pub(crate) angle: f64,
    /// Time of the first point in the scanner's clock, in nanoseconds.
    pub(crate) time: f64,
}

/// Relation of a packet to the previous packet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Step {
    /// The packet starts a new sequence, with a new clock.
    First,
    /// The packet follows the previous packet directly.
    Next,
    /// Packets are missing before this packet, or may be missing.
    Gap {
        /// Angle of the previous packet in degrees, as in [`PacketPosition::angle`].
        from: f64,
        /// Duration of the gap in nanoseconds, according to the number of counted packets.
        ns: f64,
    },
    /// The packet does not fit into the sequence.
    Outlier,
}

/// Data of a received packet that the sequencer needs.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ReceivedPacket {
    /// Angle of the first point, in degrees clockwise.
    pub(crate) start: f32,
    /// Number of discarded bytes between the previous packet and this one.
    pub(crate) skipped: u32,
    /// Time from one packet to the next, in nanoseconds.
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

    /// Ends the sequence. The next packet starts a new sequence.
    pub(crate) fn end(&mut self) {
        (self.last, self.outlier, self.outliers, self.learned_packets) = (None, None, 0, 0);
    }

    /// Returns whether a packet has arrived since the sequence started.
    pub(crate) fn has_begun(&self) -> bool {
        self.last.is_some()
    }

    /// Returns the number of received packets, and the number of lost packets between them.
    pub(crate) fn received_and_lost(&self) -> (u64, u64) {
        (self.received, self.lost)
    }

    /// Returns the angle from one packet to the next, in degrees. Returns `None` until the angle is known, and if the
    /// head does not rotate.
    pub(crate) fn advance(&self) -> Option<f64> {
        (self.learned_packets >= LEARNING_PACKETS && self.advance > MIN_PACKET_DEG).then_some(self.advance)
    }

    /// Returns the position of a packet of several points. `delay` is called with the time of the packet's first point,
    /// and with whether there is a gap before the packet. `delay` returns by how many nanoseconds the packet arrived
    /// later than usual.
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
        // During a long gap, the speed of the head may have changed. The number of packets is then more exact if it
        // follows from the time.
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

    /// Returns the position of a packet of one point. The angle of the packet may be smaller than the angle of an
    /// earlier packet.
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
        // The skipped bytes may have been points that lost bytes or contained extra bytes. If the skipped bytes took
        // less time than points, they were not points.
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

    /// Returns the position of a packet that is `packets` packets and `angle` degrees after `last`.
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
        // A revolution in which the head stopped does not count.
        if self.advance().is_some_and(|advance| f64::from(count) > (passed + 90.0) / advance) {
            return self.locate_first(packet.start);
        }
        if passed < 360.0 {
            return position;
        }
        (self.revolution, self.uncertain_points) = ((position.angle, 0), 0);
        let whole = core::mem::replace(&mut self.is_whole, true);
        match self.advance() {
            // Points are missing, although the angle has not jumped.
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

    /// Counts an outlier. If enough consecutive outliers agree with each other, starts a new sequence instead.
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

/// Returns the clockwise angle from one angle to another, from 0 to 360 degrees.
fn clockwise(from: f32, to: f32) -> f64 {
    let angle = f64::from(to) - f64::from(from);
    if angle < 0.0 { angle + 360.0 } else { angle }
}

/// Speed of the head, per packet.
#[derive(Clone, Copy)]
struct RotationSpeed {
    /// Angle from one packet to the next in degrees; `packet_ns` is the time in nanoseconds.
    advance: f64,
    packet_ns: f64,
}

impl RotationSpeed {
    /// Returns the time in nanoseconds in which the head rotates by `angle` degrees.
    fn time(self, angle: f64) -> f64 {
        angle / self.advance * self.packet_ns
    }

    /// Returns the number of missing revolutions before a packet that is `late` nanoseconds later than usual.
    fn missing_revolutions(self, late: f64) -> f64 {
        f64::from((late.max(0.0) / self.time(360.0) + 0.5) as u32)
    }

    /// Returns whether a packet arrived earlier than the scanner can have measured it. The packet is `angle` degrees
    /// after the previous packet. The tolerance covers the drift of the clocks.
    fn is_early(self, late: f64, angle: f64) -> bool {
        late < -(MAX_EARLY_NS + MAX_DRIFT * self.time(angle))
    }

    /// Returns whether the packet is much later than its angle indicates, because the scanner has paused.
    fn is_after_pause(self, late: f64) -> bool {
        late > 0.15 * self.time(360.0)
    }
}

/// Number of packets that must agree before the angle from one packet to the next counts as known. It is also the
/// number of consecutive outliers that start a new sequence.
const LEARNING_PACKETS: u32 = 3;
/// Number of packets that must agree before missing packets count as lost. Before that, the head may still be spinning
/// up.
const STEADY_PACKETS: u32 = 12;
/// Maximum angle from one packet to the next, in degrees. With a larger angle, a revolution has fewer than four
/// packets.
const MAX_PACKET_DEG: f64 = 100.0;
/// Maximum angle from one packet to the next at which the head counts as stopped, in degrees.
const MIN_PACKET_DEG: f64 = 0.02;
/// Start of the scanner's clock in nanoseconds. This start is so large that no time is negative.
const CLOCK_START_NS: f64 = 1e10;
/// Maximum angle by which a point may precede the previous point, in degrees. `MAX_FORWARD_DEG` is the maximum angle by
/// which a point may follow the previous point without a gap.
const MAX_BACKWARD_DEG: f64 = 25.0;
const MAX_FORWARD_DEG: f64 = 25.0;
/// Maximum time by which a packet may be early, in nanoseconds. `MAX_DRIFT` is the maximum drift between the clocks, as
/// a ratio.
const MAX_EARLY_NS: f64 = 3e6;
const MAX_DRIFT: f64 = 0.02;
/// Length of a packet of one point, in bytes.
const POINT_LEN: u32 = 5;
/// Maximum number of single points that may be missing before the sequencer reports a gap.
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
        // The head rotated more slowly by 0.2 %.
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
        // The skipped bytes are 12 bytes after each point, then 4,693 bytes at once, and later the rest of ten lost
        // points.
        let steps: [Step; 49] = core::array::from_fn(|i| place(3_001 + i as u32, 12).step);
        assert!(matches!(steps, [Step::Next, .., Step::Gap { .. }]), "that many bytes may have been points");
        place(3_051, 4_693);
        let last = place(3_060, 43);
        assert!(((last.time - CLOCK_START_NS) / packet_ns - 3_060.0).abs() < 1.5, "{last:?}");
        assert_eq!(sequence.received_and_lost().1, 2 + 8);
    }
}
