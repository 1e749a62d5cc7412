//! The port that a host opens to reach a simulated scanner: a pty with a name, or a TCP server that passes bytes on as
//! a serial server in raw mode does. A port that is dropped disappears like an adapter that was unplugged.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd};
use std::path::{Path, PathBuf};

use schema::{Failure, Kind};

use crate::pty::{Pty, PtySymlink};

/// The host's end of a line.
pub(crate) enum Socket {
    /// The symlink is dropped before the pty.
    Pty {
        _symlink: PtySymlink,
        pty: Pty,
    },
    Tcp(Server),
}

impl Socket {
    /// Creates a port: a server for `tcp:HOST:PORT`, or else a pty with a symlink at the path `port`.
    pub(crate) fn new(port: &Path) -> Result<Socket, Failure> {
        if let Some(address) = server(port) {
            return Server::open(address).map(Socket::Tcp);
        }
        let pty = Pty::open()?;
        Ok(Socket::Pty { _symlink: PtySymlink::new(port, pty.name())?, pty })
    }

    /// Returns the name under which a host finds the port that was requested as `port`.
    pub(crate) fn found(&self, port: &Path) -> PathBuf {
        match self {
            Socket::Pty { .. } => port.to_owned(),
            Socket::Tcp(server) => format!("tcp:{}", server.address()).into(),
        }
    }

    /// Returns the path of the pty, or `None` for a server.
    pub(crate) fn pty(&self) -> Option<&Path> {
        match self {
            Socket::Pty { pty, .. } => Some(pty.name()),
            Socket::Tcp(_) => None,
        }
    }

    /// Returns whether a host has the port open. After a host has closed a pty, its unread bytes are discarded.
    pub(crate) fn is_open(&mut self, was_open: bool) -> bool {
        match self {
            Socket::Pty { pty, .. } => {
                let is_open = pty.is_open();
                if was_open && !is_open {
                    pty.clean_up_after_close();
                }
                is_open
            }
            Socket::Tcp(server) => server.is_open(),
        }
    }

    /// Returns the rate of the host's port in bits per second, or `None` for a server, which has the rate of the
    /// scanner.
    pub(crate) fn rate(&self) -> Option<u32> {
        match self {
            Socket::Pty { pty, .. } => Some(pty.rate()),
            Socket::Tcp(_) => None,
        }
    }

    /// Reads bytes that the host has written. Returns 0 if there are none.
    pub(crate) fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Failure> {
        match self {
            Socket::Pty { pty, .. } => pty.read(buffer),
            Socket::Tcp(server) => Ok(server.read(buffer)),
        }
    }

    /// Sends `bytes` to the host. Returns the number of bytes that fit into its buffer.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> Result<usize, Failure> {
        match self {
            Socket::Pty { pty, .. } => pty.write(bytes),
            Socket::Tcp(server) => Ok(server.write(bytes)),
        }
    }

    /// Returns the descriptor to wait for. A pty that no host has open is not waited for, because it would be ready all
    /// the time.
    pub(crate) fn waits_for(&self, is_open: bool) -> Option<BorrowedFd<'_>> {
        match self {
            Socket::Pty { pty, .. } => is_open.then(|| pty.waits_for()),
            Socket::Tcp(server) => Some(server.waits_for()),
        }
    }
}

/// Returns the address in `tcp:HOST:PORT`, or `None` if `port` is a path.
pub(crate) fn server(port: &Path) -> Option<&str> {
    port.to_str()?.strip_prefix("tcp:")
}

/// A TCP server and its host. It accepts one host at a time, and closes the connections of others.
#[derive(Debug)]
pub(crate) struct Server {
    listener: TcpListener,
    address: SocketAddr,
    host: Option<TcpStream>,
}

impl Server {
    /// Creates a server that listens at `address`, `HOST:PORT`. Port 0 selects a free port.
    pub(crate) fn open(address: &str) -> Result<Server, Failure> {
        let open = || {
            let listener = TcpListener::bind(address)?;
            listener.set_nonblocking(true)?;
            let address = listener.local_addr()?;
            Ok(Server { listener, address, host: None })
        };
        open().map_err(|error: std::io::Error| {
            let (kind, hint) = match error.kind() {
                ErrorKind::AddrInUse => (Kind::PortBusy, "name another port; 0 is any that is free"),
                ErrorKind::PermissionDenied => (Kind::PortPermission, "ports from 1024 on are for everybody"),
                ErrorKind::InvalidInput => (Kind::Configuration, "write HOST:PORT, such as 127.0.0.1:0"),
                _ => (Kind::PortMissing, "name an address of this machine, such as 127.0.0.1:0"),
            };
            Failure::new(kind, format!("cannot listen at {address}: {error}"), hint)
        })
    }

    /// Returns the address at which the server listens.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Returns whether a host is connected. Accepts one host, and closes the connections of others.
    pub(crate) fn is_open(&mut self) -> bool {
        while let Ok((stream, _)) = self.listener.accept() {
            let is_set = stream.set_nonblocking(true).and_then(|()| stream.set_nodelay(true));
            if self.host.is_none() && is_set.is_ok() {
                self.host = Some(stream);
            }
        }
        self.host.is_some()
    }

    /// Reads bytes that the host has written. Returns 0 if there are none.
    pub(crate) fn read(&mut self, buffer: &mut [u8]) -> usize {
        let Some(host) = &mut self.host else { return 0 };
        match host.read(buffer) {
            Ok(count) if count > 0 => count,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => 0,
            // The host closed the connection, or the connection failed.
            _ => {
                self.host = None;
                0
            }
        }
    }

    /// Sends `bytes` to the host. Returns the number of bytes that fit into its buffer.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> usize {
        let Some(host) = &mut self.host else { return 0 };
        let mut rest = bytes;
        while !rest.is_empty() {
            match host.write(rest) {
                Ok(count) if count > 0 => rest = &rest[count..],
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                // The next read detects a connection that failed.
                _ => break,
            }
        }
        bytes.len() - rest.len()
    }

    /// Returns the descriptor to wait for: that of the connection, or else that of the listener.
    pub(crate) fn waits_for(&self) -> BorrowedFd<'_> {
        match &self.host {
            Some(host) => host.as_fd(),
            None => self.listener.as_fd(),
        }
    }
}
