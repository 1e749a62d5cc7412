//! The shared memory of a domain: its location, the locks of its publishers, and the services of its topics. Only this
//! crate uses the builders of iceoryx2. All other code uses only the ports of iceoryx2.
//!
//! The modules form layers. Each module uses only modules that are before it in this list:
//!
//! - locations and files of a domain: `domain`, `resource_limits`, `directory`, `file_in_use`, `segments`
//! - processes: `processes`
//! - services: `service`, `doorbell`, `topic_service`, `wake`, `control`

mod control;
mod directory;
mod domain;
mod doorbell;
mod file_in_use;
mod processes;
pub mod resource_limits;
mod segments;
mod service;
mod topic_service;
mod wake;

pub use control::{ControlClient, ControlServer, IncomingRequest, SentRequest};
pub use directory::{Directory, StateDirectory};
pub use domain::{DEFAULT_DOMAIN, Domain, Environment, RunningHub, shell_word};
pub use doorbell::{Doorbell, WaitUnsupported, wait_on_doorbells};
pub use file_in_use::is_unused;
pub use iceoryx2::port::update_connections::UpdateConnections;
pub use iceoryx2::port::{LoanError, ReceiveError, SendError};
/// Shared memory between processes, with ports that must stay in the thread that created them. Nodes and services may
/// move between threads. The hub uses this kind of shared memory.
pub use iceoryx2::prelude::ipc::Service as LocalService;
/// Shared memory between processes, with ports and samples that may move between threads. These ports differ from the
/// ports of [`LocalService`] only in a lock within the process, so both kinds of ports can attach to one topic. Clients
/// use this kind of shared memory.
pub use iceoryx2::prelude::ipc_threadsafe::Service as ThreadSafeService;
pub use iceoryx2::prelude::{CallbackProgression, PortFactory, ZeroCopySend};
/// Kind of shared memory: [`LocalService`] or [`ThreadSafeService`].
pub use iceoryx2::service::Service;
pub use processes::{
    CleanupReport, HubLock, LIBRARY_VERSION, ListenLock, NameLock, Node, NodeCounts, Role, clean_up,
    client_node, hub_node, hub_pid, is_member, is_starting, join, name_taken, nodes, publisher_domain,
    publisher_pid,
};
pub use segments::{Segment, allocate, foreign_segments};
pub use service::{links, published_topics, sensors, sensors_with_zones};
pub use topic_service::{
    Payload, Publisher, Sample, SampleMut, SampleTransport, SharedMemory, Subscriber, TopicPublisher,
    TopicService, payload_revision, subscriber_capacity,
};
pub use wake::{
    Listener, Notifier, PendingWakeups, WakeSender, WakeService, descriptor, listener, open_wake, sleep,
    take_wakeups,
};
