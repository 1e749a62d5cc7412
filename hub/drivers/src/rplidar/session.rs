//! A scanner behind a line, driven from outside as [`crate::line::Session`] says: it is asked what it is and told to measure, then
//! packets are handed out as they come, and turns. Refuses to know a hub, and what becomes of a turn.
//!
//! A stream that somebody left is stopped, never taken over: express and dense packets look alike, and a scanner that
//! measures answers no question.

mod dialogue;
mod driven;
mod outgoing;
mod reply;
mod stream;

use crate::line::{Reads, SensorClock, State, Tally, TurnCounts, Turns};
use schema::{MILLIS, Nanos};

use crate::rplidar::framer::{Expect, Framer};
use crate::rplidar::model::{Mode, Model};
use crate::rplidar::offers::Offers;
use crate::rplidar::packet::Kind;
use crate::rplidar::sequence::{Place, Sequence, Step};
use crate::rplidar::told::{Health, Info, Trouble};

use self::dialogue::Ask;
use self::outgoing::Outgoing;
use self::stream::{Current, Held, MOST, Measure};

/// What a session shall do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Settings {
    /// What is at the other end; `None` is asked, at the rates of all models.
    pub model: Option<Model>,
    /// How it shall measure; `None`: as fast as the line carries.
    pub mode: Option<Mode>,
    /// Beams of the grid that turns are for; `None`: the model's, at most [`most_beams`](Self::most_beams).
    pub beams: Option<usize>,
    /// The most beams that there is room for; `None`: as many as a grid can have.
    pub most_beams: Option<usize>,
    /// Whether the port has one rate and not the pace of a line: a serial server on the network, a recording.
    pub fixed_rate: bool,
    /// Whether nobody is at the other end who could be asked: a recording.
    pub listen_only: bool,
    /// Whether the motor rests while nobody follows.
    pub stop_when_idle: bool,
}

impl Settings {
    /// The rate at which the port is to be opened, in bits per second.
    pub fn baud(&self) -> u32 {
        self.model.unwrap_or(Model::A1).baud()
    }
}

/// One scanner's session.
#[derive(Clone, Debug)]
pub struct Session {
    settings: Settings,
    framer: Framer,
    pub(crate) reads: Reads,
    clock: SensorClock,
    sequence: Sequence,
    turns: Turns<MOST_POINTS>,
    phase: Phase,
    /// What to show until measured data come.
    shown: State,
    baud: u32,
    change_baud: bool,
    /// What the line DTR shall be from now on.
    change_dtr: Option<bool>,
    outgoing: Outgoing,
    info: Option<Info>,
    health: Option<Health>,
    offers: Offers,
    /// Whether a scanner that is not well was booted already.
    was_reset: bool,
    /// Whether the motor obeys requests for a duty cycle.
    has_board: bool,
    /// The mode in use, if it is known here, and the wanted one if it is another.
    mode: Option<Mode>,
    no_mode: Option<Mode>,
    /// Nanoseconds from one point to the next, once they are known, or what they are measured by.
    point_ns: Option<f64>,
    measure: Option<Measure>,
    /// The last mode of which somebody else was told, and by which key.
    overheard: (u8, u8),
    /// The grid, once it is known, and whether it is known what this stream is.
    beams: Option<usize>,
    is_learned: bool,
    /// Packets that were handed out and are not in turns yet, and the places of those of the last span.
    current: Option<Current>,
    places: [Place; MOST],
    held: Option<Held>,
    /// Since when nobody follows.
    idle_since: Option<Nanos>,
    now: Nanos,
    /// As [`crate::line::family::Turning::scanner_time`].
    pub(crate) scanner_time: Option<Nanos>,
    trouble: Option<Trouble>,
    /// Time since which no response has arrived, and the number of bytes read by then.
    quiet_since: Option<(Nanos, u64)>,
    /// Bytes of streams that were in nothing, and all of those when it was last looked.
    damaged: (u64, u64),
    resyncs: u64,
    /// Restarts of the scanner that were not requested.
    restarts: u64,
    /// Rate of the last stream, until a greeting is received.
    streamed_at: Option<u32>,
    /// Bytes of streams that were in nothing, and bytes of packets, when the last revolution ended.
    turned_with: (u64, u64),
    cut: bool,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// Nobody can be asked, and no packets come yet.
    Listening { since: Nanos },
    /// It was told to stop. After so many attempts at this rate, and no later than `at_most`, it is asked.
    Draining { attempts: u8, until: Nanos, at_most: Nanos },
    /// An answer should come by `until`.
    Asking { ask: Ask, attempts: u8, until: Nanos },
    /// It was told to boot.
    Booting { until: Nanos },
    /// It is not well, and asked again later.
    Unwell { until: Nanos },
    /// It measures; by `silent_at` the next packet comes. `turned_at` the last turn was over, or it began.
    Hearing { turned_at: Nanos, has_turned: bool, silent_at: Nanos },
    /// Nobody wants anything, or nobody follows.
    Paused { is_resting: bool },
}

impl Session {
    /// A session on a port that is open at the rate of `settings`.
    pub fn new(settings: Settings, now: Nanos) -> Self {
        let mut session = Session {
            settings,
            framer: Framer::new(Expect::Nothing),
            reads: Reads::new(now),
            clock: SensorClock::new(),
            sequence: Sequence::new(),
            turns: Turns::new(),
            phase: Phase::Listening { since: now },
            shown: State::Probing,
            baud: settings.baud(),
            change_baud: false,
            change_dtr: None,
            outgoing: Outgoing::default(),
            info: None,
            health: None,
            offers: Offers::default(),
            was_reset: false,
            has_board: false,
            mode: settings.mode.filter(|_| settings.listen_only),
            no_mode: None,
            point_ns: None,
            measure: None,
            overheard: (0, 0),
            beams: None,
            is_learned: false,
            current: None,
            places: [Place { step: Step::Odd, angle: 0.0, time: 0.0 }; MOST],
            held: None,
            idle_since: None,
            now,
            scanner_time: None,
            trouble: None,
            quiet_since: None,
            damaged: (0, 0),
            resyncs: 0,
            restarts: 0,
            streamed_at: None,
            turned_with: (0, 0),
            cut: false,
        };
        session.begin(State::Probing);
        session
    }

    /// What is at the other end, as far as that is known.
    pub fn model(&self) -> Option<Model> {
        self.info.and_then(|info| info.model()).or(self.settings.model)
    }

    /// How it measures, as far as that has a name here; nothing before it does.
    pub(crate) fn mode(&self) -> Option<Mode> {
        self.mode
    }

    /// Whether another model than this one is wanted.
    pub(crate) fn is_wrong(&self, model: Model) -> bool {
        self.settings.model.is_some_and(|wanted| wanted != model)
    }

    /// What packets are that look like express and like dense ones, where no answer says it: the model's fastest ones.
    fn alike(&self) -> Option<Kind> {
        match (self.settings.mode, self.model()) {
            (Some(Mode::DenseBoost), _) => Some(Kind::Dense),
            (Some(_), _) => Some(Kind::Express),
            (None, Some(Model::A1 | Model::A2m8 | Model::A2m12 | Model::A3)) => Some(Kind::Express),
            (None, model) => model.map(|_| Kind::Dense),
        }
    }

    /// What it says that it is; nothing before it was asked.
    pub fn info(&self) -> Option<Info> {
        self.info
    }

    /// How it says that it is; nothing before it was asked.
    pub fn health(&self) -> Option<Health> {
        self.health
    }

    /// Whether it was asked what it is and how it is, and has answered, or was asked in vain.
    pub(crate) fn is_introduced(&self) -> bool {
        let is_asked = matches!(self.phase, Phase::Asking { ask: Ask::Info | Ask::Health, .. });
        self.info.is_some() && !is_asked && !matches!(self.phase, Phase::Draining { .. })
    }

    /// Beams of the grid that turns are for; nothing before it is known what is at the other end.
    pub fn beams(&self) -> Option<usize> {
        self.beams
    }

    /// Points that the scanner measures in a second; nothing before it is known.
    pub fn points_per_second(&self) -> Option<f32> {
        self.point_ns.map(|ns| (1e9 / ns) as f32)
    }

    /// What became of the bytes.
    pub fn tally(&self) -> &Tally {
        self.framer.tally()
    }

    /// How many turns there were of which kind.
    pub fn turn_counts(&self) -> TurnCounts {
        self.turns.counts()
    }

    /// Does what is due now that all bytes were looked at: bytes that are nothing keep nobody waiting.
    fn expire(&mut self) {
        let now = self.now;
        let is_idle =
            self.settings.stop_when_idle && self.idle_since.is_some_and(|since| now >= since + IDLE);
        if is_idle && !self.settings.listen_only && !matches!(self.phase, Phase::Paused { .. }) {
            return self.rest(true);
        }
        match self.phase {
            Phase::Listening { .. } if self.framer.is_alike() => self.trouble = Some(Trouble::Alike),
            Phase::Listening { since } => self.complain(since),
            Phase::Draining { until, at_most, .. }
                if until > at_most && now >= at_most && self.seeks_quickly() =>
            {
                self.seek_on();
            }
            Phase::Draining { attempts, until, at_most } if now >= until.min(at_most) => {
                self.ask(Ask::Info, attempts);
            }
            Phase::Asking { ask, attempts, until } if now >= until => self.unanswered(ask, attempts),
            Phase::Booting { until } | Phase::Unwell { until } if now >= until => self.begin(self.shown),
            Phase::Hearing { silent_at, .. } if now >= silent_at => {
                self.resyncs += 1;
                self.trouble = Some(Trouble::Silence);
                self.begin(State::Silent);
            }
            Phase::Hearing { turned_at, .. } if now >= turned_at + STILL => {
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

    /// Whether it was sought for a short time only: then what goes on to stream is not asked, for at its rate it would have
    /// stopped. On a line that is never quiet it is asked all the same later.
    fn seeks_quickly(&self) -> bool {
        let is_young = self.quiet_since.is_none_or(|(since, _)| self.now < since + ROUNDS);
        is_young && self.next_rate().is_some()
    }

    /// Returns when the session has to act without a byte.
    fn deadline(&self) -> Nanos {
        match self.phase {
            Phase::Listening { since } => {
                let seconds = self.now.saturating_sub(since) / SILENCE;
                since + (seconds + 1) * SILENCE
            }
            Phase::Paused { .. } => Nanos::MAX,
            Phase::Draining { until, at_most, .. } => until.min(at_most),
            Phase::Asking { until, .. } => until,
            Phase::Booting { until } => until,
            Phase::Unwell { until } => until,
            Phase::Hearing { silent_at, .. } => silent_at,
        }
    }
}

/// Points of an S2 that turns four times a second; what is more does not fit into a turn.
const MOST_POINTS: usize = 8_192;
/// Without a packet for so long the session begins again.
const SILENCE: Nanos = 1_000 * MILLIS;
/// The slowest head turns once in this.
const STILL: Nanos = 2_000 * MILLIS;
/// Nobody follows for so long before the motor rests: a program that is started again follows again.
const IDLE: Nanos = 5_000 * MILLIS;
/// All rates are tried twice in so long, where a stream goes on at each of them: one may not have heard that it shall stop.
const ROUNDS: Nanos = 8 * dialogue::DRAIN;
