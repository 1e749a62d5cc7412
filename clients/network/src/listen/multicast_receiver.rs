//! Socket that receives the datagrams of groups on every interface with a carrier, including interfaces that appear or
//! come back later.

use std::io::{self, IoSliceMut};
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::fd::AsRawFd;
use std::time::{Duration, Instant};

use nix::cmsg_space;
use nix::errno::Errno;
use nix::sys::socket::sockopt::ReceiveTimestampns;
use nix::sys::socket::{ControlMessageOwned, MsgFlags, SockaddrIn, recvmsg, setsockopt};
use nix::sys::time::TimeSpec;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use scanhub_client::clock;
use scanhub_schema::datagram::{GROUP_PREFIX, PORT};
use scanhub_schema::{Failure, Kind};
use socket2::{Domain, InterfaceIndexOrAddress, Protocol, SockRef, Socket, Type};

use crate::interface::{Interface, InterfaceChanges, by_name, interfaces};
use crate::lan::WallTimestamp;

/// Socket that receives from multicast groups, and the interfaces on which it has joined them.
pub(super) struct MulticastReceiver {
    socket: UdpSocket,
    groups: Vec<Ipv4Addr>,
    /// The only interface to receive on; `None` for all suitable interfaces.
    only_interface: Option<String>,
    joined: Vec<JoinedInterface>,
    changes: InterfaceChanges,
    /// Whether the kernel has reported a change that was not handled yet.
    is_changed: bool,
    /// Time of the next update of the interfaces if the kernel reports no change before.
    update_at: Instant,
    /// Reason why groups could not be joined or interfaces could not be listed, until it is taken.
    problem: Option<String>,
    /// Buffer for the kernel's timestamp of a datagram.
    timestamp: Vec<u8>,
    /// Last time at which no datagram was waiting, in ns of CLOCK_MONOTONIC.
    empty_ns: u64,
}

/// A received datagram.
pub(super) struct ReceivedDatagram<'a> {
    /// Whole datagram.
    pub(super) bytes: &'a [u8],
    /// Address and port of the sender.
    pub(super) from: SocketAddrV4,
    /// Time at which it arrived, even if it was read later.
    pub(super) arrival: WallTimestamp,
}

/// An interface on which the groups were joined.
struct JoinedInterface {
    name: String,
    index: u32,
    /// Whether it had a carrier at the last update, and has not lost it since.
    running: bool,
}

/// Interval between updates of the interfaces while the kernel reports no change. Each update retries what has failed
/// before.
const UPDATE_INTERVAL: Duration = Duration::from_millis(500);

/// Size of the kernel's buffer for datagrams that arrive while this process does not run, in bytes. The system may
/// reduce it.
const RECEIVE_BUFFER_LEN: usize = 4 << 20;

/// Maximum length of a datagram, in bytes.
pub(super) const MAX_DATAGRAM_LEN: usize = 65_536;

impl MulticastReceiver {
    /// Binds the port, and joins the `groups` (their last bytes) on the interface `only`, or on all interfaces with a
    /// carrier. An interface without a carrier is joined once it has one.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] if the interface does not exist or has no multicast, and [`Kind::Failed`] if the
    /// port is not available.
    pub(super) fn open(
        only: Option<&str>,
        groups: &[u8],
        now: Instant,
    ) -> Result<MulticastReceiver, Failure> {
        if let Some(name) = only {
            let interface = by_name(name)?;
            if !interface.multicast {
                let hint = "choose another --interface, or have the gateway send copies: `gateway --to`";
                return Err(Failure::new(Kind::Configuration, format!("{name} carries no multicast"), hint));
            }
        }
        // Subscribe before reading the state, so that no change is missed in between.
        let changes = InterfaceChanges::subscribe()?;
        let socket = bind().map_err(|error| {
            let hint = "it is in use by a program that does not share it: `ss -lunp` names it";
            Failure::new(Kind::Failed, format!("cannot listen on UDP port {PORT}: {error}"), hint)
        })?;
        let [a, b, c] = GROUP_PREFIX;
        let mut receiver = MulticastReceiver {
            socket,
            groups: groups.iter().map(|&last| Ipv4Addr::new(a, b, c, last)).collect(),
            only_interface: only.map(str::to_owned),
            joined: Vec::new(),
            changes,
            is_changed: false,
            update_at: now,
            problem: None,
            timestamp: cmsg_space!(TimeSpec),
            empty_ns: clock::now_ns(),
        };
        receiver.update_interfaces(now);
        Ok(receiver)
    }

    /// Joins the groups on interfaces that have a new carrier, if the kernel has reported a change or an update is due.
    /// The groups are joined again even on a known interface, because a switch that filters by group forgets the
    /// members of a group when their cable is unplugged. If the system cannot list interfaces, the groups remain as
    /// they are until the next update.
    pub(super) fn update_interfaces(&mut self, now: Instant) {
        if !self.is_changed && now < self.update_at {
            return;
        }
        self.is_changed = false;
        self.update_at = now + UPDATE_INTERVAL;
        let joined = &mut self.joined;
        self.changes.read(|lost| {
            joined
                .iter_mut()
                .filter(|joined| lost.includes(joined.index))
                .for_each(|joined| joined.running = false);
        });
        let all = match interfaces() {
            Ok(all) => all,
            Err(failure) => {
                self.problem = Some(failure.to_string());
                return;
            }
        };
        let (socket, groups) = (&self.socket, &self.groups);
        self.joined.retain(|joined| {
            let is_there = all.iter().any(|interface| interface.index == joined.index);
            if !is_there {
                leave(socket, groups, joined.index);
            }
            is_there
        });
        for interface in &all {
            if !self.is_suitable(interface) {
                continue;
            }
            match self.joined.iter_mut().find(|joined| joined.index == interface.index) {
                Some(joined) if joined.running || !interface.running => joined.running = interface.running,
                _ if interface.running => self.join(interface),
                _ => {}
            }
        }
    }

    /// Returns the names of the interfaces on which the groups are joined.
    pub(super) fn interfaces(&self) -> Vec<&str> {
        self.joined.iter().map(|joined| joined.name.as_str()).collect()
    }

    /// Returns the last reason why groups could not be joined or interfaces could not be listed, but each reason once.
    pub(super) fn take_problem(&mut self) -> Option<String> {
        self.problem.take()
    }

    /// Receives the next waiting datagram. `None` if none waits. `buffer` has [`MAX_DATAGRAM_LEN`] bytes.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the socket fails.
    pub(super) fn receive<'a>(
        &mut self,
        buffer: &'a mut [u8],
    ) -> Result<Option<ReceivedDatagram<'a>>, Failure> {
        let (fd, timestamp) = (self.socket.as_raw_fd(), &mut self.timestamp);
        let mut room = [IoSliceMut::new(&mut *buffer)];
        let received = recvmsg::<SockaddrIn>(fd, &mut room, Some(timestamp), MsgFlags::empty());
        let (len, from, arrived_ns) = match received {
            Ok(message) => {
                let arrived_ns = message.cmsgs().find_map(|control| match control {
                    ControlMessageOwned::ScmTimestampns(at) => Some(wall_ns(at)),
                    _ => None,
                });
                (message.bytes, message.address, arrived_ns)
            }
            Err(Errno::EAGAIN) => {
                self.empty_ns = clock::now_ns();
                return Ok(None);
            }
            Err(Errno::EINTR) => return Ok(None),
            Err(error) => return Err(Failure::new(Kind::Failed, format!("cannot receive: {error}"), "")),
        };
        let (now_ns, wall_ns) = (clock::now_ns(), clock::wall_ns());
        let waited_ns = waited_ns(arrived_ns, wall_ns, now_ns.saturating_sub(self.empty_ns));
        Ok(Some(ReceivedDatagram {
            bytes: &buffer[..len],
            from: from.map_or(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0), SocketAddrV4::from),
            arrival: WallTimestamp {
                monotonic_ns: now_ns - waited_ns,
                wall_ns: wall_ns.saturating_sub(waited_ns),
            },
        }))
    }

    /// Sleeps until a datagram arrives, an interface changes or a signal arrives, but no longer than `at_most`.
    pub(super) fn wait(&mut self, at_most: Duration) {
        let timeout =
            Timespec { tv_sec: at_most.as_secs() as i64, tv_nsec: i64::from(at_most.subsec_nanos()) };
        // Ignore an error: receiving then fails, too, and returns the error.
        let mut both = [PollFd::new(&self.socket, PollFlags::IN), PollFd::new(&self.changes, PollFlags::IN)];
        let _ = poll(&mut both, Some(&timeout));
        self.is_changed = !both[1].revents().is_empty();
    }

    /// Returns whether to receive on `interface`.
    fn is_suitable(&self, interface: &Interface) -> bool {
        match &self.only_interface {
            Some(name) => interface.name == *name,
            // Interfaces without an address, such as those of containers and bridges, are not used, because a socket
            // cannot join on all of them.
            None => interface.multicast && interface.address.is_some(),
        }
    }

    /// Joins the groups on `interface`.
    fn join(&mut self, interface: &Interface) {
        let index = InterfaceIndexOrAddress::Index(interface.index);
        let socket = SockRef::from(&self.socket);
        // Leave first: joining a group that is already joined sends no message to the network.
        leave(&self.socket, &self.groups, interface.index);
        for group in &self.groups {
            if let Err(error) = socket.join_multicast_v4_n(group, &index) {
                self.problem = Some(format!("cannot join {group} on {}: {error}", interface.name));
                leave(&self.socket, &self.groups, interface.index);
                return;
            }
        }
        self.joined.retain(|joined| joined.index != interface.index);
        self.joined.push(JoinedInterface {
            name: interface.name.clone(),
            index: interface.index,
            running: true,
        });
    }
}

/// Leaves the groups that were joined on the interface with this index. The call is necessary even if the interface no
/// longer exists: the socket keeps its memberships on it, and can have 20 at most (`net.ipv4.igmp_max_memberships`).
fn leave(socket: &UdpSocket, groups: &[Ipv4Addr], index: u32) {
    for group in groups {
        let _ = SockRef::from(socket).leave_multicast_v4_n(group, &InterfaceIndexOrAddress::Index(index));
    }
}

/// Returns how long a datagram that arrived at `arrived_ns` has waited until `wall_ns`. Both times come from the wall
/// clock, which may have been set in between, so the result is limited to `at_most_ns`, the time since no datagram was
/// waiting.
fn waited_ns(arrived_ns: Option<u64>, wall_ns: u64, at_most_ns: u64) -> u64 {
    arrived_ns.map_or(0, |arrived_ns| wall_ns.saturating_sub(arrived_ns)).min(at_most_ns)
}

/// Returns a time since 1970, in ns.
fn wall_ns(at: TimeSpec) -> u64 {
    u64::try_from(Duration::from(at).as_nanos()).unwrap_or_default()
}

/// Binds the port on all addresses, so that copies to this machine are received, too. Datagrams of groups that only
/// other programs have joined are not received.
fn bind() -> io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_reuse_address(true)?;
    socket.set_multicast_all_v4(false)?;
    // If the system refuses this length, more datagrams are lost, but lost datagrams are counted.
    let _ = socket.set_recv_buffer_size(RECEIVE_BUFFER_LEN);
    socket.set_nonblocking(true)?;
    // Request the time of arrival of each datagram, because a datagram that waited while this process did not run must
    // not count as new.
    setsockopt(socket.as_raw_fd(), ReceiveTimestampns, &true)?;
    socket.bind(&SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT).into())?;
    Ok(socket.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffering_time_is_bounded_after_a_clock_change() {
        assert_eq!(waited_ns(Some(700), 1_000, 5_000), 300);
        assert_eq!(waited_ns(Some(700), 900_000, 5_000), 5_000, "set forward");
        assert_eq!(waited_ns(Some(700), 100, 5_000), 0, "set back");
        assert_eq!(waited_ns(None, 1_000, 5_000), 0);
    }
}
