//! Writes lines to stdout and stderr. Each line is written with one call, so a killed verb leaves no partial line. A
//! verb ends without an error if the reader of its output closes it.

use std::io::{self, ErrorKind, Write};
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use scanhub_schema::{Failure, Kind, escape_json};
use serde::Serialize;

/// Reason why a verb ends early.
#[derive(Debug)]
pub enum ExitReason {
    /// The reader of the output closed it.
    ReaderClosed,
    /// The verb failed.
    Failure(Failure),
}

impl From<Failure> for ExitReason {
    fn from(failure: Failure) -> ExitReason {
        ExitReason::Failure(failure)
    }
}

impl From<scanhub_client::Error> for ExitReason {
    fn from(error: scanhub_client::Error) -> ExitReason {
        ExitReason::Failure(error.into())
    }
}

impl From<io::Error> for ExitReason {
    fn from(error: io::Error) -> ExitReason {
        if error.kind() == ErrorKind::BrokenPipe {
            return ExitReason::ReaderClosed;
        }
        ExitReason::Failure(Failure::new(Kind::Failed, format!("cannot write: {error}"), ""))
    }
}

/// Converts the end of a verb to its result. A reader that closes the output is not an error, as in `scanhub echo
/// front/scan | head`.
///
/// # Errors
///
/// Returns the failure for any other reason.
pub fn verb_result(result: Result<(), ExitReason>) -> Result<(), Failure> {
    match result {
        Ok(()) | Err(ExitReason::ReaderClosed) => Ok(()),
        Err(ExitReason::Failure(failure)) => Err(failure),
    }
}

/// Writer of whole lines, which reuses its buffer.
pub struct Output<'a> {
    out: &'a mut dyn Write,
    line: Vec<u8>,
}

impl<'a> Output<'a> {
    /// Creates an output that writes lines to `out`.
    pub fn new(out: &'a mut dyn Write) -> Output<'a> {
        Output { out, line: Vec::with_capacity(8192) }
    }

    /// Writes a JSON line. Control characters are escaped, so they have no effect on a terminal.
    ///
    /// # Errors
    ///
    /// Returns [`ExitReason`] if the line cannot be written.
    pub fn json(&mut self, value: &impl Serialize) -> Result<(), ExitReason> {
        self.line.clear();
        serde_json::to_writer(&mut self.line, value).map_err(io::Error::from)?;
        escape_json(&mut self.line);
        self.end()
    }

    /// Writes the line of text that `build` creates without a line feed. Control characters, which move a terminal's
    /// cursor or change its colors, become `?`, because ports, types and errors may come from another machine.
    ///
    /// # Errors
    ///
    /// Returns the error of `build`, and [`ExitReason`] if the line cannot be written.
    pub fn line(&mut self, build: impl FnOnce(&mut Vec<u8>) -> io::Result<()>) -> Result<(), ExitReason> {
        self.line.clear();
        build(&mut self.line)?;
        escape_controls(&mut self.line);
        self.end()
    }

    /// Writes `bytes` unchanged.
    ///
    /// # Errors
    ///
    /// Returns [`ExitReason`] if the bytes cannot be written.
    pub fn raw(&mut self, bytes: &[u8]) -> Result<(), ExitReason> {
        self.out.write_all(bytes)?;
        Ok(self.out.flush()?)
    }

    fn end(&mut self) -> Result<(), ExitReason> {
        self.line.push(b'\n');
        self.out.write_all(&self.line)?;
        Ok(self.out.flush()?)
    }
}

/// Replaces each byte of the control characters in UTF-8 `text` by `?`. These are C0, DEL and C1 (ECMA-48). A line feed
/// becomes a space.
fn escape_controls(text: &mut [u8]) {
    let mut before = 0;
    for at in 0..text.len() {
        let byte = text[at];
        if byte == b'\n' {
            // A line feed separates a message from its remedy, and both are printed on one line.
            text[at] = b' ';
        } else if byte < 0x20 || byte == 0x7f {
            text[at] = b'?';
        } else if before == 0xc2 && byte < 0xa0 {
            text[at - 1..=at].fill(b'?');
        }
        before = byte;
    }
}

/// Writes `rows` as columns, each as wide as its widest cell. Numbers are aligned to the right.
///
/// # Errors
///
/// Returns [`ExitReason`] if a row cannot be written.
pub fn table(output: &mut Output<'_>, rows: &[Vec<String>]) -> Result<(), ExitReason> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or_default();
    let width =
        |column: usize| rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max();
    let widths: Vec<usize> = (0..columns).map(|column| width(column).unwrap_or_default()).collect();
    for row in rows {
        output.line(|line| {
            let start = line.len();
            for (cell, width) in row.iter().zip(&widths) {
                if cell.chars().all(|c| c.is_ascii_digit() || c == '.' || c == '-') {
                    write!(line, "{cell:>width$}  ")?;
                } else {
                    write!(line, "{cell:<width$}  ")?;
                }
            }
            while line.len() > start && line.ends_with(b" ") {
                line.pop();
            }
            Ok(())
        })?;
    }
    Ok(())
}

/// Returns whether colors may be used. They may be used if `NO_COLOR` is unset or empty (<https://no-color.org>).
pub fn colors() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

/// Returns the number of columns of the terminal `out`, or `None` if it is not a terminal or has no known size.
#[cfg(feature = "record")]
pub fn columns(out: impl AsFd) -> Option<usize> {
    let size = rustix::termios::tcgetwinsize(out).ok()?;
    Some(usize::from(size.ws_col)).filter(|columns| *columns > 0)
}

/// Joins `parts` with two spaces in at most `columns` columns. If the parts do not fit, drops whole parts, the lowest
/// rank first, because a truncated number would look like another number. Keeps the last remaining part even if it is
/// too long.
#[cfg(feature = "record")]
pub fn fitting(mut parts: Vec<(u8, String)>, columns: usize) -> String {
    let length =
        |parts: &[(u8, String)]| parts.iter().map(|(_, part)| part.chars().count() + 2).sum::<usize>();
    while parts.len() > 1 && length(&parts) > columns + 2 {
        let lowest = (0..parts.len()).min_by_key(|&at| parts[at].0).unwrap_or_default();
        parts.remove(lowest);
    }
    let parts: Vec<String> = parts.into_iter().map(|(_, part)| part).collect();
    parts.join("  ")
}

/// Writer that drops a line instead of waiting for a slow reader, so that the output does not delay the samples. Each
/// write is complete, or writes nothing.
pub struct LossyWriter<'a, W> {
    to: &'a mut W,
    /// Whether the verb is ending. The writer may then wait for the reader, up to `wait_budget`, because no samples are
    /// delayed.
    stop: &'a AtomicBool,
    /// Remaining time that the writer may wait.
    wait_budget: Duration,
}

/// Maximum time for which a reader may delay the end of the verb, in total for all lines. It is enough for every reader
/// that still reads.
const MAX_READER_DELAY: Duration = Duration::from_secs(1);

impl<'a, W: Write + AsFd> LossyWriter<'a, W> {
    /// Creates a writer to `to`. The writer waits for the reader only after `stop` is set.
    pub fn new(to: &'a mut W, stop: &'a AtomicBool) -> LossyWriter<'a, W> {
        LossyWriter { to, stop, wait_budget: MAX_READER_DELAY }
    }

    /// Returns whether a line can be written without waiting. The system reports a pipe as writable if a page is free.
    /// A line needs less than that (pipe(7), PIPE_BUF). The result is also true if the write will return an error.
    fn has_room(&mut self) -> bool {
        let budget = if self.stop.load(Ordering::Relaxed) { self.wait_budget } else { Duration::ZERO };
        let started = Instant::now();
        let timeout = Timespec { tv_sec: budget.as_secs() as i64, tv_nsec: i64::from(budget.subsec_nanos()) };
        let ready = poll(&mut [PollFd::new(&*self.to, PollFlags::OUT)], Some(&timeout));
        if !budget.is_zero() {
            self.wait_budget = budget.saturating_sub(started.elapsed());
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
            // Another process may have set the descriptor to nonblocking.
            Err(error) if error.kind() == ErrorKind::WouldBlock => Ok(bytes.len()),
            // A full disk must not end the verb.
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

    fn line(text: &str) -> String {
        let mut out = Vec::new();
        Output::new(&mut out).line(|line| write!(line, "{text}")).unwrap();
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn replaces_control_characters_in_text() {
        assert_eq!(line("\x1b[2J a\rb\nc\td \x7f"), "?[2J a?b c?d ?\n");
        assert_eq!(line("\u{80}x\u{9b}31m\u{9f}"), "??x??31m??\n");
        assert_eq!(line("/dev/ttyUSB0 \u{a0}20 °C ● Größe"), "/dev/ttyUSB0 \u{a0}20 °C ● Größe\n");
    }

    #[test]
    fn escapes_control_characters_in_json() {
        let mut out = Vec::new();
        Output::new(&mut out).json(&"\x1b[2J\n\u{9b}2J").unwrap();
        assert_eq!(out, b"\"\\u001b[2J\\n\\u009b2J\"\n");
    }

    #[cfg(feature = "record")]
    #[test]
    fn drops_whole_parts_that_do_not_fit() {
        let parts = || [(2, "0:00:10"), (0, "6.0 KiB/s"), (1, "903 samples"), (3, "0 lost")];
        let in_columns =
            |columns| fitting(parts().map(|(rank, part)| (rank, part.to_owned())).into(), columns);
        assert_eq!(in_columns(39), "0:00:10  6.0 KiB/s  903 samples  0 lost");
        assert_eq!(in_columns(38), "0:00:10  903 samples  0 lost");
        assert_eq!(in_columns(27), "0:00:10  0 lost");
        assert_eq!(in_columns(14), "0 lost");
        assert_eq!(in_columns(1), "0 lost");
    }

    #[test]
    fn drops_whole_lines_without_room() {
        let (mut reader, mut writer) = io::pipe().unwrap();
        let stop = AtomicBool::new(false);
        let mut lossy = LossyWriter::new(&mut writer, &stop);
        let line = [b'x'; 1000];
        for _ in 0..1000 {
            lossy.write_all(&line).unwrap();
        }
        // At the end, the writer uses its wait budget once.
        stop.store(true, Ordering::Relaxed);
        for _ in 0..1000 {
            lossy.write_all(&line).unwrap();
        }
        assert_eq!(lossy.wait_budget, Duration::ZERO);
        drop(writer);
        let mut all = Vec::new();
        reader.read_to_end(&mut all).unwrap();
        assert!(all.len() >= line.len() && all.len() < 1000 * line.len(), "{}", all.len());
        assert_eq!(all.len() % line.len(), 0);
    }

    #[test]
    fn reports_full_disk_of_log_at_end() {
        let mut full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        let stop = AtomicBool::new(false);
        let mut lossy = LossyWriter::new(&mut full, &stop);
        lossy.write_all(b"x").unwrap();
        stop.store(true, Ordering::Relaxed);
        assert_eq!(lossy.write_all(b"x").unwrap_err().kind(), ErrorKind::StorageFull);
    }

    #[test]
    fn reports_closed_reader() {
        let (reader, mut writer) = io::pipe().unwrap();
        drop(reader);
        let stop = AtomicBool::new(false);
        let error = LossyWriter::new(&mut writer, &stop).write_all(b"x").unwrap_err();
        assert_eq!(error.kind(), ErrorKind::BrokenPipe);
    }
}
