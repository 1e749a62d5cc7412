//! Terminal of the picture. It is switched to raw mode and the alternate screen at the start, and always restored at
//! the end. Each frame is sent with one write. Keys and the mouse are read without waiting.

use std::cell::Cell;
use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, ErrorKind, IsTerminal, Read, Write};
use std::os::fd::AsFd;
use std::panic::{PanicHookInfo, set_hook, take_hook};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ratatui::Frame;
use ratatui::backend::CrosstermBackend;
use ratatui::crossterm::cursor::{Hide, Show};
use ratatui::crossterm::style::Print;
use ratatui::crossterm::terminal::{
    EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode,
};
use ratatui::crossterm::{execute, queue};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::tcgetwinsize;
use scanhub_schema::{Failure, Kind};
use scanhub_verbs::output::ExitReason;

/// Terminal while the picture is shown. Dropping it restores the terminal.
pub(super) struct Terminal<'a> {
    screen: ratatui::Terminal<CrosstermBackend<FrameBuffer<'a>>>,
    /// Number of bytes of the last frame.
    written: Rc<Cell<usize>>,
    keys: Keys,
    /// Last known number of columns and rows.
    size: Option<(u16, u16)>,
    /// Panic hook that was set before the terminal was taken over.
    hook: Arc<Hook>,
    /// Whether a panic has already restored the terminal.
    is_restored: Arc<AtomicBool>,
}

type Hook = dyn Fn(&PanicHookInfo<'_>) + Sync + Send;

/// Input from the terminal.
pub(super) enum Input {
    /// A key, or the mouse.
    Key(Key),
    /// The size of the terminal has changed.
    Resized,
}

impl<'a> Terminal<'a> {
    /// Takes over the terminal that `out` writes to.
    pub(super) fn new(out: &'a mut dyn Write) -> Result<Terminal<'a>, ExitReason> {
        let written = Rc::new(Cell::new(0));
        let is_restored = Arc::new(AtomicBool::new(false));
        let mut buffer = FrameBuffer {
            out,
            bytes: Vec::new(),
            written: written.clone(),
            is_restored: is_restored.clone(),
        };
        let no_terminal = |error| {
            let message = format!("cannot use the terminal: {error}");
            Failure::new(Kind::Failed, message, "keys are read from stdin or /dev/tty; `ssh -t` provides one")
        };
        let keys = Keys::open().map_err(no_terminal)?;
        enable_raw_mode().map_err(no_terminal)?;
        let taken = execute!(buffer, EnterAlternateScreen, Hide, Print(MOUSE_ON))
            .and_then(|()| ratatui::Terminal::new(CrosstermBackend::new(buffer)));
        let screen = taken.inspect_err(|_| {
            let _ = disable_raw_mode();
        })?;
        let hook: Arc<Hook> = Arc::from(take_hook());
        let (before, restoring) = (hook.clone(), is_restored.clone());
        // Restore the terminal first, because the message of a panic would disappear with the alternate screen.
        set_hook(Box::new(move |info| {
            if !restoring.swap(true, Ordering::Relaxed) {
                let _ = execute!(io::stdout(), Print(MOUSE_OFF), LeaveAlternateScreen, Show);
                let _ = disable_raw_mode();
            }
            before(info);
        }));
        Ok(Terminal { screen, written, keys, size: size(), hook, is_restored })
    }

    /// Draws a frame. Returns its size in bytes.
    pub(super) fn draw(&mut self, picture: impl FnOnce(&mut Frame<'_>)) -> Result<usize, ExitReason> {
        self.written.set(0);
        self.screen.draw(picture).map_err(closed)?;
        Ok(self.written.get())
    }

    /// Returns the next input without waiting.
    pub(super) fn input(&mut self) -> Result<Option<Input>, ExitReason> {
        if hung_up() {
            return Err(ExitReason::ReaderClosed);
        }
        let size = size();
        if std::mem::replace(&mut self.size, size) != size {
            return Ok(Some(Input::Resized));
        }
        Ok(self.keys.next().map_err(closed)?.map(Input::Key))
    }
}

impl Drop for Terminal<'_> {
    fn drop(&mut self) {
        if !self.is_restored.swap(true, Ordering::Relaxed) {
            let backend = self.screen.backend_mut();
            let _ = queue!(backend, Print(MOUSE_OFF), LeaveAlternateScreen, Show)
                .and_then(|()| io::Write::flush(backend));
            let _ = disable_raw_mode();
        }
        // Hooks cannot be changed while a panic unwinds.
        if !std::thread::panicking() {
            let hook = self.hook.clone();
            set_hook(Box::new(move |info| hook(info)));
        }
    }
}

/// Returns columns and rows of the terminal, if it has a size.
fn size() -> Option<(u16, u16)> {
    tcgetwinsize(io::stdout()).ok().map(|size| (size.ws_col, size.ws_row))
}

/// Returns whether the terminal was closed. A signal may be missing in this case, and writes fail only when a frame is
/// drawn.
fn hung_up() -> bool {
    let stdout = io::stdout();
    let mut ends = [PollFd::new(&stdout, PollFlags::empty())];
    let is_polled = poll(&mut ends, Some(&Timespec::default())).is_ok();
    is_polled && ends[0].revents().intersects(PollFlags::HUP | PollFlags::ERR)
}

/// Converts the error of a closed terminal to [`ExitReason::ReaderClosed`].
fn closed(error: io::Error) -> ExitReason {
    const EIO: i32 = 5;
    if error.raw_os_error() == Some(EIO) || error.kind() == ErrorKind::UnexpectedEof {
        return ExitReason::ReaderClosed;
    }
    ExitReason::from(error)
}

/// Buffer that collects the bytes of a frame, and writes them with one call.
struct FrameBuffer<'a> {
    out: &'a mut dyn Write,
    bytes: Vec<u8>,
    written: Rc<Cell<usize>>,
    /// Whether the terminal is restored, so that a failed write does not matter.
    is_restored: Arc<AtomicBool>,
}

impl Write for FrameBuffer<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.bytes.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.written.set(self.written.get() + self.bytes.len());
        let result = self.out.write_all(&self.bytes).and_then(|()| self.out.flush());
        self.bytes.clear();
        if self.is_restored.load(Ordering::Relaxed) { Ok(()) } else { result }
    }
}

/// A key or an action of the mouse that has a meaning here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Key {
    /// Printable ASCII character, with or without Alt.
    Sign(char),
    Tab,
    Escape,
    Up,
    Down,
    Right,
    Left,
    /// Ctrl-C, which is a byte in raw mode.
    Interrupt,
    /// Left mouse button at this column and row, counted from 0.
    Point(u16, u16),
    /// Mouse wheel moved away from the user, at this column and row.
    WheelUp(u16, u16),
    /// Mouse wheel moved toward the user.
    WheelDown(u16, u16),
}

/// Makes the terminal report where mouse buttons are pressed and dragged (xterm's mode 1002), without a maximum column
/// (mode 1006).
const MOUSE_ON: &str = "\x1b[?1002h\x1b[?1006h";
/// Ends the reports of the mouse.
const MOUSE_OFF: &str = "\x1b[?1006l\x1b[?1002l";

/// Reader of keys from stdin if it is a terminal, otherwise from the terminal of the process. The reader distinguishes
/// a closed terminal from an open terminal at which no key is pressed.
struct Keys {
    terminal: File,
    pending: VecDeque<u8>,
}

impl Keys {
    fn open() -> io::Result<Keys> {
        let stdin = io::stdin();
        let terminal = match stdin.is_terminal() {
            true => stdin.as_fd().try_clone_to_owned()?.into(),
            false => File::open("/dev/tty")?,
        };
        Ok(Keys { terminal, pending: VecDeque::new() })
    }

    /// Returns the next key without waiting.
    ///
    /// # Errors
    ///
    /// Returns [`ErrorKind::UnexpectedEof`] if the terminal was closed.
    fn next(&mut self) -> io::Result<Option<Key>> {
        let mut key = next(&mut self.pending);
        if key.is_none() {
            let mut fds = [PollFd::new(&self.terminal, PollFlags::IN)];
            // An error means that a signal arrived. The caller handles signals.
            let is_there = poll(&mut fds, Some(&Timespec::default())).is_ok_and(|count| count > 0);
            if is_there {
                let mut piece = [0; 256];
                match self.terminal.read(&mut piece) {
                    Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
                    Ok(len) => self.pending.extend(&piece[..len]),
                    Err(error) if error.kind() == ErrorKind::Interrupted => {}
                    Err(error) => return Err(error),
                }
                key = next(&mut self.pending);
            }
        }
        Ok(key)
    }
}

/// Takes the first key from `typed`, and skips bytes without a meaning (ECMA-48, xterm). Leaves an incomplete sequence,
/// because its end may arrive with the next bytes.
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
                    if length >= typed.len() && length < MAX_SEQUENCE_LEN {
                        return None;
                    }
                    let sequence: Vec<u8> = typed.drain(..length.min(typed.len())).collect();
                    typed.front().and_then(|last| parse_sequence(&sequence[2..], *last))
                }
                // The character after the escape was typed with Alt, so skip only the escape.
                Some(_) => None,
            },
            b' '..=b'~' => Some(Key::Sign(byte.into())),
            _ => None,
        };
        // Remove the last byte of a sequence, or a key of one byte.
        typed.pop_front();
        if key.is_some() {
            return key;
        }
    }
    None
}

/// Returns the meaning of a sequence with these parameters and this last byte: an arrow, or the mouse.
fn parse_sequence(parameters: &[u8], last: u8) -> Option<Key> {
    match last {
        b'A' => Some(Key::Up),
        b'B' => Some(Key::Down),
        b'C' => Some(Key::Right),
        b'D' => Some(Key::Left),
        b'M' => mouse(parameters.strip_prefix(b"<")?),
        _ => None,
    }
}

/// Parses an action of the mouse: `BUTTON;COLUMN;ROW`, counted from 1.
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
/// Maximum length of a sequence in bytes.
const MAX_SEQUENCE_LEN: usize = 32;
/// Bits and values of the button in a report of the mouse: Shift, Alt and Ctrl; movement while the button is pressed;
/// the wheel away from the user, and toward the user.
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
    fn decodes_keys() {
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
    fn skips_bytes_without_a_meaning() {
        assert_eq!(keys("\x1b[15~\x1b[5~\x1b[<0;10;20m\x01\r\nm"), [Key::Sign('m')]);
        assert_eq!(
            keys("\x1b[M !!\x1b[<0;0;1M\x1b[<0;1M\x1b[<2;5;5M\x1b[<0;99999;1M"),
            [Key::Sign(' '), Key::Sign('!'), Key::Sign('!')]
        );
        let endless = "1".repeat(MAX_SEQUENCE_LEN);
        assert_eq!(keys(&format!("\x1b[{endless}")), [], "an endless sequence is dropped");
        assert_eq!(keys("ä€q"), [Key::Sign('q')]);
        assert_eq!(keys("\x1b[1;"), []);
    }

    #[test]
    fn decodes_the_mouse() {
        assert_eq!(
            keys("\x1b[<0;10;20M\x1b[<32;11;20M\x1b[<0;11;20m"),
            [Key::Point(9, 19), Key::Point(10, 19)]
        );
        assert_eq!(keys("\x1b[<64;300;1M\x1b[<81;1;1M"), [Key::WheelUp(299, 0), Key::WheelDown(0, 0)]);
    }

    #[test]
    fn joins_a_sequence_in_two_pieces() {
        let whole = "\x1b[<0;10;20Mq";
        for cut in 2..whole.len() {
            let mut typed = VecDeque::new();
            let mut decoded = Vec::new();
            for piece in [&whole[..cut], &whole[cut..]] {
                typed.extend(piece.bytes());
                decoded.extend(std::iter::from_fn(|| next(&mut typed)));
            }
            assert_eq!(decoded, [Key::Point(9, 19), Key::Sign('q')], "{cut}");
        }
    }
}
