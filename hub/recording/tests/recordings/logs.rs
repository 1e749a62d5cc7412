//! Tests of conversions of CARMEN logs. Every range and every code stays the same in a conversion to another format and
//! back, or the log is refused.

use std::fs;
use std::io::Read;
use std::path::Path;

use tempfile::TempDir;

use crate::folder::{convert_file, file};
use crate::real;
use scanhub_drivers::lms::measured;
use scanhub_drivers::lms::reply;
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_recording::{Encoding, Frame, Recording, UnreadLines};

#[test]
fn log_round_trips_through_mcap() {
    let folder = TempDir::new().unwrap();
    let log: String = (0..5)
        .map(|scan| {
            let ranges: Vec<_> =
                (0..181).map(|i| format!("{:.3}", 0.5 + 0.011 * f64::from(i * scan))).collect();
            format!("FLASER 181 {} 1 2 3 4 5 6 12{scan}.25 host 1\n", ranges.join(" "))
        })
        .collect();
    let log = file(&folder, "a.log", log.as_bytes());
    let (mcap, again) = (folder.path().join("a.mcap"), folder.path().join("b.log"));
    convert_file(&log, &mcap, None).unwrap();
    // Millimeters up to 8.4 m do not fit into 13 bits.
    let contents = Recording::open(&mcap).unwrap().contents().clone();
    assert_eq!(
        (contents.unit, contents.mode, &contents.sensors[0][..]),
        (Some(Unit::Mm), Some(Mode(4)), "front")
    );
    convert_file(&mcap, &again, None).unwrap();
    assert_eq!(sweeps(&again), sweeps(&log));
}

/// Returns the ranges of each scan in the log, in micrometers, and the time of the scan in microseconds.
fn sweeps(log: &Path) -> Vec<(Vec<i64>, i64)> {
    let mut text = String::new();
    flate2::read::MultiGzDecoder::new(fs::File::open(log).unwrap()).read_to_string(&mut text).unwrap_or_else(
        |_| {
            text = fs::read_to_string(log).unwrap();
            0
        },
    );
    let micros = |field: &str| (field.parse::<f64>().unwrap() * 1e6).round() as i64;
    let sweep = |line: &str| {
        let fields: Vec<&str> = line.split(' ').filter(|field| !field.is_empty()).collect();
        // In other kinds of lines, seven numbers of the sensor precede the ranges.
        let at = if fields[0] == "FLASER" { 1 } else { 8 };
        let count: usize = fields[at].parse().unwrap();
        (
            fields[at + 1..at + 1 + count].iter().map(|field| micros(field)).collect(),
            micros(fields[fields.len() - 3]),
        )
    };
    text.lines().filter(|line| line.contains("LASER") && !line.starts_with('#')).map(sweep).collect()
}

/// Converts `log` to MCAP and back, to a stream and back, and to a stream by way of MCAP. Asserts that ranges and codes
/// stay the same, and the times as well if the format has times.
fn assert_round_trips(folder: &TempDir, name: &str, log: &Path) {
    let path = |ending: &str| folder.path().join(format!("{name}{ending}"));
    let (mcap, stream, both) = (path(".mcap"), path(".bin.gz"), path("-mcap.bin"));
    convert_file(log, &mcap, None).unwrap();
    convert_file(log, &stream, None).unwrap();
    convert_file(&mcap, &both, None).unwrap();
    let original = sweeps(log);
    let own = Recording::open(log).unwrap();
    for (file_name, has_times) in [(&mcap, true), (&stream, false), (&both, false)] {
        let again = path(&format!("-{}.log.gz", file_name.extension().unwrap().display()));
        let _ = fs::remove_file(&again);
        convert_file(file_name, &again, None).unwrap();
        let back = sweeps(&again);
        assert_eq!(back.len(), original.len(), "{}", file_name.display());
        for (number, (one, other)) in original.iter().zip(&back).enumerate() {
            assert!(one.0 == other.0, "{}, scan {number}", file_name.display());
            assert!(!has_times || one.1 == 0 || one.1 == other.1, "{}, scan {number}", file_name.display());
        }
        // The intermediate file has the same value words and codes as the log itself.
        let recording = Recording::open(file_name).unwrap();
        assert_eq!(recording.encoding(), own.encoding());
        let words = |recording: &Recording| -> Vec<_> {
            let frames = recording.telegrams(recording.encoding().unwrap()).unwrap();
            frames.filter(Frame::is_scan).map(|frame| frame.telegram).collect()
        };
        assert!(words(&recording) == words(&own) && words(&own) == words(&Recording::open(&again).unwrap()));
    }
}

/// Returns a log of three scans of `count` beams, two seconds apart. The beams have `ranges` in turn.
fn log(count: usize, ranges: &[&str]) -> String {
    let line = |scan: usize| {
        let ranges: Vec<_> = (0..count).map(|beam| ranges[(beam + scan) % ranges.len()]).collect();
        format!("FLASER {count} {} 1 2 3 4 5 6 {}.25 host 1\n", ranges.join(" "), 1000 + 2 * scan)
    };
    (0..3).map(line).collect()
}

#[test]
fn ranges_and_codes_of_every_log_form_round_trip() {
    let folder = TempDir::new().unwrap();
    for (name, count, ranges) in [
        ("cm-far", 180, &["20.00", "81.91", "81.90", "81.87", "81.83", "81.82", "0.00"][..]),
        ("cm-near", 361, &["1.23", "7.00"]),
        ("cm-50", 360, &["50", "49.91", "1"]),
        ("mm-13", 181, &["1.234", "8.191", "8.183", "8.182"]),
        ("mm-14", 401, &["1.234", "9.001", "16.383", "16.379"]),
        ("mm-15", 181, &["1.234", "32.767", "32.759", "32.763", "20.001"]),
    ] {
        let log = file(&folder, &format!("{name}.log"), log(count, ranges).as_bytes());
        assert_round_trips(&folder, name, &log);
    }
    let sensor = "0 -1.570796 3.141593 0.017453 81.91 0.01 0";
    let both: String = (0..3)
        .map(|scan| {
            let ranges = vec![format!("1{scan}.05"); 180].join(" ");
            format!(
                "RAWLASER1 {sensor} 180 {ranges} 0 {scan}.5 host 1\nODOM 1\n\
                     ROBOTLASER1 {sensor} 180 {ranges} 0 1 2 3 1 2 3 0 0 0 0 0 {scan}.7 host 1\n"
            )
        })
        .collect();
    let recording = Recording::open(file(&folder, "both.log", both.as_bytes())).unwrap();
    assert_eq!(recording.contents().scans, 3, "each scan stands there twice");
    for word in ["RAWLASER1", "ROBOTLASER1"] {
        let lines: String =
            both.lines().filter(|line| line.starts_with(word)).map(|line| format!("{line}\n")).collect();
        assert_round_trips(&folder, word, &file(&folder, &format!("{word}.log"), lines.as_bytes()));
    }
}

#[test]
fn log_times_round_trip_to_the_microsecond() {
    let folder = TempDir::new().unwrap();
    let mut random = fastrand::Rng::with_seed(40);
    let mut at_us = 1_071_078_720_000_000_u64;
    let log: String = (0..910)
        .map(|_| {
            at_us += random.u64(1..200_000);
            let time = format!("{}.{:06}", at_us / 1_000_000, at_us % 1_000_000);
            format!("FLASER 181{} 0 0 0 0 0 0 {time} host 1\n", " 1.25".repeat(181))
        })
        .collect();
    let (mcap, again) = (folder.path().join("a.mcap"), folder.path().join("b.log"));
    convert_file(&file(&folder, "a.log", log.as_bytes()), &mcap, None).unwrap();
    convert_file(&mcap, &again, None).unwrap();
    let again = fs::read_to_string(again).unwrap();
    let times = |log: &str| -> Vec<String> {
        let scans = log.lines().filter(|line| line.starts_with("FLASER"));
        scans.map(|line| line.split(' ').nth_back(2).unwrap().to_owned()).collect()
    };
    assert_eq!(times(&again).len(), 910);
    assert_eq!(times(&again), times(&log));
    let first = again.lines().find(|line| line.starts_with("FLASER")).unwrap();
    assert!(first.ends_with(" scanhub 0.000000"), "{first}");
}

#[test]
fn counts_the_data_of_a_log_that_no_telegram_holds() {
    let folder = TempDir::new().unwrap();
    let ranges = " 1.25".repeat(181);
    let sensor = "0 -1.570796 3.141593 0.017453 81.91 0.01 0";
    let flaser = |poses: &str, at: u32| format!("FLASER 181{ranges} {poses} {at}.5 host 1\n");
    let log = [
        "# message formats defined: PARAM ODOM FLASER\n\nPARAM robot_length 1 host 0\n".to_owned(),
        "ODOM 1 2 3 0.1 0 0 9.5 host 1\nODOM 1 2 3 0.1 0 0 9.6 host 1\n".to_owned(),
        flaser("1 2 3 1 2 3", 10),
        flaser("0 0 0 0 0 0.5", 11),
        flaser("0 0 0 0.0 0 0", 12),
        format!("ROBOTLASER1 {sensor} 181{ranges} 0 1 2 3 1 2 3 0 0 0 0 0 12.7 host 1\n"),
    ];
    let log = file(&folder, "a.log", log.concat().as_bytes());
    let unread = UnreadLines { poses: 2, odometry: 2, remissions: 0, lines: 2 };
    assert_eq!(unread.to_string(), "2 poses, 2 lines of odometry, 2 other lines");
    for output in ["a.mcap", "a.bin", "b.log", "a.csv"] {
        let result = convert_file(&log, &folder.path().join(output), None).unwrap();
        assert_eq!((result.scans, result.unread), (3, unread), "{output}");
    }
    assert_eq!(
        Recording::open(folder.path().join("a.mcap")).unwrap().contents().unread,
        UnreadLines::default()
    );
    let lines: String = (0..2)
        .map(|at| format!("RAWLASER1 {sensor} 181{ranges} 181{} 1{at}.5 host 1\n", " 9".repeat(181)))
        .collect();
    let result =
        convert_file(&file(&folder, "raw.log", lines.as_bytes()), &folder.path().join("raw.mcap"), None);
    assert_eq!(result.unwrap().unread, UnreadLines { remissions: 2, ..UnreadLines::default() });
}

#[test]
fn reply_with_the_encoding_is_not_counted_as_dropped() {
    let folder = TempDir::new().unwrap();
    let log = file(&folder, "a.log", log(181, &["1.234", "9.001"]).as_bytes());
    let path = |name: &str| folder.path().join(name);
    for file_name in ["a.mcap", "a.bin"] {
        let result = convert_file(&log, &path(file_name), None).unwrap();
        assert_eq!((result.telegrams, result.scans, result.dropped), (3, 3, 0), "{file_name}");
        for output in ["log", "csv"] {
            let result =
                convert_file(&path(file_name), &path(&format!("{file_name}.{output}")), None).unwrap();
            assert_eq!((result.telegrams, result.scans, result.dropped), (3, 3, 0), "{file_name}, {output}");
        }
    }
    // In contrast, replies that a scanner sent count as dropped.
    let recorded = file(&folder, "hub.mcap", &crate::written::recording(20, 14).bytes);
    for output in ["hub.log", "hub.csv"] {
        let result = convert_file(&recorded, &path(output), Some("front")).unwrap();
        assert_eq!((result.telegrams, result.dropped), (18, 2), "{output}");
    }
}

#[test]
fn range_of_14_bits_survives_a_log_round_trip() {
    let folder = TempDir::new().unwrap();
    // The range is 8.185 m in 14 bits. In 13 bits, the value would be a code.
    let scan = measured::encode(0, Unit::Mm, &[8185; 181], 0x10);
    let configuration = reply::configuration_reply(0, Mode(4), Unit::Mm, 0x10);
    let stream = file(&folder, "a.bin", &[configuration.bytes(), scan.bytes()].concat());
    let log = folder.path().join("a.log");
    convert_file(&stream, &log, None).unwrap();
    let recording = Recording::open(&log).unwrap();
    assert_eq!(recording.encoding(), Some(Encoding { unit: Unit::Mm, mode: Mode(4) }));
    assert_round_trips(&folder, "b", &log);
}

#[test]
fn refuses_to_convert_unencodable_log_with_reason() {
    let folder = TempDir::new().unwrap();
    for (name, ranges, message) in [
        ("fine", &["1.23456", "2"][..], "ranges are finer"),
        ("far", &["1.234", "2", "81.91"], "ranges are finer"),
        ("farther", &["1.5", "1000.0"], "too long"),
    ] {
        let input = file(&folder, &format!("{name}.log"), log(361, ranges).as_bytes());
        for output in ["out.mcap", "out.bin", "out.log"] {
            let failure = convert_file(&input, &folder.path().join(output), None).unwrap_err();
            assert_eq!(failure.kind.exit_code(), 66);
            let all = format!("{failure} {}", failure.hint);
            assert!(all.contains("cannot become telegrams without loss"), "{name}: {all}");
            assert!(all.contains(message), "{name}: {all}");
        }
        // The log can be played anyway.
        let recording = Recording::open(&input).unwrap();
        assert_eq!(recording.telegrams(recording.encoding().unwrap()).unwrap().count(), 3);
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3);
}

#[test]
fn mcap_from_log_has_the_period_of_each_scan() {
    let folder = TempDir::new().unwrap();
    let log = file(&folder, "a.log", log(181, &["1.5"]).as_bytes());
    let mcap = folder.path().join("a.mcap");
    convert_file(&log, &mcap, None).unwrap();
    let recording = Recording::open(&mcap).unwrap();
    let frames: Vec<Frame> = recording.telegrams(recording.encoding().unwrap()).unwrap().collect();
    let periods: Vec<_> = frames.iter().map(|frame| frame.header.unwrap().period_us).collect();
    assert_eq!(periods[1..], [2_000_000, 2_000_000, 13_320]);
    assert!(
        frames
            .windows(2)
            .all(|pair| { pair[0].header.unwrap().stamp_last_ns <= pair[1].header.unwrap().stamp_first_ns })
    );
}

#[test]
fn logs_of_real_scanners_round_trip() {
    let Some(data) = real::recordings() else { return };
    let folder = TempDir::new().unwrap();
    for name in ["aces", "freiburg-079", "intel", "orebro"] {
        assert_round_trips(&folder, name, &data.join(format!("carmen/{name}-corrected.log.gz")));
        let (scans, own) = (sweeps(&data.join(format!("carmen/{name}-corrected.log.gz"))), {
            Recording::open(data.join(format!("carmen/{name}-corrected.log.gz"))).unwrap().encoding()
        });
        println!(
            "{name}: {} scans, {} ranges, {own:?}",
            scans.len(),
            scans.iter().map(|scan| scan.0.len()).sum::<usize>()
        );
    }
}
