//! Network interfaces of this machine, and the kernel's notifications that they or their addresses have changed
//! (rtnetlink(7)). The notifications also report interfaces that were down only briefly, which polling would miss.

use std::net::{IpAddr, Ipv4Addr};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use nix::ifaddrs::{InterfaceAddress, getifaddrs};
use nix::net::if_::{InterfaceFlags, if_nametoindex};
use rustix::io::Errno;
use rustix::net::netlink::SocketAddrNetlink;
use rustix::net::{
    AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, bind, recv, send, socket_with,
};
use scanhub_schema::{Failure, Kind};

/// State of one interface at the time of the query.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Interface {
    pub(crate) name: String,
    /// The kernel's index. It changes when the interface is removed and created again under the same name.
    pub(crate) index: u32,
    /// Whether the interface is enabled.
    pub(crate) up: bool,
    /// Whether the interface has a carrier, such as a plugged cable.
    pub(crate) running: bool,
    /// Whether the interface supports multicast. The loopback does, although it lacks the flag.
    pub(crate) multicast: bool,
    /// Whether the interface is the loopback, which leads back to this machine.
    pub(crate) loopback: bool,
    /// First IPv4 address.
    pub(crate) address: Option<Ipv4Addr>,
}

/// Returns all interfaces, in the kernel's order.
///
/// # Errors
///
/// Returns [`Kind::Failed`] if the system cannot list them.
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

/// Returns the interface called `name`.
///
/// # Errors
///
/// Returns [`Kind::Configuration`], with a list of all interfaces, if there is no such interface.
pub(crate) fn by_name(name: &str) -> Result<Interface, Failure> {
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

/// Returns whether a sender with `address` is on this machine. If the system cannot list its addresses, only loopback
/// and unspecified addresses count.
pub(crate) fn is_of_this_machine(address: IpAddr) -> bool {
    let has_address = |entry: &InterfaceAddress| ipv4(entry).is_some_and(|own| own == address);
    // A datagram to a group has the source address 0.0.0.0 if it is sent by loopback on a machine without another
    // address. No datagram with this address arrives from outside.
    address.is_loopback()
        || address.is_unspecified()
        || getifaddrs().is_ok_and(|mut all| all.any(|entry| has_address(&entry)))
}

/// Returns the interface of `entry`. `None` if it was removed in the meantime.
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

/// Receiver of notifications that interfaces or addresses have changed.
pub(crate) struct InterfaceChanges {
    socket: OwnedFd,
    buffer: Vec<u8>,
    losses: CarrierLosses,
}

/// Interface that lost its carrier, was disabled or was removed. It may already be up again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LostInterface {
    /// The interface with this index.
    One(u32),
    /// Possibly any interface, because the queue of notifications overflowed.
    Any,
}

/// Maximum length of the kernel's messages, in bytes (Linux, Documentation/userspace-api/netlink/intro.rst).
const MAX_MESSAGE_LEN: usize = 32 << 10;

impl InterfaceChanges {
    /// Subscribes to all changes from now on.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the kernel refuses the subscription.
    pub(crate) fn subscribe() -> Result<InterfaceChanges, Failure> {
        let socket = open_netlink().map_err(|error| {
            Failure::new(Kind::Failed, format!("cannot watch network interfaces: {error}"), "")
        })?;
        Ok(InterfaceChanges { socket, buffer: vec![0; MAX_MESSAGE_LEN], losses: CarrierLosses::default() })
    }

    /// Reads all waiting notifications, and calls `on_lost` with each interface that was lost since the last call.
    /// Returns whether there were notifications. If there were none, the call costs one system call.
    pub(crate) fn read(&mut self, mut on_lost: impl FnMut(LostInterface)) -> bool {
        let mut any = false;
        loop {
            match recv(&self.socket, &mut self.buffer[..], RecvFlags::DONTWAIT) {
                Ok((len, _)) => self.losses.read(&self.buffer[..len], &mut on_lost),
                Err(Errno::NOBUFS) => on_lost(LostInterface::Any),
                Err(Errno::INTR) => continue,
                Err(_) => return any,
            }
            any = true;
        }
    }
}

impl AsFd for InterfaceChanges {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

impl LostInterface {
    /// Returns whether the interface with this index may be lost.
    pub(crate) fn includes(self, index: u32) -> bool {
        self == LostInterface::Any || self == LostInterface::One(index)
    }
}

/// Opens a nonblocking socket that receives changes of links and addresses, and requests all existing links.
fn open_netlink() -> rustix::io::Result<OwnedFd> {
    const LINK: u32 = 1;
    const IPV4_ADDRESS: u32 = 0x10;
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    // `None` stands for protocol 0, which is NETLINK_ROUTE.
    let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, None)?;
    bind(&socket, &SocketAddrNetlink::new(0, LINK | IPV4_ADDRESS))?;
    send(&socket, &request_links(), SendFlags::empty())?;
    Ok(socket)
}

/// Returns the message that requests all links.
fn request_links() -> [u8; HEADER + LINK_HEADER] {
    const REQUEST_DUMP: u16 = 0x301;
    let mut request = [0; HEADER + LINK_HEADER];
    request[..4].copy_from_slice(&((HEADER + LINK_HEADER) as u32).to_ne_bytes());
    request[4..6].copy_from_slice(&GETLINK.to_ne_bytes());
    request[6..8].copy_from_slice(&REQUEST_DUMP.to_ne_bytes());
    request
}

/// Number of times that each interface has lost its carrier. If that happens twice in a second, the kernel may report
/// both losses in one notification after the carrier is back, and then only this number shows that there were losses.
#[derive(Default)]
struct CarrierLosses {
    /// Index of each interface, and its number of losses.
    counts: Vec<(u32, u32)>,
}

// Lengths of struct nlmsghdr and struct ifinfomsg, types of messages, and the flag IFF_RUNNING.
const HEADER: usize = 16;
const LINK_HEADER: usize = 16;
const NEWLINK: u16 = 16;
const DELLINK: u16 = 17;
const GETLINK: u16 = 18;
const RUNNING: u32 = 0x40;
/// Attribute IFLA_CARRIER_DOWN_COUNT, the number of losses. The kernel reports it since Linux 4.16.
const CARRIER_DOWN_COUNT: u16 = 48;

impl CarrierLosses {
    /// Reads a datagram of the kernel, which contains one or more messages, and calls `on_lost` with each lost
    /// interface.
    fn read(&mut self, mut bytes: &[u8], on_lost: &mut impl FnMut(LostInterface)) {
        while let Some((message, rest)) = u32_at(bytes, 0).and_then(|len| cut(bytes, len as usize)) {
            bytes = rest;
            let (Some(kind), Some(index)) = (u16_at(message, 4), u32_at(message, HEADER + 4)) else { return };
            if kind == DELLINK {
                self.counts.retain(|&(known, _)| known != index);
                on_lost(LostInterface::One(index));
            } else if kind == NEWLINK {
                let is_running = u32_at(message, HEADER + 8).is_some_and(|flags| flags & RUNNING != 0);
                let is_lost_again = loss_count(message).is_some_and(|count| self.update(index, count));
                if !is_running || is_lost_again {
                    on_lost(LostInterface::One(index));
                }
            }
        }
    }

    /// Records the number of losses of an interface. Returns whether the number differs from the last one.
    fn update(&mut self, index: u32, count: u32) -> bool {
        match self.counts.iter_mut().find(|(known, _)| *known == index) {
            Some((_, before)) => std::mem::replace(before, count) != count,
            None => {
                self.counts.push((index, count));
                false
            }
        }
    }
}

/// Returns the number of losses in `message`, if the message has that attribute.
fn loss_count(message: &[u8]) -> Option<u32> {
    let mut attributes = message.get(HEADER + LINK_HEADER..)?;
    loop {
        let (attribute, rest) = cut(attributes, u16_at(attributes, 0)?.into())?;
        if u16_at(attribute, 2) == Some(CARRIER_DOWN_COUNT) {
            return u32_at(attribute, 4);
        }
        attributes = rest;
    }
}

/// Returns the first `len` bytes, and the rest. The rest starts at the next multiple of 4, because the kernel aligns
/// messages and attributes. `None` if `bytes` is shorter than `len`, or if `len` is below 4, the length of the shortest
/// header.
fn cut(bytes: &[u8], len: usize) -> Option<(&[u8], &[u8])> {
    let first = bytes.get(..len).filter(|first| first.len() >= 4)?;
    Some((first, bytes.get(len.next_multiple_of(4)..).unwrap_or_default()))
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    bytes.get(at..)?.first_chunk().map(|bytes| u16::from_ne_bytes(*bytes))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..)?.first_chunk().map(|bytes| u32::from_ne_bytes(*bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_loopback_and_lists_interfaces() {
        let lo = by_name("lo").unwrap();
        assert!(lo.loopback && lo.multicast && lo.index > 0, "{lo:?}");
        let own = interfaces().unwrap().into_iter().filter_map(|interface| interface.address);
        assert!(
            own.chain([Ipv4Addr::new(127, 0, 0, 9), Ipv4Addr::UNSPECIFIED])
                .all(|own| is_of_this_machine(own.into()))
        );
        // This address is reserved for documentation (RFC 5737), so it belongs to no machine.
        assert!(!is_of_this_machine(Ipv4Addr::new(192, 0, 2, 1).into()));
        let failure = by_name("no-such").unwrap_err();
        assert_eq!(failure.kind, Kind::Configuration);
        assert!(failure.message.contains("no-such") && failure.hint.contains("lo"), "{failure}");
    }

    /// Builds a message of the kernel, in which the attribute with the interface's name precedes the number of losses.
    fn message(kind: u16, index: u32, flags: u32, losses: Option<u32>) -> Vec<u8> {
        let mut body = vec![0; 4];
        body.extend([index.to_ne_bytes(), flags.to_ne_bytes(), [0xFF; 4]].concat());
        body.extend([&7_u16.to_ne_bytes(), &3_u16.to_ne_bytes(), &b"lo\0\0"[..]].concat());
        if let Some(losses) = losses {
            body.extend(
                [&8_u16.to_ne_bytes()[..], &CARRIER_DOWN_COUNT.to_ne_bytes(), &losses.to_ne_bytes()].concat(),
            );
        }
        let mut bytes = ((HEADER + body.len()) as u32).to_ne_bytes().to_vec();
        bytes.extend([&kind.to_ne_bytes()[..], &[0; 10]].concat());
        bytes.extend(body);
        bytes
    }

    fn read(losses: &mut CarrierLosses, bytes: &[u8]) -> Vec<LostInterface> {
        let mut all = Vec::new();
        losses.read(bytes, &mut |lost| all.push(lost));
        all
    }

    #[test]
    fn reports_lost_interface_that_is_up_again() {
        let mut losses = CarrierLosses::default();
        let of = |index, flags, losses| message(NEWLINK, index, flags, Some(losses));
        let all = [of(1, RUNNING, 0), of(2, RUNNING, 5), of(3, 0, 1)].concat();
        assert_eq!(read(&mut losses, &all), [LostInterface::One(3)]);
        assert_eq!(read(&mut losses, &of(2, RUNNING, 5)), [], "something else has changed");
        assert_eq!(read(&mut losses, &of(2, RUNNING, 6)), [LostInterface::One(2)]);
        assert_eq!(read(&mut losses, &of(2, RUNNING, 6)), []);
        assert_eq!(read(&mut losses, &message(NEWLINK, 1, RUNNING, None)), [], "an old kernel");
        assert_eq!(read(&mut losses, &message(NEWLINK, 1, 0, None)), [LostInterface::One(1)]);
        assert_eq!(read(&mut losses, &message(DELLINK, 2, RUNNING, Some(6))), [LostInterface::One(2)]);
        assert_eq!(read(&mut losses, &of(2, RUNNING, 0)), [], "another interface with the same index");
        assert!(
            LostInterface::One(2).includes(2)
                && !LostInterface::One(2).includes(3)
                && LostInterface::Any.includes(3)
        );
    }

    #[test]
    fn ignores_truncated_messages() {
        let whole = message(NEWLINK, 2, 0, Some(1));
        for len in 0..whole.len() {
            assert_eq!(read(&mut CarrierLosses::default(), &whole[..len]), [], "{len}");
        }
        assert_eq!(
            read(&mut CarrierLosses::default(), &3_u32.to_ne_bytes()),
            [],
            "shorter than its own length"
        );
    }

    #[test]
    fn kernel_lists_existing_links() {
        let mut changes = InterfaceChanges::subscribe().unwrap();
        // The kernel sends its reply before the request returns.
        assert!(changes.read(|_| {}) && changes.losses.counts.iter().any(|&(index, _)| index > 0));
    }
}
