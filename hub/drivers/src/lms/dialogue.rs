//! The protocol state of a session: how the scanner is found, brought to a stream, supervised, and stopped.
//!
//! It handles telegrams and deadlines; the session handles bytes. No request changes a setting that outlives a power
//! cycle.

use scanhub_schema::{MILLIS, Nanos};

use crate::line::{self, Control, State};
use crate::lms::command::{MODE, Request};
use crate::lms::exchange::{FORGOTTEN, NAK_PAUSE, Outgoing, TRIES};
use crate::lms::header::{Expect, StreamHeader, is_data};
use crate::lms::measured::Measured;
use crate::lms::rate::{LineRate, POWER_ON_BAUD, SEARCH_ORDER, SETTLE};
use crate::lms::reply::{POWER_ON, REFUSED, Reply};
use crate::lms::sensor::{Identity, Sensor, Trouble};
use crate::lms::session::Settings;
use crate::lms::start::{NextQuestion, Questions, STOPS, Start, Step};
use crate::lms::telegram::{REPLY, Telegram};
use crate::lms::variant::Baud;

/// The protocol state of a session.
#[derive(Clone, Debug)]
pub(crate) struct Dialogue {
    settings: Settings,
    phase: Phase,
    /// The request that is being sent, or whose reply is expected.
    open: Option<Outgoing>,
    pub(crate) rate: LineRate,
    pub(crate) sensor: Sensor,
    /// Identity that an earlier session saved; used until the first request is sent.
    recalled: Option<Identity>,
    /// Reason why the session does not stream now. [`Dialogue::trouble`] adds those that persist.
    trouble: Option<Trouble>,
    /// Whether a user paused the session.
    is_paused: bool,
    /// Whether the scanner keeps another variant than the requested one.
    variant_refused: bool,
    /// Whether bytes have arrived since the session began to listen, to stop the scanner, or to search for another
    /// round.
    has_received: bool,
    /// Time since which no telegram has arrived.
    quiet_since: Nanos,
    pub(crate) resyncs: u64,
    restarts: Restarts,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// Waiting for a stream without sending. The state is `shown` meanwhile. The session then sends request number
    /// `attempt` of the search: at `quiet_at` if no byte has arrived, otherwise at `give_up_at`.
    Listening { give_up_at: Nanos, quiet_at: Nanos, shown: State, attempt: usize },
    /// Sending a request at one rate after the other.
    Probing { attempt: usize },
    /// The scanner receives requests, and is brought to a stream.
    Starting(Start),
    /// Measured data arrive.
    Streaming { header: StreamHeader, silent_at: Nanos, questions: Questions },
    /// Bytes are from a recording.
    Following,
    /// The scanner is stopped. A stream that continues is stopped `stops_left` times more.
    Paused { stops_left: u8 },
}

impl Dialogue {
    pub(crate) fn new(settings: Settings, now: Nanos) -> Self {
        let mut dialogue = Dialogue {
            settings,
            phase: Phase::Following,
            open: None,
            rate: LineRate::new(&settings),
            sensor: Sensor::default(),
            recalled: None,
            trouble: None,
            is_paused: false,
            variant_refused: false,
            has_received: false,
            quiet_since: now,
            resyncs: 0,
            restarts: Restarts::default(),
        };
        if !settings.listen_only {
            dialogue.begin(now);
        }
        dialogue
    }

    /// Restores the identity that an earlier session saved.
    pub(crate) fn restore_identity(&mut self, identity: line::Identity) {
        self.recalled = Some(Identity::from_bytes(identity));
    }

    /// Restores the rate at which an earlier session found the scanner.
    pub(crate) fn restore_rate(&mut self, baud: Baud) {
        self.rate.restore(baud);
    }

    /// Restores the number of silent switches that an earlier session counted.
    pub(crate) fn restore_silent_switches(&mut self, count: u8, now: Nanos) {
        if self.rate.restore_silent_switches(count) {
            self.begin(now);
        }
    }

    /// Handles that the port cannot have the rate to which it was to be set.
    pub(crate) fn reject_rate(&mut self) {
        self.rate.reject();
    }

    /// Returns the rate if the port has to be set to it now.
    pub(crate) fn take_rate_change(&mut self) -> Option<Baud> {
        self.rate.take_change()
    }

    /// Returns the identity of a scanner that streams, for a later session.
    pub(crate) fn identity(&self) -> Option<line::Identity> {
        match self.phase {
            Phase::Streaming { header, .. } => self.sensor.identity(header).map(Identity::to_bytes),
            _ => None,
        }
    }

    /// Returns the number of restarts of the scanner.
    pub(crate) fn restarts(&self) -> u64 {
        self.restarts.count
    }

    pub(crate) fn state(&self) -> State {
        match self.phase {
            _ if self.is_paused => State::Paused,
            Phase::Listening { shown, .. } => shown,
            Phase::Probing { .. } => State::Probing,
            Phase::Starting(_) if self.rate.baud != self.rate.target => State::Switching,
            Phase::Starting(_) => State::Starting,
            Phase::Streaming { .. } | Phase::Following => State::Streaming,
            Phase::Paused { .. } => State::Paused,
        }
    }

    /// Returns the trouble that the session has now, or else one that persists. During a pause, those do not matter.
    pub(crate) fn trouble(&self) -> Option<Trouble> {
        if self.is_paused {
            return self.trouble;
        }
        let has_other_angles = self.sensor.has_other_angles().then_some(Trouble::AnglesUnknown);
        let no_ranges = self.sensor.mode.filter(|mode| !mode.has_ranges()).map(Trouble::NoRanges);
        let variant_refused = self.variant_refused.then_some(Trouble::VariantRefused);
        let needs_rs422 = self.rate.trouble();
        // While the scanner is lost, it explains every other finding.
        let first = needs_rs422.filter(|_| self.rate.has_lost_scanner()).or(self.trouble);
        first.or(has_other_angles).or(no_ranges).or(needs_rs422).or(variant_refused)
    }

    /// Returns the request that is being sent, or whose reply is expected.
    pub(crate) fn open(&self) -> Option<&Outgoing> {
        self.open.as_ref()
    }

    /// Handles that a byte of the open request was written at `now`.
    pub(crate) fn transmitted(&mut self, now: Nanos) {
        let Some(open) = &mut self.open else { return };
        open.transmitted(now, self.rate.baud);
        if self.settings.fixed_rate {
            // On a network, the first bytes of a reply may be all of it.
            open.hear(self.rate.baud);
        }
    }

    /// Returns the headers that are acceptable now.
    pub(crate) fn expect(&self) -> Expect {
        match self.phase {
            Phase::Streaming { header, .. } => {
                Expect::Stream { header, reply: self.open.as_ref().map(Outgoing::reply) }
            }
            _ => Expect::Anything,
        }
    }

    /// Returns when the dialogue has to act without a byte: the end of its phase or of the wait for a reply, or the
    /// time at which the next byte of a request may leave.
    pub(crate) fn deadline(&self) -> Nanos {
        let phase_ends_at = match self.phase {
            Phase::Listening { give_up_at, .. } if self.has_received => give_up_at,
            Phase::Listening { quiet_at, .. } => quiet_at,
            Phase::Streaming { silent_at, .. } => silent_at,
            _ => Nanos::MAX,
        };
        let Some(request) = &self.open else { return phase_ends_at };
        let next_byte_at = request.next_at().unwrap_or(Nanos::MAX);
        phase_ends_at.min(request.give_up_at).min(next_byte_at)
    }

    /// Handles a deadline that has passed.
    pub(crate) fn handle_timeout(&mut self, now: Nanos) {
        match self.phase {
            Phase::Listening { give_up_at, quiet_at, attempt, .. }
                if now >= give_up_at || (now >= quiet_at && !self.has_received) =>
            {
                return self.probe(now, attempt);
            }
            Phase::Streaming { silent_at, .. } if now >= silent_at => {
                self.resyncs += 1;
                self.trouble = Some(Trouble::Silence);
                self.sensor.forget();
                // The cable may be back sooner than the power.
                self.rate.expect_target();
                return self.listen(now, State::Silent);
            }
            _ => {}
        }
        if self.open.as_ref().is_some_and(|open| now >= open.give_up_at) {
            self.retry(now);
        }
    }

    /// Handles bytes, whatever they are.
    pub(crate) fn on_bytes(&mut self) {
        self.has_received = true;
        if let Some(open) = &mut self.open {
            open.hear(self.rate.baud);
        }
    }

    /// Handles an ACK.
    pub(crate) fn on_acknowledge(&mut self, now: Nanos) {
        if let Some(open) = self.open.as_mut().filter(|open| open.is_out()) {
            open.acknowledged(now, self.rate.baud);
        }
    }

    /// Handles a NAK. It proves nothing during a search or while a stream is stopped, because the rest of a scan, or a
    /// stream at another rate, contains such bytes. Then only the timeout counts.
    pub(crate) fn on_nak(&mut self, now: Nanos) {
        let credible = !matches!(self.phase, Phase::Probing { .. }) && !self.sensor.streams;
        if credible && self.open.as_ref().is_some_and(Outgoing::is_out) {
            self.retry(now + NAK_PAUSE);
        }
    }

    /// Handles a telegram whose first byte arrived at `first`. It counts as a reply even if it cannot be decoded to a
    /// `reply`. `is_line_damaged` is whether the line has damaged telegrams recently.
    pub(crate) fn on_telegram(
        &mut self,
        telegram: Telegram<'_>,
        reply: Option<Reply<'_>>,
        is_line_damaged: bool,
        first: Nanos,
        now: Nanos,
    ) {
        self.quiet_since = now;
        // A lost scanner needs a power cycle, so that restart does not count as a sign of a weak supply.
        let is_expected_restart = self.rate.has_lost_scanner();
        self.rate.note_telegram();
        self.sensor.set_line_damaged(is_line_damaged);
        self.sensor.learn(reply.as_ref(), telegram);
        if telegram.command() == POWER_ON {
            self.restarts.note_boot_message(is_expected_restart);
            return self.on_power_on(now);
        }
        self.restarts.is_in_contact = true;
        if is_data(telegram.command()) {
            let measured = match reply {
                Some(Reply::Measured(measured)) if measured.partial().is_none() => Some(measured),
                _ => None,
            };
            return self.on_data(telegram, measured, first, now);
        }
        let expected = telegram.command() == REFUSED
            || self.open.as_ref().is_some_and(|open| open.reply() == telegram.command());
        if let Some(open) = self.open.take_if(|open| expected && open.is_out()) {
            self.on_reply(open.request, reply, now);
        }
    }

    /// Handles data that the scanner sends without a request. `measured` is a complete scan.
    fn on_data(&mut self, telegram: Telegram<'_>, measured: Option<Measured<'_>>, first: Nanos, now: Nanos) {
        let next_silence = self.silent_at(now);
        match self.phase {
            // It arrived at the previous rate.
            _ if self.rate.is_changed => return,
            Phase::Streaming { header, silent_at: ref mut at, .. } => {
                // The framer accepted a telegram of another kind before this stream was known.
                if telegram.bytes().starts_with(&header) {
                    *at = next_silence;
                    self.question(now);
                }
            }
            Phase::Following => return,
            Phase::Paused { .. } => {
                if self.open.is_none() {
                    self.stop_again(now);
                }
            }
            Phase::Listening { .. } | Phase::Probing { .. } if self.is_paused => self.stop(now),
            Phase::Listening { shown: State::Starting, .. } if measured.is_some() => {
                self.stream(telegram, measured, now);
            }
            Phase::Listening { .. } | Phase::Probing { .. } => {
                let is_at_rate = self.rate.baud == self.rate.target;
                if is_at_rate && measured.is_some_and(|measured| self.is_requested(measured)) {
                    self.stream(telegram, measured, now);
                } else {
                    self.sensor.streams = true;
                    self.restarts.note_found(self.rate.baud, false);
                    self.proceed(Start::CHECK, now);
                }
            }
            Phase::Starting(start) if start.step == Step::Stream && measured.is_some() => {
                if self.open.as_ref().is_none_or(Outgoing::is_out) {
                    self.stream(telegram, measured, now);
                }
            }
            Phase::Starting(_) => {}
        }
        if self.open.as_ref().is_some_and(|open| open.out_at.is_some_and(|out| first > out + OVERLOOKED)) {
            self.retry(now);
        }
    }

    /// Handles the boot message: the scanner lost power or was reset. Its settings are lost, and it receives at this
    /// rate.
    fn on_power_on(&mut self, now: Nanos) {
        match self.phase {
            Phase::Following => {}
            _ if self.is_paused => {
                // The scanner is at rest.
                self.open = None;
                self.phase = Phase::Paused { stops_left: STOPS };
                self.trouble = None;
            }
            phase => {
                self.resyncs += u64::from(matches!(phase, Phase::Streaming { .. }));
                self.enter(Start::CHECK, now);
            }
        }
    }

    /// Handles the reply to `request`.
    fn on_reply(&mut self, request: Request, reply: Option<Reply<'_>>, now: Nanos) {
        // A sensor that does not report its state may be streaming: it is stopped, a limited number of times.
        self.sensor.streams |= request == Request::Status && !matches!(reply, Some(Reply::Status(_)));
        match self.phase {
            Phase::Probing { .. } if self.is_paused => self.stop(now),
            Phase::Probing { .. } => {
                self.rate.note_found();
                let is_idle = matches!(reply, Some(Reply::Status(_))) && !self.sensor.streams;
                self.restarts.note_found(self.rate.baud, is_idle);
                self.trouble
                    .take_if(|trouble| matches!(trouble, Trouble::NoAnswer { .. } | Trouble::Silence));
                if request == Request::Type {
                    // The line was silent before the request. The status follows at the rate to stream at.
                    self.sensor.streams = false;
                }
                self.proceed(Start::CHECK.after(request, reply.as_ref()), now);
            }
            Phase::Starting(start) => self.on_step(start, request, reply, now),
            Phase::Paused { .. } => {
                if matches!(reply, Some(Reply::Mode { done: true })) {
                    self.sensor.streams = false;
                    self.trouble = None;
                } else {
                    self.stop_again(now);
                }
            }
            Phase::Streaming { .. } | Phase::Listening { .. } | Phase::Following => {}
        }
    }

    /// Handles that the open request had no reply: sends it again from `at` on, or continues without it.
    fn retry(&mut self, at: Nanos) {
        let Some(open) = &mut self.open else { return };
        let request = open.request;
        // A mode change may have happened. Do not repeat it, but check the state.
        let is_acknowledged = open.reply() == MODE_REPLY && open.acknowledged;
        if !is_acknowledged && open.again(at) {
            return;
        }
        self.open = None;
        match self.phase {
            Phase::Probing { attempt } => self.search_on(attempt, at),
            Phase::Starting(start) => self.on_no_reply(start, request, is_acknowledged, at),
            Phase::Paused { .. } => self.stop_again(at),
            Phase::Streaming { .. } | Phase::Listening { .. } | Phase::Following => {}
        }
    }

    /// Sends `request` from `not_before` on, at most `tries` times, in place of the open one.
    fn ask(&mut self, request: Request, not_before: Nanos, tries: u8) {
        self.recalled = None;
        let address = self.sensor.address.map_or(0, |address| address & !REPLY);
        // The scanner must drop a partial request first.
        let is_cut = self.open.as_ref().is_some_and(Outgoing::is_partly_out);
        let not_before = if is_cut { not_before + FORGOTTEN } else { not_before };
        self.open = Some(Outgoing::new(request, address, not_before, tries));
    }

    /// Begins like a new session: listens at the rate to stream at and sends nothing.
    fn begin(&mut self, now: Nanos) {
        let was_paused = core::mem::take(&mut self.is_paused);
        if was_paused {
            // During the pause, no reply was expected.
            self.quiet_since = now;
        }
        self.trouble = None;
        self.variant_refused = false;
        self.sensor.forget();
        self.rate.begin(was_paused);
        self.listen(now, State::Probing);
    }

    /// Begins at `baud`, at which a search has found the scanner and the port is open.
    pub(crate) fn begin_at(&mut self, baud: Baud, now: Nanos) {
        self.rate.begin_at(baud);
        self.listen(now, State::Probing);
    }

    /// Listens for a stream at this rate.
    fn listen(&mut self, now: Nanos, shown: State) {
        self.open = None;
        self.has_received = false;
        let give_up_at = now + LISTEN.max(2 * self.period());
        // A stream that fell silent may continue, and bytes from a network arrive in bursts.
        let may_pause = shown == State::Silent || self.settings.fixed_rate;
        let quiet_at = if may_pause { give_up_at } else { now + QUIET };
        self.phase = Phase::Listening { give_up_at, quiet_at, shown, attempt: 0 };
    }

    /// Sends request number `attempt` of the search, for the status. On a silent line, at another rate than the one to
    /// stream at, it is for the type: at 9,600 baud, the 160 bytes of a status take 0.17 s. The status follows after
    /// the change of the rate. In every other round it is always for the status, because some scanners do not report
    /// their type.
    fn probe(&mut self, now: Nanos, attempt: usize) {
        self.phase = Phase::Probing { attempt };
        // The next reply may come from another scanner. Address 0 is for all.
        self.sensor.address = None;
        let (round, turn) = (attempt / SEARCH_ORDER.len(), attempt % SEARCH_ORDER.len());
        let baud = self.rate.of_turn(turn);
        let is_patient = round % 2 == 1;
        let is_usual = baud == self.rate.target || self.settings.fixed_rate;
        let is_brief = !is_usual && !is_patient && !self.has_received && !self.is_paused;
        let not_before = if baud == self.rate.baud { now } else { now + SETTLE };
        self.rate.set(baud);
        self.ask(if is_brief { Request::Type } else { Request::Status }, not_before, 1);
        if let Some(open) = self.open.as_mut().filter(|_| is_patient) {
            open.be_patient(PATIENCE);
        }
    }

    /// Continues the search after `attempt` had no reply. After a round without a single byte, it pauses at the rate at
    /// which a scanner sends its boot message, up to a minute after power-on (Telegram listing 7.1).
    fn search_on(&mut self, attempt: usize, now: Nanos) {
        let next = attempt + 1;
        if !next.is_multiple_of(SEARCH_ORDER.len()) {
            return self.probe(now, next);
        }
        let round = next / SEARCH_ORDER.len();
        if self.is_paused && round == PAUSED_ROUNDS {
            // A scanner that streams anyway does not receive requests.
            self.phase = Phase::Paused { stops_left: 0 };
            self.trouble = self.has_received.then_some(Trouble::NotStopped);
            return;
        }
        let baud = self.settings.fixed_rate.then_some(self.rate.baud);
        let seconds = coarse(now.saturating_sub(self.quiet_since) / (1_000 * MILLIS));
        if !self.is_paused && seconds > 0 && !self.rate.has_lost_scanner() {
            self.trouble = Some(Trouble::NoAnswer { baud, seconds });
        }
        let pause = PAUSES[(round - 1).min(PAUSES.len() - 1)];
        if core::mem::take(&mut self.has_received) || pause == 0 {
            return self.probe(now, next);
        }
        self.rate.set(POWER_ON_BAUD);
        let until = now + pause;
        self.phase =
            Phase::Listening { give_up_at: until, quiet_at: until, shown: State::Probing, attempt: next };
    }

    /// Continues a start, now that it is known what the scanner does.
    fn proceed(&mut self, start: Start, now: Nanos) {
        let is_at_rate = self.rate.baud == self.rate.target;
        self.enter(start.proceed(&self.sensor, is_at_rate, self.settings.variant), now);
    }

    /// Sends the request of the step of `start`.
    fn enter(&mut self, start: Start, now: Nanos) {
        let (request, tries) = start.request(self.rate.target, self.settings.variant);
        self.restarts.streamed_at = None;
        self.phase = Phase::Starting(start);
        self.ask(request, now, tries);
    }

    /// Handles the `reply` to `request`, which belongs to the step of `start`.
    fn on_step(&mut self, start: Start, request: Request, reply: Option<Reply<'_>>, now: Nanos) {
        let failed = matches!(reply, Some(Reply::Refused | Reply::Mode { done: false }));
        let is_done = matches!(reply, Some(Reply::Variant { done: true, .. }));
        let start = start.after(request, reply.as_ref());
        match start.step {
            Step::Baud if failed && start.may_be_in_other_mode() => self.enter(start.check(), now),
            Step::Stop | Step::Baud | Step::Stream if failed => {
                self.trouble = Some(Trouble::Refused(request));
                self.probe(now + REFUSAL_PAUSE, 0);
            }
            Step::Stop => {
                self.sensor.streams = false;
                self.enter(start.check(), now);
            }
            Step::Check => self.proceed(start, now),
            Step::Baud => {
                self.rate.switch_to_target();
                self.enter(start.check(), now + SETTLE);
            }
            Step::Variant | Step::Type | Step::Configuration => {
                if start.step == Step::Variant {
                    self.variant_refused = !is_done;
                }
                self.enter(start.settle(&self.sensor, self.settings.variant), now);
            }
            // The stream begins with its first telegram, which is due like one that went missing.
            Step::Stream => {
                let until = self.silent_at(now);
                self.phase = Phase::Listening {
                    give_up_at: until,
                    quiet_at: until,
                    shown: State::Starting,
                    attempt: 0,
                };
            }
        }
    }

    /// Handles that `request`, which belongs to the step of `start`, had no reply in all its tries, or that the scanner
    /// acknowledged it and did not report the result.
    fn on_no_reply(&mut self, start: Start, request: Request, is_acknowledged: bool, at: Nanos) {
        let is_optional = match start.step {
            Step::Variant => {
                self.variant_refused = true;
                true
            }
            Step::Type | Step::Configuration => true,
            Step::Stop | Step::Stream => is_acknowledged,
            Step::Check | Step::Baud => false,
        };
        if is_optional {
            // The scanner may be unavailable. Check that, but not for long.
            self.phase = Phase::Starting(start.check());
            return self.ask(Request::Status, at, TRIES);
        }
        self.rate.give_up();
        let is_lost = self.rate.has_lost_scanner();
        self.trouble = (!is_lost).then_some(Trouble::Unanswered(request));
        self.probe(at, 0);
    }

    /// Returns whether a stream has the requested beams. A scanner that refused them is accepted as it is.
    fn is_requested(&self, measured: Measured<'_>) -> bool {
        measured.count() == self.settings.variant.beams() || self.variant_refused
    }

    /// Returns the time between two telegrams of the requested variant.
    fn period(&self) -> Nanos {
        let variant = self.settings.variant;
        variant.period(2 * variant.beams() + BYTES_BESIDES_VALUES, self.rate.target.rate())
    }

    /// Returns when a stream is silent if no measured data arrive: after a second, on a slow line after two telegrams.
    fn silent_at(&self, now: Nanos) -> Nanos {
        now + SILENCE.max(5 * self.period() / 2)
    }

    /// Begins to stream: measured data arrive, and are accepted as they are.
    fn stream(&mut self, telegram: Telegram<'_>, measured: Option<Measured<'_>>, now: Nanos) {
        let Some(&header) = telegram.bytes().first_chunk::<{ size_of::<StreamHeader>() }>() else { return };
        let is_requested = measured.is_some_and(|scan| scan.count() == self.settings.variant.beams());
        if let Some(known) = self.recalled.take_if(|known| known.header == header) {
            self.sensor.restore_identity(known);
        }
        self.trouble = None;
        self.variant_refused = !is_requested;
        self.sensor.streams = true;
        self.restarts.streamed_at = Some(self.rate.baud);
        let silent_at = self.silent_at(now);
        // A reply may still arrive to a complete request. The scanner must drop a partial one before the next.
        let unsent = self.open.take_if(|open| !open.is_out());
        let ask_at = if unsent.is_some_and(|open| open.is_partly_out()) { now + FORGOTTEN } else { now };
        self.phase = Phase::Streaming { header, silent_at, questions: Questions::new(ask_at) };
        self.question(now);
    }

    /// Sends the next question right after a scan. A reply costs the scan that it interrupts, so the next question
    /// waits for the next scan.
    fn question(&mut self, now: Nanos) {
        let Phase::Streaming { questions, .. } = &mut self.phase else { return };
        if self.open.is_some() {
            return;
        }
        match questions.next(&self.sensor, now) {
            NextQuestion::Ask(question) => self.ask(question, now, 1),
            NextQuestion::Later => {}
            NextQuestion::Done => {
                self.sensor.accept_unconfirmed();
                self.trouble.take_if(|trouble| *trouble == Trouble::ModeUnknown);
            }
            NextQuestion::ModeUnknown => self.trouble = Some(Trouble::ModeUnknown),
        }
    }

    /// Handles a request of a user. A pause stops the scanner, after a search for it if necessary. It ends with the
    /// report that the scanner has stopped, or that this is not known.
    pub(crate) fn control(&mut self, control: Control, now: Nanos) {
        match (control, self.phase) {
            (_, Phase::Following) => {}
            (Control::Pause, phase) if !self.is_paused => {
                self.is_paused = true;
                self.trouble = None;
                let is_rate_unknown = match phase {
                    Phase::Probing { .. } | Phase::Listening { shown: State::Probing, .. } => true,
                    // It may change at this moment.
                    Phase::Starting(start) => start.step == Step::Baud,
                    _ => false,
                };
                if is_rate_unknown { self.probe(now, 0) } else { self.stop(now) }
            }
            (Control::Resume, _) if self.is_paused => self.begin(now),
            (Control::Resync, _) => {
                self.resyncs += 1;
                self.begin(now);
            }
            (Control::Pause | Control::Resume, _) => {}
        }
    }

    /// Stops the scanner, which receives at this rate.
    fn stop(&mut self, now: Nanos) {
        self.phase = Phase::Paused { stops_left: STOPS };
        self.restarts.streamed_at = None;
        self.has_received = false;
        self.ask(Request::Stop, now, TRIES);
    }

    /// Stops the scanner again, because it continues, or nothing that it sent shows that it stopped.
    fn stop_again(&mut self, now: Nanos) {
        match self.phase {
            // The line is silent: the scanner is at rest, or not connected.
            _ if !self.has_received => {}
            Phase::Paused { stops_left: 0 } => self.trouble = Some(Trouble::NotStopped),
            Phase::Paused { stops_left } => {
                self.stop(now);
                self.phase = Phase::Paused { stops_left: stops_left - 1 };
            }
            _ => {}
        }
    }
}

/// Counter of restarts of the scanner that the session did not request.
#[derive(Clone, Copy, Debug, Default)]
struct Restarts {
    count: u64,
    /// Whether a telegram has arrived since the session began or the last boot message. Without it, a boot message is
    /// first contact, or a copy of the last one.
    is_in_contact: bool,
    /// Rate of the last stream, until a request stops it or the scanner is found again.
    streamed_at: Option<Baud>,
}

impl Restarts {
    /// Handles a boot message.
    fn note_boot_message(&mut self, is_expected: bool) {
        let is_restart = core::mem::take(&mut self.is_in_contact) && !is_expected;
        self.count += u64::from(is_restart);
        self.streamed_at = None;
    }

    /// Handles that the scanner was found at `baud`. It has restarted, and its boot message was lost, if it streamed
    /// and no request stopped it, but now it `is_idle` or has another rate.
    fn note_found(&mut self, baud: Baud, is_idle: bool) {
        let has_restarted = self.streamed_at.take().is_some_and(|before| before != baud || is_idle);
        self.count += u64::from(has_restarted);
    }
}

/// Rounds seconds down to the coarse steps of messages, so that they do not change every second.
fn coarse(seconds: u64) -> u32 {
    const HOUR: u32 = 3_600;
    const STEPS: [u32; 9] = [1, 3, 10, 30, 60, 300, 600, 1_800, HOUR];
    let step = STEPS.into_iter().rev().find(|&step| u64::from(step) <= seconds).unwrap_or(0);
    if step < HOUR { step } else { (seconds / u64::from(HOUR)) as u32 * HOUR }
}

/// Command byte of the reply to every change of mode or rate.
const MODE_REPLY: u8 = MODE | REPLY;
/// Time to listen for a stream: more than two scans of the slowest variant. It is longer where the line is slower than
/// the scans.
pub(crate) const LISTEN: Nanos = 120 * MILLIS;
/// A line that is silent for this time carries no stream of whole scans: the slowest variant begins one every 53 ms,
/// and has bytes on the line for at least a third of that. Two telegram times of the usual variant.
const QUIET: Nanos = 55 * MILLIS;
/// After this time without measured data, the session begins again (paper: resynchronize after one second).
pub const SILENCE: Nanos = 1_000 * MILLIS;
/// Pause after a refusal, before the search begins.
const REFUSAL_PAUSE: Nanos = 500 * MILLIS;
/// A whole scan that began this long after a request shows that the scanner overlooked the request, which would have
/// interrupted the stream. The time is for bytes that an adapter keeps.
const OVERLOOKED: Nanos = 25 * MILLIS;
/// Pauses before the next round of the search, by the number of rounds without a byte.
const PAUSES: [Nanos; 4] = [0, 500 * MILLIS, 1_000 * MILLIS, 1_500 * MILLIS];
/// Rounds of the search for a scanner that only has to stop: a brief and a patient one.
const PAUSED_ROUNDS: usize = 2;
/// Additional time for the reply in every other round. A slow scanner would never be found otherwise.
const PATIENCE: Nanos = 250 * MILLIS;
/// Bytes of a telegram besides its values: STX to the number of values, status and checksum.
const BYTES_BESIDES_VALUES: usize = 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_seconds_to_few_steps() {
        let coarse = [0, 1, 2, 9, 59, 60, 299, 3_599, 3_600, 7_199, 7_200, 360_000].map(coarse);
        assert_eq!(coarse, [0, 1, 1, 3, 30, 60, 60, 1_800, 3_600, 3_600, 7_200, 360_000]);
    }
}
