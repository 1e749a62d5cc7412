//! Stamps and revolutions of the packets of a stream. The points of a packet with several points are known only after
//! the next packet has arrived, and only if no packet is missing between the two packets.

use crate::line::{
    self, ClosedRevolution, RawScan, ReadLog, ReadScheduler, RevolutionAssembler, RevolutionCounts,
    RotationRate, SensorClock, StreamTiming,
};
use crate::settings::Settings;
use scanhub_schema::{Family, MILLIS, Nanos, line_time};

use crate::rplidar::framer::{Framer, Span};
use crate::rplidar::handshake::{Handshake, ScanModes};
use crate::rplidar::packet::PacketFormat;
use crate::rplidar::sequence::{PacketPosition, PacketSequencer, ReceivedPacket, Step};
use crate::rplidar::{Mode, Model};

/// Timing of the line on which packets arrive.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LineTiming<'a> {
    pub(crate) read_log: &'a ReadLog,
    /// Baud rate in bits per second.
    pub(crate) baud: u32,
    /// The same baud rate, if bytes arrive at the speed of a line. `None` for a network port and for a recording.
    pub(crate) line_rate: Option<u32>,
}

/// State of a stream, from its packets to its revolutions.
#[derive(Clone, Debug)]
pub(crate) struct Stream {
    settings: Settings,
    sequencer: PacketSequencer,
    clock: SensorClock,
    point_time: PointTime,
    revolutions: Revolutions,
    /// Number of beams of a scan, once it is known.
    pub(crate) beams: Option<usize>,
    /// Time of the last packet in the scanner's clock.
    pub(crate) scanner_time: Option<Nanos>,
}

impl Stream {
    pub(crate) fn new(settings: Settings) -> Stream {
        Stream {
            settings,
            sequencer: PacketSequencer::new(),
            clock: SensorClock::new(),
            point_time: PointTime::default(),
            revolutions: Revolutions::new(),
            beams: None,
            scanner_time: None,
        }
    }

    /// Ends the stream. The next packet belongs to a new stream.
    pub(crate) fn end(&mut self) {
        self.sequencer.end();
        self.revolutions.end();
        self.point_time.measurement = None;
        if self.settings.listen_only {
            // The recorded program may have chosen another mode.
            (self.point_time.ns, self.scanner_time) = (None, None);
        }
    }

    /// Returns whether a packet has arrived since the stream started.
    pub(crate) fn has_begun(&self) -> bool {
        self.sequencer.has_begun()
    }

    /// Sets the time per point in microseconds that the scanner has reported for the mode that starts next.
    pub(crate) fn set_sample_us(&mut self, sample_us: Option<f32>) {
        self.point_time.ns = sample_us.map(|us| f64::from(us) * 1e3);
    }

    /// Returns the number of points that the scanner measures per second. Returns `None` until it is known.
    pub(crate) fn points_per_second(&self) -> Option<f32> {
        self.point_time.ns.map(|ns| (1e9 / ns) as f32)
    }

    /// Returns the number of received packets and the number of lost packets.
    pub(crate) fn received_and_lost(&self) -> (u64, u64) {
        self.sequencer.received_and_lost()
    }

    /// Returns the counts of revolutions by kind.
    pub(crate) fn revolution_counts(&self) -> RevolutionCounts {
        self.revolutions.assembler.counts()
    }

    /// Returns the maximum number of packets in a sample. These packets arrive within 10 ms and fit into a sample.
    pub(crate) fn max_packets_per_sample(&self, kind: PacketFormat) -> usize {
        let packet_ns = self.point_time.ns.unwrap_or(1e6) * kind.points() as f64;
        ((1e7 / packet_ns) as usize).clamp(1, (MAX_SAMPLE_LEN / kind.byte_len()).min(MAX_PACKETS))
    }

    /// Measures the time per point with the packets of `span`, unless the scanner has reported this time. Returns
    /// whether the time is known.
    pub(crate) fn measure_point_time(
        &mut self,
        kind: PacketFormat,
        span: Span,
        line_timing: LineTiming<'_>,
        modes: &ScanModes,
    ) -> bool {
        let time = &mut self.point_time;
        if self.settings.listen_only || time.ns.is_none() || time.measurement.is_some() {
            let at = line_timing.read_log.latest(span.offset + span.len as u64 - 1, line_timing.line_rate);
            let change = time.measure_span(kind, span, at, modes, self.settings);
            if change > 0.1 {
                self.sequencer.end();
            }
            if change > 0.001 {
                // The times of this clock were computed with the previous time per point.
                self.clock = SensorClock::new();
            }
        }
        self.point_time.ns.is_some()
    }

    /// Locates the packets of `span` in the sequence, and keeps them for [`advance`](Self::advance). If there is a gap
    /// within the span, returns the packets after the gap to the framer and shortens `span`, so that these packets form
    /// the next span. Returns the stamps of the first and the last packet. A packet's stamp is the stamp of its last
    /// point. Returns `None` if the time per point or one of the two stamps is unknown.
    pub(crate) fn locate(
        &mut self,
        kind: PacketFormat,
        span: &mut Span,
        framer: &mut Framer,
        line_timing: LineTiming<'_>,
        handshake: &Handshake,
    ) -> Option<(Nanos, Nanos)> {
        let LineTiming { read_log: arrivals, baud, line_rate: pace } = line_timing;
        let point_ns = self.point_time.ns?;
        let len = kind.byte_len();
        let packet_time = line_time(len, baud);
        let packet_ns = point_ns * kind.points() as f64;
        let to_last_point = point_ns * (kind.points() - 1) as f64;
        let timing = StreamTiming { byte_ns: packet_ns / len as f64, packet_len: len, line_rate: pace };
        let positions = &mut self.revolutions.positions;
        let mut count = 0;
        for (n, bytes) in framer.bytes(*span).chunks_exact(len).enumerate() {
            let packet = ReceivedPacket {
                start: kind.start_angle(bytes),
                skipped: if n == 0 { span.skipped } else { 0 },
                packet_ns,
            };
            let end = span.offset + (n * len + len - 1) as u64;
            let at = arrivals.latest(end, pace).saturating_sub(packet_time);
            let delay = |time: f64, is_after_gap: bool| {
                let Some(due) = self.clock.time((time + to_last_point) as Nanos) else { return 0.0 };
                if at <= due {
                    return -((due - at) as f64);
                }
                let earliest = if is_after_gap {
                    arrivals.earliest_after_gap(end, timing)
                } else {
                    arrivals.earliest(end, timing)
                };
                // The delay of a packet from a backlog counts as 0, because only the buffer delayed the packet.
                earliest.unwrap_or(0).saturating_sub(packet_time + due) as f64
            };
            let before = self.sequencer;
            let position = match kind {
                PacketFormat::Standard => self.sequencer.locate_point(packet, delay),
                _ => self.sequencer.locate(packet, delay),
            };
            if n > 0 && matches!(position.step, Step::First | Step::Gap { .. }) {
                self.sequencer = before;
                break;
            }
            let last_point = (position.time + to_last_point) as Nanos;
            if position.step == Step::First {
                // Revolutions and the clock restart with a new sequence.
                self.clock = SensorClock::new();
                self.revolutions.assembler.discard();
                self.revolutions.pending = None;
            }
            if let Step::Gap { ns, .. } = position.step
                && ns * SPEED_VARIATION > packet_ns / 2.0
            {
                self.clock.add_uncertainty(last_point, (ns * SPEED_VARIATION + packet_ns) as Nanos + MILLIS);
            }
            if position.step != Step::Outlier {
                self.clock.note_arrival(last_point, at);
            }
            positions[n] = position;
            count += 1;
        }
        if count < span.packets {
            framer.shorten(span, count);
        }
        let positions = &positions[..span.packets];
        let is_placed = |place: &&PacketPosition| place.step != Step::Outlier;
        let stamp = |place: Option<&PacketPosition>| {
            place.filter(is_placed).and_then(|place| self.clock.time((place.time + to_last_point) as Nanos))
        };
        let stamps = stamp(positions.first()).zip(stamp(positions.last()));
        self.scanner_time = positions.iter().rev().find(is_placed).map(|place| place.time as Nanos);
        self.revolutions.current = Some(CurrentSpan { kind, span: *span, next_packet: 0, is_added: false });
        self.choose_beams(kind, handshake);
        stamps
    }

    /// Chooses the number of beams once per stream, as soon as the speed of the head is known.
    fn choose_beams(&mut self, kind: PacketFormat, handshake: &Handshake) {
        let Settings { beams, max_beams, .. } = self.settings;
        let Some(point_ns) = self.point_time.ns.filter(|_| !self.revolutions.has_begun) else { return };
        let Some(advance) = self.sequencer.advance() else { return };
        let points_per_revolution = 360.0 / advance * kind.points() as f64;
        let model_beams = match handshake.model() {
            Some(model) => self.beams_of(model, kind, point_ns, handshake),
            None => (points_per_revolution + 0.5) as usize,
        };
        let max = max_beams.unwrap_or(*line::BEAM_RANGE.end());
        let beams = beams.or(self.beams).unwrap_or(model_beams.max(*line::BEAM_RANGE.start())).min(max);
        self.beams = Some(beams);
        self.revolutions.begin(beams);
    }

    /// Returns the number of beams of a `model` that takes `point_ns` nanoseconds per point. If a mode is configured,
    /// this is the number for the configured mode. Otherwise, it normally is the number for the model's fastest mode.
    /// It is the number for the mode that the scanner reports if the bytes come from a recording, or if a search has
    /// found the scanner and no model is configured. The reason is that an A1 with old firmware measures half as many
    /// points as other scanners of this model.
    fn beams_of(&self, model: Model, kind: PacketFormat, point_ns: f64, handshake: &Handshake) -> usize {
        let Settings { model: configured, mode, is_found, listen_only, .. } = self.settings;
        let point_us = (point_ns / 1e3) as f32;
        let follows = listen_only || is_found && configured.is_none();
        let mode_us = match mode {
            Some(_) => Some(point_us),
            None => handshake.modes.nearest_us(kind, point_us).filter(|_| follows),
        };
        mode_us.map_or(model.beams(), |us| model.beams_in_mode(1e6 / us))
    }

    /// Returns the time per point that a scanner of this `model` must have reported, in microseconds. This is the
    /// measured time, unless the number of `beams` of the scanner's scans shows that the reported time was different. A
    /// real A1 takes 0.7 % longer than it reports.
    pub(crate) fn reported_us(&self, model: Option<Model>, beams: Option<usize>) -> Option<f64> {
        let measured = self.point_time.ns? / 1e3;
        let of_scans = model.zip(beams).and_then(|(model, beams)| {
            let reported = 1e6 / (beams as f64 * f64::from(model.revolutions_per_second()));
            let is_other = model.beams_in_mode((1e6 / measured) as f32) != beams;
            (is_other && (reported / measured - 1.0).abs() <= MAX_POINT_TIME_DEVIATION).then_some(reported)
        });
        of_scans.or(Some(measured))
    }

    /// Returns the speed of the head. Returns `None` until revolutions are assembled.
    fn rotation_rate(&self, kind: PacketFormat) -> Option<RotationRate> {
        let known = self.point_time.ns.zip(self.sequencer.advance());
        let (point_ns, advance) = known.filter(|_| self.revolutions.has_begun)?;
        Some(RotationRate { step: advance / kind.points() as f64, point_ns })
    }

    /// Adds the points of the located packets to revolutions until a revolution is complete. Returns that revolution.
    pub(crate) fn advance(&mut self, framer: &Framer) -> Option<ClosedRevolution> {
        let rate = self.revolutions.current.and_then(|current| self.rotation_rate(current.kind));
        self.revolutions.advance(framer, rate)
    }

    /// Returns the revolution that is being measured, with the points so far.
    pub(crate) fn partial_revolution(&self, kind: PacketFormat) -> Option<ClosedRevolution> {
        self.revolutions.assembler.partial_revolution(self.rotation_rate(kind)?)
    }

    /// Converts a complete or partial revolution to a scan whose stamps are in the hub's clock.
    pub(crate) fn to_scan(
        &self,
        revolution: ClosedRevolution,
        reads: &ReadScheduler,
        now: Nanos,
    ) -> RawScan<'_> {
        let stamp = |at: Nanos| self.clock.time(at).unwrap_or(now);
        let stamps = reads.revolution_stamps(stamp(revolution.first), stamp(revolution.last));
        let resolution = (self.beams.unwrap_or_default(), self.points_per_second().unwrap_or_default());
        let points = self.revolutions.assembler.points(&revolution);
        RawScan::revolution(Family::Rplidar, &revolution, stamps, resolution, points)
    }
}

/// Time per point in nanoseconds, as the scanner reported or the stream measured it.
#[derive(Clone, Copy, Debug, Default)]
struct PointTime {
    ns: Option<f64>,
    measurement: Option<Measurement>,
}

/// Measurement of the time per point over spans with no missing packets between them.
#[derive(Clone, Copy, Debug)]
struct Measurement {
    /// Arrival time of the last packet.
    last: Nanos,
    /// Whether packets are missing before the last packet, or the last packet was late.
    is_incomplete: bool,
    /// Time in nanoseconds by which the last packet was later than in a steady stream. It decreases while packets
    /// arrive faster than in a steady stream.
    lateness: f64,
    elapsed: Nanos,
    points: u64,
    /// Duration of the measurement in nanoseconds.
    duration: Nanos,
}

impl Measurement {
    fn new(last: Nanos, duration: Nanos) -> Measurement {
        Measurement { last, is_incomplete: false, lateness: 0.0, elapsed: 0, points: 0, duration }
    }
}

impl PointTime {
    /// Continues the measurement with the packets of `span`, whose last packet arrived at `at`. A complete measurement
    /// stores a new time per point: the reported time that is nearest to the measured time, among the modes with
    /// packets of format `kind`. If the scanner has reported no such time, it stores the measured time. The next
    /// measurement takes twice as long. Returns the relative change of a time that was known before.
    fn measure_span(
        &mut self,
        kind: PacketFormat,
        span: Span,
        at: Nanos,
        modes: &ScanModes,
        settings: Settings,
    ) -> f64 {
        let Some(measurement) = &mut self.measurement else {
            self.ns = modes.sample_us(kind, Mode::of(&settings)).map(|us| f64::from(us) * 1e3);
            self.measurement = Some(Measurement::new(at, FIRST_MEASUREMENT_TIME));
            return 0.0;
        };
        let interval = at.saturating_sub(core::mem::replace(&mut measurement.last, at));
        let points = (span.packets * kind.points()) as f64;
        let steady = self.ns.map(|ns| points * ns);
        let ahead = steady.map_or(0.0, |steady| steady - interval as f64);
        let is_late = steady.is_some_and(|steady| interval as f64 > 1.5 * steady + LATE_TOLERANCE_NS);
        measurement.lateness = match steady {
            Some(_) if is_late => -ahead,
            // Packets that were buffered behind the late packet arrive faster until the delay is 0.
            Some(steady) if ahead > steady / 2.0 => (measurement.lateness - ahead).max(0.0),
            _ => 0.0,
        };
        // Packets that arrive at the same time as an incomplete span were in the same read as this span.
        measurement.is_incomplete = span.reasons != 0
            || is_late
            || measurement.lateness > 0.0
            || (measurement.is_incomplete && interval == 0);
        if measurement.is_incomplete {
            return 0.0;
        }
        measurement.elapsed += interval;
        measurement.points += (span.packets * kind.points()) as u64;
        if measurement.elapsed < measurement.duration {
            return 0.0;
        }
        let measured = measurement.elapsed as f64 / measurement.points as f64;
        *measurement = Measurement::new(at, 2 * measurement.duration);
        let reported = modes.nearest_us(kind, (measured / 1e3) as f32);
        let ns = reported.map_or(measured, |us| f64::from(us) * 1e3);
        self.ns.replace(ns).map_or(0.0, |before| (before / ns - 1.0).abs())
    }
}

/// Assembly of located packets into revolutions.
#[derive(Clone, Debug)]
struct Revolutions {
    assembler: RevolutionAssembler<MAX_POINTS>,
    /// Whether the assembler has the number of beams of this stream.
    has_begun: bool,
    /// Positions of the packets in the last span.
    positions: [PacketPosition; MAX_PACKETS],
    /// Packets whose points have not been added to revolutions yet.
    current: Option<CurrentSpan>,
    pending: Option<PendingPacket>,
}

/// Packets of a span whose points are being added to revolutions.
#[derive(Clone, Copy, Debug)]
struct CurrentSpan {
    kind: PacketFormat,
    span: Span,
    /// Index of the first packet whose points are not completely processed.
    next_packet: usize,
    /// Whether the points of the packet at this index were added.
    is_added: bool,
}

/// Packet whose points are known only when the next packet arrives.
#[derive(Clone, Copy, Debug)]
struct PendingPacket {
    bytes: [u8; PacketFormat::MAX_LEN],
    position: PacketPosition,
    reasons: u8,
}

impl Revolutions {
    fn new() -> Revolutions {
        Revolutions {
            assembler: RevolutionAssembler::new(),
            has_begun: false,
            positions: [PacketPosition { step: Step::Outlier, angle: 0.0, time: 0.0 }; MAX_PACKETS],
            current: None,
            pending: None,
        }
    }

    /// Starts to assemble revolutions with `beams` beams.
    fn begin(&mut self, beams: usize) {
        self.has_begun = true;
        self.assembler.begin(beams);
    }

    /// Ends the stream, and discards incomplete revolutions.
    fn end(&mut self) {
        self.assembler.discard();
        self.has_begun = false;
        (self.current, self.pending) = (None, None);
    }

    /// Adds the points of the current packets to revolutions until a revolution is complete. Returns that revolution.
    /// `rate` is the speed of the head.
    fn advance(&mut self, framer: &Framer, rate: Option<RotationRate>) -> Option<ClosedRevolution> {
        while let Some(CurrentSpan { kind, span, next_packet: packet, is_added: is_put }) = self.current {
            let position = self.positions.get(packet).copied().filter(|_| packet < span.packets);
            let (Some(place), Some(pace)) = (position, rate) else {
                self.current = None;
                return None;
            };
            if !is_put {
                self.current = Some(CurrentSpan { kind, span, next_packet: packet, is_added: true });
                let bytes = &framer.bytes(span)[packet * kind.byte_len()..][..kind.byte_len()];
                let reasons = if packet == 0 { span.reasons } else { 0 };
                self.add_packet(kind, bytes, place, reasons, pace);
            }
            if place.step != Step::Outlier
                && let Some(closed) = self.assembler.close_before(place.angle - kind.max_before(), pace)
            {
                return Some(closed);
            }
            self.current = Some(CurrentSpan { kind, span, next_packet: packet + 1, is_added: false });
        }
        None
    }

    /// Adds the points that are known once the packet `bytes` has arrived. For a packet of one point, this is the point
    /// of the packet. Otherwise, these are the points of the previous packet.
    fn add_packet(
        &mut self,
        kind: PacketFormat,
        bytes: &[u8],
        position: PacketPosition,
        reasons: u8,
        rate: RotationRate,
    ) {
        match position.step {
            Step::First => self.assembler.discard(),
            Step::Gap { from, .. } => {
                self.assembler.mark_gap(from - kind.max_before(), position.angle + kind.max_after());
            }
            Step::Next => {}
            Step::Outlier => {
                self.pending = None;
                return;
            }
        }
        if kind == PacketFormat::Standard {
            let point = kind.point(bytes, bytes, 0);
            return self.assembler.add_point(
                position.angle,
                position.time,
                point.range,
                point.quality,
                reasons,
                rate,
            );
        }
        if let Some(pending) = self.pending.take().filter(|_| position.step == Step::Next) {
            self.add_pending(kind, &pending, bytes, position, rate);
        }
        let mut copy = [0; PacketFormat::MAX_LEN];
        copy[..kind.byte_len()].copy_from_slice(bytes);
        self.pending = Some(PendingPacket { bytes: copy, position, reasons });
    }

    /// Adds the points of `pending`. The packet `next` follows it at `position`.
    fn add_pending(
        &mut self,
        kind: PacketFormat,
        pending: &PendingPacket,
        next: &[u8],
        position: PacketPosition,
        rate: RotationRate,
    ) {
        let step = (position.angle - pending.position.angle) / kind.points() as f64;
        for i in 0..kind.points() {
            let point = kind.point(&pending.bytes[..kind.byte_len()], next, i);
            let angle = pending.position.angle + step * i as f64 - f64::from(point.before);
            let time = pending.position.time + rate.point_ns * i as f64;
            self.assembler.add_point(
                angle,
                time,
                point.range,
                point.quality,
                pending.reasons,
                RotationRate { step, ..rate },
            );
        }
    }
}

/// Duration of the first measurement of the time per point. The assembly of revolutions starts after this measurement.
const FIRST_MEASUREMENT_TIME: Nanos = 250 * MILLIS;
/// Maximum change of the head's speed during a gap, as a ratio.
const SPEED_VARIATION: f64 = 0.005;
/// Additional time in nanoseconds after which packets count as late. They may be delayed by this time because they
/// arrive together with later packets.
const LATE_TOLERANCE_NS: f64 = 15e6;
/// Maximum deviation of the time per point from the reported time, as a ratio.
const MAX_POINT_TIME_DEVIATION: f64 = 0.02;
/// Maximum number of points in a revolution. An S2 measures fewer points, even at four revolutions per second.
const MAX_POINTS: usize = 8_192;
/// Maximum number of packets in a sample.
const MAX_PACKETS: usize = 128;
/// Maximum length of a sample, in bytes.
pub(crate) const MAX_SAMPLE_LEN: usize = 800;
