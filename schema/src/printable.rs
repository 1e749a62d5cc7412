//! Text of any origin for a terminal: names and errors may come from another machine, and must not move the cursor or
//! change colours. Every line is written through this. Refuses to know which text is our own.

use std::fmt::{self, Write};

/// Shows control characters (C0, DEL and C1 of ECMA-48) as `?`, but for the ends of lines.
#[derive(Clone, Copy, Debug)]
pub struct Printable<'a>(pub &'a str);

impl fmt::Display for Printable<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.chars().try_for_each(|c| f.write_char(if c.is_control() && c != '\n' { '?' } else { c }))
    }
}

/// Replaces control characters that JSON allows but a terminal would obey, DEL and C1, by `\u` and four digits, which has
/// the same meaning in JSON. C0 is always written like this.
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

/// Returns `line` of JSON with [`escape_json`].
pub fn json_line(line: String) -> String {
    let mut line = line.into_bytes();
    escape_json(&mut line);
    String::from_utf8(line).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Failure, Kind};

    #[test]
    fn a_terminal_gets_text_alone() {
        let text = "é \x1b[2J\x07\u{9b}31m\r\x7f,\n  ok";
        assert_eq!(Printable(text).to_string(), "é ?[2J??31m??,\n  ok");
        let failure = Failure::new(Kind::Failed, "no \x1b]0;x\x07", "try \u{9d}y");
        assert_eq!(failure.to_string(), "no ?]0;x?\n  try ?y");
    }

    #[test]
    fn a_line_of_json_says_the_same_without_control_characters() {
        let text = "é\u{80}\x1b \u{9f}\x7f\u{a0}\u{9b}\u{9b}°\n";
        let line = json_line(serde_json::to_string(text).unwrap());
        assert_eq!(line, "\"é\\u0080\\u001b \\u009f\\u007f\u{a0}\\u009b\\u009b°\\n\"");
        assert_eq!(serde_json::from_str::<String>(&line).unwrap(), text);
    }
}
