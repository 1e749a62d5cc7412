//! A port that another process sets to another rate has the hub's again soon: the hub does not read for a second what arrives
//! at the wrong rate.

use scanhub_schema::{MILLIS, Nanos, Topic};

use super::{Judge, Say};
use crate::event::Event;

/// The ports that another process has set to another rate.
pub(crate) struct Settings {
    sensors: Vec<OfSensor>,
}

#[derive(Clone, Copy, Default)]
struct OfSensor {
    is_altered: bool,
    /// Time of the first read since the alteration, or since the last telegram.
    reads_since: Option<Nanos>,
    /// The last read was too long after it.
    is_overdue: bool,
}

impl Settings {
    pub(crate) fn new(sensors: usize) -> Settings {
        Settings { sensors: vec![OfSensor::default(); sensors] }
    }
}

impl Judge for Settings {
    fn name(&self) -> &'static str {
        "settings"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Altered { sensor } => {
                self.sensors[sensor] = OfSensor { is_altered: true, ..OfSensor::default() };
            }
            Event::Retuned { sensor } | Event::Opened { sensor, .. } | Event::Closed { sensor } => {
                self.sensors[sensor] = OfSensor::default();
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Telegram => {
                let of = &mut self.sensors[sensor];
                (of.reads_since, of.is_overdue) = (None, false);
            }
            Event::Read { sensor, .. } if self.sensors[sensor].is_altered => {
                let of = &mut self.sensors[sensor];
                if of.is_overdue {
                    say.broken(format!("sensor {sensor}: the rate of another process stays"));
                    of.is_altered = false;
                }
                // The hub acts after the read, not before it.
                of.is_overdue = at > *of.reads_since.get_or_insert(at) + LIMIT;
            }
            _ => {}
        }
    }
}

/// Time for which bytes may arrive at the wrong rate.
const LIMIT: Nanos = 1_000 * MILLIS;
