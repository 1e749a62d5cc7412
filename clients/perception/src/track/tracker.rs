//! Tracks people in scans, which arrive in the order of their stamps. Associates legs with tracks, starts and ends
//! tracks, and detects people who go through doors or out of the sensors' view.

use scanhub_schema::{Foreground, Scan};

use super::assignment::{Assignment, Edge};
use super::geometry::{Point, distance, distance_to_segment, dot, length2, middle, minus};
use super::passage::{ArrivedPerson, DepartedPerson, MAX_GAP_S};
use super::person::{COARSE_WEIGHT, Person, Side, TrackPhase};
use super::pose_check::PoseVotes;
use super::sensor_view::{DoorProximity, Leg, SensorView, Visibility};
use super::site::{Door, Gap, Site};
use super::{Event, Kind, MisplacedSensor, Snapshot, Track};

/// Maximum number of people who are tracked at the same time.
pub(crate) const MAX_PEOPLE: usize = 64;
/// Interval between snapshots in ns.
pub const SNAPSHOT_INTERVAL_NS: u64 = 40_000_000;

/// Gain of a leg that is exactly at its expected position. It is also the maximum ratio between a leg's squared
/// distance from that position and the variance.
const GATE: f64 = 11.0;
/// Value of [`GATE`] for a tentative person, who has a lower priority.
const GATE_TENTATIVE: f64 = 9.0;
/// Maximum distance between a person and a leg of the person, in meters.
const MAX_LEG_DISTANCE_M: f64 = 0.8;
/// Maximum distance between the legs of a person, in meters.
const MAX_STEP_WIDTH_M: f64 = 0.9;
/// Minimum distance between a new track and the legs of all tracks that are not away, in meters.
const MIN_TRACK_DISTANCE_M: f64 = 0.3;
/// Time for which sensors must see through a person's position before the person is deleted, in seconds. The first
/// constant is for a confirmed person, and the second for a tentative one.
const DELETE_AFTER_S: f64 = 0.7;
const DELETE_TENTATIVE_AFTER_S: f64 = 0.25;
/// Time without a detection after which a tentative person is deleted, in ns.
const MAX_TENTATIVE_SILENCE_NS: u64 = 400_000_000;
/// Time after which a hidden person is deleted, in ns.
const MAX_HIDDEN_NS: u64 = 120_000_000_000;
/// Maximum time between two scans of a sensor that counts in full, in seconds. A longer time is a gap, and counts only
/// as this time.
const MAX_PERIOD_S: f64 = 0.2;
/// Maximum time between two scans that count as simultaneous, in ns.
const SAME_TIME_NS: u64 = 45_000_000;
/// Minimum distance between two people, in meters. Two people who are closer are merged, unless two pairs of legs were
/// seen.
const MERGE_DISTANCE_M: f64 = 0.45;
/// Time in ns for which legs in an ignored area are associated with a confirmed person who has entered this area.
const IGNORED_GRACE_NS: u64 = 5_000_000_000;

/// Maximum time since a confirmed person was last detected, in ns. After this time, a leg that may be a part of a
/// door's leaf is not associated with the person.
const LEAF_SILENCE_NS: u64 = 300_000_000;
/// Maximum distance between a door and a person who was away, came through this door, and is first seen again in a room
/// without sensors, in meters.
const MAX_BEFORE_DOOR_M: f64 = 3.5;
/// Maximum distance that replaces [`MAX_BEFORE_DOOR_M`] for a person who is first seen again in a room with sensors.
/// Sensors in the room see people as soon as they have come through the door.
const MAX_INSIDE_DOOR_M: f64 = 1.2;
/// Minimum distance between a person and a door behind the person, in meters. At this distance, the person has gone
/// through the door.
const MIN_BEHIND_DOOR_M: f64 = 0.12;
/// Minimum distance between a confirmed person and another person who rarely shows two legs, in meters. If the other
/// person is closer, the other person counts as a part of the confirmed person.
const PART_DISTANCE_M: f64 = 0.5;
/// Maximum distance between a door that leads out of the sensors' view and the first position of a new person who has
/// come through it, in meters.
const MAX_AT_DOOR_M: f64 = 0.7;
/// Maximum distance that replaces [`MAX_AT_DOOR_M`] for a door with leaves and a person who walks away from this door.
/// The next constant is the minimum speed of this person, in m/s.
const MAX_BEFORE_LEAVES_M: f64 = 1.6;
const MIN_LEAVING_SPEED_M_S: f64 = 0.2;
/// Minimum distance between a new person and a confirmed person, in meters. If the distance is smaller, the new person
/// may be a leg of the confirmed person.
const MIN_ALONE_M: f64 = 0.9;
/// Maximum squared distance, divided by the variance, between a hidden person and a new person who may be the hidden
/// one. This limit covers 98.9 % of the normal distribution in the plane.
const HIDDEN_GATE: f64 = 9.0;
/// Maximum time for which a person in a room without sensors may be out of sight, in ns. After this time, the person is
/// away.
const AWAY_AFTER_NS: u64 = 250_000_000;

/// Number of scans in a row that must show a closed door before it counts as a door with leaves.
const MIN_CLOSED_SCANS: u32 = 20;

/// Tracks of people, with the last scans of all sensors.
pub(crate) struct Tracker {
    pub(crate) site: Site,
    watched: Vec<bool>,
    pub(crate) sensor_views: Vec<SensorView>,
    pub(crate) people: Vec<Person>,
    next_id: u64,
    events: Vec<Event>,
    assignment: Assignment,
    edges: Vec<Edge>,
    pairs: Vec<(usize, usize)>,
    scan_ns: Vec<u64>,
    /// For each door, whether it has leaves. A door that was seen closed has leaves.
    has_leaves: Vec<bool>,
    /// For each sensor and door, the number of scans in a row that showed the closed door.
    closed: Vec<Vec<u32>>,
    poses: PoseVotes,
    misplaced: Vec<MisplacedSensor>,
    /// For each sensor, two sums over the legs of walking people: offset times velocity, and squared speed. The first
    /// sum divided by the second is the mean time in seconds by which legs are ahead of their expected positions.
    pub(crate) lateness: Vec<(f64, f64)>,
}

impl Tracker {
    pub(crate) fn new(site: Site) -> Tracker {
        Tracker {
            watched: site.rooms_with_sensor(),
            sensor_views: site.sensors.iter().cloned().map(SensorView::new).collect(),
            people: Vec::with_capacity(MAX_PEOPLE),
            next_id: 1,
            events: Vec::new(),
            assignment: Assignment::default(),
            edges: Vec::new(),
            pairs: Vec::new(),
            scan_ns: vec![0; site.sensors.len()],
            has_leaves: vec![false; site.doors.len()],
            closed: vec![vec![0; site.doors.len()]; site.sensors.len()],
            poses: PoseVotes::new(site.sensors.len()),
            misplaced: Vec::new(),
            lateness: vec![(0.0, 0.0); site.sensors.len()],
            site,
        }
    }

    /// Handles the next scan in the order of time.
    pub(crate) fn take(&mut self, sensor: usize, at_ns: u64, scan: &Scan, foreground: &Foreground) {
        self.sensor_views[sensor].take(scan, foreground);
        self.detect_leaves(sensor);
        self.sensor_views[sensor].mark(&self.site, &self.has_leaves);
        let since_s = (at_ns.saturating_sub(self.scan_ns[sensor]) as f64 * 1e-9).min(MAX_PERIOD_S);
        self.scan_ns[sensor] = at_ns;
        self.compare_poses(sensor, at_ns);
        self.predict(at_ns);
        let mut pairs = std::mem::take(&mut self.pairs);
        self.associate(sensor, at_ns, &mut pairs);
        self.correct(sensor, since_s, &pairs);
        self.handle_missed_detections(sensor, since_s, &pairs);
        self.start_tracks(sensor, at_ns, &pairs);
        self.pairs = pairs;
        self.merge(at_ns);
        self.detect_crossings(at_ns);
        self.delete_lost_tracks(at_ns);
    }

    /// Corrects the position of a sensor that sees all people displaced, compared with other sensors.
    fn compare_poses(&mut self, sensor: usize, at_ns: u64) {
        for other in 0..self.sensor_views.len() {
            if other == sensor || at_ns.saturating_sub(self.scan_ns[other]) > SAME_TIME_NS {
                continue;
            }
            let legs = |sensor: usize| (sensor, self.sensor_views[sensor].legs());
            if let Some(misplaced) = self.poses.take(legs(sensor), legs(other)) {
                self.sensor_views[misplaced.sensor].shift(misplaced.offset);
                self.misplaced.push(misplaced);
            }
        }
    }

    /// Predicts the states of all people at `at_ns`. The prediction for a person who is not seen stops at walls.
    fn predict(&mut self, at_ns: u64) {
        for person in self.people.iter_mut().filter(|person| !matches!(person.phase, TrackPhase::Away { .. }))
        {
            let before = person.filter.position();
            person.predict(at_ns);
            if at_ns.saturating_sub(person.last_seen_ns) < 200_000_000 {
                continue;
            }
            let (room, after) = (self.site.room_at(before), person.filter.position());
            if self.site.room_at(after) != room {
                let door = |door: &Door| distance_to_segment(before, door.between) < 0.4;
                if !self.site.doors.iter().any(door) {
                    person.filter.stop(before);
                }
            }
        }
    }

    /// Assigns the legs that the sensor sees to people. A pair consists of the index of a leg, and twice the index of a
    /// person plus the side.
    fn associate(&mut self, sensor: usize, at_ns: u64, pairs: &mut Vec<(usize, usize)>) {
        let legs = self.sensor_views[sensor].legs();
        self.edges.clear();
        for (number, person) in self.people.iter().enumerate() {
            let gate = match person.phase {
                TrackPhase::Away { .. } => continue,
                TrackPhase::Tentative => GATE_TENTATIVE,
                TrackPhase::Known => GATE,
            };
            // Legs in the learned background keep the track of a standing person, but do not confirm a person.
            let (position, stands) = (person.filter.position(), person.is_known() && person.speed() < 0.5);
            let passes = person.is_known() && at_ns.saturating_sub(person.last_free_ns) < IGNORED_GRACE_NS;
            let is_lost = person.is_known() && at_ns.saturating_sub(person.last_seen_ns) > LEAF_SILENCE_NS;
            let reach = MAX_LEG_DISTANCE_M + 2.0 * person.filter.variance().sqrt().min(0.5);
            let expected = Side::BOTH.map(|side| person.filter.leg(side));
            for (leg, found) in legs.iter().enumerate() {
                let may_be_theirs = if found.is_ignored { passes } else { found.is_fresh || stands };
                let is_leaf = found.at_door == DoorProximity::Jamb || is_lost && may_be_leaf(found);
                if length2(minus(found.at, position)) >= reach * reach || !may_be_theirs || is_leaf {
                    continue;
                }
                for (side, (expected, variance)) in expected.into_iter().enumerate() {
                    let off2 = length2(minus(found.at, expected));
                    let variance = variance + found.sigma_m * found.sigma_m;
                    if off2 > 1.0 || off2 >= gate * variance {
                        continue;
                    }
                    let gain = gate - off2 / variance - 2.0 * (variance / 0.0025).ln().max(0.0);
                    if gain > 0.0 {
                        self.edges.push(Edge { leg, target: 2 * number + side, gain });
                    }
                }
            }
        }
        pairs.clear();
        self.assignment.solve((legs.len(), 2 * self.people.len()), &self.edges, pairs);
        // Sort by person, with the more accurate leg first.
        pairs.sort_unstable_by_key(|&(leg, target)| (target / 2, (legs[leg].sigma_m * 1e6) as u64, leg));
        let mut i = 1;
        while i < pairs.len() {
            let ((one, of), (other, and)) = (pairs[i - 1], pairs[i]);
            if of / 2 == and / 2 && distance(legs[one].at, legs[other].at) > MAX_STEP_WIDTH_M {
                pairs.remove(i);
            } else {
                i += 1;
            }
        }
    }

    fn correct(&mut self, sensor: usize, since_s: f64, pairs: &[(usize, usize)]) {
        let legs = self.sensor_views[sensor].legs();
        for of_one in pairs.chunk_by(|a, b| a.1 / 2 == b.1 / 2) {
            let person = &mut self.people[of_one[0].1 / 2];
            let (velocity, speed) = (person.filter.velocity(), person.speed());
            let mut ahead = 0.0;
            for &(leg, target) in of_one {
                let Leg { at, sigma_m, .. } = legs[leg];
                let side = Side::BOTH[target % 2];
                let off = minus(at, person.filter.leg(side).0);
                ahead += off[0] * velocity[0] + off[1] * velocity[1];
                person.filter.correct(side, at, sigma_m);
            }
            if of_one.len() == 2 && speed > 0.6 && person.phase == TrackPhase::Known {
                let (sum, weight) = &mut self.lateness[sensor];
                *sum += ahead / 2.0;
                *weight += speed * speed;
            }
            let their_legs = of_one.iter().map(|&(leg, _)| &legs[leg]);
            match their_legs.clone().filter(|leg| leg.is_solid).map(|leg| leg.beams).max() {
                Some(beams) if person.is_known() || shows_person(their_legs) => {
                    person.on_detection(sensor, since_s, of_one.len(), beams);
                }
                Some(_) => person.last_seen_ns = person.at_ns,
                None => {}
            }
            if of_one.iter().any(|&(leg, _)| !legs[leg].is_ignored) {
                person.last_free_ns = person.at_ns;
            }
        }
    }

    /// Updates the people who have no leg in `pairs`. These people are hidden, or the sensor sees through their
    /// positions.
    fn handle_missed_detections(&mut self, sensor: usize, since_s: f64, pairs: &[(usize, usize)]) {
        let view = &self.sensor_views[sensor];
        for (number, person) in self.people.iter_mut().enumerate() {
            let is_seen = |&(leg, target): &(usize, usize)| target / 2 == number && view.legs()[leg].is_solid;
            if matches!(person.phase, TrackPhase::Away { .. }) || pairs.iter().any(is_seen) {
                continue;
            }
            let position = person.filter.position();
            let sigma = person.filter.variance().sqrt();
            let share = if sigma < 0.25 {
                match view.visibility(position) {
                    Visibility::Free => 1.0,
                    Visibility::Occupied => {
                        // A person who has become background still stands at the position.
                        if person.is_known() && person.speed() < 0.4 {
                            person.absent_s = (person.absent_s - COARSE_WEIGHT * since_s).max(0.0);
                        }
                        0.0
                    }
                    Visibility::Occluded => 0.0,
                }
            } else {
                let s = 1.2 * sigma;
                let offsets = [[0.0, 0.0], [s, 0.0], [-s, 0.0], [0.0, s], [0.0, -s]];
                let through = |off: &&Point| {
                    view.visibility([position[0] + off[0], position[1] + off[1]]) == Visibility::Free
                };
                offsets.iter().filter(through).count() as f64 / 5.0
            };
            person.absent_s += share * since_s;
            if share > 0.5 {
                person.support = (person.support - 0.5).max(0.0);
            }
        }
    }

    /// Starts a track for each leg, or pair of legs, that no track explains.
    fn start_tracks(&mut self, sensor: usize, at_ns: u64, pairs: &[(usize, usize)]) {
        let legs = self.sensor_views[sensor].legs();
        let near_known = |at: Point| {
            self.people.iter().any(|person| {
                let is_near = |side| distance(person.filter.leg(side).0, at) < MIN_TRACK_DISTANCE_M;
                !matches!(person.phase, TrackPhase::Away { .. }) && Side::BOTH.into_iter().any(is_near)
            })
        };
        let mut free: Vec<usize> = (0..legs.len())
            .filter(|&leg| {
                let taken = pairs.iter().any(|&(taken, _)| taken == leg);
                let may_start =
                    legs[leg].is_fresh && legs[leg].is_solid && legs[leg].at_door < DoorProximity::Line;
                may_start && !taken && !near_known(legs[leg].at)
            })
            .collect();
        while let Some(leg) = free.pop() {
            if self.people.len() >= MAX_PEOPLE {
                return;
            }
            let off = |&&other: &&usize| distance(legs[other].at, legs[leg].at);
            let other_leg = free
                .iter()
                .filter(|other| off(other) < 0.6)
                .min_by(|a, b| off(a).total_cmp(&off(b)))
                .copied();
            free.retain(|&other| Some(other) != other_leg);
            let both = [legs[leg], other_leg.map_or(legs[leg], |other_leg| legs[other_leg])];
            let both = if other_leg.is_some() { &both[..] } else { &both[..1] };
            let mut person = Person::new(self.next_id, at_ns, both);
            person.seen_by_ns[sensor] = at_ns;
            person.room = self.site.room_at(person.first_position);
            self.next_id += 1;
            self.people.push(person);
        }
    }

    /// Merges people who share one pair of legs.
    fn merge(&mut self, at_ns: u64) {
        let mut i = 0;
        while i < self.people.len() {
            let one = &self.people[i];
            let is_same = |other: &Person| {
                if length2(minus(one.filter.position(), other.filter.position()))
                    >= MERGE_DISTANCE_M * MERGE_DISTANCE_M
                {
                    return false;
                }
                let alone = one.both + other.both < 0.35;
                let known = !matches!(one.phase, TrackPhase::Away { .. })
                    && !matches!(other.phase, TrackPhase::Away { .. });
                let grown =
                    at_ns - other.first_seen_ns > 600_000_000 && at_ns - one.first_seen_ns > 600_000_000;
                let unseen = (at_ns - one.last_seen_ns).max(at_ns - other.last_seen_ns) > 300_000_000;
                let very_near = distance(one.filter.position(), other.filter.position()) < 0.2;
                known && grown && (alone || very_near && unseen && (one.both < 0.3 || other.both < 0.3))
            };
            match (i + 1..self.people.len()).find(|&j| is_same(&self.people[j])) {
                Some(other) => {
                    // Keep the person who was confirmed first, with the filter of the person who was seen last.
                    let (keep, drop) = if self.people[other].is_known() && !self.people[i].is_known() {
                        (other, i)
                    } else {
                        (i, other)
                    };
                    if self.people[drop].last_seen_ns > self.people[keep].last_seen_ns {
                        self.people[keep].filter = self.people[drop].filter.clone();
                        self.people[keep].last_seen_ns = self.people[drop].last_seen_ns;
                    }
                    if self.people[drop].is_known() {
                        self.add_event(at_ns, drop, Kind::Left);
                    }
                    self.people.remove(drop);
                }
                None => i += 1,
            }
        }
    }

    /// Deletes people who have been out of sight for too long, who went outside, or who have stayed in an ignored area.
    /// Also deletes people if sensors have seen through their positions for long enough.
    fn delete_lost_tracks(&mut self, at_ns: u64) {
        let mut number = 0;
        while number < self.people.len() {
            let person = &self.people[number];
            let silent_ns = at_ns.saturating_sub(person.last_seen_ns);
            let (is_expired, is_reported) = match person.phase {
                TrackPhase::Tentative => (
                    person.absent_s > DELETE_TENTATIVE_AFTER_S || silent_ns > MAX_TENTATIVE_SILENCE_NS,
                    false,
                ),
                TrackPhase::Known => {
                    let is_lost = at_ns.saturating_sub(person.last_free_ns) > IGNORED_GRACE_NS
                        && self.site.is_ignored(person.filter.position());
                    (person.absent_s > DELETE_AFTER_S || silent_ns > MAX_HIDDEN_NS || is_lost, true)
                }
                TrackPhase::Away { since_ns, .. } => {
                    let away_s = at_ns.saturating_sub(since_ns) as f64 * 1e-9;
                    (person.room.is_none() || away_s > 5.0 * MAX_GAP_S, true)
                }
            };
            if is_expired {
                if is_reported {
                    self.add_event(at_ns, number, Kind::Left);
                }
                self.people.remove(number);
            } else {
                number += 1;
            }
        }
    }

    /// Returns the number of elements for which memory is allocated.
    #[cfg(test)]
    pub(crate) fn capacity(&self) -> usize {
        let views: usize = self.sensor_views.iter().map(SensorView::capacity).sum();
        let lists = self.edges.capacity() + self.pairs.capacity() + self.assignment.capacity();
        views + lists + self.people.capacity() + self.events.capacity() + self.misplaced.capacity()
    }

    fn add_event(&mut self, wall_ns: u64, number: usize, kind: Kind) {
        let Person { id, room, .. } = self.people[number];
        self.events.push(Event { wall_ns, id, room, kind });
    }

    /// Writes the snapshot at `at_ns`, which must not be before the last scan.
    pub(crate) fn write_snapshot(&mut self, at_ns: u64, picture: &mut Snapshot) {
        picture.wall_ns = at_ns;
        picture.tracks.clear();
        picture.tracks.extend(self.people.iter().map(|person| {
            let ahead = at_ns.saturating_sub(person.at_ns).min(200_000_000) as f64 * 1e-9;
            let (position, velocity) = (person.filter.position(), person.filter.velocity());
            let variance = person.filter.variance();
            let is_away = matches!(person.phase, TrackPhase::Away { .. });
            let ahead = if is_away { 0.0 } else { ahead };
            Track {
                id: person.id,
                state: person.state(at_ns),
                position: [position[0] + ahead * velocity[0], position[1] + ahead * velocity[1]],
                velocity,
                covariance: [variance, 0.0, variance],
                room: person.room,
                sensors: person.sensors(at_ns),
                age_s: at_ns.saturating_sub(person.first_seen_ns) as f64 * 1e-9,
                score: 1.0 - (-person.support / 5.0).exp(),
            }
        }));
        picture.tracks.sort_unstable_by_key(|track| track.id);
        picture.events.clear();
        picture.events.append(&mut self.events);
        picture.misplaced.clear();
        picture.misplaced.append(&mut self.misplaced);
    }

    /// Detects doors with leaves. Only these doors can be closed.
    fn detect_leaves(&mut self, sensor: usize) {
        let doors = self.site.doors.iter().zip(&mut self.has_leaves).zip(&mut self.closed[sensor]);
        for ((door, has_leaves), closed) in doors.filter(|((_, has_leaves), _)| !**has_leaves) {
            if self.sensor_views[sensor].is_closed(door.between) {
                *closed += 1;
                *has_leaves = *closed >= MIN_CLOSED_SCANS;
            } else {
                *closed = 0;
            }
        }
    }

    /// Confirms people, and detects those who go through doors or out of the sensors' view.
    fn detect_crossings(&mut self, at_ns: u64) {
        let mut number = 0;
        while number < self.people.len() {
            let person = &self.people[number];
            if person.phase == TrackPhase::Tentative {
                if person.is_certain() && !self.is_part_of_another(number) {
                    self.confirm(number, at_ns);
                    continue;
                }
            } else if person.is_known() {
                self.detect_crossing(number, at_ns);
            }
            number += 1;
        }
    }

    /// Returns the hidden person who was most likely at `position` at the time `then_ns`, in the room of `position`.
    fn hidden_near(&self, position: Point, then_ns: u64) -> Option<usize> {
        let room = self.site.room_at(position);
        let off2 = |(number, person): (usize, &Person)| {
            let is_hidden = person.is_known() && person.last_seen_ns + AWAY_AFTER_NS < person.at_ns;
            let is_candidate = is_hidden && person.last_seen_ns <= then_ns && person.room == room;
            let off = distance(position, person.filter.position());
            let off2 = off * off / (person.filter.variance() + 0.04);
            (is_candidate && off2 < HIDDEN_GATE).then_some((off2, number))
        };
        let near = self.people.iter().enumerate().filter_map(off2);
        near.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, number)| number)
    }

    /// Returns whether a person is only a leg of another person, whom a sensor sees.
    fn is_part_of_another(&self, number: usize) -> bool {
        let one = &self.people[number];
        let near = |other: &Person| {
            other.is_known()
                && one.at_ns.saturating_sub(other.last_seen_ns) < AWAY_AFTER_NS
                && distance(one.filter.position(), other.filter.position()) < PART_DISTANCE_M
        };
        one.both < 0.3 && self.people.iter().any(near)
    }

    fn detect_crossing(&mut self, number: usize, at_ns: u64) {
        let person = &self.people[number];
        let (position, from) = (person.filter.position(), person.room);
        let to = self.site.room_at(position);
        if to != from {
            let joins = |&door: &usize| [[from, to], [to, from]].contains(&self.site.doors[door].rooms());
            let door = self.site.nearest_door(position, joins);
            let behind = |door: usize| distance_to_segment(position, self.site.doors[door].between);
            match door.filter(|&door| behind(door) < 1.5) {
                Some(door) if behind(door) > MIN_BEHIND_DOOR_M => {
                    (self.people[number].room, self.people[number].entry_door) = (to, Some(door));
                    self.add_event(at_ns, number, Kind::Door { door, from, to });
                }
                // The person was not seen at a door, or is inside a wall.
                None if to.is_some() && at_ns - person.last_seen_ns < AWAY_AFTER_NS => {
                    (self.people[number].room, self.people[number].entry_door) = (to, None);
                }
                _ => {}
            }
        }
        let person = &self.people[number];
        let is_watched = person.room.is_some_and(|room| self.watched[room]);
        if !is_watched && at_ns - person.last_seen_ns > AWAY_AFTER_NS {
            let (room, position, since_ns) = (person.room, person.filter.position(), person.last_seen_ns);
            let leads = |door: &usize| self.site.doors[*door].rooms().contains(&room);
            let nearest = || self.site.nearest_door(position, leads);
            if let Some(door) = person.entry_door.filter(leads).or_else(nearest) {
                self.people[number].phase = TrackPhase::Away { since_ns, door };
            }
        }
    }

    /// Returns whether a new person has come through a door that leads out of the sensors' view. The person must be
    /// first seen near the door. Near a door with leaves, people are not confirmed, so the person may be first seen
    /// farther away from it. In this case, the person has come through the door if they walk away from the door and are
    /// not a leg of a confirmed person.
    fn has_passed_door(&self, number: usize, door: usize) -> bool {
        let person = &self.people[number];
        let off_m = self.site.distance_to_door(person.first_position, door);
        if off_m < MAX_AT_DOOR_M || !self.has_leaves[door] {
            return off_m < MAX_AT_DOOR_M;
        }
        let (position, away) =
            (person.filter.position(), minus(person.first_position, middle(self.site.doors[door].between)));
        let walks_away = dot(away, person.filter.velocity()) > MIN_LEAVING_SPEED_M_S * length2(away).sqrt();
        let near =
            |other: &Person| other.is_known() && distance(other.filter.position(), position) < MIN_ALONE_M;
        let is_alone = self.people.iter().filter(|other| other.id != person.id).all(|other| !near(other));
        off_m < MAX_BEFORE_LEAVES_M && walks_away && is_alone
    }

    /// Confirms a new person. If the new person is one who was away or hidden, continues the track of that person
    /// instead.
    fn confirm(&mut self, number: usize, at_ns: u64) {
        let new = &self.people[number];
        let (first_position, first_seen_ns) = (new.first_position, new.first_seen_ns);
        let off = |door: usize| distance_to_segment(first_position, self.site.doors[door].between);
        let is_inside = self.site.room_at(first_position).is_some_and(|room| self.watched[room]);
        let before_door_m = if is_inside { MAX_INSIDE_DOOR_M } else { MAX_BEFORE_DOOR_M };
        // Candidates are all people who are away, each with the door through which the person would have come.
        let arrival = |(old, person): (usize, &Person)| {
            let TrackPhase::Away { door: entry, .. } = person.phase else { return None };
            let exit = self.site.nearest_door(first_position, |door| {
                let is_gap = |gap: &Gap| gap.doors.contains(&entry) && gap.doors.contains(door);
                let leads = self.site.doors[*door].rooms().contains(&person.room);
                (leads || self.site.gaps.iter().any(is_gap)) && off(*door) < before_door_m
            })?;
            let after_s = (first_seen_ns as f64 - person.at_ns as f64) * 1e-9;
            // Exclude a person who was still seen when the new person appeared.
            let distance_m = distance(first_position, person.filter.position());
            if after_s < -0.75 || after_s < -0.25 && distance_m > 0.7 {
                return None;
            }
            let departed = DepartedPerson {
                entry: person.entry_door,
                at: person.filter.position(),
                speed: person.speed(),
                pace: person.pace,
            };
            let arrived = ArrivedPerson {
                exit,
                at: first_position,
                velocity: new.filter.velocity(),
                is_out: is_inside,
            };
            Some((self.site.likelihood(&departed, &arrived, after_s), old, exit))
        };
        let best = self.people.iter().enumerate().filter_map(arrival).max_by(|a, b| a.0.total_cmp(&b.0));
        let best = best.filter(|best| best.0 > 1e-4).map(|(_, old, exit)| (old, Some(exit)));
        match self.hidden_near(first_position, first_seen_ns).map(|old| (old, None)).or(best) {
            Some((old, exit)) => {
                let mut new = self.people.remove(number);
                let old = if old > number { old - 1 } else { old };
                let known = &mut self.people[old];
                let from = known.room;
                (new.id, new.first_seen_ns, new.pace, new.phase) =
                    (known.id, known.first_seen_ns, known.pace, TrackPhase::Known);
                new.room = self.site.room_at(new.filter.position()).or(new.room);
                let to = new.room;
                new.entry_door = if from == to { known.entry_door } else { exit };
                self.people[old] = new;
                if let Some(door) = exit.filter(|_| from != to) {
                    self.add_event(at_ns, old, Kind::Door { door, from, to });
                }
            }
            None => {
                self.people[number].phase = TrackPhase::Known;
                // A person near a door that leads out of the sensors' view has come through it.
                let leads = |&door: &usize| {
                    let ends = self.site.doors[door].rooms();
                    let is_unseen = |room: &Option<usize>| room.is_none_or(|room| !self.watched[room]);
                    ends.contains(&self.people[number].room) && ends.iter().any(is_unseen)
                };
                let is_entry = |&door: &usize| self.has_passed_door(number, door);
                let door = (0..self.site.doors.len()).filter(leads).find(is_entry);
                let room = self.people[number].room;
                let is_watched = room.is_some_and(|room| self.watched[room]);
                self.add_event(at_ns, number, Kind::Appeared);
                if let Some(door) = door.filter(|_| is_watched) {
                    let ends = self.site.doors[door].rooms();
                    let from = if ends[0] == room { ends[1] } else { ends[0] };
                    self.add_event(at_ns, number, Kind::Door { door, from, to: room });
                }
            }
        }
    }
}

/// Returns whether a leg may be a part of a door's leaf.
fn may_be_leaf(leg: &Leg) -> bool {
    match leg.at_door {
        DoorProximity::Clear => false,
        DoorProximity::Swing => !leg.is_free,
        DoorProximity::Line | DoorProximity::Jamb => true,
    }
}

/// Returns whether the legs of one scan are evidence for a person: one leg that no leaf of a door reaches, or two
/// adjacent free legs.
fn shows_person<'a>(legs: impl Iterator<Item = &'a Leg> + Clone) -> bool {
    let is_clear = |leg: &Leg| leg.at_door == DoorProximity::Clear;
    legs.clone().any(is_clear) || legs.filter(|leg| !may_be_leaf(leg)).count() == 2
}
