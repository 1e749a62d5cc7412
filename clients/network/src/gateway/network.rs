//! Destinations of a gateway: the groups on an interface, and hosts that get copies. Each datagram is sent to all of
//! them.

use std::num::NonZeroU64;
use std::sync::atomic::AtomicBool;

use scanhub_schema::datagram::{HEADER_LEN, MIN_MTU, MTU_ETHERNET, PORT};
use scanhub_schema::{Failure, Kind, Topic};

use super::interface_monitor::InterfaceMonitor;
use super::udp_destination::UdpDestination;
use crate::forward::SampleSink;
use crate::gateway_identity::GatewayIdentity;
use crate::lan::outgoing::{Form, Outgoing, Sample, Transmit};
use crate::now;

/// Sending end of a gateway, with its identity and its destinations.
pub(super) struct Network {
    pub(super) identity: GatewayIdentity,
    pub(super) outgoing: Outgoing,
    pub(super) destinations: Destinations,
}

/// All destinations of a gateway.
pub(super) struct Destinations {
    /// Multicast groups; `None` if the user named no interface for them.
    pub(super) groups: Option<Groups>,
    /// Hosts that get copies.
    pub(super) copies: Vec<UdpDestination>,
}

/// Multicast groups on one interface.
pub(super) struct Groups {
    pub(super) interface: InterfaceMonitor,
    destination: UdpDestination,
}

impl Network {
    /// Opens a socket for each destination. The destinations are the groups on `interface`, with this `ttl`, if an
    /// interface is named, and the hosts in `to`. Datagrams have at most `longest` bytes, or fewer if the interface
    /// carries only shorter ones.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] if `longest` is out of range, or a host is not valid or named twice,
    /// [`Kind::Failed`] if a socket cannot be opened, and [`Kind::Interrupted`] if `stop` is set before all hosts are
    /// resolved.
    pub(super) fn open(
        identity: GatewayIdentity,
        interface: Option<InterfaceMonitor>,
        to: &[String],
        form: Form,
        ttl: u8,
        longest: usize,
        stop: &AtomicBool,
    ) -> Result<Network, Failure> {
        if !(MIN_MTU..=MTU_ETHERNET).contains(&longest) {
            let what = format!("datagrams of {longest} bytes are not possible");
            let hint = format!("from {MIN_MTU} to {MTU_ETHERNET}, the most that an Ethernet carries");
            return Err(Failure::new(Kind::Configuration, what, hint));
        }
        let (port, more_ports) = match form {
            Form::Sealed | Form::Authenticated(_) => (PORT, 0),
            Form::Bare => (BARE_PORT, u16::from(u8::MAX)),
        };
        let groups = interface.map(|interface| {
            let destination = UdpDestination::groups(interface.name(), port, ttl)?;
            Ok::<_, Failure>(Groups { interface, destination })
        });
        let mut groups = groups.transpose()?;
        let mut copies: Vec<UdpDestination> = Vec::new();
        for text in to {
            let copy = UdpDestination::host(text, more_ports, stop)?;
            if let Some(other) = copies.iter().find(|other| other.is_same(&copy)) {
                let what = format!("cannot send to {text}: it is named twice");
                let hint = format!("{} already gets a copy; name each host and port once", other.name);
                return Err(Failure::new(Kind::Configuration, what, hint));
            }
            copies.push(copy);
        }
        let max_len = groups.as_mut().and_then(|groups| {
            groups.use_interface();
            groups.destination.max_len(groups.interface.index()?)
        });
        let longest = longest.min(max_len.unwrap_or(longest)).max(HEADER_LEN);
        let outgoing = Outgoing::new(identity.hub, identity.epoch, form, longest);
        Ok(Network { identity, outgoing, destinations: Destinations { groups, copies } })
    }
}

impl SampleSink for Network {
    fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize {
        self.outgoing.follow(name, every)
    }

    fn needs(&self, sensor: usize, topic: Topic) -> bool {
        self.outgoing.needs(sensor, topic)
    }

    fn sample(&mut self, sensor: usize, sample: &Sample<'_>) {
        self.outgoing.sample(sensor, sample, now(), &mut self.destinations);
    }
}

impl Destinations {
    /// Returns all destinations, the groups first.
    pub(super) fn all(&self) -> impl Iterator<Item = &UdpDestination> {
        self.groups.iter().map(|groups| &groups.destination).chain(&self.copies)
    }

    /// Returns the same destinations as [`all`](Destinations::all), as mutable references.
    pub(super) fn all_mut(&mut self) -> impl Iterator<Item = &mut UdpDestination> {
        self.groups.iter_mut().map(|groups| &mut groups.destination).chain(&mut self.copies)
    }

    /// Applies changes of the interface's state to the groups. Returns whether the state has changed since the last
    /// call.
    pub(super) fn update(&mut self) -> bool {
        let Some(groups) = &mut self.groups else { return false };
        let changed = groups.interface.update();
        if changed {
            groups.use_interface();
        }
        changed
    }
}

impl Transmit for Destinations {
    /// Sends a datagram to all destinations. Returns whether it was sent to the groups or, if the gateway has no
    /// groups, to at least one host.
    fn transmit(&mut self, datagram: &[u8], group: u8, above: u8) -> bool {
        let to_groups = self.groups.as_mut().map(|groups| groups.destination.send(datagram, group, above));
        let mut to_copies = false;
        for copy in &mut self.copies {
            to_copies |= copy.send(datagram, group, above);
        }
        to_groups.unwrap_or(to_copies)
    }
}

impl Groups {
    /// Makes the groups' socket send on the interface, with the current index and state of the interface.
    fn use_interface(&mut self) {
        self.destination.is_down = !self.interface.is_up();
        if let Some(index) = self.interface.index() {
            self.destination.use_interface(index);
        }
    }
}

/// Port of sensor 0 for bare telegrams. Each further sensor has the next port.
const BARE_PORT: u16 = PORT + 1;
