//! Telegrams with measured values. B0h, B6h, B7h and BFh contain a count word and one word per beam. Two real-time
//! indices follow if the scanner is set to send them. The meaning of a word depends on the measuring mode, which the
//! telegram does not contain. F5h, C4h and BEh contain more than one word per beam: ranges with reflectivities, or
//! ranges with the borders of the fields.

use scanhub_schema::{Nanos, ScanHead};

use crate::line::{RawScan, Values};
use crate::lms::telegram::{EncodedTelegram, REPLY, Telegram, Writer};
use crate::lms::variant::{MAX_BEAMS, Mode, Unit, Variant};

/// Command byte of a measured-value telegram.
pub const MEASURED: u8 = 0xB0;

/// View of measured values that begins with the count word.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MeasuredValues<'a> {
    count_word: u16,
    values: &'a [u8],
    indices: Option<(u8, u8)>,
}

impl<'a> MeasuredValues<'a> {
    /// Returns the view of `telegram`. Returns `None` if the command is not B0h, if the unit is unknown, or if the
    /// number of words does not match the count. At most two real-time indices may follow the words.
    pub fn decode(telegram: Telegram<'a>) -> Option<Self> {
        if telegram.command() != MEASURED || !telegram.is_reply() {
            return None;
        }
        MeasuredValues::read(telegram.data())
    }

    /// Returns the view of `data`, which begins with the count word.
    pub(crate) fn read(data: &'a [u8]) -> Option<Self> {
        let [low, high, rest @ ..] = data else { return None };
        let count_word = u16::from_le_bytes([*low, *high]);
        Unit::of_code((count_word >> 14) as u8)?;
        let count = usize::from(count_word & COUNT_MASK);
        if count == 0 || count > MAX_BEAMS {
            return None;
        }
        let (values, after) = rest.split_at_checked(2 * count)?;
        let indices = match *after {
            [] => None,
            [scan, telegram] => Some((scan, telegram)),
            _ => return None,
        };
        Some(MeasuredValues { count_word, values, indices })
    }

    /// Appends the values to a reply. Returns `None` if they do not fit.
    pub(crate) fn write(&self, writer: Writer) -> Option<Writer> {
        let writer = writer.word(self.count_word).reply_slice(self.values)?;
        match self.indices {
            Some((scan, telegram)) => writer.reply_slice(&[scan, telegram]),
            None => Some(writer),
        }
    }

    /// Returns the number of beams: 1 to 401.
    pub fn count(&self) -> usize {
        self.values.len() / 2
    }

    /// Returns the unit of the ranges.
    pub fn unit(&self) -> Unit {
        // `read` has rejected code 3, which has no unit.
        Unit::of_code((self.count_word >> 14) as u8).unwrap_or(Unit::Mm)
    }

    /// Returns the start of a partial scan, in quarters of a degree (0 to 3). Returns `None` for a complete scan.
    pub fn partial(&self) -> Option<u8> {
        (self.count_word & PARTIAL_FLAG != 0).then_some((self.count_word >> 11) as u8 & 3)
    }

    /// Returns the scan index and the telegram index, both modulo 256. Returns `None` if the scanner does not send
    /// them.
    pub fn indices(&self) -> Option<(u8, u8)> {
        self.indices
    }

    /// Returns whether a value has bits set that `mode` never sets.
    pub(crate) fn is_forbidden(&self, mode: Mode) -> bool {
        mode.forbidden() != 0 && self.words().any(|word| word & mode.forbidden() != 0)
    }

    /// Returns the scan. `mode` determines the range bits of a value. The stamps of the scan are 0.
    pub fn scan(&self, mode: Mode) -> RawScan<'a> {
        raw_scan(self.values, head(self.count(), self.unit(), self.partial(), mode), mode)
    }

    /// Returns the words as the scanner sent them. The low bits are the range, and the bits above are the reflector
    /// level or field bits (see [`Mode`]).
    pub fn words(&self) -> impl ExactSizeIterator<Item = u16> + use<'a> {
        words(self.values)
    }
}

fn words(values: &[u8]) -> impl ExactSizeIterator<Item = u16> + use<'_> {
    values.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]))
}

/// The first values of a measured-value telegram that is not complete.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PartialValues<'a> {
    count: usize,
    unit: Unit,
    values: &'a [u8],
}

impl<'a> PartialValues<'a> {
    /// Returns the values in the incomplete telegram `bytes`, if its header announces a complete scan.
    pub(crate) fn of(bytes: &'a [u8]) -> Option<Self> {
        let [_, _, _, _, MEASURED, low, high, rest @ ..] = bytes else { return None };
        let count_word = u16::from_le_bytes([*low, *high]);
        let count = usize::from(count_word & COUNT_MASK);
        let unit = Unit::of_code((count_word >> 14) as u8)?;
        let is_whole = count_word & PARTIAL_FLAG == 0 && (1..=MAX_BEAMS).contains(&count);
        let (values, _) = rest.split_at(rest.len().min(2 * count) & !1);
        is_whole.then_some(PartialValues { count, unit, values })
    }

    /// Returns the incomplete scan. `mode` determines the range bits of a value. The stamps of the scan are 0.
    pub(crate) fn scan(&self, mode: Mode) -> RawScan<'a> {
        raw_scan(self.values, head(self.count, self.unit, None, mode), mode)
    }
}

fn raw_scan(bytes: &[u8], head: ScanHead, mode: Mode) -> RawScan<'_> {
    let values = Values::Words { bytes, range_bits: mode.range_bits() };
    RawScan { number: 0, first: 0, last: 0, period: 0, reasons: 0, bytes: 0, head, values }
}

/// Returns the head of a scan of `count` values. Beams are in the order in which the scanner sends them:
/// counterclockwise as seen from above, and the first beam is on the right. Straight ahead is angle 0 (REP 103).
fn head(count: usize, unit: Unit, partial: Option<u8>, mode: Mode) -> ScanHead {
    let variant = Variant::of_beams(count);
    // A partial scan has 180 or 181 beams, 1 degree apart.
    let step_mdeg = variant.map_or(1000, |variant| variant.resolution_cdeg * 10);
    let first_angle_mdeg = match (variant, partial) {
        (None, Some(quarters)) => i32::from(quarters) * 250 - 90_000,
        (variant, _) => variant.map_or(-90_000, Variant::first_angle_mdeg),
    };
    ScanHead {
        intensity_bits: mode.intensity_bits(),
        ..ScanHead::lms(count, first_angle_mdeg, step_mdeg.into(), unit.mm().into(), mode.range_bits())
    }
}

/// Returns the nominal time between two scans of `beams` values at `baud`, rounded down to microseconds. Returns 0 if
/// no variant has `beams` values.
pub fn nominal_period(beams: usize, baud: u32) -> Nanos {
    // In addition to the values, a telegram has 10 bytes: STX to count word, status and checksum.
    let period = |variant: Variant| variant.period(2 * variant.beams() + 10, baud);
    Variant::of_beams(beams).map_or(0, |variant| period(variant) / 1000 * 1000)
}

/// Encodes the measured-value telegram of a complete scan. `address` is the scanner's address (0 to 127), `words` has
/// at most 401 elements, and `status` is the status byte.
pub fn encode(address: u8, unit: Unit, words: &[u16], status: u8) -> EncodedTelegram {
    encode_with(address, ScanFrame { unit, partial: None, indices: None }, words, status)
}

/// Contents of a measured-value telegram other than its values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ScanFrame {
    /// Unit of the ranges.
    pub unit: Unit,
    /// Start of a partial scan in quarters of a degree (0 to 3); `None` for a complete scan.
    pub partial: Option<u8>,
    /// Scan index and telegram index. `None` if the scanner does not send them.
    pub indices: Option<(u8, u8)>,
}

/// Encodes a measured-value telegram like [`encode`], but supports partial scans and real-time indices.
pub fn encode_with(address: u8, frame: ScanFrame, words: &[u16], status: u8) -> EncodedTelegram {
    let partial = frame.partial.map_or(0, |quarter| PARTIAL_FLAG | u16::from(quarter & 3) << 11);
    let count_word = words.len() as u16 | partial | u16::from(frame.unit.code()) << 14;
    let mut writer = Writer::new(address | REPLY, MEASURED).word(count_word);
    for &word in words {
        writer = writer.word(word);
    }
    if let Some((scan, telegram)) = frame.indices {
        writer = writer.byte(scan).byte(telegram);
    }
    writer.byte(status).finish()
}

/// Bits of the count word that contain the count.
pub(crate) const COUNT_MASK: u16 = 0x03FF;
/// Bit of the count word that marks a partial scan.
pub(crate) const PARTIAL_FLAG: u16 = 1 << 13;

/// Data of a reply with more than one word per beam. The counts in the data match the length of the data. Two real-time
/// indices may follow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rows<'a>(&'a [u8]);

impl<'a> Rows<'a> {
    /// Checks the data of F5h: one to five sub-ranges, with range and reflectivity of each beam (Telegram listing,
    /// 75h).
    pub fn of_reflectivities(data: &'a [u8]) -> Option<Self> {
        let mut used = 2;
        for _ in 0..word(data, 0)? {
            used += 6 + 4 * count(data, used + 4)?;
        }
        Rows::check_len(data, used)
    }

    /// Checks the data of C4h, which a version S14 sends: all ranges as words, then the reflectivity of a sub-range as
    /// bytes.
    pub fn of_reflectivity(data: &'a [u8]) -> Option<Self> {
        let reflectivities = 2 + 2 * count(data, 0)?;
        Rows::check_len(data, reflectivities + 6 + count(data, reflectivities)?)
    }

    /// Checks the data of BEh: a sub-range, with the range of each beam and the distances to the borders of the fields
    /// A, B and C along this beam. A beam has four words, so 100 beams fill the longest telegram completely.
    pub fn of_fields(data: &'a [u8]) -> Option<Self> {
        Rows::check_len(data, 6 + 8 * count(data, 4)?)
    }

    fn check_len(data: &'a [u8], used: usize) -> Option<Self> {
        matches!(data.len().checked_sub(used)?, 0 | 2).then_some(Rows(data))
    }

    /// Returns the data.
    pub fn bytes(&self) -> &'a [u8] {
        self.0
    }
}

/// Returns the count in the count word at `at`.
fn count(bytes: &[u8], at: usize) -> Option<usize> {
    word(bytes, at).map(|word| (word & COUNT_MASK).into())
}

fn word(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes([*bytes.get(at)?, *bytes.get(at + 1)?]))
}

#[cfg(test)]
mod tests {
    use scanhub_schema::Scan;

    use super::*;

    #[test]
    fn mode_determines_range_and_intensity_bits() {
        let words: Vec<u16> = (0..181).map(|i| (i % 8) << 13 | (1000 + i)).collect();
        let encoded = encode(0, Unit::Cm, &words, 0x10);
        let measured = MeasuredValues::decode(encoded.telegram()).unwrap();
        let mut scan = Scan::zeroed(measured.scan(Mode(1)).payload_len());
        measured.scan(Mode(1)).write(&mut scan);
        assert_eq!(
            (scan.beams(), scan.unit_um, scan.valid_to, scan.intensity_bits),
            (181, 10_000, 0x1FF6, 3)
        );
        assert_eq!((scan.angle_deg(0), scan.angle_deg(90), scan.angle_deg(180)), (-90.0, 0.0, 90.0));
        assert_eq!((scan.ranges()[5], scan.intensities().get(5)), (1005, Some(5)));
        measured.scan(Mode(4)).write(&mut scan);
        assert_eq!((scan.no_return, scan.intensity_bits), (0x3FFF, 0));
        assert_eq!((scan.ranges()[3], scan.upper()[3]), ((3 << 13 | 1003) & 0x3FFF, 1));
        assert!(measured.is_forbidden(Mode(0x0F)) && !measured.is_forbidden(Mode(4)));
    }

    #[test]
    fn status_reports_modes_with_reflector_bits() {
        for mode in 0..scanhub_schema::Status::MODE_UNKNOWN {
            let status = scanhub_schema::Status { mode, ..scanhub_schema::Status::default() };
            assert_eq!(status.has_reflector_bits(), Some(Mode(mode).intensity_bits() > 0), "{mode}");
        }
    }

    #[test]
    fn nominal_period_needs_a_known_beam_count() {
        assert_eq!((nominal_period(361, 500_000), nominal_period(180, 500_000)), (26_640_000, 0));
    }

    #[test]
    fn encodes_and_decodes_the_reference_scan() {
        let words: [u16; 361] = core::array::from_fn(|i| 1000 + i as u16);
        let encoded = encode(0, Unit::Mm, &words, 0x10);
        assert_eq!(encoded.bytes().len(), 732);
        assert_eq!(encoded.bytes()[..9], [0x02, 0x80, 0xD6, 0x02, 0xB0, 0x69, 0x41, 0xE8, 0x03]);
        assert_eq!(encoded.bytes()[727..], [0x50, 0x05, 0x10, 0x86, 0x0C]);
        let measured = MeasuredValues::decode(encoded.telegram()).unwrap();
        assert_eq!((measured.count(), measured.unit(), measured.partial()), (361, Unit::Mm, None));
        assert!(measured.words().eq(words));
    }

    #[test]
    fn partial_scan_with_indices_round_trips() {
        let words: [u16; 180] = core::array::from_fn(|i| i as u16);
        let frame = ScanFrame { unit: Unit::Cm, partial: Some(2), indices: Some((255, 7)) };
        let encoded = encode_with(1, frame, &words, 0x11);
        assert_eq!((encoded.bytes().len(), encoded.telegram().length()), (372, 0x016C + 2));
        assert_eq!(encoded.telegram().data()[..2], [180, 0b0011_0000]);
        let measured = MeasuredValues::decode(encoded.telegram()).unwrap();
        assert_eq!(
            (measured.unit(), measured.partial(), measured.indices()),
            (Unit::Cm, Some(2), Some((255, 7)))
        );
        assert!(measured.words().eq(words));
    }

    #[test]
    fn telegram_lengths_match_the_listing() {
        for (beams, length) in [(181, 0x016E), (361, 0x02D6), (101, 0xCE), (201, 0x0196), (401, 0x0326)] {
            let encoded = encode(0, Unit::Mm, &[0; MAX_BEAMS][..beams], 0x10);
            assert_eq!(encoded.telegram().length(), length);
            let frame = ScanFrame { unit: Unit::Mm, partial: None, indices: Some((0, 0)) };
            let with_indices = encode_with(0, frame, &[0; MAX_BEAMS][..beams], 0x10);
            assert_eq!(with_indices.telegram().length(), length + 2);
        }
    }

    #[test]
    fn mismatched_value_count_is_refused() {
        for (word, values) in [(361, 360), (361, 363), (0, 0), (402, 402), (0xC001, 1)] {
            let mut writer = Writer::new(0x80, MEASURED).word(word);
            for _ in 0..values {
                writer = writer.word(0);
            }
            assert_eq!(
                MeasuredValues::decode(writer.byte(0x10).finish().telegram()),
                None,
                "{word} {values}"
            );
        }
        let with_indices = Writer::new(0x80, MEASURED).word(1).word(7).byte(3).byte(4).byte(0x10).finish();
        assert_eq!(MeasuredValues::decode(with_indices.telegram()).unwrap().indices(), Some((3, 4)));
    }

    #[test]
    fn counts_of_rows_fit_their_length() {
        let data = [2, 0, 1, 0, 2, 0, 2, 0x40, 1, 0, 2, 0, 3, 0, 4, 0, 9, 0, 9, 0, 1, 0, 5, 0, 6, 0, 7, 8];
        assert_eq!(Rows::of_reflectivities(&data).unwrap().bytes(), data);
        assert!(Rows::of_reflectivities(&data[..26]).is_some());
        for wrong in [&data[..27], &[0xFF; 30], &[1]] {
            assert_eq!(Rows::of_reflectivities(wrong), None);
        }
        let data = [2, 0, 100, 0, 200, 0, 1, 0, 2, 0, 2, 0, 77];
        assert_eq!(Rows::of_reflectivity(&data).unwrap().bytes(), data);
        for wrong in [&data[..12], &[0xFF, 0xFF]] {
            assert_eq!(Rows::of_reflectivity(wrong), None);
        }
    }

    #[test]
    fn hundred_field_values_fill_a_telegram() {
        let mut data = [0; 806];
        data[4] = 100;
        assert!(Rows::of_fields(&data).is_some());
        assert_eq!(data.len() + 2, crate::lms::telegram::MAX_LENGTH);
        assert_eq!(Rows::of_fields(&data[..805]), None);
        assert_eq!(Rows::of_fields(&data[..5]), None);
    }
}
