//! Recording that is read with the MCAP library and the format in docs/recording.md, without code of scanhub.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use mcap::MessageStream;
use mcap::read::{LinearReader, Options};
use mcap::records::Record;

/// Content of a recording.
pub(crate) struct Recording {
    pub(crate) messages: Vec<RecordedMessage>,
    /// Names and entries of the metadata records, in file order.
    pub(crate) metadata: Vec<(String, BTreeMap<String, String>)>,
}

/// Message of a recording.
#[derive(Clone, Debug)]
pub(crate) struct RecordedMessage {
    pub(crate) topic: String,
    pub(crate) encoding: String,
    pub(crate) schema: String,
    pub(crate) sequence: u32,
    pub(crate) log_time: u64,
    pub(crate) data: Vec<u8>,
}

impl Recording {
    /// Reads a recording that was finished normally. Asserts that the file has an end record, and an index with the
    /// right number of messages.
    pub(crate) fn read_complete(path: &Path) -> Recording {
        let bytes = file_bytes(path);
        let summary =
            mcap::Summary::read(&bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let stats = summary.and_then(|summary| summary.stats).expect("the recording has an index");
        let recording = Recording::read(&bytes, path);
        assert_eq!(stats.message_count, recording.messages.len() as u64, "{}", path.display());
        MessageStream::new(&bytes).expect("the recording is complete");
        recording
    }

    /// Reads a recording whose recorder was killed, up to its last complete record.
    pub(crate) fn read_interrupted(path: &Path) -> Recording {
        Recording::read(&file_bytes(path), path)
    }

    /// Reads a recording from `bytes`. Panics name the path `from`.
    pub(crate) fn read(bytes: &[u8], from: &Path) -> Recording {
        let place = from.display();
        let options = Options::IgnoreEndMagic.into();
        let messages = MessageStream::new_with_options(bytes, options)
            .unwrap_or_else(|error| panic!("{place}: {error}"));
        let recorded = messages.map_while(Result::ok).map(|message| RecordedMessage {
            topic: message.channel.topic.clone(),
            encoding: message.channel.message_encoding.clone(),
            schema: message.channel.schema.as_ref().map(|schema| schema.name.clone()).unwrap_or_default(),
            sequence: message.sequence,
            log_time: message.log_time,
            data: message.data.into_owned(),
        });
        let records =
            LinearReader::new_with_options(bytes, options).unwrap_or_else(|error| panic!("{place}: {error}"));
        let notes = records.map_while(Result::ok).filter_map(|record| match record {
            Record::Metadata(note) => Some((note.name, note.metadata)),
            _ => None,
        });
        Recording { messages: recorded.collect(), metadata: notes.collect() }
    }

    /// Returns the messages of `topic`, in file order.
    pub(crate) fn of(&self, topic: &str) -> Vec<&RecordedMessage> {
        self.messages.iter().filter(|message| message.topic == topic).collect()
    }

    /// Returns the metadata records called `name`, in file order.
    pub(crate) fn metadata(&self, name: &str) -> Vec<&BTreeMap<String, String>> {
        self.metadata.iter().filter(|(other, _)| other == name).map(|(_, note)| note).collect()
    }
}

impl RecordedMessage {
    /// Returns the `seq` of the header: the number of the telegram from which the hub computed the sample.
    pub(crate) fn seq(&self) -> u64 {
        self.u64_at(0)
    }

    /// Returns the `topic_seq` of the header.
    pub(crate) fn topic_seq(&self) -> u64 {
        self.u64_at(8)
    }

    /// Returns the wall-clock stamp of the header, in nanoseconds since 1970.
    pub(crate) fn wall_ns(&self) -> u64 {
        self.u64_at(32)
    }

    /// Returns the `boot` ID of the hub's run.
    pub(crate) fn boot(&self) -> u64 {
        self.u64_at(40)
    }

    /// Returns the payload, which follows the 64 bytes of the header.
    pub(crate) fn payload(&self) -> &[u8] {
        &self.data[64..]
    }

    fn u64_at(&self, at: usize) -> u64 {
        u64::from_le_bytes(self.data[at..at + 8].try_into().expect("eight bytes"))
    }
}

/// Returns the `topic_seq` of each of `messages`. All of them must belong to one topic.
///
/// # Panics
///
/// Panics if a number is missing between two messages.
pub(crate) fn contiguous_topic_seqs(messages: &[&RecordedMessage]) -> Vec<u64> {
    let numbers: Vec<u64> = messages.iter().map(|message| message.topic_seq()).collect();
    for pair in numbers.windows(2) {
        assert_eq!(pair[1], pair[0] + 1, "the topic_seq of the recording has a gap");
    }
    numbers
}

fn file_bytes(path: &Path) -> Vec<u8> {
    fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}
