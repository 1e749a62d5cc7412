//! Host bytes to requests, as the sensor receives them. What a host writes at once leaves its UART byte by byte, which a
//! pty does not imitate: so each byte is received when the line would have carried it. A request with too long a gap is
//! dropped; a strict sensor also drops one with too short gaps. [`crate::machine`] knows what a request means.

use std::fmt;

use scanhub_drivers::lms::telegram::{FRAME, MAX_LENGTH, STX};
use schema::{MICROS, MILLIS, Nanos, line_time};

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

/// A request that was not heard, and why.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dropped {
    /// More than 6 ms passed behind the first so many of its bytes.
    LongGap {
        /// How many.
        after: usize,
    },
    /// Its bytes came less than 55 us apart, to a sensor that is strict.
    ShortGap,
}

impl fmt::Display for Dropped {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Dropped::LongGap { after } => {
                write!(f, "a request was dropped: more than 6 ms of silence after {after} of its bytes")
            }
            Dropped::ShortGap => f.write_str(
                "a request was dropped: less than 55 us between its bytes, which strict_gap=1 demands",
            ),
        }
    }
}

/// A request that was heard.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Heard {
    /// All of it; its checksum was not looked at.
    pub(crate) bytes: Vec<u8>,
    /// When the line had carried its last byte.
    pub(crate) at: Nanos,
}

/// Collects one request.
#[derive(Debug)]
pub(crate) struct RequestDecoder {
    bytes: Vec<u8>,
    /// When the last byte can have come if every gap before it was right; `None` before the first.
    last: Option<Arrival>,
    broken: bool,
    /// Whether the host itself has to leave the least gap.
    pub(crate) is_strict: bool,
    /// Machine time per host time: the host keeps its gaps by its own clock, however fast the sensor runs.
    speed: f64,
    dropped: Option<Dropped>,
}

impl RequestDecoder {
    pub(crate) fn new(speed: f64, is_strict: bool) -> Self {
        RequestDecoder { bytes: Vec::new(), last: None, broken: false, is_strict, speed, dropped: None }
    }

    /// The last request that was dropped, told once.
    pub(crate) fn take_dropped(&mut self) -> Option<Dropped> {
        self.dropped.take()
    }

    /// Takes a byte on a line of `baud` bits per second; returns a request that is whole and whose gaps were not
    /// provably wrong.
    pub(crate) fn hear(&mut self, byte: u8, arrival: Arrival, baud: u32) -> Option<Heard> {
        let possible = self.place(arrival, baud);
        self.last = Some(possible);
        if self.bytes.is_empty() && byte != STX {
            return None;
        }
        self.bytes.push(byte);
        let [_, _, low, high, ..] = self.bytes[..] else { return None };
        let length = usize::from(u16::from_le_bytes([low, high]));
        if !(1..=MAX_LENGTH).contains(&length) {
            self.forget();
            return None;
        }
        if self.bytes.len() < length + FRAME {
            return None;
        }
        let is_broken = self.broken;
        let bytes = self.forget();
        if is_broken {
            self.dropped = Some(Dropped::ShortGap);
            return None;
        }
        Some(Heard { bytes, at: possible.not_before.max(arrival.not_after) })
    }

    /// When the line can have carried a byte that came at `arrival`; drops the request that it comes too late for.
    fn place(&mut self, arrival: Arrival, baud: u32) -> Arrival {
        let Some(last) = self.last else { return arrival };
        let scaled = |span: Nanos| (span as f64 * self.speed) as Nanos;
        let byte_ns = scaled(line_time(1, baud));
        // Several bytes seen at once came one after the other: each leaves less for the next.
        let least = if self.is_strict { scaled(MIN_GAP) } else { 0 };
        let soonest = last.not_before + byte_ns + least;
        let latest = last.not_after + byte_ns + scaled(MAX_GAP);
        if arrival.not_before > latest {
            if !self.bytes.is_empty() {
                self.dropped = Some(Dropped::LongGap { after: self.bytes.len() });
            }
            self.forget();
            return arrival;
        }
        let is_host_s = self.is_strict && !self.bytes.is_empty();
        if is_host_s && soonest > arrival.not_after {
            self.broken = true;
            return arrival;
        }
        // Else a UART keeps it until it is through with the one before.
        let carried = if is_host_s { 0 } else { last.not_after + byte_ns };
        Arrival {
            not_before: arrival.not_before.max(soonest),
            not_after: arrival.not_after.max(carried).min(latest),
        }
    }

    fn forget(&mut self) -> Vec<u8> {
        self.broken = false;
        std::mem::take(&mut self.bytes)
    }
}

/// Least idle time between two bytes to the sensor (Telegram listing 4.3).
const MIN_GAP: Nanos = 55 * MICROS;
/// Most idle time between two bytes to the sensor (Telegram listing 4.3).
const MAX_GAP: Nanos = 6 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_drivers::lms::command::Request;

    /// When a status request is heard whose bytes are known to come with `gap` of idle time between them.
    fn heard_at(decoder: &mut RequestDecoder, start: Nanos, gap: Nanos, width: Nanos) -> Option<Nanos> {
        let request = Request::Status.encode(0);
        let step = line_time(1, 9_600) + gap;
        let mut heard = None;
        for (i, &byte) in request.bytes().iter().enumerate() {
            let at = start + i as Nanos * step;
            let arrival = Arrival { not_before: at.saturating_sub(width), not_after: at + width };
            heard = heard.or(decoder.hear(byte, arrival, 9_600));
        }
        heard.filter(|heard| heard.bytes == request.bytes()).map(|heard| heard.at)
    }

    fn heard(decoder: &mut RequestDecoder, start: Nanos, gap: Nanos, width: Nanos) -> bool {
        heard_at(decoder, start, gap, width).is_some()
    }

    /// When a status request is heard that is written at once at `start`.
    fn written_at_once(decoder: &mut RequestDecoder, start: Nanos, baud: u32) -> Option<Nanos> {
        let request = Request::Status.encode(0);
        let heard =
            request.bytes().iter().filter_map(|&byte| decoder.hear(byte, Arrival::at(start), baud)).last();
        heard.filter(|heard| heard.bytes == request.bytes()).map(|heard| heard.at)
    }

    #[test]
    fn what_is_written_at_once_is_heard_when_the_line_has_carried_it() {
        let mut decoder = RequestDecoder::new(1.0, false);
        for (round, baud) in [9_600, 19_200, 38_400, 500_000].repeat(25).into_iter().enumerate() {
            let start = (round as Nanos + 1) * 1_000 * MILLIS;
            assert_eq!(written_at_once(&mut decoder, start, baud), Some(start + 6 * line_time(1, baud)));
            // As some drivers do: 55 us from one byte to the next, whatever the rate.
            let request = Request::Stop.encode(0);
            let bytes = request.bytes().iter().enumerate();
            let at = |i: usize| Arrival::at(start + 500 * MILLIS + i as Nanos * 55 * MICROS);
            assert!(bytes.filter_map(|(i, &byte)| decoder.hear(byte, at(i), baud)).count() == 1);
        }
        assert_eq!(decoder.take_dropped(), None);
    }

    #[test]
    fn a_second_request_waits_for_the_first_one_to_leave() {
        let mut decoder = RequestDecoder::new(1.0, false);
        let byte_ns = line_time(1, 9_600);
        assert_eq!(written_at_once(&mut decoder, 0, 9_600), Some(6 * byte_ns));
        assert_eq!(written_at_once(&mut decoder, 0, 9_600), Some(13 * byte_ns));
        // Noise takes its time too.
        decoder.hear(0xFF, Arrival::at(0), 9_600);
        assert_eq!(written_at_once(&mut decoder, 0, 9_600), Some(21 * byte_ns));
    }

    #[test]
    fn a_long_gap_drops_a_request() {
        for (gap, width, expected) in [
            (0, 0, true),
            (54 * MICROS, 0, true),
            (6 * MILLIS, 0, true),
            (6 * MILLIS + MICROS, 0, false),
            // Nothing is proved by bytes that may have come long before they were seen.
            (6_100 * MICROS, MILLIS, true),
        ] {
            let mut decoder = RequestDecoder::new(1.0, false);
            assert_eq!(heard(&mut decoder, 1_000 * MILLIS, gap, width), expected, "{gap} {width}");
            assert_eq!(decoder.take_dropped(), (!expected).then_some(Dropped::LongGap { after: 1 }), "{gap}");
            assert!(heard(&mut decoder, 2_000 * MILLIS, 100 * MICROS, 0), "not heard again after {gap}");
            assert_eq!(decoder.take_dropped(), None);
        }
        // What was written at once is on the line for as long as that takes, and the gap begins behind it.
        let request = Request::Status.encode(0);
        let (head, tail) = request.bytes().split_at(4);
        let byte_ns = line_time(1, 9_600);
        for (pause, expected) in [(4 * byte_ns + 6 * MILLIS, true), (4 * byte_ns + 6 * MILLIS + 1, false)] {
            let mut decoder = RequestDecoder::new(1.0, false);
            assert!(head.iter().all(|&byte| decoder.hear(byte, Arrival::at(0), 9_600).is_none()));
            let heard = tail.iter().filter_map(|&byte| decoder.hear(byte, Arrival::at(pause), 9_600)).count();
            assert_eq!(heard == 1, expected, "{pause}");
            assert_eq!(decoder.take_dropped(), (!expected).then_some(Dropped::LongGap { after: 4 }));
        }
    }

    #[test]
    fn short_gaps_decide_for_a_strict_sensor() {
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
            let mut decoder = RequestDecoder::new(1.0, true);
            assert_eq!(heard(&mut decoder, 1_000 * MILLIS, gap, width), expected, "{gap} {width}");
            let dropped = if gap < MIN_GAP { Dropped::ShortGap } else { Dropped::LongGap { after: 1 } };
            assert_eq!(decoder.take_dropped(), (!expected).then_some(dropped), "{gap} {width}");
            assert!(heard(&mut decoder, 2_000 * MILLIS, 100 * MICROS, 0), "not heard again after {gap}");
        }
    }

    #[test]
    fn a_request_that_came_all_at_once_needs_time_to_have_come_rightly() {
        let request = Request::Status.encode(0);
        let least = 6 * (line_time(1, 9_600) + MIN_GAP);
        for (window, expected) in [(least, true), (least - 1, false)] {
            let mut decoder = RequestDecoder::new(1.0, true);
            let arrival = Arrival { not_before: 5 * MILLIS, not_after: 5 * MILLIS + window };
            let heard = request.bytes().iter().filter_map(|&byte| decoder.hear(byte, arrival, 9_600)).count();
            assert_eq!(heard == 1, expected, "{window}");
        }
    }

    #[test]
    fn what_was_spaced_and_is_read_late_is_not_spaced_again() {
        let mut decoder = RequestDecoder::new(1.0, false);
        let arrival = Arrival { not_before: 5 * MILLIS, not_after: 25 * MILLIS };
        let request = Request::Status.encode(0);
        let heard = request.bytes().iter().filter_map(|&byte| decoder.hear(byte, arrival, 9_600)).last();
        assert_eq!(heard.map(|heard| heard.at), Some(25 * MILLIS));
    }

    #[test]
    fn the_host_keeps_its_own_time() {
        // Four times as fast: 240 us of machine time are 60 us of the host's.
        let mut decoder = RequestDecoder::new(4.0, true);
        let request = Request::Stop.encode(0);
        let mut heard = None;
        for (i, &byte) in request.bytes().iter().enumerate() {
            let at = 4 * i as Nanos * (line_time(1, 500_000) + 60 * MICROS);
            heard = heard.or(decoder.hear(byte, Arrival::at(at), 500_000));
        }
        assert!(heard.is_some());
    }

    #[test]
    fn noise_before_a_request_is_passed_over() {
        for is_strict in [false, true] {
            let mut decoder = RequestDecoder::new(1.0, is_strict);
            for byte in [0x00, 0xFF, 0x06] {
                assert_eq!(decoder.hear(byte, Arrival::at(0), 9_600), None);
            }
            assert!(heard(&mut decoder, 100 * MILLIS, 100 * MICROS, 0));
            // A length that cannot be is given up at once.
            for (i, byte) in [STX, 0, 0xFF, 0xFF].into_iter().enumerate() {
                assert_eq!(
                    decoder.hear(byte, Arrival::at(200 * MILLIS + i as Nanos * 2 * MILLIS), 9_600),
                    None
                );
            }
            assert!(heard(&mut decoder, 210 * MILLIS, 100 * MICROS, 0));
            assert_eq!(decoder.take_dropped(), None);
        }
    }
}
