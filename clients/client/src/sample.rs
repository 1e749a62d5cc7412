//! A sample of any topic, and its source: for verbs that follow topics of several kinds.

use std::time::Duration;

use schema::datagram::Packed;
use schema::ipc::Payload;
use schema::{Background, Failure, Foreground, Header, Marks, ROBOT, Scan, Status, Topic};

use crate::follower::{Follower, Received};
use crate::robot::{RobotHeard, RobotSource};
use crate::session::Session;
use crate::zones::{Heard, ZonesSource};

/// Declares once what a name may stand for: the sample, and the source that it comes from.
macro_rules! samples {
    ($($kind:ident $sample:ty, $source:ty;)*) => {
        /// A received sample of one of the topics, or of several sensors combined.
        pub enum Sample { $(#[doc = concat!("Of `", stringify!($kind), "`.")] $kind($sample),)* }

        impl Sample {
            /// Numbers, stamps and quality; nothing if it was not sent but marks a silence.
            pub fn header(&self) -> Option<&Header> {
                match self { $(Sample::$kind(sample) => Told::header(sample),)* }
            }

            /// Samples that were sent before this one and not received.
            pub fn missed(&self) -> u64 {
                match self { $(Sample::$kind(sample) => sample.missed(),)* }
            }
        }

        /// Follows what one name stands for.
        pub enum Source { $(#[doc = concat!("Of `", stringify!($kind), "`.")] $kind($source),)* }

        impl Source {
            /// The topic has existed at least once.
            pub fn subscribed(&self) -> bool {
                match self { $(Source::$kind(source) => source.subscribed(),)* }
            }

            /// The next waiting sample, or nothing; failures as [`Follower::receive`].
            pub fn receive(&mut self, session: &mut Session) -> Result<Option<Sample>, Failure> {
                Ok(match self { $(Source::$kind(source) => source.receive(session)?.map(Sample::$kind),)* })
            }
        }
    };
}

samples! {
    Telegram Received<[u8]>, Follower<[u8]>;
    Scan Received<Scan>, Follower<Scan>;
    Marks Received<Marks>, Follower<Marks>;
    Zones Heard, ZonesSource;
    Foreground Received<Foreground>, Follower<Foreground>;
    Background Received<Background>, Follower<Background>;
    Status Received<Status>, Follower<Status>;
    Robot RobotHeard, RobotSource;
}

impl Source {
    /// Follows `topic` of `sensor`; the zones of `robot` are those of all sensors combined.
    pub fn new(sensor: &str, topic: Topic) -> Source {
        match topic {
            Topic::Telegram => Source::Telegram(Follower::new(sensor)),
            Topic::Scan => Source::Scan(Follower::new(sensor)),
            Topic::Marks => Source::Marks(Follower::new(sensor)),
            Topic::Zones if sensor == ROBOT => Source::Robot(RobotSource::new(&[])),
            Topic::Zones => Source::Zones(ZonesSource::new(sensor)),
            Topic::Foreground => Source::Foreground(Follower::new(sensor)),
            Topic::Background => Source::Background(Follower::new(sensor)),
            Topic::Status => Source::Status(Follower::new(sensor)),
        }
    }

    /// After this time there may be something to receive although nothing was sent.
    pub fn left(&self) -> Option<Duration> {
        match self {
            Source::Zones(source) => source.left(),
            Source::Robot(source) => source.left(),
            _ => None,
        }
    }
}

impl Sample {
    /// Nominal time between two scans, in us; 0 unknown.
    pub fn period_us(&self) -> u32 {
        self.header().map_or(0, |header| header.period_us)
    }

    /// It was sent before `since_ns` of CLOCK_MONOTONIC: the topic keeps it for late consumers, or it waited.
    pub fn is_of_before(&self, since_ns: u64) -> bool {
        self.header().is_some_and(|header| header.stamp_last_ns < since_ns)
    }

    /// It was not sent: it marks a silence.
    pub fn is_silence(&self) -> bool {
        self.header().is_none()
    }

    /// The payload as it is in memory; for the verdict over several sensors, that of the sensor whose data arrived.
    pub fn bytes(&self) -> &[u8] {
        match self {
            Sample::Telegram(sample) => sample,
            Sample::Scan(sample) => bytemuck::bytes_of::<Scan>(sample),
            Sample::Marks(sample) => bytemuck::bytes_of::<Marks>(sample),
            Sample::Zones(sample) => bytemuck::bytes_of(&sample.zones),
            Sample::Foreground(sample) => bytemuck::bytes_of::<Foreground>(sample),
            Sample::Background(sample) => bytemuck::bytes_of::<Background>(sample),
            Sample::Status(sample) => bytemuck::bytes_of::<Status>(sample),
            Sample::Robot(sample) => bytemuck::bytes_of(&sample.heard.zones),
        }
    }
}

impl Sample {
    /// Writes the payload as it is sent over a network to the start of `room`; returns its length, or `None` if there is
    /// too little room.
    pub fn pack(&self, room: &mut [u8]) -> Option<usize> {
        match self {
            Sample::Telegram(sample) => {
                room.get_mut(..sample.len())?.copy_from_slice(sample);
                Some(sample.len())
            }
            Sample::Scan(sample) => sample.pack(room),
            Sample::Marks(sample) => sample.pack(room),
            Sample::Zones(sample) => sample.zones.pack(room),
            Sample::Foreground(sample) => sample.pack(room),
            Sample::Background(sample) => sample.pack(room),
            Sample::Status(sample) => sample.pack(room),
            Sample::Robot(sample) => sample.heard.zones.pack(room),
        }
    }
}

impl Sample {
    /// As [`pack`](Self::pack), but zones as the hub sent them, however old they were on arrival here.
    pub fn pack_said(&self, room: &mut [u8]) -> Option<usize> {
        match self {
            Sample::Zones(sample) => sample.said.pack(room),
            other => other.pack(room),
        }
    }
}

/// What every sample provides.
trait Told {
    fn header(&self) -> Option<&Header>;
    fn missed(&self) -> u64;
}

impl<P: Payload + ?Sized> Told for Received<P> {
    fn header(&self) -> Option<&Header> {
        Some(self.header())
    }

    fn missed(&self) -> u64 {
        self.missed
    }
}

impl Told for Heard {
    fn header(&self) -> Option<&Header> {
        self.header.as_ref()
    }

    fn missed(&self) -> u64 {
        self.missed
    }
}

impl Told for RobotHeard {
    fn header(&self) -> Option<&Header> {
        self.heard.header.as_ref()
    }

    fn missed(&self) -> u64 {
        self.heard.missed
    }
}
