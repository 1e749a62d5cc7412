//! Who comes out of the corridor, guessed by somebody who sees every door exactly and knows how fast people walk in this
//! house, and how many stop for how long, but no person's own pace.

use crate::walkers::{CORRIDOR, Crossing, Crowd, PACE, STOPS};

/// Whether the oracle, at the moment of `crossing`, names the right one of all who are inside: the one whose coming out now is
/// the most likely, given that nobody else has come out before.
pub(crate) fn guess(crowd: &Crowd, crossing: &Crossing) -> bool {
    let inside = crowd
        .crossings
        .iter()
        .filter(|other| other.entered_s < crossing.left_s && other.left_s >= crossing.left_s);
    let best = inside.max_by(|a, b| {
        let hazard = |one: &Crossing| hazard(crossing.left_s - one.entered_s);
        hazard(a).total_cmp(&hazard(b))
    });
    best.is_some_and(|best| best.walker == crossing.walker)
}

/// Density of the time inside over what is left of it, by the walkers' own distribution.
fn hazard(after_s: f64) -> f64 {
    let way = CORRIDOR[1] - CORRIDOR[0];
    let (mut density, mut remains) = (1e-9, 1e-9);
    let width = 0.3;
    for i in 0..60 {
        let z = -3.0 + 0.1 * f64::from(i);
        let weight = (-z * z / 2.0).exp();
        let walks_s = way / (PACE.0 + PACE.1 * z).clamp(0.7, 1.7);
        let mut add = |takes_s: f64, weight: f64| {
            if (takes_s - after_s).abs() < width {
                density += weight;
            }
            if takes_s > after_s {
                remains += weight;
            }
        };
        add(walks_s, weight * (1.0 - STOPS.0));
        for stop in 0..20 {
            add(walks_s + STOPS.1 * (f64::from(stop) + 0.5) / 20.0, weight * STOPS.0 / 20.0);
        }
    }
    density / remains
}
