//! Scans as the hub publishes them, decoded by the hub's own decoder from the values that a simulated LMS sends.

use scanhub_drivers::lms::measured::{self, MeasuredValues};
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_schema::Scan;

/// Measuring mode of the scans: 13 bits of range and 3 bits of intensity.
pub(crate) const MODE: Mode = Mode(1);

/// Returns the scan that the hub publishes when an LMS sends the values `words` in `unit` and [`MODE`].
pub(crate) fn scan(words: &[u16], unit: Unit) -> Box<Scan> {
    let telegram = measured::encode(0, unit, words, 0x10);
    let measured =
        MeasuredValues::decode(telegram.telegram()).expect("a number of values that an LMS variant has");
    let raw = measured.scan(MODE);
    let mut scan = Scan::zeroed(raw.payload_len());
    raw.write(&mut scan);
    scan
}
