//! The robot's verdict: its sensors' zones combined; a sensor without recent data counts as unknown.

mod source;

use std::os::fd::BorrowedFd;
use std::time::Duration;

use scanhub_schema::{Failure, Verdict, Zones, check_followed};
use scanhub_shm::Domain;

use crate::session::Session;
use crate::subscribe::places;
use crate::wait::Wait;
pub use source::{RobotHeard, RobotSource};

/// Follows the zones of `sensors` in the domain that SCANHUB_DOMAIN names. If empty: all sensors of the hub there; in a
/// domain without a hub, the sensors of other machines that are published there. The hub may start later.
///
/// # Examples
///
/// ```no_run
/// use scanhub_client::{Failure, robot};
///
/// fn main() -> Result<(), Failure> {
///     let mut robot = robot(&[])?;
///     loop {
///         let now = robot.next()?;
///         println!("{}, {}", now.verdict().name(), now.worst().unwrap_or("no sensor"));
///     }
/// }
/// ```
///
/// # Errors
///
/// [`Kind::Configuration`](scanhub_schema::Kind) if a name is not possible.
pub fn robot(sensors: &[&str]) -> Result<RobotFollower, Failure> {
    RobotFollower::in_domain(places(None)?, sensors)
}

/// What is known of the robot's surroundings: the zones of each sensor.
#[derive(Clone, Debug, Default)]
pub struct Robot {
    parts: Vec<(String, Zones)>,
}

impl Robot {
    /// Returns the worst verdict of all sensors; unknown as long as there are none.
    pub fn verdict(&self) -> Verdict {
        let verdicts = self.sensors().map(|(_, verdict)| verdict);
        verdicts.reduce(Verdict::worse).unwrap_or(Verdict::Unknown)
    }

    /// Returns the first sensor with the worst verdict.
    pub fn worst(&self) -> Option<&str> {
        let verdict = self.verdict();
        self.sensors().find(|(_, of_sensor)| *of_sensor == verdict).map(|(sensor, _)| sensor)
    }

    /// Returns the distance from the robot's centre, in mm, of what is nearest to it, and the sensor that sees it there. Sensors
    /// that are unknown may see nothing at all.
    pub fn nearest(&self) -> Option<(u32, &str)> {
        self.parts.iter().filter_map(|(sensor, zones)| Some((zones.nearest()?.1, sensor.as_str()))).min()
    }

    /// Returns each sensor's verdict; unknown where it was not heard lately, or never.
    pub fn sensors(&self) -> impl Iterator<Item = (&str, Verdict)> {
        self.parts.iter().map(|(sensor, zones)| (sensor.as_str(), zones.verdict()))
    }

    /// Returns each sensor's zones; unknown where it was not heard lately, or never.
    pub fn zones(&self) -> impl Iterator<Item = (&str, &Zones)> {
        self.parts.iter().map(|(sensor, zones)| (sensor.as_str(), zones))
    }

    /// Counts `sensor` as unknown until its data arrives; returns its position. [`robot`](robot()) does that by itself: it is
    /// for programs that get samples another way.
    pub fn expect(&mut self, sensor: &str) -> usize {
        self.parts.push((sensor.to_owned(), Zones::unknown()));
        self.parts.len() - 1
    }

    /// Takes what is known now of the zones of the sensor at this position.
    ///
    /// # Panics
    ///
    /// If no sensor has this position.
    pub fn hear(&mut self, position: usize, zones: Zones) {
        self.parts[position].1 = zones;
    }
}

/// The verdict of a robot that is being followed.
pub struct RobotFollower {
    session: Session,
    source: RobotSource,
}

impl RobotFollower {
    /// Follows as [`robot`] does, in the first live one of `places`.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`](scanhub_schema::Kind) if a sensor's name is not possible.
    pub fn in_domain(places: Vec<Domain>, sensors: &[&str]) -> Result<RobotFollower, Failure> {
        sensors.iter().try_for_each(|sensor| check_followed(sensor))?;
        Ok(RobotFollower { session: Session::new(places), source: RobotSource::new(sensors) })
    }

    /// Waits by `wait`, as [`Subscription::wait_by`](crate::Subscription::wait_by).
    pub fn wait_by(self, wait: Wait) -> RobotFollower {
        RobotFollower { session: self.session.by(wait), ..self }
    }

    /// Takes early warnings too ([`Early`](scanhub_schema::Early)): the verdict becomes worse before a scan is complete, and is taken
    /// back if that does not come to be. To be said before the first wait.
    pub fn with_early(self) -> RobotFollower {
        RobotFollower { source: self.source.with_early(), ..self }
    }

    /// Waits until any of the sensors is heard, or any is heard no more; what is known then. The first time it waits for
    /// a word of each. A sensor becomes unknown as with [`ZonesFollower::next`](crate::ZonesFollower::next).
    ///
    /// # Errors
    ///
    /// As [`Subscription::next`](crate::Subscription::next): nothing is known then either.
    #[allow(clippy::should_implement_trait)] // There is no end that an iterator would have.
    pub fn next(&mut self) -> Result<&Robot, Failure> {
        while !self.hear()? {
            self.wait(Duration::MAX)?;
        }
        Ok(self.source.robot())
    }

    /// Returns what is known now; never waits.
    ///
    /// # Errors
    ///
    /// As [`next`](Self::next).
    pub fn now(&mut self) -> Result<&Robot, Failure> {
        self.hear()?;
        Ok(self.source.robot())
    }

    /// Returns what is known now, if anything was heard, or became too old, since the last call; never waits.
    ///
    /// # Errors
    ///
    /// As [`next`](Self::next).
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

    /// Sleeps as [`Subscription::wait`](crate::Subscription::wait) does, or until a verdict becomes too old.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if the system cannot wait.
    pub fn wait(&mut self, longest: Duration) -> Result<(), Failure> {
        self.session.wait_for(Some(self.source.left().map_or(longest, |left| left.min(longest))))
    }

    /// Returns a descriptor to poll, as [`ZonesFollower::descriptor`](crate::ZonesFollower::descriptor).
    ///
    /// # Errors
    ///
    /// As [`Subscription::descriptor`](crate::Subscription::descriptor).
    pub fn descriptor(&mut self) -> Result<BorrowedFd<'_>, Failure> {
        self.session.descriptor()
    }

    /// Returns whether somebody publishes in the domain, a hub or a listener, as of the last call of [`next`](Self::next),
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
