//! Separation of moving from static objects on a driving robot, with `background.method = "moving"`. In simulated
//! drives, the correct answers are known. For a standing robot, the method is compared with the method `multi`. The
//! recordings come from a model car, and show another car whose position is known.
//!
//! A beam counts as foreground if its whole spot meets a person, in space that was empty in at least five earlier
//! scans. Three things do not count: beams at the edge of a person, people in space that was not visible before, and
//! the first 12 s.
//!
//! A point belongs to the other car if it is within 0.2 m of the car's pose while the car moves. A beam that is
//! reported as foreground is wrong if its point is more than 0.4 m from this pose.

use std::ops::Range;
use std::time::Instant;

use scanhub_preprocess::background::{BackgroundModel, Class, Method, Settings};
use scanhub_preprocess::motion::{self, MotionEstimator};
use scanhub_schema::{Foreground, Motion, Pose, Scan};

use crate::figures::{self, Cell, Figure, Target};
use crate::recordings;
use crate::worlds::{self, Drive};

/// Measures the method on simulated drives with these `seeds`, and on recorded drives.
pub(crate) fn measure(seeds: Range<u64>, is_json: bool) {
    let (mut figures, mut cells) = (Vec::new(), Vec::new());
    measure_drives(seeds, &mut figures);
    measure_recordings(&mut cells);
    figures::print("perception, moving", is_json, &figures);
    figures::print_cells("perception, moving", is_json, &cells);
}

/// The processors that the method needs, in the order in which the hub runs them.
struct Processors {
    motion: MotionEstimator,
    model: BackgroundModel,
    out: Box<Foreground>,
}

impl Processors {
    fn new(method: Method, beams: usize) -> Processors {
        let settings = Settings { method, ..Settings::default() };
        Processors {
            motion: MotionEstimator::new(Pose::default(), motion::Settings::default(), beams),
            model: BackgroundModel::new(settings, beams),
            out: Foreground::of(beams),
        }
    }

    fn update(&mut self, scan: &Scan, stamp_ns: u64) -> &[Class] {
        if self.model.method() == Method::Moving {
            let mut motion = Motion::default();
            self.motion.update(scan, stamp_ns, 0, &mut motion);
            self.model.set_motion(&Pose::default(), &motion, &self.motion.velocity());
        }
        self.model.update(scan, &mut self.out);
        self.model.classes()
    }
}

/// Returns recall and precision of `method` from the scan with index `from` on, and the CPU time in microseconds per
/// scan. A map that is built with the true poses determines which beams are foreground.
fn run(drive: &Drive, method: Method, from: usize) -> (f64, f64, f64) {
    let beams = drive.scans[0].beams();
    let mut processors = Processors::new(method, beams);
    let mut free = worlds::ObservedSquares::default();
    let (mut due, mut found, mut wrong, mut taken_us) = (0, 0, 0, 0.0);
    for (at, scan) in drive.scans.iter().enumerate() {
        let begin = Instant::now();
        let classes = processors.update(scan, worlds::stamp_ns(at));
        taken_us += 1e6 * begin.elapsed().as_secs_f64();
        if at >= from {
            for (beam, class) in classes.iter().enumerate() {
                let (is_person, is_reported) = (drive.people[at][beam], *class == Class::Foreground);
                let is_edge = [beam.wrapping_sub(1), beam + 1]
                    .iter()
                    .any(|&other| drive.people[at].get(other).is_some_and(|person| *person != is_person));
                if is_edge {
                    continue;
                }
                let is_expected = is_person && free.is_free(drive, at, beam);
                due += usize::from(is_expected);
                found += usize::from(is_expected && is_reported);
                wrong += usize::from(!is_person && is_reported);
            }
        }
        free.observe(drive, at);
    }
    let share = |part: usize, of: usize| part as f64 / of.max(1) as f64;
    (share(found, due), share(found, found + wrong), taken_us / drive.scans.len() as f64)
}

fn measure_drives(seeds: Range<u64>, figures: &mut Vec<Figure>) {
    let mut put =
        |name, unit, hub, baseline, target| figures.push(Figure { name, unit, hub, baseline, target });
    let of = |speed: f64, beams: usize, method: Method| -> [Vec<f64>; 3] {
        let mut columns = [Vec::new(), Vec::new(), Vec::new()];
        for seed in seeds.clone() {
            let drive = worlds::Drive::with_walkers(seed, beams, 1500, 3, speed);
            let (recall, precision, time_us) = run(&drive, method, 450);
            [recall, precision, time_us].into_iter().zip(&mut columns).for_each(|(value, of)| of.push(value));
        }
        columns
    };
    let [recall, precision, time_us] = of(0.02, 361, Method::Moving);
    put("driving: recall", "1", recall, Vec::new(), Target::Min(0.95));
    put("driving: precision", "1", precision, Vec::new(), Target::Min(0.90));
    put("driving: time a scan, 361 beams", "us", time_us, Vec::new(), Target::None);
    let [recall, precision, time_us] = of(0.02, 1081, Method::Moving);
    put("driving, 1081 beams: recall", "1", recall, Vec::new(), Target::Min(0.95));
    put("driving, 1081 beams: precision", "1", precision, Vec::new(), Target::Min(0.90));
    put("driving: time a scan, 1081 beams", "us", time_us, Vec::new(), Target::None);
    let [moving, multi] = [Method::Moving, Method::Multi].map(|method| of(0.0, 361, method));
    let less = |of: usize| multi[of].iter().zip(&moving[of]).map(|(multi, moving)| multi - moving).collect();
    put("standing: recall; multi", "1", moving[0].clone(), multi[0].clone(), Target::None);
    put("standing: precision; multi", "1", moving[1].clone(), multi[1].clone(), Target::None);
    put("standing: recall below multi's", "1", less(0), Vec::new(), Target::Max(0.01));
    put("standing: precision below multi's", "1", less(1), Vec::new(), Target::Max(0.01));
}

/// Adds the scores for recordings with another car. One score is the share of the beams on the moving car that are
/// reported as foreground. The other score is the number of wrong beams per scan.
fn measure_recordings(cells: &mut Vec<Cell>) {
    let recordings = recordings::drives_with_other_car();
    if recordings.is_empty() {
        eprintln!("left out: SCANHUB_DATA names no folder with moving/*.jsonl.gz");
    }
    for (drive, others) in recordings {
        let mut processors = Processors::new(Method::Moving, 360);
        let (mut due, mut found, mut wrong, mut scans) = (0, 0, 0, 0);
        for (at, scan) in drive.scans.iter().enumerate() {
            let classes = processors.update(scan, worlds::stamp_ns(at));
            let (Some(position), Some(other)) = (drive.positions[at], others[at]) else { continue };
            scans += 1;
            let before = others[at.saturating_sub(1)].unwrap_or(other);
            let moves = (other.x - before.x).hypot(other.y - before.y) > 0.05 / 13.0;
            for (beam, class) in classes.iter().enumerate() {
                let Some(range) = scan.distance_m(beam) else { continue };
                let angle = scan.angle(beam);
                let (x, y) = position.point((range * angle.cos(), range * angle.sin()));
                let far = (x - other.x).hypot(y - other.y);
                let is_reported = *class == Class::Foreground;
                due += usize::from(far < 0.2 && moves);
                found += usize::from(far < 0.2 && moves && is_reported);
                wrong += usize::from(far > 0.4 && is_reported);
            }
        }
        let share = f64::from(found as u32) / f64::from(due.max(1) as u32);
        for (column, value) in [
            ("beams on the other car", f64::from(due as u32)),
            ("share of them found", share),
            ("other beams reported, per scan", f64::from(wrong as u32) / f64::from(scans.max(1))),
        ] {
            cells.push(Cell {
                table: "another car".to_owned(),
                row: drive.name.clone(),
                column: column.to_owned(),
                unit: "1",
                values: vec![value],
            });
        }
    }
}
