//! Scans as the hub publishes them, from the values that a simulated LMS sends: the hub's own decoder splits them.

use scanhub_drivers::lms::measured::{self, MeasuredValues};
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_schema::Scan;

/// Measuring mode of the scans: 13 bits of range, 3 of intensity.
pub(crate) const MODE: Mode = Mode(1);

/// Returns the scan that the hub publishes for the values `words` of an LMS, in `unit` and [`MODE`].
pub(crate) fn scan(words: &[u16], unit: Unit) -> Box<Scan> {
    let telegram = measured::encode(0, unit, words, 0x10);
    let measured = MeasuredValues::decode(telegram.telegram()).expect("as many words as a variant has");
    let raw = measured.scan(MODE);
    let mut scan = Scan::zeroed(raw.payload_len());
    raw.write(&mut scan);
    scan
}
