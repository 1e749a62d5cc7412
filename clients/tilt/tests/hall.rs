//! A scanner on a mount in a simulated hall: points, background and obstacles against what is true there, and angles that
//! stop, jump, lie and come late.

#[path = "../examples/figures/hall.rs"]
mod hall;
#[path = "../examples/figures/judge.rs"]
mod judge;

use hall::Hall;
use judge::{Score, Seen, seconds};
use sim::mount::FaultKind;
use sim::world::World;
use tilt::{Settings, Withheld};

#[test]
fn people_a_pole_and_a_box_are_found_and_melt_into_the_background() {
    let settings = Settings::default();
    let mut score = Score::default();
    let mut seen = Seen::default();
    let counts = Hall::new(&"tilt".parse().expect("built in"), 1).play(settings, 52, |hall, sweep| {
        seen.add(sweep);
        let is_known = sweep.from_ns > seconds(10) && sweep.until_ns < seconds(24);
        assert!(!is_known || sweep.obstacles.is_empty(), "nothing is new yet: {:?}", sweep.obstacles);
        if sweep.until_ns > seconds(20) {
            score.add(hall, sweep, &settings, judge::SWEEP_NS);
        }
    });
    assert_eq!(counts.withheld.iter().sum::<u64>() + counts.doubted + counts.forgotten, 0, "{counts:?}");
    assert!(seen.is_pole_found_at_once(), "{seen:?}");
    assert!(seen.sweeps_of_pole() >= 4 && seen.sweeps_of_pole() <= 7, "{seen:?}");
    assert!(seen.sweeps_of_box() >= 4 && seen.sweeps_of_box() <= 7, "{seen:?}");
    assert!(score.persons.0 > 2000 && score.things.0 > 1000, "{score:?}");
    assert!(score.recall() > 0.95 && score.precision() > 0.97, "{score:?}");
}

/// What a fault from 7 to 10 s makes of a room in which nothing is new: what was withheld by reason, and doubted. No obstacle
/// is invented, no point that is handed out for good is wrong, and afterwards all is as before.
fn of(kind: FaultKind) -> ([u64; Withheld::COUNT], u64) {
    let room = "[[thing]]\nline = [[-2500, -1000], [2500, -1000], [2500, 4000], [-2500, 4000], [-2500, -1000]]\n\
                [[thing]]\nbox = [600, 400]\nheight_mm = 350\npose = [-900, 2200, 35]\n";
    let mount = "[sensor.mount]\nheight_mm = 900\narm_mm = [60, 40]\nfrom_deg = 0\nto_deg = 30\n";
    let text = format!("[[sensor]]\npose = [0, 0, 90]\n{mount}[noise]\nbias_mm = 0\n{room}");
    let settings = Settings { sweeps: 3, ..Settings::default() };
    let fault = sim::mount::Fault { kind, from_s: 7.0, until_s: 10.0 };
    let world = World::of_toml("room", &text).unwrap_or_else(|failure| panic!("{failure}"));
    let world = world.with_mount_faults(&[fault]);
    let mut healthy = 0;
    let counts = Hall::new(&world, 2).play(settings, 17, |hall, sweep| {
        let wrong = sweep.points.iter().map(|point| hall.error_m(point)).fold(0.0, f64::max);
        let [from, until] = [sweep.from_ns, sweep.until_ns].map(|ns| ns as f64 / 1e9);
        assert!(sweep.is_doubted || wrong < 0.03, "{kind:?}, {from} to {until} s: {wrong} m");
        assert!(sweep.obstacles.is_empty(), "{kind:?}, {from} to {until} s: {:?}", sweep.obstacles);
        healthy += u32::from(from > 11.5 && sweep.is_complete && !sweep.is_doubted);
    });
    assert!(healthy >= 4, "{kind:?}: {healthy}, {counts:?}");
    (counts.withheld, counts.doubted)
}

#[test]
fn a_mount_that_halts_is_told_and_makes_no_points() {
    let ([silent, jumped, inconsistent, standing], doubted) = of(FaultKind::Halts);
    assert_eq!([silent, jumped, inconsistent, doubted], [0; 4]);
    // As long as it stands, and no longer.
    assert!((35_000..42_000).contains(&standing), "{standing}");
}

#[test]
fn an_encoder_that_hangs_is_told_and_makes_no_points() {
    let ([silent, jumped, inconsistent, standing], doubted) = of(FaultKind::Stuck);
    assert_eq!([silent, inconsistent, doubted], [0; 3]);
    assert!(standing > 30_000 && jumped > 0, "{standing} {jumped}");
}

#[test]
fn a_silent_encoder_is_told_and_makes_no_points() {
    let ([silent, jumped, inconsistent, standing], doubted) = of(FaultKind::Silent);
    assert_eq!([jumped, inconsistent, standing, doubted], [0; 4]);
    assert!((35_000..42_000).contains(&silent), "{silent}");
}

#[test]
fn an_encoder_that_jumps_is_told_and_what_it_says_then_is_doubted() {
    for by_deg in [8.0, -3.0] {
        let ([_, jumped, ..], doubted) = of(FaultKind::Jumps(by_deg));
        assert!(jumped > 5_000 && doubted > 0, "{by_deg}: {jumped} {doubted}");
    }
}

#[test]
fn an_encoder_that_lies_is_doubted() {
    for by_deg in [4.0, -2.0] {
        let (withheld, doubted) = of(FaultKind::Lies(by_deg));
        assert!(doubted >= 3, "{by_deg}: {withheld:?} {doubted}");
    }
}

#[test]
fn angles_that_come_late_are_waited_for_but_not_for_ever() {
    let ([silent, others @ ..], doubted) = of(FaultKind::Late(0.2));
    // When they come in time again, the last late ones come after them.
    assert!(silent < 4_000 && others == [0; 3] && doubted == 0, "{silent} {others:?} {doubted}");
    let ([silent, ..], _) = of(FaultKind::Late(1.0));
    assert!(silent > 20_000, "{silent}");
}
