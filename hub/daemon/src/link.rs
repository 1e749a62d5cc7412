//! The parts of a link that do not depend on the source of its bytes: topics, status, diagnosis, requests of users, and
//! deadlines for publishing without new bytes.

use scanhub_config::{Link, Processing};
use scanhub_drivers::line::{Control, RawScan, ReceivedTelegram, ScannerSession as _};
use scanhub_drivers::{PortSession, Problem};
use scanhub_schema::{Failure, MILLIS, Nanos, ResponseModel, State, Verb, WakeEvent};

use crate::control::{ControlQueue, PauseTarget};
use crate::diagnosis::Diagnosis;
use crate::link_output::{LinkOutput, PublishOutcome, RecordedMetadata};
use crate::link_stats::LinkStats;
use crate::platform::{Platform, SavedState, WakeReason};
use crate::topics::Topics;

/// State of a link that does not depend on the source of its bytes.
pub(crate) struct LinkState<'a, S: Platform> {
    pub(crate) link: &'a Link,
    pub(crate) platform: &'a S,
    pub(crate) output: LinkOutput<'a, S>,
    pub(crate) stats: LinkStats,
    pub(crate) diagnosis: Diagnosis<'a>,
    pub(crate) control: ControlQueue,
    /// Time at which the link next searches for subscribers that use other libraries, and delivers the history to new
    /// subscribers.
    next_history: Nanos,
    /// Time at which the status is published even if it has not changed.
    next_status: Nanos,
}

impl<'a, S: Platform> LinkState<'a, S> {
    /// Creates the parts of `link`, which is number `number` in the configuration, and its topics. `boot` identifies
    /// the run of the hub. The first sample follows with [`begin`](Self::begin).
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Platform::transport`].
    pub(crate) fn new(
        link: &'a Link,
        number: u8,
        boot: u64,
        platform: &'a S,
        control: ControlQueue,
    ) -> Result<Self, Failure> {
        let now = platform.now();
        let mut topics = Topics::new(platform, &link.name, number, boot)?;
        topics.set_family(link.family());
        Ok(LinkState {
            link,
            platform,
            output: LinkOutput::new(link, platform, topics),
            stats: LinkStats::new(link, now),
            diagnosis: Diagnosis::new(link),
            control,
            next_history: now,
            next_status: now,
        })
    }

    /// Publishes the state before the first bytes arrive.
    pub(crate) fn begin(&mut self) {
        self.output.publish_start(self.platform.now());
    }

    /// Saves the background at the end of the hub.
    pub(crate) fn end(&mut self) {
        self.save_background(true);
    }

    /// Handles that `session` ends because its port was lost or closed.
    pub(crate) fn close(&mut self, session: &PortSession) {
        self.diagnosis.end_flood();
        self.output.update_early_warning(None);
        self.stats.close_session(session);
    }

    /// Returns whether the scanner's motor stops while the topics have no subscriber.
    pub(crate) fn stops_when_idle(&self) -> bool {
        self.link.scanner.settings.stop_when_idle
    }

    /// Publishes a telegram, with the scan that it may contain, or packets, and wakes the subscribers. Returns how long
    /// the verdict on the scan stays valid.
    pub(crate) fn publish(
        &mut self,
        received: &ReceivedTelegram<'_>,
        recorded: &RecordedMetadata,
        is_backlogged: bool,
    ) -> Option<Nanos> {
        let published = match &received.contents {
            Some(whole) => self.output.publish_telegram(received, whole, recorded, is_backlogged),
            None => self.output.publish_packets(received, recorded),
        };
        self.stats.note(published);
        published.verdict_lifetime
    }

    /// Publishes a scan whose packets were published, and wakes the subscribers. Returns how long the verdict on it
    /// stays valid.
    pub(crate) fn publish_scan(
        &mut self,
        scan: &RawScan<'_>,
        recorded: &RecordedMetadata,
        is_backlogged: bool,
    ) -> Nanos {
        let verdict_lifetime = self.output.publish_revolution(scan, recorded, is_backlogged);
        self.stats
            .note(PublishOutcome { is_suspect: scan.reasons != 0, verdict_lifetime: Some(verdict_lifetime) });
        verdict_lifetime
    }

    /// Returns the time at which the status is published even if it has not changed.
    pub(crate) fn next_status(&self) -> Nanos {
        self.next_status
    }

    /// Returns whether the status or the history for new subscribers is due at `now`.
    pub(crate) fn is_due(&self, now: Nanos) -> bool {
        now >= self.next_status.min(self.next_history)
    }

    /// Publishes the status if it has changed or is due, and gives new subscribers the history. `error` is the message
    /// of the status. Returns whether a status was published.
    pub(crate) fn publish_status(
        &mut self,
        session: Option<&PortSession>,
        state: State,
        error: &str,
    ) -> bool {
        let now = self.platform.now();
        let changed = update(&mut self.stats, self.link, state, error, now);
        self.publish_due_status(session, state, changed, now)
    }

    /// Publishes the status as [`publish_status`](Self::publish_status) does, with the message of [`Diagnosis`], which
    /// has examined the `session` before.
    pub(crate) fn publish_session_status(&mut self, session: &PortSession, state: State) -> bool {
        let now = self.platform.now();
        let error = self.diagnosis.message();
        if session.family().is_some() {
            self.stats.next_search_log = 0;
        }
        let changed = if matches!(session.problem(), Some(Problem::Search(_))) {
            update_search(&mut self.stats, self.link, state, error, now)
        } else {
            update(&mut self.stats, self.link, state, error, now)
        };
        self.publish_due_status(Some(session), state, changed, now)
    }

    fn publish_due_status(
        &mut self,
        session: Option<&PortSession>,
        state: State,
        changed: bool,
        now: Nanos,
    ) -> bool {
        let is_due = changed || now >= self.next_status;
        if is_due {
            self.next_status = now.saturating_add(STATUS_PERIOD);
            let status = self.stats.status(session, self.output.topics.loan_failed(), now);
            self.output.topics.publish_status(status, now);
            if changed || state != State::Streaming {
                self.output.topics.wake(WakeEvent::Status);
            }
            self.save_background(false);
            self.diagnosis.note_line(self.stats.health());
            self.diagnosis
                .note_starved_subscribers(self.output.topics.starved_subscribers(self.stats.is_streaming()));
            self.diagnosis.log_missing_marks(self.stats.last());
        }
        self.deliver_history(now);
        is_due
    }

    fn deliver_history(&mut self, now: Nanos) {
        if now >= self.next_history {
            self.next_history = now.saturating_add(HISTORY_PERIOD);
            self.output.topics.deliver_history();
        }
    }

    /// Saves the background if it is new or has learned enough. At the end of the hub (`is_last`), one new scan is
    /// enough.
    fn save_background(&mut self, is_last: bool) {
        if let Some(saved_state) = self.platform.saved_state()
            && let Some((pose, model)) = self.output.take_background_to_save(is_last)
        {
            saved_state.save_background(pose, model);
        }
    }

    /// Publishes what is due, and returns when the wait must end: at `until`, or earlier if the link itself has
    /// something to do. Some drivers report the loss of a port only to a thread that waits for bytes, so a line whose
    /// bytes stay unread (`is_unread`) is polled every 40 ms.
    pub(crate) fn next_deadline(&mut self, until: Nanos, is_unread: bool) -> Nanos {
        let now = self.platform.now();
        self.output.expire_verdict(now, until);
        // A new subscriber to a silent sensor also gets the history in time.
        let history = if self.stats.is_streaming() { until } else { self.next_history.max(now) };
        let poll = if is_unread { now + POLL_INTERVAL } else { until };
        until.min(history).min(self.output.stale_at()).min(poll)
    }

    /// Returns whether a wait that was to end at `until` has ended. `wake_reason` is the reason why the thread woke up.
    /// If only the history was due, delivers it and returns `false`.
    pub(crate) fn is_over(&mut self, wake_reason: WakeReason, until: Nanos) -> bool {
        self.stats.wakeups += 1;
        if wake_reason != WakeReason::Timeout {
            return true;
        }
        let now = self.platform.now();
        if now < until {
            self.deliver_history(now);
        }
        now >= until
    }

    /// Handles the requests of users, and applies changed settings.
    pub(crate) fn handle_requests(&mut self, mut target: PauseTarget<'_>) {
        if let Some(processing) = self.control.take_settings() {
            self.change(&processing);
        }
        while let Some(request) = self.control.take() {
            let now = self.platform.now();
            let control = match request.verb {
                Verb::Pause => Some(Control::Pause),
                Verb::Resume => Some(Control::Resume),
                Verb::Resync => Some(Control::Resync),
                Verb::Show | Verb::Reset | Verb::Freeze | Verb::Thaw | Verb::Load => None,
            };
            let outcome = match control {
                Some(control) => self.control.control(control, &mut target, now).map(|()| None),
                None => {
                    let background = self.output.handle(request.verb, &request.model);
                    let kept_wall_ns = self.platform.saved_state().and_then(SavedState::saved_wall_ns);
                    background.map(|model| model.map(|model| Box::new(ResponseModel { model, kept_wall_ns })))
                }
            };
            self.output.publish_background(now);
            self.control.report_outcome(request.id, outcome);
        }
    }

    /// Applies `processing` from the next scan on.
    fn change(&mut self, processing: &Processing) {
        let now = self.platform.now();
        self.output.change(processing, now);
        self.stats.set_processing(processing);
        self.next_status = now;
    }
}

/// Sets `state` and `error`, and logs them if they have changed. Returns whether they have. An error that stays through
/// several states is logged once.
fn update(stats: &mut LinkStats, link: &Link, state: State, error: &str, now: Nanos) -> bool {
    let before = stats.last().last_error_text;
    let changed = stats.update(state, error, now);
    if changed {
        let is_logged = stats.last().last_error_text == before;
        log_state(&link.name, state, if is_logged { "" } else { error });
    }
    changed
}

/// Logs `state` and, unless it is empty, `error`.
#[cold]
fn log_state(name: &str, state: State, error: &str) {
    match error {
        "" => tracing::info!("{name}: {}", state.name()),
        error => tracing::warn!("{name}: {}: {error}", state.name()),
    }
}

/// Does the same as [`update`] during a search. The errors of a search may change often, because they contain the bytes
/// per second. They are therefore logged at most once a minute.
fn update_search(stats: &mut LinkStats, link: &Link, state: State, error: &str, now: Nanos) -> bool {
    if error.is_empty() || now >= stats.next_search_log {
        let changed = update(stats, link, state, error, now);
        if changed && !error.is_empty() {
            stats.next_search_log = now + SEARCH_LOG_PERIOD;
        }
        return changed;
    }
    stats.update(state, error, now)
}

/// Minimum time between two log lines about a search.
const SEARCH_LOG_PERIOD: Nanos = 60_000 * MILLIS;
/// Interval between checks whether a port still exists while its bytes are left unread. At the highest baud rate, no
/// pause between two reads is longer than this.
const POLL_INTERVAL: Nanos = 40 * MILLIS;
/// Maximum time between two samples of the status.
const STATUS_PERIOD: Nanos = 1_000 * MILLIS;
/// Maximum time after which a new subscriber gets the history, and after which a subscriber that has not announced
/// itself is found.
const HISTORY_PERIOD: Nanos = 100 * MILLIS;
