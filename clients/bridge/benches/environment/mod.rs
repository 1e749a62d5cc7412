//! Environment of the bridge's benches: programs in separate directories that end with the bench, plain Zenoh sessions,
//! and the CPU time of a process.

#![allow(dead_code)] // Each bench uses only a part of it.

use std::fs::{self, DirBuilder, File};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use scanhub_client::streams::{Session, Source};
use scanhub_client::{Domain, Topic};
use tempfile::TempDir;
use zenoh::{Config, Wait};

/// A directory for the programs of a bench. Dropping this value removes the directory.
pub(crate) struct BenchEnvironment {
    directory: TempDir,
    scanhub: PathBuf,
}

/// A running program.
pub(crate) struct RunningProgram {
    child: Child,
    stdout_path: PathBuf,
}

/// A simulated machine. All programs on it share a domain.
pub(crate) struct Machine<'a> {
    environment: &'a BenchEnvironment,
    pub(crate) root: PathBuf,
}

const BRIDGE: &str = env!("CARGO_BIN_EXE_scanhub-bridge");
/// Sensors of a robot.
pub(crate) const SENSORS: [&str; 2] = ["front", "rear"];

impl BenchEnvironment {
    /// Creates the directory. Returns `None` if `scanhub` was not built.
    pub(crate) fn new(name: &str) -> Option<BenchEnvironment> {
        let scanhub = Path::new(BRIDGE).with_file_name("scanhub");
        if !scanhub.is_file() {
            eprintln!("{} was not built: run cargo build --release", scanhub.display());
            return None;
        }
        let prefix = format!("scanhub-bench-{name}-");
        let directory = tempfile::Builder::new().prefix(&prefix).tempdir().expect("a new directory");
        Some(BenchEnvironment { directory, scanhub })
    }

    pub(crate) fn machine(&self, name: &str) -> Machine<'_> {
        let root = self.directory.path().join(name);
        make_directory(&root);
        Machine { environment: self, root }
    }
}

impl Machine<'_> {
    /// Starts two simulated sensors at 500 kBd and their hub.
    pub(crate) fn robot(&self) -> [RunningProgram; 2] {
        let port = |name: &str| self.root.join(format!("tty-{name}")).display().to_string();
        let ports = SENSORS.map(|name| format!("--port={}", port(name)));
        let links = SENSORS.map(|name| format!("--link={name}={},family=lms", port(name)));
        let scanhub = &self.environment.scanhub;
        let simulator = self.start(scanhub, &["simulate", &ports[0], &ports[1], "--baud=500000"]);
        [simulator, self.start(scanhub, &["run", &links[0], &links[1]])]
    }

    pub(crate) fn start_bridge(&self, arguments: &[&str]) -> RunningProgram {
        self.start(Path::new(BRIDGE), &[&["--json"], arguments].concat())
    }

    fn start(&self, program: &Path, arguments: &[&str]) -> RunningProgram {
        let number = fs::read_dir(&self.root).expect("it is there").count();
        let stdout_path = self.root.join(format!("out-{number}"));
        let mut command = Command::new(program);
        command.args(arguments).args(["--domain", "bench", "--root"]).arg(&self.root);
        command.env("STATE_DIRECTORY", &self.root).env("SCANHUB_END_WITH_PARENT", "1").stdin(Stdio::null());
        command.stdout(File::create(&stdout_path).expect("a new file")).stderr(Stdio::null());
        let child = command.spawn().unwrap_or_else(|error| panic!("{}: {error}", program.display()));
        RunningProgram { child, stdout_path }
    }

    /// Subscribes to topics in the shared memory of this machine, and waits until all these topics exist.
    pub(crate) fn subscribe<const N: usize>(&self, topics: [(&str, Topic); N]) -> (Session, [Source; N]) {
        let mut memory = Session::new(vec![Domain::at("bench", &self.root).expect("a name")]);
        let mut sources = topics.map(|(sensor, topic)| Source::new(sensor, topic));
        let started = Instant::now();
        while !sources.iter().all(Source::subscribed) {
            assert!(started.elapsed() < Duration::from_secs(30), "no topics in {}", self.root.display());
            memory.check_hub().expect("a domain");
            sources.iter_mut().for_each(|source| drop(source.receive(&mut memory)));
            memory.wait_for(Some(Duration::from_millis(20))).expect("to wait");
        }
        (memory, sources)
    }
}

impl RunningProgram {
    /// Returns the CPU time used so far, in clock ticks of 10 ms.
    pub(crate) fn cpu_ticks(&self) -> u64 {
        let stat = fs::read_to_string(format!("/proc/{}/stat", self.child.id())).unwrap_or_default();
        let after_name = stat.rsplit(") ").next().unwrap_or_default();
        after_name.split(' ').skip(11).take(2).filter_map(|number| number.parse::<u64>().ok()).sum()
    }

    /// Returns the JSON lines that the program has printed so far.
    pub(crate) fn lines(&self) -> Vec<serde_json::Value> {
        let text = fs::read_to_string(&self.stdout_path).unwrap_or_default();
        text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
    }

    /// Waits until the program prints a line for which `is_expected` returns true.
    pub(crate) fn wait_for_line(
        &self,
        is_expected: impl Fn(&serde_json::Value) -> bool,
    ) -> serde_json::Value {
        let started = Instant::now();
        loop {
            if let Some(line) = self.lines().into_iter().find(&is_expected) {
                return line;
            }
            assert!(
                started.elapsed() < Duration::from_secs(30),
                "the expected line was not printed; last line: {:?}",
                self.lines().last()
            );
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// Ends the program with SIGINT, and returns its output.
    pub(crate) fn end(mut self) -> Vec<serde_json::Value> {
        if let Some(process) = rustix::process::Pid::from_raw(self.child.id() as i32) {
            rustix::process::kill_process(process, rustix::process::Signal::INT).expect("it is ours");
        }
        self.child.wait().expect("it is ours");
        self.lines()
    }
}

impl Drop for RunningProgram {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn make_directory(path: &Path) {
    DirBuilder::new().mode(0o700).create(path).expect("a new directory");
}

/// Returns an address on which no program listens.
pub(crate) fn free_port() -> SocketAddr {
    TcpListener::bind("127.0.0.1:0").and_then(|it| it.local_addr()).expect("a port")
}

/// Waits until a program listens on the address.
pub(crate) fn wait_until_listening(at: SocketAddr) {
    let started = Instant::now();
    while TcpStream::connect(at).is_err() {
        assert!(started.elapsed() < Duration::from_secs(30), "no program listens on {at}");
        thread::sleep(Duration::from_millis(1));
    }
}

/// Opens a plain Zenoh client session that is connected to a router.
pub(crate) fn session(router: SocketAddr) -> zenoh::Session {
    open("client", "connect/endpoints", router)
}

/// Opens a Zenoh router with Zenoh's default configuration, like `zenohd`.
pub(crate) fn plain_router(at: SocketAddr) -> zenoh::Session {
    open("router", "listen/endpoints", at)
}

fn open(mode: &str, endpoints: &str, at: SocketAddr) -> zenoh::Session {
    let mut config = Config::default();
    for (key, value) in [
        ("mode", format!("{mode:?}")),
        (endpoints, format!("[\"tcp/{at}\"]")),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).expect("a key of Zenoh");
    }
    zenoh::open(config).wait().expect("a session")
}

/// Durations in nanoseconds, which several threads collect.
pub(crate) type SendTimes = Arc<Mutex<Vec<u64>>>;

/// Returns the value, in microseconds, below which the share `share` of all `values` lies.
pub(crate) fn percentile(values: &mut [u64], share: f64) -> f64 {
    values.sort_unstable();
    let place = ((values.len() as f64 - 1.0) * share).max(0.0) as usize;
    values.get(place).map_or(f64::NAN, |&ns| ns as f64 / 1e3)
}
