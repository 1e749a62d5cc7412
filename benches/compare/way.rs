//! The ways from one process to others that are compared, and for which cells each is run. Refuses to know how they work.

use super::message::SCAN;
use crate::support::Outcome;

/// How a message gets to its receivers, and what those wait at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    /// A topic of the hub; receivers sleep at its doorbell.
    Doorbell,
    /// A topic; receivers sleep at its event.
    Event,
    /// A topic; receivers look at its doorbell all the time.
    Spin,
    /// The scan topic itself, followed by the client library as programs do.
    Subscription,
    /// Datagrams to a UDP multicast group on the loopback.
    Multicast,
    /// A Unix datagram socket for each receiver.
    UnixDatagram,
    /// A Unix stream socket for each.
    UnixStream,
    /// A TCP connection on the loopback for each.
    Tcp,
    /// A pipe for each.
    Pipe,
    /// Nothing but a wake-up by futex.
    FutexFloor,
    /// Nothing but a wake-up by eventfd.
    EventfdFloor,
    /// Nothing but a cache line that another processor changes.
    SpinFloor,
}

impl Way {
    /// All, in the order of the table.
    pub(crate) const ALL: [Way; 12] = [
        Way::Doorbell,
        Way::Event,
        Way::Spin,
        Way::Subscription,
        Way::Multicast,
        Way::UnixDatagram,
        Way::UnixStream,
        Way::Tcp,
        Way::Pipe,
        Way::FutexFloor,
        Way::EventfdFloor,
        Way::SpinFloor,
    ];

    /// Its name in tables and on command lines.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Way::Doorbell => "topic, doorbell",
            Way::Event => "topic, event",
            Way::Spin => "topic, spinning",
            Way::Subscription => "topic, Subscription::next",
            Way::Multicast => "UDP multicast",
            Way::UnixDatagram => "Unix datagrams",
            Way::UnixStream => "Unix streams",
            Way::Tcp => "TCP",
            Way::Pipe => "pipes",
            Way::FutexFloor => "floor: futex",
            Way::EventfdFloor => "floor: eventfd",
            Way::SpinFloor => "floor: cache line",
        }
    }

    /// The one of this name.
    pub(crate) fn named(name: &str) -> Outcome<Way> {
        Ok(Way::ALL.into_iter().find(|way| way.name() == name).ok_or_else(|| format!("no way {name}"))?)
    }

    /// A mechanism that a user would take instead of topics.
    pub(crate) fn is_rival(self) -> bool {
        matches!(self, Way::Multicast | Way::UnixDatagram | Way::UnixStream | Way::Tcp | Way::Pipe)
    }

    /// Wakes and carries nothing.
    pub(crate) fn is_floor(self) -> bool {
        matches!(self, Way::FutexFloor | Way::EventfdFloor | Way::SpinFloor)
    }

    /// Never waits for its receivers: who is too slow misses messages.
    pub(crate) fn loses(self) -> bool {
        !self.is_floor() && !matches!(self, Way::UnixDatagram | Way::UnixStream | Way::Tcp | Way::Pipe)
    }

    /// Whether it is run with so many receivers and messages of this size. Who spins needs a processor for itself, and
    /// so does the sender; a floor is between two processes; the client library is compared once, for what it is used.
    pub(crate) fn runs(self, receivers: usize, payload: usize, processors: usize) -> bool {
        match self {
            Way::Spin => receivers < processors,
            Way::SpinFloor => receivers == 1 && processors > 1,
            Way::FutexFloor | Way::EventfdFloor => receivers == 1,
            Way::Subscription => receivers == 1 && payload == SCAN,
            _ => true,
        }
    }
}
