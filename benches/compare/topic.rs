//! Topics of two kinds. The first kind is a service of bytes with the hub's settings, for messages of any length. For
//! comparison, the second kind is the hub's topic `scan`. Both are published as in the hub. The publisher loans a
//! sample, writes it in place, sends it, and then wakes all subscribers once.

use iceoryx2::prelude::ServiceName;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{DoorbellWord, Header, Scan, ScanHead, Topic, WakeEvent, limits};
use scanhub_shm::{Domain, Environment, HubLock};
use scanhub_shm::{
    Doorbell, Listener, Node, Payload, Publisher, SampleMut, Subscriber, TopicService, WakeSender,
};

use super::message::{BEAM_COUNT, Label, MIN_MESSAGE_LEN, Mechanism, SCAN_LEN, contents};
use super::process::{MessageReceiver, MessageSender, RunParameters};
use crate::support::{Outcome, clock, subscriber};

/// Membership of a publishing process in the domain.
struct HubMembership {
    waker: WakeSender,
    node: Node,
    _lock: HubLock,
}

impl HubMembership {
    fn new(task: &RunParameters) -> Outcome<HubMembership> {
        let domain = Domain::of_hub(task.domain, None, &Environment::of_process())?;
        let lock = HubLock::acquire(domain.root())?;
        let node = scanhub_shm::hub_node(&domain)?;
        Ok(HubMembership { waker: WakeSender::new(&node, SENSOR)?, node, _lock: lock })
    }

    /// Sends the written sample, and wakes all subscribers.
    fn send<P: Payload + ?Sized>(&self, written: Option<SampleMut<P>>) -> Outcome<()> {
        let sample = written.ok_or("nothing was written")?;
        sample.send().map_err(|error| format!("not sent: {error:?}"))?;
        self.waker.ring(DoorbellWord::First);
        Ok(self.waker.notify(WakeEvent::Telegram)?)
    }
}

/// The publisher of a topic of bytes.
pub(crate) struct BytesSender {
    written: Option<SampleMut<[u8]>>,
    publisher: Publisher<[u8]>,
    _service: TopicService<[u8]>,
    contents: Vec<u8>,
    hub: HubMembership,
}

impl BytesSender {
    pub(crate) fn new(task: &RunParameters) -> Outcome<BytesSender> {
        let hub = HubMembership::new(task)?;
        let service = hub
            .node
            .service_builder(&ServiceName::new(SERVICE_NAME)?)
            .publish_subscribe::<[u8]>()
            .user_header::<Header>()
            .max_publishers(limits::MAX_PUBLISHERS)
            .max_subscribers(TopicLimits::default().subscribers)
            .max_nodes(limits::MAX_NODES)
            .subscriber_max_buffer_size(limits::queue_len(Topic::Scan))
            .subscriber_max_borrowed_samples(limits::MAX_BORROWED_SAMPLES)
            .history_size(limits::history_len(Topic::Scan))
            .enable_safe_overflow(true)
            .create()?;
        let publisher = service
            .publisher_builder()
            .max_loaned_samples(limits::MAX_LOANED_SAMPLES)
            .override_sample_preallocation(|_| {
                limits::sample_count(Topic::Scan, TopicLimits::default().subscribers)
            })
            .initial_max_slice_len(task.payload)
            .create()?;
        Ok(BytesSender { written: None, publisher, _service: service, contents: contents(task.payload), hub })
    }

    /// Loans a sample of this length, and writes a message into it.
    fn loan(&mut self, label: Label, len: usize) -> Outcome<()> {
        let loan = self.publisher.loan_slice_uninit(len).map_err(|error| format!("no loan: {error:?}"))?;
        let sample = self.written.insert(loan.write_from_slice(&self.contents[..len]));
        label.write(sample.payload_mut());
        Ok(())
    }
}

impl MessageSender for BytesSender {
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
        self.loan(label, MIN_MESSAGE_LEN)?;
        self.send()
    }
}

/// A subscriber to the topic of bytes.
pub(crate) struct BytesReceiver {
    subscriber: Subscriber<[u8]>,
    wait: WaitMethod,
    _node: Node,
}

/// The way in which a subscriber waits, as in the client library.
enum WaitMethod {
    /// The doorbell, the count of the doorbell when samples were last received, and whether the subscriber sleeps (or
    /// spins).
    Doorbell(Doorbell, u32, bool),
    /// The event, and whether the subscriber has taken the wake-ups of the event since its last sleep.
    Event(Box<Listener>, bool),
}

impl BytesReceiver {
    pub(crate) fn new(task: &RunParameters) -> Outcome<BytesReceiver> {
        let node = scanhub_shm::client_node(&Domain::of_hub(task.domain, None, &Environment::of_process())?)?;
        let wait = if task.mechanism == Mechanism::Event {
            let event = scanhub_shm::open_wake(&node, SENSOR)?.ok_or("no event")?;
            WaitMethod::Event(Box::new(scanhub_shm::listener(&node, &event)?), false)
        } else {
            let doorbell = Doorbell::open(&node, SENSOR)?.ok_or("no doorbell")?;
            let ring_count = doorbell.ring_count(DoorbellWord::First);
            WaitMethod::Doorbell(doorbell, ring_count, task.mechanism == Mechanism::Doorbell)
        };
        let service = node
            .service_builder(&ServiceName::new(SERVICE_NAME)?)
            .publish_subscribe::<[u8]>()
            .user_header::<Header>()
            .open()?;
        Ok(BytesReceiver { subscriber: service.subscriber_builder().create()?, wait, _node: node })
    }
}

impl MessageReceiver for BytesReceiver {
    fn next(&mut self) -> Outcome<Label> {
        loop {
            if let Some(sample) = self.subscriber.receive()? {
                return Label::read(&sample);
            }
            self.wait.wait()?;
        }
    }
}

impl WaitMethod {
    /// Sleeps or spins until a sample may have arrived. Returns at once if a sample may have arrived since samples were
    /// last received.
    fn wait(&mut self) -> Outcome<()> {
        match self {
            WaitMethod::Doorbell(doorbell, ring_count, sleeps) => {
                if doorbell.ring_count(DoorbellWord::First) == *ring_count && *sleeps {
                    let until = clock::now() + STEP_TIMEOUT_NS;
                    scanhub_shm::wait_on_doorbells(&[(doorbell, DoorbellWord::First, *ring_count)], until)
                        .map_err(|error| format!("{error:?}"))?;
                }
                while doorbell.ring_count(DoorbellWord::First) == *ring_count && !*sleeps {
                    std::hint::spin_loop();
                }
                *ring_count = doorbell.ring_count(DoorbellWord::First);
                Ok(())
            }
            WaitMethod::Event(listener, taken) => {
                *taken = !*taken && scanhub_shm::take_wakeups(&[listener])?;
                if !*taken {
                    scanhub_shm::sleep(&[listener], STEP_TIMEOUT)?;
                }
                Ok(())
            }
        }
    }
}

/// The publisher of the hub's topic of scans.
pub(crate) struct ScanSender {
    written: Option<SampleMut<Scan>>,
    publisher: Publisher<Scan>,
    _service: TopicService<Scan>,
    next: u64,
    hub: HubMembership,
}

impl ScanSender {
    pub(crate) fn new(task: &RunParameters) -> Outcome<ScanSender> {
        let hub = HubMembership::new(task)?;
        let limits = TopicLimits::default();
        let service = Scan::create(&hub.node, SENSOR, &limits)?;
        let publisher = Scan::publisher(&service, &limits)?;
        Ok(ScanSender { written: None, publisher, _service: service, next: 0, hub })
    }
}

impl MessageSender for ScanSender {
    fn open(&mut self) -> Outcome<()> {
        Ok(())
    }

    fn write(&mut self, label: Label) -> Outcome<()> {
        let loan = Scan::loan(&self.publisher, SCAN_LEN).map_err(|error| format!("no loan: {error:?}"))?;
        let sample = self.written.insert(loan);
        let kind = label.phase as u64 * 2 + u64::from(label.is_end);
        *sample.user_header_mut() =
            Header { seq: label.number, topic_seq: self.next, boot: 1, wall_ns: kind, ..Header::default() };
        let arrays = Scan::write(sample).begin(ScanHead::lms(BEAM_COUNT, -90_000, 500, 1, 13));
        arrays.ranges.fill(label.number as u16);
        self.next += 1;
        Ok(())
    }

    fn send(&mut self) -> Outcome<()> {
        self.hub.send::<Scan>(self.written.take())
    }
}

/// A subscriber to scans that uses the client library.
pub(crate) struct ScanReceiver(scanhub_client::Subscriber<Scan>);

impl ScanReceiver {
    pub(crate) fn new(task: &RunParameters) -> Outcome<ScanReceiver> {
        let mut scans = subscriber::subscribe::<Scan>(task.domain, SENSOR)?;
        // The first call attaches the subscriber to the domain. No message has been sent yet.
        scans.try_next()?;
        Ok(ScanReceiver(scans))
    }
}

impl MessageReceiver for ScanReceiver {
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

/// Name of the sensor whose subscribers are woken.
pub(crate) const SENSOR: &str = "front";
const SERVICE_NAME: &str = "compare";
const STEP_TIMEOUT: std::time::Duration = std::time::Duration::from_secs(10);
const STEP_TIMEOUT_NS: u64 = 10_000_000_000;
