//! The receiver's account: what came, what did not, and why something was refused, exactly and in bounded memory, whoever
//! sends. Refuses to know sockets, time and keys; it has no heap.

use super::numbers::{Fresh, Key, Row};
use super::{Announce, Datagram, Refusal};
use crate::Topic;

/// The most lives of gateways that are told apart; those of what is more are refused.
pub const LIVES: usize = 64;
/// The most sensors and topics of all lives; those of what is more are refused.
pub const ROWS: usize = 1024;

/// What was received, by hub, epoch, sensor and topic. 200 kB, wherever its owner puts it.
///
/// A topic's account begins with its first datagram, or with the first announcement that came before that: what was sent
/// before neither is not ours. An announcement that is overtaken by the first datagram therefore says nothing about what
/// was before it, and what comes late from before the beginning moves the beginning there.
///
/// Nothing is ever forgotten to make room: a retired life keeps its rows, so that what was lost in it can be told.
pub struct Account {
    /// Bit n: topic number n is listened to.
    followed: u8,
    lives: [(u64, u32); LIVES],
    life_count: usize,
    rows: [Row; ROWS],
    /// Positions in `rows`, sorted by key.
    order: [u16; ROWS],
    row_count: usize,
    refused: [u64; Refusal::ALL.len()],
}

impl Account {
    /// Nothing received yet. Announcements are believed for `topics` only: those whose groups were joined. Of the
    /// others they would tell as lost what nobody wanted.
    pub fn new(topics: &[Topic]) -> Account {
        Account {
            followed: topics.iter().fold(0, |bits, topic| bits | 1 << topic.number()),
            lives: [(0, 0); LIVES],
            life_count: 0,
            rows: [Row::EMPTY; ROWS],
            order: [0; ROWS],
            row_count: 0,
            refused: [0; Refusal::ALL.len()],
        }
    }

    /// Checks and counts `bytes`, a whole datagram as it was received. What is refused is counted by its reason and
    /// changes nothing else; what is not, can be unpacked.
    pub fn receive<'a>(&mut self, bytes: &'a [u8]) -> Result<(Datagram<'a>, Fresh), Refusal> {
        let result = Datagram::read(bytes).and_then(|datagram| Ok((datagram, self.take(&datagram)?)));
        if let Err(refusal) = result {
            self.refused[refusal as usize] += 1;
        }
        result
    }

    /// How many datagrams were refused for this reason.
    pub fn refused(&self, refusal: Refusal) -> u64 {
        self.refused[refusal as usize]
    }

    /// What is known of every sensor and topic of which anything was sent, by hub, epoch, sensor and topic.
    pub fn rows(&self) -> impl Iterator<Item = &Row> {
        self.order[..self.row_count]
            .iter()
            .map(|&at| &self.rows[usize::from(at)])
            .filter(|row| row.received + row.lost() > 0)
    }

    fn take(&mut self, datagram: &Datagram<'_>) -> Result<Fresh, Refusal> {
        let head = datagram.head;
        let life = (head.hub, head.epoch);
        let lives = &self.lives[..self.life_count];
        if lives.iter().any(|&(hub, epoch)| hub == head.hub && epoch > head.epoch) {
            return Err(Refusal::Epoch);
        }
        let is_known = lives.contains(&life);
        let key = (head.hub, head.epoch, head.sensor, head.topic);
        match self.find(key) {
            Ok(at) if self.rows[at].is_stale(head.sequence) => return Err(Refusal::Stale),
            Err(_) if self.row_count == ROWS => return Err(Refusal::Capacity),
            _ if !is_known && self.life_count == LIVES => return Err(Refusal::Capacity),
            _ => datagram.check_payload()?,
        }
        if !is_known {
            self.lives[self.life_count] = life;
            self.life_count += 1;
        }
        let fresh = self.row(key, head.sequence).map_or(Fresh::New, |row| row.take(head.sequence));
        if head.topic == Announce::NUMBER
            && let Some(announce) = Announce::unpack(datagram.payload)
        {
            self.note(key, &announce);
        }
        Ok(fresh)
    }

    /// What is more than fits is not noted: it begins with its first datagram, if that fits.
    fn note(&mut self, (hub, epoch, sensor, _): Key, announce: &Announce) {
        let followed = self.followed;
        let is_followed = |number: u8| number < 8 && followed >> number & 1 == 1;
        for announced in announce.topics().iter().filter(|announced| is_followed(announced.topic)) {
            if let Some(row) = self.row((hub, epoch, sensor, announced.topic), announced.next) {
                row.announce(announced.next);
            }
        }
    }

    /// The row of `key`, a new one that begins with `first` if there is none; nothing if there is no room.
    fn row(&mut self, key: Key, first: u32) -> Option<&mut Row> {
        let at = match self.find(key) {
            Ok(at) => at,
            Err(_) if self.row_count == ROWS => return None,
            Err(position) => {
                let at = self.row_count;
                self.order.copy_within(position..at, position + 1);
                self.order[position] = at as u16;
                self.rows[at] = Row::new(key, first);
                self.row_count += 1;
                at
            }
        };
        Some(&mut self.rows[at])
    }

    /// Where in `rows` it stands, else where in `order` it would.
    fn find(&self, key: Key) -> Result<usize, usize> {
        let order = &self.order[..self.row_count];
        let position = order.binary_search_by_key(&key, |&at| self.rows[usize::from(at)].key())?;
        Ok(usize::from(order[position]))
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
        account.receive(bytes).map(|(_, fresh)| fresh)
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
        let mut account = Account::new(&Topic::ALL);
        for hub in 0..64 {
            assert_eq!(fresh(&mut account, &zones(head(hub, 1, 0))), Ok(Fresh::New));
        }
        assert_eq!(fresh(&mut account, &zones(head(64, 1, 0))), Err(Refusal::Capacity));
        assert_eq!(fresh(&mut account, &zones(head(1, 2, 0))), Err(Refusal::Capacity));
        assert_eq!(fresh(&mut account, &zones(head(1, 1, 1))), Ok(Fresh::New), "its epoch is not retired");
        for sensor in 1..=240 {
            for hub in 0..4 {
                let bytes = zones(Head { sensor, ..head(hub, 1, 0) });
                assert_eq!(fresh(&mut account, &bytes), Ok(Fresh::New));
            }
        }
        let more = zones(Head { sensor: 241, ..head(1, 1, 0) });
        assert_eq!(fresh(&mut account, &more), Err(Refusal::Capacity));
        assert_eq!((account.rows().count(), account.refused(Refusal::Capacity)), (ROWS, 3));
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
