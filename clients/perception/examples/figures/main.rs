//! Figures of `tilt`: recall, precision and points of world `tilt` over several seeds, and the effects of faulty
//! angles.
//!
//! ```sh
//! cargo run --release -p scanhub-perception --example figures
//! ```

mod hall;
mod halls;
mod score;

use std::ops::Range;

use hall::Hall;
use scanhub_perception::tilt::{DropReason, Settings};
use scanhub_sim::mount::{Fault, FaultKind};
use scanhub_sim::world::World;
use score::{ObstacleScore, ObstacleTimes, PointScore, seconds, share};

/// Number of halls, each with its own seed.
const SEED_COUNT: u64 = 10;

fn main() -> Result<(), scanhub_schema::Failure> {
    let world: World = "tilt".parse()?;
    let part = std::env::args().nth(1);
    // The user can choose halls for which the library was not tuned.
    let number = |nth: usize| std::env::args().nth(nth).and_then(|text| text.parse().ok());
    let halls = |count: u64| {
        let from = number(2).unwrap_or(0);
        from..number(3).unwrap_or(from + count)
    };
    let is_wanted = |name: &str| part.as_deref().is_none_or(|part| part == name);
    if is_wanted("unchanging") {
        measure_unchanging(halls(4));
    }
    if is_wanted("changing") {
        measure_changing(halls(SEED_COUNT));
    }
    if is_wanted("stamps") {
        measure_late_stamps();
    }
    if is_wanted("cost") {
        let cost = |seed| Hall::new(&halls::changing(seed), seed).min_time_per_scan(Settings::default(), 80);
        println!("time of the library for a scan of 361 beams, in three halls: {:?}", [0, 1, 2].map(cost));
    }
    if is_wanted("people") {
        measure_people(&world);
    }
    if is_wanted("faults") {
        println!(
            "fault from 20 to 24 s: beams dropped (silent, jumped, inconsistent, standing), sweeps unreliable of all"
        );
        println!("  greatest error of points in other sweeps; obstacles in them where nothing is new");
        for (name, kind) in FAULTS {
            measure_fault(&world, name, kind);
        }
    }
    Ok(())
}

const FAULTS: [(&str, FaultKind); 8] = [
    ("halts", FaultKind::Halt),
    ("silent", FaultKind::Silence),
    ("stuck", FaultKind::Stuck),
    ("jumps by 8 degrees", FaultKind::Jump(8.0)),
    ("jumps by -3 degrees", FaultKind::Jump(-3.0)),
    ("lies by 4 degrees", FaultKind::Drift(4.0)),
    ("late by 0.2 s", FaultKind::Delay(0.2)),
    ("late by 1 s", FaultKind::Delay(1.0)),
];

/// Measures false obstacles in halls without changes. Each hall runs for 200 sweeps; the first seven do not count,
/// because the background is not known yet.
fn measure_unchanging(halls: Range<u64>) {
    let (mut sweeps, mut with, mut obstacles, mut late) = (0, 0, 0, 0);
    for seed in halls.clone() {
        let mut hall = Hall::new(&halls::unchanging(seed), seed);
        let until_s = 200 * hall.sweep_ns() / seconds(1);
        hall.play(Settings::default(), until_s, |_, sweep| {
            let is_known = sweep.number > 6;
            sweeps += u32::from(is_known);
            with += u32::from(is_known && !sweep.obstacles.is_empty());
            obstacles += if is_known { sweep.obstacles.len() } else { 0 };
            late += if sweep.number >= 100 { sweep.obstacles.len() } else { 0 };
        });
    }
    println!(
        "halls {halls:?} without changes, 200 sweeps each: {obstacles} obstacles in {with} of {sweeps} sweeps"
    );
    println!("  {late} of these in the second hundred");
}

/// Measures the obstacles in furnished halls with new objects and a person.
fn measure_changing(halls: Range<u64>) {
    let settings = Settings::default();
    let mut all = ObstacleScore::default();
    for seed in halls.clone() {
        let mut obstacle_score = ObstacleScore::default();
        let mut hall = Hall::new(&halls::changing(seed), seed);
        hall.play(settings, 80, |hall, sweep| {
            if sweep.from_ns > seconds(20) {
                obstacle_score.add(hall, sweep, &settings, hall.sweep_ns());
            }
        });
        all.new = (all.new.0 + obstacle_score.new.0, all.new.1 + obstacle_score.new.1);
        (all.right, all.wrong) = (all.right + obstacle_score.right, all.wrong + obstacle_score.wrong);
    }
    println!(
        "furnished halls {halls:?}, 80 s each: obstacles recall {:.3} of {}, precision {:.3} of {}",
        all.recall(),
        all.new.0,
        all.precision(),
        all.right + all.wrong
    );
}

/// Measures the effect of angle stamps that are wrong from the start, in halls without changes.
fn measure_late_stamps() {
    println!(
        "stamps of angles late by: found; error of points from 20 to 40 s, p50 and p99; obstacles; unreliable sweeps"
    );
    for by_s in [0.0, 0.005, 0.01, 0.03, 0.1, -0.03] {
        let (mut errors, mut obstacles, mut unreliable, mut sweeps) = (Vec::new(), 0, 0, 0);
        let mut found = Vec::new();
        for seed in 0..4 {
            let fault = Fault { kind: FaultKind::StampDelay(by_s), from_s: 0.0, until_s: f64::INFINITY };
            let world = halls::unchanging(seed).with_mount_faults(&[fault]);
            let mut hall = Hall::new(&world, seed);
            let counts = hall.play(Settings::default(), 40, |hall, sweep| {
                if sweep.from_ns > seconds(20) {
                    errors.extend(sweep.points.iter().map(|point| hall.error_m(point)));
                    obstacles += sweep.obstacles.len();
                }
            });
            found.push(hall.stamp_delay_ns as f64 / 1e6);
            (unreliable, sweeps) = (unreliable + counts.unreliable, sweeps + counts.sweeps);
        }
        errors.sort_by(f64::total_cmp);
        let at = |share: f64| 1000.0 * errors[((errors.len() - 1) as f64 * share) as usize];
        println!(
            "  {:4.0} ms: {found:.1?} ms; {:.1} mm, {:.1} mm; {obstacles}; {unreliable} of {sweeps}",
            1000.0 * by_s,
            at(0.5),
            at(0.99)
        );
    }
}

fn measure_people(world: &World) {
    let settings = Settings::default();
    let mut all = PointScore::default();
    let (mut at_once, mut errors) = (0, Vec::new());
    let (mut poles, mut boxes) = (Vec::new(), Vec::new());
    let (mut recalls, mut precisions) = (Vec::new(), Vec::new());
    for seed in 0..SEED_COUNT {
        let (mut score, mut times) = (PointScore::default(), ObstacleTimes::default());
        Hall::new(world, seed).play(settings, 60, |hall, sweep| {
            times.add(sweep);
            if sweep.until_ns > seconds(20) {
                score.add(hall, sweep, &settings, score::SWEEP_TIME_NS);
            }
            let far = sweep.points.iter().filter(|point| (4.8..5.2).contains(&hall.range_m(point)));
            errors.extend(far.map(|point| hall.error_m(point)));
        });
        at_once += u32::from(times.is_pole_found_first_sweep());
        poles.push(times.sweeps_of_pole());
        boxes.push(times.sweeps_of_box());
        recalls.push(score.recall());
        precisions.push(score.precision());
        all.persons = (all.persons.0 + score.persons.0, all.persons.1 + score.persons.1);
        all.things = (all.things.0 + score.things.0, all.things.1 + score.things.1);
        all.wrong += score.wrong;
    }
    let minimum = |values: &[f64]| values.iter().copied().fold(1.0, f64::min);
    println!(
        "{SEED_COUNT} halls of 60 s, sweeps of 50 degrees at 30 degrees a second, background after 5 sweeps"
    );
    println!("pole at 2 m found in the first whole sweep: {at_once} of {SEED_COUNT}");
    println!("sweeps until it is background: {poles:?}; the box: {boxes:?}");
    let [persons, things] = [all.persons, all.things].map(|(points, found)| share(found, points));
    println!(
        "recall {:.3} [least {:.3}]: people {persons:.3}, pole and box {things:.3}",
        all.recall(),
        minimum(&recalls)
    );
    println!("precision {:.3} [least {:.3}]", all.precision(), minimum(&precisions));
    errors.sort_by(f64::total_cmp);
    let at = |share: f64| 1000.0 * errors[((errors.len() - 1) as f64 * share) as usize];
    println!(
        "error of points 5 m away beside the noise of the ranges: p50 {:.2} mm, p99 {:.2} mm, most {:.2} mm",
        at(0.5),
        at(0.99),
        at(1.0)
    );
}

fn measure_fault(world: &World, name: &str, kind: FaultKind) {
    let fault = Fault { kind, from_s: 20.0, until_s: 24.0 };
    let (mut maximum, mut invented) = (0.0_f64, 0);
    // No person appears before the end of this run.
    let world = world.clone().with_mount_faults(&[fault]);
    let counts = Hall::new(&world, 1).play(Settings::default(), 29, |hall, sweep| {
        if !sweep.is_unreliable {
            maximum = sweep.points.iter().map(|point| hall.error_m(point)).fold(maximum, f64::max);
            invented += if sweep.until_ns < seconds(24) { sweep.obstacles.len() } else { 0 };
        }
    });
    let [silent, jumped, inconsistent, standing]: [u64; DropReason::COUNT] = counts.points_dropped;
    println!(
        "{name:20} {silent:6} {jumped:6} {inconsistent:6} {standing:6}  {} of {}  {:.1} mm  {invented}",
        counts.unreliable,
        counts.sweeps,
        1000.0 * maximum
    );
}
