//! One sensor of a scene: last samples, placement, trail of the foreground, rate and age of the scans, and the reason
//! for a silence. Callers pass the time.

use std::collections::VecDeque;
use std::time::Duration;

use scanhub_schema::{
    Background, Counter, Flags, Foreground, Header, Lines, Mark, Marks, Pose, Scan, State, Status, Zones,
};

use super::{Point, point_m};

/// The last samples of one sensor.
#[derive(Clone, Debug, Default)]
pub struct Sensor {
    /// Name of the sensor. The name of a remote sensor begins with the name of its machine.
    pub name: String,
    /// Last status of the sensor's link.
    pub status: Option<Status>,
    /// Position in the picture.
    pub placement: SensorPlacement,
    /// The last scan, unless it is too old.
    pub scan: Option<Box<Scan>>,
    /// The last foreground, unless it is too old.
    pub foreground: Option<Box<Foreground>>,
    /// Positions of the foreground over the last 1.6 s.
    pub trail: Trail,
    /// Line features of the last scan, while they are shown.
    pub lines: Option<Box<Lines>>,
    /// Reflectors, if the sensor can detect them.
    pub marks: Option<Marks>,
    /// The learned background.
    pub background: Option<Box<Background>>,
    /// The last verdict; unknown during a silence.
    pub zones: Zones,
    /// Rate and age of the scans.
    pub meter: RateMeter,
    /// Number of scans that this program missed.
    pub missed: u64,
    /// Highest intensity of the last minutes, in the sensor's units. This value decreases slowly.
    brightest: f64,
    /// Time from which on the last scan is too old to be shown, in ns of CLOCK_MONOTONIC.
    old_at_ns: u64,
    /// Flags in the header of the last scan.
    flags: u8,
}

impl Sensor {
    pub(super) fn new(name: &str) -> Sensor {
        Sensor { name: name.to_owned(), zones: Zones::unknown(), brightest: 1.0, ..Sensor::default() }
    }

    /// Returns whether the last scan came from a simulator.
    pub fn is_simulated(&self) -> bool {
        self.flags & Flags::SIMULATED != 0
    }

    /// Returns whether the last scan came from a recording.
    pub fn is_replayed(&self) -> bool {
        self.flags & Flags::REPLAYED != 0
    }

    /// Stores a scan that arrived at `now_ns`.
    pub fn take_scan(&mut self, header: &Header, scan: &Scan, now_ns: u64) {
        self.scan = Some(scan.boxed());
        self.meter.scan(header, now_ns);
        self.old_at_ns = now_ns + MAX_SCAN_AGE_NS.max(3000 * u64::from(header.period_us));
        // The highest intensity fades over minutes, because colors that change quickly cannot be read.
        let brightest = scan.intensities().iter().max().map_or(1.0, f64::from);
        self.brightest = brightest.max(BRIGHTNESS_DECAY * self.brightest).max(1.0);
        self.flags = header.flags;
    }

    /// Stores a foreground. The foreground is drawn on the last scan, even if this scan comes from another telegram.
    pub fn take_foreground(&mut self, foreground: &Foreground) {
        self.foreground = Some(foreground.boxed());
    }

    /// Adds a step to the trail, from a scan and its foreground, both of which had arrived at `now_ns`.
    pub fn take_pair(&mut self, scan: &Scan, foreground: &Foreground, now_ns: u64) {
        let Some(pose) = self.placement.pose() else { return };
        self.trail.take(now_ns, || {
            let points = points(scan, Some(foreground), pose).filter(|point| point.is_foreground);
            points.map(|point| (point.x_m, point.y_m)).collect()
        });
    }

    /// Stores the status of the sensor's link. The status has the sensor's pose on the robot.
    pub fn take_status(&mut self, status: &Status) {
        self.status = Some(*status);
        if !self.placement.is_in_map() {
            self.placement = SensorPlacement::OnRobot(status.pose);
        }
    }

    /// Deletes the scan and steps of the trail if they are too old at `now_ns`. Returns whether any were deleted.
    pub(super) fn expire(&mut self, now_ns: u64) -> bool {
        let is_old = self.scan.is_some() && now_ns >= self.old_at_ns;
        if is_old {
            (self.scan, self.foreground) = (None, None);
            (self.marks, self.lines) = (None, None);
            self.meter = RateMeter::default();
        }
        self.trail.expire(now_ns) | is_old
    }

    /// Deletes all data of a hub that has exited. The background stays, because it is used only for drawing.
    pub(super) fn on_hub_exit(&mut self) {
        let background = self.background.take();
        let Sensor { placement, missed, .. } = *self;
        *self = Sensor { placement, background, missed, ..Sensor::new(&self.name) };
    }

    /// Returns the brightness of a point with this `intensity`, from 0 to 1. The brightness is the square root of the
    /// ratio of `intensity` to the highest intensity, because most points are dark.
    pub fn shade(&self, intensity: u16) -> f64 {
        (f64::from(intensity) / self.brightest).min(1.0).sqrt()
    }

    /// Returns the state of the link as text for the user.
    pub fn state(&self) -> &'static str {
        match self.status.map(|status| status.state()) {
            None => "no status",
            Some(state) => state.map_or("unknown", State::name),
        }
    }

    /// Returns the reason why the sensor sends no scans, and the remedy. Returns `None` while scans arrive.
    pub fn problem(&self) -> Option<Problem> {
        self.scan.is_none().then(|| Problem::of_silent(&self.name, self.status.as_ref()))
    }

    /// Returns a counter of the link.
    pub fn count(&self, counter: Counter) -> u64 {
        self.status.map_or(0, |status| status.counters[counter])
    }

    /// Returns whether the background is frozen.
    pub fn is_frozen(&self) -> bool {
        self.background.as_ref().is_some_and(|model| model.is_frozen())
    }

    /// Returns the points of the last scan, in the frame of the picture.
    pub fn points(&self) -> impl Iterator<Item = Point> {
        let placed = self.scan.iter().zip(self.placement.pose());
        placed.flat_map(|(scan, pose)| points(scan, self.foreground.as_deref(), pose))
    }

    /// Returns the marks of the last scan, in meters in the frame of the picture.
    pub fn mark_points(&self) -> Vec<(f64, f64)> {
        let (Some(pose), Some(marks)) = (self.placement.pose(), &self.marks) else { return Vec::new() };
        let angle = |mark: &Mark| (f64::from(mark.angle_mdeg) / 1000.0).to_radians();
        let marks = marks.marks().iter();
        marks.map(|mark| point_m(&pose, angle(mark), f64::from(mark.range_dmm) / 10.0)).collect()
    }

    /// Returns the points of the background, in meters in the frame of the picture.
    pub fn background_points(&self) -> Vec<(f64, f64)> {
        let (Some(pose), Some(model)) = (self.placement.pose(), &self.background) else { return Vec::new() };
        let has_point = |range: &&u16| ![Background::UNKNOWN, Background::FAR].contains(range);
        let ranges = model.ranges().iter().enumerate().filter(|(_, range)| has_point(range));
        let points = ranges.map(|(i, range)| {
            let angle = model.first_angle + i as f64 * model.step;
            point_m(&pose, angle, f64::from(*range) * f64::from(model.unit_um) / 1000.0)
        });
        points.collect()
    }

    /// Returns the line features of the last scan. Line features are in the robot's frame, so a sensor in a map has
    /// none.
    pub fn lines(&self) -> Option<&Lines> {
        self.lines.as_deref().filter(|_| !self.placement.is_in_map())
    }
}

/// Returns the points of `scan`, measured at `pose` in the frame of the picture.
fn points(scan: &Scan, foreground: Option<&Foreground>, pose: Pose) -> impl Iterator<Item = Point> {
    (0..scan.beams()).filter_map(move |beam| {
        let (x_m, y_m) = point_m(&pose, scan.angle(beam), f64::from(scan.distance_mm(beam)?));
        let is_foreground = foreground.is_some_and(|foreground| foreground.contains(beam));
        Some(Point { x_m, y_m, beam, intensity: scan.intensities().get(beam), is_foreground })
    })
}

/// Position of a sensor in the picture.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum SensorPlacement {
    /// The pose is not known yet, so the sensor has no points.
    #[default]
    Unknown,
    /// On the robot, at this pose in the robot's frame.
    OnRobot(Pose),
    /// In the map of a tracker's site, at this pose. The position of the robot's center in the map is unknown.
    InMap(Pose),
}

impl SensorPlacement {
    /// Returns the pose in the frame of the picture, if it is known.
    pub fn pose(&self) -> Option<Pose> {
        match *self {
            SensorPlacement::Unknown => None,
            SensorPlacement::OnRobot(pose) | SensorPlacement::InMap(pose) => Some(pose),
        }
    }

    /// Returns whether the sensor is in the map of a site.
    pub fn is_in_map(&self) -> bool {
        matches!(self, SensorPlacement::InMap(_))
    }
}

/// Positions of a sensor's foreground over the last 1.6 s. The number of steps is small, so that all can be drawn.
#[derive(Clone, Debug, Default)]
pub struct Trail {
    /// Steps, the oldest first: the time in ns of CLOCK_MONOTONIC, and the points in meters in the robot's frame.
    steps: VecDeque<(u64, Vec<(f64, f64)>)>,
}

impl Trail {
    /// Adds the foreground that arrived at `now_ns`, unless the last step is newer than [`STEP_INTERVAL_NS`].
    fn take(&mut self, now_ns: u64, points: impl FnOnce() -> Vec<(f64, f64)>) {
        if self.steps.back().is_none_or(|(at_ns, _)| now_ns >= at_ns + STEP_INTERVAL_NS) {
            self.steps.push_back((now_ns, points()));
        }
        self.expire(now_ns);
    }

    /// Deletes steps that are too old at `now_ns`. Returns whether any were deleted.
    fn expire(&mut self, now_ns: u64) -> bool {
        let before = self.steps.len();
        self.steps.retain(|(at_ns, _)| now_ns < at_ns + TRAIL_NS);
        before != self.steps.len()
    }

    /// Returns the points of all steps.
    pub fn points(&self) -> impl Iterator<Item = (f64, f64)> {
        self.steps.iter().flat_map(|(_, points)| points.iter().copied())
    }
}

/// Rate and age of a sensor's scans over the last two seconds.
#[derive(Clone, Debug, Default)]
pub struct RateMeter {
    /// Stamp of the first byte of each scan, and age of the scan on arrival, in ns. The age is `None` if the stamp is
    /// estimated.
    scans: VecDeque<(u64, Option<u64>)>,
}

impl RateMeter {
    /// Counts a scan with `header` that arrived at `now_ns` of CLOCK_MONOTONIC.
    pub fn scan(&mut self, header: &Header, now_ns: u64) {
        if self.scans.back().is_some_and(|(last_ns, _)| *last_ns > header.stamp_first_ns) {
            // An earlier stamp comes from another recording, or from another machine's clock.
            self.scans.clear();
        }
        let is_known = header.flags & Flags::STAMP_ESTIMATED == 0;
        let age = is_known.then(|| now_ns.saturating_sub(header.stamp_last_ns));
        self.scans.push_back((header.stamp_first_ns, age));
        while self.scans.front().is_some_and(|(ns, _)| header.stamp_first_ns - ns > RATE_WINDOW_NS) {
            self.scans.pop_front();
        }
    }

    /// Returns the scans per second, or `None` while the stored scans span less than [`scanhub_schema::MIN_RATE_SPAN`].
    pub fn hz(&self) -> Option<f64> {
        let (first, last) = (self.scans.front()?.0, self.scans.back()?.0);
        scanhub_schema::rate_hz(self.scans.len() as u64 - 1, Duration::from_nanos(last - first))
    }

    /// Returns mean and maximum age on arrival in ms. The age is measured from the stamp of the telegram's last byte.
    pub fn age_ms(&self) -> Option<(f64, f64)> {
        let ages = || self.scans.iter().filter_map(|(_, age)| *age);
        let maximum = ages().max()?;
        let mean = ages().sum::<u64>() as f64 / ages().count() as f64;
        Some((mean / 1e6, maximum as f64 / 1e6))
    }

    /// Returns the 50th and the 99th percentile of the age on arrival, in ms.
    pub fn age_percentiles_ms(&self) -> Option<(f64, f64)> {
        let mut ages: Vec<u64> = self.scans.iter().filter_map(|(_, age)| *age).collect();
        ages.sort_unstable();
        // The percentile is the value at the nearest rank.
        let percentile = |percent: usize| {
            let rank = (ages.len() * percent).div_ceil(100).max(1);
            ages.get(rank - 1).map(|ns| *ns as f64 / 1e6)
        };
        percentile(50).zip(percentile(99))
    }
}

/// Reason why something is missing in the picture, and the remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// Description of the problem.
    pub description: String,
    /// Remedy, often a command. May be empty.
    pub remedy: String,
}

impl Problem {
    /// Returns the reason why `sensor` sends no scans. `status` is the status of its link. An error in the status takes
    /// precedence over the state.
    fn of_silent(sensor: &str, status: Option<&Status>) -> Problem {
        let Some(status) = status else {
            return Problem { description: "no data from it yet".into(), remedy: String::new() };
        };
        let port = status.port();
        let check = || format!("scanhub doctor {port}");
        let (what, remedy) = match status.state() {
            Some(State::Absent) => {
                ("its port is not there", "plug its adapter in, or name the right port".into())
            }
            Some(State::Probing) => ("looking for the sensor and its rate", check()),
            Some(State::Switching) => ("changing the rate of its line", String::new()),
            Some(State::Starting) => ("starting its stream", String::new()),
            Some(State::Streaming) => ("its telegrams hold no scans yet", check()),
            Some(State::Silent) => ("its telegrams stopped", check()),
            Some(State::Paused) => ("paused on request", format!("scanhub control {sensor} resume")),
            None => {
                ("in a state that this program does not know", "use hub and program of one version".into())
            }
        };
        let what = if status.last_error().is_empty() { what } else { status.last_error() };
        Problem { description: what.to_owned(), remedy }
    }
}

/// Share of the highest intensity that remains after each scan.
const BRIGHTNESS_DECAY: f64 = 0.9995;
/// Time for which the last scan is shown, in ns. If three periods of the scans are longer, they are used instead.
const MAX_SCAN_AGE_NS: u64 = 1_000_000_000;
/// Minimum interval between two steps of a trail, in ns.
const STEP_INTERVAL_NS: u64 = 90_000_000;
/// Duration of a trail, in ns.
const TRAIL_NS: u64 = 1_600_000_000;
/// Window of the rate, in ns. The window is so long that the rate changes slowly enough to be read.
const RATE_WINDOW_NS: u64 = 2_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::{ForegroundHead, ScanHead};

    #[test]
    fn pair_leaves_a_trail_and_brightest_sets_the_shade() {
        let mut sensor = Sensor::new("front");
        let scan = Scan::of(ScanHead::lms(9, 0, 1000, 1, 13), &[1000; 9]);
        let mut found = Foreground::of(9);
        found.begin(ForegroundHead { count: 9, ..ForegroundHead::default() }).bits[0] = 0b101;
        sensor.take_scan(&Header::default(), &scan, 0);
        sensor.take_pair(&scan, &found, 0);
        assert_eq!((sensor.points().count(), sensor.trail.points().count()), (0, 0), "its pose is unknown");
        sensor.take_status(&Status::default());
        let drawn = |sensor: &Sensor| sensor.points().filter(|point| point.is_foreground).count();
        assert_eq!(
            (sensor.points().count(), drawn(&sensor)),
            (9, 0),
            "a scan is drawn without its foreground"
        );
        sensor.take_foreground(&found);
        assert_eq!((drawn(&sensor), sensor.trail.points().count()), (2, 0));
        sensor.take_pair(&scan, &found, 2);
        assert_eq!(sensor.trail.points().count(), 2);
        assert_eq!(
            (sensor.shade(0), sensor.shade(1), sensor.shade(9)),
            (0.0, 1.0, 1.0),
            "no intensity was measured"
        );
        sensor.brightest = 400.0;
        assert_eq!((sensor.shade(100), sensor.shade(800)), (0.5, 1.0));
    }

    #[test]
    fn trail_is_thinned_and_expires() {
        let mut trail = Trail::default();
        for n in 0..100 {
            trail.take(n * 25_000_000, || vec![(n as f64, 0.0)]);
        }
        let steps: Vec<_> = trail.points().map(|(x, _)| x).collect();
        assert_eq!((steps.first(), steps.last(), steps.len()), (Some(&36.0), Some(&96.0), 16));
        assert!(!trail.expire(2_499_999_999) && trail.expire(2_500_000_000));
        trail.expire(u64::MAX);
        assert_eq!(trail.points().count(), 0);
    }

    fn header(first_ms: u64, flags: u8) -> Header {
        let stamp_first_ns = first_ms * 1_000_000;
        Header { stamp_first_ns, stamp_last_ns: stamp_first_ns + 10_000_000, flags, ..Header::default() }
    }

    #[test]
    fn rate_and_ages_cover_the_last_two_seconds() {
        let mut meter = RateMeter::default();
        assert_eq!((meter.hz(), meter.age_ms()), (None, None));
        for n in 0..100 {
            // The first scans are late, and then leave the window.
            let late_ms = if n < 10 { 500 } else { 1 + n % 2 * 2 };
            meter.scan(&header(n * 40, 0), (n * 40 + 10 + late_ms) * 1_000_000);
        }
        assert!((meter.hz().unwrap() - 25.0).abs() < 1e-9, "{:?}", meter.hz());
        let (mean, greatest) = meter.age_ms().unwrap();
        assert!((mean - 2.0).abs() < 0.1 && greatest == 3.0, "{mean} {greatest}");
    }

    #[test]
    fn percentiles_are_ages_that_occurred() {
        let mut meter = RateMeter::default();
        for n in 1..=50 {
            meter.scan(&header(n * 10, 0), (n * 10 + 10 + n) * 1_000_000);
        }
        assert_eq!(meter.age_percentiles_ms(), Some((25.0, 50.0)));
    }

    #[test]
    fn ignores_estimated_ages_and_restarts_on_old_stamps() {
        let mut meter = RateMeter::default();
        meter.scan(&header(1000, Flags::STAMP_ESTIMATED), 2_000_000_000);
        meter.scan(&header(1100, Flags::STAMP_ESTIMATED), 2_100_000_000);
        assert_eq!(meter.hz(), None, "0.1 s is too short for a rate");
        meter.scan(&header(1200, Flags::STAMP_ESTIMATED), 2_200_000_000);
        assert_eq!((meter.hz().map(f64::round), meter.age_ms()), (Some(10.0), None));
        meter.scan(&header(5, 0), 2_300_000_000);
        assert_eq!(meter.hz(), None);
    }

    #[test]
    fn link_error_takes_precedence_over_state_problems() {
        assert_eq!(Problem::of_silent("front", None).description, "no data from it yet");
        let mut status = Status { state: State::Silent as u8, ..Status::default() };
        status.set_port("/dev/ttyUSB0");
        let silent = Problem::of_silent("front", Some(&status));
        assert_eq!(silent.description, "its telegrams stopped");
        assert_eq!(silent.remedy, "scanhub doctor /dev/ttyUSB0");
        status.set_last_error("permission denied");
        assert_eq!(Problem::of_silent("front", Some(&status)).description, "permission denied");
        for state in 0..=7 {
            let status = Status { state, ..Status::default() };
            assert!(!Problem::of_silent("front", Some(&status)).description.is_empty(), "{state}");
        }
    }
}
