//! What can be read from a damaged file: every byte of it may be wrong, also lengths. Two things can be verified wherever
//! they are: a chunk by its CRC-32, and a telegram by its own length and CRC. Everything else is searched byte by byte, so
//! damaged data never hides intact data. Refuses to know which sensor a telegram belongs to.

use std::io::{self, Read};

use lms::telegram::{FRAME, MAX_TELEGRAM, REPLY, STX, Telegram};
use mcap::MAGIC;
use mcap::records::{MessageHeader, op};

use super::chunk::Chunk;
use super::exact::{self, ChunkHead, HEAD, MESSAGE};
use super::records::Record;
use super::seen::Seen;
use super::window::Window;

/// What was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Found {
    /// A record that a checksum vouches for.
    Proven(Record),
    /// A record whose fields fill it exactly, and which may be harmed all the same.
    Likely(Record),
    /// A telegram in what is harmed.
    Lone(Lone),
}

/// A telegram whose surroundings cannot be relied on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Lone {
    pub(crate) telegram: Vec<u8>,
    /// Its message, if that has the length that it should have.
    pub(crate) message: Option<MessageHeader>,
    /// The bytes before it, where its header should be.
    pub(crate) header: [u8; HEADER],
}

/// Searches a file from its beginning to its end.
pub(crate) struct Salvage<R> {
    window: Window<R>,
    /// Where the search goes on.
    at: u64,
    /// Records of a sound chunk.
    records: Chunk,
    /// Chunks that were there: their places in time, and their checksums.
    chunks: Seen,
    /// All bytes before it were counted or belong to something.
    accounted: u64,
    account: Account,
}

/// What belongs to nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Account {
    /// Bytes.
    pub(crate) passed: u64,
    /// Packed chunks that could not be opened.
    pub(crate) chunks: u64,
    /// Whether the file ends as it should.
    pub(crate) has_end: bool,
}

impl<R: Read> Salvage<R> {
    pub(crate) fn new(input: R) -> Self {
        Salvage {
            window: Window::new(input),
            at: 0,
            records: Chunk::default(),
            chunks: Seen::default(),
            accounted: 0,
            account: Account::default(),
        }
    }

    /// What belongs to nothing, as far as it was searched.
    pub(crate) fn account(&self) -> Account {
        self.account
    }

    /// What comes next; an error if the file cannot be read, of kind `FileTooLarge` at a chunk that is too long.
    pub(crate) fn next(&mut self) -> io::Result<Option<Found>> {
        loop {
            if let Some(record) = self.records.next() {
                return Ok(Some(Found::Proven(record)));
            }
            // What is before a telegram is looked at when it is found.
            self.window.release(self.at.saturating_sub(BEFORE as u64));
            let bytes = self.window.bytes(self.at, LOOK)?;
            if bytes.is_empty() {
                self.belongs(self.at, self.at);
                return Ok(None);
            }
            let Some(skipped) = bytes.iter().position(|&byte| may_begin(byte)) else {
                self.at += bytes.len() as u64;
                continue;
            };
            self.at += skipped as u64;
            if let Some(found) = self.look()? {
                return Ok(Some(found));
            }
        }
    }

    /// What begins here; goes on behind it, or by one byte.
    fn look(&mut self) -> io::Result<Option<Found>> {
        let at = self.at;
        let bytes = self.window.bytes(at, MAX_TELEGRAM)?;
        if let Some(telegram) = telegram(bytes) {
            let telegram = telegram.to_vec();
            return self.lone(telegram).map(|lone| Some(Found::Lone(lone)));
        }
        if bytes.starts_with(MAGIC) {
            let end = at + MAGIC.len() as u64;
            self.belongs(at, end);
            self.at = end;
            self.account.has_end = self.window.bytes(end, 1)?.is_empty();
            return Ok(None);
        }
        self.at += 1;
        if let Some(length) = exact::long_chunk(bytes) {
            let (megabytes, most) = (length >> 20, exact::LONGEST >> 20);
            let what = format!("it has a chunk of {megabytes} MB; at most {most} MB are read at a time");
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, what));
        }
        let Some(length) = exact::length(bytes) else { return Ok(None) };
        if bytes[0] == op::CHUNK {
            self.open_chunk(at, length)?;
            return Ok(None);
        }
        let whole = self.window.bytes(at, HEAD + length)?;
        let Some(record) = exact::record(whole) else { return Ok(None) };
        // Only the head of it is passed: it may have swallowed something.
        self.belongs(at, at + (HEAD + length) as u64);
        Ok(Some(Found::Likely(record)))
    }

    /// Goes on behind a chunk that is sound, and hands out its records.
    fn open_chunk(&mut self, at: u64, length: usize) -> io::Result<()> {
        if !exact::may_be_chunk(self.window.bytes(at, LOOK)?) {
            return Ok(());
        }
        let bytes = self.window.bytes(at, HEAD + length)?;
        let Some(body) = bytes.get(HEAD..HEAD + length) else { return Ok(()) };
        let Some(head) = ChunkHead::of(body) else { return Ok(()) };
        let Ok(records) = Chunk::open(body.to_vec()) else {
            self.account.chunks += u64::from(!head.packing.is_empty());
            return Ok(());
        };
        if self.chunks.is_new(head.name, &[]) {
            self.records = records;
        }
        let end = at + (HEAD + length) as u64;
        self.belongs(at, end);
        self.at = end;
        Ok(())
    }

    /// The telegram that begins here, with what is before it.
    fn lone(&mut self, telegram: Vec<u8>) -> io::Result<Lone> {
        let (at, end) = (self.at, self.at + telegram.len() as u64);
        let mut before = [0; BEFORE];
        let there = at.min(BEFORE as u64) as usize;
        let bytes = self.window.bytes(at - there as u64, there)?;
        if let Some(bytes) = bytes.get(..there) {
            before[BEFORE - there..].copy_from_slice(bytes);
        }
        let (message, header) = before.split_at(HEAD + MESSAGE);
        let message = message_of(message, HEADER + telegram.len());
        let begin = at - if message.is_some() { there as u64 } else { 0 };
        self.belongs(begin, end);
        self.at = end;
        let header = header.try_into().unwrap_or([0; HEADER]);
        Ok(Lone { telegram, message, header })
    }

    /// The bytes from `begin` to `end` belong to something; those before that belong to nothing are counted.
    fn belongs(&mut self, begin: u64, end: u64) {
        self.account.passed += begin.saturating_sub(self.accounted);
        self.accounted = self.accounted.max(end);
    }
}

/// Whether `byte` may be the first of a record, a telegram or the end.
fn may_begin(byte: u8) -> bool {
    (op::HEADER..=op::DATA_END).contains(&byte) || byte == MAGIC[0]
}

/// The telegram from a sensor that `bytes` begin with.
fn telegram(bytes: &[u8]) -> Option<&[u8]> {
    let &[STX, address, low, high, command, ..] = bytes else { return None };
    let length = usize::from(u16::from_le_bytes([low, high]));
    let is_from_sensor = address & REPLY != 0 && command & REPLY != 0;
    let telegram = bytes.get(..length + FRAME).filter(|_| is_from_sensor)?;
    Telegram::check(telegram).map(|telegram| telegram.bytes())
}

/// The head of a message of `len` bytes of data.
fn message_of(head: &[u8], len: usize) -> Option<MessageHeader> {
    let is_so_long = exact::length(head)? == MESSAGE + len && head[0] == op::MESSAGE;
    exact::head_of_message(&head[HEAD..]).filter(|_| is_so_long)
}

/// Bytes of a header.
pub(crate) const HEADER: usize = size_of::<schema::Header>();
/// What stands before a telegram in a message.
const BEFORE: usize = HEAD + MESSAGE + HEADER;
/// Bytes looked at at a time.
const LOOK: usize = 64 * 1024;
