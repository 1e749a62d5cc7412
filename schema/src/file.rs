//! The format of a recording: samples as messages of an MCAP file, with a channel for each topic of a sensor. A message
//! has the sample's header, as in shared memory, and then the payload, as it is sent over a network
//! (docs/recording.md).

use std::collections::BTreeMap;
use std::io::{self, BufWriter, Write};

use bytemuck::bytes_of;
use mcap::records::{Channel, MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Attachment, McapError, WriteOptions};

use crate::{Failure, Header, Kind, Topic};

/// First bytes of every MCAP file.
pub use mcap::MAGIC;

/// Encoding of the messages, and of the text that describes them.
pub const ENCODING: &str = "scanhub.v2";
/// Encoding of recordings of version 1. Header, telegrams, marks, zones and statuses are the same as in version 2; the
/// other payloads differ.
pub const ENCODING_V1: &str = "scanhub";
/// Name of the metadata record at the start of a recording. The record describes the origin of the recording.
pub const METADATA: &str = "scanhub";

/// Writes a recording into `W`. Every sample before the last [`close_chunk`](Self::close_chunk) is in the file, and can
/// be read even if the file ends after this chunk. Later samples are only in memory.
pub struct Writer<W: Write> {
    mcap: mcap::Writer<NoSeek<BufWriter<W>>>,
    /// Topics of each sensor, with the IDs of their channels. A sensor has few topics, so a linear search is enough.
    channels: BTreeMap<String, Vec<(Topic, u16)>>,
    message: Vec<u8>,
}

/// Description of a channel for messages of any type, such as messages of ROS 2.
#[derive(Clone, Copy, Debug)]
pub struct ForeignChannel<'a> {
    /// Name of the channel.
    pub topic: &'a str,
    /// Encoding of the channel's messages, such as `cdr`.
    pub encoding: &'a str,
    /// Type of the messages: its name, its definition, and the language of the definition, such as `ros2msg`.
    pub schema: (&'a str, &'a str, &'a str),
    /// Metadata of the channel: keys and values.
    pub metadata: &'a [(&'a str, &'a str)],
}

impl<W: Write> Writer<W> {
    /// Starts a recording with `profile` (empty, or `ros2`) and `metadata`. Its chunks are not compressed.
    ///
    /// # Errors
    ///
    /// Returns the error of `out`.
    pub fn begin(out: W, profile: &str, metadata: BTreeMap<String, String>) -> io::Result<Self> {
        Writer::begin_compressed(out, profile, Compression::None, metadata)
    }

    /// Does the same as [`begin`](Self::begin), with chunks that are compressed by `compression`.
    ///
    /// # Errors
    ///
    /// Returns the error of `out`.
    pub fn begin_compressed(
        out: W,
        profile: &str,
        compression: Compression,
        metadata: BTreeMap<String, String>,
    ) -> io::Result<Self> {
        // A chunk is written when it is closed, so a process that is killed leaves only whole chunks.
        let options = WriteOptions::new()
            .compression(compression.to_library())
            .compression_level(compression.level())
            // No threads for compression: chunks are short, and the caller already has a thread for writing.
            .compression_threads(0)
            .profile(profile)
            .library("scanhub")
            .chunk_size(None)
            .disable_seeking(true);
        let mcap = options.create(NoSeek::new(BufWriter::new(out))).map_err(io_error)?;
        let mut writer = Writer { mcap, channels: BTreeMap::new(), message: Vec::with_capacity(4096) };
        writer.write_metadata(METADATA, metadata)?;
        writer.close_chunk()?;
        Ok(writer)
    }

    /// Writes a sample of `sensor`'s `topic`. `payload` is packed as for a network
    /// ([`DatagramPayload`](crate::datagram::DatagramPayload)).
    ///
    /// # Errors
    ///
    /// Returns the error of `W`.
    pub fn write_sample(
        &mut self,
        sensor: &str,
        topic: Topic,
        header: &Header,
        payload: &[u8],
    ) -> io::Result<()> {
        let known = self.channels.get(sensor).and_then(|topics| topics.iter().find(|(its, _)| *its == topic));
        let channel = match known {
            Some(&(_, channel)) => channel,
            None => {
                let name = format!("{sensor}/{}", topic.name());
                let schema = (schema_name(topic), LAYOUT, ENCODING);
                let channel = self.add_channel(&ForeignChannel {
                    topic: &name,
                    encoding: ENCODING,
                    schema,
                    metadata: &[],
                })?;
                self.channels.entry(sensor.to_owned()).or_default().push((topic, channel));
                channel
            }
        };
        let mut message = std::mem::take(&mut self.message);
        message.clear();
        message.extend_from_slice(bytes_of(header));
        message.extend_from_slice(payload);
        let written = self.write_message(channel, header.topic_seq as u32, header.wall_ns, &message);
        self.message = message;
        written
    }

    /// Creates a channel, or returns the existing one with this description.
    ///
    /// # Errors
    ///
    /// Returns the error of `W`.
    pub fn add_channel(&mut self, description: &ForeignChannel<'_>) -> io::Result<u16> {
        let (name, text, language) = description.schema;
        let schema = self.mcap.add_schema(name, language, text.as_bytes()).map_err(io_error)?;
        let metadata =
            description.metadata.iter().map(|&(key, value)| (key.to_owned(), value.to_owned())).collect();
        self.mcap.add_channel(schema, description.topic, description.encoding, &metadata).map_err(io_error)
    }

    /// Writes a message into a channel, at `time_ns` since 1970.
    ///
    /// # Errors
    ///
    /// Returns the error of `W`.
    pub fn write_message(
        &mut self,
        channel_id: u16,
        sequence: u32,
        time_ns: u64,
        data: &[u8],
    ) -> io::Result<()> {
        let header = MessageHeader { channel_id, sequence, log_time: time_ns, publish_time: time_ns };
        self.mcap.write_to_known_channel(&header, data).map_err(io_error)
    }

    /// Creates a channel that copies a channel of another file. `schema` has the name, language and definition of the
    /// messages' type, if the channel has a type.
    ///
    /// # Errors
    ///
    /// Returns the error of `W`.
    pub fn copy_channel(
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

    /// Writes a message of another file into the channel that `header` names.
    ///
    /// # Errors
    ///
    /// Returns the error of `W`.
    pub fn copy_message(&mut self, header: &MessageHeader, data: &[u8]) -> io::Result<()> {
        self.mcap.write_to_known_channel(header, data).map_err(io_error)
    }

    /// Closes the chunk and writes an attachment of another file.
    ///
    /// # Errors
    ///
    /// Returns the error of `W`.
    pub fn copy_attachment(&mut self, attachment: &Attachment<'_>) -> io::Result<()> {
        self.mcap.attach(attachment).map_err(io_error)
    }

    /// Closes the chunk and writes a metadata record called `name`.
    ///
    /// # Errors
    ///
    /// Returns the error of `W`.
    pub fn write_metadata(&mut self, name: &str, metadata: BTreeMap<String, String>) -> io::Result<()> {
        self.mcap.write_metadata(&Metadata { name: name.to_owned(), metadata }).map_err(io_error)
    }

    /// Closes the chunk and passes everything to `W`.
    ///
    /// # Errors
    ///
    /// Returns the error of `W`.
    pub fn close_chunk(&mut self) -> io::Result<()> {
        self.mcap.flush().map_err(io_error)
    }

    /// Writes the index, without which a reader must read the whole file, and returns `W`.
    ///
    /// # Errors
    ///
    /// Returns the error of `W`.
    pub fn finish(mut self) -> io::Result<W> {
        self.mcap.finish().map_err(io_error)?;
        self.mcap.into_inner().into_inner().into_inner().map_err(io::IntoInnerError::into_error)
    }
}

/// Returns header and payload of a message of a recording; `None` if the message is shorter than a header.
pub fn split_message(message: &[u8]) -> Option<(Header, &[u8])> {
    let (header, payload) = message.split_at_checked(size_of::<Header>())?;
    Some((bytemuck::pod_read_unaligned(header), payload))
}

/// Returns the name of the type of `topic`'s messages.
pub fn schema_name(topic: Topic) -> &'static str {
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

/// Text that describes the format of the messages. Every recording contains it, for readers that have only the file.
pub const LAYOUT: &str = include_str!("file/layout.txt");

/// Compression of chunks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Compression {
    /// Uncompressed.
    None,
    /// LZ4.
    Lz4,
    /// Zstandard, which makes the shortest files.
    #[default]
    Zstd,
}

impl Compression {
    /// Returns the compression called `zstd`, `lz4` or `none`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Usage`] for any other text.
    pub fn parse(text: &str) -> Result<Compression, Failure> {
        match text {
            "zstd" => Ok(Compression::Zstd),
            "lz4" => Ok(Compression::Lz4),
            "none" => Ok(Compression::None),
            _ => Err(Failure::new(Kind::Usage, format!("unknown compression {text:?}"), "zstd, lz4 or none")),
        }
    }

    fn to_library(self) -> Option<mcap::Compression> {
        match self {
            Compression::None => None,
            Compression::Lz4 => Some(mcap::Compression::Lz4),
            Compression::Zstd => Some(mcap::Compression::Zstd),
        }
    }

    /// Returns the level of compression. Higher levels take many times as long and save a few percent.
    fn level(self) -> u32 {
        u32::from(self == Compression::Zstd)
    }
}
