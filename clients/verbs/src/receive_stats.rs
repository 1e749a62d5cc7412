//! Counts of received and missed samples of one topic, and how long it may be silent.

use std::time::{Duration, Instant};

use scanhub_schema::{Pace, Topic};

use crate::line::Loss;

/// The account of one topic in one run.
#[derive(Clone, Debug)]
pub struct ReceiveStats {
    topic: Topic,
    /// Samples received.
    pub(crate) received: u64,
    /// Samples sent meanwhile and not received: missing numbers.
    pub(crate) lost: u64,
    /// Samples received as they were sent, and when the first of them came.
    live: Option<(u64, Instant)>,
    /// What the sensor's line took away in the run, where that was watched.
    pub(crate) loss: Loss,
    first: Option<Instant>,
    last: Option<Instant>,
    period: Duration,
    stale_said: bool,
}

impl ReceiveStats {
    /// Nothing received yet.
    pub(crate) fn new(topic: Topic) -> ReceiveStats {
        ReceiveStats {
            topic,
            received: 0,
            lost: 0,
            live: None,
            loss: Loss::default(),
            first: None,
            last: None,
            period: Duration::ZERO,
            stale_said: false,
        }
    }

    /// A sample came, `missed` before it did not; scans are `period_us` apart. One that `is_of_before` was sent before
    /// anybody waited for it here, and its arrival says nothing about the rate.
    pub(crate) fn count(&mut self, now: Instant, missed: u64, period_us: u32, is_of_before: bool) {
        self.received += 1;
        if !is_of_before {
            self.live.get_or_insert((0, now)).0 += 1;
        }
        self.lost += missed;
        self.first.get_or_insert(now);
        self.last = Some(now);
        self.period = Duration::from_micros(period_us.into());
        self.stale_said = false;
    }

    /// Time between the first and the last sample.
    pub(crate) fn seconds(&self) -> f64 {
        match (self.first, self.last) {
            (Some(first), Some(last)) => (last - first).as_secs_f64(),
            _ => 0.0,
        }
    }

    /// Returns the samples per second from the first sample that was received as it was sent to the last one. `None` if these
    /// are less than [`scanhub_schema::MIN_RATE_SPAN`] apart.
    pub(crate) fn hz(&self) -> Option<f64> {
        let ((live, first), last) = (self.live?, self.last?);
        scanhub_schema::rate_hz(live - 1, last - first)
    }

    /// The silence since the last sample became too long just now; said once per silence.
    pub(crate) fn stale(&mut self, now: Instant) -> bool {
        let Some(last) = self.last else { return false };
        if self.stale_said || now - last < self.deadline() {
            return false;
        }
        self.stale_said = true;
        true
    }

    /// What comes each second may be late by two; of scans ten may be missing before it is worth a word.
    fn deadline(&self) -> Duration {
        match self.topic.row().pace {
            Pace::Second => Duration::from_secs(3),
            // It comes when there is a new one.
            Pace::Change => Duration::MAX,
            Pace::Scan => (self.period * 10).max(Duration::from_secs(1)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_and_silence() {
        let mut stats = ReceiveStats::new(Topic::Scan);
        let start = Instant::now();
        assert!(!stats.stale(start + Duration::from_secs(9)));
        for i in 0..5 {
            stats.count(start + Duration::from_millis(500 * i), i, 0, false);
        }
        assert_eq!((stats.received, stats.lost, stats.seconds(), stats.hz()), (5, 10, 2.0, Some(2.0)));
        assert!(!stats.stale(start + Duration::from_millis(2900)));
        assert!(stats.stale(start + Duration::from_millis(3000)));
        assert!(!stats.stale(start + Duration::from_millis(9000)));
    }

    #[test]
    fn what_a_topic_keeps_for_late_joiners_has_no_rate() {
        let mut stats = ReceiveStats::new(Topic::Status);
        let start = Instant::now();
        stats.count(start, 0, 0, true);
        stats.count(start + Duration::from_micros(2), 0, 0, true);
        assert_eq!((stats.received, stats.hz()), (2, None));
        stats.count(start + Duration::from_millis(10), 0, 0, false);
        assert_eq!((stats.received, stats.hz()), (3, None));
        stats.count(start + Duration::from_millis(209), 0, 0, false);
        assert_eq!(stats.hz(), None, "0.2 s have not passed");
        stats.count(start + Duration::from_millis(1010), 0, 0, false);
        assert_eq!((stats.received, stats.hz()), (5, Some(2.0)));
    }
}
