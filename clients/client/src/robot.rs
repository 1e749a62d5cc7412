//! Verdict of a robot: the combined zones of its sensors. A sensor without recent data counts as unknown.

use std::time::{Duration, Instant};

use scanhub_schema::{Verdict, Zones, is_remote};

use crate::builder::SubscriberBuilder;
use crate::clock;
use crate::error::Error;
use crate::hub_finder::{DomainHolder, STARTUP_GRACE};
use crate::session::Session;
use crate::silence::Silence;
use crate::subscribe::sealed::Sealed;
use crate::subscribe::{ItemSource, Subscribe, Subscriber};
use crate::zones::{StalenessTimer, ZonesSource, ZonesUpdate};

/// Subscribes to the zones of `sensors` in the domain that SCANHUB_DOMAIN names. Without names, it subscribes to all
/// sensors of the hub. In a domain without a hub, it subscribes to all remote sensors that a listener publishes. The
/// hub may start later.
///
/// # Examples
///
/// ```no_run
/// use scanhub_client::{Error, robot};
///
/// fn main() -> Result<(), Error> {
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
/// [`ErrorKind::InvalidInput`](crate::ErrorKind) if a name is invalid.
pub fn robot(sensors: &[&str]) -> Result<RobotSubscriber, Error> {
    RobotSubscriber::builder(sensors).open()
}

/// State of the robot's surroundings: the zones of each sensor.
#[derive(Clone, Debug, Default)]
pub struct Robot {
    parts: Vec<(String, Zones)>,
}

impl Robot {
    /// Returns the worst verdict of all sensors; unknown if there are no sensors.
    pub fn verdict(&self) -> Verdict {
        let verdicts = self.sensors().map(|(_, verdict)| verdict);
        verdicts.reduce(Verdict::worse).unwrap_or(Verdict::Unknown)
    }

    /// Returns the first sensor with the worst verdict; `None` if there are no sensors.
    pub fn worst(&self) -> Option<&str> {
        let verdict = self.verdict();
        self.sensors().find(|(_, of_sensor)| *of_sensor == verdict).map(|(sensor, _)| sensor)
    }

    /// Returns the distance of the nearest point from the robot's center in mm, and the sensor that measures it. A
    /// sensor whose verdict is unknown may report no point at all.
    pub fn nearest(&self) -> Option<(u32, &str)> {
        self.parts.iter().filter_map(|(sensor, zones)| Some((zones.nearest()?.1, sensor.as_str()))).min()
    }

    /// Returns each sensor's verdict. It is unknown if the sensor has sent no recent data.
    pub fn sensors(&self) -> impl Iterator<Item = (&str, Verdict)> {
        self.parts.iter().map(|(sensor, zones)| (sensor.as_str(), zones.verdict()))
    }

    /// Returns each sensor's zones. They are unknown if the sensor has sent no recent data.
    pub fn zones(&self) -> impl Iterator<Item = (&str, &Zones)> {
        self.parts.iter().map(|(sensor, zones)| (sensor.as_str(), zones))
    }

    /// Adds `sensor`, which counts as unknown until its data arrives, and returns its position. Use this method in
    /// programs that do not receive samples through [`robot`](robot()).
    pub fn expect(&mut self, sensor: &str) -> usize {
        self.parts.push((sensor.to_owned(), Zones::unknown()));
        self.parts.len() - 1
    }

    /// Sets the zones of the sensor at this position.
    ///
    /// # Panics
    ///
    /// If no sensor has this position.
    pub fn update(&mut self, position: usize, zones: Zones) {
        self.parts[position].1 = zones;
    }
}

/// Subscriber of the verdict of a robot.
pub type RobotSubscriber = Subscriber<Robot>;

impl Subscriber<Robot> {
    /// Waits until zones of any sensor arrive or become too old, and returns the robot's state. The first call waits
    /// until that has happened for each sensor. The verdict of a sensor becomes unknown under the same conditions as
    /// with [`ZonesSubscriber`](crate::ZonesSubscriber).
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Subscriber::next`](crate::Subscriber::next). After an error, the verdict is unknown,
    /// too.
    #[allow(clippy::should_implement_trait)] // There is no end that an iterator would have.
    pub fn next(&mut self) -> Result<Robot, Error> {
        self.wait_for_next()
    }

    /// Returns the current state, even if it has not changed. Never waits.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`next`](Self::next).
    pub fn now(&mut self) -> Result<&Robot, Error> {
        self.source.drain_and_check(&mut self.session)?;
        Ok(self.source.robot())
    }
}

impl Sealed for Robot {}

impl Subscribe for Robot {
    type Sensors<'a> = &'a [&'a str];
    type Item = Robot;
    type Source = RobotSource;

    fn source(options: &SubscriberBuilder<Robot>) -> RobotSource {
        let source = RobotSource::new(&options.sensors());
        if options.is_early() { source.with_early() } else { source }
    }
}

impl ItemSource for RobotSource {
    type Item = Robot;

    fn subscribed(&self) -> bool {
        self.subscribed()
    }

    fn receive(&mut self, session: &mut Session) -> Result<Option<Robot>, Error> {
        Ok(self.drain(session)?.then(|| self.robot.clone()))
    }

    fn check_and_receive(&mut self, session: &mut Session) -> Result<Option<Robot>, Error> {
        Ok(self.drain_and_check(session)?.then(|| self.robot.clone()))
    }

    fn time_left(&self) -> Option<Duration> {
        self.time_left()
    }

    fn why_silent(&mut self, session: &mut Session) -> Silence {
        self.why_silent(session)
    }
}

/// Source of the combined zones of a robot's sensors, sample by sample, in the caller's session. If no sensor is named,
/// the source subscribes to all sensors of the hub, or to all remote sensors if only a listener runs. It never waits.
pub struct RobotSource {
    robot: Robot,
    parts: Vec<ZonesSource>,
    /// Index of the sensor that is read next. The sensors are read in turn, so that no sensor waits until all samples
    /// of another one are handled.
    next_part: usize,
    /// Whether each sensor has sent a sample or missed its deadline once, so that the result includes all of them.
    is_complete: bool,
    /// Timer after which the verdict is unknown if there are no sensors.
    no_sensors: StalenessTimer,
    /// Origin of the sensors.
    origin: SensorOrigin,
    /// Time of the next search for new sensors, while a hub or a listener publishes.
    discover_at: Option<Instant>,
    /// Whether early warnings are used, too.
    early: bool,
}

/// Origin of the sensors of a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SensorOrigin {
    /// The caller named the sensors.
    Named,
    /// All sensors of one publisher. It is the first publisher that runs, but the hub as soon as a hub runs, because
    /// the zones of remote sensors may be around the center of another robot. After the hub has exited, its sensors are
    /// missing, and no other sensors replace them.
    All(Option<DomainHolder>),
}

/// Sample or silence of one sensor, with the resulting state of the robot.
pub struct RobotUpdate {
    /// The zones of all sensors.
    pub robot: Robot,
    /// The sample or silence.
    pub update: ZonesUpdate,
}

/// Maximum number of remote sensors of a robot. A listener publishes no more at a time. A robot needs a limit of its
/// own: it never removes a sensor, and a sender in the listener's network can announce any number of new sensors.
const MAX_REMOTE_SENSORS: usize = 16;

/// Name of an entry that stands for all remote sensors beyond the maximum. The zones of this entry are always unknown.
/// No sensor can have this name.
const OTHERS_NAME: &str = "others...";

/// Interval at which the source searches for new sensors. A hub that is starting creates its topics one after the
/// other.
const DISCOVERY_INTERVAL: Duration = Duration::from_secs(1);

impl RobotSource {
    /// Creates a source for the zones of `sensors`, or of all sensors if it is empty, as [`robot`](robot()) does.
    pub fn new(sensors: &[&str]) -> RobotSource {
        let mut source = RobotSource {
            robot: Robot::default(),
            parts: Vec::new(),
            next_part: 0,
            is_complete: false,
            no_sensors: StalenessTimer::new(clock::now()),
            origin: if sensors.is_empty() { SensorOrigin::All(None) } else { SensorOrigin::Named },
            discover_at: None,
            early: false,
        };
        sensors.iter().for_each(|sensor| source.follow(sensor));
        source
    }

    /// Makes the source use early warnings, too. A warning makes the verdict worse until the zones of its scan arrive,
    /// or until the hub withdraws it.
    pub fn with_early(self) -> RobotSource {
        let RobotSource { robot, parts, .. } = self;
        let names = robot.sensors().map(|(sensor, _)| sensor);
        let parts = parts.into_iter().zip(names).map(|(part, sensor)| part.with_early(sensor)).collect();
        RobotSource { parts, robot, early: true, ..self }
    }

    /// Returns the current state.
    pub fn robot(&self) -> &Robot {
        &self.robot
    }

    /// Returns whether the topic of each sensor has existed at least once.
    pub fn subscribed(&self) -> bool {
        !self.parts.is_empty() && self.parts.iter().all(ZonesSource::subscribed)
    }

    /// Returns the next sample or silence of any sensor. Returns `None` until each sensor has had a sample or a
    /// silence.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`ZonesSource::receive`].
    pub fn receive(&mut self, session: &mut Session) -> Result<Option<RobotUpdate>, Error> {
        let update = self.receive_part(session)?;
        Ok(update.map(|update| RobotUpdate { robot: self.robot.clone(), update }))
    }

    /// Returns the time after which [`receive`](Self::receive) returns a silence if no sample arrives.
    pub fn time_left(&self) -> Option<Duration> {
        match &self.parts[..] {
            [] => self.no_sensors.time_left(clock::now()),
            parts => parts.iter().filter_map(ZonesSource::time_left).min(),
        }
    }

    /// Handles all waiting samples and silences. Returns whether there were any.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`ZonesSource::receive`].
    pub fn drain(&mut self, session: &mut Session) -> Result<bool, Error> {
        let mut any = false;
        while self.receive_part(session)?.is_some() {
            any = true;
        }
        Ok(any)
    }

    /// Handles all waiting samples and silences, and checks for the hub. Returns whether there were any.
    fn drain_and_check(&mut self, session: &mut Session) -> Result<bool, Error> {
        // Handle samples before the check for the hub, because the check takes longer. A program that always has
        // samples must also notice a new hub.
        let has_update = self.drain(session)?;
        session.check_hub()?;
        Ok(self.drain(session)? || has_update)
    }

    /// Returns why no hub runs or, if one runs, the reason for the silence of the first sensor with an unknown verdict
    /// and a known reason. If the robot has no sensors, the reason may be that the hub has none with zones.
    pub fn why_silent(&mut self, session: &mut Session) -> Silence {
        if let Some(reason) = Silence::of_hub(session) {
            return reason;
        }
        if self.parts.is_empty() {
            return Silence::of_all_sensors(session);
        }
        let verdicts = self.robot.sensors().map(|(_, verdict)| verdict);
        let unknown = self.parts.iter_mut().zip(verdicts).filter(|(_, verdict)| *verdict == Verdict::Unknown);
        let mut reasons = unknown.map(|(part, _)| part.why_silent(session));
        reasons.find(|reason| *reason != Silence::Waiting).unwrap_or(Silence::Waiting)
    }

    fn receive_part(&mut self, session: &mut Session) -> Result<Option<ZonesUpdate>, Error> {
        if self.switch_to_hub(session.domain_holder()) {
            return Ok(Some(ZonesUpdate::silence()));
        }
        for _ in 0..self.parts.len() {
            let part = self.next_part;
            self.next_part = (part + 1) % self.parts.len();
            if let Some(update) = self.parts[part].receive(session)? {
                self.robot.update(part, update.zones);
                self.is_complete = self.is_complete || self.parts.iter().all(ZonesSource::has_update);
                if self.is_complete {
                    return Ok(Some(update));
                }
            }
        }
        // Search for sensors last, because it takes longer than everything else.
        self.discover(session)?;
        let silence = self.parts.is_empty() && self.no_sensors.silence(clock::now());
        Ok(silence.then(ZonesUpdate::silence))
    }

    /// Drops the remote sensors if a hub has started. The verdict is then unknown until the hub's own sensors send
    /// zones. Returns whether this call has dropped them.
    fn switch_to_hub(&mut self, holder: Option<DomainHolder>) -> bool {
        if (self.origin, holder) != (SensorOrigin::All(Some(DomainHolder::Listener)), Some(DomainHolder::Hub))
        {
            return false;
        }
        (self.robot, self.parts, self.next_part, self.is_complete) = (Robot::default(), Vec::new(), 0, false);
        (self.origin, self.discover_at) = (SensorOrigin::All(Some(DomainHolder::Hub)), None);
        true
    }

    /// Subscribes to new sensors. Sensors that no longer exist stay in the list, so that the user sees that they are
    /// missing.
    fn discover(&mut self, session: &Session) -> Result<(), Error> {
        let (SensorOrigin::All(holder), Some(domain)) = (self.origin, session.domain()) else {
            self.discover_at = None;
            return Ok(());
        };
        let now = Instant::now();
        if now < *self.discover_at.get_or_insert(now + STARTUP_GRACE / 2) {
            return Ok(());
        }
        self.discover_at = Some(now + DISCOVERY_INTERVAL);
        let holder = holder.or(session.domain_holder());
        let is_followed = |sensor: &String| is_remote(sensor) == (holder == Some(DomainHolder::Listener));
        for sensor in scanhub_shm::sensors_with_zones(domain)?.into_iter().filter(is_followed) {
            self.origin = SensorOrigin::All(holder);
            self.add_sensor(&sensor);
        }
        Ok(())
    }

    /// Subscribes to `sensor`, unless the robot already has it. If there are too many remote sensors, [`OTHERS_NAME`]
    /// represents the rest, without data.
    fn add_sensor(&mut self, sensor: &str) {
        let is_known = |name: &str| self.robot.sensors().any(|(known, _)| known == name);
        if is_known(sensor) {
            return;
        }
        if !is_remote(sensor) || self.parts.len() < MAX_REMOTE_SENSORS {
            self.follow(sensor);
        } else if !is_known(OTHERS_NAME) {
            self.robot.expect(OTHERS_NAME);
        }
    }

    fn follow(&mut self, sensor: &str) {
        self.robot.expect(sensor);
        let part = ZonesSource::new(sensor);
        self.parts.push(if self.early { part.with_early(sensor) } else { part });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn surplus_remote_sensors_are_one_unknown_part() {
        let mut source = RobotSource::new(&[]);
        source.origin = SensorOrigin::All(Some(DomainHolder::Listener));
        for n in 0..1000 {
            source.add_sensor(&format!("robot{n}.front"));
            source.add_sensor("robot0.front");
        }
        assert_eq!(
            (source.parts.len(), source.robot.parts.len()),
            (MAX_REMOTE_SENSORS, MAX_REMOTE_SENSORS + 1)
        );
        for (name, zones) in source.robot.parts.iter_mut().filter(|(name, _)| name != OTHERS_NAME) {
            assert!(is_remote(name));
            zones.verdict = Verdict::Clear as u8;
        }
        assert_eq!((source.robot.verdict(), source.robot.worst()), (Verdict::Unknown, Some(OTHERS_NAME)));
        assert!(scanhub_schema::check_any_sensor(OTHERS_NAME).is_err(), "no sensor has its name");
        // The number of a hub's own sensors is not limited.
        let mut source = RobotSource::new(&[]);
        (0..40).for_each(|n| source.add_sensor(&format!("front{n}")));
        assert_eq!(source.parts.len(), 40);
    }

    #[test]
    fn robot_switches_from_remote_sensors_to_a_hub() {
        let mut source = RobotSource::new(&[]);
        assert!(!source.switch_to_hub(Some(DomainHolder::Hub)), "there is no sensor yet");
        source.origin = SensorOrigin::All(Some(DomainHolder::Listener));
        source.follow("robot1.front");
        source.is_complete = true;
        assert!(!source.switch_to_hub(None) && !source.switch_to_hub(Some(DomainHolder::Listener)));
        assert!(source.switch_to_hub(Some(DomainHolder::Hub)));
        assert!(source.robot().sensors().next().is_none() && !source.is_complete, "nothing is known");
        for holder in [Some(DomainHolder::Hub), None, Some(DomainHolder::Listener), Some(DomainHolder::Hub)] {
            assert!(!source.switch_to_hub(holder));
            assert_eq!(source.origin, SensorOrigin::All(Some(DomainHolder::Hub)));
        }
        let mut named = RobotSource::new(&["robot1.front"]);
        assert!(!named.switch_to_hub(Some(DomainHolder::Hub)), "a named sensor is kept");
    }
}
