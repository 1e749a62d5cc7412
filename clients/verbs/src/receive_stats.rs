//! Counts the received and missed samples of a topic. Detects a stale topic, and computes the losses on the sensor's
//! line.

use std::time::{Duration, Instant};

use scanhub_schema::{Counter, Counters, PublishRate, Topic};

/// Counters of one topic in one run.
#[derive(Clone, Debug)]
pub struct ReceiveStats {
    topic: Topic,
    /// Number of received samples.
    pub(crate) received: u64,
    /// Number of samples that were published during the run, but not received. It is computed from gaps in the sequence
    /// numbers.
    pub(crate) missed: u64,
    /// Number of samples that were sent after the run had subscribed, and the arrival time of the first of them.
    live: Option<(u64, Instant)>,
    /// Losses on the sensor's line during the run. They are known if the run receives the statuses of the sensor.
    pub(crate) loss: Loss,
    first: Option<Instant>,
    last: Option<Instant>,
    period: Duration,
    is_stale_reported: bool,
}

impl ReceiveStats {
    /// Creates the counters of a topic without samples.
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

    /// Counts a sample, and the `missed` samples before it, which did not arrive. `period_us` is the period of the
    /// scans. If `is_of_before` is set, the sample was sent before the run subscribed, so its arrival is not used for
    /// the rate.
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

    /// Returns the time between the first and the last sample in seconds.
    pub(crate) fn seconds(&self) -> f64 {
        match (self.first, self.last) {
            (Some(first), Some(last)) => (last - first).as_secs_f64(),
            _ => 0.0,
        }
    }

    /// Returns the rate in samples per second, computed from the first sample that was sent after the run had
    /// subscribed, and the last sample. Returns `None` if these two samples are less than
    /// [`scanhub_schema::MIN_RATE_SPAN`] apart.
    pub(crate) fn hz(&self) -> Option<f64> {
        let ((live, first), last) = (self.live?, self.last?);
        scanhub_schema::rate_hz(live - 1, last - first)
    }

    /// Returns whether the topic has become stale since the last call. Returns true once per silence.
    pub(crate) fn take_silence(&mut self, now: Instant) -> bool {
        let Some(last) = self.last else { return false };
        if self.is_stale_reported || now - last < self.deadline() {
            return false;
        }
        self.is_stale_reported = true;
        true
    }

    /// Returns the time without a sample after which the topic is stale. A sample of a topic that is published every
    /// second may be two seconds late. For other topics, ten scans may be missing.
    fn deadline(&self) -> Duration {
        match self.topic.spec().publish_rate {
            PublishRate::Second => Duration::from_secs(3),
            // The topic is published only after a change.
            PublishRate::Change => Duration::MAX,
            PublishRate::Scan => (self.period * 10).max(Duration::from_secs(1)),
        }
    }
}

/// Losses on a sensor's line during one run of a verb, computed from the counters in the sensor's statuses. The
/// counters start at 0 when the hub restarts.
#[derive(Clone, Debug, Default)]
pub(crate) struct LineLossCounter {
    /// Current run of the hub: its `boot`, the counters in its first status that was received, and the counters in its
    /// last status.
    current_run: Option<(u64, Counters, Counters)>,
    /// Sums of the losses during earlier runs of the hub.
    previous_runs: Sums,
}

/// Losses on a line; `None` if they are unknown.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Loss {
    /// Share of the bytes that were damaged, 0 to 1.
    pub(crate) damaged: Option<f64>,
    /// Number of scans that must have been sent by the scanner, but did not arrive at the hub.
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
    /// Adds the counters in a status of the hub with this `boot`.
    pub(crate) fn note(&mut self, boot: u64, counters: &Counters) {
        match &mut self.current_run {
            Some((run, _, last)) if *run == boot => *last = *counters,
            Some(_) => {
                self.previous_runs = self.sums();
                // The hub was started during the run of the verb, so all counts of the hub belong to the run of the
                // verb.
                self.current_run = Some((boot, Counters::default(), *counters));
            }
            None => self.current_run = Some((boot, *counters, *counters)),
        }
    }

    /// Returns the losses since the first status that was added.
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
    fn computes_rate_and_reports_silence_once() {
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
        // The counters of another run of the hub start at 0.
        line.note(2, &counters(1000, 100, 5, 2));
        assert_eq!(line.loss(), Loss { damaged: Some(0.1), lost_on_line: Some(5) });
        line.note(2, &counters(3000, 700, 50, 20));
        assert_eq!(line.loss(), Loss { damaged: Some(0.2), lost_on_line: Some(23) });
    }
}
