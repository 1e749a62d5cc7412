//! A topic in shared memory: its service, its subscriber and its publisher. The publisher numbers samples, writes them
//! in place, and counts the samples that it has no memory for. The code for each payload is generated from the table of
//! topics.

use std::borrow::BorrowMut;
use std::fmt::Debug;
use std::marker::PhantomData;

use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{self, LoanError, ReceiveError, SendError};
use iceoryx2::prelude::ipc::Service as LocalService;
use iceoryx2::prelude::{AttributeSet, AttributeVerifier, IceoryxSend, PortFactory, SemanticString};
use iceoryx2::service::Service;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError,
};
use iceoryx2::service::port_factory::publish_subscribe;

use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Header, Kind, TelegramBytes, Topic, limits, parse_service_name};

use crate::doorbell::count_attached;
use crate::processes::Node;
use crate::resource_limits::check_client;
use crate::service::{OpenFailure, create, name, open, port_failure, publisher_failure, subscribers_full};

/// A topic of one sensor.
pub type TopicService<P, S = LocalService> =
    publish_subscribe::PortFactory<S, <P as Payload>::Memory, Header>;
/// Sends the samples of a topic.
pub type Publisher<P, S = LocalService> = port::publisher::Publisher<S, <P as Payload>::Memory, Header>;
/// Receives the samples of a topic.
pub type Subscriber<P, S = LocalService> = port::subscriber::Subscriber<S, <P as Payload>::Memory, Header>;
/// A received sample in shared memory, read-only. `*` accesses the payload, and `user_header()` the header.
pub type Sample<P, S = LocalService> = iceoryx2::sample::Sample<S, <P as Payload>::Memory, Header>;
/// A loaned sample that is not sent yet.
pub type SampleMut<P, S = LocalService> = iceoryx2::sample_mut::SampleMut<S, <P as Payload>::Memory, Header>;

/// Payload of a topic: `[u8]` (telegram), or a type of `scanhub-schema`. Other crates cannot implement this trait.
pub trait Payload: sealed::Sealed + Debug + 'static {
    /// Topic of this payload.
    const TOPIC: Topic;

    /// Type in shared memory: the payload itself, or the words of a payload of variable length.
    type Memory: IceoryxSend + Debug + ?Sized + 'static;

    /// Returns the topic of `sensor`, for the hub. The topic is created with `limits` if it does not exist. A topic
    /// that subscribers of a dead hub keep alive is reused, with the number of slots that it already has.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if memory or descriptors are short, and [`Kind::Incompatible`] if the topic
    /// exists with another layout.
    fn create<S: Service>(
        node: &Node<S>,
        sensor: &str,
        limits: &TopicLimits,
    ) -> Result<TopicService<Self, S>, Failure>;

    /// Returns the topic of `sensor`, for subscribers. `None` if no hub has created it yet.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if memory or descriptors are short, and [`Kind::Incompatible`] if the topic
    /// has another layout.
    fn open<S: Service>(node: &Node<S>, sensor: &str) -> Result<Option<TopicService<Self, S>>, Failure>;

    /// Returns the publisher of a topic, with memory for the longest samples that `limits` allow.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::DomainHeld`] if the topic already has a publisher.
    fn publisher<S: Service>(
        topic: &TopicService<Self, S>,
        limits: &TopicLimits,
    ) -> Result<Publisher<Self, S>, Failure>;

    /// Returns a subscriber of a topic, and announces the subscriber to the hub. The hub then also sends the next
    /// sample to this subscriber.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if memory, descriptors or slots for subscribers are short.
    fn subscriber<S: Service>(
        node: &Node<S>,
        topic: &TopicService<Self, S>,
    ) -> Result<Subscriber<Self, S>, Failure>;

    /// Returns the oldest queued sample, or `None`.
    ///
    /// # Errors
    ///
    /// Returns [`ReceiveError::ExceedsMaxBorrows`] if [`limits::MAX_BORROWED_SAMPLES`] samples are held, and
    /// [`ReceiveError::ConnectionFailure`] if the publisher's memory cannot be mapped.
    fn receive<S: Service>(subscriber: &Subscriber<Self, S>)
    -> Result<Option<Sample<Self, S>>, ReceiveError>;

    /// Returns the payload of a sample, in shared memory.
    fn read<S: Service>(sample: &Sample<Self, S>) -> &Self;

    /// Loans memory for a sample with a default payload. A payload of variable length has `len` bytes, at least a head.
    ///
    /// # Errors
    ///
    /// Returns the library's error if there is no memory, or if `len` is more than the topic was created for.
    fn loan<S: Service>(publisher: &Publisher<Self, S>, len: usize) -> Result<SampleMut<Self, S>, LoanError>;

    /// Returns the payload of a loaned sample.
    fn write<S: Service>(loan: &mut SampleMut<Self, S>) -> &mut Self;

    /// Type of a payload in the memory of this process.
    type Owned: BorrowMut<Self>;

    /// Returns a default payload in the memory of this process. A payload of variable length has `len` bytes, at least
    /// a head.
    fn owned(len: usize) -> Self::Owned;

    /// Returns the used bytes of the payload.
    fn bytes(&self) -> &[u8];
}

mod sealed {
    pub trait Sealed {}
}

/// Implements [`Payload`]. In iceoryx2, the functions for slices and those for values are in separate impl blocks, so
/// no generic code can call both. This macro generates the calls for either.
macro_rules! payload {
    ($payload:ty, $topic:expr, $memory:ty, $len:ident, $owned:ty, $make:expr,
        |$builder:ident, $limits:ident| $sized:expr, |$publisher:ident| $loan:expr, $read:path, $write:path, $bytes:path) => {
        impl sealed::Sealed for $payload {}

        impl Payload for $payload {
            const TOPIC: Topic = $topic;

            type Memory = $memory;

            fn create<S: Service>(
                node: &Node<S>,
                sensor: &str,
                limits: &TopicLimits,
            ) -> Result<TopicService<Self, S>, Failure> {
                let (service, revision) = (name(&$topic.service(sensor))?, revision($topic)?);
                create(node, &service, || {
                    let builder = || {
                        let builder = node.service_builder(&service).publish_subscribe::<$memory>();
                        builder.user_header::<Header>()
                    };
                    let made = builder()
                        .max_publishers(limits::MAX_PUBLISHERS)
                        .max_subscribers(limits.subscribers)
                        .max_nodes(limits::MAX_NODES)
                        .subscriber_max_buffer_size(limits::queue_len($topic))
                        .subscriber_max_borrowed_samples(limits::MAX_BORROWED_SAMPLES)
                        .history_size(limits::history_len($topic))
                        .enable_safe_overflow(true)
                        .open_or_create_with_attributes(&revision);
                    match made {
                        Err(PublishSubscribeOpenOrCreateError::PublishSubscribeOpenError(
                            PublishSubscribeOpenError::DoesNotSupportRequestedAmountOfSubscribers,
                        )) => builder().open_with_attributes(&revision).map_err(|error| error.into()),
                        made => made.map_err(OpenFailure::from),
                    }
                })
            }

            fn open<S: Service>(
                node: &Node<S>,
                sensor: &str,
            ) -> Result<Option<TopicService<Self, S>>, Failure> {
                let service = name(&$topic.service(sensor))?;
                let builder = node.service_builder(&service).publish_subscribe::<$memory>();
                open(node, &service, builder.user_header::<Header>().open())
            }

            fn publisher<S: Service>(
                topic: &TopicService<Self, S>,
                $limits: &TopicLimits,
            ) -> Result<Publisher<Self, S>, Failure> {
                let samples = limits::sample_count($topic, subscriber_capacity::<Self, S>(topic));
                let $builder = topic
                    .publisher_builder()
                    .max_loaned_samples(limits::MAX_LOANED_SAMPLES)
                    .override_sample_preallocation(move |_| samples);
                $sized.create().map_err(|error| publisher_failure(topic.name(), error))
            }

            fn subscriber<S: Service>(
                node: &Node<S>,
                topic: &TopicService<Self, S>,
            ) -> Result<Subscriber<Self, S>, Failure> {
                check_client()?;
                let subscriber = topic.subscriber_builder().create().map_err(|error| match error {
                    SubscriberCreateError::ExceedsMaxSupportedSubscribers => {
                        subscribers_full(topic.name(), subscriber_capacity::<Self, S>(topic))
                    }
                    other => port_failure(topic.name(), &other),
                })?;
                if let Some((sensor, _)) = parse_service_name(topic.name().as_str()) {
                    count_attached(node, sensor);
                }
                Ok(subscriber)
            }

            fn receive<S: Service>(
                subscriber: &Subscriber<Self, S>,
            ) -> Result<Option<Sample<Self, S>>, ReceiveError> {
                subscriber.receive()
            }

            fn read<S: Service>(sample: &Sample<Self, S>) -> &Self {
                $read(sample)
            }

            fn loan<S: Service>(
                $publisher: &Publisher<Self, S>,
                $len: usize,
            ) -> Result<SampleMut<Self, S>, LoanError> {
                $loan
            }

            fn write<S: Service>(loan: &mut SampleMut<Self, S>) -> &mut Self {
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

/// Implements [`Payload`] for rows of the table of topics. For a payload of variable length, the publisher reserves
/// memory for the maximum length.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
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
            scanhub_schema::$payload, Topic::$topic, [scanhub_schema::$word], len,
            Box<scanhub_schema::$payload>, scanhub_schema::$payload::zeroed(len),
            |builder, limits| {
                let longest = Topic::$topic.max_payload_len(limits);
                builder.initial_max_slice_len(scanhub_schema::$payload::words(longest))
            },
            |publisher| publisher.loan_slice(scanhub_schema::$payload::words(len)),
            scanhub_schema::$payload::of_words, scanhub_schema::$payload::of_words_mut, scanhub_schema::$payload::bytes
        );
    };
    ($payload:tt, $topic:ident) => {
        payload!(
            scanhub_schema::$payload, Topic::$topic, scanhub_schema::$payload, _len, Box<scanhub_schema::$payload>, Box::default(),
            |builder, _limits| builder,
            |publisher| publisher.loan(),
            std::convert::identity, std::convert::identity, bytemuck::bytes_of
        );
    };
}

scanhub_schema::for_each_topic!(payloads);

// Telegrams as a type with a name, for programs. The hub uses the bytes themselves.
payload!(
    TelegramBytes,
    Topic::Telegram,
    [u8],
    len,
    Box<TelegramBytes>,
    TelegramBytes::zeroed(len),
    |builder, limits| builder.initial_max_slice_len(limits.telegram),
    |publisher| publisher.loan_slice(len),
    TelegramBytes::of_bytes,
    TelegramBytes::of_bytes_mut,
    TelegramBytes::bytes
);

/// Returns the number of slots for subscribers that `topic` was created with.
pub fn subscriber_capacity<P: Payload + ?Sized, S: Service>(topic: &TopicService<P, S>) -> usize {
    topic.static_config().max_subscribers()
}

/// Returns the payload's revision that the publisher wrote into the `attributes` of a service; 0 if the attributes have
/// no revision.
pub fn payload_revision(attributes: &AttributeSet) -> u32 {
    let revision = attributes.iter().find(|attribute| attribute.key().as_bytes() == REVISION_KEY.as_bytes());
    revision.and_then(|attribute| attribute.value().to_string().parse().ok()).unwrap_or_default()
}

const REVISION_KEY: &str = "revision";

fn revision(topic: Topic) -> Result<AttributeVerifier, Failure> {
    let impossible = |_| Failure::new(Kind::Failed, "the payload's revision is not a valid attribute", "");
    let value = topic.revision().to_string();
    let key = REVISION_KEY.try_into().map_err(|_| impossible(()))?;
    let value = value.as_str().try_into().map_err(|_| impossible(()))?;
    AttributeVerifier::new().require(&key, &value).map_err(|_| impossible(()))
}

/// Transport of a topic's samples: [`SharedMemory`], or in a simulation the memory of the process.
pub trait SampleTransport<P: Payload + ?Sized> {
    /// A loaned sample.
    type Loan;

    /// Returns the number of subscribers of the topic.
    fn subscribers(&self) -> usize;

    /// Connects new subscribers, and sends them the history of the topic.
    ///
    /// # Errors
    ///
    /// Returns the reason why a subscriber could not be connected.
    fn connect(&self) -> Result<(), impl Debug + use<Self, P>>;

    /// Loans memory for a sample with a default payload. A payload of bytes has `len` bytes.
    ///
    /// # Errors
    ///
    /// Returns the library's error if there is no memory.
    fn loan(&self, len: usize) -> Result<Self::Loan, LoanError>;

    /// Returns the payload of `loan` for writing in place.
    fn payload_mut(loan: &mut Self::Loan) -> &mut P;

    /// Sends `loan` with `header`. Returns the number of subscribers that received it.
    ///
    /// # Errors
    ///
    /// Returns the library's error.
    fn send(&self, loan: Self::Loan, header: &Header) -> Result<usize, SendError>;
}

/// A topic in the shared memory of a domain.
#[derive(Debug)]
pub struct SharedMemory<P: Payload + ?Sized, S: Service = LocalService> {
    publisher: Publisher<P, S>,
    service: TopicService<P, S>,
}

impl<P: Payload + ?Sized, S: Service> SharedMemory<P, S> {
    /// Creates the topic of `sensor` with payload `P` and `limits`, or takes over the topic of a dead process. The
    /// [`WakeSender`](crate::WakeSender) of the sensor must already exist.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::DomainHeld`] if another process publishes the topic, [`Kind::ResourceExhausted`] if memory or
    /// descriptors are short, and [`Kind::Incompatible`] if the topic exists with another layout.
    pub fn new(node: &Node<S>, sensor: &str, limits: &TopicLimits) -> Result<Self, Failure> {
        let service = P::create(node, sensor, limits)?;
        Ok(SharedMemory { publisher: P::publisher(&service, limits)?, service })
    }

    /// Returns the number of slots for subscribers. A topic that was taken over may have another number of slots than
    /// the given limits.
    pub fn subscriber_capacity(&self) -> usize {
        subscriber_capacity::<P, S>(&self.service)
    }
}

impl<P: Payload + ?Sized, S: Service> SampleTransport<P> for SharedMemory<P, S> {
    type Loan = SampleMut<P, S>;

    fn subscribers(&self) -> usize {
        self.service.dynamic_config().number_of_subscribers()
    }

    fn connect(&self) -> Result<(), impl Debug + use<P, S>> {
        self.publisher.update_connections()
    }

    fn loan(&self, len: usize) -> Result<SampleMut<P, S>, LoanError> {
        P::loan(&self.publisher, len)
    }

    fn payload_mut(loan: &mut SampleMut<P, S>) -> &mut P {
        P::write(loan)
    }

    fn send(&self, mut loan: SampleMut<P, S>, header: &Header) -> Result<usize, SendError> {
        *loan.user_header_mut() = *header;
        loan.send()
    }
}

/// Publisher of one topic of one sensor. The publisher numbers samples from 0. The numbers have a gap where samples
/// were lost before they could be sent.
#[derive(Debug)]
pub struct TopicPublisher<P: Payload + ?Sized, M = SharedMemory<P>> {
    transport: M,
    next: u64,
    failed: u64,
    payload: PhantomData<fn(&P)>,
}

impl<P: Payload + ?Sized, S: Service> TopicPublisher<P, SharedMemory<P, S>> {
    /// Creates the topic in shared memory, and a publisher of this topic as
    /// [`with_transport`](TopicPublisher::with_transport) does.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`SharedMemory::new`].
    pub fn new(node: &Node<S>, sensor: &str, limits: &TopicLimits) -> Result<Self, Failure> {
        SharedMemory::new(node, sensor, limits).map(TopicPublisher::with_transport)
    }
}

impl<P: Payload + ?Sized, M: SampleTransport<P>> TopicPublisher<P, M> {
    /// Creates a publisher over `transport`. The first sample has number 0.
    pub fn with_transport(transport: M) -> Self {
        TopicPublisher { transport, next: 0, failed: 0, payload: PhantomData }
    }

    /// Returns the number of the next sample.
    pub fn next_number(&self) -> u64 {
        self.next
    }

    /// Skips `count` numbers, so that subscribers count `count` missing samples.
    pub fn skip_numbers(&mut self, count: u64) {
        self.next += count;
    }

    /// Returns the number of subscribers of the topic.
    pub fn subscribers(&self) -> usize {
        self.transport.subscribers()
    }

    /// Connects new subscribers, and sends them the history of the topic. If a subscriber cannot be connected, the
    /// publisher tries again with the next sample.
    ///
    /// # Errors
    ///
    /// Returns the reason why a subscriber could not be connected.
    pub fn connect(&self) -> Result<(), impl Debug + use<P, M>> {
        self.transport.connect()
    }

    /// Returns the number of samples that were not sent for lack of memory.
    pub fn failed(&self) -> u64 {
        self.failed
    }

    /// Loans memory for a sample with a default payload. A payload of bytes has `len` bytes; any other payload has its
    /// own length.
    ///
    /// # Errors
    ///
    /// Returns the library's error if there is no memory, or if bytes are longer than
    /// [`Telegram::MAX_LEN`](scanhub_schema::Telegram::MAX_LEN).
    pub fn loan(&self, len: usize) -> Result<M::Loan, LoanError> {
        self.transport.loan(len)
    }

    /// Sends `loan` with `header` and the next number of the topic. Returns the number of subscribers that received the
    /// sample.
    ///
    /// # Errors
    ///
    /// Returns the library's error. The number is then skipped, and the sample is counted as failed.
    pub fn send_loan(&mut self, loan: M::Loan, header: &Header) -> Result<usize, SendError> {
        let header = Header { topic_seq: self.next, ..*header };
        self.next += 1;
        self.transport.send(loan, &header).inspect_err(|_| self.failed += 1)
    }

    /// Skips one number, for a sample for which there is no memory.
    pub fn count_failed(&mut self) {
        self.next += 1;
        self.failed += 1;
    }

    /// Sends a sample that `fill` writes in place, starting with a default payload. The payload has `len` bytes, or its
    /// own length if that is fixed. Numbers and results are those of [`send_loan`](TopicPublisher::send_loan).
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if there is no memory for the sample, or if it is longer than the topic was
    /// created for. The number of the sample is then skipped.
    pub fn send_len(
        &mut self,
        header: &Header,
        len: usize,
        fill: impl FnOnce(&mut P),
    ) -> Result<usize, Failure> {
        let mut loan = self.loan(len).map_err(|error| {
            self.count_failed();
            send_failure(P::TOPIC, &error)
        })?;
        fill(M::payload_mut(&mut loan));
        self.send_loan(loan, header).map_err(|error| send_failure(P::TOPIC, &error))
    }
}

impl<P: Payload, M: SampleTransport<P>> TopicPublisher<P, M> {
    /// Sends a sample that `fill` writes in place, starting with a default payload. Numbers and results are those of
    /// [`send_loan`](TopicPublisher::send_loan).
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if there is no memory for the sample. The number of the sample is then
    /// skipped.
    pub fn send(&mut self, header: &Header, fill: impl FnOnce(&mut P)) -> Result<usize, Failure> {
        self.send_len(header, 0, fill)
    }
}

impl<M: SampleTransport<[u8]>> TopicPublisher<[u8], M> {
    /// Sends `bytes` as a sample. Numbers and results are those of [`send_loan`](TopicPublisher::send_loan).
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if there is no memory for the sample, or if it is longer than
    /// [`Telegram::MAX_LEN`](scanhub_schema::Telegram::MAX_LEN).
    pub fn send_bytes(&mut self, header: &Header, bytes: &[u8]) -> Result<usize, Failure> {
        self.send_len(header, bytes.len(), |sample| sample.copy_from_slice(bytes))
    }
}

fn send_failure(topic: Topic, error: &dyn Debug) -> Failure {
    let what = format!("a sample of {} was not sent: {error:?}", topic.name());
    Failure::new(Kind::ResourceExhausted, what, "drop samples that are held, or free some of /dev/shm")
}
