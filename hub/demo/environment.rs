//! Processes of a demonstration: a hub, subscribers, a people tracker and simulators. They run in a temporary domain
//! and directory.

use std::fs::OpenOptions;
use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child as Process, ChildStdout, Command, Stdio};
use std::sync::mpsc::{self, Sender};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use scanhub_schema::{Failure, Family, Kind};
use serde_json::Value;
use tempfile::TempDir;

use super::participants::{Sensor, World};
use super::{HUB, SIMULATOR, TILTED, TRACKER, WEB};
use crate::private_domain::PrivateDomain;

/// Domain, directory and settings of all processes.
pub(super) struct DemoEnvironment {
    pub(super) domain: PrivateDomain,
    pub(super) world: World,
    pub(super) sensors: Vec<Sensor>,
    directory: TempDir,
    /// Whether the processes write errors to a file, because the terminal shows a picture.
    quiet: bool,
}

impl DemoEnvironment {
    /// Creates the domain and the directory. With `quiet`, errors of the processes are kept until
    /// [`print_errors`](Self::print_errors).
    pub(super) fn new(quiet: bool, world: World, sensors: Vec<Sensor>) -> Result<DemoEnvironment, Failure> {
        let domain = PrivateDomain::new("demo")?;
        let name = domain.name().to_owned();
        let directory = tempfile::Builder::new().prefix(&format!("scanhub-{name}-")).tempdir();
        let directory = directory.map_err(|error| {
            let message = format!("cannot create a temporary directory: {error}");
            Failure::new(Kind::Failed, message, "set TMPDIR to a directory that this user may write")
        })?;
        Ok(DemoEnvironment { domain, world, sensors, directory, quiet })
    }

    /// Prints the errors that were kept because of `quiet`.
    pub(super) fn print_errors(&self) {
        let errors = std::fs::read(self.log()).unwrap_or_default();
        let _ = io::stderr().lock().write_all(&errors);
    }

    fn log(&self) -> PathBuf {
        self.directory.path().join("log")
    }

    /// Starts this program with `arguments` in the domain. If there is a `listener`, sends each line of the child to
    /// it, with the child's number.
    fn start(
        &self,
        arguments: &[String],
        listener: Option<(usize, Sender<ChildEvent>)>,
    ) -> Result<Child, Failure> {
        let failed = |error: io::Error| {
            Failure::new(Kind::Failed, format!("cannot start scanhub {}: {error}", arguments.join(" ")), "")
        };
        let log = OpenOptions::new().append(true).create(true).open(self.log());
        let errors = log.ok().filter(|_| self.quiet).map_or_else(Stdio::inherit, Stdio::from);
        let (root, program) = (self.domain.root(), std::env::current_exe().map_err(failed)?);
        let mut process = Command::new(program)
            .args(arguments)
            .args(["--domain", self.domain.name(), "--root"])
            .arg(root.parent().unwrap_or(root))
            .env("SCANHUB_LOG", std::env::var("SCANHUB_LOG").unwrap_or("error".into()))
            .env(crate::END_WITH_PARENT, "1")
            .env("STATE_DIRECTORY", self.directory.path())
            // Ctrl-C must reach only the demonstration, which ends its children in the right order.
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

    /// Returns the families of the sensors. Each family has one simulator.
    fn families(&self) -> impl Iterator<Item = Family> {
        Family::ALL.into_iter().filter(|family| self.sensors.iter().any(|sensor| sensor.family == *family))
    }

    fn port(&self, sensor: &str) -> String {
        self.directory.path().join(sensor).display().to_string()
    }

    pub(super) fn start_hub(&self, lines: Sender<ChildEvent>) -> Result<Child, Failure> {
        let links = self.sensors.iter().flat_map(|Sensor { name, family, pose: [x, y, yaw] }| {
            let set = |setting: &str| format!("--set=link.{name}.{setting}");
            [
                "--link".into(),
                format!("{name}={}", self.port(name)),
                set(&format!("family={}", family.name())),
                set(&format!("pose.x={x}")),
                set(&format!("pose.y={y}")),
                set(&format!("pose.yaw={yaw}")),
            ]
        });
        let settings = self.world.settings().iter().map(|setting| format!("--set={setting}"));
        let links: Vec<String> = links.chain(settings).collect();
        let run = ["run", "--json", "--no-system-config", NO_BACKGROUND_SETTING].map(str::to_owned);
        Ok(self.start(&[&run, &links[..]].concat(), None)?.await_ready(HUB, lines)?.0)
    }

    pub(super) fn start_subscribers(&self, lines: &Sender<ChildEvent>) -> Result<Vec<Child>, Failure> {
        let start = |(of, Sensor { name: sensor, .. }): (usize, &Sensor)| {
            let topics = ["telegram", "scan", "status"].map(|topic| format!("{sensor}/{topic}"));
            let arguments = [&["echo".into(), "--json".into()], &topics[..]].concat();
            self.start(&arguments, Some((of, lines.clone())))
        };
        self.sensors.iter().enumerate().map(start).collect()
    }

    /// Starts the people tracker, if the world has a site.
    pub(super) fn start_tracker(&self, lines: &Sender<ChildEvent>) -> Result<Option<Child>, Failure> {
        let Some(site) = self.world.site() else { return Ok(None) };
        let path = self.directory.path().join("site.toml");
        std::fs::write(&path, site).map_err(|error| {
            let hint = "set TMPDIR to a directory that this user may write and that has room";
            Failure::new(Kind::Failed, format!("cannot write {}: {error}", path.display()), hint)
        })?;
        let site = path.display().to_string();
        let arguments =
            ["track", "--site", &site, "--as", "people", "--delay", TRACKER_DELAY].map(str::to_owned);
        self.start(&arguments, Some((TRACKER, lines.clone()))).map(Some)
    }

    pub(super) fn start_simulators(
        &self,
        seed: u64,
        lines: &Sender<ChildEvent>,
    ) -> Result<Vec<Child>, Failure> {
        self.families().map(|family| self.start_simulator(family, seed, lines.clone())).collect()
    }

    fn start_simulator(
        &self,
        family: Family,
        seed: u64,
        lines: Sender<ChildEvent>,
    ) -> Result<Child, Failure> {
        let sensors = self.sensors.iter().filter(|sensor| sensor.family == family);
        let ports: Vec<_> = sensors.flat_map(|sensor| ["--port".into(), self.port(&sensor.name)]).collect();
        let rest = ["--truth".into(), "-".into(), "--seed".into(), seed.to_string(), "--json".into()];
        let world = ["--world".into(), self.world.name().into(), "--family".into(), family.name().into()];
        let angles = if self.world == World::Tilt {
            vec!["--angles".to_owned(), MOUNT_NAME.to_owned()]
        } else {
            Vec::new()
        };
        let arguments = [&["simulate".into()], &world[..], &ports[..], &rest[..], &angles[..]].concat();
        Ok(self.start(&arguments, None)?.await_ready(SIMULATOR, lines)?.0)
    }

    /// Starts `scanhub tilt`, if the sensor is on a mount. The topic with the mount's angles must exist.
    pub(super) fn start_tilt(&self, lines: &Sender<ChildEvent>) -> Result<Option<Child>, Failure> {
        if self.world != World::Tilt {
            return Ok(None);
        }
        self.start(&TILT_ARGUMENTS.map(str::to_owned), Some((TILTED, lines.clone()))).map(Some)
    }

    /// Starts the server of the page for browsers. Also returns the address of the page.
    pub(super) fn start_web(&self) -> Result<(Child, String), Failure> {
        let web = self.start(&["web".into(), "--json".into()], None)?;
        let (web, ready) = web.await_ready(WEB, mpsc::channel().0)?;
        let ready: Value = serde_json::from_str(&ready).unwrap_or_default();
        match ready["url"].as_str() {
            Some(url) => Ok((web, url.to_owned())),
            None => Err(super::ended(WEB)),
        }
    }
}

/// Event of a child process. `child` is the number of the child.
#[derive(Debug)]
pub(super) enum ChildEvent {
    /// The child printed a line.
    Line { child: usize, text: String },
    /// The child closed its standard output.
    Ended { child: usize },
}

/// Child process that runs a verb of this program. Dropping it ends the process.
#[derive(Debug)]
pub(super) struct Child {
    process: Process,
}

impl Child {
    /// Waits for the first line, which reports that the child is ready, and returns it. Sends later lines to `lines`.
    pub(super) fn await_ready(
        mut self,
        of: usize,
        lines: Sender<ChildEvent>,
    ) -> Result<(Child, String), Failure> {
        let mut first = String::new();
        if let Some(stdout) = self.process.stdout.take() {
            let mut stdout = BufReader::new(stdout);
            let _ = stdout.read_line(&mut first);
            forward(stdout, of, lines);
        }
        if first.is_empty() { Err(super::ended(of)) } else { Ok((self, first)) }
    }

    /// Returns the process ID.
    pub(super) fn pid(&self) -> u32 {
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

fn forward(stdout: BufReader<ChildStdout>, of: usize, lines: Sender<ChildEvent>) {
    thread::spawn(move || {
        for text in stdout.lines().map_while(Result::ok) {
            // Continue to read without a receiver, because a closed pipe would end the child at its next line.
            let _ = lines.send(ChildEvent::Line { child: of, text });
        }
        let _ = lines.send(ChildEvent::Ended { child: of });
    });
}

/// Name under which the simulator publishes the angles of the mount.
const MOUNT_NAME: &str = "mount";
/// Arguments with the geometry of the mount in world `tilt` (`tests/worlds/tilt.toml`).
const TILT_ARGUMENTS: [&str; 11] = [
    "tilt",
    "front",
    "--json",
    "--angles",
    MOUNT_NAME,
    "--axis-at",
    "0,0,0.9",
    "--sensor-at",
    "0.06,0,0.94",
    "--as",
    "hall",
];
/// Maximum time that the tracker waits for the scan of a sensor. Longer than the default, because the machine may be
/// busy.
const TRACKER_DELAY: &str = "200ms";
/// Setting with which the hub saves no background, because its directory is removed with the demonstration.
const NO_BACKGROUND_SETTING: &str = "--set=background.keep=false";
