//! What wakes the consumers of one sensor: a bell for those that share this code, an event for all other languages. Hides
//! from the hub which of the two is listened to.

use iceoryx2::port::listener::ListenerCreateError;
use iceoryx2::prelude::EventId;

use super::bell::Ringer;
use super::trouble::{Trouble, create, full, no_port, open};
use super::{Listener, Node, Notifier, PortFactory, WakeService, name};
use crate::shortage::check_client;
use crate::{Failure, Kind, Ring, Topic, Wake, limits};

/// The hub's end. When created, it wakes consumers with [`Wake::HubUp`]; when dropped, with [`Wake::HubDown`].
pub struct Waker {
    ringer: Ringer,
    notifier: Notifier,
    service: WakeService,
}

impl Waker {
    /// Makes that of `sensor`, to be made before its topics: who finds those sleeps at it.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if memory is, [`Kind::Failed`] if the service has another layout.
    pub fn new(node: &Node, sensor: &str) -> Result<Waker, Failure> {
        let ringer = Ringer::hang(node, sensor)?;
        let service = create_service(node, sensor)?;
        let notifier = service
            .notifier_builder()
            .default_event_id(EventId::new(Wake::Telegram as usize))
            .create()
            .map_err(|error| no_port(service.name(), &error))?;
        Ok(Waker { ringer, notifier, service })
    }

    /// Wakes those who sleep at the bell for topics of `ring`, with one call.
    pub fn ring(&self, ring: Ring) {
        self.ringer.ring(ring);
    }

    /// Tells those who listen to the event `why`.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if some were not told.
    pub fn tell(&self, why: Wake) -> Result<(), Failure> {
        if self.service.dynamic_config().number_of_listeners() == 0 {
            return Ok(());
        }
        let told = self.notifier.notify_with_custom_event_id(EventId::new(why as usize));
        told.map(|_| ())
            .map_err(|error| Failure::new(Kind::Failed, format!("cannot wake consumers: {error:?}"), ""))
    }

    /// Wakes all consumers for `why`, whatever they follow.
    ///
    /// # Errors
    ///
    /// As [`tell`](Waker::tell).
    pub fn wake(&self, why: Wake) -> Result<(), Failure> {
        Ring::ALL.into_iter().for_each(|ring| self.ring(ring));
        self.tell(why)
    }

    /// Returns the event service.
    pub fn service(&self) -> &WakeService {
        &self.service
    }
}

/// The rings that are due: since they were last rung, somebody got a sample of which they tell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DueRings([bool; Ring::ALL.len()]);

impl DueRings {
    /// Takes note that `reached` consumers got a sample of `topic`.
    pub fn note(&mut self, topic: Topic, reached: usize) {
        self.0[topic.row().ring as usize] |= reached > 0;
    }

    /// Returns whether `ring` is due, and takes it as rung.
    pub fn take(&mut self, ring: Ring) -> bool {
        std::mem::take(&mut self.0[ring as usize])
    }
}

fn create_service(node: &Node, sensor: &str) -> Result<WakeService, Failure> {
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
            .map_err(Trouble::from)
    })
}

/// Returns the event service of `sensor`, or nothing as long as no hub has made it: for consumers.
///
/// # Errors
///
/// [`Kind::Short`] if memory or descriptors are short, [`Kind::Failed`] if the service is of another layout.
pub fn open_wake(node: &Node, sensor: &str) -> Result<Option<WakeService>, Failure> {
    let service = name(&Wake::service(sensor))?;
    open(node, &service, node.service_builder(&service).event().open())
}

/// Returns a consumer's end of the event.
///
/// # Errors
///
/// [`Kind::Short`] if memory, descriptors or places for consumers are.
pub fn listener(wake: &WakeService) -> Result<Listener, Failure> {
    check_client()?;
    wake.listener_builder().create().map_err(|error| match error {
        ListenerCreateError::ExceedsMaxSupportedListeners => full(wake.name(), limits::LISTENERS),
        other => no_port(wake.name(), &other),
    })
}
