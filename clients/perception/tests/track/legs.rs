//! Test with recordings of real people, whose legs were labeled by hand: tracks must cover the labels. The recordings
//! are not a part of the project. Without them, the test is skipped with a message. All recordings come from one
//! scanner that did not move. The background for each recording is therefore learned from the other recordings, as if a
//! hub had run before.

#[path = "../../../../tests/testkit/skip.rs"]
mod skip;

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;

use flate2::read::GzDecoder;
use scanhub_perception::track::geometry::{Point, distance};
use scanhub_perception::track::{PeopleTracker, Site, Snapshot};
use scanhub_preprocess::background::{BackgroundModel, Settings};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::{Background, BackgroundHead, Code, Foreground, Pose, Scan, ScanHead, TrackState};
use serde_json::Value;

const BEAM_COUNT: usize = 768;
/// Number of scans after which a surface is background: ten seconds at 7.5 scans per second.
const SCANS_PER_WALK: u32 = 75;
/// Maximum distance between a label and a track that covers it, in meters.
const SEGMENT_MATCH_M: f64 = 0.35;
/// Minimum share of the labels that must be covered: if the hub starts with a background, and if it starts without a
/// background. The values were measured and rounded down.
const MIN_SHARE_WITH_BACKGROUND: f64 = 0.94;
const MIN_SHARE_WITHOUT_BACKGROUND: f64 = 0.75;

const ROOM_SITE: &str = r#"
[[sensor]]
name = "front"
pose = { x = 0.0, y = 0.0, yaw = 0.0 }
[[room]]
name = "hall"
polygon = [[-12, -12], [12, -12], [12, 12], [-12, 12]]
"#;

/// A scan with its stamp and the labeled legs.
struct RecordedScan {
    stamp_ns: u64,
    scan: Box<Scan>,
    legs: Vec<Point>,
}

/// Returns the recorded walks in the folder `people` in the order of time; `None` if the folder does not exist.
fn read_walks() -> Option<Vec<Vec<RecordedScan>>> {
    let default_folder = || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data"));
    let people = std::env::var_os("SCANHUB_DATA").map_or_else(default_folder, PathBuf::from).join("people");
    if !people.is_dir() {
        skip::skip("recordings", format!("none at {}", people.display()));
        return None;
    }
    let read = |number| {
        let file = File::open(people.join(format!("walk_{number}.jsonl.gz"))).expect("a walk");
        let lines = BufReader::new(GzDecoder::new(file)).lines();
        lines.map(|text| read_scan(&text.expect("a line")).expect("a scan")).collect()
    };
    Some((1..=3).map(read).collect())
}

/// Parses a scan. Ranges are in meters. Null stands for a beam without a return; most of these beams point ahead, where
/// the room is open.
fn read_scan(text: &str) -> Option<RecordedScan> {
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
    Some(RecordedScan {
        stamp_ns: line["stamp_ns"].as_u64()?,
        scan: Scan::of(head, &words),
        legs: legs.filter_map(|leg| Some([leg[0].as_f64()?, leg[1].as_f64()?])).collect(),
    })
}

/// Returns the background that a hub saves after it has processed these walks.
fn background<'a>(walks: impl Iterator<Item = &'a Vec<RecordedScan>>) -> Box<Background> {
    let (mut model, mut foreground) = (
        BackgroundModel::new(Settings { scans: Some(SCANS_PER_WALK), ..Settings::default() }, BEAM_COUNT),
        Foreground::of(BEAM_COUNT),
    );
    walks.flatten().for_each(|line| model.update(&line.scan, &mut foreground));
    let mut background = Background::of(BackgroundHead::default(), &[0; BEAM_COUNT]);
    model.write(&mut background);
    background
}

/// Returns the number of labels in a walk that a track covers. The hub starts with `background`.
fn covered_legs(walk: &[RecordedScan], background: Option<&Background>) -> usize {
    let mut people = PeopleTracker::new(Site::parse("room.toml", ROOM_SITE).expect("a room"), 0);
    let (mut model, mut segmenter) = (
        BackgroundModel::new(Settings { scans: Some(SCANS_PER_WALK), ..Settings::default() }, BEAM_COUNT),
        Segmenter::new(Pose::default(), BEAM_COUNT),
    );
    if let Some(background) = background {
        model.load(background).expect("a background of the same beams");
    }
    let (mut foreground, mut samples) = (Foreground::of(BEAM_COUNT), Vec::<Snapshot>::new());
    for RecordedScan { stamp_ns, scan, .. } in walk {
        model.update(scan, &mut foreground);
        segmenter.update(scan, &mut foreground);
        people.take(0, *stamp_ns, scan, &foreground, |sample| samples.push(sample.clone()));
    }
    people.finish(|sample| samples.push(sample.clone()));
    let covers = |stamp_ns: u64, leg: Point| {
        let next = samples.partition_point(|sample| sample.wall_ns < stamp_ns).min(samples.len() - 1);
        let ahead_s = (stamp_ns as f64 - samples[next].wall_ns as f64) * 1e-9;
        samples[next].tracks.iter().any(|track| {
            let [x, y] = [0, 1].map(|i| track.position[i] + ahead_s * track.velocity[i]);
            let counts = matches!(track.state, TrackState::Confirmed | TrackState::Hidden);
            counts && distance([x, y], leg) < SEGMENT_MATCH_M
        })
    };
    walk.iter().map(|line| line.legs.iter().filter(|&&leg| covers(line.stamp_ns, leg)).count()).sum()
}

#[test]
fn tracks_cover_the_labelled_legs_of_real_people() {
    let Some(walks) = read_walks() else { return };
    let (mut all, mut learned, mut cold) = (0, 0, 0);
    for (number, walk) in walks.iter().enumerate() {
        let others = (0..walks.len()).filter(|&other| other != number).map(|other| &walks[other]);
        let background = background(others);
        let of: usize = walk.iter().map(|line| line.legs.len()).sum();
        let counts = (covered_legs(walk, Some(&background)), covered_legs(walk, None));
        println!("walk {}: {} of {of} with a background, {} without", number + 1, counts.0, counts.1);
        (all, learned, cold) = (all + of, learned + counts.0, cold + counts.1);
    }
    println!("{:.3} and {:.3} of {all}", learned as f64 / all as f64, cold as f64 / all as f64);
    assert!(all >= 700, "{all} labels");
    assert!(learned as f64 >= MIN_SHARE_WITH_BACKGROUND * all as f64, "{learned} of {all} with a background");
    assert!(cold as f64 >= MIN_SHARE_WITHOUT_BACKGROUND * all as f64, "{cold} of {all} without");
}
