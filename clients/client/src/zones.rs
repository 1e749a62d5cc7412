//! The zones of one sensor, by value, never older than they appear: a verdict that is too old becomes `unknown` here,
//! whether the sensor, the hub or the machine stopped. A program that acts on it needs no timeout of its own.

mod state;
mod warned;

use std::os::fd::BorrowedFd;
use std::time::Duration;

use scanhub_schema::{Early, Failure, Header, Zones, check_followed};
use scanhub_shm::Domain;

use crate::clock;
use crate::follower::Follower;
use crate::session::Session;
use crate::subscribe::places;
use crate::wait::Wait;
pub use state::ZonesState;
use warned::Warned;

/// Follows the zones of `sensor` in the domain that SCANHUB_DOMAIN names. The hub may start later.
///
/// # Examples
///
/// ```no_run
/// use scanhub_client::{Failure, Verdict, zones};
///
/// fn main() -> Result<(), Failure> {
///     let mut front = zones("front")?;
///     loop {
///         let heard = front.next()?;
///         // Nothing known is taken for a stop.
///         let may_go = matches!(heard.zones.verdict(), Verdict::Clear | Verdict::Slow);
///         println!("may go: {may_go}");
///     }
/// }
/// ```
///
/// # Errors
///
/// [`Kind::Configuration`](scanhub_schema::Kind) if a name is not possible.
pub fn zones(sensor: &str) -> Result<ZonesFollower, Failure> {
    ZonesFollower::in_domain(places(None)?, sensor)
}

/// New data of a sensor's zones, or the news that none arrives.
#[derive(Clone, Copy, Debug)]
pub struct Heard {
    /// The zones of the sample; [`Zones::unknown`] if it was too old on arrival, and in a silence.
    pub zones: Zones,
    /// The header of the sample; nothing in a silence.
    pub header: Option<Header>,
    /// Samples that were sent since the previous one and were skipped.
    pub missed: u64,
    /// The zones are unknown because no recent data arrived, not because the hub reports it.
    pub stale: bool,
    /// What the hub sent, however old it was on arrival: to store it, not to act on it.
    pub said: Zones,
}

impl Heard {
    /// A silence.
    pub(crate) fn nothing() -> Heard {
        Heard { zones: Zones::unknown(), header: None, missed: 0, stale: true, said: Zones::unknown() }
    }
}

/// The zones of a sensor that is being followed.
pub struct ZonesFollower {
    session: Session,
    source: ZonesSource,
}

impl ZonesFollower {
    /// Follows as [`zones`] does, in the first live one of `places`.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`](scanhub_schema::Kind) if the sensor's name is not possible.
    pub fn in_domain(places: Vec<Domain>, sensor: &str) -> Result<ZonesFollower, Failure> {
        check_followed(sensor)?;
        Ok(ZonesFollower { session: Session::new(places), source: ZonesSource::new(sensor) })
    }

    /// Waits by `wait`, as [`Subscription::wait_by`](crate::Subscription::wait_by).
    pub fn wait_by(self, wait: Wait) -> ZonesFollower {
        ZonesFollower { session: self.session.by(wait), ..self }
    }

    /// Waits for news: the newest sample, or one `unknown` per silence. That is returned two scan periods and 40 ms
    /// after the last sample (for another machine not before half a second), or a second after the start if there was
    /// none, with or without a hub.
    ///
    /// # Errors
    ///
    /// As [`Subscription::next`](crate::Subscription::next): nothing is known then either.
    #[allow(clippy::should_implement_trait)] // There is no end that an iterator would have.
    pub fn next(&mut self) -> Result<Heard, Failure> {
        loop {
            if let Some(heard) = self.try_next()? {
                return Ok(heard);
            }
            self.wait(Duration::MAX)?;
        }
    }

    /// Sleeps as [`Subscription::wait`](crate::Subscription::wait) does, or until the verdict becomes too old.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if the system cannot wait.
    pub fn wait(&mut self, longest: Duration) -> Result<(), Failure> {
        self.session.wait_for(Some(self.source.left().map_or(longest, |left| left.min(longest))))
    }

    /// Returns a descriptor to poll, as [`Subscription::descriptor`](crate::Subscription::descriptor), with
    /// [`try_next`](Self::try_next) of the zones; it gets readable also when the verdict becomes too old.
    ///
    /// # Errors
    ///
    /// As [`Subscription::descriptor`](crate::Subscription::descriptor).
    pub fn descriptor(&mut self) -> Result<BorrowedFd<'_>, Failure> {
        self.session.descriptor()
    }

    /// Returns whether a hub lives in the domain, as of the last call of [`next`](Self::next) or
    /// [`try_next`](Self::try_next) that found no news.
    pub fn hub_lives(&self) -> bool {
        self.session.domain().is_some()
    }

    /// Returns the news, if there are any since the last call; never waits.
    ///
    /// # Errors
    ///
    /// As [`next`](Self::next).
    pub fn try_next(&mut self) -> Result<Option<Heard>, Failure> {
        loop {
            if let Some(heard) = self.look()? {
                return Ok(Some(heard));
            }
            if !self.session.settle(self.source.left())? {
                return Ok(None);
            }
        }
    }

    fn look(&mut self) -> Result<Option<Heard>, Failure> {
        // What is there comes before the question whether the hub still is: that takes longer than receiving.
        if self.source.subscribed()
            && let Some(heard) = self.source.newest(&mut self.session)?
        {
            return Ok(Some(heard));
        }
        self.session.look()?;
        self.source.newest(&mut self.session)
    }
}

/// The zones of a sensor, sample by sample and silence by silence, in the caller's session.
pub struct ZonesSource {
    follower: Follower<Zones>,
    state: ZonesState,
    /// Early warnings, if they are wanted.
    early: Option<Box<(Follower<Early>, Warned)>>,
}

impl ZonesSource {
    /// Makes what will follow the zones of `sensor`.
    pub fn new(sensor: &str) -> ZonesSource {
        ZonesSource { follower: Follower::new(sensor), state: ZonesState::new(clock::now()), early: None }
    }

    /// Takes early warnings of `sensor` too: one makes the verdict worse until the zones of its scan are there, or until it is
    /// withdrawn.
    pub(crate) fn with_early(self, sensor: &str) -> ZonesSource {
        ZonesSource { early: Some(Box::new((Follower::new(sensor), Warned::new()))), ..self }
    }

    /// Returns whether the topic has been there at least once.
    pub fn subscribed(&self) -> bool {
        self.follower.subscribed()
    }

    /// Returns whether there was a sample, or the silence of one that does not come.
    pub fn has_spoken(&self) -> bool {
        self.state.has_spoken()
    }

    /// Returns the next sample that waits; if there is none and the last one became too old just now, that.
    ///
    /// # Errors
    ///
    /// As [`Follower::receive`].
    pub fn receive(&mut self, session: &mut Session) -> Result<Option<Heard>, Failure> {
        let sample = self.follower.receive(session)?;
        let now = clock::now();
        let heard = match sample {
            Some(sample) => Some(self.state.take(sample.header(), &sample, sample.missed, now)),
            None => self.state.silence(now),
        };
        let Some((follower, warned)) = self.early.as_deref_mut() else { return Ok(heard) };
        if let Some(mut heard) = heard {
            heard.zones = warned.hear(&heard.zones, heard.header.as_ref());
            return Ok(Some(heard));
        }
        while let Some(early) = follower.receive(session)? {
            let header = *early.header();
            if let Some(zones) = warned.warn(&early, &header) {
                return Ok(Some(Heard { zones, header: Some(header), missed: 0, stale: false, said: zones }));
            }
        }
        Ok(None)
    }

    /// The last of all waiting samples. The skipped ones count as missed.
    fn newest(&mut self, session: &mut Session) -> Result<Option<Heard>, Failure> {
        let mut newest: Option<Heard> = None;
        while let Some(mut heard) = self.receive(session)? {
            heard.missed += newest.map_or(0, |passed| passed.missed + u64::from(passed.header.is_some()));
            newest = Some(heard);
        }
        Ok(newest)
    }

    /// Returns after which time [`receive`](Self::receive) has something to say even if no sample comes.
    pub fn left(&self) -> Option<Duration> {
        self.state.left(clock::now())
    }
}
