//! MCAP files that the hub recorded. [`Reader`] yields the telegrams of all sensors and all other records, [`Catalog`]
//! has the channels, and [`FileSummary`] has the contents of the whole file, which is read to its end once before its
//! telegrams are used.

mod records;

use std::collections::{BTreeMap, HashSet};
use std::io::{self, Read};

use mcap::records::{Channel, MessageHeader, Record as Parsed, op};
use scanhub_drivers::features;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::Mode;
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::{self, ENCODING, ENCODING_V1, METADATA};
use scanhub_schema::{
    Family, Foreground, Header, PublishRate, PublisherKind, Scan, Status, Tilt, Topic, check_any_sensor,
};

use crate::{Contents, Damage, Frame, MountRecord};
use records::Records;
pub(crate) use records::{Record, has_record_boundary};

/// Item of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Item {
    /// A telegram of a sensor.
    Telegram(Sample),
    /// Any other record.
    Record(Record),
}

/// Message of topic `telegram`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Sample {
    pub(crate) sensor: String,
    pub(crate) header: Header,
    pub(crate) telegram: Vec<u8>,
}

/// Reader of a file, from its beginning to its end.
pub(crate) struct Reader<R> {
    records: Records<R>,
    catalog: Catalog,
    /// Whether a message was read whose channel was unknown.
    has_unknown: bool,
}

impl<R: Read> Reader<R> {
    /// Creates a reader of `input`. `catalog` has the channels that are already known.
    fn new(input: R, catalog: Catalog) -> Self {
        Reader { records: Records::new(input), catalog, has_unknown: false }
    }

    /// Returns the next telegram or record; `None` at the end.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Records::next`] and [`Catalog::note`].
    pub(crate) fn next(&mut self) -> io::Result<Option<Item>> {
        loop {
            let Some(record) = self.records.next()? else { return Ok(None) };
            self.catalog.note(&record)?;
            let sample = self.telegram(&record);
            if !record.is_in_chunk && self.is_damaged(&record, sample.as_ref()) {
                self.records.reject(&record);
                continue;
            }
            return Ok(Some(match sample {
                Some(sample) => Item::Telegram(sample),
                None => Item::Record(record),
            }));
        }
    }

    /// Returns whether `record`, which is outside chunks and has no checksum, contradicts itself. This is a message of
    /// the hub whose header does not fit the message, or a telegram of an LMS with a wrong CRC.
    fn is_damaged(&self, record: &Record, sample: Option<&Sample>) -> bool {
        if let Some(Sample { header, telegram, .. }) = sample {
            return header.family == Family::Lms as u8 && Telegram::check(telegram).is_none();
        }
        record.message().is_some_and(|(message, data)| {
            let is_ours = matches!(self.catalog.channel_topic(message.channel_id), Some(Some(_)));
            is_ours && split_sample(&message, data).is_none()
        })
    }

    fn telegram(&mut self, record: &Record) -> Option<Sample> {
        let (message, data) = record.message()?;
        let (sensor, (header, telegram)) = match self.catalog.channel_topic(message.channel_id) {
            Some(channel_topic) => {
                let channel_topic =
                    channel_topic.filter(|channel_topic| channel_topic.topic == Topic::Telegram)?;
                (channel_topic.sensor.clone(), split_sample(&message, data)?)
            }
            // The record of the channel is lost. A telegram of an LMS can still be recognized by its CRC.
            None => {
                self.has_unknown = true;
                let sample = split_sample(&message, data)?;
                Telegram::check(sample.1)?;
                (format!("sensor{}", sample.0.sensor), sample)
            }
        };
        Some(Sample { sensor, header, telegram: telegram.to_vec() })
    }
}

/// Contents of a file that was read to its end.
#[derive(Debug, Default)]
pub(crate) struct FileSummary {
    whole: Contents,
    sensors: BTreeMap<String, Contents>,
    catalog: Catalog,
    /// Header of each sensor's last telegram.
    last: BTreeMap<String, Header>,
    /// Sequence number of the first telegram from which the hub computed another sample, by sensor and boot ID of the
    /// hub.
    first_understood: BTreeMap<String, BTreeMap<u64, u64>>,
    /// Number of pairs of sensor and boot ID in `first_understood`.
    runs: usize,
}

impl FileSummary {
    /// Reads the file that `open` opens. A damaged file may be read twice: if the chunk with a channel is lost, the
    /// index at the end can still name the channel.
    ///
    /// # Errors
    ///
    /// Returns the errors of `open` and of [`Reader::next`].
    pub(crate) fn of<R: Read>(open: impl Fn() -> io::Result<R>) -> io::Result<FileSummary> {
        let (summary, is_complete) = FileSummary::read(Reader::new(open()?, Catalog::default()))?;
        if is_complete {
            return Ok(summary);
        }
        FileSummary::read(Reader::new(open()?, summary.catalog)).map(|(summary, _)| summary)
    }

    /// Reads a file, and returns whether all of its messages have known channels.
    fn read<R: Read>(mut reader: Reader<R>) -> io::Result<(FileSummary, bool)> {
        let mut summary = FileSummary::default();
        while let Some(item) = reader.next()? {
            match item {
                Item::Telegram(sample) => summary.note(&sample),
                Item::Record(record) => summary.note_record(&reader.catalog, &record),
            }
        }
        summary.whole.sensors = reader.catalog.sensors();
        for sensor in &summary.whole.sensors {
            of_sensor(&mut summary.sensors, sensor);
        }
        let named: HashSet<_> = summary.whole.sensors.iter().collect();
        let nameless: Vec<_> = summary.sensors.keys().filter(|name| !named.contains(name)).cloned().collect();
        summary.whole.sensors.extend(nameless);
        let damage = reader.records.damage();
        for contents in std::iter::once(&mut summary.whole).chain(summary.sensors.values_mut()) {
            contents.damage = Damage { telegrams: contents.damage.telegrams, ..damage };
        }
        summary.catalog = reader.catalog;
        Ok((summary, !reader.has_unknown))
    }

    /// Returns the contents of the whole file.
    pub(crate) fn contents(&self) -> Contents {
        self.whole.clone()
    }

    /// Returns the contents that belong to `sensor`.
    pub(crate) fn contents_of(&self, sensor: &str) -> Contents {
        let contents = self.sensors.get(sensor).cloned().unwrap_or_default();
        Contents { sensors: vec![sensor.to_owned()], ..contents }
    }

    /// Reads the file again, from `input`.
    pub(crate) fn reader<R: Read>(&self, input: R) -> Reader<R> {
        Reader::new(input, self.catalog.clone())
    }

    /// Reads the file again, and returns the telegrams of `sensor` in the order of the file. The telegrams end at the
    /// first error.
    pub(crate) fn frames<R: Read>(&self, input: R, sensor: String) -> impl Iterator<Item = Frame> + use<R> {
        let mut reader = self.reader(input);
        std::iter::from_fn(move || {
            loop {
                if let Item::Telegram(sample) = reader.next().ok()??
                    && sample.sensor == sensor
                {
                    let Sample { header, telegram, .. } = sample;
                    return Some(Frame {
                        telegram,
                        family: header.family,
                        wall_ns: Some(header.wall_ns),
                        scanner_ns: None,
                        reasons: header.reasons,
                        header: Some(header),
                    });
                }
            }
        })
    }

    /// Reads the file again, and returns the angles of `mount` and the telegrams of the mount's machine, in the order
    /// of the file. The records end at the first error. If the file has no sensor of that machine, the telegrams of all
    /// machines are returned.
    pub(crate) fn angles<R: Read>(
        &self,
        input: R,
        mount: String,
    ) -> impl Iterator<Item = MountRecord> + use<R> {
        let is_near = |sensor: &String| machine(sensor) == machine(&mount);
        let is_alone = !self.catalog.sensors().iter().any(is_near);
        let mut reader = self.reader(input);
        std::iter::from_fn(move || {
            loop {
                match reader.next().ok()?? {
                    Item::Record(record) => {
                        if let Some((header, tilt)) = reader.catalog.angle(&record, &mount) {
                            return Some(MountRecord::Angle(header, tilt));
                        }
                    }
                    Item::Telegram(Sample { sensor, header, .. }) => {
                        if is_alone || machine(&sensor) == machine(&mount) {
                            return Some(MountRecord::Telegram(header));
                        }
                    }
                }
            }
        })
    }

    /// Returns the channels of the file.
    pub(crate) fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    /// Returns the sequence number of the first telegram of `sensor` from which the hub with the ID `boot` computed
    /// another sample. Returns `None` if the file has no such sample, or is damaged.
    pub(crate) fn first_understood(&self, sensor: &str, boot: u64) -> Option<u64> {
        self.first_understood.get(sensor)?.get(&boot).copied().filter(|_| !self.whole.damage.is_damaged)
    }

    fn note(&mut self, sample: &Sample) {
        let Sample { sensor, header, telegram } = sample;
        let missing = match self.last.get_mut(sensor) {
            Some(last) => {
                let last = std::mem::replace(last, *header);
                let is_same_run = last.boot == header.boot;
                if is_same_run {
                    header.topic_seq.saturating_sub(last.topic_seq.saturating_add(1))
                } else {
                    0
                }
            }
            None => {
                self.last.insert(sensor.clone(), *header);
                0
            }
        };
        for contents in [&mut self.whole, of_sensor(&mut self.sensors, sensor)] {
            contents.note(header.family, telegram, Some(header.wall_ns));
            contents.damage.telegrams = contents.damage.telegrams.saturating_add(missing);
        }
    }

    /// Stores what a status reports about the scanner, and the first telegram from which the hub computed another
    /// sample.
    fn note_record(&mut self, catalog: &Catalog, record: &Record) {
        let Some((channel_topic, header, payload)) = catalog.message(record) else { return };
        let is_of_scan = channel_topic.topic.spec().publish_rate == PublishRate::Scan
            && channel_topic.topic != Topic::Telegram;
        // A sample without a hub time was not computed from a telegram.
        if is_of_scan && header.hub_time_ns().is_some() {
            let runs = match self.first_understood.get_mut(&channel_topic.sensor) {
                Some(runs) => runs,
                None => self.first_understood.entry(channel_topic.sensor.clone()).or_default(),
            };
            match runs.get_mut(&header.boot) {
                Some(first) => *first = header.seq.min(*first),
                None if self.runs < MAX_RUNS => {
                    runs.insert(header.boot, header.seq);
                    self.runs += 1;
                }
                None => {}
            }
        }
        if header.family != Family::Lms as u8 {
            let of_sensor = of_sensor(&mut self.sensors, &channel_topic.sensor);
            if of_sensor.beams.is_none() {
                of_sensor.beams = beams_of(channel_topic, payload);
                self.whole.beams = self.whole.beams.or(of_sensor.beams);
            }
        }
        let mut status = Status::default();
        if channel_topic.topic == Topic::Status && status.unpack(payload) {
            let mode = (status.mode != Status::MODE_UNKNOWN).then_some(Mode(status.mode));
            let rotating = if channel_topic.is_old { None } else { rotating(&status) };
            let name = Some(status.sensor_type()).filter(|name| !name.is_empty());
            for contents in [&mut self.whole, of_sensor(&mut self.sensors, &channel_topic.sensor)] {
                contents.mode = contents.mode.or(mode);
                if contents.sensor_type.is_none() {
                    contents.sensor_type = name.map(|name| (status.family, name.to_owned()));
                }
                if let Some((model, mode_name)) = rotating {
                    contents.model = contents.model.or(model);
                    contents.mode_name = contents.mode_name.or(mode_name);
                    contents.step_cdeg = contents.step_cdeg.or(Some(status.resolution_cdeg));
                }
            }
        }
    }
}

/// Returns the number of beams of the scan in `payload`, or of the scan from which `payload` was computed. Returns
/// `None` for other topics.
fn beams_of(channel_topic: &ChannelTopic, payload: &[u8]) -> Option<u16> {
    match channel_topic.topic {
        _ if channel_topic.is_old => None,
        Topic::Scan => {
            let mut scan = Box::<Scan>::default();
            Scan::unpack_into(&mut scan, payload).then(|| scan.beams() as u16)
        }
        // By default, a recording contains no scans, but foregrounds.
        Topic::Foreground => {
            let mut foreground = Box::<Foreground>::default();
            Foreground::unpack_into(&mut foreground, payload).then_some(foreground.count)
        }
        _ => None,
    }
    .filter(|beams| *beams > 0)
}

/// Returns the model and the scan mode that `status` names, if the scanner is a rotating one. A model or mode that this
/// version does not support is `None`.
fn rotating(status: &Status) -> Option<(Option<&'static str>, Option<&'static str>)> {
    let features = features(Family::of_number(status.family)?);
    let name = status.model().filter(|_| !features.has_whole_telegrams)?;
    let model = features.models.iter().map(|model| model.name).find(|known| *known == name);
    let mode_name = features.modes.iter().copied().find(|known| status.mode_name() == Some(known));
    Some((model, mode_name))
}

fn of_sensor<'a>(sensors: &'a mut BTreeMap<String, Contents>, sensor: &str) -> &'a mut Contents {
    sensors.entry(sensor.to_owned()).or_default()
}

/// Returns the machine in the name of a remote sensor; `None` for a sensor of this machine.
fn machine(sensor: &str) -> Option<&str> {
    sensor.split_once('.').map(|(machine, _)| machine)
}

/// Sensor and topic to which a channel belongs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ChannelTopic {
    pub(crate) sensor: String,
    pub(crate) topic: Topic,
    /// Whether the messages of the channel have the format of version 1.
    is_old: bool,
}

impl ChannelTopic {
    /// Returns the topic of `channel`; `None` if the channel belongs to another program, or does not name a valid
    /// sensor.
    fn of(channel: &Channel) -> Option<ChannelTopic> {
        let (sensor, topic) = channel.topic.rsplit_once('/')?;
        let is_old = channel.message_encoding == ENCODING_V1;
        let is_ours = (is_old || channel.message_encoding == ENCODING) && check_any_sensor(sensor).is_ok();
        let topic =
            Topic::parse(topic).filter(|topic| is_ours && topic.publisher_kind() == PublisherKind::Link)?;
        Some(ChannelTopic { sensor: sensor.to_owned(), topic, is_old })
    }

    /// Returns whether the messages are scans in the current format.
    pub(crate) fn has_scans(&self) -> bool {
        self.topic == Topic::Scan && !self.is_old
    }
}

/// Name, language and text of a schema.
type Schema = (String, String, Vec<u8>);

/// Schemas and channels of a file. The index of the file repeats them, so they are known even if the first chunk that
/// contains them is lost.
#[derive(Clone, Debug, Default)]
pub(crate) struct Catalog {
    /// Profile of the file, such as `ros2`.
    pub(crate) profile: String,
    /// Description of the recording, such as domain, host and version ([`METADATA`]).
    pub(crate) metadata: BTreeMap<String, String>,
    schemas: BTreeMap<u16, Schema>,
    channels: BTreeMap<u16, (Channel, Option<ChannelTopic>)>,
    sensors: HashSet<String>,
    /// Approximate memory of schemas and channels, in bytes.
    bytes: usize,
}

impl Catalog {
    /// Stores the schema, the channel or the metadata in `record`. If the same ID occurs again, the first schema or
    /// channel with this ID is kept.
    ///
    /// # Errors
    ///
    /// Returns [`io::ErrorKind::FileTooLarge`] if the file has more channels, schemas or sensors than the limits
    /// permit.
    pub(crate) fn note(&mut self, record: &Record) -> io::Result<()> {
        if !matches!(record.opcode, op::HEADER | op::METADATA | op::SCHEMA | op::CHANNEL) {
            return Ok(());
        }
        match record.parse() {
            Some(Parsed::Header(header)) => self.profile = header.profile,
            Some(Parsed::Metadata(metadata)) if metadata.name == METADATA && self.metadata.is_empty() => {
                self.metadata = metadata.metadata;
            }
            Some(Parsed::Schema { header, data }) if !self.schemas.contains_key(&header.id) => {
                self.bytes += record.body.len() + RECORD_OVERHEAD;
                self.schemas.insert(header.id, (header.name, header.encoding, data.into_owned()));
            }
            Some(Parsed::Channel(channel)) if !self.channels.contains_key(&channel.id) => {
                self.bytes += record.body.len() + RECORD_OVERHEAD * (1 + channel.metadata.len());
                let channel_topic = ChannelTopic::of(&channel);
                self.sensors.extend(channel_topic.iter().map(|channel_topic| channel_topic.sensor.clone()));
                self.channels.insert(channel.id, (channel, channel_topic));
            }
            _ => {}
        }
        let what = if self.sensors.len() > MAX_SENSORS {
            format!("it names more than {MAX_SENSORS} sensors")
        } else if self.bytes > MAX_CATALOG_BYTES {
            format!("its channels and schemas take more than {} MB", MAX_CATALOG_BYTES >> 20)
        } else {
            return Ok(());
        };
        Err(io::Error::new(io::ErrorKind::FileTooLarge, what))
    }

    /// Returns the channel with this ID, and its schema.
    pub(crate) fn channel(&self, id: u16) -> Option<(&Channel, Option<&Schema>)> {
        let (channel, _) = self.channels.get(&id)?;
        Some((channel, self.schemas.get(&channel.schema_id)))
    }

    /// Returns the topic of the channel with this ID. Returns `Some(None)` if the channel belongs to another program,
    /// and `None` if the channel is unknown.
    pub(crate) fn channel_topic(&self, id: u16) -> Option<Option<&ChannelTopic>> {
        self.channels.get(&id).map(|(_, channel_topic)| channel_topic.as_ref())
    }

    /// Returns the topic, the header and the payload if `record` is a message of the hub; `None` for any other record.
    pub(crate) fn message<'a>(&self, record: &'a Record) -> Option<(&ChannelTopic, Header, &'a [u8])> {
        let (message, data) = record.message()?;
        let channel_topic = self.channel_topic(message.channel_id)??;
        let (header, payload) = split_sample(&message, data)?;
        Some((channel_topic, header, payload))
    }

    /// Returns the sensors that channels of the hub name, in the order of the channels' IDs.
    pub(crate) fn sensors(&self) -> Vec<String> {
        let mut known = HashSet::new();
        let channel_topics = self.channels.values().filter_map(|(_, channel_topic)| channel_topic.as_ref());
        channel_topics
            .map(|channel_topic| &channel_topic.sensor)
            .filter(|sensor| known.insert(*sensor))
            .cloned()
            .collect()
    }

    /// Returns the mounts whose angles have a channel, in the order of the channels' IDs.
    pub(crate) fn mounts(&self) -> Vec<String> {
        let mut known = HashSet::new();
        let names = self.channels.values().filter_map(|(channel, _)| mount_of(channel));
        names.filter(|name| known.insert(*name)).map(str::to_owned).collect()
    }

    /// Returns the angle of `mount` in `record`; `None` for any other record.
    pub(crate) fn angle(&self, record: &Record, mount: &str) -> Option<(Header, Tilt)> {
        let (message, data) = record.message()?;
        let (channel, _) = self.channels.get(&message.channel_id)?;
        if mount_of(channel)? != mount {
            return None;
        }
        let (header, payload) = split_sample(&message, data)?;
        let mut tilt = Tilt::default();
        tilt.unpack(payload).then_some((header, tilt))
    }

    /// Returns whether a channel has scans of `sensor`.
    pub(crate) fn has_scans(&self, sensor: &str) -> bool {
        let mut channel_topics =
            self.channels.values().filter_map(|(_, channel_topic)| channel_topic.as_ref());
        channel_topics.any(|channel_topic| channel_topic.sensor == sensor && channel_topic.has_scans())
    }
}

/// Returns the name of the mount whose angles `channel` has.
fn mount_of(channel: &Channel) -> Option<&str> {
    let (mount, topic) = channel.topic.rsplit_once('/')?;
    let is_ours = channel.message_encoding == ENCODING && check_any_sensor(mount).is_ok();
    (is_ours && Topic::parse(topic) == Some(Topic::Tilt)).then_some(mount)
}

/// Returns header and payload of a message of the hub. Returns `None` if the sequence number or the time in the header
/// differs from that of the message.
pub(crate) fn split_sample<'a>(message: &MessageHeader, data: &'a [u8]) -> Option<(Header, &'a [u8])> {
    let (header, payload) = file::split_message(data)?;
    let is_same = (header.topic_seq as u32, header.wall_ns) == (message.sequence, message.log_time);
    is_same.then_some((header, payload))
}

/// Maximum number of stored runs of a hub: one per minute for a month.
const MAX_RUNS: usize = 50_000;
/// Maximum number of sensors: sixteen hubs with 256 links each, which is the maximum for a hub.
const MAX_SENSORS: usize = 4096;
/// Maximum memory of channels and schemas, in bytes. Files of many sensors have some hundred channels, and a megabyte
/// of schemas.
const MAX_CATALOG_BYTES: usize = 20 << 20;
/// Number of bytes of memory that a stored schema or channel takes in addition to its text.
const RECORD_OVERHEAD: usize = 128;
