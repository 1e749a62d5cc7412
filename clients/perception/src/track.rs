//! Tracks people across the sensors and rooms of a site. The input is the scans of several sensors with their
//! foregrounds, and the output is people with IDs.
//!
//! A [`Site`] describes sensors, rooms and doors. [`PeopleTracker`] takes scans with their foregrounds and returns
//! [`Snapshot`]s: the tracks at one time, and the events since the previous snapshot. It processes the scans of all
//! sensors in the order of their stamps, and waits for late scans for a limited time. It also estimates the offsets
//! between the clocks of the hubs.
//!
//! The module uses neither a clock nor I/O. All times are stamps of the samples (`wall_ns`), so a recording gives the
//! same tracks at any speed.

mod assignment;
pub mod geometry;
mod passage;
mod person;
mod pose_check;
mod sensor_view;
pub mod site;
mod tracker;

use std::collections::VecDeque;

use scanhub_schema::{EventKind, Foreground, Pose, Scan, TrackSensor, TrackState, Tracks};
use serde::Serialize;

use self::geometry::Point;
use self::site::Sensor;
pub use self::site::Site;
pub use self::tracker::SNAPSHOT_INTERVAL_NS;
use self::tracker::{MAX_PEOPLE, Tracker};

/// Maximum number of waiting scans of a sensor. If one more scan arrives, the oldest scan is processed at once.
const MAX_WAITING_SCANS: usize = 64;
/// Maximum difference between a stamp and the latest stamp of all scans, in ns. A larger difference counts as a jump of
/// the clock.
const CLOCK_JUMP_NS: u64 = 2_000_000_000;
/// Maximum number of stamps in a row that are rejected because they differ by more than [`CLOCK_JUMP_NS`]. The next
/// stamp is accepted as the new time.
const MAX_JUMPS: u32 = 50;
/// Share of an offset between two clocks that one correction removes.
const CORRECTION_GAIN: f64 = 0.05;
/// Minimum weight of the observations that a correction of an offset needs, in (m/s)2. Each observation of a walking
/// person has the squared speed as its weight.
const MIN_WEIGHT: f64 = 40.0;
/// Maximum offset between the clocks of two hubs, in ns.
const MAX_OFFSET_NS: f64 = 250e6;

/// Counters since the creation of the tracker.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Processed scans.
    pub scans: u64,
    /// Scans that were dropped because they arrived later than the tracker waits.
    pub late: u64,
    /// Scans that were dropped because their stamps differ by more than 2 s from the latest stamp of all scans.
    pub jumped: u64,
    /// Scans that were dropped because they have no beams, because their foreground has another number of beams, or
    /// because their sensor is not in the site.
    pub invalid: u64,
}

struct WaitingScan {
    /// Stamp of the scan. The offset of the clock is subtracted when the scan is processed.
    wall_ns: u64,
    scan: Box<Scan>,
    foreground: Box<Foreground>,
}

/// Tracker of people with the scans of a site's sensors.
pub struct PeopleTracker {
    tracker: Tracker,
    delay_ns: u64,
    /// Scans of each sensor in the order of their stamps.
    queues: Vec<VecDeque<WaitingScan>>,
    /// Hub of each sensor, given as the index of the hub's first sensor.
    hub_of: Vec<usize>,
    /// Offset of each hub's clock from the clock of the first hub, in ns, at the index of the hub's first sensor.
    offsets: Vec<f64>,
    /// Latest stamp of all received scans.
    latest_ns: u64,
    /// Stamp of the last processed scan.
    taken_ns: u64,
    next_snapshot_ns: u64,
    jumps: u32,
    counts: Counts,
    /// Number of late scans of each sensor.
    late: Vec<u64>,
    snapshot: Snapshot,
    spare_scans: Vec<WaitingScan>,
}

impl PeopleTracker {
    /// Creates a tracker that waits up to `delay_ns` for late scans.
    pub fn new(site: Site, delay_ns: u64) -> PeopleTracker {
        let hub_of = site
            .sensors
            .iter()
            .map(|one| site.sensors.iter().position(|other| other.hub() == one.hub()).unwrap_or_default());
        let hub_of: Vec<usize> = hub_of.collect();
        let count = site.sensors.len();
        PeopleTracker {
            tracker: Tracker::new(site),
            delay_ns,
            queues: (0..count).map(|_| VecDeque::with_capacity(MAX_WAITING_SCANS)).collect(),
            hub_of,
            offsets: vec![0.0; count],
            latest_ns: 0,
            taken_ns: 0,
            next_snapshot_ns: 0,
            jumps: 0,
            counts: Counts::default(),
            late: vec![0; count],
            snapshot: Snapshot::default(),
            spare_scans: Vec::new(),
        }
    }

    /// Returns the site.
    pub fn site(&self) -> &Site {
        &self.tracker.site
    }

    /// Returns the counters.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Returns the number of late scans of each sensor, by the sensor's index in the site. The sum is [`Counts::late`].
    pub fn late(&self) -> &[u64] {
        &self.late
    }

    /// Returns the estimated offset between the clock that stamps `sensor` and the first sensor's clock, in seconds.
    /// The offset is computed from people whom both sensors see.
    pub fn offset_s(&self, sensor: usize) -> f64 {
        self.hub_of.get(sensor).map_or(0.0, |&hub| self.offsets[hub] * 1e-9)
    }

    /// Handles a scan of a sensor, with the scan's foreground and wall clock stamp. `sensor` is the index of the sensor
    /// in the site. Passes every due snapshot to `show`. Scans that arrive within the tracker's delay are processed in
    /// the order of their stamps.
    pub fn take(
        &mut self,
        sensor: usize,
        wall_ns: u64,
        scan: &Scan,
        foreground: &Foreground,
        mut show: impl FnMut(&Snapshot),
    ) {
        if sensor >= self.queues.len() || usize::from(foreground.count) != scan.beams() || scan.beams() == 0 {
            self.counts.invalid += 1;
            return;
        }
        let at_ns = self.corrected(sensor, wall_ns);
        if self.latest_ns > 0 && at_ns.abs_diff(self.latest_ns) > CLOCK_JUMP_NS && !self.is_new_time(at_ns) {
            self.counts.jumped += 1;
            return;
        }
        if at_ns <= self.taken_ns {
            self.counts.late += 1;
            self.late[sensor] += 1;
            return;
        }
        self.jumps = 0;
        self.latest_ns = self.latest_ns.max(at_ns);
        let mut one = self.spare_scans.pop().unwrap_or_else(|| WaitingScan {
            wall_ns,
            scan: scan.boxed(),
            foreground: foreground.boxed(),
        });
        one.wall_ns = wall_ns;
        Scan::grow(&mut one.scan, scan.bytes().len());
        Foreground::grow(&mut one.foreground, foreground.bytes().len());
        one.scan.copy_from(scan.bytes());
        one.foreground.copy_from(foreground.bytes());
        let queue = &mut self.queues[sensor];
        let index = queue.partition_point(|other| other.wall_ns <= wall_ns);
        queue.insert(index, one);
        let until_ns = self.latest_ns.saturating_sub(self.delay_ns);
        self.advance(until_ns, &mut show);
    }

    /// Processes all waiting scans, at the end of a recording.
    pub fn finish(&mut self, mut show: impl FnMut(&Snapshot)) {
        self.advance(u64::MAX, &mut show);
    }

    /// Converts a stamp of `sensor` to the clock of the first sensor.
    fn corrected(&self, sensor: usize, wall_ns: u64) -> u64 {
        wall_ns.saturating_add_signed(-(self.offsets[self.hub_of[sensor]] as i64))
    }

    fn advance(&mut self, until_ns: u64, show: &mut impl FnMut(&Snapshot)) {
        loop {
            let first = |sensor: usize, queue: &VecDeque<WaitingScan>| {
                queue.front().map(|one| self.corrected(sensor, one.wall_ns))
            };
            let fronts = self.queues.iter().enumerate().filter_map(|(i, queue)| Some((first(i, queue)?, i)));
            let Some((at_ns, sensor)) = fronts.min() else { break };
            let is_full = self.queues.iter().any(|queue| queue.len() > MAX_WAITING_SCANS);
            if at_ns > until_ns && !is_full {
                break;
            }
            // A correction of the offset can make the corrected stamps step backward.
            let at_ns = at_ns.max(self.taken_ns + 1);
            if self.next_snapshot_ns == 0 {
                self.next_snapshot_ns = (at_ns / SNAPSHOT_INTERVAL_NS + 1) * SNAPSHOT_INTERVAL_NS;
            }
            self.snapshots_until(at_ns, show);
            if let Some(one) = self.queues[sensor].pop_front() {
                self.tracker.take(sensor, at_ns, &one.scan, &one.foreground);
                self.spare_scans.push(one);
                self.counts.scans += 1;
                self.taken_ns = at_ns;
                self.compare_clocks();
            }
        }
        // Scans that may still arrive cannot change these snapshots.
        if until_ns < u64::MAX && self.next_snapshot_ns > 0 && self.next_snapshot_ns <= until_ns {
            self.snapshots_until(until_ns + 1, show);
            self.taken_ns = self.taken_ns.max(self.next_snapshot_ns - SNAPSHOT_INTERVAL_NS);
        }
    }

    /// Passes the snapshots before `at_ns` to `show`.
    fn snapshots_until(&mut self, at_ns: u64, show: &mut impl FnMut(&Snapshot)) {
        if at_ns.saturating_sub(self.next_snapshot_ns) > CLOCK_JUMP_NS {
            self.next_snapshot_ns = (at_ns / SNAPSHOT_INTERVAL_NS) * SNAPSHOT_INTERVAL_NS;
        }
        while self.next_snapshot_ns < at_ns {
            self.tracker.write_snapshot(self.next_snapshot_ns, &mut self.snapshot);
            show(&self.snapshot);
            self.next_snapshot_ns += SNAPSHOT_INTERVAL_NS;
        }
    }

    /// Counts a stamp that differs much from the current time. After enough of these stamps in a row, returns true,
    /// because the clock was set.
    fn is_new_time(&mut self, at_ns: u64) -> bool {
        self.jumps += 1;
        let is_new = self.jumps > MAX_JUMPS;
        if is_new {
            self.jumps = 0;
            self.latest_ns = at_ns;
            self.taken_ns = at_ns - 1;
            self.next_snapshot_ns = 0;
            self.queues.iter_mut().for_each(VecDeque::clear);
        }
        is_new
    }

    /// Estimates the offsets of the clocks. If a sensor's clock lags, the sensor sees a walking person ahead of the
    /// expected position. If the clock leads, the sensor sees the person behind the expected position.
    fn compare_clocks(&mut self) {
        for (sensor, &hub) in self.hub_of.iter().enumerate() {
            if hub == 0 || hub != sensor {
                continue;
            }
            let sum = |is_of: &dyn Fn(usize) -> bool| {
                let all = self.tracker.lateness.iter().zip(&self.hub_of).filter(|(_, hub)| is_of(**hub));
                all.fold((0.0, 0.0), |sum, ((a, b), _)| (sum.0 + a, sum.1 + b))
            };
            let (own, others) = (sum(&|of| of == hub), sum(&|of| of == 0));
            if own.1 < MIN_WEIGHT || others.1 < MIN_WEIGHT {
                continue;
            }
            let ahead_s = own.0 / own.1 - others.0 / others.1;
            let gain = CORRECTION_GAIN;
            self.offsets[hub] = (self.offsets[hub] - gain * 1e9 * ahead_s * OFFSET_FEEDBACK)
                .clamp(-MAX_OFFSET_NS, MAX_OFFSET_NS);
            for (of, lateness) in self.hub_of.iter().zip(&mut self.tracker.lateness) {
                if *of == hub || *of == 0 {
                    *lateness = (0.0, 0.0);
                }
            }
        }
    }
}

/// Ratio of the real offset to the measured offset. The filter partly follows each sensor, so only a part of the offset
/// can be measured.
const OFFSET_FEEDBACK: f64 = 3.0;

/// Track of a person at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Track {
    /// ID of the track, which is never reused.
    pub id: u64,
    /// State of the track.
    pub state: TrackState,
    /// Middle between the legs, in the map, in meters.
    pub position: Point,
    /// Velocity in m/s.
    pub velocity: Point,
    /// Covariance of the position in m2: xx, xy and yy.
    pub covariance: [f64; 3],
    /// Index of the room in the site.
    pub room: Option<usize>,
    /// Sensors that see the person: bit i stands for the sensor with index i in the site.
    pub sensors: u32,
    /// Seconds since the person was first seen.
    pub age_s: f64,
    /// Confidence that the track is a person, 0 to 1.
    pub score: f64,
}

/// Kind of an event.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    /// The person is confirmed.
    Appeared,
    /// The person is no longer tracked.
    Left,
    /// The person went through a door from one room to another. `None` stands for outside.
    Door {
        /// Index of the door in the site.
        door: usize,
        /// Index of the room that the person left.
        from: Option<usize>,
        /// Index of the room that the person entered.
        to: Option<usize>,
    },
}

/// An event.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Event {
    /// Time in ns since 1970.
    pub wall_ns: u64,
    /// ID of the person's track.
    pub id: u64,
    /// Index of the person's room after the event; `None` outside all rooms.
    pub room: Option<usize>,
    /// Kind of the event.
    pub kind: Kind,
}

/// A sensor that is not at its position in the site. The tracker has detected this by comparison with another sensor
/// that sees the same people. From now on, it corrects the position of the misplaced sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MisplacedSensor {
    /// Index of the sensor in the site.
    pub sensor: usize,
    /// Index of the sensor with which `sensor` was compared.
    pub other: usize,
    /// Vector from the position at which `other` sees a person to the position at which `sensor` sees the same person,
    /// in the map, in meters.
    pub offset: Point,
}

/// All tracks at one time, and the events since the previous snapshot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Snapshot {
    /// Time of all positions in ns since 1970.
    pub wall_ns: u64,
    /// Tracks in the order of their IDs.
    pub tracks: Vec<Track>,
    /// Events in order of time.
    pub events: Vec<Event>,
    /// Sensors that were found misplaced since the previous snapshot.
    pub misplaced: Vec<MisplacedSensor>,
}

impl Snapshot {
    /// Returns the payload for publication, with the names in `site`.
    pub fn payload(&self, site: &Site) -> Tracks {
        let mut tracks = Tracks::default();
        site.sensors.iter().for_each(|sensor| tracks.push_sensor(sensor.payload()));
        self.tracks.iter().for_each(|track| tracks.push(track.payload(site)));
        tracks
    }
}

impl Sensor {
    fn payload(&self) -> TrackSensor {
        let [x_m, y_m] = self.position;
        let upside_down = u8::from(self.is_upside_down);
        let pose = Pose { x_m, y_m, yaw_rad: self.yaw_rad, upside_down, ..Pose::default() };
        TrackSensor::new(&self.name, &pose)
    }
}

impl Track {
    fn payload(&self, site: &Site) -> scanhub_schema::Track {
        let mut track = scanhub_schema::Track {
            id: self.id,
            x_m: self.position[0] as f32,
            y_m: self.position[1] as f32,
            vx_m_s: self.velocity[0] as f32,
            vy_m_s: self.velocity[1] as f32,
            covariance: self.covariance.map(|value| value as f32),
            score: self.score as f32,
            age_ms: (1000.0 * self.age_s) as u32,
            sensors: self.sensors,
            state: self.state as u8,
            ..scanhub_schema::Track::default()
        };
        track.set_room(self.room.and_then(|room| site.rooms.get(room)).map_or("", |room| &room.name));
        track
    }
}

impl Event {
    /// Returns the payload for publication, with the names in `site`.
    pub fn payload(&self, site: &Site) -> scanhub_schema::Event {
        let room = self.room.and_then(|room| site.rooms.get(room)).map(|room| room.name.as_str());
        let of = |kind| scanhub_schema::Event::new(kind, self.id, room);
        match self.kind {
            Kind::Appeared => of(EventKind::Appeared),
            Kind::Left => of(EventKind::Left),
            Kind::Door { door, from, to } => {
                let name = site.doors.get(door).map_or("", |door| &door.name);
                of(EventKind::Door).with_door(name, site.room_name(from), site.room_name(to))
            }
        }
    }
}

const _: () = assert!(
    MAX_PEOPLE == scanhub_schema::MAX_TRACKS && site::MAX_SENSORS == scanhub_schema::MAX_TRACK_SENSORS
);

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use scanhub_preprocess::background::{BackgroundModel, Settings};
    use scanhub_schema::ScanHead;

    use super::*;

    const ROOM: &str = r#"
[[sensor]]
name = "front"
pose = { x = 0.1, y = 3.0, yaw = 0.0 }
[[room]]
name = "hall"
polygon = [[0, 0], [6, 0], [6, 6], [0, 6]]
"#;
    const BEAMS: usize = 361;
    const SCANS: usize = 75;

    fn capacity(people: &PeopleTracker) -> usize {
        let queues: usize = people.queues.iter().map(VecDeque::capacity).sum();
        let picture = people.snapshot.tracks.capacity() + people.snapshot.events.capacity();
        people.tracker.capacity() + queues + people.spare_scans.capacity() + picture
    }

    /// Returns a scan of a sensor with a wall at 3 m in all directions. `legs` is the beam around which two legs stand
    /// at 2 m.
    fn scan(legs: Option<usize>) -> Box<Scan> {
        let head = ScanHead {
            first_angle: -std::f64::consts::FRAC_PI_2,
            step: std::f64::consts::PI / 360.0,
            unit_um: 1000,
            valid_to: 8182,
            no_return: 8191,
            beyond: 8191,
            ..ScanHead::default()
        };
        let is_leg = |beam: usize| legs.is_some_and(|middle| (3..=8).contains(&beam.abs_diff(middle)));
        let words: Vec<u16> = (0..BEAMS).map(|beam| if is_leg(beam) { 2000 } else { 3000 }).collect();
        Scan::of(head, &words)
    }

    #[test]
    fn memory_is_constant_and_track_ids_are_never_reused() {
        let site = Site::parse("room.toml", ROOM).expect("a room");
        let mut people = PeopleTracker::new(site, 80_000_000);
        let mut model = BackgroundModel::new(Settings::default(), BEAMS);
        let (mut foreground, mut now_ns) = (Foreground::of(BEAMS), 1_700_000_000_000_000_000);
        let (mut deleted, mut present) = (BTreeSet::new(), BTreeSet::new());
        let mut turn = |people: &mut PeopleTracker, legs: Option<usize>| {
            let scan = scan(legs);
            model.update(&scan, &mut foreground);
            now_ns += SNAPSHOT_INTERVAL_NS;
            people.take(0, now_ns, &scan, &foreground, |picture| {
                let now: BTreeSet<u64> = picture.tracks.iter().map(|track| track.id).collect();
                deleted.extend(present.difference(&now).copied());
                assert!(now.is_disjoint(&deleted), "{now:?} after {deleted:?}");
                present = now;
            });
        };
        (0..300).for_each(|_| turn(&mut people, None));
        let mut visit = |people: &mut PeopleTracker, number: usize| {
            // In 40 of 75 scans, a person walks past. The track of this person is deleted before the next person
            // arrives.
            for i in 0..SCANS {
                turn(people, (i < 40).then_some(60 + number % 100 + 3 * i));
            }
        };
        // Walk each path once.
        (0..100).for_each(|number| visit(&mut people, number));
        let begin = capacity(&people);
        (100..300).for_each(|number| visit(&mut people, number));
        assert_eq!(capacity(&people), begin);
        assert!(deleted.len() >= 200, "{}", deleted.len());
        assert_eq!(people.counts().late, 0);
    }

    #[test]
    fn samples_are_published_when_the_delay_has_elapsed() {
        const MS: u64 = 1_000_000;
        const BEGIN: u64 = 1_700_000_000_000_000_000;
        let mut people = PeopleTracker::new(Site::parse("room.toml", ROOM).expect("a room"), 80 * MS);
        let (scan, foreground) = (scan(None), Foreground::of(BEAMS));
        let mut take = |after_ms: u64| {
            let mut snapshots = Vec::new();
            let show = |snapshot: &Snapshot| snapshots.push((snapshot.wall_ns - BEGIN) / MS);
            people.take(0, BEGIN + after_ms * MS, &scan, &foreground, show);
            (snapshots, people.counts().late)
        };
        assert_eq!([take(0), take(100)], [(vec![], 0), (vec![], 0)]);
        assert_eq!(take(200), (vec![40, 80, 120], 0));
        assert_eq!(take(110), (vec![], 1), "a picture that was shown holds");
        assert_eq!(take(240), (vec![160], 1));
    }
}
