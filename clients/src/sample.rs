//! A sample of any topic, and where such come from: for verbs that follow topics of several kinds.

use schema::ipc::Payload;
use schema::{Failure, Header, Scan, Status, Topic};

use crate::follower::{Follower, Received};
use crate::names::TopicName;
use crate::session::Session;

/// A received sample of one of the topics.
pub(crate) enum Sample {
    Telegram(Received<[u8]>),
    Scan(Received<Scan>),
    Status(Received<Status>),
}

impl Sample {
    /// Numbers, stamps and quality of the sample.
    pub(crate) fn header(&self) -> &Header {
        match self {
            Sample::Telegram(sample) => sample.header(),
            Sample::Scan(sample) => sample.header(),
            Sample::Status(sample) => sample.header(),
        }
    }

    /// Samples that were sent before this one and not received.
    pub(crate) fn missed(&self) -> u64 {
        match self {
            Sample::Telegram(sample) => sample.missed,
            Sample::Scan(sample) => sample.missed,
            Sample::Status(sample) => sample.missed,
        }
    }

    /// The payload as it lies in memory.
    pub(crate) fn bytes(&self) -> &[u8] {
        match self {
            Sample::Telegram(sample) => sample,
            Sample::Scan(sample) => bytemuck::bytes_of::<Scan>(sample),
            Sample::Status(sample) => bytemuck::bytes_of::<Status>(sample),
        }
    }
}

/// Follows one topic of any kind.
pub(crate) enum Source {
    Telegram(Follower<[u8]>),
    Scan(Follower<Scan>),
    Status(Follower<Status>),
}

impl Source {
    /// Will follow `name`.
    pub(crate) fn new(name: &TopicName) -> Source {
        match name.topic {
            Topic::Telegram => Source::Telegram(Follower::new(&name.sensor)),
            Topic::Scan => Source::Scan(Follower::new(&name.sensor)),
            Topic::Status => Source::Status(Follower::new(&name.sensor)),
        }
    }

    /// The topic has been there at least once.
    pub(crate) fn attached(&self) -> bool {
        match self {
            Source::Telegram(follower) => follower.attached(),
            Source::Scan(follower) => follower.attached(),
            Source::Status(follower) => follower.attached(),
        }
    }

    /// The next sample that waits, or nothing; failures as [`Follower::receive`].
    pub(crate) fn receive(&mut self, session: &mut Session) -> Result<Option<Sample>, Failure> {
        fn next<P: Payload + ?Sized>(
            follower: &mut Follower<P>,
            session: &mut Session,
            kind: impl FnOnce(Received<P>) -> Sample,
        ) -> Result<Option<Sample>, Failure> {
            Ok(follower.receive(session)?.map(kind))
        }
        match self {
            Source::Telegram(follower) => next(follower, session, Sample::Telegram),
            Source::Scan(follower) => next(follower, session, Sample::Scan),
            Source::Status(follower) => next(follower, session, Sample::Status),
        }
    }
}
