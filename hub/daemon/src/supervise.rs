//! The hub as a process: one per domain, one thread per link, an orderly end. It knows signals, threads and the
//! domain's upkeep; bytes and topics are the links' business.

use std::os::fd::{AsFd, OwnedFd};
use std::sync::atomic::AtomicBool;
use std::sync::mpsc;
use std::thread;

use config::Config;
use lms::{MILLIS, Nanos};
use port::{Port, clock};
use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use schema::ipc::{self, Node};
use schema::{Domain, Failure, HubLock, Kind, StateDirectory, shortage};

use crate::control::Desk;
use crate::link::{LinkThread, Surroundings};
use crate::reload::{Read, Reload};
use crate::replay::{Cast, Player, Recorded, Seat};
use crate::service::{Service, Watchdog};
use crate::signals::{Signals, Wanted};
use crate::topics::Topics;
use crate::{learned, preflight};

/// What is up.
#[derive(Clone, Debug)]
pub struct Ready {
    /// Number of this hub's life, random.
    pub boot: u64,
    /// The sensors' names.
    pub sensors: Vec<String>,
}

/// The links of a hub that plays a recording.
pub(crate) struct Troupe<'a> {
    pub(crate) player: &'a Player,
    /// What each link plays.
    pub(crate) parts: Vec<Recorded>,
    /// Whether the hub stays when everything was played.
    pub(crate) holds: bool,
}

/// The end of a hub that plays a recording.
struct Curtain<'a> {
    player: &'a Player,
    holds: bool,
    falls_at: Option<Nanos>,
}

impl Curtain<'_> {
    /// Whether everything was played, and whoever listens had time to read it; or somebody does not want more.
    fn has_fallen(&mut self, now: Nanos) -> bool {
        self.player.over().hush();
        if self.player.is_ended() {
            return true;
        }
        if !self.holds && self.falls_at.is_none() && self.player.is_over() {
            self.falls_at = Some(now + LINGER);
        }
        self.falls_at.is_some_and(|falls_at| now >= falls_at)
    }
}

/// Runs the hub in `domain` until SIGINT or SIGTERM; `on_ready` is called once, when all topics exist. `read` tells the
/// configuration: at the start, and at each SIGHUP, which changes what can be changed while links stream.
///
/// What `read` fails with at the start, [`Kind::DomainHeld`] if another hub has the domain, [`Kind::Short`] if memory is, the port kinds if a port is there
/// but cannot be used, [`Kind::Failed`] if shared memory refuses.
pub fn run(
    read: &dyn Fn() -> Result<Config, Failure>,
    domain: &Domain,
    on_ready: impl FnOnce(&Ready),
) -> Result<(), Failure> {
    let config = read()?;
    serve(read, config, None, domain, on_ready)
}

/// Runs a hub that begins with `config`; all links of it are of `troupe`, if there is one, with which it ends.
pub(crate) fn serve(
    read: Read<'_>,
    config: Config,
    troupe: Option<Troupe<'_>>,
    domain: &Domain,
    on_ready: impl FnOnce(&Ready),
) -> Result<(), Failure> {
    let service = Service::of_process();
    preflight::raise_descriptor_limit();
    let signals = Signals::of_process()?;
    let _lock = HubLock::acquire(domain.root())?;
    // What is known of sensors is no recording's.
    let state = StateDirectory::of_domain(domain.name()).filter(|_| troupe.is_none());
    preflight::check_descriptors(config.links.len())?;
    preflight::check_memory(config.links.len())?;
    // Ends after the links: it writes what they had learned last.
    let (config, keeper) = learned::begin(config, state.as_ref())?;
    let config = &config;
    let node = ipc::hub_node(domain)?;
    node.try_cleanup_dead_nodes();
    let ready =
        Ready { boot: random(), sensors: config.links.iter().map(|link| link.name.clone()).collect() };
    // By the port, not by the name: a line that somebody keeps cannot be opened by anybody.
    service.assign(|line| {
        let owner = config.links.iter().find(|link| Port::is_at(line, &link.port));
        owner.map(|link| link.name.clone())
    });
    let (mut desk, orders) = Desk::open(&node, config.links.iter().map(|link| link.name.as_str()))?;
    let stop = eventfd(0, EventfdFlags::CLOEXEC).map_err(|error| no_resource("an eventfd", &error))?;
    let (player, parts, holds) = match troupe {
        Some(Troupe { player, parts, holds }) => (Some(player), parts, holds),
        None => (None, Vec::new(), true),
    };
    let mut parts = parts.into_iter();
    let worked: Vec<_> = config.links.iter().map(|_| AtomicBool::new(true)).collect();
    thread::scope(|scope| {
        let (report, reports) = mpsc::channel();
        let mut threads = Vec::new();
        for ((number, link), orders) in config.links.iter().enumerate().zip(orders) {
            let (node, report) = (&node, report.clone());
            let slot = keeper.as_ref().and_then(|keeper| keeper.slot(&link.name));
            let (root, state, worked) = (domain.root(), state.as_ref(), &worked[number]);
            let around = Surroundings { stop: &stop, service: &service, root, slot, state, worked };
            let cast = player
                .zip(parts.next())
                .map(|(player, recorded)| Cast { recorded, seat: Seat { player, number } });
            let body = move || match Topics::new(node, &link.name, number as u8, ready.boot) {
                Ok(topics) => LinkThread::new(link, topics, around, orders)
                    .run(cast, |outcome| drop(report.send(outcome))),
                Err(failure) => drop(report.send(Err(failure))),
            };
            let thread = thread::Builder::new().name(link.name.clone()).spawn_scoped(scope, body);
            match thread {
                Ok(thread) => threads.push(thread),
                Err(error) => {
                    end_links(&stop);
                    return Err(no_resource("a thread", &error));
                }
            }
        }
        drop(report);
        let mut outcome = reports.iter().take(config.links.len()).find(Result::is_err).unwrap_or(Ok(()));
        if outcome.is_ok() {
            outcome = shortage::allocate(domain);
        }
        if outcome.is_ok() {
            on_ready(&ready);
            service.ready(&ready.sensors, None);
            player.iter().for_each(|player| player.begin());
            let is_alive = || threads.iter().all(|thread| !thread.is_finished());
            let watchdog = Watchdog::new(&service, &worked, clock::now());
            let reload = Reload::new(config, read, &service);
            let curtain = player.map(|player| Curtain { player, holds, falls_at: None });
            outcome = keep_up(&node, &signals, reload, &mut desk, watchdog, curtain, is_alive);
        }
        service.stopping();
        end_links(&stop);
        // Joined one by one, a thread that panicked is a failure of this function, not a panic of its own.
        let ended = threads.into_iter().map(|thread| thread.join()).collect::<Result<Vec<()>, _>>();
        outcome.and(ended.map(drop).map_err(|_| broken_thread()))
    })
}

/// Looks after the links, what users ask of them and what dead consumers left, until a signal says to end.
fn keep_up(
    node: &Node,
    signals: &Signals,
    mut reload: Reload<'_>,
    desk: &mut Desk,
    mut watchdog: Option<Watchdog<'_>>,
    mut curtain: Option<Curtain<'_>>,
    is_alive: impl Fn() -> bool,
) -> Result<(), Failure> {
    let mut upkeep_at = clock::now() + UPKEEP;
    loop {
        let ([end, hangup], [requests, outcomes]) = (signals.descriptors(), desk.descriptors());
        // Nobody rings where nothing is played.
        let over = curtain.as_ref().map_or(end, |curtain| curtain.player.over().as_fd());
        let mut fds =
            [end, hangup, requests, outcomes, over].map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN));
        let until = curtain.as_ref().and_then(|curtain| curtain.falls_at);
        let look = until.map_or(LOOK, |until| clock::span(clock::now(), until));
        // A signal ends the wait, and is there to be taken.
        let _ = poll(&mut fds, Some(&look));
        match signals.take() {
            Some(Wanted::End) => return Ok(()),
            Some(Wanted::Reload) => reload.reload(desk),
            None => {}
        }
        // Without a wake-up too: what is behind a request that could not be received has been announced already.
        desk.serve();
        if !is_alive() {
            return Err(broken_thread());
        }
        let now = clock::now();
        if curtain.as_mut().is_some_and(|curtain| curtain.has_fallen(now)) {
            return Ok(());
        }
        watchdog.iter_mut().for_each(|watchdog| watchdog.look(now));
        if now >= upkeep_at {
            node.try_cleanup_dead_nodes();
            upkeep_at = now + UPKEEP;
        }
    }
}

fn end_links(stop: &OwnedFd) {
    // An eventfd that nobody reads takes one write for sure.
    let _ = rustix::io::write(stop, &1u64.to_ne_bytes());
}

fn broken_thread() -> Failure {
    Failure::new(
        Kind::Failed,
        "a link's thread ended",
        "this is a bug: please report it with the lines above",
    )
}

fn random() -> u64 {
    use std::hash::{BuildHasher, RandomState};
    RandomState::new().hash_one(std::process::id())
}

/// `what` is not available now.
pub(crate) fn no_resource(what: &str, error: &dyn std::fmt::Display) -> Failure {
    Failure::new(Kind::Short, format!("cannot get {what}: {error}"), "try again later")
}

/// A hub that plays a recording stays for so long after its end.
const LINGER: Nanos = 1_000 * MILLIS;
/// Between two looks whether the links are alive.
const LOOK: Timespec = Timespec { tv_sec: 1, tv_nsec: 0 };
/// Between two looks at what dead processes left: each reads the directory of all nodes, and nobody waits for it.
const UPKEEP: Nanos = 5_000 * MILLIS;
