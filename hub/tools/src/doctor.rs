//! `scanhub doctor`: checks every condition of a working setup, and reports what was found and what to do. Changes no
//! sensor, no file and no process, unless asked to remove what dead processes left. It opens a port that was named and that
//! nobody holds, as the hub would: the port stays raw at the rate of the last question, and its driver hands over bytes at
//! once.

mod bridge;
mod counts;
mod finding;
mod hub;
mod installed;
mod leftovers;
mod limits;
mod line;
mod logout;
mod machine;
mod multicast;
mod program;
mod segments;
mod sensor;
mod strangers;
mod system;
mod turning;
mod version;

use std::sync::atomic::AtomicBool;

use port::{Candidate, PortlessAdapter, Source, candidates};
use schema::limits::TopicLimits;
use schema::{Domain, Failure, Kind, ipc};

pub use bridge::Bridge;
use config::{Config, Gateway, Link};
pub use finding::{CHECKS, Finding, State};
use hub::Hub;
use machine::Facts;
pub use system::System;

/// What to examine.
#[derive(Clone, Debug)]
pub struct Subjects {
    /// Ports as the user named them, or by the name of a link of the running hub; none: those of the configuration.
    pub ports: Vec<Source>,
    /// The configuration, or why it is refused; nothing if there is none.
    pub config: Option<Result<Config, Failure>>,
    /// The gateway's section of the configuration.
    pub gateway: Gateway,
    /// Where a hub would put its domain.
    pub domain: Domain,
    /// Where a client would look for it.
    pub places: Vec<Domain>,
    /// The machine's files.
    pub system: System,
    /// How a bridge to other machines would connect.
    pub bridge: Bridge,
    /// Whether to first remove what dead processes left in the domain.
    pub clean: bool,
}

/// A port under examination, and what the configuration wants of it.
pub(crate) struct Subject {
    pub(crate) source: Source,
    pub(crate) link: Option<Link>,
    /// Whether somebody said that a sensor is there; anything else may be, and is not spoken to.
    pub(crate) named: bool,
}

/// Examines everything, and calls `tell` with each finding as soon as it is known.
///
/// [`Kind::Check`] with the number of checks that failed, [`Kind::Interrupted`] if `stop` is set.
pub fn examine(
    subjects: &Subjects,
    stop: &AtomicBool,
    tell: &mut dyn FnMut(&Finding),
) -> Result<(), Failure> {
    let mut failed = 0;
    let mut tell = |finding: Finding| {
        failed += usize::from(finding.state == State::Failed);
        tell(&finding);
    };
    let there = candidates();
    let home = subjects.places.iter().find(|place| matches!(schema::holder(place.root()), Ok(Some(_))));
    let domain = home.unwrap_or(&subjects.domain);
    let hub = Hub::find(domain);
    let portless = PortlessAdapter::all(&subjects.system.path("/"));
    let ports = choose(subjects, &there, &portless, hub.as_ref(), &mut tell);
    for adapter in &portless {
        tell(line::without_port(adapter, ports.is_empty()));
    }
    let (system, pid) = (&subjects.system, hub.as_ref().map(|hub| hub.pid));
    if subjects.clean {
        let elsewhere = subjects.places.iter().filter(|place| place.root() != domain.root());
        let places: Vec<&Domain> = std::iter::once(domain).chain(elsewhere).collect();
        tell(leftovers::clean(&places, system.user()));
    }
    tell(version::version(system, pid));
    tell(installed::service(system, pid));
    tell(installed::rules(system, &there));
    let limits = match &subjects.config {
        Some(Ok(config)) => config.topic_limits(),
        _ => vec![TopicLimits::default(); ports.len().max(1)],
    };
    let facts = Facts::gather(domain, &subjects.places, limits, hub.as_ref());
    tell(machine::memory(&facts));
    tell(machine::domain(&facts));
    tell(machine::hubs(&facts, |user| system.name_of(user)));
    tell(strangers::strangers(&ipc::strangers(domain.root()), |user| system.name_of(user)));
    tell(leftovers::leftovers(&facts));
    tell(limits::descriptors(&facts));
    tell(limits::file_size(&facts));
    tell(logout::logout(system, pid.and_then(program::user_of).unwrap_or(system.user())));
    tell(multicast::multicast(system, subjects.gateway.interface.as_deref()));
    bridge::bridge(&subjects.bridge).into_iter().for_each(&mut tell);
    for subject in &ports {
        let (port, link) = (subject.source.name(), subject.link.as_ref().map(|link| link.name.as_str()));
        line::examine(subject, &there, hub.as_ref(), stop, &mut |finding| tell(finding.at(&port, link)))?;
    }
    match failed {
        0 => Ok(()),
        1 => Err(Failure::new(Kind::Check, "1 check failed", "its remedy is printed below it")),
        _ => Err(Failure::new(
            Kind::Check,
            format!("{failed} checks failed"),
            "each remedy is printed below its check",
        )),
    }
}

/// The ports that the user named, else those of the configuration, else all that there are.
fn choose(
    subjects: &Subjects,
    there: &[Candidate],
    portless: &[PortlessAdapter],
    hub: Option<&Hub>,
    tell: &mut impl FnMut(Finding),
) -> Vec<Subject> {
    const NAME: &str = "configuration";
    let links = match &subjects.config {
        Some(Ok(config)) => {
            let names: Vec<&str> = config.links.iter().map(|link| link.name.as_str()).collect();
            tell(Finding::ok(NAME, format!("links {}", names.join(", "))));
            &config.links[..]
        }
        Some(Err(failure)) => {
            tell(Finding::failed(NAME, failure.message.clone(), failure.hint.clone()));
            &[]
        }
        None => &[],
    };
    let of_link = |source: &Source| links.iter().find(|link| link.port == *source).cloned();
    if !subjects.ports.is_empty() {
        let named = subjects.ports.iter();
        return named
            .map(|source| hub.and_then(|hub| hub.port_of(source)).unwrap_or_else(|| source.clone()))
            .map(|source| Subject { link: of_link(&source), source, named: true })
            .collect();
    }
    if !links.is_empty() {
        let ports = links.iter();
        return ports
            .map(|link| Subject { source: link.port.clone(), link: Some(link.clone()), named: true })
            .collect();
    }
    if there.is_empty() && portless.is_empty() {
        tell(Finding::failed(
            "ports",
            "no serial line on this machine",
            "plug an adapter in, or name a port",
        ));
    }
    there
        .iter()
        .map(|port| Subject { source: Source::Tty(port.name.clone()), link: None, named: false })
        .collect()
}
