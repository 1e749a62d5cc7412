//! Protocol state of a session: it finds the scanner, starts its stream, monitors it, and stops it.
//!
//! This state machine handles telegrams and deadlines, and the session handles bytes. No request changes a setting that
//! the scanner keeps after a power cycle.

use scanhub_schema::{MILLIS, Nanos};

use crate::line::{self, Control, State};
use crate::lms::command::{MODE, Request};
use crate::lms::header::{ExpectedHeaders, StreamHeader, is_data};
use crate::lms::measured::MeasuredValues;
use crate::lms::rate::{LineRate, POWER_ON_BAUD, SEARCH_ORDER, SETTLE_TIME};
use crate::lms::reply::{POWER_ON, REFUSED, Reply};
use crate::lms::request_channel::{NAK_PAUSE, PARTIAL_REQUEST_TIMEOUT, PendingRequest, TRIES};
use crate::lms::sensor::{Identity, Problem, Sensor};
use crate::lms::session::Settings;
use crate::lms::start::{MAX_STOPS, NextQuery, Start, Step, StreamQueries};
use crate::lms::telegram::{REPLY, Telegram};
use crate::lms::variant::Baud;

/// State machine of a session.
#[derive(Clone, Debug)]
pub(crate) struct ProtocolState {
    settings: Settings,
    phase: Phase,
    /// The request that is being sent, or whose reply is expected.
    open_request: Option<PendingRequest>,
    pub(crate) rate: LineRate,
    pub(crate) sensor: Sensor,
    /// Identity that an earlier session saved. The first request discards it.
    restored_identity: Option<Identity>,
    /// Reason why the session does not stream now. [`ProtocolState::problem`] also returns problems that last longer.
    problem: Option<Problem>,
    /// Whether a user paused the session.
    is_paused: bool,
    /// Whether the scanner keeps a variant that differs from the requested variant.
    variant_refused: bool,
    /// Whether bytes have arrived since the session last started to listen, to stop the scanner, or to run a round of
    /// the search.
    has_received: bool,
    /// Time of the last telegram, or of the start of the session.
    no_telegram_since: Nanos,
    pub(crate) resyncs: u64,
    restarts: Restarts,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// Waits for a stream and sends nothing. Meanwhile, the session reports the state `shown`. If no stream arrives,
    /// the session then sends request number `attempt` of the search: at `quiet_at` if no byte has arrived, and
    /// otherwise at `deadline`.
    Listening { deadline: Nanos, quiet_at: Nanos, shown: State, attempt: usize },
    /// Sends a request at each baud rate.
    Probing { attempt: usize },
    /// Starts the stream of a scanner that receives requests.
    Starting(Start),
    /// Receives measured data.
    Streaming { header: StreamHeader, silent_at: Nanos, queries: StreamQueries },
    /// Reads a recording.
    Replaying,
    /// Has stopped the scanner. If a stream continues, the session sends up to `stops_left` more stop requests.
    Paused { stops_left: u8 },
}

impl ProtocolState {
    pub(crate) fn new(settings: Settings, now: Nanos) -> Self {
        let mut dialogue = ProtocolState {
            settings,
            phase: Phase::Replaying,
            open_request: None,
            rate: LineRate::new(&settings),
            sensor: Sensor::default(),
            restored_identity: None,
            problem: None,
            is_paused: false,
            variant_refused: false,
            has_received: false,
            no_telegram_since: now,
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
        self.restored_identity = Some(Identity::from_bytes(identity));
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

    /// Handles the port's rejection of a rate.
    pub(crate) fn reject_rate(&mut self) {
        self.rate.reject();
    }

    /// Returns the rate to which the port must be set now. Returns `None` if the port has the right rate.
    pub(crate) fn take_rate_change(&mut self) -> Option<Baud> {
        self.rate.take_change()
    }

    /// Returns the identity of a streaming scanner, for a later session.
    pub(crate) fn identity(&self) -> Option<line::Identity> {
        match self.phase {
            Phase::Streaming { header, .. } => self.sensor.identity(header).map(Identity::to_bytes),
            _ => None,
        }
    }

    /// Returns the number of restarts of the scanner that the session did not request.
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
            Phase::Streaming { .. } | Phase::Replaying => State::Streaming,
            Phase::Paused { .. } => State::Paused,
        }
    }

    /// Returns the current problem. If there is none, returns a lasting problem, such as a refused setting. Lasting
    /// problems are irrelevant during a pause, so a paused session reports only the current problem.
    pub(crate) fn problem(&self) -> Option<Problem> {
        if self.is_paused {
            return self.problem;
        }
        let has_other_angles = self.sensor.has_other_angles().then_some(Problem::AnglesUnknown);
        let no_ranges = self.sensor.mode.filter(|mode| !mode.has_ranges()).map(Problem::NoRanges);
        let variant_refused = self.variant_refused.then_some(Problem::VariantRefused);
        let needs_rs422 = self.rate.problem();
        // If the scanner was lost after a switch of the baud rate, this loss is the cause of all other problems.
        let main_problem = needs_rs422.filter(|_| self.rate.has_lost_scanner()).or(self.problem);
        main_problem.or(has_other_angles).or(no_ranges).or(needs_rs422).or(variant_refused)
    }

    /// Returns the request that is being sent, or whose reply is expected.
    pub(crate) fn open_request(&self) -> Option<&PendingRequest> {
        self.open_request.as_ref()
    }

    /// Records that a byte of the open request was written at `now`.
    pub(crate) fn on_transmitted(&mut self, now: Nanos) {
        let Some(open) = &mut self.open_request else { return };
        open.on_byte_sent(now, self.rate.baud);
        if self.settings.fixed_rate {
            // A network may deliver the complete reply in one read, so extend the deadline before the first byte.
            open.on_byte(self.rate.baud);
        }
    }

    /// Returns the headers that are acceptable now.
    pub(crate) fn expected_headers(&self) -> ExpectedHeaders {
        match self.phase {
            Phase::Streaming { header, .. } => ExpectedHeaders::Stream {
                header,
                reply: self.open_request.as_ref().map(PendingRequest::reply),
            },
            _ => ExpectedHeaders::Anything,
        }
    }

    /// Returns the time at which the protocol must act even if no byte arrives: the end of its phase, the timeout of a
    /// reply, or the earliest time of a request's next byte.
    pub(crate) fn deadline(&self) -> Nanos {
        let phase_ends_at = match self.phase {
            Phase::Listening { deadline: give_up_at, .. } if self.has_received => give_up_at,
            Phase::Listening { quiet_at, .. } => quiet_at,
            Phase::Streaming { silent_at, .. } => silent_at,
            _ => Nanos::MAX,
        };
        let Some(request) = &self.open_request else { return phase_ends_at };
        let next_byte_at = request.next_at().unwrap_or(Nanos::MAX);
        phase_ends_at.min(request.deadline).min(next_byte_at)
    }

    /// Handles an expired deadline.
    pub(crate) fn handle_timeout(&mut self, now: Nanos) {
        match self.phase {
            Phase::Listening { deadline: give_up_at, quiet_at, attempt, .. }
                if now >= give_up_at || (now >= quiet_at && !self.has_received) =>
            {
                return self.probe(now, attempt);
            }
            Phase::Streaming { silent_at, .. } if now >= silent_at => {
                self.resyncs += 1;
                self.problem = Some(Problem::Silence);
                self.sensor.reset_identity();
                // Perhaps only the cable was unplugged. The scanner then still uses the rate of the stream, so search
                // first at this rate.
                self.rate.expect_target();
                return self.listen(now, State::Silent);
            }
            _ => {}
        }
        if self.open_request.as_ref().is_some_and(|open| now >= open.deadline) {
            self.retry(now);
        }
    }

    /// Records the arrival of bytes, before they are decoded.
    pub(crate) fn on_bytes(&mut self) {
        self.has_received = true;
        if let Some(open) = &mut self.open_request {
            open.on_byte(self.rate.baud);
        }
    }

    /// Handles an ACK.
    pub(crate) fn on_acknowledge(&mut self, now: Nanos) {
        if let Some(open) = self.open_request.as_mut().filter(|open| open.is_sent()) {
            open.on_acknowledged(now, self.rate.baud);
        }
    }

    /// Handles a NAK. Ignores the NAK during a search and while a stream is being stopped, because the rest of a scan,
    /// or a stream at another rate, contains bytes that look like a NAK. In these cases, only the timeout ends the wait
    /// for the reply.
    pub(crate) fn on_nak(&mut self, now: Nanos) {
        let is_credible = !matches!(self.phase, Phase::Probing { .. }) && !self.sensor.streams;
        if is_credible && self.open_request.as_ref().is_some_and(PendingRequest::is_sent) {
            self.retry(now + NAK_PAUSE);
        }
    }

    /// Handles a telegram whose first byte arrived at `first`. `reply` is the decoded telegram. Even a telegram that
    /// cannot be decoded counts as the reply to the open request. `is_line_damaged` is whether the line has recently
    /// damaged telegrams.
    pub(crate) fn on_telegram(
        &mut self,
        telegram: Telegram<'_>,
        reply: Option<Reply<'_>>,
        is_line_damaged: bool,
        first: Nanos,
        now: Nanos,
    ) {
        self.no_telegram_since = now;
        // A lost scanner needs a power cycle, so its restart is expected. It is not a sign of a weak power supply.
        let is_expected_restart = self.rate.has_lost_scanner();
        self.rate.note_telegram();
        self.sensor.set_line_damaged(is_line_damaged);
        self.sensor.update(reply.as_ref(), telegram);
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
            || self.open_request.as_ref().is_some_and(|open| open.reply() == telegram.command());
        if let Some(open) = self.open_request.take_if(|open| expected && open.is_sent()) {
            self.on_reply(open.request, reply, now);
        }
    }

    /// Handles data that the scanner sends without a request. `measured` contains the decoded data if they are a
    /// complete scan.
    fn on_data(
        &mut self,
        telegram: Telegram<'_>,
        measured: Option<MeasuredValues<'_>>,
        first: Nanos,
        now: Nanos,
    ) {
        let next_silence = self.silence_deadline(now);
        match self.phase {
            // The data arrived at the previous rate.
            _ if self.rate.needs_change => return,
            Phase::Streaming { header, silent_at: ref mut at, .. } => {
                // The framer may have accepted a telegram of another kind before it had the header of this stream.
                if telegram.bytes().starts_with(&header) {
                    *at = next_silence;
                    self.send_question(now);
                }
            }
            Phase::Replaying => return,
            Phase::Paused { .. } => {
                if self.open_request.is_none() {
                    self.repeat_stop(now);
                }
            }
            Phase::Listening { .. } | Phase::Probing { .. } if self.is_paused => self.stop(now),
            Phase::Listening { shown: State::Starting, .. } if measured.is_some() => {
                self.begin_stream(telegram, measured, now);
            }
            Phase::Listening { .. } | Phase::Probing { .. } => {
                let is_at_rate = self.rate.baud == self.rate.target;
                if is_at_rate && measured.is_some_and(|measured| self.is_requested(measured)) {
                    self.begin_stream(telegram, measured, now);
                } else {
                    self.sensor.streams = true;
                    self.restarts.note_found(self.rate.baud, false);
                    self.proceed(Start::CHECK, now);
                }
            }
            Phase::Starting(start) if start.step == Step::Stream && measured.is_some() => {
                if self.open_request.as_ref().is_none_or(PendingRequest::is_sent) {
                    self.begin_stream(telegram, measured, now);
                }
            }
            Phase::Starting(_) => {}
        }
        if self
            .open_request
            .as_ref()
            .is_some_and(|open| open.sent_at.is_some_and(|out| first > out + OVERLOOK_TIME))
        {
            self.retry(now);
        }
    }

    /// Handles the boot message. The scanner lost power or was reset, so it has lost its settings. It receives requests
    /// at the current rate.
    fn on_power_on(&mut self, now: Nanos) {
        match self.phase {
            Phase::Replaying => {}
            _ if self.is_paused => {
                // After power-on, the scanner does not stream.
                self.open_request = None;
                self.phase = Phase::Paused { stops_left: MAX_STOPS };
                self.problem = None;
            }
            phase => {
                self.resyncs += u64::from(matches!(phase, Phase::Streaming { .. }));
                self.enter_step(Start::CHECK, now);
            }
        }
    }

    /// Handles the reply to `request`.
    fn on_reply(&mut self, request: Request, reply: Option<Reply<'_>>, now: Nanos) {
        // A scanner that does not report its state may be streaming. The session therefore stops it, a limited number
        // of times.
        self.sensor.streams |= request == Request::Status && !matches!(reply, Some(Reply::Status(_)));
        match self.phase {
            Phase::Probing { .. } if self.is_paused => self.stop(now),
            Phase::Probing { .. } => {
                self.rate.note_found();
                let is_idle = matches!(reply, Some(Reply::Status(_))) && !self.sensor.streams;
                self.restarts.note_found(self.rate.baud, is_idle);
                self.problem.take_if(|problem| matches!(problem, Problem::NoReply { .. } | Problem::Silence));
                if request == Request::Type {
                    // The line was silent before the request, so the scanner does not stream. The session requests the
                    // status later, at the target rate.
                    self.sensor.streams = false;
                }
                self.proceed(Start::CHECK.after_reply(request, reply.as_ref()), now);
            }
            Phase::Starting(start) => self.on_step(start, request, reply, now),
            Phase::Paused { .. } => {
                if matches!(reply, Some(Reply::Mode { done: true })) {
                    self.sensor.streams = false;
                    self.problem = None;
                } else {
                    self.repeat_stop(now);
                }
            }
            Phase::Streaming { .. } | Phase::Listening { .. } | Phase::Replaying => {}
        }
    }

    /// Handles the missing reply to the open request. Sends the request again, not before `not_before`, or continues
    /// without a reply.
    fn retry(&mut self, not_before: Nanos) {
        let Some(pending) = &mut self.open_request else { return };
        let request = pending.request;
        // The scanner has acknowledged the mode change and may have executed it. Check the state instead of repeating
        // the request.
        let is_acknowledged = pending.reply() == MODE_REPLY && pending.is_acknowledged;
        if !is_acknowledged && pending.retry(not_before) {
            return;
        }
        self.open_request = None;
        match self.phase {
            Phase::Probing { attempt } => self.continue_search(attempt, not_before),
            Phase::Starting(start) => self.on_no_reply(start, request, is_acknowledged, not_before),
            Phase::Paused { .. } => self.repeat_stop(not_before),
            Phase::Streaming { .. } | Phase::Listening { .. } | Phase::Replaying => {}
        }
    }

    /// Replaces the open request with `request`. Sends it not before `not_before`, and at most `tries` times.
    fn send_request(&mut self, request: Request, not_before: Nanos, tries: u8) {
        self.restored_identity = None;
        let address = self.sensor.address.map_or(0, |address| address & !REPLY);
        // The scanner must first discard a partly sent request.
        let is_partial = self.open_request.as_ref().is_some_and(PendingRequest::is_partly_sent);
        let not_before = if is_partial { not_before + PARTIAL_REQUEST_TIMEOUT } else { not_before };
        self.open_request = Some(PendingRequest::new(request, address, not_before, tries));
    }

    /// Starts like a new session: listens at the target rate and sends nothing.
    fn begin(&mut self, now: Nanos) {
        let was_paused = core::mem::take(&mut self.is_paused);
        if was_paused {
            // The session expected no telegrams during the pause.
            self.no_telegram_since = now;
        }
        self.problem = None;
        self.variant_refused = false;
        self.sensor.reset_identity();
        self.rate.begin(was_paused);
        self.listen(now, State::Probing);
    }

    /// Starts at `baud`. The port is open at this rate, and a search has found the scanner at this rate.
    pub(crate) fn set_start_rate(&mut self, baud: Baud, now: Nanos) {
        self.rate.set_start_rate(baud);
        self.listen(now, State::Probing);
    }

    /// Listens for a stream at the current rate.
    fn listen(&mut self, now: Nanos, shown: State) {
        self.open_request = None;
        self.has_received = false;
        let give_up_at = now + LISTEN_TIME.max(2 * self.scan_period());
        // An interrupted stream may continue, and bytes from a network arrive in bursts. A short silence then does not
        // prove that there is no stream.
        let may_pause = shown == State::Silent || self.settings.fixed_rate;
        let quiet_at = if may_pause { give_up_at } else { now + QUIET_TIME };
        self.phase = Phase::Listening { deadline: give_up_at, quiet_at, shown, attempt: 0 };
    }

    /// Sends request number `attempt` of the search, which normally requests the status. On a silent line at a rate
    /// other than the target rate, it requests the type instead, because the 160 bytes of a status take 0.17 s at 9,600
    /// baud. The session then requests the status after the change of the rate. Every second round requests only the
    /// status, because some scanners do not report their type.
    fn probe(&mut self, now: Nanos, attempt: usize) {
        self.phase = Phase::Probing { attempt };
        // The next reply may come from another scanner. Address 0 reaches every scanner.
        self.sensor.address = None;
        let (round, position) = (attempt / SEARCH_ORDER.len(), attempt % SEARCH_ORDER.len());
        let baud = self.rate.nth_rate(position);
        let is_slow_round = round % 2 == 1;
        let is_target_rate = baud == self.rate.target || self.settings.fixed_rate;
        let is_short_request = !is_target_rate && !is_slow_round && !self.has_received && !self.is_paused;
        let not_before = if baud == self.rate.baud { now } else { now + SETTLE_TIME };
        self.rate.set(baud);
        self.send_request(if is_short_request { Request::Type } else { Request::Status }, not_before, 1);
        if let Some(open) = self.open_request.as_mut().filter(|_| is_slow_round) {
            open.extend_timeout(EXTRA_REPLY_TIME);
        }
    }

    /// Continues the search after request number `attempt` got no reply. After a round without a single byte, the
    /// session pauses at the rate of the boot message. A scanner sends this message up to a minute after power-on
    /// (Telegram listing 7.1).
    fn continue_search(&mut self, attempt: usize, now: Nanos) {
        let next = attempt + 1;
        if !next.is_multiple_of(SEARCH_ORDER.len()) {
            return self.probe(now, next);
        }
        let round = next / SEARCH_ORDER.len();
        if self.is_paused && round == STOP_SEARCH_ROUNDS {
            // A scanner that still streams does not receive requests.
            self.phase = Phase::Paused { stops_left: 0 };
            self.problem = self.has_received.then_some(Problem::NotStopped);
            return;
        }
        let baud = self.settings.fixed_rate.then_some(self.rate.baud);
        let seconds = round_down_seconds(now.saturating_sub(self.no_telegram_since) / (1_000 * MILLIS));
        if !self.is_paused && seconds > 0 && !self.rate.has_lost_scanner() {
            self.problem = Some(Problem::NoReply { baud, seconds });
        }
        let pause = PAUSES[(round - 1).min(PAUSES.len() - 1)];
        if core::mem::take(&mut self.has_received) || pause == 0 {
            return self.probe(now, next);
        }
        self.rate.set(POWER_ON_BAUD);
        let until = now + pause;
        self.phase =
            Phase::Listening { deadline: until, quiet_at: until, shown: State::Probing, attempt: next };
    }

    /// Continues the start of a stream after the scanner has reported its status.
    fn proceed(&mut self, start: Start, now: Nanos) {
        let is_at_rate = self.rate.baud == self.rate.target;
        self.enter_step(start.proceed(&self.sensor, is_at_rate, self.settings.variant), now);
    }

    /// Enters the step of `start` and sends the request of this step.
    fn enter_step(&mut self, start: Start, now: Nanos) {
        let (request, tries) = start.request(self.rate.target, self.settings.variant);
        self.restarts.streamed_at = None;
        self.phase = Phase::Starting(start);
        self.send_request(request, now, tries);
    }

    /// Handles the `reply` to `request`, which belongs to the step of `start`.
    fn on_step(&mut self, start: Start, request: Request, reply: Option<Reply<'_>>, now: Nanos) {
        let is_refused = matches!(reply, Some(Reply::Refused | Reply::Mode { done: false }));
        let is_done = matches!(reply, Some(Reply::Variant { done: true, .. }));
        let start = start.after_reply(request, reply.as_ref());
        match start.step {
            Step::Baud if is_refused && start.may_be_in_other_mode() => {
                self.enter_step(start.with_check(), now)
            }
            Step::Stop | Step::Baud | Step::Stream if is_refused => {
                self.problem = Some(Problem::Refused(request));
                self.probe(now + REFUSAL_PAUSE, 0);
            }
            Step::Stop => {
                self.sensor.streams = false;
                self.enter_step(start.with_check(), now);
            }
            Step::Check => self.proceed(start, now),
            Step::Baud => {
                self.rate.switch_to_target();
                self.enter_step(start.with_check(), now + SETTLE_TIME);
            }
            Step::Variant | Step::Type | Step::Configuration => {
                if start.step == Step::Variant {
                    self.variant_refused = !is_done;
                }
                self.enter_step(start.next_setting(&self.sensor, self.settings.variant), now);
            }
            // The stream begins with its first telegram. Until this telegram arrives, the timeout is the same as within
            // a stream.
            Step::Stream => {
                let until = self.silence_deadline(now);
                self.phase =
                    Phase::Listening { deadline: until, quiet_at: until, shown: State::Starting, attempt: 0 };
            }
        }
    }

    /// Handles a missing reply to `request`, which belongs to the step of `start`. Either no try got a reply, or the
    /// scanner acknowledged the request but did not report the result.
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
            // The scanner may be unavailable. Check this with few tries.
            self.phase = Phase::Starting(start.with_check());
            return self.send_request(Request::Status, at, TRIES);
        }
        self.rate.note_no_reply();
        let is_lost = self.rate.has_lost_scanner();
        self.problem = (!is_lost).then_some(Problem::Unanswered(request));
        self.probe(at, 0);
    }

    /// Returns whether a stream has the requested number of beams. Also returns `true` if the scanner refused this
    /// number.
    fn is_requested(&self, measured: MeasuredValues<'_>) -> bool {
        measured.count() == self.settings.variant.beams() || self.variant_refused
    }

    /// Returns the time between two telegrams of the requested variant at the target rate.
    fn scan_period(&self) -> Nanos {
        let variant = self.settings.variant;
        variant.period(2 * variant.beams() + OVERHEAD_BYTES, self.rate.target.rate())
    }

    /// Returns the time at which the stream counts as silent if no more data arrive. This time is one second after
    /// `now`, or on a slow line two and a half telegram periods after `now`.
    fn silence_deadline(&self, now: Nanos) -> Nanos {
        now + SILENCE_TIMEOUT.max(5 * self.scan_period() / 2)
    }

    /// Starts to stream with the first measured data. Accepts the scanner's settings as these data show them.
    fn begin_stream(&mut self, telegram: Telegram<'_>, measured: Option<MeasuredValues<'_>>, now: Nanos) {
        let Some(&header) = telegram.bytes().first_chunk::<{ size_of::<StreamHeader>() }>() else { return };
        let is_requested = measured.is_some_and(|scan| scan.count() == self.settings.variant.beams());
        if let Some(known) = self.restored_identity.take_if(|known| known.header == header) {
            self.sensor.restore_identity(known);
        }
        self.problem = None;
        self.variant_refused = !is_requested;
        self.sensor.streams = true;
        self.restarts.streamed_at = Some(self.rate.baud);
        let silent_at = self.silence_deadline(now);
        // The reply to a completely sent request may still arrive. The scanner must discard a partly sent request
        // before the next request.
        let unsent_request = self.open_request.take_if(|open| !open.is_sent());
        let first_request_at = if unsent_request.is_some_and(|open| open.is_partly_sent()) {
            now + PARTIAL_REQUEST_TIMEOUT
        } else {
            now
        };
        self.phase = Phase::Streaming { header, silent_at, queries: StreamQueries::new(first_request_at) };
        self.send_question(now);
    }

    /// Sends the next of the [`StreamQueries`] right after a scan. A reply costs the scan that it interrupts, so the
    /// session sends at most one request per scan.
    fn send_question(&mut self, now: Nanos) {
        let Phase::Streaming { queries, .. } = &mut self.phase else { return };
        if self.open_request.is_some() {
            return;
        }
        match queries.next(&self.sensor, now) {
            NextQuery::Send(request) => self.send_request(request, now, 1),
            NextQuery::Later => {}
            NextQuery::Done => {
                self.sensor.accept_unconfirmed();
                self.problem.take_if(|problem| *problem == Problem::ModeUnknown);
            }
            NextQuery::ModeUnknown => self.problem = Some(Problem::ModeUnknown),
        }
    }

    /// Handles a request of a user. A pause stops the scanner. If the baud rate is unknown, the session first searches
    /// for the scanner. Finally, the session reports that the scanner has stopped, or that it does not know whether the
    /// scanner has stopped.
    pub(crate) fn control(&mut self, control: Control, now: Nanos) {
        match (control, self.phase) {
            (_, Phase::Replaying) => {}
            (Control::Pause, phase) if !self.is_paused => {
                self.is_paused = true;
                self.problem = None;
                let is_rate_unknown = match phase {
                    Phase::Probing { .. } | Phase::Listening { shown: State::Probing, .. } => true,
                    // The rate may be changing at this moment.
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

    /// Stops the scanner, which receives requests at the current rate.
    fn stop(&mut self, now: Nanos) {
        self.phase = Phase::Paused { stops_left: MAX_STOPS };
        self.restarts.streamed_at = None;
        self.has_received = false;
        self.send_request(Request::Stop, now, TRIES);
    }

    /// Stops the scanner again if bytes have arrived since the last stop request, because the stream may continue.
    fn repeat_stop(&mut self, now: Nanos) {
        match self.phase {
            // The line is silent, so the scanner has stopped or is not connected.
            _ if !self.has_received => {}
            Phase::Paused { stops_left: 0 } => self.problem = Some(Problem::NotStopped),
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
    /// Whether a telegram has arrived since the start of the session or since the last boot message. If not, a boot
    /// message is the first contact with the scanner, or a copy of the last boot message.
    is_in_contact: bool,
    /// Baud rate of the last stream. `None` after a request has stopped the stream, or after a search has found the
    /// scanner again.
    streamed_at: Option<Baud>,
}

impl Restarts {
    /// Records a boot message. Counts a restart, unless it `is_expected`.
    fn note_boot_message(&mut self, is_expected: bool) {
        let is_restart = core::mem::take(&mut self.is_in_contact) && !is_expected;
        self.count += u64::from(is_restart);
        self.streamed_at = None;
    }

    /// Records that a search found the scanner at `baud`. `is_idle` is whether the scanner has reported that it does
    /// not stream. A scanner that streamed, and that no request has stopped, has restarted if it now has another rate
    /// or is idle. The boot message of this restart was lost.
    fn note_found(&mut self, baud: Baud, is_idle: bool) {
        let has_restarted = self.streamed_at.take().is_some_and(|old_rate| old_rate != baud || is_idle);
        self.count += u64::from(has_restarted);
    }
}

/// Rounds seconds down to coarse steps, so that a message does not change every second.
fn round_down_seconds(seconds: u64) -> u32 {
    const HOUR_SECONDS: u32 = 3_600;
    const STEP_SECONDS: [u32; 9] = [1, 3, 10, 30, 60, 300, 600, 1_800, HOUR_SECONDS];
    let step = STEP_SECONDS.into_iter().rev().find(|&step| u64::from(step) <= seconds).unwrap_or(0);
    if step < HOUR_SECONDS { step } else { (seconds / u64::from(HOUR_SECONDS)) as u32 * HOUR_SECONDS }
}

/// Command byte of the reply to a change of mode or rate.
const MODE_REPLY: u8 = MODE | REPLY;
/// Time for which the session listens for a stream. It is longer than two scans of the slowest variant. On a line that
/// is slower than the scans, the session listens longer.
pub(crate) const LISTEN_TIME: Nanos = 120 * MILLIS;
/// Silence after which a line carries no stream of complete scans. It is the duration of two telegrams of the usual
/// variant. The slowest variant begins a scan every 53 ms, and the bytes of a scan are on the line for at least a third
/// of these 53 ms.
const QUIET_TIME: Nanos = 55 * MILLIS;
/// Time without measured data after which the session restarts (paper: resynchronize after one second).
pub const SILENCE_TIMEOUT: Nanos = 1_000 * MILLIS;
/// Pause after a refusal, before the search begins.
const REFUSAL_PAUSE: Nanos = 500 * MILLIS;
/// Minimum time from a request to the start of a complete scan that shows that the scanner overlooked the request. A
/// reply would have interrupted the stream. This time also covers bytes that an adapter still buffers.
const OVERLOOK_TIME: Nanos = 25 * MILLIS;
/// Pauses before the next round of the search. The index is the number of completed rounds minus 1. The last pause
/// applies to all later rounds.
const PAUSES: [Nanos; 4] = [0, 500 * MILLIS, 1_000 * MILLIS, 1_500 * MILLIS];
/// Maximum number of rounds of the search in a paused session, which searches for the scanner in order to stop it. One
/// round has short timeouts, and the other round has long timeouts.
const STOP_SEARCH_ROUNDS: usize = 2;
/// Additional time for the reply in every second round, so that the search also finds a slow scanner.
const EXTRA_REPLY_TIME: Nanos = 250 * MILLIS;
/// Number of bytes of a telegram in addition to its values: STX to count word, status and checksum.
const OVERHEAD_BYTES: usize = 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_seconds_to_few_steps() {
        let coarse = [0, 1, 2, 9, 59, 60, 299, 3_599, 3_600, 7_199, 7_200, 360_000].map(round_down_seconds);
        assert_eq!(coarse, [0, 1, 1, 3, 30, 60, 60, 1_800, 3_600, 3_600, 7_200, 360_000]);
    }
}
