//! State of the line and of the scanner in the last ten seconds, computed from counters that only grow. Time is an argument.

use std::collections::VecDeque;

use schema::{Counter, Counters, MILLIS, Nanos};

/// The counters of the last ten seconds.
pub(crate) struct Recent {
    /// When they were looked at, a second apart, the newest last.
    looks: VecDeque<(Nanos, Counters)>,
}

/// State of a line and its scanner in the last ten seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct LineHealth {
    /// Share of the bytes that were damaged while scans arrived, 0 to 1.
    pub(crate) damaged: f64,
    /// Share of the bytes that were in nothing, 0 to 1.
    pub(crate) discarded: f64,
    /// Telegrams that arrived.
    pub(crate) telegrams: u64,
    /// Restarts of the scanner.
    pub(crate) restarts: u64,
}

impl Recent {
    /// Nothing was looked at yet.
    pub(crate) fn new() -> Recent {
        Recent { looks: VecDeque::with_capacity(LOOKS) }
    }

    /// Restarts at `now`, with the `counters` of that time. Earlier bytes do not belong to the scanner.
    pub(crate) fn restart(&mut self, now: Nanos, counters: &Counters) {
        self.looks.clear();
        self.looks.push_back((now, *counters));
    }

    /// Sets the gauges of `counters`, which are those of `now`, and returns the state of the line.
    pub(crate) fn gauge(&mut self, now: Nanos, counters: &mut Counters) -> LineHealth {
        while self.looks.get(1).is_some_and(|(at, _)| now.saturating_sub(*at) >= WINDOW) {
            self.looks.pop_front();
        }
        let zero = Counters::default();
        let since = self.looks.front().map_or(&zero, |(_, counters)| counters);
        let grown = |counter| counters[counter].saturating_sub(since[counter]);
        let ppm = |part: Counter, whole: Counter| {
            (1_000_000 * grown(part)).checked_div(grown(whole)).unwrap_or(0).min(1_000_000)
        };
        let damaged = ppm(Counter::BytesDamaged, Counter::BytesRead);
        let lost = ppm(Counter::LostOnLine, Counter::DueOnLine);
        let health = LineHealth {
            damaged: damaged as f64 / 1e6,
            discarded: ppm(Counter::BytesDiscarded, Counter::BytesRead) as f64 / 1e6,
            telegrams: grown(Counter::Telegrams),
            restarts: grown(Counter::ScannerRestarts),
        };
        (counters[Counter::DamagedPpm], counters[Counter::LostPpm]) = (damaged, lost);
        if self.looks.back().is_none_or(|(at, _)| now.saturating_sub(*at) >= STEP) {
            self.looks.push_back((now, *counters));
        }
        health
    }
}

const WINDOW: Nanos = 10_000 * MILLIS;
const STEP: Nanos = 1_000 * MILLIS;
/// One before the window, one at its end.
const LOOKS: usize = (WINDOW / STEP) as usize + 2;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_of_a_search_are_not_those_of_the_scanner_that_it_finds() {
        let mut recent = Recent::new();
        let mut counters = Counters::default();
        (counters[Counter::BytesRead], counters[Counter::BytesDiscarded]) = (90_000, 90_000);
        assert_eq!(recent.gauge(0, &mut counters).discarded, 1.0);
        recent.restart(MILLIS, &counters);
        assert_eq!(recent.gauge(MILLIS, &mut counters), LineHealth::default());
        counters[Counter::BytesRead] += 1_000;
        counters[Counter::BytesDiscarded] += 100;
        assert_eq!(recent.gauge(2 * MILLIS, &mut counters).discarded, 0.1);
    }

    #[test]
    fn shares_are_those_of_the_last_ten_seconds() {
        let mut recent = Recent::new();
        let mut counters = Counters::default();
        for second in 0..40 {
            counters[Counter::BytesRead] += 1000;
            counters[Counter::DueOnLine] += 40;
            if (10..20).contains(&second) {
                counters[Counter::BytesDamaged] += 500;
                counters[Counter::LostOnLine] += 10;
            }
            counters[Counter::ScannerRestarts] += u64::from(second == 12 || second == 17);
            let health = recent.gauge(second * 1_000 * MILLIS, &mut counters);
            let restarts = [12..22, 17..27].iter().filter(|range| range.contains(&second)).count();
            assert_eq!(health.restarts, restarts as u64, "{second}");
            let told = (counters[Counter::DamagedPpm], counters[Counter::LostPpm]);
            match second {
                0..10 | 29.. => assert_eq!(told, (0, 0), "{second}"),
                19 => assert_eq!(told, (500_000, 250_000)),
                14 => assert_eq!(told, (250_000, 125_000)),
                _ => assert!(told.0 > 0 && told.0 < 500_000, "{second}: {told:?}"),
            }
        }
        assert_eq!(recent.looks.len(), 11);
    }
}
