//! The socket that hears the groups, on every interface that has a link, also on one that comes later or comes back.
//! It sends nothing. Refuses to know what a datagram says.

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
use scanhub_schema::datagram::{GROUPS, PORT};
use scanhub_schema::{Failure, Kind};
use socket2::{Domain, InterfaceIndexOrAddress, Protocol, SockRef, Socket, Type};

use crate::interface::{Changes, Interface, interfaces, named};

/// Hears groups.
pub(super) struct MulticastReceiver {
    socket: UdpSocket,
    groups: Vec<Ipv4Addr>,
    /// The one interface to hear on; none: all that can.
    only: Option<String>,
    joined: Vec<Joined>,
    changes: Changes,
    /// The kernel has said that something changed.
    is_changed: bool,
    look_at: Instant,
    /// Why the groups could not be joined somewhere, or the interfaces not be had.
    trouble: Option<String>,
    /// Room for the kernel's word of when a datagram came.
    stamp: Vec<u8>,
    /// CLOCK_MONOTONIC when nothing waited, in ns.
    empty_ns: u64,
}

/// A datagram as it came.
pub(super) struct Caught<'a> {
    /// All of it.
    pub(super) bytes: &'a [u8],
    /// Its sender's address and port.
    pub(super) from: SocketAddrV4,
    /// When it came, in ns of CLOCK_MONOTONIC and since 1970, however late it is read.
    pub(super) arrival_ns: u64,
    pub(super) wall_ns: u64,
}

/// An interface on which the groups were joined.
struct Joined {
    name: String,
    index: u32,
    /// It had a link when it was last looked at, and was not away since.
    running: bool,
}

/// Between two looks at the interfaces, if the kernel says nothing: what could not be done is tried again.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// Room for what waits while this process does not run; the system gives less where its own limit is lower.
const BUFFER: usize = 4 << 20;

/// The longest datagram that there can be.
pub(super) const LONGEST: usize = 65_536;

impl MulticastReceiver {
    /// Binds the port and joins the `groups` (last bytes) on the interface `only`, or wherever there is a link. If there
    /// is none yet, it is waited for.
    ///
    /// [`Kind::Configuration`] if there is no such interface, [`Kind::Failed`] if the port cannot be had.
    pub(super) fn open(
        only: Option<&str>,
        groups: &[u8],
        now: Instant,
    ) -> Result<MulticastReceiver, Failure> {
        if let Some(name) = only {
            let interface = named(name)?;
            if !interface.multicast {
                let hint = "choose another --interface, or have the gateway send copies: `gateway --to`";
                return Err(Failure::new(Kind::Configuration, format!("{name} carries no multicast"), hint));
            }
        }
        // First the watch: what changes after the look is heard.
        let changes = Changes::watch()?;
        let socket = bind().map_err(|error| {
            let hint = "it is in use by a program that does not share it: `ss -lunp` names it";
            Failure::new(Kind::Failed, format!("cannot listen on UDP port {PORT}: {error}"), hint)
        })?;
        let [a, b, c] = GROUPS;
        let mut receiver = MulticastReceiver {
            socket,
            groups: groups.iter().map(|&last| Ipv4Addr::new(a, b, c, last)).collect(),
            only: only.map(str::to_owned),
            joined: Vec::new(),
            changes,
            is_changed: false,
            look_at: now,
            trouble: None,
            stamp: cmsg_space!(TimeSpec),
            empty_ns: clock::now_ns(),
        };
        receiver.look(now);
        Ok(receiver)
    }

    /// Joins the groups where a link came or came back, if the kernel has said that something changed, or the last look is
    /// long enough ago. A switch that filters by group has forgotten us when a cable was pulled, and an interface that was
    /// made anew never knew us. If the system does not tell its interfaces, all stays as it is until the next look.
    pub(super) fn look(&mut self, now: Instant) {
        if !self.is_changed && now < self.look_at {
            return;
        }
        self.is_changed = false;
        self.look_at = now + LOOK_EVERY;
        let joined = &mut self.joined;
        self.changes.take(|away| {
            joined
                .iter_mut()
                .filter(|joined| away.includes(joined.index))
                .for_each(|joined| joined.running = false);
        });
        let all = match interfaces() {
            Ok(all) => all,
            Err(failure) => {
                self.trouble = Some(failure.to_string());
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
            if !self.wants(interface) {
                continue;
            }
            match self.joined.iter_mut().find(|joined| joined.index == interface.index) {
                Some(joined) if joined.running || !interface.running => joined.running = interface.running,
                _ if interface.running => self.join(interface),
                _ => {}
            }
        }
    }

    /// The names of the interfaces on which it hears.
    pub(super) fn interfaces(&self) -> Vec<&str> {
        self.joined.iter().map(|joined| joined.name.as_str()).collect()
    }

    /// Why the groups could not be joined somewhere, or the interfaces not be had, when that was tried last.
    pub(super) fn take_trouble(&mut self) -> Option<String> {
        self.trouble.take()
    }

    /// The next datagram that waits, or nothing; `buffer` has [`LONGEST`] bytes.
    ///
    /// [`Kind::Failed`] if the socket is of no use any more.
    pub(super) fn receive<'a>(&mut self, buffer: &'a mut [u8]) -> Result<Option<Caught<'a>>, Failure> {
        let (fd, stamp) = (self.socket.as_raw_fd(), &mut self.stamp);
        let mut room = [IoSliceMut::new(&mut *buffer)];
        let received = recvmsg::<SockaddrIn>(fd, &mut room, Some(stamp), MsgFlags::empty());
        let (len, from, came_ns) = match received {
            Ok(message) => {
                let came_ns = message.cmsgs().find_map(|said| match said {
                    ControlMessageOwned::ScmTimestampns(at) => Some(wall_ns(at)),
                    _ => None,
                });
                (message.bytes, message.address, came_ns)
            }
            Err(Errno::EAGAIN) => {
                self.empty_ns = clock::now_ns();
                return Ok(None);
            }
            Err(Errno::EINTR) => return Ok(None),
            Err(error) => return Err(Failure::new(Kind::Failed, format!("cannot receive: {error}"), "")),
        };
        let (now_ns, wall_ns) = (clock::now_ns(), clock::wall_ns());
        let waited_ns = waited_ns(came_ns, wall_ns, now_ns.saturating_sub(self.empty_ns));
        Ok(Some(Caught {
            bytes: &buffer[..len],
            from: from.map_or(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0), SocketAddrV4::from),
            arrival_ns: now_ns - waited_ns,
            wall_ns: wall_ns.saturating_sub(waited_ns),
        }))
    }

    /// Sleeps until a datagram waits, an interface changes, a signal comes or `left` is over.
    pub(super) fn wait(&mut self, left: Duration) {
        let left = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: i64::from(left.subsec_nanos()) };
        // What would go wrong here, receiving tells.
        let mut both = [PollFd::new(&self.socket, PollFlags::IN), PollFd::new(&self.changes, PollFlags::IN)];
        let _ = poll(&mut both, Some(&left));
        self.is_changed = !both[1].revents().is_empty();
    }

    fn wants(&self, interface: &Interface) -> bool {
        match &self.only {
            Some(name) => interface.name == *name,
            // Those of containers and bridges have none, and there are more of them than a socket can join.
            None => interface.multicast && interface.address.is_some(),
        }
    }

    fn join(&mut self, interface: &Interface) {
        let index = InterfaceIndexOrAddress::Index(interface.index);
        let socket = SockRef::from(&self.socket);
        // First: joining again what was joined before tells the network nothing.
        leave(&self.socket, &self.groups, interface.index);
        for group in &self.groups {
            if let Err(error) = socket.join_multicast_v4_n(group, &index) {
                self.trouble = Some(format!("cannot join {group} on {}: {error}", interface.name));
                leave(&self.socket, &self.groups, interface.index);
                return;
            }
        }
        self.joined.retain(|joined| joined.index != interface.index);
        self.joined.push(Joined { name: interface.name.clone(), index: interface.index, running: true });
    }
}

/// Leaves what was joined of `groups` on interface number `index`. Of one that is gone, too: a socket keeps what it joined
/// there, and can have 20 of them (`net.ipv4.igmp_max_memberships`).
fn leave(socket: &UdpSocket, groups: &[Ipv4Addr], index: u32) {
    for group in groups {
        let _ = SockRef::from(socket).leave_multicast_v4_n(group, &InterfaceIndexOrAddress::Index(index));
    }
}

/// How long a datagram waited that came at `came_ns`, by a wall clock that says `wall_ns` now and may have been set meanwhile:
/// never longer than it is since nothing waited, `at_most_ns`.
fn waited_ns(came_ns: Option<u64>, wall_ns: u64, at_most_ns: u64) -> u64 {
    came_ns.map_or(0, |came_ns| wall_ns.saturating_sub(came_ns)).min(at_most_ns)
}

/// A time since 1970, in ns.
fn wall_ns(at: TimeSpec) -> u64 {
    u64::try_from(Duration::from(at).as_nanos()).unwrap_or_default()
}

/// Not bound to a group: copies that are sent to this machine alone are heard as well. What other programs have joined is
/// not.
fn bind() -> io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_reuse_address(true)?;
    socket.set_multicast_all_v4(false)?;
    // Less is no reason to fail: what does not fit is lost, and counted.
    let _ = socket.set_recv_buffer_size(BUFFER);
    socket.set_nonblocking(true)?;
    // What waited while this process did not run shall not be taken for new.
    setsockopt(socket.as_raw_fd(), ReceiveTimestampns, &true)?;
    socket.bind(&SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT).into())?;
    Ok(socket.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_waited_came_earlier_and_a_clock_that_is_set_says_nothing_else() {
        assert_eq!(waited_ns(Some(700), 1_000, 5_000), 300);
        assert_eq!(waited_ns(Some(700), 900_000, 5_000), 5_000, "set forward");
        assert_eq!(waited_ns(Some(700), 100, 5_000), 0, "set back");
        assert_eq!(waited_ns(None, 1_000, 5_000), 0);
    }
}
