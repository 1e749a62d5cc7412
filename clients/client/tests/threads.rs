//! Tests that use subscribers, samples and publications in other threads than the one that created them.

mod fake;

use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use fake::{FakeHub, TestDomain, wait_until};
use scanhub_client::{
    Marks, Publication, PublishSession, Received, RobotSubscriber, Scan, SensorPublisher, Subscriber,
    Telegram, ZonesSubscriber, streams,
};
use scanhub_schema::limits::MAX_BORROWED_SAMPLES;
use scanhub_shm::{LocalService, Payload, Role, Service, ThreadSafeService};

/// Timeout that only a hang exceeds, even on a busy machine.
const WAIT_TIMEOUT: Duration = Duration::from_secs(60);

fn is_send<T: Send>() {}

#[test]
fn all_public_types_are_send() {
    is_send::<Subscriber<Scan>>();
    is_send::<Subscriber<Telegram>>();
    is_send::<Received<Scan>>();
    is_send::<Publication<Marks>>();
    is_send::<PublishSession>();
    is_send::<SensorPublisher>();
    is_send::<ZonesSubscriber>();
    is_send::<RobotSubscriber>();
    is_send::<streams::Session>();
    is_send::<streams::Source>();
}

/// Attaches to the scans of `front` with ports of kind `S`.
fn attach<S: Service>(test_domain: &TestDomain) -> (scanhub_shm::Node<S>, scanhub_shm::Subscriber<Scan, S>) {
    let node = scanhub_shm::join::<S>(&test_domain.domain, Role::Subscriber).unwrap();
    let topic = Scan::open(&node, "front").unwrap().expect("the hub made it");
    let subscriber = Scan::subscriber(&node, &topic).unwrap();
    (node, subscriber)
}

#[test]
fn local_and_thread_safe_services_attach_to_a_hub() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let local = attach::<LocalService>(&test_domain);
    let shared = attach::<ThreadSafeService>(&test_domain);
    assert_eq!(hub.front_sensor().scan.subscribers(), 2);
    for beams in 1..=3 {
        hub.front_sensor().publish_scan(&vec![1000; beams]);
        let of_local = Scan::receive(&local.1).unwrap().expect("one was sent");
        let of_shared = Scan::receive(&shared.1).unwrap().expect("one was sent");
        for beams_received in [Scan::read(&of_local).beams(), Scan::read(&of_shared).beams()] {
            assert_eq!(beams_received, beams);
        }
    }
    drop((local, shared));
    wait_until("no subscribers", || hub.front_sensor().scan.subscribers() == 0);
}

#[test]
fn subscriber_and_its_samples_move_between_threads() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut scans = Subscriber::<Scan>::builder("front")
        .in_domain(&test_domain.domain)
        .timeout(WAIT_TIMEOUT)
        .open()
        .unwrap();
    assert!(scans.try_next().unwrap().is_none());
    let (give, take) = mpsc::channel();
    let thread = thread::spawn(move || {
        for _ in 0..3 * MAX_BORROWED_SAMPLES {
            let Some(scan) = scans.next().unwrap() else { panic!("no scan") };
            give.send(scan).unwrap();
        }
        scans
    });
    for beams in 1..=3 * MAX_BORROWED_SAMPLES {
        hub.front_sensor().publish_scan(&vec![1000; beams]);
        // The sample is dropped in this thread, which frees its slot for the other thread.
        let scan = take.recv_timeout(WAIT_TIMEOUT).expect("a scan");
        assert_eq!((scan.beams(), scan.missed), (beams, 0));
    }
    let mut scans = thread.join().unwrap();
    hub.front_sensor().publish_scan(&[7]);
    assert_eq!(scans.next().unwrap().expect("a scan").beams(), 1);
}

#[test]
fn publication_moves_to_another_thread() {
    let test_domain = TestDomain::new();
    let mut near = Publication::<Marks>::in_domain(&test_domain.domain, "tracker.near").unwrap();
    let mut marks = Subscriber::<Marks>::builder("tracker.near")
        .in_domain(&test_domain.domain)
        .timeout(WAIT_TIMEOUT)
        .open()
        .unwrap();
    wait_until("the subscriber", || marks.try_next().unwrap().is_none() && near.subscribers() == 1);
    let near = thread::spawn(move || {
        near.send(|sample| *sample = Marks::default()).unwrap();
        near
    });
    let near = near.join().unwrap();
    assert_eq!(marks.next().unwrap().expect("one was sent").header().topic_seq, 0);
    assert_eq!(near.next_number(), 1);
}
