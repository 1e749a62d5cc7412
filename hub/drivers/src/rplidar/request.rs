//! Requests to a scanner, the descriptors of its responses, and the identity and health that it reports, according to
//! the manufacturer's protocol description. Only this module can create requests. None of the requests changes a
//! setting that the scanner keeps without power.

use core::fmt;

use crate::rplidar::packet::PacketFormat;
use crate::rplidar::{Mode, Model, Motor};

/// Encoded request.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Request {
    bytes: [u8; Request::MAX_LEN],
    len: usize,
}

impl Request {
    const MAX_LEN: usize = 12;

    /// Stops a stream. The scanner sends no response.
    pub(crate) const STOP: Request = Request::without_payload(0x25);
    /// Restarts the scanner.
    pub(crate) const RESET: Request = Request::without_payload(0x40);
    /// Starts the standard scan, whose packets contain one point each.
    pub(crate) const SCAN: Request = Request::without_payload(0x20);
    /// Requests the model, the versions and the serial number.
    pub(crate) const INFO: Request = Request::without_payload(0x50);
    /// Requests the health.
    pub(crate) const HEALTH: Request = Request::without_payload(0x52);
    /// Requests the times per point of a scanner that does not list its modes.
    pub(crate) const SAMPLE_TIMES: Request = Request::without_payload(0x59);

    const fn without_payload(command: u8) -> Request {
        let mut bytes = [0; Request::MAX_LEN];
        (bytes[0], bytes[1]) = (START_BYTE, command);
        Request { bytes, len: 2 }
    }

    fn with_payload(command: u8, payload: &[u8]) -> Request {
        let mut request = Request::without_payload(command);
        let end = 3 + payload.len();
        request.bytes[2] = payload.len() as u8;
        request.bytes[3..end].copy_from_slice(payload);
        request.bytes[end] = request.bytes[..end].iter().fold(0, |sum, byte| sum ^ byte);
        request.len = end + 1;
        request
    }

    /// Returns the request that starts the scan mode with this number, whose packets contain several points.
    pub(crate) fn express(mode: u8) -> Request {
        Request::with_payload(0x82, &[mode, 0, 0, 0, 0])
    }

    /// Returns the request for the value of `key`. If `mode` is given, requests the value for this mode.
    pub(crate) fn configuration(key: u8, mode: Option<u8>) -> Request {
        let payload = [key, 0, 0, 0, mode.unwrap_or_default(), 0];
        Request::with_payload(0x84, &payload[..if mode.is_some() { 6 } else { 4 }])
    }

    /// Returns the request for the information whether an accessory board controls the motor.
    pub(crate) fn accessory_board() -> Request {
        Request::with_payload(0xFF, &[0; 4])
    }

    /// Returns the request that sets the duty cycle of the motor, from 0 to 1,023.
    pub(crate) fn set_motor_pwm(duty: u16) -> Request {
        Request::with_payload(0xF0, &duty.to_le_bytes())
    }

    /// Returns the request that sets the speed of the head, in revolutions per minute.
    pub(crate) fn set_motor_speed(revolutions_per_minute: u16) -> Request {
        Request::with_payload(0xA8, &revolutions_per_minute.to_le_bytes())
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// Requests that are sent in one write.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RequestQueue {
    bytes: [u8; 32],
    len: usize,
}

impl RequestQueue {
    /// Adds `request` after the queued requests. Drops bytes for which no room is left.
    pub(crate) fn push(&mut self, request: &Request) {
        for byte in request.bytes() {
            if let Some(slot) = self.bytes.get_mut(self.len) {
                *slot = *byte;
                self.len += 1;
            }
        }
    }

    /// Returns the bytes to send. The scanner does not require gaps between these bytes.
    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// Keys for [`Request::configuration`].
pub(crate) mod key {
    /// Number of modes.
    pub(crate) const COUNT: u8 = 0x70;
    /// Time per point of a mode, in units of 1/256 us.
    pub(crate) const SAMPLE_TIME: u8 = 0x71;
    /// Packet format of a mode.
    pub(crate) const RESPONSE_TYPE: u8 = 0x75;
    /// Number of the mode that the manufacturer recommends.
    pub(crate) const TYPICAL: u8 = 0x7C;
    /// Name of a mode.
    pub(crate) const NAME: u8 = 0x7F;
}

/// Descriptor at the start of a response.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ResponseDescriptor {
    /// A single response of this type follows. The response has this number of bytes.
    Reply(ResponseType, usize),
    /// A stream of packets of this format follows, until the stop request.
    Stream(PacketFormat),
}

/// Type of a response, by the request to which it responds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ResponseType {
    /// Response to [`Request::INFO`].
    Info,
    /// Response to [`Request::HEALTH`].
    Health,
    /// Response to [`Request::SAMPLE_TIMES`].
    SampleTimes,
    /// Response to [`Request::configuration`].
    Configuration,
    /// Response to [`Request::accessory_board`].
    Board,
}

impl ResponseType {
    /// Returns the value of the type in a descriptor.
    const fn number(self) -> u8 {
        match self {
            ResponseType::Info => 0x04,
            ResponseType::Health => 0x06,
            ResponseType::SampleTimes => 0x15,
            ResponseType::Configuration => 0x20,
            ResponseType::Board => 0xFF,
        }
    }
}

impl ResponseDescriptor {
    /// Length of a descriptor, in bytes.
    pub(crate) const LEN: usize = 7;

    /// Decodes the descriptor at the start of `bytes`. Returns `None` if there is no descriptor, or if the descriptor
    /// is incomplete.
    pub(crate) fn parse(bytes: &[u8]) -> Option<ResponseDescriptor> {
        let &[START_BYTE, 0x5A, a, b, c, d, response] = bytes.first_chunk()? else { return None };
        let word = u32::from_le_bytes([a, b, c, d]);
        let (len, times) = ((word & 0x3FFF_FFFF) as usize, word >> 30);
        match (times, response, len) {
            (0, 0x04, 20) => Some(ResponseDescriptor::Reply(ResponseType::Info, len)),
            (0, 0x06, 3) => Some(ResponseDescriptor::Reply(ResponseType::Health, len)),
            (0, 0x15, 4) => Some(ResponseDescriptor::Reply(ResponseType::SampleTimes, len)),
            (0, 0x20, 4..=MAX_RESPONSE_LEN) => {
                Some(ResponseDescriptor::Reply(ResponseType::Configuration, len))
            }
            (0, 0xFF, 4) => Some(ResponseDescriptor::Reply(ResponseType::Board, len)),
            (1, answer, len) => {
                PacketFormat::of(answer).filter(|kind| kind.byte_len() == len).map(ResponseDescriptor::Stream)
            }
            _ => None,
        }
    }

    /// Encodes the descriptor as a scanner sends it.
    pub(crate) fn encode(self) -> [u8; ResponseDescriptor::LEN] {
        let (len, times, kind) = match self {
            ResponseDescriptor::Reply(answer, len) => (len, 0, answer.number()),
            ResponseDescriptor::Stream(kind) => (kind.byte_len(), 1, kind.response_type()),
        };
        let [a, b, c, d] = (len as u32 | times << 30).to_le_bytes();
        [START_BYTE, 0x5A, a, b, c, d, kind]
    }

    /// Returns whether `bytes` may be the start of a descriptor.
    pub(crate) fn begins(bytes: &[u8]) -> bool {
        match bytes {
            [] => true,
            [first] => *first == START_BYTE,
            [first, second, ..] => *first == START_BYTE && *second == 0x5A,
        }
    }
}

const START_BYTE: u8 = 0xA5;
/// Maximum length of a response, in bytes. The longest name of a mode fits into a response of this length.
const MAX_RESPONSE_LEN: usize = 64;

/// Identity of a scanner, from its reply to `A5 50`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Info {
    /// Number of the model. The upper four bits are the series.
    pub id: u8,
    /// Major and minor version of the firmware.
    pub firmware: (u8, u8),
    /// Revision of the hardware.
    pub hardware: u8,
    /// Serial number.
    pub serial: [u8; 16],
}

impl Info {
    /// Length of the reply, in bytes.
    pub(crate) const LEN: usize = 20;

    /// Decodes a reply. Returns `None` if `reply` is too short.
    pub(crate) fn parse(reply: &[u8]) -> Option<Info> {
        let &[id, minor, major, hardware, ref serial @ ..] = reply.first_chunk::<{ Info::LEN }>()?;
        Some(Info { id, firmware: (major, minor), hardware, serial: *serial })
    }

    /// Returns the identity of a scanner from a status whose type is `text`, such as `S2 denseboost 1.02`. A status
    /// contains neither the hardware revision nor the serial number, so these values are 0 in the result. Returns
    /// `None` if neither `model` nor `text` gives the number of the model.
    pub(crate) fn of_status(model: Option<Model>, text: &str) -> Option<Info> {
        let words: Vec<&str> = text.split_whitespace().collect();
        let number = |word: &&str| u8::from_str_radix(word.strip_prefix("0x")?, 16).ok();
        let version = |word: &&str| {
            let (major, minor) = word.split_once('.')?;
            major.parse().ok().zip(minor.parse().ok())
        };
        let id = model.map(Model::id).or_else(|| words.first().and_then(number))?;
        let firmware = words.last().and_then(version).unwrap_or_default();
        Some(Info { id, firmware, hardware: 0, serial: [0; 16] })
    }

    /// Encodes the reply.
    pub(crate) fn encode(&self) -> [u8; Info::LEN] {
        let mut reply = [0; Info::LEN];
        let (major, minor) = self.firmware;
        reply[..4].copy_from_slice(&[self.id, minor, major, self.hardware]);
        reply[4..].copy_from_slice(&self.serial);
        reply
    }

    /// Returns the model, if scanhub supports it.
    pub fn model(&self) -> Option<Model> {
        Model::of_id(self.id)
    }

    /// Returns the control of the motor.
    pub(crate) fn motor(&self) -> Motor {
        match self.id >> 4 {
            0 | 1 => Motor::Dtr,
            2..=5 => Motor::Board,
            _ => Motor::Speed,
        }
    }
}

/// Health of a scanner, from its reply to `A5 52`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Health {
    /// The scanner works.
    Good,
    /// The scanner measures, but may fail soon. Contains its error code.
    Warning(u16),
    /// The scanner has failed and does not measure. Contains its error code.
    Error(u16),
}

impl Health {
    /// Decodes a reply. Returns `None` if `reply` is too short.
    pub(crate) fn parse(reply: &[u8]) -> Option<Health> {
        let &[status, low, high] = reply.first_chunk()?;
        let code = u16::from_le_bytes([low, high]);
        Some(match status {
            0 => Health::Good,
            1 => Health::Warning(code),
            _ => Health::Error(code),
        })
    }
}

impl fmt::Display for Health {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Health::Good => f.write_str("good"),
            Health::Warning(code) => write!(f, "warning, code {code:04X}h: it measures, but may fail soon"),
            Health::Error(code) => {
                write!(
                    f,
                    "error, code {code:04X}h: it has stopped measuring to protect itself; is its head blocked?"
                )
            }
        }
    }
}

/// Contents of the responses at the start of a stream, for a stream file that lacks these responses.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StreamHead {
    /// Identity of the scanner, if it is known.
    pub(crate) info: Option<Info>,
    /// Scan mode of the stream, if scanhub supports it.
    pub(crate) mode: Option<Mode>,
    /// Time per point in microseconds, if it is known.
    pub(crate) sample_us: Option<f64>,
    /// Format of the packets.
    pub(crate) kind: PacketFormat,
}

impl StreamHead {
    /// Encodes the responses: the identity, a list of modes that contains only the mode of the stream, and the
    /// descriptor of the stream.
    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        if let Some(info) = &self.info {
            push_response(&mut bytes, ResponseType::Info, &info.encode());
        }
        let mut value = |key: u8, value: &[u8]| {
            push_response(&mut bytes, ResponseType::Configuration, &[&[key, 0, 0, 0], value].concat());
        };
        value(key::COUNT, &[1, 0]);
        if let Some(us) = self.sample_us {
            value(key::SAMPLE_TIME, &((us * 256.0).round() as u32).to_le_bytes());
        }
        value(key::RESPONSE_TYPE, &[self.kind.response_type()]);
        if let Some(mode) = self.mode {
            value(key::NAME, &[mode.name().as_bytes(), &[0]].concat());
        }
        bytes.extend(ResponseDescriptor::Stream(self.kind).encode());
        bytes
    }
}

fn push_response(bytes: &mut Vec<u8>, response: ResponseType, data: &[u8]) {
    bytes.extend(ResponseDescriptor::Reply(response, data.len()).encode());
    bytes.extend(data);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_match_the_manufacturers_examples() {
        assert_eq!(Request::STOP.bytes(), [0xA5, 0x25]);
        assert_eq!(Request::express(0).bytes(), [0xA5, 0x82, 5, 0, 0, 0, 0, 0, 0x22]);
        assert_eq!(Request::set_motor_pwm(660).bytes(), [0xA5, 0xF0, 2, 0x94, 0x02, 0xC1]);
        let asked = Request::configuration(key::NAME, Some(3));
        assert_eq!(asked.bytes(), [0xA5, 0x84, 6, 0x7F, 0, 0, 0, 3, 0, 0xA5 ^ 0x84 ^ 6 ^ 0x7F ^ 3]);
        assert_eq!(Request::configuration(key::COUNT, None).bytes(), [0xA5, 0x84, 4, 0x70, 0, 0, 0, 0x55]);
    }

    #[test]
    fn parses_and_encodes_response_descriptors() {
        let info = [0xA5, 0x5A, 0x14, 0, 0, 0, 0x04];
        assert_eq!(ResponseDescriptor::parse(&info), Some(ResponseDescriptor::Reply(ResponseType::Info, 20)));
        let express = [0xA5, 0x5A, 0x54, 0, 0, 0x40, 0x82];
        assert_eq!(
            ResponseDescriptor::parse(&express),
            Some(ResponseDescriptor::Stream(PacketFormat::Express))
        );
        for bytes in [info, express] {
            assert_eq!(ResponseDescriptor::parse(&bytes).map(ResponseDescriptor::encode), Some(bytes));
        }
        for (at, wrong) in [(0, 0xA4), (1, 0x5B), (2, 0x13), (5, 0x40), (6, 0x05)] {
            let mut bytes = info;
            bytes[at] = wrong;
            assert_eq!(ResponseDescriptor::parse(&bytes), None, "{at}");
        }
        assert_eq!(ResponseDescriptor::parse(&info[..6]), None);
    }

    #[test]
    fn identity_is_restored_from_a_status() {
        let info = Info::of_status(Some(Model::S2), "S2 denseboost 1.02").unwrap();
        assert_eq!((info.id, info.firmware), (0x71, (1, 2)));
        assert_eq!(Info::parse(&info.encode()), Some(info));
        let unknown = Info::of_status(None, "0x95 standard 1.30").unwrap();
        assert_eq!((unknown.id, unknown.firmware), (0x95, (1, 30)));
        assert_eq!(Info::of_status(Some(Model::A1), "").map(|info| info.firmware), Some((0, 0)));
        assert_eq!(Info::of_status(None, "A7 standard"), None);
    }
}
