//! Who is asked for what he said last: sensors that came, each in its turn, so many in a second. Whoever can connect can say
//! that sensors came: what waits is bounded, and the rest is counted. Refuses to know who asks, and how.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Sensors that came and were not asked yet.
pub(super) struct Asking {
    /// By hub and name, the first one for longest.
    waiting: VecDeque<(u64, Box<str>)>,
    /// How many were asked in the second that began then.
    asked: usize,
    second: Instant,
    /// Sensors that are not asked: there was no room, or the question was refused. Their announcement comes by itself.
    pub(super) unasked: u64,
}

/// The most sensors that are asked in a second.
const ASKED: usize = 64;
/// The most that wait: 16 s of it, and 96 kB of names at most.
const WAITING: usize = 1024;
const SECOND: Duration = Duration::from_secs(1);

impl Asking {
    /// Nobody came yet.
    pub(super) fn new(now: Instant) -> Asking {
        Asking { waiting: VecDeque::new(), asked: 0, second: now, unasked: 0 }
    }

    /// The sensor `name` of `hub` came.
    pub(super) fn came(&mut self, hub: u64, name: &str) {
        if self.waiting.iter().any(|(other, its)| (*other, &**its) == (hub, name)) {
            return;
        }
        if self.waiting.len() == WAITING {
            self.unasked += 1;
        } else {
            self.waiting.push_back((hub, name.into()));
        }
    }

    /// Who is to be asked now, if anybody is.
    pub(super) fn next(&mut self, now: Instant) -> Option<(u64, Box<str>)> {
        if now.saturating_duration_since(self.second) >= SECOND {
            (self.second, self.asked) = (now, 0);
        }
        if self.asked == ASKED {
            return None;
        }
        let next = self.waiting.pop_front();
        self.asked += usize::from(next.is_some());
        next
    }

    /// It is over: who waits is not asked any more.
    pub(super) fn give_up(&mut self) {
        self.unasked += self.waiting.drain(..).count() as u64;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The names of all that are asked at `now`.
    fn asked(asking: &mut Asking, now: Instant) -> Vec<String> {
        std::iter::from_fn(|| asking.next(now)).map(|(_, name)| name.into()).collect()
    }

    #[test]
    fn who_comes_with_many_others_is_asked_later() {
        let begin = Instant::now();
        let mut asking = Asking::new(begin);
        let names: Vec<_> = (0..150).map(|n| format!("s{n}")).collect();
        names.iter().for_each(|name| asking.came(5, name));
        asking.came(5, "s149");
        assert_eq!(asked(&mut asking, begin), names[..64]);
        assert_eq!(asked(&mut asking, begin + SECOND / 2), names[..0]);
        assert_eq!(asked(&mut asking, begin + SECOND), names[64..128]);
        assert_eq!((asked(&mut asking, begin + 2 * SECOND), asking.unasked), (names[128..].to_vec(), 0));
        asking.came(5, "s0");
        assert_eq!(asked(&mut asking, begin + 3 * SECOND), ["s0"], "it came again");
    }

    #[test]
    fn of_ten_thousand_that_come_at_once_the_rest_is_counted() {
        let begin = Instant::now();
        let mut asking = Asking::new(begin);
        (0..10_000).for_each(|hub| asking.came(hub, "front"));
        assert_eq!(asking.unasked, 10_000 - WAITING as u64);
        let all: usize = (0..100).map(|second| asked(&mut asking, begin + second * SECOND).len()).sum();
        assert_eq!(all, WAITING);
    }
}
