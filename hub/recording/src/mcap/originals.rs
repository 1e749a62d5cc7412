//! What a file says of itself, kept as it stands there, for whoever writes it anew: profile, schemas, channels. Refuses to
//! know what the hub makes of it.

use std::collections::BTreeMap;

use mcap::parse_record;
use mcap::records::{Channel, Record as Parsed};
use schema::file::METADATA;

use super::exact;
use super::records::Record;

/// The records of a file that its messages refer to.
#[derive(Clone, Debug, Default)]
pub(crate) struct Originals {
    /// Profile of the file, such as `ros2`.
    pub(crate) profile: String,
    /// Who recorded what.
    pub(crate) facts: BTreeMap<String, String>,
    schemas: BTreeMap<u16, Kept<Schema>>,
    channels: BTreeMap<u16, Kept<Channel>>,
}

/// Name, language and text of a type.
pub(crate) type Schema = (String, String, Vec<u8>);

/// A record, and whether a checksum vouches for it.
type Kept<T> = (T, bool);

impl Originals {
    /// Takes over a record; what a checksum vouches for replaces what none does.
    pub(crate) fn note(&mut self, record: &Record, is_proven: bool) {
        if !exact::fills(record) {
            return;
        }
        match parse_record(record.opcode, &record.body) {
            Ok(Parsed::Header(header)) => self.profile = header.profile,
            Ok(Parsed::Metadata(metadata)) if metadata.name == METADATA && self.facts.is_empty() => {
                self.facts = metadata.metadata;
            }
            Ok(Parsed::Schema { header, data }) => {
                keep(
                    &mut self.schemas,
                    header.id,
                    (header.name, header.encoding, data.into_owned()),
                    is_proven,
                );
            }
            Ok(Parsed::Channel(channel)) => keep(&mut self.channels, channel.id, channel, is_proven),
            _ => {}
        }
    }

    /// The channel with this number and its schema.
    pub(crate) fn channel(&self, id: u16) -> Option<(&Channel, Option<&Schema>)> {
        let (channel, _) = self.channels.get(&id)?;
        Some((channel, self.schemas.get(&channel.schema_id).map(|(schema, _)| schema)))
    }
}

fn keep<T>(kept: &mut BTreeMap<u16, Kept<T>>, id: u16, value: T, is_proven: bool) {
    if is_proven || kept.get(&id).is_none_or(|(_, was_proven)| !was_proven) {
        kept.insert(id, (value, is_proven));
    }
}
