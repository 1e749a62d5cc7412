//! What the hub publishes of what a simulated sensor sees: its words, split by the hub's own decoder. A file by itself,
//! for benches that need no stage.

use daemon::scanner;
use lms::measured::{self, Measured};
use lms::variant::{Mode, Unit};
use schema::Scan;

/// Measuring mode of all scans here: 13 bits of range, 3 of intensity.
pub(crate) const MODE: Mode = Mode(1);

/// The scan of `words` in `unit` and [`MODE`].
pub(crate) fn scan(words: &[u16], unit: Unit) -> Box<Scan> {
    let telegram = measured::encode(0, unit, words, 0x10);
    let measured = Measured::decode(telegram.telegram()).expect("as many words as a variant has");
    let mut scan = Scan::zeroed(scanner::len(&measured));
    scanner::decode(&measured, MODE, &mut scan);
    scan
}
