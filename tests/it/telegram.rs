//! Tests of `scanhub telegram decode`: it explains every telegram, counts every byte outside of telegrams, and for
//! input that cannot be read it prints an error with a remedy.

use std::io::Write as _;
use std::process::{Command, Output, Stdio};

use scanhub_drivers::lms::command::{Password, RawParameters, Request, SubRange, SubRanges};
use scanhub_drivers::lms::configuration::{self, Configuration};
use scanhub_drivers::lms::measured;
use scanhub_drivers::lms::operating::{self, Operating};
use scanhub_drivers::lms::reply::{self, Reply, SimulatedStatus};
use scanhub_drivers::lms::status::Errors;
use scanhub_drivers::lms::telegram::EncodedTelegram;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_lms_configure::eeprom::{EepromWrite, PowerOn};
use serde_json::Value;

use crate::testkit::spawn;

/// Runs `scanhub telegram` with these words as further arguments, and with `input` on its stdin.
fn telegram(words: &[&str], input: &[u8]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    command
        .arg("telegram")
        .args(words)
        .env_remove("SCANHUB_DOMAIN")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut program = spawn(command).expect("a started program");
    let mut stdin = program.stdin.take().expect("a pipe");
    let input = input.to_vec();
    // Write in a thread, because the program may print before it has read all input, and the pipes would fill.
    let writer = std::thread::spawn(move || stdin.write_all(&input));
    let output = program.wait_with_output().expect("the output of the program");
    // Writing fails if the program exits without reading its stdin, which is not an error here.
    let _ = writer.join().expect("a thread that does not panic");
    output
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("text")
}

fn lines(output: &Output) -> Vec<Value> {
    text(&output.stdout).lines().map(|line| serde_json::from_str(line).expect("an object")).collect()
}

/// Returns every request and the simpler replies, each with a part of the explanation that the verb must print for it.
fn telegrams() -> Vec<(EncodedTelegram, &'static str)> {
    let span = |first, last| SubRange { first, last };
    let spans = |spans: &[SubRange]| SubRanges::new(spans).expect("one to five sub-ranges");
    let raw = |bytes: &[u8]| RawParameters::new(bytes).expect("at most 16 bytes");
    let requests = [
        (Request::Reset, "10h reset"),
        (Request::Stream, "all values, continuously"),
        (Request::Stop, "values on request"),
        (Request::Baud(Baud::B500000), "500000 baud"),
        (Request::install(Password::FACTORY), "installation"),
        (Request::Values(1), "measured values, once"),
        (Request::Values(8), "measured values, once"),
        (Request::Status, "31h status"),
        (Request::Errors, "32h errors"),
        (Request::Counters, "35h operating data counters"),
        (Request::Means(250), "36h mean values"),
        (Request::Range(span(0x8001, 361)), "37h values of a sub-range"),
        (Request::Type, "3Ah type and firmware"),
        (Request::Variant(Variant::HALF), "180 degrees at 0.5"),
        (Request::Variant(Variant::new(100, 25).expect("a variant")), "100 degrees at 0.25"),
        (Request::RangeFields(span(1, 100)), "with field values"),
        (Request::RangeMeans(2, span(1, 361)), "mean values of a sub-range"),
        (Request::FieldSet(raw(&[1])), "switch of the field set"),
        (Request::Reflectivity(span(1, 181)), "ranges and reflectivity (S14)"),
        (Request::Field(raw(&[1, 2])), "45h field"),
        (Request::Outputs, "state of the field outputs"),
        (Request::Positioning, "positioning aid"),
        (Request::Configuration, "74h configuration, part 1"),
        (Request::Reflectivities(spans(&[span(1, 10); 5])), "ranges and reflectivities"),
        (Request::Cartesian(span(1, 200)), "Cartesian coordinates"),
        (Request::Configuration2, "7Bh configuration, part 2"),
    ];
    let modes = [
        (Operating::TestPassword(Password(*b"password")), "test of a password"),
        (Operating::Diagnosis, "diagnosis"),
        (Operating::SegmentMinimum, "lowest value of each segment, continuously"),
        (Operating::SegmentMinimumOnObject, "lowest value of each segment, on an object"),
        (Operating::VerticalMinimum, "shortest vertical distance, continuously"),
        (Operating::VerticalMinimumOnObject, "shortest vertical distance, on an object"),
        (Operating::Means(20), "mean values, continuously"),
        (Operating::Range(span(27, 299)), "values of a sub-range, continuously"),
        (Operating::RangeMeans(2, span(1, 361)), "mean values of a sub-range, continuously"),
        (Operating::RangeFields(span(1, 100)), "with field values, continuously"),
        (Operating::Partial, "partial scans, immediately"),
        (
            Operating::Reflectivities(spans(&[span(1, 181)])),
            "ranges and reflectivities of sub-ranges, continuously",
        ),
        (Operating::SegmentMinimumOfRange(raw(&[1, 2])), "in a sub-range, continuously"),
        (Operating::Navigation, "records for navigation"),
        (Operating::Reflectivity(span(1, 181)), "ranges, and reflectivities of a sub-range"),
    ];
    let factory = configuration::factory_configuration(Mode(4), Unit::Cm);
    let writes = [
        (EepromWrite::Configuration(&factory), "write of the configuration, part 1"),
        (EepromWrite::Configuration2(&[0, 1]), "write of the configuration, part 2"),
        (EepromWrite::PowerOn(PowerOn::KeepBaud), "write of the rate after power-on"),
        (EepromWrite::Field(&[1]), "write of a field"),
        (EepromWrite::Password(&[1]), "change of the password"),
        (EepromWrite::Teach(&[1]), "teaching of a field"),
    ];
    let health = SimulatedStatus {
        software: *b"V02.30 ",
        operating_mode: operating::ON_REQUEST,
        mode: Mode(0),
        variant: Variant::HALF,
        unit: Unit::Mm,
        baud: Baud::B9600,
    };
    let configuration = Configuration::new(&factory).expect("a configuration");
    let replies = [
        (Reply::PowerOn(b"LMS200;301063;V02.10"), "power on, from sensor 0: LMS200;301063;V02.10; ok"),
        (Reply::Reset, "reset begins"),
        (Reply::Refused, "command refused"),
        (Reply::Mode { done: true }, "change of operating mode, from sensor 0: done; ok"),
        (Reply::Mode { done: false }, "not done"),
        (Reply::Errors(Errors::new(&[0x84, 22, 1, 49]).expect("pairs")), "1 present, 1 past"),
        (Reply::Errors(Errors::new(&[]).expect("an empty list")), "errors, from sensor 0: none"),
        (Reply::Counters { hours_by_2: 2000, power_ons: 12 }, "operating data counters"),
        (Reply::Type(b"LMS291;S05063;V02.30"), "LMS291;S05063;V02.30"),
        (
            Reply::Variant { done: false, angle_deg: 180, resolution_cdeg: 100 },
            "not done, 180 degrees at 1 in effect",
        ),
        (Reply::Configuration(configuration), "configuration, part 1"),
        (Reply::ConfigurationWritten { done: true, configuration }, "part 1, from sensor 0: done"),
        (Reply::PowerOnSet { outcome: 1, set: 0 }, "write of the rate after power-on"),
    ];
    let operate = |(mode, headline)| (Request::Operate(mode), headline);
    let mut telegrams: Vec<_> = requests
        .into_iter()
        .chain(modes.map(operate))
        .map(|(request, headline)| (request.encode(0), headline))
        .collect();
    telegrams.extend(writes.map(|(write, headline)| (write.encode(0).expect("a short telegram"), headline)));
    telegrams.extend(
        replies.map(|(reply, headline)| (reply.encode(0, STATUS_OK).expect("a short telegram"), headline)),
    );
    telegrams.push((measured::encode(0, Unit::Cm, &[100, 8191], STATUS_OK), "2 in cm"));
    telegrams.push((reply::status_reply(0, &health, STATUS_OK), "V02.30, values on request"));
    telegrams
}

#[test]
fn every_telegram_is_explained() {
    let expected = telegrams();
    let stream: Vec<u8> = expected.iter().flat_map(|(telegram, _)| telegram.bytes()).copied().collect();
    let output = telegram(&["decode", "--json"], &stream);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let decoded = lines(&output);
    assert_eq!(decoded.len(), expected.len() + 1, "and the summary");
    for ((telegram, headline), line) in expected.iter().zip(&decoded) {
        assert_eq!((&line["class"], &line["kind"]), (&"decoded".into(), &"telegram".into()), "{line}");
        let words = line["words"].as_str().expect("words");
        assert!(words.contains(headline) && !words.contains("malformed"), "{headline}: {words}");
        let raw: String = telegram.bytes().iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(line["raw"], raw, "{headline}");
        let fields = line["fields"].as_array().expect("fields");
        let length: u64 = fields.iter().filter_map(|field| field["length"].as_u64()).sum();
        assert_eq!(length, telegram.bytes().len() as u64, "{headline}: a byte is in no field");
    }
    assert_eq!(decoded[expected.len()]["telegrams"], expected.len());
}

#[test]
fn hexadecimal_text_and_bytes_decode_equally() {
    let request = Request::Status.encode(0);
    let of_text = telegram(&["decode"], b"02 00 01 00 31 15 12\n");
    let of_bytes = telegram(&["decode", "-"], request.bytes());
    assert_eq!(text(&of_text.stdout), text(&of_bytes.stdout));
    let expected = "       0     7 bytes  31h status, to all sensors\n";
    assert!(text(&of_text.stdout).starts_with(expected), "{}", text(&of_text.stdout));
    let reply = reply::mode_reply(5, true, STATUS_OK);
    let line = &lines(&telegram(&["decode", "--json"], reply.bytes()))[0];
    assert_eq!((&line["from"], &line["address"]), (&"sensor".into(), &5.into()));
}

#[test]
fn lists_bytes_between_telegrams() {
    let mut bytes = vec![0x55, 0x55];
    bytes.extend(Request::Stop.encode(0).bytes());
    bytes.push(0x06);
    bytes.extend(reply::mode_reply(0, true, STATUS_OK).bytes());
    let mut damaged = reply::refusal(0, STATUS_OK).bytes().to_vec();
    damaged[7] ^= 0xFF;
    bytes.extend(&damaged);
    let decoded = lines(&telegram(&["decode", "--json"], &bytes));
    let kinds: Vec<_> = decoded.iter().map(|line| line["kind"].as_str().unwrap_or("summary")).collect();
    assert_eq!(kinds, ["other", "telegram", "ack", "telegram", "broken", "summary"]);
    assert_eq!((&decoded[4]["checksum"], &decoded[4]["expected"]), (&0xCC7F.into(), &0x337F.into()));
    let summary = &decoded[5];
    assert_eq!((&summary["bytes"], &summary["other_bytes"]), (&bytes.len().into(), &2.into()));
}

#[test]
fn preceding_telegrams_determine_decoded_values() {
    let mut bytes = measured::encode(0, Unit::Mm, &[0x83E8, 200], STATUS_OK).bytes().to_vec();
    let unknown = lines(&telegram(&["decode", "--json"], &bytes));
    let values = |line: &Value| line["fields"].as_array().expect("fields")[5].clone();
    assert_eq!(values(&unknown[0])["mm"], serde_json::json!([1000, 200]));
    assert!(values(&unknown[0])["words"].as_str().expect("a string").contains("mode unknown"));
    let with_mode = lines(&telegram(&["decode", "--json", "--mode", "0x0F"], &bytes));
    assert!(values(&with_mode[0])["words"].as_str().expect("a string").ends_with("15 bits"));
    bytes.splice(0..0, reply::configuration_reply(0, Mode(5), Unit::Mm, STATUS_OK).bytes().iter().copied());
    let learned = lines(&telegram(&["decode", "--json"], &bytes));
    assert!(
        values(&learned[1])["words"].as_str().expect("a string").contains("15 bits and 1 of reflector level")
    );
    let all = text(&telegram(&["decode", "--all"], &bytes).stdout);
    assert!(all.contains("   0  83E8  1000 mm, bits above 1\n"), "{all}");
}

#[test]
fn telegrams_inside_a_recording_are_decoded() {
    let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/vectors/recording/v1.mcap");
    let bytes = std::fs::read(golden).expect("a golden recording");
    let output = telegram(&["decode", "--json", golden], &[]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let (decoded, summary) = (lines(&output), lines(&output).pop().expect("a summary"));
    // All bytes that the program examined belong to telegrams. It has examined only the recorded telegrams, and not the
    // other bytes of the file.
    let inside: u64 = decoded.iter().filter_map(|line| line["length"].as_u64()).sum();
    assert!(inside > 0 && inside < bytes.len() as u64, "{summary}");
    assert_eq!((summary["bytes"].as_u64(), summary["other_bytes"].as_u64()), (Some(inside), Some(0)));
    assert!(
        summary["broken"] == 0 && summary["cut"] == 0 && summary["telegrams"].as_u64() > Some(0),
        "{summary}"
    );
    assert!(
        decoded.iter().all(|line| line["kind"] == "telegram" || line["class"] == "summary"),
        "{decoded:?}"
    );
    let chosen = telegram(&["decode", "--json", "--sensor=rear", golden], &[]);
    assert_eq!(chosen.stdout, output.stdout);

    for (words, input, code, message) in [
        (&["decode", golden, "--sensor=left"][..], &b""[..], 3, "has no sensor \"left\""),
        (&["decode", "--sensor=front"], b"", 2, "stdin is not one"),
        (&["decode"], &bytes, 66, "name its file"),
    ] {
        let output = telegram(words, input);
        let errors = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{words:?}: {errors}");
        assert!(errors.contains(message), "{words:?}: {errors}");
    }
}

#[test]
fn refusals_have_a_remedy() {
    for (words, code, message) in [
        (&["decode", "/nowhere/at/all"][..], 66, "/nowhere/at/all: No such file"),
        (&["decode", "--mode", "x"], 78, "is not a byte"),
        (&["decode"], 5, "no telegram in 0 bytes"),
    ] {
        let output = telegram(words, &[]);
        let errors = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{words:?}: {errors}");
        assert!(errors.contains(message), "{words:?}: {errors}");
    }
    let garbled = telegram(&["decode", "--json"], b"02 00 0q");
    assert_eq!(garbled.status.code(), Some(66));
    assert!(
        lines(&garbled)[0]["message"].as_str().expect("a message").contains("line 1: \"0q\" is not a byte")
    );
}

/// Status byte of a scanner without a fault.
const STATUS_OK: u8 = 0x10;
