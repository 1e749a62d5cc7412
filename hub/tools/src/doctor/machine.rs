//! What a hub needs from the machine, whatever its sensors are: shared memory, and its own domain. Each check judges facts
//! that were gathered before, so that every verdict can be tested.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use config::needs;
use rustix::fs::{Access, access, statvfs};
use rustix::process::{Resource, getrlimit, getuid};
use schema::ipc::Nodes;
use schema::limits::TopicLimits;
use schema::shortage::SHARED_MEMORY;
use schema::{Domain, Environment, Failure, RunningHub};

use super::finding::Finding;
use super::hub::Hub;
use super::program;
use super::segments::{self, Segment};

/// What is known of the machine and the domain.
#[derive(Clone, Debug)]
pub(crate) struct Facts {
    pub(crate) links: usize,
    /// What the topics of each are made for.
    pub(crate) limits: Vec<TopicLimits>,
    /// None: it cannot be looked at.
    pub(crate) memory: Option<Memory>,
    /// The domain's name.
    pub(crate) name: String,
    /// Root path of the domain.
    pub(crate) root: PathBuf,
    /// The root path, or the nearest directory above that exists.
    pub(crate) place: Place,
    /// The hub's process, if one holds the domain.
    pub(crate) hub: Result<Option<u32>, Failure>,
    /// Links of that hub whose status did not come.
    pub(crate) mute: Vec<String>,
    /// Whether that hub's process was stopped, by a signal or a debugger.
    pub(crate) is_stopped: bool,
    /// Hubs of the same name at other places.
    pub(crate) others: Vec<(PathBuf, u32)>,
    /// Such places that are another user's, with whose they are.
    pub(crate) closed: Vec<(PathBuf, u32)>,
    /// Hubs of the same or an unknown name that other users run.
    pub(crate) foreign: Vec<RunningHub>,
    /// Processes at the domain's place, and the dead ones at others where no hub is.
    pub(crate) nodes: Result<Nodes, Failure>,
    /// Files in shared memory that may be the domain's and that nobody holds.
    pub(crate) segments: Vec<Segment>,
    /// The library's lock there, which the end of a hub leaves, and the next one takes.
    pub(crate) lock: Option<PathBuf>,
    /// Hard limit of open descriptors; none: no limit.
    pub(crate) descriptors: Option<u64>,
    /// How many this process has open, as would a hub that was started in its place.
    pub(crate) open: u64,
    /// Limit of a file's bytes; none: no limit.
    pub(crate) file_size: Option<u64>,
}

/// Shared memory.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Memory {
    /// Bytes; 0 is no limit.
    pub(crate) size: u64,
    pub(crate) free: u64,
    /// How many files it has room for; none: no limit.
    pub(crate) free_files: Option<u64>,
    pub(crate) is_read_only: bool,
}

/// A directory.
#[derive(Clone, Debug)]
pub(crate) struct Place {
    pub(crate) path: PathBuf,
    /// Permission bits.
    pub(crate) mode: u32,
    /// Something can be made in it.
    pub(crate) writable: bool,
}

impl Facts {
    /// Looks at everything; changes nothing.
    pub(crate) fn gather(
        domain: &Domain,
        places: &[Domain],
        limits: Vec<TopicLimits>,
        hub: Option<&Hub>,
    ) -> Facts {
        let root = domain.root();
        let elsewhere = || places.iter().filter(|place| place.root() != root);
        let held = |place: &Domain| schema::holder(place.root()).ok().flatten();
        let user = getuid().as_raw();
        let owner =
            |place: &Domain| place.root().ancestors().find_map(|path| Some(path.metadata().ok()?.uid()));
        let mut nodes = schema::ipc::nodes(domain);
        if let Ok(nodes) = &mut nodes {
            let free = elsewhere().filter(|place| held(place).is_none() && owner(place) == Some(user));
            nodes.dead += free.filter_map(|place| Some(schema::ipc::nodes(place).ok()?.dead)).sum::<usize>();
        }
        // Whoever lives there may be opening files: they are left in peace.
        let is_empty = nodes.as_ref().is_ok_and(|nodes| nodes.alive == 0) && held(domain).is_none();
        Facts {
            // To list them needs one too.
            open: fs::read_dir("/proc/self/fd").map_or(0, |entries| entries.count() as u64 - 1),
            links: limits.len(),
            limits,
            memory: Memory::of_machine(),
            name: domain.name().to_owned(),
            root: root.to_owned(),
            place: Place::nearest(root),
            hub: schema::holder(root),
            mute: hub.map(Hub::mute).unwrap_or_default(),
            is_stopped: hub.is_some_and(|hub| program::is_stopped(hub.pid)),
            others: elsewhere().filter_map(|place| Some((place.root().to_owned(), held(place)?))).collect(),
            closed: elsewhere()
                .filter(|place| schema::holder(place.root()).is_err())
                .filter_map(|place| Some((place.root().to_owned(), owner(place)?)))
                .collect(),
            foreign: RunningHub::all(Path::new("/"))
                .into_iter()
                .filter(|hub| hub.uid != user)
                .filter(|hub| hub.domain.as_ref().is_none_or(|own| own == domain.name()))
                .collect(),
            nodes,
            segments: if is_empty { segments::abandoned(&domain.prefix(), user) } else { Vec::new() },
            lock: if is_empty { segments::lock(&domain.prefix(), user) } else { None },
            descriptors: getrlimit(Resource::Nofile).maximum,
            file_size: getrlimit(Resource::Fsize).current,
        }
    }

    /// The hub that lives at the domain's place.
    pub(crate) fn lives(&self) -> Option<u32> {
        self.hub.as_ref().ok().copied().flatten()
    }
}

impl Memory {
    fn of_machine() -> Option<Memory> {
        let stat = statvfs(SHARED_MEMORY).ok()?;
        Some(Memory {
            size: stat.f_blocks * stat.f_frsize,
            free: stat.f_bavail * stat.f_frsize,
            free_files: (stat.f_files > 0).then_some(stat.f_ffree),
            is_read_only: access(SHARED_MEMORY, Access::WRITE_OK).is_err(),
        })
    }
}

impl Place {
    fn nearest(root: &Path) -> Place {
        let found = root.ancestors().find_map(|path| Some((path, path.metadata().ok()?)));
        match found {
            Some((path, metadata)) => Place {
                path: path.to_owned(),
                mode: metadata.mode() & 0o7777,
                writable: metadata.is_dir() && access(path, Access::WRITE_OK | Access::EXEC_OK).is_ok(),
            },
            None => Place { path: root.to_owned(), mode: 0, writable: false },
        }
    }
}

/// Whether shared memory has room for the links.
pub(crate) fn memory(facts: &Facts) -> Finding {
    const NAME: &str = "memory";
    let Some(Memory { size, free, free_files, is_read_only }) = facts.memory else {
        let remedy = format!("mount a tmpfs there: sudo mount -t tmpfs -o size=64M tmpfs {SHARED_MEMORY}");
        return Finding::failed(NAME, format!("{SHARED_MEMORY} cannot be read"), remedy);
    };
    if is_read_only {
        let text = format!("{SHARED_MEMORY} cannot be written to");
        return Finding::failed(NAME, text, format!("sudo mount -o remount,rw,mode=1777 {SHARED_MEMORY}"));
    }
    let files = facts.links as u64 * FILES_OF_LINK + FILES;
    if let Some(free_files) = free_files.filter(|&free| free < files && facts.lives().is_none()) {
        let text = format!("{SHARED_MEMORY} has room for {free_files} files, {files} needed");
        return Finding::failed(NAME, text, format!("sudo mount -o remount,nr_inodes=10k {SHARED_MEMORY}"));
    }
    if size == 0 {
        return Finding::ok(NAME, format!("{SHARED_MEMORY} has no limit"));
    }
    let needed = needs::memory(&facts.limits);
    let has = format!("{SHARED_MEMORY} has {} kB, {} kB of them free", size / 1024, free / 1024);
    if facts.lives().is_some() {
        return Finding::ok(NAME, format!("{has}; the hub has what it needs"));
    }
    let text = format!("{has}; {} kB needed for {}", needed / 1024, plural(facts.links as u64, "link"));
    if free >= needed {
        return Finding::ok(NAME, text);
    }
    let remedy = if size >= needed {
        format!("free some of {SHARED_MEMORY}")
    } else {
        format!(
            "make it larger: sudo mount -o remount,size=64M {SHARED_MEMORY}; of a container by --shm-size=64m"
        )
    };
    Finding::failed(NAME, text, remedy)
}

/// Whether a hub of this user can take its place, or has it.
pub(crate) fn domain(facts: &Facts) -> Finding {
    const NAME: &str = "domain";
    let (root, place) = (facts.root.display(), &facts.place);
    let at = place.path.display();
    match &facts.hub {
        Err(failure) => return Finding::failed(NAME, failure.message.clone(), failure.hint.clone()),
        Ok(Some(pid)) if facts.is_stopped => {
            let text = format!("{root}: the hub is stopped, process {pid}");
            return Finding::failed(NAME, text, format!("continue it: kill -CONT {pid}"));
        }
        Ok(Some(pid)) if !facts.mute.is_empty() => {
            let links = facts.mute.join(", ");
            let text =
                format!("{root}: the hub, process {pid}, does not publish: no status of {links} arrived");
            return Finding::failed(NAME, text, format!("look at its log, then restart it: kill {pid}"));
        }
        Ok(Some(pid)) => return Finding::ok(NAME, format!("{root}: a hub runs, process {pid}")),
        Ok(None) => {}
    }
    if place.path != facts.root {
        return if place.writable {
            Finding::ok(NAME, format!("{root}: does not exist yet, can be created"))
        } else {
            let text = format!("{root} cannot be created: nothing can be created in {at}");
            Finding::failed(NAME, text, "name another place with --root")
        };
    }
    if !place.writable {
        let text = format!("{at}: nothing can be created there, mode {:04o}", place.mode);
        return Finding::failed(NAME, text, format!("chmod 700 {at}, or name another place with --root"));
    }
    Finding::ok(NAME, format!("{root}: free, yours, mode {:04o}", place.mode))
}

/// Whether there is one hub of this name for everybody who names no place; where another user's may be `name_of` tells whose.
pub(crate) fn hubs(facts: &Facts, name_of: impl Fn(u32) -> String) -> Finding {
    const NAME: &str = "hubs";
    let others: Vec<String> =
        facts.others.iter().map(|(root, pid)| format!("{} (process {pid})", root.display())).collect();
    if others.is_empty() {
        let mut text = format!("no other hub of domain {}", facts.name);
        for (root, owner) in &facts.closed {
            let (root, owner) = (root.display(), name_of(*owner));
            text += &format!(
                "; only user {owner} can see what runs at {root}: sudo -u {owner} scanhub doctor; {SHARING}"
            );
        }
        let is_said = |hub: &&RunningHub| facts.closed.iter().any(|(_, owner)| *owner == hub.uid);
        for hub in facts.foreign.iter().filter(|hub| !is_said(hub)) {
            text += &format!("; {}", hub.whereabouts("doctor", &facts.name, &Environment::of_process()));
        }
        return Finding::ok(NAME, text);
    }
    Finding::warning(
        NAME,
        format!(
            "domain {} has another hub at {}; clients use the first one that runs",
            facts.name,
            others.join(", ")
        ),
        "end one of them, or give it its own --domain",
    )
}

pub(crate) fn plural(count: u64, what: &str) -> String {
    match (count, what.strip_suffix("ss")) {
        (1, _) => format!("1 {what}"),
        (_, Some(_)) => format!("{count} {what}es"),
        _ => format!("{count} {what}s"),
    }
}

/// How another user's hub can be heard.
const SHARING: &str = "to have its data here: `scanhub gateway --interface lo` under that user, and `scanhub listen --publish` \
                       under this one (docs/sharing.md)";

/// Files in shared memory of each link, and of what belongs to no link, with some for the first consumers.
const FILES_OF_LINK: u64 = 24;
const FILES: u64 = 8;

#[cfg(test)]
pub(super) mod tests {
    use schema::Kind;

    use super::*;
    use crate::doctor::finding::State;
    use crate::doctor::system::tests::Laid;

    const ROOMY: Memory = Memory { size: 64 << 20, free: 60 << 20, free_files: None, is_read_only: false };

    pub(crate) fn facts() -> Facts {
        Facts {
            links: 2,
            limits: vec![TopicLimits::default(); 2],
            memory: Some(ROOMY),
            name: "scanhub".into(),
            root: "/run/user/7/scanhub/scanhub".into(),
            place: Place { path: "/run/user/7".into(), mode: 0o700, writable: true },
            hub: Ok(None),
            mute: Vec::new(),
            is_stopped: false,
            others: Vec::new(),
            closed: Vec::new(),
            foreign: Vec::new(),
            nodes: Ok(Nodes::default()),
            segments: Vec::new(),
            lock: None,
            descriptors: Some(4096),
            open: 4,
            file_size: None,
        }
    }

    pub(crate) fn says(finding: &Finding, state: State, words: &[&str]) {
        assert_eq!(finding.state, state, "{finding}");
        let text = finding.to_string();
        assert!(words.iter().all(|word| text.contains(word)), "{text} lacks one of {words:?}");
        let needs_remedy = matches!(state, State::Warning | State::Failed);
        assert_eq!(finding.remedy.is_empty(), !needs_remedy, "{finding}");
    }

    #[test]
    fn memory_is_judged_by_what_the_links_need() {
        says(&memory(&facts()), State::Ok, &["61440 kB of them free", "2 links"]);
        let with = |memory: Memory| Facts { memory: Some(memory), ..facts() };
        let full = with(Memory { free: 1 << 10, ..ROOMY });
        says(&memory(&full), State::Failed, &["1 kB of them free", "free some"]);
        let small = with(Memory { size: 1 << 20, free: 1 << 20, ..ROOMY });
        says(&memory(&small), State::Failed, &["1024 kB", "remount", "--shm-size"]);
        says(&memory(&Facts { hub: Ok(Some(5)), ..full }), State::Ok, &["the hub has"]);
        says(&memory(&with(Memory { size: 0, free: 0, ..ROOMY })), State::Ok, &["no limit"]);
        says(&memory(&Facts { memory: None, ..facts() }), State::Failed, &["mount -t tmpfs"]);
        let crowded = with(Memory { free_files: Some(9), ..ROOMY });
        says(&memory(&crowded), State::Failed, &["room for 9 files", "nr_inodes"]);
        says(&memory(&with(Memory { free_files: Some(900), ..ROOMY })), State::Ok, &["free"]);
        let closed = with(Memory { is_read_only: true, ..ROOMY });
        says(&memory(&closed), State::Failed, &["cannot be written", "remount,rw"]);
    }

    #[test]
    fn a_domain_is_free_held_foreign_or_impossible() {
        let root: PathBuf = facts().root;
        let there = |mode| Facts {
            place: Place { path: root.clone(), mode, writable: mode & 0o200 != 0 },
            ..facts()
        };
        says(&domain(&facts()), State::Ok, &["does not exist yet"]);
        says(&domain(&there(0o700)), State::Ok, &["free", "0700"]);
        says(&domain(&there(0o500)), State::Failed, &["0500", "chmod 700"]);
        says(&domain(&Facts { hub: Ok(Some(41)), ..facts() }), State::Ok, &["process 41"]);
        let mute = Facts { hub: Ok(Some(41)), mute: vec!["front".into(), "rear".into()], ..facts() };
        says(&domain(&mute), State::Failed, &["process 41", "front, rear", "kill 41"]);
        let stopped = Facts { is_stopped: true, ..mute };
        says(&domain(&stopped), State::Failed, &["stopped, process 41", "kill -CONT 41"]);
        let closed = Place { path: "/run".into(), mode: 0o755, writable: false };
        says(&domain(&Facts { place: closed, ..facts() }), State::Failed, &["/run", "--root"]);
        let denied = Failure::new(Kind::Failed, "not yours", "ask");
        says(&domain(&Facts { hub: Err(denied), ..facts() }), State::Failed, &["not yours", "ask"]);
        assert!(!Place::nearest(Path::new("/dev/null/scanhub")).writable, "no directory");
    }

    #[test]
    fn two_hubs_of_one_name_are_one_too_many() {
        let hubs = |facts: &Facts| hubs(facts, |user| format!("u{user}"));
        says(&hubs(&facts()), State::Ok, &["scanhub"]);
        let closed = Facts { closed: vec![("/run/scanhub/scanhub".into(), 8)], ..facts() };
        says(&hubs(&closed), State::Ok, &["/run/scanhub/scanhub", "sudo -u u8 scanhub doctor"]);
        let files = [
            ("etc/passwd", "robot:x:9:9::/:\n"),
            ("proc/41/comm", "scanhub\n"),
            ("proc/41/status", "Uid:\t9\t9\t9\t9\n"),
            ("proc/41/cmdline", "scanhub\0run\0--domain=scanhub\0"),
            ("proc/42/comm", "scanhub\n"),
            ("proc/42/status", "Uid:\t9\t9\t9\t9\n"),
            ("proc/42/cmdline", "scanhub\0run\0"),
        ];
        let laid = Laid::out(7, &files);
        let foreign = Facts { foreign: RunningHub::all(&laid.path("")), ..facts() };
        let command = "user robot runs one, process 41: sudo -u robot scanhub doctor";
        let unknown = "runs one in an unknown domain, process 42: sudo -u robot scanhub list --domains";
        says(&hubs(&foreign), State::Ok, &["no other hub", command, unknown]);
        let two = Facts { others: vec![("/tmp/scanhub-7/scanhub".into(), 9)], ..facts() };
        says(&hubs(&two), State::Warning, &["/tmp/scanhub-7/scanhub (process 9)", "--domain"]);
    }
}
