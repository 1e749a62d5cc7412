//! Limits of a process for its address space and for the length of files. A program that needs more than a limit allows
//! reports this and exits with 75. It does so before it creates files that would remain.

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Command, Stdio};

use crate::testkit::{Outcome, Program, TERM, TestEnv, spawn};
use rustix::process::{Pid, kill_process};

/// Starts the program with the limit `limit`, which has the form of arguments of the shell's `ulimit`.
fn start_limited<S: AsRef<str>>(env: &TestEnv, limit: &str, arguments: &[S]) -> Program {
    let inner = env.command(arguments);
    let mut command = Command::new("sh");
    command.args(["-c", &format!("ulimit {limit} && exec \"$0\" \"$@\"")]);
    command.arg(inner.get_program()).args(inner.get_args());
    command.envs(inner.get_envs().filter_map(|(key, value)| Some((key, value?))));
    command.env_remove("SCANHUB_CONFIG");
    Program::start(command)
}

fn assert_out_of_resources(outcome: &Outcome, words: &str) {
    assert_eq!(outcome.exit_code, Some(75), "{outcome}");
    let text = outcome.stderr.clone() + &String::from_utf8_lossy(&outcome.stdout);
    assert!(text.contains(words), "{outcome}");
}

#[test]
fn hub_short_of_address_space_leaves_no_segment() {
    let env = TestEnv::new();
    let (mut short, mut is_up) = (0, false);
    // Increase the limit until the hub starts. With the lowest limits, the kernel cannot even load the program.
    for limit in (16_000..400_000).step_by(1_000) {
        let inner = env.command(&["run", "--json", &env.link("front")]);
        let mut command = Command::new("sh");
        command.args(["-c", &format!("ulimit -v {limit} && exec \"$0\" \"$@\"")]);
        command.arg(inner.get_program()).args(inner.get_args()).env("SCANHUB_END_WITH_PARENT", "1");
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut hub = spawn(command).expect("a shell starts");
        let mut line = String::new();
        BufReader::new(hub.stdout.take().expect("a pipe")).read_line(&mut line).expect("text");
        is_up = line.contains("ready");
        if is_up {
            let pid = Pid::from_raw(hub.id() as i32).expect("a process");
            kill_process(pid, TERM).expect("the hub runs");
        }
        let outcome = hub.wait_with_output().expect("the hub exits");
        let errors = String::from_utf8_lossy(&outcome.stderr);
        if errors.contains("address space is short: ") {
            assert_eq!(outcome.status.code(), Some(75), "{limit}: {errors}");
            short += 1;
        } else if short > 0 {
            assert_eq!((is_up, outcome.status.code()), (true, Some(0)), "{limit}: {errors}");
        }
        assert_eq!(env.leftover_files(), Vec::<PathBuf>::new(), "{limit}: {errors}");
        if is_up {
            break;
        }
    }
    assert!(is_up && short > 4, "{short}");
}

#[test]
fn reports_a_file_size_limit_below_segment_size() {
    let env = TestEnv::new();
    let words = "the limit on file sizes is too low: ";
    for limit in ["1", "64", "250"] {
        let limit = format!("-f {limit}");
        assert_out_of_resources(
            &start_limited(&env, &limit, &["run", "--json", &env.link("front")]).wait(),
            words,
        );
        assert_eq!(env.leftover_files(), Vec::<PathBuf>::new());
    }
    let hub = env.hub(&[env.link("front")]);
    for verb in [
        &["record", "-o", &env.path_argument("walk.mcap")][..],
        &["info", "front"],
        &["echo", "front/status"],
    ] {
        assert_out_of_resources(&start_limited(&env, "-f 1", verb).wait(), words);
    }
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    let file = env.path_argument("none.mcap");
    assert_out_of_resources(
        &start_limited(&env, "-f 0", &["record", "-o", &file]).wait(),
        "cannot record into",
    );
    assert!(!env.path("none.mcap").exists());
}
