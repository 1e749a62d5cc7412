//! What stands around the sensor, as far as it matters to a parser: which bytes telegrams consist of.

use super::TELEGRAM;
use fastrand::Rng;
use scanhub_drivers::lms::measured;
use scanhub_drivers::lms::variant::Unit;

const BEAMS: usize = 361;

/// A surrounding, and what makes it easy or hard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scene {
    /// Walls and furniture with noise, in mm: the everyday case.
    Furnished,
    /// Nothing in range but a few grains of dust: long runs of equal bytes, so many losses cannot be told apart.
    Empty,
    /// A wall at 640 cm all around: its words are the first two bytes of a header.
    Wall,
    /// Random words: every byte value everywhere, whatever a room may be.
    Random,
}

impl Scene {
    /// All four.
    pub(crate) const ALL: [Scene; 4] = [Scene::Furnished, Scene::Empty, Scene::Wall, Scene::Random];

    /// Its name in a table.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Scene::Furnished => "furnished",
            Scene::Empty => "empty",
            Scene::Wall => "wall at 640 cm",
            Scene::Random => "random words",
        }
    }

    /// The bytes of `count` telegrams, one behind the other.
    pub(crate) fn telegrams(self, count: usize, rng: &mut Rng) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(count * TELEGRAM);
        let mut room = [0; BEAMS];
        for number in 0..count {
            if number % SCANS_PER_PLACE == 0 {
                room = furniture(rng);
            }
            let words = match self {
                Scene::Furnished => room.map(|range| range + rng.u16(..10)),
                Scene::Empty => [FAR; BEAMS].map(|far| one_in(rng, 200).map_or(far, |rng| rng.u16(20..4000))),
                Scene::Wall => [640; BEAMS].map(|wall| one_in(rng, 40).map_or(wall, |rng| rng.u16(639..642))),
                Scene::Random => [0; BEAMS].map(|_: u16| rng.u16(..)),
            };
            let unit = if self == Scene::Wall { Unit::Cm } else { Unit::Mm };
            bytes.extend(measured::encode(0, unit, &words, 0x10).bytes());
        }
        bytes
    }
}

/// Flat faces, each a run of beams whose ranges rise or fall evenly.
fn furniture(rng: &mut Rng) -> [u16; BEAMS] {
    let mut ranges = [0; BEAMS];
    let mut at = 0;
    while at < BEAMS {
        let beams = rng.usize(8..60).min(BEAMS - at);
        let (near, slope) = (rng.i32(500..7000), rng.i32(-15..16));
        for (i, range) in ranges[at..at + beams].iter_mut().enumerate() {
            *range = (near + slope * i as i32).clamp(20, 8000) as u16;
        }
        at += beams;
    }
    ranges
}

fn one_in(rng: &mut Rng, n: u32) -> Option<&mut Rng> {
    (rng.u32(..n) == 0).then_some(rng)
}

/// The code of a beam without return, 13 bits.
const FAR: u16 = 0x1FFF;
/// A moving robot sees another piece of the room after so many scans.
const SCANS_PER_PLACE: usize = 100;
