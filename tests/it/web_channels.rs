//! Tests of all channels of `web`. A viewer subscribes as Foxglove's own library does, with a separate message for each
//! channel. The test decodes messages with the schema that the server sends: CDR with definitions of ROS messages, and
//! JSON with JSON Schema. The values must equal those that `echo --json` prints for the same samples.

use std::collections::HashMap;
use std::net::TcpStream;
use std::time::Instant;

use scanhub_ros::{LASER_SCAN, POINT_CLOUD, TF_MESSAGE, Value as Told, read};
use scanhub_schema::Pose;
use serde_json::{Value, json};
use tungstenite::{Message, WebSocket};

use crate::testkit::{INT, Outcome, TestEnv, WAIT_TIMEOUT, is_class, number, wall_ns};
use crate::web::{connect_viewer_with, text, web};

/// Pose of the sensor: distances ahead and to the left in meters, and yaw in radians.
const SENSOR_POSE: (f64, f64, f64) = (0.3, -0.1, 0.4);
const TOPICS: [&str; 7] = ["scan", "foreground", "marks", "zones", "lines", "background", "status"];
/// World in which a person appears in front of the background, inside the zones. A reflector is in a corner.
const WORLD: &str =
    "[noise]\ntail = 0\n\n[[thing]]\nline = [[3000, -3000], [3000, 3000], [-3000, 3000], [-3000, -3000]]\n
[[thing]]\nradius_mm = 60\npose = [0, 700]\nfrom_s = 9\n
[[thing]]\nline = [[900, 2000], [1000, 2000]]\nsurface = \"reflector\"\n";

fn pose() -> Pose {
    Pose { x_m: SENSOR_POSE.0, y_m: SENSOR_POSE.1, yaw_rad: SENSOR_POSE.2, ..Pose::default() }
}

/// Time of a message in nanoseconds since 1970, and body of the message.
type ChannelMessage = (u64, Vec<u8>);

/// A viewer that behaves like npm's `@foxglove/ws-protocol` 0.8.0: it numbers subscriptions from 0, and sends a
/// separate message for each subscription.
struct Viewer {
    socket: WebSocket<TcpStream>,
    /// Channels. The index of a channel is the number of its subscription.
    channels: Vec<Value>,
    messages: HashMap<String, Vec<ChannelMessage>>,
}

impl Viewer {
    fn new(host: &str, protocol: &str) -> Viewer {
        let mut socket = connect_viewer_with(host, "/", None, protocol).expect("an accepted viewer");
        assert_eq!(text(&mut socket)["op"], "serverInfo");
        Viewer { socket, channels: Vec::new(), messages: HashMap::new() }
    }

    /// Receives until every advertised channel has sent `count` messages.
    fn receive_messages(&mut self, count: usize) {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        while self.channels.len() < TOPICS.len() + 1 || self.min_count() < count {
            assert!(Instant::now() < give_up_at, "{count} of each: {:?}", self.counts());
            match self.socket.read().expect("an open connection") {
                Message::Text(text) => self.receive(&serde_json::from_str(&text).expect("JSON")),
                Message::Binary(frame) => {
                    let subscription = u32::from_le_bytes(frame[1..5].try_into().expect("four bytes"));
                    let stamp = u64::from_le_bytes(frame[5..13].try_into().expect("eight bytes"));
                    assert_eq!(frame[0], 1);
                    let topic = self.channels[subscription as usize]["topic"].as_str().expect("a topic");
                    self.messages.entry(topic.to_owned()).or_default().push((stamp, frame[13..].to_vec()));
                }
                _ => {}
            }
        }
    }

    fn receive(&mut self, message: &Value) {
        for channel in message["channels"].as_array().into_iter().flatten() {
            let one = json!({ "id": self.channels.len(), "channelId": channel["id"] });
            let wish = json!({ "op": "subscribe", "subscriptions": [one] });
            self.socket.send(Message::text(wish.to_string())).expect("a sent message");
            self.channels.push(channel.clone());
        }
    }

    fn counts(&self) -> Vec<(&str, usize)> {
        let of = |channel: &Value| {
            self.messages.get(channel["topic"].as_str().unwrap_or_default()).map_or(0, Vec::len)
        };
        self.channels
            .iter()
            .map(|channel| (channel["topic"].as_str().unwrap_or_default(), of(channel)))
            .collect()
    }

    /// Returns the smallest number of messages per channel. If a channel sends only one message in total, this message
    /// is enough.
    fn min_count(&self) -> usize {
        let once = ["/tf_static", "/front/background"];
        let enough = |(topic, count): (&str, usize)| {
            if once.contains(&topic) && count > 0 { usize::MAX } else { count }
        };
        self.counts().into_iter().map(enough).min().unwrap_or(0)
    }

    fn messages_of(&self, topic: &str) -> &[ChannelMessage] {
        &self.messages[topic]
    }
}

/// Returns whether `value` conforms to `schema`, for the keywords that this project's schemas use: types, enums,
/// properties and items.
pub(crate) fn matches_schema(value: &Value, schema: &Value) -> bool {
    let is = |kind: &Value| match kind.as_str() {
        Some("object") => value.is_object(),
        Some("array") => value.is_array(),
        Some("string") => value.is_string(),
        Some("boolean") => value.is_boolean(),
        Some("number") => value.is_number(),
        Some("integer") => value.is_i64() || value.is_u64(),
        Some("null") => value.is_null(),
        _ => false,
    };
    let kinds = schema["type"].as_array().cloned().unwrap_or_else(|| vec![schema["type"].clone()]);
    let properties = schema["properties"].as_object().into_iter().flatten();
    let words = schema["enum"].as_array();
    kinds.iter().any(is)
        && words.is_none_or(|words| words.contains(value))
        && properties
            .filter(|_| value.is_object())
            .all(|(key, of)| value.get(key).is_some_and(|it| matches_schema(it, of)))
        && value
            .as_array()
            .into_iter()
            .flatten()
            .all(|item| schema["items"].is_null() || matches_schema(item, &schema["items"]))
}

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 2e-6 * b.abs().max(1.0)
}

fn numbers(values: &[Told]) -> Vec<f64> {
    values
        .iter()
        .map(|value| if let Told::Number(number) = value { *number } else { panic!("a number") })
        .collect()
}

/// Returns the ranges of a line in meters, with `None` for a beam without a range.
fn ranges_m(line: &Value, unit: &str, in_m: f64) -> Vec<Option<f64>> {
    let unit = line[unit].as_f64().expect("a unit") * in_m;
    line["ranges"].as_array().expect("ranges").iter().map(|range| Some(range.as_f64()? * unit)).collect()
}

fn angle_rad(line: &Value, beam: usize) -> f64 {
    let degrees = |key: &str| line[key].as_f64().expect("an angle");
    (degrees("first_angle_deg") + beam as f64 * degrees("step_deg")).to_radians()
}

/// Returns the lines of `class`, by the wall-clock stamp of their samples.
fn by_stamp(lines: &Outcome, class: &str) -> HashMap<u64, Value> {
    let lines = lines.of_class(class).into_iter();
    lines.filter_map(|line| Some((line["wall_ns"].as_u64()?, line))).collect()
}

/// Asserts that `lines` has a line for more than half of the messages, and that `is_same` returns true for each of
/// these messages and its line. The other messages may have no line, because a reader may miss some samples.
fn check_each_equals_a_line(
    topic: &str,
    messages: &[ChannelMessage],
    lines: &HashMap<u64, Value>,
    is_same: impl Fn(&[u8], &Value) -> bool,
) {
    let matched: Vec<_> =
        messages.iter().filter_map(|(stamp, body)| Some((body, lines.get(stamp)?))).collect();
    assert!(
        matched.len() * 2 > messages.len(),
        "{topic}: {} of {} have a line",
        matched.len(),
        messages.len()
    );
    for (body, line) in matched {
        assert!(is_same(body, line), "{topic}: differs from this line: {line}");
    }
}

fn is_scan(body: &[u8], line: &Value) -> bool {
    let message = read(&LASER_SCAN, body).expect("a LaserScan");
    let ranges = numbers(message.sequence("ranges").expect("ranges"));
    let expected = ranges_m(line, "unit_um", 1e-6);
    let is_range = |(range, printed): (&f64, &Option<f64>)| {
        printed.map_or(!range.is_finite(), |printed| close(*range, printed))
    };
    message.text("header.frame_id") == Some("front")
        && close(message.number("angle_min").expect("an angle"), angle_rad(line, 0))
        && close(message.number("angle_max").expect("an angle"), angle_rad(line, expected.len() - 1))
        && ranges.len() == expected.len()
        && ranges.iter().zip(&expected).all(is_range)
}

/// Returns whether a message has the points of a line of class `foreground`, in the sensor's frame. `scan` is the scan
/// with the angles of the beams.
fn is_foreground(body: &[u8], line: &Value, scan: &Value) -> bool {
    let message = read(&POINT_CLOUD, body).expect("a PointCloud2");
    let bytes: Vec<u8> =
        numbers(message.sequence("data").expect("data")).iter().map(|byte| *byte as u8).collect();
    let step = message.number("point_step").expect("a step") as usize;
    let axis = |bytes: &[u8]| f64::from(f32::from_le_bytes(bytes.try_into().expect("four bytes")));
    let points: Vec<_> = bytes.chunks(step).map(|point| (axis(&point[..4]), axis(&point[4..8]))).collect();
    let beams =
        line["beams"].as_array().expect("beams").iter().map(|beam| beam.as_u64().expect("a beam") as usize);
    let expected: Vec<_> = beams
        .zip(ranges_m(line, "unit_mm", 1e-3))
        .map(|(beam, range)| {
            let (sin, cos) = angle_rad(scan, beam).sin_cos();
            (range.expect("a range") * cos, range.expect("a range") * sin)
        })
        .collect();
    points.len() == expected.len()
        && points.iter().zip(&expected).all(|(a, b)| close(a.0, b.0) && close(a.1, b.1))
}

fn object(body: &[u8]) -> Value {
    serde_json::from_slice(body).expect("JSON")
}

/// Returns all items of `kind` in a SceneUpdate, from all entities.
fn all(update: &Value, kind: &str) -> Vec<Value> {
    let entities = update["entities"].as_array().expect("entities").iter();
    entities.flat_map(|entity| entity[kind].as_array().expect("a list").clone()).collect()
}

fn position_of(of: &Value) -> (f64, f64) {
    (of["x"].as_f64().expect("a number"), of["y"].as_f64().expect("a number"))
}

/// Returns whether both lists have the same positions in the same order.
fn are_same(a: &[(f64, f64)], b: &[(f64, f64)]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| close(a.0, b.0) && close(a.1, b.1))
}

fn list<'a>(line: &'a Value, key: &str) -> impl Iterator<Item = &'a Value> {
    line[key].as_array().expect("a list").iter()
}

/// Compares messages that show the latest state, and not one sample. Each relevant message must equal some line of
/// `class`. If `echo` missed samples, only half of the relevant messages must equal a line.
fn check_each_equals_some_line(
    class: &str,
    messages: &[ChannelMessage],
    outcome: &Outcome,
    is_relevant: impl Fn(&Value) -> bool,
    is_same: impl Fn(&Value, &Value) -> bool,
) {
    let (lines, summaries) = (outcome.of_class(class), outcome.of_class("summary"));
    let missed = summaries.iter().find(|line| line["topic"] == class).map(|line| number(line, "missed"));
    let messages: Vec<_> = messages.iter().map(|(_, body)| object(body)).filter(is_relevant).collect();
    assert!(!messages.is_empty(), "{class}: no lines");
    let missing: Vec<_> =
        messages.iter().filter(|update| !lines.iter().any(|line| is_same(update, line))).collect();
    let may_miss = if missed == Some(0) { 0 } else { messages.len() / 2 };
    assert!(missing.len() <= may_miss, "{class}: {missed:?} missed, and no line contains {missing:?}");
}

fn are_same_marks(message: &Value, line: &Value) -> bool {
    let spheres = all(message, "spheres");
    let positions: Vec<_> = spheres.iter().map(|sphere| position_of(&sphere["pose"]["position"])).collect();
    let of_mark = |mark: &Value| {
        let (angle, range) = (mark["angle_deg"].as_f64(), mark["range_mm"].as_f64());
        let (x, y) = pose().point_mm(angle.expect("an angle").to_radians(), range.expect("a range"));
        (x / 1e3, y / 1e3)
    };
    are_same(&positions, &list(line, "marks").map(of_mark).collect::<Vec<_>>())
}

fn are_same_lines(message: &Value, line: &Value) -> bool {
    let ends: Vec<_> = all(message, "lines")
        .iter()
        .flat_map(|one| list(one, "points").map(position_of).collect::<Vec<_>>())
        .collect();
    let corners: Vec<_> =
        all(message, "spheres").iter().map(|one| position_of(&one["pose"]["position"])).collect();
    let end = |one: &Value, x: &str, y: &str| {
        (one[x].as_f64().expect("a number"), one[y].as_f64().expect("a number"))
    };
    let expected: Vec<_> =
        list(line, "lines").flat_map(|one| [end(one, "x1_m", "y1_m"), end(one, "x2_m", "y2_m")]).collect();
    let expected_corners: Vec<_> = list(line, "corners").map(|one| end(one, "x_m", "y_m")).collect();
    are_same(&ends, &expected) && are_same(&corners, &expected_corners)
}

fn are_same_zones(message: &Value, line: &Value) -> bool {
    let metadata = |entity: &Value, key: &str| {
        let mut all = entity["metadata"].as_array().expect("a list").iter();
        all.find(|one| one["key"] == key).map(|one| one["value"].as_str().expect("a string").to_owned())
    };
    let entities = list(message, "entities")
        .filter(|entity| !entity["cylinders"].as_array().expect("a list").is_empty());
    let circles: Vec<_> =
        entities.map(|entity| (metadata(entity, "radius_m"), metadata(entity, "verdict"))).collect();
    let innermost = list(line, "zones").map(|zone| zone["radius_mm"].as_u64()).min().flatten();
    let expected = list(line, "zones").map(|zone| {
        let verdict = match (zone["violated"].as_bool(), zone["radius_mm"].as_u64() == innermost) {
            (Some(false), _) => "clear",
            (_, true) => "stop",
            (_, false) => "slow",
        };
        let radius_m = zone["radius_mm"].as_f64().map(|radius| format!("{:.3}", radius / 1e3));
        (radius_m, Some(verdict.to_owned()))
    });
    circles == expected.collect::<Vec<_>>()
}

fn is_same_status(message: &Value, line: &Value) -> bool {
    let keys = ["state", "family", "model", "port", "damaged", "lost_on_line"];
    message["name"] == line["sensor"]
        && keys.iter().all(|key| message[*key] == line[*key])
        && ["x_m", "y_m", "yaw_rad", "upside_down"]
            .iter()
            .all(|key| message["pose"][*key] == line["pose"][*key])
}

fn is_background(body: &[u8], line: &Value) -> bool {
    let message = read(&LASER_SCAN, body).expect("a LaserScan");
    let ranges = numbers(message.sequence("ranges").expect("ranges"));
    let expected = ranges_m(line, "unit_mm", 1e-3);
    let far: Vec<_> = list(line, "far").filter_map(Value::as_u64).collect();
    let is_range = |(beam, (range, printed)): (usize, (&f64, &Option<f64>))| match printed {
        Some(printed) => close(*range, *printed),
        None if far.contains(&(beam as u64)) => *range == f64::INFINITY,
        None => range.is_nan(),
    };
    ranges.len() == expected.len() && ranges.iter().zip(&expected).enumerate().all(is_range)
}

fn compare(viewer: &Viewer, outcome: &Outcome) {
    for channel in &viewer.channels {
        let (topic, encoding) = (channel["topic"].as_str().expect("a string"), &channel["encoding"]);
        if encoding == "json" {
            let schema: Value =
                serde_json::from_str(channel["schema"].as_str().expect("a string")).expect("JSON");
            for (_, body) in viewer.messages_of(topic) {
                assert!(matches_schema(&object(body), &schema), "{topic}: {}", object(body));
            }
        } else {
            assert_eq!((encoding, &channel["schemaEncoding"]), (&"cdr".into(), &"ros2msg".into()), "{topic}");
        }
    }
    let scans = by_stamp(outcome, "scan");
    check_each_equals_a_line("scan", viewer.messages_of("/front/scan"), &scans, is_scan);
    let found = by_stamp(outcome, "foreground");
    check_each_equals_a_line("foreground", viewer.messages_of("/front/foreground"), &found, |body, line| {
        let stamp = line["wall_ns"].as_u64().expect("a stamp");
        scans.get(&stamp).is_none_or(|scan| is_foreground(body, line, scan))
    });
    check_each_equals_some_line(
        "marks",
        viewer.messages_of("/marks"),
        outcome,
        |update| !all(update, "spheres").is_empty(),
        are_same_marks,
    );
    check_each_equals_some_line(
        "lines",
        viewer.messages_of("/lines"),
        outcome,
        |update| !all(update, "lines").is_empty(),
        are_same_lines,
    );
    check_each_equals_some_line(
        "zones",
        viewer.messages_of("/zones"),
        outcome,
        |update| !all(update, "cylinders").is_empty(),
        are_same_zones,
    );
    let has_status = |update: &Value| update["state"] != "no status";
    check_each_equals_some_line(
        "status",
        viewer.messages_of("/front/status"),
        outcome,
        has_status,
        is_same_status,
    );
    let models = outcome.of_class("background");
    for (_, body) in viewer.messages_of("/front/background") {
        assert!(models.iter().any(|line| is_background(body, line)), "background: no line is equal");
    }
    let verdicts = outcome.of_class("zones");
    let robot: Vec<_> = viewer.messages_of("/robot").iter().map(|(_, body)| object(body)).collect();
    assert!(robot.iter().any(|update| update["hub"] == true), "{robot:?}");
    for update in robot.iter().filter(|update| update["verdict"] != "unknown") {
        assert!(verdicts.iter().any(|line| line["verdict"] == update["verdict"]), "{update}");
    }
    let decoded = read(&TF_MESSAGE, &viewer.messages_of("/tf_static").last().expect("a message").1)
        .expect("a TFMessage");
    let number = |path: &str| decoded.number(&format!("transforms.0.transform.{path}")).expect("a number");
    assert!(close(number("translation.x"), SENSOR_POSE.0) && close(number("translation.y"), SENSOR_POSE.1));
    assert!(close(number("rotation.z"), (SENSOR_POSE.2 / 2.0).sin()));
}

#[test]
fn every_channel_equals_the_output_of_echo() {
    let env = TestEnv::new();
    let world = format!("--world={}", env.file("world", WORLD));
    let _sensor = env.simulator(&["front"], &["--seed=71", "--baud=500000", &world]);
    let places = [("x", SENSOR_POSE.0), ("y", SENSOR_POSE.1), ("yaw", SENSOR_POSE.2)];
    let places = places.map(|(key, value)| format!("--set=link.front.pose.{key}={value}"));
    let _hub = env.hub(&[&[env.link("front")], &places[..]].concat());
    env.await_info("front", |info| info["state"] == "streaming");
    let topics = TOPICS.map(|topic| format!("front/{topic}"));
    let mut echo = env.echo(&topics.each_ref().map(String::as_str));
    let (_server, host) = web(&env, &[]);
    let viewers = ["foxglove.sdk.v1", "foxglove.websocket.v1"].map(|protocol| {
        let mut viewer = Viewer::new(&host, protocol);
        viewer.receive_messages(5);
        viewer
    });
    // Wait until `echo` prints later samples. It has then printed all samples that the viewers have received.
    let now = wall_ns();
    for class in ["scan", "foreground", "marks", "zones", "lines"] {
        echo.await_line(class, |line| line["class"] == class && line["wall_ns"].as_u64() > Some(now));
    }
    echo.await_line("status", is_class("status"));
    let outcome = echo.end(INT);
    viewers.iter().for_each(|viewer| compare(viewer, &outcome));
}
