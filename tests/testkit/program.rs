//! Program that runs as a child of a test. The test reads the program's output line by line.

use std::fmt;
use std::io::{BufRead, BufReader, Read};
use std::process::{Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread::{self, JoinHandle};
use std::time::Instant;

use rustix::process::Signal;
use serde_json::Value;

use super::WAIT_TIMEOUT;
use super::child::{Child, spawn};

pub(crate) const INT: Signal = Signal::INT;
pub(crate) const TERM: Signal = Signal::TERM;
pub(crate) const KILL: Signal = Signal::KILL;
pub(crate) const HUP: Signal = Signal::HUP;
pub(crate) const USR1: Signal = Signal::USR1;

/// Running program. Dropping this value ends the program.
pub(crate) struct Program {
    name: String,
    process: Child,
    /// Lines of stdout that have not been processed yet. The last line may lack its line feed.
    received_lines: Receiver<Vec<u8>>,
    /// Bytes of all lines that were taken from `received_lines`.
    stdout: Vec<u8>,
    errors: Option<JoinHandle<String>>,
}

/// Result of a program that has exited.
pub(crate) struct Outcome {
    /// Exit code; `None` if a signal ended the program.
    pub(crate) exit_code: Option<i32>,
    /// Complete stdout of the program.
    pub(crate) stdout: Vec<u8>,
    /// Complete stderr of the program.
    pub(crate) stderr: String,
    /// Command lines of the descendants that were still running when the program exited. These processes have been
    /// ended since.
    pub(crate) leftover_processes: Vec<String>,
    name: String,
}

impl Program {
    /// Starts `command` with an empty stdin.
    pub(crate) fn start(command: Command) -> Program {
        Program::start_with(command, Stdio::null())
    }

    /// Starts `command` with this stdin.
    pub(crate) fn start_with(mut command: Command, stdin: impl Into<Stdio>) -> Program {
        let words: Vec<_> = command.get_args().map(|word| word.to_string_lossy()).collect();
        let name = words.join(" ");
        command.stdin(stdin).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut process = spawn(command).unwrap_or_else(|error| panic!("cannot start {name}: {error}"));
        let (send, received_lines) = channel();
        let stdout = process.stdout.take();
        thread::spawn(move || {
            let Some(mut stdout) = stdout.map(BufReader::new) else { return };
            let mut piece = Vec::new();
            while stdout.read_until(b'\n', &mut piece).is_ok_and(|len| len > 0) {
                if send.send(std::mem::take(&mut piece)).is_err() {
                    return;
                }
            }
        });
        let stderr = process.stderr.take();
        let errors = thread::spawn(move || {
            let mut text = Vec::new();
            let _ = stderr.map(|mut stderr| stderr.read_to_end(&mut text));
            String::from_utf8_lossy(&text).into_owned()
        });
        Program { name, process, received_lines, stdout: Vec::new(), errors: Some(errors) }
    }

    /// Waits for the program's line of class `ready`.
    pub(crate) fn ready(mut self) -> Program {
        self.await_line("ready", |line| line["class"] == "ready");
        self
    }

    /// Returns the process ID of the program.
    pub(crate) fn pid(&self) -> u32 {
        self.process.id()
    }

    /// Returns whether the program has ended.
    pub(crate) fn has_ended(&self) -> bool {
        matches!(self.state(), None | Some('Z' | 'X'))
    }

    /// Returns whether a signal has stopped the program.
    pub(crate) fn is_stopped(&self) -> bool {
        self.state() == Some('T')
    }

    /// Returns the state of the process as the letter of proc_pid_stat(5), or `None` if the process does not exist.
    fn state(&self) -> Option<char> {
        let status = std::fs::read_to_string(format!("/proc/{}/stat", self.pid())).ok()?;
        // The state follows the name in brackets.
        status.rsplit_once(')')?.1.trim_start().chars().next()
    }

    /// Waits for the next line or the end of the program. Returns whether the program ended without another line on
    /// stdout.
    pub(crate) fn ends_without_output(&mut self) -> bool {
        self.receive(Instant::now() + WAIT_TIMEOUT) == Err(RecvTimeoutError::Disconnected)
    }

    /// Waits for the next line that `is_expected` accepts, and returns this line.
    pub(crate) fn await_line(&mut self, description: &str, is_expected: impl Fn(&Value) -> bool) -> Value {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        loop {
            let line = self.next_line(give_up_at).unwrap_or_else(|why| self.fail_wait(description, why));
            if is_expected(&line) {
                return line;
            }
        }
    }

    /// Returns whether `is_expected` accepts one of the lines that the test has received so far. Does not receive more
    /// lines.
    pub(crate) fn has_printed(&self, is_expected: impl Fn(&Value) -> bool) -> bool {
        let lines = self.stdout.split(|byte| *byte == b'\n');
        lines.filter_map(|line| serde_json::from_slice(line).ok()).any(|line| is_expected(&line))
    }

    /// Receives the lines that the program has written by now. Returns whether `is_expected` accepts one of these lines
    /// or of the lines received before.
    pub(crate) fn prints(&mut self, is_expected: impl Fn(&Value) -> bool) -> bool {
        while self.receive(Instant::now()).is_ok() {}
        self.has_printed(is_expected)
    }

    /// Returns the first line that `is_expected` accepts, among all lines that the program has printed so far.
    pub(crate) fn printed(&mut self, is_expected: impl Fn(&Value) -> bool) -> Option<Value> {
        while self.receive(Instant::now()).is_ok() {}
        let lines = self.stdout.split(|byte| *byte == b'\n');
        lines.filter_map(|line| serde_json::from_slice(line).ok()).find(|line| is_expected(line))
    }

    /// Returns the last line that `is_expected` accepts, among all lines that the program has printed so far.
    pub(crate) fn last_printed(&mut self, is_expected: impl Fn(&Value) -> bool) -> Option<Value> {
        while self.receive(Instant::now()).is_ok() {}
        let lines = self.stdout.split(|byte| *byte == b'\n').rev();
        lines.filter_map(|line| serde_json::from_slice(line).ok()).find(|line| is_expected(line))
    }

    /// Waits for the next `count` lines that `is_expected` accepts, and returns these lines.
    pub(crate) fn await_lines(
        &mut self,
        count: usize,
        description: &str,
        is_expected: impl Fn(&Value) -> bool,
    ) -> Vec<Value> {
        (0..count).map(|_| self.await_line(description, &is_expected)).collect()
    }

    /// Waits for a line that begins with `text`, for programs that do not print JSON.
    pub(crate) fn wait_for_text(&mut self, text: &str) {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        let mut line = Vec::new();
        while !line.starts_with(text.as_bytes()) {
            let begin = self.stdout.len();
            self.receive(give_up_at).unwrap_or_else(|why| self.fail_wait(text, why));
            line = self.stdout[begin..].to_vec();
        }
    }

    /// Waits for the next line and returns it, for programs that do not print JSON.
    pub(crate) fn next_text(&mut self) -> String {
        let begin = self.stdout.len();
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        self.receive(give_up_at).unwrap_or_else(|why| self.fail_wait("a line", why));
        String::from_utf8_lossy(&self.stdout[begin..]).trim_end().to_owned()
    }

    /// Waits until the program has written more than `len` bytes to stdout in total.
    pub(crate) fn await_bytes(&mut self, len: usize) {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        while self.stdout.len() <= len {
            self.receive(give_up_at).unwrap_or_else(|why| self.fail_wait("bytes", why));
        }
    }

    /// Sends a signal.
    pub(crate) fn signal(&self, signal: Signal) {
        self.process
            .signal(signal)
            .unwrap_or_else(|error| panic!("{}: cannot send {signal:?}: {error}", self.name));
    }

    /// Sends a signal and waits until the program exits.
    pub(crate) fn end(self, signal: Signal) -> Outcome {
        self.signal(signal);
        self.wait()
    }

    /// Waits until the program exits.
    pub(crate) fn wait(mut self) -> Outcome {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        let why = loop {
            match self.receive(give_up_at) {
                Ok(()) => {}
                Err(why) => break why,
            }
        };
        if why == RecvTimeoutError::Timeout {
            self.fail_wait("the exit of the program", why);
        }
        let status = self.process.wait().unwrap_or_else(|error| panic!("{}: {error}", self.name));
        let errors = self.errors.take().map(JoinHandle::join);
        Outcome {
            exit_code: status.code(),
            stdout: std::mem::take(&mut self.stdout),
            stderr: errors.and_then(Result::ok).unwrap_or_default(),
            leftover_processes: self.process.living_command_lines(),
            name: self.name.clone(),
        }
    }

    fn receive(&mut self, deadline: Instant) -> Result<(), RecvTimeoutError> {
        let left = deadline.saturating_duration_since(Instant::now());
        self.received_lines.recv_timeout(left).map(|piece| self.stdout.extend(piece))
    }

    fn next_line(&mut self, deadline: Instant) -> Result<Value, RecvTimeoutError> {
        let begin = self.stdout.len();
        self.receive(deadline)?;
        let text = String::from_utf8_lossy(&self.stdout[begin..]);
        Ok(serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {text}: {error}", self.name)))
    }

    fn fail_wait(&mut self, description: &str, why: RecvTimeoutError) -> ! {
        // End the descendants too. Any of them keeps stderr open, and the thread that reads stderr would not end.
        self.process.end();
        let errors = self.errors.take().and_then(|errors| errors.join().ok()).unwrap_or_default();
        let out = String::from_utf8_lossy(&self.stdout);
        let tail: Vec<_> = out.lines().rev().take(5).collect();
        panic!(
            "scanhub {}: timeout or exit while waiting for {description} ({why}); its last lines: {tail:#?}\n{errors}",
            self.name
        );
    }
}

impl Drop for Program {
    /// Ends the program. If the test has failed, prints the state of the program, its last lines and its stderr,
    /// because they may show the reason.
    fn drop(&mut self) {
        let Some(errors) = self.errors.take().filter(|_| thread::panicking()) else { return };
        let status = self.process.try_wait().ok().flatten();
        let state = status.map_or_else(|| "still running".to_owned(), |status| status.to_string());
        self.process.end();
        self.stdout.extend(self.received_lines.try_iter().flatten());
        let out = String::from_utf8_lossy(&self.stdout);
        let tail: Vec<_> = out.lines().rev().take(5).collect();
        let errors = errors.join().unwrap_or_default();
        eprintln!("scanhub {}: {state}; its last lines: {tail:#?}\n{errors}", self.name);
    }
}

impl Outcome {
    /// Parses stdout as lines of JSON.
    pub(crate) fn lines(&self) -> Vec<Value> {
        let text = String::from_utf8_lossy(&self.stdout);
        assert!(text.is_empty() || text.ends_with('\n'), "the last line is incomplete: {self}");
        text.lines()
            .map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{line}: {error}\n{self}")))
            .collect()
    }

    /// Returns the lines of `class`.
    pub(crate) fn of_class(&self, class: &str) -> Vec<Value> {
        self.lines().into_iter().filter(|line| line["class"] == class).collect()
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Outcome { name, exit_code, stdout, stderr, .. } = self;
        write!(f, "scanhub {name}: exit {exit_code:?}\n{}\n{stderr}", String::from_utf8_lossy(stdout))
    }
}
