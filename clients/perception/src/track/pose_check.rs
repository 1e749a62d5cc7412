//! Detects sensors that are not at their positions in the site file. When two sensors see legs at the same time, each
//! pair of legs votes for an offset between the sensors. Votes from different people scatter, and votes from the same
//! person agree.

use super::MisplacedSensor;
use super::geometry::Point;
use super::sensor_view::Leg;

/// Side of a cell in the grid of votes, in meters.
const CELL_M: f64 = 0.1;
/// Number of cells of the grid on each side of its middle cell, which has the votes for a zero offset.
const REACH_CELLS: usize = 10;
const GRID_WIDTH: usize = 2 * REACH_CELLS + 1;
/// Number of votes that are collected before they are evaluated and cleared.
const MIN_VOTES: u32 = 2_000;
/// Minimum offset that is reported, in meters. A smaller offset may be the distance between the two legs of a person
/// who walks from sensor to sensor.
const MIN_OFFSET_M: f64 = 0.35;
/// Minimum share of the votes that must agree on an offset, and minimum ratio of these votes to the votes for a zero
/// offset.
const MIN_AGREEING_SHARE: f64 = 0.12;
const MIN_VOTE_RATIO: u32 = 3;
/// Maximum standard deviation of the position of a leg that votes, in meters.
const MAX_SIGMA_M: f64 = 0.065;

/// Votes of all pairs of sensors.
pub(crate) struct PoseVotes {
    sensors: usize,
    /// Votes of each pair, at index `sensor * sensors + other`, where `sensor` comes later in the site than `other`.
    /// `None` before the first vote.
    pairs: Vec<Option<Box<Votes>>>,
}

struct Votes {
    cells: [u32; GRID_WIDTH * GRID_WIDTH],
    count: u32,
}

impl PoseVotes {
    pub(crate) fn new(sensors: usize) -> PoseVotes {
        PoseVotes { sensors, pairs: (0..sensors * sensors).map(|_| None).collect() }
    }

    /// Adds the votes of the legs that two sensors see at the same time. Once there are enough votes, clears them. If
    /// they agree, returns the offset of the sensor that comes later in the site.
    pub(crate) fn take(&mut self, one: (usize, &[Leg]), two: (usize, &[Leg])) -> Option<MisplacedSensor> {
        let ((other, other_legs), (sensor, own)) = if one.0 < two.0 { (one, two) } else { (two, one) };
        for leg in own.iter().filter(|leg| has_vote(leg)) {
            for of in other_legs.iter().filter(|leg| has_vote(leg)) {
                let Some(cell) = cell([leg.at[0] - of.at[0], leg.at[1] - of.at[1]]) else { continue };
                let votes = self.pairs[sensor * self.sensors + other].get_or_insert_with(Box::default);
                votes.cells[cell] += 1;
                votes.count += 1;
            }
        }
        let votes =
            self.pairs[sensor * self.sensors + other].as_mut().filter(|votes| votes.count >= MIN_VOTES)?;
        let off = votes.offset();
        **votes = Votes::default();
        let off = off?;
        let of_sensor = |at: &usize| at / self.sensors == sensor || at % self.sensors == sensor;
        let pairs = self.pairs.iter_mut().enumerate().filter(|(at, _)| of_sensor(at));
        pairs.for_each(|(_, votes)| *votes = None);
        Some(MisplacedSensor { sensor, other, offset: off })
    }
}

fn has_vote(leg: &Leg) -> bool {
    leg.is_fresh && leg.sigma_m < MAX_SIGMA_M
}

fn cell(off: Point) -> Option<usize> {
    // The centers of the cells are multiples of [`CELL_M`].
    let [x, y] = off.map(|value| value * (1.0 / CELL_M) + (REACH_CELLS as f64 + 0.5));
    let is_in = |value: f64| (0.0..GRID_WIDTH as f64).contains(&value);
    (is_in(x) && is_in(y)).then_some(y as usize * GRID_WIDTH + x as usize)
}

impl Default for Votes {
    fn default() -> Votes {
        Votes { cells: [0; GRID_WIDTH * GRID_WIDTH], count: 0 }
    }
}

impl Votes {
    /// Returns the offset with the most votes. Returns `None` if most votes are for a zero offset, or the votes do not
    /// agree.
    fn offset(&self) -> Option<Point> {
        let inner = || (1..GRID_WIDTH - 1).flat_map(|y| (1..GRID_WIDTH - 1).map(move |x| (x, y)));
        let (x, y) = inner().max_by_key(|&at| self.votes_around(at))?;
        let (most, none) = (self.votes_around((x, y)), self.votes_around((REACH_CELLS, REACH_CELLS)));
        let mut off = [0.0; 2];
        for (x, y) in [0, 1, 2].into_iter().flat_map(|dy| [0, 1, 2].map(|dx| (x + dx - 1, y + dy - 1))) {
            let share = f64::from(self.cells[y * GRID_WIDTH + x]) / f64::from(most.max(1));
            off[0] += share * CELL_M * (x as f64 - REACH_CELLS as f64);
            off[1] += share * CELL_M * (y as f64 - REACH_CELLS as f64);
        }
        let is_far = (off[0] * off[0] + off[1] * off[1]).sqrt() > MIN_OFFSET_M;
        let agree =
            f64::from(most) > MIN_AGREEING_SHARE * f64::from(self.count) && most > MIN_VOTE_RATIO * none;
        (is_far && agree).then_some(off)
    }

    fn votes_around(&self, (x, y): (usize, usize)) -> u32 {
        (y - 1..=y + 1)
            .map(|y| self.cells[y * GRID_WIDTH + x - 1..=y * GRID_WIDTH + x + 1].iter().sum::<u32>())
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::track::sensor_view::DoorProximity;

    /// Returns the result for three people at random positions. The second sensor is misplaced by `off`.
    fn detect_misplaced(off: Point) -> Option<MisplacedSensor> {
        let mut random = fastrand::Rng::with_seed(4);
        let mut poses = PoseVotes::new(3);
        let leg = |at| Leg {
            at,
            sigma_m: 0.04,
            is_fresh: true,
            is_ignored: false,
            is_solid: true,
            beams: 5,
            is_free: true,
            at_door: DoorProximity::Clear,
        };
        (0..2_000).find_map(|_| {
            let mut position = || [6.0 * random.f64(), 5.0 * random.f64()];
            let positions: Vec<Point> = (0..3).map(|_| position()).collect();
            let mut noisy = |off: Point| -> Vec<Leg> {
                let mut near = || 0.05 * (random.f64() - 0.5);
                positions.iter().map(|p| leg([p[0] + off[0] + near(), p[1] + off[1] + near()])).collect()
            };
            let (first, second) = (noisy([0.0, 0.0]), noisy(off));
            poses.take((2, &second), (0, &first))
        })
    }

    #[test]
    fn only_a_clearly_misplaced_sensor_is_detected() {
        let misplaced = detect_misplaced([0.4, -0.3]).expect("half a meter");
        assert_eq!((misplaced.sensor, misplaced.other), (2, 0));
        assert!(
            (misplaced.offset[0] - 0.4).abs() < 0.03 && (misplaced.offset[1] + 0.3).abs() < 0.03,
            "{misplaced:?}"
        );
        assert_eq!(detect_misplaced([0.0, 0.0]), None);
        assert_eq!(detect_misplaced([0.1, 0.2]), None, "that little may be the legs");
    }

    #[test]
    fn uncertain_legs_do_not_vote_on_poses() {
        let mut poses = PoseVotes::new(2);
        let leg = |x, is_fresh| Leg {
            at: [x, 0.0],
            sigma_m: 0.07,
            is_fresh,
            is_ignored: false,
            is_solid: true,
            beams: 5,
            is_free: true,
            at_door: DoorProximity::Clear,
        };
        for _ in 0..3_000 {
            assert_eq!(poses.take((0, &[leg(0.0, true)]), (1, &[leg(0.5, true)])), None);
        }
        assert!(poses.pairs.iter().all(Option::is_none));
    }
}
