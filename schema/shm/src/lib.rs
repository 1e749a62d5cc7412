//! Services of topics in shared memory, with all limits. Only this module names the builders of iceoryx2; all other
//! code uses its ports.

mod clean;
mod control;
mod directory;
mod domain;
mod doorbell;
mod isolation;
mod lock;
mod open_failure;
mod running;
pub mod shortage;
mod state;
mod topic_service;
mod wake;

use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::time::Duration;

use iceoryx2::config::Config;
use iceoryx2::port;
use iceoryx2::prelude::{
    AttributeSet, CallbackProgression, FileName, LogLevel, NodeBuilder, SemanticString, ServiceName,
    SignalHandlingMode, set_log_level_from_env_or,
};
use iceoryx2::service::Service as _;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use crate::lock::MakingLock;
use schema::{Failure, Header, Kind, Maker, Topic, of_service};

use self::clean::remove_unfinished_services;
pub use self::clean::{Cleaned, Nodes, clean, is_unheld, nodes};
pub use self::control::{Asked, ControlClient, ControlServer, Pending};
pub use self::doorbell::{Bell, Unsupported, sleep_at_bells};
use self::isolation::{
    PREFIX_FILE, access_failure, ensure_node_counter, ensure_prefix, prefix_of, read_prefix,
    remove_node_counter,
};
pub use self::isolation::{Segment, strangers};
pub use self::topic_service::{Medium, Payload, SharedMemory, TopicPublisher};
pub use self::wake::{DueRings, Waker, descriptor, listener, open_wake, sleep, take_wakeups};
pub use directory::Directory;
pub use domain::{DEFAULT_DOMAIN, Domain, Environment};
pub use iceoryx2::port::update_connections::UpdateConnections;
pub use iceoryx2::port::{LoanError, ReceiveError, SendError};
/// Shared memory between processes; ports of it stay in their thread, nodes and services may move.
pub use iceoryx2::prelude::ipc::Service;
pub use iceoryx2::prelude::{PortFactory, ZeroCopySend};
pub use lock::{HubLock, ListenLock, NameLock, holder, is_starting, name_held, publisher, publisher_domain};
pub use running::{RunningHub, shell_word};
pub use state::StateDirectory;

/// The version of the shared-memory library: processes with another version are refused.
pub const LIBRARY: &str = "iceoryx2 0.10.0";

/// The membership of a process in a domain.
pub type Node = iceoryx2::node::Node<Service>;
/// A topic of one sensor.
pub type TopicService<P> = publish_subscribe::PortFactory<Service, <P as Payload>::Memory, Header>;
/// Sends the samples of a topic.
pub type Publisher<P> = port::publisher::Publisher<Service, <P as Payload>::Memory, Header>;
/// Receives the samples of a topic.
pub type Subscriber<P> = port::subscriber::Subscriber<Service, <P as Payload>::Memory, Header>;
/// A received sample: the payload by `*`, read-only, in shared memory; the header by `user_header()`.
pub type Sample<P> = iceoryx2::sample::Sample<Service, <P as Payload>::Memory, Header>;
/// A loaned sample that is not sent yet.
pub type SampleMut<P> = iceoryx2::sample_mut::SampleMut<Service, <P as Payload>::Memory, Header>;
/// What wakes the consumers of one sensor.
pub type WakeService = event::PortFactory<Service>;
/// Wakes consumers.
pub type Notifier = port::notifier::Notifier<Service>;
/// Sleeps until it is woken.
pub type Listener = port::listener::Listener<Service>;

/// Returns the node of who publishes in `domain` and holds its [`HubLock`](crate::HubLock),
/// [`ListenLock`](crate::ListenLock) or a [`NameLock`](crate::NameLock) of it. Cleans up what dead ones and consumers left.
///
/// # Errors
///
/// [`Kind::Failed`] with owner, mode and remedy if the directory is another user's.
pub fn hub_node(domain: &Domain) -> Result<Node, Failure> {
    node(domain, true)
}

/// Returns a consumer's node in `domain`; cleaning up is the hub's business.
///
/// # Errors
///
/// [`Kind::Failed`] with owner, mode and remedy if the directory is another user's.
pub fn client_node(domain: &Domain) -> Result<Node, Failure> {
    node(domain, false)
}

/// Returns the number of consumers that `topic` was made for.
pub fn places<P: Payload + ?Sized>(topic: &TopicService<P>) -> usize {
    topic.static_config().max_subscribers()
}

/// Returns the sensors that have topics in `domain`, sorted. Those of a dead hub stay as long as a consumer keeps them.
///
/// # Errors
///
/// [`Kind::Failed`] with owner, mode and remedy if the directory is another user's.
pub fn sensors(domain: &Domain) -> Result<Vec<String>, Failure> {
    let mut sensors: Vec<String> = published(domain)?.into_iter().map(|(sensor, _)| sensor).collect();
    sensors.dedup();
    Ok(sensors)
}

/// Returns those of [`sensors`] that have a link, here or on another machine: a tracker has none.
///
/// # Errors
///
/// As [`sensors`].
pub fn links(domain: &Domain) -> Result<Vec<String>, Failure> {
    let of_links = published(domain)?.into_iter().filter(|(_, topic)| topic.maker() == Maker::Link);
    let mut links: Vec<String> = of_links.map(|(sensor, _)| sensor).collect();
    links.dedup();
    Ok(links)
}

/// Returns the sensors that have zones in `domain`, sorted, as [`sensors`]: those that a robot's verdict is made of.
///
/// # Errors
///
/// As [`sensors`].
pub fn sensors_with_zones(domain: &Domain) -> Result<Vec<String>, Failure> {
    let with_zones = published(domain)?.into_iter().filter(|(_, topic)| *topic == Topic::Zones);
    Ok(with_zones.map(|(sensor, _)| sensor).collect())
}

/// Returns all topics that are there in `domain` with their sensors, sorted by these.
///
/// # Errors
///
/// As [`sensors`].
pub fn published(domain: &Domain) -> Result<Vec<(String, Topic)>, Failure> {
    let mut topics = Vec::new();
    let Some(config) = config(domain.root())? else { return Ok(topics) };
    let listed = Service::list(&config, |service| {
        if let Some((sensor, Some(topic))) = of_service(service.static_details.name().as_str()) {
            topics.push((sensor.to_owned(), topic));
        }
        CallbackProgression::Continue
    });
    listed.map_err(|error| access_failure(domain.root(), format!("cannot list topics: {error:?}")))?;
    topics.sort_by(|(one, _), (other, _)| one.cmp(other));
    Ok(topics)
}

/// Returns the payload's revision that the maker of a service wrote into its `attributes`; 0 if it wrote none.
pub fn payload_revision(attributes: &AttributeSet) -> u32 {
    let revision = attributes.iter().find(|attribute| attribute.key().as_bytes() == REVISION.as_bytes());
    revision.and_then(|attribute| attribute.value().to_string().parse().ok()).unwrap_or_default()
}

const REVISION: &str = "revision";

fn node(domain: &Domain, cleanup: bool) -> Result<Node, Failure> {
    set_log_level_from_env_or(LogLevel::Error);
    let root = domain.root();
    let _making = if cleanup {
        let making = MakingLock::wait(root)?;
        ensure_prefix(root, &making)?;
        remove_unfinished_services(root);
        Some(making)
    } else {
        None
    };
    let no_names = || {
        let hint = "its hub is just starting or ending, or has another version";
        Failure::new(
            Kind::NoHub,
            format!("{} does not contain the name of the shared memory", root.display()),
            hint,
        )
    };
    let mut config = config(root)?.ok_or_else(no_names)?;
    ensure_node_counter(&config.global.prefix.to_string())?;
    config.global.node.cleanup_dead_nodes_on_creation = cleanup;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    if !cleanup {
        config.global.creation_timeout = Duration::from_millis(100);
    }
    NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&config)
        .create::<Service>()
        .map_err(|error| access_failure(root, format!("cannot join {}: {error:?}", domain.name())))
}

/// Returns whether the names of shared memory of the domain in `root` are those that `node` has. They are others after all
/// have gone.
///
/// # Errors
///
/// As [`client_node`].
pub fn is_member(node: &Node, root: &Path) -> Result<bool, Failure> {
    let prefix = prefix_of(root)?;
    Ok(prefix.is_some_and(|prefix| node.config().global.prefix.as_bytes() == prefix.as_bytes()))
}

/// Where nobody is left in the domain in `root`: the next hub has other names, which nobody can have seen.
pub(crate) fn forget_names(root: &Path) {
    let Ok(Some(directory)) = Directory::open(root) else { return };
    // Not while somebody else joins to publish.
    let Ok(_making) = MakingLock::wait(root) else { return };
    if clean::nodes_at(root).is_ok_and(|nodes| nodes == Nodes::default()) {
        forget(&directory, root);
    }
}

fn forget(directory: &Directory, root: &Path) {
    if let Ok(Some(prefix)) = read_prefix(directory, root) {
        remove_node_counter(&prefix);
    }
    directory.remove(PREFIX_FILE.as_ref());
}

/// Nothing for a domain without names. In code, never from a file: the library would search the working directory for one.
fn config(root: &Path) -> Result<Option<Config>, Failure> {
    let Some(prefix) = prefix_of(root)? else { return Ok(None) };
    let unusable = || Failure::new(Kind::Configuration, format!("{} cannot be a root", root.display()), "");
    let path = iceoryx2::prelude::Path::new(root.as_os_str().as_bytes()).map_err(|_| unusable())?;
    let mut config = Config::default();
    config.global.prefix = FileName::new(prefix.as_bytes()).map_err(|_| unusable())?;
    config.global.set_root_path(&path);
    Ok(Some(config))
}

fn name(service: &str) -> Result<ServiceName, Failure> {
    ServiceName::new(service).map_err(|error| {
        Failure::new(Kind::Configuration, format!("{service:?} is no service: {error:?}"), "")
    })
}
