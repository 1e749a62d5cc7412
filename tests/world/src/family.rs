//! The families of scanners in a world, a file each: how one of them is found, what its link's configuration says, what its
//! bytes mean to the judges. All else in a world knows none of them.

mod ld;
mod lms;

use std::rc::Rc;

use ::lms::Nanos;
use schema::Scan;
use sim::device::Device;
use sim::ld::TruePoint;
use sim::room::Room;
use sim::series::Changes;
use sim::world::World as Scene;

use crate::plan::Action;

/// A scanner of a world and its link, as the seed has them.
pub(crate) trait Family {
    /// The keys of its link, as `KEY=VALUE`.
    fn keys(&self) -> Vec<String>;

    /// The longest time between two scans, and from when something is measured until the scan that tells it has left.
    fn times(&self) -> (Nanos, Nanos);

    /// The scanner as it is found, whose view changes as `changes` say.
    fn found(&self, changes: Changes) -> Box<dyn Scanner>;

    /// What it sent one by one, of the bytes of a sample of telegrams.
    fn units<'a>(&self, sample: &'a [u8]) -> Vec<&'a [u8]>;

    /// So many of them are in a sample at the most.
    fn most_units(&self) -> usize;

    /// Whether `unit` is measured values, and no reply.
    fn is_data(&self, unit: &[u8]) -> bool;

    /// Whether `scan` has the values of the last `sample` of telegrams, where a sample has those of a scan.
    fn is_scan_of(&self, scan: &Scan, sample: &[u8]) -> bool;

    /// Whether a line may have made `got` of one of the units that it `damaged` lately, so that nobody can know: a checksum
    /// is right once in a while.
    fn is_collision(&self, got: &[u8], damaged: &mut dyn Iterator<Item = &[u8]>) -> bool;

    /// Whether its head turns all around, and its scans are turns of points whose truth is known.
    fn turns(&self) -> bool {
        false
    }

    /// Where the last point of `unit` is, in degrees clockwise, if it has one and its head turns.
    fn last_deg(&self, unit: &[u8]) -> Option<f64> {
        let _ = unit;
        None
    }
}

/// A simulated scanner, and what only some of its family can do; of the others it does nothing.
pub(crate) trait Scanner {
    /// The scanner itself.
    fn device(&self) -> &dyn Device;

    /// The same, to be driven.
    fn device_mut(&mut self) -> &mut dyn Device;

    /// Another one is at the line from `now` on, as `action` says; what somebody said to it just before, in bytes.
    fn exchange(&mut self, action: &Action, now: Nanos) -> Vec<u8>;

    /// It behaves badly as `action` says, or well again.
    fn misbehave(&mut self, action: Option<&Action>);

    /// Its head turns at this share of its usual speed, as soon as it gets there.
    fn set_pace(&mut self, share: f64) {
        let _ = share;
    }

    /// The points that it measured since this was asked last, if their truth is known.
    fn measured(&mut self) -> Vec<TruePoint> {
        Vec::new()
    }
}

/// The scanners that `random` draws.
pub(crate) fn draw(random: &mut fastrand::Rng) -> Vec<Rc<dyn Family>> {
    let count = random.usize(1..=2);
    let one = |random: &mut fastrand::Rng| -> Rc<dyn Family> {
        match random.u8(..5) {
            0..=2 => Rc::new(lms::Lms::draw(random)),
            _ => Rc::new(ld::Ld::draw(random)),
        }
    };
    (0..count).map(|_| one(random)).collect()
}

/// The scanner of this model, otherwise as `random` draws it; nothing if there is none.
pub(crate) fn named(model: &str, random: &mut fastrand::Rng) -> Option<Rc<dyn Family>> {
    Some(Rc::new(ld::Ld::of(::ld::Model::named(model)?, random)))
}

/// The models that a plan may name.
pub(crate) const MODELS: [&str; ::ld::Model::ALL.len()] = ["ld06", "ld19", "stl19p", "stl27l", "ld14p"];

/// What scanners see in all worlds: a room without anything near, the same with a post 0.8 m ahead, and with one 0.4 m ahead.
fn rooms(layers: impl Fn(Scene) -> Scene) -> Vec<Room> {
    let rooms = [None, Some(800), Some(400)].map(|ahead_mm: Option<u32>| {
        let post =
            ahead_mm.map_or(String::new(), |mm| format!("[[thing]]\nradius_mm = 100\npose = [0, {mm}]\n"));
        let scene = Scene::of_toml("world", &format!("{WALLS}{post}")).expect("a scene");
        Room::new(&layers(scene), 1)
    });
    rooms.to_vec()
}

/// Four walls, and noise as a real sensor has it, but no codes: what is near is seen by every scan.
const WALLS: &str = "
[noise]
tail = 0
errors = 0
weak = false
dazzle = false

[[thing]]
line = [[3400, -500], [3400, 5600], [-4100, 5600], [-4100, -500]]

[[thing]]
radius_mm = 50
pose = [2900, 4800]
surface = \"reflector\"
";
