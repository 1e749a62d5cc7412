//! Search for the family and the baud rate of the scanner on a line, if the family is not configured.
//!
//! A search consists of rounds, and a round of steps. Each step sets a baud rate, and then listens or sends a request:
//!
//! 1. Listen for a stream that needs no request.
//! 2. If bytes have arrived, listen at further rates for streams of scanners that should not receive a request while
//!    they stream.
//! 3. Send the requests of each family at its rates.
//!
//! In every second round, the search waits longer for replies, because some scanners are slow. If no byte has arrived
//! in a round, the search pauses after the round, except after the first round. The pauses get longer.
//!
//! The search sends only requests that no scanner of another family accepts, at any baud rate, and that change nothing
//! in the scanner. Each family declares its requests in its [`SearchSteps`]. Only a session sends resets, motor
//! requests and changes of settings, or sets the line DTR. In the first 150 ms after the port was opened, the search
//! sends no byte.
//!
//! The search is a [`Protocol`]. It is done when it has [found](Search::found) the scanner. The bytes of its last step
//! are then available from [`Search::reads`], so that the family's session can process them.

use core::fmt;

use scanhub_schema::{Family, MILLIS, Nanos, line_time};

use crate::families::probes;
use crate::line::family::{Evidence, Probe, RequestSteps, SearchSteps};
use crate::line::{Action, Protocol, SessionStats};

/// Result of a successful search.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FoundScanner {
    /// Family of the scanner.
    pub family: Family,
    /// Name of the model, if the scanner has reported it.
    pub model: Option<&'static str>,
    /// Baud rate of the line, in bits per second. `None` if the search cannot set the baud rate of the port.
    pub rate: Option<u32>,
}

/// Kind of a port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PortKind {
    /// Serial line whose baud rate the search sets.
    Serial,
    /// Serial server on the network. The user sets the baud rate in the server.
    Server,
    /// Recording, to which the search cannot send. If the stream of a family does not prove the family, the search
    /// finds this family only by recorded replies.
    Recording,
}

/// Scanner that an earlier search found on the same port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Memory {
    /// Family of the scanner.
    pub family: Family,
    /// Baud rate at which the scanner streams, in bits per second.
    pub stream_rate: u32,
    /// Baud rate at which the scanner replied while it did not stream, in bits per second. The search reported this
    /// rate as [`FoundScanner::rate`].
    pub reply_rate: u32,
}

/// Reason why the search has not found a scanner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Problem {
    /// No byte arrives.
    Silent {
        /// Duration of the search in seconds, rounded down to 10, 100, 300, 600, ..
        seconds: u32,
        /// Whether the port supports a baud rate of the family, for each family in the order of [`Family::ALL`].
        is_possible: [bool; Family::ALL.len()],
    },
    /// Bytes arrive, but they do not match any family.
    Unrecognized {
        /// Bytes per second in the last step that listened, rounded to three digits.
        bytes_per_second: u32,
    },
}

/// Baud rates at which a search tries to find the scanners of one family.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Coverage {
    /// The family.
    pub family: Family,
    /// Baud rates of the family that the port supports, in bits per second.
    pub rates: Vec<u32>,
    /// Baud rates of the family that the port has rejected, in bits per second.
    pub rejected: Vec<u32>,
    /// Part of the message after a search without success. It names the properties of the scanner that the user should
    /// check.
    pub advice: &'static str,
}

/// Search on an open port. It returns no events.
#[derive(Debug)]
pub struct Search {
    port: PortKind,
    memory: Option<Memory>,
    probes: Vec<Box<dyn Probe>>,
    phase: Phase,
    /// Index of the round.
    round: usize,
    /// Steps of the round, and the number of steps that were started or skipped.
    steps: Vec<Step>,
    entered: usize,
    /// Whether this round has sent a request to the scanner in `memory`.
    is_memory_requested: bool,
    rate: Option<u32>,
    change_rate: bool,
    /// Baud rates that the port has rejected.
    rejected: Vec<u32>,
    capture: Capture,
    /// Index of the first captured byte that may belong to a reply.
    reply_offset: usize,
    opened_at: Nanos,
    now: Nanos,
    last_byte: Nanos,
    /// Number of bytes that the search has read. `round_read` and `step_read` are this number at the start of the round
    /// and of the step.
    read: u64,
    round_read: u64,
    step_read: u64,
    step_began: Nanos,
    round_began: Nanos,
    /// Bytes per second of the last step in this round that listened and received a byte.
    step_bytes_per_second: Option<u32>,
    /// Bytes per second of the last complete round. `None` if no byte arrived in that round.
    bytes_per_second: Option<u32>,
    found: Option<FoundScanner>,
}

#[derive(Clone, Copy, Debug)]
struct Step {
    condition: StepCondition,
    /// Baud rate of the step. `None` if the search cannot set the baud rate of the port.
    rate: Option<u32>,
    action: StepAction,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum StepCondition {
    Always,
    /// Bytes have arrived in this round. The condition also holds at the start time of a round: if no time has passed,
    /// the port has rejected the rates of all earlier steps.
    Bytes,
    /// A request to the scanner in `memory` was sent in this round, no byte has arrived, or the bytes look like a
    /// stream.
    KnownScanner,
    /// No request to the scanner in `memory` was sent in this round.
    NotRequested,
}

#[derive(Clone, Copy, Debug)]
enum StepAction {
    /// Listens for the first duration. If a transmission has begun by then, listens longer, by at most the second
    /// duration.
    Listen(Nanos, Nanos),
    /// Sends the request of the probe with this index.
    Request(usize),
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// The search listens until `until`. If a transmission has begun, it listens until `at_most` at the latest.
    Listening { until: Nanos, at_most: Nanos },
    /// The search waits until it may send the request of `ask`.
    Settling { ask: RequestState, until: Nanos },
    /// The search sends the bytes of the request.
    Sending { ask: RequestState, outgoing: OutgoingRequest },
    /// The search waits for the end of the stream that the stop request has stopped.
    Draining { ask: RequestState, until: Nanos, at_most: Nanos },
    /// The search waits for the reply, with deadlines as in [`Phase::Listening`].
    Awaiting { ask: RequestState, until: Nanos, at_most: Nanos },
    /// The search waits between two rounds. A byte ends the pause.
    Pausing { until: Nanos },
}

/// State of the requests of one step.
#[derive(Clone, Copy, Debug)]
struct RequestState {
    probe: usize,
    steps: &'static RequestSteps,
    /// Remaining repetitions of the request.
    repeats: u8,
    /// Remaining repetitions of the request after damaged replies.
    retries: u8,
    /// Whether the request that is being sent is the stop request.
    is_stop: bool,
}

/// Request that is being sent, and the number of bytes that were sent. If the scanner requires gaps, bytes are sent one
/// by one.
#[derive(Clone, Copy, Debug)]
struct OutgoingRequest {
    request: &'static [u8],
    sent: usize,
    not_before: Nanos,
    /// Time at which the last byte was sent.
    sent_at: Nanos,
    restarts: u8,
}

impl Search {
    /// Returns the baud rate at which the port must be opened, in bits per second.
    pub fn opening_rate(memory: Option<Memory>) -> u32 {
        let probes = probes();
        let first =
            probes.iter().find_map(|probe| probe.search_steps().listen_steps.first().map(|step| step.rate));
        let memory = memory.and_then(|memory| memory.checked(&probes));
        memory.map(|memory| memory.stream_rate).or(first).unwrap_or(BOOT_RATE)
    }

    /// Creates a search on a port that was opened at `now`, at the [`opening_rate`](Self::opening_rate).
    pub fn new(port: PortKind, memory: Option<Memory>, now: Nanos) -> Search {
        let probes = probes();
        let mut search = Search {
            port,
            memory: memory.and_then(|memory| memory.checked(&probes)),
            probes,
            phase: Phase::Pausing { until: now },
            round: 0,
            steps: Vec::new(),
            entered: 0,
            is_memory_requested: false,
            rate: (port == PortKind::Serial).then(|| Search::opening_rate(memory)),
            change_rate: false,
            rejected: Vec::new(),
            capture: Capture::default(),
            reply_offset: 0,
            opened_at: now,
            now,
            last_byte: now,
            read: 0,
            round_read: 0,
            step_read: 0,
            step_began: now,
            round_began: now,
            step_bytes_per_second: None,
            bytes_per_second: None,
            found: None,
        };
        search.begin_round();
        search
    }

    /// Makes the search set the [`opening_rate`](Self::opening_rate) first, for a port that is open at another baud
    /// rate.
    pub fn with_rate_change(mut self) -> Search {
        self.change_rate = self.rate.is_some();
        self
    }

    /// Restricts a new search to scanners of `family`.
    pub fn restricted_to(mut self, family: Family) -> Search {
        self.probes.retain(|probe| probe.search_steps().family == family);
        self.begin_round();
        self
    }

    /// Returns the scanner that the search has found.
    pub fn found(&self) -> Option<FoundScanner> {
        self.found
    }

    /// Returns the reads of the step in which the search found the scanner, each with its time and its bytes. Pass them
    /// to the family's session before any later read.
    pub fn reads(&self) -> impl Iterator<Item = (Nanos, &[u8])> {
        self.capture.reads()
    }

    /// Returns the baud rate of the port, in bits per second. Returns `None` if it is unknown.
    pub fn rate(&self) -> Option<u32> {
        self.rate.filter(|&rate| rate != UNKNOWN_RATE)
    }

    /// Returns the number of complete rounds.
    pub fn rounds(&self) -> usize {
        self.round
    }

    /// Returns the baud rates at which the search tries to find each family, in the order of [`Family::ALL`].
    pub fn coverage(&self) -> Vec<Coverage> {
        let steps_of = |family| {
            self.probes.iter().map(|probe| probe.search_steps()).find(|steps| steps.family == family)
        };
        let all_steps = Family::ALL.into_iter().filter_map(steps_of);
        let coverage = all_steps.map(|steps| {
            let (rejected, rates) = steps.rates().into_iter().partition(|rate| self.rejected.contains(rate));
            Coverage { family: steps.family, rates, rejected, advice: steps.advice }
        });
        coverage.collect()
    }

    /// Returns the counters of the search. The bytes in [`reads`](Self::reads) count as buffered.
    pub fn stats(&self) -> SessionStats {
        let buffered = self.capture.len() as u64;
        SessionStats { read: self.read, discarded: self.read - buffered, buffered, ..SessionStats::default() }
    }

    /// Returns the reason why the search has not found a scanner. Returns `None` in the first two rounds.
    pub fn problem(&self) -> Option<Problem> {
        if self.round < 2 || self.found.is_some() {
            return None;
        }
        if let Some(bytes_per_second) = self.bytes_per_second {
            return Some(Problem::Unrecognized { bytes_per_second });
        }
        let seconds = (self.now.saturating_sub(self.opened_at) / (1_000 * MILLIS)) as u32;
        let seconds = MESSAGE_SECONDS.into_iter().rev().find(|&step| step <= seconds)?;
        let coverage = self.coverage();
        let has_rates = |family| coverage.iter().any(|it| it.family == family && !it.rates.is_empty());
        Some(Problem::Silent { seconds, is_possible: Family::ALL.map(has_rates) })
    }

    /// Ends the search if a probe has recognized a scanner.
    fn check_evidence(&mut self) {
        for probe in &self.probes {
            let steps = probe.search_steps();
            let Evidence::Found(model) = probe.evidence() else { continue };
            self.found = Some(FoundScanner { family: steps.family, model, rate: self.rate });
            if steps.request_steps.is_some_and(|requests| requests.stop.is_some())
                && self.port != PortKind::Recording
            {
                self.capture.discard(self.reply_offset);
            }
            return;
        }
    }

    /// Handles the deadline of the phase.
    fn handle_deadline(&mut self) {
        let phase = self.phase;
        match phase {
            Phase::Listening { until, at_most } if self.extend(until, at_most) => {}
            Phase::Awaiting { until, at_most, .. } if self.extend(until, at_most) => {}
            Phase::Settling { ask, .. } => self.send(ask),
            Phase::Draining { ask, .. } => self.send(RequestState { is_stop: false, ..ask }),
            Phase::Awaiting { ask, .. } if ask.retries > 0 && self.is_damaged(ask.probe) => {
                self.send(RequestState {
                    retries: ask.retries - 1,
                    is_stop: ask.steps.stop.is_some(),
                    ..ask
                });
            }
            Phase::Awaiting { ask, .. } if ask.repeats > 0 => {
                self.send(RequestState {
                    repeats: ask.repeats - 1,
                    is_stop: ask.steps.stop.is_some(),
                    ..ask
                });
            }
            Phase::Sending { .. } => {}
            Phase::Listening { .. } => {
                self.note_rate();
                self.advance();
            }
            Phase::Awaiting { .. } => self.advance(),
            Phase::Pausing { .. } => {
                self.note_rate();
                self.begin_round();
            }
        }
    }

    /// Returns whether the reply to the request of the probe with index `probe` was damaged, or has begun and is
    /// incomplete.
    fn is_damaged(&self, probe: usize) -> bool {
        matches!(self.probes[probe].evidence(), Evidence::Damaged | Evidence::Partial)
    }

    /// Extends the wait a little, up to `at_most`, if a transmission has begun. Returns whether a transmission has
    /// begun.
    fn extend(&mut self, until: Nanos, at_most: Nanos) -> bool {
        let mut probes = self.probes.iter().filter(|probe| listens_at(probe.search_steps(), self.rate));
        if self.now >= at_most || !probes.any(|probe| probe.evidence() == Evidence::Partial) {
            return false;
        }
        let later = (until.max(self.now) + EXTENSION_INTERVAL).min(at_most);
        if let Phase::Listening { until, .. } | Phase::Awaiting { until, .. } = &mut self.phase {
            *until = later;
        }
        true
    }

    /// Stores the bytes per second of a step that has listened.
    fn note_rate(&mut self) {
        let bytes = self.read - self.step_read;
        if bytes > 0 {
            self.step_bytes_per_second = Some(per_second(bytes, self.now.saturating_sub(self.step_began)));
        }
    }

    /// Starts the next step that applies, or ends the round.
    fn advance(&mut self) {
        while let Some(&step) = self.steps.get(self.entered) {
            self.entered += 1;
            if self.applies(step) {
                return self.enter(step);
            }
        }
        self.end_round();
    }

    fn applies(&self, step: Step) -> bool {
        let has_bytes = self.read > self.round_read;
        let is_stream = || self.probes.iter().any(|probe| probe.evidence() == Evidence::Stream);
        let is_possible = step.rate.is_none_or(|rate| !self.rejected.contains(&rate));
        is_possible
            && match step.condition {
                StepCondition::Always => true,
                StepCondition::Bytes => has_bytes || self.now == self.round_began,
                StepCondition::KnownScanner => self.is_memory_requested || !has_bytes || is_stream(),
                StepCondition::NotRequested => !self.is_memory_requested,
            }
    }

    fn enter(&mut self, step: Step) {
        self.set_rate(step.rate);
        self.begin_step();
        match step.action {
            StepAction::Listen(span, extension) => {
                let until = self.now.saturating_add(span);
                self.phase = Phase::Listening { until, at_most: until.saturating_add(extension) };
            }
            StepAction::Request(probe) => {
                let Some(requests) = self.probes[probe].search_steps().request_steps.as_ref() else { return };
                self.is_memory_requested |= step.condition == StepCondition::KnownScanner;
                let repeats = if self.is_slow_round() { requests.repeats.saturating_sub(1) } else { 0 };
                let ask = RequestState {
                    probe,
                    steps: requests,
                    repeats,
                    retries: MAX_RETRIES,
                    is_stop: requests.stop.is_some(),
                };
                let ready_at = if self.change_rate { self.now + requests.settle_time } else { self.now };
                self.phase = Phase::Settling { ask, until: ready_at.max(self.opened_at + SILENT_AFTER_OPEN) };
            }
        }
    }

    /// Starts to send the request of `ask`.
    fn send(&mut self, ask: RequestState) {
        let requests = ask.steps.requests;
        let reply_request = requests[self.round % requests.len()];
        let request = ask.steps.stop.filter(|_| ask.is_stop).map_or(reply_request, |stop| stop.request);
        if !ask.is_stop {
            self.probes[ask.probe].expect_reply(true);
            self.reply_offset = self.capture.len();
        }
        let outgoing = OutgoingRequest {
            request,
            sent: 0,
            not_before: self.now,
            sent_at: self.now,
            restarts: MAX_RESTARTS,
        };
        self.phase = Phase::Sending { ask, outgoing };
    }

    fn begin_step(&mut self) {
        (self.step_began, self.step_read) = (self.now, self.read);
        self.probes.iter_mut().for_each(|probe| probe.expect_reply(false));
    }

    fn set_rate(&mut self, rate: Option<u32>) {
        if self.rate == rate {
            return;
        }
        (self.rate, self.change_rate) = (rate, true);
        self.capture.discard(self.capture.len());
        self.reply_offset = 0;
        self.probes.iter_mut().for_each(|probe| probe.clear());
    }

    fn begin_round(&mut self) {
        self.plan_round();
        (self.entered, self.is_memory_requested, self.step_bytes_per_second) = (0, false, None);
        (self.round_began, self.round_read) = (self.now, self.read);
        self.advance();
    }

    /// Ends the round, and starts the pause after it. There is no pause if a byte has arrived, or after the first
    /// round.
    fn end_round(&mut self) {
        let bytes = self.read - self.round_read;
        let mean = per_second(bytes, self.now.saturating_sub(self.round_began));
        let measured = (bytes > 0).then_some(self.step_bytes_per_second.unwrap_or(mean));
        // Keep the old number if the new number is similar, so that the message does not change.
        let is_same = |old: &u32| measured.is_some_and(|new| new / 3 <= old / 2 && old / 3 <= new / 2);
        self.bytes_per_second = self.bytes_per_second.filter(is_same).or(measured);
        let pause = if bytes == 0 { PAUSES[self.round.min(PAUSES.len() - 1)] } else { 0 };
        self.round += 1;
        let boot_rate = self.probes.iter().find_map(|probe| probe.search_steps().boot_rate);
        if let Some(rate) = boot_rate.filter(|rate| !self.rejected.contains(rate))
            && pause > 0
            && self.port == PortKind::Serial
        {
            self.set_rate(Some(rate));
        }
        self.begin_step();
        self.phase = Phase::Pausing { until: self.now + pause };
    }

    /// Returns whether slow scanners have more time in this round.
    fn is_slow_round(&self) -> bool {
        self.round % 2 == 1
    }

    fn reply_timeout(&self, requests: &RequestSteps) -> Nanos {
        match self.port {
            PortKind::Serial if self.is_slow_round() => requests.reply_timeout + requests.extra_reply_time,
            PortKind::Serial => requests.reply_timeout,
            PortKind::Server | PortKind::Recording => SERVER_STEP_TIME,
        }
    }

    fn plan_round(&mut self) {
        let mut steps = Vec::new();
        let mut push = |condition, rate, action| steps.push(Step { condition, rate, action });
        match self.port {
            PortKind::Recording => push(StepCondition::Always, None, StepAction::Listen(Nanos::MAX, 0)),
            PortKind::Server => {
                push(StepCondition::Always, None, StepAction::Listen(SERVER_STEP_TIME, SERVER_STEP_TIME));
                let is_other =
                    |number: &usize| Some(self.family(*number)) != self.memory.map(|memory| memory.family);
                let mut numbers: Vec<usize> = (0..self.probes.len()).collect();
                numbers.sort_by_key(is_other);
                for number in numbers
                    .into_iter()
                    .filter(|&number| self.probes[number].search_steps().request_steps.is_some())
                {
                    push(StepCondition::Always, None, StepAction::Request(number));
                }
            }
            PortKind::Serial => {
                let memory = self.memory.filter(|_| self.round == 0);
                let mut remembered = Vec::new();
                if let Some(Memory { family, stream_rate, reply_rate }) = memory
                    && let Some(number) = (0..self.probes.len()).find(|&number| self.family(number) == family)
                {
                    let steps = self.probes[number].search_steps();
                    let telegrams = 2 * line_time(steps.max_transmission, stream_rate);
                    push(
                        StepCondition::Always,
                        Some(stream_rate),
                        StepAction::Listen(SILENT_AFTER_OPEN, telegrams),
                    );
                    if steps.request_steps.is_some() {
                        remembered.push((number, reply_rate));
                        remembered.extend((stream_rate != reply_rate).then_some((number, stream_rate)));
                    }
                }
                for &(number, rate) in &remembered {
                    push(StepCondition::KnownScanner, Some(rate), StepAction::Request(number));
                }
                for needs_bytes in [false, true] {
                    let condition = if needs_bytes { StepCondition::Bytes } else { StepCondition::Always };
                    let listens = self.probes.iter().flat_map(|probe| probe.search_steps().listen_steps);
                    for listen in listens.filter(|listen| listen.needs_bytes == needs_bytes) {
                        if memory.is_none_or(|memory| memory.stream_rate != listen.rate) {
                            push(
                                condition,
                                Some(listen.rate),
                                StepAction::Listen(listen.duration, listen.duration),
                            );
                        }
                    }
                }
                for &(number, rate) in &remembered {
                    push(StepCondition::NotRequested, Some(rate), StepAction::Request(number));
                }
                for number in 0..self.probes.len() {
                    for rate in self.rates(number) {
                        if !remembered.contains(&(number, rate)) {
                            push(StepCondition::Always, Some(rate), StepAction::Request(number));
                        }
                    }
                }
            }
        }
        self.steps = steps;
    }

    fn family(&self, number: usize) -> Family {
        self.probes[number].search_steps().family
    }

    /// Returns the baud rates at which the search sends requests of a family. The rates in `memory` come first.
    fn rates(&self, number: usize) -> Vec<u32> {
        let steps = self.probes[number].search_steps();
        let mut rates = steps.request_steps.map_or_else(Vec::new, |requests| requests.rates.to_vec());
        if let Some(memory) = self.memory.filter(|memory| memory.family == steps.family) {
            let order = [memory.reply_rate, memory.stream_rate];
            rates.sort_by_key(|rate| order.iter().position(|first| first == rate).unwrap_or(order.len()));
        }
        rates
    }
}

impl Protocol for Search {
    fn read_buffer(&mut self) -> &mut [u8] {
        self.capture.read_buffer()
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        if len == 0 || self.found.is_some() {
            return;
        }
        let removed = self.capture.commit(now, len);
        self.reply_offset = self.reply_offset.saturating_sub(removed);
        (self.last_byte, self.read) = (now, self.read + len as u64);
        match &mut self.phase {
            Phase::Pausing { until } => *until = (*until).min(now + BOOT_MESSAGE_TIME),
            Phase::Draining { ask, until, .. } => {
                *until = now + ask.steps.stop.map_or(0, |stop| stop.quiet_time)
            }
            _ => {}
        }
        for probe in &mut self.probes {
            if listens_at(probe.search_steps(), self.rate) {
                probe.receive(self.capture.last(len));
            }
        }
        self.check_evidence();
    }

    fn handle_timeout(&mut self, now: Nanos) {
        self.now = now;
        let idle = now.saturating_sub(self.last_byte);
        self.probes.iter_mut().for_each(|probe| probe.release(idle));
        self.check_evidence();
    }

    fn reject_rate(&mut self, now: Nanos) {
        self.now = now;
        self.rejected.extend(self.rate.replace(UNKNOWN_RATE));
        if !matches!(self.phase, Phase::Pausing { .. }) {
            self.advance();
        }
    }

    fn handle_transmitted(&mut self, now: Nanos) {
        self.now = now;
        // The baud rate of a serial server is unknown, so assume the slowest baud rate.
        let byte_time = line_time(1, self.rate.unwrap_or(BOOT_RATE));
        let Phase::Sending { ask, outgoing } = &mut self.phase else { return };
        outgoing.transmitted(now, byte_time, ask.steps.gap);
        if outgoing.sent < outgoing.request.len() {
            return;
        }
        let (ask, stop) = (*ask, ask.steps.stop.filter(|_| ask.is_stop));
        self.phase = match stop {
            Some(stop) => Phase::Draining { ask, until: now + stop.quiet_time, at_most: now + stop.max_wait },
            None => {
                let until = now + self.reply_timeout(ask.steps);
                Phase::Awaiting { ask, until, at_most: until + ask.steps.extra_partial_time }
            }
        };
    }

    fn is_done(&self) -> bool {
        self.found.is_some()
    }

    fn poll_action(&mut self) -> Action<'_> {
        if self.is_done() {
            return Action::Wait { until: self.now };
        }
        loop {
            if core::mem::take(&mut self.change_rate)
                && let Some(rate) = self.rate
            {
                return Action::SetRate(rate);
            }
            let until = match &self.phase {
                Phase::Sending { ask, outgoing } if outgoing.not_before <= self.now + TRANSMIT_AHEAD => {
                    let bytes = outgoing.next(ask.steps.gap);
                    return Action::Transmit { bytes, not_before: outgoing.not_before };
                }
                Phase::Sending { outgoing, .. } => outgoing.not_before,
                Phase::Draining { until, at_most, .. } => *until.min(at_most),
                Phase::Listening { until, .. }
                | Phase::Settling { until, .. }
                | Phase::Awaiting { until, .. }
                | Phase::Pausing { until } => *until,
            };
            if until > self.now {
                let holds = self.probes.iter().filter_map(|probe| probe.hold_time());
                let held_until = holds.map(|hold| self.last_byte + hold).filter(|&at| at > self.now).min();
                return Action::Wait { until: until.min(held_until.unwrap_or(Nanos::MAX)) };
            }
            self.handle_deadline();
        }
    }
}

impl Memory {
    /// Returns the memory for a search with these `probes`. Replaces a reply rate that the family does not use by the
    /// stream rate. Returns `None` if the family does not use the stream rate.
    fn checked(self, probes: &[Box<dyn Probe>]) -> Option<Memory> {
        let steps =
            probes.iter().map(|probe| probe.search_steps()).find(|steps| steps.family == self.family)?;
        let is_known = |rate| listens_at(steps, Some(rate));
        let reply_rate = if is_known(self.reply_rate) { self.reply_rate } else { self.stream_rate };
        is_known(self.stream_rate).then_some(Memory { reply_rate, ..self })
    }
}

impl OutgoingRequest {
    /// Returns the bytes to write next.
    fn next(&self, gap: Option<(Nanos, Nanos)>) -> &'static [u8] {
        let end = if gap.is_some() { self.sent + 1 } else { self.request.len() };
        &self.request[self.sent..end]
    }

    /// Updates the state after the next bytes were written at `now`. If these bytes were too late, the scanner has
    /// discarded the request, so the search restarts the request.
    fn transmitted(&mut self, now: Nanos, byte_time: Nanos, gap: Option<(Nanos, Nanos)>) {
        let Some((min_gap, max_gap)) = gap else {
            self.sent = self.request.len();
            return;
        };
        let is_late = self.sent > 0 && now.saturating_sub(self.sent_at) > byte_time + max_gap;
        self.sent_at = now;
        if is_late && self.restarts > 0 {
            (self.sent, self.restarts) = (0, self.restarts - 1);
            self.not_before = now + byte_time + 2 * max_gap;
        } else {
            self.sent += 1;
            self.not_before = now + byte_time + min_gap;
        }
    }
}

/// Captured bytes of the current step, with the times of their reads.
#[derive(Clone, Debug, Default)]
struct Capture {
    bytes: Vec<u8>,
    /// Number of stored bytes.
    len: usize,
    /// End of each read as an index of the bytes, and the time of the read.
    reads: Vec<(usize, Nanos)>,
}

impl Capture {
    fn read_buffer(&mut self) -> &mut [u8] {
        self.bytes.resize(CAPTURE_LEN + READ_LEN, 0);
        &mut self.bytes[self.len..self.len + READ_LEN]
    }

    /// Adds a read of `len` bytes. Returns the number of old bytes that were removed to make room for the next read.
    fn commit(&mut self, now: Nanos, len: usize) -> usize {
        self.len += len;
        self.reads.push((self.len, now));
        let surplus = if self.len > CAPTURE_LEN { self.len - CAPTURE_LEN / 2 } else { 0 };
        self.discard(surplus);
        surplus
    }

    /// Removes the first `len` bytes, and the reads that end within these bytes.
    fn discard(&mut self, len: usize) {
        self.bytes.copy_within(len..self.len, 0);
        self.len -= len;
        self.reads.retain_mut(|(end, _)| {
            *end = end.saturating_sub(len);
            *end > 0
        });
    }

    fn len(&self) -> usize {
        self.len
    }

    /// Returns the last `len` bytes.
    fn last(&self, len: usize) -> &[u8] {
        &self.bytes[self.len - len..self.len]
    }

    fn reads(&self) -> impl Iterator<Item = (Nanos, &[u8])> {
        let begins = core::iter::once(0).chain(self.reads.iter().map(|(end, _)| *end));
        begins.zip(&self.reads).map(|(begin, &(end, now))| (now, &self.bytes[begin..end]))
    }
}

impl Problem {
    /// Returns the message for the user of `port`, with the remedy.
    pub fn message(self, port: &str) -> String {
        match self {
            Problem::Silent { .. } => self.to_string(),
            Problem::Unrecognized { .. } => format!("{self}: stop the hub, then: scanhub probe {port}"),
        }
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Problem::Silent { seconds, is_possible } => {
                let names = |possible: bool| {
                    let families = Family::ALL.into_iter().zip(*is_possible);
                    let names = families.filter(|(_, is_possible)| *is_possible == possible);
                    names.map(|(family, _)| family.name()).collect::<Vec<_>>().join(", ")
                };
                write!(f, "no scanner replies (looked for {} for {seconds} s", names(true))?;
                if is_possible.contains(&false) {
                    write!(f, "; the port does not support the rates of {}", names(false))?;
                }
                f.write_str("): power, cable?")
            }
            Problem::Unrecognized { bytes_per_second } => {
                match (bytes_per_second / 1_000, bytes_per_second % 1_000) {
                    (0, ones) => write!(f, "{ones}")?,
                    (thousands, ones) => write!(f, "{thousands},{ones:03}")?,
                }
                f.write_str(" bytes/s arrive, but scanhub does not recognize the scanner")
            }
        }
    }
}

/// Returns whether scanners of a family may use `rate`. Returns `true` if the rate is unknown.
fn listens_at(steps: &SearchSteps, rate: Option<u32>) -> bool {
    let requests = steps.request_steps.map_or(&[][..], |requests| requests.rates);
    let mut rates = steps.listen_steps.iter().map(|listen| listen.rate).chain(requests.iter().copied());
    rate.is_none_or(|rate| rates.any(|known| known == rate))
}

/// Returns the number of bytes per second, rounded to three digits.
fn per_second(bytes: u64, span: Nanos) -> u32 {
    let exact = bytes * 1_000 * MILLIS / span.max(MILLIS);
    let unit = 10u64.pow(exact.checked_ilog10().unwrap_or(0).saturating_sub(2));
    ((exact + unit / 2) / unit * unit) as u32
}

/// Time after the port was opened in which the search sends no byte, so that it can recognize a scanner that streams.
const SILENT_AFTER_OPEN: Nanos = 150 * MILLIS;
/// Duration of a step on a serial server.
const SERVER_STEP_TIME: Nanos = 500 * MILLIS;
/// Pauses after rounds without a byte, by the index of the round. The last pause applies to all later rounds.
const PAUSES: [Nanos; 4] = [0, 500 * MILLIS, 1_000 * MILLIS, 1_500 * MILLIS];
/// Time from the first byte in a pause to the end of the pause. It is long enough for a boot message.
const BOOT_MESSAGE_TIME: Nanos = 60 * MILLIS;
/// Interval at which the search checks whether a transmission that has begun is complete.
const EXTENSION_INTERVAL: Nanos = 20 * MILLIS;
/// Maximum time by which the search passes a byte to the driver before the driver may send it.
const TRANSMIT_AHEAD: Nanos = 5 * MILLIS;
/// Maximum number of times that the search sends a request again because the reply may have been damaged.
const MAX_RETRIES: u8 = 2;
/// Maximum number of restarts of a request because a byte was late.
const MAX_RESTARTS: u8 = 3;
/// Lowest baud rate, in bits per second. It determines the speed of requests if the rate is unknown.
const BOOT_RATE: u32 = 9_600;
/// Value of `rate` after the port has rejected a baud rate.
const UNKNOWN_RATE: u32 = 0;
/// Number of captured bytes that the search keeps. The longest telegram has 814 bytes.
const CAPTURE_LEN: usize = 16 * 1_024;
/// Length of the buffer of one read, in bytes. One read of a tty never returns more bytes.
const READ_LEN: usize = 4_096;
/// Durations that a message can contain, in seconds. Two durations differ by more than a minute, because the hub logs a
/// message each time that its duration changes.
const MESSAGE_SECONDS: [u32; 7] = [10, 100, 300, 600, 1_800, 3_600, 36_000];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn late_byte_restarts_the_request_once() {
        const BYTE: Nanos = 1_000_000;
        let gap = Some((MILLIS / 10, 5 * MILLIS));
        let request = &[1, 2, 3];
        let mut outgoing = OutgoingRequest { request, sent: 0, not_before: 0, sent_at: 0, restarts: 1 };
        outgoing.transmitted(0, BYTE, gap);
        outgoing.transmitted(BYTE + 5 * MILLIS, BYTE, gap);
        assert_eq!(outgoing.sent, 2, "in time");
        let late = 2 * (BYTE + 5 * MILLIS) + 1;
        outgoing.transmitted(late, BYTE, gap);
        assert_eq!((outgoing.sent, outgoing.not_before), (0, late + BYTE + 10 * MILLIS));
        // Without a limit, the request would never be complete on a slow machine.
        outgoing.transmitted(late + 20 * MILLIS, BYTE, gap);
        outgoing.transmitted(late + 60 * MILLIS, BYTE, gap);
        assert_eq!(outgoing.sent, 2);
    }

    #[test]
    fn memory_is_limited_to_rates_of_its_family() {
        for (family, stream_rate, reply_rate, expected) in [
            (Family::Lms, 500_000, 9_600, Some((500_000, 9_600))),
            (Family::Lms, 500_000, 115_200, Some((500_000, 500_000))),
            (Family::Rplidar, 500_000, 115_200, None),
            (Family::Ld, 9_600, 230_400, None),
        ] {
            let memory = Some(Memory { family, stream_rate, reply_rate });
            let search = Search::new(PortKind::Serial, memory, 0);
            assert_eq!(search.memory.map(|memory| (memory.stream_rate, memory.reply_rate)), expected);
            assert_eq!(search.rate(), Some(Search::opening_rate(memory)));
        }
    }

    #[test]
    fn skips_families_with_only_rejected_rates() {
        let mut search = Search::new(PortKind::Serial, None, 0);
        let (ld, lms) = (crate::ld::Probe::default(), crate::lms::Probe::default());
        let rates = |probe: &dyn Probe| probe.search_steps().rates();
        search.rejected = [rates(&ld), vec![500_000]].concat();
        let coverage = search.coverage();
        let of = |family| coverage.iter().find(|it| it.family == family).expect("all families");
        assert_eq!((&of(Family::Ld).rates, &of(Family::Ld).rejected), (&vec![], &rates(&ld)));
        assert_eq!(of(Family::Lms).rates, [9_600, 19_200, 38_400]);
        assert_eq!((&of(Family::Lms).rejected[..], rates(&lms).len()), (&[500_000][..], 4));
        (search.round, search.now) = (2, 10_000 * MILLIS);
        let message = search.problem().expect("it is silent").to_string();
        let expected = "no scanner replies (looked for lms, rplidar for 10 s; the port does not support the rates of ld): \
                        power, cable?";
        assert_eq!(message, expected);
        let only = Search::new(PortKind::Serial, None, 0).restricted_to(Family::Rplidar).coverage();
        assert_eq!(only.iter().map(|it| it.family).collect::<Vec<_>>(), [Family::Rplidar]);
    }

    #[test]
    fn messages_have_the_byte_rate_and_the_port() {
        let messages = [999, 1_000, 12_400]
            .map(|bytes_per_second| Problem::Unrecognized { bytes_per_second }.message("/dev/ttyUSB0"));
        let rest = "bytes/s arrive, but scanhub does not recognize the scanner: stop the hub, then: scanhub probe \
                    /dev/ttyUSB0";
        assert_eq!(messages, ["999", "1,000", "12,400"].map(|pace| format!("{pace} {rest}")));
        assert_eq!([per_second(12_449, 1_000 * MILLIS), per_second(7, 1_000 * MILLIS)], [12_400, 7]);
        assert_eq!(per_second(0, 0), 0);
    }
}
