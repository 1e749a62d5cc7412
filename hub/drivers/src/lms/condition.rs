//! The status byte that ends every reply: how the sensor is, in bits and in words (Telegram listing 8). One and the
//! same sensor sends 10h on one day and 11h on the next, so nothing but its bits says anything.

use core::fmt;

/// A status byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Condition(pub u8);

impl Condition {
    /// A healthy LMS type 6.
    pub const OK: Condition = Condition(0x10);

    /// How bad it is; `None` for codes without a meaning.
    pub fn severity(self) -> Option<Severity> {
        Severity::of_code(self.0 & 7)
    }

    /// Whether the sensor calls itself an LMS type 6; else it is another or a special device.
    pub fn is_type_6(self) -> bool {
        self.0 >> 3 & 3 == 0b10
    }

    /// Whether the restart input is high.
    pub fn restart_input(self) -> bool {
        self.0 & 0x20 != 0
    }

    /// Whether the sensor finds its own values implausible.
    pub fn is_implausible(self) -> bool {
        self.0 & 0x40 != 0
    }

    /// Whether the window is dirty.
    pub fn is_polluted(self) -> bool {
        self.0 & 0x80 != 0
    }
}

impl fmt::Display for Condition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.severity() {
            Some(severity) => f.write_str(severity.name())?,
            None => write!(f, "severity {}", self.0 & 7)?,
        }
        let flags = [
            (!self.is_type_6(), "no LMS of type 6"),
            (self.restart_input(), "restart input high"),
            (self.is_implausible(), "implausible values"),
            (self.is_polluted(), "window polluted"),
        ];
        for (_, words) in flags.iter().filter(|(is_set, _)| *is_set) {
            write!(f, ", {words}")?;
        }
        Ok(())
    }
}

/// How bad a condition or an error is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Nothing to say.
    Ok,
    /// For information.
    Info,
    /// The sensor works, for now.
    Warning,
    /// It does not work right.
    Error,
    /// It does not work.
    Fatal,
}

impl Severity {
    /// The severity of code 0 to 4.
    pub fn of_code(code: u8) -> Option<Severity> {
        [Severity::Ok, Severity::Info, Severity::Warning, Severity::Error, Severity::Fatal]
            .get(usize::from(code))
            .copied()
    }

    /// Its code.
    pub fn code(self) -> u8 {
        self as u8
    }

    /// In a word.
    pub fn name(self) -> &'static str {
        match self {
            Severity::Ok => "ok",
            Severity::Info => "info",
            Severity::Warning => "warning",
            Severity::Error => "error",
            Severity::Fatal => "fatal",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::string::ToString;

    #[test]
    fn every_bit_has_its_word() {
        for (byte, words) in [
            (0x10, "ok"),
            (0x11, "info"),
            (0x92, "warning, window polluted"),
            (0x53, "error, implausible values"),
            (0x34, "fatal, restart input high"),
            (0x18, "ok, no LMS of type 6"),
            (0x15, "severity 5"),
        ] {
            assert_eq!(Condition(byte).to_string(), words);
        }
        assert!((0..5).all(|code| Severity::of_code(code).unwrap().code() == code));
    }
}
