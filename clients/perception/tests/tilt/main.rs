//! Tests with a scanner on a mount in a simulated hall. They compare points, background and obstacles with the
//! simulated truth. They also cover angles that stop, jump, are wrong or arrive late.

mod definition;
#[expect(dead_code, reason = "figures needs more of it")]
#[path = "../../examples/figures/hall.rs"]
mod hall;
#[expect(dead_code, reason = "figures needs more of it")]
#[path = "../../examples/figures/halls.rs"]
mod halls;
#[expect(dead_code, reason = "figures needs more of it")]
#[path = "../../examples/figures/score.rs"]
mod score;

use hall::Hall;
use scanhub_perception::tilt::{DropReason, Settings};
use scanhub_sim::mount::{Fault, FaultKind};
use scanhub_sim::world::World;
use score::{ObstacleTimes, PointScore, seconds};

#[test]
fn obstacles_are_found_and_become_background() {
    let settings = Settings::default();
    let mut score = PointScore::default();
    let mut detections = ObstacleTimes::default();
    let counts = Hall::new(&"tilt".parse().expect("built in"), 1).play(settings, 52, |hall, sweep| {
        detections.add(sweep);
        let is_known = sweep.from_ns > seconds(10) && sweep.until_ns < seconds(24);
        assert!(!is_known || sweep.obstacles.is_empty(), "nothing is new yet: {:?}", sweep.obstacles);
        if sweep.until_ns > seconds(20) {
            score.add(hall, sweep, &settings, score::SWEEP_TIME_NS);
        }
    });
    assert_eq!(
        counts.points_dropped.iter().sum::<u64>() + counts.unreliable + counts.background_resets,
        0,
        "{counts:?}"
    );
    assert!(detections.is_pole_found_first_sweep(), "{detections:?}");
    assert!(detections.sweeps_of_pole() >= 4 && detections.sweeps_of_pole() <= 7, "{detections:?}");
    assert!(detections.sweeps_of_box() >= 4 && detections.sweeps_of_box() <= 7, "{detections:?}");
    assert!(score.persons.0 > 2000 && score.things.0 > 1000, "{score:?}");
    assert!(score.recall() > 0.95 && score.precision() > 0.97, "{score:?}");
}

/// Simulates the fault `kind` from second 7 to second 10, in a room without new objects. Returns the number of dropped
/// beams for each reason, and the number of unreliable sweeps. Asserts that there are no false obstacles, that no point
/// of a reliable sweep is wrong, and that sweeps are complete and reliable again after the fault.
fn run_with_fault(kind: FaultKind) -> ([u64; DropReason::COUNT], u64) {
    let room = "[[thing]]\nline = [[-2500, -1000], [2500, -1000], [2500, 4000], [-2500, 4000], [-2500, -1000]]\n\
                [[thing]]\nbox = [600, 400]\nheight_mm = 350\npose = [-900, 2200, 35]\n";
    let mount = "[sensor.mount]\nheight_mm = 900\narm_mm = [60, 40]\nfrom_deg = 0\nto_deg = 30\n";
    let text = format!("[[sensor]]\npose = [0, 0, 90]\n{mount}[noise]\nbias_mm = 0\n{room}");
    let settings = Settings { sweeps: 3, ..Settings::default() };
    let fault = scanhub_sim::mount::Fault { kind, from_s: 7.0, until_s: 10.0 };
    let world = World::of_toml("room", &text).unwrap_or_else(|failure| panic!("{failure}"));
    let world = world.with_mount_faults(&[fault]);
    let mut healthy = 0;
    let mut hall = Hall::new(&world, 2);
    let counts = hall.play(settings, 17, |hall, sweep| {
        let wrong = sweep.points.iter().map(|point| hall.error_m(point)).fold(0.0, f64::max);
        let [from, until] = [sweep.from_ns, sweep.until_ns].map(|ns| ns as f64 / 1e9);
        assert!(sweep.is_unreliable || wrong < 0.03, "{kind:?}, {from} to {until} s: {wrong} m");
        assert!(sweep.obstacles.is_empty(), "{kind:?}, {from} to {until} s: {:?}", sweep.obstacles);
        healthy += u32::from(from > 11.5 && sweep.is_complete && !sweep.is_unreliable);
    });
    assert!(healthy >= 4, "{kind:?}: {healthy}, {counts:?}");
    assert_eq!(hall.stamp_delay_ns, 0, "{kind:?}: the stamps were right");
    (counts.points_dropped, counts.unreliable)
}

#[test]
fn points_of_a_halted_mount_are_dropped_as_standing() {
    let ([silent, jumped, inconsistent, standing], unreliable) = run_with_fault(FaultKind::Halt);
    assert_eq!([silent, jumped, inconsistent, unreliable], [0; 4]);
    // Points are dropped only while the mount does not move.
    assert!((35_000..42_000).contains(&standing), "{standing}");
}

#[test]
fn points_of_a_stuck_encoder_are_dropped() {
    let ([silent, jumped, inconsistent, standing], unreliable) = run_with_fault(FaultKind::Stuck);
    assert_eq!([silent, inconsistent, unreliable], [0; 3]);
    assert!(standing > 30_000 && jumped > 0, "{standing} {jumped}");
}

#[test]
fn points_of_a_silent_encoder_are_dropped() {
    let ([silent, jumped, inconsistent, standing], unreliable) = run_with_fault(FaultKind::Silence);
    assert_eq!([jumped, inconsistent, standing, unreliable], [0; 4]);
    assert!((35_000..42_000).contains(&silent), "{silent}");
}

#[test]
fn jumping_encoder_is_reported_and_unreliable() {
    for by_deg in [8.0, -3.0] {
        let ([_, jumped, ..], unreliable) = run_with_fault(FaultKind::Jump(by_deg));
        assert!(jumped > 5_000 && unreliable > 0, "{by_deg}: {jumped} {unreliable}");
    }
}

#[test]
fn drifting_encoder_makes_sweeps_unreliable() {
    for by_deg in [4.0, -2.0] {
        let (points_dropped, unreliable) = run_with_fault(FaultKind::Drift(by_deg));
        assert!(unreliable >= 3, "{by_deg}: {points_dropped:?} {unreliable}");
    }
}

#[test]
fn late_angles_are_awaited_for_a_limited_time() {
    let ([silent, others @ ..], unreliable) = run_with_fault(FaultKind::Delay(0.2));
    // When the delay ends, the last late angles arrive after angles that are in time, so they are dropped.
    assert!(silent < 4_000 && others == [0; 3] && unreliable == 0, "{silent} {others:?} {unreliable}");
    let ([silent, ..], _) = run_with_fault(FaultKind::Delay(1.0));
    assert!(silent > 20_000, "{silent}");
}

#[test]
fn constant_stamp_offset_is_found_and_corrected() {
    for (seed, by_s) in [(0, 0.03), (1, -0.03), (2, 0.1), (3, 0.01)] {
        let fault = Fault { kind: FaultKind::StampDelay(by_s), from_s: 0.0, until_s: f64::INFINITY };
        let world = halls::unchanging(seed).with_mount_faults(&[fault]);
        let (mut sweeps, mut max_error_m) = (0, 0.0_f64);
        let mut hall = Hall::new(&world, seed);
        let counts = hall.play(Settings::default(), 17, |hall, sweep| {
            if sweep.from_ns > seconds(11) {
                sweeps += 1;
                let errors = sweep.points.iter().map(|point| hall.error_m(point));
                max_error_m = errors.fold(max_error_m, f64::max);
            }
        });
        assert!(
            (hall.stamp_delay_ns as f64 / 1e9 - by_s).abs() < 0.001,
            "{by_s} s: {} ns",
            hall.stamp_delay_ns
        );
        assert!(sweeps > 1 && max_error_m < 0.02, "{by_s} s: {max_error_m} m in {sweeps} sweeps");
        assert_eq!(
            (counts.background_resets, counts.unreliable),
            (1, 0),
            "{by_s} s: what was learned until then"
        );
    }
}

#[test]
fn new_stamp_delay_is_corrected_and_background_stays() {
    let fault = Fault { kind: FaultKind::StampDelay(0.03), from_s: 20.0, until_s: f64::INFINITY };
    let world = halls::unchanging(0).with_mount_faults(&[fault]);
    let mut known = 0;
    let mut hall = Hall::new(&world, 0);
    let counts = hall.play(Settings::default(), 40, |_, sweep| {
        let is_known =
            sweep.points.iter().any(|point| point.class == scanhub_perception::tilt::PointClass::Background);
        known += u32::from(sweep.from_ns > seconds(30) && is_known);
        assert!(sweep.is_unreliable || sweep.obstacles.is_empty(), "{:?}", sweep.obstacles);
    });
    assert!((hall.stamp_delay_ns as f64 / 1e6 - 30.0).abs() < 1.0, "{} ns", hall.stamp_delay_ns);
    assert!(
        (1..=5).contains(&counts.unreliable) && counts.background_resets == 0 && known > 2,
        "{counts:?} {known}"
    );
}

#[test]
fn narrow_boards_between_scans_are_no_obstacles() {
    let mut hall = Hall::new(&halls::unchanging(1), 1);
    let until_s = 45 * hall.sweep_ns() / seconds(1);
    hall.play(Settings::default(), until_s, |_, sweep| {
        assert!(sweep.obstacles.is_empty(), "sweep {}: {:?}", sweep.number, sweep.obstacles);
    });
}

#[test]
fn top_that_level_beams_graze_is_no_obstacle() {
    let mut hall = Hall::new(&halls::unchanging(41), 41);
    let until_s = 33 * hall.sweep_ns() / seconds(1);
    hall.play(Settings::default(), until_s, |_, sweep| {
        assert!(sweep.obstacles.is_empty(), "sweep {}: {:?}", sweep.number, sweep.obstacles);
    });
}

#[test]
fn check_finds_the_wall_ahead_between_side_walls() {
    let mut check = scanhub_perception::tilt::MountCheck::default();
    let mut hall = Hall::new(&"tilt".parse().expect("built in"), 1);
    hall.play(Settings::default(), 14, |_, sweep| check.take(sweep));
    let (floor, wall) = (check.floor(&hall.mount).expect("a floor"), check.wall().expect("a wall"));
    assert!(floor.height_m.abs() < 0.01 && floor.level_rad.abs() < 0.002, "{floor:?}");
    assert!(wall.distance_m > 2.0 && wall.lean_rad.abs() < 0.004 && wall.points > 2000, "{wall:?}");
}
