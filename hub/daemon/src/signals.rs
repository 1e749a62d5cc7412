//! What a signal wants of the hub: SIGINT and SIGTERM its end, SIGHUP the configuration read again, unless it says that the
//! terminal of the hub is gone. Refuses to know how either is done.

use std::io::Read;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;

use rustix::fs::{Mode, OFlags, open};
use schema::Failure;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::low_level::pipe::register;

use crate::preflight::no_resource;

/// The signals of this process.
pub(crate) struct Signals {
    /// Readable after SIGINT and SIGTERM.
    end: UnixStream,
    /// Readable after SIGHUP.
    hangup: UnixStream,
    /// Whoever started it wants it to end with its terminal.
    ends_with_terminal: bool,
}

/// What a signal wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Wanted {
    End,
    Reload,
}

impl Signals {
    /// Takes them from now on.
    ///
    /// [`Kind::Short`](schema::Kind) if descriptors are.
    pub(crate) fn of_process() -> Result<Signals, Failure> {
        // `nohup` lets it be ignored.
        let ends_with_terminal = has_terminal() && !is_hangup_ignored();
        let registered = || {
            let ((end, ends), (hangup, hung_up)) = (UnixStream::pair()?, UnixStream::pair()?);
            [&end, &hangup].into_iter().try_for_each(|stream| stream.set_nonblocking(true))?;
            register(SIGINT, ends.try_clone()?)?;
            register(SIGTERM, ends)?;
            register(SIGHUP, hung_up)?;
            Ok(Signals { end, hangup, ends_with_terminal })
        };
        registered().map_err(|error: std::io::Error| no_resource("a signal handler", &error))
    }

    /// What becomes readable when one has come.
    pub(crate) fn descriptors(&self) -> [BorrowedFd<'_>; 2] {
        [self.end.as_fd(), self.hangup.as_fd()]
    }

    /// What is wanted by those that have come.
    pub(crate) fn take(&self) -> Option<Wanted> {
        let came = |mut stream: &UnixStream| stream.read(&mut [0; 64]).is_ok_and(|count| count > 0);
        if came(&self.end) {
            return Some(Wanted::End);
        }
        let is_gone = || self.ends_with_terminal && !has_terminal();
        came(&self.hangup).then(|| if is_gone() { Wanted::End } else { Wanted::Reload })
    }
}

/// Whether there is a terminal whose end would be told; of one that was closed there is nothing to open any more.
fn has_terminal() -> bool {
    open("/dev/tty", OFlags::RDONLY | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty()).is_ok()
}

fn is_hangup_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask & 1 != 0)
}
