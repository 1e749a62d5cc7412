//! Splits the age of a sample into spans, as far as its stamps allow. Each span has a histogram.

use hdrhistogram::Histogram;
use scanhub_schema::{Flags, Header};
use serde::Serialize;

use crate::follow::Arrival;

/// Part of the time between the first byte of a telegram and the arrival of its sample in this process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Span {
    /// From the first byte of the telegram to its last byte: the time on the line.
    Line,
    /// From the first byte on another machine to the arrival on this machine, by the wall clocks of both machines.
    Network,
    /// From the last byte until the hub sent the sample.
    Hub,
    /// From the time at which the hub sent the sample until this process received it.
    Wake,
    /// Age on arrival: from the last byte, or the arrival on this machine, until this process received the sample.
    Age,
    /// From the first byte until this process received the sample.
    Total,
}

impl Span {
    /// All spans in the order in which they occur.
    pub(super) const ALL: [Span; 6] =
        [Span::Line, Span::Network, Span::Hub, Span::Wake, Span::Age, Span::Total];

    /// Returns the name that all output uses.
    pub(super) fn name(self) -> &'static str {
        match self {
            Span::Line => "line",
            Span::Network => "network",
            Span::Hub => "hub",
            Span::Wake => "wake",
            Span::Age => "age",
            Span::Total => "total",
        }
    }
}

/// Spans of all samples of one topic.
pub(super) struct Spans {
    /// Time, on CLOCK_MONOTONIC in ns, since which this process has been ready to receive. Earlier samples have waited,
    /// so their ages are not measured.
    since_ns: u64,
    /// Number of all samples.
    pub(super) received: u64,
    /// Number of samples that were sent before this process waited for them: samples in the history, and the first
    /// samples of a new hub.
    pub(super) before: u64,
    /// Number of samples whose stamp is ahead of this machine's clock, for example because the wall clock of another
    /// machine is ahead.
    pub(super) in_future: u64,
    /// Bits of [`Flags`] that at least one sample had.
    pub(super) flags: u8,
    ages: [Ages; Span::ALL.len()],
}

impl Spans {
    pub(super) fn new() -> Spans {
        let ages = Span::ALL.map(|_| Ages::new());
        Spans { since_ns: u64::MAX, received: 0, before: 0, in_future: 0, flags: 0, ages }
    }

    /// Excludes samples from the measurement that were sent before the time `now_ns` on CLOCK_MONOTONIC.
    pub(super) fn begin(&mut self, now_ns: u64) {
        self.since_ns = now_ns;
    }

    pub(super) fn ages(&self, span: Span) -> &Ages {
        &self.ages[span as usize]
    }

    /// Records the spans of a sample that was received at `arrival`.
    pub(super) fn take(&mut self, header: &Header, arrival: Arrival) {
        self.received += 1;
        self.flags |= header.flags;
        if header.stamp_last_ns < self.since_ns {
            self.before += 1;
            return;
        }
        let Some(age_ns) = arrival.monotonic_ns.checked_sub(header.stamp_last_ns) else {
            self.in_future += 1;
            return;
        };
        self.record(Span::Age, age_ns);
        if let Some(hub_ns) = header.hub_time_ns() {
            // The value in the header is rounded up, so it may be greater than the age.
            let hub_ns = hub_ns.min(age_ns);
            self.record(Span::Hub, hub_ns);
            self.record(Span::Wake, age_ns - hub_ns);
        }
        if header.flags & Flags::REMOTE != 0 {
            let arrival_ns = arrival.wall_ns.saturating_sub(age_ns);
            match arrival_ns.checked_sub(header.wall_ns) {
                _ if arrival_ns.abs_diff(header.wall_ns) < OWN_SAMPLE_NS => {}
                Some(network_ns) => {
                    self.record(Span::Network, network_ns);
                    self.record(Span::Total, network_ns.saturating_add(age_ns));
                }
                None => self.in_future += 1,
            }
        } else if is_from_telegram(header) {
            let line_ns = header.stamp_last_ns - header.stamp_first_ns;
            self.record(Span::Line, line_ns);
            self.record(Span::Total, line_ns.saturating_add(age_ns));
        }
    }

    fn record(&mut self, span: Span, ns: u64) {
        self.ages[span as usize].record(ns);
    }
}

/// Maximum difference between the stamps of a sample that a listener itself publishes when it receives nothing, in ns.
/// The listener reads the two clocks of this machine one after the other. A greater difference means that the sample
/// was sent over a network.
const OWN_SAMPLE_NS: u64 = 10_000;

/// Returns whether both stamps come from a telegram. In a sample that was published without a telegram, the stamps are
/// equal.
fn is_from_telegram(header: &Header) -> bool {
    header.flags & Flags::STAMP_ESTIMATED == 0 && header.stamp_first_ns < header.stamp_last_ns
}

/// Histogram of times up to 100 s, with three significant digits.
pub(super) struct Ages {
    histogram: Histogram<u64>,
    min_ns: u64,
    max_ns: u64,
}

/// Quantiles of times. Minimum and maximum are exact. The other quantiles are at most 0.1 % too high.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Quantiles {
    pub(super) count: u64,
    pub(super) min_ns: u64,
    pub(super) p50_ns: u64,
    pub(super) p90_ns: u64,
    pub(super) p99_ns: u64,
    pub(super) p999_ns: u64,
    pub(super) max_ns: u64,
}

/// Number of times from `from_ns` up to but not including `to_ns`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct HistogramBin {
    pub(super) from_ns: u64,
    pub(super) to_ns: u64,
    pub(super) count: u64,
}

const MAX_SPAN_NS: u64 = 100_000_000_000;
const SIGNIFICANT_DIGITS: u8 = 3;

impl Ages {
    pub(super) fn new() -> Ages {
        let histogram = Histogram::new_with_bounds(1, MAX_SPAN_NS, SIGNIFICANT_DIGITS);
        Ages { histogram: histogram.expect("bounds that a histogram can have"), min_ns: u64::MAX, max_ns: 0 }
    }

    pub(super) fn record(&mut self, ns: u64) {
        self.histogram.saturating_record(ns);
        self.min_ns = self.min_ns.min(ns);
        self.max_ns = self.max_ns.max(ns);
    }

    /// Returns the quantiles, or `None` if no time was recorded.
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

    /// Returns the bins from the minimum to the maximum. Their edges are 0 and the values of [`BIN_EDGES`] in each
    /// power of ten.
    pub(super) fn bins(&self) -> Vec<HistogramBin> {
        let mut bins: Vec<HistogramBin> = Vec::new();
        let mut edges = edges();
        let mut open = HistogramBin { from_ns: 0, to_ns: edges.next().unwrap_or(MAX_SPAN_NS), count: 0 };
        for step in self.histogram.iter_recorded() {
            while step.value_iterated_to() >= open.to_ns {
                let next =
                    HistogramBin { from_ns: open.to_ns, to_ns: edges.next().unwrap_or(u64::MAX), count: 0 };
                let full = std::mem::replace(&mut open, next);
                if full.count > 0 || !bins.is_empty() {
                    bins.push(full);
                }
            }
            open.count += step.count_since_last_iteration();
        }
        if open.count > 0 {
            bins.push(open);
        }
        bins
    }
}

/// Edges between bins in each power of ten, starting at 1 us.
const BIN_EDGES: [u64; 7] = [1, 2, 3, 4, 5, 6, 8];

fn edges() -> impl Iterator<Item = u64> {
    let tens = std::iter::successors(Some(1_000_u64), |ten| Some(ten * 10));
    tens.take_while(|ten| *ten < MAX_SPAN_NS).flat_map(|ten| BIN_EDGES.map(|step| step * ten))
}

#[cfg(test)]
mod tests {
    use super::*;

    const US: u64 = 1000;

    /// Returns the header of a telegram that took 15 ms and was sent 40 us after its last byte.
    fn header(last_ns: u64) -> Header {
        let (first, wall_ns) = (last_ns - 15_000 * US, 1_700_000_000_000_000_000 + last_ns);
        let mut header =
            Header { stamp_first_ns: first, stamp_last_ns: last_ns, wall_ns, ..Header::default() };
        header.set_sent_at(last_ns + 40 * US);
        header
    }

    /// Returns the arrival `age_ns` after the last byte of `header`.
    fn arrival_after(header: &Header, age_ns: u64) -> Arrival {
        Arrival { monotonic_ns: header.stamp_last_ns + age_ns, wall_ns: 0 }
    }

    fn started_spans() -> Spans {
        let mut spans = Spans::new();
        spans.begin(1_000_000 * US);
        spans
    }

    /// Returns name, maximum in us and count of each known span.
    fn known_spans(spans: &Spans) -> Vec<(&'static str, u64, u64)> {
        let max_and_count = |span: Span| {
            let quantiles = spans.ages(span).quantiles()?;
            Some((span.name(), quantiles.max_ns / US, quantiles.count))
        };
        Span::ALL.into_iter().filter_map(max_and_count).collect()
    }

    #[test]
    fn latency_is_split_into_line_hub_and_wake() {
        let mut spans = started_spans();
        let header = Header { flags: Flags::SIMULATED, ..header(2_000_000 * US) };
        spans.take(&header, arrival_after(&header, 72 * US));
        let parts = known_spans(&spans);
        let names: Vec<_> = parts.iter().map(|part| part.0).collect();
        assert_eq!(names, ["line", "hub", "wake", "age", "total"]);
        assert!(parts[0].1.abs_diff(15_000) <= 15, "{parts:?}");
        assert_eq!((parts[1].1, parts[2].1, parts[3].1), (40, 31, 72), "256 ns are the hub's unit");
        assert!(parts[4].1.abs_diff(15_072) <= 15, "{parts:?}");
        assert_eq!((spans.received, spans.before, spans.in_future, spans.flags), (1, 0, 0, Flags::SIMULATED));
    }

    #[test]
    fn history_for_late_joiners_has_no_latency() {
        let mut spans = Spans::new();
        let old = header(900_000 * US);
        spans.take(&old, arrival_after(&old, 200_000 * US));
        spans.begin(1_000_000 * US);
        spans.take(&old, arrival_after(&old, 200_000 * US));
        assert_eq!((spans.received, spans.before, known_spans(&spans).len()), (2, 2, 0));
        let new = header(1_000_000 * US);
        spans.take(&new, arrival_after(&new, 50 * US));
        assert_eq!((spans.received, spans.before, known_spans(&spans).len()), (3, 2, 5));
    }

    #[test]
    fn spans_without_known_stamps_are_omitted() {
        let names = |header: &Header| {
            let mut spans = started_spans();
            spans.take(header, arrival_after(header, 72 * US));
            known_spans(&spans).iter().map(|part| part.0).collect::<Vec<_>>()
        };
        let telegram = header(2_000_000 * US);
        let estimated = Header { flags: Flags::STAMP_ESTIMATED, ..telegram };
        assert_eq!(names(&estimated), ["hub", "wake", "age"]);
        let without_hub_time = Header { hub_time: [0; 3], ..telegram };
        assert_eq!(names(&without_hub_time), ["line", "age", "total"]);
        let status = Header { stamp_first_ns: telegram.stamp_last_ns, ..without_hub_time };
        assert_eq!(names(&status), ["age"]);
    }

    #[test]
    fn no_age_is_negative() {
        let mut spans = started_spans();
        let header = header(2_000_000 * US);
        spans.take(&header, Arrival { monotonic_ns: header.stamp_last_ns - 1, wall_ns: 0 });
        assert_eq!((spans.in_future, known_spans(&spans).len()), (1, 0));
        spans.take(&header, arrival_after(&header, 10));
        let parts = known_spans(&spans);
        assert_eq!((parts[1], parts[2]), (("hub", 0, 1), ("wake", 0, 1)), "never more than the age");
    }

    #[test]
    fn remote_latency_uses_wall_clocks() {
        let arrival = 2_000_000 * US;
        let remote = |wall_ns| Header {
            stamp_first_ns: arrival,
            stamp_last_ns: arrival,
            wall_ns,
            flags: Flags::REMOTE,
            ..Header::default()
        };
        let arrival_time = Arrival { monotonic_ns: arrival + 50 * US, wall_ns: 9_000_050 * US };
        let mut spans = started_spans();
        spans.take(&remote(8_999_000 * US), arrival_time);
        let parts = known_spans(&spans);
        assert_eq!(parts, [("network", 1_000, 1), ("age", 50, 1), ("total", 1_050, 1)]);
        // The wall clock of the other machine is ahead, but the time on this machine is known.
        spans.take(&remote(9_001_000 * US), arrival_time);
        assert_eq!((spans.in_future, known_spans(&spans)[1]), (1, ("age", 50, 2)));
        assert_eq!((known_spans(&spans)[0].2, known_spans(&spans)[2].2), (1, 1));
        // A listener itself publishes these samples when it receives nothing.
        for wall_ns in [9_000_000 * US - 300, 9_000_000 * US + 300] {
            spans.take(&remote(wall_ns), arrival_time);
        }
        assert_eq!((spans.in_future, known_spans(&spans)[0].2, known_spans(&spans)[1].2), (1, 1, 4));
    }

    fn of(times: impl IntoIterator<Item = u64>) -> Ages {
        let mut ages = Ages::new();
        times.into_iter().for_each(|ns| ages.record(ns));
        ages
    }

    #[test]
    fn computes_quantiles_of_1000_ages() {
        assert_eq!(Ages::new().quantiles(), None);
        let quantiles = of((1..=1000).rev()).quantiles().expect("a thousand");
        let Quantiles { count, min_ns, p50_ns, p90_ns, p99_ns, p999_ns, max_ns } = quantiles;
        assert_eq!(
            (count, min_ns, p50_ns, p90_ns, p99_ns, p999_ns, max_ns),
            (1000, 1, 500, 900, 990, 999, 1000)
        );
    }

    #[test]
    fn quantiles_keep_three_digits_and_exact_extremes() {
        for ns in [1_000, 72_345, 26_640_123, 99_000_000_000] {
            let quantiles = of([ns - 1, ns, ns, ns + ns / 2]).quantiles().expect("four");
            assert!((ns..=ns + ns / 1000).contains(&quantiles.p50_ns), "{ns}: {quantiles:?}");
            assert_eq!((quantiles.min_ns, quantiles.max_ns), (ns - 1, ns + ns / 2));
        }
        let quantiles = of([5, u64::MAX]).quantiles().expect("two");
        assert_eq!((quantiles.p50_ns, quantiles.max_ns), (5, u64::MAX));
    }

    #[test]
    fn histogram_counts_each_age_once() {
        assert_eq!(Ages::new().bins(), []);
        let bar = |from_us: u64, to_us: u64, count| HistogramBin {
            from_ns: from_us * 1000,
            to_ns: to_us * 1000,
            count,
        };
        let bars = of([25_000, 40_000, 49_000, 60_000, 150_000, 250_000]).bins();
        assert_eq!(bars[..3], [bar(20, 30, 1), bar(30, 40, 0), bar(40, 50, 2)]);
        assert_eq!(bars[3..6], [bar(50, 60, 0), bar(60, 80, 1), bar(80, 100, 0)]);
        assert_eq!(bars[6..], [bar(100, 200, 1), bar(200, 300, 1)]);
        assert_eq!(of([10]).bins(), [bar(0, 1, 1)]);
        assert_eq!(of([u64::MAX, 3]).bins().iter().map(|bar| bar.count).sum::<u64>(), 2);
    }
}
