//! What is known of the robot and its surroundings: the last sample of each topic of each sensor. Time is an argument.

use scanhub_schema::{
    Background, Counter, Flags, Foreground, Header, Lines, Mark, Marks, Scan, State, Status, Tracks, Verdict,
    Zones, is_remote,
};

use super::meter::Meter;
use super::mount::Mount;
use super::people::{People, Person};
use super::trail::Trail;
use super::trouble::{Trouble, trouble};
use super::{Point, point_m};

/// All that a picture is made of.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    /// In the order in which they were named, or of the hub.
    pub sensors: Vec<Sensor>,
    /// People of each tracker that is followed, by its name.
    pub trackers: Vec<(String, People)>,
    /// A hub lives.
    pub hub_lives: bool,
    /// Its process; 0 unknown, or on another machine.
    pub hub_pid: u32,
    /// What it uses, in percent of one processor.
    pub hub_percent: Option<f64>,
}

/// What is known of one sensor.
#[derive(Clone, Debug)]
pub struct Sensor {
    /// Its name; a remote one's begins with its machine's.
    pub name: String,
    /// How its link is, as it was said last.
    pub status: Option<Status>,
    /// Where it sits.
    pub mount: Mount,
    /// The last scan, as long as it is new.
    pub scan: Option<Box<Scan>>,
    /// What stands before the background.
    pub foreground: Option<Box<Foreground>>,
    /// Where that was over the last moments.
    pub trail: Trail,
    /// The straight surfaces of the last scan, if somebody asks for them.
    pub lines: Option<Box<Lines>>,
    /// The reflectors, where the sensor can see such.
    pub marks: Option<Marks>,
    /// What it has learned to be always there.
    pub background: Option<Box<Background>>,
    /// Unknown in a silence.
    pub zones: Zones,
    /// Rate and age of its scans.
    pub meter: Meter,
    /// Scans that were sent and not received here.
    pub lost: u64,
    /// The most that came back over the last minutes, in the sensor's units.
    brightest: f64,
    /// The telegrams of scan and foreground.
    scan_of: u64,
    foreground_of: u64,
    /// When the scan is too old to be shown as what is there, in ns of CLOCK_MONOTONIC.
    old_at_ns: u64,
    /// Flags of the header of the last scan.
    flags: u8,
}

impl Scene {
    /// The sensor called `name`, which is known from now on.
    pub fn sensor(&mut self, name: &str) -> &mut Sensor {
        let at = self.sensors.iter().position(|sensor| sensor.name == name).unwrap_or_else(|| {
            self.sensors.push(Sensor::new(name));
            self.sensors.len() - 1
        });
        &mut self.sensors[at]
    }

    /// A sample of the sensor called `name` came: if it has a header, a hub lives, and unless the sensor is of another machine,
    /// it is the process that the header names.
    pub fn heard(&mut self, name: &str, header: Option<&Header>) -> &mut Sensor {
        if let Some(header) = header {
            self.hub_lives = true;
            if !is_remote(name) {
                self.hub_pid = header.hub_pid;
            }
        }
        self.sensor(name)
    }

    /// The tracker called `name` said at `now_ns` who is where, and so where its sensors are: what these see is shown in its map
    /// from now on, as long as no other tracker says otherwise.
    pub fn take_tracks(&mut self, name: &str, tracks: &Tracks, now_ns: u64) {
        let at = self.trackers.iter().position(|(known, _)| known == name).unwrap_or_else(|| {
            self.trackers.push((name.to_owned(), People::default()));
            self.trackers.len() - 1
        });
        self.trackers[at].1.take(tracks, now_ns);
        for told in tracks.sensors() {
            if let Some(sensor) = self.sensors.iter_mut().find(|sensor| sensor.name == told.name()) {
                sensor.mount = Mount::InMap(told.pose());
            }
        }
    }

    /// Returns everybody whom any tracker knows.
    pub fn people(&self) -> impl Iterator<Item = &Person> {
        self.trackers.iter().flat_map(|(_, people)| people.known())
    }

    /// Returns whether the picture is the map of a site, because a tracker told where its sensors sit there.
    pub fn is_in_map(&self) -> bool {
        self.sensors.iter().any(|sensor| sensor.mount.is_in_map())
    }

    /// The sensors of the robot, or if there are none, all; with their numbers from 0. Those of other machines sit on other
    /// robots.
    pub fn robot(&self) -> impl Iterator<Item = (usize, &Sensor)> {
        let has_own = self.sensors.iter().any(|sensor| !is_remote(&sensor.name));
        self.sensors.iter().enumerate().filter(move |(_, sensor)| !has_own || !is_remote(&sensor.name))
    }

    /// Forgets scans and trails that are too old at `now_ns`; whether there were any.
    pub fn age(&mut self, now_ns: u64) -> bool {
        let mut any = false;
        for sensor in &mut self.sensors {
            if sensor.scan.is_some() && now_ns >= sensor.old_at_ns {
                (sensor.scan, sensor.foreground) = (None, None);
                (sensor.marks, sensor.lines) = (None, None);
                sensor.meter = Meter::default();
                any = true;
            }
            any |= sensor.trail.age(now_ns);
        }
        for (_, people) in &mut self.trackers {
            any |= people.age(now_ns);
        }
        any
    }

    /// Nobody asks for lines any more.
    pub fn forget_lines(&mut self) {
        self.sensors.iter_mut().for_each(|sensor| sensor.lines = None);
    }

    /// The hub is gone: all of its data is discarded except for the background, which is only drawn.
    pub fn hub_gone(&mut self) {
        (self.hub_lives, self.hub_pid, self.hub_percent) = (false, 0, None);
        self.trackers.clear();
        for sensor in &mut self.sensors {
            let background = sensor.background.take();
            let Sensor { mount, lost, .. } = *sensor;
            *sensor = Sensor { mount, background, lost, ..Sensor::new(&sensor.name) };
        }
    }
}

impl Sensor {
    fn new(name: &str) -> Sensor {
        Sensor {
            name: name.to_owned(),
            status: None,
            mount: Mount::Unknown,
            scan: None,
            foreground: None,
            trail: Trail::default(),
            lines: None,
            marks: None,
            background: None,
            zones: Zones::unknown(),
            meter: Meter::default(),
            lost: 0,
            brightest: 1.0,
            scan_of: 0,
            foreground_of: 0,
            old_at_ns: 0,
            flags: 0,
        }
    }

    /// Returns whether the last scan came from a simulator.
    pub fn is_simulated(&self) -> bool {
        self.flags & Flags::SIMULATED != 0
    }

    /// Returns whether the last scan came from a recording.
    pub fn is_replayed(&self) -> bool {
        self.flags & Flags::REPLAYED != 0
    }

    /// Takes a scan that arrived at `now_ns`.
    pub fn take_scan(&mut self, header: &Header, scan: &Scan, now_ns: u64) {
        self.scan = Some(scan.boxed());
        self.meter.scan(header, now_ns);
        self.old_at_ns = now_ns + OLD_NS.max(3000 * u64::from(header.period_us));
        // What is bright is told over minutes: colours that breathe cannot be read.
        let brightest = scan.intensities().iter().max().map_or(1.0, f64::from);
        self.brightest = brightest.max(FADING * self.brightest).max(1.0);
        self.scan_of = header.seq;
        self.flags = header.flags;
        self.leave_trail(now_ns);
    }

    /// Takes what stands before the background of the scan with this `header`, which arrived at `now_ns`.
    pub fn take_foreground(&mut self, header: &Header, foreground: &Foreground, now_ns: u64) {
        self.foreground = Some(foreground.boxed());
        self.foreground_of = header.seq;
        self.leave_trail(now_ns);
    }

    /// Where the scan and the foreground of one telegram are here, that is a step of the trail.
    fn leave_trail(&mut self, now_ns: u64) {
        if self.scan_of == self.foreground_of && self.foreground.is_some() {
            let mut trail = std::mem::take(&mut self.trail);
            trail.take(now_ns, || {
                let seen = self.points().filter(|point| point.is_foreground);
                seen.map(|point| (point.x_m, point.y_m)).collect()
            });
            self.trail = trail;
        }
    }

    /// How bright a point is that has this `intensity`, from 0 to 1: the root, because most of what is seen is dark.
    pub fn shade(&self, intensity: u16) -> f64 {
        (f64::from(intensity) / self.brightest).min(1.0).sqrt()
    }

    /// Takes how its link is.
    pub fn take_status(&mut self, status: &Status) {
        self.status = Some(*status);
        if !self.mount.is_in_map() {
            self.mount = Mount::OnRobot(status.pose);
        }
    }

    /// What its link is doing, in a word.
    pub fn state(&self) -> &'static str {
        match self.status.map(|status| status.state()) {
            None => "unheard",
            Some(state) => state.map_or("unknown", State::name),
        }
    }

    /// Why nothing comes from it, and what to do about that; nothing as long as its scans come.
    pub fn trouble(&self) -> Option<Trouble> {
        self.scan.is_none().then(|| trouble(&self.name, self.status.as_ref()))
    }

    /// A counter of its link.
    pub fn count(&self, counter: Counter) -> u64 {
        self.status.map_or(0, |status| status.counters[counter])
    }

    /// Its background model is held.
    pub fn is_frozen(&self) -> bool {
        self.background.as_ref().is_some_and(|model| model.is_frozen())
    }

    /// The points of the last scan, in the frame of the picture.
    pub fn points(&self) -> impl Iterator<Item = Point> {
        let placed = self.scan.iter().zip(self.mount.pose());
        placed.flat_map(move |(scan, pose)| {
            (0..scan.beams()).filter_map(move |beam| {
                let (x_m, y_m) = point_m(&pose, scan.angle(beam), f64::from(scan.distance_mm(beam)?));
                let is_foreground =
                    self.foreground.as_ref().is_some_and(|foreground| foreground.contains(beam));
                Some(Point { x_m, y_m, beam, intensity: scan.intensities().get(beam), is_foreground })
            })
        })
    }

    /// The marks of the last scan in metres in the frame of the picture.
    pub fn mark_points(&self) -> Vec<(f64, f64)> {
        let (Some(pose), Some(marks)) = (self.mount.pose(), &self.marks) else { return Vec::new() };
        let angle = |mark: &Mark| (f64::from(mark.angle_mdeg) / 1000.0).to_radians();
        let marks = marks.marks().iter();
        marks.map(|mark| point_m(&pose, angle(mark), f64::from(mark.range_dmm) / 10.0)).collect()
    }

    /// Where its background ends, in metres in the frame of the picture.
    pub fn background_points(&self) -> Vec<(f64, f64)> {
        let (Some(pose), Some(model)) = (self.mount.pose(), &self.background) else { return Vec::new() };
        let taught = |range: &&u16| ![Background::UNTAUGHT, Background::FAR].contains(range);
        let ranges = model.ranges().iter().enumerate().filter(|(_, range)| taught(range));
        let points = ranges.map(|(i, range)| {
            let angle = model.first_angle + i as f64 * model.step;
            point_m(&pose, angle, f64::from(*range) * f64::from(model.unit_um) / 1000.0)
        });
        points.collect()
    }

    /// The lines of the last scan; they are the robot's, and nowhere in a map.
    pub fn lines(&self) -> Option<&Lines> {
        self.lines.as_deref().filter(|_| !self.mount.is_in_map())
    }
}

/// The verdict over `sensors`, whose it is, and the nearest of all points around the robot's centre in mm; unknown
/// without any.
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

/// What is left of the brightest with each scan.
const FADING: f64 = 0.9995;
/// How long the last scan is what is there, at least.
const OLD_NS: u64 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::{ForegroundHead, Pose, ScanHead, Track, TrackSensor};

    #[test]
    fn old_scans_are_forgotten_and_a_hub_that_goes_leaves_nothing_to_act_on() {
        let mut scene = Scene { hub_lives: true, ..Scene::default() };
        let sensor = scene.sensor("front");
        sensor.take_scan(&Header { period_us: 500_000, ..Header::default() }, &Box::<Scan>::default(), 7);
        sensor.zones = Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() };
        assert!(!scene.age(1_500_000_006) && scene.age(1_500_000_007) && !scene.age(u64::MAX));
        assert!(scene.sensors[0].scan.is_none());
        let trail = |scene: &Scene| scene.sensors[0].trail.points().count();
        assert_eq!(trail(&scene), 0, "nothing stood before the background");
        assert_eq!(verdict(scene.sensors.iter()).0, Verdict::Clear, "the verdict has a clock of its own");
        scene.hub_gone();
        assert_eq!(verdict(scene.sensors.iter()), (Verdict::Unknown, Some("front"), None));
        assert!(!scene.hub_lives);
    }

    #[test]
    fn scan_and_foreground_of_one_telegram_leave_a_trail_and_light_is_told_by_the_brightest() {
        let mut scene = Scene::default();
        let sensor = scene.sensor("front");
        let header = |seq| Header { seq, ..Header::default() };
        let scan = Scan::of(ScanHead::lms(9, 0, 1000, 1, 13), &[1000; 9]);
        let mut found = Foreground::of(9);
        found.begin(ForegroundHead { count: 9, ..ForegroundHead::default() }).bits[0] = 0b101;
        sensor.take_scan(&header(4), &scan, 0);
        assert_eq!(sensor.points().count(), 0, "nobody said where it sits");
        sensor.take_status(&Status::default());
        assert_eq!(sensor.points().count(), 9);
        sensor.take_foreground(&header(5), &found, 1);
        assert_eq!(sensor.trail.points().count(), 0, "of another telegram");
        sensor.take_scan(&header(5), &scan, 2);
        assert_eq!(sensor.trail.points().count(), 2);
        assert_eq!((sensor.shade(0), sensor.shade(1), sensor.shade(9)), (0.0, 1.0, 1.0), "none are known");
        sensor.brightest = 400.0;
        assert_eq!((sensor.shade(100), sensor.shade(800)), (0.5, 1.0));
    }

    #[test]
    fn who_follows_a_tracker_sees_its_sensors_in_its_map() {
        let mut scene = Scene::default();
        scene.sensor("hall");
        let pose = Pose { x_m: 4.0, y_m: 1.0, yaw_rad: 0.5, ..Pose::default() };
        let mut tracks = Tracks::default();
        tracks.push_sensor(TrackSensor::new("hall", &pose));
        tracks.push(Track { id: 5, x_m: 3.0, state: 1, ..Track::default() });
        scene.take_tracks("house", &tracks, 1);
        let status = Status { pose: Pose { x_m: 0.3, ..Pose::default() }, ..Status::default() };
        scene.sensor("hall").take_status(&status);
        assert_eq!(scene.sensors[0].mount, Mount::InMap(pose), "its place on a robot is another one");
        assert!(scene.people().map(|person| (person.id, person.place)).eq([(5, (3.0, 0.0))]));
        assert_eq!(scene.sensors.len(), 1, "a tracker is no sensor");
        scene.sensor("rear").take_status(&status);
        assert_eq!(scene.sensors[1].mount, Mount::OnRobot(status.pose));
        assert!(scene.age(2_000_000_000) && scene.people().count() == 0);
    }

    #[test]
    fn the_first_of_the_worst_gives_the_verdict() {
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
    fn sensors_of_other_machines_sit_on_other_robots() {
        let mut scene = Scene::default();
        scene.sensor("hub1.front");
        assert_eq!(scene.robot().count(), 1);
        scene.sensor("rear");
        assert_eq!(scene.robot().map(|(n, sensor)| (n, &sensor.name[..])).collect::<Vec<_>>(), [(1, "rear")]);
    }
}
