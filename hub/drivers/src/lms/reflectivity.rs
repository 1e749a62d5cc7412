//! Telegrams that carry more than a word a beam: ranges with reflectivities (F5h, C4h) and with the fields' borders
//! (BEh). Views that exist only if every count in them fits.

use crate::lms::measured::COUNT;
use crate::lms::parameters::Span;
use crate::lms::telegram::Writer;

/// F5h: one to five sub-ranges, a pair of words for each beam (Telegram listing, 75h).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reflectivities<'a>(&'a [u8]);

impl<'a> Reflectivities<'a> {
    /// The view of `data`, if the counts in it fit.
    pub fn new(data: &'a [u8]) -> Option<Self> {
        let mut rest = data.get(2..)?;
        for _ in 0..word(data, 0)? {
            rest = Part::split(rest)?.1;
        }
        matches!(rest.len(), 0 | 2).then_some(Reflectivities(data))
    }

    /// The bytes as they came.
    pub fn bytes(&self) -> &'a [u8] {
        self.0
    }

    /// The sub-ranges in their order.
    pub fn parts(&self) -> impl Iterator<Item = Part<'a>> {
        let mut rest = &self.0[2..];
        (0..word(self.0, 0).unwrap_or(0)).map_while(move |_| {
            let (part, after) = Part::split(rest)?;
            rest = after;
            Some(part)
        })
    }

    /// Scan index and telegram index, where the sensor is set to send them.
    pub fn indices(&self) -> Option<(u8, u8)> {
        let used: usize = 2 + self.parts().map(|part| Part::HEAD + part.pairs.len()).sum::<usize>();
        self.0.get(used..).and_then(two)
    }
}

/// One sub-range of [`Reflectivities`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part<'a> {
    /// Which values.
    pub span: Span,
    /// Their number, with the unit in bits 14 and 15.
    pub count_word: u16,
    pairs: &'a [u8],
}

impl<'a> Part<'a> {
    /// Bytes before the pairs.
    pub(crate) const HEAD: usize = 6;

    /// Range word and reflectivity (0 to about 13000) of each beam.
    pub fn pairs(&self) -> impl ExactSizeIterator<Item = (u16, u16)> + 'a {
        self.pairs
            .chunks_exact(4)
            .map(|pair| (u16::from_le_bytes([pair[0], pair[1]]), u16::from_le_bytes([pair[2], pair[3]])))
    }

    fn split(bytes: &'a [u8]) -> Option<(Part<'a>, &'a [u8])> {
        let span = Span::read(bytes.get(..4)?)?;
        let count_word = word(bytes, 4)?;
        let (pairs, rest) = bytes[Part::HEAD..].split_at_checked(4 * usize::from(count_word & COUNT))?;
        Some((Part { span, count_word, pairs }, rest))
    }
}

/// C4h of an LMS S14: all ranges, then the reflectivity of a sub-range as bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reflectivity<'a> {
    data: &'a [u8],
    ranges: usize,
    levels: usize,
}

impl<'a> Reflectivity<'a> {
    /// The view of `data`, if the counts in it fit.
    pub fn new(data: &'a [u8]) -> Option<Self> {
        let ranges = usize::from(word(data, 0)? & COUNT);
        let levels = usize::from(word(data, 2 + 2 * ranges)? & COUNT);
        let used = 2 + 2 * ranges + 6 + levels;
        let after = data.len().checked_sub(used)?;
        matches!(after, 0 | 2).then_some(Reflectivity { data, ranges, levels })
    }

    /// The bytes as they came.
    pub fn bytes(&self) -> &'a [u8] {
        self.data
    }

    /// Range words.
    pub fn ranges(&self) -> impl ExactSizeIterator<Item = u16> + 'a {
        self.data[2..2 + 2 * self.ranges].chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]))
    }

    /// Which values have a reflectivity.
    pub fn span(&self) -> Span {
        let at = 2 + 2 * self.ranges + 2;
        Span::read(&self.data[at..at + 4]).unwrap_or_default()
    }

    /// Their reflectivities, 0 to 255.
    pub fn levels(&self) -> &'a [u8] {
        let at = 2 + 2 * self.ranges + 6;
        &self.data[at..at + self.levels]
    }
}

/// BEh: values of a sub-range, each with the borders of the fields A, B and C in its direction. Four words each: 100
/// of them fill the longest telegram to the byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RangeFields<'a> {
    /// Which values.
    pub span: Span,
    /// Their number, with the unit in bits 14 and 15.
    pub count_word: u16,
    rest: &'a [u8],
}

impl<'a> RangeFields<'a> {
    /// The view of `data`, if the count in it fits.
    pub fn new(data: &'a [u8]) -> Option<Self> {
        let span = Span::read(data.get(..4)?)?;
        let count_word = word(data, 4)?;
        let rest = &data[6..];
        let after = rest.len().checked_sub(8 * usize::from(count_word & COUNT))?;
        matches!(after, 0 | 2).then_some(RangeFields { span, count_word, rest })
    }

    /// Value, field A, field B, field C of each beam.
    pub fn rows(&self) -> impl ExactSizeIterator<Item = [u16; 4]> + 'a {
        let used = 8 * usize::from(self.count_word & COUNT);
        self.rest[..used]
            .chunks_exact(8)
            .map(|row| core::array::from_fn(|i| u16::from_le_bytes([row[2 * i], row[2 * i + 1]])))
    }

    /// Appends them to a reply; `None` if they do not fit into it.
    pub(crate) fn write(&self, writer: Writer) -> Option<Writer> {
        self.span.write(writer).word(self.count_word).reply_slice(self.rest)
    }
}

fn word(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes([*bytes.get(at)?, *bytes.get(at + 1)?]))
}

fn two(bytes: &[u8]) -> Option<(u8, u8)> {
    match *bytes {
        [scan, telegram] => Some((scan, telegram)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_of_two_sub_ranges() {
        let data = [2, 0, 1, 0, 2, 0, 2, 0x40, 1, 0, 2, 0, 3, 0, 4, 0, 9, 0, 9, 0, 1, 0, 5, 0, 6, 0, 7, 8];
        let view = Reflectivities::new(&data).unwrap();
        let mut parts = view.parts();
        let part = parts.next().unwrap();
        assert_eq!((part.span, part.count_word), (Span { first: 1, last: 2 }, 0x4002));
        assert!(part.pairs().eq([(1, 2), (3, 4)]));
        assert!(parts.next().unwrap().pairs().eq([(5, 6)]));
        assert!(parts.next().is_none());
        assert_eq!(view.indices(), Some((7, 8)));
        assert_eq!(Reflectivities::new(&data[..27]), None);
        assert_eq!(Reflectivities::new(&data[..26]).unwrap().indices(), None);
        assert_eq!(Reflectivities::new(&[0xFF; 30]), None);
        assert_eq!(Reflectivities::new(&[1]), None);
    }

    #[test]
    fn bytes_of_an_s14() {
        let data = [2, 0, 100, 0, 200, 0, 1, 0, 2, 0, 2, 0, 77];
        let view = Reflectivity::new(&data).unwrap();
        assert!(view.ranges().eq([100, 200]));
        assert_eq!((view.span(), view.levels()), (Span { first: 2, last: 2 }, &[77][..]));
        assert_eq!(Reflectivity::new(&data[..12]), None);
        assert_eq!(Reflectivity::new(&[0xFF, 0xFF]), None);
    }

    #[test]
    fn a_hundred_field_values_fill_a_telegram() {
        let mut data = [0; 806];
        data[4] = 100;
        let view = RangeFields::new(&data).unwrap();
        assert_eq!(view.rows().len(), 100);
        assert_eq!(data.len() + 2, crate::lms::telegram::MAX_LENGTH);
        assert_eq!(RangeFields::new(&data[..805]), None);
        assert_eq!(RangeFields::new(&data[..5]), None);
    }
}
