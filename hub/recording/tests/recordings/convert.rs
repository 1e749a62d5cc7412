//! Tests of conversions: data that a format can hold stays the same, a damaged file becomes intact, and a failed
//! conversion leaves no file.

use std::fs;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use tempfile::TempDir;

use crate::folder::{convert_file, file};
use crate::real;
use scanhub_drivers::lms::measured;
use scanhub_drivers::lms::reply;
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_recording::convert::{ConversionResult, ConvertOptions, Target, convert};
use scanhub_recording::{Encoding, Form, Frame, Recording};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::Writer;
use scanhub_schema::{Family, Flags, Header, Mark, Marks, Topic};

const CM_ENCODING: Encoding = Encoding { unit: Unit::Cm, mode: Mode(0) };

/// Returns the names of all files in `folder`.
fn names(folder: &TempDir) -> Vec<String> {
    let mut names: Vec<_> = fs::read_dir(folder.path())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

fn frames(path: &Path, encoding: Encoding) -> Vec<Frame> {
    Recording::open(path).unwrap().telegrams(encoding).unwrap().collect()
}

fn telegrams(path: &Path) -> Vec<Vec<u8>> {
    frames(path, CM_ENCODING).into_iter().map(|frame| frame.telegram).collect()
}

/// Returns channel, sequence number, times and data of all messages. The `mcap` library reads them.
fn messages(bytes: &[u8]) -> Vec<(String, u32, u64, u64, Vec<u8>)> {
    let all = mcap::MessageStream::new(bytes).unwrap().map(Result::unwrap);
    all.map(|m| (m.channel.topic.clone(), m.sequence, m.log_time, m.publish_time, m.data.to_vec())).collect()
}

#[test]
fn mcap_file_keeps_all_messages_of_all_channels() {
    let folder = TempDir::new().unwrap();
    let written = crate::written::recording(20, 11);
    let (whole, copy) = (file(&folder, "whole.mcap", &written.bytes), folder.path().join("copy.mcap"));
    let result = convert_file(&whole, &copy, None).unwrap();
    assert_eq!((result.telegrams, result.scans, result.dropped), (40, 36, 0));
    assert_eq!(result.telegrams, written.telegrams.len() as u64);
    assert!(result.damage.is_none(), "{}", result.damage);
    let bytes = fs::read(&copy).unwrap();
    assert!(messages(&bytes) == messages(&written.bytes));
    let metadata_count = |bytes: &[u8]| mcap::Summary::read(bytes).unwrap().unwrap().metadata_indexes.len();
    assert_eq!(metadata_count(&bytes), 1);
    let rear = folder.path().join("rear.mcap");
    assert_eq!(convert_file(&whole, &rear, Some("rear")).unwrap().telegrams, 20);
    let only = messages(&fs::read(&rear).unwrap());
    assert!(only.len() == 200 && only.iter().all(|(topic, ..)| topic.starts_with("rear/")));
}

#[test]
fn conversion_repairs_cut_and_damaged_files() {
    let folder = TempDir::new().unwrap();
    let written = crate::written::recording(20, 12);
    let all = messages(&written.bytes);
    let mut harmed = written.bytes.clone();
    let middle = harmed.len() / 3;
    harmed[middle] ^= 0x10;
    let cut = &written.bytes[..written.bytes.len() * 2 / 3];
    for (name, bytes) in [("cut", cut), ("harmed", &harmed)] {
        let broken = file(&folder, &format!("{name}-in.mcap"), bytes);
        let whole = folder.path().join(format!("{name}-out.mcap"));
        let result = convert_file(&broken, &whole, None).unwrap();
        assert!(!result.damage.is_none(), "{name}");
        assert_eq!(result.damage.is_truncated, name == "cut");
        assert_eq!(result.forms.0, Form::Mcap);
        let recording = Recording::open(&whole).unwrap();
        assert_eq!(recording.contents().telegrams, result.telegrams);
        assert_eq!(result.telegrams, Recording::open(&broken).unwrap().contents().telegrams);
        let damage = recording.contents().damage;
        assert!(damage.bytes == 0 && !damage.is_truncated && !damage.is_damaged, "{damage}");
        let kept = messages(&fs::read(&whole).unwrap());
        assert!(kept.len() > all.len() / 2 && kept.iter().all(|message| all.contains(message)), "{name}");
        // Channels of other programs are copied too.
        assert!(kept.iter().any(|(topic, ..)| topic == "/imu"), "{name}");
    }
}

#[test]
fn stream_conversion_adds_times_and_keeps_telegrams() {
    let folder = TempDir::new().unwrap();
    let mut scans: Vec<Vec<u8>> =
        vec![reply::configuration_reply(0, Mode(4), Unit::Mm, 0x10).bytes().to_vec()];
    scans.extend((0..30).map(|first| {
        let words: Vec<u16> = (0..361).map(|i| 500 + first + i).collect();
        measured::encode(0, Unit::Mm, &words, 0x10).bytes().to_vec()
    }));
    let stream = file(&folder, "a.bin", &[b"noise", &scans.concat()[..]].concat());
    let (mcap, again, log) =
        (folder.path().join("a.mcap"), folder.path().join("b.bin.gz"), folder.path().join("a.log.gz"));
    let result = convert_file(&stream, &mcap, Some("left")).unwrap();
    assert_eq!((result.forms, result.telegrams), ((Form::Telegrams, Target::Recording(Form::Mcap)), 31));
    // The duration follows from the generated stamps. The reply at the beginning takes less time on the line than a
    // scan period.
    assert!(
        result.duration_ns.is_some_and(|ns| (29 * 26_640_000..30 * 26_640_000).contains(&ns)),
        "{result:?}"
    );
    assert_eq!(convert_file(&stream, &folder.path().join("c.bin"), None).unwrap().duration_ns, None);
    let recording = Recording::open(&mcap).unwrap();
    assert_eq!(
        (&recording.contents().sensors[..], recording.contents().mode),
        (&["left".into()][..], Some(Mode(4)))
    );
    assert_eq!(telegrams(&mcap), scans);
    let headers: Vec<_> = frames(&mcap, CM_ENCODING).into_iter().map(|frame| frame.header.unwrap()).collect();
    assert!(headers.iter().all(|header| header.flags == Flags::STAMP_ESTIMATED));
    assert!(headers.windows(2).all(|pair| pair[1].topic_seq == pair[0].topic_seq + 1));
    assert_eq!(headers[30].wall_ns - headers[1].wall_ns, 29 * 26_640_000);
    convert_file(&mcap, &again, None).unwrap();
    assert_eq!(telegrams(&again), scans);
    // The log contains the encoding, so the reply is not lost.
    let result = convert_file(&mcap, &log, None).unwrap();
    assert_eq!((result.telegrams, result.dropped), (30, 0));
    let read = frames(&log, Encoding { unit: Unit::Mm, mode: Mode(4) });
    assert!(read.iter().map(|frame| &frame.telegram).eq(&scans[1..]));
}

/// Converts a recording according to `options`, and returns the result and the lines of the output.
fn rows(options: &ConvertOptions) -> (ConversionResult, Vec<String>) {
    let result = convert(options, &AtomicBool::new(false), |_, _| {}).unwrap();
    let text = fs::read_to_string(&options.output).unwrap();
    (result, text.lines().map(str::to_owned).collect())
}

#[test]
fn rows_have_intensities_and_meters_on_request() {
    let folder = TempDir::new().unwrap();
    // The values have three reflector bits above the range.
    let words: Vec<u16> = (0..181).map(|i| (1234 + i) | ((i % 8) << 13)).collect();
    let scan = measured::encode(0, Unit::Mm, &words, 0x10);
    let configuration = reply::configuration_reply(0, Mode(1), Unit::Mm, 0x10);
    let input = file(&folder, "a.bin", &[configuration.bytes(), scan.bytes()].concat());
    let plain =
        ConvertOptions { input, output: folder.path().join("a.csv"), force: true, ..Default::default() };
    let (_, lines) = rows(&plain);
    let cells = |line: &str| line.split(',').map(str::to_owned).collect::<Vec<_>>();
    let [names, row] = [&lines[0], &lines[1]].map(|line| cells(line));
    assert_eq!(
        (names.len(), &names[5][..], &names[8][..], &names[188][..]),
        (189, "unit_um", "range_0", "range_180")
    );
    assert_eq!((&row[5][..], &row[8][..], &row[188][..]), ("1000", "1234", "1414"));
    let (_, lines) = rows(&ConvertOptions { meters: true, intensities: true, ..plain.clone() });
    let [names, row] = [&lines[0], &lines[1]].map(|line| cells(line));
    assert_eq!((names.len(), &names[189][..], &names[369][..]), (370, "intensity_0", "intensity_180"));
    assert_eq!((&row[5][..], &row[8][..], &row[188][..]), ("1000000", "1.234", "1.414"));
    assert_eq!((row.len(), &row[189..194]), (370, &["0", "1", "2", "3", "4"].map(String::from)[..]));

    let log = format!("FLASER 181{} 0 0 0 0 0 0 12.5 host 1\n", " 1.25".repeat(181));
    let input = file(&folder, "a.log", log.as_bytes());
    let none = ConvertOptions {
        input,
        output: folder.path().join("b.csv"),
        intensities: true,
        ..Default::default()
    };
    let failure = convert(&none, &AtomicBool::new(false), |_, _| {}).unwrap_err();
    assert_eq!(failure.kind.exit_code(), 66);
    assert!(
        failure.message.contains("has intensities") && !folder.path().join("b.csv").exists(),
        "{failure}"
    );
}

#[test]
fn raw_bytes_of_two_families_are_refused() {
    let folder = TempDir::new().unwrap();
    let recorded = |families: &[Family]| {
        let mut writer = Writer::begin(Vec::new(), "", Default::default()).unwrap();
        for (number, family) in (0..).zip(families) {
            let header =
                Header { seq: number, topic_seq: number, family: *family as u8, ..Header::default() };
            writer.write_sample("front", Topic::Telegram, &header, &[0x54; 47]).unwrap();
        }
        file(&folder, "front.mcap", &writer.finish().unwrap())
    };
    let (bytes, copy) = (folder.path().join("out.bin"), folder.path().join("out.mcap"));
    let one = recorded(&[Family::Ld, Family::Ld]);
    assert_eq!(convert_file(&one, &bytes, None).unwrap().telegrams, 2);
    fs::remove_file(&bytes).unwrap();
    // The scanner was replaced by one of another family while the hub searched for any family.
    let two = recorded(&[Family::Ld, Family::Rplidar, Family::Ld]);
    let failure = convert_file(&two, &bytes, Some("front")).unwrap_err();
    assert_eq!(failure.kind.exit_code(), 66);
    assert!(failure.message.contains("of families ld and rplidar"), "{failure}");
    assert!(failure.hint.contains("OUT.mcap") && !bytes.exists(), "{failure}");
    assert_eq!(convert_file(&two, &copy, None).unwrap().telegrams, 3);
}

#[test]
fn recorded_marks_become_rows() {
    let folder = TempDir::new().unwrap();
    let mut writer = Writer::begin(Vec::new(), "", Default::default()).unwrap();
    let mut marks = Marks { count: 2, ..Marks::default() };
    for (number, mark) in marks.mark_array[..2].iter_mut().enumerate() {
        *mark = Mark { angle_mdeg: 45_500, range_dmm: 20_000 + number as u32, peak: 3, ..Mark::default() };
    }
    for (round, sensor, marks) in
        [(0, "front", marks), (0, "rear", marks), (1, "front", Marks::default()), (2, "front", marks)]
    {
        let header = Header { seq: round, topic_seq: round, wall_ns: 1000 + round, ..Header::default() };
        let mut room = [0; 2048];
        let len = marks.pack(&mut room).unwrap();
        writer.write_sample(sensor, Topic::Marks, &header, &room[..len]).unwrap();
    }
    let input = file(&folder, "a.mcap", &writer.finish().unwrap());
    let output = folder.path().join("marks.csv");
    let topic = Some("front/marks".to_owned());
    let options = ConvertOptions { input: input.clone(), output, topic, force: true, ..Default::default() };
    let (result, lines) = rows(&options);
    assert_eq!((result.marks, result.scans, result.telegrams, result.dropped), (Some(4), 3, 0, 0));
    assert_eq!(
        lines,
        [
            "seq,topic_seq,stamp_ns,wall_ns,quality,marks,mark,angle_deg,range_mm,peak,weight,first_beam,last_beam,edge",
            "0,0,0,1000,clean,2,0,45.5,2000,3,0,0,0,0",
            "0,0,0,1000,clean,2,1,45.5,2000.1,3,0,0,0,0",
            "1,1,0,1001,clean,0,,,,,,,,",
            "2,2,0,1002,clean,2,0,45.5,2000,3,0,0,0,0",
            "2,2,0,1002,clean,2,1,45.5,2000.1,3,0,0,0,0",
        ]
    );
    let (_, lines) = rows(&ConvertOptions { meters: true, ..options.clone() });
    assert!(lines[0].contains(",range_m,") && lines[2].contains(",2.0001,"), "{lines:?}");

    let stream = file(&folder, "a.bin", measured::encode(0, Unit::Cm, &[7; 181], 0x10).bytes());
    let topic = |topic: &str| Some(topic.to_owned());
    for (changed, code, message) in [
        (ConvertOptions { topic: topic("side/marks"), ..options.clone() }, 3, "no sensor \"side\""),
        (ConvertOptions { topic: topic("front/zones"), ..options.clone() }, 2, "only scan and marks"),
        (ConvertOptions { topic: topic("front"), ..options.clone() }, 2, "is not a topic"),
        (ConvertOptions { sensor: topic("rear"), ..options.clone() }, 2, "different sensors"),
        (ConvertOptions { intensities: true, ..options.clone() }, 2, "--intensities is for scans"),
        (ConvertOptions { mode: Some(Mode(1)), ..options.clone() }, 2, "--mode is for scans"),
        (ConvertOptions { output: folder.path().join("a.log"), ..options.clone() }, 2, "--topic is for CSV"),
        (ConvertOptions { input: stream, ..options.clone() }, 3, "no recorded marks"),
        (
            ConvertOptions {
                topic: None,
                meters: true,
                output: folder.path().join("b.mcap"),
                ..options.clone()
            },
            2,
            "--meters is for CSV",
        ),
        (
            ConvertOptions {
                topic: None,
                intensities: true,
                output: folder.path().join("b.log"),
                ..options.clone()
            },
            2,
            "--intensities is for CSV",
        ),
    ] {
        let failure = convert(&changed, &AtomicBool::new(false), |_, _| {}).unwrap_err();
        assert!(failure.message.contains(message) && !failure.hint.is_empty(), "{message}: {failure}");
        assert_eq!(failure.kind.exit_code(), code, "{failure}");
    }
}

#[test]
fn captured_stream_round_trips_through_mcap() {
    let Some(data) = real::recordings() else { return };
    let folder = TempDir::new().unwrap();
    let capture = data.join("captures/lms200_38400.bin");
    let (mcap, again) = (folder.path().join("capture.mcap"), folder.path().join("capture.bin"));
    convert_file(&capture, &mcap, None).unwrap();
    convert_file(&mcap, &again, None).unwrap();
    assert!(fs::read(&capture).unwrap() == fs::read(&again).unwrap());
}

#[test]
fn refused_conversion_leaves_no_output() {
    let folder = TempDir::new().unwrap();
    let noise = file(&folder, "noise.mcap", &[0x42; 900]);
    let failure = convert_file(&noise, &folder.path().join("out.mcap"), None).unwrap_err();
    assert!(failure.kind.exit_code() == 66 && failure.message.contains("no telegram"), "{failure}");
    fs::remove_file(noise).unwrap();
    let input = file(&folder, "in.mcap", &crate::written::recording(8, 13).bytes);
    let existing = file(&folder, "there.bin", b"mine");
    std::os::unix::fs::symlink(&input, folder.path().join("link.mcap")).unwrap();
    for (output, sensor, message) in [
        ("in.mcap", None, "both read and written"),
        ("link.mcap", None, "both read and written"),
        ("there.bin", Some("front"), "exists"),
        ("out.bin", None, "several sensors"),
        ("out.log", Some("left"), "no sensor \"left\""),
        ("out.txt", None, "is not a known format"),
        ("out.mcap.gz", None, "is not a known format"),
        ("no/such/out.mcap", None, "cannot write"),
    ] {
        let failure = convert_file(&input, &folder.path().join(output), sensor).unwrap_err();
        assert!(failure.message.contains(message) && !failure.hint.is_empty(), "{output}: {failure}");
    }
    let options =
        ConvertOptions { input, output: folder.path().join("stopped.mcap"), ..ConvertOptions::default() };
    let failure = convert(&options, &AtomicBool::new(true), |_, _| {}).unwrap_err();
    assert_eq!(failure.kind.exit_code(), 130);
    assert_eq!(names(&folder), ["in.mcap", "link.mcap", "there.bin"]);
    assert_eq!(fs::read(existing).unwrap(), b"mine");
}
