//! Measures the rate of bytes that arrive while the session receives nothing that it understands, for a message.

use schema::{MILLIS, Nanos};

/// Rate of the bytes that a session has read, over windows of some seconds.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ByteRate {
    /// Start of the window, and the number of bytes read by then.
    window: Option<(Nanos, u64)>,
    /// Result of the last complete window, in bytes per second; `None` before there is one, or if almost nothing arrived.
    last: Option<u64>,
    is_complete: bool,
    /// Consecutive windows in which almost nothing arrived.
    quiet: u32,
    /// Rate in the last message, in bytes per second.
    shown: u64,
}

impl ByteRate {
    /// Notes that the session had read `read` bytes at `now`.
    pub(crate) fn note(&mut self, now: Nanos, read: u64) {
        let (since, before) = *self.window.get_or_insert((now, read));
        if !self.is_complete && read == before {
            // The first window begins with the first byte.
            self.window = Some((now, read));
            return;
        }
        if now >= since + WINDOW {
            let rate = self.of_window(now, read);
            self.quiet = if rate.is_some() { 0 } else { self.quiet + 1 };
            // Noise near the limit must not change the message with every window: each change is a log line.
            if rate.is_some() || self.quiet >= QUIET_WINDOWS {
                self.last = rate;
            }
            self.is_complete = true;
            self.window = Some((now, read));
        }
    }

    /// Returns the rate in bytes per second, rounded for a message; `None` if almost nothing arrives, or while the rate
    /// [settles](Self::is_settling). The session has read `read` bytes at `now`. A rate that varies a little is returned
    /// unchanged, because a new message is a new log line.
    pub(crate) fn shown(&mut self, now: Nanos, read: u64) -> Option<u64> {
        let rate = if self.is_complete { self.last } else { self.of_window(now, read) }?;
        if !(self.shown / 2..=self.shown * 2).contains(&rate) {
            self.shown = rounded(rate);
        }
        Some(self.shown)
    }

    /// Returns whether bytes have begun to arrive, but not long enough for a rate.
    pub(crate) fn is_settling(&self, now: Nanos, read: u64) -> bool {
        let is_begun = |(since, before)| read > before + NOISE && now < since + FIRST;
        !self.is_complete && self.window.is_some_and(is_begun)
    }

    fn of_window(&self, now: Nanos, read: u64) -> Option<u64> {
        let (since, before) = self.window?;
        let bytes = read.saturating_sub(before);
        (bytes > NOISE && now >= since + FIRST).then(|| (bytes * 1_000 * MILLIS).div_ceil(now - since))
    }
}

/// Rounds to three digits.
fn rounded(rate: u64) -> u64 {
    let unit = 10_u64.pow(rate.checked_ilog10().unwrap_or(0).saturating_sub(2));
    (rate + unit / 2) / unit * unit
}

/// Writes `number` with a comma after every three digits.
pub(crate) fn with_commas(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// Longer than a search at all rates, so that the rate of the host's port does not change the result.
const WINDOW: Nanos = 5_000 * MILLIS;
/// Time before the first rate. A scanner that returns is found within this time, and the rate of a shorter time changes
/// quickly: each change is a log line.
const FIRST: Nanos = 2_000 * MILLIS;
/// Windows without bytes after which there is no rate any more.
const QUIET_WINDOWS: u32 = 3;
/// Number of bytes that an adapter may deliver when a cable is plugged in.
const NOISE: u64 = 64;

#[cfg(test)]
mod tests {
    use super::*;

    /// Rates that a session shows, looked at ten times a second for `seconds`, of a line with `rate` bytes per second.
    fn shown(
        bytes: &mut ByteRate,
        (from, seconds): (u64, u64),
        rate: impl Fn(u64) -> u64,
    ) -> Vec<Option<u64>> {
        let mut read = 0;
        let looks = (from * 10..(from + seconds) * 10).map(|tenth| {
            let now = tenth * 100 * MILLIS;
            read += rate(tenth) / 10;
            bytes.note(now, read);
            bytes.shown(now, read)
        });
        let mut all: Vec<_> = looks.collect();
        all.dedup();
        all
    }

    #[test]
    fn rate_is_known_before_the_first_window_ends_and_stays() {
        let mut bytes = ByteRate::default();
        let steady = shown(&mut bytes, (0, 60), |tenth| if tenth % 2 == 0 { 12_000 } else { 12_840 });
        assert_eq!(steady.first(), Some(&None), "nothing was measured yet");
        assert_eq!(steady.len(), 2, "{steady:?}");
        assert!(steady[1].is_some_and(|rate| (12_000..=12_900).contains(&rate)), "{steady:?}");
    }

    #[test]
    fn bytes_that_begin_or_end_are_noticed_within_a_few_windows() {
        let mut bytes = ByteRate::default();
        assert_eq!(shown(&mut bytes, (0, 3_600), |_| 0), [None]);
        assert_eq!(shown(&mut bytes, (3_600, 10), |_| 17_625).last(), Some(&Some(17_600)));
        assert_eq!(shown(&mut bytes, (3_610, 20), |_| 0).last(), Some(&None));
        assert_eq!(shown(&mut bytes, (3_630, 10), |_| 10).last(), Some(&None), "noise of a cable");
    }

    #[test]
    fn noise_near_the_limit_does_not_change_the_message() {
        let mut bytes = ByteRate::default();
        let noise = |tenth| if tenth / 50 % 2 == 0 { 20 } else { 10 };
        let texts = shown(&mut bytes, (0, 600), noise);
        assert!(texts.len() <= 3, "{texts:?}");
    }

    #[test]
    fn rates_are_written_with_commas() {
        let numbers = [0, 999, 1_000, 12_400, 1_234_567].map(with_commas);
        assert_eq!(numbers, ["0", "999", "1,000", "12,400", "1,234,567"]);
        assert_eq!([7, 960, 1_234, 17_625].map(rounded), [7, 960, 1_230, 17_600]);
    }
}
