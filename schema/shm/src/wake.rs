//! Wake-ups of the subscribers of a sensor: a doorbell for programs that use this code, and an event service for
//! programs in other languages. The hub wakes both kinds of subscribers.
//!
//! A thread can sleep on the events of several sensors at once. Sleeping and taking the pending wake-ups are two calls,
//! so that samples can be received in between. Wake-ups need not be taken before each receive: no sample is missed
//! while a wake-up is pending, and taking wake-ups costs several system calls.
#![allow(unsafe_code)]

use std::os::fd::BorrowedFd;
use std::time::Duration;

use iceoryx2::port;
use iceoryx2::port::listener::{ListenerCreateError, ListenerWaitError};
use iceoryx2::prelude::ipc::Service as LocalService;
use iceoryx2::prelude::{EventId, FileDescriptorBased, PortFactory};
use iceoryx2::service::Service;
use iceoryx2::service::port_factory::event;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;

use scanhub_schema::{DoorbellWord, Failure, Kind, Topic, WakeEvent, limits, parse_service_name};

use crate::doorbell::{DoorbellRinger, count_attached};
use crate::processes::Node;
use crate::resource_limits::check_client;
use crate::service::{OpenFailure, clients_full, create, name, open, port_failure};

/// Event service that wakes the subscribers of one sensor.
pub type WakeService<S = LocalService> = event::PortFactory<S>;
/// Port that wakes subscribers.
pub type Notifier<S = LocalService> = port::notifier::Notifier<S>;
/// Port on which a subscriber sleeps.
pub type Listener<S = LocalService> = port::listener::Listener<S>;

/// The hub's end of both kinds of wake-ups. The sender wakes subscribers with [`WakeEvent::HubUp`] when it is created,
/// and with [`WakeEvent::HubDown`] when it is dropped.
pub struct WakeSender<S: Service = LocalService> {
    ringer: DoorbellRinger,
    notifier: Notifier<S>,
    service: WakeService<S>,
}

impl<S: Service> WakeSender<S> {
    /// Creates the sender of `sensor`. Create the sender before the sensor's topics, because a subscriber that finds a
    /// topic sleeps on the events of this sender.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if memory is short, and [`Kind::Incompatible`] if the service has another
    /// layout.
    pub fn new(node: &Node<S>, sensor: &str) -> Result<WakeSender<S>, Failure> {
        let ringer = DoorbellRinger::open_or_create(node, sensor)?;
        let service = create_service(node, sensor)?;
        Ok(WakeSender { ringer, notifier: notifier(&service, WakeEvent::Telegram as usize)?, service })
    }

    /// Wakes all threads that sleep on the doorbell word `word`, with one system call.
    pub fn ring(&self, word: DoorbellWord) {
        self.ringer.ring(word);
    }

    /// Returns a number that changes when a subscriber or listener of the sensor attaches through a library of this
    /// project. The number may stay the same if another program attaches.
    pub fn attached(&self) -> u32 {
        self.ringer.attached()
    }

    /// Returns whether the event service has a listener.
    pub fn has_listeners(&self) -> bool {
        self.service.dynamic_config().number_of_listeners() > 0
    }

    /// Sends `event` to all listeners.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if `event` could not be sent to some of the listeners.
    pub fn notify(&self, event: WakeEvent) -> Result<(), Failure> {
        if !self.has_listeners() {
            return Ok(());
        }
        let notified = self.notifier.notify_with_custom_event_id(EventId::new(event as usize));
        notified
            .map(|_| ())
            .map_err(|error| Failure::new(Kind::Failed, format!("cannot wake subscribers: {error:?}"), ""))
    }

    /// Wakes all subscribers for `event`, regardless of their topics.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`notify`](WakeSender::notify).
    pub fn wake(&self, event: WakeEvent) -> Result<(), Failure> {
        DoorbellWord::ALL.into_iter().for_each(|word| self.ring(word));
        self.notify(event)
    }

    /// Returns the event service.
    pub fn service(&self) -> &WakeService<S> {
        &self.service
    }
}

/// Doorbell words that must be rung, because subscribers have received samples since the last ring.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PendingWakeups([bool; DoorbellWord::ALL.len()]);

impl PendingWakeups {
    /// Records that `receivers` subscribers received a sample of `topic`.
    pub fn note_sample(&mut self, topic: Topic, receivers: usize) {
        self.0[topic.spec().doorbell_word as usize] |= receivers > 0;
    }

    /// Returns whether `word` must be rung, and records it as rung.
    pub fn take_due(&mut self, word: DoorbellWord) -> bool {
        std::mem::take(&mut self.0[word as usize])
    }
}

fn create_service<S: Service>(node: &Node<S>, sensor: &str) -> Result<WakeService<S>, Failure> {
    let service = name(&WakeEvent::service(sensor))?;
    create(node, &service, || {
        let builder = node.service_builder(&service).event();
        builder
            .max_notifiers(limits::MAX_NOTIFIERS)
            .max_listeners(limits::MAX_LISTENERS)
            .max_nodes(limits::MAX_NODES)
            .event_id_max_value(limits::MAX_EVENT_ID)
            .notifier_created_event(EventId::new(WakeEvent::HubUp as usize))
            .notifier_dropped_event(EventId::new(WakeEvent::HubDown as usize))
            .notifier_dead_event(EventId::new(WakeEvent::HubDown as usize))
            .open_or_create()
            .map_err(OpenFailure::from)
    })
}

/// Returns the event service of `sensor`, for subscribers. `None` if no hub has created it yet.
///
/// # Errors
///
/// Returns [`Kind::ResourceExhausted`] if memory or descriptors are short, and [`Kind::Incompatible`] if the service
/// has another layout.
pub fn open_wake<S: Service>(node: &Node<S>, sensor: &str) -> Result<Option<WakeService<S>>, Failure> {
    open_event(node, &WakeEvent::service(sensor))
}

/// Returns the event service `service`, or `None` if this service does not exist.
pub(crate) fn open_event<S: Service>(
    node: &Node<S>,
    service: &str,
) -> Result<Option<WakeService<S>>, Failure> {
    let service = name(service)?;
    open(node, &service, node.service_builder(&service).event().open())
}

/// Returns a notifier whose default event ID is `event`.
pub(crate) fn notifier<S: Service>(service: &WakeService<S>, event: usize) -> Result<Notifier<S>, Failure> {
    let builder = service.notifier_builder().default_event_id(EventId::new(event));
    builder.create().map_err(|error| port_failure(service.name(), &error))
}

/// Returns a listener of the events of a sensor, and announces the listener to the hub. The hub notifies the listener
/// from the next event on.
///
/// # Errors
///
/// Returns [`Kind::ResourceExhausted`] if memory, descriptors or slots for subscribers are short.
pub fn listener<S: Service>(node: &Node<S>, wake: &WakeService<S>) -> Result<Listener<S>, Failure> {
    let listener = create_listener(wake)?;
    if let Some((sensor, _)) = parse_service_name(wake.name().as_str()) {
        count_attached(node, sensor);
    }
    Ok(listener)
}

/// Returns a listener of the event service `wake`.
pub(crate) fn create_listener<S: Service>(wake: &WakeService<S>) -> Result<Listener<S>, Failure> {
    check_client()?;
    wake.listener_builder().create().map_err(|error| match error {
        ListenerCreateError::ExceedsMaxSupportedListeners => clients_full(wake.name(), limits::MAX_LISTENERS),
        other => port_failure(wake.name(), &other),
    })
}

/// Sleeps until one of `listeners` is woken, a signal arrives, or `timeout` elapses. Wake-ups stay pending. Take them
/// with [`take_wakeups`], and then receive once more before the next sleep.
///
/// # Errors
///
/// Returns [`Kind::ResourceExhausted`] if the system cannot wait.
pub fn sleep<S: Service>(listeners: &[&Listener<S>], timeout: Duration) -> Result<(), Failure>
where
    Listener<S>: FileDescriptorBased,
{
    let mut fds: Vec<PollFd<'_>> = listeners
        .iter()
        .map(|listener| PollFd::from_borrowed_fd(descriptor(listener), PollFlags::IN))
        .collect();
    let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: i64::from(timeout.subsec_nanos()) };
    match poll(&mut fds, Some(&timeout)) {
        Ok(_) | Err(Errno::INTR) => Ok(()),
        Err(error) => Err(wait_failure(&error)),
    }
}

/// Returns a descriptor that is readable while wake-ups of `listener` are pending, for programs that also wait for
/// other things.
pub fn descriptor<S: Service>(listener: &Listener<S>) -> BorrowedFd<'_>
where
    Listener<S>: FileDescriptorBased,
{
    // SAFETY: the descriptor is open while the listener lives, and the listener is borrowed as long as the result.
    unsafe { BorrowedFd::borrow_raw(listener.file_descriptor().native_handle()) }
}

/// Takes all pending wake-ups of `listeners`, and returns whether there were any. To miss no sample, receive after this
/// call.
///
/// # Errors
///
/// Returns [`Kind::ResourceExhausted`] if a listener reports an error.
pub fn take_wakeups<S: Service>(listeners: &[&Listener<S>]) -> Result<bool, Failure> {
    let mut any = false;
    for listener in listeners {
        match listener.try_wait(|_| any = true) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
            Err(error) => return Err(wait_failure(&error)),
        }
    }
    Ok(any)
}

fn wait_failure(error: &dyn std::fmt::Debug) -> Failure {
    Failure::new(
        Kind::ResourceExhausted,
        format!("cannot wait for the hub: {error:?}"),
        "`ulimit -n` may be too small",
    )
}
