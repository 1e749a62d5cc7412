//! Geometry of a world. Lengths are in millimeters.
//!
//! A [`Shape`] is flat and seen from the origin, with x to the right and y ahead. Angles are counted from x. For a
//! tilted scanner, a [`Plane`] cuts objects, which have a height, into flat shapes. The plane is in the frame of the
//! mount: x to the right, y ahead, z up, and the floor at z = 0.

use std::f64::consts::TAU;

/// A point or a vector in millimeters.
pub type Point = (f64, f64);

/// An obstacle that a ray can hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// A straight wall between two points.
    Wall {
        /// One end.
        from: Point,
        /// The other end.
        to: Point,
    },
    /// A round post.
    Post {
        /// Center of the post.
        centre: Point,
        /// Radius in millimeters.
        radius: f64,
    },
}

impl Shape {
    /// Returns the distance from the origin to the shape along a ray in `direction` (a unit vector), or `None` if the
    /// ray does not meet the shape.
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

    /// Returns the cosine of the angle at which a ray in `direction` falls on the shape: 1 at a right angle, 0 along
    /// the shape.
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

    /// Returns the interval of angles at which the shape is seen from the origin: its first angle, -180 to 180 degrees,
    /// and its width counterclockwise from there, in degrees. Returns `None` for a post around the origin, and for a
    /// wall that points at the origin.
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

    /// Returns the middle of the side that faces the origin.
    pub(crate) fn front(&self) -> Point {
        match *self {
            Shape::Wall { from, to } => ((from.0 + to.0) / 2.0, (from.1 + to.1) / 2.0),
            Shape::Post { centre, radius } => {
                let nearer = 1.0 - radius / centre.0.hypot(centre.1);
                (centre.0 * nearer, centre.1 * nearer)
            }
        }
    }

    /// Returns the shape with `transform` applied to every point.
    pub(crate) fn transformed(&self, transform: impl Fn(Point) -> Point) -> Shape {
        match *self {
            Shape::Wall { from, to } => Shape::Wall { from: transform(from), to: transform(to) },
            Shape::Post { centre, radius } => Shape::Post { centre: transform(centre), radius },
        }
    }
}

/// Position and rotation of an object in a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pose {
    /// To the right, in millimeters.
    pub(crate) x_mm: f64,
    /// Ahead, in millimeters.
    pub(crate) y_mm: f64,
    /// Counterclockwise, in degrees.
    pub(crate) turn_deg: f64,
}

impl Pose {
    /// Transforms a point from the object's frame to the surrounding frame.
    pub(crate) fn outward(&self, (x, y): Point) -> Point {
        let (sin, cos) = self.turn_deg.to_radians().sin_cos();
        (self.x_mm + x * cos - y * sin, self.y_mm + x * sin + y * cos)
    }

    /// Transforms a point from the surrounding frame to the object's frame.
    pub(crate) fn inward(&self, (x, y): Point) -> Point {
        let (sin, cos) = self.turn_deg.to_radians().sin_cos();
        let (x, y) = (x - self.x_mm, y - self.y_mm);
        (x * cos + y * sin, y * cos - x * sin)
    }
}

fn cross(a: Point, b: Point) -> f64 {
    a.0 * b.1 - a.1 * b.0
}

/// A point with its height.
type Corner = (f64, f64, f64);

/// Lowest and highest point of an object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Heights {
    pub(crate) from_mm: f64,
    /// Highest point; infinite if the object is higher than any beam.
    pub(crate) to_mm: f64,
}

impl Heights {
    /// Heights from the floor to above every beam.
    pub(crate) const ALL: Heights = Heights { from_mm: 0.0, to_mm: f64::INFINITY };
}

/// The plane in which a tilted scanner measures.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plane {
    /// Position of the scanner: ahead, and above the floor.
    eye: Point,
    sin: f64,
    cos: f64,
}

impl Plane {
    /// Creates the plane of a scanner at `eye` that is tilted down by `down_deg`.
    pub(crate) fn new(eye: Point, down_deg: f64) -> Plane {
        let (sin, cos) = down_deg.to_radians().sin_cos();
        Plane { eye, sin, cos }
    }

    /// Cuts each surface of an object with the outline `shapes`, and calls `each` with each resulting shape. Posts also
    /// have surfaces at top and bottom, and so does an object for which `is_box` is set.
    pub(crate) fn cut(&self, shapes: &[Shape], heights: Heights, is_box: bool, mut each: impl FnMut(Shape)) {
        let (bottom, top) = (heights.from_mm.min(MAX_DISTANCE_MM), heights.to_mm.min(MAX_DISTANCE_MM));
        let mut wall = |from: Point, to: Point| {
            let corners = [raised(from, bottom), raised(to, bottom), raised(to, top), raised(from, top)];
            self.cut_panel(&corners).into_iter().for_each(&mut each);
        };
        for shape in shapes {
            match *shape {
                Shape::Wall { from, to } => wall(from, to),
                Shape::Post { centre, radius } => {
                    let outline = polygon(centre, radius);
                    (0..SIDES).for_each(|i| wall(outline[i], outline[(i + 1) % SIDES]));
                }
            }
        }
        // The bottom of an object on the floor cannot be seen.
        for height in [bottom, top].into_iter().filter(|&height| height > 0.0) {
            let mut lid = |outline: &[Point]| {
                let mut corners = [(0.0, 0.0, 0.0); SIDES];
                corners.iter_mut().zip(outline).for_each(|(corner, &point)| *corner = raised(point, height));
                self.cut_panel(&corners[..outline.len()]).into_iter().for_each(&mut each);
            };
            if is_box
                && let [
                    Shape::Wall { from: a, .. },
                    Shape::Wall { from: b, .. },
                    Shape::Wall { from: c, .. },
                    Shape::Wall { from: d, .. },
                ] = *shapes
            {
                lid(&[a, b, c, d]);
            }
            for shape in shapes {
                if let Shape::Post { centre, radius } = *shape {
                    lid(&polygon(centre, radius));
                }
            }
        }
    }

    /// Returns the line along which the plane cuts the floor, or `None` if it does not cut the floor.
    pub(crate) fn cut_floor(&self) -> Option<Shape> {
        let far = MAX_DISTANCE_MM;
        self.cut_panel(&[(-far, -far, 0.0), (far, -far, 0.0), (far, far, 0.0), (-far, far, 0.0)])
    }

    /// Returns the line along which the plane cuts the flat and convex surface between `corners`, or `None` if it does
    /// not cut the surface.
    fn cut_panel(&self, corners: &[Corner]) -> Option<Shape> {
        let mut ends = [(0.0, 0.0); 2];
        let mut count = 0;
        for (i, &a) in corners.iter().enumerate() {
            let b = corners[(i + 1) % corners.len()];
            let (over_a, over_b) = (self.height_above(a), self.height_above(b));
            if (over_a >= 0.0) != (over_b >= 0.0) && count < 2 {
                let share = over_a / (over_a - over_b);
                let between = |a: f64, b: f64| a + share * (b - a);
                ends[count] = self.in_plane((between(a.0, b.0), between(a.1, b.1), between(a.2, b.2)));
                count += 1;
            }
        }
        (count == 2).then_some(Shape::Wall { from: ends[0], to: ends[1] })
    }

    /// Returns the height of a point above the plane.
    fn height_above(&self, (_, y, z): Corner) -> f64 {
        (y - self.eye.0) * self.sin + (z - self.eye.1) * self.cos
    }

    /// Transforms a point of the plane to the plane's own frame, with the scanner at the origin.
    fn in_plane(&self, (x, y, z): Corner) -> Point {
        (x, (y - self.eye.0) * self.cos - (z - self.eye.1) * self.sin)
    }
}

fn raised((x, y): Point, height: f64) -> Corner {
    (x, y, height)
}

fn polygon(centre: Point, radius: f64) -> [Point; SIDES] {
    std::array::from_fn(|i| {
        let (sin, cos) = (TAU * i as f64 / SIDES as f64).sin_cos();
        (centre.0 + radius * cos, centre.1 + radius * sin)
    })
}

/// Number of sides of the polygon that replaces a round post. For a radius of 100 mm, the polygon deviates from the
/// circle by 2 mm.
const SIDES: usize = 16;
/// Extent of the floor in each direction, and maximum height of an object, in millimeters. It is beyond the maximum
/// range of every scanner.
const MAX_DISTANCE_MM: f64 = 100_000.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_shapes_ahead() {
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
    fn span_contains_every_ray_that_meets_shape() {
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
    fn pose_transforms_out_and_back() {
        let pose = Pose { x_mm: 100.0, y_mm: -50.0, turn_deg: 90.0 };
        let out = pose.outward((10.0, 0.0));
        assert!((out.0 - 100.0).abs() < 1e-9 && (out.1 + 40.0).abs() < 1e-9, "{out:?}");
        let back = pose.inward(out);
        assert!((back.0 - 10.0).abs() < 1e-9 && back.1.abs() < 1e-9, "{back:?}");
    }

    const EYE: Point = (0.0, 1000.0);

    /// Returns the distance straight ahead to the nearest cut.
    fn ahead(plane: &Plane, shapes: &[Shape], heights: Heights, is_box: bool) -> Option<f64> {
        let mut nearest: Option<f64> = None;
        plane.cut(shapes, heights, is_box, |shape| {
            let met = shape.distance((0.0, 1.0));
            nearest = nearest.into_iter().chain(met).reduce(f64::min);
        });
        nearest
    }

    #[test]
    fn cuts_floor_ahead_of_tilted_scanner() {
        let down = Plane::new(EYE, 30.0);
        let floor = down.cut_floor().expect("it looks down");
        assert!((floor.distance((0.0, 1.0)).expect("ahead") - 2000.0).abs() < 1e-6);
        let up = Plane::new(EYE, -30.0).cut_floor().expect("behind");
        assert_eq!(up.distance((0.0, 1.0)), None);
    }

    #[test]
    fn meets_wall_only_below_its_top() {
        let wall = [Shape::Wall { from: (-500.0, 2000.0), to: (500.0, 2000.0) }];
        let low = Heights { from_mm: 0.0, to_mm: 800.0 };
        assert_eq!(ahead(&Plane::new(EYE, 0.0), &wall, low, false), None, "the beam passes over it");
        let met = ahead(&Plane::new(EYE, 20.0), &wall, low, false).expect("met");
        assert!((met - 2000.0 / 20.0_f64.to_radians().cos()).abs() < 1e-6, "{met}");
        assert_eq!(ahead(&Plane::new(EYE, 30.0), &wall, low, false), None, "the floor is nearer");
        let all = ahead(&Plane::new(EYE, -60.0), &wall, Heights::ALL, false).expect("met");
        assert!((all - 4000.0).abs() < 1e-6, "{all}");
    }

    #[test]
    fn cuts_lid_of_box() {
        let points = [(-500.0, 1000.0), (500.0, 1000.0), (500.0, 3000.0), (-500.0, 3000.0)];
        let walls: [Shape; 4] =
            std::array::from_fn(|i| Shape::Wall { from: points[i], to: points[(i + 1) % 4] });
        let low = Heights { from_mm: 0.0, to_mm: 400.0 };
        let down = Plane::new(EYE, 20.0);
        let lid = 600.0 / 20.0_f64.to_radians().sin();
        assert!((ahead(&down, &walls, low, true).expect("its lid") - lid).abs() < 1e-6);
        assert_eq!(
            ahead(&down, &walls, low, false),
            None,
            "over the front, and the floor is before the back"
        );
        let post = [Shape::Post { centre: (0.0, 2000.0), radius: 600.0 }];
        let met = ahead(&down, &post, low, false).expect("its lid");
        assert!((met - lid).abs() < 1e-6, "{met}");
    }
}
