//! Test that `track` reports late scans while it runs.

#[path = "../../client/tests/fake/mod.rs"]
mod fake;

use std::ffi::OsStr;

use clap::Parser;
use fake::{FakeHub, RunningVerb, TestDomain, wait_until};
use scanhub_perception::verbs::TrackArgs;
use scanhub_verbs::context::{Context, DomainOptions};

#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    track: TrackArgs,
}

const SITE: &str = r#"
[[sensor]]
name = "front"
pose = { x = 0.0, y = 2.0, yaw = 0.0 }
[[sensor]]
name = "rear"
pose = { x = 5.0, y = 2.0, yaw = 3.1416 }
[[room]]
name = "hall"
polygon = [[0, 0], [5, 0], [5, 4], [0, 4]]
"#;
const MS: u64 = 1_000_000;
const RANGES: [u16; 4] = [300; 4];

/// Runs `track`, and sends scans of `rear` that are half a second late. Stops when a line with `text` has reported a
/// late scan. Returns the lines and the notes.
fn run_with_late_scans(json: bool, text: &str) -> (String, String) {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front", "rear"], 7);
    let site = test_domain.base.join("site.toml");
    std::fs::write(&site, SITE).unwrap();
    let args = Arguments::parse_from([OsStr::new("track"), OsStr::new("--site"), site.as_os_str()]).track;
    let domain =
        DomainOptions { name: test_domain.domain.name().to_owned(), root: Some(test_domain.base.clone()) };
    let verb = RunningVerb::start(move |out, notes, stop| {
        args.run(&mut Context::new(json, domain, (out, notes), Box::new(stop)))
    });
    for sensor in &hub.sensors {
        sensor.scan.await_subscribers(1);
        sensor.foreground.await_subscribers(1);
    }
    for seq in [1_000 * MS, 1_200 * MS, 1_400 * MS] {
        hub.sensors[0].publish_scan_with_foreground(seq, &RANGES);
    }
    // A scan is late only if the tracker has received a later scan of `front` before it, so several attempts may be
    // needed.
    let mut seq = 700 * MS;
    wait_until("a late scan is reported", || {
        seq += 1;
        hub.sensors[1].publish_scan_with_foreground(seq, &RANGES);
        [&verb.out, &verb.notes].iter().any(|lines| lines.text().contains(text))
    });
    verb.stop();
    let (end, out, notes) = verb.join();
    assert_eq!(end, Ok(()));
    (out, notes)
}

/// Returns the number after `key` in a line.
fn number(line: &str, key: &str) -> u64 {
    let (_, rest) = line.split_once(key).expect("the key");
    rest.chars().take_while(char::is_ascii_digit).collect::<String>().parse().expect("a number")
}

#[test]
fn json_reports_late_scans_by_sensor_and_count() {
    let (out, notes) = run_with_late_scans(true, r#""class":"late""#);
    assert_eq!(notes, "");
    let late: Vec<&str> = out.lines().filter(|line| line.contains(r#""class":"late""#)).collect();
    let first = r#"{"class":"late","sensor":"people","wall_ns":"#;
    // On a busy machine, the first line may count several scans.
    let is_right = |line: &str| {
        line.starts_with(first)
            && line.contains(r#","name":"rear","late":"#)
            && line.ends_with(r#","delay_ms":80}"#)
    };
    assert!(is_right(late[0]) && number(late[0], r#""late":"#) > 0, "{late:?}");
    let last = out.lines().last().expect("a summary");
    let sum: u64 = late.iter().map(|line| number(line, r#""late":"#)).sum();
    assert_eq!(number(last, r#""late":"#), sum, "{late:?} and {last}");
}

#[test]
fn late_scans_are_notes_with_a_remedy() {
    let (out, notes) = run_with_late_scans(false, "arrived late");
    let line = notes.lines().find(|line| line.contains("arrived late")).expect("a note");
    assert!(
        line.starts_with("rear: ") && line.ends_with("arrived late: set --delay longer than 80ms"),
        "{line}"
    );
    assert!(number(&out, "dropped: ") > 0, "{out}");
}
