//! Tests of topics that a program publishes. Subscribers receive them like topics of a hub, with and without a hub.

mod fake;

use std::time::Duration;

use fake::{FakeHub, TestDomain, wait_until};
use scanhub_client::{
    ErrorKind, Event, Marks, PublishSession, Scan, Subscriber, SubscriberBuilder, Topic, Tracks, Verdict,
    Wait, WakeEvent, Zones,
};
use scanhub_schema::ScanHead;
use scanhub_schema::limits::TopicLimits;
use scanhub_shm::Doorbell;
use scanhub_shm::publisher_pid;

fn marks_with_count(count: u8) -> Marks {
    Marks { count, ..Marks::default() }
}

/// Returns the properties of the next sample: missed, restarted, number, marks.
fn next_sample(subscriber: &mut Subscriber<Marks>) -> (u64, bool, u64, u8) {
    let sample = subscriber.next().unwrap().expect("a sample in time");
    (sample.missed, sample.restarted, sample.header().topic_seq, sample.count)
}

fn subscribe_marks(test_domain: &TestDomain, sensor: &str) -> Subscriber<Marks> {
    builder(test_domain, sensor).open().unwrap()
}

fn builder(test_domain: &TestDomain, sensor: &str) -> SubscriberBuilder<Marks> {
    Subscriber::builder(sensor).in_domain(&test_domain.domain).timeout(Duration::from_secs(60))
}

#[test]
fn publishes_without_a_hub_and_skips_count_as_missed() {
    let test_domain = TestDomain::new();
    for wait in [Wait::Doorbell, Wait::Event] {
        let session =
            PublishSession::open(&test_domain.domain, &[Topic::Marks], TopicLimits::default()).unwrap();
        assert_eq!(publisher_pid(test_domain.domain.root()), Ok(Some(std::process::id())));
        let mut near = session.sensor("tracker.near").unwrap().topic::<Marks>().unwrap();
        let mut subscriber = builder(&test_domain, "tracker.near").wait(wait).open().unwrap();
        assert!(
            subscriber.try_next().unwrap().is_none()
                && near.subscribers() == 1
                && subscriber.hub_is_running()
        );
        for count in 0..3 {
            near.send(|sample| *sample = marks_with_count(count)).unwrap();
            assert_eq!(next_sample(&mut subscriber), (0, false, count.into(), count));
        }
        near.skip(4);
        let before_ns = near.header().stamp_last_ns;
        near.send(|sample| *sample = marks_with_count(9)).unwrap();
        let sample = subscriber.next().unwrap().unwrap();
        assert_eq!((sample.missed, sample.header().topic_seq, sample.header().seq), (4, 7, 7));
        assert_eq!(sample.header().hub_pid, std::process::id());
        assert!(sample.header().stamp_first_ns >= before_ns && sample.header().quality == 0);
        drop((session, near));
    }
    assert_eq!(publisher_pid(test_domain.domain.root()), Ok(None), "no process holds the domain");
}

/// `send_with` wakes no program. A subscriber sleeps until `wake`, which the program calls once for several samples.
#[test]
fn samples_that_are_sent_together_wake_once() {
    let test_domain = TestDomain::new();
    let session = PublishSession::open(&test_domain.domain, &[Topic::Marks], TopicLimits::default()).unwrap();
    let sensor = session.sensor("tracker.near").unwrap();
    let (mut near, mut zones) = (sensor.topic::<Marks>().unwrap(), sensor.topic::<Zones>().unwrap());
    let mut subscriber = subscribe_marks(&test_domain, "tracker.near");
    assert!(subscriber.try_next().unwrap().is_none());
    let header = near.header();
    assert_eq!(near.send_with(&header, |sample| *sample = marks_with_count(1)).unwrap(), 1);
    assert_eq!(zones.send_with(&header, |sample| *sample = Zones::unknown()).unwrap(), 0);
    sensor.wake(WakeEvent::Telegram).unwrap();
    assert_eq!(next_sample(&mut subscriber), (0, false, 0, 1));
    // A late joiner gets the samples that the topic stores.
    let mut late =
        Subscriber::<Zones>::builder("tracker.near").in_domain(&test_domain.domain).open().unwrap();
    wait_until("the last zones", || {
        zones.connect();
        late.try_next().unwrap().is_some_and(|zones| zones.verdict() == Verdict::Unknown)
    });
}

#[test]
fn reopened_publisher_restarts_its_numbers() {
    let test_domain = TestDomain::new();
    let open = || {
        PublishSession::open(&test_domain.domain, &[Topic::Marks], TopicLimits::default())
            .unwrap()
            .sensor("tracker.near")
            .unwrap()
            .topic::<Marks>()
            .unwrap()
    };
    let mut near = open();
    let mut subscriber = subscribe_marks(&test_domain, "tracker.near");
    assert!(subscriber.try_next().unwrap().is_none());
    near.send(|sample| *sample = marks_with_count(1)).unwrap();
    assert_eq!(next_sample(&mut subscriber), (0, false, 0, 1));
    drop(near);
    let mut near = open();
    // The subscriber has to find the new topic first.
    wait_until("the subscriber", || {
        let _ = subscriber.try_next().unwrap();
        near.subscribers() == 1
    });
    near.send(|sample| *sample = marks_with_count(2)).unwrap();
    assert_eq!(next_sample(&mut subscriber), (0, true, 0, 2));
}

#[test]
fn refused_duplicate_topic_does_not_break_wakeups() {
    let test_domain = TestDomain::new();
    let session = PublishSession::open(&test_domain.domain, &[Topic::Marks], TopicLimits::default()).unwrap();
    let mut near = session.sensor("tracker.near").unwrap().topic::<Marks>().unwrap();
    let zones = session.sensor("tracker.near").unwrap().topic::<Zones>().unwrap();
    let again = session.sensor("tracker.near").and_then(|sensor| sensor.topic::<Marks>()).map(drop);
    assert_eq!(again.unwrap_err().kind(), ErrorKind::DomainHeld);
    drop((session, zones));
    let mut subscriber = subscribe_marks(&test_domain, "tracker.near");
    assert!(subscriber.try_next().unwrap().is_none());
    near.send(|sample| *sample = marks_with_count(1)).unwrap();
    assert_eq!(next_sample(&mut subscriber), (0, false, 0, 1));
}

#[test]
fn telegrams_have_variable_length_up_to_the_limit() {
    let test_domain = TestDomain::new();
    let session = PublishSession::open(&test_domain.domain, &[Topic::Marks], TopicLimits::default()).unwrap();
    let mut bytes = session.sensor("tracker.near").unwrap().topic::<[u8]>().unwrap();
    let mut subscriber = Subscriber::<[u8]>::builder("tracker.near")
        .in_domain(&test_domain.domain)
        .timeout(Duration::from_secs(60))
        .open()
        .unwrap();
    assert!(subscriber.try_next().unwrap().is_none());
    bytes.send_bytes(&[1, 2, 3]).unwrap();
    assert_eq!(*subscriber.next().unwrap().unwrap(), [1, 2, 3]);
    assert_eq!(bytes.send_bytes(&[0; 815]).unwrap_err().kind(), ErrorKind::ResourceExhausted);
    assert_eq!((bytes.failed(), bytes.next_number()), (1, 2));
}

#[test]
fn single_session_next_to_a_hub_cannot_use_its_names() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let session = PublishSession::open(&test_domain.domain, &[Topic::Marks], TopicLimits::default()).unwrap();
    assert_eq!(
        PublishSession::open(&test_domain.domain, &[Topic::Marks], TopicLimits::default())
            .map(drop)
            .unwrap_err()
            .kind(),
        ErrorKind::DomainHeld
    );
    let topic = |name: &str| session.sensor(name).and_then(|sensor| sensor.topic::<Scan>()).map(drop);
    // A hub may have a sensor whose name has no dot, now or later.
    for impossible in ["front", "near", "", "robot", "tracker.Near", "a.b.c"] {
        assert_eq!(topic(impossible).unwrap_err().kind(), ErrorKind::InvalidInput, "{impossible}");
    }
    assert!(topic("tracker.near").is_ok() && session.check_room(&Topic::ALL).is_ok());
    // The hub continues.
    let mut scans = Subscriber::<Scan>::builder("front")
        .in_domain(&test_domain.domain)
        .timeout(Duration::from_secs(60))
        .open()
        .unwrap();
    assert!(scans.try_next().unwrap().is_none());
    hub.front_sensor().publish_scan(&[1000]);
    assert_eq!(scans.next().unwrap().unwrap().beams(), 1);
}

#[test]
fn named_programs_publish_with_and_without_a_hub() {
    let test_domain = TestDomain::new();
    let open_named = |name: &str| {
        PublishSession::open_named(
            &test_domain.domain,
            name,
            &[Topic::Tracks, Topic::Events],
            TopicLimits::default(),
        )
    };
    let house = open_named("house").unwrap();
    let mut tracks = house.topic::<Tracks>().unwrap();
    let mut yard = open_named("yard").unwrap().topic::<Event>().unwrap();
    assert_eq!(publisher_pid(test_domain.domain.root()), Ok(None), "no process holds the domain any more");
    let again = open_named("house").map(drop).unwrap_err();
    assert_eq!(again.kind(), ErrorKind::NameHeld);
    let held = |name: &str| format!("the name {name} is published by process {} (", std::process::id());
    assert!(again.message().starts_with(&held("house")), "{again}");
    let _listener =
        PublishSession::open(&test_domain.domain, &[Topic::Marks], TopicLimits::default()).unwrap();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let of_hub = open_named("front").map(drop).unwrap_err();
    assert_eq!(of_hub.kind(), ErrorKind::NameHeld);
    assert!(of_hub.message().starts_with(&held("front")), "{of_hub}");
    let scans = house.topic::<Scan>().map(drop).unwrap_err();
    assert_eq!(scans.kind(), ErrorKind::InvalidInput, "only sensors have scans: {scans}");
    for impossible in ["", "robot", "tracker.near"] {
        assert_eq!(
            open_named(impossible).map(drop).unwrap_err().kind(),
            ErrorKind::InvalidInput,
            "{impossible}"
        );
    }
    let mut track_subscriber =
        Subscriber::<Tracks>::builder("house").in_domain(&test_domain.domain).open().unwrap();
    let mut event_subscriber =
        Subscriber::<Event>::builder("yard").in_domain(&test_domain.domain).open().unwrap();
    let mut scans = Subscriber::<Scan>::builder("front").in_domain(&test_domain.domain).open().unwrap();
    assert!(track_subscriber.try_next().unwrap().is_none() && event_subscriber.try_next().unwrap().is_none());
    assert!(scans.try_next().unwrap().is_none());
    tracks.send(|_| {}).unwrap();
    yard.send(|_| {}).unwrap();
    hub.front_sensor().publish_scan(&[1000]);
    let mut got = [false; 3];
    wait_until("all three", || {
        got[0] |= track_subscriber.try_next().unwrap().is_some();
        got[1] |= event_subscriber.try_next().unwrap().is_some();
        got[2] |= scans.try_next().unwrap().is_some();
        got == [true; 3]
    });
    // A name is free as soon as no process publishes under it.
    drop((tracks, house));
    open_named("house").unwrap();
}

#[test]
fn samples_of_any_length_ring_the_doorbell() {
    let test_domain = TestDomain::new();
    let session = PublishSession::open(&test_domain.domain, &[Topic::Scan], TopicLimits::default()).unwrap();
    let sensor = session.sensor("tracker.near").unwrap();
    let mut scans = sensor.topic_for::<Scan>(&TopicLimits { beams: 2_160, ..*sensor.limits() }).unwrap();
    let mut subscriber = Subscriber::<Scan>::builder("tracker.near")
        .in_domain(&test_domain.domain)
        .timeout(Duration::from_secs(60))
        .open()
        .unwrap();
    assert!(subscriber.try_next().unwrap().is_none());
    let node = scanhub_shm::client_node(&test_domain.domain).unwrap();
    let doorbell = Doorbell::open(&node, "tracker.near").unwrap().expect("the sensor has one");
    for (number, beams) in [1, 401, 2_160].into_iter().enumerate() {
        let scan = Scan::of(ScanHead::default(), &vec![7; beams]);
        let before = doorbell.ring_count(Topic::Scan.spec().doorbell_word);
        scans.send_len(scan.bytes().len(), |sample| assert!(sample.copy_from(scan.bytes()))).unwrap();
        assert_eq!(doorbell.ring_count(Topic::Scan.spec().doorbell_word), before.wrapping_add(1));
        let sample = subscriber.next().unwrap().expect("it was sent");
        assert_eq!((sample.beams(), sample.header().topic_seq), (beams, number as u64));
    }
    let longer = Scan::of(ScanHead::default(), &[7; 4_000]);
    let refused = scans.send_len(longer.bytes().len(), |_| unreachable!("there is no memory for it"));
    assert_eq!(refused.unwrap_err().kind(), ErrorKind::ResourceExhausted);
}
