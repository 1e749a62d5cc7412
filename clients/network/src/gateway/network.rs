//! Where datagrams go: the groups on an interface and the hosts that get copies, each datagram to all of them. Refuses to
//! know what a datagram says.

use std::num::NonZeroU64;
use std::sync::atomic::AtomicBool;

use crate::lan::outgoing::{Form, Outgoing, Sample, Transmit};
use scanhub_schema::datagram::{HEAD, MTU_ETHERNET, MTU_LEAST, PORT};
use scanhub_schema::{Failure, Kind, Topic};

use super::udp_destination::UdpDestination;
use super::uplink::Uplink;
use crate::forward::Carrier;
use crate::gateway_identity::Life;
use crate::now;

/// What goes out, and the account of it.
pub(super) struct Network {
    pub(super) life: Life,
    pub(super) outgoing: Outgoing,
    pub(super) destinations: Destinations,
}

/// Where it goes.
pub(super) struct Destinations {
    /// The groups, if an interface was named for them.
    pub(super) groups: Option<Groups>,
    /// Hosts that get copies.
    pub(super) copies: Vec<UdpDestination>,
}

/// The groups on an interface.
pub(super) struct Groups {
    pub(super) interface: Uplink,
    destination: UdpDestination,
}

impl Network {
    /// Datagrams of at most `longest` bytes, as `life`, to the groups on `interface`, if there is one, which routers pass on
    /// `ttl` times, and to the hosts in `to`.
    ///
    /// [`Kind::Configuration`] if `longest` is not possible, a host is none or is named twice; [`Kind::Failed`] without sockets;
    /// [`Kind::Interrupted`] if `stop` is set before it is known where the hosts are.
    pub(super) fn open(
        life: Life,
        interface: Option<Uplink>,
        to: &[String],
        form: Form,
        ttl: u8,
        longest: usize,
        stop: &AtomicBool,
    ) -> Result<Network, Failure> {
        if !(MTU_LEAST..=MTU_ETHERNET).contains(&longest) {
            let what = format!("datagrams of {longest} bytes are not possible");
            let hint = format!("from {MTU_LEAST} to {MTU_ETHERNET}, the most that an Ethernet carries");
            return Err(Failure::new(Kind::Configuration, what, hint));
        }
        let (port, more) = match form {
            Form::Sealed | Form::Authenticated(_) => (PORT, 0),
            Form::Bare => (BARE_PORT, u16::from(u8::MAX)),
        };
        let groups = interface.map(|interface| {
            let destination = UdpDestination::groups(interface.name(), port, ttl)?;
            Ok(Groups { interface, destination })
        });
        let mut groups = groups.transpose()?;
        let mut copies: Vec<UdpDestination> = Vec::new();
        for text in to {
            let copy = UdpDestination::host(text, more, stop)?;
            if let Some(other) = copies.iter().find(|other| other.is_as(&copy)) {
                let what = format!("cannot send to {text}: it is named twice");
                let hint = format!("{} already gets a copy; name each host and port once", other.name);
                return Err(Failure::new(Kind::Configuration, what, hint));
            }
            copies.push(copy);
        }
        let room = groups.as_mut().and_then(|groups| {
            groups.use_interface();
            groups.destination.room(groups.interface.index()?)
        });
        let longest = longest.min(room.unwrap_or(longest)).max(HEAD);
        let outgoing = Outgoing::new(life.hub, life.epoch, form, longest);
        Ok(Network { life, outgoing, destinations: Destinations { groups, copies } })
    }
}

impl Carrier for Network {
    fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize {
        self.outgoing.follow(name, every)
    }

    fn wants(&self, sensor: usize, topic: Topic) -> bool {
        self.outgoing.wants(sensor, topic)
    }

    fn sample(&mut self, sensor: usize, sample: &Sample<'_>) {
        self.outgoing.sample(sensor, sample, now(), &mut self.destinations);
    }
}

impl Destinations {
    /// All destinations, the groups first.
    pub(super) fn all(&self) -> impl Iterator<Item = &UdpDestination> {
        self.groups.iter().map(|groups| &groups.destination).chain(&self.copies)
    }

    /// As [`all`](Destinations::all).
    pub(super) fn all_mut(&mut self) -> impl Iterator<Item = &mut UdpDestination> {
        self.groups.iter_mut().map(|groups| &mut groups.destination).chain(&mut self.copies)
    }

    /// Goes on where the interface is now; whether its state is another one than before.
    pub(super) fn look(&mut self) -> bool {
        let Some(groups) = &mut self.groups else { return false };
        let changed = groups.interface.look();
        if changed {
            groups.use_interface();
        }
        changed
    }
}

impl Transmit for Destinations {
    /// To all of them. It is sent if the groups were sent it, or without groups a host at least.
    fn transmit(&mut self, datagram: &[u8], group: u8, above: u8) -> bool {
        let of_groups = self.groups.as_mut().map(|groups| groups.destination.send(datagram, group, above));
        let mut of_copies = false;
        for copy in &mut self.copies {
            of_copies |= copy.send(datagram, group, above);
        }
        of_groups.unwrap_or(of_copies)
    }
}

impl Groups {
    fn use_interface(&mut self) {
        self.destination.is_cut = !self.interface.is_up();
        if let Some(index) = self.interface.index() {
            self.destination.use_interface(index);
        }
    }
}

/// The port of sensor 0 where nothing but telegrams goes out; the next sensor has the next one.
const BARE_PORT: u16 = PORT + 1;
