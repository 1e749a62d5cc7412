//! Flat geometry seen from a point: how far a ray goes until it meets a wall or a post, and between which angles it
//! can. Millimetres; the eye is at the origin, x is to its right and y ahead, angles are those of x. Knows nothing of
//! beams, noise or time.

/// A point or a way in millimetres.
pub(crate) type Point = (f64, f64);

/// What a ray can meet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Shape {
    /// A straight wall between two points.
    Wall { from: Point, to: Point },
    /// A round post.
    Post { centre: Point, radius: f64 },
}

impl Shape {
    /// Distance along the ray from the origin in `direction` (a unit vector), if it meets the shape.
    pub(crate) fn distance(&self, direction: Point) -> Option<f64> {
        match *self {
            Shape::Wall { from, to } => {
                let along = (to.0 - from.0, to.1 - from.1);
                let across = cross(direction, along);
                if across.abs() < 1e-9 {
                    return None;
                }
                let distance = cross(from, along) / across;
                let share = cross(from, direction) / across;
                (distance > 0.0 && (0.0..=1.0).contains(&share)).then_some(distance)
            }
            Shape::Post { centre, radius } => {
                let foot = centre.0 * direction.0 + centre.1 * direction.1;
                let aside = cross(direction, centre);
                let depth = radius * radius - aside * aside;
                (foot > radius && depth >= 0.0).then(|| foot - depth.sqrt())
            }
        }
    }

    /// How squarely a ray in `direction` that meets the shape falls on it: 1 straight on, 0 along it.
    pub(crate) fn squareness(&self, direction: Point) -> f64 {
        match *self {
            Shape::Wall { from, to } => {
                let along = (to.0 - from.0, to.1 - from.1);
                cross(direction, along).abs() / along.0.hypot(along.1)
            }
            Shape::Post { centre, radius } => {
                let aside = cross(direction, centre) / radius;
                (1.0 - aside * aside).max(0.0).sqrt()
            }
        }
    }

    /// The angles between which it is seen from the origin: the first in degrees, -180 to 180, and how many degrees
    /// follow counter-clockwise. Nothing of a post that the eye is in, nor of a wall that points at the eye.
    pub(crate) fn span_deg(&self) -> Option<(f64, f64)> {
        let bearing = |point: Point| point.1.atan2(point.0).to_degrees();
        match *self {
            Shape::Wall { from, to } => {
                let turns_left = cross(from, to);
                let (first, last) = if turns_left > 0.0 { (from, to) } else { (to, from) };
                let width = (bearing(last) - bearing(first)).rem_euclid(360.0);
                (turns_left != 0.0).then_some((bearing(first), width))
            }
            Shape::Post { centre, radius } => {
                let half = (radius / centre.0.hypot(centre.1)).asin().to_degrees();
                (!half.is_nan()).then(|| (bearing(centre) - half, 2.0 * half))
            }
        }
    }

    /// The middle of what it shows to the eye at the origin.
    pub(crate) fn front(&self) -> Point {
        match *self {
            Shape::Wall { from, to } => ((from.0 + to.0) / 2.0, (from.1 + to.1) / 2.0),
            Shape::Post { centre, radius } => {
                let nearer = 1.0 - radius / centre.0.hypot(centre.1);
                (centre.0 * nearer, centre.1 * nearer)
            }
        }
    }

    /// The same with every point where `place` puts it.
    pub(crate) fn placed(&self, place: impl Fn(Point) -> Point) -> Shape {
        match *self {
            Shape::Wall { from, to } => Shape::Wall { from: place(from), to: place(to) },
            Shape::Post { centre, radius } => Shape::Post { centre: place(centre), radius },
        }
    }
}

/// Where something stands in a frame, and how far it is turned there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pose {
    /// To the right, in millimetres.
    pub(crate) x_mm: f64,
    /// Ahead, in millimetres.
    pub(crate) y_mm: f64,
    /// Counter-clockwise, in degrees.
    pub(crate) turn_deg: f64,
}

impl Pose {
    /// A point of its own frame in the frame that it stands in.
    pub(crate) fn outward(&self, (x, y): Point) -> Point {
        let (sin, cos) = self.turn_deg.to_radians().sin_cos();
        (self.x_mm + x * cos - y * sin, self.y_mm + x * sin + y * cos)
    }

    /// A point of the frame that it stands in, in its own.
    pub(crate) fn inward(&self, (x, y): Point) -> Point {
        let (sin, cos) = self.turn_deg.to_radians().sin_cos();
        let (x, y) = (x - self.x_mm, y - self.y_mm);
        (x * cos + y * sin, y * cos - x * sin)
    }
}

fn cross(a: Point, b: Point) -> f64 {
    a.0 * b.1 - a.1 * b.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_what_is_before_them() {
        let wall = Shape::Wall { from: (-1000.0, 2000.0), to: (1000.0, 2000.0) };
        assert_eq!(wall.distance((0.0, 1.0)), Some(2000.0));
        assert_eq!(wall.distance((1.0, 0.0)), None);
        assert_eq!(wall.distance((0.0, -1.0)), None);
        assert_eq!(wall.distance((0.6, 0.8)), None);
        assert_eq!(wall.squareness((0.0, 1.0)), 1.0);
        assert_eq!(wall.squareness((0.6, 0.8)), 0.8);
        let post = Shape::Post { centre: (0.0, 3000.0), radius: 100.0 };
        assert_eq!(post.distance((0.0, 1.0)), Some(2900.0));
        assert_eq!(post.distance((0.0, -1.0)), None);
        assert_eq!(post.distance((0.05, 0.99875)), None);
        assert_eq!((post.squareness((0.0, 1.0)), post.front()), (1.0, (0.0, 2900.0)));
    }

    #[test]
    fn every_ray_that_meets_a_shape_lies_in_its_span() {
        let mut random = fastrand::Rng::with_seed(3);
        let mut met = 0;
        for _ in 0..2_000 {
            let mut point = || (4000.0 * random.f64() - 2000.0, 4000.0 * random.f64() - 2000.0);
            let (from, to) = (point(), point());
            for shape in [Shape::Wall { from, to }, Shape::Post { centre: from, radius: 300.0 }] {
                let angle = 360.0 * random.f64() - 180.0;
                let (sin, cos) = angle.to_radians().sin_cos();
                if shape.distance((cos, sin)).is_some() {
                    let (first, width) = shape.span_deg().expect("a shape that is met is seen");
                    assert!(width < 180.0 && (angle - first + 1e-6).rem_euclid(360.0) <= width + 2e-6);
                    met += 1;
                }
            }
        }
        assert!(met > 300, "{met}");
    }

    #[test]
    fn a_pose_leads_out_and_back() {
        let pose = Pose { x_mm: 100.0, y_mm: -50.0, turn_deg: 90.0 };
        let out = pose.outward((10.0, 0.0));
        assert!((out.0 - 100.0).abs() < 1e-9 && (out.1 + 40.0).abs() < 1e-9, "{out:?}");
        let back = pose.inward(out);
        assert!((back.0 - 10.0).abs() < 1e-9 && back.1.abs() < 1e-9, "{back:?}");
    }
}
