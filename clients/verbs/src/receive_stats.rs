//! Counts of received and missed samples of one topic, how long it may be silent, and what the line of its sensor lost.

use std::time::{Duration, Instant};

use scanhub_schema::{Counter, Counters, PublishRate, Topic};

/// Counts of one topic in one run.
#[derive(Clone, Debug)]
pub struct ReceiveStats {
    topic: Topic,
    /// Samples received.
    pub(crate) received: u64,
    /// Samples sent meanwhile and not received: missing numbers.
    pub(crate) missed: u64,
    /// Number of samples received as they were sent, and the time of the first of them.
    live: Option<(u64, Instant)>,
    /// Losses on the sensor's line in the run, if its statuses are followed.
    pub(crate) loss: Loss,
    first: Option<Instant>,
    last: Option<Instant>,
    period: Duration,
    is_stale_reported: bool,
}

impl ReceiveStats {
    /// Makes the counts of a topic without samples.
    pub(crate) fn new(topic: Topic) -> ReceiveStats {
        ReceiveStats {
            topic,
            received: 0,
            missed: 0,
            live: None,
            loss: Loss::default(),
            first: None,
            last: None,
            period: Duration::ZERO,
            is_stale_reported: false,
        }
    }

    /// A sample came, `missed` before it did not; scans are `period_us` apart. One that `is_of_before` was sent before
    /// anybody waited for it here, and its arrival says nothing about the rate.
    pub(crate) fn count(&mut self, now: Instant, missed: u64, period_us: u32, is_of_before: bool) {
        self.received += 1;
        if !is_of_before {
            self.live.get_or_insert((0, now)).0 += 1;
        }
        self.missed += missed;
        self.first.get_or_insert(now);
        self.last = Some(now);
        self.period = Duration::from_micros(period_us.into());
        self.is_stale_reported = false;
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
    pub(crate) fn take_silence(&mut self, now: Instant) -> bool {
        let Some(last) = self.last else { return false };
        if self.is_stale_reported || now - last < self.deadline() {
            return false;
        }
        self.is_stale_reported = true;
        true
    }

    /// What comes each second may be late by two; of scans ten may be missing before it is worth a word.
    fn deadline(&self) -> Duration {
        match self.topic.spec().publish_rate {
            PublishRate::Second => Duration::from_secs(3),
            // It comes when there is a new one.
            PublishRate::Change => Duration::MAX,
            PublishRate::Scan => (self.period * 10).max(Duration::from_secs(1)),
        }
    }
}

/// Losses on the line of a sensor in one run, from the counters of its statuses. They start at 0 when the hub restarts.
#[derive(Clone, Debug, Default)]
pub(crate) struct LineLossCounter {
    /// The hub's `boot`, its counters when the run first received them, and the last ones.
    current_run: Option<(u64, Counters, Counters)>,
    /// Sums of the hubs before that one.
    previous_runs: Sums,
}

/// Losses on a line in a run; `None` if they are not known.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Loss {
    /// Share of the bytes that were in nothing, 0 to 1.
    pub(crate) damaged: Option<f64>,
    /// Scans that must have been sent and did not arrive.
    pub(crate) lost_on_line: Option<u64>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    read: u64,
    damaged: u64,
    lost: u64,
    is_known: bool,
}

impl LineLossCounter {
    /// Takes the counters of a status from the hub with this `boot`.
    pub(crate) fn note(&mut self, boot: u64, counters: &Counters) {
        match &mut self.current_run {
            Some((life, _, last)) if *life == boot => *last = *counters,
            Some(_) => {
                self.previous_runs = self.sums();
                // The hub started during the run, so all its counts belong to the run.
                self.current_run = Some((boot, Counters::default(), *counters));
            }
            None => self.current_run = Some((boot, *counters, *counters)),
        }
    }

    /// Returns the losses since the first status.
    pub(crate) fn loss(&self) -> Loss {
        let Sums { read, damaged, lost, is_known } = self.sums();
        let damaged = (read > 0).then(|| (damaged as f64 / read as f64).min(1.0));
        Loss { damaged, lost_on_line: is_known.then_some(lost) }
    }

    fn sums(&self) -> Sums {
        let Some((_, first, last)) = &self.current_run else { return self.previous_runs };
        let grown = |counter| last[counter].saturating_sub(first[counter]);
        Sums {
            read: self.previous_runs.read + grown(Counter::BytesRead),
            damaged: self.previous_runs.damaged + grown(Counter::BytesDamaged),
            lost: self.previous_runs.lost + grown(Counter::LostOnLine),
            is_known: self.previous_runs.is_known || last[Counter::DueOnLine] > 0,
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
        assert!(!stats.take_silence(start + Duration::from_secs(9)));
        for i in 0..5 {
            stats.count(start + Duration::from_millis(500 * i), i, 0, false);
        }
        assert_eq!((stats.received, stats.missed, stats.seconds(), stats.hz()), (5, 10, 2.0, Some(2.0)));
        assert!(!stats.take_silence(start + Duration::from_millis(2900)));
        assert!(stats.take_silence(start + Duration::from_millis(3000)));
        assert!(!stats.take_silence(start + Duration::from_millis(9000)));
    }

    #[test]
    fn history_for_late_joiners_has_no_rate() {
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

    fn counters(read: u64, damaged: u64, due: u64, lost: u64) -> Counters {
        let mut counters = Counters::default();
        counters[Counter::BytesRead] = read;
        counters[Counter::BytesDamaged] = damaged;
        counters[Counter::DueOnLine] = due;
        counters[Counter::LostOnLine] = lost;
        counters
    }

    #[test]
    fn loss_is_the_growth_of_counters_across_hub_runs() {
        let mut line = LineLossCounter::default();
        assert_eq!(line.loss(), Loss::default());
        line.note(1, &counters(1000, 500, 0, 0));
        assert_eq!(line.loss(), Loss { damaged: None, lost_on_line: None });
        line.note(1, &counters(2000, 600, 10, 3));
        assert_eq!(line.loss(), Loss { damaged: Some(0.1), lost_on_line: Some(3) });
        // Another life of the hub counts from 0.
        line.note(2, &counters(1000, 100, 5, 2));
        assert_eq!(line.loss(), Loss { damaged: Some(0.1), lost_on_line: Some(5) });
        line.note(2, &counters(3000, 700, 50, 20));
        assert_eq!(line.loss(), Loss { damaged: Some(0.2), lost_on_line: Some(23) });
    }
}
