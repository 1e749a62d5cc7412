//! Reasons for lost IDs. Each change of a person's track gets one cause, from the state of the old track and the origin
//! of the new track. This module only counts; `motmetrics` computes the scores.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use scanhub_perception::track::geometry::{Point, distance};
use scanhub_perception::track::{Snapshot, Track};
use scanhub_schema::TrackState;

use crate::house::CHAIRS;
use crate::walkers::{CORRIDOR_X, Crossing};

/// Maximum distance between a person and a matching track in meters, the same as in `score.py`.
const MATCH_M: f64 = 0.5;
/// Maximum distance in meters between two people whose tracks may be swapped.
const NEIGHBOR_M: f64 = 1.2;

/// Assignment of tracks to people, frame by frame.
pub(crate) struct Diagnosis {
    /// Track of each person, with the last time in seconds at which the person had this track.
    tracks: Vec<Option<(u64, f64)>>,
    /// Last owner of each track.
    owners: HashMap<u64, usize>,
    known_ids: BTreeSet<u64>,
    /// Number of changes by cause.
    pub(crate) causes: BTreeMap<&'static str, usize>,
    /// Sum of the squared errors of confirmed tracks, and number of these errors, by possible cause.
    pub(crate) errors: BTreeMap<&'static str, (f64, usize)>,
    is_reported: bool,
}

impl Diagnosis {
    pub(crate) fn new(people: usize) -> Diagnosis {
        Diagnosis {
            tracks: vec![None; people],
            owners: HashMap::new(),
            known_ids: BTreeSet::new(),
            causes: BTreeMap::new(),
            errors: BTreeMap::new(),
            is_reported: std::env::args().any(|argument| argument == "--events"),
        }
    }

    /// Compares the true positions of people with the tracks at the time `now_s`. `crossings` are all passages through
    /// the corridor.
    pub(crate) fn take(
        &mut self,
        now_s: f64,
        truth: &[Point],
        is_scored: &dyn Fn(Point) -> bool,
        sample: &Snapshot,
        crossings: &[Crossing],
    ) {
        let shown: Vec<&Track> = sample.tracks.iter().filter(|track| is_confirmed(track)).collect();
        let mut free: Vec<&Track> = shown.clone();
        let mut matched: Vec<Option<&Track>> = vec![None; truth.len()];
        for (person, place) in truth.iter().enumerate() {
            let Some((id, _)) = self.tracks[person] else { continue };
            let old =
                free.iter().position(|track| track.id == id && distance(track.position, *place) < MATCH_M);
            matched[person] = old.map(|old| free.swap_remove(old));
        }
        for (person, place) in truth.iter().enumerate() {
            if matched[person].is_some() || !is_scored(*place) {
                continue;
            }
            let off = |track: &&Track| distance(track.position, *place);
            let nearest = (0..free.len()).min_by(|&a, &b| off(&free[a]).total_cmp(&off(&free[b])));
            matched[person] = nearest.filter(|&i| off(&free[i]) < MATCH_M).map(|i| free.swap_remove(i));
        }
        for (person, track) in matched.iter().enumerate() {
            let Some(track) = track else { continue };
            if let Some((old, then_s)) = self.tracks[person]
                && old != track.id
            {
                let place = truth[person];
                let through = crossings.iter().any(|crossing| {
                    crossing.walker == person
                        && crossing.entered_s < now_s + 0.5
                        && crossing.left_s > then_s - 0.5
                });
                let cause = if through || (now_s - then_s > 0.15 && at_door(place)) {
                    self.corridor_cause(old, track.id, sample)
                } else {
                    self.room_cause(person, old, track.id, sample, truth, then_s, now_s)
                };
                *self.causes.entry(cause).or_default() += 1;
                if self.is_reported {
                    let old_now = sample.tracks.iter().find(|one| one.id == old);
                    let old_now = old_now.map(|one| (one.state, one.position));
                    println!(
                        "{now_s:.1}: {person} at {place:.2?} was {old} at {then_s:.1}, is {}: {cause}; old {old_now:.2?}, of {:?}",
                        track.id,
                        self.owners.get(&track.id)
                    );
                }
            }
        }
        for (person, track) in matched.iter().enumerate() {
            let Some(track) = track else { continue };
            self.tracks[person] = Some((track.id, now_s));
            self.owners.insert(track.id, person);
            self.known_ids.insert(track.id);
            if track.state == TrackState::Confirmed && is_scored(truth[person]) {
                let off = distance(track.position, truth[person]);
                let others = truth.iter().enumerate().filter(|(other, _)| *other != person);
                let near =
                    others.map(|(_, place)| distance(*place, truth[person])).fold(f64::INFINITY, f64::min);
                let sits = CHAIRS.iter().any(|(chair, _)| distance(*chair, truth[person]) < 0.5);
                let class = match (track.sensors.count_ones(), near < 0.9) {
                    _ if sits => "on a chair",
                    (0 | 1, true) => "one sensor, a person near",
                    (0 | 1, false) => "one sensor, no person near",
                    (_, true) => "two sensors, a person near",
                    (_, false) => "two sensors, no person near",
                };
                let sum = self.errors.entry(class).or_default();
                *sum = (sum.0 + off * off, sum.1 + 1);
                if off > 0.2 {
                    let sum = self.errors.entry("of all, those above 0.2 m").or_default();
                    *sum = (sum.0 + off * off, sum.1 + 1);
                }
            }
        }
        for track in &free {
            let near = |place: &Point| distance(*place, track.position) < 1.0;
            let cause = if CHAIRS.iter().any(|(chair, _)| distance(*chair, track.position) < 0.6) {
                "(frames of a track without a person, at a chair)"
            } else if [0.0, 17.0].iter().any(|x| distance([*x, 2.5], track.position) < 1.0) {
                "(frames of a track without a person, at a door to the street)"
            } else if truth.iter().any(near) {
                "(frames of a track without a person, near a person)"
            } else {
                "(frames of a track without a person, elsewhere)"
            };
            *self.causes.entry(cause).or_default() += usize::from(is_scored(track.position));
            if self.is_reported && is_scored(track.position) {
                println!(
                    "{now_s:.1}: false {} {:?} at {:.2?} by {:b} {cause}",
                    track.id, track.state, track.position, track.sensors
                );
            }
        }
    }

    fn corridor_cause(&self, old: u64, new: u64, sample: &Snapshot) -> &'static str {
        let was_of_another = self.owners.contains_key(&new);
        let old_now = sample.tracks.iter().find(|track| track.id == old).map(|track| track.state);
        match (was_of_another, old_now) {
            (true, Some(TrackState::BetweenRooms)) => "corridor: taken for another, own one still inside",
            (true, Some(_)) => "corridor: taken for another, own one is another's",
            (true, None) => "corridor: taken for another, own one gone",
            (false, Some(TrackState::BetweenRooms)) => "corridor: new, own one still inside",
            (false, Some(_)) => "corridor: new, own one is another's or a ghost",
            (false, None) => "corridor: new, own one gone",
        }
    }

    #[allow(clippy::too_many_arguments)]
    fn room_cause(
        &self,
        person: usize,
        old: u64,
        new: u64,
        sample: &Snapshot,
        truth: &[Point],
        then_s: f64,
        now_s: f64,
    ) -> &'static str {
        let place = truth[person];
        let old_now = sample.tracks.iter().find(|track| track.id == old);
        let unseen = now_s - then_s > 1.0;
        if let Some(&owner) = self.owners.get(&new) {
            return match (distance(truth[owner], place) < NEIGHBOR_M, unseen) {
                (true, _) => "room: two beside each other swapped",
                (false, true) => "room: lost for a second, then taken for one farther away",
                (false, false) => "room: taken for one farther away",
            };
        }
        match old_now {
            None if unseen => "room: gone for a second, then created again",
            None => "room: gone and at once created again",
            Some(track) if track.state == TrackState::BetweenRooms => {
                "room: away though in the room, created again"
            }
            Some(track) => {
                let near = |other: &Point| distance(*other, track.position) < MATCH_M;
                if truth.iter().enumerate().any(|(other, place)| other != person && near(place)) {
                    "room: drifted to another one, created again"
                } else if track.state == TrackState::Hidden {
                    "room: hidden elsewhere, created again"
                } else {
                    "room: born twice"
                }
            }
        }
    }
}

fn is_confirmed(track: &Track) -> bool {
    matches!(track.state, TrackState::Confirmed | TrackState::Hidden)
}

fn at_door(position: Point) -> bool {
    CORRIDOR_X.into_iter().any(|x| (position[0] - x).abs() < 1.0 && (position[1] - 2.5).abs() < 1.0)
}
