//! A run of the proof: people in the house, its sensors, backgrounds that the hub's processors learn, and the tracker.

use std::collections::{HashMap, VecDeque};
use std::time::Instant;

use scanhub_perception::track::geometry::{Point, distance, distance_to_border};
use scanhub_perception::track::{Kind, PeopleTracker, Site, Snapshot};
use scanhub_preprocess::background::{BackgroundModel, Settings};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::TrackState;
use scanhub_schema::{Foreground, Nanos, Pose, Scan};
use scanhub_sim::Shape;

use crate::baseline::NearestTracker;
use crate::diagnosis::Diagnosis;
use crate::house::{BEAMS, House, HouseSensor};
use crate::walkers::{Crossing, Crowd};

pub(crate) const EMPTY_TIME_S: f64 = 12.0;
const SAMPLE_RATE_HZ: f64 = 25.0;
const NS_PER_S: f64 = 1e9;
/// Duration of a mirror revolution of an LMS 2xx in ns, and number of simulation steps in this time.
const MIRROR_TURN_NS: Nanos = 13_320_000;
const STEPS_PER_MIRROR_TURN: usize = 3;
/// Start of the simulation as a wall clock time in ns.
const START_NS: u64 = 1_800_000_000_000_000_000;

#[derive(Clone, Copy)]
pub(crate) struct ProofSetup {
    pub(crate) people: usize,
    pub(crate) seconds: f64,
    pub(crate) seed: u64,
    pub(crate) room_change_share: f64,
    /// Share of rests on a chair.
    pub(crate) sit_share: f64,
    pub(crate) house: House,
    pub(crate) tracking: TrackerKind,
}

/// Tracker to run.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum TrackerKind {
    All,
    OneSensorEach,
    NearestSegment,
}

#[derive(Default)]
pub(crate) struct Outcome {
    /// Lines for the score of the tracker.
    pub(crate) csv: String,
    /// Lines for the score of exact positions with the oracle's IDs.
    pub(crate) oracle_csv: String,
    /// Sum of the squared distances between confirmed tracks and people, and number of these distances.
    pub(crate) squared_errors: (f64, usize),
    /// Passages through the corridor: all passages, passages with the same ID before and after, and passages that the
    /// oracle guessed right.
    pub(crate) crossings: (usize, usize, usize),
    /// Passages of doors: number of real passages, number of reported passages, and number of passages that were
    /// reported within two seconds with the right door and direction.
    pub(crate) doors: (usize, usize, usize),
    /// For each person, the number of tracks in the second half of the run, and the share of this half with a track.
    pub(crate) late_ids: Vec<(usize, f64)>,
    pub(crate) tracker_time_s: f64,
    pub(crate) simulated_s: f64,
    /// Number of tracks. In a run without people, each track is an error.
    pub(crate) tracks: usize,
    pub(crate) offset_error_s: f64,
    pub(crate) late: u64,
    /// Causes of lost IDs.
    pub(crate) diagnosis: Option<Diagnosis>,
}

struct SentScan {
    arrives_s: f64,
    sensor: usize,
    wall_ns: u64,
    scan: Box<Scan>,
    foreground: Box<Foreground>,
}

pub(crate) fn run(setup: ProofSetup) -> Outcome {
    let site = Site::parse("house.toml", &setup.house.site()).expect("the house is right");
    let mut random = fastrand::Rng::with_seed(setup.seed ^ 0x5EED);
    let sensors = site.sensors.len();
    let eyes: Vec<HouseSensor> =
        (0..sensors).map(|sensor| HouseSensor::new(setup.house, sensor, setup.seed)).collect();
    let mut models: Vec<(BackgroundModel, Segmenter)> = (0..sensors)
        .map(|_| (BackgroundModel::new(Settings::default(), BEAMS), Segmenter::new(Pose::default(), BEAMS)))
        .collect();
    let offset = 0.05 * (2.0 * random.f64() - 1.0);
    let drift = 50e-6 * (2.0 * random.f64() - 1.0);
    let phases: Vec<f64> = (0..sensors).map(|_| random.f64() / SAMPLE_RATE_HZ).collect();
    let mut crowd = Crowd::new(
        setup.house,
        setup.people,
        EMPTY_TIME_S,
        (setup.room_change_share, setup.sit_share),
        setup.seed,
    );
    let mut people = PeopleTracker::new(site.clone(), 80_000_000);
    let mut nearest = NearestTracker::new(site.clone());
    let mut outcome = Outcome { simulated_s: setup.seconds, ..Outcome::default() };
    let mut truths: Vec<Vec<Point>> = Vec::new();
    let mut samples: Vec<Snapshot> = Vec::new();
    let mut sent: Vec<SentScan> = Vec::new();
    // Moving objects during the last mirror revolution, one entry per simulation step.
    let mut shapes: VecDeque<Vec<Shape>> = VecDeque::new();
    let steps = (setup.seconds * 200.0) as usize;
    for step in 0..steps {
        let now_s = step as f64 / 200.0;
        crowd.step(now_s, 1.0 / 200.0);
        if step % 20 == 0 {
            truths.push(crowd.walkers.iter().map(|walker| walker.position).collect());
        }
        shapes.push_back(crowd.shapes());
        if shapes.len() > STEPS_PER_MIRROR_TURN + 1 {
            shapes.pop_front();
        }
        for sensor in 0..sensors {
            let revolution_index = |s: f64| ((s + phases[sensor]) * SAMPLE_RATE_HZ).floor();
            if step > 0 && revolution_index(now_s) == revolution_index(now_s - 1.0 / 200.0) {
                continue;
            }
            let end_ns = (now_s * NS_PER_S) as Nanos;
            let at = |time_ns: Nanos| match time_ns + MIRROR_TURN_NS * 3 / 2 < end_ns {
                true => shapes.front().cloned().unwrap_or_default(),
                false => shapes.back().cloned().unwrap_or_default(),
            };
            let scan = eyes[sensor].scan(&at, end_ns);
            let (model, segmenter) = &mut models[sensor];
            let mut foreground = Foreground::of(BEAMS);
            model.update(&scan, &mut foreground);
            segmenter.update(&scan, &mut foreground);
            let is_lost = random.f64() < 0.01;
            let arrives_s = now_s + 0.005 + 0.03 * random.f64();
            let is_b = site.sensors[sensor].hub() == "b";
            let off_s = if is_b { offset + drift * now_s } else { 0.0 };
            let wall_ns = START_NS.saturating_add_signed(((now_s + off_s) * NS_PER_S) as i64);
            let is_left_out = setup.tracking == TrackerKind::OneSensorEach && is_b;
            if !is_lost && !is_left_out {
                sent.push(SentScan { arrives_s, sensor, wall_ns, scan, foreground });
            }
        }
        sent.sort_by(|a, b| a.arrives_s.total_cmp(&b.arrives_s));
        let due = sent.partition_point(|one| one.arrives_s <= now_s);
        for SentScan { sensor, wall_ns, scan, foreground, .. } in sent.drain(..due) {
            let begin = Instant::now();
            match setup.tracking {
                TrackerKind::NearestSegment => nearest.take(wall_ns, sensor, &foreground, &mut samples),
                _ => people.take(sensor, wall_ns, &scan, &foreground, |sample| samples.push(sample.clone())),
            }
            outcome.tracker_time_s += begin.elapsed().as_secs_f64();
        }
    }
    outcome.late = people.counts().late;
    outcome.offset_error_s = people.offset_s(1) - (offset + drift * setup.seconds);
    score_run(&site, &truths, &samples, &crowd, &mut outcome);
    outcome
}

fn at_s(sample: &Snapshot) -> f64 {
    (sample.wall_ns as i64 - START_NS as i64) as f64 / NS_PER_S
}

fn score_run(site: &Site, truths: &[Vec<Point>], samples: &[Snapshot], crowd: &Crowd, outcome: &mut Outcome) {
    let watched = site.rooms_with_sensor();
    let is_scored = |place: Point| {
        let room = site.room_at(place).filter(|&room| watched[room]);
        room.is_some_and(|room| distance_to_border(&site.rooms[room].polygon, place) > 0.1)
    };
    let prints_events = std::env::args().any(|argument| argument == "--events");
    let mut diagnosis = Diagnosis::new(crowd.walkers.len());
    let mut oracle = crate::oracle::Identities::new(crowd);
    let mut next = 0;
    // Tracks of each person over time.
    let mut known: Vec<Vec<(f64, u64)>> = vec![Vec::new(); crowd.walkers.len()];
    let mut ids: HashMap<u64, u64> = HashMap::new();
    for (frame, truth) in truths.iter().enumerate() {
        let now_s = frame as f64 * 0.1;
        while next < samples.len() && at_s(&samples[next]) <= now_s + 1e-6 {
            next += 1;
        }
        if now_s < EMPTY_TIME_S || next == 0 {
            continue;
        }
        let sample = &samples[next - 1];
        let ahead = now_s - at_s(sample);
        diagnosis.take(now_s, truth, &is_scored, sample, &crowd.crossings);
        oracle.advance(now_s);
        for (person, place) in truth.iter().enumerate().filter(|(_, place)| is_scored(**place)) {
            outcome.csv += &format!("{frame},0,{person},{:.3},{:.3}\n", place[0], place[1]);
            for (kind, id) in [(0, person), (1, oracle.current_ids[person])] {
                outcome.oracle_csv += &format!("{frame},{kind},{id},{:.3},{:.3}\n", place[0], place[1]);
            }
        }
        for track in &sample.tracks {
            let at = [
                track.position[0] + ahead * track.velocity[0],
                track.position[1] + ahead * track.velocity[1],
            ];
            let counts = matches!(track.state, TrackState::Confirmed | TrackState::Hidden);
            if !counts {
                continue;
            }
            let nearest = truth.iter().enumerate().map(|(person, &place)| (distance(place, at), person));
            let nearest = nearest.min_by(|a, b| a.0.total_cmp(&b.0));
            if !is_scored(at) {
                continue;
            }
            ids.insert(track.id, track.id);
            outcome.csv += &format!("{frame},1,{},{:.3},{:.3}\n", track.id, at[0], at[1]);
            if let Some((off, person)) = nearest.filter(|(off, _)| *off < 0.5) {
                if track.state == TrackState::Confirmed {
                    outcome.squared_errors.0 += off * off;
                    outcome.squared_errors.1 += 1;
                }
                known[person].push((now_s, track.id));
            }
        }
    }
    if prints_events {
        for event in samples.iter().flat_map(|sample| &sample.events) {
            let at = (event.wall_ns as i64 - START_NS as i64) as f64 / NS_PER_S;
            let frame = truths.get((at * 10.0) as usize);
            println!("{at:.2} id {} room {:?} {:?} people {:.2?}", event.id, event.room, event.kind, frame);
        }
    }
    outcome.tracks = ids.len();
    outcome.diagnosis = Some(diagnosis);
    let mut reported: Vec<(f64, usize, bool)> = Vec::new();
    for event in samples.iter().flat_map(|sample| &sample.events) {
        if let Kind::Door { door, from, .. } = event.kind {
            let at = (event.wall_ns as i64 - START_NS as i64) as f64 / NS_PER_S;
            reported.push((at, door, from == site.doors[door].from));
        }
    }
    outcome.doors = (crowd.passages.len(), reported.len(), 0);
    for (at, door, forth) in &crowd.passages {
        let fits = |one: &(f64, usize, bool)| (one.1, one.2) == (*door, *forth) && (one.0 - at).abs() < 2.0;
        if let Some(found) = reported.iter().position(fits) {
            reported.remove(found);
            outcome.doors.2 += 1;
        }
    }
    let half_s = truths.len() as f64 * 0.05;
    outcome.late_ids = known
        .iter()
        .map(|one| {
            let late: Vec<u64> = one.iter().filter(|(s, _)| *s > half_s).map(|(_, id)| *id).collect();
            let mut ids = late.clone();
            ids.sort_unstable();
            ids.dedup();
            (ids.len(), late.len() as f64 / (truths.len() as f64 / 2.0))
        })
        .collect();
    let lives_s = truths.len() as f64 * 0.1;
    for crossing in &crowd.crossings {
        let track = |from_s: f64, to_s: f64, last: bool| {
            let mut within = known[crossing.walker].iter().filter(|(s, _)| (from_s..to_s).contains(s));
            if last { within.next_back() } else { within.nth(5) }.map(|(_, id)| *id)
        };
        let before = track(crossing.entered_s - 2.0, crossing.entered_s, true);
        let after = track(crossing.left_s, crossing.left_s + 2.0, false);
        if crossing.entered_s > EMPTY_TIME_S + 2.0 && crossing.left_s < lives_s - 2.5 {
            if prints_events && before != after {
                let Crossing { walker, entered_s, left_s } = crossing;
                println!("lost: {walker} in {entered_s:.2} out {left_s:.2}, was {before:?}, is {after:?}");
            }
            outcome.crossings.0 += 1;
            outcome.crossings.1 += usize::from(before.is_some() && before == after);
            outcome.crossings.2 += usize::from(crate::oracle::is_guess_right(crowd, crossing));
        }
    }
}
