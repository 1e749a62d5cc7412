//! A port whose settings another process changes while the hub streams from it.

use std::fs::File;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcsetattr};
use serde_json::Value;

use crate::testkit::{Program, TERM, TestEnv, open_line, until};

/// A process that had the port open before the hub.
struct Other(File);

impl Other {
    fn at(place: &Path) -> Other {
        Other(open_line(place, 9600))
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

fn says(words: &str) -> impl Fn(&Value) -> bool + '_ {
    move |info| {
        info["state"] == "streaming" && info["last_error"].as_str().is_some_and(|error| error.contains(words))
    }
}

#[test]
fn rate_set_by_another_process_is_set_again_whatever_the_family() {
    for (simulated, link, rate) in [
        (&["--baud=500000"][..], "", 500_000),
        (&["--family=ld", "--model=ld19"], ",model=ld19", 230_400),
        (&["--family=rplidar", "--model=a1"], ",family=rplidar", 115_200),
    ] {
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], &[&["--seed=40"], simulated].concat());
        let other = Other::at(&env.path("front"));
        let hub = env.hub(&[format!("{}{link}", env.link("front"))]);
        env.await_info("front", |info| info["state"] == "streaming");
        other.change(|termios| termios.set_speed(9600).expect("a valid rate"));
        env.await_info("front", says("the port was set to 9600 baud by another process"));
        assert_eq!(other.rate(), rate);
        env.await_info("front", |info| info["state"] == "streaming" && info["last_error"] == "");
        let outcome = hub.end(TERM);
        assert_eq!((outcome.code, outcome.errors.contains("cable")), (Some(0), false), "{outcome}");
    }
}

#[test]
fn a_program_that_is_known_to_change_ports_is_named() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=41", "--baud=500000"]);
    let other = Other::at(&env.path("front"));
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    // Any program of this name.
    symlink(env!("CARGO_BIN_EXE_scanhub"), env.path("ModemManager")).expect("a link");
    let mut command = Command::new(env.path("ModemManager"));
    command.args(["simulate", "--json", "--port", &env.word("other")]).env("SCANHUB_END_WITH_PARENT", "1");
    let _program = Program::start(command).ready();
    other.change(|termios| termios.set_speed(115_200).expect("a valid rate"));
    env.await_info("front", says("set to 115200 baud by another process; ModemManager runs"));
}

#[test]
fn other_settings_are_made_again_too() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=42", "--baud=500000"]);
    let other = Other::at(&env.path("front"));
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    other.change(|termios| termios.local_modes.insert(LocalModes::ICANON));
    env.await_info("front", says("the port's settings were changed by another process"));
    until("the line is raw again", || {
        !tcgetattr(&other.0).expect("a terminal").local_modes.contains(LocalModes::ICANON)
    });
}
