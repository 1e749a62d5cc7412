//! Points beside what was measured: each form of packet of each model, and what is odd about an A1.

use scanhub_schema::Nanos;
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::rplidar::{Form, Model, RplidarSettings};
use scanhub_sim::world::World;

use super::bench::{Bench, SECOND, start};
use super::decode::{Point, capsules, standard};

/// A room, without noise.
fn still(world: &str) -> World {
    world.parse::<World>().expect("a world").with_noise(NoiseModel::NONE)
}

/// Streams in mode `mode` for `span` in `world`; the points that were sent.
fn streamed(settings: RplidarSettings, mode: usize, world: &World, span: Nanos) -> (Bench, Vec<Point>) {
    let model = settings.model;
    let mut bench = Bench::new(settings, world, "");
    // Those whose motor rests until it is told.
    bench.ask(&[0xA5, 0xF0, 0x02, 0x94, 0x02, 0xC1]);
    bench.ask(&start(mode));
    bench.pass(2 * SECOND + span);
    let data = bench.data();
    let points = match model.modes()[mode].form {
        Form::Standard => data.iter().map(|packet| standard(packet)).collect(),
        form => capsules(form.answer(), &data),
    };
    assert_eq!(bench.unit.mode(), Some(model.modes()[mode]));
    (bench, points)
}

/// Degrees from `b` to `a`, -180 to 180.
fn off(a: f64, b: f64) -> f64 {
    (a - b + 540.0).rem_euclid(360.0) - 180.0
}

#[test]
fn every_point_of_every_mode_of_every_model_is_where_it_was_measured() {
    for model in Model::ALL {
        for (number, mode) in model.modes().iter().enumerate() {
            let (mut bench, points) =
                streamed(RplidarSettings::of(model), number, &still("corridor"), SECOND);
            let begin = bench.unit.begin_ns().expect("it streams");
            let seconds = (bench.now - begin) as f64 / 1e9;
            let due = seconds * 1e6 / mode.sample_us;
            assert!((points.len() as f64 / due - 1.0).abs() < 0.05, "{model:?} {number}: {}", points.len());
            // What the angle and the range lose by their bits.
            let (deg, mm) = match mode.form {
                Form::Standard => (0.01, 0.6),
                Form::Express => (0.08, 0.8),
                Form::Ultra => (0.08, 8.6),
                Form::Dense => (0.02, 0.6),
                Form::UltraDense => (0.02, 4.6),
            };
            let (mut ranges, mut edges) = (0, 0);
            for (k, point) in points.iter().enumerate() {
                let truth = bench.unit.truth(k as u64).expect("it streams");
                if point.mm == 0.0 {
                    continue;
                }
                let range = truth.range_mm.expect("something is there");
                ranges += 1;
                // Where a coarse range is near a step of the shift, the decoder's angle is one step off.
                let is_off = off(point.deg, truth.clockwise_deg).abs() > deg;
                edges += usize::from(is_off);
                assert!(!is_off || mode.form == Form::Ultra, "{model:?} {mode:?} {k}: {point:?} {truth:?}");
                assert!((point.mm - range).abs() < mm, "{model:?} {mode:?} {k}: {point:?} {truth:?}");
                assert!(point.quality != Some(0));
            }
            assert!(edges * 100 <= ranges, "{model:?} {mode:?}: {edges} of {ranges}");
            assert!(ranges * 2 > points.len(), "{model:?} {mode:?}: {ranges} of {}", points.len());
            assert_eq!(scanhub_sim::device::Device::eeprom_writes(&bench.unit), 0);
        }
    }
}

#[test]
fn an_a1_indoors_is_as_odd_as_a_real_one() {
    let (mut in_all, mut invalid, mut backward, mut counts, mut flags) = (0, 0, 0, Vec::new(), Vec::new());
    for seed in 0..4 {
        let settings = RplidarSettings { seed, ..RplidarSettings::of(Model::A1) };
        let (_, points) = streamed(settings, 0, &"demo".parse().expect("a world"), 10 * SECOND);
        in_all += points.len();
        invalid += points.iter().filter(|point| point.quality == Some(0)).count();
        assert!(points.iter().all(|point| (point.quality == Some(0)) == (point.mm == 0.0)));
        backward += points.windows(2).filter(|pair| off(pair[1].deg, pair[0].deg) < 0.0).count();
        let turns: Vec<usize> = (0..points.len()).filter(|&k| points[k].begins).collect();
        counts.extend(turns.windows(2).map(|pair| pair[1] - pair[0]));
        flags.extend(turns.iter().map(|&k| points[k].deg));
    }
    println!(
        "{in_all} points: {:.1} % invalid, {:.1} % backward",
        share(invalid, in_all),
        share(backward, in_all)
    );
    counts.sort_unstable();
    flags.sort_unstable_by(f64::total_cmp);
    println!(
        "{}..{} a turn, flag at {:.1}..{:.1}",
        counts[0],
        counts[counts.len() - 1],
        flags[0],
        flags[flags.len() - 1]
    );
    assert!((61.0..84.0).contains(&share(invalid, in_all)));
    assert!((9.0..15.0).contains(&share(backward, in_all)));
    // Of a real one 264 to 267 were counted.
    assert!(counts[0] >= 263 && counts[counts.len() - 1] <= 268 && counts[0] + 2 <= counts[counts.len() - 1]);
    // Where somebody stands right before it, it comes behind zero.
    let usual = flags.iter().filter(|deg| (351.0..=359.5).contains(*deg)).count();
    assert!(share(usual, flags.len()) > 97.0, "{usual} of {}", flags.len());
}

fn share(part: usize, of: usize) -> f64 {
    100.0 * part as f64 / of as f64
}

#[test]
fn the_same_seed_says_the_same_and_another_another() {
    let world: World = "demo".parse().expect("a world");
    let said = |seed| {
        let settings = RplidarSettings { seed, ..RplidarSettings::of(Model::A1) };
        streamed(settings, 1, &world, SECOND).1
    };
    let points = said(5);
    assert!(points == said(5) && points != said(6));
}
