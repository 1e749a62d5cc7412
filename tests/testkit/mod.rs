//! Environment for tests of the program: each test has its own domain, directory and child processes, which are removed
//! when the test ends, even if it fails.
//!
//! Tests do not sleep for a fixed time. They wait until a program prints a line or reaches a state, with a timeout that
//! is much longer than needed.
#![allow(dead_code, unused_imports)] // Each test binary uses only a part of this module.

mod child;
mod findings;
mod line;
mod machine;
mod network;
mod program;
mod python;
mod receiver;
mod recording;
mod relay;
mod rerun;
mod robot;
mod sender;
mod side_by_side;
mod skip;
#[cfg(target_arch = "x86_64")]
pub(crate) mod steps;
mod supervisor;
mod telegrams;
mod terminal;
mod tmux;

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use scanhub_shm::Domain;
use serde_json::Value;
use tempfile::TempDir;

pub(crate) use child::{Child, end_runs_of, output, spawn, status, succeeds, write_program};
pub(crate) use findings::Findings;
pub(crate) use line::{TestLine, open_line};
pub(crate) use machine::{Machine, command_in, ip};
pub(crate) use network::in_a_network;
pub(crate) use program::{HUP, INT, KILL, Outcome, Program, TERM, USR1};
pub(crate) use python::{client_python, python, python_for};
pub(crate) use receiver::{Receiver, decode_datagram};
pub(crate) use recording::{RecordedMessage, Recording, contiguous_topic_seqs};
pub(crate) use relay::Relay;
pub(crate) use rerun::{in_own_process, own_program, rerun_test, single_test_args};
pub(crate) use robot::Robot;
pub(crate) use sender::{TestGateway, wall_ns};
pub(crate) use side_by_side::run_concurrently;
pub(crate) use skip::{skip, verdict as skip_verdict};
pub(crate) use supervisor::Supervisor;
pub(crate) use telegrams::{
    MEASURED_VALUES, SimulatedTelegram, bytes_of, checked_topic_seqs, contiguous_numbers, hash, is_class,
    number, scan,
};
pub(crate) use terminal::{TerminalSession, can_open_terminal, terminal};
pub(crate) use tmux::Tmux;

/// Timeout of every wait. A wait lasts this long only in a test that hangs: no test depends on how long something
/// takes.
pub(crate) const WAIT_TIMEOUT: Duration = Duration::from_secs(180);

/// Flag of `simulate` with which scanners take as long to reply as real ones.
pub(crate) const REAL_REPLY_TIME: &str = "--fault=answer=0";
/// Flag of `simulate` with which scanners reply after 5 ms.
const SHORT_REPLY_TIME: &str = "--fault=answer=0.005";

/// Variable with the path of the program. A test that hides the directory with the program sets this variable.
pub(crate) const PROGRAM_PATH_VARIABLE: &str = "SCANHUB_TEST_PROGRAM";

/// Domain and directory of one test. Dropping it removes the directory and the shared memory of the domain.
pub(crate) struct TestEnv {
    directory: TempDir,
    domain: String,
    /// Network namespace in which its programs run; `None` for the test's own namespace.
    network: Option<PathBuf>,
}

impl TestEnv {
    /// Creates an environment with a unique domain.
    pub(crate) fn new() -> TestEnv {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let domain = format!("t{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        // The directory is in `/tmp` instead of TMPDIR, because the root and the prefix of a domain must be short.
        let mut builder = tempfile::Builder::new();
        builder.prefix(&domain).rand_bytes(4).permissions(Permissions::from_mode(0o755));
        let directory = builder
            .tempdir_in("/tmp")
            .unwrap_or_else(|error| panic!("cannot create a directory in /tmp: {error}"));
        TestEnv { directory, domain, network: None }
    }

    /// Creates an environment whose programs run on `machine`.
    pub(crate) fn on(machine: &Machine) -> TestEnv {
        let mut env = TestEnv::new();
        env.network = Some(machine.network());
        env
    }

    /// Returns the domain of this environment, for subscribers in the test process.
    pub(crate) fn domain(&self) -> Domain {
        Domain::at(&self.domain, self.directory.path()).unwrap_or_else(|failure| panic!("{failure}"))
    }

    /// Returns the path of the file `name` in the directory of the test.
    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Returns the path of the file `name` in the directory of the test, as an argument of a program.
    pub(crate) fn path_argument(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }

    /// Writes a file of this test and returns its path as an argument.
    pub(crate) fn file(&self, name: &str, content: impl AsRef<[u8]>) -> String {
        fs::write(self.path(name), content).unwrap_or_else(|error| panic!("{name}: {error}"));
        self.path_argument(name)
    }

    /// Returns the flag `--link=NAME=PORT` for a port called `name` in this directory.
    pub(crate) fn link(&self, name: &str) -> String {
        format!("--link={name}={}", self.path_argument(name))
    }

    /// Returns the flag for a link with `family = "lms"`. Without a family, the hub would search for the scanner and
    /// send additional requests.
    pub(crate) fn lms_link(&self, name: &str) -> String {
        format!("{},family=lms", self.link(name))
    }

    /// Returns a command that runs the program with `arguments` in this domain.
    pub(crate) fn command<S: AsRef<str>>(&self, arguments: &[S]) -> Command {
        self.command_at(self.directory.path(), arguments)
    }

    /// Returns the command that [`TestEnv::command`] returns, but with the domain in the directory `root`.
    pub(crate) fn command_at<S: AsRef<str>>(&self, root: &Path, arguments: &[S]) -> Command {
        let program = std::env::var(PROGRAM_PATH_VARIABLE).unwrap_or_else(|_| scanhub().into());
        let mut command = match &self.network {
            Some(network) => command_in(network, &program),
            None => Command::new(program),
        };
        command.args(arguments.iter().map(AsRef::as_ref));
        // `web --replay` runs its own hub in its own domain.
        let mut words = arguments.iter().map(AsRef::as_ref);
        if !(words.next() == Some("web") && words.any(|word| word == "--replay")) {
            command.args(["--domain", &self.domain, "--root"]).arg(root);
        }
        // If the test itself is killed, its children exit too.
        command.env("SCANHUB_END_WITH_PARENT", "1").env("SCANHUB_LOG", "info").env_remove("SCANHUB_CONFIG");
        // The program saves its state in the directory of the test, not in the user's home directory.
        command.env("XDG_STATE_HOME", self.path("state")).env_remove("STATE_DIRECTORY");
        command
    }

    /// Starts the program with `arguments` in this domain.
    pub(crate) fn start<S: AsRef<str>>(&self, arguments: &[S]) -> Program {
        Program::start(self.command(arguments))
    }

    /// Runs the program with `arguments` until it exits.
    pub(crate) fn run<S: AsRef<str>>(&self, arguments: &[S]) -> Outcome {
        self.start(arguments).wait()
    }

    /// Starts a hub with these flags, and waits until it is ready.
    pub(crate) fn hub<S: AsRef<str>>(&self, flags: &[S]) -> Program {
        self.start(&concat_args(&["run", "--json"], flags)).ready()
    }

    /// Creates a service manager with its socket in this directory.
    pub(crate) fn supervisor(&self) -> Supervisor {
        Supervisor::new(self.path_argument("notify"))
    }

    /// Starts a hub with these flags as a service of `supervisor`, with the descriptor that `supervisor` has stored.
    /// Does not wait until the hub is ready.
    pub(crate) fn service<S: AsRef<str>>(
        &self,
        supervisor: &mut Supervisor,
        flags: &[S],
        watchdog: Option<Duration>,
    ) -> Program {
        let (command, stdin) =
            supervisor.service(&self.command(&concat_args(&["run", "--json"], flags)), watchdog);
        Program::start_with(command, stdin)
    }

    /// Starts a gateway with these flags, and waits for its line of class `gateway`. The gateway saves the number of
    /// its run in this directory.
    pub(crate) fn gateway<S: AsRef<str>>(&self, flags: &[S]) -> Program {
        let mut gateway = self.start_gateway(flags);
        gateway.await_line("line of class gateway", is_class("gateway"));
        gateway
    }

    /// Starts a gateway like [`TestEnv::gateway`], but does not wait for a line.
    pub(crate) fn start_gateway<S: AsRef<str>>(&self, flags: &[S]) -> Program {
        self.start(&concat_args(&["gateway", "--json", "--no-system-config"], flags))
    }

    /// Starts a simulator with one port for each name in `ports`, and waits until the simulator is ready. The simulator
    /// logs every telegram that it sends in the file `truth`.
    ///
    /// The scanners reply after 5 ms unless `flags` contain a fault or [`REAL_REPLY_TIME`], because few tests need the
    /// real reply time. The lines are lossless: the simulator waits while the hub does not read.
    pub(crate) fn simulator<S: AsRef<str>>(&self, ports: &[&str], flags: &[S]) -> Program {
        self.simulator_on_real_lines(ports, &concat_args(flags, &["--lossless"]))
    }

    /// Starts a simulator like [`TestEnv::simulator`], but on lossy lines: bytes that the hub does not read in time are
    /// lost.
    pub(crate) fn simulator_on_real_lines<S: AsRef<str>>(&self, ports: &[&str], flags: &[S]) -> Program {
        let ports: Vec<_> = ports.iter().map(|port| format!("--port={}", self.path_argument(port))).collect();
        let truth = format!("--truth={}", self.path_argument("truth"));
        let has_faults = flags.iter().any(|flag| flag.as_ref().starts_with("--fault"));
        let soon: &[&str] = if has_faults { &[] } else { &[SHORT_REPLY_TIME] };
        let words = concat_args(
            &concat_args(&["simulate", "--json", &truth, "--force"], soon),
            &concat_args(&ports, flags),
        );
        self.start(&words).ready()
    }

    /// Kills the simulator of one port. The symlink of the port is removed first. Otherwise, the hub could open the
    /// symlink again after the kernel has given the same terminal to the simulator of another test.
    pub(crate) fn kill_port_simulator(&self, simulator: Program, port: &str) {
        fs::remove_file(self.path(port)).unwrap_or_else(|error| panic!("{port}: {error}"));
        assert_eq!(simulator.end(KILL).exit_code, None);
    }

    /// Waits until all of `topics` exist, starts `echo --json` with these topics, and waits until `echo` is attached to
    /// each of them. The topics of a remote sensor are created one by one, each with its first datagram.
    pub(crate) fn echo(&self, topics: &[&str]) -> Program {
        let mut before = Vec::new();
        wait_until("all topics exist", || {
            let listed = self.all_subscribers(topics);
            before = listed.iter().copied().flatten().collect();
            before.len() == topics.len()
        });
        let program = self.start(&concat_args(&["echo", "--json"], topics));
        wait_until("echo is attached to all topics", || {
            self.all_subscribers(topics)
                .iter()
                .zip(&before)
                .all(|(now, before)| now.is_some_and(|it| it > *before))
        });
        program
    }

    /// Returns the number of subscribers of `topic`.
    pub(crate) fn subscribers(&self, topic: &str) -> u64 {
        self.all_subscribers(&[topic])[0].unwrap_or_else(|| panic!("topic {topic} does not exist"))
    }

    /// Returns the number of subscribers for each topic in `topics`, or `None` for a topic that does not exist. All
    /// numbers come from one run of `list`.
    fn all_subscribers(&self, topics: &[&str]) -> Vec<Option<u64>> {
        let outcome = self.run(&["list", "--json"]);
        let lines = outcome.lines();
        let subscribers = |topic: &&str| {
            let (sensor, name) =
                topic.split_once('/').unwrap_or_else(|| panic!("{topic} lacks the name of a sensor"));
            let is_it =
                |line: &&Value| line["class"] == "topic" && line["sensor"] == sensor && line["topic"] == name;
            lines.iter().find(is_it).map(|line| number(line, "subscribers"))
        };
        topics.iter().map(subscribers).collect()
    }

    /// Runs a verb that searches for a scanner, and runs it again as long as it finds none. On a busy machine, the
    /// simulated scanner may reply too late.
    pub(crate) fn search(&self, arguments: &[&str]) -> Outcome {
        const NOT_FOUND: i32 = 3;
        let mut outcome = self.run(arguments);
        wait_until("a scanner is found", || {
            let is_found = outcome.exit_code != Some(NOT_FOUND);
            if !is_found {
                outcome = self.run(arguments);
            }
            is_found
        });
        outcome
    }

    /// Returns the line that `info` prints for `sensor`.
    pub(crate) fn info(&self, sensor: &str) -> Value {
        let outcome = self.run(&["info", sensor, "--json"]);
        let [line] = &outcome.lines()[..] else { panic!("exactly one line was expected: {outcome}") };
        line.clone()
    }

    /// Runs `info` for `sensor` until `is_expected` accepts the line that it prints, and returns this line.
    pub(crate) fn await_info(&self, sensor: &str, is_expected: impl Fn(&Value) -> bool) -> Value {
        let mut last = Value::Null;
        wait_until("info has the expected status", || {
            last = self.info(sensor);
            is_expected(&last)
        });
        last
    }

    /// Returns the telegrams that the simulator has sent on `port` so far, in order.
    pub(crate) fn truth(&self, port: &str) -> Vec<SimulatedTelegram> {
        let port = self.path_argument(port);
        self.truth_lines("truth")
            .iter()
            .filter(|line| line["port"] == port.as_str())
            .map(SimulatedTelegram::of)
            .collect()
    }

    /// Returns two counters from the simulator's final line about `port`: the telegrams that it has sent, and the
    /// writes to the scanner's EEPROM that it has simulated.
    pub(crate) fn simulator_totals(&self, port: &str) -> (u64, u64) {
        let port = self.path_argument(port);
        let lines = self.truth_lines("simulated");
        let line = lines.iter().find(|line| line["port"] == port.as_str());
        let line = line.unwrap_or_else(|| panic!("the simulator has printed no totals for {port}"));
        (number(line, "sent"), number(line, "eeprom_writes"))
    }

    fn truth_lines(&self, class: &str) -> Vec<Value> {
        let text = fs::read_to_string(self.path("truth")).expect("the simulator creates the file truth");
        text.lines()
            .map(|line| serde_json::from_str::<Value>(line).unwrap_or_else(|error| panic!("{line}: {error}")))
            .filter(|line| line["class"] == class)
            .collect()
    }

    /// Returns the files in the shared memory of this domain that have more than 16 bytes. The library for shared
    /// memory always leaves shorter files.
    pub(crate) fn leftover_files(&self) -> Vec<PathBuf> {
        shared_memory(&format!("sh_{}_", self.domain))
            .into_iter()
            .filter(|path| fs::metadata(path).is_ok_and(|metadata| metadata.len() > 16))
            .collect()
    }
}

impl Drop for TestEnv {
    fn drop(&mut self) {
        for path in shared_memory(&format!("sh_{}_", self.domain)) {
            let _ = fs::remove_file(path);
        }
    }
}

/// Returns the path of the program. For tests of other crates, Cargo does not build the program, so the first call
/// builds it.
fn scanhub() -> &'static str {
    static BUILT: OnceLock<String> = OnceLock::new();
    option_env!("CARGO_BIN_EXE_scanhub").unwrap_or_else(|| {
        BUILT.get_or_init(|| {
            let built = own_program().ancestors().nth(2).map(|directory| directory.join("scanhub"));
            let built =
                built.unwrap_or_else(|| panic!("the test binary is not in a target directory of Cargo"));
            let mut cargo = Command::new(env!("CARGO"));
            cargo.args(["build", "--quiet", "--package=scanhub", "--bin=scanhub"]);
            cargo.args(built.components().any(|word| word.as_os_str() == "release").then_some("--release"));
            assert!(status(cargo).is_ok_and(|status| status.success()), "cargo cannot build scanhub");
            built.display().to_string()
        })
    })
}

/// Returns the files in `/dev/shm` whose names begin with `prefix`.
pub(crate) fn shared_memory(prefix: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir("/dev/shm").into_iter().flatten().flatten();
    let named = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix));
    named.map(|entry| entry.path()).collect()
}

/// Waits until `is_true` returns true, and panics with `description` after [`WAIT_TIMEOUT`].
pub(crate) fn wait_until(description: &str, mut is_true: impl FnMut() -> bool) {
    let give_up_at = Instant::now() + WAIT_TIMEOUT;
    let mut pause = Duration::from_millis(1);
    loop {
        let started = Instant::now();
        if is_true() {
            return;
        }
        let elapsed = started.elapsed();
        assert!(Instant::now() < give_up_at, "timeout while waiting for: {description}");
        // A check that starts a program may take at most a third of the time. Other programs then get enough CPU time.
        thread::sleep(pause.max(2 * elapsed).min(Duration::from_millis(100)));
        pause = (2 * pause).min(Duration::from_millis(20));
    }
}

/// Waits for at least `span`, so that a program measures with its own clock that this time has passed. A test must not
/// fail if the wait takes longer.
pub(crate) fn wait_at_least(span: Duration) {
    thread::sleep(span);
}

/// Returns whether `path` exists. A symlink counts as existing even if its target is missing.
pub(crate) fn exists_or_is_symlink(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}

fn concat_args<S: AsRef<str>, T: AsRef<str>>(first: &[S], rest: &[T]) -> Vec<String> {
    let first = first.iter().map(|word| word.as_ref().to_owned());
    first.chain(rest.iter().map(|word| word.as_ref().to_owned())).collect()
}
