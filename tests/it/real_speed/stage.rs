//! Sensors on ptys, a hub and consumers as processes, to which actions are done. Refuses to know what is right.

use std::time::{Duration, Instant};

use rustix::process::Signal;
use scanhub_schema::{MILLIS, Nanos, Topic};
use scanhub_sim::Event;
use scanhub_world::Action;
use serde_json::Value;

use super::judges;
use super::sensors::{SENSORS, Sensors};
use crate::testkit::{HUP, INT, KILL, Program, TERM, TestEnv, number};

pub(super) struct Stage {
    env: TestEnv,
    begun: Instant,
    sensors: Sensors,
    hub: Option<Program>,
    /// What is to be done later because of an action before, and when.
    later: Vec<(Nanos, Later)>,
    /// Consumers of telegrams, one of each sensor, there all the time.
    telegrams: Vec<Program>,
    /// Consumers that come and go.
    guests: Vec<Program>,
    /// What users ask of sensors.
    asked: Vec<Program>,
    edition: u64,
    /// When a consumer was killed last.
    killed_at: Option<Instant>,
}

/// A hub looks every five seconds what killed consumers left; one that ends earlier leaves it to the next.
const UPKEEP: Duration = Duration::from_secs(9);

/// What follows from an action.
type Later = Box<dyn FnOnce(&mut Stage)>;

impl Stage {
    /// Everything is up; nothing streams yet.
    pub(super) fn new(seed: u64) -> Stage {
        let env = TestEnv::new();
        let sensors = Sensors::start(&env, seed);
        let mut stage = Stage {
            env,
            begun: Instant::now(),
            sensors,
            hub: None,
            later: Vec::new(),
            telegrams: Vec::new(),
            guests: Vec::new(),
            asked: Vec::new(),
            edition: 0,
            killed_at: None,
        };
        stage.start_hub();
        stage.telegrams = SENSORS.map(|name| stage.env.echo(&[&format!("{name}/telegram")])).into();
        stage.begun = Instant::now();
        stage
    }

    fn now(&self) -> Nanos {
        self.begun.elapsed().as_nanos() as Nanos
    }

    /// Waits until `at` after the begin; what is due before is done.
    pub(super) fn await_moment(&mut self, at: Nanos) {
        loop {
            self.later.sort_by_key(|(due, _)| *due);
            let due = self.later.first().map_or(at, |(due, _)| (*due).min(at));
            std::thread::sleep(Duration::from_nanos(due.saturating_sub(self.now())));
            if self.later.first().is_none_or(|(due, _)| *due > at) {
                return;
            }
            let (_, what) = self.later.remove(0);
            what(self);
        }
    }

    fn follow_up(&mut self, span: Nanos, what: impl FnOnce(&mut Stage) + 'static) {
        self.later.push((self.now() + span, Box::new(what)));
    }

    /// Does `action`, if it can be done to a real program: the machine's clock, disk, memory and rights are left alone, and a
    /// sensor's view and quirks are those that it began with.
    pub(super) fn act(&mut self, action: &Action) {
        let sensor = action.value("sensor") as usize % SENSORS.len();
        let span = action.value("span_ms") * MILLIS;
        if let Some(faults) = action.faults(0) {
            self.sensors.suffer(&self.env, sensor, Event::Faults(Box::new(faults), action.at_ms));
            self.follow_up(span, move |stage| stage.calm(sensor));
            return;
        }
        match action.name() {
            "unplug" => self.sensors.suffer(&self.env, sensor, Event::Unplug(span)),
            "replug_elsewhere" => {
                let span = span + action.value("out_ms") * MILLIS;
                self.sensors.suffer(&self.env, sensor, Event::Unplug(span));
            }
            "power_cycle" => self.sensors.suffer(&self.env, sensor, Event::PowerCycle),
            "stall" => self.stall(span),
            "kill_hub" => self.end_hub(KILL, action.value("away_ms") * MILLIS),
            "end_hub" => self.end_hub(TERM, action.value("away_ms") * MILLIS),
            "reload" => {
                self.edition = action.value("edition");
                self.configuration();
                self.hub.iter().for_each(|hub| hub.signal(HUP));
            }
            "consumer_comes" => self.invite(sensor, action.value("topic"), span, INT),
            "consumer_killed" => self.invite(sensor, action.value("topic"), span, KILL),
            "consumer_stops" => self.stop_a_guest(action.value("which"), span),
            "pause" => {
                self.ask(sensor, "pause");
                self.follow_up(span, move |stage| stage.ask(sensor, "resume"));
            }
            "resync" if action.value("verb") == 0 => self.ask(sensor, "resync"),
            _ => {}
        }
    }

    fn calm(&mut self, sensor: usize) {
        self.sensors.suffer(&self.env, sensor, Event::Faults(Box::default(), 0));
    }

    fn stall(&mut self, span: Nanos) {
        let Some(hub) = &self.hub else { return };
        hub.signal(Signal::STOP);
        let pid = hub.pid();
        self.follow_up(span, move |stage| {
            if let Some(hub) = stage.hub.as_ref().filter(|hub| hub.pid() == pid) {
                hub.signal(Signal::CONT);
            }
        });
    }

    fn end_hub(&mut self, signal: Signal, away: Nanos) {
        let Some(hub) = self.hub.take() else { return };
        // One that stands still would not hear of its end.
        hub.signal(Signal::CONT);
        let outcome = hub.end(signal);
        assert_eq!(outcome.code, (signal == TERM).then_some(0), "{outcome}");
        self.follow_up(away, Stage::start_hub);
    }

    fn start_hub(&mut self) {
        if self.hub.is_none() {
            // A bad configuration is for one that runs.
            self.edition = self.edition.min(1);
            self.hub = Some(self.env.hub(&[self.configuration(), "--no-system-config".to_owned()]));
        }
    }

    /// The hub's configuration, good or bad, in a file.
    fn configuration(&self) -> String {
        let link = |name: &str| format!("[[link]]\nname = \"{name}\"\nport = \"{}\"\n", self.env.word(name));
        let radii = ["[1.0, 0.6]", "[1.2, 0.6]", "[0.6, 1.2]"][self.edition as usize % 3];
        let text = SENSORS.map(link).concat() + &format!("[zones]\nradii = {radii}\n");
        format!("--config={}", self.env.file("scanhub.toml", text))
    }

    /// A consumer comes, and gets `signal` after `span`.
    fn invite(&mut self, sensor: usize, topic: u64, span: Nanos, signal: Signal) {
        let topic = Topic::ALL[topic as usize % Topic::ALL.len()].name();
        let guest = self.env.start(&["echo", "--json", &format!("{}/{topic}", SENSORS[sensor])]);
        let pid = guest.pid();
        self.guests.push(guest);
        self.follow_up(span, move |stage| {
            if let Some(at) = stage.guests.iter().position(|guest| guest.pid() == pid) {
                let guest = stage.guests.swap_remove(at);
                guest.signal(Signal::CONT);
                let outcome = guest.end(signal);
                if signal == KILL {
                    stage.killed_at = Some(Instant::now());
                }
                // One that just began may not have got so far as to end in order.
                assert!(matches!(outcome.code, None | Some(0)), "{outcome}");
            }
        });
    }

    fn stop_a_guest(&mut self, which: u64, span: Nanos) {
        let which = which as usize % self.guests.len().max(1);
        let Some(guest) = self.guests.get(which) else { return };
        guest.signal(Signal::STOP);
        let pid = guest.pid();
        self.follow_up(span, move |stage| {
            let guest = stage.guests.iter().find(|guest| guest.pid() == pid);
            guest.iter().for_each(|guest| guest.signal(Signal::CONT));
        });
    }

    /// A user asks; a hub that is not there or stands still answers nothing.
    fn ask(&mut self, sensor: usize, verb: &str) {
        self.asked.push(self.env.start(&["control", SENSORS[sensor], verb, "--json"]));
    }

    /// Ends what goes wrong, and waits until every sensor streams.
    pub(super) fn heal(&mut self) {
        while !self.later.is_empty() {
            let (_, what) = self.later.remove(0);
            what(self);
        }
        self.start_hub();
        for asked in self.asked.drain(..) {
            asked.wait();
        }
        for (number, name) in SENSORS.into_iter().enumerate() {
            self.calm(number);
            // Whoever was asked to pause may have been asked last.
            let outcome = self.env.run(&["control", name, "resume", "--json"]);
            assert_eq!(outcome.code, Some(0), "{outcome}");
            self.env.await_info(name, |info| info["state"] == "streaming");
        }
    }

    /// What has to be so at the end.
    pub(super) fn judge(mut self) {
        // From now on nothing goes wrong.
        let has_counters = |info: &Value| info["counters"].is_object();
        let calm =
            SENSORS.map(|name| number(&self.env.await_info(name, has_counters)["counters"], "telegrams"));
        for (name, before) in SENSORS.into_iter().zip(calm) {
            self.env.await_info(name, |info| {
                info["counters"]["telegrams"].as_u64() > Some(before + judges::CALM as u64 + 40)
            });
        }
        let infos = SENSORS.map(|name| self.env.await_info(name, has_counters));
        let outcomes: Vec<_> = self.telegrams.drain(..).map(|consumer| consumer.end(INT)).collect();
        if let Some(killed_at) = self.killed_at {
            std::thread::sleep(UPKEEP.saturating_sub(killed_at.elapsed()));
        }
        let hub = self.hub.take().expect("a hub lives").end(TERM);
        assert_eq!(hub.code, Some(0), "{hub}");
        assert_eq!(self.env.left_behind(), Vec::<std::path::PathBuf>::new());
        let (sent, summaries) = self.sensors.end(&self.env);
        for ((outcome, info), sent) in outcomes.iter().zip(&infos).zip(&sent) {
            let taken = outcome.of_class("telegram");
            judges::bytes_are_conserved(info);
            judges::all_is_accounted_for(&taken, outcome);
            judges::nothing_is_invented(&taken, sent);
            judges::nothing_is_lost(&taken, sent, outcome);
        }
        assert!(summaries.iter().all(|summary| summary.eeprom_writes == 0), "{summaries:?}");
    }
}
