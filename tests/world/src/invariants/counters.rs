//! Invariants on counters of subscribers, listeners and bridges, and on the resources in use at the end.

use std::collections::{BTreeMap, BTreeSet};

use scanhub_schema::datagram::{Announce, Datagram};
use scanhub_schema::{Nanos, Topic};

use super::{Invariant, ViolationReporter};
use crate::event::{DatagramOutcome, Event};
use crate::remote::{FIRST_NUMBER, LinkSettings};
use crate::subscriber::SubscriberId;
use crate::topics::Sample;

/// Invariant: the counters of each subscriber are right. A subscriber detects missed samples by their sequence numbers.
/// The number of samples that it took and the number of samples that it missed add up to the number of published
/// samples. No sample arrives twice or out of order. Each sample that the hub sent to a subscriber was taken by it, or
/// was dropped from its queue.
#[derive(Default)]
pub(crate) struct SubscriberCounters {
    subscribers: BTreeMap<SubscriberId, SubscriberState>,
    /// Boot ID, sequence number and index of the last sample of each topic.
    published: BTreeMap<(usize, Topic), (u64, u64, u64)>,
}

struct SubscriberState {
    topic: (usize, Topic),
    /// Counters for the hub that published the last taken sample.
    run: Option<RunCounters>,
}

struct RunCounters {
    boot: u64,
    /// Sequence number and index of the first sample that the counters include.
    first: u64,
    first_index: u64,
    taken: u64,
    missed: u64,
    dropped: u64,
    last: u64,
}

impl Invariant for SubscriberCounters {
    fn name(&self) -> &'static str {
        "accounts"
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Published { sensor, sample } => {
                let Sample { header, index, .. } = sample;
                self.published.insert((sensor, sample.topic), (header.boot, header.topic_seq, *index));
            }
            Event::Attached { subscriber, sensor, topic, .. } => {
                self.subscribers.insert(subscriber, SubscriberState { topic: (sensor, topic), run: None });
            }
            Event::Taken { subscriber, sample, missed } => {
                if let Some(state) = self.subscribers.get_mut(&subscriber)
                    && let Err(words) = state.take(sample, missed)
                {
                    reporter.report(format!("subscriber {}: {words}", subscriber.0));
                }
            }
            Event::Dropped { subscriber, sample } => {
                if let Some(state) = self.subscribers.get_mut(&subscriber) {
                    state.drop(sample);
                }
            }
            Event::Detached { subscriber, is_drained } => {
                let state = self.subscribers.remove(&subscriber);
                if let Some(SubscriberState { topic, run: Some(run) }) = state.filter(|_| is_drained)
                    && let Some(&(boot, number, index)) = self.published.get(&topic)
                    && run.boot == boot
                {
                    let RunCounters { first, first_index, taken, missed, dropped, .. } = run;
                    let (published, sent) = (number + 1 - first, index + 1 - first_index);
                    if (taken + missed, taken + dropped) != (published, sent) {
                        reporter.report(format!(
                            "subscriber {} of {topic:?}: {taken} taken, {missed} missed, {dropped} dropped of \
                             {published} published, {sent} sent",
                            subscriber.0
                        ));
                    }
                }
            }
            _ => {}
        }
    }
}

impl SubscriberState {
    fn take(&mut self, sample: &Sample, missed: u64) -> Result<(), String> {
        let Sample { header, index, .. } = sample;
        let number = header.topic_seq;
        let is_new = self.run.as_ref().is_none_or(|run| run.boot != header.boot);
        if is_new {
            // A subscriber that was attached before the hub started gets all samples of this hub.
            let (first, first_index) = if self.run.is_some() { (0, 0) } else { (number, *index) };
            let dropped = index - first_index;
            let boot = header.boot;
            self.run = Some(RunCounters { boot, first, first_index, taken: 0, missed: 0, dropped, last: 0 });
        }
        let Some(run) = &mut self.run else { return Ok(()) };
        let expected = if is_new { run.first } else { run.last + 1 };
        run.taken += 1;
        run.missed += missed;
        run.last = number;
        if expected + missed == number {
            Ok(())
        } else {
            Err(format!("topic_seq {number} instead of {expected}, {missed} missed"))
        }
    }

    fn drop(&mut self, sample: &Sample) {
        // Before the subscriber takes its first sample, dropped samples need no count: the index of the first taken
        // sample shows how many samples were dropped before it.
        if let Some(run) = self.run.as_mut().filter(|run| run.boot == sample.header.boot) {
            run.dropped += 1;
        }
    }
}

/// Invariant: at the end of the world, no line is open, no loan of memory is unused, and no sample is held.
pub(crate) struct Resources;

impl Invariant for Resources {
    fn name(&self) -> &'static str {
        "resources"
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        if let Event::WorldEnded { handles, loans, held, .. } = *event
            && (handles, loans, held) != (0, 0, 0)
        {
            reporter.report(format!(
                "{handles} lines are open, {loans} loans are unused, {held} samples are held"
            ));
        }
    }
}

/// Epoch, number of the sensor, and number of the topic.
type StreamKey = (u32, u8, u8);

/// Invariant: the counters of each listener are right (`docs/datagram.md`). In each row, `received` counts datagrams
/// that arrived, and `duplicate` counts those that arrived again. `lost` counts sequence numbers that did not arrive,
/// from the first known sequence number to the last known one. If the faults are cleared at the end of the world and
/// the last announcement arrived, the listener knows every sequence number that the gateway sent. A new listener starts
/// with new counters.
#[derive(Default)]
pub(crate) struct ListenerCounters {
    /// Next sequence number that the gateway sends in each stream.
    sequence_counts: BTreeMap<StreamKey, u32>,
    rows: BTreeMap<StreamKey, ExpectedRow>,
    /// Number of datagrams that the listener accepted, and number of datagrams that it refused.
    arrived: u64,
    refused: u64,
    /// Sum of the counters of all rows that were checked so far, and number of these rows.
    counted: u64,
    counted_rows: usize,
    is_over: bool,
}

/// Expected contents of a row.
struct ExpectedRow {
    taken: BTreeSet<u32>,
    duplicates: u64,
    late: u64,
    /// First known sequence number, and last known sequence number plus 1.
    first: u32,
    after_last: u32,
}

impl Invariant for ListenerCounters {
    fn name(&self) -> &'static str {
        "remote_accounts"
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Transmitted { datagram, .. } => {
                let head = &datagram.head;
                let next = self.sequence_counts.entry((head.epoch, head.sensor, head.topic)).or_default();
                // A sample that is too large for datagrams uses a sequence number, too.
                let is_next = if head.part > 0 { head.sequence + 1 == *next } else { head.sequence >= *next };
                if !is_next {
                    reporter.report(format!("a sequence number was used again, {next} is next: {head:?}"));
                }
                *next = head.sequence + 1;
                if let Some(announce) = announce(datagram) {
                    for announced in announce.topics() {
                        let next = self
                            .sequence_counts
                            .entry((head.epoch, head.sensor, announced.topic))
                            .or_default();
                        *next = announced.next.max(*next);
                    }
                }
            }
            Event::ListenerStarted { .. } => {
                let sequence_counts = std::mem::take(&mut self.sequence_counts);
                *self = ListenerCounters { sequence_counts, ..ListenerCounters::default() };
            }
            Event::Arrived { outcome: DatagramOutcome::Refused(_), .. } => {
                self.arrived += 1;
                self.refused += 1;
            }
            // The listener counts a sample when its last part arrives.
            Event::Arrived { outcome: DatagramOutcome::Part, .. } => {}
            Event::Arrived { datagram: Some(datagram), outcome, .. } => {
                self.arrived += 1;
                let head = &datagram.head;
                let key = |topic| (head.epoch, head.sensor, topic);
                let is_new = self.row(key(head.topic), head.sequence).take(head.sequence);
                let is_reported_new = outcome != DatagramOutcome::Duplicate;
                if head.topic != Announce::NUMBER && is_new != is_reported_new {
                    reporter.report(format!("{outcome:?}, although is_new is {is_new}: {head:?}"));
                }
                if let Some(announce) = announce(datagram) {
                    for announced in announce.topics() {
                        let row = self.row(key(announced.topic), announced.next);
                        row.after_last = row.after_last.max(announced.next);
                    }
                }
            }
            Event::FaultsCleared => self.is_over = true,
            Event::ListenerCounters { row: counted } => {
                let key = (counted.epoch, counted.sensor, counted.topic);
                let is_last = self.sequence_counts.keys().next_back().is_some_and(|last| last.0 == key.0);
                let Some(row) = self.rows.get(&key) else {
                    reporter.report(format!("{key:?}: a row for a stream that did not arrive"));
                    return;
                };
                self.counted += counted.received + counted.duplicate;
                self.counted_rows += 1;
                let received = row.taken.len() as u64;
                let lost = u64::from(row.after_last - row.first) - received;
                let due = (received, lost, row.duplicates, row.late);
                let has = (counted.received, counted.lost(), counted.duplicate, counted.reordered);
                if has != due {
                    reporter.report(format!(
                        "{key:?}: received, lost, duplicate, reordered {has:?}, expected {due:?}"
                    ));
                }
                let sequence_counts = self.sequence_counts.get(&key).copied().unwrap_or_default();
                if row.after_last > sequence_counts {
                    reporter.report(format!(
                        "{key:?}: {} sequence numbers are known, {sequence_counts} were sent",
                        row.after_last
                    ));
                }
                if self.is_over
                    && is_last
                    && Topic::of_number(key.2).is_some()
                    && row.after_last < sequence_counts
                {
                    reporter.report(format!(
                        "{key:?}: {} of {sequence_counts} sequence numbers are known at the end",
                        row.after_last
                    ));
                }
            }
            Event::ListenerEnded { refused, evicted: given_up, .. } => {
                let ListenerCounters { arrived, counted, .. } = *self;
                let rows = self.rows.values().filter(|row| row.after_last > row.first).count();
                if self.counted_rows != rows {
                    reporter.report(format!("{} rows of {rows}", self.counted_rows));
                }
                if refused != self.refused || counted + refused != arrived || given_up != 0 {
                    reporter.report(format!(
                        "{arrived} arrived, {counted} counted, {refused} refused, {given_up} runs evicted"
                    ));
                }
            }
            _ => {}
        }
    }
}

impl ListenerCounters {
    /// Returns the row of `key`. A new row starts at `first`.
    fn row(&mut self, key: StreamKey, first: u32) -> &mut ExpectedRow {
        let new = || ExpectedRow { taken: BTreeSet::new(), duplicates: 0, late: 0, first, after_last: first };
        self.rows.entry(key).or_insert_with(new)
    }
}

impl ExpectedRow {
    /// Adds a sequence number, and returns whether it is new.
    fn take(&mut self, number: u32) -> bool {
        let is_late = self.taken.last().is_some_and(|&last| last > number);
        let is_new = self.taken.insert(number);
        self.duplicates += u64::from(!is_new);
        self.late += u64::from(is_new && is_late);
        (self.first, self.after_last) = (self.first.min(number), self.after_last.max(number + 1));
        is_new
    }
}

fn announce(datagram: &Datagram<'_>) -> Option<Announce> {
    if datagram.head.topic == Announce::NUMBER { Announce::unpack(datagram.payload) } else { None }
}

/// Invariant: the counters of a bridge are right (`docs/bridge.md`). Each sample that the bridge took is sent once,
/// counted as replaced, or still queued. Announcements report replaced samples. If the faults are cleared at the end of
/// the world, the announcements report all replaced samples.
pub(crate) struct BridgeCounters {
    are_bridges: bool,
    /// Whether the bridge must send every scan, telegram and foreground.
    sends_all: bool,
    topics: BTreeMap<(usize, Option<Topic>), TopicCounters>,
    is_over: bool,
    epoch: u32,
}

#[derive(Default)]
struct TopicCounters {
    /// Number of samples that the bridge took from the hub; number of samples that it sent; and number of sent samples
    /// that the router did not accept.
    taken: u64,
    sent: u64,
    failed: u64,
    /// Number of replaced samples in the last announcement, and number of replaced samples in the bridge's counters.
    reported_replaced: u64,
    replaced: u64,
}

impl BridgeCounters {
    pub(crate) fn new(terms: &LinkSettings) -> BridgeCounters {
        let sends_all = terms.send_interval.get() == 1;
        BridgeCounters {
            are_bridges: terms.are_bridges,
            sends_all,
            topics: BTreeMap::new(),
            is_over: false,
            epoch: 0,
        }
    }

    fn topic_counters(&mut self, sensor: usize, topic: Option<Topic>) -> &mut TopicCounters {
        self.topics.entry((sensor, topic)).or_default()
    }
}

impl Invariant for BridgeCounters {
    fn name(&self) -> &'static str {
        "remote_bridge"
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        if !self.are_bridges {
            return;
        }
        match *event {
            Event::GatewayStarted { epoch } => {
                self.epoch = epoch;
                self.topics.clear();
            }
            Event::Taken { subscriber: SubscriberId(number), sample, .. } if number >= FIRST_NUMBER => {
                self.topic_counters(sample.header.sensor.into(), Some(sample.topic)).taken += 1;
            }
            Event::Transmitted { datagram, is_taken, .. } => {
                let head = &datagram.head;
                let of = self.topic_counters(head.sensor.into(), Topic::of_number(head.topic));
                of.sent += 1;
                of.failed += u64::from(!is_taken);
            }
            Event::Arrived { datagram: Some(datagram), outcome: DatagramOutcome::Announcement, .. }
                if datagram.head.epoch == self.epoch =>
            {
                let Some(announce) = Announce::unpack(datagram.payload) else { return };
                for announced in announce.topics() {
                    let of =
                        self.topic_counters(datagram.head.sensor.into(), Topic::of_number(announced.topic));
                    let reported = announce.replaced(announced.topic).map_or(0, u64::from);
                    if reported < of.reported_replaced {
                        reporter.report(format!(
                            "{:?}: {reported} replaced, {} before",
                            announced.topic, of.reported_replaced
                        ));
                    }
                    of.reported_replaced = reported;
                }
            }
            Event::FaultsCleared => self.is_over = true,
            Event::GatewayCounters { sensor, topic, row } => {
                // Announcements, backgrounds and silences are also sent without a sample from the hub.
                let is_counted = matches!(topic, Some(Topic::Scan | Topic::Telegram | Topic::Foreground));
                let all_go_out = self.sends_all && is_counted;
                let of = self.topic_counters(sensor, topic);
                if (row.sent, row.failed) != (of.sent - of.failed, of.failed) {
                    reporter.report(format!("sensor {sensor}, {topic:?}: {row:?}, {} sent", of.sent));
                }
                let accounted = row.sent + row.failed + row.replaced;
                if all_go_out && !(accounted..=accounted + 1).contains(&of.taken) {
                    reporter
                        .report(format!("sensor {sensor}, {topic:?}: {row:?} of {} taken samples", of.taken));
                }
                of.replaced = row.replaced;
            }
            // The last announcement has arrived. The counters in an announcement do not include this announcement
            // itself.
            Event::ListenerEnded { .. } if self.is_over => {
                let topics = self
                    .topics
                    .iter()
                    .filter(|((_, topic), of)| topic.is_some() && of.reported_replaced != of.replaced);
                for ((sensor, topic), TopicCounters { reported_replaced: reported, replaced, .. }) in topics {
                    reporter.report(format!(
                        "sensor {sensor}, {topic:?}: {reported} announced as replaced, {replaced} replaced"
                    ));
                }
            }
            _ => {}
        }
    }
}
