//! Processes in a domain: each one joins with a node. The last one to leave removes the domain's names.

use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::time::Duration;

use iceoryx2::config::Config;
use iceoryx2::node::NodeState;
use iceoryx2::prelude::ipc::Service;
use iceoryx2::prelude::{
    CallbackProgression, FileName, LogLevel, NodeBuilder, SemanticString, SignalHandlingMode,
    set_log_level_from_env_or,
};
use scanhub_schema::{Failure, Kind};

use crate::directory::Directory;
use crate::domain::Domain;
use crate::file_lock::MakingLock;
use crate::prefix::{ensure_prefix, prefix_of};
use crate::segments::{access_failure, ensure_node_counter, forget};

/// Version of the shared-memory library. Processes with another version are refused.
pub const LIBRARY: &str = "iceoryx2 0.10.0";

/// Membership of a process in a domain.
pub type Node = iceoryx2::node::Node<Service>;

/// Returns the node of a publisher in `domain`, which holds its [`HubLock`](crate::HubLock),
/// [`ListenLock`](crate::ListenLock) or a [`NameLock`](crate::NameLock). Removes the files that dead publishers and
/// subscribers left.
///
/// # Errors
///
/// Returns [`Kind::Failed`] with owner, mode and remedy if the directory belongs to another user.
pub fn hub_node(domain: &Domain) -> Result<Node, Failure> {
    node(domain, true)
}

/// Returns the node of a subscriber in `domain`. It removes no files.
///
/// # Errors
///
/// Returns the errors of [`hub_node`], and [`Kind::NoHub`] if the domain has no prefix.
pub fn client_node(domain: &Domain) -> Result<Node, Failure> {
    node(domain, false)
}

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

/// Returns whether `node` uses the current prefix of the domain in `root`. The prefix changes after all processes have
/// left.
///
/// # Errors
///
/// Returns the errors of [`client_node`].
pub fn is_member(node: &Node, root: &Path) -> Result<bool, Failure> {
    let prefix = prefix_of(root)?;
    Ok(prefix.is_some_and(|prefix| node.config().global.prefix.as_bytes() == prefix.as_bytes()))
}

/// Processes that have joined a domain.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Nodes {
    /// Running processes.
    pub alive: usize,
    /// Processes that ended without cleaning up. Their files still exist.
    pub dead: usize,
}

/// Returns the number of processes in `domain`; 0 if the domain does not exist.
///
/// # Errors
///
/// Returns [`Kind::Failed`] with owner, mode and remedy if the directory belongs to another user.
pub fn nodes(domain: &Domain) -> Result<Nodes, Failure> {
    nodes_at(domain.root())
}

/// Returns the number of processes in the domain in `root`.
fn nodes_at(root: &Path) -> Result<Nodes, Failure> {
    let mut nodes = Nodes::default();
    let Some(config) = config(root)? else { return Ok(nodes) };
    let listed = Node::list(&config, |state| {
        match state {
            NodeState::Alive(_) => nodes.alive += 1,
            NodeState::Dead(_) => nodes.dead += 1,
            NodeState::Inaccessible(_) | NodeState::Undefined(_) => {}
        }
        CallbackProgression::Continue
    });
    listed.map_err(|error| access_failure(root, format!("cannot list processes: {error:?}")))?;
    Ok(nodes)
}

/// Removes the names of the domain in `root` if no process is left. The next hub chooses names that no other user can
/// have seen.
pub(crate) fn forget_names(root: &Path) {
    let Ok(Some(directory)) = Directory::open(root) else { return };
    // Not while another process joins to publish.
    let Ok(_making) = MakingLock::wait(root) else { return };
    if nodes_at(root).is_ok_and(|nodes| nodes == Nodes::default()) {
        forget(&directory, root);
    }
}

/// Returns the configuration of the shared-memory library; `None` for a domain without a prefix. It never comes from a
/// file, which the library would search in the working directory.
pub(crate) fn config(root: &Path) -> Result<Option<Config>, Failure> {
    let Some(prefix) = prefix_of(root)? else { return Ok(None) };
    let unusable = || Failure::new(Kind::Configuration, format!("{} cannot be a root", root.display()), "");
    let path = iceoryx2::prelude::Path::new(root.as_os_str().as_bytes()).map_err(|_| unusable())?;
    let mut config = Config::default();
    config.global.prefix = FileName::new(prefix.as_bytes()).map_err(|_| unusable())?;
    config.global.set_root_path(&path);
    Ok(Some(config))
}

/// Removes unfinished service descriptions of the domain in `root`, which a hub leaves if it is killed while it creates
/// a service. The library waits for them forever and cleans up only finished ones, so no later hub could create that
/// service again.
///
/// The caller must hold the [`MakingLock`]. Then no process creates services, and no process has opened an unfinished
/// one. Finished descriptions are read-only.
fn remove_unfinished_services(root: &Path) {
    let Ok(Some(directory)) = Directory::open(root) else { return };
    let Some(services) = directory.below(SERVICES) else { return };
    for (name, stat) in services.entries() {
        let finished = stat.st_mode & 0o200 == 0;
        if !finished && name.to_string_lossy().ends_with(SUFFIX) {
            services.remove(&name);
        }
    }
}

/// The library's directory of service descriptions, below the root.
const SERVICES: &str = "services";

const SUFFIX: &str = ".service";
