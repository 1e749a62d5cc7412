//! Invariants for the processors that track the robot's motion: line features, motion, and the background of a moving
//! robot. No estimated variance is smaller than the readings permit.

use scanhub_preprocess::background::{BackgroundModel, Candidate, Class, Method, Settings, Start};
use scanhub_preprocess::lines::{self, LineFinder, StopCriterion};
use scanhub_preprocess::motion::{self, MotionEstimator};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{ArrayFlags, Foreground, Lines, MAX_BEAMS, Motion, MotionMethod, Scan};

use super::scans::{Bytes, fill, layout};

/// Reads settings from `data`, and then processes one scan after another until no bytes are left.
pub(super) fn surroundings(data: &[u8]) {
    let mut bytes = Bytes(data);
    let maximum = TopicLimits::default().beams;
    let mut pose = bytes.pose();
    let of_lines = lines::Settings {
        max: 1 + bytes.u8() % 64,
        min_points: 3 + u16::from(bytes.u8() % 16),
        refine: bytes.u8() % 4 == 0,
        stop: StopCriterion::Likelihood,
    };
    let of_motion = motion::Settings {
        max_step_m: 0.01 + f64::from(bytes.u8()) / 100.0,
        max_turn_deg: 1.0 + f64::from(bytes.u8() % 85),
        min_overlap: 0.1 + f64::from(bytes.u8() % 91) / 100.0,
    };
    let mut finder = LineFinder::new(pose, of_lines, maximum);
    let mut estimator = MotionEstimator::new(pose, of_motion, maximum);
    let mut model = BackgroundModel::new(MAP_SETTINGS, maximum);
    let mut foreground = Foreground::of(maximum);
    let mut scan = Scan::zeroed(Scan::len(MAX_BEAMS, ArrayFlags::ALL));
    let (mut before, mut stamp_ns) = (Motion::default(), 0);
    for _ in 0..SCANS {
        if bytes.is_empty() {
            break;
        }
        // If the value is larger than those of the cases below, the previous scan is processed again.
        let what = bytes.u8();
        match what {
            0..=3 => estimator.reset(),
            4..=7 => {
                pose = bytes.pose();
                finder.change(pose, of_lines);
                estimator.change(pose, of_motion);
            }
            8..=63 => layout(&mut bytes, &mut scan),
            _ => {}
        }
        match what {
            64..=127 => walls(&mut bytes, &mut scan),
            128..=191 => {}
            _ => fill(&mut bytes, &mut scan),
        }
        let mut lines = Lines::default();
        finder.update(&scan, &mut lines);
        assert_lines(&scan, &lines, &of_lines);
        let mut motion = Motion::default();
        stamp_ns += 1_000_000 * u64::from(bytes.u8());
        let period_ns = 1_000_000 * u64::from(bytes.u8() % 64);
        estimator.update(&scan, stamp_ns, period_ns, &mut motion);
        assert_motion(&scan, &before, &motion, &of_motion);
        before = motion;
        model.set_motion(&pose, &motion, &estimator.velocity());
        model.update(&scan, &mut foreground);
        assert!(foreground.readings().all(|(beam, range)| scan.range(beam) == Some(range)));
        if !motion.has_pose() {
            assert!(model.classes().iter().all(|class| matches!(class, Class::Unknown | Class::Invalid)));
        }
    }
}

fn assert_lines(scan: &Scan, lines: &Lines, settings: &lines::Settings) {
    let payload = &mut [0; 4096];
    let len = lines.pack(payload).expect("the greatest one is shorter");
    assert!(Lines::room(&payload[..len]).is_some(), "{lines:?}");
    let found = lines.lines();
    assert!(lines.count <= settings.max && usize::from(lines.readings) <= scan.beams());
    assert_eq!(found.iter().map(|line| line.points).sum::<u16>(), lines.on_lines);
    assert!(lines.on_lines <= lines.readings);
    assert!(found.is_sorted_by(|one, next| one.last < next.first));
    assert!(found.last().is_none_or(|line| usize::from(line.last) < scan.beams()));
    for line in found {
        assert!(line.points >= settings.min_points && line.last - line.first + 1 >= line.points);
        assert!(line.sd_r_m >= 0.0 && line.sd_alpha_rad > 0.0, "{line:?}");
    }
}

fn assert_motion(scan: &Scan, before: &Motion, motion: &Motion, settings: &motion::Settings) {
    let place = [motion.x_m, motion.y_m, motion.yaw_rad];
    let step = [motion.dx_m, motion.dy_m, motion.dyaw_rad];
    assert!(place.iter().all(|number| number.is_finite()), "{motion:?}");
    let numbers = step.iter().chain(&motion.covariance).chain(&motion.pose_covariance);
    assert!({ numbers }.all(|number| number.is_finite()), "{motion:?}");
    assert!([0, 4, 8].iter().all(|at| motion.pose_covariance[*at] >= 0.0), "{motion:?}");
    assert!(motion.has_valid_pose() || motion.pose_covariance == [0.0; 9], "{motion:?}");
    match motion.method() {
        MotionMethod::First => assert_eq!(*motion, Motion::default()),
        MotionMethod::Refused => {
            let refused_steps = before.refused_steps.saturating_add(1);
            let method = MotionMethod::Refused as u8;
            assert_eq!(*motion, Motion { method, refused_steps, ..Motion::default() });
        }
        _ => {
            let [x, y, yaw] = step.map(f64::from);
            assert!(x.hypot(y) <= settings.max_step_m + 1e-6, "{motion:?}");
            assert!(yaw.abs() <= settings.max_turn_deg.to_radians() + 1e-6, "{motion:?}");
            assert!(motion.overlap >= settings.min_overlap as f32 && motion.overlap <= 1.0, "{motion:?}");
            assert_eq!(motion.refused_steps, before.refused_steps);
            let of = |row: usize, column: usize| f64::from(motion.covariance[3 * row + column]);
            for (row, column) in [(0, 1), (0, 2), (1, 2)] {
                let maximum = (of(row, row) * of(column, column)).sqrt();
                assert!((of(row, column) - of(column, row)).abs() <= 1e-5 * maximum, "{motion:?}");
                assert!(of(row, column).abs() <= (1.0 + 1e-5) * maximum, "{motion:?}");
            }
            // The variance that the estimate would have if all beams measured the same wall and nothing else were
            // uncertain.
            let surest = MIN_VARIANCE / scan.beams() as f64;
            assert!(of(0, 0) >= surest && of(1, 1) >= surest && of(2, 2) > 0.0, "{motion:?}");
        }
    }
}

/// Fills the scan with walls. On a wall, the range changes by the same amount from each beam to the next one. The input
/// also adds noise.
fn walls(bytes: &mut Bytes<'_>, scan: &mut Scan) {
    let ranges = scan.arrays().ranges;
    let mut end = 0;
    while end < ranges.len() && !bytes.is_empty() {
        let start = end;
        end = (start + 1 + usize::from(bytes.u8())).min(ranges.len());
        let (mut range, slope, noise) =
            (bytes.u16(), i16::from(bytes.u8()) - 128, u16::from(bytes.u8() % 32));
        for (i, place) in (0_u16..).zip(&mut ranges[start..end]) {
            *place = range.wrapping_add(i.wrapping_mul(i) % (1 + noise));
            range = range.wrapping_add_signed(slope);
        }
    }
}

/// Settings of the background of a moving robot. The input changes some of them.
const MAP_SETTINGS: Settings = Settings {
    method: Method::Moving,
    threshold_mm: None,
    candidate_mm: None,
    scans: None,
    candidate: Candidate::First,
    start: Start::Empty,
    no_return_is_far: None,
};
/// Minimum variance of a range in this check, in square meters. It is a hundredth of the minimum variance of a range,
/// which is (5 mm)^2, because a beam that grazes its wall has only a twentieth of that.
const MIN_VARIANCE: f64 = 2.5e-7;
/// Maximum number of scans in an input, because the background of a moving robot takes long to forget.
const SCANS: usize = 40;
