//! The publishing end of one topic: numbers its samples, writes them in place, counts those without memory. Refuses to know
//! what is in a sample, and when its consumers are woken.

use std::fmt::Debug;

use super::{
    BytesMut, LoanError, Node, Payload, PortFactory, Publisher, SampleMut, SendError, TopicService,
    UpdateConnections, ZeroCopySend,
};
use crate::{Failure, Header, Kind, Topic};

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
    ///
    /// # Errors
    ///
    /// Why one of them could not be connected.
    pub fn connect(&self) -> Result<(), impl Debug + use<P>> {
        self.publisher.update_connections()
    }

    /// Returns the number of samples that were not sent for lack of memory.
    pub fn failed(&self) -> u64 {
        self.failed
    }

    /// Sends a written `sample` with `header` but for its number in the topic, which is the next one. Returns how many
    /// consumers got it.
    ///
    /// # Errors
    ///
    /// The library's. The number is used up, and the sample counts as failed.
    pub fn send_loan(&mut self, mut sample: SampleMut<P>, header: &Header) -> Result<usize, SendError> {
        *sample.user_header_mut() = Header { topic_seq: self.next, ..*header };
        self.next += 1;
        sample.send().inspect_err(|_| self.failed += 1)
    }

    /// Uses up a number for a sample that there is no memory for.
    pub fn fail(&mut self) {
        self.next += 1;
        self.failed += 1;
    }
}

impl<P: Payload + ZeroCopySend + Default> TopicPublisher<P> {
    /// Returns the memory of a sample, with a payload's default in it.
    ///
    /// # Errors
    ///
    /// The library's, if there is none.
    pub fn loan(&self) -> Result<SampleMut<P>, LoanError> {
        self.publisher.loan()
    }

    /// Sends a sample that `fill` writes in place, beginning with a payload's default; else as
    /// [`send_loan`](TopicPublisher::send_loan).
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if there is no memory for it. Its number is used up.
    pub fn send(&mut self, header: &Header, fill: impl FnOnce(&mut P)) -> Result<usize, Failure> {
        let mut sample = self.loan().map_err(|error| self.short(&error))?;
        fill(sample.payload_mut());
        self.send_loan(sample, header).map_err(|error| short(P::TOPIC, &error))
    }
}

impl TopicPublisher<[u8]> {
    /// Returns the memory of a sample of `len` bytes.
    ///
    /// # Errors
    ///
    /// The library's, if there is none, or if that is more than [`Telegram::MAX`](crate::Telegram::MAX).
    pub fn loan_bytes(&self, len: usize) -> Result<BytesMut, LoanError> {
        self.publisher.loan_slice_uninit(len)
    }

    /// Sends `bytes` as a sample; else as [`send`](TopicPublisher::send).
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if there is no memory for it, or it is longer than [`Telegram::MAX`](crate::Telegram::MAX).
    pub fn send_bytes(&mut self, header: &Header, bytes: &[u8]) -> Result<usize, Failure> {
        let loan = self.loan_bytes(bytes.len()).map_err(|error| self.short(&error))?;
        self.send_loan(loan.write_from_slice(bytes), header).map_err(|error| short(<[u8]>::TOPIC, &error))
    }
}

impl<P: Payload + ?Sized> TopicPublisher<P> {
    fn short(&mut self, error: &LoanError) -> Failure {
        self.fail();
        short(P::TOPIC, error)
    }
}

fn short(topic: Topic, error: &dyn Debug) -> Failure {
    let what = format!("a sample of {} was not sent: {error:?}", topic.name());
    Failure::new(Kind::Short, what, "drop samples that are held, or free some of /dev/shm")
}
