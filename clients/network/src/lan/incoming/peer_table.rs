//! Who is heard: the lives of gateways, what their sensors are called, how their clocks stand against ours. Learned from
//! what an account has accepted, which also bounds it. Refuses to know what a sample says.

use std::collections::{HashMap, HashSet};

use crate::lan::{LIVES, StreamStats};
use scanhub_schema::Topic;
use scanhub_schema::datagram::{Announce, Head};

/// All lives of gateways that were heard, as long as the account keeps them apart.
#[derive(Default)]
pub struct PeerTable {
    lives: HashMap<(u64, u32), Life>,
    /// The gateways of which it was told that their clocks differ, the first ones: whoever can send can invent more.
    told: HashSet<u64>,
}

/// One life of one gateway.
#[derive(Default)]
pub(super) struct Life {
    /// When the account took it: another time, and it is another one.
    since_ns: Option<u64>,
    sensors: HashMap<u8, Sensor>,
    delays: Delays,
}

/// One sensor in one life of its gateway.
#[derive(Default)]
pub(super) struct Sensor {
    /// What its announcement says of it, as soon as there was one.
    pub(super) announced: Option<Announce>,
    /// It was announced under another name before: the hub began anew with its sensors in another order.
    is_renamed: bool,
    /// Something was written of it under its number.
    is_numbered: bool,
    /// By topic's number: the greatest number that is known to have been sent.
    last: [Option<u32>; TOPICS],
}

/// By number, of which none is 0.
const TOPICS: usize = Topic::ALL.len() + 1;

impl PeerTable {
    /// Whether nothing of the life that sent `head`, which `stats` has taken, came before.
    pub(super) fn is_new(&self, head: &Head, stats: &StreamStats) -> bool {
        let since_ns = stats.since_ns(head.hub, head.epoch);
        self.lives.get(&(head.hub, head.epoch)).is_none_or(|known| known.since_ns != since_ns)
    }

    /// The life that sent `head`, which `stats` has taken.
    pub(super) fn life(&mut self, head: &Head, stats: &StreamStats) -> &mut Life {
        let life = (head.hub, head.epoch);
        let since_ns = stats.since_ns(head.hub, head.epoch);
        if self.is_new(head, stats) {
            self.lives.retain(|&(hub, epoch), known| stats.since_ns(hub, epoch) == known.since_ns);
        }
        self.lives.entry(life).or_insert_with(|| Life { since_ns, ..Life::default() })
    }

    /// An announcement that came with `head`, which `stats` has taken, at `wall_ns`. If it tells that the clocks differ, how
    /// much ours is ahead of theirs, in ns; said once of each gateway, however often that is started anew.
    pub(super) fn announce(
        &mut self,
        head: &Head,
        stats: &StreamStats,
        announce: &Announce,
        wall_ns: u64,
    ) -> Option<i64> {
        let difference_ns = self.life(head, stats).announce(head.sensor, announce, head.stamp_ns, wall_ns)?;
        let is_new = self.told.len() < LIVES && self.told.insert(head.hub);
        is_new.then_some(difference_ns)
    }

    /// Returns what the sensor is called: its name, or `#` and its number as long as nobody announced it.
    pub fn name(&self, hub: u64, epoch: u32, sensor: u8) -> String {
        let announced = self.sensor(hub, epoch, sensor).and_then(|sensor| sensor.announced.as_ref());
        announced.map_or_else(|| format!("#{sensor}"), |announced| announced.sensor().to_owned())
    }

    /// What the sensor that sent `head` is called, to be written now.
    pub(super) fn written(&mut self, head: &Head, stats: &StreamStats) -> String {
        let sensor = self.life(head, stats).sensor(head.sensor);
        sensor.is_numbered |= sensor.announced.is_none();
        self.name(head.hub, head.epoch, head.sensor)
    }

    /// Returns of whom a row of the account is: as [`name`](Self::name), but `#` and the number also where it had several names,
    /// for the row counts what was sent under each of them.
    pub fn row_name(&self, hub: u64, epoch: u32, sensor: u8) -> String {
        match self.sensor(hub, epoch, sensor) {
            Some(known) if known.is_renamed => format!("#{sensor}"),
            _ => self.name(hub, epoch, sensor),
        }
    }

    /// Returns how many samples of the topic with this number were replaced by newer ones before they were sent, as last
    /// announced; nothing if that was not said.
    pub fn replaced(&self, hub: u64, epoch: u32, sensor: u8, topic: u8) -> Option<u32> {
        self.announced(hub, epoch, sensor)?.replaced(topic)
    }

    /// Returns what was announced last of a sensor.
    pub fn announced(&self, hub: u64, epoch: u32, sensor: u8) -> Option<&Announce> {
        self.sensor(hub, epoch, sensor)?.announced.as_ref()
    }

    fn sensor(&self, hub: u64, epoch: u32, sensor: u8) -> Option<&Sensor> {
        self.lives.get(&(hub, epoch))?.sensors.get(&sensor)
    }
}

impl Life {
    /// The sensor `number`.
    pub(super) fn sensor(&mut self, number: u8) -> &mut Sensor {
        self.sensors.entry(number).or_default()
    }

    /// How old what was stamped at `stamp_ns` was when it came at `wall_ns`, in ns. Nothing as long as it is not known
    /// how the clocks stand, and where they differ too much for an age to say anything.
    pub(super) fn age_ns(&self, stamp_ns: u64, wall_ns: u64) -> Option<u64> {
        if self.delays.difference_ns()?.unsigned_abs() > CLOCKS_AGREE_NS {
            return None;
        }
        wall_ns.checked_sub(stamp_ns)
    }

    /// An announcement of `sensor` came at `wall_ns`. If it tells that the clocks differ, how much ours is ahead of
    /// theirs, in ns.
    fn announce(&mut self, sensor: u8, announce: &Announce, stamp_ns: u64, wall_ns: u64) -> Option<i64> {
        let known = self.sensor(sensor);
        for topic in announce.topics() {
            if let Some(last) = known.last.get_mut(usize::from(topic.topic)) {
                last.get_or_insert(topic.next.wrapping_sub(1));
            }
        }
        let before = known.announced.replace(*announce);
        known.is_renamed |= before.is_some_and(|before| before.sensor() != announce.sensor());
        self.delays.add(wall_ns.wrapping_sub(stamp_ns) as i64);
        self.delays.difference_ns().filter(|difference_ns| difference_ns.unsigned_abs() > CLOCKS_AGREE_NS)
    }
}

impl Sensor {
    /// Whether it was written of under its number; told once.
    pub(super) fn take_numbered(&mut self) -> bool {
        std::mem::take(&mut self.is_numbered)
    }

    /// A number of a topic came that is greater than all before; how many between did not.
    pub(super) fn advance(&mut self, topic: u8, sequence: u32) -> u32 {
        let Some(last) = self.last.get_mut(usize::from(topic)) else { return 0 };
        let missed = last.map_or(0, |last| sequence.wrapping_sub(last).wrapping_sub(1));
        *last = Some(sequence);
        // Before an announcement that was overtaken.
        if missed > u32::MAX / 2 { 0 } else { missed }
    }
}

/// Announcements are stamped when they are sent, so that what they take to come is the way and the difference of the
/// clocks. The shortest of the last ones is the least disturbed.
#[derive(Default)]
struct Delays {
    last_ns: [i64; DELAYS],
    count: usize,
}

/// Announcements that count for the difference of clocks: of two sensors those of the last five seconds.
const DELAYS: usize = 10;

/// Clocks that differ by less than so are taken as one. An age is at least the time that a telegram takes on its line,
/// 15 ms and more.
const CLOCKS_AGREE_NS: u64 = 20_000_000;

impl Delays {
    fn add(&mut self, delay_ns: i64) {
        self.last_ns[self.count % DELAYS] = delay_ns;
        self.count += 1;
    }

    /// By how much our clock is ahead, and the shortest way.
    fn difference_ns(&self) -> Option<i64> {
        self.last_ns[..self.count.min(DELAYS)].iter().min().copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use scanhub_schema::Zones;
    use scanhub_schema::datagram::{Announced, HEAD, Packed};

    const MS: u64 = 1_000_000;

    #[test]
    fn names_come_with_announcements() {
        let (mut peers, stats) = (PeerTable::default(), Box::new(StreamStats::new(&Topic::ALL)));
        let head = Head { hub: 5, epoch: 9, sensor: 1, ..Head::default() };
        peers.life(&head, &stats).sensor(1);
        assert_eq!(peers.name(5, 9, 1), "#1");
        peers.life(&head, &stats).announce(1, &Announce::new(3, "rear", ""), MS, MS);
        assert_eq!((peers.name(5, 9, 1).as_str(), peers.name(5, 8, 1).as_str()), ("rear", "#1"));
        assert_eq!(peers.row_name(5, 9, 1), "rear");
    }

    #[test]
    fn a_row_of_two_sensors_has_the_name_of_neither() {
        let (mut peers, stats) = (PeerTable::default(), Box::new(StreamStats::new(&Topic::ALL)));
        let head = Head { hub: 5, epoch: 9, ..Head::default() };
        let mut announce = |boot, name| {
            peers.life(&head, &stats).announce(0, &Announce::new(boot, name, ""), MS, MS);
            (peers.name(5, 9, 0), peers.row_name(5, 9, 0))
        };
        assert_eq!(announce(3, "front"), ("front".into(), "front".into()));
        assert_eq!(announce(4, "front"), ("front".into(), "front".into()), "the hub's next life");
        assert_eq!(announce(5, "rear"), ("rear".into(), "#0".into()));
        assert_eq!(announce(6, "front"), ("front".into(), "#0".into()));
    }

    #[test]
    fn who_is_given_up_is_forgotten() {
        let (mut peers, mut stats) = (PeerTable::default(), Box::new(StreamStats::new(&Topic::ALL)));
        for epoch in 1..300 {
            let head = Head { topic: 4, revision: 1, hub: 5, epoch, ..Head::default() };
            let mut buffer = [0; 100];
            let len = Zones::unknown().pack(&mut buffer[HEAD..]).unwrap();
            stats.receive(head.seal(&mut buffer, len).unwrap(), 1, 0).unwrap();
            peers.life(&head, &stats).announce(0, &Announce::new(3, "rear", ""), MS, MS);
        }
        assert_eq!((peers.lives.len(), stats.given_up().lives), (LIVES, 299 - LIVES as u64));
        assert_eq!((peers.name(5, 299, 0).as_str(), peers.name(5, 1, 0).as_str()), ("rear", "#0"));
    }

    #[test]
    fn gaps_are_counted_from_what_is_known() {
        let mut life = Life::default();
        let zones = Topic::Zones.number();
        assert_eq!(life.sensor(0).advance(zones, 70), 0, "what was before is not ours");
        assert_eq!(life.sensor(0).advance(zones, 74), 3);
        let mut announce = Announce::new(1, "front", "");
        for topic in [zones, Topic::Scan.number()] {
            announce.add(Announced { topic, group: 81, port: 22_200, next: 80 });
        }
        life.announce(0, &announce, 0, 0);
        assert_eq!(life.sensor(0).advance(zones, 75), 0);
        assert_eq!(life.sensor(0).advance(Topic::Scan.number(), 82), 2);
        for topic in Topic::ALL.into_iter().filter(|topic| ![Topic::Zones, Topic::Scan].contains(topic)) {
            assert_eq!(life.sensor(0).advance(topic.number(), u32::MAX), 0, "{topic:?}");
            assert_eq!(life.sensor(0).advance(topic.number(), 1), 1, "{topic:?}");
        }
    }

    #[test]
    fn clocks_that_differ_give_no_age_and_are_told_once() {
        let (mut peers, stats) = (PeerTable::default(), Box::new(StreamStats::new(&Topic::ALL)));
        let head = |epoch, stamp_ms| Head { hub: 5, epoch, stamp_ns: stamp_ms * MS, ..Head::default() };
        let age_ns = |peers: &mut PeerTable, stamp_ms, wall_ms| {
            peers.life(&head(1, 0), &stats).age_ns(stamp_ms * MS, wall_ms * MS)
        };
        let announce = |peers: &mut PeerTable, epoch, stamp_ms, wall_ms| {
            let announce = Announce::new(1, "front", "");
            peers.announce(&head(epoch, stamp_ms), &stats, &announce, wall_ms * MS)
        };
        assert_eq!(age_ns(&mut peers, 1, 2), None, "not known yet");
        assert_eq!(announce(&mut peers, 1, 100, 101), None);
        assert_eq!((age_ns(&mut peers, 200, 230), age_ns(&mut peers, 200, 199)), (Some(30 * MS), None));
        assert_eq!(announce(&mut peers, 1, 100, 900), None, "one that waited");
        assert_eq!(announce(&mut peers, 1, 3000, 1000), Some(-2000 * MS as i64));
        assert_eq!(announce(&mut peers, 1, 4000, 2000), None);
        assert_eq!(age_ns(&mut peers, 5000, 3030), None);
        assert!((2..1000).all(|epoch| announce(&mut peers, epoch, 3000, 1000).is_none()), "the same gateway");
    }
}
