//! State of a tracked person: the evidence for and against a person, and a linear Kalman filter of position and
//! velocity.
//!
//! The state of the filter is the middle between the legs, half of the vector from one leg to the other, and the
//! velocities of the middle and of this half vector. The half vector oscillates. A leg is at the middle plus or minus
//! the half vector. x and y have the same covariance.

use nalgebra::{Matrix4, Matrix4x2, RowVector2, Vector4};
use scanhub_schema::TrackState;

use super::geometry::{Point, distance};
use super::sensor_view::Leg;
use super::site::MAX_SENSORS;

/// State of one tracked person.
pub(crate) struct Person {
    pub(crate) id: u64,
    pub(crate) filter: Filter,
    /// Time of the filter's state in ns.
    pub(crate) at_ns: u64,
    pub(crate) first_seen_ns: u64,
    /// Position at which the person was first seen.
    pub(crate) first_position: Point,
    pub(crate) phase: TrackPhase,
    /// Time at which a leg of the person was last seen.
    pub(crate) last_seen_ns: u64,
    /// Time at which a leg of the person was last seen outside the ignored areas.
    pub(crate) last_free_ns: u64,
    /// Time at which each sensor last saw the person; 0 if the sensor has never seen the person.
    pub(crate) seen_by_ns: [u64; MAX_SENSORS],
    /// Number of scans that are evidence for the person, at most [`MAX_SUPPORT`]. A scan of a slow sensor counts up to
    /// twice.
    pub(crate) support: f64,
    /// Number of scans that showed both legs.
    pub(crate) pairs: f64,
    /// Time for which sensors have seen through the person's position, in seconds.
    pub(crate) absent_s: f64,
    /// Walking speed in m/s.
    pub(crate) pace: f64,
    pub(crate) room: Option<usize>,
    /// Door through which the person entered the room; `None` if no sensor saw the person go through a door.
    pub(crate) entry_door: Option<usize>,
    /// Share of the recent scans of the person that show both legs.
    pub(crate) both: f64,
}

/// Phase of a track.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum TrackPhase {
    Tentative,
    Known,
    /// The person has been out of sight since `since_ns`, in a room without sensors. `door` is the door through which
    /// they entered this room, or otherwise the nearest door.
    Away {
        since_ns: u64,
        door: usize,
    },
}

/// Minimum number of scans that must show a person before the person is confirmed.
const MIN_SCANS: f64 = 8.0;
pub(crate) const MAX_SUPPORT: f64 = 20.0;
/// Maximum period of a sensor whose scans count once, in seconds. Scans of a slower sensor count up to twice.
/// Otherwise, a sensor with 7.5 Hz would need a second to confirm a person.
const FULL_WEIGHT_PERIOD_S: f64 = 0.0625;
/// Minimum number of beams on a leg at which it cannot be the leg of a chair.
const MIN_CLEAR_BEAMS: usize = 4;
/// Weight of a leg with fewer than [`MIN_CLEAR_BEAMS`] beams, compared with a scan that sees through the position.
pub(crate) const COARSE_WEIGHT: f64 = 0.5;
/// Minimum age of a person who can be confirmed, in ns.
const MIN_TRACK_AGE_NS: u64 = 300_000_000;
/// Time after the last sighting during which a person does not count as hidden, in ns.
const RECENT_NS: u64 = 250_000_000;

impl Person {
    pub(crate) fn new(id: u64, at_ns: u64, legs: &[Leg]) -> Person {
        let mut filter = Filter::of_leg(legs[0].at, legs[0].sigma_m);
        if let Some(other) = legs.get(1) {
            filter.correct(Side::Minus, other.at, other.sigma_m);
        }
        Person {
            id,
            first_position: filter.position(),
            filter,
            at_ns,
            first_seen_ns: at_ns,
            phase: TrackPhase::Tentative,
            last_seen_ns: at_ns,
            last_free_ns: at_ns,
            seen_by_ns: [0; MAX_SENSORS],
            support: 1.0,
            pairs: if legs.len() > 1 { 1.0 } else { 0.0 },
            absent_s: 0.0,
            pace: 1.1,
            room: None,
            entry_door: None,
            both: if legs.len() > 1 { 1.0 } else { 0.0 },
        }
    }

    /// Predicts the filter's state at `at_ns`.
    pub(crate) fn predict(&mut self, at_ns: u64) {
        if at_ns > self.at_ns {
            let dt = (at_ns - self.at_ns) as f64 * 1e-9;
            let fades = at_ns - self.last_seen_ns > RECENT_NS;
            self.filter.predict(dt, fades);
            self.at_ns = at_ns;
        }
    }

    /// Handles a scan of `sensor` that showed `legs` legs of the person. `beams` is the number of beams on one of the
    /// legs. The sensor's previous scan was `since_s` seconds earlier.
    pub(crate) fn on_detection(&mut self, sensor: usize, since_s: f64, legs: usize, beams: usize) {
        self.last_seen_ns = self.at_ns;
        self.seen_by_ns[sensor] = self.at_ns;
        // A few beams may also be on a chair leg, so do not cancel the contradiction of another sensor completely.
        self.absent_s =
            if beams < MIN_CLEAR_BEAMS { (self.absent_s - COARSE_WEIGHT * since_s).max(0.0) } else { 0.0 };
        let both = if legs > 1 { 1.0 } else { 0.0 };
        self.pairs += both;
        self.both += 0.05 * (both - self.both);
        self.support = (self.support + (since_s / FULL_WEIGHT_PERIOD_S).clamp(1.0, 2.0)).min(MAX_SUPPORT);
        let speed = self.speed();
        if speed > 0.5 {
            // A person who turns or gives way is slower than their pace, so the pace adapts more slowly to a lower
            // speed.
            self.pace += if speed > self.pace { 0.03 } else { 0.01 } * (speed - self.pace);
        }
    }

    pub(crate) fn speed(&self) -> f64 {
        let [x, y] = self.filter.velocity();
        (x * x + y * y).sqrt()
    }

    /// Returns whether this track is certainly a person: it was seen often enough, and with two legs or in motion.
    pub(crate) fn is_certain(&self) -> bool {
        let walked_m = distance(self.filter.position(), self.first_position);
        self.support >= MIN_SCANS
            && self.at_ns - self.first_seen_ns >= MIN_TRACK_AGE_NS
            && (self.pairs >= 3.0 || walked_m > 0.3)
    }

    pub(crate) fn is_known(&self) -> bool {
        self.phase == TrackPhase::Known
    }

    pub(crate) fn state(&self, now_ns: u64) -> TrackState {
        match self.phase {
            TrackPhase::Tentative => TrackState::Tentative,
            TrackPhase::Away { .. } => TrackState::BetweenRooms,
            TrackPhase::Known if now_ns.saturating_sub(self.last_seen_ns) > RECENT_NS => TrackState::Hidden,
            TrackPhase::Known => TrackState::Confirmed,
        }
    }

    /// Returns the sensors that have seen the person within the last 250 ms. Bit i stands for the sensor with index i.
    pub(crate) fn sensors(&self, now_ns: u64) -> u32 {
        let is_recent = |&at: &u64| at > 0 && now_ns.saturating_sub(at) <= RECENT_NS;
        (0..)
            .zip(&self.seen_by_ns)
            .filter(|(_, at)| is_recent(at))
            .map(|(sensor, _): (u32, _)| 1 << sensor)
            .sum()
    }
}

/// Spectral density of the body's acceleration in m2/s3.
const BODY_NOISE: f64 = 0.6;
/// Angular frequency at which legs oscillate, in rad/s: 0.8 double steps per second.
const SWING_RATE_RAD_S: f64 = 5.0;
/// Damping of the legs' oscillation as a share of the critical damping.
const DAMPING: f64 = 0.5;
/// Spectral density of a leg's acceleration in m2/s3. With this value, [`SWING_RATE_RAD_S`] and [`DAMPING`], the
/// distance of a leg from the middle is 0.14 m.
const LEG_NOISE: f64 = 5.0;
/// Maximum length of a prediction step in seconds, and maximum number of steps.
const MAX_STEP_S: f64 = 0.05;
const MAX_STEPS: f64 = 40.0;
/// Standard deviations in the filter of a new person: velocity in m/s, and half of the distance between the legs in m.
const INITIAL_SPEED_M_S: f64 = 0.9;
const INITIAL_HALF_DISTANCE_M: f64 = 0.17;

/// One of the two legs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Side {
    Plus,
    Minus,
}

/// Kalman filter of one person.
#[derive(Clone, Debug)]
pub(crate) struct Filter {
    /// Rows: middle, velocity of the middle, half vector between the legs, and velocity of this vector. Columns: x and
    /// y.
    state: Matrix4x2<f64>,
    covariance: Matrix4<f64>,
}

impl Side {
    pub(crate) const BOTH: [Side; 2] = [Side::Plus, Side::Minus];

    fn row(self) -> Vector4<f64> {
        let sign = if self == Side::Plus { 1.0 } else { -1.0 };
        Vector4::new(1.0, 0.0, sign, 0.0)
    }
}

impl Filter {
    /// Creates the filter of a person with one detected leg, at `at`.
    pub(crate) fn of_leg(at: Point, sigma_m: f64) -> Filter {
        let mut covariance = Matrix4::zeros();
        let half = INITIAL_HALF_DISTANCE_M * INITIAL_HALF_DISTANCE_M;
        covariance[(0, 0)] = half + sigma_m * sigma_m;
        covariance[(0, 2)] = -half;
        covariance[(2, 0)] = -half;
        covariance[(2, 2)] = half;
        covariance[(1, 1)] = INITIAL_SPEED_M_S * INITIAL_SPEED_M_S;
        covariance[(3, 3)] = half * SWING_RATE_RAD_S * SWING_RATE_RAD_S;
        let mut state = Matrix4x2::zeros();
        state.set_row(0, &RowVector2::new(at[0], at[1]));
        Filter { state, covariance }
    }

    /// Predicts the state after `dt` seconds, in time steps that are short compared with a double step of a person. If
    /// `fades` is true, the velocity decays, because no sensor sees the person.
    pub(crate) fn predict(&mut self, dt: f64, fades: bool) {
        let steps = (dt / MAX_STEP_S).ceil().clamp(1.0, MAX_STEPS);
        (0..steps as usize).for_each(|_| self.step(dt / steps, fades));
    }

    fn step(&mut self, dt: f64, fades: bool) {
        let keep = if fades { (-dt / 1.5).exp() } else { 1.0 };
        #[rustfmt::skip]
        let swing = Matrix4::new(
            1.0, dt, 0.0, 0.0,
            0.0, keep, 0.0, 0.0,
            0.0, 0.0, 1.0, dt,
            0.0, 0.0, -SWING_RATE_RAD_S * SWING_RATE_RAD_S * dt, (1.0 - 2.0 * DAMPING * SWING_RATE_RAD_S * dt).max(0.0),
        );
        self.state = swing * self.state;
        self.covariance = swing * self.covariance * swing.transpose();
        for (row, noise) in [(0, BODY_NOISE), (2, LEG_NOISE)] {
            self.covariance[(row, row)] += noise * dt * dt * dt / 3.0;
            self.covariance[(row, row + 1)] += noise * dt * dt / 2.0;
            self.covariance[(row + 1, row)] += noise * dt * dt / 2.0;
            self.covariance[(row + 1, row + 1)] += noise * dt;
        }
    }

    /// Returns the expected position of a leg, and the variance of each coordinate in m2.
    pub(crate) fn leg(&self, side: Side) -> (Point, f64) {
        let row = side.row();
        let at = row.transpose() * self.state;
        ([at[0], at[1]], (row.transpose() * self.covariance * row)[0])
    }

    /// Corrects the state with a measured leg.
    pub(crate) fn correct(&mut self, side: Side, at: Point, sigma_m: f64) {
        let row = side.row();
        let reach = self.covariance * row;
        let variance = row.dot(&reach) + sigma_m * sigma_m;
        let gain = reach / variance;
        let off = RowVector2::new(at[0], at[1]) - row.transpose() * self.state;
        self.state += gain * off;
        self.covariance -= gain * reach.transpose();
    }

    /// Returns the middle between the legs, in the map, in meters.
    pub(crate) fn position(&self) -> Point {
        [self.state[(0, 0)], self.state[(0, 1)]]
    }

    /// Returns the velocity in m/s.
    pub(crate) fn velocity(&self) -> Point {
        [self.state[(1, 0)], self.state[(1, 1)]]
    }

    #[cfg(test)]
    fn half(&self) -> Point {
        [self.state[(2, 0)], self.state[(2, 1)]]
    }

    /// Returns the variance of each coordinate of the position in m2.
    pub(crate) fn variance(&self) -> f64 {
        self.covariance[(0, 0)]
    }

    /// Stops the person at `position`, in front of a wall.
    pub(crate) fn stop(&mut self, position: Point) {
        self.state.set_row(0, &RowVector2::new(position[0], position[1]));
        self.state.set_row(1, &RowVector2::zeros());
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use super::*;
    use crate::track::sensor_view::DoorProximity;

    #[test]
    fn confirmation_takes_300_to_800_ms_by_scan_rate() {
        const MS: u64 = 1_000_000;
        let legs = [-0.1, 0.1].map(|y| Leg {
            at: [2.0, y],
            sigma_m: 0.03,
            is_fresh: true,
            is_ignored: false,
            is_solid: true,
            beams: 5,
            is_free: true,
            at_door: DoorProximity::Clear,
        });
        let known_after_ms = |every_ms: u64| {
            let mut person = Person::new(1, MS, &legs);
            let mut after_ms = 0;
            while !person.is_certain() {
                after_ms += every_ms;
                person.predict(MS * (1 + after_ms));
                person.on_detection(0, every_ms as f64 * 1e-3, 2, 5);
            }
            after_ms
        };
        assert_eq!(known_after_ms(10), 300);
        assert_eq!(known_after_ms(50), 350);
        assert_eq!(known_after_ms(60), 420);
        assert_eq!(known_after_ms(100), 500);
        assert_eq!(known_after_ms(133), 532);
        assert_eq!(known_after_ms(200), 800);
    }

    #[test]
    fn filter_agrees_with_the_textbook_form() {
        // Textbook form of the filter: eight states, with both coordinates and both legs measured at once.
        let mut random = fastrand::Rng::with_seed(2);
        let mut filter = Filter::of_leg([1.0, 2.0], 0.03);
        for _ in 0..200 {
            let dt = 0.005 + 0.05 * random.f64();
            let before = filter.clone();
            filter.predict(dt, false);
            let legs = [0, 1].map(|_| [1.0 + random.f64(), 2.0 + random.f64()]);
            let wide = |m: &Matrix4<f64>| {
                DMatrix::from_fn(8, 8, |i, j| if i / 4 == j / 4 { m[(i % 4, j % 4)] } else { 0.0 })
            };
            let predicted = filter.clone();
            let p = wide(&predicted.covariance);
            let h = DMatrix::from_fn(4, 8, |i, j| {
                let side = if i % 2 == 0 { Side::Plus } else { Side::Minus };
                if i / 2 == j / 4 { side.row()[j % 4] } else { 0.0 }
            });
            let s = &h * &p * h.transpose() + DMatrix::identity(4, 4) * 0.03 * 0.03;
            let gain = &p * h.transpose() * s.try_inverse().unwrap();
            let x = DMatrix::from_fn(8, 1, |i, _| predicted.state[(i % 4, i / 4)]);
            let z = DMatrix::from_fn(4, 1, |i, _| legs[i % 2][i / 2]);
            let x = &x + &gain * (z - &h * &x);
            let p = (DMatrix::identity(8, 8) - &gain * &h) * p;
            filter.correct(Side::Plus, legs[0], 0.03);
            filter.correct(Side::Minus, legs[1], 0.03);
            for i in 0..8 {
                assert!((x[(i, 0)] - filter.state[(i % 4, i / 4)]).abs() < 1e-6, "after {before:?}");
            }
            assert!((&p - wide(&filter.covariance)).amax() < 1e-6);
        }
    }

    #[test]
    fn occluded_person_slows_down_and_gets_uncertain() {
        let mut filter = Filter::of_leg([0.0, 0.0], 0.03);
        for i in 0..50 {
            filter.predict(0.04, false);
            let x = 0.04 * f64::from(i);
            filter.correct(Side::Plus, [x, 0.1], 0.03);
            filter.correct(Side::Minus, [x, -0.1], 0.03);
        }
        assert!((filter.velocity()[0] - 1.0).abs() < 0.1 && filter.variance() < 0.03 * 0.03);
        let from = filter.position()[0];
        (0..250).for_each(|_| filter.predict(0.04, true));
        let walked = filter.position()[0] - from;
        assert!((1.2..1.8).contains(&walked) && filter.variance() > 0.5, "{walked} {}", filter.variance());
        assert!((filter.half()[0].powi(2) + filter.half()[1].powi(2)).sqrt() < 0.05);
    }
}
