//! The links of a hub, each with its port and what to ask of its sensor: values in effect. Refuses to know where they were
//! written.

use lms::family::Family;
use lms::variant::{Baud, Mode, Unit, Variant};
use port::Source;

use crate::processing::Processing;

/// The effective configuration.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// The links in their order: a sensor's number is its place here.
    pub links: Vec<Link>,
}

/// One link and what to ask of its sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// The sensor's name in topics.
    pub name: String,
    /// Where its bytes come from.
    pub port: Source,
    /// What the sensor is expected to be, if the user said it: nothing is asked for that it cannot do.
    pub family: Option<Family>,
    /// Angle and resolution.
    pub variant: Variant,
    /// Unit that the sensor is expected to measure in, if the user said one; it is compared, never written.
    pub unit: Option<Unit>,
    /// Measuring mode of a recording that does not tell it; a sensor is asked.
    pub mode: Option<Mode>,
    /// Rate to stream at.
    pub baud: Baud,
    /// What is made of its scans.
    pub processing: Processing,
}

/// Links of one hub.
pub(crate) const MAX_LINKS: usize = 256;
