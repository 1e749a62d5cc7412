//! The network namespace in which the bench runs, the bench's sockets on the loopback, and child processes that print
//! JSON.

use std::env;
use std::net::{Ipv4Addr, UdpSocket};
use std::process::{Command, ExitCode, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::Duration;

use rustix::net::sockopt::{set_ip_multicast_if, set_socket_recv_buffer_size_force};
use rustix::process::{Pid, Signal, kill_process};
use scanhub_schema::Topic;
use scanhub_schema::datagram::{GROUP_PREFIX, PORT, group};
use serde_json::Value;

use crate::support::environment::{BenchEnvironment, GuardedProcess, STEP_TIMEOUT};
use crate::support::{Outcome, clock};

pub(crate) const PROGRAM: &str = env!("CARGO_BIN_EXE_scanhub");
const NAMESPACE_VARIABLE: &str = "SCANHUB_BENCH_NETWORK";

/// Returns whether this process runs in its own network namespace.
pub(crate) fn is_in_namespace() -> bool {
    env::var_os(NAMESPACE_VARIABLE).is_some()
}

/// Runs this program again in a network namespace that has only the loopback.
pub(crate) fn rerun_in_namespace() -> Outcome<ExitCode> {
    let mut unshare = Command::new("unshare");
    unshare.arg("--net");
    if !rustix::process::getuid().is_root() {
        unshare.arg("--map-root-user");
    }
    let state = tempfile::tempdir()?;
    unshare.args(["sh", "-c", "ip link set lo up && exec \"$@\"", "sh"]).arg(env::current_exe()?);
    unshare.args(env::args().skip(1)).env(NAMESPACE_VARIABLE, "1").env("XDG_STATE_HOME", state.path());
    let status = unshare.env_remove("STATE_DIRECTORY").status()?;
    Ok(if status.success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Returns a socket that receives the datagrams of all groups on the loopback.
pub(crate) fn receiver() -> Outcome<UdpSocket> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, PORT))?;
    for last in 80..84 {
        socket.join_multicast_v4(
            &Ipv4Addr::new(GROUP_PREFIX[0], GROUP_PREFIX[1], GROUP_PREFIX[2], last),
            &Ipv4Addr::LOCALHOST,
        )?;
    }
    let _ = set_socket_recv_buffer_size_force(&socket, 8 << 20);
    socket.set_read_timeout(Some(Duration::from_millis(200)))?;
    Ok(socket)
}

/// Returns a socket that can send to the groups on the loopback.
pub(crate) fn sender() -> Outcome<UdpSocket> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    set_ip_multicast_if(&socket, &Ipv4Addr::LOCALHOST)?;
    Ok(socket)
}

/// Returns the address to which the datagrams of `topic` are sent.
pub(crate) fn address(topic: Topic) -> (Ipv4Addr, u16) {
    (Ipv4Addr::new(GROUP_PREFIX[0], GROUP_PREFIX[1], GROUP_PREFIX[2], group(topic)), PORT)
}

/// Returns the flags of a gateway that sends all topics.
pub(crate) fn all_topics() -> Vec<String> {
    Topic::ALL.iter().map(|topic| format!("--topic=*/{}", topic.name())).collect()
}

/// Starts a gateway in the domain of `environment`.
pub(crate) fn gateway(environment: &BenchEnvironment, interface: &str, flags: &[String]) -> Outcome<Program> {
    let mut command = Command::new(PROGRAM);
    command
        .args(["gateway", "--json", "--interface", interface, "--domain", environment.domain.name()])
        .args(flags);
    Program::start(command, "gateway")
}

/// A child process that prints lines of JSON.
pub(crate) struct Program {
    guard: GuardedProcess,
    lines: Receiver<(u64, Value)>,
}

impl Program {
    /// Starts a program, and waits for the first line of class `class`.
    pub(crate) fn start(mut command: Command, class: &str) -> Outcome<Program> {
        command.env("SCANHUB_END_WITH_PARENT", "1").env("SCANHUB_LOG", "error");
        let mut process = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn()?;
        let stdout = process.stdout.take().ok_or("no pipe")?;
        let (send, lines) = channel();
        thread::spawn(move || {
            use std::io::BufRead;
            for text in std::io::BufReader::new(stdout).lines().map_while(Result::ok) {
                let line = serde_json::from_str(&text).unwrap_or(Value::Null);
                if send.send((clock::now(), line)).is_err() {
                    return;
                }
            }
        });
        let program = Program { guard: GuardedProcess::new(process), lines };
        program.wait_for_class(class)?;
        Ok(program)
    }

    pub(crate) fn pid(&self) -> u32 {
        self.guard.pid()
    }

    /// Waits for the next line of class `class`, and returns this line. Drops the lines before it.
    pub(crate) fn wait_for_class(&self, class: &str) -> Outcome<Value> {
        loop {
            let (_, line) =
                self.lines.recv_timeout(STEP_TIMEOUT).map_err(|_| format!("no {class} arrived"))?;
            if line["class"] == class {
                return Ok(line);
            }
        }
    }

    /// Waits for the first line of class `class` that arrives after `since_ns`, and returns the time at which it
    /// arrived. Drops the lines before it.
    pub(crate) fn wait_for_class_after(&self, since_ns: u64, class: &str) -> Outcome<u64> {
        loop {
            let (at_ns, line) =
                self.lines.recv_timeout(STEP_TIMEOUT).map_err(|_| format!("no {class} arrived"))?;
            if at_ns > since_ns && line["class"] == class {
                return Ok(at_ns);
            }
        }
    }

    /// Ends the program, and returns its remaining lines with the times at which they arrived.
    pub(crate) fn end(self) -> Outcome<Vec<(u64, Value)>> {
        let pid = Pid::from_raw(self.pid() as i32).ok_or("no process")?;
        kill_process(pid, Signal::TERM)?;
        let mut lines = Vec::new();
        while let Ok(line) = self.lines.recv_timeout(STEP_TIMEOUT) {
            lines.push(line);
        }
        self.guard.wait()?;
        Ok(lines)
    }
}

/// Returns whether a line has statistics of this sensor and topic.
pub(crate) fn has_topic(line: &Value, sensor: &str, topic: &str) -> bool {
    line["class"] == "lan" && line["sensor"] == sensor && line["topic"] == topic
}

/// Returns the sum of `key` over all lines of statistics.
pub(crate) fn sum(lines: &[(u64, Value)], key: &str) -> f64 {
    let rows = lines.iter().filter(|(_, line)| line["class"] == "lan");
    rows.map(|(_, line)| number(line, key)).sum::<u64>() as f64
}

/// Returns the number that a line has under `key`, or 0 if the line has no such number.
pub(crate) fn number(line: &Value, key: &str) -> u64 {
    line[key].as_u64().unwrap_or_default()
}
