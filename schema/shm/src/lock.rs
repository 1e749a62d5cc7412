//! Locks of the publishers in a domain: at most one hub, at most one listener for remote sensors, and one process for
//! each name of a sensor, tracker or mount. A lock ends with its process. Subscribers query the locks but never take
//! one.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::Duration;

use scanhub_schema::{Failure, Kind};

use crate::domain::{Domain, Environment};
use crate::file_lock::{FileLock, MakingLock, content, held_file, pid_in};
use crate::node::forget_names;
use crate::prefix::{ensure_prefix, read_prefix};

/// Lock of a hub on its domain. It ends with the value or with the process, however that ends. Drop it after the hub's
/// node.
#[derive(Debug)]
pub struct HubLock {
    publishing: Publishing,
}

impl HubLock {
    /// Creates the directory `root` for this user only, takes the lock, and writes this process's ID into it.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::DomainHeld`] if another hub has the lock; the message names its process. Returns
    /// [`Kind::Failed`] if the directory belongs to another user or cannot be created.
    pub fn acquire(root: &Path) -> Result<HubLock, Failure> {
        Ok(HubLock { publishing: Publishing::acquire(root, HUB, "hub")? })
    }

    /// Reports to clients that all topics exist. Until then, [`is_starting`] is true.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the lock's file cannot be written.
    pub fn report_ready(&self) -> Result<(), Failure> {
        let Publishing { root, lock, .. } = &self.publishing;
        lock.write(root, &format!("{}\n{READY}\n", std::process::id()))
    }
}

/// Lock of the listener that publishes remote sensors. It ends like a hub's lock, and both can exist in one domain.
#[derive(Debug)]
pub struct ListenLock {
    _publishing: Publishing,
}

impl ListenLock {
    /// Takes the lock as [`HubLock::acquire`] does.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`HubLock::acquire`], with another listener instead of another hub.
    pub fn acquire(root: &Path) -> Result<ListenLock, Failure> {
        Ok(ListenLock { _publishing: Publishing::acquire(root, LISTENER, "listener")? })
    }
}

/// Lock of the process that publishes under a name: a program with a tracker or a mount, or the hub with a link.
/// Doorbell and services of the name belong to this process alone. A hub is not necessary.
#[derive(Debug)]
pub struct NameLock {
    root: PathBuf,
    _lock: FileLock,
}

impl NameLock {
    /// Takes the lock of `name` as [`HubLock::acquire`] does.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::NameHeld`] if another process publishes under `name`; the message names it. Otherwise the
    /// errors of [`HubLock::acquire`].
    pub fn acquire(root: &Path, name: &str) -> Result<NameLock, Failure> {
        let lock = acquire(root, &format!("name.{name}.lock"), |pid| name_held(name, pid));
        Ok(NameLock { _lock: lock?, root: root.to_owned() })
    }
}

/// Returns the failure if process `pid` publishes under `name`.
pub fn name_held(name: &str, pid: u32) -> Failure {
    let process = match fs::read_to_string(format!("/proc/{pid}/comm")) {
        _ if pid == 0 => "another process".to_owned(),
        Ok(program) => format!("process {pid} ({})", program.trim_end()),
        Err(_) => format!("process {pid}"),
    };
    let what = format!("the name {name} is published by {process}");
    Failure::new(Kind::NameHeld, what, "end it, or choose another name")
}

impl Drop for NameLock {
    /// The last publisher removes the names of the shared memory, as `Publishing` does.
    fn drop(&mut self) {
        if let Ok(None) = publisher(&self.root) {
            forget_names(&self.root);
        }
    }
}

/// Lock of a hub or a listener, with the cleanup at its end.
#[derive(Debug)]
struct Publishing {
    root: PathBuf,
    name: &'static str,
    lock: FileLock,
}

impl Publishing {
    fn acquire(root: &Path, name: &'static str, who: &str) -> Result<Publishing, Failure> {
        let lock = acquire(root, name, |pid| held(root, who, pid))?;
        Ok(Publishing { lock, root: root.to_owned(), name })
    }
}

impl Drop for Publishing {
    /// The last publisher removes the names while it still has the lock. The next hub chooses other names.
    fn drop(&mut self) {
        let other = if self.name == HUB { LISTENER } else { HUB };
        // The holder of the other lock uses the names, or is about to join under them.
        if let Ok(None) = holder_of(&self.root, other) {
            forget_names(&self.root);
        }
    }
}

/// Takes the lock `name`, chooses a prefix if the domain has none, and writes this process's ID into the lock's file.
/// `held` returns the failure if another process has the lock.
fn acquire(root: &Path, name: &str, held: impl Fn(u32) -> Failure) -> Result<FileLock, Failure> {
    let lock = FileLock::acquire(root, name, held)?;
    // A reader that finds a process ID relies on the prefix.
    ensure_prefix(root, &MakingLock::wait(root)?)?;
    lock.write(root, &format!("{}\n", std::process::id()))?;
    Ok(lock)
}

/// Returns the process of the hub in the domain in `root`; 0 if the hub has not written its ID yet. `None` if no hub
/// runs there.
///
/// # Errors
///
/// Returns [`Kind::Failed`] if the directory belongs to another user.
pub fn holder(root: &Path) -> Result<Option<u32>, Failure> {
    holder_of(root, HUB)
}

/// Returns whether a hub in `root` does not have all its topics yet, and started at most a minute ago.
///
/// # Errors
///
/// Returns the errors of [`holder`].
pub fn is_starting(root: &Path) -> Result<bool, Failure> {
    let held = held_file(root, HUB)?;
    Ok(held.is_some_and(|(_, file)| content(&file).lines().nth(1) != Some(READY) && is_recent(&file)))
}

/// Returns the process that publishes in `root`: the hub, or otherwise a listener. 0 as for [`holder`].
///
/// # Errors
///
/// Returns the errors of [`holder`].
pub fn publisher(root: &Path) -> Result<Option<u32>, Failure> {
    match holder_of(root, HUB)? {
        None => holder_of(root, LISTENER),
        hub => Ok(hub),
    }
}

/// Returns the domain in which a program publishes: at the first place, in the order in which clients search, where a
/// hub or a listener is running. If none is, at the place that a hub in this `environment` would take, so that the hub
/// that starts next is in the same domain. Only below `base` if it is given.
///
/// # Errors
///
/// Returns the errors of [`Domain::at`].
pub fn publisher_domain(
    name: &str,
    base: Option<&Path>,
    environment: &Environment,
) -> Result<Domain, Failure> {
    let is_live = |domain: &Domain| matches!(publisher(domain.root()), Ok(Some(_)));
    match Domain::candidates(name, base, environment)?.into_iter().find(is_live) {
        Some(live) => Ok(live),
        None => Domain::of_hub(name, base, environment),
    }
}

fn holder_of(root: &Path, name: &str) -> Result<Option<u32>, Failure> {
    let Some((directory, file)) = held_file(root, name)? else { return Ok(None) };
    // A process that just starts or ends has the lock, and the file may have the ID of an earlier process.
    Ok(Some(if read_prefix(&directory, root)?.is_some() { pid_in(&file) } else { 0 }))
}

const HUB: &str = "hub.lock";
const LISTENER: &str = "listen.lock";
/// Maximum duration of a hub's start for clients. After it, a hub of a version that never reports that it is ready is
/// up.
const MAX_START: Duration = Duration::from_secs(60);
/// Second line of the file of a hub's lock once all topics exist.
const READY: &str = "ready";

/// Returns whether the file was written in the last minute. A clock that was set back does not count.
fn is_recent(file: &File) -> bool {
    let written = file.metadata().and_then(|metadata| metadata.modified());
    written.is_ok_and(|written| written.elapsed().is_ok_and(|age| age < MAX_START))
}

fn held(root: &Path, who: &str, pid: u32) -> Failure {
    Failure::new(
        Kind::DomainHeld,
        format!("another {who} holds {}: pid {pid}", root.display()),
        "stop it, or choose another --domain",
    )
}
