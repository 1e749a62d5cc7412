//! A life of the hub in a world: its links, each a state machine that says what to wait for, and whoever writes what they learn.
//! What [`daemon`]'s supervision does with threads and descriptors is done here with times. Refuses to know why it ends.

use std::rc::Rc;

use scanhub_daemon::platform::{Wait, WaitSource, WakeReason};
use scanhub_daemon::{CommandSender, LiveLink, Reload, Service, StateSaver, StateStore};
use scanhub_schema::{Background, Failure, Kind, MICROS, MILLIS, Nanos};

use crate::event::Event;
use crate::setup::Setup;
use crate::shared::Shared;
use crate::sim_platform::SimPlatform;
use crate::world::{Ending, World};

/// A hub begins, lives and ends; `world` knows then when the next one begins.
pub(crate) fn live(world: &mut World) {
    let shared = world.shared.clone();
    let (life, now) = (world.life, world.now());
    world.life += 1;
    let boot = (world.seed + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(life);
    shared.tell(&Event::HubBegins { life, boot });
    let ending = match begin(world, &shared, boot) {
        Ok(ending) => ending,
        // A service manager tries it again.
        Err(failure) => {
            shared.tell(&Event::Acted { text: &format!("hub {life} did not start: {failure}") });
            Ending { is_killed: true, back_at: now + AGAIN }
        }
    };
    world.commands = None;
    world.begins_at = ending.back_at;
    shared.board.borrow_mut().end();
    shared.tell(&Event::HubEnds { life, killed: ending.is_killed });
}

fn begin(world: &mut World, shared: &Rc<Shared>, boot: u64) -> Result<Ending, Failure> {
    let (setup, edition) = (world.setup.clone(), world.edition.clone());
    // What was refused is not there when the next hub begins.
    let read = || setup.config(edition.get());
    let config = read().or_else(|_| setup.config(0))?;
    let wall_ns = |now: Nanos| now + shared.wall_ahead.get();
    let (config, mut saver) = StateSaver::load(config, Disk(shared.clone()), wall_ns(world.now()))?;
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
        links.push(Running::new(live, platform));
    }
    let mut writes_at = world.now();
    world.greet();
    // Its process is another one than that which stood still.
    world.stalled_until = 0;
    let ending = loop {
        world.ring();
        let links_at = links.iter().map(|link| link.next_ns().max(world.stalled_until));
        let next = links_at.chain([world.next_ns(), writes_at]).min().unwrap_or(writes_at);
        world.pass(next);
        if let Some(ending) = world.wants.end.take() {
            break ending;
        }
        if world.is_over() {
            break Ending { is_killed: false, back_at: Nanos::MAX };
        }
        let now = world.now();
        if std::mem::take(&mut world.wants.reload)
            && let Some(commands) = &world.commands
        {
            reload.reload(commands, now);
            links.iter_mut().for_each(|link| link.is_wanted = true);
        }
        for (sensor, verb) in std::mem::take(&mut world.wants.asks) {
            let model = Box::<Background>::default();
            let asked = world.commands.as_mut().map(|commands| commands.ask(&names[sensor], verb, model));
            match asked {
                Some(Ok(_)) => links[sensor].is_wanted = true,
                // Too many wait: whoever asks tries again.
                _ => world.wants.asks.push((sensor, verb)),
            }
        }
        for link in &mut links {
            link.look(now);
            if link.next_ns().max(world.stalled_until) <= now {
                link.run(now);
            }
        }
        while world.commands.as_ref().and_then(CommandSender::outcome).is_some() {}
        if now >= writes_at {
            let due = saver.as_mut().map(|saver| saver.flush_due(now, wall_ns(now), false));
            writes_at = due.unwrap_or(Nanos::MAX).clamp(now + WRITES, now + 10 * WRITES);
        }
    };
    if !ending.is_killed {
        let now = world.now();
        for Running { link, platform, .. } in links {
            platform.clock.pass(now);
            link.end();
        }
        // What they say last wakes whoever sleeps.
        world.ring();
        if let Some(saver) = &mut saver {
            saver.flush_due(world.now(), wall_ns(world.now()), true);
        }
    }
    Ok(ending)
}

/// A link and what its thread would wait for.
struct Running<'a> {
    link: LiveLink<'a, SimPlatform<'a>>,
    platform: &'a SimPlatform<'a>,
    /// The device that it watches, and whether for bytes or only for its loss.
    watched: Option<(u64, bool)>,
    until: Nanos,
    /// What it watches is ready, and its thread runs then.
    ready_at: Option<Nanos>,
    /// A user wants something.
    is_wanted: bool,
}

impl<'a> Running<'a> {
    fn new(link: LiveLink<'a, SimPlatform<'a>>, platform: &'a SimPlatform<'a>) -> Running<'a> {
        Running { link, platform, watched: None, until: 0, ready_at: None, is_wanted: false }
    }

    /// When it has something to do, or when its sensor has something that it may have to.
    fn next_ns(&self) -> Nanos {
        let SimPlatform { shared, number, clock, .. } = self.platform;
        let due = match (self.is_wanted, self.ready_at, self.watched) {
            (true, ..) => 0,
            (_, Some(ready_at), _) => ready_at,
            (.., Some((_, true))) => {
                let sensor = shared.ports[*number].borrow().sensor.next_ns();
                self.until.saturating_add(LATE).min(sensor.unwrap_or(Nanos::MAX))
            }
            _ => self.until.saturating_add(LATE),
        };
        due.max(clock.read())
    }

    /// Looks whether what it watches is ready.
    fn look(&mut self, now: Nanos) {
        let Some((device, wants_bytes)) = self.watched.filter(|_| self.ready_at.is_none()) else { return };
        let SimPlatform { shared, number, .. } = self.platform;
        let mut tty = shared.ports[*number].borrow_mut();
        if wants_bytes {
            tty.advance(now, &shared.log);
        }
        if !tty.is_there(device) || (wants_bytes && tty.waiting() > 0) {
            self.ready_at = Some(now + WAKES);
        }
    }

    /// Its thread runs at `now`, if there is a reason.
    fn run(&mut self, now: Nanos) {
        let woken = if std::mem::take(&mut self.is_wanted) {
            WakeReason::Request
        } else if self.ready_at.is_some() {
            WakeReason::Ready
        } else if now >= self.until {
            WakeReason::Timeout
        } else {
            return;
        };
        self.ready_at = None;
        self.platform.clock.pass(now);
        let Wait { on, until, .. } = self.link.on_wakeup(woken);
        self.watched = match on {
            WaitSource::Nothing | WaitSource::Opening => None,
            WaitSource::Bytes(line) => Some((line.handle.device, true)),
            WaitSource::Loss(line) => Some((line.handle.device, false)),
        };
        self.until = until;
    }
}

/// The files of the domain's state.
struct Disk(Rc<Shared>);

impl StateStore for Disk {
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

/// From a port that is ready to a thread that runs.
const WAKES: Nanos = 50 * MICROS;
/// A timer is late by so much.
const LATE: Nanos = 50 * MICROS;
/// What was learned is written within so long.
const WRITES: Nanos = 100 * MILLIS;
/// A service manager starts a hub again that did not start.
const AGAIN: Nanos = 1_000 * MILLIS;
