//! Times and durations in ns, the time that bytes take on a serial line, rates of samples, and ages as text.

use core::time::Duration;
use std::fmt;

/// A point in time or a duration, in nanoseconds of one monotonic clock that the caller chooses.
pub type Nanos = u64;

/// One millisecond in [`Nanos`].
pub const MILLIS: Nanos = 1_000_000;
/// One microsecond in [`Nanos`].
pub const MICROS: Nanos = 1_000;

/// Returns the time that `bytes` bytes take on a line of `baud` bits per second. With 8N1, a byte has 10 bits.
pub const fn line_time(bytes: usize, baud: u32) -> Nanos {
    bytes as u64 * 10 * 1_000_000_000 / baud as u64
}

/// Minimum time from the first to the last of the samples from which a rate is computed. Samples from the history of a
/// topic, or samples that waited for a subscriber, arrive within microseconds. A rate that is computed from such a
/// short time would be meaningless.
pub const MIN_RATE_SPAN: Duration = Duration::from_millis(200);

/// Returns the samples per second if `intervals` samples followed the first one, and the last sample arrived `span`
/// after the first one. `None` if the samples span less than [`MIN_RATE_SPAN`].
pub fn rate_hz(intervals: u64, span: Duration) -> Option<f64> {
    (span >= MIN_RATE_SPAN).then(|| intervals as f64 / span.as_secs_f64())
}

/// A duration in one suitable unit: `12 s`, `7 min`, `3 h` or `9 days`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Age(pub Duration);

impl fmt::Display for Age {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = self.0.as_secs();
        match seconds {
            0..120 => write!(f, "{seconds} s"),
            120..7_200 => write!(f, "{} min", seconds / 60),
            7_200..172_800 => write!(f, "{} h", seconds / 3_600),
            172_800.. => write!(f, "{} days", seconds / 86_400),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_within_a_fifth_of_a_second_have_no_rate() {
        assert_eq!(rate_hz(2, Duration::from_nanos(3060)), None);
        assert_eq!(rate_hz(0, Duration::ZERO), None);
        assert_eq!(rate_hz(14, MIN_RATE_SPAN - Duration::from_nanos(1)), None);
        assert_eq!(rate_hz(1, MIN_RATE_SPAN), Some(5.0));
    }

    #[test]
    fn age_is_written_with_rounded_units() {
        let written = |seconds| Age(Duration::from_secs(seconds)).to_string();
        let all = [0, 119, 120, 7_199, 7_200, 172_799, 172_800].map(written);
        assert_eq!(all, ["0 s", "119 s", "2 min", "119 min", "2 h", "47 h", "2 days"]);
    }
}
