//! Knowledge of the scanner at a link's port, for the next hub: the scanner that a search found, and the rate at which a
//! session found it. Each is a line of text in its own file, and ends with the port. Wrong knowledge costs only time.
//!
//! After power-on, a scanner has the same rate each time, so a search that starts there saves the timeouts of the other
//! rates.

use std::sync::Mutex;

use scanhub_drivers::line::KnownRate;
use scanhub_drivers::line::grid::BEAMS;
use scanhub_drivers::search::Memory;
use scanhub_drivers::{Model, features};
use schema::Family;

use super::{Files, held};

/// Scanner that was found at a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KnownScanner {
    /// Family and rates.
    pub memory: Memory,
    /// Name of the model in lower case, if the scanner has reported it.
    pub model: Option<String>,
    /// Number of beams of its scans, if the session has measured it.
    pub beams: Option<usize>,
}

impl KnownScanner {
    /// Returns the model and the number of beams, if both are known.
    pub(crate) fn beams_of_model(&self) -> Option<(Model, usize)> {
        let models = features(self.memory.family).models;
        let model = models.iter().find(|model| self.model.as_deref() == Some(model.name))?;
        Some((*model, self.beams.filter(|beams| BEAMS.contains(beams))?))
    }
}

/// Knowledge that consists of words without spaces.
pub(super) trait Knowledge: Clone + PartialEq {
    /// Extension of the file's name.
    const EXTENSION: &'static str;
    /// Number of words.
    const WORDS: usize;

    /// Returns the words, with a space between two of them.
    fn fields(&self) -> String;

    /// Parses the words. Returns `None` if they are damaged.
    fn parse(words: &[&str]) -> Option<Self>;
}

impl Knowledge for KnownScanner {
    const EXTENSION: &'static str = "scanner";
    const WORDS: usize = 5;

    fn fields(&self) -> String {
        let KnownScanner { memory: Memory { family, stream_rate, reply_rate }, model, beams } = self;
        let model = model.as_deref().filter(|model| !model.contains(char::is_whitespace));
        let (model, beams) = (model.unwrap_or(UNKNOWN), beams.map(|beams| beams.to_string()));
        let beams = beams.as_deref().unwrap_or(UNKNOWN);
        format!("{} {model} {stream_rate} {reply_rate} {beams}", family.name())
    }

    fn parse(words: &[&str]) -> Option<KnownScanner> {
        let &[family, model, stream_rate, reply_rate, beams] = words else { return None };
        let (stream_rate, reply_rate) = (stream_rate.parse().ok()?, reply_rate.parse().ok()?);
        let beams = if beams == UNKNOWN { None } else { Some(beams.parse().ok()?) };
        let memory = Memory { family: Family::parse(family)?, stream_rate, reply_rate };
        Some(KnownScanner { memory, model: (model != UNKNOWN).then(|| model.to_owned()), beams })
    }
}

impl Knowledge for KnownRate {
    const EXTENSION: &'static str = "rate";
    const WORDS: usize = 1;

    fn fields(&self) -> String {
        match self.silent_switches {
            0 => self.baud.to_string(),
            count => format!("{}{SILENT}{count}", self.baud),
        }
    }

    fn parse(words: &[&str]) -> Option<KnownRate> {
        let &[rate] = words else { return None };
        let (baud, silent_switches) = rate.split_once(SILENT).unwrap_or((rate, "0"));
        Some(KnownRate { baud: baud.parse().ok()?, silent_switches: silent_switches.parse().ok()? })
    }
}

/// Knowledge and its port, which a link replaces and the writer's thread saves.
pub(super) struct Kept<K>(Mutex<State<K>>);

struct State<K> {
    /// Knowledge, and the port that it belongs to.
    known: Option<(K, String)>,
    /// Whether it must be written.
    is_new: bool,
}

impl<K: Knowledge> Kept<K> {
    /// Reads what `files` has about `sensor`, if `is_used`.
    pub(super) fn load(sensor: &str, files: &impl Files, is_used: bool) -> Kept<K> {
        let text = is_used.then(|| files.read(&file_of::<K>(sensor), MAX_LEN));
        let text = text.transpose().unwrap_or_else(|failure| {
            tracing::warn!("{sensor}: {}; {}", failure.message, failure.hint);
            None
        });
        let known = text.flatten().as_deref().and_then(read);
        Kept(Mutex::new(State { known, is_new: false }))
    }

    /// Returns the knowledge of the scanner at `port`.
    pub(super) fn of(&self, port: &str) -> Option<K> {
        let State { known, .. } = &*held(&self.0);
        known.as_ref().filter(|(_, of)| of == port).map(|(known, _)| known.clone())
    }

    /// Replaces the knowledge. Returns whether it was different.
    pub(super) fn keep(&self, port: &str, known: K) -> bool {
        let known = Some((known, port.to_owned()));
        let mut state = held(&self.0);
        let is_new = state.known != known;
        if is_new {
            *state = State { known, is_new };
        }
        is_new
    }

    /// Writes the knowledge of `sensor` if it is new. A link need not wait for the disk.
    pub(super) fn write(&self, sensor: &str, files: &impl Files) {
        let text = {
            let mut state = held(&self.0);
            let is_new = std::mem::take(&mut state.is_new);
            state.known.as_ref().filter(|_| is_new).map(|(known, port)| text(known, port))
        };
        if let Some(text) = text
            && let Err(failure) = files.write(&file_of::<K>(sensor), &text)
        {
            tracing::warn!("{sensor}: {}; {}", failure.message, failure.hint);
        }
    }
}

/// Returns the line for the knowledge of the scanner at `port`.
fn text<K: Knowledge>(known: &K, port: &str) -> String {
    format!("{} {port}\n", known.fields())
}

/// Returns the knowledge and the port in `text`. Returns `None` if it is damaged.
fn read<K: Knowledge>(text: &str) -> Option<(K, String)> {
    let words: Vec<_> = text.strip_suffix('\n')?.splitn(K::WORDS + 1, ' ').collect();
    let (port, known) = words.split_last().filter(|_| words.iter().all(|word| !word.is_empty()))?;
    Some((K::parse(known)?, (*port).to_owned()))
}

fn file_of<K: Knowledge>(sensor: &str) -> String {
    format!("{sensor}.{}", K::EXTENSION)
}

/// Maximum length of a text in bytes: words, and a port, which is at most as long as a path.
const MAX_LEN: u64 = 8_192;
/// Stands for a model, or a number of beams, that is not known.
const UNKNOWN: &str = "-";
/// Stands before the number of switches that were followed by silence.
const SILENT: &str = ",silent=";

#[cfg(test)]
mod tests {
    use super::*;

    const PORT: &str = "/dev/serial/by-id/usb-FTDI 1";

    /// Checks that `known` has this `line`, and that no part of it is read.
    fn check<K: Knowledge + std::fmt::Debug>(known: &K, line: &str) {
        let text = text(known, PORT);
        assert_eq!(text, format!("{line} {PORT}\n"));
        assert_eq!(read(&text), Some((known.clone(), PORT.to_owned())));
        for len in 0..text.len() {
            assert_eq!(read::<K>(&text[..len]), None, "cut after {len} bytes");
        }
    }

    #[test]
    fn reads_what_it_writes_and_rejects_damaged_text() {
        let memory = Memory { family: Family::Lms, stream_rate: 500_000, reply_rate: 9_600 };
        let scanner = KnownScanner { memory, model: Some("lms291".to_owned()), beams: None };
        check(&scanner, "lms lms291 500000 9600 -");
        check(&KnownScanner { model: None, beams: Some(450), ..scanner.clone() }, "lms - 500000 9600 450");
        let spaced = KnownScanner { model: Some("a b".to_owned()), ..scanner };
        assert!(text(&spaced, PORT).starts_with("lms - 500000 "));
        for (silent_switches, line) in [(0, "38400"), (2, "38400,silent=2")] {
            check(&KnownRate { baud: 38_400, silent_switches }, line);
        }
        for damaged in ["sick - 1 2 - /x\n", "ld - x 2 - /x\n", "ld - 1 2 - \n", "ld  1 2 - /x\n"] {
            assert_eq!(read::<KnownScanner>(damaged), None, "{damaged:?}");
        }
        for damaged in ["", "9600\n", "x /dev/x\n", " /dev/x\n", "\n\n", "9600,silent= /x\n"] {
            assert_eq!(read::<KnownRate>(damaged), None, "{damaged:?}");
        }
    }
}
