//! A world from its beginning to its end: one clock that jumps from one thing that is due to the next. Refuses to know
//! what a hub does with its links, and what actions mean.

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use scanhub_daemon::CommandSender;
use scanhub_schema::{MILLIS, Nanos, Topic, Verb};
use scanhub_sim::fault::Faults;

use crate::actions::scene_changes;
use crate::consumer::{Bell, Consumer, Habit, Number};
use crate::event::{Detail, Event, Figures, Violation};
use crate::family::Ailment;
use crate::hub;
use crate::judges;
use crate::plan::{Action, Plan};
use crate::planted::{Defect, Planted};
use crate::remote::Remote;
use crate::setup::Setup;
use crate::shared::{Change, Log, Shared, Who};
use crate::topics::Board;
use crate::tty::Tty;

/// What came of a plan.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// What the judges said, in the order of time.
    pub violations: Vec<Violation>,
    /// Of everything that happened.
    pub hash: u64,
    /// Virtual seconds, times sensors.
    pub sensor_seconds: u64,
    /// Samples that hubs published.
    pub samples: u64,
    /// What the turns of heads were like.
    pub figures: Figures,
}

/// Lets happen what `plan` says, and tells standard error so much of it.
pub fn run(plan: &Plan, detail: Detail) -> Outcome {
    World::new(plan, detail, None, &[]).live()
}

/// Returns whether one of `judges` finds a violation while `plan` is played with `defect` around the hub. The world
/// ends with the first violation.
pub fn is_found(plan: &Plan, defect: Option<Defect>, judges: &'static [&'static str]) -> bool {
    let outcome = World::new(plan, Detail::Nothing, defect, judges).live();
    outcome.violations.iter().any(|violation| judges.contains(&violation.judge))
}

/// Something that is to be done at its time, or when everything is made well again.
type Later = Box<dyn FnOnce(&mut World)>;

/// What actions want of the hub.
#[derive(Default)]
pub(crate) struct Wants {
    /// That it is gone, killed or ended in order.
    pub(crate) end: Option<Ending>,
    /// That it reads its configuration again.
    pub(crate) reload: bool,
    /// That it does this to a sensor.
    pub(crate) asks: Vec<(usize, Verb)>,
}

/// How a hub ends, and when the next one begins.
#[derive(Clone, Copy)]
pub(crate) struct Ending {
    pub(crate) is_killed: bool,
    pub(crate) back_at: Nanos,
}

/// All that there is beside a hub.
pub(crate) struct World {
    pub(crate) shared: Rc<Shared>,
    pub(crate) setup: Rc<Setup>,
    pub(crate) seed: u64,
    pub(crate) consumers: Vec<Consumer>,
    actions: VecDeque<Action>,
    later: BTreeMap<(Nanos, u64), Later>,
    next_later: u64,
    heals_at: Nanos,
    end: Nanos,
    pub(crate) wants: Wants,
    /// Which configuration the next reading finds.
    pub(crate) edition: Rc<Cell<u64>>,
    /// Number of the hub, and when it begins or begun.
    pub(crate) life: u64,
    pub(crate) begins_at: Nanos,
    /// Until when its process does not run.
    pub(crate) stalled_until: Nanos,
    pub(crate) commands: Option<CommandSender>,
    /// What is behind the hub's topics in another machine.
    pub(crate) remote: Remote,
}

impl World {
    fn new(plan: &Plan, detail: Detail, defect: Option<Defect>, sought: &'static [&'static str]) -> World {
        let setup = Rc::new(Setup::of_plan(plan));
        let sensors = setup.sensors(|sensor| scene_changes(plan, sensor, setup.sensors.len()));
        let sensors = sensors.into_iter().zip(setup.impossible.iter().cloned()).enumerate();
        let ports = sensors.map(|(number, (sensor, impossible))| Tty::new(number, sensor, impossible));
        let shared = Rc::new(Shared {
            clock: Cell::new(0),
            wall_ahead: Cell::new(WALL_NS),
            ports: ports.map(RefCell::new).collect(),
            board: RefCell::new(Board::new(setup.sensors.len())),
            log: Log::new(judges::all(&setup, plan), detail, sought),
            planted: Planted::new(defect),
            files: RefCell::default(),
            disk_is_full: Cell::new(false),
            records: RefCell::default(),
            keeps_ports: setup.keeps_ports,
            kept: RefCell::default(),
            handles: Cell::new(0),
            lacks_descriptors: Cell::new(false),
            woken: RefCell::default(),
            next_consumer: Cell::default(),
            changes: RefCell::default(),
            newcomers: RefCell::default(),
            leavers: RefCell::default(),
        });
        let mut world = World {
            shared,
            setup: setup.clone(),
            seed: plan.seed,
            consumers: Vec::new(),
            actions: plan.actions.clone().into(),
            later: BTreeMap::new(),
            next_later: 0,
            heals_at: plan.heals_at(),
            end: plan.seconds * 1_000 * MILLIS,
            wants: Wants::default(),
            edition: Rc::default(),
            life: 0,
            begins_at: 0,
            stalled_until: 0,
            commands: None,
            remote: Remote::new(plan, &setup),
        };
        for &(sensor, topic, habit, holds) in &setup.cast {
            world.attach(sensor, topic, habit, holds);
        }
        world.remote.begin_gateway(&world.shared);
        world.remote.begin_listener(&world.shared);
        world
    }

    fn live(mut self) -> Outcome {
        while !self.is_over() {
            self.rest_without_hub();
            if !self.is_over() {
                hub::live(&mut self);
            }
        }
        self.close()
    }

    pub(crate) fn now(&self) -> Nanos {
        self.shared.clock.get()
    }

    /// Whether it is over.
    pub(crate) fn is_over(&self) -> bool {
        self.now() >= self.end || self.shared.log.is_found()
    }

    /// How long things may still go wrong.
    pub(crate) fn until_healed(&self) -> Nanos {
        self.heals_at.saturating_sub(self.now())
    }

    /// When something is due that is not the hub's.
    pub(crate) fn next_ns(&self) -> Nanos {
        let action = self.actions.front().map(|action| action.at_ms * MILLIS);
        let later = self.later.first_key_value().map(|((at, _), _)| *at);
        let consumers = self.consumers.iter().map(|consumer| consumer.next_ns(self.now()));
        let all = action.into_iter().chain(later).chain(consumers);
        all.chain([self.remote.next_ns(self.now()), self.heals_at, self.end]).min().unwrap_or(self.end)
    }

    /// The time is `now`: does what is due.
    pub(crate) fn pass(&mut self, now: Nanos) {
        self.shared.clock.set(self.now().max(now));
        while self.actions.front().is_some_and(|action| action.at_ms * MILLIS <= now)
            && let Some(action) = self.actions.pop_front()
        {
            self.shared.tell(&Event::Acted { text: &action.to_string() });
            (action.kind.act)(self, &action);
        }
        while let Some(entry) = self.later.first_entry().filter(|entry| entry.key().0 <= now) {
            entry.remove()(self);
        }
        if now >= self.heals_at {
            self.heal();
        }
        for consumer in &mut self.consumers {
            if consumer.next_ns(now) <= now {
                consumer.run(&self.shared, now);
            }
        }
        self.remote.pass(&self.shared, now);
    }

    /// Lets consumers know that they were woken.
    pub(crate) fn ring(&mut self) {
        self.admit_newcomers();
        for (sensor, bell, at) in self.shared.woken.borrow_mut().drain(..) {
            let its = self.consumers.iter_mut().filter(|consumer| consumer.sensor == sensor);
            its.for_each(|consumer| consumer.wake(bell, at));
            if bell != Bell::Event {
                self.remote.wake(at);
            }
        }
    }

    /// Takes over the subscribers that attached and left while samples were sent.
    fn admit_newcomers(&mut self) {
        let shared = self.shared.clone();
        let leavers = shared.leavers.take();
        self.consumers.retain(|consumer| !leavers.contains(&consumer.number));
        for (consumer, span_ms) in shared.newcomers.take() {
            let (sensor, topic, number) = (consumer.sensor, consumer.topic, consumer.number);
            self.consumers.push(consumer);
            self.later(span_ms, move |world| {
                let what = Who::Leaves { topic, number };
                let sends = u64::from(number.0) % MOST_SENDS;
                world.shared.changes.borrow_mut().push(Change { sensor, sends, what });
            });
        }
    }

    /// Consumers look for a hub now and then, and find the one that begins.
    pub(crate) fn greet(&mut self) {
        let at = self.now() + LOOKS;
        self.consumers.iter_mut().for_each(|consumer| consumer.look_at(at));
        self.remote.wake(at);
    }

    /// Does `what` in `span_ms`, or when everything is made well again.
    pub(crate) fn later(&mut self, span_ms: u64, what: impl FnOnce(&mut World) + 'static) {
        let at = self.now() + span_ms * MILLIS;
        self.later.insert((at, self.next_later), Box::new(what));
        self.next_later += 1;
    }

    /// A new consumer, if there is a place for it.
    pub(crate) fn attach(
        &mut self,
        sensor: usize,
        topic: Topic,
        habit: Habit,
        holds: usize,
    ) -> Option<Number> {
        let number = self.shared.consumer_number();
        let consumer = Consumer::attach(&self.shared, number, (sensor, topic), habit, holds, self.now())?;
        self.consumers.push(consumer);
        Some(number)
    }

    /// It leaves, or is killed.
    pub(crate) fn detach(&mut self, number: Number, is_killed: bool) {
        if let Some(at) = self.consumers.iter().position(|consumer| consumer.number == number) {
            self.consumers.remove(at).leave(&self.shared, is_killed, false);
        }
    }

    /// Does `what` to the port of `sensor`.
    pub(crate) fn port(&mut self, sensor: usize, what: impl FnOnce(&mut Tty, &Log, Nanos)) {
        what(&mut self.shared.ports[sensor].borrow_mut(), &self.shared.log, self.now());
    }

    /// The line of an action's sensor has `faults` for the action's time.
    pub(crate) fn fault(&mut self, action: &Action, faults: &Faults) {
        let (sensor, seed) = (self.sensor(action), self.seed ^ action.at_ms);
        self.port(sensor, |tty, log, now| {
            tty.advance(now, log);
            tty.sensor.set_faults(faults, seed);
        });
        self.later(action.value("span_ms"), move |world| {
            world.port(sensor, |tty, log, now| {
                tty.advance(now, log);
                tty.sensor.set_faults(&Faults::default(), 0);
            });
        });
    }

    /// `ailment` happens to an action's sensor.
    pub(crate) fn ail(&mut self, action: &Action, ailment: Ailment) {
        self.port(self.sensor(action), |tty, log, now| {
            tty.advance(now, log);
            tty.sensor.suffer(ailment);
        });
    }

    /// The same when an action's time is over.
    pub(crate) fn ail_later(&mut self, action: &Action, ailment: Ailment) {
        let copy = action.clone();
        self.later(action.value("span_ms"), move |world| world.ail(&copy, ailment));
    }

    /// The sensor that an action means.
    pub(crate) fn sensor(&self, action: &Action) -> usize {
        action.value("sensor") as usize % self.setup.sensors.len()
    }

    fn heal(&mut self) {
        self.heals_at = Nanos::MAX;
        while let Some((_, what)) = self.later.pop_first() {
            what(self);
        }
        self.begins_at = self.begins_at.min(self.now());
        self.stalled_until = 0;
        self.remote.heal();
        self.shared.tell(&Event::Healed);
    }

    /// Until the next hub begins.
    fn rest_without_hub(&mut self) {
        while self.now() < self.begins_at && !self.is_over() {
            self.pass(self.next_ns().min(self.begins_at));
            self.wants = Wants::default();
        }
    }

    fn close(mut self) -> Outcome {
        self.admit_newcomers();
        for consumer in &mut self.consumers {
            consumer.drain(&self.shared);
        }
        for consumer in std::mem::take(&mut self.consumers) {
            consumer.leave(&self.shared, false, true);
        }
        self.remote.close(&self.shared);
        let kept = self.shared.kept.take();
        drop(kept);
        self.shared.board.borrow_mut().end();
        self.shared.board.borrow_mut().clean();
        let (loans, held) = self.shared.board.borrow().in_use();
        let eeprom_writes = self.shared.ports.iter().map(|port| port.borrow().sensor.eeprom_writes()).sum();
        let handles = self.shared.handles.get();
        self.shared.tell(&Event::Over { eeprom_writes, handles, loans, held });
        let (violations, hash, samples, figures) = self.shared.log.end();
        let sensor_seconds = self.end / (1_000 * MILLIS) * self.setup.sensors.len() as u64;
        Outcome { violations, hash, sensor_seconds, samples, figures }
    }
}

/// The wall clock when a world begins: some day in 2026.
const WALL_NS: u64 = 1_780_000_000_000_000_000;
/// More than the samples of one scan. A subscriber leaves after fewer.
const MOST_SENDS: u64 = 12;
/// A consumer without a hub looks for one so often.
const LOOKS: Nanos = 50 * MILLIS;
