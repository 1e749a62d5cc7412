//! A writer that drops a line instead of waiting for a slow reader: sending comes first. Refuses to know what is
//! written.

use std::io::{self, ErrorKind, Write};
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

/// Writes each piece at once or not at all.
pub struct LossyWriter<'a, W> {
    to: &'a mut W,
    /// There is nothing left to send: then who reads is waited for, for a while.
    stop: &'a AtomicBool,
    left: Duration,
}

/// The most that a reader delays the end, over all lines: enough for one that reads at all.
const PATIENCE: Duration = Duration::from_secs(1);

impl<'a, W: Write + AsFd> LossyWriter<'a, W> {
    /// Makes a writer of pieces to `to`, which is not waited for before `stop` is set.
    pub fn around(to: &'a mut W, stop: &'a AtomicBool) -> LossyWriter<'a, W> {
        LossyWriter { to, stop, left: PATIENCE }
    }

    /// Whether a piece can be written without waiting: the system says so if a page is free in a pipe, which is more than
    /// a line has (pipe(7), PIPE_BUF). An error or a reader that is gone is to be told by the write.
    fn has_room(&mut self) -> bool {
        let left = if self.stop.load(Ordering::Relaxed) { self.left } else { Duration::ZERO };
        let began = Instant::now();
        let timeout = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: i64::from(left.subsec_nanos()) };
        let ready = poll(&mut [PollFd::new(&*self.to, PollFlags::OUT)], Some(&timeout));
        if !left.is_zero() {
            self.left = left.saturating_sub(began.elapsed());
        }
        ready.is_ok_and(|count| count > 0)
    }
}

impl<W: Write + AsFd> Write for LossyWriter<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if !self.has_room() {
            return Ok(bytes.len());
        }
        match self.to.write(bytes) {
            // Somebody set it so that it does not wait.
            Err(error) if error.kind() == ErrorKind::WouldBlock => Ok(bytes.len()),
            // A log on a full disk is no reason to end.
            Err(error) if error.kind() != ErrorKind::BrokenPipe && !self.stop.load(Ordering::Relaxed) => {
                Ok(bytes.len())
            }
            other => other,
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn what_finds_no_room_is_left_out_whole() {
        let (mut reader, mut writer) = io::pipe().unwrap();
        let stop = AtomicBool::new(false);
        let mut lossy = LossyWriter::around(&mut writer, &stop);
        let line = [b'x'; 1000];
        for _ in 0..1000 {
            lossy.write_all(&line).unwrap();
        }
        // At the end it is waited for a while, once.
        stop.store(true, Ordering::Relaxed);
        for _ in 0..1000 {
            lossy.write_all(&line).unwrap();
        }
        assert_eq!(lossy.left, Duration::ZERO);
        drop(writer);
        let mut all = Vec::new();
        reader.read_to_end(&mut all).unwrap();
        assert!(all.len() >= line.len() && all.len() < 1000 * line.len(), "{}", all.len());
        assert_eq!(all.len() % line.len(), 0);
    }

    #[test]
    fn a_log_on_a_full_disk_is_told_at_the_end() {
        let mut full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        let stop = AtomicBool::new(false);
        let mut lossy = LossyWriter::around(&mut full, &stop);
        lossy.write_all(b"x").unwrap();
        stop.store(true, Ordering::Relaxed);
        assert_eq!(lossy.write_all(b"x").unwrap_err().kind(), ErrorKind::StorageFull);
    }

    #[test]
    fn a_reader_that_is_gone_is_told() {
        let (reader, mut writer) = io::pipe().unwrap();
        drop(reader);
        let stop = AtomicBool::new(false);
        let error = LossyWriter::around(&mut writer, &stop).write_all(b"x").unwrap_err();
        assert_eq!(error.kind(), ErrorKind::BrokenPipe);
    }
}
