//! Invariants of a world, which the simulator calls judges: each watches every event for one promise and reports when it is
//! broken. A judge knows neither the other judges nor the intent of a plan.

mod accounts;
mod early;
mod invented;
mod liveness;
mod lost;
mod numbers;
mod recording;
mod scanner;
mod stamps;
mod subscribers;
mod turns;
mod verdict;

use scanhub_schema::Nanos;

use crate::event::{Event, Figures, Violation};
use crate::plan::Plan;
use crate::remote::Terms;
use crate::setup::Setup;

/// One promise.
pub(crate) trait Judge {
    /// Its name in what is said.
    fn name(&self) -> &'static str;

    /// `event` happened at `at`.
    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>);

    /// What it measured, if that can be told in figures.
    fn figures(&self) -> Figures {
        Figures::default()
    }
}

/// Where a judge says what is broken.
pub(crate) struct Say<'a> {
    pub(crate) judge: &'static str,
    pub(crate) at_ns: Nanos,
    pub(crate) violations: &'a mut Vec<Violation>,
}

impl Say<'_> {
    /// `words` say what is not as it should be.
    pub(crate) fn broken(&mut self, words: String) {
        // What is broken once is often broken with each sample.
        if self.violations.len() < MOST {
            self.violations.push(Violation { judge: self.judge, at_ns: self.at_ns, words });
        }
    }
}

/// All judges, for a world that begins with `setup`.
pub(crate) fn all(setup: &Setup, plan: &Plan) -> Vec<Box<dyn Judge>> {
    let (sensors, terms) = (&setup.sensors[..], Terms::of_plan(plan));
    vec![
        Box::new(lost::Bytes::new(sensors.len())),
        Box::new(accounts::Accounts::default()),
        Box::new(numbers::Numbers::new(sensors)),
        Box::new(invented::NothingInvented::new(sensors)),
        Box::new(lost::NothingLost::new(sensors)),
        Box::new(turns::Turns::new(sensors)),
        Box::new(stamps::Stamps::new(sensors)),
        Box::new(lost::LostOnLine::new(sensors)),
        Box::new(stamps::Prompt::default()),
        Box::new(subscribers::Subscribers::new(sensors.len())),
        Box::new(early::Early::default()),
        Box::new(recording::Recording::new(plan.seed)),
        Box::new(verdict::LocalVerdict::new(setup, plan)),
        Box::new(liveness::Liveness::new(sensors)),
        Box::new(scanner::Settings::new(sensors.len())),
        Box::new(accounts::Resources),
        Box::new(scanner::Eeprom),
        Box::new(scanner::Families::new(sensors)),
        Box::new(invented::RemoteNothingInvented::new(&terms)),
        Box::new(accounts::RemoteAccounts::default()),
        Box::new(accounts::RemoteBridge::new(&terms)),
        Box::new(invented::RemoteKeys::default()),
        Box::new(numbers::RemoteNumbers::new(terms)),
        Box::new(verdict::RemoteVerdict::new(setup, plan, &terms)),
        Box::new(liveness::RemoteLiveness::new(setup, &terms)),
    ]
}

/// More are not said of one world.
const MOST: usize = 20;
