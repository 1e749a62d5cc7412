//! Creation, opening and listing of services. Failures are classified by the remedy: wait, retry later, or report it to
//! the user.

use std::fmt::Debug;
use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::prelude::CallbackProgression;
use iceoryx2::prelude::ipc::Service as LocalService;
use iceoryx2::service::Service;
use iceoryx2::service::builder::event::EventOpenOrCreateError;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError,
};
use iceoryx2::service::builder::request_response::RequestResponseOpenOrCreateError;
use iceoryx2::service::builder::{ServiceCreateError, ServiceOpenError};
use iceoryx2::service::service_name::ServiceName;

use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind, PublisherKind, Topic, is_remote, parse_service_name};

use crate::directory::ServiceCreationLock;
use crate::domain::Domain;
use crate::processes::{Node, config};
use crate::resource_limits;
use crate::segments::access_failure;

/// Reason why a service cannot be opened or created, classified by the remedy.
pub(crate) enum OpenFailure {
    /// The service does not exist, or is being created or removed right now.
    Absent,
    /// All slots for processes are taken.
    Full,
    /// The service has another layout, or another version of iceoryx2.
    Incompatible(&'static str),
    /// A retry does not help.
    Broken(String),
}

impl From<ServiceOpenError> for OpenFailure {
    fn from(error: ServiceOpenError) -> OpenFailure {
        use ServiceOpenError as E;
        match error {
            E::DoesNotExist | E::HangsInCreation | E::IsMarkedForDestruction | E::Interrupt => {
                OpenFailure::Absent
            }
            // This error is temporary: it occurs while the hub creates the service or cleans up after a dead process.
            E::ServiceInCorruptedState => OpenFailure::Absent,
            E::ExceedsMaxNumberOfNodes => OpenFailure::Full,
            E::VersionMismatch => OpenFailure::Incompatible("the hub has another version of iceoryx2"),
            E::IncompatiblePayload | E::IncompatibleMessagingPattern => {
                OpenFailure::Incompatible("the hub uses another layout")
            }
            other => OpenFailure::Broken(format!("{other:?}")),
        }
    }
}

impl From<ServiceCreateError> for OpenFailure {
    fn from(error: ServiceCreateError) -> OpenFailure {
        use ServiceCreateError as E;
        match error {
            E::AlreadyExists
            | E::IsBeingCreatedByAnotherInstance
            | E::ServiceInCorruptedState
            | E::Interrupt => OpenFailure::Absent,
            other => OpenFailure::Broken(format!("{other:?}")),
        }
    }
}

impl From<PublishSubscribeOpenError> for OpenFailure {
    fn from(error: PublishSubscribeOpenError) -> OpenFailure {
        ServiceOpenError::from(error).into()
    }
}

/// Converts the errors of `open_or_create`. The library has separate errors for each kind of service.
macro_rules! open_failure {
    ($($error:ident: $open:ident, $create:ident;)*) => {
        $(impl From<$error> for OpenFailure {
            fn from(error: $error) -> OpenFailure {
                match error {
                    $error::$open(error) => ServiceOpenError::from(error).into(),
                    $error::$create(error) => ServiceCreateError::from(error).into(),
                    $error::SystemInFlux => OpenFailure::Absent,
                }
            }
        })*
    };
}

open_failure! {
    EventOpenOrCreateError: EventOpenError, EventCreateError;
    PublishSubscribeOpenOrCreateError: PublishSubscribeOpenError, PublishSubscribeCreateError;
    RequestResponseOpenOrCreateError: RequestResponseOpenError, RequestResponseCreateError;
}

/// Converts the name of a service to the library's type.
pub(crate) fn name(service: &str) -> Result<ServiceName, Failure> {
    ServiceName::new(service).map_err(|error| {
        Failure::new(Kind::Configuration, format!("{service:?} is not a valid service name: {error:?}"), "")
    })
}

/// Calls `make` until the service exists, for at most two seconds. If the last process is just leaving the service, the
/// service can soon be created again.
#[expect(clippy::disallowed_methods, reason = "waits for a service that another process has half created")]
pub(crate) fn create<T, S: Service>(
    node: &Node<S>,
    service: &ServiceName,
    make: impl Fn() -> Result<T, OpenFailure>,
) -> Result<T, Failure> {
    let deadline = Instant::now() + Duration::from_secs(2);
    let root = node.config().global.root_path().to_string();
    loop {
        let lock = ServiceCreationLock::wait(Path::new(&root))?;
        let created = make();
        drop(lock);
        match created {
            Ok(made) => return Ok(made),
            Err(OpenFailure::Absent) if Instant::now() < deadline => sleep(Duration::from_millis(10)),
            Err(failed) => return Err(failure(node, service, failed)),
        }
    }
}

/// Returns the service that was opened, `None` if the service does not exist, and a failure for any other error.
pub(crate) fn open<T, E, S: Service>(
    node: &Node<S>,
    service: &ServiceName,
    opened: Result<T, E>,
) -> Result<Option<T>, Failure>
where
    ServiceOpenError: From<E>,
{
    match opened.map_err(|error| OpenFailure::from(ServiceOpenError::from(error))) {
        Ok(opened) => Ok(Some(opened)),
        Err(OpenFailure::Absent) => Ok(None),
        Err(failed) => Err(failure(node, service, failed)),
    }
}

/// Returns the sensors that have topics in `domain`, sorted.
///
/// # Errors
///
/// Returns the errors of [`published_topics`].
pub fn sensors(domain: &Domain) -> Result<Vec<String>, Failure> {
    sensors_with_topic(domain, |_| true)
}

/// Returns the [`sensors`] that have a link, here or on another machine. A tracker has no link.
///
/// # Errors
///
/// Returns the errors of [`published_topics`].
pub fn links(domain: &Domain) -> Result<Vec<String>, Failure> {
    sensors_with_topic(domain, |topic| topic.publisher_kind() == PublisherKind::Link)
}

/// Returns the [`sensors`] that have zones. A robot's combined verdict is computed from these zones.
///
/// # Errors
///
/// Returns the errors of [`published_topics`].
pub fn sensors_with_zones(domain: &Domain) -> Result<Vec<String>, Failure> {
    sensors_with_topic(domain, |topic| topic == Topic::Zones)
}

fn sensors_with_topic(domain: &Domain, is_match: impl Fn(Topic) -> bool) -> Result<Vec<String>, Failure> {
    let topics = published_topics(domain)?.into_iter().filter(|(_, topic)| is_match(*topic));
    let mut sensors: Vec<String> = topics.map(|(sensor, _)| sensor).collect();
    sensors.dedup();
    Ok(sensors)
}

/// Returns all topics in `domain` with their sensors, sorted by sensor. The topics of a dead hub exist until their last
/// subscriber leaves.
///
/// # Errors
///
/// Returns [`Kind::OtherUser`] with owner, mode and remedy if the directory belongs to another user.
pub fn published_topics(domain: &Domain) -> Result<Vec<(String, Topic)>, Failure> {
    let mut topics = Vec::new();
    let Some(config) = config(domain.root())? else { return Ok(topics) };
    let listed = LocalService::list(&config, |service| {
        if let Some((sensor, Some(topic))) = parse_service_name(service.static_details.name().as_str()) {
            topics.push((sensor.to_owned(), topic));
        }
        CallbackProgression::Continue
    });
    listed.map_err(|error| access_failure(domain.root(), format!("cannot list topics: {error:?}")))?;
    topics.sort_by(|(one, _), (other, _)| one.cmp(other));
    Ok(topics)
}

/// Returns the failure for a publisher that cannot be created.
pub(crate) fn publisher_failure(service: &ServiceName, error: PublisherCreateError) -> Failure {
    match error {
        PublisherCreateError::ExceedsMaxSupportedPublishers => Failure::new(
            Kind::DomainHeld,
            format!("{service} has a publisher already"),
            "stop the other hub, or choose another --domain",
        ),
        PublisherCreateError::UnableToCreateDataSegment => Failure::new(
            Kind::ResourceExhausted,
            format!("no shared memory for {service}"),
            "free some of /dev/shm and file descriptors",
        ),
        other => port_failure(service, &other),
    }
}

/// Returns the failure if all `limit` slots for subscribers of the topic `service` are taken.
pub(crate) fn subscribers_full(service: &ServiceName, limit: usize) -> Failure {
    let (start, key) = match parse_service_name(service.as_str()) {
        Some((sensor, _)) if is_remote(sensor) => ("start its publisher", "--subscribers"),
        _ => ("configure the hub", "limits.subscribers"),
    };
    let max = TopicLimits::SUBSCRIBERS.end();
    let hint = format!(
        "{start} with a larger {key}, up to {max}, or stop some; the slots of crashed subscribers become free within \
         seconds"
    );
    Failure { hint, ..clients_full(service, limit) }
}

/// Returns the failure if all `limit` slots for subscribers or clients of `service` are taken.
pub(crate) fn clients_full(service: &ServiceName, limit: usize) -> Failure {
    Failure::new(
        Kind::ResourceExhausted,
        format!("{service} has {limit} subscribers, which is the maximum"),
        "stop some of them; the slots of crashed subscribers become free within seconds",
    )
}

/// Returns the failure for a port that cannot be created, for all reasons that have no function of their own. Usually
/// descriptors or slots are short.
pub(crate) fn port_failure(service: &ServiceName, error: &dyn Debug) -> Failure {
    resource_limits::find_shortage(Path::new(resource_limits::SHARED_MEMORY_DIRECTORY)).unwrap_or_else(|| {
        let hint = "too many subscribers, or `ulimit -n` is too small: about 4 descriptors for each";
        Failure::new(Kind::ResourceExhausted, format!("cannot create a port for {service}: {error:?}"), hint)
    })
}

fn failure<S: Service>(node: &Node<S>, service: &ServiceName, error: OpenFailure) -> Failure {
    let in_domain = |what: &str| {
        let root = node.config().global.root_path().to_string();
        access_failure(Path::new(&root), format!("{service}: {what}"))
    };
    match error {
        OpenFailure::Full => Failure::new(
            Kind::ResourceExhausted,
            format!("{service} has no free slot for another process"),
            "stop some subscribers",
        ),
        OpenFailure::Absent => {
            Failure::new(Kind::Failed, format!("{service} cannot be created"), "remove what is left of it")
        }
        OpenFailure::Incompatible(what) => match in_domain(what) {
            failure if failure.kind == Kind::Failed => Failure { kind: Kind::Incompatible, ..failure },
            failure => failure,
        },
        OpenFailure::Broken(what) => in_domain(&what),
    }
}
