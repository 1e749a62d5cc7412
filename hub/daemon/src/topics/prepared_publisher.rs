//! What a link adds to the publishing end of a topic: a loan is ready before it is needed, and nothing is sent that nobody
//! would get. Refuses to know what is in a sample.
//!
//! What a topic does not keep for late joiners is not sent while nobody is attached; its number is used up. Sending looks
//! at the places of all consumers that there may be, and no processor has them at hand after a pause.

use schema::ipc::{DueRings, Medium, Payload, TopicPublisher};
use schema::limits::history;
use schema::{Failure, Header};

use crate::surroundings::Surroundings;

/// One topic of one sensor.
pub(super) struct PreparedPublisher<P: Payload + ?Sized, M: Medium<P>> {
    topic: TopicPublisher<P, M>,
    /// Consumers that got the last sample.
    reached: usize,
    /// Loaned while there was time, for the sample that is coming: as long as the last one.
    prepared: Option<M::Loan>,
    last_len: usize,
}

impl<P: Payload + ?Sized, M: Medium<P>> PreparedPublisher<P, M> {
    /// The topic of `sensor`.
    pub(super) fn new(around: &impl Surroundings<Medium<P> = M>, sensor: &str) -> Result<Self, Failure> {
        let topic = TopicPublisher::over(around.medium::<P>(sensor)?);
        Ok(PreparedPublisher { topic, reached: 0, prepared: None, last_len: 0 })
    }

    /// Takes a loan for the sample that will be there in a moment, and connects who came.
    pub(super) fn prepare(&mut self) {
        if self.prepared.is_none() && self.is_wanted() {
            self.prepared = self.topic.loan(self.last_len).ok();
        }
        // Now, not while the telegram waits; and what sending looks at is near the processor.
        self.connect();
    }

    /// The next sample; one without a size of its own is `len` bytes.
    pub(super) fn loan(&mut self, len: usize) -> Loan<M::Loan> {
        if !self.is_wanted() {
            return Loan::Unwanted;
        }
        if self.last_len != len {
            self.last_len = len;
            self.prepared = None;
        }
        self.prepared.take().or_else(|| self.topic.loan(len).ok()).map_or(Loan::Lacking, Loan::Taken)
    }

    /// Where to write `loan`, if anywhere.
    pub(super) fn payload_mut(loan: &mut Loan<M::Loan>) -> Option<&mut P> {
        match loan {
            Loan::Taken(loan) => Some(M::payload_mut(loan)),
            Loan::Lacking | Loan::Unwanted => None,
        }
    }

    /// Ends the sample that [`loan`](Self::loan) began, under its number. Who has to be woken for it is noted in `due`.
    pub(super) fn send(&mut self, loan: Loan<M::Loan>, header: &Header, due: &mut DueRings) {
        match loan {
            Loan::Taken(loan) => {
                // One that fails is counted by the topic.
                if let Ok(reached) = self.topic.send_loan(loan, header) {
                    self.reached = reached;
                    due.note(P::TOPIC, reached);
                }
            }
            Loan::Lacking => self.topic.fail(),
            Loan::Unwanted => self.skip(),
        }
    }

    /// A sample is not made. Its number is used up: nobody is there to miss it.
    pub(super) fn skip(&mut self) {
        self.topic.skip(1);
        self.reached = 0;
    }

    /// Samples without memory.
    pub(super) fn failed(&self) -> u64 {
        self.topic.failed()
    }

    /// Whether a sample is made at all: somebody is attached, or whoever comes will want it.
    fn is_wanted(&self) -> bool {
        history(P::TOPIC) > 0 || self.is_heard()
    }

    /// Whether anybody is attached.
    pub(super) fn is_heard(&self) -> bool {
        self.topic.subscribers() > 0
    }

    /// Whether anybody got the last sample.
    pub(super) fn has_reached(&self) -> bool {
        self.reached > 0
    }

    /// Consumers that are attached and did not get the last sample.
    pub(super) fn missed_out(&self) -> usize {
        let has_begun = self.topic.next_number() > 0;
        if has_begun { self.topic.subscribers().saturating_sub(self.reached) } else { 0 }
    }

    /// Connects who came since, and gives them what the topic keeps for late joiners.
    pub(super) fn connect(&self) {
        if let Err(error) = self.topic.connect() {
            tracing::debug!(?error, "a consumer could not be connected");
        }
    }
}

impl<M: Medium<[u8]>> PreparedPublisher<[u8], M> {
    /// Publishes `bytes`, if anybody is attached.
    pub(super) fn send_bytes(&mut self, bytes: &[u8], header: &Header, due: &mut DueRings) {
        let mut loan = self.loan(bytes.len());
        if let Some(payload) = Self::payload_mut(&mut loan) {
            payload.copy_from_slice(bytes);
        }
        self.send(loan, header, due);
    }
}

/// A sample in the making.
pub(super) enum Loan<L> {
    /// It is written in place.
    Taken(L),
    /// There is no memory for it.
    Lacking,
    /// Nobody would get it.
    Unwanted,
}
