//! Text of whatever origin for a terminal: names and errors may come from another machine, and must not move its cursor
//! or change its colours. Refuses to know what is text of ours.

use std::fmt::{self, Write};

/// Shows control characters (C0, DEL and C1 of ECMA-48) as `?`, but for the ends of lines.
#[derive(Clone, Copy, Debug)]
pub struct Printable<'a>(pub &'a str);

impl fmt::Display for Printable<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.chars().try_for_each(|c| f.write_char(if c.is_control() && c != '\n' { '?' } else { c }))
    }
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
}
