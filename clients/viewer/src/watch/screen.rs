//! The terminal: taken over at the start, and restored however the program ends. A frame is one write. Refuses to know
//! what is drawn.

use std::cell::Cell;
use std::io::{self, ErrorKind, Write};
use std::panic::{PanicHookInfo, set_hook, take_hook};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ratatui::backend::CrosstermBackend;
use ratatui::crossterm::cursor::{Hide, Show};
use ratatui::crossterm::style::Print;
use ratatui::crossterm::terminal::{
    EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode,
};
use ratatui::crossterm::{execute, queue};
use ratatui::{Frame, Terminal};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::tcgetwinsize;
use scanhub_schema::{Failure, Kind};

use super::keys::{Key, Keys, MOUSE_OFF, MOUSE_ON};
use scanhub_verbs::output::End;

/// The terminal, as long as it is ours.
pub(crate) struct Screen<'a> {
    terminal: Terminal<CrosstermBackend<Sheet<'a>>>,
    written: Rc<Cell<usize>>,
    keys: Keys,
    /// Columns and rows, as they were last.
    size: Option<(u16, u16)>,
    hook: Arc<Hook>,
    /// A panic has given the terminal back already.
    given_back: Arc<AtomicBool>,
}

type Hook = dyn Fn(&PanicHookInfo<'_>) + Sync + Send;

/// What a terminal tells besides keys.
pub(crate) enum News {
    /// A key was pressed.
    Key(Key),
    /// It has another size.
    Resized,
}

impl<'a> Screen<'a> {
    /// Takes over the terminal that `out` writes to.
    pub(crate) fn new(out: &'a mut dyn Write) -> Result<Screen<'a>, End> {
        let written = Rc::new(Cell::new(0));
        let given_back = Arc::new(AtomicBool::new(false));
        let mut sheet =
            Sheet { out, buffer: Vec::new(), written: written.clone(), given_back: given_back.clone() };
        let no_terminal = |error| {
            let message = format!("cannot use the terminal: {error}");
            Failure::new(Kind::Failed, message, "keys are read from stdin or /dev/tty; `ssh -t` provides one")
        };
        let keys = Keys::open().map_err(no_terminal)?;
        enable_raw_mode().map_err(no_terminal)?;
        let taken = execute!(sheet, EnterAlternateScreen, Hide, Print(MOUSE_ON))
            .and_then(|()| Terminal::new(CrosstermBackend::new(sheet)));
        let terminal = taken.inspect_err(|_| {
            let _ = disable_raw_mode();
        })?;
        let hook: Arc<Hook> = Arc::from(take_hook());
        let (before, giving) = (hook.clone(), given_back.clone());
        // What a panic says would go with the sheet.
        set_hook(Box::new(move |info| {
            if !giving.swap(true, Ordering::Relaxed) {
                let _ = execute!(io::stdout(), Print(MOUSE_OFF), LeaveAlternateScreen, Show);
                let _ = disable_raw_mode();
            }
            before(info);
        }));
        Ok(Screen { terminal, written, keys, size: size(), hook, given_back })
    }

    /// Draws a frame; how many bytes that took.
    pub(crate) fn draw(&mut self, picture: impl FnOnce(&mut Frame<'_>)) -> Result<usize, End> {
        self.written.set(0);
        self.terminal.draw(picture).map_err(gone)?;
        Ok(self.written.get())
    }

    /// What was typed, or else happened to the terminal, since the last call; never waits.
    pub(crate) fn news(&mut self) -> Result<Option<News>, End> {
        if hung_up() {
            return Err(End::ReaderGone);
        }
        let size = size();
        if std::mem::replace(&mut self.size, size) != size {
            return Ok(Some(News::Resized));
        }
        Ok(self.keys.next().map_err(gone)?.map(News::Key))
    }
}

impl Drop for Screen<'_> {
    fn drop(&mut self) {
        if !self.given_back.swap(true, Ordering::Relaxed) {
            let backend = self.terminal.backend_mut();
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

/// Columns and rows of the terminal, if it tells them.
fn size() -> Option<(u16, u16)> {
    tcgetwinsize(io::stdout()).ok().map(|size| (size.ws_col, size.ws_row))
}

/// Whether the terminal was closed: a program that draws nothing would not notice, and not every one gets a signal.
fn hung_up() -> bool {
    let stdout = io::stdout();
    let mut ends = [PollFd::new(&stdout, PollFlags::empty())];
    let is_polled = poll(&mut ends, Some(&Timespec::default())).is_ok();
    is_polled && ends[0].revents().intersects(PollFlags::HUP | PollFlags::ERR)
}

/// A terminal that was closed is nobody who reads.
fn gone(error: io::Error) -> End {
    const EIO: i32 = 5;
    if error.raw_os_error() == Some(EIO) || error.kind() == ErrorKind::UnexpectedEof {
        return End::ReaderGone;
    }
    End::from(error)
}

/// Collects what makes a frame.
struct Sheet<'a> {
    out: &'a mut dyn Write,
    buffer: Vec<u8>,
    written: Rc<Cell<usize>>,
    /// What comes now is a farewell, which may well fail.
    given_back: Arc<AtomicBool>,
}

impl Write for Sheet<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.buffer.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.written.set(self.written.get() + self.buffer.len());
        let result = self.out.write_all(&self.buffer).and_then(|()| self.out.flush());
        self.buffer.clear();
        if self.given_back.load(Ordering::Relaxed) { Ok(()) } else { result }
    }
}
