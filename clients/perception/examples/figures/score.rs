//! Scores of point classes and obstacles, compared with the truth of a simulated hall.

use scanhub_perception::tilt::{Obstacle, PointClass, Settings, Sweep};
use scanhub_sim::room::BeamTarget;

use super::hall::Hall;

const ONE_SECOND: u64 = 1_000_000_000;

/// Number of points on people and new objects, and number of these points that were found.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PointScore {
    /// Points on people, and the number of these points that are foreground.
    pub(crate) persons: (usize, usize),
    /// Points on new objects that cannot be background yet, and the number of these points that are foreground.
    pub(crate) things: (usize, usize),
    /// Points that are foreground although nothing is new at their positions.
    pub(crate) wrong: usize,
}

impl PointScore {
    /// Adds the points of a sweep. An object counts as new until enough sweeps have met it to make it background. In
    /// the two sweeps after that, the object's points are not counted. Points of beams that graze an object are never
    /// counted.
    pub(crate) fn add(&mut self, hall: &Hall, sweep: &Sweep<'_>, settings: &Settings, sweep_ns: u64) {
        let new_ns = u64::from(settings.sweeps) * sweep_ns;
        for point in sweep.points {
            let is_found = point.class == PointClass::Foreground;
            let count = |(all, found): &mut (usize, usize)| {
                (*all, *found) = (*all + 1, *found + usize::from(is_found))
            };
            match hall.target_of(point) {
                Some(BeamTarget::Person) => count(&mut self.persons),
                Some(BeamTarget::Box { since_ns }) if point.stamp_ns < since_ns + new_ns => {
                    count(&mut self.things)
                }
                Some(BeamTarget::Box { since_ns }) if point.stamp_ns < since_ns + new_ns + 2 * sweep_ns => {}
                Some(BeamTarget::Grazed | BeamTarget::Invalid) | None => {}
                Some(_) => self.wrong += usize::from(is_found),
            }
        }
    }

    /// Returns the share of the points on people and new objects that were found.
    pub(crate) fn recall(&self) -> f64 {
        share(self.persons.1 + self.things.1, self.persons.0 + self.things.0)
    }

    /// Returns the share of the found points that are on people and new objects.
    pub(crate) fn precision(&self) -> f64 {
        let right = self.persons.1 + self.things.1;
        share(right, right + self.wrong)
    }
}

/// Counts of new objects, and of obstacles that were found.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ObstacleScore {
    /// Clusters of at least [`MIN_POINTS`] points on people and new objects, and the number of these clusters that were
    /// found.
    pub(crate) new: (usize, usize),
    /// Obstacles on new objects.
    pub(crate) right: usize,
    /// Obstacles at positions at which nothing is new.
    pub(crate) wrong: usize,
}

/// Minimum number of points of an object that must be found.
const MIN_POINTS: usize = 15;
/// Maximum distance between neighboring points of an object, in meters.
const NEIGHBOR_DISTANCE_M: f32 = 0.2;

impl ObstacleScore {
    /// Adds the obstacles of a sweep. An object counts as new as in [`PointScore::add`]. In the three sweeps after
    /// that, obstacles with its points are not counted.
    pub(crate) fn add(&mut self, hall: &Hall, sweep: &Sweep<'_>, settings: &Settings, sweep_ns: u64) {
        let new_ns = u64::from(settings.sweeps) * sweep_ns;
        let (mut new, mut open) = (Vec::new(), Vec::new());
        for point in sweep.points {
            match hall.target_of(point) {
                Some(BeamTarget::Person) => new.push(point.at),
                Some(BeamTarget::Box { since_ns }) if point.stamp_ns < since_ns + new_ns => {
                    new.push(point.at)
                }
                Some(BeamTarget::Box { since_ns }) if point.stamp_ns < since_ns + new_ns + 3 * sweep_ns => {
                    open.push(point.at);
                }
                _ => {}
            }
        }
        let is_in = |one: &Obstacle, at: &[f32; 3]| {
            (0..3).all(|i| (one.low[i] - 0.02..=one.high[i] + 0.02).contains(&at[i]))
        };
        for one in sweep.obstacles {
            let on = |points: &[[f32; 3]]| points.iter().filter(|at| is_in(one, at)).count();
            match (on(&new), on(&open)) {
                (3.., _) => self.right += 1,
                (_, 3..) => {}
                _ => self.wrong += 1,
            }
        }
        for cluster in clusters(&new).into_iter().filter(|cluster| cluster.len() >= MIN_POINTS) {
            let in_some = cluster.iter().filter(|at| sweep.obstacles.iter().any(|one| is_in(one, at)));
            self.new.0 += 1;
            self.new.1 += usize::from(2 * in_some.count() >= cluster.len());
        }
    }

    /// Returns the share of the new objects that were found.
    pub(crate) fn recall(&self) -> f64 {
        share(self.new.1, self.new.0)
    }

    /// Returns the share of the obstacles that are on new objects.
    pub(crate) fn precision(&self) -> f64 {
        share(self.right, self.right + self.wrong)
    }
}

/// Groups points that are near each other, directly or through other points.
fn clusters(points: &[[f32; 3]]) -> Vec<Vec<[f32; 3]>> {
    let mut open = points.to_vec();
    let mut clusters = Vec::new();
    while let Some(first) = open.pop() {
        let mut cluster = vec![first];
        let mut next = 0;
        while let Some(at) = cluster.get(next).copied() {
            next += 1;
            let is_near = |other: &mut [f32; 3]| {
                (0..3).map(|i| (at[i] - other[i]).powi(2)).sum::<f32>()
                    < NEIGHBOR_DISTANCE_M * NEIGHBOR_DISTANCE_M
            };
            cluster.extend(open.extract_if(.., is_near));
        }
        clusters.push(cluster);
    }
    clusters
}

/// Returns `part` divided by `all`; NaN if `all` is 0.
pub(crate) fn share(part: usize, all: usize) -> f64 {
    part as f64 / all as f64
}

/// For the pole and the box of world `tilt`: start of each sweep in ns, and whether the object was among the obstacles
/// of the sweep.
#[derive(Clone, Debug, Default)]
pub(crate) struct ObstacleTimes {
    pole: Vec<(u64, bool)>,
    boxed: Vec<(u64, bool)>,
}

impl ObstacleTimes {
    /// Adds the obstacles of a sweep.
    pub(crate) fn add(&mut self, sweep: &Sweep<'_>) {
        let found = |at: [f32; 2], wide: f32| sweep.obstacles.iter().any(|one| is_at(one, at, wide));
        // In the world, x is to the right and y is ahead.
        self.pole.push((sweep.from_ns, found([2.0, -0.3], 0.6)));
        self.boxed.push((sweep.from_ns, found([2.6, 0.9], 0.8)));
    }

    /// Returns whether the pole was found in the first sweep after it appeared.
    pub(crate) fn is_pole_found_first_sweep(&self) -> bool {
        self.pole
            .iter()
            .find(|(from_ns, _)| *from_ns >= seconds(POLE_PLACED_S))
            .is_some_and(|(_, found)| *found)
    }

    /// Returns the number of sweeps in which the pole was found, until it was background.
    pub(crate) fn sweeps_of_pole(&self) -> usize {
        self.pole.iter().filter(|(from_ns, found)| *found && *from_ns > seconds(POLE_PLACED_S - 2)).count()
    }

    /// Returns the number of sweeps in which the box was found, until it was background.
    pub(crate) fn sweeps_of_box(&self) -> usize {
        self.boxed.iter().filter(|(from_ns, found)| *found && *from_ns > seconds(BOX_PLACED_S - 2)).count()
    }
}

/// Returns whether the middle of `obstacle` is less than half of `max_width_m` away from `x` and `y`, and the
/// obstacle's width along x and y is below `max_width_m`.
fn is_at(obstacle: &Obstacle, [x, y]: [f32; 2], max_width_m: f32) -> bool {
    (obstacle.middle[0] - x).hypot(obstacle.middle[1] - y) < max_width_m / 2.0
        && obstacle.high[0] - obstacle.low[0] < max_width_m
        && obstacle.high[1] - obstacle.low[1] < max_width_m
}

/// Times at which the pole and the box of world `tilt` appear, in seconds.
const POLE_PLACED_S: u64 = 30;
const BOX_PLACED_S: u64 = 36;
/// Duration of a sweep of the mount in world `tilt`, in ns: 50 degrees at 30 degrees per second.
pub(crate) const SWEEP_TIME_NS: u64 = 1_666_666_667;

/// Converts seconds to ns.
pub(crate) const fn seconds(s: u64) -> u64 {
    s * ONE_SECOND
}
