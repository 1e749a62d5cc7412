//! Invariants of a world, which the simulator calls judges: each watches every event for one promise and reports when it is
//! broken. A judge knows neither the other judges nor the intent of a plan.

mod counters;
mod early;
mod headers;
mod invented;
mod liveness;
mod losses;
mod recording;
mod revolutions;
mod scanner;
mod stamps;
mod subscribers;
mod verdict;

use scanhub_schema::Nanos;

use crate::event::{Event, RevolutionFigures, Violation};
use crate::remote::LinkSettings;
use crate::scenario::Scenario;
use crate::setup::Setup;

/// One promise.
pub(crate) trait Invariant {
    /// Its name in what is said.
    fn name(&self) -> &'static str;

    /// `event` happened at `at`.
    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>);

    /// What it measured, if that can be told in figures.
    fn figures(&self) -> RevolutionFigures {
        RevolutionFigures::default()
    }
}

/// Where a judge says what is broken.
pub(crate) struct ViolationReporter<'a> {
    pub(crate) invariant: &'static str,
    pub(crate) at_ns: Nanos,
    pub(crate) violations: &'a mut Vec<Violation>,
}

impl ViolationReporter<'_> {
    /// `words` say what is not as it should be.
    pub(crate) fn report(&mut self, message: String) {
        // What is broken once is often broken with each sample.
        if self.violations.len() < MAX_VIOLATIONS {
            self.violations.push(Violation { invariant: self.invariant, at_ns: self.at_ns, message });
        }
    }
}

/// All judges, for a world that begins with `setup`.
pub(crate) fn all(setup: &Setup, scenario: &Scenario) -> Vec<Box<dyn Invariant>> {
    let (sensors, terms) = (&setup.sensors[..], LinkSettings::from_scenario(scenario));
    vec![
        Box::new(losses::ByteCounters::new(sensors.len())),
        Box::new(counters::SubscriberCounters::default()),
        Box::new(headers::HeaderConsistency::new(sensors)),
        Box::new(invented::NothingInvented::new(sensors)),
        Box::new(losses::NothingLost::new(sensors)),
        Box::new(revolutions::Revolutions::new(sensors)),
        Box::new(stamps::Stamps::new(sensors)),
        Box::new(losses::LostOnLine::new(sensors)),
        Box::new(stamps::Wakeups::default()),
        Box::new(subscribers::Subscribers::new(sensors.len())),
        Box::new(early::EarlyWarnings::default()),
        Box::new(recording::Recording::new(scenario.seed)),
        Box::new(verdict::LocalVerdict::new(setup, scenario)),
        Box::new(liveness::Liveness::new(sensors)),
        Box::new(scanner::PortRate::new(sensors.len())),
        Box::new(counters::Resources),
        Box::new(scanner::Eeprom),
        Box::new(scanner::Families::new(sensors)),
        Box::new(invented::RemoteNothingInvented::new(&terms)),
        Box::new(counters::ListenerCounters::default()),
        Box::new(counters::BridgeCounters::new(&terms)),
        Box::new(invented::RemoteKeys::default()),
        Box::new(headers::RemoteHeaders::new(terms)),
        Box::new(verdict::RemoteVerdict::new(setup, scenario, &terms)),
        Box::new(liveness::RemoteLiveness::new(setup, &terms)),
    ]
}

/// More are not said of one world.
const MAX_VIOLATIONS: usize = 20;
