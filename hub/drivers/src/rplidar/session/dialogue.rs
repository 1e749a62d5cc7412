//! What is asked of a scanner and in what order, what its answers lead to, and what is done where none comes.

use crate::line::State;
use schema::{MILLIS, Nanos};

use super::{Phase, SILENCE, Session, Trouble};
use crate::rplidar::device_info::{Health, Info};
use crate::rplidar::framer::Expect;
use crate::rplidar::model::{Mode, Motor};
use crate::rplidar::offers::{Offer, Offers};
use crate::rplidar::packet::Kind;
use crate::rplidar::request::{Answer, Request, RequestQueue, key};

/// Questions in their order; those of a mode have its place among the offers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ask {
    Info,
    Health,
    Board,
    Count,
    Typical,
    SampleTime(u8),
    Kind(u8),
    Name(u8),
    SampleTimes,
    /// How long a point takes in the mode that will be started, once more: answers have no checksum, and all times are
    /// counted by this one.
    Confirmed(u8),
    /// To measure.
    Scan(Wanted),
}

/// The mode that is started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wanted {
    Standard,
    Express(u8),
}

/// A copy of a response, independent of the buffer of the framer.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reply {
    bytes: [u8; 64],
    len: usize,
}

impl Reply {
    pub(super) fn new(data: &[u8]) -> Reply {
        let len = data.len().min(64);
        let mut bytes = [0; 64];
        bytes[..len].copy_from_slice(&data[..len]);
        Reply { bytes, len }
    }

    pub(super) fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

impl Session {
    /// Begins the conversation anew, at the rate of the last one.
    pub(super) fn begin(&mut self, shown: State) {
        self.end_stream();
        self.shown = shown;
        if self.settings.listen_only {
            self.phase = Phase::Listening { since: self.now };
            return self.framer.expect(Expect::Anything(self.alike()));
        }
        // Opening a port asserts it, which keeps the motor of an A1 off.
        self.change_dtr = Some(false);
        self.stop(0);
    }

    /// Tells it to stop, after so many attempts in vain.
    fn stop(&mut self, attempts: u8) {
        self.framer.expect(Expect::Answers);
        self.outgoing = RequestQueue::default();
        self.outgoing.push(&Request::STOP);
        let (until, at_most) = (self.now + QUIET, self.now + DRAIN);
        self.phase = Phase::Draining { attempts, until, at_most };
    }

    /// Nothing is wanted of it, and its head may rest.
    pub(super) fn rest(&mut self, is_resting: bool) {
        self.end_stream();
        self.framer.expect(Expect::Nothing);
        if !self.settings.listen_only {
            self.outgoing = RequestQueue::default();
            self.outgoing.push(&Request::STOP);
            self.turn_head(false);
        }
        self.phase = Phase::Paused { is_resting };
    }

    pub(super) fn ask(&mut self, ask: Ask, attempts: u8) {
        if self.settings.listen_only {
            // Somebody else asks.
            return;
        }
        let request = match ask {
            Ask::Info => Request::INFO,
            Ask::Health => Request::HEALTH,
            Ask::Board => Request::board(),
            Ask::Count => Request::configuration(key::COUNT, None),
            Ask::Typical => Request::configuration(key::TYPICAL, None),
            Ask::SampleTime(mode) | Ask::Confirmed(mode) => {
                Request::configuration(key::SAMPLE_TIME, Some(mode))
            }
            Ask::Kind(mode) => Request::configuration(key::ANSWER, Some(mode)),
            Ask::Name(mode) => Request::configuration(key::NAME, Some(mode)),
            Ask::SampleTimes => Request::SAMPLE_TIMES,
            Ask::Scan(Wanted::Standard) => Request::SCAN,
            Ask::Scan(Wanted::Express(mode)) => Request::express(mode),
        };
        // A piece of an answer would take the head of the next one along.
        self.framer.clear();
        self.outgoing.push(&request);
        self.phase = Phase::Asking { ask, attempts, until: self.now + self.patience() };
    }

    /// A request is on its way entirely.
    pub(super) fn sent(&mut self) {
        let (now, patience) = (self.now, self.patience());
        match &mut self.phase {
            Phase::Asking { until, .. } => *until = now + patience,
            Phase::Draining { until, at_most, .. } => (*until, *at_most) = (now + QUIET, now + DRAIN),
            _ => {}
        }
    }

    fn patience(&self) -> Nanos {
        if self.settings.fixed_rate { FAR } else { ANSWER }
    }

    /// No answer came.
    pub(super) fn unanswered(&mut self, ask: Ask, attempts: u8) {
        // Something came, and was no answer: nobody is believed not to know what he was asked.
        let is_damaged = self.reads.last_byte() + self.patience() > self.now && attempts < PATIENT;
        match ask {
            Ask::Info if attempts == 0 && is_damaged => self.stop(1),
            Ask::Info => self.seek_on(),
            _ if attempts == 0 || is_damaged => self.ask(ask, attempts + 1),
            Ask::Board => self.turn_and_list(),
            // It answers, but not to everything; without an answer it is taken to be well.
            Ask::Health => self.look_for_board(),
            Ask::Count => self.ask(Ask::SampleTimes, 0),
            Ask::SampleTimes => {
                self.offers = Offers::of_old(0, 0);
                self.start();
            }
            Ask::Confirmed(_) => self.start(),
            Ask::Scan(_) => {
                // It answered at this rate.
                self.trouble = Some(Trouble::Refused);
                self.stop(0);
            }
            ask => self.ask_next(ask),
        }
    }

    /// Tries the next rate, and says for how long already.
    pub(super) fn seek_on(&mut self) {
        let (since, read) = *self.quiet_since.get_or_insert((self.now, self.framer.tally().read));
        // A scanner that lost its power is soon back at the rate at which it streamed. Its greeting is not missed there.
        let may_boot = self.streamed_at == Some(self.baud)
            && self.framer.tally().read == read
            && self.now < since + POWER_ON;
        if let Some(baud) = self.next_rate().filter(|_| !may_boot) {
            self.baud = baud;
            self.change_baud = true;
        }
        self.complain(since);
        self.stop(0);
    }

    pub(super) fn complain(&mut self, since: Nanos) {
        let seconds = (self.now.saturating_sub(since) / (1_000 * MILLIS)) as u32;
        if seconds > 0 && self.trouble != Some(Trouble::Alike) {
            let baud = self.next_rate().is_none().then_some(self.baud);
            self.trouble = Some(Trouble::NoAnswer { baud, seconds: 1 << seconds.ilog2() });
        }
    }

    /// The rate after this one, the model's first.
    pub(super) fn next_rate(&self) -> Option<u32> {
        const RATES: [u32; 4] = [115_200, 256_000, 460_800, 1_000_000];
        let at = RATES.iter().position(|rate| *rate == self.baud)?;
        (!self.settings.fixed_rate && !self.settings.listen_only).then(|| RATES[(at + 1) % RATES.len()])
    }

    /// An answer came, what it says being `data`; it may be one that was asked before.
    pub(super) fn answered(&mut self, answer: Answer, data: Reply) {
        let data = data.bytes();
        if answer == Answer::Info {
            self.info = Info::parse(data);
        }
        let ask = match self.phase {
            Phase::Asking { ask, .. } => ask,
            _ if self.settings.listen_only => self.overhear(answer, data),
            _ => return,
        };
        // What is said of a key begins with that key.
        let of_key = |key: u8| data.strip_prefix(&[key, 0, 0, 0]).filter(|_| answer == Answer::Configuration);
        match ask {
            Ask::Info if answer == Answer::Info => {
                self.quiet_since = None;
                if self.shown == State::Probing {
                    self.shown = State::Starting;
                }
                self.ask(Ask::Health, 0);
            }
            Ask::Health if answer == Answer::Health => self.examine(Health::parse(data)),
            Ask::Board if answer == Answer::Board => {
                self.has_board = number(data) & 1 == 1;
                self.turn_and_list();
            }
            Ask::Count => {
                let Some(data) = of_key(key::COUNT) else { return };
                self.offers.begin(number(data) as usize);
                self.ask(Ask::Typical, 0);
            }
            Ask::Typical => {
                let Some(data) = of_key(key::TYPICAL) else { return };
                self.offers.recommend(number(data) as u8);
                self.ask_next(ask);
            }
            Ask::SampleTime(mode) => {
                let Some(data) = of_key(key::SAMPLE_TIME) else { return };
                let us = number(data) as f32 / 256.0;
                self.offer(mode, |offer| offer.sample_us = (us > 0.0).then_some(us));
                self.ask_next(ask);
            }
            Ask::Confirmed(mode) => {
                let Some(data) = of_key(key::SAMPLE_TIME) else { return };
                let us = number(data) as f32 / 256.0;
                let said = self.offers.nth_mut(usize::from(mode)).and_then(|offer| offer.sample_us);
                if said == Some(us) { self.start() } else { self.begin(self.shown) }
            }
            Ask::Kind(mode) => {
                let Some(data) = of_key(key::ANSWER) else { return };
                let kind = Kind::of(number(data) as u8);
                self.offer(mode, |offer| offer.kind = kind);
                self.ask_next(ask);
            }
            Ask::Name(mode) => {
                let Some(data) = of_key(key::NAME) else { return };
                let named = Mode::said(data);
                self.offer(mode, |offer| offer.named = named);
                self.ask_next(ask);
            }
            Ask::SampleTimes if answer == Answer::SampleTimes => {
                let us = number(data);
                self.offers = Offers::of_old(us as u16, (us >> 16) as u16);
                self.start();
            }
            _ => {}
        }
    }

    /// What somebody asked that is answered so: the modes are listed in their order, and of each one key after the other.
    fn overhear(&mut self, answer: Answer, data: &[u8]) -> Ask {
        let key = match answer {
            Answer::Info => return Ask::Info,
            Answer::Health => return Ask::Health,
            Answer::Board => return Ask::Board,
            Answer::SampleTimes => return Ask::SampleTimes,
            Answer::Configuration => data.first().copied().unwrap_or(key::COUNT),
        };
        let (mode, before) = self.overheard;
        let mode = if key > before { mode } else { mode + 1 };
        match key {
            key::COUNT => self.overheard = (0, 0),
            key::SAMPLE_TIME | key::ANSWER | key::NAME => self.overheard = (mode, key),
            _ => {}
        }
        match key {
            key::SAMPLE_TIME => Ask::SampleTime(mode),
            key::ANSWER => Ask::Kind(mode),
            key::NAME => Ask::Name(mode),
            key::TYPICAL => Ask::Typical,
            _ => Ask::Count,
        }
    }

    fn offer(&mut self, mode: u8, set: impl Fn(&mut Offer)) {
        self.offers.nth_mut(usize::from(mode)).into_iter().for_each(set);
    }

    /// What is asked after `ask`.
    fn ask_next(&mut self, ask: Ask) {
        let next = match ask {
            Ask::SampleTime(mode) => Ask::Kind(mode),
            Ask::Kind(mode) => Ask::Name(mode),
            Ask::Name(mode) => Ask::SampleTime(mode + 1),
            _ => Ask::SampleTime(0),
        };
        match next {
            Ask::SampleTime(mode) if usize::from(mode) >= self.offers.count() => self.scan(),
            next => self.ask(next, 0),
        }
    }

    fn examine(&mut self, health: Option<Health>) {
        self.health = health;
        match health {
            _ if self.settings.listen_only => {}
            Some(Health::Error(_)) if !self.was_reset => {
                self.was_reset = true;
                self.streamed_at = None;
                self.outgoing.push(&Request::RESET);
                self.phase = Phase::Booting { until: self.now + BOOT };
            }
            Some(health @ Health::Error(_)) => {
                self.trouble = Some(Trouble::Unwell(health));
                self.phase = Phase::Unwell { until: self.now + AGAIN };
            }
            _ => {
                self.was_reset = false;
                self.look_for_board();
            }
        }
    }

    /// Handles the greeting of a scanner that booted and lost its settings. `is_named` as of
    /// [`Found::Greeting`](crate::rplidar::framer::Found::Greeting).
    pub(super) fn booted(&mut self, is_named: bool) {
        match self.phase {
            Phase::Paused { .. } | Phase::Listening { .. } => {}
            // It is asked anyway; and what another rate makes of a stream may be text, again and again.
            Phase::Draining { .. } | Phase::Asking { ask: Ask::Info, .. } => {
                let has_streamed = self.streamed_at.take_if(|baud| is_named && *baud == self.baud).is_some();
                self.restarts += u64::from(has_streamed);
            }
            Phase::Booting { .. } => self.phase = Phase::Booting { until: self.now + SETTLE },
            // The rest of a packet may be text too, but a scanner that boots pauses before its greeting. A name proves a
            // greeting even after other bytes, which a scanner sends while its supply drops.
            Phase::Hearing { silent_at, .. }
                if !is_named
                    && (silent_at.abs_diff(self.now + SILENCE) < HUSHED
                        || self.framer.skipped() > Kind::LONGEST as u32 + GREETING) => {}
            // A stream whose beginning was damaged is text here and there.
            Phase::Asking { .. } if !is_named => {}
            _ => {
                self.resyncs += u64::from(matches!(self.phase, Phase::Hearing { .. }));
                self.restarts += 1;
                self.streamed_at = None;
                self.begin(State::Starting);
                self.outgoing = RequestQueue::default();
                self.phase = Phase::Booting { until: self.now + SETTLE };
            }
        }
    }

    fn look_for_board(&mut self) {
        if self.motor() == Motor::Board { self.ask(Ask::Board, 0) } else { self.turn_and_list() }
    }

    fn turn_and_list(&mut self) {
        self.turn_head(true);
        self.ask(Ask::Count, 0);
    }

    fn motor(&self) -> Motor {
        self.info.map_or(Motor::Dtr, |info| info.motor())
    }

    /// Has the head turn, or not.
    fn turn_head(&mut self, turns: bool) {
        match self.motor() {
            _ if self.settings.listen_only => {}
            Motor::Speed => self.outgoing.push(&Request::speed(if turns { SPEED } else { 0 })),
            Motor::Board if self.has_board => {
                self.outgoing.push(&Request::duty(if turns { DUTY } else { 0 }))
            }
            // A session begins with it cleared.
            _ if turns => {}
            _ => self.change_dtr = Some(true),
        }
    }

    /// All is known but whether it is true.
    fn scan(&mut self) {
        if self.settings.listen_only {
            return;
        }
        let offer = self.choose();
        if offer.sample_us.is_some() { self.ask(Ask::Confirmed(offer.id), 0) } else { self.start() }
    }

    /// The mode that is wanted, or else the fastest.
    fn choose(&mut self) -> Offer {
        let baud = (!self.settings.fixed_rate).then_some(self.baud);
        let wanted = self.settings.mode.and_then(|mode| self.offers.wanted(mode, baud));
        self.no_mode = self.settings.mode.filter(|_| wanted.is_none());
        let fastest = || self.offers.fastest(baud).or_else(|| self.offers.fastest(None));
        wanted.or_else(fastest).unwrap_or_default()
    }

    /// It shall measure.
    fn start(&mut self) {
        if self.settings.listen_only {
            return;
        }
        let offer = self.choose();
        self.mode = offer.named;
        self.point_ns = offer.sample_us.map(|us| f64::from(us) * 1e3);
        let is_standard = offer.kind.is_none_or(|kind| kind == Kind::Standard);
        self.ask(Ask::Scan(if is_standard { Wanted::Standard } else { Wanted::Express(offer.id) }), 0);
    }
}

/// Decodes a little-endian number of one to four bytes.
fn number(data: &[u8]) -> u32 {
    data.iter().take(4).rev().fold(0, |number, byte| number << 8 | u32::from(*byte))
}

/// A line on which nothing came for so long is quiet after a request to stop; and it is asked after so long, quiet or not.
pub(super) const QUIET: Nanos = 15 * MILLIS;
pub(super) const DRAIN: Nanos = 60 * MILLIS;
/// An answer takes some milliseconds, and an adapter that collects bytes 16 more, twice.
const ANSWER: Nanos = 70 * MILLIS;
/// So often something is asked at the most of which a damaged answer came.
const PATIENT: u8 = 8;
/// Behind a network.
const FAR: Nanos = 500 * MILLIS;
/// A real A1 has booted after 0.67 s.
const BOOT: Nanos = 1_500 * MILLIS;
/// For so long, and longer, it sends nothing before its greeting.
const HUSHED: Nanos = 200 * MILLIS;
/// Time from power-on to the greeting, and some.
const POWER_ON: Nanos = 3_000 * MILLIS;
/// Bytes of a greeting.
const GREETING: u32 = 64;
/// It answers 4 ms after its greeting.
const SETTLE: Nanos = 10 * MILLIS;
/// An unwell scanner is asked again after so long.
const AGAIN: Nanos = 2_000 * MILLIS;
/// Turns per minute that are asked for: of an S1, its maker's choice.
const SPEED: u16 = 600;
/// The duty cycle that is asked for, of 1,023: of an A2, its maker's choice.
const DUTY: u16 = 660;
