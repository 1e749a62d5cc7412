//! Position under the pointer: its coordinates, and the reading of the nearest point. The text is the same in every
//! picture.

use super::{Point, Sensor};

/// Position under the pointer.
#[derive(Clone, Copy, Debug)]
pub struct PointerPosition<'a> {
    /// Meters ahead of the robot's center. If `reading` is set, this is the coordinate of its point.
    pub x_m: f64,
    /// Meters to the left of the robot's center.
    pub y_m: f64,
    /// Reading of the nearest point, if a point is near enough.
    pub reading: Option<Reading<'a>>,
}

/// A point under the pointer.
#[derive(Clone, Copy, Debug)]
pub struct Reading<'a> {
    /// Sensor that measured the point.
    pub sensor: &'a Sensor,
    /// The point, in the robot's frame.
    pub point: Point,
    /// Angle of the beam in the sensor's frame, in radians.
    pub angle_rad: f64,
    /// Range along the beam, in meters.
    pub range_m: f64,
}

impl<'a> PointerPosition<'a> {
    /// Returns the point of `sensors` that is nearest to `at_m`, if their distance is at most `within_m`, and otherwise
    /// the position `at_m`. `at_m` is in meters ahead and to the left.
    pub fn of(
        sensors: impl Iterator<Item = &'a Sensor>,
        at_m: (f64, f64),
        within_m: f64,
    ) -> PointerPosition<'a> {
        let reading = nearest(sensors, at_m, within_m);
        let (x_m, y_m) = reading.map_or(at_m, |reading| (reading.point.x_m, reading.point.y_m));
        PointerPosition { x_m, y_m, reading }
    }

    /// Returns the distance from the robot's center in meters.
    pub fn distance_m(&self) -> f64 {
        self.x_m.hypot(self.y_m)
    }

    /// Returns lines of text about the position, the most important first: distance and coordinates. For a point, also
    /// sensor, angle, range and intensity.
    pub fn text_lines(&self) -> Vec<String> {
        let mut words = vec![
            format!("{} m from the robot", fixed(self.distance_m(), 2)),
            format!("x {}  y {} m", fixed(self.x_m, 2), fixed(self.y_m, 2)),
        ];
        if let Some(Reading { sensor, point, angle_rad, range_m }) = self.reading {
            let (angle, range) = (fixed(angle_rad.to_degrees(), 2), fixed(range_m, 3));
            words.push(format!("{}: {angle}\u{b0}, {range} m", sensor.name));
            words.extend(point.intensity.map(|intensity| format!("intensity {intensity}")));
        }
        words
    }
}

/// Formats `value` with `digits` decimals, and without the sign of a negative zero.
fn fixed(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    match text.strip_prefix('-') {
        Some(bare) if bare.bytes().all(|byte| b"0.".contains(&byte)) => bare.to_owned(),
        _ => text,
    }
}

fn nearest<'a>(
    sensors: impl Iterator<Item = &'a Sensor>,
    at_m: (f64, f64),
    within_m: f64,
) -> Option<Reading<'a>> {
    let apart = |point: &Point| (point.x_m - at_m.0).hypot(point.y_m - at_m.1);
    let points = sensors.flat_map(|sensor| sensor.points().map(move |point| (sensor, point)));
    let near = points.filter(|(_, point)| apart(point) <= within_m);
    let (sensor, point) = near.min_by(|(_, a), (_, b)| apart(a).total_cmp(&apart(b)))?;
    let scan = sensor.scan.as_ref()?;
    let range_m = f64::from(scan.distance_mm(point.beam)?) / 1000.0;
    Some(Reading { sensor, point, angle_rad: scan.angle(point.beam), range_m })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Scene;
    use scanhub_schema::{Header, Pose, Scan, ScanHead, Status};

    #[test]
    fn reads_the_nearest_point() {
        let mut scene = Scene::default();
        for (name, x_m) in [("front", 0.0), ("ahead", 1.0)] {
            let sensor = scene.sensor(name);
            let pose = Pose { x_m, ..Pose::default() };
            sensor.take_status(&Status { pose, ..Status::default() });
            let scan = Scan::of(ScanHead::lms(3, -90_000, 90_000, 1, 13), &[2000, 4000, 2000]);
            sensor.take_scan(&Header::default(), &scan, 0);
        }
        let read = |at_m| PointerPosition::of(scene.sensors.iter(), at_m, 0.5);
        let place = read((4.8, 0.1));
        let reading = place.reading.unwrap();
        assert_eq!((&reading.sensor.name[..], reading.point.beam, reading.range_m), ("ahead", 1, 4.0));
        assert_eq!(
            place.text_lines(),
            ["5.00 m from the robot", "x 5.00  y 0.00 m", "ahead: 0.00\u{b0}, 4.000 m"]
        );
        let left = read((0.1, 2.0)).reading.unwrap();
        assert_eq!((&left.sensor.name[..], left.point.beam), ("front", 2));
        assert!((left.angle_rad.to_degrees() - 90.0).abs() < 1e-6);
        let nowhere = read((2.0, -2.0));
        assert!(nowhere.reading.is_none());
        assert_eq!(nowhere.text_lines(), ["2.83 m from the robot", "x 2.00  y -2.00 m"]);
    }

    #[test]
    fn negative_zero_has_no_sign() {
        assert_eq!([fixed(-0.004, 2), fixed(-0.006, 2), fixed(0.0, 3)], ["0.00", "-0.01", "0.000"]);
    }
}
