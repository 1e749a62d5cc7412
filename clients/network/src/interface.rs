//! The network interfaces of this machine, for joining groups on them and sending to them. Refuses to know sockets.

mod changes;

use std::net::{IpAddr, Ipv4Addr};

use nix::ifaddrs::{InterfaceAddress, getifaddrs};
use nix::net::if_::{InterfaceFlags, if_nametoindex};
use scanhub_schema::{Failure, Kind};

pub(crate) use changes::Changes;

/// One interface, as it is at this moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Interface {
    /// Its name.
    pub(crate) name: String,
    /// Its number: another one if it was taken away and made again under the same name.
    pub(crate) index: u32,
    /// It is switched on.
    pub(crate) up: bool,
    /// There is a link: its cable is plugged in.
    pub(crate) running: bool,
    /// It can carry groups, or is the loopback, which can all the same.
    pub(crate) multicast: bool,
    /// It leads back to this machine.
    pub(crate) loopback: bool,
    /// Its first IPv4 address.
    pub(crate) address: Option<Ipv4Addr>,
}

/// All interfaces, in the kernel's order.
///
/// [`Kind::Failed`] if the system does not tell.
pub(crate) fn interfaces() -> Result<Vec<Interface>, Failure> {
    let addresses = getifaddrs().map_err(|error| {
        Failure::new(Kind::Failed, format!("cannot list network interfaces: {error}"), "")
    })?;
    let mut found: Vec<Interface> = Vec::new();
    for entry in addresses {
        let address = ipv4(&entry);
        match found.iter_mut().find(|known| known.name == entry.interface_name) {
            Some(known) => known.address = known.address.or(address),
            None => found.extend(interface(entry, address)),
        }
    }
    Ok(found)
}

/// The interface called `name`.
///
/// [`Kind::Configuration`] with those that there are.
pub(crate) fn named(name: &str) -> Result<Interface, Failure> {
    let mut all = interfaces()?;
    if let Some(at) = all.iter().position(|interface| interface.name == name) {
        return Ok(all.swap_remove(at));
    }
    let names: Vec<_> = all.into_iter().map(|interface| interface.name).collect();
    Err(Failure::new(
        Kind::Configuration,
        format!("there is no network interface {name:?}"),
        format!("there are {}", names.join(", ")),
    ))
}

/// Whether a sender with `address` is on this machine; not if the system does not tell its addresses.
pub(crate) fn is_of_this_machine(address: IpAddr) -> bool {
    let is_it = |entry: &InterfaceAddress| ipv4(entry).is_some_and(|own| own == address);
    // What goes to a group by the loopback of a machine without another address has none; from outside none such comes in.
    address.is_loopback()
        || address.is_unspecified()
        || getifaddrs().is_ok_and(|mut all| all.any(|entry| is_it(&entry)))
}

/// Nothing if it was taken away meanwhile.
fn interface(entry: InterfaceAddress, address: Option<Ipv4Addr>) -> Option<Interface> {
    let index = if_nametoindex(entry.interface_name.as_str()).ok()?;
    let has = |flag| entry.flags.contains(flag);
    let loopback = has(InterfaceFlags::IFF_LOOPBACK);
    Some(Interface {
        index,
        up: has(InterfaceFlags::IFF_UP),
        running: has(InterfaceFlags::IFF_RUNNING),
        multicast: has(InterfaceFlags::IFF_MULTICAST) || loopback,
        loopback,
        address,
        name: entry.interface_name,
    })
}

fn ipv4(entry: &InterfaceAddress) -> Option<Ipv4Addr> {
    Some(Ipv4Addr::from(entry.address.as_ref()?.as_sockaddr_in()?.ip()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loopback_is_known_and_others_are_named() {
        let lo = named("lo").unwrap();
        assert!(lo.loopback && lo.multicast && lo.index > 0, "{lo:?}");
        let own = interfaces().unwrap().into_iter().filter_map(|interface| interface.address);
        assert!(
            own.chain([Ipv4Addr::new(127, 0, 0, 9), Ipv4Addr::UNSPECIFIED])
                .all(|own| is_of_this_machine(own.into()))
        );
        // For documentation: nobody has it (RFC 5737).
        assert!(!is_of_this_machine(Ipv4Addr::new(192, 0, 2, 1).into()));
        let failure = named("no-such").unwrap_err();
        assert_eq!(failure.kind, Kind::Configuration);
        assert!(failure.message.contains("no-such") && failure.hint.contains("lo"), "{failure}");
    }
}
