//! Tests of recordings as files: their format is detected by their bytes, and their data is read back unchanged.

use std::fs;
use std::io::{Read, Write};

use crate::real;
use flate2::Compression;
use flate2::write::GzEncoder;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::measured::{self, MeasuredValues};
use scanhub_drivers::lms::reply;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_recording::{Encoding, Form, Recording};
use scanhub_schema::Family;
use tempfile::NamedTempFile;

const MM_ENCODING: Encoding = Encoding { unit: Unit::Mm, mode: Mode(1) };

/// Creates a temporary file whose name ends with `name`.
fn temporary(name: &str, bytes: &[u8]) -> NamedTempFile {
    let file = tempfile::Builder::new().suffix(name).tempfile().unwrap();
    fs::write(&file, bytes).unwrap();
    file
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

fn scan(first: u16) -> Vec<u8> {
    let words: Vec<u16> = (0..361).map(|i| (first + i) & 0x1FFF).collect();
    measured::encode(0, Unit::Cm, &words, 0x10).bytes().to_vec()
}

#[test]
fn stream_file_has_exact_telegrams_and_settings() {
    let telegrams =
        [scan(700), reply::configuration_reply(0, Mode(4), Unit::Cm, 0x11).bytes().to_vec(), scan(1700)];
    let mut bytes = b"\x06\x02\x80noise".to_vec();
    bytes.extend_from_slice(&telegrams.concat());
    // At the very end, a scan broke off, and a reply follows.
    bytes.extend_from_slice(&scan(5)[..40]);
    let last = reply::mode_reply(0, true, 0x10);
    bytes.extend_from_slice(&[&[0x06], last.bytes()].concat());
    for (name, stored) in [("stream.bin", bytes.clone()), ("stream.bin.gz", gzip(&bytes))] {
        let file = temporary(name, &stored);
        let recording = Recording::open(file.path()).unwrap();
        let contents = recording.contents();
        assert_eq!((contents.form, contents.telegrams, contents.scans), (Form::Telegrams, 4, 2));
        assert_eq!(contents.variant, Some(Variant::HALF));
        assert_eq!((contents.unit, contents.mode), (Some(Unit::Cm), Some(Mode(4))));
        let read: Vec<_> = recording.telegrams(MM_ENCODING).unwrap().map(|frame| frame.telegram).collect();
        assert_eq!(read[..3], telegrams);
        assert_eq!(read[3], last.bytes());
        let mut unpacked = Vec::new();
        recording.bytes().unwrap().read_to_end(&mut unpacked).unwrap();
        assert_eq!(unpacked, bytes);
    }
}

#[test]
fn log_scans_are_read_as_telegrams() {
    let mut log = String::from("# message formats defined: PARAM FLASER\nODOM 0 0 0 0 0 0 1.5 host 1.5\n");
    for count in [360, 361] {
        log += &format!("FLASER {count} {} 0 0 0 0 0 0 12.25 host 1\n", vec!["1.234"; count].join(" "));
    }
    // The recording broke off in this line.
    log += "FLASER 361 1.0 1.0";
    let file = temporary("log.gz", &gzip(log.as_bytes()));
    let recording = Recording::open(file.path()).unwrap();
    assert_eq!((recording.contents().form, recording.contents().scans), (Form::Carmen, 2));
    assert_eq!(recording.contents().variant, Some(Variant::HALF));
    assert_eq!(recording.encoding(), Some(Encoding { unit: Unit::Mm, mode: Mode(0) }));
    let frames: Vec<_> = recording.telegrams(MM_ENCODING).unwrap().collect();
    let last = |i: usize| {
        let telegram = Telegram::check(&frames[i].telegram).unwrap();
        let words: Vec<u16> = MeasuredValues::decode(telegram).unwrap().words().collect();
        (words.len(), words[0], words[360])
    };
    assert_eq!((last(0), last(1)), ((361, 1234, 8184), (361, 1234, 1234)));
    assert_eq!((frames[0].wall_ns, frames[0].header), (Some(12_250_000_000), None));
    let contents = recording.contents();
    assert_eq!(contents.span, Some((12_250_000_000, 12_250_000_000)));
    assert!(contents.sensors.is_empty() && contents.damage.is_none());
    let refused = recording.of("front").unwrap_err();
    assert!(refused.message.contains("does not name its sensor"), "{refused}");
}

#[test]
fn non_recording_is_refused_with_location_and_remedy() {
    let missing = Recording::open("/nonexistent/a.bin").unwrap_err();
    assert_eq!(missing.kind.exit_code(), 66);
    assert!(missing.message.contains("/nonexistent/a.bin") && !missing.hint.is_empty(), "{missing}");
    for (name, bytes, message) in [
        ("empty", Vec::new(), "is empty"),
        ("noise", vec![0x42; 9000], "no telegram in it"),
        ("program.py", b"#!/usr/bin/env python3\nprint('\x02\x80')\n".to_vec(), "no telegram in it"),
        ("request", Request::Stop.encode(0).bytes().to_vec(), "no telegram in it"),
        ("poses.log", b"PARAM a b\nODOM 0 0 0 0 0 0 1.5 host 1.5\n".to_vec(), "without a scan"),
        ("wrong.log", b"PARAM a b\nFLASER 12 1 2\n".to_vec(), "wrong.log:2: 12 beams"),
        #[cfg(not(feature = "mcap"))]
        ("a.mcap", b"\x89MCAP0\r\nmore".to_vec(), "which this build does not read"),
        ("cut.gz", gzip(&scan(7))[..40].to_vec(), "cannot read"),
    ] {
        let file = temporary(name, &bytes);
        let failure = Recording::open(file.path()).unwrap_err();
        assert!(failure.message.contains(message), "{failure}");
        // A stream may contain only noise if its family is named.
        let line = |family| Recording::open_stream(file.path(), family);
        let is_noise = message == "no telegram in it";
        let known = line(Some(Family::Lms)).ok();
        assert_eq!(known.map(|line| line.contents().telegrams), is_noise.then_some(0));
        let unknown = line(None).unwrap_err();
        assert!(!is_noise || unknown.kind.exit_code() == 66 && unknown.hint.contains("family="), "{unknown}");
    }
}

#[test]
fn mostly_unrecognized_stream_needs_the_family() {
    let telegrams: Vec<u8> = (0..8).flat_map(scan).collect();
    let noise = vec![0x42; telegrams.len() + 1];
    let few = temporary("few.bin", &[&telegrams[..], &noise].concat());
    let failure = Recording::open(few.path()).unwrap_err();
    assert_eq!(failure.kind.exit_code(), 66);
    assert!(failure.message.contains("(lms 49 %, ") && failure.hint.contains("family="), "{failure}");
    let named = Recording::open_as(few.path(), Some(Family::Lms)).unwrap();
    assert_eq!((named.contents().telegrams, named.contents().damage.bytes), (8, noise.len() as u64));
    // If a wrong family is named, the right one is recognized.
    let enough = temporary("enough.bin", &[&telegrams[..], &noise[1..]].concat());
    for family in [None, Some(Family::Lms), Some(Family::Ld)] {
        let recording = Recording::open_as(enough.path(), family).unwrap();
        assert_eq!((recording.family(), recording.contents().telegrams), (Some(Family::Lms), 8));
    }
}

#[test]
fn reads_the_intact_start_of_a_truncated_gzip_file() {
    // There are enough telegrams that some remain after the truncation, and they differ enough that they do not
    // compress to almost nothing.
    let telegrams: Vec<Vec<u8>> = (0..400).map(scan).collect();
    let packed = gzip(&telegrams.concat());
    let file = temporary("cut.bin.gz", &packed[..packed.len() * 2 / 3]);
    let recording = Recording::open(file.path()).unwrap();
    let contents = recording.contents();
    assert!(contents.damage.is_truncated && (1..400).contains(&contents.telegrams), "{contents:?}");
    let read: Vec<_> = recording.telegrams(MM_ENCODING).unwrap().map(|frame| frame.telegram).collect();
    assert_eq!(read[..], telegrams[..contents.telegrams as usize]);
}

#[test]
fn intact_lines_of_a_damaged_log_are_read() {
    let line = |at: u32, range: &str| {
        format!("FLASER 181 {} 0 0 0 0 0 0 {at} host {at}\n", vec![range; 181].join(" "))
    };
    let log: String = (1..4000).map(|at| line(at, if at == 7 { "1.\0" } else { "1.5" })).collect();
    let file = temporary("harmed.log", log.as_bytes());
    let recording = Recording::open(file.path()).unwrap();
    let damage = recording.contents().damage;
    assert_eq!((recording.contents().scans, damage.telegrams, damage.is_damaged), (3998, 1, true));
    let walls: Vec<_> = recording
        .telegrams(MM_ENCODING)
        .unwrap()
        .map(|frame| frame.wall_ns.unwrap() / 1_000_000_000)
        .collect();
    assert!(walls.iter().copied().eq((1..4000).filter(|at| *at != 7)));
    let packed = gzip(log.as_bytes());
    let cut = temporary("cut.log.gz", &packed[..packed.len() * 2 / 3]);
    let recording = Recording::open(cut.path()).unwrap();
    let contents = recording.contents();
    assert!(contents.damage.is_truncated && contents.scans > 0, "{contents:?}");
    assert_eq!(recording.telegrams(MM_ENCODING).unwrap().count() as u64, contents.telegrams);
}

#[test]
fn reads_captures_and_logs_of_real_scanners() {
    let Some(data) = real::recordings() else { return };
    let capture = Recording::open(data.join("captures/lms200_38400.bin")).unwrap();
    assert_eq!((capture.contents().telegrams, capture.contents().scans), (427, 354));
    assert_eq!((capture.contents().unit, capture.contents().mode), (Some(Unit::Mm), Some(Mode(4))));
    let bytes: Vec<u8> = capture.telegrams(MM_ENCODING).unwrap().flat_map(|frame| frame.telegram).collect();
    assert_eq!(bytes, fs::read(data.join("captures/lms200_38400.bin")).unwrap());
    for (name, scans, beams) in
        [("intel", 910, 181), ("freiburg-079", 4791, 361), ("aces", 440, 181), ("orebro", 237, 181)]
    {
        let log = Recording::open(data.join(format!("carmen/{name}-corrected.log.gz"))).unwrap();
        assert_eq!((log.contents().form, log.contents().scans), (Form::Carmen, scans), "{name}");
        assert_eq!(log.contents().variant.map(Variant::beams), Some(beams), "{name}");
    }
}
