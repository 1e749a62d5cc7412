//! Files in which a hub saves state for the next hub. The tests check the location and the mode of these files, and
//! that a hub also works without them.

use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt};

use crate::testkit::{Outcome, Program, TERM, TestEnv, TestLine, wait_until};

#[test]
fn next_hub_begins_its_search_at_the_saved_rate() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--permanent-baud=19200"]);
    let hub = env.hub(&[env.lms_link("front")]);
    let directory = env.path("state/scanhub").join(env.domain().name());
    let rate_file = directory.join("front.rate");
    let expected = format!("19200 {}\n", env.path_argument("front"));
    wait_until("the hub saves the baud rate", || {
        fs::read_to_string(&rate_file).is_ok_and(|text| text == expected)
    });
    let mode = |path| fs::metadata(path).expect("the file exists").mode() & 0o7777;
    assert_eq!((mode(&directory), mode(&rate_file)), (0o700, 0o600));
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 0);

    // No scanner streams on this line, so the next hub has to search for one. It starts at the saved rate.
    let line = TestLine::create(&env.path("front"));
    let outcome = search(&env, &line, env.lms_link("front"));
    assert!(outcome.stderr.contains("the search begins at 19200 baud"), "{outcome}");

    // The hub ignores the saved rate in two cases: if the link with the same name has another port, and if other users
    // can write to the file.
    let other = TestLine::create(&env.path("other"));
    let outcome = search(&env, &other, format!("--link=front={},family=lms", env.path_argument("other")));
    assert!(!outcome.stderr.contains("the search begins at"), "{outcome}");
    fs::set_permissions(&rate_file, fs::Permissions::from_mode(0o666))
        .expect("the file belongs to this user");
    let line = TestLine::create(&env.path("again"));
    let outcome = search(&env, &line, format!("--link=front={},family=lms", env.path_argument("again")));
    assert!(!outcome.stderr.contains("the search begins at"), "{outcome}");
    assert!(outcome.stderr.contains("others can write it"), "{outcome}");
    assert!(outcome.stderr.contains("delete it; its content is learned again"), "{outcome}");
}

/// Runs a hub until it has sent a request on `line`, and returns its outcome with the log. The log shows at which rate
/// the search started. The current rate of the line would not show it, because the hub may already have tried the next
/// rate on a busy machine.
fn search(env: &TestEnv, line: &TestLine, link: String) -> Outcome {
    let mut command = env.command(&["run", "--json", &link]);
    command.env("SCANHUB_LOG", "debug");
    let hub = Program::start(command).ready();
    assert_eq!(line.wait_for_request(), 0x3A);
    let outcome = hub.end(TERM);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    outcome
}

#[test]
fn hub_streams_without_a_writable_state_directory() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=4"]);
    let mut command = env.command(&["run", "--json", &env.link("front")]);
    command.env("XDG_STATE_HOME", "/dev/null");
    let hub = Program::start(command).ready();
    env.await_info("front", |info| info["state"] == "streaming");
    let outcome = hub.end(TERM);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert!(outcome.stderr.contains("nothing is kept across restarts: /dev/null: "), "{outcome}");
}
