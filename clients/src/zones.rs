//! The zones of one sensor, by value and never staler than they look: a verdict that is too old becomes `unknown` here,
//! whether the sensor, the hub or the machine stood still. So nobody who acts on it has to think of silence.

use std::time::Duration;

use schema::{Domain, Failure, Header, Zones, check_sensor};

use crate::attach::places;
use crate::clock;
use crate::follower::Follower;
use crate::freshness::Freshness;
use crate::session::Session;

/// Follows the zones of `sensor` in the domain that SCANHUB_DOMAIN names. There need not be a hub yet.
///
/// [`Kind::Configuration`](schema::Kind) if a name is not possible.
pub fn zones(sensor: &str) -> Result<ZonesFollower, Failure> {
    ZonesFollower::in_domain(places()?, sensor)
}

/// What was heard of a sensor's zones, or that nothing was.
#[derive(Clone, Copy, Debug)]
pub struct Heard {
    /// The zones; [`Zones::unknown`] in a silence.
    pub zones: Zones,
    /// Of the sample. In a silence that of the last one, with this moment as its stamps; nothing if there never was one.
    pub header: Option<Header>,
    /// Samples that were sent since the one heard before and are not handed out.
    pub missed: u64,
    /// Nothing that is new enough was heard: no sample of the hub's says this.
    pub stale: bool,
}

/// The zones of a sensor that is being followed.
pub struct ZonesFollower {
    session: Session,
    source: ZonesSource,
}

impl ZonesFollower {
    /// As [`zones`], in the first live one of `places`.
    ///
    /// [`Kind::Configuration`](schema::Kind) if the sensor's name is not possible.
    pub fn in_domain(places: Vec<Domain>, sensor: &str) -> Result<ZonesFollower, Failure> {
        check_sensor(sensor)?;
        Ok(ZonesFollower { session: Session::new(places), source: ZonesSource::new(sensor) })
    }

    /// Waits for news: the newest sample, or the one `unknown` of a silence. That comes two scan periods and 40 ms
    /// after the last sample, a second after the start if there was none, and with a hub as without one.
    ///
    /// Failures as [`Attachment::next`](crate::Attachment::next): nothing is known then either.
    #[allow(clippy::should_implement_trait)] // There is no end that an iterator would have.
    pub fn next(&mut self) -> Result<Heard, Failure> {
        loop {
            if let Some(heard) = self.try_next()? {
                return Ok(heard);
            }
            self.session.wait_for(self.source.left())?;
        }
    }

    /// The news, if there are any since the last call; never waits. Failures as [`next`](Self::next).
    pub fn try_next(&mut self) -> Result<Option<Heard>, Failure> {
        // What is there comes before the question whether the hub still is: that takes longer than receiving.
        if self.source.attached()
            && let Some(heard) = self.source.newest(&mut self.session)?
        {
            return Ok(Some(heard));
        }
        self.session.look()?;
        self.source.newest(&mut self.session)
    }
}

/// The zones of a sensor, sample by sample and silence by silence, in a session of the caller's.
pub(crate) struct ZonesSource {
    follower: Follower<Zones>,
    freshness: Freshness,
    last: Option<Header>,
}

impl ZonesSource {
    /// Will follow the zones of `sensor`.
    pub(crate) fn new(sensor: &str) -> ZonesSource {
        ZonesSource { follower: Follower::new(sensor), freshness: Freshness::new(clock::now()), last: None }
    }

    /// The topic has been there at least once.
    pub(crate) fn attached(&self) -> bool {
        self.follower.attached()
    }

    /// The next sample that waits; if there is none and the last one became too old, that; else nothing. Failures as
    /// [`Follower::receive`].
    pub(crate) fn receive(&mut self, session: &mut Session) -> Result<Option<Heard>, Failure> {
        let sample = self.follower.receive(session)?;
        let now = clock::now();
        if let Some(sample) = sample {
            let header = *sample.header();
            self.freshness.heard(&header, sample.verdict(), now);
            self.last = Some(header);
            let missed = sample.missed;
            return Ok(Some(Heard { zones: *sample, header: Some(header), missed, stale: false }));
        }
        if !self.freshness.silence(now) {
            return Ok(None);
        }
        let header = self.last.map(|last| Header {
            stamp_first_ns: now.monotonic_ns,
            stamp_last_ns: now.monotonic_ns,
            wall_ns: clock::wall_ns(),
            ..last
        });
        Ok(Some(Heard { zones: Zones::unknown(), header, missed: 0, stale: true }))
    }

    /// The last of all that waits: what stands now. What it supersedes counts as missed.
    fn newest(&mut self, session: &mut Session) -> Result<Option<Heard>, Failure> {
        let mut newest: Option<Heard> = None;
        while let Some(mut heard) = self.receive(session)? {
            heard.missed += newest.map_or(0, |passed| passed.missed + u64::from(!passed.stale));
            newest = Some(heard);
        }
        Ok(newest)
    }

    /// After which time [`receive`](Self::receive) has something to say even if no sample comes.
    pub(crate) fn left(&self) -> Option<Duration> {
        self.freshness.left(clock::now())
    }
}
