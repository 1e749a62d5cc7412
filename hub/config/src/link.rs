//! The links of a hub, each with its port and the settings of its sensor: values in effect. Refuses to know where they
//! were set.

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
    /// The source of its bytes.
    pub port: Source,
    /// The expected type of the sensor, if it is set: settings that the type does not support are refused.
    pub family: Option<Family>,
    /// Angle and resolution.
    pub variant: Variant,
    /// The expected unit of the sensor, if it is set; it is compared, never written.
    pub unit: Option<Unit>,
    /// Measuring mode of a recording that does not contain it; a sensor is asked.
    pub mode: Option<Mode>,
    /// Rate to stream at.
    pub baud: Baud,
    /// How its scans are processed.
    pub processing: Processing,
}

/// Links of one hub.
pub(crate) const MAX_LINKS: usize = 256;
