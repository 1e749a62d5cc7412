//! Reader of the records of an MCAP file in the order of the file, including those in chunks.
//!
//! Rules for a damaged file:
//!
//! - A chunk is used completely or not at all, because one CRC-32 covers all of its records. A chunk with a wrong
//!   checksum or opcode is skipped. A record whose fields are longer than the record is skipped, too.
//! - A chunk that the file contains twice is read once.
//! - After a record whose length or opcode is impossible, reading continues at the next chunk whose lengths agree. In a
//!   file with messages outside chunks, reading continues at the next message of the hub.
//! - A truncated file is read to its last complete record.
//!
//! [`Damage`] counts all bytes that were not used. The format is described at <https://mcap.dev/spec>.

use std::borrow::Cow;
use std::collections::HashSet;
use std::hash::{DefaultHasher, Hasher};
use std::io::{self, Cursor, Read};
use std::ops::RangeInclusive;

use flate2::Crc;
use mcap::records::{MessageHeader, Record as Parsed, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError, parse_record};

use super::split_sample;
use crate::Damage;
use crate::open::is_truncation;

/// Record: its opcode ([`mcap::records::op`]), and its bytes after opcode and length.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Record {
    pub(crate) opcode: u8,
    pub(crate) body: Vec<u8>,
    /// Whether the record is in a chunk, whose checksum covers it.
    pub(crate) is_in_chunk: bool,
}

impl Record {
    /// Parses the record. Returns `None` if the fields are longer than the record.
    pub(crate) fn parse(&self) -> Option<Parsed<'_>> {
        // The library panics at an attachment that ends before its checksum.
        if self.opcode == op::ATTACHMENT && !is_attachment(&self.body) {
            return None;
        }
        parse_record(self.opcode, &self.body).ok()
    }

    /// Returns header and data if the record is a message; `None` for any other record.
    pub(crate) fn message(&self) -> Option<(MessageHeader, &[u8])> {
        if self.opcode != op::MESSAGE {
            return None;
        }
        match self.parse()? {
            Parsed::Message { header, data: Cow::Borrowed(data) } => Some((header, data)),
            _ => None,
        }
    }
}

/// Reader of records, up to the end of the file or the position at which its structure is lost.
pub(crate) struct Records<R> {
    input: R,
    /// The open chunk, whose records are returned next.
    chunk: Chunk,
    /// Hashes of the first [`MAX_CHUNKS`] chunks with messages, to detect repeated chunks.
    chunks: HashSet<u64>,
    /// Bytes that are read again before further bytes of `input`.
    unread: Cursor<Vec<u8>>,
    /// Number of positions at which the structure of the file was lost.
    resyncs: u32,
    /// Whether a message was read outside chunks.
    has_messages: bool,
    /// Checksum of the current section: the data section, then the summary.
    section: Crc,
    /// Last bytes that were read. At most as many bytes are stored as the magic bytes have.
    tail: Vec<u8>,
    damage: Damage,
    is_begun: bool,
    is_ended: bool,
}

impl<R: Read> Records<R> {
    pub(crate) fn new(input: R) -> Self {
        Records {
            input,
            chunk: Chunk::default(),
            chunks: HashSet::new(),
            unread: Cursor::default(),
            resyncs: 0,
            has_messages: false,
            section: Crc::new(),
            tail: Vec::new(),
            damage: Damage::default(),
            is_begun: false,
            is_ended: false,
        }
    }

    /// Returns the counts of data that was not used so far. The counts are complete after the last record.
    pub(crate) fn damage(&self) -> Damage {
        self.damage
    }

    /// Returns the next record; `None` at the end.
    ///
    /// # Errors
    ///
    /// Returns the error of the input. Returns `FileTooLarge` at an intact chunk that is longer than
    /// [`MAX_RECORD_LEN`], whether packed or unpacked. Returns `Unsupported` at a chunk with a compression that this
    /// build does not support.
    pub(crate) fn next(&mut self) -> io::Result<Option<Record>> {
        loop {
            if let Some(record) = self.chunk.next() {
                return Ok(Some(record));
            }
            if self.is_ended {
                return Ok(None);
            }
            if !self.is_begun {
                self.is_begun = true;
                let magic = self.read(MAGIC.len())?;
                self.section.update(&magic);
                if magic != MAGIC {
                    self.end_here(magic.len())?;
                    continue;
                }
                // The magic bytes at the end of the file are the same. Clear the tail, so that the magic bytes at the
                // start do not look like those at the end.
                self.tail.clear();
            }
            if let Some(record) = self.read_record()? {
                return Ok(Some(record));
            }
        }
    }

    /// Reads the next record outside chunks. Returns `None` if the record was a chunk, or cannot be used.
    fn read_record(&mut self) -> io::Result<Option<Record>> {
        let head = self.read(HEAD_LEN)?;
        let Some((opcode, length)) = split_head(&head) else {
            self.end_in_record(head.len() as u64);
            return Ok(None);
        };
        if opcode == 0 || length > max_possible_len(opcode) {
            return self.resynchronize(head);
        }
        if opcode == op::CHUNK {
            return self.read_chunk(head, length);
        }
        if length > MAX_RECORD_LEN {
            return self.skip_long(&head, length).map(|()| None);
        }
        let body = self.read(length as usize)?;
        let len = HEAD_LEN as u64 + body.len() as u64;
        if (body.len() as u64) < length {
            return self.end_or_resynchronize(head, body);
        }
        // In these cases, damage has changed the opcode to that of a footer, to that of a data end, or to a reserved
        // opcode.
        let is_no_footer = opcode == op::FOOTER && length != FOOTER_LEN;
        let is_no_end = opcode == op::DATA_END && length != DATA_END_LEN;
        let is_chunk = is_chunk(&body, length);
        if is_chunk || is_no_footer || is_no_end || RESERVED_OPCODES.contains(&opcode) {
            self.damage.chunks += u64::from(is_chunk);
            self.skip(len);
            return Ok(None);
        }
        match opcode {
            op::DATA_END => {
                self.check_section(body.first_chunk());
                self.section.reset();
            }
            op::FOOTER => {
                self.section.update(&head);
                self.section.update(body.get(..FOOTER_CRC_OFFSET).unwrap_or_default());
                self.check_section(body.get(FOOTER_CRC_OFFSET..).and_then(<[u8]>::first_chunk));
                self.end_file()?;
            }
            _ => {
                self.section.update(&head);
                self.section.update(&body);
            }
        }
        if length > max_len(opcode) {
            self.damage.bytes += len;
            return Ok(None);
        }
        let record = Record { opcode, body, is_in_chunk: false };
        if is_interpreted(opcode) && record.parse().is_none() {
            self.skip(len);
            return Ok(None);
        }
        self.has_messages |= opcode == op::MESSAGE;
        Ok(Some(record))
    }

    /// Reads the body of a chunk, and opens the chunk if it can be used.
    fn read_chunk(&mut self, head: Vec<u8>, length: u64) -> io::Result<Option<Record>> {
        let mut body = self.read(CHUNK_HEAD_LEN.min(length as usize))?;
        if !is_chunk(&body, length) {
            let is_end = (body.len() as u64) < length && body.len() < CHUNK_HEAD_LEN;
            return if is_end {
                self.end_or_resynchronize(head, body)
            } else {
                self.resynchronize([head, body].concat())
            };
        }
        if length > MAX_RECORD_LEN {
            return Err(too_long(length));
        }
        body.append(&mut self.read(length as usize - body.len())?);
        let len = HEAD_LEN as u64 + body.len() as u64;
        if (body.len() as u64) < length {
            return self.end_or_resynchronize(head, body);
        }
        self.section.update(&head);
        self.section.update(&body);
        // The chunk starts with the time of its first message, or with 0 if it has no message. Chunks whose messages
        // have no times may be equal, so they are not compared.
        let is_dated = body.iter().take(8).any(|byte| *byte != 0);
        let mut hasher = DefaultHasher::new();
        hasher.write(&body);
        match Chunk::open(body) {
            Ok(_) if is_dated && !self.is_new(hasher.finish()) => {
                self.damage.repeats += 1;
                self.damage.is_damaged = true;
            }
            Ok(chunk) => self.chunk = chunk,
            Err(McapError::UnsupportedCompression(name)) if matches!(&name[..], "lz4" | "zstd") => {
                let what = format!("its chunks are packed by {name}");
                return Err(io::Error::new(io::ErrorKind::Unsupported, what));
            }
            Err(McapError::ChunkTooLarge(len)) => return Err(too_long(len)),
            Err(_) => {
                self.damage.chunks += 1;
                self.skip(len);
            }
        }
        Ok(None)
    }

    /// Returns whether no chunk with this hash was read before. Two chunks of a recorder are never equal, because their
    /// messages have different times and sequence numbers.
    fn is_new(&mut self, hash: u64) -> bool {
        if self.chunks.len() < MAX_CHUNKS { self.chunks.insert(hash) } else { !self.chunks.contains(&hash) }
    }

    /// Counts `record`, which was read outside chunks, as damaged.
    pub(crate) fn reject(&mut self, record: &Record) {
        self.skip((HEAD_LEN + record.body.len()) as u64);
    }

    /// Skips a record that is too long to be held in memory.
    fn skip_long(&mut self, head: &[u8], length: u64) -> io::Result<()> {
        self.damage.bytes += head.len() as u64;
        self.section.update(head);
        let mut remaining = length;
        while remaining > 0 {
            let piece = self.read(remaining.min(READ_LEN) as usize)?;
            if piece.is_empty() {
                self.end_in_record(0);
                break;
            }
            self.section.update(&piece);
            self.damage.bytes += piece.len() as u64;
            remaining -= piece.len() as u64;
        }
        Ok(())
    }

    /// Searches for the next chunk after the start of an impossible record. If the file has messages outside chunks,
    /// the next message of the hub is found, too. Reading continues there. `window` has the bytes that were read since
    /// the start of the record. Always returns `None`.
    fn resynchronize(&mut self, mut window: Vec<u8>) -> io::Result<Option<Record>> {
        self.resyncs += 1;
        let mut from = 1;
        while self.resyncs <= MAX_RESYNCS {
            let missing = (from + READ_LEN as usize).saturating_sub(window.len());
            let is_end = missing > 0 && {
                let more = self.read(missing)?;
                window.extend_from_slice(&more);
                more.len() < missing
            };
            let end = if is_end { window.len() } else { window.len() - HEAD_LEN - CHUNK_HEAD_LEN };
            if let Some(at) = (from..end).find(|&at| is_record_boundary(&window[at..], self.has_messages)) {
                self.skip(at as u64);
                window.drain(..at);
                self.unread.read_to_end(&mut window)?;
                self.unread = Cursor::new(window);
                return Ok(None);
            }
            if is_end {
                break;
            }
            self.skip(end as u64);
            window.drain(..end);
            from = 0;
        }
        self.end_here(window.len())?;
        Ok(None)
    }

    /// Handles a record whose end is missing, because the file was truncated or the record's length is wrong.
    fn end_or_resynchronize(&mut self, head: Vec<u8>, body: Vec<u8>) -> io::Result<Option<Record>> {
        // A truncated file does not end with the magic bytes.
        if self.tail == MAGIC {
            return self.resynchronize([head, body].concat());
        }
        self.end_in_record((head.len() + body.len()) as u64);
        Ok(None)
    }

    /// Reads the magic bytes at the end of the file. Nothing may follow them.
    fn end_file(&mut self) -> io::Result<()> {
        let magic = self.read(MAGIC.len())?;
        if MAGIC.starts_with(&magic) && magic.len() < MAGIC.len() {
            self.end_in_record(magic.len() as u64);
            return Ok(());
        }
        self.is_ended = true;
        let begun = if magic == MAGIC { 0 } else { magic.len() as u64 };
        let rest = self.discard()?;
        if begun + rest > 0 {
            self.skip(begun + rest);
        }
        Ok(())
    }

    /// Ends reading at an incomplete record of `len` bytes.
    fn end_in_record(&mut self, len: u64) {
        self.is_ended = true;
        self.damage.bytes += len;
        // If the file ends with the magic bytes, it is not truncated, so the length of the record is wrong.
        let is_whole = self.tail == MAGIC;
        self.damage.is_truncated |= !is_whole;
        self.damage.is_damaged |= is_whole;
    }

    /// Ends reading because the structure of the file is lost. The last `len` bytes that were read cannot be used.
    fn end_here(&mut self, len: usize) -> io::Result<()> {
        self.is_ended = true;
        let rest = self.discard()?;
        self.skip(len as u64 + rest);
        self.damage.is_truncated |= self.tail != MAGIC;
        Ok(())
    }

    /// Counts `len` bytes that are not used because they are damaged.
    fn skip(&mut self, len: u64) {
        self.damage.bytes += len;
        self.damage.is_damaged = true;
    }

    /// Compares the checksum of the section with `saved`. 0 means that the writer did not compute the checksum.
    fn check_section(&mut self, saved: Option<&[u8; 4]>) {
        let saved = saved.map_or(0, |saved| u32::from_le_bytes(*saved));
        self.damage.is_damaged |= saved != 0 && saved != self.section.sum();
    }

    /// Reads the rest of the file, and returns its length.
    fn discard(&mut self) -> io::Result<u64> {
        let mut len = 0;
        loop {
            match self.read(READ_LEN as usize)?.len() as u64 {
                0 => return Ok(len),
                read => len += read,
            }
        }
    }

    /// Reads `len` bytes, or fewer at the end of the file. The end of a gzip file is the position at which it is
    /// truncated or damaged.
    fn read(&mut self, len: usize) -> io::Result<Vec<u8>> {
        // The length may be wrong, so allocate memory only for bytes that exist.
        let mut bytes = Vec::with_capacity(len.min(READ_LEN as usize));
        let begin = self.unread.by_ref().take(len as u64).read_to_end(&mut bytes)?;
        match self.input.by_ref().take((len - begin) as u64).read_to_end(&mut bytes) {
            Err(error) if !is_truncation(&error) => return Err(error),
            _ => {}
        }
        self.tail.extend_from_slice(&bytes[begin.max(bytes.len().saturating_sub(MAGIC.len()))..]);
        self.tail.drain(..self.tail.len().saturating_sub(MAGIC.len()));
        Ok(bytes)
    }
}

/// The records of a chunk that have not been returned yet.
#[derive(Debug, Default)]
struct Chunk {
    bytes: Vec<u8>,
    /// Position of the next record.
    at: usize,
}

impl Chunk {
    /// Checks and unpacks a chunk.
    ///
    /// # Errors
    ///
    /// Returns an error if the checksum is wrong, if the records do not fill the chunk exactly, or if the chunk cannot
    /// be unpacked. Returns [`McapError::ChunkTooLarge`] if the chunk is intact, but longer than [`MAX_RECORD_LEN`]
    /// when unpacked.
    fn open(body: Vec<u8>) -> Result<Chunk, McapError> {
        let Parsed::Chunk { header, data } = parse_record(op::CHUNK, &body)? else {
            return Err(McapError::UnexpectedEoc);
        };
        if header.uncompressed_size > MAX_RECORD_LEN {
            // The length itself may be damaged. Only if the chunk is intact, the file really has a chunk that is too
            // long.
            return Err(match unpacked_length(&body, header.uncompressed_size) {
                Ok(len) if len == header.uncompressed_size => McapError::ChunkTooLarge(len),
                Ok(_) => McapError::UnexpectedEoc,
                Err(error) => error,
            });
        }
        let chunk = if header.compression.is_empty() {
            let mut crc = Crc::new();
            crc.update(&data);
            let (saved, calculated) = (header.uncompressed_crc, crc.sum());
            // 0 means that the writer did not compute the checksum.
            if saved != 0 && saved != calculated {
                return Err(McapError::BadChunkCrc { saved, calculated });
            }
            let at = body.len() - data.len();
            Chunk { bytes: body, at }
        } else {
            Chunk { bytes: unpack(&body)?, at: 0 }
        };
        let mut rest = &chunk.bytes[chunk.at..];
        while !rest.is_empty() {
            (_, rest) = split_record(rest).ok_or(McapError::UnexpectedEoc)?;
        }
        Ok(chunk)
    }
}

impl Iterator for Chunk {
    type Item = Record;

    fn next(&mut self) -> Option<Record> {
        let Some((record, _)) = split_record(&self.bytes[self.at..]) else {
            // Free the memory now, and not only when the next chunk is opened.
            *self = Chunk::default();
            return None;
        };
        self.at += record.len();
        Some(Record { opcode: record[0], body: record[HEAD_LEN..].to_vec(), is_in_chunk: true })
    }
}

/// Returns the records of a compressed chunk, with their opcodes and lengths.
fn unpack(body: &[u8]) -> Result<Vec<u8>, McapError> {
    let mut records = Vec::new();
    for_each_record(
        body,
        LinearReaderOptions::default().with_prevalidate_chunk_crcs(true),
        |opcode, data| {
            records.push(opcode);
            records.extend((data.len() as u64).to_le_bytes());
            records.extend(data);
            true
        },
    )?;
    Ok(records)
}

/// Returns the unpacked length of a chunk that may be too long to be held in memory. Stops when the length exceeds
/// `max_len` or [`MAX_CHUNK_LEN`].
fn unpacked_length(body: &[u8], max_len: u64) -> Result<u64, McapError> {
    let (mut len, most) = (0, max_len.min(MAX_CHUNK_LEN));
    for_each_record(body, LinearReaderOptions::default().with_validate_chunk_crcs(true), |_, data| {
        len += (HEAD_LEN + data.len()) as u64;
        len <= most
    })?;
    Ok(len)
}

/// Calls `take` with opcode and body of each record of a compressed chunk, until `take` returns false.
fn for_each_record(
    body: &[u8],
    options: LinearReaderOptions,
    mut take: impl FnMut(u8, &[u8]) -> bool,
) -> Result<(), McapError> {
    let options = options
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_record_length_limit(MAX_RECORD_LEN as usize);
    let mut reader = LinearReader::new_with_options(options);
    let chunk = [&[op::CHUNK][..], &(body.len() as u64).to_le_bytes(), body].concat();
    let mut input = &chunk[..];
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => {
                let (piece, rest) = input.split_at(wanted.min(input.len()));
                reader.insert(piece.len()).copy_from_slice(piece);
                reader.notify_read(piece.len());
                input = rest;
            }
            LinearReadEvent::Record { opcode, data } => {
                if !take(opcode, data) {
                    return Ok(());
                }
            }
        }
    }
    Ok(())
}

/// Returns the error of a chunk of `len` bytes, which is too long.
fn too_long(len: u64) -> io::Error {
    let (megabytes, max_megabytes) = (len >> 20, MAX_RECORD_LEN >> 20);
    let what = format!("it has a chunk of {megabytes} MB; at most {max_megabytes} MB are read at a time");
    io::Error::new(io::ErrorKind::FileTooLarge, what)
}

/// Returns whether `bytes` start with a chunk whose lengths agree, or, if `messages` is set, with a message of the hub.
/// Other bytes do not look like this by chance, because a chunk contains lengths twice, and a message contains times
/// twice.
fn is_record_boundary(bytes: &[u8], messages: bool) -> bool {
    let Some((opcode, length)) = split_head(bytes) else { return false };
    match opcode {
        _ if length > MAX_RECORD_LEN => false,
        op::CHUNK => is_chunk(&bytes[HEAD_LEN..], length),
        op::MESSAGE => messages && is_message_of_hub(bytes),
        _ => false,
    }
}

/// Returns whether a chunk with messages or a message of the hub starts anywhere in `bytes`. An empty chunk is ignored,
/// because the packets of a scanner without readings are zeros and may look like an empty chunk.
pub(crate) fn has_record_boundary(bytes: &[u8]) -> bool {
    let is_dated = |bytes: &[u8]| match split_head(bytes) {
        Some((op::CHUNK, _)) => bytes[HEAD_LEN..].iter().take(8).any(|byte| *byte != 0),
        _ => true,
    };
    (0..bytes.len()).any(|at| is_record_boundary(&bytes[at..], true) && is_dated(&bytes[at..]))
}

/// Returns whether `bytes` start with a message of the hub, complete or not.
fn is_message_of_hub(bytes: &[u8]) -> bool {
    let Some((op::MESSAGE, length)) = split_head(bytes) else { return false };
    let end = bytes.len().min(HEAD_LEN.saturating_add(length as usize)).min(HEAD_LEN + MESSAGE_HEAD_LEN);
    match parse_record(op::MESSAGE, &bytes[HEAD_LEN..end]) {
        Ok(Parsed::Message { header, data }) => {
            header.log_time != 0 && split_sample(&header, &data).is_some()
        }
        _ => false,
    }
}

/// Returns whether the body of a record of this `length` starts with the fields of a chunk.
fn is_chunk(body: &[u8], length: u64) -> bool {
    let is_known = |name: &[u8]| matches!(name, b"" | b"lz4" | b"zstd");
    let compression = || {
        let (len, rest) = body.get(COMPRESSION_OFFSET..)?.split_first_chunk()?;
        rest.get(..u32::from_le_bytes(*len) as usize)
    };
    chunk_length(body) == Some(length) && compression().is_some_and(is_known)
}

/// Returns the maximum length that a record with this opcode can have. A greater length is damaged.
fn max_possible_len(opcode: u8) -> u64 {
    match opcode {
        op::HEADER
        | op::FOOTER
        | op::MESSAGE_INDEX
        | op::CHUNK_INDEX
        | op::ATTACHMENT_INDEX
        | op::STATISTICS
        | op::METADATA_INDEX
        | op::SUMMARY_OFFSET
        | op::DATA_END => MAX_RECORD_LEN,
        _ => MAX_FILE_LEN,
    }
}

/// Returns opcode and length of the body of the record that starts with `bytes`.
fn split_head(bytes: &[u8]) -> Option<(u8, u64)> {
    let (head, _) = bytes.split_first_chunk::<HEAD_LEN>()?;
    Some((head[0], u64::from_le_bytes(*head.last_chunk()?)))
}

/// Splits `bytes` after their first record, which includes its opcode and length.
fn split_record(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (opcode, length) = split_head(bytes)?;
    bytes.split_at_checked(HEAD_LEN + usize::try_from(length).ok().filter(|_| length <= max_len(opcode))?)
}

/// Returns the length that a chunk must have according to the fields at the beginning of its `body`.
fn chunk_length(body: &[u8]) -> Option<u64> {
    let (compression, rest) = body.get(COMPRESSION_OFFSET..)?.split_first_chunk()?;
    let compression = u32::from_le_bytes(*compression);
    let records = rest.get(compression as usize..)?.first_chunk()?;
    let head = COMPRESSION_OFFSET as u64 + 4 + u64::from(compression) + 8;
    u64::from_le_bytes(*records).checked_add(head)
}

/// Returns whether the lengths inside an attachment add up to its length.
fn is_attachment(body: &[u8]) -> bool {
    let fits = || {
        // The fields are the log time and the creation time, and then name and media type.
        let mut rest = body.get(8 + 8..)?;
        for _ in 0..2 {
            let (len, text) = rest.split_first_chunk()?;
            rest = text.get(u32::from_le_bytes(*len) as usize..)?;
        }
        let (len, data) = rest.split_first_chunk()?;
        Some(u64::from_le_bytes(*len).checked_add(4)? == data.len() as u64)
    };
    fits() == Some(true)
}

/// Returns whether this reader uses the fields of records with this opcode, so that the fields must be valid.
fn is_interpreted(opcode: u8) -> bool {
    matches!(opcode, op::HEADER | op::SCHEMA | op::CHANNEL | op::MESSAGE | op::METADATA | op::ATTACHMENT)
}

/// Returns the maximum length of a record that is held in memory. Records that consist of texts take many times their
/// length when they are parsed, so their limit is lower.
fn max_len(opcode: u8) -> u64 {
    match opcode {
        op::HEADER | op::CHANNEL | op::METADATA => 1 << 20,
        _ => MAX_RECORD_LEN,
    }
}

/// Length in bytes of the opcode and the length field, with which every record begins.
const HEAD_LEN: usize = 1 + 8;
/// Number of bytes at the beginning of a chunk that surely include the field with the length of its records. The name
/// of the compression before this field has a variable length.
const CHUNK_HEAD_LEN: usize = 1024;
/// Position, in the body of a chunk, of the name of the compression: after the times of the first and the last message,
/// the uncompressed size, and the CRC.
const COMPRESSION_OFFSET: usize = 8 + 8 + 8 + 4;
/// Number of bytes of a message that include the header of a sample of the hub.
const MESSAGE_HEAD_LEN: usize = 2 + 4 + 8 + 8 + size_of::<scanhub_schema::Header>();
/// Length of the body of a data end, in bytes.
const DATA_END_LEN: u64 = 4;
/// Position of the checksum in the footer.
const FOOTER_CRC_OFFSET: usize = 8 + 8;
/// Length of the body of a footer, in bytes.
const FOOTER_LEN: u64 = FOOTER_CRC_OFFSET as u64 + 4;
/// Opcodes that no version of the format uses yet. Opcodes from 80h are free for any program.
const RESERVED_OPCODES: RangeInclusive<u8> = 0x10..=0x7F;
/// Maximum length of a record that is held in memory, in bytes, except for the kinds in [`max_len`]. The reader needs a
/// few times this length as memory. Recorders write chunks of less than half of this length.
const MAX_RECORD_LEN: u64 = 8 << 20;
/// Length that no file exceeds, in bytes.
const MAX_FILE_LEN: u64 = 1 << 40;
/// Maximum length, in bytes, to which a chunk is unpacked to check whether it is intact.
const MAX_CHUNK_LEN: u64 = 1 << 30;
/// Maximum number of chunks whose hashes are stored and compared with later chunks: 14 hours of a recording of the hub.
const MAX_CHUNKS: usize = 1 << 19;
/// Maximum number of positions after which the reader searches for the structure of the file again. Each search may
/// read the longest record twice.
const MAX_RESYNCS: u32 = 256;
/// Number of bytes that are read at a time.
const READ_LEN: u64 = 64 * 1024;
