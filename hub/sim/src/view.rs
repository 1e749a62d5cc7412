//! Views of the surroundings of a scanner. A [`WorldView`] is a scene as one scanner sees it, with random parts drawn
//! from a seed. It draws a [`View`]: the nearest surface in each direction at one time, as a row of narrow rays.

use std::ops::Range;
use std::sync::LazyLock;

use scanhub_schema::Nanos;

use crate::beam::NoiseModel;
use crate::mount::Mount;
use crate::room::Mark;
use crate::scene::{Object, Person, Scene, Sun, Surface, jittered};
use crate::shape::{Plane, Point, Pose, Shape};

/// A scene with its random parts, seen by one scanner.
#[derive(Clone, Debug)]
pub(crate) struct WorldView {
    pub(crate) noise: NoiseModel,
    sensor: Pose,
    mount: Option<Mount>,
    /// Constant error of all ranges of this scanner.
    pub(crate) bias_mm: f64,
    /// View of all objects that never change; empty for a tilted scanner.
    still: View,
    /// The objects that never change; empty unless the scanner is tilted.
    still_objects: Vec<Object>,
    still_reflectors: Vec<Shape>,
    changing: Vec<Object>,
    people: Vec<Person>,
    pub(crate) suns: Vec<Sun>,
}

impl WorldView {
    /// Creates the view of sensor number `sensor` in `scene`, with random parts drawn from `seed`.
    pub(crate) fn new(scene: &Scene, seed: u64, sensor: u64) -> WorldView {
        let mut random = fastrand::Rng::with_seed(seed);
        let people = scene.people.iter().map(|plan| Person::new(plan, &mut random)).collect();
        let mut objects = scene.objects.clone();
        for object in &mut objects {
            let position = (object.pose.x_mm, object.pose.y_mm);
            (object.pose.x_mm, object.pose.y_mm) = jittered(position, object.jitter_mm, &mut random);
        }
        let (still_objects, changing): (Vec<_>, Vec<_>) = objects.into_iter().partition(Object::is_still);
        let bias = fastrand::Rng::with_seed(!seed ^ sensor << 32).f64();
        let mut world = WorldView {
            noise: scene.noise,
            sensor: scene.sensors[sensor as usize].pose,
            mount: scene.sensors[sensor as usize].mount.clone(),
            bias_mm: scene.noise.bias_mm * (2.0 * bias - 1.0),
            still: View::empty(),
            still_objects: Vec::new(),
            still_reflectors: Vec::new(),
            changing,
            people,
            suns: scene.suns.clone(),
        };
        if world.mount.is_some() {
            world.still_objects = still_objects;
            return world;
        }
        for object in still_objects {
            for shape in world.visible_shapes(&object, object.pose) {
                if object.surface == Surface::Reflector {
                    world.still_reflectors.push(shape);
                }
                world.still.draw(Face { shape, surface: object.surface, kind: Kind::Static });
            }
        }
        world
    }

    /// Returns the shapes of `object` at `pose`, in the frame of the scanner.
    fn visible_shapes(&self, object: &Object, pose: Pose) -> Vec<Shape> {
        let transform = |point| self.in_scanner_frame(pose.outward(point));
        object.shapes.iter().map(|shape| shape.transformed(transform)).collect()
    }

    /// Transforms a point of the world to the frame of the scanner: x to the right of the scanner, y ahead.
    fn in_scanner_frame(&self, point: (f64, f64)) -> (f64, f64) {
        let (ahead, left) = self.sensor.inward(point);
        (-left, ahead)
    }

    /// Returns the faces of changing objects and of people at `time_ns`.
    fn faces(&self, time_ns: Nanos) -> Vec<Face> {
        let time_s = time_ns as f64 / 1e9;
        let mut faces = Vec::new();
        for object in &self.changing {
            let Some(presence) = object.at(time_s) else { continue };
            let kind = Kind::since(nanos(presence.since_s));
            let shapes = self.visible_shapes(object, presence.pose);
            faces.extend(shapes.into_iter().map(|shape| Face { shape, surface: object.surface, kind }));
        }
        for legs in self.people.iter().filter_map(|person| person.legs(time_s)) {
            let leg = |leg: Shape| Face {
                shape: leg.transformed(|point| self.in_scanner_frame(point)),
                surface: Surface::Plain,
                kind: Kind::Person,
            };
            faces.extend(legs.map(leg));
        }
        faces
    }

    /// Returns whether the scanner is tilted, so that each beam has another plane.
    pub(crate) fn is_tilted(&self) -> bool {
        self.mount.is_some()
    }

    /// Returns the view ahead at `time_ns`.
    pub(crate) fn view(&self, time_ns: Nanos) -> View {
        let mut view = self.still.ahead();
        self.draw(&mut view, time_ns);
        view
    }

    /// Returns the view ahead at `time_ns` with additional `shapes`, in the frame of the world. The additional shapes
    /// count as people.
    pub(crate) fn view_with(&self, time_ns: Nanos, shapes: &[Shape]) -> View {
        let mut view = self.view(time_ns);
        for shape in shapes {
            let shape = shape.transformed(|point| self.in_scanner_frame(point));
            view.draw(Face { shape, surface: Surface::Plain, kind: Kind::Person });
        }
        view
    }

    /// Returns the view of all objects that never change, in all directions.
    pub(crate) fn still(&self) -> &View {
        &self.still
    }

    /// Changes `view` to the surroundings of the beam at `angle_deg` at `time_ns`. Before the first call, `view` must
    /// be a clone of [`WorldView::still`].
    pub(crate) fn show_beam(&self, view: &mut View, angle_deg: f64, time_ns: Nanos) {
        view.narrow(&self.still, angle_deg);
        self.draw(view, time_ns);
    }

    fn draw(&self, view: &mut View, time_ns: Nanos) {
        if let Some(mount) = &self.mount {
            return self.draw_cut(&mount.plane(time_ns), view, time_ns);
        }
        for face in self.faces(time_ns) {
            view.draw(face);
        }
        for object in &self.changing {
            for presence in object.previous_presences(time_ns as f64 / 1e9) {
                for shape in self.visible_shapes(object, presence.pose) {
                    view.uncover(&shape, nanos(presence.since_s));
                }
            }
        }
    }

    /// Draws everything that `plane` cuts.
    fn draw_cut(&self, plane: &Plane, view: &mut View, time_ns: Nanos) {
        let time_s = time_ns as f64 / 1e9;
        let face = |shape, surface, kind| Face { shape, surface, kind };
        if let Some(floor) = plane.cut_floor() {
            view.draw(face(floor, Surface::Plain, Kind::Static));
        }
        for object in self.still_objects.iter().chain(&self.changing) {
            let Some(presence) = object.at(time_s) else { continue };
            let kind = Kind::since(nanos(presence.since_s));
            let shapes = self.visible_shapes(object, presence.pose);
            plane.cut(&shapes, object.heights, object.is_box, |cut| {
                view.draw(face(cut, object.surface, kind))
            });
        }
        for (part, heights) in self.people.iter().filter_map(|person| person.body(time_s)).flatten() {
            let part = part.transformed(|point| self.in_scanner_frame(point));
            plane.cut(&[part], heights, false, |cut| view.draw(face(cut, Surface::Plain, Kind::Person)));
        }
        for object in &self.changing {
            for presence in object.previous_presences(time_s) {
                let shapes = self.visible_shapes(object, presence.pose);
                let since_ns = nanos(presence.since_s);
                plane.cut(&shapes, object.heights, object.is_box, |cut| view.uncover(&cut, since_ns));
            }
        }
    }

    /// Returns the middle of each reflector that is visible at `time_ns`. For a tilted scanner, returns no marks.
    pub(crate) fn marks(&self, time_ns: Nanos) -> Vec<Mark> {
        if self.is_tilted() {
            return Vec::new();
        }
        let view = self.view(time_ns);
        let moving = self.faces(time_ns).into_iter().filter(|face| face.surface == Surface::Reflector);
        let fronts = self.still_reflectors.iter().copied().chain(moving.map(|face| face.shape));
        let marks = fronts.map(|shape| {
            let (right, ahead) = shape.front();
            Mark { angle_deg: (-right).atan2(ahead).to_degrees(), range_mm: right.hypot(ahead) }
        });
        marks.filter(|mark| view.is_visible(mark.angle_deg, mark.range_mm)).collect()
    }
}

fn nanos(time_s: f64) -> Nanos {
    (time_s * 1e9).round() as Nanos
}

/// A visible shape, in the frame of the scanner.
#[derive(Clone, Debug)]
pub(crate) struct Face {
    pub(crate) shape: Shape,
    pub(crate) surface: Surface,
    pub(crate) kind: Kind,
}

/// Kind of object that a face belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// An object that has been in place since the start.
    Static,
    /// A leg of a person.
    Person,
    /// An object that appeared or moved at this time.
    Box { since_ns: Nanos },
}

impl Kind {
    /// Returns the kind of an object that has been in place since `since_ns`.
    pub(crate) fn since(since_ns: Nanos) -> Kind {
        match since_ns {
            0 => Kind::Static,
            since_ns => Kind::Box { since_ns },
        }
    }
}

/// End of a ray.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Hit {
    /// Range of the surface; infinite if there is none.
    pub(crate) range_mm: f64,
    /// Index of the face.
    face: u32,
    /// Time at which the last object in front of this surface was removed; 0 if no object was removed.
    pub(crate) since_ns: Nanos,
}

impl Hit {
    /// Returns whether both rays end at the same face, and have ended there since the same time.
    pub(crate) fn is_of(&self, other: &Hit) -> bool {
        self.face == other.face && self.since_ns == other.since_ns
    }
}

/// Adjacent rays at one time.
#[derive(Clone, Debug)]
pub(crate) struct View {
    faces: Vec<Face>,
    hits: Vec<Hit>,
    /// Index of the first ray of this view in [`DIRECTIONS`].
    first: usize,
}

impl View {
    /// Creates a view without surfaces, in all directions.
    pub(crate) fn empty() -> View {
        let nothing = Hit { range_mm: f64::INFINITY, face: u32::MAX, since_ns: 0 };
        View { faces: Vec::new(), hits: vec![nothing; DIRECTIONS.len()], first: 0 }
    }

    /// Returns the half of the view that is ahead.
    pub(crate) fn ahead(&self) -> View {
        const RIGHT: usize = 90 * RAYS_PER_DEGREE as usize;
        const RAYS: usize = 180 * RAYS_PER_DEGREE as usize + 1 + 2 * SPOT_RAYS;
        let from = RIGHT - self.first;
        View { faces: self.faces.clone(), hits: self.hits[from..from + RAYS].to_vec(), first: RIGHT }
    }

    /// Copies the rays of `still` around the beam at `angle_deg`. Drops all faces that are not in `still`. The first
    /// faces of this view must be the faces of `still`.
    pub(crate) fn narrow(&mut self, still: &View, angle_deg: f64) {
        let middle = ray_index((angle_deg * 1e3) as i32) - still.first;
        self.faces.truncate(still.faces.len());
        self.hits.clear();
        self.hits.extend_from_slice(&still.hits[middle - SPOT_RAYS..=middle + SPOT_RAYS]);
        self.first = still.first + middle - SPOT_RAYS;
    }

    /// Adds `face` to the view. Each ray of the view then ends at its nearest face.
    pub(crate) fn draw(&mut self, face: Face) {
        let number = self.faces.len() as u32;
        for ray in rays(&face.shape, self.ray_range()) {
            let direction = DIRECTIONS[ray];
            let hit = &mut self.hits[ray - self.first];
            if face.surface == Surface::Glass && face.shape.squareness(direction) < MIN_GLASS_COSINE {
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

    /// Marks the surfaces that `shape` hid until `since_ns`. Call this function after all faces are drawn.
    pub(crate) fn uncover(&mut self, shape: &Shape, since_ns: Nanos) {
        for ray in rays(shape, self.ray_range()) {
            let hit = &mut self.hits[ray - self.first];
            if shape.distance(DIRECTIONS[ray]).is_some_and(|range_mm| range_mm < hit.range_mm) {
                hit.since_ns = hit.since_ns.max(since_ns);
            }
        }
    }

    /// Returns the ray at the scanner's angle `angle_mdeg` (0 ahead), with [`SPOT_RAYS`] rays to each side.
    pub(crate) fn rays_around(&self, angle_mdeg: i32) -> &[Hit] {
        let middle = ray_index(angle_mdeg) - self.first;
        &self.hits[middle - SPOT_RAYS..=middle + SPOT_RAYS]
    }

    /// Returns whether a point at the scanner's angle `angle_deg` and `range_mm` is visible: within the field of view,
    /// and not hidden by a surface.
    pub(crate) fn is_visible(&self, angle_deg: f64, range_mm: f64) -> bool {
        let ray = ((angle_deg + 180.0) * f64::from(RAYS_PER_DEGREE)).round() as usize + SPOT_RAYS;
        (-90.0..=90.0).contains(&angle_deg) && self.hits[ray - self.first].range_mm > range_mm - 1.0
    }

    /// Returns the range of the ray next to `angle_deg`, and the exact range at this angle of the face that the ray
    /// hits.
    pub(crate) fn exact(&self, angle_deg: f64) -> (f64, Option<f64>) {
        let hit = &self.hits[ray_index((angle_deg * 1e3) as i32) - self.first];
        let face = self.face(hit).filter(|_| hit.range_mm.is_finite());
        (hit.range_mm, face.map(|face| face.shape.distance(direction(angle_deg)).unwrap_or(hit.range_mm)))
    }

    fn ray_range(&self) -> Range<usize> {
        self.first..self.first + self.hits.len()
    }

    /// Returns the face at which `hit` ends, or `None` if there is no surface.
    pub(crate) fn face(&self, hit: &Hit) -> Option<&Face> {
        self.faces.get(hit.face as usize)
    }
}

/// Returns the index of the ray at the scanner's angle `angle_mdeg`, -180 to 180 degrees.
fn ray_index(angle_mdeg: i32) -> usize {
    SPOT_RAYS + ((angle_mdeg + 180_000) * RAYS_PER_DEGREE / 1000) as usize
}

/// Returns the indices in `range` of the rays that can meet `shape`.
fn rays(shape: &Shape, range: Range<usize>) -> impl Iterator<Item = usize> + use<> {
    let span = shape.span_deg();
    // Angles repeat after 360 degrees, so the span of the shape may overlap the range of rays at either end.
    [-360.0, 0.0, 360.0].into_iter().flat_map(move |turn| {
        let Some((first, width)) = span else { return 0..0 };
        let ray = |angle_deg: f64| {
            (angle_deg + turn - FIRST_RAY_DEG) * f64::from(RAYS_PER_DEGREE) + SPOT_RAYS as f64
        };
        let first_ray = ray(first).floor().max(0.0) as usize;
        let end = (ray(first + width).ceil() + 1.0).max(0.0) as usize;
        first_ray.max(range.start)..end.min(range.end)
    })
}

/// Number of rays per degree. Neighboring rays are 4 mm apart at 4 m. Each beam of each variant coincides with a ray.
const RAYS_PER_DEGREE: i32 = 16;
/// Number of rays that the widest spot covers on each side of its middle. They cover more than a degree on each side.
pub(crate) const SPOT_RAYS: usize = 20;
/// Angle between two rays in radians.
pub(crate) const RAY_STEP: f64 = std::f64::consts::PI / 180.0 / RAYS_PER_DEGREE as f64;
/// Minimum cosine of the angle of incidence at which glass reflects a beam back: within 3 degrees of a right angle.
const MIN_GLASS_COSINE: f64 = 0.9986;

/// Angle of the first ray: behind the scanner, in degrees counterclockwise from its right.
const FIRST_RAY_DEG: f64 = -90.0;

/// Unit vectors of all rays, for a full circle from behind the scanner, with [`SPOT_RAYS`] more rays at both ends.
static DIRECTIONS: LazyLock<Vec<Point>> = LazyLock::new(|| {
    let count = 360 * RAYS_PER_DEGREE + 1 + 2 * SPOT_RAYS as i32;
    let angle = |ray: i32| f64::from(ray - SPOT_RAYS as i32) / f64::from(RAYS_PER_DEGREE) - 180.0;
    (0..count).map(|ray| direction(angle(ray))).collect()
});

/// Returns the unit vector at the scanner's angle `angle_deg`.
fn direction(angle_deg: f64) -> Point {
    let from_right = (angle_deg - FIRST_RAY_DEG).to_radians();
    (from_right.cos(), from_right.sin())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_ray_ends_at_the_nearest_shape() {
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
        assert_eq!(view.rays_around(0)[SPOT_RAYS].range_mm, view.hits[SPOT_RAYS + 2880].range_mm);
        assert!(DIRECTIONS[SPOT_RAYS + 2880].0.abs() < 1e-12);
    }

    #[test]
    fn glass_returns_only_perpendicular_beams() {
        let mut view = View::empty();
        let shape = Shape::Wall { from: (-3000.0, 2000.0), to: (3000.0, 2000.0) };
        view.draw(Face { shape, surface: Surface::Glass, kind: Kind::Static });
        assert!((view.rays_around(0)[SPOT_RAYS].range_mm - 2000.0).abs() < 1e-9);
        assert!(view.rays_around(-10_000)[SPOT_RAYS].range_mm.is_infinite());
    }
}
