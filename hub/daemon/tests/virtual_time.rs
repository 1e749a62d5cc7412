//! Links that are driven in made-up time publish what those of lines do: every telegram, its scan, the moments that were
//! told. Nobody sleeps here.

#[path = "../../../tests/testkit/virtual_hub.rs"]
mod virtual_hub;

use std::fs;

use config::{Config, Sources};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::Unit;
use schema::ipc::{self, Payload};
use schema::{Domain, Marks, Scan, State, Status};
use virtual_hub::virtual_hub;

/// A domain that goes with the test, however it ends.
struct Place(Domain);

impl Place {
    fn new(letter: char) -> Place {
        let name = format!("{letter}{}", std::process::id());
        Place(Domain::at(&name, format!("/tmp/test-memory-{name}").as_ref()).expect("a domain"))
    }
}

impl Drop for Place {
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
fn bytes_with_times_become_samples_with_stamps() {
    let place = Place::new('m');
    let received = virtual_hub(&two_links(), &place.0, |links| {
        let node = ipc::client_node(&place.0).expect("a node");
        let service = Scan::open(&node, "b").expect("a topic").expect("is there");
        let subscriber = Scan::subscriber(&service).expect("a subscriber");
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
    let told = |number: u64| (1, number - 1, number * 26_640_000, 100 * number as u16);
    assert_eq!(received, Ok([1, 2, 3].map(told).to_vec()));
}

#[test]
fn what_nobody_follows_is_not_made_and_a_status_tells_that_it_streams() {
    let place = Place::new('n');
    let outcome = virtual_hub(&two_links(), &place.0, |links| {
        let node = ipc::client_node(&place.0).expect("a node");
        let telegram = lms::measured::encode(0, Unit::Mm, &[500; 361], 0x10);
        assert_eq!(links[0].read(1, telegram.bytes()), 1);
        let marks = Marks::open(&node, "a").expect("a topic").expect("is there");
        let marks = Marks::subscriber(&marks).expect("a subscriber");
        assert!(matches!(Marks::receive(&marks), Ok(None)), "it came too late");
        assert_eq!(links[0].read(2, telegram.bytes()), 1);
        let Ok(Some(sample)) = Marks::receive(&marks) else { panic!("no marks") };
        assert_eq!((sample.user_header().seq, sample.user_header().topic_seq), (1, 1));
        let status = Status::open(&node, "a").expect("a topic").expect("is there");
        let status = Status::subscriber(&status).expect("a subscriber");
        // A status goes out each second while nobody has anything to tell.
        for second in 1..=3 {
            links[0].read(second * 1_000_000_000, telegram.bytes());
        }
        let Ok(Some(status)) = Status::receive(&status) else { panic!("no status") };
        assert_eq!(status.state(), Some(State::Streaming));
    });
    assert_eq!(outcome, Ok(()));
}
