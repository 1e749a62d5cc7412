//! Tests of the exact output of `echo`: lines, notices, limits and ends.

use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use crate::fake::{FakeHub, RunningVerb, TestDomain};
use crate::{context, domain_options};
use scanhub_schema::{Counter, Flags, Kind, Topic, Verdict};
use scanhub_verbs::RunLimits;
use scanhub_verbs::echo::EchoArgs;
use scanhub_verbs::follow::{Event, TopicRun};
use scanhub_verbs::names::TopicName;

const REPLY: [u8; 9] = [0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10, 0x16, 0x0A];

#[derive(PartialEq)]
pub(crate) enum Format {
    Text,
    Json,
    Csv,
    Raw,
}

fn args(topics: &[&str], format: &Format, bounds: RunLimits) -> EchoArgs {
    EchoArgs {
        topics: topics.iter().map(|&it| it.into()).collect(),
        csv: *format == Format::Csv,
        raw: *format == Format::Raw,
        limits: bounds,
        ..EchoArgs::default()
    }
}

pub(crate) fn start(
    test_domain: &TestDomain,
    topics: &[&str],
    format: Format,
    bounds: RunLimits,
) -> RunningVerb {
    let (args, domain) = (args(topics, &format, bounds), domain_options(test_domain));
    let json = format == Format::Json;
    RunningVerb::start(move |out, notes, stop| args.run(&mut context(domain, json, out, notes, stop)))
}

fn count(count: u64) -> RunLimits {
    RunLimits { count: Some(count), ..RunLimits::default() }
}

/// Returns all lines except the last one, which contains times.
fn all_but_last_line(text: &str) -> Vec<&str> {
    let mut lines: Vec<_> = text.lines().collect();
    lines.pop();
    lines
}

#[test]
fn prints_scans_as_json() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 0xAB);
    let verb = start(&test_domain, &["front/scan"], Format::Json, count(2));
    hub.front_sensor().scan.await_subscribers(1);
    hub.front_sensor().publish_scan(&[1000, 0x1FFF, 0x1FF7, 7]);
    hub.front_sensor().publish_scan(&[]);
    let (end, out, notes) = verb.join();
    assert_eq!((end, notes.as_str()), (Ok(()), ""));
    assert_eq!(
        all_but_last_line(&out),
        [
            r#"{"class":"scan","sensor":"front","seq":0,"topic_seq":0,"stamp_ns":1000000000,"wall_ns":1700000000000000000,"boot":"00000000000000ab","quality":"clean","family":"lms","unit_um":10000,"count":4,"first_angle_deg":-90.0,"step_deg":0.5,"beam_time_ns":18500,"ranges":[1000,null,null,7],"codes":[[1,"no_return"],[2,"beyond"]]}"#,
            r#"{"class":"scan","sensor":"front","seq":1,"topic_seq":1,"stamp_ns":1000000001,"wall_ns":1700000000000000001,"boot":"00000000000000ab","quality":"clean","family":"lms","unit_um":10000,"count":0,"first_angle_deg":-90.0,"step_deg":0.5,"beam_time_ns":18500,"ranges":[],"codes":[]}"#,
        ]
    );
    let summary = out.lines().last().unwrap();
    let begin = r#"{"class":"summary","sensor":"front","topic":"scan","received":2,"missed":0,"seconds":"#;
    assert!(summary.starts_with(begin) && summary.contains(r#","hz":"#), "{summary}");
}

#[test]
fn prints_telegrams_and_status_as_json() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let verb = start(&test_domain, &["front/telegram", "front/status"], Format::Json, count(2));
    hub.front_sensor().telegram.await_subscribers(1);
    // One subscriber for the requested topic, and one for the state of the line.
    hub.front_sensor().status.await_subscribers(2);
    hub.front_sensor().publish_telegram(&REPLY);
    verb.out.await_lines("telegram", 1);
    hub.front_sensor().publish_status(|status| {
        status.baud = 500_000;
        status.set_port("/dev/ttyUSB0");
        status.counters[Counter::RejectedCrc] = 3;
    });
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()));
    assert_eq!(
        out.lines().take(2).collect::<Vec<_>>(),
        [
            r#"{"class":"telegram","sensor":"front","seq":0,"topic_seq":0,"stamp_ns":1000000000,"wall_ns":1700000000000000000,"boot":"0000000000000001","quality":"clean","address":128,"command":160,"length":3,"data":"02800300a00010160a"}"#,
            r#"{"class":"status","sensor":"front","state":"streaming","family":"lms","model":null,"baud":500000,"mode":null,"type":"","unit_mm":null,"angle_deg":null,"step_deg":null,"hz":null,"port":"/dev/ttyUSB0","since_ns":0,"counters":{"bytes_read":0,"bytes_in_telegrams":0,"bytes_acknowledge":0,"bytes_discarded":0,"bytes_buffered":0,"telegrams":0,"suspect":0,"aborted":0,"resyncs":0,"reconnects":0,"lost_in_restart":0,"wakeups":0,"loan_failed":0,"rejected_address":0,"rejected_length":0,"rejected_command":0,"rejected_count":0,"rejected_crc":3,"rejected_vetoed":0,"rejected_superseded":0,"line_errors":0,"bytes_damaged":0,"damaged_ppm":0,"due_on_line":0,"lost_on_line":0,"lost_ppm":0,"scanner_restarts":0},"last_error":"","pose":{"x_m":0.0,"y_m":0.0,"yaw_rad":0.0,"upside_down":false},"marks":{"available":null,"remedy":null},"damaged":0.0,"lost_on_line":null}"#,
        ]
    );
    assert_eq!(out.lines().filter(|line| line.contains("summary")).count(), 2);
}

#[test]
fn prints_scans_as_csv_and_raw_bytes() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let csv = start(&test_domain, &["front/scan"], Format::Csv, count(2));
    let raw = start(&test_domain, &["front/scan"], Format::Raw, count(1));
    hub.front_sensor().scan.await_subscribers(2);
    hub.front_sensor().publish_scan(&[1000, 0x1FFF]);
    hub.front_sensor().publish_scan(&[5, 6]);
    let (end, out, notes) = csv.join();
    assert_eq!(end, Ok(()));
    assert_eq!(
        out.lines().collect::<Vec<_>>(),
        [
            "seq,topic_seq,stamp_ns,wall_ns,quality,unit_um,first_angle_deg,step_deg,range_0,range_1",
            "0,0,1000000000,1700000000000000000,clean,10000,-90,0.5,1000,",
            "1,1,1000000001,1700000000000000001,clean,10000,-90,0.5,5,6",
        ]
    );
    assert!(notes.starts_with("front/scan: 2 received, 0 missed"), "{notes}");
    crate::fake::wait_until("bytes", || raw.finished());
    let bytes = raw.out.bytes();
    // Head of the payload: unit, count, maximum range and the code above it. The ranges follow the head.
    let field = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
    assert_eq!((bytes.len(), [28, 32, 34, 36, 64].map(field)), (70, [10_000, 2, 0x1FF6, 0x1FFF, 1000]));
}

#[test]
fn prints_samples_as_text() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let verb = start(&test_domain, &["front/scan", "front/telegram"], Format::Text, count(2));
    hub.front_sensor().scan.await_subscribers(1);
    hub.front_sensor().telegram.await_subscribers(1);
    hub.front_sensor().publish_scan(&[1000, 900, 0x1FFF]);
    verb.out.await_lines("front/scan", 1);
    hub.front_sensor().publish_telegram(&REPLY);
    let (_, out, _) = verb.join();
    assert_eq!(
        out.lines().take(2).collect::<Vec<_>>(),
        [
            "front/scan seq 0 topic_seq 0 at 1.000000 clean 3 beams -90 to -89 deg 2 valid nearest 9000 mm at -89.5 deg",
            "front/telegram seq 1 topic_seq 0 at 1.000000 clean address 80 command a0 9 bytes 02800300a00010160a",
        ]
    );
}

#[test]
fn sequence_gap_counts_as_missed() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let verb = start(&test_domain, &["front/scan"], Format::Json, count(2));
    hub.front_sensor().scan.await_subscribers(1);
    hub.front_sensor().scan.topic_seq = 5;
    hub.front_sensor().publish_scan(&[1]);
    hub.front_sensor().scan.topic_seq = 9;
    hub.front_sensor().publish_scan(&[1]);
    let (_, out, _) = verb.join();
    let lines: Vec<_> = out.lines().collect();
    assert_eq!(lines[1], r#"{"class":"notice","kind":"missed","sensor":"front","topic":"scan","missed":3}"#);
    assert!(lines[3].contains(r#""received":2,"missed":3"#), "{out}");
}

#[test]
fn several_sensors_wake_one_echo() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front", "rear"], 1);
    let verb = start(&test_domain, &["front/scan", "rear/scan"], Format::Json, count(40));
    for sensor in &hub.sensors {
        sensor.scan.await_subscribers(1);
    }
    for sent in 1..=20 {
        hub.sensors[0].publish_scan(&[1]);
        hub.sensors[1].publish_scan(&[2]);
        verb.out.await_lines("\"class\":\"scan\"", 2 * sent);
    }
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()));
    for sensor in ["front", "rear"] {
        let summary =
            format!(r#""class":"summary","sensor":"{sensor}","topic":"scan","received":20,"missed":0"#);
        assert!(out.contains(&summary), "{out}");
    }
}

#[test]
fn count_fails_and_endless_echo_waits_without_hub() {
    let test_domain = TestDomain::new();
    let (end, out, _) = start(&test_domain, &["front/scan"], Format::Json, count(1)).join();
    assert_eq!(end.unwrap_err().kind, Kind::NoHub);
    assert!(out.lines().all(|line| line.contains("summary")), "{out}");

    let waiting = start(&test_domain, &["front/scan"], Format::Json, RunLimits::default());
    waiting.out.await_lines("hub_gone", 1);
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    waiting.out.await_lines("hub_back", 1);
    hub.front_sensor().scan.await_subscribers(1);
    hub.front_sensor().publish_scan(&[1]);
    waiting.out.await_lines(r#""class":"scan""#, 1);
    waiting.stop();
    let (end, out, _) = waiting.join();
    assert_eq!((end, out.matches("hub_gone").count()), (Ok(()), 1));
    assert!(out.lines().last().unwrap().contains("summary"), "{out}");
}

#[test]
fn unmet_limits_are_a_timeout_or_interrupt() {
    let test_domain = TestDomain::new();
    let _hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let short = Some(Duration::from_millis(50));
    let kind =
        |bounds| start(&test_domain, &["front/scan"], Format::Json, bounds).join().0.map_err(|it| it.kind);
    assert_eq!(kind(RunLimits { timeout: short, ..RunLimits::default() }), Err(Kind::Timeout));
    assert_eq!(kind(RunLimits { run_for: short, ..count(1) }), Err(Kind::Timeout));
    assert_eq!(kind(RunLimits { run_for: short, ..RunLimits::default() }), Ok(()));
    assert_eq!(kind(count(0)), Ok(()));
    let interrupted = start(&test_domain, &["front/scan"], Format::Json, count(1));
    interrupted.stop();
    assert_eq!(interrupted.join().0.map_err(|it| it.kind), Err(Kind::Interrupted));
}

#[test]
fn wildcards_select_all_sensors_and_topics() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front", "rear"], 1);
    let verb = start(&test_domain, &["*/scan", "rear/*"], Format::Json, count(3));
    for sensor in &hub.sensors {
        sensor.scan.await_subscribers(1);
    }
    hub.sensors[1].telegram.await_subscribers(1);
    hub.sensors[0].publish_scan(&[1]);
    hub.sensors[1].publish_scan(&[2]);
    hub.sensors[1].publish_telegram(&[2, 0x80, 0, 0]);
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()));
    for begin in [
        r#"{"class":"scan","sensor":"front","#,
        r#"{"class":"scan","sensor":"rear","#,
        r#"{"class":"telegram","sensor":"rear","#,
    ] {
        assert_eq!(out.matches(begin).count(), 1, "{out}");
    }
    // The output has one topic of the front sensor and all topics of the rear sensor, each once.
    assert_eq!(out.matches(r#"{"class":"summary""#).count(), 1 + 10, "{out}");
}

#[test]
fn unknown_topics_and_unsuitable_formats_are_refused() {
    let test_domain = TestDomain::new();
    let _hub = FakeHub::new(&test_domain.domain, &["front", "rear"], 1);
    let failure =
        start(&test_domain, &["left/scan"], Format::Text, RunLimits::default()).join().0.unwrap_err();
    assert_eq!((failure.kind, failure.hint.as_str()), (Kind::NoTopic, "there are front, rear"));
    for (topics, format, kind) in [
        (&["front/zone"][..], Format::Text, Kind::Usage),
        (&["front/status"], Format::Csv, Kind::Usage),
        (&["front/scan", "rear/scan"], Format::Raw, Kind::Usage),
        (&[], Format::Text, Kind::Usage),
    ] {
        let failure = start(&test_domain, topics, format, RunLimits::default()).join().0.unwrap_err();
        assert_eq!(failure.kind, kind, "{topics:?}");
    }
}

#[test]
fn closed_output_pipe_ends_echo_without_error() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let (args, domain) = (args(&["front/scan"], &Format::Json, count(5)), domain_options(&test_domain));
    let (reader, pipe) = io::pipe().unwrap();
    drop(reader);
    let out = File::from(OwnedFd::from(pipe));
    let verb =
        RunningVerb::start(move |_, notes, stop| args.run(&mut context(domain, true, out, notes, stop)));
    hub.front_sensor().scan.await_subscribers(1);
    hub.front_sensor().publish_scan(&[1]);
    assert_eq!(verb.join().0, Ok(()));
}

#[test]
fn flags_are_the_last_key_of_sample_lines() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let verb = start(&test_domain, &["front/scan", "front/zones", "front/telegram"], Format::Json, count(4));
    hub.front_sensor().scan.await_subscribers(1);
    hub.front_sensor().zones.await_subscribers(1);
    hub.front_sensor().telegram.await_subscribers(1);
    hub.front_sensor().flags = Flags::SIMULATED | Flags::REPLAYED | Flags::STAMP_ESTIMATED;
    hub.front_sensor().publish_scan(&[1000]);
    hub.front_sensor().publish_zones(Verdict::Clear, 1000);
    hub.front_sensor().publish_telegram(&REPLY);
    verb.out.await_lines("stamp_estimated", 3);
    hub.front_sensor().flags = 0;
    hub.front_sensor().publish_telegram(&REPLY);
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()));
    let flagged: Vec<_> = out.lines().filter(|line| line.contains("flags")).collect();
    let last = r#","flags":["simulated","replayed","stamp_estimated"]}"#;
    assert!(flagged.len() == 3 && flagged.iter().all(|line| line.ends_with(last)), "{out}");
}

#[test]
fn summary_reports_line_loss_during_the_run() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let verb = start(&test_domain, &["front/scan"], Format::Json, RunLimits::default());
    hub.front_sensor().scan.await_subscribers(1);
    hub.front_sensor().status.await_subscribers(1);
    for n in 1..=3 {
        hub.front_sensor().publish_status(|status| {
            status.counters[Counter::BytesRead] = 1000 * n;
            status.counters[Counter::BytesDamaged] = 250 * n;
            status.counters[Counter::DueOnLine] = 100 * n;
            status.counters[Counter::LostOnLine] = 40 * n;
        });
    }
    hub.front_sensor().publish_scan(&[1000]);
    verb.out.await_lines("ranges", 1);
    verb.stop();
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()));
    let summary = out.lines().last().unwrap();
    assert!(
        summary.starts_with(r#"{"class":"summary","sensor":"front","topic":"scan","received":1,"#),
        "{out}"
    );
    assert!(summary.ends_with(r#""damaged":0.25,"lost_on_line":80}"#), "{out}");
    assert!(!out.contains(r#""class":"status""#), "{out}");
}

/// A subscriber can borrow at most four statuses. The same number of statuses may be queued.
#[test]
fn queued_statuses_do_not_hide_later_statuses() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let names = [TopicName { sensor: "front".to_owned(), topic: Topic::Scan }];
    let (places, bounds, stop) = (test_domain.locations(), RunLimits::default(), AtomicBool::new(false));
    let mut following = TopicRun::new(&names, &[], &places, &bounds, &stop).with_lines();
    // Handles events until a status has the line error count `errors`. If `errors` is 0, handles events until the topic
    // has a subscriber.
    let mut follow = |hub: &mut FakeHub, errors: u64| loop {
        match following.next(None).unwrap().expect("the run has no end") {
            Event::Line(_, status) if status.counters[Counter::LineErrors] == errors => break,
            Event::Tick(_) if errors == 0 && hub.front_sensor().status.subscribers() == 1 => break,
            _ => {}
        }
    };
    follow(&mut hub, 0);
    for errors in 1..=4 {
        hub.front_sensor().publish_status(|status| status.counters[Counter::LineErrors] = errors);
    }
    follow(&mut hub, 4);
    hub.front_sensor().publish_status(|status| status.counters[Counter::LineErrors] = 5);
    follow(&mut hub, 5);
}
