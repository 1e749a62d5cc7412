//! What the sensor answers to a request, and what the request changes in it. Knows no times but how long the sensor
//! thinks, and nothing of the line.
//!
//! It can what the path to a stream needs, and as much of the installation mode as changing unit and measuring mode
//! needs. Every other well-formed request is refused with 92h, as the sensor does with what it cannot.

use lms::command::{EEPROM_WRITES, MODE, Request, VARIANT};
use lms::reply::{self, Health};
use lms::telegram::{Encoded, Telegram, Writer};
use lms::variant::{Baud, Mode, Unit};
use lms::{MILLIS, Nanos};

use crate::machine::{Machine, Settings};

/// A reply, how long after its ACK it begins at least, and the rate of the line after it where that changes.
pub(crate) struct Answer {
    pub(crate) reply: Encoded,
    pub(crate) delay_ns: Nanos,
    pub(crate) baud: Option<Baud>,
}

impl Machine {
    /// Does what `request` asks, and answers.
    pub(crate) fn answer(&mut self, request: Telegram<'_>) -> Answer {
        let address = self.settings.address;
        if EEPROM_WRITES.contains(&request.command()) {
            self.eeprom_writes += 1;
            return answer(self.write_eeprom(request), EEPROM_NS);
        }
        match Request::decode(request) {
            Some(Request::Status) => {
                let health = Health {
                    software: *FIRMWARE,
                    operating_mode: self.operating_mode,
                    mode: self.settings.mode,
                    variant: self.settings.variant,
                    unit: self.settings.unit,
                    baud: self.baud(),
                };
                answer(reply::status(address, &health, STATUS), THINKING_NS)
            }
            Some(Request::Type) => {
                answer(reply::kind(address, self.settings.type_name.as_bytes(), STATUS), THINKING_NS)
            }
            Some(Request::Configuration) => answer(self.configuration(), THINKING_NS),
            Some(Request::Variant(variant)) => {
                let done = self.source.variant().is_none_or(|fixed| fixed == variant);
                if done {
                    self.settings.variant = variant;
                }
                answer(reply::variant(address, done, self.settings.variant, STATUS), MODE_NS)
            }
            Some(Request::Stream) => self.change_mode(STREAM),
            Some(Request::Stop) => self.change_mode(ON_REQUEST),
            Some(Request::Baud(baud)) => {
                Answer { reply: reply::mode(address, true, STATUS), delay_ns: MODE_NS, baud: Some(baud) }
            }
            _ => self.answer_other(request),
        }
    }

    fn answer_other(&mut self, request: Telegram<'_>) -> Answer {
        let address = self.settings.address;
        match (request.command(), request.data()) {
            // A variant that is none.
            (VARIANT, [_, _, _, _]) => {
                answer(reply::variant(address, false, self.settings.variant, STATUS), MODE_NS)
            }
            (ERRORS, []) => {
                answer(Writer::new(self.reply_address(), ERRORS_REPLY).byte(STATUS).finish(), THINKING_NS)
            }
            (MODE, [INSTALLATION, password @ ..]) if password == PASSWORD => self.change_mode(INSTALLATION),
            (MODE, [INSTALLATION, ..]) => answer(reply::mode(address, false, STATUS), MODE_NS),
            _ => answer(reply::refused(address, STATUS), THINKING_NS),
        }
    }

    fn change_mode(&mut self, mode: u8) -> Answer {
        self.operating_mode = mode;
        answer(reply::mode(self.settings.address, true, STATUS), MODE_NS)
    }

    /// 77h in installation mode sets measuring mode and unit, except in a recording, whose words are what they are.
    /// Everything else that would write is refused.
    fn write_eeprom(&mut self, request: Telegram<'_>) -> Encoded {
        if request.command() != WRITE_CONFIGURATION || self.operating_mode != INSTALLATION {
            return reply::refused(self.settings.address, STATUS);
        }
        let mode = request.data().get(5).map_or(self.settings.mode, |&mode| Mode(mode));
        let unit = request.data().get(6).map_or(Some(self.settings.unit), |&code| Unit::of_code(code));
        let same = mode == self.settings.mode && unit == Some(self.settings.unit);
        let done = unit.is_some() && (same || self.source.variant().is_none());
        if let (true, Some(unit)) = (done, unit) {
            self.settings.mode = mode;
            self.settings.unit = unit;
        }
        Writer::new(self.reply_address(), CONFIGURATION_WRITTEN)
            .byte(u8::from(done))
            .slice(self.configuration().telegram().data())
            .byte(STATUS)
            .finish()
    }

    fn configuration(&self) -> Encoded {
        let Settings { address, mode, unit, .. } = self.settings;
        reply::configuration(address, mode, unit, STATUS)
    }
}

fn answer(reply: Encoded, delay_ns: Nanos) -> Answer {
    Answer { reply, delay_ns, baud: None }
}

/// Operating mode: all values, continuously (Telegram listing, 20h).
pub(crate) const STREAM: u8 = 0x24;
/// Operating mode: values on request.
pub(crate) const ON_REQUEST: u8 = 0x25;
/// Operating mode: installation, with a password.
const INSTALLATION: u8 = 0x00;
/// The password that every sensor leaves the factory with (Telegram listing 6-4).
const PASSWORD: &[u8] = b"SICK_LMS";
/// Command: errors, and its reply (without one in the list).
const ERRORS: u8 = 0x32;
const ERRORS_REPLY: u8 = 0xB2;
/// Command: write the configuration, and its reply.
const WRITE_CONFIGURATION: u8 = 0x77;
const CONFIGURATION_WRITTEN: u8 = 0xF7;
/// Status byte of a healthy LMS type 6 (Telegram listing 8).
pub(crate) const STATUS: u8 = 0x10;
/// What the status reply calls the firmware.
const FIRMWARE: &[u8; 7] = b"V02.30 ";
/// Between ACK and reply where nothing changes; the listing allows 60 ms.
const THINKING_NS: Nanos = MILLIS;
/// Between ACK and A0h or BBh: captured exchanges took 66 ms and more, the listing allows 3 s.
const MODE_NS: Nanos = 55 * MILLIS;
/// Between ACK and F7h: a captured exchange took 130 ms.
const EEPROM_NS: Nanos = 110 * MILLIS;
