//! The tracker from outside, in the house of the proof: the same tracks in whatever order scans arrive, late scans and clocks that
//! jump, identities that are never used again, a sensor that dies and comes back, and a person who sits down.

use std::collections::BTreeSet;

use crate::house::{BEAMS, CHAIRS, Eye, House};
use crate::walkers::Crowd;
use scanhub_perception::track::geometry::distance;
use scanhub_perception::track::{PeopleTracker, Picture, Site};
use scanhub_preprocess::background::{Model, Settings};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::TrackState;
use scanhub_schema::{Foreground, Pose, Scan};

const DELAY_NS: u64 = 80_000_000;
const MS: u64 = 1_000_000;
const BEGIN_NS: u64 = 1_700_000_000_000_000_000;

struct Sent {
    sensor: usize,
    wall_ns: u64,
    scan: Box<Scan>,
    foreground: Box<Foreground>,
}

fn site() -> Site {
    Site::parse("house.toml", &IDEAL.site()).expect("the house is right")
}

const IDEAL: House = House { is_ideal: true };
const FURNISHED: House = House { is_ideal: false };

/// Returns the scans of the ideal house while `count` people walk there from second 12 on: 25 per second and sensor.
fn sent(count: usize, seconds: u64) -> Vec<Sent> {
    sent_of(IDEAL, (count, 0.0), 3, seconds, |_| {})
}

/// Returns the scans of a `house`. People spend the share `sits` of their rests on a chair. `each` receives the crowd every 10 ms.
fn sent_of(
    house: House,
    (count, sits): (usize, f64),
    seed: u64,
    seconds: u64,
    mut each: impl FnMut(&Crowd),
) -> Vec<Sent> {
    let sensors = Site::parse("house.toml", &house.site()).expect("the house is right").sensors.len();
    let mut crowd = Crowd::new(house, count, 12.0, (0.25, sits), seed);
    let mut eyes: Vec<(Eye, Model, Segmenter)> = (0..sensors)
        .map(|sensor| {
            let segmenter = Segmenter::new(Pose::default(), BEAMS);
            (Eye::new(house, sensor, seed), Model::new(Settings::default(), BEAMS), segmenter)
        })
        .collect();
    let mut all = Vec::new();
    for step in 0..100 * seconds {
        crowd.step(step as f64 / 100.0, 0.01);
        each(&crowd);
        let sensor = (step % 4) as usize;
        let (eye, model, segmenter) = &mut eyes[sensor];
        let scan = eye.scan(&|_| crowd.shapes(), 10 * MS * step);
        let mut foreground = Foreground::of(BEAMS);
        model.update(&scan, &mut foreground);
        segmenter.update(&scan, &mut foreground);
        all.push(Sent { sensor, wall_ns: BEGIN_NS + 10 * MS * step, scan, foreground });
    }
    all
}

fn pictures<'a>(sent: impl Iterator<Item = &'a Sent>) -> (Vec<Picture>, PeopleTracker) {
    pictures_of(site(), sent)
}

fn pictures_of<'a>(site: Site, sent: impl Iterator<Item = &'a Sent>) -> (Vec<Picture>, PeopleTracker) {
    let mut people = PeopleTracker::new(site, DELAY_NS);
    let mut pictures = Vec::new();
    for Sent { sensor, wall_ns, scan, foreground } in sent {
        people.take(*sensor, *wall_ns, scan, foreground, |picture| pictures.push(picture.clone()));
    }
    people.finish(|picture| pictures.push(picture.clone()));
    (pictures, people)
}

#[test]
fn the_same_scans_give_the_same_tracks_however_they_come() {
    let sent = sent(4, 24);
    let (in_order, people) = pictures(sent.iter());
    assert!(in_order.iter().any(|picture| picture.tracks.len() >= 3));
    assert_eq!((people.counts().scans, people.counts().late), (2_400, 0));
    // Each group of seven comes backwards: 60 ms, less than is waited for.
    let turned: Vec<&Sent> = sent.chunks(7).flat_map(|some| some.iter().rev()).collect();
    let (turned, people) = pictures(turned.into_iter());
    assert_eq!(people.counts().late, 0);
    assert!(in_order == turned, "bit for bit");
}

#[test]
fn latecomers_and_clocks_that_jump_are_counted_and_change_nothing() {
    let sent = sent(2, 20);
    let (in_order, _) = pictures(sent.iter());
    let mut people = PeopleTracker::new(site(), DELAY_NS);
    let mut shown = Vec::new();
    for (number, Sent { sensor, wall_ns, scan, foreground }) in sent.iter().enumerate() {
        let mut take = |wall_ns| {
            people.take(*sensor, wall_ns, scan, foreground, |picture| shown.push(picture.clone()));
        };
        take(*wall_ns);
        if number > 100 && number % 200 == 0 {
            take(*wall_ns - 500 * MS);
            take(*wall_ns + 3_600_000 * MS);
        }
    }
    people.finish(|picture| shown.push(picture.clone()));
    let counts = people.counts();
    assert_eq!((counts.late, counts.jumped, counts.invalid), (9, 9, 0));
    // Sensors send in turn, so that every 200th scan comes from the first one.
    assert_eq!(people.late(), [9, 0, 0, 0]);
    assert!(in_order == shown);
    let other = Foreground::of(181);
    people.take(0, BEGIN_NS, &sent[0].scan, &other, |_| {});
    people.take(9, BEGIN_NS, &sent[0].scan, &sent[0].foreground, |_| {});
    assert_eq!(people.counts().invalid, 2);
}

#[test]
fn an_identity_is_never_used_again_and_nobody_is_invented_when_a_sensor_dies() {
    let sent = sent(3, 60);
    let dies_ns = BEGIN_NS + 30_000 * MS;
    let alive = sent.iter().filter(|one| one.wall_ns < dies_ns || one.sensor != 0);
    let (pictures, _) = pictures(alive);
    let (mut gone, mut before) = (BTreeSet::new(), BTreeSet::new());
    for picture in &pictures {
        let now: BTreeSet<u64> = picture.tracks.iter().map(|track| track.id).collect();
        gone.extend(before.difference(&now).copied());
        assert!(now.is_disjoint(&gone), "{now:?} after {gone:?}");
        let is_here = |track: &&scanhub_perception::track::Track| {
            matches!(track.state, TrackState::Confirmed | TrackState::Hidden)
        };
        let known = picture.tracks.iter().filter(is_here).count();
        assert!(known <= 4, "three people, and one who is not yet joined: {picture:?}");
        before = now;
    }
    assert!(pictures.iter().any(|picture| picture.wall_ns > dies_ns + 20_000 * MS));
}

#[test]
fn a_clock_that_is_off_is_found_by_those_whom_both_see() {
    let mut sent = sent(4, 60);
    // Sensors 1 and 3 are of another hub, whose clock is 40 ms ahead.
    sent.iter_mut().filter(|one| one.sensor % 2 == 1).for_each(|one| one.wall_ns += 40 * MS);
    let (_, people) = pictures(sent.iter());
    assert_eq!(people.offset_s(0), 0.0);
    assert!((people.offset_s(1) - 0.04).abs() < 0.01, "{}", people.offset_s(1));
}

#[test]
fn a_sensor_that_sits_beside_its_place_is_told_by_those_whom_two_see() {
    let sent = sent(3, 60);
    let told = |pictures: &[Picture]| -> Vec<scanhub_perception::track::Misplaced> {
        pictures.iter().flat_map(|picture| picture.misplaced.iter().copied()).collect()
    };
    let (right, _) = pictures(sent.iter());
    assert_eq!(told(&right), [], "all are where they should be");
    let mut wrong = site();
    wrong.sensors[1].place[0] -= 0.4;
    wrong.sensors[1].place[1] += 0.3;
    let (shown, _) = pictures_of(wrong, sent.iter());
    let told = told(&shown);
    assert_eq!(told.len(), 1, "{told:?}");
    assert_eq!((told[0].sensor, told[0].other), (1, 0));
    assert!((told[0].off[0] + 0.4).abs() < 0.1 && (told[0].off[1] - 0.3).abs() < 0.1, "{told:?}");
    // From then on nobody is seen twice.
    let since = shown.iter().position(|picture| !picture.misplaced.is_empty()).expect("it is told");
    let is_known = |track: &&scanhub_perception::track::Track| {
        matches!(track.state, TrackState::Confirmed | TrackState::Hidden)
    };
    let most =
        shown[since + 100..].iter().map(|picture| picture.tracks.iter().filter(is_known).count()).max();
    assert!(most <= Some(4), "three people, and one who is not yet joined: {most:?}");
}

#[test]
fn a_sensor_that_comes_back_sees_those_who_are_there_and_nobody_else() {
    let sent = sent(3, 60);
    let is_away = |one: &&Sent| one.sensor < 2 && (20_000..30_000).contains(&((one.wall_ns - BEGIN_NS) / MS));
    let (pictures, _) = pictures(sent.iter().filter(|one| !is_away(one)));
    let is_known = |track: &&scanhub_perception::track::Track| {
        matches!(track.state, TrackState::Confirmed | TrackState::Hidden)
    };
    let most = pictures.iter().map(|picture| picture.tracks.iter().filter(is_known).count()).max();
    assert!(most <= Some(4), "three people, and one who is not yet joined: {most:?}");
    // While nobody looks, who is there gets uncertain.
    let at = |second: u64| {
        let picture = pictures.iter().find(|picture| picture.wall_ns >= BEGIN_NS + 1_000 * MS * second);
        picture.expect("a picture").tracks.iter().map(|track| track.covariance[0]).fold(0.0, f64::max)
    };
    assert!(at(29) > 0.05 && at(29) > 4.0 * at(19), "{} and {}", at(19), at(29));
}

#[test]
fn no_track_stays_on_the_chair_of_a_person_who_has_left() {
    let (mut frames, mut wrong, mut sat) = (0, 0, 0);
    for seed in 801..804 {
        let mut places = Vec::new();
        let sent = sent_of(FURNISHED, (1, 1.0), seed, 150, |crowd| {
            places.push(crowd.walkers.iter().map(|walker| walker.place).collect::<Vec<_>>());
        });
        let site = Site::parse("house.toml", &FURNISHED.site()).expect("the house is right");
        let (pictures, _) = pictures_of(site.clone(), sent.iter());
        let is_at_chair = |place| CHAIRS.iter().any(|(chair, _)| distance(*chair, place) < 0.5);
        for picture in &pictures {
            let Some(people) = places.get(((picture.wall_ns - BEGIN_NS) / (10 * MS)) as usize) else {
                continue;
            };
            sat += usize::from(people.iter().any(|&place| is_at_chair(place)));
            let is_nobody = |track: &&scanhub_perception::track::Track| {
                matches!(track.state, TrackState::Confirmed | TrackState::Hidden)
                    && people.iter().all(|&place| distance(place, track.place) > 0.7)
                    && track.room.is_some_and(|room| site.watched()[room])
            };
            frames += 1;
            wrong += usize::from(picture.tracks.iter().any(|track| is_nobody(&track)));
        }
    }
    assert!(sat > frames / 4, "somebody sat in {sat} of {frames} pictures");
    assert!(50 * wrong < frames, "{wrong} of {frames} pictures have a track of nobody");
}
