//! Test that links in virtual time publish the same as links of real lines: every telegram, its scan, and the stamps of
//! the virtual clock. No thread sleeps.

#[path = "../../../tests/testkit/virtual_hub.rs"]
mod virtual_hub;

use std::fmt;
use std::fs;
use std::sync::{Arc, Mutex};

use scanhub_config::{Config, Sources};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::Unit;
use scanhub_schema::{Family, Marks, Scan, State, Status};
use scanhub_shm::Domain;
use scanhub_shm::Payload;
use tracing::field::{Field, Visit};
use tracing::span;
use tracing::{Event, Metadata, Subscriber};
use virtual_hub::virtual_hub;

/// Domain that is removed at the end of the test, even after a failure.
struct TestDomain(Domain);

impl TestDomain {
    fn new(letter: char) -> TestDomain {
        let name = format!("{letter}{}", std::process::id());
        TestDomain(Domain::at(&name, format!("/tmp/test-memory-{name}").as_ref()).expect("a domain"))
    }
}

impl Drop for TestDomain {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(self.0.root());
        for entry in fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.0.prefix()) {
                let _ = fs::remove_file(entry.path());
            }
        }
    }
}

fn two_links() -> Config {
    let owned = |flags: &[&str]| flags.iter().map(|flag| (*flag).to_owned()).collect();
    let sources = Sources {
        links: owned(&["a=file:nothing", "b=file:nothing"]),
        set: owned(&["link.a.mode=1", "link.b.mode=1"]),
        ..Sources::default()
    };
    Config::load(&sources).expect("a configuration")
}

#[test]
fn samples_have_stamps_in_virtual_time() {
    let test_domain = TestDomain::new('m');
    let received = virtual_hub(&two_links(), &test_domain.0, |links| {
        let node = scanhub_shm::client_node(&test_domain.0).expect("a node");
        let service = Scan::open(&node, "b").expect("a topic").expect("is there");
        let subscriber = Scan::subscriber(&node, &service).expect("a subscriber");
        let mut received = Vec::new();
        for number in 1..=3_u64 {
            let words = [100 * number as u16; 361];
            let telegram = lms::measured::encode(0, Unit::Mm, &words, 0x10);
            let (begin, end) = telegram.bytes().split_at(400);
            let at = number * 26_640_000;
            assert_eq!((links[1].read(at - 9_000_000, begin), links[1].read(at, end)), (0, 1));
            assert_eq!(links[0].read(at, &[0x55; 5]), 0);
            while let Ok(Some(scan)) = Scan::receive(&subscriber) {
                let header = scan.user_header();
                received.push((
                    header.sensor,
                    header.seq,
                    header.stamp_last_ns,
                    Scan::read(&scan).ranges()[360],
                ));
            }
        }
        received
    });
    let expected = |number: u64| (1, number - 1, number * 26_640_000, 100 * number as u16);
    assert_eq!(received, Ok([1, 2, 3].map(expected).to_vec()));
}

#[test]
fn marks_need_a_subscriber_and_status_is_streaming() {
    let test_domain = TestDomain::new('n');
    let outcome = virtual_hub(&two_links(), &test_domain.0, |links| {
        let node = scanhub_shm::client_node(&test_domain.0).expect("a node");
        let telegram = lms::measured::encode(0, Unit::Mm, &[500; 361], 0x10);
        assert_eq!(links[0].read(1, telegram.bytes()), 1);
        let marks = Marks::open(&node, "a").expect("a topic").expect("is there");
        let marks = Marks::subscriber(&node, &marks).expect("a subscriber");
        assert!(matches!(Marks::receive(&marks), Ok(None)), "it came too late");
        assert_eq!(links[0].read(2, telegram.bytes()), 1);
        let Ok(Some(sample)) = Marks::receive(&marks) else { panic!("no marks") };
        assert_eq!((sample.user_header().seq, sample.user_header().topic_seq), (1, 1));
        let status = Status::open(&node, "a").expect("a topic").expect("is there");
        let status = Status::subscriber(&node, &status).expect("a subscriber");
        // Without other changes, the status is published every second.
        for second in 1..=3 {
            links[0].read(second * 1_000_000_000, telegram.bytes());
        }
        let Ok(Some(status)) = Status::receive(&status) else { panic!("no status") };
        assert_eq!(status.state(), Some(State::Streaming));
    });
    assert_eq!(outcome, Ok(()));
}

/// Collector of log messages.
#[derive(Clone, Default)]
struct LogCollector(Arc<Mutex<Vec<String>>>);

impl Subscriber for LogCollector {
    fn enabled(&self, _: &Metadata<'_>) -> bool {
        true
    }

    fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
        span::Id::from_u64(1)
    }

    fn record(&self, _: &span::Id, _: &span::Record<'_>) {}

    fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}

    fn event(&self, event: &Event<'_>) {
        struct Message(String);
        impl Visit for Message {
            fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
                if field.name() == "message" {
                    self.0 = format!("{value:?}");
                }
            }
        }
        let mut message = Message(String::new());
        event.record(&mut message);
        self.0.lock().expect("not poisoned").push(message.0);
    }

    fn enter(&self, _: &span::Id) {}

    fn exit(&self, _: &span::Id) {}
}

#[test]
fn finds_unannounced_subscriber_within_154_ms() {
    let test_domain = TestDomain::new('f');
    let outcome = virtual_hub(&two_links(), &test_domain.0, |links| {
        let node = scanhub_shm::client_node(&test_domain.0).expect("a node");
        let telegram = lms::measured::encode(0, Unit::Mm, &[500; 361], 0x10);
        assert_eq!(links[0].read(1, telegram.bytes()), 1);
        let scans = Scan::open(&node, "a").expect("a topic").expect("is there");
        let foreign = scans.subscriber_builder().create().expect("a subscriber");
        let mut found_after = None;
        for number in 1..=40_u64 {
            assert_eq!(links[0].read(1 + number * 26_640_000, telegram.bytes()), 1);
            if let Ok(Some(_)) = Scan::receive(&foreign) {
                found_after = found_after.or(Some(number * 26_640_000));
            }
        }
        found_after
    });
    let found_after = outcome.expect("it runs").expect("it was found");
    // The limit is the sum of three times: 100 ms, the telegram after which the hub checks for subscribers, and the
    // next telegram.
    assert!((26_640_001..154_000_000).contains(&found_after), "found after {found_after} ns");
}

#[test]
fn rejected_rate_is_logged_once_and_scanner_is_found() {
    let test_domain = TestDomain::new('r');
    let sources = Sources { links: vec!["a=/dev/none,family=auto".to_owned()], ..Sources::default() };
    let config = Config::load(&sources).expect("a configuration");
    let log = LogCollector::default();
    let outcome = tracing::subscriber::with_default(log.clone(), || {
        virtual_hub(&config, &test_domain.0, |links| {
            let node = scanhub_shm::client_node(&test_domain.0).expect("a node");
            let status = Status::open(&node, "a").expect("a topic").expect("is there");
            let status = Status::subscriber(&node, &status).expect("a subscriber");
            links[0].reject(&[500_000, 921_600, 256_000]);
            // For several rounds of the search, bytes arrive that no scanner sends.
            for read in 1..=200 {
                links[0].read(read * 50_000_000, &[0x55; 5]);
            }
            let telegram = lms::measured::encode(0, Unit::Mm, &[500; 361], 0x10);
            let found = (201..=400).find(|read| {
                links[0].read(read * 50_000_000, telegram.bytes());
                let mut family = None;
                while let Ok(Some(status)) = Status::receive(&status) {
                    family = status.family();
                }
                family == Some(Family::Lms)
            });
            found.expect("the scanner is found");
        })
    });
    assert_eq!(outcome, Ok(()));
    let lines = log.0.lock().expect("not poisoned");
    for rate in [500_000, 921_600, 256_000] {
        let message = format!("a: the port cannot have {rate} baud");
        assert_eq!(lines.iter().filter(|line| **line == message).count(), 1, "{lines:?}");
    }
}
