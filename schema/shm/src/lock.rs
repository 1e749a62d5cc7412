//! Locks of the publishers in a domain: at most one hub, at most one listener for remote sensors, and one process for
//! each name of a sensor, tracker or mount. A lock ends with its process. Subscribers query the locks but never take
//! one.

use std::fs::{self, File};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use nix::errno::Errno;
use nix::fcntl::{FcntlArg, fcntl};
use nix::libc::{self, flock};

use crate::isolation::{ensure_prefix, read_prefix};
use crate::{Directory, Domain, Environment, shortage};
use schema::{Failure, Kind};

/// The lock of a hub on its domain; it ends with the value or with the process, however that ends. Drop it after the
/// hub's node.
#[derive(Debug)]
pub struct HubLock {
    publishing: Publishing,
}

impl HubLock {
    /// Creates the directory `root` for this user only, takes the lock and writes this process's id into it.
    ///
    /// # Errors
    ///
    /// [`Kind::DomainHeld`] if another hub has it (the message names its pid), [`Kind::Failed`] if the directory is
    /// another user's or cannot be created.
    pub fn acquire(root: &Path) -> Result<HubLock, Failure> {
        Ok(HubLock { publishing: Publishing::acquire(root, HUB, "hub")? })
    }

    /// Reports to clients that all topics exist. Until then, [`is_starting`] is true.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if the lock's file cannot be written.
    pub fn report_ready(&self) -> Result<(), Failure> {
        let Publishing { root, held, .. } = &self.publishing;
        let content = format!("{}\n{READY}\n", std::process::id());
        held.file.write_all_at(content.as_bytes(), 0).map_err(|error| unusable(root, &error))
    }
}

/// The lock of the listener that publishes what other machines send. It exists beside a hub's lock and ends like it.
#[derive(Debug)]
pub struct ListenLock {
    _publishing: Publishing,
}

impl ListenLock {
    /// Takes the lock as [`HubLock::acquire`] does.
    ///
    /// # Errors
    ///
    /// As [`HubLock::acquire`], with another listener.
    pub fn acquire(root: &Path) -> Result<ListenLock, Failure> {
        Ok(ListenLock { _publishing: Publishing::acquire(root, LISTENER, "listener")? })
    }
}

/// The lock of the process that publishes under a name: a program with a tracker or a mount, or the hub with a link. The
/// doorbell and the services of the name belong to this process alone. There need not be a hub.
#[derive(Debug)]
pub struct NameLock {
    root: PathBuf,
    _held: Held,
}

impl NameLock {
    /// Takes the lock of `name` as [`HubLock::acquire`] does.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::NameHeld`] if another process publishes under `name`; the message names it. Otherwise the errors of
    /// [`HubLock::acquire`].
    pub fn acquire(root: &Path, name: &str) -> Result<NameLock, Failure> {
        let held = Held::acquire(root, &format!("name.{name}.lock"), |pid| name_held(name, pid));
        Ok(NameLock { _held: held?, root: root.to_owned() })
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
    /// The last one out takes the names of the shared memory along, as `Publishing` does.
    fn drop(&mut self) {
        if let Ok(None) = publisher(&self.root) {
            crate::forget_names(&self.root);
        }
    }
}

/// The lock of who publishes, with what has to be done at its end.
#[derive(Debug)]
struct Publishing {
    root: PathBuf,
    name: &'static str,
    held: Held,
}

impl Publishing {
    fn acquire(root: &Path, name: &'static str, who: &str) -> Result<Publishing, Failure> {
        Ok(Publishing {
            held: Held::acquire(root, name, |pid| held(root, who, pid))?,
            root: root.to_owned(),
            name,
        })
    }
}

impl Drop for Publishing {
    /// The last one out takes the names along, while it still has the lock: the next hub has others.
    fn drop(&mut self) {
        let other = if self.name == HUB { LISTENER } else { HUB };
        // Whoever holds the other lock has the names, or is about to join under them.
        if let Ok(None) = holder_of(&self.root, other) {
            crate::forget_names(&self.root);
        }
    }
}

/// Held while services are made in a domain or what is left of unfinished ones is swept away, by hub, listener and
/// other publishing programs in turn.
pub(crate) struct MakingLock {
    _held: Held,
}

impl MakingLock {
    /// Waits for it; nobody holds it for longer than a service takes to be made.
    pub(crate) fn wait(root: &Path) -> Result<MakingLock, Failure> {
        let file = Held::open(root, MAKING)?;
        loop {
            match fcntl(file.as_raw_fd(), FcntlArg::F_OFD_SETLKW(&whole_file(libc::F_WRLCK))) {
                Ok(_) => return Ok(MakingLock { _held: Held { file } }),
                Err(Errno::EINTR) => {}
                Err(error) => return Err(unusable(root, &error.into())),
            }
        }
    }
}

/// A lock on a file.
#[derive(Debug)]
struct Held {
    file: File,
}

impl Held {
    /// `held` says who has it.
    fn acquire(root: &Path, name: &str, held: impl Fn(u32) -> Failure) -> Result<Held, Failure> {
        let file = loop {
            let file = Held::open(root, name)?;
            match fcntl(file.as_raw_fd(), FcntlArg::F_OFD_SETLK(&whole_file(libc::F_WRLCK))) {
                // Whoever held it until now may have taken the domain away, and the next one would lock another file.
                Ok(_) if file.metadata().is_ok_and(|metadata| metadata.nlink() == 0) => {}
                Ok(_) => break file,
                Err(Errno::EAGAIN | Errno::EACCES) => return Err(held(pid_in(&file))),
                Err(error) => return Err(unusable(root, &error.into())),
            }
        };
        // A process id that is read means that there is a prefix, too.
        file.set_len(0).map_err(|error| unusable(root, &error))?;
        let held = Held { file };
        ensure_prefix(root, &MakingLock::wait(root)?)?;
        let pid = format!("{}\n", std::process::id());
        held.file.write_all_at(pid.as_bytes(), 0).map_err(|error| unusable(root, &error))?;
        Ok(held)
    }

    fn open(root: &Path, name: &str) -> Result<File, Failure> {
        Directory::make(root)?.file_or_new(name)
    }
}

impl Drop for Held {
    /// Closing is not enough: a process that is just being started has a copy of the descriptor for a moment.
    fn drop(&mut self) {
        let _ = fcntl(self.file.as_raw_fd(), FcntlArg::F_OFD_SETLK(&whole_file(libc::F_UNLCK)));
    }
}

/// Returns the process that holds the domain in `root`, if a hub lives there; 0 in the moment in which it has not yet written
/// its pid.
///
/// # Errors
///
/// [`Kind::Failed`] if the directory is another user's.
pub fn holder(root: &Path) -> Result<Option<u32>, Failure> {
    holder_of(root, HUB)
}

/// Returns whether there is a hub in `root` that does not have all its topics yet, and that started at most a minute ago.
///
/// # Errors
///
/// As [`holder`].
pub fn is_starting(root: &Path) -> Result<bool, Failure> {
    let held = held_file(root, HUB)?;
    Ok(held.is_some_and(|(_, file)| content(&file).lines().nth(1) != Some(READY) && is_recent(&file)))
}

/// Returns the process that publishes in `root`: the hub, or else a listener; failures and 0 as with [`holder`].
///
/// # Errors
///
/// As [`holder`].
pub fn publisher(root: &Path) -> Result<Option<u32>, Failure> {
    match holder_of(root, HUB)? {
        None => holder_of(root, LISTENER),
        hub => Ok(hub),
    }
}

/// Returns the domain in which a program publishes: at the first place, in the order in which clients search, where a hub
/// or a listener is running. If none is, at the place that a hub in this `environment` would take, so that the hub that
/// starts next is in the same domain. Only below `base` if it is given.
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

/// Returns the file of the lock `name` and its directory if a process holds the lock.
fn held_file(root: &Path, name: &str) -> Result<Option<(Directory, File)>, Failure> {
    let Some(directory) = Directory::open(root)? else { return Ok(None) };
    let Some(file) = directory.file(name)? else { return Ok(None) };
    let mut lock = whole_file(libc::F_RDLCK);
    fcntl(file.as_raw_fd(), FcntlArg::F_OFD_GETLK(&mut lock))
        .map_err(|error| unusable(root, &error.into()))?;
    Ok((lock.l_type != libc::F_UNLCK as libc::c_short).then_some((directory, file)))
}

const HUB: &str = "hub.lock";
const LISTENER: &str = "listen.lock";
const MAKING: &str = "making.lock";
/// Maximum duration of a hub's start for clients. After it, a hub of a version that never reports that it is ready is
/// up.
const MAX_START: Duration = Duration::from_secs(60);
/// Second line of the file of a hub's lock once all topics exist.
const READY: &str = "ready";

/// A lock of the whole file, however long; `l_pid` has to be 0 for open file descriptions.
fn whole_file(kind: libc::c_int) -> flock {
    flock {
        l_type: kind as libc::c_short,
        l_whence: libc::SEEK_SET as libc::c_short,
        l_start: 0,
        l_len: 0,
        l_pid: 0,
    }
}

/// The lock itself tells no pid (the kernel answers -1), the file's content does.
fn pid_in(file: &File) -> u32 {
    content(file).lines().next().and_then(|pid| pid.parse().ok()).unwrap_or_default()
}

/// Returns whether the file was written in the last minute. A clock that was set back does not count.
fn is_recent(file: &File) -> bool {
    let written = file.metadata().and_then(|metadata| metadata.modified());
    written.is_ok_and(|written| written.elapsed().is_ok_and(|age| age < MAX_START))
}

fn content(file: &File) -> String {
    let mut bytes = [0; 32];
    let length = file.read_at(&mut bytes, 0).unwrap_or_default();
    String::from_utf8_lossy(&bytes[..length]).into_owned()
}

fn held(root: &Path, who: &str, pid: u32) -> Failure {
    Failure::new(
        Kind::DomainHeld,
        format!("another {who} holds {}: pid {pid}", root.display()),
        "stop it, or choose another --domain",
    )
}

fn unusable(root: &Path, error: &io::Error) -> Failure {
    shortage::found(root).unwrap_or_else(|| {
        Failure::new(Kind::Failed, format!("{}: {error}", root.display()), "choose another place with --root")
    })
}
