//! Waits until samples of any followed sensor arrive: on doorbells in shared memory, on events, or by spinning.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use scanhub_schema::{Failure, Ring, Topic};
use scanhub_shm::{Bell, ThreadSafeService, Unsupported};

use crate::clock;

type Node = scanhub_shm::Node<ThreadSafeService>;
type Listener = scanhub_shm::Listener<ThreadSafeService>;

/// Method by which a subscriber waits for samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Wait {
    /// Sleep on a word in shared memory; one call of the hub wakes all. If the system cannot wait for the words of
    /// several sensors at once, it uses the event.
    #[default]
    Doorbell,
    /// Sleep on the event, which other languages use; the hub sends one message to each subscriber.
    Event,
    /// Do not sleep: read the words all the time. It has the shortest latency, and uses one CPU core completely.
    Spin,
}

/// Doorbells or events of the sensors that a subscriber follows.
pub(crate) struct Wakeups {
    wait: Wait,
    sensors: Vec<Sensor>,
    /// Whether a bell was rung since the last [`Wakeups::take_rang`].
    rang: bool,
    /// Whether wake-ups by event were taken since the last sleep, so that the caller has looked for samples.
    taken: bool,
}

struct Sensor {
    name: String,
    bell: Option<Bell>,
    /// For each ring of a followed topic, the count of the bell when the caller last looked for samples.
    rung: [Option<u32>; Ring::ALL.len()],
    listener: Option<Listener>,
}

impl Wakeups {
    pub(crate) fn by(wait: Wait) -> Wakeups {
        Wakeups { wait, sensors: Vec::new(), rang: false, taken: false }
    }

    /// Adds `topic` of the sensor `name`. Returns whether its bell or event exists already. Fails with
    /// [`Kind::Short`](scanhub_schema::Kind) if memory, descriptors or places for subscribers are short.
    pub(crate) fn add(&mut self, node: &Node, name: &str, topic: Topic) -> Result<bool, Failure> {
        let ring = topic.row().ring;
        if let Some(known) = self.sensors.iter_mut().find(|sensor| sensor.name == name) {
            known.hear(ring);
            return Ok(true);
        }
        let mut sensor =
            Sensor { name: name.to_owned(), bell: None, rung: Default::default(), listener: None };
        sensor.hear(ring);
        let is_there = match self.wait {
            Wait::Event => sensor.listen(node)?,
            Wait::Doorbell | Wait::Spin => sensor.go_to_bell(node)?,
        };
        if is_there {
            self.sensors.push(sensor);
        }
        Ok(is_there)
    }

    /// Forgets the bells, because a hub has started or ended: the next hub has other bells.
    pub(crate) fn renew(&mut self) {
        self.sensors.iter_mut().for_each(|sensor| sensor.bell = None);
    }

    /// Sleeps until a bell or event wakes it, a signal arrives or the time `left` has passed. Returns at once if this
    /// has happened since the caller looked for samples. Fails with [`Kind::Short`](scanhub_schema::Kind) if the system
    /// cannot wait.
    pub(crate) fn wait(&mut self, node: &Node, left: Duration) -> Result<(), Failure> {
        if self.wait == Wait::Event {
            return self.wait_for_event(node, left);
        }
        for sensor in &mut self.sensors {
            // Without a bell, the subscriber continues with a short sleep each time, until there is one.
            let _ = sensor.go_to_bell(node);
        }
        if self.heard() {
            return Ok(());
        }
        let bells: Vec<_> = self.sensors.iter().flat_map(Sensor::bells).collect();
        let until_ns = clock::now_ns().saturating_add(left.as_nanos() as u64);
        let slept = match self.wait {
            _ if bells.is_empty() => {
                std::thread::sleep(left.min(WITHOUT_BELL));
                Ok(())
            }
            Wait::Spin => {
                spin(&bells, until_ns);
                Ok(())
            }
            _ => scanhub_shm::sleep_at_bells(&bells, until_ns),
        };
        match slept {
            Ok(()) => {
                self.heard();
                Ok(())
            }
            Err(Unsupported) => self.turn_to_events(node),
        }
    }

    /// Returns whether a bell was rung since the last call. If so, the hub is alive.
    pub(crate) fn take_rang(&mut self) -> bool {
        std::mem::take(&mut self.rang)
    }

    /// Returns how often the bell of the sensor `name` was rung for `topic`. `None` if this does not show whether a
    /// sample was sent.
    pub(crate) fn rung(&self, name: &str, topic: Topic) -> Option<u32> {
        let sensor = self.sensors.iter().find(|sensor| sensor.name == name)?;
        let bell = sensor.bell.as_ref().filter(|bell| !bell.is_closed())?;
        Some(bell.rung(topic.row().ring))
    }

    /// Returns whether a bell was rung since the last call. Samples that were sent before can be received now.
    fn heard(&mut self) -> bool {
        let mut any = false;
        for Sensor { bell, rung, .. } in &mut self.sensors {
            let Some(bell) = bell else { continue };
            for (ring, seen) in Ring::ALL.into_iter().zip(rung) {
                let Some(seen) = seen else { continue };
                let rung = bell.rung(ring);
                any |= std::mem::replace(seen, rung) != rung;
            }
        }
        self.rang |= any;
        any
    }

    fn wait_for_event(&mut self, node: &Node, left: Duration) -> Result<(), Failure> {
        let mut is_new = false;
        for sensor in self.sensors.iter_mut().filter(|sensor| sensor.listener.is_none()) {
            // Its hub was still creating it, or there was no room.
            is_new |= sensor.listen(node).unwrap_or(false);
        }
        if is_new {
            return Ok(());
        }
        let listeners: Vec<&Listener> =
            self.sensors.iter().filter_map(|sensor| sensor.listener.as_ref()).collect();
        if !self.taken && scanhub_shm::take_wakeups(&listeners)? {
            self.taken = true;
            return Ok(());
        }
        self.taken = false;
        scanhub_shm::sleep(&listeners, left)
    }

    /// Returns the descriptors that are readable while events are pending, one of each sensor with an event.
    pub(crate) fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.sensors.iter().filter_map(|sensor| sensor.listener.as_ref()).map(scanhub_shm::descriptor)
    }

    /// Takes the pending events. Returns whether there were any; then the caller must look for samples. Fails with
    /// [`Kind::Short`](scanhub_schema::Kind) if an event does not work.
    pub(crate) fn take(&mut self) -> Result<bool, Failure> {
        let mut any = false;
        for listener in self.sensors.iter().filter_map(|sensor| sensor.listener.as_ref()) {
            any |= scanhub_shm::take_wakeups(&[listener])?;
        }
        Ok(any)
    }

    /// Uses events from now on. Returns without a wait, because samples may have arrived before the listeners existed.
    fn turn_to_events(&mut self, node: &Node) -> Result<(), Failure> {
        self.wait = Wait::Event;
        for sensor in &mut self.sensors {
            sensor.bell = None;
            sensor.listen(node)?;
        }
        Ok(())
    }
}

impl Sensor {
    /// Opens the event. Returns whether it exists.
    fn listen(&mut self, node: &Node) -> Result<bool, Failure> {
        let Some(service) = scanhub_shm::open_wake(node, &self.name)? else { return Ok(false) };
        self.listener = Some(scanhub_shm::listener(node, &service)?);
        Ok(true)
    }

    /// Opens the bell, unless it is open. Closes the bell of a hub that has ended. Returns whether there is one.
    fn go_to_bell(&mut self, node: &Node) -> Result<bool, Failure> {
        if self.bell.as_ref().is_none_or(Bell::is_closed) {
            self.bell = Bell::open(node, &self.name)?.filter(|bell| !bell.is_closed());
            // A new bell has a count of its own, and samples may have been sent before.
            for ring in Ring::ALL {
                self.rung[ring as usize] = self.rung[ring as usize].map(|_| self.not_yet(ring));
            }
        }
        Ok(self.bell.is_some())
    }

    /// Waits for `ring` too. Samples may have been sent before.
    fn hear(&mut self, ring: Ring) {
        if self.rung[ring as usize].is_none() {
            self.rung[ring as usize] = Some(self.not_yet(ring));
        }
    }

    /// Returns a count that the bell does not have now.
    fn not_yet(&self, ring: Ring) -> u32 {
        self.bell.as_ref().map_or(0, |bell| bell.rung(ring).wrapping_sub(1))
    }

    fn bells(&self) -> impl Iterator<Item = (&Bell, Ring, u32)> {
        let heard = Ring::ALL.into_iter().zip(self.rung).filter_map(|(ring, rung)| Some((ring, rung?)));
        self.bell.iter().flat_map(move |bell| heard.clone().map(move |(ring, rung)| (bell, ring, rung)))
    }
}

fn spin(bells: &[(&Bell, Ring, u32)], until_ns: u64) {
    while clock::now_ns() < until_ns {
        for _ in 0..LOOKS {
            if bells.iter().any(|(bell, ring, rung)| bell.rung(*ring) != *rung) {
                return;
            }
            std::hint::spin_loop();
        }
    }
}

/// Number of polls between two readings of the clock.
const LOOKS: u32 = 100;

/// Maximum sleep while there is no bell, between the end of a hub and the start of the next one.
const WITHOUT_BELL: Duration = Duration::from_millis(20);

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::Wake;
    use scanhub_shm::{Domain, Role, Waker};
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

    /// Returns whether a wait ended before its timeout, so that a bell or event has woken it.
    fn woken(started: Instant) -> bool {
        started.elapsed() < LONG
    }

    /// Starts the publishing side of a hub in a separate thread, because its ports cannot move. It wakes the
    /// subscribers once for each message.
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
        let node = scanhub_shm::join(&place.1, Role::Subscriber).unwrap();
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
        let node = scanhub_shm::join(&place.1, Role::Subscriber).unwrap();
        assert!(!wakeups.add(&node, "left", Topic::Zones).unwrap(), "there is no such sensor");
        for (at, sensor) in ["front", "rear"].into_iter().enumerate() {
            topics.iter().for_each(|&topic| assert!(wakeups.add(&node, sensor, topic).unwrap()));
            for hub in &hubs[..=at] {
                // Wake-ups from before the listener existed may occur once more.
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
        let node = scanhub_shm::join(&place.1, Role::Subscriber).unwrap();
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
        let node = scanhub_shm::join(&place.1, Role::Subscriber).unwrap();
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
        let node = scanhub_shm::join(&place.1, Role::Subscriber).unwrap();
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
        let node = scanhub_shm::join(&place.1, Role::Subscriber).unwrap();
        let waker = Waker::new(&hub, "front").unwrap();
        let mut wakeups = Wakeups::by(Wait::Doorbell);
        assert!(wakeups.add(&node, "front", Topic::Zones).unwrap());
        wakeups.turn_to_events(&node).unwrap();
        let started = Instant::now();
        waker.wake(Wake::Telegram).unwrap();
        wakeups.wait(&node, LONG).unwrap();
        assert!(woken(started) && wakeups.wait == Wait::Event);
    }
}
