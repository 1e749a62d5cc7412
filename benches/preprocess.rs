//! CPU time of the hub's processors for one scan of 361 beams, while a person walks through the room of the paper's
//! Fig. 8. The targets for zones, marks and background together are 1 us with the background method `paper`, 3 us with
//! `multi`, and 5 us with segments in addition.

#![allow(missing_docs)] // The macros of criterion create public functions.

#[path = "../tests/testkit/decoded_scan.rs"]
mod decoded_scan;

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use scanhub_drivers::lms::variant::{MIRROR_PERIOD, Unit, Variant};
use scanhub_preprocess::background::{self, BackgroundModel, Method};
use scanhub_preprocess::segments::Segmenter;
use scanhub_preprocess::{marks, zones};
use scanhub_schema::{Foreground, Marks, Pose, Scan, Zones};
use scanhub_sim::room::Room;

const SENSOR_POSE: Pose = Pose { x_m: 0.3, y_m: -0.1, yaw_rad: 0.2, upside_down: 0, reserved: [0; 7] };
/// Number of beams of each scan.
const BEAM_COUNT: usize = 361;
/// Index of the first scan that is measured. At this time, a person walks through the room, and the background is
/// learned.
const FIRST_SCAN: u64 = 800;
/// Number of scans that the bench uses. The bench processes these scans one after the other, again and again.
const SCAN_COUNT: u64 = 64;

/// Returns the first `count` scans of a world.
fn scans(world: &str, count: u64) -> Vec<Box<Scan>> {
    let room = Room::new(&world.parse().expect("a built-in world"), 1);
    let scan = |number| {
        let end_ns = number * Variant::HALF.revolutions() * MIRROR_PERIOD;
        decoded_scan::scan(&room.scan(Variant::HALF, Unit::Mm, decoded_scan::MODE, end_ns), Unit::Mm)
    };
    (1..=count).map(scan).collect()
}

/// Returns a model that has learned from the scans before [`FIRST_SCAN`], and the remaining scans.
fn model(method: Method, scans: &[Box<Scan>]) -> (BackgroundModel, &[Box<Scan>]) {
    let mut model =
        BackgroundModel::new(background::Settings { method, ..background::Settings::default() }, BEAM_COUNT);
    let (past, present) = scans.split_at(FIRST_SCAN as usize);
    past.iter().for_each(|scan| model.update(scan, &mut Foreground::of(BEAM_COUNT)));
    (model, present)
}

/// Measures the time of `update` for one scan. Passes the scans one after the other, again and again.
fn time_scans(c: &mut Criterion, name: &str, scans: &[Box<Scan>], mut update: impl FnMut(&Scan)) {
    let mut next = scans.iter().cycle();
    c.bench_function(name, |b| b.iter(|| update(black_box(next.next().expect("an endless sequence")))));
}

fn bench_zones(c: &mut Criterion) {
    let scans = scans("fig8", SCAN_COUNT);
    let eight = [2000, 1800, 1600, 1400, 1200, 1000, 800, 600];
    let cases: [(&str, Pose, &[u16]); 3] = [
        ("zones, 2 circles, at the center", Pose::default(), &[1000, 600]),
        ("zones, 2 circles, off the center", SENSOR_POSE, &[1000, 600]),
        ("zones, 8 circles, off the center", SENSOR_POSE, &eight),
    ];
    for (name, pose, radii_mm) in cases {
        let settings = zones::Settings { radii_mm: radii_mm.to_vec(), ..zones::Settings::default() };
        let mut check = zones::ZoneChecker::new(pose, &settings, BEAM_COUNT);
        let mut out = Zones::default();
        time_scans(c, name, &scans, |scan| check.update(scan, black_box(&mut out)));
    }
}

fn bench_finders(c: &mut Criterion) {
    for (name, world) in [("marks, none", "fig8"), ("marks, 12", "strips")] {
        let mut finder = marks::MarkDetector::new(marks::Settings::default());
        let mut out = Marks::default();
        time_scans(c, name, &scans(world, SCAN_COUNT), |scan| finder.update(scan, black_box(&mut out)));
    }
}

fn bench_background(c: &mut Criterion) {
    let scans = scans("fig8", FIRST_SCAN + SCAN_COUNT);
    for (name, method) in [("background, paper", Method::Paper), ("background, multi", Method::Multi)] {
        let (mut model, scans) = model(method, &scans);
        let mut out = Foreground::of(BEAM_COUNT);
        time_scans(c, name, scans, |scan| model.update(scan, black_box(&mut out)));
    }
    let (mut model, scans) = model(Method::Multi, &scans);
    let mut cutter = Segmenter::new(SENSOR_POSE, BEAM_COUNT);
    // Compute the foreground only once, and measure how long it takes to divide it into segments.
    let mut foreground = Foreground::of(BEAM_COUNT);
    model.update(&scans[0], &mut foreground);
    time_scans(c, "segments", &scans[..1], |scan| cutter.update(scan, black_box(&mut foreground)));
}

fn bench_all(c: &mut Criterion) {
    let scans = scans("fig8", FIRST_SCAN + SCAN_COUNT);
    let cases = [
        ("zones, marks, background paper", Method::Paper, false),
        ("zones, marks, background multi", Method::Multi, false),
        ("zones, marks, background multi, segments", Method::Multi, true),
    ];
    for (name, method, with_segments) in cases {
        let mut check = zones::ZoneChecker::new(SENSOR_POSE, &zones::Settings::default(), BEAM_COUNT);
        let mut finder = marks::MarkDetector::new(marks::Settings::default());
        let (mut model, scans) = model(method, &scans);
        let mut cutter = Segmenter::new(SENSOR_POSE, BEAM_COUNT);
        let (mut zones, mut marks) = (Zones::default(), Marks::default());
        let mut foreground = Foreground::of(BEAM_COUNT);
        time_scans(c, name, scans, |scan| {
            check.update(scan, black_box(&mut zones));
            finder.update(scan, black_box(&mut marks));
            model.update(scan, black_box(&mut foreground));
            if with_segments {
                cutter.update(scan, black_box(&mut foreground));
            }
        });
    }
}

criterion_group!(benches, bench_zones, bench_finders, bench_background, bench_all);
criterion_main!(benches);
