//! Creates and opens services. Failures are classified by the remedy: wait, retry later, or report it to the user.

use std::fmt::Debug;
use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::service::builder::event::EventOpenOrCreateError as EventError;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError as TopicError,
};
use iceoryx2::service::builder::request_response::RequestResponseOpenOrCreateError as ControlError;
use iceoryx2::service::builder::{ServiceCreateError, ServiceOpenError};
use iceoryx2::service::service_name::ServiceName;

use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind, is_remote, of_service};

use crate::file_lock::MakingLock;
use crate::node::Node;
use crate::segments::access_failure;
use crate::shortage;

/// Class of an error.
pub(crate) enum OpenFailure {
    /// The service does not exist, or is being created or removed right now.
    Absent,
    /// There is no place for another process.
    Full,
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
            // This happens while the hub creates the service or cleans up after a dead process.
            E::ServiceInCorruptedState => OpenFailure::Absent,
            E::ExceedsMaxNumberOfNodes => OpenFailure::Full,
            E::VersionMismatch => OpenFailure::Broken("the hub has another version of iceoryx2".into()),
            E::IncompatiblePayload | E::IncompatibleMessagingPattern => {
                OpenFailure::Broken("the hub uses another layout".into())
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

impl From<TopicError> for OpenFailure {
    fn from(error: TopicError) -> OpenFailure {
        match error {
            TopicError::PublishSubscribeOpenError(error) => error.into(),
            TopicError::PublishSubscribeCreateError(error) => ServiceCreateError::from(error).into(),
            TopicError::SystemInFlux => OpenFailure::Absent,
        }
    }
}

impl From<PublishSubscribeOpenError> for OpenFailure {
    fn from(error: PublishSubscribeOpenError) -> OpenFailure {
        ServiceOpenError::from(error).into()
    }
}

impl From<EventError> for OpenFailure {
    fn from(error: EventError) -> OpenFailure {
        match error {
            EventError::EventOpenError(error) => ServiceOpenError::from(error).into(),
            EventError::EventCreateError(error) => ServiceCreateError::from(error).into(),
            EventError::SystemInFlux => OpenFailure::Absent,
        }
    }
}

impl From<ControlError> for OpenFailure {
    fn from(error: ControlError) -> OpenFailure {
        match error {
            ControlError::RequestResponseOpenError(error) => ServiceOpenError::from(error).into(),
            ControlError::RequestResponseCreateError(error) => ServiceCreateError::from(error).into(),
            ControlError::SystemInFlux => OpenFailure::Absent,
        }
    }
}

/// Returns the name of a service as the library takes it.
pub(crate) fn name(service: &str) -> Result<ServiceName, Failure> {
    ServiceName::new(service).map_err(|error| {
        Failure::new(Kind::Configuration, format!("{service:?} is no service: {error:?}"), "")
    })
}

/// Calls `make` until the service exists, for at most two seconds. A service that its last user is leaving can be
/// created again soon.
pub(crate) fn create<T>(
    node: &Node,
    service: &ServiceName,
    make: impl Fn() -> Result<T, OpenFailure>,
) -> Result<T, Failure> {
    let give_up_at = Instant::now() + Duration::from_secs(2);
    let root = node.config().global.root_path().to_string();
    loop {
        let making = MakingLock::wait(Path::new(&root))?;
        let made = make();
        drop(making);
        match made {
            Ok(made) => return Ok(made),
            Err(OpenFailure::Absent) if Instant::now() < give_up_at => sleep(Duration::from_millis(10)),
            Err(failed) => return Err(failure(node, service, failed)),
        }
    }
}

/// Returns `None` if the service does not exist, and a failure for any other error.
pub(crate) fn open<T, E>(
    node: &Node,
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

/// Returns the failure for a publisher that cannot be created.
pub(crate) fn no_publisher(service: &ServiceName, error: PublisherCreateError) -> Failure {
    match error {
        PublisherCreateError::ExceedsMaxSupportedPublishers => Failure::new(
            Kind::DomainHeld,
            format!("{service} has a publisher already"),
            "stop the other hub, or choose another --domain",
        ),
        PublisherCreateError::UnableToCreateDataSegment => Failure::new(
            Kind::Short,
            format!("no shared memory for {service}"),
            "free some of /dev/shm and file descriptors",
        ),
        other => no_port(service, &other),
    }
}

/// Returns the failure if all `limit` places for subscribers of the topic `service` are taken.
pub(crate) fn no_place(service: &ServiceName, limit: usize) -> Failure {
    let (start, key) = match of_service(service.as_str()) {
        Some((sensor, _)) if is_remote(sensor) => ("start what publishes it", "--consumers"),
        _ => ("configure the hub", "limits.consumers"),
    };
    let most = TopicLimits::CONSUMERS.end();
    let hint = format!(
        "{start} with a greater {key}, up to {most}, or stop some; the places of those that crashed are free again within \
         seconds"
    );
    Failure { hint, ..full(service, limit) }
}

/// Returns the failure if all `limit` places for subscribers or clients of `service` are taken.
pub(crate) fn full(service: &ServiceName, limit: usize) -> Failure {
    Failure::new(
        Kind::Short,
        format!("{service} has {limit} consumers, the most that are possible"),
        "stop some of them; the places of those that crashed are free again within seconds",
    )
}

/// Returns the failure for any other port that cannot be created. As a rule, descriptors or places are short.
pub(crate) fn no_port(service: &ServiceName, error: &dyn Debug) -> Failure {
    shortage::found(Path::new(shortage::SHARED_MEMORY)).unwrap_or_else(|| {
        let hint = "too many consumers, or `ulimit -n` is too small: about 4 descriptors for each";
        Failure::new(Kind::Short, format!("no port at {service}: {error:?}"), hint)
    })
}

fn failure(node: &Node, service: &ServiceName, failed: OpenFailure) -> Failure {
    match failed {
        OpenFailure::Full => Failure::new(
            Kind::Short,
            format!("{service} has no place for another process"),
            "stop some consumers",
        ),
        OpenFailure::Absent => {
            Failure::new(Kind::Failed, format!("{service} cannot be created"), "remove what is left of it")
        }
        OpenFailure::Broken(what) => {
            let root = node.config().global.root_path().to_string();
            access_failure(Path::new(&root), format!("{service}: {what}"))
        }
    }
}
