//! Where to begin: corners and lines of two scans that may be the same say where the robot may be, and a few beams say
//! which of these places fits. Refuses to know how well a place fits that is not to begin with.

use std::f64::consts::{FRAC_PI_2, PI};

use schema::{Corner, Line};

use super::rigid::Rigid;
use super::view::View;
use super::{Limits, Track};

/// The place of `now` on `kept` that most beams agree with.
pub(super) fn place(kept: &View, now: &View, track: &Track, limits: &Limits) -> Rigid {
    let mut best = Best { kept, now, track, limits, place: track.last.then(&track.step), score: 0, tries: 0 };
    best.score = best.score(&best.place);
    best.try_place(track.last);
    best.try_corners();
    if best.score < best.beams() * 4 / 5 {
        best.try_lines();
    }
    best.place
}

struct Best<'a> {
    kept: &'a View,
    now: &'a View,
    track: &'a Track,
    limits: &'a Limits,
    place: Rigid,
    score: usize,
    tries: usize,
}

impl Best<'_> {
    /// The beams that are asked.
    fn beams(&self) -> usize {
        self.now.points().len().div_ceil(self.stride())
    }

    fn stride(&self) -> usize {
        self.now.points().len().div_ceil(ASKED).max(1)
    }

    /// How many of the beams that are asked end on a surface.
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

    /// Takes `place` if a robot can be there and more beams agree with it.
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

    /// Corners that open alike may be the same.
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

    /// Two lines that are the same say how far the robot turned and how far it moved across them.
    fn try_lines(&mut self) {
        let (kept, now) = (self.kept, self.now);
        let expected = self.track.last.then(&self.track.step);
        let is_long = |line: &&Line| line.points >= LONG;
        for line in now.lines.lines().iter().filter(is_long) {
            for other in kept.lines.lines().iter().filter(is_long) {
                let (alpha, of_other) = (f64::from(line.alpha_rad), f64::from(other.alpha_rad));
                let yaw = turned(alpha, of_other);
                let (sin, cos) = of_other.sin_cos();
                // Behind the robot's centre the normal looks the other way.
                let is_same_side = (alpha + yaw - of_other).cos() > 0.0;
                let r = f64::from(if is_same_side { line.r_m } else { -line.r_m });
                let across = f64::from(other.r_m) - r - (cos * expected.x + sin * expected.y);
                self.try_place(Rigid::new(expected.x + cos * across, expected.y + sin * across, yaw));
            }
        }
    }
}

/// From one direction of a line to another, by less than a quarter of a turn either way.
fn turned(from: f64, to: f64) -> f64 {
    (to - from + FRAC_PI_2).rem_euclid(PI) - FRAC_PI_2
}

/// Beams that are asked.
const ASKED: usize = 48;
/// Places that are tried, at most.
const TRIES: usize = 64;
/// Beams end on a surface if they are so many deviations off, and this.
const WIDTH: f64 = 3.0;
const WIDTH_M: f64 = 0.01;
/// As in matching.
const SPACING_M: f64 = 0.2;
/// Corners that open by more than 5 degrees more or less are others.
const ALIKE_RAD: f64 = 0.09;
/// Beams of a line that is sure of its direction.
const LONG: u16 = 10;
