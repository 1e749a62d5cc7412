//! What is in each direction from a sensor at one moment, as a row of narrow rays: drawn shape by shape, the nearest wins.
//! Knows neither beams nor noise.

use std::ops::Range;
use std::sync::LazyLock;

use schema::Nanos;

use crate::scene::Surface;
use crate::shape::{Point, Shape};

/// One shape that can be seen, in the frame of the sensor.
#[derive(Clone, Debug)]
pub(crate) struct Face {
    pub(crate) shape: Shape,
    pub(crate) surface: Surface,
    pub(crate) kind: Kind,
}

/// What a face belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// What was there at the start.
    Static,
    /// Somebody's leg.
    Person,
    /// A thing that came or moved at this time.
    Box { since_ns: Nanos },
}

impl Kind {
    /// That of a thing that stands where it does since `since_ns`.
    pub(crate) fn since(since_ns: Nanos) -> Kind {
        match since_ns {
            0 => Kind::Static,
            since_ns => Kind::Box { since_ns },
        }
    }
}

/// Where a ray ends.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Hit {
    /// Infinite where there is nothing.
    pub(crate) range_mm: f64,
    /// Number of the face.
    face: u32,
    /// When the last thing went that had stood before this.
    pub(crate) since_ns: Nanos,
}

impl Hit {
    /// Whether both end at the same face, and for as long.
    pub(crate) fn is_of(&self, other: &Hit) -> bool {
        self.face == other.face && self.since_ns == other.since_ns
    }
}

/// Rays of a moment that lie next to each other.
#[derive(Clone, Debug)]
pub(crate) struct View {
    faces: Vec<Face>,
    hits: Vec<Hit>,
    /// Number of the first ray.
    first: usize,
}

impl View {
    /// Nothing anywhere, all around.
    pub(crate) fn empty() -> View {
        let nothing = Hit { range_mm: f64::INFINITY, face: u32::MAX, since_ns: 0 };
        View { faces: Vec::new(), hits: vec![nothing; DIRECTIONS.len()], first: 0 }
    }

    /// The half of it that lies ahead.
    pub(crate) fn ahead(&self) -> View {
        const RIGHT: usize = 90 * RAYS_PER_DEGREE as usize;
        const RAYS: usize = 180 * RAYS_PER_DEGREE as usize + 1 + 2 * REACH;
        let from = RIGHT - self.first;
        View { faces: self.faces.clone(), hits: self.hits[from..from + RAYS].to_vec(), first: RIGHT }
    }

    /// Becomes what `still` has around the one beam at `angle_deg`. All faces that were drawn since it was one with `still`
    /// are forgotten.
    pub(crate) fn narrow(&mut self, still: &View, angle_deg: f64) {
        let middle = middle((angle_deg * 1e3) as i32) - still.first;
        self.faces.truncate(still.faces.len());
        self.hits.clear();
        self.hits.extend_from_slice(&still.hits[middle - REACH..=middle + REACH]);
        self.first = still.first + middle - REACH;
    }

    /// Draws `face` over it.
    pub(crate) fn draw(&mut self, face: Face) {
        let number = self.faces.len() as u32;
        for ray in rays(&face.shape, self.numbers()) {
            let direction = DIRECTIONS[ray];
            let hit = &mut self.hits[ray - self.first];
            if face.surface == Surface::Glass && face.shape.squareness(direction) < GLASS_SHINES {
                continue;
            }
            if let Some(range_mm) = face.shape.distance(direction)
                && range_mm < hit.range_mm
            {
                *hit = Hit { range_mm, face: number, since_ns: 0 };
            }
        }
        self.faces.push(face);
    }

    /// Marks what `shape` hid until `since_ns`. Only after everything is drawn.
    pub(crate) fn uncover(&mut self, shape: &Shape, since_ns: Nanos) {
        for ray in rays(shape, self.numbers()) {
            let hit = &mut self.hits[ray - self.first];
            if shape.distance(DIRECTIONS[ray]).is_some_and(|range_mm| range_mm < hit.range_mm) {
                hit.since_ns = hit.since_ns.max(since_ns);
            }
        }
    }

    /// The ray at the sensor's angle `angle_mdeg` (0 ahead) and those around it, up to [`REACH`] to each side.
    pub(crate) fn around(&self, angle_mdeg: i32) -> &[Hit] {
        let middle = middle(angle_mdeg) - self.first;
        &self.hits[middle - REACH..=middle + REACH]
    }

    /// Whether what lies at the sensor's angle `angle_deg` and `range_mm` is within the field of view and nothing stands before it.
    pub(crate) fn reaches(&self, angle_deg: f64, range_mm: f64) -> bool {
        let ray = ((angle_deg + 180.0) * f64::from(RAYS_PER_DEGREE)).round() as usize + REACH;
        (-90.0..=90.0).contains(&angle_deg) && self.hits[ray - self.first].range_mm > range_mm - 1.0
    }

    /// Where the ray at `angle_deg` ends, and where a line between it and the next one does that meets the same face.
    pub(crate) fn exact(&self, angle_deg: f64) -> (f64, Option<f64>) {
        let hit = &self.hits[middle((angle_deg * 1e3) as i32) - self.first];
        let face = self.face(hit).filter(|_| hit.range_mm.is_finite());
        (hit.range_mm, face.map(|face| face.shape.distance(direction(angle_deg)).unwrap_or(hit.range_mm)))
    }

    fn numbers(&self) -> Range<usize> {
        self.first..self.first + self.hits.len()
    }

    /// What `hit` ends at, if at anything.
    pub(crate) fn face(&self, hit: &Hit) -> Option<&Face> {
        self.faces.get(hit.face as usize)
    }
}

/// Number of the ray at the sensor's angle `angle_mdeg`, -180 degrees to 180.
fn middle(angle_mdeg: i32) -> usize {
    REACH + ((angle_mdeg + 180_000) * RAYS_PER_DEGREE / 1000) as usize
}

/// Numbers of the rays that can meet `shape`, of those that are `wanted`.
fn rays(shape: &Shape, wanted: Range<usize>) -> impl Iterator<Item = usize> + use<> {
    let span = shape.span_deg();
    // A span may reach in from both ends.
    [-360.0, 0.0, 360.0].into_iter().flat_map(move |turn| {
        let Some((first, width)) = span else { return 0..0 };
        let ray = |angle_deg: f64| (angle_deg + turn - BEHIND) * f64::from(RAYS_PER_DEGREE) + REACH as f64;
        let first_ray = ray(first).floor().max(0.0) as usize;
        let behind = (ray(first + width).ceil() + 1.0).max(0.0) as usize;
        first_ray.max(wanted.start)..behind.min(wanted.end)
    })
}

/// Rays in a degree: 4 mm apart at 4 m, and each beam of each variant is on one.
const RAYS_PER_DEGREE: i32 = 16;
/// Rays to each side that the widest spot covers: more than a degree.
pub(crate) const REACH: usize = 20;
/// Angle between two rays in radians.
pub(crate) const RAY_STEP: f64 = std::f64::consts::PI / 180.0 / RAYS_PER_DEGREE as f64;
/// Glass sends a beam back that falls on it within 3 degrees of a right angle.
const GLASS_SHINES: f64 = 0.9986;

/// Where the rays begin: behind the sensor, in degrees counter-clockwise from its right.
const BEHIND: f64 = -90.0;

/// Unit vectors of all rays, from behind over ahead to behind and as far beyond as a spot reaches.
static DIRECTIONS: LazyLock<Vec<Point>> = LazyLock::new(|| {
    let count = 360 * RAYS_PER_DEGREE + 1 + 2 * REACH as i32;
    let angle = |ray: i32| f64::from(ray - REACH as i32) / f64::from(RAYS_PER_DEGREE) - 180.0;
    (0..count).map(|ray| direction(angle(ray))).collect()
});

/// The unit vector at the sensor's angle `angle_deg`.
fn direction(angle_deg: f64) -> Point {
    let from_right = (angle_deg - BEHIND).to_radians();
    (from_right.cos(), from_right.sin())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_ray_ends_at_the_nearest_shape_wherever_it_stands() {
        let mut random = fastrand::Rng::with_seed(5);
        let mut point = || (6000.0 * random.f64() - 3000.0, 6000.0 * random.f64() - 3000.0);
        let shapes: Vec<Shape> = (0..40)
            .flat_map(|_| {
                [Shape::Wall { from: point(), to: point() }, Shape::Post { centre: point(), radius: 90.0 }]
            })
            .collect();
        let mut view = View::empty();
        for &shape in &shapes {
            view.draw(Face { shape, surface: Surface::Plain, kind: Kind::Static });
        }
        for (ray, hit) in view.hits.iter().enumerate() {
            let nearest = shapes.iter().filter_map(|shape| shape.distance(DIRECTIONS[ray]));
            assert_eq!(hit.range_mm, nearest.fold(f64::INFINITY, f64::min), "ray {ray}");
        }
        assert_eq!(view.around(0)[REACH].range_mm, view.hits[REACH + 2880].range_mm);
        assert!(DIRECTIONS[REACH + 2880].0.abs() < 1e-12);
    }

    #[test]
    fn glass_is_seen_where_the_beam_falls_squarely() {
        let mut view = View::empty();
        let shape = Shape::Wall { from: (-3000.0, 2000.0), to: (3000.0, 2000.0) };
        view.draw(Face { shape, surface: Surface::Glass, kind: Kind::Static });
        assert!((view.around(0)[REACH].range_mm - 2000.0).abs() < 1e-9);
        assert!(view.around(-10_000)[REACH].range_mm.is_infinite());
    }
}
