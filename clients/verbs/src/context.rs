//! Parts of the process that a verb uses: the output, the selected domain, and signals.

use std::fs::File;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use scanhub_schema::Failure;
use scanhub_shm::{Domain, Environment};

/// Parts of the process that a verb uses. The program creates one context for the verb that it runs.
pub struct Context {
    /// Whether to print one JSON object per line.
    pub json: bool,
    /// Domain that the user selected.
    pub domain: DomainOptions,
    /// Standard output. It is not buffered, so each write is one line or one raw sample.
    pub out: File,
    /// Whether `out` is a terminal, where a line may be redrawn.
    pub is_terminal: bool,
    /// Standard error, for notices that are not part of the output.
    pub notes: File,
    /// Signals of the process.
    pub signals: Box<dyn Signals>,
}

impl Context {
    /// Creates the context of a process that has these files as standard output and standard error.
    pub fn new(
        json: bool,
        domain: DomainOptions,
        (out, notes): (File, File),
        signals: Box<dyn Signals>,
    ) -> Context {
        let is_terminal = out.is_terminal();
        Context { json, domain, out, is_terminal, notes, signals }
    }
}

/// Options that name a domain.
#[derive(Clone, Debug)]
pub struct DomainOptions {
    /// Name of the domain.
    pub name: String,
    /// Directory of the hub, if it is not in one of the usual locations.
    pub root: Option<PathBuf>,
}

impl DomainOptions {
    /// Returns the locations in which a client searches for the domain.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`](scanhub_schema::Kind) if the name is not valid.
    pub fn locations(&self) -> Result<Vec<Domain>, Failure> {
        Domain::candidates(&self.name, self.root.as_deref(), &Environment::of_process())
    }

    /// Returns the domain in which a hub publishes.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`locations`](Self::locations).
    pub fn of_hub(&self) -> Result<Domain, Failure> {
        Domain::of_hub(&self.name, self.root.as_deref(), &Environment::of_process())
    }

    /// Returns the domain in which a program publishes: the domain of a running hub or listener, or otherwise the
    /// domain in which a new hub would publish.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`locations`](Self::locations).
    pub fn of_publisher(&self) -> Result<Domain, Failure> {
        scanhub_shm::publisher_domain(&self.name, self.root.as_deref(), &Environment::of_process())
    }
}

/// Signals that a verb handles. Each function installs a handler that sets the returned flag. The signals then no
/// longer end the process. A function returns an error if a handler cannot be installed.
pub trait Signals {
    /// Returns a flag for SIGINT and SIGTERM.
    fn stop(&self) -> Result<Arc<AtomicBool>, Failure>;
    /// Returns a flag for all signals that request a process to end, including the signal that a closed terminal sends.
    /// Used by verbs that must always restore a terminal or finish a file.
    fn any_stop(&self) -> Result<Arc<AtomicBool>, Failure>;
    /// Returns a flag for SIGUSR1, which requests a report.
    fn report(&self) -> Result<Arc<AtomicBool>, Failure>;
}

/// One flag for all signals that end a process, for a program that runs a verb in a thread. It never requests a
/// report.
impl Signals for Arc<AtomicBool> {
    fn stop(&self) -> Result<Arc<AtomicBool>, Failure> {
        Ok(self.clone())
    }

    fn any_stop(&self) -> Result<Arc<AtomicBool>, Failure> {
        Ok(self.clone())
    }

    fn report(&self) -> Result<Arc<AtomicBool>, Failure> {
        Ok(Arc::default())
    }
}
