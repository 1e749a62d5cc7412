//! A child process of this very program: started with its verb, read line by line, ended by its id.

use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child as Process, ChildStdout, Command, Stdio};
use std::sync::mpsc::Sender;
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use schema::{Domain, Failure, Kind};

/// What a child does, with its number.
#[derive(Debug)]
pub(crate) enum Line {
    /// It printed a line.
    Said { of: usize, text: String },
    /// It printed its last.
    Ended { of: usize },
}

/// A running child; ended when dropped.
#[derive(Debug)]
pub(crate) struct Child {
    process: Process,
}

impl Child {
    /// Starts this program with `arguments` in `domain`; its lines go to `listener` with its number, what it says of
    /// errors to `errors`, what it keeps to `state`.
    pub(crate) fn start(
        arguments: &[String],
        domain: &Domain,
        state: &Path,
        listener: Option<(usize, Sender<Line>)>,
        errors: Stdio,
    ) -> Result<Child, Failure> {
        let failed = |error: std::io::Error| {
            Failure::new(Kind::Failed, format!("cannot start scanhub {}: {error}", arguments.join(" ")), "")
        };
        let program = std::env::current_exe().map_err(failed)?;
        let mut process = Command::new(program)
            .args(arguments)
            .args(["--domain", domain.name(), "--root"])
            .arg(domain.root().parent().unwrap_or(domain.root()))
            .env("SCANHUB_LOG", std::env::var("SCANHUB_LOG").unwrap_or("error".into()))
            .env(crate::END_WITH_PARENT, "1")
            .env("STATE_DIRECTORY", state)
            // Ctrl-C is for the demonstration; it ends its children itself, in their order.
            .process_group(0)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(errors)
            .spawn()
            .map_err(failed)?;
        if let Some((of, lines)) = listener
            && let Some(stdout) = process.stdout.take()
        {
            forward(BufReader::new(stdout), of, lines);
        }
        Ok(Child { process })
    }

    /// Waits for the first line, which says that it is up, and returns it too; what comes later goes to `lines`.
    pub(crate) fn await_ready(mut self, of: usize, lines: Sender<Line>) -> Result<(Child, String), Failure> {
        let mut first = String::new();
        if let Some(stdout) = self.process.stdout.take() {
            let mut stdout = BufReader::new(stdout);
            let _ = stdout.read_line(&mut first);
            forward(stdout, of, lines);
        }
        if first.is_empty() { Err(super::ended(of)) } else { Ok((self, first)) }
    }

    /// Its process id.
    pub(crate) fn pid(&self) -> u32 {
        self.process.id()
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        if let Some(pid) = Pid::from_raw(self.process.id() as i32) {
            let _ = kill_process(pid, Signal::TERM);
        }
        let give_up_at = Instant::now() + Duration::from_secs(2);
        while let Ok(None) = self.process.try_wait() {
            if Instant::now() > give_up_at {
                let _ = self.process.kill();
                let _ = self.process.wait();
                return;
            }
            thread::sleep(Duration::from_millis(5));
        }
    }
}

fn forward(stdout: BufReader<ChildStdout>, of: usize, lines: Sender<Line>) {
    thread::spawn(move || {
        for text in stdout.lines().map_while(Result::ok) {
            if lines.send(Line::Said { of, text }).is_err() {
                return;
            }
        }
        let _ = lines.send(Line::Ended { of });
    });
}
