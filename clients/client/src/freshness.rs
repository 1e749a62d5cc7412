//! How long what was received from a sensor, above all its zones, is valid. Time is an argument; this file does not know
//! where the data comes from and how it is used.

use std::time::Duration;

use scanhub_schema::{Flags, Header, Verdict};

use crate::clock::Moment;

/// The deadline of one sensor's verdict.
#[derive(Clone, Debug)]
pub struct Freshness {
    until: Moment,
    /// It is known already that nothing is known: nothing more is to be said in this silence.
    said: bool,
}

/// The hub says `unknown` two periods and this long after the last scan (`docs/topics.md`).
const HUB_LIMIT_NS: u64 = 20_000_000;

/// So much longer a client waits: where the hub lives its own word comes first, and one silence has one `unknown`.
const AFTER_HUB_NS: u64 = 20_000_000;

/// The limit for a sample that tells no period, enough for two periods of half degrees at 38400 baud, 0.4 s; and the least
/// one for a sample of another machine, because networks hold back what they carry, wireless ones for a tenth of a second.
const NO_PERIOD_NS: u64 = 500_000_000;

/// How long the first word may take: a hub that lives hands its last sample to newcomers ten times a second, one that
/// is just starting needs longer.
const FIRST_WORD_NS: u64 = 1_000_000_000;

impl Freshness {
    /// Makes the deadline of a sensor of which nothing was heard yet, and nobody listened before `now`.
    pub fn new(now: Moment) -> Freshness {
        Freshness { until: later(now, FIRST_WORD_NS), said: false }
    }

    /// Takes a sample with `header` and `verdict` that came in at `now`. Returns whether it may be believed. Its age counts
    /// as well as the silence after it: what waited for long is no news, and a stamp in the future keeps nothing fresh. An
    /// `unknown` stands however old it is.
    pub fn heard(&mut self, header: &Header, verdict: Verdict, now: Moment) -> bool {
        let limit_ns = match header.period_us {
            0 => NO_PERIOD_NS,
            period_us => 2000 * u64::from(period_us) + HUB_LIMIT_NS + AFTER_HUB_NS,
        };
        let is_remote = header.flags & Flags::REMOTE != 0;
        let limit_ns = if is_remote { limit_ns.max(NO_PERIOD_NS) } else { limit_ns };
        let silent_at = later(now, limit_ns);
        let aged_at_ns = header.stamp_last_ns.saturating_add(limit_ns);
        self.until = Moment { monotonic_ns: silent_at.monotonic_ns.min(aged_at_ns), ..silent_at };
        let is_unknown = verdict == Verdict::Unknown;
        let fresh = now.monotonic_ns < self.until.monotonic_ns;
        self.said = is_unknown || !fresh;
        is_unknown || fresh
    }

    /// Returns whether a verdict became too old just now; said once per silence.
    pub fn silence(&mut self, now: Moment) -> bool {
        let over = now.monotonic_ns >= self.until.monotonic_ns || now.boottime_ns >= self.until.boottime_ns;
        if self.said || !over {
            return false;
        }
        self.said = true;
        true
    }

    /// Returns how long [`silence`](Self::silence) need not be asked; nothing if only a sample can change anything.
    pub fn left(&self, now: Moment) -> Option<Duration> {
        let left_ns = self.until.monotonic_ns.saturating_sub(now.monotonic_ns);
        let awake_ns = self.until.boottime_ns.saturating_sub(now.boottime_ns);
        (!self.said).then(|| Duration::from_nanos(left_ns.min(awake_ns)))
    }
}

fn later(moment: Moment, by_ns: u64) -> Moment {
    Moment {
        monotonic_ns: moment.monotonic_ns.saturating_add(by_ns),
        boottime_ns: moment.boottime_ns.saturating_add(by_ns),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// `ms` after the machine's start; it was never suspended.
    fn at(ms: u64) -> Moment {
        Moment { monotonic_ns: ms * MS, boottime_ns: ms * MS }
    }

    fn header(stamp_ms: u64, period_us: u32) -> Header {
        Header { stamp_last_ns: stamp_ms * MS, period_us, ..Header::default() }
    }

    /// Two periods of half degrees, 20 ms, and as long again for the hub: 93.28 ms.
    const PERIOD_US: u32 = 26_640;

    #[test]
    fn one_word_per_silence() {
        let mut freshness = Freshness::new(at(0));
        freshness.heard(&header(100, PERIOD_US), Verdict::Clear, at(100));
        assert_eq!(freshness.left(at(100)), Some(Duration::from_micros(93_280)));
        assert!(!freshness.silence(at(193)));
        assert!(freshness.silence(at(194)) && !freshness.silence(at(195)) && !freshness.silence(at(90_000)));
        assert_eq!(freshness.left(at(195)), None);
        freshness.heard(&header(200, PERIOD_US), Verdict::Stop, at(200));
        assert!(!freshness.silence(at(293)) && freshness.silence(at(294)));
    }

    #[test]
    fn who_was_never_heard_is_unknown_and_one_that_is_unknown_stays_so() {
        let mut freshness = Freshness::new(at(50));
        assert_eq!(freshness.left(at(50)), Some(Duration::from_secs(1)));
        assert!(!freshness.silence(at(1049)) && freshness.silence(at(1050)) && !freshness.silence(at(9000)));
        // The hub's own word of the silence.
        assert!(freshness.heard(&header(2000, PERIOD_US), Verdict::Unknown, at(2000)));
        assert_eq!((freshness.silence(at(9000)), freshness.left(at(2000))), (false, None));
        assert!(freshness.heard(&header(2000, PERIOD_US), Verdict::Unknown, at(60_000)), "to a late joiner");
    }

    #[test]
    fn what_waited_is_no_news() {
        let mut freshness = Freshness::new(at(0));
        assert!(freshness.heard(&header(100, PERIOD_US), Verdict::Clear, at(180)));
        assert!(!freshness.silence(at(193)) && freshness.silence(at(194)));
        assert!(!freshness.heard(&header(100, PERIOD_US), Verdict::Clear, at(500)), "too old when it came");
        assert!(!freshness.silence(at(9000)), "which says enough");
        assert!(freshness.heard(&header(99_999, PERIOD_US), Verdict::Clear, at(600)));
        assert!(!freshness.silence(at(693)) && freshness.silence(at(694)), "a stamp in the future");
    }

    #[test]
    fn time_passes_while_the_machine_is_suspended() {
        let mut freshness = Freshness::new(at(0));
        freshness.heard(&header(100, PERIOD_US), Verdict::Clear, at(100));
        let resumed = Moment { boottime_ns: 3_600_000 * MS, ..at(110) };
        assert_eq!(freshness.left(resumed), Some(Duration::ZERO));
        assert!(freshness.silence(resumed));
    }

    #[test]
    fn a_network_has_half_a_second_at_least() {
        let mut freshness = Freshness::new(at(0));
        for (period_us, limit_ms) in [(0, 500), (PERIOD_US, 500), (230_000, 500), (1_000_000, 2040)] {
            let remote = Header { flags: Flags::REMOTE, ..header(100, period_us) };
            freshness.heard(&remote, Verdict::Clear, at(100));
            assert_eq!(freshness.left(at(100)), Some(Duration::from_millis(limit_ms)), "{period_us}");
        }
    }

    #[test]
    fn headers_that_say_nonsense() {
        let mut freshness = Freshness::new(at(0));
        freshness.heard(&header(100, 0), Verdict::Clear, at(100));
        assert!(!freshness.silence(at(599)) && freshness.silence(at(600)));
        let end = Header { stamp_last_ns: u64::MAX, period_us: u32::MAX, ..Header::default() };
        let last = Moment { monotonic_ns: u64::MAX, boottime_ns: u64::MAX };
        assert!(!freshness.heard(&end, Verdict::Clear, last));
    }
}
