//! Publisher of one topic of a link. It takes the loan for a sample before the sample arrives, so that a telegram does
//! not have to wait for memory.
//!
//! iceoryx2 has the list of subscribers in a page of its own for each topic, and each send visits the slots of all
//! possible subscribers. After a pause, neither is in the processor's cache. The publisher therefore stores how many
//! subscribers its topic had at the last [check](PreparedPublisher::find_subscribers), and uses iceoryx2 only if it had
//! any.

use std::fmt::Debug;

use scanhub_schema::limits::history_len;
use scanhub_schema::{Failure, Header};
use scanhub_shm::{Payload, PendingWakeups, SampleTransport, TopicPublisher};

use crate::platform::Platform;

/// Publisher of one topic, which takes a loan before the sample arrives.
///
/// While a topic without a history has no subscriber, its samples are not sent, and their sequence numbers are skipped.
pub(crate) struct PreparedPublisher<P: Payload + ?Sized, M: SampleTransport<P>> {
    topic: TopicPublisher<P, M>,
    /// Number of subscribers at the last check.
    subscribers: usize,
    /// Number of subscribers that got the last sample.
    reached: usize,
    /// Loan for the next sample. It has the length of the last one, `last_len`.
    prepared: Option<M::Loan>,
    last_len: usize,
}

/// Loan of a sample.
pub(crate) enum Loan<P: Payload + ?Sized, M: SampleTransport<P>> {
    /// Memory that the sample is written into.
    Taken(M::Loan),
    /// There is no memory for the sample.
    NoMemory,
    /// The topic has no subscriber.
    NoSubscriber,
}

impl<P: Payload + ?Sized, M: SampleTransport<P>> PreparedPublisher<P, M> {
    /// Opens the topic of `sensor`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`](scanhub_schema::Kind::ResourceExhausted) if no memory or descriptors are
    /// left.
    pub(crate) fn new(platform: &impl Platform<Transport<P> = M>, sensor: &str) -> Result<Self, Failure> {
        let topic = TopicPublisher::with_transport(platform.transport::<P>(sensor)?);
        Ok(PreparedPublisher { topic, subscribers: 0, reached: 0, prepared: None, last_len: 0 })
    }

    /// Counts the subscribers of the topic, and connects new ones. New subscribers of a topic with a history are
    /// connected later: by [`connect`](Self::connect), or when the next sample is sent.
    pub(crate) fn find_subscribers(&mut self) {
        self.subscribers = self.topic.subscribers();
        if self.subscribers > 0 && history_len(P::TOPIC) == 0 {
            self.connect();
        }
    }

    /// Takes a loan for the sample that is about to arrive, if samples of the topic are sent. The loan has the length
    /// of the last sample. Taking the loan also brings the slots of the subscribers into the processor's cache.
    pub(crate) fn prepare(&mut self) {
        if self.prepared.is_none() && self.is_sent() {
            self.prepared = self.topic.loan(self.last_len).ok();
        }
    }

    /// Takes a loan for the next sample. `len` is its size in bytes if the payload has no fixed size.
    pub(crate) fn loan(&mut self, len: usize) -> Loan<P, M> {
        if !self.is_sent() {
            return Loan::NoSubscriber;
        }
        if self.last_len != len {
            self.last_len = len;
            self.prepared = None;
        }
        self.prepared.take().or_else(|| self.topic.loan(len).ok()).map_or(Loan::NoMemory, Loan::Taken)
    }

    /// Sends a sample from [`loan`](Self::loan), and notes in `due` which doorbell has to ring.
    pub(crate) fn send(&mut self, loan: Loan<P, M>, header: &Header, due: &mut PendingWakeups) {
        match loan {
            Loan::Taken(loan) => {
                // If sending fails, the topic counts the failure.
                if let Ok(reached) = self.topic.send_loan(loan, header) {
                    self.reached = reached;
                    due.note_sample(P::TOPIC, reached);
                    if reached < self.subscribers {
                        self.note_departure();
                    }
                }
            }
            Loan::NoMemory => self.topic.count_failed(),
            Loan::NoSubscriber => self.skip(),
        }
    }

    /// Skips the sequence number of a sample that is not sent, because the topic has no subscriber.
    pub(crate) fn skip(&mut self) {
        self.topic.skip_numbers(1);
        self.reached = 0;
    }

    /// Returns the number of samples that were dropped because there was no memory.
    pub(crate) fn failed(&self) -> u64 {
        self.topic.failed()
    }

    /// Returns whether the topic had a subscriber at the last check.
    pub(crate) fn has_subscribers(&self) -> bool {
        self.subscribers > 0
    }

    /// Returns whether a subscriber got the last sample.
    pub(crate) fn has_reached(&self) -> bool {
        self.reached > 0
    }

    /// Returns the number of attached subscribers that did not get the last sample.
    pub(crate) fn undelivered(&self) -> usize {
        let has_begun = self.topic.next_number() > 0;
        if has_begun { self.subscribers.saturating_sub(self.reached) } else { 0 }
    }

    /// Connects new subscribers, and gives them the history of the topic.
    pub(crate) fn connect(&self) {
        if let Err(error) = self.topic.connect() {
            log_unconnected(&error);
        }
    }

    /// Returns whether samples are sent: the topic has a subscriber, or a history for later subscribers.
    pub(crate) fn is_sent(&self) -> bool {
        history_len(P::TOPIC) > 0 || self.subscribers > 0
    }

    /// Counts the subscribers again, because a subscriber did not get a sample: it has left, or it cannot be connected.
    #[cold]
    fn note_departure(&mut self) {
        self.subscribers = self.topic.subscribers();
    }
}

impl<M: SampleTransport<[u8]>> PreparedPublisher<[u8], M> {
    /// Publishes `bytes` if the topic has a subscriber.
    pub(crate) fn send_bytes(&mut self, bytes: &[u8], header: &Header, due: &mut PendingWakeups) {
        let mut loan = self.loan(bytes.len());
        if let Some(payload) = loan.payload_mut() {
            payload.copy_from_slice(bytes);
        }
        self.send(loan, header, due);
    }
}

impl<P: Payload + ?Sized, M: SampleTransport<P>> Loan<P, M> {
    /// Returns the payload, if there is memory for it.
    pub(crate) fn payload_mut(&mut self) -> Option<&mut P> {
        match self {
            Loan::Taken(loan) => Some(M::payload_mut(loan)),
            Loan::NoMemory | Loan::NoSubscriber => None,
        }
    }
}

#[cold]
fn log_unconnected(error: &dyn Debug) {
    tracing::debug!(?error, "a subscriber could not be connected");
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::convert::Infallible;
    use std::rc::Rc;

    use scanhub_schema::Marks;
    use scanhub_shm::{LoanError, SendError};

    use super::*;

    /// Transport that counts the calls of its functions.
    #[derive(Clone, Default)]
    struct CountingMedium {
        subscribers: Rc<Cell<usize>>,
        calls: Rc<Cell<usize>>,
    }

    impl CountingMedium {
        fn count(&self) {
            self.calls.set(self.calls.get() + 1);
        }
    }

    impl SampleTransport<Marks> for CountingMedium {
        type Loan = Box<Marks>;

        fn subscribers(&self) -> usize {
            self.count();
            self.subscribers.get()
        }

        fn connect(&self) -> Result<(), impl Debug + use<>> {
            self.count();
            Ok::<(), Infallible>(())
        }

        fn loan(&self, _: usize) -> Result<Box<Marks>, LoanError> {
            self.count();
            Ok(Box::default())
        }

        fn payload_mut(loan: &mut Box<Marks>) -> &mut Marks {
            loan
        }

        fn send(&self, _: Box<Marks>, _: &Header) -> Result<usize, SendError> {
            self.count();
            Ok(self.subscribers.get())
        }
    }

    #[test]
    fn uses_a_topic_only_while_it_has_a_subscriber() {
        let medium = CountingMedium::default();
        let topic = TopicPublisher::with_transport(medium.clone());
        let mut publisher =
            PreparedPublisher { topic, subscribers: 0, reached: 0, prepared: None, last_len: 0 };
        let publish = |publisher: &mut PreparedPublisher<Marks, CountingMedium>| {
            let mut due = PendingWakeups::default();
            publisher.prepare();
            let loan = publisher.loan(0);
            publisher.send(loan, &Header::default(), &mut due);
            medium.calls.take()
        };
        publisher.find_subscribers();
        assert_eq!((medium.calls.take(), publish(&mut publisher)), (1, 0));
        medium.subscribers.set(2);
        publisher.find_subscribers();
        assert_eq!((medium.calls.take(), publish(&mut publisher)), (2, 2), "one loan, one send");
        assert_eq!((publisher.reached, publisher.undelivered()), (2, 0));
        medium.subscribers.set(0);
        assert_eq!(publish(&mut publisher), 3, "the last subscriber has left");
        assert_eq!((publish(&mut publisher), publisher.topic.next_number()), (0, 4));
    }
}
