//! Scans of random surroundings. Each beam flips between one to three surfaces. There are a moving object, codes,
//! ranges of 0, and noise with outliers. Such scans are harder for a background model than scans of real rooms, which
//! they do not simulate.
#![allow(dead_code)] // each test takes what it needs

use std::fmt;

use scanhub_preprocess::background::{BackgroundModel, Class};
use scanhub_schema::{Background, BackgroundHead, Foreground, ForegroundHead, Scan, ScanHead};

/// Maximum number of beams of a scan.
pub(crate) const MAX_TEST_BEAMS: usize = 401;

/// Angles, unit and bits of a scan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Shape {
    pub(crate) count: u16,
    pub(crate) first_angle_mdeg: i32,
    pub(crate) step_mdeg: u32,
    pub(crate) unit_mm: u16,
    pub(crate) range_bits: u8,
}

impl Shape {
    /// Returns one of the shapes that scans of real sensors have.
    pub(crate) fn any(random: &mut fastrand::Rng) -> Shape {
        let (count, first_angle_mdeg, step_mdeg) = [
            (181, -90_000, 1000),
            (361, -90_000, 500),
            (101, -50_000, 1000),
            (201, -50_000, 500),
            (401, -50_000, 250),
        ][random.usize(..5)];
        let (unit_mm, range_bits) = (*random.choice(&[1, 10, 100]).unwrap(), random.u8(13..=15));
        Shape { count, first_angle_mdeg, step_mdeg, unit_mm, range_bits }
    }
}

/// Source of scans of random surroundings.
pub(crate) struct RandomSurroundings {
    pub(crate) shape: Shape,
    random: fastrand::Rng,
    /// Ranges in mm of the surfaces of each beam.
    beams: Vec<Vec<f64>>,
    /// Object in front of the surfaces: its first beam, its number of beams, and its range in mm.
    moving_object: (f64, usize, f64),
}

impl RandomSurroundings {
    pub(crate) fn new(shape: Shape, seed: u64) -> RandomSurroundings {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut wall_mm = 3_000.0;
        let beams = (0..shape.count)
            .map(|_| {
                wall_mm += 80.0 * (random.f64() - 0.5);
                let surfaces = if random.u8(..4) == 0 { random.usize(2..=3) } else { 1 };
                (0..surfaces).map(|n| wall_mm + 170.0 * n as f64 * random.f64()).collect()
            })
            .collect();
        RandomSurroundings { shape, random, beams, moving_object: (0.0, 6, 1_500.0) }
    }

    /// Returns the next scan.
    pub(crate) fn next(&mut self) -> Box<Scan> {
        let RandomSurroundings { shape, random, beams, moving_object } = self;
        let &mut Shape { count, first_angle_mdeg, step_mdeg, unit_mm, range_bits } = shape;
        let head = ScanHead::lms(count.into(), first_angle_mdeg, step_mdeg, unit_mm.into(), range_bits);
        let mut scan = Scan::of(head, &vec![0; count.into()]);
        moving_object.0 = (moving_object.0 + random.f64() - 0.3).rem_euclid(MAX_TEST_BEAMS as f64);
        moving_object.2 = (moving_object.2 + 30.0 * (random.f64() - 0.5)).clamp(100.0, 3_200.0);
        if random.u16(..200) == 0 {
            moving_object.1 = random.usize(..9);
        }
        for (i, surfaces) in beams.iter_mut().enumerate() {
            if random.u16(..4_000) == 0 {
                surfaces[0] = 500.0 + 4_000.0 * random.f64();
            }
            let before = (moving_object.0 as usize..moving_object.0 as usize + moving_object.1).contains(&i);
            let range_mm = if before { moving_object.2 } else { *random.choice(surfaces.iter()).unwrap() };
            let noise_mm = (0..4).map(|_| random.f64() - 0.5).sum::<f64>() * 14.0;
            let max = ((1_u32 << shape.range_bits) - 1) as u16;
            scan.arrays().ranges[i] = match random.u16(..1_000) {
                0..10 => max - random.u16(..9),
                10..16 => 0,
                16..40 => (range_mm / f64::from(shape.unit_mm)) as u16 + random.u16(..90),
                // These beams pass through a window, so they have no return or a range beyond the maximum.
                _ if i % 40 < 3 => max - 8 * u16::from(i % 3 == 0),
                _ => ((range_mm + noise_mm) / f64::from(shape.unit_mm)).max(0.0) as u16,
            };
        }
        scan
    }
}

/// Returns the reading of beam `i`: a range in mm, infinity if nothing is in range, or `None` if the beam has no
/// reading.
pub(crate) fn reading_mm(scan: &Scan, i: usize, no_return_is_far: bool) -> Option<f64> {
    let max = f64::from(scan.no_return);
    let value = f64::from(scan.ranges()[i]);
    if value == max - 8.0 || value == max && no_return_is_far {
        Some(f64::INFINITY)
    } else if value > max - 8.0 {
        None
    } else {
        Some(value * unit_mm(scan.unit_um))
    }
}

/// Returns a random background, as a user might have saved it.
pub(crate) fn any_model(random: &mut fastrand::Rng, shape: Shape) -> Box<Background> {
    let head = BackgroundHead { unit_um: 1000 * u32::from(shape.unit_mm), ..BackgroundHead::default() };
    let mut model = Background::of(head, &vec![0; shape.count.into()]);
    for range in model.ranges_mut() {
        *range = match random.u8(..8) {
            0 => Background::UNKNOWN,
            1 => Background::FAR,
            _ => random.u16(100..4_000),
        };
    }
    model
}

/// Returns the ranges of `model` in mm. Unknown ranges are 0, and far ranges are infinity.
pub(crate) fn ranges_mm(model: &Background) -> Vec<f64> {
    let mm = |&range: &u16| match range {
        Background::FAR => f64::INFINITY,
        range => f64::from(range) * unit_mm(model.unit_um),
    };
    model.ranges().iter().map(mm).collect()
}

/// Passes `scan` to `model`, and compares the whole result with `classes` and `generation`. Before, every byte of the
/// payload is `dirt`. If the comparison fails, `description` is printed.
pub(crate) fn check_scan(
    model: &mut BackgroundModel,
    scan: &Scan,
    classes: &[Class],
    generation: u32,
    dirt: u8,
    description: &fmt::Arguments<'_>,
) {
    let dirty = || Foreground::of_bytes(&vec![dirt; Foreground::len(scan.beams())]);
    let mut out = dirty();
    model.update(scan, &mut out);
    assert_eq!(model.classes(), classes, "{description}");
    assert_eq!(out, foreground(scan, classes, generation, dirty()), "{description}");
}

/// Returns the foreground for `classes`. Its segments are taken from `expected`.
fn foreground(
    scan: &Scan,
    classes: &[Class],
    generation: u32,
    mut expected: Box<Foreground>,
) -> Box<Foreground> {
    let beams: Vec<usize> = (0..classes.len()).filter(|&i| classes[i] == Class::Foreground).collect();
    let arrays = expected.begin(ForegroundHead {
        generation,
        unit_um: scan.unit_um,
        count: scan.count,
        beams: beams.len() as u16,
        ..ForegroundHead::default()
    });
    arrays.bits.fill(0);
    arrays.ranges.fill(0);
    for (place, &i) in beams.iter().enumerate() {
        arrays.bits[i / 8] |= 1 << (i % 8);
        arrays.ranges[place] = scan.ranges()[i];
    }
    expected
}

/// Converts a device unit from micrometers to millimeters.
pub(crate) fn unit_mm(unit_um: u32) -> f64 {
    f64::from(unit_um) / 1000.0
}

/// Returns the maximum difference between two readings of one surface, in mm. It is `set_mm`, or the default for the
/// scan's unit. If this is less than one unit, the difference is one unit.
pub(crate) fn max_difference_mm(set_mm: Option<u16>, scan: &Scan) -> f64 {
    let default_mm = match scan.unit_um {
        1_000 => 30,
        10_000 => 60,
        _ => 100,
    };
    f64::from(set_mm.unwrap_or(default_mm)).max(unit_mm(scan.unit_um))
}

/// Returns a random value for an optional setting: true, false, or `None` for the default.
pub(crate) fn any_choice(random: &mut fastrand::Rng) -> Option<bool> {
    [None, Some(false), Some(true)][random.usize(..3)]
}
