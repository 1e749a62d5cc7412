//! The background with several surfaces a beam against a slow version of its rules, in floating point, without tables
//! and memory of its own but lists. Identical beam by beam, with commands in between.

mod surroundings;

use scanhub_preprocess::background::{Class, Method, Model, Settings, Start};
use scanhub_schema::{Background, Scan};
use surroundings::{
    BEAMS, Shape, Surroundings, any_choice, any_model, apart_at_most_mm, check_scan, ranges_mm, reading_mm,
    unit_mm,
};

/// A surface as a beam remembers it.
#[derive(Clone, Copy, Debug)]
struct Surface {
    /// In device units.
    at: f64,
    /// In scans.
    weight: f64,
}

impl Surface {
    fn is_background(&self, scans: f64) -> bool {
        self.weight >= scans * 5.0 / 8.0
    }
}

/// What is far, in device units.
const FAR: f64 = 1e9;
const NOTHING: Surface = Surface { at: -FAR, weight: 0.0 };

struct Slow {
    settings: Settings,
    beams: Vec<[Surface; 3]>,
    /// Times in a row that each beam, whenever it told anything, told that nothing came back.
    lost: Vec<u32>,
    /// Foreground beams of the last scan with their readings: those that were seen, those that were told.
    seen: Vec<(usize, f64)>,
    told: Vec<(usize, f64)>,
    frozen: bool,
    fresh: bool,
    /// Scans that are set, for the last scan.
    scans: f64,
}

impl Slow {
    fn new(settings: Settings, count: u16) -> Slow {
        let beams = vec![[NOTHING; 3]; usize::from(count)];
        let lost = vec![0; usize::from(count)];
        Slow { settings, beams, lost, seen: vec![], told: vec![], frozen: false, fresh: true, scans: 0.0 }
    }

    fn reset(&mut self, count: u16) {
        *self = Slow { frozen: self.frozen, scans: self.scans, ..Slow::new(self.settings, count) };
    }

    fn load(&mut self, model: &Background) {
        self.reset(model.count);
        let far = |mm: f64| if mm.is_infinite() { FAR } else { mm / unit_mm(model.unit_um) };
        ranges_mm(model).into_iter().enumerate().for_each(|(i, mm)| self.adopt(i, far(mm)));
        self.fresh = false;
    }

    fn adopt(&mut self, i: usize, at: f64) {
        if at != 0.0 {
            self.beams[i] = [Surface { at, weight: f64::INFINITY }, NOTHING, NOTHING];
        }
    }

    fn nearest(&self, i: usize, scans: f64) -> Option<f64> {
        let known = self.beams[i].iter().filter(|surface| surface.is_background(scans));
        known.map(|surface| surface.at).min_by(f64::total_cmp)
    }

    fn update(&mut self, scan: &Scan) -> Vec<Class> {
        let unit_mm = unit_mm(scan.unit_um);
        let far = self.settings.no_return_is_far.unwrap_or(true);
        let threshold = (apart_at_most_mm(self.settings.threshold_mm, scan) / unit_mm).floor();
        let scans = (750.0 * (1000.0 * scan.step.to_degrees()).round() / 1000.0).ceil();
        let scans = self.settings.scans.map_or(scans, f64::from);
        self.scans = scans;
        let readings: Vec<Option<f64>> =
            (0..self.beams.len()).map(|i| Some((reading_mm(scan, i, far)? / unit_mm).min(FAR))).collect();
        let mut classes: Vec<Class> =
            (0..readings.len()).map(|i| self.class(i, readings[i], threshold, scans)).collect();
        self.believe(&mut classes, &readings, unit_mm, (1000.0 * scan.step.to_degrees()).round());
        if !self.frozen {
            for (i, reading) in readings.iter().enumerate() {
                let Some(reading) = *reading else { continue };
                let lost = if reading == FAR { 0 } else { std::mem::take(&mut self.lost[i]) };
                self.lost[i] += u32::from(reading == FAR);
                let gain = f64::from(lost + 1).min((scans / 16.0).floor().clamp(1.0, 16.0));
                learn(&mut self.beams[i], reading, gain, threshold, scans);
                if self.fresh && self.settings.start == Start::FirstScan {
                    self.adopt(i, reading);
                }
            }
            self.fresh = false;
        }
        classes
    }

    fn class(&self, i: usize, reading: Option<f64>, threshold: f64, scans: f64) -> Class {
        let Some(reading) = reading else { return Class::Invalid };
        let meets = |surface: &&Surface| (surface.at - reading).abs() <= threshold;
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

    /// Strikes out what is not believed.
    fn believe(&mut self, classes: &mut [Class], readings: &[Option<f64>], unit_mm: f64, step_mdeg: f64) {
        let seen: Vec<(usize, f64)> = (0..classes.len())
            .filter(|&i| classes[i] == Class::Foreground)
            .map(|i| (i, readings[i].expect("only readings are in the foreground")))
            .collect();
        let mut told = Vec::new();
        // Two belong to one run if there is nothing but codes between them.
        let codes = |from: usize, to: usize| (from + 1..to).all(|i| readings[i].is_none());
        for run in seen.chunk_by(|a, b| codes(a.0, b.0)) {
            let (first, last) = (run[0].0, run[run.len() - 1].0);
            let nearest = run.iter().map(|beam| beam.1).fold(FAR, f64::min);
            let there = |before: &[(usize, f64)]| {
                before.iter().any(|&(i, range)| {
                    i + 1 >= first && i <= last + 1 && (range - nearest).abs() * unit_mm <= 200.0
                })
            };
            let beam_mm = nearest * unit_mm * step_mdeg / 57_296.0;
            let leg = (135.0 / beam_mm).floor().clamp(1.0, 3.0);
            let is_believed =
                run.len() >= 3 || there(&self.told) || run.len() as f64 >= leg && there(&self.seen);
            match is_believed {
                true => told.extend_from_slice(run),
                false => run.iter().for_each(|&(i, _)| classes[i] = Class::Unknown),
            }
        }
        (self.seen, self.told) = (seen, told);
    }
}

fn learn(surfaces: &mut [Surface; 3], reading: f64, gain: f64, threshold: f64, scans: f64) {
    surfaces.iter_mut().for_each(|surface| surface.weight = surface.weight.min(scans));
    let apart = |number: &usize| (surfaces[*number].at - reading).abs();
    let met = (0..3).filter(|number| apart(number) <= threshold).min_by(|a, b| apart(a).total_cmp(&apart(b)));
    for (number, surface) in surfaces.iter_mut().enumerate() {
        if Some(number) == met {
            surface.weight = (surface.weight + gain).min(scans);
            surface.at += ((reading - surface.at) / 16.0).trunc();
        } else {
            let leak = if reading > surface.at { 0.5 } else { 0.125 };
            surface.weight = (surface.weight - leak).max(0.0);
            if surface.weight == 0.0 {
                *surface = NOTHING;
            }
        }
    }
    let least = (0..3).min_by(|&a, &b| surfaces[a].weight.total_cmp(&surfaces[b].weight)).expect("three");
    if met.is_none() && surfaces[least].weight < scans / 4.0 {
        surfaces[least] = Surface { at: reading, weight: gain };
    }
}

#[test]
fn identical_beam_by_beam() {
    let mut seen = [0_u64; 5];
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
                    slow.load(&saved);
                    generation += 1;
                }
                2 => {
                    model.freeze();
                    slow.frozen = true;
                }
                3..7 => {
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
        for (i, &range) in shown.ranges().iter().enumerate() {
            let known: Vec<f64> =
                slow.beams[i].iter().filter(|s| s.is_background(slow.scans)).map(|s| s.at).collect();
            let at = if range == Background::FAR { FAR } else { f64::from(range) };
            // A surface at 0 looks like none.
            assert!(known.contains(&at) || range == 0 && known.is_empty(), "beam {i}: {range}, {known:?}");
        }
    }
    assert!(seen.iter().all(|&n| n > 10_000), "{seen:?}: nothing was tried");
}
