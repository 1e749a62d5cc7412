//! A world from start to end: one clock that advances from one event to the next.

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use scanhub_daemon::CommandSender;
use scanhub_schema::{MILLIS, Nanos, Topic, Verb};
use scanhub_sim::fault::Faults;

use crate::actions::scene_changes;
use crate::event::{Detail, Event, RevolutionFigures, Violation};
use crate::family::ScannerFault;
use crate::hub;
use crate::injected_defects::{Defect, InjectedDefect};
use crate::invariants;
use crate::remote::RemoteMachines;
use crate::scenario::{Action, Scenario};
use crate::setup::Setup;
use crate::shared::{ChangeKind, EventLog, SharedState, SubscriberChange};
use crate::subscriber::{Behavior, Subscriber, SubscriberId, WakeSource};
use crate::topics::TopicBoard;
use crate::tty::Tty;

/// Result of a scenario.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// Violations in order of time.
    pub violations: Vec<Violation>,
    /// Hash of all events.
    pub hash: u64,
    /// Virtual seconds, multiplied by the number of sensors.
    pub sensor_seconds: u64,
    /// Number of samples that hubs published.
    pub samples: u64,
    /// Figures of the revolutions of rotating scanners.
    pub figures: RevolutionFigures,
}

/// Runs `scenario`. Prints its events to standard error as `detail` specifies.
pub fn run(scenario: &Scenario, detail: Detail) -> Outcome {
    World::new(scenario, detail, None, &[]).run_to_end()
}

/// Returns whether one of `invariants` finds a violation while `scenario` runs with `defect` around the hub. The world
/// ends at the first violation.
pub fn is_found(scenario: &Scenario, defect: Option<Defect>, invariants: &'static [&'static str]) -> bool {
    let outcome = World::new(scenario, Detail::Nothing, defect, invariants).run_to_end();
    outcome.violations.iter().any(|violation| invariants.contains(&violation.invariant))
}

/// A task that runs at a scheduled time, or when all faults are cleared.
type ScheduledTask = Box<dyn FnOnce(&mut World)>;

/// Requests from actions to the hub.
#[derive(Default)]
pub(crate) struct HubRequests {
    /// Request that the hub end in this way.
    pub(crate) ending: Option<HubEnding>,
    /// Request to reload the configuration.
    pub(crate) reload: bool,
    /// Requests to sensors.
    pub(crate) sensor_requests: Vec<(usize, Verb)>,
}

/// The way in which a hub ends, and the time at which the next hub starts.
#[derive(Clone, Copy)]
pub(crate) struct HubEnding {
    pub(crate) is_killed: bool,
    pub(crate) restart_at: Nanos,
}

/// Everything in a world except the hub.
pub(crate) struct World {
    pub(crate) shared: Rc<SharedState>,
    pub(crate) setup: Rc<Setup>,
    pub(crate) seed: u64,
    pub(crate) subscribers: Vec<Subscriber>,
    actions: VecDeque<Action>,
    scheduled: BTreeMap<(Nanos, u64), ScheduledTask>,
    next_task_id: u64,
    faults_clear_at: Nanos,
    end: Nanos,
    pub(crate) hub_requests: HubRequests,
    /// Edition of the configuration that the hub reads next.
    pub(crate) edition: Rc<Cell<u64>>,
    /// Number of the current or next run of the hub; and time at which that run starts or has started.
    pub(crate) run: u64,
    pub(crate) hub_starts_at: Nanos,
    /// Time until which the hub's process is stalled.
    pub(crate) stalled_until: Nanos,
    pub(crate) commands: Option<CommandSender>,
    /// The machines that receive the hub's topics.
    pub(crate) remote_machines: RemoteMachines,
}

impl World {
    fn new(
        scenario: &Scenario,
        detail: Detail,
        defect: Option<Defect>,
        sought_invariants: &'static [&'static str],
    ) -> World {
        let setup = Rc::new(Setup::from_scenario(scenario));
        let sensors = setup.sensors(|sensor| scene_changes(scenario, sensor, setup.sensors.len()));
        let sensors = sensors.into_iter().zip(setup.unsupported_rates.iter().cloned()).enumerate();
        let ports = sensors.map(|(number, (sensor, impossible))| Tty::new(number, sensor, impossible));
        let shared = Rc::new(SharedState {
            clock: Cell::new(0),
            wall_offset: Cell::new(WALL_NS),
            ports: ports.map(RefCell::new).collect(),
            topics: RefCell::new(TopicBoard::new(setup.sensors.len())),
            log: EventLog::new(invariants::all(&setup, scenario), detail, sought_invariants),
            defect: InjectedDefect::new(defect),
            files: RefCell::default(),
            disk_is_full: Cell::new(false),
            records: RefCell::default(),
            keeps_ports: setup.keeps_ports,
            stored_lines: RefCell::default(),
            handles: Cell::new(0),
            lacks_descriptors: Cell::new(false),
            wakeups: RefCell::default(),
            next_subscriber: Cell::default(),
            changes: RefCell::default(),
            attached: RefCell::default(),
            detached: RefCell::default(),
        });
        let mut world = World {
            shared,
            setup: setup.clone(),
            seed: scenario.seed,
            subscribers: Vec::new(),
            actions: scenario.actions.clone().into(),
            scheduled: BTreeMap::new(),
            next_task_id: 0,
            faults_clear_at: scenario.faults_clear_at(),
            end: scenario.seconds * 1_000 * MILLIS,
            hub_requests: HubRequests::default(),
            edition: Rc::default(),
            run: 0,
            hub_starts_at: 0,
            stalled_until: 0,
            commands: None,
            remote_machines: RemoteMachines::new(scenario, &setup),
        };
        for &(sensor, topic, behavior, holds) in &setup.subscribers {
            world.attach(sensor, topic, behavior, holds);
        }
        world.remote_machines.begin_gateway(&world.shared);
        world.remote_machines.begin_listener(&world.shared);
        world
    }

    fn run_to_end(mut self) -> Outcome {
        while !self.is_over() {
            self.run_without_hub();
            if !self.is_over() {
                hub::run_hub(&mut self);
            }
        }
        self.finish()
    }

    pub(crate) fn now(&self) -> Nanos {
        self.shared.clock.get()
    }

    /// Returns whether the world has ended.
    pub(crate) fn is_over(&self) -> bool {
        self.now() >= self.end || self.shared.log.is_found()
    }

    /// Returns the remaining time in which faults may occur.
    pub(crate) fn time_until_faults_clear(&self) -> Nanos {
        self.faults_clear_at.saturating_sub(self.now())
    }

    /// Returns the time of the next event outside the hub.
    pub(crate) fn next_ns(&self) -> Nanos {
        let action = self.actions.front().map(|action| action.at_ms * MILLIS);
        let later = self.scheduled.first_key_value().map(|((at, _), _)| *at);
        let subscribers = self.subscribers.iter().map(|subscriber| subscriber.next_ns(self.now()));
        let all = action.into_iter().chain(later).chain(subscribers);
        all.chain([self.remote_machines.next_ns(self.now()), self.faults_clear_at, self.end])
            .min()
            .unwrap_or(self.end)
    }

    /// Sets the time to `now`, and runs all actions, tasks, subscribers and remote machines that are due.
    pub(crate) fn run_due(&mut self, now: Nanos) {
        self.shared.clock.set(self.now().max(now));
        while self.actions.front().is_some_and(|action| action.at_ms * MILLIS <= now)
            && let Some(action) = self.actions.pop_front()
        {
            self.shared.log_event(&Event::ActionTaken { text: &action.to_string() });
            (action.kind.act)(self, &action);
        }
        while let Some(entry) = self.scheduled.first_entry().filter(|entry| entry.key().0 <= now) {
            entry.remove()(self);
        }
        if now >= self.faults_clear_at {
            self.clear_faults();
        }
        for subscriber in &mut self.subscribers {
            if subscriber.next_ns(now) <= now {
                subscriber.run(&self.shared, now);
            }
        }
        self.remote_machines.run_due(&self.shared, now);
    }

    /// Delivers all wakeups to their subscribers.
    pub(crate) fn deliver_wakeups(&mut self) {
        self.apply_subscriber_changes();
        for (sensor, wake_source, at) in self.shared.wakeups.borrow_mut().drain(..) {
            let its = self.subscribers.iter_mut().filter(|subscriber| subscriber.sensor == sensor);
            its.for_each(|subscriber| subscriber.wake(wake_source, at));
            if wake_source != WakeSource::Event {
                self.remote_machines.wake(at);
            }
        }
    }

    /// Applies the changes of subscribers that happened while samples were sent.
    fn apply_subscriber_changes(&mut self) {
        let shared = self.shared.clone();
        let leavers = shared.detached.take();
        self.subscribers.retain(|subscriber| !leavers.contains(&subscriber.id));
        for (subscriber, span_ms) in shared.attached.take() {
            let (sensor, topic, number) = (subscriber.sensor, subscriber.topic, subscriber.id);
            self.subscribers.push(subscriber);
            self.schedule(span_ms, move |world| {
                let what = ChangeKind::Detach { topic, id: number };
                let sends = u64::from(number.0) % MAX_SENDS;
                world.shared.changes.borrow_mut().push(SubscriberChange {
                    sensor,
                    after_sends: sends,
                    kind: what,
                });
            });
        }
    }

    /// Makes all subscribers poll soon, because a hub has started. Each subscriber without a hub searches for one at
    /// fixed intervals.
    pub(crate) fn poll_all_subscribers(&mut self) {
        let at = self.now() + HUB_POLL_INTERVAL;
        self.subscribers.iter_mut().for_each(|subscriber| subscriber.poll_at(at));
        self.remote_machines.wake(at);
    }

    /// Schedules `task` to run after `span_ms` milliseconds, or when all faults are cleared.
    pub(crate) fn schedule(&mut self, span_ms: u64, task: impl FnOnce(&mut World) + 'static) {
        let at = self.now() + span_ms * MILLIS;
        self.scheduled.insert((at, self.next_task_id), Box::new(task));
        self.next_task_id += 1;
    }

    /// Attaches a new subscriber, if there is a free slot.
    pub(crate) fn attach(
        &mut self,
        sensor: usize,
        topic: Topic,
        behavior: Behavior,
        max_held: usize,
    ) -> Option<SubscriberId> {
        let number = self.shared.next_subscriber_id();
        let subscriber =
            Subscriber::attach(&self.shared, number, (sensor, topic), behavior, max_held, self.now())?;
        self.subscribers.push(subscriber);
        Some(number)
    }

    /// Removes a subscriber. With `is_killed`, the subscriber is killed, and otherwise it leaves.
    pub(crate) fn detach(&mut self, id: SubscriberId, is_killed: bool) {
        if let Some(at) = self.subscribers.iter().position(|subscriber| subscriber.id == id) {
            self.subscribers.remove(at).detach(&self.shared, is_killed, false);
        }
    }

    /// Calls `task` with the port of `sensor`.
    pub(crate) fn with_port(&mut self, sensor: usize, task: impl FnOnce(&mut Tty, &EventLog, Nanos)) {
        task(&mut self.shared.ports[sensor].borrow_mut(), &self.shared.log, self.now());
    }

    /// Applies `faults` to the line of an action's sensor for the duration of the action.
    pub(crate) fn inject_line_fault(&mut self, action: &Action, faults: &Faults) {
        let (sensor, seed) = (self.sensor(action), self.seed ^ action.at_ms);
        self.with_port(sensor, |tty, log, now| {
            tty.advance(now, log);
            tty.sensor.set_faults(faults, seed);
        });
        self.schedule(action.value("span_ms"), move |world| {
            world.with_port(sensor, |tty, log, now| {
                tty.advance(now, log);
                tty.sensor.set_faults(&Faults::default(), 0);
            });
        });
    }

    /// Injects `fault` into the scanner of an action's sensor.
    pub(crate) fn inject_scanner_fault(&mut self, action: &Action, fault: ScannerFault) {
        self.with_port(self.sensor(action), |tty, log, now| {
            tty.advance(now, log);
            tty.sensor.inject_fault(fault);
        });
    }

    /// Injects `fault` at the end of an action.
    pub(crate) fn inject_scanner_fault_later(&mut self, action: &Action, fault: ScannerFault) {
        let copy = action.clone();
        self.schedule(action.value("span_ms"), move |world| world.inject_scanner_fault(&copy, fault));
    }

    /// Returns the index of an action's sensor.
    pub(crate) fn sensor(&self, action: &Action) -> usize {
        action.value("sensor") as usize % self.setup.sensors.len()
    }

    fn clear_faults(&mut self) {
        self.faults_clear_at = Nanos::MAX;
        while let Some((_, what)) = self.scheduled.pop_first() {
            what(self);
        }
        self.hub_starts_at = self.hub_starts_at.min(self.now());
        self.stalled_until = 0;
        self.remote_machines.clear_faults();
        self.shared.log_event(&Event::FaultsCleared);
    }

    /// Runs the world until the next hub starts.
    fn run_without_hub(&mut self) {
        while self.now() < self.hub_starts_at && !self.is_over() {
            self.run_due(self.next_ns().min(self.hub_starts_at));
            self.hub_requests = HubRequests::default();
        }
    }

    fn finish(mut self) -> Outcome {
        self.apply_subscriber_changes();
        for subscriber in &mut self.subscribers {
            subscriber.drain(&self.shared);
        }
        for subscriber in std::mem::take(&mut self.subscribers) {
            subscriber.detach(&self.shared, false, true);
        }
        self.remote_machines.close(&self.shared);
        let kept = self.shared.stored_lines.take();
        drop(kept);
        self.shared.topics.borrow_mut().end();
        self.shared.topics.borrow_mut().remove_killed();
        let (loans, held) = self.shared.topics.borrow().in_use();
        let eeprom_writes = self.shared.ports.iter().map(|port| port.borrow().sensor.eeprom_writes()).sum();
        let handles = self.shared.handles.get();
        self.shared.log_event(&Event::WorldEnded { eeprom_writes, handles, loans, held });
        let (violations, hash, samples, figures) = self.shared.log.finish();
        let sensor_seconds = self.end / (1_000 * MILLIS) * self.setup.sensors.len() as u64;
        Outcome { violations, hash, sensor_seconds, samples, figures }
    }
}

/// Wall clock at the start of a world, in nanoseconds since 1970. This time is on a day in 2026.
const WALL_NS: u64 = 1_780_000_000_000_000_000;
/// Exclusive limit for the number of further samples after which a subscriber leaves. A scan has fewer samples than
/// this.
const MAX_SENDS: u64 = 12;
/// Interval at which a subscriber without a hub searches for one.
const HUB_POLL_INTERVAL: Nanos = 50 * MILLIS;
