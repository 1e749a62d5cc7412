//! The values of each beam that lie within a span, tested by one comparison of integers in device units. Refuses to
//! know what the span is for.

/// The values `from..from + len` of each beam.
#[derive(Clone)]
pub(super) struct Spans {
    /// The least value; the greatest there is for beams that there are not.
    pub(super) from: Box<[u16]>,
    len: Box<[u16]>,
}

impl Spans {
    /// No value of any of so many beams.
    pub(super) fn none(beams: usize) -> Spans {
        Spans { from: vec![u16::MAX; beams].into(), len: vec![0; beams].into() }
    }

    /// No value of any beam.
    pub(super) fn clear(&mut self) {
        self.from.fill(u16::MAX);
        self.len.fill(0);
    }

    /// Values of beam `i` that count: from `from`, below `below`.
    pub(super) fn set(&mut self, i: usize, from: u64, below: u16) {
        self.from[i] = from.min(u64::from(u16::MAX)) as u16;
        self.len[i] = below.saturating_sub(self.from[i]);
    }

    /// The value counts.
    #[inline]
    pub(super) fn has(&self, i: usize, value: u16) -> bool {
        value.wrapping_sub(self.from[i]) < self.len[i]
    }

    /// There is a value of beam `i` that counts.
    pub(super) fn has_any(&self, i: usize) -> bool {
        self.len[i] > 0
    }

    /// Beams whose value counts.
    pub(super) fn count(&self, ranges: &[u16]) -> u16 {
        let spans = self.from.iter().zip(&self.len);
        spans.zip(ranges).map(|((&from, &len), &value)| u16::from(value.wrapping_sub(from) < len)).sum()
    }
}
