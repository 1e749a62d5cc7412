//! Who is heard: the lives of gateways, what their sensors are called, how their clocks stand against ours. Learned from
//! what an account has accepted, which also bounds it. Refuses to know what a sample says.

use std::collections::HashMap;

use schema::datagram::{Account, Announce, Head};

/// All lives of gateways that were heard, as long as the account keeps them apart.
#[derive(Default)]
pub(super) struct Roll {
    lives: HashMap<(u64, u32), Life>,
}

/// One life of one gateway.
#[derive(Default)]
pub(super) struct Life {
    sensors: HashMap<u8, Sensor>,
    delays: Delays,
}

/// One sensor in one life of its gateway.
#[derive(Default)]
pub(super) struct Sensor {
    /// What its announcement says of it, as soon as there was one.
    pub(super) announced: Option<Announce>,
    /// By topic's number: the greatest number that is known to have been sent.
    last: [Option<u32>; TOPICS],
}

/// More than there are topics.
const TOPICS: usize = 8;

impl Roll {
    /// The life that sent `head`, which `account` has taken.
    pub(super) fn life(&mut self, head: &Head, account: &Account) -> &mut Life {
        let life = (head.hub, head.epoch);
        if !self.lives.contains_key(&life) {
            self.lives.retain(|&(hub, epoch), _| account.knows(hub, epoch));
        }
        self.lives.entry(life).or_default()
    }

    /// What the sensor is called: its name, or `#` and its number as long as nobody announced it.
    pub(super) fn name(&self, hub: u64, epoch: u32, sensor: u8) -> String {
        let found = self.lives.get(&(hub, epoch)).and_then(|life| life.sensors.get(&sensor));
        match found.and_then(|sensor| sensor.announced.as_ref()) {
            Some(announced) => announced.sensor().to_owned(),
            None => format!("#{sensor}"),
        }
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
    /// theirs, in ns; said once.
    pub(super) fn announce(
        &mut self,
        sensor: u8,
        announce: &Announce,
        stamp_ns: u64,
        wall_ns: u64,
    ) -> Option<i64> {
        let known = self.sensor(sensor);
        for topic in announce.topics() {
            if let Some(last) = known.last.get_mut(usize::from(topic.topic)) {
                last.get_or_insert(topic.next.wrapping_sub(1));
            }
        }
        known.announced = Some(*announce);
        self.delays.add(wall_ns.wrapping_sub(stamp_ns) as i64);
        let difference_ns = self.delays.difference_ns()?;
        let is_news = difference_ns.unsigned_abs() > CLOCKS_AGREE_NS && !self.delays.told;
        self.delays.told |= is_news;
        is_news.then_some(difference_ns)
    }
}

impl Sensor {
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
    /// That the clocks differ was told.
    told: bool,
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

    use schema::datagram::{Announced, HEAD, LIVES, Packed};
    use schema::{Topic, Zones};

    const MS: u64 = 1_000_000;

    #[test]
    fn names_come_with_announcements() {
        let (mut roll, account) = (Roll::default(), Box::new(Account::new(&Topic::ALL)));
        let head = Head { hub: 5, epoch: 9, sensor: 1, ..Head::default() };
        roll.life(&head, &account).sensor(1);
        assert_eq!(roll.name(5, 9, 1), "#1");
        roll.life(&head, &account).announce(1, &Announce::new(3, "rear", ""), MS, MS);
        assert_eq!((roll.name(5, 9, 1).as_str(), roll.name(5, 8, 1).as_str()), ("rear", "#1"));
    }

    #[test]
    fn who_is_given_up_is_forgotten() {
        let (mut roll, mut account) = (Roll::default(), Box::new(Account::new(&Topic::ALL)));
        for epoch in 1..300 {
            let head = Head { topic: 4, revision: 1, hub: 5, epoch, ..Head::default() };
            let mut buffer = [0; 100];
            let len = Zones::unknown().pack(&mut buffer[HEAD..]).unwrap();
            account.receive(head.seal(&mut buffer, len).unwrap()).unwrap();
            roll.life(&head, &account).announce(0, &Announce::new(3, "rear", ""), MS, MS);
        }
        assert_eq!((roll.lives.len(), account.given_up().lives), (LIVES, 299 - LIVES as u64));
        assert_eq!((roll.name(5, 299, 0).as_str(), roll.name(5, 1, 0).as_str()), ("rear", "#0"));
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
        assert_eq!(life.sensor(0).advance(Topic::Marks.number(), u32::MAX), 0);
        assert_eq!(life.sensor(0).advance(Topic::Marks.number(), 1), 1);
    }

    #[test]
    fn clocks_that_differ_give_no_age_and_are_told_once() {
        let (mut life, announce) = (Life::default(), Announce::new(1, "front", ""));
        assert_eq!(life.age_ns(MS, 2 * MS), None, "not known yet");
        assert_eq!(life.announce(0, &announce, 100 * MS, 101 * MS), None);
        assert_eq!((life.age_ns(200 * MS, 230 * MS), life.age_ns(200 * MS, 199 * MS)), (Some(30 * MS), None));
        assert_eq!(life.announce(0, &announce, 100 * MS, 900 * MS), None, "one that waited");
        assert_eq!(life.announce(0, &announce, 3000 * MS, 1000 * MS), Some(-2000 * MS as i64));
        assert_eq!(life.announce(0, &announce, 4000 * MS, 2000 * MS), None);
        assert_eq!(life.age_ns(5000 * MS, 3030 * MS), None);
    }
}
