//! The parts of a link that do not depend on the source of its bytes: topics, status, diagnosis, requests of users, and the
//! times at which it publishes without new bytes.

use config::{Link, Processing};
use scanhub_drivers::line::{Control, RawScan, Received, Session as _};
use scanhub_drivers::{PortSession, Trouble};
use schema::{Failure, MILLIS, Nanos, Shown, State, Verb, Wake};

use crate::control::{ControlQueue, Flow};
use crate::diagnosis::Diagnosis;
use crate::link_stats::LinkStats;
use crate::process_telegram::{LinkOutput, Processed, RecordedContext};
use crate::surroundings::{Learned, Surroundings, Woken};
use crate::topics::Topics;

/// The parts of a link.
pub(crate) struct LinkCore<'a, S: Surroundings> {
    pub(crate) link: &'a Link,
    pub(crate) around: &'a S,
    pub(crate) output: LinkOutput<'a, S>,
    pub(crate) stats: LinkStats,
    pub(crate) diagnosis: Diagnosis<'a>,
    pub(crate) control: ControlQueue,
    /// When late joiners get what they would else get with the next sample.
    next_greeting: Nanos,
    /// When a status goes out without news.
    next_status: Nanos,
}

impl<'a, S: Surroundings> LinkCore<'a, S> {
    /// The parts of `link`, number `number` in the configuration, for the hub's life `boot`. Makes its topics; nothing is
    /// published yet.
    ///
    /// # Errors
    ///
    /// As [`Surroundings::medium`].
    pub(crate) fn new(
        link: &'a Link,
        number: u8,
        boot: u64,
        around: &'a S,
        control: ControlQueue,
    ) -> Result<Self, Failure> {
        let now = around.now();
        let mut topics = Topics::new(around, &link.name, number, boot)?;
        topics.set_family(link.family());
        Ok(LinkCore {
            link,
            around,
            output: LinkOutput::new(link, around, topics),
            stats: LinkStats::new(link, now),
            diagnosis: Diagnosis::new(link),
            control,
            next_greeting: now,
            next_status: now,
        })
    }

    /// Publishes how it is before anything can come.
    pub(crate) fn begin(&mut self) {
        self.output.publish_start(self.around.now());
    }

    /// The hub ends: lets be kept what was learned.
    pub(crate) fn end(&mut self) {
        self.hand_on(true);
    }

    /// The `session` on the port is over.
    pub(crate) fn close(&mut self, session: &PortSession) {
        self.diagnosis.end_flood();
        self.output.foresee(None);
        self.stats.close(session);
    }

    /// Whether its motor rests while nobody follows.
    pub(crate) fn stops_when_idle(&self) -> bool {
        self.link.scanner.settings.stop_when_idle
    }

    /// Publishes a telegram, with the scan that it may contain, or packets, and wakes the subscribers. Returns how long
    /// the verdict on the scan stays valid.
    pub(crate) fn publish(
        &mut self,
        received: &Received<'_>,
        recorded: &RecordedContext,
        is_behind: bool,
    ) -> Option<Nanos> {
        let processed = match &received.whole {
            Some(whole) => {
                let processed = self.output.process_telegram(received, whole, recorded, is_behind);
                self.output.topics.wake(Wake::Telegram);
                processed
            }
            None => {
                let processed = self.output.process_packets(received, recorded);
                self.output.topics.wake_for_packets();
                processed
            }
        };
        self.stats.note(processed);
        processed.stands_for
    }

    /// Publishes a scan whose packets were published, and wakes the subscribers. Returns how long the verdict on it
    /// stays valid.
    pub(crate) fn publish_scan(
        &mut self,
        scan: &RawScan<'_>,
        recorded: &RecordedContext,
        is_behind: bool,
    ) -> Nanos {
        let stands_for = self.output.process_revolution(scan, recorded, is_behind);
        self.output.topics.wake(Wake::Telegram);
        self.stats.note(Processed { is_suspect: scan.reasons != 0, stands_for: Some(stands_for) });
        stands_for
    }

    /// When a status goes out without news.
    pub(crate) fn next_status(&self) -> Nanos {
        self.next_status
    }

    /// Whether a status or a greeting is due at `now`.
    pub(crate) fn is_due(&self, now: Nanos) -> bool {
        now >= self.next_status.min(self.next_greeting)
    }

    /// Publishes the status if it has changed or is due, and sends late joiners what they missed. `error` is the
    /// message of the status. Returns whether a status was published.
    pub(crate) fn show(&mut self, session: Option<&PortSession>, state: State, error: &str) -> bool {
        let now = self.around.now();
        let changed = update(&mut self.stats, self.link, state, error, now);
        self.publish_status(session, state, changed, now)
    }

    /// As [`show`](Self::show), of a `session` that was examined: what is wrong is for [`Diagnosis`] to say.
    pub(crate) fn show_session(&mut self, session: &PortSession, state: State) -> bool {
        let now = self.around.now();
        let error = self.diagnosis.explanation();
        if session.family().is_some() {
            self.stats.next_search_log = 0;
        }
        let changed = if matches!(session.trouble(), Some(Trouble::Search(_))) {
            update_search(&mut self.stats, self.link, state, error, now)
        } else {
            update(&mut self.stats, self.link, state, error, now)
        };
        self.publish_status(Some(session), state, changed, now)
    }

    fn publish_status(
        &mut self,
        session: Option<&PortSession>,
        state: State,
        changed: bool,
        now: Nanos,
    ) -> bool {
        let is_due = changed || now >= self.next_status;
        if is_due {
            self.next_status = now + STATUS_PERIOD;
            let status = self.stats.status(session, self.output.topics.loan_failed(), now);
            self.output.topics.status(status, now);
            if changed || state != State::Streaming {
                self.output.topics.wake(Wake::Status);
            }
            self.hand_on(false);
            self.diagnosis.watch_line(self.stats.health());
            self.diagnosis.watch_unserved(self.output.topics.unreached(self.stats.is_streaming()));
            self.diagnosis.tell_mode(self.stats.last());
        }
        self.greet(now);
        is_due
    }

    fn greet(&mut self, now: Nanos) {
        if now >= self.next_greeting {
            self.next_greeting = now + GREETING_PERIOD;
            self.output.topics.greet();
        }
    }

    /// Lets what was learned be kept, if that is news; if this is the `last` time, whatever there is.
    fn hand_on(&mut self, last: bool) {
        if let Some(learned) = self.around.learned()
            && let Some((pose, model)) = self.output.hand_on(last)
        {
            learned.keep_background(pose, model);
        }
    }

    /// Publishes what is due, and returns when the wait must end: at `until`, or earlier if the link itself has
    /// something to do. Some drivers report the loss of a port only to a thread that waits for bytes, so a line whose
    /// bytes are `left_alone` is polled every 40 ms.
    pub(crate) fn bound(&mut self, until: Nanos, left_alone: bool) -> Nanos {
        let now = self.around.now();
        // What was due before comes first: it may be a scan.
        self.output.expire(now, until);
        // Whoever attaches to a silent sensor is greeted in time all the same.
        let greeting = if self.stats.is_streaming() { until } else { self.next_greeting.max(now) };
        let look = if left_alone { now + LONGEST_REST } else { until };
        until.min(greeting).min(self.output.stale_at()).min(look)
    }

    /// Whether a wait `until` is over now that it ended as `woken` says; else only late joiners were due.
    pub(crate) fn is_over(&mut self, woken: Woken, until: Nanos) -> bool {
        self.stats.wakeups += 1;
        let now = self.around.now();
        let is_over = woken != Woken::Timeout || now >= until;
        if !is_over {
            self.greet(now);
        }
        is_over
    }

    /// Does what users asked for, and takes over what was changed for it.
    pub(crate) fn handle_requests(&mut self, mut flow: Flow<'_>) {
        if let Some(processing) = self.control.changed() {
            self.change(&processing);
        }
        while let Some(request) = self.control.take() {
            let now = self.around.now();
            let control = match request.verb {
                Verb::Pause => Some(Control::Pause),
                Verb::Resume => Some(Control::Resume),
                Verb::Resync => Some(Control::Resync),
                Verb::Show | Verb::Reset | Verb::Freeze | Verb::Thaw | Verb::Load => None,
            };
            let outcome = match control {
                Some(control) => self.control.control(control, &mut flow, now).map(|()| None),
                None => {
                    let shown = self.output.handle(request.verb, &request.model);
                    let kept_wall_ns = self.around.learned().and_then(Learned::kept_wall_ns);
                    shown.map(|model| model.map(|model| Box::new(Shown { model, kept_wall_ns })))
                }
            };
            self.output.publish_background(now);
            self.control.answer(request.number, outcome);
        }
    }

    /// From the next scan on.
    fn change(&mut self, processing: &Processing) {
        let now = self.around.now();
        self.output.change(processing, now);
        self.stats.set_processing(processing);
        self.next_status = now;
    }
}

/// Takes over `state` and `error`, and logs them if they are new. Returns whether they are. An error that stays through
/// several states is logged once.
fn update(stats: &mut LinkStats, link: &Link, state: State, error: &str, now: Nanos) -> bool {
    let told = stats.last().last_error_text;
    let (changed, name) = (stats.update(state, error, now), &link.name);
    match error {
        _ if !changed => {}
        _ if stats.last().last_error_text == told => tracing::info!("{name}: {}", state.name()),
        "" => tracing::info!("{name}: {}", state.name()),
        error => tracing::warn!("{name}: {}: {error}", state.name()),
    }
    changed
}

/// Does the same as [`update`] during a search. Its errors may change often, because of the bytes per second in them,
/// so they are logged at most once a minute.
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
/// A port that is left alone is looked at so often whether it is still there; at the highest rate no rest is as long.
const LONGEST_REST: Nanos = 40 * MILLIS;
/// A status goes out at least so often.
const STATUS_PERIOD: Nanos = 1_000 * MILLIS;
/// A late joiner gets the last status after so long at the most.
const GREETING_PERIOD: Nanos = 100 * MILLIS;
