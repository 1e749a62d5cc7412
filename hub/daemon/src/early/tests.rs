//! What is said of turns while they are measured, against the zones of the whole turns: rooms, masks, mounts and losses are
//! drawn, points come out of order.

use fastrand::Rng;
use preprocess::zones::{Sector, Settings};
use scanhub_drivers::line::grid::{NO_RETURN, Point};
use scanhub_drivers::line::{Values, revolution_head};
use schema::{Family, Pose, Zones};

use super::*;

const BEAMS: usize = 90;

/// A turn of points of which some stand near, each at most `late` points behind its place.
fn points(random: &mut Rng, late: usize) -> Vec<Point> {
    let count = random.usize(40..200);
    let near: Vec<(f32, f32, u16)> = (0..random.usize(..4))
        .map(|_| (6.2 * random.f32(), 0.3 * random.f32(), random.u16(..1300)))
        .collect();
    let mut points: Vec<(usize, Point)> = (0..count)
        .map(|i| {
            let clockwise = i as f32 / count as f32 * std::f32::consts::TAU - 0.03;
            let is_at = |place: &&(f32, f32, u16)| (clockwise - place.0).abs() < place.1;
            let found = near.iter().find(is_at).map_or(5000, |place| place.2 + random.u16(..30));
            let range = if random.u8(..20) == 0 { NO_RETURN } else { found };
            (i + random.usize(..=late), Point { angle: -clockwise, range, intensity: 9 })
        })
        .collect();
    points.sort_by_key(|(place, _)| *place);
    points.into_iter().map(|(_, point)| point).collect()
}

fn turn(number: u64, points: &[Point]) -> RawScan<'_> {
    // It is not the same for any two.
    let (period, per_second) = (100_000_000 + 1_000 * number, 900.0);
    RawScan {
        number,
        first: 0,
        last: 0,
        period,
        reasons: 0,
        bytes: 0,
        head: revolution_head(Family::Ld, BEAMS, period, per_second, false),
        values: Values::Points { points, per_second },
    }
}

/// The zones of the whole turn.
fn zones(check: &mut Check, turn: &RawScan<'_>) -> Zones {
    let mut scan = Scan::zeroed(turn.payload_len());
    turn.write(&mut scan);
    let mut zones = Zones::unknown();
    check.update(&scan, &mut zones);
    zones
}

/// What consumers know of warnings.
#[derive(Default)]
struct Heard {
    /// What stands.
    stands: Option<Word>,
    said: usize,
    withdrawn: usize,
}

impl Heard {
    fn hear(&mut self, word: Word) {
        if word.early.is_withdrawn() {
            let stood = self.stands.take().expect("nothing to take back");
            assert_eq!((stood.seq, stood.early.verdict), (word.seq, word.early.verdict));
            self.withdrawn += 1;
            return;
        }
        assert!(matches!(word.early.verdict(), Verdict::Slow | Verdict::Stop));
        if let Some(before) = self.stands.replace(word) {
            assert!(before.seq == word.seq && before.early.verdict < word.early.verdict, "{word:?}");
        }
        self.said += 1;
    }
}

#[test]
fn a_warning_that_is_not_withdrawn_is_confirmed_by_its_turn() {
    let mut random = Rng::with_seed(28);
    let (mut heard, mut confirmed, mut packets) = (Heard::default(), 0, 0);
    for _ in 0..400 {
        let own: Vec<Sector> = (0..random.usize(..3))
            .map(|_| {
                let from_mdeg = random.i32(-180_000..180_000);
                Sector { from_mdeg, to_mdeg: from_mdeg + random.i32(..90_000), range_mm: random.u16(..900) }
            })
            .collect();
        let settings = Settings {
            self_min: &own,
            margin_mm: random.u16(..50),
            min_beams: random.u16(1..4),
            min_scans: random.u16(1..4),
            exact: random.bool(),
            ..Settings::default()
        };
        let (x_m, y_m) = (2.0 * random.f64() - 1.0, 2.0 * random.f64() - 1.0);
        let upside_down = random.bool().into();
        let pose = Pose { x_m, y_m, yaw_rad: 6.0 * random.f64(), upside_down, ..Pose::default() };
        let mut check = Check::new(pose, &settings, BEAMS);
        let mut warner = EarlyWarner::new(BEAMS);
        let late = if random.bool() { 0 } else { 20 };
        let again = points(&mut random, late);
        for number in 1..9 {
            // What stands there often stands there for some turns.
            let points = if random.u8(..3) == 0 { points(&mut random, late) } else { again.clone() };
            let is_over = random.u8(..4) > 0;
            let end = if is_over { points.len() - 1 } else { random.usize(..points.len()) };
            let mut seen = 0;
            while seen < end {
                (seen, packets) = ((seen + random.usize(1..24)).min(end), packets + 1);
                warner.withdraw(Some(number)).into_iter().for_each(|word| heard.hear(word));
                let begun = turn(number, &points[..seen]);
                let words = warner.look(&begun, &mut check, packets);
                words.into_iter().flatten().for_each(|word| heard.hear(word));
            }
            if is_over {
                // The packet that ends the turn has some of its points.
                packets += 1;
                if warner.has_said() {
                    let begun = turn(number, &points);
                    let words = warner.look(&begun, &mut check, packets);
                    words.into_iter().flatten().for_each(|word| heard.hear(word));
                }
                let zones = zones(&mut check, &turn(number, &points));
                warner.confirm(number);
                let said = heard.stands.take();
                assert!(said.as_ref().is_none_or(|word| word.seq < packets), "{said:?} of {packets}");
                let holds = |word: &Word| zones.verdict().worse(word.early.verdict()) == zones.verdict();
                assert!(said.as_ref().is_none_or(holds), "{said:?} and {:?}", zones.verdict());
                confirmed += usize::from(said.is_some());
            } else {
                warner.withdraw(None).into_iter().for_each(|word| heard.hear(word));
                assert_eq!(heard.stands, None);
            }
        }
    }
    assert!(confirmed > 300 && heard.withdrawn > 100, "{confirmed} confirmed, {} withdrawn", heard.withdrawn);
    assert!(heard.said >= confirmed + heard.withdrawn);
}

#[test]
fn what_is_the_robots_own_body_is_taken_back() {
    let at = |degrees: f32, range| Point { angle: -degrees.to_radians(), range, intensity: 9 };
    let own = [Sector { from_mdeg: -95_000, to_mdeg: -85_000, range_mm: 300 }];
    let settings = Settings { self_min: &own, ..Settings::default() };
    let mut check = Check::new(Pose::default(), &settings, BEAMS);
    let mut warner = EarlyWarner::new(BEAMS);
    zones(&mut check, &turn(1, &[at(10.0, 5000)]));
    // Beam 22 is 88 degrees to the right, and its nearest point counts.
    let mut turned: Vec<Point> = (0..BEAMS).map(|beam| at(4.0 * beam as f32, 5000)).collect();
    turned.splice(22..23, [at(87.5, 500), at(88.5, 200)]);
    turned[60].range = 800;
    let mut look = |seen: usize| warner.look(&turn(2, &turned[..seen]), &mut check, 7);
    assert_eq!(look(22), [None, None]);
    let [None, Some(stop)] = look(23) else { panic!("no warning") };
    let Early { verdict, beam, distance_mm, bytes_seen, beams_seen, flags } = stop.early;
    assert_eq!((stop.seq, verdict, flags), (7, Verdict::Stop as u8, 0));
    assert_eq!((beam, distance_mm, bytes_seen, beams_seen), (22, 500, 0, 23));
    assert_eq!(look(23), [None, None], "said once");
    let withdrawn = Word { early: Early { flags: Early::WITHDRAWN, ..stop.early }, ..stop };
    assert_eq!(look(24), [Some(withdrawn), None]);
    let [None, Some(slow)] = look(BEAMS) else { panic!("no warning") };
    assert_eq!(slow.early.verdict(), Verdict::Slow);
    assert_eq!(zones(&mut check, &turn(2, &turned)).verdict(), Verdict::Slow);
}
