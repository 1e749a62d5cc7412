//! What a link reports of itself: the state of a session and the hub's own counts as the payload of topic `status`.

use config::{Link, Processing};
use scanhub_drivers::PortSession;
use scanhub_drivers::line::Session as _;
use schema::{Counter, Counters, Family, MIN_RATE_SPAN, Nanos, State, Status};

use crate::link_output::Published;
use crate::recent::{LineHealth, Recent};

/// The link's statistics, across all sessions on its port.
pub(crate) struct LinkStats {
    status: Status,
    /// Configured measuring mode, which is reported while no reply has reported it.
    mode: Option<u8>,
    /// Counters of the sessions that ended.
    past: Counters,
    /// What the line took away lately.
    recent: Recent,
    /// As of the last status.
    health: LineHealth,
    /// Counters as they were when the rate was last computed.
    measured_at: Option<(Nanos, u64)>,
    /// Scans published.
    scans: u64,
    /// Times that the thread woke up.
    pub(crate) wakeups: u64,
    /// Telegrams that were suspect.
    suspect: u64,
    pub(crate) reconnects: u64,
    /// Errors that the line's driver counted.
    pub(crate) line_errors: u64,
    /// Earliest time of the next log line about a search.
    pub(crate) next_search_log: Nanos,
}

impl LinkStats {
    pub(crate) fn new(link: &Link, now: Nanos) -> Self {
        let mut status = Status { since_ns: now, ..Status::default() };
        status.family = number_of(link.family());
        status.set_port(&link.port.name());
        let mut stats = LinkStats {
            status,
            mode: link.scanner.settings.mode_number,
            past: Counters::default(),
            recent: Recent::new(),
            health: LineHealth::default(),
            measured_at: None,
            scans: 0,
            wakeups: 0,
            suspect: 0,
            reconnects: 0,
            line_errors: 0,
            next_search_log: 0,
        };
        stats.set_processing(&link.processing);
        stats
    }

    /// Takes over the state and the trouble of the moment; returns whether either is new.
    pub(crate) fn update(&mut self, state: State, error: &str, now: Nanos) -> bool {
        let before = (self.status.state, self.status.last_error_text);
        if self.status.state != state as u8 {
            self.status.state = state as u8;
            self.status.since_ns = now;
            self.status.rate_mhz = 0;
            self.measured_at = None;
        }
        self.status.set_last_error(error);
        before != (self.status.state, self.status.last_error_text)
    }

    /// The status with everything that `session`, if there is one, knows.
    pub(crate) fn status(&mut self, session: Option<&PortSession>, loan_failed: u64, now: Nanos) -> &Status {
        let mut counters = self.past;
        let was_searched = self.status.family == Family::UNKNOWN;
        match session {
            Some(session) => {
                session.add_counters(&mut counters);
                self.describe(session);
            }
            None => self.status.baud = 0,
        }
        counters[Counter::Suspect] = self.suspect;
        counters[Counter::Reconnects] = self.reconnects;
        counters[Counter::Wakeups] = self.wakeups;
        counters[Counter::LoanFailed] = loan_failed;
        counters[Counter::LineErrors] = self.line_errors;
        if was_searched && self.status.family != Family::UNKNOWN {
            self.recent.restart(now, &counters);
        }
        self.health = self.recent.gauge(now, &mut counters);
        self.status.counters = counters;
        let (since, scans) = *self.measured_at.get_or_insert((now, self.scans));
        if u128::from(now.saturating_sub(since)) >= MIN_RATE_SPAN.as_nanos() {
            self.status.rate_mhz = ((self.scans - scans) * 1_000_000_000_000 / (now - since)) as u32;
        }
        if now > since + RATE_WINDOW {
            self.measured_at = Some((now, self.scans));
        }
        &self.status
    }

    /// A telegram was published.
    pub(crate) fn note(&mut self, processed: Published) {
        self.suspect += u64::from(processed.is_suspect);
        self.scans += u64::from(processed.verdict_lifetime.is_some());
    }

    /// Returns the status, so that a telegram of a recording can update it.
    pub(crate) fn status_mut(&mut self) -> &mut Status {
        &mut self.status
    }

    /// Counts a whole telegram of a recording, of `len` bytes.
    pub(crate) fn note_recorded(&mut self, len: usize) {
        self.past[Counter::BytesRead] += len as u64;
        self.past[Counter::BytesInTelegrams] += len as u64;
        self.past[Counter::Telegrams] += 1;
    }

    /// Sets the family of a recording.
    pub(crate) fn set_family(&mut self, family: Family) {
        self.status.family = family as u8;
    }

    /// Takes over the configured pose, and whether a threshold for reflectors is configured.
    pub(crate) fn set_processing(&mut self, processing: &Processing) {
        self.status.set_processing(processing.pose, processing.marks.level.is_some());
    }

    /// The status as it was last.
    pub(crate) fn last(&self) -> &Status {
        &self.status
    }

    /// Returns the state of the line in the ten seconds before the last status.
    pub(crate) fn health(&self) -> LineHealth {
        self.health
    }

    /// Whether telegrams come.
    pub(crate) fn is_streaming(&self) -> bool {
        self.status.state == State::Streaming as u8
    }

    /// The session is over: its counters stay.
    pub(crate) fn close(&mut self, session: &PortSession) {
        self.describe(session);
        session.add_counters(&mut self.past);
        self.past[Counter::BytesDiscarded] += session.account().buffered;
        self.past[Counter::BytesBuffered] = 0;
    }

    fn describe(&mut self, session: &PortSession) {
        self.status.family = number_of(session.family());
        let known_rate = matches!(self.status.state(), Some(State::Streaming | State::Starting));
        self.status.baud = if known_rate { session.rate() } else { 0 };
        session.describe(&mut self.status);
        if self.status.mode == Status::MODE_UNKNOWN {
            self.status.mode = self.mode.unwrap_or(Status::MODE_UNKNOWN);
        }
    }
}

/// Returns the number of `family` in a status.
fn number_of(family: Option<Family>) -> u8 {
    family.map_or(Family::UNKNOWN, |family| family as u8)
}

/// The rate is that of the last seconds.
const RATE_WINDOW: Nanos = 5_000_000_000;
