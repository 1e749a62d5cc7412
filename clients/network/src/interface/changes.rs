//! Notifications of the kernel that network interfaces or their addresses changed (rtnetlink(7)), and which interfaces
//! were down in between, however short: polling could miss a link that went down and came back. Refuses to know who
//! uses them.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rustix::io::Errno;
use rustix::net::netlink::SocketAddrNetlink;
use rustix::net::{
    AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, bind, recv, send, socket_with,
};
use scanhub_schema::{Failure, Kind};

/// Hears what changes.
pub(crate) struct Changes {
    socket: OwnedFd,
    buffer: Vec<u8>,
    links: Links,
}

/// What lost its link, was switched off or taken away; it may be back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Away {
    /// The interface with this number.
    One(u32),
    /// It is not known which: the queue of notifications overflowed.
    Any,
}

/// The kernel makes no longer ones (Linux, Documentation/userspace-api/netlink/intro.rst).
const LONGEST: usize = 32 << 10;

impl Changes {
    /// Begins to listen: what changes from now on is heard.
    ///
    /// [`Kind::Failed`] if the kernel refuses.
    pub(crate) fn watch() -> Result<Changes, Failure> {
        let socket = open().map_err(|error| {
            Failure::new(Kind::Failed, format!("cannot watch network interfaces: {error}"), "")
        })?;
        Ok(Changes { socket, buffer: vec![0; LONGEST], links: Links::default() })
    }

    /// Takes all that waits, and tells `away` of each interface that was away since the last call; whether anything
    /// changed at all. One system call as long as nothing did.
    pub(crate) fn take(&mut self, mut away: impl FnMut(Away)) -> bool {
        let mut any = false;
        loop {
            match recv(&self.socket, &mut self.buffer[..], RecvFlags::DONTWAIT) {
                Ok((len, _)) => self.links.read(&self.buffer[..len], &mut away),
                Err(Errno::NOBUFS) => away(Away::Any),
                Err(Errno::INTR) => continue,
                Err(_) => return any,
            }
            any = true;
        }
    }
}

impl AsFd for Changes {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

impl Away {
    /// It may be the interface with this number.
    pub(crate) fn includes(self, index: u32) -> bool {
        self == Away::Any || self == Away::One(index)
    }
}

/// A socket that hears of links and addresses without waiting for them, and has asked for all links that there are.
fn open() -> rustix::io::Result<OwnedFd> {
    const LINK: u32 = 1;
    const IPV4_ADDRESS: u32 = 0x10;
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    // No protocol: NETLINK_ROUTE is 0.
    let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, None)?;
    bind(&socket, &SocketAddrNetlink::new(0, LINK | IPV4_ADDRESS))?;
    send(&socket, &all_links(), SendFlags::empty())?;
    Ok(socket)
}

/// The request for all links.
fn all_links() -> [u8; HEADER + LINK_HEADER] {
    const REQUEST_DUMP: u16 = 0x301;
    let mut request = [0; HEADER + LINK_HEADER];
    request[..4].copy_from_slice(&((HEADER + LINK_HEADER) as u32).to_ne_bytes());
    request[4..6].copy_from_slice(&GETLINK.to_ne_bytes());
    request[6..8].copy_from_slice(&REQUEST_DUMP.to_ne_bytes());
    request
}

/// How often each link was lost. Where that happens twice in a second the kernel speaks of both at once, when the link is
/// back; then only this number tells of it.
#[derive(Default)]
struct Links {
    /// By the interface's number.
    losses: Vec<(u32, u32)>,
}

// struct nlmsghdr and struct ifinfomsg.
const HEADER: usize = 16;
const LINK_HEADER: usize = 16;
const NEWLINK: u16 = 16;
const DELLINK: u16 = 17;
const GETLINK: u16 = 18;
const RUNNING: u32 = 0x40;
/// IFLA_CARRIER_DOWN_COUNT, since Linux 4.16.
const LOSSES: u16 = 48;

impl Links {
    /// Reads a datagram of the kernel's.
    fn read(&mut self, mut bytes: &[u8], away: &mut impl FnMut(Away)) {
        while let Some((message, rest)) = u32_at(bytes, 0).and_then(|len| cut(bytes, len as usize)) {
            bytes = rest;
            let (Some(kind), Some(index)) = (u16_at(message, 4), u32_at(message, HEADER + 4)) else { return };
            if kind == DELLINK {
                self.losses.retain(|&(known, _)| known != index);
                away(Away::One(index));
            } else if kind == NEWLINK {
                let is_running = u32_at(message, HEADER + 8).is_some_and(|flags| flags & RUNNING != 0);
                let is_lost_again = losses(message).is_some_and(|losses| self.note(index, losses));
                if !is_running || is_lost_again {
                    away(Away::One(index));
                }
            }
        }
    }

    /// Notes how often the link was lost; whether that is news.
    fn note(&mut self, index: u32, losses: u32) -> bool {
        match self.losses.iter_mut().find(|(known, _)| *known == index) {
            Some((_, before)) => std::mem::replace(before, losses) != losses,
            None => {
                self.losses.push((index, losses));
                false
            }
        }
    }
}

/// How often the link was lost that `message` speaks of.
fn losses(message: &[u8]) -> Option<u32> {
    let mut attributes = message.get(HEADER + LINK_HEADER..)?;
    loop {
        let (attribute, rest) = cut(attributes, u16_at(attributes, 0)?.into())?;
        if u16_at(attribute, 2) == Some(LOSSES) {
            return u32_at(attribute, 4);
        }
        attributes = rest;
    }
}

/// The first `len` bytes, and what is behind them, which begins at a multiple of four; nothing if there are not so many,
/// or not even a length.
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

    /// A message as the kernel makes it: with a name before the number of losses.
    fn message(kind: u16, index: u32, flags: u32, losses: Option<u32>) -> Vec<u8> {
        let mut body = vec![0; 4];
        body.extend([index.to_ne_bytes(), flags.to_ne_bytes(), [0xFF; 4]].concat());
        body.extend([&7_u16.to_ne_bytes(), &3_u16.to_ne_bytes(), &b"lo\0\0"[..]].concat());
        if let Some(losses) = losses {
            body.extend([&8_u16.to_ne_bytes()[..], &LOSSES.to_ne_bytes(), &losses.to_ne_bytes()].concat());
        }
        let mut bytes = ((HEADER + body.len()) as u32).to_ne_bytes().to_vec();
        bytes.extend([&kind.to_ne_bytes()[..], &[0; 10]].concat());
        bytes.extend(body);
        bytes
    }

    fn read(links: &mut Links, bytes: &[u8]) -> Vec<Away> {
        let mut all = Vec::new();
        links.read(bytes, &mut |away| all.push(away));
        all
    }

    #[test]
    fn a_link_that_was_lost_is_told_although_it_is_back() {
        let mut links = Links::default();
        let of = |index, flags, losses| message(NEWLINK, index, flags, Some(losses));
        let all = [of(1, RUNNING, 0), of(2, RUNNING, 5), of(3, 0, 1)].concat();
        assert_eq!(read(&mut links, &all), [Away::One(3)]);
        assert_eq!(read(&mut links, &of(2, RUNNING, 5)), [], "something else of it");
        assert_eq!(read(&mut links, &of(2, RUNNING, 6)), [Away::One(2)]);
        assert_eq!(read(&mut links, &of(2, RUNNING, 6)), []);
        assert_eq!(read(&mut links, &message(NEWLINK, 1, RUNNING, None)), [], "an old kernel");
        assert_eq!(read(&mut links, &message(NEWLINK, 1, 0, None)), [Away::One(1)]);
        assert_eq!(read(&mut links, &message(DELLINK, 2, RUNNING, Some(6))), [Away::One(2)]);
        assert_eq!(read(&mut links, &of(2, RUNNING, 0)), [], "another one with its number");
        assert!(Away::One(2).includes(2) && !Away::One(2).includes(3) && Away::Any.includes(3));
    }

    #[test]
    fn what_is_cut_short_says_nothing() {
        let whole = message(NEWLINK, 2, 0, Some(1));
        for len in 0..whole.len() {
            assert_eq!(read(&mut Links::default(), &whole[..len]), [], "{len}");
        }
        assert_eq!(read(&mut Links::default(), &3_u32.to_ne_bytes()), [], "shorter than its own length");
    }

    #[test]
    fn the_kernel_tells_what_there_is() {
        let mut changes = Changes::watch().unwrap();
        // It has answered before the request was through.
        assert!(changes.take(|_| {}) && changes.links.losses.iter().any(|&(index, _)| index > 0));
    }
}
