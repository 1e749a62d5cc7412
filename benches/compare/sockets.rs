//! The mechanisms that users could choose instead of topics: UDP multicast, Unix sockets, TCP and pipes.

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

use super::message::{Label, MIN_MESSAGE_LEN, Mechanism, MessageBuffer};
use super::process::{MessageReceiver, MessageSender, RunParameters};
use crate::support::Outcome;

/// Sending sockets for datagrams. For UDP multicast on the loopback, one socket sends to the group. For Unix datagrams,
/// each receiver has its own socket. The sender splits a message that is longer than a datagram, and the receiver
/// reassembles it, as a user's program would do. If one of the datagrams is lost, the message is lost.
pub(crate) struct DatagramSender {
    group: Option<Ipv4Addr>,
    paths: Vec<String>,
    sockets: Vec<OwnedFd>,
    buffer: MessageBuffer,
    /// Number of bytes of a message that one datagram contains.
    part_len: usize,
}

impl DatagramSender {
    pub(crate) fn new(task: &RunParameters) -> Outcome<DatagramSender> {
        let [_, _, high, low] = std::process::id().to_be_bytes();
        let group = (task.mechanism == Mechanism::Multicast).then(|| Ipv4Addr::new(239, 83, high, low));
        let receivers = if group.is_some() { 0 } else { task.receivers };
        let paths = (0..receivers).map(|number| socket_path(task.path_prefix, number)).collect();
        let (buffer, part_len) = (MessageBuffer::new(task.payload), max_part_len(task));
        Ok(DatagramSender { group, paths, sockets: Vec::new(), buffer, part_len })
    }
}

impl MessageSender for DatagramSender {
    fn address(&self) -> Outcome<String> {
        Ok(self.group.map_or("-".into(), |group| group.to_string()))
    }

    fn open(&mut self) -> Outcome<()> {
        if let Some(group) = self.group {
            let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
            set_ip_multicast_if(&socket, &Ipv4Addr::LOCALHOST)?;
            socket.set_multicast_ttl_v4(0)?;
            socket.connect((group, GROUP_PORT))?;
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
        self.buffer.write(label);
        Ok(())
    }

    fn send(&mut self) -> Outcome<()> {
        self.sockets.iter().try_for_each(|socket| send(socket, self.buffer.bytes(), self.part_len))
    }

    fn end(&mut self, label: Label) -> Outcome<()> {
        let message = self.buffer.write_short(label);
        for socket in &self.sockets {
            rustix::io::write(socket, message)?;
        }
        Ok(())
    }
}

impl Drop for DatagramSender {
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
    let number = &message[..NUMBER_LEN];
    for (index, bytes) in message.chunks(part).enumerate() {
        let index = (index as u64).to_le_bytes();
        let slices = [number, &index, bytes].map(IoSlice::new);
        sendmsg(socket, &slices, &mut SendAncillaryBuffer::default(), SendFlags::empty())?;
    }
    Ok(())
}

/// A receiving socket for datagrams.
pub(crate) struct DatagramReceiver {
    socket: OwnedFd,
    message: Vec<u8>,
    len: usize,
    part_len: usize,
    /// Number of parts of the current message that have arrived.
    received_parts: usize,
}

impl DatagramReceiver {
    pub(crate) fn new(task: &RunParameters, number: usize, address: &str) -> Outcome<DatagramReceiver> {
        let socket = match task.mechanism {
            Mechanism::Multicast => group_socket(address.parse()?)?,
            _ => UnixDatagram::bind(socket_path(task.path_prefix, number))?.into(),
        };
        let (len, part_len) = (task.payload, max_part_len(task));
        // Make room for a longer part after the message. The part of another message may arrive in place of the last
        // part, and may be longer than the last part.
        Ok(DatagramReceiver { socket, message: vec![0; len + part_len], len, part_len, received_parts: 0 })
    }

    /// Receives the next part, and writes it after the parts that have arrived. If this part completes the message,
    /// returns the label of the message.
    fn take_part(&mut self) -> Outcome<Option<Label>> {
        let place = self.received_parts * self.part_len;
        let (mut number, mut index) = ([0; NUMBER_LEN], [0; NUMBER_LEN]);
        let body = &mut self.message[place..][..self.part_len];
        let mut slices = [&mut number[..], &mut index[..], body].map(IoSliceMut::new);
        let mut control = RecvAncillaryBuffer::default();
        let len = recvmsg(&self.socket, &mut slices, &mut control, RecvFlags::empty())?.bytes;
        if len == MIN_MESSAGE_LEN {
            let tail = &self.message[place..][..NUMBER_LEN];
            return Ok(Some(Label::read(&[&number, &index, tail].concat())?));
        }
        let index = u64::from_le_bytes(index) as usize;
        if index == 0 {
            self.message.copy_within(place..place + self.part_len, 0);
        } else if index != self.received_parts || self.message[..NUMBER_LEN] != number {
            // A part is missing, so the message whose other parts have arrived will never be complete.
            self.received_parts = 0;
            return Ok(None);
        }
        self.received_parts = index + 1;
        if self.received_parts < self.len.div_ceil(self.part_len) {
            return Ok(None);
        }
        self.received_parts = 0;
        Ok(Some(Label::read(&self.message[..self.len])?))
    }
}

impl MessageReceiver for DatagramReceiver {
    fn next(&mut self) -> Outcome<Label> {
        if self.len <= self.part_len {
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
    bind(&socket, &SocketAddrV4::new(group, GROUP_PORT))?;
    if set_socket_recv_buffer_size_force(&socket, RECEIVE_BUFFER_LEN).is_err() {
        set_socket_recv_buffer_size(&socket, RECEIVE_BUFFER_LEN)?;
    }
    let socket = UdpSocket::from(socket);
    socket.join_multicast_v4(&group, &Ipv4Addr::LOCALHOST)?;
    Ok(socket.into())
}

/// Returns the maximum number of a message's bytes in one datagram.
fn max_part_len(task: &RunParameters) -> usize {
    match task.mechanism {
        Mechanism::Multicast if task.payload > MAX_UDP_LEN => MAX_UDP_LEN - 2 * NUMBER_LEN,
        Mechanism::Multicast => MAX_UDP_LEN,
        _ => MAX_UNIX_LEN,
    }
}

fn socket_path(path_prefix: &str, number: usize) -> String {
    format!("{path_prefix}-mailbox-{number}")
}

/// Length of each of the two numbers at the start of a part. These are the number of the message and the index of the
/// part.
const NUMBER_LEN: usize = size_of::<u64>();
/// Maximum length of a UDP datagram.
const MAX_UDP_LEN: usize = 65_507;
/// Maximum length of a Unix datagram that fits into the system's send buffer with the kernel's overhead.
const MAX_UNIX_LEN: usize = 65_536;
/// Receive buffer of a member of the group, in bytes.
const RECEIVE_BUFFER_LEN: usize = 4 << 20;
/// UDP port of all groups. Each run has its own group.
const GROUP_PORT: u16 = 29_183;

/// The sending ends of Unix stream sockets, TCP or pipes. Each receiver has its own connection, and each message is one
/// write per connection. All messages have the same length, so a receiver reads exactly one message at a time, if
/// possible with one call of `read`.
pub(crate) struct StreamSender {
    listener: Listener,
    receivers: usize,
    ends: Vec<File>,
    buffer: MessageBuffer,
}

/// A listening socket or a pipe's paths, through which receivers connect.
enum Listener {
    Unix(UnixListener, String),
    Tcp(TcpListener),
    Pipes(Vec<String>),
}

impl StreamSender {
    pub(crate) fn new(task: &RunParameters) -> Outcome<StreamSender> {
        let listener = match task.mechanism {
            Mechanism::Tcp => Listener::Tcp(TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?),
            Mechanism::Pipe => {
                let paths: Vec<_> =
                    (0..task.receivers).map(|number| pipe_path(task.path_prefix, number)).collect();
                for path in &paths {
                    mknodat(CWD, path.as_str(), FileType::Fifo, Mode::RUSR | Mode::WUSR, 0)?;
                }
                Listener::Pipes(paths)
            }
            _ => {
                let path = listening_path(task.path_prefix);
                Listener::Unix(UnixListener::bind(&path)?, path)
            }
        };
        Ok(StreamSender {
            listener,
            receivers: task.receivers,
            ends: Vec::new(),
            buffer: MessageBuffer::new(task.payload),
        })
    }
}

impl MessageSender for StreamSender {
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
                    // Make the pipe as large as a message. If the system does not permit this size, the pipe keeps its
                    // old size.
                    let _ = fcntl_setpipe_size(&end, self.buffer.bytes().len().max(PIPE_LEN));
                    end
                }
            };
            self.ends.push(end);
        }
        Ok(())
    }

    fn write(&mut self, label: Label) -> Outcome<()> {
        self.buffer.write(label);
        Ok(())
    }

    fn send(&mut self) -> Outcome<()> {
        for end in &mut self.ends {
            end.write_all(self.buffer.bytes())?;
        }
        Ok(())
    }
}

impl Drop for StreamSender {
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
pub(crate) struct StreamReceiver {
    end: File,
    message: Vec<u8>,
}

impl StreamReceiver {
    pub(crate) fn new(task: &RunParameters, number: usize, address: &str) -> Outcome<StreamReceiver> {
        let end = match task.mechanism {
            Mechanism::Tcp => File::from(OwnedFd::from(TcpStream::connect(address)?)),
            // Open the pipe for writing, too, because a pipe without a writer is at its end.
            Mechanism::Pipe => OpenOptions::new()
                .read(true)
                .write(true)
                .open(Path::new(&pipe_path(task.path_prefix, number)))?,
            _ => File::from(OwnedFd::from(UnixStream::connect(listening_path(task.path_prefix))?)),
        };
        Ok(StreamReceiver { end, message: vec![0; task.payload] })
    }
}

impl MessageReceiver for StreamReceiver {
    fn next(&mut self) -> Outcome<Label> {
        self.end.read_exact(&mut self.message)?;
        Label::read(&self.message)
    }
}

/// Returns the path on which a Unix socket listens.
pub(crate) fn listening_path(path_prefix: &str) -> String {
    format!("{path_prefix}-listening_path")
}

fn pipe_path(path_prefix: &str, number: usize) -> String {
    format!("{path_prefix}-pipe-{number}")
}

/// Minimum size of a pipe, which is the default size of the system.
const PIPE_LEN: usize = 1 << 16;
