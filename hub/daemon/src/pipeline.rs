//! The processors of a link: they compute zones, marks, lines, motion and foreground from each scan. They run one after
//! the other on the decoded scan, and write into the payloads of the caller.

use std::fmt;

use scanhub_config::Processing;
use scanhub_preprocess::background::{BackgroundModel, Method, Mismatch};
use scanhub_preprocess::lines::LineFinder;
use scanhub_preprocess::marks::MarkDetector;
use scanhub_preprocess::motion::MotionEstimator;
use scanhub_preprocess::segments::Segmenter;
use scanhub_preprocess::zones::ZoneChecker;
use scanhub_schema::{Background, Failure, Foreground, Kind, Lines, Marks, Motion, Pose, Scan, Verb, Zones};

/// The processors of one link. They process suspect scans like clean ones: an obstacle in a suspect scan counts, and a
/// background needs hundreds of scans that agree, so a damaged scan among them has no effect.
pub(crate) struct Pipeline {
    pub(crate) zones: ZoneChecker,
    marks: MarkDetector,
    lines: LineFinder,
    motion: MotionEstimator,
    background: Option<BackgroundStage>,
    /// Settings of the processors.
    processing: Processing,
    /// Maximum number of beams of a scan.
    beams: usize,
    /// Buffers for results that have no subscriber or no memory.
    scratch: ScratchPayloads,
}

/// The background model, and which of its states were published and saved.
struct BackgroundStage {
    model: BackgroundModel,
    segmenter: Segmenter,
    every_scan: bool,
    /// Generation that was published last.
    published: Option<u32>,
    /// Number of scans that the model has learned from since its last publication.
    scans_since_publish: u32,
    /// Generation that was saved last, and the number of scans that the model has learned from since it was saved.
    saved: (u32, u32),
    /// Number of beams and unit in micrometers of the model, if anything was learned or loaded.
    shape: Option<(u16, u32)>,
}

struct ScratchPayloads {
    zones: Zones,
    motion: Motion,
    foreground: Box<Foreground>,
}

/// Reason to learn the background again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BackgroundReset {
    /// The model has another number of beams or another unit.
    Shape(Mismatch),
    /// The beams have other angles.
    Angles,
}

impl fmt::Display for BackgroundReset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            BackgroundReset::Shape(mismatch) => mismatch.fmt(f),
            BackgroundReset::Angles => f.write_str("the sensor's beams have other angles than before"),
        }
    }
}

/// Payloads for marks, lines and motion of a scan. `None`: the topic has no subscriber, or there is no memory.
#[derive(Default)]
pub(crate) struct ResultBuffers<'a> {
    pub(crate) marks: Option<&'a mut Marks>,
    pub(crate) lines: Option<&'a mut Lines>,
    pub(crate) motion: Option<&'a mut Motion>,
}

impl Pipeline {
    /// Creates the processors with the configured model, for scans of at most `beams` beams.
    pub(crate) fn new(processing: &Processing, beams: usize) -> Pipeline {
        let Processing { pose, zones, marks, lines, motion, background, early: _ } = processing;
        Pipeline {
            zones: ZoneChecker::new(*pose, zones, beams),
            marks: MarkDetector::new(*marks),
            lines: LineFinder::new(*pose, *lines, beams),
            motion: MotionEstimator::new(*pose, *motion, beams),
            background: background.is_enabled.then(|| BackgroundStage::new(processing, beams)),
            processing: processing.clone(),
            beams,
            scratch: ScratchPayloads {
                zones: Zones::default(),
                motion: Motion::default(),
                foreground: Foreground::of(beams),
            },
        }
    }

    /// Returns to the state at the start.
    pub(crate) fn reset(&mut self) {
        *self = Pipeline::new(&self.processing, self.beams);
    }

    /// Applies other settings, except for the initial model. If the pose or the circles change, the zones are unknown
    /// until enough scans were checked. The background is kept.
    pub(crate) fn change(&mut self, processing: &Processing) {
        let before = std::mem::replace(&mut self.processing, processing.clone());
        let Processing { pose, zones, marks, lines, motion, background, early: _ } = &self.processing;
        if (pose, zones) != (&before.pose, &before.zones) {
            self.zones = ZoneChecker::new(*pose, zones, self.beams);
        }
        self.marks = MarkDetector::new(*marks);
        self.lines.change(*pose, *lines);
        self.motion.change(*pose, *motion);
        match &mut self.background {
            Some(stage) if background.is_enabled => {
                stage.segmenter = Segmenter::new(*pose, self.beams);
                stage.every_scan = background.every_scan;
                if background.learning != before.background.learning {
                    stage.model.change(background.learning);
                }
            }
            kept => *kept = background.is_enabled.then(|| BackgroundStage::new(processing, self.beams)),
        }
    }

    /// Computes the zones of `scan`, which subscribers need first. The state of the zones is updated even without
    /// `out`.
    pub(crate) fn check_zones(&mut self, scan: &Scan, out: Option<&mut Zones>) {
        self.zones.update(scan, out.unwrap_or(&mut self.scratch.zones));
    }

    /// Computes marks, lines and motion of `scan`, which was measured at `stamp_ns`, `period_ns` after the scan before.
    /// The processors use only differences of stamps, so a replay passes the times of the recording. Call
    /// [`learn`](Self::learn) after it.
    pub(crate) fn process(&mut self, scan: &Scan, stamp_ns: u64, period_ns: u64, out: ResultBuffers<'_>) {
        if let Some(marks) = out.marks {
            self.marks.update(scan, marks);
        }
        let is_moving = self.background.as_ref().is_some_and(BackgroundStage::is_moving);
        let motion = match out.motion {
            None if is_moving => Some(&mut self.scratch.motion),
            wanted => wanted,
        };
        if let Some(lines) = out.lines {
            self.lines.update(scan, lines);
        }
        match motion {
            None => self.motion.reset(),
            Some(motion) => {
                self.motion.update(scan, stamp_ns, period_ns, motion);
                if let Some(stage) = &mut self.background {
                    stage.model.set_motion(&self.processing.pose, motion, &self.motion.velocity());
                }
            }
        }
    }

    /// Updates the background model from `scan`, and computes its foreground. The model learns even without a
    /// subscriber, because later subscribers and the next hub need what it has learned. Returns a reason if the model
    /// does not fit the scan and starts again.
    pub(crate) fn learn(
        &mut self,
        scan: &Scan,
        foreground: Option<&mut Foreground>,
    ) -> Option<BackgroundReset> {
        self.background.as_mut()?.update(scan, foreground, &mut self.scratch.foreground)
    }

    /// Returns the number of reads per telegram while early warnings have a subscriber.
    pub(crate) fn reads_per_telegram(&self) -> u8 {
        self.processing.early.reads_per_telegram
    }

    /// Writes the zones for a time without scans: unknown.
    pub(crate) fn mark_zones_unknown(&mut self, out: &mut Zones) {
        self.zones.write_stale(out);
    }

    /// Returns whether there is a background model.
    pub(crate) fn has_background(&self) -> bool {
        self.background.is_some()
    }

    /// Returns whether the model is published with every scan.
    pub(crate) fn publishes_every_scan(&self) -> bool {
        self.background.as_ref().is_some_and(|stage| stage.every_scan)
    }

    /// Returns whether the model must be published: its generation was not published yet, or since the last publication
    /// it has learned from as many scans as it needs for a new object.
    pub(crate) fn is_background_due(&self) -> bool {
        let is_unpublished = |stage: &BackgroundStage| stage.published != Some(stage.model.generation());
        let has_learned =
            |stage: &BackgroundStage| stage.scans_since_publish >= u32::from(stage.model.scans());
        self.background
            .as_ref()
            .is_some_and(|stage| stage.shape.is_some() && (is_unpublished(stage) || has_learned(stage)))
    }

    /// Returns the size of the model in bytes, 0 without one.
    pub(crate) fn background_len(&self) -> usize {
        self.background.as_ref().map_or(0, |stage| Background::len(stage.model.beams()))
    }

    /// Writes the model into `out`, and counts it as published.
    pub(crate) fn write_background(&mut self, out: &mut Background) {
        if let Some(stage) = &mut self.background {
            stage.model.write(out);
            stage.published = Some(out.generation);
            stage.scans_since_publish = 0;
        }
    }

    /// Returns the model and the sensor's pose for the next hub if they must be saved. They must be if the generation
    /// was not saved yet. They also must be if, since the last save, the model has learned from as many scans as it
    /// needs for a new object. At the end of the hub (`is_last`), one scan is enough.
    pub(crate) fn take_background_to_save(&mut self, is_last: bool) -> Option<(Pose, Box<Background>)> {
        let Processing { pose, background, .. } = &self.processing;
        let stage = self.background.as_mut().filter(|stage| background.is_saved && !stage.is_moving())?;
        let (generation, learned) = stage.saved;
        let min_scans = if is_last { 1 } else { u32::from(stage.model.scans()) };
        if learned < min_scans && generation == stage.model.generation() {
            return None;
        }
        stage.saved = (stage.model.generation(), 0);
        Some((*pose, stage.copy()))
    }

    /// Handles a user's request for the background of `sensor`. Returns the model for [`Verb::Show`]. `model` is the
    /// model of [`Verb::Load`].
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`] if there is no background, or if `model` does not fit the sensor.
    pub(crate) fn handle(
        &mut self,
        sensor: &str,
        verb: Verb,
        model: &Background,
    ) -> Result<Option<Box<Background>>, Failure> {
        let Some(stage) = &mut self.background else {
            let message = format!("{sensor}: background.method is \"off\", no background is kept");
            let hint = format!("run the hub with --set link.{sensor}.background.method=multi, or paper");
            return Err(Failure::new(Kind::Configuration, message, hint));
        };
        match verb {
            Verb::Show => return Ok(Some(stage.copy())),
            Verb::Reset => stage.model.reset(),
            Verb::Freeze => stage.model.freeze(),
            Verb::Thaw => stage.model.thaw(),
            Verb::Load if stage.is_moving() => {
                let message = format!(
                    "{sensor}: background.method is \"moving\": a saved background belongs to one position"
                );
                let hint = "load models of sensors that stand: of methods multi and paper";
                return Err(Failure::new(Kind::Configuration, message, hint));
            }
            Verb::Load => stage.load(model).map_err(|mismatch| {
                let hint =
                    "a model fits scans of its own resolution and unit: save one of this sensor as it is now";
                Failure::new(Kind::Configuration, format!("{sensor}: {mismatch}"), hint)
            })?,
            // Handled by the session.
            Verb::Pause | Verb::Resume | Verb::Resync => {}
        }
        Ok(None)
    }
}

impl BackgroundStage {
    fn new(processing: &Processing, beams: usize) -> BackgroundStage {
        let background = &processing.background;
        let mut stage = BackgroundStage {
            model: BackgroundModel::new(background.learning, beams),
            segmenter: Segmenter::new(processing.pose, beams),
            every_scan: background.every_scan,
            published: None,
            scans_since_publish: 0,
            saved: (0, 0),
            shape: None,
        };
        if let Some(model) = background.model.as_ref().filter(|_| !stage.is_moving()) {
            // Before the first scan, every model fits.
            let _ = stage.load(model);
            stage.saved.0 = stage.model.generation();
        }
        stage
    }

    /// Returns whether the model is a map that the robot moves in.
    fn is_moving(&self) -> bool {
        self.model.method() == Method::Moving
    }

    fn load(&mut self, model: &Background) -> Result<(), Mismatch> {
        self.model.load(model)?;
        self.shape = Some((model.count, model.unit_um));
        Ok(())
    }

    /// Returns a copy of the model.
    fn copy(&self) -> Box<Background> {
        let mut copy = Background::zeroed(Background::len(self.model.beams()));
        self.model.write(&mut copy);
        copy
    }

    fn update(
        &mut self,
        scan: &Scan,
        out: Option<&mut Foreground>,
        scratch: &mut Foreground,
    ) -> Option<BackgroundReset> {
        let before = self.model.generation();
        match out {
            Some(out) => {
                self.model.update(scan, out);
                self.segmenter.update(scan, out);
            }
            // Segments of the next scan need the points of this one.
            None => {
                self.model.update(scan, scratch);
                self.segmenter.pass(scan, scratch);
            }
        }
        let scans = u32::from(!self.model.is_frozen());
        self.scans_since_publish = self.scans_since_publish.saturating_add(scans);
        self.saved.1 = self.saved.1.saturating_add(scans);
        let sensor = (scan.beams() as u16, scan.unit_um);
        let model = self.shape.replace(sensor).filter(|shape| *shape != sensor);
        let reason =
            model.map_or(BackgroundReset::Angles, |model| BackgroundReset::Shape(Mismatch { model, sensor }));
        (self.model.generation() != before).then_some(reason)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::{BackgroundHead, ScanHead, Verdict};

    fn processing(change: impl FnOnce(&mut Processing)) -> Processing {
        let mut processing = Processing::default();
        processing.background.learning.scans = Some(4);
        change(&mut processing);
        processing
    }

    /// Returns a scan of a wall at `range` on all sides.
    fn wall(count: usize, unit_mm: u32, range: u16) -> Box<Scan> {
        Scan::of(ScanHead::lms(count, -90_000, 500, unit_mm, 13), &vec![range; count])
    }

    fn pipeline(processing: &Processing) -> Pipeline {
        Pipeline::new(processing, 401)
    }

    fn shown(pipeline: &mut Pipeline) -> Box<Background> {
        let mut model = Background::zeroed(Background::len(401));
        pipeline.write_background(&mut model);
        model
    }

    #[test]
    fn learns_and_checks_zones_without_subscribers() {
        let mut pipeline = pipeline(&processing(|_| {}));
        let mut zones = Zones::default();
        for _ in 0..20 {
            assert_eq!(pipeline.learn(&wall(361, 1, 3000), None), None);
        }
        let mut foreground = Foreground::of(361);
        let near = wall(361, 1, 500);
        pipeline.check_zones(&near, Some(&mut zones));
        assert_eq!(pipeline.learn(&near, Some(&mut foreground)), None);
        assert_eq!((zones.verdict(), foreground.beams), (Verdict::Stop, 361));
        assert_eq!(foreground.segments().len(), 1, "segments are those of this scan");
        let mut stale = Zones::default();
        pipeline.mark_zones_unknown(&mut stale);
        assert_eq!((stale.verdict(), stale.count), (Verdict::Unknown, 2));
    }

    #[test]
    fn new_generation_is_due_until_published() {
        let mut pipeline = pipeline(&processing(|_| {}));
        assert!(!pipeline.is_background_due(), "nothing was learned yet");
        pipeline.learn(&wall(361, 1, 3000), None);
        assert!(pipeline.is_background_due());
        assert_eq!((shown(&mut pipeline).generation, pipeline.is_background_due()), (0, false));
        for (verb, is_due) in [(Verb::Freeze, false), (Verb::Thaw, false), (Verb::Reset, true)] {
            assert_eq!(pipeline.handle("a", verb, &Box::<Background>::default()), Ok(None));
            assert_eq!(pipeline.is_background_due(), is_due, "{verb:?}");
        }
        assert_eq!(shown(&mut pipeline).generation, 1);
        let asked = pipeline
            .handle("a", Verb::Show, &Box::<Background>::default())
            .expect("is kept")
            .expect("a model");
        assert_eq!((asked.generation, asked.count), (1, 361));
    }

    #[test]
    fn background_is_published_again_after_learning() {
        let mut pipeline = pipeline(&processing(|_| {}));
        pipeline.learn(&wall(361, 1, 3000), None);
        assert_eq!(shown(&mut pipeline).known_beams, 0);
        for _ in 0..3 {
            pipeline.learn(&wall(361, 1, 3000), None);
            assert!(!pipeline.is_background_due());
        }
        pipeline.learn(&wall(361, 1, 3000), None);
        assert!(pipeline.is_background_due());
        assert_eq!((shown(&mut pipeline).known_beams, pipeline.is_background_due()), (361, false));
        pipeline.handle("a", Verb::Freeze, &Box::<Background>::default()).expect("is kept");
        for _ in 0..9 {
            pipeline.learn(&wall(361, 1, 3000), None);
        }
        assert!(!pipeline.is_background_due(), "a frozen model stays as it is");
    }

    #[test]
    fn mismatched_background_is_refused_or_reset() {
        let head = BackgroundHead { unit_um: 10_000, ..BackgroundHead::default() };
        let model = Background::of(head, &[300; 181]);
        let kept = model.clone();
        let mut pipeline = pipeline(&processing(|processing| processing.background.model = Some(kept)));
        let (first, is_due) = (shown(&mut pipeline), pipeline.is_background_due());
        assert_eq!((first.generation, first.known_beams, first.ranges()[180], is_due), (1, 181, 300, false));
        let reason = pipeline.learn(&wall(361, 10, 300), None);
        assert_eq!(
            reason,
            Some(BackgroundReset::Shape(Mismatch { model: (181, 10_000), sensor: (361, 10_000) }))
        );
        assert!(pipeline.is_background_due());
        let refusal = pipeline.handle("a", Verb::Load, &model).expect_err("another resolution");
        assert_eq!(refusal.kind, Kind::Configuration);
        let words = "a: the model has 181 beams in units of 10 mm, the sensor's scans have 361 beams in units of 10 mm";
        assert_eq!(refusal.message, words);
        assert!(pipeline.learn(&wall(361, 1, 3000), None).is_some(), "another unit");
        let mut turned = wall(361, 1, 3000);
        turned.first_angle = -1.0;
        shown(&mut pipeline);
        assert_eq!(pipeline.learn(&turned, None), Some(BackgroundReset::Angles));
        assert_eq!((pipeline.is_background_due(), pipeline.learn(&turned, None)), (true, None));
    }

    #[test]
    fn other_settings_keep_the_background() {
        let mut pipeline = pipeline(&processing(|_| {}));
        for _ in 0..20 {
            pipeline.learn(&wall(361, 1, 3000), None);
        }
        let verdict_and_foreground = |pipeline: &mut Pipeline, range| {
            let (mut zones, mut foreground) = (Zones::default(), Foreground::of(361));
            pipeline.check_zones(&wall(361, 1, range), Some(&mut zones));
            assert_eq!(pipeline.learn(&wall(361, 1, range), Some(&mut foreground)), None);
            (zones.verdict(), foreground.beams)
        };
        let known = shown(&mut pipeline);
        assert_eq!(
            (verdict_and_foreground(&mut pipeline, 2000), known.known_beams),
            ((Verdict::Clear, 361), 361)
        );
        pipeline.change(&processing(|processing| processing.zones.radii_mm = vec![2500]));
        assert!(!pipeline.is_background_due(), "the background is not concerned");
        assert_eq!(verdict_and_foreground(&mut pipeline, 2000), (Verdict::Stop, 361));
        pipeline.change(&processing(|processing| {
            processing.background.learning.method = scanhub_preprocess::background::Method::Paper;
            processing.background.learning.threshold_mm = Some(1500);
        }));
        let changed = shown(&mut pipeline);
        assert_eq!((changed.generation, changed.ranges()), (known.generation + 1, known.ranges()));
        assert_eq!(
            verdict_and_foreground(&mut pipeline, 2000),
            (Verdict::Clear, 0),
            "the threshold is another one"
        );
        pipeline.change(&processing(|processing| processing.background.is_enabled = false));
        assert!(!pipeline.has_background());
        pipeline.change(&processing(|_| {}));
        assert_eq!((pipeline.has_background(), shown(&mut pipeline).known_beams), (true, 0));
    }

    #[test]
    fn request_without_a_background_names_the_key() {
        let mut pipeline = pipeline(&processing(|processing| processing.background.is_enabled = false));
        pipeline.learn(&wall(361, 1, 3000), None);
        assert!(
            !pipeline.has_background() && !pipeline.is_background_due() && !pipeline.publishes_every_scan()
        );
        let refusal =
            pipeline.handle("side", Verb::Show, &Box::<Background>::default()).expect_err("none is kept");
        assert!(refusal.hint.contains("link.side.background.method=multi"), "{refusal}");
    }
}
