//! The models of the family, as far as they differ. Where the figures come from: the makers' data sheets.

use crate::settings::Settings;

/// A scanner of the family.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Model {
    /// LD06.
    Ld06,
    /// LD19, also sold in the kit D500.
    Ld19,
    /// STL19P.
    Stl19p,
    /// STL27L.
    Stl27l,
    /// LD14P, whose head turns slower.
    Ld14p,
}

impl Model {
    /// All of them.
    pub const ALL: [Model; 5] = [Model::Ld06, Model::Ld19, Model::Stl19p, Model::Stl27l, Model::Ld14p];

    /// Its name in configuration and words.
    pub const fn name(self) -> &'static str {
        match self {
            Model::Ld06 => "ld06",
            Model::Ld19 => "ld19",
            Model::Stl19p => "stl19p",
            Model::Stl27l => "stl27l",
            Model::Ld14p => "ld14p",
        }
    }

    /// The model of this name.
    pub fn named(name: &str) -> Option<Model> {
        Model::ALL.into_iter().find(|model| model.name() == name)
    }

    /// Returns the model of `settings`.
    pub(crate) fn of(settings: &Settings) -> Option<Model> {
        settings.model.and_then(Model::named)
    }

    /// The rate at which it speaks, in bits per second.
    pub const fn baud(self) -> u32 {
        match self {
            Model::Stl27l => 921_600,
            _ => 230_400,
        }
    }

    /// Points that it measures in a second, whatever the speed of its head.
    pub const fn points_per_second(self) -> u32 {
        match self {
            Model::Stl27l => 21_600,
            Model::Ld14p => 4_000,
            _ => 4_500,
        }
    }

    /// Turns in a second, as it comes out of its box.
    pub const fn turns_per_second(self) -> u32 {
        match self {
            Model::Ld14p => 6,
            _ => 10,
        }
    }

    /// Beams of a turn unless something else is asked for: chosen by measurement (docs/scanners.md).
    pub const fn beams(self) -> usize {
        match self {
            Model::Stl27l => 2_160,
            Model::Ld14p => 666,
            _ => 450,
        }
    }

    /// The model that measures so many points in a second; of those that cannot be told apart, the best known one.
    pub(crate) fn of_point_rate(points_per_second: f32) -> Model {
        match points_per_second {
            rate if rate > 10_000.0 => Model::Stl27l,
            rate if (3_600.0..4_250.0).contains(&rate) => Model::Ld14p,
            _ => Model::Ld19,
        }
    }
}
