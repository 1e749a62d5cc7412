//! How a consumer waits for the samples of its sensors. Refuses to know which topics they are, and whether there is a hub.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use scanhub_schema::{Failure, Ring, Topic};
use scanhub_shm::{Bell, Listener, Node, Unsupported};

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
    /// For each ring that tells of a topic that is followed how often the bell had been rung so when samples were last looked
    /// for.
    rung: [Option<u32>; Ring::ALL.len()],
    listener: Option<Listener>,
}

impl Wakeups {
    /// None yet.
    pub(crate) fn by(wait: Wait) -> Wakeups {
        Wakeups { wait, sensors: Vec::new(), rang: false, taken: false }
    }

    /// Those of `topic` of the sensor `name` too; whether they are there already.
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if memory, descriptors or places for consumers are.
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

    /// The hub went or came: what its consumers sleep at may be another bell now, or soon.
    pub(crate) fn renew(&mut self) {
        self.sensors.iter_mut().for_each(|sensor| sensor.bell = None);
    }

    /// Sleeps until one of them wakes, a signal comes or `left` is over; returns at once if one has since the caller looked
    /// for samples.
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if the system cannot wait.
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

    /// Whether a bell was rung since this was last asked: who rings, lives.
    pub(crate) fn take_rang(&mut self) -> bool {
        std::mem::take(&mut self.rang)
    }

    /// How often the bell of the sensor `name` was rung for `topic` by now; nothing where that does not tell whether something
    /// was sent.
    pub(crate) fn rung(&self, name: &str, topic: Topic) -> Option<u32> {
        let sensor = self.sensors.iter().find(|sensor| sensor.name == name)?;
        let bell = sensor.bell.as_ref().filter(|bell| !bell.is_closed())?;
        Some(bell.rung(topic.row().ring))
    }

    /// Whether a bell was rung since samples were last looked for; what was sent before can be received now.
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
            // Its hub was still making it, or there was no room.
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

    /// What is readable while events are pending, of each sensor that is listened to.
    pub(crate) fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.sensors.iter().filter_map(|sensor| sensor.listener.as_ref()).map(scanhub_shm::descriptor)
    }

    /// Takes the events that are pending; whether there were any. What was sent before has to be looked for.
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if an event does not work.
    pub(crate) fn take(&mut self) -> Result<bool, Failure> {
        let mut any = false;
        for listener in self.sensors.iter().filter_map(|sensor| sensor.listener.as_ref()) {
            any |= scanhub_shm::take_wakeups(&[listener])?;
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
        let Some(service) = scanhub_shm::open_wake(node, &self.name)? else { return Ok(false) };
        self.listener = Some(scanhub_shm::listener(&service)?);
        Ok(true)
    }

    /// Whether it has a bell that may be rung. That of a hub that ended is given up.
    fn go_to_bell(&mut self, node: &Node) -> Result<bool, Failure> {
        if self.bell.as_ref().is_none_or(Bell::is_closed) {
            self.bell = Bell::open(node, &self.name)?.filter(|bell| !bell.is_closed());
            // Another bell, another count: samples may have been sent at it before.
            for ring in Ring::ALL {
                self.rung[ring as usize] = self.rung[ring as usize].map(|_| self.not_yet(ring));
            }
        }
        Ok(self.bell.is_some())
    }

    /// It follows a topic of which `ring` tells. Samples may have been sent before.
    fn hear(&mut self, ring: Ring) {
        if self.rung[ring as usize].is_none() {
            self.rung[ring as usize] = Some(self.not_yet(ring));
        }
    }

    /// A number that the bell does not have now.
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

/// Looks at the words between two at the clock.
const LOOKS: u32 = 100;

/// The longest sleep while a hub is gone and its successor has hung no bell.
const WITHOUT_BELL: Duration = Duration::from_millis(20);

#[cfg(test)]
mod tests;
