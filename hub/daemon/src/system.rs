//! Platform of a link on this machine: clocks, ports, shared memory, files, and the service manager.

use std::cell::{Cell, OnceCell, RefCell};
use std::fs::File;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, poll};
use scanhub_port::{Allowance, Alteration, Dial, Port, PortError, Source, clock};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, MILLIS, Nanos, Ring, Wake};
use scanhub_shm::{Directory, NameLock};
use scanhub_shm::{Node, Payload, SharedMemory, Waker};

use crate::control::ControlQueue;
use crate::link::LinkCore;
use crate::platform::{Line, Platform, SavedState, Wait, WaitSource, WakeReason};
use crate::process::EventFd;
use crate::reconnect::LiveLink;
use crate::saved_state::SaveSlot;
use crate::service::Service;

/// Platform of one link. It stays in the thread of the link.
pub(crate) struct System<'a> {
    hub: LinkResources<'a>,
    sensor: &'a str,
    /// Empty while another process has the sensor's name.
    name: OnceCell<HeldName>,
    /// Set whenever the link has finished something.
    worked: &'a AtomicBool,
    save_slot: Option<SaveSlot<'a>>,
    /// The connection that is being made.
    dial: RefCell<Option<Dial>>,
    /// Time of the last poll for requests, the end of the hub, and the line.
    polled_at: Cell<Nanos>,
    /// File of the record that outlives a killed hub; `None` if it cannot be written. The next hub then has to identify
    /// the scanner again.
    record: OnceCell<Option<File>>,
}

/// The name of the sensor, which only this hub publishes under.
struct HeldName {
    waker: Waker,
    // Dropped last: the next process with this name creates its own doorbell.
    _lock: NameLock,
}

/// Resources of the hub that a link borrows.
#[derive(Clone, Copy)]
pub(crate) struct LinkResources<'a> {
    pub(crate) node: &'a Node,
    /// Limits of the link's topics.
    pub(crate) limits: TopicLimits,
    /// Readable once the hub must end.
    pub(crate) stop: &'a EventFd,
    /// Keeps the ports open if the hub is killed.
    pub(crate) service: &'a Service,
    /// The domain's directory.
    pub(crate) root: &'a Path,
}

impl<'a> System<'a> {
    /// Creates the platform of the link of `sensor` from the resources of `hub`. The link sets `worked` whenever it
    /// has finished something, and hands state over to `save_slot`.
    pub(crate) fn new(
        hub: LinkResources<'a>,
        sensor: &'a str,
        worked: &'a AtomicBool,
        save_slot: Option<SaveSlot<'a>>,
    ) -> System<'a> {
        let (dial, polled_at, record) = (RefCell::default(), Cell::default(), OnceCell::new());
        System { hub, sensor, name: OnceCell::new(), worked, save_slot, dial, polled_at, record }
    }

    /// Runs `link` until the hub ends. Calls `on_start` once with the link: as soon as it has tried to open its port,
    /// but not later than [`START_TIMEOUT`].
    pub(crate) fn drive(&self, mut link: LiveLink<'_, Self>, on_start: impl FnOnce(&LiveLink<'_, Self>)) {
        let mut woken = WakeReason::Timeout;
        let (mut on_start, start_by) = (Some(on_start), clock::now() + START_TIMEOUT);
        while woken != WakeReason::Stop {
            if let Some(on_start) = on_start.take_if(|_| link.has_tried() || clock::now() >= start_by) {
                on_start(&link);
            }
            let Wait { requests, on, until } = link.on_wakeup(woken);
            let until = if on_start.is_some() { until.min(start_by) } else { until };
            let now = clock::now();
            let dial = self.dial.borrow();
            let port = match on {
                WaitSource::Nothing => None,
                WaitSource::Opening => dial.as_ref().map(|dial| (dial.as_fd(), PollFlags::IN)),
                WaitSource::Bytes(line) => Some((line.as_fd(), PollFlags::IN)),
                WaitSource::Loss(_) if self.sleeps(now, until) => {
                    woken = WakeReason::Timeout;
                    continue;
                }
                WaitSource::Loss(line) => Some((line.as_fd(), PollFlags::empty())),
            };
            woken = self.wait(requests, port, now, until);
        }
        link.end();
    }

    /// Sleeps from `now` until `until` instead of polling, if that is soon and the last poll was a moment ago. Returns
    /// whether it has. A poll of several descriptors, one of them a tty, costs more than the sleep.
    fn sleeps(&self, now: Nanos, until: Nanos) -> bool {
        let is_soon = until <= now + MAX_SLEEP && now < self.polled_at.get() + MAX_POLL_INTERVAL;
        if is_soon {
            std::thread::sleep(Duration::from_nanos(until.saturating_sub(now)));
            self.worked.store(true, Ordering::Relaxed);
        }
        is_soon
    }

    /// Waits from `now` for one of the events at the descriptor, a request, or the end of the hub, at most until `until`.
    fn wait(
        &self,
        requests: &ControlQueue,
        port: Option<(BorrowedFd<'_>, PollFlags)>,
        now: Nanos,
        until: Nanos,
    ) -> WakeReason {
        self.polled_at.set(now);
        let span = clock::span(now, until);
        let stop = self.hub.stop.as_fd();
        // Without a port, a second entry for `stop` that waits for nothing.
        let (port, events) = port.unwrap_or((stop, PollFlags::empty()));
        let mut fds = [(stop, PollFlags::IN), (requests.as_fd(), PollFlags::IN), (port, events)]
            .map(|(fd, events)| PollFd::from_borrowed_fd(fd, events));
        let ready = poll(&mut fds, Some(&span)).map(|_| fds.each_ref().map(|fd| !fd.revents().is_empty()));
        self.worked.store(true, Ordering::Relaxed);
        match ready {
            Ok([true, ..]) => WakeReason::Stop,
            Ok([_, true, _]) => WakeReason::Request,
            Ok([.., true]) => WakeReason::Ready,
            _ => WakeReason::Timeout,
        }
    }

    fn record(&self, name: &str) -> Option<&File> {
        let open = || {
            let file = match Directory::open(self.hub.root) {
                Ok(Some(directory)) => directory.file_or_new(&format!("{name}.sensor")).map(Some),
                missing => missing.map(|_| None),
            };
            let log = |error: &_| tracing::debug!(%error, "{name}: the learned state cannot be saved");
            file.inspect_err(log).ok().flatten()
        };
        self.record.get_or_init(open).as_ref()
    }
}

impl LinkCore<'_, System<'_>> {
    /// Waits until `event` is readable, for a request, or the end of the hub, at most until `until`. Meanwhile,
    /// publishes what is due.
    pub(crate) fn wait(&mut self, event: BorrowedFd<'_>, until: Nanos) -> WakeReason {
        loop {
            let deadline = self.next_deadline(until, false);
            let port = Some((event, PollFlags::IN));
            let woken = self.platform.wait(&self.control, port, clock::now(), deadline);
            if self.is_over(woken, until) {
                return woken;
            }
        }
    }
}

impl Platform for System<'_> {
    type Line = Port;
    type Medium<P: Payload + ?Sized> = SharedMemory<P>;

    fn now(&self) -> Nanos {
        clock::now()
    }

    fn wall_ns(&self) -> u64 {
        clock::wall_ns()
    }

    fn pause(&self, until: Nanos) {
        let now = clock::now();
        if until > now {
            std::thread::sleep(Duration::from_nanos(until - now));
        }
    }

    fn take_name(&self) -> Result<(), Failure> {
        if self.name.get().is_none() {
            let lock = NameLock::acquire(self.hub.root, self.sensor)?;
            let waker = Waker::new(self.hub.node, self.sensor)?;
            let _ = self.name.set(HeldName { waker, _lock: lock });
        }
        Ok(())
    }

    fn open(&self, source: &Source, baud: u32) -> Option<Result<Port, PortError>> {
        if let Some(dial) = self.dial.take() {
            return Some(dial.finish());
        }
        match Port::dial(source) {
            None => Some(Port::attempt(source, baud, &AtomicBool::new(false))),
            Some(Err(error)) => Some(Err(error)),
            Some(Ok(dial)) => {
                self.dial.replace(Some(dial));
                None
            }
        }
    }

    fn explain(&self, error: &PortError, source: &Source) -> Failure {
        error.explain(source)
    }

    fn altering_program(&self, source: &Source) -> Option<String> {
        match source {
            Source::Tty(path) => scanhub_port::altering_program(path),
            Source::Tcp { .. } | Source::File { .. } => None,
        }
    }

    fn take_kept(&self, name: &str, source: &Source, baud: u32) -> Option<Port> {
        let mut adopted = None;
        while let Some(line) = self.hub.service.take(name) {
            match Port::adopt(line, source, baud).filter(|_| adopted.is_none()) {
                Some(port) => adopted = Some(port),
                // The port is unusable. Otherwise, the service manager would pass it to the next hub again.
                None => self.hub.service.forget(name),
            }
        }
        adopted
    }

    fn keep(&self, name: &str, line: &Port) {
        if let Port::Tty(_) = line {
            self.hub.service.keep(name, line);
        }
    }

    fn release(&self, name: &str) {
        self.hub.service.forget(name);
    }

    fn medium<P: Payload + ?Sized>(&self, sensor: &str) -> Result<SharedMemory<P>, Failure> {
        let (wanted, topic) = (self.hub.limits.subscribers, P::TOPIC.name());
        let medium = SharedMemory::new(self.hub.node, sensor, &self.hub.limits)?;
        let places = medium.places();
        if places < wanted {
            tracing::warn!(
                "{sensor}/{topic} has places for {places} subscribers, not for {wanted}: those of an earlier hub keep it; stop \
                 them, then start the hub again"
            );
        }
        Ok(medium)
    }

    fn attached(&self) -> Option<u32> {
        self.name.get().map(|name| name.waker.attached())
    }

    fn has_listeners(&self) -> bool {
        self.name.get().is_some_and(|name| name.waker.has_listeners())
    }

    fn ring(&self, ring: Ring) {
        if let Some(name) = self.name.get() {
            name.waker.ring(ring);
        }
    }

    fn notify_event(&self, why: Wake) {
        if let Some(Err(failure)) = self.name.get().map(|name| name.waker.tell(why)) {
            log_unnotified(&failure);
        }
    }

    fn load_record(&self, name: &str, record: &mut [u8]) -> Option<usize> {
        self.record(name)?.read_at(record, 0).ok()
    }

    fn store_record(&self, name: &str, record: &[u8]) {
        let Some(file) = self.record(name) else { return };
        // A failed write leaves a record that is soon too old. Cut the rest of a longer record off.
        let _ = file.write_all_at(record, 0).and_then(|()| file.set_len(record.len() as u64));
    }

    fn saved_state(&self) -> Option<&dyn SavedState> {
        self.save_slot.as_ref().map(|slot| slot as &dyn SavedState)
    }
}

impl Line for Port {
    fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        self.read(buffer)
    }

    fn write(&self, bytes: &[u8]) -> io::Result<()> {
        self.write(bytes)
    }

    fn set_baud(&self, baud: u32) -> io::Result<Option<io::Error>> {
        self.try_baud(baud)
    }

    fn altered(&self) -> io::Result<Option<Alteration>> {
        self.altered()
    }

    fn restore(&self, baud: u32) -> io::Result<()> {
        self.restore(baud)
    }

    fn set_dtr(&self, on: bool) -> io::Result<()> {
        self.set_dtr(on)
    }

    fn waiting(&self) -> Option<usize> {
        self.waiting()
    }

    fn allowance(&self, baud: u32) -> Option<Allowance> {
        self.allowance(baud)
    }

    fn line_errors(&self) -> u64 {
        self.line_errors()
    }

    fn device(&self) -> Option<&Path> {
        self.device()
    }

    fn is_simulated(&self) -> bool {
        self.simulated()
    }
}

#[cold]
fn log_unnotified(failure: &Failure) {
    tracing::debug!(%failure, "some consumers were not woken");
}

/// Maximum wait that is slept through.
const MAX_SLEEP: Nanos = 20 * MILLIS;
/// Maximum time for which requests, the end of the hub and the loss of a line may go unnoticed.
const MAX_POLL_INTERVAL: Nanos = 50 * MILLIS;
/// Time that the start of the hub waits for the connection to a serial server.
const START_TIMEOUT: Nanos = 250 * MILLIS;
