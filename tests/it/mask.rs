//! Tests of `zones mask` for a robot that has a post in view of its own sensor. The verdict is `stop` until the mask
//! hides the post.

use crate::testkit;
use crate::testkit::{INT, KILL, Outcome, Program, TERM, TestEnv, is_class};

/// Returns the argument for a room of 6 m by 6 m with `thing` in it.
fn world(env: &TestEnv, thing: &str) -> String {
    let room = "[noise]\ntail = 0\n\n[[thing]]\nline = [[3000, -3000], [3000, 3000], [-3000, 3000], [-3000, -3000]]\n";
    format!("--world={}", env.file("world.toml", format!("{room}\n{thing}")))
}

/// Texts of warnings that the verb may print with a mask. On a busy machine, it also prints a warning about missed
/// scans.
const WARNINGS: [&str; 3] = ["nothing of the robot", "something moved", "are hidden"];

const POST_WORLD: &str = "[[thing]]\nradius_mm = 20\npose = [0, 400]\n";

fn simulator(env: &TestEnv, world: &str) -> Program {
    env.simulator(&["front"], &["--seed=51", "--baud=500000", world])
}

/// Runs `zones front mask` with the arguments `more`. If the verb received too few scans, runs it again with a longer
/// `--for`, as the error message advises.
fn mask(env: &TestEnv, more: &[&str]) -> Outcome {
    let run = |time: &str| env.run(&[&["zones", "front", "mask", "--for", time], more].concat());
    let few = |outcome: &Outcome| {
        outcome.exit_code == Some(3) && outcome.to_string().contains("use a longer --for")
    };
    ["20s", "60s"].into_iter().fold(run("4s"), |last, time| if few(&last) { run(time) } else { last })
}

/// Waits until `front/zones` has the verdict `verdict`.
fn await_verdict(env: &TestEnv, verdict: &str) {
    env.echo(&["front/zones"]).await_line(verdict, |line| line["verdict"] == verdict);
}

#[test]
fn mask_with_zero_duration_is_refused() {
    let outcome = TestEnv::new().run(&["zones", "front", "mask", "--for=0s", "--json"]);
    assert_eq!(outcome.exit_code, Some(78), "{outcome}");
    assert_eq!(outcome.of_class("error")[0]["message"], "--for 0s measures nothing");
}

#[test]
fn mask_hides_the_robots_own_post() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, &world(&env, POST_WORLD));
    let hub = env.hub(&[env.link("front")]);
    await_verdict(&env, "stop");
    let outcome = mask(&env, &[]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert!(!WARNINGS.iter().any(|doubt| outcome.stderr.contains(doubt)), "{outcome}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));

    let text = String::from_utf8(outcome.stdout.clone()).unwrap();
    let table: toml::Table = text.parse().unwrap_or_else(|error| panic!("{error}: {outcome}"));
    let sectors = table["link"][0]["zones"]["body_mask"].as_array().unwrap();
    let key = |sector: &toml::Value, key: &str| sector[key].as_float().unwrap();
    // The post is 6 degrees wide, and one or two more beams on each side hit the edge of the post.
    let first = sectors.iter().map(|sector| key(sector, "from_deg")).fold(90.0, f64::min);
    let last = sectors.iter().map(|sector| key(sector, "to_deg")).fold(-90.0, f64::max);
    assert!((-5.0..=-2.5).contains(&first) && (2.5..=5.0).contains(&last), "{outcome}");
    assert!(sectors.iter().all(|sector| key(sector, "range") > 0.38), "{outcome}");

    let file = env.file("mask.toml", &text);
    let _hub = env.hub(&[&env.link("front"), "--config", &file]);
    await_verdict(&env, "clear");
    let mut subscriber = env.echo(&["front/zones"]);
    let lines = subscriber.await_lines(100, "a verdict", is_class("zones"));
    // On a busy machine a scan may be late, which makes the verdict `unknown`. But no verdict may be `slow` or `stop`.
    let violations: Vec<_> =
        lines.iter().filter(|line| line["verdict"] == "stop" || line["verdict"] == "slow").collect();
    assert!(violations.is_empty(), "{violations:#?}");
    // An active mask does not affect the next run of the verb, because the hub publishes topic `scan` without the mask.
    let again = mask(&env, &["--json"]);
    assert_eq!(again.exit_code, Some(0), "{again}");
    let mask = &again.of_class("mask")[0];
    assert_eq!(
        (&mask["sensor"], &mask["within_m"], &mask["of_beams"]),
        (&"front".into(), &1.0.into(), &361.into())
    );
    assert_eq!(mask["body_mask"].as_array().map(|sectors| sectors.is_empty()), Some(false), "{mask}");
    assert_eq!(mask["moving"], serde_json::json!([]), "{mask}");
}

#[test]
fn empty_mask_loads_into_a_hub() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, &world(&env, ""));
    let hub = env.hub(&[env.link("front")]);
    await_verdict(&env, "clear");
    let outcome = mask(&env, &[]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let warning = "the sensor does not see the robot within 1.0 m of its center: no mask is needed";
    assert!(outcome.stderr.contains(warning), "{outcome}");
    assert!(outcome.stdout.ends_with(b"body_mask = []\n"), "{outcome}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    let file = env.file("mask.toml", &outcome.stdout);
    let _hub = env.hub(&[&env.link("front"), "--config", &file]);
    await_verdict(&env, "clear");

    // Walls are not part of the robot. If the circle of `--within` is as large as the room, the verb nevertheless masks
    // the walls, and prints a warning.
    let outcome = mask(&env, &["--within", "6"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert!(outcome.stderr.contains("the hub will be blind there"), "{outcome}");
}

#[test]
fn suggests_a_larger_within_for_a_distant_body() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, &world(&env, "[[thing]]\nradius_mm = 40\npose = [0, 1200]\n"));
    let _hub = env.hub(&[&env.link("front"), "--set=zones.margin=0.5"]);
    await_verdict(&env, "slow");
    let outcome = mask(&env, &[]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert!(outcome.stderr.contains("the largest zone is violated") && outcome.stderr.contains("--within"));
    assert!(!outcome.stderr.contains("no mask is needed"), "{outcome}");
    let outcome = mask(&env, &["--within", "1.5"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert!(!WARNINGS.iter().any(|doubt| outcome.stderr.contains(doubt)), "{outcome}");
    assert!(!outcome.stdout.ends_with(b"body_mask = []\n"), "{outcome}");
}

#[test]
fn mask_without_enough_scans_is_refused() {
    let env = TestEnv::new();
    let mask = |more: &[&str]| env.run(&[&["zones", "front", "mask", "--json"], more].concat());
    assert_eq!(mask(&["--for=1s"]).exit_code, Some(3), "no hub");
    let simulator = simulator(&env, &world(&env, POST_WORLD));
    let hub = env.hub(&[env.link("front")]);
    await_verdict(&env, "stop");

    let outcome = mask(&["--for=700ms"]);
    let error = &outcome.of_class("error")[0];
    assert_eq!((outcome.exit_code, &error["kind"]), (Some(3), &"timeout".into()), "{outcome}");
    assert!(error["hint"].as_str().is_some_and(|hint| hint.contains("--for")), "{outcome}");
    for within in ["--within=0", "--within=-1", "--within=nan", "--within=66"] {
        assert_eq!(mask(&["--for=1s", within]).exit_code, Some(78), "{within}");
    }
    let unknown = env.run(&["zones", "side", "mask", "--for=1s", "--json"]);
    assert_eq!(unknown.exit_code, Some(3), "{unknown}");
    assert!(
        unknown.stderr.is_empty() && unknown.of_class("error")[0]["hint"] == "there are front",
        "{unknown}"
    );

    // Interrupt the verb, start it again, and kill the hub while the verb runs.
    let looking = env.start(&["zones", "front", "mask", "--for=1h", "--json"]);
    testkit::wait_until("a subscriber to scans", || env.subscribers("front/scan") == 1);
    assert_eq!(looking.end(INT).exit_code, Some(130));
    let looking = env.start(&["zones", "front", "mask", "--for=1h", "--json"]);
    testkit::wait_until("a subscriber to scans", || env.subscribers("front/scan") == 1);
    drop(hub.end(KILL));
    let left = looking.wait();
    assert_eq!(left.exit_code, Some(1), "{left}");
    assert_eq!(left.of_class("error")[0]["message"], "the hub has exited");
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
}
