//! Setups in which the scanner, the line, the port or the configuration has a fault. `scanhub doctor` finds each fault
//! and names the remedy. With `--nocapture`, the tests print the faults as a table. Faults of the machine are in
//! `doctor_machine.rs`.

use std::fs::{self, File};
use std::net::TcpListener;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::os::unix::process::CommandExt;
use std::process::Command;

use crate::testkit::{
    Findings, Program, TestEnv, TestLine, open_line, run_concurrently, skip, succeeds, wait_until,
};

/// Faults. Each row has a description of the fault, the flags of the simulator, and what `doctor` must report: the
/// check, its state and a part of the remedy.
const BROKEN_SENSORS: [(&str, &[&str], &str, &str, &str); 10] = [
    ("the window is dirty", &["--type=lms291", "--pollution=60"], "health", "warning", "clean its window"),
    (
        "an error of the sensor",
        &["--type=lms211", "--status=0x13", "--error=3:18"],
        "health",
        "failed",
        "a repair",
    ),
    (
        "a former owner's permanent rate",
        &["--permanent-baud=38400"],
        "power-on",
        "warning",
        "power_on_baud=9600",
    ),
    ("left in installation mode", &["--state=installation"], "power-on", "warning", "power it off and on"),
    ("it measures in another unit", &["--unit=cm"], "settings", "warning", "unit=mm"),
    (
        "another type was plugged in",
        &["--type=lms291", "--unit=mm"],
        "settings",
        "warning",
        "correct the type",
    ),
    ("a mode without reflector bits", &["--mode=0x00"], "marks", "warning", "mode=0x01"),
    ("no scanner answers", &["--fault=mute=1"], "sensor", "failed", "power, cable, jumper 7-8"),
    (
        "a wire is broken: the scanner streams and receives nothing",
        &["--state=streaming", "--baud=38400", "--fault=overlook=1"],
        "sensor",
        "failed",
        "the wire to its receiver",
    ),
    (
        "only noise arrives",
        &["--state=streaming", "--baud=500000", "--fault=flip=0.5,flip_bits=64,overlook=1"],
        "sensor",
        "failed",
        "RS-232 instead of RS-422",
    ),
];

#[test]
fn doctor_finds_sensor_faults() {
    run_concurrently(
        BROKEN_SENSORS.into_iter().enumerate(),
        |(number, (set_up, flags, name, state, remedy))| {
            let env = TestEnv::new();
            let port = format!("p{number}");
            let _simulator = env.simulator(&[&port], flags);
            let (link, of) = (env.link(&port), |key: &str| format!("link.{port}.{key}"));
            let expected = [of("unit=mm"), of("type=lms200")];
            let examine = || Findings::of(&env, &[&link, "--set", &expected[0], "--set", &expected[1]]);
            let mut findings = examine();
            // On a busy machine, the simulated scanner may reply too late. `doctor` is then run again.
            wait_until("the simulated scanner replies in time", || {
                let has_replied = name == "sensor" || findings.state_and_text("sensor").0 != "failed";
                if !has_replied {
                    findings = examine();
                }
                has_replied
            });
            findings.assert_problem(set_up, name, state, remedy);
        },
    );
}

#[test]
fn doctor_finds_port_faults() {
    let env = TestEnv::new();
    let port = |name: &str| Findings::of(&env, &[&env.path_argument(name)]);
    // The remedy lists the ports of the machine on which the test runs, so its text differs between machines.
    let instead =
        |finding: &Findings| if finding.state_and_text("port").1.is_empty() { "there are" } else { "" };
    let absent = port("absent");
    absent.assert_problem("no such port", "port", "failed", instead(&absent));
    symlink("/dev/pts/no-such-line", env.path("unplugged")).expect("a symlink");
    let unplugged = port("unplugged");
    assert!(
        unplugged.state_and_text("port").1.contains("points to"),
        "{:?}",
        unplugged.state_and_text("port")
    );
    unplugged.assert_problem("the adapter of the name is unplugged", "port", "failed", "");
    Findings::of(&env, &["/dev/null"]).assert_problem("not a serial line", "access", "failed", "name a tty");
    port("").assert_problem("a directory", "access", "failed", "it is a directory");

    let line = TestLine::create(&env.path("held"));
    let holder = open_line(&env.path("held"), 9600);
    port("held").assert_problem("another program has the port", "holder", "failed", "stop it first");
    drop((holder, line));

    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let server = format!("tcp:{}", listener.local_addr().expect("an address"));
    drop(listener);
    Findings::of(&env, &[&server]).assert_problem(
        "the serial server refuses",
        "port",
        "failed",
        "raw TCP mode",
    );
    let recording = env.path_argument("recording");
    let link = format!("--link=front=file:{recording}");
    Findings::of(&env, &[&link]).assert_problem("no such recording", "port", "failed", "existing recording");
}

#[test]
fn reports_missing_port_permission_with_remedy() {
    const NO_PERMISSION: &str = "no permission at the port";
    let env = TestEnv::new();
    let _line = TestLine::create(&env.path("front"));
    let arguments = ["doctor", "--json", "--no-system-config", &env.path_argument("front")];
    if !rustix::process::getuid().is_root() {
        fs::set_permissions(env.path("front"), fs::Permissions::from_mode(0o000))
            .expect("the owner can change the mode");
        let findings = Findings::in_outcome(&env.run(&arguments));
        return findings.assert_problem(NO_PERMISSION, "access", "failed", "chmod u+rw");
    }
    // Root may open every port, so another user runs `doctor`.
    let as_nobody = |mut command: Command| {
        command.uid(UNPRIVILEGED_UID).gid(UNPRIVILEGED_UID);
        command
    };
    let mut attempt = as_nobody(Command::new(env!("CARGO_BIN_EXE_scanhub")));
    if !succeeds(attempt.arg("--version")) {
        skip("open-directory", "other users cannot start the program in its directory");
        return;
    }
    let group = |gid, mode| {
        let device = env.path("front").canonicalize().expect("a device");
        std::os::unix::fs::chown(&device, Some(0), Some(gid)).expect("root is permitted");
        fs::set_permissions(&device, fs::Permissions::from_mode(mode)).expect("root is permitted");
        Findings::in_outcome(&Program::start(as_nobody(env.command(&arguments))).wait())
    };
    group(20, 0o660).assert_problem(NO_PERMISSION, "access", "failed", "sudo usermod -aG");
    group(0, 0o600).assert_problem("no group may use the port", "access", "failed", "udev rule");
}

#[test]
fn finds_configuration_faults() {
    let env = TestEnv::new();
    let broken = |set_up, text: &str, remedy| {
        let file = env.file("scanhub.toml", text);
        Findings::of(&env, &["--config", &file]).assert_problem(set_up, "configuration", "failed", remedy);
    };
    broken("an unknown key", "[[link]]\nname = \"front\"\nbuad = 500000\n", "baud");
    broken(
        "an impossible value",
        "[[link]]\nname = \"front\"\nport = \"/dev/x\"\nangle = 170\n",
        "100 or 180",
    );
    let two = "[[link]]\nname = \"a\"\nport = \"/dev/x\"\n[[link]]\nname = \"b\"\nport = \"/dev/x\"\n";
    broken("two links at one port", two, "name the port of each sensor");
    broken("a gateway that cannot be", "[gateway]\nttl = 1000\n", "");
    File::create(env.path("scanhub.toml")).expect("an empty file");
    let missing = env.path_argument("no-such.toml");
    Findings::of(&env, &["--config", &missing]).assert_problem("no such file", "configuration", "failed", "");
}

/// ID of a user without any permissions.
const UNPRIVILEGED_UID: u32 = 65534;
