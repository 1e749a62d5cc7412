//! One destination of datagrams: the groups on an interface, or a host. Each destination has its own socket, so that a
//! failing destination does not affect the others. It counts the datagrams that the kernel accepted and refused.
//! Datagrams that others send to the socket are never read.

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
use scanhub_schema::datagram::{Announce, GROUP_PREFIX, PORT};
use scanhub_schema::{Failure, Kind};

use super::host::Host;

/// A destination of datagrams, with its counters.
pub(super) struct UdpDestination {
    /// Name of the interface, or the host as the user wrote it.
    pub(super) name: String,
    /// Datagrams that the kernel accepted.
    pub(super) sent: u64,
    /// Datagrams that were not sent: the queue was full, there was no route, the host refused an earlier datagram, or
    /// the interface was down.
    pub(super) failed: u64,
    /// Errors that the network reported for earlier datagrams.
    pub(super) reported: u64,
    /// Whether the interface is down. The kernel accepts datagrams even then, and listeners on this machine receive
    /// them.
    pub(super) is_down: bool,
    socket: UdpSocket,
    target: Target,
    last_error: Option<io::Error>,
    /// Sum of `failed` and `reported` at the last check.
    lost: u64,
    /// Number of checks since the last failure; `None` unless the destination is failing.
    checks_without_failure: Option<u32>,
}

enum Target {
    /// All groups, on this port.
    Groups {
        port: u16,
    },
    Host(Host),
}

/// State change of a destination.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum DestinationEvent {
    /// Some or all datagrams are lost. Contains the reason of the last failure.
    Failing(String),
    /// All datagrams are accepted again.
    Recovered,
}

impl UdpDestination {
    /// Opens a socket for the groups, on the interface called `name`. Datagrams cross at most `ttl` networks.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the socket cannot be opened.
    pub(super) fn groups(name: &str, port: u16, ttl: u8) -> Result<UdpDestination, Failure> {
        let destination = UdpDestination::new(name, Target::Groups { port })?;
        let set = destination.socket.set_multicast_ttl_v4(ttl.into());
        set.and_then(|()| destination.socket.set_multicast_loop_v4(true))
            .map_err(|error| no_socket(&error))?;
        Ok(destination)
    }

    /// Opens a socket for the host and port in `text`, and for `more_ports` ports above that port.
    ///
    /// # Errors
    ///
    /// Returns the same errors as [`Host::parse`], and [`Kind::Failed`] if the socket cannot be opened.
    pub(super) fn host(text: &str, more_ports: u16, stop: &AtomicBool) -> Result<UdpDestination, Failure> {
        UdpDestination::new(text, Target::Host(Host::parse(text, more_ports, stop)?))
    }

    /// Returns whether datagrams to `other` arrive at the same destination.
    pub(super) fn is_same(&self, other: &UdpDestination) -> bool {
        match (&self.target, &other.target) {
            (Target::Groups { .. }, Target::Groups { .. }) => true,
            (Target::Host(one), Target::Host(other)) => one.address() == other.address(),
            _ => false,
        }
    }

    /// Checks whether the host's name has a new address. If so, sends to the new address from now on, and returns it.
    /// Call this method once a second.
    pub(super) fn follow_name(&mut self, now: Instant) -> Option<SocketAddr> {
        let Target::Host(host) = &mut self.target else { return None };
        let address = host.new_address(self.checks_without_failure.is_some(), now)?;
        if address.is_ipv4() != host.address().is_ipv4() {
            // If the socket cannot be opened, keep the old address. The name is resolved again later.
            self.socket = socket(address.ip()).ok()?;
        }
        host.set_address(address);
        Some(address)
    }

    /// Sends to the groups on the interface with this index.
    pub(super) fn use_interface(&self, index: u32) {
        let any = Ipv4Addr::UNSPECIFIED;
        // Ignore an error: if the interface was removed in the meantime, sending the next datagram fails and is
        // counted.
        let _ = set_ip_multicast_if_with_ifindex(&self.socket, &any, &any, index);
    }

    /// Returns the length of the longest datagram that the interface with this index sends without fragmenting it.
    /// `None` if that length is unknown.
    pub(super) fn max_len(&self, index: u32) -> Option<usize> {
        const IP_AND_UDP: usize = 20 + 8;
        let any = Ipv4Addr::UNSPECIFIED;
        let probe = socket(any.into()).ok()?;
        set_ip_multicast_if_with_ifindex(&probe, &any, &any, index).ok()?;
        probe
            .connect((
                Ipv4Addr::from([GROUP_PREFIX[0], GROUP_PREFIX[1], GROUP_PREFIX[2], Announce::GROUP]),
                PORT,
            ))
            .ok()?;
        (ip_mtu(&probe).ok()? as usize).checked_sub(IP_AND_UDP)
    }

    /// Sends a datagram to the port that is `above` ports after the usual one. If the destination is the groups,
    /// `group` is the last byte of the group's address. Returns whether the kernel accepted the datagram, and the
    /// interface is up.
    pub(super) fn send(&mut self, datagram: &[u8], group: u8, above: u8) -> bool {
        let mut address = match &self.target {
            Target::Groups { port } => {
                SocketAddr::from(([GROUP_PREFIX[0], GROUP_PREFIX[1], GROUP_PREFIX[2], group], *port))
            }
            Target::Host(host) => host.address(),
        };
        address.set_port(address.port() + u16::from(above));
        match self.socket.send_to(datagram, address) {
            Ok(_) if !self.is_down => {
                self.sent += 1;
                return true;
            }
            Ok(_) => self.last_error = Some(ErrorKind::NetworkDown.into()),
            Err(error) => {
                self.last_error = Some(error);
                self.read_errors();
            }
        }
        self.failed += 1;
        false
    }

    /// Checks for a state change. Call this method once a second. A destination at which some datagrams fail and others
    /// succeed is failing.
    pub(super) fn check(&mut self) -> Option<DestinationEvent> {
        self.read_errors();
        let lost = self.failed + self.reported;
        let is_failing = lost > self.lost;
        self.lost = lost;
        match (&mut self.checks_without_failure, is_failing) {
            (None, false) => None,
            (Some(checks), true) => {
                *checks = 0;
                None
            }
            (None, true) => {
                self.checks_without_failure = Some(0);
                let reason = self.last_error.as_ref().map_or_else(|| NO_RECEIVER.into(), explain);
                Some(DestinationEvent::Failing(reason))
            }
            (Some(checks), false) if *checks < RECOVERY_CHECKS => {
                *checks += 1;
                None
            }
            (Some(_), false) => {
                self.checks_without_failure = None;
                Some(DestinationEvent::Recovered)
            }
        }
    }

    fn new(name: &str, to: Target) -> Result<UdpDestination, Failure> {
        let ip = match &to {
            Target::Groups { .. } => Ipv4Addr::UNSPECIFIED.into(),
            Target::Host(host) => host.address().ip(),
        };
        Ok(UdpDestination {
            name: name.to_owned(),
            sent: 0,
            failed: 0,
            reported: 0,
            is_down: false,
            socket: socket(ip).map_err(|error| no_socket(&error))?,
            target: to,
            last_error: None,
            lost: 0,
            checks_without_failure: None,
        })
    }

    /// Reads and counts the errors that the network has reported. If they were not read, sending the next datagram
    /// would fail.
    fn read_errors(&mut self) {
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

/// Opens a socket that sends to addresses of the same version as `ip`.
fn socket(ip: IpAddr) -> io::Result<UdpSocket> {
    let any = if ip.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { IpAddr::from(Ipv6Addr::UNSPECIFIED) };
    let socket = UdpSocket::bind((any, 0))?;
    // If the queue is full, sending returns an error instead of waiting.
    socket.set_nonblocking(true)?;
    // Without the first option, the kernel reports a datagram as sent even if one of its queues has dropped it. With
    // the second option, the kernel refuses datagrams that are too long for the path, instead of fragmenting them.
    if ip.is_ipv4() {
        setsockopt(socket.as_raw_fd(), Ipv4RecvErr, &true)?;
        set_ip_mtu_discover(&socket, Ipv4PathMtuDiscovery::DO)?;
    } else {
        setsockopt(socket.as_raw_fd(), Ipv6RecvErr, &true)?;
        set_ipv6_mtu_discover(&socket, Ipv6PathMtuDiscovery::DO)?;
    }
    // Incoming datagrams are never read, so they get the smallest buffer.
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

const NO_RECEIVER: &str = "no program receives there";
/// Number of checks without a failure that must precede the one that reports a recovery. Checks come once a second. The
/// network reports at most once a second that a host has no receiver, so a single check without a report proves
/// nothing.
const RECOVERY_CHECKS: u32 = 2;

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU16, Ordering};
    use std::time::Duration;

    use super::*;

    #[test]
    fn follows_a_host_to_its_new_address() {
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
        let host = Host::resolve_with(resolve, "robot:7", 0, &AtomicBool::new(false), begin).unwrap();
        let mut destination = UdpDestination::new("robot:7", Target::Host(host)).unwrap();
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
    fn reports_a_host_without_receiver_once() {
        check_without_receiver(UdpSocket::bind("127.0.0.1:0").unwrap());
        match UdpSocket::bind("[::1]:0") {
            Ok(receiver) => check_without_receiver(receiver),
            Err(error) => eprintln!("skipped: no IPv6 here: {error}"),
        }
    }

    fn check_without_receiver(receiver: UdpSocket) {
        let text = receiver.local_addr().unwrap().to_string();
        let mut destination = UdpDestination::host(&text, 0, &AtomicBool::new(false)).unwrap();
        assert!(destination.send(b"one", 0, 0) && destination.check().is_none());
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
        assert!(
            matches!(destination.check(), Some(DestinationEvent::Failing(_)))
                && destination.check().is_none()
        );
        let receiver = UdpSocket::bind(&text).unwrap();
        assert_eq!((destination.check(), destination.check()), (None, Some(DestinationEvent::Recovered)));
        assert!(destination.send(b"three", 0, 0));
        let mut bytes = [0; 9];
        assert_eq!(receiver.recv(&mut bytes).unwrap(), 5);
    }
}
