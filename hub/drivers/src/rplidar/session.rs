//! The session with an RPLIDAR: it requests the identity of the scanner, starts a scan mode, and returns packets as
//! they arrive, and revolutions.
//!
//! A stream that another program left running is stopped, never continued: express and dense packets look alike, and a
//! scanner that measures answers no request.

use core::fmt;

use scanhub_schema::{MILLIS, Nanos, line_time};

use crate::line::{
    self, Account, Closed, Condition, Control, Event, Introduction, Output, RawScan, Reads, Received, State,
    StreamCounters, Tally, TurnCounts, Watchdog, family,
};
use crate::rplidar::framer::{Expect, Found, Framer, Span};
use crate::rplidar::handshake::{Handshake, Next, Query, RateSearch};
use crate::rplidar::packet::Kind;
use crate::rplidar::request::{Answer, Head, Health, Info, Request, RequestQueue, StreamHead};
use crate::rplidar::stream::{Line, Stream};
use crate::rplidar::{Mode, Model, described};
use crate::settings::Settings;

/// The session with one scanner.
#[derive(Clone, Debug)]
pub struct Session {
    settings: Settings,
    now: Nanos,
    phase: Phase,
    /// State that is shown until measured data arrive.
    shown: State,
    trouble: Option<Trouble>,
    framer: Framer,
    reads: Reads,
    rate: RateSearch,
    requests: RequestQueue,
    /// Level that the DTR line has to get.
    change_dtr: Option<bool>,
    handshake: Handshake,
    stream: Stream,
    /// Kind of the stream and arrival of its descriptor, once the descriptor has arrived.
    announced: Option<(Kind, Nanos)>,
    counters: StreamCounters,
    /// Time since which there are no subscribers.
    idle_since: Option<Nanos>,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// A recording. No packets have been read yet.
    Listening { since: Nanos },
    /// The stop request was sent. The session sends the first query at `until`, or at `at_most` if bytes still arrive.
    Draining { attempts: u8, until: Nanos, at_most: Nanos },
    /// The response to `query` is expected by `until`.
    Querying { query: Query, attempts: u8, until: Nanos },
    /// The scanner restarts.
    Booting { until: Nanos },
    /// The scanner reports an error. The session requests the health again at `until`.
    Unwell { until: Nanos },
    /// Packets arrive.
    Streaming(Watchdog),
    /// A user paused the session, or, if `is_resting`, there are no subscribers.
    Paused { is_resting: bool },
}

impl Session {
    /// Creates a session on a port that is open at the rate of `settings`.
    pub fn new(settings: Settings, now: Nanos) -> Self {
        let mut session = Session {
            settings,
            now,
            phase: Phase::Listening { since: now },
            shown: State::Probing,
            trouble: None,
            framer: Framer::new(Expect::Nothing),
            reads: Reads::new(now),
            rate: RateSearch::new(&settings),
            requests: RequestQueue::default(),
            change_dtr: None,
            handshake: Handshake::new(settings),
            stream: Stream::new(settings),
            announced: None,
            counters: StreamCounters::default(),
            idle_since: None,
        };
        session.begin(State::Probing);
        session
    }

    /// Returns the model, once it is known.
    pub fn model(&self) -> Option<Model> {
        self.handshake.model()
    }

    /// Returns the identity that the scanner reported.
    pub fn info(&self) -> Option<Info> {
        self.handshake.info
    }

    /// Returns the health that the scanner reported.
    pub fn health(&self) -> Option<Health> {
        self.handshake.health
    }

    /// Returns the points that the scanner measures per second, once they are known.
    pub fn points_per_second(&self) -> Option<f32> {
        self.stream.points_per_second()
    }

    /// Returns the counters of the framer.
    pub fn tally(&self) -> &Tally {
        self.framer.buffer.tally()
    }

    /// Returns the numbers of revolutions by kind.
    pub fn turn_counts(&self) -> TurnCounts {
        self.stream.turn_counts()
    }

    /// Begins again at the current rate. The session shows the state `shown` until measured data arrive.
    fn begin(&mut self, shown: State) {
        self.end_stream();
        self.announced = None;
        self.shown = shown;
        if self.settings.listen_only {
            self.phase = Phase::Listening { since: self.now };
            return self.framer.expect(Expect::Anything(self.handshake.alike()));
        }
        // Opening a port asserts it, which keeps the motor of an A1 off.
        self.change_dtr = Some(false);
        self.stop(0);
    }

    /// Sends the stop request. The first query follows; `attempts` of it were not answered.
    fn stop(&mut self, attempts: u8) {
        self.framer.expect(Expect::Answers);
        self.requests = RequestQueue::default();
        self.requests.push(&Request::STOP);
        let (until, at_most) = (self.now + QUIET, self.now + DRAIN);
        self.phase = Phase::Draining { attempts, until, at_most };
    }

    /// Stops the stream and the motor, and expects nothing.
    fn rest(&mut self, is_resting: bool) {
        self.end_stream();
        self.framer.expect(Expect::Nothing);
        if !self.settings.listen_only {
            self.requests = RequestQueue::default();
            self.requests.push(&Request::STOP);
            self.set_motor(false);
        }
        self.phase = Phase::Paused { is_resting };
    }

    /// Starts the motor, or stops it.
    fn set_motor(&mut self, is_on: bool) {
        match self.handshake.motor_request(is_on) {
            _ if self.settings.listen_only => {}
            Some(request) => self.requests.push(&request),
            // A session begins with DTR cleared.
            None if is_on => {}
            None => self.change_dtr = Some(true),
        }
    }

    /// Sends `query`. There were `attempts` before. In a recording, the recorded program sends queries.
    fn query(&mut self, query: Query, attempts: u8) {
        if self.settings.listen_only {
            return;
        }
        // A leftover fragment would swallow the start of the next response.
        self.framer.clear();
        self.requests.push(&query.request());
        self.phase = Phase::Querying { query, attempts, until: self.now + self.response_timeout() };
    }

    /// Restarts the timeout after a request was sent completely.
    fn requests_sent(&mut self) {
        let (now, timeout) = (self.now, self.response_timeout());
        match &mut self.phase {
            Phase::Querying { until, .. } => *until = now + timeout,
            Phase::Draining { until, at_most, .. } => (*until, *at_most) = (now + QUIET, now + DRAIN),
            _ => {}
        }
    }

    fn response_timeout(&self) -> Nanos {
        if self.settings.fixed_rate { NETWORK_TIMEOUT } else { RESPONSE_TIMEOUT }
    }

    /// Handles a response with its descriptor in `span`.
    fn answered(&mut self, answer: Answer, span: Span) {
        let query = if let Phase::Querying { query, .. } = self.phase { Some(query) } else { None };
        let data = &self.framer.bytes(span)[Head::LEN..];
        let next = self.handshake.answered(query, answer, data, self.rate.baud);
        self.proceed(next);
    }

    /// Handles that no response to `query` arrived.
    fn unanswered(&mut self, query: Query, attempts: u8) {
        // Bytes arrived, but no valid response. The response may have been damaged, so do not conclude that the request
        // is unsupported.
        let is_damaged =
            self.reads.last_byte() + self.response_timeout() > self.now && attempts < MAX_ATTEMPTS;
        match query {
            Query::Info if attempts == 0 && is_damaged => self.stop(1),
            Query::Info => self.search_on(),
            _ if attempts == 0 || is_damaged => self.query(query, attempts + 1),
            _ => {
                let next = self.handshake.unanswered(query, self.rate.baud);
                self.proceed(next);
            }
        }
    }

    /// Carries out the next step of the handshake.
    fn proceed(&mut self, next: Next) {
        match next {
            Next::Nothing => {}
            Next::Found(query) => {
                self.rate.end();
                if self.shown == State::Probing {
                    self.shown = State::Starting;
                }
                self.query(query, 0);
            }
            Next::Query(query) => self.query(query, 0),
            Next::Reset => {
                self.rate.forget_stream();
                self.requests.push(&Request::RESET);
                self.phase = Phase::Booting { until: self.now + BOOT };
            }
            Next::Unwell(health) => {
                self.trouble = Some(Trouble::Unwell(health));
                self.phase = Phase::Unwell { until: self.now + HEALTH_RETRY_INTERVAL };
            }
            Next::StartMotor(query) => {
                self.set_motor(true);
                self.query(query, 0);
            }
            Next::Scan(mode) => {
                self.stream.set_sample_us(mode.sample_us);
                self.query(mode.query(), 0);
            }
            Next::Restart => self.begin(self.shown),
            Next::Refused => {
                self.trouble = Some(Trouble::Refused);
                self.stop(0);
            }
        }
    }

    /// Tries the next rate, and updates the time in the trouble.
    fn search_on(&mut self) {
        let since = self.rate.advance(self.now, self.framer.buffer.tally().read);
        self.complain(since);
        self.stop(0);
    }

    /// Reports that no response has arrived since `since`.
    fn complain(&mut self, since: Nanos) {
        if self.trouble != Some(Trouble::Alike) {
            self.trouble = self.rate.no_answer(since, self.now).or(self.trouble);
        }
    }

    /// Handles the boot message of a scanner, which has lost its settings. `is_named` as of [`Found::Greeting`].
    fn booted(&mut self, is_named: bool) {
        match self.phase {
            Phase::Paused { .. } | Phase::Listening { .. } => {}
            // The first query follows anyway. A stream at another rate may look like text again and again.
            Phase::Draining { .. } | Phase::Querying { query: Query::Info, .. } => {
                if is_named && self.rate.take_stream() {
                    self.counters.note_restart();
                }
            }
            Phase::Booting { .. } => self.phase = Phase::Booting { until: self.now + SETTLE },
            // The rest of a packet may be text too, but a scanner that boots pauses before its boot message. A name
            // proves it even after other bytes, which a scanner sends while its supply drops.
            Phase::Streaming(watchdog)
                if !is_named
                    && (watchdog.silent_at().abs_diff(self.now + Watchdog::SILENCE) < BOOT_SILENCE
                        || self.framer.skipped() > Kind::LONGEST as u32 + BOOT_MESSAGE_LEN) => {}
            // A stream whose beginning was damaged looks like text here and there.
            Phase::Querying { .. } if !is_named => {}
            phase => {
                if matches!(phase, Phase::Streaming(_)) {
                    self.counters.note_resync();
                }
                self.counters.note_restart();
                self.rate.forget_stream();
                self.begin(State::Starting);
                self.requests = RequestQueue::default();
                self.phase = Phase::Booting { until: self.now + SETTLE };
            }
        }
    }

    /// Handles the descriptor of a stream.
    fn stream_begins(&mut self) {
        match self.phase {
            // Another stream, in an unknown mode: of another program, or of another scanner.
            Phase::Streaming(_) if !self.settings.listen_only && !self.is_announced_again() => {
                self.counters.note_resync();
                self.begin(State::Starting);
            }
            Phase::Querying { query, .. } if !query.is_scan() => self.framer.expect(Expect::Answers),
            Phase::Querying { .. } | Phase::Listening { .. } | Phase::Streaming(_) => {
                self.end_stream();
                self.announced = self.framer.kind().map(|kind| (kind, self.now));
                self.framer.kind().into_iter().for_each(|kind| self.handshake.stream_begins(kind));
                let mut watchdog = self.continue_stream();
                watchdog.await_spin_up(self.now + SPIN_UP);
                self.phase = Phase::Streaming(watchdog);
                self.counters.await_revolution(self.framer.buffer.tally());
            }
            Phase::Paused { .. } => self.framer.expect(Expect::Nothing),
            Phase::Draining { .. } | Phase::Booting { .. } | Phase::Unwell { .. } => {
                self.framer.expect(Expect::Answers);
            }
        }
    }

    /// Returns whether the descriptor that has just arrived announces the session's own stream once more: the scanner
    /// responds to a request and to its repetition. A head may need a second to reach its speed. During this time, another
    /// scanner or program can start a stream, too.
    fn is_announced_again(&self) -> bool {
        let is_repeated = |(kind, at): (Kind, Nanos)| {
            self.framer.kind() == Some(kind) && self.now < at + 2 * self.response_timeout()
        };
        !self.stream.is_begun() && self.announced.is_some_and(is_repeated)
    }

    /// Starts or extends the stream after packets have arrived. Returns its deadlines.
    fn continue_stream(&mut self) -> Watchdog {
        let mut watchdog = Watchdog::new(self.now);
        if let Phase::Streaming(known) = self.phase {
            watchdog = known;
            watchdog.note_packets(self.now);
            self.counters.continue_stream(self.framer.buffer.tally());
        } else {
            self.trouble = None;
            self.counters.begin_stream(self.framer.buffer.tally());
        }
        self.phase = Phase::Streaming(watchdog);
        self.rate.note_stream();
        watchdog
    }

    /// Ends the stream: the next packet belongs to another one.
    fn end_stream(&mut self) {
        self.stream.end();
        self.reads.end_rest();
    }

    /// Stamps the packets of `span`, and keeps them for revolutions.
    fn receive(&mut self, kind: Kind, mut span: Span) -> Received<'_> {
        self.continue_stream();
        span.reasons |= self.reads.take_doubt(span.offset + span.len as u64);
        let baud = self.rate.baud;
        let pace = (!self.settings.fixed_rate).then_some(baud);
        let line = Line { arrivals: self.reads.arrivals(), baud, pace };
        let mut stamps = None;
        if self.stream.measure(kind, span, line, &self.handshake.modes) {
            stamps = self.stream.place(kind, &mut span, &mut self.framer, line, &self.handshake);
            self.counters.note_packets(self.framer.buffer.tally(), span.packets);
        }
        let packet_time = line_time(kind.bytes(), baud);
        let latest = line.arrivals.latest(span.offset + span.len as u64 - 1, pace);
        let latest = latest.saturating_sub(packet_time);
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

    /// Returns a complete revolution, and updates the state of the session.
    fn show(&mut self, closed: Closed) -> RawScan<'_> {
        let first = self.stream.scan(closed, &self.reads, self.now).first;
        self.reads.end_turn(first);
        self.trouble = None;
        if let Phase::Streaming(watchdog) = &mut self.phase {
            watchdog.note_revolution(self.now);
        }
        self.counters.await_revolution(self.framer.buffer.tally());
        self.stream.scan(closed, &self.reads, self.now)
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
                if until > at_most && now >= at_most && self.rate.is_quick(now) =>
            {
                self.search_on();
            }
            Phase::Draining { attempts, until, at_most } if now >= until.min(at_most) => {
                self.query(Query::Info, attempts);
            }
            Phase::Querying { query, attempts, until } if now >= until => self.unanswered(query, attempts),
            Phase::Booting { until } | Phase::Unwell { until } if now >= until => self.begin(self.shown),
            Phase::Streaming(watchdog) if watchdog.is_silent(now) => {
                self.counters.note_resync();
                self.trouble = Some(Trouble::Silence);
                self.begin(State::Silent);
            }
            Phase::Streaming(watchdog) if watchdog.is_revolution_overdue(now) => {
                let is_damaged = self.counters.is_mostly_damaged(self.framer.buffer.tally());
                self.trouble = (!is_damaged).then_some(Trouble::StandsStill);
            }
            _ => {}
        }
    }

    /// Returns when the session has to act without a byte.
    fn deadline(&self) -> Nanos {
        match self.phase {
            Phase::Listening { since } => {
                // The next full second, for the time in the trouble.
                let seconds = self.now.saturating_sub(since) / SECOND;
                since + (seconds + 1) * SECOND
            }
            Phase::Paused { .. } => Nanos::MAX,
            Phase::Draining { until, at_most, .. } => until.min(at_most),
            Phase::Querying { until, .. } | Phase::Booting { until } | Phase::Unwell { until } => until,
            Phase::Streaming(watchdog) => watchdog.silent_at(),
        }
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
            if let Phase::Draining { until, .. } = &mut self.phase {
                *until = now + QUIET;
            }
        }
    }

    fn handle_timeout(&mut self, now: Nanos) {
        self.now = now;
        self.framer.buffer.release(now.saturating_sub(self.reads.last_byte()));
    }

    fn transmitted(&mut self, now: Nanos) {
        self.now = now;
        self.requests = RequestQueue::default();
        self.requests_sent();
    }

    fn poll_output(&mut self) -> Output<'_> {
        loop {
            if let Some(on) = self.change_dtr.take() {
                return Output::SetDtr(on);
            }
            if let Some(baud) = self.rate.take_change() {
                self.framer.clear();
                return Output::SetRate(baud);
            }
            if !self.requests.bytes().is_empty() {
                return Output::Transmit { bytes: self.requests.bytes(), not_before: 0 };
            }
            if let Some(closed) = self.stream.advance(&self.framer) {
                return Output::Event(Event::Scan(self.show(closed)));
            }
            let most = self.framer.kind().map_or(1, |kind| self.stream.max_packets_per_sample(kind));
            let Some(found) = self.framer.advance(most) else { break };
            match found {
                Found::Reply(answer, span) => {
                    self.answered(answer, span);
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
        if self.change_dtr.is_some() || self.rate.is_changed || !self.requests.bytes().is_empty() {
            return self.poll_output();
        }
        self.reads.wait(self.now, self.deadline(), self.framer.buffer.hold())
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
                self.counters.note_resync();
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
            Phase::Streaming(watchdog) => watchdog.state(),
            Phase::Paused { .. } => State::Paused,
            _ => self.shown,
        }
    }

    fn trouble(&self) -> Option<Trouble> {
        let is_paused = matches!(self.phase, Phase::Paused { .. });
        let no_mode = self.handshake.unavailable_mode.map(Trouble::NoMode);
        let warning =
            self.health().filter(|health| matches!(health, Health::Warning(_))).map(Trouble::Unwell);
        self.trouble.or(no_mode).or(warning).filter(|_| !is_paused)
    }

    fn missing(&self) -> Option<&'static str> {
        matches!(self.trouble(), Some(Trouble::NoAnswer { .. })).then_some("RPLIDAR replies")
    }

    fn rate(&self) -> u32 {
        self.rate.baud
    }

    fn account(&self) -> Account {
        let (tally, buffered) = (self.framer.buffer.tally(), self.framer.buffer.open().len());
        self.counters.account(tally, buffered, self.stream.came_and_lost())
    }

    fn model(&self) -> Option<family::Model> {
        self.model().map(described)
    }

    fn beams(&self) -> Option<usize> {
        self.stream.beams
    }

    fn partial_scan(&self) -> Option<RawScan<'_>> {
        let closed = self.framer.kind().and_then(|kind| self.stream.partial_revolution(kind))?;
        Some(self.stream.scan(closed, &self.reads, self.now))
    }

    fn other_model(&self) -> Option<family::Model> {
        let reported = self.info().and_then(|info| info.model())?;
        Model::of(&self.settings).filter(|wanted| *wanted != reported).map(|_| described(reported))
    }

    fn missing_setting(&self) -> Option<&'static str> {
        (line::Session::trouble(self) == Some(Trouble::Alike)).then_some("model or mode")
    }

    fn model_text(&self) -> Option<String> {
        let number = || self.info().map(|info| format!("0x{:02x}", info.id));
        self.model().map(|model| model.name().to_uppercase()).or_else(number)
    }

    fn stream_head(&self, reported: &str, beams: Option<usize>) -> Vec<u8> {
        let Some(kind) = self.framer.kind() else { return Vec::new() };
        let (model, modes) = (self.model(), &self.handshake.modes);
        if self.announced.is_some() && self.info().is_some() && modes.is_unambiguous(kind) {
            return Vec::new();
        }
        let sample_us = self.stream.reported_us(model, beams);
        let of_status = reported.split_whitespace().nth(1).and_then(Mode::named);
        let is_it = |mode: &Mode| sample_us.is_some_and(|us| modes.has(*mode, kind, us as f32));
        let head = StreamHead {
            info: self.info().or_else(|| Info::of_status(model, reported)),
            mode: self.handshake.mode.or(of_status.filter(is_it)),
            sample_us,
            kind,
        };
        head.encode()
    }

    fn write_details(&self, text: &mut dyn fmt::Write) {
        let _ = self.handshake.mode.map_or(Ok(()), |mode| write!(text, " {}", mode.name()));
        if let Some(Info { firmware: (major, minor), .. }) = self.info() {
            let _ = write!(text, " {major}.{minor:02}");
        }
    }

    fn scanner_time(&self) -> Option<Nanos> {
        self.stream.scanner_time
    }

    fn mark_suspect(&mut self, reasons: u8) {
        self.reads.doubt(reasons);
    }

    fn begin_at(&mut self, rate: u32, _: Nanos) {
        self.rate.begin_at(rate);
    }

    fn introduction(&self) -> Option<Introduction> {
        // The health is known, unless the scanner does not respond to that request.
        let is_asked = matches!(
            self.phase,
            Phase::Draining { .. } | Phase::Querying { query: Query::Info | Query::Health, .. }
        );
        let info = self.info().filter(|_| !is_asked)?;
        let (major, minor) = info.firmware;
        let serial: String = info.serial.iter().map(|byte| format!("{byte:02X}")).collect();
        let model = match info.model() {
            Some(_) => String::new(),
            None => format!("model 0x{:02x} (unknown), ", info.id),
        };
        let hardware = info.hardware;
        let identity = format!("{model}firmware {major}.{minor:02}, hardware {hardware}, number {serial}");
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

/// A line without a byte for this time after the stop request is quiet.
const QUIET: Nanos = 15 * MILLIS;
/// Maximum time to wait for a quiet line before the first query.
pub(crate) const DRAIN: Nanos = 60 * MILLIS;
/// A response takes some milliseconds. An adapter that collects bytes takes 16 ms more, twice.
const RESPONSE_TIMEOUT: Nanos = 70 * MILLIS;
/// Maximum time for a response over a network.
const NETWORK_TIMEOUT: Nanos = 500 * MILLIS;
/// Maximum number of attempts with a query whose responses are damaged.
const MAX_ATTEMPTS: u8 = 8;
/// Maximum time from a restart request to the boot message. A real A1 has booted after 0.67 s.
const BOOT: Nanos = 1_500 * MILLIS;
/// Minimum silence before the boot message.
const BOOT_SILENCE: Nanos = 200 * MILLIS;
/// Maximum length of a boot message, in bytes.
const BOOT_MESSAGE_LEN: u32 = 64;
/// Time from the boot message to the first query. A scanner responds after 4 ms.
const SETTLE: Nanos = 10 * MILLIS;
/// Interval between requests for the health of a scanner that reports an error.
const HEALTH_RETRY_INTERVAL: Nanos = 2_000 * MILLIS;
/// Some heads have to reach their speed before they measure.
const SPIN_UP: Nanos = 3_000 * MILLIS;
/// The motor stops after this time without subscribers. A program that restarts subscribes again in less.
const IDLE: Nanos = 5_000 * MILLIS;
const SECOND: Nanos = 1_000 * MILLIS;
