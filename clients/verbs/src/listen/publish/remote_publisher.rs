//! A topic of a remote sensor in shared memory. Numbers its samples so that consumers see what the network lost: they go on
//! over lives of the gateway, and begin again with each life of the hub, as a hub's own do. Refuses to know what is in a
//! sample.

use scanhub_client::{Publication, SensorPublisher};
use schema::datagram::{Packed, telegram};
use schema::ipc::{Payload, ZeroCopySend};
use schema::{Failure, Header, Topic};

use super::super::remote::Remote;
use super::arrivals::Arrivals;

/// One topic.
pub(super) struct RemotePublisher<P: Payload + ?Sized> {
    topic: Publication<P>,
    /// Life of the gateway, sensor's number there, and its own number, of the last one that came from the network. The first
    /// one has its number of the network here too, so that consumers that outlive a listener see what was lost meanwhile.
    last: Option<(u32, u8, u32)>,
    arrivals: Arrivals,
}

impl<P: Payload + ?Sized> RemotePublisher<P> {
    /// The topic of `sensor`.
    pub(super) fn new(sensor: &SensorPublisher) -> Result<Self, Failure> {
        Ok(RemotePublisher { topic: sensor.topic()?, last: None, arrivals: Arrivals::default() })
    }

    /// The header of `remote` here, with the time that is between two as they are sent. All numbers between the last one and
    /// it are left out, be they lost or not published; of a new life of the gateway all before it. Where the sensor has
    /// another number than before, those before it may have been another one's: none counts.
    pub(super) fn header(&mut self, remote: &Remote<'_>) -> Header {
        let head = &remote.datagram.head;
        let next = (head.epoch, head.sensor, head.sequence);
        let steps = self.last.and_then(|last| steps(last, next));
        let left_out = match (steps, self.last) {
            (Some(steps), _) => steps.wrapping_sub(1),
            (None, Some((epoch, ..))) if head.epoch == epoch => 0,
            (None, _) => head.sequence,
        };
        self.topic.skip(left_out.into());
        self.last = Some(next);
        let period_us = self.arrivals.period_us(remote.arrival_ns, steps.unwrap_or_default().into());
        Header { period_us, ..remote.header() }
    }

    /// Connects who came since, and gives them what the topic keeps for late joiners.
    pub(super) fn connect(&self) {
        self.topic.connect();
    }

    /// Samples for which there was no memory.
    pub(super) fn failed(&self) -> u64 {
        self.topic.failed()
    }
}
impl RemotePublisher<[u8]> {
    /// Publishes the telegram in `remote`.
    pub(super) fn publish(&mut self, remote: &Remote<'_>) {
        let header = self.header(remote);
        match telegram(remote.datagram.payload) {
            // What fails is counted by the topic.
            Some(telegram) => _ = self.topic.send_bytes_with(&header, telegram.0),
            None => self.topic.skip(1),
        }
    }
}

impl<P: Payload + ZeroCopySend + Default> RemotePublisher<P> {
    /// Publishes a sample with `header` that `fill` writes in place.
    pub(super) fn send(&mut self, header: &Header, fill: impl FnOnce(&mut P)) {
        // What fails is counted by the topic.
        let _ = self.topic.send_with(header, fill);
    }
}

impl<P: Payload + ZeroCopySend + Default + Packed> RemotePublisher<P> {
    /// Publishes what `remote` says.
    pub(super) fn publish(&mut self, remote: &Remote<'_>) {
        let header = self.header(remote);
        self.send(&header, |sample| {
            let _ = sample.unpack(remote.datagram.payload);
        });
    }
}

/// Declares the publisher of any topic from the table of topics.
macro_rules! publishers {
    ($($topic:ident $payload:tt, $name:literal, $($column:tt),*: $about:literal;)*) => {
        /// A topic of any kind.
        pub(super) enum AnyPublisher { $($topic(RemotePublisher<schema::payload_type!($payload)>),)* }

        impl AnyPublisher {
            /// `topic` of `sensor`.
            pub(super) fn new(topic: Topic, sensor: &SensorPublisher) -> Result<AnyPublisher, Failure> {
                Ok(match topic { $(Topic::$topic => AnyPublisher::$topic(RemotePublisher::new(sensor)?),)* })
            }

            /// Publishes what `remote` says, which is of this topic.
            pub(super) fn publish(&mut self, remote: &Remote<'_>) {
                match self { $(AnyPublisher::$topic(topic) => topic.publish(remote),)* }
            }

            /// As [`RemotePublisher::connect`].
            pub(super) fn connect(&self) {
                match self { $(AnyPublisher::$topic(topic) => topic.connect(),)* }
            }

            /// As [`RemotePublisher::failed`].
            pub(super) fn failed(&self) -> u64 {
                match self { $(AnyPublisher::$topic(topic) => topic.failed(),)* }
            }
        }
    };
}

schema::for_each_topic!(publishers);

/// How many numbers `next` is behind `last`, each with its epoch and the sensor's number, if both are of one count. What comes
/// late is not published: a lower number is of another sender's count, who came in the place of a silent one.
fn steps(last: (u32, u8, u32), next: (u32, u8, u32)) -> Option<u32> {
    let steps = next.2.wrapping_sub(last.2);
    ((next.0, next.1) == (last.0, last.1) && steps <= u32::MAX / 2).then_some(steps)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_begin_anew_are_of_another_count() {
        assert_eq!(steps((1, 0, 100), (1, 0, 103)), Some(3));
        assert_eq!(steps((1, 0, u32::MAX), (1, 0, 1)), Some(2));
        assert_eq!(steps((1, 0, 100), (1, 0, 20)), None);
        assert_eq!(steps((1, 0, 100), (2, 0, 103)), None);
        assert_eq!(steps((1, 0, 100), (1, 1, 103)), None);
    }
}
