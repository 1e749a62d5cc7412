//! How a consumer waits for the samples of its sensors. Refuses to know which topics they are, and whether there is a hub.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use schema::Failure;
use schema::ipc::{self, Bell, Listener, Node, Unsupported};

use crate::clock;

/// What a consumer sleeps on, or that it does not sleep.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Wait {
    /// Sleep on a word in shared memory; one call of the hub wakes all. If the system cannot wait for the words of several
    /// sensors at once, it uses the event.
    #[default]
    Doorbell,
    /// Sleep on the event, which other languages use; the hub sends one message to each consumer.
    Event,
    /// Do not sleep: reads the words all the time, which uses a whole processor, for the shortest latency.
    Spin,
}

/// What wakes a consumer, for each of its sensors.
pub(crate) struct Wakeups {
    wait: Wait,
    sensors: Vec<Sensor>,
    /// A bell was rung since that was last asked.
    rang: bool,
    /// Wake-ups by event were taken since the last sleep, and samples looked for since.
    taken: bool,
}

struct Sensor {
    name: String,
    bell: Option<Bell>,
    /// How often the bell had been rung when its samples were last looked for.
    rung: u32,
    listener: Option<Listener>,
}

impl Wakeups {
    /// None yet.
    pub(crate) fn by(wait: Wait) -> Wakeups {
        Wakeups { wait, sensors: Vec::new(), rang: false, taken: false }
    }

    /// Those of the sensor `name` too; whether they are there already.
    ///
    /// [`Kind::Short`](schema::Kind) if memory, descriptors or places for consumers are.
    pub(crate) fn add(&mut self, node: &Node, name: &str) -> Result<bool, Failure> {
        if self.sensors.iter().any(|sensor| sensor.name == name) {
            return Ok(true);
        }
        let mut sensor = Sensor { name: name.to_owned(), bell: None, rung: 0, listener: None };
        let is_there = match self.wait {
            Wait::Event => sensor.listen(node)?,
            Wait::Doorbell | Wait::Spin => sensor.go_to_bell(node)?,
        };
        if is_there {
            self.sensors.push(sensor);
        }
        Ok(is_there)
    }

    /// The hub went or came: what its consumers sleep at may be another bell now, or soon.
    pub(crate) fn renew(&mut self) {
        self.sensors.iter_mut().for_each(|sensor| sensor.bell = None);
    }

    /// Sleeps until one of them wakes, a signal comes or `left` is over; returns at once if one has since the caller looked
    /// for samples.
    ///
    /// [`Kind::Short`](schema::Kind) if the system cannot wait.
    pub(crate) fn wait(&mut self, node: &Node, left: Duration) -> Result<(), Failure> {
        if self.wait == Wait::Event {
            return self.wait_for_event(node, left);
        }
        for sensor in &mut self.sensors {
            // Who has come this far goes on without a bell, a little later each time, until there is one.
            let _ = sensor.go_to_bell(node);
        }
        if self.heard() {
            return Ok(());
        }
        let bells: Vec<_> = self.sensors.iter().filter_map(Sensor::bell).collect();
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
            _ => ipc::sleep_at_bells(&bells, until_ns),
        };
        match slept {
            Ok(()) => {
                self.heard();
                Ok(())
            }
            Err(Unsupported) => self.turn_to_events(node),
        }
    }

    /// Whether a bell was rung since this was last asked: who rings, lives.
    pub(crate) fn take_rang(&mut self) -> bool {
        std::mem::take(&mut self.rang)
    }

    /// How often the bell of the sensor `name` was rung by now; nothing where that does not tell whether something was sent.
    pub(crate) fn rung(&self, name: &str) -> Option<u32> {
        let sensor = self.sensors.iter().find(|sensor| sensor.name == name)?;
        sensor.bell.as_ref().filter(|bell| !bell.is_closed()).map(Bell::rung)
    }

    /// Whether a bell was rung since samples were last looked for; what was sent before can be received now.
    fn heard(&mut self) -> bool {
        let mut any = false;
        for sensor in &mut self.sensors {
            let rung = sensor.bell.as_ref().map_or(sensor.rung, Bell::rung);
            any |= std::mem::replace(&mut sensor.rung, rung) != rung;
        }
        self.rang |= any;
        any
    }

    fn wait_for_event(&mut self, node: &Node, left: Duration) -> Result<(), Failure> {
        let mut is_new = false;
        for sensor in self.sensors.iter_mut().filter(|sensor| sensor.listener.is_none()) {
            // Its hub was still making it, or there was no room.
            is_new |= sensor.listen(node).unwrap_or(false);
        }
        if is_new {
            return Ok(());
        }
        let listeners: Vec<&Listener> =
            self.sensors.iter().filter_map(|sensor| sensor.listener.as_ref()).collect();
        if !self.taken && ipc::take_wakeups(&listeners)? {
            self.taken = true;
            return Ok(());
        }
        self.taken = false;
        ipc::sleep(&listeners, left)
    }

    /// What is readable while events are pending, of each sensor that is listened to.
    pub(crate) fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.sensors.iter().filter_map(|sensor| sensor.listener.as_ref()).map(ipc::descriptor)
    }

    /// Takes the events that are pending; whether there were any. What was sent before has to be looked for.
    ///
    /// [`Kind::Short`](schema::Kind) if an event does not work.
    pub(crate) fn take(&mut self) -> Result<bool, Failure> {
        let mut any = false;
        for listener in self.sensors.iter().filter_map(|sensor| sensor.listener.as_ref()) {
            any |= ipc::take_wakeups(&[listener])?;
        }
        Ok(any)
    }

    /// From now on. Returns without a wait: what came before the listeners has to be looked for.
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
    /// Whether it listens to the event, if possible.
    fn listen(&mut self, node: &Node) -> Result<bool, Failure> {
        let Some(service) = ipc::open_wake(node, &self.name)? else { return Ok(false) };
        self.listener = Some(ipc::listener(&service)?);
        Ok(true)
    }

    /// Whether it has a bell that may be rung. That of a hub that ended is given up.
    fn go_to_bell(&mut self, node: &Node) -> Result<bool, Failure> {
        if self.bell.as_ref().is_none_or(Bell::is_closed) {
            self.bell = Bell::open(node, &self.name)?.filter(|bell| !bell.is_closed());
            // Another bell, another count: samples may have been sent at it before.
            self.rung = self.bell.as_ref().map_or(self.rung, |bell| bell.rung().wrapping_sub(1));
        }
        Ok(self.bell.is_some())
    }

    fn bell(&self) -> Option<(&Bell, u32)> {
        self.bell.as_ref().map(|bell| (bell, self.rung))
    }
}

fn spin(bells: &[(&Bell, u32)], until_ns: u64) {
    while clock::now_ns() < until_ns {
        for _ in 0..LOOKS {
            if bells.iter().any(|(bell, rung)| bell.rung() != *rung) {
                return;
            }
            std::hint::spin_loop();
        }
    }
}

/// Looks at the words between two at the clock.
const LOOKS: u32 = 100;

/// The longest sleep while a hub is gone and its successor has hung no bell.
const WITHOUT_BELL: Duration = Duration::from_millis(20);

#[cfg(test)]
mod tests {
    use super::*;
    use schema::ipc::Waker;
    use schema::{Domain, Wake};
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
    const LONG: Duration = Duration::from_secs(20);

    /// Waits that are over before this time were woken.
    fn woken(started: Instant) -> bool {
        started.elapsed() < LONG
    }

    /// A hub's end in a thread of its own, where its ports have to stay; wakes each time it is told.
    fn hub(domain: &Domain, sensor: &'static str) -> mpsc::Sender<()> {
        let (tell, told) = mpsc::channel();
        let (say, said) = mpsc::channel();
        let node = ipc::hub_node(domain).unwrap();
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

    #[test]
    fn each_way_wakes_for_every_sensor() {
        for (wait, name) in [(Wait::Doorbell, "bell"), (Wait::Event, "event"), (Wait::Spin, "spin")] {
            let place = Place::new(name);
            let mut wakeups = Wakeups::by(wait);
            let hubs = ["front", "rear"].map(|sensor| hub(&place.1, sensor));
            let node = ipc::client_node(&place.1).unwrap();
            assert!(!wakeups.add(&node, "left").unwrap(), "there is no such sensor");
            for (at, sensor) in ["front", "rear"].into_iter().enumerate() {
                assert!(wakeups.add(&node, sensor).unwrap());
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
    }

    #[test]
    fn the_bell_of_a_hub_that_ended_is_exchanged() {
        let place = Place::new("ended");
        let hub = ipc::hub_node(&place.1).unwrap();
        let node = ipc::client_node(&place.1).unwrap();
        let mut wakeups = Wakeups::by(Wait::Doorbell);
        let first = Waker::new(&hub, "front").unwrap();
        assert!(wakeups.add(&node, "front").unwrap());
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
        let hub = ipc::hub_node(&place.1).unwrap();
        let node = ipc::client_node(&place.1).unwrap();
        let mut wakeups = Wakeups::by(Wait::Doorbell);
        // A hub that is killed closes nothing.
        std::mem::forget(Waker::new(&hub, "front").unwrap());
        assert!(wakeups.add(&node, "front").unwrap());
        for entry in std::fs::read_dir("/dev/shm").unwrap().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with(&place.1.prefix()) && name.ends_with(".bell") {
                std::fs::remove_file(entry.path()).unwrap();
            }
        }
        let next = Waker::new(&hub, "front").unwrap();
        wakeups.renew();
        wakeups.wait(&node, Duration::ZERO).unwrap();
        let before = wakeups.rung("front").expect("it has a bell");
        next.wake(Wake::Telegram).unwrap();
        assert_eq!(wakeups.rung("front"), Some(before + 1));
    }

    #[test]
    fn an_event_that_is_made_later_is_listened_to() {
        let place = Place::new("later");
        let hub = ipc::hub_node(&place.1).unwrap();
        let node = ipc::client_node(&place.1).unwrap();
        let mut wakeups = Wakeups::by(Wait::Doorbell);
        let first = Waker::new(&hub, "front").unwrap();
        assert!(wakeups.add(&node, "front").unwrap());
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
        let hub = ipc::hub_node(&place.1).unwrap();
        let node = ipc::client_node(&place.1).unwrap();
        let waker = Waker::new(&hub, "front").unwrap();
        let mut wakeups = Wakeups::by(Wait::Doorbell);
        assert!(wakeups.add(&node, "front").unwrap());
        wakeups.turn_to_events(&node).unwrap();
        let started = Instant::now();
        waker.wake(Wake::Telegram).unwrap();
        wakeups.wait(&node, LONG).unwrap();
        assert!(woken(started) && wakeups.wait == Wait::Event);
    }
}
