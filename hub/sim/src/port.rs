//! The port that a host opens to reach a simulated scanner: a pty with a symlink as its name, or a TCP server that
//! passes on bytes like a serial server in raw mode. When a port is dropped, it disappears for the host, as if an
//! adapter was unplugged. This file also reads the kernel's clock, which no other file of this crate does.
//!
//! A pty differs from a serial line in three ways:
//!
//! - It keeps bytes that no host reads. The simulator writes nothing while the host's side is closed, and discards
//!   unread bytes when it closes.
//! - Its exclusive mode survives the last close, so the simulator clears it.
//! - Before the first open, it does not report that it is closed, so the simulator opens and closes it once.

use std::ffi::OsStr;
use std::fs::{self, Metadata};
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, fcntl_setfl, open};
use rustix::io::{self, Errno};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, QueueSelector, ioctl_tiocnxcl, tcflush, tcgetattr, tcsetattr};
use rustix::time::{ClockId, clock_gettime};
use scanhub_schema::{Failure, Kind, Nanos};

/// The host's end of a line.
pub(crate) enum SimPort {
    /// A pty and its symlink. The symlink is dropped before the pty.
    Pty {
        _symlink: PtySymlink,
        pty: Pty,
    },
    Tcp(Server),
}

impl SimPort {
    /// Creates a port: a server for `tcp:HOST:PORT`, and otherwise a pty with a symlink at the path `port`.
    pub(crate) fn new(port: &Path) -> Result<SimPort, Failure> {
        if let Some(address) = server(port) {
            return Server::open(address).map(SimPort::Tcp);
        }
        let pty = Pty::open()?;
        Ok(SimPort::Pty { _symlink: PtySymlink::new(port, pty.name())?, pty })
    }

    /// Returns the name under which a host finds the port that [`SimPort::new`] created for `port`. It differs from
    /// `port` if a server has selected a free TCP port.
    pub(crate) fn found(&self, port: &Path) -> PathBuf {
        match self {
            SimPort::Pty { .. } => port.to_owned(),
            SimPort::Tcp(server) => format!("tcp:{}", server.address()).into(),
        }
    }

    /// Returns the path of the pty, or `None` for a server.
    pub(crate) fn pty(&self) -> Option<&Path> {
        match self {
            SimPort::Pty { pty, .. } => Some(pty.name()),
            SimPort::Tcp(_) => None,
        }
    }

    /// Returns whether a host has the port open. `was_open` is the result of the last call. If a host has closed a pty
    /// since then, the bytes that the host did not read are discarded.
    pub(crate) fn is_open(&mut self, was_open: bool) -> bool {
        match self {
            SimPort::Pty { pty, .. } => {
                let is_open = pty.is_open();
                if was_open && !is_open {
                    pty.clean_up_after_close();
                }
                is_open
            }
            SimPort::Tcp(server) => server.is_open(),
        }
    }

    /// Returns the rate of the host's port in bits per second, or `None` for a server, which has the rate of the
    /// scanner.
    pub(crate) fn rate(&self) -> Option<u32> {
        match self {
            SimPort::Pty { pty, .. } => Some(pty.rate()),
            SimPort::Tcp(_) => None,
        }
    }

    /// Reads bytes that the host has written. Returns 0 if there are none.
    pub(crate) fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Failure> {
        match self {
            SimPort::Pty { pty, .. } => pty.read(buffer),
            SimPort::Tcp(server) => Ok(server.read(buffer)),
        }
    }

    /// Sends `bytes` to the host. Returns the number of bytes that fit into its buffer.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> Result<usize, Failure> {
        match self {
            SimPort::Pty { pty, .. } => pty.write(bytes),
            SimPort::Tcp(server) => Ok(server.write(bytes)),
        }
    }

    /// Returns the descriptor to wait for. Returns `None` for a pty that no host has open, because its descriptor would
    /// be ready all the time.
    pub(crate) fn wait_fd(&self, is_open: bool) -> Option<BorrowedFd<'_>> {
        match self {
            SimPort::Pty { pty, .. } => is_open.then(|| pty.wait_fd()),
            SimPort::Tcp(server) => Some(server.wait_fd()),
        }
    }
}

/// Returns the address in `tcp:HOST:PORT`, or `None` if `port` is a path.
pub(crate) fn server(port: &Path) -> Option<&str> {
    port.to_str()?.strip_prefix("tcp:")
}

/// A TCP server, and the connection of a host. The server accepts one host at a time, and closes other connections.
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
                ErrorKind::AddrInUse => (Kind::PortBusy, "name another port, or 0 for any free port"),
                ErrorKind::PermissionDenied => {
                    (Kind::PortPermission, "name a port from 1024 on, which needs no privileges")
                }
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

    /// Returns whether a host is connected. Accepts a host if none is connected, and closes other connections.
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

    /// Returns the descriptor to wait for. It is the descriptor of the connection, or the descriptor of the listening
    /// socket while no host is connected.
    pub(crate) fn wait_fd(&self) -> BorrowedFd<'_> {
        match &self.host {
            Some(host) => host.as_fd(),
            None => self.listener.as_fd(),
        }
    }
}

/// Returns CLOCK_MONOTONIC in nanoseconds.
pub fn now_ns() -> Nanos {
    #[expect(clippy::disallowed_methods, reason = "a simulator at a port runs in real time")]
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// A pty. A host opens its other side.
#[derive(Debug)]
pub struct Pty {
    master: OwnedFd,
    name: PathBuf,
}

/// Reason why a wait ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum WaitResult {
    /// The deadline has passed, bytes have arrived, or the host has closed its side.
    Line,
    /// A stop descriptor is readable.
    Stop,
}

impl Pty {
    /// Creates a pty in raw mode. The host's side is closed.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if a pty cannot be created.
    pub fn open() -> Result<Pty, Failure> {
        let make = || -> io::Result<Pty> {
            let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
            grantpt(&master)?;
            unlockpt(&master)?;
            let name = ptsname(&master, Vec::new())?;
            fcntl_setfl(&master, OFlags::RDWR | OFlags::NONBLOCK)?;
            let pty = Pty { master, name: OsStr::from_bytes(name.as_bytes()).into() };
            let slave = pty.open_slave()?;
            // Otherwise the pty would echo the bytes of the scanner until the host has set its own mode.
            let mut termios = tcgetattr(&slave)?;
            termios.make_raw();
            tcsetattr(&slave, OptionalActions::Now, &termios)?;
            Ok(pty)
        };
        make().map_err(|errno| {
            Failure::new(
                Kind::ResourceExhausted,
                format!("cannot create a pty: {errno}"),
                "compare /proc/sys/kernel/pty/nr with /proc/sys/kernel/pty/max",
            )
        })
    }

    /// Returns the path of the host's side, such as `/dev/pts/4`.
    pub fn name(&self) -> &Path {
        &self.name
    }

    /// Returns whether a host has its side of the pty open.
    pub fn is_open(&self) -> bool {
        let mut fds = [PollFd::new(&self.master, PollFlags::IN)];
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        poll(&mut fds, Some(&now)).is_ok() && !fds[0].revents().contains(PollFlags::HUP)
    }

    /// Returns the rate of the host's port in bits per second.
    pub fn rate(&self) -> u32 {
        tcgetattr(&self.master).map_or(0, |termios| termios.output_speed())
    }

    /// Reads bytes that the host has written. Returns 0 if there are none.
    pub fn read(&self, buffer: &mut [u8]) -> Result<usize, Failure> {
        match io::read(&self.master, buffer) {
            Ok(count) => Ok(count),
            // EIO: the host's side is closed and everything was read.
            Err(Errno::AGAIN | Errno::IO | Errno::INTR) => Ok(0),
            Err(errno) => Err(pty_failure("read from", &self.name, errno)),
        }
    }

    /// Sends `bytes` to the host. Returns the number of bytes that fit into its buffer.
    pub fn write(&self, bytes: &[u8]) -> Result<usize, Failure> {
        let mut rest = bytes;
        while !rest.is_empty() {
            match io::write(&self.master, rest) {
                Ok(count) => rest = &rest[count..],
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN | Errno::IO) => break,
                Err(errno) => return Err(pty_failure("write to", &self.name, errno)),
            }
        }
        Ok(bytes.len() - rest.len())
    }

    /// Returns the descriptor that becomes readable when a host has written, and writable when it has read.
    pub fn wait_fd(&self) -> BorrowedFd<'_> {
        self.master.as_fd()
    }

    /// Discards unread bytes after the host's side was closed, and lets users other than root open it again.
    fn clean_up_after_close(&self) {
        // If another host has opened the pty exclusively in the meantime, there is nothing to clean up.
        if let Ok(slave) = self.open_slave() {
            let _ = tcflush(&slave, QueueSelector::IFlush);
            let _ = ioctl_tiocnxcl(&slave);
        }
    }

    fn open_slave(&self) -> io::Result<OwnedFd> {
        open(&self.name, OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC, Mode::empty())
    }
}

/// Waits until `line` has bytes, until the time `deadline_ns`, or until one of the descriptors `stops` is readable.
pub(crate) fn wait(
    stops: [BorrowedFd<'_>; 2],
    line: Option<BorrowedFd<'_>>,
    deadline_ns: Nanos,
) -> WaitResult {
    let left = deadline_ns.saturating_sub(now_ns());
    let timeout = Timespec { tv_sec: (left / 1_000_000_000) as _, tv_nsec: (left % 1_000_000_000) as _ };
    let mut fds =
        [stops[0], stops[1], line.unwrap_or(stops[0])].map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN));
    // An interrupted wait only ends early.
    let _ = poll(&mut fds, Some(&timeout));
    if fds[..2].iter().any(|fd| !fd.revents().is_empty()) { WaitResult::Stop } else { WaitResult::Line }
}

fn pty_failure(what: &str, name: &Path, errno: Errno) -> Failure {
    Failure::new(Kind::Failed, format!("cannot {what} the pty {}: {errno}", name.display()), "")
}

/// A symlink at a path that the user names. Its target is a pty, whose number is unknown before the pty exists. The
/// symlink is removed on drop.
#[derive(Debug)]
pub(crate) struct PtySymlink {
    path: PathBuf,
    target: PathBuf,
}

impl PtySymlink {
    /// Creates a symlink at `path` to `target`. Replaces a symlink that a killed simulator left: its target does not
    /// exist, or is a terminal that is younger than the symlink. Anything else at `path` remains.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::PortBusy`] if another simulator uses `path`, [`Kind::PortNotTty`] if something else exists
    /// there, and [`Kind::PortMissing`], [`Kind::PortPermission`] or [`Kind::Failed`] if the symlink cannot be created.
    pub(crate) fn new(path: &Path, target: &Path) -> Result<PtySymlink, Failure> {
        match fs::symlink_metadata(path) {
            Ok(metadata) if metadata.is_symlink() && is_stale(path) => {
                fs::remove_file(path).map_err(|error| failure(path, &error))?;
            }
            Ok(metadata) if metadata.is_symlink() && is_terminal(path) => {
                return Err(Failure::new(
                    Kind::PortBusy,
                    format!("port {} belongs to another simulator, which still runs", path.display()),
                    "name another path, or stop the other simulator first",
                ));
            }
            Ok(metadata) => {
                let kind = if metadata.is_symlink() { "a symlink to something else" } else { "no symlink" };
                return Err(Failure::new(
                    Kind::PortNotTty,
                    format!("port {} exists and is {kind}", path.display()),
                    "name an unused path, or remove the existing file",
                ));
            }
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => return Err(failure(path, &error)),
        }
        std::os::unix::fs::symlink(target, path).map_err(|error| failure(path, &error))?;
        Ok(PtySymlink { path: path.to_owned(), target: target.to_owned() })
    }
}

impl Drop for PtySymlink {
    fn drop(&mut self) {
        // Another simulator may have replaced the symlink in the meantime.
        if fs::read_link(&self.path).is_ok_and(|target| target == self.target) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Returns whether a killed simulator left the symlink at `path`. If the terminal is older than the symlink, it still
/// belongs to the simulator that created the symlink. If the terminal is younger, the kernel has created it later with
/// the number of a terminal that no longer exists.
fn is_stale(path: &Path) -> bool {
    let (Ok(terminal), Ok(link)) = (fs::metadata(path), fs::symlink_metadata(path)) else { return true };
    let since = |metadata: &Metadata| (metadata.ctime(), metadata.ctime_nsec());
    is_terminal(path) && since(&terminal) > since(&link)
}

fn is_terminal(path: &Path) -> bool {
    fs::read_link(path).is_ok_and(|target| target.starts_with("/dev/pts"))
}

fn failure(path: &Path, error: &std::io::Error) -> Failure {
    let (kind, hint) = match error.kind() {
        ErrorKind::NotFound => (Kind::PortMissing, "create its directory first, or name another path"),
        ErrorKind::PermissionDenied => {
            (Kind::PortPermission, "name a path in a directory that this user may write to")
        }
        _ => (Kind::Failed, ""),
    };
    Failure::new(kind, format!("cannot create the symlink {}: {error}", path.display()), hint)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replaces_only_symlinks_of_killed_simulators() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("port");
        let link = || fs::read_link(&path).unwrap();

        drop(PtySymlink::new(&path, Path::new("/dev/pts/ptmx")).unwrap());
        assert!(fs::symlink_metadata(&path).is_err(), "not removed at the end");

        std::os::unix::fs::symlink("/nonexistent/tty", &path).unwrap();
        let place = PtySymlink::new(&path, Path::new("/dev/pts/999998")).unwrap();
        let second = PtySymlink::new(&path, Path::new("/dev/pts/999999")).unwrap();
        drop(place);
        assert_eq!(link(), Path::new("/dev/pts/999999"), "the second one's was removed");
        drop(second);

        let [one, other] = [(); 2].map(|()| Pty::open().unwrap());
        let place = PtySymlink::new(&path, one.name()).unwrap();
        assert_eq!(PtySymlink::new(&path, other.name()).unwrap_err().kind, Kind::PortBusy);
        assert_eq!(link(), one.name(), "it was taken away from who has it");
        drop(place);

        // The simulator was killed, and a younger terminal has the number of its terminal. The change time of the
        // younger terminal is later than that of the symlink.
        std::os::unix::fs::symlink(one.name(), &path).unwrap();
        let since = |metadata: Metadata| (metadata.ctime(), metadata.ctime_nsec());
        let made = since(fs::symlink_metadata(&path).unwrap());
        while since(fs::metadata(one.name()).unwrap()) <= made {
            fs::set_permissions(one.name(), fs::metadata(one.name()).unwrap().permissions()).unwrap();
        }
        drop(PtySymlink::new(&path, other.name()).unwrap());

        std::os::unix::fs::symlink("/dev/null", &path).unwrap();
        let failure = PtySymlink::new(&path, Path::new("/dev/pts/0")).unwrap_err();
        assert_eq!(failure.kind, Kind::PortNotTty);
        fs::remove_file(&path).unwrap();
        fs::write(&path, "mine").unwrap();
        assert_eq!(PtySymlink::new(&path, Path::new("/dev/pts/0")).unwrap_err().kind.exit_code(), 4);
        assert_eq!(fs::read(&path).unwrap(), b"mine");
        let deep = directory.path().join("no/port");
        assert_eq!(PtySymlink::new(&deep, Path::new("/dev/pts/0")).unwrap_err().kind, Kind::PortMissing);
    }
}
