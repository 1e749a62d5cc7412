//! The paper's background against an independent version of it: slow, in millimetres and floating point, with the
//! whole run of a candidate kept. Identical beam by beam, over many surroundings, with commands in between.

mod surroundings;

use scanhub_preprocess::background::{Candidate, Class, Method, Model, Settings, Start};
use scanhub_schema::{Background, Scan};
use surroundings::{
    BEAMS, Shape, Surroundings, any_choice, any_model, apart_at_most_mm, check_scan, ranges_mm, reading_mm,
};

/// One beam as the paper has it.
#[derive(Clone, Default)]
struct Beam {
    /// 0: not known.
    background_mm: f64,
    /// Readings in a row that belong to one candidate.
    run_mm: Vec<f64>,
}

struct Slow {
    settings: Settings,
    beams: Vec<Beam>,
    frozen: bool,
    fresh: bool,
}

/// Two readings that may be infinite.
fn apart_mm(a: f64, b: f64) -> f64 {
    if a == b { 0.0 } else { (a - b).abs() }
}

impl Slow {
    fn new(settings: Settings, count: u16) -> Slow {
        Slow { settings, beams: vec![Beam::default(); usize::from(count)], frozen: false, fresh: true }
    }

    fn reset(&mut self, count: u16) {
        self.beams = vec![Beam::default(); usize::from(count)];
        self.fresh = true;
    }

    fn load(&mut self, ranges_mm: &[f64]) {
        self.beams = ranges_mm.iter().map(|&mm| Beam { background_mm: mm, run_mm: vec![] }).collect();
        self.fresh = false;
    }

    fn update(&mut self, scan: &Scan) -> Vec<Class> {
        let far = self.settings.no_return_is_far.unwrap_or(false);
        let threshold_mm = apart_at_most_mm(self.settings.threshold_mm, scan);
        let candidate_mm = apart_at_most_mm(self.settings.candidate_mm, scan);
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
                let stands = beam.background_mm != 0.0 && apart_mm(mm, beam.background_mm) <= threshold_mm;
                if stands {
                    beam.run_mm.clear();
                } else {
                    let candidate = match self.settings.candidate {
                        Candidate::First => beam.run_mm.first(),
                        Candidate::Latest => beam.run_mm.last(),
                    };
                    if candidate.is_some_and(|&candidate| apart_mm(mm, candidate) > candidate_mm) {
                        beam.run_mm.clear();
                    }
                    beam.run_mm.push(mm);
                    if beam.run_mm.len() as f64 >= scans {
                        *beam = Beam { background_mm: mm, run_mm: vec![] };
                    }
                }
                if self.fresh && self.settings.start == Start::FirstScan && mm != 0.0 {
                    *beam = Beam { background_mm: mm, run_mm: vec![] };
                }
                if self.frozen {
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
        self.fresh &= self.frozen;
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
fn identical_beam_by_beam() {
    let mut seen = [0_u64; 5];
    let mut adopted = 0_u64;
    for seed in 0..16 {
        let mut random = fastrand::Rng::with_seed(seed);
        let settings = any_settings(&mut random);
        let mut surroundings = Surroundings::new(Shape::any(&mut random), seed);
        let mut model = Model::new(settings, BEAMS);
        let mut slow = Slow::new(settings, surroundings.shape.count);
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
                    surroundings = Surroundings::new(other, seed);
                    if !same {
                        slow.reset(other.count);
                        generation += 1;
                    }
                }
                3 => {
                    model.freeze();
                    slow.frozen = true;
                }
                4..8 => {
                    model.thaw();
                    slow.frozen = false;
                }
                _ => {}
            }
            let scan = surroundings.next();
            let classes = slow.update(&scan);
            let dirt = random.u8(..);
            let place = &format_args!("seed {seed}, scan {number}, {settings:?}");
            check_scan(&mut model, &scan, &classes, generation, dirt, place);
            classes.iter().for_each(|&class| seen[class as usize] += 1);
        }
        let mut shown = Background::zeroed(Background::len(BEAMS));
        model.show(&mut shown);
        assert_eq!(ranges_mm(&shown), slow.beams.iter().map(|b| b.background_mm).collect::<Vec<_>>());
        assert_eq!((shown.generation, shown.is_frozen()), (generation, slow.frozen));
        assert_eq!(usize::from(shown.taught), shown.ranges().iter().filter(|&&r| r != 0).count());
        adopted += u64::from(shown.taught);
    }
    assert!(seen.iter().all(|&n| n > 10_000) && adopted > 2_000, "{seen:?}, {adopted}: nothing was tried");
}
