//! The port: a pty that behaves like a serial line as far as a pty can, and the clock. The only file of this crate that
//! reads the kernel's clock. Knows nothing about telegrams.
//!
//! Differences between a pty and a line, and what is done about them: a pty keeps what nobody reads (so nothing is written
//! while the host's side is closed, and the rest is discarded then); its exclusive mode survives the last close (so it is
//! cleared); before the first open it does not report that it is closed (so it is opened and closed once).

use std::ffi::OsStr;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, fcntl_setfl, open};
use rustix::io::{self, Errno};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, QueueSelector, ioctl_tiocnxcl, tcflush, tcgetattr, tcsetattr};
use rustix::time::{ClockId, clock_gettime};
use schema::{Failure, Kind, Nanos};

/// CLOCK_MONOTONIC in nanoseconds.
pub fn now_ns() -> Nanos {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// A pty whose other side is what a host opens.
#[derive(Debug)]
pub struct Pty {
    master: OwnedFd,
    name: PathBuf,
}

/// What ended a wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Wake {
    /// Time, bytes, or the host's side was closed.
    Line,
    /// One of the stop descriptors is readable.
    Stop,
}

impl Pty {
    /// A new one, raw, its host's side closed.
    pub fn open() -> Result<Pty, Failure> {
        let make = || -> io::Result<Pty> {
            let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
            grantpt(&master)?;
            unlockpt(&master)?;
            let name = ptsname(&master, Vec::new())?;
            fcntl_setfl(&master, OFlags::RDWR | OFlags::NONBLOCK)?;
            let pty = Pty { master, name: OsStr::from_bytes(name.as_bytes()).into() };
            let slave = pty.open_slave()?;
            // Else what the sensor sends would be echoed back to it until the host has set its own mode.
            let mut termios = tcgetattr(&slave)?;
            termios.make_raw();
            tcsetattr(&slave, OptionalActions::Now, &termios)?;
            Ok(pty)
        };
        make().map_err(|errno| {
            Failure::new(
                Kind::Short,
                format!("cannot make a pty: {errno}"),
                "see /proc/sys/kernel/pty/nr and max",
            )
        })
    }

    /// The host's side, such as `/dev/pts/4`.
    pub fn name(&self) -> &Path {
        &self.name
    }

    /// Whether a host has its side open.
    pub fn is_open(&self) -> bool {
        let mut fds = [PollFd::new(&self.master, PollFlags::IN)];
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        poll(&mut fds, Some(&now)).is_ok() && !fds[0].revents().contains(PollFlags::HUP)
    }

    /// What the rate of the host's port is set to, in bits per second.
    pub fn rate(&self) -> u32 {
        tcgetattr(&self.master).map_or(0, |termios| termios.output_speed())
    }

    /// Reads what the host has written; `0` if nothing.
    pub fn read(&self, buffer: &mut [u8]) -> Result<usize, Failure> {
        match io::read(&self.master, buffer) {
            Ok(count) => Ok(count),
            // EIO: the host's side is closed and everything was read.
            Err(Errno::AGAIN | Errno::IO | Errno::INTR) => Ok(0),
            Err(errno) => Err(broken("read from", &self.name, errno)),
        }
    }

    /// Gives `bytes` to the host; returns how many of them its buffer had room for.
    pub fn write(&self, bytes: &[u8]) -> Result<usize, Failure> {
        let mut rest = bytes;
        while !rest.is_empty() {
            match io::write(&self.master, rest) {
                Ok(count) => rest = &rest[count..],
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN | Errno::IO) => break,
                Err(errno) => return Err(broken("write to", &self.name, errno)),
            }
        }
        Ok(bytes.len() - rest.len())
    }

    /// What becomes readable when a host has written, and writable when it has read.
    pub fn waits_for(&self) -> BorrowedFd<'_> {
        self.master.as_fd()
    }

    /// After the host's side was closed: forgets what it has not read, and lets others than root open it again.
    pub(crate) fn clean_up_after_close(&self) {
        // Somebody else may have opened it exclusively in this moment: then there is nothing to clean up.
        if let Ok(slave) = self.open_slave() {
            let _ = tcflush(&slave, QueueSelector::IFlush);
            let _ = ioctl_tiocnxcl(&slave);
        }
    }

    fn open_slave(&self) -> io::Result<OwnedFd> {
        open(&self.name, OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC, Mode::empty())
    }
}

/// Waits for bytes at `line`, for `deadline_ns` of the clock, or for one of the `stops`.
pub(crate) fn wait(stops: [BorrowedFd<'_>; 2], line: Option<BorrowedFd<'_>>, deadline_ns: Nanos) -> Wake {
    let left = deadline_ns.saturating_sub(now_ns());
    let timeout = Timespec { tv_sec: (left / 1_000_000_000) as _, tv_nsec: (left % 1_000_000_000) as _ };
    let mut fds =
        [stops[0], stops[1], line.unwrap_or(stops[0])].map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN));
    // An interrupted wait is a short one.
    let _ = poll(&mut fds, Some(&timeout));
    if fds[..2].iter().any(|fd| !fd.revents().is_empty()) { Wake::Stop } else { Wake::Line }
}

fn broken(what: &str, name: &Path, errno: Errno) -> Failure {
    Failure::new(Kind::Failed, format!("cannot {what} the pty {}: {errno}", name.display()), "")
}
