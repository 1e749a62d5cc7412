//! The format of a recording: samples as messages of an MCAP file, a channel for each sensor's topic. A message is the
//! header of shared memory, followed by the payload as it is sent over a network (docs/recording.md). Refuses to know
//! where samples come from, when a chunk is full, and what a disk does.

mod compression;

use std::collections::BTreeMap;
use std::io::{self, BufWriter, Write};

use bytemuck::bytes_of;
use mcap::records::{Channel, MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Attachment, McapError, WriteOptions};

use crate::{Header, Topic};
pub use compression::Compression;
/// First bytes of every MCAP file.
pub use mcap::MAGIC;

/// Encoding of the messages, and of the text that describes them.
pub const ENCODING: &str = "scanhub.v2";
/// That of recordings of version 1: header, telegrams, marks, zones and statuses are as they are now, the others are not.
pub const ENCODING_V1: &str = "scanhub";
/// Name of the metadata record at the start of a recording: who recorded what, where.
pub const METADATA: &str = "scanhub";

/// Writes a recording into `W`. Everything written up to [`close_chunk`](Self::close_chunk) can be read even if nothing
/// follows; until then it is only in memory.
pub struct Writer<W: Write> {
    mcap: mcap::Writer<NoSeek<BufWriter<W>>>,
    /// Of each sensor, few enough to be looked through.
    channels: BTreeMap<String, Vec<(Topic, u16)>>,
    message: Vec<u8>,
}

/// The description of a channel that is not one of the hub's topics.
#[derive(Clone, Copy, Debug)]
pub struct Foreign<'a> {
    /// Name of the channel.
    pub topic: &'a str,
    /// Encoding of its messages, such as `cdr`.
    pub encoding: &'a str,
    /// Name of their type, its description, and in what language that is written, such as `ros2msg`.
    pub schema: (&'a str, &'a str, &'a str),
    /// Metadata of the channel: keys and values.
    pub metadata: &'a [(&'a str, &'a str)],
}

impl<W: Write> Writer<W> {
    /// Begins a recording of `profile` (empty, or `ros2`), of which `facts` are told; its chunks are not packed.
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn begin(out: W, profile: &str, facts: BTreeMap<String, String>) -> io::Result<Self> {
        Writer::packed(out, profile, Compression::None, facts)
    }

    /// Returns the same with chunks that are packed by `compression`.
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn packed(
        out: W,
        profile: &str,
        compression: Compression,
        facts: BTreeMap<String, String>,
    ) -> io::Result<Self> {
        // A chunk is written when it is closed: a process that is killed leaves whole chunks and nothing else.
        let options = WriteOptions::new()
            .compression(compression.of_library())
            .compression_level(compression.level())
            // Chunks are short, and whoever writes them has one thread for that.
            .compression_threads(0)
            .profile(profile)
            .library("scanhub")
            .chunk_size(None)
            .disable_seeking(true);
        let mcap = options.create(NoSeek::new(BufWriter::new(out))).map_err(io_error)?;
        let mut writer = Writer { mcap, channels: BTreeMap::new(), message: Vec::with_capacity(4096) };
        writer.note(METADATA, facts)?;
        writer.close_chunk()?;
        Ok(writer)
    }

    /// Writes a sample of `sensor`'s `topic`; `payload` is packed as for a network
    /// ([`Packed`](crate::datagram::Packed)).
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn sample(&mut self, sensor: &str, topic: Topic, header: &Header, payload: &[u8]) -> io::Result<()> {
        let known = self.channels.get(sensor).and_then(|its| its.iter().find(|(its, _)| *its == topic));
        let channel = match known {
            Some(&(_, channel)) => channel,
            None => {
                let name = format!("{sensor}/{}", topic.name());
                let schema = (schema(topic), LAYOUT, ENCODING);
                let channel =
                    self.channel(&Foreign { topic: &name, encoding: ENCODING, schema, metadata: &[] })?;
                self.channels.entry(sensor.to_owned()).or_default().push((topic, channel));
                channel
            }
        };
        let mut message = std::mem::take(&mut self.message);
        message.clear();
        message.extend_from_slice(bytes_of(header));
        message.extend_from_slice(payload);
        let written = self.message(channel, header.topic_seq as u32, header.wall_ns, &message);
        self.message = message;
        written
    }

    /// Makes a channel, or finds the one made before.
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn channel(&mut self, foreign: &Foreign<'_>) -> io::Result<u16> {
        let (name, text, language) = foreign.schema;
        let schema = self.mcap.add_schema(name, language, text.as_bytes()).map_err(io_error)?;
        let metadata =
            foreign.metadata.iter().map(|&(key, value)| (key.to_owned(), value.to_owned())).collect();
        self.mcap.add_channel(schema, foreign.topic, foreign.encoding, &metadata).map_err(io_error)
    }

    /// Writes a message of `time_ns` since 1970 into a channel.
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn message(&mut self, channel_id: u16, sequence: u32, time_ns: u64, data: &[u8]) -> io::Result<()> {
        let header = MessageHeader { channel_id, sequence, log_time: time_ns, publish_time: time_ns };
        self.mcap.write_to_known_channel(&header, data).map_err(io_error)
    }

    /// Makes a channel as another file has it, with name, language and text of its messages' type, if it has one.
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn copied_channel(
        &mut self,
        channel: &Channel,
        schema: Option<(&str, &str, &[u8])>,
    ) -> io::Result<u16> {
        let mut add = || {
            let schema = match schema {
                Some((name, language, text)) => self.mcap.add_schema(name, language, text)?,
                None => 0,
            };
            self.mcap.add_channel(schema, &channel.topic, &channel.message_encoding, &channel.metadata)
        };
        add().map_err(io_error)
    }

    /// Writes a message as another file has it, into the channel that `header` names.
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn copied_message(&mut self, header: &MessageHeader, data: &[u8]) -> io::Result<()> {
        self.mcap.write_to_known_channel(header, data).map_err(io_error)
    }

    /// Writes a file within the file, as another one has it, behind a chunk that this closes.
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn copied_attachment(&mut self, attachment: &Attachment<'_>) -> io::Result<()> {
        self.mcap.attach(attachment).map_err(io_error)
    }

    /// Writes a metadata record called `name`, behind a chunk that this closes.
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn note(&mut self, name: &str, facts: BTreeMap<String, String>) -> io::Result<()> {
        self.mcap.write_metadata(&Metadata { name: name.to_owned(), metadata: facts }).map_err(io_error)
    }

    /// Hands all that was written to `W`.
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn close_chunk(&mut self) -> io::Result<()> {
        self.mcap.flush().map_err(io_error)
    }

    /// Writes the index, without which a reader must read the whole file, and gives `W` back.
    ///
    /// # Errors
    ///
    /// The error of what it is written to.
    pub fn finish(mut self) -> io::Result<W> {
        self.mcap.finish().map_err(io_error)?;
        self.mcap.into_inner().into_inner().into_inner().map_err(io::IntoInnerError::into_error)
    }
}

/// Returns header and payload of a message of a recording; `None` if it is shorter than a header.
pub fn parts(message: &[u8]) -> Option<(Header, &[u8])> {
    let (header, payload) = message.split_at_checked(size_of::<Header>())?;
    Some((bytemuck::pod_read_unaligned(header), payload))
}

/// Returns the name of the type of `topic`'s messages.
pub fn schema(topic: Topic) -> &'static str {
    match topic {
        Topic::Telegram => "scanhub.Telegram.v2",
        other => other.payload(),
    }
}

fn io_error(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        other => io::Error::other(other),
    }
}

/// What stands in a file about the messages, for whoever has nothing but the file.
pub const LAYOUT: &str = include_str!("file/layout.txt");
