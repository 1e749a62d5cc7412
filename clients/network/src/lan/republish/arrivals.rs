//! How often samples of a topic are sent over the network. A gateway may send every so many only, which its datagrams do
//! not say; what was lost on the way they do say. Time is an argument; refuses to know what comes.

/// The last few arrivals of one topic.
#[derive(Default)]
pub(super) struct Arrivals {
    last_ns: Option<u64>,
    /// Between two that were sent, of the last arrivals.
    distances_ns: [u64; KEPT],
    count: usize,
}

/// Enough that two gaps and a burst among them say nothing.
const KEPT: usize = 5;

/// What comes less often has no period: a silence is not to be taken for one, and a verdict that old says nothing.
const LONGEST_NS: u64 = 2_500_000_000;

impl Arrivals {
    /// A sample came at `now_ns`, by a clock that goes on, `steps` numbers behind the last one; 0 if nobody knows how many.
    /// The time between two that were sent, in us: the median of the last ones, the shorter one of two. 0 as long as it is
    /// not known. What is lost makes it no longer: else a bad link would keep a verdict for longer than a good one.
    pub(super) fn period_us(&mut self, now_ns: u64, steps: u64) -> u32 {
        let before_ns = self.last_ns.replace(now_ns);
        let distance_ns = before_ns.and_then(|before_ns| now_ns.checked_sub(before_ns)?.checked_div(steps));
        if let Some(distance_ns) = distance_ns.filter(|distance_ns| *distance_ns <= LONGEST_NS) {
            self.distances_ns[self.count % KEPT] = distance_ns;
            self.count += 1;
        }
        let mut known = self.distances_ns;
        let known = &mut known[..self.count.min(KEPT)];
        known.sort_unstable();
        let median_ns = known.get(known.len().saturating_sub(1) / 2);
        median_ns.map_or(0, |median_ns| (median_ns / 1000) as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use scanhub_client::clock::Moment;
    use scanhub_client::streams::Freshness;
    use scanhub_schema::{Flags, Header, Verdict};

    const MS: u64 = 1_000_000;

    fn periods_ms(arrivals_ms: &[u64]) -> Vec<u32> {
        let mut arrivals = Arrivals::default();
        arrivals_ms.iter().map(|at_ms| arrivals.period_us(at_ms * MS, 1) / 1000).collect()
    }

    #[test]
    fn it_is_the_median_of_the_last_distances() {
        assert_eq!(periods_ms(&[100, 600, 1600, 2100, 2600]), [0, 500, 500, 500, 500]);
        // What was lost, and what waited and came in a burst.
        assert_eq!(
            periods_ms(&[0, 100, 200, 500, 600, 901, 902, 903]),
            [0, 100, 100, 100, 100, 100, 100, 100]
        );
        // Thinned from now on: three tell.
        assert_eq!(periods_ms(&[0, 20, 40, 60, 80, 100, 1100, 2100, 3100]).split_off(6), [20, 20, 1000]);
    }

    #[test]
    fn what_is_lost_makes_it_no_longer() {
        let mut arrivals = Arrivals::default();
        let mut came = |at_ms: u64, steps| arrivals.period_us(at_ms * MS, steps) / 1000;
        assert_eq!([came(0, 1), came(20, 1), came(2_020, 100), came(4_020, 100)], [0, 20, 20, 20]);
        assert_eq!(came(64_020, 3_000), 20, "out of sight for a minute");
        // Another life of the gateway: how many of its numbers are of the time between is not known.
        assert_eq!([came(65_020, 0), came(65_040, 1), came(65_060, 1)], [20, 20, 20]);
    }

    #[test]
    fn a_silence_is_no_period() {
        assert_eq!(periods_ms(&[0, 90_000, 90_020, 190_000, 190_020]), [0, 0, 20, 20, 20]);
        assert_eq!(periods_ms(&[0, 2_500, 5_001, 7_501]), [0, 2_500, 2_500, 2_500]);
        assert_eq!(periods_ms(&[500, 400, 300]), [0, 0, 0], "a clock that goes back");
    }

    /// How often the verdict of a stream becomes unknown whose samples come every `period_ms` for a minute, and how long
    /// after its end it does so for good.
    /// Of `sent` one comes.
    fn followed(period_ms: u64, jitter_ms: u64, sent: u64) -> (u32, u64) {
        let (mut arrivals, mut freshness) = (Arrivals::default(), Freshness::new(at(0)));
        let mut silences = 0;
        let mut next_ms = 0;
        let mut last_ms = 0;
        for ms in 0..75_000 {
            let now = at(ms);
            if ms == next_ms && ms < 60_000 {
                let period_us = arrivals.period_us(now.monotonic_ns, sent);
                let header = Header {
                    stamp_last_ns: now.monotonic_ns,
                    period_us,
                    flags: Flags::REMOTE,
                    ..Header::default()
                };
                assert!(freshness.heard(&header, Verdict::Clear, now));
                last_ms = ms;
                let number = ms / period_ms + 1;
                next_ms = number * period_ms + number * 7 % (jitter_ms + 1);
            }
            if freshness.silence(now) {
                silences += 1;
                if next_ms >= 60_000 {
                    return (silences - 1, ms - last_ms);
                }
            }
        }
        panic!("never silent after the end");
    }

    fn at(ms: u64) -> Moment {
        Moment { monotonic_ns: ms * MS, boottime_ns: ms * MS }
    }

    #[test]
    fn a_verdict_is_as_fresh_as_its_stream_is_fast() {
        for (period_ms, jitter_ms) in [(27, 0), (27, 20), (230, 0), (400, 60), (1_000, 100), (2_000, 200)] {
            let (silences, ended_ms) = followed(period_ms, jitter_ms, 1);
            let limit_ms = 2 * (period_ms + jitter_ms) + 41;
            // Of a slow one it is not known before the second sample how slow it is.
            let before_known = u32::from(period_ms > 500);
            assert_eq!(silences, before_known, "a sample each {period_ms} ms");
            assert!(
                (500..=limit_ms.max(500)).contains(&ended_ms),
                "a sample each {period_ms} ms: {ended_ms} ms"
            );
        }
        assert!(followed(3_000, 0, 1).0 > 15, "too slow to be followed");
    }

    #[test]
    fn a_bad_link_keeps_no_verdict_for_longer() {
        // Each 30 ms one is sent, and one in two seconds comes: the verdict is known for a quarter of the time.
        assert_eq!(followed(2_010, 0, 67), (29, 500));
    }
}
