//! Copies an MCAP file: every message that can be read, of all channels including those of other programs, and a new index.

use std::collections::BTreeMap;
use std::io::{self, Write};

use mcap::records::{Record as Parsed, op};
use schema::file::{Compression, METADATA, Writer};
use schema::{Failure, Topic};

use super::{CHUNK, Written};
use crate::Recording;
use crate::mcap::{Catalog, Item, Record, Sample};

/// Copies `recording` into `file`, and calls `count` for each telegram.
pub(super) fn copy(
    recording: &Recording,
    compression: Compression,
    file: &mut impl Write,
    count: &mut impl FnMut(Written, Option<u64>) -> Result<(), Failure>,
    failed: &impl Fn(io::Error) -> Failure,
) -> Result<(), Failure> {
    let (mut reader, catalog) = recording.reader()?;
    let sensor = recording.chosen();
    let writer =
        Writer::packed(file, &catalog.profile, compression, catalog.facts.clone()).map_err(failed)?;
    let mut copy = Copy { writer, catalog, channels: BTreeMap::new(), has_facts: false, bytes: 0 };
    while let Some(item) = reader.next().map_err(|error| recording.broken(&error))? {
        match item {
            Item::Telegram(sample) if sensor.is_none_or(|sensor| *sensor == sample.sensor) => {
                let Sample { sensor, header, telegram } = &sample;
                let is_scan = crate::is_scan(header.family, telegram);
                let written = copy.writer.sample(sensor, Topic::Telegram, header, telegram);
                written.and_then(|()| copy.wrote(telegram.len())).map_err(failed)?;
                count(Written::of(is_scan), Some(header.wall_ns))?;
            }
            Item::Telegram(_) => {}
            Item::Record(record) => {
                let place =
                    record.message().and_then(|(message, _)| catalog.place(message.channel_id).flatten());
                let is_chosen =
                    sensor.is_none_or(|sensor| place.is_some_and(|place| place.sensor == *sensor));
                if is_chosen || record.opcode != op::MESSAGE {
                    copy.record(&record).map_err(failed)?;
                }
            }
        }
    }
    copy.writer.finish().map_err(failed).map(drop)
}

struct Copy<'a, W: Write> {
    writer: Writer<W>,
    catalog: &'a Catalog,
    /// Channel numbers in the new file, by those in the old file.
    channels: BTreeMap<u16, u16>,
    /// Whether the facts of the old file were met, with which the new one begins.
    has_facts: bool,
    /// Bytes in the open chunk.
    bytes: usize,
}

impl<W: Write> Copy<'_, W> {
    fn record(&mut self, record: &Record) -> io::Result<()> {
        match record.opcode {
            op::MESSAGE => self.message(record),
            op::METADATA | op::ATTACHMENT => match record.parse() {
                Some(Parsed::Metadata(metadata)) if metadata.name == METADATA && !self.has_facts => {
                    self.has_facts = true;
                    Ok(())
                }
                Some(Parsed::Metadata(metadata)) => self.writer.note(&metadata.name, metadata.metadata),
                Some(Parsed::Attachment { header, data, .. }) => {
                    self.writer.copied_attachment(&mcap::Attachment {
                        log_time: header.log_time,
                        create_time: header.create_time,
                        name: header.name,
                        media_type: header.media_type,
                        data,
                    })
                }
                _ => Ok(()),
            },
            _ => Ok(()),
        }
    }

    /// Copies a message, unless its channel is unknown.
    fn message(&mut self, record: &Record) -> io::Result<()> {
        let Some((mut head, data)) = record.message() else { return Ok(()) };
        head.channel_id = match self.channels.get(&head.channel_id) {
            Some(&id) => id,
            None => {
                let Some((channel, schema)) = self.catalog.channel(head.channel_id) else { return Ok(()) };
                let schema = schema.map(|(name, language, text)| (&name[..], &language[..], &text[..]));
                let id = self.writer.copied_channel(channel, schema)?;
                self.channels.insert(head.channel_id, id);
                id
            }
        };
        self.writer.copied_message(&head, data)?;
        self.wrote(data.len())
    }

    fn wrote(&mut self, len: usize) -> io::Result<()> {
        self.bytes += len;
        if self.bytes >= CHUNK {
            self.bytes = 0;
            self.writer.close_chunk()?;
        }
        Ok(())
    }
}
