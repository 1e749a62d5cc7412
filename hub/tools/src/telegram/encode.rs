//! Names and values to telegrams: every request, also those that write a sensor's EEPROM, and the simpler replies. The
//! bytes are printed; nothing here can send them.

use std::io::{ErrorKind, Write};

use lms::command::Request;
use lms::condition::Condition;
use lms::configuration::Configuration;
use lms::errors::Errors;
use lms::explain::Headline;
use lms::measured;
use lms::operating::Operating;
use lms::parameters::Password;
use lms::reply::{self, Health, Reply};
use lms::telegram::{Encoded, REPLY};
use lms::variant::{Baud, MAX_BEAMS, Mode, Unit, Variant};
use lms_configure::eeprom::{self, PowerOn};
use schema::{Failure, Kind};
use serde::Serialize;

use super::arguments::{
    byte, bytes, configuration, configuration_keys, hundredths, outcome, password, raw, refuse, span, spans,
    unit, word,
};

/// Options of `telegram encode`.
#[derive(Clone, Debug, Default)]
pub struct EncodeOptions {
    /// Name and values.
    pub words: Vec<String>,
    /// The sensor's own address; 0 is all sensors.
    pub address: u8,
    /// Status byte of a reply, as `0x10`; without it that of a healthy sensor.
    pub status: Option<String>,
    /// The bytes themselves.
    pub raw: bool,
    /// One JSON object.
    pub json: bool,
}

/// Writes the telegram that the options name.
///
/// [`Kind::Configuration`] if the name or a value is not valid, with what is.
pub fn encode(options: &EncodeOptions, out: &mut dyn Write) -> Result<(), Failure> {
    if options.address > 0x7F {
        return Err(refuse(format!("address {}", options.address), "0 for all sensors, or 1 to 127"));
    }
    let words: Vec<&str> = options.words.iter().map(String::as_str).collect();
    let encoded = match (&words[..], &options.status) {
        (["reply", words @ ..], status) => {
            let status = status.as_deref().map_or(Ok(Condition::OK.0), byte)?;
            answer(words, options.address, status)?
        }
        (_, Some(status)) => {
            let message = format!("--status {status} with {:?}", words.join(" "));
            return Err(refuse(message, "only a reply has a status byte"));
        }
        (_, None) => request(&words, options.address)?,
    };
    let hex: Vec<_> = encoded.bytes().iter().map(|byte| format!("{byte:02X}")).collect();
    let written = match (options.json, options.raw) {
        (true, _) => {
            let telegram = encoded.telegram();
            let line = Line {
                class: "encoded",
                length: encoded.bytes().len(),
                from: if telegram.is_reply() { "sensor" } else { "host" },
                address: telegram.address() & !REPLY,
                command: telegram.command(),
                writes_eeprom: eeprom::Write::decode(telegram).is_some(),
                words: Headline(telegram).to_string(),
                raw: hex.concat().to_lowercase(),
            };
            let line = schema::json_line(serde_json::to_string(&line).unwrap_or_default());
            out.write_all(format!("{line}\n").as_bytes())
        }
        (false, true) => out.write_all(encoded.bytes()),
        (false, false) => out.write_all(format!("{}\n", hex.join(" ")).as_bytes()),
    };
    match written {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::new(Kind::Failed, format!("cannot write: {error}"), ""))
        }
        _ => Ok(()),
    }
}

/// Class `encoded`.
#[derive(Serialize)]
struct Line {
    class: &'static str,
    length: usize,
    from: &'static str,
    address: u8,
    command: u8,
    writes_eeprom: bool,
    words: String,
    raw: String,
}

fn request(words: &[&str], address: u8) -> Result<Encoded, Failure> {
    let operate = Request::Operate;
    let request = match *words {
        ["reset"] => Request::Reset,
        ["stream"] => Request::Stream,
        ["stop"] => Request::Stop,
        ["baud", rate] => Request::Baud(baud(rate)?),
        ["install"] => Request::install(Password::FACTORY),
        ["install", text] => Request::install(password(text)?),
        ["test-password", text] => operate(Operating::TestPassword(password(text)?)),
        ["mode", "stream"] => Request::Stream,
        ["mode", "stop"] => Request::Stop,
        ["mode", "diagnosis"] => operate(Operating::Diagnosis),
        ["mode", "segments"] => operate(Operating::SegmentMinimum),
        ["mode", "segments-on-object"] => operate(Operating::SegmentMinimumOnObject),
        ["mode", "vertical"] => operate(Operating::VerticalMinimum),
        ["mode", "vertical-on-object"] => operate(Operating::VerticalMinimumOnObject),
        ["mode", "means", n] => operate(Operating::Means(byte(n)?)),
        ["mode", "range", first, last] => operate(Operating::Range(span(first, last)?)),
        ["mode", "range-means", n, first, last] => {
            operate(Operating::RangeMeans(byte(n)?, span(first, last)?))
        }
        ["mode", "range-fields", first, last] => operate(Operating::RangeFields(span(first, last)?)),
        ["mode", "partial"] => operate(Operating::Partial),
        ["mode", "reflectivities", ref pairs @ ..] => operate(Operating::Reflectivities(spans(pairs)?)),
        ["mode", "range-segments", ref hex @ ..] => operate(Operating::SegmentMinimumOfRange(raw(hex)?)),
        ["mode", "navigation"] => operate(Operating::Navigation),
        ["mode", "reflectivity", first, last] => operate(Operating::Reflectivity(span(first, last)?)),
        ["values"] => Request::Values(1),
        ["values", selection] => Request::Values(byte(selection)?),
        ["status"] => Request::Status,
        ["errors"] => Request::Errors,
        ["counters"] => Request::Counters,
        ["means", n] => Request::Means(byte(n)?),
        ["range", first, last] => Request::Range(span(first, last)?),
        ["type"] => Request::Type,
        ["variant", angle, step] => Request::Variant(variant(angle, step)?),
        ["range-fields", first, last] => Request::RangeFields(span(first, last)?),
        ["range-means", n, first, last] => Request::RangeMeans(byte(n)?, span(first, last)?),
        ["field-set", ref hex @ ..] => Request::FieldSet(raw(hex)?),
        ["reflectivity", first, last] => Request::Reflectivity(span(first, last)?),
        ["field", ref hex @ ..] => Request::Field(raw(hex)?),
        ["outputs"] => Request::Outputs,
        ["positioning"] => Request::Positioning,
        ["configuration"] => Request::Configuration,
        ["reflectivities", ref pairs @ ..] => Request::Reflectivities(spans(pairs)?),
        ["cartesian", first, last] => Request::Cartesian(span(first, last)?),
        ["configuration2"] => Request::Configuration2,
        _ => return write(words, address),
    };
    Ok(request.encode(address))
}

/// Requests that write the EEPROM.
fn write(words: &[&str], address: u8) -> Result<Encoded, Failure> {
    let data = match *words {
        ["write-field" | "write-password" | "teach" | "configuration2", ref hex @ ..] => bytes(hex)?,
        ["configuration", ref settings @ ..] => configuration(settings)?.to_vec(),
        _ => Vec::new(),
    };
    let write = match *words {
        ["configuration", ..] => eeprom::Write::Configuration(&data),
        ["configuration2", ..] => eeprom::Write::Configuration2(&data),
        ["power-on", "9600"] => eeprom::Write::PowerOn(PowerOn::Baud9600),
        ["power-on", "keep"] => eeprom::Write::PowerOn(PowerOn::KeepBaud),
        ["power-on", "type"] => eeprom::Write::PowerOn(PowerOn::KeepType),
        ["write-field", ..] => eeprom::Write::Field(&data),
        ["write-password", ..] => eeprom::Write::Password(&data),
        ["teach", ..] => eeprom::Write::Teach(&data),
        _ => return Err(unknown(words, "")),
    };
    write
        .encode(address)
        .ok_or_else(|| refuse(format!("{} bytes for {}", data.len(), words[0]), "it takes fewer"))
}

fn answer(words: &[&str], address: u8, status: u8) -> Result<Encoded, Failure> {
    let mut data = Vec::new();
    let reply = match *words {
        ["power-on", name] => Reply::PowerOn(name.as_bytes()),
        ["reset"] => Reply::Reset,
        ["refused"] => Reply::Refused,
        ["mode", done] => Reply::Mode { done: outcome(done)? },
        ["values", unit_name, ref ranges @ ..] => {
            let ranges = ranges.iter().map(|range| word(range)).collect::<Result<Vec<_>, _>>()?;
            if !(1..=MAX_BEAMS).contains(&ranges.len()) {
                return Err(refuse(format!("{} values", ranges.len()), format!("1 to {MAX_BEAMS}")));
            }
            return Ok(measured::encode(address, unit(unit_name)?, &ranges, status));
        }
        ["status"] => {
            let health = Health {
                software: *b"V02.30 ",
                operating_mode: lms::operating::ON_REQUEST,
                mode: Mode(0),
                variant: Variant::HALF,
                unit: Unit::Mm,
                baud: Baud::B9600,
            };
            return Ok(reply::status(address, &health, status));
        }
        ["errors", ref pairs @ ..] => {
            for pair in pairs {
                let (kind, number) = pair
                    .split_once(':')
                    .ok_or_else(|| refuse(format!("error {pair:?}"), "TYPE:NUMBER, such as 0x84:22"))?;
                data.extend([byte(kind)?, byte(number)?]);
            }
            Reply::Errors(Errors::new(&data).ok_or_else(|| unknown(words, "reply "))?)
        }
        ["counters", hours, power_ons] => {
            Reply::Counters { hours_by_2: word(hours)? / 2, power_ons: word(power_ons)? }
        }
        ["type", name] => Reply::Type(name.as_bytes()),
        ["variant", done, angle, step] => {
            let Variant { angle_deg, resolution_cdeg } = variant(angle, step)?;
            Reply::Variant { done: outcome(done)?, angle_deg, resolution_cdeg }
        }
        ["configuration", ref settings @ ..] => {
            data.extend(configuration(settings)?);
            Reply::Configuration(Configuration::new(&data).ok_or_else(|| unknown(words, "reply "))?)
        }
        ["configuration-written", done, ref settings @ ..] => {
            data.extend(configuration(settings)?);
            let configuration = Configuration::new(&data).ok_or_else(|| unknown(words, "reply "))?;
            Reply::ConfigurationWritten { done: outcome(done)?, configuration }
        }
        ["power-on-set", result, set] => Reply::PowerOnSet { outcome: byte(result)?, set: byte(set)? },
        _ => return Err(unknown(words, "reply ")),
    };
    reply.encode(address, status).ok_or_else(|| refuse("longer than a telegram may be", "at most 808 bytes"))
}

fn baud(rate: &str) -> Result<Baud, Failure> {
    let known = rate.parse().ok().and_then(Baud::of_rate);
    known.ok_or_else(|| refuse(format!("rate {rate:?}"), "9600, 19200, 38400 or 500000"))
}

fn variant(angle: &str, step: &str) -> Result<Variant, Failure> {
    Variant::new(word(angle)?, hundredths(step)?).ok_or_else(|| {
        let remedy = "180 degrees at 0.5 or 1, 100 degrees at 0.25, 0.5 or 1";
        refuse(format!("no sensor scans {angle} degrees at {step}"), remedy)
    })
}

/// The name is none, or has other values.
fn unknown(words: &[&str], prefix: &str) -> Failure {
    let Some((name, values)) = words.split_first() else {
        return refuse(format!("no name of a {prefix}telegram"), "scanhub telegram encode --help lists them");
    };
    let full = format!("{prefix}{name}");
    let takes: Vec<_> = NAMES
        .iter()
        .filter(|(known, ..)| known.split(' ').take(full.split(' ').count()).eq(full.split(' ')))
        .collect();
    if takes.is_empty() {
        let names = NAMES.iter().map(|(known, ..)| *known);
        let near =
            names.max_by(|a, b| strsim::jaro_winkler(a, &full).total_cmp(&strsim::jaro_winkler(b, &full)));
        let hint =
            format!("did you mean {:?}? scanhub telegram encode --help lists all", near.unwrap_or_default());
        return refuse(format!("unknown telegram {full:?}"), hint);
    }
    let forms: Vec<_> =
        takes.iter().map(|(name, values, _)| format!("{name} {values}").trim_end().to_owned()).collect();
    refuse(format!("{full} with {:?}", values.join(" ")), format!("it is: {}", forms.join(", or ")))
}

/// All names with their values, for the help.
pub fn names() -> String {
    let rows =
        NAMES.iter().map(|(name, values, meaning)| format!("  {:<46} {meaning}", format!("{name} {values}")));
    format!(
        "Telegrams:\n{}\n\nKeys of a configuration: {}",
        rows.collect::<Vec<_>>().join("\n"),
        configuration_keys().join(", ")
    )
}

/// Name, values, meaning.
const NAMES: &[(&str, &str, &str)] = &[
    ("reset", "", "restart, clear the fault memory"),
    ("stream", "", "all values, continuously"),
    ("stop", "", "values on request only"),
    ("baud", "RATE", "9600, 19200, 38400 or 500000"),
    ("install", "[PASSWORD]", "installation mode"),
    ("test-password", "PASSWORD", "check a password"),
    ("mode stream", "", "as stream"),
    ("mode stop", "", "as stop"),
    ("mode diagnosis", "", "diagnosis"),
    ("mode segments", "", "least value of each segment"),
    ("mode segments-on-object", "", "the same, on an object"),
    ("mode vertical", "", "least vertical distance"),
    ("mode vertical-on-object", "", "the same, on an object"),
    ("mode means", "N", "means of N scans"),
    ("mode range", "FIRST LAST", "a sub-range"),
    ("mode range-means", "N FIRST LAST", "means of a sub-range"),
    ("mode range-fields", "FIRST LAST", "a sub-range with fields"),
    ("mode partial", "", "partial scans, at once"),
    ("mode reflectivities", "FIRST LAST ..", "ranges and reflectivities of 1 to 5 sub-ranges"),
    ("mode range-segments", "HEX ..", "least value of each segment in a sub-range"),
    ("mode navigation", "", "records for navigation"),
    ("mode reflectivity", "FIRST LAST", "as reflectivity, continuously (S14)"),
    ("values", "[SELECTION]", "one scan; 1 all, 2 vertical, 3 taught, 6 every 2nd, 7 every 20th, 8 partial"),
    ("status", "", "status"),
    ("errors", "", "errors"),
    ("counters", "", "hours and power-ons (LMS 211, 221, 291)"),
    ("means", "N", "means of N scans, once"),
    ("range", "FIRST LAST", "a sub-range, once"),
    ("type", "", "type and firmware"),
    ("variant", "ANGLE STEP", "such as 180 0.5"),
    ("range-fields", "FIRST LAST", "a sub-range with fields, once"),
    ("range-means", "N FIRST LAST", "means of a sub-range, once"),
    ("field-set", "HEX ..", "switch the field set"),
    ("reflectivity", "FIRST LAST", "ranges, and reflectivity of a sub-range (S14)"),
    ("field", "HEX ..", "read a field"),
    ("outputs", "", "state of the field outputs"),
    ("positioning", "", "positioning aid"),
    ("configuration", "", "read part 1 of the configuration"),
    ("reflectivities", "FIRST LAST ..", "ranges and reflectivities of 1 to 5 sub-ranges, once"),
    ("cartesian", "FIRST LAST", "Cartesian coordinates"),
    ("configuration2", "", "read part 2 of the configuration"),
    ("configuration", "KEY=VALUE ..", "EEPROM: write part 1; keys not named get the factory value"),
    ("configuration2", "HEX ..", "EEPROM: write part 2"),
    ("power-on", "9600|keep|type", "EEPROM: rate after power-on"),
    ("write-field", "HEX ..", "EEPROM: write a field"),
    ("write-password", "HEX ..", "EEPROM: change the password"),
    ("teach", "HEX ..", "EEPROM: teach a field"),
    ("reply power-on", "NAME", "sent by a sensor after power-on"),
    ("reply reset", "", "the reset starts"),
    ("reply refused", "", "impossible, or not now"),
    ("reply mode", "ok|refused", "operating mode changed"),
    ("reply values", "mm|cm|dm WORD ..", "1 to 401 values"),
    ("reply status", "", "a healthy sensor"),
    ("reply errors", "[TYPE:NUMBER ..]", "such as 0x84:22"),
    ("reply counters", "HOURS POWER-ONS", "of operation"),
    ("reply type", "NAME", "such as LMS200;301063;V02.30"),
    ("reply variant", "ok|refused ANGLE STEP", "the variant in use"),
    ("reply configuration", "[KEY=VALUE ..]", "part 1"),
    ("reply configuration-written", "ok|refused [KEY=VALUE ..]", "part 1, and the result"),
    ("reply power-on-set", "BYTE BYTE", "result, and the rate set"),
];
