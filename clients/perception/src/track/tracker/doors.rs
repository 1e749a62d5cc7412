//! Who goes through doors, who goes where no sensor looks, and who of them somebody new is. Refuses to know legs.

use super::Tracker;
use crate::track::geometry::{Point, distance, distance_to_segment, dot, length2, middle, minus};
use crate::track::passage::{Gone, New};
use crate::track::person::{Life, Person};
use crate::track::picture::Kind;

/// So far from a door somebody may be seen first who comes to it.
const BEFORE_DOOR_M: f64 = 3.5;
/// The same in a room with sensors, where he is seen as soon as he has come through.
const INSIDE_DOOR_M: f64 = 1.2;
/// Who is so far behind a door has gone through it.
const BEHIND_DOOR_M: f64 = 0.12;
/// Who is nearer to somebody known, and never shows two legs, is a part of him.
const PART_M: f64 = 0.5;
/// Maximum distance from a door at which a person is first seen who has come through it, in meters.
const AT_DOOR_M: f64 = 0.7;
/// This distance for a door with leaves, if the person walks away from it at least at the speed below, in m/s.
const BEFORE_LEAVES_M: f64 = 1.6;
const LEAVES_M_S: f64 = 0.2;
/// A new person who is nearer to a known one may be one of their legs.
const ALONE_M: f64 = 0.9;
/// Squared distance over variance within which somebody new is one who was hidden: 98.9 % of the plane's normal distribution.
const HIDDEN_GATE: f64 = 9.0;
/// Who is out of sight for so long in an unseen room is away.
const AWAY_NS: u64 = 250_000_000;

/// A door has leaves if this number of scans of a sensor in a row show it closed.
const CLOSED_SCANS: u32 = 20;

impl Tracker {
    /// Finds the doors that have leaves: only these are ever closed.
    pub(super) fn watch_leaves(&mut self, sensor: usize) {
        let doors = self.site.doors.iter().zip(&mut self.has_leaves).zip(&mut self.closed[sensor]);
        for ((door, has_leaves), closed) in doors.filter(|((_, has_leaves), _)| !**has_leaves) {
            if self.sights[sensor].is_closed(door.between) {
                *closed += 1;
                *has_leaves = *closed >= CLOSED_SCANS;
            } else {
                *closed = 0;
            }
        }
    }

    /// Doors, and those who go where no sensor looks.
    pub(super) fn pass(&mut self, at_ns: u64) {
        let mut number = 0;
        while number < self.persons.len() {
            let person = &self.persons[number];
            if person.life == Life::Tentative {
                if person.is_sure() && !self.is_part_of_another(number) {
                    self.confirm(number, at_ns);
                    continue;
                }
            } else if person.is_known() {
                self.cross(number, at_ns);
            }
            number += 1;
        }
    }

    /// Who is hidden and may have been at `place` then, in the same room: the one for whom it is the least far off.
    fn hidden_near(&self, place: Point, then_ns: u64) -> Option<usize> {
        let room = self.site.room_at(place);
        let off2 = |(number, person): (usize, &Person)| {
            let is_hidden = person.is_known() && person.seen_ns + AWAY_NS < person.at_ns;
            let is_he = is_hidden && person.seen_ns <= then_ns && person.room == room;
            let off = distance(place, person.filter.place());
            let off2 = off * off / (person.filter.variance() + 0.04);
            (is_he && off2 < HIDDEN_GATE).then_some((off2, number))
        };
        let near = self.persons.iter().enumerate().filter_map(off2);
        near.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, number)| number)
    }

    /// One leg beside somebody who is seen is rather a part of him.
    fn is_part_of_another(&self, number: usize) -> bool {
        let one = &self.persons[number];
        let near = |other: &Person| {
            other.is_known()
                && one.at_ns.saturating_sub(other.seen_ns) < AWAY_NS
                && distance(one.filter.place(), other.filter.place()) < PART_M
        };
        one.both < 0.3 && self.persons.iter().any(near)
    }

    fn cross(&mut self, number: usize, at_ns: u64) {
        let person = &self.persons[number];
        let (place, from) = (person.filter.place(), person.room);
        let to = self.site.room_at(place);
        if to != from {
            let door = self.site.door_between(from, to, place);
            let behind = |door: usize| distance_to_segment(place, self.site.doors[door].between);
            match door.filter(|&door| behind(door) < 1.5) {
                Some(door) if behind(door) > BEHIND_DOOR_M => {
                    (self.persons[number].room, self.persons[number].came_by) = (to, Some(door));
                    self.tell(at_ns, number, Kind::Door { door, from, to });
                }
                // He was not seen at the door, or is in a wall.
                None if to.is_some() && at_ns - person.seen_ns < AWAY_NS => {
                    (self.persons[number].room, self.persons[number].came_by) = (to, None);
                }
                _ => {}
            }
        }
        let person = &self.persons[number];
        let is_watched = person.room.is_some_and(|room| self.watched[room]);
        if !is_watched && at_ns - person.seen_ns > AWAY_NS {
            let (room, place, since_ns) = (person.room, person.filter.place(), person.seen_ns);
            let off = |&door: &usize| distance_to_segment(place, self.site.doors[door].between);
            let leads =
                |&door: &usize| [self.site.doors[door].from, self.site.doors[door].to].contains(&room);
            let nearest =
                || (0..self.site.doors.len()).filter(leads).min_by(|a, b| off(a).total_cmp(&off(b)));
            let door = person.came_by.filter(leads).or_else(nearest);
            if let Some(door) = door {
                self.persons[number].life = Life::Away { since_ns, door };
            }
        }
    }

    /// Returns whether a new person has come through a door that leads where no sensor looks: they were first seen at the door.
    /// At a door with leaves, a person is not confirmed, so that they may be first seen at some distance. Then they have
    /// come through it if they walk away from it, and are not a leg of someone who is known.
    fn came_through(&self, number: usize, door: usize) -> bool {
        let person = &self.persons[number];
        let off_m = self.site.distance_to_door(person.born_at, door);
        if off_m < AT_DOOR_M || !self.has_leaves[door] {
            return off_m < AT_DOOR_M;
        }
        let (place, away) =
            (person.filter.place(), minus(person.born_at, middle(self.site.doors[door].between)));
        let walks_away = dot(away, person.filter.velocity()) > LEAVES_M_S * length2(away).sqrt();
        let near = |other: &Person| other.is_known() && distance(other.filter.place(), place) < ALONE_M;
        let is_alone = self.persons.iter().filter(|other| other.id != person.id).all(|other| !near(other));
        off_m < BEFORE_LEAVES_M && walks_away && is_alone
    }

    /// Somebody new is sure: he may be one who went away.
    fn confirm(&mut self, number: usize, at_ns: u64) {
        let new = &self.persons[number];
        let (born_at, born_ns) = (new.born_at, new.born_ns);
        let off = |door: usize| distance_to_segment(born_at, self.site.doors[door].between);
        let is_inside = self.site.room_at(born_at).is_some_and(|room| self.watched[room]);
        let before_door_m = if is_inside { INSIDE_DOOR_M } else { BEFORE_DOOR_M };
        // Everyone away, at the door that he would have come out of.
        let arrival = |(old, person): (usize, &Person)| {
            let Life::Away { door: entry, .. } = person.life else { return None };
            let exits = (0..self.site.doors.len()).filter(|&door| {
                let ends = [self.site.doors[door].from, self.site.doors[door].to];
                let gap =
                    self.site.gaps.iter().any(|gap| gap.doors.contains(&entry) && gap.doors.contains(&door));
                (ends.contains(&person.room) || gap) && off(door) < before_door_m
            });
            let exit = exits.min_by(|&a, &b| off(a).total_cmp(&off(b)))?;
            let after_s = (born_ns as f64 - person.at_ns as f64) * 1e-9;
            // He was born while the other was seen: another one.
            let way_m = distance(born_at, person.filter.place());
            if after_s < -0.75 || after_s < -0.25 && way_m > 0.7 {
                return None;
            }
            let gone = Gone {
                entry: person.came_by,
                at: person.filter.place(),
                speed: person.speed(),
                pace: person.pace,
            };
            let seen = New { exit, at: born_at, velocity: new.filter.velocity(), is_out: is_inside };
            Some((self.site.likelihood(&gone, &seen, after_s), old, exit))
        };
        let best = self.persons.iter().enumerate().filter_map(arrival).max_by(|a, b| a.0.total_cmp(&b.0));
        let best = best.filter(|best| best.0 > 1e-4).map(|(_, old, exit)| (old, Some(exit)));
        match self.hidden_near(born_at, born_ns).map(|old| (old, None)).or(best) {
            Some((old, exit)) => {
                let mut new = self.persons.remove(number);
                let old = if old > number { old - 1 } else { old };
                let known = &mut self.persons[old];
                let from = known.room;
                (new.id, new.born_ns, new.pace, new.life) =
                    (known.id, known.born_ns, known.pace, Life::Known);
                new.room = self.site.room_at(new.filter.place()).or(new.room);
                let to = new.room;
                new.came_by = if from == to { known.came_by } else { exit };
                self.persons[old] = new;
                if let Some(door) = exit.filter(|_| from != to) {
                    self.tell(at_ns, old, Kind::Door { door, from, to });
                }
            }
            None => {
                self.persons[number].life = Life::Known;
                // Who comes out of a door that leads where nobody looks has come through it.
                let leads = |&door: &usize| {
                    let ends = [self.site.doors[door].from, self.site.doors[door].to];
                    let is_unseen = |room: &Option<usize>| room.is_none_or(|room| !self.watched[room]);
                    ends.contains(&self.persons[number].room) && ends.iter().any(is_unseen)
                };
                let came_by = |&door: &usize| self.came_through(number, door);
                let door = (0..self.site.doors.len()).filter(leads).find(came_by);
                let (room, is_watched) = {
                    let room = self.persons[number].room;
                    (room, room.is_some_and(|room| self.watched[room]))
                };
                self.tell(at_ns, number, Kind::Appeared);
                if let Some(door) = door.filter(|_| is_watched) {
                    let ends = [self.site.doors[door].from, self.site.doors[door].to];
                    let from = if ends[0] == room { ends[1] } else { ends[0] };
                    self.tell(at_ns, number, Kind::Door { door, from, to: room });
                }
            }
        }
    }
}
