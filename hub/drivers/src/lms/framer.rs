//! Framer that finds telegrams in a stream that may lack bytes. It never discards an intact telegram.
//!
//! A parser that collects a damaged telegram up to its announced length also consumes the beginning of the next
//! telegram. The framer therefore examines every byte before it discards it. Each position with an acceptable header is
//! a *candidate*. The first candidate that is complete and has a right checksum is the telegram. The checksum is weak,
//! so the framer *holds* a complete frame while another header begins inside it, or while its last bytes may be the
//! beginning of a header. If the inner telegram turns out to be valid, the outer frame was wrong. A pause on the line
//! may release a held frame, but the framer never discards a byte because of a pause.
//!
//! [`FramerCounters`] accounts for every byte. The equation `read == in_telegrams + acknowledge + discarded + buffered`
//! always holds.

use scanhub_schema::{MILLIS, Nanos};

use crate::line::suspect;
use crate::lms::header::{
    ExpectedHeaders, HeaderCheck, MAX_HEADER_LEN, MIN_HEADER_DISTANCE, Reject, State, check_header,
};
use crate::lms::measured::MEASURED;
use crate::lms::telegram::{ACK, Checksum, MAX_TELEGRAM, NAK, STX, Telegram};

/// Counters of bytes and telegrams. They only increase.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FramerCounters {
    /// Bytes committed.
    pub read: u64,
    /// Bytes in delivered telegrams.
    pub in_telegrams: u64,
    /// ACK and NAK bytes that arrived outside telegrams while a reply was expected.
    pub acknowledge: u64,
    /// Bytes that are not part of a telegram or an acknowledgement.
    pub discarded: u64,
    /// Discarded bytes of measured-value telegrams that the scanner broke off to send a reply. `discarded` includes
    /// them.
    pub broken_off: u64,
    /// Delivered telegrams.
    pub telegrams: u64,
    /// Measured-value telegrams that the scanner broke off to send a reply.
    pub aborted: u64,
    /// Delivered telegrams that were held because another header began inside them.
    pub held: u64,
    /// Number of start bytes among the discarded bytes, by the reason for the rejection.
    pub rejected: [u64; Reject::COUNT],
}

/// A telegram with its position in the stream.
#[derive(Clone, Copy, Debug)]
pub struct FramedTelegram<'a> {
    /// The telegram, in the framer's buffer.
    pub telegram: Telegram<'a>,
    /// Offset of the telegram's first byte, counted from the first committed byte.
    pub offset: u64,
    /// Bits of [`suspect`]; 0 if the telegram is clean.
    pub reasons: u8,
}

/// The received bytes of an incomplete telegram. Only its header has been checked.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PartialTelegram<'a> {
    /// Bytes from the start byte on.
    pub(crate) bytes: &'a [u8],
    /// Offset of the first byte, counted from the first committed byte.
    pub(crate) offset: u64,
    /// Bits of [`suspect`] that can already be determined.
    pub(crate) reasons: u8,
}

/// Next telegram or acknowledgement in the stream.
#[derive(Clone, Copy, Debug)]
pub enum FramerEvent<'a> {
    /// A telegram.
    Telegram(FramedTelegram<'a>),
    /// A single ACK.
    Ack,
    /// A single NAK.
    Nak,
}

/// [`FramerEvent`] without the telegram's bytes.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FoundItem {
    Telegram(TelegramSpan),
    Ack,
    Nak,
}

/// Location of a telegram in the buffer. The location is valid until the next bytes are committed.
#[derive(Clone, Copy, Debug)]
pub struct TelegramSpan {
    at: usize,
    end: usize,
    pub(crate) offset: u64,
    reasons: u8,
}

/// The framer. Its buffer has room for two telegrams of the maximum length.
#[derive(Clone, Debug)]
pub struct Framer {
    buffer: [u8; BUFFER_LEN],
    /// `buffer[start..end]` contains the bytes that are neither delivered nor discarded.
    start: usize,
    end: usize,
    /// Position in the buffer. All earlier positions have been checked for a header.
    cursor: usize,
    /// Positions with an acceptable header whose checksum has not been checked yet, ascending.
    candidates: Candidates,
    /// A frame with a right checksum that the framer holds because another header may begin inside it.
    held: Option<HeldFrame>,
    /// Offset of a candidate's first byte, and the checksum of the candidate's bytes so far.
    partial_checksum: (u64, Checksum),
    expect: ExpectedHeaders,
    expects_acknowledge: bool,
    /// Whether bytes were discarded since the last telegram.
    has_damage: bool,
    counters: FramerCounters,
}

#[derive(Clone, Copy, Debug)]
struct HeldFrame {
    at: usize,
    end: usize,
    header_inside: bool,
}

impl Default for Framer {
    fn default() -> Self {
        Framer {
            buffer: [0; BUFFER_LEN],
            start: 0,
            end: 0,
            cursor: 0,
            candidates: Candidates::new(),
            held: None,
            partial_checksum: (0, Checksum::default()),
            expect: ExpectedHeaders::Anything,
            expects_acknowledge: false,
            has_damage: false,
            counters: FramerCounters::default(),
        }
    }
}

impl Framer {
    /// Returns the space for the next bytes. The space is never empty after [`Framer::poll`] has returned `None`. The
    /// caller writes to the beginning of the space and then calls [`Framer::commit`].
    pub fn read_buffer(&mut self) -> &mut [u8] {
        if self.start == self.end {
            self.shift(self.start);
        } else if BUFFER_LEN - self.end < MAX_TELEGRAM {
            self.buffer.copy_within(self.start..self.end, 0);
            self.shift(self.start);
        }
        &mut self.buffer[self.end..]
    }

    /// Adds the first `len` bytes of [`Framer::read_buffer`] to the stream.
    pub fn commit(&mut self, len: usize) {
        self.end += len;
        assert!(self.end <= BUFFER_LEN, "more bytes committed than there was room");
        self.counters.read += len as u64;
    }

    /// Sets the acceptable headers. Positions that have already been checked keep their results.
    pub fn expect(&mut self, expect: ExpectedHeaders) {
        self.expect = expect;
    }

    /// Sets whether the framer treats single ACK and NAK bytes as acknowledgements.
    pub fn expect_acknowledge(&mut self, is_expected: bool) {
        self.expects_acknowledge = is_expected;
    }

    /// Returns the next telegram or acknowledgement in the committed bytes. Returns `None` if more bytes are necessary.
    pub fn poll(&mut self) -> Option<FramerEvent<'_>> {
        Some(match self.advance()? {
            FoundItem::Telegram(span) => FramerEvent::Telegram(self.telegram_at(span)),
            FoundItem::Ack => FramerEvent::Ack,
            FoundItem::Nak => FramerEvent::Nak,
        })
    }

    /// Returns the telegram at a span that [`Framer::advance`] returned last.
    pub(crate) fn telegram_at(&self, span: TelegramSpan) -> FramedTelegram<'_> {
        let TelegramSpan { at, end, offset, reasons } = span;
        FramedTelegram { telegram: Telegram::assume_valid(&self.buffer[at..end]), offset, reasons }
    }

    /// Returns the same as [`Framer::poll`], but does not borrow the buffer.
    pub(crate) fn advance(&mut self) -> Option<FoundItem> {
        loop {
            self.check_headers();
            if let Some(held) = self.held
                && self.cursor >= held.end
                && !self.candidates.has_candidate_before(held.end)
            {
                return Some(FoundItem::Telegram(self.deliver(held)));
            }
            if let Some(candidate) = self.candidates.first_complete(self.end) {
                self.complete(candidate);
                continue;
            }
            self.add_arrived();
            if let Some(held) = self.held {
                self.discard_before(held);
                return None;
            }
            let decided = self.candidates.first().map_or(self.cursor, |candidate| usize::from(candidate.at));
            if self.expects_acknowledge
                && let Some(at) = (self.start..decided).find(|&at| matches!(self.buffer[at], ACK | NAK))
            {
                self.discard(at, None);
                self.start = at + 1;
                self.counters.acknowledge += 1;
                return Some(if self.buffer[at] == ACK { FoundItem::Ack } else { FoundItem::Nak });
            }
            self.discard(decided, None);
            return None;
        }
    }

    /// Returns the time without bytes after which [`Framer::release`] delivers the held frame. Returns `None` if no
    /// frame is held.
    pub fn hold_time(&self) -> Option<Nanos> {
        self.held.map(|held| {
            if self.candidates.has_candidate_before(held.end) { VETO_HOLD_TIME } else { SUFFIX_HOLD_TIME }
        })
    }

    /// Handles a read without bytes, after the line has been idle for `idle` ns. If `idle` is long enough, the framer
    /// no longer waits for telegrams inside the held frame.
    pub fn release(&mut self, idle: Nanos) {
        if self.hold_time().is_some_and(|hold| idle >= hold) {
            self.refute_headers_inside();
            self.cursor = self.held.map_or(self.cursor, |held| self.cursor.max(held.end));
        }
    }

    /// Discards all undecided bytes, for example because the baud rate changes.
    pub fn clear(&mut self) {
        self.candidates = Candidates::new();
        self.held = None;
        self.discard(self.end, None);
        self.cursor = self.end;
        self.has_damage = false;
    }

    /// Returns the part of the telegram that the earliest candidate needs next. Call it after [`Framer::poll`] has
    /// returned `None`.
    pub fn state(&self) -> State {
        match self.candidates.first() {
            Some(candidate) if self.end + 2 < usize::from(candidate.end) => State::Body,
            Some(_) => State::Crc,
            None => match check_header(&self.buffer[self.cursor..self.end], &self.expect) {
                HeaderCheck::Prefix(state) => state,
                HeaderCheck::Candidate { .. } | HeaderCheck::Refused(_) => State::Stx,
            },
        }
    }

    /// Returns the earliest telegram that has begun but was not delivered. Call it after [`Framer::poll`] has returned
    /// `None`.
    pub(crate) fn partial_telegram(&self) -> Option<PartialTelegram<'_>> {
        let held = self.held.map(|held| (held.at, held.end));
        let first_candidate =
            || self.candidates.first().map(|candidate| (candidate.at.into(), candidate.end.into()));
        let (at, end): (usize, usize) = held.or_else(first_candidate)?;
        let reasons = if self.has_damage || at > self.start { suspect::NEIGHBOUR } else { 0 };
        Some(PartialTelegram { bytes: &self.buffer[at..end.min(self.end)], offset: self.offset(at), reasons })
    }

    /// Returns the counters.
    pub fn counters(&self) -> &FramerCounters {
        &self.counters
    }

    /// Returns the number of bytes that are neither delivered nor discarded.
    pub fn buffered(&self) -> usize {
        self.end - self.start
    }

    /// Returns the offset of the byte at index `at` of the buffer, counted from the first committed byte.
    fn offset(&self, at: usize) -> u64 {
        self.counters.read - (self.end - at) as u64
    }

    fn check_headers(&mut self) {
        while let Some(found) = find_stx(&self.buffer[self.cursor..self.end]) {
            let at = self.cursor + found;
            let header = &self.buffer[at..self.end.min(at + MAX_HEADER_LEN)];
            match check_header(header, &self.expect) {
                HeaderCheck::Prefix(_) => {
                    self.cursor = at;
                    return;
                }
                HeaderCheck::Candidate { len } => self.candidates.push(at, at + len),
                HeaderCheck::Refused(_) => {}
            }
            self.cursor = at + 1;
        }
        self.cursor = self.end.max(self.cursor);
    }

    /// Adds the received bytes of the first candidate to its checksum, so that little work is left when the last byte
    /// arrives.
    fn add_arrived(&mut self) {
        if let Some(first) = self.candidates.first() {
            let (at, end) = (usize::from(first.at), usize::from(first.end));
            let mut checksum = self.checksum(at);
            checksum.extend(&self.buffer[at..self.end.min(end - 2)]);
            self.partial_checksum = (self.offset(at), checksum);
        }
    }

    /// Returns the checksum of the candidate at `at`. It may already include some of the candidate's bytes.
    fn checksum(&self, at: usize) -> Checksum {
        let (offset, checksum) = self.partial_checksum;
        if offset == self.offset(at) { checksum } else { Checksum::default() }
    }

    /// Checks the checksum of the earliest complete candidate. If the checksum is wrong, removes the candidate. If it
    /// is right, removes all earlier candidates. The candidate then replaces the held frame, if it began inside this
    /// frame.
    fn complete(&mut self, candidate: Candidate) {
        let (at, end) = (usize::from(candidate.at), usize::from(candidate.end));
        let is_valid = Telegram::check_with(&self.buffer[at..end], self.checksum(at)).is_some();
        match &mut self.held {
            // This telegram begins after the held frame. A candidate inside the held frame would overlap the telegram,
            // so the candidate is not valid.
            Some(held) if is_valid && held.end <= at => return self.refute_headers_inside(),
            Some(held) => held.header_inside |= at < held.end,
            None => {}
        }
        self.candidates.remove(candidate);
        if is_valid {
            self.candidates.drop_before(at);
            self.held = Some(HeldFrame { at, end, header_inside: self.candidates.has_candidate_before(end) });
        }
    }

    fn refute_headers_inside(&mut self) {
        if let Some(held) = &mut self.held {
            held.header_inside |= self.candidates.has_candidate_before(held.end);
            self.candidates.drop_before(held.end);
        }
    }

    fn deliver(&mut self, held: HeldFrame) -> TelegramSpan {
        let HeldFrame { at, end, header_inside } = held;
        self.discard_before(held);
        self.held = None;
        self.start = end;
        self.candidates.drop_before(end);
        self.counters.in_telegrams += (end - at) as u64;
        self.counters.telegrams += 1;
        self.counters.held += u64::from(header_inside);
        let is_damaged = core::mem::take(&mut self.has_damage) && self.counters.telegrams > 1;
        let reasons = if is_damaged { suspect::NEIGHBOUR } else { 0 }
            | if header_inside { suspect::HEADER_INSIDE } else { 0 };
        TelegramSpan { at, end, offset: self.offset(at), reasons }
    }

    /// Discards the bytes before `held`, which cannot belong to any telegram.
    fn discard_before(&mut self, held: HeldFrame) {
        self.discard(held.at, Some((self.buffer[held.at + 4], held.end)));
    }

    /// Discards the bytes before index `to`. `successor` contains the command and the end of the telegram that begins
    /// at `to`.
    fn discard(&mut self, to: usize, successor: Option<(u8, usize)>) {
        let is_reply = successor.is_some_and(|(command, _)| command != MEASURED);
        let decided = successor.map_or(self.end, |(_, end)| end);
        let mut until = to;
        if is_reply && self.expects_acknowledge && until > self.start && self.buffer[until - 1] == ACK {
            until -= 1;
            self.counters.acknowledge += 1;
        }
        let mut broken_off = 0;
        for at in self.start..until {
            if self.buffer[at] == STX && self.count_rejection(at, is_reply, decided) {
                broken_off = broken_off.max(until - at);
            }
        }
        self.counters.broken_off += broken_off as u64;
        self.has_damage |= until > self.start && !is_reply;
        self.counters.discarded += (until - self.start) as u64;
        self.start = to;
    }

    /// Counts the reason why the start byte at `at` did not become a telegram. The reason is determined from the bytes
    /// before `decided`. Returns whether a scan began at `at` that the scanner broke off to send a reply.
    fn count_rejection(&mut self, at: usize, is_reply: bool, decided: usize) -> bool {
        let reject = match check_header(&self.buffer[at..self.end.min(at + MAX_HEADER_LEN)], &self.expect) {
            HeaderCheck::Refused(reject) => reject,
            HeaderCheck::Prefix(_) => Reject::Superseded,
            HeaderCheck::Candidate { len } if at + len > decided => {
                if is_reply && self.buffer[at + 4] == MEASURED {
                    self.counters.aborted += 1;
                    return true;
                }
                Reject::Superseded
            }
            HeaderCheck::Candidate { len } => match Telegram::check(&self.buffer[at..at + len]) {
                Some(_) => Reject::Vetoed,
                None => Reject::Crc,
            },
        };
        self.counters.rejected[reject as usize] += 1;
        false
    }

    /// Adjusts all positions after the removal of the first `by` bytes from the buffer.
    fn shift(&mut self, by: usize) {
        self.start -= by;
        self.end -= by;
        self.cursor -= by;
        self.candidates.shift(by);
        if let Some(held) = &mut self.held {
            held.at -= by;
            held.end -= by;
        }
    }
}

/// Returns the index of the first STX. A block of 16 bytes without an STX needs only one vector comparison.
fn find_stx(bytes: &[u8]) -> Option<usize> {
    let is_empty = |block: &&[u8; 16]| !block.iter().fold(false, |any, &byte| any | (byte == STX));
    let skipped = 16 * bytes.as_chunks().0.iter().take_while(is_empty).count();
    bytes[skipped..].iter().position(|&byte| byte == STX).map(|at| skipped + at)
}

/// Length of the buffer, in bytes. A held frame and a telegram that begins with the last byte of this frame fit into
/// the buffer.
pub(crate) const BUFFER_LEN: usize = 2 * MAX_TELEGRAM;
/// Time without bytes after which the framer ignores a header inside a held frame. This time is the longest pause
/// inside a telegram (Telegram listing 4.3).
pub const VETO_HOLD_TIME: Nanos = 14 * MILLIS;
/// Time without bytes after which the framer delivers a held frame whose last bytes may be the beginning of a header.
pub const SUFFIX_HOLD_TIME: Nanos = 2 * MILLIS;

/// A position with an acceptable header, and the end of its telegram.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Candidate {
    pub(crate) at: u16,
    pub(crate) end: u16,
}

/// The candidates in the buffer, in ascending order of position. The capacity is the maximum number of candidates in a
/// full buffer.
#[derive(Clone, Debug)]
pub(crate) struct Candidates {
    list: [Candidate; Candidates::MAX_CANDIDATES],
    len: usize,
}

impl Candidates {
    const MAX_CANDIDATES: usize = BUFFER_LEN.div_ceil(MIN_HEADER_DISTANCE);

    pub(crate) fn new() -> Self {
        Candidates { list: [Candidate::default(); Candidates::MAX_CANDIDATES], len: 0 }
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

    /// Returns the candidate that is complete first, if the bytes before `end` are available. If two candidates end at
    /// the same position, returns the inner candidate, because this candidate may prove that the outer candidate is
    /// wrong.
    pub(crate) fn first_complete(&self, end: usize) -> Option<Candidate> {
        let complete = self.as_slice().iter().filter(|candidate| usize::from(candidate.end) <= end);
        complete.copied().min_by_key(|candidate| (candidate.end, core::cmp::Reverse(candidate.at)))
    }

    pub(crate) fn has_candidate_before(&self, at: usize) -> bool {
        self.first().is_some_and(|candidate| usize::from(candidate.at) < at)
    }

    pub(crate) fn remove(&mut self, candidate: Candidate) {
        if let Ok(at) = self.as_slice().binary_search_by_key(&candidate.at, |other| other.at) {
            self.list.copy_within(at + 1..self.len, at);
            self.len -= 1;
        }
    }

    pub(crate) fn drop_before(&mut self, at: usize) {
        let removed = self.as_slice().partition_point(|candidate| usize::from(candidate.at) < at);
        self.list.copy_within(removed..self.len, 0);
        self.len -= removed;
    }

    pub(crate) fn shift(&mut self, by: usize) {
        for candidate in &mut self.list[..self.len] {
            candidate.at -= by as u16;
            candidate.end -= by as u16;
        }
    }
}
