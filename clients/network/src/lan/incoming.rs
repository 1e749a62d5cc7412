//! What a listener makes of datagrams: each is refused or counted, and a sample that is new comes out with all that is known
//! of it. Refuses to know sockets and clocks, and what becomes of samples.

mod duplicate_gateways;
mod guard;
mod parts;
mod peer_table;
mod remote;

use std::collections::HashMap;

use crate::lan::{Fresh, StreamStats};
use scanhub_schema::Topic;
use scanhub_schema::datagram::{Announce, Datagram, DatagramError, Head};

use crate::lan::{Key, Stamp};
use duplicate_gateways::DuplicateGateways;
pub use guard::GATEWAYS;
use guard::Guard;
use parts::Parts;
pub use peer_table::PeerTable;
pub use remote::Remote;

/// The incoming end: everything that was heard of any gateway.
pub struct Incoming {
    stats: Box<StreamStats>,
    peers: PeerTable,
    duplicates: DuplicateGateways,
    parts: Parts,
    /// Nothing is believed without it, if there is one.
    guard: Option<Guard>,
}

/// What a datagram is to who received it.
pub enum Arrived<'a> {
    /// It was refused.
    Refused {
        /// The reason, under which it is counted.
        why: DatagramError,
        /// The gateway's number, if two are known to send under it.
        shared: Option<u64>,
    },
    /// It is the first announcement of a sensor, and has the key, but is stamped by a clock that is so much behind ours, in
    /// ns, or was recorded so long ago; it was refused.
    Untimely {
        /// How much.
        behind_ns: i64,
    },
    /// It is a part of a sample that is not whole yet.
    Part,
    /// It came before, or announces what a newer one has announced.
    Known,
    /// It says who a sensor is.
    Announced(Announcement),
    /// It is a sample that did not come before.
    Sample(RemoteSample<'a>),
}

/// The newest announcement of a sensor.
pub struct Announcement {
    /// What it came with.
    pub head: Head,
    /// What it says.
    pub announce: Announce,
    /// CLOCK_MONOTONIC of this machine when it came, in ns.
    pub arrival_ns: u64,
    /// A life of its gateway begins with it.
    pub begins: bool,
    /// [`Incoming::written`] called the sensor by its number before, and now it has this name.
    pub is_named: bool,
    /// How much the gateway's clock is behind this one's, in ns, if they differ; said once of each gateway.
    pub behind_ns: Option<i64>,
    /// Whether its gateway had the key, or samples that it has sent cover a second or more.
    pub is_proven: bool,
}

/// A sample, and what is known of who sent it.
pub struct RemoteSample<'a> {
    /// The sample.
    pub remote: Remote<'a>,
    /// What was announced last of its sensor.
    pub announced: Option<Announce>,
    /// A life of its gateway begins with it.
    pub begins: bool,
    /// Samples of its topic that were sent before it and did not come, or not yet; 0 if it is late.
    pub missed: u32,
    /// Whether its gateway had the key, or samples that it has sent cover a second or more.
    pub is_proven: bool,
}

impl Arrived<'_> {
    /// Returns the header of a datagram with which a life of its gateway begins.
    pub fn begins(&self) -> Option<&Head> {
        match self {
            Arrived::Announced(announced) if announced.begins => Some(&announced.head),
            Arrived::Sample(sample) if sample.begins => Some(&sample.remote.datagram.head),
            _ => None,
        }
    }
}

impl Incoming {
    /// Makes an end that heard nothing yet. Announcements are believed for `topics` only, as [`StreamStats::new`] says.
    pub fn new(topics: &[Topic]) -> Incoming {
        Incoming {
            stats: Box::new(StreamStats::new(topics)),
            peers: PeerTable::default(),
            duplicates: DuplicateGateways::default(),
            parts: Parts::default(),
            guard: None,
        }
    }

    /// Makes an end that believes only what was sent with `key`, and is not older than it can be: `epochs` has the greatest
    /// epoch of each gateway that was heard before, see [`take_epochs`](Incoming::take_epochs); it knows [`GATEWAYS`] at most.
    pub fn with_key(topics: &[Topic], key: Key, epochs: HashMap<u64, u32>) -> Incoming {
        Incoming {
            stats: Box::new(StreamStats::new(topics).only_announced()),
            guard: Some(Guard::new(key, epochs)),
            ..Incoming::new(topics)
        }
    }

    /// Returns the greatest epochs of all gateways that had the key, to be kept, if one of them is new since the last call.
    pub fn take_epochs(&mut self) -> Option<&HashMap<u64, u32>> {
        self.guard.as_mut()?.take_changed()
    }

    /// Takes `bytes`, a whole datagram that came `from` a sender at `arrival`. A sender is any number that others do not
    /// have, for example its address and port. Where a sample came in parts, it is in `whole` once the last of them is there.
    pub fn receive<'a>(
        &mut self,
        bytes: &'a [u8],
        from: u64,
        arrival: Stamp,
        whole: &'a mut Vec<u8>,
    ) -> Arrived<'a> {
        let mut datagram = match self.stats.read(bytes) {
            Ok(datagram) => datagram,
            Err(why) => return Arrived::Refused { why, shared: None },
        };
        if let Some(guard) = &self.guard
            && let Err(why) = guard.check(bytes, &datagram, &self.stats, arrival.wall_ns)
        {
            self.stats.refuse(why);
            if why == DatagramError::Untimely && datagram.head.topic == Announce::NUMBER {
                return Arrived::Untimely {
                    behind_ns: arrival.wall_ns.wrapping_sub(datagram.head.stamp_ns) as i64,
                };
            }
            return Arrived::Refused { why, shared: None };
        }
        if datagram.head.parts > 1 {
            let is_known = match self.stats.check_part(&datagram.head) {
                Ok(is_known) => is_known,
                Err(why) => return Arrived::Refused { why, shared: None },
            };
            let Some(head) = self.parts.take(&datagram, from, is_known, whole) else { return Arrived::Part };
            datagram = Datagram { head, payload: whole, mac: None };
        }
        if let Some(guard) = &self.guard
            && guard.is_timely(&datagram.head, arrival.wall_ns)
        {
            self.stats.follow(&datagram, from, arrival.monotonic_ns);
        }
        match self.stats.take(&datagram, from, arrival.monotonic_ns) {
            Ok(Fresh::Duplicate) => Arrived::Known,
            Ok(fresh) => {
                if let Some(guard) = &mut self.guard {
                    guard.note(datagram.head.hub, datagram.head.epoch);
                }
                self.duplicates.taken(datagram.head.hub);
                self.accepted(datagram, fresh == Fresh::Late, arrival)
            }
            Err(why) => Arrived::Refused { why, shared: self.shared(why, &datagram.head, arrival) },
        }
    }

    /// Returns the account of all that came and did not.
    pub fn stats(&self) -> &StreamStats {
        &self.stats
    }

    /// Returns what sensors are called.
    pub fn peers(&self) -> &PeerTable {
        &self.peers
    }

    /// Returns what the sensor that sent `head` is called, to be written now: its name, or `#` and its number.
    pub fn written(&mut self, head: &Head) -> String {
        self.peers.written(head, &self.stats)
    }

    /// A datagram that was not there before.
    fn accepted<'a>(&mut self, datagram: Datagram<'a>, late: bool, arrival: Stamp) -> Arrived<'a> {
        let head = datagram.head;
        let begins = self.peers.is_new(&head, &self.stats);
        let Some(topic) = Topic::of_number(head.topic) else {
            // What it says was said again, and better, by a newer one.
            return if late { Arrived::Known } else { self.announced(&datagram, begins, arrival) };
        };
        let life = self.peers.life(&head, &self.stats);
        let age_ns = life.age_ns(head.stamp_ns, arrival.wall_ns);
        let sensor = life.sensor(head.sensor);
        let missed = if late { 0 } else { sensor.advance(head.topic, head.sequence) };
        let announced = sensor.announced;
        // What follows it is a later revision's.
        let telegram = datagram.telegram().filter(|_| topic == Topic::Telegram);
        let datagram =
            Datagram { payload: telegram.map_or(datagram.payload, |telegram| telegram.bytes), ..datagram };
        let boot = announced.map_or(0, |announced| announced.boot);
        let (arrival_ns, authenticated) = (arrival.monotonic_ns, self.guard.is_some());
        let is_proven = self.is_proven(&head);
        let remote = Remote { topic, datagram, boot, arrival_ns, age_ns, late, authenticated };
        Arrived::Sample(RemoteSample { remote, announced, begins, missed, is_proven })
    }

    fn is_proven(&self, head: &Head) -> bool {
        self.guard.is_some() || self.stats.is_proven(head.hub, head.epoch)
    }

    fn announced<'a>(&mut self, datagram: &Datagram<'a>, begins: bool, arrival: Stamp) -> Arrived<'a> {
        let head = datagram.head;
        let Some(announce) = Announce::unpack(datagram.payload) else { return Arrived::Known };
        let behind_ns = self.peers.announce(&head, &self.stats, &announce, arrival.wall_ns);
        let is_named = self.peers.life(&head, &self.stats).sensor(head.sensor).take_numbered();
        Arrived::Announced(Announcement {
            head,
            announce,
            arrival_ns: arrival.monotonic_ns,
            begins,
            is_named,
            behind_ns,
            is_proven: self.is_proven(&head),
        })
    }

    /// Whose number it is, if a sample with this `head`, that was refused, shows that two gateways have it.
    fn shared(&mut self, why: DatagramError, head: &Head, arrival: Stamp) -> Option<u64> {
        if !matches!(why, DatagramError::Epoch | DatagramError::Twin) {
            return None;
        }
        let Head { hub, epoch, .. } = *head;
        let is_shared =
            self.stats.is_shared(hub, epoch) || self.duplicates.refused(hub, arrival.monotonic_ns);
        is_shared.then_some(hub)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use scanhub_schema::Zones;
    use scanhub_schema::datagram::{HEAD, Packed};

    /// A datagram with zones, of gateway 5.
    fn zones(epoch: u32, sequence: u32) -> Vec<u8> {
        let mut buffer = [0; 100];
        let len = Zones::unknown().pack(&mut buffer[HEAD..]).unwrap();
        let topic = Topic::Zones.number();
        let head = Head { topic, revision: 1, hub: 5, epoch, sequence, ..Head::default() };
        head.seal(&mut buffer, len).unwrap().to_vec()
    }

    #[test]
    fn a_life_begins_once_also_where_datagrams_come_in_one_moment() {
        let mut incoming = Incoming::new(&Topic::ALL);
        let mut begins = |epoch, sequence, from, ms: u64| {
            let arrival = Stamp { monotonic_ns: ms * 1_000_000, wall_ns: 0 };
            let bytes = zones(epoch, sequence);
            let mut whole = Vec::new();
            let arrived = incoming.receive(&bytes, from, arrival, &mut whole);
            arrived.begins().map(|head| head.epoch)
        };
        assert_eq!([begins(7, 0, 1, 10), begins(7, 1, 1, 10), begins(7, 2, 1, 11)], [Some(7), None, None]);
        assert_eq!([begins(8, 0, 1, 11), begins(8, 1, 1, 11), begins(7, 3, 1, 11)], [Some(8), None, None]);
        assert_eq!([begins(8, 0, 2, 3000), begins(8, 0, 2, 3011)], [None, Some(8)], "another one's");
    }
}
