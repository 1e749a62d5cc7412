//! The records of an MCAP file in the order of the file, including those in chunks.
//!
//! A damaged file is read as far as its structure can be trusted:
//!
//! - A chunk is used whole or not at all, because one CRC-32 covers all of its records. A chunk with a wrong checksum is
//!   skipped, and so is a record whose fields do not fit into it.
//! - At a length that is impossible, reading ends: nothing after it is known to be the start of a record.
//! - A file that was cut anywhere is read to its last whole record.
//!
//! [`Damage`] counts all bytes that were not used. The format is described at <https://mcap.dev/spec>.

use std::borrow::Cow;
use std::io::{self, Read};
use std::ops::RangeInclusive;

use flate2::Crc;
use mcap::records::{MessageHeader, Record as Parsed, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError, parse_record};

use crate::Damage;
use crate::open::is_end;

/// A record: its kind ([`mcap::records::op`]), and its bytes after opcode and length.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Record {
    pub(crate) opcode: u8,
    pub(crate) body: Vec<u8>,
}

impl Record {
    /// Parses the record; `None` if its fields do not fit into it.
    pub(crate) fn parse(&self) -> Option<Parsed<'_>> {
        // The library panics at an attachment that ends before its checksum.
        if self.opcode == op::ATTACHMENT && !is_attachment(&self.body) {
            return None;
        }
        parse_record(self.opcode, &self.body).ok()
    }

    /// Returns header and data of a message; `None` if the record is not one.
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

/// Reads records; ends with the file, or where its structure is lost.
pub(crate) struct Records<R> {
    input: R,
    /// The open chunk, whose records are returned next.
    chunk: Chunk,
    /// Checksum of the section that is being read: the data section, then the summary.
    section: Crc,
    /// The last bytes that were read, at most as many as the magic bytes.
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
            section: Crc::new(),
            tail: Vec::new(),
            damage: Damage::default(),
            is_begun: false,
            is_ended: false,
        }
    }

    /// Returns what was not used so far; complete after the last record.
    pub(crate) fn damage(&self) -> Damage {
        self.damage
    }

    /// Returns the next record; `None` at the end.
    ///
    /// # Errors
    ///
    /// Returns the error of the input. Returns `FileTooLarge` at a chunk that is longer than [`LONGEST`], and `Unsupported`
    /// at a chunk whose compression this build lacks.
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
                // Those at the end are the same.
                self.tail.clear();
            }
            if let Some(record) = self.read_record()? {
                return Ok(Some(record));
            }
        }
    }

    /// Reads the next record outside chunks; `None` if it was a chunk, or cannot be used.
    fn read_record(&mut self) -> io::Result<Option<Record>> {
        let head = self.read(HEAD)?;
        let Some((opcode, length)) = split_head(&head) else {
            self.end_in_record(head.len() as u64);
            return Ok(None);
        };
        if opcode == 0 {
            return self.end_here(HEAD).map(|()| None);
        }
        if length > longest(opcode) {
            return self.skip_long(&head, opcode, length).map(|()| None);
        }
        let body = self.read(length as usize)?;
        let len = HEAD as u64 + body.len() as u64;
        if (body.len() as u64) < length {
            self.end_in_record(len);
            return Ok(None);
        }
        // The opcode of another record became that of a footer, or one that the format reserves.
        let is_no_footer = opcode == op::FOOTER && length != FOOTER_LEN;
        if is_no_footer || RESERVED.contains(&opcode) {
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
                self.section.update(body.get(..FOOTER_CRC).unwrap_or_default());
                self.check_section(body.get(FOOTER_CRC..).and_then(<[u8]>::first_chunk));
                self.end_file()?;
            }
            _ => {
                self.section.update(&head);
                self.section.update(&body);
            }
        }
        if opcode == op::CHUNK {
            if chunk_length(&body) != Some(length) {
                return self.end_here(len as usize).map(|()| None);
            }
            match Chunk::open(body) {
                Ok(chunk) => self.chunk = chunk,
                Err(McapError::UnsupportedCompression(name)) if matches!(&name[..], "lz4" | "zstd") => {
                    let what = format!("its chunks are packed by {name}");
                    return Err(io::Error::new(io::ErrorKind::Unsupported, what));
                }
                Err(_) => {
                    self.damage.chunks += 1;
                    self.skip(len);
                }
            }
            return Ok(None);
        }
        let record = Record { opcode, body };
        if is_interpreted(opcode) && record.parse().is_none() {
            self.skip(len);
            return Ok(None);
        }
        Ok(Some(record))
    }

    /// Passes over a record that is too long to be held in memory.
    fn skip_long(&mut self, head: &[u8], opcode: u8, length: u64) -> io::Result<()> {
        if opcode == op::CHUNK {
            let begin = self.read(HEAD_OF_CHUNK)?;
            if chunk_length(&begin) == Some(length) {
                let (megabytes, most) = (length >> 20, LONGEST >> 20);
                let what = format!("it has a chunk of {megabytes} MB; at most {most} MB are read at a time");
                return Err(io::Error::new(io::ErrorKind::FileTooLarge, what));
            }
            return self.end_here(HEAD + begin.len());
        }
        self.damage.bytes += head.len() as u64;
        self.section.update(head);
        let mut left = length;
        while left > 0 {
            let piece = self.read(left.min(PIECE) as usize)?;
            if piece.is_empty() {
                self.end_in_record(0);
                break;
            }
            self.section.update(&piece);
            self.damage.bytes += piece.len() as u64;
            left -= piece.len() as u64;
        }
        Ok(())
    }

    /// Reads the magic bytes at the end of the file, after which nothing may follow.
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

    /// Ends reading at an incomplete record that has `len` bytes.
    fn end_in_record(&mut self, len: u64) {
        self.is_ended = true;
        self.damage.bytes += len;
        // A whole file in which a wrong length leads beyond the end was not cut.
        let is_whole = self.tail == MAGIC;
        self.damage.is_cut |= !is_whole;
        self.damage.is_harmed |= is_whole;
    }

    /// Ends reading because the structure is lost. The last `len` bytes that were read cannot be used.
    fn end_here(&mut self, len: usize) -> io::Result<()> {
        self.is_ended = true;
        let rest = self.discard()?;
        self.skip(len as u64 + rest);
        self.damage.is_cut |= self.tail != MAGIC;
        Ok(())
    }

    /// Counts `len` bytes that are not used because they are damaged.
    fn skip(&mut self, len: u64) {
        self.damage.bytes += len;
        self.damage.is_harmed = true;
    }

    /// Compares the checksum of the section with `saved`; 0 means that the writer did not compute it.
    fn check_section(&mut self, saved: Option<&[u8; 4]>) {
        let saved = saved.map_or(0, |saved| u32::from_le_bytes(*saved));
        self.damage.is_harmed |= saved != 0 && saved != self.section.sum();
    }

    /// Reads the rest of the file, and returns its length.
    fn discard(&mut self) -> io::Result<u64> {
        let mut len = 0;
        loop {
            match self.read(PIECE as usize)?.len() as u64 {
                0 => return Ok(len),
                read => len += read,
            }
        }
    }

    /// Reads `len` bytes; fewer only at the end of the file. A gzip file ends where it is cut or damaged.
    fn read(&mut self, len: usize) -> io::Result<Vec<u8>> {
        // A length may be wrong: memory is allocated for bytes that exist.
        let mut bytes = Vec::with_capacity(len.min(PIECE as usize));
        match self.input.by_ref().take(len as u64).read_to_end(&mut bytes) {
            Err(error) if !is_end(&error) => return Err(error),
            _ => {}
        }
        self.tail.extend_from_slice(&bytes[bytes.len().saturating_sub(MAGIC.len())..]);
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
    /// Returns an error if the checksum is wrong, if its records do not fill it, or if it cannot be unpacked.
    fn open(body: Vec<u8>) -> Result<Chunk, McapError> {
        let Parsed::Chunk { header, data } = parse_record(op::CHUNK, &body)? else {
            return Err(McapError::UnexpectedEoc);
        };
        if header.uncompressed_size > LONGEST {
            return Err(McapError::ChunkTooLarge(header.uncompressed_size));
        }
        let chunk = if header.compression.is_empty() {
            let mut crc = Crc::new();
            crc.update(&data);
            let (saved, calculated) = (header.uncompressed_crc, crc.sum());
            // 0: the writer did not compute it.
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
            // Free the memory now, not when the next chunk arrives.
            *self = Chunk::default();
            return None;
        };
        self.at += record.len();
        Some(Record { opcode: record[0], body: record[HEAD..].to_vec() })
    }
}

/// Returns the records of a compressed chunk, with their opcodes and lengths.
fn unpack(body: &[u8]) -> Result<Vec<u8>, McapError> {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(LONGEST as usize);
    let mut reader = LinearReader::new_with_options(options);
    let chunk = [&[op::CHUNK][..], &(body.len() as u64).to_le_bytes(), body].concat();
    let (mut input, mut records) = (&chunk[..], Vec::new());
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => {
                let (piece, rest) = input.split_at(wanted.min(input.len()));
                reader.insert(piece.len()).copy_from_slice(piece);
                reader.notify_read(piece.len());
                input = rest;
            }
            LinearReadEvent::Record { opcode, data } => {
                records.push(opcode);
                records.extend((data.len() as u64).to_le_bytes());
                records.extend(data);
            }
        }
    }
    Ok(records)
}

/// Returns opcode and length of the body of the record that starts with `bytes`.
fn split_head(bytes: &[u8]) -> Option<(u8, u64)> {
    let (head, _) = bytes.split_first_chunk::<HEAD>()?;
    Some((head[0], u64::from_le_bytes(*head.last_chunk()?)))
}

/// Splits `bytes` after their first record, which includes its opcode and length.
fn split_record(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (opcode, length) = split_head(bytes)?;
    bytes.split_at_checked(HEAD + usize::try_from(length).ok().filter(|_| length <= longest(opcode))?)
}

/// Returns the length that a chunk must have according to the fields at the beginning of its `body`.
fn chunk_length(body: &[u8]) -> Option<u64> {
    // Times of the first and the last message, uncompressed size, CRC.
    let (compression, rest) = body.get(8 + 8 + 8 + 4..)?.split_first_chunk()?;
    let compression = u32::from_le_bytes(*compression);
    let records = rest.get(compression as usize..)?.first_chunk()?;
    let head = 8 + 8 + 8 + 4 + 4 + u64::from(compression) + 8;
    u64::from_le_bytes(*records).checked_add(head)
}

/// Returns whether the lengths inside an attachment add up to its length.
fn is_attachment(body: &[u8]) -> bool {
    let fits = || {
        // Times of the log and of the creation, then name and media type.
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

/// Returns whether records of this kind are used by their fields, so that they must be well formed.
fn is_interpreted(opcode: u8) -> bool {
    matches!(opcode, op::HEADER | op::SCHEMA | op::CHANNEL | op::MESSAGE | op::METADATA | op::ATTACHMENT)
}

/// Maximum length of a record that is held in memory. Records of texts take many times their length when they are parsed.
fn longest(opcode: u8) -> u64 {
    match opcode {
        op::HEADER | op::CHANNEL | op::METADATA => 1 << 20,
        _ => LONGEST,
    }
}

/// Bytes of opcode and length, with which every record begins.
const HEAD: usize = 1 + 8;
/// Bytes of a chunk that include the length of its records, whatever the name of its compression.
const HEAD_OF_CHUNK: usize = 1024;
/// Position of the checksum in the footer.
const FOOTER_CRC: usize = 8 + 8;
/// Length of a footer.
const FOOTER_LEN: u64 = FOOTER_CRC as u64 + 4;
/// Opcodes that no version of the format uses yet. Those from 80h are free for any program.
const RESERVED: RangeInclusive<u8> = 0x10..=0x7F;
/// Maximum length of all other records. A few times this is held in memory; recorders write chunks of less than half of it.
const LONGEST: u64 = 8 << 20;
/// Bytes that are read at a time.
const PIECE: u64 = 64 * 1024;
