//! Opens a chunk: its records, all of them or none, since one checksum vouches for all. Refuses to know what is in
//! them.

use flate2::Crc;
use mcap::McapError;
use mcap::records::op;
use mcap::sans_io::{LinearReader, LinearReaderOptions};

use super::exact::{self, HEAD, LONGEST};
use super::records::{Record, read};

/// The records of a chunk with this `body`; an error if it is not sound, or packed in a way that is not read here.
pub(crate) fn open(body: &[u8]) -> Result<Vec<Record>, McapError> {
    let Some(head) = exact::ChunkHead::of(body) else { return Err(McapError::UnexpectedEoc) };
    if head.packing.is_empty() { plain(&head) } else { packed(body) }
}

fn plain(head: &exact::ChunkHead<'_>) -> Result<Vec<Record>, McapError> {
    let mut sum = Crc::new();
    sum.update(head.content);
    let (saved, calculated) = (head.checksum, sum.sum());
    // 0: whoever wrote it did not say.
    if saved != 0 && saved != calculated {
        return Err(McapError::BadChunkCrc { saved, calculated });
    }
    let mut records = Vec::new();
    let mut rest = head.content;
    while !rest.is_empty() {
        let length = exact::any_length(rest).ok_or(McapError::UnexpectedEoc)?;
        let (record, after) = rest.split_at_checked(HEAD + length).ok_or(McapError::UnexpectedEoc)?;
        records.push(Record { opcode: record[0], body: record[HEAD..].to_vec() });
        rest = after;
    }
    Ok(records)
}

fn packed(body: &[u8]) -> Result<Vec<Record>, McapError> {
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
    let mut records = Vec::new();
    while let Some(record) = read(&mut reader, &mut input)? {
        records.push(record);
    }
    Ok(records)
}
