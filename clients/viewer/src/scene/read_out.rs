//! What is under a pointer: a place, and if a point is near it, whose that is and what its beam measured. The words are the
//! same in every picture.

use super::{Point, Sensor};

/// A place that somebody points at.
#[derive(Clone, Copy, Debug)]
pub struct Place<'a> {
    /// Metres ahead of the robot's centre; of the point that is read, if there is one.
    pub x_m: f64,
    /// Metres to the left of it.
    pub y_m: f64,
    /// What a beam measured there.
    pub reading: Option<Reading<'a>>,
}

/// A point that somebody points at.
#[derive(Clone, Copy, Debug)]
pub struct Reading<'a> {
    /// Whose it is.
    pub sensor: &'a Sensor,
    /// The point, in the robot's frame.
    pub point: Point,
    /// Angle of its beam in the sensor's frame, in radians.
    pub angle_rad: f64,
    /// What that beam measured, in metres.
    pub range_m: f64,
}

impl<'a> Place<'a> {
    /// What is at `at_m`, metres ahead and to the left: the nearest point of `sensors`, if one is within `within_m`.
    pub fn of(sensors: impl Iterator<Item = &'a Sensor>, at_m: (f64, f64), within_m: f64) -> Place<'a> {
        let reading = nearest(sensors, at_m, within_m);
        let (x_m, y_m) = reading.map_or(at_m, |reading| (reading.point.x_m, reading.point.y_m));
        Place { x_m, y_m, reading }
    }

    /// Its distance from the robot's centre in metres.
    pub fn distance_m(&self) -> f64 {
        self.x_m.hypot(self.y_m)
    }

    /// What to say about it, the most needed first: distance and coordinates, and of a point the sensor with angle and range,
    /// and the intensity.
    pub fn words(&self) -> Vec<String> {
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

/// `value` with so many digits behind the point; what rounds to nothing has no sign.
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
    fn the_nearest_point_is_read() {
        let mut scene = Scene::default();
        for (name, x_m) in [("front", 0.0), ("ahead", 1.0)] {
            let sensor = scene.sensor(name);
            let pose = Pose { x_m, ..Pose::default() };
            sensor.take_status(&Status { pose, ..Status::default() });
            let scan = Scan::of(ScanHead::lms(3, -90_000, 90_000, 1, 13), &[2000, 4000, 2000]);
            sensor.take_scan(&Header::default(), &scan, 0);
        }
        let read = |at_m| Place::of(scene.sensors.iter(), at_m, 0.5);
        let place = read((4.8, 0.1));
        let reading = place.reading.unwrap();
        assert_eq!((&reading.sensor.name[..], reading.point.beam, reading.range_m), ("ahead", 1, 4.0));
        assert_eq!(
            place.words(),
            ["5.00 m from the robot", "x 5.00  y 0.00 m", "ahead: 0.00\u{b0}, 4.000 m"]
        );
        let left = read((0.1, 2.0)).reading.unwrap();
        assert_eq!((&left.sensor.name[..], left.point.beam), ("front", 2));
        assert!((left.angle_rad.to_degrees() - 90.0).abs() < 1e-6);
        let nowhere = read((2.0, -2.0));
        assert!(nowhere.reading.is_none());
        assert_eq!(nowhere.words(), ["2.83 m from the robot", "x 2.00  y -2.00 m"]);
    }

    #[test]
    fn what_rounds_to_nothing_has_no_sign() {
        assert_eq!([fixed(-0.004, 2), fixed(-0.006, 2), fixed(0.0, 3)], ["0.00", "-0.01", "0.000"]);
    }
}
