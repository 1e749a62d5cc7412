//! CPU time of the hub's processors for one scan of 361 beams, with a person who walks through the room of the paper's
//! Fig. 8. Targets: zones, marks and background together 1 us with the method `paper`, 3 us with `multi`; 5 us with
//! segments.

#![allow(missing_docs)] // criterion's macros make public functions

#[path = "../tests/testkit/decoded_scan.rs"]
mod decoded_scan;

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use scanhub_drivers::lms::variant::{MIRROR_TURN, Unit, Variant};
use scanhub_preprocess::background::{self, Method, Model};
use scanhub_preprocess::segments::Segmenter;
use scanhub_preprocess::{marks, zones};
use scanhub_schema::{Foreground, Marks, Pose, Scan, Zones};
use scanhub_sim::room::Room;

const POSE: Pose = Pose { x_m: 0.3, y_m: -0.1, yaw_rad: 0.2, upside_down: 0, reserved: [0; 7] };
/// Of each scan.
const BEAMS: usize = 361;
/// Somebody walks through the room, and its background has been learned.
const FIRST: u64 = 800;
/// Scans that take turns.
const COUNT: u64 = 64;

/// Scans of a world from the first one.
fn scans(world: &str, count: u64) -> Vec<Box<Scan>> {
    let room = Room::new(&world.parse().expect("a world that the program brings along"), 1);
    let scan = |number| {
        let end_ns = number * Variant::HALF.turns() * MIRROR_TURN;
        decoded_scan::scan(&room.scan(Variant::HALF, Unit::Mm, decoded_scan::MODE, end_ns), Unit::Mm)
    };
    (1..=count).map(scan).collect()
}

/// A model that has learned from what came before, and the scans that come then.
fn model(method: Method, scans: &[Box<Scan>]) -> (Model, &[Box<Scan>]) {
    let mut model = Model::new(background::Settings { method, ..background::Settings::default() }, BEAMS);
    let (past, present) = scans.split_at(FIRST as usize);
    past.iter().for_each(|scan| model.update(scan, &mut Foreground::of(BEAMS)));
    (model, present)
}

/// Times `update` over `scans` in turn.
fn bench(c: &mut Criterion, name: &str, scans: &[Box<Scan>], mut update: impl FnMut(&Scan)) {
    let mut next = scans.iter().cycle();
    c.bench_function(name, |b| b.iter(|| update(black_box(next.next().expect("a cycle")))));
}

fn check(c: &mut Criterion) {
    let scans = scans("fig8", COUNT);
    let eight = [2000, 1800, 1600, 1400, 1200, 1000, 800, 600];
    let cases: [(&str, Pose, &[u16]); 3] = [
        ("zones, 2 circles, at the centre", Pose::default(), &[1000, 600]),
        ("zones, 2 circles, off the centre", POSE, &[1000, 600]),
        ("zones, 8 circles, off the centre", POSE, &eight),
    ];
    for (name, pose, radii_mm) in cases {
        let settings = zones::Settings { radii_mm: radii_mm.to_vec(), ..zones::Settings::default() };
        let mut check = zones::Check::new(pose, &settings, BEAMS);
        let mut out = Zones::default();
        bench(c, name, &scans, |scan| check.update(scan, black_box(&mut out)));
    }
}

fn find(c: &mut Criterion) {
    for (name, world) in [("marks, none", "fig8"), ("marks, 12", "strips")] {
        let mut finder = marks::MarkDetector::new(marks::Settings::default());
        let mut out = Marks::default();
        bench(c, name, &scans(world, COUNT), |scan| finder.update(scan, black_box(&mut out)));
    }
}

fn learn(c: &mut Criterion) {
    let scans = scans("fig8", FIRST + COUNT);
    for (name, method) in [("background, paper", Method::Paper), ("background, multi", Method::Multi)] {
        let (mut model, scans) = model(method, &scans);
        let mut out = Foreground::of(BEAMS);
        bench(c, name, scans, |scan| model.update(scan, black_box(&mut out)));
    }
    let (mut model, scans) = model(Method::Multi, &scans);
    let mut cutter = Segmenter::new(POSE, BEAMS);
    // What stands before the background is found once, and cut again and again.
    let mut foreground = Foreground::of(BEAMS);
    model.update(&scans[0], &mut foreground);
    bench(c, "segments", &scans[..1], |scan| cutter.update(scan, black_box(&mut foreground)));
}

fn all(c: &mut Criterion) {
    let scans = scans("fig8", FIRST + COUNT);
    let cases = [
        ("zones, marks, background paper", Method::Paper, false),
        ("zones, marks, background multi", Method::Multi, false),
        ("zones, marks, background multi, segments", Method::Multi, true),
    ];
    for (name, method, with_segments) in cases {
        let mut check = zones::Check::new(POSE, &zones::Settings::default(), BEAMS);
        let mut finder = marks::MarkDetector::new(marks::Settings::default());
        let (mut model, scans) = model(method, &scans);
        let mut cutter = Segmenter::new(POSE, BEAMS);
        let (mut zones, mut marks) = (Zones::default(), Marks::default());
        let mut foreground = Foreground::of(BEAMS);
        bench(c, name, scans, |scan| {
            check.update(scan, black_box(&mut zones));
            finder.update(scan, black_box(&mut marks));
            model.update(scan, black_box(&mut foreground));
            if with_segments {
                cutter.update(scan, black_box(&mut foreground));
            }
        });
    }
}

criterion_group!(benches, check, find, learn, all);
criterion_main!(benches);
