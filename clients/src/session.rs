//! A process's stay in a domain, over several lives of its hub: membership, the listeners that wake it, and the news
//! that a hub went or came. Refuses to know what is followed.

use std::time::{Duration, Instant};

use schema::ipc::{self, Listener, Node, Payload, Subscriber};
use schema::{Domain, Failure, holder};

use crate::presence::{Change, Presence};

/// The longest wait: so often the hub is looked for, and the caller's reasons to stop are seen.
const LONGEST_WAIT: Duration = Duration::from_millis(100);

/// Membership in the first live one of several domains.
pub(crate) struct Session {
    presence: Presence,
    joined: Option<Joined>,
    number: u32,
    /// Wake-ups were taken since the last sleep, and samples looked for since.
    taken: bool,
}

struct Joined {
    domain: Domain,
    node: Node,
    listeners: Vec<(String, Listener)>,
}

impl Session {
    /// Will join the first live one of `places`, as soon as one is.
    pub(crate) fn new(places: Vec<Domain>) -> Session {
        Session { presence: Presence::new(places), joined: None, number: 0, taken: false }
    }

    /// Looks whether the hub is there, and joins its domain if it is a new place.
    ///
    /// [`Kind::Short`](schema::Kind) if memory or descriptors are; who has joined already goes on without a look.
    pub(crate) fn look(&mut self) -> Result<Change, Failure> {
        let change = self.presence.look();
        let Some(domain) = self.presence.domain() else {
            return match self.presence.short() {
                Some(short) if self.joined.is_none() => Err(short),
                _ => Ok(change),
            };
        };
        if self.joined.as_ref().is_none_or(|joined| joined.domain != *domain) {
            let node = ipc::client_node(domain)?;
            self.joined = Some(Joined { domain: domain.clone(), node, listeners: Vec::new() });
            self.number += 1;
        }
        Ok(change)
    }

    /// Where the hub lives, if there is one.
    pub(crate) fn domain(&self) -> Option<&Domain> {
        self.presence.domain()
    }

    /// There is a hub, and not only a listener that stands for those of other machines.
    pub(crate) fn hub_lives(&self) -> bool {
        self.domain().is_some_and(|domain| matches!(holder(domain.root()), Ok(Some(_))))
    }

    /// What to tell who cannot wait for a hub.
    pub(crate) fn no_hub(&self) -> Failure {
        self.presence.no_hub()
    }

    /// Counts the domains joined: ports of an earlier one are to be opened again.
    pub(crate) fn number(&self) -> u32 {
        self.number
    }

    /// A subscriber of `sensor`, or nothing as long as its hub or topic is not there. The listener comes first, so that
    /// nothing is sent unheard between the two.
    pub(crate) fn subscribe<P: Payload + ?Sized>(
        &mut self,
        sensor: &str,
    ) -> Result<Option<Subscriber<P>>, Failure> {
        let (Some(_), Some(joined)) = (self.presence.domain(), &mut self.joined) else {
            return Ok(None);
        };
        if !joined.listeners.iter().any(|(name, _)| name == sensor) {
            let Some(wake) = ipc::open_wake(&joined.node, sensor)? else {
                return Ok(None);
            };
            joined.listeners.push((sensor.to_owned(), ipc::listener(&wake)?));
        }
        P::open(&joined.node, sensor)?.map(|topic| P::subscriber(&topic)).transpose()
    }

    /// Sleeps until something was sent, at the latest until `until`, and 100 ms at most; returns at once if something
    /// may have been sent since the caller looked. Hold no sample meanwhile.
    pub(crate) fn wait(&mut self, until: Option<Instant>) -> Result<(), Failure> {
        self.wait_for(until.map(|until| until.saturating_duration_since(Instant::now())))
    }

    /// As [`wait`](Self::wait), for a time instead of until one.
    pub(crate) fn wait_for(&mut self, left: Option<Duration>) -> Result<(), Failure> {
        let listeners: Vec<&Listener> = match &self.joined {
            Some(joined) => joined.listeners.iter().map(|(_, listener)| listener).collect(),
            None => Vec::new(),
        };
        if !self.taken && ipc::take_wakeups(&listeners)? {
            self.taken = true;
            return Ok(());
        }
        self.taken = false;
        ipc::sleep(&listeners, left.map_or(LONGEST_WAIT, |left| left.min(LONGEST_WAIT)))
    }
}
