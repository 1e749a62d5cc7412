//! The scanner of a link: its family, and what is set for one whose head turns. Refuses to know
//! where it was set, and what is set for an LMS.

use scanhub_drivers::line::family::{Features, Model, Wanted};
use schema::Family;

/// A family of scanners, with what is set for one of them. What is set for an LMS is in its [`Link`](crate::Link).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scanner {
    /// SICK LMS 2xx.
    Lms,
    /// A scanner whose head turns.
    Turning(Turning),
}

/// What is set for a scanner whose head turns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Turning {
    /// Of which family it is.
    pub family: Family,
    /// What it can be.
    pub features: &'static Features,
    /// The model; the features' own if it is to be found out.
    pub model: Model,
    /// How it measures; nothing if it shall choose.
    pub mode: Option<&'static str>,
    /// Beams of a scan; the model's, if they are not set.
    pub beams: Option<usize>,
    /// Whether its motor rests while nobody follows.
    pub stop_when_idle: bool,
}

impl Turning {
    /// A scanner of `family`, of which nothing is set.
    pub(crate) fn new(family: Family, features: &'static Features) -> Turning {
        Turning { family, features, model: features.auto, mode: None, beams: None, stop_when_idle: false }
    }

    /// Returns whether the model, and with it the number of beams, is to be found out.
    pub fn is_auto(&self) -> bool {
        self.model == self.features.auto && self.beams.is_none()
    }

    /// Returns the beams of its scans, at the most where they are to be found out.
    pub fn most_beams(&self) -> usize {
        self.beams.unwrap_or(self.model.beams)
    }

    /// Returns the highest rate that it can have.
    pub fn most_rate(&self) -> u32 {
        let all = self.features.models.iter().map(|model| model.baud);
        if self.is_auto() { all.max().unwrap_or(self.model.baud) } else { self.model.baud }
    }

    /// Returns what a session with it needs, on a port that has one rate or not, of a scanner that listens or not.
    pub fn wanted(&self, fixed_rate: bool, listen_only: bool) -> Wanted {
        Wanted {
            model: (self.model != self.features.auto).then_some(self.model.name),
            mode: self.mode,
            beams: self.beams,
            most_beams: Some(self.most_beams()),
            fixed_rate,
            listen_only,
            stop_when_idle: self.stop_when_idle,
        }
    }
}
