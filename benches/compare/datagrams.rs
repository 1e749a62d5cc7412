//! UDP multicast on the loopback and Unix datagram sockets. What is longer than a datagram may be is sent as several, as a
//! user would, and put together by the receiver; one of them lost is the message lost.

use std::io::{IoSlice, IoSliceMut};
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixDatagram;

use rustix::net::sockopt::{
    set_ip_multicast_if, set_socket_recv_buffer_size, set_socket_recv_buffer_size_force, set_socket_reuseaddr,
};
use rustix::net::{
    AddressFamily, RecvAncillaryBuffer, RecvFlags, SendAncillaryBuffer, SendFlags, SocketFlags, SocketType,
    bind, recvmsg, sendmsg, socket_with,
};

use super::message::{Draft, Label, SHORT};
use super::receiver::Inlet;
use super::sender::{Outlet, Task};
use super::way::Way;
use crate::support::Outcome;

/// The sending sockets: one for each receiver, or one for the group.
pub(crate) struct Datagrams {
    group: Option<Ipv4Addr>,
    paths: Vec<String>,
    sockets: Vec<OwnedFd>,
    draft: Draft,
    /// Bytes of a message in one datagram.
    part: usize,
}

impl Datagrams {
    pub(crate) fn new(task: &Task) -> Outcome<Datagrams> {
        let [_, _, high, low] = std::process::id().to_be_bytes();
        let group = (task.way == Way::Multicast).then(|| Ipv4Addr::new(239, 83, high, low));
        let receivers = if group.is_some() { 0 } else { task.receivers };
        let paths = (0..receivers).map(|number| mailbox(task.place, number)).collect();
        let (draft, part) = (Draft::new(task.payload), part(task));
        Ok(Datagrams { group, paths, sockets: Vec::new(), draft, part })
    }
}

impl Outlet for Datagrams {
    fn address(&self) -> Outcome<String> {
        Ok(self.group.map_or("-".into(), |group| group.to_string()))
    }

    fn open(&mut self) -> Outcome<()> {
        if let Some(group) = self.group {
            let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
            set_ip_multicast_if(&socket, &Ipv4Addr::LOCALHOST)?;
            socket.set_multicast_ttl_v4(0)?;
            socket.connect((group, PORT))?;
            self.sockets.push(socket.into());
        }
        for path in &self.paths {
            let socket = UnixDatagram::unbound()?;
            socket.connect(path)?;
            self.sockets.push(socket.into());
        }
        Ok(())
    }

    fn write(&mut self, label: Label) -> Outcome<()> {
        self.draft.write(label);
        Ok(())
    }

    fn send(&mut self) -> Outcome<()> {
        self.sockets.iter().try_for_each(|socket| send(socket, self.draft.bytes(), self.part))
    }

    fn end(&mut self, label: Label) -> Outcome<()> {
        let message = self.draft.write_short(label);
        for socket in &self.sockets {
            rustix::io::write(socket, message)?;
        }
        Ok(())
    }
}

impl Drop for Datagrams {
    fn drop(&mut self) {
        for path in &self.paths {
            let _ = std::fs::remove_file(path);
        }
    }
}

fn send(socket: &OwnedFd, message: &[u8], part: usize) -> Outcome<()> {
    if message.len() <= part {
        rustix::io::write(socket, message)?;
        return Ok(());
    }
    let number = &message[..NUMBER];
    for (index, bytes) in message.chunks(part).enumerate() {
        let index = (index as u64).to_le_bytes();
        let slices = [number, &index, bytes].map(IoSlice::new);
        sendmsg(socket, &slices, &mut SendAncillaryBuffer::default(), SendFlags::empty())?;
    }
    Ok(())
}

/// A receiving socket.
pub(crate) struct DatagramsInlet {
    socket: OwnedFd,
    message: Vec<u8>,
    len: usize,
    part: usize,
    /// Parts of the message that are there.
    parts: usize,
}

impl DatagramsInlet {
    pub(crate) fn new(task: &Task, number: usize, address: &str) -> Outcome<DatagramsInlet> {
        let socket = match task.way {
            Way::Multicast => ear(address.parse()?)?,
            _ => UnixDatagram::bind(mailbox(task.place, number))?.into(),
        };
        let (len, part) = (task.payload, part(task));
        // A part that comes instead of the last one may be longer.
        Ok(DatagramsInlet { socket, message: vec![0; len + part], len, part, parts: 0 })
    }

    /// The next part, written behind those that are there; the message's label if that was the last one.
    fn take_part(&mut self) -> Outcome<Option<Label>> {
        let place = self.parts * self.part;
        let (mut number, mut index) = ([0; NUMBER], [0; NUMBER]);
        let body = &mut self.message[place..][..self.part];
        let mut slices = [&mut number[..], &mut index[..], body].map(IoSliceMut::new);
        let mut control = RecvAncillaryBuffer::default();
        let len = recvmsg(&self.socket, &mut slices, &mut control, RecvFlags::empty())?.bytes;
        if len == SHORT {
            let tail = &self.message[place..][..NUMBER];
            return Ok(Some(Label::read(&[&number, &index, tail].concat())?));
        }
        let index = u64::from_le_bytes(index) as usize;
        if index == 0 {
            self.message.copy_within(place..place + self.part, 0);
        } else if index != self.parts || self.message[..NUMBER] != number {
            // What is there will never be whole.
            self.parts = 0;
            return Ok(None);
        }
        self.parts = index + 1;
        if self.parts < self.len.div_ceil(self.part) {
            return Ok(None);
        }
        self.parts = 0;
        Ok(Some(Label::read(&self.message[..self.len])?))
    }
}

impl Inlet for DatagramsInlet {
    fn next(&mut self) -> Outcome<Label> {
        if self.len <= self.part {
            let len = rustix::io::read(&self.socket, &mut self.message)?;
            return Label::read(&self.message[..len]);
        }
        loop {
            if let Some(label) = self.take_part()? {
                return Ok(label);
            }
        }
    }
}

/// A member of `group`, with as much room as the system gives.
fn ear(group: Ipv4Addr) -> Outcome<OwnedFd> {
    let socket = socket_with(AddressFamily::INET, SocketType::DGRAM, SocketFlags::CLOEXEC, None)?;
    set_socket_reuseaddr(&socket, true)?;
    bind(&socket, &SocketAddrV4::new(group, PORT))?;
    if set_socket_recv_buffer_size_force(&socket, ROOM).is_err() {
        set_socket_recv_buffer_size(&socket, ROOM)?;
    }
    let socket = UdpSocket::from(socket);
    socket.join_multicast_v4(&group, &Ipv4Addr::LOCALHOST)?;
    Ok(socket.into())
}

/// As much of a message as one datagram of this kind holds.
fn part(task: &Task) -> usize {
    match task.way {
        Way::Multicast if task.payload > UDP => UDP - 2 * NUMBER,
        Way::Multicast => UDP,
        _ => UNIX,
    }
}

fn mailbox(place: &str, number: usize) -> String {
    format!("{place}-mailbox-{number}")
}

/// What a part begins with: the message's number, and its own.
const NUMBER: usize = size_of::<u64>();
/// The longest UDP datagram.
const UDP: usize = 65_507;
/// As long as the system's send buffer takes with all that the kernel adds to it.
const UNIX: usize = 65_536;
/// Bytes that may wait for a receiver of the group.
const ROOM: usize = 4 << 20;
/// Of all groups here; each run has a group of its own.
const PORT: u16 = 29_183;
