//! What a sensor's owner should know although scans come: plain words for what the sensor says of itself.

/// Something that the sensor said of itself; see [`crate::lms::Sensor::notices`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Notice {
    /// Its status report says that it is defective.
    Defective,
    /// Its telegrams end with a fatal error.
    Fatal,
    /// Its telegrams end with an error.
    Error,
    /// The window is dirty.
    Dirty,
    /// After power-on it does not begin at 9600.
    PermanentBaud,
}

impl Notice {
    /// Whether its scans may be wrong for it; else it is only good to know.
    pub fn is_fault(self) -> bool {
        self != Notice::PermanentBaud
    }

    /// Returns the message.
    pub(crate) fn text(self) -> &'static str {
        match self {
            Notice::Defective => {
                "the sensor reports that it is defective; it streams, but its scans may be wrong"
            }
            Notice::Fatal => "the sensor reports a fatal error; it streams, but its scans may be wrong",
            Notice::Error => "the sensor reports an error; it streams, but its scans may be wrong",
            Notice::Dirty => "the sensor's window is dirty: clean it",
            Notice::PermanentBaud => {
                "the rate after power-on in the sensor's EEPROM is not the factory's; the hub works with it as it is"
            }
        }
    }
}
