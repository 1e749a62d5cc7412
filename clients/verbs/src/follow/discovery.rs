//! Finds the sensors to follow: all sensors of a new hub where all are wanted; a notice where a named one is missing.
//! Refuses to receive samples.

use std::time::{Duration, Instant};

use scanhub_client::streams::{GRACE, Who};
use scanhub_schema::{Failure, Kind, Topic, is_remote};

use super::{Run, Sink, Track, brings};
use crate::names::{TopicName, no_sensor, no_such_topic};
use crate::output::End;

/// Sensors of other machines that are there have been announced after so long: it is done once a second.
const ANNOUNCED: Duration = Duration::from_secs(3);
/// So often it is looked which sensors there are, while one is missing: that takes milliseconds, in which samples wait.
const ASK_EVERY: Duration = Duration::from_millis(500);

impl Run<'_> {
    /// Follows the sensors of the hub that are not followed yet, if all are wanted.
    pub(super) fn discover(&mut self, sink: &mut dyn Sink) -> Result<(), End> {
        let Some(domain) = self.session.domain().filter(|_| !self.topics.is_empty()) else { return Ok(()) };
        let Some(called) = self.discovery.call(domain, Instant::now())? else { return Ok(()) };
        for sensor in &called.sensors {
            for &topic in self.topics.iter().filter(|topic| called.may_have(sensor, **topic)) {
                let name = TopicName { sensor: sensor.clone(), topic };
                if self.tracks.iter().all(|track| track.name != name) {
                    sink.begin(&name);
                    self.tracks.push(Track::new(name));
                }
            }
        }
        Ok(())
    }

    /// A hub that is up has all its topics: a sensor that is not among them is no sensor of it.
    pub(super) fn check_sensors(&mut self, sink: &dyn Sink) -> Result<(), End> {
        // What nobody wants now is not missing: asking costs more than following.
        let is_missing = |track: &Track| sink.wants(track.name.topic) && !track.source.subscribed();
        if !self.tracks.is_empty() && !self.tracks.iter().any(is_missing) {
            return Ok(());
        }
        // Who has no descriptor to follow a topic has none to ask for it.
        if self.session.domain().is_none() || self.shortage.lasts(Instant::now()) {
            return Ok(());
        }
        if self.asked_at.is_some_and(|at| at.elapsed() < ASK_EVERY) {
            return Ok(());
        }
        self.asked_at = Some(Instant::now());
        // On a busy machine, a hub may take seconds to create its topics.
        if self.session.hub_is_starting() {
            return Ok(());
        }
        // A hub that came to a listener has to make its topics first.
        let lives = self.session.hub_lives();
        self.hub_lives_since = if lives { self.hub_lives_since.or(Some(Instant::now())) } else { None };
        let published = self.published()?;
        let mut sensors: Vec<String> = published.iter().map(|(sensor, _)| sensor.clone()).collect();
        sensors.dedup();
        let wants_all = self.tracks.iter().all(|track| track.name.is_robot());
        // Those of the hub, or where there is none, of other machines.
        let may_come = self.may_come(if lives { Who::Hub } else { Who::Listener });
        if wants_all && !may_come && sensors.iter().all(|sensor| is_remote(sensor) == lives) {
            let (what, hint) = match lives {
                true => ("the hub has no sensors", "scanhub run --link NAME=PORT"),
                false => {
                    ("no sensor of another machine is published here", "`scanhub listen` shows who sends")
                }
            };
            return Err(Failure::new(Kind::NoTopic, what, hint).into());
        }
        for track in &self.tracks {
            let sensor = &track.name.sensor;
            let is_there = track.name.is_robot() || sensors.contains(sensor) || self.may_come(brings(sensor));
            if is_missing(track) && !is_there {
                return Err(no_sensor(sensor, &sensors).into());
            }
            let topics = published.iter().filter(|(of, _)| of == sensor).map(|(_, topic)| *topic);
            let topics: Vec<Topic> = topics.collect();
            let maker = track.name.topic.maker();
            let is_other = |topic: &Topic| topic.maker() != maker;
            if !topics.is_empty() && topics.iter().all(is_other) {
                return Err(no_such_topic(&track.name, &topics).into());
            }
        }
        Ok(())
    }

    /// Who is not there may come: another machine that is switched on later, or the hub, where only a listener is yet.
    fn may_come(&self, who: Who) -> bool {
        let unbounded = !self.bounds.bounded();
        match who {
            Who::Listener => unbounded || self.started.elapsed() < ANNOUNCED,
            Who::Hub => unbounded && self.hub_lives_since.is_none_or(|since| since.elapsed() < GRACE),
        }
    }

    fn published(&self) -> Result<Vec<(String, Topic)>, Failure> {
        self.session.domain().map(scanhub_shm::published).transpose().map(Option::unwrap_or_default)
    }
}
