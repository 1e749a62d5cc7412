//! Where the foreground of a sensor was over the last moments, in steps that are few enough to be drawn. Time is an argument.

use std::collections::VecDeque;

/// The steps of a trail, the oldest first.
#[derive(Clone, Debug, Default)]
pub struct Trail {
    /// When, in ns of CLOCK_MONOTONIC, and the points in the robot's frame, in metres.
    steps: VecDeque<(u64, Vec<(f64, f64)>)>,
}

impl Trail {
    /// Takes what the foreground is at `now_ns`, unless the last step was just now.
    pub(crate) fn take(&mut self, now_ns: u64, points: impl FnOnce() -> Vec<(f64, f64)>) {
        if self.steps.back().is_none_or(|(at_ns, _)| now_ns >= at_ns + STEP_NS) {
            self.steps.push_back((now_ns, points()));
        }
        self.age(now_ns);
    }

    /// Forgets what is too long ago at `now_ns`; whether there was such.
    pub(crate) fn age(&mut self, now_ns: u64) -> bool {
        let before = self.steps.len();
        self.steps.retain(|(at_ns, _)| now_ns < at_ns + TRAIL_NS);
        before != self.steps.len()
    }

    /// The points of all steps.
    pub fn points(&self) -> impl Iterator<Item = (f64, f64)> {
        self.steps.iter().flat_map(|(_, points)| points.iter().copied())
    }
}

/// Between two steps.
const STEP_NS: u64 = 90_000_000;
/// Of the whole trail.
const TRAIL_NS: u64 = 1_600_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trail_has_few_steps_and_an_end() {
        let mut trail = Trail::default();
        for n in 0..100 {
            trail.take(n * 25_000_000, || vec![(n as f64, 0.0)]);
        }
        let steps: Vec<_> = trail.points().map(|(x, _)| x).collect();
        assert_eq!((steps.first(), steps.last(), steps.len()), (Some(&36.0), Some(&96.0), 16));
        assert!(!trail.age(2_499_999_999) && trail.age(2_500_000_000));
        trail.age(u64::MAX);
        assert_eq!(trail.points().count(), 0);
    }
}
