//! Tests that each layer of noise has an effect, and that it has no effect if it is switched off.

use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::room::BeamTarget;
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

use super::{SCAN_PERIOD_NS, scan_at, text, world};

/// A wall 3 m ahead, a post in front of it, a dark board and a far wall.
const TEST_WORLD: &str = "
[[thing]]
line = [[-3000, 3000], [3000, 3000]]
[[thing]]
radius_mm = 60
pose = [500, 1500]
[[thing]]
line = [[-3000, 2900], [-2000, 2900]]
surface = \"dark\"
[[thing]]
line = [[6000, 9000], [9000, 2000]]
";

const NO_NOISE: NoiseModel = NoiseModel::NONE;

/// Returns the values of `count` scans of the test world with the noise `layers`.
fn words(layers: NoiseModel, seed: u64, count: u64) -> Vec<Vec<u16>> {
    let room = Room::new(&world(TEST_WORLD).with_noise(layers), seed);
    (1..=count).map(|scan| scan_at(&room, scan * SCAN_PERIOD_NS).words).collect()
}

/// Returns the deviations of `words` from the ranges without noise, for all beams that have both ranges.
fn deviations_mm(words: &[Vec<u16>]) -> Vec<f64> {
    let exact = &self::words(NO_NOISE, 0, 1)[0];
    let pairs = words.iter().flat_map(|words| words.iter().zip(exact));
    pairs
        .filter(|(word, exact)| **word < 8183 && **exact < 8183)
        .map(|(word, exact)| f64::from(*word) - f64::from(*exact))
        .collect()
}

fn share(values: &[f64], is_counted: impl Fn(f64) -> bool) -> f64 {
    values.iter().filter(|&&value| is_counted(value)).count() as f64 / values.len() as f64
}

#[test]
fn noiseless_words_are_true_ranges() {
    let room = Room::new(&world(TEST_WORLD).with_noise(NO_NOISE), 9);
    for (unit, mm) in [(Unit::Mm, 1.0), (Unit::Cm, 10.0), (Unit::Dm, 100.0)] {
        let words = room.scan(Variant::HALF, unit, Mode(1), SCAN_PERIOD_NS);
        for beam in 180..200 {
            let angle = (f64::from(beam) / 2.0).to_radians();
            assert_eq!(f64::from(words[beam as usize]), (3000.0 / angle.sin() / mm).round(), "beam {beam}");
        }
    }
    assert_eq!(words(NO_NOISE, 1, 3)[0], words(NO_NOISE, 2, 3)[2]);
}

#[test]
fn sigma_is_the_standard_deviation_of_ranges() {
    let deviations = deviations_mm(&words(NoiseModel { sigma_mm: 5.0, ..NO_NOISE }, 1, 100));
    let mean = deviations.iter().sum::<f64>() / deviations.len() as f64;
    let variance = deviations.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / deviations.len() as f64;
    assert!(mean.abs() < 0.2 && (4.8..5.2).contains(&variance.sqrt()), "{mean} {variance}");
    assert!(share(&deviations, |d| d.abs() > 30.0) == 0.0);
}

#[test]
fn bias_is_constant_per_device() {
    let mut met: Vec<i32> = Vec::new();
    for seed in 0..20 {
        let deviations = deviations_mm(&words(NoiseModel { bias_mm: 15.0, ..NO_NOISE }, seed, 2));
        let bias = deviations[0].round();
        assert!(bias.abs() <= 15.0 && deviations.iter().all(|d| (d - bias).abs() <= 1.0), "seed {seed}");
        met.push(bias as i32);
    }
    met.sort_unstable();
    met.dedup();
    assert!(met.len() > 10 && met[0] < -5 && met[met.len() - 1] > 5, "{met:?}");
}

#[test]
fn heavy_tail_occurs_only_at_edges() {
    let exact = &words(NO_NOISE, 1, 1)[0];
    let scans = words(NoiseModel { tail: 0.5, ..NO_NOISE }, 1, 400);
    let ranges = (0..361).filter(|&beam| exact[beam] < 8183);
    let (mut at_edges, mut readings) = (0, Vec::new());
    for beam in ranges {
        let off = |words: &Vec<u16>| f64::from(words[beam]) - f64::from(exact[beam]);
        let off: Vec<f64> = scans.iter().map(off).collect();
        if off.iter().all(|&mm| mm == 0.0) {
            continue;
        }
        let neighbors = beam.saturating_sub(1)..(beam + 2).min(361);
        assert!(
            neighbors.clone().any(|other| exact[other].abs_diff(exact[beam]) > 40),
            "beam {beam} is not at an edge"
        );
        at_edges += 1;
        readings.extend(off);
    }
    assert!((4..30).contains(&at_edges), "{at_edges} beams");
    // About half of these readings have a normal distribution with a standard deviation of 60 mm. In this
    // distribution, 62 % are beyond 30 mm.
    let far = share(&readings, |mm| mm.abs() > 30.0);
    assert!((0.2..0.33).contains(&far), "{far}");
}

/// In a recording of a scanner that stood still for 18 s, a share of .006 of the readings is off by more than 30 mm.
#[test]
fn outliers_are_as_frequent_as_in_recordings() {
    let world: World = "fig8".parse().unwrap();
    let (mut off, mut count) = (0, 0);
    for seed in 0..3 {
        let room = Room::new(&world, seed);
        // Measure only before the first object of this world moves.
        let scans: Vec<_> = (1..300).map(|scan| scan_at(&room, scan * SCAN_PERIOD_NS)).collect();
        for beam in 0..361 {
            let valid = scans.iter().filter(|look| look.truth[beam] != BeamTarget::Invalid);
            let mut ranges: Vec<i32> = valid.map(|look| i32::from(look.words[beam] & 8191)).collect();
            ranges.sort_unstable();
            let Some(&middle) = ranges.get(ranges.len() / 2) else { continue };
            off += ranges.iter().filter(|range| (*range - middle).abs() > 30).count();
            count += ranges.len();
        }
    }
    let share = off as f64 / f64::from(count as u32);
    assert!((0.004..0.012).contains(&share), "{share}");
}

/// Measures a post at 1.5 m in front of a wall that is `depth_mm` behind the post. The post is measured at several
/// positions, so that its edges are anywhere between two beams. Returns the share of the readings around the post that
/// are between post and wall, and the mean standard deviation of such readings at one beam, as a share of the depth.
fn values_between(depth_mm: f64, spot: bool) -> (f64, f64) {
    let (mut all, mut between, mut deviations) = (0, 0, Vec::new());
    for x_mm in 0..26 {
        let text = format!(
            "[[thing]]\nline = [[-3000, {0}], [3000, {0}]]\n[[thing]]\nradius_mm = 60\npose = [{x_mm}, 1560]",
            1_500.0 + depth_mm
        );
        let room = Room::new(&world(&text).with_noise(NoiseModel { spot, ..NO_NOISE }), 1);
        let scans: Vec<Vec<u16>> = (1..=50).map(|scan| scan_at(&room, scan * SCAN_PERIOD_NS).words).collect();
        for beam in 170..191 {
            let ranges = scans.iter().map(|words| f64::from(words[beam]));
            let values: Vec<f64> =
                ranges.filter(|range| (1_600.0..1_450.0 + depth_mm).contains(range)).collect();
            (all, between) = (all + scans.len(), between + values.len());
            if values.len() > 30 {
                let mean = values.iter().sum::<f64>() / values.len() as f64;
                let variance = values.iter().map(|range| (range - mean).powi(2)).sum::<f64>();
                deviations.push((variance / values.len() as f64).sqrt() / depth_mm);
            }
        }
    }
    let deviation = deviations.iter().sum::<f64>() / deviations.len().max(1) as f64;
    (f64::from(between as u32) / all as f64, deviation)
}

#[test]
fn spot_on_two_near_surfaces_gives_a_mixed_range() {
    assert_eq!(values_between(800.0, false).0, 0.0);
    let (share, deviation) = values_between(800.0, true);
    println!("{share:.3} of the beams, with a standard deviation of {deviation:.3} of the depth");
    assert!((0.01..0.1).contains(&share) && (0.005..0.02).contains(&deviation), "{share} {deviation}");
    // Real scanners separate the echoes of surfaces that are farther apart.
    assert_eq!(values_between(1_100.0, true).0, 0.0);
}

#[test]
fn errors_replace_ranges_by_codes_and_nothing_else() {
    let (with, without) = (words(NoiseModel { errors: 0.005, ..NO_NOISE }, 1, 200), words(NO_NOISE, 1, 200));
    let (mut codes, mut ranges) = (0, 0);
    for (with, without) in with.iter().flatten().zip(without.iter().flatten()) {
        if *without < 8183 {
            ranges += 1;
            codes += usize::from(with != without);
            assert!(with == without || [8191, 8187, 8189].contains(with), "{with} for {without}");
        }
    }
    let share = codes as f64 / f64::from(ranges);
    assert!((0.004..0.006).contains(&share), "{share}");
}

#[test]
fn range_beyond_the_maximum_has_its_code() {
    let room = Room::new(&world(TEST_WORLD).with_noise(NO_NOISE), 1);
    // The far wall is at a range of 8.5 m and an angle of 40 degrees.
    assert_eq!(scan_at(&room, SCAN_PERIOD_NS).words[80], 8191 - 8);
    let cm = room.scan(Variant::HALF, Unit::Cm, Mode(1), SCAN_PERIOD_NS);
    assert!((800..950).contains(&cm[80]), "{}", cm[80]);
}

#[test]
fn dark_and_oblique_surfaces_far_away_are_too_weak() {
    let board = (0..361).filter(|beam| (250..265).contains(beam));
    let far = "[[thing]]\nline = [[-20000, 900], [20000, 900]]";
    let range_word = |weak: bool, beam: usize| {
        let world = world(&format!("{TEST_WORLD}{far}")).with_noise(NoiseModel { weak, ..NO_NOISE });
        Room::new(&world, 1).scan(Variant::HALF, Unit::Cm, Mode(1), SCAN_PERIOD_NS)[beam]
    };
    // The beam meets the wall, which is 0.9 m to the side, at an angle of 4 degrees and a range of 12.9 m.
    assert_eq!((range_word(true, 8), range_word(false, 8)), (8187, 1290));
    let dark = "[[thing]]\nline = [[-3000, 7900], [3000, 7900]]\nsurface = \"dark\"";
    let range_word = |weak: bool| {
        let world = world(dark).with_noise(NoiseModel { weak, ..NO_NOISE });
        scan_at(&Room::new(&world, 1), SCAN_PERIOD_NS).words[180]
    };
    assert_eq!((range_word(true), range_word(false)), (7900 + 287, 7900));
    // At a range of three meters, the dark board returns enough light for a range.
    let near = words(NoiseModel { weak: true, ..NO_NOISE }, 1, 1);
    assert!(board.into_iter().all(|beam| near[0][beam] < 8183));
}

#[test]
fn sun_dazzles_its_sector_during_its_time() {
    let text =
        format!("{TEST_WORLD}[[sun]]\nfrom_deg = 0\nto_deg = 5\nfrom_s = 2\nuntil_s = 4\nshare = 0.5\n");
    let dazzled = |dazzle, end_s: u64, beams: std::ops::RangeInclusive<usize>| {
        let room = Room::new(&world(&text).with_noise(NoiseModel { dazzle, ..NO_NOISE }), 1);
        let codes = (0..40).flat_map(|scan| {
            scan_at(&room, end_s * 1_000_000_000 + scan * SCAN_PERIOD_NS).words[beams.clone()].to_vec()
        });
        codes.filter(|&word| word == 8190).count() as f64 / (40.0 * beams.count() as f64)
    };
    assert!((0.4..0.6).contains(&dazzled(true, 2, 180..=190)));
    assert_eq!(dazzled(false, 2, 180..=190), 0.0);
    assert_eq!(
        (dazzled(true, 2, 170..=179), dazzled(true, 0, 180..=190), dazzled(true, 5, 180..=190)),
        (0.0, 0.0, 0.0)
    );
}

/// Even beams are measured in the first of the two revolutions of the mirror, and odd beams in the second one.
#[test]
fn half_degrees_are_measured_one_mirror_turn_later() {
    let (comb, straight) = [true, false]
        .map(|comb| {
            Room::new(&"approach".parse::<World>().unwrap().with_noise(NoiseModel { comb, ..NO_NOISE }), 1)
        })
        .into();
    let half_scan_ns = SCAN_PERIOD_NS / 2;
    let mut moved = 0;
    for end_ns in (15..25).map(|second| second * 1_000_000_000) {
        let combed = scan_at(&comb, end_ns).words;
        let (last, before) =
            (scan_at(&straight, end_ns).words, scan_at(&straight, end_ns - half_scan_ns).words);
        for beam in 0..361 {
            assert_eq!(combed[beam], if beam % 2 == 0 { before[beam] } else { last[beam] }, "beam {beam}");
        }
        moved += (0..361).filter(|&beam| last[beam] != before[beam]).count();
    }
    assert!(moved > 20, "{moved}");
}

/// The level of a beam depends on how much of its light falls on the reflector. A mark that is computed from the levels
/// of neighboring beams is therefore at the middle of the reflector.
#[test]
fn reflectors_have_graded_levels_around_their_middle() {
    let strips = text("strips");
    let mut errors = Vec::new();
    for seed in 0..20 {
        let room = Room::new(&world(&strips), seed);
        let marks = room.marks(SCAN_PERIOD_NS);
        assert_eq!(marks.len(), 12);
        let words = scan_at(&room, SCAN_PERIOD_NS).words;
        for mark in marks {
            let near = |beam: &usize| (*beam as f64 / 2.0 - 90.0 - mark.angle_deg).abs() < 3.0;
            let bright: Vec<usize> = (0..361)
                .filter(near)
                .filter(|&beam| words[beam] >> 13 > 0 && words[beam] & 8191 < 8183)
                .collect();
            let weight: f64 = bright.iter().map(|&beam| f64::from(words[beam] >> 13)).sum();
            let sum: f64 = bright.iter().map(|&beam| f64::from(words[beam] >> 13) * beam as f64 / 2.0).sum();
            assert!(weight > 0.0, "seed {seed}: nothing of {mark:?}");
            assert!(bright.iter().all(|&beam| (f64::from(words[beam] & 8191) - mark.range_mm).abs() < 60.0));
            errors.push(sum / weight - 90.0 - mark.angle_deg);
        }
    }
    let rms = (errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64).sqrt();
    assert!(rms < 0.15, "{rms} degrees");
    eprintln!("strips of 5 cm: {rms:.3} degrees RMS");
}
