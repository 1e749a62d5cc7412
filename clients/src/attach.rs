//! The attach library: one topic of one sensor, in place, for as long as you like. Waits for a hub that is not there
//! yet and goes on after one that was killed. Hides what it is woken by.

use std::time::{Duration, Instant};

use schema::ipc::Payload;
use schema::{DEFAULT_DOMAIN, Domain, Environment, Failure, check_followed};

use crate::follower::{Follower, Received};
use crate::session::Session;
use crate::wait::Wait;

/// Follows the topic of `sensor` that carries `P` (`[u8]`: telegram, `Scan`, `Marks` ..), in the domain that
/// SCANHUB_DOMAIN names. There need not be a hub yet. Who acts on zones follows them by [`zones`](crate::zones).
///
/// [`Kind::Configuration`](schema::Kind) if a name is not possible.
pub fn attach<P: Payload + ?Sized>(sensor: &str) -> Result<Attachment<P>, Failure> {
    Attachment::in_domain(places()?, sensor)
}

/// Where the domain that SCANHUB_DOMAIN names may be.
pub(crate) fn places() -> Result<Vec<Domain>, Failure> {
    let name = std::env::var("SCANHUB_DOMAIN").unwrap_or_else(|_| DEFAULT_DOMAIN.to_owned());
    Domain::candidates(&name, None, &Environment::of_process())
}

/// A topic that is being followed.
pub struct Attachment<P: Payload + ?Sized> {
    session: Session,
    follower: Follower<P>,
    timeout: Option<Duration>,
}

impl<P: Payload + ?Sized> Attachment<P> {
    /// As [`attach`], in the first live one of `places`.
    ///
    /// [`Kind::Configuration`](schema::Kind) if the sensor's name is not possible.
    pub fn in_domain(places: Vec<Domain>, sensor: &str) -> Result<Self, Failure> {
        check_followed(sensor)?;
        Ok(Attachment { session: Session::new(places), follower: Follower::new(sensor), timeout: None })
    }

    /// Lets [`next`](Self::next) answer `None` after a silence of `timeout`; without it waits forever.
    pub fn timeout(mut self, timeout: Duration) -> Self {
        self.timeout = Some(timeout);
        self
    }

    /// Waits by `wait`, to be said before the first sample is asked for; without it by [`Wait::Doorbell`].
    pub fn wait_by(self, wait: Wait) -> Self {
        Attachment { session: self.session.by(wait), ..self }
    }

    /// Waits for the next sample; `None` only after the timeout. Drop the sample before the next call.
    ///
    /// [`Kind::Short`](schema::Kind) if descriptors or places are short, [`Kind::Failed`](schema::Kind) if the domain
    /// is another user's or the topic has another layout.
    #[allow(clippy::should_implement_trait)] // An iterator would have to hold samples over waits.
    pub fn next(&mut self) -> Result<Option<Received<P>>, Failure> {
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

    /// The next sample if one waits; never waits itself. Failures as [`next`](Self::next).
    pub fn try_next(&mut self) -> Result<Option<Received<P>>, Failure> {
        // What is there comes before the question whether the hub still is: that takes longer than receiving.
        if self.follower.attached()
            && let Some(received) = self.follower.receive(&mut self.session)?
        {
            return Ok(Some(received));
        }
        self.session.look()?;
        self.follower.receive(&mut self.session)
    }

    /// A hub lives in the domain, as of the last call of [`next`](Self::next) or [`try_next`](Self::try_next) that found
    /// no sample waiting.
    pub fn hub_lives(&self) -> bool {
        self.session.domain().is_some()
    }
}
