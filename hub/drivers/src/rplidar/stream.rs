//! Packets of a stream: gives them stamps, and assembles their points into revolutions. The points of a packet with
//! several points are known once the next packet has arrived, and only if nothing is missing between the two.

use crate::line::{self, Arrivals, Closed, Flow, Pace, RawScan, Reads, SensorClock, TurnCounts, Turns};
use crate::settings::Settings;
use scanhub_schema::{Family, MILLIS, Nanos, line_time};

use crate::rplidar::framer::{Framer, Span};
use crate::rplidar::handshake::{Handshake, ScanModes};
use crate::rplidar::packet::Kind;
use crate::rplidar::sequence::{Came, Place, Sequence, Step};
use crate::rplidar::{Mode, Model};

/// The line that packets arrive on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Line<'a> {
    pub(crate) arrivals: &'a Arrivals,
    /// Rate in bits per second.
    pub(crate) baud: u32,
    /// Rate if bytes arrive at the pace of the line, unlike those of a network or a recording.
    pub(crate) pace: Option<u32>,
}

/// The packets of a stream and their points.
#[derive(Clone, Debug)]
pub(crate) struct Stream {
    settings: Settings,
    sequence: Sequence,
    clock: SensorClock,
    point_time: PointTime,
    revolutions: Revolutions,
    /// Number of beams, once it is known.
    pub(crate) beams: Option<usize>,
    /// Time of the last packet, by the scanner's clock.
    pub(crate) scanner_time: Option<Nanos>,
}

impl Stream {
    pub(crate) fn new(settings: Settings) -> Stream {
        Stream {
            settings,
            sequence: Sequence::new(),
            clock: SensorClock::new(),
            point_time: PointTime::default(),
            revolutions: Revolutions::new(),
            beams: None,
            scanner_time: None,
        }
    }

    /// Ends the stream: the next packet belongs to another one.
    pub(crate) fn end(&mut self) {
        self.sequence.end();
        self.revolutions.end();
        self.point_time.measurement = None;
        if self.settings.listen_only {
            // The recorded program may have chosen another mode.
            (self.point_time.ns, self.scanner_time) = (None, None);
        }
    }

    /// Returns whether packets have arrived since the stream began.
    pub(crate) fn is_begun(&self) -> bool {
        self.sequence.is_begun()
    }

    /// Sets the microseconds per point that the scanner reported for the mode that it is about to start.
    pub(crate) fn set_sample_us(&mut self, sample_us: Option<f32>) {
        self.point_time.ns = sample_us.map(|us| f64::from(us) * 1e3);
    }

    /// Returns the points that the scanner measures per second, once they are known.
    pub(crate) fn points_per_second(&self) -> Option<f32> {
        self.point_time.ns.map(|ns| (1e9 / ns) as f32)
    }

    /// Returns the numbers of received and lost packets.
    pub(crate) fn came_and_lost(&self) -> (u64, u64) {
        self.sequence.came_and_lost()
    }

    /// Returns the numbers of revolutions by kind.
    pub(crate) fn turn_counts(&self) -> TurnCounts {
        self.revolutions.turns.counts()
    }

    /// Returns the number of packets that arrive in 10 ms, as far as a sample has space for them.
    pub(crate) fn max_packets_per_sample(&self, kind: Kind) -> usize {
        let packet_ns = self.point_time.ns.unwrap_or(1e6) * kind.points() as f64;
        ((1e7 / packet_ns) as usize).clamp(1, (MAX_SAMPLE_LEN / kind.bytes()).min(MAX_PACKETS))
    }

    /// Measures the time per point with the packets of `span`, if the scanner has not reported it. Returns whether it
    /// is known.
    pub(crate) fn measure(&mut self, kind: Kind, span: Span, line: Line<'_>, modes: &ScanModes) -> bool {
        let time = &mut self.point_time;
        if self.settings.listen_only || time.ns.is_none() || time.measurement.is_some() {
            let at = line.arrivals.latest(span.offset + span.len as u64 - 1, line.pace);
            let change = time.measure(kind, span, at, modes, self.settings);
            if change > 0.1 {
                self.sequence.end();
            }
            if change > 0.001 {
                // Its times were based on the previous value.
                self.clock = SensorClock::new();
            }
        }
        self.point_time.ns.is_some()
    }

    /// Places the packets of `span` in the sequence, and keeps them for [`advance`](Self::advance). Packets after a gap
    /// are given back to the framer, so that they arrive once more by themselves. Returns the stamps of the first point
    /// of the first packet and of the last point of the last packet, if they are known.
    pub(crate) fn place(
        &mut self,
        kind: Kind,
        span: &mut Span,
        framer: &mut Framer,
        line: Line<'_>,
        handshake: &Handshake,
    ) -> Option<(Nanos, Nanos)> {
        let Line { arrivals, baud, pace } = line;
        let point_ns = self.point_time.ns?;
        let len = kind.bytes();
        let packet_time = line_time(len, baud);
        let packet_ns = point_ns * kind.points() as f64;
        let to_last_point = point_ns * (kind.points() - 1) as f64;
        let flow = Flow { byte_ns: packet_ns / len as f64, packet_len: len, pace };
        let places = &mut self.revolutions.places;
        let mut count = 0;
        for (n, bytes) in framer.bytes(*span).chunks_exact(len).enumerate() {
            let came =
                Came { start: kind.start(bytes), skipped: if n == 0 { span.skipped } else { 0 }, packet_ns };
            let end = span.offset + (n * len + len - 1) as u64;
            let at = arrivals.latest(end, pace).saturating_sub(packet_time);
            let late = |time: f64, is_after_gap: bool| {
                let Some(due) = self.clock.time((time + to_last_point) as Nanos) else { return 0.0 };
                if at <= due {
                    return -((due - at) as f64);
                }
                let earliest = if is_after_gap {
                    arrivals.earliest_behind_gap(end, flow)
                } else {
                    arrivals.earliest(end, flow)
                };
                // A packet from a backlog is late for another reason.
                earliest.unwrap_or(0).saturating_sub(packet_time + due) as f64
            };
            let before = self.sequence;
            let place = match kind {
                Kind::Standard => self.sequence.place_point(came, late),
                _ => self.sequence.place(came, late),
            };
            if n > 0 && matches!(place.step, Step::First | Step::Gap { .. }) {
                self.sequence = before;
                break;
            }
            let last_point = (place.time + to_last_point) as Nanos;
            if place.step == Step::First {
                // Neither a revolution nor the clock continues from earlier packets.
                self.clock = SensorClock::new();
                self.revolutions.turns.give_up();
                self.revolutions.pending = None;
            }
            if let Step::Gap { ns, .. } = place.step
                && ns * UNSTEADY > packet_ns / 2.0
            {
                self.clock.doubt(last_point, (ns * UNSTEADY + packet_ns) as Nanos + MILLIS);
            }
            if place.step != Step::Odd {
                self.clock.note(last_point, at);
            }
            places[n] = place;
            count += 1;
        }
        if count < span.packets {
            framer.cut(span, count);
        }
        let places = &places[..span.packets];
        let is_placed = |place: &&Place| place.step != Step::Odd;
        let stamp = |place: Option<&Place>| {
            place.filter(is_placed).and_then(|place| self.clock.time((place.time + to_last_point) as Nanos))
        };
        let stamps = stamp(places.first()).zip(stamp(places.last()));
        self.scanner_time = places.iter().rev().find(is_placed).map(|place| place.time as Nanos);
        self.revolutions.current = Some(Current { kind, span: *span, packet: 0, is_put: false });
        self.choose_beams(kind, handshake);
        stamps
    }

    /// Chooses the number of beams as soon as the speed of the head is known, once per stream.
    fn choose_beams(&mut self, kind: Kind, handshake: &Handshake) {
        let Settings { beams, max_beams, .. } = self.settings;
        let Some(point_ns) = self.point_time.ns.filter(|_| !self.revolutions.is_begun) else { return };
        let Some(advance) = self.sequence.advance() else { return };
        let points_per_turn = 360.0 / advance * kind.points() as f64;
        let own = match handshake.model() {
            Some(model) => self.beams_of(model, kind, point_ns, handshake),
            None => (points_per_turn + 0.5) as usize,
        };
        let most = max_beams.unwrap_or(*line::BEAMS.end());
        let beams = beams.or(self.beams).unwrap_or(own.max(*line::BEAMS.start())).min(most);
        self.beams = Some(beams);
        self.revolutions.begin(beams);
    }

    /// Returns the number of beams of a `model` that takes `point_ns` per point: that of the mode in the settings, or that of
    /// the mode that the scanner has reported, if the beams follow it. Otherwise that of the fastest mode. An A1 with an old
    /// firmware measures half as many points as the others.
    fn beams_of(&self, model: Model, kind: Kind, point_ns: f64, handshake: &Handshake) -> usize {
        let Settings { model: named, mode, is_found, listen_only, .. } = self.settings;
        let point_us = (point_ns / 1e3) as f32;
        let follows = listen_only || is_found && named.is_none();
        let mode_us = match mode {
            Some(_) => Some(point_us),
            None => handshake.modes.nearest_us(kind, point_us).filter(|_| follows),
        };
        mode_us.map_or(model.beams(), |us| model.beams_in_mode(1e6 / us))
    }

    /// Returns the microseconds per point that a scanner of this `model` must have reported: the measured ones, unless the
    /// number of `beams` of its scans shows that it reported another value. A real A1 takes 0.7 % longer than it reports.
    pub(crate) fn reported_us(&self, model: Option<Model>, beams: Option<usize>) -> Option<f64> {
        let measured = self.point_time.ns? / 1e3;
        let of_scans = model.zip(beams).and_then(|(model, beams)| {
            let reported = 1e6 / (beams as f64 * f64::from(model.turns_per_second()));
            let is_other = model.beams_in_mode((1e6 / measured) as f32) != beams;
            (is_other && (reported / measured - 1.0).abs() <= OFF).then_some(reported)
        });
        of_scans.or(Some(measured))
    }

    /// Returns the speed of the head. `None` before the revolutions have begun.
    fn pace(&self, kind: Kind) -> Option<Pace> {
        let known = self.point_time.ns.zip(self.sequence.advance());
        let (point_ns, advance) = known.filter(|_| self.revolutions.is_begun)?;
        Some(Pace { step: advance / kind.points() as f64, point_ns })
    }

    /// Adds the points of the placed packets to revolutions. Returns the first revolution that is complete.
    pub(crate) fn advance(&mut self, framer: &Framer) -> Option<Closed> {
        let pace = self.revolutions.current.and_then(|current| self.pace(current.kind));
        self.revolutions.advance(framer, pace)
    }

    /// Returns the revolution that is being measured, with the points so far.
    pub(crate) fn partial_revolution(&self, kind: Kind) -> Option<Closed> {
        self.revolutions.turns.begun(self.pace(kind)?)
    }

    /// Converts a revolution, complete or partial, to the hub's clock.
    pub(crate) fn scan(&self, closed: Closed, reads: &Reads, now: Nanos) -> RawScan<'_> {
        let stamp = |at: Nanos| self.clock.time(at).unwrap_or(now);
        let stamps = reads.turn_dates(stamp(closed.first), stamp(closed.last));
        let resolution = (self.beams.unwrap_or_default(), self.points_per_second().unwrap_or_default());
        let points = self.revolutions.turns.points(&closed);
        RawScan::revolution(Family::Rplidar, &closed, stamps, resolution, points)
    }
}

/// Nanoseconds per point: as the scanner reported, or measured.
#[derive(Clone, Copy, Debug, Default)]
struct PointTime {
    ns: Option<f64>,
    measurement: Option<Measurement>,
}

/// Duration and number of points of spans without anything missing between them.
#[derive(Clone, Copy, Debug)]
struct Measurement {
    /// Arrival of the last packet.
    last: Nanos,
    /// Whether something is missing before it.
    is_incomplete: bool,
    /// Nanoseconds by which the last packet arrived later than in a steady stream. It falls while packets catch up.
    behind: f64,
    passed: Nanos,
    points: u64,
    /// Duration after which the result counts.
    duration: Nanos,
}

impl Measurement {
    fn new(last: Nanos, duration: Nanos) -> Measurement {
        Measurement { last, is_incomplete: false, behind: 0.0, passed: 0, points: 0, duration }
    }
}

impl PointTime {
    /// Measures with the packets of `span`, whose last one arrived at `at`. Among the reported times of modes with
    /// packets of `kind`, the nearest one counts. Without any, the measured time counts, and is measured again over
    /// longer and longer durations. Returns the relative change of a time that was known.
    fn measure(&mut self, kind: Kind, span: Span, at: Nanos, modes: &ScanModes, settings: Settings) -> f64 {
        let Some(measurement) = &mut self.measurement else {
            self.ns = modes.sample_us(kind, Mode::of(&settings)).map(|us| f64::from(us) * 1e3);
            self.measurement = Some(Measurement::new(at, FIRST_MEASUREMENT));
            return 0.0;
        };
        let apart = at.saturating_sub(core::mem::replace(&mut measurement.last, at));
        let points = (span.packets * kind.points()) as f64;
        let steady = self.ns.map(|ns| points * ns);
        let ahead = steady.map_or(0.0, |steady| steady - apart as f64);
        let is_late = steady.is_some_and(|steady| apart as f64 > 1.5 * steady + LATE);
        measurement.behind = match steady {
            Some(_) if is_late => -ahead,
            // Packets that waited with the late one arrive fast until they have caught up.
            Some(steady) if ahead > steady / 2.0 => (measurement.behind - ahead).max(0.0),
            _ => 0.0,
        };
        // Packets that arrive at the same time as an incomplete span were read together with it.
        measurement.is_incomplete = span.reasons != 0
            || is_late
            || measurement.behind > 0.0
            || (measurement.is_incomplete && apart == 0);
        if measurement.is_incomplete {
            return 0.0;
        }
        measurement.passed += apart;
        measurement.points += (span.packets * kind.points()) as u64;
        if measurement.passed < measurement.duration {
            return 0.0;
        }
        let measured = measurement.passed as f64 / measurement.points as f64;
        *measurement = Measurement::new(at, 2 * measurement.duration);
        let reported = modes.nearest_us(kind, (measured / 1e3) as f32);
        let ns = reported.map_or(measured, |us| f64::from(us) * 1e3);
        self.ns.replace(ns).map_or(0.0, |before| (before / ns - 1.0).abs())
    }
}

/// Assembles the points of placed packets into revolutions.
#[derive(Clone, Debug)]
struct Revolutions {
    turns: Turns<MAX_POINTS>,
    /// Whether the number of beams of this stream is known.
    is_begun: bool,
    /// Positions of the packets of the last span.
    places: [Place; MAX_PACKETS],
    /// Packets whose points are not in revolutions yet.
    current: Option<Current>,
    pending: Option<PendingPacket>,
}

/// Packets of a span whose points are being added to revolutions.
#[derive(Clone, Copy, Debug)]
struct Current {
    kind: Kind,
    span: Span,
    /// Index of the first packet that is not finished.
    packet: usize,
    /// Whether its points were added.
    is_put: bool,
}

/// A packet whose points are known only with the next packet.
#[derive(Clone, Copy, Debug)]
struct PendingPacket {
    bytes: [u8; Kind::LONGEST],
    place: Place,
    reasons: u8,
}

impl Revolutions {
    fn new() -> Revolutions {
        Revolutions {
            turns: Turns::new(),
            is_begun: false,
            places: [Place { step: Step::Odd, angle: 0.0, time: 0.0 }; MAX_PACKETS],
            current: None,
            pending: None,
        }
    }

    /// Begins revolutions with `beams` beams.
    fn begin(&mut self, beams: usize) {
        self.is_begun = true;
        self.turns.begin(beams);
    }

    /// Gives up what is not complete, because the stream ended.
    fn end(&mut self) {
        self.turns.give_up();
        self.is_begun = false;
        (self.current, self.pending) = (None, None);
    }

    /// Adds the points of the current packets, of a head with the speed `pace`. Returns the first revolution that is
    /// complete.
    fn advance(&mut self, framer: &Framer, pace: Option<Pace>) -> Option<Closed> {
        while let Some(Current { kind, span, packet, is_put }) = self.current {
            let place = self.places.get(packet).copied().filter(|_| packet < span.packets);
            let (Some(place), Some(pace)) = (place, pace) else {
                self.current = None;
                return None;
            };
            if !is_put {
                self.current = Some(Current { kind, span, packet, is_put: true });
                let bytes = &framer.bytes(span)[packet * kind.bytes()..][..kind.bytes()];
                let reasons = if packet == 0 { span.reasons } else { 0 };
                self.put_packet(kind, bytes, place, reasons, pace);
            }
            if place.step != Step::Odd
                && let Some(closed) = self.turns.reach(place.angle - kind.most_before(), pace)
            {
                return Some(closed);
            }
            self.current = Some(Current { kind, span, packet: packet + 1, is_put: false });
        }
        None
    }

    /// Adds the points that are known with the packet `bytes`: its own, or those of the packet before.
    fn put_packet(&mut self, kind: Kind, bytes: &[u8], place: Place, reasons: u8, pace: Pace) {
        match place.step {
            Step::First => self.turns.give_up(),
            Step::Gap { from, .. } => {
                self.turns.lacks(from - kind.most_before(), place.angle + kind.most_behind());
            }
            Step::Next => {}
            Step::Odd => {
                self.pending = None;
                return;
            }
        }
        if kind == Kind::Standard {
            let point = kind.point(bytes, bytes, 0);
            return self.turns.put(place.angle, place.time, point.range, point.quality, reasons, pace);
        }
        if let Some(pending) = self.pending.take().filter(|_| place.step == Step::Next) {
            self.put_pending(kind, &pending, bytes, place, pace);
        }
        let mut copy = [0; Kind::LONGEST];
        copy[..kind.bytes()].copy_from_slice(bytes);
        self.pending = Some(PendingPacket { bytes: copy, place, reasons });
    }

    /// Adds the points of `pending`, which the packet `next` at `place` follows.
    fn put_pending(&mut self, kind: Kind, pending: &PendingPacket, next: &[u8], place: Place, pace: Pace) {
        let step = (place.angle - pending.place.angle) / kind.points() as f64;
        for i in 0..kind.points() {
            let point = kind.point(&pending.bytes[..kind.bytes()], next, i);
            let angle = pending.place.angle + step * i as f64 - f64::from(point.before);
            let time = pending.place.time + pace.point_ns * i as f64;
            self.turns.put(angle, time, point.range, point.quality, pending.reasons, Pace { step, ..pace });
        }
    }
}

/// Duration of the first measurement of the time per point. Revolutions begin after it.
const FIRST_MEASUREMENT: Nanos = 250 * MILLIS;
/// Fraction by which the speed of a head may change during a gap.
const UNSTEADY: f64 = 0.005;
/// Nanoseconds by which packets that arrive together may be late.
const LATE: f64 = 15e6;
/// Maximum share by which the time per point may differ from the reported one.
const OFF: f64 = 0.02;
/// Maximum number of points in a revolution: those of an S2 at four revolutions per second.
const MAX_POINTS: usize = 8_192;
/// Maximum number of packets of one sample.
const MAX_PACKETS: usize = 128;
/// Maximum number of bytes of one sample.
pub(crate) const MAX_SAMPLE_LEN: usize = 800;
