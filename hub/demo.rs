//! The whole thing in one terminal: two simulated sensors, the hub and one consumer per sensor, each a process as in
//! real life. This process only starts them, reads what they print, and compares what was sent with what arrived.

mod account;
mod process;
mod view;

use std::fs::{File, OpenOptions};
use std::io::{self, IsTerminal, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

use rustix::fs::{CWD, FileType, Mode, OFlags, mknodat};
use schema::{Domain, Environment, Failure, Kind};
use serde_json::Value;

use account::Account;
use process::{Child, Line};

/// What the demonstration is asked for.
#[derive(Clone, Debug)]
pub(crate) struct DemoOptions {
    /// No live view.
    pub(crate) headless: bool,
    /// How long from the first sample on; until `stop` if nothing.
    pub(crate) run_for: Option<Duration>,
    /// Seed of the rooms.
    pub(crate) seed: u64,
    /// Whether the summary is JSON.
    pub(crate) json: bool,
}

/// Runs until `run_for` is over or `stop` is set, then prints a summary per sensor.
///
/// [`Kind::Check`] if a telegram that a sensor sent did not arrive, [`Kind::Interrupted`] if a bounded run was stopped,
/// [`Kind::Timeout`] if a sensor does not stream within ten seconds, [`Kind::Failed`] if a process ends early.
pub(crate) fn demo(options: &DemoOptions, out: &mut dyn Write, stop: &AtomicBool) -> Result<(), Failure> {
    let stage = Stage::new()?;
    let (lines, received) = mpsc::channel();
    let hub = stage.start_hub(lines.clone())?;
    let consumers = stage.start_consumers(&lines)?;
    let mut account = Account::new(SENSORS.map(String::from).to_vec(), stage.open_truth()?);
    // The sensors come last: whoever listens from the beginning can tell whether something was lost.
    let mut simulator = None;
    let mut ready = 0;
    let mut first_sample: Option<Instant> = None;
    let begun = Instant::now();
    let mut view = view::View::new(stage.domain.name(), hub.pid(), io::stdout().is_terminal());
    let show = !options.headless && !options.json;
    let mut next_look = begun;
    let mut cut = None;
    loop {
        match received.recv_timeout(next_look.saturating_duration_since(Instant::now()).min(PATIENCE)) {
            Ok(Line::Said { of, text }) => {
                let value: Value = serde_json::from_str(&text).unwrap_or_default();
                if value["class"] == "status" && simulator.is_none() {
                    ready |= 1 << of;
                    if ready == (1 << SENSORS.len()) - 1 {
                        simulator = Some(stage.start_simulator(options.seed, lines.clone())?);
                    }
                }
                account.take(of, &value);
                if account.all_stream() {
                    first_sample.get_or_insert_with(Instant::now);
                }
            }
            Ok(Line::Ended { of }) => return Err(ended(of)),
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {}
        }
        let now = Instant::now();
        if now >= next_look {
            next_look = now + REFRESH;
            account.read_truth();
            account.look_at_hub(hub.pid());
            if show {
                view.draw(out, &account, begun.elapsed());
            }
        }
        if first_sample.is_none() && begun.elapsed() > START_LIMIT {
            return Err(Failure::new(
                Kind::Timeout,
                "not every sensor streams after ten seconds",
                "run with SCANHUB_LOG=debug to see what the hub says",
            ));
        }
        let over = options.run_for.zip(first_sample).is_some_and(|(limit, first)| first.elapsed() >= limit);
        if cut.is_none() && (over || stop.load(Ordering::Relaxed)) {
            // What is on its way now arrives before anybody is stopped.
            cut = Some((now + GRACE, account.cut()));
        }
        if cut.is_some_and(|(end, ())| now >= end) {
            break;
        }
    }
    drop(consumers);
    drop(hub);
    drop(simulator);
    account.read_truth();
    if show {
        view.end(out);
    }
    let lost = account.summary(out, options.json);
    if lost > 0 {
        return Err(Failure::new(Kind::Check, format!("{lost} telegrams were sent and not received"), ""));
    }
    if stop.load(Ordering::Relaxed) && options.run_for.is_some() {
        return Err(Failure::new(Kind::Interrupted, "interrupted before the time was over", ""));
    }
    Ok(())
}

/// Where it all takes place: a domain and a directory of its own, gone afterwards.
struct Stage {
    domain: Domain,
    directory: PathBuf,
}

impl Stage {
    fn new() -> Result<Self, Failure> {
        let name = format!("demo-{}", std::process::id());
        let domain = Domain::of_hub(&name, None, &Environment::of_process())?;
        let directory = std::env::temp_dir().join(format!("scanhub-{name}"));
        std::fs::create_dir_all(&directory).map_err(|error| {
            let message = format!("cannot make {}: {error}", directory.display());
            Failure::new(Kind::Failed, message, "set TMPDIR to a directory that this user may write")
        })?;
        Ok(Stage { domain, directory })
    }

    fn truth(&self) -> PathBuf {
        self.directory.join("truth")
    }

    /// The reading end of what the simulator will tell: a pipe, because a demonstration may run for days.
    fn open_truth(&self) -> Result<File, Failure> {
        let open = || -> io::Result<File> {
            mknodat(CWD, self.truth(), FileType::Fifo, Mode::RUSR | Mode::WUSR, 0)?;
            OpenOptions::new().read(true).custom_flags(OFlags::NONBLOCK.bits() as i32).open(self.truth())
        };
        open().map_err(|error| {
            Failure::new(Kind::Failed, format!("cannot make a pipe {}: {error}", self.truth().display()), "")
        })
    }

    fn port(&self, sensor: &str) -> String {
        self.directory.join(sensor).display().to_string()
    }

    fn start_hub(&self, lines: mpsc::Sender<Line>) -> Result<Child, Failure> {
        let links: Vec<_> = SENSORS.iter().flat_map(|sensor| ["--link".into(), self.link(sensor)]).collect();
        let hub = Child::start(
            &[&["run".into(), "--json".into(), "--no-system-config".into()], &links[..]].concat(),
            self.domain.name(),
            None,
        )?;
        hub.await_ready(HUB, lines)
    }

    fn link(&self, sensor: &str) -> String {
        format!("{sensor}={}", self.port(sensor))
    }

    fn start_consumers(&self, lines: &mpsc::Sender<Line>) -> Result<Vec<Child>, Failure> {
        let start = |(of, sensor): (usize, &&str)| {
            let topics = ["telegram", "scan", "status"].map(|topic| format!("{sensor}/{topic}"));
            let arguments = [&["echo".into(), "--json".into()], &topics[..]].concat();
            Child::start(&arguments, self.domain.name(), Some((of, lines.clone())))
        };
        SENSORS.iter().enumerate().map(start).collect()
    }

    fn start_simulator(&self, seed: u64, lines: mpsc::Sender<Line>) -> Result<Child, Failure> {
        let ports: Vec<_> = SENSORS.iter().flat_map(|sensor| ["--port".into(), self.port(sensor)]).collect();
        let truth = self.truth().display().to_string();
        let rest = ["--truth".into(), truth, "--seed".into(), seed.to_string(), "--json".into()];
        let arguments = [&["simulate".into()], &ports[..], &rest[..]].concat();
        Child::start(&arguments, self.domain.name(), None)?.await_ready(SIMULATOR, lines)
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        // All of it is ours alone: the domain's name has our process id.
        let _ = std::fs::remove_dir_all(&self.directory);
        let _ = std::fs::remove_dir_all(self.domain.root());
        let entries = std::fs::read_dir("/dev/shm").into_iter().flatten().flatten();
        for entry in
            entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&self.domain.prefix()))
        {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

fn ended(of: usize) -> Failure {
    let who = match of {
        HUB => "the hub",
        SIMULATOR => "the simulator",
        _ => "a consumer",
    };
    Failure::new(Kind::Failed, format!("{who} ended early"), "what it said stands above")
}

const SENSORS: [&str; 2] = ["front", "rear"];
/// Number of the hub among the processes; consumers have their sensor's.
const HUB: usize = 100;
const SIMULATOR: usize = 101;
/// Between two pictures.
const REFRESH: Duration = Duration::from_millis(250);
/// Longest wait for a line before the clock is looked at.
const PATIENCE: Duration = Duration::from_millis(50);
/// Processes start and a rate is found in far less.
const START_LIMIT: Duration = Duration::from_secs(10);
/// From the last byte of a telegram to its line of JSON, on a busy machine.
const GRACE: Duration = Duration::from_millis(300);
