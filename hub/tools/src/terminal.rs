//! Output of the commands: whole lines of text or JSON, and progress on a terminal.

use std::io::{ErrorKind, IsTerminal, Write, stderr};

use scanhub_schema::{Failure, Kind, Printable, json_line};
use serde::Serialize;

/// Writes `value` as a line of JSON, or as text. Succeeds if the reader has closed the output.
///
/// # Errors
///
/// Returns [`Kind::Failed`] if the line cannot be written, as on a full disk.
pub(crate) fn print(
    out: &mut dyn Write,
    json: bool,
    value: &impl Serialize,
    text: impl FnOnce() -> String,
) -> Result<(), Failure> {
    let line = if json { json_line(serde_json::to_string(value).unwrap_or_default()) } else { text() };
    // One write for each line, so that a killed command leaves no partial line.
    match out.write_all(format!("{}\n", Printable(&line)).as_bytes()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::new(Kind::Failed, format!("cannot write: {error}"), ""))
        }
        _ => Ok(()),
    }
}

/// Progress of a command: one line on stderr that the next text overwrites. Shows no text if stderr is not a terminal.
pub(crate) struct Progress {
    is_terminal: bool,
    /// Whether the line has a text.
    is_shown: bool,
}

impl Progress {
    /// Creates an empty line.
    pub(crate) fn on_stderr() -> Progress {
        Progress { is_terminal: stderr().is_terminal(), is_shown: false }
    }

    /// Replaces the line by `text`.
    pub(crate) fn show(&mut self, text: &str) {
        if self.is_terminal {
            let _ = write!(stderr(), "\r\x1b[K{text} ..");
            self.is_shown = true;
        }
    }

    /// Removes the line.
    pub(crate) fn clear(&mut self) {
        if std::mem::take(&mut self.is_shown) {
            let _ = write!(stderr(), "\r\x1b[K");
        }
    }

    /// Keeps the last text on its own line, because that step failed and its reason is printed next.
    pub(crate) fn keep_text(&mut self) {
        if std::mem::take(&mut self.is_shown) {
            let _ = writeln!(stderr());
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.clear();
    }
}
