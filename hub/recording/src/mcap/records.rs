//! The records of an intact MCAP file in their order, also those in chunks. Refuses to know what is in them.

use std::io::{self, Read};

use mcap::McapError;
use mcap::records::op;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::chunk::Chunk;
use super::exact::{self, LONGEST, longest};

/// A record: what kind ([`mcap::records::op`]), and its bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Record {
    pub(crate) opcode: u8,
    pub(crate) body: Vec<u8>,
}

/// Reads records; ends with the file.
pub(crate) struct Records<R> {
    input: R,
    reader: LinearReader,
    /// Of the chunk that is being read.
    of_chunk: Chunk,
}

impl<R: Read> Records<R> {
    pub(crate) fn new(input: R) -> Self {
        // Chunks are opened here: the library panics at one whose records are longer than itself.
        let options = LinearReaderOptions::default()
            .with_emit_chunks(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true)
            .with_record_length_limit(LONGEST as usize);
        let reader = LinearReader::new_with_options(options);
        Records { input, reader, of_chunk: Chunk::default() }
    }

    /// The next record; an error where the file is not sound, or cannot be read.
    pub(crate) fn next(&mut self) -> Result<Option<Record>, McapError> {
        loop {
            if let Some(record) = self.of_chunk.next() {
                return Ok(Some(record));
            }
            match read(&mut self.reader, &mut self.input)? {
                Some(record) if record.opcode == op::CHUNK => self.of_chunk = Chunk::open(record.body)?,
                Some(Record { opcode, body }) if body.len() as u64 > longest(opcode) => {
                    return Err(McapError::RecordTooLarge { opcode, len: body.len() as u64 });
                }
                // One that cannot be copied is not passed over in silence.
                Some(record) if is_for_copies(record.opcode) && exact::parse(&record).is_none() => {
                    return Err(McapError::UnexpectedEoc);
                }
                other => return Ok(other),
            }
        }
    }
}

fn is_for_copies(opcode: u8) -> bool {
    matches!(opcode, op::METADATA | op::ATTACHMENT)
}

/// What `reader` finds next in `input`.
pub(crate) fn read(reader: &mut LinearReader, input: &mut impl Read) -> Result<Option<Record>, McapError> {
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => {
                // What a length says is not believed before that many bytes are there.
                let room = reader.insert(wanted.min(PIECE));
                let len = loop {
                    match input.read(room) {
                        Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                        other => break other?,
                    }
                };
                reader.notify_read(len);
            }
            LinearReadEvent::Record { opcode, data } => {
                return Ok(Some(Record { opcode, body: data.to_vec() }));
            }
        }
    }
    Ok(None)
}

/// Bytes read at a time.
const PIECE: usize = 64 * 1024;
