//! Detects sensors that are not where the site file says. When two sensors see legs at the same time, each pair of legs votes
//! for an offset between the sensors. Votes from different people scatter; votes from the same person agree.

use super::Misplaced;
use super::geometry::Point;
use super::sensor_view::Leg;

/// Side of a cell of the votes, in meters.
const CELL_M: f64 = 0.1;
/// Number of cells on each side of a zero offset.
const REACH: usize = 10;
const ACROSS: usize = 2 * REACH + 1;
/// Number of votes that are evaluated.
const ENOUGH: u32 = 2_000;
/// Minimum offset. A smaller one may be the two legs of a person who walks from sensor to sensor.
const LEAST_M: f64 = 0.35;
/// Minimum share of the votes that agree, and their minimum ratio to the votes for no offset.
const AGREE: f64 = 0.12;
const TIMES: u32 = 3;
/// Maximum standard deviation of a leg that votes.
const WORST_M: f64 = 0.065;

/// Votes of all pairs of sensors.
pub(crate) struct PoseVotes {
    sensors: usize,
    /// By the index of the later sensor in the site, and then of the earlier one. `None` before the first vote.
    pairs: Vec<Option<Box<Votes>>>,
}

struct Votes {
    cells: [u32; ACROSS * ACROSS],
    count: u32,
}

impl PoseVotes {
    pub(crate) fn new(sensors: usize) -> PoseVotes {
        PoseVotes { sensors, pairs: (0..sensors * sensors).map(|_| None).collect() }
    }

    /// Takes the legs that two sensors see at the same time. Returns the offset of the later sensor in the site once
    /// it is known. Its votes then restart.
    pub(crate) fn take(&mut self, one: (usize, &[Leg]), two: (usize, &[Leg])) -> Option<Misplaced> {
        let ((other, theirs), (sensor, own)) = if one.0 < two.0 { (one, two) } else { (two, one) };
        for leg in own.iter().filter(|leg| has_vote(leg)) {
            for of in theirs.iter().filter(|leg| has_vote(leg)) {
                let Some(cell) = cell([leg.at[0] - of.at[0], leg.at[1] - of.at[1]]) else { continue };
                let votes = self.pairs[sensor * self.sensors + other].get_or_insert_with(Box::default);
                votes.cells[cell] += 1;
                votes.count += 1;
            }
        }
        let votes =
            self.pairs[sensor * self.sensors + other].as_mut().filter(|votes| votes.count >= ENOUGH)?;
        let off = votes.off();
        **votes = Votes::default();
        let off = off?;
        let of_sensor = |at: &usize| at / self.sensors == sensor || at % self.sensors == sensor;
        let pairs = self.pairs.iter_mut().enumerate().filter(|(at, _)| of_sensor(at));
        pairs.for_each(|(_, votes)| *votes = None);
        Some(Misplaced { sensor, other, off })
    }
}

fn has_vote(leg: &Leg) -> bool {
    leg.is_fresh && leg.sigma_m < WORST_M
}

fn cell(off: Point) -> Option<usize> {
    // Cells lie around the multiples of their side.
    let [x, y] = off.map(|value| value * (1.0 / CELL_M) + (REACH as f64 + 0.5));
    let is_in = |value: f64| (0.0..ACROSS as f64).contains(&value);
    (is_in(x) && is_in(y)).then_some(y as usize * ACROSS + x as usize)
}

impl Default for Votes {
    fn default() -> Votes {
        Votes { cells: [0; ACROSS * ACROSS], count: 0 }
    }
}

impl Votes {
    /// Returns the offset that most votes are for. `None` if they are for no offset, or do not agree.
    fn off(&self) -> Option<Point> {
        let inner = || (1..ACROSS - 1).flat_map(|y| (1..ACROSS - 1).map(move |x| (x, y)));
        let (x, y) = inner().max_by_key(|&at| self.around(at))?;
        let (most, none) = (self.around((x, y)), self.around((REACH, REACH)));
        let mut off = [0.0; 2];
        for (x, y) in [0, 1, 2].into_iter().flat_map(|dy| [0, 1, 2].map(|dx| (x + dx - 1, y + dy - 1))) {
            let share = f64::from(self.cells[y * ACROSS + x]) / f64::from(most.max(1));
            off[0] += share * CELL_M * (x as f64 - REACH as f64);
            off[1] += share * CELL_M * (y as f64 - REACH as f64);
        }
        let is_far = (off[0] * off[0] + off[1] * off[1]).sqrt() > LEAST_M;
        let agree = f64::from(most) > AGREE * f64::from(self.count) && most > TIMES * none;
        (is_far && agree).then_some(off)
    }

    fn around(&self, (x, y): (usize, usize)) -> u32 {
        (y - 1..=y + 1).map(|y| self.cells[y * ACROSS + x - 1..=y * ACROSS + x + 1].iter().sum::<u32>()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::track::sensor_view::AtDoor;

    /// Returns the result for three people who stand anywhere, if the second sensor is off by `off`.
    fn told(off: Point) -> Option<Misplaced> {
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
            at_door: AtDoor::Clear,
        };
        (0..2_000).find_map(|_| {
            let mut place = || [6.0 * random.f64(), 5.0 * random.f64()];
            let places: Vec<Point> = (0..3).map(|_| place()).collect();
            let mut noisy = |off: Point| -> Vec<Leg> {
                let mut near = || 0.05 * (random.f64() - 0.5);
                places.iter().map(|p| leg([p[0] + off[0] + near(), p[1] + off[1] + near()])).collect()
            };
            let (first, second) = (noisy([0.0, 0.0]), noisy(off));
            poses.take((2, &second), (0, &first))
        })
    }

    #[test]
    fn a_sensor_that_is_off_is_told_and_one_that_is_not_is_not() {
        let misplaced = told([0.4, -0.3]).expect("half a metre");
        assert_eq!((misplaced.sensor, misplaced.other), (2, 0));
        assert!(
            (misplaced.off[0] - 0.4).abs() < 0.03 && (misplaced.off[1] + 0.3).abs() < 0.03,
            "{misplaced:?}"
        );
        assert_eq!(told([0.0, 0.0]), None);
        assert_eq!(told([0.1, 0.2]), None, "that little may be the legs");
    }

    #[test]
    fn legs_that_are_not_known_well_say_nothing() {
        let mut poses = PoseVotes::new(2);
        let leg = |x, is_fresh| Leg {
            at: [x, 0.0],
            sigma_m: 0.07,
            is_fresh,
            is_ignored: false,
            is_solid: true,
            beams: 5,
            is_free: true,
            at_door: AtDoor::Clear,
        };
        for _ in 0..3_000 {
            assert_eq!(poses.take((0, &[leg(0.0, true)]), (1, &[leg(0.5, true)])), None);
        }
        assert!(poses.pairs.iter().all(Option::is_none));
    }
}
