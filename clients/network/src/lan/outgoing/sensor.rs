//! One sensor of the hub on its way out: which of its samples become datagrams, and what is announced of it. Refuses to
//! know what a datagram looks like.

use std::collections::VecDeque;
use std::num::NonZeroU64;
use std::time::Duration;

use scanhub_schema::datagram::{Announce, Announced, Head, LanFlags, PORT, Packed, group};
use scanhub_schema::{Background, Family, Flags, Header, Quality, Topic, Verdict};

use super::numbering::{Numbering, Transmit};
use super::sample::{PayloadRef, Sample};
use crate::lan::Stamp;

/// A sensor that is being followed.
pub(super) struct Sensor {
    pub(super) name: String,
    /// One for each of [`Topic::ALL`].
    tracks: [Track; Topic::ALL.len()],
    /// Of what came last; nothing as long as nothing did.
    heard: Option<Header>,
    turns: Turns,
    /// As its status says; empty if unknown.
    kind: String,
    model: Option<Model>,
}

struct Track {
    topic: Topic,
    /// Every how manieth sample goes out; nothing if none do.
    every: Option<NonZeroU64>,
    last: Option<Header>,
    /// The last zones that went out were unknown.
    is_unknown: bool,
}

/// The turns of a scanner whose head turns, counted: the numbers of the telegrams that complete them have gaps, which may all be
/// of one length.
#[derive(Default)]
struct Turns {
    /// Of the last ones the number of the telegram, and their own.
    last: VecDeque<(u64, u64)>,
}

impl Turns {
    /// The number of the turn of which a sample with `header` is made; nothing if it is none of those that are remembered.
    fn number(&mut self, header: &Header) -> Option<u64> {
        let newest = self.last.back().copied();
        if newest.is_none_or(|(seq, _)| header.seq > seq) && header.hub_time_ns().is_some() {
            let number = newest.map_or(0, |(_, number)| number + 1);
            if self.last.len() == REMEMBERED {
                self.last.pop_front();
            }
            self.last.push_back((header.seq, number));
        }
        self.last.iter().rev().find(|(seq, _)| *seq == header.seq).map(|(_, number)| *number)
    }

    /// The number of the turn that is being measured, of which an early warning is, whatever its own number.
    fn next(&self) -> u64 {
        self.last.back().map_or(0, |(_, number)| number + 1)
    }
}

/// The background as it went out last.
struct Model {
    background: Box<Background>,
    header: Header,
    /// CLOCK_MONOTONIC, in ns.
    sent_ns: u64,
}

impl Sensor {
    /// The sensor called `name`, of whose topics every so many samples go out.
    pub(super) fn new(name: &str, every: impl Fn(Topic) -> Option<NonZeroU64>) -> Sensor {
        let track = |topic| Track { topic, every: every(topic), last: None, is_unknown: false };
        let tracks = Topic::ALL.map(track);
        Sensor {
            name: name.to_owned(),
            tracks,
            heard: None,
            turns: Turns::default(),
            kind: String::new(),
            model: None,
        }
    }

    /// Samples of this topic go out.
    pub(super) fn sends(&self, topic: Topic) -> bool {
        self.tracks[topic as usize].every.is_some()
    }

    /// Sends the background again if it went out longer than `every` ago.
    pub(super) fn repeat(
        &mut self,
        every: Duration,
        now: Stamp,
        numbering: &mut Numbering,
        to: &mut impl Transmit,
    ) {
        let is_due = |model: &&mut Model| {
            u128::from(now.monotonic_ns.saturating_sub(model.sent_ns)) >= every.as_nanos()
        };
        let Some(model) = self.model.as_mut().filter(is_due) else { return };
        if numbering.is_claimed(model.header.sensor, &self.name) {
            model.sent_ns = now.monotonic_ns;
            let head = head(Topic::Background, &model.header, model.header.wall_ns);
            numbering.send(head, to, |room| model.background.pack(room));
        }
    }

    /// Says who this is and which number each topic has next; nothing as long as nothing was heard of it.
    pub(super) fn announce(&self, now: Stamp, numbering: &mut Numbering, to: &mut impl Transmit) {
        let is_announced = numbering.announces();
        let heard = self.heard.filter(|heard| is_announced && numbering.is_claimed(heard.sensor, &self.name));
        let Some(heard) = heard else { return };
        let mut announce = Announce::new(heard.boot, &self.name, &self.kind);
        for topic in self.tracks.iter().filter(|track| track.every.is_some()).map(|track| track.topic) {
            announce.add(Announced {
                topic: topic.number(),
                group: group(topic),
                port: PORT,
                next: numbering.next(heard.sensor, topic),
            });
            if numbering.tells_replaced() {
                announce.add_replaced(numbering.replaced(heard.sensor, topic));
            }
        }
        let head = Head {
            topic: Announce::NUMBER,
            flags: flags(&heard) & !LanFlags::SUSPECT,
            revision: announce.revision(),
            ..head(Topic::Status, &heard, now.wall_ns)
        };
        numbering.send(head, to, |room| announce.pack(room));
    }

    /// Sends `sample`, if it is one that goes out.
    pub(super) fn take(
        &mut self,
        sample: &Sample<'_>,
        now: Stamp,
        numbering: &mut Numbering,
        to: &mut impl Transmit,
    ) {
        let topic = sample.payload.topic();
        let Sensor { name, tracks, heard, kind, .. } = self;
        let track = &mut tracks[topic as usize];
        let Some(header) = sample.header.copied() else {
            // A silence has no header of its own: it is one of the last sample's sensor, if that still is this one.
            let last = track.last.filter(|last| numbering.is_claimed(last.sensor, name));
            if let Some(last) = last.filter(|_| track.every.is_some()) {
                track.is_unknown = true;
                numbering.send(head(topic, &last, now.wall_ns), to, |room| sample.payload.pack(room));
            }
            return;
        };
        // What came from another machine is not sent on: it would go round in circles.
        if header.flags & Flags::REMOTE != 0 {
            return;
        }
        let is_new = heard.is_none_or(|heard| (heard.boot, heard.sensor) != (header.boot, header.sensor));
        if is_new {
            numbering.claim(header.sensor, name);
        } else if !numbering.is_claimed(header.sensor, name) {
            // What is left of a hub's life that is over: the number is another sensor's.
            return;
        }
        *heard = Some(header);
        track.last = Some(header);
        if let PayloadRef::Status(status) = sample.payload {
            status.sensor_type().clone_into(kind);
        }
        // Before its first sample: listeners would take that for one of whoever had the number before.
        if is_new {
            self.announce(now, numbering, to);
        }
        let Sensor { tracks, model, turns, .. } = self;
        if is_new {
            *turns = Turns::default();
        }
        let track = &mut tracks[topic as usize];
        let Some(every) = track.every else { return };
        numbering.miss(header.sensor, topic, sample.missed);
        let mut stamp_ns = header.wall_ns;
        let number = match topic {
            _ if topic == Topic::Telegram || header.family == Family::Lms as u8 => Some(header.seq),
            Topic::Early => Some(turns.next()),
            _ => turns.number(&header),
        };
        let mut is_due = every.get() == 1 || number.is_some_and(|number| number.is_multiple_of(every.get()));
        match sample.payload {
            PayloadRef::Status(_) => stamp_ns = now.wall_ns,
            PayloadRef::Zones(zones) => {
                // That nothing is known is never thinned away.
                let is_unknown = zones.verdict() == Verdict::Unknown;
                is_due |= is_unknown && !track.is_unknown;
                track.is_unknown = if is_due { is_unknown } else { track.is_unknown };
            }
            PayloadRef::Background(background) => {
                let same = |model: &Model| {
                    (model.header.boot, model.background.generation) == (header.boot, background.generation)
                };
                is_due = !model.as_ref().is_some_and(same);
                let sent_ns =
                    model.as_ref().filter(|_| !is_due).map_or(now.monotonic_ns, |model| model.sent_ns);
                *model = Some(Model { background: background.boxed(), header, sent_ns });
            }
            _ => {}
        }
        if is_due {
            numbering.send(head(topic, &header, stamp_ns), to, |room| sample.payload.pack(room));
        }
    }
}

/// No topic is behind another one by more turns than its consumers have places for.
const REMEMBERED: usize = 64;

/// What stands before a sample of `topic`.
fn head(topic: Topic, header: &Header, stamp_ns: u64) -> Head {
    Head {
        topic: topic.number(),
        flags: flags(header),
        stamp_ns,
        sensor: header.sensor,
        family: header.family,
        revision: topic.revision() as u16,
        counter: header.seq as u32,
        ..Head::default()
    }
}

fn flags(header: &Header) -> u8 {
    let known = Flags::SIMULATED | Flags::REPLAYED | Flags::STAMP_ESTIMATED;
    let suspect = if header.quality() == Quality::Suspect { LanFlags::SUSPECT } else { 0 };
    header.flags & known | suspect
}

// The bits are the same in both forms.
const _: () = assert!(
    Flags::SIMULATED == LanFlags::SIMULATED
        && Flags::REPLAYED == LanFlags::REPLAYED
        && Flags::STAMP_ESTIMATED == LanFlags::STAMP_ESTIMATED
);
