//! Background in three dimensions: the surface that each beam usually meets, for each narrow range of the mount's
//! angle. It is learned in the same way as the background in two dimensions: if a number of sweeps in a row meet
//! another surface, this surface replaces the previous one.

use scanhub_schema::PointClass;

use super::Settings;
use super::mount::Mount;

/// A measured beam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Reading {
    /// Index of the beam.
    pub(crate) beam: u16,
    /// Height that the beam gains per meter, -1 to 1.
    pub(crate) rise: f32,
    /// Change of the rise per radian of the mount's angle.
    pub(crate) rise_change: f32,
    /// Range in meters; infinite without a return.
    pub(crate) range_m: f32,
}

/// A surface, described by one reading.
#[derive(Clone, Copy, Default)]
struct Surface {
    /// Range in meters; 0 if there is no surface.
    range_m: f32,
    rise: f32,
    /// Mean squared difference between the beams and a level surface, and between the beams and an upright surface.
    /// Recent beams have more weight.
    off: [f32; 2],
}

#[derive(Clone, Copy, Default)]
struct Cell {
    background: Surface,
    /// Surface that may become background.
    candidate: Surface,
    /// Number of sweeps in a row that met the candidate.
    run: u16,
    /// Surfaces that are narrower than the distance between two scans, so that beams meet them only in some sweeps.
    narrow: [NarrowSurface; MAX_NARROW],
    /// Number of the sweep that last updated the cell, plus 1. Each sweep updates a cell only once.
    last_sweep: u32,
}

/// A surface that the beams of a cell meet only in some sweeps.
#[derive(Clone, Copy, Default)]
struct NarrowSurface {
    surface: Surface,
    /// Number of sweeps that met the surface; 0 if no surface is stored. A beam that meets neither the background nor a
    /// stored narrow surface decreases the smallest of these numbers in the cell.
    hit_count: u16,
    /// Number of times that a sweep met the surface after the previous sweep had missed the surface.
    visits: u16,
    /// Number of sweeps since a sweep last met the surface. Sweeps that did not measure the cell do not count.
    miss_count: u16,
}

/// Background of all beams.
pub(crate) struct SurfaceModel {
    beams: usize,
    /// Number of sweeps that must meet a surface before it becomes background.
    sweeps: u16,
    /// Cells by the mount's angle. Rows that the mount has not reached use no memory.
    rows: Box<[Box<[Cell]>]>,
}

impl SurfaceModel {
    /// Creates an empty model, for a mount that tilts by at most 90 degrees to each side of level.
    pub(crate) fn new(beams: usize, settings: &Settings) -> SurfaceModel {
        let rows = (std::f64::consts::PI / width_rad(settings)).ceil() as usize + 1;
        SurfaceModel { beams, sweeps: settings.sweeps, rows: (0..rows).map(|_| Box::default()).collect() }
    }

    /// Compares a reading with the model, and returns its class.
    pub(crate) fn class(&self, reading: &Reading, row: usize, threshold_m: f32) -> PointClass {
        let beam = usize::from(reading.beam);
        let own = self.background(row, beam);
        let explains = |surface: &Surface| surface.explains(reading, threshold_m);
        if own.as_ref().is_some_and(explains) {
            return PointClass::Background;
        }
        // At an edge, a beam may meet the surfaces of neighboring cells.
        let neighbors = || {
            let rows = row.saturating_sub(1)..=row + 1;
            rows.flat_map(|row| (beam.saturating_sub(1)..=beam + 1).map(move |beam| (row, beam)))
        };
        let mut all = neighbors().filter_map(|(row, beam)| self.background(row, beam));
        let mut narrow =
            neighbors().filter_map(|(row, beam)| self.cell(row, beam)).flat_map(|cell| &cell.narrow);
        if all.any(|surface| explains(&surface))
            || narrow.any(|narrow| narrow.is_background(self.sweeps) && explains(&narrow.surface))
        {
            return PointClass::Background;
        }
        match own {
            None => PointClass::Unknown,
            Some(surface) if reading.range_m < surface.expected(reading, threshold_m).0 - threshold_m => {
                PointClass::Foreground
            }
            Some(_) => PointClass::Behind,
        }
    }

    /// Returns whether the background of the reading's own cell is known.
    pub(crate) fn is_known(&self, reading: &Reading, row: usize) -> bool {
        self.background(row, reading.beam.into()).is_some()
    }

    /// Returns the error of the mount's angle in radians, computed from the reading. The error is the difference
    /// between the mount's angle and the angle at which the reading would be on the background. Returns `None` unless
    /// the background is a level surface that the beam meets at a steep angle.
    pub(crate) fn angle_off(&self, reading: &Reading, row: usize, threshold_m: f32) -> Option<f32> {
        let known = self.background(row, reading.beam.into())?;
        let [level, upright] = known.ends(reading);
        let is_level = known.expected(reading, threshold_m) == (level, level) && level != upright;
        let is_usable =
            is_level && reading.range_m.is_finite() && reading.rise_change.abs() > MIN_RISE_CHANGE;
        is_usable.then(|| (known.range_m * known.rise / reading.range_m - reading.rise) / reading.rise_change)
    }

    /// Updates the model with a reading of sweep number `sweep`.
    pub(crate) fn learn(&mut self, reading: &Reading, row: usize, sweep: u32, settings: &Settings) {
        let beams = self.beams;
        let Some(cells) = self.rows.get_mut(row) else { return };
        if cells.is_empty() {
            *cells = vec![Cell::default(); beams].into();
        }
        let Some(cell) = cells.get_mut(usize::from(reading.beam)) else { return };
        let is_first = cell.last_sweep != sweep + 1;
        if is_first {
            cell.last_sweep = sweep + 1;
            cell.narrow.iter_mut().for_each(|narrow| narrow.begin_sweep(settings.sweeps));
        }
        let threshold_m = settings.threshold_m as f32;
        if cell.background.is_known() && cell.background.explains(reading, threshold_m) {
            if is_first {
                cell.background.update(reading);
                cell.run = 0;
            }
            return;
        }
        cell.learn_narrow(reading, settings.sweeps, threshold_m);
        if !is_first {
            return;
        }
        if cell.run > 0 && cell.candidate.explains(reading, threshold_m) {
            cell.candidate.update(reading);
            cell.run += 1;
        } else {
            (cell.candidate, cell.run) = (Surface::of(reading), 1);
        }
        if cell.run >= settings.sweeps {
            (cell.background, cell.run) = (cell.candidate, 0);
        }
    }

    /// Clears all cells.
    pub(crate) fn clear(&mut self) {
        self.rows.iter_mut().for_each(|cells| cells.fill(Cell::default()));
    }

    fn background(&self, row: usize, beam: usize) -> Option<Surface> {
        self.cell(row, beam).map(|cell| cell.background).filter(Surface::is_known)
    }

    fn cell(&self, row: usize, beam: usize) -> Option<&Cell> {
        self.rows.get(row)?.get(beam)
    }
}

impl Cell {
    /// Counts the sweeps that meet each narrow surface, with a reading that is not on the background.
    fn learn_narrow(&mut self, reading: &Reading, sweeps: u16, threshold_m: f32) {
        let explains = |narrow: &&mut NarrowSurface| {
            narrow.hit_count > 0 && narrow.surface.explains(reading, threshold_m)
        };
        if let Some(narrow) = self.narrow.iter_mut().find(explains) {
            narrow.record_hit(reading, sweeps);
            return;
        }
        let Some(rarest) = self.narrow.iter_mut().min_by_key(|narrow| narrow.hit_count) else { return };
        rarest.hit_count = rarest.hit_count.saturating_sub(1);
        if rarest.hit_count == 0 {
            *rarest = NarrowSurface { surface: Surface::of(reading), hit_count: 1, visits: 1, miss_count: 0 };
        }
    }
}

impl NarrowSurface {
    /// Returns whether the surface is background. An object that stands for a while and then leaves causes only one
    /// visit. People who walk do not return to the same range.
    fn is_background(&self, sweeps: u16) -> bool {
        self.hit_count >= sweeps && self.visits >= MIN_VISITS.min(sweeps)
    }

    /// Starts a sweep that measures this cell. Removes the surface if too many sweeps have missed it.
    fn begin_sweep(&mut self, sweeps: u16) {
        self.miss_count = self.miss_count.saturating_add(1);
        if self.miss_count > sweeps.saturating_mul(FORGET_FACTOR) {
            *self = NarrowSurface::default();
        }
    }

    fn record_hit(&mut self, reading: &Reading, sweeps: u16) {
        if self.miss_count > 0 {
            self.hit_count = (self.hit_count + 1).min(sweeps.saturating_mul(2).max(1));
            self.visits = self.visits.saturating_add(u16::from(self.miss_count > 1));
        }
        self.miss_count = 0;
        self.surface.update(reading);
    }
}

/// Returns the width of a row in radians. Narrower rows would need too much memory.
fn width_rad(settings: &Settings) -> f64 {
    settings.bin_rad.max(MIN_BIN_RAD)
}

/// Returns the row of the model for a beam with direction `beam_rad` at the mount's angle `angle_rad`, and the reading
/// to compare with this row.
pub(crate) fn row_for(
    mount: &Mount,
    settings: &Settings,
    (angle_rad, beam_rad): (f64, f64),
    beam: u16,
    range_m: f32,
) -> (usize, Reading) {
    const STEP_RAD: f64 = 1e-3;
    let from_lowest = angle_rad - mount.level_rad + std::f64::consts::FRAC_PI_2;
    let row = (from_lowest / width_rad(settings)).floor().max(0.0) as usize;
    let rise = |angle_rad: f64| mount.direction(angle_rad, beam_rad)[2];
    let turn = (rise(angle_rad + STEP_RAD) - rise(angle_rad)) / STEP_RAD;
    (row, Reading { beam, rise: rise(angle_rad) as f32, rise_change: turn as f32, range_m })
}

impl Surface {
    fn of(reading: &Reading) -> Surface {
        Surface { range_m: reading.range_m, rise: reading.rise, off: [0.0; 2] }
    }

    fn is_known(&self) -> bool {
        self.range_m > 0.0
    }

    /// Returns two ranges at which a beam with the rise of `reading` would meet the surface. The first range is right
    /// if the surface is level, so that its height is constant. The second range is right if the surface is upright, so
    /// that its horizontal distance is constant.
    fn ends(&self, reading: &Reading) -> [f32; 2] {
        let Surface { range_m, rise, .. } = *self;
        let over_ground = |rise: f32| (1.0 - rise * rise).max(0.0).sqrt();
        let upright = range_m * over_ground(rise) / over_ground(reading.rise).max(MIN_OVER_GROUND);
        let is_slope = rise * reading.rise > 0.0 && rise.abs().min(reading.rise.abs()) > MIN_RISE;
        [if is_slope { range_m * rise / reading.rise } else { upright }, upright]
    }

    /// Returns the minimum and maximum range at which a beam with the rise of `reading` would meet the surface. If
    /// earlier beams have shown that the surface is level, or that it is upright, minimum and maximum are equal. The
    /// range for any other slope is between the range for a level surface and the range for an upright surface.
    fn expected(&self, reading: &Reading, threshold_m: f32) -> (f32, f32) {
        let [level, upright] = self.ends(reading);
        let most = (threshold_m / 2.0).powi(2);
        match self.off.map(|off| off <= most) {
            [true, false] => (level, level),
            [false, true] => (upright, upright),
            _ => (level.min(upright), level.max(upright)),
        }
    }

    /// Updates the surface with a beam that ended on it.
    fn update(&mut self, reading: &Reading) {
        if reading.range_m.is_finite() {
            let ends = self.ends(reading);
            for (off, end) in self.off.iter_mut().zip(ends) {
                *off += UPDATE_WEIGHT * ((end - reading.range_m).powi(2) - *off);
            }
        }
    }

    fn explains(&self, reading: &Reading, threshold_m: f32) -> bool {
        if self.range_m.is_infinite() || reading.range_m.is_infinite() {
            return self.range_m == reading.range_m;
        }
        let (min_m, max_m) = self.expected(reading, threshold_m);
        (min_m - threshold_m..=max_m + threshold_m).contains(&reading.range_m)
    }
}

/// Maximum number of narrow surfaces in a cell, for example the edge and the top of a board.
const MAX_NARROW: usize = 2;
/// Minimum number of visits after which a narrow surface is background. People, and objects that are put down, can
/// cause two visits.
const MIN_VISITS: u16 = 3;
/// Number of sweeps in a row that must miss a narrow surface before it is removed, as a multiple of
/// [`Settings::sweeps`].
const FORGET_FACTOR: u16 = 20;
/// Minimum width of a row in radians. A narrower row would be below the accuracy of a planar scanner.
const MIN_BIN_RAD: f64 = 0.002;
/// Weight of the latest beam in the mean squared differences of a surface.
const UPDATE_WEIGHT: f32 = 0.25;
/// Minimum horizontal distance per meter of range, which avoids a division by zero for a vertical beam.
const MIN_OVER_GROUND: f32 = 0.02;
/// Minimum change of a beam's rise per radian at which the beam is used to measure the error of the mount's angle. A
/// beam along the axis has the same height at any angle, so it shows no error.
const MIN_RISE_CHANGE: f32 = 0.3;
/// Minimum absolute rise of a beam that is compared with a level surface. A flatter beam meets a level surface within
/// reach only if the surface's height is close to the scanner's: at 8 m, within 0.16 m.
const MIN_RISE: f32 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;

    fn settings() -> Settings {
        Settings { sweeps: 3, ..Settings::default() }
    }

    fn reading(range_m: f32) -> Reading {
        Reading { beam: 5, rise: -0.2, rise_change: -1.0, range_m }
    }

    #[test]
    fn surface_met_in_consecutive_sweeps_is_background() {
        let mut model = SurfaceModel::new(11, &settings());
        let class = |model: &SurfaceModel, range| model.class(&reading(range), 90, 0.06);
        for (sweep, range) in [4.0, 4.0, 2.0, 4.0, 4.0].into_iter().enumerate() {
            model.learn(&reading(range), 90, sweep as u32, &settings());
            assert_eq!(class(&model, 2.0), PointClass::Unknown, "after sweep {sweep}");
        }
        (5..9).for_each(|_| model.learn(&reading(4.02), 90, 5, &settings()));
        use PointClass::{Background, Behind, Foreground};
        assert_eq!([2.0, 4.05, 5.0].map(|range| class(&model, range)), [Foreground, Background, Behind]);
        assert_eq!(class(&model, f32::INFINITY), Behind);
        (6..9).for_each(|sweep| model.learn(&reading(2.0), 90, sweep, &settings()));
        assert_eq!([2.0, 4.0].map(|range| class(&model, range)), [Background, Behind], "it stays");
        model.clear();
        assert_eq!(class(&model, 2.0), PointClass::Unknown);
    }

    #[test]
    fn intermittent_surface_is_background_after_3_visits() {
        use PointClass::{Background, Foreground};
        let mut model = SurfaceModel::new(11, &settings());
        let mut classes = Vec::new();
        for sweep in 0..16 {
            let range_m = if sweep % 4 == 3 { 2.0 } else { 4.0 };
            classes.push(model.class(&reading(2.0), 90, 0.06));
            model.learn(&reading(range_m), 90, sweep, &settings());
        }
        assert_eq!(classes[3..], [[Foreground; 9].as_slice(), &[Background; 4]].concat());
        assert_eq!(model.class(&reading(3.0), 90, 0.06), Foreground, "before both");
        let neighbor = Reading { beam: 6, ..reading(4.0) };
        (16..20).for_each(|sweep| model.learn(&neighbor, 91, sweep, &settings()));
        assert_eq!(model.class(&Reading { beam: 6, ..reading(2.0) }, 91, 0.06), Background, "beside it");
    }

    /// Returns whether the reading at 2 m is background after `sweeps`. Each item is the range of one sweep, or `None`
    /// if the sweep did not measure the cell.
    fn is_narrow_background(settings: &Settings, sweeps: impl IntoIterator<Item = Option<f32>>) -> bool {
        let mut model = SurfaceModel::new(11, settings);
        for (sweep, range_m) in sweeps.into_iter().enumerate() {
            if let Some(range_m) = range_m {
                model.learn(&reading(range_m), 90, sweep as u32, settings);
            }
        }
        model.class(&reading(2.0), 90, 0.06) == PointClass::Background
    }

    #[test]
    fn narrow_surface_needs_the_configured_sweeps() {
        let visits = |count| [Some(4.0); 20].into_iter().chain([Some(4.0), Some(2.0)].repeat(count));
        for (sweeps, wanted) in [(1, 1), (3, 3), (5, 5), (12, 12)] {
            let settings = Settings { sweeps, ..Settings::default() };
            let learned = (1..20).find(|count| is_narrow_background(&settings, visits(*count)));
            assert_eq!(learned, Some(wanted), "{sweeps} sweeps");
        }
    }

    #[test]
    fn sweep_without_a_measurement_is_not_a_visit() {
        let settings = Settings::default();
        let sweeps = [Some(4.0); 6].into_iter().chain([None, Some(2.0)].repeat(4)).chain([Some(4.0)]);
        assert!(!is_narrow_background(&settings, sweeps));
    }

    #[test]
    fn narrow_surface_seen_through_is_removed() {
        let visits = [Some(4.0); 3].into_iter().chain([Some(4.0), Some(2.0)].repeat(3));
        for (after, is_background) in [(60, true), (61, false)] {
            let sweeps = visits.clone().chain(vec![Some(4.0); after]);
            assert_eq!(is_narrow_background(&settings(), sweeps), is_background, "after {after} sweeps");
            let sweeps = visits.clone().chain([Some(4.0), None].repeat(60)).chain(vec![None; 90]);
            assert!(is_narrow_background(&settings(), sweeps), "only sweeps that measured the place count");
        }
    }

    #[test]
    fn removed_and_moving_objects_are_foreground() {
        use PointClass::Foreground;
        let mut model = SurfaceModel::new(11, &settings());
        let learn_ranges = |ranges: &[f32], from: u32, model: &mut SurfaceModel| {
            for (range_m, sweep) in ranges.iter().zip(from..) {
                model.learn(&reading(*range_m), 90, sweep, &settings());
            }
        };
        learn_ranges(&[4.0; 5], 0, &mut model);
        // An object stands at 2 m until it is background, and then leaves.
        learn_ranges(&[2.0, 2.0, 2.0, 2.0, 4.0, 4.0, 4.0, 4.0], 5, &mut model);
        assert_eq!(model.class(&reading(2.0), 90, 0.06), Foreground);
        let walks = [1.5, 4.0, 2.5, 3.0, 4.0, 2.0, 1.7, 4.0, 3.3, 2.5, 4.0, 1.5, 2.2, 4.0, 3.6, 2.8, 4.0];
        learn_ranges(&walks, 13, &mut model);
        for range_m in walks.into_iter().filter(|range_m| *range_m < 4.0) {
            assert_eq!(model.class(&reading(range_m), 90, 0.06), Foreground, "{range_m}");
        }
    }

    #[test]
    fn sweep_counts_once_per_cell() {
        let mut model = SurfaceModel::new(11, &settings());
        (0..9).for_each(|_| model.learn(&reading(4.0), 90, 0, &settings()));
        assert!(!model.is_known(&reading(4.0), 90));
    }

    #[test]
    fn level_surface_explains_readings_across_its_cell() {
        let mut floor = Surface { range_m: 5.0, rise: -0.2, off: [0.0; 2] };
        let at = |rise: f32, range_m| Reading { rise, ..reading(range_m) };
        assert!(floor.explains(&at(-0.21, 1.0 / 0.21), 0.01) && floor.explains(&at(-0.19, 1.0 / 0.19), 0.01));
        assert!(floor.explains(&at(-0.21, 5.0 * (0.96_f32 / (1.0 - 0.0441)).sqrt()), 0.01), "a wall");
        assert!(!floor.explains(&at(-0.21, 1.0 / 0.21 - 0.05), 0.01));
        assert!(!floor.explains(&at(0.01, 20.0), 0.01), "a beam that rises");
        (0..4).for_each(|_| floor.update(&at(-0.21, 1.0 / 0.21)));
        assert!(floor.explains(&at(-0.21, 1.0 / 0.21), 0.05), "seen to be level");
        assert!(!floor.explains(&at(-0.21, 5.0), 0.05), "and no wall any more");
        // A table top a little below the scanner. A small change of the angle changes the range at which a beam meets
        // this top.
        let mut top = Surface { range_m: 4.76, rise: -0.042, off: [0.0; 2] };
        (1..5).for_each(|i| top.update(&at(-0.042 - 0.001 * i as f32, 0.2 / (0.042 + 0.001 * i as f32))));
        assert!(top.explains(&at(-0.047, 0.2 / 0.047), 0.06) && !top.explains(&at(-0.047, 3.9), 0.06));
        let sky = Surface { range_m: f32::INFINITY, rise: 0.1, off: [0.0; 2] };
        assert!(sky.explains(&at(0.1, f32::INFINITY), 0.01) && !sky.explains(&at(0.1, 9.0), 0.01));
    }

    /// Computes the background of a cell from all its ranges, one per sweep, by the definition: the background is the
    /// last surface that enough sweeps in a row have met.
    fn reference_background(ranges: &[f32], scans: usize) -> Option<f32> {
        let same = |a: f32, b: f32| a == b || (a - b).abs() <= 0.06;
        let mut background = None;
        let mut run: Vec<f32> = Vec::new();
        for &range in ranges {
            if background.is_some_and(|known| same(known, range)) {
                run.clear();
                continue;
            }
            if run.first().is_some_and(|&first| !same(first, range)) {
                run.clear();
            }
            run.push(range);
            if run.len() == scans {
                background = Some(run[0]);
                run.clear();
            }
        }
        background
    }

    #[test]
    fn background_matches_the_reference() {
        for seed in 0..200 {
            let mut random = fastrand::Rng::with_seed(seed);
            let surfaces = [2.0, 2.05, 3.0, f32::INFINITY];
            let mut model = SurfaceModel::new(11, &settings());
            let mut ranges = Vec::new();
            for sweep in 0..40 {
                let range = surfaces[random.usize(..4) * random.usize(..2)];
                let known = model.background(90, 5).map(|surface| surface.range_m);
                assert_eq!(known, reference_background(&ranges, 3), "seed {seed}, sweep {sweep}");
                model.learn(&reading(range), 90, sweep, &settings());
                ranges.push(range);
            }
        }
    }
}
