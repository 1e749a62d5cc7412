//! Positions in the framer's buffer at which a telegram may begin, and where each would end. Their number is bounded by
//! the headers that fit into the buffer, so they need no heap.

use crate::lms::framer::CAPACITY;
use crate::lms::header::HEADER_DISTANCE;

/// A position with an acceptable header, and where its telegram would end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Candidate {
    pub(crate) at: u16,
    pub(crate) end: u16,
}

/// The candidates in a full buffer, ascending by position.
#[derive(Clone, Debug)]
pub(crate) struct Candidates {
    list: [Candidate; Candidates::CAPACITY],
    len: usize,
}

impl Candidates {
    const CAPACITY: usize = CAPACITY.div_ceil(HEADER_DISTANCE);

    pub(crate) fn new() -> Self {
        Candidates { list: [Candidate::default(); Candidates::CAPACITY], len: 0 }
    }

    fn as_slice(&self) -> &[Candidate] {
        &self.list[..self.len]
    }

    pub(crate) fn push(&mut self, at: usize, end: usize) {
        self.list[self.len] = Candidate { at: at as u16, end: end as u16 };
        self.len += 1;
    }

    pub(crate) fn first(&self) -> Option<Candidate> {
        self.as_slice().first().copied()
    }

    /// Returns the candidate that is complete first, with bytes up to `end`. If two have the same end, it is the inner
    /// one, which may refute the outer one.
    pub(crate) fn first_complete(&self, end: usize) -> Option<Candidate> {
        let complete = self.as_slice().iter().filter(|candidate| usize::from(candidate.end) <= end);
        complete.copied().min_by_key(|candidate| (candidate.end, core::cmp::Reverse(candidate.at)))
    }

    pub(crate) fn any_before(&self, at: usize) -> bool {
        self.first().is_some_and(|candidate| usize::from(candidate.at) < at)
    }

    pub(crate) fn remove(&mut self, candidate: Candidate) {
        if let Ok(at) = self.as_slice().binary_search_by_key(&candidate.at, |other| other.at) {
            self.list.copy_within(at + 1..self.len, at);
            self.len -= 1;
        }
    }

    pub(crate) fn drop_before(&mut self, at: usize) {
        let gone = self.as_slice().partition_point(|candidate| usize::from(candidate.at) < at);
        self.list.copy_within(gone..self.len, 0);
        self.len -= gone;
    }

    pub(crate) fn shift(&mut self, by: usize) {
        for candidate in &mut self.list[..self.len] {
            candidate.at -= by as u16;
            candidate.end -= by as u16;
        }
    }
}
