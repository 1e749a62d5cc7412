//! Plain matching of two scans, beginning at the place of the first: point to point by the least squares of Umeyama's method
//! in the plane, and point to line as in Censi (ICRA 2008), both with the worst tenth left out. Refuses to know the hub's.

use preprocess::motion::Rigid;
use schema::Scan;

type Point = (f64, f64);

const ROUNDS: usize = 40;
/// Points farther apart belong to nothing.
const MOST_M: f64 = 1.0;
/// What is left out.
const KEPT: f64 = 0.9;

fn points(scan: &Scan) -> Vec<Point> {
    let point = |i| {
        let (range, angle) = (scan.distance_m(i).filter(|range| *range > 0.0)?, scan.angle(i));
        Some((range * angle.cos(), range * angle.sin()))
    };
    (0..scan.beams()).filter_map(point).collect()
}

fn square((x, y): Point, (a, b): Point) -> f64 {
    (x - a) * (x - a) + (y - b) * (y - b)
}

/// For each point that is moved the nearest one of `fixed`: both numbers and the square of their distance.
fn pairs(fixed: &[Point], moved: &[Point]) -> Vec<(usize, usize, f64)> {
    let nearest = |(i, &point): (usize, &Point)| {
        let by_distance = fixed.iter().enumerate().map(|(j, &other)| (j, square(point, other)));
        let (j, square) = by_distance.min_by(|a, b| a.1.total_cmp(&b.1))?;
        (square < MOST_M * MOST_M).then_some((i, j, square))
    };
    moved.iter().enumerate().filter_map(nearest).collect()
}

fn trim<T>(mut pairs: Vec<T>, by: impl Fn(&T) -> f64) -> Vec<T> {
    pairs.sort_by(|a, b| by(a).total_cmp(&by(b)));
    pairs.truncate((KEPT * pairs.len() as f64).ceil() as usize);
    pairs
}

pub(crate) fn point_to_point(before: &Scan, now: &Scan) -> Rigid {
    let (fixed, own) = (points(before), points(now));
    let mut place = Rigid::default();
    for _ in 0..ROUNDS {
        let moved: Vec<Point> = own.iter().map(|&point| place.point(point)).collect();
        let pairs = trim(pairs(&fixed, &moved), |pair| pair.2);
        if pairs.len() < 3 {
            break;
        }
        let n = pairs.len() as f64;
        let mean = |of: &dyn Fn(&(usize, usize, f64)) -> Point| {
            let sum = pairs.iter().map(of).fold((0.0, 0.0), |sum, at| (sum.0 + at.0, sum.1 + at.1));
            (sum.0 / n, sum.1 / n)
        };
        let (a, b) = (mean(&|pair| moved[pair.0]), mean(&|pair| fixed[pair.1]));
        let (mut along, mut across) = (0.0, 0.0);
        for &(i, j, _) in &pairs {
            let (p, q) = ((moved[i].0 - a.0, moved[i].1 - a.1), (fixed[j].0 - b.0, fixed[j].1 - b.1));
            along += p.0 * q.0 + p.1 * q.1;
            across += p.0 * q.1 - p.1 * q.0;
        }
        let turn = Rigid::new(0.0, 0.0, across.atan2(along));
        let turned = turn.point(a);
        let step = Rigid::new(b.0 - turned.0, b.1 - turned.1, turn.yaw);
        place = step.then(&place);
        if step.x.hypot(step.y) < 1e-5 && step.yaw.abs() < 1e-5 {
            break;
        }
    }
    place
}

pub(crate) fn point_to_line(before: &Scan, now: &Scan) -> Rigid {
    let (fixed, own) = (points(before), points(now));
    let mut place = Rigid::default();
    for _ in 0..ROUNDS {
        let moved: Vec<Point> = own.iter().map(|&point| place.point(point)).collect();
        // The line goes through the nearest point and the nearer one of its neighbours.
        let of_pair = |(i, j, _): (usize, usize, f64)| {
            let point = moved[i];
            let neighbours = [j.checked_sub(1), Some(j + 1)].into_iter().flatten();
            let neighbours = neighbours.filter_map(|other| fixed.get(other).copied());
            let other = neighbours.min_by(|a, b| square(point, *a).total_cmp(&square(point, *b)))?;
            let (dx, dy) = (other.0 - fixed[j].0, other.1 - fixed[j].1);
            let length = dx.hypot(dy);
            let normal = (-dy / length, dx / length);
            let off = normal.0 * (point.0 - fixed[j].0) + normal.1 * (point.1 - fixed[j].1);
            (length > 0.0).then_some((point, normal, off))
        };
        let lines = pairs(&fixed, &moved).into_iter().filter_map(of_pair).collect();
        let lines = trim(lines, |(_, _, off): &(Point, Point, f64)| off.abs());
        let (mut m, mut v) = ([[0.0; 3]; 3], [0.0; 3]);
        for ((x, y), (nx, ny), off) in &lines {
            let row = [*nx, *ny, ny * x - nx * y];
            for i in 0..3 {
                v[i] -= row[i] * off;
                for j in 0..3 {
                    m[i][j] += row[i] * row[j];
                }
            }
        }
        let Some([x, y, yaw]) = solved(m, v) else { break };
        place = Rigid::new(x, y, yaw).then(&place);
        if x.hypot(y) < 1e-5 && yaw.abs() < 1e-5 {
            break;
        }
    }
    place
}

/// x of m x = v, by Cramer's rule.
pub(crate) fn solved(m: [[f64; 3]; 3], v: [f64; 3]) -> Option<[f64; 3]> {
    let of = |m: &[[f64; 3]; 3]| {
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
            + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    };
    let whole = of(&m);
    let with = |column: usize| {
        let mut other = m;
        (0..3).for_each(|row| other[row][column] = v[row]);
        of(&other) / whole
    };
    let x = [with(0), with(1), with(2)];
    x.iter().all(|value| value.is_finite()).then_some(x)
}
