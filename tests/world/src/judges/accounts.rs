//! Judges of counters: those of subscribers, listeners and bridges, and the resources that remain at the end.

use std::collections::{BTreeMap, BTreeSet};

use scanhub_schema::datagram::{Announce, Datagram};
use scanhub_schema::{Nanos, Topic};

use super::{Judge, Say};
use crate::consumer::Number;
use crate::event::{Arrival, Event};
use crate::remote::{FIRST_NUMBER, Terms};
use crate::topics::Sample;

/// Judge: the counters of each subscriber are right. By their numbers, its taken samples and its missed samples are
/// together the published ones. No sample arrives twice or out of order, and each sample that was sent to a subscriber
/// was taken or fell out of its queue.
#[derive(Default)]
pub(crate) struct Accounts {
    consumers: BTreeMap<Number, Account>,
    /// Life, number and index of the last sample of each topic.
    published: BTreeMap<(usize, Topic), (u64, u64, u64)>,
}

struct Account {
    topic: (usize, Topic),
    /// Of the hub whose samples it gets.
    life: Option<Life>,
}

struct Life {
    boot: u64,
    /// The number at which its account begins, and the index of its first sample.
    first: u64,
    first_index: u64,
    taken: u64,
    missed: u64,
    dropped: u64,
    last: u64,
}

impl Judge for Accounts {
    fn name(&self) -> &'static str {
        "accounts"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Published { sensor, sample } => {
                let Sample { header, index, .. } = sample;
                self.published.insert((sensor, sample.topic), (header.boot, header.topic_seq, *index));
            }
            Event::Attached { consumer, sensor, topic, .. } => {
                self.consumers.insert(consumer, Account { topic: (sensor, topic), life: None });
            }
            Event::Taken { consumer, sample, missed } => {
                if let Some(account) = self.consumers.get_mut(&consumer)
                    && let Err(words) = account.take(sample, missed)
                {
                    say.broken(format!("consumer {}: {words}", consumer.0));
                }
            }
            Event::Dropped { consumer, sample } => {
                if let Some(account) = self.consumers.get_mut(&consumer) {
                    account.drop(sample);
                }
            }
            Event::Left { consumer, is_drained } => {
                let account = self.consumers.remove(&consumer);
                if let Some(Account { topic, life: Some(life) }) = account.filter(|_| is_drained)
                    && let Some(&(boot, number, index)) = self.published.get(&topic)
                    && life.boot == boot
                {
                    let Life { first, first_index, taken, missed, dropped, .. } = life;
                    let (published, sent) = (number + 1 - first, index + 1 - first_index);
                    if (taken + missed, taken + dropped) != (published, sent) {
                        say.broken(format!(
                            "consumer {} of {topic:?}: {taken} taken, {missed} missed, {dropped} dropped of \
                             {published} published, {sent} sent",
                            consumer.0
                        ));
                    }
                }
            }
            _ => {}
        }
    }
}

impl Account {
    fn take(&mut self, sample: &Sample, missed: u64) -> Result<(), String> {
        let Sample { header, index, .. } = sample;
        let number = header.topic_seq;
        let is_new = self.life.as_ref().is_none_or(|life| life.boot != header.boot);
        if is_new {
            // Who was there before got everything of the new hub.
            let (first, first_index) = if self.life.is_some() { (0, 0) } else { (number, *index) };
            let dropped = index - first_index;
            let boot = header.boot;
            self.life = Some(Life { boot, first, first_index, taken: 0, missed: 0, dropped, last: 0 });
        }
        let Some(life) = &mut self.life else { return Ok(()) };
        let expected = if is_new { life.first } else { life.last + 1 };
        life.taken += 1;
        life.missed += missed;
        life.last = number;
        if expected + missed == number {
            Ok(())
        } else {
            Err(format!("number {number} where {expected} was expected, {missed} missed"))
        }
    }

    fn drop(&mut self, sample: &Sample) {
        // What fell out before the first one was taken is known by that one's index.
        if let Some(life) = self.life.as_mut().filter(|life| life.boot == sample.header.boot) {
            life.dropped += 1;
        }
    }
}

/// Judge: at the end no line is open, no loan is out, and no sample is held.
pub(crate) struct Resources;

impl Judge for Resources {
    fn name(&self) -> &'static str {
        "resources"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        if let Event::Over { handles, loans, held, .. } = *event
            && (handles, loans, held) != (0, 0, 0)
        {
            say.broken(format!("{handles} lines are open, {loans} loans are out, {held} samples are held"));
        }
    }
}

/// Epoch, sensor's number and topic's.
type Key = (u32, u8, u8);

/// Judge: the counters of each listener are right (`docs/datagram.md`). In each row, `received` counts datagrams that arrived,
/// `duplicate` those that arrived again, and `lost` the numbers between the first and the last known one that did not arrive.
/// If nothing is wrong at the end and the last announcement arrived, the listener knows every number that the gateway sent.
/// The counters belong to the running listener.
#[derive(Default)]
pub(crate) struct RemoteAccounts {
    /// Number of sequence numbers in use.
    numbered: BTreeMap<Key, u32>,
    rows: BTreeMap<Key, Row>,
    /// Datagrams that it took, and those that it refused.
    arrived: u64,
    refused: u64,
    /// Sum of the counters so far, and number of their rows.
    counted: u64,
    counted_rows: usize,
    is_over: bool,
}

/// One row as it has to be.
struct Row {
    taken: BTreeSet<u32>,
    again: u64,
    late: u64,
    /// The first known number, and the one behind the last known.
    first: u32,
    end: u32,
}

impl Judge for RemoteAccounts {
    fn name(&self) -> &'static str {
        "remote_accounts"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Transmitted { datagram, .. } => {
                let head = &datagram.head;
                let next = self.numbered.entry((head.epoch, head.sensor, head.topic)).or_default();
                // A sample that fits into no datagram has a number, too.
                let is_next = if head.part > 0 { head.sequence + 1 == *next } else { head.sequence >= *next };
                if !is_next {
                    say.broken(format!("a number that was there, {next} is next: {head:?}"));
                }
                *next = head.sequence + 1;
                if let Some(announce) = announce(datagram) {
                    for announced in announce.topics() {
                        let next =
                            self.numbered.entry((head.epoch, head.sensor, announced.topic)).or_default();
                        *next = announced.next.max(*next);
                    }
                }
            }
            Event::ListenerBegins { .. } => {
                let numbered = std::mem::take(&mut self.numbered);
                *self = RemoteAccounts { numbered, ..RemoteAccounts::default() };
            }
            Event::Arrived { outcome: Arrival::Refused(_), .. } => {
                self.arrived += 1;
                self.refused += 1;
            }
            // The listener counts a sample when its last part arrives.
            Event::Arrived { outcome: Arrival::Part, .. } => {}
            Event::Arrived { datagram: Some(datagram), outcome, .. } => {
                self.arrived += 1;
                let head = &datagram.head;
                let key = |topic| (head.epoch, head.sensor, topic);
                let is_new = self.row(key(head.topic), head.sequence).take(head.sequence);
                let is_told_new = outcome != Arrival::Known;
                if head.topic != Announce::NUMBER && is_new != is_told_new {
                    say.broken(format!("{outcome:?}, and it is new: {is_new}, {head:?}"));
                }
                if let Some(announce) = announce(datagram) {
                    for announced in announce.topics() {
                        let row = self.row(key(announced.topic), announced.next);
                        row.end = row.end.max(announced.next);
                    }
                }
            }
            Event::Healed => self.is_over = true,
            Event::Counted { row: counted } => {
                let key = (counted.epoch, counted.sensor, counted.topic);
                let is_last = self.numbered.keys().next_back().is_some_and(|last| last.0 == key.0);
                let Some(row) = self.rows.get(&key) else {
                    say.broken(format!("{key:?}: a row of what did not come"));
                    return;
                };
                self.counted += counted.received + counted.duplicate;
                self.counted_rows += 1;
                let received = row.taken.len() as u64;
                let lost = u64::from(row.end - row.first) - received;
                let due = (received, lost, row.again, row.late);
                let has = (counted.received, counted.lost(), counted.duplicate, counted.reordered);
                if has != due {
                    say.broken(format!("{key:?}: received, lost, duplicate, reordered {has:?}, due {due:?}"));
                }
                let numbered = self.numbered.get(&key).copied().unwrap_or_default();
                if row.end > numbered {
                    say.broken(format!("{key:?}: {} is known, {numbered} were sent", row.end));
                }
                if self.is_over && is_last && Topic::of_number(key.2).is_some() && row.end < numbered {
                    say.broken(format!("{key:?}: {} of {numbered} are known at the end", row.end));
                }
            }
            Event::ListenerEnds { refused, given_up, .. } => {
                let RemoteAccounts { arrived, counted, .. } = *self;
                let rows = self.rows.values().filter(|row| row.end > row.first).count();
                if self.counted_rows != rows {
                    say.broken(format!("{} rows of {rows}", self.counted_rows));
                }
                if refused != self.refused || counted + refused != arrived || given_up != 0 {
                    say.broken(format!(
                        "{arrived} came, {counted} counted, {refused} refused, {given_up} lives given up"
                    ));
                }
            }
            _ => {}
        }
    }
}

impl RemoteAccounts {
    /// The row of `key`, which begins with `first` if it is new.
    fn row(&mut self, key: Key, first: u32) -> &mut Row {
        let new = || Row { taken: BTreeSet::new(), again: 0, late: 0, first, end: first };
        self.rows.entry(key).or_insert_with(new)
    }
}

impl Row {
    /// Takes a number, and returns whether it is new.
    fn take(&mut self, number: u32) -> bool {
        let is_late = self.taken.last().is_some_and(|&last| last > number);
        let is_new = self.taken.insert(number);
        self.again += u64::from(!is_new);
        self.late += u64::from(is_new && is_late);
        (self.first, self.end) = (self.first.min(number), self.end.max(number + 1));
        is_new
    }
}

fn announce(datagram: &Datagram<'_>) -> Option<Announce> {
    if datagram.head.topic == Announce::NUMBER { Announce::unpack(datagram.payload) } else { None }
}

/// Judge: the counters of a bridge are right (`docs/bridge.md`). Each sample that the bridge took is sent once, counted as
/// replaced, or still waiting. Announcements report the replaced samples, and all of them if nothing is wrong at the end.
pub(crate) struct RemoteBridge {
    are_bridges: bool,
    /// All samples of scans and their like go out.
    all_go_out: bool,
    topics: BTreeMap<(usize, Option<Topic>), OfTopic>,
    is_over: bool,
    epoch: u32,
}

#[derive(Default)]
struct OfTopic {
    /// Samples that it took of the hub, that went out, and of these that were not taken.
    taken: u64,
    out: u64,
    failed: u64,
    /// Replaced samples in the last announcement, and in the counters.
    said: u64,
    replaced: u64,
}

impl RemoteBridge {
    pub(crate) fn new(terms: &Terms) -> RemoteBridge {
        let all_go_out = terms.every.get() == 1;
        RemoteBridge {
            are_bridges: terms.are_bridges,
            all_go_out,
            topics: BTreeMap::new(),
            is_over: false,
            epoch: 0,
        }
    }

    fn of(&mut self, sensor: usize, topic: Option<Topic>) -> &mut OfTopic {
        self.topics.entry((sensor, topic)).or_default()
    }
}

impl Judge for RemoteBridge {
    fn name(&self) -> &'static str {
        "remote_bridge"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        if !self.are_bridges {
            return;
        }
        match *event {
            Event::GatewayBegins { epoch } => {
                self.epoch = epoch;
                self.topics.clear();
            }
            Event::Taken { consumer: Number(number), sample, .. } if number >= FIRST_NUMBER => {
                self.of(sample.header.sensor.into(), Some(sample.topic)).taken += 1;
            }
            Event::Transmitted { datagram, is_taken, .. } => {
                let head = &datagram.head;
                let of = self.of(head.sensor.into(), Topic::of_number(head.topic));
                of.out += 1;
                of.failed += u64::from(!is_taken);
            }
            Event::Arrived { datagram: Some(datagram), outcome: Arrival::Announced, .. }
                if datagram.head.epoch == self.epoch =>
            {
                let Some(announce) = Announce::unpack(datagram.payload) else { return };
                for announced in announce.topics() {
                    let of = self.of(datagram.head.sensor.into(), Topic::of_number(announced.topic));
                    let said = announce.replaced(announced.topic).map_or(0, u64::from);
                    if said < of.said {
                        say.broken(format!("{:?}: {said} replaced, {} before", announced.topic, of.said));
                    }
                    of.said = said;
                }
            }
            Event::Healed => self.is_over = true,
            Event::Accounted { sensor, topic, row } => {
                // Announcements, backgrounds and silences come of themselves, too.
                let is_counted = matches!(topic, Some(Topic::Scan | Topic::Telegram | Topic::Foreground));
                let all_go_out = self.all_go_out && is_counted;
                let of = self.of(sensor, topic);
                if (row.sent, row.failed) != (of.out - of.failed, of.failed) {
                    say.broken(format!("sensor {sensor}, {topic:?}: {row:?}, {} went out", of.out));
                }
                let accounted = row.sent + row.failed + row.replaced;
                if all_go_out && !(accounted..=accounted + 1).contains(&of.taken) {
                    say.broken(format!(
                        "sensor {sensor}, {topic:?}: {row:?} of {} that were taken",
                        of.taken
                    ));
                }
                of.replaced = row.replaced;
            }
            // The last announcement has arrived. Announcements do not count themselves.
            Event::ListenerEnds { .. } if self.is_over => {
                let topics =
                    self.topics.iter().filter(|((_, topic), of)| topic.is_some() && of.said != of.replaced);
                for ((sensor, topic), OfTopic { said, replaced, .. }) in topics {
                    say.broken(format!("sensor {sensor}, {topic:?}: {said} are said, {replaced} replaced"));
                }
            }
            _ => {}
        }
    }
}
