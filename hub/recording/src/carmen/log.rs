//! The scans of a log in their order, and how they are encoded. If a log contains each scan in several message types, only
//! those of the first type are used. Refuses to know what a scan becomes.

use std::io::{self, BufRead, Read};

use lms::variant::{Mode, Unit};

use super::{LineForm, Sweep, Unread};
use crate::Encoding;

/// Reads a log.
pub(crate) struct Log<R> {
    reader: R,
    /// Number of the last line.
    pub(crate) line: u64,
    /// How the first scan is written.
    form: Option<LineForm>,
    /// What the log says itself.
    pub(crate) told: Option<Encoding>,
    /// Data of the lines so far that the scans do not contain.
    pub(crate) unread: Unread,
}

/// Why there is no next scan.
#[derive(Debug)]
pub(crate) enum Wrong {
    /// What is wrong with the line.
    Line(String),
    /// The file cannot be read.
    File(io::Error),
}

impl<R: BufRead> Log<R> {
    pub(crate) fn new(reader: R) -> Self {
        Log { reader, line: 0, form: None, told: None, unread: Unread::default() }
    }

    /// The next scan. A last line without its end that is no scan is where the recording broke off, not a mistake.
    pub(crate) fn next(&mut self) -> Result<Option<Sweep>, Wrong> {
        let mut bytes = Vec::new();
        loop {
            bytes.clear();
            if self.reader.by_ref().take(LONGEST).read_until(b'\n', &mut bytes).map_err(Wrong::File)? == 0 {
                return Ok(None);
            }
            self.line += 1;
            let is_last = bytes.last() != Some(&b'\n') && bytes.len() < LONGEST as usize;
            let line = String::from_utf8_lossy(&bytes);
            if let Some(encoding) = told(&line) {
                self.told = self.told.or(Some(encoding));
            }
            match Sweep::parse(&line) {
                Ok(None) => match line.split_ascii_whitespace().next() {
                    Some("ODOM") => self.unread.odometry += 1,
                    Some(word) if !word.starts_with('#') => self.unread.lines += 1,
                    _ => {}
                },
                Ok(Some(sweep)) if *self.form.get_or_insert(sweep.form) != sweep.form => {
                    self.unread.lines += 1;
                }
                Ok(Some(sweep)) => {
                    self.unread.poses += u64::from(sweep.has_pose);
                    self.unread.remissions += u64::from(sweep.has_remissions);
                    return Ok(Some(sweep));
                }
                Err(_) if is_last => return Ok(None),
                Err(wrong) => return Err(Wrong::Line(wrong)),
            }
        }
    }

    /// The next scan of a log that was read before: lines that are wrong are passed over, where it breaks off it ends.
    pub(crate) fn following(&mut self) -> Option<Sweep> {
        loop {
            match self.next() {
                Ok(sweep) => return sweep,
                Err(Wrong::Line(_)) => {}
                Err(Wrong::File(_)) => return None,
            }
        }
    }
}

/// Whether `head`, the beginning of a file, looks like a log.
pub(crate) fn is_log(head: &[u8]) -> bool {
    head.split(|&byte| byte == b'\n').any(|line| FIRST_WORDS.iter().any(|word| line.starts_with(word)))
}

/// The line in which a log says how its ranges are encoded; other programs pass over it.
#[cfg(feature = "mcap")]
pub(crate) fn line_of(encoding: Encoding) -> String {
    format!("{TOLD} {} mm, {} bits\n", encoding.unit.mm(), encoding.mode.range_bits())
}

fn told(line: &str) -> Option<Encoding> {
    let mut fields = line.strip_prefix(TOLD)?.split([' ', ',']).filter(|field| !field.is_empty());
    let (mm, bits) = (fields.next()?, fields.nth(1)?);
    let unit = [Unit::Mm, Unit::Cm, Unit::Dm].into_iter().find(|unit| unit.mm().to_string() == mm)?;
    let mode = super::census::MODES.into_iter().find(|mode: &Mode| mode.range_bits().to_string() == bits)?;
    Some(Encoding { unit, mode })
}

/// How a line of a log begins, at the beginning of the file.
const FIRST_WORDS: [&[u8]; 6] =
    [b"FLASER ", b"ROBOTLASER1 ", b"RAWLASER1 ", b"PARAM ", b"ODOM ", b"# message formats"];
/// How the line begins that says how ranges are encoded.
const TOLD: &str = "# LMS 2xx values:";
/// No line is longer.
const LONGEST: u64 = 1 << 20;
