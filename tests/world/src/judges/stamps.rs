//! Judges of time: stamps of telegrams, and the delay until a subscriber wakes.

use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use scanhub_schema::{Flags, Header, MILLIS, Nanos, Ring, Topic, line_time};

use super::{Judge, Say};
use crate::consumer::Number;
use crate::event::{Event, Telegram};
use crate::family::Family;
use crate::topics::Sample;

/// Judge: the stamps of a scan's telegram are right, or the hub marks them as estimates. Without the mark, they are the times at
/// which the first and last bytes of the telegram went into the port, even if the hub was held up. While nothing is wrong, no
/// stamp of a streaming scanner is an estimate. Only families whose samples are single telegrams; `turns` checks the others.
pub(crate) struct Stamps {
    families: Vec<Rc<dyn Family>>,
    sensors: BTreeMap<usize, OfSensor>,
    healed_at: Option<Nanos>,
    /// Until this time, bytes may arrive that took no time on the line. Telegrams that are read with them look earlier than
    /// they were.
    crowded_until: Nanos,
}

#[derive(Default)]
struct OfSensor {
    sent: VecDeque<Sent>,
    /// Place after the last byte that the hub has read.
    read: u64,
    /// Scans that were published since the line was opened or retuned, and since the last reply.
    in_a_row: usize,
}

struct Sent {
    bytes: Vec<u8>,
    end: u64,
    first_at: Nanos,
    last_at: Nanos,
    rate: u32,
}

impl Stamps {
    pub(crate) fn new(families: &[Rc<dyn Family>]) -> Stamps {
        Stamps { families: families.to_vec(), sensors: BTreeMap::new(), healed_at: None, crowded_until: 0 }
    }
}

impl Judge for Stamps {
    fn name(&self) -> &'static str {
        "stamps"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Sent { sensor, telegram } if !self.families[sensor].turns() => {
                self.sensors.entry(sensor).or_default().send(at, telegram);
            }
            Event::Read { sensor, to, .. } => self.sensors.entry(sensor).or_default().read = to,
            Event::Opened { sensor, .. } | Event::Retuned { sensor } | Event::Exchanged { sensor } => {
                self.sensors.entry(sensor).or_default().in_a_row = 0;
            }
            Event::HubBegins { .. } => self.sensors.values_mut().for_each(|of| of.in_a_row = 0),
            Event::Healed => self.healed_at = Some(at),
            Event::Acted { text } if text.contains("garbage") => {
                let span_ms =
                    text.split_once("span_ms=").and_then(|(_, span)| span.trim().parse::<u64>().ok());
                let until = at + span_ms.unwrap_or(0) * MILLIS + RECOVERED;
                self.crowded_until = self.crowded_until.max(until);
            }
            Event::Published { sensor, sample: Sample { topic: Topic::Telegram, header, bytes, .. } }
                if !self.families[sensor].turns() =>
            {
                let of = self.sensors.entry(sensor).or_default();
                if !self.families[sensor].is_data(bytes) {
                    of.in_a_row = 0;
                    return;
                }
                of.in_a_row += 1;
                let is_well = self.healed_at.is_some_and(|healed_at| at > healed_at + RECOVERED);
                let wrong = of.publish(header, bytes, is_well);
                if let Some(wrong) = wrong.filter(|_| at > self.crowded_until) {
                    say.broken(format!("sensor {sensor}, telegram {}: {wrong}", header.seq));
                }
            }
            _ => {}
        }
    }
}

impl OfSensor {
    fn send(&mut self, at: Nanos, telegram: &Telegram<'_>) {
        let Telegram { bytes, span: (_, end), first_at, rate, .. } = *telegram;
        self.sent.push_back(Sent { bytes: bytes.to_vec(), end, first_at, last_at: at, rate });
        if self.sent.len() > MOST {
            self.sent.pop_front();
        }
    }

    /// Returns what is wrong with the stamps of a scan's telegram that is published, while nothing goes wrong if all `is_well`.
    fn publish(&mut self, header: &Header, bytes: &[u8], is_well: bool) -> Option<String> {
        if header.flags & Flags::STAMP_ESTIMATED != 0 {
            let is_new = self.in_a_row <= SETTLED;
            return (is_well && !is_new)
                .then(|| "a stamp is an estimate although nothing went wrong".to_owned());
        }
        // It is marked as suspect: it follows damaged bytes, or took longer than usual.
        if header.reasons != 0 {
            return None;
        }
        // Scans of a simulated scene repeat, so every telegram that has been read is compared.
        let is_it = |sent: &&Sent| sent.end <= self.read && sent.bytes == bytes;
        let is_right = |sent: &Sent| {
            let most = EXACT + line_time(PIECE, sent.rate);
            header.stamp_first_ns.abs_diff(sent.first_at) <= most
                && header.stamp_last_ns.abs_diff(sent.last_at) <= most + SLOW
        };
        let off = |sent: &Sent| {
            let stamps = [(header.stamp_first_ns, sent.first_at), (header.stamp_last_ns, sent.last_at)];
            stamps.map(|(stamp, sent)| (stamp as i64 - sent as i64) / 1_000)
        };
        let offs: Vec<&Sent> = self.sent.iter().filter(is_it).collect();
        let nearest = offs.iter().min_by_key(|sent| off(sent).map(i64::abs))?;
        let is_wrong = !offs.iter().any(|sent| is_right(sent));
        is_wrong.then(|| format!("stamps are off by {:?} us and not marked", off(nearest)))
    }
}

/// Maximum error of a stamp that is not marked, in addition to the time of the bytes that a port passes on at once.
const EXACT: Nanos = 5 * MILLIS;
/// Time by which a telegram may take longer than usual before it is marked as suspect.
const SLOW: Nanos = 8 * MILLIS;
/// Bytes that a USB adapter passes on at once, and after which a stamp is an estimate.
const PIECE: usize = 64;
/// Time after the last fault from which nothing is due to it any more.
const RECOVERED: Nanos = 3_000 * MILLIS;
/// Scans of a stream after which the session knows its rhythm.
const SETTLED: usize = 8;
/// Telegrams that are remembered: more than a port holds.
const MOST: usize = 256;

/// Judge: the hub wakes a sleeping subscriber. A prompt subscriber has each sample of a telegram a moment after the telegram was
/// sent, and a subscriber to zones need not wait for the marks of the same scan.
#[derive(Default)]
pub(crate) struct Prompt {
    /// Times at which prompt subscribers attached.
    came: BTreeMap<Number, Nanos>,
    /// Topics of the subscribers.
    followed: BTreeMap<Number, (usize, Topic)>,
    /// For each sensor, the number of the telegram whose samples have subscribers that are not woken yet.
    asleep: BTreeMap<usize, u64>,
}

impl Judge for Prompt {
    fn name(&self) -> &'static str {
        "prompt"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Attached { consumer, sensor, topic, is_prompt, .. } => {
                self.followed.insert(consumer, (sensor, topic));
                if is_prompt {
                    self.came.insert(consumer, at);
                }
            }
            Event::Left { consumer, .. } => {
                self.followed.remove(&consumer);
            }
            Event::Published { sensor, sample } if sample.header.hub_time_ns().is_some() => {
                let (topic, seq) = (sample.topic, sample.header.seq);
                if topic.row().ring == Ring::Last && self.asleep.get(&sensor) == Some(&seq) {
                    say.broken(format!("{topic:?} of {seq} were made while those who wait for zones slept"));
                }
                let is_wanted = self.followed.values().any(|followed| *followed == (sensor, topic));
                if matches!(topic, Topic::Scan | Topic::Zones) && is_wanted {
                    self.asleep.insert(sensor, seq);
                }
            }
            Event::Rung { sensor, ring: Ring::First } => {
                self.asleep.remove(&sensor);
            }
            Event::HubEnds { .. } => self.asleep.clear(),
            Event::Taken { consumer, sample, .. } => {
                let came = self.came.get(&consumer);
                let is_of_telegram = sample.header.hub_time_ns().is_some();
                let late = at.saturating_sub(sample.at);
                if is_of_telegram && late > LATEST && came.is_some_and(|&came| sample.at > came) {
                    let us = late / 1_000;
                    say.broken(format!("consumer {} got {:?} after {us} us", consumer.0, sample.topic));
                }
            }
            _ => {}
        }
    }
}

/// Maximum delay on a machine with idle processors.
const LATEST: Nanos = 2 * MILLIS;
