//! A host with a port open: writes requests, and finds the telegrams in what arrives.

use std::os::fd::OwnedFd;
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, open};
use rustix::io::Errno;
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use scanhub_drivers::lms;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::framer::{Found, Framer};

use crate::PATIENCE;

/// A host with the port open.
pub(crate) struct Host {
    pub(crate) port: OwnedFd,
    framer: Framer,
}

impl Host {
    pub(crate) fn open(path: &Path, rate: u32) -> Host {
        Host::try_open(path, rate).unwrap()
    }

    /// Opens a port that may be unplugged at any time.
    pub(crate) fn try_open(path: &Path, rate: u32) -> Result<Host, Errno> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let host = Host { port: open(path, flags, Mode::empty())?, framer: Framer::default() };
        host.try_set_rate(rate)?;
        Ok(host)
    }

    pub(crate) fn set_rate(&self, rate: u32) {
        self.try_set_rate(rate).unwrap();
    }

    fn try_set_rate(&self, rate: u32) -> Result<(), Errno> {
        let mut termios = tcgetattr(&self.port)?;
        termios.make_raw();
        termios.set_speed(rate)?;
        tcsetattr(&self.port, OptionalActions::Now, &termios)
    }

    /// Writes `request` as most drivers do: at once, for the UART to space.
    pub(crate) fn write(&self, request: Request) {
        let encoded = request.encode(0);
        assert_eq!(rustix::io::write(&self.port, encoded.bytes()), Ok(encoded.bytes().len()));
    }

    /// Returns the next telegram that arrives within `patience`; `None` if the port is unplugged before.
    pub(crate) fn telegram(&mut self, patience: Duration) -> Option<Vec<u8>> {
        let end = Instant::now() + patience;
        loop {
            while let Some(found) = self.framer.poll() {
                if let Found::Telegram(framed) = found {
                    return Some(framed.telegram.bytes().to_vec());
                }
            }
            let left = end.saturating_duration_since(Instant::now());
            let timeout = Timespec { tv_sec: left.as_secs() as _, tv_nsec: left.subsec_nanos() as _ };
            let mut fds = [PollFd::new(&self.port, PollFlags::IN)];
            if poll(&mut fds, Some(&timeout)).unwrap() == 0 {
                // A frame whose end looks like a beginning is delivered when nothing follows.
                self.framer.release(lms::framer::VETO_HOLD);
                if let Some(Found::Telegram(framed)) = self.framer.poll() {
                    return Some(framed.telegram.bytes().to_vec());
                }
                return None;
            }
            match rustix::io::read(&self.port, self.framer.spare()) {
                Ok(0) => return None,
                Ok(count) => self.framer.commit(count),
                Err(Errno::AGAIN | Errno::INTR) => {}
                Err(_) => return None,
            }
        }
    }

    /// Sends `request` and returns the reply to it; telegrams before that are skipped.
    pub(crate) fn ask(&mut self, request: Request) -> Vec<u8> {
        self.write(request);
        loop {
            let telegram = self.telegram(PATIENCE).unwrap_or_else(|| panic!("no answer to {request:?}"));
            if telegram[4] == request.command() | 0x80 {
                return telegram;
            }
        }
    }
}
