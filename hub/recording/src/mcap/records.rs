//! The records of an MCAP file that is sound, one after the other, chunks opened and their checksums looked at.
//! Refuses to know what is in them.

use std::io::{self, Read};

use mcap::McapError;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

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
}

impl<R: Read> Records<R> {
    pub(crate) fn new(input: R) -> Self {
        let options = LinearReaderOptions::default()
            .with_validate_chunk_crcs(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true)
            .with_record_length_limit(LONGEST_RECORD);
        Records { input, reader: LinearReader::new_with_options(options) }
    }

    /// The next record; an error where the file is not sound, or cannot be read.
    pub(crate) fn next(&mut self) -> Result<Option<Record>, McapError> {
        while let Some(event) = self.reader.next_event() {
            match event? {
                LinearReadEvent::ReadRequest(wanted) => {
                    // What a length says is not believed before that many bytes are there.
                    let room = self.reader.insert(wanted.min(PIECE));
                    let len = loop {
                        match self.input.read(room) {
                            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                            other => break other?,
                        }
                    };
                    self.reader.notify_read(len);
                }
                LinearReadEvent::Record { opcode, data } => {
                    return Ok(Some(Record { opcode, body: data.to_vec() }));
                }
            }
        }
        Ok(None)
    }
}

/// Longer ones are not held in memory.
const LONGEST_RECORD: usize = 256 << 20;
/// Bytes read at a time.
const PIECE: usize = 64 * 1024;
