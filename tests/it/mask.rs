//! A robot that sees itself: it stops for its own post until it is told to look past it.

use crate::testkit;
use crate::testkit::{INT, KILL, Outcome, Program, TERM, TestEnv, is_class};

/// A room of six metres, and 0.4 m before the sensor what `thing` says.
fn world(env: &TestEnv, thing: &str) -> String {
    let room = "[noise]\ntail = 0\n\n[[thing]]\nline = [[3000, -3000], [3000, 3000], [-3000, 3000], [-3000, -3000]]\n";
    format!("--world={}", env.file("world.toml", format!("{room}\n{thing}")))
}

/// What is told beside a mask that a person should look at; on a busy machine also that scans were missed.
const DOUBTS: [&str; 3] = ["nothing of the robot", "something moved", "are hidden"];

const POST: &str = "[[thing]]\nradius_mm = 20\npose = [0, 400]\n";

fn simulator(env: &TestEnv, world: &str) -> Program {
    env.simulator(&["front"], &["--seed=51", "--baud=500000", world])
}

/// Runs the verb with these arguments, and for a longer time if the scans were too few, as its message advises.
fn mask(env: &TestEnv, more: &[&str]) -> Outcome {
    let run = |time: &str| env.run(&[&["zones", "front", "mask", "--for", time], more].concat());
    let few =
        |outcome: &Outcome| outcome.code == Some(3) && outcome.to_string().contains("use a longer --for");
    ["20s", "60s"].into_iter().fold(run("4s"), |last, time| if few(&last) { run(time) } else { last })
}

/// Waits until scans come and the verdict is `verdict`.
fn await_verdict(env: &TestEnv, verdict: &str) {
    env.echo(&["front/zones"]).await_line(verdict, |line| line["verdict"] == verdict);
}

#[test]
fn no_time_at_all_is_refused() {
    let outcome = TestEnv::new().run(&["zones", "front", "mask", "--for=0s", "--json"]);
    assert_eq!(outcome.code, Some(78), "{outcome}");
    assert_eq!(outcome.of_class("error")[0]["message"], "--for 0s measures nothing");
}

#[test]
fn a_robot_that_knows_its_own_post_goes_on() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, &world(&env, POST));
    let hub = env.hub(&[env.link("front")]);
    await_verdict(&env, "stop");
    let outcome = mask(&env, &[]);
    assert_eq!(outcome.code, Some(0), "{outcome}");
    assert!(!DOUBTS.iter().any(|doubt| outcome.errors.contains(doubt)), "{outcome}");
    assert_eq!(hub.end(TERM).code, Some(0));

    let text = String::from_utf8(outcome.out.clone()).unwrap();
    let table: toml::Table = text.parse().unwrap_or_else(|error| panic!("{error}: {outcome}"));
    let sectors = table["link"][0]["zones"]["body_mask"].as_array().unwrap();
    let key = |sector: &toml::Value, key: &str| sector[key].as_float().unwrap();
    // The post is 6 degrees wide, and a beam or two beside it meet its edge.
    let first = sectors.iter().map(|sector| key(sector, "from_deg")).fold(90.0, f64::min);
    let last = sectors.iter().map(|sector| key(sector, "to_deg")).fold(-90.0, f64::max);
    assert!((-5.0..=-2.5).contains(&first) && (2.5..=5.0).contains(&last), "{outcome}");
    assert!(sectors.iter().all(|sector| key(sector, "range") > 0.38), "{outcome}");

    let file = env.file("mask.toml", &text);
    let _hub = env.hub(&[&env.link("front"), "--config", &file]);
    await_verdict(&env, "clear");
    let mut consumer = env.echo(&["front/zones"]);
    let lines = consumer.await_lines(100, "a verdict", is_class("zones"));
    // On a busy machine a scan may be late, which is `unknown`; but nothing is seen.
    let seen: Vec<_> =
        lines.iter().filter(|line| line["verdict"] == "stop" || line["verdict"] == "slow").collect();
    assert!(seen.is_empty(), "{seen:#?}");
    // A mask that is in force does not hinder the next one: scans are as the sensor sends them.
    let again = mask(&env, &["--json"]);
    assert_eq!(again.code, Some(0), "{again}");
    let mask = &again.of_class("mask")[0];
    assert_eq!(
        (&mask["sensor"], &mask["within_m"], &mask["of_beams"]),
        (&"front".into(), &1.0.into(), &361.into())
    );
    assert_eq!(mask["body_mask"].as_array().map(|sectors| sectors.is_empty()), Some(false), "{mask}");
    assert_eq!(mask["moving"], serde_json::json!([]), "{mask}");
}

#[test]
fn nothing_there_is_an_empty_mask_that_a_hub_takes_too() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, &world(&env, ""));
    let hub = env.hub(&[env.link("front")]);
    await_verdict(&env, "clear");
    let outcome = mask(&env, &[]);
    assert_eq!(outcome.code, Some(0), "{outcome}");
    let doubt = "nothing of the robot is seen within 1.0 m of its centre: no mask is needed";
    assert!(outcome.errors.contains(doubt), "{outcome}");
    assert!(outcome.out.ends_with(b"body_mask = []\n"), "{outcome}");
    assert_eq!(hub.end(TERM).code, Some(0));
    let file = env.file("mask.toml", &outcome.out);
    let _hub = env.hub(&[&env.link("front"), "--config", &file]);
    await_verdict(&env, "clear");

    // The walls are no body, but in a circle that is as large as the room they are: that is told.
    let outcome = mask(&env, &["--within", "6"]);
    assert_eq!(outcome.code, Some(0), "{outcome}");
    assert!(outcome.errors.contains("the hub will be blind there"), "{outcome}");
}

#[test]
fn a_body_beyond_the_circle_that_violates_it_is_no_reason_to_do_without_a_mask() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, &world(&env, "[[thing]]\nradius_mm = 40\npose = [0, 1200]\n"));
    let _hub = env.hub(&[&env.link("front"), "--set=zones.margin=0.5"]);
    await_verdict(&env, "slow");
    let outcome = mask(&env, &[]);
    assert_eq!(outcome.code, Some(0), "{outcome}");
    assert!(outcome.errors.contains("the largest circle is violated") && outcome.errors.contains("--within"));
    assert!(!outcome.errors.contains("no mask is needed"), "{outcome}");
    let outcome = mask(&env, &["--within", "1.5"]);
    assert_eq!(outcome.code, Some(0), "{outcome}");
    assert!(!DOUBTS.iter().any(|doubt| outcome.errors.contains(doubt)), "{outcome}");
    assert!(!outcome.out.ends_with(b"body_mask = []\n"), "{outcome}");
}

#[test]
fn too_little_to_learn_from_is_refused() {
    let env = TestEnv::new();
    let mask = |more: &[&str]| env.run(&[&["zones", "front", "mask", "--json"], more].concat());
    assert_eq!(mask(&["--for=1s"]).code, Some(3), "no hub");
    let simulator = simulator(&env, &world(&env, POST));
    let hub = env.hub(&[env.link("front")]);
    await_verdict(&env, "stop");

    let outcome = mask(&["--for=700ms"]);
    let error = &outcome.of_class("error")[0];
    assert_eq!((outcome.code, &error["kind"]), (Some(3), &"timeout".into()), "{outcome}");
    assert!(error["hint"].as_str().is_some_and(|hint| hint.contains("--for")), "{outcome}");
    for within in ["--within=0", "--within=-1", "--within=nan", "--within=66"] {
        assert_eq!(mask(&["--for=1s", within]).code, Some(78), "{within}");
    }
    let unknown = env.run(&["zones", "side", "mask", "--for=1s", "--json"]);
    assert_eq!(unknown.code, Some(3), "{unknown}");
    assert!(
        unknown.errors.is_empty() && unknown.of_class("error")[0]["hint"] == "there are front",
        "{unknown}"
    );

    // Interrupted, and left alone by the hub.
    let looking = env.start(&["zones", "front", "mask", "--for=1h", "--json"]);
    testkit::until("it looks", || env.subscribers("front/scan") == 1);
    assert_eq!(looking.end(INT).code, Some(130));
    let looking = env.start(&["zones", "front", "mask", "--for=1h", "--json"]);
    testkit::until("it looks", || env.subscribers("front/scan") == 1);
    drop(hub.end(KILL));
    let left = looking.wait();
    assert_eq!(left.code, Some(1), "{left}");
    assert_eq!(left.of_class("error")[0]["message"], "the hub went away");
    assert_eq!(simulator.end(TERM).code, Some(0));
}
