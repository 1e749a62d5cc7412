//! What a host opens to reach a simulated sensor: a pty with a name, or a TCP server. Dropped, it is gone as an adapter is
//! that was pulled out. Knows nothing about telegrams.

use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};

use schema::Failure;

use crate::place::Place;
use crate::pty::Pty;
use crate::server::Server;

/// The host's end of a line.
pub(crate) enum Socket {
    /// First the name goes, then the terminal.
    Pty {
        _place: Place,
        pty: Pty,
    },
    Tcp(Server),
}

impl Socket {
    /// What `port` says: `tcp:HOST:PORT`, else the path that leads to a new pty.
    pub(crate) fn new(port: &Path) -> Result<Socket, Failure> {
        if let Some(address) = server(port) {
            return Server::open(address).map(Socket::Tcp);
        }
        let pty = Pty::open()?;
        Ok(Socket::Pty { _place: Place::new(port, pty.name())?, pty })
    }

    /// The name under which it is found, where `port` was asked for.
    pub(crate) fn found(&self, port: &Path) -> PathBuf {
        match self {
            Socket::Pty { .. } => port.to_owned(),
            Socket::Tcp(server) => format!("tcp:{}", server.address()).into(),
        }
    }

    /// The pty, if it is one.
    pub(crate) fn pty(&self) -> Option<&Path> {
        match self {
            Socket::Pty { pty, .. } => Some(pty.name()),
            Socket::Tcp(_) => None,
        }
    }

    /// Whether a host is there; what nobody read is gone when one left.
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

    /// What the rate of the host's port is set to, in bits per second; nothing where the other end of a serial server has
    /// the sensor's.
    pub(crate) fn rate(&self) -> Option<u32> {
        match self {
            Socket::Pty { pty, .. } => Some(pty.rate()),
            Socket::Tcp(_) => None,
        }
    }

    /// Reads what the host has written; `0` if nothing.
    pub(crate) fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Failure> {
        match self {
            Socket::Pty { pty, .. } => pty.read(buffer),
            Socket::Tcp(server) => Ok(server.read(buffer)),
        }
    }

    /// Gives `bytes` to the host; returns how many of them its buffer had room for.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> Result<usize, Failure> {
        match self {
            Socket::Pty { pty, .. } => pty.write(bytes),
            Socket::Tcp(server) => Ok(server.write(bytes)),
        }
    }

    /// What to wait for. A pty whose host `is_open` not must not be waited for: it would say so all the time.
    pub(crate) fn waits_for(&self, is_open: bool) -> Option<BorrowedFd<'_>> {
        match self {
            Socket::Pty { pty, .. } => is_open.then(|| pty.waits_for()),
            Socket::Tcp(server) => Some(server.waits_for()),
        }
    }
}

/// The address in `tcp:HOST:PORT`, if `port` is one.
pub(crate) fn server(port: &Path) -> Option<&str> {
    port.to_str()?.strip_prefix("tcp:")
}
