//! The port: a TCP server that hands bytes on as they are, as a serial server in raw mode does. One host at a time: another
//! one that connects meanwhile is turned away. Knows nothing about telegrams.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd};

use schema::{Failure, Kind};

/// A server, and who is connected.
#[derive(Debug)]
pub(crate) struct Server {
    listener: TcpListener,
    address: SocketAddr,
    host: Option<TcpStream>,
}

impl Server {
    /// One that listens at `address`, `HOST:PORT`; port 0 is any that is free.
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

    /// Where it listens.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Whether a host is connected. Lets one in, and turns others away.
    pub(crate) fn is_open(&mut self) -> bool {
        while let Ok((stream, _)) = self.listener.accept() {
            let is_set = stream.set_nonblocking(true).and_then(|()| stream.set_nodelay(true));
            if self.host.is_none() && is_set.is_ok() {
                self.host = Some(stream);
            }
        }
        self.host.is_some()
    }

    /// Reads what the host has written; `0` if nothing.
    pub(crate) fn read(&mut self, buffer: &mut [u8]) -> usize {
        let Some(host) = &mut self.host else { return 0 };
        match host.read(buffer) {
            Ok(count) if count > 0 => count,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => 0,
            // The end, or a connection that broke.
            _ => {
                self.host = None;
                0
            }
        }
    }

    /// Gives `bytes` to the host; returns how many of them its buffer had room for.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> usize {
        let Some(host) = &mut self.host else { return 0 };
        let mut rest = bytes;
        while !rest.is_empty() {
            match host.write(rest) {
                Ok(count) if count > 0 => rest = &rest[count..],
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                // A connection that broke is noticed by the next read.
                _ => break,
            }
        }
        bytes.len() - rest.len()
    }

    /// What to wait for: bytes of the host, else a host.
    pub(crate) fn waits_for(&self) -> BorrowedFd<'_> {
        match &self.host {
            Some(host) => host.as_fd(),
            None => self.listener.as_fd(),
        }
    }
}
