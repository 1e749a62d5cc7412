//! Rate and jitter over a sliding window of arrivals. Knows only their times.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// The arrivals of the last seconds.
pub(crate) struct Window {
    length: Duration,
    arrivals: VecDeque<(Instant, u64)>,
}

/// What a window says; times between arrivals in ms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rate {
    /// Arrivals per second.
    pub(crate) hz: f64,
    /// Standard deviation of the times between arrivals.
    pub(crate) jitter_ms: f64,
    /// The shortest time between two arrivals.
    pub(crate) min_ms: f64,
    /// The longest time between two arrivals.
    pub(crate) max_ms: f64,
}

impl Window {
    /// Remembers `length` of time.
    pub(crate) fn new(length: Duration) -> Window {
        Window { length, arrivals: VecDeque::new() }
    }

    /// Something arrived, `missed` before it did not.
    pub(crate) fn arrived(&mut self, now: Instant, missed: u64) {
        self.arrivals.push_back((now, missed));
    }

    /// Forgets what is older than the window.
    pub(crate) fn slide(&mut self, now: Instant) {
        while self.arrivals.front().is_some_and(|(at, _)| now - *at > self.length) {
            self.arrivals.pop_front();
        }
    }

    /// Arrivals in the window.
    pub(crate) fn received(&self) -> u64 {
        self.arrivals.len() as u64
    }

    /// What did not arrive between those in the window.
    pub(crate) fn lost(&self) -> u64 {
        self.arrivals.iter().map(|(_, missed)| missed).sum()
    }

    /// Returns the time from the first arrival in the window to the last.
    pub(crate) fn span(&self) -> Duration {
        match (self.arrivals.front(), self.arrivals.back()) {
            (Some((first, _)), Some((last, _))) => *last - *first,
            _ => Duration::ZERO,
        }
    }

    /// Returns the rate, or `None` if the arrivals span less than [`scanhub_schema::MIN_RATE_SPAN`].
    pub(crate) fn rate(&self) -> Option<Rate> {
        let span = self.span();
        let times_ms = || {
            self.arrivals
                .iter()
                .zip(self.arrivals.iter().skip(1))
                .map(|(a, b)| (b.0 - a.0).as_secs_f64() * 1e3)
        };
        let count = times_ms().count();
        let hz = scanhub_schema::rate_hz(count as u64, span)?;
        let mean = span.as_secs_f64() * 1e3 / count as f64;
        let variance = times_ms().map(|time| (time - mean).powi(2)).sum::<f64>() / count as f64;
        Some(Rate {
            hz,
            jitter_ms: variance.sqrt(),
            min_ms: times_ms().fold(f64::INFINITY, f64::min),
            max_ms: times_ms().fold(0.0, f64::max),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_of_a_window() {
        let start = Instant::now();
        let mut window = Window::new(Duration::from_secs(1));
        assert_eq!(window.rate(), None);
        let mut burst = Window::new(Duration::from_secs(1));
        for at_us in [0, 1, 3] {
            burst.arrived(start + Duration::from_micros(at_us), 0);
        }
        assert_eq!((burst.received(), burst.rate()), (3, None));
        for (at_ms, missed) in [(0, 9), (500, 0), (600, 1), (800, 0), (1200, 0)] {
            window.arrived(start + Duration::from_millis(at_ms), missed);
        }
        window.slide(start + Duration::from_millis(1200));
        assert_eq!((window.received(), window.lost()), (4, 1));
        let rate = window.rate().unwrap();
        let expected = Rate { hz: 3.0 / 0.7, jitter_ms: 124.72, min_ms: 100.0, max_ms: 400.0 };
        assert!((rate.hz - expected.hz).abs() < 1e-6 && (rate.jitter_ms - expected.jitter_ms).abs() < 0.01);
        assert!((rate.min_ms - expected.min_ms).abs() < 1e-6 && (rate.max_ms - expected.max_ms).abs() < 1e-6);
    }
}
