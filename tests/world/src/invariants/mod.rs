//! Invariants of a world. Each invariant checks one property at every event, and reports violations of this property.
//! An invariant does not depend on other invariants or on the scenario's actions.

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

/// A property that must always hold.
pub(crate) trait Invariant {
    /// Returns the name in reports.
    fn name(&self) -> &'static str;

    /// Handles an event at time `at`.
    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>);

    /// Returns the figures that the invariant measured, if any.
    fn figures(&self) -> RevolutionFigures {
        RevolutionFigures::default()
    }
}

/// Collects the violations of one invariant at one event.
pub(crate) struct ViolationReporter<'a> {
    pub(crate) invariant: &'static str,
    pub(crate) at_ns: Nanos,
    pub(crate) violations: &'a mut Vec<Violation>,
}

impl ViolationReporter<'_> {
    /// Adds a violation.
    pub(crate) fn report(&mut self, message: String) {
        // The number is limited, because the same violation often repeats with every sample.
        if self.violations.len() < MAX_VIOLATIONS {
            self.violations.push(Violation { invariant: self.invariant, at_ns: self.at_ns, message });
        }
    }
}

/// Returns all invariants for a world that starts with `setup`.
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

/// Maximum number of reported violations per world.
const MAX_VIOLATIONS: usize = 20;
