//! Tests of a hub with an LMS on RS-232, on a pty: at 500,000 baud, the hub loses the scanner until the scanner's power
//! is cycled. The hub therefore falls back to 38,400 baud, and saves this rate.

use std::fs;
use std::os::unix::net::UnixStream;
use std::sync::Mutex;
use std::sync::mpsc::{Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use scanhub_schema::Failure;
use scanhub_sim::fault::Faults;
use scanhub_sim::options::SimulateOptions;
use scanhub_sim::simulate::Summary;
use scanhub_sim::{Event, simulate_with};
use serde_json::Value;

use crate::testkit::{TERM, TestEnv, WAIT_TIMEOUT, is_class};

const RS422_MESSAGE: &str = "500000 baud needs RS-422";

/// A simulated scanner whose power the test can cycle.
struct Scanner {
    events: Sender<Event>,
    stop: UnixStream,
    thread: JoinHandle<Result<Vec<Summary>, Failure>>,
}

impl Scanner {
    fn start(env: &TestEnv) -> Scanner {
        let options = SimulateOptions {
            ports: vec![env.path("front")],
            boot: Duration::from_millis(300),
            faults: Faults { rs232: 1.0, ..Faults::default() },
            ..SimulateOptions::default()
        };
        let (stop, stopped) = UnixStream::pair().expect("a pair of sockets");
        let (events, next) = channel();
        let (say_ready, is_ready) = channel();
        let thread = thread::spawn(move || {
            let next = Mutex::new(next);
            simulate_with(
                &options,
                &stopped,
                |_| say_ready.send(()).expect("a waiting test"),
                |_| {},
                |_| next.lock().expect("an intact mutex").try_recv().ok(),
                |_, _| {},
            )
        });
        is_ready.recv_timeout(WAIT_TIMEOUT).expect("the port can be opened");
        Scanner { events, stop, thread }
    }

    fn cycle_power(&self) {
        self.events.send(Event::PowerCycle).expect("the scanner is simulated");
    }

    fn end(self) {
        drop(self.stop);
        let [summary] =
            &self.thread.join().expect("a thread that does not panic").expect("a run without an error")[..]
        else {
            panic!("one port")
        };
        assert_eq!(summary.eeprom_writes, 0);
    }
}

fn has_rs422_problem(status: &Value) -> bool {
    status["last_error"].as_str().is_some_and(|error| error.starts_with(RS422_MESSAGE))
}

fn is_streaming_slowly(status: &Value) -> bool {
    status["state"] == "streaming" && status["baud"] == 38_400 && has_rs422_problem(status)
}

/// Asserts that the log has a warning with RS422_MESSAGE, and not twice in a row. If a reply is late on a busy machine,
/// another warning may be between two of them.
fn assert_single_warning(log: &str) {
    let warnings: Vec<_> = log.lines().filter(|line| line.contains(" WARN ")).collect();
    let is_reason = |line: &&str| line.contains(RS422_MESSAGE);
    assert!(warnings.iter().any(is_reason), "{log}");
    assert!(!warnings.windows(2).any(|pair| pair.iter().all(is_reason)), "{log}");
}

#[test]
fn falls_back_to_38400_baud_and_saves_the_rate() {
    let env = TestEnv::new();
    let scanner = Scanner::start(&env);
    let hub = env.hub(&[env.link("front")]);
    let mut echo = env.echo(&["front/scan", "front/status"]);
    echo.await_line("lost", |line| line["last_error"].as_str().is_some_and(|error| error.contains("Status")));
    scanner.cycle_power();
    echo.await_line("lost again", |line| line["state"] == "probing" && has_rs422_problem(line));
    scanner.cycle_power();
    echo.await_line("streaming at 38400", is_streaming_slowly);
    echo.await_lines(3, "a scan", is_class("scan"));
    let log = hub.end(TERM).stderr;
    assert_single_warning(&log);
    let saved = env.path("state/scanhub").join(env.domain().name()).join("front.rate");
    let text = fs::read_to_string(&saved).unwrap_or_else(|error| panic!("{}: {error}", saved.display()));
    assert!(text.starts_with("38400,silent=2 "), "{text}");
    scanner.end();

    // After a power cycle, the scanner is at 9,600 baud. The next hub must use the saved rate at once: if it switched
    // to 500,000 baud even once, it would lose the scanner, whose power the test does not cycle again.
    let scanner = Scanner::start(&env);
    let hub = env.hub(&[env.link("front")]);
    let mut echo = env.echo(&["front/status"]);
    echo.await_line("streaming at 38400", is_streaming_slowly);
    let log = hub.end(TERM).stderr;
    assert_single_warning(&log);
    scanner.end();
}
