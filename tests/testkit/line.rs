//! Serial line for tests: a pty. The test has the scanner's end, and can send bytes as fast as the hub reads them.

use std::ffi::OsStr;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::time::Instant;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, fcntl_setfl, open};
use rustix::io::{Errno, read, write};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use super::WAIT_TIMEOUT;

/// Scanner's end of the line.
pub(crate) struct TestLine(OwnedFd);

impl TestLine {
    /// Creates a raw pty, and a symlink at `path` to the hub's end of the pty.
    pub(crate) fn create(path: &Path) -> TestLine {
        let make = || -> Result<TestLine, Errno> {
            let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
            grantpt(&master)?;
            unlockpt(&master)?;
            let name = ptsname(&master, Vec::new())?;
            fcntl_setfl(&master, OFlags::RDWR | OFlags::NONBLOCK)?;
            let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
            let slave = open(OsStr::from_bytes(name.as_bytes()), flags, Mode::empty())?;
            let mut termios = tcgetattr(&slave)?;
            termios.make_raw();
            tcsetattr(&slave, OptionalActions::Now, &termios)?;
            rustix::fs::symlink(OsStr::from_bytes(name.as_bytes()), path)?;
            Ok(TestLine(master))
        };
        make().unwrap_or_else(|error| panic!("cannot create a pty at {}: {error}", path.display()))
    }

    /// Waits until the hub has the line open.
    pub(crate) fn wait_until_open(&self) {
        super::wait_until("the hub opens the line", || self.is_open());
    }

    /// Returns whether the hub has the line open.
    pub(crate) fn is_open(&self) -> bool {
        let mut fds = [PollFd::new(&self.0, PollFlags::IN)];
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        poll(&mut fds, Some(&now)).is_ok() && !fds[0].revents().contains(PollFlags::HUP)
    }

    /// Waits for a request of the hub, and returns its command byte.
    pub(crate) fn wait_for_request(&self) -> u8 {
        let mut buffer = Vec::new();
        super::wait_until("the hub sends a request", || {
            let mut bytes = [0; 16];
            let len = read(&self.0, &mut bytes).unwrap_or(0);
            buffer.extend(&bytes[..len]);
            buffer.len() >= REQUEST_LEN
        });
        buffer[COMMAND_OFFSET]
    }

    /// Returns the bytes that the other end has sent since the last call.
    pub(crate) fn received(&self) -> Vec<u8> {
        let (mut received, mut bytes) = (Vec::new(), [0; 256]);
        while let Ok(len @ 1..) = read(&self.0, &mut bytes) {
            received.extend(&bytes[..len]);
        }
        received
    }

    /// Sends the first part of `bytes` for which the line has room, and discards the rest.
    pub(crate) fn offer(&self, bytes: &[u8]) {
        let _ = write(&self.0, bytes);
    }

    /// Sends all of `bytes`, as fast as the other end reads them. Discards bytes that the other end sends meanwhile.
    pub(crate) fn send(&self, mut bytes: &[u8]) {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        while !bytes.is_empty() {
            let mut buffer = [0; 256];
            while read(&self.0, &mut buffer).is_ok_and(|len| len > 0) {}
            match write(&self.0, bytes) {
                Ok(len) => bytes = &bytes[len..],
                Err(Errno::AGAIN | Errno::INTR) => {
                    let mut fds = [PollFd::new(&self.0, PollFlags::OUT)];
                    let _ = poll(&mut fds, Some(&Timespec { tv_sec: 1, tv_nsec: 0 }));
                }
                Err(error) => panic!("cannot write to the line: {error}"),
            }
            assert!(Instant::now() < give_up_at, "timeout: the other end does not read");
        }
    }
}

/// Length in bytes of the LMS requests that the tests wait for.
const REQUEST_LEN: usize = 7;
/// Offset of the command byte in a request.
const COMMAND_OFFSET: usize = 4;

/// Opens the host's end of the line at `path` in raw mode at `rate` baud. Reads and writes do not block.
pub(crate) fn open_line(path: &Path, rate: u32) -> std::fs::File {
    let make = || -> Result<OwnedFd, Errno> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let line = open(path, flags, Mode::empty())?;
        let mut termios = tcgetattr(&line)?;
        termios.make_raw();
        termios.set_speed(rate)?;
        tcsetattr(&line, OptionalActions::Now, &termios)?;
        Ok(line)
    };
    make().unwrap_or_else(|error| panic!("cannot open {}: {error}", path.display())).into()
}
