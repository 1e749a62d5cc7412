//! What the hub makes of each scan of a link: marks, lines, motion, zones, foreground. One after the other on the scan where it was
//! decoded, each into the payload that is given. Refuses to know topics, and who listens.

use std::fmt;

use config::Processing;
use preprocess::background::{Method, Mismatch, Model};
use preprocess::lines::LineFinder;
use preprocess::marks::MarkDetector;
use preprocess::motion::MotionEstimator;
use preprocess::segments::Segmenter;
use preprocess::zones::Check;
use schema::{Background, Failure, Foreground, Kind, Lines, Marks, Motion, Pose, Scan, Verb, Zones};

/// The processors of one link. Suspect scans take the same way as clean ones: an obstacle counts also where it is only
/// suspected, and a background needs hundreds of scans in agreement, which the one bad one among them does not spoil.
pub(crate) struct Pipeline {
    pub(crate) zones: Check,
    marks: MarkDetector,
    lines: LineFinder,
    motion: MotionEstimator,
    background: Option<BackgroundStage>,
    /// By which they are made.
    processing: Processing,
    /// The most beams of a scan.
    beams: usize,
    /// Where a payload is written that nobody wants, or for which there is no memory.
    spare: Spare,
}

/// A background, and what is known of it outside.
struct BackgroundStage {
    model: Model,
    cutter: Segmenter,
    every_scan: bool,
    /// The generation that was published last.
    published: Option<u32>,
    /// Scans that it has learned from since.
    learned: u32,
    /// The generation that was handed on last, and scans that it has learned from since.
    handed_on: (u32, u32),
    /// Beams and unit in micrometres of the model, as far as something was learned or loaded.
    shape: Option<(u16, u32)>,
}

struct Spare {
    zones: Zones,
    lines: Box<Lines>,
    motion: Motion,
    foreground: Box<Foreground>,
}

/// Why a background is learned again from a scan on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Relearned {
    /// The model was one of other beams or another unit.
    Shape(Mismatch),
    /// Its beams look elsewhere.
    Angles,
}

impl fmt::Display for Relearned {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Relearned::Shape(mismatch) => mismatch.fmt(f),
            Relearned::Angles => f.write_str("the sensor's beams have other angles than before"),
        }
    }
}

/// Where to write what a scan tells beside its zones; nothing where nobody wants it or there is no memory.
#[derive(Default)]
pub(crate) struct Outputs<'a> {
    pub(crate) marks: Option<&'a mut Marks>,
    pub(crate) lines: Option<&'a mut Lines>,
    pub(crate) motion: Option<&'a mut Motion>,
    pub(crate) foreground: Option<&'a mut Foreground>,
}

impl Pipeline {
    /// The processors as configured, with the model to begin with, for scans of at most `beams` beams.
    pub(crate) fn new(processing: &Processing, beams: usize) -> Pipeline {
        let Processing { pose, zones, marks, lines, motion, background, early: _ } = processing;
        Pipeline {
            zones: Check::new(*pose, &zones.settings(), beams),
            marks: MarkDetector::new(*marks),
            lines: LineFinder::new(*pose, *lines, beams),
            motion: MotionEstimator::new(*pose, *motion, beams),
            background: background.is_kept.then(|| BackgroundStage::new(processing, beams)),
            processing: processing.clone(),
            beams,
            spare: Spare {
                zones: Zones::default(),
                lines: Box::default(),
                motion: Motion::default(),
                foreground: Foreground::of(beams),
            },
        }
    }

    /// Forgets all that was learned, as at the start.
    pub(crate) fn reset(&mut self) {
        *self = Pipeline::new(&self.processing, self.beams);
    }

    /// Goes on as `processing` says, what it says of a begin aside. A check of other circles knows nothing until it has
    /// seen its scans; a background stays, as far as it is known.
    pub(crate) fn change(&mut self, processing: &Processing) {
        let before = std::mem::replace(&mut self.processing, processing.clone());
        let Processing { pose, zones, marks, lines, motion, background, early: _ } = &self.processing;
        if (pose, zones) != (&before.pose, &before.zones) {
            self.zones = Check::new(*pose, &zones.settings(), self.beams);
        }
        self.marks = MarkDetector::new(*marks);
        self.lines.change(*pose, *lines);
        self.motion.change(*pose, *motion);
        match &mut self.background {
            Some(kept) if background.is_kept => {
                kept.cutter = Segmenter::new(*pose, self.beams);
                kept.every_scan = background.every_scan;
                if background.learning != before.background.learning {
                    kept.model.change(background.learning);
                }
            }
            kept => *kept = background.is_kept.then(|| BackgroundStage::new(processing, self.beams)),
        }
    }

    /// Reads `scan` for its zones, which are wanted first. What has a memory learns from it, whoever wants to know.
    pub(crate) fn watch(&mut self, scan: &Scan, out: Option<&mut Zones>) {
        self.zones.update(scan, out.unwrap_or(&mut self.spare.zones));
    }

    /// Reads `scan` for all else. A model that does not fit it starts again; then the reason is returned.
    pub(crate) fn examine(&mut self, scan: &Scan, out: Outputs<'_>) -> Option<Relearned> {
        if let Some(marks) = out.marks {
            self.marks.update(scan, marks);
        }
        let is_moving = self.background.as_ref().is_some_and(BackgroundStage::is_moving);
        let motion = match out.motion {
            None if is_moving => Some(&mut self.spare.motion),
            wanted => wanted,
        };
        match (out.lines, motion) {
            (None, None) => self.motion.forget(),
            (Some(lines), None) => {
                self.lines.update(scan, lines);
                self.motion.forget();
            }
            // The one is found by the other.
            (lines, Some(motion)) => {
                let lines = lines.unwrap_or(&mut self.spare.lines);
                self.lines.update(scan, lines);
                self.motion.update(scan, lines, motion);
                if let Some(kept) = &mut self.background {
                    kept.model.follow(&self.processing.pose, motion);
                }
            }
        }
        self.background.as_mut()?.update(scan, out.foreground, &mut self.spare.foreground)
    }

    /// In how many pieces a telegram is read for who wants to be warned early.
    pub(crate) fn pieces(&self) -> u8 {
        self.processing.early.pieces
    }

    /// What to say of the zones when scans stay out.
    pub(crate) fn stale(&mut self, out: &mut Zones) {
        self.zones.stale(out);
    }

    /// Whether there are foreground and background at all.
    pub(crate) fn keeps_background(&self) -> bool {
        self.background.is_some()
    }

    /// Whether the model is published with every scan.
    pub(crate) fn shows_every_scan(&self) -> bool {
        self.background.as_ref().is_some_and(|kept| kept.every_scan)
    }

    /// Whether there is a model, of a generation that was not published, or that has had the time since to learn what
    /// stands there.
    pub(crate) fn is_news(&self) -> bool {
        let is_new = |kept: &BackgroundStage| kept.published != Some(kept.model.generation());
        let has_learned = |kept: &BackgroundStage| kept.learned >= u32::from(kept.model.scans());
        self.background
            .as_ref()
            .is_some_and(|kept| kept.shape.is_some() && (is_new(kept) || has_learned(kept)))
    }

    /// Returns the bytes of the model, if one is kept.
    pub(crate) fn model_len(&self) -> usize {
        self.background.as_ref().map_or(0, |kept| Background::len(kept.model.beams()))
    }

    /// Writes the model, which is to be published, into `out`, if one is kept.
    pub(crate) fn show(&mut self, out: &mut Background) {
        if let Some(kept) = &mut self.background {
            kept.model.show(out);
            kept.published = Some(out.generation);
            kept.learned = 0;
        }
    }

    /// The model for the next hub, if that shall have it, and where the sensor sits: of a generation that was not handed on,
    /// or that has learned since for as long as it takes; or, if it is `last` time, for however long.
    pub(crate) fn hand_on(&mut self, last: bool) -> Option<(Pose, Box<Background>)> {
        let Processing { pose, background, .. } = &self.processing;
        let kept = self.background.as_mut().filter(|kept| background.is_handed_on && !kept.is_moving())?;
        let (generation, learned) = kept.handed_on;
        let enough = if last { 1 } else { u32::from(kept.model.scans()) };
        if learned < enough && generation == kept.model.generation() {
            return None;
        }
        kept.handed_on = (kept.model.generation(), 0);
        Some((*pose, kept.shown()))
    }

    /// Does what a user asks of the background of `sensor`; the model, for [`Verb::Show`]. `model` is that of a request
    /// to load.
    ///
    /// [`Kind::Configuration`] if none is kept, or if `model` is another sensor's.
    pub(crate) fn handle(
        &mut self,
        sensor: &str,
        verb: Verb,
        model: &Background,
    ) -> Result<Option<Box<Background>>, Failure> {
        let Some(kept) = &mut self.background else {
            let message = format!("{sensor}: background.method is \"off\", no background is kept");
            let hint = format!("run the hub with --set link.{sensor}.background.method=multi, or paper");
            return Err(Failure::new(Kind::Configuration, message, hint));
        };
        match verb {
            Verb::Show => return Ok(Some(kept.shown())),
            Verb::Reset => kept.model.reset(),
            Verb::Freeze => kept.model.freeze(),
            Verb::Thaw => kept.model.thaw(),
            Verb::Load if kept.is_moving() => {
                let message = format!("{sensor}: background.method is \"moving\": a model is of one place");
                let hint = "load models of sensors that stand: of methods multi and paper";
                return Err(Failure::new(Kind::Configuration, message, hint));
            }
            Verb::Load => kept.load(model).map_err(|mismatch| {
                let hint =
                    "a model fits scans of its own resolution and unit: save one of this sensor as it is now";
                Failure::new(Kind::Configuration, format!("{sensor}: {mismatch}"), hint)
            })?,
            // The session's business.
            Verb::Pause | Verb::Resume | Verb::Resync => {}
        }
        Ok(None)
    }
}

impl BackgroundStage {
    fn new(processing: &Processing, beams: usize) -> BackgroundStage {
        let background = &processing.background;
        let mut kept = BackgroundStage {
            model: Model::new(background.learning, beams),
            cutter: Segmenter::new(processing.pose, beams),
            every_scan: background.every_scan,
            published: None,
            learned: 0,
            handed_on: (0, 0),
            shape: None,
        };
        if let Some(model) = background.model.as_ref().filter(|_| !kept.is_moving()) {
            // Before the first scan every model is taken.
            let _ = kept.load(model);
            kept.handed_on.0 = kept.model.generation();
        }
        kept
    }

    /// It is a map that the robot moves in.
    fn is_moving(&self) -> bool {
        self.model.method() == Method::Moving
    }

    fn load(&mut self, model: &Background) -> Result<(), Mismatch> {
        self.model.load(model)?;
        self.shape = Some((model.count, model.unit_um));
        Ok(())
    }

    /// A copy of the model.
    fn shown(&self) -> Box<Background> {
        let mut shown = Background::zeroed(Background::len(self.model.beams()));
        self.model.show(&mut shown);
        shown
    }

    fn update(
        &mut self,
        scan: &Scan,
        out: Option<&mut Foreground>,
        spare: &mut Foreground,
    ) -> Option<Relearned> {
        let before = self.model.generation();
        match out {
            Some(out) => {
                self.model.update(scan, out);
                self.cutter.update(scan, out);
            }
            // The segments of the next scan are supported by the points of this one.
            None => {
                self.model.update(scan, spare);
                self.cutter.pass(scan, spare);
            }
        }
        let scans = u32::from(!self.model.is_frozen());
        self.learned = self.learned.saturating_add(scans);
        self.handed_on.1 = self.handed_on.1.saturating_add(scans);
        let sensor = (scan.beams() as u16, scan.unit_um);
        let model = self.shape.replace(sensor).filter(|shape| *shape != sensor);
        let reason = model.map_or(Relearned::Angles, |model| Relearned::Shape(Mismatch { model, sensor }));
        (self.model.generation() != before).then_some(reason)
    }
}

#[cfg(test)]
mod tests;
