//! What the topics carry, and the service, publisher and subscriber of each kind: generated from the table of topics. Refuses
//! to know what is in a payload.

use std::borrow::BorrowMut;
use std::fmt::Debug;

use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::prelude::{AttributeVerifier, IceoryxSend};
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError,
};

use super::trouble::{Trouble, create, no_place, no_port, no_publisher, open};
use super::{
    LoanError, Node, PortFactory, Publisher, REVISION, ReceiveError, Sample, SampleMut, Subscriber,
    TopicService, name, places,
};
use crate::limits::TopicLimits;
use crate::shortage::check_client;
use crate::{Failure, Header, Kind, Topic, limits};

/// What a topic carries; implemented by `[u8]` (telegram) and the payloads of the other topics.
pub trait Payload: Debug + 'static {
    /// The topic that carries it.
    const TOPIC: Topic;

    /// As which it lies in shared memory: itself, or the words of a payload whose length goes by the number of beams.
    type Memory: IceoryxSend + Debug + ?Sized + 'static;

    /// Returns the topic of `sensor`, made as `limits` say if it is not there: for the hub. What a dead hub's consumers keep
    /// alive is reused with the places that it has.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if memory or descriptors are short, [`Kind::Failed`] if it is there with another layout.
    fn create(node: &Node, sensor: &str, limits: &TopicLimits) -> Result<TopicService<Self>, Failure>;

    /// Returns the topic of `sensor`, or nothing as long as no hub has made it: for consumers.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if memory or descriptors are short, [`Kind::Failed`] if it has another layout.
    fn open(node: &Node, sensor: &str) -> Result<Option<TopicService<Self>>, Failure>;

    /// Returns the publisher of a topic, with memory for samples as long as `limits` say.
    ///
    /// # Errors
    ///
    /// [`Kind::DomainHeld`] if the topic has a publisher already.
    fn publisher(topic: &TopicService<Self>, limits: &TopicLimits) -> Result<Publisher<Self>, Failure>;

    /// Returns a consumer's end of a topic.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if memory, descriptors or places for consumers are.
    fn subscriber(topic: &TopicService<Self>) -> Result<Subscriber<Self>, Failure>;

    /// Returns the oldest sample that waits, or nothing.
    ///
    /// # Errors
    ///
    /// [`ReceiveError::ExceedsMaxBorrows`] if [`limits::BORROWED`] samples are held; [`ReceiveError::ConnectionFailure`] if
    /// the publisher's memory cannot be mapped.
    fn receive(subscriber: &Subscriber<Self>) -> Result<Option<Sample<Self>>, ReceiveError>;

    /// Returns the payload of a sample, in shared memory.
    fn read(sample: &Sample<Self>) -> &Self;

    /// Returns the memory of a sample, with a payload's default in it; one without a size of its own is `len` bytes, at least a
    /// head.
    ///
    /// # Errors
    ///
    /// The library's, if there is none, or if `len` is more than the longest that the topic was made for.
    fn loan(publisher: &Publisher<Self>, len: usize) -> Result<SampleMut<Self>, LoanError>;

    /// Returns the payload of a sample that is not sent yet.
    fn write(loan: &mut SampleMut<Self>) -> &mut Self;

    /// A payload in the memory of this process.
    type Owned: BorrowMut<Self>;

    /// Returns a payload's default in the memory of this process; one without a size of its own is `len` bytes, at least a
    /// head.
    fn owned(len: usize) -> Self::Owned;

    /// Returns the payload as it lies in memory, as far as it is used.
    fn bytes(&self) -> &[u8];
}

/// iceoryx2 has a slice and a value behind two impl blocks of the same words; this says them once.
macro_rules! payload {
    ($payload:ty, $topic:expr, $memory:ty, $len:ident, $owned:ty, $make:expr,
        |$builder:ident, $limits:ident| $sized:expr, |$publisher:ident| $loan:expr, $read:path, $write:path, $bytes:path) => {
        impl Payload for $payload {
            const TOPIC: Topic = $topic;

            type Memory = $memory;

            fn create(
                node: &Node,
                sensor: &str,
                limits: &TopicLimits,
            ) -> Result<TopicService<Self>, Failure> {
                let (service, revision) = (name(&$topic.service(sensor))?, revision($topic)?);
                create(node, &service, || {
                    let builder = || {
                        let builder = node.service_builder(&service).publish_subscribe::<$memory>();
                        builder.user_header::<Header>()
                    };
                    let made = builder()
                        .max_publishers(limits::PUBLISHERS)
                        .max_subscribers(limits.consumers)
                        .max_nodes(limits::NODES)
                        .subscriber_max_buffer_size(limits::buffer($topic))
                        .subscriber_max_borrowed_samples(limits::BORROWED)
                        .history_size(limits::history($topic))
                        .enable_safe_overflow(true)
                        .open_or_create_with_attributes(&revision);
                    match made {
                        Err(PublishSubscribeOpenOrCreateError::PublishSubscribeOpenError(
                            PublishSubscribeOpenError::DoesNotSupportRequestedAmountOfSubscribers,
                        )) => builder().open_with_attributes(&revision).map_err(|error| error.into()),
                        made => made.map_err(Trouble::from),
                    }
                })
            }

            fn open(node: &Node, sensor: &str) -> Result<Option<TopicService<Self>>, Failure> {
                let service = name(&$topic.service(sensor))?;
                let builder = node.service_builder(&service).publish_subscribe::<$memory>();
                open(node, &service, builder.user_header::<Header>().open())
            }

            fn publisher(
                topic: &TopicService<Self>,
                $limits: &TopicLimits,
            ) -> Result<Publisher<Self>, Failure> {
                let samples = limits::samples($topic, places::<Self>(topic));
                let $builder = topic
                    .publisher_builder()
                    .max_loaned_samples(limits::LOANED)
                    .override_sample_preallocation(move |_| samples);
                $sized.create().map_err(|error| no_publisher(topic.name(), error))
            }

            fn subscriber(topic: &TopicService<Self>) -> Result<Subscriber<Self>, Failure> {
                check_client()?;
                topic.subscriber_builder().create().map_err(|error| match error {
                    SubscriberCreateError::ExceedsMaxSupportedSubscribers => {
                        no_place(topic.name(), places::<Self>(topic))
                    }
                    other => no_port(topic.name(), &other),
                })
            }

            fn receive(subscriber: &Subscriber<Self>) -> Result<Option<Sample<Self>>, ReceiveError> {
                subscriber.receive()
            }

            fn read(sample: &Sample<Self>) -> &Self {
                $read(sample)
            }

            fn loan($publisher: &Publisher<Self>, $len: usize) -> Result<SampleMut<Self>, LoanError> {
                $loan
            }

            fn write(loan: &mut SampleMut<Self>) -> &mut Self {
                $write(loan.payload_mut())
            }

            type Owned = $owned;

            fn owned($len: usize) -> $owned {
                $make
            }

            fn bytes(&self) -> &[u8] {
                $bytes(self)
            }
        }
    };
}

/// A payload without a size of its own is loaned in the length of the longest.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:literal, $($column:tt),*: $about:literal;)*) => {
        $(payloads!($payload, $topic);)*
    };
    ([u8], $topic:ident) => {
        payload!(
            [u8], Topic::$topic, [u8], len, Vec<u8>, vec![0; len],
            |builder, limits| builder.initial_max_slice_len(limits.telegram),
            |publisher| publisher.loan_slice(len),
            std::convert::identity, std::convert::identity, std::convert::identity
        );
    };
    (Scan, $topic:ident) => { payloads!(Scan, ScanWord, $topic); };
    (Foreground, $topic:ident) => { payloads!(Foreground, ForegroundWord, $topic); };
    (Background, $topic:ident) => { payloads!(Background, BackgroundWord, $topic); };
    (Cloud, $topic:ident) => { payloads!(Cloud, CloudWord, $topic); };
    ($payload:ident, $word:ident, $topic:ident) => {
        payload!(
            crate::$payload, Topic::$topic, [crate::$word], len, Box<crate::$payload>, crate::$payload::zeroed(len),
            |builder, limits| {
                let longest = Topic::$topic.longest(limits);
                builder.initial_max_slice_len(crate::$payload::words(longest))
            },
            |publisher| publisher.loan_slice(crate::$payload::words(len)),
            crate::$payload::of_words, crate::$payload::of_words_mut, crate::$payload::bytes
        );
    };
    ($payload:tt, $topic:ident) => {
        payload!(
            crate::$payload, Topic::$topic, crate::$payload, _len, Box<crate::$payload>, Box::default(),
            |builder, _limits| builder,
            |publisher| publisher.loan(),
            std::convert::identity, std::convert::identity, bytemuck::bytes_of
        );
    };
}

crate::for_each_topic!(payloads);

fn revision(topic: Topic) -> Result<AttributeVerifier, Failure> {
    let impossible = |_| Failure::new(Kind::Failed, "the payload's revision is no attribute", "");
    let value = topic.revision().to_string();
    let key = REVISION.try_into().map_err(|_| impossible(()))?;
    let value = value.as_str().try_into().map_err(|_| impossible(()))?;
    AttributeVerifier::new().require(&key, &value).map_err(|_| impossible(()))
}
