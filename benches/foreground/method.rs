//! What is measured: something that tells the foreground of scan after scan, and the hub's methods as such.

use lms::variant::Variant;
use preprocess::background::{Class, Model, Settings};
use schema::{Foreground, Scan};

/// Something that tells the foreground of each scan.
pub(crate) trait Method {
    /// The beams of `scan` in the foreground.
    fn update(&mut self, scan: &Scan, foreground: &mut [bool]);
}

/// A method of the hub.
pub(crate) struct Hub {
    model: Model,
    out: Box<Foreground>,
}

impl Hub {
    pub(crate) fn new(settings: Settings) -> Hub {
        let beams = Variant::HALF.beams();
        Hub { model: Model::new(settings, beams), out: Foreground::of(beams) }
    }
}

impl Method for Hub {
    fn update(&mut self, scan: &Scan, foreground: &mut [bool]) {
        self.model.update(scan, &mut self.out);
        for (is_foreground, class) in foreground.iter_mut().zip(self.model.classes()) {
            *is_foreground = *class == Class::Foreground;
        }
    }
}
