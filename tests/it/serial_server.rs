//! Tests of a scanner behind a serial server. The test itself is the server, and forwards bytes between a loopback
//! socket and the simulator's pty.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crate::testkit;
use crate::testkit::{
    INT, TERM, TestEnv, contiguous_numbers, is_class, number, open_line, spawn, terminal, wait_until,
};
use rustix::process::Signal;
use serde_json::Value;

/// A serial server that accepts one connection at a time, until it is dropped.
struct Server {
    address: String,
    /// Flag that the test sets to end the current connection.
    hang_up: Arc<AtomicBool>,
    end: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Starts a server whose serial port is the line at `path`, with the baud rate `rate`.
    fn new(env: &TestEnv, path: &str, rate: u32) -> Server {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port of the loopback");
        let address = listener.local_addr().expect("a bound address").to_string();
        listener.set_nonblocking(true).expect("a socket");
        let (hang_up, end) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
        let line = open_line(&env.path(path), rate);
        let body = {
            let (hang_up, end) = (hang_up.clone(), end.clone());
            move || {
                while !end.load(Ordering::Relaxed) {
                    match listener.accept() {
                        Ok((socket, _)) => forward(&line, &socket, &|| {
                            hang_up.swap(false, Ordering::Relaxed) || end.load(Ordering::Relaxed)
                        }),
                        Err(_) => thread::sleep(Duration::from_millis(5)),
                    }
                }
            }
        };
        Server { address, hang_up, end, thread: Some(thread::spawn(body)) }
    }

    fn link(&self) -> String {
        format!("--link=front=tcp:{}", self.address)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Copies bytes in both directions until `is_over`, or until either end fails or closes the connection.
fn forward(line: &std::fs::File, socket: &TcpStream, is_over: &dyn Fn() -> bool) {
    let (mut line, mut socket) = (line, socket);
    let mut buffer = [0; 4096];
    socket.set_nonblocking(true).expect("a socket");
    socket.set_nodelay(true).expect("a socket");
    while !is_over() {
        let from_host = socket.read(&mut buffer);
        match from_host {
            Ok(0) => return,
            Ok(len) => line.write_all(&buffer[..len]).expect("a running simulator"),
            Err(_) => {}
        }
        match line.read(&mut buffer) {
            Ok(len) if len > 0 => {
                if socket.write_all(&buffer[..len]).is_err() {
                    return;
                }
            }
            _ if from_host.is_ok() => {}
            _ => thread::sleep(Duration::from_micros(200)),
        }
    }
}

#[test]
fn reconnects_to_a_scanner_behind_a_serial_server() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["line"], &["--baud=38400", "--seed=5"]);
    let server = Server::new(&env, "line", 38_400);
    let hub = env.hub(&[&server.link(), "--set=link.front.baud=38400"]);
    let mut subscriber = env.echo(&["front/telegram", "front/status"]);
    subscriber.await_lines(5, "a telegram", is_class("telegram"));
    server.hang_up.store(true, Ordering::Relaxed);
    let absent = subscriber.await_line("absent", |line| line["state"] == "absent");
    let error = absent["last_error"].as_str().unwrap_or_default();
    assert!(error.contains(&server.address) && error.contains("closed by the serial server"), "{absent}");
    subscriber.await_line("streaming", |line| line["state"] == "streaming");
    subscriber.await_lines(5, "a telegram", is_class("telegram"));
    let info = env.info("front");
    assert_eq!(number(&info["counters"], "reconnects"), 1, "{info}");
    assert_eq!(info["port"], format!("tcp:{}", server.address));
    let outcome = subscriber.end(INT);
    contiguous_numbers(&outcome.of_class("telegram"), "seq");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn finds_scanner_of_any_family_behind_a_server() {
    for (simulated, rate, family, model) in [
        (&["--baud=38400", "--seed=5"][..], 38_400, "lms", "lms200"),
        (&["--family=ld", "--model=ld19", "--seed=5"], 230_400, "ld", "ld19"),
        (&["--family=rplidar", "--model=a1", "--seed=5"], 115_200, "rplidar", "a1"),
    ] {
        let env = TestEnv::new();
        let simulator = env.simulator(&["line"], simulated);
        let server = Server::new(&env, "line", rate);
        let hub = env.hub(&[format!("{},family=auto", server.link())]);
        let mut subscriber = env.echo(&["front/scan", "front/status"]);
        subscriber.await_line("a scan", |line| is_class("scan")(line) && line["family"] == family);
        let info = env.await_info("front", |info| info["state"] == "streaming" && info["model"] == model);
        assert_eq!((&info["family"], &info["last_error"]), (&family.into(), &"".into()), "{info}");
        // After the connection was lost and opened again, the search starts again and finds this scanner again.
        server.hang_up.store(true, Ordering::Relaxed);
        subscriber.await_line("absent", |line| line["state"] == "absent");
        subscriber.await_line("a search", |line| line["state"] == "probing" && line["family"].is_null());
        subscriber.await_line("a scan", |line| is_class("scan")(line) && line["family"] == family);
        contiguous_numbers(&subscriber.end(INT).of_class("scan"), "topic_seq");
        let outcome = hub.end(TERM);
        assert_eq!((outcome.exit_code, outcome.stderr.contains("is now")), (Some(0), false), "{outcome}");
        assert!(outcome.stderr.contains(&format!("front: found {model}")), "{outcome}");
        drop(server);
        assert_eq!(simulator.end(TERM).exit_code, Some(0));
        if family == "lms" {
            assert_eq!(env.simulator_totals("line").1, 0, "EEPROM writes");
        }
    }
}

/// Number of scans that the simulator sends while the hub is stopped.
const BACKLOGGED_SCANS: usize = 20;

#[test]
fn scans_buffered_for_a_stopped_hub_give_no_verdict() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["line"], &["--baud=38400", "--seed=5"]);
    let server = Server::new(&env, "line", 38_400);
    let hub = env.hub(&[&server.link(), "--set=link.front.baud=38400", "--set=zones.radii=[0.02,0.01]"]);
    let mut subscriber = env.echo(&["front/zones"]);
    subscriber.await_line("a verdict", |line| line["verdict"] == "clear");
    hub.signal(Signal::STOP);
    let sent = || env.truth("line").len();
    let before = sent();
    wait_until("scans wait", || sent() > before + BACKLOGGED_SCANS);
    hub.signal(Signal::CONT);
    let is_estimated = |line: &Value| line["flags"].to_string().contains("stamp_estimated");
    // The simulator sends about five scans per second. The scans of the last second may count as recent, so expect six
    // fewer.
    for _ in 0..BACKLOGGED_SCANS - 6 {
        subscriber.await_line("an old scan", |line| line["verdict"] == "unknown" && is_estimated(line));
    }
    subscriber.await_line("a new scan", |line| line["verdict"] == "clear" && !is_estimated(line));
    subscriber.end(INT);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn wrong_rate_of_a_serial_server_is_reported() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["line"], &["--baud=9600"]);
    let server = Server::new(&env, "line", 38_400);
    let _hub = env.hub(&[&server.link(), "--set=link.front.baud=38400"]);
    let message = "no reply at 38400 baud, the rate set in the serial server";
    let has_message = |info: &Value| info["last_error"].as_str().is_some_and(|error| error.contains(message));
    env.await_info("front", has_message);
}

#[test]
fn unreachable_serial_server_is_reported() {
    let env = TestEnv::new();
    // No process listens at this port, because it was free a short time ago.
    let address = TcpListener::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).expect("a port");
    // This name is longer than a DNS label may be, so the system rejects it without a query to a name server.
    let nowhere = "x".repeat(64);
    let hub = env.hub(&[&format!("--link=front=tcp:{address}"), &format!("--link=named=tcp:{nowhere}:4001")]);
    for (sensor, message) in
        [("front", "connection refused; nothing listens there"), ("named", "no such host")]
    {
        let has_message =
            |info: &Value| info["last_error"].as_str().is_some_and(|error| error.contains(message));
        let info = env.await_info(sensor, has_message);
        assert_eq!(info["state"], "absent", "{info}");
    }
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn descriptor_shortage_is_not_a_network_error() {
    let env = TestEnv::new();
    let free = TcpListener::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).expect("a port");
    let port = format!("tcp:localhost:{}", free.port());
    for limit in 5..16 {
        let inner = env.command(&["probe", &port]);
        let mut command = std::process::Command::new("sh");
        command.args(["-c", "ulimit -n \"$0\" && exec \"$@\"", &limit.to_string()]);
        command.arg(inner.get_program()).args(inner.get_args()).env("SCANHUB_END_WITH_PARENT", "1");
        let outcome = testkit::Program::start(command).wait();
        match outcome.exit_code {
            Some(75) => {}
            Some(4) => assert!(outcome.stderr.contains("connection refused"), "{limit}: {outcome}"),
            _ => panic!("{limit}: {outcome}"),
        }
    }
}

#[test]
fn interrupt_ends_connecting_to_a_mute_serial_server() {
    let env = TestEnv::new();
    // No process accepts connections, and the listener's queue is full, so the kernel drops further attempts to
    // connect.
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port of the loopback");
    rustix::net::listen(&listener, 0).expect("a socket");
    let address = listener.local_addr().expect("a bound address");
    let _waiting = TcpStream::connect(address).expect("room for one connection");
    let port = format!("tcp:{address}");
    for arguments in [["probe", &port, "--json"], ["doctor", &port, "--json"]] {
        let program = env.start(&arguments);
        let descriptors = format!("/proc/{}/fd", program.pid());
        let is_socket = |entry: std::fs::DirEntry| {
            entry.path().read_link().is_ok_and(|target| target.to_string_lossy().starts_with("socket:"))
        };
        testkit::wait_until("a connection attempt", || {
            std::fs::read_dir(&descriptors).is_ok_and(|entries| entries.flatten().any(is_socket))
        });
        assert_eq!(program.end(INT).exit_code, Some(130));
    }
}

#[test]
fn busy_serial_server_is_reported_once() {
    let env = TestEnv::new();
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port of the loopback");
    let address = listener.local_addr().expect("a bound address");
    let hub = env.hub(&[format!("--link=front=tcp:{address}")]);
    for _ in 0..6 {
        drop(listener.accept().expect("another connection of the hub"));
    }
    let info = env.await_info("front", |info| info["counters"]["reconnects"] == 6);
    assert_eq!(info["state"], "absent", "{info}");
    let outcome = hub.end(TERM);
    let reports = outcome.stderr.lines().filter(|line| line.contains("closed by the serial server")).count();
    assert_eq!(reports, 1, "{outcome}");
    assert!(outcome.stderr.lines().count() < 8, "{outcome}");
}

#[test]
fn probe_and_doctor_work_behind_a_serial_server() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["sensor"], &["--baud=38400"]);
    let server = Server::new(&env, "sensor", 38_400);
    let port = format!("tcp:{}", server.address);
    let outcome = env.search(&["probe", &port, "--json"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let found = &outcome.lines()[0];
    // In a serial server, the server's own settings determine the baud rate. `probe` reports the rate that the scanner
    // itself reports.
    assert_eq!((number(found, "baud"), number(found, "operating_mode")), (38_400, 0x25), "{found}");
    let outcome = env.run(&["doctor", &port, "--no-system-config", "--json"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let findings = outcome.of_class("check");
    let sensor = findings.iter().find(|line| line["name"] == "sensor").expect("the check of the sensor");
    assert!(sensor["finding"].as_str().is_some_and(|text| text.contains("38400 Bd")), "{sensor}");
    drop(server);
    let outcome = env.search(&["probe", &port, "--json"]);
    assert_eq!(outcome.exit_code, Some(4), "{outcome}");
}

/// Runs the program with `arguments` at a terminal and answers its question with yes. Returns the output and the exit
/// code of the program.
fn run_and_confirm(env: &TestEnv, arguments: &[&str]) -> (String, Option<i32>) {
    let (mut keys, screen) = terminal();
    let mut command = env.command(arguments);
    let screens = [0; 3].map(|_| Stdio::from(screen.try_clone().unwrap()));
    let [stdin, stdout, stderr] = screens;
    let mut process = spawn(command.stdin(stdin).stdout(stdout).stderr(stderr)).expect("a started program");
    drop((command, screen));
    let (mut output, mut byte) = (Vec::new(), [0]);
    // Reading fails as soon as no process has the terminal open.
    while keys.read(&mut byte).is_ok_and(|len| len > 0) {
        output.push(byte[0]);
        if output.ends_with(b"Type yes: ") {
            keys.write_all(b"yes\n").expect("an open terminal");
        }
    }
    (String::from_utf8_lossy(&output).into_owned(), process.wait().expect("the exit status").code())
}

#[test]
fn scanner_behind_a_serial_server_is_configurable() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--baud=38400"]);
    let server = Server::new(&env, "front", 38_400);
    let port = format!("tcp:{}", server.address);
    let (output, code) = run_and_confirm(&env, &["configure", &port, "unit=cm"]);
    assert_eq!(code, Some(0), "{output}");
    assert_eq!(number(&env.search(&["probe", &port, "--json"]).lines()[0], "unit_mm"), 10);
    drop(server);
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 1);
}
