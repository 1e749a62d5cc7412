//! Background for a scanner that moves: a map of the standing objects around the robot. The map scrolls with the robot,
//! whose position the caller sets before each scan. A beam is in the foreground if it ends in space that earlier scans
//! saw free. Space behind objects is unknown, and so is the edge of the space that scans saw.

use std::f64::consts::FRAC_PI_2;

use scanhub_schema::{Background, Motion, Pose, Scan};

use super::{Class, INVALID, Limits, RunFilter};
use crate::directions::exact_angle;
use crate::velocity::{Pose2, Velocity};

/// State of the method that follows the robot.
#[derive(Clone)]
pub(super) struct OccupancyMap {
    /// Square cells around the robot. The index of a cell is its coordinates modulo the width.
    cells: Box<[Cell]>,
    /// Effect of the last scan that met each cell, see [`CellEffect`].
    effects: Box<[u8]>,
    /// Cell of the sensor, in the middle of the map.
    middle: (i32, i32),
    /// Poses at the current scan; `None` if the position is unknown.
    map_pose: Option<MapPose>,
    /// Number of the current scan in `effects`, from 1 to [`CellEffect::SCANS`].
    scan: u8,
    /// Buffer for the positions of the sensor at the times of the beams, in cells, while a scan is processed.
    starts: Box<[(f32, f32)]>,
    /// Buffer for the ends of the beams, in cells, while a scan is processed. NaN for beams without a range.
    ends: Box<[(f32, f32)]>,
    run_filter: RunFilter,
}

/// A cell of the map: a square of the floor, with counts of the scans that met it.
#[derive(Clone, Copy, Default)]
struct Cell {
    /// Number of scans in which a beam ended in the cell. Each later scan that saw through the cell decreases it, by 1
    /// or more.
    hits: u16,
    /// Number of scans that saw through the cell, minus an eighth of the number of scans in which a beam ended in it.
    free: u16,
    /// Number of times that a beam ended in the cell after scans had seen through the cell. It is for thin objects,
    /// such as chair legs, which are often between two beams.
    returns: u8,
    /// Number of consecutive scans that saw through the cell.
    through: u8,
}

/// Poses of the robot and its sensor at a scan, and the values from which the ends of the scan's beams are computed.
#[derive(Clone, Copy)]
struct MapPose {
    robot: Pose2,
    /// Position of the sensor in the map, in meters.
    x: f64,
    y: f64,
    /// Pose of the sensor on the robot.
    pose: Pose,
    /// Velocity of the sensor.
    velocity: Velocity,
    /// First angle and step of the beams.
    angles: (f64, f64),
    /// Device unit of the ranges in meters.
    unit_m: f64,
}

/// Effect of a scan on a cell, stored in a byte: three times the number of the scan, plus one of the values `THROUGH`,
/// `NEAR` and `ENDED`. A later scan has a greater number, so its effect replaces that of an earlier scan. If a scan has
/// several effects on a cell, the one with the greatest value remains.
struct CellEffect;

impl CellEffect {
    /// Maximum number of a scan in the byte. The next scan has the number 1 again.
    const SCANS: u8 = 84;
    /// A beam saw through the cell.
    const THROUGH: u8 = 0;
    /// A beam ended next to the cell.
    const NEAR: u8 = 1;
    /// A beam ended in the cell.
    const ENDED: u8 = 2;
}

impl OccupancyMap {
    /// Creates the state for at most `beams` beams.
    pub(super) fn new(beams: usize) -> OccupancyMap {
        OccupancyMap {
            cells: vec![Cell::default(); CELL_COUNT].into(),
            effects: vec![0; CELL_COUNT].into(),
            middle: (0, 0),
            map_pose: None,
            scan: 0,
            starts: vec![(0.0, 0.0); beams].into(),
            ends: vec![(0.0, 0.0); beams].into(),
            run_filter: RunFilter::new(beams),
        }
    }

    /// Restores the initial state.
    pub(super) fn reset(&mut self) {
        self.cells.fill(Cell::default());
        self.run_filter.reset();
    }

    /// Sets the robot's position at the next scan, which `motion` contains, and the robot's `velocity` during that
    /// scan. The sensor is at `pose` on the robot. Returns whether the map is still valid. It is not valid if the
    /// position is unknown or the last step was too uncertain.
    pub(super) fn set_motion(&mut self, pose: &Pose, motion: &Motion, velocity: &Velocity) -> bool {
        let robot = Pose2::new(motion.x_m, motion.y_m, motion.yaw_rad);
        let (x, y) = robot.point((pose.x_m, pose.y_m));
        let is_known = motion.has_pose() && x.abs() < MAX_DISTANCE_M && y.abs() < MAX_DISTANCE_M;
        let (angles, unit_m) = ((0.0, 0.0), 0.0);
        let velocity = velocity.of_sensor(pose);
        self.map_pose = is_known.then_some(MapPose { robot, x, y, pose: *pose, velocity, angles, unit_m });
        // In a corridor, the variance along the corridor is large. But all positions along the corridor look alike, so
        // the map stays valid.
        let variance = f64::from(motion.covariance[0].max(motion.covariance[4]));
        let is_sure = motion.is_degenerate() || variance <= MAX_STEP_SIGMA_M * MAX_STEP_SIGMA_M;
        is_known && motion.has_step() && is_sure
    }

    /// Compares all beams with the map before this scan, then adds the scan to the map.
    pub(super) fn update(
        &mut self,
        scan: &Scan,
        readings: &[u16],
        limits: &Limits,
        learn: bool,
        classes: &mut [Class],
    ) {
        let Some(map_pose) = &mut self.map_pose else {
            classes.fill(Class::Unknown);
            return;
        };
        (map_pose.angles, map_pose.unit_m) = ((scan.first_angle, scan.step), f64::from(scan.unit_um) * 1e-6);
        let map_pose = *map_pose;
        self.scroll((cell(map_pose.x), cell(map_pose.y)));
        let (forward, left) = (map_pose.direction(0.0), map_pose.direction(FRAC_PI_2));
        let exact = scan.exact_angles();
        for (i, (&reading, class)) in readings.iter().zip(classes.iter_mut()).enumerate() {
            self.ends[i] = (f32::NAN, f32::NAN);
            if reading >= INVALID {
                *class = if reading == INVALID { Class::Invalid } else { Class::Unknown };
                continue;
            }
            let angle = exact_angle(exact, i).unwrap_or(map_pose.angles.0 + i as f64 * map_pose.angles.1);
            let range = f64::from(reading) * map_pose.unit_m;
            // The sensor moves while the scan is measured, so compute its position and direction for each beam.
            let (x, y, yaw) = map_pose.velocity.position(1e-9 * scan.beam_ns(i) as f64);
            let direction = map_pose.direction(angle + yaw);
            let start = (map_pose.x + x * forward.0 + y * left.0, map_pose.y + x * forward.1 + y * left.1);
            let end = (start.0 + range * direction.0, start.1 + range * direction.1);
            self.starts[i] = in_cells(start);
            self.ends[i] = in_cells(end);
            *class = self.class(cell(end.0), cell(end.1), limits);
        }
        self.run_filter.retain_objects(readings, limits, classes);
        if learn {
            self.add_scan(readings.len(), limits);
        }
    }

    /// Returns the class of a beam that ends in this cell.
    fn class(&self, x: i32, y: i32, limits: &Limits) -> Class {
        if !self.is_inside(x, y, UNCERTAINTY_CELLS) {
            return Class::Unknown;
        }
        let mut is_free = true;
        for dx in -UNCERTAINTY_CELLS..=UNCERTAINTY_CELLS {
            for dy in -UNCERTAINTY_CELLS..=UNCERTAINTY_CELLS {
                let cell = &self.cells[index(x + dx, y + dy)];
                if cell.is_occupied(limits) {
                    return Class::Background;
                }
                let is_near = dx.abs().max(dy.abs()) <= 1;
                is_free &= !is_near
                    || cell.free >= if (dx, dy) == (0, 0) { MIN_FREE_SCANS } else { MIN_FREE_SCANS / 2 };
            }
        }
        if is_free { Class::Foreground } else { Class::Unknown }
    }

    /// Moves the map so that `middle` is its middle, and clears the cells that enter the map.
    fn scroll(&mut self, middle: (i32, i32)) {
        let (dx, dy) = (middle.0 - self.middle.0, middle.1 - self.middle.1);
        if dx.abs() >= MAP_WIDTH || dy.abs() >= MAP_WIDTH {
            self.cells.fill(Cell::default());
        } else {
            let new = |from: i32, by: i32| {
                let (old, new) = (from - MAP_WIDTH / 2, from + by - MAP_WIDTH / 2);
                if by > 0 { old + MAP_WIDTH..new + MAP_WIDTH } else { new..old }
            };
            for x in new(self.middle.0, dx) {
                (0..MAP_WIDTH).for_each(|y| self.cells[index(x, y)] = Cell::default());
            }
            for y in new(self.middle.1, dy) {
                (0..MAP_WIDTH).for_each(|x| self.cells[index(x, y)] = Cell::default());
            }
        }
        self.middle = middle;
    }

    /// Returns whether a cell and the `margin` cells on each side of it are in the map.
    fn is_inside(&self, x: i32, y: i32, margin: i32) -> bool {
        let half = MAP_WIDTH / 2 - margin;
        let is_near = |at: i32, middle: i32| (middle - half..middle + half).contains(&at);
        is_near(x, self.middle.0) && is_near(y, self.middle.1)
    }

    /// Adds the scan to the map. Each cell is counted at most once per scan. If one beam ended in or next to a cell, it
    /// does not matter that other beams saw through the cell.
    fn add_scan(&mut self, beams: usize, limits: &Limits) {
        self.scan = if self.scan >= CellEffect::SCANS { 1 } else { self.scan + 1 };
        if self.scan == 1 {
            self.effects.fill(0);
        }
        let (near, ended) = (3 * self.scan + CellEffect::NEAR, 3 * self.scan + CellEffect::ENDED);
        let max_hits = limits.scans.max(MIN_FREE_SCANS);
        // Add the ends of all beams first, because they take precedence over beams that saw through a cell.
        for i in 0..beams {
            let (x, y) = self.ends[i];
            let (x, y) = (x.floor() as i32, y.floor() as i32);
            if self.ends[i].0.is_nan() || !self.is_inside(x, y, 1) {
                continue;
            }
            let at = index(x, y);
            if self.effects[at] == ended {
                continue;
            }
            self.cells[at].note_hit(max_hits);
            for dx in -1..=1 {
                for dy in -1..=1 {
                    let mark = &mut self.effects[index(x + dx, y + dy)];
                    *mark = near.max(*mark);
                }
            }
            self.effects[at] = ended;
        }
        // Coordinates relative to the first cell of the map are never negative.
        let first = ((self.middle.0 - MAP_WIDTH / 2) as f32, (self.middle.1 - MAP_WIDTH / 2) as f32);
        for i in 0..beams {
            let (start, end) = (self.starts[i], self.ends[i]);
            if !end.0.is_nan() {
                let from = (start.0 - first.0, start.1 - first.1);
                self.note_empty_cells(from, (end.0 - first.0, end.1 - first.1), max_hits);
            }
        }
    }

    /// Counts the cells between the sensor (`from`) and the `end` of a beam as seen through. Goes along the beam in
    /// steps of one cell.
    fn note_empty_cells(&mut self, from: (f32, f32), end: (f32, f32), max_hits: u16) {
        let through = 3 * self.scan + CellEffect::THROUGH;
        let (dx, dy) = (end.0 - from.0, end.1 - from.1);
        let length = dx.hypot(dy);
        let steps = (length - END_MARGIN_CELLS).min(MAP_WIDTH as f32 / 2.0);
        let (dx, dy) = (dx / length, dy / length);
        let (mut x, mut y) = from;
        let first = (self.middle.0 - MAP_WIDTH / 2, self.middle.1 - MAP_WIDTH / 2);
        let first = (first.0.rem_euclid(MAP_WIDTH), first.1.rem_euclid(MAP_WIDTH));
        let wrapped = |at: i32| if at >= MAP_WIDTH { at - MAP_WIDTH } else { at };
        for _ in 0..steps as u32 {
            (x, y) = (x + dx, y + dy);
            let (column, row) = (x as i32, y as i32);
            if !(0..MAP_WIDTH).contains(&column) || !(0..MAP_WIDTH).contains(&row) {
                return;
            }
            let at = (wrapped(first.0 + column) * MAP_WIDTH + wrapped(first.1 + row)) as usize;
            // An equal or greater value means that a beam of this scan has already had an effect on the cell.
            if self.effects[at] < through {
                self.effects[at] = through;
                self.cells[at].note_seen_through(max_hits);
            }
        }
    }

    /// Returns the range in device units at which beam `i` would end if nothing were in the foreground, or
    /// [`Background::UNKNOWN`].
    pub(super) fn background(&self, i: usize, limits: &Limits) -> u16 {
        let Some(map_pose) = self.map_pose.filter(|map_pose| map_pose.unit_m > 0.0) else {
            return Background::UNKNOWN;
        };
        let direction = map_pose.direction(map_pose.angles.0 + i as f64 * map_pose.angles.1);
        for step in 1..MAP_WIDTH / 2 {
            let range = f64::from(step) * CELL_M;
            let (x, y) = (cell(map_pose.x + range * direction.0), cell(map_pose.y + range * direction.1));
            if !self.is_inside(x, y, 0) {
                break;
            }
            let cell = &self.cells[index(x, y)];
            if cell.is_occupied(limits) {
                return (range / map_pose.unit_m).min(f64::from(INVALID - 1)) as u16;
            }
        }
        Background::UNKNOWN
    }
}

impl Cell {
    /// Returns whether a permanent object is in the cell: an object that beams hit before the cell was seen free, an
    /// object that they have hit long enough since then, or a thin object.
    fn is_occupied(&self, limits: &Limits) -> bool {
        self.hits >= MIN_HITS && self.free < MIN_FREE_SCANS
            || self.hits >= limits.scans.max(MIN_HITS)
            || self.returns >= MIN_RETURNS
    }

    fn note_hit(&mut self, max_hits: u16) {
        self.hits = (self.hits + 1).min(max_hits);
        self.returns = self.returns.saturating_add(u8::from(self.through > 0));
        self.through = 0;
        if self.hits.is_multiple_of(8) {
            self.free = self.free.saturating_sub(1);
        }
    }

    fn note_seen_through(&mut self, max_hits: u16) {
        self.free = (self.free + 1).min(max_hits);
        self.through = self.through.saturating_add(1);
        if self.through >= MAX_THROUGH_SCANS {
            self.returns = 0;
        }
        self.hits = self.hits.saturating_sub(1 + self.hits / 16);
    }
}

impl MapPose {
    /// Returns the direction in the map of a beam at the sensor's `angle`.
    fn direction(&self, angle: f64) -> (f64, f64) {
        self.robot.turned(self.pose.direction(angle))
    }
}

/// Converts a position from meters to cells.
fn in_cells((x, y): (f64, f64)) -> (f32, f32) {
    ((x / CELL_M) as f32, (y / CELL_M) as f32)
}

/// Returns the cell of a coordinate in meters.
fn cell(meters: f64) -> i32 {
    (meters / CELL_M).floor() as i32
}

/// Returns the index of a cell.
fn index(x: i32, y: i32) -> usize {
    (x.rem_euclid(MAP_WIDTH) * MAP_WIDTH + y.rem_euclid(MAP_WIDTH)) as usize
}

/// Width of a cell in meters. A person is several cells wide, and the error of a position is less than one cell.
const CELL_M: f64 = 0.05;
/// Width and height of the map in cells: 40 m.
const MAP_WIDTH: i32 = 800;
const CELL_COUNT: usize = (MAP_WIDTH * MAP_WIDTH) as usize;
/// Maximum distance in cells, along each axis, between the end of a beam and an object that counts as the beam's
/// background. It is not 0, because positions and walls are uncertain.
const UNCERTAINTY_CELLS: i32 = 2;
/// Number of scans that must see through a cell before the cell is free.
const MIN_FREE_SCANS: u16 = 5;
/// Number of scans in which a beam must end in a cell before the cell has a permanent object, if the cell was never
/// seen free.
const MIN_HITS: u16 = 3;
/// Number of [`Cell::returns`] with which a cell has a permanent thin object.
const MIN_RETURNS: u8 = 24;
/// Number of consecutive scans that must see through a cell before a thin object in the cell is removed.
const MAX_THROUGH_SCANS: u8 = 60;
/// Number of cells before the end of a beam that do not count as seen through.
const END_MARGIN_CELLS: f32 = 2.5;
/// Maximum standard deviation of a step after which the map stays valid. With a larger error, walls would appear in
/// free space.
const MAX_STEP_SIGMA_M: f64 = CELL_M;
/// Distance of a robot from its start beyond which its position counts as unknown.
const MAX_DISTANCE_M: f64 = 1e6;
