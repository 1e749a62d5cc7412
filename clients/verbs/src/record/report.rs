//! Reports of a recorder: JSON lines, or text with one progress line that is redrawn.

use std::io::{self, Write};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::queue::{Gap, RecordStats, WriterEvent};
use crate::follow::Notice;
use crate::names::TopicName;
use crate::output::{ExitReason, Output, columns, fitting};
use crate::receive_stats::ReceiveStats;
use crate::{json, text};

/// Format of the reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ReportForm {
    /// Lines of text at the start, at the end, and for each event.
    Lines,
    /// JSON lines at the start, at the end, for each event, and once a second.
    Json,
    /// Lines of text, and a progress line that is redrawn.
    Terminal,
}

impl ReportForm {
    /// Returns the format for this output.
    pub(super) fn of(is_json: bool, is_terminal: bool) -> ReportForm {
        match (is_json, is_terminal) {
            (true, _) => ReportForm::Json,
            (false, true) => ReportForm::Terminal,
            (false, false) => ReportForm::Lines,
        }
    }
}

/// Reports of a run, with their counters.
pub(super) struct Report<'a> {
    form: ReportForm,
    out: Output<'a>,
    notes: Output<'a>,
    /// Terminal that shows the progress line. The number of its columns is read from here.
    terminal: Option<OwnedFd>,
    started: Instant,
    next: Instant,
    files: Vec<PathBuf>,
    /// Number of bytes in the last report of progress.
    bytes: u64,
    /// Number of samples that were published, but that this program did not receive.
    missed: u64,
    /// Number of samples in files that were removed or truncated.
    removed: u64,
    is_write_failing: bool,
}

/// Interval between reports of progress.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);

impl<'a> Report<'a> {
    /// Creates the reports of a run. They go to `out`, which may be `terminal`. Notices go to `notes` unless `out` is
    /// JSON.
    pub(super) fn new(
        form: ReportForm,
        out: &'a mut dyn Write,
        notes: &'a mut dyn Write,
        terminal: Option<OwnedFd>,
    ) -> Report<'a> {
        let now = Instant::now();
        Report {
            form,
            out: Output::new(out),
            notes: Output::new(notes),
            terminal,
            started: now,
            next: now + REPORT_INTERVAL,
            files: Vec::new(),
            bytes: 0,
            missed: 0,
            removed: 0,
            is_write_failing: false,
        }
    }

    /// Writes the first line, which contains the `path` of the file, and the number `older` of files of earlier runs
    /// that are removed once the new file has samples.
    pub(super) fn begin(&mut self, path: &Path, older: usize) -> Result<(), ExitReason> {
        self.files.push(path.to_owned());
        if self.form == ReportForm::Json {
            let first = ProgressJson { older_removed: Some(older), ..self.at(&RecordStats::default(), 0) };
            return self.out.json(&first);
        }
        self.out.line(|line| {
            write!(line, "records into {}", path.display())?;
            match older {
                0 => Ok(()),
                1 => write!(line, "; the first sample in it removes 1 file of an earlier run (--keep)"),
                _ => write!(line, "; the first sample in it removes {older} files of earlier runs (--keep)"),
            }
        })
    }

    /// Reports events of the hub, and missed samples.
    pub(super) fn hub(&mut self, names: &[Rc<TopicName>], notice: Notice) -> Result<(), ExitReason> {
        if let Notice::Missed(missed) = notice {
            self.missed += missed;
        }
        if self.form == ReportForm::Json {
            return json::notices(&mut self.out, names, &notice);
        }
        self.note(|line| text::notice(line, names, &notice))
    }

    /// Reports an event of the disk thread.
    pub(super) fn disk(&mut self, event: &WriterEvent) -> Result<(), ExitReason> {
        self.is_write_failing = match event {
            WriterEvent::WriteFailed(..) => true,
            WriterEvent::WriteResumed(..) => false,
            WriterEvent::File(_) | WriterEvent::Removed(..) | WriterEvent::ReaderClosed => {
                self.is_write_failing
            }
        };
        match event {
            WriterEvent::File(path) => self.files.push(path.clone()),
            WriterEvent::Removed(_, samples) => self.removed += samples,
            _ => {}
        }
        if self.form == ReportForm::Json {
            let of = |kind, path: &Path| DiskJson {
                class: "notice",
                kind,
                file: path.display().to_string(),
                message: None,
                seconds: None,
                samples: None,
            };
            let notice = match event {
                WriterEvent::File(path) => of("file", path),
                WriterEvent::WriteFailed(path, message) => {
                    DiskJson { message: Some(message), ..of("write_failed", path) }
                }
                WriterEvent::WriteResumed(path, after) => {
                    DiskJson { seconds: Some(after.as_secs_f64()), ..of("write_resumed", path) }
                }
                WriterEvent::Removed(path, samples) => {
                    DiskJson { samples: Some(*samples), ..of("file_removed", path) }
                }
                WriterEvent::ReaderClosed => return Ok(()),
            };
            return self.out.json(&notice);
        }
        self.note(|line| match event {
            WriterEvent::File(path) => write!(line, "continues in {}", path.display()),
            WriterEvent::WriteFailed(path, message) => {
                let path = path.display();
                write!(
                    line,
                    "cannot write {path}: {message}; samples are kept in memory, and writing is tried again"
                )
            }
            WriterEvent::WriteResumed(path, after) => {
                write!(line, "{} is written again, after {:.1} s", path.display(), after.as_secs_f64())
            }
            WriterEvent::Removed(path, samples) => {
                write!(line, "{} was removed or truncated: its {samples} samples are lost", path.display())
            }
            WriterEvent::ReaderClosed => Ok(()),
        })
    }

    /// Reports the start of a gap, in which samples are dropped.
    pub(super) fn gap_begins(&mut self) -> Result<(), ExitReason> {
        if self.form == ReportForm::Json {
            let (dropped, seconds) = (0, 0.0);
            return self.out.json(&DroppedJson { class: "notice", kind: "gap_begins", dropped, seconds });
        }
        self.note(|line| write!(line, "memory for samples is full: samples are dropped from the recording"))
    }

    /// Reports the end of a gap, with the number of dropped samples.
    pub(super) fn gap_ends(&mut self, gap: &Gap) -> Result<(), ExitReason> {
        let dropped = gap.dropped.iter().map(|(_, count)| count).sum();
        let seconds = gap.to_ns.saturating_sub(gap.from_ns) as f64 / 1e9;
        if self.form == ReportForm::Json {
            return self.out.json(&DroppedJson { class: "notice", kind: "gap_ends", dropped, seconds });
        }
        self.note(|line| {
            write!(line, "records again: {dropped} samples of {seconds:.1} s are not in the recording (")?;
            for (at, (name, count)) in gap.dropped.iter().enumerate() {
                write!(line, "{}{name} {count}", if at == 0 { "" } else { ", " })?;
            }
            write!(line, ")")
        })
    }

    /// Reports the progress once a second, to a terminal or as JSON.
    pub(super) fn progress(&mut self, written: &RecordStats, dropped: u64) -> Result<(), ExitReason> {
        if Instant::now() < self.next {
            return Ok(());
        }
        self.next = Instant::now() + REPORT_INTERVAL;
        match self.form {
            ReportForm::Lines => Ok(()),
            ReportForm::Json => {
                let progress = self.at(written, dropped);
                self.out.json(&progress)
            }
            ReportForm::Terminal => {
                // If the line is still too long, let the terminal cut it, because a wrapped line could not be redrawn.
                let columns = self.terminal.as_ref().and_then(columns).unwrap_or(usize::MAX - 2);
                let status = fitting(self.status(written, dropped), columns);
                let line = [CLEAR_LINE, b"\x1b[?7l", status.as_bytes(), b"\x1b[?7h"].concat();
                self.bytes = written.bytes;
                self.out.raw(&line)
            }
        }
    }

    /// Reports the counters of a topic.
    pub(super) fn topic(&mut self, name: &TopicName, stats: &ReceiveStats) -> Result<(), ExitReason> {
        if self.form == ReportForm::Json {
            return self.out.json(&json::summary(name, stats));
        }
        self.clear_line()?;
        self.out.line(|line| text::summary(line, name, stats))
    }

    /// Reports the completed recording.
    pub(super) fn end(&mut self, written: &RecordStats, dropped: u64) -> Result<(), ExitReason> {
        let RecordStats { bytes, samples, .. } = *written;
        if self.form == ReportForm::Json {
            return self.out.json(&RecordedJson {
                class: "recorded",
                files: self.files.iter().map(|file| file.display().to_string()).collect(),
                bytes,
                samples,
                missed: self.missed,
                dropped,
                removed: self.removed,
                seconds: self.started.elapsed().as_secs_f64(),
            });
        }
        self.clear_line()?;
        let removed = self.removed;
        let files = &self.files;
        self.out.line(|line| {
            match &files[..] {
                [file] => write!(line, "{}", file.display())?,
                [first, .., last] => {
                    write!(line, "{} to {}", first.display(), last.display())?;
                }
                [] => {}
            }
            write!(line, ": {samples} samples, {}", size(bytes))?;
            if dropped > 0 {
                write!(line, ", {dropped} dropped")?;
            }
            if removed > 0 {
                write!(line, ", {removed} in files that were removed or truncated")
            } else {
                Ok(())
            }
        })
    }

    fn at(&self, written: &RecordStats, dropped: u64) -> ProgressJson {
        ProgressJson {
            class: "recording",
            file: self.files.last().map(|file| file.display().to_string()),
            bytes: written.bytes,
            samples: written.samples,
            missed: self.missed,
            dropped,
            seconds: self.started.elapsed().as_secs_f64(),
            older_removed: None,
        }
    }

    /// Returns the parts of the progress line with their ranks. The part about lost samples has the highest rank.
    fn status(&self, written: &RecordStats, dropped: u64) -> Vec<(u8, String)> {
        let seconds = self.started.elapsed().as_secs();
        let rate = written.bytes.saturating_sub(self.bytes) / REPORT_INTERVAL.as_secs();
        let problem = self.is_write_failing.then(|| (4, "write failed".to_owned()));
        let parts = [
            (3, format!("{}:{:02}:{:02}", seconds / 3600, seconds / 60 % 60, seconds % 60)),
            (1, size(written.bytes)),
            (0, format!("{}/s", size(rate))),
            (2, format!("{} samples", written.samples)),
            (5, format!("{} lost", self.missed + dropped + self.removed)),
        ];
        problem.into_iter().chain(parts).collect()
    }

    /// Writes a notice.
    fn note(&mut self, build: impl FnOnce(&mut Vec<u8>) -> io::Result<()>) -> Result<(), ExitReason> {
        self.clear_line()?;
        self.notes.line(build)
    }

    fn clear_line(&mut self) -> Result<(), ExitReason> {
        match self.form {
            ReportForm::Terminal => self.out.raw(CLEAR_LINE),
            ReportForm::Json | ReportForm::Lines => Ok(()),
        }
    }
}

/// Formats a size in bytes for users, such as `1.5 MiB`.
fn size(bytes: u64) -> String {
    let units = [("GiB", 30), ("MiB", 20), ("KiB", 10)];
    match units.into_iter().find(|(_, bits)| bytes >> bits > 0) {
        Some((unit, bits)) => format!("{:.1} {unit}", bytes as f64 / (1_u64 << bits) as f64),
        None => format!("{bytes} B"),
    }
}

/// JSON line of class `recording`.
#[derive(Serialize)]
struct ProgressJson {
    class: &'static str,
    file: Option<String>,
    bytes: u64,
    samples: u64,
    missed: u64,
    dropped: u64,
    seconds: f64,
    /// Number of files of earlier runs that will be removed; only in the first line.
    #[serde(skip_serializing_if = "Option::is_none")]
    older_removed: Option<usize>,
}

/// JSON line of class `recorded`, the last one.
#[derive(Serialize)]
struct RecordedJson {
    class: &'static str,
    files: Vec<String>,
    bytes: u64,
    samples: u64,
    missed: u64,
    dropped: u64,
    removed: u64,
    seconds: f64,
}

/// JSON line of class `notice` about the disk.
#[derive(Serialize)]
struct DiskJson<'a> {
    class: &'static str,
    kind: &'static str,
    file: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    message: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    seconds: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    samples: Option<u64>,
}

/// JSON line of class `notice` about dropped samples.
#[derive(Serialize)]
struct DroppedJson {
    class: &'static str,
    kind: &'static str,
    dropped: u64,
    seconds: f64,
}

/// Moves the cursor to the start of the line, and erases it (ECMA-48).
const CLEAR_LINE: &[u8] = b"\r\x1b[K";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_sizes_with_binary_units() {
        assert_eq!(
            [0, 1023, 1024, 5 << 19, 3 << 30].map(size),
            ["0 B", "1023 B", "1.0 KiB", "2.5 MiB", "3.0 GiB"]
        );
    }
}
