//! Tests of what the processors of a link make of scans.

use super::*;
use schema::{BackgroundHead, ScanHead, Verdict};

fn processing(change: impl FnOnce(&mut Processing)) -> Processing {
    let mut processing = Processing::default();
    processing.background.learning.scans = Some(4);
    change(&mut processing);
    processing
}

/// A wall at `range` all around.
fn wall(count: usize, unit_mm: u32, range: u16) -> Box<Scan> {
    Scan::of(ScanHead::lms(count, -90_000, 500, unit_mm, 13), &vec![range; count])
}

fn pipeline(processing: &Processing) -> Pipeline {
    Pipeline::new(processing, 401)
}

fn shown(pipeline: &mut Pipeline) -> Box<Background> {
    let mut model = Background::zeroed(Background::len(401));
    pipeline.show(&mut model);
    model
}

#[test]
fn it_learns_and_warns_whoever_wants_to_know() {
    let mut pipeline = pipeline(&processing(|_| {}));
    let mut zones = Zones::default();
    for _ in 0..20 {
        assert_eq!(pipeline.examine(&wall(361, 1, 3000), Outputs::default()), None);
    }
    let mut foreground = Foreground::of(361);
    let near = wall(361, 1, 500);
    let out = Outputs { foreground: Some(&mut foreground), ..Outputs::default() };
    pipeline.watch(&near, Some(&mut zones));
    assert_eq!(pipeline.examine(&near, out), None);
    assert_eq!((zones.verdict(), foreground.beams), (Verdict::Stop, 361));
    assert_eq!(foreground.segments().len(), 1, "segments are those of this scan");
    let mut stale = Zones::default();
    pipeline.stale(&mut stale);
    assert_eq!((stale.verdict(), stale.count), (Verdict::Unknown, 2));
}

#[test]
fn a_generation_is_news_until_it_is_shown() {
    let mut pipeline = pipeline(&processing(|_| {}));
    assert!(!pipeline.is_news(), "nothing is known yet");
    pipeline.examine(&wall(361, 1, 3000), Outputs::default());
    assert!(pipeline.is_news());
    assert_eq!((shown(&mut pipeline).generation, pipeline.is_news()), (0, false));
    for (verb, is_news) in [(Verb::Freeze, false), (Verb::Thaw, false), (Verb::Reset, true)] {
        assert_eq!(pipeline.handle("a", verb, &Box::<Background>::default()), Ok(None));
        assert_eq!(pipeline.is_news(), is_news, "{verb:?}");
    }
    assert_eq!(shown(&mut pipeline).generation, 1);
    let asked =
        pipeline.handle("a", Verb::Show, &Box::<Background>::default()).expect("is kept").expect("a model");
    assert_eq!((asked.generation, asked.count), (1, 361));
}

#[test]
fn what_was_learned_meanwhile_is_news() {
    let mut pipeline = pipeline(&processing(|_| {}));
    pipeline.examine(&wall(361, 1, 3000), Outputs::default());
    assert_eq!(shown(&mut pipeline).taught, 0);
    for _ in 0..3 {
        pipeline.examine(&wall(361, 1, 3000), Outputs::default());
        assert!(!pipeline.is_news());
    }
    pipeline.examine(&wall(361, 1, 3000), Outputs::default());
    assert!(pipeline.is_news());
    assert_eq!((shown(&mut pipeline).taught, pipeline.is_news()), (361, false));
    pipeline.handle("a", Verb::Freeze, &Box::<Background>::default()).expect("is kept");
    for _ in 0..9 {
        pipeline.examine(&wall(361, 1, 3000), Outputs::default());
    }
    assert!(!pipeline.is_news(), "a frozen model stays as it is");
}

#[test]
fn a_model_that_does_not_fit_is_refused_or_begins_anew() {
    let head = BackgroundHead { unit_um: 10_000, ..BackgroundHead::default() };
    let model = Background::of(head, &[300; 181]);
    let kept = model.clone();
    let mut pipeline = pipeline(&processing(|processing| processing.background.model = Some(kept)));
    let (first, is_news) = (shown(&mut pipeline), pipeline.is_news());
    assert_eq!((first.generation, first.taught, first.ranges()[180], is_news), (1, 181, 300, false));
    let reason = pipeline.examine(&wall(361, 10, 300), Outputs::default());
    assert_eq!(reason, Some(Relearned::Shape(Mismatch { model: (181, 10_000), sensor: (361, 10_000) })));
    assert!(pipeline.is_news());
    let refusal = pipeline.handle("a", Verb::Load, &model).expect_err("another resolution");
    assert_eq!(refusal.kind, Kind::Configuration);
    let words =
        "a: the model has 181 beams in units of 10 mm, the sensor's scans have 361 beams in units of 10 mm";
    assert_eq!(refusal.message, words);
    assert!(pipeline.examine(&wall(361, 1, 3000), Outputs::default()).is_some(), "another unit");
    let mut turned = wall(361, 1, 3000);
    turned.first_angle = -1.0;
    shown(&mut pipeline);
    assert_eq!(pipeline.examine(&turned, Outputs::default()), Some(Relearned::Angles));
    assert_eq!((pipeline.is_news(), pipeline.examine(&turned, Outputs::default())), (true, None));
}

#[test]
fn other_settings_keep_what_is_known() {
    let mut pipeline = pipeline(&processing(|_| {}));
    for _ in 0..20 {
        pipeline.examine(&wall(361, 1, 3000), Outputs::default());
    }
    let told = |pipeline: &mut Pipeline, range| {
        let (mut zones, mut foreground) = (Zones::default(), Foreground::of(361));
        let out = Outputs { foreground: Some(&mut foreground), ..Outputs::default() };
        pipeline.watch(&wall(361, 1, range), Some(&mut zones));
        assert_eq!(pipeline.examine(&wall(361, 1, range), out), None);
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
    let mut pipeline = pipeline(&processing(|processing| processing.background.is_kept = false));
    pipeline.examine(&wall(361, 1, 3000), Outputs::default());
    assert!(!pipeline.keeps_background() && !pipeline.is_news() && !pipeline.shows_every_scan());
    let refusal =
        pipeline.handle("side", Verb::Show, &Box::<Background>::default()).expect_err("none is kept");
    assert!(refusal.hint.contains("link.side.background.method=multi"), "{refusal}");
}
