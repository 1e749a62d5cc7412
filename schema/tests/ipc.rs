//! Topics in shared memory, each test in a domain of its own.
#![cfg(feature = "ipc")]

use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::Duration;

use rustix::fs::{FileType, Mode};
use rustix::time::{ClockId, clock_gettime};
use schema::ipc::{self, Bell, Payload, PortFactory, Waker, sleep_at_bells};
use schema::{
    Domain, Failure, Header, HubLock, Kind, ListenLock, Request, Response, Scan, Status, Topic, Verb, Wake,
    holder, limits, publisher,
};

/// A domain that goes with the test.
struct Place {
    base: PathBuf,
    domain: Domain,
}

impl Place {
    fn new() -> Place {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let base = PathBuf::from(format!("/tmp/shs{}-{number}", std::process::id()));
        let domain = Domain::at(&format!("s{}-{number}", std::process::id()), &base).unwrap();
        Place { base, domain }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.base);
        // The node management of a domain outlives its nodes.
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.domain.prefix()) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

#[test]
fn a_scan_is_written_and_read_in_place() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let topic = Scan::create(&hub, "front").unwrap();
    let publisher = Scan::publisher(&topic).unwrap();

    let client = ipc::client_node(&place.domain).unwrap();
    let seen = Scan::open(&client, "front").unwrap().expect("the hub made it");
    let subscriber = Scan::subscriber(&seen).unwrap();

    let mut sample = publisher.loan().unwrap();
    *sample.user_header_mut() = Header { seq: 7, topic_seq: 3, ..Header::default() };
    let scan = sample.payload_mut();
    scan.count = 2;
    scan.range_array[..2].copy_from_slice(&[11, 12]);
    assert_eq!(sample.send().unwrap(), 1);

    let received = Scan::receive(&subscriber).unwrap().expect("one was sent");
    assert_eq!((received.user_header().seq, received.user_header().topic_seq), (7, 3));
    assert_eq!(received.ranges(), [11, 12]);
    assert!(Scan::receive(&subscriber).unwrap().is_none());
    let types = seen.static_config().message_type_details();
    assert_eq!((types.payload.size(), types.user_header.size()), (1216, 64));
    assert_eq!(types.payload.type_name().to_string(), Topic::Scan.payload());
    assert_eq!(types.user_header.type_name().to_string(), "scanhub.Header.v1");
    let revision = seen.attributes().iter().next().map(|it| (it.key().to_string(), it.value().to_string()));
    assert_eq!(revision, Some(("revision".into(), "1".into())));
}

#[test]
fn a_telegram_is_as_long_as_it_is() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let topic = <[u8]>::create(&hub, "front").unwrap();
    let publisher = <[u8]>::publisher(&topic).unwrap();
    let subscriber = <[u8]>::subscriber(&topic).unwrap();
    for length in [9, 814] {
        let bytes: Vec<u8> = (0..length).map(|i| i as u8).collect();
        publisher.loan_slice_uninit(length).unwrap().write_from_slice(&bytes).send().unwrap();
        assert_eq!(*<[u8]>::receive(&subscriber).unwrap().expect("one was sent"), *bytes);
    }
    assert!(publisher.loan_slice_uninit(815).is_err());
}

#[test]
fn a_late_consumer_gets_the_last_status() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let topic = Status::create(&hub, "front").unwrap();
    let publisher = Status::publisher(&topic).unwrap();
    for baud in [9600, 38400] {
        let mut sample = publisher.loan().unwrap();
        sample.payload_mut().baud = baud;
        assert_eq!(sample.send().unwrap(), 0);
    }
    let subscriber = Status::subscriber(&topic).unwrap();
    schema::ipc::UpdateConnections::update_connections(&publisher).unwrap();
    assert_eq!(Status::receive(&subscriber).unwrap().expect("history").baud, 38400);
    assert!(Status::receive(&subscriber).unwrap().is_none());
}

#[test]
fn a_full_queue_drops_the_oldest_and_nobody_waits() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let topic = Scan::create(&hub, "front").unwrap();
    let publisher = Scan::publisher(&topic).unwrap();
    let subscriber = Scan::subscriber(&topic).unwrap();
    for seq in 0..100 {
        let mut sample = publisher.loan().unwrap();
        sample.user_header_mut().seq = seq;
        sample.send().unwrap();
    }
    let held: Vec<_> =
        (0..4).map(|_| Scan::receive(&subscriber).unwrap().unwrap().user_header().seq).collect();
    assert_eq!(held, [84, 85, 86, 87]);
}

#[test]
fn a_second_publisher_is_refused() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let topic = Scan::create(&hub, "front").unwrap();
    let _first = Scan::publisher(&topic).unwrap();
    let other = ipc::hub_node(&place.domain).unwrap();
    let again = Scan::create(&other, "front").unwrap();
    assert_eq!(Scan::publisher(&again).unwrap_err().kind, Kind::DomainHeld);
}

#[test]
fn limits_are_those_of_the_contract() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let scan = Scan::create(&hub, "front").unwrap();
    let config = scan.static_config();
    assert_eq!((config.max_publishers(), config.max_subscribers(), config.max_nodes()), (1, 200, 260));
    assert_eq!((config.subscriber_max_buffer_size(), config.subscriber_max_borrowed_samples()), (16, 4));
    assert_eq!((config.history_size(), config.has_safe_overflow()), (0, true));
    let status = Status::create(&hub, "front").unwrap();
    let config = status.static_config();
    assert_eq!((config.subscriber_max_buffer_size(), config.history_size()), (4, 1));
    let waker = Waker::new(&hub, "front").unwrap();
    let config = waker.service().static_config();
    assert_eq!((config.max_listeners(), config.max_nodes(), config.event_id_max_value()), (250, 260, 7));
    assert_eq!(limits::samples(Topic::Scan), 16 + 800 + 2);
    assert_eq!(Topic::ALL.map(limits::subscribers), [32, 200, 32, 200, 32, 32, 64]);
}

#[test]
fn consumers_wake_for_every_reason() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let waker = Waker::new(&hub, "front").unwrap();
    let client = ipc::client_node(&place.domain).unwrap();
    let seen = ipc::open_wake(&client, "front").unwrap().expect("the hub made it");
    let listener = ipc::listener(&seen).unwrap();
    let heard = || {
        let mut ids = Vec::new();
        listener.try_wait(|event| ids.push(event.id.as_value())).unwrap();
        ids
    };
    assert_eq!(heard(), [0usize; 0], "who comes later was not woken");
    waker.wake(Wake::Telegram).unwrap();
    assert_eq!(heard(), [Wake::Telegram as usize]);
    drop(waker);
    assert_eq!(heard(), [Wake::HubDown as usize]);
    let _again = Waker::new(&hub, "front").unwrap();
    assert_eq!(heard(), [Wake::HubUp as usize]);
}

/// CLOCK_MONOTONIC in so many seconds.
fn in_seconds(seconds: i64) -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    (now.tv_sec + seconds) as u64 * 1_000_000_000 + now.tv_nsec as u64
}

#[test]
fn one_ring_wakes_all_who_sleep_at_a_bell() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let client = ipc::client_node(&place.domain).unwrap();
    assert!(Bell::open(&client, "front").unwrap().is_none());
    let (front, rear) = (Waker::new(&hub, "front").unwrap(), Waker::new(&hub, "rear").unwrap());
    let bell = |sensor| Bell::open(&client, sensor).unwrap().expect("the hub hung it");
    let (heard, end) = (bell("front").rung(), in_seconds(20));
    let sleepers: Vec<_> = (0..8)
        .map(|number| {
            let (front, rear) = (bell("front"), bell("rear"));
            thread::spawn(move || {
                let both = [(&front, front.rung()), (&rear, heard)];
                let bells = if number % 2 == 0 { &both[..] } else { &both[1..] };
                while rear.rung() == heard && in_seconds(0) < end {
                    sleep_at_bells(bells, end).expect("this system can wait for two words");
                }
                rear.rung()
            })
        })
        .collect();
    // Of a sensor that only half of them follow; they go on sleeping.
    front.wake(Wake::Telegram).unwrap();
    rear.wake(Wake::Telegram).unwrap();
    assert!(sleepers.into_iter().all(|sleeper| sleeper.join().unwrap() == heard + 1));
    assert!(in_seconds(0) < end, "somebody slept to the end");
    assert_eq!((bell("front").rung(), bell("rear").is_closed()), (heard + 1, false));
    let last = bell("rear");
    drop(rear);
    assert!(last.is_closed() && Bell::open(&client, "rear").unwrap().is_none());
}

#[test]
fn hubs_of_one_name_below_two_roots_have_bells_of_their_own() {
    let place = Place::new();
    let other = Domain::at(place.domain.name(), &place.base.join("other")).unwrap();
    let [here, there] = [&place.domain, &other].map(|domain| ipc::hub_node(domain).unwrap());
    let mine = Waker::new(&here, "front").unwrap();
    let bell = Bell::open(&here, "front").unwrap().expect("the hub hung it");
    let rung = bell.rung();
    assert!(Bell::open(&there, "front").unwrap().is_none(), "nobody hung one there");
    let theirs = Waker::new(&there, "front").unwrap();
    theirs.wake(Wake::Telegram).unwrap();
    drop(theirs);
    assert!(bell.rung() == rung && !bell.is_closed(), "another hub's end is none of ours");
    mine.wake(Wake::Telegram).unwrap();
    assert_ne!(bell.rung(), rung);
    assert!(Bell::open(&here, "front").unwrap().is_some());
}

#[test]
fn the_bell_of_a_killed_hub_is_rung_by_the_next_one() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let killed = Waker::new(&hub, "front").unwrap();
    let bell = Bell::open(&hub, "front").unwrap().expect("the hub hung it");
    // A process that is killed closes nothing.
    std::mem::forget(killed);
    let next = Waker::new(&hub, "front").unwrap();
    let heard = bell.rung();
    next.wake(Wake::Telegram).unwrap();
    assert_eq!((bell.rung(), bell.is_closed()), (heard + 1, false));
    let end = in_seconds(20);
    sleep_at_bells(&[(&bell, heard)], end).unwrap();
    assert!(in_seconds(10) < end, "what was rung before is no reason to sleep");
}

#[test]
fn a_bell_that_nobody_can_have_is_told() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
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
fn what_is_not_there_is_nothing_and_sensors_are_listed() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    assert!(Scan::open(&hub, "front").unwrap().is_none());
    assert!(ipc::open_wake(&hub, "front").unwrap().is_none());
    assert!(ipc::sensors(&place.domain).unwrap().is_empty());
    let _topics = (Scan::create(&hub, "rear").unwrap(), Status::create(&hub, "rear").unwrap());
    let _other = <[u8]>::create(&hub, "front").unwrap();
    assert_eq!(ipc::sensors(&place.domain).unwrap(), ["front", "rear"]);
}

#[test]
fn one_hub_holds_a_domain() {
    let place = Place::new();
    let root = place.domain.root();
    assert_eq!(holder(root), Ok(None));
    let lock = HubLock::acquire(root).unwrap();
    assert_eq!(holder(root), Ok(Some(std::process::id())));
    let second = HubLock::acquire(root).unwrap_err();
    assert_eq!(second.kind, Kind::DomainHeld);
    assert!(second.message.contains(&format!("pid {}", std::process::id())), "{second}");
    drop(lock);
    assert_eq!(holder(root), Ok(None));
    let listener = ListenLock::acquire(root).unwrap();
    assert_eq!((holder(root), publisher(root)), (Ok(None), Ok(Some(std::process::id()))));
    assert!(ListenLock::acquire(root).unwrap_err().message.starts_with("another listener holds "));
    let _again = HubLock::acquire(root).unwrap();
    drop(listener);
    assert_eq!(publisher(root), Ok(Some(std::process::id())));
}

#[test]
fn a_hub_that_was_killed_while_making_a_topic_leaves_no_obstacle() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let topic = Scan::create(&hub, "front").unwrap();
    let services = place.domain.root().join("services");
    let description = std::fs::read_dir(&services).unwrap().next().unwrap().unwrap().path();
    let text = std::fs::read(&description).unwrap();
    drop((topic, hub));
    assert!(!description.exists());
    // Written, but not yet made read-only.
    std::fs::write(&description, text).unwrap();
    let hub = ipc::hub_node(&place.domain).unwrap();
    Scan::create(&hub, "front").unwrap();
}

#[test]
fn a_request_is_answered_and_both_are_woken() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    let server = ipc::ControlServer::create(&hub).unwrap();
    let node = ipc::client_node(&place.domain).unwrap();
    let client = ipc::ControlClient::open(&node).unwrap().expect("the hub made it");
    assert!(!ipc::take_wakeups(&[client.responses()]).unwrap());
    let pending = client.ask(&Request::new("front", Verb::Pause)).unwrap();
    ipc::sleep(&[server.requests()], Duration::from_secs(20)).unwrap();
    let asked = server.receive().unwrap().expect("was asked");
    assert_eq!((asked.request().sensor(), asked.request().verb()), ("front", Some(Verb::Pause)));
    assert!(server.receive().unwrap().is_none() && !ipc::take_wakeups(&[server.requests()]).unwrap());
    assert!(pending.response().unwrap().is_none() && pending.is_open());
    let refusal = Response(Err(Failure::new(Kind::Short, "busy", "wait")));
    server.answer(asked, &refusal).unwrap();
    assert!(ipc::take_wakeups(&[client.responses()]).unwrap());
    assert_eq!(pending.response().unwrap(), Some(refusal));
}

#[test]
fn clients_that_went_while_they_asked_are_no_obstacle() {
    let place = Place::new();
    let hub = ipc::hub_node(&place.domain).unwrap();
    assert!(ipc::ControlClient::open(&hub).unwrap().is_none());
    let server = ipc::ControlServer::create(&hub).unwrap();
    for verb in [Verb::Pause, Verb::Resume].repeat(limits::CONTROL_CLIENTS) {
        let node = ipc::client_node(&place.domain).unwrap();
        let client = ipc::ControlClient::open(&node).unwrap().expect("the hub made it");
        let pending = client.ask(&Request::new("front", verb)).unwrap();
        if verb == Verb::Pause {
            // Received and then given up.
            let asked = server.receive().unwrap().expect("was asked");
            drop(pending);
            assert!(!asked.is_waited_for());
            server.answer(asked, &Response(Ok(None))).unwrap();
        } else {
            drop((pending, client));
            assert!(server.receive().unwrap().is_none());
        }
    }
}

#[test]
fn the_librarys_version_is_the_one_that_is_built_with() {
    let manifest = include_str!("../../Cargo.toml");
    let pinned = manifest.lines().find_map(|line| line.strip_prefix("iceoryx2 = { version = \"="));
    let version = pinned.and_then(|rest| rest.split('"').next()).expect("it is pinned");
    assert_eq!(ipc::LIBRARY, format!("iceoryx2 {version}"));
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
    let hub = ipc::hub_node(&place.domain).unwrap();
    let client = ipc::client_node(&place.domain).unwrap();
    assert!(ipc::is_member(&client, root));
    drop((hub, lock));
    assert_eq!(prefix().as_ref(), Some(&first), "a consumer waits for the next hub");
    let lock = HubLock::acquire(root).unwrap();
    drop(client);
    assert_eq!(files().len(), 1, "the library's counter: {:?}", files());
    drop(lock);
    assert_eq!((prefix(), files()), (None, Vec::new()));
    let failure = ipc::client_node(&place.domain).unwrap_err();
    assert!(failure.message.contains("does not tell how shared memory is named"), "{failure}");
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
    let hub = ipc::hub_node(&domain).unwrap();
    let waker = Waker::new(&hub, &"s".repeat(24)).unwrap();
    let topic = Scan::create(&hub, "front").unwrap();
    let (publisher, subscriber) = (Scan::publisher(&topic).unwrap(), Scan::subscriber(&topic).unwrap());
    let listener = ipc::listener(waker.service()).unwrap();
    waker.wake(Wake::Telegram).unwrap();
    assert!(ipc::take_wakeups(&[&listener]).unwrap());
    assert_eq!(publisher.loan().unwrap().send().unwrap(), 1);
    assert!(Scan::receive(&subscriber).unwrap().is_some());
}
