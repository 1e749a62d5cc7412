//! Pseudoterminal in which a test runs a program, and the content of its screen.

use std::ffi::OsStr;
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags};
use rustix::process::Signal;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Termios, Winsize, tcgetattr, tcsetwinsize};

use super::child::{Child, spawn, succeeds};
use super::{WAIT_TIMEOUT, skip};

/// Creates a terminal, and returns the test's side and the program's side.
pub(crate) fn terminal() -> (File, OwnedFd) {
    let keys = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
    grantpt(&keys).unwrap();
    unlockpt(&keys).unwrap();
    let name = ptsname(&keys, Vec::new()).unwrap();
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
    let screen: OwnedFd = rustix::fs::open(OsStr::from_bytes(name.as_bytes()), flags, Mode::empty()).unwrap();
    (keys.into(), screen)
}

/// Returns whether a test can start a program in a new terminal. Skips the test if not.
pub(crate) fn can_open_terminal() -> bool {
    let can_sit = succeeds(Command::new("setsid").arg("true"));
    if !can_sit {
        skip("setsid", "it is not installed (Debian: apt-get install util-linux)");
    }
    can_sit
}

/// Program in its own terminal.
pub(crate) struct TerminalSession {
    process: Child,
    /// Test's side of the terminal, until the test closes it.
    input: Option<File>,
    terminal: OwnedFd,
    initial_modes: Termios,
    output: Arc<Mutex<Vec<u8>>>,
    /// Thread that reads the output of the program until `closed` is set.
    reader: Option<JoinHandle<()>>,
    closed: Arc<AtomicBool>,
    size: (u16, u16),
}

impl TerminalSession {
    /// Starts `command` in a new terminal of `size` (columns and rows). The terminal is the controlling terminal of a
    /// new session.
    pub(crate) fn start(command: &Command, size: (u16, u16)) -> TerminalSession {
        TerminalSession::begin(command, size, &["-c"], None)
    }

    /// Starts `command` like [`TerminalSession::start`], with `errors` as its stderr. If `has_controlling_terminal` is
    /// false, the session has no controlling terminal, so that closing the terminal sends no signal.
    pub(crate) fn start_for_hang_up(
        command: &Command,
        size: (u16, u16),
        has_controlling_terminal: bool,
        errors: File,
    ) -> TerminalSession {
        TerminalSession::begin(
            command,
            size,
            if has_controlling_terminal { &["-c"] } else { &[] },
            Some(errors),
        )
    }

    fn begin(command: &Command, size: (u16, u16), flags: &[&str], errors: Option<File>) -> TerminalSession {
        let (input, terminal) = terminal();
        resize(&terminal, size);
        let initial_modes = tcgetattr(&terminal).unwrap();
        let program = || Stdio::from(terminal.try_clone().unwrap());
        let mut setsid = Command::new("setsid");
        setsid.args(flags).arg(command.get_program()).args(command.get_args());
        for (key, value) in command.get_envs() {
            match value {
                Some(value) => setsid.env(key, value),
                None => setsid.env_remove(key),
            };
        }
        setsid.env("TERM", "xterm").stdin(program()).stdout(program());
        setsid.stderr(errors.map_or_else(program, Stdio::from));
        let process = spawn(&mut setsid).unwrap();
        drop(setsid);
        let output = Arc::new(Mutex::new(Vec::new()));
        let closed = Arc::new(AtomicBool::new(false));
        let (mut from, to, is_over) = (input.try_clone().unwrap(), output.clone(), closed.clone());
        let eye = thread::spawn(move || {
            let mut piece = [0; 4096];
            while !is_over.load(Ordering::Relaxed) {
                let mut fds = [PollFd::new(&from, PollFlags::IN)];
                if poll(&mut fds, Some(&POLL_INTERVAL)).unwrap() == 0 {
                    continue;
                }
                // Reading fails as soon as no process has the terminal open.
                let Ok(len @ 1..) = from.read(&mut piece) else { return };
                to.lock().unwrap().extend_from_slice(&piece[..len]);
            }
        });
        TerminalSession {
            process,
            input: Some(input),
            terminal,
            initial_modes,
            output,
            reader: Some(eye),
            closed,
            size,
        }
    }

    /// Returns the process ID of the program.
    pub(crate) fn pid(&self) -> u32 {
        self.process.id()
    }

    /// Returns all output of the program so far.
    pub(crate) fn text(&self) -> String {
        String::from_utf8_lossy(&self.output.lock().unwrap()).into_owned()
    }

    /// Returns the rows of the screen.
    pub(crate) fn rows(&self) -> Vec<String> {
        screen_rows(&self.text(), self.size.0.into(), self.size.1.into())
    }

    /// Waits until a row contains `words`.
    pub(crate) fn wait_for_text(&self, words: &str) {
        self.await_rows(words, |rows| rows.iter().any(|row| row.contains(words)));
    }

    /// Waits until `is_expected` accepts the rows.
    pub(crate) fn await_rows(&self, description: &str, is_expected: impl Fn(&[String]) -> bool) {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        while !is_expected(&self.rows()) {
            assert!(
                Instant::now() < give_up_at,
                "timeout: the terminal does not show {description}:\n{}",
                self.rows().join("\n")
            );
            thread::sleep(Duration::from_millis(10));
        }
    }

    /// Types `keys`.
    pub(crate) fn press(&mut self, keys: &str) {
        self.input.as_mut().expect("the terminal is open").write_all(keys.as_bytes()).unwrap();
    }

    /// Sets the size of the terminal in columns and rows.
    pub(crate) fn resize(&mut self, size: (u16, u16)) {
        self.size = size;
        resize(&self.terminal, size);
    }

    /// Sends a signal.
    pub(crate) fn signal(&self, signal: Signal) {
        self.process.signal(signal).unwrap();
    }

    /// Closes the test's side of the terminal and waits until the program exits. Returns its exit code.
    pub(crate) fn hang_up(mut self) -> Option<i32> {
        self.closed.store(true, Ordering::Relaxed);
        self.reader.take().map(JoinHandle::join).transpose().unwrap();
        drop(self.input.take());
        self.wait()
    }

    fn wait(&mut self) -> Option<i32> {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        loop {
            if let Some(status) = self.process.try_wait().unwrap() {
                return status.code();
            }
            assert!(
                Instant::now() < give_up_at,
                "timeout: the program does not exit:\n{}",
                self.rows().join("\n")
            );
            thread::sleep(Duration::from_millis(10));
        }
    }

    /// Waits until the program exits. Returns the exit code, the text that it printed after it left the alternate
    /// screen, and whether it used the alternate screen and restored the cursor and the modes of the terminal.
    pub(crate) fn finish(self) -> (Option<i32>, String, bool) {
        let (code, text, is_as_before) = self.finish_plain();
        let (picture, below) = text.rsplit_once("\x1b[?1049l").unwrap_or(("", &text));
        let is_shown = below.contains("\x1b[?25h") && !below.contains("\x1b[?25l");
        let is_whole = picture.contains("\x1b[?1049h") && is_shown && is_as_before;
        (code, below.replace("\x1b[?25h", ""), is_whole)
    }

    /// Waits until a program that does not use the alternate screen exits. Returns the exit code, all of its output,
    /// and whether the terminal has its old modes.
    pub(crate) fn finish_plain(mut self) -> (Option<i32>, String, bool) {
        let code = self.wait();
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        let after = tcgetattr(&self.terminal).unwrap();
        let is_as_before = (after.input_modes, after.output_modes, after.local_modes)
            == (
                self.initial_modes.input_modes,
                self.initial_modes.output_modes,
                self.initial_modes.local_modes,
            );
        // This mark is written after the output of the program. Once the mark has been read, all output has been read.
        let mark = "\u{1}end";
        File::from(self.terminal.try_clone().unwrap()).write_all(mark.as_bytes()).unwrap();
        while !self.text().ends_with(mark) {
            assert!(Instant::now() < give_up_at, "the terminal does not return the output");
            thread::sleep(Duration::from_millis(10));
        }
        let text = self.text();
        (code, text.replace(mark, ""), is_as_before)
    }
}

/// Interval at which the reader checks whether the terminal is closed.
const POLL_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };

fn resize(terminal: impl AsFd, (columns, rows): (u16, u16)) {
    tcsetwinsize(terminal, Winsize { ws_col: columns, ws_row: rows, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
}

/// Returns the rows of a screen after `text` was written to it. Interprets cursor positions (CSI H), clearing (CSI J)
/// and switching to and from the alternate screen. Ignores all other sequences, such as colors.
fn screen_rows(text: &str, columns: usize, rows: usize) -> Vec<String> {
    let mut screen = vec![vec![' '; columns]; rows];
    let (mut row, mut column) = (0, 0);
    let mut signs = text.chars();
    while let Some(sign) = signs.next() {
        match sign {
            '\x1b' if signs.clone().next() == Some('[') => {
                signs.next();
                let arguments: String =
                    signs.clone().take_while(|sign| !sign.is_ascii_alphabetic()).collect();
                match signs.nth(arguments.chars().count()) {
                    Some('H') => {
                        let mut numbers =
                            arguments.split(';').map(|number| number.parse().unwrap_or(1_usize));
                        row = numbers.next().unwrap_or(1).saturating_sub(1);
                        column = numbers.next().unwrap_or(1).saturating_sub(1);
                    }
                    Some('J') => screen.iter_mut().for_each(|row| row.fill(' ')),
                    Some('h' | 'l') if arguments == "?1049" => {
                        screen.iter_mut().for_each(|row| row.fill(' '));
                    }
                    _ => {}
                }
            }
            '\r' => column = 0,
            '\n' => row += 1,
            sign => {
                if let Some(cell) = screen.get_mut(row).and_then(|row| row.get_mut(column)) {
                    *cell = sign;
                }
                column += 1;
            }
        }
    }
    screen.into_iter().map(|row| row.into_iter().collect::<String>().trim_end().to_owned()).collect()
}
