//! Subscribers of any kind, and the subscriber of a topic. The subscriber of a topic makes no copies, waits for a hub
//! that does not run yet, and continues when the hub is restarted.

use std::time::{Duration, Instant};

use scanhub_shm::Payload;

use crate::builder::SubscriberBuilder;
use crate::error::Error;
use crate::session::Session;
use crate::silence::Silence;
use crate::topic_reader::{Received, TopicReader};

/// Subscribes to the topic of `sensor` that carries `P` ([`Telegram`](crate::Telegram), [`Scan`](crate::Scan),
/// [`Marks`](crate::Marks) ..), in the domain that SCANHUB_DOMAIN names. The hub may start later. To act on zones, use
/// [`zones`](crate::zones). [`Subscriber::builder`] has options.
///
/// # Examples
///
/// ```no_run
/// use scanhub_client::{Error, Scan, subscribe};
///
/// fn main() -> Result<(), Error> {
///     let mut scans = subscribe::<Scan>("front")?;
///     while let Some(scan) = scans.next()? {
///         println!("{} beams, beam 0 at {} degrees: {:?} mm", scan.beams(), scan.angle_deg(0), scan.distance_mm(0));
///     }
///     Ok(())
/// }
/// ```
///
/// # Errors
///
/// [`ErrorKind::InvalidInput`](crate::ErrorKind) if a name is invalid.
pub fn subscribe<P: Payload + ?Sized>(sensor: &str) -> Result<Subscriber<P>, Error> {
    Subscriber::builder(sensor).open()
}

/// Subscriber of one topic of one sensor, such as `Subscriber<Scan>`. [`JoinedSubscriber`](crate::JoinedSubscriber),
/// [`ZonesSubscriber`](crate::ZonesSubscriber) and [`RobotSubscriber`](crate::RobotSubscriber) are subscribers, too.
pub struct Subscriber<T: Subscribe + ?Sized> {
    pub(crate) session: Session,
    pub(crate) source: T::Source,
    timeout: Option<Duration>,
}

/// Kind of a [`Subscriber`]: a payload such as [`Scan`](crate::Scan), [`Joined`](crate::Joined),
/// [`ZonesUpdate`](crate::ZonesUpdate) or [`Robot`](crate::Robot). Other crates cannot implement this trait.
pub trait Subscribe: sealed::Sealed {
    /// Names of the sensors: `&str`, or `&[&str]` for a robot.
    type Sensors<'a>: SensorNames;
    /// Item that the subscriber returns.
    type Item;
    /// Part that receives the items.
    #[doc(hidden)]
    type Source: ItemSource<Item = Self::Item>;

    /// Creates the source of a subscriber with these options.
    #[doc(hidden)]
    fn source(options: &SubscriberBuilder<Self>) -> Self::Source;
}

/// Kind of a [`Subscriber`] whose `next` can end after a timeout. Zones and robots report `unknown` instead of a
/// timeout.
pub trait WithTimeout: Subscribe {}

/// Names of one or several sensors.
pub trait SensorNames {
    /// Returns the names.
    fn names(self) -> Vec<String>;
}

impl SensorNames for &str {
    fn names(self) -> Vec<String> {
        vec![self.to_owned()]
    }
}

impl SensorNames for &[&str] {
    fn names(self) -> Vec<String> {
        self.iter().map(|&sensor| sensor.to_owned()).collect()
    }
}

/// Source of items in the session of its subscriber. The source never waits.
pub trait ItemSource {
    /// Received item.
    type Item;

    /// Returns whether an item can arrive without a check for the hub.
    fn subscribed(&self) -> bool;

    /// Returns the next item that has arrived.
    fn receive(&mut self, session: &mut Session) -> Result<Option<Self::Item>, Error>;

    /// Checks for the hub if necessary, and returns the next item that has arrived.
    fn check_and_receive(&mut self, session: &mut Session) -> Result<Option<Self::Item>, Error> {
        // Receive samples before the check for the hub, because the check takes longer.
        if self.subscribed()
            && let Some(item) = self.receive(session)?
        {
            return Ok(Some(item));
        }
        session.check_hub()?;
        self.receive(session)
    }

    /// Returns the time after which the source has an item even if no sample arrives. `None` if the source has items
    /// only when samples arrive.
    fn time_left(&self) -> Option<Duration> {
        None
    }

    /// Returns why no item arrives.
    fn why_silent(&mut self, session: &mut Session) -> Silence;
}

/// Seal of [`Subscribe`].
pub(crate) mod sealed {
    pub trait Sealed {}
}

impl<T: Subscribe + ?Sized> Subscriber<T> {
    /// Returns the options of a subscriber of a sensor, for example `"front"`, or of a robot's sensors, for example
    /// `&["front", "rear"]`. A robot without names subscribes to all sensors.
    pub fn builder(sensors: T::Sensors<'_>) -> SubscriberBuilder<T> {
        SubscriberBuilder::new(sensors.names())
    }

    pub(crate) fn new(session: Session, source: T::Source, timeout: Option<Duration>) -> Subscriber<T> {
        Subscriber { session, source, timeout }
    }

    /// Returns the next item if one has arrived. Never waits.
    ///
    /// # Errors
    ///
    /// Returns the errors of `next`.
    pub fn try_next(&mut self) -> Result<Option<T::Item>, Error> {
        loop {
            if let Some(item) = self.source.check_and_receive(&mut self.session)? {
                return Ok(Some(item));
            }
            if !self.session.rearm_descriptor(self.source.time_left())? {
                return Ok(None);
            }
        }
    }

    /// Returns an iterator that waits for each item. The iterator ends after a silence that is as long as the timeout.
    /// The next call of `iter` continues.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use std::collections::VecDeque;
    ///
    /// use scanhub_client::{Error, Received, Scan, subscribe};
    ///
    /// fn main() -> Result<(), Error> {
    ///     let mut last: VecDeque<Received<Scan>> = VecDeque::new();
    ///     for scan in subscribe::<Scan>("front")?.iter() {
    ///         // The last three scans, in the hub's memory.
    ///         last.push_back(scan?);
    ///         if last.len() > 3 {
    ///             last.pop_front();
    ///         }
    ///     }
    ///     Ok(())
    /// }
    /// ```
    pub fn iter(&mut self) -> Iter<'_, T> {
        Iter(self)
    }

    /// Sleeps until an item may have arrived, but for at most `longest` and at most a tenth of a second, so that the
    /// caller can stop.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if the system cannot wait.
    pub fn wait(&mut self, longest: Duration) -> Result<(), Error> {
        self.session.wait_for(Some(self.source.time_left().map_or(longest, |left| left.min(longest))))
    }

    /// Returns whether a hub or a listener publishes in the domain, as of the last call that found no item.
    pub fn hub_is_running(&self) -> bool {
        self.session.domain().is_some()
    }

    /// Returns the time since the last sample; if there was none, since the subscriber was opened. Time during which
    /// the machine was suspended counts (CLOCK_BOOTTIME).
    pub fn silent_for(&self) -> Duration {
        self.session.silent_for()
    }

    /// Returns why no sample arrives. This method never waits, and is cheap enough to be called once a second. The
    /// first call after a sample can return [`Silence::Waiting`], because the method has just subscribed to the status
    /// of the sensor. For a robot, returns the reason of the first sensor with an unknown verdict and a known reason.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use std::time::Duration;
    ///
    /// use scanhub_client::{Error, Scan, Subscriber};
    ///
    /// fn main() -> Result<(), Error> {
    ///     let mut scans = Subscriber::<Scan>::builder("front").timeout(Duration::from_secs(1)).open()?;
    ///     loop {
    ///         match scans.next()? {
    ///             Some(scan) => println!("{} beams", scan.beams()),
    ///             None => {
    ///                 let reason = scans.why_silent();
    ///                 println!("{reason}; {}", reason.remedy());
    ///             }
    ///         }
    ///     }
    /// }
    /// ```
    pub fn why_silent(&mut self) -> Silence {
        self.source.why_silent(&mut self.session)
    }

    /// Waits for the next item. Returns `None` only after the timeout.
    pub(crate) fn next_until_timeout(&mut self) -> Result<Option<T::Item>, Error> {
        // A timeout that is too long for the clock never expires.
        let until = self.timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        loop {
            if let Some(item) = self.try_next()? {
                return Ok(Some(item));
            }
            let left = until.map_or(Duration::MAX, |until| until.saturating_duration_since(Instant::now()));
            if left.is_zero() {
                return Ok(None);
            }
            self.wait(left)?;
        }
    }

    /// Waits for the next item of a subscriber without a timeout.
    pub(crate) fn wait_for_next(&mut self) -> Result<T::Item, Error> {
        loop {
            if let Some(item) = self.next_until_timeout()? {
                return Ok(item);
            }
        }
    }
}

impl<'a, T: Subscribe + ?Sized> IntoIterator for &'a mut Subscriber<T> {
    type Item = Result<T::Item, Error>;
    type IntoIter = Iter<'a, T>;

    fn into_iter(self) -> Iter<'a, T> {
        self.iter()
    }
}

/// Items of a [`Subscriber`]. A program may hold up to four samples. While it holds four, the iterator returns
/// [`Error::TooManyHeld`] in place of the next sample, which stays in the queue.
pub struct Iter<'a, T: Subscribe + ?Sized>(&'a mut Subscriber<T>);

impl<T: Subscribe + ?Sized> Iterator for Iter<'_, T> {
    type Item = Result<T::Item, Error>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.next_until_timeout().transpose()
    }
}

impl<T: WithTimeout + ?Sized> Subscriber<T> {
    /// Waits for the next sample or pair; `None` only after the timeout. Up to four samples, or three pairs, may be
    /// held while others are received.
    ///
    /// # Errors
    ///
    /// [`Error::TooManyHeld`] if the program holds four samples and another one has arrived.
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if memory, descriptors or slots for subscribers have run out.
    /// [`ErrorKind::Incompatible`](crate::ErrorKind) if the topic has another layout.
    #[allow(clippy::should_implement_trait)] // `iter` returns an iterator.
    pub fn next(&mut self) -> Result<Option<T::Item>, Error> {
        self.next_until_timeout()
    }
}

impl<P: Payload + ?Sized> sealed::Sealed for P {}

impl<P: Payload + ?Sized> WithTimeout for P {}

impl<P: Payload + ?Sized> Subscribe for P {
    type Sensors<'a> = &'a str;
    type Item = Received<P>;
    type Source = TopicReader<P>;

    fn source(options: &SubscriberBuilder<P>) -> TopicReader<P> {
        TopicReader::new(options.sensor())
    }
}

impl<P: Payload + ?Sized> ItemSource for TopicReader<P> {
    type Item = Received<P>;

    fn subscribed(&self) -> bool {
        self.subscribed()
    }

    fn receive(&mut self, session: &mut Session) -> Result<Option<Received<P>>, Error> {
        self.receive(session)
    }

    fn why_silent(&mut self, session: &mut Session) -> Silence {
        self.why_silent(session)
    }
}
