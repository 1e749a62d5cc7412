//! Shortage of file descriptors. A program that needs more descriptors than it may have reports this and exits with 75.
//! A hub that runs out of descriptors continues to serve its subscribers, and reports that new subscribers receive
//! nothing.

use std::process::Command;

use crate::testkit::{
    INT, Outcome, Program, TERM, TestEnv, contiguous_numbers, in_a_network, is_class, number, output,
    run_concurrently, wait_until,
};
use rustix::process::{Pid, Resource, Rlimit, getrlimit, prlimit};

/// Starts the program with room for `limit` descriptors in addition to those that it inherits.
fn start_limited<S: AsRef<str>>(env: &TestEnv, limit: u64, arguments: &[S]) -> Program {
    let inner = env.command(arguments);
    let mut command = Command::new("sh");
    // Close descriptors that the test process may have left open. A shell can close only descriptors with one digit, so
    // the others are added to the limit.
    let closed = "exec 3<&- 4<&- 5<&- 6<&- 7<&- 8<&- 9<&-";
    let limit = limit + inherited_descriptors();
    let script = format!("{closed} && ulimit -n \"$0\" && exec \"$@\"");
    command.args(["-c", &script, &limit.to_string()]);
    command.arg(inner.get_program()).args(inner.get_args());
    command.envs(inner.get_envs().filter_map(|(key, value)| Some((key, value?))));
    command.env_remove("SCANHUB_CONFIG");
    Program::start(command)
}

/// Returns the number of descriptors from 10 on that a child of this process inherits.
fn inherited_descriptors() -> u64 {
    let mut shell = Command::new("sh");
    shell.args(["-c", "for fd in /proc/$$/fd/*; do echo ${fd##*/}; done"]);
    let listed = String::from_utf8(output(shell).expect("a shell starts").stdout).expect("numbers");
    listed.lines().filter(|fd| fd.parse::<u32>().is_ok_and(|fd| fd > 9)).count() as u64
}

fn assert_out_of_descriptors(outcome: &Outcome) {
    assert_eq!(outcome.exit_code, Some(75), "{outcome}");
    let text = outcome.stderr.clone() + &String::from_utf8_lossy(&outcome.stdout);
    assert!(text.contains("descriptors are short: ") || text.contains("Too many open files"), "{outcome}");
    assert!(!text.contains("panicked"), "{outcome}");
}

#[test]
fn hub_starts_or_reports_the_needed_descriptors() {
    let env = TestEnv::new();
    let run = ["run", "--json", &env.link("front")];
    for limit in [6, 8, 12, 16, 24, 32, 40, 48] {
        assert_out_of_descriptors(&start_limited(&env, limit, &run).wait());
    }
    for limit in [88, 96, 128] {
        let hub = start_limited(&env, limit, &run).ready();
        assert_eq!(env.info("front")["state"], "absent", "{limit}");
        assert_eq!(hub.end(TERM).exit_code, Some(0), "{limit}");
    }
}

#[test]
fn client_works_or_reports_the_needed_descriptors() {
    let env = TestEnv::new();
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "absent");
    let verbs = [
        &["info", "front"][..],
        &["list"],
        &["echo", "front/status", "-n", "1"],
        &["control", "front", "pause"],
    ];
    for limit in [5, 6, 8, 10] {
        // A program without enough descriptors cannot search for a hub. It exits instead of waiting for one.
        assert_out_of_descriptors(&start_limited(&env, limit, &["echo", "front/status"]).wait());
    }
    run_concurrently(verbs, |verb| {
        for limit in [5, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30, 32, 64] {
            let mut outcome = start_limited(&env, limit, verb).wait();
            wait_until("the hub replies in time", || {
                let is_late = outcome.exit_code == Some(3);
                if is_late {
                    outcome = start_limited(&env, limit, verb).wait();
                }
                !is_late
            });
            if outcome.exit_code != Some(0) {
                assert_out_of_descriptors(&outcome);
                assert!(limit < 64, "{outcome}");
            }
        }
    });
}

#[test]
fn hub_out_of_descriptors_keeps_serving_subscribers() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=51", "--baud=500000"]);
    let hub = start_limited(&env, 88, &["run", "--json", &env.link("front")]).ready();
    let mut served = env.echo(&["front/scan", "front/status"]);
    served.await_lines(20, "a scan", is_class("scan"));
    let others: Vec<_> = (0..16).map(|_| env.start(&["echo", "--json", "front/scan"])).collect();
    // Wait until all subscribers are attached, because only an attached subscriber is sure to exit after a signal.
    wait_until("all are attached", || env.subscribers("front/scan") == 17);
    let reports_shortage = |line: &serde_json::Value| {
        line["class"] == "status"
            && line["last_error"].as_str().is_some_and(|error| error.contains("attached but get nothing"))
    };
    served.await_line("report that clients are not served", reports_shortage);
    served.await_lines(20, "a scan", is_class("scan"));
    let refused = env.run(&["control", "front", "resync", "--json"]);
    let error = &refused.of_class("error")[0];
    assert_eq!((refused.exit_code, &error["kind"]), (Some(3), &"timeout".into()), "{refused}");
    assert_eq!(error["message"], "the hub did not reply for front in 5 s");
    for other in others {
        assert_eq!(other.end(INT).exit_code, Some(0));
    }
    // The hub has descriptors again, so new subscribers receive samples.
    wait_until("the hub has free descriptors again", || env.run(&["info", "front"]).exit_code == Some(0));
    served.await_line("report that all clients are served", |line| {
        line["class"] == "status" && line["last_error"] == ""
    });
    assert_eq!(env.run(&["echo", "front/scan", "-n", "5", "--timeout", "9s"]).exit_code, Some(0));
    let outcome = served.end(INT);
    contiguous_numbers(&outcome.of_class("scan"), "topic_seq");
    let summaries = outcome.of_class("summary");
    assert!(summaries.iter().all(|summary| number(summary, "missed") == 0), "{summaries:?}");
    let outcome = hub.end(TERM);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert!(outcome.stderr.contains("attached but get nothing"), "{outcome}");
    assert!(outcome.stderr.contains("a request was not received: descriptors are short: "), "{outcome}");
}

#[test]
fn listener_continues_after_descriptor_shortage() {
    in_a_network("limits_descriptors::listener_continues_after_descriptor_shortage", || {
        let env = TestEnv::new();
        let mut listener = env.start(&["listen", "--json", "--interface=lo"]).ready();
        let pid = Pid::from_raw(listener.pid() as i32);
        let maximum = getrlimit(Resource::Nofile).maximum;
        let none = Rlimit { current: Some(0), maximum };
        let usual = prlimit(pid, Resource::Nofile, none).expect("the limit can be reduced");
        let notice = listener.await_line("report of the shortage", |line| line["kind"] == "problem");
        assert!(notice["message"].to_string().contains("cannot list network interfaces"), "{notice}");
        prlimit(pid, Resource::Nofile, usual).expect("the limit can be restored");
        let outcome = listener.end(TERM);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        assert_eq!(outcome.of_class("notice").len(), 1, "{outcome}");
    });
}
