//! A simulated hall with a scanner on a mount. The hall is played from start to end. The library receives scans and
//! angles in the order of their arrival, and the hall stores the truth about each point. `score.rs` scores the results.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_perception::tilt::{Angle, Counts, Mount, Point, Settings, Sweep, TiltScanner};
use scanhub_schema::{Scan, ScanHead};
use scanhub_sim::mount::{Mount as Motor, Report};
use scanhub_sim::room::BeamTarget;
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

/// Duration of a scan of 361 beams, which is two revolutions of the mirror, and transmission time of the scan, in ns.
const SCAN_TIME_NS: u64 = 26_640_000;
const LINE_TIME_NS: u64 = 15_000_000;

/// A hall whose contents depend on a seed.
pub(crate) struct Hall {
    room: Room,
    motor: Motor,
    /// Mount as described to the library.
    pub(crate) mount: Mount,
    /// Target of each beam, by stamp and beam index.
    truth: HashMap<(u64, u16), BeamTarget>,
    /// Delay of the angles' stamps that the library has estimated, in ns.
    pub(crate) stamp_delay_ns: i64,
}

impl Hall {
    /// Creates the hall of `world`, whose first sensor has a mount.
    pub(crate) fn new(world: &World, seed: u64) -> Hall {
        let motor = world.mount(0).expect("a world with a mount").clone();
        let axis_m = motor.height_mm / 1000.0;
        let (ahead, up) = (motor.arm_mm.0 / 1000.0, motor.arm_mm.1 / 1000.0);
        let mount =
            Mount { axis_at: [0.0, 0.0, axis_m], sensor_at: [ahead, 0.0, axis_m + up], ..Mount::default() };
        Hall { room: Room::new(world, seed), motor, mount, truth: HashMap::new(), stamp_delay_ns: 0 }
    }

    /// Plays the first `until_s` seconds of the hall, and passes each sweep with the hall to `show`.
    pub(crate) fn play(
        &mut self,
        settings: Settings,
        until_s: u64,
        mut show: impl FnMut(&Hall, &Sweep<'_>),
    ) -> Counts {
        let mut tilting = TiltScanner::new(self.mount, settings);
        let until_ns = until_s * 1_000_000_000;
        let numbers = 0..(until_s as f64 * self.motor.reports_hz) as u64;
        let mut reports: Vec<Report> = numbers.filter_map(|number| self.motor.report(number)).collect();
        reports.sort_by_key(|report| report.arrival_ns);
        let mut reports = reports.into_iter().peekable();
        for end_ns in (1..).map(|number| number * SCAN_TIME_NS).take_while(|end_ns| *end_ns < until_ns) {
            while let Some(report) = reports.next_if(|report| report.arrival_ns < end_ns + LINE_TIME_NS) {
                let Report { stamp_ns, angle_rad, rate_rad_s, .. } = report;
                tilting.take_angle(Angle { stamp_ns, angle_rad, rate_rad_s }, |sweep| show(self, sweep));
            }
            let scan = self.scan(end_ns);
            tilting.take_scan(end_ns, &scan, |sweep| show(self, sweep));
        }
        self.stamp_delay_ns = tilting.late_ns();
        tilting.counts()
    }

    /// Plays the first `until_s` seconds of the hall 30 times. Returns the time that the library needs per scan in the
    /// fastest run.
    pub(crate) fn min_time_per_scan(&mut self, settings: Settings, until_s: u64) -> Duration {
        let ends: Vec<u64> =
            (1..until_s * 1_000_000_000 / SCAN_TIME_NS).map(|number| number * SCAN_TIME_NS).collect();
        let scans: Vec<Box<Scan>> = ends.iter().map(|end_ns| self.scan(*end_ns)).collect();
        let numbers = 0..(until_s as f64 * self.motor.reports_hz) as u64;
        let reports: Vec<Report> = numbers.filter_map(|number| self.motor.report(number)).collect();
        let play = |_| {
            let mut tilting = TiltScanner::new(self.mount, settings);
            let mut reports = reports.iter().peekable();
            let began = Instant::now();
            for (end_ns, scan) in ends.iter().zip(&scans) {
                while let Some(report) = reports.next_if(|report| report.arrival_ns < end_ns + LINE_TIME_NS) {
                    let Report { stamp_ns, angle_rad, rate_rad_s, .. } = *report;
                    tilting.take_angle(Angle { stamp_ns, angle_rad, rate_rad_s }, |_| {});
                }
                tilting.take_scan(*end_ns, scan, |_| {});
            }
            began.elapsed()
        };
        (0..30).map(play).min().unwrap_or_default() / ends.len() as u32
    }

    /// Returns the time from one reversal of the mount to the next, in ns.
    pub(crate) fn sweep_ns(&self) -> u64 {
        ((self.motor.to_deg - self.motor.from_deg) / self.motor.deg_s * 1e9) as u64
    }

    /// Returns the target of the beam that measured `point`.
    pub(crate) fn target_of(&self, point: &Point) -> Option<BeamTarget> {
        self.truth.get(&(point.stamp_ns, point.beam)).copied()
    }

    /// Returns the distance in meters between `point` and the position that it would have if the angle were known
    /// exactly.
    pub(crate) fn error_m(&self, point: &Point) -> f64 {
        let angle_rad = self.motor.angle_rad(point.stamp_ns);
        let beam_rad = (f64::from(point.beam) / 2.0 - 90.0).to_radians();
        let origin = self.mount.origin(angle_rad);
        let direction = self.mount.direction(angle_rad, beam_rad);
        // Both positions use the range of the point, so the noise of the sensor does not matter.
        let (at, range_m) = (point.at.map(f64::from), self.range_m(point));
        (0..3).map(|i| (origin[i] + range_m * direction[i] - at[i]).powi(2)).sum::<f64>().sqrt()
    }

    /// Returns the distance between `point` and the sensor in meters.
    pub(crate) fn range_m(&self, point: &Point) -> f64 {
        let origin = self.mount.origin(self.motor.angle_rad(point.stamp_ns));
        let off = |i: usize| f64::from(point.at[i]) - origin[i];
        (off(0).powi(2) + off(1).powi(2) + off(2).powi(2)).sqrt()
    }

    fn scan(&mut self, end_ns: u64) -> Box<Scan> {
        let look = self.room.labeled_scan(Variant::HALF, Unit::Mm, Mode(1), end_ns);
        let ranges: Vec<u16> = look.words.iter().map(|word| word & 0x1FFF).collect();
        let scan = Scan::of(ScanHead::lms(361, -90_000, 500, 1, 13), &ranges);
        for (beam, target) in look.truth.into_iter().enumerate() {
            self.truth.insert((end_ns.saturating_add_signed(scan.beam_ns(beam)), beam as u16), target);
        }
        self.truth.retain(|(stamp_ns, _), _| *stamp_ns + TRUTH_LIFETIME_NS > end_ns);
        scan
    }
}

/// Time for which targets are stored in ns, because a sweep is scored after its end.
const TRUTH_LIFETIME_NS: u64 = 6_000_000_000;
