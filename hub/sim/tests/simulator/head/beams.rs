//! The number of beams of a scanner whose model is not configured: as many as it measures points per revolution, whatever
//! happens to its power.

use scanhub_drivers::Settings;
use scanhub_drivers::ld::{Model, Session, Trouble};
use scanhub_drivers::line::Session as _;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::ld::LdSettings;

use super::bench::{Bench, still};

const SECOND: Nanos = 1_000 * MILLIS;
const SPIN_UPS: [f64; 4] = [0.0, 0.5, 1.5, 3.0];

/// A scanner and a session that does not know its model.
fn bench(settings: LdSettings, seed: u64) -> Bench {
    let mut bench = Bench::new(LdSettings { seed, ..settings }, &still("wall640"), "", seed);
    bench.session = Session::new(Settings::default(), 0);
    bench
}

/// Different numbers of beams of the revolutions, in their order.
fn numbers_of_beams(bench: &Bench) -> Vec<usize> {
    let mut numbers: Vec<usize> = bench.turns.iter().map(|turn| turn.beams).collect();
    numbers.dedup();
    numbers
}

#[test]
fn a_power_cycle_does_not_change_the_number_of_beams() {
    for model in Model::ALL {
        for spin_up_s in SPIN_UPS {
            for seed in 0..2 {
                let mut bench = bench(LdSettings { spin_up_s, ..LdSettings::of(model) }, seed);
                bench.run(3 * SECOND);
                for cycle in 1..=2 {
                    let before = bench.turns.len();
                    bench.cycle_power();
                    bench.run((3 + 20 * cycle) * SECOND);
                    assert!(bench.turns.len() > before + 50, "{model:?} {spin_up_s}: streams again");
                }
                assert_eq!(numbers_of_beams(&bench), [model.beams()], "{model:?} {spin_up_s}, seed {seed}");
                assert_eq!(
                    (bench.session.model().map(Model::beams), bench.session.trouble()),
                    (Some(model.beams()), None)
                );
            }
        }
    }
}

#[test]
fn a_scanner_that_gets_power_later_has_its_beams_from_the_first_scan_on() {
    for model in Model::ALL {
        for spin_up_s in SPIN_UPS {
            for seed in 0..2 {
                let mut bench = bench(LdSettings { spin_up_s, ..LdSettings::of(model) }, seed);
                bench.cycle_power();
                bench.run(20 * SECOND);
                assert_eq!(numbers_of_beams(&bench), [model.beams()], "{model:?} {spin_up_s}, seed {seed}");
            }
        }
    }
}

#[test]
fn beams_are_the_points_that_a_revolution_has() {
    let sold = LdSettings { points_per_second: 5_000.0, ..LdSettings::of(Model::Stl19p) };
    let slow = LdSettings { turns_per_second: 4.0, ..LdSettings::of(Model::Ld14p) };
    for (settings, beams) in [(sold, 500), (slow, 1_000)] {
        for seed in 0..2 {
            let mut bench = bench(settings, seed);
            bench.run(10 * SECOND);
            let numbers = numbers_of_beams(&bench);
            assert!(numbers.len() == 1 && numbers[0].abs_diff(beams) * 100 <= beams, "{numbers:?}");
            // A configured number stays.
            let configured = Settings { beams: Some(300), ..Settings::default() };
            let mut bench = self::bench(settings, seed);
            bench.session = Session::new(configured, 0);
            bench.run(5 * SECOND);
            assert_eq!(numbers_of_beams(&bench), [300]);
        }
    }
}

#[test]
fn another_speed_changes_the_beams_after_ten_seconds_and_says_so() {
    let mut bench = bench(LdSettings::of(Model::Ld19), 1);
    bench.run(3 * SECOND);
    for (speed, span) in [(8.0, 5), (10.0, 5), (8.0, 25)] {
        bench.head.set_speed(speed);
        let end = bench.now + span * SECOND;
        bench.run(end);
    }
    let numbers = numbers_of_beams(&bench);
    assert!(numbers.len() == 2 && numbers[0] == 450 && numbers[1].abs_diff(562) < 8, "{numbers:?}");
    let trouble = bench.session.trouble().expect("reported");
    assert_eq!(trouble, Trouble::BeamsChanged { from: 450, to: numbers[1] });
    assert!(trouble.to_string().contains("instead of 450"));
}

#[test]
fn a_typical_scanner_has_its_beams_within_a_revolution() {
    for model in Model::ALL.into_iter().filter(|model| model.baud() == 230_400) {
        let mut bench = bench(LdSettings::of(model), 1);
        bench.run(SECOND);
        assert_eq!(numbers_of_beams(&bench), [model.beams()]);
        let revolution = SECOND / Nanos::from(model.turns_per_second());
        assert!(bench.turns[0].first < revolution + 100 * MILLIS, "{model:?}");
    }
}
