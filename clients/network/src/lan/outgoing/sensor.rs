//! One sensor of the hub on the sending side of a network. It decides which samples of the sensor become datagrams, and
//! announces the sensor.

use std::collections::VecDeque;
use std::num::NonZeroU64;
use std::time::Duration;

use scanhub_schema::datagram::{Announce, Announced, DatagramPayload, Head, LanFlags, PORT, group};
use scanhub_schema::{Background, Family, Flags, Header, Quality, Topic, Verdict};

use super::datagram_writer::{DatagramWriter, Transmit};
use super::{PayloadRef, Sample};
use crate::lan::WallTimestamp;

/// A subscribed sensor.
pub(super) struct Sensor {
    pub(super) name: String,
    /// State of each topic, in the order of [`Topic::ALL`].
    streams: [Stream; Topic::ALL.len()],
    /// Header of the last sample of any topic.
    last: Option<Header>,
    revolutions: RevolutionCounter,
    /// The sensor's type from its last status; empty if unknown.
    kind: String,
    sent_background: Option<SentBackground>,
}

/// State of one topic.
struct Stream {
    topic: Topic,
    /// Thinning factor; `None` if the topic is not sent.
    every: Option<NonZeroU64>,
    last: Option<Header>,
    /// Whether the last zones that were sent had the verdict `unknown`.
    is_unknown: bool,
}

/// Counter of the revolutions of a rotating scanner, for thinning. The sequence number of a sample is not suitable for
/// that, because it is the number of the packet that completed the revolution. The steps between these numbers may all
/// have the same length, so that none or all of them are multiples of the thinning factor.
#[derive(Default)]
struct RevolutionCounter {
    /// For each of the last revolutions: the sequence number of its samples, and its index.
    last: VecDeque<(u64, u64)>,
}

impl RevolutionCounter {
    /// Returns the index of the revolution that a sample with `header` is computed from. `None` if the revolution is
    /// too old.
    fn index(&mut self, header: &Header) -> Option<u64> {
        let newest = self.last.back().copied();
        if newest.is_none_or(|(seq, _)| header.seq > seq) && header.hub_time_ns().is_some() {
            if self.last.len() == MAX_REVOLUTIONS {
                self.last.pop_front();
            }
            self.last.push_back((header.seq, self.next_index()));
        }
        self.last.iter().rev().find(|(seq, _)| *seq == header.seq).map(|(_, index)| *index)
    }

    /// Returns the index of the revolution in progress. An early warning belongs to that revolution.
    fn next_index(&self) -> u64 {
        self.last.back().map_or(0, |(_, index)| index + 1)
    }
}

/// Background that was sent last.
struct SentBackground {
    background: Box<Background>,
    header: Header,
    /// Time of the last transmission, in ns of CLOCK_MONOTONIC.
    sent_ns: u64,
}

impl Sensor {
    /// Creates the sensor called `name`. `every` returns the thinning factor of a topic, or `None` if the topic is not
    /// sent.
    pub(super) fn new(name: &str, every: impl Fn(Topic) -> Option<NonZeroU64>) -> Sensor {
        let stream = |topic| Stream { topic, every: every(topic), last: None, is_unknown: false };
        Sensor {
            name: name.to_owned(),
            streams: Topic::ALL.map(stream),
            last: None,
            revolutions: RevolutionCounter::default(),
            kind: String::new(),
            sent_background: None,
        }
    }

    /// Returns whether samples of this topic are sent.
    pub(super) fn sends(&self, topic: Topic) -> bool {
        self.streams[topic as usize].every.is_some()
    }

    /// Sends the background again if its last transmission is `every` or longer ago.
    pub(super) fn repeat(
        &mut self,
        every: Duration,
        now: WallTimestamp,
        writer: &mut DatagramWriter,
        to: &mut impl Transmit,
    ) {
        let is_due = |sent: &&mut SentBackground| {
            u128::from(now.monotonic_ns.saturating_sub(sent.sent_ns)) >= every.as_nanos()
        };
        let Some(sent) = self.sent_background.as_mut().filter(is_due) else { return };
        if writer.is_claimed(sent.header.sensor, &self.name) {
            sent.sent_ns = now.monotonic_ns;
            let head = head(Topic::Background, &sent.header, sent.header.wall_ns);
            writer.send(head, to, |room| sent.background.pack(room));
        }
    }

    /// Announces the sensor's name, and the next sequence number of each topic. Sends nothing before the sensor's first
    /// sample.
    pub(super) fn announce(&self, now: WallTimestamp, writer: &mut DatagramWriter, to: &mut impl Transmit) {
        let is_announced = writer.announces();
        let last = self.last.filter(|last| is_announced && writer.is_claimed(last.sensor, &self.name));
        let Some(last) = last else { return };
        let mut announce = Announce::new(last.boot, &self.name, &self.kind);
        for topic in self.streams.iter().filter(|stream| stream.every.is_some()).map(|stream| stream.topic) {
            announce.add(Announced {
                topic: topic.number(),
                group: group(topic),
                port: PORT,
                next: writer.next(last.sensor, topic),
            });
            if writer.counts_replaced() {
                announce.add_replaced(writer.replaced(last.sensor, topic));
            }
        }
        let head = Head {
            topic: Announce::NUMBER,
            flags: flags(&last) & !LanFlags::SUSPECT,
            revision: announce.revision(),
            ..head(Topic::Status, &last, now.wall_ns)
        };
        writer.send(head, to, |room| announce.pack(room));
    }

    /// Sends `sample`, unless it is thinned out, is a background that was already sent, or comes from another machine.
    pub(super) fn send(
        &mut self,
        sample: &Sample<'_>,
        now: WallTimestamp,
        writer: &mut DatagramWriter,
        to: &mut impl Transmit,
    ) {
        let topic = sample.payload.topic();
        let Sensor { name, streams, last, kind, .. } = self;
        let stream = &mut streams[topic as usize];
        let Some(header) = sample.header.copied() else {
            // A silence has no header. It gets the header of the topic's last sample, if the sensor number in that
            // header still belongs to this sensor.
            let last = stream.last.filter(|last| writer.is_claimed(last.sensor, name));
            if let Some(last) = last.filter(|_| stream.every.is_some()) {
                stream.is_unknown = true;
                writer.send(head(topic, &last, now.wall_ns), to, |room| sample.payload.pack(room));
            }
            return;
        };
        // Samples of another machine are not forwarded, because they would circulate between machines.
        if header.flags & Flags::REMOTE != 0 {
            return;
        }
        let is_new = last.is_none_or(|last| (last.boot, last.sensor) != (header.boot, header.sensor));
        if is_new {
            writer.claim(header.sensor, name);
        } else if !writer.is_claimed(header.sensor, name) {
            // The sample comes from an earlier run of the hub, and its sensor number now belongs to another sensor.
            return;
        }
        *last = Some(header);
        stream.last = Some(header);
        if let PayloadRef::Status(status) = sample.payload {
            status.sensor_type().clone_into(kind);
        }
        // Announce the sensor before sending its sample. Listeners would otherwise assign the sample to the sensor that
        // had the number before.
        if is_new {
            self.announce(now, writer, to);
        }
        let Sensor { streams, sent_background, revolutions, .. } = self;
        if is_new {
            *revolutions = RevolutionCounter::default();
        }
        let stream = &mut streams[topic as usize];
        let Some(every) = stream.every else { return };
        writer.count_missed(header.sensor, topic, sample.missed);
        let mut stamp_ns = header.wall_ns;
        let index = match topic {
            _ if topic == Topic::Telegram || header.family == Family::Lms as u8 => Some(header.seq),
            Topic::Early => Some(revolutions.next_index()),
            _ => revolutions.index(&header),
        };
        let mut is_due = every.get() == 1 || index.is_some_and(|index| index.is_multiple_of(every.get()));
        match sample.payload {
            PayloadRef::Status(_) => stamp_ns = now.wall_ns,
            PayloadRef::Zones(zones) => {
                // A change to unknown is never thinned out.
                let is_unknown = zones.verdict() == Verdict::Unknown;
                is_due |= is_unknown && !stream.is_unknown;
                stream.is_unknown = if is_due { is_unknown } else { stream.is_unknown };
            }
            PayloadRef::Background(background) => {
                let is_same = |sent: &SentBackground| {
                    (sent.header.boot, sent.background.generation) == (header.boot, background.generation)
                };
                is_due = !sent_background.as_ref().is_some_and(is_same);
                let before = sent_background.as_ref().filter(|_| !is_due);
                let sent_ns = before.map_or(now.monotonic_ns, |sent| sent.sent_ns);
                *sent_background = Some(SentBackground { background: background.boxed(), header, sent_ns });
            }
            _ => {}
        }
        if is_due {
            writer.send(head(topic, &header, stamp_ns), to, |room| sample.payload.pack(room));
        }
    }
}

/// Number of revolutions whose indices are kept. No topic lags another one by more revolutions, because the buffer of a
/// topic holds fewer samples.
const MAX_REVOLUTIONS: usize = 64;

/// Returns the header of a datagram with a sample of `topic`, without hub, epoch and sequence number, which the writer
/// adds.
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

// The bits are the same in a header of shared memory and in a datagram.
const _: () = assert!(
    Flags::SIMULATED == LanFlags::SIMULATED
        && Flags::REPLAYED == LanFlags::REPLAYED
        && Flags::STAMP_ESTIMATED == LanFlags::STAMP_ESTIMATED
);
