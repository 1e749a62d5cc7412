//! What three dimensions are worth: recall, precision and points of world `tilt` over seeds, and what faulty angles do.
//!
//! ```sh
//! cargo run --release -p scanhub-tilt --example figures
//! ```

mod hall;
mod judge;

use hall::Hall;
use judge::{Score, Seen, seconds, share};
use sim::mount::{Fault, FaultKind};
use sim::world::World;
use tilt::{Settings, Withheld};

/// So many halls.
const SEEDS: u64 = 10;

fn main() -> Result<(), schema::Failure> {
    let world: World = "tilt".parse()?;
    people(&world);
    println!(
        "fault from 20 to 24 s: beams withheld (silent, jumped, inconsistent, standing), sweeps doubted of all"
    );
    println!("  greatest error of points in other sweeps; obstacles in them where nothing is new");
    for (name, kind) in FAULTS {
        fault(&world, name, kind);
    }
    Ok(())
}

const FAULTS: [(&str, FaultKind); 8] = [
    ("halts", FaultKind::Halts),
    ("silent", FaultKind::Silent),
    ("stuck", FaultKind::Stuck),
    ("jumps by 8 degrees", FaultKind::Jumps(8.0)),
    ("jumps by -3 degrees", FaultKind::Jumps(-3.0)),
    ("lies by 4 degrees", FaultKind::Lies(4.0)),
    ("late by 0.2 s", FaultKind::Late(0.2)),
    ("late by 1 s", FaultKind::Late(1.0)),
];

fn people(world: &World) {
    let settings = Settings::default();
    let mut all = Score::default();
    let (mut at_once, mut errors) = (0, Vec::new());
    let (mut poles, mut boxes) = (Vec::new(), Vec::new());
    let (mut recalls, mut precisions) = (Vec::new(), Vec::new());
    for seed in 0..SEEDS {
        let (mut score, mut seen) = (Score::default(), Seen::default());
        Hall::new(world, seed).play(settings, 60, |hall, sweep| {
            seen.add(sweep);
            if sweep.until_ns > seconds(20) {
                score.add(hall, sweep, &settings, judge::SWEEP_NS);
            }
            let far = sweep.points.iter().filter(|point| (4.8..5.2).contains(&hall.range_m(point)));
            errors.extend(far.map(|point| hall.error_m(point)));
        });
        at_once += u32::from(seen.is_pole_found_at_once());
        poles.push(seen.sweeps_of_pole());
        boxes.push(seen.sweeps_of_box());
        recalls.push(score.recall());
        precisions.push(score.precision());
        all.persons = (all.persons.0 + score.persons.0, all.persons.1 + score.persons.1);
        all.things = (all.things.0 + score.things.0, all.things.1 + score.things.1);
        all.wrong += score.wrong;
    }
    let least = |values: &[f64]| values.iter().copied().fold(1.0, f64::min);
    println!("{SEEDS} halls of 60 s, sweeps of 50 degrees at 30 degrees a second, background after 5 sweeps");
    println!("pole at 2 m found in the first whole sweep: {at_once} of {SEEDS}");
    println!("sweeps until it is background: {poles:?}; the box: {boxes:?}");
    let [persons, things] = [all.persons, all.things].map(|(points, found)| share(found, points));
    println!(
        "recall {:.3} [least {:.3}]: persons {persons:.3}, pole and box {things:.3}",
        all.recall(),
        least(&recalls)
    );
    println!("precision {:.3} [least {:.3}]", all.precision(), least(&precisions));
    errors.sort_by(f64::total_cmp);
    let at = |share: f64| 1000.0 * errors[((errors.len() - 1) as f64 * share) as usize];
    println!(
        "error of points 5 m away beside the noise of the ranges: p50 {:.2} mm, p99 {:.2} mm, most {:.2} mm",
        at(0.5),
        at(0.99),
        at(1.0)
    );
}

fn fault(world: &World, name: &str, kind: FaultKind) {
    let fault = Fault { kind, from_s: 20.0, until_s: 24.0 };
    let (mut most, mut invented) = (0.0_f64, 0);
    // Nobody has come yet.
    let world = world.clone().with_mount_faults(&[fault]);
    let counts = Hall::new(&world, 1).play(Settings::default(), 29, |hall, sweep| {
        if !sweep.is_doubted {
            most = sweep.points.iter().map(|point| hall.error_m(point)).fold(most, f64::max);
            invented += if sweep.until_ns < seconds(24) { sweep.obstacles.len() } else { 0 };
        }
    });
    let [silent, jumped, inconsistent, standing]: [u64; Withheld::COUNT] = counts.withheld;
    println!(
        "{name:20} {silent:6} {jumped:6} {inconsistent:6} {standing:6}  {} of {}  {:.1} mm  {invented}",
        counts.doubted,
        counts.sweeps,
        1000.0 * most
    );
}
