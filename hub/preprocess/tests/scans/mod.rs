//! Random scans of all kinds of sensors, with codes among the ranges. The scans have random variants, units, measuring
//! modes and poses of the sensor.
#![allow(dead_code)] // each test takes what it needs

use std::f64::consts::PI;

use fastrand::Rng;
use scanhub_schema::{Pose, Scan, ScanHead};

/// The five variants of an LMS: number of beams, first angle and step. Angles are in 1/1000 degree.
pub(crate) const LMS_VARIANTS: [(usize, i32, u32); 5] = [
    (181, -90_000, 1000),
    (361, -90_000, 500),
    (101, -50_000, 1000),
    (201, -50_000, 500),
    (401, -50_000, 250),
];

/// Returns a scan of a random variant in units of `unit_mm`, with 13, 14 or 15 bits of range. All its ranges are 0.
pub(crate) fn layout(random: &mut Rng, unit_mm: u32) -> Box<Scan> {
    let (count, first_angle_mdeg, step_mdeg) = LMS_VARIANTS[random.usize(..LMS_VARIANTS.len())];
    let range_bits = random.u8(13..=15);
    let head = ScanHead::lms(count, first_angle_mdeg, step_mdeg, unit_mm, range_bits);
    Scan::of(ScanHead { intensity_bits: 16 - range_bits, ..head }, &vec![0; count])
}

/// Returns a random code for a beam of `scan`. Some of the codes are reserved.
pub(crate) fn code(random: &mut Rng, scan: &Scan) -> u16 {
    const CODES: [u16; 9] = [0, 0, 0, 1, 2, 4, 5, 8, 8];
    let code = if random.u8(..20) == 0 { random.u16(..9) } else { CODES[random.usize(..CODES.len())] };
    scan.no_return - code
}

/// Returns the device unit of `scan` in millimeters.
pub(crate) fn unit_mm(scan: &Scan) -> f64 {
    f64::from(scan.unit_um) / 1000.0
}

/// Returns a random pose of a sensor, on the robot or away from it, with a random yaw. The sensor may be upside down.
pub(crate) fn pose(random: &mut Rng) -> Pose {
    let reach_m = [0.0, 0.4, 1.5, 6.0][random.usize(..4)];
    let mut anywhere = || reach_m * (2.0 * random.f64() - 1.0);
    let (x_m, y_m) = (anywhere(), anywhere());
    let yaw_rad = if random.bool() { PI / 2.0 * f64::from(random.u8(..4)) } else { 2.0 * PI * random.f64() };
    Pose { x_m, y_m, yaw_rad, upside_down: random.u8(..2), ..Pose::default() }
}
