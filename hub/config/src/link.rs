//! The links of a hub, each with its port and the settings of its sensor: values in effect. Refuses to know where they
//! were set.

use port::Source;
use scanhub_drivers::lms::family::Family;
use scanhub_drivers::lms::variant::{Baud, MAX_BEAMS, Mode, Unit, Variant};
use schema::limits::TopicLimits;
use schema::{Background, Contents};

use crate::processing::Processing;
use crate::scanner::Scanner;

/// The effective configuration.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// The links in their order: a sensor's number is its place here.
    pub links: Vec<Link>,
    /// What the topics of a link are made for, but for what its scanner needs.
    pub limits: TopicLimits,
}

impl Config {
    /// Returns what the topics of each link are made for.
    pub fn topic_limits(&self) -> Vec<TopicLimits> {
        self.links.iter().map(|link| link.limits(&self.limits)).collect()
    }
}

/// One link and what to ask of its sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// The sensor's name in topics.
    pub name: String,
    /// The source of its bytes.
    pub port: Source,
    /// Of which family its scanner is.
    pub scanner: Scanner,
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
    /// Whether the rate is set. Otherwise, the hub may use a lower one on a line that cannot carry it.
    pub is_baud_set: bool,
    /// How its scans are processed.
    pub processing: Processing,
}

impl Link {
    /// Returns the rate at which its port is opened, in bits per second.
    pub fn rate(&self) -> u32 {
        match self.scanner {
            Scanner::Lms => self.baud.rate(),
            Scanner::Turning(turning) => turning.model.baud,
        }
    }

    /// Returns the highest rate of what may be behind its port, which a serial server has whatever is configured here.
    pub fn most_rate(&self) -> u32 {
        match self.scanner {
            Scanner::Turning(turning) if !matches!(self.port, Source::Tty(_)) => turning.most_rate(),
            _ => self.rate(),
        }
    }

    /// Returns the most beams of a scan of its sensor.
    pub fn beams(&self) -> usize {
        match self.scanner {
            Scanner::Lms => MAX_BEAMS,
            Scanner::Turning(turning) => turning.most_beams(),
        }
    }

    /// Returns what its topics are made for, where those of all links are made as `all` says.
    pub fn limits(&self, all: &TopicLimits) -> TopicLimits {
        match self.scanner {
            Scanner::Lms => *all,
            Scanner::Turning(_) => TopicLimits { beams: self.beams(), contents: Contents::TURNING, ..*all },
        }
    }

    /// Returns the family of its scanner.
    pub fn family(&self) -> schema::Family {
        match self.scanner {
            Scanner::Lms => schema::Family::Lms,
            Scanner::Turning(turning) => turning.family,
        }
    }

    /// Whether `model` may be of its sensor, as far as that is known.
    ///
    /// # Errors
    ///
    /// The beams and the unit that such a model has, in words.
    pub fn fits(&self, model: &Background) -> Result<(), String> {
        let (fits, beams, unit_mm) = match self.scanner {
            Scanner::Lms => {
                let (beams, unit) = (self.variant.beams(), self.unit.map(|unit| u32::from(unit.mm())));
                let unit_mm = unit.unwrap_or(model.unit_um / 1000);
                (usize::from(model.count) == beams, beams.to_string(), unit_mm)
            }
            Scanner::Turning(turning) if turning.is_auto() => {
                (usize::from(model.count) <= self.beams(), format!("at most {}", self.beams()), 1)
            }
            Scanner::Turning(_) => (usize::from(model.count) == self.beams(), self.beams().to_string(), 1),
        };
        if fits && model.unit_um == 1000 * unit_mm {
            return Ok(());
        }
        Err(format!("{beams} beams in units of {unit_mm} mm"))
    }
}

/// Links of one hub.
pub(crate) const MAX_LINKS: usize = 256;
