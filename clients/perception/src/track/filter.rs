//! Where a person is and how he moves, as a linear Kalman filter: the middle between the legs with its velocity, and half
//! the way from the one leg to the other, which swings. A leg is the middle plus or minus that half. Both coordinates have
//! the same covariance. Refuses to know which leg was measured.

use nalgebra::{Matrix4, Matrix4x2, RowVector2, Vector4};

use crate::track::geometry::Point;

/// Spectral density of the body's acceleration, m2/s3.
const BODY_NOISE: f64 = 0.6;
/// How fast legs swing, radians per second: 0.8 double steps a second.
const SWING: f64 = 5.0;
/// Share of the critical damping of that swing.
const DAMPING: f64 = 0.5;
/// Spectral density of a leg's acceleration: with the two above, a leg is 0.14 m off the middle.
const LEG_NOISE: f64 = 5.0;
/// Longest step of a prediction, and how many there are at most.
const LONGEST_STEP_S: f64 = 0.05;
const MOST_STEPS: f64 = 40.0;
/// Standard deviations of somebody new: velocity, and half way between the legs.
const NEW_SPEED: f64 = 0.9;
const NEW_HALF_M: f64 = 0.17;

/// One of the two legs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Side {
    Plus,
    Minus,
}

/// The filter of one person.
#[derive(Clone, Debug)]
pub(crate) struct Filter {
    /// Rows: middle, velocity, half way, its velocity; columns x and y.
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
    /// Somebody of whom one leg is seen.
    pub(crate) fn of_leg(at: Point, sigma_m: f64) -> Filter {
        let mut covariance = Matrix4::zeros();
        let half = NEW_HALF_M * NEW_HALF_M;
        covariance[(0, 0)] = half + sigma_m * sigma_m;
        covariance[(0, 2)] = -half;
        covariance[(2, 0)] = -half;
        covariance[(2, 2)] = half;
        covariance[(1, 1)] = NEW_SPEED * NEW_SPEED;
        covariance[(3, 3)] = half * SWING * SWING;
        let mut state = Matrix4x2::zeros();
        state.set_row(0, &RowVector2::new(at[0], at[1]));
        Filter { state, covariance }
    }

    /// Moves to `dt` seconds later, in steps that are short beside a swing. Who is not seen walks on with less and less
    /// certainty: `fades`.
    pub(crate) fn predict(&mut self, dt: f64, fades: bool) {
        let steps = (dt / LONGEST_STEP_S).ceil().clamp(1.0, MOST_STEPS);
        (0..steps as usize).for_each(|_| self.step(dt / steps, fades));
    }

    fn step(&mut self, dt: f64, fades: bool) {
        let keep = if fades { (-dt / 1.5).exp() } else { 1.0 };
        let swing = Matrix4::new(
            1.0,
            dt,
            0.0,
            0.0, //
            0.0,
            keep,
            0.0,
            0.0, //
            0.0,
            0.0,
            1.0,
            dt, //
            0.0,
            0.0,
            -SWING * SWING * dt,
            (1.0 - 2.0 * DAMPING * SWING * dt).max(0.0),
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

    /// Where a leg should be, and the variance of each coordinate.
    pub(crate) fn leg(&self, side: Side) -> (Point, f64) {
        let row = side.row();
        let at = row.transpose() * self.state;
        ([at[0], at[1]], (row.transpose() * self.covariance * row)[0])
    }

    /// Takes a leg that was measured.
    pub(crate) fn correct(&mut self, side: Side, at: Point, sigma_m: f64) {
        let row = side.row();
        let reach = self.covariance * row;
        let variance = row.dot(&reach) + sigma_m * sigma_m;
        let gain = reach / variance;
        let off = RowVector2::new(at[0], at[1]) - row.transpose() * self.state;
        self.state += gain * off;
        self.covariance -= gain * reach.transpose();
    }

    /// The middle between the legs.
    pub(crate) fn place(&self) -> Point {
        [self.state[(0, 0)], self.state[(0, 1)]]
    }

    /// Metres per second.
    pub(crate) fn velocity(&self) -> Point {
        [self.state[(1, 0)], self.state[(1, 1)]]
    }

    #[cfg(test)]
    fn half(&self) -> Point {
        [self.state[(2, 0)], self.state[(2, 1)]]
    }

    /// Variance of each coordinate of the place.
    pub(crate) fn variance(&self) -> f64 {
        self.covariance[(0, 0)]
    }

    /// Puts him to `place`, where he stops: a wall is before him.
    pub(crate) fn stop(&mut self, place: Point) {
        self.state.set_row(0, &RowVector2::new(place[0], place[1]));
        self.state.set_row(1, &RowVector2::zeros());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DMatrix;

    #[test]
    fn agrees_with_the_textbook_form_by_whole_matrices() {
        // The slow way: eight states, both coordinates and both legs measured at once.
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
    fn who_is_not_seen_slows_down_and_gets_uncertain() {
        let mut filter = Filter::of_leg([0.0, 0.0], 0.03);
        for i in 0..50 {
            filter.predict(0.04, false);
            let x = 0.04 * f64::from(i);
            filter.correct(Side::Plus, [x, 0.1], 0.03);
            filter.correct(Side::Minus, [x, -0.1], 0.03);
        }
        assert!((filter.velocity()[0] - 1.0).abs() < 0.1 && filter.variance() < 0.03 * 0.03);
        let from = filter.place()[0];
        (0..250).for_each(|_| filter.predict(0.04, true));
        let walked = filter.place()[0] - from;
        assert!((1.2..1.8).contains(&walked) && filter.variance() > 0.5, "{walked} {}", filter.variance());
        assert!((filter.half()[0].powi(2) + filter.half()[1].powi(2)).sqrt() < 0.05);
    }
}
