//! Oracle that guesses who comes out of the corridor. The oracle has the exact time of each passage through a door, and
//! the distributions of walking speed and stops in this house, but no person's own pace.

use crate::walkers::{CORRIDOR_X, Crossing, Crowd, STOP_SHARE, WALKING_SPEED};

/// Returns whether the oracle identifies the person of `crossing` correctly. The oracle chooses the person in the
/// corridor who is most likely to come out at that time, given that they have not come out before.
pub(crate) fn is_guess_right(crowd: &Crowd, crossing: &Crossing) -> bool {
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

/// ID of each walker over time, according to an observer that sees everything in the rooms and uses the oracle for
/// everyone who comes out of the corridor. No tracker can be expected to do better if it neither sees into the corridor
/// nor has each person's pace.
pub(crate) struct Identities {
    /// Entries into the corridor and exits from it in order of time: time in seconds, walker, and whether the event is
    /// an exit.
    events: Vec<(f64, usize, bool)>,
    next_event: usize,
    /// ID of each walker.
    pub(crate) current_ids: Vec<usize>,
    /// Time of entry and ID of everyone who is in the corridor.
    inside: Vec<(f64, usize)>,
}

impl Identities {
    pub(crate) fn new(crowd: &Crowd) -> Identities {
        let through = crowd.crossings.iter();
        let through =
            through.flat_map(|one| [(one.entered_s, one.walker, false), (one.left_s, one.walker, true)]);
        let still = crowd.walkers.iter().enumerate();
        let still = still.filter_map(|(walker_index, walker)| Some((walker.entered_s?, walker_index, false)));
        let mut events: Vec<_> = through.chain(still).collect();
        events.sort_by(|a, b| a.0.total_cmp(&b.0));
        Identities {
            events,
            next_event: 0,
            current_ids: (0..crowd.walkers.len()).collect(),
            inside: Vec::new(),
        }
    }

    /// Handles the events up to `now_s`.
    pub(crate) fn advance(&mut self, now_s: f64) {
        while let Some(&(at_s, walker, is_out)) =
            self.events.get(self.next_event).filter(|event| event.0 <= now_s)
        {
            self.next_event += 1;
            if !is_out {
                self.inside.push((at_s, self.current_ids[walker]));
                continue;
            }
            let likely = |one: &usize| hazard(at_s - self.inside[*one].0);
            let best = (0..self.inside.len()).max_by(|a, b| likely(a).total_cmp(&likely(b)));
            if let Some(best) = best {
                self.current_ids[walker] = self.inside.swap_remove(best).1;
            }
        }
    }
}

/// Returns the hazard rate of coming out of the corridor after `after_s` seconds inside: the density divided by the
/// remaining probability. The distribution is the one from which the walkers' speeds and stops are drawn.
fn hazard(after_s: f64) -> f64 {
    let corridor_m = CORRIDOR_X[1] - CORRIDOR_X[0];
    let (mut density, mut remains) = (1e-9, 1e-9);
    let width = 0.3;
    for i in 0..60 {
        let z = -3.0 + 0.1 * f64::from(i);
        let weight = (-z * z / 2.0).exp();
        let walks_s = corridor_m / (WALKING_SPEED.0 + WALKING_SPEED.1 * z).clamp(0.7, 1.7);
        let mut add = |takes_s: f64, weight: f64| {
            if (takes_s - after_s).abs() < width {
                density += weight;
            }
            if takes_s > after_s {
                remains += weight;
            }
        };
        add(walks_s, weight * (1.0 - STOP_SHARE.0));
        for stop in 0..20 {
            add(walks_s + STOP_SHARE.1 * (f64::from(stop) + 0.5) / 20.0, weight * STOP_SHARE.0 / 20.0);
        }
    }
    density / remains
}
