//! A run of the hub in a world: its links and the saver of learned state. Each link is a state machine that returns
//! what it waits for. The supervision in [`daemon`] uses threads and descriptors; a world uses virtual time instead.

use std::rc::Rc;

use scanhub_daemon::platform::{Wait, WaitSource, WakeReason};
use scanhub_daemon::{CommandSender, LiveLink, Reload, Service, StateSaver, StateStore};
use scanhub_schema::{Background, Failure, Kind, MICROS, MILLIS, Nanos};

use crate::event::Event;
use crate::setup::Setup;
use crate::shared::SharedState;
use crate::sim_platform::SimPlatform;
use crate::world::{HubEnding, World};

/// Runs a hub from its start to its end. Afterward, `world` has the time at which the next hub starts.
pub(crate) fn run_hub(world: &mut World) {
    let shared = world.shared.clone();
    let (run, now) = (world.run, world.now());
    world.run += 1;
    let boot = (world.seed + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(run);
    shared.log_event(&Event::HubStarted { run, boot });
    let ending = match start(world, &shared, boot) {
        Ok(ending) => ending,
        // A service manager would start the hub again.
        Err(failure) => {
            shared.log_event(&Event::ActionTaken { text: &format!("hub {run} did not start: {failure}") });
            HubEnding { is_killed: true, restart_at: now + RESTART_INTERVAL }
        }
    };
    world.commands = None;
    world.hub_starts_at = ending.restart_at;
    shared.topics.borrow_mut().end();
    shared.log_event(&Event::HubEnded { run, killed: ending.is_killed });
}

fn start(world: &mut World, shared: &Rc<SharedState>, boot: u64) -> Result<HubEnding, Failure> {
    let (setup, edition) = (world.setup.clone(), world.edition.clone());
    // The next hub starts with a valid configuration, even if the current one is invalid.
    let read = || setup.config(edition.get());
    let config = read().or_else(|_| setup.config(0))?;
    let wall_ns = |now: Nanos| now + shared.wall_offset.get();
    let (config, mut saver) = StateSaver::load(config, StateFiles(shared.clone()), wall_ns(world.now()))?;
    let queue = saver.as_ref().map(StateSaver::queue);
    let names = || (0..setup.sensors.len()).map(Setup::name).collect::<Vec<_>>();
    let (commands, queues) = CommandSender::new(names().iter().map(String::as_str))?;
    world.commands = Some(commands);
    let (service, names) = (Service::default(), names());
    let mut reload = Reload::new(&config, &read, &service);
    let platform = |(number, name): (usize, &String)| SimPlatform::new(shared, number, name, queue.as_ref());
    let platforms: Vec<SimPlatform<'_>> = names.iter().enumerate().map(platform).collect();
    let mut links = Vec::new();
    for ((number, link), (platform, queue)) in
        config.links.iter().enumerate().zip(platforms.iter().zip(queues))
    {
        let live = LiveLink::new(link, number as u8, boot, platform, queue)?;
        links.push(RunningLink::new(live, platform));
    }
    let mut writes_at = world.now();
    world.poll_all_subscribers();
    // A stall of the previous hub's process does not affect this hub.
    world.stalled_until = 0;
    let ending = loop {
        world.deliver_wakeups();
        let links_at = links.iter().map(|link| link.next_ns().max(world.stalled_until));
        let next = links_at.chain([world.next_ns(), writes_at]).min().unwrap_or(writes_at);
        world.run_due(next);
        if let Some(ending) = world.hub_requests.ending.take() {
            break ending;
        }
        if world.is_over() {
            break HubEnding { is_killed: false, restart_at: Nanos::MAX };
        }
        let now = world.now();
        if std::mem::take(&mut world.hub_requests.reload)
            && let Some(commands) = &world.commands
        {
            reload.reload(commands, now);
            links.iter_mut().for_each(|link| link.is_requested = true);
        }
        for (sensor, verb) in std::mem::take(&mut world.hub_requests.sensor_requests) {
            let model = Box::<Background>::default();
            let result =
                world.commands.as_mut().map(|commands| commands.enqueue(&names[sensor], verb, model));
            match result {
                Some(Ok(_)) => links[sensor].is_requested = true,
                // The queue of requests is full, so the user tries again.
                _ => world.hub_requests.sensor_requests.push((sensor, verb)),
            }
        }
        for link in &mut links {
            link.poll(now);
            if link.next_ns().max(world.stalled_until) <= now {
                link.run(now);
            }
        }
        while world.commands.as_ref().and_then(CommandSender::outcome).is_some() {}
        if now >= writes_at {
            let due = saver.as_mut().map(|saver| saver.flush_due(now, wall_ns(now), false));
            writes_at = due.unwrap_or(Nanos::MAX).clamp(now + WRITE_DELAY, now + 10 * WRITE_DELAY);
        }
    };
    if !ending.is_killed {
        let now = world.now();
        for RunningLink { link, platform, .. } in links {
            platform.clock.advance_to(now);
            link.end();
        }
        // Wake the subscribers of the hub's last samples.
        world.deliver_wakeups();
        if let Some(saver) = &mut saver {
            saver.flush_due(world.now(), wall_ns(world.now()), true);
        }
    }
    Ok(ending)
}

/// A link, and what its thread waits for.
struct RunningLink<'a> {
    link: LiveLink<'a, SimPlatform<'a>>,
    platform: &'a SimPlatform<'a>,
    /// The device that the thread polls. The flag is true if the thread waits for bytes, and false if it waits only for
    /// the loss of the port.
    watched: Option<(u64, bool)>,
    due_at: Nanos,
    /// Time at which the thread runs because the device is ready.
    ready_at: Option<Nanos>,
    /// Whether a user has sent a request.
    is_requested: bool,
}

impl<'a> RunningLink<'a> {
    fn new(link: LiveLink<'a, SimPlatform<'a>>, platform: &'a SimPlatform<'a>) -> RunningLink<'a> {
        RunningLink { link, platform, watched: None, due_at: 0, ready_at: None, is_requested: false }
    }

    /// Returns the time at which the link next has something to do, or at which the link's scanner may next send bytes.
    fn next_ns(&self) -> Nanos {
        let SimPlatform { shared, number, clock, .. } = self.platform;
        let due = match (self.is_requested, self.ready_at, self.watched) {
            (true, ..) => 0,
            (_, Some(ready_at), _) => ready_at,
            (.., Some((_, true))) => {
                let sensor = shared.ports[*number].borrow().sensor.next_ns();
                self.due_at.saturating_add(TIMER_DELAY).min(sensor.unwrap_or(Nanos::MAX))
            }
            _ => self.due_at.saturating_add(TIMER_DELAY),
        };
        due.max(clock.peek())
    }

    /// Checks whether the polled device is ready.
    fn poll(&mut self, now: Nanos) {
        let Some((device, wants_bytes)) = self.watched.filter(|_| self.ready_at.is_none()) else { return };
        let SimPlatform { shared, number, .. } = self.platform;
        let mut tty = shared.ports[*number].borrow_mut();
        if wants_bytes {
            tty.advance(now, &shared.log);
        }
        if !tty.is_plugged_in(device) || (wants_bytes && tty.waiting() > 0) {
            self.ready_at = Some(now + WAKE_DELAY);
        }
    }

    /// Runs the link's thread at `now`, if it has a reason to wake.
    fn run(&mut self, now: Nanos) {
        let woken = if std::mem::take(&mut self.is_requested) {
            WakeReason::Request
        } else if self.ready_at.is_some() {
            WakeReason::Ready
        } else if now >= self.due_at {
            WakeReason::Timeout
        } else {
            return;
        };
        self.ready_at = None;
        self.platform.clock.advance_to(now);
        let Wait { source: on, until, .. } = self.link.on_wakeup(woken);
        self.watched = match on {
            WaitSource::Nothing | WaitSource::Opening => None,
            WaitSource::Bytes(line) => Some((line.handle.device, true)),
            WaitSource::Loss(line) => Some((line.handle.device, false)),
        };
        self.due_at = until;
    }
}

/// Files in the state directory of the domain.
struct StateFiles(Rc<SharedState>);

impl StateStore for StateFiles {
    fn read(&self, name: &str, _: u64) -> Result<Option<String>, Failure> {
        Ok(self.0.files.borrow().get(name).cloned())
    }

    fn write(&self, name: &str, text: &str) -> Result<(), Failure> {
        if self.0.disk_is_full.get() {
            return Err(Failure::new(Kind::Failed, format!("{name}: the disk is full"), ""));
        }
        self.0.files.borrow_mut().insert(name.to_owned(), text.to_owned());
        Ok(())
    }

    fn remove(&self, name: &str) -> Result<(), Failure> {
        self.0.files.borrow_mut().remove(name);
        Ok(())
    }

    fn location(&self, name: &str) -> String {
        name.to_owned()
    }
}

/// Time from a ready port to a running thread.
const WAKE_DELAY: Nanos = 50 * MICROS;
/// Time from the end of a timer to a running thread.
const TIMER_DELAY: Nanos = 50 * MICROS;
/// Minimum time until the hub next saves learned state. The maximum is ten times as long.
const WRITE_DELAY: Nanos = 100 * MILLIS;
/// Time after which a service manager restarts a hub that failed to start.
const RESTART_INTERVAL: Nanos = 1_000 * MILLIS;
