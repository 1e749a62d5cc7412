//! A port whose settings another process changes while the hub streams from it.

use std::fs::File;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcsetattr};

use crate::testkit::{Program, TERM, TestEnv, open_line, wait_until};

/// A process that had the port open before the hub.
struct OtherProcess(File);

impl OtherProcess {
    fn open(path: &Path) -> OtherProcess {
        OtherProcess(open_line(path, 9600))
    }

    fn change(&self, change: impl Fn(&mut Termios)) {
        let mut termios = tcgetattr(&self.0).expect("a terminal");
        change(&mut termios);
        tcsetattr(&self.0, OptionalActions::Now, &termios).expect("a terminal");
    }

    fn rate(&self) -> u32 {
        tcgetattr(&self.0).expect("a terminal").output_speed()
    }
}

#[test]
fn hub_restores_baud_rate_changed_by_another_process() {
    let cases = [
        (&["--baud=500000"][..], "", 500_000),
        (&["--family=ld", "--model=ld19"], ",model=ld19", 230_400),
        (&["--family=rplidar", "--model=a1"], ",family=rplidar", 115_200),
    ];
    let hubs = cases.map(|(simulated, link, rate)| {
        let env = TestEnv::new();
        let simulator = env.simulator(&["front"], &[&["--seed=40"], simulated].concat());
        let other = OtherProcess::open(&env.path("front"));
        let hub = env.hub(&[format!("{}{link}", env.link("front"))]);
        env.await_info("front", |info| info["state"] == "streaming");
        other.change(|termios| termios.set_speed(9600).expect("a valid rate"));
        wait_until("the hub restores its baud rate", || other.rate() == rate);
        (env, simulator, hub)
    });
    for (env, _simulator, hub) in hubs {
        // The status keeps the message for only ten seconds, so the test may not see the message there on a busy
        // machine. It searches the log instead.
        env.await_info("front", |info| info["state"] == "streaming" && info["last_error"] == "");
        let outcome = hub.end(TERM);
        let logs = |words: &str| outcome.stderr.contains(words);
        assert!(logs("the port was set to 9600 baud by another process"), "{outcome}");
        assert_eq!((outcome.exit_code, logs("cable")), (Some(0), false), "{outcome}");
    }
}

#[test]
fn message_names_a_program_that_changes_ports() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=41", "--baud=500000"]);
    let other = OtherProcess::open(&env.path("front"));
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    // Through this symlink, a process of `scanhub` has the name `ModemManager`.
    symlink(env!("CARGO_BIN_EXE_scanhub"), env.path("ModemManager")).expect("a link");
    let mut command = Command::new(env.path("ModemManager"));
    command
        .args(["simulate", "--json", "--port", &env.path_argument("other")])
        .env("SCANHUB_END_WITH_PARENT", "1");
    let _program = Program::start(command).ready();
    other.change(|termios| termios.set_speed(115_200).expect("a valid rate"));
    wait_until("the hub restores its baud rate", || other.rate() == 500_000);
    let outcome = hub.end(TERM);
    let words = "set to 115200 baud by another process; ModemManager runs";
    assert!(outcome.stderr.contains(words), "{outcome}");
}

#[test]
fn hub_restores_port_settings_changed_by_others() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=42", "--baud=500000"]);
    let other = OtherProcess::open(&env.path("front"));
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    other.change(|termios| termios.local_modes.insert(LocalModes::ICANON));
    wait_until("the hub restores the raw mode", || {
        !tcgetattr(&other.0).expect("a terminal").local_modes.contains(LocalModes::ICANON)
    });
    let outcome = hub.end(TERM);
    assert!(outcome.stderr.contains("the port's settings were changed by another process"), "{outcome}");
}
