//! One descriptor for programs that also wait for other things: readable while there may be something to receive or to
//! check. Hides that the event behind it changes with each hub; refuses to know what is received.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::Duration;

use rustix::event::epoll;
use rustix::io::Errno;
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create, timerfd_settime,
};
use scanhub_schema::{Failure, Kind};

/// An epoll descriptor over events, which come and go, and a clock.
pub(crate) struct Readiness {
    descriptor: OwnedFd,
    clock: OwnedFd,
}

impl Readiness {
    /// Readable at once: nobody has looked yet.
    ///
    /// [`Kind::Short`] if descriptors are.
    pub(crate) fn new() -> Result<Readiness, Failure> {
        let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
        let clock = timerfd_create(TimerfdClockId::Monotonic, flags).map_err(short)?;
        let descriptor = epoll::create(epoll::CreateFlags::CLOEXEC).map_err(short)?;
        let readiness = Readiness { descriptor, clock };
        readiness.add(readiness.clock.as_fd())?;
        readiness.again_in(Duration::ZERO)?;
        Ok(readiness)
    }

    /// Readable also while `event` is; one that is closed leaves by itself, one that is known already stays.
    ///
    /// [`Kind::Short`] if memory is.
    pub(crate) fn add(&self, event: BorrowedFd<'_>) -> Result<(), Failure> {
        let data = epoll::EventData::new_u64(0);
        match epoll::add(&self.descriptor, event, data, epoll::EventFlags::IN) {
            Ok(()) | Err(Errno::EXIST) => Ok(()),
            Err(error) => Err(short(error)),
        }
    }

    /// Not readable because of the time, until `left` is over.
    pub(crate) fn again_in(&self, left: Duration) -> Result<(), Failure> {
        // 0 would mean never.
        let left = left.max(Duration::from_nanos(1));
        let it_value = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
        let once = Itimerspec { it_interval: Timespec { tv_sec: 0, tv_nsec: 0 }, it_value };
        timerfd_settime(&self.clock, TimerfdTimerFlags::empty(), &once).map(|_| ()).map_err(short)
    }
}

impl AsFd for Readiness {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.descriptor.as_fd()
    }
}

fn short(error: Errno) -> Failure {
    let what = format!("no descriptor to wait on: {error}");
    Failure::new(Kind::Short, what, "`ulimit -n` may be too small")
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::event::{PollFd, PollFlags, poll};
    use std::io::{Write, pipe};

    fn is_readable(readiness: &Readiness, within: Duration) -> bool {
        let mut fds = [PollFd::new(readiness, PollFlags::IN)];
        let within = Timespec { tv_sec: within.as_secs() as i64, tv_nsec: within.subsec_nanos().into() };
        poll(&mut fds, Some(&within)).unwrap() == 1
    }

    const LONG: Duration = Duration::from_secs(20);

    #[test]
    fn the_time_makes_it_readable_once() {
        let readiness = Readiness::new().unwrap();
        assert!(is_readable(&readiness, LONG), "nobody has looked yet");
        readiness.again_in(LONG).unwrap();
        assert!(!is_readable(&readiness, Duration::ZERO));
        readiness.again_in(Duration::from_millis(1)).unwrap();
        assert!(is_readable(&readiness, LONG));
    }

    #[test]
    fn events_come_and_go() {
        let readiness = Readiness::new().unwrap();
        readiness.again_in(LONG).unwrap();
        let (read, mut write) = pipe().unwrap();
        for _ in 0..2 {
            readiness.add(read.as_fd()).unwrap();
        }
        write.write_all(b"!").unwrap();
        assert!(is_readable(&readiness, LONG));
        drop(read);
        assert!(!is_readable(&readiness, Duration::ZERO));
    }
}
