//! One port and more than one who wants it: two hubs, and two links of one hub.

use std::fs;
use std::os::unix::fs::symlink;

use serde_json::json;

use crate::testkit::{Outcome, TERM, TestEnv, until};

fn error_of(outcome: &Outcome) -> serde_json::Value {
    let line = outcome.errors.lines().last().unwrap_or_else(|| panic!("{outcome}"));
    serde_json::from_str(line).unwrap_or_else(|_| panic!("{outcome}"))
}

#[test]
fn second_hub_waits_for_the_port_and_names_the_first_one() {
    let (env, other) = (TestEnv::new(), TestEnv::new());
    let _simulator = env.simulator(&["front"], &["--seed=71", "--baud=500000"]);
    let first = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let second = other.hub(&[env.link("front")]);
    assert!(second.has_said(|line| line["waiting"] == json!(["front"])));
    let holder = format!("in use by process {} (scanhub)", first.pid());
    let info = other.info("front");
    assert!(info["last_error"].as_str().is_some_and(|error| error.contains(&holder)), "{info}");
    assert_eq!(env.info("front")["state"], "streaming", "was disturbed");
    assert_eq!(first.end(TERM).code, Some(0));
    other.await_info("front", |info| info["state"] == "streaming");
    assert_eq!(second.end(TERM).code, Some(0));
}

#[test]
fn two_links_at_one_port_are_refused() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--baud=500000"]);
    symlink(env.path("front"), env.path("stable")).expect("a symlink");
    for second in ["front", "stable"] {
        let links = [env.link("front"), format!("--link=rear={}", env.word(second))];
        let refused = env.run(&["run", "--json", &links[0], &links[1]]);
        let error = error_of(&refused);
        assert_eq!((refused.code, &error["kind"]), (Some(78), &"configuration".into()), "{refused}");
        let said = "links front and rear have the same port: ";
        assert!(error["message"].as_str().is_some_and(|message| message.starts_with(said)), "{refused}");
    }
}

#[test]
fn two_names_that_become_one_port_later_are_told_apart() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("one"), env.link("two")]);
    let _simulator = env.simulator(&["front"], &["--seed=72", "--baud=500000"]);
    let pty = fs::read_link(env.path("front")).expect("a symlink");
    for name in ["one", "two"] {
        symlink(&pty, env.path(name)).expect("a symlink");
    }
    // Whoever comes first has it.
    until("one of them streams and the other one says why not", || {
        let infos = ["one", "two"].map(|name| env.info(name));
        let streams = infos.iter().filter(|info| info["state"] == "streaming").count();
        let tells = |info: &&serde_json::Value| {
            let error = info["last_error"].as_str().unwrap_or_default();
            info["state"] == "absent" && error.contains("in use by another link of this hub")
        };
        streams == 1 && infos.iter().filter(tells).count() == 1
    });
    assert_eq!(hub.end(TERM).code, Some(0));
}
