//! Receive statistics: which samples arrived, which did not, and why datagrams were refused. They are exact and take
//! bounded memory, no matter who sends. This module has no heap; time is an argument, and keys are checked in
//! `incoming`.

use super::gateway_runs::{Arrival, EvictedRun, GatewayRuns, RunLookup, SenderMatch};
use scanhub_schema::Topic;
use scanhub_schema::datagram::{Announce, Datagram, DatagramError, Head};

/// Maximum number of sensors and topics, of all runs together, that are counted separately.
pub const ROWS: usize = 1024;

/// Receive statistics by gateway, epoch, sensor and topic. 200 kB, stored inline.
///
/// The statistics of a topic start with its first datagram, or with an announcement that arrives before it. Samples
/// that were sent earlier are not counted. An announcement that arrives after the first datagram therefore says nothing
/// about earlier ones, and a late datagram from before the start moves the start back.
///
/// A higher epoch of a gateway retires the previous run, whose rows stay. If there is no room, the run that retired
/// first is evicted, and its rows are added to [`given_up`](StreamStats::given_up). Rows and evicted rows together
/// therefore always count everything that was accepted.
///
/// If no run is retired, an active one is evicted: one that never delivered a sample or has been silent for 3 s,
/// longest silence first. For a sample, a run that has delivered for less than a second may be evicted too. A run that
/// is known to deliver is kept for one more minute of silence, and never evicted while it delivers. A datagram that
/// finds no room is refused.
///
/// Two gateways with the same number and epoch are distinguished by their senders and announcements, and only the first
/// one is accepted. After 3 s of its silence, another sender is accepted as a new run, but not if two gateways are
/// known to send.
pub struct StreamStats {
    /// Bit n is set if the receiver has joined the group of topic number n.
    followed: u64,
    /// Whether only samples of announced topics are accepted.
    only_announced: bool,
    runs: GatewayRuns,
    rows: [Row; ROWS],
    /// Indexes into `rows`: first those in use, sorted by key, then the others.
    order: [u16; ROWS],
    row_count: usize,
    given_up: GivenUp,
    refused: [u64; DatagramError::ALL.len()],
}

/// Totals of the rows that were evicted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GivenUp {
    /// Runs of gateways.
    pub lives: u64,
    /// Runs that were still active and had to make room for others.
    pub displaced: u64,
    /// Distinct sequence numbers that arrived.
    pub received: u64,
    /// Sequence numbers that did not arrive, and cannot arrive any more because their run has ended.
    pub lost: u64,
    /// Sequence numbers that arrived again.
    pub duplicate: u64,
    /// Sequence numbers among `received` that arrived after a higher one.
    pub reordered: u64,
}

impl StreamStats {
    /// Creates statistics for a receiver that has joined the groups of `topics`. Announcements of other topics are
    /// ignored, because their samples would count as lost.
    pub fn new(topics: &[Topic]) -> StreamStats {
        StreamStats {
            followed: topics.iter().fold(0, |bits, topic| bits | 1 << topic.number()),
            only_announced: false,
            runs: GatewayRuns::new(),
            rows: [Row::EMPTY; ROWS],
            order: std::array::from_fn(|at| at as u16),
            row_count: 0,
            given_up: GivenUp::default(),
            refused: [0; DatagramError::ALL.len()],
        }
    }

    /// Returns statistics for a receiver with a key. It accepts samples only from announced sensors and topics,
    /// starting with the number in the first announcement. It does not accept another sender as the next run of a
    /// silent gateway. Recorded datagrams therefore cannot be replayed.
    pub fn only_announced(self) -> StreamStats {
        StreamStats { only_announced: true, ..self }
    }

    /// Returns whether this sensor was announced in this run of `hub`, and neither has been evicted since.
    pub fn is_announced(&self, hub: u64, epoch: u32, sensor: u8) -> bool {
        self.find((hub, epoch, sensor, Announce::NUMBER)).is_some()
    }

    /// Counts a datagram that the caller refuses for its own reason.
    pub fn refuse(&mut self, why: DatagramError) {
        self.count(Some(why));
    }

    /// Checks and counts `bytes`, a datagram with a whole sample. It calls [`read`](StreamStats::read), then
    /// [`take`](StreamStats::take). `from` identifies the sender, for example its address and port. `now_ns` is the
    /// time of any clock that is never set. A datagram that is accepted can be unpacked.
    ///
    /// # Errors
    ///
    /// Returns the reason for which the datagram is refused. The reason is counted, and nothing else changes.
    pub fn receive<'a>(
        &mut self,
        bytes: &'a [u8],
        from: u64,
        now_ns: u64,
    ) -> Result<(Datagram<'a>, Fresh), DatagramError> {
        let datagram = self.read(bytes)?;
        Ok((datagram, self.take(&datagram, from, now_ns)?))
    }

    /// Checks `bytes`, a datagram as it was received.
    ///
    /// # Errors
    ///
    /// Returns the reason for which the datagram is refused, and counts it.
    pub fn read<'a>(&mut self, bytes: &'a [u8]) -> Result<Datagram<'a>, DatagramError> {
        let read = Datagram::read(bytes);
        self.count(read.err());
        read
    }

    /// Checks a part of a sample before memory is spent on it. The sample is checked and counted when it is complete.
    /// Returns whether the sample is a duplicate. Without [`only_announced`](StreamStats::only_announced), every part
    /// is accepted.
    ///
    /// # Errors
    ///
    /// Returns [`DatagramError::Epoch`], [`DatagramError::Stale`] or [`DatagramError::Untimely`] if the whole sample
    /// would be refused for this reason, and counts it.
    pub fn check_part(&mut self, head: &Head) -> Result<bool, DatagramError> {
        if !self.only_announced {
            return Ok(false);
        }
        let row = self.find((head.hub, head.epoch, head.sensor, head.topic)).map(|at| &self.rows[at]);
        let checked = match (self.runs.find((head.hub, head.epoch)), row) {
            (RunLookup::Over, _) => Err(DatagramError::Epoch),
            (_, None) => Err(DatagramError::Untimely),
            (_, Some(row)) if row.is_stale(head.sequence) || row.is_before(head.sequence) => {
                Err(DatagramError::Stale)
            }
            (_, Some(row)) => Ok(row.came(head.sequence)),
        };
        self.count(checked.err());
        checked
    }

    /// Accepts the sender of an announcement as the new address of its gateway, which has also announced another run of
    /// its hub. This requires that the previous address is silent, and that the announcement's number is ahead of all
    /// others of its sensor. Call it only for announcements that are authenticated with a key. Until then, they are
    /// refused as [`DatagramError::Twin`].
    pub fn follow(&mut self, datagram: &Datagram<'_>, from: u64, now_ns: u64) {
        let head = datagram.head;
        let RunLookup::At(slot) = self.runs.find((head.hub, head.epoch)) else { return };
        let Some(announce) = Announce::unpack(datagram.payload) else { return };
        let row = self.find((head.hub, head.epoch, head.sensor, Announce::NUMBER));
        let is_ahead = row.is_some_and(|at| self.rows[at].is_ahead(head.sequence));
        let senders = &mut self.runs.record_mut(slot).senders;
        if is_ahead && senders.judge(from, Some(announce.boot), now_ns) == SenderMatch::Next {
            senders.move_to(from, announce.boot, now_ns);
        }
    }

    /// Checks and counts a complete sample. A sample that was reassembled from parts has the header of one of them.
    ///
    /// # Errors
    ///
    /// Returns the same errors as [`receive`](StreamStats::receive).
    pub fn take(&mut self, datagram: &Datagram<'_>, from: u64, now_ns: u64) -> Result<Fresh, DatagramError> {
        let taken = self.place(datagram, from, now_ns);
        self.count(taken.err());
        taken
    }

    fn count(&mut self, refusal: Option<DatagramError>) {
        if let Some(refusal) = refusal {
            self.refused[refusal as usize] += 1;
        }
    }

    /// Returns how many datagrams were refused for this reason.
    pub fn refused(&self, refusal: DatagramError) -> u64 {
        self.refused[refusal as usize]
    }

    /// Returns the totals of everything that was evicted.
    pub fn given_up(&self) -> GivenUp {
        self.given_up
    }

    /// Returns the time at which the first datagram of this run of `hub` was accepted, unless the run has been evicted.
    /// If the time of a run changes, it is another gateway, or the run was evicted in between.
    pub fn since_ns(&self, hub: u64, epoch: u32) -> Option<u64> {
        self.runs.since_ns((hub, epoch))
    }

    /// Returns whether this run of `hub` is known to deliver: its accepted samples cover a second or more.
    pub fn is_proven(&self, hub: u64, epoch: u32) -> bool {
        match self.runs.find((hub, epoch)) {
            RunLookup::At(slot) => self.runs.record(slot).standing.is_proven(),
            RunLookup::Over | RunLookup::New => false,
        }
    }

    /// Returns whether two gateways are known to send under this number and epoch. All datagrams of one of them are
    /// refused as [`DatagramError::Twin`].
    pub fn is_shared(&self, hub: u64, epoch: u32) -> bool {
        match self.runs.find((hub, epoch)) {
            RunLookup::At(slot) => self.runs.record(slot).senders.is_shared(),
            RunLookup::Over | RunLookup::New => false,
        }
    }

    /// Returns the counters of every sensor and topic that has sent samples, by gateway, epoch, sensor and topic.
    pub fn rows(&self) -> impl Iterator<Item = &Row> {
        self.order[..self.row_count]
            .iter()
            .map(|&at| &self.rows[usize::from(at)])
            .filter(|row| row.received + row.lost() > 0)
    }

    fn place(&mut self, datagram: &Datagram<'_>, from: u64, now_ns: u64) -> Result<Fresh, DatagramError> {
        let head = datagram.head;
        let run = (head.hub, head.epoch);
        let known = match self.runs.find(run) {
            RunLookup::Over => return Err(DatagramError::Epoch),
            RunLookup::At(slot) => Some(slot),
            RunLookup::New => None,
        };
        let is_announce = head.topic == Announce::NUMBER;
        let announce = if is_announce { Announce::unpack(datagram.payload) } else { None };
        let boot = announce.map(|announce| announce.boot);
        let judge = |slot: usize| self.runs.record(slot).senders.judge(from, boot, now_ns);
        let sender_match = match known.map_or(SenderMatch::Own, judge) {
            SenderMatch::Next if self.only_announced => SenderMatch::Twin,
            sender_match => sender_match,
        };
        if sender_match == SenderMatch::Twin {
            if let Some(slot) = known.filter(|_| datagram.check_payload().is_ok()) {
                self.runs.record_mut(slot).senders.note(from, boot, now_ns);
            }
            return Err(DatagramError::Twin);
        }
        let known = known.filter(|_| sender_match == SenderMatch::Own);
        let arrival = Arrival { delivers: !is_announce, now_ns };
        let key = (head.hub, head.epoch, head.sensor, head.topic);
        let is_full = self.row_count == ROWS || known.is_none() && self.runs.is_full();
        match self.find(key) {
            // The whole run of the silent gateway makes room.
            _ if sender_match == SenderMatch::Next => datagram.check_payload()?,
            Some(at) if self.rows[at].is_stale(head.sequence) => return Err(DatagramError::Stale),
            Some(at) if self.only_announced && self.rows[at].is_before(head.sequence) => {
                return Err(DatagramError::Stale);
            }
            None if self.only_announced && !is_announce => return Err(DatagramError::Untimely),
            None if is_full && !self.runs.can_evict(run, arrival) => return Err(DatagramError::Capacity),
            _ => datagram.check_payload()?,
        }
        if sender_match == SenderMatch::Next {
            self.runs.forget(run);
            self.clear(EvictedRun { run, is_displaced: false });
        }
        let slot = known.unwrap_or_else(|| {
            let (slot, gone) = self.runs.take(run, arrival);
            if let Some(gone) = gone {
                self.clear(gone);
            }
            slot
        });
        let record = self.runs.record_mut(slot);
        record.standing.take(arrival);
        record.senders.note(from, boot, now_ns);
        let fresh = self.row(key, head.sequence, arrival).map_or(Fresh::New, |row| row.take(head.sequence));
        if let Some(announce) = announce {
            self.note(key, &announce, arrival);
        }
        Ok(fresh)
    }

    /// Records the next sequence numbers of an announcement. A topic that finds no room starts with its first datagram,
    /// if there is room then.
    fn note(&mut self, (hub, epoch, sensor, _): Key, announce: &Announce, arrival: Arrival) {
        let followed = self.followed;
        let is_followed = |number: u8| number < 64 && followed >> number & 1 == 1;
        for announced in announce.topics().iter().filter(|announced| is_followed(announced.topic)) {
            if let Some(row) = self.row((hub, epoch, sensor, announced.topic), announced.next, arrival) {
                row.announce(announced.next);
            }
        }
    }

    /// Returns the row of `key`, or a new row that starts with `first`. `None` if there is no room.
    fn row(&mut self, key: Key, first: u32, arrival: Arrival) -> Option<&mut Row> {
        let at = match self.find(key) {
            Some(at) => at,
            None => {
                // Each run has at least one row.
                if self.row_count == ROWS {
                    let gone = self.runs.evict((key.0, key.1), arrival)?;
                    self.clear(gone);
                }
                let position = self.below(|other| other < key);
                self.order[position..=self.row_count].rotate_right(1);
                self.row_count += 1;
                let at = usize::from(self.order[position]);
                self.rows[at] = Row::new(key, first);
                at
            }
        };
        Some(&mut self.rows[at])
    }

    /// Adds the rows of an evicted run to the totals.
    fn clear(&mut self, EvictedRun { run, is_displaced }: EvictedRun) {
        let first = self.below(|(hub, epoch, ..)| (hub, epoch) < run);
        let end = self.below(|(hub, epoch, ..)| (hub, epoch) <= run);
        let sum = &mut self.given_up;
        sum.lives += 1;
        sum.displaced += u64::from(is_displaced);
        for row in self.order[first..end].iter().map(|&at| &self.rows[usize::from(at)]) {
            sum.received += row.received;
            sum.lost += row.lost();
            sum.duplicate += row.duplicate;
            sum.reordered += row.reordered;
        }
        self.order[first..self.row_count].rotate_left(end - first);
        self.row_count -= end - first;
    }

    /// Returns the position of the first key for which `before` does not hold.
    fn below(&self, before: impl Fn(Key) -> bool) -> usize {
        self.order[..self.row_count].partition_point(|&at| before(self.rows[usize::from(at)].key()))
    }

    /// Returns the row's index in `rows`.
    fn find(&self, key: Key) -> Option<usize> {
        let order = &self.order[..self.row_count];
        let found = order.binary_search_by_key(&key, |&at| self.rows[usize::from(at)].key());
        found.ok().map(|position| usize::from(order[position]))
    }
}

/// Sequence numbers below the highest one that are still distinguished. Older ones are stale.
pub const WINDOW: usize = 1024;

/// Counters of one sensor and topic in one run of a gateway. Sequence numbers have 32 bits, wrap, and may arrive in any
/// order.
#[derive(Clone, Copy, Debug)]
pub struct Row {
    /// Number of the gateway.
    pub hub: u64,
    /// Epoch of its run.
    pub epoch: u32,
    /// Position of the sensor's link in the hub's configuration.
    pub sensor: u8,
    /// Number of the topic. 0 is the announcement.
    pub topic: u8,
    /// Distinct sequence numbers that arrived.
    pub received: u64,
    /// Sequence numbers that arrived again, within the window.
    pub duplicate: u64,
    /// Sequence numbers among `received` that arrived after a higher one.
    pub reordered: u64,
    /// First number that is known to have been sent to this receiver, without wrapping.
    lowest: i64,
    /// Highest number that has arrived; invalid while `received` is 0.
    highest: i64,
    /// One more than the highest number that is known to have been sent.
    next: i64,
    /// Bit n % WINDOW is set if number n of the window has arrived.
    seen: [u64; WINDOW / 64],
}

/// A sequence number, compared with those that arrived before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fresh {
    /// Higher than all others of its topic.
    New,
    /// Arrived after a higher one.
    Late,
    /// Arrived before.
    Duplicate,
}

/// Key of a row, in the order of output: gateway, epoch, sensor, topic.
pub(super) type Key = (u64, u32, u8, u8);

impl Row {
    /// An unused row.
    pub(super) const EMPTY: Row = Row {
        hub: 0,
        epoch: 0,
        sensor: 0,
        topic: 0,
        received: 0,
        duplicate: 0,
        reordered: 0,
        lowest: 0,
        highest: 0,
        next: 0,
        seen: [0; WINDOW / 64],
    };

    /// Creates a row that expects all numbers from `first` on.
    pub(super) fn new((hub, epoch, sensor, topic): Key, first: u32) -> Row {
        // Numbers before the first one must not become negative.
        let first = i64::from(first) + (1 << 32);
        Row { hub, epoch, sensor, topic, lowest: first, next: first, ..Row::EMPTY }
    }

    /// Returns the count of numbers that were sent since the first known one and have not arrived. The first known
    /// number is the lowest that arrived, or the next number of an earlier announcement. The last known number is the
    /// highest that arrived, or the one before the next number of an announcement.
    pub fn lost(&self) -> u64 {
        (self.next - self.lowest) as u64 - self.received
    }

    pub(super) fn key(&self) -> Key {
        (self.hub, self.epoch, self.sensor, self.topic)
    }

    /// Returns whether the number is so far below the highest one that it may be a duplicate.
    pub(super) fn is_stale(&self, sequence: u32) -> bool {
        self.received > 0 && self.highest - self.number(sequence) >= WINDOW as i64
    }

    /// Returns whether the number is below the first one that is known to have been sent to this receiver.
    pub(super) fn is_before(&self, sequence: u32) -> bool {
        self.number(sequence) < self.lowest
    }

    /// Returns whether the number is higher than all that have arrived.
    pub(super) fn is_ahead(&self, sequence: u32) -> bool {
        self.received == 0 || self.number(sequence) > self.highest
    }

    /// Returns whether the number, which is not stale, has arrived.
    pub(super) fn came(&self, sequence: u32) -> bool {
        !self.is_ahead(sequence) && self.has(self.number(sequence))
    }

    /// Records the arrival of a number that is not stale.
    pub(super) fn take(&mut self, sequence: u32) -> Fresh {
        let number = self.number(sequence);
        let is_late = !self.is_ahead(sequence);
        if is_late && self.has(number) {
            self.duplicate += 1;
            return Fresh::Duplicate;
        }
        if !is_late {
            self.advance(number);
        }
        let (word, bit) = place(number);
        self.seen[word] |= bit;
        self.received += 1;
        self.lowest = self.lowest.min(number);
        self.next = self.next.max(number.saturating_add(1));
        if is_late {
            self.reordered += 1;
            return Fresh::Late;
        }
        Fresh::New
    }

    /// Records that all numbers before `next` were sent. An announcement that samples have overtaken changes nothing.
    pub(super) fn announce(&mut self, next: u32) {
        self.next = self.next.max(self.number(next));
    }

    /// Returns the number without wrapping: the value nearest to the known ones.
    fn number(&self, sequence: u32) -> i64 {
        let known = if self.received > 0 { self.highest } else { self.next };
        known.saturating_add(i64::from(sequence.wrapping_sub(known as u32) as i32))
    }

    fn has(&self, number: i64) -> bool {
        let (word, bit) = place(number);
        self.seen[word] & bit != 0
    }

    /// Moves the window up to `number`. Neither that number nor those in between have arrived.
    fn advance(&mut self, number: i64) {
        if self.received == 0 || number - self.highest >= WINDOW as i64 {
            self.seen = [0; WINDOW / 64];
        } else {
            for between in self.highest + 1..=number {
                let (word, bit) = place(between);
                self.seen[word] &= !bit;
            }
        }
        self.highest = number;
    }
}

/// Returns the word and the bit of a number in the window.
fn place(number: i64) -> (usize, u64) {
    let at = number as usize % WINDOW;
    (at / 64, 1 << (at % 64))
}

#[cfg(test)]
mod tests {
    use scanhub_schema::Zones;
    use scanhub_schema::datagram::{Announced, HEAD, Packed};

    use super::*;

    fn zones(head: Head) -> Vec<u8> {
        let mut buffer = [0; 100];
        let len = Zones::unknown().pack(&mut buffer[HEAD..]).unwrap();
        head.seal(&mut buffer, len).unwrap().to_vec()
    }

    fn head(hub: u64, epoch: u32, sequence: u32) -> Head {
        Head { topic: Topic::Zones.number(), revision: 1, hub, epoch, sequence, ..Head::default() }
    }

    fn announce(hub: u64, next: u32) -> Vec<u8> {
        let mut announce = Announce::new(1, "front", "");
        for topic in [Topic::Zones, Topic::Telegram] {
            announce.add(Announced { topic: topic.number(), group: 81, port: 22_200, next });
        }
        let mut buffer = [0; 200];
        let len = announce.pack(&mut buffer[HEAD..]).unwrap();
        Head { topic: 0, ..head(hub, 1, 0) }.seal(&mut buffer, len).unwrap().to_vec()
    }

    fn fresh(account: &mut StreamStats, bytes: &[u8]) -> Result<Fresh, DatagramError> {
        at(account, bytes, 0)
    }

    fn at(account: &mut StreamStats, bytes: &[u8], now_ms: u64) -> Result<Fresh, DatagramError> {
        account.receive(bytes, 1, now_ms * 1_000_000).map(|(_, fresh)| fresh)
    }

    fn knows(account: &StreamStats, hub: u64, epoch: u32) -> bool {
        account.since_ns(hub, epoch).is_some()
    }

    /// 64 gateways that are known to deliver.
    fn full() -> StreamStats {
        let mut account = StreamStats::new(&Topic::ALL);
        for (number, now_ms) in [(0, 0), (1, 1000)] {
            for hub in 0..64 {
                assert_eq!(at(&mut account, &zones(head(hub, 1, number)), now_ms), Ok(Fresh::New));
            }
        }
        account
    }

    #[test]
    fn a_greater_epoch_retires_the_older_one_of_its_hub() {
        let mut account = StreamStats::new(&Topic::ALL);
        for (hub, epoch, expected) in [
            (1, 7, Ok(Fresh::New)),
            (2, 3, Ok(Fresh::New)),
            (1, 6, Err(DatagramError::Epoch)),
            (1, 8, Ok(Fresh::New)),
            (1, 7, Err(DatagramError::Epoch)),
            (2, 3, Ok(Fresh::Duplicate)),
        ] {
            assert_eq!(fresh(&mut account, &zones(head(hub, epoch, 0))), expected, "{hub} {epoch}");
        }
        let rows: Vec<_> = account.rows().map(|row| (row.hub, row.epoch, row.received)).collect();
        assert_eq!(rows, [(1, 7, 1), (1, 8, 1), (2, 3, 1)]);
        assert_eq!(account.refused(DatagramError::Epoch), 2);
    }

    #[test]
    fn what_is_refused_changes_nothing() {
        let mut account = StreamStats::new(&Topic::ALL);
        let damaged = |head: Head| {
            let mut buffer = [0; 60];
            head.seal(&mut buffer, 3).unwrap().to_vec()
        };
        let refused = [
            (DatagramError::Payload, damaged(head(1, 2, 0))),
            (DatagramError::Payload, zones(Head { revision: 0, ..head(1, 2, 0) })),
            (DatagramError::Skipped, zones(Head { topic: 255, revision: 0, ..head(1, 2, 0) })),
        ];
        for (refusal, bytes) in &refused {
            assert_eq!(fresh(&mut account, bytes), Err(*refusal));
        }
        assert_eq!(account.rows().count(), 0);
        assert_eq!(fresh(&mut account, &zones(head(1, 1, 0))), Ok(Fresh::New), "epoch 2 was not believed");
        assert_eq!(account.refused(DatagramError::Payload), 2);
    }

    #[test]
    fn memory_is_bounded() {
        let mut account = full();
        assert_eq!(at(&mut account, &zones(head(64, 1, 0)), 1000), Err(DatagramError::Capacity));
        assert_eq!(at(&mut account, &zones(head(1, 1, 2)), 1000), Ok(Fresh::New), "all go on");
        for sensor in 1..=240 {
            for hub in 0..4 {
                let bytes = zones(Head { sensor, ..head(hub, 1, 0) });
                assert_eq!(at(&mut account, &bytes, 1000), Ok(Fresh::New));
            }
        }
        let more = zones(Head { sensor: 241, ..head(1, 1, 0) });
        assert_eq!(at(&mut account, &more, 3999), Err(DatagramError::Capacity));
        assert_eq!((account.rows().count(), account.refused(DatagramError::Capacity)), (ROWS, 2));
        assert_eq!(account.given_up(), GivenUp::default());
        // Runs that were silent for three seconds make room. The totals keep their received samples.
        assert_eq!(at(&mut account, &more, 4000), Ok(Fresh::New));
        assert_eq!(at(&mut account, &zones(head(64, 1, 0)), 4000), Ok(Fresh::New));
        let sum = account.given_up();
        assert_eq!(
            (sum.lives, sum.displaced, sum.lost),
            (1, 1, 0),
            "one went for the row, and left its place"
        );
        let counted: u64 = account.rows().map(|row| row.received).sum();
        assert_eq!(counted + sum.received, 128 + 1 + 4 * 240 + 2);
    }

    #[test]
    fn a_true_gateway_is_heard_at_once_after_any_number_of_invented_ones() {
        let mut account = StreamStats::new(&Topic::ALL);
        for number in 0..2 {
            assert_eq!(
                at(&mut account, &zones(head(9999, 1, number)), 1000 * u64::from(number)),
                Ok(Fresh::New)
            );
        }
        for (now_ms, bytes) in [(1001, announce(0, 10)), (1002, zones(head(0, 1, 0)))] {
            for hub in 0..1000 {
                let mut forged = bytes.clone();
                forged[8..10].copy_from_slice(&(hub as u16).to_le_bytes());
                let Datagram { mut head, payload, .. } = Datagram::read(&bytes).unwrap();
                head.hub = hub;
                forged[HEAD..].copy_from_slice(payload);
                let forged = head.seal(&mut forged, payload.len()).unwrap();
                assert!(at(&mut account, forged, now_ms).is_ok());
            }
        }
        assert_eq!(at(&mut account, &zones(head(7777, 1, 0)), 1003), Ok(Fresh::New));
        assert!(knows(&account, 9999, 1) && knows(&account, 7777, 1), "{:?}", account.given_up());
        assert_eq!(account.given_up().displaced, account.given_up().lives);
    }

    #[test]
    fn two_gateways_with_one_number_and_one_epoch_are_never_mixed() {
        let mut account = StreamStats::new(&Topic::ALL);
        let mut hear = |from: u64, bytes: &[u8], now_ms: u64| {
            account.receive(bytes, from, now_ms * 1_000_000).map(|(_, fresh)| fresh)
        };
        let announce = |boot: u64, number: u32| {
            let mut buffer = [0; 200];
            let len = Announce::new(boot, "front", "").pack(&mut buffer[HEAD..]).unwrap();
            Head { topic: 0, ..head(5, 1, number) }.seal(&mut buffer, len).unwrap().to_vec()
        };
        for n in 0..30_u32 {
            let now_ms = 100 * u64::from(n);
            if n % 10 == 0 {
                assert_eq!(hear(1, &announce(7, n / 10), now_ms), Ok(Fresh::New));
                assert_eq!(hear(2, &announce(8, n / 10), now_ms), Err(DatagramError::Twin));
            }
            assert_eq!(hear(1, &zones(head(5, 1, n)), now_ms), Ok(Fresh::New));
            assert_eq!(hear(2, &zones(head(5, 1, 500 + n)), now_ms + 50), Err(DatagramError::Twin));
        }
        // The second gateway continues alone. It never replaces the first one.
        assert_eq!(hear(2, &zones(head(5, 1, 100)), 5899), Err(DatagramError::Twin));
        assert_eq!(hear(2, &zones(head(5, 1, 101)), 60_000), Err(DatagramError::Twin));
        assert_eq!(hear(1, &zones(head(5, 1, 30)), 60_001), Ok(Fresh::New));
        assert!(account.is_shared(5, 1));
        assert_eq!(account.refused(DatagramError::Twin), 35);
    }

    #[test]
    fn whoever_follows_a_silent_gateway_begins_anew() {
        let mut account = StreamStats::new(&Topic::ALL);
        let mut hear = |from: u64, bytes: &[u8], now_ms: u64| {
            account.receive(bytes, from, now_ms * 1_000_000).map(|(_, fresh)| fresh)
        };
        for n in 0..30 {
            assert_eq!(hear(1, &zones(head(5, 1, 200 + n)), 100 * u64::from(n)), Ok(Fresh::New));
        }
        // Its numbers start again, and none of the first gateway's numbers count as lost.
        assert_eq!(hear(2, &zones(head(5, 1, 100)), 5899), Err(DatagramError::Twin));
        assert_eq!(hear(2, &zones(head(5, 1, 101)), 5900), Ok(Fresh::New));
        assert!(!account.is_shared(5, 1), "a new run");
        let rows: Vec<_> = account.rows().map(|row| (row.received, row.lost())).collect();
        assert_eq!(rows, [(1, 0)]);
        let given_up = account.given_up();
        assert_eq!((given_up.lives, given_up.displaced, given_up.received, given_up.lost), (1, 0, 30, 0));
        assert_eq!(account.refused(DatagramError::Twin), 1);
    }

    #[test]
    fn what_is_retired_makes_room_and_stays_in_the_sum() {
        let mut account = full();
        let fresh = |account: &mut StreamStats, bytes: &[u8]| at(account, bytes, 1000);
        assert_eq!(fresh(&mut account, &zones(head(5, 1, 4))), Ok(Fresh::New));
        // A gateway that restarts is accepted even though the table is full.
        assert_eq!(fresh(&mut account, &zones(head(5, 2, 0))), Ok(Fresh::New));
        let mut given_up = GivenUp { lives: 1, received: 3, lost: 2, ..GivenUp::default() };
        assert_eq!((account.given_up(), account.rows().count()), (given_up, 64));
        assert_eq!(
            fresh(&mut account, &zones(head(5, 1, 5))),
            Err(DatagramError::Epoch),
            "given up is not forgotten"
        );
        assert!(knows(&account, 5, 2) && !knows(&account, 5, 1));
        // A damaged datagram evicts nothing.
        let mut buffer = [0; 60];
        let damaged = head(5, 3, 0).seal(&mut buffer, 3).unwrap();
        assert_eq!(fresh(&mut account, damaged), Err(DatagramError::Payload));
        assert!(knows(&account, 5, 2) && !knows(&account, 5, 3));
        // Fills the table with sensors of a run that then retires. One more row evicts it.
        for sensor in 1..=240 {
            for hub in 0..4 {
                let bytes = zones(Head { sensor, ..head(hub, 1, 0) });
                assert_eq!(fresh(&mut account, &bytes), Ok(Fresh::New));
            }
        }
        assert_eq!(fresh(&mut account, &zones(head(2, 9, 0))), Ok(Fresh::New));
        given_up = GivenUp { lives: 2, received: 3 + 242, ..given_up };
        assert_eq!((account.given_up(), account.rows().count()), (given_up, ROWS - 240));
        let counted: u64 = account.rows().map(|row| row.received).sum();
        assert_eq!(counted + given_up.received, 128 + 2 + 4 * 240 + 1);
    }

    #[test]
    fn announcements_count_for_topics_that_are_listened_to() {
        let mut account = StreamStats::new(&[Topic::Zones]);
        assert_eq!(fresh(&mut account, &announce(1, 10)), Ok(Fresh::New));
        assert_eq!(
            account.rows().map(|row| row.topic).collect::<Vec<_>>(),
            [0],
            "nothing sent, nothing to tell"
        );
        assert_eq!(fresh(&mut account, &announce(1, 12)), Ok(Fresh::Duplicate));
        let rows: Vec<_> = account.rows().map(|row| (row.topic, row.received, row.lost())).collect();
        assert_eq!(rows, [(0, 1, 0), (Topic::Zones.number(), 0, 2)]);
    }

    fn row(first: u32) -> Row {
        Row::new((1, 2, 3, 4), first)
    }

    fn figures(row: &Row) -> (u64, u64, u64, u64) {
        (row.received, row.lost(), row.duplicate, row.reordered)
    }

    #[test]
    fn numbers_wrap() {
        let mut row = row(u32::MAX - 1);
        assert_eq!(row.take(u32::MAX - 1), Fresh::New);
        assert_eq!(row.take(1), Fresh::New);
        assert_eq!(figures(&row), (2, 2, 0, 0));
        assert_eq!(
            (row.take(0), row.take(0), row.take(u32::MAX)),
            (Fresh::Late, Fresh::Duplicate, Fresh::Late)
        );
        assert_eq!(figures(&row), (4, 0, 1, 2));
    }

    #[test]
    fn the_window_ends_after_1024() {
        let mut row = row(5000);
        row.take(5000);
        assert!(!row.is_stale(5000 - 1023) && row.is_stale(5000 - 1024));
        assert_eq!(row.take(5000 - 1023), Fresh::Late);
        assert_eq!(figures(&row), (2, 1022, 0, 1));
        row.take(5001);
        assert!(row.is_stale(5000 - 1023));
        assert_eq!(row.take(5001 - 1023), Fresh::Late, "its place in the window was another's");
    }

    #[test]
    fn announcements_tell_what_was_lost_before_and_after() {
        let mut row = row(10);
        assert_eq!(figures(&row), (0, 0, 0, 0));
        row.announce(13);
        assert_eq!(figures(&row), (0, 3, 0, 0));
        row.take(14);
        row.announce(12);
        assert_eq!(figures(&row), (1, 4, 0, 0));
        row.announce(20);
        assert_eq!(figures(&row), (1, 9, 0, 0));
        row.take(19);
        assert_eq!(figures(&row), (2, 8, 0, 0), "announced, but none that came was higher");
    }
}
