//! The robot's verdict: its sensors' zones combined; a sensor without recent data counts as unknown.

mod source;

use std::os::fd::BorrowedFd;
use std::time::Duration;

use schema::{Domain, Failure, Verdict, Zones, check_followed};

use crate::session::Session;
use crate::subscribe::places;
use crate::wait::Wait;
pub use source::{RobotHeard, RobotSource};

/// Follows the zones of `sensors` in the domain that SCANHUB_DOMAIN names. If empty: all sensors of the hub there; in a
/// domain without a hub, the sensors of other machines that are published there. The hub may start later.
///
/// [`Kind::Configuration`](schema::Kind) if a name is not possible.
pub fn robot(sensors: &[&str]) -> Result<RobotFollower, Failure> {
    RobotFollower::in_domain(places(None)?, sensors)
}

/// What is known of the robot's surroundings: the zones of each sensor.
#[derive(Clone, Debug, Default)]
pub struct Robot {
    parts: Vec<(String, Zones)>,
}

impl Robot {
    /// The worst verdict of all sensors; unknown as long as there are none.
    pub fn verdict(&self) -> Verdict {
        let verdicts = self.sensors().map(|(_, verdict)| verdict);
        verdicts.reduce(Verdict::worse).unwrap_or(Verdict::Unknown)
    }

    /// The first sensor with the worst verdict.
    pub fn worst(&self) -> Option<&str> {
        let verdict = self.verdict();
        self.sensors().find(|(_, of_sensor)| *of_sensor == verdict).map(|(sensor, _)| sensor)
    }

    /// Distance from the robot's centre, in mm, of the nearest object, and the sensor that sees it. Unknown sensors may
    /// see nothing at all.
    pub fn nearest(&self) -> Option<(u32, &str)> {
        self.parts.iter().filter_map(|(sensor, zones)| Some((zones.nearest()?.1, sensor.as_str()))).min()
    }

    /// Each sensor's verdict; unknown without recent data.
    pub fn sensors(&self) -> impl Iterator<Item = (&str, Verdict)> {
        self.parts.iter().map(|(sensor, zones)| (sensor.as_str(), zones.verdict()))
    }

    /// Each sensor's zones; unknown without recent data.
    pub fn zones(&self) -> impl Iterator<Item = (&str, &Zones)> {
        self.parts.iter().map(|(sensor, zones)| (sensor.as_str(), zones))
    }

    /// Counts `sensor` as unknown until its data arrives.
    fn expect(&mut self, sensor: &str) {
        self.parts.push((sensor.to_owned(), Zones::unknown()));
    }
}

/// The verdict of a robot that is being followed.
pub struct RobotFollower {
    session: Session,
    source: RobotSource,
}

impl RobotFollower {
    /// As [`robot`], at the first of `places` where a hub runs.
    ///
    /// [`Kind::Configuration`](schema::Kind) if a sensor's name is not possible.
    pub fn in_domain(places: Vec<Domain>, sensors: &[&str]) -> Result<RobotFollower, Failure> {
        sensors.iter().try_for_each(|sensor| check_followed(sensor))?;
        Ok(RobotFollower { session: Session::new(places), source: RobotSource::new(sensors) })
    }

    /// As [`Subscription::wait_by`](crate::Subscription::wait_by).
    pub fn wait_by(self, wait: Wait) -> RobotFollower {
        RobotFollower { session: self.session.by(wait), ..self }
    }

    /// Waits until data from any sensor arrives, or stops; returns what is known then. The first time it waits for each
    /// sensor. A sensor becomes unknown as with [`ZonesFollower::next`](crate::ZonesFollower::next), and this fails in
    /// the same way.
    #[allow(clippy::should_implement_trait)] // There is no end that an iterator would have.
    pub fn next(&mut self) -> Result<&Robot, Failure> {
        while !self.hear()? {
            self.wait(Duration::MAX)?;
        }
        Ok(self.source.robot())
    }

    /// What is known now; never waits. Failures as [`next`](Self::next).
    pub fn now(&mut self) -> Result<&Robot, Failure> {
        self.hear()?;
        Ok(self.source.robot())
    }

    /// What is known now, if data arrived or became too old since the last call; never waits. Failures as
    /// [`next`](Self::next).
    pub fn try_next(&mut self) -> Result<Option<&Robot>, Failure> {
        loop {
            if self.hear()? {
                return Ok(Some(self.source.robot()));
            }
            if !self.session.settle(self.source.left())? {
                return Ok(None);
            }
        }
    }

    /// As [`Subscription::wait`](crate::Subscription::wait); it is also over when a verdict becomes too old.
    pub fn wait(&mut self, longest: Duration) -> Result<(), Failure> {
        self.session.wait_for(Some(self.source.left().map_or(longest, |left| left.min(longest))))
    }

    /// As [`ZonesFollower::descriptor`](crate::ZonesFollower::descriptor).
    pub fn descriptor(&mut self) -> Result<BorrowedFd<'_>, Failure> {
        self.session.descriptor()
    }

    /// Somebody publishes in the domain, a hub or a listener, as of the last call of [`next`](Self::next),
    /// [`now`](Self::now) or [`try_next`](Self::try_next) that found no news.
    pub fn hub_lives(&self) -> bool {
        self.session.domain().is_some()
    }

    /// Takes all waiting samples; returns whether there were any.
    fn hear(&mut self) -> Result<bool, Failure> {
        // As with one sensor's zones what is there comes first; but who always finds something has to see a hub come, too.
        let heard = self.source.drain(&mut self.session)?;
        self.session.look()?;
        Ok(self.source.drain(&mut self.session)? || heard)
    }
}
