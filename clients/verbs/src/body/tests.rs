//! Bodies and people in front of a sensor that sees a wall at five metres, by ranges that are written here.

use super::*;
use scanhub_schema::ScanHead;

const COUNT: usize = 361;
const WALL_MM: u16 = 5000;
const SCANS: usize = 40;

/// What a sensor at the robot's centre makes of scans whose beams are `range_mm(beam, slice, scan of the slice)`.
fn mask(range_mm: impl Fn(usize, usize, usize) -> Option<u16>) -> Mask {
    learn(Pose::default(), 1000.0, range_mm)
}

fn learn(pose: Pose, within_mm: f64, range_mm: impl Fn(usize, usize, usize) -> Option<u16>) -> Mask {
    let mut body = Body::new(pose, within_mm);
    let mut scan = Scan::of(ScanHead::lms(COUNT, angle_mdeg(0), 500, 1, 13), &[0; COUNT]);
    let code = scan.no_return;
    for slice in 0..SLICES {
        for number in 0..SCANS {
            for beam in 0..COUNT {
                scan.arrays().ranges[beam] = range_mm(beam, slice, number).unwrap_or(code);
            }
            assert!(body.look(slice, &scan));
        }
    }
    assert_eq!((body.scans(), body.seen_slices()), ((SLICES * SCANS) as u32, SLICES));
    body.mask()
}

fn sector(first: usize, last: usize, range_mm: u32) -> Sector {
    Sector { from_mdeg: angle_mdeg(first), to_mdeg: angle_mdeg(last), beams: last - first + 1, range_mm }
}

/// Half degrees, of which beam 180 looks ahead.
fn angle_mdeg(beam: usize) -> i32 {
    beam as i32 * 500 - 90_000
}

/// A body from beam `first` to `last`, as far as `range_mm`, in a circle of a metre: two beams of it and one beside it are
/// its edge.
fn hidden(first: usize, last: usize, range_mm: u32) -> Vec<Sector> {
    let edge = |from: usize| sector(from, from + 2, 1050);
    vec![edge(first - 1), sector(first + 2, last - 2, range_mm), edge(last - 1)]
}

/// Noise of a few mm, the same in every run.
fn noise(beam: usize, slice: usize, scan: usize) -> u16 {
    ((beam * 31 + slice * 17 + scan * 7) % 11) as u16
}

#[test]
fn a_post_is_body_with_a_beam_beside_it_on_either_side() {
    let post = |beam, slice, scan| match beam {
        60..=67 => Some(400 + noise(beam, slice, scan)),
        _ => Some(WALL_MM),
    };
    // As far as it was met, and a good deal of what it hides; the beams beside it as far as it matters.
    assert_eq!(mask(post), Mask { sectors: hidden(60, 67, 660), moving: vec![], of_beams: COUNT });
}

#[test]
fn nothing_there_is_an_empty_list() {
    let nothing = Mask { of_beams: COUNT, ..Mask::default() };
    assert_eq!(mask(|_, _, _| Some(WALL_MM)), nothing);
    assert_eq!(mask(|_, _, _| None), nothing);
    assert_eq!(Body::new(Pose::default(), 1000.0).mask(), Mask::default(), "not a scan");
}

#[test]
fn what_comes_and_goes_is_left_out_and_named() {
    // Somebody walks past in six slices, ten beams further in each, while a post stands there.
    let found = mask(|beam, slice, scan| match beam {
        60..=67 => Some(400 + noise(beam, slice, scan)),
        _ if (2..8).contains(&slice) && (100 + 10 * slice..115 + 10 * slice).contains(&beam) => Some(700),
        _ => Some(WALL_MM),
    });
    assert_eq!((found.sectors, found.moving), (hidden(60, 67, 660), vec![sector(120, 184, 700)]));
}

#[test]
fn who_walks_up_and_down_all_the_time_is_no_body() {
    let found = mask(|beam, slice, _| match beam {
        100..=130 => Some(400 + 50 * slice as u16),
        _ => Some(WALL_MM),
    });
    assert_eq!((found.sectors, found.moving), (vec![], vec![sector(100, 130, 400)]));
}

#[test]
fn who_passes_before_a_body_neither_widens_nor_hides_it() {
    let found = mask(|beam, slice, _| match beam {
        90..=150 if slice == 4 => Some(250),
        100..=110 => Some(500),
        _ => Some(WALL_MM),
    });
    assert_eq!(found.sectors, hidden(100, 110, 750));
    assert_eq!(found.moving, [sector(90, 98, 250), sector(112, 150, 250)]);
}

#[test]
fn an_edge_that_is_met_by_turns_hides_what_lies_between() {
    // Beams 68 and 70 meet body, wall and what lies between by turns; the second one is too far from the body for that.
    let found = mask(|beam, slice, scan| match beam {
        60..=67 => Some(400),
        68 | 70 if scan % 8 == 0 && slice < 6 => Some(450 + 50 * (scan as u16 / 4)),
        _ => Some(WALL_MM),
    });
    assert_eq!(found.sectors, hidden(60, 67, 650));
    assert_eq!(found.moving, [sector(70, 70, 450)]);
}

#[test]
fn a_cable_is_body_although_it_is_met_seldom_and_never_at_one_range() {
    // It is met in six of forty scans, and each time somewhere else.
    let found = mask(|beam, slice, scan| match beam {
        200..=202 if scan % 7 == slice % 7 => Some(300 + ((slice * 97 + scan * 41) % 400) as u16),
        _ => Some(WALL_MM),
    });
    assert_eq!((found.sectors.len(), found.moving.len()), (1, 0), "{found:?}");
    assert_eq!((found.sectors[0].from_mdeg, found.sectors[0].to_mdeg), (9_500, 11_500));
}

#[test]
fn single_wrong_readings_are_nothing() {
    let wrong = |one: usize| {
        mask(move |beam, slice, scan| match beam {
            7 if slice == 2 && (scan == 3 || scan == one) => Some(100),
            _ => Some(WALL_MM),
        })
    };
    assert_eq!(wrong(3), Mask { of_beams: COUNT, ..Mask::default() });
    // Twice in a slice is something; not a body.
    assert_eq!(wrong(30), Mask { moving: vec![sector(7, 7, 100)], of_beams: COUNT, ..Mask::default() });
}

#[test]
fn the_circle_is_around_the_robot_wherever_the_sensor_sits() {
    // 0.8 m ahead of the centre and looking back: what is 1.7 m off is 0.9 m behind the centre.
    let pose = Pose { x_m: 0.8, yaw_rad: std::f64::consts::PI, ..Pose::default() };
    let wall = |range_mm: u16| move |beam, _, _| if beam == 180 { Some(range_mm) } else { None };
    assert_eq!(learn(pose, 1000.0, wall(1700)).sectors, [sector(179, 181, 1850)]);
    assert_eq!(learn(pose, 1000.0, wall(1801)).sectors, []);
    assert_eq!(learn(pose, 1000.0, wall(1800)).sectors, [], "on the circle is outside");
    // As large a circle as there is: no range is beyond what a hub takes.
    assert_eq!(learn(Pose::default(), 65_000.0, wall(1800)).sectors, [sector(179, 181, FARTHEST_MM)]);
}

#[test]
fn a_slope_becomes_steps_and_a_fence_no_more_than_a_hub_takes() {
    let slope = mask(|beam, _, _| if beam < 100 { Some(200 + 5 * beam as u16) } else { Some(WALL_MM) });
    assert_eq!(slope.sectors.len(), 10, "nine steps, and the edge");
    for pair in slope.sectors[..9].windows(2) {
        assert!(pair[0].to_mdeg < pair[1].from_mdeg && pair[1].range_mm - pair[0].range_mm <= 2 * ALIKE_MM);
    }
    let fence = mask(|beam, _, _| if beam % 4 == 0 { Some(300 + beam as u16) } else { Some(WALL_MM) });
    assert_eq!(fence.sectors.len(), SECTORS);
    let hidden = |beam: usize| {
        let of = |sector: &&Sector| (sector.from_mdeg..=sector.to_mdeg).contains(&angle_mdeg(beam));
        fence.sectors.iter().find(of).map_or(0, |sector| sector.range_mm)
    };
    assert!((0..COUNT).step_by(4).all(|beam| hidden(beam) > 300 + beam as u32), "every post is still hidden");
}

#[test]
fn a_sensor_that_is_set_otherwise_meanwhile_is_noticed() {
    let mut body = Body::new(Pose::default(), 1000.0);
    let scan = |count, unit_mm| Scan::of(ScanHead::lms(count, -90_000, 1000, unit_mm, 13), &vec![0; count]);
    assert!(body.look(0, &scan(181, 1)) && !body.look(0, &scan(181, 10)));
    assert!(!body.look(0, &scan(180, 1)) && body.look(SLICES, &scan(181, 1)));
}

#[test]
fn a_scan_of_impossible_angles_does_no_harm() {
    for (first_angle, step) in [(1e300, 0.5), (0.0, 0.0), (-1e300, -1e-300)] {
        let mut body = Body::new(Pose::default(), 1000.0);
        let head = ScanHead { first_angle, step, ..ScanHead::lms(3, 0, 1000, 1, 13) };
        for slice in 0..SLICES {
            assert!(body.look(slice, &Scan::of(head, &[400, 8191, 5000])));
        }
        assert_eq!(body.mask().of_beams, 3);
    }
}

#[test]
fn a_head_that_turns_clockwise_has_sectors_from_the_lesser_angle_on() {
    let mut body = Body::new(Pose::default(), 1000.0);
    let mut scan = Scan::of(ScanHead::turning(scanhub_schema::Family::Ld, 360), &[WALL_MM; 360]);
    // A post on the right, and one behind, across 180 degrees.
    scan.arrays().ranges[85..=95].fill(400);
    scan.arrays().ranges[175..=185].fill(400);
    for slice in 0..SLICES {
        (0..SCANS).for_each(|_| assert!(body.look(slice, &scan)));
    }
    let sectors = body.mask().sectors;
    let seen: Vec<_> =
        sectors.iter().map(|sector| (sector.from_mdeg / 1000, sector.to_mdeg / 1000)).collect();
    assert!(seen.iter().all(|(from, to)| from <= to && to - from <= 12), "{seen:?}");
    for angle in [-95, -90, -85, -175, -180, 179, 175] {
        assert!(seen.iter().any(|(from, to)| (*from..=*to).contains(&angle)), "{angle}: {seen:?}");
    }
    assert!(!seen.iter().any(|(from, to)| (*from..=*to).contains(&0)), "{seen:?}");
}
