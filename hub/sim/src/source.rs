//! Where the sensor's scans come from: a room that is measured anew each time, or a recording that is told once from
//! its beginning to its end. Knows neither requests nor the line.

use lms::Nanos;
use lms::measured;
use lms::variant::Variant;

use crate::answer::STATUS;
use crate::machine::Settings;
use crate::room::Room;

/// A source of measured-value telegrams.
pub enum Source {
    /// A simulated room.
    Room(Room),
    /// Whole telegrams, sent as they are.
    Recorded {
        /// The variant of the recording, which the sensor is fixed to.
        variant: Variant,
        /// In the order to send them; the stream ends with them.
        telegrams: Box<dyn Iterator<Item = Vec<u8>> + Send>,
    },
}

impl Source {
    /// The telegram that begins to leave at `start_ns`, as the sensor is set at that time; `None` at the end.
    pub(crate) fn telegram(&mut self, start_ns: Nanos, settings: &Settings) -> Option<Vec<u8>> {
        match self {
            Source::Room(room) => {
                let words = room.scan(settings.variant, settings.unit, settings.mode, start_ns);
                Some(measured::encode(settings.address, settings.unit, &words, STATUS).bytes().to_vec())
            }
            Source::Recorded { telegrams, .. } => telegrams.next(),
        }
    }

    /// The only variant that it can, if it cannot do others.
    pub(crate) fn variant(&self) -> Option<Variant> {
        match self {
            Source::Room(_) => None,
            Source::Recorded { variant, .. } => Some(*variant),
        }
    }
}
