//! The robot's verdict: the fold over its sensors' zones, in which a sensor that is not heard counts as unknown.

use std::time::{Duration, Instant};

use schema::{Domain, Failure, Verdict, Zones, check_followed, ipc, is_remote};

use crate::attach::places;
use crate::clock;
use crate::freshness::Freshness;
use crate::presence::GRACE;
use crate::session::Session;
use crate::zones::{Heard, ZonesSource};

/// Follows the zones of `sensors` (none: all sensors of the hub on this machine) in the domain that SCANHUB_DOMAIN names. There need
/// not be a hub yet.
///
/// [`Kind::Configuration`](schema::Kind) if a name is not possible.
pub fn robot(sensors: &[&str]) -> Result<RobotFollower, Failure> {
    RobotFollower::in_domain(places(None)?, sensors)
}

/// What is known of the robot's surroundings: one sensor's zones each.
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

    /// Distance from the robot's centre, in mm, of what is nearest to it, and the sensor that sees it there. Sensors
    /// that are unknown may see nothing at all.
    pub fn nearest(&self) -> Option<(u32, &str)> {
        self.parts.iter().filter_map(|(sensor, zones)| Some((zones.nearest()?.1, sensor.as_str()))).min()
    }

    /// Each sensor's verdict; unknown where it was not heard lately, or never.
    pub fn sensors(&self) -> impl Iterator<Item = (&str, Verdict)> {
        self.parts.iter().map(|(sensor, zones)| (sensor.as_str(), zones.verdict()))
    }

    /// Counts `sensor` as unknown until it is heard.
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
    /// As [`robot`], in the first live one of `places`.
    ///
    /// [`Kind::Configuration`](schema::Kind) if a sensor's name is not possible.
    pub fn in_domain(places: Vec<Domain>, sensors: &[&str]) -> Result<RobotFollower, Failure> {
        sensors.iter().try_for_each(|sensor| check_followed(sensor))?;
        Ok(RobotFollower { session: Session::new(places), source: RobotSource::new(sensors) })
    }

    /// Waits until any of the sensors is heard, or any is heard no more; what is known then. The first time it waits for
    /// a word of each. A sensor becomes unknown as with [`ZonesFollower::next`](crate::ZonesFollower::next), and this
    /// fails likewise.
    #[allow(clippy::should_implement_trait)] // There is no end that an iterator would have.
    pub fn next(&mut self) -> Result<&Robot, Failure> {
        while !self.hear()? {
            self.session.wait_for(self.source.left())?;
        }
        Ok(&self.source.robot)
    }

    /// What is known now; never waits. Failures as [`next`](Self::next).
    pub fn now(&mut self) -> Result<&Robot, Failure> {
        self.hear()?;
        Ok(&self.source.robot)
    }

    /// Takes all that waits; whether there was anything.
    fn hear(&mut self) -> Result<bool, Failure> {
        // As with one sensor's zones: what is there comes first.
        if self.source.drain(&mut self.session)? {
            return Ok(true);
        }
        self.session.look()?;
        self.source.drain(&mut self.session)
    }
}

/// The fold, sample by sample, in a session of the caller's.
pub(crate) struct RobotSource {
    robot: Robot,
    parts: Vec<ZonesSource>,
    /// Whose turn it is: no sensor shall wait for another one's samples.
    turn: usize,
    /// Each sensor has spoken once: the fold is of all of them.
    begun: bool,
    /// As long as there are no sensors.
    nobody: Freshness,
    /// The sensors are those of the hub.
    all: bool,
    /// When the hub is asked for its sensors, if there is one.
    call_at: Option<Instant>,
}

/// A sample of any sensor, or that it is silent, and what is known with it.
pub(crate) struct RobotHeard {
    pub(crate) robot: Robot,
    pub(crate) heard: Heard,
}

/// A hub that starts makes its topics one after the other: nobody shall be overlooked for long.
const CALL_EVERY: Duration = Duration::from_secs(1);

impl RobotSource {
    /// Will follow the zones of `sensors`; none: all of the hub.
    pub(crate) fn new(sensors: &[&str]) -> RobotSource {
        let mut source = RobotSource {
            robot: Robot::default(),
            parts: Vec::new(),
            turn: 0,
            begun: false,
            nobody: Freshness::new(clock::now()),
            all: sensors.is_empty(),
            call_at: None,
        };
        sensors.iter().for_each(|sensor| source.follow(sensor));
        source
    }

    /// The topic of each sensor has been there at least once.
    pub(crate) fn attached(&self) -> bool {
        !self.parts.is_empty() && self.parts.iter().all(ZonesSource::attached)
    }

    /// The next sample of any sensor, or a silence, once each has spoken; failures as [`ZonesSource::receive`].
    pub(crate) fn receive(&mut self, session: &mut Session) -> Result<Option<RobotHeard>, Failure> {
        let heard = self.hear(session)?;
        Ok(heard.map(|heard| RobotHeard { robot: self.robot.clone(), heard }))
    }

    /// After which time [`receive`](Self::receive) has something to say even if no sample comes.
    pub(crate) fn left(&self) -> Option<Duration> {
        match &self.parts[..] {
            [] => self.nobody.left(clock::now()),
            parts => parts.iter().filter_map(ZonesSource::left).min(),
        }
    }

    /// Takes all that waits; whether there was anything.
    fn drain(&mut self, session: &mut Session) -> Result<bool, Failure> {
        let mut any = false;
        while self.hear(session)?.is_some() {
            any = true;
        }
        Ok(any)
    }

    fn hear(&mut self, session: &mut Session) -> Result<Option<Heard>, Failure> {
        for _ in 0..self.parts.len() {
            let turn = self.turn;
            self.turn = (turn + 1) % self.parts.len();
            if let Some(heard) = self.parts[turn].receive(session)? {
                self.robot.parts[turn].1 = heard.zones;
                self.begun = self.begun || self.parts.iter().all(ZonesSource::has_spoken);
                if self.begun {
                    return Ok(Some(heard));
                }
            }
        }
        // Last, because it takes longer than all the rest.
        self.call_the_roll(session)?;
        let silence = self.parts.is_empty() && self.nobody.silence(clock::now());
        Ok(silence.then(Heard::nothing))
    }

    /// Adds the sensors that the hub has and that are not followed yet. One that is, stays: that it is missing is to be
    /// seen.
    fn call_the_roll(&mut self, session: &Session) -> Result<(), Failure> {
        let Some(domain) = session.domain().filter(|_| self.all) else {
            self.call_at = None;
            return Ok(());
        };
        let now = Instant::now();
        if now < *self.call_at.get_or_insert(now + GRACE / 2) {
            return Ok(());
        }
        self.call_at = Some(now + CALL_EVERY);
        // The zones of another robot's sensors are around its own centre.
        for sensor in ipc::sensors(domain)?.into_iter().filter(|sensor| !is_remote(sensor)) {
            if self.robot.sensors().all(|(known, _)| known != sensor) {
                self.follow(&sensor);
            }
        }
        Ok(())
    }

    fn follow(&mut self, sensor: &str) {
        self.robot.expect(sensor);
        self.parts.push(ZonesSource::new(sensor));
    }
}
