//! Measurements of an LMS 2xx in a world, with the true target of each beam. The measurements are a pure function of
//! world, seed and time. [`PrecomputedScans`] are measured once and then repeated. They are for simulations that run
//! through hours in seconds, because measuring a scan takes far longer than sending it.

use std::sync::Arc;

use scanhub_drivers::lms::variant::{MIRROR_PERIOD, Mode, Unit, Variant};
use scanhub_schema::{Nanos, Scan, ScanHead};

use crate::beam::{self, BeamRng};
use crate::beam::{Echo, echo};
use crate::shape::Shape;
use crate::view::{View, WorldView};
use crate::world::World;

/// A world with its random parts drawn, as one of its sensors sees it.
#[derive(Clone, Debug)]
pub struct Room {
    pub(crate) seed: u64,
    pub(crate) view: RoomView,
}

/// Origin of the scans of a room.
#[derive(Clone, Debug)]
pub(crate) enum RoomView {
    /// No beam has a return.
    Empty,
    /// All beams have this value.
    Value(u16),
    Random,
    Scene(Box<WorldView>),
    /// Scans that were measured in advance.
    PrecomputedScans(Arc<PrecomputedScans>, Changes),
}

impl Room {
    /// Creates the room of the first sensor in `world`. Noise and paths of people are drawn from `seed`.
    pub fn new(world: &World, seed: u64) -> Self {
        Room::of_port(world, seed, 0)
    }

    /// Creates the room of the sensor at the port with index `port`. If there are more ports than sensors in the world,
    /// the next ports belong to the sensors of a second copy of the world, with the next seed.
    pub fn of_port(world: &World, seed: u64, port: u64) -> Self {
        let sensors = world.sensors() as u64;
        let (seed, sensor) = (seed.wrapping_add(port / sensors), port % sensors);
        let view = match world {
            World::Empty => RoomView::Empty,
            World::Wall640 => RoomView::Value(640),
            World::Random => RoomView::Random,
            World::Scene(scene) => RoomView::Scene(Box::new(WorldView::new(scene, seed, sensor))),
        };
        Room { seed: seed ^ sensor.wrapping_mul(0xD1B5_4A32_D192_ED03), view }
    }

    /// Creates the room of a sensor whose scans were measured in advance.
    pub fn of_series(series: Arc<PrecomputedScans>, changes: Changes) -> Self {
        Room { seed: 0, view: RoomView::PrecomputedScans(series, changes) }
    }

    /// Returns the values of the scan whose last revolution of the mirror ended at `end_ns`: one value for each beam of
    /// `variant`. Each value has a range in `unit`, and the other bits that `mode` defines. The same arguments give the
    /// same values.
    pub fn scan(&self, variant: Variant, unit: Unit, mode: Mode, end_ns: Nanos) -> Vec<u16> {
        match &self.view {
            RoomView::PrecomputedScans(series, changes) => {
                series.scan(changes, (variant, unit, mode), end_ns)
            }
            _ => self.labeled_scan(variant, unit, mode, end_ns).words,
        }
    }

    /// Returns the values of [`Room::scan`] with their true targets.
    pub fn labeled_scan(&self, variant: Variant, unit: Unit, mode: Mode, end_ns: Nanos) -> LabeledScan {
        self.measure(angles_mdeg(variant), variant.revolutions(), unit, mode, end_ns, &|_| Vec::new())
    }

    /// Returns the values of the partial scan whose revolution of the mirror ended at `end_ns`. If `quarter` is 0, it
    /// has 181 beams on whole degrees. Otherwise it has 180 beams, `quarter` quarters of a degree after whole degrees.
    pub(crate) fn partial_scan(&self, quarter: u8, unit: Unit, mode: Mode, end_ns: Nanos) -> Vec<u16> {
        let beams = if quarter > 0 { 180 } else { 181 };
        let angles_mdeg = (0..beams).map(|beam| 1_000 * beam + 250 * i32::from(quarter) - 90_000).collect();
        self.measure(angles_mdeg, 1, unit, mode, end_ns, &|_| Vec::new()).words
    }

    /// Returns the values of [`Room::scan`] with additional shapes in view, such as the legs of people and the doors in
    /// a simulation of the caller. `shapes` returns the shapes at a time, in the frame of the world. If the world is
    /// not a scene, or if the sensor is tilted, the additional shapes are ignored.
    pub fn scan_with(
        &self,
        shapes: &dyn Fn(Nanos) -> Vec<Shape>,
        variant: Variant,
        unit: Unit,
        mode: Mode,
        end_ns: Nanos,
    ) -> Vec<u16> {
        self.measure(angles_mdeg(variant), variant.revolutions(), unit, mode, end_ns, shapes).words
    }

    /// Returns the middle of each reflector that is visible at `time_ns`.
    pub fn marks(&self, time_ns: Nanos) -> Vec<Mark> {
        match &self.view {
            RoomView::Scene(world) => world.marks(time_ns),
            _ => Vec::new(),
        }
    }

    /// Returns the measurements of the beams at `angles_mdeg`, with `shapes` in view. Beam i is measured in revolution
    /// i modulo `revolutions` of the mirror.
    fn measure(
        &self,
        angles_mdeg: Vec<i32>,
        revolutions: u64,
        unit: Unit,
        mode: Mode,
        end_ns: Nanos,
        shapes: &dyn Fn(Nanos) -> Vec<Shape>,
    ) -> LabeledScan {
        let mut random = fastrand::Rng::with_seed(self.seed ^ end_ns.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let beams = angles_mdeg.len();
        let words = match &self.view {
            RoomView::Empty => vec![mode.max_value(); beams],
            RoomView::Value(value) => vec![*value; beams],
            RoomView::Random => (0..beams).map(|_| random.u16(..) & !mode.forbidden()).collect(),
            RoomView::Scene(world) => {
                return measure(world, &angles_mdeg, revolutions, unit, mode, end_ns, shapes, &mut random);
            }
            RoomView::PrecomputedScans(series, changes) => {
                let room = series.room(changes, end_ns);
                return room.measure(angles_mdeg, revolutions, unit, mode, end_ns, shapes);
            }
        };
        let truth = words.iter().map(|&word| truth(word, BeamTarget::Static { since_ns: 0 }, mode)).collect();
        LabeledScan { words, truth }
    }
}

/// Returns the angles of the beams of `variant`, in thousandths of a degree.
fn angles_mdeg(variant: Variant) -> Vec<i32> {
    let step_mdeg = 10 * i32::from(variant.resolution_cdeg);
    (0..variant.beams() as i32).map(|beam| variant.first_angle_mdeg() + beam * step_mdeg).collect()
}

/// Returns the measurements of the beams at `angles_mdeg` in `world`, with `shapes` in view. Beam i is measured in
/// revolution i modulo `revolutions` of the mirror.
#[allow(clippy::too_many_arguments)]
fn measure(
    world: &WorldView,
    angles_mdeg: &[i32],
    revolutions: u64,
    unit: Unit,
    mode: Mode,
    end_ns: Nanos,
    shapes: &dyn Fn(Nanos) -> Vec<Shape>,
    random: &mut fastrand::Rng,
) -> LabeledScan {
    if world.is_tilted() {
        return measure_tilted(world, angles_mdeg, unit, mode, end_ns, random);
    }
    let times: Vec<Nanos> = (0..revolutions)
        .map(|revolution| world.noise.revolution_ns(revolution, revolutions, end_ns))
        .collect();
    let views: Vec<View> = times.iter().map(|&time_ns| world.view_with(time_ns, &shapes(time_ns))).collect();
    let mut scan = LabeledScan::default();
    for (beam, &angle_mdeg) in angles_mdeg.iter().enumerate() {
        // Beams between whole degrees are measured in the later revolutions.
        let revolution = beam % revolutions as usize;
        measure_beam(
            world,
            &views[revolution],
            (angle_mdeg, times[revolution]),
            (unit, mode),
            random,
            &mut scan,
        );
    }
    scan
}

/// Returns the measurements of a sensor whose plane moves during the scan. Each beam is measured at its own time
/// according to [`ScanHead::lms`]. Without the layer `comb`, all beams are measured at the end of the scan.
fn measure_tilted(
    world: &WorldView,
    angles_mdeg: &[i32],
    unit: Unit,
    mode: Mode,
    end_ns: Nanos,
    random: &mut fastrand::Rng,
) -> LabeledScan {
    let step_mdeg = angles_mdeg.windows(2).map(|pair| pair[1] - pair[0]).next().unwrap_or(1000);
    let first_mdeg = angles_mdeg.first().copied().unwrap_or(0);
    let head =
        ScanHead::lms(angles_mdeg.len(), first_mdeg, step_mdeg as u32, unit.mm().into(), mode.range_bits());
    let times = Scan::of(head, &vec![0; angles_mdeg.len()]);
    let mut view = world.still().clone();
    let mut scan = LabeledScan::default();
    for (beam, &angle_mdeg) in angles_mdeg.iter().enumerate() {
        let off_ns = if world.noise.comb { times.beam_ns(beam) } else { 0 };
        let at_ns = end_ns.saturating_add_signed(off_ns);
        world.show_beam(&mut view, f64::from(angle_mdeg) / 1e3, at_ns);
        measure_beam(world, &view, (angle_mdeg, at_ns), (unit, mode), random, &mut scan);
    }
    scan
}

/// Adds the beam at the angle and time `at` to `scan`. `view` contains the surroundings of the beam.
fn measure_beam(
    world: &WorldView,
    view: &View,
    at: (i32, Nanos),
    (unit, mode): (Unit, Mode),
    random: &mut fastrand::Rng,
    scan: &mut LabeledScan,
) {
    let (angle_mdeg, time_ns) = at;
    let rng = BeamRng::draw(random);
    let echo = echo(view, angle_mdeg, world.noise.spot, &rng);
    let time_s = time_ns as f64 / 1e9;
    let sun = world.suns.iter().map(|sun| sun.share(angle_mdeg, time_s)).fold(0.0, f64::max);
    let word = word(world, &echo, sun, unit, mode, &rng);
    scan.words.push(word);
    scan.truth.push(truth(word, echo.target, mode));
}

/// Returns the value of a beam with this `echo`. The sun dazzles the share `sun` of the beams in this direction.
fn word(world: &WorldView, echo: &Echo, sun: f64, unit: Unit, mode: Mode, rng: &BeamRng) -> u16 {
    match reported_range(world, echo, sun, rng) {
        Err(code) => mode.max_value() - code,
        Ok(range_mm) => {
            let range = range_value(range_mm / f64::from(unit.mm()), mode);
            range | level(echo, mode, rng) << mode.range_bits()
        }
    }
}

/// Returns the range in millimeters that the scanner reports for a beam with this `echo`. If the scanner reports a code
/// instead, returns the code, counted down from the highest value.
pub(crate) fn reported_range(world: &WorldView, echo: &Echo, sun: f64, rng: &BeamRng) -> Result<f64, u16> {
    if world.noise.dazzles(sun, rng) {
        Err(beam::DAZZLE)
    } else if echo.range_mm.is_infinite() || rng.code >= echo.returns {
        Err(beam::NO_RETURN)
    } else if world.noise.loses(echo.signal, echo.is_torn, rng) {
        Err(beam::TOO_WEAK)
    } else if let Some(error) = world.noise.error(rng) {
        Err(error)
    } else {
        Ok(echo.range_mm + world.bias_mm + world.noise.deviation_mm(echo.is_edge, rng))
    }
}

/// Returns the true target of a beam that hit `target` and reported `word`.
fn truth(word: u16, target: BeamTarget, mode: Mode) -> BeamTarget {
    if word & mode.max_value() >= mode.max_value() - scanhub_recording::BEYOND_RANGE_OFFSET {
        BeamTarget::Invalid
    } else {
        target
    }
}

/// Returns the value for a range of `units`, or the code for a range beyond the maximum. A negative range becomes 0.
fn range_value(units: f64, mode: Mode) -> u16 {
    let beyond = mode.max_value() - scanhub_recording::BEYOND_RANGE_OFFSET;
    (units.round().max(0.0) as u16).min(beyond)
}

/// Returns the reflector level of a beam; 0 if the beam does not hit a reflector.
fn level(echo: &Echo, mode: Mode, rng: &BeamRng) -> u16 {
    if echo.reflector_share == 0.0 {
        return 0;
    }
    let max = f64::from((1u16 << mode.intensity_bits()) - 1);
    // Reflectors in real recordings have levels of 0 to 5, of a maximum of 7.
    let top = (max * 0.75).round();
    (top * echo.reflector_share + LEVEL_DEVIATION * rng.bright).round().clamp(0.0, max) as u16
}

/// A scan, and the true targets of its beams.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LabeledScan {
    /// A value word for each beam.
    pub words: Vec<u16>,
    /// The target of each beam, in the same order.
    pub truth: Vec<BeamTarget>,
}

/// Target that the whole spot of a beam hits.
///
/// A target that has appeared, disappeared or moved has the time of this change. The user of this type decides for how
/// long after this time the target counts as foreground.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BeamTarget {
    /// A surface of the surroundings at the start of the world, or another surface that is not nearer than the previous
    /// target.
    Static {
        /// Time from which on the beam hits this surface: 0, or the time at which an object in front of the surface was
        /// removed. In the second case, the surface is old, but new to the beam. People who pass do not change this
        /// time.
        since_ns: Nanos,
    },
    /// A leg of a person who stands or walks.
    Person,
    /// An object or a door that was put down or moved after the start of the world, and is nearer than the previous
    /// target. An object that moved away from the sensor is [`BeamTarget::Static`], like the surfaces that it
    /// uncovered.
    Box {
        /// Time at which the object was put down or came to rest. While the object moves, it is the time of the scan.
        since_ns: Nanos,
    },
    /// A person or an object as in [`BeamTarget::Box`], together with another surface next to it. The beam may report
    /// either of the two. Beams at the edges of a box have this target for as long as the box exists.
    Grazed,
    /// Any target, if the value is a code instead of a range.
    Invalid,
}

/// True position of a reflector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// Angle of the reflector's middle in degrees, counterclockwise, 0 ahead of the sensor.
    pub angle_deg: f64,
    /// Range of the reflector's middle in millimeters.
    pub range_mm: f64,
}

/// Several scans of each of a few rooms. A sensor changes between the rooms at fixed times ([`Changes`]). No two scans
/// within [`PrecomputedScans::COUNT_CYCLE`] revolutions of the mirror are equal, because the value of the first beam
/// counts the revolutions.
#[derive(Clone, Debug)]
pub struct PrecomputedScans {
    settings: (Variant, Unit, Mode),
    rooms: Vec<(Room, Vec<Vec<u16>>)>,
}

/// The sequence of rooms that one sensor of [`PrecomputedScans`] sees: the time of each change, and the room after it.
#[derive(Clone, Debug, Default)]
pub struct Changes(Vec<(Nanos, usize)>);

impl PrecomputedScans {
    /// Number of revolutions of the mirror after which the count of the first beam restarts: 54 s.
    pub const COUNT_CYCLE: u64 = 4_096;

    /// Measures `count` scans (at least one) of each of `rooms` (at least one) with `variant`, `unit` and `mode`. For a
    /// sensor with other settings, each scan is measured on demand.
    pub fn new(rooms: Vec<Room>, count: usize, variant: Variant, unit: Unit, mode: Mode) -> PrecomputedScans {
        let measured = |room: Room| {
            let scans = (0..count as Nanos).map(|i| room.scan(variant, unit, mode, i * PERIOD)).collect();
            (room, scans)
        };
        PrecomputedScans { settings: (variant, unit, mode), rooms: rooms.into_iter().map(measured).collect() }
    }

    /// Returns the scan that ended at `end_ns` in the room that `changes` select for this time.
    pub(crate) fn scan(
        &self,
        changes: &Changes,
        (variant, unit, mode): (Variant, Unit, Mode),
        end_ns: Nanos,
    ) -> Vec<u16> {
        let (room, scans) = self.at(changes, end_ns);
        if (variant, unit, mode) != self.settings {
            return room.scan(variant, unit, mode, end_ns);
        }
        let revolution = end_ns / MIRROR_PERIOD;
        let mixed = revolution.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32;
        let mut words = scans[(mixed % scans.len() as u64) as usize].clone();
        words[0] = COUNT_START + (revolution % PrecomputedScans::COUNT_CYCLE) as u16;
        words
    }

    /// Returns the room that `changes` select for `time_ns`.
    pub(crate) fn room(&self, changes: &Changes, time_ns: Nanos) -> &Room {
        &self.at(changes, time_ns).0
    }

    /// Returns all rooms.
    pub(crate) fn rooms(&self) -> impl Iterator<Item = &Room> {
        self.rooms.iter().map(|(room, _)| room)
    }

    /// Returns the index of the room that `changes` select for `time_ns`.
    pub(crate) fn number(&self, changes: &Changes, time_ns: Nanos) -> usize {
        changes.at(time_ns).min(self.rooms.len() - 1)
    }

    fn at(&self, changes: &Changes, time_ns: Nanos) -> &(Room, Vec<Vec<u16>>) {
        &self.rooms[self.number(changes, time_ns)]
    }
}

impl Changes {
    /// Creates changes from pairs of a time and the index of the room from this time on, in the order of time. Before
    /// the first time, the sensor is in the first room.
    pub fn new(changes: Vec<(Nanos, usize)>) -> Changes {
        Changes(changes)
    }

    fn at(&self, time_ns: Nanos) -> usize {
        let started = self.0.partition_point(|&(from, _)| from <= time_ns);
        started.checked_sub(1).map_or(0, |last| self.0[last].1)
    }
}

/// Standard deviation of a reflector level. A recording of a standing sensor shows no deviation at all.
const LEVEL_DEVIATION: f64 = 0.1;
/// Period of the scans that are measured in advance. Any other period would do, too.
const PERIOD: Nanos = 26_640_000;
/// Value of the first beam at count 0. The sum of this value and the highest count fits into 13 bits, and is below all
/// codes.
const COUNT_START: u16 = 2_000;

#[cfg(test)]
mod tests {
    use super::*;

    const MM: (Variant, Unit, Mode) = (Variant::HALF, Unit::Mm, Mode(1));

    fn room(name: &str, seed: u64) -> Room {
        Room::new(&name.parse().unwrap(), seed)
    }

    fn scan(room: &Room, end_ns: Nanos) -> Vec<u16> {
        room.scan(MM.0, MM.1, MM.2, end_ns)
    }

    #[test]
    fn same_seed_and_time_give_same_scan_and_truth() {
        let (a, b) = (room("room", 7), room("room", 7));
        let look = |room: &Room, end_ns| room.labeled_scan(MM.0, MM.1, MM.2, end_ns);
        assert_eq!(look(&a, 5_000_000_000), look(&b, 5_000_000_000));
        assert_ne!(scan(&a, 5_000_000_000), scan(&room("room", 8), 5_000_000_000));
        assert_ne!(scan(&a, 5_000_000_000), scan(&a, 5_026_640_000));
    }

    #[test]
    fn room_has_walls_passage_window_and_reflectors() {
        let bare = room("bare", 1);
        let words = scan(&bare, 1_000_000_000);
        assert_eq!(words.len(), 361);
        assert!((3_370..3_430).contains(&words[0]), "right wall: {}", words[0]);
        assert!((4_070..4_130).contains(&words[360]), "left wall: {}", words[360]);
        assert_eq!(words[2 * 87], 8191 - 8, "the passage's end is 14 m away");
        assert_eq!(words[2 * 40], 8191, "window");
        let furnished = scan(&room("room", 1), 1_000_000_000);
        assert!(furnished.iter().filter(|&&word| word >> 13 >= 3 && word & 8191 < 8183).count() >= 5);
        let cm = bare.scan(Variant::HALF, Unit::Cm, Mode(1), 1_000_000_000);
        assert!((1_400..1_405).contains(&cm[2 * 87]), "{}", cm[2 * 87]);
    }

    #[test]
    fn noise_matches_real_scanner() {
        let room = room("bare", 3);
        let values: Vec<f64> = (0..400).map(|i| f64::from(scan(&room, i * 26_640_000)[20])).collect();
        let mean = values.iter().sum::<f64>() / 400.0;
        let deviation = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 399.0).sqrt();
        assert!((3.0..5.0).contains(&deviation), "{deviation} mm");
    }

    #[test]
    fn people_move_and_values_fit_every_mode() {
        let busy = room("room", 1);
        let (a, b) = (scan(&busy, 1_000_000_000), scan(&busy, 3_000_000_000));
        assert!(a.iter().zip(&b).filter(|(a, b)| a.abs_diff(**b) > 300).count() > 10);
        for name in World::names() {
            let room = room(name, 2);
            for variant in Variant::ALL {
                for mode in [0, 1, 3, 4, 5, 6, 0x0F].map(Mode) {
                    for unit in [Unit::Cm, Unit::Mm, Unit::Dm] {
                        let look = room.labeled_scan(variant, unit, mode, 1_000_000_000);
                        assert_eq!((look.words.len(), look.truth.len()), (variant.beams(), variant.beams()));
                        assert!(look.words.iter().all(|word| word & mode.forbidden() == 0));
                    }
                }
            }
        }
    }

    const SETTINGS: (Variant, Unit, Mode) = (Variant::HALF, Unit::Mm, Mode(1));

    #[test]
    fn repeats_scans_of_room_and_makes_each_unique() {
        let (variant, unit, mode) = SETTINGS;
        let rooms = ["bare", "wall640"].map(|name| Room::new(&name.parse().unwrap(), 1)).to_vec();
        let series = Arc::new(PrecomputedScans::new(rooms.clone(), 4, variant, unit, mode));
        let changes = Changes::new(vec![(1_000_000_000, 1), (2_000_000_000, 0)]);
        let room = Room::of_series(series, changes);
        let mut met = std::collections::HashSet::new();
        for i in 0..100 {
            let end_ns = i * PERIOD;
            let words = room.scan(variant, unit, mode, end_ns);
            let is_wall = words[1..].iter().all(|&word| word == 640);
            assert_eq!((words.len(), is_wall), (361, (38..76).contains(&i)), "{i}");
            assert!(met.insert(words));
        }
        let cm = room.scan(variant, Unit::Cm, mode, 500_000_000);
        assert_eq!(cm, rooms[0].scan(variant, Unit::Cm, mode, 500_000_000));
    }
}
