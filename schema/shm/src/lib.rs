//! The shared memory of a domain: where it is, who publishes in it, and the services of its topics. Only this crate
//! names the builders of iceoryx2; all other code uses its ports.
//!
//! The modules form layers. Each one uses only modules that are before it in this list:
//!
//! - locations and files of a domain: `domain`, `shortage`, `directory`, `file_in_use`, `segments`
//! - processes: `processes`
//! - services: `service`, `doorbell`, `topic_service`, `wake`, `control`

mod control;
mod directory;
mod domain;
mod doorbell;
mod file_in_use;
mod processes;
mod segments;
mod service;
pub mod shortage;
mod topic_service;
mod wake;

pub use control::{Asked, ControlClient, ControlServer, Pending};
pub use directory::{Directory, StateDirectory};
pub use domain::{DEFAULT_DOMAIN, Domain, Environment, RunningHub, shell_word};
pub use doorbell::{Bell, Unsupported, sleep_at_bells};
pub use file_in_use::is_unheld;
pub use iceoryx2::port::update_connections::UpdateConnections;
pub use iceoryx2::port::{LoanError, ReceiveError, SendError};
/// Shared memory between processes. Its ports stay in their thread; nodes and services may move.
pub use iceoryx2::prelude::ipc::Service;
pub use iceoryx2::prelude::{PortFactory, ZeroCopySend};
pub use processes::{
    Cleaned, HubLock, LIBRARY, ListenLock, NameLock, Node, Nodes, clean, client_node, holder, hub_node,
    is_member, is_starting, name_held, nodes, publisher, publisher_domain,
};
pub use segments::{Segment, allocate, strangers};
pub use service::{links, published, sensors, sensors_with_zones};
pub use topic_service::{
    Medium, Payload, Publisher, Sample, SampleMut, SharedMemory, Subscriber, TopicPublisher, TopicService,
    payload_revision, places,
};
pub use wake::{
    DueRings, Listener, Notifier, WakeService, Waker, descriptor, listener, open_wake, sleep, take_wakeups,
};
