//! The names of a domain's shared memory, and the bells that lie under them.

#![expect(clippy::disallowed_methods, reason = "limits and periods of real time")]

mod place;

use std::path::PathBuf;
use std::thread;

use place::Place;
use rustix::fs::{FileType, Mode};
use rustix::time::{ClockId, clock_gettime};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Kind, Ring, Scan, Wake};
use scanhub_shm::{Bell, Payload, Waker, sleep_at_bells};
use scanhub_shm::{Domain, HubLock, ListenLock};

#[test]
fn one_ring_wakes_all_who_sleep_at_a_bell() {
    let place = Place::new();
    let hub = scanhub_shm::hub_node(&place.domain).unwrap();
    let client = scanhub_shm::client_node(&place.domain).unwrap();
    assert!(Bell::open(&client, "front").unwrap().is_none());
    let (front, rear) = (Waker::new(&hub, "front").unwrap(), Waker::new(&hub, "rear").unwrap());
    let bell = |sensor| Bell::open(&client, sensor).unwrap().expect("the hub hung it");
    let (heard, end) = (bell("front").rung(Ring::First), in_seconds(20));
    let sleepers: Vec<_> = (0..8)
        .map(|number| {
            let (front, rear) = (bell("front"), bell("rear"));
            thread::spawn(move || {
                let both = [(&front, Ring::First, front.rung(Ring::First)), (&rear, Ring::First, heard)];
                let bells = if number % 2 == 0 { &both[..] } else { &both[1..] };
                while rear.rung(Ring::First) == heard && in_seconds(0) < end {
                    sleep_at_bells(bells, end).expect("this system can wait for two words");
                }
                rear.rung(Ring::First)
            })
        })
        .collect();
    // Of a sensor that only half of them follow; they go on sleeping.
    front.wake(Wake::Telegram).unwrap();
    rear.wake(Wake::Telegram).unwrap();
    assert!(sleepers.into_iter().all(|sleeper| sleeper.join().unwrap() == heard + 1));
    assert!(in_seconds(0) < end, "somebody slept to the end");
    assert_eq!((bell("front").rung(Ring::First), bell("rear").is_closed()), (heard + 1, false));
    let last = bell("rear");
    drop(rear);
    assert!(last.is_closed() && Bell::open(&client, "rear").unwrap().is_none());
}

#[test]
fn hubs_of_one_name_below_two_roots_have_bells_of_their_own() {
    let place = Place::new();
    let other = Domain::at(place.domain.name(), &place.base.join("other")).unwrap();
    let [here, there] = [&place.domain, &other].map(|domain| scanhub_shm::hub_node(domain).unwrap());
    let mine = Waker::new(&here, "front").unwrap();
    let bell = Bell::open(&here, "front").unwrap().expect("the hub hung it");
    let rung = bell.rung(Ring::First);
    assert!(Bell::open(&there, "front").unwrap().is_none(), "nobody hung one there");
    let theirs = Waker::new(&there, "front").unwrap();
    theirs.wake(Wake::Telegram).unwrap();
    drop(theirs);
    assert!(bell.rung(Ring::First) == rung && !bell.is_closed(), "another hub's end is none of ours");
    mine.wake(Wake::Telegram).unwrap();
    assert_ne!(bell.rung(Ring::First), rung);
    assert!(Bell::open(&here, "front").unwrap().is_some());
}

#[test]
fn the_bell_of_a_killed_hub_is_rung_by_the_next_one() {
    let place = Place::new();
    let hub = scanhub_shm::hub_node(&place.domain).unwrap();
    let killed = Waker::new(&hub, "front").unwrap();
    let bell = Bell::open(&hub, "front").unwrap().expect("the hub hung it");
    // A process that is killed closes nothing.
    std::mem::forget(killed);
    let next = Waker::new(&hub, "front").unwrap();
    let heard = bell.rung(Ring::First);
    next.wake(Wake::Telegram).unwrap();
    assert_eq!((bell.rung(Ring::First), bell.is_closed()), (heard + 1, false));
    let end = in_seconds(20);
    sleep_at_bells(&[(&bell, Ring::First, heard)], end).unwrap();
    assert!(in_seconds(10) < end, "what was rung before is no reason to sleep");
}

#[test]
fn a_bell_that_nobody_can_have_is_told() {
    let place = Place::new();
    let hub = scanhub_shm::hub_node(&place.domain).unwrap();
    let prefix = std::fs::read_to_string(place.domain.root().join("prefix")).unwrap();
    let path = PathBuf::from("/dev/shm").join(format!("{}front.bell", prefix.trim_end()));
    rustix::fs::mknodat(rustix::fs::CWD, &path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    let failure = Waker::new(&hub, "front").err().expect("nobody waits for who writes");
    assert!(failure.message.contains("is no file"), "{failure}");
    assert_eq!(Bell::open(&hub, "front").err(), Some(failure));
    std::fs::remove_file(&path).unwrap();
    std::os::unix::fs::symlink("/dev/null", &path).unwrap();
    let failure = Waker::new(&hub, "front").err().expect("a link is not followed");
    assert_eq!(failure.kind, Kind::Failed);
    assert!(failure.message.starts_with(path.to_str().unwrap()) && !failure.hint.is_empty(), "{failure}");
    assert!(Bell::open(&hub, "front").is_err());
    std::fs::remove_file(&path).unwrap();
    std::fs::write(&path, "").unwrap();
    assert!(Bell::open(&hub, "front").unwrap().is_none(), "it is not made yet");
    assert!(Waker::new(&hub, "front").is_ok());
}

#[test]
fn the_last_one_out_takes_the_names_along() {
    let place = Place::new();
    let root = place.domain.root();
    let prefix = || std::fs::read_to_string(root.join("prefix")).ok();
    let files = || {
        let entries = std::fs::read_dir("/dev/shm").unwrap().flatten();
        let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
        names.filter(|name| name.starts_with(&place.domain.prefix())).collect::<Vec<_>>()
    };
    let lock = HubLock::acquire(root).unwrap();
    let first = prefix().expect("names are there with the lock");
    let hub = scanhub_shm::hub_node(&place.domain).unwrap();
    let client = scanhub_shm::client_node(&place.domain).unwrap();
    assert_eq!(scanhub_shm::is_member(&client, root), Ok(true));
    drop((hub, lock));
    assert_eq!(prefix().as_ref(), Some(&first), "a consumer waits for the next hub");
    let lock = HubLock::acquire(root).unwrap();
    drop(client);
    assert_eq!(files().len(), 1, "the library's counter: {:?}", files());
    let listener = ListenLock::acquire(root).unwrap();
    drop(lock);
    assert!(prefix().is_some(), "a listener is about to join");
    drop(listener);
    assert_eq!((prefix(), files()), (None, Vec::new()));
    let failure = scanhub_shm::client_node(&place.domain).unwrap_err();
    assert!(failure.message.contains("does not contain the name of the shared memory"), "{failure}");
    let _lock = HubLock::acquire(root).unwrap();
    assert!(prefix().is_some_and(|second| second != first));
}

/// Root and prefix are as long as they may be.
#[test]
fn at_the_longest_place_all_works() {
    let place = Place::new();
    let base = |length: usize| place.base.join("x".repeat(length - place.base.as_os_str().len() - 1));
    let name = place.domain.name();
    let longest = (place.base.as_os_str().len() + 2..).map(|length| Domain::at(name, &base(length)));
    let domain = longest.take_while(Result::is_ok).last().expect("one is possible").unwrap();
    let hub = scanhub_shm::hub_node(&domain).unwrap();
    let waker = Waker::new(&hub, &"s".repeat(24)).unwrap();
    let topic = Scan::create(&hub, "front", &TopicLimits::default()).unwrap();
    let (publisher, subscriber) =
        (Scan::publisher(&topic, &TopicLimits::default()).unwrap(), Scan::subscriber(&hub, &topic).unwrap());
    let listener = scanhub_shm::listener(&hub, waker.service()).unwrap();
    waker.wake(Wake::Telegram).unwrap();
    assert!(scanhub_shm::take_wakeups(&[&listener]).unwrap());
    assert_eq!(Scan::loan(&publisher, 0).unwrap().send().unwrap(), 1);
    assert!(Scan::receive(&subscriber).unwrap().is_some());
}

/// CLOCK_MONOTONIC in so many seconds.
fn in_seconds(seconds: i64) -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    (now.tv_sec + seconds) as u64 * 1_000_000_000 + now.tv_nsec as u64
}
