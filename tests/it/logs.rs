//! CARMEN logs: a subscriber receives each range and each code of a log. This is true for a replay of the log itself
//! and for replays of its conversions.

use crate::testkit::{INT, Outcome, TestEnv, number};
use serde_json::{Value, json};

/// Writes a log with `scans` scans, which are `period_ms` apart. Each scan starts with `ranges`. Returns its path.
fn log(env: &TestEnv, ranges: &[&str], scans: u64, period_ms: u64) -> String {
    let line = |scan: u64| {
        let beams: Vec<&str> = ranges.iter().chain([&"1.50"; 181]).take(181).copied().collect();
        let at = 1000.0 + (scan * period_ms) as f64 / 1000.0;
        format!("FLASER 181 {} 0 0 0 0 0 0 {at} host {at}\n", beams.join(" "))
    };
    env.file("a.log", (0..scans).map(line).collect::<String>())
}

/// Replays `file`, and returns the outcomes of a subscriber and of the player.
fn replay_and_echo(env: &TestEnv, file: &str) -> (Outcome, Outcome) {
    let words = ["replay", "--json", "--no-system-config", file, "--paused"];
    let player = env.start(&words).ready();
    let mut subscriber = env.echo(&["front/scan", "front/zones", "front/status"]);
    env.await_info("front", |info| info["state"] == "paused");
    assert_eq!(env.run(&["control", "front", "resume"]).exit_code, Some(0));
    subscriber.await_line("end of the recording", |line| line["last_error"] == "the recording is at its end");
    let player = player.wait();
    (subscriber.end(INT), player)
}

#[test]
fn log_encoding_is_chosen_by_range_and_reported() {
    for (ranges, unit_mm, bits, units, codes) in [
        (
            ["20.00", "81.90", "81.83", "81.82"],
            10,
            13,
            json!([2000, null, null, 8182]),
            json!([[1, "too_bright"], [2, "beyond"]]),
        ),
        (
            ["9.001", "16.383", "16.379", "8.190"],
            1,
            14,
            json!([9001, null, null, 8190]),
            json!([[1, "no_return"], [2, "weak"]]),
        ),
    ] {
        let env = TestEnv::new();
        let file = log(&env, &ranges, 3, 50);
        let stream = file.replace("a.log", "a.bin");
        let converted = env.run(&["convert", &file, &stream]);
        let read = format!("read as values of {unit_mm} mm in {bits} bits");
        assert!(converted.exit_code == Some(0) && converted.stderr.contains(&read), "{converted}");
        let (outcome, player) = replay_and_echo(&env, &file);
        assert!(player.stderr.lines().next().is_some_and(|line| line.contains(&read)), "{player}");
        for outcome in [outcome, replay_and_echo(&env, &stream).0] {
            let scans = outcome.of_class("scan");
            assert_eq!(scans.len(), 3, "{outcome}");
            for scan in scans {
                let first: Vec<_> =
                    scan["ranges"].as_array().into_iter().flatten().take(4).cloned().collect();
                assert_eq!((&scan["unit_um"], Value::from(first)), (&(1000 * unit_mm).into(), units.clone()));
                assert_eq!(scan["codes"], codes);
            }
        }
    }
}

#[test]
fn zones_stay_valid_until_the_next_scan_of_a_slow_log() {
    let env = TestEnv::new();
    // This period is much longer than the period of any streaming scanner.
    let file = log(&env, &["1.50"], 4, 400);
    let mcap = file.replace("a.log", "a.mcap");
    assert_eq!(env.run(&["convert", &file, &mcap]).exit_code, Some(0));
    for file in [file, mcap] {
        let (outcome, _) = replay_and_echo(&env, &file);
        let last = number(&outcome.of_class("scan")[3], "seq");
        let zones = outcome.of_class("zones");
        let first = zones
            .iter()
            .position(|zones| zones["verdict"] != "unknown")
            .unwrap_or_else(|| panic!("{outcome}"));
        // The lines after the last scan do not count. The client reports the silence there with the verdict `unknown`.
        let until_last = zones[first..].iter().take_while(|zones| zones["seq"] != last);
        let unknown = until_last.filter(|zones| zones["verdict"] == "unknown");
        assert_eq!(unknown.count(), 0, "{file}: {outcome}");
    }
}
