//! The account of a bridge is right (`docs/bridge.md`): each sample that it took goes out once, or is counted as replaced, or
//! waits; what its announcements say was replaced is what was, and all of it when all is well at the end.

use std::collections::BTreeMap;

use scanhub_schema::datagram::Announce;
use scanhub_schema::{Nanos, Topic};

use super::{Judge, Say};
use crate::consumer::Number;
use crate::event::{Arrival, Event};
use crate::remote::{FIRST_NUMBER, Terms};

/// What the bridge that lives did.
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
    /// As was announced to the listener last, and as its account has it.
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
            // It had its last word; announcements do not tell of themselves.
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
