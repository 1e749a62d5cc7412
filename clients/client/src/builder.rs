//! Options of a subscriber: the domain, its directory, and how the subscriber waits.

use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use std::time::Duration;

use scanhub_schema::check_followed;
use scanhub_shm::{DEFAULT_DOMAIN, Domain, Environment, Payload};

use crate::error::Error;
use crate::joined::JoinedSubscriber;
use crate::pollable::{Pollable, PollableSubscriber};
use crate::robot::{RobotSource, RobotSubscriber};
use crate::session::Session;
use crate::subscribe::Subscriber;
use crate::wait::Wait;
use crate::zones::ZonesSubscriber;

/// Options of a subscriber of type `T`: a [`Subscriber`], [`JoinedSubscriber`], [`ZonesSubscriber`] or
/// [`RobotSubscriber`].
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
pub struct SubscriberBuilder<T> {
    sensors: Vec<String>,
    domain: Option<String>,
    root: Option<PathBuf>,
    wait: Wait,
    timeout: Option<Duration>,
    early: bool,
    subscriber: PhantomData<fn() -> T>,
}

impl<T> SubscriberBuilder<T> {
    pub(crate) fn new(sensors: &[&str]) -> SubscriberBuilder<T> {
        SubscriberBuilder {
            sensors: sensors.iter().map(|&sensor| sensor.to_owned()).collect(),
            domain: None,
            root: None,
            wait: Wait::default(),
            timeout: None,
            early: false,
            subscriber: PhantomData,
        }
    }

    /// Sets the name of the domain. Default: the one that SCANHUB_DOMAIN names, otherwise `scanhub`.
    pub fn domain(self, name: impl Into<String>) -> Self {
        SubscriberBuilder { domain: Some(name.into()), ..self }
    }

    /// Sets the directory of the hub, as its option `--root`. Default: each directory that a hub may have chosen.
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

    /// Checks the names of the sensors, and returns the session.
    fn session(&self) -> Result<Session, Error> {
        self.sensors.iter().try_for_each(|sensor| check_followed(sensor))?;
        let from_environment;
        let name = match &self.domain {
            Some(name) => name,
            None => {
                from_environment = domain_of_process();
                &from_environment
            }
        };
        let places = Domain::candidates(name, self.root.as_deref(), &Environment::of_process())?;
        Ok(Session::new(places).by(self.wait))
    }

    /// Returns the first sensor; the builder of a single sensor has one.
    fn sensor(&self) -> &str {
        self.sensors.first().map_or("", String::as_str)
    }
}

impl<P: Payload + ?Sized> SubscriberBuilder<Subscriber<P>> {
    /// Lets [`Subscriber::next`] return `None` after a silence of `timeout`. Default: it waits forever.
    pub fn timeout(self, timeout: Duration) -> Self {
        SubscriberBuilder { timeout: Some(timeout), ..self }
    }

    /// Creates the subscriber. The hub may start later.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::InvalidInput`](crate::ErrorKind) if the name of the sensor or of the domain is invalid.
    pub fn open(self) -> Result<Subscriber<P>, Error> {
        Ok(Subscriber::new(self.session()?, self.sensor(), self.timeout))
    }

    /// Creates the subscriber with a descriptor for `poll`, `epoll` or an executor. It waits by event, whatever
    /// [`wait`](Self::wait) says.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`open`](Self::open), and [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if
    /// descriptors have run out.
    pub fn open_pollable(self) -> Result<PollableSubscriber<P>, Error> {
        let mut session = self.session()?;
        let descriptor = session.pollable()?;
        Ok(Pollable::new(descriptor, Subscriber::new(session, self.sensor(), self.timeout)))
    }
}

impl<A: Payload + ?Sized, B: Payload + ?Sized> SubscriberBuilder<JoinedSubscriber<A, B>> {
    /// Lets [`JoinedSubscriber::next`] return `None` after a silence of `timeout`. Default: it waits forever.
    pub fn timeout(self, timeout: Duration) -> Self {
        SubscriberBuilder { timeout: Some(timeout), ..self }
    }

    /// Creates the subscriber. The hub may start later.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::InvalidInput`](crate::ErrorKind) if the name of the sensor or of the domain is invalid.
    pub fn open(self) -> Result<JoinedSubscriber<A, B>, Error> {
        Ok(JoinedSubscriber::new(self.session()?, self.sensor(), self.timeout))
    }

    /// Creates the subscriber with a descriptor for `poll`, `epoll` or an executor. It waits by event, whatever
    /// [`wait`](Self::wait) says.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`open`](Self::open), and [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if
    /// descriptors have run out.
    pub fn open_pollable(self) -> Result<Pollable<JoinedSubscriber<A, B>>, Error> {
        let mut session = self.session()?;
        let descriptor = session.pollable()?;
        Ok(Pollable::new(descriptor, JoinedSubscriber::new(session, self.sensor(), self.timeout)))
    }
}

impl SubscriberBuilder<ZonesSubscriber> {
    /// Creates the subscriber. The hub may start later.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::InvalidInput`](crate::ErrorKind) if the name of the sensor or of the domain is invalid.
    pub fn open(self) -> Result<ZonesSubscriber, Error> {
        Ok(ZonesSubscriber::new(self.session()?, self.sensor()))
    }

    /// Creates the subscriber with a descriptor for `poll`, `epoll` or an executor. It waits by event, whatever
    /// [`wait`](Self::wait) says.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`open`](Self::open), and [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if
    /// descriptors have run out.
    pub fn open_pollable(self) -> Result<Pollable<ZonesSubscriber>, Error> {
        let mut session = self.session()?;
        let descriptor = session.pollable()?;
        Ok(Pollable::new(descriptor, ZonesSubscriber::new(session, self.sensor())))
    }
}

impl SubscriberBuilder<RobotSubscriber> {
    /// Takes early warnings too ([`Early`](crate::Early)): the verdict becomes worse before a scan is complete, and the
    /// hub withdraws the warning if the scan does not confirm it.
    pub fn early(self) -> Self {
        SubscriberBuilder { early: true, ..self }
    }

    /// Creates the subscriber. The hub may start later.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::InvalidInput`](crate::ErrorKind) if the name of a sensor or of the domain is invalid.
    pub fn open(self) -> Result<RobotSubscriber, Error> {
        Ok(RobotSubscriber::new(self.session()?, self.robot()))
    }

    /// Creates the subscriber with a descriptor for `poll`, `epoll` or an executor. It waits by event, whatever
    /// [`wait`](Self::wait) says.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`open`](Self::open), and [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if
    /// descriptors have run out.
    pub fn open_pollable(self) -> Result<Pollable<RobotSubscriber>, Error> {
        let mut session = self.session()?;
        let descriptor = session.pollable()?;
        Ok(Pollable::new(descriptor, RobotSubscriber::new(session, self.robot())))
    }

    fn robot(&self) -> RobotSource {
        let sensors: Vec<&str> = self.sensors.iter().map(String::as_str).collect();
        let source = RobotSource::new(&sensors);
        if self.early { source.with_early() } else { source }
    }
}

/// Returns the name of the domain that SCANHUB_DOMAIN names, or the default.
pub(crate) fn domain_of_process() -> String {
    std::env::var("SCANHUB_DOMAIN").unwrap_or_else(|_| DEFAULT_DOMAIN.to_owned())
}
