//! Contents of a recording, what it says about the sensor, and what could not be read.

use std::fmt;

use scanhub_drivers::lms::measured::{Measured, nominal_period};
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use schema::{Family, Nanos};

use crate::{Encoding, Unfit, Unread};

/// What kind of recording it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// Bytes as they came down a line.
    Telegrams,
    /// A CARMEN log.
    Carmen,
    /// An MCAP file of `scanhub record`.
    Mcap,
}

/// What a recording contains, and what it says about the sensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Contents {
    /// Its form.
    pub form: Form,
    /// Of which family its first sensor is, a number of [`Family`]; a log is of an LMS.
    pub family: u8,
    /// Number of another family that telegrams belong to. `None` if all have the same.
    pub other_family: Option<u8>,
    /// Names of the sensors in it, in order of appearance; a stream and a log name none.
    pub sensors: Vec<String>,
    /// Number of whole telegrams; of a log, of scans.
    pub telegrams: u64,
    /// How many of them are measured values (B0h).
    pub scans: u64,
    /// Wall clock of the first and the last telegram, ns since 1970, if there are stamps.
    pub span: Option<(u64, u64)>,
    /// How long it took by the scanner's own clock, in ns, where that is all there is.
    pub scanner_ns: Option<u64>,
    /// Beams of the scans that were recorded of a scanner whose head turns.
    pub beams: Option<u16>,
    /// Name of the model, if it is of a family whose heads turn and a status says it.
    pub model: Option<&'static str>,
    /// Name of the way in which that one measures, if a status says it.
    pub way: Option<&'static str>,
    /// Number of the sensor's family, and its type, as in the first status that has a type.
    pub sensor_type: Option<(u8, String)>,
    /// Angle between two beams in 1/100 degree, of such a one, as a status says it.
    pub step_cdeg: Option<u16>,
    /// Variant of the first scan.
    pub variant: Option<Variant>,
    /// Unit of the first scan; of a log the one in which its ranges are whole values.
    pub unit: Option<Unit>,
    /// Measuring mode, if a configuration reply (F4h) or a status contains it; for a log, a mode whose values reach as far as
    /// its ranges.
    pub mode: Option<Mode>,
    /// Bits that are set in any value of its scans; of a log none.
    pub bits: u16,
    /// Ranges of a log that its unit and mode cannot say.
    pub unfit: Unfit,
    /// Data of a log that its scans do not contain.
    pub unread: Unread,
    /// What is missing in the file; [`telegrams`](crate::Recording::telegrams) returns those that are present.
    pub damage: Damage,
}

impl Contents {
    /// The measuring mode for reading the values: the one in the recording, else the mode of 13 bits if no value has a
    /// higher bit, because then no mode assigns it a meaning. Nothing if the values could be split in several ways.
    pub fn readable(&self) -> Option<Mode> {
        let plain = Mode(0x00);
        self.mode.or((self.bits <= plain.max_value()).then_some(plain))
    }

    /// Returns the number of the measuring mode for reading the values: the one in the recording, or else `configured`, or
    /// else the one that is [readable](Self::readable).
    pub fn mode_or(&self, configured: Option<u8>) -> Option<u8> {
        self.mode.map(|mode| mode.0).or(configured).or(self.readable().map(|mode| mode.0))
    }

    /// Returns the encoding of values in the measuring mode with the number `mode`.
    pub fn encoding(&self, mode: Option<u8>) -> Encoding {
        let default = Encoding::default();
        Encoding { unit: self.unit.unwrap_or(default.unit), mode: mode.map_or(default.mode, Mode) }
    }

    /// Returns the time from a scan of `beams` to the next one, for a recording without stamps. Another number of beams than those of
    /// the listing has the period of the other scans.
    pub fn period(&self, beams: usize) -> Nanos {
        let variant = Variant::of_beams(beams).or(self.variant).unwrap_or(Variant::HALF);
        nominal_period(variant.beams(), Baud::B500000.rate())
    }

    /// Nothing yet.
    pub(crate) fn new(form: Form) -> Contents {
        Contents {
            form,
            family: Family::Lms as u8,
            other_family: None,
            sensors: Vec::new(),
            telegrams: 0,
            scans: 0,
            span: None,
            scanner_ns: None,
            beams: None,
            model: None,
            way: None,
            sensor_type: None,
            step_cdeg: None,
            variant: None,
            unit: None,
            mode: None,
            bits: 0,
            unfit: Unfit::default(),
            unread: Unread::default(),
            damage: Damage::default(),
        }
    }

    /// Returns whether it is of an LMS.
    pub fn is_lms(&self) -> bool {
        self.family == Family::Lms as u8
    }

    /// Counts a telegram of a sensor of `family`, and believes what it says of the sensor.
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
        if let Some(measured) = Measured::decode(telegram) {
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

/// Parts of a recording that could not be read; all zero if the file is intact.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Damage {
    /// Telegrams whose numbers are missing between others. Either the file or the recorder lost them.
    pub telegrams: u64,
    /// Bytes that were not read: those of damaged chunks and records, those after a place where the structure of the file is
    /// lost, and those outside the telegrams of a stream.
    pub bytes: u64,
    /// Chunks that were skipped because they are damaged.
    pub chunks: u64,
    /// Chunks that were skipped because the file has them twice.
    pub repeats: u64,
    /// Whether the file ends without its index, as after a kill.
    pub is_cut: bool,
    /// Whether the file was changed after it was written: a checksum or a length is wrong.
    pub is_harmed: bool,
}

impl Damage {
    /// Returns whether nothing is missing.
    pub fn is_none(&self) -> bool {
        *self == Damage::default()
    }
}

/// In one line, `nothing` if nothing is missing.
impl fmt::Display for Damage {
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
            self.is_cut.then(|| "the end of the file, with its index".to_owned()),
        ];
        let parts: Vec<_> = parts.into_iter().flatten().collect();
        match (&parts[..], self.is_harmed) {
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
    fn lists_what_is_missing() {
        assert_eq!(Damage::default().to_string(), "nothing");
        let damage = Damage { telegrams: 2, chunks: 1, is_cut: true, ..Damage::default() };
        let words = "2 telegrams, 1 chunk, the end of the file, with its index";
        assert_eq!(damage.to_string(), words);
        let damage = Damage { is_harmed: true, ..Damage::default() };
        assert_eq!(damage.to_string(), "no telegram, but a checksum is wrong");
    }
}
