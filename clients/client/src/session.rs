//! Membership of a process in a domain, across restarts of its hub. It wakes the process when samples arrive, and
//! reports that a hub has started or ended.

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
use scanhub_shm::{Domain, Node, Payload, Role, Subscriber, ThreadSafeService, holder, is_starting};

use crate::clock;
use crate::error::Error;
use crate::hub_monitor::HubMonitor;
use crate::presence::{Change, Presence, Who};
use crate::silence::Silence;
use crate::wait::{Wait, Wakeups};

/// Maximum wait. After it, the session looks for the hub, and the caller can stop.
const LONGEST_WAIT: Duration = Duration::from_millis(100);

/// Interval at which a program that polls the descriptor checks a running hub. An event reports the next hub.
const MAKE_SURE_EVERY: Duration = Duration::from_secs(1);

/// Membership in the first of several domains where a hub runs.
pub struct Session {
    presence: Presence,
    joined: Option<Joined>,
    /// Whether a hub has started, and its shared memory may have other names than those that were joined.
    is_unsure: bool,
    number: u32,
    /// Number of hubs or listeners that have started.
    starts: u32,
    wait: Wait,
    /// CLOCK_BOOTTIME at the last sample, or at the creation, in ns.
    heard_ns: u64,
    /// For programs that poll the descriptor.
    readiness: Option<Readiness>,
    /// Time until which the caller looks ten times a second: the hub creates its topics one after the other, and sends
    /// samples to late joiners without an event.
    quick_until: Option<Instant>,
}

struct Joined {
    domain: Domain,
    wakeups: Wakeups,
    node: Node<ThreadSafeService>,
}

impl Session {
    /// Creates a session that joins the first live one of `places`, as soon as there is one.
    pub fn new(places: Vec<Domain>) -> Session {
        Session {
            presence: Presence::new(places),
            joined: None,
            is_unsure: false,
            number: 0,
            starts: 0,
            wait: Wait::default(),
            heard_ns: clock::boottime_ns(),
            readiness: None,
            quick_until: None,
        }
    }

    /// Sets the method by which the session waits. Call it before anything is followed.
    pub fn by(self, wait: Wait) -> Session {
        Session { wait, ..self }
    }

    /// Checks whether a hub runs, and joins its domain if it is at a new place.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if memory or descriptors are short. A session that has joined
    /// already continues without this check.
    pub fn look(&mut self) -> Result<Change, Error> {
        if self.joined.as_mut().is_some_and(|joined| joined.wakeups.take_rang()) {
            self.presence.heard();
        }
        let change = self.presence.look();
        if let Some(joined) = self.joined.as_mut().filter(|_| change != Change::default()) {
            joined.wakeups.renew();
        }
        let Some(domain) = self.presence.domain() else {
            return match self.presence.short() {
                Some(short) if self.joined.is_none() => Err(short.into()),
                _ => Ok(change),
            };
        };
        if change.back.is_some() {
            self.is_unsure = true;
            self.starts += 1;
            self.quick_until = Some(Instant::now() + 2 * MAKE_SURE_EVERY);
        }
        let is_here = self.joined.as_ref().is_some_and(|joined| joined.domain == *domain);
        if is_here && !self.is_unsure {
            return Ok(change);
        }
        // If all processes have left the domain, the shared memory of the next hub has other names.
        let is_member = |joined: &Joined| scanhub_shm::is_member(&joined.node, domain.root());
        match self.joined.as_ref().filter(|_| is_here).map(is_member).transpose()? {
            Some(true) => {}
            _ => match scanhub_shm::join(domain, Role::Subscriber) {
                Ok(node) => {
                    let (domain, wakeups) = (domain.clone(), Wakeups::by(self.wait));
                    self.joined = Some(Joined { domain, wakeups, node });
                    self.number += 1;
                }
                // It is just starting or ending: the next look decides.
                Err(failure) if failure.kind == Kind::NoHub => return Ok(change),
                Err(failure) => return Err(failure.into()),
            },
        }
        self.is_unsure = false;
        Ok(change)
    }

    /// Returns the domain of the hub or listener, if one runs.
    pub fn domain(&self) -> Option<&Domain> {
        self.presence.domain()
    }

    /// Returns who publishes there, as of the last look.
    pub fn publishes(&self) -> Option<Who> {
        self.presence.who()
    }

    /// Notes that a sample was received.
    pub(crate) fn heard(&mut self) {
        self.heard_ns = clock::boottime_ns();
    }

    /// Returns the time since a sample of any source was received; if there was none, since the session was created.
    /// Time during which the machine was suspended counts.
    pub fn silent_for(&self) -> Duration {
        Duration::from_nanos(clock::boottime_ns().saturating_sub(self.heard_ns))
    }

    /// Returns whether a hub runs, and not only a listener that publishes the sensors of other machines.
    pub fn hub_lives(&self) -> bool {
        self.domain().is_some_and(|domain| matches!(holder(domain.root()), Ok(Some(_))))
    }

    /// Returns whether there is a hub that does not have all its topics yet.
    pub fn hub_is_starting(&self) -> bool {
        self.domain().is_some_and(|domain| is_starting(domain.root()) == Ok(true))
    }

    /// Returns the failure for callers that cannot wait for a hub.
    pub fn no_hub(&self) -> Error {
        self.presence.no_hub()
    }

    /// Returns [`Session::no_hub`] without the hubs of other users and domains, for readers on other machines.
    pub fn no_hub_here(&self) -> Error {
        self.presence.no_hub_here()
    }

    /// Returns why no hub runs, as of the last look.
    pub(crate) fn absence(&self) -> Silence {
        self.presence.absence()
    }

    /// Counts the domains joined: ports of an earlier one must be opened again.
    pub fn number(&self) -> u32 {
        self.number
    }

    /// Counts the starts of a hub or listener that the looks have shown. A session can stay in the domain meanwhile.
    pub(crate) fn starts(&self) -> u32 {
        self.starts
    }

    /// Returns the node of the domain that the session has joined last.
    pub(crate) fn node(&self) -> Option<&Node<ThreadSafeService>> {
        self.joined.as_ref().map(|joined| &joined.node)
    }

    /// Returns a subscriber of `sensor`, or `None` if its hub or topic does not exist yet. The bell or event is opened
    /// first, so that the subscriber is woken for every sample.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if memory, descriptors or places for subscribers are short;
    /// [`ErrorKind::Incompatible`](crate::ErrorKind) if the topic has another layout.
    pub fn subscribe<P: Payload + ?Sized>(
        &mut self,
        sensor: &str,
    ) -> Result<Option<Subscriber<P, ThreadSafeService>>, Error> {
        let (Some(_), Some(joined)) = (self.presence.domain(), &mut self.joined) else {
            return Ok(None);
        };
        if !joined.wakeups.add(&joined.node, sensor, P::TOPIC)? {
            return Ok(None);
        }
        if let Some(readiness) = &self.readiness {
            joined.wakeups.descriptors().try_for_each(|event| readiness.add(event))?;
        }
        let subscriber =
            P::open(&joined.node, sensor)?.map(|topic| P::subscriber(&joined.node, &topic)).transpose()?;
        if subscriber.is_some() {
            self.quick_until = Some(Instant::now() + MAKE_SURE_EVERY);
        }
        Ok(subscriber)
    }

    /// Returns a value that stays the same until a sample of the `sensor`'s `topic` may have been sent. `None` if that
    /// is unknown. The hub sends samples to late joiners without ringing the bell, so each check for the hub changes
    /// the value.
    pub fn moment(&self, sensor: &str, topic: Topic) -> Option<(u32, Instant)> {
        let rung = self.joined.as_ref()?.wakeups.rung(sensor, topic)?;
        Some((rung, self.presence.looked_at()?))
    }

    /// Returns a descriptor that is readable while there may be something to receive or to check. The session waits by
    /// event from now on. The descriptor stays the same when the hub is replaced. Only [`settle`](Self::settle) makes
    /// it unreadable. Call this before anything is followed.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if descriptors have run out.
    pub fn pollable(&mut self) -> Result<Arc<OwnedFd>, Error> {
        self.wait = Wait::Event;
        let readiness = Readiness::new()?;
        let descriptor = readiness.descriptor.clone();
        self.readiness = Some(readiness);
        Ok(descriptor)
    }

    /// Notes that the caller has received all samples. The descriptor, if it is used, is not readable until something
    /// changes or `left` has passed. Returns whether samples were sent, or a hub has started or ended, in the meantime.
    /// Then the caller must look and receive first.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if the system cannot wait.
    pub fn settle(&mut self, left: Option<Duration>) -> Result<bool, Error> {
        let Some(readiness) = &mut self.readiness else { return Ok(false) };
        let is_changed = match self.presence.pid() {
            Some(pid) => readiness.monitor.watch_hub(pid),
            None => readiness.monitor.watch_directories(self.presence.places()),
        };
        if is_changed {
            self.presence.expire();
            return Ok(true);
        }
        let pace = match self.presence.pid() {
            Some(_) if self.quick_until.is_some_and(|until| Instant::now() < until) => Some(LONGEST_WAIT),
            Some(_) => Some(MAKE_SURE_EVERY),
            None if self.presence.short().is_some() => Some(LONGEST_WAIT),
            None => Some(readiness.monitor.interval()),
        };
        readiness.again_in(pace.into_iter().chain(left).min())?;
        Ok(self.joined.as_mut().map_or(Ok(false), |joined| joined.wakeups.take())?)
    }

    /// Sleeps until a sample was sent, at most until `until` and for 100 ms. Returns at once if one may have been sent
    /// since the caller looked.
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
        let left = left.map_or(LONGEST_WAIT, |left| left.min(LONGEST_WAIT));
        // This takes events that a program that polls has not seen, so the descriptor stays readable until it is
        // settled.
        if let Some(readiness) = &self.readiness {
            readiness.again_in(Some(Duration::ZERO))?;
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

/// Descriptor for programs that also wait for other things: an epoll over a timer, the events of each hub, and the
/// start and end of hubs. It is readable while there may be something to receive or to check.
struct Readiness {
    descriptor: Arc<OwnedFd>,
    clock: OwnedFd,
    monitor: HubMonitor,
}

impl Readiness {
    /// Creates a descriptor that is readable at once. Fails with [`ErrorKind::ResourceExhausted`](crate::ErrorKind)
    /// without free descriptors.
    fn new() -> Result<Readiness, Error> {
        let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
        let clock = timerfd_create(TimerfdClockId::Monotonic, flags).map_err(short)?;
        let descriptor = Arc::new(epoll::create(epoll::CreateFlags::CLOEXEC).map_err(short)?);
        let readiness = Readiness { monitor: HubMonitor::new(descriptor.clone()), descriptor, clock };
        readiness.add(readiness.clock.as_fd())?;
        readiness.again_in(Some(Duration::ZERO))?;
        Ok(readiness)
    }

    /// Adds `event`, if it is new. The kernel removes it when it is closed. Fails with
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) without free memory.
    fn add(&self, event: BorrowedFd<'_>) -> Result<(), Error> {
        let data = epoll::EventData::new_u64(0);
        match epoll::add(&self.descriptor, event, data, epoll::EventFlags::IN) {
            Ok(()) | Err(Errno::EXIST) => Ok(()),
            Err(error) => Err(short(error)),
        }
    }

    /// Sets the timer: it makes the descriptor readable after `left`, or never.
    fn again_in(&self, left: Option<Duration>) -> Result<(), Error> {
        // 0 means never.
        let left = left.map_or(Duration::ZERO, |left| left.max(Duration::from_nanos(1)));
        let it_value = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
        let once = Itimerspec { it_interval: Timespec { tv_sec: 0, tv_nsec: 0 }, it_value };
        timerfd_settime(&self.clock, TimerfdTimerFlags::empty(), &once).map(|_| ()).map_err(short)
    }
}

fn short(error: Errno) -> Error {
    let what = format!("no descriptor to wait on: {error}");
    Error::new(Kind::Short, what, "`ulimit -n` may be too small").with_source(io::Error::from(error))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::event::{PollFd, PollFlags, poll};
    use std::io::{Write, pipe};

    fn is_readable(readiness: &Readiness, within: Duration) -> bool {
        let mut fds = [PollFd::new(&readiness.descriptor, PollFlags::IN)];
        let within = Timespec { tv_sec: within.as_secs() as i64, tv_nsec: within.subsec_nanos().into() };
        poll(&mut fds, Some(&within)).unwrap() == 1
    }

    const LONG: Duration = Duration::from_secs(20);

    #[test]
    fn the_time_makes_it_readable_once() {
        let readiness = Readiness::new().unwrap();
        assert!(is_readable(&readiness, LONG), "nobody has looked yet");
        readiness.again_in(Some(LONG)).unwrap();
        assert!(!is_readable(&readiness, Duration::ZERO));
        readiness.again_in(Some(Duration::from_millis(1))).unwrap();
        assert!(is_readable(&readiness, LONG));
    }

    #[test]
    fn a_shortage_has_the_error_of_the_system_as_its_source() {
        let error = short(Errno::MFILE);
        assert_eq!(error.kind(), crate::ErrorKind::ResourceExhausted);
        let source = std::error::Error::source(&error).and_then(|source| source.downcast_ref::<io::Error>());
        assert_eq!(source.and_then(io::Error::raw_os_error), Some(Errno::MFILE.raw_os_error()));
    }

    #[test]
    fn events_come_and_go() {
        let readiness = Readiness::new().unwrap();
        readiness.again_in(Some(LONG)).unwrap();
        let (read, mut write) = pipe().unwrap();
        for _ in 0..2 {
            readiness.add(read.as_fd()).unwrap();
        }
        write.write_all(b"!").unwrap();
        assert!(is_readable(&readiness, LONG));
        drop(read);
        assert!(!is_readable(&readiness, Duration::ZERO));
    }
}
