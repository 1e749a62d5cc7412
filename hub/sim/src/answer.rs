//! What the sensor answers to a request, and what the request changes in it. Knows only one time, how long the sensor
//! takes to answer, and nothing about the line.
//!
//! It supports everything on the way to a stream, every mode that sends measured values, and the part of the installation
//! mode that changes the configuration and the permanent rate. Every other well-formed request is refused with 92h, as the
//! sensor does with requests that it does not support.

use std::ops::Range;

use lms_configure::eeprom::{self, PowerOn, Write};
use scanhub_drivers::lms::command::{self, EEPROM_WRITES, Request};
use scanhub_drivers::lms::family::Family;
use scanhub_drivers::lms::operating::Operating as Asked;
use scanhub_drivers::lms::parameters::Password;
use scanhub_drivers::lms::reply::{self, Health};
use scanhub_drivers::lms::telegram::{Encoded, REPLY, Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, MIRROR_TURN, Variant};
use schema::{MILLIS, Nanos};

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
    /// The sensor restarts.
    Reset,
}

impl Machine {
    /// Does what `request` asks at `now`, and answers.
    pub(crate) fn answer(&mut self, request: Telegram<'_>, now: Nanos) -> Answer {
        if EEPROM_WRITES.contains(&request.command()) {
            self.eeprom.writes += 1;
        }
        let asked = request.command();
        let is_refused = self.settings.habits.refuses.contains(&asked);
        if is_refused || self.family().and_then(|family| family.refuses_command(asked)).is_some() {
            return self.refusal();
        }
        let (address, status) = (self.settings.address, self.settings.status);
        match Request::decode(request) {
            Some(Request::Status) => answer(&self.status(), self.thinking_ns()),
            Some(Request::Type) => {
                answer(&reply::kind(address, self.settings.type_name.as_bytes(), status), self.thinking_ns())
            }
            Some(Request::Configuration) => {
                let told = self.reply(command::CONFIGURATION | REPLY, self.eeprom.configuration());
                answer(&told, self.thinking_ns())
            }
            Some(Request::Errors) => {
                let pairs: Vec<u8> =
                    self.settings.errors.iter().flat_map(|&(kind, number)| [kind, number]).collect();
                answer(&self.reply(command::ERRORS | REPLY, &pairs), self.thinking_ns())
            }
            Some(Request::Counters) => self.counters(),
            Some(Request::Reset) => {
                self.settings.errors.clear();
                let announced = self.reply(reply::RESET, &[]);
                Answer { after: After::Reset, ..answer(&announced, self.thinking_ns()) }
            }
            Some(Request::Variant(variant)) => {
                let done = self.source.variant().is_none_or(|fixed| fixed == variant) && self.can(variant);
                if done {
                    self.variant = variant;
                }
                answer(&reply::variant(address, done, self.variant, status), self.mode_ns())
            }
            Some(Request::Baud(baud)) => {
                let changed = reply::mode(address, true, status);
                Answer { after: After::Baud(baud), ..answer(&changed, self.mode_ns()) }
            }
            Some(Request::Operate(Asked::Installation(password))) => match password {
                Password::FACTORY => self.change_mode(Operating::Installation),
                _ => answer(&reply::mode(address, false, status), self.mode_ns()),
            },
            Some(asked) => match Operating::of_request(asked, self.variant) {
                Some(operating) if self.source.can(&operating) && self.may(&operating) => {
                    if asked.command() == command::MODE {
                        self.change_mode(operating)
                    } else {
                        self.measure_once(&operating, now)
                    }
                }
                _ => self.refusal(),
            },
            None => self.answer_other(request),
        }
    }

    /// 90h: what it says when it has started.
    pub(crate) fn banner(&self) -> Vec<u8> {
        self.reply(reply::POWER_ON, self.settings.type_name.as_bytes()).bytes().to_vec()
    }

    /// What writes the EEPROM, and what is a request by its command only.
    fn answer_other(&mut self, request: Telegram<'_>) -> Answer {
        let (address, status) = (self.settings.address, self.settings.status);
        let is_installation = self.operating == Operating::Installation;
        match Write::decode(request) {
            Some(Write::Configuration(data)) if is_installation => return self.write_configuration(data),
            Some(Write::PowerOn(set @ (PowerOn::Baud9600 | PowerOn::KeepBaud))) if is_installation => {
                self.eeprom.permanent_baud = (set == PowerOn::KeepBaud).then(|| self.baud());
                let done = self.reply(eeprom::POWER_ON_RATE | REPLY, &[0, set.byte()]);
                return answer(&done, self.write_ns(false));
            }
            _ => {}
        }
        match (request.command(), request.data()) {
            // A variant that is none.
            (command::VARIANT, [_, _, _, _]) => {
                answer(&reply::variant(address, false, self.variant, status), self.mode_ns())
            }
            // The listing allows a word that means nothing.
            (command::COUNTERS, [0, 0]) => self.counters(),
            _ => self.refusal(),
        }
    }

    fn counters(&mut self) -> Answer {
        answer(&self.reply(command::COUNTERS | REPLY, &COUNTED), self.thinking_ns())
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
        self.partials = 0;
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
        answer(&self.reply(eeprom::CONFIGURATION | REPLY, &outcome), delay_ns)
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
        self.delay_ns(THINKING_NS)
    }

    /// Between ACK and A0h or BBh.
    fn mode_ns(&mut self) -> Nanos {
        self.delay_ns(MODE_NS) + self.settings.habits.late_mode_ns
    }

    fn delay_ns(&mut self, usual: Range<Nanos>) -> Nanos {
        let by_chance = self.random.u64(usual);
        match self.settings.habits.answer_ns {
            0 => by_chance,
            answer_ns => answer_ns,
        }
    }

    /// Between ACK and F7h or E6h.
    fn write_ns(&self, is_other_unit: bool) -> Nanos {
        let usual_ns = if is_other_unit { UNIT_NS } else { SAME_NS };
        usual_ns + self.settings.habits.late_write_ns
    }

    fn may(&self, operating: &Operating) -> bool {
        let is_measuring = operating.streams();
        !(self.settings.habits.strict && is_measuring) || self.operating != Operating::Installation
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

/// Of an error that is not over.
const FATAL: u8 = 4;
/// What a sensor has counted that is some years old: hours (unit 2 h) and power-ons.
const COUNTED: [u8; 4] = [0x10, 0x27, 0x2C, 0x01];
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
