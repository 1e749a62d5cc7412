//! What a file says about itself, kept unchanged for the copy: profile, schemas, channels. Refuses to know how the hub
//! interprets it.

use std::collections::BTreeMap;

use std::io;

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
    /// About what all of it takes in memory.
    bytes: usize,
}

/// Name, language and text of a type.
pub(crate) type Schema = (String, String, Vec<u8>);

/// What a record says.
#[derive(Clone, Debug)]
struct Kept<T> {
    value: T,
    /// A checksum vouches for it.
    is_proven: bool,
    /// About what it takes in memory.
    bytes: usize,
}

impl Originals {
    /// Takes over a record; what a checksum vouches for replaces what none does.
    pub(crate) fn note(&mut self, record: &Record, is_proven: bool) {
        match exact::parse(record) {
            Some(Parsed::Header(header)) => self.profile = header.profile,
            Some(Parsed::Metadata(metadata)) if metadata.name == METADATA && self.facts.is_empty() => {
                self.facts = metadata.metadata;
            }
            Some(Parsed::Schema { header, data }) => {
                let value = (header.name, header.encoding, data.into_owned());
                let bytes = record.body.len() + OVERHEAD;
                let kept = Kept { value, is_proven, bytes };
                keep(&mut self.schemas, header.id, kept, &mut self.bytes);
            }
            Some(Parsed::Channel(channel)) => {
                let (id, bytes) = (channel.id, record.body.len() + OVERHEAD * (1 + channel.metadata.len()));
                keep(&mut self.channels, id, Kept { value: channel, is_proven, bytes }, &mut self.bytes);
            }
            _ => {}
        }
    }

    /// [`io::ErrorKind::FileTooLarge`] if channels and schemas are more than is kept.
    pub(crate) fn check(&self) -> io::Result<()> {
        if self.bytes <= MOST {
            return Ok(());
        }
        let what = format!("its channels and schemas take more than {} MB", MOST >> 20);
        Err(io::Error::new(io::ErrorKind::FileTooLarge, what))
    }

    /// The channel with this number and its schema.
    pub(crate) fn channel(&self, id: u16) -> Option<(&Channel, Option<&Schema>)> {
        let channel = &self.channels.get(&id)?.value;
        Some((channel, self.schemas.get(&channel.schema_id).map(|schema| &schema.value)))
    }
}

/// Takes `new` unless what is there is better; `bytes` is what all of it takes.
fn keep<T>(kept: &mut BTreeMap<u16, Kept<T>>, id: u16, new: Kept<T>, bytes: &mut usize) {
    if new.is_proven || kept.get(&id).is_none_or(|old| !old.is_proven) {
        *bytes += new.bytes;
        *bytes -= kept.insert(id, new).map_or(0, |old| old.bytes);
    }
}

/// What a record takes in memory beside its text.
const OVERHEAD: usize = 128;
/// Enough for as many channels as have a number; files of many sensors have some hundred, and a megabyte of schemas.
const MOST: usize = 20 << 20;
