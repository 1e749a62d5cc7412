//! What the hub makes of each scan of a link: marks, zones, foreground. One after the other on the scan where it was
//! decoded, each into the payload that is given. Refuses to know topics, and who listens.

use std::fmt;

use config::Processing;
use preprocess::background::{Mismatch, Model};
use preprocess::marks::MarkDetector;
use preprocess::segments::Segmenter;
use preprocess::zones::Check;
use schema::{Background, Failure, Foreground, Kind, Marks, Pose, Scan, Verb, Zones};

/// The processors of one link. Suspect scans take the same way as clean ones: an obstacle counts also where it is only
/// suspected, and a background needs hundreds of scans in agreement, which the one bad one among them does not spoil.
pub(crate) struct Pipeline {
    pub(crate) zones: Check,
    marks: MarkDetector,
    background: Option<BackgroundStage>,
    /// By which they are made.
    processing: Processing,
    /// Where a payload is written that nobody wants, or for which there is no memory.
    spare: Spare,
}

/// A background, and what is known of it outside.
struct BackgroundStage {
    model: Box<Model>,
    cutter: Segmenter,
    every_scan: bool,
    /// The generation that was published last.
    published: Option<u32>,
    /// Scans that it has learned from since.
    learned: u32,
    /// The generation that was handed on last, and scans that it has learned from since.
    handed_on: (u32, u32),
    /// Beams and unit of the model, as far as something was learned or loaded.
    shape: Option<(u16, u8)>,
}

#[derive(Default)]
struct Spare {
    zones: Zones,
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

/// Where to write what a scan tells; nothing where nobody wants it or there is no memory.
#[derive(Default)]
pub(crate) struct Outputs<'a> {
    pub(crate) zones: Option<&'a mut Zones>,
    pub(crate) marks: Option<&'a mut Marks>,
    pub(crate) foreground: Option<&'a mut Foreground>,
}

impl Pipeline {
    /// The processors as configured, with the model to begin with.
    pub(crate) fn new(processing: &Processing) -> Pipeline {
        let Processing { pose, zones, marks, background } = processing;
        Pipeline {
            zones: Check::new(*pose, &zones.settings()),
            marks: MarkDetector::new(*marks),
            background: background.is_kept.then(|| BackgroundStage::new(processing)),
            processing: processing.clone(),
            spare: Spare::default(),
        }
    }

    /// Forgets all that was learned, as at the start.
    pub(crate) fn reset(&mut self) {
        *self = Pipeline::new(&self.processing);
    }

    /// Goes on as `processing` says, what it says of a begin aside. A check of other circles knows nothing until it has
    /// seen its scans; a background stays, as far as it is known.
    pub(crate) fn change(&mut self, processing: &Processing) {
        let before = std::mem::replace(&mut self.processing, processing.clone());
        let Processing { pose, zones, marks, background } = &self.processing;
        if (pose, zones) != (&before.pose, &before.zones) {
            self.zones = Check::new(*pose, &zones.settings());
        }
        self.marks = MarkDetector::new(*marks);
        match &mut self.background {
            Some(kept) if background.is_kept => {
                kept.cutter = Segmenter::new(*pose);
                kept.every_scan = background.every_scan;
                if background.learning != before.background.learning {
                    kept.model.change(background.learning);
                }
            }
            kept => *kept = background.is_kept.then(|| BackgroundStage::new(processing)),
        }
    }

    /// Reads `scan`. What has a memory learns from it, whoever wants to know. A model that does not fit the scan starts
    /// again; then the reason is returned.
    pub(crate) fn update(&mut self, scan: &Scan, out: Outputs<'_>) -> Option<Relearned> {
        self.zones.update(scan, out.zones.unwrap_or(&mut self.spare.zones));
        if let Some(marks) = out.marks {
            self.marks.update(scan, marks);
        }
        self.background.as_mut()?.update(scan, out.foreground, &mut self.spare.foreground)
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
    pub(crate) fn hand_on(&mut self, last: bool) -> Option<(Pose, Background)> {
        let Processing { pose, background, .. } = &self.processing;
        let kept = self.background.as_mut().filter(|_| background.is_handed_on)?;
        let (generation, learned) = kept.handed_on;
        let enough = if last { 1 } else { u32::from(kept.model.scans()) };
        if learned < enough && generation == kept.model.generation() {
            return None;
        }
        kept.handed_on = (kept.model.generation(), 0);
        let mut model = Background::default();
        kept.model.show(&mut model);
        Some((*pose, model))
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
            Verb::Show => {
                let mut shown = Box::<Background>::default();
                kept.model.show(&mut shown);
                return Ok(Some(shown));
            }
            Verb::Reset => kept.model.reset(),
            Verb::Freeze => kept.model.freeze(),
            Verb::Thaw => kept.model.thaw(),
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
    fn new(processing: &Processing) -> BackgroundStage {
        let background = &processing.background;
        let mut kept = BackgroundStage {
            model: Box::new(Model::new(background.learning)),
            cutter: Segmenter::new(processing.pose),
            every_scan: background.every_scan,
            published: None,
            learned: 0,
            handed_on: (0, 0),
            shape: None,
        };
        if let Some(model) = &background.model {
            // Before the first scan every model is taken.
            let _ = kept.load(model);
            kept.handed_on.0 = kept.model.generation();
        }
        kept
    }

    fn load(&mut self, model: &Background) -> Result<(), Mismatch> {
        self.model.load(model)?;
        self.shape = Some((model.count, model.unit_mm));
        Ok(())
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
            None => self.model.update(scan, spare),
        }
        let scans = u32::from(!self.model.is_frozen());
        self.learned = self.learned.saturating_add(scans);
        self.handed_on.1 = self.handed_on.1.saturating_add(scans);
        let sensor = (scan.beams() as u16, scan.unit_mm);
        let model = self.shape.replace(sensor).filter(|shape| *shape != sensor);
        let reason = model.map_or(Relearned::Angles, |model| Relearned::Shape(Mismatch { model, sensor }));
        (self.model.generation() != before).then_some(reason)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use schema::Verdict;

    fn processing(change: impl FnOnce(&mut Processing)) -> Processing {
        let mut processing = Processing::default();
        processing.background.learning.scans = Some(4);
        change(&mut processing);
        processing
    }

    /// A wall at `range` all around.
    fn wall(count: u16, unit_mm: u8, range: u16) -> Scan {
        let mut scan = Scan { count, unit_mm, range_bits: 13, step_mdeg: 500, ..Scan::default() };
        scan.range_array[..usize::from(count)].fill(range);
        scan
    }

    fn shown(pipeline: &mut Pipeline) -> Background {
        let mut model = Background::default();
        pipeline.show(&mut model);
        model
    }

    #[test]
    fn it_learns_and_warns_whoever_wants_to_know() {
        let mut pipeline = Pipeline::new(&processing(|_| {}));
        let mut zones = Zones::default();
        for _ in 0..20 {
            assert_eq!(pipeline.update(&wall(361, 1, 3000), Outputs::default()), None);
        }
        let mut foreground = Foreground::default();
        let near = wall(361, 1, 500);
        let out = Outputs { zones: Some(&mut zones), marks: None, foreground: Some(&mut foreground) };
        assert_eq!(pipeline.update(&near, out), None);
        assert_eq!((zones.verdict(), foreground.beams), (Verdict::Stop, 361));
        assert_eq!(foreground.segments().len(), 1, "segments are those of this scan");
        let mut stale = Zones::default();
        pipeline.stale(&mut stale);
        assert_eq!((stale.verdict(), stale.count), (Verdict::Unknown, 2));
    }

    #[test]
    fn a_generation_is_news_until_it_is_shown() {
        let mut pipeline = Pipeline::new(&processing(|_| {}));
        assert!(!pipeline.is_news(), "nothing is known yet");
        pipeline.update(&wall(361, 1, 3000), Outputs::default());
        assert!(pipeline.is_news());
        assert_eq!((shown(&mut pipeline).generation, pipeline.is_news()), (0, false));
        for (verb, is_news) in [(Verb::Freeze, false), (Verb::Thaw, false), (Verb::Reset, true)] {
            assert_eq!(pipeline.handle("a", verb, &Background::default()), Ok(None));
            assert_eq!(pipeline.is_news(), is_news, "{verb:?}");
        }
        assert_eq!(shown(&mut pipeline).generation, 1);
        let asked =
            pipeline.handle("a", Verb::Show, &Background::default()).expect("is kept").expect("a model");
        assert_eq!((asked.generation, asked.count), (1, 361));
    }

    #[test]
    fn what_was_learned_meanwhile_is_news() {
        let mut pipeline = Pipeline::new(&processing(|_| {}));
        pipeline.update(&wall(361, 1, 3000), Outputs::default());
        assert_eq!(shown(&mut pipeline).taught, 0);
        for _ in 0..3 {
            pipeline.update(&wall(361, 1, 3000), Outputs::default());
            assert!(!pipeline.is_news());
        }
        pipeline.update(&wall(361, 1, 3000), Outputs::default());
        assert!(pipeline.is_news());
        assert_eq!((shown(&mut pipeline).taught, pipeline.is_news()), (361, false));
        pipeline.handle("a", Verb::Freeze, &Background::default()).expect("is kept");
        for _ in 0..9 {
            pipeline.update(&wall(361, 1, 3000), Outputs::default());
        }
        assert!(!pipeline.is_news(), "a frozen model stays as it is");
    }

    #[test]
    fn a_model_that_does_not_fit_is_refused_or_begins_anew() {
        let mut model = Background { count: 181, unit_mm: 10, ..Background::default() };
        model.range_array[..181].fill(300);
        let mut pipeline =
            Pipeline::new(&processing(|processing| processing.background.model = Some(Box::new(model))));
        let (first, is_news) = (shown(&mut pipeline), pipeline.is_news());
        assert_eq!((first.generation, first.taught, first.ranges()[180], is_news), (1, 181, 300, false));
        let reason = pipeline.update(&wall(361, 10, 300), Outputs::default());
        assert_eq!(reason, Some(Relearned::Shape(Mismatch { model: (181, 10), sensor: (361, 10) })));
        assert!(pipeline.is_news());
        let refusal = pipeline.handle("a", Verb::Load, &model).expect_err("another resolution");
        assert_eq!(refusal.kind, Kind::Configuration);
        let words = "a: the model has 181 beams in units of 10 mm, the sensor's scans have 361 beams in units of 10 mm";
        assert_eq!(refusal.message, words);
        assert!(pipeline.update(&wall(361, 1, 3000), Outputs::default()).is_some(), "another unit");
        let turned = Scan { first_angle_mdeg: 40_000, ..wall(361, 1, 3000) };
        shown(&mut pipeline);
        assert_eq!(pipeline.update(&turned, Outputs::default()), Some(Relearned::Angles));
        assert_eq!((pipeline.is_news(), pipeline.update(&turned, Outputs::default())), (true, None));
    }

    #[test]
    fn other_settings_keep_what_is_known() {
        let mut pipeline = Pipeline::new(&processing(|_| {}));
        for _ in 0..20 {
            pipeline.update(&wall(361, 1, 3000), Outputs::default());
        }
        let told = |pipeline: &mut Pipeline, range| {
            let (mut zones, mut foreground) = (Zones::default(), Foreground::default());
            let out = Outputs { zones: Some(&mut zones), marks: None, foreground: Some(&mut foreground) };
            assert_eq!(pipeline.update(&wall(361, 1, range), out), None);
            (zones.verdict(), foreground.beams)
        };
        let known = shown(&mut pipeline);
        assert_eq!((told(&mut pipeline, 2000), known.taught), ((Verdict::Clear, 361), 361));
        pipeline.change(&processing(|processing| processing.zones.radii_mm = vec![2500]));
        assert!(!pipeline.is_news(), "the background is not concerned");
        assert_eq!(told(&mut pipeline, 2000), (Verdict::Stop, 361));
        pipeline.change(&processing(|processing| {
            processing.background.learning.method = preprocess::background::Method::Paper;
            processing.background.learning.threshold_mm = Some(1500);
        }));
        let changed = shown(&mut pipeline);
        assert_eq!((changed.generation, changed.ranges()), (known.generation + 1, known.ranges()));
        assert_eq!(told(&mut pipeline, 2000), (Verdict::Clear, 0), "the threshold is another one");
        pipeline.change(&processing(|processing| processing.background.is_kept = false));
        assert!(!pipeline.keeps_background());
        pipeline.change(&processing(|_| {}));
        assert_eq!((pipeline.keeps_background(), shown(&mut pipeline).taught), (true, 0));
    }

    #[test]
    fn who_keeps_none_refuses_with_the_key() {
        let mut pipeline = Pipeline::new(&processing(|processing| processing.background.is_kept = false));
        pipeline.update(&wall(361, 1, 3000), Outputs::default());
        assert!(!pipeline.keeps_background() && !pipeline.is_news() && !pipeline.shows_every_scan());
        let refusal = pipeline.handle("side", Verb::Show, &Background::default()).expect_err("none is kept");
        assert!(refusal.hint.contains("link.side.background.method=multi"), "{refusal}");
    }
}
