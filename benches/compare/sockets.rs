//! The mechanisms that users would take instead of topics: UDP multicast, Unix sockets, TCP and pipes.

use std::fs::{File, OpenOptions};
use std::io::{IoSlice, IoSliceMut, Read, Write};
use std::net::{Ipv4Addr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::os::fd::OwnedFd;
use std::os::unix::net::{UnixDatagram, UnixListener, UnixStream};
use std::path::Path;

use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::net::sockopt::{
    set_ip_multicast_if, set_socket_recv_buffer_size, set_socket_recv_buffer_size_force, set_socket_reuseaddr,
};
use rustix::net::{
    AddressFamily, RecvAncillaryBuffer, RecvFlags, SendAncillaryBuffer, SendFlags, SocketFlags, SocketType,
    bind, recvmsg, sendmsg, socket_with,
};
use rustix::pipe::fcntl_setpipe_size;

use super::message::{Draft, Label, SHORT, Way};
use super::process::{Inlet, Outlet, Task};
use crate::support::Outcome;

/// The sending sockets of UDP multicast on the loopback, which is one for the group, or of Unix datagram sockets, which
/// are one per receiver. A message that is longer than a datagram is sent as several and reassembled by the receiver,
/// as users would do it; if one of them is lost, the message is lost.
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
    /// Parts of the message that have arrived.
    parts: usize,
}

impl DatagramsInlet {
    pub(crate) fn new(task: &Task, number: usize, address: &str) -> Outcome<DatagramsInlet> {
        let socket = match task.way {
            Way::Multicast => group_socket(address.parse()?)?,
            _ => UnixDatagram::bind(mailbox(task.place, number))?.into(),
        };
        let (len, part) = (task.payload, part(task));
        // A part that arrives instead of the last one may be longer.
        Ok(DatagramsInlet { socket, message: vec![0; len + part], len, part, parts: 0 })
    }

    /// Receives the next part, and writes it after those that have arrived. Returns the label of the message if that
    /// was the last part.
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
            // The parts that have arrived will never be complete.
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

/// Returns a socket in `group` with the largest receive buffer that the system allows.
fn group_socket(group: Ipv4Addr) -> Outcome<OwnedFd> {
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

/// Returns how much of a message a datagram of this kind holds.
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

/// Length of each of the two numbers at the start of a part: that of the message, and its own.
const NUMBER: usize = size_of::<u64>();
/// Maximum length of a UDP datagram.
const UDP: usize = 65_507;
/// Maximum length that the system's send buffer holds with the kernel's overhead.
const UNIX: usize = 65_536;
/// Receive buffer of a member of the group, in bytes.
const ROOM: usize = 4 << 20;
/// Port of all groups; each run has its own group.
const PORT: u16 = 29_183;

/// The sending ends of Unix stream sockets, TCP or pipes: one connection per receiver, and one write to each for a
/// message. All messages have the same length, so a receiver reads exactly one message, with one read if possible.
pub(crate) struct Streams {
    listener: Listener,
    receivers: usize,
    ends: Vec<File>,
    draft: Draft,
}

/// The addresses on which receivers connect.
enum Listener {
    Unix(UnixListener, String),
    Tcp(TcpListener),
    Pipes(Vec<String>),
}

impl Streams {
    pub(crate) fn new(task: &Task) -> Outcome<Streams> {
        let listener = match task.way {
            Way::Tcp => Listener::Tcp(TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?),
            Way::Pipe => {
                let paths: Vec<_> = (0..task.receivers).map(|number| pipe(task.place, number)).collect();
                for path in &paths {
                    mknodat(CWD, path.as_str(), FileType::Fifo, Mode::RUSR | Mode::WUSR, 0)?;
                }
                Listener::Pipes(paths)
            }
            _ => {
                let path = listening_path(task.place);
                Listener::Unix(UnixListener::bind(&path)?, path)
            }
        };
        Ok(Streams { listener, receivers: task.receivers, ends: Vec::new(), draft: Draft::new(task.payload) })
    }
}

impl Outlet for Streams {
    fn address(&self) -> Outcome<String> {
        Ok(match &self.listener {
            Listener::Tcp(listener) => listener.local_addr()?.to_string(),
            _ => "-".into(),
        })
    }

    fn open(&mut self) -> Outcome<()> {
        for number in 0..self.receivers {
            let end = match &self.listener {
                Listener::Unix(listener, _) => File::from(OwnedFd::from(listener.accept()?.0)),
                Listener::Tcp(listener) => {
                    let stream = listener.accept()?.0;
                    stream.set_nodelay(true)?;
                    File::from(OwnedFd::from(stream))
                }
                Listener::Pipes(paths) => {
                    let end = OpenOptions::new().write(true).open(&paths[number])?;
                    // As large as a message. Users may not be allowed that; then the size stays.
                    let _ = fcntl_setpipe_size(&end, self.draft.bytes().len().max(PIPE));
                    end
                }
            };
            self.ends.push(end);
        }
        Ok(())
    }

    fn write(&mut self, label: Label) -> Outcome<()> {
        self.draft.write(label);
        Ok(())
    }

    fn send(&mut self) -> Outcome<()> {
        for end in &mut self.ends {
            end.write_all(self.draft.bytes())?;
        }
        Ok(())
    }
}

impl Drop for Streams {
    fn drop(&mut self) {
        let paths: &[String] = match &self.listener {
            Listener::Unix(_, path) => std::slice::from_ref(path),
            Listener::Pipes(paths) => paths,
            Listener::Tcp(_) => &[],
        };
        for path in paths {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// The receiving end of a connection.
pub(crate) struct StreamInlet {
    end: File,
    message: Vec<u8>,
}

impl StreamInlet {
    pub(crate) fn new(task: &Task, number: usize, address: &str) -> Outcome<StreamInlet> {
        let end = match task.way {
            Way::Tcp => File::from(OwnedFd::from(TcpStream::connect(address)?)),
            // Opened for writing too, because a pipe without a writer is at its end.
            Way::Pipe => {
                OpenOptions::new().read(true).write(true).open(Path::new(&pipe(task.place, number)))?
            }
            _ => File::from(OwnedFd::from(UnixStream::connect(listening_path(task.place))?)),
        };
        Ok(StreamInlet { end, message: vec![0; task.payload] })
    }
}

impl Inlet for StreamInlet {
    fn next(&mut self) -> Outcome<Label> {
        self.end.read_exact(&mut self.message)?;
        Label::read(&self.message)
    }
}

/// Returns the path on which a Unix socket listens.
pub(crate) fn listening_path(place: &str) -> String {
    format!("{place}-listening_path")
}

fn pipe(place: &str, number: usize) -> String {
    format!("{place}-pipe-{number}")
}

/// Default size of a pipe.
const PIPE: usize = 1 << 16;
