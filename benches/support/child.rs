//! A child process: started, read line by line, ended by its id whatever happens.

use std::io::{BufRead, BufReader};
use std::process::{Child as Process, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use super::{Outcome, clock};

/// A process that ends with this value.
pub(crate) struct Guard(Process);

impl Guard {
    /// Takes over a process that was started.
    pub(crate) fn new(process: Process) -> Guard {
        Guard(process)
    }

    /// Its process id.
    pub(crate) fn pid(&self) -> u32 {
        self.0.id()
    }

    /// Ends it as a crash would; an error if it ended by itself before.
    pub(crate) fn kill(mut self) -> Outcome<()> {
        if let Some(status) = self.0.try_wait()? {
            return Err(format!("process {} ended early: {status}", self.pid()).into());
        }
        self.0.kill()?;
        self.wait()
    }

    /// Waits until it has ended.
    pub(crate) fn wait(mut self) -> Outcome<()> {
        self.0.wait()?;
        Ok(())
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        if let (Ok(None), Some(pid)) = (self.0.try_wait(), Pid::from_raw(self.0.id() as i32)) {
            let _ = kill_process(pid, Signal::TERM);
        }
        let give_up_at = Instant::now() + Duration::from_secs(2);
        while let Ok(None) = self.0.try_wait() {
            if Instant::now() > give_up_at {
                let _ = self.0.kill();
                let _ = self.0.wait();
                return;
            }
            thread::sleep(Duration::from_millis(1));
        }
    }
}

/// A guarded process and what it prints.
pub(crate) struct Child {
    pub(crate) guard: Guard,
    lines: Receiver<Line>,
    /// CLOCK_MONOTONIC just before it was started.
    pub(crate) started_ns: u64,
}

/// A line that a process printed, and when it was read.
#[derive(Clone, Debug)]
pub(crate) struct Line {
    pub(crate) at_ns: u64,
    pub(crate) text: String,
}

impl Line {
    /// The words of the line.
    pub(crate) fn words(&self) -> Vec<&str> {
        self.text.split_whitespace().collect()
    }

    /// Word number `i` as a number.
    pub(crate) fn number(&self, i: usize) -> Outcome<u64> {
        let word =
            self.text.split_whitespace().nth(i).ok_or_else(|| format!("no word {i}: {}", self.text))?;
        Ok(word.parse()?)
    }
}

impl Child {
    /// Starts `program` with `arguments`.
    pub(crate) fn start(program: &str, arguments: &[String]) -> Outcome<Child> {
        let mut command = Command::new(program);
        command.args(arguments);
        Child::of(command, Stdio::null())
    }

    /// Starts what `command` says, with this as its stdin.
    pub(crate) fn of(mut command: Command, stdin: Stdio) -> Outcome<Child> {
        command.stdin(stdin).stdout(Stdio::piped());
        // The program's own: nothing outlives this process, and only errors are logged.
        command.env("SCANHUB_END_WITH_PARENT", "1").env("SCANHUB_LOG", "error");
        let started_ns = clock::now();
        let mut process = command.spawn()?;
        let stdout = process.stdout.take();
        let guard = Guard::new(process);
        let stdout = BufReader::new(stdout.ok_or("no pipe")?);
        let (send, lines) = channel();
        thread::spawn(move || {
            for text in stdout.lines().map_while(Result::ok) {
                if send.send(Line { at_ns: clock::now(), text }).is_err() {
                    return;
                }
            }
        });
        Ok(Child { guard, lines, started_ns })
    }

    /// The next line that begins with `word`; others are dropped.
    pub(crate) fn await_line(&self, word: &str, patience: Duration) -> Outcome<Line> {
        let end = Instant::now() + patience;
        loop {
            match self.lines.recv_timeout(end.saturating_duration_since(Instant::now())) {
                Ok(line) if line.text.starts_with(word) => return Ok(line),
                Ok(_) => {}
                Err(_) => return Err(format!("no line {word:?} came").into()),
            }
        }
    }

    /// The next line, whatever it is.
    pub(crate) fn next_line(&self, patience: Duration) -> Outcome<Line> {
        self.lines.recv_timeout(patience).map_err(|_| "no line came".into())
    }

    /// All lines up to the one that is `word`.
    pub(crate) fn lines_until(&self, word: &str, patience: Duration) -> Outcome<Vec<Line>> {
        let end = Instant::now() + patience;
        let mut lines = Vec::new();
        loop {
            match self.lines.recv_timeout(end.saturating_duration_since(Instant::now())) {
                Ok(line) if line.text == word => return Ok(lines),
                Ok(line) => lines.push(line),
                Err(_) => return Err(format!("no line {word:?} came after {} lines", lines.len()).into()),
            }
        }
    }

    /// The lines that wait.
    pub(crate) fn lines_so_far(&self) -> Vec<Line> {
        self.lines.try_iter().collect()
    }
}
