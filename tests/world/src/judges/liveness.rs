//! Judges of recovery: once nothing is wrong any more, everything works again soon.

use std::rc::Rc;

use scanhub_schema::{MILLIS, Nanos, State, Status, Topic, Verdict, Zones};

use super::{Judge, Say};
use crate::event::{Event, Figures};
use crate::family::Family;
use crate::remote::{RECONNECTED, ROUND, Terms};
use crate::setup::Setup;

/// Judge: once nothing is wrong any more, each link soon reports that it streams, and publishes measured values. It publishes
/// scans as soon as the scanner has reported how its values are split; the session repeats that request now and then. The
/// search for a scanner of another family starts after ten seconds without data.
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

/// Judge: once nothing is wrong any more, a remote robot soon knows what the hub knows. The next announcement names the sensor,
/// and then the next zones are sent. The robot knows the verdict from then on, unless the zones are so rare that the first
/// ones, which have no period yet, expire before the second ones arrive (`docs/topics.md`).
pub(crate) struct RemoteLiveness {
    is_healed: bool,
    sensors: Vec<RemoteSensor>,
}

struct RemoteSensor {
    /// From known zones in the hub to known ones here, at most.
    soon: Nanos,
    /// Zones come less often than a verdict stands whose period is not known.
    is_slow: bool,
    /// Time since which the hub has published a known verdict, if it does.
    said_since: Option<Nanos>,
    is_known: bool,
    /// Whether the robot knew the verdict after the world healed.
    came: bool,
}

impl RemoteLiveness {
    pub(crate) fn new(setup: &Setup, terms: &Terms) -> RemoteLiveness {
        let sensor = |of: usize| {
            let (period, _) = setup.sensors[of].times();
            let every = terms.every.get() * period;
            // Time to find a router that returns when the world heals, and to send the queue.
            let over_router = if terms.are_bridges { RECONNECTED + ROUND } else { 0 };
            let soon = ANNOUNCED + every + period + terms.delay_ns + over_router + SLACK;
            RemoteSensor { soon, is_slow: every > OFTEN, said_since: None, is_known: false, came: false }
        };
        RemoteLiveness { is_healed: false, sensors: (0..setup.sensors.len()).map(sensor).collect() }
    }
}

impl Judge for RemoteLiveness {
    fn name(&self) -> &'static str {
        "remote_liveness"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Healed => {
                self.is_healed = true;
                self.sensors.iter_mut().for_each(|of| (of.said_since, of.came) = (None, of.is_known));
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Zones => {
                let zones: Zones = bytemuck::pod_read_unaligned(&sample.bytes);
                let of = &mut self.sensors[sensor];
                match zones.verdict() {
                    Verdict::Unknown => of.said_since = None,
                    _ => _ = of.said_since.get_or_insert(at),
                }
                of.check(sensor, at, self.is_healed, say);
            }
            Event::RemoteBelieves { sensor, verdict } => {
                let of = &mut self.sensors[sensor];
                of.check(sensor, at, self.is_healed, say);
                of.is_known = verdict != Verdict::Unknown;
                of.came |= of.is_known;
            }
            Event::Over { .. } => {
                for (sensor, of) in self.sensors.iter().enumerate() {
                    of.check(sensor, at, self.is_healed, say);
                }
            }
            Event::ListenerEnds { sensors, .. } if self.is_healed && sensors != self.sensors.len() => {
                say.broken(format!("{sensors} sensors are published at the end"));
            }
            _ => {}
        }
    }
}

impl RemoteSensor {
    fn check(&self, sensor: usize, at: Nanos, is_healed: bool, say: &mut Say<'_>) {
        if is_healed
            && !(self.is_known || self.is_slow && self.came)
            && let Some(since) = self.said_since.filter(|since| at > since + self.soon)
        {
            let (ms, soon) = ((at - since) / MILLIS, self.soon / MILLIS);
            say.broken(format!("sensor {sensor}: nothing is known {ms} ms later, bound {soon}"));
        }
    }
}

/// Interval of zones up to which their verdict is always known.
const OFTEN: Nanos = 230 * MILLIS;
/// Between two announcements.
const ANNOUNCED: Nanos = 1_000 * MILLIS;
/// Threads and timers are late by no more than this, all together.
const SLACK: Nanos = 3 * MILLIS;
