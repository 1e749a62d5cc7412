//! How well is a robot's motion known from its scans, and how long does it take? The hub's beside plain point-to-point and
//! plain point-to-line matching of two scans, on drives of real robots whose place somebody knew, and on simulated ones:
//! `cargo bench --bench motion`, `-- --json` for a line each, `-- --quick` for fewer steps.

#[path = "../lines/rooms.rs"]
#[allow(dead_code)] // The experiment of PLE.
mod rooms;

mod drives;
#[path = "../support/figures.rs"]
#[allow(dead_code)] // Benches of time use more of it.
mod figures;
#[path = "../support/quick.rs"]
mod quick;
mod rivals;
mod simulated;

use std::process::ExitCode;
use std::time::Instant;

use preprocess::lines::{LineFinder, Settings as LineSettings};
use preprocess::motion::{MotionEstimator, Rigid, Settings};
use schema::{Lines, Motion, Pose, Scan};

use drives::Drive;
use figures::{Cell, Figure, Target};

fn main() -> ExitCode {
    let [is_json, is_quick] = match quick::asked() {
        Ok(asked) => asked,
        Err(code) => return code,
    };
    let (mut figures, mut cells) = (Vec::new(), Vec::new());
    let drives = drives::all();
    if drives.is_empty() {
        eprintln!("no drives: SCANHUB_DATA names no folder with carmen/ and moving/; left out");
    }
    for drive in &drives {
        of_drive(drive, if is_quick { 100 } else { 400 }, &mut cells);
    }
    of_simulated(if is_quick { 2 } else { 10 }, &mut figures);
    figures::print("motion", is_json, &figures);
    figures::print_cells("motion", is_json, &cells);
    ExitCode::SUCCESS
}

/// What the hub says of each scan, and microseconds a scan: of its lines, and of the motion.
fn run(scans: &[Box<Scan>], settings: Settings) -> (Vec<Motion>, [f64; 2]) {
    let beams = scans.iter().map(|scan| scan.beams()).max().unwrap_or(0);
    let mut finder = LineFinder::new(Pose::default(), LineSettings::default(), beams);
    let mut estimator = MotionEstimator::new(Pose::default(), settings, beams);
    let mut lines = Lines::default();
    let mut taken_us = [0.0; 2];
    let motions = scans.iter().map(|scan| {
        let begin = Instant::now();
        finder.update(scan, &mut lines);
        taken_us[0] += 1e6 * begin.elapsed().as_secs_f64();
        let begin = Instant::now();
        let mut motion = Motion::default();
        estimator.update(scan, &lines, &mut motion);
        taken_us[1] += 1e6 * begin.elapsed().as_secs_f64();
        motion
    });
    let motions = motions.collect();
    (motions, taken_us.map(|us| us / scans.len().max(1) as f64))
}

/// Millimetres and degrees from `truth` to `found`.
fn off(truth: &Rigid, found: &Rigid) -> (f64, f64) {
    let between = truth.inverse().then(found);
    (1000.0 * between.x.hypot(between.y), between.yaw.to_degrees().abs())
}

fn step(motion: &Motion) -> Option<Rigid> {
    let [x, y, yaw] = [motion.dx_m, motion.dy_m, motion.dyaw_rad].map(f64::from);
    motion.has_step().then(|| Rigid::new(x, y, yaw))
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    figures::percentile(values, 0.5).unwrap_or(f64::NAN)
}

/// At most `most` steps of `drive`, evenly spread.
fn of_drive(drive: &Drive, most: usize, cells: &mut Vec<Cell>) {
    let (motions, times_us) = run(&drive.scans, drive.settings);
    let steps: Vec<(usize, Rigid)> = drive.steps().collect();
    let every = steps.len().div_ceil(most).max(1);
    let steps: Vec<_> = steps.into_iter().step_by(every).collect();
    let mut put = |row: &str,
                   found: &dyn Fn(usize) -> Option<Rigid>,
                   says: &dyn Fn(usize) -> bool,
                   time_us: Option<f64>| {
        let pairs: Vec<(f64, f64)> =
            steps.iter().filter_map(|(at, truth)| Some(off(truth, &found(*at)?))).collect();
        let mut offs: [Vec<f64>; 2] = pairs.iter().copied().collect::<(Vec<_>, Vec<_>)>().into();
        let [mm, degrees] = offs.each_mut().map(|values| median(values));
        let is_wrong = |(mm, degrees): &&(f64, f64)| *mm > drive.wrong_mm || *degrees > 5.0;
        let is_silent = |(at, truth): &&(usize, Rigid)| {
            found(*at).is_some_and(|found| is_wrong(&&off(truth, &found))) && !says(*at)
        };
        let silent = steps.iter().filter(is_silent).count();
        let share = |count: usize| count as f64 / steps.len().max(1) as f64;
        for (column, unit, value) in [
            ("median step error", "mm", Some(mm)),
            ("median turn error", "deg", Some(degrees)),
            ("steps that are wrong", "1", Some(share(pairs.iter().filter(is_wrong).count()))),
            ("wrong, and none says so", "1", Some(share(silent))),
            ("steps refused", "1", Some(share(steps.len() - pairs.len()))),
            ("time", "us", time_us),
        ] {
            cells.push(Cell {
                table: format!("{}: {} steps of {}", drive.name, steps.len(), drive.scans.len()),
                row: row.to_owned(),
                column: column.to_owned(),
                unit,
                values: value.into_iter().collect(),
            });
        }
    };
    put("hub", &|at| step(&motions[at]), &|at| motions[at].is_degenerate(), Some(times_us[1]));
    type Rival = fn(&Scan, &Scan) -> Rigid;
    let rivals: [(&str, Rival); 2] =
        [("point to point", rivals::point_to_point), ("point to line", rivals::point_to_line)];
    for (row, rival) in rivals {
        let begin = Instant::now();
        let found: Vec<Rigid> =
            steps.iter().map(|(at, _)| rival(&drive.scans[at - 1], &drive.scans[*at])).collect();
        let time_us = 1e6 * begin.elapsed().as_secs_f64() / steps.len().max(1) as f64;
        let of = |at: usize| found.get(steps.iter().position(|(step, _)| *step == at)?).copied();
        put(row, &of, &|_| false, Some(time_us));
    }
}

/// Simulated drives, `seeds` of each kind.
fn of_simulated(seeds: u64, figures: &mut Vec<Figure>) {
    let mut put = |name, unit, hub, floor, target| figures.push(Figure { name, unit, hub, floor, target });
    let of_each = |of: &dyn Fn(u64) -> f64| (1..=seeds).map(of).collect::<Vec<f64>>();
    let error = |kind: simulated::Kind, beams: usize, seed: u64, by_hub: bool| {
        let (scans, truth) = simulated::drive(kind, beams, 200, seed);
        let motions = run(&scans, Settings::default()).0;
        let mut offs: Vec<f64> = (1..scans.len())
            .filter_map(|at| {
                let truth = truth[at - 1].inverse().then(&truth[at]);
                let found = match by_hub {
                    true => step(&motions[at])?,
                    false => rivals::point_to_line(&scans[at - 1], &scans[at]),
                };
                Some(off(&truth, &found).0)
            })
            .collect();
        median(&mut offs)
    };
    use simulated::Kind::{Corridor, Hidden, Jump, People, Room};
    let time = |beams: usize, part: usize| {
        move |seed| run(&simulated::drive(Room, beams, 300, seed).0, Settings::default()).1[part]
    };
    for (beams, [name, lines]) in [
        (361, ["time a scan, 361 beams", "lines of it, 361 beams"]),
        (1081, ["time a scan, 1081 beams", "lines of it, 1081 beams"]),
    ] {
        put(name, "us", of_each(&time(beams, 1)), Vec::new(), Target::Most(1000.0));
        put(lines, "us", of_each(&time(beams, 0)), Vec::new(), Target::None);
    }
    let by = |kind, by_hub| of_each(&|seed| error(kind, 361, seed, by_hub));
    put("room: step error; plain", "mm", by(Room, true), by(Room, false), Target::Ratio(1.0));
    put("people in half the view; plain", "mm", by(People, true), by(People, false), Target::Ratio(1.0));
    put("people in half; hidden", "mm", by(People, true), by(Hidden, true), Target::Ratio(1.5));
    put("people in half; without", "mm", by(People, true), by(Room, true), Target::Ratio(1.5));
    let corridor = of_each(&|seed| {
        let motions = run(&simulated::drive(Corridor, 361, 200, seed).0, Settings::default()).0;
        let says = |motion: &&Motion| motion.is_degenerate() && motion.covariance[0] > 0.01;
        let steps = motions.iter().filter(|motion| motion.has_step());
        steps.clone().filter(says).count() as f64 / steps.count().max(1) as f64
    });
    put("corridor: steps that say so", "1", corridor, Vec::new(), Target::Least(0.99));
    let room = of_each(&|seed| {
        let motions = run(&simulated::drive(Room, 361, 200, seed).0, Settings::default()).0;
        motions.iter().filter(|motion| motion.is_degenerate()).count() as f64 / motions.len() as f64
    });
    put("room: steps that say so", "1", room, Vec::new(), Target::Most(0.01));
    let jumps = of_each(&|seed| {
        let (scans, truth) = simulated::drive(Jump, 361, 200, seed);
        let motions = run(&scans, Settings::default()).0;
        let jumps: Vec<usize> =
            (1..scans.len()).filter(|&at| off(&truth[at - 1], &truth[at]).0 > 1000.0).collect();
        jumps.iter().filter(|&&at| !motions[at].has_step()).count() as f64 / jumps.len().max(1) as f64
    });
    put("jumps that are refused", "1", jumps, Vec::new(), Target::Least(0.99));
    let unsure = of_each(&|seed| {
        let (scans, truth) = simulated::drive(Room, 361, 400, seed);
        let motions = run(&scans, Settings::default()).0;
        let squares: Vec<f64> = (1..scans.len())
            .filter_map(|at| {
                let found = step(&motions[at])?;
                let truth = truth[at - 1].inverse().then(&truth[at]);
                let off = [found.x - truth.x, found.y - truth.y, found.yaw - truth.yaw];
                simulated::normalized(&off, &motions[at].covariance)
            })
            .collect();
        squares.iter().sum::<f64>() / (3 * squares.len().max(1)) as f64
    });
    put("squared error by covariance", "1", unsure, Vec::new(), Target::Most(2.0));
    let drift = of_each(&|seed| {
        let (scans, _) = simulated::drive(simulated::Kind::Standing, 361, 1000, seed);
        let motions = run(&scans, Settings::default()).0;
        motions.last().map_or(f64::NAN, |last| 1000.0 * last.x_m.hypot(last.y_m))
    });
    put("standing for 1000 scans: drift", "mm", drift, Vec::new(), Target::None);
}
