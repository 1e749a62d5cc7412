//! The program `scanhub`: it parses the command line, starts the log, runs the verb, and converts its result to output
//! and an exit code.

mod cli;
mod demo;
mod mounts;
mod private_domain;
mod replay;

use std::ffi::c_int;
use std::fs::File;
use std::io::{self, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::error::ErrorKind;
use rustix::process::Signal;
use scanhub_schema::{Failure, Kind, Printable, json_line};
use scanhub_verbs::context::{Context, DomainOptions, Signals};
use serde::Serialize;
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGUSR1};
use tracing::level_filters::LevelFilter;

use cli::{Cli, Verb};

/// Environment variable of a process that must not outlive its parent.
const END_WITH_PARENT: &str = "SCANHUB_END_WITH_PARENT";

fn main() -> ExitCode {
    if std::env::var_os(END_WITH_PARENT).is_some() {
        let _ = rustix::process::set_parent_process_death_signal(Some(Signal::TERM));
    }
    let cli = match Cli::of_process() {
        Ok(cli) => cli,
        Err(error) => return refuse(&error),
    };
    start_log();
    // Programs read the output of these verbs on stdout, or stdout is a recording. Print failures to stderr.
    let quiet = match &cli.verb {
        Verb::Run(_) | Verb::Replay(_) | Verb::Simulate(_) => true,
        Verb::Record(record) => record.is_to_stdout(),
        _ => false,
    };
    scanhub_daemon::explain_bus_error(cli.global.json, quiet);
    let json = cli.global.json;
    match run(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            report(&failure, json, quiet);
            ExitCode::from(failure.kind.exit_code())
        }
    }
}

/// Runs the verb in the context of this process.
fn run(cli: Cli) -> Result<(), Failure> {
    // At the limit of a file's length, the write must fail, and the signal must not end the process.
    flag(&[SIGXFSZ])?;
    // Bypass the buffer of the standard library, which splits writes at line feeds. One write must be one sample, even
    // a raw one.
    let own = |name: &str, stream: BorrowedFd<'_>| {
        let file = stream.try_clone_to_owned().map(File::from);
        file.map_err(|error| Failure::new(Kind::Failed, format!("no {name}: {error}"), ""))
    };
    let streams = (own("stdout", io::stdout().as_fd())?, own("stderr", io::stderr().as_fd())?);
    let domain = DomainOptions { name: cli.global.domain, root: cli.global.root };
    cli.verb.run(&mut Context::new(cli.global.json, domain, streams, Box::new(ProcessSignals)))
}

fn to_json_line(value: &impl Serialize) -> String {
    json_line(serde_json::to_string(value).unwrap_or_default())
}

/// Signal that a file would exceed the limit of its length. signal-hook has no name for it.
const SIGXFSZ: c_int = Signal::XFSZ.as_raw();

/// Signals of this process.
struct ProcessSignals;

impl Signals for ProcessSignals {
    fn stop(&self) -> Result<Arc<AtomicBool>, Failure> {
        flag(&[SIGINT, SIGTERM])
    }

    fn any_stop(&self) -> Result<Arc<AtomicBool>, Failure> {
        match scanhub_daemon::is_hangup_ignored() {
            true => flag(&[SIGINT, SIGTERM, SIGQUIT]),
            false => flag(&[SIGINT, SIGTERM, SIGHUP, SIGQUIT]),
        }
    }

    fn report(&self) -> Result<Arc<AtomicBool>, Failure> {
        flag(&[SIGUSR1])
    }
}

/// Returns a flag that `signals` set. The signals also interrupt a wait, and no longer end the process.
fn flag(signals: &[c_int]) -> Result<Arc<AtomicBool>, Failure> {
    let flag = Arc::new(AtomicBool::new(false));
    for signal in signals {
        signal_hook::flag::register(*signal, flag.clone()).map_err(no_handler)?;
    }
    Ok(flag)
}

fn no_handler(error: io::Error) -> Failure {
    Failure::new(Kind::Failed, format!("no signal handler: {error}"), "")
}

/// Prints the result of a verb. Succeeds if the reader has closed stdout.
///
/// # Errors
///
/// Returns [`Kind::Failed`] if the text cannot be written, for example to a full disk.
fn print(text: &str) -> Result<(), Failure> {
    print_own(&Printable(text).to_string())
}

/// Prints text of this program. It contains no input, so it may have tabs.
///
/// # Errors
///
/// Returns the errors of [`print()`].
fn print_own(text: &str) -> Result<(), Failure> {
    match io::stdout().lock().write_all(format!("{text}\n").as_bytes()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(Failure::new(Kind::Failed, format!("cannot write: {error}"), ""))
        }
        _ => Ok(()),
    }
}

/// Writes one line to stdout. Ignores errors, such as a closed pipe.
fn print_status(line: &str) {
    let _ = print(line);
}

/// Prints the error of a verb. Without `json`, prints text to stderr. With `json`, prints a JSON line to stdout, or to
/// stderr if `quiet`.
fn report(failure: &Failure, json: bool, quiet: bool) {
    if !json {
        return print_error(&format!("scanhub: {failure}"));
    }
    let line = scanhub_verbs::error_line(failure);
    // On a full disk, stdout cannot take the error either.
    if quiet || print(&line).is_err() {
        print_error(&line);
    }
}

/// Writes one line to stderr. Ignores errors, such as a closed terminal.
fn print_error(line: &str) {
    let _ = io::stderr().lock().write_all(format!("{}\n", Printable(line)).as_bytes());
}

/// Prints help, or the error of a command line that is not valid.
fn refuse(error: &clap::Error) -> ExitCode {
    let wants_text = matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion);
    if !wants_text && std::env::args_os().any(|word| word == "--json") {
        let text = error.to_string();
        let message = text.lines().next().unwrap_or_default().trim_start_matches("error: ");
        let tip = text.lines().find_map(|line| line.trim_start().strip_prefix("tip: "));
        report(&Failure::new(Kind::Usage, message, tip.unwrap_or("scanhub --help")), true, false);
    } else {
        let _ = error.print();
    }
    ExitCode::from(if wants_text { 0 } else { Kind::Usage.exit_code() })
}

/// Starts the log to stderr, with the level in SCANHUB_LOG: error, warn, info (default), debug, trace or off.
fn start_log() {
    let level = std::env::var("SCANHUB_LOG").ok().and_then(|level| level.parse().ok());
    tracing_subscriber::fmt()
        .with_writer(|| replay::progress_line::LogWriter)
        .with_max_level(level.unwrap_or(LevelFilter::INFO))
        .with_target(false)
        .with_ansi(false)
        .init();
}
