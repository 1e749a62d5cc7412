//! Statistics of a link: the state of its session and the counters of the hub, as the payload of topic `status`.

use std::collections::VecDeque;

use scanhub_config::{Link, Processing};
use scanhub_drivers::PortSession;
use scanhub_drivers::line::ScannerSession as _;
use scanhub_schema::{Counter, Counters, Family, MILLIS, MIN_RATE_SPAN, Nanos, State, Status};

use crate::link_output::PublishOutcome;

/// Statistics of a link, across all sessions on its port.
pub(crate) struct LinkStats {
    status: Status,
    /// Configured measuring mode. The status shows it until a reply of the scanner reports the mode.
    mode: Option<u8>,
    /// Counters of the sessions that have ended.
    closed_sessions: Counters,
    window: LossWindow,
    /// State of the line as of the last status.
    health: LineHealth,
    /// Time and number of scans at the start of the measurement of the scan rate.
    measured_at: Option<(Nanos, u64)>,
    /// Number of published scans.
    scans: u64,
    /// Number of times that the thread woke up.
    pub(crate) wakeups: u64,
    /// Number of suspect telegrams.
    suspect: u64,
    pub(crate) reconnects: u64,
    /// Errors that the driver of the line has counted.
    pub(crate) line_errors: u64,
    /// Earliest time of the next log line about a search.
    pub(crate) next_search_log: Nanos,
}

/// State of a line and its scanner in the last ten seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct LineHealth {
    /// Share of the bytes that were damaged while scans arrived, 0 to 1.
    pub(crate) damaged: f64,
    /// Share of the bytes outside telegrams and packets, 0 to 1.
    pub(crate) discarded: f64,
    /// Number of telegrams that arrived.
    pub(crate) telegrams: u64,
    /// Number of restarts of the scanner.
    pub(crate) restarts: u64,
}

impl LinkStats {
    /// Creates the statistics of `link`, which exists since `now`.
    pub(crate) fn new(link: &Link, now: Nanos) -> Self {
        let mut status = Status { since_ns: now, ..Status::default() };
        status.family = family_number(link.family());
        status.set_port(&link.port.name());
        let mut stats = LinkStats {
            status,
            mode: link.scanner.settings.mode_number,
            closed_sessions: Counters::default(),
            window: LossWindow::new(),
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

    /// Sets the state and the error. Returns whether either has changed.
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

    /// Returns the status as of `now`, with the values of `session`.
    pub(crate) fn status(&mut self, session: Option<&PortSession>, loan_failed: u64, now: Nanos) -> &Status {
        let mut counters = self.closed_sessions;
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
            self.window.restart(now, &counters);
        }
        self.health = self.window.update(now, &mut counters);
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

    /// Counts a published scan, and a telegram that was marked as suspect.
    pub(crate) fn note(&mut self, published: PublishOutcome) {
        self.suspect += u64::from(published.is_suspect);
        self.scans += u64::from(published.verdict_lifetime.is_some());
    }

    /// Returns the status, so that a telegram of a recording can update it.
    pub(crate) fn status_mut(&mut self) -> &mut Status {
        &mut self.status
    }

    /// Counts a whole telegram of a recording, of `len` bytes.
    pub(crate) fn note_recorded(&mut self, len: usize) {
        self.closed_sessions[Counter::BytesRead] += len as u64;
        self.closed_sessions[Counter::BytesInTelegrams] += len as u64;
        self.closed_sessions[Counter::Telegrams] += 1;
    }

    /// Sets the family of a recording.
    pub(crate) fn set_family(&mut self, family: Family) {
        self.status.family = family as u8;
    }

    /// Sets the configured pose, and whether a threshold for reflectors is configured.
    pub(crate) fn set_processing(&mut self, processing: &Processing) {
        self.status.set_processing(processing.pose, processing.marks.level.is_some());
    }

    /// Returns the last status.
    pub(crate) fn last(&self) -> &Status {
        &self.status
    }

    /// Returns the state of the line in the ten seconds before the last status.
    pub(crate) fn health(&self) -> LineHealth {
        self.health
    }

    /// Returns whether the link streams.
    pub(crate) fn is_streaming(&self) -> bool {
        self.status.state == State::Streaming as u8
    }

    /// Handles the end of `session`, whose counters are kept.
    pub(crate) fn close_session(&mut self, session: &PortSession) {
        self.describe(session);
        session.add_counters(&mut self.closed_sessions);
        self.closed_sessions[Counter::BytesDiscarded] += session.stats().buffered;
        self.closed_sessions[Counter::BytesBuffered] = 0;
    }

    fn describe(&mut self, session: &PortSession) {
        self.status.family = family_number(session.family());
        let known_rate = matches!(self.status.state(), Some(State::Streaming | State::Starting));
        self.status.baud = if known_rate { session.rate() } else { 0 };
        session.describe(&mut self.status);
        if self.status.mode == Status::MODE_UNKNOWN {
            self.status.mode = self.mode.unwrap_or(Status::MODE_UNKNOWN);
        }
    }
}

/// Sliding window of the counters in the last ten seconds.
struct LossWindow {
    /// Counters with the time at which they were read, one second apart, the newest last.
    samples: VecDeque<(Nanos, Counters)>,
}

impl LossWindow {
    fn new() -> LossWindow {
        LossWindow { samples: VecDeque::with_capacity(MAX_SAMPLES) }
    }

    /// Restarts the window at `now`, with the `counters` of that time. Earlier bytes do not belong to the scanner.
    fn restart(&mut self, now: Nanos, counters: &Counters) {
        self.samples.clear();
        self.samples.push_back((now, *counters));
    }

    /// Sets the gauges among the `counters`, which were read at `now`. Returns the state of the line.
    fn update(&mut self, now: Nanos, counters: &mut Counters) -> LineHealth {
        while self.samples.get(1).is_some_and(|(at, _)| now.saturating_sub(*at) >= LOSS_WINDOW) {
            self.samples.pop_front();
        }
        let zero = Counters::default();
        let since = self.samples.front().map_or(&zero, |(_, counters)| counters);
        let grown = |counter| counters[counter].saturating_sub(since[counter]);
        let ppm = |part: Counter, whole: Counter| {
            (1_000_000 * grown(part)).checked_div(grown(whole)).unwrap_or(0).min(1_000_000)
        };
        let damaged = ppm(Counter::BytesDamaged, Counter::BytesRead);
        let lost = ppm(Counter::LostOnLine, Counter::DueOnLine);
        let health = LineHealth {
            damaged: damaged as f64 / 1e6,
            discarded: ppm(Counter::BytesDiscarded, Counter::BytesRead) as f64 / 1e6,
            telegrams: grown(Counter::Telegrams),
            restarts: grown(Counter::ScannerRestarts),
        };
        (counters[Counter::DamagedPpm], counters[Counter::LostPpm]) = (damaged, lost);
        if self.samples.back().is_none_or(|(at, _)| now.saturating_sub(*at) >= SAMPLE_INTERVAL) {
            self.samples.push_back((now, *counters));
        }
        health
    }
}

/// Returns the number of `family` in a status.
fn family_number(family: Option<Family>) -> u8 {
    family.map_or(Family::UNKNOWN, |family| family as u8)
}

/// Time after which the measurement of the scan rate starts again.
const RATE_WINDOW: Nanos = 5_000_000_000;
/// Length of the sliding window.
const LOSS_WINDOW: Nanos = 10_000 * MILLIS;
const SAMPLE_INTERVAL: Nanos = 1_000 * MILLIS;
/// Maximum number of samples in [`LossWindow`]: those within the window, one before it, and one at its end.
const MAX_SAMPLES: usize = (LOSS_WINDOW / SAMPLE_INTERVAL) as usize + 2;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_of_a_search_do_not_count_as_damaged() {
        let mut window = LossWindow::new();
        let mut counters = Counters::default();
        (counters[Counter::BytesRead], counters[Counter::BytesDiscarded]) = (90_000, 90_000);
        assert_eq!(window.update(0, &mut counters).discarded, 1.0);
        window.restart(MILLIS, &counters);
        assert_eq!(window.update(MILLIS, &mut counters), LineHealth::default());
        counters[Counter::BytesRead] += 1_000;
        counters[Counter::BytesDiscarded] += 100;
        assert_eq!(window.update(2 * MILLIS, &mut counters).discarded, 0.1);
    }

    #[test]
    fn shares_cover_the_last_ten_seconds() {
        let mut window = LossWindow::new();
        let mut counters = Counters::default();
        for second in 0..40 {
            counters[Counter::BytesRead] += 1000;
            counters[Counter::DueOnLine] += 40;
            if (10..20).contains(&second) {
                counters[Counter::BytesDamaged] += 500;
                counters[Counter::LostOnLine] += 10;
            }
            counters[Counter::ScannerRestarts] += u64::from(second == 12 || second == 17);
            let health = window.update(second * 1_000 * MILLIS, &mut counters);
            let restarts = [12..22, 17..27].iter().filter(|range| range.contains(&second)).count();
            assert_eq!(health.restarts, restarts as u64, "{second}");
            let ppm = (counters[Counter::DamagedPpm], counters[Counter::LostPpm]);
            match second {
                0..10 | 29.. => assert_eq!(ppm, (0, 0), "{second}"),
                19 => assert_eq!(ppm, (500_000, 250_000)),
                14 => assert_eq!(ppm, (250_000, 125_000)),
                _ => assert!(ppm.0 > 0 && ppm.0 < 500_000, "{second}: {ppm:?}"),
            }
        }
        assert_eq!(window.samples.len(), 11);
    }
}
