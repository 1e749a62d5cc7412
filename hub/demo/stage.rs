//! Where a demonstration takes place, and who takes part: a hub, consumers, a tracker of people and simulated sensors, in a domain and a
//! directory that are gone afterwards. Refuses to know what they say.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::PathBuf;
use std::process::Stdio;
use std::sync::mpsc;

use rustix::fs::{CWD, FileType, Mode, OFlags, mknodat};
use schema::{Failure, Family, Kind};
use serde_json::Value;
use tempfile::TempDir;

use super::process::{Child, Line};
use crate::own_domain::OwnDomain;

use super::cast::{Sensor, World};
use super::{HUB, SIMULATOR, TILTED, TRACKER, WEB};

/// A domain and a directory of its own.
pub(super) struct Stage {
    pub(super) domain: OwnDomain,
    pub(super) world: World,
    pub(super) sensors: Vec<Sensor>,
    directory: TempDir,
    /// There is a picture on the terminal, into which nobody may write.
    quiet: bool,
}

impl Stage {
    /// `quiet`: what the processes have to say of errors is kept until [`tell_errors`](Self::tell_errors).
    pub(super) fn new(quiet: bool, world: World, sensors: Vec<Sensor>) -> Result<Stage, Failure> {
        let domain = OwnDomain::new("demo")?;
        let name = domain.name().to_owned();
        let directory = tempfile::Builder::new().prefix(&format!("scanhub-{name}-")).tempdir();
        let directory = directory.map_err(|error| {
            let message = format!("cannot create a temporary directory: {error}");
            Failure::new(Kind::Failed, message, "set TMPDIR to a directory that this user may write")
        })?;
        Ok(Stage { domain, world, sensors, directory, quiet })
    }

    /// Says on stderr what was kept.
    pub(super) fn tell_errors(&self) {
        let kept = std::fs::read(self.log()).unwrap_or_default();
        let _ = io::stderr().lock().write_all(&kept);
    }

    fn log(&self) -> PathBuf {
        self.directory.path().join("log")
    }

    /// Where a process says what goes wrong.
    fn errors(&self) -> Stdio {
        let log = OpenOptions::new().append(true).create(true).open(self.log());
        log.ok().filter(|_| self.quiet).map_or_else(Stdio::inherit, Stdio::from)
    }

    /// The families of the sensors: each has a simulator of its own.
    fn families(&self) -> impl Iterator<Item = Family> {
        Family::ALL.into_iter().filter(|family| self.sensors.iter().any(|sensor| sensor.family == *family))
    }

    fn truth(&self, family: Family) -> PathBuf {
        self.directory.path().join(format!("truth-{}", family.name()))
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
        self.directory.path().join(sensor).display().to_string()
    }

    pub(super) fn start_hub(&self, lines: mpsc::Sender<Line>) -> Result<Child, Failure> {
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
        let hub = Child::start(
            &[&["run".into(), "--json".into(), "--no-system-config".into(), FORGETS.into()], &links[..]]
                .concat(),
            &self.domain,
            self.directory.path(),
            None,
            self.errors(),
        )?;
        Ok(hub.await_ready(HUB, lines)?.0)
    }

    pub(super) fn start_consumers(&self, lines: &mpsc::Sender<Line>) -> Result<Vec<Child>, Failure> {
        let start = |(of, Sensor { name: sensor, .. }): (usize, &Sensor)| {
            let topics = ["telegram", "scan", "status"].map(|topic| format!("{sensor}/{topic}"));
            let arguments = [&["echo".into(), "--json".into()], &topics[..]].concat();
            Child::start(
                &arguments,
                &self.domain,
                self.directory.path(),
                Some((of, lines.clone())),
                self.errors(),
            )
        };
        self.sensors.iter().enumerate().map(start).collect()
    }

    /// What follows people, where there is a site to follow them in.
    pub(super) fn start_tracker(&self, lines: &mpsc::Sender<Line>) -> Result<Option<Child>, Failure> {
        let Some(site) = self.world.site() else { return Ok(None) };
        let path = self.directory.path().join("site.toml");
        std::fs::write(&path, site).map_err(|error| {
            let hint = "set TMPDIR to a directory that this user may write and that has room";
            Failure::new(Kind::Failed, format!("cannot write {}: {error}", path.display()), hint)
        })?;
        let site = path.display().to_string();
        let arguments = ["track", "--site", &site, "--as", "people", "--delay", DELAY].map(str::to_owned);
        let listener = Some((TRACKER, lines.clone()));
        Child::start(&arguments, &self.domain, self.directory.path(), listener, self.errors()).map(Some)
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
        let ports: Vec<_> = sensors.flat_map(|sensor| ["--port".into(), self.port(&sensor.name)]).collect();
        let truth = self.truth(family).display().to_string();
        let rest = ["--truth".into(), truth, "--seed".into(), seed.to_string(), "--json".into()];
        let world = ["--world".into(), self.world.name().into(), "--family".into(), family.name().into()];
        let angles = if self.world == World::Tilt {
            vec!["--angles".to_owned(), MOUNT.to_owned()]
        } else {
            Vec::new()
        };
        let arguments = [&["simulate".into()], &world[..], &ports[..], &rest[..], &angles[..]].concat();
        let simulator = Child::start(&arguments, &self.domain, self.directory.path(), None, self.errors())?;
        Ok(simulator.await_ready(SIMULATOR, lines)?.0)
    }

    /// What sees in three dimensions, if a sensor is tilted: once the angles of its mount are there.
    pub(super) fn start_tilted(&self, lines: &mpsc::Sender<Line>) -> Result<Option<Child>, Failure> {
        if self.world != World::Tilt {
            return Ok(None);
        }
        let arguments: Vec<String> = TILTED_VERB.iter().map(|word| (*word).to_owned()).collect();
        let listener = Some((TILTED, lines.clone()));
        Child::start(&arguments, &self.domain, self.directory.path(), listener, self.errors()).map(Some)
    }

    /// The picture for a browser, and its address.
    pub(super) fn start_web(&self) -> Result<(Child, String), Failure> {
        let arguments = ["web".into(), "--json".into()];
        let web = Child::start(&arguments, &self.domain, self.directory.path(), None, self.errors())?;
        // Who comes and goes is not told here.
        let (web, ready) = web.await_ready(WEB, mpsc::channel().0)?;
        let ready: Value = serde_json::from_str(&ready).unwrap_or_default();
        match ready["url"].as_str() {
            Some(url) => Ok((web, url.to_owned())),
            None => Err(super::ended(WEB)),
        }
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
/// How long the tracker waits for the scan of a sensor: a machine on which somebody tries things is busy.
const DELAY: &str = "200ms";
/// What a demonstration learns is gone with it.
const FORGETS: &str = "--set=background.keep=false";
