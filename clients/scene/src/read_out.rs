//! What is under a pointer: the point that is nearest to it, whose it is, and what its beam measured.

use crate::{Point, Sensor};

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

/// The point of `sensors` that is nearest to `at_m`, metres ahead and to the left, if one is within `within_m`.
pub fn read_out<'a>(
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
    use crate::Scene;
    use schema::{Header, Pose, Scan, ScanHead};

    #[test]
    fn the_nearest_point_is_read() {
        let mut scene = Scene::default();
        for (name, x_m) in [("front", 0.0), ("ahead", 1.0)] {
            let sensor = scene.sensor(name);
            sensor.pose = Pose { x_m, ..Pose::default() };
            let scan = Scan::of(ScanHead::lms(3, -90_000, 90_000, 1, 13), &[2000, 4000, 2000]);
            sensor.take_scan(&Header::default(), &scan, 0);
        }
        let read = |at_m| read_out(scene.sensors.iter(), at_m, 0.5);
        let reading = read((4.8, 0.1)).unwrap();
        assert_eq!((&reading.sensor.name[..], reading.point.beam, reading.range_m), ("ahead", 1, 4.0));
        let left = read((0.1, 2.0)).unwrap();
        assert_eq!((&left.sensor.name[..], left.point.beam), ("front", 2));
        assert!((left.angle_rad.to_degrees() - 90.0).abs() < 1e-6);
        assert!(read((2.0, 2.0)).is_none());
    }
}
