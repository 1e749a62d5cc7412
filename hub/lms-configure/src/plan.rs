//! Planned change of the EEPROM settings, and a person's consent to it. A plan contains only values.
//! [`Change`](crate::Change) carries it out only with a consent, which is valid for exactly the plan that the person
//! has seen.

use scanhub_drivers::lms::command::Password;
use scanhub_drivers::lms::configuration::{CONFIGURATION_LEN, Configuration, ITEMS, Item};
use scanhub_drivers::lms::identity_probe::Report;
use scanhub_drivers::lms::variant::Baud;

use crate::eeprom::PowerOn;

/// First part of a configuration, in its own storage. It has 34 bytes, or 32 with older firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OwnedConfiguration {
    bytes: [u8; CONFIGURATION_LEN],
    len: usize,
}

impl OwnedConfiguration {
    /// Copies `bytes`. Returns `None` if they are not a configuration.
    pub fn new(bytes: &[u8]) -> Option<OwnedConfiguration> {
        Configuration::new(bytes)?;
        let mut configuration = OwnedConfiguration { bytes: [0; CONFIGURATION_LEN], len: bytes.len() };
        configuration.bytes.get_mut(..bytes.len())?.copy_from_slice(bytes);
        Some(configuration)
    }

    /// Returns the bytes as the scanner stores them.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }

    /// Sets the byte at index `at`. Does nothing if the configuration is shorter.
    pub fn set(&mut self, at: usize, byte: u8) {
        if let Some(slot) = self.bytes[..self.len].get_mut(at) {
            *slot = byte;
        }
    }

    /// Returns the items in which `self` and `other` differ.
    pub fn differences<'a>(&'a self, other: &'a OwnedConfiguration) -> impl Iterator<Item = Item> + 'a {
        let of = |configuration: &'a OwnedConfiguration, item: &Item| {
            configuration.bytes().get(item.at..item.at + item.len)
        };
        ITEMS.into_iter().filter(move |item| of(self, item) != of(other, item))
    }
}

/// Planned change of one scanner's settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plan {
    /// Baud rate at which the scanner communicates.
    pub baud: Baud,
    /// Address of the scanner.
    pub address: u8,
    /// Operating mode in which the scanner was found.
    pub operating_mode: u8,
    /// Present configuration.
    pub old: OwnedConfiguration,
    /// New configuration.
    pub new: OwnedConfiguration,
    /// New setting for the baud rate after power-on. `None` if it does not change.
    pub power_on: Option<PowerOn>,
    /// Password of the installation mode.
    pub password: Password,
}

impl Plan {
    /// Creates a plan without changes for the scanner of `report`. Returns `None` if the report lacks necessary data.
    pub fn from_report(report: &Report) -> Option<Plan> {
        let old = OwnedConfiguration::new(report.configuration()?.bytes())?;
        Some(Plan {
            baud: report.baud?,
            address: report.address?,
            operating_mode: report.status()?.operating_mode(),
            old,
            new: old,
            power_on: None,
            password: Password::FACTORY,
        })
    }

    /// Returns whether the plan changes nothing.
    pub fn is_empty(&self) -> bool {
        self.old == self.new && self.power_on.is_none()
    }
}

/// Consent to a plan, from a person who has seen and confirmed it. Code with a consent can write a scanner's EEPROM.
/// Create a consent only in code that asks a person, and nowhere else.
#[derive(Debug)]
pub struct Consent(Plan);

impl Consent {
    /// Creates the consent of a person who has seen `plan` at a terminal and confirmed it.
    pub fn confirmed_by_person(plan: Plan) -> Consent {
        Consent(plan)
    }

    pub(crate) fn into_plan(self) -> Plan {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_drivers::lms::configuration::factory_configuration;
    use scanhub_drivers::lms::variant::{Mode, Unit};
    use std::vec::Vec;

    #[test]
    fn differences_are_listed_by_item() {
        let old = OwnedConfiguration::new(&factory_configuration(Mode(1), Unit::Mm)).unwrap();
        let mut new = old;
        assert_eq!(old.differences(&new).count(), 0);
        new.set(5, 4);
        new.set(1, 1);
        new.set(CONFIGURATION_LEN, 9);
        let names: Vec<_> = old.differences(&new).map(|item| item.name).collect();
        assert_eq!(names, ["blanking", "measuring mode"]);
        assert_eq!(new.bytes().len(), CONFIGURATION_LEN);
        assert_eq!(
            OwnedConfiguration::new(&old.bytes()[..32]).map(|configuration| configuration.bytes().len()),
            Some(32)
        );
        assert_eq!(OwnedConfiguration::new(&[0; 35]), None);
        assert_eq!(OwnedConfiguration::new(&[0; 31]), None);
    }
}
