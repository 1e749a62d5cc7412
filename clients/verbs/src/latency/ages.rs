//! A histogram of times with three significant digits. Refuses to know what is timed.

use hdrhistogram::Histogram;
use serde::Serialize;

/// Times, told apart up to 100 s.
pub(super) struct Ages {
    histogram: Histogram<u64>,
    min_ns: u64,
    max_ns: u64,
}

/// The order of the times, in ns: the least and the greatest as they are, what is between at most a thousandth too great.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Quantiles {
    /// How many there were.
    pub(super) count: u64,
    pub(super) min_ns: u64,
    /// Half of them took no longer.
    pub(super) p50_ns: u64,
    pub(super) p90_ns: u64,
    pub(super) p99_ns: u64,
    /// 99.9 % of them took no longer.
    pub(super) p999_ns: u64,
    pub(super) max_ns: u64,
}

/// How many times lie in `from_ns..to_ns`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Bar {
    pub(super) from_ns: u64,
    pub(super) to_ns: u64,
    pub(super) count: u64,
}

const LONGEST_NS: u64 = 100_000_000_000;
const DIGITS: u8 = 3;

impl Ages {
    /// None yet.
    pub(super) fn new() -> Ages {
        let histogram = Histogram::new_with_bounds(1, LONGEST_NS, DIGITS);
        Ages { histogram: histogram.expect("bounds that a histogram can have"), min_ns: u64::MAX, max_ns: 0 }
    }

    /// One more, of `ns`.
    pub(super) fn record(&mut self, ns: u64) {
        self.histogram.saturating_record(ns);
        self.min_ns = self.min_ns.min(ns);
        self.max_ns = self.max_ns.max(ns);
    }

    /// Their order, if there are any.
    pub(super) fn quantiles(&self) -> Option<Quantiles> {
        let (min_ns, max_ns) = (self.min_ns, self.max_ns);
        let at = |quantile| self.histogram.value_at_quantile(quantile).clamp(min_ns, max_ns);
        (!self.histogram.is_empty()).then(|| Quantiles {
            count: self.histogram.len(),
            min_ns,
            p50_ns: at(0.5),
            p90_ns: at(0.9),
            p99_ns: at(0.99),
            p999_ns: at(0.999),
            max_ns,
        })
    }

    /// From the least to the greatest, with the edges of [`STEPS`]; below the first edge it begins with 0.
    pub(super) fn bars(&self) -> Vec<Bar> {
        let mut bars: Vec<Bar> = Vec::new();
        let mut edges = edges();
        let mut open = Bar { from_ns: 0, to_ns: edges.next().unwrap_or(LONGEST_NS), count: 0 };
        for step in self.histogram.iter_recorded() {
            while step.value_iterated_to() >= open.to_ns {
                let next = Bar { from_ns: open.to_ns, to_ns: edges.next().unwrap_or(u64::MAX), count: 0 };
                let full = std::mem::replace(&mut open, next);
                if full.count > 0 || !bars.is_empty() {
                    bars.push(full);
                }
            }
            open.count += step.count_since_last_iteration();
        }
        if open.count > 0 {
            bars.push(open);
        }
        bars
    }
}

/// Of each power of ten, from 1 us on.
const STEPS: [u64; 7] = [1, 2, 3, 4, 5, 6, 8];

fn edges() -> impl Iterator<Item = u64> {
    let tens = std::iter::successors(Some(1_000_u64), |ten| Some(ten * 10));
    tens.take_while(|ten| *ten < LONGEST_NS).flat_map(|ten| STEPS.map(|step| step * ten))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(times: impl IntoIterator<Item = u64>) -> Ages {
        let mut ages = Ages::new();
        times.into_iter().for_each(|ns| ages.record(ns));
        ages
    }

    #[test]
    fn quantiles_of_a_thousand() {
        assert_eq!(Ages::new().quantiles(), None);
        let quantiles = of((1..=1000).rev()).quantiles().expect("a thousand");
        let Quantiles { count, min_ns, p50_ns, p90_ns, p99_ns, p999_ns, max_ns } = quantiles;
        assert_eq!(
            (count, min_ns, p50_ns, p90_ns, p99_ns, p999_ns, max_ns),
            (1000, 1, 500, 900, 990, 999, 1000)
        );
    }

    #[test]
    fn three_digits_are_kept_and_the_ends_as_they_are() {
        for ns in [1_000, 72_345, 26_640_123, 99_000_000_000] {
            let quantiles = of([ns - 1, ns, ns, ns + ns / 2]).quantiles().expect("four");
            assert!((ns..=ns + ns / 1000).contains(&quantiles.p50_ns), "{ns}: {quantiles:?}");
            assert_eq!((quantiles.min_ns, quantiles.max_ns), (ns - 1, ns + ns / 2));
        }
        let quantiles = of([5, u64::MAX]).quantiles().expect("two");
        assert_eq!((quantiles.p50_ns, quantiles.max_ns), (5, u64::MAX));
    }

    #[test]
    fn bars_hold_each_time_once() {
        assert_eq!(Ages::new().bars(), []);
        let bar =
            |from_us: u64, to_us: u64, count| Bar { from_ns: from_us * 1000, to_ns: to_us * 1000, count };
        let bars = of([25_000, 40_000, 49_000, 60_000, 150_000, 250_000]).bars();
        assert_eq!(bars[..3], [bar(20, 30, 1), bar(30, 40, 0), bar(40, 50, 2)]);
        assert_eq!(bars[3..6], [bar(50, 60, 0), bar(60, 80, 1), bar(80, 100, 0)]);
        assert_eq!(bars[6..], [bar(100, 200, 1), bar(200, 300, 1)]);
        assert_eq!(of([10]).bars(), [bar(0, 1, 1)]);
        assert_eq!(of([u64::MAX, 3]).bars().iter().map(|bar| bar.count).sum::<u64>(), 2);
    }
}
