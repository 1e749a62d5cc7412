//! Processes of a domain: their membership, the locks of processes that publish, and the cleanup after processes that
//! have died.
//!
//! - Each process joins with a [`Node`]. The last process that leaves removes the names of the domain's shared memory.
//! - At most one hub, at most one listener for remote sensors, and one process for each name of a sensor, tracker or
//!   mount hold a lock. A lock ends with its process. Subscribers query the locks but never take one.
//! - A cleanup removes only files in shared memory that belonged to a known dead process.

use std::fs::{self, File};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use iceoryx2::config::Config;
use iceoryx2::node::NodeState;
use iceoryx2::prelude::ipc::Service as LocalService;
use iceoryx2::prelude::{
    CallbackProgression, FileName, LogLevel, NodeBuilder, SemanticString, SignalHandlingMode,
    set_log_level_from_env_or,
};
use iceoryx2::service::Service;
use rustix::fs::FileType;
use scanhub_schema::{Failure, Kind};

use crate::directory::{Directory, FileLock, ServiceCreationLock, lock_text, locked_file, pid_in};
use crate::domain::{Domain, Environment};
use crate::segments::{
    access_failure, ensure_node_counter, ensure_prefix, prefix_of, read_prefix, remove_prefix,
};

/// Version of the shared-memory library. Processes with another version are refused.
pub const LIBRARY_VERSION: &str = "iceoryx2 0.10.0";

/// Membership of a process in a domain.
pub type Node<S = LocalService> = iceoryx2::node::Node<S>;

/// Role of a process in a domain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// A process that holds a [`HubLock`], [`ListenLock`] or [`NameLock`].
    Publisher,
    /// A process that only subscribes to topics.
    Subscriber,
}

/// Joins `domain` as a publisher, as [`join`] does. The ports of this node must stay in the thread that created them.
///
/// # Errors
///
/// Returns the errors of [`join`].
pub fn hub_node(domain: &Domain) -> Result<Node, Failure> {
    join(domain, Role::Publisher)
}

/// Joins `domain` as a subscriber, as [`join`] does. The ports of this node must stay in the thread that created them.
///
/// # Errors
///
/// Returns the errors of [`join`].
pub fn client_node(domain: &Domain) -> Result<Node, Failure> {
    join(domain, Role::Subscriber)
}

/// Returns the node of this process in `domain`. The node of a publisher removes the files that dead publishers and
/// subscribers left. The node of a subscriber removes no files.
///
/// # Errors
///
/// Returns [`Kind::OtherUser`] with owner, mode and remedy if the directory belongs to another user. For a subscriber,
/// returns [`Kind::NoHub`] if the domain has no prefix.
pub fn join<S: Service>(domain: &Domain, role: Role) -> Result<Node<S>, Failure> {
    set_log_level_from_env_or(LogLevel::Error);
    let (root, cleanup) = (domain.root(), role == Role::Publisher);
    let _lock = if cleanup {
        let lock = ServiceCreationLock::wait(root)?;
        ensure_prefix(root, &lock)?;
        remove_unfinished_services(root);
        Some(lock)
    } else {
        None
    };
    let no_prefix = || {
        let hint = "its hub is just starting or ending, or has another version";
        Failure::new(
            Kind::NoHub,
            format!("{} does not contain the name of the shared memory", root.display()),
            hint,
        )
    };
    let mut config = config(root)?.ok_or_else(no_prefix)?;
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
        .create::<S>()
        .map_err(|error| access_failure(root, format!("cannot join {}: {error:?}", domain.name())))
}

/// Returns whether `node` uses the current prefix of the domain in `root`. The prefix changes after all processes have
/// left.
///
/// # Errors
///
/// Returns the errors of [`client_node`].
pub fn is_member<S: Service>(node: &Node<S>, root: &Path) -> Result<bool, Failure> {
    let prefix = prefix_of(root)?;
    Ok(prefix.is_some_and(|prefix| node.config().global.prefix.as_bytes() == prefix.as_bytes()))
}

/// Processes that have joined a domain.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NodeCounts {
    /// Running processes.
    pub alive: usize,
    /// Processes that ended without cleaning up. Their files still exist.
    pub dead: usize,
}

/// Returns the number of processes in `domain`; 0 if the domain does not exist.
///
/// # Errors
///
/// Returns [`Kind::OtherUser`] with owner, mode and remedy if the directory belongs to another user.
pub fn nodes(domain: &Domain) -> Result<NodeCounts, Failure> {
    nodes_at(domain.root())
}

/// Returns the number of processes in the domain in `root`.
fn nodes_at(root: &Path) -> Result<NodeCounts, Failure> {
    let mut nodes = NodeCounts::default();
    let Some(config) = config(root)? else { return Ok(nodes) };
    let listed = Node::<LocalService>::list(&config, |state| {
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

/// Lock of a hub on its domain. The lock ends when this value is dropped, or when the process ends for any reason. Drop
/// this value after the hub's node.
#[derive(Debug)]
pub struct HubLock(PublisherLock);

impl HubLock {
    /// Creates the directory `root` for this user only, takes the lock, and writes this process's ID into it.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::DomainHeld`] if another hub has the lock; the message names its process. Returns
    /// [`Kind::OtherUser`] if the directory belongs to another user, and [`Kind::Failed`] if it cannot be created.
    pub fn acquire(root: &Path) -> Result<HubLock, Failure> {
        PublisherLock::acquire(root, HUB_LOCK_FILE, |pid| domain_held(root, "hub", pid)).map(HubLock)
    }

    /// Reports to clients that all topics exist. Until then, [`is_starting`] is true.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the lock's file cannot be written.
    pub fn report_ready(&self) -> Result<(), Failure> {
        self.0.lock.write(&self.0.root, &format!("{}\n{READY_LINE}\n", std::process::id()))
    }
}

/// Lock of the listener that publishes remote sensors. The lock ends like a hub's lock. A hub's lock and a listener's
/// lock can be held in one domain at the same time.
#[derive(Debug)]
pub struct ListenLock {
    _lock: PublisherLock,
}

impl ListenLock {
    /// Takes the lock as [`HubLock::acquire`] does.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`HubLock::acquire`], with another listener instead of another hub.
    pub fn acquire(root: &Path) -> Result<ListenLock, Failure> {
        let lock =
            PublisherLock::acquire(root, LISTENER_LOCK_FILE, |pid| domain_held(root, "listener", pid))?;
        Ok(ListenLock { _lock: lock })
    }
}

/// Lock of the process that publishes under a name: a program with a tracker or a mount, or the hub with a link.
/// Doorbell and services of the name belong to this process alone. The process can publish without a hub.
#[derive(Debug)]
pub struct NameLock {
    _lock: PublisherLock,
}

impl NameLock {
    /// Takes the lock of `name` as [`HubLock::acquire`] does.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::NameHeld`] if another process publishes under `name`; the message names this process. Otherwise,
    /// returns the errors of [`HubLock::acquire`].
    pub fn acquire(root: &Path, name: &str) -> Result<NameLock, Failure> {
        let lock = PublisherLock::acquire(root, &format!("name.{name}.lock"), |pid| name_taken(name, pid))?;
        Ok(NameLock { _lock: lock })
    }
}

/// Returns the failure if process `pid` publishes under `name`.
pub fn name_taken(name: &str, pid: u32) -> Failure {
    let process = match fs::read_to_string(format!("/proc/{pid}/comm")) {
        _ if pid == 0 => "another process".to_owned(),
        Ok(program) => format!("process {pid} ({})", program.trim_end()),
        Err(_) => format!("process {pid}"),
    };
    let message = format!("the name {name} is published by {process}");
    Failure::new(Kind::NameHeld, message, "end it, or choose another name")
}

/// Lock of a process that publishes. Dropping it cleans up.
#[derive(Debug)]
struct PublisherLock {
    root: PathBuf,
    name: String,
    lock: FileLock,
}

impl PublisherLock {
    /// Takes the lock `name`, chooses a prefix if the domain has none, and writes this process's ID into the lock's
    /// file. `on_held` returns the failure if another process has the lock.
    fn acquire(root: &Path, name: &str, on_held: impl Fn(u32) -> Failure) -> Result<PublisherLock, Failure> {
        let lock = FileLock::acquire(root, name, on_held)?;
        // Write the ID last: a reader that finds a process ID expects that the prefix exists.
        ensure_prefix(root, &ServiceCreationLock::wait(root)?)?;
        lock.write(root, &format!("{}\n", std::process::id()))?;
        Ok(PublisherLock { root: root.to_owned(), name: name.to_owned(), lock })
    }
}

impl Drop for PublisherLock {
    /// Removes the domain's names in shared memory while the lock is still held, if no other process uses these names.
    /// The next hub chooses other names.
    fn drop(&mut self) {
        // The holder of another lock uses the names, or will soon join with these names.
        let mut others = [HUB_LOCK_FILE, LISTENER_LOCK_FILE].into_iter().filter(|other| *other != self.name);
        if others.all(|other| matches!(lock_holder(&self.root, other), Ok(None))) {
            remove_names(&self.root);
        }
    }
}

/// Returns the ID of the hub's process in the domain in `root`; 0 if the hub has not written this ID yet. Returns
/// `None` if no hub runs in the domain.
///
/// # Errors
///
/// Returns [`Kind::OtherUser`] if the directory belongs to another user.
pub fn hub_pid(root: &Path) -> Result<Option<u32>, Failure> {
    lock_holder(root, HUB_LOCK_FILE)
}

/// Returns whether a hub in `root` does not have all its topics yet, and started at most a minute ago.
///
/// # Errors
///
/// Returns the errors of [`hub_pid`].
pub fn is_starting(root: &Path) -> Result<bool, Failure> {
    let held = locked_file(root, HUB_LOCK_FILE)?;
    Ok(held.is_some_and(|(_, file)| lock_text(&file).lines().nth(1) != Some(READY_LINE) && is_recent(&file)))
}

/// Returns the ID of the process that publishes in `root`: the hub, or otherwise a listener; 0 if the process has not
/// written this ID yet. Returns `None` if neither a hub nor a listener runs.
///
/// # Errors
///
/// Returns the errors of [`hub_pid`].
pub fn publisher_pid(root: &Path) -> Result<Option<u32>, Failure> {
    match lock_holder(root, HUB_LOCK_FILE)? {
        None => lock_holder(root, LISTENER_LOCK_FILE),
        hub => Ok(hub),
    }
}

/// Returns the domain in which a program publishes. This is the first location, in the order in which clients search,
/// where a hub or a listener is running. If neither is running at any location, it is the location that a hub in this
/// `environment` would use, so that the hub that starts next uses the same domain. If `base` is given, only locations
/// below `base` are considered.
///
/// # Errors
///
/// Returns the errors of [`Domain::at`].
pub fn publisher_domain(
    name: &str,
    base: Option<&Path>,
    environment: &Environment,
) -> Result<Domain, Failure> {
    let is_live = |domain: &Domain| matches!(publisher_pid(domain.root()), Ok(Some(_)));
    match Domain::candidates(name, base, environment)?.into_iter().find(is_live) {
        Some(live) => Ok(live),
        None => Domain::of_hub(name, base, environment),
    }
}

fn lock_holder(root: &Path, name: &str) -> Result<Option<u32>, Failure> {
    let Some((directory, file)) = locked_file(root, name)? else { return Ok(None) };
    // Without a prefix, the process with the lock is just starting or ending, and the file may have the ID of an
    // earlier process.
    Ok(Some(if read_prefix(&directory, root)?.is_some() { pid_in(&file) } else { 0 }))
}

/// Result of a cleanup.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CleanupReport {
    /// Processes that had ended without cleaning up.
    pub dead: usize,
    /// Processes that still run. Nothing that belongs to these processes was removed.
    pub alive: usize,
    /// Whether the domain's directory was removed.
    pub root: bool,
}

/// Removes files that dead processes left in `domain`. Everything that a running process uses stays, and so does the
/// directory while any process runs.
///
/// # Errors
///
/// Returns [`Kind::DomainHeld`](scanhub_schema::Kind) if a hub or a listener publishes in `domain`, because a hub or a
/// listener cleans up by itself. Returns [`Kind::OtherUser`](scanhub_schema::Kind) if the directory belongs to another
/// user.
pub fn clean_up(domain: &Domain) -> Result<CleanupReport, Failure> {
    let root = domain.root();
    let Some(directory) = Directory::open(root)? else { return Ok(CleanupReport::default()) };
    // No process can start to publish while these locks are held.
    let _hub = HubLock::acquire(root)?;
    let _listener = ListenLock::acquire(root)?;
    let before = nodes(domain)?;
    let node = hub_node(domain)?;
    node.blocking_cleanup_dead_nodes(CLEANUP_TIMEOUT);
    drop(node);
    let after = nodes(domain)?;
    let root = after.alive == 0 && after.dead == 0 && remove_domain(&directory, root);
    Ok(CleanupReport { dead: before.dead.saturating_sub(after.dead), alive: after.alive, root })
}

/// Removes the domain's `directory` at `root` with everything that only running processes need: empty directories,
/// locks, names, and the saved state of sensors. Returns whether the directory was removed. The directory stays if it
/// contains anything else.
fn remove_domain(directory: &Directory, root: &Path) -> bool {
    remove_prefix(directory, root);
    for (name, stat) in directory.entries() {
        let extension = Path::new(&name).extension();
        match FileType::from_raw_mode(stat.st_mode) {
            FileType::Directory => directory.remove_empty(&name),
            FileType::RegularFile if extension.is_some_and(|kind| kind == "lock" || kind == "sensor") => {
                directory.remove(&name);
            }
            _ => {}
        }
    }
    directory.remove_itself()
}

/// Removes the names of the domain in `root` if no process is left. The next hub chooses names that no other user can
/// have seen.
pub(crate) fn remove_names(root: &Path) {
    let Ok(Some(directory)) = Directory::open(root) else { return };
    // Keep the names while another process joins to publish.
    let Ok(_lock) = ServiceCreationLock::wait(root) else { return };
    if nodes_at(root).is_ok_and(|nodes| nodes == NodeCounts::default()) {
        remove_prefix(&directory, root);
    }
}

/// Returns the configuration of the shared-memory library; `None` for a domain without a prefix. The configuration is
/// never read from a file, because the library would search for this file in the working directory.
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
/// a service. The library waits for unfinished descriptions forever, and cleans up only finished ones. Without this
/// function, no later hub could create that service again.
///
/// The caller must hold the [`ServiceCreationLock`]. While the caller holds this lock, no process creates services, and
/// no process has opened an unfinished description. Finished descriptions are read-only.
fn remove_unfinished_services(root: &Path) {
    let Ok(Some(directory)) = Directory::open(root) else { return };
    let Some(services) = directory.subdirectory(SERVICES_DIRECTORY) else { return };
    for (name, stat) in services.entries() {
        let finished = stat.st_mode & 0o200 == 0;
        if !finished && name.to_string_lossy().ends_with(SERVICE_SUFFIX) {
            services.remove(&name);
        }
    }
}

/// Returns whether the file was written in the last minute. Returns `false` if the clock was set back since then.
fn is_recent(file: &File) -> bool {
    let written = file.metadata().and_then(|metadata| metadata.modified());
    written.is_ok_and(|written| written.elapsed().is_ok_and(|age| age < MAX_START_TIME))
}

fn domain_held(root: &Path, program: &str, pid: u32) -> Failure {
    Failure::new(
        Kind::DomainHeld,
        format!("another {program} holds {}: pid {pid}", root.display()),
        "stop it, or choose another --domain",
    )
}

const HUB_LOCK_FILE: &str = "hub.lock";
const LISTENER_LOCK_FILE: &str = "listen.lock";
/// Maximum duration of a hub's start. After this time, clients consider the hub as ready, even if the hub's version
/// never reports that it is ready.
const MAX_START_TIME: Duration = Duration::from_secs(60);
/// Second line of the file of a hub's lock, which the hub writes once all topics exist.
const READY_LINE: &str = "ready";

/// The library's directory of service descriptions, below the root.
const SERVICES_DIRECTORY: &str = "services";

const SERVICE_SUFFIX: &str = ".service";
/// Maximum time to wait for another process that is cleaning up after the same dead process.
const CLEANUP_TIMEOUT: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn foreign_files_of_a_domain_directory_remain() {
        let base = tempfile::tempdir().unwrap();
        let root = base.path().join("a");
        let directory = Directory::create(&root).unwrap();
        fs::create_dir(root.join("nodes")).unwrap();
        symlink(root.join("full"), root.join("link.lock")).unwrap();
        fs::create_dir(root.join("full")).unwrap();
        for file in ["hub.lock", "front.sensor", "prefix", "full/something.lock", "letter"] {
            fs::write(root.join(file), "").unwrap();
        }
        assert!(!remove_domain(&directory, &root));
        let mut left: Vec<_> = fs::read_dir(&root).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, ["full", "letter", "link.lock"]);
        assert!(root.join("full/something.lock").exists());
        for file in ["link.lock", "letter", "full/something.lock"] {
            fs::remove_file(root.join(file)).unwrap();
        }
        assert!(remove_domain(&directory, &root) && !root.exists());
        assert!(remove_domain(&directory, &root), "it is gone already");
    }
}
