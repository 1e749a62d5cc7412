//! The words after a telegram's name as values; each refusal names what would be valid. Knows no telegrams.

use lms::configuration::{ITEMS, LEN, factory};
use lms::parameters::{Password, Raw, Span, Spans};
use lms::variant::{Mode, Unit};
use schema::{Failure, Kind};

/// What cannot be, and what could.
pub(super) fn refuse(message: impl Into<String>, hint: impl Into<String>) -> Failure {
    Failure::new(Kind::Configuration, message, hint)
}

/// `1`, `0x0F` or `0Fh`.
pub(super) fn byte(text: &str) -> Result<u8, Failure> {
    number(text)?
        .try_into()
        .map_err(|_| refuse(format!("{text} is more than a byte"), "0 to 255, or 0x00 to 0xFF"))
}

/// The same for a word.
pub(super) fn word(text: &str) -> Result<u16, Failure> {
    number(text)?
        .try_into()
        .map_err(|_| refuse(format!("{text} is more than a word"), "0 to 65535, or 0x0000 to 0xFFFF"))
}

fn number(text: &str) -> Result<u32, Failure> {
    let hex = text.strip_prefix("0x").or(text.strip_prefix("0X")).or(text.strip_suffix(['h', 'H']));
    let digits = hex.unwrap_or(text);
    let parsed = u32::from_str_radix(digits, if hex.is_some() { 16 } else { 10 }).ok();
    parsed
        .filter(|_| digits.chars().all(|c| c.is_ascii_hexdigit()))
        .ok_or_else(|| refuse(format!("{text:?} is no number"), "write 31, 0x1F or 1Fh"))
}

/// Degrees as hundredths.
pub(super) fn hundredths(text: &str) -> Result<u16, Failure> {
    let degrees = text.parse::<f64>().ok().filter(|degrees| (0.0..=360.0).contains(degrees));
    let hundredths = degrees.map(|degrees| (degrees * 100.0).round());
    hundredths
        .filter(|hundredths| Some(hundredths / 100.0) == degrees)
        .map(|hundredths| hundredths as u16)
        .ok_or_else(|| refuse(format!("{text:?} are no degrees"), "0.25, 0.5 or 1"))
}

/// A pair of words.
pub(super) fn span(first: &str, last: &str) -> Result<Span, Failure> {
    Ok(Span { first: word(first)?, last: word(last)? })
}

/// One to five pairs of words.
pub(super) fn spans(words: &[&str]) -> Result<Spans, Failure> {
    let pairs: Vec<Span> = words
        .chunks(2)
        .map(|pair| span(pair[0], pair.get(1).copied().unwrap_or_default()))
        .collect::<Result<_, _>>()?;
    Spans::new(&pairs)
        .ok_or_else(|| refuse(format!("{} sub-ranges", pairs.len()), "one to five: FIRST LAST FIRST LAST .."))
}

/// Eight characters.
pub(super) fn password(text: &str) -> Result<Password, Failure> {
    text.as_bytes().try_into().map(Password).map_err(|_| {
        refuse(format!("the password {text:?} has {} characters", text.len()), "8, such as SICK_LMS")
    })
}

/// Hexadecimal, as `telegram decode` reads it; at least one byte.
pub(super) fn bytes(words: &[&str]) -> Result<Vec<u8>, Failure> {
    let parsed = super::input::parse(&words.join(" ")).ok().filter(|bytes| !bytes.is_empty());
    parsed.ok_or_else(|| {
        refuse(format!("{:?} are no bytes", words.join(" ")), "pairs of digits, as 02 80 or 0280")
    })
}

/// The same, as parameters of a request.
pub(super) fn raw(words: &[&str]) -> Result<Raw, Failure> {
    let bytes = bytes(words)?;
    Raw::new(&bytes).ok_or_else(|| refuse(format!("{} bytes", bytes.len()), format!("at most {}", Raw::MAX)))
}

/// `ok` or `refused`.
pub(super) fn outcome(text: &str) -> Result<bool, Failure> {
    match text {
        "ok" => Ok(true),
        "refused" => Ok(false),
        _ => Err(refuse(format!("outcome {text:?}"), "ok or refused")),
    }
}

/// `mm`, `cm` or `dm`.
pub(super) fn unit(text: &str) -> Result<Unit, Failure> {
    match text {
        "mm" => Ok(Unit::Mm),
        "cm" => Ok(Unit::Cm),
        "dm" => Ok(Unit::Dm),
        _ => Err(refuse(format!("unit {text:?}"), "mm, cm or dm")),
    }
}

/// A factory-new configuration with the values that `KEY=VALUE` say.
pub(super) fn configuration(words: &[&str]) -> Result<[u8; LEN], Failure> {
    let mut bytes = factory(Mode(0), Unit::Mm);
    for setting in words {
        let known = || configuration_keys().join(", ");
        let (key, value) =
            setting.split_once('=').ok_or_else(|| refuse(format!("{setting:?} is no KEY=VALUE"), known()))?;
        let item = ITEMS.iter().find(|item| key_of(item.name) == key);
        let item = item.ok_or_else(|| refuse(format!("unknown key {key:?}"), known()))?;
        let value = match unit(value) {
            Ok(unit) if key == "unit" => unit.code().into(),
            _ if item.len == 1 => byte(value)?.into(),
            _ => word(value)?,
        };
        bytes[item.at..item.at + item.len].copy_from_slice(&value.to_le_bytes()[..item.len]);
    }
    Ok(bytes)
}

/// All keys of a configuration.
pub(super) fn configuration_keys() -> Vec<String> {
    ITEMS.iter().map(|item| key_of(item.name)).collect()
}

fn key_of(name: &str) -> String {
    match name {
        "measuring mode" => "mode".into(),
        "peak threshold or sensitivity" => "sensitivity".into(),
        _ => name.to_lowercase().replace(' ', "_"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_and_what_is_none() {
        assert_eq!((byte("31").unwrap(), byte("0x1f").unwrap(), byte("1Fh").unwrap()), (31, 31, 31));
        assert_eq!((hundredths("0.25").unwrap(), hundredths("1").unwrap()), (25, 100));
        for failure in [
            byte("256").unwrap_err(),
            byte("+1").unwrap_err(),
            byte("").unwrap_err(),
            word("65536").unwrap_err(),
            hundredths("0.251").unwrap_err(),
            spans(&["1"]).unwrap_err(),
            spans(&["1"; 12]).unwrap_err(),
            password("SICK").unwrap_err(),
            raw(&["00"; 17]).unwrap_err(),
            configuration(&["unit"]).unwrap_err(),
            configuration(&["units=mm"]).unwrap_err(),
            configuration(&["unit=m"]).unwrap_err(),
        ] {
            assert!(failure.kind == Kind::Configuration && !failure.hint.is_empty(), "{failure}");
        }
    }

    #[test]
    fn a_configuration_by_its_keys() {
        let bytes = configuration(&["unit=cm", "mode=0x04", "blanking=300", "contour_a_start=7"]).unwrap();
        assert_eq!((bytes[6], bytes[5], bytes[0], bytes[1], bytes[16], bytes[9]), (0, 4, 0x2C, 1, 7, 2));
        let mut keys = configuration_keys();
        keys.sort();
        keys.dedup();
        assert_eq!(keys.len(), ITEMS.len());
    }
}
