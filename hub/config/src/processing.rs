//! How the hub processes the scans of a link: the effective values of sections pose, zones, marks, lines, motion, background and early.
//! Refuses to know where they were set.

use std::path::PathBuf;

use crate::link::Link;
use preprocess::background::Settings as Learning;
use preprocess::{lines, marks, motion, zones};
use schema::{Failure, Kind, Pose, SavedModel, regular};

/// How the scans of one link are processed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Processing {
    /// The pose of the sensor.
    pub pose: Pose,
    /// What is near the robot.
    pub zones: Zones,
    /// How reflector marks are found.
    pub marks: marks::Settings,
    /// How straight lines are found.
    pub lines: lines::Settings,
    /// Which steps of the robot are believed.
    pub motion: motion::Settings,
    /// How the background is learned.
    pub background: Background,
    /// How warnings come before a telegram is complete.
    pub early: Early,
}

/// Section `[early]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Early {
    /// A telegram is read in so many pieces while somebody follows the topic, 2 to 8.
    pub pieces: u8,
}

impl Default for Early {
    fn default() -> Self {
        Early { pieces: 2 }
    }
}

/// Section `[zones]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Zones {
    /// Radii around the robot's centre in mm, the largest first, 1 to 8.
    pub radii_mm: Vec<u16>,
    /// The robot's own body in the sensor's view.
    pub self_min: Vec<zones::Sector>,
    /// Added to every radius, in mm.
    pub margin_mm: u16,
    /// Beams that violate a circle, at least.
    pub min_beams: u16,
    /// Scans in a row that violate it, at least.
    pub min_scans: u16,
    /// Share of the beams through the largest circle that may be without a reading.
    pub max_invalid: f64,
    /// If the sensor is outside a circle, points in front of the circle's near side are not inside it.
    pub exact: bool,
    /// A beam without an echo means that nothing is near.
    pub no_return_is_far: bool,
}

impl Zones {
    /// The same, as the processor takes it.
    pub fn settings(&self) -> zones::Settings<'_> {
        zones::Settings {
            radii_mm: &self.radii_mm,
            self_min: &self.self_min,
            margin_mm: self.margin_mm,
            min_beams: self.min_beams,
            min_scans: self.min_scans,
            max_invalid: self.max_invalid,
            exact: self.exact,
            no_return_is_far: self.no_return_is_far,
        }
    }
}

impl Default for Zones {
    fn default() -> Self {
        let zones::Settings {
            radii_mm,
            self_min,
            margin_mm,
            min_beams,
            min_scans,
            max_invalid,
            exact,
            no_return_is_far,
        } = zones::Settings::default();
        let (radii_mm, self_min) = (radii_mm.to_vec(), self_min.to_vec());
        Zones { radii_mm, self_min, margin_mm, min_beams, min_scans, max_invalid, exact, no_return_is_far }
    }
}

/// Section `[background]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Background {
    /// A background is kept; else there are no samples of foreground and background.
    pub is_kept: bool,
    /// How it is learned.
    pub learning: Learning,
    /// The file that it starts with.
    pub file: Option<PathBuf>,
    /// The start was set explicitly: what an earlier hub learned is not used.
    pub start_is_said: bool,
    /// What is learned is kept for the next hub, which starts with it.
    pub is_handed_on: bool,
    /// What it starts with: the content of the file, or what an earlier hub learned.
    pub model: Option<Box<schema::Background>>,
    /// The model is published with every scan, not only with a new generation and whenever it has learned for a while.
    pub every_scan: bool,
}

impl Background {
    /// Reads the file that the background of the sensor of `link` starts with, if there is one, and compares it with the
    /// configuration of that sensor.
    ///
    /// [`Kind::Configuration`] with file and reason.
    pub(crate) fn read(&mut self, link: &Link) -> Result<(), Failure> {
        let sensor = &link.name;
        let Some(file) = self.file.as_ref().filter(|_| self.is_kept) else { return Ok(()) };
        let place = file.display().to_string();
        let refuse = |what: String, hint: &str| {
            let message = format!("link {sensor}: background.start = {place}: {what}");
            Err(Failure::new(Kind::Configuration, message, hint))
        };
        let text = match regular::read(file, regular::LONGEST) {
            Ok(text) => text,
            Err(error) => return refuse(error.to_string(), START),
        };
        let SavedModel { sensor: of, model } = SavedModel::parse(&text, &place).map_err(|failure| {
            let message = format!("link {sensor}: background.start: {}", failure.message);
            Failure::new(Kind::Configuration, message, failure.hint)
        })?;
        if of != *sensor {
            let hint = "name the file of each sensor by background.start of its link";
            return refuse(format!("the model is that of sensor {of}"), hint);
        }
        if let Err(wanted) = link.fits(&model) {
            let (beams, unit_mm) = (model.count, model.unit_um / 1000);
            let what = format!(
                "the model has {beams} beams in units of {unit_mm} mm, the link is configured for {wanted}"
            );
            return refuse(what, "use \"empty\", and save a new model of the sensor");
        }
        self.model = Some(model);
        Ok(())
    }
}

impl Default for Background {
    fn default() -> Self {
        Background {
            is_kept: true,
            learning: Learning::default(),
            file: None,
            start_is_said: false,
            is_handed_on: true,
            model: None,
            every_scan: false,
        }
    }
}

/// What a background may begin with.
pub(crate) const START: &str =
    "\"empty\", \"first-scan\", or a file that `scanhub background SENSOR save` has written";
