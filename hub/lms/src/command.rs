//! Requests: what a host says to a sensor. Encoded by the session, decoded by the simulator.

use crate::telegram::{Encoded, Telegram, Writer};
use crate::variant::{Baud, Variant};

/// A request of the path from power-on to a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// 31h: status of the sensor; the reply is [`crate::reply::Reply::Status`].
    Status,
    /// 3Ah: type and firmware.
    Type,
    /// 74h: first part of the configuration, with unit and measuring mode.
    Configuration,
    /// 3Bh: switch angle and resolution; forgotten at power-off.
    Variant(Variant),
    /// 20h 24h: send all values of every scan from now on.
    Stream,
    /// 20h 25h: values on request only; so this is the stop command.
    Stop,
    /// 20h 40h, 41h, 42h, 48h: change the rate of the line; acknowledged at the old one, forgotten at power-off.
    Baud(Baud),
}

impl Request {
    /// The telegram that says it to the sensor at `address` (0 is every sensor).
    pub fn encode(self, address: u8) -> Encoded {
        match self {
            Request::Variant(variant) => Writer::new(address, self.command())
                .word(variant.angle_deg)
                .word(variant.resolution_cdeg)
                .finish(),
            Request::Stream => Writer::new(address, self.command()).byte(STREAM).finish(),
            Request::Stop => Writer::new(address, self.command()).byte(ON_REQUEST).finish(),
            Request::Baud(baud) => Writer::new(address, self.command()).byte(baud_mode(baud)).finish(),
            Request::Status | Request::Type | Request::Configuration => {
                Writer::new(address, self.command()).finish()
            }
        }
    }

    /// The request that `telegram` says; `None` if it is another one, a reply, or its data are not as they should be.
    pub fn decode(telegram: Telegram<'_>) -> Option<Request> {
        if telegram.is_reply() {
            return None;
        }
        match (telegram.command(), telegram.data()) {
            (STATUS, []) => Some(Request::Status),
            (TYPE, []) => Some(Request::Type),
            (CONFIGURATION, []) => Some(Request::Configuration),
            (VARIANT, &[a, b, c, d]) => {
                Variant::new(u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d])).map(Request::Variant)
            }
            (MODE, &[STREAM]) => Some(Request::Stream),
            (MODE, &[ON_REQUEST]) => Some(Request::Stop),
            (MODE, &[mode]) => Baud::ALL.into_iter().find(|&b| baud_mode(b) == mode).map(Request::Baud),
            _ => None,
        }
    }

    /// The command byte.
    pub fn command(self) -> u8 {
        match self {
            Request::Status => STATUS,
            Request::Type => TYPE,
            Request::Configuration => CONFIGURATION,
            Request::Variant(_) => VARIANT,
            Request::Stream | Request::Stop | Request::Baud(_) => MODE,
        }
    }
}

fn baud_mode(baud: Baud) -> u8 {
    match baud {
        Baud::B38400 => 0x40,
        Baud::B19200 => 0x41,
        Baud::B9600 => 0x42,
        Baud::B500000 => 0x48,
    }
}

/// Command: change the operating mode.
pub const MODE: u8 = 0x20;
/// Command: status.
pub const STATUS: u8 = 0x31;
/// Command: type.
pub const TYPE: u8 = 0x3A;
/// Command: switch the variant.
pub const VARIANT: u8 = 0x3B;
/// Command: read the configuration.
pub const CONFIGURATION: u8 = 0x74;
/// Operating mode: all values, continuously.
const STREAM: u8 = 0x24;
/// Operating mode: values on request.
const ON_REQUEST: u8 = 0x25;

/// Commands that write the sensor's EEPROM: fields, password, permanent rate, configuration parts 1 and 2
/// (Telegram listing 7-1: those that need the installation mode). Nothing in this crate encodes one.
pub const EEPROM_WRITES: [u8; 6] = [0x40, 0x42, 0x46, 0x66, 0x77, 0x7C];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn printed_requests_both_ways() {
        let vectors: [(Request, &[u8]); 12] = [
            (Request::Status, &[0x02, 0, 1, 0, 0x31, 0x15, 0x12]),
            (Request::Type, &[0x02, 0, 1, 0, 0x3A, 0x1E, 0x12]),
            (Request::Configuration, &[0x02, 0, 1, 0, 0x74, 0x50, 0x12]),
            (Request::Stream, &[0x02, 0, 2, 0, 0x20, 0x24, 0x34, 0x08]),
            (Request::Stop, &[0x02, 0, 2, 0, 0x20, 0x25, 0x35, 0x08]),
            (Request::Baud(Baud::B38400), &[0x02, 0, 2, 0, 0x20, 0x40, 0x50, 0x08]),
            (Request::Baud(Baud::B19200), &[0x02, 0, 2, 0, 0x20, 0x41, 0x51, 0x08]),
            (Request::Baud(Baud::B9600), &[0x02, 0, 2, 0, 0x20, 0x42, 0x52, 0x08]),
            (Request::Baud(Baud::B500000), &[0x02, 0, 2, 0, 0x20, 0x48, 0x58, 0x08]),
            (Request::Variant(Variant::HALF), &[0x02, 0, 5, 0, 0x3B, 0xB4, 0, 0x32, 0, 0x3B, 0x1F]),
            (
                Request::Variant(Variant { angle_deg: 180, resolution_cdeg: 100 }),
                &[0x02, 0, 5, 0, 0x3B, 0xB4, 0, 0x64, 0, 0x97, 0x49],
            ),
            (
                Request::Variant(Variant { angle_deg: 100, resolution_cdeg: 25 }),
                &[0x02, 0, 5, 0, 0x3B, 0x64, 0, 0x19, 0, 0xE7, 0x72],
            ),
        ];
        for (request, bytes) in vectors {
            assert_eq!(request.encode(0).bytes(), bytes, "{request:?}");
            assert_eq!(Request::decode(Telegram::check(bytes).unwrap()), Some(request));
            assert!(!EEPROM_WRITES.contains(&request.command()));
        }
    }

    #[test]
    fn a_variant_that_is_none_is_no_request() {
        let telegram = Writer::new(0, VARIANT).word(180).word(25).finish();
        assert_eq!(Request::decode(telegram.telegram()), None);
    }
}
