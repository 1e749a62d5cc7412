//! Session with an RPLIDAR. It requests the identity of the scanner and starts a scan mode. It returns packets as they
//! arrive, and complete revolutions.
//!
//! The session stops a stream that another program has left running, and never continues it. The session could not find
//! out the mode of such a stream, because express and dense packets look alike, and a scanner does not respond to
//! requests while it streams.

use core::fmt;

use scanhub_schema::{MILLIS, Nanos, line_time};

use crate::line::{
    self, Action, ByteCounters, ClosedRevolution, Control, DeviceInfo, Event, HealthStatus, RawScan,
    ReadScheduler, ReceivedTelegram, RevolutionCounts, SessionStats, State, StreamCounters, Watchdog, family,
};
use crate::rplidar::framer::{ExpectedBytes, Framer, FramerEvent, Span};
use crate::rplidar::handshake::{Handshake, NextStep, Query, RateSearch};
use crate::rplidar::packet::PacketFormat;
use crate::rplidar::request::{
    Health, Info, Request, RequestQueue, ResponseDescriptor, ResponseType, StreamHead,
};
use crate::rplidar::stream::{LineTiming, Stream};
use crate::rplidar::{Mode, Model, describe};
use crate::settings::Settings;

/// Session with an RPLIDAR scanner.
#[derive(Clone, Debug)]
pub struct RplidarSession {
    settings: Settings,
    now: Nanos,
    phase: Phase,
    /// State that the session reports until measured data arrives.
    shown: State,
    problem: Option<Problem>,
    framer: Framer,
    reads: ReadScheduler,
    rate: RateSearch,
    requests: RequestQueue,
    /// Level to which the driver must set the line DTR.
    change_dtr: Option<bool>,
    handshake: Handshake,
    stream: Stream,
    /// Packet format of the stream and arrival time of its descriptor. `None` until the descriptor has arrived.
    announced: Option<(PacketFormat, Nanos)>,
    counters: StreamCounters,
    /// Time since which the sensor has had no subscribers.
    idle_since: Option<Nanos>,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// The session reads a recording and has not read a packet yet.
    Listening { since: Nanos },
    /// The session has sent the stop request. It sends the first query at `until` if the line is quiet, and at
    /// `at_most` even if bytes still arrive.
    Draining { attempts: u8, until: Nanos, at_most: Nanos },
    /// The session waits for the response to `query` until `until`.
    Querying { query: Query, attempts: u8, until: Nanos },
    /// The scanner is restarting. The session starts again at `until`.
    Booting { until: Nanos },
    /// The scanner reports an error. The session requests the scanner's health again at `until`.
    Unhealthy { until: Nanos },
    /// Packets are arriving.
    Streaming(Watchdog),
    /// The session is paused. If `is_idle`, the reason is that the sensor has no subscribers. Otherwise, a user has
    /// paused the session.
    Paused { is_idle: bool },
}

impl RplidarSession {
    /// Creates a session on a port that is open at the baud rate of the configured model, or at the default rate.
    pub fn new(settings: Settings, now: Nanos) -> Self {
        let mut session = RplidarSession {
            settings,
            now,
            phase: Phase::Listening { since: now },
            shown: State::Probing,
            problem: None,
            framer: Framer::new(ExpectedBytes::Nothing),
            reads: ReadScheduler::new(now),
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

    /// Returns the model that the scanner has reported. Before its report, returns the configured model.
    pub fn model(&self) -> Option<Model> {
        self.handshake.model()
    }

    /// Returns the identity that the scanner has reported.
    pub fn info(&self) -> Option<Info> {
        self.handshake.info
    }

    /// Returns the health that the scanner has reported.
    pub fn health(&self) -> Option<Health> {
        self.handshake.health
    }

    /// Returns the number of points that the scanner measures per second. Returns `None` until it is known.
    pub fn points_per_second(&self) -> Option<f32> {
        self.stream.points_per_second()
    }

    /// Returns the counters of the framer.
    pub fn byte_counters(&self) -> &ByteCounters {
        self.framer.buffer.byte_counters()
    }

    /// Returns the counts of revolutions by kind.
    pub fn revolution_counts(&self) -> RevolutionCounts {
        self.stream.revolution_counts()
    }

    /// Starts again at the current baud rate. `shown` is the session's state until measured data arrives.
    fn begin(&mut self, shown: State) {
        self.end_stream();
        self.announced = None;
        self.shown = shown;
        if self.settings.listen_only {
            self.phase = Phase::Listening { since: self.now };
            return self.framer.expect(ExpectedBytes::AnyPackets(self.handshake.ambiguous_format()));
        }
        // The kernel asserts DTR when a port is opened, which keeps the motor of an A1 off.
        self.change_dtr = Some(false);
        self.stop(0);
    }

    /// Sends the stop request, and then the first query. `attempts` is the number of earlier attempts with the first
    /// query.
    fn stop(&mut self, attempts: u8) {
        self.framer.expect(ExpectedBytes::Responses);
        self.requests = RequestQueue::default();
        self.requests.push(&Request::STOP);
        let (until, at_most) = (self.now + QUIET_TIME, self.now + MAX_DRAIN_TIME);
        self.phase = Phase::Draining { attempts, until, at_most };
    }

    /// Stops the stream and the motor. After the call, the session expects no bytes.
    fn stop_scanner(&mut self, is_idle: bool) {
        self.end_stream();
        self.framer.expect(ExpectedBytes::Nothing);
        if !self.settings.listen_only {
            self.requests = RequestQueue::default();
            self.requests.push(&Request::STOP);
            self.set_motor(false);
        }
        self.phase = Phase::Paused { is_idle };
    }

    /// Starts or stops the motor.
    fn set_motor(&mut self, is_on: bool) {
        match self.handshake.motor_request(is_on) {
            _ if self.settings.listen_only => {}
            Some(request) => self.requests.push(&request),
            // Every session clears DTR at its start, so the motor already runs.
            None if is_on => {}
            None => self.change_dtr = Some(true),
        }
    }

    /// Sends `query`. `attempts` is the number of earlier attempts. Does nothing for a recording, because the recorded
    /// program has sent the queries.
    fn query(&mut self, query: Query, attempts: u8) {
        if self.settings.listen_only {
            return;
        }
        // Otherwise, the framer would take the start of the next response for the rest of an incomplete response.
        self.framer.clear();
        self.requests.push(&query.request());
        self.phase = Phase::Querying { query, attempts, until: self.now + self.response_timeout() };
    }

    /// Restarts the timeout after a request was sent completely.
    fn on_requests_sent(&mut self) {
        let (now, timeout) = (self.now, self.response_timeout());
        match &mut self.phase {
            Phase::Querying { until, .. } => *until = now + timeout,
            Phase::Draining { until, at_most, .. } => {
                (*until, *at_most) = (now + QUIET_TIME, now + MAX_DRAIN_TIME)
            }
            _ => {}
        }
    }

    fn response_timeout(&self) -> Nanos {
        if self.settings.fixed_rate { NETWORK_TIMEOUT } else { RESPONSE_TIMEOUT }
    }

    /// Handles a response with its descriptor in `span`.
    fn on_response(&mut self, response: ResponseType, span: Span) {
        let query = if let Phase::Querying { query, .. } = self.phase { Some(query) } else { None };
        let data = &self.framer.bytes(span)[ResponseDescriptor::LEN..];
        let next = self.handshake.handle_response(query, response, data, self.rate.baud);
        self.proceed(next);
    }

    /// Handles a missing response to `query`.
    fn on_no_response(&mut self, query: Query, attempts: u8) {
        // Bytes arrived, but no valid response. The response may have been damaged, so the scanner may support the
        // request.
        let is_damaged =
            self.reads.last_byte() + self.response_timeout() > self.now && attempts < MAX_ATTEMPTS;
        match query {
            Query::Info if attempts == 0 && is_damaged => self.stop(1),
            Query::Info => self.search_next_rate(),
            _ if attempts == 0 || is_damaged => self.query(query, attempts + 1),
            _ => {
                let next = self.handshake.handle_no_response(query, self.rate.baud);
                self.proceed(next);
            }
        }
    }

    /// Carries out the next step of the handshake.
    fn proceed(&mut self, next: NextStep) {
        match next {
            NextStep::Nothing => {}
            NextStep::ScannerFound(query) => {
                self.rate.end();
                if self.shown == State::Probing {
                    self.shown = State::Starting;
                }
                self.query(query, 0);
            }
            NextStep::Query(query) => self.query(query, 0),
            NextStep::Reset => {
                self.rate.forget_stream();
                self.requests.push(&Request::RESET);
                self.phase = Phase::Booting { until: self.now + RESET_TIMEOUT };
            }
            NextStep::Unhealthy(health) => {
                self.problem = Some(Problem::Unhealthy(health));
                self.phase = Phase::Unhealthy { until: self.now + HEALTH_RETRY_INTERVAL };
            }
            NextStep::StartMotor(query) => {
                self.set_motor(true);
                self.query(query, 0);
            }
            NextStep::Scan(mode) => {
                self.stream.set_sample_us(mode.sample_us);
                self.query(mode.query(), 0);
            }
            NextStep::Restart => self.begin(self.shown),
            NextStep::Refused => {
                self.problem = Some(Problem::Refused);
                self.stop(0);
            }
        }
    }

    /// Changes to the next baud rate, and updates the duration in the problem.
    fn search_next_rate(&mut self) {
        let since = self.rate.advance(self.now, self.framer.buffer.byte_counters().read);
        self.report_no_response(since);
        self.stop(0);
    }

    /// Reports the problem that no response has arrived since `since`.
    fn report_no_response(&mut self, since: Nanos) {
        if self.problem != Some(Problem::AmbiguousPackets) {
            self.problem = self.rate.no_response_problem(since, self.now).or(self.problem);
        }
    }

    /// Handles the boot message of a scanner, which has lost its settings. `is_named` is the field of
    /// [`FramerEvent::BootMessage`].
    fn on_boot_message(&mut self, is_named: bool) {
        match self.phase {
            Phase::Paused { .. } | Phase::Listening { .. } => {}
            // The session sends the first query in any case. A stream at another baud rate may look like text
            // repeatedly.
            Phase::Draining { .. } | Phase::Querying { query: Query::Info, .. } => {
                if is_named && self.rate.take_stream() {
                    self.counters.note_restart();
                }
            }
            Phase::Booting { .. } => self.phase = Phase::Booting { until: self.now + SETTLE_TIME },
            // The rest of a packet may also look like text, but a scanner pauses before its boot message. The name
            // proves the message even if other bytes precede it. A scanner sends these bytes while its supply voltage
            // drops.
            Phase::Streaming(watchdog)
                if !is_named
                    && (watchdog.silent_at().abs_diff(self.now + Watchdog::SILENCE_TIMEOUT)
                        < BOOT_SILENCE
                        || self.framer.skipped() > PacketFormat::MAX_LEN as u32 + BOOT_MESSAGE_LEN) => {}
            // A stream whose first bytes were damaged may look like text in some parts.
            Phase::Querying { .. } if !is_named => {}
            phase => {
                if matches!(phase, Phase::Streaming(_)) {
                    self.counters.note_resync();
                }
                self.counters.note_restart();
                self.rate.forget_stream();
                self.begin(State::Starting);
                self.requests = RequestQueue::default();
                self.phase = Phase::Booting { until: self.now + SETTLE_TIME };
            }
        }
    }

    /// Handles the descriptor of a stream.
    fn on_stream_begin(&mut self) {
        match self.phase {
            // The descriptor announces another stream, whose mode is unknown. Another program has started this stream,
            // or another scanner sends it.
            Phase::Streaming(_) if !self.settings.listen_only && !self.is_repeated_announcement() => {
                self.counters.note_resync();
                self.begin(State::Starting);
            }
            Phase::Querying { query, .. } if !query.is_scan() => self.framer.expect(ExpectedBytes::Responses),
            Phase::Querying { .. } | Phase::Listening { .. } | Phase::Streaming(_) => {
                self.end_stream();
                self.announced = self.framer.kind().map(|kind| (kind, self.now));
                self.framer.kind().into_iter().for_each(|kind| self.handshake.stream_begins(kind));
                let mut watchdog = self.continue_stream();
                watchdog.await_spin_up(self.now + SPIN_UP_TIME);
                self.phase = Phase::Streaming(watchdog);
                self.counters.await_revolution(self.framer.buffer.byte_counters());
            }
            Phase::Paused { .. } => self.framer.expect(ExpectedBytes::Nothing),
            Phase::Draining { .. } | Phase::Booting { .. } | Phase::Unhealthy { .. } => {
                self.framer.expect(ExpectedBytes::Responses);
            }
        }
    }

    /// Returns whether the descriptor that has just arrived announces the session's own stream again, because a scanner
    /// responds to a request and to its repetition. A head may need a second to spin up, and another scanner or program
    /// can start a stream in this second. Only a descriptor shortly after the first descriptor therefore counts.
    fn is_repeated_announcement(&self) -> bool {
        let is_repeated = |(kind, at): (PacketFormat, Nanos)| {
            self.framer.kind() == Some(kind) && self.now < at + 2 * self.response_timeout()
        };
        !self.stream.has_begun() && self.announced.is_some_and(is_repeated)
    }

    /// Starts the stream after its first packets, or continues it after later packets. Returns the deadlines of the
    /// stream.
    fn continue_stream(&mut self) -> Watchdog {
        let mut watchdog = Watchdog::new(self.now);
        if let Phase::Streaming(known) = self.phase {
            watchdog = known;
            watchdog.note_packets(self.now);
            self.counters.continue_stream(self.framer.buffer.byte_counters());
        } else {
            self.problem = None;
            self.counters.begin_stream(self.framer.buffer.byte_counters());
        }
        self.phase = Phase::Streaming(watchdog);
        self.rate.note_stream();
        watchdog
    }

    /// Ends the stream. The next packet belongs to a new stream.
    fn end_stream(&mut self) {
        self.stream.end();
        self.reads.cancel_wait();
    }

    /// Returns the packets of `span` with their stamps, and keeps them for the assembly of revolutions.
    fn receive(&mut self, kind: PacketFormat, mut span: Span) -> ReceivedTelegram<'_> {
        self.continue_stream();
        span.reasons |= self.reads.take_suspect(span.offset + span.len as u64);
        let baud = self.rate.baud;
        let line_rate = (!self.settings.fixed_rate).then_some(baud);
        let line_timing = LineTiming { read_log: self.reads.read_log(), baud, line_rate };
        let mut stamps = None;
        if self.stream.measure_point_time(kind, span, line_timing, &self.handshake.modes) {
            stamps = self.stream.locate(kind, &mut span, &mut self.framer, line_timing, &self.handshake);
            self.counters.note_packets(self.framer.buffer.byte_counters(), span.packets);
        }
        let packet_time = line_time(kind.byte_len(), baud);
        let latest = line_timing.read_log.latest(span.offset + span.len as u64 - 1, line_rate);
        let latest = latest.saturating_sub(packet_time);
        let (first, last) = stamps.unwrap_or((latest, latest));
        let first = first.min(self.now);
        let last = self.reads.stamp_packet((last + packet_time).clamp(first, self.now.max(first)));
        ReceivedTelegram {
            bytes: self.framer.bytes(span),
            first,
            last,
            estimated: stamps.is_none(),
            reasons: span.reasons,
            count: span.packets,
            is_checked: kind.is_checked(),
            is_reply: false,
            contents: None,
        }
    }

    /// Returns the bytes of a response or descriptor as a reply.
    fn reply(&self, span: Span) -> ReceivedTelegram<'_> {
        ReceivedTelegram {
            bytes: self.framer.bytes(span),
            first: self.reads.last_byte(),
            last: self.reads.last_byte(),
            estimated: true,
            reasons: 0,
            count: span.packets,
            is_checked: false,
            is_reply: true,
            contents: None,
        }
    }

    /// Returns a complete revolution as a scan, and updates the state of the session.
    fn complete_revolution(&mut self, revolution: ClosedRevolution) -> RawScan<'_> {
        let first = self.stream.to_scan(revolution, &self.reads, self.now).first;
        self.reads.end_revolution(first);
        self.problem = None;
        if let Phase::Streaming(watchdog) = &mut self.phase {
            watchdog.note_revolution(self.now);
        }
        self.counters.await_revolution(self.framer.buffer.byte_counters());
        self.stream.to_scan(revolution, &self.reads, self.now)
    }

    /// Handles deadlines after all bytes were framed. Bytes that are not part of a packet or response do not extend a
    /// deadline.
    fn handle_deadlines(&mut self) {
        let now = self.now;
        let is_idle =
            self.settings.stop_when_idle && self.idle_since.is_some_and(|since| now >= since + IDLE_TIME);
        if is_idle && !self.settings.listen_only && !matches!(self.phase, Phase::Paused { .. }) {
            return self.stop_scanner(true);
        }
        match self.phase {
            Phase::Listening { .. } if self.framer.is_ambiguous() => {
                self.problem = Some(Problem::AmbiguousPackets)
            }
            Phase::Listening { since } => self.report_no_response(since),
            Phase::Draining { until, at_most, .. }
                if until > at_most && now >= at_most && self.rate.is_quick(now) =>
            {
                self.search_next_rate();
            }
            Phase::Draining { attempts, until, at_most } if now >= until.min(at_most) => {
                self.query(Query::Info, attempts);
            }
            Phase::Querying { query, attempts, until } if now >= until => {
                self.on_no_response(query, attempts)
            }
            Phase::Booting { until } | Phase::Unhealthy { until } if now >= until => self.begin(self.shown),
            Phase::Streaming(watchdog) if watchdog.is_silent(now) => {
                self.counters.note_resync();
                self.problem = Some(Problem::Silence);
                self.begin(State::Silent);
            }
            Phase::Streaming(watchdog) if watchdog.is_revolution_overdue(now) => {
                self.problem = self.counters.overdue_problem(
                    self.framer.buffer.byte_counters(),
                    Problem::HeadBlocked,
                    Problem::DamagedRevolutions,
                );
            }
            _ => {}
        }
    }

    /// Returns the time at which the session must act even if no byte arrives.
    fn deadline(&self) -> Nanos {
        match self.phase {
            Phase::Listening { since } => {
                // The duration in the problem changes at the next full second.
                let seconds = self.now.saturating_sub(since) / SECOND;
                since + (seconds + 1) * SECOND
            }
            Phase::Paused { .. } => Nanos::MAX,
            Phase::Draining { until, at_most, .. } => until.min(at_most),
            Phase::Querying { until, .. } | Phase::Booting { until } | Phase::Unhealthy { until } => until,
            Phase::Streaming(watchdog) => watchdog.silent_at(),
        }
    }
}

impl line::Protocol for RplidarSession {
    fn read_buffer(&mut self) -> &mut [u8] {
        let spare = self.framer.buffer.read_buffer();
        self.reads.set_buffer_len(spare.len());
        spare
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        self.reads.note_read(now, len, line::ScannerSession::state(self) == State::Streaming);
        if len > 0 {
            self.framer.buffer.commit(len);
            if let Phase::Draining { until, .. } = &mut self.phase {
                *until = now + QUIET_TIME;
            }
        }
    }

    fn handle_timeout(&mut self, now: Nanos) {
        self.now = now;
        self.framer.buffer.release(now.saturating_sub(self.reads.last_byte()));
    }

    fn handle_transmitted(&mut self, now: Nanos) {
        self.now = now;
        self.requests = RequestQueue::default();
        self.on_requests_sent();
    }

    fn poll_action(&mut self) -> Action<'_> {
        loop {
            if let Some(on) = self.change_dtr.take() {
                return Action::SetDtr(on);
            }
            if let Some(baud) = self.rate.take_change() {
                self.framer.clear();
                return Action::SetRate(baud);
            }
            if !self.requests.bytes().is_empty() {
                return Action::Transmit { bytes: self.requests.bytes(), not_before: 0 };
            }
            if let Some(closed) = self.stream.advance(&self.framer) {
                return Action::Event(Event::Scan(self.complete_revolution(closed)));
            }
            let max_packets = self.framer.kind().map_or(1, |kind| self.stream.max_packets_per_sample(kind));
            let Some(found) = self.framer.advance(max_packets) else { break };
            match found {
                FramerEvent::Reply(answer, span) => {
                    self.on_response(answer, span);
                    return Action::Event(Event::Telegram(self.reply(span)));
                }
                FramerEvent::Stream(span) => {
                    self.on_stream_begin();
                    return Action::Event(Event::Telegram(self.reply(span)));
                }
                FramerEvent::Packets(kind, span) => {
                    return Action::Event(Event::Telegram(self.receive(kind, span)));
                }
                FramerEvent::BootMessage { is_named } => self.on_boot_message(is_named),
            }
        }
        self.handle_deadlines();
        if self.change_dtr.is_some() || self.rate.needs_change || !self.requests.bytes().is_empty() {
            return self.poll_action();
        }
        self.reads.wait_action(self.now, self.deadline(), self.framer.buffer.hold_time())
    }
}

impl line::ScannerSession for RplidarSession {
    type Problem = Problem;

    fn control(&mut self, control: Control, now: Nanos) {
        self.now = now;
        match (control, self.phase) {
            (Control::Pause, _) => self.stop_scanner(false),
            (Control::Resume, Phase::Paused { is_idle: false }) => self.begin(State::Probing),
            (Control::Resume, _) => {}
            (Control::Resync, _) => {
                self.counters.note_resync();
                self.problem = None;
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
        if let Phase::Paused { is_idle: true } = self.phase {
            self.begin(State::Starting);
        }
    }

    fn end(&mut self, now: Nanos) -> bool {
        self.now = now;
        let is_active = !self.settings.listen_only && !matches!(self.phase, Phase::Paused { .. });
        if is_active {
            self.stop_scanner(false);
        }
        is_active
    }

    fn state(&self) -> State {
        match self.phase {
            Phase::Streaming(watchdog) => watchdog.state(),
            Phase::Paused { .. } => State::Paused,
            _ => self.shown,
        }
    }

    fn problem(&self) -> Option<Problem> {
        let is_paused = matches!(self.phase, Phase::Paused { .. });
        let unavailable_mode = self.handshake.unavailable_mode.map(Problem::ModeUnavailable);
        let warning =
            self.health().filter(|health| matches!(health, Health::Warning(_))).map(Problem::Unhealthy);
        self.problem.or(unavailable_mode).or(warning).filter(|_| !is_paused)
    }

    fn missing_transmission(&self) -> Option<&'static str> {
        matches!(self.problem(), Some(Problem::NoResponse { .. })).then_some("RPLIDAR replies")
    }

    fn rate(&self) -> u32 {
        self.rate.baud
    }

    fn stats(&self) -> SessionStats {
        let (tally, buffered) = (self.framer.buffer.byte_counters(), self.framer.buffer.open_bytes().len());
        self.counters.stats(tally, buffered, self.stream.received_and_lost())
    }

    fn model(&self) -> Option<family::Model> {
        self.model().map(describe)
    }

    fn beams(&self) -> Option<usize> {
        self.stream.beams
    }

    fn partial_scan(&self) -> Option<RawScan<'_>> {
        let closed = self.framer.kind().and_then(|kind| self.stream.partial_revolution(kind))?;
        Some(self.stream.to_scan(closed, &self.reads, self.now))
    }

    fn unexpected_model(&self) -> Option<family::Model> {
        let reported = self.info().and_then(|info| info.model())?;
        Model::of(&self.settings).filter(|configured| *configured != reported).map(|_| describe(reported))
    }

    fn missing_setting(&self) -> Option<&'static str> {
        (line::ScannerSession::problem(self) == Some(Problem::AmbiguousPackets)).then_some("model or mode")
    }

    fn model_text(&self) -> Option<String> {
        let number = || self.info().map(|info| format!("0x{:02x}", info.id));
        self.model().map(|model| model.name().to_uppercase()).or_else(number)
    }

    fn stream_responses(&self, reported: &str, beams: Option<usize>) -> Vec<u8> {
        let Some(kind) = self.framer.kind() else { return Vec::new() };
        let (model, modes) = (self.model(), &self.handshake.modes);
        if self.announced.is_some() && self.info().is_some() && modes.is_unambiguous(kind) {
            return Vec::new();
        }
        let sample_us = self.stream.reported_us(model, beams);
        let of_status = reported.split_whitespace().nth(1).and_then(Mode::from_name);
        let is_reported = |mode: &Mode| sample_us.is_some_and(|us| modes.has(*mode, kind, us as f32));
        let head = StreamHead {
            info: self.info().or_else(|| Info::of_status(model, reported)),
            mode: self.handshake.mode.or(of_status.filter(is_reported)),
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
        self.reads.mark_suspect(reasons);
    }

    fn set_start_rate(&mut self, rate: u32, _: Nanos) {
        self.rate.set_start_rate(rate);
    }

    fn device_info(&self) -> Option<DeviceInfo> {
        // After these phases, the session has the health, unless the scanner did not respond to the request for its
        // health.
        let is_unconfirmed = matches!(
            self.phase,
            Phase::Draining { .. } | Phase::Querying { query: Query::Info | Query::Health, .. }
        );
        let info = self.info().filter(|_| !is_unconfirmed)?;
        let (major, minor) = info.firmware;
        let serial: String = info.serial.iter().map(|byte| format!("{byte:02X}")).collect();
        let model = match info.model() {
            Some(_) => String::new(),
            None => format!("model 0x{:02x} (unknown), ", info.id),
        };
        let hardware = info.hardware;
        let identity = format!("{model}firmware {major}.{minor:02}, hardware {hardware}, number {serial}");
        Some(DeviceInfo {
            identity,
            health: self.health().map_or_else(String::new, |health| health.to_string()),
            condition: match self.health() {
                None => HealthStatus::Unknown,
                Some(Health::Good) => HealthStatus::Good,
                Some(Health::Warning(_)) => HealthStatus::Warning,
                Some(Health::Error(_)) => HealthStatus::Error,
            },
        })
    }
}

/// Reason why a session does not stream as it should.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Problem {
    /// No response arrives. In a recording, no packet arrives.
    NoResponse {
        /// Only baud rate that the session tried. `None` if it tried all rates.
        baud: Option<u32>,
        /// Time without a response in seconds, rounded down to 1, 2, 4, ..
        seconds: u32,
    },
    /// No measured data arrived for one second.
    Silence,
    /// Packets arrive, but the head does not rotate.
    HeadBlocked,
    /// No revolution is complete, because the line damages bytes.
    DamagedRevolutions,
    /// The scanner reports a warning or an error.
    Unhealthy(Health),
    /// The scanner responds, but does not start to measure.
    Refused,
    /// A recording contains packets that may have one of two formats, and does not show which format they have.
    AmbiguousPackets,
    /// The scanner uses another mode, because it does not have this mode or because the line is too slow for it.
    ModeUnavailable(Mode),
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Problem::NoResponse { baud, seconds } => {
                f.write_str("no reply at ")?;
                match baud {
                    Some(baud) => write!(f, "{baud}")?,
                    None => f.write_str("115200, 256000, 460800 and 1000000")?,
                }
                write!(f, " baud for {seconds} s: power, cable, other port?")
            }
            Problem::Silence => f.write_str("no measured data for one second"),
            Problem::HeadBlocked => {
                f.write_str("packets arrive, but the head does not rotate: is it blocked?")
            }
            Problem::DamagedRevolutions => f.write_str(
                "packets arrive, but no revolution is complete, because bytes are damaged on the line: check the \
                 cable, its ground and termination, and the adapter",
            ),
            Problem::Unhealthy(health) => write!(f, "the scanner reports: {health}"),
            Problem::Refused => f.write_str("the scanner replies, but does not start to measure"),
            Problem::AmbiguousPackets => f.write_str(
                "the packets may have either of two formats (82h or 85h): set the model or the mode",
            ),
            Problem::ModeUnavailable(mode) => {
                write!(
                    f,
                    "the scanner or its line does not support mode {}: it measures in its fastest mode",
                    mode.name()
                )
            }
        }
    }
}

/// Time without a byte after the stop request after which the line counts as quiet.
const QUIET_TIME: Nanos = 15 * MILLIS;
/// Maximum time to wait for a quiet line before the first query.
pub(crate) const MAX_DRAIN_TIME: Nanos = 60 * MILLIS;
/// Maximum time for a response on a serial line. A response takes some milliseconds, and an adapter that collects bytes
/// adds 16 ms in each direction.
const RESPONSE_TIMEOUT: Nanos = 70 * MILLIS;
/// Maximum time for a response over a network.
const NETWORK_TIMEOUT: Nanos = 500 * MILLIS;
/// Maximum number of attempts with a query whose responses are damaged.
const MAX_ATTEMPTS: u8 = 8;
/// Maximum time from a restart request to the boot message. A real A1 has booted after 0.67 s.
const RESET_TIMEOUT: Nanos = 1_500 * MILLIS;
/// Minimum silence before the boot message.
const BOOT_SILENCE: Nanos = 200 * MILLIS;
/// Maximum length of a boot message, in bytes.
const BOOT_MESSAGE_LEN: u32 = 64;
/// Time from the boot message to the first query. A scanner responds after 4 ms.
const SETTLE_TIME: Nanos = 10 * MILLIS;
/// Interval between requests for the health of a scanner that reports an error.
const HEALTH_RETRY_INTERVAL: Nanos = 2_000 * MILLIS;
/// Maximum time until a head has reached its speed. Some scanners do not measure before this time.
const SPIN_UP_TIME: Nanos = 3_000 * MILLIS;
/// Time without subscribers after which the motor stops. A program that restarts subscribes again in less time.
const IDLE_TIME: Nanos = 5_000 * MILLIS;
const SECOND: Nanos = 1_000 * MILLIS;
