//! What the sensor sees: a world, measured the way an LMS 2xx measures it. Noise, beams without return, a signal too
//! weak at edges, ranges beyond the mode's, half-degree beams one mirror turn later. A pure function of world, seed
//! and time; knows neither telegrams nor the line.

use lms::Nanos;
use lms::variant::{MIRROR_TURN, Mode, Unit, Variant};

use crate::people::Walker;
use crate::shape::Shape;

/// The worlds there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum World {
    /// A furnished room with three people, a window, an open door and three reflectors.
    Room,
    /// The same room without people, furniture and reflectors.
    Bare,
    /// Nothing within reach.
    Empty,
    /// A wall bent around the sensor so that every value is 640: its bytes are `80 02` throughout, so each beam but
    /// the last ends in what a header begins with.
    Wall640,
    /// Words without meaning: every bit that the mode may set, at random.
    Random,
}

impl World {
    /// Every world with its name.
    pub const ALL: [(&str, World); 5] = [
        ("room", World::Room),
        ("bare", World::Bare),
        ("empty", World::Empty),
        ("wall640", World::Wall640),
        ("random", World::Random),
    ];
}

/// A world with its furniture in place.
#[derive(Clone, Debug)]
pub struct Room {
    world: World,
    seed: u64,
    fixed: Vec<(Shape, Surface)>,
    people: Vec<Walker>,
}

/// How a surface answers to the beam.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Surface {
    Plain,
    Reflector,
    /// Glass: the beam goes through and does not come back.
    Glass,
}

impl Room {
    /// `world` as `seed` makes it: the ways of its people, its noise.
    pub fn new(world: World, seed: u64) -> Self {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut fixed = Vec::new();
        let mut people = Vec::new();
        if matches!(world, World::Room | World::Bare) {
            walls(&mut fixed);
        }
        if world == World::Room {
            furniture(&mut fixed);
            for (centre, reach) in WALKS {
                people.push(Walker::new(centre, reach, &mut random));
            }
        }
        Room { world, seed, fixed, people }
    }

    /// The value words of the scan whose last mirror turn ended at `end_ns`: as many as `variant` has beams, in `unit`,
    /// split as `mode` says. The same arguments give the same words.
    pub fn scan(&self, variant: Variant, unit: Unit, mode: Mode, end_ns: Nanos) -> Vec<u16> {
        let mut random = fastrand::Rng::with_seed(self.seed ^ end_ns.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        match self.world {
            World::Empty => vec![mode.max_value(); variant.beams()],
            World::Wall640 => vec![640; variant.beams()],
            World::Random => (0..variant.beams()).map(|_| random.u16(..) & !mode.forbidden()).collect(),
            World::Room | World::Bare => {
                let step_mdeg = 10 * i32::from(variant.resolution_cdeg);
                let angles =
                    (0..variant.beams() as i32).map(|beam| variant.first_angle_mdeg() + beam * step_mdeg);
                self.measure(angles, variant.turns(), unit, mode, end_ns, &mut random)
            }
        }
    }

    /// The value words of the mirror turn that ended at `end_ns`, as a partial scan tells them: 181 beams on whole
    /// degrees, or 180 that lie `quarter` quarters of a degree behind them.
    pub(crate) fn partial(&self, quarter: u8, unit: Unit, mode: Mode, end_ns: Nanos) -> Vec<u16> {
        let whole = Variant { angle_deg: 180, resolution_cdeg: 100 };
        let beams = whole.beams() - usize::from(quarter > 0);
        match self.world {
            World::Room | World::Bare => {
                let mut random =
                    fastrand::Rng::with_seed(self.seed ^ end_ns.wrapping_mul(0x9E37_79B9_7F4A_7C15));
                let angles = (0..beams as i32).map(|beam| 1_000 * beam + 250 * i32::from(quarter));
                self.measure(angles, 1, unit, mode, end_ns, &mut random)
            }
            _ => self.scan(whole, unit, mode, end_ns)[..beams].to_vec(),
        }
    }

    /// What the beams at `angles_mdeg` meet, every one after the other in the next of `turns` mirror turns.
    fn measure(
        &self,
        angles_mdeg: impl Iterator<Item = i32>,
        turns: u64,
        unit: Unit,
        mode: Mode,
        end_ns: Nanos,
        random: &mut fastrand::Rng,
    ) -> Vec<u16> {
        let legs: Vec<Vec<Shape>> = (0..turns)
            .map(|turn| {
                let time_s = end_ns.saturating_sub((turns - turn) * MIRROR_TURN) as f64 / 1e9;
                self.people.iter().flat_map(|walker| walker.legs(time_s)).collect()
            })
            .collect();
        let mut before_mm = None;
        angles_mdeg
            .enumerate()
            .map(|(beam, angle_mdeg)| {
                let (sin, cos) = (f64::from(angle_mdeg) / 1000.0).to_radians().sin_cos();
                // The beams between whole degrees are measured in the turns after the first.
                let (range_mm, surface) = self.nearest((cos, sin), &legs[beam % turns as usize]);
                let edge = before_mm.replace(range_mm).is_some_and(|b: f64| (b - range_mm).abs() > EDGE_MM);
                let weak = random.f64() < WEAK_AT_EDGES;
                let noise_mm = NOISE_MM * gaussian(random);
                if surface == Surface::Glass || range_mm.is_infinite() {
                    mode.max_value()
                } else if edge && weak {
                    mode.max_value() - TOO_WEAK
                } else {
                    let level = if surface == Surface::Reflector { level(mode, random) } else { 0 };
                    range_value((range_mm + noise_mm) / f64::from(unit.mm()), mode)
                        | level << mode.range_bits()
                }
            })
            .collect()
    }

    fn nearest(&self, direction: (f64, f64), legs: &[Shape]) -> (f64, Surface) {
        let fixed = self.fixed.iter().map(|(shape, surface)| (shape, *surface));
        let legs = legs.iter().map(|shape| (shape, Surface::Plain));
        fixed
            .chain(legs)
            .filter_map(|(shape, surface)| Some((shape.distance(direction)?, surface)))
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .unwrap_or((f64::INFINITY, Surface::Glass))
    }
}

/// The range value of `units` (any number), or the code for what is beyond the mode's range.
fn range_value(units: f64, mode: Mode) -> u16 {
    let beyond = mode.max_value() - recording::BEYOND;
    (units.round().max(0.0) as u16).min(beyond)
}

/// Level of a reflector; real recordings show 0 to 5 of 7.
fn level(mode: Mode, random: &mut fastrand::Rng) -> u16 {
    match mode.intensity_bits() {
        3 => random.u16(3..=5),
        2 => random.u16(2..=3),
        bits => u16::from(bits),
    }
}

/// Standard normal, by the sum of twelve.
fn gaussian(random: &mut fastrand::Rng) -> f64 {
    (0..12).map(|_| random.f64()).sum::<f64>() - 6.0
}

fn walls(fixed: &mut Vec<(Shape, Surface)>) {
    let mut line = |points: &[(f64, f64)], surface| {
        for pair in points.windows(2) {
            fixed.push((Shape::Wall { from: pair[0], to: pair[1] }, surface));
        }
    };
    // Right wall, window, far wall up to the door; then from the door's other side to the left wall.
    line(&[(3_400.0, -500.0), (3_400.0, 2_200.0)], Surface::Plain);
    line(&[(3_400.0, 2_200.0), (3_400.0, 3_300.0)], Surface::Glass);
    line(&[(3_400.0, 3_300.0), (3_400.0, 5_600.0), (900.0, 5_600.0)], Surface::Plain);
    line(&[(0.0, 5_600.0), (-4_100.0, 5_600.0), (-4_100.0, -500.0)], Surface::Plain);
    // Behind the door a corridor, whose end is beyond 8 metres.
    line(&[(900.0, 5_600.0), (900.0, 14_000.0), (0.0, 14_000.0), (0.0, 5_600.0)], Surface::Plain);
}

fn furniture(fixed: &mut Vec<(Shape, Surface)>) {
    // A cupboard, and a table of which only the legs are seen.
    for (from, to) in [
        ((-4_100.0, 3_000.0), (-3_500.0, 3_000.0)),
        ((-3_500.0, 3_000.0), (-3_500.0, 4_200.0)),
        ((-3_500.0, 4_200.0), (-4_100.0, 4_200.0)),
        ((2_600.0, 400.0), (2_600.0, 1_300.0)),
        ((2_600.0, 1_300.0), (3_400.0, 1_300.0)),
    ] {
        fixed.push((Shape::Wall { from, to }, Surface::Plain));
    }
    for centre in [(-2_400.0, 1_500.0), (-1_200.0, 1_500.0), (-2_400.0, 2_300.0), (-1_200.0, 2_300.0)] {
        fixed.push((Shape::Post { centre, radius: 30.0 }, Surface::Plain));
    }
    for centre in [(2_900.0, 4_800.0), (-600.0, 5_400.0), (-3_700.0, 900.0)] {
        fixed.push((Shape::Post { centre, radius: 50.0 }, Surface::Reflector));
    }
}

/// Where people walk, and how far from there: never nearer than half a metre, the furniture left alone.
const WALKS: [((f64, f64), (f64, f64)); 3] = [
    ((1_000.0, 2_600.0), (1_200.0, 700.0)),
    ((-400.0, 3_900.0), (2_200.0, 900.0)),
    ((300.0, 1_200.0), (900.0, 400.0)),
];
/// Standard deviation of a range: between the data sheet's 5 mm and the 3.2 mm measured on a real unit.
const NOISE_MM: f64 = 4.0;
/// A jump between neighbouring beams that makes an edge.
const EDGE_MM: f64 = 300.0;
/// Share of the beams at an edge whose signal is too weak.
const WEAK_AT_EDGES: f64 = 0.15;
/// Code of such a beam: maximum - 4 (Telegram listing 10.8).
const TOO_WEAK: u16 = 4;

#[cfg(test)]
mod tests {
    use super::*;

    const MM: (Variant, Unit, Mode) = (Variant::HALF, Unit::Mm, Mode(1));

    fn scan(room: &Room, end_ns: Nanos) -> Vec<u16> {
        room.scan(MM.0, MM.1, MM.2, end_ns)
    }

    #[test]
    fn the_same_seed_and_time_give_the_same_scan() {
        let (a, b) = (Room::new(World::Room, 7), Room::new(World::Room, 7));
        assert_eq!(scan(&a, 5_000_000_000), scan(&b, 5_000_000_000));
        assert_ne!(scan(&a, 5_000_000_000), scan(&Room::new(World::Room, 8), 5_000_000_000));
        assert_ne!(scan(&a, 5_000_000_000), scan(&a, 5_026_640_000));
    }

    #[test]
    fn the_room_has_walls_a_far_corridor_a_window_and_reflectors() {
        let room = Room::new(World::Bare, 1);
        let words = scan(&room, 1_000_000_000);
        assert_eq!(words.len(), 361);
        assert!((3_370..3_430).contains(&words[0]), "right wall: {}", words[0]);
        assert!((4_070..4_130).contains(&words[360]), "left wall: {}", words[360]);
        assert_eq!(words[2 * 87], 8191 - 8, "the corridor's end is 14 m away");
        assert_eq!(words[2 * 40], 8191, "window");
        let furnished = scan(&Room::new(World::Room, 1), 1_000_000_000);
        assert!(furnished.iter().filter(|&&word| word >> 13 >= 3 && word & 8191 < 8183).count() >= 5);
        let cm = room.scan(Variant::HALF, Unit::Cm, Mode(1), 1_000_000_000);
        assert!((1_400..1_405).contains(&cm[2 * 87]), "{}", cm[2 * 87]);
    }

    #[test]
    fn noise_is_what_a_real_unit_has() {
        let room = Room::new(World::Bare, 3);
        let values: Vec<f64> = (0..400).map(|i| f64::from(scan(&room, i * 26_640_000)[20])).collect();
        let mean = values.iter().sum::<f64>() / 400.0;
        let deviation = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 399.0).sqrt();
        assert!((3.0..5.0).contains(&deviation), "{deviation} mm");
    }

    #[test]
    fn people_move_and_every_word_fits_every_mode() {
        let room = Room::new(World::Room, 1);
        let (a, b) = (scan(&room, 1_000_000_000), scan(&room, 3_000_000_000));
        assert!(a.iter().zip(&b).filter(|(a, b)| a.abs_diff(**b) > 300).count() > 10);
        for (_, world) in World::ALL {
            for variant in Variant::ALL {
                for mode in [0, 1, 3, 4, 5, 6, 0x0F].map(Mode) {
                    for unit in [Unit::Cm, Unit::Mm, Unit::Dm] {
                        let words = Room::new(world, 2).scan(variant, unit, mode, 1_000_000_000);
                        assert_eq!(words.len(), variant.beams());
                        assert!(words.iter().all(|word| word & mode.forbidden() == 0));
                    }
                }
            }
        }
    }
}
