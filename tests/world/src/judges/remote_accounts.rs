//! The account of each listener is right (`docs/datagram.md`): per row, received is what came, duplicate what came again, and lost
//! what lies between the first known and the last known number and did not come. When all is well at the end, and the gateway
//! had its last word, all that it sent is known.

use std::collections::{BTreeMap, BTreeSet};

use scanhub_schema::datagram::{Announce, Datagram};
use scanhub_schema::{Nanos, Topic};

use super::{Judge, Say};
use crate::event::{Arrival, Event};

/// Epoch, sensor's number and topic's.
type Key = (u32, u8, u8);

/// What is due of the listener that lives.
#[derive(Default)]
pub(crate) struct RemoteAccounts {
    /// How many numbers were used up.
    numbered: BTreeMap<Key, u32>,
    rows: BTreeMap<Key, Row>,
    /// Datagrams that it took, and those that it refused.
    arrived: u64,
    refused: u64,
    /// What its account has so far, and in how many rows.
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
            // Nothing is counted before the last part is there.
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
    /// A number came; whether it is the first time.
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
