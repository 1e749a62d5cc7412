//! Membership of a process in a domain, across restarts of the hub. A session wakes the process when samples arrive,
//! and reports that a hub has started or ended.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::event::epoll;
use rustix::io::Errno;
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create, timerfd_settime,
};
use scanhub_schema::{Kind, Topic};
use scanhub_shm::{Domain, Node, Payload, Role, Subscriber, ThreadSafeService, hub_pid, is_starting};

use crate::clock;
use crate::error::Error;
use crate::hub_finder::{Change, DomainHolder, HubFinder};
use crate::hub_monitor::HubMonitor;
use crate::silence::Silence;
use crate::wait::{Wait, Wakeups};

/// Maximum time of one wait. After it, the session can check for the hub, and the caller can stop.
const MAX_WAIT: Duration = Duration::from_millis(100);

/// Interval at which a program that polls the descriptor checks for the hub while one runs. Without a hub, the
/// descriptor becomes readable when the next one starts.
const HUB_CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// Membership in the domain at the first of several locations at which a hub runs.
pub struct Session {
    finder: HubFinder,
    joined: Option<JoinedDomain>,
    /// Whether a hub has started whose shared memory may have other names than that of the joined domain.
    is_unsure: bool,
    join_count: u32,
    /// Number of hubs or listeners that have started.
    start_count: u32,
    wait: Wait,
    /// Time of the last sample or, before the first one, of the session's creation, in ns of CLOCK_BOOTTIME.
    last_sample_ns: u64,
    /// Descriptor for programs that poll it; `None` if it is not used.
    poll_descriptor: Option<PollDescriptor>,
    /// Time until which the caller checks ten times a second, because a starting hub creates its topics one after the
    /// other, and sends samples to late joiners without an event.
    quick_until: Option<Instant>,
}

struct JoinedDomain {
    domain: Domain,
    wakeups: Wakeups,
    node: Node<ThreadSafeService>,
}

impl Session {
    /// Creates a session that joins the first one of `locations` at which a hub runs, as soon as one runs.
    pub fn new(locations: Vec<Domain>) -> Session {
        Session {
            finder: HubFinder::new(locations),
            joined: None,
            is_unsure: false,
            join_count: 0,
            start_count: 0,
            wait: Wait::default(),
            last_sample_ns: clock::boottime_ns(),
            poll_descriptor: None,
            quick_until: None,
        }
    }

    /// Sets the method by which the session waits. Call this method before subscribing to any topic.
    pub fn waiting_by(self, wait: Wait) -> Session {
        Session { wait, ..self }
    }

    /// Checks whether a hub runs, and joins its domain if it is at a new location.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if memory or descriptors are short. A session that has joined
    /// already continues without this check.
    pub fn check_hub(&mut self) -> Result<Change, Error> {
        if self.joined.as_mut().is_some_and(|joined| joined.wakeups.take_activity()) {
            self.finder.note_ring();
        }
        let change = self.finder.check();
        if let Some(joined) = self.joined.as_mut().filter(|_| change != Change::default()) {
            joined.wakeups.close_doorbells();
        }
        let Some(domain) = self.finder.domain() else {
            return match self.finder.shortage() {
                Some(short) if self.joined.is_none() => Err(short.into()),
                _ => Ok(change),
            };
        };
        if change.started.is_some() {
            self.is_unsure = true;
            self.start_count += 1;
            self.quick_until = Some(Instant::now() + 2 * HUB_CHECK_INTERVAL);
        }
        let is_here = self.joined.as_ref().is_some_and(|joined| joined.domain == *domain);
        if is_here && !self.is_unsure {
            return Ok(change);
        }
        // If all processes have left the domain, the shared memory of the next hub has other names.
        let is_member = |joined: &JoinedDomain| scanhub_shm::is_member(&joined.node, domain.root());
        match self.joined.as_ref().filter(|_| is_here).map(is_member).transpose()? {
            Some(true) => {}
            _ => match scanhub_shm::join(domain, Role::Subscriber) {
                Ok(node) => {
                    let (domain, wakeups) = (domain.clone(), Wakeups::waiting_by(self.wait));
                    self.joined = Some(JoinedDomain { domain, wakeups, node });
                    self.join_count += 1;
                }
                // The hub is just starting or ending, so the next check decides.
                Err(failure) if failure.kind == Kind::NoHub => return Ok(change),
                Err(failure) => return Err(failure.into()),
            },
        }
        self.is_unsure = false;
        Ok(change)
    }

    /// Returns the domain of the hub or listener, if one runs.
    pub fn domain(&self) -> Option<&Domain> {
        self.finder.domain()
    }

    /// Returns the kind of the publisher in the domain, as of the last check.
    pub fn domain_holder(&self) -> Option<DomainHolder> {
        self.finder.holder()
    }

    /// Notes that a sample was received.
    pub(crate) fn note_sample(&mut self) {
        self.last_sample_ns = clock::boottime_ns();
    }

    /// Returns the time since a sample of any source was received; if there was none, since the session was created.
    /// Time during which the machine was suspended counts.
    pub fn silent_for(&self) -> Duration {
        Duration::from_nanos(clock::boottime_ns().saturating_sub(self.last_sample_ns))
    }

    /// Returns whether a hub runs, and not only a listener that publishes the sensors of other machines.
    pub fn hub_is_running(&self) -> bool {
        self.domain().is_some_and(|domain| matches!(hub_pid(domain.root()), Ok(Some(_))))
    }

    /// Returns whether a hub runs that does not have all of its topics yet.
    pub fn hub_is_starting(&self) -> bool {
        self.domain().is_some_and(|domain| is_starting(domain.root()) == Ok(true))
    }

    /// Returns the error that no hub runs, for callers that cannot wait for a hub.
    pub fn no_hub(&self) -> Error {
        self.finder.no_hub()
    }

    /// Returns the same error as [`Session::no_hub`], but without the hubs of other users and domains, because the
    /// error is shown on other machines.
    pub fn no_hub_here(&self) -> Error {
        self.finder.no_hub_here()
    }

    /// Returns why no hub runs, as of the last check.
    pub(crate) fn silence_reason(&self) -> Silence {
        self.finder.silence_reason()
    }

    /// Returns how often the session has joined a domain. Ports that were opened before it joined last must be opened
    /// again.
    pub fn join_count(&self) -> u32 {
        self.join_count
    }

    /// Returns the number of starts of a hub or listener that the checks have found. A start does not always require
    /// the session to join again, so this number is not that of [`join_count`](Self::join_count).
    pub(crate) fn start_count(&self) -> u32 {
        self.start_count
    }

    /// Returns the node of the domain that the session has joined last.
    pub(crate) fn node(&self) -> Option<&Node<ThreadSafeService>> {
        self.joined.as_ref().map(|joined| &joined.node)
    }

    /// Returns a subscriber of `sensor`, or `None` if its hub or topic does not exist yet. The doorbell or event is
    /// opened first, so that the subscriber is woken for every sample.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if memory, descriptors or slots for subscribers are short;
    /// [`ErrorKind::Incompatible`](crate::ErrorKind) if the topic has another layout.
    pub fn subscribe<P: Payload + ?Sized>(
        &mut self,
        sensor: &str,
    ) -> Result<Option<Subscriber<P, ThreadSafeService>>, Error> {
        let (Some(_), Some(joined)) = (self.finder.domain(), &mut self.joined) else {
            return Ok(None);
        };
        if !joined.wakeups.add(&joined.node, sensor, P::TOPIC)? {
            return Ok(None);
        }
        if let Some(poll_descriptor) = &self.poll_descriptor {
            joined.wakeups.descriptors().try_for_each(|event| poll_descriptor.add(event))?;
        }
        let subscriber =
            P::open(&joined.node, sensor)?.map(|topic| P::subscriber(&joined.node, &topic)).transpose()?;
        if subscriber.is_some() {
            self.quick_until = Some(Instant::now() + HUB_CHECK_INTERVAL);
        }
        Ok(subscriber)
    }

    /// Returns a value that stays the same until a sample of the `sensor`'s `topic` may have been sent. `None` if that
    /// is unknown. The hub sends samples to late joiners without ringing the doorbell, so each check for the hub
    /// changes the value.
    pub fn sample_mark(&self, sensor: &str, topic: Topic) -> Option<(u32, Instant)> {
        let ring_count = self.joined.as_ref()?.wakeups.ring_count(sensor, topic)?;
        Some((ring_count, self.finder.checked_at()?))
    }

    /// Returns a descriptor that is readable while a sample or a check may be due. The session waits by event from now
    /// on. The session keeps this descriptor when the hub is replaced. Only
    /// [`rearm_descriptor`](Self::rearm_descriptor) makes it unreadable. Call this before subscribing to any topic.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if descriptors have run out.
    pub fn pollable(&mut self) -> Result<Arc<OwnedFd>, Error> {
        self.wait = Wait::Event;
        let poll_descriptor = PollDescriptor::new()?;
        let descriptor = poll_descriptor.descriptor.clone();
        self.poll_descriptor = Some(poll_descriptor);
        Ok(descriptor)
    }

    /// Notes that the caller has received all samples. The descriptor, if it is used, is then not readable until
    /// something changes or `left` has passed. Returns whether samples were sent, or a hub has started or ended, in the
    /// meantime. The caller must then first check for the hub and receive samples.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if the system cannot wait.
    pub fn rearm_descriptor(&mut self, left: Option<Duration>) -> Result<bool, Error> {
        let Some(poll_descriptor) = &mut self.poll_descriptor else { return Ok(false) };
        let is_changed = match self.finder.pid() {
            Some(pid) => poll_descriptor.monitor.watch_hub(pid),
            None => poll_descriptor.monitor.watch_directories(self.finder.locations()),
        };
        if is_changed {
            self.finder.expire();
            return Ok(true);
        }
        let interval = match self.finder.pid() {
            Some(_) if self.quick_until.is_some_and(|until| Instant::now() < until) => Some(MAX_WAIT),
            Some(_) => Some(HUB_CHECK_INTERVAL),
            None if self.finder.shortage().is_some() => Some(MAX_WAIT),
            None => Some(poll_descriptor.monitor.interval()),
        };
        poll_descriptor.set_timer(interval.into_iter().chain(left).min())?;
        Ok(self.joined.as_mut().map_or(Ok(false), |joined| joined.wakeups.take())?)
    }

    /// Sleeps until a sample was sent, but at most until `until`, and for at most 100 ms. Returns at once if a sample
    /// may have been sent since the caller last received samples.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if the system cannot wait.
    pub fn wait(&mut self, until: Option<Instant>) -> Result<(), Error> {
        self.wait_for(until.map(|until| until.saturating_duration_since(Instant::now())))
    }

    /// Sleeps as [`wait`](Self::wait) does, at most for `left`.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`wait`](Self::wait).
    pub fn wait_for(&mut self, left: Option<Duration>) -> Result<(), Error> {
        let left = left.map_or(MAX_WAIT, |left| left.min(MAX_WAIT));
        // The wait consumes events that a polling program has not seen, so keep the descriptor readable until it is
        // rearmed.
        if let Some(poll_descriptor) = &self.poll_descriptor {
            poll_descriptor.set_timer(Some(Duration::ZERO))?;
        }
        match &mut self.joined {
            Some(joined) => Ok(joined.wakeups.wait(&joined.node, left)?),
            None => {
                std::thread::sleep(left);
                Ok(())
            }
        }
    }
}

/// Descriptor for programs that also wait for other events: an epoll over a timer, the events of each hub, and the
/// start and end of hubs. It is readable while a sample or a check may be due.
struct PollDescriptor {
    descriptor: Arc<OwnedFd>,
    timer: OwnedFd,
    monitor: HubMonitor,
}

impl PollDescriptor {
    /// Creates a descriptor that is readable at once. Returns [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if
    /// descriptors have run out.
    fn new() -> Result<PollDescriptor, Error> {
        let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
        let timer = timerfd_create(TimerfdClockId::Monotonic, flags).map_err(shortage)?;
        let descriptor = Arc::new(epoll::create(epoll::CreateFlags::CLOEXEC).map_err(shortage)?);
        let poll_descriptor =
            PollDescriptor { monitor: HubMonitor::new(descriptor.clone()), descriptor, timer };
        poll_descriptor.add(poll_descriptor.timer.as_fd())?;
        poll_descriptor.set_timer(Some(Duration::ZERO))?;
        Ok(poll_descriptor)
    }

    /// Adds `event`, if it is new. The kernel removes it when it is closed. Returns
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if memory is short.
    fn add(&self, event: BorrowedFd<'_>) -> Result<(), Error> {
        let data = epoll::EventData::new_u64(0);
        match epoll::add(&self.descriptor, event, data, epoll::EventFlags::IN) {
            Ok(()) | Err(Errno::EXIST) => Ok(()),
            Err(error) => Err(shortage(error)),
        }
    }

    /// Sets the timer: it makes the descriptor readable after `left`, or never.
    fn set_timer(&self, left: Option<Duration>) -> Result<(), Error> {
        // For the kernel, 0 means never, so use at least 1 ns for a time that has passed.
        let left = left.map_or(Duration::ZERO, |left| left.max(Duration::from_nanos(1)));
        let it_value = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
        let once = Itimerspec { it_interval: Timespec { tv_sec: 0, tv_nsec: 0 }, it_value };
        timerfd_settime(&self.timer, TimerfdTimerFlags::empty(), &once).map(|_| ()).map_err(shortage)
    }
}

fn shortage(error: Errno) -> Error {
    let what = format!("no descriptor to wait on: {error}");
    Error::new(Kind::ResourceExhausted, what, "`ulimit -n` may be too small")
        .with_source(io::Error::from(error))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::event::{PollFd, PollFlags, poll};
    use std::io::{Write, pipe};

    fn is_readable(poll_descriptor: &PollDescriptor, within: Duration) -> bool {
        let mut fds = [PollFd::new(&poll_descriptor.descriptor, PollFlags::IN)];
        let within = Timespec { tv_sec: within.as_secs() as i64, tv_nsec: within.subsec_nanos().into() };
        poll(&mut fds, Some(&within)).unwrap() == 1
    }

    const TEST_TIMEOUT: Duration = Duration::from_secs(20);

    #[test]
    fn timer_makes_poll_descriptor_readable_once() {
        let poll_descriptor = PollDescriptor::new().unwrap();
        assert!(is_readable(&poll_descriptor, TEST_TIMEOUT), "it was not checked yet");
        poll_descriptor.set_timer(Some(TEST_TIMEOUT)).unwrap();
        assert!(!is_readable(&poll_descriptor, Duration::ZERO));
        poll_descriptor.set_timer(Some(Duration::from_millis(1))).unwrap();
        assert!(is_readable(&poll_descriptor, TEST_TIMEOUT));
    }

    #[test]
    fn resource_exhaustion_has_the_os_error_as_source() {
        let error = shortage(Errno::MFILE);
        assert_eq!(error.kind(), crate::ErrorKind::ResourceExhausted);
        let source = std::error::Error::source(&error).and_then(|source| source.downcast_ref::<io::Error>());
        assert_eq!(source.and_then(io::Error::raw_os_error), Some(Errno::MFILE.raw_os_error()));
    }

    #[test]
    fn closed_descriptor_leaves_the_poll_set() {
        let poll_descriptor = PollDescriptor::new().unwrap();
        poll_descriptor.set_timer(Some(TEST_TIMEOUT)).unwrap();
        let (read, mut write) = pipe().unwrap();
        for _ in 0..2 {
            poll_descriptor.add(read.as_fd()).unwrap();
        }
        write.write_all(b"!").unwrap();
        assert!(is_readable(&poll_descriptor, TEST_TIMEOUT));
        drop(read);
        assert!(!is_readable(&poll_descriptor, Duration::ZERO));
    }
}
