//! Tests of the tracker in the simulated house. The tracks must not depend on the order in which scans arrive. The
//! tests also cover late scans, clock jumps, IDs that must never be reused, a sensor that is interrupted, and a person
//! who sits down.

use std::collections::BTreeSet;

use crate::house::{BEAMS, CHAIRS, House, HouseSensor};
use crate::walkers::Crowd;
use scanhub_perception::track::geometry::distance;
use scanhub_perception::track::{PeopleTracker, Site, Snapshot};
use scanhub_preprocess::background::{BackgroundModel, Settings};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::TrackState;
use scanhub_schema::{Foreground, Pose, Scan};

const DELAY_NS: u64 = 80_000_000;
const MS: u64 = 1_000_000;
const START_NS: u64 = 1_700_000_000_000_000_000;

struct SentScan {
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

/// Returns the scans of the ideal house, in which `count` people walk from second 12 on. Each sensor sends 25 scans per
/// second.
fn simulate(count: usize, seconds: u64) -> Vec<SentScan> {
    simulate_house(IDEAL, (count, 0.0), 3, seconds, |_| {})
}

/// Returns the scans of a `house` in which `count` people walk. `sits` is the share of people's rests that they spend
/// on a chair. `each` receives the crowd every 10 ms of virtual time.
fn simulate_house(
    house: House,
    (count, sits): (usize, f64),
    seed: u64,
    seconds: u64,
    mut each: impl FnMut(&Crowd),
) -> Vec<SentScan> {
    let sensors = Site::parse("house.toml", &house.site()).expect("the house is right").sensors.len();
    let mut crowd = Crowd::new(house, count, 12.0, (0.25, sits), seed);
    let mut eyes: Vec<(HouseSensor, BackgroundModel, Segmenter)> = (0..sensors)
        .map(|sensor| {
            let segmenter = Segmenter::new(Pose::default(), BEAMS);
            (
                HouseSensor::new(house, sensor, seed),
                BackgroundModel::new(Settings::default(), BEAMS),
                segmenter,
            )
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
        all.push(SentScan { sensor, wall_ns: START_NS + 10 * MS * step, scan, foreground });
    }
    all
}

fn track<'a>(sent: impl Iterator<Item = &'a SentScan>) -> (Vec<Snapshot>, PeopleTracker) {
    track_site(site(), sent)
}

fn track_site<'a>(site: Site, sent: impl Iterator<Item = &'a SentScan>) -> (Vec<Snapshot>, PeopleTracker) {
    let mut people = PeopleTracker::new(site, DELAY_NS);
    let mut samples = Vec::new();
    for SentScan { sensor, wall_ns, scan, foreground } in sent {
        people.take(*sensor, *wall_ns, scan, foreground, |sample| samples.push(sample.clone()));
    }
    people.finish(|sample| samples.push(sample.clone()));
    (samples, people)
}

#[test]
fn order_of_arrival_does_not_change_the_tracks() {
    let sent = simulate(4, 24);
    let (in_order, people) = track(sent.iter());
    assert!(in_order.iter().any(|sample| sample.tracks.len() >= 3));
    assert_eq!((people.counts().scans, people.counts().late), (2_400, 0));
    // Reverse each group of seven scans. A group spans 60 ms, which is less than the delay.
    let turned: Vec<&SentScan> = sent.chunks(7).flat_map(|some| some.iter().rev()).collect();
    let (turned, people) = track(turned.into_iter());
    assert_eq!(people.counts().late, 0);
    assert!(in_order == turned, "bit for bit");
}

#[test]
fn late_scans_and_clock_jumps_are_counted_and_dropped() {
    let sent = simulate(2, 20);
    let (in_order, _) = track(sent.iter());
    let mut people = PeopleTracker::new(site(), DELAY_NS);
    let mut shown = Vec::new();
    for (number, SentScan { sensor, wall_ns, scan, foreground }) in sent.iter().enumerate() {
        let mut take = |wall_ns| {
            people.take(*sensor, wall_ns, scan, foreground, |sample| shown.push(sample.clone()));
        };
        take(*wall_ns);
        if number > 100 && number % 200 == 0 {
            take(*wall_ns - 500 * MS);
            take(*wall_ns + 3_600_000 * MS);
        }
    }
    people.finish(|sample| shown.push(sample.clone()));
    let counts = people.counts();
    assert_eq!((counts.late, counts.jumped, counts.invalid), (9, 9, 0));
    // Sensors send one after another, so every 200th scan comes from the first sensor.
    assert_eq!(people.late(), [9, 0, 0, 0]);
    assert!(in_order == shown);
    let other = Foreground::of(181);
    people.take(0, START_NS, &sent[0].scan, &other, |_| {});
    people.take(9, START_NS, &sent[0].scan, &sent[0].foreground, |_| {});
    assert_eq!(people.counts().invalid, 2);
}

#[test]
fn sensor_failure_reuses_no_id_and_adds_no_person() {
    let sent = simulate(3, 60);
    let dies_ns = START_NS + 30_000 * MS;
    let alive = sent.iter().filter(|one| one.wall_ns < dies_ns || one.sensor != 0);
    let (samples, _) = track(alive);
    let (mut deleted, mut before) = (BTreeSet::new(), BTreeSet::new());
    for sample in &samples {
        let now: BTreeSet<u64> = sample.tracks.iter().map(|track| track.id).collect();
        deleted.extend(before.difference(&now).copied());
        assert!(now.is_disjoint(&deleted), "{now:?} after {deleted:?}");
        let is_here = |track: &&scanhub_perception::track::Track| {
            matches!(track.state, TrackState::Confirmed | TrackState::Hidden)
        };
        let known = sample.tracks.iter().filter(is_here).count();
        assert!(known <= 4, "three people, and one who is not yet joined: {sample:?}");
        before = now;
    }
    assert!(samples.iter().any(|sample| sample.wall_ns > dies_ns + 20_000 * MS));
}

#[test]
fn clock_offset_is_estimated_from_shared_people() {
    let mut sent = simulate(4, 60);
    // Sensors 1 and 3 belong to another hub, whose clock is 40 ms ahead.
    sent.iter_mut().filter(|one| one.sensor % 2 == 1).for_each(|one| one.wall_ns += 40 * MS);
    let (_, people) = track(sent.iter());
    assert_eq!(people.offset_s(0), 0.0);
    assert!((people.offset_s(1) - 0.04).abs() < 0.01, "{}", people.offset_s(1));
}

#[test]
fn misplaced_sensor_is_reported_once_and_corrected() {
    let sent = simulate(3, 60);
    let misplaced = |samples: &[Snapshot]| -> Vec<scanhub_perception::track::MisplacedSensor> {
        samples.iter().flat_map(|sample| sample.misplaced.iter().copied()).collect()
    };
    let (right, _) = track(sent.iter());
    assert_eq!(misplaced(&right), [], "all are where they should be");
    let mut wrong = site();
    wrong.sensors[1].position[0] -= 0.4;
    wrong.sensors[1].position[1] += 0.3;
    let (shown, _) = track_site(wrong, sent.iter());
    let misplaced = misplaced(&shown);
    assert_eq!(misplaced.len(), 1, "{misplaced:?}");
    assert_eq!((misplaced[0].sensor, misplaced[0].other), (1, 0));
    assert!(
        (misplaced[0].offset[0] + 0.4).abs() < 0.1 && (misplaced[0].offset[1] - 0.3).abs() < 0.1,
        "{misplaced:?}"
    );
    // After the correction, the tracker sees no person twice.
    let since = shown.iter().position(|sample| !sample.misplaced.is_empty()).expect("a report");
    let is_known = |track: &&scanhub_perception::track::Track| {
        matches!(track.state, TrackState::Confirmed | TrackState::Hidden)
    };
    let max_people =
        shown[since + 100..].iter().map(|sample| sample.tracks.iter().filter(is_known).count()).max();
    assert!(max_people <= Some(4), "three people, and one who is not yet joined: {max_people:?}");
}

#[test]
fn returning_sensor_adds_no_person() {
    let sent = simulate(3, 60);
    let is_away =
        |one: &&SentScan| one.sensor < 2 && (20_000..30_000).contains(&((one.wall_ns - START_NS) / MS));
    let (samples, _) = track(sent.iter().filter(|one| !is_away(one)));
    let is_known = |track: &&scanhub_perception::track::Track| {
        matches!(track.state, TrackState::Confirmed | TrackState::Hidden)
    };
    let max_people = samples.iter().map(|sample| sample.tracks.iter().filter(is_known).count()).max();
    assert!(max_people <= Some(4), "three people, and one who is not yet joined: {max_people:?}");
    // While no sensor sees a person, the person's position becomes uncertain.
    let at = |second: u64| {
        let sample = samples.iter().find(|sample| sample.wall_ns >= START_NS + 1_000 * MS * second);
        sample.expect("a picture").tracks.iter().map(|track| track.covariance[0]).fold(0.0, f64::max)
    };
    assert!(at(29) > 0.05 && at(29) > 4.0 * at(19), "{} and {}", at(19), at(29));
}

#[test]
fn tracks_rarely_remain_on_chairs_of_departed_people() {
    let (mut frames, mut wrong, mut sat) = (0, 0, 0);
    for seed in 801..804 {
        let mut places = Vec::new();
        let sent = simulate_house(FURNISHED, (1, 1.0), seed, 150, |crowd| {
            places.push(crowd.walkers.iter().map(|walker| walker.position).collect::<Vec<_>>());
        });
        let site = Site::parse("house.toml", &FURNISHED.site()).expect("the house is right");
        let (samples, _) = track_site(site.clone(), sent.iter());
        let is_at_chair = |place| CHAIRS.iter().any(|(chair, _)| distance(*chair, place) < 0.5);
        for sample in &samples {
            let Some(people) = places.get(((sample.wall_ns - START_NS) / (10 * MS)) as usize) else {
                continue;
            };
            sat += usize::from(people.iter().any(|&place| is_at_chair(place)));
            let is_false_track = |track: &&scanhub_perception::track::Track| {
                matches!(track.state, TrackState::Confirmed | TrackState::Hidden)
                    && people.iter().all(|&place| distance(place, track.position) > 0.7)
                    && track.room.is_some_and(|room| site.rooms_with_sensor()[room])
            };
            frames += 1;
            wrong += usize::from(sample.tracks.iter().any(|track| is_false_track(&track)));
        }
    }
    assert!(sat > frames / 4, "a person sat in {sat} of {frames} pictures");
    assert!(50 * wrong < frames, "{wrong} of {frames} pictures have a track without a person");
}
