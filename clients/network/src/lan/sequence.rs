//! Counters of one sensor and topic in one run of a gateway: which sequence numbers arrived, arrived late, arrived
//! again or did not arrive.

/// Number of sequence numbers, counted down from the highest one, for which it is known whether they have arrived.
/// Lower numbers are stale.
pub const WINDOW_LEN: usize = 1024;

/// Counters of one sensor and topic in one run of a gateway. Sequence numbers have 32 bits, wrap, and may arrive in any
/// order.
#[derive(Clone, Copy, Debug)]
pub struct StreamCounters {
    /// Number of the gateway.
    pub hub: u64,
    /// Epoch of the gateway's run.
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
    /// Bit n % WINDOW_LEN is set if number n of the window has arrived.
    arrived: [u64; WINDOW_LEN / 64],
}

/// A sequence number, compared with those that arrived before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SequenceStatus {
    /// Higher than all others of its topic.
    New,
    /// Arrived after a higher one.
    Late,
    /// Arrived before.
    Duplicate,
}

/// Key of a row, in the order of output: gateway, epoch, sensor, topic.
type StreamKey = (u64, u32, u8, u8);

impl StreamCounters {
    /// An unused row.
    pub(super) const EMPTY: StreamCounters = StreamCounters {
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
        arrived: [0; WINDOW_LEN / 64],
    };

    /// Creates a row that expects all numbers from `first` on.
    pub(super) fn new((hub, epoch, sensor, topic): StreamKey, first: u32) -> StreamCounters {
        // Add 2^32, so that late numbers before the first one do not become negative.
        let first = i64::from(first) + (1 << 32);
        StreamCounters { hub, epoch, sensor, topic, lowest: first, next: first, ..StreamCounters::EMPTY }
    }

    /// Returns how many numbers from the first to the last known one have not arrived. The first known number is the
    /// lowest that arrived, or the next number of an earlier announcement. The last known number is the highest that
    /// arrived, or the one before the next number of an announcement.
    pub fn lost(&self) -> u64 {
        (self.next - self.lowest) as u64 - self.received
    }

    /// Returns whether the number is so far below the highest one that it is no longer known whether it has arrived.
    pub(super) fn is_stale(&self, sequence: u32) -> bool {
        self.received > 0 && self.highest - self.number(sequence) >= WINDOW_LEN as i64
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
    pub(super) fn has_arrived(&self, sequence: u32) -> bool {
        !self.is_ahead(sequence) && self.has(self.number(sequence))
    }

    /// Returns how many numbers between the highest one that has arrived and `sequence` are missing. If none has
    /// arrived, counts from the first known number. 0 for a number that is late, or that was sent before the first
    /// announcement.
    pub(super) fn missed_before(&self, sequence: u32) -> u32 {
        let before = if self.received > 0 { self.highest + 1 } else { self.lowest };
        u32::try_from(self.number(sequence) - before).unwrap_or_default()
    }

    /// Records the arrival of a number that is not stale.
    pub(super) fn record(&mut self, sequence: u32) -> SequenceStatus {
        let number = self.number(sequence);
        let is_late = !self.is_ahead(sequence);
        if is_late && self.has(number) {
            self.duplicate += 1;
            return SequenceStatus::Duplicate;
        }
        if !is_late {
            self.advance(number);
        }
        let (word, bit) = window_bit(number);
        self.arrived[word] |= bit;
        self.received += 1;
        self.lowest = self.lowest.min(number);
        self.next = self.next.max(number.saturating_add(1));
        if is_late {
            self.reordered += 1;
            return SequenceStatus::Late;
        }
        SequenceStatus::New
    }

    /// Records that all numbers before `next` were sent. If a sample with a higher number arrived before the
    /// announcement, nothing changes.
    pub(super) fn announce(&mut self, next: u32) {
        self.next = self.next.max(self.number(next));
    }

    /// Converts `sequence` to a number that does not wrap, the one nearest to the known numbers.
    fn number(&self, sequence: u32) -> i64 {
        let known = if self.received > 0 { self.highest } else { self.next };
        known.saturating_add(i64::from(sequence.wrapping_sub(known as u32) as i32))
    }

    fn has(&self, number: i64) -> bool {
        let (word, bit) = window_bit(number);
        self.arrived[word] & bit != 0
    }

    /// Moves the window up to `number`. Neither `number` nor the numbers that the window now includes have arrived.
    fn advance(&mut self, number: i64) {
        if self.received == 0 || number - self.highest >= WINDOW_LEN as i64 {
            self.arrived = [0; WINDOW_LEN / 64];
        } else {
            for between in self.highest + 1..=number {
                let (word, bit) = window_bit(between);
                self.arrived[word] &= !bit;
            }
        }
        self.highest = number;
    }
}

/// Returns the word and the bit of a number in the window.
fn window_bit(number: i64) -> (usize, u64) {
    let at = number as usize % WINDOW_LEN;
    (at / 64, 1 << (at % 64))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(first: u32) -> StreamCounters {
        StreamCounters::new((1, 2, 3, 4), first)
    }

    fn figures(row: &StreamCounters) -> (u64, u64, u64, u64) {
        (row.received, row.lost(), row.duplicate, row.reordered)
    }

    #[test]
    fn sequence_numbers_wrap_around() {
        let mut row = row(u32::MAX - 1);
        assert_eq!(row.record(u32::MAX - 1), SequenceStatus::New);
        assert_eq!(row.record(1), SequenceStatus::New);
        assert_eq!(figures(&row), (2, 2, 0, 0));
        assert_eq!(
            (row.record(0), row.record(0), row.record(u32::MAX)),
            (SequenceStatus::Late, SequenceStatus::Duplicate, SequenceStatus::Late)
        );
        assert_eq!(figures(&row), (4, 0, 1, 2));
    }

    #[test]
    fn numbers_older_than_1024_are_stale() {
        let mut row = row(5000);
        row.record(5000);
        assert!(!row.is_stale(5000 - 1023) && row.is_stale(5000 - 1024));
        assert_eq!(row.record(5000 - 1023), SequenceStatus::Late);
        assert_eq!(figures(&row), (2, 1022, 0, 1));
        row.record(5001);
        assert!(row.is_stale(5000 - 1023));
        assert_eq!(row.record(5001 - 1023), SequenceStatus::Late, "its place in the window was another's");
    }

    #[test]
    fn announcements_reveal_losses_before_and_after() {
        let mut row = row(10);
        assert_eq!(figures(&row), (0, 0, 0, 0));
        row.announce(13);
        assert_eq!(figures(&row), (0, 3, 0, 0));
        row.record(14);
        row.announce(12);
        assert_eq!(figures(&row), (1, 4, 0, 0));
        row.announce(20);
        assert_eq!(figures(&row), (1, 9, 0, 0));
        row.record(19);
        assert_eq!(figures(&row), (2, 8, 0, 0), "announced, but none that came was higher");
    }

    #[test]
    fn counts_missed_numbers_from_the_first_known_one() {
        let take = |row: &mut StreamCounters, sequence| {
            let missed = row.missed_before(sequence);
            row.record(sequence);
            missed
        };
        let mut tracked = row(70);
        assert_eq!(take(&mut tracked, 70), 0, "numbers before the first one were not sent to this receiver");
        assert_eq!([take(&mut tracked, 74), take(&mut tracked, 72), take(&mut tracked, 75)], [3, 0, 0]);
        let mut announced = row(80);
        announced.announce(85);
        assert_eq!(take(&mut announced, 82), 2);
        let mut overtaken = row(80);
        assert_eq!(take(&mut overtaken, 78), 0, "sent before the announcement");
        let mut wrapping = row(u32::MAX);
        assert_eq!([take(&mut wrapping, u32::MAX), take(&mut wrapping, 1)], [0, 1]);
    }
}
