//! A head that turns clockwise: how far it has come at a time, and how fast it is then. Knows neither points nor packets.

use std::f64::consts::TAU;

use schema::Nanos;

/// How a head turns, from the moment on at which its motor begins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rotation {
    /// Turns in a second, on the mean.
    pub(crate) turns_per_second: f64,
    wander: f64,
    /// Time constant with which it gets up to speed, in seconds; 0: at once.
    pub(crate) spin_up_s: f64,
    /// How fast the speed goes up and down, and where it begins.
    pace: f64,
    phase: f64,
    /// Seconds at which this speed was set, and turns made by then.
    since: (f64, f64),
}

/// A point as the head measures it, without noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TruePoint {
    /// When it is measured.
    pub at_ns: Nanos,
    /// Degrees, clockwise from the head's zero, 0 to 360.
    pub clockwise_deg: f64,
    /// What lies there in millimetres, if anything does.
    pub range_mm: Option<f64>,
}

impl Rotation {
    /// A head that makes so many turns in a second on the mean, and goes up and down by the share `wander` of that. It gets up
    /// to speed with a time constant of `spin_up_s` seconds; 0: at once. `seed` says where it begins, and how it wanders.
    pub(crate) fn new(turns_per_second: f64, wander: f64, spin_up_s: f64, seed: u64) -> Rotation {
        let phase = TAU * fastrand::Rng::with_seed(seed).f64();
        // A head does not begin where its zero is.
        Rotation {
            turns_per_second,
            wander,
            spin_up_s,
            pace: TAU / WANDER_S,
            phase,
            since: (0.0, phase / TAU),
        }
    }

    /// It makes so many turns in a second from `seconds` on; what was before is not told any more.
    pub(crate) fn set_speed(&mut self, seconds: f64, turns_per_second: f64) {
        self.since = (seconds, self.turns(seconds));
        self.turns_per_second = turns_per_second;
    }

    /// Turns made after `seconds`, of which the whole ones count from the head's zero.
    pub(crate) fn turns(&self, seconds: f64) -> f64 {
        let (since, turned) = self.since;
        let angle = |seconds: f64| (self.pace * seconds + self.phase).sin();
        let swing = (angle(seconds) - angle(since)) / self.pace;
        let missed = self.spin_up_s * (self.still(since) - self.still(seconds));
        self.turns_per_second * (seconds - since - missed + self.wander * swing) + turned
    }

    /// Turns in a second after `seconds`.
    pub(crate) fn speed(&self, seconds: f64) -> f64 {
        let wander = self.wander * (self.pace * seconds + self.phase).cos();
        self.turns_per_second * (1.0 - self.still(seconds) + wander)
    }

    /// Share of the speed that is still missing.
    fn still(&self, seconds: f64) -> f64 {
        if self.spin_up_s > 0.0 { (-seconds / self.spin_up_s).exp() } else { 0.0 }
    }
}

/// The angle of a head that turns clockwise, `clockwise_deg` from its zero: degrees, 0 ahead, counter-clockwise, -180
/// to 180.
pub(crate) fn ahead_deg(clockwise_deg: f64) -> f64 {
    if clockwise_deg > 180.0 { 360.0 - clockwise_deg } else { -clockwise_deg }
}

/// The speed goes up and down once in so many seconds.
const WANDER_S: f64 = 7.3;
