//! `scanhub telegram` from outside: what is encoded is decoded again, whatever the name; bytes that are nothing are
//! accounted for; what cannot be said is refused with the remedy.

use std::io::Write;
use std::process::{Command, Output, Stdio};

use serde_json::Value;

use crate::testkit::spawn;

/// Runs the verb with `input` on its stdin.
fn telegram(words: &[&str], input: &[u8]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    command
        .arg("telegram")
        .args(words)
        .env_remove("SCANHUB_DOMAIN")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut program = spawn(command).expect("it starts");
    let mut stdin = program.stdin.take().expect("a pipe");
    let input = input.to_vec();
    // It may write before it has read everything.
    let writer = std::thread::spawn(move || stdin.write_all(&input));
    let output = program.wait_with_output().expect("it ends");
    // One that reads nothing closes its end.
    let _ = writer.join().expect("no panic");
    output
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("text")
}

fn lines(output: &Output) -> Vec<Value> {
    text(&output.stdout).lines().map(|line| serde_json::from_str(line).expect("an object")).collect()
}

fn encoded(words: &str) -> Vec<u8> {
    let words: Vec<_> = ["encode", "--raw"].into_iter().chain(words.split(' ')).collect();
    let output = telegram(&words, &[]);
    assert_eq!(output.status.code(), Some(0), "{words:?}: {}", text(&output.stderr));
    output.stdout
}

/// Something for every name.
const TELEGRAMS: [(&str, &str); 65] = [
    ("reset", "10h reset"),
    ("stream", "all values, continuously"),
    ("stop", "values on request"),
    ("baud 500000", "500000 baud"),
    ("install", "installation"),
    ("install SICK_LMS", "installation"),
    ("test-password password", "test of a password"),
    ("mode stream", "all values, continuously"),
    ("mode stop", "values on request"),
    ("mode diagnosis", "diagnosis"),
    ("mode segments", "least value of each segment, continuously"),
    ("mode segments-on-object", "least value of each segment, on an object"),
    ("mode vertical", "least vertical distance, continuously"),
    ("mode vertical-on-object", "least vertical distance, on an object"),
    ("mode means 20", "mean values, continuously"),
    ("mode range 27 299", "values of a sub-range, continuously"),
    ("mode range-means 2 1 361", "mean values of a sub-range, continuously"),
    ("mode range-fields 1 100", "with field values, continuously"),
    ("mode partial", "partial scans, at once"),
    ("mode reflectivities 1 181", "ranges and reflectivities of sub-ranges, continuously"),
    ("mode range-segments 01 02", "in a sub-range, continuously"),
    ("mode navigation", "records for navigation"),
    ("mode reflectivity 1 181", "ranges, and reflectivities of a sub-range"),
    ("values", "measured values, once"),
    ("values 8", "measured values, once"),
    ("status", "31h status"),
    ("errors", "32h errors"),
    ("counters", "35h operating data counters"),
    ("means 250", "36h mean values"),
    ("range 0x8001 361", "37h values of a sub-range"),
    ("type", "3Ah type and firmware"),
    ("variant 180 0.5", "180 degrees at 0.5"),
    ("variant 100 0.25", "100 degrees at 0.25"),
    ("range-fields 1 100", "with field values"),
    ("range-means 2 1 361", "mean values of a sub-range"),
    ("field-set 01", "switch of the field set"),
    ("reflectivity 1 181", "ranges and reflectivity (S14)"),
    ("field 01 02", "45h field"),
    ("outputs", "state of the field outputs"),
    ("positioning", "positioning aid"),
    ("configuration", "74h configuration, part 1"),
    ("reflectivities 1 10 20 30 40 50 60 70 80 90", "ranges and reflectivities"),
    ("cartesian 1 200", "Cartesian coordinates"),
    ("configuration2", "7Bh configuration, part 2"),
    ("configuration unit=cm mode=4 blanking=10", "write of the configuration, part 1"),
    ("configuration2 00 01", "write of the configuration, part 2"),
    ("power-on keep", "write of the rate after power-on"),
    ("write-field 01", "write of a field"),
    ("write-password 01", "change of the password"),
    ("teach 01", "teaching of a field"),
    ("reply power-on LMS200;301063;V02.10", "power on, from sensor 0: LMS200;301063;V02.10; ok"),
    ("reply reset", "reset begins"),
    ("reply refused", "command refused"),
    ("reply mode ok", "change of operating mode, from sensor 0: done; ok"),
    ("reply mode refused", "not done"),
    ("reply values cm 100 8191", "2 in cm"),
    ("reply status", "V02.30, values on request"),
    ("reply errors 0x84:22 1:49", "1 present, 1 past"),
    ("reply counters 4000 12", "operating data counters"),
    ("reply type LMS291;S05063;V02.30", "LMS291;S05063;V02.30"),
    ("reply variant refused 180 1", "not done, 180 degrees at 1 in force"),
    ("reply configuration unit=cm", "configuration, part 1"),
    ("reply configuration-written ok mode=1", "part 1, from sensor 0: done"),
    ("reply power-on-set 1 0", "write of the rate after power-on"),
    ("reply errors", "errors, from sensor 0: none"),
];

#[test]
fn every_telegram_that_can_be_said_is_understood() {
    let (mut stream, mut expected) = (Vec::new(), Vec::new());
    for (words, headline) in TELEGRAMS {
        let bytes = encoded(words);
        expected.push((words, headline, bytes.clone()));
        stream.extend(bytes);
    }
    let output = telegram(&["decode", "--json"], &stream);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let decoded = lines(&output);
    assert_eq!(decoded.len(), expected.len() + 1, "and the summary");
    for ((words, headline, bytes), line) in expected.iter().zip(&decoded) {
        assert_eq!(
            (&line["class"], &line["kind"]),
            (&"decoded".into(), &"telegram".into()),
            "{words}: {line}"
        );
        let told = line["words"].as_str().expect("words");
        assert!(told.contains(headline) && !told.contains("not as it should be"), "{words}: {told}");
        let raw: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(line["raw"], raw, "{words}");
        let fields = line["fields"].as_array().expect("fields");
        let length: u64 = fields.iter().filter_map(|field| field["length"].as_u64()).sum();
        assert_eq!(length, bytes.len() as u64, "{words}: a byte is in no field");
    }
    assert_eq!(decoded[expected.len()]["telegrams"], expected.len());
    // No name of the help was forgotten.
    let help = text(&telegram(&["encode", "--help"], &[]).stdout);
    let rows =
        help.lines().skip_while(|line| *line != "Telegrams:").skip(1).take_while(|line| !line.is_empty());
    let rows: Vec<_> = rows.collect();
    assert!(rows.len() > 50, "{help}");
    for row in rows {
        // Name and values stand in a column of their own; a name is of small letters only.
        let is_name = |word: &&str| word.chars().all(|c| c.is_ascii_lowercase() || c == '-' || c == '2');
        let name: Vec<_> = row[..48].split_whitespace().take_while(is_name).collect();
        let known = |words: &str| words.split(' ').take(name.len()).eq(name.iter().copied());
        assert!(!name.is_empty() && expected.iter().any(|(words, ..)| known(words)), "{row}");
    }
}

#[test]
fn text_and_bytes_are_the_same() {
    let hex = text(&telegram(&["encode", "status"], &[]).stdout);
    assert_eq!(hex, "02 00 01 00 31 15 12\n");
    let of_text = telegram(&["decode"], hex.as_bytes());
    let of_bytes = telegram(&["decode", "-"], &encoded("status"));
    assert_eq!(text(&of_text.stdout), text(&of_bytes.stdout));
    let expected = "       0     7 bytes  31h status, to all sensors\n";
    assert!(text(&of_text.stdout).starts_with(expected), "{}", text(&of_text.stdout));
    let one = &lines(&telegram(&["encode", "power-on", "keep", "--address", "3", "--json"], &[]))[0];
    let keys: Vec<_> = one.as_object().expect("an object").keys().cloned().collect();
    let mut expected = ["class", "length", "from", "address", "command", "writes_eeprom", "words", "raw"];
    expected.sort_unstable();
    assert_eq!(keys, expected);
    assert_eq!(
        (&one["from"], &one["address"], &one["command"], &one["writes_eeprom"]),
        (&"host".into(), &3.into(), &0x66.into(), &true.into())
    );
    // Said and understood, an address is the same.
    let words = ["reply", "mode", "ok", "--address", "5"];
    let said = &lines(&telegram(&[&["encode", "--json"], &words[..]].concat(), &[]))[0];
    let bytes = telegram(&[&["encode", "--raw"], &words[..]].concat(), &[]).stdout;
    let understood = &lines(&telegram(&["decode", "--json"], &bytes))[0];
    assert_eq!((&said["from"], &said["address"]), (&"sensor".into(), &5.into()));
    for key in ["from", "address", "command", "length", "words", "raw"] {
        assert_eq!(said[key], understood[key], "{key}");
    }
}

#[test]
fn what_is_between_telegrams_is_told() {
    let mut bytes = vec![0x55, 0x55];
    bytes.extend(encoded("stop"));
    bytes.push(0x06);
    bytes.extend(encoded("reply mode ok"));
    let mut damaged = encoded("reply refused");
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
fn values_are_read_as_the_telegrams_tell() {
    let mut bytes = encoded("reply values mm 0x83E8 200");
    let unknown = lines(&telegram(&["decode", "--json"], &bytes));
    let values = |line: &Value| line["fields"].as_array().expect("fields")[5].clone();
    assert_eq!(values(&unknown[0])["mm"], serde_json::json!([1000, 200]));
    assert!(values(&unknown[0])["words"].as_str().expect("words").contains("mode unknown"));
    let said = lines(&telegram(&["decode", "--json", "--mode", "0x0F"], &bytes));
    assert!(values(&said[0])["words"].as_str().expect("words").ends_with("15 bits"));
    bytes.splice(0..0, encoded("reply configuration mode=5"));
    let learned = lines(&telegram(&["decode", "--json"], &bytes));
    assert!(
        values(&learned[1])["words"].as_str().expect("words").contains("15 bits and 1 of reflector level")
    );
    let all = text(&telegram(&["decode", "--all"], &bytes).stdout);
    assert!(all.contains("   0  83E8  1000 mm, bits above 1\n"), "{all}");
}

#[test]
fn the_telegrams_inside_a_recording_are_decoded() {
    let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/vectors/recording/v1.mcap");
    let bytes = std::fs::read(golden).expect("it is there");
    let output = telegram(&["decode", "--json", golden], &[]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let (decoded, summary) = (lines(&output), lines(&output).pop().expect("a summary"));
    // Every byte is of a telegram: nothing of the framing is taken for one.
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

    for (words, input, code, told) in [
        (&["decode", golden, "--sensor=left"][..], &b""[..], 3, "has no sensor \"left\""),
        (&["decode", "--sensor=front"], b"", 2, "stdin is not one"),
        (&["decode"], &bytes, 66, "name its file"),
    ] {
        let output = telegram(words, input);
        let errors = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{words:?}: {errors}");
        assert!(errors.contains(told), "{words:?}: {errors}");
    }
}

#[test]
fn refusals_have_a_remedy() {
    for (words, code, told) in [
        (&["encode", "variant", "180", "0.25"][..], 78, "180 degrees at 0.5 or 1, 100 degrees at 0.25"),
        (&["encode", "statis"], 78, "did you mean \"status\"?"),
        (&["encode", "variant", "180"], 78, "it is: variant ANGLE STEP"),
        (&["encode", "configuration", "units=mm"], 78, "unknown key \"units\""),
        (&["encode", "install", "secret"], 78, "8, such as SICK_LMS"),
        (&["encode", "status", "--address", "200"], 78, "1 to 127"),
        (&["encode", "configuration2", "zz"], 78, "pairs of digits"),
        (&["encode", "stop", "--status", "0x10"], 78, "only a reply has a status byte"),
        (&["encode", "mode", "range-segments"], 78, "pairs of digits"),
        (&["encode", "field-set"], 78, "pairs of digits"),
        (&["encode", "field", ""], 78, "pairs of digits"),
        (&["encode", "write-field"], 78, "pairs of digits"),
        (&["encode", "write-password"], 78, "pairs of digits"),
        (&["encode", "teach"], 78, "pairs of digits"),
        (&["encode"], 2, "NAME"),
        (&["decode", "/nowhere/at/all"], 66, "/nowhere/at/all: No such file"),
        (&["decode", "--mode", "x"], 78, "is no number"),
        (&["decode"], 5, "no telegram in 0 bytes"),
    ] {
        let output = telegram(words, &[]);
        let errors = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{words:?}: {errors}");
        assert!(errors.contains(told), "{words:?}: {errors}");
    }
    let garbled = telegram(&["decode", "--json"], b"02 00 0q");
    assert_eq!(garbled.status.code(), Some(66));
    assert!(lines(&garbled)[0]["message"].as_str().expect("words").contains("line 1: \"0q\" is no byte"));
}
