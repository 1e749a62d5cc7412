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
use scanhub_port::{PendingConnection, Port, PortError, PortSpec, ReadBudget, SettingsChange, clock};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{DoorbellWord, Failure, MILLIS, Nanos, WakeEvent};
use scanhub_shm::{Directory, NameLock};
use scanhub_shm::{Node, Payload, SharedMemory, WakeSender};

use crate::control::ControlQueue;
use crate::link::LinkState;
use crate::platform::{Platform, PortIo, SavedState, Wait, WaitSource, WakeReason};
use crate::process::EventFd;
use crate::reconnect::LiveLink;
use crate::saved_state::SaveSlot;
use crate::service::Service;

/// Platform of one link. The platform stays in the thread of the link.
pub(crate) struct System<'a> {
    resources: LinkResources<'a>,
    sensor: &'a str,
    /// Empty while another process has the sensor's name.
    name: OnceCell<HeldName>,
    /// Set whenever the link has finished something.
    activity: &'a AtomicBool,
    save_slot: Option<SaveSlot<'a>>,
    /// The connection that is being made.
    pending_connection: RefCell<Option<PendingConnection>>,
    /// Time of the last poll for requests, the end of the hub, and the line.
    polled_at: Cell<Nanos>,
    /// File of the record that outlives a killed hub; `None` if it cannot be written. The next hub then has to identify
    /// the scanner again.
    record: OnceCell<Option<File>>,
}

/// The name of the sensor, which only this hub publishes under.
struct HeldName {
    waker: WakeSender,
    // Dropped after `waker`, because the next process that takes this name creates its own doorbell.
    _lock: NameLock,
}

/// Resources of the hub that a link borrows.
#[derive(Clone, Copy)]
pub(crate) struct LinkResources<'a> {
    pub(crate) node: &'a Node,
    /// Limits of the link's topics.
    pub(crate) limits: TopicLimits,
    /// Event that is readable once the hub must end.
    pub(crate) stop: &'a EventFd,
    /// Service manager, which keeps the ports open if the hub is killed.
    pub(crate) service: &'a Service,
    /// The domain's directory.
    pub(crate) root: &'a Path,
}

impl<'a> System<'a> {
    /// Creates the platform of the link of `sensor` from the `resources` of the hub. The link sets `activity` whenever
    /// it has finished something, and passes state to `save_slot`.
    pub(crate) fn new(
        resources: LinkResources<'a>,
        sensor: &'a str,
        activity: &'a AtomicBool,
        save_slot: Option<SaveSlot<'a>>,
    ) -> System<'a> {
        let (pending_connection, polled_at, record) = (RefCell::default(), Cell::default(), OnceCell::new());
        System {
            resources,
            sensor,
            name: OnceCell::new(),
            activity,
            save_slot,
            pending_connection,
            polled_at,
            record,
        }
    }

    /// Runs `link` until the hub ends. Calls `on_start` once with the link: as soon as it has tried to open its port,
    /// but not later than [`START_TIMEOUT`].
    pub(crate) fn run_link(&self, mut link: LiveLink<'_, Self>, on_start: impl FnOnce(&LiveLink<'_, Self>)) {
        let mut wake_reason = WakeReason::Timeout;
        let (mut on_start, start_by) = (Some(on_start), clock::now() + START_TIMEOUT);
        while wake_reason != WakeReason::Stop {
            if let Some(on_start) = on_start.take_if(|_| link.has_tried() || clock::now() >= start_by) {
                on_start(&link);
            }
            let Wait { requests, source, until } = link.on_wakeup(wake_reason);
            let until = if on_start.is_some() { until.min(start_by) } else { until };
            let now = clock::now();
            let pending_connection = self.pending_connection.borrow();
            let port = match source {
                WaitSource::Nothing => None,
                WaitSource::Opening => pending_connection
                    .as_ref()
                    .map(|pending_connection| (pending_connection.as_fd(), PollFlags::IN)),
                WaitSource::Bytes(line) => Some((line.as_fd(), PollFlags::IN)),
                WaitSource::Loss(_) if self.try_sleep(now, until) => {
                    wake_reason = WakeReason::Timeout;
                    continue;
                }
                WaitSource::Loss(line) => Some((line.as_fd(), PollFlags::empty())),
            };
            wake_reason = self.wait(requests, port, now, until);
        }
        link.end();
    }

    /// Sleeps from `now` until `until` instead of polling, if `until` is soon and the last poll was a moment ago.
    /// Returns whether it has slept. A poll of several descriptors, one of them a tty, costs more than the sleep.
    fn try_sleep(&self, now: Nanos, until: Nanos) -> bool {
        let is_soon = until <= now + MAX_SLEEP && now < self.polled_at.get() + MAX_POLL_INTERVAL;
        if is_soon {
            std::thread::sleep(Duration::from_nanos(until.saturating_sub(now)));
            self.activity.store(true, Ordering::Relaxed);
        }
        is_soon
    }

    /// Waits from `now` for an event at the descriptor of `port`, a request, or the end of the hub, at most until
    /// `until`.
    fn wait(
        &self,
        requests: &ControlQueue,
        port: Option<(BorrowedFd<'_>, PollFlags)>,
        now: Nanos,
        until: Nanos,
    ) -> WakeReason {
        self.polled_at.set(now);
        let span = clock::poll_timeout(now, until);
        let stop = self.resources.stop.as_fd();
        // Without a port, poll `stop` a second time, without events.
        let (port, events) = port.unwrap_or((stop, PollFlags::empty()));
        let mut fds = [(stop, PollFlags::IN), (requests.as_fd(), PollFlags::IN), (port, events)]
            .map(|(fd, events)| PollFd::from_borrowed_fd(fd, events));
        let ready = poll(&mut fds, Some(&span)).map(|_| fds.each_ref().map(|fd| !fd.revents().is_empty()));
        self.activity.store(true, Ordering::Relaxed);
        match ready {
            Ok([true, ..]) => WakeReason::Stop,
            Ok([_, true, _]) => WakeReason::Request,
            Ok([.., true]) => WakeReason::Ready,
            _ => WakeReason::Timeout,
        }
    }

    fn record(&self, name: &str) -> Option<&File> {
        let open = || {
            let file = match Directory::open(self.resources.root) {
                Ok(Some(directory)) => directory.open_or_create(&format!("{name}.sensor")).map(Some),
                missing => missing.map(|_| None),
            };
            let log = |error: &_| tracing::debug!(%error, "{name}: the learned state cannot be saved");
            file.inspect_err(log).ok().flatten()
        };
        self.record.get_or_init(open).as_ref()
    }
}

impl LinkState<'_, System<'_>> {
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
    type Port = Port;
    type Transport<P: Payload + ?Sized> = SharedMemory<P>;

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
            let lock = NameLock::acquire(self.resources.root, self.sensor)?;
            let waker = WakeSender::new(self.resources.node, self.sensor)?;
            let _ = self.name.set(HeldName { waker, _lock: lock });
        }
        Ok(())
    }

    fn open(&self, source: &PortSpec, baud: u32) -> Option<Result<Port, PortError>> {
        if let Some(dial) = self.pending_connection.take() {
            return Some(dial.finish());
        }
        match Port::connect(source) {
            None => Some(Port::try_open(source, baud, &AtomicBool::new(false))),
            Some(Err(error)) => Some(Err(error)),
            Some(Ok(dial)) => {
                self.pending_connection.replace(Some(dial));
                None
            }
        }
    }

    fn explain(&self, error: &PortError, source: &PortSpec) -> Failure {
        error.explain(source)
    }

    fn altering_program(&self, source: &PortSpec) -> Option<String> {
        match source {
            PortSpec::Tty(path) => scanhub_port::altering_program(path),
            PortSpec::Tcp { .. } | PortSpec::File { .. } => None,
        }
    }

    fn take_kept_port(&self, name: &str, source: &PortSpec, baud: u32) -> Option<Port> {
        let mut adopted = None;
        while let Some(line) = self.resources.service.take(name) {
            match Port::adopt(line, source, baud).filter(|_| adopted.is_none()) {
                Some(port) => adopted = Some(port),
                // The port is unusable. Release it, because the service manager would otherwise pass it to the next hub
                // again.
                None => self.resources.service.release(name),
            }
        }
        adopted
    }

    fn keep_open(&self, name: &str, line: &Port) {
        if let Port::Tty(_) = line {
            self.resources.service.keep(name, line);
        }
    }

    fn release(&self, name: &str) {
        self.resources.service.release(name);
    }

    fn transport<P: Payload + ?Sized>(&self, sensor: &str) -> Result<SharedMemory<P>, Failure> {
        let (max_subscribers, topic) = (self.resources.limits.subscribers, P::TOPIC.name());
        let medium = SharedMemory::new(self.resources.node, sensor, &self.resources.limits)?;
        let slots = medium.subscriber_capacity();
        if slots < max_subscribers {
            tracing::warn!(
                "{sensor}/{topic} has slots for {slots} subscribers, not for {max_subscribers}: those of an earlier hub keep it; stop \
                 them, then start the hub again"
            );
        }
        Ok(medium)
    }

    fn attach_count(&self) -> Option<u32> {
        self.name.get().map(|name| name.waker.attached())
    }

    fn has_listeners(&self) -> bool {
        self.name.get().is_some_and(|name| name.waker.has_listeners())
    }

    fn ring(&self, ring: DoorbellWord) {
        if let Some(name) = self.name.get() {
            name.waker.ring(ring);
        }
    }

    fn notify_event(&self, why: WakeEvent) {
        if let Some(Err(failure)) = self.name.get().map(|name| name.waker.notify(why)) {
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

impl PortIo for Port {
    fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        self.read(buffer)
    }

    fn write(&self, bytes: &[u8]) -> io::Result<()> {
        self.write(bytes)
    }

    fn set_baud(&self, baud: u32) -> io::Result<Option<io::Error>> {
        self.try_baud(baud)
    }

    fn alteration(&self) -> io::Result<Option<SettingsChange>> {
        self.changed_settings()
    }

    fn restore(&self, baud: u32) -> io::Result<()> {
        self.restore(baud)
    }

    fn set_dtr(&self, on: bool) -> io::Result<()> {
        self.set_dtr(on)
    }

    fn buffered_len(&self) -> Option<usize> {
        self.buffered_bytes()
    }

    fn read_budget(&self, baud: u32) -> Option<ReadBudget> {
        self.read_budget(baud)
    }

    fn line_errors(&self) -> u64 {
        self.line_errors()
    }

    fn device(&self) -> Option<&Path> {
        self.device()
    }

    fn is_simulated(&self) -> bool {
        self.is_simulated()
    }
}

#[cold]
fn log_unnotified(failure: &Failure) {
    tracing::debug!(%failure, "some subscribers were not woken");
}

/// Maximum wait during which the thread sleeps instead of polling.
const MAX_SLEEP: Nanos = 20 * MILLIS;
/// Maximum time for which requests, the end of the hub and the loss of a line may go unnoticed.
const MAX_POLL_INTERVAL: Nanos = 50 * MILLIS;
/// Time that the start of the hub waits for the connection to a serial server.
const START_TIMEOUT: Nanos = 250 * MILLIS;
