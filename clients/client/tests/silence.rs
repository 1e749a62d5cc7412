//! Tests of the reasons for a silence, for a program that requests the reason once a second.

mod fake;

use std::time::{Duration, Instant};

use fake::{FakeHub, TestDomain, wait_until};
use scanhub_client::streams::find;
use scanhub_client::{
    ErrorKind, Marks, Publication, RobotSubscriber, Scan, Silence, Subscriber, Tilt, Verdict, ZonesSubscriber,
};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind, State, Topic, Zones};
use scanhub_shm::{Payload, PortFactory};

fn scans(test_domain: &TestDomain, sensor: &str) -> Subscriber<Scan> {
    let builder = Subscriber::<Scan>::builder(sensor).in_domain(&test_domain.domain);
    builder.timeout(Duration::from_millis(100)).open().unwrap()
}

/// Calls `next` until the reason is as expected, and returns the reason. Stops trying after 20 s.
fn await_reason(scans: &mut Subscriber<Scan>, is_expected: impl Fn(&Silence) -> bool) -> Silence {
    let started = Instant::now();
    loop {
        assert!(scans.next().unwrap().is_none(), "nothing was sent");
        let silence = scans.why_silent();
        // The limit is generous, because the machine may be busy.
        if is_expected(&silence) || started.elapsed() > Duration::from_secs(20) {
            return silence;
        }
    }
}

#[test]
fn missing_hub_is_the_reason_for_a_silence() {
    let test_domain = TestDomain::new();
    let mut scans = scans(&test_domain, "front");
    let silence = scans.why_silent();
    assert!(matches!(silence, Silence::NoHub { .. }), "{silence}");
    assert!(silence.to_string().contains(test_domain.domain.name()), "{silence}");
    assert!(silence.remedy().contains("scanhub run"), "{}", silence.remedy());
}

#[test]
fn mistyped_sensor_is_unknown_and_remedy_lists_names() {
    let test_domain = TestDomain::new();
    let _hub = FakeHub::new(&test_domain.domain, &["rear", "front"], 1);
    let mut scans = scans(&test_domain, "frnot");
    let silence = await_reason(&mut scans, |silence| matches!(silence, Silence::UnknownSensor { .. }));
    let Silence::UnknownSensor { sensor, sensors, .. } = &silence else { panic!("{silence}") };
    assert_eq!((&sensor[..], &sensors[..]), ("frnot", &["front".to_owned(), "rear".to_owned()][..]));
    assert_eq!(silence.remedy(), "the sensors are front, rear");
    let mut zones = ZonesSubscriber::builder("frnot").in_domain(&test_domain.domain).open().unwrap();
    assert!(matches!(zones.why_silent(), Silence::UnknownSensor { .. }));
}

#[test]
fn state_of_the_link_is_the_reason() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut scans = scans(&test_domain, "front");
    assert_eq!(await_reason(&mut scans, |silence| *silence == Silence::Waiting), Silence::Waiting);
    let mut is = |state: State, expected: &dyn Fn(&Silence) -> bool| {
        wait_until("the reason", || {
            hub.front_sensor().publish_status(|status| {
                status.state = state as u8;
                status.set_last_error("no such port");
            });
            expected(&scans.why_silent())
        });
    };
    is(State::Paused, &|silence| {
        matches!(silence, Silence::Paused { .. }) && silence.remedy() == "scanhub control front resume"
    });
    is(State::Absent, &|silence| {
        matches!(silence, Silence::Absent { state: State::Absent, .. })
            && silence.to_string().contains("no such port")
    });
    is(State::Streaming, &|silence| *silence == Silence::Waiting);
    // The subscription to the status exists only during a silence. A status is not a sample of the topic.
    assert_eq!(hub.front_sensor().status.subscribers(), 1);
    let silent_for = scans.silent_for();
    hub.front_sensor().publish_status(|_| {});
    assert!(scans.try_next().unwrap().is_none() && scans.silent_for() >= silent_for);
    hub.front_sensor().publish_scan(&[1000]);
    assert!(scans.next().unwrap().is_some());
    assert_eq!(hub.front_sensor().status.subscribers(), 0);
}

#[test]
fn robot_has_the_reason_of_its_first_unknown_sensor() {
    let test_domain = TestDomain::new();
    let robot =
        |sensors: &[&str]| RobotSubscriber::builder(sensors).in_domain(&test_domain.domain).open().unwrap();
    let (mut all, mut mistyped) = (robot(&[]), robot(&["front", "frnot"]));
    for robot in [&mut all, &mut mistyped] {
        assert!(matches!(robot.why_silent(), Silence::NoHub { .. }));
    }
    let mut hub = FakeHub::new(&test_domain.domain, &["front", "rear"], 1);
    hub.sensors[0].period_us = 60_000_000;
    hub.sensors[1].period_us = 60_000_000;
    wait_until("the zones", || {
        hub.sensors[0].publish_zones(Verdict::Clear, 900);
        [&mut all, &mut mistyped]
            .iter_mut()
            .all(|robot| robot.now().unwrap().sensors().any(|part| part == ("front", Verdict::Clear)))
    });
    wait_until("the reason", || matches!(mistyped.why_silent(), Silence::UnknownSensor { .. }));
    wait_until("the state of the other sensor", || {
        hub.sensors[1].publish_status(|status| status.state = State::Paused as u8);
        all.why_silent().to_string() == "rear is paused"
    });
    wait_until("its zones", || {
        hub.sensors[1].publish_zones(Verdict::Clear, 900);
        all.now().unwrap().verdict() == Verdict::Clear
    });
    assert_eq!(all.why_silent(), Silence::Waiting);
}

#[test]
fn missing_zones_are_the_reason_for_robot_silence() {
    let test_domain = TestDomain::new();
    let mut robot = RobotSubscriber::builder(&[]).in_domain(&test_domain.domain).open().unwrap();
    let lock = scanhub_shm::HubLock::acquire(test_domain.domain.root()).unwrap();
    let node = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    wait_until("the hub", || robot.why_silent() == Silence::Waiting);
    lock.report_ready().unwrap();
    let silence = robot.why_silent();
    assert_eq!(silence.to_string(), "the hub has no sensor with zones");
    assert!(silence.remedy().contains("scanhub run --link"), "{}", silence.remedy());
    let limits = TopicLimits::default();
    let scan = Scan::create(&node, "front", &limits).unwrap();
    let _scans = Scan::publisher(&scan, &limits).unwrap();
    assert_eq!(robot.why_silent().remedy(), "the sensors are front");
    let zones = Zones::create(&node, "front", &limits).unwrap();
    let _zones = Zones::publisher(&zones, &limits).unwrap();
    assert_eq!(robot.why_silent(), Silence::Waiting);
}

#[test]
fn topic_that_the_hub_does_not_publish_is_unknown() {
    let test_domain = TestDomain::new();
    let lock = scanhub_shm::HubLock::acquire(test_domain.domain.root()).unwrap();
    let node = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let _waker = scanhub_shm::WakeSender::new(&node, "front").unwrap();
    let limits = TopicLimits::default();
    let scan = Scan::create(&node, "front", &limits).unwrap();
    let _publisher = Scan::publisher(&scan, &limits).unwrap();
    lock.report_ready().unwrap();
    let mut marks = Subscriber::<Marks>::builder("front").in_domain(&test_domain.domain).open().unwrap();
    let silence = marks.why_silent();
    let Silence::UnknownTopic { topic, topics, .. } = &silence else { panic!("{silence}") };
    assert_eq!((&topic[..], &topics[..]), ("front/marks", &[Topic::Scan.name().to_owned()][..]));
}

#[test]
fn restarted_hub_without_the_sensor_is_the_reason() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut scans = scans(&test_domain, "front");
    // Ports of the same program keep topics of the sensor open.
    let builder = Subscriber::<Marks>::builder("front").in_domain(&test_domain.domain);
    let mut marks = builder.open().unwrap();
    wait_until("the state", || {
        hub.front_sensor().publish_status(|status| status.state = State::Paused as u8);
        assert!(marks.try_next().unwrap().is_none() && scans.try_next().unwrap().is_none());
        matches!(scans.why_silent(), Silence::Paused { .. })
    });
    assert_eq!((hub.front_sensor().scan.subscribers(), hub.front_sensor().marks.subscribers()), (1, 1));
    drop(hub);
    wait_until("the end", || matches!(scans.why_silent(), Silence::NoHub { .. }));
    let hub = FakeHub::new(&test_domain.domain, &["rear"], 2);
    let is_unknown = |silence: &Silence| matches!(silence, Silence::UnknownSensor { .. });
    let silence = await_reason(&mut scans, is_unknown);
    assert!(is_unknown(&silence), "{silence}");
    assert_eq!(silence.remedy(), "the sensors are rear");
    drop(hub);
    let _hub = FakeHub::new(&test_domain.domain, &["front"], 3);
    assert_eq!(await_reason(&mut scans, |silence| *silence == Silence::Waiting), Silence::Waiting);
}

#[test]
fn state_of_the_last_hub_is_not_the_reason() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut scans = scans(&test_domain, "front");
    wait_until("the state", || {
        hub.front_sensor().publish_status(|status| status.state = State::Paused as u8);
        assert!(scans.try_next().unwrap().is_none());
        matches!(scans.why_silent(), Silence::Paused { .. })
    });
    // The program never calls `why_silent` while no hub runs.
    drop(hub);
    wait_until("the end", || {
        assert!(scans.try_next().unwrap().is_none());
        !scans.hub_is_running()
    });
    let _hub = FakeHub::new(&test_domain.domain, &["front"], 2);
    wait_until("the next hub", || {
        assert!(scans.try_next().unwrap().is_none());
        scans.hub_is_running()
    });
    // The sensor of the second hub sends no status.
    assert_eq!(scans.why_silent(), Silence::Waiting);
}

#[test]
fn missing_subscriber_slot_is_the_reason() {
    let test_domain = TestDomain::new();
    let lock = scanhub_shm::HubLock::acquire(test_domain.domain.root()).unwrap();
    let node = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let _waker = scanhub_shm::WakeSender::new(&node, "front").unwrap();
    let limits = TopicLimits { subscribers: 1, ..TopicLimits::default() };
    let scan = Scan::create(&node, "front", &limits).unwrap();
    let _publisher = Scan::publisher(&scan, &limits).unwrap();
    lock.report_ready().unwrap();
    let mut first = scans(&test_domain, "front");
    assert!(first.try_next().unwrap().is_none());
    assert_eq!(scan.dynamic_config().number_of_subscribers(), 1);
    let mut second = scans(&test_domain, "front");
    assert!(second.try_next().is_err());
    let silence = second.why_silent();
    assert!(matches!(silence, Silence::Full { .. }), "{silence}");
    assert!(silence.remedy().contains("limits.subscribers"), "{}", silence.remedy());
    drop(first);
    wait_until("the place", || {
        second.try_next().is_ok_and(|scan| scan.is_none()) && second.why_silent() == Silence::Waiting
    });
}

#[test]
fn domain_of_another_user_is_named() {
    if !rustix::process::getuid().is_root() {
        eprintln!("skipped: only root can make a directory of another user");
        return;
    }
    let test_domain = TestDomain::new();
    std::fs::create_dir(test_domain.domain.root()).unwrap();
    std::os::unix::fs::chown(test_domain.domain.root(), Some(65_534), Some(65_534)).unwrap();
    let silence = scans(&test_domain, "front").why_silent();
    assert!(matches!(silence, Silence::OtherUser { .. }), "{silence:?}");
    assert!(silence.to_string().contains("belongs to user"), "{silence}");
    assert!(silence.remedy().contains("run as user"), "{}", silence.remedy());
    let error = find(std::slice::from_ref(&test_domain.domain)).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::OtherUser, "{error}");
    assert_eq!(Failure::from(error).kind, Kind::NoHub, "the exit code is that of a missing hub");
    let error = Publication::<Tilt>::in_domain(&test_domain.domain, "mount").err();
    assert_eq!(error.map(|error| error.kind()), Some(ErrorKind::OtherUser));
}

#[test]
fn why_silent_takes_less_than_200_ms() {
    let test_domain = TestDomain::new();
    let _hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let [mut known, mut unknown] = ["front", "frnot"].map(|sensor| scans(&test_domain, sensor));
    let elsewhere = TestDomain::new();
    let mut absent = scans(&elsewhere, "front");
    for (name, scans) in [("known", &mut known), ("unknown", &mut unknown), ("no hub", &mut absent)] {
        scans.why_silent();
        let started = Instant::now();
        (0..10).for_each(|_| drop(scans.why_silent()));
        let each = started.elapsed() / 10;
        eprintln!("{name}: {each:?}");
        assert!(each < Duration::from_millis(200), "{name}: {each:?}");
    }
}
