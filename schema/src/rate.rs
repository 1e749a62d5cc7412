//! Rate of samples, from their number and the time that they span.

use std::time::Duration;

/// Minimum time from the first to the last sample of a rate. Samples that a topic keeps, or that waited for a subscriber,
/// arrive within microseconds, and a rate computed from them would be meaningless.
pub const MIN_RATE_SPAN: Duration = Duration::from_millis(200);

/// Returns the samples per second if `intervals` samples followed the first one, the last of them `span` after it. `None` if
/// the samples span less than [`MIN_RATE_SPAN`].
pub fn rate_hz(intervals: u64, span: Duration) -> Option<f64> {
    (span >= MIN_RATE_SPAN).then(|| intervals as f64 / span.as_secs_f64())
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
}
