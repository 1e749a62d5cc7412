//! Subscribes to one topic of one sensor, without copies. Waits for a hub that does not run yet, and continues when
//! the hub is restarted.

use std::time::{Duration, Instant};

use scanhub_shm::Payload;

use crate::builder::SubscriberBuilder;
use crate::error::Error;
use crate::follower::{Follower, Received};
use crate::session::Session;
use crate::silence::{Silence, SilenceCheck};

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

/// Subscriber of one topic of one sensor.
pub struct Subscriber<P: Payload + ?Sized> {
    session: Session,
    follower: Follower<P>,
    timeout: Option<Duration>,
    silence: SilenceCheck,
}

impl<P: Payload + ?Sized> Subscriber<P> {
    /// Returns the options of a subscriber of `sensor`.
    pub fn builder(sensor: &str) -> SubscriberBuilder<Subscriber<P>> {
        SubscriberBuilder::new(&[sensor])
    }

    pub(crate) fn new(session: Session, sensor: &str, timeout: Option<Duration>) -> Subscriber<P> {
        Subscriber { session, follower: Follower::new(sensor), timeout, silence: SilenceCheck::default() }
    }

    /// Waits for the next sample; `None` only after the timeout. Up to four samples may be held while others are
    /// received.
    ///
    /// # Errors
    ///
    /// [`Error::TooManyHeld`] if the program holds four samples and another one has arrived.
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if memory, descriptors or places for subscribers have run
    /// out. [`ErrorKind::Incompatible`](crate::ErrorKind) if the topic has another layout.
    #[allow(clippy::should_implement_trait)] // `iter` returns an iterator.
    pub fn next(&mut self) -> Result<Option<Received<P>>, Error> {
        // A timeout beyond all time is none.
        let until = self.timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        loop {
            if let Some(received) = self.try_next()? {
                return Ok(Some(received));
            }
            if until.is_some_and(|until| Instant::now() >= until) {
                return Ok(None);
            }
            self.session.wait(until)?;
        }
    }

    /// Returns an iterator over the samples, which waits for each of them. It ends after a silence of the timeout; a
    /// later call continues.
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
    pub fn iter(&mut self) -> Iter<'_, P> {
        Iter(self)
    }

    /// Returns the next sample if one has arrived. It never waits.
    ///
    /// # Errors
    ///
    /// As [`next`](Self::next).
    pub fn try_next(&mut self) -> Result<Option<Received<P>>, Error> {
        loop {
            if let Some(received) = self.look()? {
                return Ok(Some(received));
            }
            if !self.session.settle(None)? {
                return Ok(None);
            }
        }
    }

    /// Sleeps until there may be a sample, but at most for `longest` and a tenth of a second, so that the caller can
    /// stop.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if the system cannot wait.
    pub fn wait(&mut self, longest: Duration) -> Result<(), Error> {
        self.session.wait_for(Some(longest))
    }

    /// Returns whether a hub runs in the domain, as of the last call of [`next`](Self::next) or
    /// [`try_next`](Self::try_next) that found no sample.
    pub fn hub_is_running(&self) -> bool {
        self.session.domain().is_some()
    }

    /// Returns the time since the last sample; if there was none, since the subscriber was opened. Time during which
    /// the machine was suspended counts (CLOCK_BOOTTIME).
    pub fn silent_for(&self) -> Duration {
        self.session.silent_for()
    }

    /// Returns why no sample arrives. It never waits, and is cheap enough for once a second. The first call after a
    /// sample can return [`Silence::Waiting`], because it has just subscribed to the status of the sensor.
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
        self.follower.why_silent(&mut self.session, &mut self.silence)
    }

    fn look(&mut self) -> Result<Option<Received<P>>, Error> {
        let received = self.receive()?;
        if received.is_some() {
            self.silence.end();
        }
        Ok(received)
    }

    fn receive(&mut self) -> Result<Option<Received<P>>, Error> {
        // Samples that have arrived come first, because the look for the hub takes longer than receiving.
        if self.follower.subscribed()
            && let Some(received) = self.follower.receive(&mut self.session)?
        {
            return Ok(Some(received));
        }
        self.session.look()?;
        self.follower.receive(&mut self.session)
    }
}

impl<'a, P: Payload + ?Sized> IntoIterator for &'a mut Subscriber<P> {
    type Item = Result<Received<P>, Error>;
    type IntoIter = Iter<'a, P>;

    fn into_iter(self) -> Iter<'a, P> {
        self.iter()
    }
}

/// Samples of a [`Subscriber`]. Up to four may be held; with four held, the iterator returns [`Error::TooManyHeld`] in
/// place of the next sample, which stays in the queue.
pub struct Iter<'a, P: Payload + ?Sized>(&'a mut Subscriber<P>);

impl<P: Payload + ?Sized> Iterator for Iter<'_, P> {
    type Item = Result<Received<P>, Error>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.next().transpose()
    }
}
