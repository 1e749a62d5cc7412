//! Reads keys from the terminal without waiting, and distinguishes a closed terminal from one where nobody types.
//! Refuses to know what a key means.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, ErrorKind, IsTerminal, Read};
use std::os::fd::AsFd;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

/// A key that means something here.
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
}

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
        if self.typed.is_empty() {
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
            }
        }
        Ok(next(&mut self.typed))
    }
}

/// The first key in `typed`, which is what came at once; what means nothing is passed over (ECMA-48, xterm).
fn next(typed: &mut VecDeque<u8>) -> Option<Key> {
    while let Some(byte) = typed.pop_front() {
        let key = match byte {
            0x03 => Some(Key::Interrupt),
            b'\t' => Some(Key::Tab),
            ESC => match typed.front() {
                None | Some(&ESC) => Some(Key::Escape),
                Some(b'[' | b'O') => sequence(typed),
                // What follows was pressed with Alt.
                Some(_) => None,
            },
            b' '..=b'~' => Some(Key::Sign(byte.into())),
            _ => None,
        };
        if key.is_some() {
            return key;
        }
    }
    None
}

/// The key whose sequence goes on in `typed`; of all of them only the arrows mean something.
fn sequence(typed: &mut VecDeque<u8>) -> Option<Key> {
    typed.pop_front();
    let last = loop {
        match typed.pop_front()? {
            b' '..=b'?' => {}
            last => break last,
        }
    };
    match last {
        b'A' => Some(Key::Up),
        b'B' => Some(Key::Down),
        b'C' => Some(Key::Right),
        b'D' => Some(Key::Left),
        _ => None,
    }
}

const ESC: u8 = 0x1b;

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
        assert_eq!(keys("\x1b[15~\x1b[5~\x1b[<0;10;20M\x01\r\nm"), [Key::Sign('m')]);
        assert_eq!(keys("ä€q"), [Key::Sign('q')]);
        assert_eq!(keys("\x1b[1;"), []);
    }
}
