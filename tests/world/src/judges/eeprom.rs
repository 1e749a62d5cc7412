//! Nothing that a hub says to a sensor writes its EEPROM.

use scanhub_schema::Nanos;

use super::{Judge, Say};
use crate::event::Event;

/// Looks at the end.
pub(crate) struct Eeprom;

impl Judge for Eeprom {
    fn name(&self) -> &'static str {
        "eeprom"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        if let Event::Over { eeprom_writes, .. } = *event
            && eeprom_writes > 0
        {
            say.broken(format!("sensors heard {eeprom_writes} requests that write the EEPROM"));
        }
    }
}
