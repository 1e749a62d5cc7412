//! What a part of a scan warns of, against the slow way: the same scans given to a new check, the last one with nothing near
//! in the beams that have not arrived.

use fastrand::Rng;
use scanhub_preprocess::zones::{Check, Settings, Warning};
use scanhub_schema::{Pose, Scan, ScanHead, Verdict, Zones};

const BEAMS: usize = 100;
const FAR: u16 = 5000;

/// A scan of 180 degrees: nothing near but in `near` beams.
fn scan(random: &mut Rng, near: usize) -> Box<Scan> {
    let mut scan = Scan::of(ScanHead::lms(BEAMS, -90_000, 1800, 1, 13), &[FAR; BEAMS]);
    (0..near).for_each(|_| scan.arrays().ranges[random.usize(..BEAMS)] = random.u16(..1200));
    scan
}

/// What a new check says of the last of `scans` after the others.
fn told(pose: Pose, settings: &Settings, scans: &[Box<Scan>]) -> Zones {
    let (mut check, mut out) = (Check::new(pose, settings, BEAMS), Zones::unknown());
    scans.iter().for_each(|scan| check.update(scan, &mut out));
    out
}

fn worst(zones: &Zones) -> Option<Verdict> {
    match zones.zones() {
        [.., smallest] if smallest.violated != 0 => Some(Verdict::Stop),
        circles if circles.iter().any(|zone| zone.violated != 0) => Some(Verdict::Slow),
        _ => None,
    }
}

#[test]
fn a_part_of_a_scan_warns_of_what_it_shows_and_the_whole_confirms_it() {
    let mut random = Rng::with_seed(28);
    let (mut warned, mut silent) = (0, 0);
    for _ in 0..200 {
        let (min_beams, min_scans) = (random.u16(1..4), random.u16(1..4));
        let settings = Settings { min_beams, min_scans, exact: random.bool(), ..Settings::default() };
        let pose = Pose { x_m: 0.4 * random.f64(), yaw_rad: random.f64(), ..Pose::default() };
        let mut check = Check::new(pose, &settings, BEAMS);
        let mut scans: Vec<Box<Scan>> = Vec::new();
        for _ in 0..6 {
            let near = random.usize(..9);
            let whole = scan(&mut random, near);
            let mut before = None;
            for seen in [0, 1, random.usize(..BEAMS), random.usize(..BEAMS), BEAMS] {
                let early = check.early(BEAMS, 1000, &whole.ranges()[..seen], &[]);
                let mut part = whole.clone();
                part.arrays().ranges[seen..].fill(FAR);
                scans.push(part);
                let zones = told(pose, &settings, &scans);
                scans.pop();
                // The first scan of a layout makes the table: there is nothing to judge by before it.
                let expected = worst(&zones).filter(|_| !scans.is_empty());
                assert_eq!(early.map(|warning| warning.verdict), expected, "{seen} of {near}");
                if let Some(Warning { beam, distance_mm, .. }) = early {
                    assert_eq!(Some((beam, distance_mm)), zones.nearest());
                }
                (warned, silent) =
                    (warned + usize::from(early.is_some()), silent + usize::from(early.is_none()));
                before = before.max(early.map(|warning| warning.verdict as u8).filter(|_| seen == BEAMS));
            }
            let mut out = Zones::unknown();
            check.update(&whole, &mut out);
            assert!(before.is_none_or(|before| out.verdict().worse(Verdict::Clear) as u8 >= before));
            scans.push(whole);
        }
    }
    assert!(warned > 500 && silent > 500, "{warned} and {silent}");
}

#[test]
fn scans_of_another_form_warn_of_nothing() {
    let mut check = Check::new(Pose::default(), &Settings::default(), BEAMS);
    let near = [300; BEAMS];
    assert_eq!(check.early(BEAMS, 1000, &near, &[]), None, "nothing is known of the sensor");
    check.update(&scan(&mut Rng::with_seed(1), 0), &mut Zones::unknown());
    assert_eq!(check.early(BEAMS, 1000, &near, &[]).map(|warning| warning.verdict), Some(Verdict::Stop));
    assert_eq!(check.early(BEAMS + 1, 1000, &near, &[]), None, "more beams");
    assert_eq!(check.early(BEAMS, 10_000, &near, &[]), None, "another unit");
    check.stale(&mut Zones::unknown());
    assert_eq!(check.early(BEAMS, 1000, &[], &[]), None);
}

/// A turn of a head: a second of arc more or less in how far its own points are apart does not make another sensor of it.
#[test]
fn turns_of_which_none_takes_as_long_as_another_are_counted_in_a_row() {
    let settings = Settings { min_scans: 2, ..Settings::default() };
    let mut check = Check::new(Pose::default(), &settings, BEAMS);
    let mut turn = Scan::zeroed(Scan::len(BEAMS, scanhub_schema::Contents::TURNING));
    let mut verdicts = Vec::new();
    for number in 0..3 {
        let head = ScanHead::turning(scanhub_schema::Family::Ld, BEAMS);
        let arrays = turn.begin(ScanHead { spacing: head.spacing + number as f32 * 5e-6, ..head });
        arrays.ranges.fill(500);
        arrays.upper.fill(0);
        let step = head.step;
        arrays.angles.iter_mut().enumerate().for_each(|(i, angle)| *angle = (i as f64 * step) as f32);
        let early = check.early(BEAMS, 1000, turn.ranges(), turn.exact_angles());
        let mut out = Zones::unknown();
        check.update(&turn, &mut out);
        verdicts.push((early.map(|warning| warning.verdict), out.verdict()));
    }
    let known = (Some(Verdict::Stop), Verdict::Stop);
    assert_eq!(verdicts, [(None, Verdict::Unknown), known, known]);
}
