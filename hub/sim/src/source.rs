//! Where the sensor's scans come from: a room that is measured for each scan, or a recording that is played from start to
//! end. Knows neither requests nor the line.

use scanhub_drivers::lms::variant::Variant;

use crate::operating::{Operating, Shot};
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
    /// The next telegram of a sensor in `operating`, of what `shot` makes of the room; `None` at the end of a
    /// recording, and in a mode that sends nothing.
    pub(crate) fn telegram<'a>(
        &'a mut self,
        operating: &Operating,
        shot: impl FnOnce(&'a Room) -> Shot<'a>,
    ) -> Option<Vec<u8>> {
        match self {
            Source::Room(room) => operating.telegram(&shot(room)),
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

    /// Whether a sensor that tells it can be in `operating`: a recording streams all values, and each once.
    pub(crate) fn can(&self, operating: &Operating) -> bool {
        matches!(self, Source::Room(_)) || *operating == Operating::All || !operating.streams()
    }
}
