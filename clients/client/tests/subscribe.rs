//! Subscribers of one topic: their options, and what they return.

mod fake;

use std::time::Duration;

use fake::{FakeHub, Place};
use scanhub_client::{ErrorKind, Scan, Subscriber, SubscriberBuilder, Telegram, Wait};

/// Far longer than anything takes on a busy machine.
const LONG: Duration = Duration::from_secs(60);

#[test]
fn a_builder_finds_the_hub_by_domain_and_root() {
    let place = Place::new();
    let mut hub = FakeHub::new(&place.domain, &["front"], 1);
    for wait in [Wait::Doorbell, Wait::Event, Wait::Spin] {
        let builder = Subscriber::<Scan>::builder("front").timeout(LONG).wait(wait);
        let mut scans = builder.domain(place.domain.name()).root(&place.base).open().unwrap();
        assert!(scans.try_next().unwrap().is_none() && scans.hub_is_running());
        hub.front().scan(&[1000, 2000]);
        assert_eq!(scans.next().unwrap().expect("a scan").beams(), 2, "{wait:?}");
    }
    let elsewhere = Subscriber::<Scan>::builder("front").domain(place.domain.name()).root("/nowhere");
    let mut scans = elsewhere.timeout(Duration::from_millis(1)).open().unwrap();
    assert!(scans.next().unwrap().is_none() && !scans.hub_is_running());
}

#[test]
fn a_builder_refuses_impossible_names() {
    let kind = |builder: SubscriberBuilder<Subscriber<Scan>>| builder.open().map(drop).unwrap_err().kind();
    assert_eq!(kind(Subscriber::builder("front/scan")), ErrorKind::InvalidInput);
    assert_eq!(kind(Subscriber::builder("front").domain("a b")), ErrorKind::InvalidInput);
}

#[test]
fn telegrams_are_bytes() {
    let place = Place::new();
    let mut hub = FakeHub::new(&place.domain, &["front"], 1);
    let builder = Subscriber::<Telegram>::builder("front").in_domain(&place.domain);
    let mut telegrams = builder.timeout(LONG).open().unwrap();
    assert!(telegrams.try_next().unwrap().is_none());
    hub.front().telegram(&[2, 0x80, 7]);
    let telegram = telegrams.next().unwrap().expect("a telegram");
    assert_eq!((telegram.bytes(), telegram.len()), (&[2, 0x80, 7][..], 3));
}
