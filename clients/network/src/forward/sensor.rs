//! One sensor of the hub, followed in shared memory: its samples are handed on as they come. Refuses to know what becomes
//! of them.

use std::time::Duration;

use crate::lan::outgoing::{self, PayloadRef};
use scanhub_client::streams::{Sample, Session, Source};
use scanhub_schema::{Failure, Topic};

use super::Carrier;
use super::selection::Selection;

/// A sensor that is being followed.
pub(super) struct Sensor {
    pub(super) name: String,
    /// What the carrier knows it by.
    position: usize,
    sources: Vec<Source>,
}

/// Samples taken from one topic before the next one has its turn.
const TURN: usize = 32;

impl Sensor {
    /// Will follow what goes out of the sensor called `name`, of the topics that it `may_have`; its status too if it is announced, for its type.
    pub(super) fn new(
        name: &str,
        may_have: impl Fn(Topic) -> bool,
        selection: &Selection,
        carrier: &mut impl Carrier,
    ) -> Sensor {
        let every = |topic| selection.every(name, topic).filter(|_| may_have(topic));
        let position = carrier.follow(name, &every);
        let wanted =
            Topic::ALL.into_iter().filter(|topic| may_have(*topic) && carrier.wants(position, *topic));
        let sources = wanted.map(|topic| Source::new(name, topic)).collect();
        Sensor { name: name.to_owned(), position, sources }
    }

    /// Hands on what waits; whether more may. If nothing `subscribed` to a topic yet in this round it may, and says so: that
    /// takes a thousand times as long as sending, so that what waits of others has its turn before the next one. Failures as
    /// [`Source::receive`].
    pub(super) fn forward(
        &mut self,
        session: &mut Session,
        carrier: &mut impl Carrier,
        subscribed: &mut bool,
    ) -> Result<bool, Failure> {
        let mut more = false;
        for source in &mut self.sources {
            let is_new = !source.subscribed();
            if is_new && *subscribed {
                more = true;
                continue;
            }
            for turn in 0..TURN {
                let Some(sample) = source.receive(session)? else { break };
                more |= turn + 1 == TURN;
                carrier.sample(self.position, &borrowed(&sample));
            }
            *subscribed |= is_new && source.subscribed();
        }
        Ok(more)
    }

    /// After which time there may be something to send although the hub sends nothing.
    pub(super) fn left(&self) -> Option<Duration> {
        self.sources.iter().filter_map(Source::left).min()
    }
}

/// Declares from the table of topics where the payload of a sample lies.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        fn payload(sample: &Sample) -> PayloadRef<'_> {
            match sample {
                $(Sample::$topic(sample) => PayloadRef::$topic(payloads!($topic sample)),)*
                Sample::Robot(sample) => PayloadRef::Zones(&sample.heard.zones),
            }
        }
    };
    // Zones are followed with an eye on their age.
    (Zones $sample:ident) => {
        &$sample.zones
    };
    ($topic:ident $sample:ident) => {
        $sample
    };
}

scanhub_schema::for_each_topic!(payloads);

fn borrowed(sample: &Sample) -> outgoing::Sample<'_> {
    outgoing::Sample { header: sample.header(), missed: sample.missed(), payload: payload(sample) }
}
