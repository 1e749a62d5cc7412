//! Host bytes to requests: `A5 command`, and with the command's top bit a length, so many bytes, and the XOR of all of
//! it. Knows what a request says, not what follows from it.

/// What a host asks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Request {
    Stop,
    Reset,
    Scan,
    /// As [`Request::Scan`], whether the motor turns or not.
    Force,
    /// The number of a mode.
    Express(u8),
    Info,
    Health,
    SampleRate,
    /// What is asked of, and of which mode.
    Configuration {
        key: u32,
        mode: u16,
    },
    /// A value that is to stay in the scanner.
    SetConfiguration(u32),
    /// Duty cycle of the motor, 0 to 1,023.
    Pwm(u16),
    /// Revolutions a minute.
    Rpm(u16),
    /// What the accessory board can do.
    Board,
}

/// Collects one request.
#[derive(Debug, Default)]
pub(crate) struct Decoder {
    bytes: Vec<u8>,
}

impl Decoder {
    /// Takes a byte; returns the request that it completes. What has a wrong sum or another length than its command wants
    /// is dropped, as is a command that no scanner knows.
    pub(crate) fn hear(&mut self, byte: u8) -> Option<Request> {
        if self.bytes.is_empty() && byte != START {
            return None;
        }
        self.bytes.push(byte);
        let (&command, payload) = match &self.bytes[..] {
            [_] => return None,
            [_, command] if command & PAYLOAD == 0 => (command, &[][..]),
            [_, command, len, payload @ ..] if payload.len() == usize::from(*len) + 1 => (command, payload),
            _ => return None,
        };
        let is_right = payload.is_empty() || self.bytes.iter().fold(0, |sum, byte| sum ^ byte) == 0;
        let payload = &payload[..payload.len().saturating_sub(1)];
        let request = if is_right { Request::of(command, payload) } else { None };
        self.bytes.clear();
        request
    }

    /// Forgets what it has heard of a request.
    pub(crate) fn forget(&mut self) {
        self.bytes.clear();
    }
}

impl Request {
    fn of(command: u8, payload: &[u8]) -> Option<Request> {
        let word = |low: u8, high: u8| u16::from_le_bytes([low, high]);
        Some(match (command, payload) {
            (0x25, []) => Request::Stop,
            (0x40, []) => Request::Reset,
            (0x20, []) => Request::Scan,
            (0x21, []) => Request::Force,
            (0x50, []) => Request::Info,
            (0x52, []) => Request::Health,
            (0x59, []) => Request::SampleRate,
            (0x82, [mode, _, _, _, _]) => Request::Express(*mode),
            (0x84, [a, b, c, d, rest @ ..]) => {
                let mode = if let [low, high, ..] = rest { word(*low, *high) } else { 0 };
                Request::Configuration { key: u32::from_le_bytes([*a, *b, *c, *d]), mode }
            }
            (0x85, [a, b, c, d, ..]) => Request::SetConfiguration(u32::from_le_bytes([*a, *b, *c, *d])),
            (0xF0, [low, high]) => Request::Pwm(word(*low, *high)),
            (0xA8, [low, high]) => Request::Rpm(word(*low, *high)),
            (0xFF, [_, _, _, _]) => Request::Board,
            _ => return None,
        })
    }
}

/// How every request begins.
const START: u8 = 0xA5;
/// The bit of a command that has a payload.
const PAYLOAD: u8 = 0x80;

#[cfg(test)]
mod tests {
    use super::*;

    fn heard(bytes: &[u8]) -> Vec<Request> {
        let mut decoder = Decoder::default();
        bytes.iter().filter_map(|&byte| decoder.hear(byte)).collect()
    }

    #[test]
    fn requests_are_heard_among_other_bytes_and_wrong_ones_are_not() {
        assert_eq!(heard(&[0x00, 0x25, 0xA5, 0x25, 0xA5, 0x50, 0x52]), [Request::Stop, Request::Info]);
        let express = [0xA5, 0x82, 0x05, 3, 0, 0, 0, 0, 0xA5 ^ 0x82 ^ 0x05 ^ 3];
        assert_eq!(heard(&express), [Request::Express(3)]);
        for at in 2..express.len() {
            let mut wrong = express;
            wrong[at] ^= 4;
            assert_eq!(heard(&wrong), [], "{at}");
        }
        let name = [0xA5, 0x84, 0x06, 0x7F, 0, 0, 0, 2, 0, 0xA5 ^ 0x84 ^ 0x06 ^ 0x7F ^ 2];
        assert_eq!(heard(&name), [Request::Configuration { key: 0x7F, mode: 2 }]);
        let pwm = [0xA5, 0xF0, 0x02, 0x94, 0x02, 0xC1];
        assert_eq!(heard(&[&pwm[..], &[0xA5, 0x40]].concat()), [Request::Pwm(660), Request::Reset]);
    }
}
