//! Lines, motion and the map around a robot when its scans are not what they should be: somebody lifts the platform, most
//! beams do not return, the clock jumps. Nothing may panic, and nothing may be told that is surer than it is.

mod drives;

use drives::Drive;
use fastrand::Rng;
use scanhub_preprocess::background::{Candidate, Class, Method, Model, Settings, Start};
use scanhub_preprocess::lines::{self, LineFinder};
use scanhub_preprocess::motion::{self, MotionEstimator, Rigid};
use scanhub_schema::{Foreground, Lines, Motion, MotionMethod, Pose, Scan};

const MAP: Settings = Settings {
    method: Method::Moving,
    threshold_mm: None,
    candidate_mm: None,
    // Ten seconds of an LMS; else they are counted by how long a scan takes.
    scans: Some(375),
    candidate: Candidate::First,
    start: Start::Empty,
    no_return_is_far: None,
};

/// What is said of a scan.
#[derive(PartialEq)]
struct Said {
    lines: Lines,
    motion: Motion,
    classes: Vec<Class>,
    foreground: usize,
}

/// All that is said, one after the other as in the hub.
fn follow(scans: &[Box<Scan>]) -> Vec<Said> {
    let beams = scans.iter().map(|scan| scan.beams()).max().unwrap_or(0);
    let mut finder = LineFinder::new(Pose::default(), lines::Settings::default(), beams);
    let mut estimator = MotionEstimator::new(Pose::default(), motion::Settings::default(), beams);
    let mut model = Model::new(MAP, beams);
    let mut out = Foreground::of(beams);
    let say = |(number, scan): (usize, &Scan)| {
        let (mut lines, mut motion) = (Lines::default(), Motion::default());
        finder.update(scan, &mut lines);
        estimator.update(scan, drives::stamp_ns(number), 0, &mut motion);
        model.follow(&Pose::default(), &motion, &estimator.velocity());
        model.update(scan, &mut out);
        let classes = model.classes().to_vec();
        Said { lines, motion, classes, foreground: usize::from(out.beams) }
    };
    scans.iter().map(|scan| &**scan).enumerate().map(say).collect()
}

/// The worst of the step's three numbers: its error in deviations that are said of it.
fn deviations(truth: &Rigid, motion: &Motion) -> f64 {
    let off = [
        f64::from(motion.dx_m) - truth.x,
        f64::from(motion.dy_m) - truth.y,
        f64::from(motion.dyaw_rad) - truth.yaw,
    ];
    let of = |(k, off): (usize, f64)| off.abs() / f64::from(motion.covariance[4 * k]).sqrt();
    off.into_iter().enumerate().map(of).fold(0.0, f64::max)
}

/// Each range as `change` says of it and its beam.
fn changed(scan: &mut Scan, mut change: impl FnMut(usize, f64) -> f64) {
    let valid_to = scan.valid_to;
    for (i, range) in scan.arrays().ranges.iter_mut().enumerate().filter(|(_, range)| **range <= valid_to) {
        *range = change(i, f64::from(*range)).clamp(1.0, valid_to.into()) as u16;
    }
}

/// Higher up a sensor sees other things at other ranges; tilted, less on the one side and more on the other.
#[test]
fn who_is_lifted_is_refused_or_unsure() {
    for seed in 0..6 {
        for factor in [0.5, 0.8, 0.95, 1.05, 1.2, 1.6] {
            for tilt in [0.0, 0.4] {
                let mut drive = Drive::through_a_room(seed, 361, 1, 0.01);
                drive.stand(59);
                for scan in &mut drive.scans[20..30] {
                    changed(scan, |i, range| range * (factor + tilt * (i as f64 / 360.0 - 0.5)));
                }
                let said = follow(&drive.scans);
                let place = format!("seed {seed}, {factor} as far, tilt {tilt}");
                for (at, said) in said.iter().enumerate().skip(1).filter(|(_, said)| said.motion.has_step()) {
                    let off = deviations(&Rigid::default(), &said.motion);
                    assert!(off < 5.0, "{place}, scan {at}: off by {off} deviations, {:?}", said.motion);
                }
                assert!(said[..20].iter().all(|said| said.foreground == 0), "{place}");
                // Where the ranges are quite other ones, there is nothing to be unsure of.
                if (factor - 1.0_f64).abs() > 0.3 {
                    for at in [20, 30] {
                        assert_eq!(said[at].motion.how(), MotionMethod::Refused, "{place}, scan {at}");
                    }
                    assert!(said.iter().all(|said| said.foreground == 0), "{place}");
                }
                let last = said.last().unwrap();
                assert!(last.motion.has_step() && last.motion.overlap > 0.9, "it goes on: {place}");
            }
        }
    }
}

/// One beam in ten returns: that is too little to say what moves.
#[test]
fn where_little_returns_nothing_moves() {
    let mut random = Rng::with_seed(9);
    for seed in 0..4 {
        let mut drive = Drive::through_a_room(seed, 361, 120, 0.01);
        for scan in &mut drive.scans[40..60] {
            let no_return = scan.no_return;
            scan.arrays()
                .ranges
                .iter_mut()
                .filter(|_| random.u8(..10) != 0)
                .for_each(|range| *range = no_return);
        }
        let said = follow(&drive.scans);
        for (at, said) in said.iter().enumerate().skip(1) {
            if said.motion.has_step() {
                let truth = drive.places[at - 1].inverse().then(&drive.places[at]);
                let off = deviations(&truth, &said.motion);
                assert!(off < 6.0, "{seed} {at}: off by {off} deviations, {:?}", said.motion);
            }
            assert!(
                usize::from(said.lines.readings) <= 361 && said.foreground <= 4,
                "{seed} {at}: {}",
                said.foreground
            );
        }
        assert!(said[100..].iter().all(|said| said.motion.has_step()), "{seed}: it goes on");
    }
}

/// A scan whose beams have impossible times is not corrected by them.
#[test]
fn impossible_times_of_beams_are_ignored() {
    let mut random = Rng::with_seed(4);
    let drive = Drive::with_walkers(3, 361, 150, 2, 0.02);
    let mut jumping = Drive::with_walkers(3, 361, 150, 2, 0.02);
    for scan in &mut jumping.scans {
        (scan.beam_time_ns, scan.turn_ns) = (random.u32(..), random.u32(..));
        scan.first_beam_ns = random.i32(..);
    }
    let said = follow(&jumping.scans);
    for (at, said) in said.iter().enumerate().skip(1) {
        let truth = drive.places[at - 1].inverse().then(&drive.places[at]);
        let off = truth.inverse().then(&Rigid::new(said.motion.dx_m.into(), said.motion.dy_m.into(), 0.0));
        assert!(said.motion.has_step() && off.x.hypot(off.y) < 0.03, "{at}: {truth:?} {:?}", said.motion);
    }
    assert!(said.iter().any(|said| said.foreground > 0));
}
