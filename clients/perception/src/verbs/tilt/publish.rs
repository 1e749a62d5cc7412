//! What becomes of a sweep: its points scan by scan and its obstacles get numbers, and go out as topics if they have a name.
//! Refuses to know how they are told.

use std::hash::{BuildHasher, RandomState};

use crate::tilt::{Point, Sweep};
use scanhub_client::streams::find;
use scanhub_client::{Publication, PublishSession, SensorPublisher};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Cloud, CloudHead, CloudPoint, Failure, Flags, Header, Maker, Obstacles, Wake};
use scanhub_shm::Domain;

use scanhub_verbs::names::position;

/// Sweeps as samples.
pub(super) struct Samples {
    /// What all samples have alike.
    header: Header,
    /// From CLOCK_MONOTONIC to the wall clock, in ns.
    to_wall_ns: i64,
    /// Of the last sweep.
    obstacles: Box<Obstacles>,
    of_obstacles: Header,
    topics: Option<Topics>,
}

struct Topics {
    // Before what wakes their consumers.
    cloud: Publication<Cloud>,
    obstacles: Publication<Obstacles>,
    sensor: SensorPublisher,
}

impl Samples {
    /// Of what is called `name`.
    pub(super) fn new(name: &str) -> Samples {
        let boot = RandomState::new().hash_one(std::process::id());
        let sensor = position(name);
        Samples {
            header: Header { boot, sensor, hub_pid: std::process::id(), ..Header::default() },
            to_wall_ns: 0,
            obstacles: Box::default(),
            of_obstacles: Header::default(),
            topics: None,
        }
    }

    /// Makes the topics of `name` in the domain where a hub or listener lives, for clouds of so many `beams`.
    ///
    /// [`Kind::NoHub`](scanhub_schema::Kind) if none does, [`Kind::Configuration`](scanhub_schema::Kind) if the name is not possible,
    /// [`Kind::NameHeld`](scanhub_schema::Kind) if another process has it, [`Kind::Short`](scanhub_schema::Kind) if memory or descriptors are
    /// short.
    pub(super) fn publish(&mut self, name: &str, beams: usize, places: &[Domain]) -> Result<(), Failure> {
        let limits = TopicLimits { beams, ..TopicLimits::default() };
        let sensor = PublishSession::beside(&find(places)?, name, Maker::Tilted.topics(), limits)?;
        self.topics = Some(Topics { cloud: sensor.topic()?, obstacles: sensor.topic()?, sensor });
        Ok(())
    }

    /// The topics are there.
    pub(super) fn is_published(&self) -> bool {
        self.topics.is_some()
    }

    /// A scan with this `header` came.
    pub(super) fn hear(&mut self, header: &Header) {
        self.to_wall_ns = header.wall_ns.wrapping_sub(header.stamp_last_ns) as i64;
        self.header.flags = header.flags & (Flags::SIMULATED | Flags::REPLAYED);
    }

    /// Takes a sweep, and sends it if it is published. Returns what it has found.
    pub(super) fn take(&mut self, sweep: &Sweep<'_>) -> (&Header, &Obstacles) {
        let flags = if sweep.is_complete { Obstacles::COMPLETE } else { 0 }
            | if sweep.is_doubted { Obstacles::DOUBTED } else { 0 };
        *self.obstacles = Obstacles {
            sweep: sweep.number,
            generation: sweep.generation,
            left_out: sweep.left_out,
            flags,
            ..Obstacles::default()
        };
        sweep.obstacles.iter().for_each(|one| self.obstacles.push(*one));
        self.of_obstacles = self.header(sweep.number.into(), sweep.from_ns, sweep.until_ns);
        if let Some(mut topics) = self.topics.take() {
            self.send_points(&mut topics, sweep, flags);
            // A sample without memory is a number that is missing, and who cannot be woken looks ten times a second.
            let _ = topics.obstacles.send_with(&self.of_obstacles, |sample| *sample = *self.obstacles);
            let _ = topics.sensor.wake(Wake::Telegram);
            self.topics = Some(topics);
        }
        (&self.of_obstacles, &self.obstacles)
    }

    /// A sample for each scan of `sweep`.
    fn send_points(&self, topics: &mut Topics, sweep: &Sweep<'_>, flags: u8) {
        let most = topics.sensor.limits().beams;
        let mut scans = scans(sweep.points, most).peekable();
        let mut first = Cloud::FIRST;
        while let Some(points) = scans.next() {
            let last = if scans.peek().is_none() { Cloud::LAST } else { 0 };
            let head = CloudHead {
                sweep: sweep.number,
                generation: sweep.generation,
                count: points.len() as u16,
                flags: flags | std::mem::take(&mut first) | last,
                ..CloudHead::default()
            };
            if topics.cloud.subscribers() == 0 {
                topics.cloud.skip(1);
                continue;
            }
            let times = || points.iter().map(|point| point.stamp_ns);
            let (from_ns, until_ns) = (times().min().unwrap_or(0), times().max().unwrap_or(0));
            let header = self.header(topics.cloud.next_number(), from_ns, until_ns);
            let _ = topics.cloud.send_len_with(&header, Cloud::len(points.len()), |sample| {
                for (place, point) in sample.begin(head).iter_mut().zip(points) {
                    *place = CloudPoint {
                        at: point.at,
                        beam: point.beam,
                        point_class: point.class as u8,
                        ..CloudPoint::default()
                    };
                }
            });
        }
    }

    fn header(&self, seq: u64, from_ns: u64, until_ns: u64) -> Header {
        Header {
            seq,
            topic_seq: seq,
            stamp_first_ns: from_ns,
            stamp_last_ns: until_ns,
            wall_ns: until_ns.wrapping_add_signed(self.to_wall_ns),
            ..self.header
        }
    }

    /// Samples that were not sent for lack of memory.
    pub(super) fn failed(&self) -> u64 {
        self.topics.as_ref().map_or(0, |topics| topics.cloud.failed() + topics.obstacles.failed())
    }
}

/// The points of each scan, at most so many together: in a scan the numbers of the beams grow.
fn scans(points: &[Point], most: usize) -> impl Iterator<Item = &[Point]> {
    points.chunk_by(|one, next| one.beam < next.beam).flat_map(move |scan| scan.chunks(most.max(1)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_go_scan_by_scan() {
        let point = |beam| Point { beam, ..Point::default() };
        let points = [3, 4, 7, 1, 2, 2, 0, 1, 2].map(point);
        let lengths = |most| scans(&points, most).map(<[Point]>::len).collect::<Vec<_>>();
        assert_eq!(lengths(401), [3, 2, 1, 3]);
        assert_eq!(lengths(2), [2, 1, 2, 1, 2, 1]);
        assert_eq!(scans(&[], 9).count(), 0);
    }
}
