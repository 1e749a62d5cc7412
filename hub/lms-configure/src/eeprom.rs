//! Requests that write a sensor's EEPROM, which wears out after a few thousand writes. They work in installation mode
//! only (Telegram listing 7-1). This module encodes and decodes them, and sends none.

use scanhub_drivers::lms::telegram::{EncodedTelegram, MAX_LENGTH, Telegram, Writer};

/// A request that writes the EEPROM.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EepromWrite<'a> {
    /// 40h: a field. The parameters as they are: their layout is not known here.
    Field(&'a [u8]),
    /// 42h: the password of the installation mode. The parameters as they are.
    Password(&'a [u8]),
    /// 46h: teach a field. The parameters as they are.
    Teach(&'a [u8]),
    /// 66h: the rate after power-on, or how the type is kept.
    PowerOn(PowerOn),
    /// 77h: the first part of the configuration; fewer than its 34 bytes change the leading ones only.
    Configuration(&'a [u8]),
    /// 7Ch: the second part of the configuration, 84 bytes.
    Configuration2(&'a [u8]),
}

impl<'a> EepromWrite<'a> {
    /// The telegram that says it to the sensor at `address`; `None` if its bytes are more than such a request may have.
    pub fn encode(self, address: u8) -> Option<EncodedTelegram> {
        let data = match &self {
            EepromWrite::PowerOn(power_on) => core::slice::from_ref(power_on.as_byte()),
            EepromWrite::Field(data)
            | EepromWrite::Password(data)
            | EepromWrite::Teach(data)
            | EepromWrite::Configuration(data)
            | EepromWrite::Configuration2(data) => data,
        };
        self.fits(data.len()).then(|| Writer::new(address, self.command()).slice(data).finish())
    }

    /// The write that `telegram` asks for; `None` if it is none, or longer or shorter than it may be.
    pub fn decode(telegram: Telegram<'a>) -> Option<EepromWrite<'a>> {
        if telegram.is_reply() {
            return None;
        }
        let data = telegram.data();
        let write = match telegram.command() {
            FIELD => EepromWrite::Field(data),
            PASSWORD => EepromWrite::Password(data),
            TEACH => EepromWrite::Teach(data),
            POWER_ON_RATE => match data {
                &[byte] => EepromWrite::PowerOn(PowerOn::of_byte(byte)?),
                _ => return None,
            },
            CONFIGURATION => EepromWrite::Configuration(data),
            CONFIGURATION_2 => EepromWrite::Configuration2(data),
            _ => return None,
        };
        write.fits(data.len()).then_some(write)
    }

    /// The command byte.
    pub fn command(self) -> u8 {
        match self {
            EepromWrite::Field(_) => FIELD,
            EepromWrite::Password(_) => PASSWORD,
            EepromWrite::Teach(_) => TEACH,
            EepromWrite::PowerOn(_) => POWER_ON_RATE,
            EepromWrite::Configuration(_) => CONFIGURATION,
            EepromWrite::Configuration2(_) => CONFIGURATION_2,
        }
    }

    fn fits(&self, len: usize) -> bool {
        match self {
            EepromWrite::Configuration(_) => (1..=CONFIGURATION_LEN).contains(&len),
            EepromWrite::Configuration2(_) => (1..=CONFIGURATION_2_LEN).contains(&len),
            EepromWrite::PowerOn(_) => len == 1,
            EepromWrite::Field(_) | EepromWrite::Password(_) | EepromWrite::Teach(_) => len < MAX_LENGTH,
        }
    }
}

/// What 66h sets (Telegram listing, 66h).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PowerOn {
    /// 00h: 9600 after power-on, as from the factory.
    Baud9600,
    /// 01h: the present rate after power-on; a sensor so left at 500 kBd is found by nobody who looks at 9600.
    KeepBaud,
    /// 02h: keep the type.
    KeepType,
}

impl PowerOn {
    /// All of them.
    pub const ALL: [PowerOn; 3] = [PowerOn::Baud9600, PowerOn::KeepBaud, PowerOn::KeepType];

    /// Its byte.
    pub fn byte(self) -> u8 {
        *self.as_byte()
    }

    /// What `byte` sets.
    pub fn of_byte(byte: u8) -> Option<PowerOn> {
        PowerOn::ALL.into_iter().find(|power_on| power_on.byte() == byte)
    }

    fn as_byte(self) -> &'static u8 {
        match self {
            PowerOn::Baud9600 => &0,
            PowerOn::KeepBaud => &1,
            PowerOn::KeepType => &2,
        }
    }
}

/// Bytes of the first part of the configuration (Telegram listing, 77h; older firmware has 32).
pub const CONFIGURATION_LEN: usize = 34;
/// Bytes of the second part (Telegram listing, 7Ch).
pub const CONFIGURATION_2_LEN: usize = 84;

/// Command: write a field.
pub const FIELD: u8 = 0x40;
/// Command: change the password.
pub const PASSWORD: u8 = 0x42;
/// Command: teach a field.
pub const TEACH: u8 = 0x46;
/// Command: rate after power-on.
pub const POWER_ON_RATE: u8 = 0x66;
/// Command: write the first part of the configuration.
pub const CONFIGURATION: u8 = 0x77;
/// Command: write the second part of the configuration.
pub const CONFIGURATION_2: u8 = 0x7C;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_drivers::lms::command::{EEPROM_WRITES, Request};

    const PRINTED: [u8; 34] = [
        0, 0, 0x46, 0, 0, 0, 1, 0, 0, 2, 2, 2, 0, 0, 0x0A, 0x0A, 0x50, 0x64, 0, 0x0A, 0x0A, 0x50, 0x80, 0,
        0x0A, 0x0A, 0x50, 0x64, 0, 0, 0, 0, 2, 0,
    ];

    #[test]
    fn printed_writes_both_ways() {
        let configuration = EepromWrite::Configuration(&PRINTED).encode(0).unwrap();
        assert_eq!(configuration.bytes()[..5], [0x02, 0, 0x23, 0, 0x77]);
        assert_eq!(configuration.bytes()[39..], [0x7B, 0x4B]);
        assert_eq!(EepromWrite::decode(configuration.telegram()), Some(EepromWrite::Configuration(&PRINTED)));
        let factory = EepromWrite::PowerOn(PowerOn::Baud9600).encode(0).unwrap();
        assert_eq!(factory.bytes(), [0x02, 0, 2, 0, 0x66, 0, 0x9C, 0x4E]);
        let keep = EepromWrite::PowerOn(PowerOn::KeepBaud).encode(0).unwrap();
        assert_eq!(keep.bytes(), [0x02, 0, 2, 0, 0x66, 1, 0x9D, 0x4E]);
    }

    #[test]
    fn every_write_both_ways_and_none_is_a_request() {
        let all = [
            EepromWrite::Field(&[1, 2, 3]),
            EepromWrite::Password(b"SICK_LMSSICK_LMS"),
            EepromWrite::Teach(&[1]),
            EepromWrite::PowerOn(PowerOn::KeepType),
            EepromWrite::Configuration(&PRINTED[..7]),
            EepromWrite::Configuration2(&[0; 84]),
        ];
        for (write, command) in all.into_iter().zip(EEPROM_WRITES) {
            assert_eq!(write.command(), command);
            let encoded = write.encode(5).unwrap();
            assert_eq!(EepromWrite::decode(encoded.telegram()), Some(write));
            assert_eq!(Request::decode(encoded.telegram()), None);
        }
    }

    #[test]
    fn does_not_encode_or_decode_invalid_writes() {
        assert!(EepromWrite::Configuration(&[0; 35]).encode(0).is_none());
        assert!(EepromWrite::Configuration2(&[]).encode(0).is_none());
        assert!(EepromWrite::Field(&[0; 808]).encode(0).is_none());
        let three = Writer::new(0, POWER_ON_RATE).byte(3).finish();
        assert_eq!(EepromWrite::decode(three.telegram()), None);
        let reply = Writer::new(0x80, CONFIGURATION).byte(0).byte(0x10).finish();
        assert_eq!(EepromWrite::decode(reply.telegram()), None);
    }
}
