//! Parts that all simulated rotating scanners share: the clockwise rotation of the head, and the measurement of a room
//! beam by beam, each beam at its own time and angle.

use std::f64::consts::TAU;

use scanhub_schema::Nanos;

use crate::beam::echo;
use crate::beam::{BeamRng, NoiseModel};
use crate::room::{Room, RoomView, reported_range};
use crate::view::View;

/// Rotation of a head since the start of its motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rotation {
    /// Mean revolutions per second.
    pub(crate) revolutions_per_second: f64,
    speed_variation: f64,
    /// Time constant of the spin-up, in seconds; 0 means full speed at once.
    pub(crate) spin_up_s: f64,
    /// Angular frequency of the variation of the speed, in radians per second.
    angular_frequency: f64,
    /// Phase of the variation at the start, in radians.
    phase: f64,
    /// Time in seconds at which the mean speed was set, and the number of revolutions until then.
    since: (f64, f64),
}

/// A point as the head measures it, without noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TruePoint {
    /// Time of the measurement.
    pub at_ns: Nanos,
    /// Clockwise angle from the head's zero, 0 to 360 degrees.
    pub clockwise_deg: f64,
    /// Range of the surface in millimeters; `None` if there is no surface.
    pub range_mm: Option<f64>,
}

impl Rotation {
    /// Creates the rotation of a head with a mean speed of `revolutions_per_second` that varies by the share
    /// `speed_variation`. The spin-up has a time constant of `spin_up_s` seconds; 0 means full speed at once. `seed`
    /// selects the angle at the start and the phase of the variation.
    pub(crate) fn new(
        revolutions_per_second: f64,
        speed_variation: f64,
        spin_up_s: f64,
        seed: u64,
    ) -> Rotation {
        let phase = TAU * fastrand::Rng::with_seed(seed).f64();
        // A head does not start at its zero.
        Rotation {
            revolutions_per_second,
            speed_variation,
            spin_up_s,
            angular_frequency: TAU / SPEED_VARIATION_PERIOD_S,
            phase,
            since: (0.0, phase / TAU),
        }
    }

    /// Changes the mean speed from `seconds` on. Earlier angles can no longer be queried.
    pub(crate) fn set_speed(&mut self, seconds: f64, revolutions_per_second: f64) {
        self.since = (seconds, self.revolutions(seconds));
        self.revolutions_per_second = revolutions_per_second;
    }

    /// Returns the number of revolutions until `seconds`, counted from the head's zero.
    pub(crate) fn revolutions(&self, seconds: f64) -> f64 {
        let (since, revolutions_before) = self.since;
        let angle = |seconds: f64| (self.angular_frequency * seconds + self.phase).sin();
        let swing = (angle(seconds) - angle(since)) / self.angular_frequency;
        let missed = self.spin_up_s * (self.missing_share(since) - self.missing_share(seconds));
        self.revolutions_per_second * (seconds - since - missed + self.speed_variation * swing)
            + revolutions_before
    }

    /// Returns the revolutions per second at `seconds`.
    pub(crate) fn speed(&self, seconds: f64) -> f64 {
        let wander = self.speed_variation * (self.angular_frequency * seconds + self.phase).cos();
        self.revolutions_per_second * (1.0 - self.missing_share(seconds) + wander)
    }

    /// Returns the share of the speed that is still missing at `seconds`.
    fn missing_share(&self, seconds: f64) -> f64 {
        if self.spin_up_s > 0.0 { (-seconds / self.spin_up_s).exp() } else { 0.0 }
    }
}

/// Converts a clockwise angle from the head's zero to a counterclockwise angle: 0 is ahead, -180 to 180 degrees.
pub(crate) fn counterclockwise_deg(clockwise_deg: f64) -> f64 {
    if clockwise_deg > 180.0 { 360.0 - clockwise_deg } else { -clockwise_deg }
}

/// Measures a room beam by beam.
#[derive(Clone, Debug)]
pub(crate) struct BeamSampler {
    room: Room,
    /// View of the surroundings of the last beam. The next beam replaces everything in it except the static faces.
    view: Option<View>,
    /// One sampler for each room, if `room` has precomputed scans; otherwise empty.
    rooms: Vec<BeamSampler>,
}

/// Result of one beam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct BeamReading {
    /// Measured range in millimeters; `None` without an echo, or if the echo is too weak.
    pub(crate) range_mm: Option<f64>,
    /// Range of the surface without noise, in millimeters; `None` if there is no surface.
    pub(crate) exact_mm: Option<f64>,
    /// Intensity of the echo, 0 to 255.
    pub(crate) intensity: u8,
    /// Strength of the echo relative to a white surface at 1 m; infinite in a world without noise.
    pub(crate) signal: f64,
}

impl BeamSampler {
    pub(crate) fn new(room: Room) -> BeamSampler {
        let rooms = match &room.view {
            RoomView::PrecomputedScans(series, _) => {
                series.rooms().map(|room| BeamSampler::new(room.clone())).collect()
            }
            _ => Vec::new(),
        };
        BeamSampler { room, view: None, rooms }
    }

    /// Measures the beam at `angle_deg` (0 ahead, counterclockwise, -180 to 180) at `at_ns`.
    pub(crate) fn measure(&mut self, at_ns: Nanos, angle_deg: f64) -> BeamReading {
        if let RoomView::PrecomputedScans(series, changes) = &self.room.view {
            return self.rooms[series.number(changes, at_ns)].measure(at_ns, angle_deg);
        }
        let mut random = fastrand::Rng::with_seed(self.room.seed ^ at_ns.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let rng = BeamRng::draw(&mut random);
        let all = |range_mm: Option<f64>| BeamReading {
            range_mm,
            exact_mm: range_mm,
            intensity: PLAIN_INTENSITY as u8,
            signal: f64::INFINITY,
        };
        let world = match &self.room.view {
            RoomView::Scene(world) => world,
            RoomView::Empty | RoomView::PrecomputedScans(..) => {
                return BeamReading { intensity: 0, ..all(None) };
            }
            RoomView::Value(value) => return all(Some(f64::from(*value))),
            RoomView::Random => return all(Some(f64::from(random.u16(..12_000)))),
        };
        let view = self.view.get_or_insert_with(|| world.still().clone());
        world.show_beam(view, angle_deg, at_ns);
        let angle_mdeg = (angle_deg * 1e3) as i32;
        let echo = echo(view, angle_mdeg, world.noise.spot, &rng);
        let (ray_mm, exact_mm) = view.exact(angle_deg);
        // The beam lies between two rays. If it hits a single surface, correct the range of the ray to the point at
        // which the beam hits this surface.
        let is_one = echo.range_mm == ray_mm;
        let off_mm = exact_mm.filter(|_| is_one).map_or(0.0, |exact_mm| exact_mm - ray_mm);
        let time_s = at_ns as f64 / 1e9;
        let sun = world.suns.iter().map(|sun| sun.share(angle_mdeg, time_s)).fold(0.0, f64::max);
        let range_mm = reported_range(world, &echo, sun, &rng).ok().map(|range_mm| range_mm + off_mm);
        let plain = PLAIN_INTENSITY * echo.signal.min(1.0).powf(0.25);
        let intensity = if echo.reflector_share > 0.0 {
            plain.max(REFLECTOR_INTENSITY * echo.reflector_share)
        } else {
            plain
        };
        let signal = if world.noise != NoiseModel::NONE { echo.signal } else { f64::INFINITY };
        BeamReading { range_mm, exact_mm, intensity: range_mm.map_or(0, |_| intensity as u8), signal }
    }
}

/// Period of the variation of the speed, in seconds.
const SPEED_VARIATION_PERIOD_S: f64 = 7.3;
/// Intensity of a plain surface at a short range. According to the manual of the LD06, it is 228 to 233 at 0.2 m.
const PLAIN_INTENSITY: f64 = 230.0;
/// Intensity of a reflector.
const REFLECTOR_INTENSITY: f64 = 255.0;
