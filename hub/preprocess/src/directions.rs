//! Directions of a scan's beams.

use scanhub_schema::{Pose, Scan};

/// Directions of the beams of one sensor in the robot's frame, as unit vectors.
pub(crate) struct Directions {
    /// Pose of the sensor, and first angle and step of the scans, for which `grid` was computed. `None` before that.
    layout: Option<(Pose, f64, f64)>,
    /// Directions of the beams at equal steps, without the exact angles that a scan may have.
    grid: Box<[(f64, f64)]>,
}

impl Directions {
    /// Allocates the directions of at most `beams` beams.
    pub(crate) fn new(beams: usize) -> Directions {
        Directions { layout: None, grid: vec![(0.0, 0.0); beams].into() }
    }

    /// Adapts the directions to scans with the angles of `scan`, for a sensor at `pose`. Returns whether the directions
    /// have changed.
    pub(crate) fn fit(&mut self, pose: &Pose, scan: &Scan) -> bool {
        let layout = Some((*pose, scan.first_angle, scan.step));
        if self.layout == layout {
            return false;
        }
        self.layout = layout;
        for (i, direction) in self.grid.iter_mut().enumerate() {
            *direction = pose.direction(scan.first_angle + i as f64 * scan.step);
        }
        true
    }

    /// Returns the direction of beam `i` on the grid, or `None` if there is no such beam.
    pub(crate) fn on_grid(&self, i: usize) -> Option<(f64, f64)> {
        self.grid.get(i).copied()
    }

    /// Returns the readings of `scan` in the order of the beams, except readings of 0. Each item has the index of the
    /// beam, its direction, and its range in meters. The direction is computed from the exact angle, if there is one.
    pub(crate) fn readings<'a>(
        &'a self,
        pose: &'a Pose,
        scan: &'a Scan,
    ) -> impl Iterator<Item = (usize, (f64, f64), f64)> + 'a {
        let unit_m = f64::from(scan.unit_um) * 1e-6;
        let exact = scan.exact_angles();
        self.grid.iter().enumerate().take(scan.beams()).filter_map(move |(i, &on_grid)| {
            let range = scan.range(i).map_or(0.0, |range| f64::from(range) * unit_m);
            let direction = || exact_angle(exact, i).map_or(on_grid, |exact| pose.direction(exact));
            (range > 0.0).then(|| (i, direction(), range))
        })
    }
}

/// Returns the exact angle of beam `i` in radians, or `None` if `exact` has no angle for this beam.
pub(crate) fn exact_angle(exact: &[f32], i: usize) -> Option<f64> {
    exact.get(i).filter(|angle| angle.is_finite()).map(|&angle| f64::from(angle))
}
