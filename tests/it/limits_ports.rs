//! Conflicts between two users of one port: two hubs, or two links of one hub.

use std::fs;
use std::os::unix::fs::symlink;

use serde_json::json;

use crate::testkit::{Outcome, TERM, TestEnv, wait_until};

fn error_of(outcome: &Outcome) -> serde_json::Value {
    let line = outcome.stderr.lines().last().unwrap_or_else(|| panic!("{outcome}"));
    serde_json::from_str(line).unwrap_or_else(|_| panic!("{outcome}"))
}

#[test]
fn second_hub_waits_for_the_port_and_names_its_holder() {
    let (env, other) = (TestEnv::new(), TestEnv::new());
    let _simulator = env.simulator(&["front"], &["--seed=71", "--baud=500000"]);
    let first = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let second = other.hub(&[env.link("front")]);
    assert!(second.has_printed(|line| line["waiting"] == json!(["front"])));
    let holder = format!("in use by process {} (scanhub)", first.pid());
    let info = other.info("front");
    assert!(info["last_error"].as_str().is_some_and(|error| error.contains(&holder)), "{info}");
    assert_eq!(env.info("front")["state"], "streaming", "the running hub was disturbed");
    assert_eq!(first.end(TERM).exit_code, Some(0));
    other.await_info("front", |info| info["state"] == "streaming");
    assert_eq!(second.end(TERM).exit_code, Some(0));
}

#[test]
fn two_links_with_one_port_are_refused() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--baud=500000"]);
    symlink(env.path("front"), env.path("stable")).expect("a symlink");
    for second in ["front", "stable"] {
        let links = [env.link("front"), format!("--link=rear={}", env.path_argument(second))];
        let refused = env.run(&["run", "--json", &links[0], &links[1]]);
        let error = error_of(&refused);
        assert_eq!((refused.exit_code, &error["kind"]), (Some(78), &"configuration".into()), "{refused}");
        let expected = "links front and rear have the same port: ";
        assert!(error["message"].as_str().is_some_and(|message| message.starts_with(expected)), "{refused}");
    }
}

#[test]
fn only_one_of_two_links_opens_a_shared_port() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("one"), env.link("two")]);
    let _simulator = env.simulator(&["front"], &["--seed=72", "--baud=500000"]);
    let pty = fs::read_link(env.path("front")).expect("a symlink");
    for name in ["one", "two"] {
        symlink(&pty, env.path(name)).expect("a symlink");
    }
    // The link that opens the port first gets the port.
    wait_until("one link streams and the other one reports the reason", || {
        let infos = ["one", "two"].map(|name| env.info(name));
        let streams = infos.iter().filter(|info| info["state"] == "streaming").count();
        let is_refused = |info: &&serde_json::Value| {
            let error = info["last_error"].as_str().unwrap_or_default();
            info["state"] == "absent" && error.contains("in use by another link of this hub")
        };
        streams == 1 && infos.iter().filter(is_refused).count() == 1
    });
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}
