//! The available worlds: some for tests of the sensor, made in code, and scenes as data: built-in ones, and files. Knows
//! where a world comes from, not what is in it.

mod file;

use std::path::Path;
use std::str::FromStr;
use std::sync::Arc;

use schema::{Failure, Kind, regular};

use crate::layers::Layers;
use crate::mount::{Fault, Mount};
use crate::scene::Scene;

/// What a sensor can be put into.
#[derive(Clone, Debug, PartialEq)]
pub enum World {
    /// Nothing within reach.
    Empty,
    /// A wall bent around the sensor so that every value is 640: its bytes are `80 02` throughout, so each beam but
    /// the last ends in what a header begins with.
    Wall640,
    /// Words without meaning: every bit that the mode may set, at random.
    Random,
    /// Walls, things and people.
    Scene(Arc<Scene>),
}

/// The scenes that the program brings along: name and text.
const SCENES: [(&str, &str); 16] = [
    ("room", include_str!("../../../tests/worlds/room.toml")),
    ("bare", include_str!("../../../tests/worlds/bare.toml")),
    ("fig8", include_str!("../../../tests/worlds/fig8.toml")),
    ("standing", include_str!("../../../tests/worlds/standing.toml")),
    ("approach", include_str!("../../../tests/worlds/approach.toml")),
    ("door", include_str!("../../../tests/worlds/door.toml")),
    ("corridor", include_str!("../../../tests/worlds/corridor.toml")),
    ("glass", include_str!("../../../tests/worlds/glass.toml")),
    ("faint", include_str!("../../../tests/worlds/faint.toml")),
    ("sun", include_str!("../../../tests/worlds/sun.toml")),
    ("chair", include_str!("../../../tests/worlds/chair.toml")),
    ("strips", include_str!("../../../tests/worlds/strips.toml")),
    ("crowd", include_str!("../../../tests/worlds/crowd.toml")),
    ("demo", include_str!("../../../tests/worlds/demo.toml")),
    ("house", include_str!("../../../tests/worlds/house.toml")),
    ("tilt", include_str!("../../../tests/worlds/tilt.toml")),
];

impl World {
    /// The names of all worlds that need no file.
    pub fn names() -> impl Iterator<Item = &'static str> {
        SCENES.iter().map(|(name, _)| *name).chain(["empty", "wall640", "random"])
    }

    /// The world that `text` describes in TOML; `name` is how failures call it.
    ///
    /// [`Kind::Configuration`] if it is none, with place, value and remedy.
    pub fn of_toml(name: &str, text: &str) -> Result<World, Failure> {
        file::parse(name, text).map(|scene| World::Scene(Arc::new(scene)))
    }

    /// How many sensors look at it.
    pub fn sensors(&self) -> usize {
        match self {
            World::Scene(scene) => scene.sensors.len(),
            _ => 1,
        }
    }

    /// What tilts its sensor number `sensor`, if anything does.
    pub fn mount(&self, sensor: usize) -> Option<&Mount> {
        match self {
            World::Scene(scene) => scene.sensors.get(sensor)?.mount.as_ref(),
            _ => None,
        }
    }

    /// The same world with `faults` of all its mounts, instead of those that they have.
    pub fn with_mount_faults(self, faults: &[Fault]) -> World {
        let World::Scene(scene) = self else { return self };
        let mut scene = Arc::unwrap_or_clone(scene);
        let mounts = scene.sensors.iter_mut().filter_map(|sensor| sensor.mount.as_mut());
        mounts.for_each(|mount| mount.faults = faults.to_vec());
        World::Scene(Arc::new(scene))
    }

    /// Its layers of noise, if it has any.
    pub fn layers(&self) -> Option<Layers> {
        match self {
            World::Scene(scene) => Some(scene.layers),
            _ => None,
        }
    }

    /// The same world with other layers of noise; one without layers stays as it is.
    pub fn with_layers(self, layers: Layers) -> World {
        match self {
            World::Scene(scene) => World::Scene(Arc::new(Scene { layers, ..Arc::unwrap_or_clone(scene) })),
            other => other,
        }
    }
}

impl FromStr for World {
    type Err = Failure;

    /// The world of this name, else of this file.
    ///
    /// [`Kind::Input`] if it is neither; [`Kind::Configuration`] if the file is wrong: with the place and a remedy.
    fn from_str(text: &str) -> Result<World, Failure> {
        match text {
            "empty" => Ok(World::Empty),
            "wall640" => Ok(World::Wall640),
            "random" => Ok(World::Random),
            _ => match SCENES.iter().find(|(name, _)| *name == text) {
                Some((name, contents)) => World::of_toml(name, contents),
                None => World::of_toml(text, &read(text)?),
            },
        }
    }
}

fn read(path: &str) -> Result<String, Failure> {
    regular::read_text(Path::new(path), regular::LONGEST).map_err(|error| {
        let names: Vec<_> = World::names().collect();
        let message = format!("world {path:?} is not known, and as a file: {error}");
        Failure::new(Kind::Input, message, format!("a TOML file, or one of: {}", names.join(", ")))
    })
}
