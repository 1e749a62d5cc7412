//! When nothing goes wrong any more, everything comes back soon: each link says that it streams, and publishes scans.

use lms::{MILLIS, Nanos};
use schema::{State, Status, Topic};

use super::{Judge, Say};
use crate::event::Event;

/// Since when nothing goes wrong, and what has come back.
pub(crate) struct Liveness {
    healed: Option<Nanos>,
    sensors: Vec<OfSensor>,
}

#[derive(Clone, Copy, Default)]
struct OfSensor {
    says_so: bool,
    came: bool,
}

impl Liveness {
    pub(crate) fn new(sensors: usize) -> Liveness {
        Liveness { healed: None, sensors: vec![OfSensor::default(); sensors] }
    }
}

impl Judge for Liveness {
    fn name(&self) -> &'static str {
        "liveness"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Healed => {
                self.healed = Some(at);
                self.sensors.iter_mut().for_each(|of| of.came = false);
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Status => {
                let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                self.sensors[sensor].says_so = status.state() == Some(State::Streaming);
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Scan => {
                let of = &mut self.sensors[sensor];
                let is_back = of.says_so && !of.came;
                of.came |= of.says_so;
                if let Some(healed) = self.healed
                    && is_back
                    && at > healed + SOON
                {
                    say.broken(format!("sensor {sensor} streams {} ms later", (at - healed) / MILLIS));
                }
            }
            Event::Over { .. } => {
                let sensors = self.sensors.iter().enumerate();
                for (sensor, _) in sensors.filter(|(_, of)| !(of.says_so && of.came)) {
                    say.broken(format!("sensor {sensor} does not stream at the end"));
                }
            }
            _ => {}
        }
    }
}

/// So soon.
const SOON: Nanos = 3_000 * MILLIS;
