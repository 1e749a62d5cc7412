//! The golden recording of version 2, which the test builds from values. Do not change this test: a different format
//! needs a new version. `docs/recording.md` explains the format.
#![cfg(feature = "mcap")]

use std::collections::BTreeMap;

use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::{Writer, split_message};
use scanhub_schema::{Flags, Header, Topic, Zones};

fn header(seq: u64, topic_seq: u64) -> Header {
    let at = 5_000_000_000 + seq * 26_666_667;
    Header {
        seq,
        topic_seq,
        stamp_first_ns: at,
        stamp_last_ns: at + 14_640_000,
        wall_ns: 1_700_000_000_000_000_000 + at,
        boot: 0x1122_3344_5566_7788,
        sensor: 1,
        flags: Flags::SIMULATED,
        period_us: 26_667,
        hub_pid: 4711,
        ..Header::default()
    }
}

/// Reply to a request to stop the stream (Telegram listing 7.11), with its CRC.
const TELEGRAM_BYTES: [u8; 9] = [0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10, 0x16, 0x0A];

fn recording() -> Vec<u8> {
    let facts = BTreeMap::from([("domain".to_owned(), "scanhub".to_owned())]);
    let mut writer = Writer::begin(Vec::new(), "", facts).unwrap();
    let mut room = [0; 256];
    let len = Zones::unknown().pack(&mut room).unwrap();
    writer.write_sample("rear", Topic::Telegram, &header(40, 40), &TELEGRAM_BYTES).unwrap();
    writer.write_sample("rear", Topic::Zones, &header(40, 7), &room[..len]).unwrap();
    writer.close_chunk().unwrap();
    writer.write_sample("rear", Topic::Telegram, &header(43, 43), &TELEGRAM_BYTES).unwrap();
    writer.finish().unwrap()
}

#[test]
fn recording_matches_the_golden_file() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/vectors/recording/v2.mcap");
    if std::env::var_os("SCANHUB_WRITE").is_some() {
        std::fs::write(path, recording()).unwrap();
    }
    let golden = std::fs::read(path).unwrap_or_else(|error| panic!("{path}: {error}"));
    assert!(recording() == golden, "another form is another version");
}

#[test]
fn recording_is_readable_by_other_mcap_readers() {
    let recording = recording();
    let messages: Vec<_> = mcap::MessageStream::new(&recording).unwrap().map(Result::unwrap).collect();
    let messages_read: Vec<_> = messages.iter().map(|m| (m.channel.topic.as_str(), m.sequence)).collect();
    assert_eq!(messages_read, [("rear/telegram", 40), ("rear/zones", 7), ("rear/telegram", 43)]);
    assert_eq!(messages[0].data[..64], *bytemuck::bytes_of(&header(40, 40)));
    assert_eq!(messages[0].data[64..], TELEGRAM_BYTES);
    assert_eq!(split_message(&messages[0].data), Some((header(40, 40), &TELEGRAM_BYTES[..])));
    assert_eq!(split_message(&messages[0].data[..63]), None);
    let schema = messages[1].channel.schema.as_ref().unwrap();
    assert_eq!((schema.name.as_str(), schema.encoding.as_str()), ("scanhub.Zones.v2", "scanhub.v2"));
}

/// A closed chunk can be read even if nothing follows it, for example because the process was killed.
#[test]
fn closed_chunk_outlives_its_writer() {
    struct FullDisk<'a>(&'a mut Vec<u8>);
    impl std::io::Write for FullDisk<'_> {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.extend_from_slice(bytes);
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
    let mut disk = Vec::new();
    let mut writer = Writer::begin(FullDisk(&mut disk), "", BTreeMap::new()).unwrap();
    writer.write_sample("rear", Topic::Telegram, &header(40, 40), &TELEGRAM_BYTES).unwrap();
    writer.close_chunk().unwrap();
    writer.write_sample("rear", Topic::Telegram, &header(41, 41), &TELEGRAM_BYTES).unwrap();
    std::mem::forget(writer);
    let found = mcap::MessageStream::new_with_options(&disk, mcap::read::Options::IgnoreEndMagic.into())
        .unwrap()
        .map_while(Result::ok)
        .count();
    assert_eq!(found, 1);
}
