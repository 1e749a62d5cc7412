//! Points, segments and polygons of a map, in meters.

/// A point in the map: x to the right, y up, in meters.
pub type Point = [f64; 2];

/// Returns `a - b`.
pub fn minus(a: Point, b: Point) -> Point {
    [a[0] - b[0], a[1] - b[1]]
}

/// Returns the square of the length of a vector.
pub fn length2([x, y]: Point) -> f64 {
    x * x + y * y
}

/// Returns the distance between two points.
pub fn distance(a: Point, b: Point) -> f64 {
    length2(minus(a, b)).sqrt()
}

/// Returns the middle of a segment.
pub fn middle([a, b]: [Point; 2]) -> Point {
    [(a[0] + b[0]) / 2.0, (a[1] + b[1]) / 2.0]
}

/// Returns the scalar product.
pub fn dot(a: Point, b: Point) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

/// Returns the cross product. It is positive if `b` is counterclockwise of `a`.
pub fn cross(a: Point, b: Point) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

/// Returns the distance between `point` and the nearest point of a segment.
pub fn distance_to_segment(point: Point, [a, b]: [Point; 2]) -> f64 {
    let along = minus(b, a);
    let length2 = along[0] * along[0] + along[1] * along[1];
    let from_a = minus(point, a);
    let share = if length2 > 0.0 { (from_a[0] * along[0] + from_a[1] * along[1]) / length2 } else { 0.0 };
    let share = share.clamp(0.0, 1.0);
    distance(point, [a[0] + share * along[0], a[1] + share * along[1]])
}

/// Returns the position on the first segment at which the second segment crosses it: 0 at the start of the first
/// segment, 1 at its end. Segments do not cross if they only touch at an end, or lie on one line.
pub fn crossing([a, b]: [Point; 2], [c, d]: [Point; 2]) -> Option<f64> {
    let (first, second) = (minus(b, a), minus(d, c));
    let across = cross(first, second);
    if across.abs() < 1e-12 {
        return None;
    }
    let from_a = minus(c, a);
    let (on_first, on_second) = (cross(from_a, second) / across, cross(from_a, first) / across);
    let inside = |share: f64| share > 1e-9 && share < 1.0 - 1e-9;
    (inside(on_first) && inside(on_second)).then_some(on_first)
}

/// Returns the sides of a polygon. The last one leads back to the first corner.
pub fn sides(polygon: &[Point]) -> impl Iterator<Item = [Point; 2]> + '_ {
    polygon.iter().zip(polygon.iter().cycle().skip(1)).map(|(&a, &b)| [a, b])
}

/// Returns the area of a polygon in square meters. It is positive if the corners run counterclockwise.
pub fn area(polygon: &[Point]) -> f64 {
    sides(polygon).map(|[a, b]| cross(a, b)).sum::<f64>() / 2.0
}

/// Returns whether `point` is inside a polygon. Counts the sides that a ray from `point` crosses.
pub fn contains(polygon: &[Point], point: Point) -> bool {
    let crossed = sides(polygon).filter(|&[a, b]| {
        (a[1] > point[1]) != (b[1] > point[1])
            && point[0] < (b[0] - a[0]) * (point[1] - a[1]) / (b[1] - a[1]) + a[0]
    });
    crossed.count() % 2 == 1
}

/// Returns the distance between `point` and the nearest side.
pub fn distance_to_border(polygon: &[Point], point: Point) -> f64 {
    sides(polygon).map(|side| distance_to_segment(point, side)).fold(f64::INFINITY, f64::min)
}

/// Returns whether two polygons overlap by more than `tolerance_m`. A smaller overlap is allowed, because plans are
/// measured by hand.
pub fn overlap(first: &[Point], second: &[Point], tolerance_m: f64) -> bool {
    let deep =
        |outer: &[Point], point| contains(outer, point) && distance_to_border(outer, point) > tolerance_m;
    let reaches_in = |outer: &[Point], inner: &[Point]| {
        // Two polygons can overlap although all corners of each polygon lie outside the other. Points on the sides and
        // in the middle also detect polygons that cross, and polygons that are equal.
        let centre = inner.iter().fold([0.0, 0.0], |sum, point| [sum[0] + point[0], sum[1] + point[1]]);
        let centre = [centre[0] / inner.len() as f64, centre[1] / inner.len() as f64];
        (contains(inner, centre) && deep(outer, centre))
            || sides(inner).any(|[a, b]| {
                (0..32).any(|i| {
                    let share = f64::from(i) / 32.0;
                    deep(outer, [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])])
                })
            })
    };
    reaches_in(first, second) || reaches_in(second, first)
}

/// Returns whether two sides of the polygon cross.
pub fn crosses_itself(polygon: &[Point]) -> bool {
    let all: Vec<_> = sides(polygon).collect();
    (0..all.len()).any(|i| (0..i).any(|j| crossing(all[i], all[j]).is_some()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [Point; 4] = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]];

    #[test]
    fn computes_containment_distance_and_crossings() {
        assert!(contains(&SQUARE, [1.0, 1.9]) && !contains(&SQUARE, [1.0, 2.1]));
        assert_eq!((area(&SQUARE), distance_to_border(&SQUARE, [1.0, 1.5])), (4.0, 0.5));
        assert_eq!(crossing([[0.0, 0.0], [4.0, 0.0]], [[1.0, -1.0], [1.0, 1.0]]), Some(0.25));
        assert_eq!(crossing([[0.0, 0.0], [4.0, 0.0]], [[5.0, -1.0], [5.0, 1.0]]), None);
        assert_eq!(crossing([[0.0, 0.0], [4.0, 0.0]], [[1.0, 1.0], [3.0, 1.0]]), None);
        assert_eq!(distance_to_segment([3.0, 4.0], [[0.0, 0.0], [0.0, 0.0]]), 5.0);
    }

    #[test]
    fn polygons_that_share_a_wall_do_not_overlap() {
        let moved = |x: f64| SQUARE.map(|[a, b]| [a + x, b]);
        assert!(!overlap(&SQUARE, &moved(2.0), 0.05) && !overlap(&SQUARE, &moved(1.97), 0.05));
        assert!(overlap(&SQUARE, &moved(1.8), 0.05) && overlap(&SQUARE, &SQUARE, 0.05));
        let bar = [[-1.0, 0.8], [3.0, 0.8], [3.0, 1.2], [-1.0, 1.2]];
        assert!(overlap(&SQUARE, &bar, 0.05), "a cross has no corner in the other");
        assert!(
            crosses_itself(&[[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]]) && !crosses_itself(&SQUARE)
        );
    }

    #[test]
    fn contains_agrees_with_the_sum_of_angles() {
        // Compare with the sum of the angles that the sides subtend at the point. The sum is 360 degrees for a point
        // inside.
        let polygon = [[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]];
        let mut random = fastrand::Rng::with_seed(4);
        for _ in 0..2_000 {
            let point = [5.0 * random.f64() - 0.5, 4.0 * random.f64() - 0.5];
            let turned: f64 = sides(&polygon)
                .map(|[a, b]| {
                    let (a, b) = (minus(a, point), minus(b, point));
                    cross(a, b).atan2(a[0] * b[0] + a[1] * b[1])
                })
                .sum();
            assert_eq!(contains(&polygon, point), turned.abs() > 3.0, "{point:?}");
        }
    }
}
