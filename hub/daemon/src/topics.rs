//! The topics of one link: numbers every sample, fills it in place, sends it, wakes the consumers. A sample for which
//! there is no memory is counted and its number used up, so that consumers see the gap; nothing ever waits for one.

use lms::session::Received;
use schema::ipc::{
    self, BytesMut, Node, Notifier, Payload, PortFactory, Publisher, SampleMut, TopicService,
    UpdateConnections, WakeService,
};
use schema::{Failure, Flags, Header, Quality, Scan, Status, Wake};

use crate::clock;

/// The publishing end of one sensor; stays in its link's thread.
pub(crate) struct Topics {
    telegram: Outlet<[u8]>,
    scan: Outlet<Scan>,
    /// Loaned while there was time, for the telegram that is coming.
    next_telegram: Option<BytesMut>,
    next_scan: Option<SampleMut<Scan>>,
    /// Length of the last telegram.
    last_len: usize,
    status: Outlet<Status>,
    notifier: Notifier,
    _wake: WakeService,
    /// What the next sample's header begins with.
    header: Header,
    next_seq: u64,
    /// Samples without memory.
    pub(crate) loan_failed: u64,
}

struct Outlet<P: Payload + ?Sized> {
    publisher: Publisher<P>,
    service: TopicService<P>,
    next: u64,
    reached: usize,
}

impl<P: Payload + ?Sized> Outlet<P> {
    fn new(node: &Node, sensor: &str) -> Result<Self, Failure> {
        let service = P::create(node, sensor)?;
        Ok(Outlet { publisher: P::publisher(&service)?, service, next: 0, reached: 0 })
    }

    fn take_number(&mut self) -> u64 {
        let number = self.next;
        self.next += 1;
        number
    }

    /// Consumers that are attached and did not get the last sample.
    fn missed_out(&self) -> usize {
        let attached = self.service.dynamic_config().number_of_subscribers();
        if self.next > 0 { attached.saturating_sub(self.reached) } else { 0 }
    }
}

impl Topics {
    /// Makes the topics of `sensor`, number `number` in the configuration, for the hub's life `boot`.
    pub(crate) fn new(node: &Node, sensor: &str, number: u8, boot: u64) -> Result<Self, Failure> {
        let wake = ipc::create_wake(node, sensor)?;
        let header = Header { sensor: number, boot, hub_pid: std::process::id(), ..Header::default() };
        Ok(Topics {
            telegram: Outlet::new(node, sensor)?,
            scan: Outlet::new(node, sensor)?,
            next_telegram: None,
            next_scan: None,
            last_len: 0,
            status: Outlet::new(node, sensor)?,
            notifier: ipc::notifier(&wake)?,
            _wake: wake,
            header,
            next_seq: 0,
            loan_failed: 0,
        })
    }

    /// What all samples from now on have in common: bits of [`Flags`].
    pub(crate) fn set_flags(&mut self, flags: u16) {
        self.header.flags = flags;
    }

    /// Takes loans for a telegram as long as the last one and for its scan, which will be there in a moment.
    pub(crate) fn prepare(&mut self) {
        if self.next_telegram.is_none() {
            self.next_telegram = self.telegram.publisher.loan_slice_uninit(self.last_len).ok();
        }
        if self.next_scan.is_none() {
            self.next_scan = self.scan.publisher.loan().ok();
        }
        // Who came is connected now, not while the telegram waits; and what sending looks at is near the processor.
        connect(&self.telegram.publisher);
        connect(&self.scan.publisher);
    }

    /// Publishes the telegram and takes its number and stamps for all that follows from it.
    /// `reasons` are why it is suspect.
    pub(crate) fn telegram(&mut self, received: &Received<'_>, reasons: u8, period_us: u32) {
        self.header.seq = self.next_seq;
        self.next_seq += 1;
        self.header.stamp_first_ns = received.first;
        self.header.stamp_last_ns = received.last;
        self.header.wall_ns = clock::wall(received.first);
        self.header.period_us = period_us;
        let quality = if reasons == 0 { Quality::Clean } else { Quality::Suspect };
        self.header.quality = quality as u8;
        self.header.reasons = reasons;
        self.header.flags &= !Flags::STAMP_ESTIMATED;
        self.header.flags |= if received.estimated { Flags::STAMP_ESTIMATED } else { 0 };
        let bytes = received.telegram.bytes();
        let header = Header { topic_seq: self.telegram.take_number(), ..self.header };
        self.last_len = bytes.len();
        let prepared = self.next_telegram.take().filter(|loan| loan.payload().len() == bytes.len());
        let Some(loan) = prepared.or_else(|| self.telegram.publisher.loan_slice_uninit(bytes.len()).ok())
        else {
            self.loan_failed += 1;
            return;
        };
        let mut sample = loan.write_from_slice(bytes);
        *sample.user_header_mut() = header;
        match sample.send() {
            Ok(reached) => self.telegram.reached = reached,
            Err(_) => self.loan_failed += 1,
        }
    }

    /// Publishes a scan of the last telegram, which `fill` writes in place.
    pub(crate) fn scan(&mut self, fill: impl FnOnce(&mut Scan)) {
        let topic_seq = self.scan.take_number();
        let Some(mut sample) = self.next_scan.take().or_else(|| self.scan.publisher.loan().ok()) else {
            self.loan_failed += 1;
            return;
        };
        fill(sample.payload_mut());
        *sample.user_header_mut() = Header { topic_seq, ..self.header };
        match sample.send() {
            Ok(reached) => self.scan.reached = reached,
            Err(_) => self.loan_failed += 1,
        }
    }

    /// Publishes the status as of `now`.
    pub(crate) fn status(&mut self, status: &Status, now: u64) {
        let topic_seq = self.status.take_number();
        let header = Header {
            topic_seq,
            stamp_first_ns: now,
            stamp_last_ns: now,
            wall_ns: clock::wall(now),
            quality: Quality::Clean as u8,
            reasons: 0,
            ..self.header
        };
        let Ok(mut sample) = self.status.publisher.loan() else {
            self.loan_failed += 1;
            return;
        };
        *sample.payload_mut() = *status;
        *sample.user_header_mut() = header;
        match sample.send() {
            Ok(reached) => self.status.reached = reached,
            Err(_) => self.loan_failed += 1,
        }
    }

    /// Wakes whoever sleeps; once per telegram, after its last sample.
    pub(crate) fn wake(&self, why: Wake) {
        if let Err(failure) = ipc::notify(&self.notifier, why) {
            tracing::debug!(%failure, "some consumers were not woken");
        }
    }

    /// Gives late joiners what they would else get with the next status.
    pub(crate) fn greet(&self) {
        connect(&self.status.publisher);
    }

    /// Consumers that got nothing although they are attached: their descriptors or ours ran out, and sending says Ok
    /// all the same.
    pub(crate) fn unreached(&self) -> usize {
        self.telegram.missed_out().max(self.scan.missed_out()).max(self.status.missed_out())
    }
}

fn connect(publisher: &impl UpdateConnections) {
    if let Err(error) = publisher.update_connections() {
        tracing::debug!(?error, "a consumer could not be connected");
    }
}
