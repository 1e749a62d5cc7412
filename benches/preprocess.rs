//! What the processors of the hub cost for one scan of 361 beams. Targets: zones, marks and background together 1 us
//! with the method `paper`, 3 us with `multi`; 5 us with segments.

#![allow(missing_docs)] // criterion's macros make public functions

use std::f64::consts::PI;
use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use fastrand::Rng;
use preprocess::{marks, zones};
use schema::{CONTENTS_UPPER, Marks, Pose, Scan, Zones};

/// Scans of a rectangular room with noise, a few codes and `reflectors` strips of four beams, so that no two are alike.
fn scans(reflectors: usize) -> Vec<Scan> {
    let mut random = Rng::with_seed(1);
    let mut scan = || {
        let mut scan = Scan {
            count: 361,
            unit_mm: 1,
            range_bits: 13,
            step_mdeg: 500,
            intensity_bits: 3,
            contents: CONTENTS_UPPER,
            ..Scan::default()
        };
        for i in 0..361 {
            let (sin, cos) = (i as f64 / 360.0 * PI).sin_cos();
            let wall_mm = (3_150.0 / cos.abs()).min(5_500.0 / sin.abs());
            let is_code = random.u8(..200) == 0;
            scan.range_array[i] = if is_code { 0x1FFB } else { wall_mm as u16 + random.u16(..20) };
            let is_lit = (1..=reflectors).any(|n| (0..4).contains(&(i as i32 - (n * 28) as i32)));
            scan.upper_array[i] = if is_lit { random.u8(1..8) } else { 0 };
        }
        scan
    };
    std::iter::repeat_with(&mut scan).take(64).collect()
}

fn check(c: &mut Criterion) {
    let scans = scans(0);
    let off_centre = Pose { x_m: 0.3, y_m: -0.1, yaw_rad: 0.2, ..Pose::default() };
    let eight = [2000, 1800, 1600, 1400, 1200, 1000, 800, 600];
    let cases: [(&str, Pose, &[u16]); 3] = [
        ("zones, 2 circles, at the centre", Pose::default(), &[1000, 600]),
        ("zones, 2 circles, off the centre", off_centre, &[1000, 600]),
        ("zones, 8 circles, off the centre", off_centre, &eight),
    ];
    for (name, pose, radii_mm) in cases {
        let settings = zones::Settings { radii_mm, ..zones::Settings::default() };
        let mut check = zones::Check::new(pose, &settings);
        let mut out = Zones::default();
        let mut next = scans.iter().cycle();
        c.bench_function(name, |b| {
            b.iter(|| {
                check.update(black_box(next.next().expect("a cycle")), &mut out);
                black_box(&mut out);
            });
        });
    }
}

fn find(c: &mut Criterion) {
    for (name, reflectors) in [("marks, none", 0), ("marks, 12 of 4 beams", 12)] {
        let scans = scans(reflectors);
        let mut finder = marks::Finder::new(marks::Settings::default());
        let mut out = Marks::default();
        let mut next = scans.iter().cycle();
        c.bench_function(name, |b| {
            b.iter(|| {
                finder.update(black_box(next.next().expect("a cycle")), &mut out);
                black_box(&mut out);
            });
        });
    }
}

criterion_group!(benches, check, find);
criterion_main!(benches);
