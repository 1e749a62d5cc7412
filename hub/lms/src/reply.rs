//! Replies: what a sensor says to a host's requests. Decoded by the session, encoded by the simulator. Every reply
//! ends with a status byte, which is the telegram's affair ([`Telegram::status`]), not this file's.

use crate::command;
use crate::measured::{MEASURED, Measured};
use crate::telegram::{Encoded, REPLY, Telegram, Writer};
use crate::variant::{Baud, Mode, Unit, Variant};

/// A reply of the path from power-on to a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reply<'a> {
    /// A0h: the operating mode (or rate) was changed, or not.
    Mode {
        /// Whether it was.
        done: bool,
    },
    /// B1h.
    Status(StatusReport<'a>),
    /// BAh: type, number and firmware as ASCII, such as `LMS200;S18063;V02.19`.
    Type(&'a [u8]),
    /// F4h.
    Configuration(Configuration<'a>),
    /// BBh: the variant now in force, and whether it is the one asked for.
    Variant {
        /// Whether the switch was done.
        done: bool,
        /// Angle in degrees and resolution in 1/100 degree as the sensor says them.
        angle_deg: u16,
        /// See `angle_deg`.
        resolution_cdeg: u16,
    },
    /// B0h: a scan, asked for or streamed.
    Measured(Measured<'a>),
    /// 92h: a well-formed command that this sensor cannot do, or not now.
    Refused,
}

impl<'a> Reply<'a> {
    /// What `telegram` says; `None` if it is no reply of this list or shorter than its kind needs.
    pub fn decode(telegram: Telegram<'a>) -> Option<Reply<'a>> {
        if !telegram.is_reply() {
            return None;
        }
        let data = telegram.data();
        match telegram.command() {
            MODE => data.first().map(|&outcome| Reply::Mode { done: outcome == 0 }),
            STATUS => data.try_into().ok().map(StatusReport).map(Reply::Status),
            TYPE => Some(Reply::Type(data.trim_ascii())),
            CONFIGURATION => {
                (data.len() >= CONFIGURATION_MIN).then_some(Reply::Configuration(Configuration(data)))
            }
            VARIANT => {
                let &[done, a, b, c, d] = data else { return None };
                Some(Reply::Variant {
                    done: done == 1,
                    angle_deg: u16::from_le_bytes([a, b]),
                    resolution_cdeg: u16::from_le_bytes([c, d]),
                })
            }
            MEASURED => Measured::decode(telegram).map(Reply::Measured),
            REFUSED => Some(Reply::Refused),
            _ => None,
        }
    }
}

/// Data of a status reply: 152 bytes, of which the sensor's settings and its health are read here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StatusReport<'a>(&'a [u8; STATUS_LEN]);

impl<'a> StatusReport<'a> {
    /// Firmware as ASCII, such as `V02.19`.
    pub fn software(&self) -> &'a [u8] {
        self.0[..7].trim_ascii()
    }

    /// The operating mode, the byte after command 20h (24h: streaming, 25h: on request).
    pub fn operating_mode(&self) -> u8 {
        self.0[7]
    }

    /// Whether the sensor calls itself defective.
    pub fn is_defective(&self) -> bool {
        self.0[8] != 0
    }

    /// How values are split.
    pub fn mode(&self) -> Mode {
        Mode(self.0[101])
    }

    /// Angle and resolution in force; `None` if the sensor names a pair that no telegram can carry.
    pub fn variant(&self) -> Option<Variant> {
        let word = |at: usize| u16::from_le_bytes([self.0[at], self.0[at + 1]]);
        Variant::new(word(106), word(108))
    }

    /// Unit of the ranges; `None` for an unknown code.
    pub fn unit(&self) -> Option<Unit> {
        Unit::of_code(self.0[121])
    }
}

/// Data of a configuration reply: 34 bytes, 32 with older firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Configuration<'a>(&'a [u8]);

impl<'a> Configuration<'a> {
    /// The bytes as the sensor keeps them.
    pub fn bytes(&self) -> &'a [u8] {
        self.0
    }

    /// How values are split.
    pub fn mode(&self) -> Mode {
        Mode(self.0[5])
    }

    /// Unit of the ranges; `None` for an unknown code.
    pub fn unit(&self) -> Option<Unit> {
        Unit::of_code(self.0[6])
    }
}

/// A0h: mode or rate changed (or not), from `address`, ending with `status`.
pub fn mode(address: u8, done: bool, status: u8) -> Encoded {
    Writer::new(address | REPLY, MODE).byte(u8::from(!done)).byte(status).finish()
}

/// 92h: refused, from `address`, ending with `status`.
pub fn refused(address: u8, status: u8) -> Encoded {
    Writer::new(address | REPLY, REFUSED).byte(status).finish()
}

/// BAh: `name` is type, number and firmware, 20 or 21 ASCII characters by custom.
pub fn kind(address: u8, name: &[u8], status: u8) -> Encoded {
    Writer::new(address | REPLY, TYPE).slice(name).byte(status).finish()
}

/// BBh: whether the switch was done, and the variant in force.
pub fn variant(address: u8, done: bool, variant: Variant, status: u8) -> Encoded {
    Writer::new(address | REPLY, VARIANT)
        .byte(u8::from(done))
        .word(variant.angle_deg)
        .word(variant.resolution_cdeg)
        .byte(status)
        .finish()
}

/// F4h: 34 bytes of a sensor as it left the factory, with this measuring mode and unit.
pub fn configuration(address: u8, mode: Mode, unit: Unit, status: u8) -> Encoded {
    let mut data = [0; CONFIGURATION_LEN];
    data[2] = 0x70;
    data[5] = mode.0;
    data[6] = unit.code();
    data[9] = 2;
    data[10] = 2;
    data[32] = 2;
    Writer::new(address | REPLY, CONFIGURATION).slice(&data).byte(status).finish()
}

/// What a simulated sensor says of itself in a status reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Health {
    /// Firmware, 7 ASCII characters.
    pub software: [u8; 7],
    /// The byte after the last 20h.
    pub operating_mode: u8,
    /// How values are split.
    pub mode: Mode,
    /// Angle and resolution in force.
    pub variant: Variant,
    /// Unit of the ranges.
    pub unit: Unit,
    /// Rate of the line.
    pub baud: Baud,
}

/// B1h: the settings of `health`, a motor at its nominal speed, everything else 0.
pub fn status(address: u8, health: &Health, status: u8) -> Encoded {
    let mut data = [0; STATUS_LEN];
    data[..7].copy_from_slice(&health.software);
    data[7] = health.operating_mode;
    // Microseconds per 1/90 revolution: 148 is 13.32 ms a turn.
    data[66..68].copy_from_slice(&148u16.to_le_bytes());
    data[101] = health.mode.0;
    data[106..108].copy_from_slice(&health.variant.angle_deg.to_le_bytes());
    data[108..110].copy_from_slice(&health.variant.resolution_cdeg.to_le_bytes());
    let divisor: u16 = match health.baud {
        Baud::B500000 => 0x8001,
        Baud::B38400 => 0x8019,
        Baud::B19200 => 0x8033,
        Baud::B9600 => 0x8067,
    };
    data[115..117].copy_from_slice(&divisor.to_le_bytes());
    data[121] = health.unit.code();
    data[122] = 1;
    Writer::new(address | REPLY, STATUS).slice(&data).byte(status).finish()
}

/// Command byte of the refusal.
pub const REFUSED: u8 = 0x92;

const MODE: u8 = command::MODE | REPLY;
const STATUS: u8 = command::STATUS | REPLY;
const TYPE: u8 = command::TYPE | REPLY;
const VARIANT: u8 = command::VARIANT | REPLY;
const CONFIGURATION: u8 = command::CONFIGURATION | REPLY;
/// LENGTH 9Ah less command and status (Telegram listing 7-5).
const STATUS_LEN: usize = 152;
/// Data of F4h; a capture of V02.19 has 34, older firmware 32.
const CONFIGURATION_LEN: usize = 34;
const CONFIGURATION_MIN: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(bytes: &[u8]) -> Reply<'_> {
        Reply::decode(Telegram::check(bytes).unwrap()).unwrap()
    }

    #[test]
    fn printed_and_captured_replies() {
        assert_eq!(mode(0, true, 0x10).bytes(), [0x02, 0x80, 3, 0, 0xA0, 0, 0x10, 0x16, 0x0A]);
        assert_eq!(mode(1, true, 0x10).bytes(), [0x02, 0x81, 3, 0, 0xA0, 0, 0x10, 0x36, 0x1A]);
        assert_eq!(mode(0, true, 0x11).bytes(), [0x02, 0x80, 3, 0, 0xA0, 0, 0x11, 0x17, 0x0A]);
        assert_eq!(refused(0, 0x10).bytes(), [0x02, 0x80, 2, 0, 0x92, 0x10, 0x7F, 0x33]);
        let bb = variant(0, true, Variant::HALF, 0x10);
        assert_eq!(bb.bytes(), [0x02, 0x80, 7, 0, 0xBB, 1, 0xB4, 0, 0x32, 0, 0x10, 0x03, 0x9D]);
        assert_eq!(decoded(bb.bytes()), Reply::Variant { done: true, angle_deg: 180, resolution_cdeg: 50 });
        let ba = kind(0, b"LMS200;S18063;V02.19 ", 0x10);
        assert_eq!(ba.bytes()[26..], [0x10, 0x85, 0x6A]);
        assert_eq!(decoded(ba.bytes()), Reply::Type(b"LMS200;S18063;V02.19"));
        assert_eq!(decoded(mode(0, false, 0x10).bytes()), Reply::Mode { done: false });
        assert_eq!(decoded(refused(0, 0x10).bytes()), Reply::Refused);
    }

    #[test]
    fn a_captured_configuration() {
        let mut bytes = [0; 42];
        bytes[..17].copy_from_slice(&[2, 0x80, 0x24, 0, 0xF4, 0, 0, 0x70, 0, 0, 4, 1, 0, 0, 2, 2, 0]);
        bytes[37..].copy_from_slice(&[2, 0, 0x10, 0x36, 0xFE]);
        let Reply::Configuration(configuration) = decoded(&bytes) else { panic!("not a configuration") };
        assert_eq!((configuration.mode(), configuration.unit()), (Mode(4), Some(Unit::Mm)));
        assert_eq!(super::configuration(0, Mode(4), Unit::Mm, 0x10).bytes(), bytes);
    }

    #[test]
    fn a_status_both_ways() {
        let health = Health {
            software: *b"V02.19 ",
            operating_mode: 0x24,
            mode: Mode(1),
            variant: Variant::HALF,
            unit: Unit::Cm,
            baud: Baud::B500000,
        };
        let encoded = status(0, &health, 0x10);
        assert_eq!(encoded.bytes().len(), 160);
        let Reply::Status(report) = decoded(encoded.bytes()) else { panic!("not a status") };
        assert_eq!(report.software(), b"V02.19");
        assert_eq!((report.operating_mode(), report.is_defective()), (0x24, false));
        assert_eq!(
            (report.mode(), report.variant(), report.unit()),
            (Mode(1), Some(Variant::HALF), Some(Unit::Cm))
        );
    }
}
