//! Divides the age of a sample, as far as its stamps allow: time on the line, in the hub, on the way to the consumer,
//! on another machine. Time is an argument; refuses to know how samples arrive and how the result is shown.

use scanhub_schema::{Flags, Header};

use super::ages::Ages;
use crate::follow::Arrival;

/// A stretch of a sample's way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Span {
    /// From the telegram's first byte to its last: the time on the line.
    Line,
    /// Of a sensor of another machine, from the first byte there to the arrival here: by the wall clocks of two machines.
    Network,
    /// From the last byte until the hub sent it.
    Hub,
    /// From when the hub sent it until it was received here.
    Wake,
    /// The age on arrival: from the last byte, or from the arrival on this machine, until it was received here.
    Age,
    /// From the first byte until it was received here.
    Total,
}

impl Span {
    /// In the order of a sample's way.
    pub(super) const ALL: [Span; 6] =
        [Span::Line, Span::Network, Span::Hub, Span::Wake, Span::Age, Span::Total];

    /// As in all output.
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

/// The ages of one topic's samples.
pub(super) struct Spans {
    /// Since when samples are received as they are sent.
    since_ns: u64,
    /// All samples.
    pub(super) received: u64,
    /// Those that were sent before anybody waited for them here: what a topic keeps for late joiners, and the first of a
    /// hub that was replaced.
    pub(super) before: u64,
    /// Stamps ahead of the clock here, from which no time follows: another machine's wall clock is not ours.
    pub(super) ahead: u64,
    /// Bits of [`Flags`] that any of them had.
    pub(super) flags: u8,
    ages: [Ages; Span::ALL.len()],
}

impl Spans {
    /// Nothing received yet.
    pub(super) fn new() -> Spans {
        let ages = Span::ALL.map(|_| Ages::new());
        Spans { since_ns: u64::MAX, received: 0, before: 0, ahead: 0, flags: 0, ages }
    }

    /// What was sent before `now_ns` of CLOCK_MONOTONIC is not late if it comes after.
    pub(super) fn begin(&mut self, now_ns: u64) {
        self.since_ns = now_ns;
    }

    /// The times of this stretch.
    pub(super) fn ages(&self, span: Span) -> &Ages {
        &self.ages[span as usize]
    }

    /// A sample with `header` was received.
    pub(super) fn take(&mut self, header: &Header, seen: Arrival) {
        self.received += 1;
        self.flags |= header.flags;
        if header.stamp_last_ns < self.since_ns {
            self.before += 1;
            return;
        }
        let Some(age_ns) = seen.monotonic_ns.checked_sub(header.stamp_last_ns) else {
            self.ahead += 1;
            return;
        };
        self.record(Span::Age, age_ns);
        if let Some(hub_ns) = header.hub_time_ns() {
            // It is rounded up.
            let hub_ns = hub_ns.min(age_ns);
            self.record(Span::Hub, hub_ns);
            self.record(Span::Wake, age_ns - hub_ns);
        }
        if header.flags & Flags::REMOTE != 0 {
            let arrival_ns = seen.wall_ns.saturating_sub(age_ns);
            match arrival_ns.checked_sub(header.wall_ns) {
                _ if arrival_ns.abs_diff(header.wall_ns) < OWN_WORD_NS => {}
                Some(network_ns) => {
                    self.record(Span::Network, network_ns);
                    self.record(Span::Total, network_ns.saturating_add(age_ns));
                }
                None => self.ahead += 1,
            }
        } else if is_of_bytes(header) {
            let line_ns = header.stamp_last_ns - header.stamp_first_ns;
            self.record(Span::Line, line_ns);
            self.record(Span::Total, line_ns.saturating_add(age_ns));
        }
    }

    fn record(&mut self, span: Span, ns: u64) {
        self.ages[span as usize].record(ns);
    }
}

/// What a listener says itself when it hears nothing is stamped by both clocks here, one after the other: it came over no
/// network, which takes longer than that.
const OWN_WORD_NS: u64 = 10_000;

/// Both stamps come from a telegram; they are equal in a sample that was published without one.
fn is_of_bytes(header: &Header) -> bool {
    header.flags & Flags::STAMP_ESTIMATED == 0 && header.stamp_first_ns < header.stamp_last_ns
}

#[cfg(test)]
mod tests {
    use super::*;

    const US: u64 = 1000;

    /// A telegram that took 15 ms, sent 40 us after its last byte.
    fn header(last_ns: u64) -> Header {
        let (first, wall_ns) = (last_ns - 15_000 * US, 1_700_000_000_000_000_000 + last_ns);
        let mut header =
            Header { stamp_first_ns: first, stamp_last_ns: last_ns, wall_ns, ..Header::default() };
        header.set_sent_at(last_ns + 40 * US);
        header
    }

    /// So long after `header`'s last byte.
    fn seen(header: &Header, age_ns: u64) -> Arrival {
        Arrival { monotonic_ns: header.stamp_last_ns + age_ns, wall_ns: 0 }
    }

    fn begun() -> Spans {
        let mut spans = Spans::new();
        spans.begin(1_000_000 * US);
        spans
    }

    /// Greatest time and count of each stretch that there is, in us.
    fn told(spans: &Spans) -> Vec<(&'static str, u64, u64)> {
        let told = |span: Span| {
            let quantiles = spans.ages(span).quantiles()?;
            Some((span.name(), quantiles.max_ns / US, quantiles.count))
        };
        Span::ALL.into_iter().filter_map(told).collect()
    }

    #[test]
    fn a_telegram_is_split() {
        let mut spans = begun();
        let header = Header { flags: Flags::SIMULATED, ..header(2_000_000 * US) };
        spans.take(&header, seen(&header, 72 * US));
        let parts = told(&spans);
        let names: Vec<_> = parts.iter().map(|part| part.0).collect();
        assert_eq!(names, ["line", "hub", "wake", "age", "total"]);
        assert!(parts[0].1.abs_diff(15_000) <= 15, "{parts:?}");
        assert_eq!((parts[1].1, parts[2].1, parts[3].1), (40, 31, 72), "256 ns are the hub's unit");
        assert!(parts[4].1.abs_diff(15_072) <= 15, "{parts:?}");
        assert_eq!((spans.received, spans.before, spans.ahead, spans.flags), (1, 0, 0, Flags::SIMULATED));
    }

    #[test]
    fn what_was_kept_for_late_joiners_is_no_latency() {
        let mut spans = Spans::new();
        let old = header(900_000 * US);
        spans.take(&old, seen(&old, 200_000 * US));
        spans.begin(1_000_000 * US);
        spans.take(&old, seen(&old, 200_000 * US));
        assert_eq!((spans.received, spans.before, told(&spans).len()), (2, 2, 0));
        let new = header(1_000_000 * US);
        spans.take(&new, seen(&new, 50 * US));
        assert_eq!((spans.received, spans.before, told(&spans).len()), (3, 2, 5));
    }

    #[test]
    fn what_stamps_do_not_tell_is_left_out() {
        let names = |header: &Header| {
            let mut spans = begun();
            spans.take(header, seen(header, 72 * US));
            told(&spans).iter().map(|part| part.0).collect::<Vec<_>>()
        };
        let telegram = header(2_000_000 * US);
        let estimated = Header { flags: Flags::STAMP_ESTIMATED, ..telegram };
        assert_eq!(names(&estimated), ["hub", "wake", "age"]);
        let untold = Header { hub_time: [0; 3], ..telegram };
        assert_eq!(names(&untold), ["line", "age", "total"]);
        let status = Header { stamp_first_ns: telegram.stamp_last_ns, ..untold };
        assert_eq!(names(&status), ["age"]);
    }

    #[test]
    fn no_age_is_negative() {
        let mut spans = begun();
        let header = header(2_000_000 * US);
        spans.take(&header, Arrival { monotonic_ns: header.stamp_last_ns - 1, wall_ns: 0 });
        assert_eq!((spans.ahead, told(&spans).len()), (1, 0));
        spans.take(&header, seen(&header, 10));
        let parts = told(&spans);
        assert_eq!((parts[1], parts[2]), (("hub", 0, 1), ("wake", 0, 1)), "never more than the age");
    }

    #[test]
    fn of_other_machines_there_are_wall_clocks() {
        let arrival = 2_000_000 * US;
        let remote = |wall_ns| Header {
            stamp_first_ns: arrival,
            stamp_last_ns: arrival,
            wall_ns,
            flags: Flags::REMOTE,
            ..Header::default()
        };
        let seen = Arrival { monotonic_ns: arrival + 50 * US, wall_ns: 9_000_050 * US };
        let mut spans = begun();
        spans.take(&remote(8_999_000 * US), seen);
        let parts = told(&spans);
        assert_eq!(parts, [("network", 1_000, 1), ("age", 50, 1), ("total", 1_050, 1)]);
        // Its wall clock is ahead: the stretch here is known all the same.
        spans.take(&remote(9_001_000 * US), seen);
        assert_eq!((spans.ahead, told(&spans)[1]), (1, ("age", 50, 2)));
        assert_eq!((told(&spans)[0].2, told(&spans)[2].2), (1, 1));
        // Said here, when nothing came.
        for wall_ns in [9_000_000 * US - 300, 9_000_000 * US + 300] {
            spans.take(&remote(wall_ns), seen);
        }
        assert_eq!((spans.ahead, told(&spans)[0].2, told(&spans)[1].2), (1, 1, 4));
    }
}
