//! A consumer that sleeps is woken: a prompt one has each sample that was made of a telegram a moment after it was sent, and
//! nobody waits for the marks of a scan whose zones he wants.

use std::collections::BTreeMap;

use scanhub_schema::{MILLIS, Nanos, Ring, Topic};

use super::{Judge, Say};
use crate::consumer::Number;
use crate::event::Event;

/// What is known of those who sleep.
#[derive(Default)]
pub(crate) struct Prompt {
    /// When prompt consumers came.
    came: BTreeMap<Number, Nanos>,
    /// The topics that consumers follow.
    followed: BTreeMap<Number, (usize, Topic)>,
    /// For each sensor the number of the telegram of which a sample was sent to somebody who has not been woken for it yet.
    asleep: BTreeMap<usize, u64>,
}

impl Judge for Prompt {
    fn name(&self) -> &'static str {
        "prompt"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Attached { consumer, sensor, topic, is_prompt } => {
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

/// Of a machine with processors to spare.
const LATEST: Nanos = 2 * MILLIS;
