//! Requests that write a scanner's EEPROM, which wears out after a few thousand writes. A scanner accepts them only in
//! installation mode (Telegram listing 7-1). This module encodes and decodes requests, and does not send them.

use scanhub_drivers::lms::telegram::{EncodedTelegram, MAX_LENGTH, Telegram, Writer};

/// Request that writes the EEPROM.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EepromWrite<'a> {
    /// 40h: write a field. Contains the raw parameters, because this module does not decode their layout.
    Field(&'a [u8]),
    /// 42h: change the password of the installation mode. Contains the raw parameters.
    Password(&'a [u8]),
    /// 46h: teach a field. Contains the raw parameters.
    Teach(&'a [u8]),
    /// 66h: set the baud rate after power-on, or keep the type.
    PowerOn(PowerOn),
    /// 77h: write the first part of the configuration. Fewer than 34 bytes change only the first bytes of the
    /// configuration.
    Configuration(&'a [u8]),
    /// 7Ch: write the second part of the configuration, 84 bytes.
    Configuration2(&'a [u8]),
}

impl<'a> EepromWrite<'a> {
    /// Returns the telegram that sends this request to the scanner at `address`. Returns `None` if the data is too long
    /// or too short.
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

    /// Decodes the write in `telegram`. Returns `None` if the telegram is not a write, or its length is not valid.
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

    /// Returns the command byte.
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

/// Setting of command 66h (Telegram listing, 66h).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PowerOn {
    /// 00h: use 9600 baud after power-on, which is the factory setting.
    Baud9600,
    /// 01h: use the present baud rate after power-on. A program that searches only at 9600 does not find a scanner that
    /// was set to 500 kBd.
    KeepBaud,
    /// 02h: keep the type.
    KeepType,
}

impl PowerOn {
    /// Every setting.
    pub const ALL: [PowerOn; 3] = [PowerOn::Baud9600, PowerOn::KeepBaud, PowerOn::KeepType];

    /// Returns the byte of the setting.
    pub fn byte(self) -> u8 {
        *self.as_byte()
    }

    /// Returns the setting that `byte` stands for.
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

/// Length of the first part of the configuration, in bytes (Telegram listing, 77h). Older firmware has 32 bytes.
pub const CONFIGURATION_LEN: usize = 34;
/// Length of the second part of the configuration, in bytes (Telegram listing, 7Ch).
pub const CONFIGURATION_2_LEN: usize = 84;

/// Command that writes a field.
pub const FIELD: u8 = 0x40;
/// Command that changes the password.
pub const PASSWORD: u8 = 0x42;
/// Command that teaches a field.
pub const TEACH: u8 = 0x46;
/// Command that sets the baud rate after power-on.
pub const POWER_ON_RATE: u8 = 0x66;
/// Command that writes the first part of the configuration.
pub const CONFIGURATION: u8 = 0x77;
/// Command that writes the second part of the configuration.
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
    fn printed_eeprom_writes_round_trip() {
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
    fn every_eeprom_write_round_trips_and_is_no_request() {
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
