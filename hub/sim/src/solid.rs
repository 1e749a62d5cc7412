//! What has a height, cut by the plane that a tilted sensor measures in: flat shapes remain, which are measured like all
//! others. Millimetres, in the frame of the mount: x to the right, y ahead, z up, the floor at 0. Knows neither beams nor
//! time.

use std::f64::consts::TAU;

use crate::shape::{Point, Shape};

/// A point with its height.
type Corner = (f64, f64, f64);

/// From which height to which something stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Heights {
    pub(crate) from_mm: f64,
    /// Infinite: higher than any beam.
    pub(crate) to_mm: f64,
}

impl Heights {
    /// From the floor to above everything.
    pub(crate) const ALL: Heights = Heights { from_mm: 0.0, to_mm: f64::INFINITY };
}

/// The plane of a sensor that looks up or down.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plane {
    /// Where the sensor is: ahead, and above the floor.
    eye: Point,
    sin: f64,
    cos: f64,
}

impl Plane {
    /// That of a sensor at `eye` which looks down by `down_deg`.
    pub(crate) fn new(eye: Point, down_deg: f64) -> Plane {
        let (sin, cos) = down_deg.to_radians().sin_cos();
        Plane { eye, sin, cos }
    }

    /// Hands the cut of each surface of what stands on `shapes` to `each`. Posts have lids, and so has what `is_box`.
    pub(crate) fn cut(&self, shapes: &[Shape], heights: Heights, is_box: bool, mut each: impl FnMut(Shape)) {
        let (bottom, top) = (heights.from_mm.min(HIGHEST_MM), heights.to_mm.min(HIGHEST_MM));
        let mut wall = |from: Point, to: Point| {
            let corners = [raised(from, bottom), raised(to, bottom), raised(to, top), raised(from, top)];
            self.cut_panel(&corners).into_iter().for_each(&mut each);
        };
        for shape in shapes {
            match *shape {
                Shape::Wall { from, to } => wall(from, to),
                Shape::Post { centre, radius } => {
                    let around = around(centre, radius);
                    (0..SIDES).for_each(|i| wall(around[i], around[(i + 1) % SIDES]));
                }
            }
        }
        // What stands on the floor has no bottom that can be seen.
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
                    lid(&around(centre, radius));
                }
            }
        }
    }

    /// The cut of the floor.
    pub(crate) fn cut_floor(&self) -> Option<Shape> {
        let far = HIGHEST_MM;
        self.cut_panel(&[(-far, -far, 0.0), (far, -far, 0.0), (far, far, 0.0), (-far, far, 0.0)])
    }

    /// The cut of a flat and convex surface.
    fn cut_panel(&self, corners: &[Corner]) -> Option<Shape> {
        let mut ends = [(0.0, 0.0); 2];
        let mut count = 0;
        for (i, &a) in corners.iter().enumerate() {
            let b = corners[(i + 1) % corners.len()];
            let (over_a, over_b) = (self.over(a), self.over(b));
            if (over_a >= 0.0) != (over_b >= 0.0) && count < 2 {
                let share = over_a / (over_a - over_b);
                let between = |a: f64, b: f64| a + share * (b - a);
                ends[count] = self.within((between(a.0, b.0), between(a.1, b.1), between(a.2, b.2)));
                count += 1;
            }
        }
        (count == 2).then_some(Shape::Wall { from: ends[0], to: ends[1] })
    }

    /// How far `point` is above the plane.
    fn over(&self, (_, y, z): Corner) -> f64 {
        (y - self.eye.0) * self.sin + (z - self.eye.1) * self.cos
    }

    /// A point of the plane in its own frame, seen from the sensor.
    fn within(&self, (x, y, z): Corner) -> Point {
        (x, (y - self.eye.0) * self.cos - (z - self.eye.1) * self.sin)
    }
}

fn raised((x, y): Point, height: f64) -> Corner {
    (x, y, height)
}

fn around(centre: Point, radius: f64) -> [Point; SIDES] {
    std::array::from_fn(|i| {
        let (sin, cos) = (TAU * i as f64 / SIDES as f64).sin_cos();
        (centre.0 + radius * cos, centre.1 + radius * sin)
    })
}

/// Sides of a round post: of one of 100 mm they are off by 2 mm.
const SIDES: usize = 16;
/// Nothing is measured beyond.
const HIGHEST_MM: f64 = 100_000.0;

#[cfg(test)]
mod tests {
    use super::*;

    const EYE: Point = (0.0, 1000.0);

    /// How far it is straight ahead to what is cut.
    fn ahead(plane: &Plane, shapes: &[Shape], heights: Heights, is_box: bool) -> Option<f64> {
        let mut nearest: Option<f64> = None;
        plane.cut(shapes, heights, is_box, |shape| {
            let met = shape.distance((0.0, 1.0));
            nearest = nearest.into_iter().chain(met).reduce(f64::min);
        });
        nearest
    }

    #[test]
    fn the_floor_is_where_the_slope_says() {
        let down = Plane::new(EYE, 30.0);
        let floor = down.cut_floor().expect("it looks down");
        assert!((floor.distance((0.0, 1.0)).expect("ahead") - 2000.0).abs() < 1e-6);
        let up = Plane::new(EYE, -30.0).cut_floor().expect("behind");
        assert_eq!(up.distance((0.0, 1.0)), None);
    }

    #[test]
    fn a_wall_is_met_below_its_top_alone() {
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
    fn a_box_has_a_lid() {
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
