//! Waking the subscribers of a sensor: a doorbell for programs that use this code, and an event service for all other
//! languages. The hub rings and notifies without knowing which of the two has subscribers.
//!
//! A thread can sleep on the events of several sensors at once. Waking up and taking the wake-ups are two calls, so
//! that samples can be received in between. A pending wake-up loses nothing, and taking it costs several system calls.
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

use scanhub_schema::{Failure, Kind, Ring, Topic, Wake, limits, of_service};

use crate::doorbell::{DoorbellRinger, note_attached};
use crate::processes::Node;
use crate::service::{OpenFailure, create, full, name, no_port, open};
use crate::shortage::check_client;

/// Event service that wakes the subscribers of one sensor.
pub type WakeService<S = LocalService> = event::PortFactory<S>;
/// Wakes subscribers.
pub type Notifier<S = LocalService> = port::notifier::Notifier<S>;
/// Sleeps until it is woken.
pub type Listener<S = LocalService> = port::listener::Listener<S>;

/// The hub's end. It wakes subscribers with [`Wake::HubUp`] when it is created, and with [`Wake::HubDown`] when it is
/// dropped.
pub struct Waker<S: Service = LocalService> {
    ringer: DoorbellRinger,
    notifier: Notifier<S>,
    service: WakeService<S>,
}

impl<S: Service> Waker<S> {
    /// Creates the waker of `sensor`. Create it before the sensor's topics, because a subscriber that finds a topic
    /// sleeps at it.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Short`] if memory is short, and [`Kind::Incompatible`] if the service has another layout.
    pub fn new(node: &Node<S>, sensor: &str) -> Result<Waker<S>, Failure> {
        let ringer = DoorbellRinger::hang(node, sensor)?;
        let service = create_service(node, sensor)?;
        Ok(Waker { ringer, notifier: notifier(&service, Wake::Telegram as usize)?, service })
    }

    /// Wakes all threads that sleep at the doorbell word `ring`, with one system call.
    pub fn ring(&self, ring: Ring) {
        self.ringer.ring(ring);
    }

    /// Returns a number that changes when a subscriber or listener of the sensor attaches by a library of this project.
    /// Other programs may not change it.
    pub fn attached(&self) -> u32 {
        self.ringer.attached()
    }

    /// Returns whether the event has a listener.
    pub fn has_listeners(&self) -> bool {
        self.service.dynamic_config().number_of_listeners() > 0
    }

    /// Sends the event `why` to its listeners.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if it could not be sent to some of them.
    pub fn tell(&self, why: Wake) -> Result<(), Failure> {
        if !self.has_listeners() {
            return Ok(());
        }
        let told = self.notifier.notify_with_custom_event_id(EventId::new(why as usize));
        told.map(|_| ())
            .map_err(|error| Failure::new(Kind::Failed, format!("cannot wake consumers: {error:?}"), ""))
    }

    /// Wakes all subscribers for `why`, whatever topics they have.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`tell`](Waker::tell).
    pub fn wake(&self, why: Wake) -> Result<(), Failure> {
        Ring::ALL.into_iter().for_each(|ring| self.ring(ring));
        self.tell(why)
    }

    /// Returns the event service.
    pub fn service(&self) -> &WakeService<S> {
        &self.service
    }
}

/// Doorbell words to ring: a subscriber has received a sample of one of their topics since they were last rung.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DueRings([bool; Ring::ALL.len()]);

impl DueRings {
    /// Records that `reached` subscribers received a sample of `topic`.
    pub fn note(&mut self, topic: Topic, reached: usize) {
        self.0[topic.row().ring as usize] |= reached > 0;
    }

    /// Returns whether `ring` must be rung, and records it as rung.
    pub fn take(&mut self, ring: Ring) -> bool {
        std::mem::take(&mut self.0[ring as usize])
    }
}

fn create_service<S: Service>(node: &Node<S>, sensor: &str) -> Result<WakeService<S>, Failure> {
    let service = name(&Wake::service(sensor))?;
    create(node, &service, || {
        let builder = node.service_builder(&service).event();
        builder
            .max_notifiers(limits::NOTIFIERS)
            .max_listeners(limits::LISTENERS)
            .max_nodes(limits::NODES)
            .event_id_max_value(limits::EVENT_ID)
            .notifier_created_event(EventId::new(Wake::HubUp as usize))
            .notifier_dropped_event(EventId::new(Wake::HubDown as usize))
            .notifier_dead_event(EventId::new(Wake::HubDown as usize))
            .open_or_create()
            .map_err(OpenFailure::from)
    })
}

/// Returns the event service of `sensor`, for subscribers. `None` if no hub has created it yet.
///
/// # Errors
///
/// Returns [`Kind::Short`] if memory or descriptors are short, and [`Kind::Incompatible`] if the service has another
/// layout.
pub fn open_wake<S: Service>(node: &Node<S>, sensor: &str) -> Result<Option<WakeService<S>>, Failure> {
    open_event(node, &Wake::service(sensor))
}

/// Returns the event service `service`; `None` if it does not exist.
pub(crate) fn open_event<S: Service>(
    node: &Node<S>,
    service: &str,
) -> Result<Option<WakeService<S>>, Failure> {
    let service = name(service)?;
    open(node, &service, node.service_builder(&service).event().open())
}

/// Returns a notifier of the event whose default event ID is `event`.
pub(crate) fn notifier<S: Service>(service: &WakeService<S>, event: usize) -> Result<Notifier<S>, Failure> {
    let builder = service.notifier_builder().default_event_id(EventId::new(event));
    builder.create().map_err(|error| no_port(service.name(), &error))
}

/// Returns a listener of the event of a sensor, and announces it to the hub, which notifies it from the next event on.
///
/// # Errors
///
/// Returns [`Kind::Short`] if memory, descriptors or places for subscribers are short.
pub fn listener<S: Service>(node: &Node<S>, wake: &WakeService<S>) -> Result<Listener<S>, Failure> {
    let listener = create_listener(wake)?;
    if let Some((sensor, _)) = of_service(wake.name().as_str()) {
        note_attached(node, sensor);
    }
    Ok(listener)
}

/// Returns a listener of any event.
pub(crate) fn create_listener<S: Service>(wake: &WakeService<S>) -> Result<Listener<S>, Failure> {
    check_client()?;
    wake.listener_builder().create().map_err(|error| match error {
        ListenerCreateError::ExceedsMaxSupportedListeners => full(wake.name(), limits::LISTENERS),
        other => no_port(wake.name(), &other),
    })
}

/// Sleeps until one of `listeners` is woken, a signal arrives, or `timeout` elapses. Wake-ups stay pending. Take them
/// with [`take_wakeups`], and then receive once more before the next sleep.
///
/// # Errors
///
/// Returns [`Kind::Short`] if the system cannot wait.
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
        Err(error) => Err(broken(&error)),
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

/// Takes all pending wake-ups of `listeners`, and returns whether there were any. To miss nothing, receive after this
/// call.
///
/// # Errors
///
/// Returns [`Kind::Short`] if a listener does not work.
pub fn take_wakeups<S: Service>(listeners: &[&Listener<S>]) -> Result<bool, Failure> {
    let mut any = false;
    for listener in listeners {
        match listener.try_wait(|_| any = true) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
            Err(error) => return Err(broken(&error)),
        }
    }
    Ok(any)
}

fn broken(error: &dyn std::fmt::Debug) -> Failure {
    Failure::new(Kind::Short, format!("cannot wait for the hub: {error:?}"), "`ulimit -n` may be too small")
}
