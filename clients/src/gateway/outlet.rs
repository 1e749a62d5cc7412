//! One destination of datagrams, with a socket of its own, so that one that is dead disturbs no other: the groups on an
//! interface, or a host. Counts what the kernel took and what it refused; nothing that comes in is ever read.

use std::io::{self, ErrorKind, IoSliceMut};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, ToSocketAddrs, UdpSocket};
use std::os::fd::AsRawFd;

use nix::sys::socket::{setsockopt, sockopt::Ipv4RecvErr};
use rustix::net::sockopt::{
    Ipv4PathMtuDiscovery, ip_mtu, set_ip_mtu_discover, set_ip_multicast_if_with_ifindex,
    set_socket_recv_buffer_size,
};
use rustix::net::{RecvAncillaryBuffer, RecvFlags, recvmsg};
use schema::datagram::{Announce, GROUPS, PORT};
use schema::{Failure, Kind};

/// A destination.
pub(super) struct Outlet {
    /// The interface, or the host as the user wrote it.
    pub(super) name: String,
    /// Datagrams that the kernel took.
    pub(super) sent: u64,
    /// Datagrams that it did not take: full queues, no route, a destination that refused the one before.
    pub(super) failed: u64,
    /// Answers that what was sent before did not get there.
    pub(super) reported: u64,
    /// Nothing gets out by the interface, although the kernel takes it: listeners on this machine may still hear it.
    pub(super) is_cut: bool,
    socket: UdpSocket,
    to: To,
    error: Option<io::Error>,
    told: u64,
    trouble: Option<u32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum To {
    /// All groups.
    Groups {
        port: u16,
    },
    Host(SocketAddrV4),
}

/// What became of a destination.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum News {
    /// Nothing, or not all, gets there any more, with the last reason.
    Failing(String),
    /// All is taken again.
    Well,
}

impl Outlet {
    /// The groups, on the interface called `name`; routers pass `ttl` of them on.
    ///
    /// [`Kind::Failed`] if the system has no such socket.
    pub(super) fn groups(name: &str, port: u16, ttl: u8) -> Result<Outlet, Failure> {
        let outlet = Outlet::new(name, To::Groups { port })?;
        let set = outlet.socket.set_multicast_ttl_v4(ttl.into());
        set.and_then(|()| outlet.socket.set_multicast_loop_v4(true)).map_err(|error| no_socket(&error))?;
        Ok(outlet)
    }

    /// The host and port in `text`, and up to `more` ports above it.
    ///
    /// [`Kind::Configuration`] if `text` names none, or a group.
    pub(super) fn host(text: &str, more: u16) -> Result<Outlet, Failure> {
        let refuse = |what: String, hint: &str| Failure::new(Kind::Configuration, what, hint);
        let found = text.to_socket_addrs().map_err(|error| {
            let hint = "write HOST:PORT with a name that is known here, or an address, as in 10.0.0.7:22200";
            refuse(format!("cannot send to {text}: {error}"), hint)
        })?;
        let address = found.into_iter().find_map(|address| match address {
            SocketAddr::V4(address) => Some(address),
            SocketAddr::V6(_) => None,
        });
        let address = address.ok_or_else(|| {
            refuse(format!("cannot send to {text}: it has no IPv4 address"), "name one that has")
        })?;
        if address.ip().is_multicast() || address.ip().is_broadcast() || address.ip().is_unspecified() {
            let hint = "the groups get everything anyway; name single hosts besides";
            return Err(refuse(format!("cannot send to {text}: it is no host"), hint));
        }
        let ports = 1..=u16::MAX - more;
        if !ports.contains(&address.port()) {
            let hint = format!("a port from {} to {}", ports.start(), ports.end());
            return Err(refuse(format!("cannot send to {text}: the port is not possible"), &hint));
        }
        Outlet::new(text, To::Host(address))
    }

    /// What is sent to `other` gets to the same place.
    pub(super) fn is_as(&self, other: &Outlet) -> bool {
        self.to == other.to
    }

    /// Lets the groups be those on interface number `index`.
    pub(super) fn use_interface(&self, index: u32) {
        let any = Ipv4Addr::UNSPECIFIED;
        // An interface that is gone again is seen at the next send.
        let _ = set_ip_multicast_if_with_ifindex(&self.socket, &any, &any, index);
    }

    /// The longest datagram that goes over interface number `index` in one piece, if that is known.
    pub(super) fn room(&self, index: u32) -> Option<usize> {
        const IP_AND_UDP: usize = 20 + 8;
        let probe = socket().ok()?;
        let any = Ipv4Addr::UNSPECIFIED;
        set_ip_multicast_if_with_ifindex(&probe, &any, &any, index).ok()?;
        probe.connect((Ipv4Addr::from([GROUPS[0], GROUPS[1], GROUPS[2], Announce::GROUP]), PORT)).ok()?;
        (ip_mtu(&probe).ok()? as usize).checked_sub(IP_AND_UDP)
    }

    /// Hands a datagram to the kernel, for the group with this last byte if it goes to groups, and to the port so much above
    /// the usual one; whether it was taken.
    pub(super) fn send(&mut self, datagram: &[u8], group: u8, above: u8) -> bool {
        let address = match self.to {
            To::Groups { port } => {
                SocketAddrV4::new(Ipv4Addr::new(GROUPS[0], GROUPS[1], GROUPS[2], group), port)
            }
            To::Host(address) => address,
        };
        let address = SocketAddrV4::new(*address.ip(), address.port() + u16::from(above));
        match self.socket.send_to(datagram, address) {
            Ok(_) if !self.is_cut => {
                self.sent += 1;
                return true;
            }
            Ok(_) => self.error = Some(ErrorKind::NetworkDown.into()),
            Err(error) => {
                self.error = Some(error);
                self.drain();
            }
        }
        self.failed += 1;
        false
    }

    /// What is new since the last call, a second ago. One that fails and succeeds by turns is failing.
    pub(super) fn news(&mut self) -> Option<News> {
        self.drain();
        let lost = self.failed + self.reported;
        let is_failing = lost > self.told;
        self.told = lost;
        match (&mut self.trouble, is_failing) {
            (None, false) => None,
            (Some(calm), true) => {
                *calm = 0;
                None
            }
            (None, true) => {
                self.trouble = Some(0);
                Some(News::Failing(self.error.as_ref().map_or_else(|| NOBODY.into(), explain)))
            }
            (Some(calm), false) if *calm < CALM => {
                *calm += 1;
                None
            }
            (Some(_), false) => {
                self.trouble = None;
                Some(News::Well)
            }
        }
    }

    fn new(name: &str, to: To) -> Result<Outlet, Failure> {
        Ok(Outlet {
            name: name.to_owned(),
            sent: 0,
            failed: 0,
            reported: 0,
            is_cut: false,
            socket: socket().map_err(|error| no_socket(&error))?,
            to,
            error: None,
            told: 0,
            trouble: None,
        })
    }

    /// Takes what the network answered: it would stand in the way of the next datagram.
    fn drain(&mut self) {
        let mut no_data = [];
        let flags = RecvFlags::ERRQUEUE | RecvFlags::DONTWAIT;
        while recvmsg(
            &self.socket,
            &mut [IoSliceMut::new(&mut no_data)],
            &mut RecvAncillaryBuffer::default(),
            flags,
        )
        .is_ok()
        {
            self.reported += 1;
        }
    }
}

fn socket() -> io::Result<UdpSocket> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    // A queue that is full shall be told and not waited for.
    socket.set_nonblocking(true)?;
    // Without it the kernel reports what its queues dropped as sent.
    setsockopt(socket.as_raw_fd(), Ipv4RecvErr, &true)?;
    // A datagram is never fragmented: one that is too long for the way is refused.
    set_ip_mtu_discover(&socket, Ipv4PathMtuDiscovery::DO)?;
    // What others may send here is never read and takes no memory: the least there is.
    set_socket_recv_buffer_size(&socket, 0)?;
    Ok(socket)
}

fn explain(error: &io::Error) -> String {
    match error.kind() {
        ErrorKind::WouldBlock => "the queue to the network is full".into(),
        _ => error.to_string(),
    }
}

fn no_socket(error: &io::Error) -> Failure {
    Failure::new(Kind::Failed, format!("no socket for datagrams: {error}"), "")
}

const NOBODY: &str = "nobody is there";
/// Seconds without a failure until all is well: answers of a host that is not there come once a second at most.
const CALM: u32 = 2;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts_that_are_none() {
        for bad in
            ["", "nowhere", "10.0.0.1", "10.0.0.1:99999", "239.255.76.80:22200", "0.0.0.0:1", "[::1]:22200"]
        {
            let refused = Outlet::host(bad, 0).map(drop).unwrap_err();
            assert_eq!(refused.kind, Kind::Configuration, "{refused}");
            assert!(refused.message.contains(bad) && !refused.hint.is_empty(), "{refused}");
        }
        assert!(Outlet::host("127.0.0.1:0", 0).is_err());
        assert!(Outlet::host("127.0.0.1:65535", 255).is_err() && Outlet::host("127.0.0.1:65535", 0).is_ok());
    }

    #[test]
    fn a_host_where_nobody_listens_is_told_once() {
        let receiver = UdpSocket::bind("127.0.0.1:0").unwrap();
        let text = receiver.local_addr().unwrap().to_string();
        let mut outlet = Outlet::host(&text, 0).unwrap();
        assert!(outlet.send(b"one", 0, 0) && outlet.news().is_none());
        drop(receiver);
        for _ in 0..4 {
            outlet.send(b"two", 0, 0);
        }
        assert!(outlet.failed + outlet.reported >= 2, "{} and {}", outlet.failed, outlet.reported);
        assert_eq!(outlet.sent + outlet.failed, 5);
        assert!(matches!(outlet.news(), Some(News::Failing(_))) && outlet.news().is_none());
        let receiver = UdpSocket::bind(&text).unwrap();
        assert_eq!((outlet.news(), outlet.news()), (None, Some(News::Well)));
        assert!(outlet.send(b"three", 0, 0));
        let mut bytes = [0; 9];
        assert_eq!(receiver.recv(&mut bytes).unwrap(), 5);
    }
}
