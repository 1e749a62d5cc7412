//! Interface to the client library: subscriptions to several topics or to the verdict of a robot, and the samples that
//! a program keeps.
//!
//! A program may use a subscription, and drop samples, in any thread. Subscriptions and samples are `Send` but not
//! `Sync`, so each of them is in a mutex.
#![allow(unsafe_code)]

use std::collections::VecDeque;
use std::mem;
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::PathBuf;
use std::process;
use std::ptr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use scanhub_client::streams::{Change, Sample as AnySample, Session, Source, find};
use scanhub_client::{
    Domain, ErrorKind, Header, PollableSubscriber, Publication, Robot, RobotSubscriber, Silence, Subscriber,
    SubscriberBuilder, Tilt, Topic, Wait, domain_candidates,
};
use scanhub_schema::Failure;

use crate::error::Error;
use crate::sample::{Memory, Sample};

type ClientError = scanhub_client::Error;

/// Maximum duration of one wait in the client library. Between two waits, the caller handles signals.
const MAX_WAIT: Duration = Duration::from_millis(100);

/// Time from the start of a subscription until the program gets a warning about topics without a first sample, if there
/// is a reason for the silence.
const WARN_AFTER: Duration = Duration::from_secs(2);

/// Interval at which the check for a reason is repeated, after the first check has found none.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// Topic of a sensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Name {
    pub(crate) sensor: Arc<str>,
    pub(crate) topic: Topic,
}

/// Domain and root directory as the program names them.
#[derive(Clone, Debug, Default)]
pub(crate) struct DomainOptions {
    pub(crate) domain: Option<String>,
    pub(crate) root: Option<PathBuf>,
}

impl DomainOptions {
    /// Returns the locations in which the domain may be.
    pub(crate) fn candidates(&self) -> Result<Vec<Domain>, Error> {
        let base = self.root.as_deref().map(std::path::absolute).transpose();
        let base = base.map_err(|error| Error::new("Impossible", format!("root: {error}"), ""))?;
        Ok(domain_candidates(self.domain.as_deref(), base.as_deref())?)
    }

    /// Returns the location of the running hub.
    pub(crate) fn live_domain(&self) -> Result<Domain, Error> {
        Ok(find(&self.candidates()?)?)
    }

    /// Returns the location in which a program publishes.
    fn publish_domain(&self) -> Result<Domain, Error> {
        match self.root {
            Some(_) => Ok(self.candidates()?.remove(0)),
            None => Ok(scanhub_client::publish_domain(self.domain.as_deref())?),
        }
    }
}

/// Cell with a value that one thread at a time uses. A child after `fork` neither uses nor drops the value, because the
/// value belongs to the parent.
pub(crate) struct ForkSafeCell<T> {
    value: Mutex<Option<T>>,
    process: u32,
    busy: AtomicBool,
}

impl<T> ForkSafeCell<T> {
    pub(crate) fn new(value: T) -> ForkSafeCell<T> {
        ForkSafeCell { value: Mutex::new(Some(value)), process: process::id(), busy: AtomicBool::new(false) }
    }

    /// Reserves the value for one thread until the result is dropped.
    pub(crate) fn reserve(&self) -> Result<Reservation<'_>, Error> {
        if !self.is_own() {
            let remedy = "a child process after a fork makes its own";
            return Err(Error::new("Failure", "this object belongs to the parent process", remedy));
        }
        if self.busy.swap(true, Ordering::Acquire) {
            let remedy = "make one for each thread";
            return Err(Error::new("Failure", "another thread or task uses this object", remedy));
        }
        Ok(Reservation(&self.busy))
    }

    /// Returns whether this process created the value.
    pub(crate) fn is_own(&self) -> bool {
        self.process == process::id()
    }

    /// Waits until other threads have finished with the value, and calls `apply` with the value. Returns `None` if the
    /// value was taken or belongs to the parent.
    pub(crate) fn with<R>(&self, apply: impl FnOnce(&mut T) -> R) -> Option<R> {
        // Do not lock in a child, because a thread of the parent may have held the lock at the fork.
        if self.is_own() { self.lock().as_mut().map(apply) } else { None }
    }

    /// Takes the value, if this process created it.
    pub(crate) fn take(&self) -> Option<T> {
        if self.is_own() { self.lock().take() } else { None }
    }

    fn lock(&self) -> MutexGuard<'_, Option<T>> {
        self.value.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T> Drop for ForkSafeCell<T> {
    fn drop(&mut self) {
        if !self.is_own() {
            mem::forget(self.value.get_mut().unwrap_or_else(PoisonError::into_inner).take());
        }
    }
}

/// Reservation of the value in a [`ForkSafeCell`], until it is dropped.
pub(crate) struct Reservation<'a>(&'a AtomicBool);

impl Drop for Reservation<'_> {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Release);
    }
}

/// Source of items, with or without a descriptor to poll.
pub(crate) trait PollableSource: Sized + Send {
    /// Received item.
    type Item;

    /// Returns the next item that has arrived. Returns `None` if no item has arrived, or if notices must be taken
    /// first.
    fn try_next(&mut self) -> Result<Option<Self::Item>, Error>;

    /// Sleeps until an item may have arrived, for at most `longest` and at most 0.1 s.
    fn wait(&mut self, longest: Duration) -> Result<(), Error>;

    /// Changes the method of waiting to events, if no method was chosen yet, and returns the descriptor to poll.
    fn descriptor(&mut self) -> Result<i32, Error>;

    /// Leaves the domain permanently.
    fn leave(&mut self);

    /// Returns whether the source has left the domain.
    fn has_left(&self) -> bool;

    /// Returns whether a hub or listener publishes in the domain, as of the last check.
    fn hub_is_running(&self) -> bool;

    /// Returns the time since the last sample, or since the start if there was no sample. The result includes time
    /// during which the machine was suspended.
    fn silent_for(&self) -> Duration;

    /// Returns the oldest notice about the hub that was not returned yet.
    fn next_notice(&mut self) -> Option<&'static str> {
        None
    }

    /// Returns the time of the next check for a warning. It is `None` after the warning, and if there is nothing to
    /// warn about.
    fn warn_at(&mut self) -> &mut Option<Instant>;

    /// Returns the distinct reasons why nothing was received since the start. The list is empty if nothing is wrong. A
    /// subscription to several topics checks the topics without a first sample.
    fn why_silent(&mut self) -> Vec<Silence>;

    /// Returns the time until [`warning`](Self::warning) must be called, or `None` if no check for a warning is
    /// scheduled.
    fn warning_due(&mut self) -> Option<Duration> {
        self.warn_at().map(|at| at.saturating_duration_since(Instant::now()))
    }

    /// Returns the reason why nothing was received, as a warning. Returns it only once, and only after [`WARN_AFTER`].
    fn warning(&mut self) -> Option<Error> {
        self.warn_at().take_if(|at| *at <= Instant::now())?;
        let reason = Error::of_silence(&self.why_silent());
        if reason.is_none() {
            *self.warn_at() = Some(Instant::now() + CHECK_INTERVAL);
        }
        reason
    }

    /// Returns the error for a silence of `timeout` seconds.
    fn silence(&mut self, timeout: f64) -> Error {
        Error::new("Silent", format!("no verdict in {timeout} s"), "")
    }
}

/// Subscription to one or more topics.
pub(crate) struct Topics {
    session: Session,
    sources: Vec<TopicState>,
    /// Index of the source that is polled next. The sources are polled in turn, so that a topic with many samples does
    /// not delay the samples of other topics.
    next_source: usize,
    wait: Option<Wait>,
    /// Descriptor to poll, if the subscription waits by event.
    descriptor: Option<Arc<OwnedFd>>,
    notices: VecDeque<&'static str>,
    /// Time of the next check for a warning; `None` before the method of waiting is set, after the warning, and when
    /// all topics have had a sample.
    warn_at: Option<Instant>,
    has_left: bool,
}

struct TopicState {
    name: Name,
    source: Source,
    last: Header,
    /// Whether the topic has had no sample yet.
    is_first: bool,
}

impl Topics {
    pub(crate) fn new(names: Vec<Name>, domain_options: &DomainOptions) -> Result<Topics, Error> {
        let sources = names.into_iter().map(|name| {
            let source = Source::new(&name.sensor, name.topic);
            TopicState { name, source, last: Header::default(), is_first: true }
        });
        Ok(Topics {
            session: Session::new(domain_options.candidates()?),
            sources: sources.collect(),
            next_source: 0,
            wait: None,
            descriptor: None,
            notices: VecDeque::new(),
            warn_at: None,
            has_left: false,
        })
    }

    fn check_and_receive(&mut self) -> Result<Option<(usize, AnySample)>, Error> {
        loop {
            // Deliver notices before samples, so that a callback that fails does not lose a sample.
            if !self.notices.is_empty() {
                return Ok(None);
            }
            // Receive samples before the check for the hub, because the check takes longer than receiving a sample.
            if let Some(received) = self.receive(true)? {
                return Ok(Some(received));
            }
            self.check_hub()?;
            if self.session.domain().is_none() {
                let error = self.session.no_hub_here();
                if error.kind() == ErrorKind::OtherUser {
                    return Err(error.into());
                }
            }
            if !self.notices.is_empty() {
                continue;
            }
            if let Some(received) = self.receive(false)? {
                return Ok(Some(received));
            }
            if self.wait != Some(Wait::Event) || !self.session.rearm_descriptor(self.left())? {
                return Ok(None);
            }
        }
    }

    /// Checks for the hub, and queues notices about its changes.
    fn check_hub(&mut self) -> Result<(), Error> {
        let Change { ended, started } = self.session.check_hub()?;
        self.notices.extend(ended.map(|_| "hub_gone"));
        self.notices.extend(started.map(|_| "hub_back"));
        Ok(())
    }

    fn receive(&mut self, only_subscribed: bool) -> Result<Option<(usize, AnySample)>, Error> {
        for _ in 0..self.sources.len() {
            let index = self.next_source;
            self.next_source = (index + 1) % self.sources.len();
            let source = &mut self.sources[index].source;
            if only_subscribed && !source.subscribed() {
                continue;
            }
            match source.receive(&mut self.session) {
                Ok(None) => {}
                Ok(Some(sample)) => return Ok(Some((index, sample))),
                Err(ClientError::TooManyHeld) => {
                    let Name { sensor, topic } = &self.sources[index].name;
                    let what = format!(
                        "four samples of {sensor}/{} are kept, and no more are possible",
                        topic.name()
                    );
                    return Err(Error::new(
                        "Held",
                        what,
                        "drop them and their views, or keep `sample.copy()`",
                    ));
                }
                Err(error) => return Err(error.into()),
            }
        }
        Ok(None)
    }

    /// Sets the method of waiting, and starts the time until a warning.
    fn begin(&mut self, wait: Wait) {
        (self.wait, self.warn_at) = (Some(wait), Some(Instant::now() + WARN_AFTER));
    }

    fn left(&self) -> Option<Duration> {
        self.sources.iter().filter_map(|followed| followed.source.time_left()).min()
    }

    /// Returns the distinct reasons for the silence of the sources for which `is_checked` returns true.
    fn reasons(&mut self, is_checked: impl Fn(&TopicState) -> bool) -> Vec<Silence> {
        let mut reasons = Vec::new();
        // Check for the hub first, because the sources also check for it, but queue no notices. An error is ignored
        // here, because the sources return the same error.
        let _ = self.check_hub();
        for followed in self.sources.iter_mut().filter(|followed| is_checked(followed)) {
            match followed.source.why_silent(&mut self.session) {
                Silence::Waiting => {}
                // This reason applies to all sources, so the others need no check.
                reason @ (Silence::NoHub { .. } | Silence::OtherUser { .. }) => return vec![reason],
                reason if reasons.contains(&reason) => {}
                reason => reasons.push(reason),
            }
        }
        reasons
    }
}

impl PollableSource for Topics {
    type Item = Sample;

    fn leave(&mut self) {
        (self.has_left, self.warn_at) = (true, None);
        self.notices.clear();
        // Samples that the program keeps stay readable.
        self.sources.clear();
        self.session = Session::new(Vec::new());
    }

    fn has_left(&self) -> bool {
        self.has_left
    }

    fn try_next(&mut self) -> Result<Option<Sample>, Error> {
        if self.wait.is_none() {
            self.begin(Wait::Doorbell);
        }
        let Some((index, sample)) = self.check_and_receive()? else { return Ok(None) };
        let followed = &mut self.sources[index];
        let header = sample.header().copied();
        let restarted = header.is_some_and(|header| !followed.is_first && header.boot != followed.last.boot);
        if let Some(header) = header {
            (followed.last, followed.is_first) = (header, false);
        }
        let (name, header) = (followed.name.clone(), followed.last);
        self.warn_at.take_if(|_| self.sources.iter().all(|followed| !followed.is_first));
        let (missed, stale) = (sample.missed(), matches!(&sample, AnySample::Zones(update) if update.stale));
        let memory = match &sample {
            // The client library has already copied the zones.
            AnySample::Zones(_) => Memory::copy_of(sample.bytes()),
            _ => {
                let bytes = sample.bytes();
                let (address, len) = (bytes.as_ptr().expose_provenance(), bytes.len());
                let is_of_words = matches!(
                    sample,
                    AnySample::Scan(_)
                        | AnySample::Foreground(_)
                        | AnySample::Background(_)
                        | AnySample::Cloud(_)
                );
                Memory::Hub(SharedPayload {
                    address,
                    len,
                    is_slice: is_of_words,
                    _sample: ForkSafeCell::new(sample),
                })
            }
        };
        Ok(Some(Sample { name, header, missed, restarted, stale, memory: Arc::new(memory) }))
    }

    fn wait(&mut self, longest: Duration) -> Result<(), Error> {
        let longest = longest.min(MAX_WAIT);
        Ok(self.session.wait_for(Some(self.left().map_or(longest, |left| left.min(longest))))?)
    }

    fn descriptor(&mut self) -> Result<i32, Error> {
        if self.wait.is_none() {
            self.descriptor = Some(self.session.pollable()?);
            self.begin(Wait::Event);
        }
        self.descriptor.as_ref().map(|descriptor| descriptor.as_raw_fd()).ok_or_else(Error::mixed)
    }

    fn hub_is_running(&self) -> bool {
        self.session.domain().is_some()
    }

    fn next_notice(&mut self) -> Option<&'static str> {
        self.notices.pop_front()
    }

    fn silent_for(&self) -> Duration {
        self.session.silent_for()
    }

    fn warn_at(&mut self) -> &mut Option<Instant> {
        &mut self.warn_at
    }

    fn why_silent(&mut self) -> Vec<Silence> {
        let mut reasons = self.reasons(|followed| followed.is_first);
        if self.sources.iter().any(|followed| !followed.is_first) {
            // A topic has had a sample, so a hub has run. Its end is reported by `on_notice`, not by a warning.
            reasons.retain(|reason| !matches!(reason, Silence::NoHub { .. } | Silence::OtherUser { .. }));
        }
        reasons
    }

    fn silence(&mut self, timeout: f64) -> Error {
        let reason = Error::of_silence(&self.reasons(|_| true));
        let names = self
            .sources
            .iter()
            .map(|TopicState { name: Name { sensor, topic }, .. }| format!("{sensor}/{}", topic.name()));
        let mut names: Vec<String> = names.collect();
        names.sort();
        let what = format!("nothing of {} in {timeout} s", names.join(", "));
        match reason {
            Some(reason) if reason.class == "Silent" => reason.after(&what),
            Some(reason) => reason,
            None => {
                let sensor = self.sources.first().map_or("SENSOR", |followed| &followed.name.sensor);
                Error::new("Silent", what, format!("`scanhub info {sensor}` shows the sensor's state"))
            }
        }
    }
}

/// Payload of a sample in shared memory. The sample is released when this object is dropped, except in a child after
/// `fork`.
pub(crate) struct SharedPayload {
    /// Address of the payload.
    address: usize,
    len: usize,
    /// Whether the payload has a variable length.
    is_slice: bool,
    _sample: ForkSafeCell<AnySample>,
}

impl SharedPayload {
    /// Returns the used bytes of the payload.
    pub(crate) fn bytes(&self) -> &[u8] {
        &self.words()[..self.len]
    }

    /// Returns the used bytes of the payload, and for a payload of variable length also the bytes that fill its last
    /// word.
    pub(crate) fn words(&self) -> &[u8] {
        let len = if self.is_slice { self.len.next_multiple_of(8) } else { self.len };
        // SAFETY: `_sample` is kept until `self` is dropped. Until then, its payload in shared memory does not move,
        // and the hub does not write it. A payload of variable length consists of whole words of 8 bytes.
        unsafe { std::slice::from_raw_parts(ptr::with_exposed_provenance(self.address), len) }
    }
}

/// Subscription to the verdict of a robot.
pub(crate) struct Verdicts {
    sensors: Vec<String>,
    domain_options: DomainOptions,
    early: bool,
    /// Subscriber that waits without a descriptor; `None` if it was replaced by `pollable`, or has left.
    robot: Option<RobotSubscriber>,
    /// Subscriber that replaces `robot` if the program polls a descriptor.
    pollable: Option<PollableSubscriber<Robot>>,
    wait: Option<Wait>,
    /// Time of the next check for a warning; `None` after the warning, and after a verdict other than unknown.
    warn_at: Option<Instant>,
}

/// Copy of the verdict of a robot.
pub(crate) struct Verdict {
    pub(crate) verdict: &'static str,
    pub(crate) worst: Option<String>,
    pub(crate) nearest: Option<(u32, String)>,
    pub(crate) sensors: Vec<(String, &'static str)>,
}

impl Default for Verdict {
    /// Returns the verdict of a robot without sensors.
    fn default() -> Verdict {
        verdict(&Robot::default())
    }
}

impl Verdicts {
    pub(crate) fn new(
        sensors: &[&str],
        domain_options: &DomainOptions,
        early: bool,
    ) -> Result<Verdicts, Error> {
        let robot = Some(builder(sensors, domain_options, early).open()?);
        let sensors = sensors.iter().map(|&sensor| sensor.to_owned()).collect();
        let (domain_options, warn_at) = (domain_options.clone(), Some(Instant::now() + WARN_AFTER));
        Ok(Verdicts { sensors, domain_options, early, robot, pollable: None, wait: None, warn_at })
    }

    /// Returns the current verdict. Never waits.
    pub(crate) fn now(&mut self) -> Result<Verdict, Error> {
        let Some(robot) = self.subscriber() else { return Ok(Verdict::default()) };
        let verdict = verdict(robot.now()?);
        self.note(&verdict);
        Ok(verdict)
    }

    fn note(&mut self, verdict: &Verdict) {
        self.warn_at.take_if(|_| verdict.verdict != scanhub_client::Verdict::Unknown.name());
    }

    fn subscriber(&mut self) -> Option<&mut RobotSubscriber> {
        match &mut self.pollable {
            Some(pollable) => Some(pollable.subscriber_mut()),
            None => self.robot.as_mut(),
        }
    }
}

impl PollableSource for Verdicts {
    type Item = Verdict;

    fn leave(&mut self) {
        (self.robot, self.pollable) = (None, None);
    }

    fn has_left(&self) -> bool {
        self.robot.is_none() && self.pollable.is_none()
    }

    fn try_next(&mut self) -> Result<Option<Verdict>, Error> {
        self.wait = self.wait.or(Some(Wait::Doorbell));
        let Some(robot) = self.subscriber() else { return Ok(None) };
        let verdict = robot.try_next()?.as_ref().map(verdict);
        verdict.iter().for_each(|verdict| self.note(verdict));
        Ok(verdict)
    }

    fn wait(&mut self, longest: Duration) -> Result<(), Error> {
        self.subscriber().map_or(Ok(()), |robot| Ok(robot.wait(longest.min(MAX_WAIT))?))
    }

    fn descriptor(&mut self) -> Result<i32, Error> {
        if self.wait.is_none() {
            // Nothing was received yet, so the new subscriber misses no verdict.
            if self.robot.is_some() {
                let sensors: Vec<&str> = self.sensors.iter().map(String::as_str).collect();
                self.pollable = Some(builder(&sensors, &self.domain_options, self.early).open_pollable()?);
                self.robot = None;
            }
            self.wait = Some(Wait::Event);
        }
        self.pollable.as_ref().map(AsRawFd::as_raw_fd).ok_or_else(Error::mixed)
    }

    fn hub_is_running(&self) -> bool {
        match &self.pollable {
            Some(pollable) => pollable.hub_is_running(),
            None => self.robot.as_ref().is_some_and(RobotSubscriber::hub_is_running),
        }
    }

    fn silent_for(&self) -> Duration {
        match &self.pollable {
            Some(pollable) => pollable.silent_for(),
            None => self.robot.as_ref().map(RobotSubscriber::silent_for).unwrap_or_default(),
        }
    }

    fn warn_at(&mut self) -> &mut Option<Instant> {
        &mut self.warn_at
    }

    fn why_silent(&mut self) -> Vec<Silence> {
        let reason = self.subscriber().map(Subscriber::why_silent);
        reason.filter(|reason| *reason != Silence::Waiting).into_iter().collect()
    }
}

fn builder(sensors: &[&str], domain_options: &DomainOptions, early: bool) -> SubscriberBuilder<Robot> {
    let mut builder = RobotSubscriber::builder(sensors);
    if let Some(domain) = &domain_options.domain {
        builder = builder.domain(domain);
    }
    if let Some(root) = &domain_options.root {
        builder = builder.root(root);
    }
    if early { builder.early() } else { builder }
}

fn verdict(robot: &Robot) -> Verdict {
    Verdict {
        verdict: robot.verdict().name(),
        worst: robot.worst().map(str::to_owned),
        nearest: robot.nearest().map(|(mm, sensor)| (mm, sensor.to_owned())),
        sensors: robot.sensors().map(|(sensor, verdict)| (sensor.to_owned(), verdict.name())).collect(),
    }
}

/// Publication of the angles of a mount.
pub(crate) struct Mount(Publication<Tilt>);

impl Mount {
    pub(crate) fn new(name: &str, domain_options: &DomainOptions) -> Result<Mount, Error> {
        Ok(Mount(Publication::in_domain(&domain_options.publish_domain()?, name)?))
    }

    /// Publishes the angle of the mount at `stamp_ns` of CLOCK_MONOTONIC. `None` means now.
    pub(crate) fn send(&mut self, stamp_ns: Option<u64>, tilt: Tilt) -> Result<(), Error> {
        let fill = |sample: &mut Tilt| *sample = tilt;
        Ok(match stamp_ns {
            None => self.0.send(fill),
            Some(stamp_ns) => self.0.send_at(stamp_ns, fill),
        }?)
    }

    /// Returns the number of subscribers.
    pub(crate) fn subscribers(&self) -> usize {
        self.0.connect();
        self.0.subscribers()
    }
}

/// Returns the topics of the running hub, sorted.
pub(crate) fn topics(domain_options: &DomainOptions) -> Result<Vec<(String, String)>, Error> {
    let names = scanhub_client::live_topics(&[domain_options.live_domain()?]);
    let names = names.iter().filter_map(|name| name.split_once('/'));
    Ok(names.map(|(sensor, topic)| (sensor.to_owned(), topic.to_owned())).collect())
}

impl From<Failure> for Error {
    fn from(failure: Failure) -> Error {
        ClientError::from(failure).into()
    }
}

impl From<ClientError> for Error {
    fn from(error: ClientError) -> Error {
        let class = match error.kind() {
            ErrorKind::NoHub => "NoHub",
            ErrorKind::NoTopic => "NoTopic",
            ErrorKind::ResourceExhausted => "Short",
            ErrorKind::InvalidInput => "Impossible",
            ErrorKind::NameHeld | ErrorKind::DomainHeld => "Taken",
            ErrorKind::Timeout => "Silent",
            ErrorKind::OtherUser => "Denied",
            ErrorKind::Incompatible => "Mismatch",
            ErrorKind::TooManyHeld => "Held",
            _ => "Failure",
        };
        Error::new(class, error.message(), error.remedy())
    }
}

impl Error {
    /// Returns the error for a silence with these reasons, or `None` if there is no reason.
    fn of_silence(reasons: &[Silence]) -> Option<Error> {
        let class = match reasons.first()? {
            Silence::NoHub { .. } | Silence::OtherUser { .. } => "NoHub",
            Silence::Full { .. } => "Short",
            _ => "Silent",
        };
        let messages: Vec<String> = reasons.iter().map(Silence::to_string).collect();
        let mut remedies: Vec<String> = reasons.iter().map(Silence::remedy).collect();
        remedies.dedup();
        Some(Error::new(class, messages.join("; "), remedies.join("; ")))
    }

    /// Returns the error for a request that the hub refused.
    pub(crate) fn of_request(error: ClientError) -> Error {
        match error.kind() {
            ErrorKind::Failed => Error::new("Refused", error.message(), error.remedy()),
            _ => error.into(),
        }
    }

    fn mixed() -> Error {
        let remedy = "make a subscription for each";
        Error::new("Failure", "a subscription is used by either `for` or `async for`", remedy)
    }
}
