//! The scanner that a search found at a link's port, as a line of text. The next search begins with it. A wrong scanner
//! costs only time.

use scanhub_drivers::line::grid::BEAMS;
use scanhub_drivers::search::Memory;
use scanhub_drivers::{Model, features};
use schema::Family;

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

/// Returns the line for `scanner` at `port`.
pub(super) fn text(scanner: &KnownScanner, port: &str) -> String {
    let KnownScanner { memory: Memory { family, stream_rate, reply_rate }, model, beams } = scanner;
    let model = model.as_deref().filter(|model| !model.contains(char::is_whitespace)).unwrap_or(UNKNOWN);
    let beams = beams.map_or(UNKNOWN.to_owned(), |beams| beams.to_string());
    format!("{} {model} {stream_rate} {reply_rate} {beams} {port}\n", family.name())
}

/// Returns the scanner and the port in `text`. Returns `None` if it is damaged.
pub(super) fn read(text: &str) -> Option<(KnownScanner, &str)> {
    let mut words = text.strip_suffix('\n')?.splitn(6, ' ');
    let mut word = || words.next().filter(|word| !word.is_empty());
    let (family, model) = (Family::parse(word()?)?, word()?);
    let (stream_rate, reply_rate) = (word()?.parse().ok()?, word()?.parse().ok()?);
    let beams = match word()? {
        UNKNOWN => None,
        beams => Some(beams.parse().ok()?),
    };
    let model = (model != UNKNOWN).then(|| model.to_owned());
    Some((KnownScanner { memory: Memory { family, stream_rate, reply_rate }, model, beams }, word()?))
}

/// Stands for a model, or a number of beams, that is not known.
const UNKNOWN: &str = "-";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_it_writes_and_rejects_damaged_text() {
        let port = "/dev/serial/by-id/usb-FTDI 1";
        let memory = Memory { family: Family::Lms, stream_rate: 500_000, reply_rate: 9_600 };
        for (model, beams, line) in [
            (Some("lms291"), None, "lms lms291 500000 9600 - "),
            (None, Some(450), "lms - 500000 9600 450 "),
            (Some("a b"), None, "lms - "),
        ] {
            let scanner = KnownScanner { memory, model: model.map(str::to_owned), beams };
            let text = text(&scanner, port);
            assert!(text.starts_with(line), "{text}");
            let model = model.filter(|model| *model != "a b").map(str::to_owned);
            let known = KnownScanner { memory, model, beams };
            assert_eq!(read(&text), Some((known, port)));
            for len in 0..text.len() {
                assert_eq!(read(&text[..len]), None, "cut after {len} bytes");
            }
        }
        for damaged in [
            "sick - 1 2 - /x\n",
            "ld - x 2 - /x\n",
            "ld - 1 2 - \n",
            "ld  1 2 - /x\n",
            "ld - 1 2 x /x\n",
            "\n",
        ] {
            assert_eq!(read(damaged), None, "{damaged:?}");
        }
    }
}
