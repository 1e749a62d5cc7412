//! Plain ways to find lines, each with the number of vertices as its only bound: iterative end-point fit, split and merge,
//! and RANSAC. Of J vertices there are J - 1 lines. Refuses to know scores.

use fastrand::Rng;
use schema::Scan;

use crate::score::Found;

/// A beam that returned.
#[derive(Clone, Copy)]
struct Point {
    beam: usize,
    x: f64,
    y: f64,
}

fn points(scan: &Scan) -> Vec<Point> {
    let point = |beam| {
        let (range, angle) = (scan.distance_m(beam)?, scan.angle(beam));
        Some(Point { beam, x: range * angle.cos(), y: range * angle.sin() })
    };
    (0..scan.beams()).filter_map(point).collect()
}

/// Distance from the sensor and direction of the nearest point of the line with this normal through (x, y).
fn normal_form(normal: (f64, f64), x: f64, y: f64) -> (f64, f64) {
    let r = normal.0 * x + normal.1 * y;
    let turned = if r < 0.0 { -1.0 } else { 1.0 };
    (turned * r, (turned * normal.1).atan2(turned * normal.0))
}

fn through(a: Point, b: Point) -> (f64, f64) {
    let length = (b.x - a.x).hypot(b.y - a.y).max(1e-12);
    normal_form(((b.y - a.y) / length, (a.x - b.x) / length), a.x, a.y)
}

/// The point farthest from the straight line between two.
fn farthest(points: &[Point], first: usize, last: usize) -> (f64, usize) {
    let (a, b) = (points[first], points[last]);
    let length = (b.x - a.x).hypot(b.y - a.y);
    let distance = |p: Point| {
        if length < 1e-9 {
            return (p.x - a.x).hypot(p.y - a.y);
        }
        ((p.x - a.x) * (b.y - a.y) - (p.y - a.y) * (b.x - a.x)).abs() / length
    };
    (first + 1..last)
        .map(|i| (distance(points[i]), i))
        .fold((0.0, first), |best, one| if one.0 > best.0 { one } else { best })
}

/// The numbers of the vertices of the polyline, which begins with both ends: always the farthest point of all.
fn vertices(points: &[Point], count: usize) -> Vec<usize> {
    let mut vertices = vec![0, points.len() - 1];
    let mut splits = vec![farthest(points, 0, points.len() - 1)];
    while vertices.len() < count.min(points.len()) {
        let best = (0..splits.len()).max_by(|&a, &b| splits[a].0.total_cmp(&splits[b].0)).unwrap_or(0);
        let (distance, at) = splits[best];
        if distance == 0.0 {
            break;
        }
        vertices.insert(best + 1, at);
        splits[best] = farthest(points, vertices[best], at);
        splits.insert(best + 1, farthest(points, at, vertices[best + 2]));
    }
    vertices
}

/// The beams that meet the line between the ends that its outermost points have on it.
fn met(points: &[Point], (r, alpha): (f64, f64)) -> Option<(usize, usize, f64, f64)> {
    let (first, last) = (points.first()?, points.last()?);
    let (sin, cos) = alpha.sin_cos();
    // How far to the left of the direction of the end on the line a point is seen, in radians.
    let left_of = |p: &Point, end: &Point| {
        let off = end.x * cos + end.y * sin - r;
        let (x, y) = (end.x - off * cos, end.y - off * sin);
        (x * p.y - y * p.x).atan2(x * p.x + y * p.y)
    };
    let mut inside = points.iter().filter(|p| left_of(p, first) >= -1e-3 && left_of(p, last) <= 1e-3);
    let begin = inside.next()?;
    let end = inside.next_back().unwrap_or(begin);
    Some((begin.beam, end.beam, r, alpha))
}

/// Iterative end-point fit: the polyline through some of the points.
pub(crate) fn end_points(scan: &Scan, count: usize) -> Found {
    let points = points(scan);
    let mut lines = Vec::new();
    if points.len() > 1 {
        for pair in vertices(&points, count).windows(2) {
            let (a, b) = (points[pair[0]], points[pair[1]]);
            let (r, alpha) = through(a, b);
            lines.push((a.beam, b.beam, r, alpha));
        }
    }
    Found { lines }
}

/// The line of least squares at right angles, and the sum of these squares.
fn regression(points: &[Point]) -> ((f64, f64), f64) {
    let n = points.len() as f64;
    let (x, y) = points.iter().fold((0.0, 0.0), |(x, y), p| (x + p.x / n, y + p.y / n));
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for p in points {
        xx += (p.x - x) * (p.x - x);
        xy += (p.x - x) * (p.y - y);
        yy += (p.y - y) * (p.y - y);
    }
    let along = 0.5 * (2.0 * xy).atan2(xx - yy);
    let normal = (-along.sin(), along.cos());
    let error = normal.0 * normal.0 * xx + 2.0 * normal.0 * normal.1 * xy + normal.1 * normal.1 * yy;
    (normal_form(normal, x, y), error.max(0.0))
}

/// Split and merge: cut into twice as many pieces as end-point fit cuts, then the neighbours whose common line is nearest to
/// their points are joined until there are few enough.
pub(crate) fn split_and_merge(scan: &Scan, count: usize) -> Found {
    let points = points(scan);
    if points.len() < 2 {
        return Found { lines: Vec::new() };
    }
    let cuts = vertices(&points, 2 * count);
    let mut pieces: Vec<(usize, usize)> = cuts.windows(2).map(|pair| (pair[0], pair[1])).collect();
    for piece in pieces.iter_mut().skip(1) {
        piece.0 += 1;
    }
    pieces.retain(|piece| piece.0 <= piece.1);
    let error = |first: usize, last: usize| regression(&points[first..=last]).1;
    while pieces.len() > count - 1 {
        let price = |i: usize| {
            let (one, two) = (pieces[i], pieces[i + 1]);
            error(one.0, two.1) - error(one.0, one.1) - error(two.0, two.1)
        };
        let prices: Vec<f64> = (0..pieces.len() - 1).map(price).collect();
        let cheapest = (0..prices.len()).min_by(|&a, &b| prices[a].total_cmp(&prices[b])).unwrap_or(0);
        pieces[cheapest].1 = pieces.remove(cheapest + 1).1;
    }
    let line = |&(first, last): &(usize, usize)| {
        let (one, points) = (points[first], &points[first..=last]);
        // One point: a line across its beam.
        let alone = (one.x.hypot(one.y), one.y.atan2(one.x));
        met(points, if points.len() > 1 { regression(points).0 } else { alone })
    };
    Found { lines: pieces.iter().filter_map(line).collect() }
}

/// Tries of RANSAC for each line, and how near a point is to be, in metres.
const TRIES: usize = 200;
const NEAR_M: f64 = 0.05;

/// RANSAC: of lines through two points that are drawn, that with the longest row of near points, which are taken away.
pub(crate) fn ransac(scan: &Scan, count: usize) -> Found {
    let mut random = Rng::with_seed(1);
    let mut left = points(scan);
    let mut lines = Vec::new();
    while lines.len() + 1 < count && left.len() > 2 {
        let mut best = 0..0;
        for _ in 0..TRIES {
            let first = random.usize(..left.len());
            let second = random.usize(first.saturating_sub(10)..(first + 11).min(left.len()));
            if first != second {
                let row = row(&left, first, through(left[first], left[second]));
                best = if row.len() > best.len() { row } else { best };
            }
        }
        if best.len() < 2 {
            break;
        }
        lines.extend(met(&left[best.clone()], regression(&left[best.clone()]).0));
        left.drain(best);
    }
    // Where two cover a beam, the first counts: that of more points.
    Found { lines }
}

/// The points around one of them that are near the line, without a break in their beams.
fn row(points: &[Point], at: usize, (r, alpha): (f64, f64)) -> std::ops::Range<usize> {
    let near = |p: &Point| (p.x * alpha.cos() + p.y * alpha.sin() - r).abs() < NEAR_M;
    let (mut first, mut end) = (at, at + 1);
    while first > 0 && near(&points[first - 1]) && points[first].beam - points[first - 1].beam <= 2 {
        first -= 1;
    }
    while end < points.len() && near(&points[end]) && points[end].beam - points[end - 1].beam <= 2 {
        end += 1;
    }
    first..end
}
