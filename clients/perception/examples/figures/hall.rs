//! A simulated hall with a scanner on a mount, played from start to end: scans and angles in the order of their arrival, and
//! what is true of each point. Does not compute scores.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_perception::tilt::{Angle, Counts, Mount, Point, Settings, Sweep, TiltScanner};
use scanhub_schema::{Scan, ScanHead};
use scanhub_sim::mount::{Mount as Motor, Report};
use scanhub_sim::room::BeamTarget;
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

/// A scan of 361 beams takes two turns of the mirror, and so long to arrive.
const SCAN_TIME_NS: u64 = 26_640_000;
const LINE_TIME_NS: u64 = 15_000_000;

/// A hall as a seed makes it.
pub(crate) struct Hall {
    room: Room,
    motor: Motor,
    /// The mount as it is known.
    pub(crate) mount: Mount,
    /// What stamped each beam, and what it met.
    truth: HashMap<(u64, u16), BeamTarget>,
    /// The delay of the angles' stamps that the library has found.
    pub(crate) stamp_delay_ns: i64,
}

impl Hall {
    /// `world`, whose first sensor has a mount.
    pub(crate) fn new(world: &World, seed: u64) -> Hall {
        let motor = world.mount(0).expect("a world with a mount").clone();
        let axis_m = motor.height_mm / 1000.0;
        let (ahead, up) = (motor.arm_mm.0 / 1000.0, motor.arm_mm.1 / 1000.0);
        let mount =
            Mount { axis_at: [0.0, 0.0, axis_m], sensor_at: [ahead, 0.0, axis_m + up], ..Mount::default() };
        Hall { room: Room::new(world, seed), motor, mount, truth: HashMap::new(), stamp_delay_ns: 0 }
    }

    /// Plays the hall until `until_s`, and hands out each sweep with the hall.
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

    /// Plays the hall until `until_s` again and again. Returns the time of the library for each scan, in the fastest of them.
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

    /// Returns what the beam of `point` met.
    pub(crate) fn target_of(&self, point: &Point) -> Option<BeamTarget> {
        self.truth.get(&(point.stamp_ns, point.beam)).copied()
    }

    /// How far `point` is from where its beam ended by its range, had the angle been known exactly.
    pub(crate) fn error_m(&self, point: &Point) -> f64 {
        let angle_rad = self.motor.angle_rad(point.stamp_ns);
        let beam_rad = (f64::from(point.beam) / 2.0 - 90.0).to_radians();
        let origin = self.mount.origin(angle_rad);
        let direction = self.mount.direction(angle_rad, beam_rad);
        // The same range as the point's: the noise of the sensor is in both.
        let (at, range_m) = (point.at.map(f64::from), self.range_m(point));
        (0..3).map(|i| (origin[i] + range_m * direction[i] - at[i]).powi(2)).sum::<f64>().sqrt()
    }

    /// How far `point` is from the sensor.
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

/// The truth of a sweep is asked for after it.
const TRUTH_LIFETIME_NS: u64 = 6_000_000_000;
