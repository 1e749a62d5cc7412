//! Computes the result of one beam: its echo, and the noise of the measured range.
//!
//! The echo is computed from the rays that the spot of the beam covers. If the rays hit two surfaces, the scanner
//! reports the range of one surface. If the surfaces are not far apart, the scanner may report a range between the two
//! surfaces instead. This range depends on the share of the light on each surface, so it hardly changes from scan to
//! scan. `cargo run --release -p scanhub-sim --example edges` measures such ranges.
//!
//! The noise has layers, each with its own switch. Two effects have no switch: ranges are sent in whole units, and a
//! range beyond the maximum is sent as a code.

use scanhub_drivers::lms;
use scanhub_schema::Nanos;

use crate::room::BeamTarget;
use crate::scene::Surface;
use crate::shape::Shape;
use crate::view::{Face, Hit, Kind, RAY_STEP, SPOT_RAYS, View};

/// Strength of each layer of noise. A share or a length of 0 switches the layer off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseModel {
    /// Maximum of the constant error that all ranges of one scanner share, in millimeters. The error is drawn uniformly
    /// from the seed.
    pub bias_mm: f64,
    /// Standard deviation of a range, in millimeters.
    pub sigma_mm: f64,
    /// Share of the readings at edges that have the standard deviation [`TAIL_SIGMA_MM`]. Other readings do not have
    /// it, because in recordings, large errors come from few beams. In a recording of a scanner at rest, 316 of 348
    /// beams never had an error of 30 mm, and 22 beams had such an error in more than one scan of a hundred.
    pub tail: f64,
    /// Whether a beam is as wide as a real beam. A wide beam on two surfaces reports the range of either surface, or a
    /// range between the two. If the surfaces are far apart, it reports the range of either surface, or the code for a
    /// signal that is too weak. Without this layer, a beam is a line without width.
    pub spot: bool,
    /// Share of the beams that report a code although they could report a range.
    pub errors: f64,
    /// Whether far surfaces that are dark or oblique return too weak a signal.
    pub weak: bool,
    /// Whether the sun dazzles beams that point toward it.
    pub dazzle: bool,
    /// Whether beams between whole degrees are measured in later revolutions of the mirror than beams at whole degrees,
    /// as in a real scanner. Otherwise all beams are measured at the same time.
    pub comb: bool,
}

impl NoiseModel {
    /// No noise: ranges are exact to the unit.
    pub const NONE: NoiseModel = NoiseModel {
        bias_mm: 0.0,
        sigma_mm: 0.0,
        tail: 0.0,
        spot: false,
        errors: 0.0,
        weak: false,
        dazzle: false,
        comb: false,
    };
}

impl Default for NoiseModel {
    /// Returns all layers with the strength of real recordings: the ranges of a beam have a standard deviation of 6 to
    /// 7 mm, and 0.5 % of the beams report a code.
    fn default() -> Self {
        NoiseModel {
            bias_mm: 15.0,
            sigma_mm: 5.0,
            tail: 0.1,
            spot: true,
            errors: 0.005,
            weak: true,
            dazzle: true,
            comb: true,
        }
    }
}

/// Random numbers of one beam. They are drawn even if their layer is off, so that switching a layer off does not change
/// the other layers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BeamRng {
    /// Deviation of the beam's direction, standard normal.
    pub(crate) mirror: f64,
    /// Selects the surface that the scanner reports if the spot is on two surfaces, 0 to 1.
    pub(crate) surface: f64,
    /// Selects whether the scanner reports a range between the two surfaces instead, 0 to 1.
    pub(crate) between: f64,
    /// Selects whether a signal is too weak, 0 to 1.
    pub(crate) weak: f64,
    /// Brightness of a reflector, standard normal.
    pub(crate) bright: f64,
    pub(crate) deviation: f64,
    pub(crate) tail: f64,
    pub(crate) error: f64,
    pub(crate) code: f64,
    pub(crate) dazzle: f64,
}

impl BeamRng {
    /// Draws the numbers of the next beam.
    pub(crate) fn draw(random: &mut fastrand::Rng) -> BeamRng {
        BeamRng {
            mirror: gaussian(random),
            surface: random.f64(),
            between: random.f64(),
            weak: random.f64(),
            bright: gaussian(random),
            deviation: gaussian(random),
            tail: random.f64(),
            error: random.f64(),
            code: random.f64(),
            dazzle: random.f64(),
        }
    }
}

impl NoiseModel {
    /// Returns the deviation of a reading in millimeters, without the constant error. The deviation may be larger at an
    /// `edge`.
    pub(crate) fn deviation_mm(&self, edge: bool, rng: &BeamRng) -> f64 {
        rng.deviation * if edge && rng.tail < self.tail { TAIL_SIGMA_MM } else { self.sigma_mm }
    }

    /// Returns the code that this beam reports although it could report a range. Returns `None` if the beam reports the
    /// range. The code is counted down from the maximum.
    pub(crate) fn error(&self, rng: &BeamRng) -> Option<u16> {
        let of = |code: &&(f64, u16)| rng.code < code.0;
        (rng.error < self.errors).then(|| CODES.iter().find(of).map_or(NO_RETURN, |code| code.1))
    }

    /// Returns whether the scanner misses an echo of this `signal`. With the layer `weak`, it misses every echo below
    /// [`MIN_SIGNAL`], and no echo above twice [`MIN_SIGNAL`]. If the spot is `torn` between two distant surfaces, it
    /// also misses [`EDGE_LOSS_SHARE`] of the echoes.
    pub(crate) fn loses(&self, signal: f64, torn: bool, rng: &BeamRng) -> bool {
        let faint = self.weak && rng.weak > signal / MIN_SIGNAL - 1.0;
        faint || torn && rng.weak < EDGE_LOSS_SHARE
    }

    /// Returns whether the sun dazzles this beam. It dazzles the given `share` of the beams in its direction.
    pub(crate) fn dazzles(&self, share: f64, rng: &BeamRng) -> bool {
        self.dazzle && rng.dazzle < share
    }

    /// Returns the time at which revolution number `revolution` of the mirror started, in a scan that ended at `end_ns`
    /// and took `revolutions` revolutions.
    pub(crate) fn revolution_ns(&self, revolution: u64, revolutions: u64, end_ns: Nanos) -> Nanos {
        let before_end = if self.comb { revolutions - revolution } else { 1 };
        end_ns.saturating_sub(before_end * lms::variant::MIRROR_PERIOD)
    }
}

#[cfg(test)]
impl BeamRng {
    /// The random numbers in the middle of each distribution.
    const CENTER: BeamRng = BeamRng {
        mirror: 0.0,
        surface: 0.5,
        between: 0.5,
        weak: 0.5,
        bright: 0.0,
        deviation: 0.0,
        tail: 0.5,
        error: 0.5,
        code: 0.5,
        dazzle: 0.5,
    };
}

/// Returns a number from the standard normal distribution, as the sum of twelve uniform numbers.
fn gaussian(random: &mut fastrand::Rng) -> f64 {
    (0..12).map(|_| random.f64()).sum::<f64>() - 6.0
}

/// Echo of a beam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Echo {
    /// Range; infinite if there is no echo.
    pub(crate) range_mm: f64,
    /// Signal relative to a white surface at 1 m that is at a right angle to the beam.
    pub(crate) signal: f64,
    /// Share of the beams on such a surface that have an echo. It is 1, except for a faint surface.
    pub(crate) returns: f64,
    /// Share of the light that fell on reflectors.
    pub(crate) reflector_share: f64,
    /// Whether a beam with the width of a real beam would hit two surfaces at different ranges, and no reflector.
    pub(crate) is_edge: bool,
    /// Whether the spot of this beam hit two surfaces that are far apart, and no reflector.
    pub(crate) is_torn: bool,
    /// The true target of the beam.
    pub(crate) target: BeamTarget,
}

/// The part of a spot that is on one face.
#[derive(Clone, Copy)]
struct SpotPart<'a> {
    face: Option<&'a Face>,
    hit: Hit,
    weight: f64,
}

impl SpotPart<'_> {
    fn is_reflector(&self) -> bool {
        self.face.is_some_and(|face| face.surface == Surface::Reflector)
    }

    /// Returns the strength of this part's echo relative to the other parts of the spot.
    fn echo(&self) -> f64 {
        self.weight * if self.is_reflector() { REFLECTOR_BRIGHTNESS } else { 1.0 }
    }

    /// Returns the kind of target of a beam whose whole spot is this part. An object that moved away from the scanner
    /// counts as an uncovered surface, because it is new to the beam but not nearer than the previous target.
    fn kind(&self) -> Kind {
        match self.face.map_or(Kind::Static, |face| face.kind) {
            Kind::Box { since_ns } if self.hit.since_ns >= since_ns => Kind::Static,
            kind => kind,
        }
    }
}

/// Returns the echo of the beam at `angle_mdeg`. The beam is a line without width, unless `wide` is set.
pub(crate) fn echo(view: &View, angle_mdeg: i32, wide: bool, rng: &BeamRng) -> Echo {
    let rays = view.rays_around(angle_mdeg);
    let spread = spread(view, rays, rng);
    let middle = [part(view, &rays[SPOT_RAYS], 1.0)];
    let parts: &[SpotPart] = if wide { &spread } else { &middle };
    let total: f64 = parts.iter().map(|part| part.weight).sum();
    let nearest_mm = parts.iter().map(|part| part.hit.range_mm).fold(f64::INFINITY, f64::min);
    let is_near = |part: &&SpotPart| part.hit.range_mm <= nearest_mm + MAX_STEP_MM;
    let near_echo: f64 = parts.iter().filter(is_near).map(SpotPart::echo).sum();
    let near = heaviest(parts.iter().filter(is_near));
    let far = heaviest(parts.iter().filter(|part| !is_near(part)));
    let all_echo: f64 = parts.iter().map(SpotPart::echo).sum();
    let (face, range_mm) = reported_surface(near, far, near_echo / all_echo, rng);
    let lit = parts.iter().filter(|part| part.is_reflector());
    let bright = lit.map(|part| part.weight).sum::<f64>() / total;
    // The echo of a reflector is strong and unambiguous.
    let dull = bright == 0.0;
    Echo {
        range_mm,
        signal: face.map_or(0.0, |face| signal(face, range_mm, angle_mdeg)),
        returns: face
            .map_or(1.0, |face| if face.surface == Surface::Faint { FAINT_RETURN_SHARE } else { 1.0 }),
        reflector_share: bright,
        is_edge: dull
            && spread.iter().any(|part| (part.hit.range_mm - spread[0].hit.range_mm).abs() > MAX_STEP_MM),
        is_torn: dull && far.is_some_and(|far| far.1 - nearest_mm > MAX_MERGE_DISTANCE_MM),
        target: true_target(parts),
    }
}

/// Returns face and range of the part with the strongest echo, or `None` if there is no part.
fn heaviest<'a>(parts: impl Iterator<Item = &'a SpotPart<'a>>) -> Option<(Option<&'a Face>, f64)> {
    parts.max_by(|a, b| a.echo().total_cmp(&b.echo())).map(|part| (part.face, part.hit.range_mm))
}

/// Returns the face and the range that the scanner reports for a spot on the face `near` and possibly also on the face
/// `far`. `share` is the part of the echo's light that comes from `near`.
fn reported_surface<'a>(
    near: Option<(Option<&'a Face>, f64)>,
    far: Option<(Option<&'a Face>, f64)>,
    share: f64,
    rng: &BeamRng,
) -> (Option<&'a Face>, f64) {
    let near = near.unwrap_or((None, f64::INFINITY));
    let Some(far) = far else { return near };
    let leans = (share - 0.5) / (1.0 - 2.0 * MIN_REPORTED_SHARE) + 0.5;
    let reported = if rng.surface < leans { near } else { far };
    let depth_mm = far.1 - near.1;
    if (0.0..1.0).contains(&leans) && depth_mm <= MAX_MERGE_DISTANCE_MM && rng.between < MIXED_SHARE {
        (reported.0, far.1 - depth_mm * leans)
    } else {
        reported
    }
}

/// Returns the parts of the spot on each face. The spot has a Gaussian profile, and ends at 1/e^2 of the maximum.
fn spread<'a>(view: &'a View, rays: &'a [Hit], rng: &BeamRng) -> Vec<SpotPart<'a>> {
    if rays.iter().all(|hit| hit.is_of(&rays[SPOT_RAYS])) {
        return vec![part(view, &rays[SPOT_RAYS], 1.0)];
    }
    let mut parts: Vec<SpotPart> = Vec::with_capacity(2);
    let off = MIRROR_SIGMA_RAYS * rng.mirror;
    // Go from the middle outwards, so that each face is represented by its ray nearest to the middle.
    for number in 0..rays.len() {
        let offset = number.div_ceil(2);
        let ray = if number % 2 == 0 { SPOT_RAYS + offset } else { SPOT_RAYS - offset };
        let hit = &rays[ray];
        let angle = (ray as f64 - SPOT_RAYS as f64 - off) * RAY_STEP;
        let within = angle.abs() / (SPOT_DIAMETER_MM / hit.range_mm + SPOT_GROWTH) * 2.0;
        if within > 1.0 {
            continue;
        }
        let new = part(view, hit, (-2.0 * within * within).exp());
        match parts.iter_mut().find(|part| part.hit.is_of(hit)) {
            Some(part) => part.weight += new.weight,
            None => parts.push(new),
        }
    }
    if parts.is_empty() {
        parts.push(part(view, &rays[SPOT_RAYS], 1.0));
    }
    parts
}

fn part<'a>(view: &'a View, hit: &Hit, weight: f64) -> SpotPart<'a> {
    SpotPart { face: view.face(hit), hit: *hit, weight }
}

/// Returns the true target of a spot with these `parts`.
fn true_target(parts: &[SpotPart]) -> BeamTarget {
    let kinds = || parts.iter().map(SpotPart::kind);
    let since_ns = parts.iter().map(|part| part.hit.since_ns).max().unwrap_or(0);
    let youngest = kinds().filter_map(|kind| match kind {
        Kind::Box { since_ns } => Some(since_ns),
        _ => None,
    });
    let is_box = |kind| matches!(kind, Kind::Box { .. });
    if kinds().all(|kind| kind == Kind::Static) {
        BeamTarget::Static { since_ns }
    } else if kinds().all(|kind| kind == Kind::Person) {
        BeamTarget::Person
    } else if kinds().all(is_box) {
        BeamTarget::Box { since_ns: youngest.max().unwrap_or(0) }
    } else {
        BeamTarget::Grazed
    }
}

/// Returns the signal of a face at `range_mm`.
fn signal(face: &Face, range_mm: f64, angle_mdeg: i32) -> f64 {
    let white = match face.surface {
        Surface::Plain | Surface::Faint => 0.5,
        Surface::Dark => 0.02,
        // Glass that a beam hits at a right angle, and reflectors, always return enough light.
        Surface::Reflector | Surface::Glass => return f64::INFINITY,
    };
    let (left, ahead) = (f64::from(angle_mdeg) / 1000.0).to_radians().sin_cos();
    let square = match face.shape {
        Shape::Wall { .. } => face.shape.squareness((-left, ahead)),
        // A post is round, so the beam hits a part of its surface at a right angle.
        Shape::Post { .. } => 1.0,
    };
    white * square / (range_mm / 1000.0).powi(2)
}

/// Standard deviation of the readings that [`NoiseModel::tail`] selects, in millimeters. Most of these readings differ
/// from the true range by more than 30 mm, which algorithms take for a change.
pub const TAIL_SIGMA_MM: f64 = 60.0;
/// Minimum signal for which a scanner reports a range, relative to a white surface at 1 m. A surface with 10 % of the
/// brightness of white has this signal at 18 m.
const MIN_SIGNAL: f64 = 0.0003;
/// Share of the beams on two surfaces far apart whose signal is too weak.
const EDGE_LOSS_SHARE: f64 = 0.15;
// Codes are counted down from the maximum (Telegram listing 10.8).
pub(crate) const NO_RETURN: u16 = 0;
pub(crate) const DAZZLE: u16 = 1;
pub(crate) const TOO_WEAK: u16 = 4;
const OVERFLOW: u16 = 2;
/// Codes of beams that could have reported a range, with cumulative shares. Codes and shares come from a recording of a
/// real LMS 200. They were counted for the beams that reported a range in at least 16 of 20 scans.
const CODES: [(f64, u16); 3] = [(0.57, NO_RETURN), (0.94, TOO_WEAK), (1.0, OVERFLOW)];
/// Diameter of the spot at the scanner's window, in millimeters.
const SPOT_DIAMETER_MM: f64 = 10.0;
/// Growth of the spot's diameter per millimeter of range, in millimeters.
const SPOT_GROWTH: f64 = 0.0045;
/// Standard deviation of a beam's direction, in units of the angle between two rays: 0.0025 degrees. Without other
/// noise, a range between two surfaces then has a standard deviation of about 0.01 of the distance between the
/// surfaces. In recordings of scanners at rest, where all noise adds up, it is 0.004 to 0.03 of that distance.
const MIRROR_SIGMA_RAYS: f64 = 0.04;
/// Maximum distance between two surfaces that count as one surface, such as the two sides of a corner, in mm.
const MAX_STEP_MM: f64 = 40.0;
/// Maximum distance between two surfaces whose echoes the scanner takes for one echo, in mm. If the surfaces are
/// farther apart, the scanner separates or loses their echoes. In recordings, hardly any range lies between two
/// surfaces that are more than 1.25 m apart, and hardly any beam is lost if they are less than 1 m apart.
const MAX_MERGE_DISTANCE_MM: f64 = 1_000.0;
/// Brightness of a reflector relative to other surfaces. In recordings, a beam reports the range of a reflector even if
/// only the edge of its spot is on the reflector, so the brightness must be high.
const REFLECTOR_BRIGHTNESS: f64 = 100.0;
/// Minimum share of the echo's light that must come from a surface for the scanner to report the surface.
const MIN_REPORTED_SHARE: f64 = 0.17;
/// Share of the beams on a faint surface that have an echo.
const FAINT_RETURN_SHARE: f64 = 0.15;
/// Share of the readings that lie between the two surfaces, if the spot is on both. In recordings of an LMS 200, beams
/// with at least one reading between two surfaces had 203 of 205 readings there.
const MIXED_SHARE: f64 = 0.98;

#[cfg(test)]
mod tests {
    use super::*;

    const RNG: BeamRng = BeamRng::CENTER;

    fn view(faces: &[(Shape, Surface, Kind)]) -> View {
        let mut view = View::empty();
        for &(shape, surface, kind) in faces {
            view.draw(Face { shape, surface, kind });
        }
        view
    }

    fn wall(from_x: f64, to_x: f64, y: f64) -> Shape {
        Shape::Wall { from: (from_x, y), to: (to_x, y) }
    }

    #[test]
    fn reports_single_surface_exactly_at_any_angle() {
        let view = view(&[(wall(-9_000.0, 9_000.0, 500.0), Surface::Plain, Kind::Static)]);
        for angle_deg in -80..80 {
            let cos = f64::from(angle_deg).to_radians().cos();
            let echo = echo(&view, 1_000 * angle_deg, true, &RNG);
            assert!((echo.range_mm - 500.0 / cos).abs() < 1e-6 && !echo.is_torn, "{angle_deg}: {echo:?}");
        }
    }

    /// Returns a view of a person 3 m ahead of the scanner, in front of a wall at `far_y`. The person's right edge is
    /// `edge_x` millimeters to the right of the beam at 0 degrees.
    fn edge(edge_x: f64, far_y: f64) -> View {
        view(&[
            (wall(-2_000.0, edge_x, 3_000.0), Surface::Plain, Kind::Person),
            (wall(-2_000.0, 2_000.0, far_y), Surface::Plain, Kind::Static),
        ])
    }

    #[test]
    fn edge_reports_one_surface_or_value_between() {
        let range = |far_y, surface, between| {
            let echo = echo(&edge(1.0, far_y), 0, true, &BeamRng { surface, between, ..RNG });
            assert!(echo.is_torn == (far_y > 4_000.0) && echo.target == BeamTarget::Grazed, "{echo:?}");
            echo.range_mm.round()
        };
        assert_eq!((range(3_990.0, 0.1, MIXED_SHARE), range(3_990.0, 0.9, MIXED_SHARE)), (3_000.0, 3_990.0));
        assert!((3_100.0..3_900.0).contains(&range(3_990.0, 0.1, 0.0)));
        assert_eq!((range(4_010.0, 0.1, 0.0), range(4_010.0, 0.9, 0.0)), (3_000.0, 4_010.0));
        let view = edge(1.0, 4_000.0);
        assert_eq!(echo(&view, 0, false, &RNG).range_mm.round(), 3_000.0);
        assert_eq!(echo(&view, 2_000, true, &RNG).target, BeamTarget::Person);
        assert_eq!(echo(&view, -2_000, true, &RNG).target, BeamTarget::Static { since_ns: 0 });
    }

    #[test]
    fn value_between_follows_share_of_light() {
        let range = |edge_x, mirror| {
            let rng = BeamRng { mirror, between: 0.0, ..RNG };
            echo(&edge(edge_x, 3_800.0), 0, true, &rng).range_mm
        };
        // At the person, neighboring rays are 3.3 mm apart.
        let ranges = [-9.0, -6.0, -2.0, 1.0, 4.0, 7.0, 10.0].map(|edge_x| range(edge_x, 0.0));
        assert!(ranges.windows(2).all(|pair| pair[0] >= pair[1]), "{ranges:?}");
        let is_between = |range: &&f64| (3_040.0..3_760.0).contains(*range);
        assert!(ranges.iter().filter(is_between).count() >= 2, "{ranges:?}");
        assert_eq!((ranges[0].round(), ranges[6].round()), (3_800.0, 3_000.0));
        let spread = (range(1.0, 1.0) - range(1.0, -1.0)).abs() / 2.0 / 800.0;
        assert!((0.006..0.018).contains(&spread), "{spread}");
    }

    #[test]
    fn strip_brightens_with_light_on_it() {
        let view = view(&[
            (wall(-25.0, 25.0, 4_000.0), Surface::Reflector, Kind::Static),
            (wall(-900.0, 900.0, 4_010.0), Surface::Plain, Kind::Static),
        ]);
        let bright = |angle_mdeg| echo(&view, angle_mdeg, true, &RNG).reflector_share;
        assert!(bright(0) > 0.95 && bright(500) > 0.0 && bright(500) < 0.5 && bright(1_000) == 0.0);
    }

    #[test]
    fn dark_and_oblique_surfaces_return_little() {
        let signal = |surface, angle_mdeg| {
            echo(&view(&[(wall(-9e3, 9e3, 2e3), surface, Kind::Static)]), angle_mdeg, true, &RNG).signal
        };
        assert!((signal(Surface::Plain, 0) - 0.125).abs() < 1e-9);
        assert!(signal(Surface::Dark, 0) < 0.1 * signal(Surface::Plain, 0));
        assert!(signal(Surface::Plain, -70_000) < 0.1 * signal(Surface::Plain, 0));
    }
}
