//! Worlds as data: every file is one that runs, a wrong one is refused by name and place, each layer of noise acts and
//! can be switched off, and the truth is what geometry says.

mod files;
mod layers;
mod tilted;
mod truth;

use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_schema::Nanos;
use scanhub_sim::room::LabeledScan;
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

/// The directory of the files.
const WORLDS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/worlds");

/// Time of one scan of 361 beams.
const SCAN_NS: Nanos = 26_640_000;

/// The room of a world in TOML.
fn room(text: &str, seed: u64) -> Room {
    Room::new(&world(text), seed)
}

fn world(text: &str) -> World {
    World::of_toml("world", text).unwrap_or_else(|failure| panic!("{failure}"))
}

/// 361 beams in millimetres with levels.
fn look(room: &Room, end_ns: Nanos) -> LabeledScan {
    room.labeled_scan(Variant::HALF, Unit::Mm, Mode(1), end_ns)
}

/// A text of the directory.
fn text(name: &str) -> String {
    std::fs::read_to_string(format!("{WORLDS}/{name}.toml")).expect("a file of this name")
}
