//! Catalog of an MCAP file: profile, schemas and channels, and the sensor and topic of each channel. The records are kept
//! unchanged, so that a copy of the file can repeat them.

use std::collections::{BTreeMap, HashSet};
use std::io;

use mcap::records::{Channel, MessageHeader, Record as Parsed, op};
use schema::datagram::Packed;
use schema::file::{self, ENCODING, ENCODING_V1, METADATA};
use schema::{Header, Maker, Tilt, Topic, check_followed};

use super::records::Record;

/// Topic of a sensor that a channel has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    pub(crate) sensor: String,
    pub(crate) topic: Topic,
    /// Whether its messages have the format of version 1.
    pub(crate) is_old: bool,
}

impl Place {
    /// Returns the topic of `channel`; `None` if another program made the channel, or if it names no valid sensor.
    fn of(channel: &Channel) -> Option<Place> {
        let (sensor, topic) = channel.topic.rsplit_once('/')?;
        let is_old = channel.message_encoding == ENCODING_V1;
        let is_ours = (is_old || channel.message_encoding == ENCODING) && check_followed(sensor).is_ok();
        let topic = Topic::parse(topic).filter(|topic| is_ours && topic.maker() == Maker::Link)?;
        Some(Place { sensor: sensor.to_owned(), topic, is_old })
    }

    /// Returns whether its messages are scans in today's format.
    pub(crate) fn has_scans(&self) -> bool {
        self.topic == Topic::Scan && !self.is_old
    }
}

/// Name, language and text of a type.
pub(crate) type Schema = (String, String, Vec<u8>);

/// Schemas and channels of a file. Its index repeats them, so they are known even if the chunk that had them first is lost.
#[derive(Clone, Debug, Default)]
pub(crate) struct Catalog {
    /// Profile of the file, such as `ros2`.
    pub(crate) profile: String,
    /// Description of the recording: domain, host, version ([`METADATA`]).
    pub(crate) facts: BTreeMap<String, String>,
    schemas: BTreeMap<u16, Schema>,
    channels: BTreeMap<u16, (Channel, Option<Place>)>,
    sensors: HashSet<String>,
    /// Approximate memory of schemas and channels.
    bytes: usize,
}

impl Catalog {
    /// Takes over what `record` says. The first schema or channel with a number counts.
    ///
    /// # Errors
    ///
    /// Returns [`io::ErrorKind::FileTooLarge`] if the file has more channels, schemas or sensors than are kept in memory.
    pub(crate) fn note(&mut self, record: &Record) -> io::Result<()> {
        if !matches!(record.opcode, op::HEADER | op::METADATA | op::SCHEMA | op::CHANNEL) {
            return Ok(());
        }
        match record.parse() {
            Some(Parsed::Header(header)) => self.profile = header.profile,
            Some(Parsed::Metadata(metadata)) if metadata.name == METADATA && self.facts.is_empty() => {
                self.facts = metadata.metadata;
            }
            Some(Parsed::Schema { header, data }) if !self.schemas.contains_key(&header.id) => {
                self.bytes += record.body.len() + OVERHEAD;
                self.schemas.insert(header.id, (header.name, header.encoding, data.into_owned()));
            }
            Some(Parsed::Channel(channel)) if !self.channels.contains_key(&channel.id) => {
                self.bytes += record.body.len() + OVERHEAD * (1 + channel.metadata.len());
                let place = Place::of(&channel);
                self.sensors.extend(place.iter().map(|place| place.sensor.clone()));
                self.channels.insert(channel.id, (channel, place));
            }
            _ => {}
        }
        let what = if self.sensors.len() > MOST_SENSORS {
            format!("it names more than {MOST_SENSORS} sensors")
        } else if self.bytes > MOST_BYTES {
            format!("its channels and schemas take more than {} MB", MOST_BYTES >> 20)
        } else {
            return Ok(());
        };
        Err(io::Error::new(io::ErrorKind::FileTooLarge, what))
    }

    /// Returns the channel with this number, and its schema.
    pub(crate) fn channel(&self, id: u16) -> Option<(&Channel, Option<&Schema>)> {
        let (channel, _) = self.channels.get(&id)?;
        Some((channel, self.schemas.get(&channel.schema_id)))
    }

    /// Returns the topic of the channel with this number: `Some(None)` if another program made it, `None` if the channel is
    /// unknown.
    pub(crate) fn place(&self, id: u16) -> Option<Option<&Place>> {
        self.channels.get(&id).map(|(_, place)| place.as_ref())
    }

    /// Returns the topic of a message of the hub, its header and its payload; `None` for any other record.
    pub(crate) fn message<'a>(&self, record: &'a Record) -> Option<(&Place, Header, &'a [u8])> {
        let (message, data) = record.message()?;
        let place = self.place(message.channel_id)??;
        let (header, payload) = sample(&message, data)?;
        Some((place, header, payload))
    }

    /// Returns the sensors that channels name, in the order of the channels' numbers.
    pub(crate) fn sensors(&self) -> Vec<String> {
        let mut seen = HashSet::new();
        let places = self.channels.values().filter_map(|(_, place)| place.as_ref());
        places.map(|place| &place.sensor).filter(|sensor| seen.insert(*sensor)).cloned().collect()
    }

    /// Returns the mounts whose angles have a channel, in the order of the channels' numbers.
    pub(crate) fn mounts(&self) -> Vec<String> {
        let mut seen = HashSet::new();
        let names = self.channels.values().filter_map(|(channel, _)| mount_of(channel));
        names.filter(|name| seen.insert(*name)).map(str::to_owned).collect()
    }

    /// Returns the angle of `mount` that `record` contains. `None` if it contains anything else.
    pub(crate) fn angle(&self, record: &Record, mount: &str) -> Option<(Header, Tilt)> {
        let (message, data) = record.message()?;
        let (channel, _) = self.channels.get(&message.channel_id)?;
        if mount_of(channel)? != mount {
            return None;
        }
        let (header, payload) = sample(&message, data)?;
        let mut tilt = Tilt::default();
        tilt.unpack(payload).then_some((header, tilt))
    }

    /// Returns whether a channel has scans of `sensor`.
    pub(crate) fn has_scans(&self, sensor: &str) -> bool {
        let mut places = self.channels.values().filter_map(|(_, place)| place.as_ref());
        places.any(|place| place.sensor == sensor && place.has_scans())
    }
}

/// Returns the name of the mount whose angles `channel` has.
fn mount_of(channel: &Channel) -> Option<&str> {
    let (mount, topic) = channel.topic.rsplit_once('/')?;
    let is_ours = channel.message_encoding == ENCODING && check_followed(mount).is_ok();
    (is_ours && Topic::parse(topic) == Some(Topic::Tilt)).then_some(mount)
}

/// Returns header and payload of a message of the hub; `None` if the header contradicts the message that contains it.
pub(super) fn sample<'a>(message: &MessageHeader, data: &'a [u8]) -> Option<(Header, &'a [u8])> {
    let (header, payload) = file::parts(data)?;
    let is_same = (header.topic_seq as u32, header.wall_ns) == (message.sequence, message.log_time);
    is_same.then_some((header, payload))
}

/// Maximum number of sensors: those of sixteen hubs, each with as many as one can have.
const MOST_SENSORS: usize = 4096;
/// Maximum memory of channels and schemas. Files of many sensors have some hundred channels, and a megabyte of schemas.
const MOST_BYTES: usize = 20 << 20;
/// Memory that a record takes in addition to its text.
const OVERHEAD: usize = 128;
