//! How many bytes a second go over a network: all scans, or the foreground alone.

use lms::variant::Variant;
use preprocess::background::{Model, Settings};
use preprocess::segments::Segmenter;
use schema::{Foreground, Pose, Scan};

use super::play::Frame;

/// Bytes of payloads over some runs, without headers.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Bytes {
    scans: u64,
    scan: u64,
    foreground: u64,
    /// The foreground of scans in which nobody was.
    empty: (u64, u64),
}

impl Bytes {
    /// Adds a run of `frames`, compared by the method of `settings`.
    pub(crate) fn add(&mut self, settings: Settings, frames: &[Frame]) {
        let beams = Variant::HALF.beams();
        let mut model = Model::new(settings, beams);
        let mut cutter = Segmenter::new(Pose::default(), beams);
        let mut out = Foreground::of(beams);
        for frame in frames {
            model.update(&frame.scan, &mut out);
            cutter.update(&frame.scan, &mut out);
            let foreground =
                Foreground::HEAD + beams.div_ceil(8) + 2 * out.ranges().len() + 16 * out.segments().len();
            self.scans += 1;
            self.scan += Scan::len(beams, 0) as u64;
            self.foreground += foreground as u64;
            if out.beams == 0 {
                self.empty = (self.empty.0 + 1, self.empty.1 + foreground as u64);
            }
        }
    }

    /// Bytes per second at 37.5 Hz: scans, foreground, foreground of scans in which it is empty.
    pub(crate) fn per_second(&self) -> [f64; 3] {
        let per_second = |bytes: u64, scans: u64| bytes as f64 / scans as f64 * 1e3 / 26.64;
        [
            per_second(self.scan, self.scans),
            per_second(self.foreground, self.scans),
            per_second(self.empty.1, self.empty.0),
        ]
    }
}
