//! A hub without sensors, which publishes the same scan on request.

use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{DoorbellWord, Header, Scan, ScanHead, Status, WakeEvent};
use scanhub_shm::{Domain, HubLock};
use scanhub_shm::{Node, Payload, Publisher, TopicService, WakeSender};

use super::Outcome;

/// Name of the only sensor.
pub(crate) const SENSOR: &str = "front";

/// A hub without sensors, which publishes the same scan on request.
pub(crate) struct ScanSource {
    publisher: Publisher<Scan>,
    waker: WakeSender,
    next: u64,
    _service: TopicService<Scan>,
    /// The topic `status`, which every hub has. If it did not exist, a gateway would repeatedly try to open it.
    _status: TopicService<Status>,
    _node: Node,
    _lock: HubLock,
}

impl ScanSource {
    pub(crate) fn open(domain: &Domain) -> Outcome<ScanSource> {
        let lock = HubLock::acquire(domain.root())?;
        let node = scanhub_shm::hub_node(domain)?;
        // This is the maximum number of subscribers in any bench.
        let limits = TopicLimits { subscribers: 200, ..TopicLimits::default() };
        let waker = WakeSender::new(&node, SENSOR)?;
        let service = Scan::create(&node, SENSOR, &limits)?;
        let status = Status::create(&node, SENSOR, &limits)?;
        lock.report_ready()?;
        Ok(ScanSource {
            publisher: Scan::publisher(&service, &limits)?,
            waker,
            next: 0,
            _service: service,
            _status: status,
            _node: node,
            _lock: lock,
        })
    }

    /// Publishes a scan with `wall_ns` as its wall-clock stamp, and wakes the subscribers.
    pub(crate) fn publish(&mut self, wall_ns: u64) -> Outcome<()> {
        let scan = scan();
        let loan = Scan::loan(&self.publisher, scan.bytes().len());
        let mut sample = loan.map_err(|error| format!("no loan: {error:?}"))?;
        let header = Header { seq: self.next, topic_seq: self.next, boot: 1, wall_ns, ..Header::default() };
        self.next += 1;
        *sample.user_header_mut() = header;
        let to = Scan::write(&mut sample).begin(**scan);
        to.ranges.copy_from_slice(scan.ranges());
        sample.send().map_err(|error| format!("not sent: {error:?}"))?;
        self.waker.ring(DoorbellWord::First);
        self.waker.notify(WakeEvent::Telegram)?;
        Ok(())
    }
}

/// Returns a scan of 361 beams in millimeters, which is what scanners send by default.
pub(crate) fn scan() -> Box<Scan> {
    let ranges: [u16; 361] = std::array::from_fn(|beam| 1000 + beam as u16);
    Scan::of(ScanHead::lms(ranges.len(), -90_000, 500, 1, 13), &ranges)
}
