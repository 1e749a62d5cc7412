//! Models of the background. A model decides which beams of a scan hit the permanent surroundings, and which beams hit
//! something in front of the surroundings.
//!
//! A [`BackgroundModel`] learns the surroundings from the scans. For a sensor that does not move, it learns them beam
//! by beam, with one of two methods (`fixed`). For a sensor that moves, it learns a map (`moving`).

mod fixed;
mod moving;

use std::f64::consts::TAU;
use std::fmt;

use scanhub_schema::{
    Background, BackgroundHead, Foreground, ForegroundArrays, ForegroundHead, Motion, Pose, Scan, ScanHead,
};

use fixed::{BLOCK_LEN, MultiSurface, SingleSurface};
use moving::OccupancyMap;

use crate::search::position;
use crate::velocity::Velocity;

/// Settings of a background.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Settings {
    /// Method of learning.
    pub method: Method,
    /// Maximum difference in mm between two readings of one surface. A value below one unit of the sensor counts as one
    /// unit. `None` selects 30, in cm mode 60, and in dm mode 100.
    pub threshold_mm: Option<u16>,
    /// Maximum difference in mm between a reading and the candidate with which it is compared (only method `paper`).
    /// `None` selects the same values as for `threshold_mm`.
    pub candidate_mm: Option<u16>,
    /// Number of scans until a surface is background. `None` selects the number of scans in 10 s at the full rate: for
    /// an LMS 750 at steps of 1 degree, 375 at half degrees, and 188 at a quarter. With method `multi`, a surface is
    /// background after 5/8 of this number. The maximum is 8191, which is 3.6 minutes at half degrees. A greater number
    /// counts as 8191.
    pub scans: Option<u32>,
    /// Which reading of a run is the candidate (only method `paper`).
    pub candidate: Candidate,
    /// Contents of the model at the start and after each reset.
    pub start: Start,
    /// Whether no return counts as a background far away. Otherwise, a beam without a return counts as a beam without a
    /// reading. `None` selects true for method `multi`, which then also detects people in front of glass, at no cost
    /// elsewhere. `None` selects false for the other methods: with `paper`, each beam without a return would end a run.
    pub no_return_is_far: Option<bool>,
}

/// Method of learning a background.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Method {
    /// One background per beam. A range that was read in enough consecutive scans (a run) replaces it.
    Paper,
    /// Several surfaces per beam. Something is in the foreground only if neighboring beams or scans agree.
    #[default]
    Multi,
    /// A map of the surroundings of a robot that moves. A beam is in the foreground if it ends in space that earlier
    /// scans saw free. Each scan needs the robot's position, see [`BackgroundModel::set_motion`].
    Moving,
}

/// Candidate for the background: the reading with which each reading of a run is compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Candidate {
    /// The first reading of the run. A person who walks straight toward the sensor never becomes background.
    #[default]
    First,
    /// The previous reading of the run. Anything that moves slowly can become background.
    Latest,
}

/// Contents of the model at the start and after each reset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Start {
    /// Nothing.
    #[default]
    Empty,
    /// The first scan, as soon as it is complete. Beams without a reading in this scan start empty.
    FirstScan,
}

/// The settings in the units of the scans.
#[derive(Clone, Copy, Debug)]
struct Limits {
    /// Maximum difference between two readings of one surface, in device units. It is so low that no range belongs to
    /// the same surface as [`scanhub_schema::Background::FAR`].
    threshold: u16,
    /// Maximum difference between a reading and its candidate, in device units.
    candidate: u16,
    /// Number of scans until a surface is background, from 1 to [`MAX_SCANS`].
    scans: u16,
    latest: bool,
    no_return_is_far: bool,
    /// Angle between two beams in 1/1000 degree, in either direction.
    step_mdeg: u32,
    /// Micrometers per device unit, at least 1.
    unit_um: u32,
}

/// Default of `threshold_mm` and `candidate_mm`: six standard deviations of a range (the paper names no value).
const THRESHOLD_MM: u16 = 30;
/// Default of `threshold_mm` and `candidate_mm` in cm mode, where rounding to the unit adds to the noise.
const THRESHOLD_CM_MODE_MM: u16 = 60;
/// Default of `threshold_mm` and `candidate_mm` in dm mode: one unit. Readings of two surfaces that are 30 mm apart
/// differ by at most one unit in this mode.
const THRESHOLD_DM_MODE_MM: u16 = 100;
/// Default time until a surface is background, in ns. It is the time of 750 revolutions of an LMS's mirror. In this
/// time, the LMS sends 750 scans at steps of 1 degree, and half of this number at half degrees.
const LEARNING_TIME_NS: f64 = 9.99e9;
/// Maximum number of scans until a surface is background. It is limited because the weights of `multi` grow by 8 per
/// scan and have 16 bits.
const MAX_SCANS: u32 = 8191;
/// Maximum of `threshold` and `candidate` in device units. [`scanhub_schema::Background::FAR`] differs by more from
/// every range.
const MAX_DIFFERENCE: u32 = 0x7FFF;
/// Maximum rounding error of a quotient. It is subtracted before rounding up, so that a whole number stays the same.
const ROUNDING_ERROR: f64 = 1e-6;

impl Limits {
    fn of(settings: &Settings, scan: &ScanHead) -> Limits {
        let unit_um = scan.unit_um.max(1);
        let default_mm = match unit_um {
            ..10_000 => THRESHOLD_MM,
            10_000..100_000 => THRESHOLD_CM_MODE_MM,
            100_000.. => THRESHOLD_DM_MODE_MM,
        };
        // The minimum is one unit. With less, readings that differ only by rounding would belong to different surfaces.
        let units = |mm: Option<u16>| {
            (1000 * u32::from(mm.unwrap_or(default_mm)) / unit_um).clamp(1, MAX_DIFFERENCE) as u16
        };
        let turn_ns = f64::from(scan.beam_time_ns) * TAU / scan.step.abs();
        // Without a time per beam, the quotient is not a number or infinite, and the clamp below limits it.
        let ten_seconds =
            (LEARNING_TIME_NS / (turn_ns * f64::from(scan.turns.max(1))) - ROUNDING_ERROR).ceil() as u32;
        Limits {
            threshold: units(settings.threshold_mm),
            candidate: units(settings.candidate_mm),
            scans: settings.scans.unwrap_or(ten_seconds).clamp(1, MAX_SCANS) as u16,
            latest: settings.candidate == Candidate::Latest,
            no_return_is_far: settings.no_return_is_far.unwrap_or(settings.method == Method::Multi),
            step_mdeg: (scan.step.abs().to_degrees() * 1000.0).round() as u32,
            unit_um,
        }
    }
}

/// Class of a beam. It is the result of comparing the beam's reading with its background.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Class {
    /// The beam has no reading.
    Invalid,
    /// The beam's background is unknown. With the methods `multi` and `moving`, the beam may also end nearer than its
    /// background, but too few neighboring beams do so, too.
    Unknown,
    /// The beam ends at its background.
    Background,
    /// The beam ends nearer than its background.
    Foreground,
    /// The beam ends farther away than its background: an object was removed.
    Behind,
}

/// The background of one sensor.
///
/// A scan resets the background if its shape (number of beams, unit, angles) differs from the shape of the previous
/// scan. A reading of 0 is treated like any other reading. But a background of 0 cannot be distinguished from an
/// unknown background.
#[derive(Clone)]
pub struct BackgroundModel {
    settings: Settings,
    limits: Limits,
    method_state: MethodState,
    /// Maximum number of beams of a scan. Further beams are ignored.
    max_beams: usize,
    /// Number of beams and unit in micrometers of the last scan, or of the model that was loaded before the first scan.
    /// (0, 0) before that.
    shape: (u16, u32),
    /// First angle and step of the last scan, or of the model that was loaded before the first scan. 0 before that.
    angles: (f64, f64),
    /// Whether `limits` were computed for the scans. If not, the next scan defines their units.
    is_fitted: bool,
    generation: u32,
    is_frozen: bool,
    /// Whether nothing has been learned or loaded since the last reset.
    is_empty: bool,
    /// Classes of the beams of the last scan, padded to whole blocks.
    classes: Box<[Class]>,
    /// Buffer for the readings of the beams while a scan is processed, padded to whole blocks.
    readings: Box<[u16]>,
}

/// State of the method.
#[derive(Clone)]
enum MethodState {
    Paper(SingleSurface),
    Multi(MultiSurface),
    Moving(OccupancyMap),
}

/// Value of a beam without a reading. It is above all ranges, and below [`Background::FAR`].
const INVALID: u16 = Background::FAR - 1;

impl BackgroundModel {
    /// Creates an empty model for scans of at most `beams` beams. Allocates all the memory that the model ever needs.
    pub fn new(settings: Settings, beams: usize) -> BackgroundModel {
        BackgroundModel {
            settings,
            limits: Limits::of(&settings, &ScanHead::default()),
            method_state: MethodState::new(settings.method, beams),
            max_beams: beams,
            shape: (0, 0),
            angles: (0.0, 0.0),
            is_fitted: false,
            generation: 0,
            is_frozen: false,
            is_empty: true,
            classes: vec![Class::Invalid; beams.next_multiple_of(BLOCK_LEN)].into(),
            readings: vec![INVALID; beams.next_multiple_of(BLOCK_LEN)].into(),
        }
    }

    /// Compares `scan` with the model, writes the foreground to `out`, and then learns from `scan`. Writes every byte
    /// of `out` except the bytes of the segments.
    ///
    /// # Panics
    ///
    /// Panics if `out` has not enough memory for the beams of `scan`.
    pub fn update(&mut self, scan: &Scan, out: &mut Foreground) {
        self.fit(scan);
        let count = scan.beams().min(self.max_beams);
        let padded_count = count.next_multiple_of(BLOCK_LEN);
        measure(scan, self.limits.no_return_is_far, &mut self.readings[..count]);
        self.readings[count..padded_count].fill(INVALID);
        let (readings, classes) = (&self.readings[..count], &mut self.classes[..count]);
        let learn = !self.is_frozen;
        match &mut self.method_state {
            MethodState::Paper(paper) => paper.update(readings, &self.limits, learn, classes),
            MethodState::Multi(multi) => {
                let (readings, classes) = (&self.readings[..padded_count], &mut self.classes[..padded_count]);
                multi.update(readings, &self.limits, learn, classes);
            }
            MethodState::Moving(moving) => moving.update(scan, readings, &self.limits, learn, classes),
        }
        if learn && self.is_empty {
            if self.settings.start == Start::FirstScan {
                self.method_state.adopt(readings);
            }
            self.is_empty = false;
        }
        write_foreground(scan, self.generation, &self.classes[..count], out);
    }

    /// Sets the robot's position at the next scan, which `motion` contains, and the robot's `velocity` during that
    /// scan. The sensor is at `pose` on the robot. Only [`Method::Moving`] uses these values. Resets the model if the
    /// estimation of the motion restarts or refuses a step.
    pub fn set_motion(&mut self, pose: &Pose, motion: &Motion, velocity: &Velocity) {
        if let MethodState::Moving(moving) = &mut self.method_state
            && !moving.set_motion(pose, motion, velocity)
            && !self.is_empty
        {
            self.reset();
        }
    }

    /// Returns the classes of the beams of the last scan. The result is empty before the first scan.
    pub fn classes(&self) -> &[Class] {
        if self.is_fitted { &self.classes[..usize::from(self.shape.0)] } else { &[] }
    }

    /// Returns the number of beams of the last scan or of the loaded model.
    pub fn beams(&self) -> usize {
        self.shape.0.into()
    }

    /// Writes the model to `out`. Writes every byte of `out`.
    ///
    /// # Panics
    ///
    /// Panics if `out` has not enough memory for the beams of the model.
    pub fn write(&self, out: &mut Background) {
        let ranges = out.begin(BackgroundHead {
            first_angle: self.angles.0,
            step: self.angles.1,
            generation: self.generation,
            unit_um: self.shape.1,
            count: self.shape.0,
            flags: if self.is_frozen { Background::FROZEN } else { 0 },
            ..BackgroundHead::default()
        });
        let mut known_beams = 0;
        for (i, range) in ranges.iter_mut().enumerate() {
            *range = self.method_state.background(i, &self.limits);
            known_beams += u16::from(*range != Background::UNKNOWN);
        }
        out.known_beams = known_beams;
    }

    /// Returns the method of learning.
    pub fn method(&self) -> Method {
        self.settings.method
    }

    /// Returns the generation of the model. It increases by 1 at each reset, each load, each change of settings, and
    /// each change of the scans' shape.
    pub fn generation(&self) -> u32 {
        self.generation
    }

    /// Returns the number of scans until a surface is background. It is the value of the settings, or the default that
    /// was computed from the last scan.
    pub fn scans(&self) -> u16 {
        self.limits.scans
    }

    /// Returns whether learning is stopped.
    pub fn is_frozen(&self) -> bool {
        self.is_frozen
    }

    /// Empties the model. A frozen model stays frozen, so it stays empty until it is thawed.
    pub fn reset(&mut self) {
        match &mut self.method_state {
            MethodState::Paper(paper) if self.settings.method == Method::Paper => paper.reset(),
            MethodState::Multi(multi) if self.settings.method == Method::Multi => multi.reset(),
            MethodState::Moving(moving) if self.settings.method == Method::Moving => moving.reset(),
            other => *other = MethodState::new(self.settings.method, self.max_beams),
        }
        self.generation = self.generation.wrapping_add(1);
        self.is_empty = true;
    }

    /// Stops learning. Scans are still compared with the model.
    pub fn freeze(&mut self) {
        self.is_frozen = true;
    }

    /// Resumes learning.
    pub fn thaw(&mut self) {
        self.is_frozen = false;
    }

    /// Uses the ranges of `model` as the background, and drops all candidates. Ignores the generation and the flags of
    /// `model`.
    ///
    /// Before the first scan, the shape of the scans is unknown, so any model is accepted. If the first scan then has
    /// another number of beams or another unit than `model`, the background is reset.
    ///
    /// # Errors
    ///
    /// Returns [`Mismatch`] if number of beams or unit of `model` differ from the last scan, or if `model` has too many
    /// beams.
    pub fn load(&mut self, model: &Background) -> Result<(), Mismatch> {
        let ranges = model.ranges();
        let shape = (ranges.len() as u16, model.unit_um);
        if self.is_fitted && shape != self.shape || ranges.len() > self.max_beams {
            return Err(Mismatch { model: shape, sensor: self.shape });
        }
        self.shape = shape;
        if !self.is_fitted {
            self.angles = (model.first_angle, model.step);
        }
        self.reset();
        self.method_state.adopt(ranges);
        self.is_empty = false;
        Ok(())
    }

    /// Applies `settings` from the next scan on. Keeps the background as a fully known background, and drops all
    /// candidates. The generation increases, as after [`load`](Self::load).
    pub fn change(&mut self, settings: Settings) {
        // Between two scans, the buffer of readings is unused, so it can hold the background.
        let beams = self.beams();
        for (i, range) in self.readings[..beams].iter_mut().enumerate() {
            *range = self.method_state.background(i, &self.limits);
        }
        let was_fresh = self.is_empty;
        self.settings = settings;
        self.reset();
        self.method_state.adopt(&self.readings[..beams]);
        self.is_empty = was_fresh;
        // The next scan defines the units of the settings.
        self.is_fitted = false;
    }

    /// Adapts the model to scans with the shape of `scan`.
    fn fit(&mut self, scan: &Scan) {
        let shape = (scan.beams().min(self.max_beams) as u16, scan.unit_um);
        let angles = (scan.first_angle, scan.step);
        if self.is_fitted && (shape, angles) == (self.shape, self.angles) {
            return;
        }
        if shape != self.shape && self.shape != (0, 0) || self.is_fitted && angles != self.angles {
            self.reset();
        }
        self.shape = shape;
        self.angles = angles;
        self.is_fitted = true;
        self.limits = Limits::of(&self.settings, scan);
    }
}

impl MethodState {
    fn new(method: Method, beams: usize) -> MethodState {
        match method {
            Method::Paper => MethodState::Paper(SingleSurface::new(beams)),
            Method::Multi => MethodState::Multi(MultiSurface::new(beams)),
            Method::Moving => MethodState::Moving(OccupancyMap::new(beams)),
        }
    }

    /// Uses `ranges` as the background. Values without a reading are skipped.
    fn adopt(&mut self, ranges: &[u16]) {
        for (i, &range) in ranges.iter().enumerate() {
            if range != INVALID && range != Background::UNKNOWN {
                match self {
                    MethodState::Paper(paper) => paper.adopt(i, range),
                    MethodState::Multi(multi) => multi.adopt(i, range),
                    // The ranges of a model were measured from one position, so they do not define a map.
                    MethodState::Moving(_) => {}
                }
            }
        }
    }

    /// Returns the background of beam `i` in device units, [`Background::UNKNOWN`] or [`Background::FAR`].
    fn background(&self, i: usize, limits: &Limits) -> u16 {
        match self {
            MethodState::Paper(paper) => paper.background(i),
            MethodState::Multi(multi) => multi.background(i, limits),
            MethodState::Moving(moving) => moving.background(i, limits),
        }
    }
}

/// Writes the reading of each beam of `scan`: a range in device units, [`Background::FAR`] or [`INVALID`]. The function
/// compares plain numbers, because this is faster for many beams. `Reading` in the tests defines the same readings.
fn measure(scan: &Scan, no_return_is_far: bool, readings: &mut [u16]) {
    let ScanHead { valid_to, no_return, beyond, .. } = **scan;
    let valid_to = valid_to.min(INVALID - 1);
    let of_no_return = if no_return_is_far { Background::FAR } else { INVALID };
    for (reading, &value) in readings.iter_mut().zip(scan.ranges()) {
        let code = if value == beyond { Background::FAR } else { INVALID };
        let code = if value == no_return { of_no_return } else { code };
        *reading = if value <= valid_to { value } else { code };
    }
}

/// Writes the foreground of `scan` into `out`, except the segments.
fn write_foreground(scan: &Scan, generation: u32, classes: &[Class], out: &mut Foreground) {
    let head = ForegroundHead {
        generation,
        unit_um: scan.unit_um,
        count: classes.len() as u16,
        ..ForegroundHead::default()
    };
    let ForegroundArrays { bits, ranges, .. } = out.begin(head);
    bits.fill(0);
    let values = scan.ranges();
    let (mut beams, mut end) = (0, 0);
    while let Some(beam) = position(classes, end, is_foreground) {
        bits[beam / 8] |= 1 << (beam % 8);
        ranges[beams] = values[beam];
        beams += 1;
        end = beam + 1;
    }
    ranges[beams..].fill(0);
    out.beams = beams as u16;
}

fn is_foreground(class: Class) -> bool {
    class == Class::Foreground
}

/// Error: a model that does not fit the sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mismatch {
    /// Number of beams and micrometers per device unit of the model.
    pub model: (u16, u32),
    /// Number of beams and micrometers per device unit of the sensor's scans.
    pub sensor: (u16, u32),
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ((beams, unit), (sensor_beams, sensor_unit)) = (self.model, self.sensor);
        let [unit, sensor_unit] = [unit, sensor_unit].map(|unit_um| f64::from(unit_um) / 1000.0);
        write!(
            f,
            "the model has {beams} beams in units of {unit} mm, the sensor's scans have {sensor_beams} beams in \
             units of {sensor_unit} mm"
        )
    }
}

impl std::error::Error for Mismatch {}

/// Filter that decides which runs of neighboring foreground beams count as objects. Noise, and readings between two
/// surfaces at edges, affect only single beams. People cover several beams, unless they are far away.
#[derive(Clone)]
struct RunFilter {
    /// Readings of the beams of the last scan that were nearer than their background; [`INVALID`] for other beams.
    foreground: Box<[u16]>,
    /// Readings in `foreground` that counted as an object; [`INVALID`] for other beams.
    objects: Box<[u16]>,
    /// Buffers for `foreground` and `objects` of the current scan.
    next: [Box<[u16]>; 2],
}

impl RunFilter {
    /// Creates the state for at most `beams` beams.
    fn new(beams: usize) -> RunFilter {
        let none = || vec![INVALID; beams].into_boxed_slice();
        RunFilter { foreground: none(), objects: none(), next: [none(), none()] }
    }

    /// Restores the initial state.
    fn reset(&mut self) {
        self.foreground.fill(INVALID);
        self.objects.fill(INVALID);
    }

    /// Keeps the runs of foreground beams in `classes` that count as objects. Beams of other runs become unknown. A
    /// beam without a reading does not end a run, and does not count as one of its beams.
    ///
    /// A run of three beams or more is an object. For a shorter run, the last scan decides: beams of the last scan that
    /// are among or next to the beams of the run, and within 200 mm of the run's nearest range. If one of them belonged
    /// to an object, the run is an object. If one of them was in the foreground, the run is an object if it is as wide
    /// as a leg at this range.
    fn retain_objects(&mut self, readings: &[u16], limits: &Limits, classes: &mut [Class]) {
        let beam_count = self.foreground.len();
        let [foreground, objects] = &mut self.next;
        foreground.fill(INVALID);
        objects.fill(INVALID);
        let mut begin = 0;
        while let Some(first) = position(classes, begin, is_foreground) {
            let (mut end, mut beams, mut nearest) = (first, 0, INVALID);
            for (i, class) in classes.iter().enumerate().skip(first) {
                match class {
                    Class::Foreground => {
                        (end, beams, nearest) = (i + 1, beams + 1, nearest.min(readings[i]));
                        foreground[i] = readings[i];
                    }
                    Class::Invalid => {}
                    _ => break,
                }
            }
            let neighbors = first.saturating_sub(1)..(end + 1).min(beam_count);
            let reach = (1000 * MAX_MOVEMENT_MM / limits.unit_um).min(u16::MAX.into()) as u16;
            let has_near = |earlier: &[u16]| {
                let mut earlier = earlier[neighbors.clone()].iter();
                earlier.any(|&range| range != INVALID && range.abs_diff(nearest) <= reach)
            };
            let run = &mut classes[first..end];
            if beams >= MIN_OBJECT_BEAMS
                || has_near(&self.objects)
                || beams >= leg_beams(nearest, limits) && has_near(&self.foreground)
            {
                objects[first..end].copy_from_slice(&foreground[first..end]);
            } else {
                run.iter_mut().filter(|class| **class == Class::Foreground).for_each(|c| *c = Class::Unknown);
            }
            begin = end;
        }
        std::mem::swap(&mut self.foreground, foreground);
        std::mem::swap(&mut self.objects, objects);
    }
}

/// Returns the number of beams that a leg covers at `range`, at least one and at most [`MIN_OBJECT_BEAMS`].
fn leg_beams(range: u16, limits: &Limits) -> u64 {
    let apart_um = u64::from(range) * u64::from(limits.unit_um);
    let apart = apart_um.saturating_mul(limits.step_mdeg.into());
    (1000 * LEG_WIDTH_MM * MDEG_PER_RADIAN)
        .checked_div(apart)
        .map_or(MIN_OBJECT_BEAMS, |beams| beams.clamp(1, MIN_OBJECT_BEAMS))
}

/// Number of neighboring foreground beams that are never noise. A run of at least this length is an object, at any
/// range.
const MIN_OBJECT_BEAMS: u64 = 3;
/// Width of a leg with trousers plus width of a beam, in mm. The values 120, 135 and 150 mm were compared in the room
/// of the paper's Fig. 8. This value has the best recall without a loss of precision.
const LEG_WIDTH_MM: u64 = 135;
const MDEG_PER_RADIAN: u64 = 57_296;
/// Maximum movement of an object between two scans plus the depth of the object, in mm. An object at 5 m/s moves by
/// 133 mm between two scans at 37.5 Hz.
const MAX_MOVEMENT_MM: u32 = 200;

#[cfg(test)]
mod tests {
    use scanhub_schema::Code;

    use super::*;

    /// Reading of one beam. [`measure`] must have the same result for whole scans, but is faster.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    enum Reading {
        /// A range in mm.
        Valid(u32),
        /// No object within reach.
        Far,
        /// No valid reading: the scanner was dazzled, the signal was too weak, or there was a reading error.
        Invalid,
    }

    impl Reading {
        /// Returns the reading of beam `i` of `scan`. `no_return_is_far` decides whether no return, the most frequent
        /// code in real rooms, means [`Reading::Far`] or [`Reading::Invalid`].
        fn of(scan: &Scan, i: usize, no_return_is_far: bool) -> Reading {
            match (scan.distance_mm(i), scan.code(i)) {
                (Some(range_mm), _) => Reading::Valid(range_mm),
                (None, Some(Code::Beyond)) => Reading::Far,
                (None, Some(Code::NoReturn)) if no_return_is_far => Reading::Far,
                _ => Reading::Invalid,
            }
        }
    }

    #[test]
    fn classifies_codes_and_ranges() {
        let mut ranges: Vec<u16> = (0..10).map(|code| 0x1FFF - code).collect();
        ranges.push(0);
        let scan = Scan::of(ScanHead::lms(11, 0, 500, 10, 13), &ranges);
        let all = |far| (0..12).map(|i| Reading::of(&scan, i, far)).collect::<Vec<_>>();
        let mut expected = vec![Reading::Invalid; 12];
        expected[8] = Reading::Far;
        expected[9] = Reading::Valid(81_820);
        expected[10] = Reading::Valid(0);
        assert_eq!(all(false), expected);
        expected[0] = Reading::Far;
        assert_eq!(all(true), expected, "and a beam that does not exist has no reading");
    }

    #[test]
    fn readings_agree_between_processors() {
        for valid_to in [0_u16, 1, 0x1FF6, 0x3FF6, 0x7FF6, 0xFFEF] {
            let values: [u16; 32] = std::array::from_fn(|i| {
                [0, 1, 2, 0x1FFF, 0x3FFF, 0x7FFF, 0xFFFF, i as u16][i % 8].wrapping_sub(i as u16 / 2)
            });
            let (no_return, beyond) = (valid_to.saturating_add(9), valid_to + 1);
            let scan = Scan::of(
                ScanHead { unit_um: 1000, valid_to, no_return, beyond, ..ScanHead::default() },
                &values,
            );
            for far in [false, true] {
                let mut readings = [INVALID; 32];
                measure(&scan, far, &mut readings);
                for (i, &reading) in readings.iter().enumerate() {
                    let expected = match Reading::of(&scan, i, far) {
                        Reading::Valid(range) => range as u16,
                        Reading::Far => Background::FAR,
                        Reading::Invalid => INVALID,
                    };
                    assert_eq!(reading, expected, "beam {i} of {valid_to}");
                }
            }
        }
    }

    #[test]
    fn defaults_depend_on_unit_and_resolution() {
        let limits = |settings, unit_mm: u32, turns| {
            let step_deg = 1.0 / f64::from(turns);
            let head = ScanHead {
                unit_um: 1000 * unit_mm,
                step: step_deg.to_radians(),
                beam_time_ns: (37_000.0 * step_deg) as u32,
                turns,
                ..ScanHead::default()
            };
            let limits = Limits::of(&settings, &head);
            (limits.threshold, limits.candidate, limits.scans)
        };
        let paper = Settings { method: Method::Paper, ..Settings::default() };
        assert_eq!(limits(paper, 1, 2), (30, 30, 375));
        assert_eq!(limits(paper, 10, 1), (6, 6, 750));
        assert_eq!(limits(paper, 1, 4), (30, 30, 188));
        assert_eq!(limits(paper, 100, 2), (1, 1, 375));
        let own = Settings { threshold_mm: Some(45), candidate_mm: Some(u16::MAX), scans: Some(0), ..paper };
        assert_eq!(limits(own, 10, 2), (4, 6553, 1));
        assert_eq!(limits(own, 0, 2), (32_767, 32_767, 1));
        let turning = ScanHead {
            unit_um: 1000,
            step: -0.8_f64.to_radians(),
            beam_time_ns: 222_222,
            ..ScanHead::default()
        };
        assert_eq!(Limits::of(&paper, &turning).scans, 100, "10 Hz");
        assert_eq!(Limits::of(&paper, &ScanHead::default()).scans, 1);
        assert_eq!(limits(own, 100, 2), (1, 655, 1), "less than a unit is one");
        assert_eq!(limits(Settings { scans: Some(u32::MAX), ..paper }, 1, 2).2, 8191);
    }
}
