//! Decides which beams of a scan hit the permanent surroundings, and which hit something in front of them. The model
//! of the surroundings is learned from the scans, beam by beam, by one of two methods, or in a map
//! that a moving sensor is laid into. It refuses to know what objects there are.

mod moving;
mod multi;
mod paper;
mod runs;
mod settings;

use std::fmt;

use schema::{
    Background, BackgroundHead, Foreground, ForegroundArrays, ForegroundHead, Motion, Pose, Scan, ScanHead,
};

use moving::Moving;
use multi::Multi;
use paper::Paper;
use settings::Limits;
pub use settings::{Candidate, Method, Settings, Start};

/// What one beam of a scan is, beside its background.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Class {
    /// It has no reading.
    Invalid,
    /// Its background is not known; or (`multi`) something is nearer, but on too few beams to be believed.
    Unknown,
    /// It ends where it always does.
    Background,
    /// It ends nearer than its background.
    Foreground,
    /// It ends farther away than its background: something has gone.
    Behind,
}

/// The background of one sensor.
///
/// A scan of another shape than the one before (number of beams, unit, angles) resets it. A reading of 0 is one like
/// any other, but as a background it cannot be told from one that is not known.
#[derive(Clone)]
pub struct Model {
    settings: Settings,
    limits: Limits,
    learner: Learner,
    /// The most beams of a scan; those beyond are passed over.
    most: usize,
    /// Beams and unit in micrometres of the model: of the last scan or of what was loaded; (0, 0) before both.
    shape: (u16, u32),
    /// First angle and step: of the last scan or of what was loaded; 0 before both.
    angles: (f64, f64),
    /// There was a scan, by which the settings are those of its units.
    is_fitted: bool,
    generation: u32,
    frozen: bool,
    /// Nothing has been learned or loaded since the last reset.
    fresh: bool,
    classes: Box<[Class]>,
    /// What the beams tell, while a scan is looked at.
    readings: Box<[u16]>,
}

/// What is learned, by method.
#[derive(Clone)]
enum Learner {
    Paper(Paper),
    Multi(Multi),
    Moving(Moving),
}

/// A reading that tells nothing. It lies between the ranges and [`Background::FAR`].
const INVALID: u16 = Background::FAR - 1;

impl Model {
    /// A model that knows nothing, for scans of at most `beams` beams: all the memory that it ever needs.
    pub fn new(settings: Settings, beams: usize) -> Model {
        Model {
            settings,
            limits: Limits::of(&settings, &ScanHead::default()),
            learner: Learner::new(settings.method, beams),
            most: beams,
            shape: (0, 0),
            angles: (0.0, 0.0),
            is_fitted: false,
            generation: 0,
            frozen: false,
            fresh: true,
            classes: vec![Class::Invalid; beams].into(),
            readings: vec![INVALID; beams].into(),
        }
    }

    /// Compares `scan` with the model as it is, writes what stands before it to `out`, then learns from it. Writes
    /// every byte of `out` but those of the segments.
    ///
    /// # Panics
    ///
    /// If `out` has no memory for as many beams.
    pub fn update(&mut self, scan: &Scan, out: &mut Foreground) {
        self.fit(scan);
        let count = scan.beams().min(self.most);
        measure(scan, self.limits.no_return_is_far, &mut self.readings[..count]);
        let (readings, classes) = (&self.readings[..count], &mut self.classes[..count]);
        let learn = !self.frozen;
        match &mut self.learner {
            Learner::Paper(paper) => paper.update(readings, &self.limits, learn, classes),
            Learner::Multi(multi) => multi.update(readings, &self.limits, learn, classes),
            Learner::Moving(moving) => moving.update(scan, readings, &self.limits, learn, classes),
        }
        if learn && self.fresh {
            if self.settings.start == Start::FirstScan {
                self.learner.adopt(readings);
            }
            self.fresh = false;
        }
        write(scan, self.generation, &self.classes[..count], out);
    }

    /// The next scan is from where `motion` says that the robot is, of a sensor at `pose`: for
    /// [`Method::Moving`]. Where the motion begins anew or is refused, all is forgotten.
    pub fn follow(&mut self, pose: &Pose, motion: &Motion) {
        if let Learner::Moving(moving) = &mut self.learner
            && !moving.follow(pose, motion)
            && !self.fresh
        {
            self.reset();
        }
    }

    /// What the beams of the last scan are; empty before the first one.
    pub fn classes(&self) -> &[Class] {
        if self.is_fitted { &self.classes[..usize::from(self.shape.0)] } else { &[] }
    }

    /// Returns the number of beams of the model: those of the last scan or of what was loaded.
    pub fn beams(&self) -> usize {
        self.shape.0.into()
    }

    /// Writes the model to `out`, every byte of it.
    ///
    /// # Panics
    ///
    /// If `out` has no memory for as many beams.
    pub fn show(&self, out: &mut Background) {
        let ranges = out.begin(BackgroundHead {
            first_angle: self.angles.0,
            step: self.angles.1,
            generation: self.generation,
            unit_um: self.shape.1,
            count: self.shape.0,
            flags: if self.frozen { Background::FROZEN } else { 0 },
            ..BackgroundHead::default()
        });
        let mut taught = 0;
        for (i, range) in ranges.iter_mut().enumerate() {
            *range = self.learner.background(i, &self.limits);
            taught += u16::from(*range != Background::UNTAUGHT);
        }
        out.taught = taught;
    }

    /// By which method it is learned.
    pub fn method(&self) -> Method {
        self.settings.method
    }

    /// Counts the models: one more after a reset, a load, and a change of the scan's shape.
    pub fn generation(&self) -> u32 {
        self.generation
    }

    /// In so many scans something has to be met until it is background, as set or as follows from the last scan.
    pub fn scans(&self) -> u16 {
        self.limits.scans
    }

    /// Nothing is learned until it is thawed.
    pub fn is_frozen(&self) -> bool {
        self.frozen
    }

    /// Forgets everything. A frozen model stays frozen and then knows nothing until it is thawed.
    pub fn reset(&mut self) {
        match &mut self.learner {
            Learner::Paper(paper) if self.settings.method == Method::Paper => paper.forget(),
            Learner::Multi(multi) if self.settings.method == Method::Multi => multi.forget(),
            Learner::Moving(moving) if self.settings.method == Method::Moving => moving.forget(),
            other => *other = Learner::new(self.settings.method, self.most),
        }
        self.generation = self.generation.wrapping_add(1);
        self.fresh = true;
    }

    /// Stops learning; scans are compared as before.
    pub fn freeze(&mut self) {
        self.frozen = true;
    }

    /// Learns again.
    pub fn thaw(&mut self) {
        self.frozen = false;
    }

    /// Takes the ranges of `model` for the background; what was about to be learned is forgotten, its generation and
    /// its flags are left to this model's own.
    ///
    /// Before the first scan nothing is known to compare it with: it is taken, and a first scan of another number of
    /// beams or unit resets it as any change does.
    pub fn load(&mut self, model: &Background) -> Result<(), Mismatch> {
        let ranges = model.ranges();
        let shape = (ranges.len() as u16, model.unit_um);
        if self.is_fitted && shape != self.shape || ranges.len() > self.most {
            return Err(Mismatch { model: shape, sensor: self.shape });
        }
        self.shape = shape;
        if !self.is_fitted {
            self.angles = (model.first_angle, model.step);
        }
        self.reset();
        self.learner.adopt(ranges);
        self.fresh = false;
        Ok(())
    }

    /// Learns by `settings` from the next scan on. What is background stays background, as well known as can be; what was
    /// about to be learned is forgotten, and the generation is the next one, as after [`load`](Self::load).
    pub fn change(&mut self, settings: Settings) {
        // Between two scans there are no readings.
        let beams = self.beams();
        for (i, range) in self.readings[..beams].iter_mut().enumerate() {
            *range = self.learner.background(i, &self.limits);
        }
        let was_fresh = self.fresh;
        self.settings = settings;
        self.reset();
        self.learner.adopt(&self.readings[..beams]);
        self.fresh = was_fresh;
        // The next scan tells what the settings mean in its units.
        self.is_fitted = false;
    }

    /// Makes the model one for scans such as `scan`.
    fn fit(&mut self, scan: &Scan) {
        let shape = (scan.beams().min(self.most) as u16, scan.unit_um);
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

impl Learner {
    fn new(method: Method, beams: usize) -> Learner {
        match method {
            Method::Paper => Learner::Paper(Paper::new(beams)),
            Method::Multi => Learner::Multi(Multi::new(beams)),
            Method::Moving => Learner::Moving(Moving::new(beams)),
        }
    }

    /// Takes `ranges` for the background, but those that tell nothing.
    fn adopt(&mut self, ranges: &[u16]) {
        for (i, &range) in ranges.iter().enumerate() {
            if range != INVALID && range != Background::UNTAUGHT {
                match self {
                    Learner::Paper(paper) => paper.adopt(i, range),
                    Learner::Multi(multi) => multi.adopt(i, range),
                    // Ranges from one place are no map.
                    Learner::Moving(_) => {}
                }
            }
        }
    }

    /// The background of beam `i` in device units, [`Background::UNTAUGHT`] or [`Background::FAR`].
    fn background(&self, i: usize, limits: &Limits) -> u16 {
        match self {
            Learner::Paper(paper) => paper.background(i),
            Learner::Multi(multi) => multi.background(i, limits),
            Learner::Moving(moving) => moving.background(i, limits),
        }
    }
}

/// The readings of `scan` in device units, [`Background::FAR`] or [`INVALID`]. The values
/// themselves are compared: they are many.
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

/// Writes everything but the segments.
fn write(scan: &Scan, generation: u32, classes: &[Class], out: &mut Foreground) {
    let head = ForegroundHead {
        generation,
        unit_um: scan.unit_um,
        count: classes.len() as u16,
        ..ForegroundHead::default()
    };
    let ForegroundArrays { bits, ranges, .. } = out.begin(head);
    bits.fill(0);
    let mut beams = 0;
    for ((byte, classes), values) in bits.iter_mut().zip(classes.chunks(8)).zip(scan.ranges().chunks(8)) {
        if !classes.iter().fold(false, |any, &class| any | (class == Class::Foreground)) {
            continue;
        }
        for (bit, (&class, &value)) in classes.iter().zip(values).enumerate() {
            if class == Class::Foreground {
                *byte |= 1 << bit;
                ranges[beams] = value;
                beams += 1;
            }
        }
    }
    ranges[beams..].fill(0);
    out.beams = beams as u16;
}

/// A model that does not fit the sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mismatch {
    /// Beams and micrometres per device unit of the model.
    pub model: (u16, u32),
    /// Those of the sensor's scans.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reading::Reading;

    #[test]
    fn readings_are_those_of_every_processor() {
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
}
