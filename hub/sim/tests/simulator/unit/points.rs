//! Tests that compare the points in packets with the true measurements, for each packet format of each model, and tests
//! of properties of a real A1. The packets are decoded here by a slow decoder that follows the published formulas, and
//! not by the decoder of the driver.

use scanhub_schema::Nanos;
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::rplidar::{Model, PacketFormat, RplidarSettings};
use scanhub_sim::world::World;

use super::{Bench, ONE_SECOND, stream_request};

/// A decoded point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct DecodedPoint {
    /// Clockwise angle in degrees, 0 to 360.
    pub(crate) clockwise_deg: f64,
    /// Range in millimeters; 0 means no return.
    pub(crate) range_mm: f64,
    /// Quality, if the packet has one.
    pub(crate) quality: Option<u8>,
    /// Flag of a new revolution. In formats without this flag, it is false.
    pub(crate) starts_revolution: bool,
}

fn word(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn normalize_deg(deg: f64) -> f64 {
    deg.rem_euclid(360.0)
}

/// Decodes a packet of type 0x81.
pub(crate) fn standard(packet: &[u8]) -> DecodedPoint {
    assert_eq!(packet.len(), 5);
    let starts_revolution = packet[0] & 1 == 1;
    assert_eq!(packet[0] & 2 == 2, !starts_revolution, "the flag and its inverse");
    assert_eq!(packet[1] & 1, 1, "the check bit");
    let clockwise_deg = f64::from(word(packet, 1) >> 1) / 64.0;
    DecodedPoint {
        clockwise_deg,
        range_mm: f64::from(word(packet, 3)) / 4.0,
        quality: Some(packet[0] >> 2),
        starts_revolution,
    }
}

/// Returns the points of all packets except the last one. The packets have the response type `answer`.
pub(crate) fn capsules(answer: u8, packets: &[Vec<u8>]) -> Vec<DecodedPoint> {
    packets.windows(2).flat_map(|pair| capsule(answer, &pair[0], &pair[1])).collect()
}

fn capsule(answer: u8, packet: &[u8], next: &[u8]) -> Vec<DecodedPoint> {
    let (len, count, at) = match answer {
        0x82 => (84, 32, 2),
        0x84 => (132, 96, 2),
        0x85 => (84, 40, 2),
        0x86 => (170, 64, 8),
        _ => panic!("{answer:#x}"),
    };
    for packet in [packet, next] {
        assert_eq!(packet.len(), len);
        assert_eq!((packet[0] >> 4, packet[1] >> 4), (0xA, 0x5));
        let sum = packet[2..].iter().fold(0, |sum, byte| sum ^ byte);
        assert_eq!((packet[0] & 15, packet[1] & 15), (sum & 15, sum >> 4));
    }
    let start = |packet: &[u8]| f64::from(word(packet, at) & 0x7FFF) / 64.0;
    let step = normalize_deg(start(next) - start(packet)) / f64::from(count);
    let body = &packet[at + 2..];
    let of = |k: usize| match answer {
        0x82 => {
            let cabin = &body[k / 2 * 5..][..5];
            let value = word(cabin, k % 2 * 2);
            let low = if k.is_multiple_of(2) { cabin[4] & 15 } else { cabin[4] >> 4 };
            let behind = f64::from(u16::from(low) | (value & 3) << 4) / 8.0;
            (f64::from(value >> 2), behind, None)
        }
        0x84 => {
            let range_mm = ultra(body, &next[at + 2..], k);
            (range_mm, angle_correction_deg(range_mm), None)
        }
        0x85 => (f64::from(word(body, 2 * k)), 0.0, None),
        _ => {
            let cabin = &body[k / 2 * 5..][..5];
            let high = if k.is_multiple_of(2) { cabin[4] & 15 } else { cabin[4] >> 4 };
            let value = u32::from(word(cabin, k % 2 * 2)) | u32::from(high) << 16;
            let (range_mm, quality) = match value & 3 {
                0 => (2 * (value >> 2 & 0x3FF), value >> 12),
                1 => (3 * (value >> 2 & 0x7FF) + 2_046, value >> 13 << 1),
                2 => (4 * (value >> 2 & 0xFFF) + 8_187, value >> 14 << 2),
                _ => (5 * (value >> 2 & 0x1FFF) + 24_567, value >> 15 << 3),
            };
            (f64::from(range_mm), 0.0, Some(quality as u8))
        }
    };
    let point = |k: usize| {
        let (range_mm, behind, quality) = of(k);
        DecodedPoint {
            clockwise_deg: normalize_deg(start(packet) + step * k as f64 - behind),
            range_mm,
            quality,
            starts_revolution: false,
        }
    };
    (0..count as usize).map(point).collect()
}

/// Decodes the range with index `k` in a packet of 32 words, in millimeters.
fn ultra(body: &[u8], next: &[u8], k: usize) -> f64 {
    let at = |cabin: usize| if cabin < 32 { &body[4 * cabin..] } else { next };
    let bits = |cabin: usize| u32::from_le_bytes(at(cabin)[..4].try_into().expect("four bytes"));
    let major = |cabin: usize| {
        let v = (bits(cabin) & 0xFFF) as i32;
        match v {
            3_328.. => ((1 << 14) + 16 * (v - 3_328), 4),
            1_792.. => ((1 << 12) + 8 * (v - 1_792), 3),
            1_280.. => ((1 << 11) + 4 * (v - 1_280), 2),
            512.. => ((1 << 9) + 2 * (v - 512), 1),
            _ => (v, 0),
        }
    };
    let cabin = k / 3;
    let (here, there) = (major(cabin), major(cabin + 1));
    let signed = |shift: u32| ((bits(cabin) >> shift) as i32) << 22 >> 22;
    let predict = |steps: i32, (base, level): (i32, u32)| match steps {
        -512 | 511 => 0,
        _ => base + (steps << level),
    };
    f64::from(match k % 3 {
        0 => here.0,
        1 => predict(signed(12), if here.0 == 0 { there } else { here }),
        _ => predict(signed(22), there),
    })
}

/// Returns the angle in degrees by which the vendor's decoder of type 0x84 corrects the angle of a point at `mm`
/// millimeters.
fn angle_correction_deg(mm: f64) -> f64 {
    if mm < 50.0 {
        return 7.5;
    }
    let k = (98_361.0 / (4.0 * mm)).floor();
    8.0 - (k / 1_024.0).to_degrees() - (k * k * k / 6_442_450_944.0).to_degrees()
}

/// Returns a world without noise.
fn noiseless_world(world: &str) -> World {
    world.parse::<World>().expect("a world").with_noise(NoiseModel::NONE)
}

/// Streams in mode number `mode` for `span` in `world`. Returns the points that the scanner sent.
fn stream_points(
    settings: RplidarSettings,
    mode: usize,
    world: &World,
    span: Nanos,
) -> (Bench, Vec<DecodedPoint>) {
    let model = settings.model;
    let mut bench = Bench::new(settings, world, "");
    // Some motors start only after this request.
    bench.ask(&[0xA5, 0xF0, 0x02, 0x94, 0x02, 0xC1]);
    bench.ask(&stream_request(mode));
    bench.run_for(2 * ONE_SECOND + span);
    let data = bench.data();
    let points = match model.modes()[mode].form {
        PacketFormat::Standard => data.iter().map(|packet| standard(packet)).collect(),
        form => capsules(form.response_type(), &data),
    };
    assert_eq!(bench.unit.mode(), Some(model.modes()[mode]));
    (bench, points)
}

/// Returns the angle from `b` to `a` in degrees, -180 to 180.
fn difference_deg(a: f64, b: f64) -> f64 {
    (a - b + 540.0).rem_euclid(360.0) - 180.0
}

#[test]
fn every_point_of_every_mode_matches_its_truth() {
    for model in Model::ALL {
        for (number, mode) in model.modes().iter().enumerate() {
            let (mut bench, points) =
                stream_points(RplidarSettings::of(model), number, &noiseless_world("corridor"), ONE_SECOND);
            let begin = bench.unit.begin_ns().expect("it streams");
            let seconds = (bench.now - begin) as f64 / 1e9;
            let due = seconds * 1e6 / mode.sample_us;
            assert!((points.len() as f64 / due - 1.0).abs() < 0.05, "{model:?} {number}: {}", points.len());
            // Maximum errors of angle and range that result from rounding in this format.
            let (deg, mm) = match mode.form {
                PacketFormat::Standard => (0.01, 0.6),
                PacketFormat::Express => (0.08, 0.8),
                PacketFormat::Ultra => (0.08, 8.6),
                PacketFormat::Dense => (0.02, 0.6),
                PacketFormat::UltraDense => (0.02, 4.6),
            };
            let (mut ranges, mut edges) = (0, 0);
            for (k, point) in points.iter().enumerate() {
                let truth = bench.unit.truth(k as u64).expect("it streams");
                if point.range_mm == 0.0 {
                    continue;
                }
                let range = truth.range_mm.expect("something is there");
                ranges += 1;
                // The decoder computes the shift from the range. If a coarse range is near a step of the shift, the
                // decoded angle is off by this step.
                let is_off = difference_deg(point.clockwise_deg, truth.clockwise_deg).abs() > deg;
                edges += usize::from(is_off);
                assert!(
                    !is_off || mode.form == PacketFormat::Ultra,
                    "{model:?} {mode:?} {k}: {point:?} {truth:?}"
                );
                assert!((point.range_mm - range).abs() < mm, "{model:?} {mode:?} {k}: {point:?} {truth:?}");
                assert!(point.quality != Some(0));
            }
            assert!(edges * 100 <= ranges, "{model:?} {mode:?}: {edges} of {ranges}");
            assert!(ranges * 2 > points.len(), "{model:?} {mode:?}: {ranges} of {}", points.len());
            assert_eq!(scanhub_sim::device::Device::eeprom_writes(&bench.unit), 0);
        }
    }
}

#[test]
fn simulated_a1_points_match_a_real_a1() {
    let (mut in_all, mut invalid, mut backward, mut counts, mut flags) = (0, 0, 0, Vec::new(), Vec::new());
    for seed in 0..4 {
        let settings = RplidarSettings { seed, ..RplidarSettings::of(Model::A1) };
        let (_, points) = stream_points(settings, 0, &"demo".parse().expect("a world"), 10 * ONE_SECOND);
        in_all += points.len();
        invalid += points.iter().filter(|point| point.quality == Some(0)).count();
        assert!(points.iter().all(|point| (point.quality == Some(0)) == (point.range_mm == 0.0)));
        backward += points
            .windows(2)
            .filter(|pair| difference_deg(pair[1].clockwise_deg, pair[0].clockwise_deg) < 0.0)
            .count();
        let starts: Vec<usize> = (0..points.len()).filter(|&k| points[k].starts_revolution).collect();
        counts.extend(starts.windows(2).map(|pair| pair[1] - pair[0]));
        flags.extend(starts.iter().map(|&k| points[k].clockwise_deg));
    }
    println!(
        "{in_all} points: {:.1} % invalid, {:.1} % backward",
        share(invalid, in_all),
        share(backward, in_all)
    );
    counts.sort_unstable();
    flags.sort_unstable_by(f64::total_cmp);
    println!(
        "{}..{} per revolution, flag at {:.1}..{:.1}",
        counts[0],
        counts[counts.len() - 1],
        flags[0],
        flags[flags.len() - 1]
    );
    assert!((61.0..84.0).contains(&share(invalid, in_all)));
    assert!((9.0..15.0).contains(&share(backward, in_all)));
    // A real A1 had 264 to 267 points per revolution.
    assert!(counts[0] >= 263 && counts[counts.len() - 1] <= 268 && counts[0] + 2 <= counts[counts.len() - 1]);
    // If a person stands at an angle just below zero, the first point of a revolution is at an angle above zero.
    let usual = flags.iter().filter(|deg| (351.0..=359.5).contains(*deg)).count();
    assert!(share(usual, flags.len()) > 97.0, "{usual} of {}", flags.len());
}

fn share(part: usize, of: usize) -> f64 {
    100.0 * part as f64 / of as f64
}

#[test]
fn points_depend_only_on_the_seed() {
    let world: World = "demo".parse().expect("a world");
    let points_of = |seed| {
        let settings = RplidarSettings { seed, ..RplidarSettings::of(Model::A1) };
        stream_points(settings, 1, &world, ONE_SECOND).1
    };
    let points = points_of(5);
    assert!(points == points_of(5) && points != points_of(6));
}
