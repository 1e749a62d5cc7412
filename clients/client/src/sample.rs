//! Samples of any topic, and their sources, for programs that subscribe to topics of several kinds.

use std::time::Duration;

use bytemuck::bytes_of;
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::{Header, ROBOT, Topic};
use scanhub_shm::Payload;

use crate::error::Error;
use crate::robot::{RobotSource, RobotUpdate};
use crate::session::Session;
use crate::silence::Silence;
use crate::subscribe::Subscribe;
use crate::topic_reader::Received;
use crate::zones::{ZonesSource, ZonesUpdate};

/// Selects the type by which a topic is subscribed. Zones become stale, so they have their own type.
macro_rules! kind {
    (Zones $payload:tt) => {
        ZonesUpdate
    };
    ($topic:ident $payload:tt) => {
        scanhub_schema::payload_type!($payload)
    };
}

/// Declares the samples and sources of all topics, and of the combined verdict, from the table of topics.
macro_rules! samples {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Received sample of one of the topics, or of the combined verdict of a robot.
        pub enum Sample {
            $(#[doc = $about] $topic(<kind!($topic $payload) as Subscribe>::Item),)*
            /// Combined zones of a robot's sensors.
            Robot(RobotUpdate),
        }

        impl Sample {
            fn any(&self) -> &dyn AnySample {
                match self {
                    $(Sample::$topic(sample) => sample,)*
                    Sample::Robot(sample) => sample,
                }
            }
        }

        /// Source of the samples of a topic, or of the combined verdict of a robot.
        pub enum Source {
            $(#[doc = $about] $topic(<kind!($topic $payload) as Subscribe>::Source),)*
            /// Combined zones of a robot's sensors.
            Robot(RobotSource),
        }

        impl Source {
            /// Creates the source of `topic` of `sensor`. The zones of `robot` are the combined zones of all sensors.
            pub fn new(sensor: &str, topic: Topic) -> Source {
                match topic {
                    Topic::Zones if sensor == ROBOT => Source::Robot(RobotSource::new(&[])),
                    $(Topic::$topic => Source::$topic(<<kind!($topic $payload) as Subscribe>::Source>::new(sensor)),)*
                }
            }

            /// Returns whether the topic has existed at least once.
            pub fn subscribed(&self) -> bool {
                match self {
                    $(Source::$topic(source) => source.subscribed(),)*
                    Source::Robot(source) => source.subscribed(),
                }
            }

            /// Returns why no sample arrives, as [`TopicReader::why_silent`](crate::streams::TopicReader::why_silent)
            /// does.
            pub fn why_silent(&mut self, session: &mut Session) -> Silence {
                match self {
                    $(Source::$topic(source) => source.why_silent(session),)*
                    Source::Robot(source) => source.why_silent(session),
                }
            }

            /// Returns the next sample that has arrived.
            ///
            /// # Errors
            ///
            /// Returns the errors of [`TopicReader::receive`](crate::streams::TopicReader::receive).
            pub fn receive(&mut self, session: &mut Session) -> Result<Option<Sample>, Error> {
                Ok(match self {
                    $(Source::$topic(source) => source.receive(session)?.map(Sample::$topic),)*
                    Source::Robot(source) => source.receive(session)?.map(Sample::Robot),
                })
            }
        }
    };
}

scanhub_schema::for_each_topic!(samples);

impl Source {
    /// Creates the source of the zones and early warnings of `sensor`. A warning makes the verdict worse until the
    /// zones of its scan arrive or the hub withdraws it.
    pub fn zones_with_early(sensor: &str) -> Source {
        match sensor {
            ROBOT => Source::Robot(RobotSource::new(&[]).with_early()),
            sensor => Source::Zones(ZonesSource::new(sensor).with_early(sensor)),
        }
    }

    /// Returns the time after which the source may report a silence. `None` if it reports no silences.
    pub fn time_left(&self) -> Option<Duration> {
        match self {
            Source::Zones(source) => source.time_left(),
            Source::Robot(source) => source.time_left(),
            _ => None,
        }
    }
}

impl Sample {
    /// Returns the header, with numbers, stamps and quality. `None` if the sample stands for a silence.
    pub fn header(&self) -> Option<&Header> {
        self.any().header()
    }

    /// Returns how many samples were missed before this one: they were sent, but not received.
    pub fn missed(&self) -> u64 {
        self.any().missed()
    }

    /// Returns the nominal time between two scans, in us; 0 if it is unknown.
    pub fn period_us(&self) -> u32 {
        self.header().map_or(0, |header| header.period_us)
    }

    /// Returns whether the sample was sent before `since_ns` of CLOCK_MONOTONIC. If `since_ns` is the time of the
    /// subscription, the topic kept such a sample for late joiners.
    pub fn is_older_than(&self, since_ns: u64) -> bool {
        self.header().is_some_and(|header| header.stamp_last_ns < since_ns)
    }

    /// Returns whether the sample stands for a silence, and was not sent.
    pub fn is_silence(&self) -> bool {
        self.header().is_none()
    }

    /// Returns the payload as it is in memory. For a robot, it is the payload of the sensor that sent the sample.
    pub fn bytes(&self) -> &[u8] {
        self.any().bytes()
    }

    /// Writes the payload in the format of datagrams to the beginning of `room`, and returns its length in bytes.
    /// `None` if `room` is too short.
    pub fn pack(&self, room: &mut [u8]) -> Option<usize> {
        self.any().pack(room)
    }

    /// Writes the payload as [`pack`](Self::pack) does, but zones as the hub published them, even if they were too old
    /// on arrival.
    pub fn pack_as_published(&self, room: &mut [u8]) -> Option<usize> {
        match self {
            Sample::Zones(sample) => sample.as_published.pack(room),
            other => other.pack(room),
        }
    }
}

/// Properties that all samples have.
trait AnySample {
    fn header(&self) -> Option<&Header>;
    fn missed(&self) -> u64;
    fn bytes(&self) -> &[u8];
    fn pack(&self, room: &mut [u8]) -> Option<usize>;
}

impl<P: Payload + DatagramPayload + ?Sized> AnySample for Received<P> {
    fn header(&self) -> Option<&Header> {
        Some(self.header())
    }

    fn missed(&self) -> u64 {
        self.missed
    }

    fn bytes(&self) -> &[u8] {
        Payload::bytes(&**self)
    }

    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        (**self).pack(room)
    }
}

impl AnySample for ZonesUpdate {
    fn header(&self) -> Option<&Header> {
        self.header.as_ref()
    }

    fn missed(&self) -> u64 {
        self.missed
    }

    fn bytes(&self) -> &[u8] {
        bytes_of(&self.zones)
    }

    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        self.zones.pack(room)
    }
}

impl AnySample for RobotUpdate {
    fn header(&self) -> Option<&Header> {
        self.update.header.as_ref()
    }

    fn missed(&self) -> u64 {
        self.update.missed
    }

    fn bytes(&self) -> &[u8] {
        bytes_of(&self.update.zones)
    }

    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        self.update.zones.pack(room)
    }
}
