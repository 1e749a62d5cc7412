//! Tests of the options and results of a subscriber of one topic.

mod fake;

use std::time::Duration;

use fake::{FakeHub, TestDomain, wait_until};
use scanhub_client::{Error, ErrorKind, Scan, Subscriber, SubscriberBuilder, Telegram, Wait};
use scanhub_schema::limits::MAX_BORROWED_SAMPLES;

/// Timeout that only a hang exceeds, even on a busy machine.
const WAIT_TIMEOUT: Duration = Duration::from_secs(60);

#[test]
fn builder_finds_the_hub_by_domain_and_root() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    for wait in [Wait::Doorbell, Wait::Event, Wait::Spin] {
        let builder = Subscriber::<Scan>::builder("front").timeout(WAIT_TIMEOUT).wait(wait);
        let mut scans = builder.domain(test_domain.domain.name()).root(&test_domain.base).open().unwrap();
        assert!(scans.try_next().unwrap().is_none() && scans.hub_is_running());
        hub.front_sensor().publish_scan(&[1000, 2000]);
        assert_eq!(scans.next().unwrap().expect("a scan").beams(), 2, "{wait:?}");
    }
    let elsewhere = Subscriber::<Scan>::builder("front").domain(test_domain.domain.name()).root("/nowhere");
    let mut scans = elsewhere.timeout(Duration::from_millis(1)).open().unwrap();
    assert!(scans.next().unwrap().is_none() && !scans.hub_is_running());
}

#[test]
fn builder_refuses_impossible_names() {
    let kind = |builder: SubscriberBuilder<Scan>| builder.open().map(drop).unwrap_err().kind();
    assert_eq!(kind(Subscriber::builder("front/scan")), ErrorKind::InvalidInput);
    assert_eq!(kind(Subscriber::builder("front").domain("a b")), ErrorKind::InvalidInput);
}

#[test]
fn telegram_sample_has_the_published_bytes() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let builder = Subscriber::<Telegram>::builder("front").in_domain(&test_domain.domain);
    let mut telegrams = builder.timeout(WAIT_TIMEOUT).open().unwrap();
    assert!(telegrams.try_next().unwrap().is_none());
    hub.front_sensor().publish_telegram(&[2, 0x80, 7]);
    let telegram = telegrams.next().unwrap().expect("a telegram");
    assert_eq!((telegram.bytes(), telegram.len()), (&[2, 0x80, 7][..], 3));
}

#[test]
fn four_samples_can_be_held_and_the_fifth_is_refused() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    for wait in [Wait::Doorbell, Wait::Event] {
        let builder = Subscriber::<Scan>::builder("front").in_domain(&test_domain.domain);
        let mut scans = builder.timeout(WAIT_TIMEOUT).wait(wait).open().unwrap();
        assert!(scans.try_next().unwrap().is_none());
        let mut held = Vec::new();
        for beams in 1..=MAX_BORROWED_SAMPLES {
            hub.front_sensor().publish_scan(&vec![1000; beams]);
            held.push(scans.iter().next().expect("a scan").unwrap());
        }
        hub.front_sensor().publish_scan(&[7]);
        for _ in 0..2 {
            let error = scans.iter().next().expect("an error").map(drop).unwrap_err();
            assert!(matches!(error, Error::TooManyHeld), "{error}");
        }
        let beams: Vec<_> = held.iter().map(|scan| scan.beams()).collect();
        assert_eq!(beams, [1, 2, 3, 4], "they have not changed");
        held.pop();
        let fifth = scans.next().unwrap().expect("the fifth was not lost");
        assert_eq!((fifth.missed, fifth.distance_mm(0)), (0, Some(70)));
    }
}

#[test]
fn held_sample_stays_valid_after_the_hub_has_ended() {
    let test_domain = TestDomain::new();
    let mut scans = Subscriber::<Scan>::builder("front")
        .in_domain(&test_domain.domain)
        .timeout(WAIT_TIMEOUT)
        .open()
        .unwrap();
    let mut held = Vec::new();
    for boot in 1..=2 {
        let mut hub = FakeHub::new(&test_domain.domain, &["front"], boot);
        wait_until("the subscriber", || {
            assert!(scans.try_next().unwrap().is_none());
            hub.front_sensor().scan.subscribers() == 1
        });
        hub.front_sensor().publish_scan(&vec![1000; boot as usize]);
        held.push(scans.next().unwrap().expect("a scan"));
    }
    let observed: Vec<_> = held.iter().map(|scan| (scan.header().boot, scan.beams())).collect();
    assert_eq!(observed, [(1, 1), (2, 2)]);
    assert!(held[1].restarted);
}

#[test]
fn iterator_ends_after_a_silence_and_continues() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let builder = Subscriber::<Scan>::builder("front").in_domain(&test_domain.domain);
    let mut scans = builder.timeout(Duration::from_millis(20)).open().unwrap();
    for _ in 0..2 {
        assert!(scans.iter().next().is_none());
        (0..3).for_each(|_| hub.front_sensor().publish_scan(&[1000]));
        let mut count = 0;
        for scan in &mut scans {
            count += scan.unwrap().beams();
        }
        assert_eq!(count, 3);
    }
}
