//! Environment of a bench: its own domain, its own directory, and the processes that run in this domain. The bench
//! reads the output of these processes line by line. However the bench ends, it ends the processes by their IDs.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child as Process, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use scanhub_shm::{Domain, Environment};

use super::{Outcome, PART_WORD, clock};

/// A domain and a directory of this process. Both are removed when this value is dropped.
pub(crate) struct BenchEnvironment {
    pub(crate) domain: Domain,
    directory: PathBuf,
}

impl BenchEnvironment {
    /// Creates the domain and the directory of this process.
    pub(crate) fn new() -> Outcome<BenchEnvironment> {
        BenchEnvironment::create(&std::process::id().to_string())
    }

    /// Creates the domain and the directory with the number `number` of this process, for a bench that needs several of
    /// them.
    pub(crate) fn numbered(number: usize) -> Outcome<BenchEnvironment> {
        BenchEnvironment::create(&format!("{}-{number}", std::process::id()))
    }

    fn create(owner: &str) -> Outcome<BenchEnvironment> {
        let environment = BenchEnvironment::open_existing(owner)?;
        std::fs::create_dir_all(&environment.directory)?;
        Ok(environment)
    }

    fn open_existing(owner: &str) -> Outcome<BenchEnvironment> {
        let name = format!("bench-{owner}");
        let domain = Domain::of_hub(&name, None, &Environment::of_process())?;
        Ok(BenchEnvironment { domain, directory: std::env::temp_dir().join(format!("scanhub-{name}")) })
    }

    /// Removes the files that interrupted benches have left.
    pub(crate) fn remove_leftovers() -> Outcome<()> {
        for entry in std::fs::read_dir(std::env::temp_dir())? {
            let name = entry?.file_name().to_string_lossy().into_owned();
            let Some(owner) = name.strip_prefix("scanhub-bench-") else { continue };
            let pid = owner.split('-').next().and_then(|pid| pid.parse::<u32>().ok());
            if pid.is_some_and(|pid| !Path::new(&format!("/proc/{pid}")).exists()) {
                drop(BenchEnvironment::open_existing(owner)?);
            }
        }
        Ok(())
    }

    /// Returns the path of the file `name` in the directory of this environment.
    pub(crate) fn file(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    /// Returns the path of the log in which the simulator records what it has sent.
    pub(crate) fn truth(&self) -> PathBuf {
        self.directory.join("truth")
    }

    /// Returns the path at which the simulator creates the pty of `sensor`.
    pub(crate) fn port(&self, sensor: &str) -> String {
        self.directory.join(sensor).display().to_string()
    }

    /// Starts a simulator with idle sensors at ptys, at the baud rate `rate`.
    pub(crate) fn simulate(&self, sensors: &[&str], rate: u32) -> Outcome<Child> {
        self.simulator(sensors, Some(&self.truth()), &["--baud", &rate.to_string()])
    }

    /// Starts a simulator with sensors that stream at 500 kBd to any program that opens their ptys. The simulator
    /// writes no log.
    pub(crate) fn simulate_streaming(&self, sensors: &[&str]) -> Outcome<Child> {
        self.simulate_as(sensors, &["--baud", "500000", "--state", "streaming"])
    }

    /// Starts a simulator with sensors at ptys and more `flags`. The simulator writes no log.
    pub(crate) fn simulate_as(&self, sensors: &[&str], flags: &[&str]) -> Outcome<Child> {
        self.simulator(sensors, None, flags)
    }

    /// Starts a simulator with one sensor and more `flags`. The simulator writes a log to
    /// [`BenchEnvironment::own_truth`].
    pub(crate) fn simulate_one(&self, sensor: &str, flags: &[&str]) -> Outcome<Child> {
        self.simulator(&[sensor], Some(&self.own_truth(sensor)), flags)
    }

    /// Returns the path of the log for a sensor that has its own simulator.
    pub(crate) fn own_truth(&self, sensor: &str) -> PathBuf {
        self.directory.join(format!("truth-{sensor}"))
    }

    fn simulator(&self, sensors: &[&str], truth: Option<&Path>, flags: &[&str]) -> Outcome<Child> {
        let mut words: Vec<String> =
            ["simulate", "--seed", "1"].iter().chain(flags).map(|word| word.to_string()).collect();
        words.extend(truth.iter().flat_map(|truth| ["--truth".into(), truth.display().to_string()]));
        words.extend(sensors.iter().flat_map(|sensor| ["--port".into(), self.port(sensor)]));
        let child = Child::start(PROGRAM, &words)?;
        child.wait_for_line("ready", STEP_TIMEOUT)?;
        Ok(child)
    }

    /// Starts the hub. The first line that the hub prints is `ready`.
    pub(crate) fn start_hub(&self, sensors: &[&str]) -> Outcome<Child> {
        Child::spawn(self.hub_command(PROGRAM, sensors), Stdio::null())
    }

    /// Starts the hub with slots for [`MAX_SUBSCRIBERS`] subscribers.
    pub(crate) fn hub_with_many_slots(&self, sensors: &[&str]) -> Outcome<Child> {
        let mut command = self.hub_command(PROGRAM, sensors);
        command.arg(format!("--set=limits.subscribers={MAX_SUBSCRIBERS}"));
        Child::spawn(command, Stdio::null())
    }

    /// Returns the command that starts `program` as a hub with these sensors.
    pub(crate) fn hub_command(&self, program: &str, sensors: &[&str]) -> Command {
        self.hub_command_on(self, program, sensors)
    }

    /// Returns the command that starts `program` as a hub in this domain, with the sensors of the environment `lines`.
    pub(crate) fn hub_command_on(
        &self,
        lines: &BenchEnvironment,
        program: &str,
        sensors: &[&str],
    ) -> Command {
        let mut command = Command::new(program);
        command.args(["run", "--domain", self.domain.name()]);
        // The hub saves its state in the directory of this environment, which is removed in the end.
        command.env("XDG_STATE_HOME", &self.directory).env_remove("STATE_DIRECTORY");
        sensors.iter().for_each(|sensor| {
            // Set the family, because a search would need additional time and shared memory.
            command.args(["--link", &format!("{sensor}={},family=lms", lines.port(sensor))]);
        });
        command
    }

    /// Starts this program as a subscriber to `topic`, with the further arguments `words`.
    pub(crate) fn start_subscriber(&self, topic: &str, sensor: &str, words: &[&str]) -> Outcome<Child> {
        self.start_part(&[&["consume", topic, self.domain.name(), sensor], words].concat())
    }

    /// Starts this program as the baseline. The baseline reads `count` telegrams from each port. It wakes up
    /// `wake_ahead_ns` nanoseconds before the expected end of each telegram. If `wake_ahead_ns` is 0, it wakes up as
    /// long before the end as the hub does.
    pub(crate) fn start_baseline(
        &self,
        sensors: &[&str],
        count: usize,
        wake_ahead_ns: u64,
    ) -> Outcome<Child> {
        let ports: Vec<String> = sensors.iter().map(|sensor| self.port(sensor)).collect();
        let mut words: Vec<&str> = ports.iter().map(String::as_str).collect();
        let (count, lead) = (count.to_string(), wake_ahead_ns.to_string());
        words.splice(0..0, ["bare", &count, &lead]);
        self.start_part(&words)
    }

    /// Starts this program as one of its parts, which `words` name.
    pub(crate) fn start_part(&self, words: &[&str]) -> Outcome<Child> {
        let words: Vec<String> =
            std::iter::once(&PART_WORD).chain(words).map(|word| word.to_string()).collect();
        Child::start(&std::env::current_exe()?.display().to_string(), &words)
    }
}

impl Drop for BenchEnvironment {
    fn drop(&mut self) {
        // The domain's name contains the ID of this process, so no other bench uses these files.
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
/// The sensors of a vehicle that has one sensor on each side.
pub(crate) const ALL_AROUND: [&str; 4] = ["front", "rear", "left", "right"];
/// Number of slots for subscribers to a topic with [`BenchEnvironment::hub_with_many_slots`].
pub(crate) const MAX_SUBSCRIBERS: usize = 200;
/// Timeout of a step. It is far longer than any step takes.
pub(crate) const STEP_TIMEOUT: Duration = Duration::from_secs(20);
/// The program of this build.
pub(crate) const PROGRAM: &str = env!("CARGO_BIN_EXE_scanhub");

/// A process that is ended when this value is dropped.
pub(crate) struct GuardedProcess(Process);

impl GuardedProcess {
    /// Guards a process that was started.
    pub(crate) fn new(process: Process) -> GuardedProcess {
        GuardedProcess(process)
    }

    /// Returns the process ID.
    pub(crate) fn pid(&self) -> u32 {
        self.0.id()
    }

    /// Kills the process, as a crash would end it. Fails if the process has already ended.
    pub(crate) fn kill(mut self) -> Outcome<()> {
        if let Some(status) = self.0.try_wait()? {
            return Err(format!("process {} ended early: {status}", self.pid()).into());
        }
        self.0.kill()?;
        self.wait()
    }

    /// Waits until the process has ended.
    pub(crate) fn wait(mut self) -> Outcome<()> {
        self.0.wait()?;
        Ok(())
    }
}

impl Drop for GuardedProcess {
    fn drop(&mut self) {
        if let (Ok(None), Some(pid)) = (self.0.try_wait(), Pid::from_raw(self.0.id() as i32)) {
            let _ = kill_process(pid, Signal::TERM);
        }
        let deadline = Instant::now() + Duration::from_secs(2);
        while let Ok(None) = self.0.try_wait() {
            if Instant::now() > deadline {
                let _ = self.0.kill();
                let _ = self.0.wait();
                return;
            }
            thread::sleep(Duration::from_millis(1));
        }
    }
}

/// A guarded process with the lines that it prints.
pub(crate) struct Child {
    pub(crate) guard: GuardedProcess,
    lines: Receiver<OutputLine>,
    /// Time of CLOCK_MONOTONIC just before the start of the process.
    pub(crate) started_ns: u64,
}

/// A line that a process printed, with the time at which it was read.
#[derive(Clone, Debug)]
pub(crate) struct OutputLine {
    pub(crate) at_ns: u64,
    pub(crate) text: String,
}

impl OutputLine {
    /// Returns the words of the line.
    pub(crate) fn words(&self) -> Vec<&str> {
        self.text.split_whitespace().collect()
    }

    /// Returns the word with index `i` as a number.
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
        Child::spawn(command, Stdio::null())
    }

    /// Starts `command` with this stdin.
    pub(crate) fn spawn(mut command: Command, stdin: Stdio) -> Outcome<Child> {
        command.stdin(stdin).stdout(Stdio::piped());
        // The child ends with this process, and logs only errors.
        command.env("SCANHUB_END_WITH_PARENT", "1").env("SCANHUB_LOG", "error");
        let started_ns = clock::now();
        let mut process = command.spawn()?;
        let stdout = process.stdout.take();
        let guard = GuardedProcess::new(process);
        let stdout = BufReader::new(stdout.ok_or("no pipe")?);
        let (send, lines) = channel();
        thread::spawn(move || {
            for text in stdout.lines().map_while(Result::ok) {
                if send.send(OutputLine { at_ns: clock::now(), text }).is_err() {
                    return;
                }
            }
        });
        Ok(Child { guard, lines, started_ns })
    }

    /// Waits for the next line that begins with `word`, and returns it. Drops the lines before it.
    pub(crate) fn wait_for_line(&self, word: &str, timeout: Duration) -> Outcome<OutputLine> {
        let end = Instant::now() + timeout;
        loop {
            match self.lines.recv_timeout(end.saturating_duration_since(Instant::now())) {
                Ok(line) if line.text.starts_with(word) => return Ok(line),
                Ok(_) => {}
                Err(_) => return Err(format!("no line {word:?} arrived").into()),
            }
        }
    }

    /// Waits for the next line, and returns it.
    pub(crate) fn next_line(&self, timeout: Duration) -> Outcome<OutputLine> {
        self.lines.recv_timeout(timeout).map_err(|_| "no line arrived".into())
    }

    /// Waits for a line that equals `word`, and returns all lines that arrive before it.
    pub(crate) fn lines_until(&self, word: &str, timeout: Duration) -> Outcome<Vec<OutputLine>> {
        let end = Instant::now() + timeout;
        let mut lines = Vec::new();
        loop {
            match self.lines.recv_timeout(end.saturating_duration_since(Instant::now())) {
                Ok(line) if line.text == word => return Ok(lines),
                Ok(line) => lines.push(line),
                Err(_) => return Err(format!("no line {word:?} arrived after {} lines", lines.len()).into()),
            }
        }
    }

    /// Returns the lines that have arrived since the last call, without waiting.
    pub(crate) fn lines_so_far(&self) -> Vec<OutputLine> {
        self.lines.try_iter().collect()
    }
}
