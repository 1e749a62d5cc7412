//! The receiver's account: what came, what did not, and why something was refused, exactly and in bounded memory, whoever
//! sends. Refuses to know sockets, time and keys; it has no heap.

use super::lives::{Arrival, Gone, Lives};
use super::numbers::{Fresh, Key, Row};
use super::voices::Whose;
use super::{Announce, Datagram, Refusal};
use crate::Topic;

/// The most sensors and topics of all lives that are told apart.
pub const ROWS: usize = 1024;

/// What was received, by hub, epoch, sensor and topic. 200 kB, wherever its owner puts it.
///
/// A topic's account begins with its first datagram, or with the first announcement that came before that: what was sent
/// before neither is not ours. An announcement that is overtaken by the first datagram therefore says nothing about what
/// was before it, and what comes late from before the beginning moves the beginning there.
///
/// A greater epoch of a gateway retires the one before, whose rows stay. Where there is no room, the life that has been
/// retired longest is given up, and its rows are added to [`given_up`](Account::given_up): so rows and that together
/// always are everything that was taken. If none is retired, one that goes on makes room: what never delivered a sample or
/// is silent for 3 s, whatever was not heard for longest first; for a sample also what delivered for less than a second.
/// One that is known to deliver is kept for a minute of silence longer, and is never put out while it delivers; what has no
/// room beside those is refused.
///
/// Two gateways with one number and one epoch are told apart by their senders and by what they announce: only one of them
/// is taken, the first that was heard, until it is silent for 3 s.
pub struct Account {
    /// Bit n: topic number n is listened to.
    followed: u8,
    lives: Lives,
    rows: [Row; ROWS],
    /// Positions in `rows`: of those in use, sorted by key, then of the others.
    order: [u16; ROWS],
    row_count: usize,
    given_up: GivenUp,
    refused: [u64; Refusal::ALL.len()],
}

/// The sums of the rows that an account has given up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GivenUp {
    /// Lives of gateways.
    pub lives: u64,
    /// Of them those that were not known to be over: they made room for others.
    pub displaced: u64,
    /// Distinct numbers that came.
    pub received: u64,
    /// Numbers that did not come, and now never will: their epoch is over.
    pub lost: u64,
    /// Numbers that came again.
    pub duplicate: u64,
    /// Numbers among `received` that came after a higher one.
    pub reordered: u64,
}

impl Account {
    /// Nothing received yet. Announcements are believed for `topics` only: those whose groups were joined. Of the
    /// others they would tell as lost what nobody wanted.
    pub fn new(topics: &[Topic]) -> Account {
        Account {
            followed: topics.iter().fold(0, |bits, topic| bits | 1 << topic.number()),
            lives: Lives::new(),
            rows: [Row::EMPTY; ROWS],
            order: core::array::from_fn(|at| at as u16),
            row_count: 0,
            given_up: GivenUp::default(),
            refused: [0; Refusal::ALL.len()],
        }
    }

    /// Checks and counts `bytes`, a whole datagram as it was received `from` a sender, at `now_ns` of any clock that is
    /// never set. A sender is any number that others do not have, for example its address and port. What is refused is
    /// counted by its reason and changes nothing else; what is not, can be unpacked.
    pub fn receive<'a>(
        &mut self,
        bytes: &'a [u8],
        from: u64,
        now_ns: u64,
    ) -> Result<(Datagram<'a>, Fresh), Refusal> {
        let read = Datagram::read(bytes);
        let result = read.and_then(|datagram| Ok((datagram, self.take(&datagram, from, now_ns)?)));
        if let Err(refusal) = result {
            self.refused[refusal as usize] += 1;
        }
        result
    }

    /// How many datagrams were refused for this reason.
    pub fn refused(&self, refusal: Refusal) -> u64 {
        self.refused[refusal as usize]
    }

    /// What was given up to make room.
    pub fn given_up(&self) -> GivenUp {
        self.given_up
    }

    /// Something of this life of `hub` was taken, and it was not given up.
    pub fn knows(&self, hub: u64, epoch: u32) -> bool {
        self.lives.contains((hub, epoch))
    }

    /// Two gateways are known to send under this number and epoch. Of one of them everything is refused as
    /// [`Refusal::Twin`].
    pub fn is_shared(&self, hub: u64, epoch: u32) -> bool {
        self.lives.record((hub, epoch)).is_some_and(|record| record.voices.is_shared())
    }

    /// What is known of every sensor and topic of which anything was sent, by hub, epoch, sensor and topic.
    pub fn rows(&self) -> impl Iterator<Item = &Row> {
        self.order[..self.row_count]
            .iter()
            .map(|&at| &self.rows[usize::from(at)])
            .filter(|row| row.received + row.lost() > 0)
    }

    fn take(&mut self, datagram: &Datagram<'_>, from: u64, now_ns: u64) -> Result<Fresh, Refusal> {
        let head = datagram.head;
        let life = (head.hub, head.epoch);
        if self.lives.is_over(life) {
            return Err(Refusal::Epoch);
        }
        let is_announce = head.topic == Announce::NUMBER;
        let announce = if is_announce { Announce::unpack(datagram.payload) } else { None };
        let boot = announce.map(|announce| announce.boot);
        let record = self.lives.record_mut(life);
        let whose = record.as_ref().map_or(Whose::Own, |record| record.voices.judge(from, boot, now_ns));
        if whose == Whose::Twin {
            if let Some(record) = record.filter(|_| datagram.check_payload().is_ok()) {
                record.voices.note(from, boot, now_ns);
            }
            return Err(Refusal::Twin);
        }
        let is_known = record.is_some() && whose == Whose::Own;
        let arrival = Arrival { delivers: !is_announce, now_ns };
        let key = (head.hub, head.epoch, head.sensor, head.topic);
        let is_full = self.row_count == ROWS || !is_known && self.lives.is_full();
        match self.find(key) {
            // All of the one that is silent makes room.
            _ if whose == Whose::Next => datagram.check_payload()?,
            Some(at) if self.rows[at].is_stale(head.sequence) => return Err(Refusal::Stale),
            None if is_full && !self.lives.can_give_up(life, arrival) => return Err(Refusal::Capacity),
            _ => datagram.check_payload()?,
        }
        if whose == Whose::Next {
            self.lives.forget(life);
            self.clear(Gone { life, is_displaced: false });
        }
        if !is_known && let Some(gone) = self.lives.take(life, arrival) {
            self.clear(gone);
        }
        if let Some(record) = self.lives.record_mut(life) {
            record.take(arrival);
            record.voices.note(from, boot, now_ns);
        }
        let fresh = self.row(key, head.sequence, arrival).map_or(Fresh::New, |row| row.take(head.sequence));
        if let Some(announce) = announce {
            self.note(key, &announce, arrival);
        }
        Ok(fresh)
    }

    /// What has no room is not noted: it begins with its first datagram, if there is room then.
    fn note(&mut self, (hub, epoch, sensor, _): Key, announce: &Announce, arrival: Arrival) {
        let followed = self.followed;
        let is_followed = |number: u8| number < 8 && followed >> number & 1 == 1;
        for announced in announce.topics().iter().filter(|announced| is_followed(announced.topic)) {
            if let Some(row) = self.row((hub, epoch, sensor, announced.topic), announced.next, arrival) {
                row.announce(announced.next);
            }
        }
    }

    /// The row of `key`, a new one that begins with `first` if there is none; nothing if there is no room.
    fn row(&mut self, key: Key, first: u32, arrival: Arrival) -> Option<&mut Row> {
        let at = match self.find(key) {
            Some(at) => at,
            None => {
                // Each life has a row at least.
                if self.row_count == ROWS {
                    let gone = self.lives.give_up((key.0, key.1), arrival)?;
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

    /// Adds the rows of a life that is `gone` to what was given up.
    fn clear(&mut self, Gone { life, is_displaced }: Gone) {
        let first = self.below(|(hub, epoch, ..)| (hub, epoch) < life);
        let end = self.below(|(hub, epoch, ..)| (hub, epoch) <= life);
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

    /// How many keys are before the first one that is not `before`.
    fn below(&self, before: impl Fn(Key) -> bool) -> usize {
        self.order[..self.row_count].partition_point(|&at| before(self.rows[usize::from(at)].key()))
    }

    /// Where in `rows` it stands.
    fn find(&self, key: Key) -> Option<usize> {
        let order = &self.order[..self.row_count];
        let found = order.binary_search_by_key(&key, |&at| self.rows[usize::from(at)].key());
        found.ok().map(|position| usize::from(order[position]))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{HEAD, Head};
    use super::*;
    use crate::Zones;
    use crate::datagram::{Announced, Packed};

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

    fn fresh(account: &mut Account, bytes: &[u8]) -> Result<Fresh, Refusal> {
        at(account, bytes, 0)
    }

    fn at(account: &mut Account, bytes: &[u8], now_ms: u64) -> Result<Fresh, Refusal> {
        account.receive(bytes, 1, now_ms * 1_000_000).map(|(_, fresh)| fresh)
    }

    /// 64 gateways that are known to deliver.
    fn full() -> Account {
        let mut account = Account::new(&Topic::ALL);
        for (number, now_ms) in [(0, 0), (1, 1000)] {
            for hub in 0..64 {
                assert_eq!(at(&mut account, &zones(head(hub, 1, number)), now_ms), Ok(Fresh::New));
            }
        }
        account
    }

    #[test]
    fn a_greater_epoch_retires_the_older_one_of_its_hub() {
        let mut account = Account::new(&Topic::ALL);
        for (hub, epoch, expected) in [
            (1, 7, Ok(Fresh::New)),
            (2, 3, Ok(Fresh::New)),
            (1, 6, Err(Refusal::Epoch)),
            (1, 8, Ok(Fresh::New)),
            (1, 7, Err(Refusal::Epoch)),
            (2, 3, Ok(Fresh::Duplicate)),
        ] {
            assert_eq!(fresh(&mut account, &zones(head(hub, epoch, 0))), expected, "{hub} {epoch}");
        }
        let rows: Vec<_> = account.rows().map(|row| (row.hub, row.epoch, row.received)).collect();
        assert_eq!(rows, [(1, 7, 1), (1, 8, 1), (2, 3, 1)]);
        assert_eq!(account.refused(Refusal::Epoch), 2);
    }

    #[test]
    fn what_is_refused_changes_nothing() {
        let mut account = Account::new(&Topic::ALL);
        let damaged = |head: Head| {
            let mut buffer = [0; 60];
            head.seal(&mut buffer, 3).unwrap().to_vec()
        };
        let refused = [
            (Refusal::Payload, damaged(head(1, 2, 0))),
            (Refusal::Payload, zones(Head { revision: 0, ..head(1, 2, 0) })),
            (Refusal::Skipped, zones(Head { topic: 8, revision: 0, ..head(1, 2, 0) })),
        ];
        for (refusal, bytes) in &refused {
            assert_eq!(fresh(&mut account, bytes), Err(*refusal));
        }
        assert_eq!(account.rows().count(), 0);
        assert_eq!(fresh(&mut account, &zones(head(1, 1, 0))), Ok(Fresh::New), "epoch 2 was not believed");
        assert_eq!(account.refused(Refusal::Payload), 2);
    }

    #[test]
    fn memory_is_bounded() {
        let mut account = full();
        assert_eq!(at(&mut account, &zones(head(64, 1, 0)), 1000), Err(Refusal::Capacity));
        assert_eq!(at(&mut account, &zones(head(1, 1, 2)), 1000), Ok(Fresh::New), "all go on");
        for sensor in 1..=240 {
            for hub in 0..4 {
                let bytes = zones(Head { sensor, ..head(hub, 1, 0) });
                assert_eq!(at(&mut account, &bytes, 1000), Ok(Fresh::New));
            }
        }
        let more = zones(Head { sensor: 241, ..head(1, 1, 0) });
        assert_eq!(at(&mut account, &more, 3999), Err(Refusal::Capacity));
        assert_eq!((account.rows().count(), account.refused(Refusal::Capacity)), (ROWS, 2));
        assert_eq!(account.given_up(), GivenUp::default());
        // Those that were silent for three seconds make room; what was received of them stays in the sum.
        assert_eq!(at(&mut account, &more, 4000), Ok(Fresh::New));
        assert_eq!(at(&mut account, &zones(head(64, 1, 0)), 4000), Ok(Fresh::New));
        let sum = account.given_up();
        assert_eq!((sum.lives, sum.displaced, sum.lost), (1, 1, 0), "one went for the row, and left its place");
        let counted: u64 = account.rows().map(|row| row.received).sum();
        assert_eq!(counted + sum.received, 128 + 1 + 4 * 240 + 2);
    }

    #[test]
    fn a_true_gateway_is_heard_at_once_after_any_number_of_invented_ones() {
        let mut account = Account::new(&Topic::ALL);
        for number in 0..2 {
            assert_eq!(at(&mut account, &zones(head(9999, 1, number)), 1000 * u64::from(number)), Ok(Fresh::New));
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
        assert!(account.knows(9999, 1) && account.knows(7777, 1), "{:?}", account.given_up());
        assert_eq!(account.given_up().displaced, account.given_up().lives);
    }

    #[test]
    fn two_gateways_with_one_number_and_one_epoch_are_never_mixed() {
        let mut account = Account::new(&Topic::ALL);
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
                assert_eq!(hear(2, &announce(8, n / 10), now_ms), Err(Refusal::Twin));
            }
            assert_eq!(hear(1, &zones(head(5, 1, n)), now_ms), Ok(Fresh::New));
            assert_eq!(hear(2, &zones(head(5, 1, 500 + n)), now_ms + 50), Err(Refusal::Twin));
        }
        // The other one goes on alone: its numbers begin anew, and none of the first one's count as lost.
        assert_eq!(hear(2, &zones(head(5, 1, 100)), 5899), Err(Refusal::Twin));
        assert_eq!(hear(2, &zones(head(5, 1, 101)), 5900), Ok(Fresh::New));
        assert!(!account.is_shared(5, 1), "a new life");
        let rows: Vec<_> = account.rows().map(|row| (row.received, row.lost())).collect();
        assert_eq!(rows, [(1, 0)]);
        let given_up = account.given_up();
        assert_eq!((given_up.lives, given_up.displaced, given_up.received, given_up.lost), (1, 0, 33, 0));
        assert_eq!(account.refused(Refusal::Twin), 34);
    }

    #[test]
    fn what_is_retired_makes_room_and_stays_in_the_sum() {
        let mut account = full();
        let fresh = |account: &mut Account, bytes: &[u8]| at(account, bytes, 1000);
        assert_eq!(fresh(&mut account, &zones(head(5, 1, 4))), Ok(Fresh::New));
        // A gateway that starts again is heard, though all places are taken.
        assert_eq!(fresh(&mut account, &zones(head(5, 2, 0))), Ok(Fresh::New));
        let mut given_up = GivenUp { lives: 1, received: 3, lost: 2, ..GivenUp::default() };
        assert_eq!((account.given_up(), account.rows().count()), (given_up, 64));
        assert_eq!(
            fresh(&mut account, &zones(head(5, 1, 5))),
            Err(Refusal::Epoch),
            "given up is not forgotten"
        );
        assert!(account.knows(5, 2) && !account.knows(5, 1));
        // A damaged one gives up nothing.
        let mut buffer = [0; 60];
        let damaged = head(5, 3, 0).seal(&mut buffer, 3).unwrap();
        assert_eq!(fresh(&mut account, damaged), Err(Refusal::Payload));
        assert!(account.knows(5, 2) && !account.knows(5, 3));
        // As many sensors as there is room for, in a life that is retired then: one row more, and it goes.
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
        let mut account = Account::new(&[Topic::Zones]);
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
}
