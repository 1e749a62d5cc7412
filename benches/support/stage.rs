//! Where it all takes place: a domain and a directory of its own, gone afterwards, and the processes in it.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use schema::{Domain, Environment};

use super::child::Child;
use super::{Outcome, PART};

/// A domain and a directory.
pub(crate) struct Stage {
    pub(crate) domain: Domain,
    directory: PathBuf,
}

impl Stage {
    /// A new one of this process.
    pub(crate) fn new() -> Outcome<Stage> {
        let stage = Stage::of(std::process::id())?;
        std::fs::create_dir_all(&stage.directory)?;
        Ok(stage)
    }

    fn of(pid: u32) -> Outcome<Stage> {
        let name = format!("bench-{pid}");
        let domain = Domain::of_hub(&name, None, &Environment::of_process())?;
        Ok(Stage { domain, directory: std::env::temp_dir().join(format!("scanhub-{name}")) })
    }

    /// Removes what benches left that were interrupted.
    pub(crate) fn sweep() -> Outcome<()> {
        for entry in std::fs::read_dir(std::env::temp_dir())? {
            let name = entry?.file_name().to_string_lossy().into_owned();
            let pid = name.strip_prefix("scanhub-bench-").and_then(|pid| pid.parse().ok());
            if let Some(pid) = pid.filter(|pid| !Path::new(&format!("/proc/{pid}")).exists()) {
                drop(Stage::of(pid)?);
            }
        }
        Ok(())
    }

    /// A file that parts may agree upon.
    pub(crate) fn file(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    /// The file with the truth.
    pub(crate) fn truth(&self) -> PathBuf {
        self.directory.join("truth")
    }

    /// Where the pty of `sensor` appears.
    pub(crate) fn port(&self, sensor: &str) -> String {
        self.directory.join(sensor).display().to_string()
    }

    /// Sensors at the other end of ptys, idle, at `rate`.
    pub(crate) fn simulate(&self, sensors: &[&str], rate: u32) -> Outcome<Child> {
        self.simulator(sensors, &self.truth(), &["--baud", &rate.to_string()])
    }

    /// Sensors that stream at 500 kBd to whoever opens their ptys, in a simulator of their own that writes no truth.
    pub(crate) fn simulate_streaming(&self, sensors: &[&str]) -> Outcome<Child> {
        self.simulate_as(sensors, &["--baud", "500000", "--state", "streaming"])
    }

    /// Sensors at the other end of ptys, as `flags` say, in a simulator of their own that writes no truth.
    pub(crate) fn simulate_as(&self, sensors: &[&str], flags: &[&str]) -> Outcome<Child> {
        self.simulator(sensors, Path::new("/dev/null"), flags)
    }

    /// A sensor in a simulator of its own, as `flags` say, with its truth in [`Stage::own_truth`].
    pub(crate) fn simulate_one(&self, sensor: &str, flags: &[&str]) -> Outcome<Child> {
        self.simulator(&[sensor], &self.own_truth(sensor), flags)
    }

    /// The file with the truth of a sensor that has a simulator of its own.
    pub(crate) fn own_truth(&self, sensor: &str) -> PathBuf {
        self.directory.join(format!("truth-{sensor}"))
    }

    fn simulator(&self, sensors: &[&str], truth: &Path, flags: &[&str]) -> Outcome<Child> {
        let truth = truth.display().to_string();
        let mut words: Vec<String> = ["simulate", "--seed", "1", "--truth", &truth]
            .iter()
            .chain(flags)
            .map(|word| word.to_string())
            .collect();
        words.extend(sensors.iter().flat_map(|sensor| ["--port".into(), self.port(sensor)]));
        let child = Child::start(PROGRAM, &words)?;
        child.await_line("ready", PATIENCE)?;
        Ok(child)
    }

    /// The hub; its first line says that it is up.
    pub(crate) fn hub(&self, sensors: &[&str]) -> Outcome<Child> {
        self.hub_of(PROGRAM, sensors)
    }

    /// The hub with places for a crowd.
    pub(crate) fn hub_for_crowd(&self, sensors: &[&str]) -> Outcome<Child> {
        let mut command = self.hub_command(PROGRAM, sensors);
        command.arg(format!("--set=limits.consumers={CROWD}"));
        Child::of(command, Stdio::null())
    }

    /// The hub of another build of the program.
    pub(crate) fn hub_of(&self, program: &str, sensors: &[&str]) -> Outcome<Child> {
        Child::of(self.hub_command(program, sensors), Stdio::null())
    }

    /// What starts the hub.
    pub(crate) fn hub_command(&self, program: &str, sensors: &[&str]) -> Command {
        let mut command = Command::new(program);
        command.args(["run", "--domain", self.domain.name()]);
        // What it keeps goes with the stage.
        command.env("XDG_STATE_HOME", &self.directory).env_remove("STATE_DIRECTORY");
        sensors.iter().for_each(|sensor| {
            command.args(["--link", &format!("{sensor}={}", self.port(sensor))]);
        });
        command
    }

    /// This program as a consumer of `topic`, with more `words`.
    pub(crate) fn consumer(&self, topic: &str, sensor: &str, words: &[&str]) -> Outcome<Child> {
        self.part(&[&["consume", topic, self.domain.name(), sensor], words].concat())
    }

    /// This program as the floor that reads `count` telegrams from each port.
    pub(crate) fn bare(&self, sensors: &[&str], count: usize) -> Outcome<Child> {
        let ports: Vec<String> = sensors.iter().map(|sensor| self.port(sensor)).collect();
        let mut words: Vec<&str> = ports.iter().map(String::as_str).collect();
        let count = count.to_string();
        words.splice(0..0, ["bare", &count]);
        self.part(&words)
    }

    /// This program in one of its parts.
    pub(crate) fn part(&self, words: &[&str]) -> Outcome<Child> {
        let words: Vec<String> = std::iter::once(&PART).chain(words).map(|word| word.to_string()).collect();
        Child::start(&std::env::current_exe()?.display().to_string(), &words)
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        // All of it is ours alone: the domain's name has our process id.
        let _ = std::fs::remove_dir_all(&self.directory);
        let _ = std::fs::remove_dir_all(self.domain.root());
        let entries = std::fs::read_dir("/dev/shm").into_iter().flatten().flatten();
        let prefix = self.domain.prefix();
        for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix)) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// The two sensors of a vehicle.
pub(crate) const SENSORS: [&str; 2] = ["front", "rear"];
/// Consumers of a topic that [`Stage::hub_for_crowd`] has places for.
pub(crate) const CROWD: usize = 200;
/// Far longer than anything takes.
pub(crate) const PATIENCE: Duration = Duration::from_secs(20);
/// The program of this build.
pub(crate) const PROGRAM: &str = env!("CARGO_BIN_EXE_scanhub");
