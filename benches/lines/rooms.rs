//! Rooms drawn at random as the experiment of PLE draws them (Schaefer, Buescher, Luft, Burgard, IROS 2018): a star-shaped
//! polygon around the sensor, and a scan of it with noise in angle and range. Refuses to know who looks for lines in it.

use std::f64::consts::{PI, TAU};

use fastrand::Rng;
use schema::{Code, Scan, ScanHead};

/// Scans of a draw.
pub(crate) const SCANS: usize = 260;
/// Rays of a scan of the experiment.
pub(crate) const RAYS: usize = 360;
const CORNERS: [usize; 7] = [3, 4, 5, 6, 12, 36, 180];
/// Of a ray's angle, in degrees, and of its range in metres.
const NOISE: (f64, f64) = (0.2, 0.03);

/// The scans of draw `seed`, of so many rays over a full turn with both ends: the first and the last look the same way.
pub(crate) fn draw(seed: u64, rays: usize) -> Vec<Box<Scan>> {
    let mut random = Rng::with_seed(seed);
    (0..SCANS).map(|_| room(&mut random, rays)).collect()
}

fn room(random: &mut Rng, rays: usize) -> Box<Scan> {
    let corners = CORNERS[random.usize(..CORNERS.len())];
    let (turned, scale) = (random.f64(), 5.0 + 5.0 * random.f64());
    let mean = (corners * corners) as f64 / 5.0;
    let distances: Vec<f64> =
        (0..corners).map(|_| scale * (poisson(random, mean) + 1.0) / (mean + 1.0)).collect();
    let (each, step) = (TAU / corners as f64, TAU / (rays - 1) as f64);
    let ranges: Vec<f64> = (0..rays)
        .map(|ray| {
            let angle = ray as f64 * step - PI + NOISE.0.to_radians() * normal(random);
            let from_first = (angle - turned).rem_euclid(TAU);
            let corner = ((from_first / each) as usize).min(corners - 1);
            let (one, two) = (distances[corner], distances[(corner + 1) % corners]);
            let inside = from_first - corner as f64 * each;
            // The wall from one corner to the next, by the law of sines.
            let wall = one * two * each.sin() / (one * inside.sin() + two * (each - inside).sin());
            wall + NOISE.1 * normal(random)
        })
        .collect();
    scan(-PI, step, &ranges)
}

/// A scan of these ranges in metres, in units of 1 mm; no return where one is beyond what a scan can say.
pub(crate) fn scan(first_angle: f64, step: f64, ranges: &[f64]) -> Box<Scan> {
    let head = ScanHead {
        first_angle,
        step,
        spacing: step as f32,
        unit_um: 1000,
        count: ranges.len() as u16,
        valid_to: 0xFFEF,
        no_return: Code::NoReturn.value(),
        beyond: Code::NoReturn.value(),
        turns: 1,
        ..ScanHead::default()
    };
    let in_units = |&range: &f64| if range < 65.0 { (1000.0 * range).round() as u16 } else { head.no_return };
    Scan::of(head, &ranges.iter().map(in_units).collect::<Vec<_>>())
}

/// How many events of an even rate fall into a time in which `mean` are expected.
fn poisson(random: &mut Rng, mean: f64) -> f64 {
    let (mut time, mut count) = (0.0, 0.0);
    loop {
        time -= (1.0 - random.f64()).ln();
        if time > mean {
            return count;
        }
        count += 1.0;
    }
}

/// By Box and Muller.
fn normal(random: &mut Rng) -> f64 {
    (-2.0 * (1.0 - random.f64()).ln()).sqrt() * (TAU * random.f64()).cos()
}
