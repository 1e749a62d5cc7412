//! Rate of the scans of a sensor and their age on arrival, over a short window. Time is an argument.

use std::collections::VecDeque;
use std::time::Duration;

use scanhub_schema::{Flags, Header};

/// Rate and ages of one sensor's scans.
#[derive(Clone, Debug, Default)]
pub struct Meter {
    /// First byte, and age on arrival where it is known, in ns.
    scans: VecDeque<(u64, Option<u64>)>,
}

impl Meter {
    /// A scan with `header` arrived at `now_ns` of CLOCK_MONOTONIC.
    pub fn scan(&mut self, header: &Header, now_ns: u64) {
        if self.scans.back().is_some_and(|(last_ns, _)| *last_ns > header.stamp_first_ns) {
            // Another recording, or another machine's clock: what was measured before goes with nothing now.
            self.scans.clear();
        }
        let is_known = header.flags & Flags::STAMP_ESTIMATED == 0;
        let age = is_known.then(|| now_ns.saturating_sub(header.stamp_last_ns));
        self.scans.push_back((header.stamp_first_ns, age));
        while self.scans.front().is_some_and(|(ns, _)| header.stamp_first_ns - ns > WINDOW_NS) {
            self.scans.pop_front();
        }
    }

    /// Returns the scans per second, or `None` while they span less than [`scanhub_schema::MIN_RATE_SPAN`].
    pub fn hz(&self) -> Option<f64> {
        let (first, last) = (self.scans.front()?.0, self.scans.back()?.0);
        scanhub_schema::rate_hz(self.scans.len() as u64 - 1, Duration::from_nanos(last - first))
    }

    /// Mean and greatest age on arrival, from the telegram's last byte, in ms.
    pub fn age_ms(&self) -> Option<(f64, f64)> {
        let ages = || self.scans.iter().filter_map(|(_, age)| *age);
        let greatest = ages().max()?;
        let mean = ages().sum::<u64>() as f64 / ages().count() as f64;
        Some((mean / 1e6, greatest as f64 / 1e6))
    }

    /// The age on arrival that half of the scans do not exceed, and that of 99 of 100, in ms.
    pub fn age_percentiles_ms(&self) -> Option<(f64, f64)> {
        let mut ages: Vec<u64> = self.scans.iter().filter_map(|(_, age)| *age).collect();
        ages.sort_unstable();
        (!ages.is_empty()).then(|| (percentile(&ages, 50), percentile(&ages, 99)))
    }
}

/// The value that `percent` of `sorted` do not exceed (nearest rank).
fn percentile(sorted: &[u64], percent: usize) -> f64 {
    let rank = (sorted.len() * percent).div_ceil(100).max(1);
    sorted.get(rank - 1).map_or(0.0, |ns| *ns as f64 / 1e6)
}

/// A number that changes with each scan cannot be read.
const WINDOW_NS: u64 = 2_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    fn header(first_ms: u64, flags: u8) -> Header {
        let stamp_first_ns = first_ms * 1_000_000;
        Header { stamp_first_ns, stamp_last_ns: stamp_first_ns + 10_000_000, flags, ..Header::default() }
    }

    #[test]
    fn rate_and_ages_are_of_the_last_two_seconds() {
        let mut meter = Meter::default();
        assert_eq!((meter.hz(), meter.age_ms()), (None, None));
        for n in 0..100 {
            // A slow beginning that is forgotten.
            let late_ms = if n < 10 { 500 } else { 1 + n % 2 * 2 };
            meter.scan(&header(n * 40, 0), (n * 40 + 10 + late_ms) * 1_000_000);
        }
        assert!((meter.hz().unwrap() - 25.0).abs() < 1e-9, "{:?}", meter.hz());
        let (mean, greatest) = meter.age_ms().unwrap();
        assert!((mean - 2.0).abs() < 0.1 && greatest == 3.0, "{mean} {greatest}");
    }

    #[test]
    fn percentiles_are_ages_that_occurred() {
        let mut meter = Meter::default();
        for n in 1..=50 {
            meter.scan(&header(n * 10, 0), (n * 10 + 10 + n) * 1_000_000);
        }
        assert_eq!(meter.age_percentiles_ms(), Some((25.0, 50.0)));
    }

    #[test]
    fn computed_stamps_have_no_age_and_clocks_that_go_back_begin_anew() {
        let mut meter = Meter::default();
        meter.scan(&header(1000, Flags::STAMP_ESTIMATED), 2_000_000_000);
        meter.scan(&header(1100, Flags::STAMP_ESTIMATED), 2_100_000_000);
        assert_eq!(meter.hz(), None, "0.1 s are too short for a rate");
        meter.scan(&header(1200, Flags::STAMP_ESTIMATED), 2_200_000_000);
        assert_eq!((meter.hz().map(f64::round), meter.age_ms()), (Some(10.0), None));
        meter.scan(&header(5, 0), 2_300_000_000);
        assert_eq!(meter.hz(), None);
    }
}
