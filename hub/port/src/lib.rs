//! Ports of links: serial lines of this machine, and lines of serial servers. The other crates of the hub open and use
//! a port only through [`Port`].

mod access;
pub mod clock;
mod port_error;
mod serial_ports;
mod tcp;
mod tty;

use std::io;
use std::net::{SocketAddr, ToSocketAddrs as _};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use rustix::io::Errno;
use scanhub_schema::Failure;

pub use access::{Holder, Ownership, PortPermissions, all_holders, altering_program, holder};
pub use port_error::PortError;
pub use serial_ports::{
    MAX_LATENCY_MS, NoPortReason, PortlessAdapter, SerialPortInfo, check_tty, is_same_line, is_tty,
    latency_ms, serial_ports, serial_ports_in,
};
pub use tcp::{PendingConnection, ReadBudget, Tcp};
pub use tty::{LineErrors, SettingsChange, Tty, UartCounters};

/// Port of a link, as it is written in a configuration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PortSpec {
    /// Serial line of this machine.
    Tty(PathBuf),
    /// Line of a serial server (`tcp:HOST:PORT`). The server must be set to the baud rate of the link.
    Tcp {
        /// Name or address of the server. An IPv6 address has no brackets here.
        host: String,
        /// TCP port of the server, which must be in raw TCP mode.
        port: u16,
    },
    /// Recording (`file:PATH`). It is replayed with its scan period or, with `?rate=max`, as fast as it can be read.
    File {
        /// Path of the recording.
        path: PathBuf,
        /// Whether the replay keeps the scan period.
        paced: bool,
    },
}

impl PortSpec {
    /// Returns the port as it is written in a configuration.
    pub fn name(&self) -> String {
        match self {
            PortSpec::Tty(path) => path.display().to_string(),
            PortSpec::Tcp { host, port } if host.contains(':') => format!("tcp:[{host}]:{port}"),
            PortSpec::Tcp { host, port } => format!("tcp:{host}:{port}"),
            PortSpec::File { path, paced: true } => format!("file:{}", path.display()),
            PortSpec::File { path, paced: false } => format!("file:{}?rate=max", path.display()),
        }
    }

    /// Returns whether `other` names the same port: the same serial line, or the same address of a serial server. If
    /// the port numbers of two servers are equal, their names are resolved, which may take some seconds.
    pub fn is_same_port(&self, other: &PortSpec) -> bool {
        match (self, other) {
            (PortSpec::Tty(a), PortSpec::Tty(b)) => is_same_line(a, b),
            (PortSpec::Tcp { host: a, port: a_port }, PortSpec::Tcp { host: b, port: b_port }) => {
                let addresses = |host: &str| -> Vec<SocketAddr> {
                    (host, *a_port).to_socket_addrs().map_or_else(|_| Vec::new(), Iterator::collect)
                };
                let is_same_host = || {
                    let a = addresses(a);
                    addresses(b).iter().any(|address| a.contains(address))
                };
                a_port == b_port && (a == b || is_same_host())
            }
            _ => self == other,
        }
    }

    /// Parses a port from a configuration.
    ///
    /// # Errors
    ///
    /// Returns a message with the remedy if `text` is not a valid port.
    pub fn parse(text: &str) -> Result<PortSpec, &'static str> {
        if let Some(server) = text.strip_prefix("tcp:") {
            let (host, port) = server.rsplit_once(':').ok_or("tcp: without a port: write tcp:HOST:PORT")?;
            let port = port
                .parse()
                .ok()
                .filter(|&port| port > 0)
                .ok_or("tcp: the port must be a number from 1 to 65535")?;
            let bracketed = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
            return match bracketed.unwrap_or(host) {
                "" => Err("tcp: without a host: write tcp:HOST:PORT"),
                host if bracketed.is_none() && host.contains(':') => {
                    Err("write an IPv6 address in brackets: tcp:[ADDRESS]:PORT")
                }
                host => Ok(PortSpec::Tcp { host: host.to_owned(), port }),
            };
        }
        let Some(file) = text.strip_prefix("file:") else {
            return if text.is_empty() { Err("the port is empty") } else { Ok(PortSpec::Tty(text.into())) };
        };
        let (path, paced) = match file.split_once('?') {
            None => (file, true),
            Some((path, "rate=max")) => (path, false),
            Some(_) => return Err("the only option of a file is rate=max"),
        };
        if path.is_empty() {
            Err("the file has no name")
        } else {
            Ok(PortSpec::File { path: path.into(), paced })
        }
    }
}

/// Open port. Reads and writes never block.
pub enum Port {
    /// Serial line, which is exclusive and raw.
    Tty(Tty),
    /// Connection to a serial server.
    Tcp(Tcp),
}

impl Port {
    /// Opens `spec` at `baud` bits per second. Waits for a serial server for at most some seconds, or until `stop` is
    /// set.
    ///
    /// # Errors
    ///
    /// Returns a failure of one of the kinds for ports, with its remedy. The kind is
    /// [`Kind::ResourceExhausted`](scanhub_schema::Kind::ResourceExhausted) if descriptors run out,
    /// [`Kind::Configuration`](scanhub_schema::Kind::Configuration) for a recording, and
    /// [`Kind::Interrupted`](scanhub_schema::Kind::Interrupted) if `stop` is set.
    pub fn open(spec: &PortSpec, baud: u32, stop: &AtomicBool) -> Result<Port, Failure> {
        Port::try_open(spec, baud, stop).map_err(|error| error.explain(spec))
    }

    /// Opens the port as [`Port::open`] does, for repeated attempts.
    ///
    /// # Errors
    ///
    /// Returns only the reason. [`PortError::explain`] looks up the details.
    pub fn try_open(spec: &PortSpec, baud: u32, stop: &AtomicBool) -> Result<Port, PortError> {
        match spec {
            PortSpec::Tty(path) => Tty::open(path, baud).map(Port::Tty),
            PortSpec::Tcp { host, port } => Tcp::open(host, *port, stop).map(Port::Tcp),
            PortSpec::File { .. } => Err(PortError::Recording),
        }
    }

    /// Creates a port from `line`, which an earlier hub had opened. Returns `None` if `spec` does not name this line,
    /// or the line cannot be configured.
    pub fn adopt(line: OwnedFd, spec: &PortSpec, baud: u32) -> Option<Port> {
        match spec {
            PortSpec::Tty(path) => Tty::adopt(line, path, baud).ok().map(Port::Tty),
            // A connection is not continued: its unread bytes may be old, and the server may have closed it.
            PortSpec::Tcp { .. } | PortSpec::File { .. } => None,
        }
    }

    /// Returns whether `spec` names the open `line`.
    pub fn is_at(line: &OwnedFd, spec: &PortSpec) -> bool {
        matches!(spec, PortSpec::Tty(path) if Tty::is_at(line, path))
    }

    /// Returns whether the line is a pty. If so, another program simulates the scanner.
    pub fn is_simulated(&self) -> bool {
        self.tty().is_some_and(Tty::is_simulated)
    }

    /// Starts to open `spec` if opening it may take time. Returns `None` if [`Port::try_open`] returns at once for
    /// `spec`.
    pub fn connect(spec: &PortSpec) -> Option<Result<PendingConnection, PortError>> {
        match spec {
            PortSpec::Tcp { host, port } => Some(PendingConnection::start(host, *port)),
            _ => None,
        }
    }

    /// Returns the serial line. Returns `None` for a serial server, whose line is at the other end of the network.
    fn tty(&self) -> Option<&Tty> {
        if let Port::Tty(tty) = self { Some(tty) } else { None }
    }

    /// Changes the baud rate, and discards the bytes that arrived at the old one.
    ///
    /// # Errors
    ///
    /// Returns an error of kind `Unsupported` if the driver rejected the rate or set another one, or if the port is a
    /// serial server. Returns other errors if the line is lost.
    pub fn set_baud(&self, baud: u32) -> io::Result<()> {
        match self {
            Port::Tty(tty) => tty.set_baud(baud),
            Port::Tcp(_) => {
                let what = "the rate of a serial server can only be set in the server";
                Err(io::Error::new(io::ErrorKind::Unsupported, what))
            }
        }
    }

    /// Asserts or clears DTR. A port without DTR ignores the call.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub fn set_dtr(&self, on: bool) -> io::Result<()> {
        self.tty().map_or(Ok(()), |tty| tty.set_dtr(on))
    }

    /// Changes the baud rate as [`Port::set_baud`] does, for callers that can try other rates. Returns the error as a
    /// value if this rate is not possible.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub fn try_baud(&self, baud: u32) -> io::Result<Option<io::Error>> {
        match self.set_baud(baud) {
            Err(error) if error.kind() == io::ErrorKind::Unsupported => Ok(Some(error)),
            other => other.map(|()| None),
        }
    }

    /// Discards the received bytes, and sets the baud rate to `baud`. The rate of a serial server does not change.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost, or if the driver rejects the rate.
    pub fn discard_input(&self, baud: u32) -> io::Result<()> {
        match self {
            Port::Tty(tty) => tty.set_baud(baud),
            Port::Tcp(tcp) => tcp.discard_input(),
        }
    }

    /// Returns the number of bytes in the tty's input buffer. Returns `None` for a network port.
    pub fn buffered_bytes(&self) -> Option<usize> {
        self.tty()?.buffered_bytes()
    }

    /// Returns the read budget of a network port at `baud`. Returns `None` for a tty, which is never throttled.
    pub fn read_budget(&self, baud: u32) -> Option<ReadBudget> {
        match self {
            Port::Tty(_) => None,
            Port::Tcp(_) => Some(ReadBudget::new(baud, clock::now())),
        }
    }

    /// Reads the available bytes into `buffer`, and returns their number. The number is 0 if no byte is available.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Port::Tty(tty) => tty.read(buffer),
            Port::Tcp(tcp) => tcp.read(buffer),
        }
    }

    /// Writes `bytes`. If the output buffer is full, drops the remaining bytes. The session then repeats the request.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub fn write(&self, bytes: &[u8]) -> io::Result<()> {
        match self {
            Port::Tty(tty) => tty.write(bytes),
            Port::Tcp(tcp) => tcp.write(bytes),
        }
    }

    /// Returns the number of errors that the driver has counted on the line since the last call. Returns 0, without a
    /// system call, if the driver does not count errors.
    pub fn line_errors(&self) -> u64 {
        self.tty().map_or(0, Tty::line_errors)
    }

    /// Returns the driver's counters since the driver was loaded. Returns `None` if the driver has no counters.
    pub fn uart_counters(&self) -> Option<UartCounters> {
        self.tty()?.uart_counters()
    }

    /// Returns the settings that another process has changed. Returns `None` if they are unchanged, or if the port is a
    /// serial server.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub fn changed_settings(&self) -> io::Result<Option<SettingsChange>> {
        self.tty().map_or(Ok(None), Tty::changed_settings)
    }

    /// Restores the settings of this process, at `baud`, and discards the input that arrived with other settings. If
    /// the driver rejects the rate, the line keeps its present rate, which is not an error: a search then tries other
    /// rates.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub fn restore(&self, baud: u32) -> io::Result<()> {
        self.tty().map_or(Ok(()), |tty| tty.restore(baud))
    }

    /// Returns the device that the port's name resolved to when the port was opened. Returns `None` for a serial
    /// server.
    pub fn device(&self) -> Option<&Path> {
        self.tty().map(Tty::device)
    }

    /// Returns the baud rate that the driver reports. Returns `None` for a serial server.
    pub fn baud(&self) -> Option<u32> {
        self.tty()?.baud()
    }
}

impl AsFd for Port {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            Port::Tty(tty) => tty.as_fd(),
            Port::Tcp(tcp) => tcp.as_fd(),
        }
    }
}

/// Writes `bytes` to `fd`, which is non-blocking. Drops the bytes for which there is no room.
fn write_all(fd: impl AsFd, mut bytes: &[u8]) -> Result<(), Errno> {
    while !bytes.is_empty() {
        match rustix::io::write(&fd, bytes) {
            Ok(0) | Err(Errno::AGAIN) => break,
            Ok(len) => bytes = &bytes[len..],
            Err(Errno::INTR) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::Kind;
    use std::io::Read as _;
    use std::os::unix::net::UnixStream;

    /// Creates a pty. Returns its master and the path of its slave.
    pub(crate) fn pty() -> (OwnedFd, PathBuf) {
        use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("a pty");
        grantpt(&master).and_then(|()| unlockpt(&master)).expect("a slave");
        let name = ptsname(&master, Vec::new()).expect("a name").into_string().expect("ASCII");
        (master, name.into())
    }

    #[test]
    fn writes_only_a_prefix_to_a_full_line() {
        let (line, mut end) = UnixStream::pair().unwrap();
        line.set_nonblocking(true).unwrap();
        let bytes: Vec<u8> = (0..10_000_000_u32).map(|i| (i % 251) as u8).collect();
        write_all(&line, &bytes).unwrap();
        drop(line);
        let mut received = Vec::new();
        end.read_to_end(&mut received).unwrap();
        assert!(!received.is_empty() && received.len() < bytes.len(), "{}", received.len());
        assert!(bytes.starts_with(&received));
    }

    #[test]
    fn recognizes_a_port_under_another_name() {
        let directory = tempfile::tempdir().unwrap();
        let link = directory.path().join("lidar");
        std::os::unix::fs::symlink("/dev/null", &link).unwrap();
        let is_same = |a: &str, b: &str| {
            let [a, b] = [a, b].map(|text| PortSpec::parse(text).unwrap());
            assert_eq!(a.is_same_port(&b), b.is_same_port(&a));
            a.is_same_port(&b)
        };
        let link = link.to_str().unwrap();
        assert!(is_same(link, "/dev/null") && is_same("/dev/../dev/null", link));
        assert!(!is_same(link, "/dev/zero") && !is_same("/dev/no-such-port", "/dev/another"));
        assert!(is_same("/dev/no-such-port", "/dev/no-such-port"));
        assert!(is_same("tcp:127.0.0.1:4001", "tcp:127.1:4001"), "two forms of one address");
        assert!(is_same("tcp:localhost:4001", "tcp:localhost:4001"));
        assert!(!is_same("tcp:127.0.0.1:4001", "tcp:127.0.0.1:4002"));
        assert!(!is_same("tcp:127.0.0.1:4001", "tcp:127.0.0.2:4001"));
        assert!(!is_same("/dev/null", "file:/dev/null"));
    }

    static NEVER: AtomicBool = AtomicBool::new(false);

    fn refused(text: &str) -> Failure {
        let source = PortSpec::parse(text).unwrap();
        Port::open(&source, 500_000, &NEVER).err().expect("cannot be opened")
    }

    #[test]
    fn rate_change_of_a_network_port_is_rejected() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let source = PortSpec::parse(&format!("tcp:{}", listener.local_addr().unwrap())).unwrap();
        let port = Port::open(&source, 9600, &NEVER).unwrap();
        assert!(port.try_baud(38_400).unwrap().is_some());
    }

    #[test]
    fn unusable_ports_have_distinct_error_kinds() {
        assert_eq!(refused("/dev/no-such-port").kind, Kind::PortMissing);
        assert_eq!(refused("/dev/null").kind, Kind::PortNotTty);
        assert_eq!(refused("/etc/hostname").kind, Kind::PortNotTty);
        assert_eq!(refused("/").kind, Kind::PortNotTty);
        assert_eq!(refused("file:/etc/hostname").kind, Kind::Configuration);
    }
}
