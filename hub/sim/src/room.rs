//! What the sensor sees: a world, measured the way an LMS 2xx measures it. A pure function of world, seed and time;
//! knows neither telegrams nor the line.

use std::sync::Arc;

use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use schema::{Nanos, Scan, ScanHead};

use crate::labeled_scan::{LabeledScan, Mark, Met};
use crate::layers::{self, BeamRng};
use crate::series::{Changes, Series};
use crate::shape::Shape;
use crate::spot::{Echo, echo};
use crate::view::{View, WorldView};
use crate::world::World;

/// A world with its furniture in place, as one sensor in it sees it.
#[derive(Clone, Debug)]
pub struct Room {
    pub(crate) seed: u64,
    pub(crate) sight: Sight,
}

/// Rendering method of a room.
#[derive(Clone, Debug)]
pub(crate) enum Sight {
    /// No return anywhere.
    Empty,
    /// Every value is this.
    Value(u16),
    Random,
    Scene(Box<WorldView>),
    /// Measured before.
    Series(Arc<Series>, Changes),
}

impl Room {
    /// `world` as `seed` makes it, its noise and the ways of its people, seen by its first sensor.
    pub fn new(world: &World, seed: u64) -> Self {
        Room::of_port(world, seed, 0)
    }

    /// What the sensor at port number `port` sees, counted from 0. The sensors of a world take its ports in turn; when
    /// all have one, the next port belongs to another such world, with the next seed.
    pub fn of_port(world: &World, seed: u64, port: u64) -> Self {
        let sensors = world.sensors() as u64;
        let (seed, sensor) = (seed.wrapping_add(port / sensors), port % sensors);
        let sight = match world {
            World::Empty => Sight::Empty,
            World::Wall640 => Sight::Value(640),
            World::Random => Sight::Random,
            World::Scene(scene) => Sight::Scene(Box::new(WorldView::new(scene, seed, sensor))),
        };
        Room { seed: seed ^ sensor.wrapping_mul(0xD1B5_4A32_D192_ED03), sight }
    }

    /// What a sensor sees for which scans were measured before.
    pub fn of_series(series: Arc<Series>, changes: Changes) -> Self {
        Room { seed: 0, sight: Sight::Series(series, changes) }
    }

    /// The values of the scan whose last mirror turn ended at `end_ns`: as many as `variant` has beams, in `unit`,
    /// split according to `mode`. The same arguments give the same values.
    pub fn scan(&self, variant: Variant, unit: Unit, mode: Mode, end_ns: Nanos) -> Vec<u16> {
        match &self.sight {
            Sight::Series(series, changes) => series.scan(changes, (variant, unit, mode), end_ns),
            _ => self.labeled_scan(variant, unit, mode, end_ns).words,
        }
    }

    /// The words of [`Room::scan`] with their truth.
    pub fn labeled_scan(&self, variant: Variant, unit: Unit, mode: Mode, end_ns: Nanos) -> LabeledScan {
        self.measure(angles_mdeg(variant), variant.turns(), unit, mode, end_ns, &|_| Vec::new())
    }

    /// The value words of the mirror turn that ended at `end_ns`, as a partial scan tells them: 181 beams on whole
    /// degrees, or 180 that lie `quarter` quarters of a degree behind them.
    pub(crate) fn partial(&self, quarter: u8, unit: Unit, mode: Mode, end_ns: Nanos) -> Vec<u16> {
        let beams = if quarter > 0 { 180 } else { 181 };
        let angles_mdeg = (0..beams).map(|beam| 1_000 * beam + 250 * i32::from(quarter) - 90_000).collect();
        self.measure(angles_mdeg, 1, unit, mode, end_ns, &|_| Vec::new()).words
    }

    /// Returns the values of [`Room::scan`] with more shapes in view, such as the legs of people and the doors of a
    /// simulation of the caller. `shapes` returns them at a time, in the frame of the world. A world that is not a scene, and a
    /// tilted sensor, do not show them.
    pub fn scan_with(
        &self,
        shapes: &dyn Fn(Nanos) -> Vec<Shape>,
        variant: Variant,
        unit: Unit,
        mode: Mode,
        end_ns: Nanos,
    ) -> Vec<u16> {
        self.measure(angles_mdeg(variant), variant.turns(), unit, mode, end_ns, shapes).words
    }

    /// Where the reflectors are that can be seen at `time_ns`: the middle of each, unless something hides it.
    pub fn marks(&self, time_ns: Nanos) -> Vec<Mark> {
        match &self.sight {
            Sight::Scene(stage) => stage.marks(time_ns),
            _ => Vec::new(),
        }
    }

    /// Returns what the beams at `angles_mdeg` measure, one after the other in the next of `turns` mirror turns, with
    /// `shapes` in view.
    fn measure(
        &self,
        angles_mdeg: Vec<i32>,
        turns: u64,
        unit: Unit,
        mode: Mode,
        end_ns: Nanos,
        shapes: &dyn Fn(Nanos) -> Vec<Shape>,
    ) -> LabeledScan {
        let mut random = fastrand::Rng::with_seed(self.seed ^ end_ns.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let beams = angles_mdeg.len();
        let words = match &self.sight {
            Sight::Empty => vec![mode.max_value(); beams],
            Sight::Value(value) => vec![*value; beams],
            Sight::Random => (0..beams).map(|_| random.u16(..) & !mode.forbidden()).collect(),
            Sight::Scene(stage) => {
                return measure(stage, &angles_mdeg, turns, unit, mode, end_ns, shapes, &mut random);
            }
            Sight::Series(series, changes) => {
                let room = series.room(changes, end_ns);
                return room.measure(angles_mdeg, turns, unit, mode, end_ns, shapes);
            }
        };
        let truth = words.iter().map(|&word| truth(word, Met::Static { since_ns: 0 }, mode)).collect();
        LabeledScan { words, truth }
    }
}

/// Returns the angles of the beams of `variant`, in thousandths of a degree.
fn angles_mdeg(variant: Variant) -> Vec<i32> {
    let step_mdeg = 10 * i32::from(variant.resolution_cdeg);
    (0..variant.beams() as i32).map(|beam| variant.first_angle_mdeg() + beam * step_mdeg).collect()
}

/// Returns what the beams at `angles_mdeg` measure of `stage` and `shapes`, one after the other in the next of `turns` mirror
/// turns.
#[allow(clippy::too_many_arguments)]
fn measure(
    stage: &WorldView,
    angles_mdeg: &[i32],
    turns: u64,
    unit: Unit,
    mode: Mode,
    end_ns: Nanos,
    shapes: &dyn Fn(Nanos) -> Vec<Shape>,
    random: &mut fastrand::Rng,
) -> LabeledScan {
    if stage.is_tilted() {
        return measure_tilted(stage, angles_mdeg, unit, mode, end_ns, random);
    }
    let times: Vec<Nanos> = (0..turns).map(|turn| stage.layers.turn_ns(turn, turns, end_ns)).collect();
    let views: Vec<View> = times.iter().map(|&time_ns| stage.view_with(time_ns, &shapes(time_ns))).collect();
    let mut look = LabeledScan { words: Vec::new(), truth: Vec::new() };
    for (beam, &angle_mdeg) in angles_mdeg.iter().enumerate() {
        // The beams between whole degrees are measured in the turns after the first.
        let turn = beam % turns as usize;
        look_along(stage, &views[turn], (angle_mdeg, times[turn]), (unit, mode), random, &mut look);
    }
    look
}

/// The same of a sensor whose plane turns while it measures: each beam is measured at its own time, as
/// [`ScanHead::lms`] has it; without layer `comb` all are of the end.
fn measure_tilted(
    stage: &WorldView,
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
    let mut view = stage.still().clone();
    let mut look = LabeledScan { words: Vec::new(), truth: Vec::new() };
    for (beam, &angle_mdeg) in angles_mdeg.iter().enumerate() {
        let off_ns = if stage.layers.comb { times.beam_ns(beam) } else { 0 };
        let at_ns = end_ns.saturating_add_signed(off_ns);
        stage.look_along(&mut view, f64::from(angle_mdeg) / 1e3, at_ns);
        look_along(stage, &view, (angle_mdeg, at_ns), (unit, mode), random, &mut look);
    }
    look
}

/// Adds to `look` what the beam at the angle and time `at` tells, around which `view` lies.
fn look_along(
    stage: &WorldView,
    view: &View,
    at: (i32, Nanos),
    (unit, mode): (Unit, Mode),
    random: &mut fastrand::Rng,
    look: &mut LabeledScan,
) {
    let (angle_mdeg, time_ns) = at;
    let dice = BeamRng::throw(random);
    let echo = echo(view, angle_mdeg, stage.layers.spot, &dice);
    let time_s = time_ns as f64 / 1e9;
    let sun = stage.suns.iter().map(|sun| sun.share(angle_mdeg, time_s)).fold(0.0, f64::max);
    let word = word(stage, &echo, sun, unit, mode, &dice);
    look.words.push(word);
    look.truth.push(truth(word, echo.met, mode));
}

/// What a beam says that got `echo`, while the sun dazzles `sun` of its like.
fn word(stage: &WorldView, echo: &Echo, sun: f64, unit: Unit, mode: Mode, dice: &BeamRng) -> u16 {
    match reported_range(stage, echo, sun, dice) {
        Err(code) => mode.max_value() - code,
        Ok(range_mm) => {
            let range = range_value(range_mm / f64::from(unit.mm()), mode);
            range | level(echo, mode, dice) << mode.range_bits()
        }
    }
}

/// Returns the range in millimeters that the scanner reports for a beam with this `echo`. Otherwise returns the code
/// that it reports, counted down from the highest value.
pub(crate) fn reported_range(stage: &WorldView, echo: &Echo, sun: f64, dice: &BeamRng) -> Result<f64, u16> {
    if stage.layers.dazzles(sun, dice) {
        Err(layers::DAZZLE)
    } else if echo.range_mm.is_infinite() || dice.code >= echo.returns {
        Err(layers::NO_RETURN)
    } else if stage.layers.loses(echo.signal, echo.torn, dice) {
        Err(layers::TOO_WEAK)
    } else if let Some(error) = stage.layers.error(dice) {
        Err(error)
    } else {
        Ok(echo.range_mm + stage.bias_mm + stage.layers.deviation_mm(echo.edge, dice))
    }
}

/// What is true of a beam that says `word` and met `met`.
fn truth(word: u16, met: Met, mode: Mode) -> Met {
    if word & mode.max_value() >= mode.max_value() - recording::BEYOND { Met::Invalid } else { met }
}

/// The range value of `units` (any number), or the code for what is beyond the mode's range.
fn range_value(units: f64, mode: Mode) -> u16 {
    let beyond = mode.max_value() - recording::BEYOND;
    (units.round().max(0.0) as u16).min(beyond)
}

/// Level of a reflector.
fn level(echo: &Echo, mode: Mode, dice: &BeamRng) -> u16 {
    if echo.bright == 0.0 {
        return 0;
    }
    let most = f64::from((1u16 << mode.intensity_bits()) - 1);
    // Real recordings show 0 to 5 of 7.
    let top = (most * 0.75).round();
    (top * echo.bright + LEVEL_DEVIATION * dice.bright).round().clamp(0.0, most) as u16
}

/// Standard deviation of a reflector level; a recording of a standing sensor shows none at all.
const LEVEL_DEVIATION: f64 = 0.1;

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
    fn the_same_seed_and_time_give_the_same_scan_and_truth() {
        let (a, b) = (room("room", 7), room("room", 7));
        let look = |room: &Room, end_ns| room.labeled_scan(MM.0, MM.1, MM.2, end_ns);
        assert_eq!(look(&a, 5_000_000_000), look(&b, 5_000_000_000));
        assert_ne!(scan(&a, 5_000_000_000), scan(&room("room", 8), 5_000_000_000));
        assert_ne!(scan(&a, 5_000_000_000), scan(&a, 5_026_640_000));
    }

    #[test]
    fn the_room_has_walls_a_far_passage_a_window_and_reflectors() {
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
    fn noise_is_what_a_real_unit_has() {
        let room = room("bare", 3);
        let values: Vec<f64> = (0..400).map(|i| f64::from(scan(&room, i * 26_640_000)[20])).collect();
        let mean = values.iter().sum::<f64>() / 400.0;
        let deviation = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 399.0).sqrt();
        assert!((3.0..5.0).contains(&deviation), "{deviation} mm");
    }

    #[test]
    fn people_move_and_every_word_fits_every_mode() {
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
}
