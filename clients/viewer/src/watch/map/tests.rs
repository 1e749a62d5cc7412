//! Comparison of the picture in the terminal with the messages for a browser: picture and messages must have the same
//! points. The tests read the messages as the page does.

use crate::server::messages;
use scanhub_ros::{LASER_SCAN, POINT_CLOUD, TF_MESSAGE, Value, read};
use scanhub_schema::{Corner, Header, Line, Lines, Pose, Scan, ScanHead, Status, Track, Tracks};
use serde_json::Value as Json;

use super::super::tests as pictures;
use super::super::view::View;
use super::{Dots, Layers};
use crate::scene::{Scene, Sensor};

/// Returns a scene with two sensors in a room. A third sensor between them is upside down, and has readings in half of
/// its beams. One sensor has line features.
fn scene() -> Scene {
    let mut scene = pictures::scene();
    let side = scene.sensor("side");
    let pose = Pose { x_m: 0.1, y_m: 0.4, yaw_rad: 1.1, upside_down: 1, ..Pose::default() };
    side.take_status(&Status { pose, ..Status::default() });
    let ranges: Vec<u16> = (0..401).map(|n| if n % 2 == 0 { 700 + 3 * n } else { 8190 }).collect();
    side.take_scan(&Header::default(), &Scan::of(ScanHead::lms(401, -50_000, 250, 1, 13), &ranges), 0);
    let mut lines = Lines { count: 2, corners: 1, ..Lines::default() };
    lines.line_array[0] = Line { x1_m: 2.0, y1_m: -1.0, x2_m: 2.0, y2_m: 1.5, ..Line::default() };
    lines.line_array[1] = Line { x1_m: 2.0, y1_m: 1.5, x2_m: -0.5, y2_m: 1.5, ..Line::default() };
    lines.corner_array[0] = Corner { x_m: 2.0, y_m: 1.5, ..Corner::default() };
    scene.sensor("front").lines = Some(Box::new(lines));
    // Add a person who walks and is seen, one who is not seen, and a tentative track.
    let mut tracks = Tracks::default();
    for (id, state) in [(7, 1), (8, 2), (9, 0)] {
        tracks.push(Track { id, state, x_m: 1.0, y_m: id as f32 - 7.5, ..Track::default() });
    }
    for n in 0..9 {
        tracks.track_array[0].x_m += 0.2;
        scene.take_tracks("house", &tracks, n * 200_000_000);
    }
    scene
}

/// Transform from the frame of a sensor to the robot's, from the pose in the message, as the page uses it.
struct SensorTransform(Vec<f64>);

impl SensorTransform {
    fn of(scene: &Scene, sensor: &Sensor) -> SensorTransform {
        let message = read(&TF_MESSAGE, &messages::transforms(scene, 1)).unwrap();
        let all = message.sequence("transforms").unwrap();
        let one = all.iter().find(|one| one.text("child_frame_id") == Some(&sensor.name)).unwrap();
        let keys = ["translation.x", "translation.y", "rotation.x", "rotation.y", "rotation.z", "rotation.w"];
        SensorTransform(keys.iter().map(|key| one.number(&format!("transform.{key}")).unwrap()).collect())
    }

    /// Transforms a point to meters ahead and to the left, in the robot's frame.
    fn point(&self, (x, y): (f64, f64)) -> (f64, f64) {
        let [dx, dy, qx, qy, qz, qw] = self.0[..] else { panic!("six numbers") };
        let ahead = (1.0 - 2.0 * (qy * qy + qz * qz)) * x + 2.0 * (qx * qy - qz * qw) * y;
        let left = 2.0 * (qx * qy + qz * qw) * x + (1.0 - 2.0 * (qx * qx + qz * qz)) * y;
        (ahead + dx, left + dy)
    }
}

/// Returns the points of a LaserScan.
fn points(message: &[u8], placed: &SensorTransform) -> Vec<(f64, f64)> {
    let scan = read(&LASER_SCAN, message).unwrap();
    let (first, step) = (scan.number("angle_min").unwrap(), scan.number("angle_increment").unwrap());
    let ranges = scan.sequence("ranges").unwrap().iter().enumerate();
    let point = |(i, range): (usize, &Value)| {
        let Value::Number(range) = range else { panic!("a number") };
        let (sin, cos) = (first + i as f64 * step).sin_cos();
        range.is_finite().then(|| placed.point((range * cos, range * sin)))
    };
    ranges.filter_map(point).collect()
}

fn cloud(message: &[u8], placed: &SensorTransform) -> Vec<(f64, f64)> {
    let decoded = read(&POINT_CLOUD, message).unwrap();
    let byte = |value: &Value| if let Value::Number(byte) = value { *byte as u8 } else { panic!("a byte") };
    let bytes: Vec<u8> = decoded.sequence("data").unwrap().iter().map(byte).collect();
    let axis = |bytes: &[u8]| f64::from(f32::from_le_bytes(bytes.try_into().unwrap()));
    bytes.chunks(12).map(|point| placed.point((axis(&point[..4]), axis(&point[4..8])))).collect()
}

fn positions<'a>(of: impl Iterator<Item = &'a Json>) -> Vec<(f64, f64)> {
    of.map(|one| (one["x"].as_f64().unwrap(), one["y"].as_f64().unwrap())).collect()
}

fn entities(message: &[u8]) -> Vec<Json> {
    let update: Json = serde_json::from_slice(message).unwrap();
    update["entities"].as_array().unwrap().clone()
}

fn primitives<'a>(entities: &'a [Json], kind: &str) -> Vec<&'a Json> {
    entities.iter().flat_map(|entity| entity[kind].as_array().unwrap()).collect()
}

/// Asserts that the points in `sent` and in `drawn` are the same. `sent` is in the robot's frame, and `drawn` has the
/// coordinates to the right and up.
fn assert_same_points(kind: &str, sent: Vec<(f64, f64)>, drawn: &Dots) {
    assert!(
        !sent.is_empty() && sent.len() == drawn.len(),
        "{kind}: {} sent, {} drawn",
        sent.len(),
        drawn.len()
    );
    for (ahead, left) in sent {
        let apart = |(right, up): &(f64, f64)| (up - ahead).hypot(right + left);
        let nearest = drawn.iter().map(apart).fold(f64::INFINITY, f64::min);
        assert!(
            nearest < 0.0005,
            "{kind}: nothing is drawn at {ahead}, {left}, the nearest {nearest} m away"
        );
    }
}

#[test]
fn browser_and_terminal_draw_the_same_scene() {
    let scene = scene();
    let view = View { lines: true, dot_m: 0.01, ..View::new(true) };
    let layers = Layers::new(&scene, &view);
    let (mut scans, mut found, mut models) = (Vec::new(), Vec::new(), Vec::new());
    for sensor in &scene.sensors {
        let placed = SensorTransform::of(&scene, sensor);
        let (scan, mut message) = (sensor.scan.as_ref().unwrap(), Vec::new());
        scanhub_ros::laser_scan(&mut message, scanhub_ros::frame(&sensor.name), &Header::default(), scan);
        scans.extend(points(&message, &placed));
        if let (Some(foreground), Some(model)) = (&sensor.foreground, &sensor.background) {
            message.clear();
            scanhub_ros::foreground_cloud(&mut message, "front", &Header::default(), scan, foreground);
            found.extend(cloud(&message, &placed));
            message.clear();
            messages::background(&mut message, &sensor.name, 1, model);
            models.extend(points(&message, &placed));
        }
    }
    // For a beam in the foreground, the terminal draws only one point. The browser draws a point of the scan, and a
    // point of the foreground on top.
    let drawn: Dots = layers.walls.iter().flatten().chain(&layers.foreground).copied().collect();
    assert_same_points("scans", scans, &drawn);
    assert_same_points("foreground", found, &layers.foreground);
    assert_same_points("background", models, &layers.background);

    let marks = entities(&messages::marks(&scene, 1));
    assert_same_points(
        "marks",
        positions(primitives(&marks, "spheres").iter().map(|one| &one["pose"]["position"])),
        &layers.marks,
    );
    let lines = entities(&messages::lines(&scene, 1));
    let ends =
        positions(primitives(&lines, "lines").iter().flat_map(|one| one["points"].as_array().unwrap()));
    assert_eq!(ends.len(), 4);
    for (ahead, left) in ends {
        let is_end = |(right, up): &(f64, f64)| (up - ahead).hypot(right + left) < 1e-6;
        assert!(layers.lines.iter().any(is_end), "{ahead}, {left}");
    }
    assert_same_points(
        "corners",
        positions(primitives(&lines, "spheres").iter().map(|one| &one["pose"]["position"])),
        &layers.corners,
    );

    let people = entities(&messages::tracks(&scene.trackers[0].1, 1));
    let mut tails = Vec::new();
    for (entity, (right, up, number)) in people.iter().zip(&layers.people) {
        let [at, word] = [&entity["cylinders"][0], &entity["texts"][0]];
        let position = positions([&at["pose"]["position"]].into_iter())[0];
        assert!(
            (up - position.0).hypot(right + position.1) < 1e-9,
            "{position:?}, {number} at {right}, {up}"
        );
        let is_seen = at["color"]["a"] == 1.0;
        let text = word["text"].as_str().unwrap();
        assert_eq!(*number, if is_seen { text.to_owned() } else { format!("({text})") });
        // The last position of a tail is the position of the person.
        let line = positions(entity["lines"][0]["points"].as_array().unwrap().iter());
        assert_eq!(line.last(), Some(&position));
        tails.extend(line.into_iter().rev().skip(1));
    }
    assert_eq!((people.len(), layers.people.len()), (2, 2));
    assert_same_points("tails", tails, &layers.tails);

    let zones = entities(&messages::zones(&scene, 1));
    let circle = |entity: &Json| {
        let metadata = |key: &str| {
            let all = entity["metadata"].as_array().unwrap();
            all.iter().find(|one| one["key"] == key).map(|one| one["value"].as_str().unwrap().to_owned())
        };
        let is_circle = !entity["cylinders"].as_array().unwrap().is_empty();
        is_circle.then(|| {
            let sign = if metadata("verdict").unwrap() == "clear" { "" } else { "!" };
            format!("{:.2}{sign}", metadata("radius_m").unwrap().parse::<f64>().unwrap())
        })
    };
    let sent: Vec<_> = zones.iter().filter_map(circle).collect();
    let drawn: Vec<_> =
        layers.circles.iter().map(|circle| circle.label.as_ref().unwrap().2.clone()).collect();
    assert_eq!((sent.len(), sent), (2, drawn));
    // The beam in the message of circles ends at a drawn point.
    let beams = primitives(&zones, "lines");
    let ends = positions(beams.iter().map(|one| &one["points"][1]));
    assert_eq!(ends.len(), 1);
    let points: Dots = layers.walls.iter().flatten().chain(&layers.foreground).copied().collect();
    let is_there =
        |(ahead, left): (f64, f64)| points.iter().any(|(right, up)| (up - ahead).hypot(right + left) < 1e-6);
    assert!(is_there(ends[0]), "{ends:?}");
    for (n, sensor) in scene.sensors.iter().enumerate() {
        let (ahead, left) = SensorTransform::of(&scene, sensor).point((0.0, 0.0));
        let (right, up, number) = &layers.sensors[n];
        assert!((up - ahead).hypot(right + left) < 1e-9 && *number == (n + 1).to_string());
    }
}
