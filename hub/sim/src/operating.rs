//! The operating modes: what a sensor sends unasked after a request 20h, or once after one of its own kind, and how
//! such a telegram is laid out (Telegram listing, 20h, 30h to 3Fh and 75h). Knows nothing of the line.

use lms::telegram::{REPLY, Telegram, Writer};
use lms::variant::{MIRROR_TURN, Mode, Unit, Variant};
use lms::{Nanos, line_time};

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
            Operating::Installation => 0x00,
            Operating::All => 0x24,
            Operating::OnRequest => 0x25,
            Operating::Means(_) => 0x26,
            Operating::Range(..) => 0x27,
            Operating::MeanRange(..) => 0x28,
            Operating::Fields(..) => 0x29,
            Operating::Partial => 0x2A,
            Operating::Reflectivity(_) => 0x2B,
        }
    }

    /// Whether telegrams come unasked.
    pub fn streams(&self) -> bool {
        !matches!(self, Operating::Installation | Operating::OnRequest)
    }

    /// The mode that the data of a request 20h name, if a sensor set to `variant` can do it; not the installation,
    /// which takes a password.
    pub(crate) fn of_mode(data: &[u8], variant: Variant) -> Option<Operating> {
        let (&code, data) = data.split_first()?;
        let operating = match (code, data) {
            (0x24, []) => Operating::All,
            (0x25, []) => Operating::OnRequest,
            (0x26, &[shots]) => Operating::Means(shots),
            (0x27, &[a, b, c, d]) => Operating::Range(word(a, b), word(c, d)),
            (0x28, &[shots, a, b, c, d]) => Operating::MeanRange(shots, word(a, b), word(c, d)),
            (0x29, &[a, b, c, d]) => Operating::Fields(word(a, b), word(c, d)),
            (0x2A, []) => Operating::Partial,
            (0x2B, data) => Operating::Reflectivity(ranges(data)?),
            _ => return None,
        };
        operating.fits(variant).then_some(operating)
    }

    /// What a request for one telegram asks for: 30h 36h 37h 3Eh 3Fh 75h.
    pub(crate) fn of_single(request: Telegram<'_>, variant: Variant) -> Option<Operating> {
        let data = request.data();
        let code = match (request.command(), data) {
            (0x30, [1]) => return Some(Operating::All),
            (0x30, [8]) => return Some(Operating::Partial),
            (0x36, _) => 0x26,
            (0x37, _) => 0x27,
            (0x3E, _) => 0x29,
            (0x3F, _) => 0x28,
            (0x75, _) => 0x2B,
            _ => return None,
        };
        Operating::of_mode(&[&[code], data].concat(), variant)
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
            Operating::All => {
                let words = shot.words();
                append(begin(0xB0).word(whole(&words)), &words)
            }
            Operating::Partial => {
                let step = 4 / shot.variant.turns();
                let quarter = (shot.turn % shot.variant.turns() * step) as u8;
                let words = shot.room.partial(quarter, shot.unit, shot.mode, shot.at_ns);
                append(begin(0xB0).word(whole(&words) | PARTIAL | u16::from(quarter) << 11), &words)
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
        let writer = match shot.index {
            Some(index) => writer.byte((shot.at_ns / MIRROR_TURN) as u8).byte(index),
            None => writer,
        };
        Some(writer.byte(shot.status).finish().bytes().to_vec())
    }
}

impl Shot<'_> {
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

/// Number of ranges (a word; 75h is seen with a byte too), then first and last beam of each.
fn ranges(data: &[u8]) -> Option<Vec<(u16, u16)>> {
    let (count, pairs) = match data.len() % 4 {
        1 => (usize::from(data[0]), &data[1..]),
        2 => (usize::from(word(data[0], data[1])), &data[2..]),
        _ => return None,
    };
    let ranges = pairs.chunks_exact(4).map(|pair| (word(pair[0], pair[1]), word(pair[2], pair[3]))).collect();
    ((1..=5).contains(&count) && pairs.len() == 4 * count).then_some(ranges)
}

fn word(low: u8, high: u8) -> u16 {
    u16::from_le_bytes([low, high])
}

/// Bit of the count word that marks a partial scan.
const PARTIAL: u16 = 1 << 13;
/// Code of a value that could not be calculated: maximum - 2 (Telegram listing 10.8).
const OVERFLOW: u16 = 2;
