//! Copies an MCAP file: every readable message, all channels, also those of other programs, and a new index. Refuses to
//! know what the messages mean, except for telegrams, whose headers may have been estimated.

use std::collections::BTreeMap;
use std::io::{self, Write};

use mcap::records::{Record as Parsed, op};
use schema::file::{Compression, METADATA, Writer};
use schema::{Failure, Topic};

use super::{CHUNK, Written};
use crate::Recording;
use crate::mcap::reader::Item;
use crate::mcap::{Originals, Record, message, parse};

/// Copies `recording` into `file`; `count` hears of each telegram.
pub(super) fn copy(
    recording: &Recording,
    compression: Compression,
    file: &mut impl Write,
    count: &mut impl FnMut(Written, Option<u64>) -> Result<(), Failure>,
    failed: &impl Fn(io::Error) -> Failure,
) -> Result<(), Failure> {
    let (mut reader, known) = recording.reader()?;
    let originals = &known.originals;
    let sensor = recording.chosen();
    let writer =
        Writer::packed(file, &originals.profile, compression, originals.facts.clone()).map_err(failed)?;
    let mut copy = Copy { writer, originals, channels: BTreeMap::new(), has_facts: false, bytes: 0 };
    while let Some(item) = reader.next().map_err(|error| recording.broken(&error))? {
        match item {
            Item::Telegram(sighting) if sensor.is_none_or(|sensor| *sensor == sighting.sensor) => {
                let is_scan = crate::is_scan(sighting.header.family, &sighting.telegram);
                let len = sighting.telegram.len();
                let header = &sighting.header;
                let written =
                    copy.writer.sample(&sighting.sensor, Topic::Telegram, header, &sighting.telegram);
                written.and_then(|()| copy.wrote(len)).map_err(failed)?;
                count(Written::of(is_scan), Some(header.wall_ns))?;
            }
            Item::Telegram(_) => {}
            Item::Record(record) => {
                let place =
                    message(&record).and_then(|(head, _)| known.channels.place(head.channel_id).flatten());
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
    originals: &'a Originals,
    /// Numbers of the channels in the new file, by those in the old one.
    channels: BTreeMap<u16, u16>,
    /// The new file begins with the facts of the old one.
    has_facts: bool,
    bytes: usize,
}

impl<W: Write> Copy<'_, W> {
    fn record(&mut self, record: &Record) -> io::Result<()> {
        match record.opcode {
            op::MESSAGE => self.message(record),
            op::METADATA | op::ATTACHMENT => match parse(record) {
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

    /// Copies a message, unless nothing tells what it is.
    fn message(&mut self, record: &Record) -> io::Result<()> {
        let Some((mut head, data)) = message(record) else { return Ok(()) };
        head.channel_id = match self.channels.get(&head.channel_id) {
            Some(&id) => id,
            None => {
                let Some((channel, schema)) = self.originals.channel(head.channel_id) else { return Ok(()) };
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
