//! What headers say fits together: numbers grow, stamps are neither of the future nor go back, and what was made of a telegram
//! has its number, its stamps and its quality.

use std::collections::BTreeMap;
use std::rc::Rc;

use scanhub_schema::{Header, Nanos, Topic};

use super::{Judge, Say};
use crate::event::Event;
use crate::family::Family;
use crate::topics::Sample;

/// The last headers.
pub(crate) struct Numbers {
    /// Of which sample of a sensor all others are made that say when they were sent.
    sources: Vec<Topic>,
    last: BTreeMap<(usize, Topic), Header>,
}

impl Numbers {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> Numbers {
        // A turn is of many telegrams: what is made of it is of its scan.
        let source = |family: &Rc<dyn Family>| if family.turns() { Topic::Scan } else { Topic::Telegram };
        Numbers { sources: sensors.iter().map(source).collect(), last: BTreeMap::new() }
    }
}

impl Judge for Numbers {
    fn name(&self) -> &'static str {
        "numbers"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        if let Event::HubBegins { .. } = event {
            // What it publishes first may be made of what it has no memory to publish.
            return self.last.clear();
        }
        let Event::Published { sensor, sample } = *event else { return };
        let Sample { topic, header, .. } = sample;
        let before = self.last.insert((sensor, *topic), *header);
        let mut broken = |what: &str| say.broken(format!("sensor {sensor}, {topic:?}: {what}: {header:?}"));
        if header.stamp_first_ns > header.stamp_last_ns || header.stamp_last_ns > at {
            broken("a stamp of the future");
        }
        if usize::from(header.sensor) != sensor {
            broken("the number of another sensor");
        }
        if let Some(before) = before.filter(|before| before.boot == header.boot) {
            if header.topic_seq <= before.topic_seq || header.seq < before.seq {
                broken("a number that does not grow");
            }
            if *topic == Topic::Telegram && header.stamp_last_ns < before.stamp_last_ns {
                broken("a stamp that goes back");
            }
        }
        // What has no telegram does not say when it was sent.
        let source = self.sources[sensor];
        if *topic != Topic::Telegram && *topic != source && header.hub_time_ns().is_some() {
            let of = |header: &Header| {
                let Header { seq, boot, stamp_first_ns, stamp_last_ns, wall_ns, reasons, .. } = *header;
                (seq, boot, stamp_first_ns, stamp_last_ns, wall_ns, reasons)
            };
            // One without memory was not published.
            let source = self.last.get(&(sensor, source));
            if source.is_some_and(|source| source.seq >= header.seq && of(source) != of(header)) {
                broken("not that of what it was made of");
            }
        }
    }
}
