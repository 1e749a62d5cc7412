//! What becomes of packets: they are dated and handed out, and their points go into turns. Of a packet of several points these
//! are known once the next one came, and only if nothing was between.

use crate::line;
use crate::line::{
    Closed, Flow, Pace, RawScan, Received, SensorClock, State, Turns, Values, revolution_head,
};
use schema::{Family, MILLIS, Nanos, line_time};

use super::dialogue::Ask;
use super::{MOST_POINTS, Phase, SILENCE, Session};
use crate::rplidar::framer::{Expect, Span};
use crate::rplidar::packet::Kind;
use crate::rplidar::sequence::{Came, Place, Step};

/// Packets on their way into turns.
#[derive(Clone, Copy, Debug)]
pub(super) struct Current {
    kind: Kind,
    span: Span,
    /// The first one that is not done, and whether its points are.
    packet: usize,
    is_put: bool,
}

/// A packet of which the points are not known yet.
#[derive(Clone, Copy, Debug)]
pub(super) struct Held {
    bytes: [u8; Kind::LONGEST],
    place: Place,
    reasons: u8,
}

/// What the points of a span took, as far as nothing is missing between them: so long takes a point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Measure {
    /// When the last packet was there.
    last: Nanos,
    /// Whether something is missing before it.
    lacks: bool,
    /// Nanoseconds by which the last packet came later than in a steady stream. It falls while packets catch up.
    behind: f64,
    passed: Nanos,
    points: u64,
    /// What has to pass until it is believed.
    span: Nanos,
}

impl Session {
    /// No more packets of this stream.
    pub(super) fn end_stream(&mut self) {
        self.sequence.end();
        self.turns.give_up();
        self.is_learned = false;
        (self.current, self.held, self.measure) = (None, None, None);
        self.reads.end_rest();
        if self.settings.listen_only {
            // The next one may be another one, and nobody asks for it here.
            (self.point_ns, self.scanner_time) = (None, None);
        }
    }

    /// The scanner begins to measure, if it is what it was told last.
    pub(super) fn stream_begins(&mut self) {
        match self.phase {
            // Another one is there that somebody else told to measure, nobody knows in which mode.
            Phase::Hearing { .. } if self.sequence.is_begun() && !self.settings.listen_only => {
                self.resyncs += 1;
                self.begin(State::Starting);
            }
            Phase::Asking { ask: Ask::Scan(_), .. } | Phase::Listening { .. } | Phase::Hearing { .. } => {
                self.end_stream();
                self.hear();
                self.await_turn();
                if let Phase::Hearing { turned_at, silent_at, .. } = &mut self.phase {
                    (*turned_at, *silent_at) = (self.now + SPIN_UP, self.now + SPIN_UP);
                }
            }
            Phase::Paused { .. } => self.framer.expect(Expect::Nothing),
            _ => self.framer.expect(Expect::Answers),
        }
    }

    /// Packets that arrive in ten milliseconds, as far as a sample has room for them.
    pub(super) fn most_together(&self, kind: Kind) -> usize {
        let packet_ns = self.point_ns.unwrap_or(1e6) * kind.points() as f64;
        ((1e7 / packet_ns) as usize).clamp(1, (LONGEST / kind.bytes()).min(MOST))
    }

    /// Packets came: dates them, and remembers them for turns. Those behind a gap come once more, by themselves.
    pub(super) fn receive(&mut self, kind: Kind, mut span: Span) -> Received<'_> {
        self.hear();
        span.reasons |= self.reads.take_doubt(span.offset + span.len as u64);
        if self.settings.listen_only || self.point_ns.is_none() || self.measure.is_some() {
            self.measure(kind, span);
        }
        let len = kind.bytes();
        let pace = (!self.settings.fixed_rate).then_some(self.baud);
        let packet_time = line_time(len, self.baud);
        let end = |n: usize| span.offset + (n * len + len - 1) as u64;
        let mut stamps = None;
        if let Some(point_ns) = self.point_ns {
            let behind_first = point_ns * (kind.points() - 1) as f64;
            let packet_ns = point_ns * kind.points() as f64;
            let mut count = 0;
            for (n, bytes) in self.framer.bytes(span).chunks_exact(len).enumerate() {
                let came = Came {
                    start: kind.start(bytes),
                    skipped: if n == 0 { span.skipped } else { 0 },
                    packet_ns,
                };
                let at = self.reads.arrivals().latest(end(n), pace).saturating_sub(packet_time);
                let late = |time: f64, is_behind_gap: bool| {
                    let Some(due) = self.clock.time((time + behind_first) as Nanos) else { return 0.0 };
                    if at <= due {
                        return -((due - at) as f64);
                    }
                    let flow = Flow { byte_ns: packet_ns / len as f64, packet_len: len, pace };
                    let arrivals = self.reads.arrivals();
                    let least = if is_behind_gap {
                        arrivals.earliest_behind_gap(end(n), flow)
                    } else {
                        arrivals.earliest(end(n), flow)
                    };
                    // One that waited is late for another reason.
                    least.unwrap_or(0).saturating_sub(packet_time + due) as f64
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
                if place.step == Step::First {
                    // Nothing goes on from what was before: neither its turn nor its clock.
                    self.clock = SensorClock::new();
                    self.turns.give_up();
                    self.held = None;
                }
                if let Step::Gap { ns, .. } = place.step
                    && ns * UNSTEADY > packet_ns / 2.0
                {
                    let most = (ns * UNSTEADY + packet_ns) as Nanos + MILLIS;
                    self.clock.doubt((place.time + behind_first) as Nanos, most);
                }
                if place.step != Step::Odd {
                    self.clock.note((place.time + behind_first) as Nanos, at);
                }
                self.places[n] = place;
                count += 1;
            }
            if count < span.packets {
                self.framer.cut(&mut span, count);
            }
            let stamp = |n: usize| {
                let place = &self.places[n];
                let is_placed = place.step != Step::Odd;
                self.clock.time((place.time + behind_first) as Nanos).filter(|_| is_placed)
            };
            stamps = stamp(0).zip(stamp(span.packets - 1));
            self.current = Some(Current { kind, span, packet: 0, is_put: false });
            self.learn(kind);
            let tally = self.framer.tally();
            self.cut |= tally.packets == span.packets as u64 && tally.discarded > 0;
            self.scanner_time = self.places[..span.packets]
                .iter()
                .rev()
                .find(|place| place.step != Step::Odd)
                .map(|place| place.time as Nanos);
        }
        let latest =
            self.reads.arrivals().latest(span.offset + span.len as u64 - 1, pace).saturating_sub(packet_time);
        let (first, last) = stamps.unwrap_or((latest, latest));
        let first = first.min(self.now);
        let last = self.reads.date_packet((last + packet_time).clamp(first, self.now.max(first)));
        Received {
            bytes: self.framer.bytes(span),
            first,
            last,
            estimated: stamps.is_none(),
            reasons: span.reasons,
            count: span.packets,
            is_checked: kind.is_checked(),
            is_reply: false,
            whole: None,
        }
    }

    /// The stream begins or goes on.
    fn hear(&mut self) {
        let silent_at = self.now + SILENCE;
        let discarded = self.framer.tally().discarded;
        match &mut self.phase {
            Phase::Hearing { silent_at: at, .. } => {
                *at = silent_at;
                self.damaged.0 += discarded - self.damaged.1;
            }
            _ => {
                self.trouble = None;
                self.phase = Phase::Hearing { turned_at: self.now, has_turned: false, silent_at };
                self.await_turn();
            }
        }
        self.streamed_at = Some(self.baud);
        self.damaged.1 = discarded;
    }

    /// How long a point takes, where nobody is asked or nobody answered: as somebody was told, of the modes of `kind` the one that
    /// packets agree with; else as long as these take, measured anew in spans that get longer.
    fn measure(&mut self, kind: Kind, span: Span) {
        let pace = (!self.settings.fixed_rate).then_some(self.baud);
        let at = self.reads.arrivals().latest(span.offset + span.len as u64 - 1, pace);
        let Some(measure) = &mut self.measure else {
            let told = self.offers.sample_us(kind, self.settings.mode);
            self.point_ns = told.map(|us| f64::from(us) * 1e3);
            self.measure =
                Some(Measure { last: at, lacks: false, behind: 0.0, passed: 0, points: 0, span: SOON });
            return;
        };
        let apart = at.saturating_sub(core::mem::replace(&mut measure.last, at));
        let points = (span.packets * kind.points()) as f64;
        let steady = self.point_ns.map(|ns| points * ns);
        let ahead = steady.map_or(0.0, |steady| steady - apart as f64);
        let is_late = steady.is_some_and(|steady| apart as f64 > 1.5 * steady + LATE);
        measure.behind = match steady {
            Some(_) if is_late => -ahead,
            // Packets that waited with the late one arrive fast until they have caught up.
            Some(steady) if ahead > steady / 2.0 => (measure.behind - ahead).max(0.0),
            _ => 0.0,
        };
        // What comes at the same time came with it.
        measure.lacks = span.reasons != 0 || is_late || measure.behind > 0.0 || (measure.lacks && apart == 0);
        if measure.lacks {
            return;
        }
        measure.passed += apart;
        measure.points += (span.packets * kind.points()) as u64;
        if measure.passed < measure.span {
            return;
        }
        let measured = measure.passed as f64 / measure.points as f64;
        *measure =
            Measure { last: at, lacks: false, behind: 0.0, passed: 0, points: 0, span: 2 * measure.span };
        let told = self.offers.nearest_us(kind, (measured / 1e3) as f32);
        let point_ns = told.map_or(measured, |us| f64::from(us) * 1e3);
        let off = self.point_ns.map_or(0.0, |before| (before / point_ns - 1.0).abs());
        if off > 0.1 {
            self.sequence.end();
        }
        if off > 0.001 {
            // Its times were others.
            self.clock = SensorClock::new();
        }
        self.point_ns = Some(point_ns);
    }

    /// The grid is known once it is known how fast the head turns.
    fn learn(&mut self, kind: Kind) {
        let Some(point_ns) = self.point_ns.filter(|_| !self.is_learned) else { return };
        let Some(advance) = self.sequence.advance() else { return };
        let points_per_turn = 360.0 / advance * kind.points() as f64;
        let own = match (self.model(), self.settings.mode) {
            (Some(model), None) => model.beams(),
            (Some(model), Some(_)) => model.beams_of((1e9 / point_ns) as f32),
            (None, _) => (points_per_turn + 0.5) as usize,
        };
        let most = self.settings.max_beams.unwrap_or(*line::grid::BEAMS.end());
        let beams =
            self.settings.beams.or(self.beams).unwrap_or(own.max(*line::grid::BEAMS.start())).min(most);
        (self.beams, self.is_learned) = (Some(beams), true);
        self.turns.begin(beams);
    }

    /// Puts what was handed out into turns; one that is over.
    pub(super) fn advance_turns(&mut self) -> Option<Closed> {
        while let Some(current) = &mut self.current {
            let (kind, span, packet) = (current.kind, current.span, current.packet);
            let is_put = core::mem::replace(&mut current.is_put, true);
            let place = self.places.get(packet).copied().filter(|_| packet < span.packets);
            let (Some(place), Some(pace)) = (place, self.pace(kind)) else {
                self.current = None;
                return None;
            };
            if !is_put {
                self.put_packet(kind, span, packet, place, pace);
            }
            if place.step != Step::Odd
                && let Some(closed) = self.turns.reach(place.angle - kind.most_before(), pace)
            {
                return Some(closed);
            }
            if let Some(current) = &mut self.current {
                (current.packet, current.is_put) = (packet + 1, false);
            }
        }
        None
    }

    /// Puts points into turns: those of this packet, or those of the one before it.
    fn put_packet(&mut self, kind: Kind, span: Span, packet: usize, place: Place, pace: Pace) {
        let reasons = if packet == 0 { span.reasons } else { 0 };
        let bytes = &self.framer.bytes(span)[packet * kind.bytes()..][..kind.bytes()];
        match place.step {
            Step::First => self.turns.give_up(),
            Step::Gap { from, .. } => {
                self.turns.lacks(from - kind.most_before(), place.angle + kind.most_behind());
            }
            Step::Next => {}
            Step::Odd => {
                self.held = None;
                return;
            }
        }
        if kind == Kind::Standard {
            let point = kind.point(bytes, bytes, 0);
            return self.turns.put(place.angle, place.time, point.range, point.quality, reasons, pace);
        }
        if let Some(held) = self.held.take().filter(|_| place.step == Step::Next) {
            put(&mut self.turns, kind, &held, bytes, place, pace);
        }
        let mut copy = [0; Kind::LONGEST];
        copy[..kind.bytes()].copy_from_slice(bytes);
        self.held = Some(Held { bytes: copy, place, reasons });
    }

    /// How fast the head turns past points; nothing before turns are wanted.
    fn pace(&self, kind: Kind) -> Option<Pace> {
        let (point_ns, advance) = self.point_ns.zip(self.sequence.advance()).filter(|_| self.is_learned)?;
        Some(Pace { step: advance / kind.points() as f64, point_ns })
    }

    pub(super) fn show(&mut self, closed: Closed) -> RawScan<'_> {
        let first = self.dated(closed).first;
        self.reads.end_turn(first);
        self.trouble = None;
        if let Phase::Hearing { turned_at, has_turned, .. } = &mut self.phase {
            (*turned_at, *has_turned) = (self.now, true);
        }
        self.await_turn();
        self.dated(closed)
    }

    /// The turn that is being measured, as if it ended with the points that are known.
    pub(crate) fn begun_turn(&self) -> Option<RawScan<'_>> {
        let pace = self.framer.kind().and_then(|kind| self.pace(kind))?;
        self.turns.begun(pace).map(|begun| self.dated(begun))
    }

    /// A turn that is over, or that is being measured, by the hub's clock.
    fn dated(&self, closed: Closed) -> RawScan<'_> {
        let stamp = |at: Nanos| self.clock.time(at).unwrap_or(self.now);
        let (first, last) = self.reads.turn_dates(stamp(closed.first), stamp(closed.last));
        let (beams, per_second) =
            (self.beams.unwrap_or_default(), self.points_per_second().unwrap_or_default());
        RawScan {
            number: closed.number,
            first,
            last,
            period: closed.period,
            reasons: closed.reasons,
            bytes: 0,
            head: revolution_head(Family::Rplidar, beams, closed.period, per_second, closed.incomplete),
            values: Values::Points { points: self.turns.points(&closed), per_second },
        }
    }
}

/// The points of `held`, which `next` follows at `place`.
fn put(turns: &mut Turns<MOST_POINTS>, kind: Kind, held: &Held, next: &[u8], place: Place, pace: Pace) {
    let step = (place.angle - held.place.angle) / kind.points() as f64;
    for i in 0..kind.points() {
        let point = kind.point(&held.bytes[..kind.bytes()], next, i);
        let angle = held.place.angle + step * i as f64 - f64::from(point.before);
        let time = held.place.time + pace.point_ns * i as f64;
        turns.put(angle, time, point.range, point.quality, held.reasons, Pace { step, ..pace });
    }
}

/// A stream of which nobody was told how long a point takes is measured so long before it has turns.
const SOON: Nanos = 250 * MILLIS;
/// The share by which heads turn faster or slower over a gap than before it.
const UNSTEADY: f64 = 0.005;
/// Nanoseconds by which packets come late that came in one piece.
const LATE: f64 = 15e6;
/// Some heads have to turn before they measure.
const SPIN_UP: Nanos = 3_000 * MILLIS;
/// Packets of one sample at the most, and its bytes.
pub(super) const MOST: usize = 128;
pub(super) const LONGEST: usize = 800;
