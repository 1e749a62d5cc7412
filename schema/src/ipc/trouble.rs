//! What can fail when a service is created or opened, sorted by what to do: wait, try again later, or report it to the
//! user. Refuses to know which service it is.

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

use super::Node;
use crate::limits::TopicLimits;
use crate::lock::MakingLock;
use crate::{Failure, Kind, access, is_remote, of_service, shortage};

/// What there is to do about an error.
pub(super) enum Trouble {
    /// The service is not there, or is being made or taken away at this moment.
    Absent,
    /// Everything is taken: too many processes.
    Full,
    /// Nothing helps.
    Broken(String),
}

impl From<ServiceOpenError> for Trouble {
    fn from(error: ServiceOpenError) -> Trouble {
        use ServiceOpenError as E;
        match error {
            E::DoesNotExist | E::HangsInCreation | E::IsMarkedForDestruction | E::Interrupt => {
                Trouble::Absent
            }
            // Seen while the hub makes it or cleans up after a dead one.
            E::ServiceInCorruptedState => Trouble::Absent,
            E::ExceedsMaxNumberOfNodes => Trouble::Full,
            E::VersionMismatch => Trouble::Broken("the hub has another version of iceoryx2".into()),
            E::IncompatiblePayload | E::IncompatibleMessagingPattern => {
                Trouble::Broken("the hub uses another layout".into())
            }
            other => Trouble::Broken(format!("{other:?}")),
        }
    }
}

impl From<ServiceCreateError> for Trouble {
    fn from(error: ServiceCreateError) -> Trouble {
        use ServiceCreateError as E;
        match error {
            E::AlreadyExists
            | E::IsBeingCreatedByAnotherInstance
            | E::ServiceInCorruptedState
            | E::Interrupt => Trouble::Absent,
            other => Trouble::Broken(format!("{other:?}")),
        }
    }
}

impl From<TopicError> for Trouble {
    fn from(error: TopicError) -> Trouble {
        match error {
            TopicError::PublishSubscribeOpenError(error) => error.into(),
            TopicError::PublishSubscribeCreateError(error) => ServiceCreateError::from(error).into(),
            TopicError::SystemInFlux => Trouble::Absent,
        }
    }
}

impl From<PublishSubscribeOpenError> for Trouble {
    fn from(error: PublishSubscribeOpenError) -> Trouble {
        ServiceOpenError::from(error).into()
    }
}

impl From<EventError> for Trouble {
    fn from(error: EventError) -> Trouble {
        match error {
            EventError::EventOpenError(error) => ServiceOpenError::from(error).into(),
            EventError::EventCreateError(error) => ServiceCreateError::from(error).into(),
            EventError::SystemInFlux => Trouble::Absent,
        }
    }
}

impl From<ControlError> for Trouble {
    fn from(error: ControlError) -> Trouble {
        match error {
            ControlError::RequestResponseOpenError(error) => ServiceOpenError::from(error).into(),
            ControlError::RequestResponseCreateError(error) => ServiceCreateError::from(error).into(),
            ControlError::SystemInFlux => Trouble::Absent,
        }
    }
}

/// Calls `make` until the service is there, two seconds at most: one that its last user is leaving comes back soon.
pub(super) fn create<T>(
    node: &Node,
    service: &ServiceName,
    make: impl Fn() -> Result<T, Trouble>,
) -> Result<T, Failure> {
    let give_up_at = Instant::now() + Duration::from_secs(2);
    let root = node.config().global.root_path().to_string();
    loop {
        let making = MakingLock::wait(Path::new(&root))?;
        let made = make();
        drop(making);
        match made {
            Ok(made) => return Ok(made),
            Err(Trouble::Absent) if Instant::now() < give_up_at => sleep(Duration::from_millis(10)),
            Err(trouble) => return Err(failure(node, service, trouble)),
        }
    }
}

/// A service that is not there is nothing, anything else that is wrong a failure.
pub(super) fn open<T, E>(
    node: &Node,
    service: &ServiceName,
    opened: Result<T, E>,
) -> Result<Option<T>, Failure>
where
    ServiceOpenError: From<E>,
{
    match opened.map_err(|error| Trouble::from(ServiceOpenError::from(error))) {
        Ok(opened) => Ok(Some(opened)),
        Err(Trouble::Absent) => Ok(None),
        Err(trouble) => Err(failure(node, service, trouble)),
    }
}

/// Why there is no publisher.
pub(super) fn no_publisher(service: &ServiceName, error: PublisherCreateError) -> Failure {
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

/// Why there is no place for one more consumer of the topic `service`, which was made for `limit` of them.
pub(super) fn no_place(service: &ServiceName, limit: usize) -> Failure {
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

/// Why there is no place for one more consumer or client at `service`, of which there can be `limit`.
pub(super) fn full(service: &ServiceName, limit: usize) -> Failure {
    Failure::new(
        Kind::Short,
        format!("{service} has {limit} consumers, the most that are possible"),
        "stop some of them; the places of those that crashed are free again within seconds",
    )
}

/// Why there is no other port: as a rule descriptors or places are short.
pub(super) fn no_port(service: &ServiceName, error: &dyn Debug) -> Failure {
    shortage::found(Path::new(shortage::SHARED_MEMORY)).unwrap_or_else(|| {
        let hint = "too many consumers, or `ulimit -n` is too small: about 4 descriptors for each";
        Failure::new(Kind::Short, format!("no port at {service}: {error:?}"), hint)
    })
}

fn failure(node: &Node, service: &ServiceName, trouble: Trouble) -> Failure {
    match trouble {
        Trouble::Full => Failure::new(
            Kind::Short,
            format!("{service} has no place for another process"),
            "stop some consumers",
        ),
        Trouble::Absent => {
            Failure::new(Kind::Failed, format!("{service} cannot be created"), "remove what is left of it")
        }
        Trouble::Broken(what) => {
            let root = node.config().global.root_path().to_string();
            access::failure(Path::new(&root), format!("{service}: {what}"))
        }
    }
}
