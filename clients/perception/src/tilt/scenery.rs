//! What a sweep shows: its points beside the background, whether its angles can be right, and what stands there. Refuses to
//! know scans and how they are put in order.

use scanhub_schema::{Obstacle, PointClass};

use crate::tilt::background::{Model, Reading, placed};
use crate::tilt::mount::Mount;
use crate::tilt::obstacles::{Candidate, Clusters};
use crate::tilt::settings::Settings;
use crate::tilt::sweep::{Point, Sweep};

/// Parts of a sweep whose angles are judged each for itself.
const PARTS: usize = 4;
/// With fewer beams on known background nothing can be doubted.
const ENOUGH: usize = 200;

/// A beam whose angle is known.
#[derive(Clone, Copy)]
pub(crate) struct Ray {
    pub(crate) time_ns: u64,
    pub(crate) angle_rad: f64,
    pub(crate) beam_rad: f64,
    /// Infinite if nothing came back.
    pub(crate) range_m: f32,
    pub(crate) beam: u16,
}

/// What is known of the surroundings.
pub(crate) struct Scenery {
    mount: Mount,
    settings: Settings,
    model: Model,
    /// How often the model was forgotten.
    pub(crate) forgotten: u64,
    points: Vec<Point>,
    /// Row of the model and reading of each beam.
    readings: Vec<(usize, Reading)>,
    /// What each beam on a level surface tells of the angles.
    off: Vec<f32>,
    /// Points of which obstacles may be.
    standing: Vec<Candidate>,
    /// Mount's angle and rise of the beam of each point.
    beams: Vec<(f32, f32)>,
    clusters: Clusters,
    /// The floor was where the angles say, or they have never jumped.
    is_confirmed: bool,
    /// Sweeps in a row that were doubted.
    doubted: u16,
}

impl Scenery {
    pub(crate) fn new(mount: Mount, settings: Settings) -> Scenery {
        Scenery {
            mount,
            settings,
            model: Model::new(0, &settings),
            forgotten: 0,
            points: Vec::new(),
            readings: Vec::new(),
            off: Vec::new(),
            standing: Vec::new(),
            beams: Vec::new(),
            clusters: Clusters::default(),
            is_confirmed: true,
            doubted: 0,
        }
    }

    /// Scans are others from now on, of so many beams.
    pub(crate) fn begin(&mut self, beams: usize, is_first: bool) {
        self.model = Model::new(beams, &self.settings);
        self.forgotten += u64::from(!is_first);
    }

    /// The angles have jumped: they are doubted until the floor is where they say.
    pub(crate) fn distrust(&mut self) {
        self.is_confirmed = false;
    }

    /// Forgets the background, because all angles are corrected from now on. If the last sweep contradicted the background,
    /// the angles were right when it was learned, and it stays.
    pub(crate) fn correct(&mut self) {
        if self.doubted == 0 {
            self.model.forget();
            self.forgotten += 1;
        }
    }

    /// Returns what `rays` show; `sweep` says which sweep that is.
    pub(crate) fn look<'a>(&'a mut self, rays: &[Ray], sweep: Sweep<'a>) -> Sweep<'a> {
        let (known, elsewhere) = self.compare(rays);
        let is_elsewhere = known >= ENOUGH && elsewhere as f64 > self.settings.doubt * known as f64;
        let is_contradicted = is_elsewhere || self.is_angle_off();
        self.is_confirmed |= !is_contradicted && self.off.len() >= ENOUGH;
        let is_doubted = is_contradicted || !self.is_confirmed;
        let generation = self.forgotten as u32;
        self.standing.clear();
        if is_doubted {
            self.points.iter_mut().for_each(|point| point.class = PointClass::Unknown);
            self.doubted += 1;
        } else {
            self.learn(sweep.number);
            self.pick();
            self.doubted = 0;
        }
        if self.doubted > 2 * self.settings.sweeps {
            self.model.forget();
            self.forgotten += 1;
            (self.doubted, self.is_confirmed) = (0, true);
        }
        let (obstacles, left_out) =
            self.clusters.find(&self.standing, self.settings.cube_m as f32, self.settings.points);
        Sweep { is_doubted, generation, points: &self.points, obstacles, left_out, ..sweep }
    }

    /// Makes points of the rays; returns how many have a cell whose background is known, and how many of these are elsewhere.
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
            if self.model.knows(&reading, row) {
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

    /// Returns whether the level surfaces of the background are where they would be if the angles of a part of the sweep were
    /// off.
    fn is_angle_off(&mut self) -> bool {
        let most = self.settings.off_rad as f32;
        let part = (self.off.len() / PARTS).max(ENOUGH);
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

    /// Picks the points of which obstacles may be.
    fn pick(&mut self) {
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
    /// The row of the background that it is compared with, and how.
    fn reading(&self, mount: &Mount, settings: &Settings) -> (usize, Reading) {
        placed(mount, settings, (self.angle_rad, self.beam_rad), self.beam, self.range_m)
    }
}
