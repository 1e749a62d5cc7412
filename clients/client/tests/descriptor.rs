//! Tests of subscribers with a descriptor. It is readable while a sample waits, and not after the sample was received,
//! also across restarts of the hub.

mod fake;

use std::os::fd::{AsFd, AsRawFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use fake::{FakeHub, TestDomain, wait_until};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use scanhub_client::{PollableSubscriber, RobotSubscriber, Subscriber, ZonesSubscriber};
use scanhub_schema::{Scan, Status, Verdict};
use scanhub_shm::UpdateConnections;

/// Returns whether `descriptor` becomes readable within `timeout`.
fn is_readable(descriptor: &impl AsFd, timeout: Duration) -> bool {
    let mut fds = [PollFd::new(descriptor, PollFlags::IN)];
    let longest = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: timeout.subsec_nanos().into() };
    poll(&mut fds, Some(&longest)).unwrap() == 1
}

fn scans(test_domain: &TestDomain) -> PollableSubscriber<Scan> {
    Subscriber::<Scan>::builder("front").in_domain(&test_domain.domain).open_pollable().unwrap()
}

/// Timeout that only a hang exceeds, even on a busy machine.
const WAIT_TIMEOUT: Duration = Duration::from_secs(60);

/// Period of the scans, in us. A verdict is then valid for more than a second, so that a busy machine receives it in
/// time.
const LONG_PERIOD_US: u32 = 500_000;

/// Polls until a scan arrives. Returns the run of the hub (`boot`), whether the hub was restarted, and the number of
/// beams.
fn await_scan(scans: &PollableSubscriber<Scan>) -> (u64, bool, usize) {
    let give_up_at = Instant::now() + WAIT_TIMEOUT;
    loop {
        assert!(is_readable(scans, WAIT_TIMEOUT) && Instant::now() < give_up_at);
        if let Some(scan) = scans.try_next().unwrap() {
            return (scan.header().boot, scan.restarted, scan.beams());
        }
    }
}

#[test]
fn same_descriptor_is_readable_over_hub_restarts() {
    let test_domain = TestDomain::new();
    let scans = scans(&test_domain);
    let number = scans.as_raw_fd();
    for boot in 1..4 {
        let mut hub = FakeHub::new(&test_domain.domain, &["front"], boot);
        wait_until("the subscriber", || {
            assert!(is_readable(&scans, WAIT_TIMEOUT), "it looks for a hub by itself");
            assert!(scans.try_next().unwrap().is_none());
            hub.front_sensor().scan.subscribers() == 1
        });
        for beams in [5, 6] {
            hub.front_sensor().publish_scan(&vec![1000; beams]);
        }
        assert_eq!(await_scan(&scans), (boot, boot > 1, 5));
        assert!(is_readable(&scans, Duration::ZERO), "there is another one");
        assert_eq!(await_scan(&scans), (boot, false, 6));
        assert!(scans.try_next().unwrap().is_none());
        assert_eq!((scans.as_raw_fd(), scans.as_fd().as_raw_fd()), (number, number));
    }
}

#[test]
fn idle_hub_rarely_wakes_the_subscriber() {
    let test_domain = TestDomain::new();
    let scans = scans(&test_domain);
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    wait_until("the subscriber", || {
        assert!(scans.try_next().unwrap().is_none());
        hub.front_sensor().scan.subscribers() == 1
    });
    let (started, mut looks) = (Instant::now(), 0);
    while started.elapsed() < Duration::from_secs(3) {
        if is_readable(&scans, Duration::from_millis(500)) {
            assert!(scans.try_next().unwrap().is_none());
            looks += 1;
        }
    }
    // There are ten wake-ups in the first second, because a late joiner may receive a sample then.
    assert!((1..=20).contains(&looks), "{looks}");
}

#[test]
fn history_makes_late_joiner_readable() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    hub.front_sensor().publish_status(|status| status.baud = 500_000);
    let builder = Subscriber::<Status>::builder("front").in_domain(&test_domain.domain);
    let statuses = builder.open_pollable().unwrap();
    wait_until("the status", || {
        hub.front_sensor().status.publisher.update_connections().unwrap();
        assert!(is_readable(&statuses, WAIT_TIMEOUT));
        statuses.try_next().unwrap().is_some_and(|status| status.baud == 500_000)
    });
}

#[test]
fn stale_verdict_makes_descriptor_readable() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let zones = ZonesSubscriber::builder("front").in_domain(&test_domain.domain).open_pollable().unwrap();
    let polled = || loop {
        assert!(is_readable(&zones, WAIT_TIMEOUT));
        if let Some(update) = zones.try_next().unwrap() {
            return (update.zones.verdict(), update.stale);
        }
    };
    wait_until("the subscriber", || {
        let _ = zones.try_next().unwrap();
        hub.front_sensor().zones.subscribers() == 1
    });
    assert!(zones.hub_is_running());
    hub.front_sensor().period_us = LONG_PERIOD_US;
    hub.front_sensor().publish_zones(Verdict::Clear, 900);
    wait_until("the verdict", || polled() == (Verdict::Clear, false));
    assert_eq!(polled(), (Verdict::Unknown, true));
}

#[test]
fn pollable_robot_is_readable_on_a_verdict_change() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let robot = RobotSubscriber::builder(&["front"]).in_domain(&test_domain.domain).open_pollable().unwrap();
    wait_until("the subscriber", || {
        let _ = robot.try_next().unwrap();
        hub.front_sensor().zones.subscribers() == 1
    });
    hub.front_sensor().period_us = LONG_PERIOD_US;
    hub.front_sensor().publish_zones(Verdict::Clear, 900);
    let verdict = || loop {
        assert!(is_readable(&robot, WAIT_TIMEOUT));
        if let Some(now) = robot.try_next().unwrap() {
            return now.verdict();
        }
    };
    wait_until("the verdict", || verdict() == Verdict::Clear);
    wait_until("the silence", || verdict() == Verdict::Unknown);
}

#[test]
fn descriptor_is_closed_on_exec() {
    let test_domain = TestDomain::new();
    let scans = scans(&test_domain);
    let flags = rustix::io::fcntl_getfd(&scans).unwrap();
    assert!(flags.contains(rustix::io::FdFlags::CLOEXEC));
}

#[test]
fn samples_are_taken_while_the_descriptor_is_borrowed() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let scans = scans(&test_domain);
    let mut fds = [PollFd::new(&scans, PollFlags::IN)];
    wait_until("the subscriber", || {
        scans.try_next().unwrap().is_none() && hub.front_sensor().scan.subscribers() == 1
    });
    hub.front_sensor().publish_scan(&[1000]);
    wait_until("the scan", || {
        poll(&mut fds, None).unwrap();
        scans.try_next().unwrap().is_some()
    });
}

#[test]
fn pollable_subscriber_can_wait_too() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut scans = scans(&test_domain);
    assert!(scans.try_next().unwrap().is_none());
    hub.front_sensor().publish_scan(&[1000]);
    assert_eq!(scans.subscriber_mut().next().unwrap().expect("a scan").beams(), 1);
    assert!(is_readable(&scans, WAIT_TIMEOUT), "the event is still to be taken");
}

/// Returns the number of wake-ups of a program that takes all samples for 5 s, and the number of timeouts of `poll`.
fn wake_ups_and_timeouts(scans: &PollableSubscriber<Scan>) -> (u32, u32) {
    let (started, mut wake_ups, mut timeouts) = (Instant::now(), 0, 0);
    while started.elapsed() < Duration::from_secs(5) {
        match is_readable(scans, Duration::from_millis(500)) {
            true => wake_ups += 1,
            false => timeouts += 1,
        }
        assert!(scans.try_next().unwrap().is_none());
    }
    (wake_ups, timeouts)
}

#[test]
fn without_a_hub_poll_times_out() {
    let test_domain = TestDomain::new();
    let scans = scans(&test_domain);
    assert!(is_readable(&scans, WAIT_TIMEOUT), "it must look for a hub first");
    assert!(scans.try_next().unwrap().is_none());
    // The monitor checks every 2 s if it cannot watch the directories. This test receives nothing, so the descriptor
    // would stay readable after one check.
    assert!(!is_readable(&scans, Duration::from_secs(5)), "no timer wakes it");
}

#[test]
fn unrelated_files_wake_at_most_once_per_second() {
    let test_domain = TestDomain::new();
    let scans = scans(&test_domain);
    assert!(scans.try_next().unwrap().is_none());
    let is_done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for number in 0.. {
                if is_done.load(Ordering::Relaxed) {
                    break;
                }
                std::fs::write(test_domain.base.join(format!("other{number}")), "").unwrap();
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        let (wake_ups, timeouts) = wake_ups_and_timeouts(&scans);
        is_done.store(true, Ordering::Relaxed);
        assert!(wake_ups <= 6 && timeouts > 0, "{wake_ups} wake-ups, {timeouts} timeouts");
    });
}

#[test]
fn hub_start_makes_descriptor_readable() {
    let test_domain = TestDomain::new();
    let scans = scans(&test_domain);
    assert!(scans.try_next().unwrap().is_none() && !is_readable(&scans, Duration::ZERO));
    let _hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    assert!(is_readable(&scans, Duration::ZERO), "without a timer");
    wait_until("the hub", || {
        assert!(is_readable(&scans, WAIT_TIMEOUT));
        scans.try_next().unwrap().is_none() && scans.hub_is_running()
    });
}

#[test]
fn unknown_sensor_rarely_wakes_the_subscriber() {
    let test_domain = TestDomain::new();
    let _hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let scans = Subscriber::<Scan>::builder("frnot").in_domain(&test_domain.domain).open_pollable().unwrap();
    // In the first seconds, wake-ups are frequent, because the hub may still create the topic.
    let started = Instant::now();
    while started.elapsed() < Duration::from_secs(3) {
        is_readable(&scans, Duration::from_millis(100));
        assert!(scans.try_next().unwrap().is_none());
    }
    let (wake_ups, timeouts) = wake_ups_and_timeouts(&scans);
    assert!(wake_ups <= 7 && timeouts > 0, "{wake_ups} wake-ups, {timeouts} timeouts");
}

#[test]
fn silence_is_measured_from_the_last_sample() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let scans = scans(&test_domain);
    wait_until("the subscriber", || {
        scans.try_next().unwrap().is_none() && hub.front_sensor().scan.subscribers() == 1
    });
    let before = scans.silent_for();
    std::thread::sleep(Duration::from_millis(20));
    assert!(scans.silent_for() >= before + Duration::from_millis(20), "since it was opened");
    let sent = Instant::now();
    hub.front_sensor().publish_scan(&[1000]);
    let _scan = await_scan(&scans);
    assert!(scans.silent_for() <= sent.elapsed());
}
