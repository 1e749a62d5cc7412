//! The session with an RPLIDAR: it requests the identity of the scanner, starts a scan mode, and returns packets as they arrive,
//! and revolutions.
//!
//! A stream that another program left running is stopped, never continued: express and dense packets look alike, and a
//! scanner that measures answers no request.

mod dialogue;
mod stream;

use core::fmt;

use schema::{Contents, Family, MILLIS, Nanos, ScanHead};

use crate::line::family::{self, Features};
use crate::line::{
    self, Account, Condition, Control, Event, Introduction, Output, RawScan, Reads, Received, SensorClock,
    State, Tally, TurnCounts, Turns,
};

use crate::rplidar::device_info::{Health, Info};
use crate::rplidar::framer::{Expect, Found, Framer, Span};
use crate::rplidar::model::{Mode, Model};
use crate::rplidar::offers::Offers;
use crate::rplidar::packet::Kind;
use crate::rplidar::request::{Head, RequestQueue};
use crate::rplidar::sequence::{Place, Sequence, Step};

use self::dialogue::{Ask, Reply};
use self::stream::{Current, Held, MOST, Measure};

/// Settings of a session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Settings {
    /// The model. `None`: the session requests it, at the rates of all models.
    pub model: Option<Model>,
    /// The scan mode. `None`: the fastest one that the line can carry.
    pub mode: Option<Mode>,
    /// Number of beams of the grid. `None`: the model's number, at most [`max_beams`](Self::max_beams).
    pub beams: Option<usize>,
    /// Maximum number of beams. `None`: the maximum of a grid.
    pub max_beams: Option<usize>,
    /// Whether the port has one fixed rate and bytes do not arrive at the pace of a line, as with a serial server on the
    /// network or a recording.
    pub fixed_rate: bool,
    /// Whether nothing can be sent, because the bytes are from a recording.
    pub listen_only: bool,
    /// Whether the motor stops while there are no subscribers.
    pub stop_when_idle: bool,
}

impl Settings {
    /// Returns the rate at which the port is opened, in bits per second.
    pub fn baud(&self) -> u32 {
        self.model.unwrap_or(Model::A1).baud()
    }
}

/// The session with one scanner.
#[derive(Clone, Debug)]
pub struct Session {
    settings: Settings,
    framer: Framer,
    reads: Reads,
    clock: SensorClock,
    sequence: Sequence,
    turns: Turns<MOST_POINTS>,
    phase: Phase,
    /// The state that is shown until measured data arrive.
    shown: State,
    baud: u32,
    change_baud: bool,
    /// Level that the DTR line has to get.
    change_dtr: Option<bool>,
    outgoing: RequestQueue,
    info: Option<Info>,
    health: Option<Health>,
    offers: Offers,
    /// Whether a scanner that reported an error was already restarted.
    was_reset: bool,
    /// Whether an accessory board controls the motor, by its duty cycle.
    has_board: bool,
    /// The mode in use, if scanhub knows it.
    mode: Option<Mode>,
    /// The mode of the settings, if the scanner cannot use it.
    no_mode: Option<Mode>,
    /// Nanoseconds per point, once they are known.
    point_ns: Option<f64>,
    /// Measurement of the time per point.
    measure: Option<Measure>,
    /// In a recording: the last mode in a request of the recorded program, and the key of that request.
    overheard: (u8, u8),
    /// Number of beams, once it is known.
    beams: Option<usize>,
    /// Whether the packets of this stream are identified.
    is_learned: bool,
    /// Packets that were returned and whose points are not in revolutions yet.
    current: Option<Current>,
    /// Positions of the packets of the last span.
    places: [Place; MOST],
    held: Option<Held>,
    /// Time since which there are no subscribers.
    idle_since: Option<Nanos>,
    now: Nanos,
    scanner_time: Option<Nanos>,
    trouble: Option<Trouble>,
    /// Time since which no response has arrived, and the number of bytes read by then.
    quiet_since: Option<(Nanos, u64)>,
    /// Discarded bytes of streams, and all discarded bytes when the first number was updated.
    damaged: (u64, u64),
    resyncs: u64,
    /// Restarts of the scanner that were not requested.
    restarts: u64,
    /// Rate of the last stream, until a greeting is received.
    streamed_at: Option<u32>,
    /// Discarded bytes of streams, and bytes of packets, when the last revolution ended.
    turned_with: (u64, u64),
    cut: bool,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// A recording. No packets have been read yet.
    Listening { since: Nanos },
    /// The stop request was sent. The session sends the first request at `until`, or at `at_most` if bytes still arrive.
    Draining { attempts: u8, until: Nanos, at_most: Nanos },
    /// A response is expected by `until`.
    Asking { ask: Ask, attempts: u8, until: Nanos },
    /// The restart request was sent.
    Booting { until: Nanos },
    /// The scanner reports an error. The session requests the health again at `until`.
    Unwell { until: Nanos },
    /// Packets arrive, the next one by `silent_at`. The last revolution ended at `turned_at`, or the stream began then.
    Hearing { turned_at: Nanos, has_turned: bool, silent_at: Nanos },
    /// A user paused the session, or, if `is_resting`, there are no subscribers.
    Paused { is_resting: bool },
}

impl Session {
    /// Creates a session on a port that is open at the rate of `settings`.
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
            outgoing: RequestQueue::default(),
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

    /// Returns the model, once it is known.
    pub fn model(&self) -> Option<Model> {
        self.info.and_then(|info| info.model()).or(self.settings.model)
    }

    /// Returns the scan mode, once the scanner measures, if scanhub knows it.
    fn mode(&self) -> Option<Mode> {
        self.mode
    }

    /// Returns whether `model` is not the one of the settings.
    fn is_unexpected(&self, model: Model) -> bool {
        self.settings.model.is_some_and(|wanted| wanted != model)
    }

    /// Returns the kind of packets that look like both express and dense ones if no response has named it: the fastest kind of
    /// the model.
    fn alike(&self) -> Option<Kind> {
        match (self.settings.mode, self.model()) {
            (Some(Mode::DenseBoost), _) => Some(Kind::Dense),
            (Some(_), _) => Some(Kind::Express),
            (None, Some(Model::A1 | Model::A2m8 | Model::A2m12 | Model::A3)) => Some(Kind::Express),
            (None, model) => model.map(|_| Kind::Dense),
        }
    }

    /// Returns the identity that the scanner reported.
    pub fn info(&self) -> Option<Info> {
        self.info
    }

    /// Returns the health that the scanner reported.
    pub fn health(&self) -> Option<Health> {
        self.health
    }

    /// Returns whether the scanner has reported its identity, and its health unless it does not respond to that request.
    fn is_introduced(&self) -> bool {
        let is_asked = matches!(self.phase, Phase::Asking { ask: Ask::Info | Ask::Health, .. });
        self.info.is_some() && !is_asked && !matches!(self.phase, Phase::Draining { .. })
    }

    /// Returns the number of beams of a scan, once the model is known.
    pub fn beams(&self) -> Option<usize> {
        self.beams
    }

    /// Returns the points that the scanner measures per second, once they are known.
    pub fn points_per_second(&self) -> Option<f32> {
        self.point_ns.map(|ns| (1e9 / ns) as f32)
    }

    /// Creates a session from the settings that all families share.
    pub(crate) fn configured(settings: &family::Settings, now: Nanos) -> Session {
        let &family::Settings {
            model, mode, beams, max_beams, fixed_rate, listen_only, stop_when_idle, ..
        } = settings;
        let (model, mode) = (model.and_then(Model::named), mode.and_then(Mode::named));
        let settings = Settings { model, mode, beams, max_beams, fixed_rate, listen_only, stop_when_idle };
        Session::new(settings, now)
    }

    /// Returns the counters of the framer.
    pub fn tally(&self) -> &Tally {
        self.framer.tally()
    }

    /// Returns the numbers of revolutions by kind.
    pub fn turn_counts(&self) -> TurnCounts {
        self.turns.counts()
    }

    /// Handles deadlines after all bytes were framed. Bytes that belong to nothing do not extend a deadline.
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

    /// Returns whether the search for the rate is young. During this time, a scanner that streams on after the stop request is
    /// not asked at this rate, because at the right rate it would have stopped. Later a request is sent, because the line may never
    /// be quiet.
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

    /// Returns the packets of a response for the caller.
    fn reply(&self, span: Span) -> Received<'_> {
        Received {
            bytes: self.framer.bytes(span),
            first: self.reads.last_byte(),
            last: self.reads.last_byte(),
            estimated: true,
            reasons: 0,
            count: span.packets,
            is_checked: false,
            is_reply: true,
            whole: None,
        }
    }
}

impl line::Protocol for Session {
    fn spare(&mut self) -> &mut [u8] {
        let spare = self.framer.spare();
        self.reads.offer(spare.len());
        spare
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        self.reads.note(now, len, line::Session::state(self) == State::Streaming);
        if len > 0 {
            self.framer.commit(len);
            if let Phase::Draining { until, .. } = &mut self.phase {
                *until = now + dialogue::QUIET;
            }
        }
    }

    fn handle_timeout(&mut self, now: Nanos) {
        self.now = now;
        self.framer.release(now.saturating_sub(self.reads.last_byte()));
    }

    fn transmitted(&mut self, now: Nanos) {
        self.now = now;
        if self.outgoing.advance() {
            self.sent();
        }
    }

    fn poll_output(&mut self) -> Output<'_> {
        loop {
            if let Some(on) = self.change_dtr.take() {
                return Output::SetDtr(on);
            }
            if core::mem::take(&mut self.change_baud) {
                self.framer.clear();
                return Output::SetRate(self.baud);
            }
            if !self.outgoing.next().is_empty() {
                return Output::Transmit { bytes: self.outgoing.next(), not_before: 0 };
            }
            if let Some(closed) = self.advance_turns() {
                return Output::Event(Event::Scan(self.show(closed)));
            }
            let most = self.framer.kind().map_or(1, |kind| self.most_together(kind));
            let Some(found) = self.framer.advance(most) else { break };
            match found {
                Found::Reply(answer, span) => {
                    let data = Reply::new(&self.framer.bytes(span)[Head::LEN..]);
                    self.answered(answer, data);
                    return Output::Event(Event::Telegram(self.reply(span)));
                }
                Found::Stream(span) => {
                    self.stream_begins();
                    return Output::Event(Event::Telegram(self.reply(span)));
                }
                Found::Packets(kind, span) => {
                    return Output::Event(Event::Telegram(self.receive(kind, span)));
                }
                Found::Greeting { is_named } => self.booted(is_named),
            }
        }
        self.expire();
        if self.change_dtr.is_some() || self.change_baud || !self.outgoing.next().is_empty() {
            return self.poll_output();
        }
        self.reads.wait(self.now, self.deadline(), self.framer.hold())
    }
}

impl line::Session for Session {
    type Trouble = Trouble;

    fn control(&mut self, control: Control, now: Nanos) {
        self.now = now;
        match (control, self.phase) {
            (Control::Pause, _) => self.rest(false),
            (Control::Resume, Phase::Paused { is_resting: false }) => self.begin(State::Probing),
            (Control::Resume, _) => {}
            (Control::Resync, _) => {
                self.resyncs += 1;
                self.trouble = None;
                self.begin(State::Probing);
            }
        }
    }

    fn set_has_subscribers(&mut self, now: Nanos, has_subscribers: bool) {
        self.now = now;
        if !has_subscribers {
            self.idle_since.get_or_insert(now);
            return;
        }
        self.idle_since = None;
        if let Phase::Paused { is_resting: true } = self.phase {
            self.begin(State::Starting);
        }
    }

    fn end(&mut self, now: Nanos) -> bool {
        self.now = now;
        let is_at_work = !self.settings.listen_only && !matches!(self.phase, Phase::Paused { .. });
        if is_at_work {
            self.rest(false);
        }
        is_at_work
    }

    fn state(&self) -> State {
        match self.phase {
            Phase::Hearing { has_turned: false, .. } => State::Starting,
            Phase::Hearing { .. } => State::Streaming,
            Phase::Paused { .. } => State::Paused,
            _ => self.shown,
        }
    }

    fn trouble(&self) -> Option<Trouble> {
        let is_paused = matches!(self.phase, Phase::Paused { .. });
        let warning = self.health.filter(|health| matches!(health, Health::Warning(_))).map(Trouble::Unwell);
        self.trouble.or(self.no_mode.map(Trouble::NoMode)).or(warning).filter(|_| !is_paused)
    }

    fn missing(&self) -> Option<&'static str> {
        matches!(self.trouble(), Some(Trouble::NoAnswer { .. })).then_some("RPLIDAR replies")
    }

    fn rate(&self) -> u32 {
        self.baud
    }

    fn account(&self) -> Account {
        let tally = self.framer.tally();
        let (came, lost) = self.sequence.came_and_lost();
        Account {
            read: tally.read,
            in_telegrams: tally.in_packets,
            acknowledge: 0,
            discarded: tally.discarded,
            buffered: self.framer.buffered() as u64,
            telegrams: tally.packets,
            due: came + lost,
            lost,
            damaged: self.damaged.0,
            resyncs: self.resyncs,
            restarts: self.restarts,
            began_with_a_cut: self.cut,
            rejected_checksum: tally.rejected_checksum,
        }
    }

    fn model(&self) -> Option<family::Model> {
        self.model().map(described)
    }

    fn beams(&self) -> Option<usize> {
        self.beams()
    }

    fn partial_scan(&self) -> Option<RawScan<'_>> {
        self.begun_turn()
    }

    fn other_model(&self) -> Option<family::Model> {
        self.info().and_then(|info| info.model()).filter(|model| self.is_unexpected(*model)).map(described)
    }

    fn missing_setting(&self) -> Option<&'static str> {
        (line::Session::trouble(self) == Some(Trouble::Alike)).then_some("model or mode")
    }

    fn write_details(&self, text: &mut dyn fmt::Write) {
        let _ = self.mode().map_or(Ok(()), |mode| write!(text, " {}", mode.name()));
        if let Some(Info { firmware: (major, minor), .. }) = self.info() {
            let _ = write!(text, " {major}.{minor:02}");
        }
    }

    fn scanner_time(&self) -> Option<Nanos> {
        self.scanner_time
    }

    fn mark_suspect(&mut self, reasons: u8) {
        self.reads.doubt(reasons);
    }

    fn begin_at(&mut self, rate: u32, _: Nanos) {
        self.baud = rate;
    }

    fn introduction(&self) -> Option<Introduction> {
        let info = self.info().filter(|_| self.is_introduced())?;
        let (major, minor) = info.firmware;
        let serial: String = info.serial.iter().map(|byte| format!("{byte:02X}")).collect();
        let identity = format!("firmware {major}.{minor:02}, hardware {}, number {serial}", info.hardware);
        Some(Introduction {
            identity,
            health: self.health().map_or_else(String::new, |health| health.to_string()),
            condition: match self.health() {
                None => Condition::Unknown,
                Some(Health::Good) => Condition::Good,
                Some(Health::Warning(_)) => Condition::Warning,
                Some(Health::Error(_)) => Condition::Error,
            },
        })
    }
}

/// Models and settings of the family.
pub const FEATURES: Features = Features {
    models: &MODELS,
    // Enough for all models but the S2 and the S3.
    auto: family::Model { name: "auto", baud: Model::A1.baud(), beams: 2_048 },
    modes: &MODES,
    can_rest: true,
    speaks_unasked: false,
    has_whole_telegrams: false,
    contents: Contents::TURNING,
    max_telegram: stream::LONGEST,
};

/// Returns the head of a scan on a grid of as many beams as there is space for.
pub(crate) fn scan_heads(settings: &family::Settings) -> Vec<ScanHead> {
    let beams = settings.beams.or(settings.max_beams).unwrap_or(FEATURES.auto.beams);
    vec![ScanHead::turning(Family::Rplidar, beams)]
}

/// Reason why a session does not stream as it should.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trouble {
    /// No response, or no packets in a recording.
    NoAnswer {
        /// The only rate that the session tried. `None`: it tried all.
        baud: Option<u32>,
        /// Seconds without a response, rounded down to 1, 2, 4, ..
        seconds: u32,
    },
    /// No measured data arrived for one second.
    Silence,
    /// Packets arrive, but the head does not rotate.
    StandsStill,
    /// The scanner reports a warning or an error.
    Unwell(Health),
    /// The scanner responds, but does not begin to measure.
    Refused,
    /// A recording contains packets that may be of two kinds, and nothing shows which kind they are.
    Alike,
    /// The scanner does not have this mode, or the line is too slow for it. The scanner uses another mode.
    NoMode(Mode),
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Trouble::NoAnswer { baud, seconds } => {
                f.write_str("no answer at ")?;
                match baud {
                    Some(baud) => write!(f, "{baud}")?,
                    None => f.write_str("115200, 256000, 460800 and 1000000")?,
                }
                write!(f, " baud for {seconds} s: power, cable, other port?")
            }
            Trouble::Silence => f.write_str("no measured data for one second"),
            Trouble::StandsStill => f.write_str("packets come, but the head does not turn: is it blocked?"),
            Trouble::Unwell(health) => write!(f, "the scanner reports: {health}"),
            Trouble::Refused => f.write_str("the scanner answers, but does not begin to measure"),
            Trouble::Alike => f.write_str(
                "the packets may be of two kinds (82h or 85h), which nothing here tells: name the model or the mode",
            ),
            Trouble::NoMode(mode) => {
                write!(
                    f,
                    "the scanner or its line cannot do mode {}: it measures in its fastest one",
                    mode.name()
                )
            }
        }
    }
}

/// Describes a model for the configuration.
const fn described(model: Model) -> family::Model {
    family::Model { name: model.name(), baud: model.baud(), beams: model.beams() }
}

/// All models, described for the configuration.
const MODELS: [family::Model; Model::ALL.len()] = {
    let mut all = [described(Model::A1); Model::ALL.len()];
    let mut at = 0;
    while at < all.len() {
        all[at] = described(Model::ALL[at]);
        at += 1;
    }
    all
};

/// Names of all modes.
const MODES: [&str; Mode::ALL.len()] = {
    let mut all = [""; Mode::ALL.len()];
    let mut at = 0;
    while at < all.len() {
        all[at] = Mode::ALL[at].name();
        at += 1;
    }
    all
};

/// Maximum number of points in a revolution: those of an S2 at four revolutions per second.
const MOST_POINTS: usize = 8_192;
/// After this time without a packet, the session begins again.
const SILENCE: Nanos = 1_000 * MILLIS;
/// After this time without a revolution, the head is blocked. The slowest head needs less for one.
const STILL: Nanos = 2_000 * MILLIS;
/// The motor stops after this time without subscribers. A program that restarts subscribes again in less.
const IDLE: Nanos = 5_000 * MILLIS;
/// All rates are tried twice in this time if bytes arrive at each of them, because a stop request can be lost.
const ROUNDS: Nanos = 8 * dialogue::DRAIN;
