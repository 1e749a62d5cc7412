//! What a link's thread has, whatever the link's other end is: where its results go, what it reports of itself, what users
//! ask of it, and how it waits. It sleeps until something comes or a deadline passes. Refuses to know where bytes come from.

use std::os::fd::{BorrowedFd, OwnedFd};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use config::{Link, Processing};
use lms::session::Received;
use lms::{Control, MILLIS, Nanos, Session, Settings};
use port::{Source, clock};
use rustix::event::{PollFd, PollFlags, poll};
use schema::{Shown, State, StateDirectory, Verb, Wake};

use crate::control::{ControlQueue, Flow};
use crate::diagnosis::Diagnosis;
use crate::learned::Slot;
use crate::link_stats::LinkStats;
use crate::process_telegram::{LinkOutput, RecordedContext};
use crate::service::Service;
use crate::topics::Topics;

/// The parts of a link's thread.
pub(crate) struct LinkThread<'a> {
    pub(crate) link: &'a Link,
    pub(crate) around: Surroundings<'a>,
    pub(crate) output: LinkOutput<'a>,
    pub(crate) stats: LinkStats,
    pub(crate) diagnosis: Diagnosis<'a>,
    pub(crate) control: ControlQueue,
    /// When late joiners get what they would else get with the next sample.
    next_greeting: Nanos,
    /// When a status goes out without news.
    next_status: Nanos,
}

/// What a link has around it.
#[derive(Clone, Copy)]
pub(crate) struct Surroundings<'a> {
    /// Readable once the hub shall end.
    pub(crate) stop: &'a OwnedFd,
    /// Keeps the port when the hub is killed.
    pub(crate) service: &'a Service,
    /// The domain's directory.
    pub(crate) root: &'a Path,
    /// Where what was learned goes, for the next hub; nothing where that is not wanted.
    pub(crate) slot: Option<&'a Slot>,
    /// What outlives the machine's power; nothing where that is not wanted.
    pub(crate) state: Option<&'a StateDirectory>,
    /// Set whenever the link finished something.
    pub(crate) worked: &'a AtomicBool,
}

/// Why a wait is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Woken {
    /// The hub shall end.
    Stop,
    /// A user wants something.
    Request,
    /// There is something to do at the port.
    Ready,
    /// The time is up.
    Timeout,
}

impl<'a> LinkThread<'a> {
    /// The thread's parts; nothing happens yet.
    pub(crate) fn new(
        link: &'a Link,
        topics: Topics,
        around: Surroundings<'a>,
        control: ControlQueue,
    ) -> Self {
        let now = clock::now();
        LinkThread {
            link,
            around,
            output: LinkOutput::new(link, topics),
            stats: LinkStats::new(link, now),
            diagnosis: Diagnosis::new(link),
            control,
            next_greeting: now,
            next_status: now,
        }
    }

    /// Publishes how it is before anything can come.
    pub(crate) fn begin(&mut self) {
        self.output.publish_start(clock::now());
    }

    /// The hub ends: lets be kept what was learned.
    pub(crate) fn end(&mut self) {
        self.hand_on(true);
    }

    /// How a session with this link's sensor goes, or with a recording of one to which nobody talks.
    pub(crate) fn settings(&self, listen_only: bool) -> Settings {
        let fixed_rate = matches!(self.link.port, Source::Tcp { .. });
        Settings { variant: self.link.variant, baud: self.link.baud, listen_only, fixed_rate }
    }

    /// Publishes `received` and what is made of it, and wakes the consumers. For how long the verdict on its scan stands,
    /// where it has one.
    pub(crate) fn publish(
        &mut self,
        received: &Received<'_>,
        recorded: &RecordedContext,
        is_behind: bool,
    ) -> Option<Nanos> {
        let processed = self.output.process(received, recorded, is_behind);
        self.output.topics.wake(Wake::Telegram);
        self.stats.note(processed);
        processed.stands_for
    }

    /// When a status goes out without news.
    pub(crate) fn next_status(&self) -> Nanos {
        self.next_status
    }

    /// Whether a status or a greeting is due at `now`.
    pub(crate) fn is_due(&self, now: Nanos) -> bool {
        now >= self.next_status.min(self.next_greeting)
    }

    /// Publishes the status if it changed or is due, and greets late joiners; `error` is what is wrong, in words. Whether a
    /// status went out.
    pub(crate) fn show(&mut self, session: Option<&Session>, state: State, error: &str) -> bool {
        let now = clock::now();
        let changed = update(&mut self.stats, self.link, state, error, now);
        self.publish_status(session, state, changed, now)
    }

    /// As [`show`](Self::show), of a `session` that was examined: what is wrong is for [`Diagnosis`] to say.
    pub(crate) fn show_session(&mut self, session: &Session, state: State) -> bool {
        let now = clock::now();
        let changed = update(&mut self.stats, self.link, state, self.diagnosis.explanation(), now);
        self.publish_status(Some(session), state, changed, now)
    }

    fn publish_status(&mut self, session: Option<&Session>, state: State, changed: bool, now: Nanos) -> bool {
        let is_due = changed || now >= self.next_status;
        if is_due {
            self.next_status = now + STATUS_PERIOD;
            let status = self.stats.status(session, self.output.topics.loan_failed(), now);
            self.output.topics.status(status, now);
            if changed || state != State::Streaming {
                self.output.topics.wake(Wake::Status);
            }
            self.hand_on(false);
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
        if let Some(slot) = self.around.slot
            && let Some((pose, model)) = self.output.hand_on(last)
        {
            slot.put(pose, model);
        }
    }

    /// Sleeps until the port has one of these events or is gone, `until`, or the hub's end.
    pub(crate) fn wait(&mut self, port: Option<(BorrowedFd<'_>, PollFlags)>, until: Nanos) -> Woken {
        loop {
            let now = clock::now();
            // What was due before comes first: it may be a scan.
            self.output.expire(now, until);
            // Whoever attaches to a silent sensor is greeted in time all the same.
            let mut bound =
                if self.stats.is_streaming() { until } else { until.min(self.next_greeting.max(now)) };
            bound = bound.min(self.output.stale_at());
            if port.is_some_and(|(_, events)| events.is_empty()) {
                // Some drivers wake nobody who waits for no bytes.
                bound = bound.min(now + LONGEST_REST);
            }
            let span = clock::span(now, bound);
            let stop = PollFd::new(self.around.stop, PollFlags::IN);
            let requests = PollFd::new(&self.control, PollFlags::IN);
            let woken = match port {
                Some((port, events)) => {
                    let mut fds = [stop, requests, PollFd::from_borrowed_fd(port, events)];
                    poll(&mut fds, Some(&span)).map(|_| fds.each_ref().map(is_ready))
                }
                None => {
                    let mut fds = [stop, requests];
                    poll(&mut fds, Some(&span)).map(|_| [is_ready(&fds[0]), is_ready(&fds[1]), false])
                }
            };
            self.stats.wakeups += 1;
            self.around.worked.store(true, Ordering::Relaxed);
            match woken {
                Ok([true, ..]) => return Woken::Stop,
                Ok([_, true, _]) => return Woken::Request,
                Ok([.., true]) => return Woken::Ready,
                _ => {}
            }
            let now = clock::now();
            if now >= until {
                return Woken::Timeout;
            }
            self.greet(now);
        }
    }

    /// Does what users asked for, and takes over what was changed for it.
    pub(crate) fn handle_requests(&mut self, mut flow: Flow<'_>) {
        if let Some(processing) = self.control.changed() {
            self.change(&processing);
        }
        while let Some(request) = self.control.take() {
            let control = match request.verb {
                Verb::Pause => Some(Control::Pause),
                Verb::Resume => Some(Control::Resume),
                Verb::Resync => Some(Control::Resync),
                Verb::Show | Verb::Reset | Verb::Freeze | Verb::Thaw | Verb::Load => None,
            };
            let outcome = match control {
                Some(control) => self.control.control(control, &mut flow).map(|()| None),
                None => {
                    let shown = self.output.handle(request.verb, &request.model);
                    let kept_wall_ns = self.around.slot.and_then(Slot::kept_wall_ns);
                    shown.map(|model| model.map(|model| Box::new(Shown { model: *model, kept_wall_ns })))
                }
            };
            self.output.publish_background(clock::now());
            self.control.answer(request.number, outcome);
        }
    }

    /// From the next scan on.
    fn change(&mut self, processing: &Processing) {
        let now = clock::now();
        self.output.change(processing, now);
        self.stats.set_pose(processing.pose);
        self.next_status = now;
    }
}

/// Takes over `state` and `error`, and logs them if they are new; whether they are.
fn update(stats: &mut LinkStats, link: &Link, state: State, error: &str, now: Nanos) -> bool {
    let (changed, name) = (stats.update(state, error, now), &link.name);
    match error {
        _ if !changed => {}
        "" => tracing::info!("{name}: {}", state.name()),
        error => tracing::warn!("{name}: {}: {error}", state.name()),
    }
    changed
}

fn is_ready(fd: &PollFd<'_>) -> bool {
    !fd.revents().is_empty()
}

/// A port that is left alone is looked at so often whether it is still there; at the highest rate no rest is as long.
const LONGEST_REST: Nanos = 40 * MILLIS;
/// A status goes out at least so often.
const STATUS_PERIOD: Nanos = 1_000 * MILLIS;
/// A late joiner gets the last status after so long at the most.
const GREETING_PERIOD: Nanos = 100 * MILLIS;
