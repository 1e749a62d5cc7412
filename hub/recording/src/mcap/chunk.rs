//! Opens a chunk: all of its records or none, because one checksum covers all. They are returned one by one, because there
//! may be a million of them. Refuses to know what is in them.

use flate2::Crc;
use mcap::McapError;
use mcap::records::op;
use mcap::sans_io::{LinearReader, LinearReaderOptions};

use super::exact::{self, HEAD, LONGEST};
use super::records::{Record, read};

/// The records of a chunk that is sound, those that were not handed out yet.
#[derive(Debug, Default)]
pub(crate) struct Chunk {
    bytes: Vec<u8>,
    /// Where the next record begins.
    at: usize,
}

impl Chunk {
    /// The records of a chunk with this `body`; an error if it is not sound, or packed in a way that is not read here.
    pub(crate) fn open(body: Vec<u8>) -> Result<Chunk, McapError> {
        let Some(head) = exact::ChunkHead::of(&body) else { return Err(McapError::UnexpectedEoc) };
        if !head.packing.is_empty() {
            return Ok(Chunk { bytes: unpack(&body)?, at: 0 });
        }
        check(&head)?;
        let at = body.len() - head.content.len();
        Ok(Chunk { bytes: body, at })
    }
}

impl Iterator for Chunk {
    type Item = Record;

    fn next(&mut self) -> Option<Record> {
        let rest = &self.bytes[self.at..];
        let Some((record, _)) = split(rest) else {
            // What was read is not kept until the next chunk comes.
            *self = Chunk::default();
            return None;
        };
        let record = Record { opcode: record[0], body: record[HEAD..].to_vec() };
        self.at += HEAD + record.body.len();
        Some(record)
    }
}

/// Whether the checksum is right and the records fill the content.
fn check(head: &exact::ChunkHead<'_>) -> Result<(), McapError> {
    let mut sum = Crc::new();
    sum.update(head.content);
    let (saved, calculated) = (head.checksum, sum.sum());
    // 0: the writer did not set it.
    if saved != 0 && saved != calculated {
        return Err(McapError::BadChunkCrc { saved, calculated });
    }
    let mut rest = head.content;
    while !rest.is_empty() {
        (_, rest) = split(rest).ok_or(McapError::UnexpectedEoc)?;
    }
    Ok(())
}

/// The first record of `bytes`, and what follows it.
fn split(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    bytes.split_at_checked(HEAD + exact::any_length(bytes)?)
}

/// The records of a packed chunk, one behind the other.
fn unpack(body: &[u8]) -> Result<Vec<u8>, McapError> {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(LONGEST as usize);
    let mut reader = LinearReader::new_with_options(options);
    let mut chunk = vec![op::CHUNK];
    chunk.extend((body.len() as u64).to_le_bytes());
    chunk.extend(body);
    let mut input = &chunk[..];
    let mut content = Vec::new();
    while let Some(record) = read(&mut reader, &mut input)? {
        content.push(record.opcode);
        content.extend((record.body.len() as u64).to_le_bytes());
        content.extend(record.body);
    }
    Ok(content)
}
