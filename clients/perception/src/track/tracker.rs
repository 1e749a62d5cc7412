//! Tracks people from scans in the order of their stamps: association of legs with tracks, track initiation and deletion, and
//! people who go through doors or where no sensor looks.

use scanhub_schema::{Foreground, Scan};

use super::assignment::{Assignment, Edge};
use super::geometry::{Point, distance, distance_to_segment, dot, length2, middle, minus};
use super::passage::{ArrivedPerson, DepartedPerson, MAX_GAP_S};
use super::person::{COARSE_WEIGHT, Person, Side, TrackPhase};
use super::pose_check::PoseVotes;
use super::sensor_view::{DoorProximity, Leg, SensorView, Visibility};
use super::site::{Door, Gap, Site};
use super::{Event, Kind, MisplacedSensor, Snapshot, Track};

/// Maximum number of people at a time.
pub(crate) const MAX_PEOPLE: usize = 64;
/// Interval between snapshots.
pub const SNAPSHOT_INTERVAL_NS: u64 = 40_000_000;

/// Gain of a leg exactly at its expected position, and limit of a leg's squared distance over its variance.
const GATE: f64 = 11.0;
/// The same for a tentative person, who has lower priority.
const GATE_TENTATIVE: f64 = 9.0;
/// Maximum distance of a leg from its person.
const MAX_LEG_DISTANCE_M: f64 = 0.8;
/// Maximum distance between the legs of a person.
const MAX_STEP_WIDTH_M: f64 = 0.9;
/// Minimum distance of a new track from the legs of every track that is not away.
const MIN_TRACK_DISTANCE_M: f64 = 0.3;
/// Time after which a person is deleted whose position sensors see through.
const DELETE_AFTER_S: f64 = 0.7;
const DELETE_TENTATIVE_AFTER_S: f64 = 0.25;
/// Time after which a tentative person is deleted who is not seen.
const MAX_TENTATIVE_SILENCE_NS: u64 = 400_000_000;
/// Time after which a hidden person is deleted.
const MAX_HIDDEN_NS: u64 = 120_000_000_000;
/// Maximum period of a sensor. A longer one is a gap.
const MAX_PERIOD_S: f64 = 0.2;
/// Maximum time between two scans that show the same.
const SAME_TIME_NS: u64 = 45_000_000;
/// Two people who are nearer to each other, and who never show two pairs of legs, are one.
const MERGE_DISTANCE_M: f64 = 0.45;
/// Time for which a known person who went into an ignored area may be associated with the legs in it.
const IGNORED_GRACE_NS: u64 = 5_000_000_000;

/// A known person who was not seen for this time is not found again by a leg that may be a part of a leaf.
const LEAF_SILENCE_NS: u64 = 300_000_000;
/// Maximum distance from a door at which a person is first seen who comes out of it.
const MAX_BEFORE_DOOR_M: f64 = 3.5;
/// The same in a room with sensors, where they are seen as soon as they have come through.
const MAX_INSIDE_DOOR_M: f64 = 1.2;
/// Minimum distance behind a door of a person who has gone through it.
const MIN_BEHIND_DOOR_M: f64 = 0.12;
/// A person who is nearer to a confirmed one, and never shows two legs, is a part of them.
const PART_DISTANCE_M: f64 = 0.5;
/// Maximum distance from a door at which a person is first seen who has come through it, in meters.
const MAX_AT_DOOR_M: f64 = 0.7;
/// This distance for a door with leaves, if the person walks away from it at least at the speed below, in m/s.
const MAX_BEFORE_LEAVES_M: f64 = 1.6;
const MIN_LEAVING_SPEED_M_S: f64 = 0.2;
/// A new person who is nearer to a known one may be one of their legs.
const MIN_ALONE_M: f64 = 0.9;
/// Maximum squared distance over variance of a new person who is a hidden one: 98.9 % of the normal distribution in
/// the plane.
const HIDDEN_GATE: f64 = 9.0;
/// Time out of sight in a room without sensors after which a person is away.
const AWAY_AFTER_NS: u64 = 250_000_000;

/// A door has leaves if this number of scans of a sensor in a row show it closed.
const MIN_CLOSED_SCANS: u32 = 20;

/// Tracks of people.
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
    /// Whether each door was seen closed.
    has_leaves: Vec<bool>,
    /// Number of scans in a row of each sensor that showed each door closed.
    closed: Vec<Vec<u32>>,
    poses: PoseVotes,
    misplaced: Vec<MisplacedSensor>,
    /// For each sensor, from the legs of walking people: the sum of offset times velocity, and the sum of squared speeds.
    /// The ratio is the mean time in seconds by which legs are ahead of their expected positions.
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

    /// Takes the next scan in the order of time.
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

    /// Corrects the position of a sensor that sees all people next to the positions at which others see them.
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

    /// Predicts all people at `at_ns`. A person who is not seen does not walk through a wall.
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

    /// Assigns the legs that the sensor sees to people: pairs of a leg, and twice the index of a person plus the
    /// side.
    fn associate(&mut self, sensor: usize, at_ns: u64, pairs: &mut Vec<(usize, usize)>) {
        let legs = self.sensor_views[sensor].legs();
        self.edges.clear();
        for (number, person) in self.people.iter().enumerate() {
            let gate = match person.phase {
                TrackPhase::Away { .. } => continue,
                TrackPhase::Tentative => GATE_TENTATIVE,
                TrackPhase::Known => GATE,
            };
            // Learned background keeps a confirmed person who stands, but does not confirm one.
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
        // By person, the more certain leg first.
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

    /// Updates the people without a leg in `pairs`: they are hidden, or the sensor sees through their positions.
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
                        // A learned object still stands there.
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

    /// Merges two people who share one pair of legs.
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
                    // The person who was confirmed first stays, with the filter of the one who was seen last.
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

    /// Deletes people whose position sensors have seen through for long enough, and people who have been away for too
    /// long.
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

    /// Returns the number of elements that memory is allocated for.
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

    /// Writes the picture of `at_ns`, which is not before the last scan.
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

    /// Finds the doors that have leaves. Only these are ever closed.
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

    /// Confirms people, and detects those who go through doors or where no sensor looks.
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

    /// Returns the hidden person in the same room who is most likely to have been at `place` at that time.
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

    /// Returns whether a person is a leg of another person who is seen.
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
                // The person was not seen at the door, or is in a wall.
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

    /// Returns whether a new person has come through a door that leads where no sensor looks: they were first seen at the door.
    /// At a door with leaves, a person is not confirmed, so that they may be first seen at some distance. Then they have
    /// come through it if they walk away from it, and are not a leg of someone who is known.
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

    /// Confirms a new person, who may be one who was away or hidden.
    fn confirm(&mut self, number: usize, at_ns: u64) {
        let new = &self.people[number];
        let (first_position, first_seen_ns) = (new.first_position, new.first_seen_ns);
        let off = |door: usize| distance_to_segment(first_position, self.site.doors[door].between);
        let is_inside = self.site.room_at(first_position).is_some_and(|room| self.watched[room]);
        let before_door_m = if is_inside { MAX_INSIDE_DOOR_M } else { MAX_BEFORE_DOOR_M };
        // All people who are away, with the door that they would have come out of.
        let arrival = |(old, person): (usize, &Person)| {
            let TrackPhase::Away { door: entry, .. } = person.phase else { return None };
            let exit = self.site.nearest_door(first_position, |door| {
                let is_gap = |gap: &Gap| gap.doors.contains(&entry) && gap.doors.contains(door);
                let leads = self.site.doors[*door].rooms().contains(&person.room);
                (leads || self.site.gaps.iter().any(is_gap)) && off(*door) < before_door_m
            })?;
            let after_s = (first_seen_ns as f64 - person.at_ns as f64) * 1e-9;
            // A person who appeared while the other one was seen is a different one.
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
                // A person who comes out of a door to where no sensor looks has come through it.
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

/// Returns whether a leg may be a part of a leaf of a door.
fn may_be_leaf(leg: &Leg) -> bool {
    match leg.at_door {
        DoorProximity::Clear => false,
        DoorProximity::Swing => !leg.is_free,
        DoorProximity::Line | DoorProximity::Jamb => true,
    }
}

/// Returns whether the legs of one scan are evidence for a person: one that no leaf of a door reaches, or two free ones
/// next to each other.
fn shows_person<'a>(legs: impl Iterator<Item = &'a Leg> + Clone) -> bool {
    let is_clear = |leg: &Leg| leg.at_door == DoorProximity::Clear;
    legs.clone().any(is_clear) || legs.filter(|leg| !may_be_leaf(leg)).count() == 2
}
