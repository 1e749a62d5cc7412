//! From scans in the order of time to persons: association, birth, death, doors. Refuses to know how scans come in order.

mod doors;

use scanhub_schema::{Foreground, Scan};

use crate::track::assignment::{Assignment, Edge};
use crate::track::filter::Side;
use crate::track::geometry::{Point, distance, distance_to_segment, length2, minus};
use crate::track::passage::LONGEST_S;
use crate::track::person::{COARSE, Life, Person};
use crate::track::picture::{Event, Kind, Misplaced, Picture, Track};
use crate::track::poses::Poses;
use crate::track::sight::{AtDoor, Leg, Seen, Sight};
use crate::track::site::Site;

/// The most persons at a time.
pub const PERSONS: usize = 64;
/// Time between two pictures.
pub const PICTURE_NS: u64 = 40_000_000;

/// Gain of a leg exactly where it should be: what a leg's squared distance over its variance must be below.
const GATE: f64 = 11.0;
/// Who is only tentative gives way.
const GATE_TENTATIVE: f64 = 9.0;
/// Legs farther from a person than this are not his.
const FARTHEST_LEG_M: f64 = 0.8;
/// The legs of a person are at most this far apart.
const WIDEST_STEP_M: f64 = 0.9;
/// Nobody is born so near to somebody who is known.
const APART_M: f64 = 0.3;
/// Who is seen through for so long is gone.
const GONE_S: f64 = 0.7;
const GONE_TENTATIVE_S: f64 = 0.25;
/// Who is tentative and not seen for so long is forgotten.
const FORGOTTEN_NS: u64 = 400_000_000;
/// Who is hidden for so long is.
const HIDDEN_NS: u64 = 120_000_000_000;
/// Between two scans of the slowest sensor; what is longer is a gap.
const SLOWEST_S: f64 = 0.2;
/// Scans that are not farther apart show the same.
const AT_ONCE_NS: u64 = 45_000_000;
/// Two who are nearer, and of whom never two pairs of legs are seen, are one.
const SAME_M: f64 = 0.45;
/// Time for which a known person who went into an ignored area may be associated with the legs in it.
const IGNORED_NS: u64 = 5_000_000_000;

/// A known person who was not seen for this time is not found again by a leg that may be a part of a leaf.
const LEAF_NS: u64 = 300_000_000;

/// What follows persons.
pub(crate) struct Tracker {
    pub(crate) site: Site,
    watched: Vec<bool>,
    pub(crate) sights: Vec<Sight>,
    pub(crate) persons: Vec<Person>,
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
    poses: Poses,
    misplaced: Vec<Misplaced>,
    /// Legs that were seen where a person walks: how much later than expected, per sensor, summed.
    pub(crate) lateness: Vec<(f64, f64)>,
}

impl Tracker {
    pub(crate) fn new(site: Site) -> Tracker {
        Tracker {
            watched: site.watched(),
            sights: site.sensors.iter().cloned().map(Sight::new).collect(),
            persons: Vec::with_capacity(PERSONS),
            next_id: 1,
            events: Vec::new(),
            assignment: Assignment::default(),
            edges: Vec::new(),
            pairs: Vec::new(),
            scan_ns: vec![0; site.sensors.len()],
            has_leaves: vec![false; site.doors.len()],
            closed: vec![vec![0; site.doors.len()]; site.sensors.len()],
            poses: Poses::new(site.sensors.len()),
            misplaced: Vec::new(),
            lateness: vec![(0.0, 0.0); site.sensors.len()],
            site,
        }
    }

    /// Takes the next scan in the order of time.
    pub(crate) fn take(&mut self, sensor: usize, at_ns: u64, scan: &Scan, foreground: &Foreground) {
        self.sights[sensor].take(scan, foreground);
        self.watch_leaves(sensor);
        self.sights[sensor].mark(&self.site, &self.has_leaves);
        let since_s = (at_ns.saturating_sub(self.scan_ns[sensor]) as f64 * 1e-9).min(SLOWEST_S);
        self.scan_ns[sensor] = at_ns;
        self.compare_poses(sensor, at_ns);
        self.walk(at_ns);
        let mut pairs = std::mem::take(&mut self.pairs);
        self.associate(sensor, at_ns, &mut pairs);
        self.correct(sensor, since_s, &pairs);
        self.miss(sensor, since_s, &pairs);
        self.bear(sensor, at_ns, &pairs);
        self.pairs = pairs;
        self.merge(at_ns);
        self.pass(at_ns);
        self.bury(at_ns);
    }

    /// A sensor that sees everybody beside where others see them is taken to sit beside its place.
    fn compare_poses(&mut self, sensor: usize, at_ns: u64) {
        for other in 0..self.sights.len() {
            if other == sensor || at_ns.saturating_sub(self.scan_ns[other]) > AT_ONCE_NS {
                continue;
            }
            let legs = |sensor: usize| (sensor, self.sights[sensor].legs());
            if let Some(misplaced) = self.poses.take(legs(sensor), legs(other)) {
                self.sights[misplaced.sensor].shift(misplaced.off);
                self.misplaced.push(misplaced);
            }
        }
    }

    /// Moves everybody to `at_ns`; nobody who is not seen walks through a wall.
    fn walk(&mut self, at_ns: u64) {
        for person in self.persons.iter_mut().filter(|person| !matches!(person.life, Life::Away { .. })) {
            let before = person.filter.place();
            person.predict(at_ns);
            if at_ns.saturating_sub(person.seen_ns) < 200_000_000 {
                continue;
            }
            let (room, after) = (self.site.room_at(before), person.filter.place());
            if self.site.room_at(after) != room {
                let door = |door: &crate::track::site::Door| distance_to_segment(before, door.between) < 0.4;
                if !self.site.doors.iter().any(door) {
                    person.filter.stop(before);
                }
            }
        }
    }

    /// Finds whose legs the sensor sees: pairs of a leg and twice the number of a person plus the side.
    fn associate(&mut self, sensor: usize, at_ns: u64, pairs: &mut Vec<(usize, usize)>) {
        let legs = self.sights[sensor].legs();
        self.edges.clear();
        for (number, person) in self.persons.iter().enumerate() {
            let gate = match person.life {
                Life::Away { .. } => continue,
                Life::Tentative => GATE_TENTATIVE,
                Life::Known => GATE,
            };
            // What the background has learned holds who is known and stands, and makes nobody known.
            let (place, stands) = (person.filter.place(), person.is_known() && person.speed() < 0.5);
            let passes = person.is_known() && at_ns.saturating_sub(person.free_ns) < IGNORED_NS;
            let is_lost = person.is_known() && at_ns.saturating_sub(person.seen_ns) > LEAF_NS;
            let reach = FARTHEST_LEG_M + 2.0 * person.filter.variance().sqrt().min(0.5);
            let expected = Side::BOTH.map(|side| person.filter.leg(side));
            for (leg, found) in legs.iter().enumerate() {
                let may_be_theirs = if found.is_ignored { passes } else { found.is_fresh || stands };
                let is_leaf = found.at_door == AtDoor::Jamb || is_lost && may_be_leaf(found);
                if length2(minus(found.at, place)) >= reach * reach || !may_be_theirs || is_leaf {
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
                        self.edges.push(Edge { leg, place: 2 * number + side, gain });
                    }
                }
            }
        }
        pairs.clear();
        self.assignment.solve((legs.len(), 2 * self.persons.len()), &self.edges, pairs);
        // By person, the surer leg first.
        pairs.sort_unstable_by_key(|&(leg, place)| (place / 2, (legs[leg].sigma_m * 1e6) as u64, leg));
        let mut i = 1;
        while i < pairs.len() {
            let ((one, of), (other, and)) = (pairs[i - 1], pairs[i]);
            if of / 2 == and / 2 && distance(legs[one].at, legs[other].at) > WIDEST_STEP_M {
                pairs.remove(i);
            } else {
                i += 1;
            }
        }
    }

    fn correct(&mut self, sensor: usize, since_s: f64, pairs: &[(usize, usize)]) {
        let legs = self.sights[sensor].legs();
        for of_one in pairs.chunk_by(|a, b| a.1 / 2 == b.1 / 2) {
            let person = &mut self.persons[of_one[0].1 / 2];
            let (velocity, speed) = (person.filter.velocity(), person.speed());
            let mut ahead = 0.0;
            for &(leg, place) in of_one {
                let Leg { at, sigma_m, .. } = legs[leg];
                let side = Side::BOTH[place % 2];
                let off = minus(at, person.filter.leg(side).0);
                ahead += off[0] * velocity[0] + off[1] * velocity[1];
                person.filter.correct(side, at, sigma_m);
            }
            if of_one.len() == 2 && speed > 0.6 && person.life == Life::Known {
                let (sum, weight) = &mut self.lateness[sensor];
                *sum += ahead / 2.0;
                *weight += speed * speed;
            }
            let theirs = of_one.iter().map(|&(leg, _)| &legs[leg]);
            match theirs.clone().filter(|leg| leg.is_solid).map(|leg| leg.beams).max() {
                Some(beams) if person.is_known() || shows_person(theirs) => {
                    person.seen(sensor, since_s, of_one.len(), beams);
                }
                Some(_) => person.seen_ns = person.at_ns,
                None => {}
            }
            if of_one.iter().any(|&(leg, _)| !legs[leg].is_ignored) {
                person.free_ns = person.at_ns;
            }
        }
    }

    /// Who is not among `pairs` is hidden, or seen through.
    fn miss(&mut self, sensor: usize, since_s: f64, pairs: &[(usize, usize)]) {
        let sight = &self.sights[sensor];
        for (number, person) in self.persons.iter_mut().enumerate() {
            let is_seen = |&(leg, place): &(usize, usize)| place / 2 == number && sight.legs()[leg].is_solid;
            if matches!(person.life, Life::Away { .. }) || pairs.iter().any(is_seen) {
                continue;
            }
            let place = person.filter.place();
            let sigma = person.filter.variance().sqrt();
            let share = if sigma < 0.25 {
                match sight.look(place) {
                    Seen::Through => 1.0,
                    Seen::Here => {
                        // What the background has learned still stands there.
                        if person.is_known() && person.speed() < 0.4 {
                            person.absent_s = (person.absent_s - COARSE * since_s).max(0.0);
                        }
                        0.0
                    }
                    Seen::Hidden => 0.0,
                }
            } else {
                let s = 1.2 * sigma;
                let around = [[0.0, 0.0], [s, 0.0], [-s, 0.0], [0.0, s], [0.0, -s]];
                let through =
                    |off: &&Point| sight.look([place[0] + off[0], place[1] + off[1]]) == Seen::Through;
                around.iter().filter(through).count() as f64 / 5.0
            };
            person.absent_s += share * since_s;
            if share > 0.5 {
                person.support = (person.support - 0.5).max(0.0);
            }
        }
    }

    /// Legs of nobody are somebody's.
    fn bear(&mut self, sensor: usize, at_ns: u64, pairs: &[(usize, usize)]) {
        let legs = self.sights[sensor].legs();
        let near_known = |at: Point| {
            self.persons.iter().any(|person| {
                let is_his = |side| distance(person.filter.leg(side).0, at) < APART_M;
                !matches!(person.life, Life::Away { .. }) && Side::BOTH.into_iter().any(is_his)
            })
        };
        let mut free: Vec<usize> = (0..legs.len())
            .filter(|&leg| {
                let taken = pairs.iter().any(|&(taken, _)| taken == leg);
                let may_start = legs[leg].is_fresh && legs[leg].is_solid && legs[leg].at_door < AtDoor::Line;
                may_start && !taken && !near_known(legs[leg].at)
            })
            .collect();
        while let Some(leg) = free.pop() {
            if self.persons.len() >= PERSONS {
                return;
            }
            let off = |&&other: &&usize| distance(legs[other].at, legs[leg].at);
            let mate = free
                .iter()
                .filter(|other| off(other) < 0.6)
                .min_by(|a, b| off(a).total_cmp(&off(b)))
                .copied();
            free.retain(|&other| Some(other) != mate);
            let both = [legs[leg], mate.map_or(legs[leg], |mate| legs[mate])];
            let both = if mate.is_some() { &both[..] } else { &both[..1] };
            let mut person = Person::new(self.next_id, at_ns, both);
            person.seen_by_ns[sensor] = at_ns;
            person.room = self.site.room_at(person.born_at);
            self.next_id += 1;
            self.persons.push(person);
        }
    }

    /// Two who share one pair of legs are one.
    fn merge(&mut self, at_ns: u64) {
        let mut i = 0;
        while i < self.persons.len() {
            let one = &self.persons[i];
            let is_same = |other: &Person| {
                if length2(minus(one.filter.place(), other.filter.place())) >= SAME_M * SAME_M {
                    return false;
                }
                let alone = one.both + other.both < 0.35;
                let known =
                    !matches!(one.life, Life::Away { .. }) && !matches!(other.life, Life::Away { .. });
                let grown = at_ns - other.born_ns > 600_000_000 && at_ns - one.born_ns > 600_000_000;
                let unseen = (at_ns - one.seen_ns).max(at_ns - other.seen_ns) > 300_000_000;
                let very_near = distance(one.filter.place(), other.filter.place()) < 0.2;
                known && grown && (alone || very_near && unseen && (one.both < 0.3 || other.both < 0.3))
            };
            match (i + 1..self.persons.len()).find(|&j| is_same(&self.persons[j])) {
                Some(other) => {
                    // The one who was known first stays, with the filter of whom was seen last.
                    let (keep, drop) = if self.persons[other].is_known() && !self.persons[i].is_known() {
                        (other, i)
                    } else {
                        (i, other)
                    };
                    if self.persons[drop].seen_ns > self.persons[keep].seen_ns {
                        self.persons[keep].filter = self.persons[drop].filter.clone();
                        self.persons[keep].seen_ns = self.persons[drop].seen_ns;
                    }
                    if self.persons[drop].is_known() {
                        self.tell(at_ns, drop, Kind::Left);
                    }
                    self.persons.remove(drop);
                }
                None => i += 1,
            }
        }
    }

    /// Who was seen through long enough is gone, and who was away too long.
    fn bury(&mut self, at_ns: u64) {
        let mut number = 0;
        while number < self.persons.len() {
            let person = &self.persons[number];
            let silent_ns = at_ns.saturating_sub(person.seen_ns);
            let (is_gone, is_told) = match person.life {
                Life::Tentative => (person.absent_s > GONE_TENTATIVE_S || silent_ns > FORGOTTEN_NS, false),
                Life::Known => {
                    let is_lost = at_ns.saturating_sub(person.free_ns) > IGNORED_NS
                        && self.site.is_ignored(person.filter.place());
                    (person.absent_s > GONE_S || silent_ns > HIDDEN_NS || is_lost, true)
                }
                Life::Away { since_ns, .. } => {
                    let away_s = at_ns.saturating_sub(since_ns) as f64 * 1e-9;
                    (person.room.is_none() || away_s > 5.0 * LONGEST_S, true)
                }
            };
            if is_gone {
                if is_told {
                    self.tell(at_ns, number, Kind::Left);
                }
                self.persons.remove(number);
            } else {
                number += 1;
            }
        }
    }

    /// Elements for which there is memory.
    #[cfg(test)]
    pub(crate) fn capacity(&self) -> usize {
        let sights: usize = self.sights.iter().map(Sight::capacity).sum();
        let lists = self.edges.capacity() + self.pairs.capacity() + self.assignment.capacity();
        sights + lists + self.persons.capacity() + self.events.capacity() + self.misplaced.capacity()
    }

    fn tell(&mut self, wall_ns: u64, number: usize, kind: Kind) {
        let Person { id, room, .. } = self.persons[number];
        self.events.push(Event { wall_ns, id, room, kind });
    }

    /// Writes the picture of `at_ns`, at which or before which the last scan was.
    pub(crate) fn show(&mut self, at_ns: u64, picture: &mut Picture) {
        picture.wall_ns = at_ns;
        picture.tracks.clear();
        picture.tracks.extend(self.persons.iter().map(|person| {
            let ahead = at_ns.saturating_sub(person.at_ns).min(200_000_000) as f64 * 1e-9;
            let (place, velocity) = (person.filter.place(), person.filter.velocity());
            let variance = person.filter.variance();
            let is_away = matches!(person.life, Life::Away { .. });
            let ahead = if is_away { 0.0 } else { ahead };
            Track {
                id: person.id,
                state: person.state(at_ns),
                place: [place[0] + ahead * velocity[0], place[1] + ahead * velocity[1]],
                velocity,
                covariance: [variance, 0.0, variance],
                room: person.room,
                sensors: person.sensors(at_ns),
                age_s: at_ns.saturating_sub(person.born_ns) as f64 * 1e-9,
                score: 1.0 - (-person.support / 5.0).exp(),
            }
        }));
        picture.tracks.sort_unstable_by_key(|track| track.id);
        picture.events.clear();
        picture.events.append(&mut self.events);
        picture.misplaced.clear();
        picture.misplaced.append(&mut self.misplaced);
    }
}

/// Returns whether a leg may be a part of a leaf of a door.
fn may_be_leaf(leg: &Leg) -> bool {
    match leg.at_door {
        AtDoor::Clear => false,
        AtDoor::Swing => !leg.is_free,
        AtDoor::Line | AtDoor::Jamb => true,
    }
}

/// Returns whether the legs of one scan are evidence for a person: one that no leaf of a door reaches, or two free ones
/// next to each other.
fn shows_person<'a>(legs: impl Iterator<Item = &'a Leg> + Clone) -> bool {
    let is_clear = |leg: &Leg| leg.at_door == AtDoor::Clear;
    legs.clone().any(is_clear) || legs.filter(|leg| !may_be_leaf(leg)).count() == 2
}
