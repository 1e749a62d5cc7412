//! Random scans of every kind of sensor: variants, units, measuring modes, mountings, with codes among the ranges.
#![allow(dead_code)] // each test takes what it needs

use std::f64::consts::PI;

use fastrand::Rng;
use schema::{CONTENTS_UPPER, Pose, Scan};

/// Beams, first angle and step of the five variants.
pub(crate) const VARIANTS: [(u16, i32, u16); 5] =
    [(181, 0, 1000), (361, 0, 500), (101, 40_000, 1000), (201, 40_000, 500), (401, 40_000, 250)];

/// A scan in `unit_mm` without readings yet: any variant, 13, 14 or 15 bits of range.
pub(crate) fn layout(random: &mut Rng, unit_mm: u8) -> Scan {
    let (count, first_angle_mdeg, step_mdeg) = VARIANTS[random.usize(..VARIANTS.len())];
    let range_bits = random.u8(13..=15);
    Scan {
        count,
        unit_mm,
        range_bits,
        first_angle_mdeg,
        step_mdeg,
        intensity_bits: 16 - range_bits,
        contents: CONTENTS_UPPER,
        ..Scan::default()
    }
}

/// A code, or now and then one that is reserved.
pub(crate) fn code(random: &mut Rng, scan: &Scan) -> u16 {
    const CODES: [u16; 9] = [0, 0, 0, 1, 2, 4, 5, 8, 8];
    let code = if random.u8(..20) == 0 { random.u16(..9) } else { CODES[random.usize(..CODES.len())] };
    ((1 << scan.range_bits) - 1) - code
}

/// A sensor on the robot or off it, turned anyhow, upside down or not.
pub(crate) fn pose(random: &mut Rng) -> Pose {
    let reach_m = [0.0, 0.4, 1.5, 6.0][random.usize(..4)];
    let mut anywhere = || reach_m * (2.0 * random.f64() - 1.0);
    let (x_m, y_m) = (anywhere(), anywhere());
    let yaw_rad = if random.bool() { PI / 2.0 * f64::from(random.u8(..4)) } else { 2.0 * PI * random.f64() };
    Pose { x_m, y_m, yaw_rad, upside_down: random.u8(..2), ..Pose::default() }
}
