//! One link: the thread that owns a port and its topics, from the first open to the hub's end. It sleeps until bytes
//! come or a deadline passes, and does nothing twice per telegram.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use config::Link;
use lms::framer::suspect;
use lms::session::Output;
use lms::variant::{Baud, Unit};
use lms::{MILLIS, Nanos, Notice, Session, Settings, Trouble};
use port::{LineErrors, Port, Source, clock};
use rustix::event::{PollFd, PollFlags, poll};
use schema::{Failure, Flags, State, StateDirectory, Status, Wake};

use crate::control::{ControlQueue, Flow};
use crate::identity_cache::IdentityCache;
use crate::last_rate::LastRate;
use crate::learned::Slot;
use crate::link_stats::LinkStats;
use crate::pipeline::Pipeline;
use crate::process_telegram::RecordedContext;
use crate::replay::{self, ReplayPart};
use crate::service::Service;
use crate::topics::Topics;

/// A link with everything that belongs to its thread.
pub(crate) struct LinkThread<'a> {
    pub(crate) link: &'a Link,
    pub(crate) topics: Topics,
    pub(crate) account: LinkStats,
    pub(crate) around: Surroundings<'a>,
    /// What users ask for.
    pub(crate) orders: ControlQueue,
    /// What is made of the scans.
    pub(crate) pipeline: Pipeline,
    /// When the last verdict of the zones is too old to stand; `Nanos::MAX` if none stands.
    pub(crate) stale_at: Nanos,
    next_greeting: Nanos,
    pub(crate) next_status: Nanos,
    /// Why the port went away the last time, if it did so without a byte.
    pub(crate) doubt: String,
    /// What `error` was made from.
    pub(crate) facts: Option<Facts>,
    /// What is wrong, in words; empty if nothing is.
    error: String,
    /// Rates that the port cannot have, as was said.
    refused: Vec<Baud>,
    line_errors: LineErrors,
    /// What the next hub would like to know; nothing where there will be none.
    pub(crate) memory: Option<IdentityCache>,
    /// Where the sensor was found the last time; nothing on a line whose rate cannot be changed.
    pub(crate) last_rate: Option<LastRate>,
    /// Statuses in a row that said that consumers got nothing.
    pub(crate) unreached: u32,
    /// The port brings more than its line can.
    pub(crate) is_flooded: bool,
    /// What is read waited in the port, who knows for how long.
    pub(crate) is_behind: bool,
    /// The measuring mode of which was said whether it has marks.
    pub(crate) told_mode: u8,
    /// The sensor, as it turned out to be, sees too little of its circles.
    pub(crate) is_blind: bool,
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

/// What a link's error is made from.
type Facts = (State, Option<Trouble>, Option<Unit>, Option<Notice>);

/// Why a wait is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Woken {
    /// The hub shall end.
    Stop,
    /// A user wants something.
    Order,
    /// There is something to do at the port.
    Ready,
    /// The time is up.
    Timeout,
}

impl<'a> LinkThread<'a> {
    /// The thread's values; nothing happens yet.
    pub(crate) fn new(
        link: &'a Link,
        topics: Topics,
        around: Surroundings<'a>,
        orders: ControlQueue,
    ) -> Self {
        let now = clock::now();
        let account = LinkStats::new(link, now);
        LinkThread {
            link,
            topics,
            account,
            around,
            orders,
            pipeline: Pipeline::new(&link.processing),
            stale_at: Nanos::MAX,
            next_greeting: now,
            next_status: now,
            doubt: String::new(),
            facts: None,
            error: String::new(),
            refused: Vec::new(),
            line_errors: LineErrors::default(),
            memory: None,
            last_rate: None,
            unreached: 0,
            is_flooded: false,
            is_behind: false,
            told_mode: Status::MODE_UNKNOWN,
            is_blind: false,
        }
    }

    /// Runs until the hub shall end, a recording as part of `part` or alone. `report` is called once, when it is clear whether the link can work: an absent
    /// port can, one that is busy, forbidden or no tty cannot.
    pub(crate) fn run(mut self, part: Option<ReplayPart<'_>>, report: impl FnOnce(Result<(), Failure>)) {
        if let Source::File { .. } = self.link.port {
            self.topics.set_flags(Flags::REPLAYED);
        }
        // Nothing is known yet but the model to begin with: that is said before anything can come.
        let now = clock::now();
        self.topics.stale(&mut self.pipeline, now);
        self.topics.background(&mut self.pipeline, now);
        match &self.link.port {
            Source::File { path, paced } => replay::run(&mut self, part, path, *paced, report),
            Source::Tty(_) | Source::Tcp { .. } => self.attend(report),
        }
        self.hand_on(true);
    }

    /// Lets what was learned be kept, if that is news; if this is the `last` time, whatever there is.
    fn hand_on(&mut self, last: bool) {
        if let Some(slot) = self.around.slot
            && let Some((pose, model)) = self.pipeline.hand_on(last)
        {
            slot.put(pose, model);
        }
    }

    /// Drives `session` on `tty` until the hub shall end; an error says that the port is gone.
    pub(crate) fn stream(&mut self, port: &Port, session: &mut Session) -> io::Result<()> {
        let mut allowance = port.allowance(self.link.baud.rate());
        loop {
            let (watch, until) = self.drain(port, session)?;
            let rest = allowance.as_mut().and_then(|allowance| allowance.rest(clock::now(), until));
            // Also while bytes are left alone the port may go away.
            let events = if watch && rest.is_none() { PollFlags::IN } else { PollFlags::empty() };
            match self.wait(Some((port.as_fd(), events)), rest.unwrap_or(until)) {
                Woken::Stop => return Ok(()),
                Woken::Order => {
                    self.obey(Flow::Session(session));
                    continue;
                }
                Woken::Ready | Woken::Timeout => {}
            }
            if !watch {
                // The telegram's end is near: what can be done before it is not done after it.
                self.topics.prepare(&self.pipeline);
            }
            if watch
                && session.may_leave()
                && let Some(waiting) = port.waiting()
                && session.leave(clock::now(), waiting)
            {
                continue;
            }
            let mut spare = session.spare();
            if let Some(allowance) = &allowance {
                let most = spare.len().min(allowance.bytes(clock::now()).max(1));
                spare = &mut spare[..most];
            }
            let room = spare.len();
            let len = port.read(spare)?;
            let now = clock::now();
            session.commit(now, len);
            if let Some(allowance) = &mut allowance {
                allowance.take(len, room, now);
                self.is_behind = allowance.is_behind(now);
                self.watch_flood(allowance.is_flooded(now));
            }
            if len == 0 && now >= until {
                session.handle_timeout(now);
            }
        }
    }

    /// Does what the session wants, until it wants to wait: whether for bytes, and until when.
    fn drain(&mut self, port: &Port, session: &mut Session) -> io::Result<(bool, Nanos)> {
        let mut published = false;
        let (watch, until) = loop {
            match session.poll_output() {
                Output::SetBaud(baud) => {
                    // The sensor is looked for at those that the port can have.
                    if let Some(error) = port.try_baud(baud.rate())?
                        && !self.refused.contains(&baud)
                    {
                        self.refused.push(baud);
                        tracing::warn!("{}: {error}", self.link.name);
                    }
                }
                Output::Transmit { byte, not_before } => {
                    self.pause(not_before);
                    port.write(byte)?;
                    session.transmitted(clock::now());
                }
                Output::Telegram(mut received) => {
                    let counted = port.line_errors();
                    self.account.line_errors += counted;
                    let is_hit = self.line_errors.note(counted);
                    received.estimated |= self.is_behind;
                    received.reasons |= if is_hit { suspect::LINE_ERROR } else { 0 };
                    self.publish(&received, &RecordedContext::default());
                    self.wake(Wake::Telegram);
                    published = true;
                }
                Output::Rest(until) => break (false, until),
                Output::Wait { until, .. } => break (true, until),
            }
        };
        if published {
            self.line_errors.wait();
        }
        self.memory.iter_mut().for_each(|memory| memory.keep_first(session));
        let sensor = session.sensor();
        let state = if self.is_doubtful(session) { State::Absent } else { state_of(session) };
        let facts = (state, session.trouble(), sensor.unit, sensor.notices().next());
        let (.., notice) = facts;
        let changed = self.facts != Some(facts);
        if changed {
            // What is good to know is no error.
            if let Some(notice) = notice.filter(|notice| !notice.is_fault())
                && self.facts.is_none_or(|(.., before)| before != Some(notice))
            {
                tracing::info!("{}: {notice}", self.link.name);
            }
            self.facts = Some(facts);
            self.error = self.trouble(session);
            self.last_rate.iter_mut().for_each(|last| last.keep(session));
        }
        if changed || clock::now() >= self.next_status.min(self.next_greeting) {
            let error = std::mem::take(&mut self.error);
            self.show(Some(session), state, &error);
            self.error = error;
        }
        // While telegrams come there is no need for wake-ups of the status' own.
        let bound = if state == State::Streaming { Nanos::MAX } else { self.next_status };
        Ok((watch, until.min(bound)))
    }

    /// The session is over: what is wrong is not what was.
    pub(crate) fn forget(&mut self) {
        self.facts = None;
    }

    /// Wakes the consumers.
    pub(crate) fn wake(&self, why: Wake) {
        self.topics.wake(why);
    }

    /// Publishes the status if it changed or is due, and greets late joiners.
    pub(crate) fn show(&mut self, session: Option<&Session>, state: State, error: &str) {
        let now = clock::now();
        let changed = self.account.update(state, error, now);
        if changed {
            let name = &self.link.name;
            match error {
                "" => tracing::info!("{name}: {}", state.name()),
                error => tracing::warn!("{name}: {}: {error}", state.name()),
            }
        }
        if changed || now >= self.next_status {
            self.next_status = now + STATUS_PERIOD;
            let status = self.account.status(session, self.topics.loan_failed(), now);
            self.topics.status(status, now);
            if changed || state != State::Streaming {
                self.topics.wake(Wake::Status);
            }
            self.memory.iter_mut().for_each(|memory| memory.keep(session, now));
            self.hand_on(false);
            self.watch_reach();
            self.tell_mode();
        }
        if now >= self.next_greeting {
            self.next_greeting = now + GREETING_PERIOD;
            self.topics.greet();
        }
    }

    /// Sleeps until the port has one of these events or is gone, `until`, or the hub's end.
    pub(crate) fn wait(&mut self, port: Option<(BorrowedFd<'_>, PollFlags)>, until: Nanos) -> Woken {
        loop {
            let now = clock::now();
            // What was due before comes first: it may be a scan.
            if now >= self.stale_at && self.stale_at < until {
                self.stale_at = Nanos::MAX;
                self.topics.stale(&mut self.pipeline, now);
                self.topics.wake(Wake::Status);
            }
            // Whoever attaches to a silent sensor is greeted in time all the same.
            let mut bound =
                if self.account.is_streaming() { until } else { until.min(self.next_greeting.max(now)) };
            bound = bound.min(self.stale_at);
            if port.is_some_and(|(_, events)| events.is_empty()) {
                // Some drivers wake nobody who waits for no bytes.
                bound = bound.min(now + LONGEST_REST);
            }
            let span = clock::span(now, bound);
            let stop = PollFd::new(self.around.stop, PollFlags::IN);
            let orders = PollFd::new(&self.orders, PollFlags::IN);
            let woken = match port {
                Some((port, events)) => {
                    let mut fds = [stop, orders, PollFd::from_borrowed_fd(port, events)];
                    poll(&mut fds, Some(&span)).map(|_| fds.each_ref().map(is_ready))
                }
                None => {
                    let mut fds = [stop, orders];
                    poll(&mut fds, Some(&span)).map(|_| [is_ready(&fds[0]), is_ready(&fds[1]), false])
                }
            };
            self.account.wakeups += 1;
            self.around.worked.store(true, Ordering::Relaxed);
            match woken {
                Ok([true, ..]) => return Woken::Stop,
                Ok([_, true, _]) => return Woken::Order,
                Ok([.., true]) => return Woken::Ready,
                _ => {}
            }
            let now = clock::now();
            if now >= until {
                return Woken::Timeout;
            }
            if now >= self.next_greeting {
                self.next_greeting = now + GREETING_PERIOD;
                self.topics.greet();
            }
        }
    }

    /// Sleeps until `not_before`, too short a time to watch anything meanwhile.
    fn pause(&self, not_before: Nanos) {
        let now = clock::now();
        if not_before > now {
            std::thread::sleep(std::time::Duration::from_nanos(not_before - now));
        }
    }

    pub(crate) fn settings(&self, listen_only: bool) -> Settings {
        let fixed_rate = matches!(self.link.port, Source::Tcp { .. });
        Settings { variant: self.link.variant, baud: self.link.baud, listen_only, fixed_rate }
    }
}

/// The word for how far `session` is.
pub(crate) fn state_of(session: &Session) -> State {
    match session.state() {
        lms::State::Probing => State::Probing,
        lms::State::Switching => State::Switching,
        lms::State::Starting => State::Starting,
        lms::State::Streaming => State::Streaming,
        lms::State::Silent => State::Silent,
        lms::State::Paused => State::Paused,
    }
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
