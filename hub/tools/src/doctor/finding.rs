//! The result of one check: its state, what was found, and what to do about it.

use std::fmt;

use schema::Printable;
use serde::Serialize;

/// The names of all checks, in the order in which they are made; docs/doctor.md has a line for each.
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
    "strangers",
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

/// How a check ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// As it should be.
    Ok,
    /// It works, and could work better.
    Warning,
    /// It cannot work so.
    Failed,
    /// Not looked at; the finding says why.
    Skipped,
}

/// One line of the examination; class `check`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    class: &'static str,
    /// Which check.
    pub name: &'static str,
    /// How it ended.
    pub state: State,
    /// What was found.
    pub finding: String,
    /// What to do; empty if nothing.
    pub remedy: String,
    /// The port that it is about; none: the machine.
    pub port: Option<String>,
    /// The link of the configuration that has this port.
    pub link: Option<String>,
}

impl Finding {
    /// As it should be.
    pub(crate) fn ok(name: &'static str, finding: impl Into<String>) -> Finding {
        Finding::new(name, State::Ok, finding, "")
    }

    /// It works, and `remedy` makes it better.
    pub(crate) fn warning(
        name: &'static str,
        finding: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        Finding::new(name, State::Warning, finding, remedy)
    }

    /// It cannot work before `remedy` is done.
    pub(crate) fn failed(
        name: &'static str,
        finding: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        Finding::new(name, State::Failed, finding, remedy)
    }

    /// Not looked at, for a reason.
    pub(crate) fn skipped(name: &'static str, why: impl Into<String>) -> Finding {
        Finding::new(name, State::Skipped, why, "")
    }

    /// The same, about a port and its link.
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
    /// A line, and one for the remedy if there is one.
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
