//! Geometry of a mount, and a check of the mount's description. If the axis, the arm and the level angle in the
//! description are right, the points of a flat floor are level, and the points of a wall ahead are upright.

use super::Sweep;

/// A mount with one axis, and the scanner on it. Positions are in the robot's frame in meters: x forward, y left, z up
/// from the floor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mount {
    /// A point on the axis.
    pub axis_at: [f64; 3],
    /// Direction of the axis. The vector may have any length except 0. Angles are right-handed: around y, which is the
    /// default, a larger angle tilts the scanner down; around -y, it tilts the scanner up.
    pub axis: [f64; 3],
    /// Angle of the mount at which the scanner is level, so that its beams are horizontal. `sensor_at` and `yaw_rad`
    /// are given for this angle.
    pub level_rad: f64,
    /// Origin of the beams.
    pub sensor_at: [f64; 3],
    /// Direction of the scanner, counterclockwise from forward.
    pub yaw_rad: f64,
    /// Whether the scanner is mounted upside down, so that its beams run clockwise.
    pub is_upside_down: bool,
}

impl Default for Mount {
    /// Returns a mount whose axis goes through the scanner, which is at the origin and faces forward.
    fn default() -> Mount {
        Mount {
            axis_at: [0.0; 3],
            axis: [0.0, 1.0, 0.0],
            level_rad: 0.0,
            sensor_at: [0.0; 3],
            yaw_rad: 0.0,
            is_upside_down: false,
        }
    }
}

impl Mount {
    /// Returns the direction of the beam at `beam_rad` (counterclockwise from the scanner's direction) at the mount's
    /// angle `angle_rad`, as a unit vector.
    pub fn direction(&self, angle_rad: f64, beam_rad: f64) -> [f64; 3] {
        let turned = if self.is_upside_down { -beam_rad } else { beam_rad };
        let (sin, cos) = (self.yaw_rad + turned).sin_cos();
        self.rotated([cos, sin, 0.0], angle_rad)
    }

    /// Returns the origin of the beams at the mount's angle `angle_rad`.
    pub fn origin(&self, angle_rad: f64) -> [f64; 3] {
        let arm = std::array::from_fn(|i| self.sensor_at[i] - self.axis_at[i]);
        let arm = self.rotated(arm, angle_rad);
        std::array::from_fn(|i| self.axis_at[i] + arm[i])
    }

    /// Returns the point at range `range_m` on the beam with direction `beam_rad`, at the mount's angle `angle_rad`.
    pub fn point(&self, angle_rad: f64, beam_rad: f64, range_m: f64) -> [f64; 3] {
        let (origin, direction) = (self.origin(angle_rad), self.direction(angle_rad, beam_rad));
        std::array::from_fn(|i| origin[i] + range_m * direction[i])
    }

    /// Rotates `v` around the axis, from the level angle to `angle_rad`, by Rodrigues' formula.
    fn rotated(&self, v: [f64; 3], angle_rad: f64) -> [f64; 3] {
        let length = dot(self.axis, self.axis).sqrt();
        let k = self.axis.map(|value| value / length);
        let (sin, cos) = (angle_rad - self.level_rad).sin_cos();
        let (across, along) = (cross(k, v), dot(k, v));
        std::array::from_fn(|i| v[i] * cos + across[i] * sin + k[i] * along * (1.0 - cos))
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Maximum height of the floor's points above or below 0, in meters.
const MAX_FLOOR_OFFSET_M: f64 = 0.4;
/// Maximum distance of a point that is used, in meters. At a larger distance, a small error of the angle moves a point
/// too far.
const MAX_DISTANCE_M: f64 = 6.0;
/// Minimum height of the points of a wall, in meters.
const MIN_WALL_POINT_HEIGHT_M: f64 = 0.3;
/// Width of the distance bins in which points are counted to find the wall, in meters.
const BIN_M: f64 = 0.1;
/// Minimum number of points on a plane.
const MIN_POINTS: usize = 300;
/// Minimum height of a wall in meters.
const MIN_WALL_HEIGHT_M: f64 = 0.4;
/// Maximum standard deviation of the points of a wall, in meters.
const MAX_ROUGHNESS_M: f64 = 0.07;
/// Maximum number of points that are stored for each sweep. Each sweep has its own limit and therefore the same weight,
/// because up and down sweeps can differ.
const MAX_POINTS: usize = 40_000;

/// Check of the mount's description, with the points of several sweeps.
#[derive(Debug, Default)]
pub struct MountCheck {
    points: Vec<[f64; 3]>,
    sweeps: u32,
    /// Delay by which the angles of the stored sweeps were corrected, in ns.
    late_ns: i64,
}

/// A flat floor, computed from the points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Floor {
    /// Height of the floor at the axis, in meters. It is 0 if the description of the mount is right.
    pub height_m: f64,
    /// Angle in radians by which the scanner points lower than the description of the mount states.
    pub level_rad: f64,
    /// Angle in radians by which the floor rises to the left.
    pub roll_rad: f64,
    /// Standard deviation of the points in meters.
    pub deviation_m: f64,
    /// Number of points.
    pub points: usize,
}

/// A wall ahead, computed from the points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wall {
    /// Distance from the robot's origin at the floor, in meters.
    pub distance_m: f64,
    /// Angle in radians by which the wall leans backward.
    pub lean_rad: f64,
    /// Standard deviation of the points in meters.
    pub deviation_m: f64,
    /// Number of points.
    pub points: usize,
}

impl MountCheck {
    /// Adds the points of a complete sweep. If this sweep was corrected by another delay than earlier sweeps, the check
    /// restarts with this sweep.
    pub fn take(&mut self, sweep: &Sweep<'_>) {
        if !sweep.is_complete {
            return;
        }
        if sweep.late_ns != self.late_ns {
            *self = MountCheck { late_ns: sweep.late_ns, ..MountCheck::default() };
        }
        self.sweeps += 1;
        let points = sweep.points.iter().map(|point| point.at.map(f64::from));
        let near = points.filter(|at| at[0].hypot(at[1]) < MAX_DISTANCE_M);
        let every = near.clone().count().div_ceil(MAX_POINTS).max(1);
        self.points.extend(near.step_by(every));
    }

    /// Returns the number of sweeps since the check started or restarted.
    pub fn sweeps(&self) -> u32 {
        self.sweeps
    }

    /// Returns the floor, if enough points are on one plane.
    pub fn floor(&self, mount: &Mount) -> Option<Floor> {
        let is_low =
            |at: &&[f64; 3]| at[2].abs() < MAX_FLOOR_OFFSET_M && at[0].hypot(at[1]) < MAX_DISTANCE_M / 2.0;
        let low = self.points.iter().filter(is_low).map(|at| ([1.0, at[0], at[1]], at[2]));
        let plane = Plane::of(low.collect())?;
        let [height, ahead, left] = plane.terms;
        let [kx, ky, _] = mount.axis;
        let square = kx * kx + ky * ky;
        if square == 0.0 {
            return None;
        }
        // A rotation around the axis moves a point up by kx y - ky x per radian.
        let length = (square + mount.axis[2].powi(2)).sqrt();
        let level_rad = (ahead * ky - left * kx) * length / square;
        let roll_rad = (ahead * kx + left * ky) / square.sqrt();
        let at_axis = height + ahead * mount.axis_at[0] + left * mount.axis_at[1];
        Some(Floor {
            height_m: at_axis,
            level_rad,
            roll_rad,
            deviation_m: plane.deviation,
            points: plane.points,
        })
    }

    /// Returns the wall with the largest area within 45 degrees of the forward direction.
    pub fn wall(&self) -> Option<Wall> {
        let high: Vec<[f64; 3]> =
            self.points.iter().filter(|at| at[2] > MIN_WALL_POINT_HEIGHT_M && at[0] > 0.3).copied().collect();
        let mut best = (0.0, 0.0, 0.0);
        for degrees in -45..=45 {
            let yaw = f64::from(degrees).to_radians();
            let mut areas = [0.0; (MAX_DISTANCE_M / BIN_M) as usize + 2];
            for at in &high {
                let distance = at[0] * yaw.cos() + at[1] * yaw.sin();
                // Points of a side wall can have a negative distance.
                if distance >= 0.0
                    && let Some(area) = areas.get_mut((distance / BIN_M) as usize)
                {
                    // The beams diverge, so a near wall has more points per square meter. Without this weight, a part
                    // of a near side wall would count more than a wall ahead.
                    *area += at[0].powi(2) + at[1].powi(2);
                }
            }
            for (bin, pair) in areas.windows(2).enumerate() {
                if pair[0] + pair[1] > best.0 {
                    best = (pair[0] + pair[1], yaw, (bin + 1) as f64 * BIN_M);
                }
            }
        }
        let (_, yaw, distance_m) = best;
        let (sin, cos) = yaw.sin_cos();
        let off = |at: &[f64; 3]| at[0] * cos + at[1] * sin;
        let on: Vec<_> = high
            .iter()
            .filter(|at| (off(at) - distance_m).abs() < 2.0 * BIN_M)
            .map(|at| ([1.0, at[1] * cos - at[0] * sin, at[2]], off(at)))
            .collect();
        let heights = on.iter().map(|(terms, _)| terms[2]);
        let (low, top) = heights.fold((f64::INFINITY, 0.0_f64), |(low, top), z| (low.min(z), top.max(z)));
        if top - low < MIN_WALL_HEIGHT_M {
            return None;
        }
        let plane = Plane::of(on).filter(|plane| plane.deviation < MAX_ROUGHNESS_M)?;
        // The search tries only whole degrees, so the wall is not exactly perpendicular to the direction that the
        // search found.
        let [distance, slope, lean] = plane.terms;
        let across = slope.hypot(1.0);
        Some(Wall {
            distance_m: distance / across,
            lean_rad: (lean / across).atan(),
            deviation_m: plane.deviation / across,
            points: plane.points,
        })
    }
}

/// Coefficients of the plane that fits most points best.
struct Plane {
    terms: [f64; 3],
    deviation: f64,
    points: usize,
}

impl Plane {
    /// Fits a plane by least squares, 8 times. After each fit, drops the points that are far from the plane. Returns
    /// `None` if too few points remain.
    fn of(mut points: Vec<([f64; 3], f64)>) -> Option<Plane> {
        let mut plane = None;
        for _ in 0..8 {
            if points.len() < MIN_POINTS {
                return None;
            }
            let terms = solve(&points)?;
            let off = |(a, b): &([f64; 3], f64)| b - (0..3).map(|i| a[i] * terms[i]).sum::<f64>();
            let deviation =
                (points.iter().map(|point| off(point).powi(2)).sum::<f64>() / points.len() as f64).sqrt();
            plane = Some(Plane { terms, deviation, points: points.len() });
            let most = (2.0 * deviation).max(0.02);
            points.retain(|point| off(point).abs() < most);
        }
        plane
    }
}

/// Solves the normal equations by Cramer's rule.
fn solve(points: &[([f64; 3], f64)]) -> Option<[f64; 3]> {
    let (mut m, mut v) = ([[0.0; 3]; 3], [0.0; 3]);
    for (a, b) in points {
        for i in 0..3 {
            v[i] += a[i] * b;
            for j in 0..3 {
                m[i][j] += a[i] * a[j];
            }
        }
    }
    let whole = determinant(&m);
    let is_regular = whole.abs() > 1e-9 * (m[0][0] * m[1][1] * m[2][2]).abs();
    is_regular.then(|| {
        std::array::from_fn(|column| {
            let mut other = m;
            (0..3).for_each(|row| other[row][column] = v[row]);
            determinant(&other) / whole
        })
    })
}

fn determinant(m: &[[f64; 3]; 3]) -> f64 {
    m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, FRAC_PI_6};

    use super::*;
    use crate::tilt::Point;

    fn is_near(a: [f64; 3], b: [f64; 3]) -> bool {
        (0..3).all(|i| (a[i] - b[i]).abs() < 1e-9)
    }

    #[test]
    fn greater_angle_points_down_to_the_floor() {
        let mount = Mount { axis_at: [0.0, 0.0, 1.0], sensor_at: [0.0, 0.0, 1.0], ..Mount::default() };
        assert!(is_near(mount.point(FRAC_PI_6, 0.0, 2.0), [3.0_f64.sqrt(), 0.0, 0.0]));
        assert!(
            is_near(mount.point(FRAC_PI_6, FRAC_PI_2, 2.0), [0.0, 2.0, 1.0]),
            "along the axis nothing sinks"
        );
        let other = Mount { axis: [0.0, -2.0, 0.0], ..mount };
        assert!(is_near(other.point(-FRAC_PI_6, 0.0, 2.0), [3.0_f64.sqrt(), 0.0, 0.0]));
    }

    #[test]
    fn arm_rotates_with_the_mount_relative_to_level() {
        let mount = Mount {
            axis_at: [0.1, 0.0, 1.0],
            sensor_at: [0.2, 0.0, 1.0],
            level_rad: 0.3,
            yaw_rad: FRAC_PI_2,
            is_upside_down: true,
            ..Mount::default()
        };
        assert!(is_near(mount.point(0.3, 0.0, 1.0), [0.2, 1.0, 1.0]));
        assert!(is_near(mount.point(0.3, FRAC_PI_2, 1.0), [1.2, 0.0, 1.0]), "it hangs");
        assert!(is_near(mount.origin(0.3 + FRAC_PI_2), [0.1, 0.0, 0.9]));
    }

    /// Checks a mount in a room with a wall 3 m ahead and a box on the floor. `real` is the mount, and `described` is
    /// its description.
    fn check_room(real: &Mount, described: &Mount) -> (Floor, Wall) {
        let mut points = Vec::new();
        for tenth in -150..450 {
            for beam in -60..=60 {
                let (down, beam) = (f64::from(tenth).to_radians() / 10.0, f64::from(beam).to_radians());
                let angle = down * real.axis[1].signum();
                let (from, direction) = (real.origin(angle), real.direction(angle, beam));
                let to = |at: f64, axis: usize| {
                    Some((at - from[axis]) / direction[axis])
                        .filter(|range| *range > 0.1 && direction[axis].abs() > 1e-3)
                };
                let on_box = to(1.5, 0).filter(|range| {
                    let [y, z] = [1, 2].map(|i| from[i] + range * direction[i]);
                    (-0.3..0.3).contains(&y) && (0.0..0.35).contains(&z)
                });
                let ranges = [to(0.0, 2), to(3.0, 0), on_box].into_iter().flatten();
                let range = ranges.fold(f64::INFINITY, f64::min);
                if range < 8.0 {
                    let at = described.point(angle, beam, range).map(|value| value as f32);
                    points.push(Point { at, ..Point::default() });
                }
            }
        }
        let mut check = MountCheck::default();
        check.take(&Sweep { points: &points, ..Sweep::default() });
        assert_eq!(check.sweeps(), 0, "not complete");
        check.take(&Sweep { points: &points, is_complete: true, ..Sweep::default() });
        assert_eq!(check.sweeps(), 1);
        (check.floor(described).expect("a floor"), check.wall().expect("a wall"))
    }

    #[test]
    fn side_wall_behind_the_origin_is_not_a_wall_ahead() {
        let grid =
            |points: usize| (0..points).map(|i| (0.005 * (i % 100) as f32, 0.1 * (i / 100 % 10) as f32));
        let ahead = grid(2000).map(|(y, z)| [3.0, 4.0 * y - 1.0, 0.4 + z]);
        // Along a direction to the left, all points of the wall have negative distances.
        let right = grid(2500).map(|(x, z)| [0.35 + 4.0 * x, -3.0 - 4.0 * x, 0.4 + z]);
        let points: Vec<Point> = ahead.chain(right).map(|at| Point { at, ..Point::default() }).collect();
        let mut check = MountCheck::default();
        check.take(&Sweep { points: &points, is_complete: true, ..Sweep::default() });
        let wall = check.wall().expect("a wall");
        assert!((wall.distance_m - 3.0).abs() < 0.01, "{wall:?}");
    }

    #[test]
    fn each_sweep_has_equal_weight_in_the_check() {
        let points: Vec<Point> = (0..100_000_u32)
            .map(|i| Point { at: [if i < 50_000 { 1.0 } else { 2.0 }, 0.0, 0.0], ..Point::default() })
            .collect();
        let mut check = MountCheck::default();
        for _ in 0..6 {
            check.take(&Sweep { points: &points, is_complete: true, ..Sweep::default() });
        }
        let near = check.points.iter().filter(|at| at[0] < 1.5).count();
        assert!(
            near > 90_000 && near.abs_diff(check.points.len() - near) < 12,
            "{near} of {}",
            check.points.len()
        );
    }

    #[test]
    fn first_corrected_sweep_restarts_the_check() {
        let points = vec![Point { at: [1.0, 0.0, 0.0], ..Point::default() }; 10];
        let mut check = MountCheck::default();
        let sweeps = [0, 0, 0, 30_000_000, 30_000_000].map(|late_ns| {
            check.take(&Sweep { points: &points, is_complete: true, late_ns, ..Sweep::default() });
            check.sweeps()
        });
        assert_eq!((sweeps, check.points.len()), ([1, 2, 3, 1, 2], 20));
    }

    fn mount() -> Mount {
        Mount { axis_at: [0.0, 0.0, 0.9], sensor_at: [0.06, 0.0, 0.94], ..Mount::default() }
    }

    #[test]
    fn correct_mount_gives_level_floor_and_upright_wall() {
        for axis in [[0.0, 1.0, 0.0], [0.0, -2.0, 0.0]] {
            let real = Mount { axis, ..mount() };
            let (floor, wall) = check_room(&real, &real);
            assert!(floor.height_m.abs().max(floor.level_rad.abs()) < 1e-3, "{floor:?}");
            assert!(floor.roll_rad.abs().max(wall.lean_rad.abs()) < 1e-3, "{floor:?} {wall:?}");
            assert!((wall.distance_m - 3.0).abs() < 1e-3, "{wall:?}");
        }
    }

    #[test]
    fn each_mount_error_affects_its_own_result() {
        let real = mount();
        let (floor, wall) = check_room(&real, &Mount { level_rad: 0.02, ..real });
        assert!((floor.level_rad - 0.02).abs() < 2e-3, "{floor:?}");
        assert!((wall.lean_rad + 0.02).abs() < 3e-3 && floor.height_m.abs() < 0.02, "{floor:?} {wall:?}");
        let higher = Mount { axis_at: [0.0, 0.0, 0.95], sensor_at: [0.06, 0.0, 0.99], ..real };
        let (floor, _) = check_room(&real, &higher);
        assert!((floor.height_m - 0.05).abs() < 2e-3 && floor.level_rad.abs() < 2e-3, "{floor:?}");
        let (floor, _) = check_room(&real, &Mount { axis: [0.0, 1.0, 0.03], ..real });
        assert!(floor.roll_rad.abs() > 5e-3 && floor.level_rad.abs() < 5e-3, "{floor:?}");
        // If the described arm is 0.1 m too long, the wall leans, but the floor is nearly level.
        let (floor, wall) = check_room(&real, &Mount { sensor_at: [0.06, 0.0, 1.04], ..real });
        assert!((wall.lean_rad + floor.level_rad).abs() > 5e-3, "{floor:?} {wall:?}");
    }
}
