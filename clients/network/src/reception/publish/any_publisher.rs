//! A topic of a remote sensor in shared memory, of whichever kind. Refuses to know what is in a sample.

use scanhub_client::{Publication, SensorPublisher};
use scanhub_schema::datagram::Packed;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Header, Topic};
use scanhub_shm::Payload;

/// What is published from a payload as it stands in a datagram.
trait Unpacked {
    /// Publishes the `payload`, which was checked. What fails is counted by the topic.
    fn publish(&mut self, header: &Header, payload: &[u8]);
}

impl<P: Payload + Packed + ?Sized> Unpacked for Publication<P> {
    fn publish(&mut self, header: &Header, payload: &[u8]) {
        let Some(len) = P::room(payload) else { return self.skip(1) };
        let _ = self.send_len_with(header, len, |sample| {
            let _ = sample.unpack(payload);
        });
    }
}

/// Declares the publisher of any topic from the table of topics.
macro_rules! publishers {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// A topic of any kind.
        pub(super) enum AnyPublisher { $($topic(Publication<scanhub_schema::payload_type!($payload)>),)* }

        impl AnyPublisher {
            /// `topic` of `sensor`, for samples as long as `limits` say.
            pub(super) fn new(
                topic: Topic,
                sensor: &SensorPublisher,
                limits: &TopicLimits,
            ) -> Result<AnyPublisher, Failure> {
                Ok(match topic { $(Topic::$topic => AnyPublisher::$topic(sensor.topic_for(limits)?),)* })
            }

            /// Widens `limits` until `topic` has room for `payload`; whether they had not.
            pub(super) fn widen(topic: Topic, limits: &mut TopicLimits, payload: &[u8]) -> bool {
                match topic { $(Topic::$topic => {
                    type P = scanhub_schema::payload_type!($payload);
                    if P::room(payload).is_none_or(|len| len <= topic.longest(limits)) {
                        return false;
                    }
                    P::widen(limits, payload);
                })* }
                true
            }

            /// Publishes the `payload` of this topic, as it stands in a datagram.
            pub(super) fn publish(&mut self, header: &Header, payload: &[u8]) {
                match self { $(AnyPublisher::$topic(topic) => Unpacked::publish(topic, header, payload),)* }
            }

            /// Uses up `count` numbers without a sample.
            pub(super) fn skip(&mut self, count: u64) {
                match self { $(AnyPublisher::$topic(topic) => topic.skip(count),)* }
            }

            /// Number of the next sample.
            pub(super) fn next_number(&self) -> u64 {
                match self { $(AnyPublisher::$topic(topic) => topic.next_number(),)* }
            }

            /// Connects who came since, and gives them what the topic keeps for late joiners.
            pub(super) fn connect(&self) {
                match self { $(AnyPublisher::$topic(topic) => topic.connect(),)* }
            }

            /// Samples for which there was no memory.
            pub(super) fn failed(&self) -> u64 {
                match self { $(AnyPublisher::$topic(topic) => topic.failed(),)* }
            }
        }
    };
}

scanhub_schema::for_each_topic!(publishers);
