//! A warning before its scan is complete says slow or stop, never clear, and it is true of the scan or taken back: before the
//! next zones of its number or a greater one, which are of its scan, unless these are at least as bad.

use std::collections::BTreeMap;

use bytemuck::pod_read_unaligned;
use lms::Nanos;
use schema::{Topic, Verdict, Zones};

use super::{Judge, Say};
use crate::event::Event;

/// What was said of the scans that are arriving, by sensors.
#[derive(Default)]
pub(crate) struct Early {
    sensors: BTreeMap<usize, OfSensor>,
}

/// A warning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Said {
    seq: u64,
    verdict: Verdict,
    /// Its scan has exactly its number, and no greater one.
    is_of_telegram: bool,
}

#[derive(Default)]
struct OfSensor {
    /// The warning that stands.
    stands: Option<Said>,
    /// The number of the last zones.
    zones: Option<u64>,
    /// A sample had no memory, so that nobody knows what stands.
    is_unknown: bool,
}

impl Judge for Early {
    fn name(&self) -> &'static str {
        "early"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Published { sensor, sample } => {
                let of = self.sensors.entry(sensor).or_default();
                let seq = sample.header.seq;
                let wrong = match sample.topic {
                    Topic::Early => of.warn(seq, &pod_read_unaligned(&sample.bytes)),
                    Topic::Zones => of.tell(seq, pod_read_unaligned::<Zones>(&sample.bytes).verdict()),
                    _ => None,
                };
                if let Some(wrong) = wrong {
                    say.broken(format!("sensor {sensor}, number {seq}: {wrong}"));
                }
            }
            Event::Lacking { sensor, topic: Topic::Early | Topic::Zones } => {
                let of = self.sensors.entry(sensor).or_default();
                (of.stands, of.is_unknown) = (None, true);
            }
            Event::HubEnds { .. } => self.sensors.clear(),
            _ => {}
        }
    }
}

impl OfSensor {
    /// What is wrong with a warning, or with what takes it back.
    fn warn(&mut self, seq: u64, early: &schema::Early) -> Option<String> {
        let verdict = early.verdict();
        if !matches!(verdict, Verdict::Slow | Verdict::Stop) {
            return Some(format!("a warning says {}", verdict.name()));
        }
        if self.zones.is_some_and(|zones| seq <= zones) {
            return Some("a warning of a scan whose zones were there".to_owned());
        }
        let said = Said { seq, verdict, is_of_telegram: early.bytes_seen > 0 };
        let before = self.stands.take();
        if early.is_withdrawn() {
            let is_of = before.is_some_and(|before| (before.seq, before.verdict) == (seq, verdict));
            let is_of = is_of || std::mem::take(&mut self.is_unknown);
            return (!is_of).then(|| format!("{before:?} stood, something else was taken back"));
        }
        self.stands = Some(said);
        self.is_unknown = false;
        let is_worse = |before: &Said| before.seq == seq && before.verdict.worse(verdict) != before.verdict;
        before
            .filter(|before| !is_worse(before))
            .map(|before| format!("{before:?} stood, and {said:?} is no worse"))
    }

    /// What is wrong with the warning that stands, now that the zones say `verdict`.
    fn tell(&mut self, seq: u64, verdict: Verdict) -> Option<String> {
        self.zones = Some(seq);
        let said = self.stands.take_if(|said| seq >= said.seq)?;
        let holds = verdict.worse(said.verdict) == verdict && (seq == said.seq || !said.is_of_telegram);
        (!holds).then(|| format!("{said:?}, the zones say {}", verdict.name()))
    }
}
