//! The lines for a shell on the pages, run by a shell: with a hub and a sensor `front`, recordings under the names that
//! the pages use, and a spare sensor at every port that they name. What cannot be run is named here, with the reason.

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

/// Commands that are not run, by how their line begins or what is in it, and what makes sure of them. Those of the
/// program are read by `hub/cli.rs`.
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
/// The same of what is in the middle of a line.
const NOT_RUN_IF_CONTAINS: [(&str, &str); 1] = [("| ssh ", "needs another machine")];

/// Whether `line` is not run.
fn is_excluded(line: &str) -> bool {
    SKIPPED_COMMANDS.iter().any(|(begin, _)| line.starts_with(begin))
        || NOT_RUN_IF_CONTAINS.iter().any(|(part, _)| line.contains(part))
}

/// Whether `line` has to do with a network.
fn needs_network(line: &str) -> bool {
    ["scanhub listen", "scanhub gateway", "robot1."].iter().any(|part| line.contains(part))
}

/// All lines of all pages with their places.
fn command_lines() -> Vec<(String, String)> {
    let blocks = blocks().into_iter().filter(|block| block.language == "sh");
    let lines = blocks
        .flat_map(|block| lines(&block.text).into_iter().map(move |line| (block.location.clone(), line)));
    lines.collect()
}

/// What the pages take for granted.
struct ShellEnv {
    env: TestEnv,
    /// Of lines that were run.
    count: AtomicUsize,
}

/// Recordings of `front` under these names.
const RECORDINGS: [&str; 5] = ["walk.mcap", "day-0001.mcap", "cut.mcap", "killed.mcap", "robot.mcap"];
/// A part of a recording that lasts longer than the one here, and the like of this one.
const SHORTENED_RANGE: (&str, &str) = ("--start 1m --end 90s", "--start 200ms --end 500ms");
/// Ports that pages name.
const PORTS: [&str; 3] = ["/dev/serial/by-id/usb-FTDI...", "/dev/ttyUSB0", "/tmp/lms"];

impl ShellEnv {
    /// With what runs beside it, the simulator and the hub.
    fn new() -> (ShellEnv, [Program; 2]) {
        let env = TestEnv::new();
        let simulator = env.simulator(&["front", "spare"], &["--seed=82", "--baud=500000"]);
        let hub = env.hub(&[env.link("front")]);
        env.await_info("front", |info| info["state"] == "streaming");
        let recorded = env.run(&["record", "-o", &env.path_argument("one.mcap"), "--for=1s"]);
        assert_eq!(recorded.exit_code, Some(0), "{recorded}");
        let stream = env.run(&["echo", "front/telegram", "--raw", "-n", "5"]);
        fs::create_dir(env.path("bin")).expect("a directory");
        // One domain is not enough for two hubs.
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

    /// Runs `line`, and returns the problem, if there is one. A search for a scanner runs again while it finds none: on a busy machine,
    /// the simulated scanner may reply too late.
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

    /// Runs `line` in a new directory until it ends, or ends it with Ctrl-C. Returns the problem, if there is one.
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
            fs::write(&key, "5a".repeat(32)).expect("a key");
            fs::set_permissions(key, std::os::unix::fs::PermissionsExt::from_mode(0o600))
                .expect("it is ours");
        }
        let typed = PORTS.iter().fold(line.to_owned(), |line, port| {
            let is_made = line.starts_with("scanhub simulate");
            line.replace(port, &if is_made { "lms".into() } else { self.env.path_argument("spare") })
        });
        let typed = typed.replace(SHORTENED_RANGE.0, SHORTENED_RANGE.1);
        let mut shell = Command::new("sh");
        // A single command is the shell's own process, so that what ends it ends that.
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
        // Any other may last. It is ended when it can be, and has had time for something to go wrong.
        wait_until(line, || program.has_ended() || !ends && catches_interrupts(group));
        let started = Instant::now();
        wait_until(line, || program.has_ended() || started.elapsed() > TIME_TO_FAIL);
        let is_ended = !program.has_ended() && kill_process_group(group, Signal::INT).is_ok();
        let outcome = program.wait();
        let is_bounded = [" --for ", " -n "].iter().any(|flag| line.contains(flag));
        let is_right = match outcome.exit_code {
            Some(0) => true,
            // A bounded run that is interrupted says so.
            Some(130) => is_ended && is_bounded,
            // Of doctor: a condition is not met, here or on the machine that runs the test.
            Some(5) => line.starts_with("scanhub doctor"),
            _ => false,
        };
        (!is_right).then(|| format!("{line}: {outcome}"))
    }
}

/// Commands that end by themselves, however long that takes on this machine.
const ENDING_VERBS: [&str; 6] = ["doctor", "probe", "list", "info", "convert", "key"];

/// Time in which a command that lasts may fail. A longer or shorter time does not let a right one fail.
const TIME_TO_FAIL: Duration = Duration::from_millis(1200);

/// Whether there are programs of this project in `group`, and all of them have a handler for SIGINT (proc(5),
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

/// What is wrong with those of `lines` that can be run.
fn failures(environment: &ShellEnv, lines: &[(String, String)]) -> Vec<String> {
    let wrong = |(place, line): &(String, String)| Some(format!("{place}: {}", environment.run(line)?));
    // There is one spare sensor, one domain for another hub, one place for a listener, and one sensor to be told what
    // to do; the rest mostly waits.
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
fn every_line_for_a_shell_runs() {
    let lines: Vec<_> =
        command_lines().into_iter().filter(|(_, line)| !is_excluded(line) && !needs_network(line)).collect();
    assert!(lines.len() > 25, "{lines:#?}");
    let (desk, _running) = ShellEnv::new();
    let wrong = failures(&desk, &lines);
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn every_line_about_a_network_runs() {
    in_a_network("pages::lines::every_line_about_a_network_runs", || {
        let lines: Vec<_> = command_lines().into_iter().filter(|(_, line)| needs_network(line)).collect();
        assert!(lines.len() > 3, "{lines:#?}");
        let (desk, _running) = ShellEnv::new();
        // One after the other, each with what the one before it leaves running on the page.
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

/// What is not run is still a command that exists, with files that exist.
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
fn a_line_that_does_not_run_is_found() {
    let (desk, _running) = ShellEnv::new();
    for line in
        ["scanhub ecko front/scan", "scanhub info rear", "scanhub convert none.mcap x.mcap", "scnahub list"]
    {
        assert!(desk.run(line).is_some(), "{line}");
    }
    assert_eq!(desk.run("scanhub list"), None);
}
