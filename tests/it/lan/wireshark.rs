//! Dissector for Wireshark, tested on captures: it shows every field of the golden datagrams, and marks faults in a
//! sequence of datagrams. The tests are skipped if tshark is not installed.

use std::collections::{BTreeMap, BTreeSet};

use super::capture::{Capture, has_tshark};
use super::{damaged, keyed_vectors, vectors};
use crate::testkit::TestEnv;
use scanhub_schema::datagram::{DatagramPayload, HEADER_LEN, Head};
use scanhub_schema::{EventKind, Family, PointClass, State, Topic, TrackState, Verdict, Zones};
use serde_json::Value;

/// Returns the fields that the dissector must show for a payload, by the dissector's name of the field. `description`
/// is the payload in the list of golden datagrams. The values of each field are in the order and in the format in which
/// the dissector shows them.
fn fields(topic: &str, description: &Value) -> BTreeMap<String, Vec<String>> {
    let mut fields = BTreeMap::new();
    flatten(topic, "", description, &mut fields);
    fields
}

fn flatten(topic: &str, name: &str, description: &Value, fields: &mut BTreeMap<String, Vec<String>>) {
    match description {
        // The list has times that are computed from other fields. The dissector does not show these.
        Value::Object(items) => items
            .iter()
            .filter(|(key, _)| *key != "times_ns")
            .for_each(|(key, item)| flatten(topic, key, item, fields)),
        Value::Array(items) => {
            let single = match name {
                "beams" => "beam",
                "ranges" => "range",
                "angles" => "angle",
                "codes" => "code",
                "intensities" => "intensity",
                name => name,
            };
            items.iter().for_each(|item| flatten(topic, single, item, fields));
        }
        // The list has `null` for a missing value, which a datagram encodes as a special number. The test does not
        // compare missing values.
        Value::Null => {}
        value => {
            let field = match name {
                "telegram" => "scanhub.telegram".to_owned(),
                name => format!("scanhub.{topic}.{name}"),
            };
            fields.entry(field).or_default().push(shown_field(name, value));
        }
    }
}

fn shown_field(name: &str, value: &Value) -> String {
    let number = |of: Option<usize>| of.expect("a known name").to_string();
    match (name, value) {
        ("verdict", Value::String(name)) => {
            number(Verdict::ALL.iter().find(|known| known.name() == name).map(|&known| known as usize))
        }
        ("family", Value::String(name)) => number(Family::parse(name).map(|family| family as usize)),
        ("state", Value::String(name)) => {
            let of_track = || TrackState::ALL.iter().position(|known| known.name() == name);
            number(State::ALL.iter().position(|known| known.name() == name).or_else(of_track))
        }
        ("class", Value::String(name)) => {
            number(PointClass::ALL.iter().position(|known| known.name() == name))
        }
        ("kind", Value::String(name)) => number(EventKind::ALL.iter().position(|known| known.name() == name)),
        ("method", Value::String(name)) => {
            number(scanhub_schema::MotionMethod::ALL.iter().position(|known| known.name() == name))
        }
        ("boot" | "hub", Value::String(digits)) => format!("0x{digits}"),
        ("mode" | "flags", value) => format!("0x{:02x}", value.as_u64().expect("a byte")),
        (_, Value::Bool(value)) => u8::from(*value).to_string(),
        (_, Value::String(text)) => text.clone(),
        (_, value) => value.to_string(),
    }
}

/// Rounds values of angles, lines, motions and similar fields, because the dissector shows fewer or more digits of them
/// than the list.
fn shown_value(name: &str, values: &str) -> String {
    let is_angle = ["angle", "step", "spacing"].iter().any(|word| name.ends_with(word))
        || ["lines", "motion", "tracks", "tilt", "cloud", "obstacles"]
            .iter()
            .any(|topic| name.starts_with(&format!("scanhub.{topic}.")))
            && ["_m", "_m_s", "_rad", "_rad_s", "covariance", "score"]
                .iter()
                .any(|word| name.ends_with(word));
    if !is_angle || values.is_empty() {
        return values.to_owned();
    }
    let rounded = |value: &str| format!("{:.5}", value.parse::<f64>().expect("a number"));
    values.split(',').map(rounded).collect::<Vec<_>>().join(",")
}

#[test]
fn golden_datagrams_are_shown_field_by_field() {
    if !has_tshark() {
        return;
    }
    let vectors = vectors::vectors();
    let mut capture = Capture::default();
    vectors.iter().for_each(|vector| capture.add(&vector.bytes));
    // Expected fields of each datagram.
    let mut expected: Vec<BTreeMap<String, Vec<String>>> = Vec::new();
    for vector in &vectors {
        let mut target = BTreeMap::new();
        match vector.description["refusal"].as_str() {
            None => {
                let head = &vector.description["head"];
                let topic = head["topic"].as_u64().expect("a number");
                let topic = Topic::of_number(topic as u8).map_or("announce", Topic::name);
                target = fields(topic, &vector.description["payload"]);
                for (key, value) in head.as_object().expect("an object") {
                    let key = if key == "payload_len" { "payload_length" } else { key };
                    target.insert(format!("scanhub.{key}"), vec![shown_field(key, value)]);
                }
                target.insert("scanhub.refused".to_owned(), Vec::new());
                target.insert("scanhub.crc_status".to_owned(), vec!["good".to_owned()]);
            }
            // For a part of a sample, the dissector shows only that it is a part, and not the content of the sample.
            Some("payload") if vector.name.starts_with("scan_part_") => {
                let part = vector.name.trim_start_matches("scan_part_");
                for (field, value) in [("part", part), ("parts", "3"), ("crc_status", "good")] {
                    target.insert(format!("scanhub.{field}"), vec![value.to_owned()]);
                }
                target.insert("scanhub.refused".to_owned(), Vec::new());
            }
            // These results depend on a key or on datagrams that the capture does not contain.
            Some("unauthenticated" | "mac" | "epoch" | "twin" | "stale" | "capacity") => {}
            Some(refusal) => {
                target.insert("scanhub.refused".to_owned(), vec![refusal.to_owned()]);
            }
        }
        expected.push(target);
    }
    let names: BTreeSet<&String> = expected.iter().flat_map(BTreeMap::keys).collect();
    let names: Vec<String> = names.into_iter().cloned().collect();
    let shown = capture.fields("golden", &names);
    assert_eq!(shown.len(), vectors.len());
    for ((vector, target), shown) in vectors.iter().zip(&expected).zip(&shown) {
        for (name, values) in target {
            assert_eq!(
                shown_value(name, &shown[name]),
                shown_value(name, &values.join(",")),
                "{name} of {}",
                vector.name
            );
        }
    }
    assert!(names.len() > 80, "{names:?}");
}

/// The dissector shows the reason why a receiver would refuse a datagram, and continues with the next one.
#[test]
fn damaged_datagrams_are_shown_as_refused() {
    if !has_tshark() {
        return;
    }
    let damaged = damaged::datagrams(3_000);
    let mut capture = Capture::default();
    damaged.iter().for_each(|(datagram, _)| capture.add(datagram));
    let shown = capture.fields("damaged", &["scanhub.refused".to_owned()]);
    assert_eq!(shown.len(), damaged.len());
    for ((datagram, expected), shown) in damaged.iter().zip(&shown) {
        let refusal = expected["refusal"].as_str().unwrap_or_default();
        // A single part is not a valid payload, so `schema` refuses it. The dissector shows it as a part.
        let is_part = refusal == "payload" && datagram[34] > 1;
        let refusal = if is_part { "" } else { refusal };
        assert_eq!(shown["scanhub.refused"], refusal, "{datagram:02x?}");
    }
}

/// With the key, the dissector marks datagrams with a wrong MAC as refused. Without a key, it cannot check them.
#[test]
fn wireshark_checks_macs_with_a_key() {
    if !has_tshark() {
        return;
    }
    let keyed = keyed_vectors::read_vectors();
    let mut capture = Capture::default();
    keyed.steps.iter().for_each(|step| capture.add(&step.bytes));
    let env = TestEnv::new();
    let names = ["mac_status", "refused"].map(|name| format!("scanhub.{name}"));
    let shown = |name: &str, file: &str| {
        let setting = Some(format!("scanhub.key_file:{file}")).filter(|_| !file.is_empty());
        let settings: Vec<_> = setting.into_iter().collect();
        capture.fields_with(name, &names, &settings)
    };
    let raw: Vec<u8> = keyed_vectors::unhex(&keyed.key);
    for (name, file) in [("hex", env.file("hex", format!("{}\n", keyed.key))), ("raw", env.file("raw", raw))]
    {
        for (step, shown) in keyed.steps.iter().zip(shown(name, &file)) {
            assert_eq!(shown["scanhub.mac_status"], step.mac, "{}", step.name);
            let refused = Some(step.outcome.as_str()).filter(|_| step.mac != "right").unwrap_or_default();
            assert_eq!(shown["scanhub.refused"], refused, "{}", step.name);
        }
    }
    let (missing, short) = (env.path_argument("missing"), env.file("short", "00ff"));
    for (name, file) in [("without", ""), ("missing", &missing), ("short", &short)] {
        for (step, shown) in keyed.steps.iter().zip(shown(name, file)) {
            let status = &shown["scanhub.mac_status"];
            let is_right = match step.mac.as_str() {
                "none" => status.is_empty(),
                _ => status.starts_with("no key") && status.contains(file),
            };
            assert!(is_right, "{status} of {}", step.name);
            assert_eq!(shown["scanhub.refused"], "", "{}", step.name);
        }
    }
}

#[test]
fn gaps_are_flagged_per_hub_epoch_sensor_and_topic() {
    if !has_tshark() {
        return;
    }
    let zones =
        |sequence| Head { topic: Topic::Zones.number(), revision: 1, epoch: 7, sequence, ..Head::default() };
    let nothing = ("", "");
    let sent = [
        (zones(u32::MAX - 1), nothing),
        (zones(u32::MAX), nothing),
        (zones(0), nothing),
        (zones(3), ("lost", "2")),
        (Head { sensor: 1, ..zones(900) }, nothing),
        (Head { hub: 9, ..zones(800) }, nothing),
        (zones(2), ("reordered", "1")),
        (zones(2), ("duplicate", "1")),
        (zones(3), ("duplicate", "0")),
        (zones(4), nothing),
        (Head { sensor: 1, ..zones(902) }, ("lost", "1")),
        (zones(1028), ("lost", "1023")),
        (zones(5), ("reordered", "1023")),
        (zones(4), ("stale", "1024")),
        (Head { epoch: 8, ..zones(0) }, nothing),
        (Head { epoch: 7, ..zones(1029) }, ("retired", "8")),
        (Head { hub: 9, ..zones(801) }, nothing),
    ];
    let mut capture = Capture::default();
    for (head, _) in sent {
        let mut buffer = [0; 100];
        let len = Zones::unknown().pack(&mut buffer[HEADER_LEN..]).expect("the payload fits into the buffer");
        capture.add(head.seal(&mut buffer, len).expect("the payload fits into the buffer"));
    }
    let flags = ["lost", "reordered", "duplicate", "stale", "retired"];
    let names = flags.map(|name| format!("scanhub.{name}"));
    for (number, ((_, (flag, value)), shown)) in sent.iter().zip(capture.fields("gaps", &names)).enumerate() {
        for name in flags {
            let expected = if name == *flag { value } else { "" };
            assert_eq!(shown[&format!("scanhub.{name}")], expected, "{name} of datagram {number}");
        }
    }
}
