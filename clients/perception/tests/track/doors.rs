//! Tests of doors with moving leaves. If only the leaves move, no person is counted. Each person is counted once,
//! whether they walk through the door or stand in the opening.

use crate::hall::{DOOR_KINDS, DoorKind, HALL_SITE, SCANNERS, Scene, Walker, events};
use scanhub_perception::track::geometry::Point;
use scanhub_perception::track::{Event, Kind};

/// Positions of the scanner: in the middle of the wall opposite the door, at the side of this wall, and nearer to the
/// door.
const DOOR_POSITIONS: [Point; 3] = [[0.0, 0.0], [0.0, -2.5], [2.5, -2.5]];

fn describe(events: &[(f64, Event)]) -> String {
    events.iter().map(|(at_s, event)| format!("{at_s:.2} {} {:?}\n", event.id, event.kind)).collect()
}

/// Returns the passages in `events`, each with its time in seconds, and whether the person went into the hall.
fn reported_passages(events: &[(f64, Event)]) -> Vec<(f64, bool)> {
    let door = |(at_s, event): &(f64, Event)| match event.kind {
        Kind::Door { to, .. } => Some((*at_s, to == Some(0))),
        _ => None,
    };
    events.iter().filter_map(door).collect()
}

/// Returns the number of passages of `walkers` without a report, and the number of reports without a passage. A person
/// who stands in the opening is counted when they leave it. The report may therefore be up to `stand_s` + 1 s earlier
/// than the passage, or up to `stand_s` + 2.5 s later.
fn count_errors(walkers: &[Walker], events: &[(f64, Event)], stand_s: f64) -> (usize, usize) {
    let mut reports = reported_passages(events);
    let mut missed = 0;
    for (at_s, into) in walkers.iter().flat_map(Walker::passages) {
        let after_s = |report: &(f64, bool)| report.0 - at_s;
        let fits = |report: &(f64, bool)| {
            report.1 == into && (-1.0 - stand_s..stand_s + 2.5).contains(&after_s(report))
        };
        match reports.iter().position(fits) {
            Some(found) => drop(reports.remove(found)),
            None => missed += 1,
        }
    }
    (missed, reports.len())
}

/// Simulated time for each scanner in each position, in minutes. The sum over all four scanners and three positions is
/// an hour.
const EMPTY_MINUTES: u64 = 5;

fn check_no_events(leaves: DoorKind) {
    let mut all = String::new();
    for (scanner, at) in SCANNERS.into_iter().flat_map(|scanner| DOOR_POSITIONS.map(|at| (scanner, at))) {
        let scene = Scene {
            site: HALL_SITE,
            leaves,
            scanner,
            at,
            seed: 1,
            seconds: 60 * EMPTY_MINUTES,
            is_door_moving: true,
            opens_m: 0.0,
            open_time_s: 4.0,
            walkers: &[],
        };
        let events = events(&scene);
        if !events.is_empty() {
            all += &format!(
                "{leaves:?} {scanner:?} at {at:?}: {} events, {} counts\n",
                events.len(),
                reported_passages(&events).len()
            );
            all += &describe(&events[..events.len().min(12)]);
        }
    }
    assert!(all.is_empty(), "{all}");
}

#[test]
fn leaves_sliding_behind_the_wall_cause_no_events() {
    check_no_events(DoorKind::Slide(0.05));
}

#[test]
fn leaves_sliding_before_the_wall_cause_no_events() {
    check_no_events(DoorKind::Slide(-0.05));
}

#[test]
fn leaves_swinging_into_the_hall_cause_no_events() {
    check_no_events(DoorKind::SwingIn);
}

#[test]
fn leaves_swinging_into_the_lobby_cause_no_events() {
    check_no_events(DoorKind::SwingOut);
}

/// Number of seeds for each scanner.
const SEED_COUNT: u64 = 20;
/// Maximum share of wrongly counted passages for the scanner with one degree between beams and ten scans per second.
/// For this scanner, a leg at the door is a single beam. The other scanners must count every passage correctly.
const MAX_ERROR_SHARE: f64 = 0.05;

/// Checks the counted passages for each scanner and seed. `of_seed` returns the walkers of a seed; the seed also
/// selects the kind of leaves. The first value of `opens` is the distance at which the door opens for people, in
/// meters. The second value is the time for which the door stays open, in seconds. People stand in the opening for up
/// to `stand_s` seconds.
fn check_counts(
    of_seed: impl Fn(&mut fastrand::Rng) -> Vec<Walker>,
    seconds: u64,
    opens: (f64, f64),
    stand_s: f64,
) {
    for (number, scanner) in SCANNERS.into_iter().enumerate() {
        let (mut all, mut passages, mut missed, mut extra) = (String::new(), 0, 0, 0);
        for seed in 1..=SEED_COUNT {
            let mut random = fastrand::Rng::with_seed(100 * number as u64 + seed);
            let walkers = of_seed(&mut random);
            let scene = Scene {
                site: HALL_SITE,
                leaves: DOOR_KINDS[seed as usize % DOOR_KINDS.len()],
                scanner,
                at: DOOR_POSITIONS[seed as usize % DOOR_POSITIONS.len()],
                seed,
                seconds,
                is_door_moving: false,
                opens_m: opens.0,
                open_time_s: opens.1,
                walkers: &walkers,
            };
            let events = events(&scene);
            let real: Vec<(f64, bool)> = walkers.iter().flat_map(Walker::passages).collect();
            let wrong = count_errors(&walkers, &events, stand_s);
            (passages, missed, extra) = (passages + real.len(), missed + wrong.0, extra + wrong.1);
            if wrong != (0, 0) {
                let (leaves, at) = (scene.leaves, scene.at);
                all += &format!(
                    "seed {seed} {leaves:?} at {at:?}: {wrong:?} of {real:.1?}\n{}",
                    describe(&events)
                );
            }
        }
        println!("{scanner:?}: {passages} passages, {missed} not counted, {extra} counted without one");
        let is_coarse = scanner.step_deg == 1.0 && scanner.hz == 10;
        let max_errors = if is_coarse { (MAX_ERROR_SHARE * passages as f64) as usize } else { 0 };
        assert!(missed + extra <= max_errors, "{scanner:?} {missed} {extra}\n{all}");
    }
}

#[test]
fn person_in_the_opening_is_counted_at_each_passage() {
    let of_seed = |random: &mut fastrand::Rng| {
        let mut place =
            |x: [f64; 2], y: f64| [x[0] + (x[1] - x[0]) * random.f64(), y * (2.0 * random.f64() - 1.0)];
        let path = vec![
            (place([9.0, 9.5], 3.0), 0.0),
            (place([6.0, 6.0], 0.4), 0.0),
            (place([2.0, 3.5], 2.0), 3.0),
            (place([6.0, 6.0], 0.4), 0.0),
            (place([8.0, 9.5], 1.0), 3.0),
            (place([5.9, 6.1], 0.4), 8.0),
            (place([2.0, 3.5], 2.0), 2.0),
            (place([5.9, 6.1], 0.4), 8.0),
            (place([8.5, 9.5], 1.0), 0.0),
            (place([9.7, 9.9], 1.0), 0.0),
        ];
        vec![Walker { from_s: 80.0, path, speed: 0.9 + 0.4 * random.f64(), phase: random.f64() }]
    };
    check_counts(of_seed, 140, (2.0, 2.0), 10.0);
}

#[test]
fn people_in_a_row_are_counted_while_the_leaves_move() {
    let of_seed = |random: &mut fastrand::Rng| {
        let into = random.bool();
        let pace = 0.9 + 0.4 * random.f64();
        let walker = |number: i32, random: &mut fastrand::Rng| {
            let y = 0.6 * (random.f64() - 0.5);
            let mut path =
                vec![([9.5, y], 0.0), ([6.0, y], 0.0), ([1.5, y + 1.5], 0.0), ([0.5, y + 3.0], 0.0)];
            if !into {
                path.reverse();
            }
            Walker { from_s: 80.0 + 1.3 * f64::from(number), path, speed: pace, phase: random.f64() }
        };
        (0..4).map(|number| walker(number, random)).collect()
    };
    check_counts(of_seed, 105, (1.5, 0.5), 0.0);
}
