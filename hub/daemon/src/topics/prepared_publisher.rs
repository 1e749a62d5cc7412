//! What a link adds to the publishing end of a topic: a loan is ready before it is needed, and nothing is sent that nobody
//! would get. Refuses to know what is in a sample.
//!
//! What a topic does not keep for late joiners is not sent while nobody is attached; its number is used up. Sending looks
//! at the places of all consumers that there may be, and no processor has them at hand after a pause.

use schema::ipc::{BytesMut, Node, Payload, SampleMut, TopicPublisher, ZeroCopySend};
use schema::limits::history;
use schema::{Failure, Header};

/// One topic of one sensor.
pub(super) struct PreparedPublisher<P: Payload + ?Sized> {
    topic: TopicPublisher<P>,
    /// Consumers that got the last sample.
    reached: usize,
    /// Loaned while there was time, for the sample that is coming.
    prepared: Option<SampleMut<P>>,
}

impl<P: Payload + ?Sized> PreparedPublisher<P> {
    /// The topic of `sensor`.
    pub(super) fn new(node: &Node, sensor: &str) -> Result<Self, Failure> {
        Ok(PreparedPublisher { topic: TopicPublisher::new(node, sensor)?, reached: 0, prepared: None })
    }

    /// Uses up a number without a sample: nobody is there to miss it.
    fn skip(&mut self) {
        self.topic.skip(1);
        self.reached = 0;
    }

    /// Sends a written sample; one that fails is counted.
    fn send_loan(&mut self, sample: SampleMut<P>, header: &Header) {
        if let Ok(reached) = self.topic.send_loan(sample, header) {
            self.reached = reached;
        }
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

impl<P: Payload + ZeroCopySend + Default> PreparedPublisher<P> {
    /// Takes a loan for the sample that will be there in a moment, and connects who came.
    pub(super) fn prepare(&mut self) {
        if self.prepared.is_none() && self.is_wanted() {
            self.prepared = self.topic.loan().ok();
        }
        // Now, not while the telegram waits; and what sending looks at is near the processor.
        self.connect();
    }

    /// The next sample.
    pub(super) fn loan(&mut self) -> Loan<P> {
        if !self.is_wanted() {
            return Loan::Unwanted;
        }
        self.prepared.take().or_else(|| self.topic.loan().ok()).map_or(Loan::Lacking, Loan::Taken)
    }

    /// Ends the sample that [`loan`](Self::loan) began, under its number.
    pub(super) fn send(&mut self, loan: Loan<P>, header: &Header) {
        match loan {
            Loan::Taken(sample) => self.send_loan(sample, header),
            Loan::Lacking => self.topic.fail(),
            Loan::Unwanted => self.skip(),
        }
    }
}

/// The same for telegrams, whose length is known when they are there.
pub(super) struct TelegramPublisher {
    pub(super) telegrams: PreparedPublisher<[u8]>,
    /// Loaned while there was time, as long as the last telegram.
    prepared: Option<BytesMut>,
    last_len: usize,
}

impl TelegramPublisher {
    /// The topic of `sensor`.
    pub(super) fn new(node: &Node, sensor: &str) -> Result<Self, Failure> {
        let telegrams = PreparedPublisher::new(node, sensor)?;
        Ok(TelegramPublisher { telegrams, prepared: None, last_len: 0 })
    }

    /// Takes a loan for a telegram as long as the last one, and connects who came.
    pub(super) fn prepare(&mut self) {
        if self.prepared.is_none() && self.telegrams.is_wanted() {
            self.prepared = self.telegrams.topic.loan_bytes(self.last_len).ok();
        }
        self.telegrams.connect();
    }

    /// Publishes `bytes`, if anybody is attached.
    pub(super) fn send(&mut self, bytes: &[u8], header: &Header) {
        self.last_len = bytes.len();
        if !self.telegrams.is_wanted() {
            return self.telegrams.skip();
        }
        let prepared = self.prepared.take().filter(|loan| loan.payload().len() == bytes.len());
        match prepared.or_else(|| self.telegrams.topic.loan_bytes(bytes.len()).ok()) {
            Some(loan) => self.telegrams.send_loan(loan.write_from_slice(bytes), header),
            None => self.telegrams.topic.fail(),
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
