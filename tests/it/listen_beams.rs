//! Remote sensors with more beams than an LMS, and with exact angles. `scanhub listen --publish` creates their topics
//! with the length of the received samples. Gateway, network and listener are real. The test compares each sample of
//! the remote sensor with the hub's sample.

use serde_json::{Value, json};

use crate::testkit::{
    INT, Program, TERM, TestEnv, TestGateway, contiguous_numbers, in_a_network, is_class, number,
};
use scanhub_schema::{ArrayFlags, Family, MAX_BEAMS, Scan, ScanHead, Topic};

/// Returns the values of a scan that must be the same at both ends. The other values depend on the machine that
/// published the scan.
fn values_of_scan(line: &Value) -> Vec<Value> {
    let keys = [
        "seq",
        "boot",
        "wall_ns",
        "family",
        "count",
        "ranges",
        "codes",
        "intensities",
        "angles_deg",
        "collisions",
    ];
    keys.map(|key| line[key].clone()).into()
}

#[test]
fn revolutions_of_any_length_arrive_complete() {
    in_a_network("listen_beams::revolutions_of_any_length_arrive_complete", || {
        let env = TestEnv::new();
        let simulator = |name: &str, model: &str, seed: u64| -> Program {
            let port = format!("--port={}", env.path(name).display());
            let of = ["simulate", "--json", "--family=ld", "--world=room", &port];
            env.start(&[&of[..], &[&format!("--model={model}"), &format!("--seed={seed}")]].concat()).ready()
        };
        let _simulators = [simulator("front", "ld19", 3), simulator("rear", "stl27l", 4)];
        let mut listener = env.start(&["listen", "--json", "--publish", "--interface=lo"]).ready();
        let topics = ["scan", "zones", "foreground", "background", "status", "telegram"];
        let topics = topics.map(|topic| format!("--topic=*/{topic}"));
        let words: Vec<_> =
            ["gateway", "--json", "--interface=lo"].into_iter().map(str::to_owned).chain(topics).collect();
        let mut gateway = env.start(&words);
        let id = gateway.await_line("line of class gateway", is_class("gateway"))["hub"].clone();
        let remote = |name: &str| format!("{}.{name}", id.as_str().unwrap_or_default());
        let settings = ["front.family=ld", "front.model=ld19", "rear.family=ld", "rear.model=stl27l"]
            .map(|set| format!("--set=link.{set}"));
        let background = "--set=background.scans=10".to_owned();
        let hub = env.hub(&[vec![env.link("front"), env.link("rear"), background], settings.into()].concat());
        for _ in 0..2 {
            listener.await_line("a sensor", |line| line["kind"] == "published");
        }
        for (name, beams) in [("front", 450), ("rear", 2_160)] {
            let there = remote(name);
            let follow = [there.as_str(), name].map(|sensor| {
                ["scan", "foreground", "background", "telegram"].map(|topic| format!("{sensor}/{topic}"))
            });
            let follow: Vec<_> = follow.iter().flatten().map(String::as_str).collect();
            let mut echo = env.echo(&follow);
            let is_there = |line: &Value| line["sensor"] == there.as_str();
            let is_model = |line: &Value| {
                is_there(line) && line["class"] == "background" && number(line, "count") == beams
            };
            echo.await_lines(25, "scans", |line| is_there(line) && is_class("scan")(line));
            echo.await_lines(5, "a foreground", |line| is_there(line) && is_class("foreground")(line));
            // The gateway sends a background only when it is new. The listener keeps the last one for late joiners.
            assert!(echo.has_printed(is_model), "no background with {beams} beams");
            let outcome = echo.end(INT);
            for topic in ["scan", "foreground", "telegram"] {
                let lines = outcome.of_class(topic);
                let (far, near): (Vec<_>, Vec<_>) = lines.into_iter().partition(is_there);
                // On a busy machine, `echo` may miss some samples, because it prints many topics. The network loses
                // none, which the test checks below.
                let numbers: Vec<u64> = far.iter().map(|line| number(line, "topic_seq")).collect();
                assert!(numbers.is_sorted_by(|one, next| one < next), "{topic}: {numbers:?}");
                let same = |line: &Value| near.iter().find(|it| it["seq"] == line["seq"]).cloned();
                let both = far.iter().filter_map(|line| Some((line, same(line)?)));
                let mut compared = 0;
                for (far, near) in both {
                    compared += 1;
                    assert_eq!(values_of_scan(far), values_of_scan(&near), "{topic}");
                    assert_eq!(
                        (&far["data"], &far["packets"], &far["beams"]),
                        (&near["data"], &near["packets"], &near["beams"])
                    );
                    if topic == "scan" {
                        assert_eq!((number(far, "count"), &far["family"]), (beams, &json!("ld")));
                        assert_eq!(far["angles_deg"].as_array().map(Vec::len), Some(beams as usize));
                    }
                }
                assert!(compared >= 4, "{topic}: {compared}");
            }
        }
        assert_eq!((gateway.end(TERM).exit_code, hub.end(TERM).exit_code), (Some(0), Some(0)));
        let outcome = listener.end(TERM);
        assert!(outcome.of_class("lan").iter().all(|row| row["lost"] == 0), "{outcome}");
        let published = &outcome.of_class("lan_published")[0];
        assert_eq!(
            (&published["loan_failed"], &published["unannounced"]),
            (&json!(0), &json!(0)),
            "{published}"
        );
    });
}

#[test]
fn publishes_scans_that_grow_beam_by_beam() {
    in_a_network("listen_beams::publishes_scans_that_grow_beam_by_beam", || {
        let env = TestEnv::new();
        let words = ["listen", "--json", "--publish", "--name=robot1=5f3a12bc00d1e2f3"];
        let mut listener = env.start(&words).ready();
        let mut sender = TestGateway::new(0x5f3a_12bc_00d1_e2f3, 7, 3, "front");
        sender.family = Family::Ld;
        sender.wait_until_published(&mut listener, &[Topic::Scan]);
        let mut echo = env.echo(&["robot1.front/scan"]);
        let revolution_of = |beams: usize| {
            let head = ScanHead { contents: ArrayFlags::ALL, ..ScanHead::of_revolution(Family::Ld, beams) };
            Scan::of(head, &vec![1_234; beams])
        };
        let beams: Vec<usize> = (450..470).chain([MAX_BEAMS, 450]).collect();
        for &beams in &beams {
            sender.send(Topic::Scan, &*revolution_of(beams));
            let line = echo.await_line("a scan", is_class("scan"));
            assert_eq!(line["count"], beams);
            assert_eq!(line["ranges"].as_array().map(Vec::len), Some(beams));
        }
        contiguous_numbers(&echo.end(INT).of_class("scan"), "topic_seq");
        let outcome = listener.end(TERM);
        let published = &outcome.of_class("lan_published")[0];
        assert_eq!(
            (&published["loan_failed"], &published["shortage"]),
            (&json!(0), &json!(0)),
            "{published}"
        );
    });
}
