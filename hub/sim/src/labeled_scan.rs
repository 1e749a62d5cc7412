//! One scan of a world: the values that the sensor would send, and for each the object that its beam really hit. Knows
//! neither shapes nor noise.

use schema::Nanos;

/// A scan, and the truth for it.
#[derive(Clone, Debug, PartialEq)]
pub struct LabeledScan {
    /// A value word for each beam.
    pub words: Vec<u16>,
    /// What each of these beams met, in the same order.
    pub truth: Vec<Met>,
}

/// What a beam hit with all of its spot.
///
/// A world does not know what a consumer has learned, only since when things are as they are. So each object that has
/// appeared, disappeared or moved has the time of that, and a bench decides how long afterwards it counts as foreground.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Met {
    /// What stood there when the world began, and everything that people do not carry away.
    Static {
        /// Since when the beam meets it: 0, or when a thing that stood or moved before it was gone. The surface is an
        /// old one, but new to the beam: the place where a box was. People who pass leave no such trace.
        since_ns: Nanos,
    },
    /// A leg of somebody, standing or walking.
    Person,
    /// A thing that was put down or moved after the world began, a door too, and is nearer than what the beam met before;
    /// one that moved away from the sensor is [`Met::Static`] as what it uncovers is.
    Box {
        /// When it was put down or came to rest; the time of the scan itself while it moves.
        since_ns: Nanos,
    },
    /// A person, or a thing as in [`Met::Box`], and beside it something else: whichever the beam tells, it is not
    /// wrong. Stays so at the edges of a box however long it stands.
    Grazed,
    /// The word holds a code instead of a range, whatever the beam met.
    Invalid,
}

/// The place of a reflector as geometry has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// Angle of its middle in degrees, counter-clockwise, 0 ahead of the sensor.
    pub angle_deg: f64,
    /// Range of its middle in millimetres.
    pub range_mm: f64,
}
