//! The shared memory of a domain: where it is, who publishes in it, and the services of its topics. Only this crate
//! names the builders of iceoryx2; all other code uses its ports.
//!
//! The modules form layers. Each one uses only modules that are before it in this list:
//!
//! - files of a domain: `domain`, `running`, `shortage`, `directory`, `state`, `file_lock`, `prefix`, `segments`
//! - processes: `node`, `lock`, `clean`
//! - services: `service`, `doorbell`, `topic_service`, `wake`, `control`, `published`

mod clean;
mod control;
mod directory;
mod domain;
mod doorbell;
mod file_lock;
mod lock;
mod node;
mod prefix;
mod published;
mod running;
mod segments;
mod service;
pub mod shortage;
mod state;
mod topic_service;
mod wake;

pub use clean::{Cleaned, clean, is_unheld};
pub use control::{Asked, ControlClient, ControlServer, Pending};
pub use directory::Directory;
pub use domain::{DEFAULT_DOMAIN, Domain, Environment};
pub use doorbell::{Bell, Unsupported, sleep_at_bells};
pub use iceoryx2::port::update_connections::UpdateConnections;
pub use iceoryx2::port::{LoanError, ReceiveError, SendError};
/// Shared memory between processes. Its ports stay in their thread; nodes and services may move.
pub use iceoryx2::prelude::ipc::Service;
pub use iceoryx2::prelude::{PortFactory, ZeroCopySend};
pub use lock::{HubLock, ListenLock, NameLock, holder, is_starting, name_held, publisher, publisher_domain};
pub use node::{LIBRARY, Node, Nodes, client_node, hub_node, is_member, nodes};
pub use published::{links, published, sensors, sensors_with_zones};
pub use running::{RunningHub, shell_word};
pub use segments::{Segment, allocate, strangers};
pub use state::StateDirectory;
pub use topic_service::{
    Medium, Payload, Publisher, Sample, SampleMut, SharedMemory, Subscriber, TopicPublisher, TopicService,
    payload_revision, places,
};
pub use wake::{
    DueRings, Listener, Notifier, WakeService, Waker, descriptor, listener, open_wake, sleep, take_wakeups,
};
