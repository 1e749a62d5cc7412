//! The zones of a robot's sensors, combined sample by sample, in the caller's session. If no sensor is named, it follows
//! those of the hub, or those of other machines if only they are published. Never waits.

use std::time::{Duration, Instant};

use scanhub_schema::{Failure, is_remote};

use super::Robot;
use crate::clock;
use crate::freshness::Freshness;
use crate::presence::{GRACE, Who};
use crate::session::Session;
use crate::zones::{Heard, ZonesSource};

/// The fold, sample by sample.
pub struct RobotSource {
    robot: Robot,
    parts: Vec<ZonesSource>,
    /// Whose turn it is: no sensor shall wait for another one's samples.
    turn: usize,
    /// Each sensor has spoken once: the fold is of all of them.
    begun: bool,
    /// As long as there are no sensors.
    nobody: Freshness,
    /// Where the sensors come from.
    whose: Whose,
    /// When it is asked which sensors there are, if anybody publishes.
    call_at: Option<Instant>,
    /// Early warnings count too.
    early: bool,
}

/// Where the sensors come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Whose {
    /// They were named.
    Named,
    /// All of this one: whoever was there first, and the hub from when it is there, because the zones of another robot's
    /// sensors are around its own centre. A hub that goes leaves its sensors missing; nobody stands in for them.
    All(Option<Who>),
}

/// A sample of any sensor, or that it is silent, and what is known with it.
pub struct RobotHeard {
    /// What is known with it.
    pub robot: Robot,
    /// What was heard, of whichever sensor.
    pub heard: Heard,
}

/// The most sensors of other machines that are followed: as many as a listener publishes at a time. None is forgotten, and
/// whoever can send to its network can announce ever new ones.
const MOST_REMOTE: usize = 16;

/// Stands for the sensors of other machines that are not followed, and is always unknown. No sensor can have this name.
const OTHERS: &str = "others...";

/// A hub that starts makes its topics one after the other: nobody shall be overlooked for long.
const CALL_EVERY: Duration = Duration::from_secs(1);

impl RobotSource {
    /// Makes what will follow the zones of `sensors`; none: all, as [`robot`](super::robot()) says.
    pub fn new(sensors: &[&str]) -> RobotSource {
        let mut source = RobotSource {
            robot: Robot::default(),
            parts: Vec::new(),
            turn: 0,
            begun: false,
            nobody: Freshness::new(clock::now()),
            whose: if sensors.is_empty() { Whose::All(None) } else { Whose::Named },
            call_at: None,
            early: false,
        };
        sensors.iter().for_each(|sensor| source.follow(sensor));
        source
    }

    /// Takes early warnings too: one makes the verdict worse until the zones of its scan are there, or until it is withdrawn.
    pub fn with_early(self) -> RobotSource {
        let RobotSource { robot, parts, .. } = self;
        let names = robot.sensors().map(|(sensor, _)| sensor);
        let parts = parts.into_iter().zip(names).map(|(part, sensor)| part.with_early(sensor)).collect();
        RobotSource { parts, robot, early: true, ..self }
    }

    /// Returns what is known.
    pub fn robot(&self) -> &Robot {
        &self.robot
    }

    /// Returns whether the topic of each sensor has been there at least once.
    pub fn subscribed(&self) -> bool {
        !self.parts.is_empty() && self.parts.iter().all(ZonesSource::subscribed)
    }

    /// Returns the next sample of any sensor, or a silence, once each has spoken.
    ///
    /// # Errors
    ///
    /// As [`ZonesSource::receive`].
    pub fn receive(&mut self, session: &mut Session) -> Result<Option<RobotHeard>, Failure> {
        let heard = self.hear(session)?;
        Ok(heard.map(|heard| RobotHeard { robot: self.robot.clone(), heard }))
    }

    /// Returns after which time [`receive`](Self::receive) has something to say even if no sample comes.
    pub fn left(&self) -> Option<Duration> {
        match &self.parts[..] {
            [] => self.nobody.left(clock::now()),
            parts => parts.iter().filter_map(ZonesSource::left).min(),
        }
    }

    /// Takes all that waits; whether there was anything.
    ///
    /// # Errors
    ///
    /// As [`ZonesSource::receive`].
    pub fn drain(&mut self, session: &mut Session) -> Result<bool, Failure> {
        let mut any = false;
        while self.hear(session)?.is_some() {
            any = true;
        }
        Ok(any)
    }

    fn hear(&mut self, session: &mut Session) -> Result<Option<Heard>, Failure> {
        if self.gives_way_to(session.publishes()) {
            return Ok(Some(Heard::nothing()));
        }
        for _ in 0..self.parts.len() {
            let turn = self.turn;
            self.turn = (turn + 1) % self.parts.len();
            if let Some(heard) = self.parts[turn].receive(session)? {
                self.robot.hear(turn, heard.zones);
                self.begun = self.begun || self.parts.iter().all(ZonesSource::has_spoken);
                if self.begun {
                    return Ok(Some(heard));
                }
            }
        }
        // Last, because it takes longer than all the rest.
        self.discover(session)?;
        let silence = self.parts.is_empty() && self.nobody.silence(clock::now());
        Ok(silence.then(Heard::nothing))
    }

    /// A hub came where the sensors of other machines were followed: nothing is known until its own are heard. Whether
    /// that is so just now.
    fn gives_way_to(&mut self, who: Option<Who>) -> bool {
        if (self.whose, who) != (Whose::All(Some(Who::Listener)), Some(Who::Hub)) {
            return false;
        }
        (self.robot, self.parts, self.turn, self.begun) = (Robot::default(), Vec::new(), 0, false);
        (self.whose, self.call_at) = (Whose::All(Some(Who::Hub)), None);
        true
    }

    /// Adds the sensors that there are and that are not followed yet. One that is, stays: that it is missing is to be
    /// seen.
    fn discover(&mut self, session: &Session) -> Result<(), Failure> {
        let (Whose::All(whose), Some(domain)) = (self.whose, session.domain()) else {
            self.call_at = None;
            return Ok(());
        };
        let now = Instant::now();
        if now < *self.call_at.get_or_insert(now + GRACE / 2) {
            return Ok(());
        }
        self.call_at = Some(now + CALL_EVERY);
        let whose = whose.or(session.publishes());
        let is_followed = |sensor: &String| is_remote(sensor) == (whose == Some(Who::Listener));
        for sensor in scanhub_shm::sensors_with_zones(domain)?.into_iter().filter(is_followed) {
            self.whose = Whose::All(whose);
            self.meet(&sensor);
        }
        Ok(())
    }

    /// Follows `sensor`, if it is not followed yet. Of those of other machines that are too many none is: in their place stands
    /// [`OTHERS`], which is never heard.
    fn meet(&mut self, sensor: &str) {
        let is_known = |name: &str| self.robot.sensors().any(|(known, _)| known == name);
        if is_known(sensor) {
            return;
        }
        if !is_remote(sensor) || self.parts.len() < MOST_REMOTE {
            self.follow(sensor);
        } else if !is_known(OTHERS) {
            self.robot.expect(OTHERS);
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
    use scanhub_schema::Verdict;

    #[test]
    fn remote_sensors_without_number_are_one_unknown_part() {
        let mut source = RobotSource::new(&[]);
        source.whose = Whose::All(Some(Who::Listener));
        for n in 0..1000 {
            source.meet(&format!("robot{n}.front"));
            source.meet("robot0.front");
        }
        assert_eq!((source.parts.len(), source.robot.parts.len()), (MOST_REMOTE, MOST_REMOTE + 1));
        for (name, zones) in source.robot.parts.iter_mut().filter(|(name, _)| name != OTHERS) {
            assert!(is_remote(name));
            zones.verdict = Verdict::Clear as u8;
        }
        assert_eq!((source.robot.verdict(), source.robot.worst()), (Verdict::Unknown, Some(OTHERS)));
        assert!(scanhub_schema::check_followed(OTHERS).is_err(), "no sensor has its name");
        // A hub's own sensors are as many as its configuration says.
        let mut source = RobotSource::new(&[]);
        (0..40).for_each(|n| source.meet(&format!("front{n}")));
        assert_eq!(source.parts.len(), 40);
    }

    #[test]
    fn remote_sensors_give_way_to_the_hub_and_never_the_hub_to_them() {
        let mut source = RobotSource::new(&[]);
        assert!(!source.gives_way_to(Some(Who::Hub)), "nobody is followed yet");
        source.whose = Whose::All(Some(Who::Listener));
        source.follow("robot1.front");
        source.begun = true;
        assert!(!source.gives_way_to(None) && !source.gives_way_to(Some(Who::Listener)));
        assert!(source.gives_way_to(Some(Who::Hub)));
        assert!(source.robot().sensors().next().is_none() && !source.begun, "nothing is known");
        for who in [Some(Who::Hub), None, Some(Who::Listener), Some(Who::Hub)] {
            assert!(!source.gives_way_to(who));
            assert_eq!(source.whose, Whose::All(Some(Who::Hub)));
        }
        let mut named = RobotSource::new(&["robot1.front"]);
        assert!(!named.gives_way_to(Some(Who::Hub)), "whoever names a sensor means it");
    }
}
