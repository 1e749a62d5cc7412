//! Detection of a hub or listener in a domain: at which of the domain's locations it runs, and which sensors and topics
//! exist there. Each location has locks that show this.

use std::path::Path;
use std::time::{Duration, Instant};

use scanhub_schema::{Failure, Kind};
use scanhub_shm::{Domain, Environment, RunningHub, hub_pid, publisher_pid};

use crate::error::{Error, ErrorKind};
use crate::silence::Silence;

/// Interval of the queries of the locks.
const LOCK_POLL_INTERVAL: Duration = Duration::from_millis(100);

/// Maximum number of hubs of other users or domains that a message names.
const MAX_HUBS: usize = 3;

/// Remedy for a user who needs the data of another user's hub.
const SHARING_REMEDY: &str = "to have its data under this user: docs/sharing.md";

/// Interval of the queries of the locks while the hub rings doorbells, which also shows that it runs.
const ACTIVE_POLL_INTERVAL: Duration = Duration::from_secs(1);

/// Finder of the hub or listener of a domain, by its lock.
pub(crate) struct HubFinder {
    locations: Vec<Domain>,
    hub: Option<HolderProcess>,
    checked_at: Option<Instant>,
    /// Time of the last query of the locks.
    queried_at: Option<Instant>,
    rang_at: Option<Instant>,
    denied: Option<Failure>,
}

/// Kind of the publisher in a domain. If a hub and a listener run, the kind is [`DomainHolder::Hub`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DomainHolder {
    /// A hub.
    Hub,
    /// A listener that publishes the sensors of other machines.
    Listener,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct HolderProcess {
    domain: Domain,
    pid: u32,
    kind: DomainHolder,
}

/// Change since the last check. If both are set, one publisher has replaced another one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Change {
    /// The publisher that has ended.
    pub ended: Option<DomainHolder>,
    /// The publisher that has started.
    pub started: Option<DomainHolder>,
}

impl Change {
    /// Compares the results of two checks. A listener that runs together with a hub does not count as started when the
    /// hub ends, or as ended when a hub starts.
    fn between(before: Option<&HolderProcess>, now: Option<&HolderProcess>) -> Change {
        let kind = |holder: Option<&HolderProcess>| holder.map(|holder| holder.kind);
        let is_same_domain = before.zip(now).is_some_and(|(a, b)| a.domain == b.domain && a.kind != b.kind);
        let counts = |kind: &DomainHolder| !is_same_domain || *kind == DomainHolder::Hub;
        match before == now {
            true => Change::default(),
            false => Change { ended: kind(before).filter(counts), started: kind(now).filter(counts) },
        }
    }
}

impl HubFinder {
    /// Creates a finder for `locations`. It uses the first location at which a hub or listener runs.
    pub(crate) fn new(locations: Vec<Domain>) -> HubFinder {
        HubFinder { locations, hub: None, checked_at: None, queried_at: None, rang_at: None, denied: None }
    }

    /// Notes that the hub has just rung a doorbell.
    pub(crate) fn note_ring(&mut self) {
        self.rang_at = Some(Instant::now());
    }

    /// Checks for a hub or listener, unless the last check was less than 100 ms ago. Returns what has changed since the
    /// last check. While the hub rings doorbells, the locks are queried less often.
    pub(crate) fn check(&mut self) -> Change {
        let now = Instant::now();
        let is_within = |at: Option<Instant>, limit| at.is_some_and(|at| now - at < limit);
        if is_within(self.checked_at, LOCK_POLL_INTERVAL) {
            return Change::default();
        }
        self.checked_at = Some(now);
        let is_ringing =
            is_within(self.rang_at, LOCK_POLL_INTERVAL) && is_within(self.queried_at, ACTIVE_POLL_INTERVAL);
        // If an unknown hub rings a doorbell, it has just started, so query the locks.
        if is_ringing && self.hub.is_some() {
            return Change::default();
        }
        self.queried_at = Some(now);
        self.denied = None;
        let found = self.find_live();
        if found.is_none() && self.shortage().is_some() {
            // The check failed for lack of a descriptor, so the hub may still run.
            return Change::default();
        }
        let change = Change::between(self.hub.as_ref(), found.as_ref());
        self.hub = found;
        change
    }

    /// Makes the next call of [`check`](Self::check) query the locks, because something has changed.
    pub(crate) fn expire(&mut self) {
        (self.checked_at, self.queried_at) = (None, None);
    }

    /// Returns the locations where a hub may run.
    pub(crate) fn locations(&self) -> &[Domain] {
        &self.locations
    }

    /// Returns the process ID of the hub or listener, if one runs.
    pub(crate) fn pid(&self) -> Option<u32> {
        self.hub.as_ref().map(|holder| holder.pid)
    }

    /// Returns the time of the last check.
    pub(crate) fn checked_at(&self) -> Option<Instant> {
        self.checked_at
    }

    /// Returns the domain of the hub or listener, if one runs.
    pub(crate) fn domain(&self) -> Option<&Domain> {
        self.hub.as_ref().map(|holder| &holder.domain)
    }

    /// Returns the kind of the publisher, if one runs.
    pub(crate) fn holder(&self) -> Option<DomainHolder> {
        self.hub.as_ref().map(|holder| holder.kind)
    }

    /// Returns the error that no hub runs, for callers that cannot wait for a hub.
    pub(crate) fn no_hub(&self) -> Error {
        self.with_access_class(self.no_hub_failure(|| RunningHub::all(Path::new("/"))))
    }

    /// Returns the same error as [`HubFinder::no_hub`], but without the hubs of other users and domains, because the
    /// error is shown on other machines. If a directory cannot be opened, the error names it and its owner. This
    /// function does not read /proc, so it can be called often.
    pub(crate) fn no_hub_here(&self) -> Error {
        self.with_access_class(self.no_hub_failure(Vec::new))
    }

    /// Returns the error for `failure`. If a directory of another user was found, the class is
    /// [`ErrorKind::OtherUser`].
    fn with_access_class(&self, failure: Failure) -> Error {
        let is_of_other = self.denied.as_ref().is_some_and(|denied| denied.kind == Kind::OtherUser);
        let error = Error::from(failure);
        if is_of_other { error.with_kind(ErrorKind::OtherUser) } else { error }
    }

    /// Returns why there is no hub, for a subscriber that waits for one. Reads /proc, which takes a few milliseconds.
    pub(crate) fn silence_reason(&self) -> Silence {
        let hubs = RunningHub::all(Path::new("/"));
        let (uid, name) = (Environment::of_process().uid, self.locations.first().map(Domain::name));
        // The domain of another user's hub may be unknown.
        let may_be_ours = |hub: &RunningHub| hub.domain.is_none() || hub.domain.as_deref() == name;
        let is_of_other = self.denied.is_some() || hubs.iter().any(|hub| hub.uid != uid && may_be_ours(hub));
        let Failure { kind, message, hint: remedy } = self.no_hub_failure(|| hubs);
        match kind {
            Kind::ResourceExhausted => Silence::Full { message, remedy },
            _ if is_of_other => Silence::OtherUser { message, remedy },
            _ => Silence::NoHub { message, remedy },
        }
    }

    fn no_hub_failure(&self, hubs: impl FnOnce() -> Vec<RunningHub>) -> Failure {
        let of_process = Environment::of_process();
        self.shortage().unwrap_or_else(|| no_hub(&self.locations, self.denied.as_ref(), &hubs(), &of_process))
    }

    /// Returns the failure if a shortage of descriptors prevents the check for a hub.
    pub(crate) fn shortage(&self) -> Option<Failure> {
        self.denied.clone().filter(|denied| denied.kind == Kind::ResourceExhausted)
    }

    fn find_live(&mut self) -> Option<HolderProcess> {
        for location in &self.locations {
            let found = hub_pid(location.root()).and_then(|hub| match hub {
                None => Ok((publisher_pid(location.root())?, DomainHolder::Listener)),
                hub => Ok((hub, DomainHolder::Hub)),
            });
            match found {
                // 0: the process holds the lock, but has not written its ID yet.
                Ok((None | Some(0), _)) => {}
                Ok((Some(pid), who)) => {
                    return Some(HolderProcess { domain: location.clone(), pid, kind: who });
                }
                // Do not replace a shortage by a later failure, because the other locations fail for the same reason.
                Err(failure) if self.shortage().is_none() => self.denied = Some(failure),
                Err(_) => {}
            }
        }
        None
    }
}

/// Returns the failure for a domain without a hub at `locations`. `denied` is the failure to open one of these
/// locations, `hubs` are the hubs of this machine, and `caller` is the environment of this process.
fn no_hub(
    locations: &[Domain],
    denied: Option<&Failure>,
    hubs: &[RunningHub],
    caller: &Environment,
) -> Failure {
    let name = locations.first().map(Domain::name).unwrap_or_default();
    let is_named = |hub: &RunningHub| hub.uid != caller.uid && hub.domain.as_deref() == Some(name);
    let is_elsewhere = hubs.iter().any(is_named);
    // If another user runs a hub whose domain is unknown, that hub may be in this domain.
    let may_be_elsewhere =
        is_elsewhere || hubs.iter().any(|hub| hub.uid != caller.uid && hub.domain.is_none());
    // Hubs of other domains are named only if no other user has a hub in this domain. Hubs of this user are named
    // first.
    let mut hubs: Vec<&RunningHub> = hubs.iter().filter(|hub| !is_elsewhere || is_named(hub)).collect();
    hubs.sort_by_key(|hub| (hub.uid != caller.uid, hub.domain.is_some()));
    let mut hints: Vec<String> =
        hubs.iter().take(MAX_HUBS).map(|hub| hub.describe("list", name, caller)).collect();
    if hubs.len() > MAX_HUBS {
        hints.push(format!("and {} more", hubs.len() - MAX_HUBS));
    }
    let message = match denied {
        Some(denied) => format!("no hub of this user in domain {name}: {}", denied.message),
        None if may_be_elsewhere => format!("no hub of this user in domain {name}"),
        None => format!("no hub in domain {name}"),
    };
    match denied {
        Some(denied) => hints.push(denied.hint.clone()),
        None if is_elsewhere => hints.push(SHARING_REMEDY.to_owned()),
        None => {
            let roots: Vec<_> =
                locations.iter().map(|location| location.root().display().to_string()).collect();
            hints.push(format!("start one with `scanhub run`; searched {}", roots.join(", ")));
        }
    }
    Failure::new(Kind::NoHub, message, hints.join("; "))
}

/// Returns the first one of `locations` at which a hub or listener runs. Waits for up to half a second for one that is
/// just starting.
///
/// # Errors
///
/// [`ErrorKind::NoHub`](crate::ErrorKind) if none runs after half a second; [`ErrorKind::OtherUser`](crate::ErrorKind)
/// if the domain belongs to another user.
pub fn find(locations: &[Domain]) -> Result<Domain, Error> {
    let deadline = Instant::now() + STARTUP_GRACE;
    let mut finder = HubFinder::new(locations.to_vec());
    loop {
        finder.check();
        if let Some(domain) = finder.domain() {
            return Ok(domain.clone());
        }
        if Instant::now() >= deadline {
            return Err(finder.no_hub());
        }
        std::thread::sleep(LOCK_POLL_INTERVAL);
    }
}

/// Time within which a hub that is starting becomes visible. It is short enough that a verb ends within a second if no
/// hub runs.
pub const STARTUP_GRACE: Duration = Duration::from_millis(500);

/// Returns the names of all sensors at the first one of `locations` at which a hub or listener runs. If that fails,
/// returns no names. Never waits.
///
/// # Examples
///
/// ```
/// use scanhub_client::{domain_candidates, live_sensors};
///
/// let places = domain_candidates(Some("no-hub-is-here"), None)?;
/// assert!(live_sensors(&places).is_empty());
/// # Ok::<(), scanhub_client::Error>(())
/// ```
pub fn live_sensors(locations: &[Domain]) -> Vec<String> {
    query_live(locations, scanhub_shm::sensors)
}

/// Returns the topics of each of [`live_sensors`] as `SENSOR/TOPIC`.
pub fn live_topics(locations: &[Domain]) -> Vec<String> {
    let mut topics = query_live(locations, scanhub_shm::published_topics);
    topics.sort();
    topics.into_iter().map(|(sensor, topic)| format!("{sensor}/{}", topic.name())).collect()
}

fn query_live<T>(locations: &[Domain], query: impl Fn(&Domain) -> Result<Vec<T>, Failure>) -> Vec<T> {
    let is_live = |domain: &&Domain| matches!(publisher_pid(domain.root()), Ok(Some(_)));
    locations.iter().find(is_live).and_then(|domain| query(domain).ok()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hub_is_checked_only_while_it_is_silent() {
        let domain = Domain::at("presence", std::path::Path::new("/tmp/presence")).unwrap();
        let mut finder = HubFinder::new(vec![domain.clone()]);
        finder.hub = Some(HolderProcess { domain, pid: 1, kind: DomainHolder::Hub });
        let expired_at = Instant::now().checked_sub(2 * LOCK_POLL_INTERVAL);
        (finder.checked_at, finder.queried_at) = (expired_at, expired_at);
        finder.note_ring();
        assert_eq!(finder.check(), Change::default(), "no process holds that location");
        assert!(finder.checked_at() > expired_at && finder.queried_at == expired_at);
        (finder.checked_at, finder.rang_at) = (expired_at, expired_at);
        assert_eq!(finder.check(), Change { ended: Some(DomainHolder::Hub), started: None });
    }

    #[test]
    fn missing_hub_error_lists_hubs_of_other_users() {
        let hubs = |processes: &[(u32, u32, &str)]| {
            let root = tempfile::tempdir().unwrap();
            let put = |path: &str, text: &str| {
                let path = root.path().join(path);
                std::fs::create_dir_all(path.parent().unwrap()).unwrap();
                std::fs::write(path, text).unwrap();
            };
            put("etc/passwd", "root:x:0:0::/root:/bin/sh\nscanhub:x:998:998::/:/bin/false\n");
            for (pid, uid, words) in processes {
                put(&format!("proc/{pid}/comm"), "scanhub\n");
                put(&format!("proc/{pid}/status"), &format!("Uid:\t{uid}\t{uid}\t{uid}\t{uid}\n"));
                put(&format!("proc/{pid}/cmdline"), &format!("scanhub\0{}\0", words.replace(' ', "\0")));
            }
            let hubs = RunningHub::all(root.path());
            assert_eq!(hubs.len(), processes.len());
            hubs
        };
        let caller = Environment { uid: 1000, ..Environment::default() };
        let locations = Domain::candidates("scanhub", None, &caller).unwrap();
        let failure_text = |hubs: &[RunningHub], denied| {
            let failure = no_hub(&locations, denied, hubs, &caller);
            assert_eq!(failure.kind, Kind::NoHub);
            (failure.message, failure.hint)
        };
        let (message, hint) = failure_text(&hubs(&[]), None);
        assert_eq!(message, "no hub in domain scanhub");
        assert!(hint.starts_with("start one with `scanhub run`; searched /run/scanhub/scanhub, "), "{hint}");

        let (message, hint) = failure_text(&hubs(&[(7, 0, "run")]), None);
        assert_eq!(message, "no hub of this user in domain scanhub");
        let unknown = "user root runs one in an unknown domain, process 7: sudo scanhub list --domains; ";
        assert!(hint.starts_with(unknown) && hint.contains("start one"), "{hint}");
        let own = [(6, 1000, "run --domain lab"), (7, 0, "run")];
        let (_, hint) = failure_text(&hubs(&own), None);
        assert!(hint.starts_with("this user runs one in domain lab, process 6: scanhub list"), "{hint}");
        assert!(hint.contains(unknown), "{hint}");

        let named = (7, 0, "run --domain scanhub");
        let (message, hint) = failure_text(&hubs(&[named]), None);
        assert_eq!(message, "no hub of this user in domain scanhub");
        assert!(hint.starts_with("user root runs one, process 7: sudo scanhub list; "), "{hint}");
        assert!(hint.contains("docs/sharing.md") && !hint.contains("start one"), "{hint}");

        let others = [(6, 1000, "run --domain lab"), named, (8, 0, "run --domain x"), (9, 0, "run")];
        assert_eq!(failure_text(&hubs(&others), None).1, hint, "hubs of other domains are not meant");

        // The service's directory cannot be opened.
        let denied = Failure::new(Kind::Failed, "/run/scanhub belongs to user 998", "choose another --root");
        let (message, hint) = failure_text(&hubs(&[(7, 998, "run --domain scanhub")]), Some(&denied));
        assert!(message.ends_with("in domain scanhub: /run/scanhub belongs to user 998"), "{message}");
        assert!(
            hint.starts_with("user scanhub runs one, process 7: sudo -u scanhub scanhub list; "),
            "{hint}"
        );
        assert_eq!(failure_text(&hubs(&[]), Some(&denied)).1, denied.hint);

        let (message, hint) =
            failure_text(&hubs(&[(7, 1000, "run --domain lab"), (8, 0, "replay --domain x a")]), None);
        assert_eq!(message, "no hub in domain scanhub");
        let own = "this user runs one in domain lab, process 7: scanhub list --domain lab; ";
        let root_s =
            "user root runs one in domain x, process 8: sudo scanhub list --domain x; start one with ";
        assert!(hint.starts_with(&[own, root_s].concat()), "{hint}");

        let many: Vec<_> = (1..6).map(|pid| (pid, 1000, "run --domain lab")).collect();
        assert!(failure_text(&hubs(&many), None).1.contains("; and 2 more; start one"));
    }

    #[test]
    fn exit_of_a_hub_does_not_count_as_listener_start() {
        let domain = Domain::at("presence", std::path::Path::new("/tmp/presence")).unwrap();
        let holder = |pid, who| Some(HolderProcess { domain: domain.clone(), pid, kind: who });
        let (hub, other, listener) =
            (holder(1, DomainHolder::Hub), holder(2, DomainHolder::Hub), holder(3, DomainHolder::Listener));
        let change = |before: &Option<HolderProcess>, now: &Option<HolderProcess>| {
            let Change { ended: gone, started: back } = Change::between(before.as_ref(), now.as_ref());
            (gone, back)
        };
        assert_eq!(change(&None, &hub), (None, Some(DomainHolder::Hub)));
        assert_eq!(change(&hub, &hub), (None, None));
        assert_eq!(change(&hub, &other), (Some(DomainHolder::Hub), Some(DomainHolder::Hub)));
        assert_eq!(change(&hub, &listener), (Some(DomainHolder::Hub), None));
        assert_eq!(change(&listener, &hub), (None, Some(DomainHolder::Hub)));
        assert_eq!(change(&listener, &None), (Some(DomainHolder::Listener), None));
    }
}
