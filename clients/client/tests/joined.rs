//! Tests of joined subscriptions: samples of two topics with the same `seq`.

mod fake;

use std::time::Duration;

use fake::{FakeHub, FakeSensor, TestDomain, wait_until};
use scanhub_client::{Error, Foreground, JoinedSubscriber, Scan, Silence};

/// Timeout that only a hang exceeds, even on a busy machine.
const WAIT_TIMEOUT: Duration = Duration::from_secs(60);

/// Returns a subscriber of both topics that has attached to the hub.
fn attach(test_domain: &TestDomain, hub: &mut FakeHub) -> JoinedSubscriber<Scan, Foreground> {
    let builder = JoinedSubscriber::builder("front").in_domain(&test_domain.domain);
    let mut pairs = builder.timeout(WAIT_TIMEOUT).open().unwrap();
    await_subscribers(&mut pairs, hub);
    pairs
}

fn await_subscribers(pairs: &mut JoinedSubscriber<Scan, Foreground>, hub: &mut FakeHub) {
    wait_until("both subscribers", || {
        assert!(pairs.try_next().unwrap().is_none());
        let FakeSensor { scan, foreground, .. } = hub.front_sensor();
        scan.subscribers() == 1 && foreground.subscribers() == 1
    });
}

/// Returns the `seq` of the next pair, and the number of missed pairs before it.
fn next_pair(pairs: &mut JoinedSubscriber<Scan, Foreground>) -> (u64, u64) {
    let pair = pairs.next().unwrap().expect("a pair");
    assert_eq!(pair.first.header().seq, pair.second.header().seq);
    (pair.first.header().seq, pair.missed)
}

#[test]
fn samples_of_one_telegram_are_a_pair_in_any_order() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut pairs = attach(&test_domain, &mut hub);
    hub.front_sensor().period_us = 60_000_000;
    hub.front_sensor().publish_scan_with_foreground(1, &[1000]);
    assert_eq!(next_pair(&mut pairs), (1, 0));
    hub.front_sensor().publish_scan(&[1000]);
    assert!(pairs.try_next().unwrap().is_none(), "the foreground is missing");
    hub.front_sensor().publish_foreground(2, 1);
    hub.front_sensor().wake();
    assert_eq!(next_pair(&mut pairs), (2, 0));
    hub.front_sensor().publish_foreground(3, 1);
    assert!(pairs.try_next().unwrap().is_none(), "the scan is missing");
    hub.front_sensor().publish_scan(&[1000]);
    assert_eq!(next_pair(&mut pairs), (3, 0));
}

#[test]
fn sample_without_a_partner_is_dropped_and_counted() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut pairs = attach(&test_domain, &mut hub);
    hub.front_sensor().period_us = 60_000_000;
    hub.front_sensor().publish_scan_with_foreground(1, &[1000]);
    assert_eq!(next_pair(&mut pairs), (1, 0));
    // Telegram 2 has only a scan, and telegram 3 only a foreground.
    hub.front_sensor().publish_scan(&[1000]);
    hub.front_sensor().publish_foreground(3, 1);
    hub.front_sensor().publish_scan_with_foreground(4, &[1000]);
    let (seq, missed) = next_pair(&mut pairs);
    assert_eq!((seq, missed), (4, 2), "each topic has lost another one");
    hub.front_sensor().publish_scan_with_foreground(5, &[1000]);
    assert_eq!(next_pair(&mut pairs), (5, 0));
}

#[test]
fn pairs_beyond_the_queue_count_as_missed() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut pairs = attach(&test_domain, &mut hub);
    hub.front_sensor().publish_scan_with_foreground(0, &[1000]);
    let (mut last, mut received) = (next_pair(&mut pairs).0, 1);
    for round in 1..=3 {
        // The queue of scans has room for 64 samples, that of foregrounds for 16.
        (0..100).for_each(|_| {
            let seq = hub.front_sensor().seq;
            hub.front_sensor().publish_scan_with_foreground(seq, &[1000]);
        });
        while let Some(pair) = pairs.try_next().unwrap() {
            let seq = pair.first.header().seq;
            assert_eq!(pair.missed, seq - last - 1, "each pair is received or missed");
            (last, received) = (seq, received + 1);
        }
        assert_eq!(last, 100 * round);
    }
    assert!(received < 100, "{received}");
}

#[test]
fn unpaired_sample_is_kept_for_one_period() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut pairs = attach(&test_domain, &mut hub);
    hub.front_sensor().period_us = 20_000;
    hub.front_sensor().publish_scan_with_foreground(1, &[1000]);
    assert_eq!(next_pair(&mut pairs).0, 1);
    hub.front_sensor().publish_scan(&[1000]);
    assert!(pairs.try_next().unwrap().is_none());
    std::thread::sleep(Duration::from_millis(40));
    assert!(pairs.try_next().unwrap().is_none());
    // The other sample of the pair arrives too late now.
    hub.front_sensor().publish_foreground(2, 1);
    hub.front_sensor().wake();
    assert!(pairs.try_next().unwrap().is_none());
    hub.front_sensor().period_us = 60_000_000;
    hub.front_sensor().publish_scan_with_foreground(3, &[1000]);
    assert_eq!(next_pair(&mut pairs), (3, 1));
}

#[test]
fn pairs_continue_after_a_restart_of_the_hub() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut pairs = attach(&test_domain, &mut hub);
    hub.front_sensor().period_us = 60_000_000;
    hub.front_sensor().publish_scan_with_foreground(1, &[1000]);
    assert_eq!(next_pair(&mut pairs), (1, 0));
    // One sample of a pair has arrived when the hub ends.
    hub.front_sensor().publish_scan(&[1000]);
    assert!(pairs.try_next().unwrap().is_none());
    drop(hub);
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 2);
    hub.front_sensor().start_ns = 2_000_000_000;
    await_subscribers(&mut pairs, &mut hub);
    hub.front_sensor().period_us = 60_000_000;
    hub.front_sensor().publish_scan_with_foreground(0, &[1000]);
    let pair = pairs.next().unwrap().expect("a pair");
    assert_eq!((pair.first.header().boot, pair.second.header().boot, pair.restarted), (2, 2, true));
}

#[test]
fn three_pairs_can_be_held() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut pairs = attach(&test_domain, &mut hub);
    (1..=5).for_each(|seq| hub.front_sensor().publish_scan_with_foreground(seq, &[1000]));
    let mut held: Vec<_> = (0..4).map(|_| pairs.iter().next().expect("a pair").unwrap()).collect();
    let error = pairs.try_next().map(drop).unwrap_err();
    assert!(matches!(error, Error::TooManyHeld), "{error}");
    held.truncate(3);
    assert_eq!(next_pair(&mut pairs), (5, 0));
}

#[test]
fn pollable_join_is_readable_and_explains_silence() {
    use rustix::event::{PollFd, PollFlags, poll};
    let test_domain = TestDomain::new();
    let builder = || JoinedSubscriber::<Scan, Foreground>::builder("front").in_domain(&test_domain.domain);
    let pairs = builder().open_pollable().unwrap();
    assert!(matches!(pairs.why_silent(), Silence::NoHub { .. }));
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    wait_until("both subscribers", || {
        assert!(pairs.try_next().unwrap().is_none());
        hub.front_sensor().scan.subscribers() == 1 && hub.front_sensor().foreground.subscribers() == 1
    });
    hub.front_sensor().publish_scan_with_foreground(1, &[1000]);
    wait_until("the pair", || {
        poll(&mut [PollFd::new(&pairs, PollFlags::IN)], None).unwrap();
        pairs.try_next().unwrap().is_some_and(|pair| pair.second.header().seq == 1)
    });
}
