//! Tests of the names of a domain's shared memory, and of the doorbells with these names.

#![expect(clippy::disallowed_methods, reason = "limits and periods of real time")]

mod temp_domain;

use std::path::PathBuf;
use std::thread;

use rustix::fs::{FileType, Mode};
use rustix::time::{ClockId, clock_gettime};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{DoorbellWord, Kind, Scan, WakeEvent};
use scanhub_shm::{Domain, HubLock, ListenLock};
use scanhub_shm::{Doorbell, Payload, WakeSender, wait_on_doorbells};
use temp_domain::TempDomain;

#[test]
fn one_ring_wakes_all_sleepers_of_a_doorbell() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let client = scanhub_shm::client_node(&test_domain.domain).unwrap();
    assert!(Doorbell::open(&client, "front").unwrap().is_none());
    let (front, rear) = (WakeSender::new(&hub, "front").unwrap(), WakeSender::new(&hub, "rear").unwrap());
    let doorbell = |sensor| Doorbell::open(&client, sensor).unwrap().expect("the hub hung it");
    let (ring_count, end) = (doorbell("front").ring_count(DoorbellWord::First), ns_after_seconds(20));
    let sleepers: Vec<_> = (0..8)
        .map(|number| {
            let (front, rear) = (doorbell("front"), doorbell("rear"));
            thread::spawn(move || {
                let both = [
                    (&front, DoorbellWord::First, front.ring_count(DoorbellWord::First)),
                    (&rear, DoorbellWord::First, ring_count),
                ];
                let bells = if number % 2 == 0 { &both[..] } else { &both[1..] };
                while rear.ring_count(DoorbellWord::First) == ring_count && ns_after_seconds(0) < end {
                    wait_on_doorbells(bells, end).expect("this system can wait for two words");
                }
                rear.ring_count(DoorbellWord::First)
            })
        })
        .collect();
    // This ring wakes only the half of the threads that also wait for `front`. They find no ring of `rear`, and sleep
    // again.
    front.wake(WakeEvent::Telegram).unwrap();
    rear.wake(WakeEvent::Telegram).unwrap();
    assert!(sleepers.into_iter().all(|sleeper| sleeper.join().unwrap() == ring_count + 1));
    assert!(ns_after_seconds(0) < end, "a wait lasted to the end");
    assert_eq!(
        (doorbell("front").ring_count(DoorbellWord::First), doorbell("rear").is_closed()),
        (ring_count + 1, false)
    );
    let last = doorbell("rear");
    drop(rear);
    assert!(last.is_closed() && Doorbell::open(&client, "rear").unwrap().is_none());
}

#[test]
fn equal_domains_below_two_roots_have_own_doorbells() {
    let test_domain = TempDomain::new();
    let other = Domain::at(test_domain.domain.name(), &test_domain.base.join("other")).unwrap();
    let [here, there] = [&test_domain.domain, &other].map(|domain| scanhub_shm::hub_node(domain).unwrap());
    let mine = WakeSender::new(&here, "front").unwrap();
    let doorbell = Doorbell::open(&here, "front").unwrap().expect("the hub hung it");
    let count = doorbell.ring_count(DoorbellWord::First);
    assert!(Doorbell::open(&there, "front").unwrap().is_none(), "no process created one there");
    let theirs = WakeSender::new(&there, "front").unwrap();
    theirs.wake(WakeEvent::Telegram).unwrap();
    drop(theirs);
    assert!(
        doorbell.ring_count(DoorbellWord::First) == count && !doorbell.is_closed(),
        "another hub's end is none of ours"
    );
    mine.wake(WakeEvent::Telegram).unwrap();
    assert_ne!(doorbell.ring_count(DoorbellWord::First), count);
    assert!(Doorbell::open(&here, "front").unwrap().is_some());
}

#[test]
fn next_hub_rings_the_doorbell_of_a_killed_hub() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let killed = WakeSender::new(&hub, "front").unwrap();
    let doorbell = Doorbell::open(&hub, "front").unwrap().expect("the hub hung it");
    // A process that is killed does not close its doorbell.
    std::mem::forget(killed);
    let next = WakeSender::new(&hub, "front").unwrap();
    let ring_count = doorbell.ring_count(DoorbellWord::First);
    next.wake(WakeEvent::Telegram).unwrap();
    assert_eq!((doorbell.ring_count(DoorbellWord::First), doorbell.is_closed()), (ring_count + 1, false));
    let end = ns_after_seconds(20);
    wait_on_doorbells(&[(&doorbell, DoorbellWord::First, ring_count)], end).unwrap();
    assert!(ns_after_seconds(10) < end, "what was rung before is no reason to sleep");
}

#[test]
fn unusable_doorbell_file_is_reported() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let prefix = std::fs::read_to_string(test_domain.domain.root().join("prefix")).unwrap();
    let path = PathBuf::from("/dev/shm").join(format!("{}front.bell", prefix.trim_end()));
    rustix::fs::mknodat(rustix::fs::CWD, &path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    let failure = WakeSender::new(&hub, "front").err().expect("no subscriber waits for the writer");
    assert!(failure.message.contains("is not a regular file"), "{failure}");
    assert_eq!(Doorbell::open(&hub, "front").err(), Some(failure));
    std::fs::remove_file(&path).unwrap();
    std::os::unix::fs::symlink("/dev/null", &path).unwrap();
    let failure = WakeSender::new(&hub, "front").err().expect("a link is not followed");
    assert_eq!(failure.kind, Kind::Failed);
    assert!(failure.message.starts_with(path.to_str().unwrap()) && !failure.hint.is_empty(), "{failure}");
    assert!(Doorbell::open(&hub, "front").is_err());
    std::fs::remove_file(&path).unwrap();
    std::fs::write(&path, "").unwrap();
    assert!(Doorbell::open(&hub, "front").unwrap().is_none(), "it is not made yet");
    assert!(WakeSender::new(&hub, "front").is_ok());
}

#[test]
fn last_process_removes_the_prefix_and_all_files() {
    let test_domain = TempDomain::new();
    let root = test_domain.domain.root();
    let prefix = || std::fs::read_to_string(root.join("prefix")).ok();
    let files = || {
        let entries = std::fs::read_dir("/dev/shm").unwrap().flatten();
        let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
        names.filter(|name| name.starts_with(&test_domain.domain.prefix())).collect::<Vec<_>>()
    };
    let lock = HubLock::acquire(root).unwrap();
    let first = prefix().expect("names are there with the lock");
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let client = scanhub_shm::client_node(&test_domain.domain).unwrap();
    assert_eq!(scanhub_shm::is_member(&client, root), Ok(true));
    drop((hub, lock));
    assert_eq!(prefix().as_ref(), Some(&first), "a subscriber waits for the next hub");
    let lock = HubLock::acquire(root).unwrap();
    drop(client);
    assert_eq!(files().len(), 1, "the library's counter: {:?}", files());
    let listener = ListenLock::acquire(root).unwrap();
    drop(lock);
    assert!(prefix().is_some(), "a listener is about to join");
    drop(listener);
    assert_eq!((prefix(), files()), (None, Vec::new()));
    let failure = scanhub_shm::client_node(&test_domain.domain).unwrap_err();
    assert!(failure.message.contains("does not contain the name of the shared memory"), "{failure}");
    let _lock = HubLock::acquire(root).unwrap();
    assert!(prefix().is_some_and(|second| second != first));
}

/// Creates a domain at a location of the maximum length, and uses all kinds of shared memory in it.
#[test]
fn shared_memory_works_at_the_longest_location() {
    let test_domain = TempDomain::new();
    let base =
        |length: usize| test_domain.base.join("x".repeat(length - test_domain.base.as_os_str().len() - 1));
    let name = test_domain.domain.name();
    let longest = (test_domain.base.as_os_str().len() + 2..).map(|length| Domain::at(name, &base(length)));
    let domain = longest.take_while(Result::is_ok).last().expect("one is possible").unwrap();
    let hub = scanhub_shm::hub_node(&domain).unwrap();
    let waker = WakeSender::new(&hub, &"s".repeat(24)).unwrap();
    let topic = Scan::create(&hub, "front", &TopicLimits::default()).unwrap();
    let (publisher, subscriber) =
        (Scan::publisher(&topic, &TopicLimits::default()).unwrap(), Scan::subscriber(&hub, &topic).unwrap());
    let listener = scanhub_shm::listener(&hub, waker.service()).unwrap();
    waker.wake(WakeEvent::Telegram).unwrap();
    assert!(scanhub_shm::take_wakeups(&[&listener]).unwrap());
    assert_eq!(Scan::loan(&publisher, 0).unwrap().send().unwrap(), 1);
    assert!(Scan::receive(&subscriber).unwrap().is_some());
}

/// Returns the time of CLOCK_MONOTONIC in `seconds` seconds.
fn ns_after_seconds(seconds: i64) -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    (now.tv_sec + seconds) as u64 * 1_000_000_000 + now.tv_nsec as u64
}
