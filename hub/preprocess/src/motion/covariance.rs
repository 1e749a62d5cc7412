//! Covariances of positions and steps, and their transforms: symmetric 3 x 3 matrices.

use crate::velocity::Pose2;

/// A 3 x 3 matrix, row by row. Rows and columns are x, y and yaw.
pub(super) type Square = [[f64; 3]; 3];

/// Adds the matrix `factor` v v' to `m`, where v' is the transpose of `v`.
#[inline]
pub(super) fn add_outer(m: &mut Square, v: &[f64; 3], factor: f64) {
    for i in 0..3 {
        for j in 0..3 {
            m[i][j] += factor * v[i] * v[j];
        }
    }
}

/// Returns a + b.
pub(super) fn sum(a: &Square, b: &Square) -> Square {
    std::array::from_fn(|i| std::array::from_fn(|j| a[i][j] + b[i][j]))
}

/// Returns a b.
fn product(a: &Square, b: &Square) -> Square {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

/// Returns a b a', where a' is the transpose of `a`: the covariance `b` after the linear transform `a`.
pub(super) fn transformed(a: &Square, b: &Square) -> Square {
    let transposed: Square = std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]));
    product(&product(a, b), &transposed)
}

/// Returns the eigenvalues of a symmetric matrix, and the eigenvector of each as a unit vector. The method is Jacobi's
/// rotations.
pub(super) fn eigen(mut m: Square) -> ([f64; 3], [[f64; 3]; 3]) {
    let mut vectors = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for _ in 0..JACOBI_SWEEPS {
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

/// Returns the covariance of `step`, which leads from `start` to another position in the same frame. `reference` is the
/// covariance of `start`, and `own` that of the other position. The errors of the two positions must be independent.
pub(super) fn of_step(own: &Square, reference: &Square, start: &Pose2, step: &Pose2) -> Square {
    let (x, y) = (start.turned_back((1.0, 0.0)), start.turned_back((0.0, 1.0)));
    let back = rotation(x, y);
    // Derivatives of the step with respect to the position of its start.
    let by_before = [[-x.0, -y.0, step.y], [-x.1, -y.1, -step.x], [0.0, 0.0, -1.0]];
    sum(&transformed(&back, own), &transformed(&by_before, reference))
}

/// Returns the covariance of the step `first` followed by the step `next`. The covariances of the two steps are
/// `of_first` and `of_next`, and their errors must be independent. The method is from Smith, Self and Cheeseman:
/// "Estimating uncertain spatial relationships in robotics" (1990).
pub(super) fn of_both(of_first: &Square, of_next: &Square, first: &Pose2, next: &Pose2) -> Square {
    let (x, y) = first.turned((next.x, next.y));
    let by_first = [[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]];
    sum(&transformed(&by_first, of_first), &turned(of_next, first))
}

/// Transforms the covariance `m` of a position from the frame of `pose` to the frame that contains `pose`.
pub(super) fn turned(m: &Square, pose: &Pose2) -> Square {
    transformed(&rotation(pose.turned((1.0, 0.0)), pose.turned((0.0, 1.0))), m)
}

/// Returns the rotation that turns the axes to `x` and `y`.
fn rotation(x: (f64, f64), y: (f64, f64)) -> Square {
    [[x.0, y.0, 0.0], [x.1, y.1, 0.0], [0.0, 0.0, 1.0]]
}

/// Returns the numbers of `m`, row by row.
pub(super) fn rows(m: &Square) -> [f32; 9] {
    std::array::from_fn(|i| m[i / 3][i % 3] as f32)
}

/// Number of rounds of rotations after which all digits of the three eigenvalues are right.
const JACOBI_SWEEPS: usize = 6;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eigenvectors_satisfy_their_equation() {
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
