//! Tests of topics in shared memory, each in a separate domain.

mod temp_domain;

use std::time::Duration;

use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{
    ArrayFlags, Failure, Header, Kind, Request, Response, Scan, ScanHead, Status, Telegram, Topic, Verb,
    WakeEvent, limits,
};
use scanhub_shm::{HubLock, ListenLock, hub_pid, is_starting, publisher_pid};
use scanhub_shm::{Payload, PortFactory, SharedMemory, WakeSender};
use temp_domain::TempDomain;

#[test]
fn scan_is_written_and_read_in_place() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let topic = Scan::create(&hub, "front", &TOPIC_LIMITS).unwrap();
    let publisher = Scan::publisher(&topic, &TOPIC_LIMITS).unwrap();

    let client = scanhub_shm::client_node(&test_domain.domain).unwrap();
    let topic_of_client = Scan::open(&client, "front").unwrap().expect("the hub made it");
    let subscriber = Scan::subscriber(&hub, &topic_of_client).unwrap();

    let head = ScanHead { count: 2, valid_to: 12, ..ScanHead::default() };
    let mut sample = Scan::loan(&publisher, Scan::len(2, 0)).unwrap();
    *sample.user_header_mut() = Header { seq: 7, topic_seq: 3, ..Header::default() };
    Scan::write(&mut sample).begin(head).ranges.copy_from_slice(&[11, 12]);
    assert_eq!(sample.send().unwrap(), 1);

    let received = Scan::receive(&subscriber).unwrap().expect("one was sent");
    assert_eq!((received.user_header().seq, received.user_header().topic_seq), (7, 3));
    assert_eq!((Scan::read(&received).ranges(), received.payload().len()), (&[11, 12][..], 9));
    assert!(Scan::receive(&subscriber).unwrap().is_none());
    let types = topic_of_client.static_config().message_type_details();
    assert_eq!((types.payload.size(), types.user_header.size()), (8, 64));
    let variant = format!("{:?}", types.payload.variant());
    assert_eq!((types.payload.alignment(), variant.as_str()), (8, "Dynamic"));
    assert_eq!(types.payload.type_name().to_string(), Topic::Scan.payload());
    assert_eq!(types.user_header.type_name().to_string(), "scanhub.Header.v2");
    let revision =
        topic_of_client.attributes().iter().next().map(|it| (it.key().to_string(), it.value().to_string()));
    assert_eq!(revision, Some(("revision".into(), "1".into())));
}

#[test]
fn telegram_has_variable_length() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let topic = <[u8]>::create(&hub, "front", &TOPIC_LIMITS).unwrap();
    let publisher = <[u8]>::publisher(&topic, &TOPIC_LIMITS).unwrap();
    let subscriber = <[u8]>::subscriber(&hub, &topic).unwrap();
    for length in [9, 814] {
        let bytes: Vec<u8> = (0..length).map(|i| i as u8).collect();
        publisher.loan_slice_uninit(length).unwrap().write_from_slice(&bytes).send().unwrap();
        assert_eq!(*<[u8]>::receive(&subscriber).unwrap().expect("one was sent"), *bytes);
    }
    assert!(publisher.loan_slice_uninit(815).is_err());
}

#[test]
fn late_subscriber_gets_the_last_status() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let topic = Status::create(&hub, "front", &TOPIC_LIMITS).unwrap();
    let publisher = Status::publisher(&topic, &TOPIC_LIMITS).unwrap();
    for baud in [9600, 38400] {
        let mut sample = publisher.loan().unwrap();
        sample.payload_mut().baud = baud;
        assert_eq!(sample.send().unwrap(), 0);
    }
    let subscriber = Status::subscriber(&hub, &topic).unwrap();
    scanhub_shm::UpdateConnections::update_connections(&publisher).unwrap();
    assert_eq!(Status::receive(&subscriber).unwrap().expect("history").baud, 38400);
    assert!(Status::receive(&subscriber).unwrap().is_none());
}

#[test]
fn full_queue_drops_the_oldest_without_blocking() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let topic = Scan::create(&hub, "front", &TOPIC_LIMITS).unwrap();
    let publisher = Scan::publisher(&topic, &TOPIC_LIMITS).unwrap();
    let subscriber = Scan::subscriber(&hub, &topic).unwrap();
    for seq in 0..100 {
        let mut sample = Scan::loan(&publisher, 0).unwrap();
        sample.user_header_mut().seq = seq;
        sample.send().unwrap();
    }
    let held: Vec<_> =
        (0..4).map(|_| Scan::receive(&subscriber).unwrap().unwrap().user_header().seq).collect();
    assert_eq!(held, [36, 37, 38, 39]);
}

#[test]
fn second_publisher_is_refused() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let topic = Scan::create(&hub, "front", &TOPIC_LIMITS).unwrap();
    let _first = Scan::publisher(&topic, &TOPIC_LIMITS).unwrap();
    let other = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let again = Scan::create(&other, "front", &TOPIC_LIMITS).unwrap();
    assert_eq!(Scan::publisher(&again, &TOPIC_LIMITS).unwrap_err().kind, Kind::DomainHeld);
}

#[test]
fn topic_limits_match_the_contract() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let scan = Scan::create(&hub, "front", &TOPIC_LIMITS).unwrap();
    let config = scan.static_config();
    assert_eq!((config.max_publishers(), config.max_subscribers(), config.max_nodes()), (1, 32, 260));
    assert_eq!((config.subscriber_max_buffer_size(), config.subscriber_max_borrowed_samples()), (64, 4));
    assert_eq!((config.history_size(), config.has_safe_overflow()), (0, true));
    let status = Status::create(&hub, "front", &TOPIC_LIMITS).unwrap();
    let config = status.static_config();
    assert_eq!((config.subscriber_max_buffer_size(), config.history_size()), (4, 1));
    let waker = WakeSender::new(&hub, "front").unwrap();
    let config = waker.service().static_config();
    assert_eq!((config.max_listeners(), config.max_nodes(), config.event_id_max_value()), (250, 260, 7));
    assert_eq!(limits::sample_count(Topic::Scan, 32), 64 + 128 + 2);
    assert_eq!(
        Topic::ALL.map(limits::queue_len),
        [64, 64, 16, 16, 16, 4, 4, 16, 16, 16, 16, 64, 64, 128, 16]
    );
    for subscribers in [0, 251] {
        assert_eq!(
            TopicLimits { subscribers, ..TOPIC_LIMITS }.check().unwrap_err().kind,
            Kind::Configuration
        );
    }
    let large_limits = TopicLimits { subscribers: 250, ..TOPIC_LIMITS };
    assert_eq!(large_limits.check(), Ok(()));
    let crowded = Scan::create(&hub, "rear", &large_limits).unwrap();
    let publisher = Scan::publisher(&crowded, &large_limits).unwrap();
    let all: Vec<_> = (0..250).map(|_| Scan::subscriber(&hub, &crowded).unwrap()).collect();
    Scan::loan(&publisher, 0).unwrap().send().unwrap();
    assert!(all.iter().all(|subscriber| Scan::receive(subscriber).unwrap().is_some()));
    assert_eq!(Scan::subscriber(&hub, &crowded).unwrap_err().kind, Kind::ResourceExhausted);
}

#[test]
fn surplus_subscriber_is_refused_with_the_key() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let two = TopicLimits { subscribers: 2, ..TOPIC_LIMITS };
    for (sensor, key) in [("front", "limits.subscribers"), ("robot1.front", "--subscribers")] {
        let topic = Scan::create(&hub, sensor, &two).unwrap();
        let first = [Scan::subscriber(&hub, &topic).unwrap(), Scan::subscriber(&hub, &topic).unwrap()];
        let refused = Scan::subscriber(&hub, &topic).unwrap_err();
        assert_eq!(refused.kind, Kind::ResourceExhausted);
        assert!(refused.message.contains("has 2 subscribers") && refused.hint.contains(key), "{refused}");
        drop(first);
        Scan::subscriber(&hub, &topic).unwrap();
    }
}

#[test]
fn topic_kept_alive_by_subscribers_keeps_its_slots() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let kept = Scan::create(&hub, "front", &TopicLimits { subscribers: 2, ..TOPIC_LIMITS }).unwrap();
    for subscribers in [1, 3] {
        let again =
            SharedMemory::<Scan>::new(&hub, "front", &TopicLimits { subscribers, ..TOPIC_LIMITS }).unwrap();
        assert_eq!(again.subscriber_capacity(), 2, "made for {subscribers}");
    }
    drop(kept);
    let new =
        SharedMemory::<Scan>::new(&hub, "front", &TopicLimits { subscribers: 3, ..TOPIC_LIMITS }).unwrap();
    assert_eq!(new.subscriber_capacity(), 3);
}

const TOPIC_LIMITS: TopicLimits =
    TopicLimits { subscribers: 32, beams: 401, contents: ArrayFlags::UPPER, telegram: Telegram::MAX_LEN };

#[test]
fn subscribers_wake_for_every_reason() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let waker = WakeSender::new(&hub, "front").unwrap();
    let client = scanhub_shm::client_node(&test_domain.domain).unwrap();
    let wake_service = scanhub_shm::open_wake(&client, "front").unwrap().expect("the hub made it");
    let listener = scanhub_shm::listener(&client, &wake_service).unwrap();
    let take_event_ids = || {
        let mut ids = Vec::new();
        listener.try_wait(|event| ids.push(event.id.as_value())).unwrap();
        ids
    };
    assert_eq!(take_event_ids(), [0usize; 0], "who comes later was not woken");
    waker.wake(WakeEvent::Telegram).unwrap();
    assert_eq!(take_event_ids(), [WakeEvent::Telegram as usize]);
    drop(waker);
    assert_eq!(take_event_ids(), [WakeEvent::HubDown as usize]);
    let _again = WakeSender::new(&hub, "front").unwrap();
    assert_eq!(take_event_ids(), [WakeEvent::HubUp as usize]);
}

#[test]
fn absent_topics_are_none_and_sensors_are_listed() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    assert!(Scan::open(&hub, "front").unwrap().is_none());
    assert!(scanhub_shm::open_wake(&hub, "front").unwrap().is_none());
    assert!(scanhub_shm::sensors(&test_domain.domain).unwrap().is_empty());
    let _topics = (
        Scan::create(&hub, "rear", &TOPIC_LIMITS).unwrap(),
        Status::create(&hub, "rear", &TOPIC_LIMITS).unwrap(),
    );
    let _other = <[u8]>::create(&hub, "front", &TOPIC_LIMITS).unwrap();
    assert_eq!(scanhub_shm::sensors(&test_domain.domain).unwrap(), ["front", "rear"]);
}

#[test]
fn second_hub_cannot_lock_a_domain() {
    let test_domain = TempDomain::new();
    let root = test_domain.domain.root();
    assert_eq!(hub_pid(root), Ok(None));
    let lock = HubLock::acquire(root).unwrap();
    assert_eq!((hub_pid(root), is_starting(root)), (Ok(Some(std::process::id())), Ok(true)));
    lock.report_ready().unwrap();
    assert_eq!((hub_pid(root), is_starting(root)), (Ok(Some(std::process::id())), Ok(false)));
    let second = HubLock::acquire(root).unwrap_err();
    assert_eq!(second.kind, Kind::DomainHeld);
    assert!(second.message.contains(&format!("pid {}", std::process::id())), "{second}");
    drop(lock);
    assert_eq!((hub_pid(root), is_starting(root)), (Ok(None), Ok(false)));
    let listener = ListenLock::acquire(root).unwrap();
    assert_eq!((hub_pid(root), publisher_pid(root)), (Ok(None), Ok(Some(std::process::id()))));
    assert!(ListenLock::acquire(root).unwrap_err().message.starts_with("another listener holds "));
    let _again = HubLock::acquire(root).unwrap();
    assert_eq!(is_starting(root), Ok(true), "nothing is left of the previous hub");
    drop(listener);
    assert_eq!(publisher_pid(root), Ok(Some(std::process::id())));
}

#[test]
fn topic_half_created_by_a_killed_hub_is_recreated() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let topic = Scan::create(&hub, "front", &TOPIC_LIMITS).unwrap();
    let services = test_domain.domain.root().join("services");
    let description = std::fs::read_dir(&services).unwrap().next().unwrap().unwrap().path();
    let text = std::fs::read(&description).unwrap();
    drop((topic, hub));
    assert!(!description.exists());
    // A service description that was written but is not read-only yet.
    std::fs::write(&description, text).unwrap();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    Scan::create(&hub, "front", &TOPIC_LIMITS).unwrap();
}

#[test]
fn control_request_and_response_wake_their_receivers() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let server = scanhub_shm::ControlServer::create(&hub).unwrap();
    let node = scanhub_shm::client_node(&test_domain.domain).unwrap();
    let client = scanhub_shm::ControlClient::open(&node).unwrap().expect("the hub made it");
    assert!(!scanhub_shm::take_wakeups(&[client.responses()]).unwrap());
    let pending = client.send(&Request::new("front", Verb::Pause)).unwrap();
    scanhub_shm::sleep(&[server.requests()], Duration::from_secs(60)).unwrap();
    let request = server.receive().unwrap().expect("was asked");
    assert_eq!(request.request(), Some(Request::new("front", Verb::Pause)));
    assert!(server.receive().unwrap().is_none() && !scanhub_shm::take_wakeups(&[server.requests()]).unwrap());
    assert!(pending.try_receive().unwrap().is_none() && pending.is_open());
    let refusal = Response(Err(Failure::new(Kind::ResourceExhausted, "busy", "wait")));
    server.respond(request, &refusal).unwrap();
    assert!(scanhub_shm::take_wakeups(&[client.responses()]).unwrap());
    assert_eq!(pending.try_receive().unwrap(), Some(refusal));
}

#[test]
fn exited_clients_with_open_requests_free_their_slots() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    assert!(scanhub_shm::ControlClient::open(&hub).unwrap().is_none());
    let server = scanhub_shm::ControlServer::create(&hub).unwrap();
    for verb in [Verb::Pause, Verb::Resume].repeat(limits::MAX_CONTROL_CLIENTS) {
        let node = scanhub_shm::client_node(&test_domain.domain).unwrap();
        let client = scanhub_shm::ControlClient::open(&node).unwrap().expect("the hub made it");
        let pending = client.send(&Request::new("front", verb)).unwrap();
        if verb == Verb::Pause {
            // The hub receives the request, and the client drops it before the hub responds.
            let request = server.receive().unwrap().expect("was asked");
            drop(pending);
            assert!(!request.is_client_waiting());
            server.respond(request, &Response(Ok(None))).unwrap();
        } else {
            drop((pending, client));
            assert!(server.receive().unwrap().is_none());
        }
    }
}

#[test]
fn library_version_matches_the_manifest() {
    let manifest = include_str!("../../../Cargo.toml");
    let pinned = manifest.lines().find_map(|line| line.strip_prefix("iceoryx2 = { version = \"="));
    let version = pinned.and_then(|rest| rest.split('"').next()).expect("it is pinned");
    assert_eq!(scanhub_shm::LIBRARY_VERSION, format!("iceoryx2 {version}"));
}

#[test]
fn topic_with_another_layout_is_incompatible() {
    let test_domain = TempDomain::new();
    let hub = scanhub_shm::hub_node(&test_domain.domain).unwrap();
    let service = Topic::Scan.service("front").as_str().try_into().unwrap();
    let _other = hub.service_builder(&service).publish_subscribe::<u64>().create().unwrap();
    let failure = Scan::open(&hub, "front").expect_err("its samples are numbers");
    assert_eq!(failure.kind, Kind::Incompatible, "{failure}");
    assert!(failure.message.ends_with("the hub uses another layout"), "{failure}");
}
