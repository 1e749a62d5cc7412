//! Estimates how a robot moved from scan to scan. Corners and lines of both scans are matched first, and then all
//! beams: each ends on a surface of the scan that it is compared with.
//!
//! The method is point-to-line matching as in Censi: "An ICP variant using a point-to-line metric" (ICRA 2008), with
//! the covariance of Censi: "An accurate closed-form estimate of ICP's covariance" (ICRA 2007). Surfaces are the lines
//! of the scan, and otherwise those of a few neighbors.
//!
//! Scans are compared with a scan that is kept until the robot has left its position, so a robot that stands does not
//! drift.

mod matching;
mod rigid;
mod view;

use std::f64::consts::{FRAC_PI_2, PI};

use schema::{BEAMS, Corner, Line, Lines, Motion, MotionMethod, Pose, Scan};

use matching::{Match, Matcher};
pub use rigid::Rigid;
use rigid::Square;
use view::View;

/// Limits of the steps that are accepted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Maximum distance from one scan to the next, in meters.
    pub max_step_m: f64,
    /// Maximum turn from one scan to the next, in degrees; less than 90.
    pub max_turn_deg: f64,
    /// Minimum share of a scan's readings that lie on surfaces of the scan that it is compared with.
    pub min_overlap: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Settings { max_step_m: 0.5, max_turn_deg: 30.0, min_overlap: 0.4 }
    }
}

/// Estimates the motion of one sensor.
pub struct MotionEstimator {
    pose: Pose,
    settings: Settings,
    /// The scan that others are compared with, and the current one.
    kept: View,
    now: View,
    matcher: Matcher,
    /// `None` before the first scan.
    track: Option<Track>,
}

/// Position of the robot, and its last step.
#[derive(Clone, Copy)]
struct Track {
    /// Position at the kept scan, since the start.
    origin: Rigid,
    /// Position at the last scan, in the frame of the kept one.
    last: Rigid,
    /// Covariance of that position by the last scan's own noise; `None` if that is the kept one.
    unsure: Option<Square>,
    /// The last step.
    step: Rigid,
    breaks: u16,
}

impl MotionEstimator {
    /// Creates an estimator for a sensor at `pose` with at most `beams` beams.
    pub fn new(pose: Pose, settings: Settings, beams: usize) -> MotionEstimator {
        let beams = beams.min(BEAMS);
        MotionEstimator {
            pose,
            settings,
            kept: View::new(beams),
            now: View::new(beams),
            matcher: Matcher::new(beams),
            track: None,
        }
    }

    /// Continues with these `settings` for a sensor at `pose`. If the pose has changed, the estimator restarts.
    pub fn change(&mut self, pose: Pose, settings: Settings) {
        if self.pose != pose {
            self.forget();
        }
        (self.pose, self.settings) = (pose, settings);
    }

    /// Forgets the motion so far. The next scan is the first one.
    pub fn forget(&mut self) {
        self.track = None;
    }

    /// Writes the motion since the last scan into `out`, every byte of it. `lines` are those of `scan`.
    pub fn update(&mut self, scan: &Scan, lines: &Lines, out: &mut Motion) {
        *out = Motion::default();
        self.now.take(&self.pose, scan, lines);
        let Some(track) = self.track else {
            self.matcher.trust_all();
            let (origin, step) = (Rigid::default(), Rigid::default());
            self.keep(Track { origin, last: origin, unsure: None, step, breaks: 0 });
            return;
        };
        match self.find(&track) {
            Some((found, step)) => {
                write(&track, &found, &step, out);
                let next = Track { last: found.place, unsure: Some(found.own), step, ..track };
                let is_away = found.place.x.hypot(found.place.y) > AWAY_M || found.place.yaw.abs() > AWAY_RAD;
                if is_away || found.overlap < ENOUGH {
                    self.keep(next);
                } else {
                    self.track = Some(next);
                }
            }
            None => {
                self.matcher.trust_all();
                let breaks = track.breaks.saturating_add(1);
                (out.method, out.breaks) = (MotionMethod::Refused as u8, breaks);
                self.keep(Track { step: Rigid::default(), breaks, ..track });
            }
        }
    }

    /// Returns the robot's position and its step, if they are within the limits.
    fn find(&mut self, track: &Track) -> Option<(Match, Rigid)> {
        let Settings { max_step_m, max_turn_deg, min_overlap } = self.settings;
        let limits = Limits { step_m: max_step_m, turn_rad: max_turn_deg.to_radians() };
        let begin = initial_guess(&self.kept, &self.now, track, &limits);
        let found = self.matcher.find(&self.kept, &self.now, begin, max_step_m)?;
        let step = track.last.inverse().then(&found.place);
        let is_near = step.x.hypot(step.y) <= limits.step_m && step.yaw.abs() <= limits.turn_rad;
        (is_near && found.overlap >= min_overlap).then_some((found, step))
    }

    /// Keeps the current scan, with which later ones are compared.
    fn keep(&mut self, track: Track) {
        self.now.doubt(self.matcher.doubts());
        std::mem::swap(&mut self.kept, &mut self.now);
        let origin = track.origin.then(&track.last);
        self.track = Some(Track { origin, last: Rigid::default(), unsure: None, ..track });
    }
}

/// Maximum motion of a robot from one scan to the next.
struct Limits {
    step_m: f64,
    turn_rad: f64,
}

/// Writes `step`, which leads to `found`.
fn write(track: &Track, found: &Match, step: &Rigid, out: &mut Motion) {
    (out.dx_m, out.dy_m, out.dyaw_rad) = (step.x as f32, step.y as f32, step.yaw as f32);
    // Both scans have their own noise. That of the kept one moves both positions alike.
    let before = track.unsure.unwrap_or(found.of_kept);
    let mut covariance = rigid::of_step(&found.own, &before, &track.last, step);
    // Readings on no surface contradict this step: according to them, the robot moved as before.
    let other = [step.x - track.step.x, step.y - track.step.y, step.yaw - track.step.yaw];
    rigid::add_outer(&mut covariance, &other, 1.0 - found.overlap);
    for (place, number) in out.covariance.iter_mut().zip(covariance.as_flattened()) {
        *place = *number as f32;
    }
    out.overlap = found.overlap as f32;
    out.flags = if found.is_degenerate { Motion::DEGENERATE } else { 0 };
    out.method = match (found.has_corners, found.has_lines) {
        (true, true) => MotionMethod::Both,
        (true, false) => MotionMethod::Points,
        (false, true) => MotionMethod::Lines,
        (false, false) => MotionMethod::Beams,
    } as u8;
    let place = track.origin.then(&found.place);
    (out.x_m, out.y_m, out.yaw_rad) = (place.x, place.y, place.yaw);
    out.breaks = track.breaks;
}

/// Distance from the kept scan at which another one is kept. Its surfaces are still seen from about the same side.
const AWAY_M: f64 = 0.15;
const AWAY_RAD: f64 = 0.15;
/// Minimum share of readings on surfaces of the kept scan. With less, another scan is kept.
const ENOUGH: f64 = 0.5;

/// Returns the position in `kept`, at which the matching of `now` starts: the one that most beams agree with. Corners and lines
/// of the two scans that may be the same propose positions, and a few beams choose among them.
fn initial_guess(kept: &View, now: &View, track: &Track, limits: &Limits) -> Rigid {
    let mut best =
        Guess { kept, now, track, limits, place: track.last.then(&track.step), score: 0, tries: 0 };
    best.score = best.score(&best.place);
    best.try_place(track.last);
    best.try_corners();
    if best.score < best.beams() * 4 / 5 {
        best.try_lines();
    }
    best.place
}

struct Guess<'a> {
    kept: &'a View,
    now: &'a View,
    track: &'a Track,
    limits: &'a Limits,
    place: Rigid,
    score: usize,
    tries: usize,
}

impl Guess<'_> {
    /// Returns the number of beams that are sampled.
    fn beams(&self) -> usize {
        self.now.points().len().div_ceil(self.stride())
    }

    fn stride(&self) -> usize {
        self.now.points().len().div_ceil(ASKED).max(1)
    }

    /// Returns the number of sampled beams that end on a surface.
    fn score(&self, place: &Rigid) -> usize {
        let width = WIDTH * self.kept.noise.hypot(self.now.noise) + WIDTH_M;
        let fits = |point: &&(f64, f64)| {
            let point = place.point(**point);
            let on = self.kept.nearest(point, width + SPACING_M);
            let surface = on.and_then(|nearest| self.kept.readings()[nearest].surface);
            surface.is_some_and(|surface| surface.off(point).abs() <= width)
        };
        self.now.points().iter().step_by(self.stride()).filter(fits).count()
    }

    /// Uses `place` if the robot can be there and more beams agree with it.
    fn try_place(&mut self, place: Rigid) {
        let step = self.track.last.inverse().then(&place);
        let is_near = step.x.hypot(step.y) <= self.limits.step_m && step.yaw.abs() <= self.limits.turn_rad;
        if !is_near || self.tries >= TRIES {
            return;
        }
        self.tries += 1;
        let score = self.score(&place);
        if score > self.score {
            (self.place, self.score) = (place, score);
        }
    }

    /// Tries the positions at which corners coincide. Corners that open alike may be the same.
    fn try_corners(&mut self) {
        let (kept, now) = (self.kept, self.now);
        let opening = |view: &View, corner: &Corner| {
            let line = |number: u16| view.lines.lines().get(usize::from(number));
            let (one, two) = (line(corner.first_line)?, line(corner.second_line)?);
            Some((f64::from(one.alpha_rad), f64::from(two.alpha_rad)))
        };
        for corner in now.lines.corners() {
            let Some((first, second)) = opening(now, corner) else { continue };
            for other in kept.lines.corners() {
                let Some((of_first, of_second)) = opening(kept, other) else { continue };
                let (one, two) = (turned(first, of_first), turned(second, of_second));
                if (one - two).abs() > ALIKE_RAD {
                    continue;
                }
                let yaw = (one + two) / 2.0;
                let turn = Rigid::new(0.0, 0.0, yaw);
                let (x, y) = turn.point((corner.x_m.into(), corner.y_m.into()));
                self.try_place(Rigid::new(f64::from(other.x_m) - x, f64::from(other.y_m) - y, yaw));
            }
        }
    }

    /// Tries the positions at which lines coincide. A line defines how far the robot turned, and how far it moved
    /// across the line.
    fn try_lines(&mut self) {
        let (kept, now) = (self.kept, self.now);
        let expected = self.track.last.then(&self.track.step);
        let is_long = |line: &&Line| line.points >= LONG;
        for line in now.lines.lines().iter().filter(is_long) {
            for other in kept.lines.lines().iter().filter(is_long) {
                let (alpha, of_other) = (f64::from(line.alpha_rad), f64::from(other.alpha_rad));
                let yaw = turned(alpha, of_other);
                let (sin, cos) = of_other.sin_cos();
                // If the line is behind the robot's center, its normal points the other way.
                let is_same_side = (alpha + yaw - of_other).cos() > 0.0;
                let r = f64::from(if is_same_side { line.r_m } else { -line.r_m });
                let across = f64::from(other.r_m) - r - (cos * expected.x + sin * expected.y);
                self.try_place(Rigid::new(expected.x + cos * across, expected.y + sin * across, yaw));
            }
        }
    }
}

/// Returns the turn from one direction of a line to another, less than a quarter turn either way.
fn turned(from: f64, to: f64) -> f64 {
    (to - from + FRAC_PI_2).rem_euclid(PI) - FRAC_PI_2
}

/// Number of beams that are sampled.
const ASKED: usize = 48;
/// Maximum number of positions that are tried.
const TRIES: usize = 64;
/// Maximum distance of a beam's end from a surface, in standard deviations, and in addition to that in meters.
const WIDTH: f64 = 3.0;
const WIDTH_M: f64 = 0.01;
/// As in `matching`.
const SPACING_M: f64 = 0.2;
/// Maximum difference of the opening of equal corners: 5 degrees.
const ALIKE_RAD: f64 = 0.09;
/// Minimum number of beams of a line whose direction is reliable.
const LONG: u16 = 10;
