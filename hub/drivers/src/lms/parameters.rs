//! The parts that several telegrams are made of: sub-ranges, passwords, and parameters of which only the bytes are
//! known. Owned and of fixed size, so that a request can be kept without a heap.

use crate::lms::telegram::Writer;

/// A sub-range of the values, both ends included, counted from 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Span {
    /// The first value.
    pub first: u16,
    /// The last value.
    pub last: u16,
}

impl Span {
    /// Bytes on the wire: two words.
    pub const LEN: usize = 4;

    /// The span that exactly these four bytes are.
    pub(crate) fn read(bytes: &[u8]) -> Option<Span> {
        let &[a, b, c, d] = bytes else { return None };
        Some(Span { first: u16::from_le_bytes([a, b]), last: u16::from_le_bytes([c, d]) })
    }

    pub(crate) fn write(self, writer: Writer) -> Writer {
        writer.word(self.first).word(self.last)
    }
}

/// One to five sub-ranges.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Spans {
    list: [Span; Spans::MAX],
    len: u8,
}

impl Spans {
    /// As many as a telegram may name (Telegram listing, 75h).
    pub const MAX: usize = 5;

    /// `None` if there are none, or more than five.
    pub fn new(spans: &[Span]) -> Option<Spans> {
        if spans.is_empty() {
            return None;
        }
        let mut list = [Span::default(); Spans::MAX];
        list.get_mut(..spans.len())?.copy_from_slice(spans);
        Some(Spans { list, len: spans.len() as u8 })
    }

    /// The spans in their order.
    pub fn as_slice(&self) -> &[Span] {
        &self.list[..usize::from(self.len)]
    }

    /// A word that counts them, then as many.
    pub(crate) fn read_counted(bytes: &[u8]) -> Option<Spans> {
        let (count, rest) = bytes.split_first_chunk()?;
        let count = usize::from(u16::from_le_bytes(*count));
        if count > Spans::MAX || rest.len() != count * Span::LEN {
            return None;
        }
        let mut list = [Span::default(); Spans::MAX];
        for (span, bytes) in list.iter_mut().zip(rest.chunks_exact(Span::LEN)) {
            *span = Span::read(bytes)?;
        }
        Spans::new(&list[..count])
    }

    pub(crate) fn write(&self, writer: Writer) -> Writer {
        self.as_slice().iter().fold(writer, |writer, span| span.write(writer))
    }
}

/// The eight characters that open the installation mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Password(pub [u8; 8]);

impl Password {
    /// The one that every sensor leaves the factory with (Telegram listing 6-4).
    pub const FACTORY: Password = Password(*b"SICK_LMS");
}

/// Parameters of which no layout is known here: at most sixteen bytes, as they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Raw {
    bytes: [u8; Raw::MAX],
    len: u8,
}

impl Raw {
    /// Longest parameters that are kept.
    pub const MAX: usize = 16;

    /// `None` if they are longer than [`Raw::MAX`].
    pub fn new(bytes: &[u8]) -> Option<Raw> {
        let mut kept = [0; Raw::MAX];
        kept.get_mut(..bytes.len())?.copy_from_slice(bytes);
        Some(Raw { bytes: kept, len: bytes.len() as u8 })
    }

    /// The bytes.
    pub fn as_slice(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_to_five_spans() {
        let span = Span { first: 1, last: 2 };
        assert_eq!(Spans::new(&[]), None);
        assert_eq!(Spans::new(&[span; 6]), None);
        assert_eq!(Spans::new(&[span; 5]).unwrap().as_slice(), [span; 5]);
        assert_eq!(Spans::read_counted(&[1, 0, 1, 0, 2, 0]), Spans::new(&[span]));
        assert_eq!(Spans::read_counted(&[2, 0, 1, 0, 2, 0]), None);
        assert_eq!(Spans::read_counted(&[0, 0]), None);
        assert_eq!(Spans::read_counted(&[0]), None);
    }

    #[test]
    fn raw_parameters_end_somewhere() {
        assert_eq!(Raw::new(&[7; 16]).unwrap().as_slice(), [7; 16]);
        assert_eq!(Raw::new(&[7; 17]), None);
    }
}
