//! A scene with its random parts drawn from a seed, seen by one sensor: what is around it at a given time. Knows neither
//! units nor codes.

use schema::Nanos;

use crate::labeled_scan::Mark;
use crate::layers::Layers;
use crate::mount::Mount;
use crate::people::{Person, jittered};
use crate::scene::{Scene, Sun, Surface, Thing};
use crate::shape::{Pose, Shape};
use crate::solid::Plane;
use crate::view::{Face, Kind, View};

/// A scene as a seed makes it.
#[derive(Clone, Debug)]
pub(crate) struct WorldView {
    pub(crate) layers: Layers,
    sensor: Pose,
    mount: Option<Mount>,
    /// By how much all ranges of this sensor are off.
    pub(crate) bias_mm: f64,
    /// What never changes, drawn once; of a tilted sensor nothing.
    still: View,
    /// What a tilted sensor may see and never changes.
    still_things: Vec<Thing>,
    still_reflectors: Vec<Shape>,
    changing: Vec<Thing>,
    people: Vec<Person>,
    pub(crate) suns: Vec<Sun>,
}

impl WorldView {
    /// `scene` as `seed` makes it, seen by its sensor number `sensor`.
    pub(crate) fn new(scene: &Scene, seed: u64, sensor: u64) -> WorldView {
        let mut random = fastrand::Rng::with_seed(seed);
        let people = scene.people.iter().map(|plan| Person::new(plan, &mut random)).collect();
        let mut things = scene.things.clone();
        for thing in &mut things {
            let place = (thing.pose.x_mm, thing.pose.y_mm);
            (thing.pose.x_mm, thing.pose.y_mm) = jittered(place, thing.jitter_mm, &mut random);
        }
        let (still_things, changing): (Vec<_>, Vec<_>) = things.into_iter().partition(Thing::is_still);
        let bias = fastrand::Rng::with_seed(!seed ^ sensor << 32).f64();
        let mut stage = WorldView {
            layers: scene.layers,
            sensor: scene.sensors[sensor as usize].pose,
            mount: scene.sensors[sensor as usize].mount.clone(),
            bias_mm: scene.layers.bias_mm * (2.0 * bias - 1.0),
            still: View::empty(),
            still_things: Vec::new(),
            still_reflectors: Vec::new(),
            changing,
            people,
            suns: scene.suns.clone(),
        };
        if stage.mount.is_some() {
            stage.still_things = still_things;
            return stage;
        }
        for thing in still_things {
            for shape in stage.seen(&thing, thing.pose) {
                if thing.surface == Surface::Reflector {
                    stage.still_reflectors.push(shape);
                }
                stage.still.draw(Face { shape, surface: thing.surface, kind: Kind::Static });
            }
        }
        stage
    }

    /// The shapes of `thing` in the frame of the sensor, while it stands at `pose`.
    fn seen(&self, thing: &Thing, pose: Pose) -> Vec<Shape> {
        let place = |point| self.eye(pose.outward(point));
        thing.shapes.iter().map(|shape| shape.placed(place)).collect()
    }

    /// A point of the world in the frame of the sensor: x to its right, y ahead.
    fn eye(&self, point: (f64, f64)) -> (f64, f64) {
        let (ahead, left) = self.sensor.inward(point);
        (-left, ahead)
    }

    /// The things that come, go or move, and the people, as they are at `time_ns`.
    fn faces(&self, time_ns: Nanos) -> Vec<Face> {
        let time_s = time_ns as f64 / 1e9;
        let mut faces = Vec::new();
        for thing in &self.changing {
            let Some(spell) = thing.at(time_s) else { continue };
            let kind = Kind::since(nanos(spell.since_s));
            let shapes = self.seen(thing, spell.pose);
            faces.extend(shapes.into_iter().map(|shape| Face { shape, surface: thing.surface, kind }));
        }
        for legs in self.people.iter().filter_map(|person| person.legs(time_s)) {
            let leg = |leg: Shape| Face {
                shape: leg.placed(|point| self.eye(point)),
                surface: Surface::Plain,
                kind: Kind::Person,
            };
            faces.extend(legs.map(leg));
        }
        faces
    }

    /// Whether each beam has a plane of its own.
    pub(crate) fn is_tilted(&self) -> bool {
        self.mount.is_some()
    }

    /// What lies in each direction at `time_ns`.
    pub(crate) fn view(&self, time_ns: Nanos) -> View {
        let mut view = self.still.ahead();
        self.draw(&mut view, time_ns);
        view
    }

    /// What never changes, all around.
    pub(crate) fn still(&self) -> &View {
        &self.still
    }

    /// Makes `view`, which began as what never changes, what lies around the one beam at `angle_deg` at `time_ns`.
    pub(crate) fn look_along(&self, view: &mut View, angle_deg: f64, time_ns: Nanos) {
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
        for thing in &self.changing {
            for spell in thing.left(time_ns as f64 / 1e9) {
                for shape in self.seen(thing, spell.pose) {
                    view.uncover(&shape, nanos(spell.since_s));
                }
            }
        }
    }

    /// Draws what `plane` cuts.
    fn draw_cut(&self, plane: &Plane, view: &mut View, time_ns: Nanos) {
        let time_s = time_ns as f64 / 1e9;
        let face = |shape, surface, kind| Face { shape, surface, kind };
        if let Some(floor) = plane.cut_floor() {
            view.draw(face(floor, Surface::Plain, Kind::Static));
        }
        for thing in self.still_things.iter().chain(&self.changing) {
            let Some(spell) = thing.at(time_s) else { continue };
            let kind = Kind::since(nanos(spell.since_s));
            let shapes = self.seen(thing, spell.pose);
            plane.cut(&shapes, thing.heights, thing.is_box, |cut| view.draw(face(cut, thing.surface, kind)));
        }
        for (part, heights) in self.people.iter().filter_map(|person| person.body(time_s)).flatten() {
            let part = part.placed(|point| self.eye(point));
            plane.cut(&[part], heights, false, |cut| view.draw(face(cut, Surface::Plain, Kind::Person)));
        }
        for thing in &self.changing {
            for spell in thing.left(time_s) {
                let shapes = self.seen(thing, spell.pose);
                let since_ns = nanos(spell.since_s);
                plane.cut(&shapes, thing.heights, thing.is_box, |cut| view.uncover(&cut, since_ns));
            }
        }
    }

    /// The middle of each reflector that can be seen at `time_ns`; of a tilted sensor none.
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
        marks.filter(|mark| view.reaches(mark.angle_deg, mark.range_mm)).collect()
    }
}

fn nanos(time_s: f64) -> Nanos {
    (time_s * 1e9).round() as Nanos
}
