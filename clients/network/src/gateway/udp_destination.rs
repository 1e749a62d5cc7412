//! One destination of datagrams, with a socket of its own, so that one that is dead disturbs no other: the groups on an
//! interface, or a host. Counts what the kernel took and what it refused; nothing that comes in is ever read.

use std::io::{self, ErrorKind, IoSliceMut};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::os::fd::AsRawFd;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use nix::sys::socket::{
    setsockopt,
    sockopt::{Ipv4RecvErr, Ipv6RecvErr},
};
use rustix::net::sockopt::{
    Ipv4PathMtuDiscovery, Ipv6PathMtuDiscovery, ip_mtu, set_ip_mtu_discover,
    set_ip_multicast_if_with_ifindex, set_ipv6_mtu_discover, set_socket_recv_buffer_size,
};
use rustix::net::{RecvAncillaryBuffer, RecvFlags, recvmsg};
use scanhub_schema::datagram::{Announce, GROUPS, PORT};
use scanhub_schema::{Failure, Kind};

use super::host::Host;

/// A destination.
pub(super) struct UdpDestination {
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

enum To {
    /// All groups.
    Groups {
        port: u16,
    },
    Host(Host),
}

/// What became of a destination.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum News {
    /// Nothing, or not all, gets there any more, with the last reason.
    Failing(String),
    /// All is taken again.
    Well,
}

impl UdpDestination {
    /// The groups, on the interface called `name`; routers pass `ttl` of them on.
    ///
    /// [`Kind::Failed`] if the system has no such socket.
    pub(super) fn groups(name: &str, port: u16, ttl: u8) -> Result<UdpDestination, Failure> {
        let destination = UdpDestination::new(name, To::Groups { port })?;
        let set = destination.socket.set_multicast_ttl_v4(ttl.into());
        set.and_then(|()| destination.socket.set_multicast_loop_v4(true))
            .map_err(|error| no_socket(&error))?;
        Ok(destination)
    }

    /// A host and port, and up to `more` ports above it. Failures as [`Host::parse`], and [`Kind::Failed`] as above.
    pub(super) fn host(text: &str, more: u16, stop: &AtomicBool) -> Result<UdpDestination, Failure> {
        UdpDestination::new(text, To::Host(Host::parse(text, more, stop)?))
    }

    /// What is sent to `other` gets to the same place.
    pub(super) fn is_as(&self, other: &UdpDestination) -> bool {
        match (&self.to, &other.to) {
            (To::Groups { .. }, To::Groups { .. }) => true,
            (To::Host(one), To::Host(other)) => one.address() == other.address(),
            _ => false,
        }
    }

    /// Goes on at the address that the host's name has now, if that is another one; to be called once a second.
    pub(super) fn follow_name(&mut self, now: Instant) -> Option<SocketAddr> {
        let To::Host(host) = &mut self.to else { return None };
        let address = host.look(self.trouble.is_some(), now)?;
        if address.is_ipv4() != host.address().is_ipv4() {
            // Without a socket all stays as it is, and the name is asked for again.
            self.socket = socket(address.ip()).ok()?;
        }
        host.move_to(address);
        Some(address)
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
        let any = Ipv4Addr::UNSPECIFIED;
        let probe = socket(any.into()).ok()?;
        set_ip_multicast_if_with_ifindex(&probe, &any, &any, index).ok()?;
        probe.connect((Ipv4Addr::from([GROUPS[0], GROUPS[1], GROUPS[2], Announce::GROUP]), PORT)).ok()?;
        (ip_mtu(&probe).ok()? as usize).checked_sub(IP_AND_UDP)
    }

    /// Hands a datagram to the kernel, for the group with this last byte if it goes to groups, and to the port so much above
    /// the usual one; whether it was taken.
    pub(super) fn send(&mut self, datagram: &[u8], group: u8, above: u8) -> bool {
        let mut address = match &self.to {
            To::Groups { port } => SocketAddr::from(([GROUPS[0], GROUPS[1], GROUPS[2], group], *port)),
            To::Host(host) => host.address(),
        };
        address.set_port(address.port() + u16::from(above));
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

    fn new(name: &str, to: To) -> Result<UdpDestination, Failure> {
        let ip = match &to {
            To::Groups { .. } => Ipv4Addr::UNSPECIFIED.into(),
            To::Host(host) => host.address().ip(),
        };
        Ok(UdpDestination {
            name: name.to_owned(),
            sent: 0,
            failed: 0,
            reported: 0,
            is_cut: false,
            socket: socket(ip).map_err(|error| no_socket(&error))?,
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

/// A socket that sends to addresses like `ip`.
fn socket(ip: IpAddr) -> io::Result<UdpSocket> {
    let any = if ip.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { IpAddr::from(Ipv6Addr::UNSPECIFIED) };
    let socket = UdpSocket::bind((any, 0))?;
    // A queue that is full shall be told and not waited for.
    socket.set_nonblocking(true)?;
    // Without the first the kernel reports what its queues dropped as sent. And a datagram is never fragmented: one that is
    // too long for the way is refused.
    if ip.is_ipv4() {
        setsockopt(socket.as_raw_fd(), Ipv4RecvErr, &true)?;
        set_ip_mtu_discover(&socket, Ipv4PathMtuDiscovery::DO)?;
    } else {
        setsockopt(socket.as_raw_fd(), Ipv6RecvErr, &true)?;
        set_ipv6_mtu_discover(&socket, Ipv6PathMtuDiscovery::DO)?;
    }
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
    use std::sync::atomic::{AtomicU16, Ordering};
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_host_whose_name_moves_is_followed() {
        static PORT: AtomicU16 = AtomicU16::new(0);
        static HAS_MOVED: AtomicBool = AtomicBool::new(false);
        fn resolve(_: &str) -> io::Result<Vec<SocketAddr>> {
            let there = if HAS_MOVED.load(Ordering::SeqCst) { Ipv6Addr::LOCALHOST.into() } else { HERE };
            Ok(vec![SocketAddr::new(there, PORT.load(Ordering::SeqCst))])
        }
        const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);
        let there = match UdpSocket::bind("[::1]:0") {
            Ok(there) => there,
            Err(error) => return eprintln!("skipped: no IPv6 here: {error}"),
        };
        PORT.store(there.local_addr().unwrap().port(), Ordering::SeqCst);
        let begin = Instant::now();
        let host = Host::by(resolve, "robot:7", 0, &AtomicBool::new(false), begin).unwrap();
        let mut destination = UdpDestination::new("robot:7", To::Host(host)).unwrap();
        let later = begin + Duration::from_secs(60);
        assert_eq!(destination.follow_name(begin), None);
        HAS_MOVED.store(true, Ordering::SeqCst);
        let moved = loop {
            assert!(begin.elapsed() < Duration::from_secs(30));
            match destination.follow_name(later) {
                Some(address) => break address,
                None => std::thread::yield_now(),
            }
        };
        assert_eq!(moved, there.local_addr().unwrap());
        assert!(destination.send(b"there", 0, 0));
        let mut bytes = [0; 9];
        assert_eq!(there.recv(&mut bytes).unwrap(), 5);
    }

    #[test]
    fn a_host_where_nobody_listens_is_told_once() {
        nobody_listens(UdpSocket::bind("127.0.0.1:0").unwrap());
        match UdpSocket::bind("[::1]:0") {
            Ok(receiver) => nobody_listens(receiver),
            Err(error) => eprintln!("skipped: no IPv6 here: {error}"),
        }
    }

    fn nobody_listens(receiver: UdpSocket) {
        let text = receiver.local_addr().unwrap().to_string();
        let mut destination = UdpDestination::host(&text, 0, &AtomicBool::new(false)).unwrap();
        assert!(destination.send(b"one", 0, 0) && destination.news().is_none());
        drop(receiver);
        for _ in 0..4 {
            destination.send(b"two", 0, 0);
        }
        assert!(
            destination.failed + destination.reported >= 2,
            "{} and {}",
            destination.failed,
            destination.reported
        );
        assert_eq!(destination.sent + destination.failed, 5);
        assert!(matches!(destination.news(), Some(News::Failing(_))) && destination.news().is_none());
        let receiver = UdpSocket::bind(&text).unwrap();
        assert_eq!((destination.news(), destination.news()), (None, Some(News::Well)));
        assert!(destination.send(b"three", 0, 0));
        let mut bytes = [0; 9];
        assert_eq!(receiver.recv(&mut bytes).unwrap(), 5);
    }
}
