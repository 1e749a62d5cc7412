//! Wait for samples of several sensors: on doorbells in shared memory, on events, or by spinning.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use scanhub_schema::{DoorbellWord, Failure, Topic};
use scanhub_shm::{Doorbell, ThreadSafeService, WaitUnsupported};

use crate::clock;

type Node = scanhub_shm::Node<ThreadSafeService>;
type Listener = scanhub_shm::Listener<ThreadSafeService>;

/// Method by which a subscriber waits for samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Wait {
    /// Sleep on a word in shared memory. One call of the hub wakes all subscribers. If the system cannot wait for the
    /// words of several sensors at once, the subscriber uses the event.
    #[default]
    Doorbell,
    /// Sleep on the event, as subscribers in other languages do. The hub sends one message to each subscriber.
    Event,
    /// Do not sleep, and read the words continuously. This method has the shortest latency, and uses one CPU core
    /// completely.
    Spin,
}

/// Doorbells or events of a subscriber's sensors.
pub(crate) struct Wakeups {
    wait: Wait,
    sensors: Vec<Sensor>,
    /// Whether a doorbell was rung since the last [`Wakeups::take_activity`].
    has_activity: bool,
    /// Whether wake-ups by event were taken since the last sleep. The caller has then received samples, so the next
    /// wait may sleep.
    taken: bool,
}

struct Sensor {
    name: String,
    doorbell: Option<Doorbell>,
    /// For each doorbell word at which the subscriber waits, its count when the caller last received samples.
    ring_counts: [Option<u32>; DoorbellWord::ALL.len()],
    listener: Option<Listener>,
}

impl Wakeups {
    pub(crate) fn waiting_by(wait: Wait) -> Wakeups {
        Wakeups { wait, sensors: Vec::new(), has_activity: false, taken: false }
    }

    /// Adds `topic` of the sensor `name`. Returns whether the sensor's doorbell or event already exists. Fails with
    /// [`Kind::ResourceExhausted`](scanhub_schema::Kind) if memory, descriptors or slots for subscribers are short.
    pub(crate) fn add(&mut self, node: &Node, name: &str, topic: Topic) -> Result<bool, Failure> {
        let ring = topic.spec().doorbell_word;
        if let Some(known) = self.sensors.iter_mut().find(|sensor| sensor.name == name) {
            known.watch_word(ring);
            return Ok(true);
        }
        let mut sensor =
            Sensor { name: name.to_owned(), doorbell: None, ring_counts: Default::default(), listener: None };
        sensor.watch_word(ring);
        let is_there = match self.wait {
            Wait::Event => sensor.listen(node)?,
            Wait::Doorbell | Wait::Spin => sensor.open_doorbell(node)?,
        };
        if is_there {
            self.sensors.push(sensor);
        }
        Ok(is_there)
    }

    /// Closes the doorbells, because a hub has started or ended, and the next hub has other doorbells.
    pub(crate) fn close_doorbells(&mut self) {
        self.sensors.iter_mut().for_each(|sensor| sensor.doorbell = None);
    }

    /// Sleeps until a doorbell or event wakes the subscriber, a signal arrives or the time `left` has passed. Returns
    /// at once if the subscriber was woken since the caller last received samples. Fails with
    /// [`Kind::ResourceExhausted`](scanhub_schema::Kind) if the system cannot wait.
    pub(crate) fn wait(&mut self, node: &Node, left: Duration) -> Result<(), Failure> {
        if self.wait == Wait::Event {
            return self.wait_for_event(node, left);
        }
        for sensor in &mut self.sensors {
            // Ignore an error: without any doorbell, each call only sleeps for a short time.
            let _ = sensor.open_doorbell(node);
        }
        if self.has_rung() {
            return Ok(());
        }
        let doorbells: Vec<_> = self.sensors.iter().flat_map(Sensor::doorbells).collect();
        let until_ns = clock::now_ns().saturating_add(left.as_nanos() as u64);
        let slept = match self.wait {
            _ if doorbells.is_empty() => {
                std::thread::sleep(left.min(MAX_SLEEP_WITHOUT_DOORBELL));
                Ok(())
            }
            Wait::Spin => {
                spin(&doorbells, until_ns);
                Ok(())
            }
            _ => scanhub_shm::wait_on_doorbells(&doorbells, until_ns),
        };
        match slept {
            Ok(()) => {
                self.has_rung();
                Ok(())
            }
            Err(WaitUnsupported) => self.switch_to_events(node),
        }
    }

    /// Returns whether a doorbell was rung since the last call. If so, the hub is alive.
    pub(crate) fn take_activity(&mut self) -> bool {
        std::mem::take(&mut self.has_activity)
    }

    /// Returns how often the doorbell of the sensor `name` was rung for `topic`. `None` if no doorbell is open, so that
    /// a sample may have been sent without a ring.
    pub(crate) fn ring_count(&self, name: &str, topic: Topic) -> Option<u32> {
        let sensor = self.sensors.iter().find(|sensor| sensor.name == name)?;
        let doorbell = sensor.doorbell.as_ref().filter(|bell| !bell.is_closed())?;
        Some(doorbell.ring_count(topic.spec().doorbell_word))
    }

    /// Returns whether a doorbell was rung since the last call. Samples that were sent before a ring can be received
    /// now.
    fn has_rung(&mut self) -> bool {
        let mut any = false;
        for Sensor { doorbell, ring_counts, .. } in &mut self.sensors {
            let Some(doorbell) = doorbell else { continue };
            for (word, last_count) in DoorbellWord::ALL.into_iter().zip(ring_counts) {
                let Some(last_count) = last_count else { continue };
                let ring_count = doorbell.ring_count(word);
                any |= std::mem::replace(last_count, ring_count) != ring_count;
            }
        }
        self.has_activity |= any;
        any
    }

    fn wait_for_event(&mut self, node: &Node, left: Duration) -> Result<(), Failure> {
        let mut is_new = false;
        for sensor in self.sensors.iter_mut().filter(|sensor| sensor.listener.is_none()) {
            // Retry, because at the last attempt the hub was still creating the event, or there was no slot.
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

    /// Takes the pending events. Returns whether there were any, so that the caller must receive samples. Fails with
    /// [`Kind::ResourceExhausted`](scanhub_schema::Kind) if an event does not work.
    pub(crate) fn take(&mut self) -> Result<bool, Failure> {
        let mut any = false;
        for listener in self.sensors.iter().filter_map(|sensor| sensor.listener.as_ref()) {
            any |= scanhub_shm::take_wakeups(&[listener])?;
        }
        Ok(any)
    }

    /// Changes to events. Returns without a wait, because samples may have arrived before the listeners existed.
    fn switch_to_events(&mut self, node: &Node) -> Result<(), Failure> {
        self.wait = Wait::Event;
        for sensor in &mut self.sensors {
            sensor.doorbell = None;
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

    /// Opens the doorbell, unless it is open. Closes the doorbell of a hub that has ended. Returns whether a doorbell
    /// is open.
    fn open_doorbell(&mut self, node: &Node) -> Result<bool, Failure> {
        if self.doorbell.as_ref().is_none_or(Doorbell::is_closed) {
            self.doorbell = Doorbell::open(node, &self.name)?.filter(|bell| !bell.is_closed());
            // A new doorbell has its own counts. Samples may have been sent before, so let each word appear to have
            // rung.
            for ring in DoorbellWord::ALL {
                self.ring_counts[ring as usize] =
                    self.ring_counts[ring as usize].map(|_| self.stale_count(ring));
            }
        }
        Ok(self.doorbell.is_some())
    }

    /// Adds the doorbell word `ring` to the wait. The word appears to have rung, because samples may have been sent
    /// before.
    fn watch_word(&mut self, ring: DoorbellWord) {
        if self.ring_counts[ring as usize].is_none() {
            self.ring_counts[ring as usize] = Some(self.stale_count(ring));
        }
    }

    /// Returns a count that differs from the doorbell's current one, so that the word appears to have rung.
    fn stale_count(&self, ring: DoorbellWord) -> u32 {
        self.doorbell.as_ref().map_or(0, |bell| bell.ring_count(ring).wrapping_sub(1))
    }

    fn doorbells(&self) -> impl Iterator<Item = (&Doorbell, DoorbellWord, u32)> {
        let watched = DoorbellWord::ALL
            .into_iter()
            .zip(self.ring_counts)
            .filter_map(|(word, count)| Some((word, count?)));
        self.doorbell
            .iter()
            .flat_map(move |doorbell| watched.clone().map(move |(word, count)| (doorbell, word, count)))
    }
}

fn spin(doorbells: &[(&Doorbell, DoorbellWord, u32)], until_ns: u64) {
    while clock::now_ns() < until_ns {
        for _ in 0..POLLS_PER_CLOCK_READ {
            if doorbells.iter().any(|(doorbell, word, count)| doorbell.ring_count(*word) != *count) {
                return;
            }
            std::hint::spin_loop();
        }
    }
}

/// Number of polls per reading of the clock.
const POLLS_PER_CLOCK_READ: u32 = 100;

/// Maximum sleep while there is no doorbell, between the end of a hub and the start of the next one.
const MAX_SLEEP_WITHOUT_DOORBELL: Duration = Duration::from_millis(20);

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::WakeEvent;
    use scanhub_shm::{Domain, Role, WakeSender};
    use std::path::PathBuf;
    use std::sync::mpsc;
    use std::thread;
    use std::time::Instant;

    /// Domain that is removed at the end of the test.
    struct TestDomain(PathBuf, Domain);

    impl TestDomain {
        fn new(name: &str) -> TestDomain {
            let name = format!("w{}-{name}", std::process::id());
            let base = PathBuf::from(format!("/tmp/sh{name}"));
            TestDomain(base.clone(), Domain::at(&name, &base).unwrap())
        }
    }

    impl Drop for TestDomain {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
            for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
                if entry.file_name().to_string_lossy().starts_with(&self.1.prefix()) {
                    let _ = std::fs::remove_file(entry.path());
                }
            }
        }
    }

    /// Timeout that is far longer than any wait in these tests.
    const TEST_TIMEOUT: Duration = Duration::from_secs(60);

    /// Returns whether a wait ended before its timeout, so that a doorbell or event has woken it.
    fn ended_before_timeout(started: Instant) -> bool {
        started.elapsed() < TEST_TIMEOUT
    }

    /// Starts the publishing side of a hub in a separate thread, because the ports of a hub cannot move between
    /// threads. The thread wakes the subscribers once for each message.
    fn hub(domain: &Domain, sensor: &'static str) -> mpsc::Sender<()> {
        let (wake_sender, wake_requests) = mpsc::channel();
        let (ready_sender, ready) = mpsc::channel();
        let node = scanhub_shm::hub_node(domain).unwrap();
        thread::spawn(move || {
            let waker = WakeSender::new(&node, sensor).unwrap();
            ready_sender.send(()).unwrap();
            while let Ok(()) = wake_requests.recv() {
                waker.wake(WakeEvent::Telegram).unwrap();
            }
        });
        ready.recv().unwrap();
        wake_sender
    }

    const SUBSCRIBED_TOPICS: [&[Topic]; 3] =
        [&[Topic::Zones], &[Topic::Marks], &[Topic::Status, Topic::Scan]];

    #[test]
    fn each_topic_is_woken_only_by_its_doorbell_word() {
        let domain = TestDomain::new("rings");
        let hub = scanhub_shm::hub_node(&domain.1).unwrap();
        let node = scanhub_shm::join(&domain.1, Role::Subscriber).unwrap();
        let waker = WakeSender::new(&hub, "front").unwrap();
        for (topics, woken_by) in SUBSCRIBED_TOPICS.into_iter().zip([
            &[DoorbellWord::First][..],
            &[DoorbellWord::Last],
            &[DoorbellWord::First, DoorbellWord::Last],
        ]) {
            let mut wakeups = Wakeups::waiting_by(Wait::Doorbell);
            topics.iter().for_each(|&topic| assert!(wakeups.add(&node, "front", topic).unwrap()));
            assert!(wakeups.has_rung(), "samples may have been sent before");
            for ring in DoorbellWord::ALL {
                let before =
                    topics.iter().map(|&topic| wakeups.ring_count("front", topic)).collect::<Vec<_>>();
                waker.ring(ring);
                let after =
                    topics.iter().map(|&topic| wakeups.ring_count("front", topic)).collect::<Vec<_>>();
                let is_woken = woken_by.contains(&ring);
                assert_eq!(
                    (wakeups.has_rung(), before != after),
                    (is_woken, is_woken),
                    "{topics:?} {ring:?}"
                );
                assert!(!wakeups.has_rung());
            }
        }
        let mut wakeups = Wakeups::waiting_by(Wait::Doorbell);
        for topic in [Topic::Zones, Topic::Marks] {
            assert!(wakeups.add(&node, "front", topic).unwrap());
            assert!(wakeups.has_rung() && !wakeups.has_rung(), "another topic has samples that wait");
        }
    }

    #[test]
    fn each_wait_method_wakes_for_every_sensor() {
        for (wait, name) in [(Wait::Doorbell, "bell"), (Wait::Event, "event"), (Wait::Spin, "spin")] {
            SUBSCRIBED_TOPICS.into_iter().for_each(|topics| wakes_for_every_sensor(wait, name, topics));
        }
    }

    fn wakes_for_every_sensor(wait: Wait, name: &str, topics: &[Topic]) {
        let domain = TestDomain::new(name);
        let mut wakeups = Wakeups::waiting_by(wait);
        let hubs = ["front", "rear"].map(|sensor| hub(&domain.1, sensor));
        let node = scanhub_shm::join(&domain.1, Role::Subscriber).unwrap();
        assert!(!wakeups.add(&node, "left", Topic::Zones).unwrap(), "there is no such sensor");
        for (at, sensor) in ["front", "rear"].into_iter().enumerate() {
            topics.iter().for_each(|&topic| assert!(wakeups.add(&node, sensor, topic).unwrap()));
            for hub in &hubs[..=at] {
                // Wake-ups from before the listener existed may occur once more.
                wakeups.wait(&node, Duration::ZERO).unwrap();
                wakeups.wait(&node, Duration::ZERO).unwrap();
                let started = Instant::now();
                hub.send(()).unwrap();
                wakeups.wait(&node, TEST_TIMEOUT).unwrap();
                assert!(ended_before_timeout(started), "{wait:?}");
            }
        }
    }

    #[test]
    fn doorbell_of_an_exited_hub_is_replaced() {
        let domain = TestDomain::new("ended");
        let hub = scanhub_shm::hub_node(&domain.1).unwrap();
        let node = scanhub_shm::join(&domain.1, Role::Subscriber).unwrap();
        let mut wakeups = Wakeups::waiting_by(Wait::Doorbell);
        let first = WakeSender::new(&hub, "front").unwrap();
        assert!(wakeups.add(&node, "front", Topic::Zones).unwrap());
        wakeups.wait(&node, Duration::ZERO).unwrap();
        let started = Instant::now();
        drop(first);
        wakeups.wait(&node, TEST_TIMEOUT).unwrap();
        assert!(wakeups.sensors[0].doorbell.is_none(), "its hub has ended");
        wakeups.wait(&node, Duration::ZERO).unwrap();
        let second = WakeSender::new(&hub, "front").unwrap();
        wakeups.wait(&node, TEST_TIMEOUT).unwrap();
        second.wake(WakeEvent::Telegram).unwrap();
        wakeups.wait(&node, TEST_TIMEOUT).unwrap();
        assert!(ended_before_timeout(started));
        assert!(wakeups.sensors[0].doorbell.as_ref().is_some_and(|bell| !bell.is_closed()));
    }

    #[test]
    fn doorbell_removed_without_a_hub_is_reopened() {
        let domain = TestDomain::new("removed");
        let hub = scanhub_shm::hub_node(&domain.1).unwrap();
        let node = scanhub_shm::join(&domain.1, Role::Subscriber).unwrap();
        let mut wakeups = Wakeups::waiting_by(Wait::Doorbell);
        // Do not drop the doorbell, because a hub that is killed closes nothing.
        std::mem::forget(WakeSender::new(&hub, "front").unwrap());
        assert!(wakeups.add(&node, "front", Topic::Zones).unwrap());
        for entry in std::fs::read_dir("/dev/shm").unwrap().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with(&domain.1.prefix()) && name.ends_with(".bell") {
                std::fs::remove_file(entry.path()).unwrap();
            }
        }
        let next = WakeSender::new(&hub, "front").unwrap();
        wakeups.close_doorbells();
        wakeups.wait(&node, Duration::ZERO).unwrap();
        let before = wakeups.ring_count("front", Topic::Zones).expect("it has a bell");
        next.wake(WakeEvent::Telegram).unwrap();
        assert_eq!(wakeups.ring_count("front", Topic::Zones), Some(before + 1));
    }

    #[test]
    fn listener_attaches_to_an_event_created_later() {
        let domain = TestDomain::new("later");
        let hub = scanhub_shm::hub_node(&domain.1).unwrap();
        let node = scanhub_shm::join(&domain.1, Role::Subscriber).unwrap();
        let mut wakeups = Wakeups::waiting_by(Wait::Doorbell);
        let first = WakeSender::new(&hub, "front").unwrap();
        assert!(wakeups.add(&node, "front", Topic::Zones).unwrap());
        drop(first);
        wakeups.switch_to_events(&node).unwrap();
        assert!(wakeups.sensors[0].listener.is_none());
        let waker = WakeSender::new(&hub, "front").unwrap();
        wakeups.wait(&node, TEST_TIMEOUT).unwrap();
        let started = Instant::now();
        waker.wake(WakeEvent::Telegram).unwrap();
        wakeups.wait(&node, TEST_TIMEOUT).unwrap();
        assert!(ended_before_timeout(started) && wakeups.sensors[0].listener.is_some());
    }

    #[test]
    fn event_wakes_if_doorbell_is_unsupported() {
        let domain = TestDomain::new("turn");
        let hub = scanhub_shm::hub_node(&domain.1).unwrap();
        let node = scanhub_shm::join(&domain.1, Role::Subscriber).unwrap();
        let waker = WakeSender::new(&hub, "front").unwrap();
        let mut wakeups = Wakeups::waiting_by(Wait::Doorbell);
        assert!(wakeups.add(&node, "front", Topic::Zones).unwrap());
        wakeups.switch_to_events(&node).unwrap();
        let started = Instant::now();
        waker.wake(WakeEvent::Telegram).unwrap();
        wakeups.wait(&node, TEST_TIMEOUT).unwrap();
        assert!(ended_before_timeout(started) && wakeups.wait == Wait::Event);
    }
}
