//! Invariants on headers: sequence numbers, stamps and periods.

use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use scanhub_schema::datagram::Head;
use scanhub_schema::{Flags, Header, MILLIS, Nanos, Topic};

use super::{Invariant, ViolationReporter};
use crate::event::{DatagramOutcome, Event};
use crate::family::Family;
use crate::remote::LinkSettings;
use crate::topics::Sample;

/// Invariant: headers are consistent. Sequence numbers increase. Stamps are never in the future and never decrease. A
/// sample that is derived from a telegram has the `seq`, the stamps and the quality of that telegram.
pub(crate) struct HeaderConsistency {
    /// For each sensor, the topic from which all samples with a hub time are derived.
    sources: Vec<Topic>,
    last: BTreeMap<(usize, Topic), Header>,
}

impl HeaderConsistency {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> HeaderConsistency {
        // A revolution consists of several packets, so results have the header of the revolution's scan.
        let source =
            |family: &Rc<dyn Family>| if family.is_rotating() { Topic::Scan } else { Topic::Telegram };
        HeaderConsistency { sources: sensors.iter().map(source).collect(), last: BTreeMap::new() }
    }
}

impl Invariant for HeaderConsistency {
    fn name(&self) -> &'static str {
        "numbers"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        if let Event::HubStarted { .. } = event {
            // The first results of a hub may come from a scan that could not be published for lack of memory.
            return self.last.clear();
        }
        let Event::Published { sensor, sample } = *event else { return };
        let Sample { topic, header, .. } = sample;
        let before = self.last.insert((sensor, *topic), *header);
        let mut broken = |description: &str| {
            reporter.report(format!("sensor {sensor}, {topic:?}: {description}: {header:?}"))
        };
        if header.stamp_first_ns > header.stamp_last_ns || header.stamp_last_ns > at {
            broken("a stamp in the future");
        }
        if usize::from(header.sensor) != sensor {
            broken("the index of another sensor");
        }
        if let Some(before) = before.filter(|before| before.boot == header.boot) {
            if header.topic_seq <= before.topic_seq || header.seq < before.seq {
                broken("a sequence number that does not increase");
            }
            if *topic == Topic::Telegram && header.stamp_last_ns < before.stamp_last_ns {
                broken("a stamp that decreases");
            }
        }
        // A sample that is not derived from a telegram has no hub time.
        let source = self.sources[sensor];
        if *topic != Topic::Telegram && *topic != source && header.hub_time_ns().is_some() {
            let of = |header: &Header| {
                let Header { seq, boot, stamp_first_ns, stamp_last_ns, wall_ns, reasons, .. } = *header;
                (seq, boot, stamp_first_ns, stamp_last_ns, wall_ns, reasons)
            };
            // If there was no memory for the sample of the source topic, that sample was not published.
            let source = self.last.get(&(sensor, source));
            if source.is_some_and(|source| source.seq >= header.seq && of(source) != of(header)) {
                broken("not the header of the source");
            }
        }
    }
}

/// Invariant: a listener publishes the sequence numbers, stamps and periods that `docs/topics.md` describes. The
/// sequence number comes from the datagram and continues over runs of the gateway. Both stamps are the time of arrival.
/// The period is the median of the last five intervals between the arrivals of consecutive samples. If samples are
/// missing between two arrivals, the time is divided by the difference of the sequence numbers. Once a topic exists,
/// the listener publishes every sample that arrived in time.
pub(crate) struct RemoteHeaders {
    terms: LinkSettings,
    topics: BTreeMap<(usize, Topic), TopicHeaders>,
}

#[derive(Default)]
struct TopicHeaders {
    /// Time of arrival and header of each datagram that arrived in time and is not published yet.
    unpublished: VecDeque<(Nanos, Head)>,
    /// Time of arrival and header of the last published datagram that arrived in time.
    last: Option<(Nanos, Head)>,
    /// Last sequence number of the republished topic.
    number: Option<u64>,
    intervals_ns: VecDeque<Nanos>,
}

impl RemoteHeaders {
    pub(crate) fn new(terms: LinkSettings) -> RemoteHeaders {
        RemoteHeaders { terms, topics: BTreeMap::new() }
    }
}

impl Invariant for RemoteHeaders {
    fn name(&self) -> &'static str {
        "remote_numbers"
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::ListenerStarted { .. } => self.topics.clear(),
            Event::Arrived {
                arrived_at: came,
                datagram: Some(datagram),
                outcome: DatagramOutcome::Sample { late: false },
                ..
            } => {
                let head = datagram.head;
                if let Some(topic) = Topic::of_number(head.topic) {
                    let of = self.topics.entry((head.sensor.into(), topic)).or_default();
                    of.unpublished.push_back((came, head));
                }
            }
            Event::Republished { sensor, topic, header, .. } => {
                let of = self.topics.entry((sensor, topic)).or_default();
                if let Err(words) = of.publish(header, self.terms.initial_clocks.monotonic_ns) {
                    reporter.report(format!("sensor {sensor}, {topic:?}: {words}: {header:?}"));
                }
            }
            _ => {}
        }
    }
}

impl TopicHeaders {
    /// Checks the header of a published sample.
    ///
    /// # Errors
    ///
    /// Returns a description of the error.
    fn publish(&mut self, header: &Header, begin_ns: u64) -> Result<(), String> {
        let before = self.number.replace(header.topic_seq);
        if header.flags & Flags::REMOTE == 0 || header.stamp_first_ns != header.stamp_last_ns {
            return Err("not the header of a remote sample".to_owned());
        }
        let is_it = |(arrived_at, head): &(Nanos, Head)| {
            let Head { counter, stamp_ns, .. } = *head;
            let of = (begin_ns + arrived_at, u64::from(counter), stamp_ns);
            of == (header.stamp_last_ns, header.seq, header.wall_ns)
        };
        let Some(at) = self.unpublished.iter().position(is_it) else {
            // No datagram matches, so the listener published the sample because of a silence.
            let due = before.map_or(0, |before| before + 1);
            return if header.topic_seq == due {
                Ok(())
            } else {
                Err(format!("the silence should have topic_seq {due}"))
            };
        };
        let passed: Vec<_> = self.unpublished.drain(..at).collect();
        let Some((arrived_at, head)) = self.unpublished.pop_front() else { return Ok(()) };
        let last = self.last.replace((arrived_at, head));
        let left_out =
            passed.iter().filter(|(_, passed)| last.is_some_and(|(_, last)| last.epoch == passed.epoch));
        let left_out = left_out.count();
        let steps =
            last.filter(|(_, last)| last.epoch == head.epoch).map(|(_, last)| head.sequence - last.sequence);
        if let (Some(steps), Some((last_came, _))) = (steps.filter(|steps| *steps > 0), last) {
            // If a sample has an earlier time of arrival than the last sample, there is no interval between the two.
            let distance_ns = arrived_at.checked_sub(last_came).map(|apart| apart / u64::from(steps));
            self.intervals_ns.extend(distance_ns.filter(|distance_ns| *distance_ns <= MAX_INTERVAL));
            if self.intervals_ns.len() > PERIOD_INTERVALS {
                self.intervals_ns.pop_front();
            }
        }
        let mut known: Vec<_> = self.intervals_ns.iter().copied().collect();
        known.sort_unstable();
        let period_us = known.get(known.len().saturating_sub(1) / 2).map_or(0, |period_ns| period_ns / 1000);
        // The first sequence number of a run of the listener comes from the datagram. When another run of the gateway
        // starts, its datagrams that did not arrive increase the sequence number, too.
        let due = match (before, steps) {
            (Some(before), Some(steps)) => before + u64::from(steps),
            (Some(before), None) => before + 1 + u64::from(head.sequence),
            (None, _) => head.sequence.into(),
        };
        if header.topic_seq != due {
            Err(format!("topic_seq should be {due}"))
        } else if u64::from(header.period_us) != period_us {
            Err(format!("the period should be {period_us} us"))
        } else if left_out > 0 {
            Err(format!("{left_out} samples that arrived before it are missing"))
        } else {
            Ok(())
        }
    }
}

/// Number of intervals from which the period is calculated, and maximum length of such an interval. Longer intervals
/// are ignored.
const PERIOD_INTERVALS: usize = 5;
const MAX_INTERVAL: Nanos = 2_500 * MILLIS;
