//! Tests of recordings of the hub: the telegrams of each sensor are read back unchanged, with their headers.

use std::fs;

use crate::written::{SENSOR_NAMES, WrittenTelegram};
use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_recording::{Encoding, Form, Recording};
use tempfile::NamedTempFile;

const MM_ENCODING: Encoding = Encoding { unit: Unit::Mm, mode: Mode(1) };

/// Creates a temporary file with these bytes.
fn file(bytes: &[u8]) -> NamedTempFile {
    let file = NamedTempFile::new().unwrap();
    fs::write(&file, bytes).unwrap();
    file
}

/// Returns the telegrams of `sensor` in `recording`.
fn read(recording: &Recording, sensor: &'static str) -> Vec<WrittenTelegram> {
    let frames = recording.of(sensor).unwrap().telegrams(MM_ENCODING).unwrap();
    frames
        .map(|frame| {
            let header = frame.header.unwrap();
            assert_eq!(frame.wall_ns, Some(header.wall_ns));
            WrittenTelegram { sensor, header, telegram: frame.telegram }
        })
        .collect()
}

#[test]
fn mcap_file_has_telegrams_of_each_sensor() {
    let written = crate::written::recording(20, 1);
    let file = file(&written.bytes);
    let recording = Recording::open(file.path()).unwrap();
    let contents = recording.contents();
    assert_eq!((contents.form, contents.telegrams, contents.scans), (Form::Mcap, 40, 36));
    assert_eq!(contents.sensors, SENSOR_NAMES);
    let [first, .., last] = &written.telegrams[..] else { panic!("no telegrams") };
    assert_eq!(contents.span, Some((first.header.wall_ns, last.header.wall_ns)));
    assert!(contents.damage.is_none(), "{}", contents.damage);
    for sensor in SENSOR_NAMES {
        let of_sensor: Vec<_> = written.telegrams.iter().filter(|known| known.sensor == sensor).collect();
        assert!(read(&recording, sensor).iter().eq(of_sensor));
        let part = recording.of(sensor).unwrap();
        assert_eq!((part.contents().telegrams, part.contents().sensors.len()), (20, 1));
        let settings = (part.contents().variant, part.contents().unit, part.contents().mode);
        let full = Variant::of_beams(181);
        assert_eq!(settings, (full, Some(Unit::Mm), Some(Mode(4))));
    }
}

#[test]
fn several_sensors_require_a_choice() {
    let file = file(&crate::written::recording(4, 2).bytes);
    let recording = Recording::open(file.path()).unwrap();
    let refused =
        [(recording.telegrams(MM_ENCODING).err().unwrap(), 2), (recording.of("left").unwrap_err(), 3)];
    for (failure, code) in refused {
        assert_eq!(failure.kind.exit_code(), code);
        assert_eq!(failure.hint, "choose one: front, rear");
    }
}

/// A recorder that was killed leaves complete chunks.
#[test]
fn reads_a_recording_truncated_by_a_kill() {
    let written = crate::written::recording(20, 3);
    let file = file(&written.bytes[..written.bytes.len() / 2]);
    let recording = Recording::open(file.path()).unwrap();
    assert!(recording.contents().damage.is_truncated);
    let rear = read(&recording, "rear");
    assert!(rear.len() >= 8, "{}", rear.len());
    assert!(rear.iter().eq(written.telegrams.iter().filter(|known| known.sensor == "rear").take(rear.len())));
}

#[test]
fn file_of_bare_telegrams_is_a_stream() {
    let written = crate::written::recording(40, 3);
    // Other bytes may precede each telegram.
    let telegrams = |before: &[u8]| {
        written.telegrams.iter().flat_map(|known| [before, &known.telegram].concat()).collect::<Vec<u8>>()
    };
    for before in [&[][..], &[5; 95], &[0; 95]] {
        let file = file(&telegrams(before));
        let contents = Recording::open(file.path()).unwrap().contents().clone();
        assert_eq!((contents.form, contents.telegrams), (Form::Telegrams, 80));
    }
}
