//! One topic of one sensor, without copies, for as long as you like. Waits for a hub that does not run yet and continues
//! after one that was killed. Hides what wakes it.

use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

use scanhub_schema::check_followed;
use scanhub_shm::Payload;
use scanhub_shm::{DEFAULT_DOMAIN, Domain, Environment};

use crate::error::Error;
use crate::follower::{Follower, Received};
use crate::session::Session;
use crate::wait::Wait;

/// Follows the topic of `sensor` that carries `P` (`[u8]`: telegram, `Scan`, `Marks` ..), in the domain that
/// SCANHUB_DOMAIN names. The hub may start later. To act on zones, follow them with [`zones`](crate::zones).
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
/// [`ErrorKind::InvalidInput`](crate::ErrorKind) if a name is not possible.
pub fn subscribe<P: Payload + ?Sized>(sensor: &str) -> Result<Subscription<P>, Error> {
    Subscription::in_domain(places(None)?, sensor)
}

/// Returns where `domain` may be, or if none is named that which SCANHUB_DOMAIN names.
///
/// # Errors
///
/// [`ErrorKind::InvalidInput`](crate::ErrorKind) if the name is not possible.
pub fn places(domain: Option<&str>) -> Result<Vec<Domain>, Error> {
    let environment = Environment::of_process();
    match domain {
        Some(domain) => Ok(Domain::candidates(domain, None, &environment)?),
        None => {
            let domain = std::env::var("SCANHUB_DOMAIN").unwrap_or_else(|_| DEFAULT_DOMAIN.to_owned());
            Ok(Domain::candidates(&domain, None, &environment)?)
        }
    }
}

/// A topic that is being followed.
pub struct Subscription<P: Payload + ?Sized> {
    session: Session,
    follower: Follower<P>,
    timeout: Option<Duration>,
}

impl<P: Payload + ?Sized> Subscription<P> {
    /// Follows as [`subscribe`] does, in the first live one of `places`.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::InvalidInput`](crate::ErrorKind) if the sensor's name is not possible.
    pub fn in_domain(places: Vec<Domain>, sensor: &str) -> Result<Self, Error> {
        check_followed(sensor)?;
        Ok(Subscription { session: Session::new(places), follower: Follower::new(sensor), timeout: None })
    }

    /// Lets [`next`](Self::next) return `None` after a silence of `timeout`; without it, waits forever.
    pub fn timeout(mut self, timeout: Duration) -> Self {
        self.timeout = Some(timeout);
        self
    }

    /// Sets how it waits; call it before the first sample is requested. Default: [`Wait::Doorbell`].
    pub fn wait_by(self, wait: Wait) -> Self {
        Subscription { session: self.session.by(wait), ..self }
    }

    /// Waits for the next sample; `None` only after the timeout. Drop the sample before the next call.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if descriptors or places are short, [`ErrorKind::Failed`](crate::ErrorKind) if the domain
    /// is another user's or the topic has another layout.
    #[allow(clippy::should_implement_trait)] // An iterator would have to hold samples over waits.
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

    /// Returns the next sample if one waits; never waits itself.
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

    /// Sleeps until there may be a sample, but at most for `longest` and a tenth of a second, so that the caller can stop.
    /// Hold no sample meanwhile.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if the system cannot wait.
    pub fn wait(&mut self, longest: Duration) -> Result<(), Error> {
        self.session.wait_for(Some(longest))
    }

    /// Returns a descriptor to poll, never to read. It can be readable although no sample has arrived: every second, ten
    /// times a second while there is no hub, and when another topic of the sensor has a sample. It stays the same for as
    /// long as the subscription exists, even if the hub restarts. While it is readable, `poll` returns at once, until
    /// [`try_next`](Self::try_next) returns `None`.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::InvalidInput`](crate::ErrorKind) without [`Wait::Event`], [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if descriptors are.
    pub fn descriptor(&mut self) -> Result<BorrowedFd<'_>, Error> {
        self.session.descriptor()
    }

    fn look(&mut self) -> Result<Option<Received<P>>, Error> {
        // What is there comes before the question whether the hub still is: that takes longer than receiving.
        if self.follower.subscribed()
            && let Some(received) = self.follower.receive(&mut self.session)?
        {
            return Ok(Some(received));
        }
        self.session.look()?;
        self.follower.receive(&mut self.session)
    }

    /// Returns whether a hub lives in the domain, as of the last call of [`next`](Self::next) or [`try_next`](Self::try_next) that
    /// found no sample waiting.
    pub fn hub_lives(&self) -> bool {
        self.session.domain().is_some()
    }
}
