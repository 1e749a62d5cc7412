//! Sending end of a network: it converts samples of a hub's sensors to complete datagrams, thinned and numbered, and
//! announces the sensors.
//!
//! Samples and time are arguments. Datagrams go to a [`Transmit`] at once, or wait until [`Outgoing::take_next`] takes
//! them.

mod datagram_writer;
mod sensor;

use std::num::NonZeroU64;
use std::time::Duration;

use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::{Header, Topic};

use crate::lan::WallTimestamp;
use datagram_writer::DatagramWriter;
pub use datagram_writer::{Form, QueuedSample, SensorStats, TopicStats, Transmit};
use sensor::Sensor;

/// Sending end of one gateway in one run.
pub struct Outgoing {
    writer: DatagramWriter,
    sensors: Vec<Sensor>,
}

/// Interval between the announcements of a sensor.
pub const ANNOUNCEMENT_INTERVAL: Duration = Duration::from_secs(1);

/// A sample of a topic, or a silence.
#[derive(Clone, Copy, Debug)]
pub struct Sample<'a> {
    /// Header of the sample. `None` for a silence: the payload does not come from a hub, and states that the verdict is
    /// unknown.
    pub header: Option<&'a Header>,
    /// Number of samples of the topic that the hub sent before this one, and that were missed here.
    pub missed: u64,
    /// Payload, which determines the topic.
    pub payload: PayloadRef<'a>,
}

/// Generates [`PayloadRef`] from the table of topics.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Payload of any topic.
        #[derive(Clone, Copy, Debug)]
        pub enum PayloadRef<'a> {
            $(#[doc = $about] $topic(&'a scanhub_schema::payload_type!($payload)),)*
        }

        impl PayloadRef<'_> {
            /// Returns the topic of the payload.
            pub fn topic(self) -> Topic {
                match self { $(PayloadRef::$topic(_) => Topic::$topic,)* }
            }

            /// Writes the payload in its form for networks to the start of `room`, and returns its length. `None` if
            /// there is too little room.
            pub fn pack(self, room: &mut [u8]) -> Option<usize> {
                match self { $(PayloadRef::$topic(payload) => payload.pack(room),)* }
            }
        }
    };
}

scanhub_schema::for_each_topic!(payloads);

impl Outgoing {
    /// Creates the sending end of gateway `hub` in its run `epoch`. Datagrams have at most `longest` bytes, and never
    /// more than [`MTU_ETHERNET`](scanhub_schema::datagram::MTU_ETHERNET).
    pub fn new(hub: u64, epoch: u32, form: Form, longest: usize) -> Outgoing {
        Outgoing { writer: DatagramWriter::new(hub, epoch, form, longest), sensors: Vec::new() }
    }

    /// Creates the sending end of gateway `hub` in its run `epoch` for a connection that is slow at times. The newest
    /// sample of each sensor and topic waits until [`take_next`](Outgoing::take_next) takes it. Each sample is one
    /// datagram, however long the sample is.
    pub fn with_queue(hub: u64, epoch: u32) -> Outgoing {
        Outgoing { writer: DatagramWriter::with_queue(hub, epoch), sensors: Vec::new() }
    }

    /// Adds the sensor called `name`. `every` returns the thinning factor of a topic, or `None` if the topic is not
    /// sent. Returns the sensor's position, which identifies it from now on.
    pub fn follow(&mut self, name: &str, every: impl Fn(Topic) -> Option<NonZeroU64>) -> usize {
        self.sensors.push(Sensor::new(name, every));
        self.sensors.len() - 1
    }

    /// Returns the position of the sensor called `name`, if it was added.
    pub fn position(&self, name: &str) -> Option<usize> {
        self.sensors.iter().position(|sensor| sensor.name == name)
    }

    /// Returns whether samples of `topic` are needed, because they are sent, or because announcements contain a value
    /// from them.
    pub fn needs(&self, sensor: usize, topic: Topic) -> bool {
        let is_announced = self.writer.announces();
        self.sensors[sensor].sends(topic) || is_announced && topic == Topic::Status
    }

    /// Sends a sample of the sensor at this position, or a silence of its zones, to `to`. Before the first sample of
    /// each run of the hub, an announcement is sent. Nothing is sent if the sample is thinned out, is a background that
    /// was sent before, or comes from another machine.
    pub fn sample(&mut self, sensor: usize, sample: &Sample<'_>, now: WallTimestamp, to: &mut impl Transmit) {
        self.sensors[sensor].send(sample, now, &mut self.writer, to);
    }

    /// Announces all sensors that have sent a sample. Call this method every [`ANNOUNCEMENT_INTERVAL`], and at the end
    /// of the run.
    pub fn announce(&mut self, now: WallTimestamp, to: &mut impl Transmit) {
        self.sensors.iter().for_each(|sensor| sensor.announce(now, &mut self.writer, to));
    }

    /// Sends each background again whose last transmission is `every` or longer ago.
    pub fn repeat(&mut self, every: Duration, now: WallTimestamp, to: &mut impl Transmit) {
        self.sensors.iter_mut().for_each(|sensor| sensor.repeat(every, now, &mut self.writer, to));
    }

    /// Takes the sample that has waited for longest, numbers it, and returns its datagram for sending at `now`. `None`
    /// if no sample waits.
    pub fn take_next(&mut self, now: WallTimestamp) -> Option<QueuedSample<'_>> {
        self.writer.take_next(now)
    }

    /// Returns whether a sample waits.
    pub fn is_waiting(&self) -> bool {
        self.writer.is_waiting()
    }

    /// Counts the last sample that [`take_next`](Outgoing::take_next) returned for this sensor and topic, of `bytes`
    /// bytes, as failed. Its sequence number is not used again.
    pub fn mark_failed(&mut self, sensor: u8, topic: Option<Topic>, bytes: usize) {
        self.writer.mark_failed(sensor, topic, bytes);
    }

    /// Returns the datagram that [`take_next`](Outgoing::take_next) returned last for the sensor called `name` and
    /// `topic`: its status, its background or, without a topic, its announcement. Call this method when a receiver
    /// queries the datagram, at `now`. The datagram keeps its sequence number, so that receivers count it once.
    pub fn resend_last(&mut self, name: &str, topic: Option<Topic>, now: WallTimestamp) -> Option<&[u8]> {
        self.writer.resend_last(name, topic, now)
    }

    /// Returns the sensors and topics (`None`: announcements) for which [`resend_last`](Outgoing::resend_last) has a
    /// sample. The announcement of a sensor comes before its samples.
    pub fn stored_samples(&self) -> impl Iterator<Item = (&str, Option<Topic>)> {
        self.writer.stored_samples()
    }

    /// Drops the samples that are kept for [`resend_last`](Outgoing::resend_last).
    pub fn drop_kept(&mut self) {
        self.writer.drop_kept();
    }

    /// Returns whether there is a queue, in which newer samples replace older ones. Announcements then contain the
    /// number of replaced samples.
    pub(crate) fn announces_replaced(&self) -> bool {
        self.writer.counts_replaced()
    }

    /// Returns the maximum length of a datagram, in bytes.
    pub fn max_datagram_len(&self) -> usize {
        self.writer.max_datagram_len()
    }

    /// Returns the counters of each sensor, in the order of the sensors' numbers in the hub.
    pub fn counters(&self) -> impl Iterator<Item = &SensorStats> {
        self.writer.sensors()
    }

    /// Returns the number of samples that did not fit into the maximum number of parts.
    pub fn oversized_samples(&self) -> u64 {
        self.writer.oversized_samples()
    }

    /// Returns the `SENSOR/TOPIC` of a sample that did not fit into datagrams. Returns each name only once.
    pub(crate) fn take_oversized(&mut self) -> Option<String> {
        self.writer.take_oversized()
    }
}

#[cfg(test)]
mod tests;
