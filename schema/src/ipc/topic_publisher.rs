//! The publishing end of one topic: numbers its samples, writes them in place, counts those without memory. Refuses to know
//! what is in a sample, and when its consumers are woken.

use super::{
    LoanError, Node, Payload, PortFactory, Publisher, TopicService, UpdateConnections, ZeroCopySend,
};
use crate::{Failure, Header, Kind};

/// Publishes the samples of one topic of one sensor. Their numbers begin at 0 and have a gap where samples were lost before
/// they could be sent.
#[derive(Debug)]
pub struct TopicPublisher<P: Payload + ?Sized> {
    publisher: Publisher<P>,
    service: TopicService<P>,
    next: u64,
    failed: u64,
}

impl<P: Payload + ?Sized> TopicPublisher<P> {
    /// Makes the topic of `sensor` that carries `P`, or takes over that of a dead process. What wakes its consumers
    /// ([`Waker`](super::Waker)) is made before it.
    ///
    /// # Errors
    ///
    /// [`Kind::DomainHeld`] if somebody publishes the topic, [`Kind::Short`] if memory or descriptors are short,
    /// [`Kind::Failed`] if the topic is there with another layout.
    pub fn new(node: &Node, sensor: &str) -> Result<Self, Failure> {
        let service = P::create(node, sensor)?;
        Ok(TopicPublisher { publisher: P::publisher(&service)?, service, next: 0, failed: 0 })
    }

    /// Returns the number that the next sample will have.
    pub fn next_number(&self) -> u64 {
        self.next
    }

    /// Uses up `count` numbers without a sample, so that consumers see `count` of them missing.
    pub fn skip(&mut self, count: u64) {
        self.next += count;
    }

    /// Returns the number of consumers that follow the topic.
    pub fn subscribers(&self) -> usize {
        self.service.dynamic_config().number_of_subscribers()
    }

    /// Connects consumers that came since the last sample, and hands them what the topic keeps for late joiners. One that
    /// cannot be connected now is tried again with the next sample.
    pub fn connect(&self) {
        let _ = self.publisher.update_connections();
    }

    /// Returns the number of samples that were not sent for lack of memory.
    pub fn failed(&self) -> u64 {
        self.failed
    }

    /// Takes the next number for a sample with `header`.
    fn number(&mut self, header: &Header) -> Header {
        self.next += 1;
        Header { topic_seq: self.next - 1, ..*header }
    }

    fn short(&mut self, error: &dyn std::fmt::Debug) -> Failure {
        self.failed += 1;
        let what = format!("a sample of {} was not sent: {error:?}", P::TOPIC.name());
        Failure::new(Kind::Short, what, "drop samples that are held, or free some of /dev/shm")
    }
}

impl<P: Payload + ZeroCopySend + Default> TopicPublisher<P> {
    /// Sends a sample that `fill` writes in place, beginning with a payload's default. It has `header` but for its number in
    /// the topic, which is the next one. Returns how many consumers got it.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if there is no memory for it. Its number is used up.
    pub fn send(&mut self, header: &Header, fill: impl FnOnce(&mut P)) -> Result<usize, Failure> {
        let header = self.number(header);
        let mut sample = match self.publisher.loan() {
            Ok(sample) => sample,
            Err(error) => return Err(self.short(&error)),
        };
        *sample.user_header_mut() = header;
        fill(sample.payload_mut());
        sample.send().map_err(|error| self.short(&error))
    }
}

impl TopicPublisher<[u8]> {
    /// Sends `bytes` as a sample; else as [`send`](TopicPublisher::send).
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if there is no memory for it, or it is longer than [`Telegram::MAX`](crate::Telegram::MAX).
    pub fn send_bytes(&mut self, header: &Header, bytes: &[u8]) -> Result<usize, Failure> {
        let header = self.number(header);
        let loan: Result<_, LoanError> = self.publisher.loan_slice_uninit(bytes.len());
        let mut sample = match loan {
            Ok(loan) => loan.write_from_slice(bytes),
            Err(error) => return Err(self.short(&error)),
        };
        *sample.user_header_mut() = header;
        sample.send().map_err(|error| self.short(&error))
    }
}
