//! Scenes of the simulated world in which the correct answer for each beam is known, and scores of the methods that
//! separate foreground from background. `benches/perception` measures ten runs of each scene, and
//! `tests/it/foreground.rs` measures one.

#[path = "decoded_scan.rs"]
mod decoded_scan;

use std::ops::AddAssign;

use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{Unit, Variant};
use scanhub_preprocess::background::{BackgroundModel, Class, Settings};
use scanhub_schema::{Foreground, Scan};
use scanhub_sim::room::BeamTarget;
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

/// A scene of the simulated world. It has 2000 scans, which take 53 s.
#[derive(Clone, Copy)]
pub(crate) struct Scene {
    /// Name of the scene in tables.
    pub(crate) name: &'static str,
    /// Name of the simulated world.
    pub(crate) world: &'static str,
    pub(crate) unit: Unit,
    /// Whether beams are as wide as real ones. At an edge, a wide beam measures one surface, the other surface, or a
    /// range between them.
    pub(crate) mixed: bool,
}

const SCANS: u64 = 2_000;

/// Correct answer for a beam.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ExpectedAnswer {
    /// Foreground: the beam meets a person.
    Foreground,
    /// Not foreground: the beam meets a surface that existed from the start, a surface that became visible when an
    /// object was removed, or an object that was put down or moved more than [`OLD_AGE_S`] ago.
    Other,
    /// An object that was put down, moved or opened recently. It is foreground until the method has learned it. The
    /// methods take different times to learn it, so both answers are right.
    New,
    /// Not counted, because the beam grazes a leg or has no reading.
    Neither,
}

/// Age in seconds from which an object is background: twice the longest time that the paper's method takes.
const OLD_AGE_S: f64 = 20.0;

/// One scan with the correct answer and the target of each beam.
pub(crate) struct LabeledScan {
    pub(crate) scan: Box<Scan>,
    pub(crate) expected: Vec<ExpectedAnswer>,
    pub(crate) targets: Vec<BeamTarget>,
}

/// Simulates `scene` with random numbers from `seed`, and returns its scans.
pub(crate) fn play(scene: &Scene, seed: u64) -> Vec<LabeledScan> {
    let world: World = scene.world.parse().expect("the name of a built-in world");
    let mut layers = world.noise().expect("a world with noise");
    layers.spot &= scene.mixed;
    let room = Room::new(&world.with_noise(layers), seed);
    (1..=SCANS).map(|number| frame(&room, scene.unit, number)).collect()
}

fn frame(room: &Room, unit: Unit, number: u64) -> LabeledScan {
    let end_ns = number * Variant::HALF.revolutions() * lms::variant::MIRROR_PERIOD;
    let look = room.labeled_scan(Variant::HALF, unit, decoded_scan::MODE, end_ns);
    let scan = decoded_scan::scan(&look.words, unit);
    let expected = (0..look.truth.len()).map(|i| expected_answer(&scan, i, look.truth[i], end_ns)).collect();
    LabeledScan { scan, expected, targets: look.truth }
}

fn expected_answer(scan: &Scan, i: usize, target: BeamTarget, end_ns: u64) -> ExpectedAnswer {
    match target {
        _ if scan.range(i).is_none() => ExpectedAnswer::Neither,
        BeamTarget::Person => ExpectedAnswer::Foreground,
        BeamTarget::Box { since_ns } if end_ns.saturating_sub(since_ns) as f64 <= OLD_AGE_S * 1e9 => {
            ExpectedAnswer::New
        }
        BeamTarget::Static { .. } | BeamTarget::Box { .. } => ExpectedAnswer::Other,
        BeamTarget::Grazed | BeamTarget::Invalid => ExpectedAnswer::Neither,
    }
}

/// Method that separates foreground from background, scan by scan.
pub(crate) trait Detector {
    /// Processes the next scan, and writes to `foreground` for each beam whether it is foreground.
    fn update(&mut self, scan: &Scan, foreground: &mut [bool]);
}

/// The hub's method.
pub(crate) struct HubDetector {
    model: BackgroundModel,
    out: Box<Foreground>,
}

impl HubDetector {
    /// Creates the method with an empty background.
    pub(crate) fn new(settings: Settings) -> HubDetector {
        let beams = Variant::HALF.beams();
        HubDetector { model: BackgroundModel::new(settings, beams), out: Foreground::of(beams) }
    }
}

impl Detector for HubDetector {
    fn update(&mut self, scan: &Scan, foreground: &mut [bool]) {
        self.model.update(scan, &mut self.out);
        for (is_foreground, class) in foreground.iter_mut().zip(self.model.classes()) {
            *is_foreground = *class == Class::Foreground;
        }
    }
}

/// Numbers of beams, counted by the correct answer and by the answer of the method.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Score {
    scans: u64,
    found: u64,
    missed: u64,
    wrong: u64,
}

impl Score {
    /// Runs `method` on `frames` in order, and counts its answers.
    pub(crate) fn of(method: &mut dyn Detector, frames: &[LabeledScan]) -> Score {
        let mut score = Score { scans: frames.len() as u64, ..Score::default() };
        let mut foreground = vec![false; frames.first().map_or(0, |frame| frame.expected.len())];
        for frame in frames {
            method.update(&frame.scan, &mut foreground);
            for (expected, &is_reported) in frame.expected.iter().zip(&foreground) {
                match (expected, is_reported) {
                    (ExpectedAnswer::Foreground, true) => score.found += 1,
                    (ExpectedAnswer::Foreground, false) => score.missed += 1,
                    (ExpectedAnswer::Other, true) => score.wrong += 1,
                    _ => {}
                }
            }
        }
        score
    }

    /// Returns the fraction of the foreground beams that were found.
    pub(crate) fn recall(&self) -> f64 {
        self.found as f64 / (self.found + self.missed) as f64
    }

    /// Returns the fraction of the beams reported as foreground that are foreground.
    pub(crate) fn precision(&self) -> f64 {
        self.found as f64 / (self.found + self.wrong) as f64
    }

    /// Returns the number of beams per scan that were reported as foreground but are not.
    pub(crate) fn wrong_per_scan(&self) -> f64 {
        self.wrong as f64 / self.scans as f64
    }
}

impl AddAssign for Score {
    fn add_assign(&mut self, other: Score) {
        self.scans += other.scans;
        self.found += other.found;
        self.missed += other.missed;
        self.wrong += other.wrong;
    }
}

/// Number of scans after which a new surface becomes background, which is the hub's default for 361 beams.
const LEARNING_SCANS: usize = 375;

/// Answers for the beams of two boxes in the room of Fig. 8, over several runs. Box 1 is put down, and box 2 is taken
/// away. In the docs of the fields, N is [`LEARNING_SCANS`].
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Boxes {
    /// Beams that meet box 1, N scans after the box was put down, and how many of these beams are still foreground.
    new_box: Share,
    /// Beams that met box 2 before it was taken away, and how many of these beams would not be foreground if the box
    /// were put back. The first entry is N scans after the box was taken away, the second one 2N scans.
    removed_box: [Share; 2],
}

/// Number of beams, and number of those that have a property.
#[derive(Clone, Copy, Debug, Default)]
struct Share {
    total: u64,
    matching: u64,
}

impl Share {
    fn count(&mut self, is_matching: bool) {
        self.total += 1;
        self.matching += u64::from(is_matching);
    }

    fn percent(&self) -> f64 {
        100.0 * self.matching as f64 / self.total as f64
    }
}

impl Boxes {
    /// Adds the answers of a new method for `frames`, which are one run. `make` creates the method with an empty
    /// background.
    pub(crate) fn add(&mut self, make: impl Fn() -> Box<dyn Detector>, frames: &[LabeledScan]) {
        let first = |is: fn(&BeamTarget) -> bool| {
            frames
                .iter()
                .position(|frame| frame.targets.iter().any(is))
                .expect("boxes are put down and removed in this room")
        };
        let at = first(is_new) + LEARNING_SCANS;
        let answers = answers(&mut *make(), &frames[..at], &frames[at].scan);
        for (i, _) in frames[at].targets.iter().enumerate().filter(|(_, target)| is_new(target)) {
            self.new_box.count(answers[i]);
        }

        let taken = first(is_where_object_was_removed);
        let stood = &frames[taken - 1];
        for (removed_box, at) in
            self.removed_box.iter_mut().zip([taken + LEARNING_SCANS, taken + 2 * LEARNING_SCANS])
        {
            let now = &frames[at];
            // Beams at the edges of the box may have measured the surface behind it.
            let inside = |i: &usize| now.targets[i - 1..=i + 1].iter().all(is_where_object_was_removed);
            let beams: Vec<usize> = (1..stood.targets.len() - 1).filter(inside).collect();
            let mut scan = now.scan.clone();
            let span = beams[0]..=beams[beams.len() - 1];
            scan.arrays().ranges[span.clone()].copy_from_slice(&stood.scan.ranges()[span]);
            let answers = self::answers(&mut *make(), &frames[..at], &scan);
            let met_box = beams.into_iter().filter(|&i| is_still(&stood.targets[i]));
            met_box.for_each(|i| removed_box.count(!answers[i]));
        }
    }

    /// Returns three percentages. The first one is the share of the beams of box 1 that is foreground N scans after the
    /// box was put down. The other two are the shares of the beams of box 2 that are background N and 2N scans after
    /// the box was taken away.
    pub(crate) fn percents(&self) -> [f64; 3] {
        [self.new_box.percent(), self.removed_box[0].percent(), self.removed_box[1].percent()]
    }
}

fn is_new(target: &BeamTarget) -> bool {
    matches!(target, BeamTarget::Box { .. })
}

/// Returns whether the beam meets a surface from which an object was taken away.
fn is_where_object_was_removed(target: &BeamTarget) -> bool {
    matches!(target, BeamTarget::Static { since_ns: 1.. })
}

fn is_still(target: &BeamTarget) -> bool {
    matches!(target, BeamTarget::Static { since_ns: 0 })
}

/// Runs `method` on `before` and `scan`, and returns its answers for `scan`.
fn answers(method: &mut dyn Detector, before: &[LabeledScan], scan: &Scan) -> Vec<bool> {
    let mut foreground = vec![false; scan.beams()];
    before.iter().for_each(|frame| method.update(&frame.scan, &mut foreground));
    method.update(scan, &mut foreground);
    foreground
}
