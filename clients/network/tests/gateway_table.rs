//! The receiver's account against a slow model that keeps every number, under whatever a network and strangers do.

use std::collections::{BTreeMap, BTreeSet};

use fastrand::Rng;
use scanhub_network::lan::{EvictedTotals, Fresh, GatewayTable, MAX_ROWS, MAX_RUNS, WINDOW};
use scanhub_schema::datagram::{Announce, Announced, DatagramError, HEAD, Head, Packed};
use scanhub_schema::{Background, Marks, Topic, Zones};

/// Hub, epoch, sensor, topic.
type Key = (u64, u32, u8, u8);

/// What a datagram is, known without looking at its bytes: numbers do not wrap.
#[derive(Clone)]
struct Sent {
    key: Key,
    number: u64,
    /// Of an announcement: the next numbers.
    next: Vec<(u8, u64)>,
    bytes: Vec<u8>,
}

impl Sent {
    fn new(key: Key, number: u64, next: Vec<(u8, u64)>) -> Sent {
        let (hub, epoch, sensor, topic) = key;
        let mut buffer = [0; 200];
        let room = &mut buffer[HEAD..];
        let len = match Topic::of_number(topic) {
            None => {
                let mut announce = Announce::new(1, "front", "");
                for &(topic, next) in &next {
                    announce.add(Announced { topic, group: 81, port: 22_200, next: next as u32 });
                }
                announce.pack(room)
            }
            Some(Topic::Marks) => Marks::default().pack(room),
            Some(Topic::Background) => Box::<Background>::default().pack(room),
            Some(_) => Zones::unknown().pack(room),
        };
        let head =
            Head { topic, hub, epoch, sequence: number as u32, sensor, revision: 1, ..Head::default() };
        let bytes = head.seal(&mut buffer, len.unwrap()).unwrap().to_vec();
        Sent { key, number, next, bytes }
    }
}

/// All numbers that came.
#[derive(Default)]
struct Numbers {
    came: BTreeSet<u64>,
    expected: BTreeSet<u64>,
    duplicate: u64,
    reordered: u64,
}

#[derive(Default)]
struct Model {
    rows: BTreeMap<Key, Numbers>,
    /// The greatest epoch of each hub.
    living: BTreeMap<u64, u32>,
    /// When they were heard last, and when the first and the last sample came, in ms.
    heard: BTreeMap<u64, (u64, Option<(u64, u64)>)>,
    /// The others, in the order in which they were retired.
    retired: Vec<(u64, u32)>,
    given_up: EvictedTotals,
    refused: BTreeMap<&'static str, u64>,
}

impl Model {
    fn receive(&mut self, sent: &Sent, now_ms: u64) -> Result<Fresh, DatagramError> {
        let result = self.take(sent, now_ms);
        if let Err(refusal) = result {
            *self.refused.entry(refusal.name()).or_default() += 1;
        }
        result
    }

    fn take(&mut self, sent: &Sent, now_ms: u64) -> Result<Fresh, DatagramError> {
        let (hub, epoch, sensor, topic) = sent.key;
        let delivers = topic != Announce::NUMBER;
        let before = self.living.get(&hub).copied();
        if before.is_some_and(|greatest| greatest > epoch) {
            return Err(DatagramError::Epoch);
        }
        let highest = self.rows.get(&sent.key).and_then(|row| row.came.last().copied());
        if highest.is_some_and(|highest| highest >= sent.number + WINDOW as u64) {
            return Err(DatagramError::Stale);
        }
        let is_new = before != Some(epoch);
        let lives = self.living.len() + self.retired.len();
        let is_full = self.rows.len() == MAX_ROWS || is_new && lives == MAX_RUNS;
        let has_retired = !self.retired.is_empty() || before.is_some_and(|older| older < epoch);
        let can_give_up = has_retired || self.least(hub, delivers, now_ms).is_some();
        if !self.rows.contains_key(&sent.key) && is_full && !can_give_up {
            return Err(DatagramError::Capacity);
        }
        if is_new {
            self.retired.extend(before.map(|older| (hub, older)));
            self.living.remove(&hub);
            self.heard.remove(&hub);
            if lives == MAX_RUNS {
                self.give_up(hub, delivers, now_ms);
            }
            self.living.insert(hub, epoch);
        }
        let (heard, delivered) = self.heard.entry(hub).or_default();
        *heard = now_ms;
        if delivers {
            *delivered = Some((delivered.map_or(now_ms, |(first, _)| first), now_ms));
        }
        assert!(self.has_room(sent.key, delivers, now_ms));
        let row = self.rows.entry(sent.key).or_default();
        let fresh = match highest {
            _ if row.came.contains(&sent.number) => Fresh::Duplicate,
            Some(highest) if highest > sent.number => Fresh::Late,
            _ => Fresh::New,
        };
        row.duplicate += u64::from(fresh == Fresh::Duplicate);
        row.reordered += u64::from(fresh == Fresh::Late);
        row.came.insert(sent.number);
        row.expect(sent.number, sent.number + 1);
        for &(topic, next) in &sent.next {
            let key = (hub, epoch, sensor, topic);
            if self.has_room(key, delivers, now_ms) {
                self.rows.entry(key).or_default().expect(next, next);
            }
        }
        Ok(fresh)
    }

    /// There is a row, or there can be one, after another life was given up if need be.
    fn has_room(&mut self, key: Key, delivers: bool, now_ms: u64) -> bool {
        if !self.rows.contains_key(&key) && self.rows.len() == MAX_ROWS {
            self.give_up(key.0, delivers, now_ms);
        }
        self.rows.contains_key(&key) || self.rows.len() < MAX_ROWS
    }

    /// The gateway that makes room for a datagram of `hub`, if nothing is retired.
    fn least(&self, hub: u64, delivers: bool, now_ms: u64) -> Option<u64> {
        let mut least: Option<(u64, u64)> = None;
        for (&other, &(heard, delivered)) in &self.heard {
            let (mut kept_until, mut is_proven, mut is_busy) = (heard, false, false);
            if let Some((first, last)) = delivered {
                is_proven = last >= first + 1_000;
                is_busy = now_ms < last + 3_000;
                kept_until = last + if is_proven { 60_000 } else { 3_000 };
            }
            let may_go = other != hub && if delivers { !is_busy || !is_proven } else { !is_busy };
            if may_go && least.is_none_or(|(until, _)| kept_until < until) {
                least = Some((kept_until, other));
            }
        }
        least.map(|(_, other)| other)
    }

    fn give_up(&mut self, hub: u64, delivers: bool, now_ms: u64) {
        let life = if self.retired.is_empty() {
            let Some(other) = self.least(hub, delivers, now_ms) else { return };
            self.heard.remove(&other);
            self.given_up.displaced += 1;
            (other, self.living.remove(&other).unwrap())
        } else {
            self.retired.remove(0)
        };
        let sum = &mut self.given_up;
        sum.runs += 1;
        self.rows.retain(|&(hub, epoch, ..), row| {
            if (hub, epoch) != life {
                return true;
            }
            let received = row.came.len() as u64;
            sum.received += received;
            sum.lost += row.sent() - received;
            sum.duplicate += row.duplicate;
            sum.reordered += row.reordered;
            false
        });
    }

    /// Received, lost, duplicate, reordered.
    fn figures(&self) -> BTreeMap<Key, [u64; 4]> {
        let all = self.rows.iter().map(|(&key, row)| {
            let received = row.came.len() as u64;
            (key, [received, row.sent() - received, row.duplicate, row.reordered])
        });
        all.filter(|(_, figures)| figures[0] + figures[1] > 0).collect()
    }
}

impl Numbers {
    /// `first` to `next` were sent, if `first` is one; nothing is known of what is before the first announcement.
    fn expect(&mut self, first: u64, next: u64) {
        let known_first = self.expected.first().copied().unwrap_or(first);
        // An announcement alone moves no beginning.
        let first = if first == next { known_first } else { first.min(known_first) };
        self.expected.extend([first, next.max(first)]);
    }

    fn sent(&self) -> u64 {
        self.expected.last().unwrap() - self.expected.first().unwrap()
    }
}

fn figures(account: &GatewayTable) -> BTreeMap<Key, [u64; 4]> {
    let rows = account.rows();
    rows.map(|row| {
        let key = (row.hub, row.epoch, row.sensor, row.topic);
        (key, [row.received, row.lost(), row.duplicate, row.reordered])
    })
    .collect()
}

/// Gateways that send, restart and announce, and a network between.
struct World {
    random: Rng,
    now: u64,
    /// By hub and sensor: the epoch and the next number of each topic, announce first.
    gateways: Vec<(u64, u32, u8, Vec<u64>)>,
    /// By time of arrival.
    underway: BTreeMap<(u64, u64), Sent>,
    count: u64,
    /// One datagram of a stranger to so many of the gateways.
    strangers: u8,
    /// So many strangers.
    crowd: u64,
}

impl World {
    fn new(seed: u64) -> World {
        let mut random = Rng::with_seed(seed);
        let start = |random: &mut Rng| {
            // Some begin close to the end of 32 bits.
            let near = (1 << 32) - random.u64(..2_000);
            [0, near, 1 << 31][random.usize(..3)]
        };
        let mut gateways = Vec::new();
        for hub in 0..random.u64(1..4) {
            for sensor in 0..random.u8(1..4) {
                gateways.push((hub, 1, sensor, (0..4).map(|_| (1 << 33) + start(&mut random)).collect()));
            }
        }
        let (strangers, crowd) = ([60, 5][random.usize(..2)], [30, 70][random.usize(..2)]);
        World { random, now: 0, gateways, underway: BTreeMap::new(), count: 0, strangers, crowd }
    }

    /// One datagram goes out, and all that arrive meanwhile come back.
    fn step(&mut self) -> Vec<Sent> {
        self.now += 1;
        let at = self.random.usize(..self.gateways.len());
        let life = self.random.u32(..12_000);
        let (hub, epoch, sensor, next) = &mut self.gateways[at];
        if life == 0 {
            *epoch += self.random.u32(1..3);
            next.fill(0);
        }
        let topic = self.random.usize(..4);
        let key = (*hub, *epoch, *sensor, TOPICS[topic]);
        let announced: Vec<(u8, u64)> = TOPICS.into_iter().zip(next.iter().copied()).skip(1).collect();
        let sent = Sent::new(key, next[topic], if topic == 0 { announced } else { Vec::new() });
        next[topic] += 1;
        if self.random.u8(..20) > 0 {
            self.carry(sent.clone());
        }
        if self.random.u8(..20) == 0 {
            self.carry(sent);
        }
        // A stranger.
        if self.random.u8(..self.strangers) == 0 {
            let topic = [Announce::NUMBER, 4, 4, 4][self.random.usize(..4)];
            let hub = 100 + self.random.u64(..self.crowd);
            let key = (hub, self.random.u32(1..3), self.random.u8(..), topic);
            self.carry(Sent::new(key, 1 << 33, Vec::new()));
        }
        let later = self.underway.split_off(&(self.now, 0));
        std::mem::replace(&mut self.underway, later).into_values().collect()
    }

    fn carry(&mut self, sent: Sent) {
        let delay = match self.random.u8(..100) {
            0 => self.random.u64(..20_000),
            1..10 => self.random.u64(..100),
            _ => 0,
        };
        self.count += 1;
        self.underway.insert((self.now + delay, self.count), sent);
    }
}

#[test]
fn it_says_what_a_model_says_that_keeps_everything() {
    let (mut refused, mut full, mut given_up, mut displaced) = (BTreeMap::new(), 0, 0, 0);
    for seed in 0..20 {
        let mut world = World::new(seed);
        let (mut account, mut model) = (GatewayTable::new(&Topic::ALL), Model::default());
        // All that deliver are busy, or hardly any is.
        let (mut ticks, tick_ms) = (0, [1, 40][seed as usize % 2]);
        for step in 0..16_000 {
            for sent in world.step() {
                // One clock tick each: who was not heard for longest is never two.
                ticks += 1;
                let now_ms = ticks * tick_ms;
                let fresh = account.receive(&sent.bytes, 1, now_ms * 1_000_000).map(|(_, fresh)| fresh);
                assert_eq!(
                    fresh,
                    model.receive(&sent, now_ms),
                    "seed {seed}, step {step}, {:?}",
                    (sent.key, sent.number)
                );
            }
            if step % 1_000 == 0 {
                assert_eq!(figures(&account), model.figures(), "seed {seed}, step {step}");
            }
        }
        full += u32::from(model.rows.len() == MAX_ROWS);
        given_up += model.given_up.runs;
        displaced += model.given_up.displaced;
        assert_eq!((figures(&account), account.evicted()), (model.figures(), model.given_up), "seed {seed}");
        for refusal in DatagramError::ALL {
            let count = model.refused.get(refusal.name()).copied().unwrap_or_default();
            assert_eq!(account.refused(refusal), count, "seed {seed}, {}", refusal.name());
            *refused.entry(refusal.name()).or_insert(0) += count;
        }
    }
    // The network did what it was made for.
    assert!(full > 0 && given_up > 100, "{full} full, {given_up} lives given up");
    assert!(displaced > 100 && given_up > displaced, "{displaced} of them not over");
    for refusal in [DatagramError::Epoch, DatagramError::Stale, DatagramError::Capacity] {
        assert!(refused[refusal.name()] > 0, "nothing was ever {}", refusal.name());
    }
}

/// With an announcement before and one behind, what is lost is what a relay dropped, whichever that was.
#[test]
fn it_is_the_log_of_a_relay() {
    const SENT: u64 = 5_000;
    let topic = Topic::Zones.number();
    for seed in 0..50 {
        let mut random = Rng::with_seed(seed);
        let first = (1 << 33) - random.u64(..2 * SENT);
        let announce =
            |number: u64, next| Sent::new((1, 1, 0, Announce::NUMBER), number, vec![(topic, next)]);
        let (mut dropped, mut doubled) = (0, 0);
        let mut arrivals = Vec::new();
        for number in first..first + SENT {
            let sent = Sent::new((1, 1, 0, topic), number, Vec::new());
            let late = if random.u8(..20) == 0 { random.u64(..1_000) } else { 0 };
            match random.u8(..100) {
                0..5 => dropped += 1,
                5..7 => {
                    doubled += 1;
                    arrivals.extend([(number + late, sent.clone()), (number + random.u64(..20), sent)]);
                }
                _ => arrivals.push((number + late, sent)),
            }
        }
        arrivals.sort_by_key(|&(at, _)| at);
        let mut account = GatewayTable::new(&Topic::ALL);
        let (mut highest, mut below, mut came) = (0, 0, BTreeSet::new());
        account.receive(&announce(0, first).bytes, 1, 0).unwrap();
        for (_, sent) in &arrivals {
            account.receive(&sent.bytes, 1, 0).unwrap();
            below += u64::from(came.insert(sent.number) && sent.number < highest);
            highest = highest.max(sent.number);
        }
        account.receive(&announce(1, first + SENT).bytes, 1, 0).unwrap();
        let expected = [SENT - dropped, dropped, doubled, below];
        assert_eq!(figures(&account)[&(1, 1, 0, topic)], expected, "seed {seed}");
        assert!(dropped > 100 && doubled > 30 && below > 100);
    }
}

/// Announce, marks, zones, background.
const TOPICS: [u8; 4] = [Announce::NUMBER, 3, 4, 6];
