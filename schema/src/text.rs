//! Text in fixed-size fields of payloads, text for a terminal, and failures as users see them.
//!
//! A field has UTF-8, padded with 0. A text that is too long for its field is cut at a character boundary. Names and
//! errors may come from another machine, and must not move the cursor of a terminal or change its colors. All output is
//! written through [`Printable`] or [`escape_json`].

use std::fmt::{self, Write};

/// Writes `text` into `field` and clears the rest.
pub(crate) fn write(field: &mut [u8], text: &str) {
    let mut end = text.len().min(field.len());
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    field[..end].copy_from_slice(&text.as_bytes()[..end]);
    field[end..].fill(0);
}

/// Returns the text in `field`, up to the first 0 or the first byte that is not UTF-8.
pub(crate) fn read(field: &[u8]) -> &str {
    let end = field.iter().position(|&byte| byte == 0).unwrap_or(field.len());
    match str::from_utf8(&field[..end]) {
        Ok(text) => text,
        Err(error) => str::from_utf8(&field[..error.valid_up_to()]).unwrap_or_default(),
    }
}

/// Defines `ALL`, which has the values of an enum in the order of their numbers, and `name`, which returns the name of
/// a value.
macro_rules! named {
    ($type:ident: $($variant:ident $name:literal,)*) => {
        impl $type {
            /// All values, in the order of their numbers.
            pub const ALL: [$type; [$($name),*].len()] = [$($type::$variant),*];

            /// Returns the value's name, which all commands print.
            pub const fn name(self) -> &'static str {
                match self { $($type::$variant => $name,)* }
            }
        }
    };
}

pub(crate) use named;

/// Shows control characters (C0, DEL and C1 of ECMA-48) as `?`, except line feeds.
#[derive(Clone, Copy, Debug)]
pub struct Printable<'a>(pub &'a str);

impl fmt::Display for Printable<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.chars().try_for_each(|c| f.write_char(if c.is_control() && c != '\n' { '?' } else { c }))
    }
}

/// Replaces DEL and C1, which JSON allows but a terminal executes, by `\u` and four digits, which have the same meaning
/// in JSON. C0 is not replaced here, because writers of JSON always escape it.
pub fn escape_json(line: &mut Vec<u8>) {
    let code = |at: usize, line: &[u8]| match line[at] {
        0x7f => Some((1, 0x7f)),
        0xc2 => line.get(at + 1).filter(|byte| (0x80..0xa0).contains(*byte)).map(|&byte| (2, byte)),
        _ => None,
    };
    let mut at = 0;
    while at < line.len() {
        let Some((length, code)) = code(at, line) else {
            at += 1;
            continue;
        };
        let escaped = format!("\\u{code:04x}");
        at += escaped.len();
        line.splice(at - escaped.len()..at - escaped.len() + length, escaped.into_bytes());
    }
}

/// Returns the JSON `line` after [`escape_json`].
pub fn json_line(line: String) -> String {
    let mut line = line.into_bytes();
    escape_json(&mut line);
    String::from_utf8(line).unwrap_or_default()
}

/// Kinds of failure. Each kind has a name for `--json` and an exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Kind {
    /// Something failed that has no kind of its own: exit 1.
    Failed,
    /// Another user owns the domain or a file in it: exit 1. Its name is that of [`Kind::Failed`].
    OtherUser,
    /// The hub has another layout, or another version of the shared memory: exit 1. Its name is that of
    /// [`Kind::Failed`].
    Incompatible,
    /// Another hub holds the domain: exit 1.
    DomainHeld,
    /// Another process publishes under the name: exit 75.
    NameHeld,
    /// The command line has a wrong syntax, a topic that does not exist, or a format that the verb does not support:
    /// exit 2.
    Usage,
    /// No hub runs in the domain: exit 3.
    NoHub,
    /// The hub, or the recording, has no such sensor: exit 3.
    NoTopic,
    /// No sample arrived in time: exit 3.
    Timeout,
    /// The port does not exist: exit 4.
    PortMissing,
    /// This user may not open the port: exit 4.
    PortPermission,
    /// Another process has the port: exit 4.
    PortBusy,
    /// The path is not a serial line: exit 4.
    PortNotTty,
    /// The port does not support the baud rate: exit 4.
    PortRate,
    /// A check failed (telegrams lost, a limit exceeded): exit 5.
    Check,
    /// A file to read is missing, cannot be read, or has the wrong content: exit 66.
    Input,
    /// A file to write exists already, or cannot be created: exit 73.
    Output,
    /// There is too little shared memory, or there are too few descriptors; a later attempt may succeed: exit 75.
    ResourceExhausted,
    /// A value in the configuration, in `--set` or in `--link` is not valid: exit 78.
    Configuration,
    /// The program was interrupted before a run of limited length was complete: exit 130.
    Interrupted,
}

impl Kind {
    /// Returns the value of key `kind` in an `error` line.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Failed | Kind::OtherUser | Kind::Incompatible => "failed",
            Kind::DomainHeld => "domain_held",
            Kind::NameHeld => "name_held",
            Kind::Usage => "usage",
            Kind::NoHub => "no_hub",
            Kind::NoTopic => "no_topic",
            Kind::Timeout => "timeout",
            Kind::PortMissing => "port_missing",
            Kind::PortPermission => "port_permission",
            Kind::PortBusy => "port_busy",
            Kind::PortNotTty => "port_not_tty",
            Kind::PortRate => "port_rate",
            Kind::Check => "check",
            Kind::Input => "input",
            Kind::Output => "output",
            Kind::ResourceExhausted => "short",
            Kind::Configuration => "configuration",
            Kind::Interrupted => "interrupted",
        }
    }

    /// Returns the process's exit code.
    pub fn exit_code(self) -> u8 {
        match self {
            Kind::Failed | Kind::OtherUser | Kind::Incompatible | Kind::DomainHeld => 1,
            Kind::Usage => 2,
            Kind::NoHub | Kind::NoTopic | Kind::Timeout => 3,
            Kind::PortMissing | Kind::PortPermission | Kind::PortBusy | Kind::PortNotTty | Kind::PortRate => {
                4
            }
            Kind::Check => 5,
            Kind::Input => 66,
            Kind::Output => 73,
            Kind::ResourceExhausted | Kind::NameHeld => 75,
            Kind::Configuration => 78,
            Kind::Interrupted => 130,
        }
    }
}

/// A failure with its remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// Kind of the failure.
    pub kind: Kind,
    /// Message that states where the error is, and which value caused it.
    pub message: String,
    /// Remedy; may be empty.
    pub hint: String,
}

impl Failure {
    /// Returns a failure of `kind` with this message, and with `hint` as its remedy.
    pub fn new(kind: Kind, message: impl Into<String>, hint: impl Into<String>) -> Self {
        Failure { kind, message: message.into(), hint: hint.into() }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", Printable(&self.message))?;
        if !self.hint.is_empty() {
            write!(f, "\n  {}", Printable(&self.hint))?;
        }
        Ok(())
    }
}

impl std::error::Error for Failure {}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Failure, Kind};

    #[test]
    fn text_is_cut_at_a_character_boundary() {
        let mut field = [0xAA; 5];
        write(&mut field, "abcdé");
        assert_eq!(field, *b"abcd\0");
        assert_eq!(read(&field), "abcd");
        write(&mut field, "é");
        assert_eq!(read(&field), "é");
        assert_eq!(field[2..], [0; 3]);
    }

    #[test]
    fn text_ends_at_the_first_invalid_byte() {
        assert_eq!(read(b"ab\xFFcd"), "ab");
    }

    #[test]
    fn control_characters_are_replaced_for_a_terminal() {
        let text = "é \x1b[2J\x07\u{9b}31m\r\x7f,\n  ok";
        assert_eq!(Printable(text).to_string(), "é ?[2J??31m??,\n  ok");
        let failure = Failure::new(Kind::Failed, "no \x1b]0;x\x07", "try \u{9d}y");
        assert_eq!(failure.to_string(), "no ?]0;x?\n  try ?y");
    }

    #[test]
    fn json_line_escapes_control_characters() {
        let text = "é\u{80}\x1b \u{9f}\x7f\u{a0}\u{9b}\u{9b}°\n";
        let line = json_line(serde_json::to_string(text).unwrap());
        assert_eq!(line, "\"é\\u0080\\u001b \\u009f\\u007f\u{a0}\\u009b\\u009b°\\n\"");
        assert_eq!(serde_json::from_str::<String>(&line).unwrap(), text);
    }
}
