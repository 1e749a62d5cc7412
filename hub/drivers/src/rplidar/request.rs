//! What the session says to a scanner, and the heads of its answers. Source: the maker's description of the protocol. None of
//! the requests that change what a scanner keeps is here, and none can be made outside this file.

use crate::rplidar::packet::Kind;

/// A request as it goes down the line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Request {
    bytes: [u8; Request::LONGEST],
    len: usize,
}

impl Request {
    const LONGEST: usize = 12;

    /// Ends a stream; there is no answer.
    pub(crate) const STOP: Request = Request::plain(0x25);
    /// Boots the scanner.
    pub(crate) const RESET: Request = Request::plain(0x40);
    /// Points one by one.
    pub(crate) const SCAN: Request = Request::plain(0x20);
    /// Model, versions, serial number.
    pub(crate) const INFO: Request = Request::plain(0x50);
    /// Whether it is well.
    pub(crate) const HEALTH: Request = Request::plain(0x52);
    /// How long a point takes, of scanners that do not list their modes.
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

    /// Points in packets, in the mode of this number.
    pub(crate) fn express(mode: u8) -> Request {
        Request::with(0x82, &[mode, 0, 0, 0, 0])
    }

    /// What the scanner says of `key`, of the mode of this number if there is one.
    pub(crate) fn configuration(key: u8, mode: Option<u8>) -> Request {
        let payload = [key, 0, 0, 0, mode.unwrap_or_default(), 0];
        Request::with(0x84, &payload[..if mode.is_some() { 6 } else { 4 }])
    }

    /// Whether there is an accessory board.
    pub(crate) fn board() -> Request {
        Request::with(0xFF, &[0; 4])
    }

    /// The duty cycle of the motor, of 1,023.
    pub(crate) fn duty(duty: u16) -> Request {
        Request::with(0xF0, &duty.to_le_bytes())
    }

    /// The speed of the head in turns per minute.
    pub(crate) fn speed(turns_per_minute: u16) -> Request {
        Request::with(0xA8, &turns_per_minute.to_le_bytes())
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// Keys of [`Request::configuration`].
pub(crate) mod key {
    /// How many modes there are.
    pub(crate) const COUNT: u8 = 0x70;
    /// How long a point takes in a mode, in 1/256 us.
    pub(crate) const SAMPLE_TIME: u8 = 0x71;
    /// What kind of packets a mode has.
    pub(crate) const ANSWER: u8 = 0x75;
    /// The mode that the maker recommends.
    pub(crate) const TYPICAL: u8 = 0x7C;
    /// What a mode is called.
    pub(crate) const NAME: u8 = 0x7F;
}

/// What an answer begins with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Head {
    /// So many bytes follow, once.
    Reply(Answer, usize),
    /// Packets of this kind follow until they are stopped.
    Stream(Kind),
}

/// What a reply answers.
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

impl Head {
    /// Its bytes.
    pub(crate) const LEN: usize = 7;

    /// The head that `bytes` begin with; nothing if they do not, or are too few.
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

    /// Whether a head may begin here, as far as there are bytes.
    pub(crate) fn begins(bytes: &[u8]) -> bool {
        match bytes {
            [] => true,
            [first] => *first == START,
            [first, second, ..] => *first == START && *second == 0x5A,
        }
    }
}

const START: u8 = 0xA5;
/// A name and some.
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
        for (at, wrong) in [(0, 0xA4), (1, 0x5B), (2, 0x13), (5, 0x40), (6, 0x05)] {
            let mut bytes = info;
            bytes[at] = wrong;
            assert_eq!(Head::parse(&bytes), None, "{at}");
        }
        assert_eq!(Head::parse(&info[..6]), None);
    }
}
