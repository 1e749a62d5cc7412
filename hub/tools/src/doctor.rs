//! `scanhub doctor`: checks every condition of a working setup, and reports findings and remedies.
//!
//! It changes no scanner, no file and no process, unless the user requests the removal of files that dead processes
//! left. If a port was named and no process holds it, `doctor` opens the port in the same way as the hub. Afterwards,
//! the port remains in raw mode at the rate of the last request, and its driver still returns bytes at once.

mod hub;
mod installation;
mod line;
mod machine;
mod sensor;
mod shared_memory;

use std::fmt;
use std::io::Write;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use clap::Args;
use scanhub_config::{Config, Gateway, Link, Sources};
use scanhub_port::{PortSpec, PortlessAdapter, SerialPortInfo, serial_ports};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind, Printable};
use scanhub_shm::Domain;
use serde::Serialize;

pub use crate::bridge_program::Bridge;
use crate::probe::source;
use crate::terminal::print;
pub(crate) use hub::Hub;
pub use installation::System;
use machine::MachineState;

/// Check the setup and show how to fix what is wrong
#[derive(Args, Debug)]
pub struct DoctorArgs {
    /// Ports to check: a tty, tcp:HOST:PORT, or the name of a link of the running hub. Without a port, doctor checks
    /// the links of the running hub and the ports of the configuration. If the configuration has no port, doctor checks
    /// all ports of this machine
    #[arg(value_name = "PORT")]
    ports: Vec<String>,
    /// Before the checks, remove what dead processes left in this domain, unless a hub runs in it
    #[arg(long)]
    clean: bool,
    /// Router to which a bridge of this machine connects, as in `scanhub bridge --connect`. doctor checks whether the
    /// connection would work. Can be repeated
    #[arg(long, value_name = "ADDRESS")]
    bridge: Vec<String>,
    /// Configuration of Zenoh to check, as in `scanhub bridge --config`
    #[arg(long, value_name = "FILE")]
    bridge_config: Option<PathBuf>,
}

impl DoctorArgs {
    /// Makes all checks, and prints each finding as soon as it is known. The configuration is that of `sources`. A hub
    /// would create `domain`, and a client would search for the domain in `locations`.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`run_checks`], and [`Kind::Failed`] if `out` cannot be written.
    pub fn run(
        &self,
        sources: &Sources,
        (domain, locations): (Domain, Vec<Domain>),
        json: bool,
        out: &mut dyn Write,
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        let is_configured = !(sources.files.is_empty() && sources.links.is_empty() && sources.set.is_empty());
        let read = sources.read();
        let gateway = Gateway::of(&read);
        let targets = CheckTargets {
            ports: self.ports.iter().map(|port| source(port)).collect::<Result<_, _>>()?,
            config: is_configured
                .then(|| Config::of(&read).and_then(|config| gateway.clone().map(|_| config))),
            gateway: gateway.clone().unwrap_or_default(),
            domain,
            locations,
            system: System::local(),
            bridge: Bridge {
                connect: self.bridge.clone(),
                config: self.bridge_config.clone(),
                ..Bridge::default()
            },
            clean: self.clean,
        };
        let mut port = None;
        let mut written = Ok(());
        let result = run_checks(&targets, stop, &mut |finding| {
            if written.is_err() {
                return;
            }
            let mut heading = String::new();
            if port != finding.port {
                port.clone_from(&finding.port);
                let link = finding.link.as_ref().map(|link| format!(" (link {link})"));
                heading = format!("\n{}{}\n", port.as_deref().unwrap_or_default(), link.unwrap_or_default());
            }
            written = print(out, json, finding, || format!("{heading}{finding}"));
        });
        written.and(result)
    }
}

/// The ports, the configuration and the machine to check.
#[derive(Clone, Debug)]
pub struct CheckTargets {
    /// Ports as the user named them, or names of links of the running hub. If the list is empty, the ports of the
    /// configuration and of the running hub.
    pub ports: Vec<PortSpec>,
    /// The configuration, or the reason why it is invalid; `None` if no configuration exists.
    pub config: Option<Result<Config, Failure>>,
    /// The gateway's section of the configuration.
    pub gateway: Gateway,
    /// The domain that a hub would create.
    pub domain: Domain,
    /// The locations in which a client would search for the domain.
    pub locations: Vec<Domain>,
    /// The machine's files.
    pub system: System,
    /// Connection of a bridge to other machines.
    pub bridge: Bridge,
    /// Whether to remove files that dead processes left in the domain, before the checks.
    pub clean: bool,
}

/// A port to check, and its link in the configuration.
pub(crate) struct PortTarget {
    pub(crate) source: PortSpec,
    pub(crate) link: Option<Link>,
    /// Whether the user or the configuration named the port. Another port may belong to any device, so nothing is sent
    /// to it.
    pub(crate) is_named: bool,
}

/// The names of all checks, in their order. docs/doctor.md has a line for each.
pub const CHECKS: &[&str] = &[
    "configuration",
    "ports",
    "clean",
    "version",
    "service",
    "udev",
    "memory",
    "domain",
    "hubs",
    "foreign-files",
    "leftovers",
    "descriptors",
    "file-size",
    "logout",
    "multicast",
    "bridge",
    "port",
    "holder",
    "access",
    "latency",
    "rate",
    "sensor",
    "settings",
    "power-on",
    "health",
    "marks",
    "line-errors",
    "line-loss",
];

/// The result of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// As it should be.
    Ok,
    /// Works, but could work better.
    Warning,
    /// Cannot work in this way.
    Failed,
    /// Not checked. The finding has the reason.
    Skipped,
}

/// Finding of one check; class `check`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    class: &'static str,
    /// Name of the check.
    pub name: &'static str,
    /// The result.
    pub state: State,
    /// The finding, as text.
    pub finding: String,
    /// The remedy, or an empty string.
    pub remedy: String,
    /// The port that the finding describes; `None` if it describes the machine.
    pub port: Option<String>,
    /// The link of the configuration, or else of the running hub, that has this port.
    pub link: Option<String>,
}

impl Finding {
    /// Creates a finding of a check that passed.
    pub(crate) fn ok(name: &'static str, finding: impl Into<String>) -> Finding {
        Finding::new(name, State::Ok, finding, "")
    }

    /// Creates a finding of something that works, and that `remedy` improves.
    pub(crate) fn warning(
        name: &'static str,
        finding: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        Finding::new(name, State::Warning, finding, remedy)
    }

    /// Creates a finding of something that cannot work without `remedy`.
    pub(crate) fn failed(
        name: &'static str,
        finding: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        Finding::new(name, State::Failed, finding, remedy)
    }

    /// Creates a finding of a check that was not made, with the reason.
    pub(crate) fn skipped(name: &'static str, why: impl Into<String>) -> Finding {
        Finding::new(name, State::Skipped, why, "")
    }

    /// Returns this finding, assigned to `port` and its `link`.
    pub(crate) fn at(self, port: &str, link: Option<&str>) -> Finding {
        Finding { port: Some(port.to_owned()), link: link.map(str::to_owned), ..self }
    }

    fn new(
        name: &'static str,
        state: State,
        finding: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        debug_assert!(CHECKS.contains(&name), "{name} is in no list");
        let (finding, remedy) = (finding.into(), remedy.into());
        Finding { class: "check", name, state, finding, remedy, port: None, link: None }
    }
}

impl fmt::Display for Finding {
    /// Writes one line, and a second line for a remedy.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let state = match self.state {
            State::Ok => "ok",
            State::Warning => "warning",
            State::Failed => "FAILED",
            State::Skipped => "skipped",
        };
        write!(f, "{state:<8} {:<13} {}", self.name, Printable(&self.finding))?;
        if !self.remedy.is_empty() {
            write!(f, "\n{:23}{}", "", Printable(&self.remedy))?;
        }
        Ok(())
    }
}

/// Makes all checks, and calls `report` with each finding as soon as it is known.
///
/// # Errors
///
/// Returns [`Kind::Check`] with the number of checks that failed, and [`Kind::Interrupted`] if `stop` is set.
pub fn run_checks(
    targets: &CheckTargets,
    stop: &AtomicBool,
    report: &mut dyn FnMut(&Finding),
) -> Result<(), Failure> {
    let mut failed = 0;
    let mut report = |finding: Finding| {
        failed += usize::from(finding.state == State::Failed);
        report(&finding);
    };
    let serial_ports = serial_ports();
    let hub_location = targets
        .locations
        .iter()
        .find(|location| matches!(scanhub_shm::hub_pid(location.root()), Ok(Some(_))));
    let domain = hub_location.unwrap_or(&targets.domain);
    let hub = Hub::find(domain);
    let portless = PortlessAdapter::all(&targets.system.path("/"));
    let ports = select_ports(targets, &serial_ports, &portless, hub.as_ref(), &mut report);
    for adapter in &portless {
        report(line::without_port(adapter, ports.is_empty()));
    }
    let (system, pid) = (&targets.system, hub.as_ref().map(|hub| hub.pid));
    if targets.clean {
        let elsewhere = targets.locations.iter().filter(|location| location.root() != domain.root());
        let locations: Vec<&Domain> = std::iter::once(domain).chain(elsewhere).collect();
        report(shared_memory::clean(&locations, system.user()));
    }
    report(installation::version(system, pid));
    report(installation::service(system, pid));
    report(installation::rules(system, &serial_ports));
    let limits = match &targets.config {
        Some(Ok(config)) => config.topic_limits(),
        _ => vec![TopicLimits::default(); ports.len().max(1)],
    };
    let facts = MachineState::gather(domain, &targets.locations, limits, hub.as_ref());
    let config = targets.config.as_ref().and_then(|config| config.as_ref().ok());
    report(machine::memory(&facts, config.and_then(scanhub_config::Config::memory_remedy)));
    report(machine::domain(&facts));
    report(machine::hubs(&facts, |user| system.name_of(user)));
    report(shared_memory::foreign_files(&scanhub_shm::foreign_segments(domain.root()), |user| {
        system.name_of(user)
    }));
    report(shared_memory::leftovers(&facts));
    report(machine::descriptors(&facts));
    report(machine::file_size(&facts));
    report(installation::logout(system, pid.and_then(installation::user_of).unwrap_or(system.user())));
    report(machine::multicast(system, targets.gateway.interface.as_deref()));
    targets.bridge.check().into_iter().for_each(&mut report);
    for subject in &ports {
        let link = subject.link.as_ref().map(|link| link.name.as_str());
        let of_hub = || hub.as_ref().and_then(|hub| hub.link(&subject.source)).map(|(name, _)| name);
        let (port, link) = (subject.source.name(), link.or_else(of_hub));
        line::check_port(subject, &serial_ports, hub.as_ref(), stop, &mut |finding| {
            report(finding.at(&port, link))
        })?;
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

/// Returns the ports that the user named. If the user named none, returns the ports of the configuration, or all ports
/// of the machine if the configuration has none, and in addition the ports of the running hub.
fn select_ports(
    targets: &CheckTargets,
    serial_ports: &[SerialPortInfo],
    portless: &[PortlessAdapter],
    hub: Option<&Hub>,
    report: &mut impl FnMut(Finding),
) -> Vec<PortTarget> {
    const NAME: &str = "configuration";
    let links = match &targets.config {
        Some(Ok(config)) => {
            let names: Vec<&str> = config.links.iter().map(|link| link.name.as_str()).collect();
            report(Finding::ok(NAME, format!("links {}", names.join(", "))));
            &config.links[..]
        }
        Some(Err(failure)) => {
            report(Finding::failed(NAME, failure.message.clone(), failure.hint.clone()));
            &[]
        }
        None => &[],
    };
    let of_link = |source: &PortSpec| links.iter().find(|link| link.port.is_same_port(source)).cloned();
    if !targets.ports.is_empty() {
        let named = targets.ports.iter();
        return named
            .map(|source| hub.and_then(|hub| hub.port_of(source)).unwrap_or_else(|| source.clone()))
            .map(|source| PortTarget { link: of_link(&source), source, is_named: true })
            .collect();
    }
    // The hub may have other links than this configuration, and ports that are not lines of this machine. A port that
    // the hub waits for is not opened.
    let add_links_of_hub = |mut ports: Vec<PortTarget>| {
        for source in hub.map(Hub::ports).unwrap_or_default() {
            if !ports.iter().any(|subject| subject.source.is_same_port(&source)) {
                ports.push(PortTarget { source, link: None, is_named: false });
            }
        }
        ports
    };
    if !links.is_empty() {
        let ports = links.iter();
        let ports = ports.map(|link| PortTarget {
            source: link.port.clone(),
            link: Some(link.clone()),
            is_named: true,
        });
        return add_links_of_hub(ports.collect());
    }
    if serial_ports.is_empty() && portless.is_empty() && hub.is_none_or(|hub| hub.ports().is_empty()) {
        report(Finding::failed(
            "ports",
            "no serial line on this machine",
            "plug an adapter in, or name a port",
        ));
    }
    let ports = serial_ports.iter();
    let ports = ports.map(|port| PortTarget {
        source: PortSpec::Tty(port.name.clone()),
        link: None,
        is_named: false,
    });
    add_links_of_hub(ports.collect())
}
