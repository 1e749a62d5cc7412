//! Tests of verdicts, circles and what a beam tells.

use scanhub_preprocess::zones::{Check, Sector, Settings};
use scanhub_schema::{Code, Contents, Pose, Scan, ScanHead, Verdict, Zones};

const INVALID: u16 = 0x1FFF - 5;

/// A hundred beams of 180 degrees: nothing within 5 m but what is named.
fn scan(beams: &[(usize, u16)]) -> Box<Scan> {
    let mut scan = Scan::of(ScanHead::lms(100, -90_000, 1800, 1, 13), &[5000; 100]);
    beams.iter().for_each(|&(i, range_mm)| scan.arrays().ranges[i] = range_mm);
    scan
}

fn told(check: &mut Check, scan: &Scan) -> Zones {
    let mut out = Zones::unknown();
    check.update(scan, &mut out);
    out
}

fn verdict(settings: &Settings, scan: &Scan) -> Verdict {
    told(&mut Check::new(Pose::default(), settings, 100), scan).verdict()
}

#[test]
fn the_two_circles_of_the_paper() {
    let settings = Settings::default();
    assert_eq!(verdict(&settings, &scan(&[])), Verdict::Clear);
    assert_eq!(verdict(&settings, &scan(&[(7, 1000)])), Verdict::Clear);
    assert_eq!(verdict(&settings, &scan(&[(7, 999)])), Verdict::Slow);
    assert_eq!(verdict(&settings, &scan(&[(7, 600)])), Verdict::Slow);
    assert_eq!(verdict(&settings, &scan(&[(7, 599), (9, 0)])), Verdict::Stop);
    let mut check = Check::new(Pose::default(), &settings, 100);
    let out = told(&mut check, &scan(&[(7, 599), (9, 0), (12, 700), (13, INVALID)]));
    assert_eq!((out.nearest(), out.invalid_beams, out.flags), (Some((9, 0)), 1, 0));
    let circles = out.zones().iter().map(|zone| (zone.radius_mm, zone.beams, zone.violated));
    assert!(circles.eq([(1000, 3, 1), (600, 2, 1)]));
}

#[test]
fn a_violation_takes_enough_beams_in_enough_scans_and_a_start_is_unknown() {
    let settings = Settings { min_beams: 2, min_scans: 3, ..Settings::default() };
    let mut check = Check::new(Pose::default(), &settings, 100);
    let (near, single) = (scan(&[(7, 700), (8, 500), (9, 500)]), scan(&[(7, 500)]));
    let mut next = |scan: &Scan| {
        let out = told(&mut check, scan);
        (out.verdict(), out.flags)
    };
    assert_eq!(next(&near), (Verdict::Unknown, Zones::PROVISIONAL));
    assert_eq!(next(&near), (Verdict::Unknown, Zones::PROVISIONAL));
    assert_eq!(next(&near), (Verdict::Stop, 0));
    assert_eq!(next(&single), (Verdict::Clear, 0));
    assert_eq!([(); 3].map(|()| next(&near).0), [Verdict::Clear, Verdict::Clear, Verdict::Stop]);
    let mut cm = scan(&[]);
    cm.unit_um = 10_000;
    assert_eq!(next(&cm), (Verdict::Unknown, Zones::PROVISIONAL), "another layout is another start");
}

#[test]
fn a_silence_is_unknown_and_scans_follow_each_other_anew() {
    let settings = Settings { min_scans: 2, ..Settings::default() };
    let mut check = Check::new(Pose::default(), &settings, 100);
    let near = scan(&[(7, 500)]);
    assert_eq!([(); 2].map(|()| told(&mut check, &near).verdict()), [Verdict::Unknown, Verdict::Stop]);
    let mut out = told(&mut check, &near);
    check.stale(&mut out);
    assert_eq!((out.verdict(), out.nearest(), out.flags), (Verdict::Unknown, None, Zones::PROVISIONAL));
    let circles = out.zones().iter().map(|zone| (zone.radius_mm, zone.beams, zone.violated));
    assert!(circles.eq([(1000, 0, 0), (600, 0, 0)]));
    assert_eq!([(); 2].map(|()| told(&mut check, &near).verdict()), [Verdict::Unknown, Verdict::Stop]);
}

#[test]
fn too_many_invalid_beams_hide_all_but_a_stop() {
    let invalid: Vec<_> = (0..11).map(|i| (i, INVALID)).collect();
    let settings = Settings::default();
    assert_eq!(verdict(&settings, &scan(&invalid[..10])), Verdict::Clear, "a tenth is not too many");
    assert_eq!(verdict(&settings, &scan(&invalid)), Verdict::Unknown);
    let with = |range_mm| scan(&[&invalid[..], &[(20, range_mm)]].concat());
    assert_eq!(verdict(&settings, &with(700)), Verdict::Unknown);
    assert_eq!(verdict(&settings, &with(500)), Verdict::Stop);
    let far: Vec<_> = (0..100).map(|i| (i, 0x1FFF - 8 * (i as u16 % 2))).collect();
    assert_eq!(verdict(&settings, &scan(&far)), Verdict::Clear, "nothing came back");
    let strict = Settings { no_return_is_far: false, ..settings };
    assert_eq!(verdict(&strict, &scan(&far)), Verdict::Unknown);
}

#[test]
fn the_robot_itself_is_neither_near_nor_invalid() {
    // Beams 0 to 10; there the body ends before the circle, or hides all of it.
    let partly = [Sector { from_mdeg: -90_000, to_mdeg: -72_000, range_mm: 400 }];
    let wholly = [Sector { range_mm: 1000, ..partly[0] }, partly[0]];
    let body: Vec<_> = (0..12).map(|i| (i, 399)).collect();
    let blind: Vec<_> = (0..11).map(|i| (i, INVALID)).collect();
    for (self_min, of_blind) in [(&partly[..], Verdict::Unknown), (&wholly[..], Verdict::Clear)] {
        let settings = Settings { self_min: self_min.to_vec(), ..Settings::default() };
        assert_eq!(verdict(&settings, &scan(&body[..11])), Verdict::Clear);
        assert_eq!(verdict(&settings, &scan(&body)), Verdict::Stop, "beam 11 is none of the body's");
        assert_eq!(verdict(&settings, &scan(&blind)), of_blind);
        let mut check = Check::new(Pose::default(), &settings, 100);
        assert_eq!(told(&mut check, &scan(&body[..11])).nearest(), Some((11, 5000)));
    }
    let settings = Settings { self_min: partly.to_vec(), ..Settings::default() };
    assert_eq!(verdict(&settings, &scan(&[(3, 400)])), Verdict::Stop, "where the body ends");
}

#[test]
fn who_is_told_nothing_knows_nothing() {
    let settings = Settings::default();
    assert_eq!(verdict(&settings, &Box::<Scan>::default()), Verdict::Unknown);
    assert_eq!(
        verdict(&Settings { radii_mm: Vec::new(), ..Settings::default() }, &scan(&[(7, 500)])),
        Verdict::Unknown
    );
    for (x_m, yaw_rad) in [(f64::NAN, 0.0), (0.0, f64::INFINITY), (f64::INFINITY, 0.0)] {
        let mut check = Check::new(Pose { x_m, yaw_rad, ..Pose::default() }, &settings, 100);
        assert_eq!(told(&mut check, &scan(&[])).verdict(), Verdict::Unknown);
    }
}

#[test]
fn an_old_scan_is_never_clear() {
    let mut check = Check::new(Pose::default(), &Settings::default(), 100);
    let mut of = |is_late, scan: &Scan| {
        check.doubt(is_late);
        told(&mut check, scan).verdict()
    };
    assert_eq!(of(false, &scan(&[])), Verdict::Clear);
    assert_eq!(of(true, &scan(&[])), Verdict::Unknown);
    assert_eq!(of(true, &scan(&[(7, 700)])), Verdict::Unknown);
    assert_eq!(of(true, &scan(&[(7, 500)])), Verdict::Stop);
    assert_eq!(of(false, &scan(&[])), Verdict::Clear);
}

#[test]
fn a_circle_that_cannot_be_violated_is_never_clear() {
    let settings = Settings::default();
    let of = |pose: Pose, settings: &Settings, scan: &Scan| {
        let mut check = Check::new(pose, settings, 100);
        (told(&mut check, scan).verdict(), check.telling(), check.is_blind())
    };
    let whole = Pose::default();
    let most = Settings { min_beams: 100, ..settings.clone() };
    assert_eq!(of(whole, &most, &scan(&[])), (Verdict::Clear, 100, false));
    let more = Settings { min_beams: 101, ..settings.clone() };
    assert_eq!(of(whole, &more, &scan(&[(7, 0)])), (Verdict::Unknown, 100, true));
    let body = [Sector { from_mdeg: -90_000, to_mdeg: -72_000, range_mm: 1000 }];
    let masked = Settings { self_min: body.to_vec(), ..most.clone() };
    assert_eq!(of(whole, &masked, &scan(&[])), (Verdict::Unknown, 89, true));
    let all = [Sector { to_mdeg: 90_000, ..body[0] }];
    assert_eq!(
        of(whole, &Settings { self_min: all.to_vec(), ..settings.clone() }, &scan(&[])).0,
        Verdict::Unknown
    );
    // 2 m ahead of the centre it looks away from the circle; turned about, into it.
    let away = Pose { x_m: 2.0, ..Pose::default() };
    assert_eq!(of(away, &settings, &scan(&[])), (Verdict::Unknown, 0, true));
    let back = Pose { yaw_rad: std::f64::consts::PI, ..away };
    assert_eq!(of(back, &settings, &scan(&[])).0, Verdict::Clear);
    // So far away that 13 bits of mm do not reach it; those of cm do.
    let far = Pose { x_m: 9.2, ..back };
    assert_eq!(of(far, &settings, &scan(&[])), (Verdict::Unknown, 0, true));
    let mut cm = scan(&[]);
    cm.unit_um = 10_000;
    assert_eq!(of(far, &settings, &cm).0, Verdict::Clear);
}

/// A clockwise turn of 200 bins of 1.8 degrees, of a sensor whose own points are 1.8 degrees apart: nothing within 5 m but
/// what is named, at its exact angle in degrees.
fn turn(beams: &[(usize, u16, f32)]) -> Box<Scan> {
    let head = ScanHead {
        step: -1.8_f64.to_radians(),
        spacing: 1.8_f32.to_radians(),
        unit_um: 1000,
        valid_to: 0xFFEF,
        no_return: Code::NoReturn.value(),
        beyond: Code::NoReturn.value(),
        contents: Contents::ANGLES,
        ..ScanHead::default()
    };
    let mut scan = Scan::of(head, &[5000; 200]);
    let arrays = scan.arrays();
    for (i, angle) in arrays.angles.iter_mut().enumerate() {
        *angle = (-1.8 * i as f32).to_radians();
    }
    for &(i, range, angle_deg) in beams {
        (arrays.ranges[i], arrays.angles[i]) = (range, angle_deg.to_radians());
    }
    scan
}

fn of_turn(pose: Pose, settings: &Settings, scan: &Scan) -> Zones {
    told(&mut Check::new(pose, settings, 200), scan)
}

#[test]
fn the_exact_point_counts_where_there_is_one() {
    let settings = Settings::default();
    assert_eq!(of_turn(Pose::default(), &settings, &turn(&[])).verdict(), Verdict::Clear);
    let near = of_turn(Pose::default(), &settings, &turn(&[(7, 700, -12.0), (190, 999, 17.5)]));
    assert_eq!((near.verdict(), near.nearest()), (Verdict::Slow, Some((7, 700))));
    assert_eq!((near.zones()[0].beams, near.zones()[1].beams), (2, 0));
    // 2 m ahead of the centre, what is straight behind at 1001 mm is just inside; a bin's half to the side it is not.
    let ahead = Pose { x_m: 2.0, ..Pose::default() };
    assert_eq!(of_turn(ahead, &settings, &turn(&[(100, 1001, -180.0)])).zones()[0].beams, 1);
    assert_eq!(of_turn(ahead, &settings, &turn(&[(100, 1000, -180.0)])).zones()[0].beams, 0);
    assert_eq!(of_turn(ahead, &settings, &turn(&[(100, 1001, -182.6)])).zones()[0].beams, 0);
    // The middle of bin 99 is beside the robot's body, a point in it may not be.
    let body = [Sector { from_mdeg: -180_000, to_mdeg: -179_000, range_mm: 2000 }];
    let masked = Settings { self_min: body.to_vec(), ..settings };
    assert_eq!(of_turn(ahead, &masked, &turn(&[(99, 1500, -178.3)])).zones()[0].beams, 1);
    assert_eq!(of_turn(ahead, &masked, &turn(&[(99, 1500, -179.3)])).zones()[0].beams, 0);
}

#[test]
fn what_was_not_measured_is_looked_past_where_its_neighbours_were() {
    let settings = Settings { max_invalid: 0.0, ..Settings::default() };
    let without = |beams: &[usize], spacing_deg: f32| {
        let mut scan = turn(&[]);
        beams.iter().for_each(|&i| scan.arrays().ranges[i] = Scan::NOT_MEASURED);
        scan.spacing = spacing_deg.to_radians();
        let out = of_turn(Pose::default(), &settings, &scan);
        (out.invalid_beams, out.verdict())
    };
    assert_eq!(without(&[5, 90, 198], 1.8), (0, Verdict::Clear));
    assert_eq!(without(&[5, 6, 90], 1.8), (2, Verdict::Unknown), "three spacings without a point");
    assert_eq!(without(&[5, 6, 90], 3.6), (0, Verdict::Clear), "its points are farther apart");
    assert_eq!(without(&[199], 1.8), (0, Verdict::Clear), "the first beam follows the last");
    assert_eq!(without(&[0, 199], 1.8), (2, Verdict::Unknown));
    let none: Vec<usize> = (0..200).collect();
    assert_eq!(without(&none, 1.8), (200, Verdict::Unknown));
}

#[test]
fn scans_of_a_head_that_changes_its_speed_follow_each_other() {
    let settings = Settings { min_scans: 3, max_invalid: 0.0, ..Settings::default() };
    let mut check = Check::new(Pose::default(), &settings, 200);
    let mut next = |range: u16, spacing_deg: f32| {
        let mut scan = turn(&[(7, range, -12.6)]);
        [90, 91].iter().for_each(|&i| scan.arrays().ranges[i] = Scan::NOT_MEASURED);
        scan.spacing = spacing_deg.to_radians();
        let out = told(&mut check, &scan);
        (out.verdict(), out.invalid_beams)
    };
    let near = [3.6, 3.61, 3.59].map(|spacing_deg| next(500, spacing_deg));
    assert_eq!(near, [(Verdict::Unknown, 0), (Verdict::Unknown, 0), (Verdict::Stop, 0)]);
    assert_eq!(next(5000, 3.6), (Verdict::Clear, 0));
    assert_eq!(next(5000, 1.8), (Verdict::Unknown, 2), "its points are as near to each other as its beams");
}
