//! What a recording contains, and what it says about the sensor. Refuses to know how it is read.

use lms::measured::Measured;
use lms::reply::Reply;
use lms::telegram::Telegram;
use lms::variant::{Mode, Unit, Variant};
use schema::Family;

use crate::{Damage, Unfit, Unread};

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

    /// Nothing yet.
    pub(crate) fn new(form: Form) -> Contents {
        Contents {
            form,
            family: Family::Lms as u8,
            sensors: Vec::new(),
            telegrams: 0,
            scans: 0,
            span: None,
            scanner_ns: None,
            beams: None,
            model: None,
            way: None,
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
