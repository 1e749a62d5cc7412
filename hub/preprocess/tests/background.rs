//! Tests of background models. Each method is compared beam by beam with a slow, independent version in floating point.
//! The comparison uses scans of many random surroundings, with commands such as a reset between the scans. Other tests
//! are about shapes of scans, commands, saved models, and scans that no scanner sends.

mod surroundings;

use scanhub_preprocess::background::{BackgroundModel, Candidate, Class, Method, Mismatch, Settings, Start};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::{Background, BackgroundHead, Foreground, Pose, Scan, ScanHead};
use surroundings::{
    MAX_TEST_BEAMS, RandomSurroundings, Shape, any_choice, any_model, check_scan, max_difference_mm,
    ranges_mm, reading_mm, unit_mm,
};

/// State of one beam in the slow version of the paper's method.
#[derive(Clone, Default)]
struct Beam {
    /// Background in mm; 0 if it is unknown.
    background_mm: f64,
    /// Consecutive readings in mm that agree with one candidate.
    run_mm: Vec<f64>,
}

struct ReferencePaper {
    settings: Settings,
    beams: Vec<Beam>,
    is_frozen: bool,
    is_fresh: bool,
}

/// Returns the difference of two readings, which may be infinite.
fn distance_mm(a: f64, b: f64) -> f64 {
    if a == b { 0.0 } else { (a - b).abs() }
}

impl ReferencePaper {
    fn new(settings: Settings, count: u16) -> ReferencePaper {
        ReferencePaper {
            settings,
            beams: vec![Beam::default(); usize::from(count)],
            is_frozen: false,
            is_fresh: true,
        }
    }

    fn reset(&mut self, count: u16) {
        self.beams = vec![Beam::default(); usize::from(count)];
        self.is_fresh = true;
    }

    fn load(&mut self, ranges_mm: &[f64]) {
        self.beams = ranges_mm.iter().map(|&mm| Beam { background_mm: mm, run_mm: vec![] }).collect();
        self.is_fresh = false;
    }

    fn update(&mut self, scan: &Scan) -> Vec<Class> {
        let far = self.settings.no_return_is_far.unwrap_or(false);
        let threshold_mm = max_difference_mm(self.settings.threshold_mm, scan);
        let candidate_mm = max_difference_mm(self.settings.candidate_mm, scan);
        let ten_seconds = (10.0 * 75.0 * (1000.0 * scan.step.to_degrees()).round() / 1000.0).ceil();
        let scans = self.settings.scans.map_or(ten_seconds, f64::from);
        let classes = self
            .beams
            .iter_mut()
            .enumerate()
            .map(|(i, beam)| {
                let Some(mm) = reading_mm(scan, i, far) else {
                    return Class::Invalid;
                };
                let before = beam.clone();
                let stands = beam.background_mm != 0.0 && distance_mm(mm, beam.background_mm) <= threshold_mm;
                if stands {
                    beam.run_mm.clear();
                } else {
                    let candidate = match self.settings.candidate {
                        Candidate::First => beam.run_mm.first(),
                        Candidate::Latest => beam.run_mm.last(),
                    };
                    if candidate.is_some_and(|&candidate| distance_mm(mm, candidate) > candidate_mm) {
                        beam.run_mm.clear();
                    }
                    beam.run_mm.push(mm);
                    if beam.run_mm.len() as f64 >= scans {
                        *beam = Beam { background_mm: mm, run_mm: vec![] };
                    }
                }
                if self.is_fresh && self.settings.start == Start::FirstScan && mm != 0.0 {
                    *beam = Beam { background_mm: mm, run_mm: vec![] };
                }
                if self.is_frozen {
                    *beam = before.clone();
                }
                match before.background_mm {
                    _ if stands => Class::Background,
                    0.0 => Class::Unknown,
                    background if mm < background => Class::Foreground,
                    _ => Class::Behind,
                }
            })
            .collect();
        self.is_fresh &= self.is_frozen;
        classes
    }
}

fn any_settings(random: &mut fastrand::Rng) -> Settings {
    let mut maybe = |from, to| if random.bool() { Some(random.u16(from..to)) } else { None };
    let (threshold_mm, candidate_mm, scans) = (maybe(5, 120), maybe(5, 120), maybe(1, 60));
    Settings {
        method: Method::Paper,
        threshold_mm,
        candidate_mm,
        scans: scans.map(u32::from),
        candidate: if random.bool() { Candidate::First } else { Candidate::Latest },
        start: if random.bool() { Start::Empty } else { Start::FirstScan },
        no_return_is_far: any_choice(random),
    }
}

#[test]
fn paper_method_matches_the_reference() {
    let mut class_counts = [0_u64; 5];
    let mut adopted = 0_u64;
    for seed in 0..16 {
        let mut random = fastrand::Rng::with_seed(seed);
        let settings = any_settings(&mut random);
        let mut surroundings = RandomSurroundings::new(Shape::any(&mut random), seed);
        let mut model = BackgroundModel::new(settings, MAX_TEST_BEAMS);
        let mut slow = ReferencePaper::new(settings, surroundings.shape.count);
        let mut generation = 0;
        for number in 0..2_000 {
            match random.u16(..1_500) {
                0 => {
                    model.reset();
                    slow.reset(surroundings.shape.count);
                    generation += 1;
                }
                1 => {
                    let saved = any_model(&mut random, surroundings.shape);
                    model.load(&saved).unwrap();
                    slow.load(&ranges_mm(&saved));
                    generation += 1;
                }
                2 if number > 0 => {
                    let other = Shape::any(&mut random);
                    let same = (other.count, other.unit_mm)
                        == (surroundings.shape.count, surroundings.shape.unit_mm);
                    surroundings = RandomSurroundings::new(other, seed);
                    if !same {
                        slow.reset(other.count);
                        generation += 1;
                    }
                }
                3 => {
                    model.freeze();
                    slow.is_frozen = true;
                }
                4..8 => {
                    model.thaw();
                    slow.is_frozen = false;
                }
                _ => {}
            }
            let scan = surroundings.next();
            let classes = slow.update(&scan);
            let dirt = random.u8(..);
            let place = &format_args!("seed {seed}, scan {number}, {settings:?}");
            check_scan(&mut model, &scan, &classes, generation, dirt, place);
            classes.iter().for_each(|&class| class_counts[class as usize] += 1);
        }
        let mut shown = Background::zeroed(Background::len(MAX_TEST_BEAMS));
        model.write(&mut shown);
        assert_eq!(ranges_mm(&shown), slow.beams.iter().map(|b| b.background_mm).collect::<Vec<_>>());
        assert_eq!((shown.generation, shown.is_frozen()), (generation, slow.is_frozen));
        assert_eq!(usize::from(shown.known_beams), shown.ranges().iter().filter(|&&r| r != 0).count());
        adopted += u64::from(shown.known_beams);
    }
    assert!(
        class_counts.iter().all(|&n| n > 10_000) && adopted > 2_000,
        "{class_counts:?}, {adopted}: nothing was tried"
    );
}

/// Surface that a beam has met, in the slow version of the method `multi`.
#[derive(Clone, Copy, Debug)]
struct SlowSurface {
    /// Range in device units.
    range: f64,
    /// Weight of the surface, in scans in which the beam met it.
    weight: f64,
}

impl SlowSurface {
    fn is_background(&self, scans: f64) -> bool {
        self.weight >= scans * 5.0 / 8.0
    }
}

/// Range in device units that is greater than any other range.
const FAR_RANGE: f64 = 1e9;
const NO_SURFACE: SlowSurface = SlowSurface { range: -FAR_RANGE, weight: 0.0 };

struct ReferenceMulti {
    settings: Settings,
    beams: Vec<[SlowSurface; 3]>,
    /// For each beam, the number of consecutive scans without a return. Scans in which the beam had no reading are
    /// ignored.
    lost_scans: Vec<u32>,
    /// Foreground beams of the last scan, with their readings.
    foreground: Vec<(usize, f64)>,
    /// Those beams in `foreground` that counted as objects.
    reported: Vec<(usize, f64)>,
    is_frozen: bool,
    is_fresh: bool,
    /// Number of scans until a surface is background, as computed for the last scan.
    scans: f64,
}

impl ReferenceMulti {
    fn new(settings: Settings, count: u16) -> ReferenceMulti {
        let beams = vec![[NO_SURFACE; 3]; usize::from(count)];
        let lost_scans = vec![0; usize::from(count)];
        ReferenceMulti {
            settings,
            beams,
            lost_scans,
            foreground: vec![],
            reported: vec![],
            is_frozen: false,
            is_fresh: true,
            scans: 0.0,
        }
    }

    fn reset(&mut self, count: u16) {
        *self = ReferenceMulti {
            is_frozen: self.is_frozen,
            scans: self.scans,
            ..ReferenceMulti::new(self.settings, count)
        };
    }

    fn load(&mut self, model: &Background) {
        self.reset(model.count);
        let far = |mm: f64| if mm.is_infinite() { FAR_RANGE } else { mm / unit_mm(model.unit_um) };
        ranges_mm(model).into_iter().enumerate().for_each(|(i, mm)| self.adopt(i, far(mm)));
        self.is_fresh = false;
    }

    fn adopt(&mut self, i: usize, range: f64) {
        if range != 0.0 {
            self.beams[i] = [SlowSurface { range, weight: f64::INFINITY }, NO_SURFACE, NO_SURFACE];
        }
    }

    fn nearest(&self, i: usize, scans: f64) -> Option<f64> {
        let known = self.beams[i].iter().filter(|surface| surface.is_background(scans));
        known.map(|surface| surface.range).min_by(f64::total_cmp)
    }

    fn update(&mut self, scan: &Scan) -> Vec<Class> {
        let unit_mm = unit_mm(scan.unit_um);
        let far = self.settings.no_return_is_far.unwrap_or(true);
        let threshold = (max_difference_mm(self.settings.threshold_mm, scan) / unit_mm).floor();
        let scans = (750.0 * (1000.0 * scan.step.to_degrees()).round() / 1000.0).ceil();
        let scans = self.settings.scans.map_or(scans, f64::from);
        self.scans = scans;
        let readings: Vec<Option<f64>> = (0..self.beams.len())
            .map(|i| Some((reading_mm(scan, i, far)? / unit_mm).min(FAR_RANGE)))
            .collect();
        let mut classes: Vec<Class> =
            (0..readings.len()).map(|i| self.class(i, readings[i], threshold, scans)).collect();
        self.remove_unconfirmed(&mut classes, &readings, unit_mm, (1000.0 * scan.step.to_degrees()).round());
        if !self.is_frozen {
            for (i, reading) in readings.iter().enumerate() {
                let Some(reading) = *reading else { continue };
                let lost = if reading == FAR_RANGE { 0 } else { std::mem::take(&mut self.lost_scans[i]) };
                self.lost_scans[i] += u32::from(reading == FAR_RANGE);
                let gain = f64::from(lost + 1).min((scans / 16.0).floor().clamp(1.0, 16.0));
                learn(&mut self.beams[i], reading, gain, threshold, scans);
                if self.is_fresh && self.settings.start == Start::FirstScan {
                    self.adopt(i, reading);
                }
            }
            self.is_fresh = false;
        }
        classes
    }

    fn class(&self, i: usize, reading: Option<f64>, threshold: f64, scans: f64) -> Class {
        let Some(reading) = reading else { return Class::Invalid };
        let meets = |surface: &&SlowSurface| (surface.range - reading).abs() <= threshold;
        if let Some(nearest) = self.nearest(i, scans) {
            return match reading {
                _ if self.beams[i].iter().filter(meets).any(|surface| surface.is_background(scans)) => {
                    Class::Background
                }
                _ if reading < nearest => Class::Foreground,
                _ => Class::Behind,
            };
        }
        let right = (1..=8).find_map(|aside| self.nearest(i.checked_sub(aside)?, scans));
        let left = (1..=8)
            .filter(|aside| i + aside < self.beams.len())
            .find_map(|aside| self.nearest(i + aside, scans));
        let met = self.beams[i].iter().filter(meets).any(|surface| surface.weight >= scans / 4.0);
        match (right, left) {
            (Some(right), Some(left)) if reading < right.min(left) - threshold && !met => Class::Foreground,
            _ => Class::Unknown,
        }
    }

    /// Changes the class of foreground beams that do not count as an object to unknown.
    fn remove_unconfirmed(
        &mut self,
        classes: &mut [Class],
        readings: &[Option<f64>],
        unit_mm: f64,
        step_mdeg: f64,
    ) {
        let foreground: Vec<(usize, f64)> = (0..classes.len())
            .filter(|&i| classes[i] == Class::Foreground)
            .map(|i| (i, readings[i].expect("only readings are in the foreground")))
            .collect();
        let mut reported = Vec::new();
        // Two foreground beams belong to one run if all beams between them have codes.
        let codes = |from: usize, to: usize| (from + 1..to).all(|i| readings[i].is_none());
        for run in foreground.chunk_by(|a, b| codes(a.0, b.0)) {
            let (first, last) = (run[0].0, run[run.len() - 1].0);
            let nearest = run.iter().map(|beam| beam.1).fold(FAR_RANGE, f64::min);
            let continues = |before: &[(usize, f64)]| {
                before.iter().any(|&(i, range)| {
                    i + 1 >= first && i <= last + 1 && (range - nearest).abs() * unit_mm <= 200.0
                })
            };
            let beam_mm = nearest * unit_mm * step_mdeg / 57_296.0;
            let leg = (135.0 / beam_mm).floor().clamp(1.0, 3.0);
            let is_confirmed = run.len() >= 3
                || continues(&self.reported)
                || run.len() as f64 >= leg && continues(&self.foreground);
            match is_confirmed {
                true => reported.extend_from_slice(run),
                false => run.iter().for_each(|&(i, _)| classes[i] = Class::Unknown),
            }
        }
        (self.foreground, self.reported) = (foreground, reported);
    }
}

fn learn(surfaces: &mut [SlowSurface; 3], reading: f64, gain: f64, threshold: f64, scans: f64) {
    surfaces.iter_mut().for_each(|surface| surface.weight = surface.weight.min(scans));
    let apart = |number: &usize| (surfaces[*number].range - reading).abs();
    let met = (0..3).filter(|number| apart(number) <= threshold).min_by(|a, b| apart(a).total_cmp(&apart(b)));
    for (number, surface) in surfaces.iter_mut().enumerate() {
        if Some(number) == met {
            surface.weight = (surface.weight + gain).min(scans);
            surface.range += ((reading - surface.range) / 16.0).trunc();
        } else {
            let leak = if reading > surface.range { 0.5 } else { 0.125 };
            surface.weight = (surface.weight - leak).max(0.0);
            if surface.weight == 0.0 {
                *surface = NO_SURFACE;
            }
        }
    }
    let weakest = (0..3).min_by(|&a, &b| surfaces[a].weight.total_cmp(&surfaces[b].weight)).expect("three");
    if met.is_none() && surfaces[weakest].weight < scans / 4.0 {
        surfaces[weakest] = SlowSurface { range: reading, weight: gain };
    }
}

#[test]
fn multi_method_matches_the_reference() {
    let mut class_counts = [0_u64; 5];
    for seed in 0..12 {
        let mut random = fastrand::Rng::with_seed(seed);
        let settings = Settings {
            method: Method::Multi,
            threshold_mm: if random.bool() { Some(random.u16(5..120)) } else { None },
            scans: if random.u8(..4) > 0 { Some(random.u32(1..300)) } else { None },
            start: if random.bool() { Start::Empty } else { Start::FirstScan },
            no_return_is_far: any_choice(&mut random),
            ..Settings::default()
        };
        let mut surroundings = RandomSurroundings::new(Shape::any(&mut random), seed);
        let mut model = BackgroundModel::new(settings, MAX_TEST_BEAMS);
        let mut slow = ReferenceMulti::new(settings, surroundings.shape.count);
        let mut generation = 0;
        for number in 0..2_000 {
            match random.u16(..1_500) {
                0 => {
                    model.reset();
                    slow.reset(surroundings.shape.count);
                    generation += 1;
                }
                1 => {
                    let saved = any_model(&mut random, surroundings.shape);
                    model.load(&saved).unwrap();
                    slow.load(&saved);
                    generation += 1;
                }
                2 => {
                    model.freeze();
                    slow.is_frozen = true;
                }
                3..7 => {
                    model.thaw();
                    slow.is_frozen = false;
                }
                _ => {}
            }
            let scan = surroundings.next();
            let classes = slow.update(&scan);
            let dirt = random.u8(..);
            let place = &format_args!("seed {seed}, scan {number}, {settings:?}");
            check_scan(&mut model, &scan, &classes, generation, dirt, place);
            classes.iter().for_each(|&class| class_counts[class as usize] += 1);
        }
        let mut shown = Background::zeroed(Background::len(MAX_TEST_BEAMS));
        model.write(&mut shown);
        for (i, &range) in shown.ranges().iter().enumerate() {
            let known: Vec<f64> =
                slow.beams[i].iter().filter(|s| s.is_background(slow.scans)).map(|s| s.range).collect();
            let at = if range == Background::FAR { FAR_RANGE } else { f64::from(range) };
            // A background at range 0 cannot be distinguished from an unknown background.
            assert!(known.contains(&at) || range == 0 && known.is_empty(), "beam {i}: {range}, {known:?}");
        }
    }
    assert!(class_counts.iter().all(|&n| n > 10_000), "{class_counts:?}: nothing was tried");
}

/// Both methods that learn a background beam by beam.
const METHODS: [Method; 2] = [Method::Paper, Method::Multi];

fn scan(count: usize, unit_mm: u32, range: u16) -> Box<Scan> {
    Scan::of(ScanHead::lms(count, 0, 500, unit_mm, 13), &vec![range; count])
}

fn model(method: Method) -> BackgroundModel {
    BackgroundModel::new(Settings { method, scans: Some(8), ..Settings::default() }, MAX_TEST_BEAMS)
}

fn background_of(model: &BackgroundModel) -> Box<Background> {
    let mut background = Background::of_bytes(&[0xA5; Background::len(MAX_TEST_BEAMS)]);
    model.write(&mut background);
    background
}

/// Returns a copy of `model` whose head `change` has changed.
fn with(model: &Background, change: impl FnOnce(&mut BackgroundHead)) -> Box<Background> {
    let mut other = model.boxed();
    change(&mut other);
    other
}

/// Passes `scan` to `model`, `times` times, and returns the last foreground.
fn update_times(model: &mut BackgroundModel, scan: &Scan, times: usize) -> Box<Foreground> {
    let mut out = Foreground::of(scan.beams());
    (0..times).for_each(|_| model.update(scan, &mut out));
    out
}

#[test]
fn model_learns_freezes_thaws_and_resets() {
    for method in METHODS {
        let mut model = model(method);
        assert_eq!((model.classes(), background_of(&model)), (&[][..], Box::default()));
        update_times(&mut model, &scan(361, 1, 3_000), 8);
        let known = background_of(&model);
        assert_eq!((known.count, known.known_beams, known.generation, known.unit_um), (361, 361, 0, 1000));
        assert!(known.ranges().iter().all(|&range| range == 3_000) && known.ranges().len() == 361);

        model.freeze();
        let out = update_times(&mut model, &scan(361, 1, 2_000), 100);
        assert_eq!((out.beams, out.ranges()[360], out.ranges().len()), (361, 2_000, 361));
        assert_eq!(background_of(&model), with(&known, |head| head.flags = Background::FROZEN));
        update_times(&mut model, &scan(361, 1, 4_000), 1);
        assert!(model.is_frozen() && model.classes().iter().all(|&class| class == Class::Behind));
        model.thaw();
        update_times(&mut model, &scan(361, 1, 2_000), 8);
        assert_eq!(update_times(&mut model, &scan(361, 1, 2_000), 1).beams, 0);

        model.reset();
        assert_eq!(
            (model.generation(), background_of(&model).known_beams, background_of(&model).count),
            (1, 0, 361)
        );
        assert_eq!(update_times(&mut model, &scan(361, 1, 1_000), 1).generation, 1);
        assert!(model.classes().iter().all(|&class| class == Class::Unknown));
    }
}

#[test]
fn changed_scan_layout_resets_the_background() {
    for method in METHODS {
        let mut model = model(method);
        update_times(&mut model, &scan(361, 1, 3_000), 20);
        let mut generation = 0;
        let mut finer = scan(361, 1, 3_000);
        finer.step /= 2.0;
        let mut turned = finer.clone();
        turned.first_angle = -1.0;
        for other in [scan(181, 1, 3_000), scan(181, 10, 300), scan(361, 1, 3_000), finer, turned] {
            generation += 1;
            assert_eq!(update_times(&mut model, &other, 1).generation, generation);
            assert_eq!((background_of(&model).known_beams, background_of(&model).count), (0, other.count));
            update_times(&mut model, &other, 20);
            assert_eq!((model.generation(), background_of(&model).known_beams), (generation, other.count));
        }
    }
}

#[test]
fn saved_model_is_loaded_only_if_the_layout_fits() {
    for method in METHODS {
        let head = BackgroundHead { unit_um: 1000, generation: 77, ..BackgroundHead::default() };
        let mut saved = Background::of(head, &[3_000; 361]);
        saved.ranges_mut()[..3].copy_from_slice(&[0, Background::FAR, 2_500]);
        let short = |unit_um| Background::of(BackgroundHead { unit_um, ..head }, &saved.ranges()[..181]);

        // A model may be loaded before the first scan.
        let mut early = model(method);
        early.load(&saved).unwrap();
        assert_eq!(
            background_of(&early),
            with(&saved, |head| (head.generation, head.known_beams) = (1, 360))
        );
        let out = update_times(&mut early, &scan(361, 1, 1_000), 1);
        assert_eq!((out.generation, out.beams), (1, 360));

        // If the loaded background does not match the first scan, the model is reset.
        let mut wrong = model(method);
        wrong.load(&saved).unwrap();
        assert_eq!(update_times(&mut wrong, &scan(181, 1, 1_000), 1).generation, 2);
        assert_eq!((background_of(&wrong).known_beams, background_of(&wrong).count), (0, 181));

        // After the first scan, the model refuses a background that does not match, and does not change.
        let before = background_of(&wrong);
        let refusal = wrong.load(&saved).unwrap_err();
        assert_eq!(refusal, Mismatch { model: (361, 1000), sensor: (181, 1000) });
        assert_eq!(
            wrong.load(&short(10_000)).unwrap_err().to_string(),
            "the model has 181 beams in units of 10 mm, the sensor's scans have 181 beams in units of 1 mm"
        );
        assert_eq!(background_of(&wrong), before);
        wrong.load(&short(1000)).unwrap();
        assert_eq!((wrong.generation(), background_of(&wrong).known_beams), (3, 180));
    }
}

#[test]
fn learns_background_from_the_first_scan() {
    for method in METHODS {
        let mut model = BackgroundModel::new(
            Settings { method, start: Start::FirstScan, ..Settings::default() },
            MAX_TEST_BEAMS,
        );
        update_times(&mut model, &scan(361, 1, 3_000), 1);
        assert!(
            model.classes().iter().all(|&class| class == Class::Unknown),
            "compared before it is learned"
        );
        assert_eq!(background_of(&model).known_beams, 361);
        assert_eq!(update_times(&mut model, &scan(361, 1, 2_000), 1).beams, 361);
        model.reset();
        update_times(&mut model, &scan(361, 1, 2_000), 1);
        assert_eq!(update_times(&mut model, &scan(361, 1, 2_000), 1).beams, 0, "after a reset as well");
        assert!(background_of(&model).ranges().iter().all(|&range| range == 2_000));
    }
}

/// A wall that returns only 15 % of the beams becomes background in 20 s. A person who stands for 5 s in a room without
/// returns does not become background, even if some beams that meet the person have no return.
#[test]
fn learns_faint_wall_but_not_a_standing_person() {
    let mut random = fastrand::Rng::with_seed(3);
    let mut some = |share: f64, range: u16| {
        let mut scan = scan(361, 1, 8191);
        for value in scan.arrays().ranges {
            *value = if random.f64() < share { range } else { 8191 };
        }
        scan
    };
    let mut model = BackgroundModel::new(Settings::default(), MAX_TEST_BEAMS);
    (0..750).for_each(|_| _ = update_times(&mut model, &some(0.15, 5_000), 1));
    let wall = update_times(&mut model, &some(1.0, 5_000), 1).beams;
    let before_it = update_times(&mut model, &some(1.0, 3_000), 1).beams;
    assert!(wall < 10 && before_it == 361, "{wall} beams of the wall, {before_it} before it");

    let mut model = BackgroundModel::new(Settings::default(), MAX_TEST_BEAMS);
    update_times(&mut model, &some(0.0, 0), 600);
    (0..187).for_each(|_| _ = update_times(&mut model, &some(0.97, 3_000), 1));
    let standing = update_times(&mut model, &some(1.0, 3_000), 1).beams;
    assert!(standing > 355, "{standing} beams");
}

#[test]
fn no_scan_or_model_causes_a_panic() {
    let mut random = fastrand::Rng::with_seed(1);
    for method in METHODS {
        for round in 0..60 {
            let mut any = || if random.bool() { Some(random.u16(..)) } else { None };
            let (threshold_mm, candidate_mm, scans) = (any(), any(), any());
            let settings = Settings {
                method,
                threshold_mm,
                candidate_mm,
                scans: scans.map(|n| if round % 3 == 0 { u32::MAX } else { u32::from(n % 5) }),
                start: if random.bool() { Start::Empty } else { Start::FirstScan },
                no_return_is_far: Some(random.bool()),
                ..Settings::default()
            };
            let mut model = BackgroundModel::new(settings, MAX_TEST_BEAMS);
            let mut cutter =
                Segmenter::new(Pose { x_m: f64::NAN, y_m: f64::MAX, ..Pose::default() }, MAX_TEST_BEAMS);
            let mut bytes = [0_u8; Scan::len(MAX_TEST_BEAMS + 20, 1)];
            for _ in 0..40 {
                // Most scans keep the shape of the previous scan, however unusual it is, because only the bytes after
                // the head change.
                let from = if random.u8(..8) == 0 { 0 } else { Scan::HEAD };
                random.fill(&mut bytes[from..]);
                let scan = Scan::of_bytes(&bytes);
                let dirty = || Foreground::of_bytes(&[0xFF; Foreground::len(MAX_TEST_BEAMS)]);
                let mut out = dirty();
                model.update(&scan, &mut out);
                assert_eq!(model.classes().len(), scan.beams().min(MAX_TEST_BEAMS));
                assert_eq!(out.readings().count(), usize::from(out.beams));
                cutter.update(&scan, &mut out);
                let mut foreign = dirty();
                foreign.count = MAX_TEST_BEAMS as u16;
                cutter.update(&scan, &mut foreign);
                let _ = model.load(&Background::of_bytes(&bytes));
                background_of(&model);
            }
        }
    }
}
