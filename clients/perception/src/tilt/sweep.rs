//! Analyzes a sweep: compares the points with the background, decides whether the angles are reliable, and finds
//! obstacles, which are clusters of points in three dimensions.

use scanhub_schema::{MAX_OBSTACLES, Obstacle, PointClass};

use super::background::{Reading, SurfaceModel, row_for};
use super::mount::Mount;
use super::{Point, Settings, Sweep};

/// Number of parts of a sweep whose angles are checked separately.
const PART_COUNT: usize = 4;
/// Minimum number of beams on known background that a check of the angles needs.
const MIN_BEAMS: usize = 200;

/// A beam with the mount's angle at its time.
#[derive(Clone, Copy)]
pub(crate) struct Ray {
    pub(crate) time_ns: u64,
    pub(crate) angle_rad: f64,
    pub(crate) beam_rad: f64,
    /// Range in meters; infinite without a return.
    pub(crate) range_m: f32,
    pub(crate) beam: u16,
}

/// Background, with the buffers for the analysis of a sweep.
pub(crate) struct SweepAnalyzer {
    mount: Mount,
    settings: Settings,
    model: SurfaceModel,
    /// Number of resets of the model.
    pub(crate) background_resets: u64,
    points: Vec<Point>,
    /// For each beam, the row of the model and the reading.
    readings: Vec<(usize, Reading)>,
    /// Error of the mount's angle in radians, computed from each beam on a level surface.
    off: Vec<f32>,
    /// Points that may belong to obstacles.
    standing: Vec<Candidate>,
    /// Mount's angle in radians, and rise of the beam, for each point.
    beams: Vec<(f32, f32)>,
    clusters: Clusters,
    /// Whether the floor has been at its expected height since the last jump of the angles.
    is_confirmed: bool,
    /// Number of unreliable sweeps in a row.
    unreliable: u16,
}

impl SweepAnalyzer {
    pub(crate) fn new(mount: Mount, settings: Settings) -> SweepAnalyzer {
        SweepAnalyzer {
            mount,
            settings,
            model: SurfaceModel::new(0, &settings),
            background_resets: 0,
            points: Vec::new(),
            readings: Vec::new(),
            off: Vec::new(),
            standing: Vec::new(),
            beams: Vec::new(),
            clusters: Clusters::default(),
            is_confirmed: true,
            unreliable: 0,
        }
    }

    /// Starts a new background for scans with `beams` beams.
    pub(crate) fn begin(&mut self, beams: usize, is_first: bool) {
        self.model = SurfaceModel::new(beams, &self.settings);
        self.background_resets += u64::from(!is_first);
    }

    /// Marks the angles as unreliable after a jump, until the floor is at its expected height.
    pub(crate) fn mark_unreliable(&mut self) {
        self.is_confirmed = false;
    }

    /// Clears the background, because all angles are corrected from now on. If the last sweep contradicted the
    /// background, the background was learned with right angles and is kept.
    pub(crate) fn correct(&mut self) {
        if self.unreliable == 0 {
            self.model.clear();
            self.background_resets += 1;
        }
    }

    /// Returns `sweep` with the points and obstacles of `rays`.
    pub(crate) fn analyze<'a>(&'a mut self, rays: &[Ray], sweep: Sweep<'a>) -> Sweep<'a> {
        let (known, elsewhere) = self.compare(rays);
        let is_elsewhere =
            known >= MIN_BEAMS && elsewhere as f64 > self.settings.max_displaced_share * known as f64;
        let is_contradicted = is_elsewhere || self.is_angle_off();
        self.is_confirmed |= !is_contradicted && self.off.len() >= MIN_BEAMS;
        let is_unreliable = is_contradicted || !self.is_confirmed;
        let generation = self.background_resets as u32;
        self.standing.clear();
        if is_unreliable {
            self.points.iter_mut().for_each(|point| point.class = PointClass::Unknown);
            self.unreliable += 1;
        } else {
            self.learn(sweep.number);
            self.pick_candidates();
            self.unreliable = 0;
        }
        if self.unreliable > 2 * self.settings.sweeps {
            self.model.clear();
            self.background_resets += 1;
            (self.unreliable, self.is_confirmed) = (0, true);
        }
        let (obstacles, dropped) =
            self.clusters.find(&self.standing, self.settings.cube_m as f32, self.settings.points);
        Sweep { is_unreliable, generation, points: &self.points, obstacles, dropped, ..sweep }
    }

    /// Computes the points of the rays. Returns the number of rays whose cell has a known background, and the number of
    /// these rays whose range differs from this background.
    fn compare(&mut self, rays: &[Ray]) -> (usize, usize) {
        self.points.clear();
        self.readings.clear();
        self.beams.clear();
        self.off.clear();
        let threshold_m = self.settings.threshold_m as f32;
        let (mut known, mut elsewhere) = (0, 0);
        for ray in rays {
            let (row, reading) = ray.reading(&self.mount, &self.settings);
            self.readings.push((row, reading));
            let class = self.model.class(&reading, row, threshold_m);
            self.off.extend(self.model.angle_off(&reading, row, threshold_m));
            if self.model.is_known(&reading, row) {
                known += 1;
                elsewhere += usize::from(class != PointClass::Background);
            }
            if ray.range_m.is_finite() {
                let at = self.mount.point(ray.angle_rad, ray.beam_rad, ray.range_m.into());
                let at = at.map(|value| value as f32);
                self.beams.push((ray.angle_rad as f32, reading.rise));
                self.points.push(Point { at, stamp_ns: ray.time_ns, beam: ray.beam, class });
            }
        }
        (known, elsewhere)
    }

    /// Returns whether the angles in a part of the sweep are wrong. Compares them with the level surfaces of the
    /// background.
    fn is_angle_off(&mut self) -> bool {
        let most = self.settings.max_error_rad as f32;
        let part = (self.off.len() / PART_COUNT).max(MIN_BEAMS);
        let is_off = |part: &mut [f32]| {
            let middle = part.len() / 2;
            part.select_nth_unstable_by(middle, f32::total_cmp).1.abs() > most
        };
        self.off.chunks_exact_mut(part).any(is_off)
    }

    fn learn(&mut self, number: u32) {
        for (row, reading) in &self.readings {
            self.model.learn(reading, *row, number, &self.settings);
        }
    }

    /// Collects the points that may belong to obstacles.
    fn pick_candidates(&mut self) {
        let near = self.settings.near;
        for (point, &(angle_rad, rise)) in self.points.iter().zip(&self.beams) {
            let within = |near: &[[f64; 2]; 3]| {
                near.iter().zip(point.at).all(|(span, value)| (span[0]..=span[1]).contains(&f64::from(value)))
            };
            let is_foreground = point.class == PointClass::Foreground;
            let flags = if is_foreground { Obstacle::FOREGROUND } else { 0 }
                | if near.as_ref().is_some_and(within) { Obstacle::NEAR } else { 0 };
            if flags != 0 {
                self.standing.push(Candidate { at: point.at, flags, angle_rad, rise });
            }
        }
    }
}

impl Ray {
    /// Returns the row of the background for this ray, and the reading of the ray.
    fn reading(&self, mount: &Mount, settings: &Settings) -> (usize, Reading) {
        row_for(mount, settings, (self.angle_rad, self.beam_rad), self.beam, self.range_m)
    }
}

/// A point that may belong to an obstacle.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Candidate {
    pub(crate) at: [f32; 3],
    /// Flags of an obstacle that contains this point.
    pub(crate) flags: u8,
    /// Mount's angle in radians.
    pub(crate) angle_rad: f32,
    /// Height that the beam gains per meter, -1 to 1.
    pub(crate) rise: f32,
}

/// An obstacle, with properties of the beams that met it.
struct ObstacleCluster {
    obstacle: Obstacle,
    /// Minimum and maximum angle of the mount in radians.
    angles_rad: [f32; 2],
    /// Maximum absolute rise of the beams.
    rise: f32,
}

impl ObstacleCluster {
    /// Returns whether the cluster may be only the top of an object that was there from the start. Nearly level beams
    /// graze this top only in few sweeps, and each time at another range. In one sweep, only one scan grazes the top,
    /// so the mount's angle hardly differs between its beams. An object that was put down is higher, so several scans
    /// meet the object.
    fn is_grazed(&self) -> bool {
        let [low, high] = self.angles_rad;
        self.obstacle.flags & Obstacle::NEAR == 0
            && high - low < MAX_GRAZED_RAD
            && self.rise < MAX_GRAZING_RISE
    }
}

/// Maximum difference between the mount's angles at which beams graze a top, in radians: 0.4 degrees.
const MAX_GRAZED_RAD: f32 = 0.007;
/// Maximum absolute rise of beams that graze a top. Steeper beams meet a top in more than one scan.
const MAX_GRAZING_RISE: f32 = 0.1;

/// Search for obstacles, which are clusters of points whose cubes touch.
#[derive(Default)]
pub(crate) struct Clusters {
    /// Cube of each point with the point's index, sorted by cube.
    cubes: Vec<([i16; 3], u32)>,
    /// For each point, whether it is the first point of a cube that the search has not reached.
    open: Vec<bool>,
    /// Cubes at the front of the search, by the index of their first point.
    front: Vec<usize>,
    found: Vec<Obstacle>,
}

impl Clusters {
    /// Returns the obstacles with at least the given number of points, the nearest first, and the number of obstacles
    /// that were dropped because there are more than [`MAX_OBSTACLES`].
    pub(crate) fn find(
        &mut self,
        points: &[Candidate],
        cube_m: f32,
        min_points: usize,
    ) -> (&[Obstacle], u32) {
        let cube = |at: [f32; 3]| at.map(|value| (value / cube_m).floor() as i16);
        self.cubes.clear();
        self.cubes.extend(points.iter().zip(0..).map(|(point, number)| (cube(point.at), number)));
        self.cubes.sort_unstable();
        self.open.clear();
        self.open.resize(self.cubes.len(), true);
        self.found.clear();
        for first in 0..self.cubes.len() {
            if !self.open[first] || first > 0 && self.cubes[first].0 == self.cubes[first - 1].0 {
                continue;
            }
            let grown = self.grow(first, points);
            if grown.obstacle.points as usize >= min_points && !grown.is_grazed() {
                self.found.push(grown.obstacle);
            }
        }
        self.found.sort_by(|a, b| a.distance_m.total_cmp(&b.distance_m));
        let dropped = self.found.len().saturating_sub(MAX_OBSTACLES) as u32;
        self.found.truncate(MAX_OBSTACLES);
        (&self.found, dropped)
    }

    fn grow(&mut self, first: usize, points: &[Candidate]) -> ObstacleCluster {
        let (inf, mut sum) = (f32::INFINITY, [0.0_f64; 3]);
        let mut grown = Obstacle { low: [inf; 3], high: [-inf; 3], distance_m: inf, ..Obstacle::default() };
        let (mut angles_rad, mut most_rise) = ([inf, -inf], 0.0_f32);
        self.open[first] = false;
        self.front.push(first);
        while let Some(first) = self.front.pop() {
            let cube = self.cubes[first].0;
            for (_, number) in self.cubes[first..].iter().take_while(|(other, _)| *other == cube) {
                let Candidate { at, flags, angle_rad, rise } = points[*number as usize];
                angles_rad = [angles_rad[0].min(angle_rad), angles_rad[1].max(angle_rad)];
                most_rise = most_rise.max(rise.abs());
                for i in 0..3 {
                    sum[i] += f64::from(at[i]);
                    grown.low[i] = grown.low[i].min(at[i]);
                    grown.high[i] = grown.high[i].max(at[i]);
                }
                grown.distance_m = grown.distance_m.min(at[0].hypot(at[1]));
                grown.points += 1;
                grown.flags |= flags;
            }
            for neighbor in neighbors(cube) {
                let index = self.cubes.partition_point(|(other, _)| *other < neighbor);
                let is_there = self.cubes.get(index).is_some_and(|(other, _)| *other == neighbor);
                if is_there && self.open[index] {
                    self.open[index] = false;
                    self.front.push(index);
                }
            }
        }
        grown.middle = sum.map(|value| (value / f64::from(grown.points)) as f32);
        ObstacleCluster { obstacle: grown, angles_rad, rise: most_rise }
    }
}

/// Returns the 26 cubes that touch `cube`.
fn neighbors(cube: [i16; 3]) -> impl Iterator<Item = [i16; 3]> {
    let offset = |i: i16| [i / 9 - 1, i / 3 % 3 - 1, i % 3 - 1];
    (0..27)
        .map(offset)
        .filter(|off| *off != [0; 3])
        .map(move |off| std::array::from_fn(|i| cube[i].saturating_add(off[i])))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate((at, flags): ([f32; 3], u8)) -> Candidate {
        Candidate { at, flags, angle_rad: 0.2, rise: -0.3 }
    }

    #[test]
    fn line_grazed_by_one_level_scan_is_no_obstacle() {
        let line = |flags, angle_rad: f32, rise| {
            let point = move |i| ([4.0, 0.05 * i as f32, 0.7 + angle_rad], flags);
            (0..12).map(move |i| Candidate { angle_rad, rise, ..candidate(point(i)) })
        };
        let mut clusters = Clusters::default();
        let mut count = |points: Vec<Candidate>| clusters.find(&points, 0.15, 8).0.len();
        assert_eq!(count(line(Obstacle::FOREGROUND, 0.0, -0.02).collect()), 0);
        assert_eq!(count(line(Obstacle::FOREGROUND, 0.0, -0.2).collect()), 1, "steep beams");
        assert_eq!(count(line(Obstacle::NEAR, 0.0, -0.02).collect()), 1, "in the box near");
        let two = line(Obstacle::FOREGROUND, 0.0, -0.02).chain(line(Obstacle::FOREGROUND, 0.01, -0.01));
        assert_eq!(count(two.collect()), 1, "two scans");
    }

    #[test]
    fn near_points_form_an_obstacle_unless_too_few() {
        let pole = (0..20).map(|i| ([2.0, 0.0, 0.05 * i as f32], Obstacle::FOREGROUND));
        let crate_ = (0..9).map(|i| ([1.0 + 0.1 * i as f32, -1.0, 0.3], Obstacle::NEAR));
        let speck = (0..3).map(|i| ([5.0, 5.0, 0.1 * i as f32], Obstacle::FOREGROUND));
        let mut clusters = Clusters::default();
        let (found, dropped) =
            clusters.find(&pole.chain(crate_).chain(speck).map(candidate).collect::<Vec<_>>(), 0.15, 5);
        assert_eq!((found.len(), dropped), (2, 0));
        assert_eq!((found[0].points, found[0].flags), (9, Obstacle::NEAR), "the nearest first");
        assert!((found[0].distance_m - 2.0_f32.sqrt()).abs() < 1e-6);
        let pole = found[1];
        assert_eq!((pole.low, pole.high, pole.points), ([2.0, 0.0, 0.0], [2.0, 0.0, 0.95], 20));
        assert!((pole.middle[2] - 0.475).abs() < 1e-6);
    }

    /// Computes the sizes of the clusters by definition: points whose cubes touch get the same label, until no label
    /// changes.
    fn reference_cluster_sizes(points: &[[f32; 3]], cube_m: f32, min_size: usize) -> Vec<usize> {
        let cube = |at: &[f32; 3]| at.map(|value| (value / cube_m).floor() as i32);
        let mut names: Vec<usize> = (0..points.len()).collect();
        let mut changes = true;
        while changes {
            changes = false;
            for a in 0..points.len() {
                for b in 0..points.len() {
                    let (x, y) = (cube(&points[a]), cube(&points[b]));
                    if (0..3).all(|i| (x[i] - y[i]).abs() <= 1) && names[b] < names[a] {
                        names[a] = names[b];
                        changes = true;
                    }
                }
            }
        }
        let sizes = (0..points.len()).map(|name| names.iter().filter(|of| **of == name).count());
        let mut sizes: Vec<usize> = sizes.filter(|size| *size >= min_size).collect();
        sizes.sort_unstable();
        sizes
    }

    #[test]
    fn obstacles_match_the_reference_clusters() {
        let mut clusters = Clusters::default();
        for seed in 0..40 {
            let mut random = fastrand::Rng::with_seed(seed);
            let count = random.usize(0..90);
            let points: Vec<[f32; 3]> =
                (0..count).map(|_| std::array::from_fn(|_| 1.6 * random.f32() - 0.8)).collect();
            let flagged: Vec<_> = points.iter().map(|at| candidate((*at, 1))).collect();
            let (found, dropped) = clusters.find(&flagged, 0.15, 2);
            let mut sizes: Vec<usize> = found.iter().map(|obstacle| obstacle.points as usize).collect();
            sizes.sort_unstable();
            assert_eq!((sizes, dropped), (reference_cluster_sizes(&points, 0.15, 2), 0), "seed {seed}");
        }
    }
}
