//! Scenes of the simulated world as a method gets to see them: scans, and beside each beam what it should say of it.
//! Refuses to know any method.

use lms::variant::{Unit, Variant};
use schema::Scan;
use sim::labeled_scan::Met;
use sim::room::Room;
use sim::world::World;

use super::seen;

/// A scene of the table, 2000 scans of it, 53 s.
#[derive(Clone, Copy)]
pub(crate) struct Scene {
    /// What the table calls it.
    pub(crate) name: &'static str,
    /// Its world.
    pub(crate) world: &'static str,
    pub(crate) unit: Unit,
    /// Whether beams are as wide as real ones, so that at edges they tell one surface, the other or one between.
    pub(crate) mixed: bool,
}

const SCANS: u64 = 2_000;

/// What a method should say of a beam.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Due {
    /// In the foreground: a person.
    Foreground,
    /// Not in the foreground: what always stood there, what stood behind a thing that has been taken away, and a thing
    /// that was put down or moved more than [`OLD_S`] ago.
    Other,
    /// A thing that has been put down, moved or opened lately: rightly foreground until it is learned, and each method
    /// takes its own time.
    New,
    /// Grazed by a leg, or without a reading.
    Neither,
}

/// A thing older than this is background: twice the time that the paper's method takes at most.
const OLD_S: f64 = 20.0;

/// One scan and what is due.
pub(crate) struct Frame {
    pub(crate) scan: Box<Scan>,
    pub(crate) due: Vec<Due>,
    pub(crate) met: Vec<Met>,
}

/// The scans of `scene` as `seed` makes it.
pub(crate) fn play(scene: &Scene, seed: u64) -> Vec<Frame> {
    let world: World = scene.world.parse().expect("a world that the program brings along");
    let mut layers = world.layers().expect("a world with noise");
    layers.spot &= scene.mixed;
    let room = Room::new(&world.with_layers(layers), seed);
    (1..=SCANS).map(|number| frame(&room, scene.unit, number)).collect()
}

fn frame(room: &Room, unit: Unit, number: u64) -> Frame {
    let end_ns = number * Variant::HALF.turns() * lms::variant::MIRROR_TURN;
    let look = room.labeled_scan(Variant::HALF, unit, seen::MODE, end_ns);
    let scan = seen::scan(&look.words, unit);
    let due = (0..look.truth.len()).map(|i| due(&scan, i, look.truth[i], end_ns)).collect();
    Frame { scan, due, met: look.truth }
}

fn due(scan: &Scan, i: usize, met: Met, end_ns: u64) -> Due {
    match met {
        _ if scan.range(i).is_none() => Due::Neither,
        Met::Person => Due::Foreground,
        Met::Box { since_ns } if end_ns.saturating_sub(since_ns) as f64 <= OLD_S * 1e9 => Due::New,
        Met::Static { .. } | Met::Box { .. } => Due::Other,
        Met::Grazed | Met::Invalid => Due::Neither,
    }
}
