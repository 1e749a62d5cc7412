//! A planned change of the EEPROM settings, and a person's consent to it. A plan is only values. It can be carried out
//! only with consent, which is for one plan as it was shown.

use scanhub_drivers::lms::command::Password;
use scanhub_drivers::lms::configuration::{CONFIGURATION_LEN, Configuration, ITEMS, Item};
use scanhub_drivers::lms::inquiry::Report;
use scanhub_drivers::lms::variant::Baud;

use crate::eeprom::PowerOn;

/// The first part of a configuration with its own storage: 34 bytes, 32 with older firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OwnedConfiguration {
    bytes: [u8; CONFIGURATION_LEN],
    len: usize,
}

impl OwnedConfiguration {
    /// A copy of `bytes`; `None` if they are no configuration.
    pub fn new(bytes: &[u8]) -> Option<OwnedConfiguration> {
        Configuration::new(bytes)?;
        let mut configuration = OwnedConfiguration { bytes: [0; CONFIGURATION_LEN], len: bytes.len() };
        configuration.bytes.get_mut(..bytes.len())?.copy_from_slice(bytes);
        Some(configuration)
    }

    /// The bytes as the sensor keeps them.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }

    /// Sets one byte; beyond its end nothing.
    pub fn set(&mut self, at: usize, byte: u8) {
        if let Some(slot) = self.bytes[..self.len].get_mut(at) {
            *slot = byte;
        }
    }

    /// The items in which `self` and `other` differ.
    pub fn differences<'a>(&'a self, other: &'a OwnedConfiguration) -> impl Iterator<Item = Item> + 'a {
        let of = |configuration: &'a OwnedConfiguration, item: &Item| {
            configuration.bytes().get(item.at..item.at + item.len)
        };
        ITEMS.into_iter().filter(move |item| of(self, item) != of(other, item))
    }
}

/// What is to be changed in one sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plan {
    /// The rate at which the sensor talks.
    pub baud: Baud,
    /// Its own address.
    pub address: u8,
    /// The operating mode in which it was found.
    pub operating_mode: u8,
    /// Its configuration.
    pub old: OwnedConfiguration,
    /// What its configuration shall be.
    pub new: OwnedConfiguration,
    /// What the rate after power-on shall be, if that shall change.
    pub power_on: Option<PowerOn>,
    /// The password of the installation mode.
    pub password: Password,
}

impl Plan {
    /// No change of the sensor that told `report`; `None` if it did not tell all that is needed.
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

    /// Whether there is nothing to do.
    pub fn is_empty(&self) -> bool {
        self.old == self.new && self.power_on.is_none()
    }
}

/// A person saw a plan and confirmed it. Code that has a consent can write a sensor's EEPROM, so it is made where a
/// person is asked, and nowhere else.
#[derive(Debug)]
pub struct Consent(Plan);

impl Consent {
    /// A person at a terminal saw `plan` and confirmed it.
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
