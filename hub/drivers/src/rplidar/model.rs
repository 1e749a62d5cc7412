//! The models of the family and their modes, as far as they differ. Where the figures come from: the maker's data sheets; of
//! an A1, measurements of a real one.

use crate::line::family::Settings;

/// A scanner of the family.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Model {
    /// A1M8.
    A1,
    /// A2M8, and the older ones of its kind.
    A2m8,
    /// A2M12.
    A2m12,
    /// A3M1.
    A3,
    /// S1.
    S1,
    /// S2.
    S2,
    /// S3.
    S3,
    /// C1.
    C1,
}

/// What turns the head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Motor {
    /// The line DTR, while it is not asserted; nothing else can.
    Dtr,
    /// A request with a duty cycle, if an accessory board is there to obey; else as [`Motor::Dtr`].
    Board,
    /// A request with a speed.
    Speed,
}

impl Model {
    /// All of them.
    pub const ALL: [Model; 8] =
        [Model::A1, Model::A2m8, Model::A2m12, Model::A3, Model::S1, Model::S2, Model::S3, Model::C1];

    /// Its name in configuration and words.
    pub const fn name(self) -> &'static str {
        match self {
            Model::A1 => "a1",
            Model::A2m8 => "a2m8",
            Model::A2m12 => "a2m12",
            Model::A3 => "a3",
            Model::S1 => "s1",
            Model::S2 => "s2",
            Model::S3 => "s3",
            Model::C1 => "c1",
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

    /// The model that says `id` of itself: its series in the upper half.
    pub(crate) fn of_id(id: u8) -> Option<Model> {
        match (id >> 4, id & 15) {
            (1, _) => Some(Model::A1),
            (2, 12) => Some(Model::A2m12),
            (2, _) => Some(Model::A2m8),
            (3, _) => Some(Model::A3),
            (4, _) => Some(Model::C1),
            (6, _) => Some(Model::S1),
            (7, _) => Some(Model::S2),
            (8, _) => Some(Model::S3),
            _ => None,
        }
    }

    /// The rate at which it speaks, in bits per second.
    pub const fn baud(self) -> u32 {
        match self {
            Model::A1 | Model::A2m8 => 115_200,
            Model::A2m12 | Model::A3 | Model::S1 => 256_000,
            Model::C1 => 460_800,
            Model::S2 | Model::S3 => 1_000_000,
        }
    }

    /// Points that it measures in a second in its fastest mode.
    pub const fn points_per_second(self) -> u32 {
        match self {
            Model::A1 => 7_874,
            Model::A2m8 => 8_000,
            Model::A2m12 | Model::A3 => 16_000,
            Model::S1 => 9_200,
            Model::S2 | Model::S3 => 32_000,
            Model::C1 => 5_000,
        }
    }

    /// Turns in a second.
    pub const fn turns_per_second(self) -> f32 {
        match self {
            Model::A1 => 7.3,
            _ => 10.0,
        }
    }

    /// Beams of a turn in its fastest mode unless something else is asked for: its points.
    pub const fn beams(self) -> usize {
        self.beams_of(self.points_per_second() as f32)
    }

    /// Beams of a turn where so many points are measured in a second.
    pub(crate) const fn beams_of(self, points_per_second: f32) -> usize {
        (points_per_second / self.turns_per_second() + 0.5) as usize
    }
}

/// A way of measuring that a model may offer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// A packet for each point, with its quality; the slowest.
    Standard,
    /// More points in packets with a checksum.
    Express,
    /// More points, for short distances.
    Boost,
    /// More points, for dark targets.
    Sensitivity,
    /// Fewer points, where the sun shines.
    Stability,
    /// The fastest of the S series and of the C1.
    DenseBoost,
    /// The fastest with a quality for each point.
    UltraDense,
}

impl Mode {
    /// All of them.
    pub const ALL: [Mode; 7] = [
        Mode::Standard,
        Mode::Express,
        Mode::Boost,
        Mode::Sensitivity,
        Mode::Stability,
        Mode::DenseBoost,
        Mode::UltraDense,
    ];

    /// Its name in configuration and words.
    pub const fn name(self) -> &'static str {
        match self {
            Mode::Standard => "standard",
            Mode::Express => "express",
            Mode::Boost => "boost",
            Mode::Sensitivity => "sensitivity",
            Mode::Stability => "stability",
            Mode::DenseBoost => "denseboost",
            Mode::UltraDense => "ultradense",
        }
    }

    /// The mode of this name.
    pub fn named(name: &str) -> Option<Mode> {
        Mode::said(name.as_bytes())
    }

    /// Returns the mode of `settings`.
    pub(crate) fn of(settings: &Settings) -> Option<Mode> {
        settings.mode.and_then(Mode::named)
    }

    /// The mode that a scanner calls `name`: in capitals, with spaces, ended by a zero, as it likes.
    pub(crate) fn said(name: &[u8]) -> Option<Mode> {
        Mode::ALL.into_iter().find(|mode| {
            let letters = name.iter().filter(|byte| byte.is_ascii_alphanumeric());
            letters.map(u8::to_ascii_lowercase).eq(mode.name().bytes())
        })
    }
}
