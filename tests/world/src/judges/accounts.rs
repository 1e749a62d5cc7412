//! Each consumer's account is right: by the numbers of its samples, what it took and what it was told that it missed is what was
//! published, no sample came twice or out of order, and all that was sent to it was taken or fell out of its queue.

use std::collections::BTreeMap;

use scanhub_schema::{Nanos, Topic};

use super::{Judge, Say};
use crate::consumer::Number;
use crate::event::Event;
use crate::topics::Sample;

/// The accounts of all consumers.
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
