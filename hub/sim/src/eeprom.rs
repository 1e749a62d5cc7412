//! What the sensor keeps without power: configuration and permanent rate, as bytes where the protocol has bytes, and how
//! many requests asked to write them. Automatic code never does; tests check the count.

use scanhub_drivers::lms::configuration::{OLD_LEN, REAL_TIME_INDICES, factory};
use scanhub_drivers::lms::variant::{Baud, Mode, Unit};

use crate::settings::Settings;

/// The sensor's EEPROM, as far as it matters here.
#[derive(Clone, Debug)]
pub(crate) struct Eeprom {
    /// Data of F4h: 34 bytes, 32 with older firmware.
    configuration: Vec<u8>,
    /// Rate at power-on, where it is not 9600.
    pub(crate) permanent_baud: Option<Baud>,
    /// Requests to write, done or refused.
    pub(crate) writes: u64,
}

impl Eeprom {
    /// As it left the factory, but for what `settings` name (Telegram listing, 77h).
    pub(crate) fn new(settings: &Settings) -> Eeprom {
        let mut configuration = factory(settings.mode, settings.unit).to_vec();
        configuration[AVAILABILITY] = settings.availability;
        configuration.truncate(settings.configuration_len.max(OLD_LEN));
        Eeprom { configuration, permanent_baud: settings.permanent_baud, writes: 0 }
    }

    /// The configuration's bytes.
    pub(crate) fn configuration(&self) -> &[u8] {
        &self.configuration
    }

    pub(crate) fn mode(&self) -> Mode {
        Mode(self.configuration[MODE])
    }

    pub(crate) fn unit(&self) -> Unit {
        // Nothing else was written: see `rewritten`.
        Unit::of_code(self.configuration[UNIT]).unwrap_or(Unit::Mm)
    }

    /// Whether measured values end with scan and telegram index.
    pub(crate) fn has_indices(&self) -> bool {
        self.configuration[AVAILABILITY] & REAL_TIME_INDICES != 0
    }

    pub(crate) fn power_on_baud(&self) -> Baud {
        self.permanent_baud.unwrap_or(Baud::B9600)
    }

    /// The EEPROM with the leading bytes of its configuration as `data` has them; bytes too many are passed over.
    /// `None` if no sensor can be set so.
    pub(crate) fn rewritten(&self, data: &[u8]) -> Option<Eeprom> {
        let mut written = self.clone();
        let len = data.len().min(self.configuration.len());
        written.configuration[..len].copy_from_slice(&data[..len]);
        let known = MODES.contains(&written.mode().0) && Unit::of_code(written.configuration[UNIT]).is_some();
        known.then_some(written)
    }
}

const AVAILABILITY: usize = 4;
const MODE: usize = 5;
const UNIT: usize = 6;
/// Measuring modes of the listing (77h block D), and the two that a sensor needs for reflectivity (reference 1.6).
const MODES: [u8; 11] = [0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x0D, 0x0E, 0x0F, 0x3F];
