//! Contents of every picture of the robot: points in the robot's frame, circles with their verdict, people, and the
//! state of each sensor with rate, age and losses. The terminal and the browser draw the same scene, so they always
//! agree. Callers pass the time.

mod people;
mod pointer;
mod sensor;

use scanhub_schema::{Header, Pose, Tracks, Verdict, Zone, is_remote};

pub use people::{Ellipse, People, Person, rooms};
pub use pointer::{PointerPosition, Reading};
pub use sensor::{Problem, RateMeter, Sensor, SensorPlacement, Trail};

/// End of a beam, in the robot's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Meters ahead of the robot's center.
    pub x_m: f64,
    /// Meters to the left of the robot's center.
    pub y_m: f64,
    /// Index of the beam in its scan.
    pub beam: usize,
    /// Intensity of the echo in the sensor's own units, if the sensor measures intensities.
    pub intensity: Option<u16>,
    /// Whether the point is part of the foreground.
    pub is_foreground: bool,
}

impl Point {
    /// Returns the distance from the robot's center in meters.
    pub fn distance_m(&self) -> f64 {
        self.x_m.hypot(self.y_m)
    }
}

fn point_m(pose: &Pose, angle: f64, range_mm: f64) -> (f64, f64) {
    let (x, y) = pose.point_mm(angle, range_mm);
    (x / 1000.0, y / 1000.0)
}

/// The last sample of each topic of all sensors and trackers.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    /// Sensors in the order in which the user or the hub named them.
    pub sensors: Vec<Sensor>,
    /// People of each tracker, by the tracker's name.
    pub trackers: Vec<(String, People)>,
    /// Whether a hub runs.
    pub hub_is_running: bool,
    /// Process ID of the hub; 0 if it is unknown, or if the hub runs on another machine.
    pub hub_pid: u32,
    /// CPU time of the hub in percent of one processor.
    pub hub_percent: Option<f64>,
}

impl Scene {
    /// Returns the sensor with this name, and adds it if it is new.
    pub fn sensor(&mut self, name: &str) -> &mut Sensor {
        let at = self.sensors.iter().position(|sensor| sensor.name == name).unwrap_or_else(|| {
            self.sensors.push(Sensor::new(name));
            self.sensors.len() - 1
        });
        &mut self.sensors[at]
    }

    /// Returns the sensor `name`, from which a sample with this `header` arrived. A sample with a header shows that a
    /// hub runs. The header of a local sensor's sample has the process ID of the hub.
    pub fn sensor_of_sample(&mut self, name: &str, header: Option<&Header>) -> &mut Sensor {
        if let Some(header) = header {
            self.hub_is_running = true;
            if !is_remote(name) {
                self.hub_pid = header.hub_pid;
            }
        }
        self.sensor(name)
    }

    /// Stores the people of the tracker `name`, which arrived at `now_ns`, and the poses of the tracker's sensors. From
    /// then on, these sensors are shown in the tracker's map, unless another tracker sends other poses.
    pub fn take_tracks(&mut self, name: &str, tracks: &Tracks, now_ns: u64) {
        let at = self.trackers.iter().position(|(known, _)| known == name).unwrap_or_else(|| {
            self.trackers.push((name.to_owned(), People::default()));
            self.trackers.len() - 1
        });
        self.trackers[at].1.take(tracks, now_ns);
        for placed in tracks.sensors() {
            if let Some(sensor) = self.sensors.iter_mut().find(|sensor| sensor.name == placed.name()) {
                sensor.placement = SensorPlacement::InMap(placed.pose());
            }
        }
    }

    /// Returns the people of all trackers, without tentative tracks.
    pub fn people(&self) -> impl Iterator<Item = &Person> {
        self.trackers.iter().flat_map(|(_, people)| people.known())
    }

    /// Returns whether the picture is the map of a site. This is the case if a tracker has sent poses of sensors in its
    /// map.
    pub fn is_in_map(&self) -> bool {
        self.sensors.iter().any(|sensor| sensor.placement.is_in_map())
    }

    /// Returns the sensors of the robot with their indices, or all sensors if all are remote. Remote sensors belong to
    /// other robots.
    pub fn robot(&self) -> impl Iterator<Item = (usize, &Sensor)> {
        let has_own = self.sensors.iter().any(|sensor| !is_remote(&sensor.name));
        self.sensors.iter().enumerate().filter(move |(_, sensor)| !has_own || !is_remote(&sensor.name))
    }

    /// Deletes scans, trails and people that are too old at `now_ns`. Returns whether any were deleted.
    pub fn expire(&mut self, now_ns: u64) -> bool {
        let mut any = false;
        for sensor in &mut self.sensors {
            any |= sensor.expire(now_ns);
        }
        for (_, people) in &mut self.trackers {
            any |= people.expire(now_ns);
        }
        any
    }

    /// Deletes the line features, because they are no longer shown.
    pub fn delete_lines(&mut self) {
        self.sensors.iter_mut().for_each(|sensor| sensor.lines = None);
    }

    /// Deletes all data of a hub that has exited. The background stays, because it is used only for drawing.
    pub fn on_hub_exit(&mut self) {
        (self.hub_is_running, self.hub_pid, self.hub_percent) = (false, 0, None);
        self.trackers.clear();
        self.sensors.iter_mut().for_each(Sensor::on_hub_exit);
    }
}

/// Returns the worst verdict of `sensors`, the first sensor with this verdict, and the smallest distance between a
/// point and the robot's center in mm. Without sensors, the verdict is unknown.
pub fn verdict<'a>(sensors: impl Iterator<Item = &'a Sensor>) -> (Verdict, Option<&'a str>, Option<u32>) {
    let (mut worst, mut nearest): (Option<(Verdict, &str)>, Option<u32>) = (None, None);
    for sensor in sensors {
        let verdict = sensor.zones.verdict();
        if worst.is_none_or(|(worst, _)| worst != verdict && worst.worse(verdict) == verdict) {
            worst = Some((verdict, &sensor.name));
        }
        let here = sensor.zones.nearest().map(|(_, mm)| mm);
        nearest = nearest.into_iter().chain(here).min();
    }
    (worst.map_or(Verdict::Unknown, |(verdict, _)| verdict), worst.map(|(_, name)| name), nearest)
}

/// A zone of the robot: a circle around the robot's center. The hub decides whether a circle is violated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Circle {
    /// Radius in meters.
    pub radius_m: f64,
    /// Worst verdict of all sensors for this circle: clear while the circle is not violated, and stop if the innermost
    /// circle is violated.
    pub verdict: Verdict,
}

impl Circle {
    /// Returns whether enough beams of enough scans end inside the circle.
    pub fn is_violated(&self) -> bool {
        self.verdict != Verdict::Clear
    }

    /// Returns the points of `sensor` inside the circle, if this sensor reports a violation of the circle.
    pub fn inside<'a>(&self, sensor: &'a Sensor) -> impl Iterator<Item = Point> + use<'a> {
        let radius_m = self.radius_m;
        let own = |zone: &&Zone| f64::from(zone.radius_mm) / 1000.0 == radius_m;
        let zone = sensor.zones.zones().iter().find(own).filter(|_| !sensor.placement.is_in_map());
        let is_violated = zone.is_some_and(|zone| zone.violated != 0);
        let points = is_violated.then(|| sensor.points()).into_iter().flatten();
        points.filter(move |point| point.distance_m() <= radius_m)
    }
}

/// Returns the circles of `sensors` in the order of the sensors, and each circle only once. Sensors in a map have no
/// circles, because the position of the robot's center in the map is unknown.
pub fn circles<'a>(sensors: impl Iterator<Item = &'a Sensor>) -> Vec<Circle> {
    let mut radii: Vec<(u16, bool)> = Vec::new();
    let on_robot = sensors.filter(|sensor| !sensor.placement.is_in_map());
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
    use scanhub_schema::{Scan, ScanHead, Status, Track, TrackSensor, Zones};

    #[test]
    fn deletes_old_scans_and_verdicts_of_an_exited_hub() {
        let mut scene = Scene { hub_is_running: true, ..Scene::default() };
        let sensor = scene.sensor("front");
        sensor.take_scan(&Header { period_us: 500_000, ..Header::default() }, &Box::<Scan>::default(), 7);
        sensor.zones = Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() };
        assert!(!scene.expire(1_500_000_006) && scene.expire(1_500_000_007) && !scene.expire(u64::MAX));
        assert!(scene.sensors[0].scan.is_none());
        let trail = |scene: &Scene| scene.sensors[0].trail.points().count();
        assert_eq!(trail(&scene), 0, "nothing stood before the background");
        assert_eq!(verdict(scene.sensors.iter()).0, Verdict::Clear, "the verdict expires separately");
        scene.on_hub_exit();
        assert_eq!(verdict(scene.sensors.iter()), (Verdict::Unknown, Some("front"), None));
        assert!(!scene.hub_is_running);
    }

    #[test]
    fn tracks_set_the_placement_of_their_sensors() {
        let mut scene = Scene::default();
        scene.sensor("hall");
        let pose = Pose { x_m: 4.0, y_m: 1.0, yaw_rad: 0.5, ..Pose::default() };
        let mut tracks = Tracks::default();
        tracks.push_sensor(TrackSensor::new("hall", &pose));
        tracks.push(Track { id: 5, x_m: 3.0, state: 1, ..Track::default() });
        scene.take_tracks("house", &tracks, 1);
        let status = Status { pose: Pose { x_m: 0.3, ..Pose::default() }, ..Status::default() };
        scene.sensor("hall").take_status(&status);
        assert_eq!(
            scene.sensors[0].placement,
            SensorPlacement::InMap(pose),
            "the pose on a robot does not replace it"
        );
        assert!(scene.people().map(|person| (person.id, person.position)).eq([(5, (3.0, 0.0))]));
        assert_eq!(scene.sensors.len(), 1, "a tracker is not a sensor");
        scene.sensor("rear").take_status(&status);
        assert_eq!(scene.sensors[1].placement, SensorPlacement::OnRobot(status.pose));
        assert!(scene.expire(2_000_000_000) && scene.people().count() == 0);
    }

    #[test]
    fn first_sensor_with_the_worst_verdict_is_named() {
        let mut scene = Scene::default();
        for (name, word, nearest_mm) in [("a", Verdict::Slow, 900), ("b", Verdict::Stop, 300)] {
            scene.sensor(name).zones =
                Zones { verdict: word as u8, nearest_beam: 1, nearest_mm, ..Zones::unknown() };
        }
        scene.sensor("c").zones = scene.sensors[1].zones;
        assert_eq!(verdict(scene.sensors.iter()), (Verdict::Stop, Some("b"), Some(300)));
        assert_eq!(verdict([].iter()), (Verdict::Unknown, None, None));
    }

    #[test]
    fn robot_has_only_sensors_of_the_local_hub() {
        let mut scene = Scene::default();
        scene.sensor("hub1.front");
        assert_eq!(scene.robot().count(), 1);
        scene.sensor("rear");
        assert_eq!(scene.robot().map(|(n, sensor)| (n, &sensor.name[..])).collect::<Vec<_>>(), [(1, "rear")]);
    }

    #[test]
    fn circle_has_worst_verdict_and_the_points_inside() {
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
        let zone_circles = circles(scene.sensors.iter());
        let verdicts: Vec<_> = zone_circles.iter().map(|circle| (circle.radius_m, circle.verdict)).collect();
        assert_eq!(verdicts, [(1.0, Verdict::Slow), (0.5, Verdict::Stop)]);
        let inside = |n: usize, of: usize| {
            zone_circles[n].inside(&scene.sensors[of]).map(|point| point.beam).collect::<Vec<_>>()
        };
        assert_eq!((inside(0, 0), inside(0, 1)), (vec![0, 2], vec![0, 2]));
        assert!(inside(1, 0).is_empty(), "not violated in its view, however near one beam is");
        assert_eq!(inside(1, 1), [0, 2]);
        scene.sensors[1].placement = SensorPlacement::InMap(Pose::default());
        assert_eq!(
            circles(scene.sensors.iter())[1].verdict,
            Verdict::Clear,
            "the other sensor is not on the robot"
        );
        assert_eq!(zone_circles[1].inside(&scene.sensors[1]).count(), 0);
    }
}
