//! The publishing end of one topic: numbers its samples, writes them in place, counts those without memory. Refuses to know
//! what is in a sample, and when its consumers are woken.

use std::fmt::Debug;
use std::marker::PhantomData;

use super::{
    LoanError, Node, Payload, PortFactory, Publisher, SampleMut, SendError, TopicService, UpdateConnections,
    places,
};
use crate::limits::TopicLimits;
use crate::{Failure, Header, Kind, Topic};

/// What carries the samples of a topic: [`SharedMemory`], or in a simulation the memory of its own process.
pub trait Medium<P: Payload + ?Sized> {
    /// A sample that is not sent yet.
    type Loan;

    /// Returns the number of consumers that follow the topic.
    fn subscribers(&self) -> usize;

    /// Connects consumers that came since the last sample, and hands them what the topic keeps for late joiners.
    ///
    /// # Errors
    ///
    /// Why one of them could not be connected.
    fn connect(&self) -> Result<(), impl Debug + use<Self, P>>;

    /// Returns the memory of a sample, with a payload's default in it; bytes are `len`.
    ///
    /// # Errors
    ///
    /// The library's, if there is none.
    fn loan(&self, len: usize) -> Result<Self::Loan, LoanError>;

    /// Returns the payload of `loan`, to be written in place.
    fn payload_mut(loan: &mut Self::Loan) -> &mut P;

    /// Sends `loan` with `header`. Returns how many consumers got it.
    ///
    /// # Errors
    ///
    /// The library's.
    fn send(&self, loan: Self::Loan, header: &Header) -> Result<usize, SendError>;
}

/// A topic in the shared memory of a domain.
#[derive(Debug)]
pub struct SharedMemory<P: Payload + ?Sized> {
    publisher: Publisher<P>,
    service: TopicService<P>,
}

impl<P: Payload + ?Sized> SharedMemory<P> {
    /// Makes the topic of `sensor` that carries `P`, as `limits` say, or takes over that of a dead process. What wakes its consumers
    /// ([`Waker`](super::Waker)) is made before it.
    ///
    /// # Errors
    ///
    /// [`Kind::DomainHeld`] if somebody publishes the topic, [`Kind::Short`] if memory or descriptors are short,
    /// [`Kind::Failed`] if the topic is there with another layout.
    pub fn new(node: &Node, sensor: &str, limits: &TopicLimits) -> Result<Self, Failure> {
        let service = P::create(node, sensor, limits)?;
        Ok(SharedMemory { publisher: P::publisher(&service, limits)?, service })
    }

    /// Returns the number of consumers that there are places for. It is not that of the limits where the topic was taken over.
    pub fn places(&self) -> usize {
        places::<P>(&self.service)
    }
}

impl<P: Payload + ?Sized> Medium<P> for SharedMemory<P> {
    type Loan = SampleMut<P>;

    fn subscribers(&self) -> usize {
        self.service.dynamic_config().number_of_subscribers()
    }

    fn connect(&self) -> Result<(), impl Debug + use<P>> {
        self.publisher.update_connections()
    }

    fn loan(&self, len: usize) -> Result<SampleMut<P>, LoanError> {
        P::loan(&self.publisher, len)
    }

    fn payload_mut(loan: &mut SampleMut<P>) -> &mut P {
        P::write(loan)
    }

    fn send(&self, mut loan: SampleMut<P>, header: &Header) -> Result<usize, SendError> {
        *loan.user_header_mut() = *header;
        loan.send()
    }
}

/// Publishes the samples of one topic of one sensor. Their numbers begin at 0 and have a gap where samples were lost before
/// they could be sent.
#[derive(Debug)]
pub struct TopicPublisher<P: Payload + ?Sized, M = SharedMemory<P>> {
    medium: M,
    next: u64,
    failed: u64,
    payload: PhantomData<fn(&P)>,
}

impl<P: Payload + ?Sized> TopicPublisher<P> {
    /// Publishes into shared memory, else as [`over`](TopicPublisher::over).
    ///
    /// # Errors
    ///
    /// As [`SharedMemory::new`].
    pub fn new(node: &Node, sensor: &str, limits: &TopicLimits) -> Result<Self, Failure> {
        SharedMemory::new(node, sensor, limits).map(TopicPublisher::over)
    }
}

impl<P: Payload + ?Sized, M: Medium<P>> TopicPublisher<P, M> {
    /// Publishes over `medium`; the first sample has number 0.
    pub fn over(medium: M) -> Self {
        TopicPublisher { medium, next: 0, failed: 0, payload: PhantomData }
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
        self.medium.subscribers()
    }

    /// Connects consumers that came since the last sample, and hands them what the topic keeps for late joiners. One that
    /// cannot be connected now is tried again with the next sample.
    ///
    /// # Errors
    ///
    /// Why one of them could not be connected.
    pub fn connect(&self) -> Result<(), impl Debug + use<P, M>> {
        self.medium.connect()
    }

    /// Returns the number of samples that were not sent for lack of memory.
    pub fn failed(&self) -> u64 {
        self.failed
    }

    /// Returns the memory of a sample, with a payload's default in it; bytes are `len`, any other payload has its own
    /// length.
    ///
    /// # Errors
    ///
    /// The library's, if there is none, or if bytes are more than [`Telegram::MAX`](crate::Telegram::MAX).
    pub fn loan(&self, len: usize) -> Result<M::Loan, LoanError> {
        self.medium.loan(len)
    }

    /// Sends a written `loan` with `header` but for its number in the topic, which is the next one. Returns how many
    /// consumers got it.
    ///
    /// # Errors
    ///
    /// The library's. The number is used up, and the sample counts as failed.
    pub fn send_loan(&mut self, loan: M::Loan, header: &Header) -> Result<usize, SendError> {
        let header = Header { topic_seq: self.next, ..*header };
        self.next += 1;
        self.medium.send(loan, &header).inspect_err(|_| self.failed += 1)
    }

    /// Uses up a number for a sample that there is no memory for.
    pub fn fail(&mut self) {
        self.next += 1;
        self.failed += 1;
    }

    /// Sends a sample of `len` bytes, or of the payload's own length, that `fill` writes in place, beginning with a payload's
    /// default; else as [`send_loan`](TopicPublisher::send_loan).
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if there is no memory for it, or it is longer than the topic was made for. Its number is used up.
    pub fn send_len(
        &mut self,
        header: &Header,
        len: usize,
        fill: impl FnOnce(&mut P),
    ) -> Result<usize, Failure> {
        let mut loan = self.loan(len).map_err(|error| {
            self.fail();
            short(P::TOPIC, &error)
        })?;
        fill(M::payload_mut(&mut loan));
        self.send_loan(loan, header).map_err(|error| short(P::TOPIC, &error))
    }
}

impl<P: Payload, M: Medium<P>> TopicPublisher<P, M> {
    /// Sends a sample that `fill` writes in place, beginning with a payload's default; else as
    /// [`send_loan`](TopicPublisher::send_loan).
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if there is no memory for it. Its number is used up.
    pub fn send(&mut self, header: &Header, fill: impl FnOnce(&mut P)) -> Result<usize, Failure> {
        self.send_len(header, 0, fill)
    }
}

impl<M: Medium<[u8]>> TopicPublisher<[u8], M> {
    /// Sends `bytes` as a sample; else as [`send`](TopicPublisher::send).
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if there is no memory for it, or it is longer than [`Telegram::MAX`](crate::Telegram::MAX).
    pub fn send_bytes(&mut self, header: &Header, bytes: &[u8]) -> Result<usize, Failure> {
        self.send_len(header, bytes.len(), |sample| sample.copy_from_slice(bytes))
    }
}

fn short(topic: Topic, error: &dyn Debug) -> Failure {
    let what = format!("a sample of {} was not sent: {error:?}", topic.name());
    Failure::new(Kind::Short, what, "drop samples that are held, or free some of /dev/shm")
}
