//! Where a demonstration takes place, and who takes part: a hub, consumers and simulated sensors, in a domain and a
//! directory that are gone afterwards. Refuses to know what they say.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::PathBuf;
use std::process::Stdio;
use std::sync::mpsc;

use rustix::fs::{CWD, FileType, Mode, OFlags, mknodat};
use schema::{Failure, Family, Kind};
use serde_json::Value;

use super::process::{Child, Line};
use crate::own_domain::OwnDomain;

use super::{Cast, HUB, SIMULATOR, Sensor, TILTED, WEB};

/// A domain and a directory of its own.
pub(super) struct Stage {
    pub(super) domain: OwnDomain,
    pub(super) sensors: Vec<Sensor>,
    cast: Cast,
    directory: PathBuf,
    /// There is a picture on the terminal, into which nobody may write.
    quiet: bool,
}

impl Stage {
    /// `quiet`: what the processes have to say of errors is kept until [`tell_errors`](Self::tell_errors).
    pub(super) fn new(quiet: bool, cast: Cast) -> Result<Stage, Failure> {
        let domain = OwnDomain::new("demo")?;
        let name = domain.name().to_owned();
        let directory = std::env::temp_dir().join(format!("scanhub-{name}"));
        // Not one that is there already: it may be another user's.
        std::fs::DirBuilder::new().mode(0o700).create(&directory).map_err(|error| {
            let message = format!("cannot make {}: {error}", directory.display());
            Failure::new(
                Kind::Failed,
                message,
                "set TMPDIR to a directory that this user may write, or remove what is in the way",
            )
        })?;
        Ok(Stage { domain, sensors: cast.sensors(), cast, directory, quiet })
    }

    /// Says on stderr what was kept.
    pub(super) fn tell_errors(&self) {
        let kept = std::fs::read(self.log()).unwrap_or_default();
        let _ = io::stderr().lock().write_all(&kept);
    }

    fn log(&self) -> PathBuf {
        self.directory.join("log")
    }

    /// Where a process says what goes wrong.
    fn errors(&self) -> Stdio {
        let log = OpenOptions::new().append(true).create(true).open(self.log());
        log.ok().filter(|_| self.quiet).map_or_else(Stdio::inherit, Stdio::from)
    }

    /// The names of the sensors.
    pub(super) fn names(&self) -> Vec<String> {
        self.sensors.iter().map(|sensor| sensor.name.to_owned()).collect()
    }

    /// The families of the sensors: each has a simulator of its own.
    fn families(&self) -> impl Iterator<Item = Family> {
        Family::ALL.into_iter().filter(|family| self.sensors.iter().any(|sensor| sensor.family == *family))
    }

    fn truth(&self, family: Family) -> PathBuf {
        self.directory.join(format!("truth-{}", family.name()))
    }

    /// The reading ends of what the simulators will tell: pipes, because a demonstration may run for days.
    pub(super) fn open_truths(&self) -> Result<Vec<File>, Failure> {
        let open = |path: &PathBuf| -> io::Result<File> {
            mknodat(CWD, path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0)?;
            OpenOptions::new().read(true).custom_flags(OFlags::NONBLOCK.bits() as i32).open(path)
        };
        let pipes = self.families().map(|family| self.truth(family));
        pipes
            .map(|path| {
                open(&path).map_err(|error| {
                    Failure::new(Kind::Failed, format!("cannot make a pipe {}: {error}", path.display()), "")
                })
            })
            .collect()
    }

    fn port(&self, sensor: &str) -> String {
        self.directory.join(sensor).display().to_string()
    }

    pub(super) fn start_hub(&self, lines: mpsc::Sender<Line>) -> Result<Child, Failure> {
        let links = self.sensors.iter().flat_map(|Sensor { name, family, pose }| {
            let set = move |setting: &str| format!("--set=link.{name}.{setting}");
            let link = [
                "--link".into(),
                format!("{name}={}", self.port(name)),
                set(&format!("family={}", family.name())),
            ];
            link.into_iter().chain(pose.iter().map(move |pose| set(pose)))
        });
        let links: Vec<String> = links.collect();
        let hub = Child::start(
            &[&["run".into(), "--json".into(), "--no-system-config".into(), FORGETS.into()], &links[..]]
                .concat(),
            &self.domain,
            &self.directory,
            None,
            self.errors(),
        )?;
        Ok(hub.await_ready(HUB, lines)?.0)
    }

    pub(super) fn start_consumers(&self, lines: &mpsc::Sender<Line>) -> Result<Vec<Child>, Failure> {
        let start = |(of, Sensor { name: sensor, .. }): (usize, &Sensor)| {
            let topics = ["telegram", "scan", "status"].map(|topic| format!("{sensor}/{topic}"));
            let arguments = [&["echo".into(), "--json".into()], &topics[..]].concat();
            Child::start(&arguments, &self.domain, &self.directory, Some((of, lines.clone())), self.errors())
        };
        self.sensors.iter().enumerate().map(start).collect()
    }

    pub(super) fn start_simulators(
        &self,
        seed: u64,
        lines: &mpsc::Sender<Line>,
    ) -> Result<Vec<Child>, Failure> {
        self.families().map(|family| self.start_simulator(family, seed, lines.clone())).collect()
    }

    fn start_simulator(
        &self,
        family: Family,
        seed: u64,
        lines: mpsc::Sender<Line>,
    ) -> Result<Child, Failure> {
        let sensors = self.sensors.iter().filter(|sensor| sensor.family == family);
        let ports: Vec<_> = sensors.flat_map(|sensor| ["--port".into(), self.port(sensor.name)]).collect();
        let truth = self.truth(family).display().to_string();
        let rest = ["--truth".into(), truth, "--seed".into(), seed.to_string(), "--json".into()];
        let world = ["--world".into(), self.cast.world().into(), "--family".into(), family.name().into()];
        let angles = match self.cast {
            Cast::Fixed(_) => Vec::new(),
            Cast::Tilted => vec!["--angles".to_owned(), MOUNT.to_owned()],
        };
        let arguments = [&["simulate".into()], &world[..], &ports[..], &rest[..], &angles[..]].concat();
        let simulator = Child::start(&arguments, &self.domain, &self.directory, None, self.errors())?;
        Ok(simulator.await_ready(SIMULATOR, lines)?.0)
    }

    /// What sees in three dimensions, if a sensor is tilted: once the angles of its mount are there.
    pub(super) fn start_tilted(&self, lines: &mpsc::Sender<Line>) -> Result<Option<Child>, Failure> {
        let Cast::Tilted = self.cast else { return Ok(None) };
        let arguments: Vec<String> = TILTED_VERB.iter().map(|word| (*word).to_owned()).collect();
        let listener = Some((TILTED, lines.clone()));
        Child::start(&arguments, &self.domain, &self.directory, listener, self.errors()).map(Some)
    }

    /// The picture for a browser, and its address.
    pub(super) fn start_web(&self) -> Result<(Child, String), Failure> {
        let arguments = ["web".into(), "--json".into()];
        let web = Child::start(&arguments, &self.domain, &self.directory, None, self.errors())?;
        // Who comes and goes is not told here.
        let (web, ready) = web.await_ready(WEB, mpsc::channel().0)?;
        let ready: Value = serde_json::from_str(&ready).unwrap_or_default();
        match ready["url"].as_str() {
            Some(url) => Ok((web, url.to_owned())),
            None => Err(super::ended(WEB)),
        }
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        // Ours alone: its name has our process id.
        let _ = std::fs::remove_dir_all(&self.directory);
    }
}

/// Who says how the mount stands.
const MOUNT: &str = "mount";
/// Of the mount of world `tilt` (`tests/worlds/tilt.toml`).
const TILTED_VERB: [&str; 11] = [
    "tilt",
    "front",
    "--json",
    "--angles",
    MOUNT,
    "--axis-at",
    "0,0,0.9",
    "--sensor-at",
    "0.06,0,0.94",
    "--as",
    "hall",
];
/// What a demonstration learns is gone with it.
const FORGETS: &str = "--set=background.keep=false";
