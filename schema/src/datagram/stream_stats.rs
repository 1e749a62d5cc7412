//! The receiver's counts: what arrived, what did not, and why something was refused, exactly and in bounded memory, no
//! matter who sends. Refuses to know sockets, time and keys; it has no heap.

use super::lives::{Found, Gone, Lives};
use super::numbers::{Fresh, Key, Row};
use super::standing::Arrival;
use super::voices::Whose;
use super::{Announce, Datagram, DatagramError, Head};
use crate::Topic;

/// The most sensors and topics of all lives that are counted separately.
pub const ROWS: usize = 1024;

/// What was received, by hub, epoch, sensor and topic. 200 kB, stored inline.
///
/// Counting for a topic starts with its first datagram, or with an announcement that arrived before it: what was sent
/// before that is not counted. An announcement that arrives after the first datagram therefore says nothing about earlier
/// ones, and a late datagram from before the start moves the start back to it.
///
/// A greater epoch of a gateway retires the one before, whose rows stay. If there is no room, the life that was retired
/// first is given up, and its rows are added to [`given_up`](StreamStats::given_up): so the rows and that together always are
/// everything that was accepted. If none is retired, an active life makes room: one that never delivered a sample or is
/// silent for 3 s, the one silent for longest first; for a sample also one that has delivered for less than a second. A
/// life that is known to deliver is kept for one more minute of silence, and is never given up while it delivers; what
/// finds no room beside those is refused.
///
/// Two gateways with the same number and epoch are distinguished by their senders and by what they announce: only one of
/// them is accepted, the first that was heard. After 3 s of its silence another sender is accepted, as a new life; but not
/// after two are known to send.
pub struct StreamStats {
    /// Bit n: topic number n is listened to.
    followed: u64,
    /// Nothing is taken but what an announcement spoke of.
    only_announced: bool,
    lives: Lives,
    rows: [Row; ROWS],
    /// Positions in `rows`: of those in use, sorted by key, then of the others.
    order: [u16; ROWS],
    row_count: usize,
    given_up: GivenUp,
    refused: [u64; DatagramError::ALL.len()],
}

/// The sums of the rows that an account has given up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GivenUp {
    /// Lives of gateways.
    pub lives: u64,
    /// Of them those that were not known to be over: they made room for others.
    pub displaced: u64,
    /// Distinct numbers that arrived.
    pub received: u64,
    /// Numbers that did not arrive, and cannot any more: their epoch is over.
    pub lost: u64,
    /// Numbers that arrived again.
    pub duplicate: u64,
    /// Numbers among `received` that arrived after a higher one.
    pub reordered: u64,
}

impl StreamStats {
    /// Makes statistics with nothing received yet. Announcements are believed for `topics` only: those whose groups were
    /// joined. Of the others they would tell as lost what nobody wanted.
    pub fn new(topics: &[Topic]) -> StreamStats {
        StreamStats {
            followed: topics.iter().fold(0, |bits, topic| bits | 1 << topic.number()),
            only_announced: false,
            lives: Lives::new(),
            rows: [Row::EMPTY; ROWS],
            order: core::array::from_fn(|at| at as u16),
            row_count: 0,
            given_up: GivenUp::default(),
            refused: [0; DatagramError::ALL.len()],
        }
    }

    /// The same for who has a key: a sample is taken only of a sensor and topic that were announced, from the number on that
    /// the first announcement said; and another sender is not taken for the next life of a silent gateway. So what was sent
    /// before cannot be sent again.
    pub fn only_announced(self) -> StreamStats {
        StreamStats { only_announced: true, ..self }
    }

    /// Returns whether this sensor was announced in this life of `hub`, and neither was given up since.
    pub fn is_announced(&self, hub: u64, epoch: u32, sensor: u8) -> bool {
        self.find((hub, epoch, sensor, Announce::NUMBER)).is_some()
    }

    /// Counts a datagram that was read and is refused for a reason that these statistics do not know themselves.
    pub fn refuse(&mut self, why: DatagramError) {
        self.count(Some(why));
    }

    /// Checks and counts `bytes`, a datagram with a whole sample as it was received `from` a sender, at `now_ns` of any clock
    /// that is never set: [`read`](StreamStats::read), then [`take`](StreamStats::take). A sender is any number that others do not have, for example its address and port. What is refused is
    /// counted by its reason and changes nothing else; what is not, can be unpacked.
    ///
    /// # Errors
    ///
    /// The reason for which it is refused; it is counted, and changes nothing else.
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
    /// The reason for which it is refused; it is counted.
    pub fn read<'a>(&mut self, bytes: &'a [u8]) -> Result<Datagram<'a>, DatagramError> {
        let read = Datagram::read(bytes);
        self.count(read.err());
        read
    }

    /// Checks a part of a sample before memory is spent on it; the sample is checked and counted when it is whole. Returns
    /// whether the sample came before. Without [`only_announced`](StreamStats::only_announced) it knows nothing of parts.
    ///
    /// # Errors
    ///
    /// [`DatagramError::Epoch`], [`DatagramError::Stale`] or [`DatagramError::Untimely`], for which all of the sample would be
    /// refused; it is counted.
    pub fn check_part(&mut self, head: &Head) -> Result<bool, DatagramError> {
        if !self.only_announced {
            return Ok(false);
        }
        let row = self.find((head.hub, head.epoch, head.sensor, head.topic)).map(|at| &self.rows[at]);
        let checked = match (self.lives.find((head.hub, head.epoch)), row) {
            (Found::Over, _) => Err(DatagramError::Epoch),
            (_, None) => Err(DatagramError::Untimely),
            (_, Some(row)) if row.is_stale(head.sequence) || row.is_before(head.sequence) => {
                Err(DatagramError::Stale)
            }
            (_, Some(row)) => Ok(row.came(head.sequence)),
        };
        self.count(checked.err());
        checked
    }

    /// Takes the sender of an announcement for the gateway's, which goes on at another address and for another life of its
    /// hub: if the address that was heard is silent, and the announcement's number is ahead of all that came of its sensor.
    /// Only for announcements that nobody else can have made, with a key; other ones are a twin's until then.
    pub fn follow(&mut self, datagram: &Datagram<'_>, from: u64, now_ns: u64) {
        let head = datagram.head;
        let Found::At(slot) = self.lives.find((head.hub, head.epoch)) else { return };
        let Some(announce) = Announce::unpack(datagram.payload) else { return };
        let row = self.find((head.hub, head.epoch, head.sensor, Announce::NUMBER));
        let is_ahead = row.is_some_and(|at| self.rows[at].is_ahead(head.sequence));
        let voices = &mut self.lives.record_mut(slot).voices;
        if is_ahead && voices.judge(from, Some(announce.boot), now_ns) == Whose::Next {
            voices.move_to(from, announce.boot, now_ns);
        }
    }

    /// Checks and counts a sample that is whole, be it that it came in one datagram, or that it was put together of parts,
    /// with the header of one that came so.
    ///
    /// # Errors
    ///
    /// As [`receive`](StreamStats::receive).
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

    /// Returns what was given up to make room.
    pub fn given_up(&self) -> GivenUp {
        self.given_up
    }

    /// Returns when the first datagram of this life of `hub` was taken, if it was not given up since. Another time of the
    /// same life is another gateway, or one that was forgotten meanwhile.
    pub fn since_ns(&self, hub: u64, epoch: u32) -> Option<u64> {
        self.lives.since_ns((hub, epoch))
    }

    /// Returns whether two gateways are known to send under this number and epoch. Of one of them everything is refused as
    /// [`DatagramError::Twin`].
    pub fn is_shared(&self, hub: u64, epoch: u32) -> bool {
        match self.lives.find((hub, epoch)) {
            Found::At(slot) => self.lives.record(slot).voices.is_shared(),
            Found::Over | Found::New => false,
        }
    }

    /// Returns what is known of every sensor and topic of which anything was sent, by hub, epoch, sensor and topic.
    pub fn rows(&self) -> impl Iterator<Item = &Row> {
        self.order[..self.row_count]
            .iter()
            .map(|&at| &self.rows[usize::from(at)])
            .filter(|row| row.received + row.lost() > 0)
    }

    fn place(&mut self, datagram: &Datagram<'_>, from: u64, now_ns: u64) -> Result<Fresh, DatagramError> {
        let head = datagram.head;
        let life = (head.hub, head.epoch);
        let known = match self.lives.find(life) {
            Found::Over => return Err(DatagramError::Epoch),
            Found::At(slot) => Some(slot),
            Found::New => None,
        };
        let is_announce = head.topic == Announce::NUMBER;
        let announce = if is_announce { Announce::unpack(datagram.payload) } else { None };
        let boot = announce.map(|announce| announce.boot);
        let judge = |slot: usize| self.lives.record(slot).voices.judge(from, boot, now_ns);
        let whose = match known.map_or(Whose::Own, judge) {
            Whose::Next if self.only_announced => Whose::Twin,
            whose => whose,
        };
        if whose == Whose::Twin {
            if let Some(slot) = known.filter(|_| datagram.check_payload().is_ok()) {
                self.lives.record_mut(slot).voices.note(from, boot, now_ns);
            }
            return Err(DatagramError::Twin);
        }
        let known = known.filter(|_| whose == Whose::Own);
        let arrival = Arrival { delivers: !is_announce, now_ns };
        let key = (head.hub, head.epoch, head.sensor, head.topic);
        let is_full = self.row_count == ROWS || known.is_none() && self.lives.is_full();
        match self.find(key) {
            // All of the one that is silent makes room.
            _ if whose == Whose::Next => datagram.check_payload()?,
            Some(at) if self.rows[at].is_stale(head.sequence) => return Err(DatagramError::Stale),
            Some(at) if self.only_announced && self.rows[at].is_before(head.sequence) => {
                return Err(DatagramError::Stale);
            }
            None if self.only_announced && !is_announce => return Err(DatagramError::Untimely),
            None if is_full && !self.lives.can_give_up(life, arrival) => return Err(DatagramError::Capacity),
            _ => datagram.check_payload()?,
        }
        if whose == Whose::Next {
            self.lives.forget(life);
            self.clear(Gone { life, is_displaced: false });
        }
        let slot = known.unwrap_or_else(|| {
            let (slot, gone) = self.lives.take(life, arrival);
            if let Some(gone) = gone {
                self.clear(gone);
            }
            slot
        });
        let record = self.lives.record_mut(slot);
        record.standing.take(arrival);
        record.voices.note(from, boot, now_ns);
        let fresh = self.row(key, head.sequence, arrival).map_or(Fresh::New, |row| row.take(head.sequence));
        if let Some(announce) = announce {
            self.note(key, &announce, arrival);
        }
        Ok(fresh)
    }

    /// What has no room is not noted: it begins with its first datagram, if there is room then.
    fn note(&mut self, (hub, epoch, sensor, _): Key, announce: &Announce, arrival: Arrival) {
        let followed = self.followed;
        let is_followed = |number: u8| number < 64 && followed >> number & 1 == 1;
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
mod tests;
