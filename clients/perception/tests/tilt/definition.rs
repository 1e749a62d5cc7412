//! Comparison of points with their definition. The test calculates each point again from all scans and the complete
//! list of angles, with quaternions.

use std::collections::BTreeMap;

use scanhub_perception::tilt::{Angle, Mount, Settings, TiltScanner};
use scanhub_schema::{Scan, ScanHead};

const MS: u64 = 1_000_000;

/// Rotates `v` by the quaternion `q`, whose components are w, x, y and z.
fn rotate(q: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    let times = |a: [f64; 4], b: [f64; 4]| {
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    };
    let [_, x, y, z] = times(times(q, [0.0, v[0], v[1], v[2]]), [q[0], -q[1], -q[2], -q[3]]);
    [x, y, z]
}

fn point(mount: &Mount, angle_rad: f64, beam_rad: f64, range_m: f64) -> [f64; 3] {
    let half = (angle_rad - mount.level_rad) / 2.0;
    let [x, y, z] = mount.axis.map(|value| value * half.sin());
    let q = [half.cos(), x, y, z];
    let sign = if mount.is_upside_down { -1.0 } else { 1.0 };
    let (sin, cos) = (mount.yaw_rad + sign * beam_rad).sin_cos();
    let end: [f64; 3] =
        std::array::from_fn(|i| mount.sensor_at[i] - mount.axis_at[i] + range_m * [cos, sin, 0.0][i]);
    let end = rotate(q, end);
    std::array::from_fn(|i| mount.axis_at[i] + end[i])
}

#[test]
fn point_positions_match_the_reference() {
    for seed in 0..8 {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut draw = |maximum: f64| maximum * (2.0 * random.f64() - 1.0);
        let mount = Mount {
            axis_at: [draw(0.3), draw(0.3), 1.0 + draw(0.3)],
            axis: if seed % 2 == 0 { [0.0, 1.0, 0.0] } else { [0.6, -0.8, 0.0] },
            level_rad: draw(0.2),
            sensor_at: [draw(0.3), draw(0.3), 1.0 + draw(0.3)],
            yaw_rad: draw(3.0),
            is_upside_down: seed % 3 == 0,
        };
        // The mount moves up and down at 40 degrees per second, and reports its angle every 5 to 25 ms.
        let swing = |ms: f64| (20.0 - ((ms / 1000.0) % 2.0 - 1.0).abs() * 40.0).to_radians();
        let mut angles: Vec<(u64, f64)> = vec![(0, swing(0.0))];
        while angles[angles.len() - 1].0 < 6000 * MS {
            let at = angles[angles.len() - 1].0 + (15.0 + draw(10.0)) as u64 * MS;
            angles.push((at, swing(at as f64 / 1e6)));
        }
        let head = ScanHead::lms(361, -90_000, 500, 1, 13);
        let scans: Vec<(u64, Box<Scan>)> = (1..210)
            .map(|number| {
                let ranges: Vec<u16> = (0..361).map(|_| (3000.0 + draw(2500.0)) as u16).collect();
                (number * 26_640_000, Scan::of(head, &ranges))
            })
            .collect();
        let mut expected = BTreeMap::new();
        for (stamp, scan) in &scans {
            for beam in 0..361 {
                let at = stamp.saturating_add_signed(scan.beam_ns(beam));
                let later = angles.iter().filter(|(ns, _)| *ns >= at).min_by_key(|(ns, _)| *ns);
                let earlier = angles.iter().filter(|(ns, _)| *ns < at).max_by_key(|(ns, _)| *ns);
                let (Some(&(t1, a1)), Some(&(t0, a0))) = (later, earlier) else { continue };
                let angle = a0 + (a1 - a0) * (at - t0) as f64 / (t1 - t0) as f64;
                let range_m = scan.distance_m(beam).expect("all are");
                expected.insert((at, beam as u16), point(&mount, angle, scan.angle(beam), range_m));
            }
        }
        let mut tilting = TiltScanner::new(mount, Settings::default());
        let mut made = 0;
        let mut check = |sweep: &scanhub_perception::tilt::Sweep<'_>| {
            for point in sweep.points {
                let target = expected[&(point.stamp_ns, point.beam)];
                let off = (0..3).map(|i| (target[i] - f64::from(point.at[i])).abs()).fold(0.0, f64::max);
                assert!(off < 1e-5, "seed {seed}: {off} m");
                assert!(point.stamp_ns <= sweep.until_ns && point.stamp_ns >= sweep.from_ns);
                made += 1;
            }
        };
        let mut angles = angles.iter().peekable();
        for (stamp, scan) in &scans {
            while let Some(&(stamp_ns, angle_rad)) = angles.next_if(|(ns, _)| ns < stamp) {
                tilting.take_angle(Angle { stamp_ns, angle_rad, rate_rad_s: f64::NAN }, &mut check);
            }
            tilting.take_scan(*stamp, scan, &mut check);
        }
        // The last sweep has no end, so its points are missing.
        assert!(made > 4 * 13_000 && made <= expected.len(), "seed {seed}: {made} of {}", expected.len());
        assert_eq!((tilting.counts().points_dropped, tilting.problem()), ([0; 4], None), "seed {seed}");
    }
}
