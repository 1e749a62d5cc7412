//! Decides when the hub reads an open port's settings back, because another process may have changed them: bytes arrive, but
//! no telegram. A port that was open before the hub, or a program of root, is not kept out by the hub's lock.

use scanhub_drivers::line::State;
use schema::{MILLIS, Nanos};

/// Deadline of the next check of an open port.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SettingsCheck {
    /// Arrival of the first bytes since the last telegram, change of the rate, or check.
    bytes_since: Option<Nanos>,
    was_silent: bool,
}

impl SettingsCheck {
    /// Notes bytes that were read at `now`.
    pub(crate) fn note_bytes(&mut self, now: Nanos) {
        self.bytes_since.get_or_insert(now);
    }

    /// Notes a telegram, or that the session has set the rate: the port has the hub's settings.
    pub(crate) fn pass(&mut self) {
        self.bytes_since = None;
    }

    /// Returns whether to read the settings back at `now`: after 300 ms of bytes without a telegram, or when the stream has
    /// just stopped, as the `state` of the session says.
    pub(crate) fn is_due(&mut self, state: State, now: Nanos) -> bool {
        let is_silent = state == State::Silent;
        let has_stopped = is_silent && !self.was_silent;
        self.was_silent = is_silent;
        let is_due = has_stopped || self.bytes_since.is_some_and(|since| now >= since + CHECK_AFTER);
        if is_due {
            self.bytes_since = None;
        }
        is_due
    }
}

/// Longer than any scanner takes for a telegram, except an LMS at 9600 and 19200 baud, where a check is wasted.
const CHECK_AFTER: Nanos = 300 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_checked_when_bytes_bring_no_telegram() {
        let mut check = SettingsCheck::default();
        let mut looks = |range: std::ops::Range<u64>, telegram_every: u64| {
            let due = range.filter(|ms| {
                let now = ms * MILLIS;
                check.note_bytes(now);
                if ms % telegram_every == 0 {
                    check.pass();
                }
                check.is_due(State::Streaming, now)
            });
            due.collect::<Vec<_>>()
        };
        assert!(looks(1..10_000, 27).is_empty(), "a stream is never checked");
        // The last telegram arrived at 9,990 ms.
        assert_eq!(looks(10_000..10_700, u64::MAX), [10_291, 10_592]);
    }

    #[test]
    fn settings_are_checked_once_when_a_stream_stops() {
        let mut check = SettingsCheck::default();
        let states = [State::Streaming, State::Silent, State::Silent, State::Probing, State::Silent];
        assert_eq!(states.map(|state| check.is_due(state, 1)), [false, true, false, false, true]);
    }
}
