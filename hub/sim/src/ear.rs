//! Host bytes to requests, the way the sensor hears them: a request whose bytes came too close together or too far
//! apart is not heard at all. What a request means is [`crate::machine`]'s affair.

use lms::telegram::{FRAME, MAX_LENGTH, STX};
use lms::{MICROS, MILLIS, Nanos, line_time};

/// When a byte was written by the host, as far as that is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// It cannot have been earlier.
    pub not_before: Nanos,
    /// It cannot have been later.
    pub not_after: Nanos,
}

impl Arrival {
    /// A byte of which the time is known exactly.
    pub fn at(time: Nanos) -> Self {
        Arrival { not_before: time, not_after: time }
    }
}

/// Collects one request.
#[derive(Debug)]
pub(crate) struct Ear {
    bytes: Vec<u8>,
    /// When the last byte can have come if every gap of the request before it was right; `None` before the first.
    last: Option<Arrival>,
    broken: bool,
    /// Machine time per host time: the host keeps its gaps by its own clock, however fast the sensor runs.
    speed: f64,
}

impl Ear {
    pub(crate) fn new(speed: f64) -> Self {
        Ear { bytes: Vec::new(), last: None, broken: false, speed }
    }

    /// Takes a byte on a line of `baud` bits per second; returns the bytes of a request that is whole and whose gaps
    /// were not provably wrong. Its checksum was not looked at.
    pub(crate) fn hear(&mut self, byte: u8, arrival: Arrival, baud: u32) -> Option<Vec<u8>> {
        let speed = self.speed;
        let scaled = |span: Nanos| (span as f64 * speed) as Nanos;
        let mut possible = arrival;
        if let Some(last) = self.last {
            let byte_ns = scaled(line_time(1, baud));
            let soonest = last.not_before + byte_ns + scaled(MIN_GAP);
            let latest = last.not_after + byte_ns + scaled(MAX_GAP);
            if arrival.not_before > latest {
                self.forget();
            } else if soonest > arrival.not_after {
                self.broken = true;
            } else {
                // Several bytes seen at once must have come one after the other: each leaves less for the next.
                possible.not_before = arrival.not_before.max(soonest);
                possible.not_after = arrival.not_after.min(latest);
            }
        }
        if self.bytes.is_empty() && byte != STX {
            return None;
        }
        self.bytes.push(byte);
        self.last = Some(possible);
        let [_, _, low, high, ..] = self.bytes[..] else { return None };
        let length = usize::from(u16::from_le_bytes([low, high]));
        if !(1..=MAX_LENGTH).contains(&length) {
            self.forget();
            return None;
        }
        if self.bytes.len() < length + FRAME {
            return None;
        }
        let whole = (!self.broken).then(|| self.bytes.clone());
        self.forget();
        whole
    }

    fn forget(&mut self) {
        self.bytes.clear();
        self.last = None;
        self.broken = false;
    }
}

/// Least idle time between two bytes to the sensor (Telegram listing 4.3).
const MIN_GAP: Nanos = 55 * MICROS;
/// Most idle time between two bytes to the sensor (Telegram listing 4.3).
const MAX_GAP: Nanos = 6 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;
    use lms::command::Request;

    /// Whether a status request is heard whose bytes are known to come with `gap` of idle time between them.
    fn heard(ear: &mut Ear, start: Nanos, gap: Nanos, width: Nanos) -> bool {
        let request = Request::Status.encode(0);
        let step = line_time(1, 9_600) + gap;
        let mut heard = None;
        for (i, &byte) in request.bytes().iter().enumerate() {
            let at = start + i as Nanos * step;
            let arrival = Arrival { not_before: at.saturating_sub(width), not_after: at + width };
            heard = heard.or(ear.hear(byte, arrival, 9_600));
        }
        heard.as_deref() == Some(request.bytes())
    }

    #[test]
    fn gaps_decide_whether_a_request_is_heard() {
        for (gap, width, expected) in [
            (55 * MICROS, 0, true),
            (54 * MICROS, 0, false),
            (0, 0, false),
            (6 * MILLIS, 0, true),
            (6 * MILLIS + MICROS, 0, false),
            // Nothing is proved by bytes that may have come long before they were seen; but seven bytes within 2 ms,
            // however they came, were too fast for 9600.
            (40 * MICROS, 50 * MICROS, true),
            (0, 100 * MICROS, false),
            (6_100 * MICROS, MILLIS, true),
        ] {
            let mut ear = Ear::new(1.0);
            assert_eq!(heard(&mut ear, 1_000 * MILLIS, gap, width), expected, "{gap} {width}");
            assert!(heard(&mut ear, 2_000 * MILLIS, 100 * MICROS, 0), "not heard again after {gap}");
        }
    }

    #[test]
    fn a_request_that_came_all_at_once_needs_time_to_have_come_rightly() {
        let request = Request::Status.encode(0);
        let least = 6 * (line_time(1, 9_600) + MIN_GAP);
        for (window, expected) in [(least, true), (least - 1, false)] {
            let mut ear = Ear::new(1.0);
            let arrival = Arrival { not_before: 5 * MILLIS, not_after: 5 * MILLIS + window };
            let heard = request.bytes().iter().filter_map(|&byte| ear.hear(byte, arrival, 9_600)).count();
            assert_eq!(heard == 1, expected, "{window}");
        }
    }

    #[test]
    fn the_host_keeps_its_own_time() {
        // Four times as fast: 240 us of machine time are 60 us of the host's.
        let mut ear = Ear::new(4.0);
        let request = Request::Stop.encode(0);
        let mut heard = None;
        for (i, &byte) in request.bytes().iter().enumerate() {
            let at = 4 * i as Nanos * (line_time(1, 500_000) + 60 * MICROS);
            heard = heard.or(ear.hear(byte, Arrival::at(at), 500_000));
        }
        assert!(heard.is_some());
    }

    #[test]
    fn noise_before_a_request_is_passed_over() {
        let mut ear = Ear::new(1.0);
        for byte in [0x00, 0xFF, 0x06] {
            assert_eq!(ear.hear(byte, Arrival::at(0), 9_600), None);
        }
        assert!(heard(&mut ear, 100 * MILLIS, 100 * MICROS, 0));
        // A length that cannot be is given up at once.
        for (i, byte) in [STX, 0, 0xFF, 0xFF].into_iter().enumerate() {
            assert_eq!(ear.hear(byte, Arrival::at(200 * MILLIS + i as Nanos * 2 * MILLIS), 9_600), None);
        }
        assert!(heard(&mut ear, 210 * MILLIS, 100 * MICROS, 0));
    }
}
