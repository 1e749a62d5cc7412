//! Finds telegrams in a stream that may lack bytes, and never discards an intact one.
//!
//! A parser that collects a damaged telegram to its announced length includes the beginning of the next one. So no byte is
//! discarded here before it was examined: every position with an acceptable header is a *candidate*, and the first
//! candidate that is complete with a right checksum is the telegram. Because that checksum is weak, such a frame is *held*
//! while another header begins inside it, or might begin with its last bytes. If that one succeeds, the frame was wrong. A
//! gap in time may release a held frame, but it never drops a byte.
//!
//! The counters in [`FramerCounters`] include every byte: always `read == in_telegrams + acknowledge + discarded + buffered`.

use scanhub_schema::{MILLIS, Nanos};

use crate::line::suspect;
use crate::lms::header::{
    ExpectedHeaders, HeaderCheck, MAX_HEADER_LEN, MIN_HEADER_DISTANCE, Reject, State, check_header,
};
use crate::lms::measured::MEASURED;
use crate::lms::telegram::{ACK, Checksum, MAX_TELEGRAM, NAK, STX, Telegram};

/// What became of the bytes; every field only grows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FramerCounters {
    /// Bytes committed.
    pub read: u64,
    /// Bytes in delivered telegrams.
    pub in_telegrams: u64,
    /// ACK and NAK outside telegrams, while a reply was awaited.
    pub acknowledge: u64,
    /// Bytes that were in nothing.
    pub discarded: u64,
    /// Of these the bytes of measured-value telegrams that broke off for a reply.
    pub broken_off: u64,
    /// Delivered telegrams.
    pub telegrams: u64,
    /// Measured-value telegrams that broke off for a reply.
    pub aborted: u64,
    /// Delivered telegrams that had to wait for a header inside them to fail.
    pub held: u64,
    /// Refused start bytes among the discarded, by [`Reject`].
    pub rejected: [u64; Reject::COUNT],
}

/// A telegram as it was found.
#[derive(Clone, Copy, Debug)]
pub struct FramedTelegram<'a> {
    /// The telegram; it lies in the framer's buffer.
    pub telegram: Telegram<'a>,
    /// Number of its first byte among all bytes committed, from 0.
    pub offset: u64,
    /// Bits of [`suspect`]; 0 is clean.
    pub reasons: u8,
}

/// The bytes of a telegram that has begun, as far as they are there: nothing of them is checked but the header.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PartialTelegram<'a> {
    /// From its start byte on.
    pub(crate) bytes: &'a [u8],
    /// Number of its first byte among all bytes committed, from 0.
    pub(crate) offset: u64,
    /// Bits of [`suspect`] that are known already.
    pub(crate) reasons: u8,
}

/// What was found next.
#[derive(Clone, Copy, Debug)]
pub enum FramerEvent<'a> {
    /// A telegram.
    Telegram(FramedTelegram<'a>),
    /// A single ACK.
    Ack,
    /// A single NAK.
    Nak,
}

/// [`Found`] without the bytes.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FoundItem {
    Telegram(TelegramSpan),
    Ack,
    Nak,
}

/// Where in the buffer a telegram lies, until the next bytes come.
#[derive(Clone, Copy, Debug)]
pub struct TelegramSpan {
    at: usize,
    end: usize,
    pub(crate) offset: u64,
    reasons: u8,
}

/// The framer with its buffer of twice the longest telegram.
#[derive(Clone, Debug)]
pub struct Framer {
    buffer: [u8; BUFFER_LEN],
    /// `buffer[start..end]` are the bytes whose fate is open.
    start: usize,
    end: usize,
    /// Every position before it was judged.
    cursor: usize,
    /// Positions with an acceptable header whose checksum was not looked at, ascending.
    candidates: Candidates,
    /// A frame with a right checksum that waits for a header inside it.
    held: Option<HeldFrame>,
    /// Checksum of a candidate that is arriving, and the number of its first byte.
    partial_checksum: (u64, Checksum),
    expect: ExpectedHeaders,
    expects_acknowledge: bool,
    /// Bytes were discarded since the last telegram.
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
    /// Room for the next bytes, never empty after [`Framer::poll`] answered `None`: write into its beginning, then
    /// [`Framer::commit`].
    pub fn read_buffer(&mut self) -> &mut [u8] {
        if self.start == self.end {
            self.shift(self.start);
        } else if BUFFER_LEN - self.end < MAX_TELEGRAM {
            self.buffer.copy_within(self.start..self.end, 0);
            self.shift(self.start);
        }
        &mut self.buffer[self.end..]
    }

    /// The first `len` bytes of [`Framer::read_buffer`] are valid now.
    pub fn commit(&mut self, len: usize) {
        self.end += len;
        assert!(self.end <= BUFFER_LEN, "more bytes committed than there was room");
        self.counters.read += len as u64;
    }

    /// What may come from now on. Bytes that were judged stay judged.
    pub fn expect(&mut self, expect: ExpectedHeaders) {
        self.expect = expect;
    }

    /// Whether single ACK and NAK bytes may come.
    pub fn expect_acknowledge(&mut self, is_expected: bool) {
        self.expects_acknowledge = is_expected;
    }

    /// The next telegram or acknowledgement in the bytes committed so far, or `None` until more come.
    pub fn poll(&mut self) -> Option<FramerEvent<'_>> {
        Some(match self.advance()? {
            FoundItem::Telegram(span) => FramerEvent::Telegram(self.telegram_at(span)),
            FoundItem::Ack => FramerEvent::Ack,
            FoundItem::Nak => FramerEvent::Nak,
        })
    }

    /// The telegram at a span that [`Framer::advance`] answered last.
    pub(crate) fn telegram_at(&self, span: TelegramSpan) -> FramedTelegram<'_> {
        let TelegramSpan { at, end, offset, reasons } = span;
        FramedTelegram { telegram: Telegram::assume_valid(&self.buffer[at..end]), offset, reasons }
    }

    /// As [`Framer::poll`], for a caller who must look at other things between finding and reading.
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

    /// How long the line must be idle until [`Framer::release`] may deliver the held frame; `None` if none is held.
    pub fn hold(&self) -> Option<Nanos> {
        self.held.map(|held| {
            if self.candidates.has_candidate_before(held.end) { VETO_HOLD_TIME } else { SUFFIX_HOLD_TIME }
        })
    }

    /// A read found nothing, and no byte came for `idle`: gives up waiting for headers inside the held frame.
    pub fn release(&mut self, idle: Nanos) {
        if self.hold().is_some_and(|hold| idle >= hold) {
            self.refute_headers_inside();
            self.cursor = self.held.map_or(self.cursor, |held| self.cursor.max(held.end));
        }
    }

    /// Gives up all bytes that are still open, for example because the line's rate changes.
    pub fn clear(&mut self) {
        self.candidates = Candidates::new();
        self.held = None;
        self.discard(self.end, None);
        self.cursor = self.end;
        self.has_damage = false;
    }

    /// What the earliest open position waits for, after [`Framer::poll`] answered `None`.
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

    /// The earliest telegram that has begun and was not delivered, after [`Framer::poll`] answered `None`.
    pub(crate) fn partial_telegram(&self) -> Option<PartialTelegram<'_>> {
        let held = self.held.map(|held| (held.at, held.end));
        let first_candidate =
            || self.candidates.first().map(|candidate| (candidate.at.into(), candidate.end.into()));
        let (at, end): (usize, usize) = held.or_else(first_candidate)?;
        let reasons = if self.has_damage || at > self.start { suspect::NEIGHBOUR } else { 0 };
        Some(PartialTelegram { bytes: &self.buffer[at..end.min(self.end)], offset: self.offset(at), reasons })
    }

    /// What became of the bytes.
    pub fn counters(&self) -> &FramerCounters {
        &self.counters
    }

    /// Bytes whose fate is open.
    pub fn buffered(&self) -> usize {
        self.end - self.start
    }

    /// Returns the number of the byte at `at` among all bytes committed, from 0.
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

    /// Adds the bytes that have arrived to the checksum of the first candidate, so that little is left to do after its last
    /// byte.
    fn add_arrived(&mut self) {
        if let Some(first) = self.candidates.first() {
            let (at, end) = (usize::from(first.at), usize::from(first.end));
            let mut checksum = self.checksum(at);
            checksum.extend(&self.buffer[at..self.end.min(end - 2)]);
            self.partial_checksum = (self.offset(at), checksum);
        }
    }

    /// Returns the checksum of the candidate at `at`, which may already include some of its bytes.
    fn checksum(&self, at: usize) -> Checksum {
        let (offset, checksum) = self.partial_checksum;
        if offset == self.offset(at) { checksum } else { Checksum::default() }
    }

    /// Looks at the checksum of the earliest complete candidate: a wrong one ends it, a right one ends those that
    /// began before it and the held frame that it began in.
    fn complete(&mut self, candidate: Candidate) {
        let (at, end) = (usize::from(candidate.at), usize::from(candidate.end));
        let is_valid = Telegram::check_with(&self.buffer[at..end], self.checksum(at)).is_some();
        match &mut self.held {
            // What began inside the held frame reaches into this telegram, so it is none.
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

    /// Whatever becomes of `held`, what came before it is in nothing.
    fn discard_before(&mut self, held: HeldFrame) {
        self.discard(held.at, Some((self.buffer[held.at + 4], held.end)));
    }

    /// Gives up the bytes before `to`; `winner` is the command of the telegram that begins there, and its end.
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

    /// Counts why the start byte at `at` was none, as it stood when the bytes before `decided` were there. Whether a scan
    /// began there that broke off.
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

    /// The bytes before `by` are gone from the buffer.
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

/// Returns the index of the first STX. A block without one is skipped by a single vector comparison.
fn find_stx(bytes: &[u8]) -> Option<usize> {
    let is_empty = |block: &&[u8; 16]| !block.iter().fold(false, |any, &byte| any | (byte == STX));
    let skipped = 16 * bytes.as_chunks().0.iter().take_while(is_empty).count();
    bytes[skipped..].iter().position(|&byte| byte == STX).map(|at| skipped + at)
}

/// A held frame and a header that begins with its last byte must fit.
pub(crate) const BUFFER_LEN: usize = 2 * MAX_TELEGRAM;
/// The longest pause inside a telegram (Telegram listing 4.3): a header inside a held frame is given up after it.
pub const VETO_HOLD_TIME: Nanos = 14 * MILLIS;
/// A frame whose last bytes might begin a header is delivered when nothing followed for so long.
pub const SUFFIX_HOLD_TIME: Nanos = 2 * MILLIS;

/// A position with an acceptable header, and where its telegram would end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Candidate {
    pub(crate) at: u16,
    pub(crate) end: u16,
}

/// The candidates in a full buffer, ascending by position.
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

    /// Returns the candidate that is complete first, with bytes up to `end`. If two have the same end, it is the inner
    /// one, which may refute the outer one.
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
