//! Monitor that makes a descriptor readable when a hub starts or ends, so that a program that polls the descriptor
//! needs no timer.
//!
//! Without a hub, inotify reports changes in the directories in which a hub creates its files. If such a directory does
//! not exist yet, the nearest existing directory above it is watched. With a hub, a pidfd reports the end of its
//! process.

use std::ffi::{OsStr, OsString};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, epoll, poll};
use rustix::fs::inotify;
use rustix::io::Errno;
use rustix::process::{Pid, PidfdFlags, pidfd_open};
use scanhub_shm::Domain;

/// Monitor of the hub of a domain. Its descriptors are in the epoll of the caller.
pub(crate) struct HubMonitor {
    epoll: Arc<OwnedFd>,
    /// Watched directories; `None` while a hub runs. They need an inotify instance, and a user can have only about a
    /// hundred.
    directories: Option<Directories>,
    /// The hub's process ID, and its pidfd until it has ended.
    hub: Option<(u32, Option<OwnedFd>)>,
}

/// Time for which changes are not reported after a change that does not concern a hub. In a directory such as /tmp,
/// other programs may create files all the time.
const UNRELATED_CHANGE_PAUSE: Duration = Duration::from_secs(2);

/// Interval of the checks for a hub if the directories cannot be watched.
const UNWATCHED_INTERVAL: Duration = Duration::from_secs(2);

/// Interval of the checks for a hub if all directories are watched. They are necessary because the kernel does not
/// report the removal of a directory while any process has a file in it open.
const RECHECK_INTERVAL: Duration = Duration::from_secs(10);

/// Files of a domain's directory that a hub or listener writes when it starts.
const HUB_FILES: [&str; 3] = ["hub.lock", "listen.lock", "prefix"];

impl HubMonitor {
    pub(crate) fn new(epoll: Arc<OwnedFd>) -> HubMonitor {
        HubMonitor { epoll, directories: None, hub: None }
    }

    /// Watches the process `pid` of the hub. Returns whether the process has ended since the last call.
    pub(crate) fn watch_hub(&mut self, pid: u32) -> bool {
        self.directories = None;
        if self.hub.as_ref().is_none_or(|(known, _)| *known != pid) {
            // If no pidfd can be opened, the caller notices the end of the hub when it checks after the interval.
            let process = i32::try_from(pid).ok().and_then(Pid::from_raw);
            let opened = process.and_then(|pid| pidfd_open(pid, PidfdFlags::empty()).ok());
            self.hub = Some((pid, opened.filter(|pidfd| add(&self.epoll, pidfd).is_ok())));
        }
        let Some((_, pidfd)) = &mut self.hub else { return false };
        let has_ended = pidfd.as_ref().is_some_and(is_readable);
        if has_ended {
            *pidfd = None;
        }
        has_ended
    }

    /// Watches the directories in which a hub would appear at `locations`. Returns whether something has changed since
    /// the last call, so that the caller must check for a hub.
    pub(crate) fn watch_directories(&mut self, locations: &[Domain]) -> bool {
        self.hub = None;
        let (directories, is_new) = match &mut self.directories {
            Some(directories) => (directories, false),
            none => match Directories::new(&self.epoll) {
                Ok(directories) => (none.insert(directories), true),
                Err(_) => return false,
            },
        };
        let change = directories.take();
        if change == Change::Unrelated {
            directories.pause(&self.epoll);
        } else {
            directories.resume(&self.epoll);
        }
        // Read the changes before watching: a directory that is created in between is then either watched now, or found
        // by the next call.
        directories.watch(locations) || is_new || change == Change::Related
    }

    /// Returns the time after which the caller must check for a hub even if nothing has changed.
    pub(crate) fn interval(&self) -> Duration {
        match &self.directories {
            Some(Directories { paused_until: Some(until), .. }) => {
                until.saturating_duration_since(Instant::now())
            }
            Some(directories) if directories.is_complete => RECHECK_INTERVAL,
            _ => UNWATCHED_INTERVAL,
        }
    }
}

/// Directories that are watched by one inotify.
struct Directories {
    inotify: OwnedFd,
    watches: Vec<WatchedDirectory>,
    /// Whether each directory that this user may read is watched.
    is_complete: bool,
    paused_until: Option<Instant>,
}

/// Directory to watch, with the number of its inotify watch if it is watched.
struct WatchedDirectory {
    target: Target,
    number: Option<i32>,
}

/// Directory to watch. `entry` is the name in it that leads to a domain; `None` for the domain's directory itself.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Target {
    directory: PathBuf,
    entry: Option<OsString>,
    /// Device and inode of the directory, which change if a program removes the directory and creates it again. `None`
    /// if the directory was removed before the monitor could watch it.
    inode: Option<(u64, u64)>,
}

/// Changes in the directories.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Change {
    None,
    /// Other files have changed.
    Unrelated,
    /// A file or directory of the domain has changed.
    Related,
}

impl Directories {
    fn new(epoll: &OwnedFd) -> Result<Directories, Errno> {
        let inotify = inotify::init(inotify::CreateFlags::CLOEXEC | inotify::CreateFlags::NONBLOCK)?;
        add(epoll, &inotify)?;
        Ok(Directories { inotify, watches: Vec::new(), is_complete: true, paused_until: None })
    }

    /// Watches the directories of `locations`. Returns whether these directories have changed since the last call.
    fn watch(&mut self, locations: &[Domain]) -> bool {
        let targets: Vec<Target> = locations.iter().map(|location| Target::of(location.root())).collect();
        if self.watches.iter().map(|watch| &watch.target).eq(&targets) {
            return false;
        }
        let old = std::mem::take(&mut self.watches);
        self.is_complete = true;
        for mut target in targets {
            let number = match inotify::add_watch(&self.inotify, &target.directory, target.flags()) {
                Ok(number) => Some(number),
                // The directory was removed. Forget its inode, because a directory that replaces it can have the same
                // inode.
                Err(Errno::NOENT | Errno::NOTDIR) => {
                    target.inode = None;
                    None
                }
                // The directory belongs to another user, so only that user can run a hub there.
                Err(Errno::ACCESS) => None,
                Err(_) => {
                    self.is_complete = false;
                    None
                }
            };
            self.watches.push(WatchedDirectory { target, number });
        }
        for number in old.into_iter().filter_map(|watch| watch.number) {
            if !self.watches.iter().any(|watch| watch.number == Some(number)) {
                // Ignore an error: a directory that was removed is not watched any more.
                let _ = inotify::remove_watch(&self.inotify, number);
            }
        }
        true
    }

    /// Takes all pending changes.
    fn take(&mut self) -> Change {
        let mut buffer = [MaybeUninit::uninit(); 4096];
        let mut reader = inotify::Reader::new(&self.inotify, &mut buffer);
        let mut change = Change::None;
        let mut is_lost = false;
        while let Ok(event) = reader.next() {
            let mut watches = self.watches.iter().filter(|watch| watch.number == Some(event.wd()));
            let name = event.file_name().map(|name| OsStr::from_bytes(name.to_bytes()));
            if event.events().intersects(WATCH_ENDED) {
                // A watch that was removed on purpose is not in the list any more.
                is_lost |=
                    event.events().contains(inotify::ReadFlags::QUEUE_OVERFLOW) || watches.next().is_some();
            } else if watches.any(|watch| watch.target.leads_to_hub(name)) {
                change = Change::Related;
            } else if change == Change::None {
                change = Change::Unrelated;
            }
        }
        if is_lost {
            self.watches.clear();
            change = Change::Related;
        }
        change
    }

    /// Pauses watching for a moment, unless it is already paused.
    fn pause(&mut self, epoll: &OwnedFd) {
        if self.paused_until.is_none_or(|until| until <= Instant::now()) {
            let nothing = epoll::EventFlags::empty();
            let _ = epoll::modify(epoll, &self.inotify, epoll::EventData::new_u64(0), nothing);
            self.paused_until = Some(Instant::now() + UNRELATED_CHANGE_PAUSE);
        }
    }

    /// Resumes watching after a pause.
    fn resume(&mut self, epoll: &OwnedFd) {
        if self.paused_until.is_some_and(|until| until <= Instant::now()) {
            let input = epoll::EventFlags::IN;
            let _ = epoll::modify(epoll, &self.inotify, epoll::EventData::new_u64(0), input);
            self.paused_until = None;
        }
    }
}

/// Events after which a directory may not be watched any more.
const WATCH_ENDED: inotify::ReadFlags = inotify::ReadFlags::IGNORED
    .union(inotify::ReadFlags::DELETE_SELF)
    .union(inotify::ReadFlags::MOVE_SELF)
    .union(inotify::ReadFlags::UNMOUNT)
    .union(inotify::ReadFlags::QUEUE_OVERFLOW);

impl Target {
    /// Returns the directory `root` of a domain, or the nearest one above it that exists.
    fn of(root: &Path) -> Target {
        let mut entry = None;
        for directory in root.ancestors() {
            if let Some(metadata) = directory.metadata().ok().filter(|metadata| metadata.is_dir()) {
                let inode = Some((metadata.dev(), metadata.ino()));
                return Target { directory: directory.to_owned(), entry: entry.map(OsStr::to_owned), inode };
            }
            entry = directory.file_name();
        }
        Target { directory: PathBuf::from("/"), entry: None, inode: None }
    }

    fn flags(&self) -> inotify::WatchFlags {
        use inotify::WatchFlags as W;
        let always = W::CREATE | W::MOVED_TO | W::DELETE_SELF | W::MOVE_SELF | W::ONLYDIR | W::MASK_ADD;
        if self.entry.is_none() { always | W::MODIFY | W::CLOSE_WRITE } else { always }
    }

    /// Returns whether the entry `name` leads to a hub.
    fn leads_to_hub(&self, name: Option<&OsStr>) -> bool {
        match &self.entry {
            Some(entry) => name == Some(entry),
            None => name.is_some_and(|name| HUB_FILES.iter().any(|file| name == *file)),
        }
    }
}

fn add(epoll: &OwnedFd, descriptor: &OwnedFd) -> Result<(), Errno> {
    epoll::add(epoll, descriptor, epoll::EventData::new_u64(0), epoll::EventFlags::IN)
}

fn is_readable(descriptor: &OwnedFd) -> bool {
    let mut fds = [PollFd::from_borrowed_fd(descriptor.as_fd(), PollFlags::IN)];
    poll(&mut fds, Some(&Timespec { tv_sec: 0, tv_nsec: 0 })) == Ok(1)
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::process::Command;

    use super::*;

    /// Timeout that is far longer than any step on a busy machine.
    const TEST_TIMEOUT: Timespec = Timespec { tv_sec: 60, tv_nsec: 0 };

    fn monitor() -> HubMonitor {
        HubMonitor::new(Arc::new(epoll::create(epoll::CreateFlags::CLOEXEC).unwrap()))
    }

    fn becomes_readable(monitor: &HubMonitor, within: Timespec) -> bool {
        poll(&mut [PollFd::new(&monitor.epoll, PollFlags::IN)], Some(&within)) == Ok(1)
    }

    const NO_WAIT: Timespec = Timespec { tv_sec: 0, tv_nsec: 0 };

    #[test]
    fn creation_of_each_parent_directory_is_a_change() {
        let base = tempfile::Builder::new().prefix("sh").tempdir_in("/tmp").unwrap();
        let locations = [Domain::at("lab", &base.path().join("a/b")).unwrap()];
        let mut monitor = monitor();
        assert!(monitor.watch_directories(&locations), "they are watched from now on");
        assert!(!monitor.watch_directories(&locations) && !becomes_readable(&monitor, NO_WAIT));
        for path in ["a", "a/b", "a/b/lab", "a/b/lab/hub.lock"] {
            let path = base.path().join(path);
            match path.extension() {
                None => fs::create_dir(path).unwrap(),
                Some(_) => fs::write(path, "1").unwrap(),
            }
            assert!(becomes_readable(&monitor, TEST_TIMEOUT));
            assert!(monitor.watch_directories(&locations));
            while monitor.watch_directories(&locations) {}
            assert!(!becomes_readable(&monitor, NO_WAIT));
        }
        fs::remove_dir_all(base.path().join("a")).unwrap();
        assert!(becomes_readable(&monitor, TEST_TIMEOUT) && monitor.watch_directories(&locations));
        while monitor.watch_directories(&locations) {}
        fs::create_dir_all(base.path().join("a/b/lab")).unwrap();
        assert!(becomes_readable(&monitor, TEST_TIMEOUT), "it watches where the directory was");
        assert_eq!(monitor.interval(), RECHECK_INTERVAL);
    }

    #[test]
    fn rewatches_replaced_directory_despite_an_open_file() {
        let base = tempfile::Builder::new().prefix("sh").tempdir_in("/tmp").unwrap();
        let domain = base.path().join("lab");
        let locations = [Domain::at("lab", base.path()).unwrap()];
        fs::create_dir(&domain).unwrap();
        let _open = fs::File::create(domain.join("other")).unwrap();
        let mut monitor = monitor();
        while monitor.watch_directories(&locations) {}
        fs::remove_dir_all(&domain).unwrap();
        fs::create_dir(&domain).unwrap();
        // No change is reported, so the caller checks after the interval.
        assert!(!becomes_readable(&monitor, NO_WAIT));
        assert!(monitor.interval() <= RECHECK_INTERVAL);
        assert!(monitor.watch_directories(&locations), "it is another directory");
        while monitor.watch_directories(&locations) {}
        fs::write(domain.join("hub.lock"), "1").unwrap();
        assert!(becomes_readable(&monitor, TEST_TIMEOUT) && monitor.watch_directories(&locations));
    }

    #[test]
    fn unrelated_files_pause_the_directory_watch() {
        let base = tempfile::Builder::new().prefix("sh").tempdir_in("/tmp").unwrap();
        let locations = [Domain::at("lab", base.path()).unwrap()];
        let mut monitor = monitor();
        while monitor.watch_directories(&locations) {}
        fs::write(base.path().join("other"), "").unwrap();
        assert!(becomes_readable(&monitor, TEST_TIMEOUT));
        assert!(!monitor.watch_directories(&locations), "it is not the domain");
        fs::write(base.path().join("another"), "").unwrap();
        assert!(!becomes_readable(&monitor, NO_WAIT), "it pauses");
        let interval = monitor.interval();
        assert!(interval <= UNRELATED_CHANGE_PAUSE, "it must look after the pause");
        fs::create_dir(base.path().join("lab")).unwrap();
        std::thread::sleep(interval);
        assert!(monitor.watch_directories(&locations), "nothing is lost by the pause");
    }

    #[test]
    fn exit_of_a_hub_is_reported_once() {
        let mut monitor = monitor();
        let mut hub = Command::new("sleep").arg("600").spawn().unwrap();
        assert!(!monitor.watch_hub(hub.id()) && !becomes_readable(&monitor, NO_WAIT));
        hub.kill().unwrap();
        assert!(becomes_readable(&monitor, TEST_TIMEOUT));
        assert!(monitor.watch_hub(hub.id()) && !monitor.watch_hub(hub.id()));
        assert!(!becomes_readable(&monitor, NO_WAIT));
        hub.wait().unwrap();
    }
}
