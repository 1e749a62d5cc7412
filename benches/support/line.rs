//! The host's end of a pty for the floors: open, read, write, with the system calls that it takes and nothing else.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;

use rustix::fs::{Mode, OFlags, open};
use rustix::io::Errno;
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use super::Outcome;
use super::clock;

/// An open line.
pub(crate) struct Line(OwnedFd);

impl Line {
    /// Opens the line at `path`, raw, at `rate` bits per second.
    pub(crate) fn open(path: &Path, rate: u32) -> Outcome<Line> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let line = Line(open(path, flags, Mode::empty())?);
        line.set_rate(rate)?;
        Ok(line)
    }

    /// Sets the rate.
    pub(crate) fn set_rate(&self, rate: u32) -> Outcome<()> {
        let mut termios = tcgetattr(&self.0)?;
        termios.make_raw();
        termios.set_speed(rate)?;
        Ok(tcsetattr(&self.0, OptionalActions::Now, &termios)?)
    }

    /// What there is; 0 if nothing.
    pub(crate) fn read(&self, buffer: &mut [u8]) -> Outcome<usize> {
        match rustix::io::read(&self.0, buffer) {
            Ok(0) => Err("the line is gone".into()),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            other => Ok(other?),
        }
    }

    /// Writes one byte.
    pub(crate) fn write(&self, byte: u8) -> Outcome<()> {
        rustix::io::write(&self.0, &[byte])?;
        Ok(())
    }

    /// Throws away what comes until nothing has come for `pause` nanoseconds.
    pub(crate) fn await_pause(&self, pause: u64) -> Outcome<()> {
        let mut buffer = [0; 1024];
        while clock::readable(self, Some(clock::now() + pause))? {
            self.read(&mut buffer)?;
        }
        Ok(())
    }
}

impl AsFd for Line {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}
