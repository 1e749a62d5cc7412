//! Tests of recordings in the format of version 1. Their telegrams have the current format and are played and
//! converted. Their scans have another format and are not read.

use std::fs;
use std::path::Path;

use tempfile::TempDir;

use crate::folder::{convert_file, file};
use crate::written::{self, SENSOR_NAMES, WrittenRecording, WrittenTelegram};
use bytemuck::bytes_of;
use scanhub_drivers::lms::measured;
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_recording::convert::{ConvertOptions, convert};
use scanhub_recording::{Encoding, Form, Recording};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::{ENCODING, ENCODING_V1, ForeignChannel, Writer};
use scanhub_schema::{Header, Kind, Scan, ScanHead, Topic};

const MM_ENCODING: Encoding = Encoding { unit: Unit::Mm, mode: Mode(1) };

/// Returns the telegrams of all sensors in the file at `path`, with their headers.
fn telegrams(path: &Path) -> Vec<WrittenTelegram> {
    let recording = Recording::open(path).unwrap();
    let of_sensor = |sensor: &'static str| {
        let frames: Vec<_> = recording.of(sensor).unwrap().telegrams(MM_ENCODING).unwrap().collect();
        frames.into_iter().map(move |frame| WrittenTelegram {
            sensor,
            header: frame.header.unwrap(),
            telegram: frame.telegram,
        })
    };
    SENSOR_NAMES.into_iter().flat_map(of_sensor).collect()
}

fn sorted_by_sensor(written: &WrittenRecording) -> Vec<WrittenTelegram> {
    let of_sensor = |sensor| written.telegrams.iter().filter(move |known| known.sensor == sensor).cloned();
    SENSOR_NAMES.into_iter().flat_map(of_sensor).collect()
}

/// Returns three parts of each message: the topic of its channel, the encoding of its channel, and its data.
fn messages(bytes: &[u8]) -> Vec<(String, String, Vec<u8>)> {
    let all = mcap::MessageStream::new(bytes).unwrap().map(Result::unwrap);
    let message =
        |m: mcap::Message<'_>| (m.channel.topic.clone(), m.channel.message_encoding.clone(), m.data.to_vec());
    all.map(message).collect()
}

#[test]
fn version_1_file_has_all_telegrams() {
    let folder = TempDir::new().unwrap();
    let (old, new) = (written::recording_of_version_1(20, 21, &Topic::ALL), written::recording(20, 21));
    assert_eq!(old.telegrams, new.telegrams, "both say the same");
    let (file, copy) = (file(&folder, "old.mcap", &old.bytes), folder.path().join("copy.mcap"));
    let contents = Recording::open(&file).unwrap().contents().clone();
    assert_eq!((contents.form, contents.telegrams, contents.scans), (Form::Mcap, 40, 36));
    assert_eq!((&contents.sensors[..], contents.mode), (&SENSOR_NAMES.map(String::from)[..], Some(Mode(4))));
    assert!(contents.damage.is_none(), "{}", contents.damage);
    assert_eq!(telegrams(&file), sorted_by_sensor(&old));
    // A copy has all messages unchanged, and its telegrams can be read.
    convert_file(&file, &copy, None).unwrap();
    let (kept, all) = (messages(&fs::read(&copy).unwrap()), messages(&old.bytes));
    assert_eq!(kept.len(), all.len());
    for ((topic, encoding, data), (its_topic, its_encoding, its_data)) in kept.iter().zip(&all) {
        assert!((topic, data) == (its_topic, its_data), "{topic}");
        let is_telegram = topic.ends_with("/telegram");
        assert_eq!(encoding, if is_telegram { ENCODING } else { its_encoding }, "{topic}");
        assert!(topic == "/imu" || its_encoding == ENCODING_V1);
    }
    assert_eq!(telegrams(&copy), sorted_by_sensor(&old));
}

#[test]
fn version_1_scans_are_derived_from_telegrams() {
    let folder = TempDir::new().unwrap();
    let payload = written::version_1_scan();
    assert!(Scan::room(&payload).is_some(), "nothing but the encoding says that it is none of today");
    let old = file(&folder, "old.mcap", &written::recording_of_version_1(20, 22, &Topic::ALL).bytes);
    let new = file(&folder, "new.mcap", &written::recording(20, 22).bytes);
    let rows = |file: &Path, name: &str| {
        let out = folder.path().join(name);
        assert_eq!(convert_file(file, &out, Some("rear")).unwrap().scans, 18);
        fs::read_to_string(out).unwrap()
    };
    let expected = rows(&new, "new.csv");
    assert_eq!(expected.lines().next().unwrap().matches("range_").count(), 181);
    assert!(rows(&old, "old.csv") == expected);
    let ros = |file: &Path, name: &str| {
        let output = folder.path().join(name);
        let options =
            ConvertOptions { input: file.to_owned(), output, ros2: true, ..ConvertOptions::default() };
        assert_eq!(convert(&options, &Default::default(), |_, _| {}).unwrap().scans, 36);
        messages(&fs::read(&options.output).unwrap())
    };
    let (from_old, from_new) = (ros(&old, "old-ros.mcap"), ros(&new, "new-ros.mcap"));
    assert!(from_old.len() > 36 && from_old == from_new);
}

#[test]
fn version_1_file_without_telegrams_is_refused() {
    let folder = TempDir::new().unwrap();
    let old = file(
        &folder,
        "old.mcap",
        &written::recording_of_version_1(4, 23, &[Topic::Scan, Topic::Status]).bytes,
    );
    let failure = convert_file(&old, &folder.path().join("out.csv"), Some("front")).unwrap_err();
    assert_eq!(failure.kind, Kind::Input);
    assert!(failure.message.starts_with("there is no scan in "), "{failure}");
}

/// The values of the telegrams are ambiguous without the measuring mode. In a recording of the current version, the
/// published scan is used instead. A scan of version 1 is not read, so the conversion is refused.
#[test]
fn version_1_scan_does_not_define_the_measuring_mode() {
    let folder = TempDir::new().unwrap();
    let telegram = measured::encode(0, Unit::Mm, &[0x3FFF; 181], 0x10).bytes().to_vec();
    let made = |encoding, scan: &[u8]| {
        let mut writer = Writer::begin(Vec::new(), "", Default::default()).unwrap();
        for (topic, payload) in [("front/telegram", &telegram[..]), ("front/scan", scan)] {
            let channel = ForeignChannel { topic, encoding, schema: ("any", "", encoding), metadata: &[] };
            let channel = writer.add_channel(&channel).unwrap();
            let message = [bytes_of(&Header::default()), payload].concat();
            writer.write_message(channel, 0, 0, &message).unwrap();
        }
        file(&folder, "in.mcap", &writer.finish().unwrap())
    };
    let converted = |file: &Path, name: &str| convert_file(file, &folder.path().join(name), Some("front"));
    let today = Scan::of(ScanHead::lms(181, -90_000, 1000, 1, 13), &[700; 181]);
    assert_eq!(converted(&made(ENCODING, today.bytes()), "today.csv").unwrap().scans, 1);
    let failure = converted(&made(ENCODING_V1, &written::version_1_scan()), "old.csv").unwrap_err();
    assert_eq!(failure.kind, Kind::Configuration);
    assert!(failure.message.ends_with("does not contain the measuring mode of front"), "{failure}");
}
