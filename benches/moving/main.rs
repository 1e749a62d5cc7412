//! How well does a robot that drives tell what moves from what stands? `background.method = "moving"` in simulated drives
//! with truth, beside `multi` where the robot stands, and on recordings of a model car with another one whose place is
//! known: `cargo bench --bench moving`, `-- --json` for a line each, `-- --quick` for two seeds.
//!
//! Due is a beam wholly on a person that ends in space that was seen free at least five times. Left out are beams at a
//! person's edge, people where nothing was seen before, and the first 12 s.

#[path = "../motion/drives.rs"]
#[allow(dead_code)] // The logs of others.
mod drives;
#[path = "../support/figures.rs"]
#[allow(dead_code)] // Benches of time use more of it.
mod figures;
#[path = "../support/quick.rs"]
mod quick;
#[path = "../lines/rooms.rs"]
#[allow(dead_code)] // The experiment of PLE.
mod rooms;
#[path = "../../hub/preprocess/tests/drives/mod.rs"]
mod worlds;

use std::process::ExitCode;
use std::time::Instant;

use preprocess::background::{Class, Method, Model, Settings};
use preprocess::lines::{self, LineFinder};
use preprocess::motion::{self, MotionEstimator};
use schema::{Foreground, Lines, Motion, Pose, Scan};

use figures::{Cell, Figure, Target};
use worlds::Drive;

fn main() -> ExitCode {
    let [is_json, is_quick] = match quick::asked() {
        Ok(asked) => asked,
        Err(code) => return code,
    };
    let (mut figures, mut cells) = (Vec::new(), Vec::new());
    // Seeds below 10 were there to tune on.
    let seeds = if is_quick { 10..12 } else { 10..20 };
    of_drives(seeds, &mut figures);
    of_recordings(&mut cells);
    figures::print("moving", is_json, &figures);
    figures::print_cells("moving", is_json, &cells);
    ExitCode::SUCCESS
}

/// All that the method takes, one after the other as in the hub.
struct Follower {
    lines: LineFinder,
    motion: MotionEstimator,
    model: Model,
    found: Lines,
    out: Box<Foreground>,
}

impl Follower {
    fn new(method: Method, beams: usize) -> Follower {
        let settings = Settings { method, ..Settings::default() };
        Follower {
            lines: LineFinder::new(Pose::default(), lines::Settings::default(), beams),
            motion: MotionEstimator::new(Pose::default(), motion::Settings::default(), beams),
            model: Model::new(settings, beams),
            found: Lines::default(),
            out: Foreground::of(beams),
        }
    }

    fn update(&mut self, scan: &Scan) -> &[Class] {
        if self.model.method() == Method::Moving {
            let mut motion = Motion::default();
            self.lines.update(scan, &mut self.found);
            self.motion.update(scan, &self.found, &mut motion);
            self.model.follow(&Pose::default(), &motion);
        }
        self.model.update(scan, &mut self.out);
        self.model.classes()
    }
}

/// Recall and precision of `method` from scan `from` on, microseconds a scan. A map with the true places says what is due.
fn run(drive: &Drive, method: Method, from: usize) -> (f64, f64, f64) {
    let beams = drive.scans[0].beams();
    let mut follower = Follower::new(method, beams);
    let mut free = worlds::Seen::default();
    let (mut due, mut found, mut wrong, mut taken_us) = (0, 0, 0, 0.0);
    for (at, scan) in drive.scans.iter().enumerate() {
        let begin = Instant::now();
        let classes = follower.update(scan);
        taken_us += 1e6 * begin.elapsed().as_secs_f64();
        if at >= from {
            for (beam, class) in classes.iter().enumerate() {
                let (is_person, is_told) = (drive.people[at][beam], *class == Class::Foreground);
                let is_edge = [beam.wrapping_sub(1), beam + 1]
                    .iter()
                    .any(|&other| drive.people[at].get(other).is_some_and(|person| *person != is_person));
                if is_edge {
                    continue;
                }
                let is_due = is_person && free.is_free(&drive.places[at], scan, beam);
                due += usize::from(is_due);
                found += usize::from(is_due && is_told);
                wrong += usize::from(!is_person && is_told);
            }
        }
        free.look(&drive.places[at], scan);
    }
    let share = |part: usize, of: usize| part as f64 / of.max(1) as f64;
    (share(found, due), share(found, found + wrong), taken_us / drive.scans.len() as f64)
}

fn of_drives(seeds: std::ops::Range<u64>, figures: &mut Vec<Figure>) {
    let mut put = |name, unit, hub, floor, target| figures.push(Figure { name, unit, hub, floor, target });
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
    put("driving: recall", "1", recall, Vec::new(), Target::Least(0.95));
    put("driving: precision", "1", precision, Vec::new(), Target::Least(0.90));
    put("driving: time a scan, 361 beams", "us", time_us, Vec::new(), Target::None);
    let [recall, precision, time_us] = of(0.02, 1081, Method::Moving);
    put("driving, 1081 beams: recall", "1", recall, Vec::new(), Target::Least(0.95));
    put("driving, 1081 beams: precision", "1", precision, Vec::new(), Target::Least(0.90));
    put("driving: time a scan, 1081 beams", "us", time_us, Vec::new(), Target::None);
    let [moving, multi] = [Method::Moving, Method::Multi].map(|method| of(0.0, 361, method));
    let less = |of: usize| multi[of].iter().zip(&moving[of]).map(|(multi, moving)| multi - moving).collect();
    put("standing: recall; multi", "1", moving[0].clone(), multi[0].clone(), Target::None);
    put("standing: precision; multi", "1", moving[1].clone(), multi[1].clone(), Target::None);
    put("standing: recall less than multi's", "1", less(0), Vec::new(), Target::Most(0.01));
    put("standing: precision less than multi's", "1", less(1), Vec::new(), Target::Most(0.01));
}

/// The other car, while it moves: what share of its beams is told, and what else is, per scan.
fn of_recordings(cells: &mut Vec<Cell>) {
    let recordings = drives::with_another();
    if recordings.is_empty() {
        eprintln!("no recordings: SCANHUB_DATA names no folder with moving/*.jsonl.gz; left out");
    }
    for (drive, others) in recordings {
        let mut follower = Follower::new(Method::Moving, 360);
        let (mut due, mut found, mut wrong, mut scans) = (0, 0, 0, 0);
        for (at, scan) in drive.scans.iter().enumerate() {
            let classes = follower.update(scan);
            let (Some(place), Some(other)) = (drive.places[at], others[at]) else { continue };
            scans += 1;
            let before = others[at.saturating_sub(1)].unwrap_or(other);
            let moves = (other.x - before.x).hypot(other.y - before.y) > 0.05 / 13.0;
            for (beam, class) in classes.iter().enumerate() {
                let Some(range) = scan.distance_m(beam) else { continue };
                let angle = scan.angle(beam);
                let (x, y) = place.point((range * angle.cos(), range * angle.sin()));
                let far = (x - other.x).hypot(y - other.y);
                let is_told = *class == Class::Foreground;
                due += usize::from(far < 0.2 && moves);
                found += usize::from(far < 0.2 && moves && is_told);
                wrong += usize::from(far > 0.4 && is_told);
            }
        }
        let share = f64::from(found as u32) / f64::from(due.max(1) as u32);
        for (column, value) in [
            ("beams on the other car", f64::from(due as u32)),
            ("share of them found", share),
            ("other beams told a scan", f64::from(wrong as u32) / f64::from(scans.max(1))),
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
