//! Requests to a scanner, and the descriptors of its responses, after the manufacturer's description of the protocol. Requests can be
//! made only here. None of them changes a setting that the scanner keeps without power.

use crate::rplidar::packet::Kind;

/// An encoded request.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Request {
    bytes: [u8; Request::LONGEST],
    len: usize,
}

impl Request {
    const LONGEST: usize = 12;

    /// Stops a stream. There is no response.
    pub(crate) const STOP: Request = Request::plain(0x25);
    /// Restarts the scanner.
    pub(crate) const RESET: Request = Request::plain(0x40);
    /// Starts the standard scan: single points.
    pub(crate) const SCAN: Request = Request::plain(0x20);
    /// Requests model, versions and serial number.
    pub(crate) const INFO: Request = Request::plain(0x50);
    /// Requests the health.
    pub(crate) const HEALTH: Request = Request::plain(0x52);
    /// Requests the time per point of a scanner that does not list its modes.
    pub(crate) const SAMPLE_TIMES: Request = Request::plain(0x59);

    const fn plain(command: u8) -> Request {
        let mut bytes = [0; Request::LONGEST];
        (bytes[0], bytes[1]) = (START, command);
        Request { bytes, len: 2 }
    }

    fn with(command: u8, payload: &[u8]) -> Request {
        let mut request = Request::plain(command);
        let end = 3 + payload.len();
        request.bytes[2] = payload.len() as u8;
        request.bytes[3..end].copy_from_slice(payload);
        request.bytes[end] = request.bytes[..end].iter().fold(0, |sum, byte| sum ^ byte);
        request.len = end + 1;
        request
    }

    /// Starts the scan mode with this number, whose packets contain several points.
    pub(crate) fn express(mode: u8) -> Request {
        Request::with(0x82, &[mode, 0, 0, 0, 0])
    }

    /// Requests the value of `key`, of one mode if `mode` is given.
    pub(crate) fn configuration(key: u8, mode: Option<u8>) -> Request {
        let payload = [key, 0, 0, 0, mode.unwrap_or_default(), 0];
        Request::with(0x84, &payload[..if mode.is_some() { 6 } else { 4 }])
    }

    /// Requests whether an accessory board controls the motor.
    pub(crate) fn board() -> Request {
        Request::with(0xFF, &[0; 4])
    }

    /// Sets the duty cycle of the motor, 0 to 1,023.
    pub(crate) fn duty(duty: u16) -> Request {
        Request::with(0xF0, &duty.to_le_bytes())
    }

    /// Sets the speed of the head, in revolutions per minute.
    pub(crate) fn speed(turns_per_minute: u16) -> Request {
        Request::with(0xA8, &turns_per_minute.to_le_bytes())
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// Requests that are sent together.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RequestQueue {
    bytes: [u8; 32],
    len: usize,
}

impl RequestQueue {
    /// Adds `request` after the requests that are queued, as far as there is room.
    pub(crate) fn push(&mut self, request: &Request) {
        for byte in request.bytes() {
            if let Some(place) = self.bytes.get_mut(self.len) {
                *place = *byte;
                self.len += 1;
            }
        }
    }

    /// Returns the bytes to send. A scanner needs no gaps between them.
    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// Keys of [`Request::configuration`].
pub(crate) mod key {
    /// Number of modes.
    pub(crate) const COUNT: u8 = 0x70;
    /// Time per point of a mode, in 1/256 us.
    pub(crate) const SAMPLE_TIME: u8 = 0x71;
    /// Kind of the packets of a mode.
    pub(crate) const ANSWER: u8 = 0x75;
    /// Number of the mode that the manufacturer recommends.
    pub(crate) const TYPICAL: u8 = 0x7C;
    /// Name of a mode.
    pub(crate) const NAME: u8 = 0x7F;
}

/// Descriptor at the beginning of a response.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Head {
    /// One response with this number of bytes follows.
    Reply(Answer, usize),
    /// A stream of these packets follows, until it is stopped.
    Stream(Kind),
}

/// The request that a response belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Answer {
    /// [`Request::INFO`].
    Info,
    /// [`Request::HEALTH`].
    Health,
    /// [`Request::SAMPLE_TIMES`].
    SampleTimes,
    /// [`Request::configuration`].
    Configuration,
    /// [`Request::board`].
    Board,
}

impl Answer {
    /// Returns the type in the descriptor.
    const fn number(self) -> u8 {
        match self {
            Answer::Info => 0x04,
            Answer::Health => 0x06,
            Answer::SampleTimes => 0x15,
            Answer::Configuration => 0x20,
            Answer::Board => 0xFF,
        }
    }
}

impl Head {
    /// Length of a descriptor, in bytes.
    pub(crate) const LEN: usize = 7;

    /// Decodes the descriptor that `bytes` begin with. Returns `None` if they begin with something else, or are too few.
    pub(crate) fn parse(bytes: &[u8]) -> Option<Head> {
        let &[START, 0x5A, a, b, c, d, answer] = bytes.first_chunk()? else { return None };
        let word = u32::from_le_bytes([a, b, c, d]);
        let (len, times) = ((word & 0x3FFF_FFFF) as usize, word >> 30);
        match (times, answer, len) {
            (0, 0x04, 20) => Some(Head::Reply(Answer::Info, len)),
            (0, 0x06, 3) => Some(Head::Reply(Answer::Health, len)),
            (0, 0x15, 4) => Some(Head::Reply(Answer::SampleTimes, len)),
            (0, 0x20, 4..=LONGEST_REPLY) => Some(Head::Reply(Answer::Configuration, len)),
            (0, 0xFF, 4) => Some(Head::Reply(Answer::Board, len)),
            (1, answer, len) => Kind::of(answer).filter(|kind| kind.bytes() == len).map(Head::Stream),
            _ => None,
        }
    }

    /// Encodes the descriptor, in the form in which a scanner sends it.
    pub(crate) fn encode(self) -> [u8; Head::LEN] {
        let (len, times, kind) = match self {
            Head::Reply(answer, len) => (len, 0, answer.number()),
            Head::Stream(kind) => (kind.bytes(), 1, kind.answer()),
        };
        let [a, b, c, d] = (len as u32 | times << 30).to_le_bytes();
        [START, 0x5A, a, b, c, d, kind]
    }

    /// Returns whether `bytes` may be the beginning of a descriptor.
    pub(crate) fn begins(bytes: &[u8]) -> bool {
        match bytes {
            [] => true,
            [first] => *first == START,
            [first, second, ..] => *first == START && *second == 0x5A,
        }
    }
}

const START: u8 = 0xA5;
/// Maximum length of a response: more than the longest name of a mode needs.
const LONGEST_REPLY: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_as_the_maker_writes_them() {
        assert_eq!(Request::STOP.bytes(), [0xA5, 0x25]);
        assert_eq!(Request::express(0).bytes(), [0xA5, 0x82, 5, 0, 0, 0, 0, 0, 0x22]);
        assert_eq!(Request::duty(660).bytes(), [0xA5, 0xF0, 2, 0x94, 0x02, 0xC1]);
        let asked = Request::configuration(key::NAME, Some(3));
        assert_eq!(asked.bytes(), [0xA5, 0x84, 6, 0x7F, 0, 0, 0, 3, 0, 0xA5 ^ 0x84 ^ 6 ^ 0x7F ^ 3]);
        assert_eq!(Request::configuration(key::COUNT, None).bytes(), [0xA5, 0x84, 4, 0x70, 0, 0, 0, 0x55]);
    }

    #[test]
    fn heads_of_answers() {
        let info = [0xA5, 0x5A, 0x14, 0, 0, 0, 0x04];
        assert_eq!(Head::parse(&info), Some(Head::Reply(Answer::Info, 20)));
        let express = [0xA5, 0x5A, 0x54, 0, 0, 0x40, 0x82];
        assert_eq!(Head::parse(&express), Some(Head::Stream(Kind::Express)));
        for bytes in [info, express] {
            assert_eq!(Head::parse(&bytes).map(Head::encode), Some(bytes));
        }
        for (at, wrong) in [(0, 0xA4), (1, 0x5B), (2, 0x13), (5, 0x40), (6, 0x05)] {
            let mut bytes = info;
            bytes[at] = wrong;
            assert_eq!(Head::parse(&bytes), None, "{at}");
        }
        assert_eq!(Head::parse(&info[..6]), None);
    }
}
