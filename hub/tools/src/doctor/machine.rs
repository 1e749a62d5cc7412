//! Checks the conditions that a hub needs on the machine with any sensors: shared memory, its own domain, descriptors
//! and file sizes, and the network interface of a gateway. Most checks use a [`MachineState`] that was gathered before,
//! so that tests can provide any state.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::fs::{Access, access, statvfs};
use rustix::process::{Resource, getrlimit, getuid};
use scanhub_config::resource_estimate;
use scanhub_schema::Failure;
use scanhub_schema::limits::TopicLimits;
use scanhub_shm::NodeCounts;
use scanhub_shm::resource_limits::SHARED_MEMORY_DIRECTORY;
use scanhub_shm::{Domain, Environment, RunningHub};

use super::hub::Hub;
use super::installation::is_stopped;
use super::shared_memory::{self, SharedFile};
use super::{Finding, System};

/// State of the machine and the domain.
#[derive(Clone, Debug)]
pub(crate) struct MachineState {
    pub(crate) links: usize,
    /// Limits of the topics of each link.
    pub(crate) limits: Vec<TopicLimits>,
    /// Shared memory; `None` if it cannot be read.
    pub(crate) memory: Option<Memory>,
    /// The domain's name.
    pub(crate) name: String,
    /// Root path of the domain.
    pub(crate) root: PathBuf,
    /// The root path, or the nearest directory above that exists.
    pub(crate) directory: ExistingDirectory,
    /// The hub's process, if one holds the domain.
    pub(crate) hub: Result<Option<u32>, Failure>,
    /// Links of that hub whose status did not arrive.
    pub(crate) links_without_status: Vec<String>,
    /// Whether that hub's process was stopped, by a signal or a debugger.
    pub(crate) is_stopped: bool,
    /// Hubs of the same name at other locations, with their processes.
    pub(crate) other_hubs: Vec<(PathBuf, u32)>,
    /// Other locations that belong to another user, with their owners.
    pub(crate) foreign_locations: Vec<(PathBuf, u32)>,
    /// Hubs of the same or an unknown name that other users run.
    pub(crate) foreign_hubs: Vec<RunningHub>,
    /// Processes at the domain's location, and dead processes at other locations without a hub.
    pub(crate) nodes: Result<NodeCounts, Failure>,
    /// Files in shared memory that may belong to the domain, and that no process holds.
    pub(crate) segments: Vec<SharedFile>,
    /// The lock file of iceoryx2 for the domain. A hub leaves this file at its exit, and the next hub takes it over.
    pub(crate) lock: Option<PathBuf>,
    /// Hard limit of open descriptors; `None` if there is no limit.
    pub(crate) descriptors: Option<u64>,
    /// Number of descriptors that this process has open. A hub that is started in its place would begin with the same
    /// number.
    pub(crate) open_descriptors: u64,
    /// Limit of the length of a file, in bytes; `None` if there is no limit.
    pub(crate) file_size: Option<u64>,
}

/// Shared memory.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Memory {
    /// Size in bytes; 0 means no limit.
    pub(crate) size: u64,
    pub(crate) free: u64,
    /// Number of files that shared memory still has room for; `None` if there is no limit.
    pub(crate) free_files: Option<u64>,
    pub(crate) is_read_only: bool,
}

/// A directory.
#[derive(Clone, Debug)]
pub(crate) struct ExistingDirectory {
    pub(crate) path: PathBuf,
    /// Permission bits.
    pub(crate) mode: u32,
    /// Whether this process can create files in it.
    pub(crate) writable: bool,
}

impl MachineState {
    /// Gathers the state, without changing anything.
    pub(crate) fn gather(
        domain: &Domain,
        locations: &[Domain],
        limits: Vec<TopicLimits>,
        hub: Option<&Hub>,
    ) -> MachineState {
        let root = domain.root();
        let elsewhere = || locations.iter().filter(|location| location.root() != root);
        let holder_of = |location: &Domain| scanhub_shm::hub_pid(location.root()).ok().flatten();
        let user = getuid().as_raw();
        let owner = |location: &Domain| {
            location.root().ancestors().find_map(|path| Some(path.metadata().ok()?.uid()))
        };
        let mut nodes = scanhub_shm::nodes(domain);
        if let Ok(nodes) = &mut nodes {
            let free =
                elsewhere().filter(|location| holder_of(location).is_none() && owner(location) == Some(user));
            nodes.dead +=
                free.filter_map(|location| Some(scanhub_shm::nodes(location).ok()?.dead)).sum::<usize>();
        }
        // A process that runs at this location may be opening files, so files that no process holds do not count as
        // left then.
        let is_empty = nodes.as_ref().is_ok_and(|nodes| nodes.alive == 0) && holder_of(domain).is_none();
        MachineState {
            // Listing the descriptors needs a descriptor, too, which is subtracted.
            open_descriptors: fs::read_dir("/proc/self/fd").map_or(0, |entries| entries.count() as u64 - 1),
            links: limits.len(),
            limits,
            memory: Memory::of_machine(),
            name: domain.name().to_owned(),
            root: root.to_owned(),
            directory: ExistingDirectory::nearest(root),
            hub: scanhub_shm::hub_pid(root),
            links_without_status: hub.map(Hub::mute).unwrap_or_default(),
            is_stopped: hub.is_some_and(|hub| is_stopped(hub.pid)),
            other_hubs: elsewhere()
                .filter_map(|location| Some((location.root().to_owned(), holder_of(location)?)))
                .collect(),
            foreign_locations: elsewhere()
                .filter(|location| scanhub_shm::hub_pid(location.root()).is_err())
                .filter_map(|location| Some((location.root().to_owned(), owner(location)?)))
                .collect(),
            foreign_hubs: RunningHub::all(Path::new("/"))
                .into_iter()
                .filter(|hub| hub.uid != user)
                .filter(|hub| hub.domain.as_ref().is_none_or(|own| own == domain.name()))
                .collect(),
            nodes,
            segments: if is_empty {
                shared_memory::abandoned_files(&domain.prefix(), user)
            } else {
                Vec::new()
            },
            lock: if is_empty { shared_memory::lock(&domain.prefix(), user) } else { None },
            descriptors: getrlimit(Resource::Nofile).maximum,
            file_size: getrlimit(Resource::Fsize).current,
        }
    }

    /// Returns the process of the hub at the domain's location.
    pub(crate) fn hub_pid(&self) -> Option<u32> {
        self.hub.as_ref().ok().copied().flatten()
    }
}

impl Memory {
    fn of_machine() -> Option<Memory> {
        let stat = statvfs(SHARED_MEMORY_DIRECTORY).ok()?;
        Some(Memory {
            size: stat.f_blocks * stat.f_frsize,
            free: stat.f_bavail * stat.f_frsize,
            free_files: (stat.f_files > 0).then_some(stat.f_ffree),
            is_read_only: access(SHARED_MEMORY_DIRECTORY, Access::WRITE_OK).is_err(),
        })
    }
}

impl ExistingDirectory {
    fn nearest(root: &Path) -> ExistingDirectory {
        let found = root.ancestors().find_map(|path| Some((path, path.metadata().ok()?)));
        match found {
            Some((path, metadata)) => ExistingDirectory {
                path: path.to_owned(),
                mode: metadata.mode() & 0o7777,
                writable: metadata.is_dir() && access(path, Access::WRITE_OK | Access::EXEC_OK).is_ok(),
            },
            None => ExistingDirectory { path: root.to_owned(), mode: 0, writable: false },
        }
    }
}

/// Checks whether shared memory has room for the links. `saving_remedy` is a remedy that makes the links need less
/// memory.
pub(crate) fn memory(state: &MachineState, saving_remedy: Option<String>) -> Finding {
    const NAME: &str = "memory";
    let Some(Memory { size, free, free_files, is_read_only }) = state.memory else {
        let remedy =
            format!("mount a tmpfs there: sudo mount -t tmpfs -o size=64M tmpfs {SHARED_MEMORY_DIRECTORY}");
        return Finding::failed(NAME, format!("{SHARED_MEMORY_DIRECTORY} cannot be read"), remedy);
    };
    if is_read_only {
        let text = format!("{SHARED_MEMORY_DIRECTORY} cannot be written to");
        return Finding::failed(
            NAME,
            text,
            format!("sudo mount -o remount,rw,mode=1777 {SHARED_MEMORY_DIRECTORY}"),
        );
    }
    let files = state.links as u64 * FILES_PER_LINK + BASE_FILES;
    if let Some(free_files) = free_files.filter(|&free| free < files && state.hub_pid().is_none()) {
        let text = format!("{SHARED_MEMORY_DIRECTORY} has room for {free_files} files, {files} needed");
        return Finding::failed(
            NAME,
            text,
            format!("sudo mount -o remount,nr_inodes=10k {SHARED_MEMORY_DIRECTORY}"),
        );
    }
    if size == 0 {
        return Finding::ok(NAME, format!("{SHARED_MEMORY_DIRECTORY} has no limit"));
    }
    let needed = resource_estimate::memory(&state.limits);
    let has = format!("{SHARED_MEMORY_DIRECTORY} has {} kB, {} kB of them free", size / 1024, free / 1024);
    if state.hub_pid().is_some() {
        return Finding::ok(NAME, format!("{has}; the hub has what it needs"));
    }
    let text = format!("{has}; {} kB needed for {}", needed / 1024, plural(state.links as u64, "link"));
    if free >= needed {
        return Finding::ok(NAME, text);
    }
    let remedy = if size >= needed {
        format!("free some of {SHARED_MEMORY_DIRECTORY}")
    } else {
        format!(
            "make it larger: sudo mount -o remount,size=64M {SHARED_MEMORY_DIRECTORY}; of a container by --shm-size=64m"
        )
    };
    let remedy = saving_remedy.map_or(remedy.clone(), |less| format!("{remedy}; {less}"));
    Finding::failed(NAME, text, remedy)
}

/// Checks whether a hub of this user has the domain, or can create it.
pub(crate) fn domain(state: &MachineState) -> Finding {
    const NAME: &str = "domain";
    let (root, directory) = (state.root.display(), &state.directory);
    let at = directory.path.display();
    match &state.hub {
        Err(failure) => return Finding::failed(NAME, failure.message.clone(), failure.hint.clone()),
        Ok(Some(pid)) if state.is_stopped => {
            let text = format!("{root}: the hub is stopped, process {pid}");
            return Finding::failed(NAME, text, format!("continue it: kill -CONT {pid}"));
        }
        Ok(Some(pid)) if !state.links_without_status.is_empty() => {
            let links = state.links_without_status.join(", ");
            let text =
                format!("{root}: the hub, process {pid}, does not publish: no status of {links} arrived");
            return Finding::failed(NAME, text, format!("read its log, then restart it: kill {pid}"));
        }
        Ok(Some(pid)) => return Finding::ok(NAME, format!("{root}: a hub runs, process {pid}")),
        Ok(None) => {}
    }
    if directory.path != state.root {
        return if directory.writable {
            Finding::ok(NAME, format!("{root}: does not exist yet, can be created"))
        } else {
            let text = format!("{root} cannot be created: nothing can be created in {at}");
            Finding::failed(NAME, text, "name another directory with --root")
        };
    }
    if !directory.writable {
        let text = format!("{at}: nothing can be created there, mode {:04o}", directory.mode);
        return Finding::failed(NAME, text, format!("chmod 700 {at}, or name another directory with --root"));
    }
    Finding::ok(NAME, format!("{root}: free, yours, mode {:04o}", directory.mode))
}

/// Checks whether there is only one hub of this name for clients that name no location. `name_of` returns the name of
/// the owner of another location.
pub(crate) fn hubs(state: &MachineState, name_of: impl Fn(u32) -> String) -> Finding {
    const NAME: &str = "hubs";
    let others: Vec<String> =
        state.other_hubs.iter().map(|(root, pid)| format!("{} (process {pid})", root.display())).collect();
    if others.is_empty() {
        let mut text = format!("no other hub of domain {}", state.name);
        for (root, owner) in &state.foreign_locations {
            let (root, owner) = (root.display(), name_of(*owner));
            text += &format!(
                "; only user {owner} can see what runs at {root}: sudo -u {owner} scanhub doctor; {SHARING_REMEDY}"
            );
        }
        let is_listed =
            |hub: &&RunningHub| state.foreign_locations.iter().any(|(_, owner)| *owner == hub.uid);
        for hub in state.foreign_hubs.iter().filter(|hub| !is_listed(hub)) {
            text += &format!("; {}", hub.describe("doctor", &state.name, &Environment::of_process()));
        }
        return Finding::ok(NAME, text);
    }
    Finding::warning(
        NAME,
        format!(
            "domain {} has another hub at {}; clients use the first one that runs",
            state.name,
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

/// Remedy to receive data of another user's hub.
const SHARING_REMEDY: &str = "to have its data here: `scanhub gateway --interface lo` under that user, and `scanhub listen --publish` \
                       under this one (docs/sharing.md)";

/// Number of files in shared memory for each link, with some for the first subscribers.
const FILES_PER_LINK: u64 = 24;
/// Number of files in shared memory that belong to no link.
const BASE_FILES: u64 = 8;

/// Checks whether a hub may open enough descriptors.
pub(crate) fn descriptors(state: &MachineState) -> Finding {
    const NAME: &str = "descriptors";
    let Some(limit) = state.descriptors else { return Finding::ok(NAME, "no limit") };
    let own = state.open_descriptors + DESCRIPTORS_AT_START + resource_estimate::descriptors(state.links);
    let remedy = "raise the hard limit: for this shell sudo prlimit --pid $$ --nofile=65536:65536, of a service LimitNOFILE=65536, \
         of a container --ulimit nofile=65536";
    let Some(remaining) = limit.checked_sub(own) else {
        let text = format!("{limit} at most, the hub needs {own}");
        return Finding::failed(NAME, text, remedy);
    };
    let subscribers = remaining / DESCRIPTORS_PER_SUBSCRIBER;
    let text = format!("{limit} at most: enough for about {subscribers} subscribers of a topic");
    if subscribers >= MIN_SUBSCRIBERS {
        Finding::ok(NAME, text)
    } else {
        Finding::warning(NAME, text, remedy)
    }
}

/// Checks whether a hub may create files as long as the longest segment. A signal ends a process that exceeds the
/// limit.
pub(crate) fn file_size(state: &MachineState) -> Finding {
    const NAME: &str = "file-size";
    let Some(limit) = state.file_size else { return Finding::ok(NAME, "no limit") };
    let longest = resource_estimate::longest_segment(&state.limits);
    let text = format!("{} kB at most; the longest segment has {} kB", limit / 1024, longest / 1024);
    if limit >= longest {
        return Finding::ok(NAME, text);
    }
    Finding::failed(NAME, text, "lift the limit: ulimit -f unlimited, LimitFSIZE= of a service")
}

/// Number of descriptors that a hub has open when it checks their number: five for the signals, and one for its lock.
const DESCRIPTORS_AT_START: u64 = 6;
/// Number of descriptors for each subscriber to a topic.
const DESCRIPTORS_PER_SUBSCRIBER: u64 = 4;
/// Number of subscribers for which the descriptors must suffice. A robot hardly ever has more.
const MIN_SUBSCRIBERS: u64 = 50;

/// Checks whether the interface that the configuration names for a gateway can send multicast datagrams. Sends nothing.
/// Without such a name, a gateway sends nothing to groups, and a listener receives on every interface that has a link.
pub(crate) fn multicast(system: &System, interface: Option<&str>) -> Finding {
    const NAME: &str = "multicast";
    let Some(name) = interface else {
        return Finding::skipped(NAME, "no gateway.interface is named, so nothing is sent to groups");
    };
    // This list has the interfaces of the network namespace of this process. /sys may show the interfaces of another
    // namespace.
    let list = system.text("proc/net/dev").unwrap_or_default();
    let names: Vec<&str> = list.lines().filter_map(|line| Some(line.split_once(':')?.0.trim())).collect();
    if !names.contains(&name) {
        return Finding::failed(
            NAME,
            format!("gateway.interface: there is no network interface {name:?}"),
            format!("correct it, there are {}; or plug it in", names.join(", ")),
        );
    }
    let directory = system.path("sys/class/net").join(name);
    let number = |file: &str| {
        let text = std::fs::read_to_string(directory.join(file)).ok()?;
        u32::from_str_radix(text.trim().trim_start_matches("0x"), 16).ok()
    };
    let Some(flags) = number("flags") else {
        return Finding::ok(
            NAME,
            format!("by {name}, as set in gateway.interface; its state is not shown here"),
        );
    };
    if flags & LOOPBACK != 0 {
        return Finding::ok(NAME, format!("by {name}, as set in gateway.interface: this machine only"));
    }
    if flags & MULTICAST == 0 {
        let text = format!("gateway.interface: {name} carries no multicast");
        return Finding::failed(NAME, text, "name another one, or hosts under gateway.to");
    }
    if flags & UP == 0 {
        return Finding::warning(NAME, format!("{name} is down"), format!("sudo ip link set {name} up"));
    }
    if number("carrier") != Some(1) {
        return Finding::warning(NAME, format!("{name} is up and has no link"), "plug its cable in");
    }
    Finding::ok(NAME, format!("by {name}, as set in gateway.interface; it is up"))
}

/// Flag of an interface that is up (linux/if.h, as the next two flags).
const UP: u32 = 0x1;
const LOOPBACK: u32 = 0x8;
const MULTICAST: u32 = 0x1000;

#[cfg(test)]
pub(super) use tests::{facts, says};

#[cfg(test)]
mod tests {
    use scanhub_schema::Kind;

    use super::*;
    use crate::doctor::State;
    use crate::doctor::installation::TempRoot;

    const ROOMY: Memory = Memory { size: 64 << 20, free: 60 << 20, free_files: None, is_read_only: false };

    pub(crate) fn facts() -> MachineState {
        MachineState {
            links: 2,
            limits: vec![TopicLimits::default(); 2],
            memory: Some(ROOMY),
            name: "scanhub".into(),
            root: "/run/user/7/scanhub/scanhub".into(),
            directory: ExistingDirectory { path: "/run/user/7".into(), mode: 0o700, writable: true },
            hub: Ok(None),
            links_without_status: Vec::new(),
            is_stopped: false,
            other_hubs: Vec::new(),
            foreign_locations: Vec::new(),
            foreign_hubs: Vec::new(),
            nodes: Ok(NodeCounts::default()),
            segments: Vec::new(),
            lock: None,
            descriptors: Some(4096),
            open_descriptors: 4,
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
    fn compares_memory_with_need_of_links() {
        says(&memory(&facts(), None), State::Ok, &["61440 kB of them free", "2 links"]);
        let with = |memory: Memory| MachineState { memory: Some(memory), ..facts() };
        let full = with(Memory { free: 1 << 10, ..ROOMY });
        says(&memory(&full, None), State::Failed, &["1 kB of them free", "free some"]);
        let small = with(Memory { size: 1 << 20, free: 1 << 20, ..ROOMY });
        let less = Some("a named family needs less".to_owned());
        says(&memory(&small, less), State::Failed, &["--shm-size=64m; a named family needs less"]);
        says(&memory(&small, None), State::Failed, &["1024 kB", "remount", "--shm-size"]);
        says(&memory(&MachineState { hub: Ok(Some(5)), ..full }, None), State::Ok, &["the hub has"]);
        says(&memory(&with(Memory { size: 0, free: 0, ..ROOMY }), None), State::Ok, &["no limit"]);
        says(&memory(&MachineState { memory: None, ..facts() }, None), State::Failed, &["mount -t tmpfs"]);
        let crowded = with(Memory { free_files: Some(9), ..ROOMY });
        says(&memory(&crowded, None), State::Failed, &["room for 9 files", "nr_inodes"]);
        says(&memory(&with(Memory { free_files: Some(900), ..ROOMY }), None), State::Ok, &["free"]);
        let closed = with(Memory { is_read_only: true, ..ROOMY });
        says(&memory(&closed, None), State::Failed, &["cannot be written", "remount,rw"]);
    }

    #[test]
    fn checks_location_of_domain() {
        let root: PathBuf = facts().root;
        let there = |mode| MachineState {
            directory: ExistingDirectory { path: root.clone(), mode, writable: mode & 0o200 != 0 },
            ..facts()
        };
        says(&domain(&facts()), State::Ok, &["does not exist yet"]);
        says(&domain(&there(0o700)), State::Ok, &["free", "0700"]);
        says(&domain(&there(0o500)), State::Failed, &["0500", "chmod 700"]);
        says(&domain(&MachineState { hub: Ok(Some(41)), ..facts() }), State::Ok, &["process 41"]);
        let mute = MachineState {
            hub: Ok(Some(41)),
            links_without_status: vec!["front".into(), "rear".into()],
            ..facts()
        };
        says(&domain(&mute), State::Failed, &["process 41", "front, rear", "kill 41"]);
        let stopped = MachineState { is_stopped: true, ..mute };
        says(&domain(&stopped), State::Failed, &["stopped, process 41", "kill -CONT 41"]);
        let closed = ExistingDirectory { path: "/run".into(), mode: 0o755, writable: false };
        says(&domain(&MachineState { directory: closed, ..facts() }), State::Failed, &["/run", "--root"]);
        let denied = Failure::new(Kind::Failed, "not yours", "ask");
        says(&domain(&MachineState { hub: Err(denied), ..facts() }), State::Failed, &["not yours", "ask"]);
        assert!(!ExistingDirectory::nearest(Path::new("/dev/null/scanhub")).writable, "no directory");
    }

    #[test]
    fn warns_of_two_hubs_with_same_name() {
        let hubs = |facts: &MachineState| hubs(facts, |user| format!("u{user}"));
        says(&hubs(&facts()), State::Ok, &["scanhub"]);
        let closed = MachineState { foreign_locations: vec![("/run/scanhub/scanhub".into(), 8)], ..facts() };
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
        let temp = TempRoot::new(7, &files);
        let foreign = MachineState { foreign_hubs: RunningHub::all(&temp.path("")), ..facts() };
        let command = "user robot runs one, process 41: sudo -u robot scanhub doctor";
        let unknown = "runs one in an unknown domain, process 42: sudo -u robot scanhub list --domains";
        says(&hubs(&foreign), State::Ok, &["no other hub", command, unknown]);
        let two = MachineState { other_hubs: vec![("/tmp/scanhub-7/scanhub".into(), 9)], ..facts() };
        says(&hubs(&two), State::Warning, &["/tmp/scanhub-7/scanhub (process 9)", "--domain"]);
    }

    #[test]
    fn counts_descriptors_in_subscribers() {
        says(&descriptors(&facts()), State::Ok, &["4096", "990 subscribers"]);
        says(&descriptors(&MachineState { descriptors: None, ..facts() }), State::Ok, &["no limit"]);
        says(
            &descriptors(&MachineState { descriptors: Some(152), ..facts() }),
            State::Warning,
            &["4 subscribers"],
        );
        says(
            &descriptors(&MachineState { descriptors: Some(131), ..facts() }),
            State::Failed,
            &["needs 136"],
        );
    }

    #[test]
    fn compares_file_size_with_longest_segment() {
        says(&file_size(&facts()), State::Ok, &["no limit"]);
        let of = |limit| file_size(&MachineState { file_size: Some(limit), ..facts() });
        says(&of(1 << 30), State::Ok, &["1048576 kB at most"]);
        says(&of(100 << 10), State::Failed, &["100 kB at most", "ulimit -f unlimited", "LimitFSIZE="]);
    }

    #[test]
    fn checks_interface_of_gateway() {
        let head = "Inter-|   Receive\n face |bytes\n";
        let files = [("sys/class/net/lo/flags", "0x9\n"), ("proc/net/dev", &format!("{head}    lo: 1 2\n"))];
        let temp = TempRoot::new(7, &files);
        let of = |name: &str| multicast(&temp.system, Some(name));
        assert_eq!(multicast(&temp.system, None).state, State::Skipped);
        assert_eq!(of("lo").state, State::Ok);
        let missing = of("eth0");
        assert!(missing.state == State::Failed && missing.remedy.contains("there are lo"), "{missing}");
        temp.put("proc/net/dev", &format!("{head}    lo: 1 2\n  eth0: 3 4\n"));
        assert_eq!(of("eth0").state, State::Ok, "its state is unknown");
        for (flags, carrier, state) in [
            ("0x1", "1", State::Failed),
            ("0x1002", "0", State::Warning),
            ("0x1003", "0", State::Warning),
            ("0x1003", "1", State::Ok),
        ] {
            temp.put("sys/class/net/eth0/flags", flags);
            temp.put("sys/class/net/eth0/carrier", carrier);
            assert_eq!(of("eth0").state, state, "{flags} {carrier}");
        }
    }
}
