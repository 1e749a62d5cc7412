//! Which bytes are a record that is exactly as long as its own fields say: the only evidence where there is no checksum.
//! Messages have no such fields, chunks have a checksum. Refuses to know what records mean.

use std::str;

use mcap::parse_record;
use mcap::records::{MessageHeader, Record as Parsed, op};

use super::records::Record;

/// Opcode and length, with which every record begins.
pub(crate) const HEAD: usize = 1 + 8;

/// Length of the body of the record that `bytes` begin with, if it is not longer than [`longest`] allows.
pub(crate) fn any_length(bytes: &[u8]) -> Option<usize> {
    let (head, _) = bytes.split_first_chunk::<HEAD>()?;
    let length = u64::from_le_bytes(*head.last_chunk()?);
    (length <= longest(bytes[0])).then_some(length as usize)
}

/// The same of a record of a kind that is known.
pub(crate) fn length(bytes: &[u8]) -> Option<usize> {
    let is_known = (op::HEADER..=op::DATA_END).contains(bytes.first()?);
    any_length(bytes).filter(|_| is_known)
}

/// The record that `bytes` begin with, if its fields fill it exactly.
pub(crate) fn record(bytes: &[u8]) -> Option<Record> {
    let length = length(bytes)?;
    let (opcode, body) = (bytes[0], bytes.get(HEAD..HEAD + length)?);
    is_filled(opcode, body)?.then(|| Record { opcode, body: body.to_vec() })
}

/// Length of the chunk that `bytes` begin with, if it fits what the chunk says of itself and is more than [`LONGEST`].
pub(crate) fn long_chunk(bytes: &[u8]) -> Option<u64> {
    let length = u64::from_le_bytes(*bytes.get(1..HEAD)?.first_chunk()?);
    (bytes[0] == op::CHUNK && length > LONGEST && is_as_long(bytes, length)).then_some(length)
}

/// Bytes of a record with this opcode that are held in memory; a longer one is not read. Those that are taken to pieces
/// become many times as long.
pub(crate) fn longest(opcode: u8) -> u64 {
    match opcode {
        op::HEADER | op::CHANNEL | op::METADATA => 1 << 20,
        _ => LONGEST,
    }
}

/// What `record` says, if its fields fill it: of others the library may panic.
pub(crate) fn parse(record: &Record) -> Option<Parsed<'_>> {
    fills(record).then(|| parse_record(record.opcode, &record.body).ok())?
}

/// A chunk whose length fits what it says of itself.
pub(crate) struct ChunkHead<'a> {
    /// First and last time, size, checksum: seldom the same of two.
    pub(crate) name: &'a [u8],
    pub(crate) checksum: u32,
    /// By what its content is packed; empty if by nothing.
    pub(crate) packing: &'a str,
    pub(crate) content: &'a [u8],
}

impl<'a> ChunkHead<'a> {
    /// What a chunk's `body` says.
    pub(crate) fn of(body: &'a [u8]) -> Option<Self> {
        let mut fields = Fields(body);
        let name = fields.take(8 + 8 + 8 + 4)?;
        let packing = fields.text()?;
        let len = fields.u64()?;
        let checksum = name.last_chunk().copied().map(u32::from_le_bytes)?;
        (fields.0.len() as u64 == len).then_some(ChunkHead { name, checksum, packing, content: fields.0 })
    }
}

/// Whether the chunk that `bytes` begin with may be sound, as far as its head tells, which is there.
pub(crate) fn may_be_chunk(bytes: &[u8]) -> bool {
    bytes.first() == Some(&op::CHUNK) && length(bytes).is_some_and(|length| is_as_long(bytes, length as u64))
}

/// Whether the head of a chunk says that its body has this `length`.
fn is_as_long(bytes: &[u8], length: u64) -> bool {
    let told = || {
        let mut fields = Fields(bytes.get(HEAD..)?);
        fields.take(8 + 8 + 8 + 4)?;
        let packing = fields.text()?;
        let head = 8 + 8 + 8 + 4 + 4 + packing.len() as u64 + 8;
        fields.u64()?.checked_add(head)
    };
    told() == Some(length)
}

/// Channel, sequence and times of the message with this `body`.
pub(crate) fn head_of_message(body: &[u8]) -> Option<MessageHeader> {
    let (channel, rest) = body.split_first_chunk()?;
    let (sequence, rest) = rest.split_first_chunk()?;
    let (log_time, rest) = rest.split_first_chunk()?;
    Some(MessageHeader {
        channel_id: u16::from_le_bytes(*channel),
        sequence: u32::from_le_bytes(*sequence),
        log_time: u64::from_le_bytes(*log_time),
        publish_time: u64::from_le_bytes(*rest.first_chunk()?),
    })
}

/// Whether the fields of a record fill it.
fn fills(record: &Record) -> bool {
    is_filled(record.opcode, &record.body) == Some(true)
}

fn is_filled(opcode: u8, body: &[u8]) -> Option<bool> {
    let mut fields = Fields(body);
    match opcode {
        op::HEADER => {
            fields.text()?;
            fields.text()?;
        }
        op::SCHEMA => {
            fields.take(2)?;
            fields.text()?;
            fields.text()?;
            fields.counted()?;
        }
        op::CHANNEL => {
            fields.take(2 + 2)?;
            fields.text()?;
            fields.text()?;
            fields.map()?;
        }
        op::METADATA => {
            fields.text()?;
            fields.map()?;
        }
        op::ATTACHMENT => {
            fields.take(8 + 8)?;
            fields.text()?;
            fields.text()?;
            let len = usize::try_from(fields.u64()?).ok()?;
            fields.take(len)?;
            fields.take(4)?;
        }
        op::METADATA_INDEX => {
            fields.take(8 + 8)?;
            fields.text()?;
        }
        op::MESSAGE_INDEX => {
            fields.take(2)?;
            let entries = fields.counted()?;
            return Some(fields.0.is_empty() && entries.len() % 16 == 0);
        }
        op::CHUNK_INDEX => {
            fields.take(4 * 8)?;
            fields.counted()?;
            fields.take(8)?;
            fields.text()?;
            fields.take(8 + 8)?;
        }
        op::STATISTICS => {
            fields.take(8 + 2 + 4 * 4 + 8 + 8)?;
            fields.counted()?;
        }
        op::FOOTER => fields.take(8 + 8 + 4).map(drop)?,
        op::SUMMARY_OFFSET => fields.take(1 + 8 + 8).map(drop)?,
        op::DATA_END => fields.take(4).map(drop)?,
        _ => return None,
    }
    Some(fields.0.is_empty())
}

/// What is left of a record.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn take(&mut self, len: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(len)?;
        self.0 = rest;
        Some(taken)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take(8)?.try_into().ok().map(u64::from_le_bytes)
    }

    /// As many bytes as the number before them says.
    fn counted(&mut self) -> Option<&'a [u8]> {
        let count = self.take(4)?.try_into().ok().map(u32::from_le_bytes)?;
        self.take(count as usize)
    }

    fn text(&mut self) -> Option<&'a str> {
        str::from_utf8(self.counted()?).ok()
    }

    /// Pairs of texts.
    fn map(&mut self) -> Option<()> {
        let mut pairs = Fields(self.counted()?);
        while !pairs.0.is_empty() {
            pairs.text()?;
            pairs.text()?;
        }
        Some(())
    }
}

/// Bytes of channel, sequence and two times, with which a message begins.
pub(crate) const MESSAGE: usize = 2 + 4 + 8 + 8;
/// Of all records: a few times this is held in memory. Chunks of recorders have less than half of it.
pub(crate) const LONGEST: u64 = 8 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_is_filled_by_its_fields() {
        let mut footer = vec![op::FOOTER, 20, 0, 0, 0, 0, 0, 0, 0];
        footer.extend([7; 20]);
        assert_eq!(record(&footer), Some(Record { opcode: op::FOOTER, body: vec![7; 20] }));
        assert_eq!(record(&footer[..28]), None);
        footer[1] = 19;
        assert_eq!(record(&footer), None);
        footer[7] = 0x10;
        assert_eq!(length(&footer), None, "2^52 bytes");
        let mut metadata = vec![op::METADATA, 0, 0, 0, 0, 0, 0, 0, 0];
        metadata.extend(b"\x01\0\0\0m\x0A\0\0\0\x01\0\0\0a\x01\0\0\0b");
        metadata[1] = (metadata.len() - HEAD) as u8;
        assert!(record(&metadata).is_some());
        metadata[HEAD + 5] = 9;
        assert_eq!(record(&metadata), None);
    }
}
