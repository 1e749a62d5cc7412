//! Reader and converter of recordings: MCAP files of the hub (feature `mcap`), streams of telegrams as they arrived on
//! a line, and CARMEN logs, each plain or gzipped.
//!
//! All formats yield complete telegrams as [`Frame`]s, which the simulator can send and a hub can read. [`Contents`]
//! describes the sensors and the encoding of the values, if the file contains them. This crate reads no clock and opens
//! no port.

mod carmen;
#[cfg(feature = "mcap")]
pub mod convert;
#[cfg(feature = "mcap")]
mod mcap;
mod open;
mod stream;

use std::fmt;

use scanhub_drivers::lms::measured::{MEASURED, MeasuredValues, nominal_period};
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_schema::{Family, Nanos};

pub use carmen::{BEYOND_RANGE_OFFSET, UnencodableRanges, UnreadLines};
pub use open::Recording;
pub use stream::VirtualTime;

/// Telegram of a recording, or the packets that a hub received together.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Frame {
    /// Complete telegram, from STX to checksum; for families other than LMS, complete packets. From a stream file, the
    /// bytes are exactly those that were received.
    pub telegram: Vec<u8>,
    /// Number of the scanner's [`Family`].
    pub family: u8,
    /// Time of the measurement, in nanoseconds since 1970, if the recording contains it.
    pub wall_ns: Option<u64>,
    /// Time of the measurement on the scanner's clock, in nanoseconds since the first frame, if the recording has no
    /// other time.
    pub scanner_ns: Option<u64>,
    /// Reasons why the telegram is suspect, as bits of [`scanhub_drivers::line::suspect`].
    pub reasons: u8,
    /// Header that the hub published. Streams and logs have no headers.
    pub header: Option<scanhub_schema::Header>,
}

/// Record of an MCAP file that is needed to replay the angles of a mount.
#[derive(Clone, Copy, Debug)]
pub enum MountRecord {
    /// Angle of the mount.
    Angle(scanhub_schema::Header, scanhub_schema::Tilt),
    /// Header of a telegram from a sensor of the mount's machine. Its stamps are from the same clock as the stamps of
    /// the mount.
    Telegram(scanhub_schema::Header),
}

impl Frame {
    /// Returns whether the frame is a telegram of measured values (B0h), which an LMS streams.
    pub fn is_scan(&self) -> bool {
        is_scan(self.family, &self.telegram)
    }

    /// Returns whether the frame reports the measuring mode, or shows that the mode is no longer known.
    pub fn has_mode(&self) -> bool {
        let reply = Telegram::check(&self.telegram).and_then(Reply::decode);
        reply.is_some_and(|reply| reply.mode().is_some())
    }
}

pub(crate) fn is_scan(family: u8, telegram: &[u8]) -> bool {
    family == Family::Lms as u8 && telegram.get(4) == Some(&MEASURED)
}

/// Encoding of ranges as value words. The ranges of a log are text in meters, so an encoding must be chosen for a log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Encoding {
    /// Unit of the ranges.
    pub unit: Unit,
    /// Meaning of the 16 bits of a value.
    pub mode: Mode,
}

impl Default for Encoding {
    /// Returns millimeters in 13 bits.
    fn default() -> Encoding {
        Encoding { unit: Unit::Mm, mode: Mode(0) }
    }
}

impl fmt::Display for Encoding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "values of {} mm in {} bits", self.unit.mm(), self.mode.range_bits())
    }
}

/// Format of a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Form {
    /// Bytes as they arrived on a line.
    Telegrams,
    /// A CARMEN log.
    Carmen,
    /// An MCAP file of `scanhub record`.
    #[default]
    Mcap,
}

/// Contents of a recording, including what it reports about the sensor.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Contents {
    /// Format of the file.
    pub form: Form,
    /// Number of the first sensor's [`Family`]. For a log, it is the number of family LMS.
    pub family: u8,
    /// Number of another family to which some telegrams belong. `None` if all telegrams belong to `family`.
    pub other_family: Option<u8>,
    /// Names of the sensors, in order of appearance; a stream and a log name no sensor.
    pub sensors: Vec<String>,
    /// Number of complete telegrams; for a log, number of scans.
    pub telegrams: u64,
    /// Number of unpacked bytes of a stream; 0 for other forms.
    pub bytes: u64,
    /// Number of telegrams with measured values (B0h).
    pub scans: u64,
    /// Times of the first and the last telegram, in ns since 1970, if there are stamps.
    pub span: Option<(u64, u64)>,
    /// Duration on the scanner's clock, in ns, if the recording has no other time.
    pub scanner_ns: Option<u64>,
    /// Number of beams in the recorded scans of a rotating scanner.
    pub beams: Option<u16>,
    /// Name of the model of a rotating scanner, if a status reports it.
    pub model: Option<&'static str>,
    /// Name of the scan mode of a rotating scanner, if a status reports it.
    pub mode_name: Option<&'static str>,
    /// Number of the sensor's family, and its type, as in the first status that has a type.
    pub sensor_type: Option<(u8, String)>,
    /// Angle between two beams of a rotating scanner, in 1/100 degree, if a status reports it.
    pub step_cdeg: Option<u16>,
    /// Variant of the first scan.
    pub variant: Option<Variant>,
    /// Unit of the first scan; for a log the unit in which its ranges are whole values.
    pub unit: Option<Unit>,
    /// Measuring mode, if a configuration reply (F4h) or a status contains it; for a log, a mode whose values can hold
    /// the ranges of the log.
    pub mode: Option<Mode>,
    /// All bits that are set in at least one value of the scans; 0 for a log.
    pub bits: u16,
    /// Ranges of a log that its unit and mode cannot encode.
    pub unencodable: UnencodableRanges,
    /// Data of a log that its scans do not contain.
    pub unread: UnreadLines,
    /// Counts of data that could not be read. [`telegrams`](Recording::telegrams) returns all readable telegrams.
    pub damage: Damage,
}

impl Contents {
    /// Returns the measuring mode for reading the values. If the recording contains no mode, and no value has more than
    /// 13 bits, this is the mode of 13 bits, because such values mean the same in all modes. Returns `None` if the
    /// values have several possible meanings.
    pub fn readable_mode(&self) -> Option<Mode> {
        let plain = Mode(0x00);
        self.mode.or((self.bits <= plain.max_value()).then_some(plain))
    }

    /// Returns the number of the measuring mode for reading the values: the mode in the recording, otherwise
    /// `configured`, otherwise the [readable](Self::readable_mode) mode.
    pub fn mode_or(&self, configured: Option<u8>) -> Option<u8> {
        self.mode.map(|mode| mode.0).or(configured).or(self.readable_mode().map(|mode| mode.0))
    }

    /// Returns the encoding of values in the measuring mode with the number `mode`.
    pub fn encoding(&self, mode: Option<u8>) -> Encoding {
        let default = Encoding::default();
        Encoding { unit: self.unit.unwrap_or(default.unit), mode: mode.map_or(default.mode, Mode) }
    }

    /// Returns the time from a scan of `beams` beams to the next one, for a recording without stamps. If no variant in
    /// the telegram listing has this number of beams, the result is the period of the first scan.
    pub fn period(&self, beams: usize) -> Nanos {
        let variant = Variant::of_beams(beams).or(self.variant).unwrap_or(Variant::HALF);
        nominal_period(variant.beams(), Baud::B500000.rate())
    }

    /// Returns whether the first sensor is an LMS.
    pub fn is_lms(&self) -> bool {
        self.family == Family::Lms as u8
    }

    /// Counts a telegram of a sensor of `family`, and stores what it reports about the sensor.
    pub(crate) fn note(&mut self, family: u8, telegram: &[u8], wall_ns: Option<u64>) {
        if self.telegrams == 0 {
            self.family = family;
        } else if family != self.family {
            self.other_family.get_or_insert(family);
        }
        self.telegrams += 1;
        self.note_time(wall_ns);
        if family != Family::Lms as u8 {
            return;
        }
        let Some(telegram) = Telegram::check(telegram) else { return };
        if let Some(Reply::Configuration(configuration)) = Reply::decode(telegram) {
            self.mode = self.mode.or(Some(configuration.mode()));
        }
        if let Some(measured) = MeasuredValues::decode(telegram) {
            self.scans += 1;
            self.variant = self.variant.or(Variant::of_beams(measured.count()));
            self.unit = self.unit.or(Some(measured.unit()));
            self.bits = measured.words().fold(self.bits, |bits, word| bits | word);
        }
    }

    /// Counts a scan of a log.
    pub(crate) fn note_scan(&mut self, variant: Option<Variant>, wall_ns: Option<u64>) {
        self.telegrams += 1;
        self.scans += 1;
        self.note_time(wall_ns);
        self.variant = self.variant.or(variant);
    }

    fn note_time(&mut self, wall_ns: Option<u64>) {
        if let Some(wall_ns) = wall_ns {
            let (first_ns, last_ns) = self.span.unwrap_or((wall_ns, wall_ns));
            self.span = Some((first_ns, last_ns.max(wall_ns)));
        }
    }
}

/// Counts of data that could not be read; all zero if the file is intact.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Damage {
    /// Number of sequence numbers that are missing between those of other telegrams. Either the file or the recorder
    /// lost the telegrams with these numbers.
    pub telegrams: u64,
    /// Number of bytes that were not used: bytes of damaged chunks and records, bytes after a position at which the
    /// structure of the file is lost, and bytes outside the telegrams of a stream.
    pub bytes: u64,
    /// Number of chunks that were skipped because they are damaged.
    pub chunks: u64,
    /// Number of chunks that were skipped because the same chunk had been read before.
    pub repeats: u64,
    /// Whether the file ends without its index, for example because the recorder was killed.
    pub is_truncated: bool,
    /// Whether the file was changed after it was written: a checksum or a length is wrong.
    pub is_damaged: bool,
}

impl Damage {
    /// Returns whether nothing is missing or damaged.
    pub fn is_none(&self) -> bool {
        *self == Damage::default()
    }
}

impl fmt::Display for Damage {
    /// Writes the counts as one line, or `nothing` if all counts are 0.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counted = |count: u64, one: &str, more: &str| match count {
            0 => None,
            1 => Some(format!("1 {one}")),
            count => Some(format!("{count} {more}")),
        };
        let parts = [
            counted(self.telegrams, "telegram", "telegrams"),
            counted(self.chunks, "chunk", "chunks"),
            counted(self.repeats, "chunk that the file has twice", "chunks that the file has twice"),
            counted(self.bytes, "byte that could not be used", "bytes that could not be used"),
            self.is_truncated.then(|| "the end of the file, with its index".to_owned()),
        ];
        let parts: Vec<_> = parts.into_iter().flatten().collect();
        match (&parts[..], self.is_damaged) {
            ([], true) => f.write_str("no telegram, but a checksum is wrong"),
            ([], false) => f.write_str("nothing"),
            _ => f.write_str(&parts.join(", ")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damage_lists_missing_parts() {
        assert_eq!(Damage::default().to_string(), "nothing");
        let damage = Damage { telegrams: 2, chunks: 1, is_truncated: true, ..Damage::default() };
        let words = "2 telegrams, 1 chunk, the end of the file, with its index";
        assert_eq!(damage.to_string(), words);
        let damage = Damage { is_damaged: true, ..Damage::default() };
        assert_eq!(damage.to_string(), "no telegram, but a checksum is wrong");
    }
}
