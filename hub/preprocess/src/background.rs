//! Decides which beams of a scan hit the permanent surroundings, and which hit something in front of them. The model
//! of the surroundings is learned from the scans, beam by beam, by one of two methods. It compares ranges only: it
//! refuses to know what objects there are, and where the sensor is.

mod multi;
mod paper;
mod runs;
mod settings;

use std::fmt;

use schema::{BEAMS, Background, Code, Foreground, Scan};

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
    /// Beams and unit of the model: of the last scan or of what was loaded; (0, 0) before both.
    shape: (u16, u8),
    /// First angle and step of the last scan: a file does not tell them.
    angles: Option<(i32, u16)>,
    generation: u32,
    frozen: bool,
    /// Nothing has been learned or loaded since the last reset.
    fresh: bool,
    classes: [Class; BEAMS],
}

/// What is learned, by method.
#[expect(clippy::large_enum_variant, reason = "there is one per sensor, and no heap")]
#[derive(Clone)]
enum Learner {
    Paper(Paper),
    Multi(Multi),
}

/// A reading that tells nothing. It lies between the ranges and [`Background::FAR`].
const INVALID: u16 = Background::FAR - 1;

impl Model {
    /// A model that knows nothing.
    pub fn new(settings: Settings) -> Model {
        let limits = Limits::of(&settings, &Scan::default());
        Model {
            settings,
            limits,
            learner: Learner::new(settings.method),
            shape: (0, 0),
            angles: None,
            generation: 0,
            frozen: false,
            fresh: true,
            classes: [Class::Invalid; BEAMS],
        }
    }

    /// Compares `scan` with the model as it is, writes what stands before it to `out`, then learns from it. Writes
    /// every byte of `out` but those of the segments.
    pub fn update(&mut self, scan: &Scan, out: &mut Foreground) {
        self.fit(scan);
        let mut readings = [INVALID; BEAMS];
        measure(scan, self.limits.no_return_is_far, &mut readings);
        let count = scan.beams();
        let (readings, classes) = (&readings[..count], &mut self.classes[..count]);
        let learn = !self.frozen;
        match &mut self.learner {
            Learner::Paper(paper) => paper.update(readings, &self.limits, learn, classes),
            Learner::Multi(multi) => multi.update(readings, &self.limits, learn, classes),
        }
        if learn && self.fresh {
            if self.settings.start == Start::FirstScan {
                self.learner.adopt(readings);
            }
            self.fresh = false;
        }
        out.generation = self.generation;
        write(scan, &self.classes, out);
    }

    /// What the beams of the last scan are; empty before the first one.
    pub fn classes(&self) -> &[Class] {
        if self.angles.is_some() { &self.classes[..usize::from(self.shape.0)] } else { &[] }
    }

    /// Writes the model to `out`, every byte of it.
    pub fn show(&self, out: &mut Background) {
        *out = Background {
            generation: self.generation,
            count: self.shape.0,
            unit_mm: self.shape.1,
            flags: if self.frozen { Background::FROZEN } else { 0 },
            ..Background::default()
        };
        let count = usize::from(self.shape.0);
        for (i, range) in out.range_array[..count].iter_mut().enumerate() {
            *range = self.learner.background(i, &self.limits);
        }
        out.taught = out.ranges().iter().filter(|&&range| range != Background::UNTAUGHT).count() as u16;
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
        self.learner = Learner::new(self.settings.method);
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
        let shape = (ranges.len() as u16, model.unit_mm);
        if self.angles.is_some() && shape != self.shape {
            return Err(Mismatch { model: (model.count, model.unit_mm), sensor: self.shape });
        }
        self.shape = shape;
        self.reset();
        self.learner.adopt(ranges);
        self.fresh = false;
        Ok(())
    }

    /// Learns by `settings` from the next scan on. What is background stays background, as well known as can be; what was
    /// about to be learned is forgotten, and the generation is the next one, as after [`load`](Self::load).
    pub fn change(&mut self, settings: Settings) {
        let mut ranges = [Background::UNTAUGHT; BEAMS];
        let ranges = &mut ranges[..usize::from(self.shape.0)];
        for (i, range) in ranges.iter_mut().enumerate() {
            *range = self.learner.background(i, &self.limits);
        }
        let was_fresh = self.fresh;
        self.settings = settings;
        self.reset();
        self.learner.adopt(ranges);
        self.fresh = was_fresh;
        // The next scan tells what the settings mean in its units.
        self.angles = None;
    }

    /// Makes the model one for scans such as `scan`.
    fn fit(&mut self, scan: &Scan) {
        let shape = (scan.beams() as u16, scan.unit_mm);
        let angles = Some((scan.first_angle_mdeg, scan.step_mdeg));
        if (shape, angles) == (self.shape, self.angles) {
            return;
        }
        if shape != self.shape && self.shape != (0, 0) || self.angles.is_some() && angles != self.angles {
            self.reset();
        }
        self.shape = shape;
        self.angles = angles;
        self.limits = Limits::of(&self.settings, scan);
    }
}

impl Learner {
    fn new(method: Method) -> Learner {
        match method {
            Method::Paper => Learner::Paper(Paper::new()),
            Method::Multi => Learner::Multi(Multi::new()),
        }
    }

    /// Takes `ranges` for the background, but those that tell nothing.
    fn adopt(&mut self, ranges: &[u16]) {
        for (i, &range) in ranges.iter().enumerate() {
            if range != INVALID && range != Background::UNTAUGHT {
                match self {
                    Learner::Paper(paper) => paper.adopt(i, range),
                    Learner::Multi(multi) => multi.adopt(i, range),
                }
            }
        }
    }

    /// The background of beam `i` in device units, [`Background::UNTAUGHT`] or [`Background::FAR`].
    fn background(&self, i: usize, limits: &Limits) -> u16 {
        match self {
            Learner::Paper(paper) => paper.background(i),
            Learner::Multi(multi) => multi.background(i, limits),
        }
    }
}

/// The readings of `scan` in device units, [`Background::FAR`] or [`INVALID`]. The values
/// themselves are compared: they are many.
fn measure(scan: &Scan, no_return_is_far: bool, readings: &mut [u16; BEAMS]) {
    let max = scan.max();
    let no_return = if no_return_is_far { Background::FAR } else { INVALID };
    let beyond = max.saturating_sub(Code::BEYOND.0);
    let far = if max > Code::BEYOND.0 { Background::FAR } else { INVALID };
    for (reading, &value) in readings.iter_mut().zip(scan.ranges()) {
        *reading = if value < beyond {
            value
        } else if value == max {
            no_return
        } else if value == beyond {
            far
        } else {
            INVALID
        };
    }
}

/// Writes everything but generation and segments.
fn write(scan: &Scan, classes: &[Class; BEAMS], out: &mut Foreground) {
    let count = scan.beams();
    out.count = count as u16;
    out.unit_mm = scan.unit_mm;
    (out.pad, out.pad2) = ([0; 1], [0; 2]);
    out.bit_array.fill(0);
    let mut beams = 0;
    for (byte, (classes, values)) in classes[..count].chunks(8).zip(scan.ranges().chunks(8)).enumerate() {
        if !classes.iter().fold(false, |any, &class| any | (class == Class::Foreground)) {
            continue;
        }
        for (bit, (&class, &value)) in classes.iter().zip(values).enumerate() {
            if class == Class::Foreground {
                out.bit_array[byte] |= 1 << bit;
                out.range_array[beams] = value;
                beams += 1;
            }
        }
    }
    out.range_array[beams..].fill(0);
    out.beams = beams as u16;
}

/// A model that does not fit the sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mismatch {
    /// Beams and mm per device unit of the model.
    pub model: (u16, u8),
    /// Those of the sensor's scans.
    pub sensor: (u16, u8),
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ((beams, unit), (sensor_beams, sensor_unit)) = (self.model, self.sensor);
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
        for range_bits in 0..=u8::MAX {
            let mut scan = Scan { count: 32, unit_mm: 1, range_bits, ..Scan::default() };
            for (i, value) in scan.range_array.iter_mut().enumerate() {
                *value =
                    [0, 1, 2, 0x1FFF, 0x3FFF, 0x7FFF, 0xFFFF, i as u16][i % 8].wrapping_sub(i as u16 / 2);
            }
            for far in [false, true] {
                let mut readings = [INVALID; BEAMS];
                measure(&scan, far, &mut readings);
                for (i, &reading) in readings.iter().enumerate() {
                    let expected = match Reading::of(&scan, i, far) {
                        Reading::Valid(range) => range as u16,
                        Reading::Far => Background::FAR,
                        Reading::Invalid => INVALID,
                    };
                    assert_eq!(reading, expected, "beam {i} of {range_bits} bits");
                }
            }
        }
    }
}
