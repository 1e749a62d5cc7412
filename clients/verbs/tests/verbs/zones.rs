//! Tests of zones that become stale, as seen by subscribers.

use std::time::{Duration, Instant};

use crate::echo::{Format, start};
use crate::fake::{FakeHub, FakeSensor, RunningVerb, TestDomain, wait_until};
use crate::{context, domain_options};
use scanhub_client::{ErrorKind, RobotSubscriber, ZonesSubscriber};
use scanhub_schema::Verdict;
use scanhub_verbs::RunLimits;
use scanhub_verbs::hz::HzArgs;

/// Period of slow scans in us. It is so long that a delay on a busy machine does not count as a silence. Zones become
/// stale after two periods and 40 ms.
const PERIOD_US: u32 = 300_000;

/// Creates a hub whose sensors have slow scans.
fn slow_hub(test_domain: &TestDomain, sensors: &[&str], boot: u64) -> FakeHub {
    let mut hub = FakeHub::new(&test_domain.domain, sensors, boot);
    hub.sensors.iter_mut().for_each(|sensor| sensor.period_us = PERIOD_US);
    hub
}

/// Publishes zones until a late joiner has received them.
fn publish_until_received(sensor: &mut FakeSensor, verdict: Verdict, mut is_received: impl FnMut() -> bool) {
    wait_until("a sample", || {
        sensor.publish_zones(verdict, 1234);
        is_received()
    });
}

#[test]
fn silence_is_unknown_once() {
    let test_domain = TestDomain::new();
    let mut hub = slow_hub(&test_domain, &["front"], 7);
    let mut zones = ZonesSubscriber::builder("front").in_domain(&test_domain.domain).open().unwrap();
    publish_until_received(hub.front_sensor(), Verdict::Clear, || {
        zones.try_next().unwrap().is_some_and(|update| update.zones.verdict() == Verdict::Clear)
    });
    while zones.try_next().unwrap().is_some() {}
    hub.front_sensor().publish_zones(Verdict::Slow, 700);
    let received = zones.next().unwrap();
    assert_eq!(
        (received.zones.verdict(), received.zones.nearest_mm, received.stale),
        (Verdict::Slow, 700, false)
    );
    assert_eq!(received.header.map(|header| (header.boot, header.period_us)), Some((7, PERIOD_US)));
    let received = zones.next().unwrap();
    assert_eq!((received.zones.verdict(), received.header, received.stale), (Verdict::Unknown, None, true));
    let quiet_until = Instant::now() + Duration::from_millis(700);
    while Instant::now() < quiet_until {
        assert!(zones.try_next().unwrap().is_none(), "published already");
        std::thread::sleep(Duration::from_millis(5));
    }
    hub.front_sensor().publish_zones(Verdict::Clear, 5000);
    assert_eq!(zones.next().unwrap().zones.verdict(), Verdict::Clear);
    hub.front_sensor().publish_zones(Verdict::Unknown, 0);
    let received = zones.next().unwrap();
    assert_eq!((received.zones.verdict(), received.stale), (Verdict::Unknown, false), "the hub's own word");
}

#[test]
fn verdict_is_unknown_before_and_after_a_hub() {
    let test_domain = TestDomain::new();
    let mut zones = ZonesSubscriber::builder("front").in_domain(&test_domain.domain).open().unwrap();
    let received = zones.next().unwrap();
    assert_eq!((received.zones.verdict(), received.stale, received.header), (Verdict::Unknown, true, None));
    let mut hub = slow_hub(&test_domain, &["front"], 1);
    publish_until_received(hub.front_sensor(), Verdict::Clear, || zones.try_next().unwrap().is_some());
    drop(hub);
    let last = std::iter::from_fn(|| zones.next().ok()).find(|update| update.stale);
    assert_eq!(last.map(|update| update.zones.verdict()), Some(Verdict::Unknown));
}

#[test]
fn newest_verdict_counts_and_stale_one_is_unknown() {
    let test_domain = TestDomain::new();
    let mut hub = slow_hub(&test_domain, &["front"], 1);
    let mut zones = ZonesSubscriber::builder("front").in_domain(&test_domain.domain).open().unwrap();
    publish_until_received(hub.front_sensor(), Verdict::Clear, || zones.try_next().unwrap().is_some());
    while zones.try_next().unwrap().is_some() {}
    for nearest_mm in [300, 200, 100] {
        hub.front_sensor().publish_zones(Verdict::Stop, nearest_mm);
    }
    let received = zones.next().unwrap();
    assert_eq!((received.zones.nearest_mm, received.missed, received.stale), (100, 2, false));
    // The stamp is one second after the machine's start, so these zones are stale.
    hub.front_sensor().publish_zones_at(Verdict::Clear, 9000, 1_000_000_000);
    let received = zones.next().unwrap();
    assert_eq!(
        (received.zones.verdict(), received.zones.nearest(), received.stale),
        (Verdict::Unknown, None, true)
    );
    assert!(received.header.is_some_and(|header| header.stamp_last_ns == 1_000_000_000));
}

#[test]
fn echo_prints_a_silence_in_each_format() {
    let test_domain = TestDomain::new();
    let mut hub = slow_hub(&test_domain, &["front"], 0xAB);
    let verbs = [Format::Json, Format::Text, Format::Raw]
        .map(|format| start(&test_domain, &["front/zones"], format, RunLimits::default()));
    let args = HzArgs {
        topics: vec!["front/zones".into()],
        window: Duration::from_secs(10),
        limits: RunLimits::default(),
    };
    let domain = domain_options(&test_domain);
    let rate =
        RunningVerb::start(move |out, notes, stop| args.run(&mut context(domain, true, out, notes, stop)));
    hub.front_sensor().zones.await_subscribers(4);
    hub.front_sensor().publish_zones(Verdict::Stop, 420);
    verbs[0].out.await_lines(r#""stale":true"#, 1);
    verbs[1].out.await_lines("no recent data", 1);
    wait_until("bytes", || verbs[2].out.bytes().len() == 2 * 76);
    verbs.iter().chain([&rate]).for_each(RunningVerb::stop);
    let [json, text, raw] = verbs;
    let (end, out, _) = json.join();
    assert_eq!((end, out.lines().count()), (Ok(()), 3), "{out}");
    let lines: Vec<_> = out.lines().collect();
    assert!(lines[0].starts_with(r#"{"class":"zones","sensor":"front","seq":0,"topic_seq":0,"stamp_ns":"#));
    let expected = r#""quality":"clean","verdict":"stop","nearest_mm":420,"nearest_beam":180,"zones":[],"invalid_beams":0}"#;
    assert!(lines[0].ends_with(expected), "{out}");
    let silence = r#"{"class":"zones","sensor":"front","seq":null,"topic_seq":null,"stamp_ns":null,"wall_ns":null,"boot":null,"quality":null,"verdict":"unknown","nearest_mm":null,"nearest_beam":null,"zones":[],"invalid_beams":0,"stale":true}"#;
    assert_eq!(lines[1], silence);
    assert!(
        lines[2].contains(r#""class":"summary""#) && lines[2].contains(r#""received":1,"missed":0"#),
        "{out}"
    );
    let (_, out, _) = text.join();
    assert!(out.lines().nth(1).is_some_and(|line| line == "front/zones unknown: no recent data"), "{out}");
    let bytes = raw.out.bytes();
    assert_eq!((bytes[0], bytes[76]), (Verdict::Stop as u8, Verdict::Unknown as u8));
    let (_, out, _) = rate.join();
    assert!(out.lines().last().is_some_and(|line| line.contains(r#""received":1,"missed":0"#)), "{out}");
}

#[test]
fn combined_verdict_is_the_worst_of_all_sensors() {
    let test_domain = TestDomain::new();
    let mut hub = slow_hub(&test_domain, &["front", "rear"], 1);
    let mut all = RobotSubscriber::builder(&[]).in_domain(&test_domain.domain).open().unwrap();
    assert_eq!((all.now().unwrap().verdict(), all.now().unwrap().worst()), (Verdict::Unknown, None));
    let mut publish = |front: Verdict, rear: Option<Verdict>| {
        hub.sensors[0].publish_zones(front, 900);
        if let Some(rear) = rear {
            hub.sensors[1].publish_zones(rear, 800);
        }
    };
    wait_until("both", || {
        publish(Verdict::Clear, Some(Verdict::Slow));
        all.now().unwrap().verdict() == Verdict::Slow
    });
    let robot = all.now().unwrap();
    assert_eq!((robot.worst(), robot.nearest()), (Some("rear"), Some((800, "rear"))));
    wait_until("one falls silent", || {
        publish(Verdict::Clear, None);
        all.now().unwrap().verdict() == Verdict::Unknown
    });
    let robot = all.now().unwrap();
    let verdicts: Vec<_> = robot.sensors().collect();
    assert_eq!(verdicts, [("front", Verdict::Clear), ("rear", Verdict::Unknown)]);
    assert_eq!((robot.worst(), robot.nearest()), (Some("rear"), Some((900, "front"))));

    let mut named =
        RobotSubscriber::builder(&["front", "left"]).in_domain(&test_domain.domain).open().unwrap();
    wait_until("the one that is there", || {
        publish(Verdict::Stop, Some(Verdict::Clear));
        named.next().unwrap().verdict() == Verdict::Stop
    });
    let verdicts: Vec<_> = named.now().unwrap().sensors().map(|(_, verdict)| verdict).collect();
    assert_eq!(verdicts, [Verdict::Stop, Verdict::Unknown], "never received");
    let refused = RobotSubscriber::builder(&["robot"]).in_domain(&test_domain.domain).open().err();
    assert_eq!(refused.map(|error| error.kind()), Some(ErrorKind::InvalidInput));
}

#[test]
fn echo_prints_combined_verdicts() {
    let test_domain = TestDomain::new();
    let mut hub = slow_hub(&test_domain, &["rear", "front"], 1);
    let bounds = RunLimits { count: Some(3), ..RunLimits::default() };
    let verb = start(&test_domain, &["robot/zones"], Format::Json, bounds);
    hub.sensors.iter().for_each(|sensor| sensor.zones.await_subscribers(1));
    // There is no combined verdict until each sensor has sent its verdict.
    hub.sensors[1].publish_zones(Verdict::Stop, 500);
    hub.sensors[0].publish_zones(Verdict::Slow, 700);
    verb.out.await_lines(r#""verdict":"stop","nearest_mm":500,"nearest_sensor":"front""#, 1);
    hub.sensors[1].publish_zones(Verdict::Clear, 900);
    let expected = r#""verdict":"slow","nearest_mm":700,"nearest_sensor":"rear","sensors":[{"sensor":"front","verdict":"clear"},{"sensor":"rear","verdict":"slow"}]}"#;
    verb.out.await_lines(expected, 1);
    verb.out.await_lines(r#""stale":true"#, 2);
    hub.sensors[0].publish_zones(Verdict::Stop, 300);
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()));
    assert!(out.lines().all(|line| {
        line.starts_with(r#"{"class":"zones","sensor":"robot","stamp_ns":"#)
            || line
                .starts_with(r#"{"class":"summary","sensor":"robot","topic":"zones","received":3,"missed":0"#)
    }));
    let expected = r#""verdict":"stop","nearest_mm":300,"nearest_sensor":"rear","sensors":[{"sensor":"front","verdict":"unknown"},{"sensor":"rear","verdict":"stop"}]}"#;
    assert!(out.lines().nth_back(1).is_some_and(|line| line.ends_with(expected)), "{out}");
}
