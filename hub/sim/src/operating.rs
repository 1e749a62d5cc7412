//! Operating modes of an LMS, and the telegrams of measured values that a scanner sends in each mode. It sends them
//! continuously after a request 20h, or one telegram after a request 30h to 3Fh or 75h (Telegram listing). The measured
//! values come from a [`ScanSource`]: a room, or a recording.

use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::measured::{ScanFrame, encode_with};
use scanhub_drivers::lms::operating::{self as mode, Operating as Asked};
use scanhub_drivers::lms::telegram::{REPLY, Writer};
use scanhub_drivers::lms::variant::{MIRROR_PERIOD, Mode, Unit, Variant};
use scanhub_schema::{Nanos, line_time};

use crate::room::Room;

/// Operating mode of a scanner: the byte after 20h that selects it, the contents of its telegrams, and their command
/// byte. Beams are counted from 1.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum OperatingMode {
    /// 00h: installation, the only mode in which the EEPROM can be written.
    Installation,
    /// 24h: all values of every scan, B0h.
    All,
    /// 25h: values on request only.
    OnRequest,
    /// 26h: means of this number of scans, B6h.
    Means(u8),
    /// 27h: the values from the first of these beams to the second one, B7h.
    Range(u16, u16),
    /// 28h: means of this number of scans, from the first of these beams to the second one, BFh.
    MeanRange(u8, u16, u16),
    /// 29h: the values from the first of these beams to the second one, with the states of the fields, BEh.
    Fields(u16, u16),
    /// 2Ah: every revolution of the mirror as a separate scan, B0h with the partial bit.
    Partial,
    /// 2Bh: range and reflectivity of each beam in up to five intervals of beams, F5h.
    Reflectivity(Vec<(u16, u16)>),
}

/// Contents of a telegram of measured values.
pub(crate) struct MeasuredValues<'a> {
    pub(crate) room: &'a Room,
    pub(crate) variant: Variant,
    pub(crate) unit: Unit,
    pub(crate) mode: Mode,
    pub(crate) at_ns: Nanos,
    pub(crate) address: u8,
    pub(crate) status: u8,
    /// Count of the telegrams since power-on, modulo 256; `None` if real-time indices are off.
    pub(crate) index: Option<u8>,
    /// Number of partial scans since the last change of the operating mode.
    pub(crate) revolution: u64,
}

impl OperatingMode {
    /// Returns the byte after 20h.
    pub fn code(&self) -> u8 {
        match self {
            OperatingMode::Installation => mode::INSTALLATION,
            OperatingMode::All => mode::STREAM,
            OperatingMode::OnRequest => mode::ON_REQUEST,
            OperatingMode::Means(_) => mode::MEANS,
            OperatingMode::Range(..) => mode::RANGE,
            OperatingMode::MeanRange(..) => mode::RANGE_MEANS,
            OperatingMode::Fields(..) => mode::RANGE_FIELDS,
            OperatingMode::Partial => mode::PARTIAL,
            OperatingMode::Reflectivity(_) => mode::REFLECTIVITIES,
        }
    }

    /// Returns whether telegrams are sent continuously.
    pub fn streams(&self) -> bool {
        !matches!(self, OperatingMode::Installation | OperatingMode::OnRequest)
    }

    /// Returns the mode that `request` selects for one telegram or for all telegrams from now on. Returns `None` if a
    /// scanner in `variant` does not support the mode, and for the installation mode, which needs a password.
    pub(crate) fn of_request(request: Request, variant: Variant) -> Option<OperatingMode> {
        let operating = match request {
            Request::Stream | Request::Values(1) => OperatingMode::All,
            Request::Stop => OperatingMode::OnRequest,
            Request::Operate(Asked::Partial) | Request::Values(8) => OperatingMode::Partial,
            Request::Operate(Asked::Means(shots)) | Request::Means(shots) => OperatingMode::Means(shots),
            Request::Operate(Asked::Range(span)) | Request::Range(span) => {
                OperatingMode::Range(span.first, span.last)
            }
            Request::Operate(Asked::RangeMeans(shots, span)) | Request::RangeMeans(shots, span) => {
                OperatingMode::MeanRange(shots, span.first, span.last)
            }
            Request::Operate(Asked::RangeFields(span)) | Request::RangeFields(span) => {
                OperatingMode::Fields(span.first, span.last)
            }
            Request::Operate(Asked::Reflectivities(spans)) | Request::Reflectivities(spans) => {
                let ranges = spans.as_slice().iter().map(|span| (span.first, span.last));
                OperatingMode::Reflectivity(ranges.collect())
            }
            _ => return None,
        };
        operating.fits(variant).then_some(operating)
    }

    fn fits(&self, variant: Variant) -> bool {
        let within =
            |first: u16, last: u16| 1 <= first && first <= last && usize::from(last) <= variant.beams();
        match self {
            OperatingMode::Means(shots) => *shots >= 2,
            OperatingMode::Range(first, last) => within(*first, *last),
            OperatingMode::MeanRange(shots, first, last) => *shots >= 2 && within(*first, *last),
            OperatingMode::Fields(first, last) => within(*first, *last) && last - first < 100,
            OperatingMode::Reflectivity(ranges) => {
                let pairs: usize =
                    ranges.iter().map(|(first, last)| usize::from(last.abs_diff(*first)) + 1).sum();
                // The length field is at most 808. Command, number of ranges and status take 4 bytes of it, and each
                // range has a header of 6 bytes.
                let room = 6 * ranges.len() + 4 * pairs <= 804;
                room && ranges.iter().all(|&(first, last)| within(first, last))
            }
            _ => true,
        }
    }

    /// Returns the minimum number of revolutions of the mirror from one telegram to the next.
    pub(crate) fn revolutions(&self, variant: Variant) -> u64 {
        match self {
            OperatingMode::Partial => 1,
            OperatingMode::Means(shots) | OperatingMode::MeanRange(shots, ..) => {
                variant.revolutions() * u64::from(*shots)
            }
            _ => variant.revolutions(),
        }
    }

    /// Returns the time from the start of one telegram of `len` bytes to the start of the next telegram, at `rate` bits
    /// per second. The result is the duration of the smallest number of whole scans in which the line can carry the
    /// telegram (Telegram listing, table 10-17).
    pub(crate) fn period(&self, variant: Variant, len: usize, rate: u32) -> Nanos {
        let scan = self.revolutions(variant) * MIRROR_PERIOD;
        scan * line_time(len, rate).div_ceil(scan).max(1)
    }

    /// Returns the telegram with `values`, or `None` in a mode that sends no telegrams.
    pub(crate) fn telegram(&self, values: &MeasuredValues<'_>) -> Option<Vec<u8>> {
        let count_word = |words: &[u16]| words.len() as u16 | u16::from(values.unit.code()) << 14;
        let begin = |command| Writer::new(values.address | REPLY, command);
        let writer = match self {
            OperatingMode::Installation | OperatingMode::OnRequest => return None,
            OperatingMode::All => return Some(values.scan(None, &values.words())),
            OperatingMode::Partial => {
                let step = 4 / values.variant.revolutions();
                let quarter = (values.revolution % values.variant.revolutions() * step) as u8;
                let words = values.room.partial_scan(quarter, values.unit, values.mode, values.at_ns);
                return Some(values.scan(Some(quarter), &words));
            }
            OperatingMode::Means(shots) => {
                let words = values.means(*shots);
                append(begin(0xB6).byte(*shots).word(count_word(&words)), &words)
            }
            OperatingMode::Range(first, last) => {
                let words = select_beams(&values.words(), *first, *last);
                append(begin(0xB7).word(*first).word(*last).word(count_word(&words)), &words)
            }
            OperatingMode::MeanRange(shots, first, last) => {
                let words = select_beams(&values.means(*shots), *first, *last);
                let writer = begin(0xBF).byte(*shots).word(*first).word(*last).word(count_word(&words));
                return Some(append(writer, &words).byte(values.status).finish().bytes().to_vec());
            }
            OperatingMode::Fields(first, last) => {
                let words = select_beams(&values.words(), *first, *last);
                let head = begin(0xBE).word(*first).word(*last).word(count_word(&words));
                let writer = words.iter().fold(head, |writer, &word| append(writer, &[word, 0, 0, 0]));
                return Some(writer.byte(values.status).finish().bytes().to_vec());
            }
            OperatingMode::Reflectivity(ranges) => {
                let pairs = values.pairs();
                ranges.iter().fold(begin(0xF5).word(ranges.len() as u16), |writer, &(first, last)| {
                    let pairs = &pairs[usize::from(first) - 1..usize::from(last)];
                    let count = pairs.len() as u16 | u16::from(values.unit.code()) << 14;
                    let writer = writer.word(first).word(last).word(count);
                    pairs.iter().fold(writer, |writer, pair| append(writer, pair))
                })
            }
        };
        let writer = match values.indices() {
            Some((scan, telegram)) => writer.byte(scan).byte(telegram),
            None => writer,
        };
        Some(writer.byte(values.status).finish().bytes().to_vec())
    }
}

impl MeasuredValues<'_> {
    /// Returns the telegram B0h with `words`. If `partial` is `None`, they are a whole scan. Otherwise they are a
    /// partial scan, whose beams are this number of quarters of a degree after whole degrees.
    fn scan(&self, partial: Option<u8>, words: &[u16]) -> Vec<u8> {
        let frame = ScanFrame { unit: self.unit, partial, indices: self.indices() };
        encode_with(self.address, frame, words, self.status).bytes().to_vec()
    }

    /// Returns the numbers of the revolution and of the telegram, or `None` if real-time indices are off.
    fn indices(&self) -> Option<(u8, u8)> {
        self.index.map(|index| ((self.at_ns / MIRROR_PERIOD) as u8, index))
    }

    fn words(&self) -> Vec<u16> {
        self.room.scan(self.variant, self.unit, self.mode, self.at_ns)
    }

    /// Returns the mean range of each beam in `shots` scans, without levels. If a beam has no range in a fifth of the
    /// scans or more, its value is the code for overflow.
    fn means(&self, shots: u8) -> Vec<u16> {
        let (greatest, scan) = (self.mode.max_value(), self.variant.revolutions() * MIRROR_PERIOD);
        let mut sums = vec![(0u32, 0u32); self.variant.beams()];
        for scan_number in 0..u64::from(shots) {
            let at_ns = self.at_ns + scan_number * scan;
            let words = self.room.scan(self.variant, self.unit, self.mode, at_ns);
            for (sum, range) in sums.iter_mut().zip(words.iter().map(|word| word & greatest)) {
                if range < greatest - scanhub_recording::BEYOND_RANGE_OFFSET {
                    *sum = (sum.0 + u32::from(range), sum.1 + 1);
                }
            }
        }
        let mean = |(sum, count): (u32, u32)| match count {
            count if 5 * count > 4 * u32::from(shots) => (sum / count) as u16,
            _ => greatest - OVERFLOW,
        };
        sums.into_iter().map(mean).collect()
    }

    /// Returns range and reflectivity of each beam: 400 for a plain surface, up to about 13,000 for a reflector.
    fn pairs(&self) -> Vec<[u16; 2]> {
        let levels = Mode(1);
        let words = self.room.scan(self.variant, self.unit, levels, self.at_ns);
        let pair = |word: u16| match word & levels.max_value() {
            range if range < levels.max_value() - scanhub_recording::BEYOND_RANGE_OFFSET => {
                [range, 400 + 2_000 * (word >> 13)]
            }
            code => [code, 0],
        };
        words.into_iter().map(pair).collect()
    }
}

/// A source of measured-value telegrams.
pub enum ScanSource {
    /// A simulated room.
    Room(Room),
    /// Whole telegrams, sent as they are.
    Recorded {
        /// Variant of the recording. The scanner supports no other variant.
        variant: Variant,
        /// The telegrams, in the order in which they are sent. The stream ends after the last one.
        telegrams: Box<dyn Iterator<Item = Vec<u8>> + Send>,
    },
}

impl ScanSource {
    /// Returns the next telegram of a scanner in `operating`: the next recorded telegram, or a telegram with the values
    /// that `measure` takes from the room. Returns `None` at the end of a recording, and in a mode that sends nothing.
    pub(crate) fn telegram<'a>(
        &'a mut self,
        operating: &OperatingMode,
        measure: impl FnOnce(&'a Room) -> MeasuredValues<'a>,
    ) -> Option<Vec<u8>> {
        match self {
            ScanSource::Room(room) => operating.telegram(&measure(room)),
            ScanSource::Recorded { telegrams, .. } => telegrams.next(),
        }
    }

    /// Returns the only supported variant, or `None` if all variants are supported.
    pub(crate) fn variant(&self) -> Option<Variant> {
        match self {
            ScanSource::Room(_) => None,
            ScanSource::Recorded { variant, .. } => Some(*variant),
        }
    }

    /// Returns whether `operating` is supported. A recording supports only a stream of whole scans, and the modes that
    /// do not stream.
    pub(crate) fn supports(&self, operating: &OperatingMode) -> bool {
        matches!(self, ScanSource::Room(_)) || *operating == OperatingMode::All || !operating.streams()
    }
}

fn select_beams(words: &[u16], first: u16, last: u16) -> Vec<u16> {
    words[usize::from(first) - 1..usize::from(last)].to_vec()
}

fn append(writer: Writer, words: &[u16]) -> Writer {
    words.iter().fold(writer, |writer, &word| writer.word(word))
}

/// Code of a value that could not be calculated, counted down from the maximum (Telegram listing 10.8).
const OVERFLOW: u16 = 2;
