//! Compares the table of gateways with a slow model that keeps every number, while a network loses and reorders
//! datagrams and strangers invent gateways.

use std::collections::{BTreeMap, BTreeSet};

use fastrand::Rng;
use scanhub_network::lan::{EvictedTotals, GatewayTable, MAX_ROWS, MAX_RUNS, SequenceStatus, WINDOW_LEN};
use scanhub_schema::datagram::{Announce, Announced, DatagramError, DatagramPayload, HEADER_LEN, Head};
use scanhub_schema::{Background, Marks, Topic, Zones};

/// Hub, epoch, sensor, topic.
type StreamKey = (u64, u32, u8, u8);

/// Content of a datagram, with numbers that do not wrap.
#[derive(Clone)]
struct SentDatagram {
    key: StreamKey,
    number: u64,
    /// Next number of each topic in an announcement.
    next: Vec<(u8, u64)>,
    bytes: Vec<u8>,
}

impl SentDatagram {
    fn new(key: StreamKey, number: u64, next: Vec<(u8, u64)>) -> SentDatagram {
        let (hub, epoch, sensor, topic) = key;
        let mut buffer = [0; 200];
        let room = &mut buffer[HEADER_LEN..];
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
        SentDatagram { key, number, next, bytes }
    }
}

/// All numbers of one stream that arrived, and the first and last ones that are expected.
#[derive(Default)]
struct ExpectedCounters {
    arrived: BTreeSet<u64>,
    expected: BTreeSet<u64>,
    duplicate: u64,
    reordered: u64,
}

/// Slow model of the table of gateways, which keeps all numbers.
#[derive(Default)]
struct TableModel {
    rows: BTreeMap<StreamKey, ExpectedCounters>,
    /// Highest epoch of each hub.
    active: BTreeMap<u64, u32>,
    /// For each hub with an active run, the times of its last datagram, and of its first and last sample, in ms.
    times: BTreeMap<u64, (u64, Option<(u64, u64)>)>,
    /// Other runs, in the order in which they retired.
    retired: Vec<(u64, u32)>,
    evicted: EvictedTotals,
    refused: BTreeMap<&'static str, u64>,
}

impl TableModel {
    fn receive(&mut self, sent: &SentDatagram, now_ms: u64) -> Result<SequenceStatus, DatagramError> {
        let result = self.take(sent, now_ms);
        if let Err(refusal) = result {
            *self.refused.entry(refusal.name()).or_default() += 1;
        }
        result
    }

    fn take(&mut self, sent: &SentDatagram, now_ms: u64) -> Result<SequenceStatus, DatagramError> {
        let (hub, epoch, sensor, topic) = sent.key;
        let delivers = topic != Announce::NUMBER;
        let before = self.active.get(&hub).copied();
        if before.is_some_and(|greatest| greatest > epoch) {
            return Err(DatagramError::Epoch);
        }
        let highest = self.rows.get(&sent.key).and_then(|row| row.arrived.last().copied());
        if highest.is_some_and(|highest| highest >= sent.number + WINDOW_LEN as u64) {
            return Err(DatagramError::Stale);
        }
        let is_new = before != Some(epoch);
        let runs = self.active.len() + self.retired.len();
        let is_full = self.rows.len() == MAX_ROWS || is_new && runs == MAX_RUNS;
        let has_retired = !self.retired.is_empty() || before.is_some_and(|older| older < epoch);
        let can_evict = has_retired || self.next_evicted(hub, delivers, now_ms).is_some();
        if !self.rows.contains_key(&sent.key) && is_full && !can_evict {
            return Err(DatagramError::Capacity);
        }
        if is_new {
            self.retired.extend(before.map(|older| (hub, older)));
            self.active.remove(&hub);
            self.times.remove(&hub);
            if runs == MAX_RUNS {
                self.evict(hub, delivers, now_ms);
            }
            self.active.insert(hub, epoch);
        }
        let (received_at, delivered) = self.times.entry(hub).or_default();
        *received_at = now_ms;
        if delivers {
            *delivered = Some((delivered.map_or(now_ms, |(first, _)| first), now_ms));
        }
        assert!(self.has_room(sent.key, delivers, now_ms));
        let row = self.rows.entry(sent.key).or_default();
        let fresh = match highest {
            _ if row.arrived.contains(&sent.number) => SequenceStatus::Duplicate,
            Some(highest) if highest > sent.number => SequenceStatus::Late,
            _ => SequenceStatus::New,
        };
        row.duplicate += u64::from(fresh == SequenceStatus::Duplicate);
        row.reordered += u64::from(fresh == SequenceStatus::Late);
        row.arrived.insert(sent.number);
        row.expect(sent.number, sent.number + 1);
        for &(topic, next) in &sent.next {
            let key = (hub, epoch, sensor, topic);
            if self.has_room(key, delivers, now_ms) {
                self.rows.entry(key).or_default().expect(next, next);
            }
        }
        Ok(fresh)
    }

    /// Returns whether the stream `key` has a row, or there is room for one. Evicts another run if necessary.
    fn has_room(&mut self, key: StreamKey, is_delivering: bool, now_ms: u64) -> bool {
        if !self.rows.contains_key(&key) && self.rows.len() == MAX_ROWS {
            self.evict(key.0, is_delivering, now_ms);
        }
        self.rows.contains_key(&key) || self.rows.len() < MAX_ROWS
    }

    /// Returns the active gateway that makes room for a datagram of `hub` if no run is retired.
    fn next_evicted(&self, hub: u64, is_delivering: bool, now_ms: u64) -> Option<u64> {
        let mut minimum: Option<(u64, u64)> = None;
        for (&other, &(received_at, delivered)) in &self.times {
            let (mut kept_until, mut is_proven, mut is_busy) = (received_at, false, false);
            if let Some((first, last)) = delivered {
                is_proven = last >= first + 1_000;
                is_busy = now_ms < last + 3_000;
                kept_until = last + if is_proven { 60_000 } else { 3_000 };
            }
            let may_go = other != hub && if is_delivering { !is_busy || !is_proven } else { !is_busy };
            if may_go && minimum.is_none_or(|(until, _)| kept_until < until) {
                minimum = Some((kept_until, other));
            }
        }
        minimum.map(|(_, other)| other)
    }

    fn evict(&mut self, hub: u64, is_delivering: bool, now_ms: u64) {
        let evicted = if self.retired.is_empty() {
            let Some(other) = self.next_evicted(hub, is_delivering, now_ms) else { return };
            self.times.remove(&other);
            self.evicted.evicted_active += 1;
            (other, self.active.remove(&other).unwrap())
        } else {
            self.retired.remove(0)
        };
        let sum = &mut self.evicted;
        sum.runs += 1;
        self.rows.retain(|&(hub, epoch, ..), row| {
            if (hub, epoch) != evicted {
                return true;
            }
            let received = row.arrived.len() as u64;
            sum.received += received;
            sum.lost += row.sent() - received;
            sum.duplicate += row.duplicate;
            sum.reordered += row.reordered;
            false
        });
    }

    /// Returns the received, lost, duplicate and reordered numbers of each stream.
    fn counters(&self) -> BTreeMap<StreamKey, [u64; 4]> {
        let all = self.rows.iter().map(|(&key, row)| {
            let received = row.arrived.len() as u64;
            (key, [received, row.sent() - received, row.duplicate, row.reordered])
        });
        all.filter(|(_, figures)| figures[0] + figures[1] > 0).collect()
    }
}

impl ExpectedCounters {
    /// Records that the numbers from `first` to `next` were sent. Numbers before the first announcement are unknown.
    fn expect(&mut self, first: u64, next: u64) {
        let known_first = self.expected.first().copied().unwrap_or(first);
        // An announcement alone does not move the start.
        let first = if first == next { known_first } else { first.min(known_first) };
        self.expected.extend([first, next.max(first)]);
    }

    fn sent(&self) -> u64 {
        self.expected.last().unwrap() - self.expected.first().unwrap()
    }
}

fn table_counters(table: &GatewayTable) -> BTreeMap<StreamKey, [u64; 4]> {
    let rows = table.rows();
    rows.map(|row| {
        let key = (row.hub, row.epoch, row.sensor, row.topic);
        (key, [row.received, row.lost(), row.duplicate, row.reordered])
    })
    .collect()
}

/// A network, and the gateways that send, restart and announce in it.
struct SimulatedNetwork {
    random: Rng,
    now: u64,
    /// Hub, epoch, sensor, and the next number of each topic, announcements first.
    gateways: Vec<(u64, u32, u8, Vec<u64>)>,
    /// Datagrams on their way, by time of arrival and order of sending.
    in_transit: BTreeMap<(u64, u64), SentDatagram>,
    count: u64,
    /// Average number of datagrams of the gateways for each datagram of a stranger.
    unknown_hubs: u8,
    /// Number of strangers.
    gateway_count: u64,
}

impl SimulatedNetwork {
    fn new(seed: u64) -> SimulatedNetwork {
        let mut random = Rng::with_seed(seed);
        let start = |random: &mut Rng| {
            // Some numbers start just below 2^32, so that they wrap.
            let near = (1 << 32) - random.u64(..2_000);
            [0, near, 1 << 31][random.usize(..3)]
        };
        let mut gateways = Vec::new();
        for hub in 0..random.u64(1..4) {
            for sensor in 0..random.u8(1..4) {
                gateways.push((hub, 1, sensor, (0..4).map(|_| (1 << 33) + start(&mut random)).collect()));
            }
        }
        let (unknown_hubs, gateway_count) = ([60, 5][random.usize(..2)], [30, 70][random.usize(..2)]);
        SimulatedNetwork {
            random,
            now: 0,
            gateways,
            in_transit: BTreeMap::new(),
            count: 0,
            unknown_hubs,
            gateway_count,
        }
    }

    /// Sends one datagram. Returns all datagrams that arrive in the meantime.
    fn step(&mut self) -> Vec<SentDatagram> {
        self.now += 1;
        let at = self.random.usize(..self.gateways.len());
        let restart = self.random.u32(..12_000);
        let (hub, epoch, sensor, next) = &mut self.gateways[at];
        if restart == 0 {
            *epoch += self.random.u32(1..3);
            next.fill(0);
        }
        let topic = self.random.usize(..4);
        let key = (*hub, *epoch, *sensor, TOPICS[topic]);
        let announced: Vec<(u8, u64)> = TOPICS.into_iter().zip(next.iter().copied()).skip(1).collect();
        let sent = SentDatagram::new(key, next[topic], if topic == 0 { announced } else { Vec::new() });
        next[topic] += 1;
        if self.random.u8(..20) > 0 {
            self.transmit(sent.clone());
        }
        if self.random.u8(..20) == 0 {
            self.transmit(sent);
        }
        // A stranger sends, too.
        if self.random.u8(..self.unknown_hubs) == 0 {
            let topic = [Announce::NUMBER, 4, 4, 4][self.random.usize(..4)];
            let hub = 100 + self.random.u64(..self.gateway_count);
            let key = (hub, self.random.u32(1..3), self.random.u8(..), topic);
            self.transmit(SentDatagram::new(key, 1 << 33, Vec::new()));
        }
        let later = self.in_transit.split_off(&(self.now, 0));
        std::mem::replace(&mut self.in_transit, later).into_values().collect()
    }

    fn transmit(&mut self, sent: SentDatagram) {
        let delay = match self.random.u8(..100) {
            0 => self.random.u64(..20_000),
            1..10 => self.random.u64(..100),
            _ => 0,
        };
        self.count += 1;
        self.in_transit.insert((self.now + delay, self.count), sent);
    }
}

#[test]
fn table_agrees_with_an_unbounded_model() {
    let (mut refused, mut full, mut evicted, mut evicted_active) = (BTreeMap::new(), 0, 0, 0);
    for seed in 0..20 {
        let mut world = SimulatedNetwork::new(seed);
        let (mut table, mut model) = (GatewayTable::new(&Topic::ALL), TableModel::default());
        // With the short tick, all delivering gateways have sent within the last 3 s. With the long tick, hardly any
        // has.
        let (mut ticks, tick_ms) = (0, [1, 40][seed as usize % 2]);
        for step in 0..16_000 {
            for sent in world.step() {
                // The clock advances by one tick for each datagram, so that two gateways are never silent for the same
                // time.
                ticks += 1;
                let now_ms = ticks * tick_ms;
                let fresh = table.receive(&sent.bytes, 1, now_ms * 1_000_000).map(|(_, fresh)| fresh);
                assert_eq!(
                    fresh,
                    model.receive(&sent, now_ms),
                    "seed {seed}, step {step}, {:?}",
                    (sent.key, sent.number)
                );
            }
            if step % 1_000 == 0 {
                assert_eq!(table_counters(&table), model.counters(), "seed {seed}, step {step}");
            }
        }
        full += u32::from(model.rows.len() == MAX_ROWS);
        evicted += model.evicted.runs;
        evicted_active += model.evicted.evicted_active;
        assert_eq!(
            (table_counters(&table), table.evicted()),
            (model.counters(), model.evicted),
            "seed {seed}"
        );
        for refusal in DatagramError::ALL {
            let count = model.refused.get(refusal.name()).copied().unwrap_or_default();
            assert_eq!(table.refused(refusal), count, "seed {seed}, {}", refusal.name());
            *refused.entry(refusal.name()).or_insert(0) += count;
        }
    }
    // Every kind of refusal and eviction has occurred.
    assert!(full > 0 && evicted > 100, "{full} full, {evicted} runs evicted");
    assert!(evicted_active > 100 && evicted > evicted_active, "{evicted_active} of them active");
    for refusal in [DatagramError::Epoch, DatagramError::Stale, DatagramError::Capacity] {
        assert!(refused[refusal.name()] > 0, "no datagram was refused as {}", refusal.name());
    }
}

/// Sends an announcement first and another one last, so that exactly the dropped samples count as lost.
#[test]
fn counters_agree_with_the_log_of_a_relay() {
    const DATAGRAM_COUNT: u64 = 5_000;
    let topic = Topic::Zones.number();
    for seed in 0..50 {
        let mut random = Rng::with_seed(seed);
        let first = (1 << 33) - random.u64(..2 * DATAGRAM_COUNT);
        let announce =
            |number: u64, next| SentDatagram::new((1, 1, 0, Announce::NUMBER), number, vec![(topic, next)]);
        let (mut dropped, mut doubled) = (0, 0);
        let mut arrivals = Vec::new();
        for number in first..first + DATAGRAM_COUNT {
            let sent = SentDatagram::new((1, 1, 0, topic), number, Vec::new());
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
        let mut table = GatewayTable::new(&Topic::ALL);
        let (mut highest, mut below, mut arrived) = (0, 0, BTreeSet::new());
        table.receive(&announce(0, first).bytes, 1, 0).unwrap();
        for (_, sent) in &arrivals {
            table.receive(&sent.bytes, 1, 0).unwrap();
            below += u64::from(arrived.insert(sent.number) && sent.number < highest);
            highest = highest.max(sent.number);
        }
        table.receive(&announce(1, first + DATAGRAM_COUNT).bytes, 1, 0).unwrap();
        let expected = [DATAGRAM_COUNT - dropped, dropped, doubled, below];
        assert_eq!(table_counters(&table)[&(1, 1, 0, topic)], expected, "seed {seed}");
        assert!(dropped > 100 && doubled > 30 && below > 100);
    }
}

/// Numbers of the topics that gateways send: announcements, marks, zones and backgrounds.
const TOPICS: [u8; 4] = [Announce::NUMBER, 3, 4, 6];
