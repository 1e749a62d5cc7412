//! Counts restarts of the scanner by its clock, which starts at 0 with the scanner and wraps at 30 s.
//!
//! A sequence of packets that does not continue the one before it follows a gap, a host stall or a restart. After a gap or a
//! stall, the clock has advanced by the time that has passed. After a restart it has not, and it shows no more time than
//! has passed since the last packet. The time of arrival is known only as a range, because bytes may have waited in the host:
//! a restart counts only if no time in this range fits a clock that continued.

use scanhub_schema::{MILLIS, Nanos};

use crate::ld::packet::CLOCK_TURN;

/// The restarts of one scanner.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Restarts {
    /// Milliseconds of the last packet of a sequence, and the hub's time at which it had arrived.
    last: Option<(u16, Nanos)>,
    /// Whether the sequence that has just begun does not fit the one before it. Its second packet confirms it.
    is_suspected: bool,
    count: u64,
}

impl Restarts {
    /// Notes the first packet of a sequence with its milliseconds. It arrived between the times of `arrival`, which are
    /// `None` if they are unknown.
    pub(crate) fn note_first(&mut self, millis: u16, arrival: Option<(Nanos, Nanos)>) {
        let known = self.last.zip(arrival);
        self.is_suspected = known.is_some_and(|((last, at), (earliest, latest))| {
            let passed = (earliest.saturating_sub(at), latest.saturating_sub(at));
            began_again(last, millis, passed)
        });
    }

    /// Notes a packet that follows another one in its sequence, with its milliseconds and the time `at` which it had arrived.
    pub(crate) fn note_next(&mut self, millis: u16, at: Nanos) {
        self.count += u64::from(core::mem::take(&mut self.is_suspected));
        self.last = Some((millis, at));
    }

    /// Returns the number of restarts.
    pub(crate) fn count(&self) -> u64 {
        self.count
    }
}

/// Returns whether a clock that showed `last` milliseconds began again and then showed `millis`, between `least` and `most`
/// nanoseconds later.
fn began_again(last: u16, millis: u16, (least, most): (Nanos, Nanos)) -> bool {
    let turn = Nanos::from(CLOCK_TURN) * MILLIS;
    let tolerance = JITTER + most / DRIFT;
    let began_since = Nanos::from(millis) * MILLIS <= least + JITTER;
    let advance = (turn + Nanos::from(millis) * MILLIS - Nanos::from(last) * MILLIS) % turn;
    let missing = least.saturating_sub(tolerance).saturating_sub(advance);
    let continued = advance + missing.next_multiple_of(turn);
    began_since && continued > most + tolerance
}

/// Error of a time of arrival, and of milliseconds that are cut off.
const JITTER: Nanos = 30 * MILLIS;
/// Two clocks differ by at most one part in this many.
const DRIFT: Nanos = 100;

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Nanos = 1_000 * MILLIS;

    fn after(passed: Nanos) -> (Nanos, Nanos) {
        (passed.saturating_sub(5 * MILLIS), passed)
    }

    #[test]
    fn a_clock_that_continues_is_not_a_restart() {
        for last in [0, 1, 12_345, 29_999] {
            for passed in
                [0, 3 * MILLIS, 400 * MILLIS, 12 * SECOND, 29_990 * MILLIS, 31 * SECOND, 125 * SECOND]
            {
                for drift in [-2, 0, 2] {
                    let advance = (passed as i64 + drift * passed as i64 / 1_000) / MILLIS as i64;
                    let millis = ((i64::from(last) + advance) % i64::from(CLOCK_TURN)) as u16;
                    assert!(!began_again(last, millis, after(passed)), "{last} {passed} {drift}");
                }
            }
        }
    }

    #[test]
    fn a_clock_that_begins_again_is_a_restart() {
        for last in [5_000, 12_345, 29_000] {
            for (passed, millis) in [(350, 300), (1_200, 800), (2_300, 2_000), (40_000, 2_000)] {
                assert!(began_again(last, millis, after(passed * MILLIS)), "{last} {passed} {millis}");
            }
        }
    }

    #[test]
    fn bytes_that_waited_in_the_host_are_not_a_restart() {
        // A host that stood still for 9 s read then what was measured at some time since.
        for advance in [100, 2_000, 8_900] {
            assert!(!began_again(1_000, 1_000 + advance, (0, 9 * SECOND)), "{advance}");
        }
        // A host that was suspended: its own clock did not count that time.
        assert!(!began_again(1_000, 17_000, after(500 * MILLIS)));
    }

    #[test]
    fn one_packet_alone_proves_nothing() {
        let mut restarts = Restarts::default();
        restarts.note_first(100, Some((0, 0)));
        restarts.note_next(20_000, SECOND);
        assert_eq!(restarts.count(), 0, "first contact");
        let arrival = Some((2 * SECOND, 2 * SECOND));
        restarts.note_first(500, arrival);
        assert_eq!(restarts.count(), 0);
        restarts.note_first(21_000, arrival);
        restarts.note_next(21_003, 2 * SECOND);
        assert_eq!(restarts.count(), 0, "the one before was a chance match");
        restarts.note_first(500, None);
        restarts.note_next(503, 4 * SECOND);
        assert_eq!(restarts.count(), 0, "when it arrived is not known");
        restarts.note_first(300, Some((5 * SECOND, 5 * SECOND)));
        restarts.note_next(303, 5 * SECOND);
        assert_eq!(restarts.count(), 1);
    }
}
