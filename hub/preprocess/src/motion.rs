//! Estimation of a robot's motion from scan to scan. Each scan is matched with an earlier scan, the reference scan.
//! First, corners and lines of both scans are matched. Then all beams are matched: each beam should end on a surface of
//! the reference scan.
//!
//! The method is point-to-line matching as in Censi: "An ICP variant using a point-to-line metric" (ICRA 2008), with
//! the covariance of Censi: "An accurate closed-form estimate of ICP's covariance" (ICRA 2007). The surfaces are the
//! line features of the scan. Where there is no line feature, a few neighboring readings define a surface.
//!
//! A reference scan is kept until the robot has moved away from the position at which it was measured. The estimated
//! position of a robot that stands therefore does not drift.

mod covariance;
mod matching;

use std::f64::consts::{FRAC_PI_2, PI};

use scanhub_schema::{Corner, Line, Lines, MAX_BEAMS, Motion, MotionMethod, Pose, Scan};

use crate::lines::{self, LineFinder};
pub use crate::velocity::Pose2;
use crate::velocity::{UndistortedScan, Velocity, times};

use covariance::Square;
use matching::{MAX_SPACING_M, Match, PreparedScan, ScanMatcher};

/// Limits of the steps that are accepted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Maximum distance from one scan to the next, in meters.
    pub max_step_m: f64,
    /// Maximum turn from one scan to the next, in degrees; less than 90.
    pub max_turn_deg: f64,
    /// Minimum share of a scan's readings that lie on surfaces of the reference scan.
    pub min_overlap: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Settings { max_step_m: 0.5, max_turn_deg: 30.0, min_overlap: 0.4 }
    }
}

impl Settings {
    fn allows(&self, step: &Pose2) -> bool {
        step.x.hypot(step.y) <= self.max_step_m && step.yaw.abs() <= self.max_turn_deg.to_radians()
    }
}

/// Estimates the motion of one sensor.
pub struct MotionEstimator {
    pose: Pose,
    settings: Settings,
    /// The reference scan.
    reference: PreparedScan,
    /// The current scan.
    current: PreparedScan,
    matcher: ScanMatcher,
    /// State of the odometry; `None` before the first scan.
    odometry: Option<OdometryState>,
    /// Stamp of the last scan, in ns.
    stamp_ns: u64,
    velocity: Velocity,
    /// Velocity of the last step, if this velocity was rejected because it differs too much from the velocity before.
    rejected: Option<Velocity>,
    undistorted: UndistortedScan,
    finder: LineFinder,
    lines: Lines,
}

/// Position and last step of the robot.
#[derive(Clone, Copy, Default)]
struct OdometryState {
    /// Position at the reference scan, relative to the start.
    origin: Pose2,
    /// Covariance of `origin`.
    of_origin: Square,
    /// Position at the last scan, in the frame of the reference scan.
    last: Pose2,
    /// Covariance of `last` that the noise of the last scan causes. `None` if the last scan is the reference scan.
    extra_covariance: Option<Square>,
    /// Covariance of `last` from all causes.
    of_last: Square,
    /// Whether `last` is degenerate: there is a direction in which the surroundings do not define it.
    is_degenerate: bool,
    /// Whether the position is open: a step since the start was degenerate.
    is_open: bool,
    /// The last step.
    step: Pose2,
    /// Number of steps that were refused since the start.
    refused_steps: u16,
}

impl MotionEstimator {
    /// Creates an estimator for a sensor at `pose` with at most `beams` beams.
    pub fn new(pose: Pose, settings: Settings, beams: usize) -> MotionEstimator {
        let beams = beams.min(MAX_BEAMS);
        MotionEstimator {
            pose,
            settings,
            reference: PreparedScan::new(beams),
            current: PreparedScan::new(beams),
            matcher: ScanMatcher::new(beams),
            odometry: None,
            stamp_ns: 0,
            velocity: Velocity::default(),
            rejected: None,
            undistorted: UndistortedScan::new(beams),
            finder: LineFinder::new(pose, lines::Settings::default(), beams),
            lines: Lines::default(),
        }
    }

    /// Changes the settings and the pose of the sensor. If the pose differs from the previous one, the estimator
    /// restarts.
    pub fn change(&mut self, pose: Pose, settings: Settings) {
        if self.pose != pose {
            self.reset();
            self.finder.change(pose, lines::Settings::default());
        }
        (self.pose, self.settings) = (pose, settings);
    }

    /// Restarts the odometry. The next scan is the first one.
    pub fn reset(&mut self) {
        self.odometry = None;
    }

    /// Returns the robot's velocity during the last scan.
    pub fn velocity(&self) -> Velocity {
        self.velocity
    }

    /// Writes the motion since the last scan into `out`. Writes every byte of `out`. `stamp_ns` is the stamp of `scan`.
    /// `period_ns` is the period of the scans, or 0 if it is unknown.
    pub fn update(&mut self, scan: &Scan, stamp_ns: u64, period_ns: u64, out: &mut Motion) {
        *out = Motion::default();
        let elapsed_ns = stamp_ns.saturating_sub(std::mem::replace(&mut self.stamp_ns, stamp_ns));
        let seconds = 1e-9 * without_jitter(elapsed_ns, period_ns) as f64;
        let is_timed = self.odometry.is_some()
            && (MIN_INTERVAL_S..MAX_INTERVAL_S).contains(&seconds)
            && times(scan).iter().all(|time| time.abs() < MAX_INTERVAL_S);
        if !is_timed {
            self.velocity = Velocity::default();
        }
        self.take(scan);
        let Some(odometry) = self.odometry else {
            self.matcher.reset();
            self.set_reference(OdometryState::default());
            return;
        };
        let first = self.find(&odometry, None);
        let (found, offset) = match first {
            Some(first) if is_timed => {
                let (found, offset) = self.correct(scan, &odometry, first, seconds);
                (Some(found), offset)
            }
            _ => (first, [0.0; 3]),
        };
        match found {
            Some((found, step)) => {
                let pose_covariance = covariance_in_reference(&odometry, &found, &step, &offset);
                write(&odometry, &found, &step, &offset, &pose_covariance, out);
                let next = OdometryState {
                    last: found.pose,
                    extra_covariance: Some(found.own),
                    of_last: pose_covariance,
                    is_degenerate: found.is_degenerate,
                    is_open: odometry.is_open || found.is_degenerate,
                    step,
                    ..odometry
                };
                let is_away = found.pose.x.hypot(found.pose.y) > MAX_REFERENCE_DISTANCE_M
                    || found.pose.yaw.abs() > MAX_REFERENCE_ANGLE_RAD;
                if is_away || found.overlap < MIN_REFERENCE_OVERLAP {
                    self.set_reference(next);
                } else {
                    self.odometry = Some(next);
                }
            }
            None => {
                if self.velocity != Velocity::default() {
                    // This scan becomes the reference scan. The velocity during this scan is unknown, so undo its
                    // correction.
                    self.velocity = Velocity::default();
                    self.take(scan);
                }
                self.matcher.reset();
                let refused_steps = odometry.refused_steps.saturating_add(1);
                (out.method, out.refused_steps) = (MotionMethod::Refused as u8, refused_steps);
                self.set_reference(OdometryState { step: Pose2::default(), refused_steps, ..odometry });
            }
        }
    }

    /// Corrects the current scan by the velocity that follows from the step in `first` and its duration of `seconds`.
    /// Repeats correction and match until velocity and step agree. Returns the position, the step, and the remaining
    /// offset of the beams.
    fn correct(
        &mut self,
        scan: &Scan,
        odometry: &OdometryState,
        first: (Match, Pose2),
        seconds: f64,
    ) -> ((Match, Pose2), [f64; 3]) {
        let expected = self.velocity;
        let (mut found, mut corrections) = (first, 0);
        loop {
            let (before, step) = found;
            let measured = Velocity::of_step((step.x, step.y, step.yaw), seconds);
            let change = self.velocity.difference(&measured);
            let offset = change.offset(scan);
            let is_again = self.rejected.is_some_and(|rejected| rejected.difference(&measured).is_possible());
            if !change.is_possible() && !is_again {
                // No robot changes its velocity so fast. Either the step is an error, or a person has moved the robot.
                // If the next step has about the same velocity, the velocity is accepted then.
                self.rejected = Some(measured);
                return (self.stop_or_continue(scan, odometry, found), offset);
            }
            self.rejected = None;
            if corrections == MAX_CORRECTIONS || !change.distorts(scan, MIN_DISTORTION_CHANGE_M) {
                self.velocity.approach(&measured);
                return (found, offset);
            }
            corrections += 1;
            self.velocity = measured;
            self.take(scan);
            match self.find(odometry, Some(before.pose)) {
                Some(again) => found = again,
                None => {
                    // The corrected scan does not match, so use the step of the uncorrected scan.
                    self.velocity = expected;
                    self.take(scan);
                    return (first, offset);
                }
            }
        }
    }

    /// Decides after a rejected velocity between two cases: a person has carried the robot and it stands now, or the
    /// robot moves as before. A scan fits better if it is corrected with the right velocity, so this function tries
    /// both velocities. Returns the position and the step.
    fn stop_or_continue(
        &mut self,
        scan: &Scan,
        odometry: &OdometryState,
        found: (Match, Pose2),
    ) -> (Match, Pose2) {
        let moving = std::mem::take(&mut self.velocity);
        if !moving.distorts(scan, MIN_DISTORTION_M) {
            return found;
        }
        self.take(scan);
        let begin = Some(found.0.pose);
        if let Some(standing) =
            self.find(odometry, begin).filter(|standing| standing.0.weight > found.0.weight)
        {
            return standing;
        }
        self.velocity = moving;
        self.take(scan);
        self.find(odometry, begin).unwrap_or(found)
    }

    /// Prepares `scan` as the current scan. If the velocity distorts it, it is corrected as if all beams had been
    /// measured at once.
    fn take(&mut self, scan: &Scan) {
        let scan = match self.velocity.distorts(scan, MIN_DISTORTION_M) {
            true => self.undistorted.compute(scan, &self.velocity.of_sensor(&self.pose)),
            false => scan,
        };
        self.finder.update(scan, &mut self.lines);
        self.current.take(&self.pose, scan, &self.lines);
    }

    /// Returns the robot's position and its step, or `None` if they are not within the limits of the settings. The
    /// search starts at `begin`, or at [`initial_guess`] if `begin` is `None`.
    fn find(&mut self, odometry: &OdometryState, begin: Option<Pose2>) -> Option<(Match, Pose2)> {
        let settings = self.settings;
        let begin =
            begin.unwrap_or_else(|| initial_guess(&self.reference, &self.current, odometry, &settings));
        let found = self.matcher.find(&self.reference, &self.current, begin, settings.max_step_m)?;
        let step = odometry.last.inverse().then(&found.pose);
        (settings.allows(&step) && found.overlap >= settings.min_overlap).then_some((found, step))
    }

    /// Makes the current scan the reference scan for later scans.
    fn set_reference(&mut self, odometry: OdometryState) {
        self.current.set_ignored_scans(self.matcher.ignored_scans());
        std::mem::swap(&mut self.reference, &mut self.current);
        let OdometryState { origin, of_origin, last, of_last, .. } = odometry;
        self.odometry = Some(OdometryState {
            origin: origin.then(&last),
            of_origin: covariance::of_both(&of_origin, &of_last, &origin, &last),
            last: Pose2::default(),
            extra_covariance: None,
            of_last: Square::default(),
            is_degenerate: false,
            ..odometry
        });
    }
}

/// Rounds `elapsed_ns` to a multiple of the period, because stamps of telegrams have jitter.
fn without_jitter(elapsed_ns: u64, period_ns: u64) -> u64 {
    let periods = elapsed_ns.saturating_add(period_ns / 2).checked_div(period_ns);
    periods.map_or(elapsed_ns, |periods| periods.saturating_mul(period_ns))
}

/// Writes the `step` that leads to the position `found`, and the sum of all steps. The beams may be off by `offset`,
/// because the velocity changes.
fn write(
    odometry: &OdometryState,
    found: &Match,
    step: &Pose2,
    offset: &[f64; 3],
    pose_covariance: &Square,
    out: &mut Motion,
) {
    (out.dx_m, out.dy_m, out.dyaw_rad) = (step.x as f32, step.y as f32, step.yaw as f32);
    // The noise of the last scan and the noise of the current scan are independent. The noise of the reference scan
    // moves both positions by the same amount, so the step does not depend on it. If the last scan is the reference
    // scan, its noise is the only noise of the step's start.
    let reference_covariance = odometry.extra_covariance.unwrap_or(found.of_reference);
    let mut covariance = covariance::of_step(&found.own, &reference_covariance, &odometry.last, step);
    add_uncertainty(&mut covariance, odometry, found, step, offset);
    out.covariance = covariance::rows(&covariance);
    out.overlap = found.overlap as f32;
    // The covariance of a step contains the covariances of both positions.
    let is_degenerate = found.is_degenerate || odometry.is_degenerate;
    out.flags = if is_degenerate { Motion::DEGENERATE } else { 0 };
    out.flags |= if is_degenerate || odometry.is_open { Motion::OPEN } else { 0 };
    out.method = match (found.has_corners, found.has_lines) {
        (true, true) => MotionMethod::Both,
        (true, false) => MotionMethod::Points,
        (false, true) => MotionMethod::Lines,
        (false, false) => MotionMethod::Beams,
    } as u8;
    let pose = odometry.origin.then(&found.pose);
    (out.x_m, out.y_m, out.yaw_rad) = (pose.x, pose.y, pose.yaw);
    out.refused_steps = odometry.refused_steps;
    if out.has_valid_pose() {
        let covariance =
            covariance::of_both(&odometry.of_origin, pose_covariance, &odometry.origin, &found.pose);
        out.pose_covariance = covariance::rows(&covariance);
    }
}

/// Returns the covariance of the position to which `step` leads, in the frame of the reference scan. Every position in
/// this frame is matched with the reference scan itself, so the covariance does not contain those of earlier steps.
fn covariance_in_reference(
    odometry: &OdometryState,
    found: &Match,
    step: &Pose2,
    offset: &[f64; 3],
) -> Square {
    let mut of_step = Square::default();
    add_uncertainty(&mut of_step, odometry, found, step, offset);
    let of_step = covariance::turned(&of_step, &odometry.last);
    covariance::sum(&covariance::sum(&found.own, &found.of_reference), &of_step)
}

/// Adds the causes other than noise to the `covariance` of `step`.
fn add_uncertainty(
    covariance: &mut Square,
    odometry: &OdometryState,
    found: &Match,
    step: &Pose2,
    offset: &[f64; 3],
) {
    // Readings that are on no surface contradict this step. Perhaps the robot moved as in the previous step instead.
    let other = [step.x - odometry.step.x, step.y - odometry.step.y, step.yaw - odometry.step.yaw];
    covariance::add_outer(covariance, &other, 1.0 - found.overlap);
    covariance::add_outer(covariance, offset, 1.0);
}

/// Minimum distortion of a scan that is corrected: the motion from its first to its last beam, in meters.
const MIN_DISTORTION_M: f64 = 0.003;
/// Minimum change of the distortion for which the correction is repeated, in meters. It is greater than
/// [`MIN_DISTORTION_M`], because a repeated correction adds the noise of the last step.
const MIN_DISTORTION_CHANGE_M: f64 = 0.01;
/// Maximum number of corrections after a change of velocity. Each correction leaves less than half of the error.
const MAX_CORRECTIONS: u8 = 4;
/// Minimum time between two scans from which a velocity is computed, in seconds.
const MIN_INTERVAL_S: f64 = 0.005;
/// Maximum time between two scans from which a velocity is computed, in seconds.
const MAX_INTERVAL_S: f64 = 1.0;
/// Maximum distance from the position of the reference scan. Beyond it, another scan becomes the reference scan. Up to
/// this distance, the robot sees the surfaces of the reference scan from about the same side.
const MAX_REFERENCE_DISTANCE_M: f64 = 0.15;
/// Maximum turn since the reference scan. Beyond it, another scan becomes the reference scan.
const MAX_REFERENCE_ANGLE_RAD: f64 = 0.15;
/// Minimum share of readings on surfaces of the reference scan. With a lower share, another scan becomes the reference
/// scan.
const MIN_REFERENCE_OVERLAP: f64 = 0.5;

/// Returns the position at which the matching starts. The candidates are the position after the same step as before,
/// the last position, and the positions at which corners or lines of both scans coincide. The function samples a few
/// beams, and returns the candidate with which most of them agree.
fn initial_guess(
    reference: &PreparedScan,
    current: &PreparedScan,
    odometry: &OdometryState,
    settings: &Settings,
) -> Pose2 {
    let mut best = Guess {
        reference,
        current,
        odometry,
        settings,
        pose: odometry.last.then(&odometry.step),
        score: 0,
        tries: 0,
    };
    best.score = best.score(&best.pose);
    best.try_pose(odometry.last);
    best.try_corners();
    if best.score < best.beams() * 4 / 5 {
        best.try_lines();
    }
    best.pose
}

/// Search for the position at which the matching starts. `pose` is the best position so far.
struct Guess<'a> {
    reference: &'a PreparedScan,
    current: &'a PreparedScan,
    odometry: &'a OdometryState,
    settings: &'a Settings,
    pose: Pose2,
    score: usize,
    tries: usize,
}

impl Guess<'_> {
    /// Returns the number of beams that are sampled.
    fn beams(&self) -> usize {
        self.current.points().len().div_ceil(self.stride())
    }

    fn stride(&self) -> usize {
        self.current.points().len().div_ceil(SAMPLED_BEAMS).max(1)
    }

    /// Returns the number of sampled beams that end on a surface of the reference scan if the robot is at `pose`.
    fn score(&self, pose: &Pose2) -> usize {
        let width = MAX_DEVIATIONS * self.reference.noise.hypot(self.current.noise) + EXTRA_DISTANCE_M;
        let fits = |point: &&(f64, f64)| {
            let point = pose.point(**point);
            let on = self.reference.nearest(point, width + MAX_SPACING_M);
            let surface = on.and_then(|nearest| self.reference.readings()[nearest].surface);
            surface.is_some_and(|surface| surface.distance(point).abs() <= width)
        };
        self.current.points().iter().step_by(self.stride()).filter(fits).count()
    }

    /// Makes `pose` the best position, if the settings allow it and more beams agree with it than with the best
    /// position so far.
    fn try_pose(&mut self, pose: Pose2) {
        let step = self.odometry.last.inverse().then(&pose);
        if !self.settings.allows(&step) || self.tries >= MAX_TRIES {
            return;
        }
        self.tries += 1;
        let score = self.score(&pose);
        if score > self.score {
            (self.pose, self.score) = (pose, score);
        }
    }

    /// Tries the positions at which a corner of the current scan coincides with a corner of the reference scan. Only
    /// corners with about the same angle between their lines are compared.
    fn try_corners(&mut self) {
        let (reference, current) = (self.reference, self.current);
        let opening = |view: &PreparedScan, corner: &Corner| {
            let line = |number: u16| view.lines.lines().get(usize::from(number));
            let (one, two) = (line(corner.first_line)?, line(corner.second_line)?);
            Some((f64::from(one.alpha_rad), f64::from(two.alpha_rad)))
        };
        for corner in current.lines.corners() {
            let Some((first, second)) = opening(current, corner) else { continue };
            for other in reference.lines.corners() {
                let Some((of_first, of_second)) = opening(reference, other) else { continue };
                let (one, two) = (turned(first, of_first), turned(second, of_second));
                if (one - two).abs() > MAX_OPENING_DIFFERENCE_RAD {
                    continue;
                }
                let yaw = (one + two) / 2.0;
                let turn = Pose2::new(0.0, 0.0, yaw);
                let (x, y) = turn.point((corner.x_m.into(), corner.y_m.into()));
                self.try_pose(Pose2::new(f64::from(other.x_m) - x, f64::from(other.y_m) - y, yaw));
            }
        }
    }

    /// Tries the positions at which a line of the current scan coincides with a line of the reference scan. A line
    /// defines only how far the robot turned, and how far it moved across the line. Along the line, the robot is
    /// assumed to move as in the previous step.
    fn try_lines(&mut self) {
        let (reference, current) = (self.reference, self.current);
        let expected = self.odometry.last.then(&self.odometry.step);
        let is_long = |line: &&Line| line.points >= MIN_LINE_BEAMS;
        for line in current.lines.lines().iter().filter(is_long) {
            for other in reference.lines.lines().iter().filter(is_long) {
                let (alpha, of_other) = (f64::from(line.alpha_rad), f64::from(other.alpha_rad));
                let yaw = turned(alpha, of_other);
                let (sin, cos) = of_other.sin_cos();
                // If the robot's center has moved to the other side of the line, the normal of the line points in the
                // opposite direction.
                let is_same_side = (alpha + yaw - of_other).cos() > 0.0;
                let r = f64::from(if is_same_side { line.r_m } else { -line.r_m });
                let across = f64::from(other.r_m) - r - (cos * expected.x + sin * expected.y);
                self.try_pose(Pose2::new(expected.x + cos * across, expected.y + sin * across, yaw));
            }
        }
    }
}

/// Returns the turn from one direction of a line to another direction, at most a quarter turn either way. The opposite
/// direction of a line is the same direction.
fn turned(from: f64, to: f64) -> f64 {
    (to - from + FRAC_PI_2).rem_euclid(PI) - FRAC_PI_2
}

/// Maximum number of beams that are sampled to compare two positions.
const SAMPLED_BEAMS: usize = 48;
/// Maximum number of positions that are tried.
const MAX_TRIES: usize = 64;
/// Maximum distance between the end of a sampled beam and its surface, in standard deviations. [`EXTRA_DISTANCE_M`] is
/// added to it.
const MAX_DEVIATIONS: f64 = 3.0;
/// Additional distance between the end of a sampled beam and its surface, in meters.
const EXTRA_DISTANCE_M: f64 = 0.01;
/// Maximum difference between the angles of two corners that may be the same corner: 5 degrees.
const MAX_OPENING_DIFFERENCE_RAD: f64 = 0.09;
/// Minimum number of beams of a line whose direction is accurate enough for a guess.
const MIN_LINE_BEAMS: u16 = 10;
