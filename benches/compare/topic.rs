//! Topics: a service with the settings of the hub's own for messages of any length, and the hub's own topic of scans
//! for comparison. They are published as the hub does it: loaned, written in place, sent, and then all subscribers are
//! woken once.

use iceoryx2::prelude::ServiceName;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Header, Ring, Scan, ScanHead, Topic, Wake, limits};
use scanhub_shm::{Bell, Listener, Node, Payload, Publisher, SampleMut, Subscriber, TopicService, Waker};
use scanhub_shm::{Domain, Environment, HubLock};

use super::message::{BEAMS, Label, SCAN, SHORT, Way, contents};
use super::process::{Inlet, Outlet, Task};
use crate::support::{Outcome, clock, consumer};

/// Membership of a publishing process.
struct Hub {
    waker: Waker,
    node: Node,
    _lock: HubLock,
}

impl Hub {
    fn new(task: &Task) -> Outcome<Hub> {
        let domain = Domain::of_hub(task.domain, None, &Environment::of_process())?;
        let lock = HubLock::acquire(domain.root())?;
        let node = scanhub_shm::hub_node(&domain)?;
        Ok(Hub { waker: Waker::new(&node, SENSOR)?, node, _lock: lock })
    }

    /// Sends the written sample, and wakes all subscribers.
    fn send<P: Payload + ?Sized>(&self, written: Option<SampleMut<P>>) -> Outcome<()> {
        let sample = written.ok_or("nothing was written")?;
        sample.send().map_err(|error| format!("not sent: {error:?}"))?;
        self.waker.ring(Ring::First);
        Ok(self.waker.tell(Wake::Telegram)?)
    }
}

/// The publisher of a topic of bytes.
pub(crate) struct Bytes {
    written: Option<SampleMut<[u8]>>,
    publisher: Publisher<[u8]>,
    _service: TopicService<[u8]>,
    contents: Vec<u8>,
    hub: Hub,
}

impl Bytes {
    pub(crate) fn new(task: &Task) -> Outcome<Bytes> {
        let hub = Hub::new(task)?;
        let service = hub
            .node
            .service_builder(&ServiceName::new(SERVICE)?)
            .publish_subscribe::<[u8]>()
            .user_header::<Header>()
            .max_publishers(limits::PUBLISHERS)
            .max_subscribers(TopicLimits::default().subscribers)
            .max_nodes(limits::NODES)
            .subscriber_max_buffer_size(limits::buffer(Topic::Scan))
            .subscriber_max_borrowed_samples(limits::BORROWED)
            .history_size(limits::history(Topic::Scan))
            .enable_safe_overflow(true)
            .create()?;
        let publisher = service
            .publisher_builder()
            .max_loaned_samples(limits::LOANED)
            .override_sample_preallocation(|_| {
                limits::samples(Topic::Scan, TopicLimits::default().subscribers)
            })
            .initial_max_slice_len(task.payload)
            .create()?;
        Ok(Bytes { written: None, publisher, _service: service, contents: contents(task.payload), hub })
    }

    /// Writes a message of this length into a loan.
    fn loan(&mut self, label: Label, len: usize) -> Outcome<()> {
        let loan = self.publisher.loan_slice_uninit(len).map_err(|error| format!("no loan: {error:?}"))?;
        let sample = self.written.insert(loan.write_from_slice(&self.contents[..len]));
        label.write(sample.payload_mut());
        Ok(())
    }
}

impl Outlet for Bytes {
    fn open(&mut self) -> Outcome<()> {
        Ok(())
    }

    fn write(&mut self, label: Label) -> Outcome<()> {
        self.loan(label, self.contents.len())
    }

    fn send(&mut self) -> Outcome<()> {
        self.hub.send::<[u8]>(self.written.take())
    }

    fn end(&mut self, label: Label) -> Outcome<()> {
        self.loan(label, SHORT)?;
        self.send()
    }
}

/// A subscriber to the topic of bytes.
pub(crate) struct BytesInlet {
    subscriber: Subscriber<[u8]>,
    wait: Wait,
    _node: Node,
}

/// How a subscriber waits, as in the client library.
enum Wait {
    /// The doorbell, its count when samples were last received, and whether the subscriber sleeps.
    Bell(Bell, u32, bool),
    /// The event, and whether wake-ups were taken since the last sleep.
    Event(Box<Listener>, bool),
}

impl BytesInlet {
    pub(crate) fn new(task: &Task) -> Outcome<BytesInlet> {
        let node = scanhub_shm::client_node(&Domain::of_hub(task.domain, None, &Environment::of_process())?)?;
        let wait = if task.way == Way::Event {
            let event = scanhub_shm::open_wake(&node, SENSOR)?.ok_or("no event")?;
            Wait::Event(Box::new(scanhub_shm::listener(&node, &event)?), false)
        } else {
            let bell = Bell::open(&node, SENSOR)?.ok_or("no bell")?;
            let rung = bell.rung(Ring::First);
            Wait::Bell(bell, rung, task.way == Way::Doorbell)
        };
        let service = node
            .service_builder(&ServiceName::new(SERVICE)?)
            .publish_subscribe::<[u8]>()
            .user_header::<Header>()
            .open()?;
        Ok(BytesInlet { subscriber: service.subscriber_builder().create()?, wait, _node: node })
    }
}

impl Inlet for BytesInlet {
    fn next(&mut self) -> Outcome<Label> {
        loop {
            if let Some(sample) = self.subscriber.receive()? {
                return Label::read(&sample);
            }
            self.wait.wait()?;
        }
    }
}

impl Wait {
    /// Sleeps or spins until there may be a sample; returns at once if one may have arrived since samples were last
    /// received.
    fn wait(&mut self) -> Outcome<()> {
        match self {
            Wait::Bell(bell, rung, sleeps) => {
                if bell.rung(Ring::First) == *rung && *sleeps {
                    let until = clock::now() + LONG_NS;
                    scanhub_shm::sleep_at_bells(&[(bell, Ring::First, *rung)], until)
                        .map_err(|error| format!("{error:?}"))?;
                }
                while bell.rung(Ring::First) == *rung && !*sleeps {
                    std::hint::spin_loop();
                }
                *rung = bell.rung(Ring::First);
                Ok(())
            }
            Wait::Event(listener, taken) => {
                *taken = !*taken && scanhub_shm::take_wakeups(&[listener])?;
                if !*taken {
                    scanhub_shm::sleep(&[listener], LONG)?;
                }
                Ok(())
            }
        }
    }
}

/// The publisher of the hub's topic of scans.
pub(crate) struct Scans {
    written: Option<SampleMut<Scan>>,
    publisher: Publisher<Scan>,
    _service: TopicService<Scan>,
    next: u64,
    hub: Hub,
}

impl Scans {
    pub(crate) fn new(task: &Task) -> Outcome<Scans> {
        let hub = Hub::new(task)?;
        let limits = TopicLimits::default();
        let service = Scan::create(&hub.node, SENSOR, &limits)?;
        let publisher = Scan::publisher(&service, &limits)?;
        Ok(Scans { written: None, publisher, _service: service, next: 0, hub })
    }
}

impl Outlet for Scans {
    fn open(&mut self) -> Outcome<()> {
        Ok(())
    }

    fn write(&mut self, label: Label) -> Outcome<()> {
        let loan = Scan::loan(&self.publisher, SCAN).map_err(|error| format!("no loan: {error:?}"))?;
        let sample = self.written.insert(loan);
        let kind = label.phase as u64 * 2 + u64::from(label.is_end);
        *sample.user_header_mut() =
            Header { seq: label.number, topic_seq: self.next, boot: 1, wall_ns: kind, ..Header::default() };
        let arrays = Scan::write(sample).begin(ScanHead::lms(BEAMS, -90_000, 500, 1, 13));
        arrays.ranges.fill(label.number as u16);
        self.next += 1;
        Ok(())
    }

    fn send(&mut self) -> Outcome<()> {
        self.hub.send::<Scan>(self.written.take())
    }
}

/// A subscriber to scans that uses the client library.
pub(crate) struct ScansInlet(scanhub_client::Subscriber<Scan>);

impl ScansInlet {
    pub(crate) fn new(task: &Task) -> Outcome<ScansInlet> {
        let mut scans = consumer::subscribe::<Scan>(task.domain, SENSOR)?;
        // Joins the domain; no message has been sent yet.
        scans.try_next()?;
        Ok(ScansInlet(scans))
    }
}

impl Inlet for ScansInlet {
    fn next(&mut self) -> Outcome<Label> {
        let scan = self.0.next()?.ok_or("no scan")?;
        let Header { seq: number, wall_ns: kind, .. } = *scan.header();
        let ends = [scan.ranges().first(), scan.ranges().last()];
        if ends != [Some(&(number as u16)); 2] {
            return Err(format!("scan {number} is torn").into());
        }
        Ok(Label { phase: kind as usize / 2, number, is_end: kind % 2 == 1 })
    }
}

/// The sensor whose subscribers are woken.
pub(crate) const SENSOR: &str = "front";
const SERVICE: &str = "compare";
const LONG: std::time::Duration = std::time::Duration::from_secs(10);
const LONG_NS: u64 = 10_000_000_000;
