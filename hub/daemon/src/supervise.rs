//! The hub as a process: it takes the domain, starts a thread for each link, and then serves signals and requests
//! until it ends all threads in order.

use std::collections::BTreeMap;
use std::os::fd::AsFd;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread::{self, Scope, ScopedJoinHandle};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use scanhub_config::{Config, Link};
use scanhub_port::{Port, PortSpec, clock};
use scanhub_schema::{Failure, Kind, MILLIS, Nanos};
use scanhub_shm::Node;
use scanhub_shm::{Domain, HubLock, StateDirectory};

use crate::control::{ControlQueue, ControlServer};
use crate::link::LinkState;
use crate::platform::Platform as _;
use crate::player::{Player, PlayerHandle};
use crate::process::{
    EventFd, SignalAction, Signals, check_descriptors, check_memory, no_resource, raise_descriptor_limit,
};
use crate::reconnect::LiveLink;
use crate::reload::{ConfigLoader, Reload};
use crate::replay;
use crate::replay::{RecordedSensor, ReplayPart};
use crate::saved_state::{StateSaver, StateWriter};
use crate::service::{Service, Watchdog};
use crate::system::{LinkResources, System};

/// Report that the hub is ready.
#[derive(Clone, Debug)]
pub struct StartReport {
    /// Random ID of this run of the hub.
    pub boot: u64,
    /// Names of the sensors.
    pub sensors: Vec<String>,
    /// Names of the sensors that do not stream yet: their port cannot be opened, or another process publishes under
    /// their name.
    pub waiting: Vec<String>,
    /// The sensors in `waiting` whose name another process has.
    pub taken: Vec<String>,
}

/// The links of a hub that plays a recording.
pub(crate) struct ReplaySet<'a> {
    pub(crate) player: &'a Player,
    /// Recording of each link.
    pub(crate) parts: Vec<RecordedSensor>,
    /// Whether the hub continues after everything was played.
    pub(crate) holds: bool,
}

/// Outcome of the start of a link.
#[derive(PartialEq)]
enum LinkStart {
    /// The link has started with an open port, or with a recording.
    Open,
    /// The link has started without its port, which cannot be opened yet, or to which no connection is made yet.
    Waiting,
    /// The link has started without its port, because another process publishes under the sensor's name.
    Taken,
}

/// The end of a hub that plays a recording.
struct EndOfPlayback<'a> {
    player: &'a Player,
    holds: bool,
    ends_at: Option<Nanos>,
}

impl EndOfPlayback<'_> {
    /// Returns whether the hub ends at `now`: everything was played, and the subscribers had time to read it, or a
    /// user has ended the player.
    fn has_ended(&mut self, now: Nanos) -> bool {
        self.player.over().clear();
        if self.player.is_ended() {
            return true;
        }
        if !self.holds && self.ends_at.is_none() && self.player.is_over() {
            self.ends_at = Some(now + LINGER_TIME);
        }
        self.ends_at.is_some_and(|ends_at| now >= ends_at)
    }
}

/// Runs the hub in `domain` until SIGINT or SIGTERM. `on_ready` is called once, when all topics exist. `load_config`
/// returns the configuration. It is called at the start, and at each SIGHUP to apply the changes that are possible
/// while links stream.
///
/// # Errors
///
/// Returns the error of `load_config` at the start. Returns [`Kind::DomainHeld`] if another hub has the domain, and
/// [`Kind::NameHeld`] if another process publishes under the name of a link that plays a recording. Returns
/// [`Kind::ResourceExhausted`] if memory or descriptors are short, [`Kind::PortNotTty`] if a port is not a serial line,
/// and [`Kind::Failed`] if shared memory cannot be used. The hub waits for a port that cannot be opened for another
/// reason, and for a name that another process has.
pub fn run(
    load_config: &dyn Fn() -> Result<Config, Failure>,
    domain: &Domain,
    on_ready: impl FnOnce(&StartReport),
) -> Result<(), Failure> {
    let config = load_config()?;
    serve(load_config, config, None, domain, on_ready)
}

/// Runs a hub that starts with `config`. If there is a `set`, all links play its recordings, and the hub ends after
/// them.
pub(crate) fn serve(
    load_config: ConfigLoader<'_>,
    config: Config,
    set: Option<ReplaySet<'_>>,
    domain: &Domain,
    on_ready: impl FnOnce(&StartReport),
) -> Result<(), Failure> {
    let service = Service::of_process();
    raise_descriptor_limit();
    let signals = Signals::register()?;
    let lock = HubLock::acquire(domain.root())?;
    // A replay does not use the saved state of sensors.
    let state = if set.is_none() { state_directory(domain) } else { None };
    check_descriptors(config.links.len())?;
    check_memory(&config.topic_limits()).map_err(|failure| config.with_remedy(failure))?;
    let (config, saver) = match state {
        Some(state) => StateSaver::load(config, state, clock::wall_ns())?,
        None => (config, None),
    };
    let writer = saver.map(StateWriter::start).transpose()?;
    let node = scanhub_shm::hub_node(domain)?;
    node.try_cleanup_dead_nodes();
    // Assign each kept line to the link that has its port now, whatever the name of the link was. While the service
    // manager keeps the line, no link can open its port again.
    service.assign(|line| {
        let owner = config.links.iter().find(|link| Port::is_at(line, &link.port));
        owner.map(|link| link.name.clone())
    });
    let (mut control, queues) =
        ControlServer::open(&node, config.links.iter().map(|link| link.name.as_str()))?;
    let (parts, end_of_playback) = match set {
        Some(ReplaySet { player, parts, holds }) => {
            (parts, Some(EndOfPlayback { player, holds, ends_at: None }))
        }
        None => (Vec::new(), None),
    };
    let player = end_of_playback.as_ref().map(|end_of_playback| end_of_playback.player);
    let hub = Hub {
        boot: random_id(),
        root: domain.root(),
        node: &node,
        service: &service,
        player,
        stop: EventFd::new()?,
        activity: config.links.iter().map(|_| AtomicBool::new(true)).collect(),
        config,
        writer,
    };
    thread::scope(|scope| {
        let (report, reports) = mpsc::channel();
        let mut threads = Vec::new();
        let started = hub.start_links(scope, queues, parts, &report, &mut threads);
        drop(report);
        let outcome = started.and_then(|()| hub.await_starts(&reports)).and_then(|ready| {
            scanhub_shm::allocate(domain)?;
            lock.report_ready()?;
            on_ready(&ready);
            service.notify_ready(&ready.sensors, None);
            player.iter().for_each(|player| player.begin());
            let is_alive = || threads.iter().all(|thread| !thread.is_finished());
            let watchdog = Watchdog::new(&service, &hub.activity, clock::now());
            let reload = Reload::new(&hub.config, load_config, &service);
            run_supervisor(&node, &signals, reload, &mut control, watchdog, end_of_playback, is_alive)
        });
        service.notify_stopping();
        hub.stop.signal();
        // Join the threads one by one, so that a panic in a thread becomes a failure of this function and not another
        // panic.
        let ended = threads.into_iter().map(|thread| thread.join()).collect::<Result<Vec<()>, _>>();
        outcome.and(ended.map(drop).map_err(|_| thread_failure()))
    })
}

/// Parts of a hub that the threads of its links use.
struct Hub<'a> {
    config: Config,
    /// Random ID of this run.
    boot: u64,
    /// Directory of the domain.
    root: &'a Path,
    node: &'a Node,
    service: &'a Service,
    /// Player of the recording that the links play.
    player: Option<&'a Player>,
    /// Event that ends the threads of the links.
    stop: EventFd,
    /// Flags of the links. Each link sets its flag when it has finished something.
    activity: Vec<AtomicBool>,
    /// Thread that saves the state of the links. It ends after the links, because it also writes their last state.
    writer: Option<StateWriter>,
}

impl Hub<'_> {
    /// Starts a thread for each link, and adds it to `threads`. Each thread sends the number of its link and the
    /// outcome of the start to `report`.
    fn start_links<'s>(
        &'s self,
        scope: &'s Scope<'s, '_>,
        queues: Vec<ControlQueue>,
        parts: Vec<RecordedSensor>,
        report: &Sender<(usize, Result<LinkStart, Failure>)>,
        threads: &mut Vec<ScopedJoinHandle<'s, ()>>,
    ) -> Result<(), Failure> {
        let mut parts = parts.into_iter();
        for ((number, link), queue) in self.config.links.iter().enumerate().zip(queues) {
            let resources = LinkResources {
                node: self.node,
                limits: link.limits(&self.config.limits),
                stop: &self.stop,
                service: self.service,
                root: self.root,
            };
            let save_slot = self.writer.as_ref().and_then(|writer| writer.queue().slot(&link.name));
            let part = self
                .player
                .zip(parts.next())
                .map(|(player, recorded)| ReplayPart { recorded, handle: PlayerHandle { player, number } });
            let report = report.clone();
            let body = move || {
                let report = |outcome| drop(report.send((number, outcome)));
                let system = System::new(resources, &link.name, &self.activity[number], save_slot);
                run_link(link, number as u8, self.boot, &system, queue, part, report);
            };
            let thread = thread::Builder::new().name(link.name.clone()).spawn_scoped(scope, body);
            threads.push(thread.map_err(|error| no_resource("a thread", &error))?);
        }
        Ok(())
    }

    /// Waits until all links have started.
    fn await_starts(
        &self,
        reports: &Receiver<(usize, Result<LinkStart, Failure>)>,
    ) -> Result<StartReport, Failure> {
        let links = &self.config.links;
        // Sort the reports by the order of the links, because the links report in any order.
        let reports = reports.iter().take(links.len());
        let starts: BTreeMap<_, _> =
            reports.map(|(number, start)| Ok((number, start?))).collect::<Result<_, Failure>>()?;
        let names = |is_counted: fn(&LinkStart) -> bool| {
            let counted = starts.iter().filter(|(_, start)| is_counted(start));
            counted.map(|(&number, _)| links[number].name.clone()).collect()
        };
        Ok(StartReport {
            boot: self.boot,
            sensors: links.iter().map(|link| link.name.clone()).collect(),
            waiting: names(|start| *start != LinkStart::Open),
            taken: names(|start| *start == LinkStart::Taken),
        })
    }
}

/// Returns the directory for state that outlives a hub in `domain`, if it can be used.
fn state_directory(domain: &Domain) -> Option<StateDirectory> {
    let state = StateDirectory::of_domain(domain.name())?;
    if let Err(Failure { message, hint, .. }) = state.check() {
        tracing::warn!("nothing is kept across restarts: {message}; {hint}");
        return None;
    }
    Some(state)
}

/// Runs `link`, number `number` in the run `boot` of the hub, until the hub ends. A recording is played as `part` of a
/// replay of several sensors, or alone. `report` is called once, with the outcome of the start.
fn run_link(
    link: &Link,
    number: u8,
    boot: u64,
    system: &System<'_>,
    queue: ControlQueue,
    part: Option<ReplayPart<'_>>,
    report: impl FnOnce(Result<LinkStart, Failure>),
) {
    match &link.port {
        // A link that plays a recording does not wait for its name, because the other links of the hub may play
        // together with it.
        PortSpec::File { path, paced } => {
            match system.take_name().and_then(|()| LinkState::new(link, number, boot, system, queue)) {
                Ok(core) => {
                    replay::run(core, part, path, *paced, |outcome| {
                        report(outcome.map(|()| LinkStart::Open))
                    });
                }
                Err(failure) => report(Err(failure)),
            }
        }
        PortSpec::Tty(_) | PortSpec::Tcp { .. } => match LiveLink::new(link, number, boot, system, queue) {
            Ok(live) => {
                system.run_link(live, |live| {
                    report(Ok(if live.lacks_name() {
                        LinkStart::Taken
                    } else if live.is_waiting() {
                        LinkStart::Waiting
                    } else {
                        LinkStart::Open
                    }));
                });
            }
            Err(failure) => report(Err(failure)),
        },
    }
}

/// Serves signals and requests, checks the links, and cleans up after dead processes, until the hub ends.
fn run_supervisor(
    node: &Node,
    signals: &Signals,
    mut reload: Reload<'_>,
    control: &mut ControlServer,
    mut watchdog: Option<Watchdog<'_>>,
    mut end_of_playback: Option<EndOfPlayback<'_>>,
    is_alive: impl Fn() -> bool,
) -> Result<(), Failure> {
    let mut cleanup_at = clock::now() + CLEANUP_INTERVAL;
    loop {
        let ([end, hangup], [requests, outcomes]) = (signals.descriptors(), control.descriptors());
        // Without a player, the descriptor `end` fills the place of the player's descriptor.
        let over =
            end_of_playback.as_ref().map_or(end, |end_of_playback| end_of_playback.player.over().as_fd());
        let mut fds =
            [end, hangup, requests, outcomes, over].map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN));
        let until = end_of_playback.as_ref().and_then(|end_of_playback| end_of_playback.ends_at);
        let span = until.map_or(CHECK_INTERVAL, |until| clock::poll_timeout(clock::now(), until));
        // A signal ends the wait with an error, and is taken below.
        let _ = poll(&mut fds, Some(&span));
        match signals.take() {
            Some(SignalAction::End) => return Ok(()),
            Some(SignalAction::Reload) => reload.reload(&control.commands, clock::now()),
            None => {}
        }
        // Serve requests even without a wake-up. If one request could not be received, the later ones were announced
        // together with it and cause no further wake-up.
        control.serve();
        if !is_alive() {
            return Err(thread_failure());
        }
        let now = clock::now();
        if end_of_playback.as_mut().is_some_and(|end_of_playback| end_of_playback.has_ended(now)) {
            return Ok(());
        }
        watchdog.iter_mut().for_each(|watchdog| watchdog.notify_due(now));
        if now >= cleanup_at {
            node.try_cleanup_dead_nodes();
            cleanup_at = now + CLEANUP_INTERVAL;
        }
    }
}

fn thread_failure() -> Failure {
    Failure::new(
        Kind::Failed,
        "a link's thread ended",
        "this is a bug: please report it with the lines above",
    )
}

fn random_id() -> u64 {
    use std::hash::{BuildHasher, RandomState};
    RandomState::new().hash_one(std::process::id())
}

/// Time for which the hub continues after the end of a recording, so that subscribers can read the last samples.
const LINGER_TIME: Nanos = 1_000 * MILLIS;
/// Interval of the checks whether the links are alive.
const CHECK_INTERVAL: Timespec = Timespec { tv_sec: 1, tv_nsec: 0 };
/// Interval between cleanups after dead processes. Each one reads the directory of all nodes, and nothing depends on
/// its result.
const CLEANUP_INTERVAL: Nanos = 5_000 * MILLIS;
