//! A telegram in a line: who says what to whom, and the one thing in it that people want to know first.

use super::{Degrees, name, unit_name};
use crate::lms::command::Request;
use crate::lms::condition::Condition;
use crate::lms::measured::Measured;
use crate::lms::operating;
use crate::lms::reply::Reply;
use crate::lms::telegram::{REPLY, Telegram};
use crate::lms::variant::Variant;
use core::fmt;

/// What a telegram is, for people.
#[derive(Clone, Copy, Debug)]
pub struct Headline<'a>(pub Telegram<'a>);

impl fmt::Display for Headline<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let telegram = self.0;
        let (command, is_reply) = (telegram.command(), telegram.is_reply());
        write!(f, "{command:02X}h {}", name(command, is_reply).unwrap_or("unknown command"))?;
        match (is_reply, telegram.address() & !REPLY) {
            (true, address) => write!(f, ", from sensor {address}")?,
            (false, 0) => f.write_str(", to all sensors")?,
            (false, address) => write!(f, ", to sensor {address}")?,
        }
        if is_reply {
            reply(f, telegram)?;
        } else {
            request(f, telegram)?;
        }
        match telegram.status() {
            Some(status) => write!(f, "; {}", Condition(status)),
            None => Ok(()),
        }
    }
}

fn request(f: &mut fmt::Formatter<'_>, telegram: Telegram<'_>) -> fmt::Result {
    match Request::decode(telegram) {
        Some(Request::Variant(Variant { angle_deg, resolution_cdeg })) => {
            write!(f, ": {angle_deg} degrees at {}", Degrees(resolution_cdeg))
        }
        Some(Request::Stream | Request::Stop | Request::Baud(_) | Request::Operate(_)) => {
            write!(f, ": {}", operating::name(telegram.data()[0]))
        }
        Some(_) => Ok(()),
        None if crate::lms::command::EEPROM_WRITES.contains(&telegram.command()) => f.write_str(" (EEPROM)"),
        None => f.write_str(", not as it should be"),
    }
}

fn reply(f: &mut fmt::Formatter<'_>, telegram: Telegram<'_>) -> fmt::Result {
    match Reply::decode(telegram) {
        Some(Reply::PowerOn(name) | Reply::Type(name)) => write!(f, ": {}", name.escape_ascii()),
        Some(Reply::Mode { done }) => f.write_str(if done { ": done" } else { ": not done" }),
        Some(Reply::Measured(values)) => measured(f, values),
        Some(
            Reply::Means { values, .. } | Reply::Range { values, .. } | Reply::RangeMeans { values, .. },
        ) => {
            write!(f, ": {} in {}", values.count(), unit_name(values.unit()))
        }
        Some(Reply::Status(report)) => {
            write!(
                f,
                ": {}, {}",
                report.software().escape_ascii(),
                operating::name(report.operating_mode())
            )?;
            f.write_str(if report.is_defective() { ", DEFECTIVE" } else { "" })
        }
        Some(Reply::Errors(errors)) => match errors.iter().len() {
            0 => f.write_str(": none"),
            count => {
                let past = errors.iter().filter(|fault| fault.is_past()).count();
                write!(f, ": {} present, {past} past", count - past)
            }
        },
        Some(Reply::Variant { done, angle_deg, resolution_cdeg }) => {
            let degrees = Degrees(resolution_cdeg);
            let outcome = if done { "done" } else { "not done" };
            write!(f, ": {outcome}, {angle_deg} degrees at {degrees} in force")
        }
        Some(Reply::Configuration(configuration)) => write!(f, ": {}", configuration.mode().name()),
        Some(Reply::ConfigurationWritten { done, .. } | Reply::Configuration2Written { done, .. }) => {
            f.write_str(if done { ": done" } else { ": not done" })
        }
        Some(_) => Ok(()),
        None => f.write_str(", not as it should be"),
    }
}

fn measured(f: &mut fmt::Formatter<'_>, values: Measured<'_>) -> fmt::Result {
    write!(f, ": {} in {}", values.count(), unit_name(values.unit()))?;
    match (values.partial(), Variant::of_beams(values.count())) {
        (Some(quarter), _) => write!(f, ", partial scan from {}", Degrees(25 * u16::from(quarter))),
        (None, Some(Variant { angle_deg, resolution_cdeg })) => {
            write!(f, ", {angle_deg} degrees at {}", Degrees(resolution_cdeg))
        }
        (None, None) => Ok(()),
    }
}
