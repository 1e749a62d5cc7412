//! What the sensor answers to a request, and what the request changes in it. Knows no times but how long the sensor
//! thinks, and nothing of the line.
//!
//! It can what the path to a stream needs, every mode that sends measured values, and as much of the installation mode
//! as changing the configuration and the permanent rate needs. Every other well-formed request is refused with 92h, as
//! the sensor does with what it cannot.

use std::ops::Range;

use lms::command::{EEPROM_WRITES, MODE, Request, VARIANT};
use lms::family::Family;
use lms::reply::{self, Health};
use lms::telegram::{Encoded, Telegram, Writer};
use lms::variant::{Baud, MIRROR_TURN, Variant};
use lms::{MILLIS, Nanos};

use crate::machine::Machine;
use crate::operating::Operating;

/// A reply, how long after its ACK it begins at least, and what comes after it.
pub(crate) struct Answer {
    pub(crate) reply: Vec<u8>,
    pub(crate) delay_ns: Nanos,
    pub(crate) after: After,
}

/// What a reply announces.
#[derive(Clone, Copy, Debug)]
pub(crate) enum After {
    Nothing,
    /// The line has another rate.
    Baud(Baud),
    /// The sensor starts anew.
    Reset,
}

impl Machine {
    /// Does what `request` asks at `now`, and answers.
    pub(crate) fn answer(&mut self, request: Telegram<'_>, now: Nanos) -> Answer {
        if EEPROM_WRITES.contains(&request.command()) {
            self.eeprom.writes += 1;
        }
        let command = request.command();
        let is_refused = self.settings.habits.refuses.contains(&command);
        if is_refused || self.family().and_then(|family| family.refuses_command(command)).is_some() {
            return self.refusal();
        }
        let (address, status) = (self.settings.address, self.settings.status);
        match Request::decode(request) {
            Some(Request::Status) => answer(&self.status(), self.thinking_ns()),
            Some(Request::Type) => {
                answer(&reply::kind(address, self.settings.type_name.as_bytes(), status), self.thinking_ns())
            }
            Some(Request::Configuration) => {
                answer(&self.reply(CONFIGURATION, self.eeprom.configuration()), self.thinking_ns())
            }
            Some(Request::Variant(variant)) => {
                let done = self.source.variant().is_none_or(|fixed| fixed == variant) && self.can(variant);
                if done {
                    self.variant = variant;
                }
                answer(&reply::variant(address, done, self.variant, status), self.mode_ns())
            }
            Some(Request::Stream) if self.may_measure() => self.change_mode(Operating::All),
            Some(Request::Stop) => self.change_mode(Operating::OnRequest),
            Some(Request::Baud(baud)) => Answer {
                after: After::Baud(baud),
                ..answer(&reply::mode(address, true, status), self.mode_ns())
            },
            _ => self.answer_other(request, now),
        }
    }

    /// 90h: what it says when it has started.
    pub(crate) fn banner(&self) -> Vec<u8> {
        self.reply(BANNER, self.settings.type_name.as_bytes()).bytes().to_vec()
    }

    fn answer_other(&mut self, request: Telegram<'_>, now: Nanos) -> Answer {
        let (address, status) = (self.settings.address, self.settings.status);
        let is_installation = self.operating == Operating::Installation;
        match (request.command(), request.data()) {
            (RESET, []) => {
                self.settings.errors.clear();
                let announced = Writer::new(self.reply_address(), RESET_REPLY).byte(status).finish();
                Answer { after: After::Reset, ..answer(&announced, self.thinking_ns()) }
            }
            // A variant that is none.
            (VARIANT, [_, _, _, _]) => {
                answer(&reply::variant(address, false, self.variant, status), self.mode_ns())
            }
            (COUNTERS, [] | [0, 0]) => answer(&self.reply(COUNTERS_REPLY, &COUNTED), self.thinking_ns()),
            (ERRORS, []) => {
                let pairs: Vec<u8> =
                    self.settings.errors.iter().flat_map(|&(kind, number)| [kind, number]).collect();
                answer(&self.reply(ERRORS_REPLY, &pairs), self.thinking_ns())
            }
            (MODE, [0x00, password @ ..]) if password == PASSWORD => {
                self.change_mode(Operating::Installation)
            }
            (MODE, [0x00, ..]) => answer(&reply::mode(address, false, status), self.mode_ns()),
            (MODE, data) => match Operating::of_mode(data, self.variant) {
                Some(operating) if self.source.can(&operating) && self.may_measure() => {
                    self.change_mode(operating)
                }
                _ => self.refusal(),
            },
            (WRITE_CONFIGURATION, data) if is_installation && !data.is_empty() => {
                self.write_configuration(data)
            }
            (PERMANENT_BAUD, &[permanent @ (0 | 1)]) if is_installation => {
                self.eeprom.permanent_baud = (permanent == 1).then(|| self.baud());
                answer(&self.reply(PERMANENT_BAUD | 0x80, &[0, permanent]), self.write_ns(false))
            }
            _ => match Operating::of_single(request, self.variant) {
                Some(operating) if self.source.can(&operating) && self.may_measure() => {
                    self.measure_once(&operating, now)
                }
                _ => self.refusal(),
            },
        }
    }

    fn measure_once(&mut self, operating: &Operating, now: Nanos) -> Answer {
        let delay_ns = operating.turns(self.variant) * MIRROR_TURN;
        let single =
            self.source.variant().is_none().then(|| self.measure(operating, now + delay_ns)).flatten();
        match single {
            Some(reply) => Answer { reply, delay_ns, after: After::Nothing },
            None => self.refusal(),
        }
    }

    fn change_mode(&mut self, operating: Operating) -> Answer {
        self.operating = operating;
        answer(&reply::mode(self.settings.address, true, self.settings.status), self.mode_ns())
    }

    /// 77h in installation mode changes as many bytes of the configuration as it has, except that the words of a
    /// recording are what they are.
    fn write_configuration(&mut self, data: &[u8]) -> Answer {
        let (unit, mode) = (self.eeprom.unit(), self.eeprom.mode());
        let written = self.eeprom.rewritten(data).filter(|written| {
            self.source.variant().is_none() || (written.unit() == unit && written.mode() == mode)
        });
        let done = written.is_some();
        self.eeprom = written.unwrap_or_else(|| self.eeprom.clone());
        let delay_ns = self.write_ns(self.eeprom.unit() != unit);
        let outcome = [&[u8::from(done)], self.eeprom.configuration()].concat();
        answer(&self.reply(CONFIGURATION_WRITTEN, &outcome), delay_ns)
    }

    /// B1h: what a healthy sensor says, its settings, and what ails it.
    fn status(&self) -> Encoded {
        let firmware = self.settings.type_name.rsplit(';').next().unwrap_or_default().as_bytes();
        let health = Health {
            software: std::array::from_fn(|at| firmware.get(at).copied().unwrap_or(b' ')),
            operating_mode: self.operating.code(),
            mode: self.eeprom.mode(),
            variant: self.variant,
            unit: self.eeprom.unit(),
            baud: self.baud(),
        };
        let healthy = reply::status(self.settings.address, &health, self.settings.status);
        let mut data = healthy.telegram().data().to_vec();
        // Offsets in the data of B1h, which begin after the command byte (Telegram listing 7-5).
        data[8] = u8::from(self.settings.errors.iter().any(|&(kind, _)| kind == FATAL));
        let pollution = POLLUTION_CLEAN / 100 * self.settings.pollution_percent;
        for (at, words, value) in [(18, 12, pollution), (42, 12, POLLUTION_CLEAN)] {
            data[at..at + 2 * words].copy_from_slice(&value.to_le_bytes().repeat(words));
        }
        data[118] = u8::from(self.eeprom.permanent_baud.is_some());
        data[119] = self.settings.address;
        self.reply(healthy.telegram().command(), &data)
    }

    /// Between ACK and reply where nothing changes.
    fn thinking_ns(&mut self) -> Nanos {
        self.random.u64(THINKING_NS)
    }

    /// Between ACK and A0h or BBh.
    fn mode_ns(&mut self) -> Nanos {
        self.random.u64(MODE_NS) + self.settings.habits.late_mode_ns
    }

    /// Between ACK and F7h or E6h.
    fn write_ns(&self, is_other_unit: bool) -> Nanos {
        let usual_ns = if is_other_unit { UNIT_NS } else { SAME_NS };
        usual_ns + self.settings.habits.late_write_ns
    }

    fn may_measure(&self) -> bool {
        !self.settings.habits.strict || self.operating != Operating::Installation
    }

    fn family(&self) -> Option<Family> {
        Family::of_type(self.settings.type_name.as_bytes())
    }

    fn can(&self, variant: Variant) -> bool {
        self.family().and_then(|family| family.refuses_variant(variant)).is_none()
    }

    fn refusal(&mut self) -> Answer {
        answer(&reply::refused(self.settings.address, self.settings.status), self.thinking_ns())
    }

    fn reply(&self, command: u8, data: &[u8]) -> Encoded {
        Writer::new(self.reply_address(), command).slice(data).byte(self.settings.status).finish()
    }
}

fn answer(reply: &Encoded, delay_ns: Nanos) -> Answer {
    Answer { reply: reply.bytes().to_vec(), delay_ns, after: After::Nothing }
}

/// The password that every sensor leaves the factory with (Telegram listing 6-4).
const PASSWORD: &[u8] = b"SICK_LMS";
/// Command: start anew, and the reply before that; then the banner.
const RESET: u8 = 0x10;
const RESET_REPLY: u8 = 0x91;
const BANNER: u8 = 0x90;
/// Command: errors, and its reply (without one in the list). A fatal one that is not over has type 4.
const ERRORS: u8 = 0x32;
const ERRORS_REPLY: u8 = 0xB2;
const FATAL: u8 = 4;
/// Command: hours (unit 2 h) and power-ons, and its reply; what a sensor has counted that is some years old.
const COUNTERS: u8 = 0x35;
const COUNTERS_REPLY: u8 = 0xB5;
const COUNTED: [u8; 4] = [0x10, 0x27, 0x2C, 0x01];
/// Reply: the configuration.
const CONFIGURATION: u8 = 0xF4;
/// Command: write the configuration, and its reply.
const WRITE_CONFIGURATION: u8 = 0x77;
const CONFIGURATION_WRITTEN: u8 = 0xF7;
/// Command: the rate at power-on.
const PERMANENT_BAUD: u8 = 0x66;
/// What a clean window's sensors read; only the ratio to it matters.
const POLLUTION_CLEAN: u16 = 1_000;
/// Between ACK and reply where nothing changes: captured exchanges took 70 to 158 ms at 38400, request and reply
/// themselves 10 to 45 of them.
const THINKING_NS: Range<Nanos> = 55 * MILLIS..145 * MILLIS;
/// Between ACK and A0h or BBh: captured exchanges took 66 to 94 ms, the listing allows 3 s.
const MODE_NS: Range<Nanos> = 55 * MILLIS..85 * MILLIS;
/// Between ACK and F7h: a captured exchange took 130 ms.
const SAME_NS: Nanos = 110 * MILLIS;
/// The same where the unit changes: SICK's quick manual allows 7 s.
const UNIT_NS: Nanos = 1_000 * MILLIS;
