//! Subscriptions in a poll set: readable when there is something to take, not readable after it was taken, over lives of
//! the hub.

mod fake;

use std::os::fd::{AsRawFd, OwnedFd};
use std::time::{Duration, Instant};

use fake::{FakeHub, Place, until};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use scanhub_client::{ErrorKind, Subscriber, Wait, ZonesSubscriber};
use scanhub_schema::{Scan, Status, Verdict};
use scanhub_shm::{PortFactory, UpdateConnections};

/// Whether `descriptor` gets readable within `longest`.
fn is_readable(descriptor: &OwnedFd, longest: Duration) -> bool {
    let mut fds = [PollFd::new(descriptor, PollFlags::IN)];
    let longest = Timespec { tv_sec: longest.as_secs() as i64, tv_nsec: longest.subsec_nanos().into() };
    poll(&mut fds, Some(&longest)).unwrap() == 1
}

fn scans(place: &Place) -> (Subscriber<Scan>, OwnedFd) {
    let mut scans =
        Subscriber::<Scan>::builder("front").in_domain(&place.domain).wait(Wait::Event).open().unwrap();
    let descriptor = scans.descriptor().unwrap().try_clone_to_owned().unwrap();
    (scans, descriptor)
}

/// Far longer than anything takes on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// Polls until there is a scan.
fn polled(scans: &mut Subscriber<Scan>, descriptor: &OwnedFd) -> (u64, bool, usize) {
    let give_up_at = Instant::now() + LONG;
    loop {
        assert!(is_readable(descriptor, LONG) && Instant::now() < give_up_at);
        if let Some(scan) = scans.try_next().unwrap() {
            return (scan.header().boot, scan.restarted, scan.beams());
        }
    }
}

#[test]
fn a_bell_has_no_descriptor() {
    let place = Place::new();
    let mut scans = Subscriber::<Scan>::builder("front").in_domain(&place.domain).open().unwrap();
    let failure = scans.descriptor().unwrap_err();
    assert_eq!(failure.kind(), ErrorKind::InvalidInput);
    assert!(failure.remedy().contains("by event"), "{failure}");
}

#[test]
fn it_is_readable_until_all_is_taken_and_the_same_over_lives_of_the_hub() {
    let place = Place::new();
    let (mut scans, descriptor) = scans(&place);
    let number = scans.descriptor().unwrap().as_raw_fd();
    for boot in 1..4 {
        let mut hub = FakeHub::new(&place.domain, &["front"], boot);
        until("the consumer", || {
            assert!(is_readable(&descriptor, LONG), "it looks for a hub by itself");
            assert!(scans.try_next().unwrap().is_none());
            hub.front().scan.service.dynamic_config().number_of_subscribers() == 1
        });
        for beams in [5, 6] {
            hub.front().scan(&vec![1000; beams]);
        }
        assert_eq!(polled(&mut scans, &descriptor), (boot, boot > 1, 5));
        assert!(is_readable(&descriptor, Duration::ZERO), "there is another one");
        assert_eq!(polled(&mut scans, &descriptor), (boot, false, 6));
        assert!(scans.try_next().unwrap().is_none());
        assert_eq!(scans.descriptor().unwrap().as_raw_fd(), number);
    }
}

#[test]
fn a_hub_that_lives_and_says_nothing_wakes_nobody_but_once_a_second() {
    let place = Place::new();
    let (mut scans, descriptor) = scans(&place);
    let mut hub = FakeHub::new(&place.domain, &["front"], 1);
    until("the consumer", || {
        assert!(scans.try_next().unwrap().is_none());
        hub.front().scan.service.dynamic_config().number_of_subscribers() == 1
    });
    let (started, mut looks) = (Instant::now(), 0);
    while started.elapsed() < Duration::from_secs(3) {
        if is_readable(&descriptor, Duration::from_millis(500)) {
            assert!(scans.try_next().unwrap().is_none());
            looks += 1;
        }
    }
    // Ten in the first second, in which something may be handed to a late joiner.
    assert!((1..=20).contains(&looks), "{looks}");
}

#[test]
fn what_a_late_joiner_is_handed_makes_it_readable() {
    let place = Place::new();
    let mut hub = FakeHub::new(&place.domain, &["front"], 1);
    hub.front().status(|status| status.baud = 500_000);
    let mut statuses =
        Subscriber::<Status>::builder("front").in_domain(&place.domain).wait(Wait::Event).open().unwrap();
    let descriptor = statuses.descriptor().unwrap().try_clone_to_owned().unwrap();
    until("the status", || {
        hub.front().status.publisher.update_connections().unwrap();
        assert!(is_readable(&descriptor, LONG));
        statuses.try_next().unwrap().is_some_and(|status| status.baud == 500_000)
    });
}

#[test]
fn a_verdict_that_gets_too_old_makes_it_readable() {
    let place = Place::new();
    let mut hub = FakeHub::new(&place.domain, &["front"], 1);
    let mut zones =
        ZonesSubscriber::builder("front").in_domain(&place.domain).wait(Wait::Event).open().unwrap();
    let descriptor = zones.descriptor().unwrap().try_clone_to_owned().unwrap();
    let polled = |zones: &mut ZonesSubscriber| loop {
        assert!(is_readable(&descriptor, LONG));
        if let Some(heard) = zones.try_next().unwrap() {
            return (heard.zones.verdict(), heard.stale);
        }
    };
    until("the consumer", || {
        let _ = zones.try_next().unwrap();
        hub.front().zones.service.dynamic_config().number_of_subscribers() == 1
    });
    assert!(zones.hub_is_running());
    hub.front().zones(Verdict::Clear, 900);
    until("the verdict", || polled(&mut zones) == (Verdict::Clear, false));
    assert_eq!(polled(&mut zones), (Verdict::Unknown, true));
}
