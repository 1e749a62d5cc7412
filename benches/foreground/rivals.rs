//! What the hub's methods are measured beside: a teach-in that never adapts, and the mixture of Gaussians that computer
//! vision takes for the background of pictures, a mixture per beam. Plain versions in floating point and millimetres.

use schema::Scan;

use super::method::Method;

/// The background is the median of what each beam told in the first [`TEACH_SCANS`] scans, for ever; nearer by more
/// than 30 mm (60 in cm mode) is foreground.
pub(crate) struct TeachIn {
    scans: usize,
    told_mm: Vec<Vec<u32>>,
    background_mm: Vec<Option<u32>>,
}

/// 5 s: nobody is in the room of Fig. 8 before 8 s.
const TEACH_SCANS: usize = 187;

impl TeachIn {
    pub(crate) fn new(beams: usize) -> TeachIn {
        TeachIn { scans: 0, told_mm: vec![Vec::new(); beams], background_mm: vec![None; beams] }
    }
}

impl Method for TeachIn {
    fn update(&mut self, scan: &Scan, foreground: &mut [bool]) {
        self.scans += 1;
        let threshold_mm = if scan.unit_um == 10_000 { 60 } else { 30 };
        for (i, is_foreground) in foreground.iter_mut().enumerate() {
            let reading = scan.distance_mm(i);
            *is_foreground =
                reading.zip(self.background_mm[i]).is_some_and(|(mm, wall_mm)| mm + threshold_mm < wall_mm);
            if self.scans <= TEACH_SCANS {
                self.told_mm[i].extend(reading);
            }
            if self.scans == TEACH_SCANS {
                let told = &mut self.told_mm[i];
                told.sort_unstable();
                self.background_mm[i] = told.get(told.len() / 2).copied();
            }
        }
    }
}

/// The adaptive mixture of Zivkovic (2004), as widely used on pictures: at most five Gaussians a beam, learning rate
/// 1/375 (1/n before), background are the heaviest that together weigh .9; within four standard deviations is
/// background, within three adapts, weights decay by a prior of .05; standard deviation 15 mm at first, 5 to 40 mm
/// later, in cm mode twice as much. Told as foreground is only what is nearer than the heaviest background.
pub(crate) struct Mixtures {
    scans: f64,
    beams: Vec<Vec<Gaussian>>,
}

#[derive(Clone, Copy)]
struct Gaussian {
    weight: f64,
    mean_mm: f64,
    variance: f64,
}

impl Mixtures {
    pub(crate) fn new(beams: usize) -> Mixtures {
        Mixtures { scans: 0.0, beams: vec![Vec::new(); beams] }
    }
}

impl Method for Mixtures {
    fn update(&mut self, scan: &Scan, foreground: &mut [bool]) {
        self.scans += 1.0;
        let rate = (1.0 / self.scans).max(1.0 / 375.0);
        let scale = if scan.unit_um == 10_000 { 2.0 } else { 1.0 };
        for (i, is_foreground) in foreground.iter_mut().enumerate() {
            let Some(mm) = scan.distance_mm(i).map(f64::from) else {
                *is_foreground = false;
                continue;
            };
            let beam = &mut self.beams[i];
            let heaviest_mm = beam.first().map(|gaussian| gaussian.mean_mm);
            let is_background = mix(beam, mm, rate, scale);
            *is_foreground = !is_background && heaviest_mm.is_some_and(|wall_mm| mm < wall_mm);
        }
    }
}

/// Whether a reading is background; then `beam` has learned it.
fn mix(beam: &mut Vec<Gaussian>, mm: f64, rate: f64, scale: f64) -> bool {
    const PRIOR: f64 = 0.05;
    let (mut is_background, mut met, mut before) = (false, false, 0.0);
    for gaussian in beam.iter_mut() {
        let off = mm - gaussian.mean_mm;
        is_background |= before < 0.9 && !met && off * off < 16.0 * gaussian.variance;
        before += gaussian.weight;
        gaussian.weight = (1.0 - rate) * gaussian.weight - rate * PRIOR;
        if !met && off * off < 9.0 * gaussian.variance {
            met = true;
            gaussian.weight += rate;
            let share = rate / gaussian.weight;
            gaussian.mean_mm += share * off;
            let (least, most) = ((5.0 * scale).powi(2), (40.0 * scale).powi(2));
            gaussian.variance =
                (gaussian.variance + share * (off * off - gaussian.variance)).clamp(least, most);
        }
    }
    beam.retain(|gaussian| gaussian.weight > 0.0);
    if !met {
        beam.truncate(4);
        let weight = if beam.is_empty() { 1.0 } else { rate };
        beam.push(Gaussian { weight, mean_mm: mm, variance: (15.0 * scale).powi(2) });
    }
    let total: f64 = beam.iter().map(|gaussian| gaussian.weight).sum();
    beam.iter_mut().for_each(|gaussian| gaussian.weight /= total);
    beam.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    is_background
}
