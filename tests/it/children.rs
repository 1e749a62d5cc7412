//! Cleanup of child processes. The testkit ends each child together with its descendants, and it ends the processes
//! that interrupted test runs left.

use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::process::ExitStatusExt;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use rustix::process::Signal;

use crate::testkit::{
    Child, Program, TestEnv, can_open_terminal, end_runs_of, output, own_program, single_test_args, spawn,
    status, wait_until, write_program,
};

/// Variable that the testkit sets in the environment of each child. It names the test binary from which a process
/// descends.
const RUN_VARIABLE: &str = "SCANHUB_TEST_RUN";
/// Variable that is set in the test process that acts as the next test run.
const NEXT_RUN_VARIABLE: &str = "SCANHUB_TEST_NEXT_RUN";

/// Returns whether the process `pid` is running. A zombie does not count as running.
fn is_running(pid: &str) -> bool {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    stat.rsplit_once(')').is_some_and(|(_, rest)| !rest.trim_start().starts_with(['Z', 'X']))
}

/// Starts a shell with `script`, and returns the shell and its first line of output.
fn shell(script: &str) -> (Child, String) {
    let mut shell = Command::new("sh");
    shell.args(["-c", script]).stdin(Stdio::null()).stdout(Stdio::piped());
    let mut shell = spawn(shell).expect("sh starts");
    let mut line = String::new();
    let out = shell.stdout.take().expect("a pipe");
    BufReader::new(out).read_line(&mut line).expect("text");
    (shell, line.trim().to_owned())
}

#[test]
fn dropping_a_script_ends_its_children() {
    // Debian's browser is such a shell script: it starts another program without `exec`.
    let (script, child) = shell("sleep 1000 & echo $!; wait");
    assert!(is_running(&child));
    drop(script);
    assert!(!is_running(&child), "the child of the script still runs");
    // In this script, the shell exits before its child.
    let (mut script, child) = shell("sleep 1000 & echo $!");
    assert!(script.wait().is_ok_and(|status| status.success()) && is_running(&child));
    drop(script);
    assert!(!is_running(&child), "the child of an ended script still runs");
    // In this script, the shell and its child ignore TERM.
    let (script, child) = shell("trap '' TERM; sleep 1000 & echo $!; wait");
    drop(script);
    assert!(!is_running(&child), "TERM was ignored");
}

#[test]
fn dropping_a_program_ends_its_daemons() {
    if !can_open_terminal() {
        return;
    }
    let (mut script, daemon) = shell("setsid --fork sh -c 'echo $$; exec sleep 1000'");
    assert!(script.wait().is_ok_and(|status| status.success()));
    assert_eq!(script.living_command_lines().len(), 1, "{:?}", script.living_command_lines());
    drop(script);
    assert!(!is_running(&daemon), "the daemon still runs");
}

#[test]
fn outcome_lists_leftover_processes() {
    let mut script = Command::new("sh");
    script.args(["-c", "sleep 1000 > /dev/null 2>&1 & exit 0"]);
    let outcome = Program::start(script).wait();
    assert_eq!(
        (outcome.exit_code, outcome.leftover_processes.len()),
        (Some(0), 1),
        "{outcome}: {:?}",
        outcome.leftover_processes
    );
}

/// Starts a process that looks like a descendant of the test binary described by `run`.
fn start_with_run(run: &str) -> Child {
    let (child, _) = shell(&format!("echo; export {RUN_VARIABLE}='{run}'; exec sleep 1000"));
    wait_until("the process sleeps", || child.living_command_lines() == ["sleep 1000"]);
    child
}

fn is_killed(mut child: Child) -> bool {
    let status = child.try_wait().expect("a child");
    status.is_some_and(|status| status.signal() == Some(Signal::KILL.as_raw()))
}

#[test]
fn ends_processes_of_interrupted_runs() {
    let (env, own) = (TestEnv::new(), std::process::id());
    let (mut ended, run) = shell(&format!("echo ${RUN_VARIABLE}"));
    ended.wait().expect("the process exits");
    let start = run.rsplit(':').next().expect("the start time of this process");
    let (target, ended_pid) = (env.path_argument("target"), ended.id());
    // The test binaries of these processes have ended. In the second case, the ID of the test binary now belongs to
    // another process, which started later.
    let left =
        [format!("{target}:{ended_pid}:5"), format!("{target}:{own}:5")].map(|run| start_with_run(&run));
    // The test binaries of these processes must not match. The first one still runs, the second one started too late,
    // and the third one belongs to another target directory. The fourth value names no test binary.
    let kept = [
        format!("{target}:{own}:{start}"),
        format!("{target}:{ended_pid}:6"),
        format!("{target}x:{ended_pid}:5"),
        target.clone(),
    ];
    let mut kept = kept.map(|run| start_with_run(&run));
    end_runs_of(&target, 6);
    assert!(left.into_iter().all(is_killed));
    for child in &mut kept {
        assert_eq!(child.try_wait().ok(), Some(None), "{:?}", child.living_command_lines());
    }
}

#[test]
fn first_child_ends_interrupted_runs() {
    const NAME: &str = "children::first_child_ends_interrupted_runs";
    if std::env::var_os(NEXT_RUN_VARIABLE).is_some() {
        assert!(status(Command::new("true")).is_ok_and(|status| status.success()));
        return;
    }
    let (mut ended, run) = shell(&format!("echo ${RUN_VARIABLE}"));
    ended.wait().expect("the process exits");
    let target = run.rsplitn(3, ':').nth(2).expect("the target directory");
    let left = start_with_run(&format!("{target}:{}:5", ended.id()));
    let mut next = Command::new(own_program());
    let next =
        output(next.args(single_test_args(NAME)).env(NEXT_RUN_VARIABLE, "1")).expect("the program runs");
    assert!(next.status.success(), "{next:?}");
    assert!(is_killed(left));
}

#[test]
fn written_program_can_be_started_at_once() {
    let env = TestEnv::new();
    let is_over = AtomicBool::new(false);
    thread::scope(|scope| {
        // These threads start processes. If this process itself had the program's file open for writing, each child
        // would inherit the open file.
        for _ in 0..4 {
            scope.spawn(|| {
                while !is_over.load(Ordering::Relaxed) {
                    status(Command::new("true")).expect("`true` starts");
                }
            });
        }
        let failed = (0..200).find_map(|number| {
            let program = env.path(&format!("program{number}"));
            write_program(&program, "#!/bin/sh\n");
            output(Command::new(&program)).err()
        });
        is_over.store(true, Ordering::Relaxed);
        assert!(failed.is_none(), "{failed:?}");
    });
}
