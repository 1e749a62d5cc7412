//! Options of a subscriber: the domain, its directory, and how the subscriber waits.

use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use std::time::Duration;

use scanhub_schema::check_any_sensor;
use scanhub_shm::{DEFAULT_DOMAIN, Domain, Environment};

use crate::error::Error;
use crate::pollable::PollableSubscriber;
use crate::robot::Robot;
use crate::session::Session;
use crate::subscribe::{Subscribe, Subscriber, WithTimeout};
use crate::wait::Wait;

/// Options of a [`Subscriber<T>`](Subscriber).
///
/// # Examples
///
/// ```no_run
/// use std::time::Duration;
///
/// use scanhub_client::{Error, Scan, Subscriber, Wait};
///
/// fn main() -> Result<(), Error> {
///     let mut scans = Subscriber::<Scan>::builder("front")
///         .domain("lab")
///         .root("/run/lab")
///         .timeout(Duration::from_secs(1))
///         .wait(Wait::Spin)
///         .open()?;
///     println!("{:?}", scans.next()?.map(|scan| scan.beams()));
///     Ok(())
/// }
/// ```
#[derive(Clone, Debug)]
#[must_use = "a builder does nothing until it is opened"]
pub struct SubscriberBuilder<T: ?Sized> {
    sensors: Vec<String>,
    domain: Option<String>,
    root: Option<PathBuf>,
    wait: Wait,
    timeout: Option<Duration>,
    early: bool,
    kind: PhantomData<fn(&T)>,
}

impl<T: Subscribe + ?Sized> SubscriberBuilder<T> {
    pub(crate) fn new(sensors: Vec<String>) -> SubscriberBuilder<T> {
        SubscriberBuilder {
            sensors,
            domain: None,
            root: None,
            wait: Wait::default(),
            timeout: None,
            early: false,
            kind: PhantomData,
        }
    }

    /// Sets the name of the domain. Default: the domain that SCANHUB_DOMAIN names, otherwise `scanhub`.
    pub fn domain(self, name: impl Into<String>) -> Self {
        SubscriberBuilder { domain: Some(name.into()), ..self }
    }

    /// Sets the directory of the hub, like the hub's option `--root`. Default: all directories that a hub may have
    /// chosen are searched.
    pub fn root(self, directory: impl Into<PathBuf>) -> Self {
        SubscriberBuilder { root: Some(directory.into()), ..self }
    }

    /// Sets name and directory to those of `domain`.
    pub fn in_domain(self, domain: &Domain) -> Self {
        let root = domain.root().parent().unwrap_or(Path::new("/"));
        self.domain(domain.name()).root(root)
    }

    /// Sets how the subscriber waits. Default: [`Wait::Doorbell`].
    pub fn wait(self, wait: Wait) -> Self {
        SubscriberBuilder { wait, ..self }
    }

    /// Creates the subscriber. The hub may start later.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::InvalidInput`](crate::ErrorKind) if the name of a sensor or of the domain is invalid.
    pub fn open(self) -> Result<Subscriber<T>, Error> {
        Ok(Subscriber::new(self.session()?, T::source(&self), self.timeout))
    }

    /// Creates the subscriber with a descriptor for `poll`, `epoll` or an executor. The subscriber waits by event, even
    /// if [`wait`](Self::wait) sets another method.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`open`](Self::open), and [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if
    /// descriptors have run out.
    pub fn open_pollable(self) -> Result<PollableSubscriber<T>, Error> {
        let mut session = self.session()?;
        let descriptor = session.pollable()?;
        Ok(PollableSubscriber::new(descriptor, Subscriber::new(session, T::source(&self), self.timeout)))
    }

    /// Checks the names of the sensors, and returns the session.
    fn session(&self) -> Result<Session, Error> {
        self.sensors.iter().try_for_each(|sensor| check_any_sensor(sensor))?;
        let locations = domain_candidates(self.domain.as_deref(), self.root.as_deref())?;
        Ok(Session::new(locations).waiting_by(self.wait))
    }

    /// Returns the name of the first sensor. The builder of a subscriber for a single sensor has one name.
    pub(crate) fn sensor(&self) -> &str {
        self.sensors.first().map_or("", String::as_str)
    }

    /// Returns the names of the sensors.
    pub(crate) fn sensors(&self) -> Vec<&str> {
        self.sensors.iter().map(String::as_str).collect()
    }
}

impl<T: WithTimeout + ?Sized> SubscriberBuilder<T> {
    /// Lets [`Subscriber::next`] return `None` after a silence of `timeout`. Default: `next` waits forever.
    pub fn timeout(self, timeout: Duration) -> Self {
        SubscriberBuilder { timeout: Some(timeout), ..self }
    }
}

impl SubscriberBuilder<Robot> {
    /// Uses early warnings, too ([`Early`](crate::Early)). A warning makes the verdict worse before its scan is
    /// complete. The hub withdraws the warning if the complete scan does not confirm it.
    pub fn early(self) -> Self {
        SubscriberBuilder { early: true, ..self }
    }

    pub(crate) fn is_early(&self) -> bool {
        self.early
    }
}

/// Returns the locations where the hub of the domain `name` may run: below `root`, or in each directory that a hub may
/// have chosen. Without a name, the domain is the one that SCANHUB_DOMAIN names, otherwise `scanhub`.
///
/// # Errors
///
/// [`ErrorKind::InvalidInput`](crate::ErrorKind) if the name is invalid, or the path of the directory is too long.
pub fn domain_candidates(name: Option<&str>, root: Option<&Path>) -> Result<Vec<Domain>, Error> {
    let name = name.map_or_else(domain_of_process, str::to_owned);
    Ok(Domain::candidates(&name, root, &Environment::of_process())?)
}

/// Returns the name of the domain that SCANHUB_DOMAIN names, or the default.
pub(crate) fn domain_of_process() -> String {
    std::env::var("SCANHUB_DOMAIN").unwrap_or_else(|_| DEFAULT_DOMAIN.to_owned())
}
