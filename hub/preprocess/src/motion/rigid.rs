//! Geometry of the plane for motion: rigid transforms, and symmetric 3 x 3 matrices such as their covariances.

use std::f64::consts::{PI, TAU};

/// A position and a direction in some frame: meters, and radians counterclockwise from -pi to pi. Also the transform from the
/// frame of a robot there into that frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rigid {
    /// Ahead.
    pub x: f64,
    /// To the left.
    pub y: f64,
    /// Direction.
    pub yaw: f64,
    cos: f64,
    sin: f64,
}

impl Default for Rigid {
    fn default() -> Self {
        Rigid { x: 0.0, y: 0.0, yaw: 0.0, cos: 1.0, sin: 0.0 }
    }
}

impl Rigid {
    /// Creates the transform of position `x`, `y` and direction `yaw`.
    pub fn new(x: f64, y: f64, yaw: f64) -> Rigid {
        let (sin, cos) = yaw.sin_cos();
        Rigid { x, y, yaw: (yaw + PI).rem_euclid(TAU) - PI, cos, sin }
    }

    /// Returns this transform followed by `next`, which is given in the frame of this one.
    pub fn then(&self, next: &Rigid) -> Rigid {
        let (x, y) = self.point((next.x, next.y));
        Rigid::new(x, y, self.yaw + next.yaw)
    }

    /// Returns the inverse transform.
    pub fn inverse(&self) -> Rigid {
        let (x, y) = self.turned_back((-self.x, -self.y));
        Rigid::new(x, y, -self.yaw)
    }

    /// Transforms a point out of this frame.
    #[inline]
    pub fn point(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.x + self.cos * x - self.sin * y, self.y + self.sin * x + self.cos * y)
    }

    /// Transforms a direction out of this frame.
    #[inline]
    pub(super) fn turned(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.cos * x - self.sin * y, self.sin * x + self.cos * y)
    }

    /// Transforms a direction into this frame.
    pub(super) fn turned_back(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.cos * x + self.sin * y, self.cos * y - self.sin * x)
    }
}

/// Three rows.
pub(super) type Square = [[f64; 3]; 3];

/// Adds factor v v' to `m`.
#[inline]
pub(super) fn add_outer(m: &mut Square, v: &[f64; 3], factor: f64) {
    for i in 0..3 {
        for j in 0..3 {
            m[i][j] += factor * v[i] * v[j];
        }
    }
}

/// Returns a b.
pub(super) fn product(a: &Square, b: &Square) -> Square {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

/// Returns a b a'.
pub(super) fn around(a: &Square, b: &Square) -> Square {
    let transposed: Square = std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]));
    product(&product(a, b), &transposed)
}

/// The eigenvalues of a symmetric matrix, and for each its unit vector: by Jacobi's rotations.
pub(super) fn eigen(mut m: Square) -> ([f64; 3], [[f64; 3]; 3]) {
    let mut vectors = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for _ in 0..SWEEPS {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if m[p][q].abs() <= f64::MIN_POSITIVE {
                continue;
            }
            let theta = (m[q][q] - m[p][p]) / (2.0 * m[p][q]);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let cos = 1.0 / (t * t + 1.0).sqrt();
            let sin = t * cos;
            for row in &mut m {
                (row[p], row[q]) = (cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]);
            }
            for k in 0..3 {
                (m[p][k], m[q][k]) = (cos * m[p][k] - sin * m[q][k], sin * m[p][k] + cos * m[q][k]);
                (vectors[p][k], vectors[q][k]) =
                    (cos * vectors[p][k] - sin * vectors[q][k], sin * vectors[p][k] + cos * vectors[q][k]);
            }
        }
    }
    ([m[0][0], m[1][1], m[2][2]], vectors)
}

/// The covariance of `step` between two places in one frame, `before` and the next, of which each is unsure for itself: `own`
/// of the next one, `of_before`.
pub(super) fn of_step(own: &Square, of_before: &Square, before: &Rigid, step: &Rigid) -> Square {
    let (x, y) = (before.turned_back((1.0, 0.0)), before.turned_back((0.0, 1.0)));
    let back = [[x.0, y.0, 0.0], [x.1, y.1, 0.0], [0.0, 0.0, 1.0]];
    // How the step changes with the place before.
    let by_before = [[-x.0, -y.0, step.y], [-x.1, -y.1, -step.x], [0.0, 0.0, -1.0]];
    let (own, other) = (around(&back, own), around(&by_before, of_before));
    std::array::from_fn(|i| std::array::from_fn(|j| own[i][j] + other[i][j]))
}

/// Returns the covariance of `first` followed by `next`, whose covariances are `of_first` and `of_next`, as in Smith, Self and
/// Cheeseman: "Estimating uncertain spatial relationships in robotics" (1990). The two errors must be independent.
pub(super) fn of_both(of_first: &Square, of_next: &Square, first: &Rigid, next: &Rigid) -> Square {
    let (x, y) = first.turned((next.x, next.y));
    let by_first = [[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]];
    let (one, other) = (around(&by_first, of_first), turned(of_next, first));
    std::array::from_fn(|i| std::array::from_fn(|j| one[i][j] + other[i][j]))
}

/// Returns the covariance `m` of a position in the frame of `place`, in the frame that contains `place`.
pub(super) fn turned(m: &Square, place: &Rigid) -> Square {
    let (x, y) = (place.turned((1.0, 0.0)), place.turned((0.0, 1.0)));
    around(&[[x.0, y.0, 0.0], [x.1, y.1, 0.0], [0.0, 0.0, 1.0]], m)
}

/// Returns the numbers of `m`, row by row.
pub(super) fn rows(m: &Square) -> [f32; 9] {
    std::array::from_fn(|i| m[i / 3][i % 3] as f32)
}

/// Enough for all digits of three numbers.
const SWEEPS: usize = 6;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eigenvectors_are_those_of_the_matrix() {
        let mut random = fastrand::Rng::with_seed(3);
        for _ in 0..500 {
            let mut m = [[0.0; 3]; 3];
            for _ in 0..random.usize(1..5) {
                let vector = std::array::from_fn(|_| random.f64() - 0.5);
                add_outer(&mut m, &vector, 10.0_f64.powi(random.i32(-4..4)));
            }
            let size: f64 = m.as_flattened().iter().map(|value| value.abs()).sum();
            let (values, vectors) = eigen(m);
            for (value, vector) in values.iter().zip(&vectors) {
                for i in 0..3 {
                    let product: f64 = (0..3).map(|j| m[i][j] * vector[j]).sum();
                    assert!((product - value * vector[i]).abs() <= 1e-12 * size, "{m:?} {value} {vector:?}");
                }
                assert!((vector.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12);
            }
        }
    }
}
