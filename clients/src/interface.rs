//! The network interface that datagrams leave or enter by: which one is meant, and whether anything would get through
//! it. The kernel takes datagrams for an interface whose cable is out, and says nothing. Refuses to know who sends what.

use std::io;
use std::os::fd::OwnedFd;

use nix::ifaddrs::{InterfaceAddress, getifaddrs};
use nix::net::if_::{InterfaceFlags, if_nametoindex};
use rustix::net::netlink::SocketAddrNetlink;
use rustix::net::{AddressFamily, RecvFlags, SocketFlags, SocketType, bind, recv, socket_with};
use schema::{Failure, Kind};

/// A network interface and its state.
pub(crate) struct Interface {
    name: String,
    /// The kernel tells here that interfaces or addresses changed.
    events: OwnedFd,
    index: Option<u32>,
    is_up: bool,
}

impl Interface {
    /// The interface called `name`; without a name the only one that is up, not the loopback, and has multicast and an
    /// IPv4 address.
    ///
    /// [`Kind::Configuration`] with those that there are if it is not there, or not just one.
    pub(crate) fn choose(name: Option<&str>) -> Result<Interface, Failure> {
        // First the events: what changes after the look is one.
        let events = events().map_err(|error| unknown(&error))?;
        let found = list().map_err(|error| unknown(&error))?;
        let name = match name {
            Some(name) if found.iter().any(|one| one.name == name) => name.to_owned(),
            Some(name) => return Err(refuse(format!("no interface {name}"), &found)),
            None => {
                let candidates: Vec<_> = found.iter().filter(|one| one.is_candidate()).collect();
                match candidates[..] {
                    [one] => one.name.clone(),
                    [] => return Err(refuse("no interface has multicast and is up".into(), &found)),
                    _ => return Err(refuse("several interfaces have multicast".into(), &found)),
                }
            }
        };
        let mut interface = Interface { name, events, index: None, is_up: false };
        interface.learn(&found);
        Ok(interface)
    }

    /// Its name.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Its number; it has another one each time that it is made, and none while it is not there.
    pub(crate) fn index(&self) -> Option<u32> {
        self.index
    }

    /// It is up, has a carrier and an IPv4 address.
    pub(crate) fn is_up(&self) -> bool {
        self.is_up
    }

    /// Takes note of what changed since the last call; whether that was the number or the state of this interface. One
    /// system call as long as nothing did.
    pub(crate) fn look(&mut self) -> bool {
        let mut any = false;
        // Too many at once are an error that stands for them.
        while !matches!(recv(&self.events, &mut [0; 64], RecvFlags::DONTWAIT), Err(rustix::io::Errno::AGAIN))
        {
            any = true;
        }
        if !any {
            return false;
        }
        let before = (self.index, self.is_up);
        self.learn(&list().unwrap_or_default());
        before != (self.index, self.is_up)
    }

    fn learn(&mut self, found: &[Found]) {
        let own = found.iter().find(|one| one.name == self.name);
        self.index = own.and_then(|own| if_nametoindex(own.name.as_str()).ok());
        self.is_up = self.index.is_some() && own.is_some_and(Found::is_up);
    }
}

/// An interface of this machine.
struct Found {
    name: String,
    flags: InterfaceFlags,
    has_address: bool,
}

impl Found {
    fn is_up(&self) -> bool {
        self.flags.contains(InterfaceFlags::IFF_UP | InterfaceFlags::IFF_RUNNING) && self.has_address
    }

    /// What has no carrier yet, as at the start of a robot, is one too.
    fn is_candidate(&self) -> bool {
        self.flags.contains(InterfaceFlags::IFF_UP | InterfaceFlags::IFF_MULTICAST)
            && !self.flags.contains(InterfaceFlags::IFF_LOOPBACK)
            && self.has_address
    }
}

fn list() -> io::Result<Vec<Found>> {
    let mut found: Vec<Found> = Vec::new();
    for InterfaceAddress { interface_name, flags, address, .. } in getifaddrs()? {
        let has_address = address.is_some_and(|address| address.as_sockaddr_in().is_some());
        match found.iter_mut().find(|one| one.name == interface_name) {
            Some(one) => one.has_address |= has_address,
            None => found.push(Found { name: interface_name, flags, has_address }),
        }
    }
    Ok(found)
}

/// The kernel's word on links and addresses, without waiting for it (rtnetlink(7)).
fn events() -> rustix::io::Result<OwnedFd> {
    const LINK: u32 = 1;
    const IPV4_ADDRESS: u32 = 0x10;
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    // No protocol: NETLINK_ROUTE is 0.
    let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, None)?;
    bind(&socket, &SocketAddrNetlink::new(0, LINK | IPV4_ADDRESS))?;
    Ok(socket)
}

fn refuse(what: String, found: &[Found]) -> Failure {
    let tell = |one: &Found| match (one.flags.contains(InterfaceFlags::IFF_UP), one.has_address) {
        (false, _) => format!("{} (down)", one.name),
        (true, false) => format!("{} (no IPv4 address)", one.name),
        (true, true) => one.name.clone(),
    };
    let names: Vec<_> = found.iter().map(tell).collect();
    Failure::new(
        Kind::Configuration,
        what,
        format!("name one by --interface; there are {}", names.join(", ")),
    )
}

fn unknown(error: &dyn std::fmt::Display) -> Failure {
    Failure::new(Kind::Failed, format!("cannot ask for network interfaces: {error}"), "")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loopback_is_taken_by_name_only() {
        let refused = Interface::choose(Some("none0")).map(drop).unwrap_err();
        assert_eq!(refused.kind, Kind::Configuration);
        assert!(refused.message.contains("none0") && refused.hint.contains("lo"), "{refused}");
        let mut lo = Interface::choose(Some("lo")).unwrap();
        assert!(lo.name() == "lo" && lo.index().is_some());
        let loopback = Found { name: "lo".into(), flags: InterfaceFlags::all(), has_address: true };
        assert!(!loopback.is_candidate());
        lo.look();
        assert!(!lo.look() || lo.index().is_some(), "a look changes nothing");
    }

    #[test]
    fn what_gets_nothing_through_is_not_up() {
        let flags = InterfaceFlags::IFF_UP | InterfaceFlags::IFF_MULTICAST;
        let plugged =
            Found { name: "eth0".into(), flags: flags | InterfaceFlags::IFF_RUNNING, has_address: true };
        assert!(plugged.is_up() && plugged.is_candidate());
        let unplugged = Found { name: "eth0".into(), flags, has_address: true };
        assert!(!unplugged.is_up() && unplugged.is_candidate());
        let nameless = Found { has_address: false, ..plugged };
        assert!(!nameless.is_up() && !nameless.is_candidate());
    }
}
