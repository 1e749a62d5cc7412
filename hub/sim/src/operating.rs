//! The operating modes: what a sensor sends continuously after a request 20h, or once after the request for one value, and
//! the layout of such a telegram (Telegram listing, 20h, 30h to 3Fh and 75h). Knows nothing about the line.

use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::measured::{Frame, encode_with};
use scanhub_drivers::lms::operating::{self as mode, Operating as Asked};
use scanhub_drivers::lms::telegram::{REPLY, Writer};
use scanhub_drivers::lms::variant::{MIRROR_TURN, Mode, Unit, Variant};
use schema::{Nanos, line_time};

use crate::room::Room;

/// What the sensor does.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Operating {
    /// 00h: installation; the only one in which the EEPROM can be written.
    Installation,
    /// 24h: all values of every scan, B0h.
    All,
    /// 25h: values on request only.
    OnRequest,
    /// 26h: means of so many scans, B6h.
    Means(u8),
    /// 27h: the values from one beam to another, counted from 1, B7h.
    Range(u16, u16),
    /// 28h: means of so many scans, from one beam to another, BFh.
    MeanRange(u8, u16, u16),
    /// 29h: the values from one beam to another with what they say of the fields, BEh.
    Fields(u16, u16),
    /// 2Ah: every mirror turn as a scan of its own, B0h with the partial bit.
    Partial,
    /// 2Bh: range and reflectivity of up to five ranges of beams, F5h.
    Reflectivity(Vec<(u16, u16)>),
}

/// What a telegram of measured values is made of.
pub(crate) struct Shot<'a> {
    pub(crate) room: &'a Room,
    pub(crate) variant: Variant,
    pub(crate) unit: Unit,
    pub(crate) mode: Mode,
    pub(crate) at_ns: Nanos,
    pub(crate) address: u8,
    pub(crate) status: u8,
    /// Where real-time indices are wanted: number of the telegram.
    pub(crate) index: Option<u8>,
    /// Number of the partial scan.
    pub(crate) turn: u64,
}

impl Operating {
    /// The byte after 20h.
    pub fn code(&self) -> u8 {
        match self {
            Operating::Installation => mode::INSTALLATION,
            Operating::All => mode::STREAM,
            Operating::OnRequest => mode::ON_REQUEST,
            Operating::Means(_) => mode::MEANS,
            Operating::Range(..) => mode::RANGE,
            Operating::MeanRange(..) => mode::RANGE_MEANS,
            Operating::Fields(..) => mode::RANGE_FIELDS,
            Operating::Partial => mode::PARTIAL,
            Operating::Reflectivity(_) => mode::REFLECTIVITIES,
        }
    }

    /// Whether telegrams are sent continuously.
    pub fn streams(&self) -> bool {
        !matches!(self, Operating::Installation | Operating::OnRequest)
    }

    /// What `request` asks for, once or from now on, if a sensor set to `variant` can do it; not the installation,
    /// which takes a password.
    pub(crate) fn of_request(request: Request, variant: Variant) -> Option<Operating> {
        let operating = match request {
            Request::Stream | Request::Values(1) => Operating::All,
            Request::Stop => Operating::OnRequest,
            Request::Operate(Asked::Partial) | Request::Values(8) => Operating::Partial,
            Request::Operate(Asked::Means(shots)) | Request::Means(shots) => Operating::Means(shots),
            Request::Operate(Asked::Range(span)) | Request::Range(span) => {
                Operating::Range(span.first, span.last)
            }
            Request::Operate(Asked::RangeMeans(shots, span)) | Request::RangeMeans(shots, span) => {
                Operating::MeanRange(shots, span.first, span.last)
            }
            Request::Operate(Asked::RangeFields(span)) | Request::RangeFields(span) => {
                Operating::Fields(span.first, span.last)
            }
            Request::Operate(Asked::Reflectivities(spans)) | Request::Reflectivities(spans) => {
                let ranges = spans.as_slice().iter().map(|span| (span.first, span.last));
                Operating::Reflectivity(ranges.collect())
            }
            _ => return None,
        };
        operating.fits(variant).then_some(operating)
    }

    fn fits(&self, variant: Variant) -> bool {
        let within =
            |first: u16, last: u16| 1 <= first && first <= last && usize::from(last) <= variant.beams();
        match self {
            Operating::Means(shots) => *shots >= 2,
            Operating::Range(first, last) => within(*first, *last),
            Operating::MeanRange(shots, first, last) => *shots >= 2 && within(*first, *last),
            Operating::Fields(first, last) => within(*first, *last) && last - first < 100,
            Operating::Reflectivity(ranges) => {
                let pairs: usize =
                    ranges.iter().map(|(first, last)| usize::from(last.abs_diff(*first)) + 1).sum();
                // As many as LENGTH has room for (808 less command, number of ranges, their heads and status).
                let room = 6 * ranges.len() + 4 * pairs <= 804;
                room && ranges.iter().all(|&(first, last)| within(first, last))
            }
            _ => true,
        }
    }

    /// Mirror turns from one telegram's first beam to the next one's at least.
    pub(crate) fn turns(&self, variant: Variant) -> u64 {
        match self {
            Operating::Partial => 1,
            Operating::Means(shots) | Operating::MeanRange(shots, ..) => variant.turns() * u64::from(*shots),
            _ => variant.turns(),
        }
    }

    /// Time between two telegrams of `len` bytes at `rate`: whole scans, as many as the line needs (Telegram listing
    /// table 10-17).
    pub(crate) fn period(&self, variant: Variant, len: usize, rate: u32) -> Nanos {
        let scan = self.turns(variant) * MIRROR_TURN;
        scan * line_time(len, rate).div_ceil(scan).max(1)
    }

    /// The telegram of what is seen; `None` for a mode in which nothing is sent.
    pub(crate) fn telegram(&self, shot: &Shot<'_>) -> Option<Vec<u8>> {
        let whole = |words: &[u16]| words.len() as u16 | u16::from(shot.unit.code()) << 14;
        let begin = |command| Writer::new(shot.address | REPLY, command);
        let writer = match self {
            Operating::Installation | Operating::OnRequest => return None,
            Operating::All => return Some(shot.scan(None, &shot.words())),
            Operating::Partial => {
                let step = 4 / shot.variant.turns();
                let quarter = (shot.turn % shot.variant.turns() * step) as u8;
                let words = shot.room.partial(quarter, shot.unit, shot.mode, shot.at_ns);
                return Some(shot.scan(Some(quarter), &words));
            }
            Operating::Means(shots) => {
                let words = shot.means(*shots);
                append(begin(0xB6).byte(*shots).word(whole(&words)), &words)
            }
            Operating::Range(first, last) => {
                let words = beams(&shot.words(), *first, *last);
                append(begin(0xB7).word(*first).word(*last).word(whole(&words)), &words)
            }
            Operating::MeanRange(shots, first, last) => {
                let words = beams(&shot.means(*shots), *first, *last);
                let writer = begin(0xBF).byte(*shots).word(*first).word(*last).word(whole(&words));
                return Some(append(writer, &words).byte(shot.status).finish().bytes().to_vec());
            }
            Operating::Fields(first, last) => {
                let words = beams(&shot.words(), *first, *last);
                let head = begin(0xBE).word(*first).word(*last).word(whole(&words));
                let writer = words.iter().fold(head, |writer, &word| append(writer, &[word, 0, 0, 0]));
                return Some(writer.byte(shot.status).finish().bytes().to_vec());
            }
            Operating::Reflectivity(ranges) => {
                let pairs = shot.pairs();
                ranges.iter().fold(begin(0xF5).word(ranges.len() as u16), |writer, &(first, last)| {
                    let pairs = &pairs[usize::from(first) - 1..usize::from(last)];
                    let count = pairs.len() as u16 | u16::from(shot.unit.code()) << 14;
                    let writer = writer.word(first).word(last).word(count);
                    pairs.iter().fold(writer, |writer, pair| append(writer, pair))
                })
            }
        };
        let writer = match shot.indices() {
            Some((scan, telegram)) => writer.byte(scan).byte(telegram),
            None => writer,
        };
        Some(writer.byte(shot.status).finish().bytes().to_vec())
    }
}

impl Shot<'_> {
    /// B0h of `words`, which are a whole scan or the one that begins at a quarter of a degree.
    fn scan(&self, partial: Option<u8>, words: &[u16]) -> Vec<u8> {
        let frame = Frame { unit: self.unit, partial, indices: self.indices() };
        encode_with(self.address, frame, words, self.status).bytes().to_vec()
    }

    /// Numbers of the mirror turn and of the telegram, where they are wanted.
    fn indices(&self) -> Option<(u8, u8)> {
        self.index.map(|index| ((self.at_ns / MIRROR_TURN) as u8, index))
    }

    fn words(&self) -> Vec<u16> {
        self.room.scan(self.variant, self.unit, self.mode, self.at_ns)
    }

    /// Ranges only, each the mean of `shots` scans; where a fifth of them have none it is the code for overflow.
    fn means(&self, shots: u8) -> Vec<u16> {
        let (greatest, scan) = (self.mode.max_value(), self.variant.turns() * MIRROR_TURN);
        let mut sums = vec![(0u32, 0u32); self.variant.beams()];
        for shot in 0..u64::from(shots) {
            let at_ns = self.at_ns + shot * scan;
            let words = self.room.scan(self.variant, self.unit, self.mode, at_ns);
            for (sum, range) in sums.iter_mut().zip(words.iter().map(|word| word & greatest)) {
                if range < greatest - recording::BEYOND {
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

    /// Range and reflectivity of each beam: a plain surface sends back some, a reflector up to about 13000.
    fn pairs(&self) -> Vec<[u16; 2]> {
        let levels = Mode(1);
        let words = self.room.scan(self.variant, self.unit, levels, self.at_ns);
        let pair = |word: u16| match word & levels.max_value() {
            range if range < levels.max_value() - recording::BEYOND => [range, 400 + 2_000 * (word >> 13)],
            code => [code, 0],
        };
        words.into_iter().map(pair).collect()
    }
}

fn beams(words: &[u16], first: u16, last: u16) -> Vec<u16> {
    words[usize::from(first) - 1..usize::from(last)].to_vec()
}

fn append(writer: Writer, words: &[u16]) -> Writer {
    words.iter().fold(writer, |writer, &word| writer.word(word))
}

/// Code of a value that could not be calculated: maximum - 2 (Telegram listing 10.8).
const OVERFLOW: u16 = 2;
