//! Wakers and sleepers in domains of their own.

use super::*;
use scanhub_schema::Wake;
use scanhub_shm::Domain;
use scanhub_shm::Waker;
use std::path::PathBuf;
use std::sync::mpsc;
use std::thread;
use std::time::Instant;

/// A domain that goes with the test.
struct Place(PathBuf, Domain);

impl Place {
    fn new(name: &str) -> Place {
        let name = format!("w{}-{name}", std::process::id());
        let base = PathBuf::from(format!("/tmp/sh{name}"));
        Place(base.clone(), Domain::at(&name, &base).unwrap())
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.1.prefix()) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

/// Far longer than any wait here may last.
const LONG: Duration = Duration::from_secs(60);

/// Waits that are over before this time were woken.
fn woken(started: Instant) -> bool {
    started.elapsed() < LONG
}

/// A hub's end in a thread of its own, where its ports have to stay; wakes each time it is told.
fn hub(domain: &Domain, sensor: &'static str) -> mpsc::Sender<()> {
    let (tell, told) = mpsc::channel();
    let (say, said) = mpsc::channel();
    let node = scanhub_shm::hub_node(domain).unwrap();
    thread::spawn(move || {
        let waker = Waker::new(&node, sensor).unwrap();
        say.send(()).unwrap();
        while let Ok(()) = told.recv() {
            waker.wake(Wake::Telegram).unwrap();
        }
    });
    said.recv().unwrap();
    tell
}

const FOLLOWED: [&[Topic]; 3] = [&[Topic::Zones], &[Topic::Marks], &[Topic::Status, Topic::Scan]];

#[test]
fn each_topic_is_told_by_its_ring() {
    let place = Place::new("rings");
    let hub = scanhub_shm::hub_node(&place.1).unwrap();
    let node = scanhub_shm::client_node(&place.1).unwrap();
    let waker = Waker::new(&hub, "front").unwrap();
    for (topics, told) in
        FOLLOWED.into_iter().zip([&[Ring::First][..], &[Ring::Last], &[Ring::First, Ring::Last]])
    {
        let mut wakeups = Wakeups::by(Wait::Doorbell);
        topics.iter().for_each(|&topic| assert!(wakeups.add(&node, "front", topic).unwrap()));
        assert!(wakeups.heard(), "samples may have been sent before");
        for ring in Ring::ALL {
            let before = topics.iter().map(|&topic| wakeups.rung("front", topic)).collect::<Vec<_>>();
            waker.ring(ring);
            let after = topics.iter().map(|&topic| wakeups.rung("front", topic)).collect::<Vec<_>>();
            let is_told = told.contains(&ring);
            assert_eq!((wakeups.heard(), before != after), (is_told, is_told), "{topics:?} {ring:?}");
            assert!(!wakeups.heard());
        }
    }
    let mut wakeups = Wakeups::by(Wait::Doorbell);
    for topic in [Topic::Zones, Topic::Marks] {
        assert!(wakeups.add(&node, "front", topic).unwrap());
        assert!(wakeups.heard() && !wakeups.heard(), "another topic has samples that wait");
    }
}

#[test]
fn each_way_wakes_for_every_sensor() {
    for (wait, name) in [(Wait::Doorbell, "bell"), (Wait::Event, "event"), (Wait::Spin, "spin")] {
        FOLLOWED.into_iter().for_each(|topics| wakes_for_every_sensor(wait, name, topics));
    }
}

fn wakes_for_every_sensor(wait: Wait, name: &str, topics: &[Topic]) {
    let place = Place::new(name);
    let mut wakeups = Wakeups::by(wait);
    let hubs = ["front", "rear"].map(|sensor| hub(&place.1, sensor));
    let node = scanhub_shm::client_node(&place.1).unwrap();
    assert!(!wakeups.add(&node, "left", Topic::Zones).unwrap(), "there is no such sensor");
    for (at, sensor) in ["front", "rear"].into_iter().enumerate() {
        topics.iter().for_each(|&topic| assert!(wakeups.add(&node, sensor, topic).unwrap()));
        for hub in &hubs[..=at] {
            // What came before it was listened to may be told once more.
            wakeups.wait(&node, Duration::ZERO).unwrap();
            wakeups.wait(&node, Duration::ZERO).unwrap();
            let started = Instant::now();
            hub.send(()).unwrap();
            wakeups.wait(&node, LONG).unwrap();
            assert!(woken(started), "{wait:?}");
        }
    }
}

#[test]
fn the_bell_of_a_hub_that_ended_is_exchanged() {
    let place = Place::new("ended");
    let hub = scanhub_shm::hub_node(&place.1).unwrap();
    let node = scanhub_shm::client_node(&place.1).unwrap();
    let mut wakeups = Wakeups::by(Wait::Doorbell);
    let first = Waker::new(&hub, "front").unwrap();
    assert!(wakeups.add(&node, "front", Topic::Zones).unwrap());
    wakeups.wait(&node, Duration::ZERO).unwrap();
    let started = Instant::now();
    drop(first);
    wakeups.wait(&node, LONG).unwrap();
    assert!(wakeups.sensors[0].bell.is_none(), "nobody rings it any more");
    wakeups.wait(&node, Duration::ZERO).unwrap();
    let second = Waker::new(&hub, "front").unwrap();
    wakeups.wait(&node, LONG).unwrap();
    second.wake(Wake::Telegram).unwrap();
    wakeups.wait(&node, LONG).unwrap();
    assert!(woken(started));
    assert!(wakeups.sensors[0].bell.as_ref().is_some_and(|bell| !bell.is_closed()));
}

#[test]
fn a_bell_that_somebody_removed_while_there_was_no_hub_is_exchanged() {
    let place = Place::new("removed");
    let hub = scanhub_shm::hub_node(&place.1).unwrap();
    let node = scanhub_shm::client_node(&place.1).unwrap();
    let mut wakeups = Wakeups::by(Wait::Doorbell);
    // A hub that is killed closes nothing.
    std::mem::forget(Waker::new(&hub, "front").unwrap());
    assert!(wakeups.add(&node, "front", Topic::Zones).unwrap());
    for entry in std::fs::read_dir("/dev/shm").unwrap().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with(&place.1.prefix()) && name.ends_with(".bell") {
            std::fs::remove_file(entry.path()).unwrap();
        }
    }
    let next = Waker::new(&hub, "front").unwrap();
    wakeups.renew();
    wakeups.wait(&node, Duration::ZERO).unwrap();
    let before = wakeups.rung("front", Topic::Zones).expect("it has a bell");
    next.wake(Wake::Telegram).unwrap();
    assert_eq!(wakeups.rung("front", Topic::Zones), Some(before + 1));
}

#[test]
fn an_event_that_is_made_later_is_listened_to() {
    let place = Place::new("later");
    let hub = scanhub_shm::hub_node(&place.1).unwrap();
    let node = scanhub_shm::client_node(&place.1).unwrap();
    let mut wakeups = Wakeups::by(Wait::Doorbell);
    let first = Waker::new(&hub, "front").unwrap();
    assert!(wakeups.add(&node, "front", Topic::Zones).unwrap());
    drop(first);
    wakeups.turn_to_events(&node).unwrap();
    assert!(wakeups.sensors[0].listener.is_none());
    let waker = Waker::new(&hub, "front").unwrap();
    wakeups.wait(&node, LONG).unwrap();
    let started = Instant::now();
    waker.wake(Wake::Telegram).unwrap();
    wakeups.wait(&node, LONG).unwrap();
    assert!(woken(started) && wakeups.sensors[0].listener.is_some());
}

#[test]
fn where_words_cannot_be_waited_for_the_event_wakes() {
    let place = Place::new("turn");
    let hub = scanhub_shm::hub_node(&place.1).unwrap();
    let node = scanhub_shm::client_node(&place.1).unwrap();
    let waker = Waker::new(&hub, "front").unwrap();
    let mut wakeups = Wakeups::by(Wait::Doorbell);
    assert!(wakeups.add(&node, "front", Topic::Zones).unwrap());
    wakeups.turn_to_events(&node).unwrap();
    let started = Instant::now();
    waker.wake(Wake::Telegram).unwrap();
    wakeups.wait(&node, LONG).unwrap();
    assert!(woken(started) && wakeups.wait == Wait::Event);
}
