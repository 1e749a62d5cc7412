//! The session with an LDROBOT scanner, which streams without a request. The session only receives: at the model's
//! rate, or at both rates in turn until packets arrive. It learns how many points the scanner measures per second, and
//! returns packets as they arrive, and revolutions.

use core::fmt;

use scanhub_schema::{Family, MILLIS, Nanos, line_time};

use crate::ld::packet::{Framer, LEN, POINTS, Packet, Span};
use crate::ld::point_count::{Counted, PointCount};
use crate::ld::sequence::{Place, Restarts, Sequence};
use crate::ld::{FEATURES, Model, described};
use crate::line::{
    self, Account, Closed, Control, Event, Flow, Output, Pace, RawScan, Reads, Received, SensorClock, State,
    StreamCounters, Tally, TurnCounts, Turns, Watchdog, family,
};
use crate::settings::Settings;

/// The session with one scanner.
#[derive(Clone, Debug)]
pub struct Session {
    settings: Settings,
    framer: Framer,
    reads: Reads,
    clock: SensorClock,
    /// If a new sequence began within the packets that were returned last: the number of its first packet among them,
    /// and the clock of the packets before.
    clock_before: Option<(usize, SensorClock)>,
    sequence: Sequence,
    turns: Turns<MOST_POINTS>,
    /// Pace of the packet whose points were added last.
    pace: Option<Pace>,
    phase: Phase,
    baud: u32,
    change_baud: bool,
    point_count: PointCount,
    /// Model and number of beams by the points that the scanner measures, once they are known. A power cycle does not
    /// change them.
    measured: Option<(Model, usize)>,
    /// Time since which packets have arrived without a decision about the number of beams.
    undecided_since: Nanos,
    /// Another number of beams, which the points have required since this time of the scanner's clock.
    other_beams: Option<(usize, Nanos)>,
    /// The last change of the number of beams, and until when it is reported.
    change: Option<(Trouble, Nanos)>,
    /// Number of beams, once it is known.
    beams: Option<usize>,
    /// Whether the points per second of this stream are known.
    is_learned: bool,
    scanner_time: Option<Nanos>,
    /// Packets that were returned and whose points are not in revolutions yet.
    current: Option<Current>,
    now: Nanos,
    trouble: Option<Trouble>,
    /// Time since which no packet has arrived.
    quiet_since: Nanos,
    counters: StreamCounters,
    restarts: Restarts,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// No packets yet. At `next_at` the session tries another rate.
    Listening { shown: State, next_at: Nanos },
    /// Packets arrive.
    Streaming(Watchdog),
    /// A user paused the session.
    Paused,
}

/// Packets whose points are being added to revolutions.
#[derive(Clone, Copy, Debug)]
struct Current {
    span: Span,
    places: [Place; MOST],
    /// Number of the first packet that is not finished.
    packet: usize,
    /// Whether its points were added.
    is_put: bool,
}

impl Session {
    /// Creates a session on a port that is open at the rate of `settings`.
    pub fn new(settings: Settings, now: Nanos) -> Self {
        Session {
            settings,
            framer: Framer::default(),
            reads: Reads::new(now),
            clock: SensorClock::new(),
            clock_before: None,
            sequence: Sequence::new(),
            turns: Turns::new(),
            pace: None,
            point_count: PointCount::default(),
            measured: None,
            undecided_since: now,
            other_beams: None,
            change: None,
            phase: Phase::Listening { shown: State::Probing, next_at: now + LISTEN },
            baud: Model::of(&settings).map_or(FEATURES.auto.baud, Model::baud),
            change_baud: false,
            beams: None,
            is_learned: false,
            scanner_time: None,
            current: None,
            now,
            trouble: None,
            quiet_since: now,
            counters: StreamCounters::default(),
            restarts: Restarts::default(),
        }
    }

    /// Restores the model and the number of beams that an earlier session on the same port has measured. Call it before
    /// the first read.
    pub fn recall(&mut self, model: Model, beams: usize) {
        self.measured = Some((model, beams));
    }

    /// Returns the model, once it is known. Of models that cannot be distinguished, it is one.
    pub fn model(&self) -> Option<Model> {
        Model::of(&self.settings).or(self.measured.map(|(model, _)| model))
    }

    /// Returns the number of beams for scans: that of the settings, of the model in the settings, or the measured one.
    fn known_beams(&self) -> Option<usize> {
        let of_model = || Model::of(&self.settings).map(Model::beams);
        let measured = || self.measured.map(|(_, beams)| beams);
        let beams = self.settings.beams.or_else(of_model).or_else(measured)?;
        Some(beams.min(self.settings.max_beams.unwrap_or(usize::MAX)))
    }

    /// Handles the points of a revolution of a scanner without a configured model. The first reliable number of points
    /// decides. Later, it must be different for a long time.
    fn count(&mut self, counted: Counted) {
        let Some((_, beams)) = self.measured else {
            self.measured = counted.is_final().then(|| (counted.model(), counted.beams()));
            return;
        };
        if !counted.is_final() || !counted.differs_from(beams) {
            self.other_beams = None;
            return;
        }
        // The clock of a scanner that has restarted begins again.
        let is_same = |&(other, since): &(usize, Nanos)| !counted.differs_from(other) && since <= counted.at;
        let known = self.other_beams.filter(is_same);
        let (other, since) = *self.other_beams.insert(known.unwrap_or((counted.beams(), counted.at)));
        if counted.at.saturating_sub(since) < CHANGE {
            return;
        }
        (self.measured, self.other_beams) = (Some((counted.model(), other)), None);
        if self.settings.beams.is_none() {
            self.is_learned = false;
            let trouble = Trouble::BeamsChanged { from: beams, to: other };
            self.change = Some((trouble, self.now + SHOW_CHANGE));
        }
    }

    /// Returns the model of the scanner if it is not the one of the settings. Models with the same number of points per
    /// second cannot be distinguished.
    fn heard_other_model(&self) -> Option<Model> {
        let wanted = Model::of(&self.settings)?;
        self.heard_model().filter(|heard| heard.points_per_second() != wanted.points_per_second())
    }

    /// Returns the model that the points per second indicate.
    fn heard_model(&self) -> Option<Model> {
        self.sequence.points_per_second().map(Model::of_point_rate)
    }

    /// Returns the points that the scanner measures per second, once enough packets have arrived.
    pub fn points_per_second(&self) -> Option<f32> {
        self.sequence.points_per_second()
    }

    /// Returns the counters of the framer.
    pub fn tally(&self) -> &Tally {
        self.framer.buffer.tally()
    }

    /// Returns the numbers of revolutions by kind.
    pub fn turn_counts(&self) -> TurnCounts {
        self.turns.counts()
    }

    /// Returns the rates at which packets may arrive.
    fn rates(&self) -> &'static [u32] {
        const BOTH: [u32; 2] = [230_400, 921_600];
        let at = usize::from(self.baud == BOTH[1]);
        if self.settings.model.is_some() || self.settings.fixed_rate { &BOTH[at..=at] } else { &BOTH }
    }

    /// Ends the stream, and waits for packets. The session shows the state `shown` meanwhile.
    fn listen(&mut self, shown: State) {
        self.phase = Phase::Listening { shown, next_at: self.now + LISTEN };
        self.quiet_since = self.now;
        self.sequence.end();
        self.turns.give_up();
        self.is_learned = false;
        self.current = None;
        self.reads.end_rest();
    }

    /// Tries the next rate, because no packet arrived at this one, and updates the time in the trouble.
    fn listen_on(&mut self, shown: State) {
        self.phase = Phase::Listening { shown, next_at: self.now + LISTEN };
        let rates = self.rates();
        if let Some(&next) = rates.iter().find(|&&rate| rate != self.baud) {
            self.baud = next;
            self.change_baud = true;
        }
        let seconds = (self.now.saturating_sub(self.quiet_since) / (1_000 * MILLIS)) as u32;
        if seconds > 0 {
            let seconds = 1 << seconds.ilog2();
            let baud = (rates.len() == 1).then_some(self.baud);
            self.trouble = Some(Trouble::NoPackets { baud, seconds });
        }
    }

    /// Handles deadlines after all bytes were framed. Bytes that are no packets do not extend a deadline.
    fn expire(&mut self) {
        match self.phase {
            Phase::Listening { shown, next_at } if self.now >= next_at => self.listen_on(shown),
            Phase::Streaming(watchdog) if watchdog.is_silent(self.now) => {
                self.counters.note_resync();
                self.trouble = Some(Trouble::Silence);
                self.listen(State::Silent);
            }
            Phase::Streaming(watchdog) if watchdog.is_revolution_overdue(self.now) => {
                let is_damaged = self.counters.is_mostly_damaged(self.framer.buffer.tally());
                self.trouble = (!is_damaged).then_some(Trouble::StandsStill);
            }
            _ => {}
        }
    }

    /// Stamps the packets of `span`, and keeps them for revolutions.
    fn receive(&mut self, span: Span) -> Received<'_> {
        let mut span = span;
        span.reasons |= self.reads.take_doubt(span.offset + (span.packets * LEN) as u64);
        let pace = (!self.settings.fixed_rate).then_some(self.baud);
        let packet_time = line_time(LEN, self.baud);
        let mut places = [Place::Odd; MOST];
        self.clock_before = None;
        let flow = Flow { byte_ns: self.sequence.packet_ns() / LEN as f64, packet_len: LEN, pace };
        let mut counted = None;
        let (bytes, _) = self.framer.bytes(span).as_chunks::<LEN>();
        for (number, bytes) in bytes.iter().enumerate() {
            let packet = Packet::checked(bytes);
            let place = self.sequence.place(&packet);
            counted = self.point_count.note(&packet, place).or(counted);
            self.measured = self.measured.or_else(|| self.point_count.typical());
            let end = span.offset + ((number + 1) * LEN - 1) as u64;
            if matches!(place, Place::First { .. }) {
                let arrivals = self.reads.arrivals();
                let earliest = arrivals.earliest_behind_gap(end, flow);
                let arrival = earliest.map(|earliest| (earliest, arrivals.latest(end, pace)));
                self.restarts.note_first(packet.millis(), arrival);
                let before = core::mem::replace(&mut self.clock, SensorClock::new());
                self.clock_before.get_or_insert((number, before));
            }
            if let Some(time) = place.time() {
                self.clock.note(time, self.reads.arrivals().latest(end, pace).saturating_sub(packet_time));
            }
            if let Place::Next { time, .. } = place
                && let Some(measured) = self.clock.time(time)
            {
                self.restarts.note_next(packet.millis(), measured + packet_time);
            }
            places[number] = place;
        }
        if let Some(counted) = counted.filter(|_| self.settings.model.is_none()) {
            self.count(counted);
            if !self.is_learned
                && let Phase::Streaming(watchdog) = &mut self.phase
            {
                watchdog.await_revolution(self.now);
            }
        }
        self.scanner_time = places[..span.packets].iter().rev().find_map(|place| place.time());
        let stamp = |number: usize| places[number].time().and_then(|time| self.clock_of(number).time(time));
        let first = stamp(0);
        let last_byte = span.offset + (span.packets * LEN - 1) as u64;
        let latest = self.reads.arrivals().latest(last_byte, pace);
        let last = stamp(span.packets - 1).map_or(latest, |at| at + packet_time);
        let at = first.unwrap_or(last.saturating_sub(packet_time * span.packets as u64));
        // A packet that arrived twice is stamped by its arrival, and the next one by the scanner's clock.
        let last = self.reads.date_packet(last.max(at));
        self.current = Some(Current { span, places, packet: 0, is_put: false });
        self.counters.note_packets(self.framer.buffer.tally(), span.packets);
        self.continue_stream();
        Received {
            bytes: self.framer.bytes(span),
            first: at,
            last,
            estimated: first.is_none(),
            reasons: span.reasons,
            count: span.packets,
            is_checked: true,
            is_reply: false,
            whole: None,
        }
    }

    /// Returns the clock that stamps packet number `number` of those returned last.
    fn clock_of(&self, number: usize) -> &SensorClock {
        match &self.clock_before {
            Some((first, clock)) if number < *first => clock,
            _ => &self.clock,
        }
    }

    /// Starts or extends the stream after packets have arrived.
    fn continue_stream(&mut self) {
        match &mut self.phase {
            Phase::Streaming(watchdog) => {
                watchdog.note_packets(self.now);
                self.counters.continue_stream(self.framer.buffer.tally());
                if self.measured.is_none()
                    && self.now >= self.undecided_since + UNDECIDED
                    && let Some(rate) = self.sequence.points_per_second()
                {
                    let model = Model::of_point_rate(rate);
                    self.measured = Some((model, model.beams()));
                }
            }
            Phase::Listening { .. } => {
                self.trouble = None;
                self.undecided_since = self.now;
                self.phase = Phase::Streaming(Watchdog::new(self.now));
                self.counters.begin_stream(self.framer.buffer.tally());
            }
            Phase::Paused => {}
        }
        if !self.is_learned
            && self.sequence.points_per_second().is_some()
            && let Some(beams) = self.known_beams()
        {
            (self.beams, self.is_learned) = (Some(beams), true);
            self.turns.begin(beams);
        }
    }

    /// Adds the points of the current packets to revolutions. Returns the first revolution that is complete.
    fn advance_turns(&mut self) -> Option<Closed> {
        while let Some(current) = &mut self.current {
            let (bytes, _) = self.framer.bytes(current.span).as_chunks::<LEN>();
            let packet = bytes.get(current.packet).map(Packet::checked);
            let Some(packet) = packet.filter(|_| self.is_learned) else {
                self.current = None;
                return None;
            };
            let place = current.places[current.packet];
            let reasons = if current.packet == 0 { current.span.reasons } else { 0 };
            let step = f64::from(packet.span()) / 100.0 / (POINTS - 1) as f64;
            let pace = Pace { step, point_ns: f64::from(self.sequence.point_ns()) };
            if !current.is_put {
                if let Place::Next { angle, missing, from, .. } = place
                    && missing > 0
                {
                    // No point was received between the two angles. They may be in a revolution that has not begun yet.
                    self.turns.lacks(from + pace.step, angle - pace.step);
                    // The head may be slower now than in the revolution that ends here.
                    if let Some(closed) = self.turns.reach(angle, self.pace.unwrap_or(pace)) {
                        return Some(closed);
                    }
                }
                self.pace = Some(pace);
                current.is_put = true;
                put(&mut self.turns, &packet, place, reasons, pace);
            }
            if let Place::First { angle, .. } | Place::Next { angle, .. } = place
                && let Some(closed) = self.turns.reach(angle + f64::from(packet.span()) / 100.0, pace)
            {
                return Some(closed);
            }
            if let Some(current) = &mut self.current {
                (current.packet, current.is_put) = (current.packet + 1, false);
            }
        }
        None
    }

    /// Returns a complete revolution, and updates the state of the session.
    fn show(&mut self, closed: Closed) -> RawScan<'_> {
        let first = self.dated(closed).first;
        self.reads.end_turn(first);
        self.trouble = None;
        if let Phase::Streaming(watchdog) = &mut self.phase {
            watchdog.note_revolution(self.now);
        }
        self.counters.await_revolution(self.framer.buffer.tally());
        self.dated(closed)
    }

    /// Converts a revolution to the hub's clock.
    fn dated(&self, closed: Closed) -> RawScan<'_> {
        let packet = self.current.map_or(usize::MAX, |current| current.packet);
        let stamp = |at: Nanos| self.clock_of(packet).time(at).unwrap_or(self.now);
        let stamps = self.reads.turn_dates(stamp(closed.first), stamp(closed.last));
        let resolution = (self.beams.unwrap_or_default(), self.points_per_second().unwrap_or_default());
        RawScan::revolution(Family::Ld, &closed, stamps, resolution, self.turns.points(&closed))
    }
}

impl line::Protocol for Session {
    fn spare(&mut self) -> &mut [u8] {
        let spare = self.framer.buffer.spare();
        self.reads.offer(spare.len());
        spare
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        self.reads.note(now, len, line::Session::state(self) == State::Streaming);
        if len > 0 {
            self.framer.buffer.commit(len);
        }
    }

    fn handle_timeout(&mut self, now: Nanos) {
        self.now = now;
        self.framer.buffer.release(now.saturating_sub(self.reads.last_byte()));
    }

    fn transmitted(&mut self, now: Nanos) {
        self.now = now;
    }

    fn poll_output(&mut self) -> Output<'_> {
        if let Some(closed) = self.advance_turns() {
            return Output::Event(Event::Scan(self.show(closed)));
        }
        while let Some(span) = self.framer.advance(most_together(self.baud)) {
            if !matches!(self.phase, Phase::Paused) {
                return Output::Event(Event::Telegram(self.receive(span)));
            }
        }
        self.expire();
        if core::mem::take(&mut self.change_baud) {
            self.framer.clear();
            return Output::SetRate(self.baud);
        }
        let until = match self.phase {
            Phase::Listening { next_at, .. } => next_at,
            Phase::Streaming(watchdog) => watchdog.silent_at(),
            Phase::Paused => Nanos::MAX,
        };
        self.reads.wait(self.now, until, self.framer.buffer.hold())
    }
}

impl line::Session for Session {
    type Trouble = Trouble;

    fn control(&mut self, control: Control, now: Nanos) {
        self.now = now;
        match (control, self.phase) {
            (Control::Pause, _) => {
                self.listen(State::Paused);
                self.phase = Phase::Paused;
            }
            (Control::Resume, Phase::Paused) => self.listen(State::Probing),
            (Control::Resume, _) => {}
            (Control::Resync, _) => {
                self.counters.note_resync();
                self.trouble = None;
                self.listen(State::Probing);
            }
        }
    }

    fn state(&self) -> State {
        match self.phase {
            Phase::Listening { shown, .. } => shown,
            Phase::Streaming(watchdog) => watchdog.state(),
            Phase::Paused => State::Paused,
        }
    }

    fn trouble(&self) -> Option<Trouble> {
        let change = self.change.filter(|&(_, until)| self.now < until).map(|(trouble, _)| trouble);
        self.trouble.or(change).filter(|_| !matches!(self.phase, Phase::Paused))
    }

    fn missing(&self) -> Option<&'static str> {
        matches!(self.trouble(), Some(Trouble::NoPackets { .. })).then_some("LDROBOT packets")
    }

    fn rate(&self) -> u32 {
        self.baud
    }

    fn account(&self) -> Account {
        let (tally, buffered) = (self.framer.buffer.tally(), self.framer.buffer.open().len());
        let account = self.counters.account(tally, buffered, self.sequence.came_and_lost());
        Account { restarts: self.restarts.count, ..account }
    }

    fn begin_at(&mut self, rate: u32, _: Nanos) {
        self.baud = rate;
    }

    fn restore_beams(&mut self, model: family::Model, beams: usize) {
        let model = Model::named(model.name);
        if let Some(model) = model.filter(|model| self.settings.fixed_rate || model.baud() == self.baud) {
            self.recall(model, beams);
        }
    }

    fn model(&self) -> Option<family::Model> {
        self.model().map(described)
    }

    fn beams(&self) -> Option<usize> {
        self.beams
    }

    fn partial_scan(&self) -> Option<RawScan<'_>> {
        self.turns.begun(self.pace?).map(|begun| self.dated(begun))
    }

    fn other_model(&self) -> Option<family::Model> {
        self.heard_other_model().map(described)
    }

    fn scanner_time(&self) -> Option<Nanos> {
        self.scanner_time
    }

    fn mark_suspect(&mut self, reasons: u8) {
        self.reads.doubt(reasons);
    }
}

/// Reason why a session does not stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trouble {
    /// No packets arrive.
    NoPackets {
        /// The only rate that the session tried. `None`: it tried both.
        baud: Option<u32>,
        /// Seconds without a packet, rounded down to 1, 2, 4, ..
        seconds: u32,
    },
    /// No packet arrived for one second.
    Silence,
    /// Packets arrive, but the head does not rotate.
    StandsStill,
    /// The scanner measures another number of points per revolution, so its scans have another number of beams.
    BeamsChanged {
        /// Number of beams before.
        from: usize,
        /// Number of beams now.
        to: usize,
    },
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Trouble::NoPackets { baud, seconds } => {
                f.write_str("no packets at ")?;
                match baud {
                    Some(baud) => write!(f, "{baud}")?,
                    None => f.write_str("230400 and 921600")?,
                }
                write!(f, " baud for {seconds} s: power, cable, other port?")
            }
            Trouble::Silence => f.write_str("no packet for one second"),
            Trouble::StandsStill => f.write_str("packets come, but the head does not turn: is it blocked?"),
            Trouble::BeamsChanged { from, to } => {
                write!(f, "scans have {to} beams instead of {from}, as many as the scanner measures points")
            }
        }
    }
}

/// Adds the points of `packet`, which is at `place` of the sequence, to `turns`.
fn put(turns: &mut Turns<MOST_POINTS>, packet: &Packet<'_>, place: Place, reasons: u8, pace: Pace) {
    let (last, angle) = match place {
        Place::Again => return,
        Place::Odd => return turns.doubt(),
        Place::First { time, angle } => {
            turns.give_up();
            (time, angle)
        }
        Place::Next { time, angle, .. } => (time, angle),
    };
    for i in 0..POINTS {
        let point = packet.point(i);
        let time = last as f64 - pace.point_ns * (POINTS - 1 - i) as f64;
        turns.put(angle + pace.step * i as f64, time, point.range, point.intensity, reasons, pace);
    }
}

/// Returns how many packets are returned together: as many as arrive in 10 ms.
const fn most_together(baud: u32) -> usize {
    if baud > 500_000 { MOST } else { 3 }
}

/// Maximum number of points in a revolution: more than an STL27L measures at five revolutions per second.
const MOST_POINTS: usize = 4_400;
/// How long the session listens at one rate. A stream has a packet every 3 ms.
const LISTEN: Nanos = 300 * MILLIS;
/// Time after which a scanner whose speed is never constant, or whose sequence has a gap in every revolution, has the
/// beams of its model.
const UNDECIDED: Nanos = 10_000 * MILLIS;
/// After this time with another number of points per revolution, the number of beams changes.
const CHANGE: Nanos = 10_000 * MILLIS;
/// Duration for which a change of the number of beams is reported.
const SHOW_CHANGE: Nanos = 60_000 * MILLIS;
/// Maximum number of packets that are returned together: those of an STL27L in 10 ms, one every 0.56 ms.
pub(crate) const MOST: usize = 17;
