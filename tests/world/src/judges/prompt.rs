//! A consumer that sleeps is woken: a prompt one has each sample that was made of a telegram a moment after it was sent.

use std::collections::BTreeMap;

use lms::{MILLIS, Nanos};

use super::{Judge, Say};
use crate::consumer::Number;
use crate::event::Event;

/// When prompt consumers came.
#[derive(Default)]
pub(crate) struct Prompt(BTreeMap<Number, Nanos>);

impl Judge for Prompt {
    fn name(&self) -> &'static str {
        "prompt"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Attached { consumer, is_prompt: true, .. } => {
                self.0.insert(consumer, at);
            }
            Event::Taken { consumer, sample, .. } => {
                let came = self.0.get(&consumer);
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
