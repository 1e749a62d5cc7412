//! When a byte arrived, at the latest: the port only tells when a read returned and how many bytes it brought.

use crate::{Nanos, line_time};

/// Reads, newest last, by the number of the byte after their last one.
#[derive(Clone, Debug, Default)]
pub struct Arrivals {
    reads: [(u64, Nanos); Arrivals::CAPACITY],
    next: usize,
    total: u64,
}

impl Arrivals {
    /// A packet in pieces of 16 bytes, and the one that begins inside it.
    const CAPACITY: usize = 8;

    /// A read at `now` brought `len` bytes.
    pub fn note(&mut self, now: Nanos, len: usize) {
        if len > 0 {
            self.total += len as u64;
            self.reads[self.next % Arrivals::CAPACITY] = (self.total, now);
            self.next += 1;
        }
    }

    /// When byte number `offset` was there for sure: what came behind it took its time on a line of `pace` bits per second,
    /// if it was one, but none of it was there when it was read before.
    pub fn latest(&self, offset: u64, pace: Option<u32>) -> Nanos {
        let oldest = self.next.saturating_sub(Arrivals::CAPACITY);
        let mut latest = Nanos::MAX;
        for n in (oldest..self.next).rev() {
            let (end, now) = self.reads[n % Arrivals::CAPACITY];
            if end <= offset {
                break;
            }
            let behind = pace.map_or(0, |baud| line_time((end - offset - 1) as usize, baud));
            let (_, before) = if n > oldest { self.reads[(n - 1) % Arrivals::CAPACITY] } else { (0, 0) };
            latest = latest.min(now.saturating_sub(behind).max(before));
        }
        latest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_came_behind_it_took_its_time() {
        let mut arrivals = Arrivals::default();
        arrivals.note(1_000_000, 100);
        arrivals.note(1_500_000, 0);
        arrivals.note(2_000_000, 10);
        let byte = line_time(1, 1_000_000);
        assert_eq!(arrivals.latest(99, Some(1_000_000)), 1_000_000);
        assert_eq!(arrivals.latest(90, Some(1_000_000)), 1_000_000 - 9 * byte);
        assert_eq!(arrivals.latest(109, Some(1_000_000)), 2_000_000);
        assert_eq!(arrivals.latest(90, None), 1_000_000);
        // Two reads of what had been waiting.
        arrivals.note(2_000_001, 30);
        assert_eq!(arrivals.latest(109, Some(1_000_000)), 2_000_000, "not before it was read");
        arrivals.note(3_000_000, 200);
        assert_eq!(arrivals.latest(139, Some(1_000_000)), 2_000_001, "faster than a line");
        assert_eq!(arrivals.latest(300, Some(1_000_000)), 3_000_000 - 39 * byte);
    }
}
