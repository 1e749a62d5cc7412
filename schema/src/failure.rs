//! Why a verb of the program ended without success, in the words of its users: what kind of failure, which place and
//! value, and the remedy. One type for all crates, because the exit code and the `error` line are a contract.

use std::fmt;

use crate::Printable;

/// The kinds of failure; each has a name for `--json` and an exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Kind {
    /// Something failed that has no kind of its own: exit 1.
    Failed,
    /// Another hub holds the domain: exit 1.
    DomainHeld,
    /// Another process publishes under the name: exit 75.
    NameHeld,
    /// Syntax of the command line, a topic that there is not, or a form that the verb does not take: exit 2.
    Usage,
    /// No hub lives in the domain: exit 3.
    NoHub,
    /// The hub, or the recording, has no such sensor: exit 3.
    NoTopic,
    /// Nothing came within the time allowed: exit 3.
    Timeout,
    /// The port does not exist: exit 4.
    PortMissing,
    /// The port may not be opened by this user: exit 4.
    PortPermission,
    /// Another process has the port: exit 4.
    PortBusy,
    /// The path is not a serial line: exit 4.
    PortNotTty,
    /// The port cannot do the rate: exit 4.
    PortRate,
    /// A check failed (telegrams lost, a limit exceeded): exit 5.
    Check,
    /// A file to read is missing, unreadable, or not what it has to be: exit 66.
    Input,
    /// A file to write exists, or cannot be made: exit 73.
    Output,
    /// Shared memory or descriptors are short, try later: exit 75.
    Short,
    /// A value in the configuration, in `--set` or in `--link`: exit 78.
    Configuration,
    /// Interrupted before a bounded run was through: exit 130.
    Interrupted,
}

impl Kind {
    /// Returns the value of key `kind` in an `error` line.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Failed => "failed",
            Kind::DomainHeld => "domain_held",
            Kind::NameHeld => "name_held",
            Kind::Usage => "usage",
            Kind::NoHub => "no_hub",
            Kind::NoTopic => "no_topic",
            Kind::Timeout => "timeout",
            Kind::PortMissing => "port_missing",
            Kind::PortPermission => "port_permission",
            Kind::PortBusy => "port_busy",
            Kind::PortNotTty => "port_not_tty",
            Kind::PortRate => "port_rate",
            Kind::Check => "check",
            Kind::Input => "input",
            Kind::Output => "output",
            Kind::Short => "short",
            Kind::Configuration => "configuration",
            Kind::Interrupted => "interrupted",
        }
    }

    /// Returns the process's exit code.
    pub fn exit_code(self) -> u8 {
        match self {
            Kind::Failed | Kind::DomainHeld => 1,
            Kind::Usage => 2,
            Kind::NoHub | Kind::NoTopic | Kind::Timeout => 3,
            Kind::PortMissing | Kind::PortPermission | Kind::PortBusy | Kind::PortNotTty | Kind::PortRate => {
                4
            }
            Kind::Check => 5,
            Kind::Input => 66,
            Kind::Output => 73,
            Kind::Short | Kind::NameHeld => 75,
            Kind::Configuration => 78,
            Kind::Interrupted => 130,
        }
    }
}

/// A failure with its remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// What kind it is.
    pub kind: Kind,
    /// What happened: the place and the value.
    pub message: String,
    /// What would be right; may be empty.
    pub hint: String,
}

impl Failure {
    /// Returns a failure of `kind` that says `message`, with the remedy `hint`.
    pub fn new(kind: Kind, message: impl Into<String>, hint: impl Into<String>) -> Self {
        Failure { kind, message: message.into(), hint: hint.into() }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", Printable(&self.message))?;
        if !self.hint.is_empty() {
            write!(f, "\n  {}", Printable(&self.hint))?;
        }
        Ok(())
    }
}

impl std::error::Error for Failure {}
