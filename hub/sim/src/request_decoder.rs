//! Decoder of the requests of a host to an LMS. If a host writes several bytes at once, a real UART sends them one
//! after the other, but a pty delivers them at once. The decoder therefore handles each byte at the time at which a
//! real line would have carried the byte. The decoder drops a request if a gap between two bytes is too long. For a
//! strict scanner, it also drops a request if a gap is too short.

use std::fmt;

use scanhub_drivers::lms::telegram::{FRAME_LEN, MAX_LENGTH, STX};
use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};

/// Time at which the host wrote a byte. It is a range, because the simulator reads the byte later.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// Earliest possible time.
    pub not_before: Nanos,
    /// Latest possible time.
    pub not_after: Nanos,
}

impl Arrival {
    /// Returns an exact time.
    pub fn at(time: Nanos) -> Self {
        Arrival { not_before: time, not_after: time }
    }
}

/// Reason for which a request was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DroppedRequest {
    /// A gap of more than 6 ms inside the request.
    LongGap {
        /// Number of bytes before the gap.
        after: usize,
    },
    /// A gap of less than 55 us, which a strict scanner does not accept.
    ShortGap,
}

impl fmt::Display for DroppedRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            DroppedRequest::LongGap { after } => {
                write!(f, "a request was dropped: more than 6 ms of silence after {after} of its bytes")
            }
            DroppedRequest::ShortGap => f.write_str(
                "a request was dropped: less than 55 us between its bytes, which strict_gap=1 does not allow",
            ),
        }
    }
}

/// A request that was received.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct DecodedRequest {
    /// The whole request. Its checksum was not checked.
    pub(crate) bytes: Vec<u8>,
    /// Time at which the line has carried the last byte of the request.
    pub(crate) at: Nanos,
}

/// Decoder of requests. It collects the bytes of one request.
#[derive(Debug)]
pub(crate) struct RequestDecoder {
    bytes: Vec<u8>,
    /// Time at which the line carried the last byte, assuming that every gap before it was valid; `None` before the
    /// first byte.
    last: Option<Arrival>,
    /// Whether a gap in the current request was too short.
    is_broken: bool,
    /// Whether the scanner is strict, so that the host must leave the minimum gap between two bytes.
    pub(crate) is_strict: bool,
    /// Speed of the simulation's time relative to the host's time. The host measures the gaps by its own clock.
    speed: f64,
    dropped: Option<DroppedRequest>,
}

impl RequestDecoder {
    pub(crate) fn new(speed: f64, is_strict: bool) -> Self {
        RequestDecoder { bytes: Vec::new(), last: None, is_broken: false, is_strict, speed, dropped: None }
    }

    /// Returns the last request that was dropped. Each dropped request is returned at most once.
    pub(crate) fn take_dropped(&mut self) -> Option<DroppedRequest> {
        self.dropped.take()
    }

    /// Adds a byte on a line at `baud` bits per second. Returns the request that the byte completes. Drops the request
    /// only if a gap was wrong for all possible times of the bytes.
    pub(crate) fn receive(&mut self, byte: u8, arrival: Arrival, baud: u32) -> Option<DecodedRequest> {
        let possible = self.narrow_arrival(arrival, baud);
        self.last = Some(possible);
        if self.bytes.is_empty() && byte != STX {
            return None;
        }
        self.bytes.push(byte);
        let [_, _, low, high, ..] = self.bytes[..] else { return None };
        let length = usize::from(u16::from_le_bytes([low, high]));
        if !(1..=MAX_LENGTH).contains(&length) {
            self.take_bytes();
            return None;
        }
        if self.bytes.len() < length + FRAME_LEN {
            return None;
        }
        let is_broken = self.is_broken;
        let bytes = self.take_bytes();
        if is_broken {
            self.dropped = Some(DroppedRequest::ShortGap);
            return None;
        }
        Some(DecodedRequest { bytes, at: possible.not_before.max(arrival.not_after) })
    }

    /// Returns the range of times at which the line can have carried a byte that the host wrote at `arrival`. Drops the
    /// incomplete request if the byte is too late for it.
    fn narrow_arrival(&mut self, arrival: Arrival, baud: u32) -> Arrival {
        let Some(last) = self.last else { return arrival };
        let scaled = |span: Nanos| (span as f64 * self.speed) as Nanos;
        let byte_ns = scaled(line_time(1, baud));
        // Even if the simulator read several bytes at once, the line carried them one after the other. The earliest
        // time of a byte is therefore after the earliest time of the byte before.
        let min_gap = if self.is_strict { scaled(MIN_GAP) } else { 0 };
        let earliest = last.not_before + byte_ns + min_gap;
        let latest = last.not_after + byte_ns + scaled(MAX_GAP);
        if arrival.not_before > latest {
            if !self.bytes.is_empty() {
                self.dropped = Some(DroppedRequest::LongGap { after: self.bytes.len() });
            }
            self.take_bytes();
            return arrival;
        }
        let is_host_s = self.is_strict && !self.bytes.is_empty();
        if is_host_s && earliest > arrival.not_after {
            self.is_broken = true;
            return arrival;
        }
        // In a request to a strict scanner, the host times every byte itself. Otherwise the host's UART sends the byte
        // when it has sent the byte before.
        let uart_time = if is_host_s { 0 } else { last.not_after + byte_ns };
        Arrival {
            not_before: arrival.not_before.max(earliest),
            not_after: arrival.not_after.max(uart_time).min(latest),
        }
    }

    fn take_bytes(&mut self) -> Vec<u8> {
        self.is_broken = false;
        std::mem::take(&mut self.bytes)
    }
}

/// Minimum idle time between two bytes to the scanner (Telegram listing 4.3).
const MIN_GAP: Nanos = 55 * MICROS;
/// Maximum idle time between two bytes to the scanner (Telegram listing 4.3).
const MAX_GAP: Nanos = 6 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_drivers::lms::command::Request;

    /// Sends a status request with the idle time `gap` between its bytes. The time of each byte is known to `width`.
    /// Returns the time at which the decoder receives the request.
    fn accepted_at(decoder: &mut RequestDecoder, start: Nanos, gap: Nanos, width: Nanos) -> Option<Nanos> {
        let request = Request::Status.encode(0);
        let step = line_time(1, 9_600) + gap;
        let mut decoded = None;
        for (i, &byte) in request.bytes().iter().enumerate() {
            let at = start + i as Nanos * step;
            let arrival = Arrival { not_before: at.saturating_sub(width), not_after: at + width };
            decoded = decoded.or(decoder.receive(byte, arrival, 9_600));
        }
        decoded.filter(|decoded| decoded.bytes == request.bytes()).map(|decoded| decoded.at)
    }

    fn is_accepted(decoder: &mut RequestDecoder, start: Nanos, gap: Nanos, width: Nanos) -> bool {
        accepted_at(decoder, start, gap, width).is_some()
    }

    /// Writes all bytes of a status request at `start`. Returns the time at which the decoder receives the request.
    fn written_at_once(decoder: &mut RequestDecoder, start: Nanos, baud: u32) -> Option<Nanos> {
        let request = Request::Status.encode(0);
        let decoded =
            request.bytes().iter().filter_map(|&byte| decoder.receive(byte, Arrival::at(start), baud)).last();
        decoded.filter(|decoded| decoded.bytes == request.bytes()).map(|decoded| decoded.at)
    }

    #[test]
    fn receives_request_after_its_time_on_the_line() {
        let mut decoder = RequestDecoder::new(1.0, false);
        for (round, baud) in [9_600, 19_200, 38_400, 500_000].repeat(25).into_iter().enumerate() {
            let start = (round as Nanos + 1) * 1_000 * MILLIS;
            assert_eq!(written_at_once(&mut decoder, start, baud), Some(start + 6 * line_time(1, baud)));
            // Some hosts write one byte every 55 us at any rate, although the line needs more time for a byte.
            let request = Request::Stop.encode(0);
            let bytes = request.bytes().iter().enumerate();
            let at = |i: usize| Arrival::at(start + 500 * MILLIS + i as Nanos * 55 * MICROS);
            assert!(bytes.filter_map(|(i, &byte)| decoder.receive(byte, at(i), baud)).count() == 1);
        }
        assert_eq!(decoder.take_dropped(), None);
    }

    #[test]
    fn second_request_waits_for_first() {
        let mut decoder = RequestDecoder::new(1.0, false);
        let byte_ns = line_time(1, 9_600);
        assert_eq!(written_at_once(&mut decoder, 0, 9_600), Some(6 * byte_ns));
        assert_eq!(written_at_once(&mut decoder, 0, 9_600), Some(13 * byte_ns));
        // Noise needs time on the line, too.
        decoder.receive(0xFF, Arrival::at(0), 9_600);
        assert_eq!(written_at_once(&mut decoder, 0, 9_600), Some(21 * byte_ns));
    }

    #[test]
    fn drops_request_with_long_gap() {
        for (gap, width, expected) in [
            (0, 0, true),
            (54 * MICROS, 0, true),
            (6 * MILLIS, 0, true),
            (6 * MILLIS + MICROS, 0, false),
            // If the times of the bytes are uncertain, the gap may have been valid.
            (6_100 * MICROS, MILLIS, true),
        ] {
            let mut decoder = RequestDecoder::new(1.0, false);
            assert_eq!(is_accepted(&mut decoder, 1_000 * MILLIS, gap, width), expected, "{gap} {width}");
            assert_eq!(
                decoder.take_dropped(),
                (!expected).then_some(DroppedRequest::LongGap { after: 1 }),
                "{gap}"
            );
            assert!(
                is_accepted(&mut decoder, 2_000 * MILLIS, 100 * MICROS, 0),
                "not accepted again after {gap}"
            );
            assert_eq!(decoder.take_dropped(), None);
        }
        // The line needs time to carry bytes that were written at once. The gap begins when it has carried them.
        let request = Request::Status.encode(0);
        let (head, tail) = request.bytes().split_at(4);
        let byte_ns = line_time(1, 9_600);
        for (pause, expected) in [(4 * byte_ns + 6 * MILLIS, true), (4 * byte_ns + 6 * MILLIS + 1, false)] {
            let mut decoder = RequestDecoder::new(1.0, false);
            assert!(head.iter().all(|&byte| decoder.receive(byte, Arrival::at(0), 9_600).is_none()));
            let decoded =
                tail.iter().filter_map(|&byte| decoder.receive(byte, Arrival::at(pause), 9_600)).count();
            assert_eq!(decoded == 1, expected, "{pause}");
            assert_eq!(decoder.take_dropped(), (!expected).then_some(DroppedRequest::LongGap { after: 4 }));
        }
    }

    #[test]
    fn strict_scanner_drops_request_with_short_gaps() {
        for (gap, width, expected) in [
            (55 * MICROS, 0, true),
            (54 * MICROS, 0, false),
            (0, 0, false),
            (6 * MILLIS, 0, true),
            (6 * MILLIS + MICROS, 0, false),
            // If the times of the bytes are uncertain, the gaps may have been valid. But seven bytes within 2 ms were
            // too fast for 9600 in any case.
            (40 * MICROS, 50 * MICROS, true),
            (0, 100 * MICROS, false),
            (6_100 * MICROS, MILLIS, true),
        ] {
            let mut decoder = RequestDecoder::new(1.0, true);
            assert_eq!(is_accepted(&mut decoder, 1_000 * MILLIS, gap, width), expected, "{gap} {width}");
            let dropped =
                if gap < MIN_GAP { DroppedRequest::ShortGap } else { DroppedRequest::LongGap { after: 1 } };
            assert_eq!(decoder.take_dropped(), (!expected).then_some(dropped), "{gap} {width}");
            assert!(
                is_accepted(&mut decoder, 2_000 * MILLIS, 100 * MICROS, 0),
                "not accepted again after {gap}"
            );
        }
    }

    #[test]
    fn request_read_at_once_needs_enough_time() {
        let request = Request::Status.encode(0);
        let least = 6 * (line_time(1, 9_600) + MIN_GAP);
        for (window, expected) in [(least, true), (least - 1, false)] {
            let mut decoder = RequestDecoder::new(1.0, true);
            let arrival = Arrival { not_before: 5 * MILLIS, not_after: 5 * MILLIS + window };
            let decoded =
                request.bytes().iter().filter_map(|&byte| decoder.receive(byte, arrival, 9_600)).count();
            assert_eq!(decoded == 1, expected, "{window}");
        }
    }

    #[test]
    fn does_not_space_late_bytes_again() {
        let mut decoder = RequestDecoder::new(1.0, false);
        let arrival = Arrival { not_before: 5 * MILLIS, not_after: 25 * MILLIS };
        let request = Request::Status.encode(0);
        let decoded = request.bytes().iter().filter_map(|&byte| decoder.receive(byte, arrival, 9_600)).last();
        assert_eq!(decoded.map(|decoded| decoded.at), Some(25 * MILLIS));
    }

    #[test]
    fn host_measures_gaps_by_its_own_clock() {
        // At four times the speed, 240 us of the scanner are 60 us of the host.
        let mut decoder = RequestDecoder::new(4.0, true);
        let request = Request::Stop.encode(0);
        let mut decoded = None;
        for (i, &byte) in request.bytes().iter().enumerate() {
            let at = 4 * i as Nanos * (line_time(1, 500_000) + 60 * MICROS);
            decoded = decoded.or(decoder.receive(byte, Arrival::at(at), 500_000));
        }
        assert!(decoded.is_some());
    }

    #[test]
    fn skips_noise_before_request() {
        for is_strict in [false, true] {
            let mut decoder = RequestDecoder::new(1.0, is_strict);
            for byte in [0x00, 0xFF, 0x06] {
                assert_eq!(decoder.receive(byte, Arrival::at(0), 9_600), None);
            }
            assert!(is_accepted(&mut decoder, 100 * MILLIS, 100 * MICROS, 0));
            // The decoder drops a request with an impossible length at once.
            for (i, byte) in [STX, 0, 0xFF, 0xFF].into_iter().enumerate() {
                assert_eq!(
                    decoder.receive(byte, Arrival::at(200 * MILLIS + i as Nanos * 2 * MILLIS), 9_600),
                    None
                );
            }
            assert!(is_accepted(&mut decoder, 210 * MILLIS, 100 * MICROS, 0));
            assert_eq!(decoder.take_dropped(), None);
        }
    }
}
