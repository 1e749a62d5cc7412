//! Separation of people from the background. Two methods of the hub and two simple methods are compared, in scenes of
//! the simulated world in which the correct answer for each beam is known.
//!
//! A beam counts as foreground if its whole spot meets a person. A beam that is reported as foreground is wrong in
//! three cases. First, it meets an object that has always been in the scene. Second, it meets the surface behind an
//! object that was taken away. Third, it meets an object that was put down or moved more than 20 s ago. Some beams do
//! not count: beams that graze a person or a moved object, beams without a reading, and beams that meet an object that
//! was put down or moved in the last 20 s.
//!
//! Recall is the share of the foreground beams that are found. Precision is the share of the reported beams that are
//! right. The number of wrong beams is an average per scan, over all 2000 scans including the first ones.
//!
//! If a person stands in the room at the start, all methods learn this person as background, and find the person only
//! after they move. The people of the scene with a crowd are also present from the start. A person behind a door that
//! has just opened is farther away than the door was, so no method finds this person either. Bytes are those of
//! payloads on a network, where an empty foreground has 58 bytes. In the room of Fig. 8, a person is present for 40 %
//! of the time.

use std::ops::Range;

use scanhub_drivers::lms::variant::{Unit, Variant};
use scanhub_preprocess::background::{BackgroundModel, Method as Kind, Settings, Start};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::{Foreground, Pose, Scan};

use crate::figures::{self, Cell, Figure, Target};
use crate::scenes::{Boxes, Detector, HubDetector, LabeledScan, Scene, Score, play};

const SCENES: [Scene; 11] = [
    Scene { name: "Fig. 8", world: "fig8", unit: Unit::Mm, mixed: true },
    Scene { name: "Fig. 8, no mixed pixels", world: "fig8", unit: Unit::Mm, mixed: false },
    Scene { name: "corridor, in cm", world: "corridor", unit: Unit::Cm, mixed: true },
    Scene { name: "a person walks up to the sensor", world: "approach", unit: Unit::Mm, mixed: true },
    Scene { name: "a person stands there first", world: "standing", unit: Unit::Mm, mixed: true },
    Scene { name: "a door opens", world: "door", unit: Unit::Mm, mixed: true },
    Scene { name: "a chair is moved", world: "chair", unit: Unit::Mm, mixed: true },
    Scene { name: "a glass wall", world: "glass", unit: Unit::Mm, mixed: true },
    Scene { name: "a wall with few readings", world: "faint", unit: Unit::Mm, mixed: true },
    Scene { name: "sun", world: "sun", unit: Unit::Mm, mixed: true },
    Scene { name: "a crowd", world: "crowd", unit: Unit::Mm, mixed: true },
];

/// Targets of the method `multi`. Each entry has the name of the figure, the row, the table and the target.
const TARGETS: [(&str, &str, &str, Target); 11] = [
    ("recall in Fig. 8", "Fig. 8", RECALL_TABLE, Target::Min(0.99)),
    ("precision in Fig. 8", "Fig. 8", PRECISION_TABLE, Target::Min(0.95)),
    ("wrong beams a scan in Fig. 8", "Fig. 8", WRONG_TABLE, Target::Max(0.2)),
    ("recall in a corridor", "corridor, in cm", RECALL_TABLE, Target::Min(0.95)),
    ("wrong beams a scan in a corridor", "corridor, in cm", WRONG_TABLE, Target::Max(0.4)),
    ("recall at the sensor", "a person walks up to the sensor", RECALL_TABLE, Target::Min(0.95)),
    ("wrong beams a scan at the sensor", "a person walks up to the sensor", WRONG_TABLE, Target::Max(0.4)),
    (
        "precision before a wall with few readings",
        "a wall with few readings",
        PRECISION_TABLE,
        Target::Min(0.9),
    ),
    (
        "wrong beams a scan before a wall with few readings",
        "a wall with few readings",
        WRONG_TABLE,
        Target::Max(0.25),
    ),
    ("percent of a box new after N", NEW_ROW, BOX_TABLE, Target::Max(0.0)),
    ("percent of a box left after 2N", LEFT_ROW, BOX_TABLE, Target::Max(0.0)),
];
const BOX_TABLE: &str = "of a box in Fig. 8";
const NEW_ROW: &str = "put down: new after N scans";
const LEFT_ROW: &str = "taken away: left after 2N";
const RECALL_TABLE: &str = "recall";
const PRECISION_TABLE: &str = "precision";
const WRONG_TABLE: &str = "wrong beams a scan";

const METHODS: [&str; 5] = ["multi", "paper", "paper, first scan", "teach-in", "mixtures (MOG2)"];

fn settings(name: &str) -> Option<Settings> {
    let paper = Settings { method: Kind::Paper, ..Settings::default() };
    match name {
        "multi" => Some(Settings { method: Kind::Multi, ..Settings::default() }),
        "paper" => Some(paper),
        "paper, first scan" => Some(Settings { start: Start::FirstScan, ..paper }),
        _ => None,
    }
}

fn method(name: &str) -> Box<dyn Detector> {
    match settings(name) {
        Some(settings) => Box::new(HubDetector::new(settings)),
        None if name == "teach-in" => Box::new(TeachIn::new(Variant::HALF.beams())),
        None => Box::new(Mixtures::new(Variant::HALF.beams())),
    }
}

/// Measures the methods in all scenes with these `seeds`.
pub(crate) fn measure(seeds: Range<u64>, is_json: bool) {
    let mut boxes = [Boxes::default(); METHODS.len()];
    let mut bytes = [PayloadBytes::default(); METHODS.len()];
    let mut cells = Vec::new();
    for (number, scene) in SCENES.iter().enumerate() {
        let mut scores = [Score::default(); METHODS.len()];
        for seed in seeds.clone() {
            let run = play(scene, seed);
            for (m, name) in METHODS.into_iter().enumerate() {
                scores[m] += Score::of(&mut *method(name), &run);
                if number == 0 {
                    boxes[m].add(|| method(name), &run);
                    if let Some(settings) = settings(name) {
                        bytes[m].add(settings, &run);
                    }
                }
            }
        }
        cells.extend(METHODS.iter().zip(&scores).flat_map(|(name, score)| scored(scene, name, score)));
    }
    // Sort the cells by table. There is one table for each quantity, but the cells were computed scene by scene.
    cells.sort_by_key(|cell| {
        [RECALL_TABLE, PRECISION_TABLE, WRONG_TABLE].iter().position(|table| cell.table == *table)
    });
    for (name, boxes) in METHODS.iter().zip(&boxes) {
        let rows = [NEW_ROW, "taken away: left after N", LEFT_ROW];
        let values = rows.into_iter().zip(boxes.percents());
        cells.extend(values.map(|(row, percent)| cell(BOX_TABLE, row, name, "%", percent)));
    }
    for (name, bytes) in METHODS.iter().zip(&bytes).filter(|(name, _)| settings(name).is_some()) {
        let rows = ["scans", "foreground", "foreground when empty"];
        let values = rows.into_iter().zip(bytes.per_second());
        cells.extend(values.map(|(row, bytes)| cell("payloads in Fig. 8", row, name, "B/s", bytes)));
    }
    let value = |table: &str, row: &str| {
        let is_it = |cell: &&Cell| cell.table == table && cell.row == row && cell.column == METHODS[0];
        cells.iter().find(is_it).map_or(Vec::new(), |cell| cell.values.clone())
    };
    let figure = |name, hub, target| Figure { name, unit: "1", hub, baseline: Vec::new(), target };
    let mut figures =
        Vec::from(TARGETS.map(|(name, row, table, target)| figure(name, value(table, row), target)));
    let [scans, foreground, _] = bytes[0].per_second();
    figures.push(figure("bytes of scans for one of foreground", vec![scans / foreground], Target::Min(10.0)));
    figures::print("perception, foreground", is_json, &figures);
    figures::print_cells("perception, foreground", is_json, &cells);
}

fn scored(scene: &Scene, method: &str, score: &Score) -> [Cell; 3] {
    [
        (RECALL_TABLE, score.recall()),
        (PRECISION_TABLE, score.precision()),
        (WRONG_TABLE, score.wrong_per_scan()),
    ]
    .map(|(table, value)| cell(table, scene.name, method, "1", value))
}

fn cell(table: &str, row: &str, method: &str, unit: &'static str, value: f64) -> Cell {
    // If a scene has no person or no reported beam, the share is not a number.
    let values = if value.is_finite() { vec![value] } else { Vec::new() };
    Cell { table: table.into(), row: row.into(), column: method.into(), unit, values }
}

/// Bytes of the payloads of several runs, without headers.
#[derive(Clone, Copy, Debug, Default)]
struct PayloadBytes {
    scans: u64,
    scan: u64,
    foreground: u64,
    /// Number of scans whose foreground is empty, and bytes of the foreground payloads of these scans.
    empty: (u64, u64),
}

impl PayloadBytes {
    /// Adds a run of a scene, processed by the method in `settings`.
    fn add(&mut self, settings: Settings, run: &[LabeledScan]) {
        let beams = Variant::HALF.beams();
        let mut model = BackgroundModel::new(settings, beams);
        let mut cutter = Segmenter::new(Pose::default(), beams);
        let mut out = Foreground::of(beams);
        for frame in run {
            model.update(&frame.scan, &mut out);
            cutter.update(&frame.scan, &mut out);
            let foreground =
                Foreground::HEAD + beams.div_ceil(8) + 2 * out.ranges().len() + 16 * out.segments().len();
            self.scans += 1;
            self.scan += Scan::len(beams, 0) as u64;
            self.foreground += foreground as u64;
            if out.beams == 0 {
                self.empty = (self.empty.0 + 1, self.empty.1 + foreground as u64);
            }
        }
    }

    /// Returns three rates in bytes per second at 37.5 scans per second: for scans, for the foreground, and for an
    /// empty foreground.
    fn per_second(&self) -> [f64; 3] {
        let per_second = |bytes: u64, scans: u64| bytes as f64 / scans as f64 * 1e3 / 26.64;
        [
            per_second(self.scan, self.scans),
            per_second(self.foreground, self.scans),
            per_second(self.empty.1, self.empty.0),
        ]
    }
}

/// A method that learns only at the start. The background of a beam is the median of its readings in the first
/// [`LEARNING_SCANS`] scans. A reading is foreground if it is nearer than the background by more than 30 mm (60 mm for
/// a scanner that measures in centimeters).
struct TeachIn {
    scans: usize,
    readings_mm: Vec<Vec<u32>>,
    background_mm: Vec<Option<u32>>,
}

/// Number of scans from which the background is learned. 187 scans take 5 s. The room of Fig. 8 is empty for the first
/// 8 s.
const LEARNING_SCANS: usize = 187;

impl TeachIn {
    fn new(beams: usize) -> TeachIn {
        TeachIn { scans: 0, readings_mm: vec![Vec::new(); beams], background_mm: vec![None; beams] }
    }
}

impl Detector for TeachIn {
    fn update(&mut self, scan: &Scan, foreground: &mut [bool]) {
        self.scans += 1;
        let threshold_mm = if scan.unit_um == 10_000 { 60 } else { 30 };
        for (i, is_foreground) in foreground.iter_mut().enumerate() {
            let reading = scan.distance_mm(i);
            *is_foreground =
                reading.zip(self.background_mm[i]).is_some_and(|(mm, wall_mm)| mm + threshold_mm < wall_mm);
            if self.scans <= LEARNING_SCANS {
                self.readings_mm[i].extend(reading);
            }
            if self.scans == LEARNING_SCANS {
                let readings = &mut self.readings_mm[i];
                readings.sort_unstable();
                self.background_mm[i] = readings.get(readings.len() / 2).copied();
            }
        }
    }
}

/// The adaptive Gaussian mixture of Zivkovic (ICPR 2004), which computer vision uses for the background of images, with
/// one mixture for each beam. There are at most five Gaussians, and the learning rate is 1/375 (1/n at first). The
/// heaviest Gaussians whose weights sum to .9 are background. A reading within four standard deviations of such a
/// Gaussian is background. A reading within three standard deviations of a Gaussian adapts this Gaussian. Weights decay
/// by a prior of .05. The standard deviation starts at 15 mm and stays between 5 and 40 mm, or twice as much for a
/// scanner that measures in centimeters. Only readings that are nearer than the heaviest Gaussian count as foreground.
struct Mixtures {
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
    fn new(beams: usize) -> Mixtures {
        Mixtures { scans: 0.0, beams: vec![Vec::new(); beams] }
    }
}

impl Detector for Mixtures {
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

/// Updates `beam` with a reading, and returns whether the reading is background.
fn mix(beam: &mut Vec<Gaussian>, mm: f64, rate: f64, scale: f64) -> bool {
    const WEIGHT_DECAY: f64 = 0.05;
    let (mut is_background, mut is_matched, mut before) = (false, false, 0.0);
    for gaussian in beam.iter_mut() {
        let off = mm - gaussian.mean_mm;
        is_background |= before < 0.9 && !is_matched && off * off < 16.0 * gaussian.variance;
        before += gaussian.weight;
        gaussian.weight = (1.0 - rate) * gaussian.weight - rate * WEIGHT_DECAY;
        if !is_matched && off * off < 9.0 * gaussian.variance {
            is_matched = true;
            gaussian.weight += rate;
            let share = rate / gaussian.weight;
            gaussian.mean_mm += share * off;
            let (minimum, maximum) = ((5.0 * scale).powi(2), (40.0 * scale).powi(2));
            gaussian.variance =
                (gaussian.variance + share * (off * off - gaussian.variance)).clamp(minimum, maximum);
        }
    }
    beam.retain(|gaussian| gaussian.weight > 0.0);
    if !is_matched {
        beam.truncate(4);
        let weight = if beam.is_empty() { 1.0 } else { rate };
        beam.push(Gaussian { weight, mean_mm: mm, variance: (15.0 * scale).powi(2) });
    }
    let total: f64 = beam.iter().map(|gaussian| gaussian.weight).sum();
    beam.iter_mut().for_each(|gaussian| gaussian.weight /= total);
    beam.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    is_background
}
