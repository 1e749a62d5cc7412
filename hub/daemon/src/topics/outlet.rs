//! The publishing end of one topic: numbers its samples, has a loan ready before it is needed, knows whether anybody is
//! there. Refuses to know what is in a sample.

use schema::ipc::{
    Node, Payload, PortFactory, Publisher, SampleMut, SendError, TopicService, UpdateConnections,
    ZeroCopySend,
};
use schema::{Failure, Header};

/// One topic of one sensor.
pub(super) struct Outlet<P: Payload + ?Sized> {
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

impl<P: Payload + ?Sized> Outlet<P> {
    /// The topic of `sensor`.
    pub(super) fn new(node: &Node, sensor: &str) -> Result<Self, Failure> {
        let service = P::create(node, sensor)?;
        let publisher = P::publisher(&service)?;
        Ok(Outlet { publisher, service, next: 0, reached: 0, prepared: None, failed: 0 })
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

    /// Whether anybody is attached.
    pub(super) fn is_followed(&self) -> bool {
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

impl<P: Payload + ZeroCopySend + Default> Outlet<P> {
    /// Takes a loan for the sample that will be there in a moment, and connects who came.
    pub(super) fn prepare(&mut self) {
        if self.prepared.is_none() {
            self.prepared = self.publisher.loan().ok();
        }
        // Now, not while the telegram waits; and what sending looks at is near the processor.
        self.connect();
    }

    /// A sample to write; nothing if there is no memory for it.
    pub(super) fn loan(&mut self) -> Option<SampleMut<P>> {
        self.prepared.take().or_else(|| self.publisher.loan().ok())
    }

    /// Sends what [`loan`](Self::loan) gave, under its number.
    pub(super) fn send(&mut self, loan: Option<SampleMut<P>>, header: &Header) {
        let topic_seq = self.take_number();
        let Some(mut sample) = loan else {
            self.failed += 1;
            return;
        };
        *sample.user_header_mut() = Header { topic_seq, ..*header };
        self.note(sample.send());
    }
}
