//! Tests that run the shell lines of the pages. The lines run with a hub, a sensor `front`, and recordings with the
//! names that the pages use. A spare sensor takes the place of each port that the lines name. A list has the commands
//! that cannot run here, with the reason.

use std::fs;
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process_group};

use super::blocks::blocks;
use super::shell::{commands, lines};
use crate::testkit::{
    Program, TestEnv, TestGateway, in_a_network, run_concurrently, wait_until, write_program,
};
use scanhub_schema::Topic;

/// Commands that are not run here. Each entry has the beginning of the line, and the reason or the test that runs the
/// command. A test in `hub/cli.rs` parses the `scanhub` commands among them.
const SKIPPED_COMMANDS: [(&str, &str); 18] = [
    ("sudo ", "changes the machine; tests/it/dist.rs and tests/it/client_c.rs install elsewhere"),
    ("sudoedit ", "an editor"),
    ("curl ", "installs Rust, which built this test"),
    (". \"$HOME/.cargo/env\"", "the shell that started this test finds cargo"),
    ("systemctl ", "asks the machine's service manager; tests/it/service.rs has one of its own"),
    ("cargo build", "builds for minutes; this test was built so"),
    ("cargo test", "this is it"),
    ("cargo run", "builds for minutes; what follows `--` is read as a command line"),
    ("cargo new", "needs a directory beside the project; the example behind it is built and run"),
    ("cargo add", "the same"),
    ("python3 -m venv", "fetches packages; the package is used from its directory"),
    ("~/scans/bin/pip", "the same"),
    ("cc ", "tests/it/client_c.rs builds the same program against an installed library"),
    ("scanhub bridge", "another program; clients/bridge/tests/bridge/page.rs runs it"),
    ("openssl ", "the same"),
    ("scanhub watch", "needs a terminal; tests/it/watch.rs has one"),
    ("scanhub tilt", "needs a mount; tests/it/tilt.rs runs it beside one"),
    ("scanhub echo hall/", "follows what that makes; the same"),
];
/// If a line contains one of these parts, it is not run. Each part has the reason.
const NOT_RUN_IF_CONTAINS: [(&str, &str); 1] = [("| ssh ", "needs another machine")];

/// Returns whether `line` is not run.
fn is_excluded(line: &str) -> bool {
    SKIPPED_COMMANDS.iter().any(|(begin, _)| line.starts_with(begin))
        || NOT_RUN_IF_CONTAINS.iter().any(|(part, _)| line.contains(part))
}

/// Returns whether `line` needs a network.
fn needs_network(line: &str) -> bool {
    ["scanhub listen", "scanhub gateway", "robot1."].iter().any(|part| line.contains(part))
}

/// Returns all shell lines of all pages with their locations.
fn command_lines() -> Vec<(String, String)> {
    let blocks = blocks().into_iter().filter(|block| block.language == "sh");
    let lines = blocks
        .flat_map(|block| lines(&block.text).into_iter().map(move |line| (block.location.clone(), line)));
    lines.collect()
}

/// Environment that the pages assume: a running hub, recordings, and the program `scanhub` in `PATH`.
struct ShellEnv {
    env: TestEnv,
    /// Number of lines that were run so far. It names the directory of the next line.
    count: AtomicUsize,
}

/// Names of files that pages use for a recording of `front`.
const RECORDINGS: [&str; 5] = ["walk.mcap", "day-0001.mcap", "cut.mcap", "killed.mcap", "robot.mcap"];
/// Time range of a recording on a page, and the time range that replaces it here. The recording of this test is
/// shorter.
const SHORTENED_RANGE: (&str, &str) = ("--start 1m --end 90s", "--start 200ms --end 500ms");
/// Ports that pages name.
const PORTS: [&str; 5] =
    ["/dev/serial/by-id/usb-FTDI...", "/dev/ttyUSB0", "/tmp/lms", "/tmp/ld19", "/tmp/rplidar"];

impl ShellEnv {
    /// Creates the environment, and returns it with its simulator and hub.
    fn new() -> (ShellEnv, [Program; 2]) {
        let env = TestEnv::new();
        let simulator = env.simulator(&["front", "spare"], &["--seed=82", "--baud=500000"]);
        let hub = env.hub(&[env.link("front")]);
        env.await_info("front", |info| info["state"] == "streaming");
        let recorded = env.run(&["record", "-o", &env.path_argument("one.mcap"), "--for=1s"]);
        assert_eq!(recorded.exit_code, Some(0), "{recorded}");
        let stream = env.run(&["echo", "front/telegram", "--raw", "-n", "5"]);
        fs::create_dir(env.path("bin")).expect("a directory");
        // A domain has at most one hub, so the commands `run` and `replay` use another domain.
        let (name, root) = (env.domain().name().to_owned(), env.path("").display().to_string());
        let script = format!(
            "#!/bin/sh\ncase $1 in run | replay) other=x ;; esac\n\
             if [ \"$1 $2\" = 'web --replay' ]; then exec '{program}' \"$@\"; fi\n\
             exec '{program}' \"$@\" --domain \"{name}$other\" --root '{root}'\n",
            program = env!("CARGO_BIN_EXE_scanhub"),
        );
        write_program(env.path("bin/scanhub"), script);
        env.file("capture.bin", stream.stdout);
        (ShellEnv { env, count: AtomicUsize::new(0) }, [simulator, hub])
    }

    /// Runs `line` and returns the problem, if any. If `scanhub probe` finds no scanner, runs the line again, because
    /// the simulated scanner may reply too late on a busy machine.
    fn run(&self, line: &str) -> Option<String> {
        let mut wrong = self.run_once(line);
        wait_until(line, || {
            let finds_none =
                |wrong: &String| line.starts_with("scanhub probe") && wrong.contains("exit Some(3)");
            let is_late = wrong.as_ref().is_some_and(finds_none);
            if is_late {
                wrong = self.run_once(line);
            }
            !is_late
        });
        wrong
    }

    /// Runs `line` in a new directory until the command ends, or ends the command as Ctrl-C does. Returns the problem,
    /// if there is one.
    fn run_once(&self, line: &str) -> Option<String> {
        let here = self.env.path(&format!("line{}", self.count.fetch_add(1, Ordering::Relaxed)));
        fs::create_dir(&here).expect("a directory");
        let writes = line.starts_with("scanhub record");
        for name in RECORDINGS.iter().filter(|_| !writes) {
            fs::copy(self.env.path("one.mcap"), here.join(name)).expect("a recording");
        }
        fs::copy(self.env.path("capture.bin"), here.join("capture.bin")).expect("a stream");
        if line.contains(" --key-file ") {
            let key = here.join("lan.key");
            fs::write(&key, "5a".repeat(32)).expect("a key file");
            fs::set_permissions(key, std::os::unix::fs::PermissionsExt::from_mode(0o600))
                .expect("permission to change the mode");
        }
        let typed = PORTS.iter().fold(line.to_owned(), |line, port| {
            let is_made = line.starts_with("scanhub simulate");
            line.replace(port, &if is_made { "lms".into() } else { self.env.path_argument("spare") })
        });
        let typed = typed.replace(SHORTENED_RANGE.0, SHORTENED_RANGE.1);
        let mut shell = Command::new("sh");
        // If the line has a single command, this command replaces the shell, so that the test's signals reach the
        // command.
        let exec = if commands(line).len() == 1 { "exec " } else { "" };
        let path = format!("{}:{}", self.env.path_argument("bin"), std::env::var("PATH").unwrap_or_default());
        shell.arg("-c").arg(format!("{exec}{typed}")).current_dir(&here).env("PATH", path);
        shell.env("HOME", &here).env("XDG_STATE_HOME", here.join("state")).env_remove("STATE_DIRECTORY");
        shell.env("SCANHUB_END_WITH_PARENT", "1").env("SCANHUB_LOG", "error").env_remove("SCANHUB_CONFIG");
        let program = Program::start(shell);
        let group = Pid::from_raw(program.pid() as i32).expect("a process");
        let mut words = line.split_whitespace();
        let ends =
            words.next() == Some("scanhub") && words.next().is_some_and(|verb| ENDING_VERBS.contains(&verb));
        // Any other command may run forever. Interrupt it after it has set a handler for SIGINT and has had time to
        // fail.
        wait_until(line, || program.has_ended() || !ends && catches_interrupts(group));
        let started = Instant::now();
        wait_until(line, || program.has_ended() || started.elapsed() > TIME_TO_FAIL);
        let is_ended = !program.has_ended() && kill_process_group(group, Signal::INT).is_ok();
        let outcome = program.wait();
        let is_bounded = [" --for ", " -n "].iter().any(|flag| line.contains(flag));
        let is_right = match outcome.exit_code {
            Some(0) => true,
            // A command with `--for` or `-n` exits with 130 when it is interrupted.
            Some(130) => is_ended && is_bounded,
            // `doctor` exits with 5 if a condition is not met, for example on the machine on which the test runs.
            Some(5) => line.starts_with("scanhub doctor"),
            _ => false,
        };
        (!is_right).then(|| format!("{line}: {outcome}"))
    }
}

/// Verbs that end by themselves. The test waits for them as long as they need.
const ENDING_VERBS: [&str; 6] = ["doctor", "probe", "list", "info", "convert", "key"];

/// Time for which the test waits for a failure of a command that may run forever. A shorter time could only hide
/// failures, and a longer time cannot make a correct command fail.
const TIME_TO_FAIL: Duration = Duration::from_millis(1200);

/// Returns whether `group` contains a program of this project, and each such program has a handler for SIGINT (proc(5),
/// `SigCgt`).
fn catches_interrupts(group: Pid) -> bool {
    let processes = fs::read_dir("/proc").into_iter().flatten().flatten().map(|entry| entry.path());
    let ours = processes.filter_map(|process| {
        let stat = fs::read_to_string(process.join("stat")).ok()?;
        let (name, rest) = stat.rsplit_once(") ")?;
        let is_ours =
            name.ends_with("(scanhub") && rest.split(' ').nth(2)? == group.as_raw_nonzero().to_string();
        let status = is_ours.then(|| fs::read_to_string(process.join("status")).ok()).flatten()?;
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"))?;
        let caught = u64::from_str_radix(caught.trim(), 16).ok()?;
        Some(caught >> (Signal::INT.as_raw() - 1) & 1 == 1)
    });
    let catches: Vec<bool> = ours.collect();
    !catches.is_empty() && catches.iter().all(|catches| *catches)
}

/// Runs `lines` and returns a description of each failure.
fn failures(environment: &ShellEnv, lines: &[(String, String)]) -> Vec<String> {
    let wrong = |(place, line): &(String, String)| Some(format!("{place}: {}", environment.run(line)?));
    // These commands, and those that name a port, run one after the other, because they share resources. The resources
    // are the spare sensor, the domain for another hub, the single slot for a listener, and the state of the sensor
    // `front`. All other commands run in three concurrent rows, because commands wait most of the time.
    const SEQUENTIAL_COMMANDS: [&str; 6] = [
        "scanhub run",
        "scanhub replay",
        "scanhub control",
        "scanhub background",
        "scanhub listen",
        "scanhub gateway",
    ];
    let (in_turn, others): (Vec<_>, Vec<_>) = lines
        .iter()
        .partition(|(_, line)| PORTS.iter().chain(&SEQUENTIAL_COMMANDS).any(|part| line.contains(part)));
    let rows = others.chunks(others.len().div_ceil(3).max(1)).map(<[_]>::to_vec).chain([in_turn]);
    let wrong = run_concurrently(rows, |row| row.into_iter().filter_map(wrong).collect::<Vec<_>>());
    wrong.concat()
}

#[test]
fn every_shell_line_of_the_pages_runs() {
    let lines: Vec<_> =
        command_lines().into_iter().filter(|(_, line)| !is_excluded(line) && !needs_network(line)).collect();
    assert!(lines.len() > 25, "{lines:#?}");
    let (desk, _running) = ShellEnv::new();
    let wrong = failures(&desk, &lines);
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn every_network_line_of_the_pages_runs() {
    in_a_network("pages::lines::every_network_line_of_the_pages_runs", || {
        let lines: Vec<_> = command_lines().into_iter().filter(|(_, line)| needs_network(line)).collect();
        assert!(lines.len() > 3, "{lines:#?}");
        let (desk, _running) = ShellEnv::new();
        // Lines that start a listener or a gateway run first. The other lines then run while a listener publishes,
        // which the page assumes.
        let (alone, follows): (Vec<_>, Vec<_>) = lines
            .into_iter()
            .partition(|(_, line)| line.contains("scanhub listen") || line.contains("gateway"));
        let mut wrong = failures(&desk, &alone);
        let name = "--name=robot1=5f3a12bc00d1e2f3";
        let mut listener = desk.env.start(&["listen", "--json", "--publish", name, "--interface=lo"]).ready();
        let mut sender = TestGateway::new(0x5f3a_12bc_00d1_e2f3, 7, 0, "front");
        sender.wait_until_published(&mut listener, &[Topic::Scan, Topic::Zones]);
        wrong.extend(failures(&desk, &follows));
        assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    });
}

/// Each entry in the lists of excluded lines must still be the start of a line, and must name only existing files.
#[test]
fn excluded_shell_lines_exist_and_name_existing_files() {
    let lines = command_lines();
    for (begin, reason) in SKIPPED_COMMANDS {
        assert!(lines.iter().any(|(_, line)| line.starts_with(begin)), "{begin} is on no page: {reason}");
    }
    for (part, reason) in NOT_RUN_IF_CONTAINS {
        assert!(lines.iter().any(|(_, line)| line.contains(part)), "{part} is on no page: {reason}");
    }
    let top = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    for (place, line) in lines.iter().filter(|(_, line)| is_excluded(line)) {
        for word in commands(line).concat() {
            let path = word.trim_start_matches("./").trim_start_matches("../scanhub/");
            let is_ours =
                ["clients", "schema", "hub/", "tests/", "docs/"].iter().any(|top| path.starts_with(top));
            assert!(!is_ours || top.join(path).exists(), "{place}: {line}: there is no {path}");
        }
    }
}

#[test]
fn failing_shell_line_is_detected() {
    let (desk, _running) = ShellEnv::new();
    for line in
        ["scanhub ecko front/scan", "scanhub info rear", "scanhub convert none.mcap x.mcap", "scnahub list"]
    {
        assert!(desk.run(line).is_some(), "{line}");
    }
    assert_eq!(desk.run("scanhub list"), None);
}
