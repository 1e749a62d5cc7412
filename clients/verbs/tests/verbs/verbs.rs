//! Tests of `list`, `info` and `hz`, with and without a hub.

use std::time::Duration;

use crate::fake::{FakeHub, RunningVerb, TestDomain};
use crate::{context, domain_options};
use scanhub_schema::{Counter, Kind, Pose};
use scanhub_verbs::RunLimits;
use scanhub_verbs::hz::HzArgs;
use scanhub_verbs::info::InfoArgs;
use scanhub_verbs::list::ListArgs;

fn start_list(test_domain: &TestDomain, json: bool) -> RunningVerb {
    list(test_domain, ListArgs { domains: false }, json)
}

fn list(test_domain: &TestDomain, args: ListArgs, json: bool) -> RunningVerb {
    let domain = domain_options(test_domain);
    RunningVerb::start(move |out, notes, stop| args.run(&mut context(domain, json, out, notes, stop)))
}

fn start_info(test_domain: &TestDomain, sensor: Option<&str>, json: bool) -> RunningVerb {
    let (args, domain) = (InfoArgs { sensor: sensor.map(Into::into) }, domain_options(test_domain));
    RunningVerb::start(move |out, notes, stop| args.run(&mut context(domain, json, out, notes, stop)))
}

#[test]
fn list_and_info_fail_without_a_hub() {
    let test_domain = TestDomain::new();
    let verbs = [start_list(&test_domain, true), start_info(&test_domain, None, true)];
    for verb in verbs {
        assert_eq!(verb.join().0.unwrap_err().kind, Kind::NoHub);
    }
}

#[test]
fn list_prints_topics_and_rates_of_a_hub() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["rear", "front"], 1);
    for sensor in &mut hub.sensors {
        sensor.publish_status(|status| status.rate_mhz = 37_540);
    }
    let verb = start_list(&test_domain, true);
    hub.serve_history(|| verb.finished());
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()));
    const LISTED_TOPICS: [&str; 3] = [r#""topic":"telegram""#, r#""topic":"scan""#, r#""topic":"status""#];
    assert_eq!(
        out.lines()
            .filter(|line| LISTED_TOPICS.iter().any(|it| line.contains(it)))
            .take(3)
            .collect::<Vec<_>>(),
        [
            r#"{"class":"topic","sensor":"front","topic":"telegram","payload":"u8[]","revision":1,"hz":37.54,"subscribers":0}"#,
            r#"{"class":"topic","sensor":"front","topic":"scan","payload":"scanhub.Scan.v2","revision":1,"hz":37.54,"subscribers":0}"#,
            r#"{"class":"topic","sensor":"front","topic":"status","payload":"scanhub.Status.v2","revision":1,"hz":null,"subscribers":0}"#,
        ]
    );
    let rates: Vec<_> = out.lines().map(|line| line.contains(r#""hz":37.54"#)).collect();
    let of_one = [true, true, true, true, true, false, false];
    assert_eq!(rates, [of_one, of_one].concat(), "background and status come at their own time");
    let verb = start_list(&test_domain, false);
    hub.serve_history(|| verb.finished());
    let (_, out, _) = verb.join();
    assert_eq!(
        out.lines().nth(2),
        Some("front/scan        37.54            0  scanhub.Scan.v2               1"),
        "{out}"
    );
}

#[test]
fn list_prints_domains_with_a_running_hub() {
    let test_domain = TestDomain::new();
    let list = || {
        let (end, out, _) = list(&test_domain, ListArgs { domains: true }, true).join();
        assert_eq!(end, Ok(()));
        out
    };
    assert_eq!(list(), "");
    let _hub = FakeHub::new(&test_domain.domain, &[], 1);
    let (name, root, pid) =
        (test_domain.domain.name(), test_domain.domain.root().display(), std::process::id());
    let expected =
        format!("{{\"class\":\"domain\",\"domain\":\"{name}\",\"root\":\"{root}\",\"pid\":{pid}}}\n");
    assert_eq!(list(), expected);
}

#[test]
fn info_prints_the_status_of_a_sensor() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front", "rear"], 1);
    for sensor in &mut hub.sensors {
        sensor.publish_status(|status| {
            status.set_sensor_type("LMS200");
            status.set_port("/dev/ttyUSB1");
            status.mode = 0;
            status.pose = Pose { x_m: 0.3, yaw_rad: std::f64::consts::PI, upside_down: 1, ..Pose::default() };
            status.counters[Counter::Telegrams] = 12;
        });
    }
    let verb = start_info(&test_domain, Some("rear"), true);
    hub.serve_history(|| verb.finished());
    let (end, out, _) = verb.join();
    assert_eq!((end, out.lines().count()), (Ok(()), 1));
    assert!(out.starts_with(r#"{"class":"status","sensor":"rear","state":"streaming""#), "{out}");
    let verb = start_info(&test_domain, None, false);
    hub.serve_history(|| verb.finished());
    let (_, out, _) = verb.join();
    assert!(out.starts_with("front                  streaming for"), "{out}");
    assert!(out.contains("  telegrams            12\n"), "{out}");
    assert!(out.contains("  pose                 x 0.3 m, y 0 m, yaw 180.0 deg, upside down\n"), "{out}");
    assert!(out.contains("`scanhub configure /dev/ttyUSB1 mode=0x01`\n"), "{out}");
    let failure = start_info(&test_domain, Some("left"), true).join().0.unwrap_err();
    assert_eq!((failure.kind, failure.hint.as_str()), (Kind::NoTopic, "there are front, rear"));
}

#[test]
fn missing_status_is_a_timeout_of_info() {
    let test_domain = TestDomain::new();
    let _hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    assert_eq!(start_info(&test_domain, None, true).join().0.unwrap_err().kind, Kind::Timeout);
    let (end, out, _) = start_list(&test_domain, true).join();
    assert_eq!((end, out.matches(r#""hz":null"#).count()), (Ok(()), 7));
}

#[test]
fn hz_measures_all_topics() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let args = HzArgs { topics: Vec::new(), window: Duration::from_secs(10), limits: RunLimits::default() };
    let domain = domain_options(&test_domain);
    // A status that was published before any subscription is queued for late joiners.
    hub.front_sensor().publish_status(|_| {});
    let verb =
        RunningVerb::start(move |out, notes, stop| args.run(&mut context(domain, true, out, notes, stop)));
    hub.front_sensor().scan.await_subscribers(1);
    // The verb also subscribes to the state of the line.
    hub.front_sensor().status.await_subscribers(2);
    hub.front_sensor().publish_status(|_| {});
    // From this point on, the stamps of samples are later than all subscriptions.
    hub.front_sensor().start_ns = u64::MAX / 2;
    while !verb.out.text().contains(r#""topic":"scan","hz":"#) {
        hub.front_sensor().publish_scan(&[1]);
        hub.serve_history(|| true);
        std::thread::sleep(Duration::from_millis(10));
    }
    verb.stop();
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()));
    let line = out.lines().find(|line| line.contains(r#""topic":"scan""#)).unwrap();
    let keys: Vec<_> =
        line.split("\"").skip(1).step_by(2).filter(|it| !["hz", "front", "scan"].contains(it)).collect();
    assert_eq!(
        keys.join(" "),
        "class sensor topic jitter_ms min_ms max_ms received missed window_s damaged lost_on_line",
        "{line}"
    );
    assert!(
        out.lines().any(|line| line.contains(r#""topic":"telegram","hz":null,"jitter_ms":null"#)),
        "{out}"
    );
    assert_eq!(out.lines().filter(|line| line.contains("summary")).count(), 10);
    let statuses: Vec<_> = out.lines().filter(|line| line.contains(r#""topic":"status""#)).collect();
    let (summary, lines) = statuses.split_last().unwrap();
    // A rate that includes the history would be hundreds of thousands per second.
    assert!(lines.iter().all(|line| line.contains(r#""hz":null"#)), "{statuses:?}");
    assert!(summary.contains(r#""received":2,"#) && summary.contains(r#""hz":null"#), "{statuses:?}");
}
