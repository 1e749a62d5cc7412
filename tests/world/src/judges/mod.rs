//! The judges: each watches everything that happens for one promise, and says when it is broken. None knows another,
//! nor what a plan wants.

mod accounts;
mod bytes;
mod early;
mod eeprom;
mod family;
mod liveness;
mod lost_on_line;
mod nothing_invented;
mod nothing_lost;
mod numbers;
mod prompt;
mod recording;
mod remote_accounts;
mod remote_bridge;
mod remote_keys;
mod remote_liveness;
mod remote_nothing_invented;
mod remote_numbers;
mod remote_verdict;
mod resources;
mod settings;
mod stamps;
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
        Box::new(bytes::Bytes::new(sensors.len())),
        Box::new(accounts::Accounts::default()),
        Box::new(numbers::Numbers::new(sensors)),
        Box::new(nothing_invented::NothingInvented::new(sensors)),
        Box::new(nothing_lost::NothingLost::new(sensors)),
        Box::new(turns::Turns::new(sensors)),
        Box::new(stamps::Stamps::new(sensors)),
        Box::new(lost_on_line::LostOnLine::new(sensors)),
        Box::new(prompt::Prompt::default()),
        Box::new(early::Early::default()),
        Box::new(recording::Recording::new(plan.seed)),
        Box::new(verdict::OfRobot::new(setup, plan)),
        Box::new(liveness::Liveness::new(sensors)),
        Box::new(settings::Settings::new(sensors.len())),
        Box::new(resources::Resources),
        Box::new(eeprom::Eeprom),
        Box::new(family::OfSensors::new(sensors)),
        Box::new(remote_nothing_invented::RemoteNothingInvented::new(&terms)),
        Box::new(remote_accounts::RemoteAccounts::default()),
        Box::new(remote_bridge::RemoteBridge::new(&terms)),
        Box::new(remote_keys::RemoteKeys::default()),
        Box::new(remote_numbers::RemoteNumbers::new(terms)),
        Box::new(remote_verdict::RemoteVerdict::new(setup, plan, &terms)),
        Box::new(remote_liveness::RemoteLiveness::new(setup, &terms)),
    ]
}

/// More are not said of one world.
const MOST: usize = 20;
