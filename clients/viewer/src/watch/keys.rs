//! Reads keys and the mouse from the terminal without waiting, and distinguishes a closed terminal from one where nobody types.
//! Refuses to know what a key means.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, ErrorKind, IsTerminal, Read};
use std::os::fd::AsFd;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

/// A key, or what the mouse did, that means something here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Key {
    /// A printable character of ASCII, also with Alt.
    Sign(char),
    Tab,
    Escape,
    Up,
    Down,
    Right,
    Left,
    /// Ctrl-C, which is a byte in raw mode.
    Interrupt,
    /// The mouse's left button is down at this column and row, from 0 on.
    Point(u16, u16),
    /// Its wheel was turned there, away from the person.
    WheelUp(u16, u16),
    /// The other way.
    WheelDown(u16, u16),
}

/// Makes a terminal that has a mouse tell where its buttons are pressed and dragged (xterm's mode 1002), in the form that has no
/// largest column (1006).
pub(crate) const MOUSE_ON: &str = "\x1b[?1002h\x1b[?1006h";
/// Gives the mouse back.
pub(crate) const MOUSE_OFF: &str = "\x1b[?1006l\x1b[?1002l";

/// The keys of the terminal that stdin is, or else of the one that the process belongs to.
pub(crate) struct Keys {
    terminal: File,
    typed: VecDeque<u8>,
}

impl Keys {
    /// An error if there is no terminal.
    pub(crate) fn open() -> io::Result<Keys> {
        let stdin = io::stdin();
        let terminal = match stdin.is_terminal() {
            true => stdin.as_fd().try_clone_to_owned()?.into(),
            false => File::open("/dev/tty")?,
        };
        Ok(Keys { terminal, typed: VecDeque::new() })
    }

    /// The next key that was pressed, if one was.
    ///
    /// [`ErrorKind::UnexpectedEof`] if the terminal was closed.
    pub(crate) fn next(&mut self) -> io::Result<Option<Key>> {
        let mut key = next(&mut self.typed);
        if key.is_none() {
            let mut fds = [PollFd::new(&self.terminal, PollFlags::IN)];
            // The caller handles a signal that came during the read.
            let is_there = poll(&mut fds, Some(&Timespec::default())).is_ok_and(|count| count > 0);
            if is_there {
                let mut piece = [0; 256];
                match self.terminal.read(&mut piece) {
                    Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
                    Ok(len) => self.typed.extend(&piece[..len]),
                    Err(error) if error.kind() == ErrorKind::Interrupted => {}
                    Err(error) => return Err(error),
                }
                key = next(&mut self.typed);
            }
        }
        Ok(key)
    }
}

/// The first key in `typed`; what means nothing is passed over (ECMA-48, xterm), and a sequence whose end is missing waits for
/// that: it may come with the next piece.
fn next(typed: &mut VecDeque<u8>) -> Option<Key> {
    while let Some(&byte) = typed.front() {
        let key = match byte {
            0x03 => Some(Key::Interrupt),
            b'\t' => Some(Key::Tab),
            ESC => match typed.get(1) {
                None | Some(&ESC) => Some(Key::Escape),
                Some(b'[' | b'O') => {
                    let parameters = typed.iter().skip(2).take_while(|byte| (b' '..=b'?').contains(byte));
                    let length = 2 + parameters.count();
                    if length >= typed.len() && length < LONGEST {
                        return None;
                    }
                    let sequence: Vec<u8> = typed.drain(..length.min(typed.len())).collect();
                    typed.front().and_then(|last| meaning(&sequence[2..], *last))
                }
                // What follows was pressed with Alt.
                Some(_) => None,
            },
            b' '..=b'~' => Some(Key::Sign(byte.into())),
            _ => None,
        };
        // The last of a sequence, or all of a key.
        typed.pop_front();
        if key.is_some() {
            return key;
        }
    }
    None
}

/// What a sequence with these parameters and this end means: an arrow, or the mouse.
fn meaning(parameters: &[u8], last: u8) -> Option<Key> {
    match last {
        b'A' => Some(Key::Up),
        b'B' => Some(Key::Down),
        b'C' => Some(Key::Right),
        b'D' => Some(Key::Left),
        b'M' => mouse(parameters.strip_prefix(b"<")?),
        _ => None,
    }
}

/// What the mouse did: `BUTTON;COLUMN;ROW`, from 1 on.
fn mouse(parameters: &[u8]) -> Option<Key> {
    let text = std::str::from_utf8(parameters).ok()?;
    let numbers: Vec<u16> = text.split(';').filter_map(|number| number.parse().ok()).collect();
    let [button, column, row] = numbers[..] else { return None };
    let (column, row) = (column.checked_sub(1)?, row.checked_sub(1)?);
    match button & !MODIFIERS {
        0 | DRAGGED => Some(Key::Point(column, row)),
        WHEEL => Some(Key::WheelUp(column, row)),
        WHEEL_DOWN => Some(Key::WheelDown(column, row)),
        _ => None,
    }
}

const ESC: u8 = 0x1b;
/// A sequence that is longer is none.
const LONGEST: usize = 32;
/// Of the mouse's button: Shift, Alt and Ctrl; moved while it was down; the wheel.
const MODIFIERS: u16 = 0b1_1100;
const DRAGGED: u16 = 32;
const WHEEL: u16 = 64;
const WHEEL_DOWN: u16 = 65;

#[cfg(test)]
mod tests {
    use super::*;

    fn keys(typed: &str) -> Vec<Key> {
        let mut typed: VecDeque<u8> = typed.bytes().collect();
        std::iter::from_fn(|| next(&mut typed)).collect()
    }

    #[test]
    fn keys_of_a_terminal() {
        assert_eq!(
            keys("q? \t\x03"),
            [Key::Sign('q'), Key::Sign('?'), Key::Sign(' '), Key::Tab, Key::Interrupt]
        );
        let arrows = [Key::Up, Key::Down, Key::Right, Key::Left];
        assert_eq!(keys("\x1b[A\x1b[B\x1b[C\x1b[D"), arrows);
        assert_eq!(keys("\x1bOA\x1bOB\x1bOC\x1bOD"), arrows);
        assert_eq!(keys("\x1b[1;5A"), [Key::Up], "with Ctrl");
        assert_eq!(keys("\x1b"), [Key::Escape]);
        assert_eq!(keys("\x1b\x1b[A"), [Key::Escape, Key::Up]);
        assert_eq!(keys("\x1bq"), [Key::Sign('q')], "with Alt");
    }

    #[test]
    fn what_means_nothing_is_passed_over() {
        assert_eq!(keys("\x1b[15~\x1b[5~\x1b[<0;10;20m\x01\r\nm"), [Key::Sign('m')]);
        assert_eq!(
            keys("\x1b[M !!\x1b[<0;0;1M\x1b[<0;1M\x1b[<2;5;5M\x1b[<0;99999;1M"),
            [Key::Sign(' '), Key::Sign('!'), Key::Sign('!')]
        );
        let endless = "1".repeat(LONGEST);
        assert_eq!(keys(&format!("\x1b[{endless}")), [], "it does not wait for ever");
        assert_eq!(keys("ä€q"), [Key::Sign('q')]);
        assert_eq!(keys("\x1b[1;"), []);
    }

    #[test]
    fn the_mouse_says_where() {
        assert_eq!(
            keys("\x1b[<0;10;20M\x1b[<32;11;20M\x1b[<0;11;20m"),
            [Key::Point(9, 19), Key::Point(10, 19)]
        );
        assert_eq!(keys("\x1b[<64;300;1M\x1b[<81;1;1M"), [Key::WheelUp(299, 0), Key::WheelDown(0, 0)]);
    }

    #[test]
    fn a_sequence_in_two_pieces_is_one() {
        let whole = "\x1b[<0;10;20Mq";
        for cut in 2..whole.len() {
            let mut typed = VecDeque::new();
            let mut told = Vec::new();
            for piece in [&whole[..cut], &whole[cut..]] {
                typed.extend(piece.bytes());
                told.extend(std::iter::from_fn(|| next(&mut typed)));
            }
            assert_eq!(told, [Key::Point(9, 19), Key::Sign('q')], "{cut}");
        }
    }
}
