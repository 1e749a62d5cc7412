//! `scanhub latency` with a streaming hub: the parts of a sample's age add up to the age, and the verb exits with 5 if
//! a limit is exceeded. For a remote sensor, the verb reports the parts that this machine can measure.

use std::collections::BTreeSet;

use crate::testkit;
use crate::testkit::{INT, Outcome, TERM, TestEnv, TestGateway, in_a_network, number, wait_until};
use scanhub_schema::{Topic, Verdict, Zones};
use serde_json::{Value, json};

const PERCENTILE_KEYS: [&str; 6] = ["min_ns", "p50_ns", "p90_ns", "p99_ns", "p999_ns", "max_ns"];

/// Returns the last line of class `latency`, which has the results.
fn latency_line(outcome: &Outcome) -> Value {
    outcome.of_class("latency").pop().unwrap_or_else(|| panic!("no result: {outcome}"))
}

/// Returns the number of measurements of `span`, and asserts that the percentiles of these measurements are in order.
fn count(line: &Value, span: &str) -> u64 {
    let of = &line[span];
    if *of == Value::Null {
        return 0;
    }
    let times = PERCENTILE_KEYS.map(|key| number(of, key));
    assert!(times.is_sorted(), "{span}: {line}");
    number(of, "count")
}

#[test]
fn splits_ages_of_a_stream_and_checks_the_limit() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--seed=71", "--baud=500000"]);
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    for wait in ["doorbell", "event", "spin"] {
        let by = format!("--wait={wait}");
        let outcome = env.run(&["latency", "front/scan", "-n", "20", "--json", &by, "--max-p99=1h"]);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let conditions = &outcome.lines()[0];
        assert_eq!((&conditions["class"], &conditions["wait"]), (&json!("conditions"), &json!(wait)));
        assert!(conditions["clock_read_ns"].as_f64().is_some_and(|ns| ns > 0.0), "{conditions}");
        let all = conditions["realtime"] == true && conditions["memory_locked"] == true;
        assert_eq!(
            conditions["refused"] == json!([]),
            all,
            "the missing parts must be explained: {conditions}"
        );
        let line = latency_line(&outcome);
        assert_eq!((number(&line, "received"), number(&line, "in_future")), (20, 0), "{line}");
        assert_eq!(line["flags"][0], "simulated");
        assert_eq!(count(&line, "age") + number(&line, "before"), 20, "{line}");
        // On a busy machine, a sample may spend more time in the hub than its header can hold. The sample then does not
        // count in `hub`.
        let in_hub = count(&line, "hub");
        assert!(in_hub == count(&line, "wake") && in_hub <= count(&line, "age"), "{line}");
        // On a busy machine, the stamps of a telegram may be estimated. The time that the telegram took on the line is
        // then unknown.
        assert!(count(&line, "line") <= 20 && count(&line, "line") == count(&line, "total"), "{line}");
        for part in ["hub", "wake"].into_iter().filter(|_| in_hub > 0) {
            assert!(number(&line[part], "max_ns") <= number(&line["age"], "max_ns"), "{line}");
        }
        assert_eq!(line["network"], Value::Null);
        let summary = &outcome.of_class("summary")[0];
        assert_eq!((number(summary, "received"), &summary["topic"]), (20, &json!("scan")));
    }
    let outcome = env.run(&["latency", "front/scan", "front/telegram", "-n20", "--json", "--max-p99=1us"]);
    assert_eq!(
        (outcome.exit_code, &outcome.of_class("error")[0]["kind"]),
        (Some(5), &json!("check")),
        "{outcome}"
    );
    // The verb also prints a result line every second for each topic.
    let results = outcome.of_class("latency");
    let topics: BTreeSet<_> = results.iter().map(|line| line["topic"].to_string()).collect();
    assert_eq!(topics.len(), 2, "{outcome}");
    let mut latency = env.start(&["latency", "front/scan", "--json"]);
    let line = latency.await_line("a time on the line", |line| count(line, "line") > 0);
    // A telegram has 732 bytes with ten bits each, which take 14.6 ms at 500,000 baud.
    assert!(number(&line["line"], "max_ns") > 14_000_000, "{line}");
    assert!(number(&line["total"], "min_ns") > number(&line["line"], "min_ns"), "{line}");
    assert_eq!(latency.end(INT).exit_code, Some(0));
    // A status does not belong to a telegram: it has an age, but the age has no parts.
    let mut latency = env.start(&["latency", "front/status", "--json", "--no-realtime"]);
    let line = latency.await_line("a status", |line| line["age"] != Value::Null);
    assert_eq!((&line["line"], &line["hub"], &line["total"]), (&Value::Null, &Value::Null, &Value::Null));
    let outcome = latency.end(INT);
    assert_eq!((outcome.exit_code, &outcome.lines()[0]["realtime"]), (Some(0), &json!(false)), "{outcome}");
    assert!(
        number(&latency_line(&outcome), "before") <= 1,
        "at most the sample of the history was sent before"
    );
    let text = env.run(&["latency", "front/scan", "-n", "5"]);
    let out = String::from_utf8_lossy(&text.stdout).into_owned();
    // On a busy machine, all samples may have been sent before the subscriber was ready.
    let are_left_out = out.contains("5 were sent before this listened");
    assert!(are_left_out || out.contains("p99.9") && out.contains("\nwake "), "{text}");
    assert!(!out.contains(" ##"), "{text}");
    assert!(text.stderr.contains("wait by doorbell") && text.stderr.contains("ns to read"), "{text}");
    assert_eq!(env.run(&["latency"]).exit_code, Some(2));
    assert_eq!(env.run(&["latency", "front/scan", "--wait=long"]).exit_code, Some(2));
    assert_eq!((hub.end(TERM).exit_code, simulator.end(TERM).exit_code), (Some(0), Some(0)));
}

#[test]
fn splits_remote_age_into_network_and_local_part() {
    in_a_network("latency::splits_remote_age_into_network_and_local_part", || {
        let env = TestEnv::new();
        let mut sender = TestGateway::new(0x5f3a_12bc_00d1_e2f3, 7, 3, "front");
        let publisher = ["listen", "--json", "--publish", "--name=robot1=5f3a12bc00d1e2f3"];
        let mut listener = env.start(&publisher).ready();
        sender.wait_until_published(&mut listener, &[Topic::Zones]);
        let mut latency = env.start(&["latency", "--json", "robot1.front/zones"]);
        wait_until("latency is attached", || env.subscribers("robot1.front/zones") == 1);
        let zones = Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() };
        let known = |line: &Value| line["class"] == "latency" && line["age"] != Value::Null;
        sender.stamp_ns = testkit::wall_ns() - 50_000_000;
        // Samples that were sent before `latency` was attached do not count.
        let mut line = Value::Null;
        wait_until("latency prints an age", || {
            sender.send(Topic::Zones, &zones);
            latency.printed(known).map(|printed| line = printed).is_some()
        });
        assert_eq!(line["flags"], json!(["simulated", "remote"]), "{line}");
        assert!(number(&line["network"], "min_ns") > 49_000_000, "{line}");
        assert_eq!((&line["line"], &line["hub"]), (&Value::Null, &Value::Null));
        // The listener itself also publishes zones, when datagrams are missing. These have not passed the network.
        assert!((1..=count(&line, "age")).contains(&count(&line, "network")), "{line}");
        assert_eq!(number(&line, "in_future"), 0, "{line}");
        // Now the clock of the gateway is ahead by an hour.
        sender.stamp_ns = testkit::wall_ns() + 3_600_000_000_000;
        sender.send(Topic::Zones, &zones);
        let line = latency.await_line("a stamp in the future", |line| line["in_future"] == 1);
        assert!(count(&line, "age") > count(&line, "network"), "{line}");
        assert_eq!(latency.end(INT).exit_code, Some(0));
        assert_eq!(listener.end(TERM).exit_code, Some(0));
    });
}
