//! A scanner behind a line, driven from outside as [`crate::line::Session`] says. It only listens: at the model's rate, or at
//! both in turn until packets come. Then it learns how many points there are in a second, hands out packets as they come,
//! and turns. Refuses to know a hub, and what becomes of a turn.

mod driven;

use crate::line::{
    Closed, Flow, Pace, Packets, Reads, Received, SensorClock, State, Tally, Turn, TurnCounts, Turns,
};
use schema::{MILLIS, Nanos, line_time};

use crate::ld::framer::{Framer, Span};
use crate::ld::heard::Trouble;
use crate::ld::model::Model;
use crate::ld::packet::{LEN, POINTS, Packet};
use crate::ld::restarts::Restarts;
use crate::ld::sequence::{Place, Sequence};

/// What a session shall do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Settings {
    /// What is at the other end; `None` is sought.
    pub model: Option<Model>,
    /// Beams of the grid that turns are for; `None`: the model's, at most [`most_beams`](Self::most_beams).
    pub beams: Option<usize>,
    /// The most beams that there is room for; `None`: as many as a grid can have.
    pub most_beams: Option<usize>,
    /// Whether the port has one rate and not the pace of a line: a serial server on the network, a recording.
    pub fixed_rate: bool,
}

impl Settings {
    /// The rate at which the port is to be opened, in bits per second.
    pub fn baud(&self) -> u32 {
        self.model.unwrap_or(Model::Ld19).baud()
    }
}

/// One scanner's session.
#[derive(Clone, Debug)]
pub struct Session {
    settings: Settings,
    framer: Framer,
    pub(crate) reads: Reads,
    clock: SensorClock,
    /// The clock of the packets before the one with this number, of those handed out last, if another sequence began there.
    clock_before: Option<(usize, SensorClock)>,
    sequence: Sequence,
    turns: Turns<MOST_POINTS>,
    /// Of the packet whose points were put last.
    pace: Option<Pace>,
    phase: Phase,
    baud: u32,
    change_baud: bool,
    /// The grid, once it is known, and whether it is known what this stream is.
    beams: Option<usize>,
    is_learned: bool,
    /// As [`crate::line::family::Turning::scanner_time`].
    pub(crate) scanner_time: Option<Nanos>,
    /// Packets that were handed out and are not in turns yet.
    current: Option<Current>,
    now: Nanos,
    trouble: Option<Trouble>,
    /// Time since which no packet has arrived.
    quiet_since: Nanos,
    /// Bytes of streams that were in nothing, and all of those when it was last looked.
    damaged: (u64, u64),
    resyncs: u64,
    restarts: Restarts,
    /// Bytes of streams that were in nothing, and bytes of packets, when the last revolution ended.
    turned_with: (u64, u64),
    cut: bool,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// No packets yet; at `next_at` another rate is tried.
    Listening { shown: State, next_at: Nanos },
    /// Packets come, by `silent_at` the next one; `turned_at` the last turn was over, or they began to come.
    Hearing { turned_at: Nanos, has_turned: bool, silent_at: Nanos },
    /// Nobody wants anything.
    Paused,
}

/// Packets on their way into turns.
#[derive(Clone, Copy, Debug)]
struct Current {
    span: Span,
    places: [Place; MOST],
    /// The first one that is not done, and whether its points are.
    packet: usize,
    is_put: bool,
}

impl Session {
    /// A session on a port that is open at the rate of `settings`.
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
            phase: Phase::Listening { shown: State::Probing, next_at: now + LISTEN },
            baud: settings.baud(),
            change_baud: false,
            beams: None,
            is_learned: false,
            scanner_time: None,
            current: None,
            now,
            trouble: None,
            quiet_since: now,
            damaged: (0, 0),
            resyncs: 0,
            restarts: Restarts::default(),
            turned_with: (0, 0),
            cut: false,
        }
    }

    /// What is at the other end, as far as that is known: of models that cannot be told apart, one.
    pub fn model(&self) -> Option<Model> {
        self.settings.model.or_else(|| self.heard_model())
    }

    /// What it turned out to be where another model is wanted: many of them speak alike.
    pub(crate) fn other_model(&self) -> Option<Model> {
        let wanted = self.settings.model?;
        self.heard_model().filter(|heard| heard.points_per_second() != wanted.points_per_second())
    }

    fn heard_model(&self) -> Option<Model> {
        self.sequence.points_per_second().map(Model::of_point_rate)
    }

    /// Beams of the grid that turns are for; nothing before it is known what is at the other end.
    pub fn beams(&self) -> Option<usize> {
        self.beams
    }

    /// Points that the scanner measures in a second; nothing before enough packets came.
    pub fn points_per_second(&self) -> Option<f32> {
        self.sequence.points_per_second()
    }

    /// What became of the bytes.
    pub fn tally(&self) -> &Tally {
        self.framer.tally()
    }

    /// How many turns there were of which kind.
    pub fn turn_counts(&self) -> TurnCounts {
        self.turns.counts()
    }

    /// The rates at which packets may come.
    fn rates(&self) -> &'static [u32] {
        const BOTH: [u32; 2] = [230_400, 921_600];
        let at = usize::from(self.baud == BOTH[1]);
        if self.settings.model.is_some() || self.settings.fixed_rate { &BOTH[at..=at] } else { &BOTH }
    }

    fn listen(&mut self, shown: State) {
        self.phase = Phase::Listening { shown, next_at: self.now + LISTEN };
        self.quiet_since = self.now;
        self.sequence.end();
        self.turns.give_up();
        self.is_learned = false;
        self.current = None;
        self.reads.end_rest();
    }

    /// Nothing was heard at this rate: tries the next one, and says for how long already.
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

    /// Does what is due now that all bytes were looked at: bytes that are no packets keep nobody waiting.
    fn expire(&mut self) {
        match self.phase {
            Phase::Listening { shown, next_at } if self.now >= next_at => self.listen_on(shown),
            Phase::Hearing { silent_at, .. } if self.now >= silent_at => {
                self.resyncs += 1;
                self.trouble = Some(Trouble::Silence);
                self.listen(State::Silent);
            }
            Phase::Hearing { turned_at, .. } if self.now >= turned_at + STILL => {
                // A revolution may also be missing because most bytes are damaged.
                let (damaged, in_packets) = self.turned_with;
                let is_damaged = self.damaged.0 - damaged > self.framer.tally().in_packets - in_packets;
                self.trouble = (!is_damaged).then_some(Trouble::StandsStill);
            }
            _ => {}
        }
    }

    /// Starts to wait for the end of the next revolution.
    fn await_turn(&mut self) {
        self.turned_with = (self.damaged.0, self.framer.tally().in_packets);
    }

    /// Packets came: dates them, and remembers them for turns.
    fn receive(&mut self, span: Span) -> Received<'_, Packets> {
        let mut span = span;
        span.reasons |= self.reads.take_doubt(span.offset + (span.packets * LEN) as u64);
        let pace = (!self.settings.fixed_rate).then_some(self.baud);
        let packet_time = line_time(LEN, self.baud);
        let mut places = [Place::Odd; MOST];
        self.clock_before = None;
        let flow = Flow { byte_ns: self.sequence.packet_ns() / LEN as f64, packet_len: LEN, pace };
        let (bytes, _) = self.framer.bytes(span).as_chunks::<LEN>();
        for (number, bytes) in bytes.iter().enumerate() {
            let Ok(packet) = Packet::check(bytes) else { continue };
            let place = self.sequence.place(&packet);
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
        self.scanner_time = places[..span.packets].iter().rev().find_map(|place| place.time());
        let stamp = |number: usize| places[number].time().and_then(|time| self.clock_of(number).time(time));
        let first = stamp(0);
        let last_byte = span.offset + (span.packets * LEN - 1) as u64;
        let latest = self.reads.arrivals().latest(last_byte, pace);
        let last = stamp(span.packets - 1).map_or(latest, |at| at + packet_time);
        let at = first.unwrap_or(last.saturating_sub(packet_time * span.packets as u64));
        // One that came twice is dated by its arrival, and the next one by the scanner's clock.
        let last = self.reads.date_packet(last.max(at));
        self.current = Some(Current { span, places, packet: 0, is_put: false });
        self.cut |= self.framer.tally().packets == span.packets as u64 && self.framer.tally().discarded > 0;
        self.hear();
        Received {
            bytes: self.framer.bytes(span),
            message: Packets { count: span.packets, is_checked: true, is_reply: false },
            first: at,
            last,
            estimated: first.is_none(),
            reasons: span.reasons,
        }
    }

    /// The clock by which packet `number` of those handed out last is dated.
    fn clock_of(&self, number: usize) -> &SensorClock {
        match &self.clock_before {
            Some((first, clock)) if number < *first => clock,
            _ => &self.clock,
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
            Phase::Listening { .. } => {
                self.trouble = None;
                self.phase = Phase::Hearing { turned_at: self.now, has_turned: false, silent_at };
                self.await_turn();
            }
            Phase::Paused => {}
        }
        self.damaged.1 = discarded;
        if !self.is_learned
            && let Some(model) = self.model().filter(|_| self.sequence.points_per_second().is_some())
        {
            let most = self.settings.most_beams.unwrap_or(usize::MAX);
            let beams = self.settings.beams.unwrap_or(model.beams()).min(most);
            (self.beams, self.is_learned) = (Some(beams), true);
            self.turns.begin(beams);
        }
    }

    /// Puts what was handed out into turns; one that is over.
    fn advance_turns(&mut self) -> Option<Closed> {
        while let Some(current) = &mut self.current {
            let (bytes, _) = self.framer.bytes(current.span).as_chunks::<LEN>();
            let packet = bytes.get(current.packet).and_then(|bytes| Packet::check(bytes).ok());
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
                    // Up to the points beside it nothing is; they may be in a turn that is not open yet.
                    self.turns.lacks(from + pace.step, angle - pace.step);
                    // The head may be slower now than it was in a turn that ends here.
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

    fn show(&mut self, closed: Closed) -> Turn<'_> {
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
    pub(crate) fn begun_turn(&self) -> Option<Turn<'_>> {
        self.turns.begun(self.pace?).map(|begun| self.dated(begun))
    }

    /// A turn that is over, or that is being measured, by the hub's clock.
    fn dated(&self, closed: Closed) -> Turn<'_> {
        let packet = self.current.map_or(usize::MAX, |current| current.packet);
        let stamp = |at: Nanos| self.clock_of(packet).time(at).unwrap_or(self.now);
        let (first, last) = self.reads.turn_dates(stamp(closed.first), stamp(closed.last));
        Turn {
            number: closed.number,
            points: self.turns.points(&closed),
            first,
            last,
            period: closed.period,
            beams: self.beams.unwrap_or_default(),
            points_per_second: self.sequence.points_per_second().unwrap_or_default(),
            incomplete: closed.incomplete,
            reasons: closed.reasons,
        }
    }
}

/// Puts the points of `packet`, which is at `place`, into turns.
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

/// Points of an STL27L that turns five times a second, and some; what is more does not fit into a turn.
const MOST_POINTS: usize = 4_400;
/// How long is listened at one rate before the next: a stream has a packet each 3 ms.
const LISTEN: Nanos = 300 * MILLIS;
/// Without a packet for so long the session begins again.
const SILENCE: Nanos = 1_000 * MILLIS;
/// The slowest head turns twice a second.
const STILL: Nanos = 2_000 * MILLIS;
/// Packets of one sample at the most: of an STL27L, which sends one each 0.56 ms.
const MOST: usize = 17;
