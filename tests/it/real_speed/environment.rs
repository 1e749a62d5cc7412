//! Sensors on ptys, and a hub and subscribers as processes. The test applies the actions of a scenario to them.
//! `invariants.rs` checks the result.

use std::time::{Duration, Instant};

use rustix::process::Signal;
use scanhub_schema::{MILLIS, Nanos, Topic};
use scanhub_sim::Event;
use scanhub_world::Action;
use serde_json::Value;

use super::invariants;
use super::sensors::{SENSORS, Sensors};
use crate::testkit::{HUP, INT, KILL, Program, TERM, TestEnv, number};

pub(super) struct RealSpeedEnvironment {
    env: TestEnv,
    started: Instant,
    sensors: Sensors,
    hub: Option<Program>,
    /// Tasks that follow from earlier actions, each with the time at which it is due.
    scheduled: Vec<(Nanos, ScheduledTask)>,
    /// Subscribers of topic `telegram`, one for each sensor, which run all the time.
    telegrams: Vec<Program>,
    /// Subscribers that an action starts and ends.
    subscribers: Vec<Program>,
    /// Running `control` commands.
    requests: Vec<Program>,
    edition: u64,
    /// Time at which a subscriber was last killed.
    killed_at: Option<Instant>,
}

/// Maximum time until the hub has cleaned up after a killed subscriber. The hub cleans up every five seconds. If it
/// ends before that, the next hub cleans up.
const CLEANUP_INTERVAL: Duration = Duration::from_secs(9);

/// A task that follows from an action.
type ScheduledTask = Box<dyn FnOnce(&mut RealSpeedEnvironment)>;

impl RealSpeedEnvironment {
    /// Starts the sensors, the hub and the subscribers of telegrams. Does not wait until sensors stream.
    pub(super) fn new(seed: u64) -> RealSpeedEnvironment {
        let env = TestEnv::new();
        let sensors = Sensors::start(&env, seed);
        let mut environment = RealSpeedEnvironment {
            env,
            started: Instant::now(),
            sensors,
            hub: None,
            scheduled: Vec::new(),
            telegrams: Vec::new(),
            subscribers: Vec::new(),
            requests: Vec::new(),
            edition: 0,
            killed_at: None,
        };
        environment.start_hub();
        environment.telegrams =
            SENSORS.map(|name| environment.env.echo(&[&format!("{name}/telegram")])).into();
        environment.started = Instant::now();
        environment
    }

    fn now(&self) -> Nanos {
        self.started.elapsed().as_nanos() as Nanos
    }

    /// Waits until the time `at` (nanoseconds since the start), and runs the scheduled tasks that become due until
    /// then.
    pub(super) fn wait_until(&mut self, at: Nanos) {
        loop {
            self.scheduled.sort_by_key(|(due, _)| *due);
            let due = self.scheduled.first().map_or(at, |(due, _)| (*due).min(at));
            std::thread::sleep(Duration::from_nanos(due.saturating_sub(self.now())));
            if self.scheduled.first().is_none_or(|(due, _)| *due > at) {
                return;
            }
            let (_, what) = self.scheduled.remove(0);
            what(self);
        }
    }

    fn schedule(&mut self, span: Nanos, task: impl FnOnce(&mut RealSpeedEnvironment) + 'static) {
        self.scheduled.push((self.now() + span, Box::new(task)));
    }

    /// Applies `action` if this is possible with real programs. Ignores actions on the machine's clock, disk, memory
    /// and permissions, and on a sensor's view and quirks.
    pub(super) fn perform(&mut self, action: &Action) {
        let sensor = action.value("sensor") as usize % SENSORS.len();
        let span = action.value("span_ms") * MILLIS;
        if let Some(faults) = action.faults(0) {
            self.sensors.inject(&self.env, sensor, Event::Faults(Box::new(faults), action.at_ms));
            self.schedule(span, move |environment| environment.clear_line_faults(sensor));
            return;
        }
        match action.name() {
            "unplug" => self.sensors.inject(&self.env, sensor, Event::Unplug(span)),
            "replug_elsewhere" => {
                let span = span + action.value("out_ms") * MILLIS;
                self.sensors.inject(&self.env, sensor, Event::Unplug(span));
            }
            "power_cycle" => self.sensors.inject(&self.env, sensor, Event::PowerCycle),
            "stall" => self.stall(span),
            "kill_hub" => self.end_hub(KILL, action.value("away_ms") * MILLIS),
            "end_hub" => self.end_hub(TERM, action.value("away_ms") * MILLIS),
            "reload" => {
                self.edition = action.value("edition");
                self.configuration();
                self.hub.iter().for_each(|hub| hub.signal(HUP));
            }
            "consumer_comes" => self.attach_subscriber(sensor, action.value("topic"), span, INT),
            "consumer_killed" => self.attach_subscriber(sensor, action.value("topic"), span, KILL),
            "consumer_stops" => self.stall_subscriber(action.value("which"), span),
            "pause" => {
                self.send_request(sensor, "pause");
                self.schedule(span, move |environment| environment.send_request(sensor, "resume"));
            }
            "resync" if action.value("verb") == 0 => self.send_request(sensor, "resync"),
            _ => {}
        }
    }

    fn clear_line_faults(&mut self, sensor: usize) {
        self.sensors.inject(&self.env, sensor, Event::Faults(Box::default(), 0));
    }

    fn stall(&mut self, span: Nanos) {
        let Some(hub) = &self.hub else { return };
        hub.signal(Signal::STOP);
        let pid = hub.pid();
        self.schedule(span, move |environment| {
            if let Some(hub) = environment.hub.as_ref().filter(|hub| hub.pid() == pid) {
                hub.signal(Signal::CONT);
            }
        });
    }

    fn end_hub(&mut self, signal: Signal, down_time: Nanos) {
        let Some(hub) = self.hub.take() else { return };
        // Continue the process first, because a stopped process does not handle SIGTERM.
        hub.signal(Signal::CONT);
        let outcome = hub.end(signal);
        assert_eq!(outcome.exit_code, (signal == TERM).then_some(0), "{outcome}");
        self.schedule(down_time, RealSpeedEnvironment::start_hub);
    }

    fn start_hub(&mut self) {
        if self.hub.is_none() {
            // A hub does not start with a bad configuration, so use one only for a reload. The editions 0 and 1 are
            // valid.
            self.edition = self.edition.min(1);
            self.hub = Some(self.env.hub(&[self.configuration(), "--no-system-config".to_owned()]));
        }
    }

    /// Writes the hub's configuration of the current edition, which may be invalid, and returns the flag that names the
    /// file.
    fn configuration(&self) -> String {
        let link = |name: &str| {
            format!("[[link]]\nname = \"{name}\"\nport = \"{}\"\n", self.env.path_argument(name))
        };
        let radii = ["[1.0, 0.6]", "[1.2, 0.6]", "[0.6, 1.2]"][self.edition as usize % 3];
        let text = SENSORS.map(link).concat() + &format!("[zones]\nradii = {radii}\n");
        format!("--config={}", self.env.file("scanhub.toml", text))
    }

    /// Starts a subscriber, and schedules a task that sends `signal` to it after `span`.
    fn attach_subscriber(&mut self, sensor: usize, topic: u64, span: Nanos, signal: Signal) {
        let topic = Topic::ALL[topic as usize % Topic::ALL.len()].name();
        let guest = self.env.start(&["echo", "--json", &format!("{}/{topic}", SENSORS[sensor])]);
        let pid = guest.pid();
        self.subscribers.push(guest);
        self.schedule(span, move |environment| {
            if let Some(at) = environment.subscribers.iter().position(|guest| guest.pid() == pid) {
                let guest = environment.subscribers.swap_remove(at);
                guest.signal(Signal::CONT);
                let outcome = guest.end(signal);
                if signal == KILL {
                    environment.killed_at = Some(Instant::now());
                }
                // A subscriber that has just started may not have a handler for the signal yet, so the signal may end
                // it.
                assert!(matches!(outcome.exit_code, None | Some(0)), "{outcome}");
            }
        });
    }

    fn stall_subscriber(&mut self, which: u64, span: Nanos) {
        let which = which as usize % self.subscribers.len().max(1);
        let Some(guest) = self.subscribers.get(which) else { return };
        guest.signal(Signal::STOP);
        let pid = guest.pid();
        self.schedule(span, move |environment| {
            let guest = environment.subscribers.iter().find(|guest| guest.pid() == pid);
            guest.iter().for_each(|guest| guest.signal(Signal::CONT));
        });
    }

    /// Sends a control request. The hub may not reply, because it may have ended or be stopped.
    fn send_request(&mut self, sensor: usize, verb: &str) {
        self.requests.push(self.env.start(&["control", SENSORS[sensor], verb, "--json"]));
    }

    /// Runs the remaining tasks, clears all faults, and waits until every sensor streams.
    pub(super) fn clear_faults(&mut self) {
        while !self.scheduled.is_empty() {
            let (_, what) = self.scheduled.remove(0);
            what(self);
        }
        self.start_hub();
        for request in self.requests.drain(..) {
            request.wait();
        }
        for (number, name) in SENSORS.into_iter().enumerate() {
            self.clear_line_faults(number);
            // The last request may have paused the sensor.
            let outcome = self.env.run(&["control", name, "resume", "--json"]);
            assert_eq!(outcome.exit_code, Some(0), "{outcome}");
            self.env.await_info(name, |info| info["state"] == "streaming");
        }
    }

    /// Checks the invariants at the end.
    pub(super) fn check_invariants(mut self) {
        // From now on, there are no faults.
        let has_counters = |info: &Value| info["counters"].is_object();
        let calm =
            SENSORS.map(|name| number(&self.env.await_info(name, has_counters)["counters"], "telegrams"));
        for (name, before) in SENSORS.into_iter().zip(calm) {
            self.env.await_info(name, |info| {
                info["counters"]["telegrams"].as_u64()
                    > Some(before + invariants::FAULTLESS_TELEGRAMS as u64 + 40)
            });
        }
        let infos = SENSORS.map(|name| self.env.await_info(name, has_counters));
        let outcomes: Vec<_> = self.telegrams.drain(..).map(|subscriber| subscriber.end(INT)).collect();
        if let Some(killed_at) = self.killed_at {
            std::thread::sleep(CLEANUP_INTERVAL.saturating_sub(killed_at.elapsed()));
        }
        let hub = self.hub.take().expect("a running hub").end(TERM);
        assert_eq!(hub.exit_code, Some(0), "{hub}");
        assert_eq!(self.env.leftover_files(), Vec::<std::path::PathBuf>::new());
        let (sent, summaries) = self.sensors.end(&self.env);
        for ((outcome, info), sent) in outcomes.iter().zip(&infos).zip(&sent) {
            let taken = outcome.of_class("telegram");
            invariants::bytes_are_conserved(info);
            invariants::all_samples_are_counted(&taken, outcome);
            invariants::nothing_is_invented(&taken, sent);
            invariants::nothing_is_lost(&taken, sent, outcome);
        }
        assert!(summaries.iter().all(|summary| summary.eeprom_writes == 0), "{summaries:?}");
    }
}
