//! How a robot moved from scan to scan. Corners and lines of both scans are matched first, then all beams: each ends on a
//! surface of the scan that it is compared with. Refuses to know how lines are found, and what time it is.
//!
//! The method is point-to-line matching as in Censi: "An ICP variant using a point-to-line metric" (ICRA 2008), with the
//! covariance of Censi: "An accurate closed-form estimate of ICP's covariance" (ICRA 2007). Surfaces are the lines of the
//! scan where there are such, else those of a few neighbours.
//!
//! Scans are compared with a scan that is kept until the robot is away from it: a robot that stands does not drift.

mod matching;
mod rigid;
mod solve;
mod start;
mod view;

use schema::{BEAMS, Lines, Motion, MotionMethod, Pose, Scan};

use matching::{Match, Matcher};
pub use rigid::Rigid;
use solve::Square;
use view::View;

/// Which steps are believed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// A robot does not move farther from one scan to the next, in metres.
    pub max_step_m: f64,
    /// It does not turn more, in degrees; less than 90.
    pub max_turn_deg: f64,
    /// Share of a scan's readings that must lie on surfaces of the scan that it is compared with.
    pub min_overlap: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Settings { max_step_m: 0.5, max_turn_deg: 30.0, min_overlap: 0.4 }
    }
}

/// Follows the motion of one sensor.
pub struct MotionEstimator {
    pose: Pose,
    settings: Settings,
    /// The scan that others are compared with, and the one that is looked at.
    kept: View,
    now: View,
    matcher: Matcher,
    /// Nothing before the first scan.
    track: Option<Track>,
}

/// Where the robot was, and how it came there.
#[derive(Clone, Copy)]
struct Track {
    /// Where it was at the kept scan, since the start.
    origin: Rigid,
    /// Where it was at the last scan, as seen from there.
    last: Rigid,
    /// How unsure that is by the last scan's own noise; none if that is the kept one.
    unsure: Option<Square>,
    /// Its last step.
    step: Rigid,
    breaks: u16,
}

impl MotionEstimator {
    /// For a sensor that sits at `pose` and has at most `beams` beams.
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

    /// Goes on for a sensor at `pose` as `settings` say. One that sits elsewhere begins again.
    pub fn change(&mut self, pose: Pose, settings: Settings) {
        if self.pose != pose {
            self.forget();
        }
        (self.pose, self.settings) = (pose, settings);
    }

    /// The next scan is the first: what was summed up is forgotten.
    pub fn forget(&mut self) {
        self.track = None;
    }

    /// Writes how the robot moved since the last scan into `out`, every byte of it. `lines` are those of `scan`.
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

    /// Where the robot is and its step, if there is one that can be believed.
    fn find(&mut self, track: &Track) -> Option<(Match, Rigid)> {
        let Settings { max_step_m, max_turn_deg, min_overlap } = self.settings;
        let limits = Limits { step_m: max_step_m, turn_rad: max_turn_deg.to_radians() };
        let begin = start::place(&self.kept, &self.now, track, &limits);
        let found = self.matcher.find(&self.kept, &self.now, begin, max_step_m)?;
        let step = track.last.inverse().then(&found.place);
        let is_near = step.x.hypot(step.y) <= limits.step_m && step.yaw.abs() <= limits.turn_rad;
        (is_near && found.overlap >= min_overlap).then_some((found, step))
    }

    /// From now on scans are compared with the one that was looked at.
    fn keep(&mut self, track: Track) {
        self.now.doubt(self.matcher.doubts());
        std::mem::swap(&mut self.kept, &mut self.now);
        let origin = track.origin.then(&track.last);
        self.track = Some(Track { origin, last: Rigid::default(), unsure: None, ..track });
    }
}

/// How far a robot moves at most from one scan to the next.
struct Limits {
    step_m: f64,
    turn_rad: f64,
}

/// Writes `step`, which leads to `found`.
fn write(track: &Track, found: &Match, step: &Rigid, out: &mut Motion) {
    (out.dx_m, out.dy_m, out.dyaw_rad) = (step.x as f32, step.y as f32, step.yaw as f32);
    // Both scans are unsure by their own noise; that of the kept one moves both places alike.
    let before = track.unsure.unwrap_or(found.of_kept);
    let mut covariance = solve::of_step(&found.own, &before, &track.last, step);
    // Readings that lie on nothing speak against this step: by them the robot went on as before.
    let other = [step.x - track.step.x, step.y - track.step.y, step.yaw - track.step.yaw];
    solve::add_outer(&mut covariance, &other, 1.0 - found.overlap);
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

/// So far from the kept scan another one is kept: its surfaces are still seen from about the same side.
const AWAY_M: f64 = 0.15;
const AWAY_RAD: f64 = 0.15;
/// If fewer readings lie on surfaces of the kept scan, another one is kept.
const ENOUGH: f64 = 0.5;
