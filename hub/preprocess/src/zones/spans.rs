//! The values of each beam that lie within a span, tested by one comparison of integers in device units. Refuses to
//! know what the span is for.

use schema::BEAMS;

/// Ranges as they lie in a scan: the whole array, so that loops have a length that the compiler knows.
pub(super) type Ranges = [u16; BEAMS];

/// The values `from..from + len` of each beam.
#[derive(Clone, Copy)]
pub(super) struct Spans {
    /// The least value; the greatest there is for beams that there are not.
    pub(super) from: [u16; BEAMS],
    len: [u16; BEAMS],
}

impl Spans {
    /// No value of any beam.
    pub(super) const NONE: Spans = Spans { from: [u16::MAX; BEAMS], len: [0; BEAMS] };

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
    pub(super) fn count(&self, ranges: &Ranges) -> u16 {
        (0..BEAMS).map(|i| u16::from(self.has(i, ranges[i]))).sum()
    }
}
