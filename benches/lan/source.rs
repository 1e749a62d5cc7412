//! A hub without sensors: publishes one scan again and again, when it is told to.

use schema::ipc::{self, Node, Payload, Publisher, TopicService, Waker};
use schema::{Domain, Header, HubLock, Scan, Status, Wake};

use crate::support::Outcome;

/// Name of its one sensor.
pub(crate) const SENSOR: &str = "front";

/// The publishing end of the scans of one sensor.
pub(crate) struct Source {
    publisher: Publisher<Scan>,
    waker: Waker,
    next: u64,
    _service: TopicService<Scan>,
    /// Every hub has it; where it was not there, a gateway would ask for it again and again.
    _status: TopicService<Status>,
    _node: Node,
    _lock: HubLock,
}

impl Source {
    pub(crate) fn open(domain: &Domain) -> Outcome<Source> {
        let lock = HubLock::acquire(domain.root())?;
        let node = ipc::hub_node(domain)?;
        let waker = Waker::new(&node, SENSOR)?;
        let service = Scan::create(&node, SENSOR)?;
        Ok(Source {
            publisher: Scan::publisher(&service)?,
            waker,
            next: 0,
            _service: service,
            _status: Status::create(&node, SENSOR)?,
            _node: node,
            _lock: lock,
        })
    }

    /// Publishes a scan with this stamp of the wall clock, and wakes who follows.
    pub(crate) fn publish(&mut self, wall_ns: u64) -> Outcome<()> {
        let mut sample = self.publisher.loan().map_err(|error| format!("no loan: {error:?}"))?;
        let header = Header { seq: self.next, topic_seq: self.next, boot: 1, wall_ns, ..Header::default() };
        self.next += 1;
        *sample.user_header_mut() = header;
        *sample.payload_mut() = scan();
        sample.send().map_err(|error| format!("not sent: {error:?}"))?;
        self.waker.wake(Wake::Telegram)?;
        Ok(())
    }
}

/// 361 beams in mm, as sensors leave the factory.
pub(crate) fn scan() -> Scan {
    let mut scan = Scan { count: 361, unit_mm: 1, range_bits: 13, step_mdeg: 500, ..Scan::default() };
    scan.range_array[..361].iter_mut().enumerate().for_each(|(beam, range)| *range = 1000 + beam as u16);
    scan
}
