//! Flat geometry seen from a point: how far a ray goes until it meets a wall or a post. Millimetres; the sensor stands
//! at the origin, 0 degrees is to its right (x), 90 degrees ahead (y). Knows nothing of beams, noise or time.

/// What a ray can meet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Shape {
    /// A straight wall between two points.
    Wall { from: (f64, f64), to: (f64, f64) },
    /// A round post.
    Post { centre: (f64, f64), radius: f64 },
}

impl Shape {
    /// Distance along the ray from the origin in `direction` (a unit vector), if it meets the shape.
    pub(crate) fn distance(&self, direction: (f64, f64)) -> Option<f64> {
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
}

fn cross(a: (f64, f64), b: (f64, f64)) -> f64 {
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
        let post = Shape::Post { centre: (0.0, 3000.0), radius: 100.0 };
        assert_eq!(post.distance((0.0, 1.0)), Some(2900.0));
        assert_eq!(post.distance((0.0, -1.0)), None);
        assert_eq!(post.distance((0.05, 0.99875)), None);
    }
}
