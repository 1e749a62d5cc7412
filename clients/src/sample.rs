//! A sample of any topic, and where such come from: for verbs that follow topics of several kinds.

use schema::ipc::Payload;
use schema::{Background, Failure, Foreground, Header, Marks, Scan, Status, Topic, Zones};

use crate::follower::{Follower, Received};
use crate::names::TopicName;
use crate::session::Session;

/// Declares once which topics there are and what they carry.
macro_rules! samples {
    ($($topic:ident $payload:ty,)*) => {
        /// A received sample of one of the topics.
        pub(crate) enum Sample { $($topic(Received<$payload>),)* }

        impl Sample {
            /// Numbers, stamps and quality of the sample.
            pub(crate) fn header(&self) -> &Header {
                match self { $(Sample::$topic(sample) => sample.header(),)* }
            }

            /// Samples that were sent before this one and not received.
            pub(crate) fn missed(&self) -> u64 {
                match self { $(Sample::$topic(sample) => sample.missed,)* }
            }
        }

        /// Follows one topic of any kind.
        pub(crate) enum Source { $($topic(Follower<$payload>),)* }

        impl Source {
            /// Will follow `name`.
            pub(crate) fn new(name: &TopicName) -> Source {
                match name.topic { $(Topic::$topic => Source::$topic(Follower::new(&name.sensor)),)* }
            }

            /// The topic has been there at least once.
            pub(crate) fn attached(&self) -> bool {
                match self { $(Source::$topic(follower) => follower.attached(),)* }
            }

            /// The next sample that waits, or nothing; failures as [`Follower::receive`].
            pub(crate) fn receive(&mut self, session: &mut Session) -> Result<Option<Sample>, Failure> {
                match self { $(Source::$topic(follower) => next(follower, session, Sample::$topic),)* }
            }
        }
    };
}

samples! {
    Telegram [u8],
    Scan Scan,
    Marks Marks,
    Zones Zones,
    Foreground Foreground,
    Background Background,
    Status Status,
}

impl Sample {
    /// The payload as it lies in memory.
    pub(crate) fn bytes(&self) -> &[u8] {
        match self {
            Sample::Telegram(sample) => sample,
            Sample::Scan(sample) => bytemuck::bytes_of::<Scan>(sample),
            Sample::Marks(sample) => bytemuck::bytes_of::<Marks>(sample),
            Sample::Zones(sample) => bytemuck::bytes_of::<Zones>(sample),
            Sample::Foreground(sample) => bytemuck::bytes_of::<Foreground>(sample),
            Sample::Background(sample) => bytemuck::bytes_of::<Background>(sample),
            Sample::Status(sample) => bytemuck::bytes_of::<Status>(sample),
        }
    }
}

fn next<P: Payload + ?Sized>(
    follower: &mut Follower<P>,
    session: &mut Session,
    kind: impl FnOnce(Received<P>) -> Sample,
) -> Result<Option<Sample>, Failure> {
    Ok(follower.receive(session)?.map(kind))
}
