//! A topic that is being published: its samples get headers and numbers, and wake who follows it. Refuses to know who else
//! publishes.

use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Header, Maker, Topic, Wake};
use scanhub_shm::Domain;
use scanhub_shm::{Payload, TopicPublisher};

use super::{PublishSession, SensorPublisher};
use crate::clock;

/// A topic that is being published.
pub struct Publication<P: Payload + ?Sized> {
    // Before what wakes its consumers, and before the session.
    topic: TopicPublisher<P>,
    sensor: SensorPublisher,
}

impl<P: Payload + ?Sized> Publication<P> {
    /// Publishes as [`publish`](crate::publish) does, in `domain`.
    ///
    /// # Errors
    ///
    /// As [`publish`](crate::publish).
    pub fn in_domain(domain: &Domain, name: &str) -> Result<Publication<P>, Failure> {
        let (topics, limits) = ([P::TOPIC], TopicLimits::default());
        if P::TOPIC.maker() == Maker::Link {
            return PublishSession::open(domain, &topics, limits)?.sensor(name)?.topic();
        }
        PublishSession::beside(domain, name, &topics, limits)?.topic()
    }

    pub(super) fn new(topic: TopicPublisher<P>, sensor: SensorPublisher) -> Publication<P> {
        Publication { topic, sensor }
    }

    /// Returns the header of a sample that is made now: both stamps are this moment, on CLOCK_MONOTONIC, and its number is
    /// the next one.
    pub fn header(&self) -> Header {
        let now_ns = clock::now_ns();
        let number = self.topic.next_number();
        Header {
            seq: number,
            topic_seq: number,
            stamp_first_ns: now_ns,
            stamp_last_ns: now_ns,
            wall_ns: clock::wall_ns(),
            boot: self.sensor.0.membership.boot,
            hub_pid: std::process::id(),
            ..Header::default()
        }
    }

    /// Returns the header of a sample of what was so at `stamp_ns` on CLOCK_MONOTONIC, else as [`header`](Self::header).
    pub fn header_at(&self, stamp_ns: u64) -> Header {
        let now = self.header();
        let wall_ns = now.wall_ns.wrapping_sub(now.stamp_last_ns.wrapping_sub(stamp_ns));
        Header { stamp_first_ns: stamp_ns, stamp_last_ns: stamp_ns, wall_ns, ..now }
    }

    /// Uses up `count` numbers without a sample: consumers see `count` of them missing.
    pub fn skip(&mut self, count: u64) {
        self.topic.skip(count);
    }

    /// Returns the number that the next sample will have: from 0, as they are sent.
    pub fn next_number(&self) -> u64 {
        self.topic.next_number()
    }

    /// Returns the number of consumers that follow the topic.
    pub fn subscribers(&self) -> usize {
        self.topic.subscribers()
    }

    /// Connects consumers that came since the last sample, and hands them what the topic keeps for late joiners. Of a topic
    /// that is seldom sent, call it ten times a second.
    pub fn connect(&self) {
        // One that cannot be connected now is tried again with the next sample.
        let _ = self.topic.connect();
    }

    /// Returns the number of samples that were not sent for lack of memory.
    pub fn failed(&self) -> u64 {
        self.topic.failed()
    }

    /// Sends a sample of `len` bytes that `fill` writes in place, beginning with all of them 0, and wakes the consumers: for
    /// payloads without a size of their own, such as a scan.
    ///
    /// # Errors
    ///
    /// As [`send`](Publication::send); also [`Kind::Short`](scanhub_schema::Kind) if it is longer than the topic was made for.
    pub fn send_len(&mut self, len: usize, fill: impl FnOnce(&mut P)) -> Result<(), Failure> {
        let header = self.header();
        self.send_len_with(&header, len, fill)?;
        self.sensor.wake(Wake::Telegram)
    }

    /// Sends as [`send_len`](Self::send_len), with `header` but for the sample's number in the topic, and wakes nobody. Returns
    /// how many consumers got it.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if there is no memory for it, or it is longer than the topic was made for: its number is
    /// used up.
    pub fn send_len_with(
        &mut self,
        header: &Header,
        len: usize,
        fill: impl FnOnce(&mut P),
    ) -> Result<usize, Failure> {
        self.topic.send_len(header, len, fill).inspect(|&reached| self.sensor.note(P::TOPIC, reached))
    }
}

impl<P: Payload> Publication<P> {
    /// Sends a sample that `fill` writes in place, beginning with the payload's default, and wakes the consumers.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if there is no memory for it: its number is used up. Else as
    /// [`SensorPublisher::wake`].
    pub fn send(&mut self, fill: impl FnOnce(&mut P)) -> Result<(), Failure> {
        let header = self.header();
        self.send_with(&header, fill)?;
        self.sensor.wake(Wake::Telegram)
    }

    /// Sends as [`send`](Self::send) what was so at `stamp_ns` on CLOCK_MONOTONIC, such as the angle of a mount when it was
    /// measured.
    ///
    /// # Errors
    ///
    /// As [`send`](Self::send).
    pub fn send_at(&mut self, stamp_ns: u64, fill: impl FnOnce(&mut P)) -> Result<(), Failure> {
        let header = self.header_at(stamp_ns);
        self.send_with(&header, fill)?;
        self.sensor.wake(Wake::Telegram)
    }

    /// Sends as [`send`](Self::send), with `header` but for the sample's number in the topic, and wakes nobody: for samples
    /// of several topics that are sent together. Returns how many consumers got it.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if there is no memory for it: its number is used up.
    pub fn send_with(&mut self, header: &Header, fill: impl FnOnce(&mut P)) -> Result<usize, Failure> {
        self.topic.send(header, fill).inspect(|&reached| self.sensor.note(P::TOPIC, reached))
    }
}

impl Publication<[u8]> {
    /// Sends `bytes` as a sample and wakes the consumers.
    ///
    /// # Errors
    ///
    /// As [`send`](Publication::send); also [`Kind::Short`](scanhub_schema::Kind) for more than
    /// [`Telegram::MAX`](scanhub_schema::Telegram::MAX) bytes.
    pub fn send_bytes(&mut self, bytes: &[u8]) -> Result<(), Failure> {
        let header = self.header();
        self.send_bytes_with(&header, bytes)?;
        self.sensor.wake(Wake::Telegram)
    }

    /// Sends `bytes` with `header`, as [`send_with`](Publication::send_with).
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if there is no memory for it, or it is longer than
    /// [`Telegram::MAX`](scanhub_schema::Telegram::MAX).
    pub fn send_bytes_with(&mut self, header: &Header, bytes: &[u8]) -> Result<usize, Failure> {
        self.topic.send_bytes(header, bytes).inspect(|&reached| self.sensor.note(Topic::Telegram, reached))
    }
}
