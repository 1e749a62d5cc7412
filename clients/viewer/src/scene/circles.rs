//! The circles around the robot: each once, the worst over all sensors, and what is inside. Refuses to judge: whether a
//! circle is violated is the hub's word.

use scanhub_schema::Verdict;

use super::{Point, Sensor};

/// A circle around the robot's centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Circle {
    /// Its radius in metres.
    pub radius_m: f64,
    /// What it means for the robot: clear as long as it is not violated, and stop if it is the innermost one.
    pub verdict: Verdict,
}

impl Circle {
    /// Something is inside, in enough beams and scans.
    pub fn is_violated(&self) -> bool {
        self.verdict != Verdict::Clear
    }

    /// The points of `sensor` that are inside, if the circle is violated in its view.
    pub fn inside<'a>(&self, sensor: &'a Sensor) -> impl Iterator<Item = Point> + use<'a> {
        let radius_m = self.radius_m;
        let own = |zone: &&scanhub_schema::Zone| f64::from(zone.radius_mm) / 1000.0 == radius_m;
        let zone = sensor.zones.zones().iter().find(own).filter(|_| !sensor.mount.is_in_map());
        let is_violated = zone.is_some_and(|zone| zone.violated != 0);
        let points = is_violated.then(|| sensor.points()).into_iter().flatten();
        points.filter(move |point| point.distance_m() <= radius_m)
    }
}

/// The circles of `sensors`, in the order in which they are met; none of those that are shown in a map, where nobody knows the
/// robot's centre.
pub fn circles<'a>(sensors: impl Iterator<Item = &'a Sensor>) -> Vec<Circle> {
    let mut radii: Vec<(u16, bool)> = Vec::new();
    let on_robot = sensors.filter(|sensor| !sensor.mount.is_in_map());
    for zone in on_robot.flat_map(|sensor| sensor.zones.zones()) {
        match radii.iter_mut().find(|(radius, _)| *radius == zone.radius_mm) {
            Some((_, violated)) => *violated |= zone.violated != 0,
            None => radii.push((zone.radius_mm, zone.violated != 0)),
        }
    }
    let innermost = radii.iter().map(|(radius, _)| *radius).min();
    let circle = |(radius_mm, violated): (u16, bool)| Circle {
        radius_m: f64::from(radius_mm) / 1000.0,
        verdict: match violated {
            false => Verdict::Clear,
            true if Some(radius_mm) == innermost => Verdict::Stop,
            true => Verdict::Slow,
        },
    };
    radii.into_iter().map(circle).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Mount, Scene};
    use scanhub_schema::{Header, Pose, Scan, ScanHead, Status, Zone, Zones};

    #[test]
    fn a_circle_is_as_bad_as_its_worst_sensor_and_shows_what_is_inside() {
        let mut scene = Scene::default();
        for (name, range_mm) in [("front", 900), ("rear", 300)] {
            let mut zones = Zones { count: 2, ..Zones::unknown() };
            for (zone, radius_mm) in zones.zone_array.iter_mut().zip([1000, 500]) {
                *zone = Zone { radius_mm, violated: u8::from(range_mm < radius_mm), ..Zone::default() };
            }
            let sensor = scene.sensor(name);
            sensor.take_status(&Status::default());
            sensor.zones = zones;
            let scan = Scan::of(ScanHead::lms(3, 0, 1000, 1, 13), &[range_mm, 8000, 1]);
            sensor.take_scan(&Header::default(), &scan, 0);
        }
        let told = circles(scene.sensors.iter());
        let verdicts: Vec<_> = told.iter().map(|circle| (circle.radius_m, circle.verdict)).collect();
        assert_eq!(verdicts, [(1.0, Verdict::Slow), (0.5, Verdict::Stop)]);
        let inside = |n: usize, of: usize| {
            told[n].inside(&scene.sensors[of]).map(|point| point.beam).collect::<Vec<_>>()
        };
        assert_eq!((inside(0, 0), inside(0, 1)), (vec![0, 2], vec![0, 2]));
        assert!(inside(1, 0).is_empty(), "not violated in its view, however near one beam is");
        assert_eq!(inside(1, 1), [0, 2]);
        scene.sensors[1].mount = Mount::InMap(Pose::default());
        assert_eq!(
            circles(scene.sensors.iter())[1].verdict,
            Verdict::Clear,
            "the other one is not around the robot"
        );
        assert_eq!(told[1].inside(&scene.sensors[1]).count(), 0);
    }
}
