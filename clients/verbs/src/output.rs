//! Lines on stdout and stderr: each is written with one call, so that a killed verb loses none. A closed reader ends
//! the verb quietly. Refuses to know what the lines say.

use std::io::{self, ErrorKind, Write};

use scanhub_schema::{Failure, Kind, escape_json};
use serde::Serialize;

/// Why a verb ended early.
#[derive(Debug)]
pub enum End {
    /// The reader of the output closed it.
    ReaderGone,
    /// It failed.
    Failure(Failure),
}

impl From<Failure> for End {
    fn from(failure: Failure) -> End {
        End::Failure(failure)
    }
}

impl From<io::Error> for End {
    fn from(error: io::Error) -> End {
        if error.kind() == ErrorKind::BrokenPipe {
            return End::ReaderGone;
        }
        End::Failure(Failure::new(Kind::Failed, format!("cannot write: {error}"), ""))
    }
}

/// Makes a success of a reader that went away: `scanhub echo front/scan | head` is normal use.
///
/// # Errors
///
/// What else it ended by.
pub fn quiet(result: Result<(), End>) -> Result<(), Failure> {
    match result {
        Ok(()) | Err(End::ReaderGone) => Ok(()),
        Err(End::Failure(failure)) => Err(failure),
    }
}

/// Writes whole lines; the buffer is used again and again.
pub struct Output<'a> {
    out: &'a mut dyn Write,
    line: Vec<u8>,
}

impl<'a> Output<'a> {
    /// Makes an output of lines to `out`.
    pub fn new(out: &'a mut dyn Write) -> Output<'a> {
        Output { out, line: Vec::with_capacity(8192) }
    }

    /// Writes a line of JSON, which a terminal does not obey either.
    ///
    /// # Errors
    ///
    /// As [`End`] says.
    pub fn json(&mut self, value: &impl Serialize) -> Result<(), End> {
        self.line.clear();
        serde_json::to_writer(&mut self.line, value).map_err(io::Error::from)?;
        escape_json(&mut self.line);
        self.end()
    }

    /// Writes a line of text that `build` makes, without its end. What would move a terminal's cursor or change its colours is
    /// shown as `?`: ports, types and errors may come from another machine.
    ///
    /// # Errors
    ///
    /// As [`End`] says, and what `build` says.
    pub fn line(&mut self, build: impl FnOnce(&mut Vec<u8>) -> io::Result<()>) -> Result<(), End> {
        self.line.clear();
        build(&mut self.line)?;
        disarm(&mut self.line);
        self.end()
    }

    /// Bytes as they are.
    pub fn raw(&mut self, bytes: &[u8]) -> Result<(), End> {
        self.out.write_all(bytes)?;
        Ok(self.out.flush()?)
    }

    fn end(&mut self) -> Result<(), End> {
        self.line.push(b'\n');
        self.out.write_all(&self.line)?;
        Ok(self.out.flush()?)
    }
}

/// Puts `?` in place of each byte of the control characters of UTF-8 `text`: C0, DEL and C1 (ECMA-48); a blank for a new
/// line.
fn disarm(text: &mut [u8]) {
    let mut before = 0;
    for at in 0..text.len() {
        let byte = text[at];
        if byte == b'\n' {
            // A message and its remedy are told in one line.
            text[at] = b' ';
        } else if byte < 0x20 || byte == 0x7f {
            text[at] = b'?';
        } else if before == 0xc2 && byte < 0xa0 {
            text[at - 1..=at].fill(b'?');
        }
        before = byte;
    }
}

/// Writes `rows` as columns, each as wide as its widest cell; numbers to the right, for people.
pub fn table(output: &mut Output<'_>, rows: &[Vec<String>]) -> Result<(), End> {
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

/// Returns whether colors may be used: `NO_COLOR` is unset or empty (<https://no-color.org>).
pub fn colors() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

/// The columns of the terminal that `out` is, if it is one that says so.
#[cfg(feature = "record")]
pub fn columns(out: impl std::os::fd::AsFd) -> Option<usize> {
    let size = rustix::termios::tcgetwinsize(out).ok()?;
    Some(usize::from(size.ws_col)).filter(|columns| *columns > 0)
}

/// `parts` with two blanks between them, in at most so many `columns`: of those that do not fit the one with the lowest rank
/// goes first. A number that is cut would be another number. The last one stays, however long.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn line(text: &str) -> String {
        let mut out = Vec::new();
        Output::new(&mut out).line(|line| write!(line, "{text}")).unwrap();
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn text_does_not_command_a_terminal() {
        assert_eq!(line("\x1b[2J a\rb\nc\td \x7f"), "?[2J a?b c?d ?\n");
        assert_eq!(line("\u{80}x\u{9b}31m\u{9f}"), "??x??31m??\n");
        assert_eq!(line("/dev/ttyUSB0 \u{a0}20 °C ● Größe"), "/dev/ttyUSB0 \u{a0}20 °C ● Größe\n");
    }

    #[test]
    fn json_says_what_is_there() {
        let mut out = Vec::new();
        Output::new(&mut out).json(&"\x1b[2J\n\u{9b}2J").unwrap();
        assert_eq!(out, b"\"\\u001b[2J\\n\\u009b2J\"\n");
    }

    #[cfg(feature = "record")]
    #[test]
    fn what_does_not_fit_goes_whole() {
        let parts = || [(2, "0:00:10"), (0, "6.0 KiB/s"), (1, "903 samples"), (3, "0 lost")];
        let in_columns =
            |columns| fitting(parts().map(|(rank, part)| (rank, part.to_owned())).into(), columns);
        assert_eq!(in_columns(39), "0:00:10  6.0 KiB/s  903 samples  0 lost");
        assert_eq!(in_columns(38), "0:00:10  903 samples  0 lost");
        assert_eq!(in_columns(27), "0:00:10  0 lost");
        assert_eq!(in_columns(14), "0 lost");
        assert_eq!(in_columns(1), "0 lost");
    }
}
