//! What a hub needs of the machine, whatever its sensors are: shared memory, a domain, descriptors. Each check judges
//! facts that were gathered before, so that every verdict can be tested.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::fs::{Access, access, statvfs};
use rustix::process::{Resource, getrlimit, getuid};
use schema::ipc::Nodes;
use schema::shortage::SHARED_MEMORY;
use schema::{Domain, Failure};

use super::finding::Finding;
use super::segments::abandoned;
use crate::preflight::{needed, needed_descriptors};

/// What is known of the machine and the domain.
#[derive(Clone, Debug)]
pub(crate) struct Facts {
    pub(crate) links: usize,
    /// Size (0 is no limit) and free bytes of shared memory; none: it cannot be looked at.
    pub(crate) memory: Option<(u64, u64)>,
    /// Root path of the domain.
    pub(crate) root: PathBuf,
    /// This user's number.
    pub(crate) user: u32,
    /// The root path, or the nearest directory above that exists.
    pub(crate) place: Place,
    /// The hub's process, if one holds the domain.
    pub(crate) hub: Result<Option<u32>, Failure>,
    pub(crate) nodes: Result<Nodes, Failure>,
    /// Files in shared memory that may be the domain's and that nobody holds, with their bytes.
    pub(crate) segments: Vec<(PathBuf, u64)>,
    /// Hard limit of open descriptors; none: no limit.
    pub(crate) descriptors: Option<u64>,
    /// How many this process has open, as would a hub that was started in its place.
    pub(crate) open: u64,
}

/// A directory.
#[derive(Clone, Debug)]
pub(crate) struct Place {
    pub(crate) path: PathBuf,
    pub(crate) owner: u32,
    /// Permission bits.
    pub(crate) mode: u32,
    pub(crate) writable: bool,
}

impl Facts {
    /// Looks at everything; changes nothing.
    pub(crate) fn gather(domain: &Domain, links: usize) -> Facts {
        let root = domain.root();
        Facts {
            // To list them needs one too.
            open: fs::read_dir("/proc/self/fd").map_or(0, |entries| entries.count() as u64 - 1),
            links,
            memory: statvfs(SHARED_MEMORY)
                .ok()
                .map(|stat| (stat.f_blocks * stat.f_frsize, stat.f_bavail * stat.f_frsize)),
            root: root.to_owned(),
            user: getuid().as_raw(),
            place: Place::nearest(root),
            hub: schema::holder(root),
            nodes: schema::ipc::nodes(domain),
            segments: abandoned(&domain.prefix(), getuid().as_raw()),
            descriptors: getrlimit(Resource::Nofile).maximum,
        }
    }

    fn lives(&self) -> Option<u32> {
        self.hub.as_ref().ok().copied().flatten()
    }
}

impl Place {
    fn nearest(root: &Path) -> Place {
        let found = root.ancestors().find_map(|path| Some((path, path.metadata().ok()?)));
        match found {
            Some((path, metadata)) => Place {
                path: path.to_owned(),
                owner: metadata.uid(),
                mode: metadata.mode() & 0o7777,
                writable: access(path, Access::WRITE_OK | Access::EXEC_OK).is_ok(),
            },
            None => Place { path: root.to_owned(), owner: 0, mode: 0, writable: false },
        }
    }
}

/// Whether shared memory has room for the links.
pub(crate) fn memory(facts: &Facts) -> Finding {
    const NAME: &str = "memory";
    let Some((size, free)) = facts.memory else {
        let remedy = format!("mount a tmpfs there: mount -t tmpfs -o size=64M tmpfs {SHARED_MEMORY}");
        return Finding::failed(NAME, format!("{SHARED_MEMORY} cannot be looked at"), remedy);
    };
    if size == 0 {
        return Finding::ok(NAME, format!("{SHARED_MEMORY} has no limit"));
    }
    let needed = needed(facts.links);
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
        format!("make it larger: mount -o remount,size=64M {SHARED_MEMORY}; of a container by --shm-size=64m")
    };
    Finding::failed(NAME, text, remedy)
}

/// Whether a hub of this user can take its place, or has it.
pub(crate) fn domain(facts: &Facts) -> Finding {
    const NAME: &str = "domain";
    let (root, place, user) = (facts.root.display(), &facts.place, facts.user);
    let at = place.path.display();
    match &facts.hub {
        Err(failure) => return Finding::failed(NAME, failure.message.clone(), failure.hint.clone()),
        Ok(Some(pid)) => return Finding::ok(NAME, format!("{root}: a hub runs, process {pid}")),
        Ok(None) => {}
    }
    if place.path != facts.root {
        return if place.writable {
            Finding::ok(NAME, format!("{root}: not there yet, can be made"))
        } else {
            let text = format!("{root} cannot be made: no right to write in {at}");
            Finding::failed(NAME, text, "name another place with --root")
        };
    }
    if place.owner != user {
        return Finding::failed(
            NAME,
            format!("{at} belongs to user {}, mode {:04o}; this is user {user}", place.owner, place.mode),
            "run as that user, or choose another --root or --domain",
        );
    }
    if place.mode & 0o022 != 0 {
        let text = format!("{at}: others may write there, mode {:04o}", place.mode);
        return Finding::warning(NAME, text, format!("chmod 700 {at}"));
    }
    Finding::ok(NAME, format!("{root}: free, yours, mode {:04o}", place.mode))
}

/// Whether something is left of processes that ended without tidying up.
pub(crate) fn leftovers(facts: &Facts) -> Finding {
    const NAME: &str = "leftovers";
    let nodes = match &facts.nodes {
        Ok(nodes) => nodes,
        Err(failure) => return Finding::failed(NAME, failure.message.clone(), failure.hint.clone()),
    };
    let (files, bytes) = (facts.segments.len(), facts.segments.iter().map(|(_, bytes)| bytes).sum::<u64>());
    let left = format!("{} ({} kB) in {SHARED_MEMORY}", plural(files as u64, "file"), bytes / 1024);
    match (facts.lives(), nodes.dead, nodes.alive) {
        (Some(_), 0, _) => Finding::ok(NAME, "none"),
        (Some(_), dead, _) => {
            Finding::ok(NAME, format!("{} died; the hub is tidying up", plural(dead as u64, "process")))
        }
        (None, 0, 0) if files == 0 => Finding::ok(NAME, "none"),
        (None, 0, alive) if alive > 0 => {
            Finding::ok(NAME, format!("none; {} waiting for a hub", plural(alive as u64, "consumer")))
        }
        (None, 0, _) => {
            let names: Vec<_> = facts.segments.iter().map(|(path, _)| path.display().to_string()).collect();
            Finding::warning(
                NAME,
                format!("no process here holds {left}"),
                format!("unless a container that shares {SHARED_MEMORY} does: rm {}", names.join(" ")),
            )
        }
        (None, dead, _) => Finding::warning(
            NAME,
            format!("{} died without a hub to tidy up; {left}", plural(dead as u64, "process")),
            format!("the next `scanhub run` at {} tidies up at its start", facts.root.display()),
        ),
    }
}

/// Whether the process may open enough.
pub(crate) fn descriptors(facts: &Facts) -> Finding {
    const NAME: &str = "descriptors";
    let Some(limit) = facts.descriptors else { return Finding::ok(NAME, "no limit") };
    let own = facts.open + DESCRIPTORS_AT_START + needed_descriptors(facts.links);
    let remedy =
        "raise the hard limit: ulimit -Hn, LimitNOFILE= of a service, --ulimit nofile= of a container";
    let Some(rest) = limit.checked_sub(own) else {
        let text = format!("{limit} at most, the hub needs {own}");
        return Finding::failed(NAME, text, remedy);
    };
    let consumers = rest / DESCRIPTORS_OF_CONSUMER;
    let text = format!("{limit} at most: enough for about {consumers} consumers of a topic");
    if consumers >= ENOUGH_CONSUMERS { Finding::ok(NAME, text) } else { Finding::warning(NAME, text, remedy) }
}

fn plural(count: u64, what: &str) -> String {
    match (count, what.strip_suffix("ss")) {
        (1, _) => format!("1 {what}"),
        (_, Some(_)) => format!("{count} {what}es"),
        _ => format!("{count} {what}s"),
    }
}

/// What a hub has open when it counts: five for the signals, and its lock.
const DESCRIPTORS_AT_START: u64 = 6;
/// For each consumer of a topic.
const DESCRIPTORS_OF_CONSUMER: u64 = 4;
/// A robot has hardly more.
const ENOUGH_CONSUMERS: u64 = 50;

#[cfg(test)]
mod tests {
    use schema::Kind;

    use super::*;
    use crate::doctor::finding::State;

    fn facts() -> Facts {
        Facts {
            links: 2,
            memory: Some((64 << 20, 60 << 20)),
            root: "/run/user/7/scanhub/scanhub".into(),
            user: 7,
            place: Place { path: "/run/user/7".into(), owner: 7, mode: 0o700, writable: true },
            hub: Ok(None),
            nodes: Ok(Nodes::default()),
            segments: Vec::new(),
            descriptors: Some(4096),
            open: 4,
        }
    }

    fn says(finding: &Finding, state: State, words: &[&str]) {
        assert_eq!(finding.state, state, "{finding}");
        let text = finding.to_string();
        assert!(words.iter().all(|word| text.contains(word)), "{text} lacks one of {words:?}");
        let needs_remedy = matches!(state, State::Warning | State::Failed);
        assert_eq!(finding.remedy.is_empty(), !needs_remedy, "{finding}");
    }

    #[test]
    fn memory_is_judged_by_what_the_links_need() {
        says(&memory(&facts()), State::Ok, &["61440 kB of them free", "2 links"]);
        let full = Facts { memory: Some((64 << 20, 1 << 10)), ..facts() };
        says(&memory(&full), State::Failed, &["1 kB of them free", "free some"]);
        let small = Facts { memory: Some((1 << 20, 1 << 20)), ..facts() };
        says(&memory(&small), State::Failed, &["1024 kB", "remount", "--shm-size"]);
        says(&memory(&Facts { hub: Ok(Some(5)), ..full }), State::Ok, &["the hub has"]);
        says(&memory(&Facts { memory: Some((0, 0)), ..facts() }), State::Ok, &["no limit"]);
        says(&memory(&Facts { memory: None, ..facts() }), State::Failed, &["mount -t tmpfs"]);
    }

    #[test]
    fn a_domain_is_free_held_foreign_or_impossible() {
        let root: PathBuf = facts().root;
        let there = |owner, mode| Facts {
            place: Place { path: root.clone(), owner, mode, writable: true },
            ..facts()
        };
        says(&domain(&facts()), State::Ok, &["not there yet"]);
        says(&domain(&there(7, 0o700)), State::Ok, &["free", "0700"]);
        says(&domain(&there(7, 0o777)), State::Warning, &["0777", "chmod 700"]);
        says(&domain(&there(8, 0o700)), State::Failed, &["user 8", "user 7", "--root"]);
        says(&domain(&Facts { hub: Ok(Some(41)), ..facts() }), State::Ok, &["process 41"]);
        let closed = Place { path: "/run".into(), owner: 0, mode: 0o755, writable: false };
        says(&domain(&Facts { place: closed, ..facts() }), State::Failed, &["/run", "--root"]);
        let denied = Failure::new(Kind::Failed, "not yours", "ask");
        says(&domain(&Facts { hub: Err(denied), ..facts() }), State::Failed, &["not yours", "ask"]);
    }

    #[test]
    fn what_dead_processes_left_is_told_and_waiting_consumers_are_not() {
        says(&leftovers(&facts()), State::Ok, &["none"]);
        let segments = vec![("/dev/shm/sh_a_1".into(), 1024), ("/dev/shm/sh_a_2".into(), 1024)];
        let nodes =
            |alive, dead| Facts { nodes: Ok(Nodes { alive, dead }), segments: segments.clone(), ..facts() };
        says(&leftovers(&nodes(3, 0)), State::Ok, &["3 consumers waiting"]);
        let words = ["1 process died", "2 files (2 kB)", "`scanhub run` at /run/user/7/scanhub/scanhub"];
        says(&leftovers(&nodes(0, 1)), State::Warning, &words);
        assert!(!leftovers(&nodes(0, 1)).remedy.contains("rm "), "its files may be another hub's");
        says(
            &leftovers(&nodes(0, 0)),
            State::Warning,
            &["no process", "2 files", "rm /dev/shm/sh_a_1 /dev/shm/sh_a_2"],
        );
        says(&leftovers(&Facts { hub: Ok(Some(5)), ..nodes(3, 2) }), State::Ok, &["2 processes", "tidying"]);
    }

    #[test]
    fn descriptors_are_counted_in_consumers() {
        says(&descriptors(&facts()), State::Ok, &["4096", "996 consumers"]);
        says(&descriptors(&Facts { descriptors: None, ..facts() }), State::Ok, &["no limit"]);
        says(&descriptors(&Facts { descriptors: Some(128), ..facts() }), State::Warning, &["4 consumers"]);
        says(&descriptors(&Facts { descriptors: Some(107), ..facts() }), State::Failed, &["needs 110"]);
    }
}
