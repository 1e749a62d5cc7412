//! A hub with an LMS on RS-232, on a pty: 500,000 baud loses the scanner until its power is cycled, so the hub falls back to
//! 38,400 baud, and remembers it.

use std::fs;

use crate::testkit::{KILL, Outcome, TERM, TestEnv, is_class};

const NEEDS: &str = "500000 baud needs RS-422";

/// Waits for a stream at 38,400 baud, and returns how the hub ended.
fn streams_slowly(env: &TestEnv) -> Outcome {
    let hub = env.hub(&[env.link("front")]);
    let mut echo = env.echo(&["front/scan", "front/status"]);
    let streaming =
        echo.await_line("streaming at 38400", |line| line["state"] == "streaming" && line["baud"] == 38_400);
    assert!(streaming["last_error"].as_str().is_some_and(|error| error.starts_with(NEEDS)), "{streaming}");
    let scan = echo.await_line("a scan", is_class("scan"));
    // 732 bytes take 191 ms at this rate.
    assert!(scan["period_us"].as_u64().is_some_and(|period| period > 180_000), "{scan}");
    hub.end(TERM)
}

#[test]
fn falls_back_to_38400_baud_and_the_next_hub_starts_there() {
    let env = TestEnv::new();
    let simulator =
        env.simulator_on_real_lines(&["front"], &["--boot=0.3", "--fault=rs232=1,power_at=5,power_every=6"]);
    let log = streams_slowly(&env).errors;
    assert_eq!(log.matches(NEEDS).count(), 1, "{log}");
    let saved = env.path("state/scanhub").join(env.place().name()).join("front.rate");
    let text = fs::read_to_string(&saved).unwrap_or_else(|error| panic!("{}: {error}", saved.display()));
    assert!(text.starts_with("38400,silent=2 "), "{text}");
    env.kill_simulator(simulator, "front");

    // After a power cycle, the scanner is at 9,600 baud. A single switch to 500,000 baud would lose it for good.
    let simulator = env.simulator_on_real_lines(&["front"], &["--fault=rs232=1"]);
    let log = streams_slowly(&env).errors;
    assert_eq!(log.matches(NEEDS).count(), 1, "{log}");
    assert_eq!(simulator.end(KILL).code, None);
}
