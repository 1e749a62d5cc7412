//! Which numbers of one sensor and topic arrived and which did not. Refuses to know where they come from: it sees 32 bits
//! that wrap, in any order, some twice.

/// Numbers below the highest that are still distinguished; older ones are stale.
pub const WINDOW: usize = 1024;

/// The account of one sensor and topic in one life of a gateway.
#[derive(Clone, Copy, Debug)]
pub struct Row {
    /// The gateway.
    pub hub: u64,
    /// Its life.
    pub epoch: u32,
    /// Position of the sensor's link in the hub's configuration.
    pub sensor: u8,
    /// The topic's number; 0 is announce.
    pub topic: u8,
    /// Distinct numbers that arrived.
    pub received: u64,
    /// Numbers that arrived again, within the window.
    pub duplicate: u64,
    /// Numbers among `received` that arrived after a higher one.
    pub reordered: u64,
    /// The first number that is known to have been sent to us, without wrapping.
    lowest: i64,
    /// The greatest one that came; nothing as long as `received` is 0.
    highest: i64,
    /// One more than the greatest that is known to have been sent.
    next: i64,
    /// Bit n % WINDOW of those in the window: n came.
    seen: [u64; WINDOW / 64],
}

/// What a datagram is compared with those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fresh {
    /// The newest of its topic.
    New,
    /// It came after a newer one.
    Late,
    /// It came before.
    Duplicate,
}

/// What tells two rows apart, in the order of output: hub, epoch, sensor, topic.
pub(super) type Key = (u64, u32, u8, u8);

impl Row {
    /// No row.
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

    /// From now on everything from `first` on is expected.
    pub(super) fn new((hub, epoch, sensor, topic): Key, first: u32) -> Row {
        // Far enough from 0 for what came before the first.
        let first = i64::from(first) + (1 << 32);
        Row { hub, epoch, sensor, topic, lowest: first, next: first, ..Row::EMPTY }
    }

    /// Numbers that were sent since the first known one and did not arrive, or not yet. The first known one is the lowest
    /// that arrived, or the next number of an earlier announcement; the last one is the highest that arrived, or the one
    /// before the next number of an announcement.
    pub fn lost(&self) -> u64 {
        (self.next - self.lowest) as u64 - self.received
    }

    pub(super) fn key(&self) -> Key {
        (self.hub, self.epoch, self.sensor, self.topic)
    }

    /// So far below the highest that nobody knows whether it came.
    pub(super) fn is_stale(&self, sequence: u32) -> bool {
        self.received > 0 && self.highest - self.number(sequence) >= WINDOW as i64
    }

    /// Sent before the first number that is known to have been sent to us.
    pub(super) fn is_before(&self, sequence: u32) -> bool {
        self.number(sequence) < self.lowest
    }

    /// Greater than all that came.
    pub(super) fn is_ahead(&self, sequence: u32) -> bool {
        self.received == 0 || self.number(sequence) > self.highest
    }

    /// It came, if it is not stale.
    pub(super) fn came(&self, sequence: u32) -> bool {
        !self.is_ahead(sequence) && self.has(self.number(sequence))
    }

    /// A number came that is not stale.
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

    /// Everything before `next` was sent. One that was overtaken by what it speaks of says nothing new.
    pub(super) fn announce(&mut self, next: u32) {
        self.next = self.next.max(self.number(next));
    }

    /// The number without wrapping: the nearest to what is known.
    fn number(&self, sequence: u32) -> i64 {
        let known = if self.received > 0 { self.highest } else { self.next };
        known.saturating_add(i64::from(sequence.wrapping_sub(known as u32) as i32))
    }

    fn has(&self, number: i64) -> bool {
        let (word, bit) = place(number);
        self.seen[word] & bit != 0
    }

    /// Moves the window up to `number`, which did not come yet, nor did what lies between.
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

/// Word and bit of a number in the window.
fn place(number: i64) -> (usize, u64) {
    let at = number as usize % WINDOW;
    (at / 64, 1 << (at % 64))
}

#[cfg(test)]
mod tests {
    use super::*;

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
