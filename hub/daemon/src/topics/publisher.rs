//! The publishing end of one topic: numbers its samples, has a loan ready before it is needed, knows whether anybody is
//! there. Refuses to know what is in a sample.
//!
//! What a topic does not keep for late joiners is not sent while nobody is attached; its number is used up. Sending looks
//! at the places of all consumers that there may be, and no processor has them at hand after a pause.

use schema::ipc::{
    Node, Payload, PortFactory, Publisher, SampleMut, SendError, TopicService, UpdateConnections,
    ZeroCopySend,
};
use schema::limits::history;
use schema::{Failure, Header};

/// One topic of one sensor.
pub(super) struct TopicPublisher<P: Payload + ?Sized> {
    pub(super) publisher: Publisher<P>,
    service: TopicService<P>,
    /// The number of the next sample.
    next: u64,
    /// Consumers that got the last sample.
    reached: usize,
    /// Loaned while there was time, for the sample that is coming.
    prepared: Option<SampleMut<P>>,
    /// Samples without memory.
    pub(super) failed: u64,
}

impl<P: Payload + ?Sized> TopicPublisher<P> {
    /// The topic of `sensor`.
    pub(super) fn new(node: &Node, sensor: &str) -> Result<Self, Failure> {
        let service = P::create(node, sensor)?;
        let publisher = P::publisher(&service)?;
        Ok(TopicPublisher { publisher, service, next: 0, reached: 0, prepared: None, failed: 0 })
    }

    /// The number of the sample that is being made.
    pub(super) fn take_number(&mut self) -> u64 {
        self.next += 1;
        self.next - 1
    }

    /// Uses up a number without a sample: nobody is there to miss it.
    pub(super) fn skip(&mut self) {
        self.next += 1;
        self.reached = 0;
    }

    /// Notes what came of sending.
    pub(super) fn note(&mut self, outcome: Result<usize, SendError>) {
        match outcome {
            Ok(reached) => self.reached = reached,
            Err(_) => self.failed += 1,
        }
    }

    /// Whether a sample is made at all: somebody is attached, or whoever comes will want it.
    pub(super) fn is_wanted(&self) -> bool {
        history(P::TOPIC) > 0 || self.is_heard()
    }

    /// Whether anybody is attached.
    pub(super) fn is_heard(&self) -> bool {
        self.subscribers() > 0
    }

    /// Consumers that are attached and did not get the last sample.
    pub(super) fn missed_out(&self) -> usize {
        if self.next > 0 { self.subscribers().saturating_sub(self.reached) } else { 0 }
    }

    /// Connects who came since, and gives them what the topic keeps for late joiners.
    pub(super) fn connect(&self) {
        if let Err(error) = self.publisher.update_connections() {
            tracing::debug!(?error, "a consumer could not be connected");
        }
    }

    fn subscribers(&self) -> usize {
        self.service.dynamic_config().number_of_subscribers()
    }
}

impl<P: Payload + ZeroCopySend + Default> TopicPublisher<P> {
    /// Takes a loan for the sample that will be there in a moment, and connects who came.
    pub(super) fn prepare(&mut self) {
        if self.prepared.is_none() && self.is_wanted() {
            self.prepared = self.publisher.loan().ok();
        }
        // Now, not while the telegram waits; and what sending looks at is near the processor.
        self.connect();
    }

    /// The next sample.
    pub(super) fn loan(&mut self) -> Loan<P> {
        if !self.is_wanted() {
            return Loan::Unwanted;
        }
        self.prepared.take().or_else(|| self.publisher.loan().ok()).map_or(Loan::Lacking, Loan::Taken)
    }

    /// Ends the sample that [`loan`](Self::loan) began, under its number.
    pub(super) fn send(&mut self, loan: Loan<P>, header: &Header) {
        let topic_seq = self.take_number();
        match loan {
            Loan::Taken(mut sample) => {
                *sample.user_header_mut() = Header { topic_seq, ..*header };
                self.note(sample.send());
            }
            Loan::Lacking => self.failed += 1,
            Loan::Unwanted => self.reached = 0,
        }
    }
}

/// A sample in the making.
pub(super) enum Loan<P: Payload> {
    /// It is written in place.
    Taken(SampleMut<P>),
    /// There is no memory for it.
    Lacking,
    /// Nobody would get it.
    Unwanted,
}

impl<P: Payload + ZeroCopySend> Loan<P> {
    /// Where to write it, if anywhere.
    pub(super) fn payload_mut(&mut self) -> Option<&mut P> {
        match self {
            Loan::Taken(sample) => Some(sample.payload_mut()),
            Loan::Lacking | Loan::Unwanted => None,
        }
    }
}
