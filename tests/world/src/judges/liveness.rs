//! When nothing goes wrong any more, everything comes back soon: each link says that it streams, and publishes measured
//! values; and scans, as soon as the sensor has told how its values are split. One that did not tell is asked again now
//! and then. The search for a scanner of another family begins after ten seconds without data.

use std::rc::Rc;

use scanhub_schema::{MILLIS, Nanos, State, Status, Topic};

use super::{Judge, Say};
use crate::event::{Event, Figures};
use crate::family::Family;

/// Since when nothing goes wrong, and what has come back.
pub(crate) struct Liveness {
    healed: Option<Nanos>,
    sensors: Vec<OfSensor>,
}

struct OfSensor {
    family: Rc<dyn Family>,
    says_so: bool,
    /// Time at which the search for a scanner of another family begins.
    searched_at: Nanos,
    /// Telegrams of measured values came, and scans.
    came: [bool; 2],
    /// When the first one of each came, without the time that the scanner waited for its motor.
    first: [Option<Nanos>; 2],
    /// When it answered last before that, and when it measured first after that answer.
    answered_at: Nanos,
    measured_at: Option<Nanos>,
}

impl Liveness {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> Liveness {
        let sensor = |family: &Rc<dyn Family>| OfSensor {
            family: family.clone(),
            says_so: false,
            searched_at: 0,
            came: [false; 2],
            first: [None; 2],
            answered_at: 0,
            measured_at: None,
        };
        Liveness { healed: None, sensors: sensors.iter().map(sensor).collect() }
    }
}

impl Judge for Liveness {
    fn name(&self) -> &'static str {
        "liveness"
    }

    fn figures(&self) -> Figures {
        let last = |which: usize| self.sensors.iter().filter_map(|of| of.first[which]).max().unwrap_or(0);
        Figures { data_ns: last(0), scan_ns: last(1), ..Figures::default() }
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Healed => {
                self.healed = Some(at);
                self.sensors.iter_mut().for_each(|of| of.came = [false; 2]);
            }
            Event::Exchanged { sensor } if self.sensors[sensor].family.families().len() > 1 => {
                self.sensors[sensor].searched_at = at + LOST_AFTER;
            }
            Event::Sent { sensor, telegram }
                if telegram.is_reply && self.sensors[sensor].first[0].is_none() =>
            {
                let of = &mut self.sensors[sensor];
                (of.answered_at, of.measured_at) = (at, None);
            }
            Event::Measured { sensor, points } => {
                let of = &mut self.sensors[sensor];
                of.measured_at = of.measured_at.or(points.first().map(|first| first.at_ns));
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Status => {
                let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                self.sensors[sensor].says_so = status.state() == Some(State::Streaming);
            }
            Event::Published { sensor, sample } => {
                let of = &mut self.sensors[sensor];
                let is_data =
                    || of.family.units(&sample.bytes).into_iter().any(|unit| of.family.is_data(unit));
                let which = match sample.topic {
                    Topic::Telegram if is_data() => 0,
                    Topic::Scan => 1,
                    _ => return,
                };
                if of.first[which].is_none() {
                    let waited = of.measured_at.unwrap_or(0).saturating_sub(of.answered_at);
                    of.first[which] = Some(at.saturating_sub(waited));
                }
                let is_back = of.says_so && !of.came[which];
                of.came[which] |= of.says_so;
                if let Some(healed) = self.healed.map(|healed| healed.max(of.searched_at))
                    && is_back
                    && at > healed + SOON[which]
                {
                    let (topic, after) = (sample.topic, (at - healed) / MILLIS);
                    say.broken(format!("sensor {sensor}: {topic:?} {after} ms later"));
                }
            }
            Event::Over { .. } => {
                let sensors = self.sensors.iter().enumerate();
                let is_due = |of: &OfSensor| of.searched_at == 0 || at > of.searched_at + SOON[1];
                let is_back = |of: &OfSensor| of.says_so && of.came == [true; 2];
                for (sensor, _) in sensors.filter(|(_, of)| is_due(of) && !is_back(of)) {
                    say.broken(format!("sensor {sensor} does not stream at the end"));
                }
            }
            _ => {}
        }
    }
}

/// So soon: after a second of silence a sensor is sought that may be at another rate, for some 2.4 s
/// (`docs/measured.md`); one whose last word was damaged, just before everything was well, is asked again for up to 3 s
/// first. One that streams and does not tell how is asked every ten seconds.
const SOON: [Nanos; 2] = [5_500 * MILLIS, 11_000 * MILLIS];
/// Time after which the search begins again because nothing of the scanner arrives.
const LOST_AFTER: Nanos = 10_000 * MILLIS;
