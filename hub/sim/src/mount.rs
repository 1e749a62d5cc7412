//! A mount that tilts a scanner: the angle of the mount at each time, and the reports of its encoder, which may have
//! faults. Angle and reports are pure functions of time.

use std::cmp::Reverse;
use std::f64::consts::PI;

use scanhub_schema::Nanos;

use crate::shape::Plane;
use crate::shape::Point;

/// A mount that swings a scanner back and forth at a constant speed, around a horizontal axis across the field of view.
/// At larger angles, the scanner points farther down.
#[derive(Clone, Debug, PartialEq)]
pub struct Mount {
    /// Height of the axis above the floor.
    pub height_mm: f64,
    /// Position of the scanner relative to the axis while the angle is 0: distance ahead, and distance up.
    pub arm_mm: (f64, f64),
    /// Angle at the start and at one reversal.
    pub from_deg: f64,
    /// Angle at the other reversal. It is greater than `from_deg`.
    pub to_deg: f64,
    /// Speed in degrees per second.
    pub deg_s: f64,
    /// Reports of the encoder per second.
    pub reports_hz: f64,
    /// Faults of the encoder or the motor.
    pub faults: Vec<Fault>,
}

/// A fault of a mount, with its time span.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fault {
    /// Kind of the fault.
    pub kind: FaultKind,
    /// Start in seconds since the start of the scanner.
    pub from_s: f64,
    /// End in seconds since the start of the scanner.
    pub until_s: f64,
}

/// Kind of a fault.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FaultKind {
    /// The motor stops, and the encoder reports it. Afterwards the motion continues.
    Halt,
    /// The encoder sends no reports.
    Silence,
    /// The encoder reports a constant angle, while the mount swings.
    Stuck,
    /// All reported angles are off by this number of degrees.
    Jump(f64),
    /// The error of the encoder grows to this number of degrees at 2 degrees per second, and shrinks again.
    Drift(f64),
    /// Reports arrive this number of seconds after their angles were measured. The stamps are correct.
    Delay(f64),
    /// The stamps are this number of seconds later than the measurements of the angles; earlier if negative.
    StampDelay(f64),
}

/// A report of the encoder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Report {
    /// Time of the angle.
    pub stamp_ns: Nanos,
    /// Time at which the report arrives.
    pub arrival_ns: Nanos,
    /// Angle in radians.
    pub angle_rad: f64,
    /// Change of the angle in radians per second.
    pub rate_rad_s: f64,
}

/// Encoder of a mount, which sends reports.
#[derive(Clone, Debug)]
pub(crate) struct Encoder {
    mount: Mount,
    /// Number of the next report.
    number: u64,
    /// Reports that were sent and have not arrived yet. The report that arrives first is the last one in the list.
    pending: Vec<Report>,
}

impl Encoder {
    /// Creates the encoder of `mount`.
    pub(crate) fn new(mount: Mount) -> Encoder {
        Encoder { mount, number: 0, pending: Vec::new() }
    }

    /// Returns the next report that has arrived by `now_ns`.
    pub(crate) fn poll(&mut self, now_ns: Nanos) -> Option<Report> {
        while self.next_report_ns() <= now_ns {
            self.pending.extend(self.mount.report(self.number));
            self.pending.sort_by_key(|report| Reverse(report.arrival_ns));
            self.number += 1;
        }
        self.pending.pop_if(|report| report.arrival_ns <= now_ns)
    }

    /// Returns the time at which to poll next.
    pub(crate) fn poll_timeout(&self) -> Nanos {
        let arrives_ns = self.pending.last().map_or(Nanos::MAX, |report| report.arrival_ns);
        arrives_ns.min(self.next_report_ns())
    }

    fn next_report_ns(&self) -> Nanos {
        (self.number as f64 / self.mount.reports_hz * 1e9).round() as Nanos
    }
}

impl Mount {
    /// Returns the angle of the scanner at `time_ns` in radians.
    pub fn angle_rad(&self, time_ns: Nanos) -> f64 {
        self.angle_deg(time_ns as f64 / 1e9).to_radians()
    }

    /// Returns report number `number`; `None` while the encoder is silent.
    pub fn report(&self, number: u64) -> Option<Report> {
        let time_s = number as f64 / self.reports_hz;
        let mut at_s = time_s;
        let mut off_deg = 0.0;
        let (mut late_s, mut stamp_s) = (0.0, time_s);
        for fault in self.faults.iter().filter(|fault| fault.is_active(time_s)) {
            match fault.kind {
                FaultKind::Halt => {}
                FaultKind::Silence => return None,
                FaultKind::Stuck => at_s = fault.from_s,
                FaultKind::Jump(by_deg) => off_deg += by_deg,
                FaultKind::Drift(by_deg) => {
                    let edge_s = (time_s - fault.from_s).min(fault.until_s - time_s);
                    off_deg += by_deg.signum() * (DRIFT_DEG_S * edge_s).min(by_deg.abs());
                }
                FaultKind::Delay(by_s) => late_s += by_s,
                FaultKind::StampDelay(by_s) => stamp_s += by_s,
            }
        }
        let is_stopped = at_s != time_s || self.faults.iter().any(|fault| fault.is_halting(time_s));
        let rate_deg_s = if is_stopped { 0.0 } else { self.deg_s * self.direction(time_s) };
        let nanos = |time_s: f64| (time_s * 1e9).round() as Nanos;
        Some(Report {
            stamp_ns: nanos(stamp_s),
            // A stamp that is too late comes from a program that stamps an angle at its arrival. The report therefore
            // does not arrive before its stamp.
            arrival_ns: nanos(stamp_s.max(time_s) + late_s),
            angle_rad: (self.angle_deg(at_s) + off_deg).to_radians(),
            rate_rad_s: rate_deg_s / 180.0 * PI,
        })
    }

    /// Returns the plane in which the scanner measures at `time_ns`.
    pub(crate) fn plane(&self, time_ns: Nanos) -> Plane {
        let down_deg = self.angle_deg(time_ns as f64 / 1e9);
        let (sin, cos) = down_deg.to_radians().sin_cos();
        let (ahead, up) = self.arm_mm;
        let eye: Point = (ahead * cos + up * sin, self.height_mm - ahead * sin + up * cos);
        Plane::new(eye, down_deg)
    }

    fn angle_deg(&self, time_s: f64) -> f64 {
        let travel_deg = self.travel_deg(time_s);
        let width = self.to_deg - self.from_deg;
        self.from_deg + if travel_deg <= width { travel_deg } else { 2.0 * width - travel_deg }
    }

    fn direction(&self, time_s: f64) -> f64 {
        if self.travel_deg(time_s) < self.to_deg - self.from_deg { 1.0 } else { -1.0 }
    }

    /// Returns how many degrees the mount has traveled since it was last at `from_deg`.
    fn travel_deg(&self, time_s: f64) -> f64 {
        let halts = self.faults.iter().filter(|fault| fault.kind == FaultKind::Halt);
        let halted_s: f64 = halts.map(|fault| (time_s.min(fault.until_s) - fault.from_s).max(0.0)).sum();
        (self.deg_s * (time_s - halted_s)).rem_euclid(2.0 * (self.to_deg - self.from_deg))
    }
}

impl Fault {
    fn is_active(&self, time_s: f64) -> bool {
        (self.from_s..self.until_s).contains(&time_s)
    }

    fn is_halting(&self, time_s: f64) -> bool {
        self.kind == FaultKind::Halt && self.is_active(time_s)
    }
}

/// Speed at which the error of [`FaultKind::Drift`] grows, in degrees per second. The error grows so slowly that each
/// step of the reported angle still looks like motion of the mount.
const DRIFT_DEG_S: f64 = 2.0;

#[cfg(test)]
mod tests {
    use super::*;

    fn mount(faults: &[Fault]) -> Mount {
        Mount {
            height_mm: 1000.0,
            arm_mm: (50.0, 30.0),
            from_deg: -10.0,
            to_deg: 50.0,
            deg_s: 30.0,
            reports_hz: 100.0,
            faults: faults.to_vec(),
        }
    }

    fn deg(mount: &Mount, time_s: f64) -> f64 {
        mount.angle_rad((time_s * 1e9) as Nanos).to_degrees().round()
    }

    #[test]
    fn mount_swings_and_stands_during_a_halt() {
        let swings = mount(&[]);
        assert_eq!([0.0, 1.0, 2.0, 3.0, 4.0].map(|s| deg(&swings, s)), [-10.0, 20.0, 50.0, 20.0, -10.0]);
        let halted = mount(&[Fault { kind: FaultKind::Halt, from_s: 1.0, until_s: 5.0 }]);
        assert_eq!([1.0, 3.0, 5.0, 6.0].map(|s| deg(&halted, s)), [20.0, 20.0, 20.0, 50.0]);
        let report = halted.report(300).expect("it says so");
        assert_eq!((report.angle_rad.to_degrees().round(), report.rate_rad_s), (20.0, 0.0));
    }

    #[test]
    fn delayed_angle_reports_arrive_late() {
        let late = Fault { kind: FaultKind::Delay(0.015), from_s: 0.01, until_s: 0.02 };
        let mut encoder = Encoder::new(mount(&[late]));
        let mut come = Vec::new();
        for ms in 0..50 {
            let now_ns = ms * 1_000_000;
            let is_due = encoder.poll_timeout() <= now_ns;
            let before = come.len();
            come.extend(
                std::iter::from_fn(|| encoder.poll(now_ns)).map(|one| (ms, one.stamp_ns / 1_000_000)),
            );
            assert_eq!(is_due, come.len() > before || ms == 10, "at {ms} ms");
        }
        assert_eq!(come, [(0, 0), (20, 20), (25, 10), (30, 30), (40, 40)]);
    }

    #[test]
    fn encoder_reports_true_angle_except_for_faults() {
        let report_with_fault =
            |kind: FaultKind, number: u64| mount(&[Fault { kind, from_s: 0.5, until_s: 1.5 }]).report(number);
        let deg = |kind, number| {
            report_with_fault(kind, number).map(|report| report.angle_rad.to_degrees().round())
        };
        assert_eq!(deg(FaultKind::Jump(8.0), 100), Some(28.0));
        assert_eq!(deg(FaultKind::Jump(8.0), 200), Some(50.0));
        assert_eq!(deg(FaultKind::Stuck, 100), Some(5.0));
        assert_eq!(deg(FaultKind::Silence, 100), None);
        assert_eq!(
            [50, 75, 100, 149].map(|n| deg(FaultKind::Drift(-1.0), n)),
            [5.0, 12.0, 19.0, 35.0].map(Some)
        );
        let late = report_with_fault(FaultKind::Delay(0.2), 100).expect("it says so");
        assert_eq!((late.stamp_ns, late.arrival_ns), (1_000_000_000, 1_200_000_000));
        assert!((late.rate_rad_s.to_degrees() - 30.0).abs() < 1e-9);
        let stamped = [0.03, -0.03]
            .map(|by_s| report_with_fault(FaultKind::StampDelay(by_s), 100).expect("it says so"));
        assert_eq!(stamped.map(|report| report.stamp_ns / 1_000_000), [1030, 970]);
        assert_eq!(stamped.map(|report| report.arrival_ns / 1_000_000), [1030, 1000]);
        assert_eq!(stamped.map(|report| report.angle_rad.to_degrees().round()), [20.0; 2]);
    }
}
