//! Real people before a real scanner, whose legs others have labelled: tracks are where the labels are. The recordings are no
//! part of the project; without them the test is left out, which is said. They are of one scanner in one place, so that the
//! background is learned from those that are not scored, as by a hub that was there before.

#[path = "../../../../tests/testkit/skip.rs"]
mod skip;

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;

use flate2::read::GzDecoder;
use scanhub_perception::track::geometry::{Point, distance};
use scanhub_perception::track::{PeopleTracker, Picture, Site};
use scanhub_preprocess::background::{Model, Settings};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::{Background, BackgroundHead, Code, Foreground, Pose, Scan, ScanHead, TrackState};
use serde_json::Value;

const BEAMS: usize = 768;
/// Ten seconds, after which something is background, of the 7.5 scans a second that there are.
const SCANS: u32 = 75;
/// A track covers the labels within this distance.
const COVERS_M: f64 = 0.35;
/// Shares of the labels that are covered: with a background at the start, and without; as measured, rounded down.
const LEARNED: f64 = 0.94;
const COLD: f64 = 0.75;

const ROOM: &str = r#"
[[sensor]]
name = "front"
pose = { x = 0.0, y = 0.0, yaw = 0.0 }
[[room]]
name = "hall"
polygon = [[-12, -12], [12, -12], [12, 12], [-12, 12]]
"#;

/// A scan, when it was, and the legs that are labelled in it.
struct Line {
    stamp_ns: u64,
    scan: Box<Scan>,
    legs: Vec<Point>,
}

/// The walks in the folder `people`, in the order of time.
fn walks() -> Option<Vec<Vec<Line>>> {
    let beside = || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data"));
    let people = std::env::var_os("SCANHUB_DATA").map_or_else(beside, PathBuf::from).join("people");
    if !people.is_dir() {
        skip::skip("recordings", format!("none at {}", people.display()));
        return None;
    }
    let read = |number| {
        let file = File::open(people.join(format!("walk_{number}.jsonl.gz"))).expect("a walk");
        let lines = BufReader::new(GzDecoder::new(file)).lines();
        lines.map(|text| line(&text.expect("a line")).expect("a scan")).collect()
    };
    Some((1..=3).map(read).collect())
}

/// Ranges are in metres; null is a beam from which nothing came back: most are of the open way ahead.
fn line(text: &str) -> Option<Line> {
    let line: Value = serde_json::from_str(text).ok()?;
    let step = line["step"].as_f64()?;
    let head = ScanHead {
        first_angle: line["angle_min"].as_f64()?,
        step,
        spacing: step as f32,
        unit_um: 1000,
        beam_time_ns: 65_000,
        valid_to: 11_000,
        no_return: Code::NoReturn.value(),
        beyond: Code::NoReturn.value(),
        ..ScanHead::default()
    };
    let word = |range: &Value| range.as_f64().map_or(head.no_return, |m| (1000.0 * m).round() as u16);
    let words: Vec<u16> = line["ranges"].as_array()?.iter().map(word).collect();
    let legs = line["labels"].as_array().into_iter().flatten();
    Some(Line {
        stamp_ns: line["stamp_ns"].as_u64()?,
        scan: Scan::of(head, &words),
        legs: legs.filter_map(|leg| Some([leg[0].as_f64()?, leg[1].as_f64()?])).collect(),
    })
}

/// What a hub saves that has seen these walks.
fn background<'a>(walks: impl Iterator<Item = &'a Vec<Line>>) -> Box<Background> {
    let (mut model, mut foreground) =
        (Model::new(Settings { scans: Some(SCANS), ..Settings::default() }, BEAMS), Foreground::of(BEAMS));
    walks.flatten().for_each(|line| model.update(&line.scan, &mut foreground));
    let mut background = Background::of(BackgroundHead::default(), &[0; BEAMS]);
    model.show(&mut background);
    background
}

/// How many labels of a walk a track covers, of a hub that begins with `background`.
fn covered(walk: &[Line], background: Option<&Background>) -> usize {
    let mut people = PeopleTracker::new(Site::parse("room.toml", ROOM).expect("a room"), 0);
    let (mut model, mut segmenter) = (
        Model::new(Settings { scans: Some(SCANS), ..Settings::default() }, BEAMS),
        Segmenter::new(Pose::default(), BEAMS),
    );
    if let Some(background) = background {
        model.load(background).expect("a background of the same beams");
    }
    let (mut foreground, mut pictures) = (Foreground::of(BEAMS), Vec::<Picture>::new());
    for Line { stamp_ns, scan, .. } in walk {
        model.update(scan, &mut foreground);
        segmenter.update(scan, &mut foreground);
        people.take(0, *stamp_ns, scan, &foreground, |picture| pictures.push(picture.clone()));
    }
    people.finish(|picture| pictures.push(picture.clone()));
    let covers = |stamp_ns: u64, leg: Point| {
        let next = pictures.partition_point(|picture| picture.wall_ns < stamp_ns).min(pictures.len() - 1);
        let ahead_s = (stamp_ns as f64 - pictures[next].wall_ns as f64) * 1e-9;
        pictures[next].tracks.iter().any(|track| {
            let [x, y] = [0, 1].map(|i| track.place[i] + ahead_s * track.velocity[i]);
            let counts = matches!(track.state, TrackState::Confirmed | TrackState::Hidden);
            counts && distance([x, y], leg) < COVERS_M
        })
    };
    walk.iter().map(|line| line.legs.iter().filter(|&&leg| covers(line.stamp_ns, leg)).count()).sum()
}

#[test]
fn tracks_cover_the_labelled_legs_of_real_people() {
    let Some(walks) = walks() else { return };
    let (mut all, mut learned, mut cold) = (0, 0, 0);
    for (number, walk) in walks.iter().enumerate() {
        let others = (0..walks.len()).filter(|&other| other != number).map(|other| &walks[other]);
        let background = background(others);
        let of: usize = walk.iter().map(|line| line.legs.len()).sum();
        let counts = (covered(walk, Some(&background)), covered(walk, None));
        println!("walk {}: {} of {of} with a background, {} without", number + 1, counts.0, counts.1);
        (all, learned, cold) = (all + of, learned + counts.0, cold + counts.1);
    }
    println!("{:.3} and {:.3} of {all}", learned as f64 / all as f64, cold as f64 / all as f64);
    assert!(all >= 700, "{all} labels");
    assert!(learned as f64 >= LEARNED * all as f64, "{learned} of {all} with a background");
    assert!(cold as f64 >= COLD * all as f64, "{cold} of {all} without");
}
