//! Invariants on time: stamps of telegrams, and the delay until a subscriber wakes.

use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use scanhub_schema::{DoorbellWord, Flags, Header, MILLIS, Nanos, Topic, line_time};

use super::{Invariant, ViolationReporter};
use crate::event::{Event, Telegram};
use crate::family::Family;
use crate::subscriber::SubscriberId;
use crate::topics::Sample;

/// Invariant: the stamps of a scan's telegram are right, or the hub marks them as estimates. Without the mark, the
/// stamps are the times at which the first and last bytes of the telegram arrived at the port, even if the hub was
/// stalled. While nothing is wrong, no stamp of a streaming scanner is an estimate. This invariant applies to families
/// in which each sample is one telegram; the invariant `turns` checks the other families.
pub(crate) struct Stamps {
    families: Vec<Rc<dyn Family>>,
    sensors: BTreeMap<usize, SensorStamps>,
    faults_cleared_at: Option<Nanos>,
    /// Time until which bytes may arrive all at once, without time on the line. A telegram that is read together with
    /// such bytes seems to arrive too early.
    crowded_until: Nanos,
}

#[derive(Default)]
struct SensorStamps {
    sent: VecDeque<SentTelegram>,
    /// Position after the last byte that the hub has read.
    read_end: u64,
    /// Number of scans that were published since the last of three events: the line was opened, its rate changed, or a
    /// reply arrived.
    consecutive_scans: usize,
}

struct SentTelegram {
    bytes: Vec<u8>,
    end: u64,
    first_at: Nanos,
    last_at: Nanos,
    rate: u32,
}

impl Stamps {
    pub(crate) fn new(families: &[Rc<dyn Family>]) -> Stamps {
        Stamps {
            families: families.to_vec(),
            sensors: BTreeMap::new(),
            faults_cleared_at: None,
            crowded_until: 0,
        }
    }
}

impl Invariant for Stamps {
    fn name(&self) -> &'static str {
        "stamps"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Sent { sensor, telegram } if !self.families[sensor].is_rotating() => {
                self.sensors.entry(sensor).or_default().send(at, telegram);
            }
            Event::Read { sensor, to, .. } => self.sensors.entry(sensor).or_default().read_end = to,
            Event::PortOpened { sensor, .. }
            | Event::RateChanged { sensor }
            | Event::ScannerExchanged { sensor } => {
                self.sensors.entry(sensor).or_default().consecutive_scans = 0;
            }
            Event::HubStarted { .. } => self.sensors.values_mut().for_each(|of| of.consecutive_scans = 0),
            Event::FaultsCleared => self.faults_cleared_at = Some(at),
            Event::ActionTaken { text } if text.contains("garbage") => {
                let span_ms =
                    text.split_once("span_ms=").and_then(|(_, span)| span.trim().parse::<u64>().ok());
                let until = at + span_ms.unwrap_or(0) * MILLIS + RECOVERY_TIME;
                self.crowded_until = self.crowded_until.max(until);
            }
            Event::Published { sensor, sample: Sample { topic: Topic::Telegram, header, bytes, .. } }
                if !self.families[sensor].is_rotating() =>
            {
                let of = self.sensors.entry(sensor).or_default();
                if !self.families[sensor].is_data(bytes) {
                    of.consecutive_scans = 0;
                    return;
                }
                of.consecutive_scans += 1;
                let is_well = self.faults_cleared_at.is_some_and(|healed_at| at > healed_at + RECOVERY_TIME);
                let wrong = of.publish(header, bytes, is_well);
                if let Some(wrong) = wrong.filter(|_| at > self.crowded_until) {
                    reporter.report(format!("sensor {sensor}, telegram {}: {wrong}", header.seq));
                }
            }
            _ => {}
        }
    }
}

impl SensorStamps {
    fn send(&mut self, at: Nanos, telegram: &Telegram<'_>) {
        let Telegram { bytes, span: (_, end), first_at, rate, .. } = *telegram;
        self.sent.push_back(SentTelegram { bytes: bytes.to_vec(), end, first_at, last_at: at, rate });
        if self.sent.len() > MAX_TELEGRAMS {
            self.sent.pop_front();
        }
    }

    /// Returns a description of the error in the stamps of a scan's telegram, or `None` if there is no error. If
    /// `is_faultless`, nothing is wrong in the world.
    fn publish(&mut self, header: &Header, bytes: &[u8], is_faultless: bool) -> Option<String> {
        if header.flags & Flags::STAMP_ESTIMATED != 0 {
            let is_new = self.consecutive_scans <= LEARNING_SCANS;
            return (is_faultless && !is_new)
                .then(|| "a stamp is an estimate although nothing went wrong".to_owned());
        }
        // The hub marks the telegram as suspect, because the telegram follows damaged bytes or took longer than usual.
        if header.reasons != 0 {
            return None;
        }
        // Scans of a simulated scene repeat, so the telegram is compared with every telegram that has been read.
        let is_it = |sent: &&SentTelegram| sent.end <= self.read_end && sent.bytes == bytes;
        let is_right = |sent: &SentTelegram| {
            let maximum = MAX_STAMP_ERROR + line_time(USB_CHUNK_LEN, sent.rate);
            header.stamp_first_ns.abs_diff(sent.first_at) <= maximum
                && header.stamp_last_ns.abs_diff(sent.last_at) <= maximum + MAX_DELAY
        };
        let off = |sent: &SentTelegram| {
            let stamps = [(header.stamp_first_ns, sent.first_at), (header.stamp_last_ns, sent.last_at)];
            stamps.map(|(stamp, sent)| (stamp as i64 - sent as i64) / 1_000)
        };
        let offs: Vec<&SentTelegram> = self.sent.iter().filter(is_it).collect();
        let nearest = offs.iter().min_by_key(|sent| off(sent).map(i64::abs))?;
        let is_wrong = !offs.iter().any(|sent| is_right(sent));
        is_wrong.then(|| format!("stamps are off by {:?} us and not marked", off(nearest)))
    }
}

/// Maximum error of a stamp that is not marked as an estimate. The time that [`USB_CHUNK_LEN`] bytes spend on the line
/// is added.
const MAX_STAMP_ERROR: Nanos = 5 * MILLIS;
/// Maximum additional time, compared with the usual duration of a telegram, at which the hub does not yet mark the
/// telegram as suspect.
const MAX_DELAY: Nanos = 8 * MILLIS;
/// Number of bytes that a USB adapter passes on at once. A longer chunk makes a stamp an estimate.
const USB_CHUNK_LEN: usize = 64;
/// Time after the last fault, after which no fault has an effect any more.
const RECOVERY_TIME: Nanos = 3_000 * MILLIS;
/// Number of consecutive scans after which the session has estimated the scan period.
const LEARNING_SCANS: usize = 8;
/// Maximum number of stored telegrams. The buffer of a port contains fewer telegrams.
const MAX_TELEGRAMS: usize = 256;

/// Invariant: the hub wakes a sleeping subscriber. A prompt subscriber receives each sample of a telegram shortly after
/// the hub has sent it. The hub wakes a subscriber to zones before it sends the marks of the same scan.
#[derive(Default)]
pub(crate) struct Wakeups {
    /// Times at which prompt subscribers attached.
    attached_at: BTreeMap<SubscriberId, Nanos>,
    /// Topics of the subscribers.
    topics: BTreeMap<SubscriberId, (usize, Topic)>,
    /// For each sensor, the `seq` of the telegram for whose samples the hub has not woken all subscribers yet.
    unwoken: BTreeMap<usize, u64>,
}

impl Invariant for Wakeups {
    fn name(&self) -> &'static str {
        "prompt"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Attached { subscriber, sensor, topic, is_prompt, .. } => {
                self.topics.insert(subscriber, (sensor, topic));
                if is_prompt {
                    self.attached_at.insert(subscriber, at);
                }
            }
            Event::Detached { subscriber, .. } => {
                self.topics.remove(&subscriber);
            }
            Event::Published { sensor, sample } if sample.header.hub_time_ns().is_some() => {
                let (topic, seq) = (sample.topic, sample.header.seq);
                if topic.spec().doorbell_word == DoorbellWord::Last && self.unwoken.get(&sensor) == Some(&seq)
                {
                    reporter.report(format!(
                        "{topic:?} of {seq} was sent before subscribers to zones were woken"
                    ));
                }
                let is_wanted = self.topics.values().any(|followed| *followed == (sensor, topic));
                if matches!(topic, Topic::Scan | Topic::Zones) && is_wanted {
                    self.unwoken.insert(sensor, seq);
                }
            }
            Event::Rung { sensor, ring: DoorbellWord::First } => {
                self.unwoken.remove(&sensor);
            }
            Event::HubEnded { .. } => self.unwoken.clear(),
            Event::Taken { subscriber, sample, .. } => {
                let attached_at = self.attached_at.get(&subscriber);
                let is_of_telegram = sample.header.hub_time_ns().is_some();
                let late = at.saturating_sub(sample.sent_at);
                if is_of_telegram
                    && late > MAX_WAKE_DELAY
                    && attached_at.is_some_and(|&attached_at| sample.sent_at > attached_at)
                {
                    let us = late / 1_000;
                    reporter
                        .report(format!("subscriber {} got {:?} after {us} us", subscriber.0, sample.topic));
                }
            }
            _ => {}
        }
    }
}

/// Maximum time from the publication of a sample until a prompt subscriber takes it, on a machine with idle processors.
const MAX_WAKE_DELAY: Nanos = 2 * MILLIS;
