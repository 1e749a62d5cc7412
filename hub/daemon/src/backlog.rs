//! What waited in a tty before this hub opened it, because a killed hub had it before: nobody knows for how long. A driver tells
//! only part of how much it is; but what waited comes faster than the line could bring it. Time is an argument.

use schema::{MILLIS, Nanos, line_time};

/// What waited and was not read yet.
#[derive(Clone, Debug)]
pub(crate) struct Backlog {
    /// When the line was read last.
    read_at: Nanos,
    /// Since when nothing came that the line could not have brought.
    calm_since: Option<Nanos>,
    /// More than so many bytes have not waited.
    left: usize,
}

impl Backlog {
    /// Of a port that is opened at `now` with `waiting` bytes, as far as its driver tells; nothing if none wait.
    pub(crate) fn new(waiting: usize, now: Nanos) -> Option<Backlog> {
        (waiting > 0).then_some(Backlog { read_at: now, calm_since: None, left: MOST })
    }

    /// `len` bytes were read at `now` from a line of `baud`. Whether they may have waited, or there may be more that did.
    pub(crate) fn take(&mut self, len: usize, baud: u32, now: Nanos) -> bool {
        let elapsed = now.saturating_sub(std::mem::replace(&mut self.read_at, now));
        self.left = self.left.saturating_sub(len);
        if line_time(len, baud) > elapsed + BURST {
            self.calm_since = None;
        }
        let calm_since = *self.calm_since.get_or_insert(now);
        self.left > 0 && now < calm_since + CALM
    }
}

/// More than a native port (64 kB) and its line discipline (4 kB) keep.
const MOST: usize = 70_000;
/// Adapters hand over what came in so much time at once.
const BURST: Nanos = 20 * MILLIS;
/// So long the driver moves what waited from one of its buffers to the next.
const CALM: Nanos = 10 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    const BAUD: u32 = 500_000;

    /// Bytes that count as having waited, of `waited` that did, in a stream of a telegram each 26 ms that is read in pieces.
    fn doubted(waited: usize) -> usize {
        let (mut now, mut left, mut doubted) = (1_000, waited, 0);
        let Some(mut backlog) = Backlog::new(waited.min(4_095), now) else { return 0 };
        for read in 0..1_000 {
            let len = if left > 0 { left.min(1_628) } else { 732 };
            now += if left > 0 { 50_000 } else { 26 * MILLIS };
            left -= left.min(len);
            // A driver that has just moved its buffers has next to nothing for a moment.
            let (len, left_behind) = if read == 2 && left > 0 { (40, len - 40) } else { (len, 0) };
            left += left_behind;
            if !backlog.take(len, BAUD, now) {
                return doubted;
            }
            doubted += len;
        }
        panic!("never over");
    }

    #[test]
    fn all_that_waited_is_doubted_and_little_else() {
        assert_eq!(doubted(0), 0);
        for waited in [1_700, 4_095, 17_024, 65_000] {
            assert!((waited..=waited + 3 * 732).contains(&doubted(waited)), "{waited}: {}", doubted(waited));
        }
    }

    #[test]
    fn a_line_that_is_faster_than_its_rate_is_believed_in_the_end() {
        let mut backlog = Backlog::new(100, 0).expect("something waits");
        let reads = (1..1_000).take_while(|read| backlog.take(1_500, BAUD, read * MILLIS)).count();
        assert!((40..50).contains(&reads), "{reads}");
    }
}
