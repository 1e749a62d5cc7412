//! What a consumer does that is given telegrams and nothing else: decode, zones, marks, background, foreground with its
//! segments, by the same code and settings as the hub. Refuses to know where telegrams come from.

use std::hint::black_box;

use daemon::scanner;
use lms::measured::Measured;
use lms::telegram::Telegram;
use lms::variant::Mode;
use preprocess::{background, marks, segments, zones};
use schema::limits::TopicLimits;
use schema::{Foreground, Marks, Pose, Scan, Zones};

/// Everything that is made of the scans of one sensor.
pub(crate) struct Work {
    zones: zones::Check,
    marks: marks::MarkDetector,
    model: background::Model,
    cutter: segments::Segmenter,
    scan: Box<Scan>,
    near: Zones,
    found: Marks,
    foreground: Box<Foreground>,
}

impl Work {
    pub(crate) fn new() -> Box<Work> {
        let TopicLimits { beams, contents, .. } = TopicLimits::default();
        Box::new(Work {
            zones: zones::Check::new(Pose::default(), &zones::Settings::default(), beams),
            marks: marks::MarkDetector::new(marks::Settings::default()),
            model: background::Model::new(background::Settings::default(), beams),
            cutter: segments::Segmenter::new(Pose::default(), beams),
            scan: Scan::zeroed(Scan::len(beams, contents)),
            near: Zones::default(),
            found: Marks::default(),
            foreground: Foreground::of(beams),
        })
    }

    /// Does it all for `telegram`; whether it was a scan.
    pub(crate) fn take(&mut self, telegram: Telegram<'_>) -> bool {
        let Some(measured) = Measured::decode(telegram) else { return false };
        scanner::decode(&measured, MODE, &mut self.scan);
        self.zones.update(&self.scan, &mut self.near);
        self.marks.update(&self.scan, &mut self.found);
        self.model.update(&self.scan, &mut self.foreground);
        self.cutter.update(&self.scan, &mut self.foreground);
        black_box((self.near.verdict(), self.found.marks().len(), self.foreground.segments().len()));
        true
    }
}

/// Measuring mode of the sensors here, as they leave the factory.
pub(crate) const MODE: Mode = Mode(1);
