//! What a model is made for, what is done to it by command, and what it does with scans that no sensor sends.

use scanhub_preprocess::background::{Class, Method, Mismatch, Model, Settings, Start};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::{Background, BackgroundHead, Foreground, Pose, Scan, ScanHead};

/// The most beams of a scan.
const BEAMS: usize = 401;

const METHODS: [Method; 2] = [Method::Paper, Method::Multi];

fn scan(count: usize, unit_mm: u32, range: u16) -> Box<Scan> {
    Scan::of(ScanHead::lms(count, 0, 500, unit_mm, 13), &vec![range; count])
}

fn model(method: Method) -> Model {
    Model::new(Settings { method, scans: Some(8), ..Settings::default() }, BEAMS)
}

fn shown(model: &Model) -> Box<Background> {
    let mut background = Background::of_bytes(&[0xA5; Background::len(BEAMS)]);
    model.show(&mut background);
    background
}

/// `model` with another head.
fn with(model: &Background, change: impl FnOnce(&mut BackgroundHead)) -> Box<Background> {
    let mut other = model.boxed();
    change(&mut other);
    other
}

/// Shows `scan` to `model` so many times; the last foreground.
fn look(model: &mut Model, scan: &Scan, times: usize) -> Box<Foreground> {
    let mut out = Foreground::of(scan.beams());
    (0..times).for_each(|_| model.update(scan, &mut out));
    out
}

#[test]
fn learned_compared_frozen_thawed_and_reset() {
    for method in METHODS {
        let mut model = model(method);
        assert_eq!((model.classes(), shown(&model)), (&[][..], Box::default()));
        look(&mut model, &scan(361, 1, 3_000), 8);
        let known = shown(&model);
        assert_eq!((known.count, known.taught, known.generation, known.unit_um), (361, 361, 0, 1000));
        assert!(known.ranges().iter().all(|&range| range == 3_000) && known.ranges().len() == 361);

        model.freeze();
        let out = look(&mut model, &scan(361, 1, 2_000), 100);
        assert_eq!((out.beams, out.ranges()[360], out.ranges().len()), (361, 2_000, 361));
        assert_eq!(shown(&model), with(&known, |head| head.flags = Background::FROZEN));
        look(&mut model, &scan(361, 1, 4_000), 1);
        assert!(model.is_frozen() && model.classes().iter().all(|&class| class == Class::Behind));
        model.thaw();
        look(&mut model, &scan(361, 1, 2_000), 8);
        assert_eq!(look(&mut model, &scan(361, 1, 2_000), 1).beams, 0);

        model.reset();
        assert_eq!((model.generation(), shown(&model).taught, shown(&model).count), (1, 0, 361));
        assert_eq!(look(&mut model, &scan(361, 1, 1_000), 1).generation, 1);
        assert!(model.classes().iter().all(|&class| class == Class::Unknown));
    }
}

#[test]
fn another_shape_begins_anew() {
    for method in METHODS {
        let mut model = model(method);
        look(&mut model, &scan(361, 1, 3_000), 20);
        let mut generation = 0;
        let mut finer = scan(361, 1, 3_000);
        finer.step /= 2.0;
        let mut turned = finer.clone();
        turned.first_angle = -1.0;
        for other in [scan(181, 1, 3_000), scan(181, 10, 300), scan(361, 1, 3_000), finer, turned] {
            generation += 1;
            assert_eq!(look(&mut model, &other, 1).generation, generation);
            assert_eq!((shown(&model).taught, shown(&model).count), (0, other.count));
            look(&mut model, &other, 20);
            assert_eq!((model.generation(), shown(&model).taught), (generation, other.count));
        }
    }
}

#[test]
fn a_saved_model_is_taken_if_it_fits() {
    for method in METHODS {
        let head = BackgroundHead { unit_um: 1000, generation: 77, ..BackgroundHead::default() };
        let mut saved = Background::of(head, &[3_000; 361]);
        saved.ranges_mut()[..3].copy_from_slice(&[0, Background::FAR, 2_500]);
        let short = |unit_um| Background::of(BackgroundHead { unit_um, ..head }, &saved.ranges()[..181]);

        // Before the first scan.
        let mut early = model(method);
        early.load(&saved).unwrap();
        assert_eq!(shown(&early), with(&saved, |head| (head.generation, head.taught) = (1, 360)));
        let out = look(&mut early, &scan(361, 1, 1_000), 1);
        assert_eq!((out.generation, out.beams), (1, 360));

        // It does not fit the first scan: what it says is forgotten.
        let mut wrong = model(method);
        wrong.load(&saved).unwrap();
        assert_eq!(look(&mut wrong, &scan(181, 1, 1_000), 1).generation, 2);
        assert_eq!((shown(&wrong).taught, shown(&wrong).count), (0, 181));

        // Later it is refused, and the model stays what it was.
        let before = shown(&wrong);
        let refusal = wrong.load(&saved).unwrap_err();
        assert_eq!(refusal, Mismatch { model: (361, 1000), sensor: (181, 1000) });
        assert_eq!(
            wrong.load(&short(10_000)).unwrap_err().to_string(),
            "the model has 181 beams in units of 10 mm, the sensor's scans have 181 beams in units of 1 mm"
        );
        assert_eq!(shown(&wrong), before);
        wrong.load(&short(1000)).unwrap();
        assert_eq!((wrong.generation(), shown(&wrong).taught), (3, 180));
    }
}

#[test]
fn the_first_scan_may_be_the_background() {
    for method in METHODS {
        let mut model =
            Model::new(Settings { method, start: Start::FirstScan, ..Settings::default() }, BEAMS);
        look(&mut model, &scan(361, 1, 3_000), 1);
        assert!(
            model.classes().iter().all(|&class| class == Class::Unknown),
            "compared before it is learned"
        );
        assert_eq!(shown(&model).taught, 361);
        assert_eq!(look(&mut model, &scan(361, 1, 2_000), 1).beams, 361);
        model.reset();
        look(&mut model, &scan(361, 1, 2_000), 1);
        assert_eq!(look(&mut model, &scan(361, 1, 2_000), 1).beams, 0, "after a reset as well");
        assert!(shown(&model).ranges().iter().all(|&range| range == 2_000));
    }
}

/// A wall from which 15 % of the beams come back is learned in 20 s, and nobody who stands there for 5 s, though some beams
/// that meet him are lost.
#[test]
fn a_wall_seldom_seen_is_learned_and_who_stands_there_is_not() {
    let mut random = fastrand::Rng::with_seed(3);
    let mut some = |share: f64, range: u16| {
        let mut scan = scan(361, 1, 8191);
        for value in scan.arrays().ranges {
            *value = if random.f64() < share { range } else { 8191 };
        }
        scan
    };
    let mut model = Model::new(Settings::default(), BEAMS);
    (0..750).for_each(|_| _ = look(&mut model, &some(0.15, 5_000), 1));
    let wall = look(&mut model, &some(1.0, 5_000), 1).beams;
    let before_it = look(&mut model, &some(1.0, 3_000), 1).beams;
    assert!(wall < 10 && before_it == 361, "{wall} beams of the wall, {before_it} before it");

    let mut model = Model::new(Settings::default(), BEAMS);
    look(&mut model, &some(0.0, 0), 600);
    (0..187).for_each(|_| _ = look(&mut model, &some(0.97, 3_000), 1));
    let standing = look(&mut model, &some(1.0, 3_000), 1).beams;
    assert!(standing > 355, "{standing} beams");
}

#[test]
fn no_scan_makes_it_panic() {
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
            let mut model = Model::new(settings, BEAMS);
            let mut cutter = Segmenter::new(Pose { x_m: f64::NAN, y_m: f64::MAX, ..Pose::default() }, BEAMS);
            let mut bytes = [0_u8; Scan::len(BEAMS + 20, 1)];
            for _ in 0..40 {
                // A sensor keeps the shape of its scans for a while, however odd it is.
                let from = if random.u8(..8) == 0 { 0 } else { Scan::HEAD };
                random.fill(&mut bytes[from..]);
                let scan = Scan::of_bytes(&bytes);
                let dirty = || Foreground::of_bytes(&[0xFF; Foreground::len(BEAMS)]);
                let mut out = dirty();
                model.update(&scan, &mut out);
                assert_eq!(model.classes().len(), scan.beams().min(BEAMS));
                assert_eq!(out.readings().count(), usize::from(out.beams));
                cutter.update(&scan, &mut out);
                let mut foreign = dirty();
                foreign.count = BEAMS as u16;
                cutter.update(&scan, &mut foreign);
                let _ = model.load(&Background::of_bytes(&bytes));
                shown(&model);
            }
        }
    }
}
