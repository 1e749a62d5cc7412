//! The echo of one beam, computed from the rays that its spot covers. If they hit two surfaces, the scanner reports one of
//! them, or, if they are not far apart, a value between them. That value follows the share of the light on each surface, so
//! it hardly changes from scan to scan. `cargo run --release -p scanhub-sim --example edges` measures it.

use crate::labeled_scan::Met;
use crate::layers::BeamRng;
use crate::scene::Surface;
use crate::shape::Shape;
use crate::view::{Face, Hit, Kind, RAY_STEP, REACH, View};

/// What comes back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Echo {
    /// How far away; infinite if nothing comes back.
    pub(crate) range_mm: f64,
    /// How much, beside a white surface at 1 m on which the beam falls squarely.
    pub(crate) signal: f64,
    /// Share of such beams that come back at all.
    pub(crate) returns: f64,
    /// Share of the light that fell on reflectors.
    pub(crate) bright: f64,
    /// Whether a beam as wide as a real one meets two surfaces, one behind the other, and no reflector.
    pub(crate) edge: bool,
    /// Whether this spot met two surfaces far apart, and no reflector.
    pub(crate) torn: bool,
    /// What is true.
    pub(crate) met: Met,
}

/// What the spot has of one face.
#[derive(Clone, Copy)]
struct Part<'a> {
    face: Option<&'a Face>,
    hit: Hit,
    weight: f64,
}

impl Part<'_> {
    fn is_reflector(&self) -> bool {
        self.face.is_some_and(|face| face.surface == Surface::Reflector)
    }

    /// What it sends back beside the other parts of the spot.
    fn echo(&self) -> f64 {
        self.weight * if self.is_reflector() { OUTSHINES } else { 1.0 }
    }

    /// What the beam meets, if it meets this part alone. A thing that moved away is like any surface that was
    /// uncovered: new to the beam, but not nearer than what it met before.
    fn kind(&self) -> Kind {
        match self.face.map_or(Kind::Static, |face| face.kind) {
            Kind::Box { since_ns } if self.hit.since_ns >= since_ns => Kind::Static,
            kind => kind,
        }
    }
}

/// The echo of the beam at `angle_mdeg`; without `wide` that of a line, else that of a spot.
pub(crate) fn echo(view: &View, angle_mdeg: i32, wide: bool, dice: &BeamRng) -> Echo {
    let rays = view.around(angle_mdeg);
    let spread = spread(view, rays, dice);
    let middle = [part(view, &rays[REACH], 1.0)];
    let parts: &[Part] = if wide { &spread } else { &middle };
    let total: f64 = parts.iter().map(|part| part.weight).sum();
    let nearest_mm = parts.iter().map(|part| part.hit.range_mm).fold(f64::INFINITY, f64::min);
    let is_near = |part: &&Part| part.hit.range_mm <= nearest_mm + CONTINUOUS_MM;
    let near_echo: f64 = parts.iter().filter(is_near).map(Part::echo).sum();
    let near = heaviest(parts.iter().filter(is_near));
    let far = heaviest(parts.iter().filter(|part| !is_near(part)));
    let all_echo: f64 = parts.iter().map(Part::echo).sum();
    let (face, range_mm) = told(near, far, near_echo / all_echo, dice);
    let lit = parts.iter().filter(|part| part.is_reflector());
    let bright = lit.map(|part| part.weight).sum::<f64>() / total;
    // What a reflector sends back is strong and clear.
    let dull = bright == 0.0;
    Echo {
        range_mm,
        signal: face.map_or(0.0, |face| signal(face, range_mm, angle_mdeg)),
        returns: face.map_or(1.0, |face| if face.surface == Surface::Faint { FAINT_RETURNS } else { 1.0 }),
        bright,
        edge: dull
            && spread.iter().any(|part| (part.hit.range_mm - spread[0].hit.range_mm).abs() > CONTINUOUS_MM),
        torn: dull && far.is_some_and(|far| far.1 - nearest_mm > MERGED_MM),
        met: met(parts),
    }
}

/// Face and range of the part with most of the light.
fn heaviest<'a>(parts: impl Iterator<Item = &'a Part<'a>>) -> Option<(Option<&'a Face>, f64)> {
    parts.max_by(|a, b| a.echo().total_cmp(&b.echo())).map(|part| (part.face, part.hit.range_mm))
}

/// Returns the face and the range that the scanner reports for a spot on a `near` and perhaps a `far` face. The nearer one
/// has `share` of the light.
fn told<'a>(
    near: Option<(Option<&'a Face>, f64)>,
    far: Option<(Option<&'a Face>, f64)>,
    share: f64,
    dice: &BeamRng,
) -> (Option<&'a Face>, f64) {
    let near = near.unwrap_or((None, f64::INFINITY));
    let Some(far) = far else { return near };
    let leans = (share - 0.5) / (1.0 - 2.0 * CLEAR) + 0.5;
    let tells = if dice.surface < leans { near } else { far };
    let depth_mm = far.1 - near.1;
    if (0.0..1.0).contains(&leans) && depth_mm <= MERGED_MM && dice.between < MIXED {
        (tells.0, far.1 - depth_mm * leans)
    } else {
        tells
    }
}

/// The faces that the spot covers, with the light that falls on each. The spot has a Gaussian profile; it ends where
/// the light is down to 1/e^2.
fn spread<'a>(view: &'a View, rays: &'a [Hit], dice: &BeamRng) -> Vec<Part<'a>> {
    if rays.iter().all(|hit| hit.is_of(&rays[REACH])) {
        return vec![part(view, &rays[REACH], 1.0)];
    }
    let mut parts: Vec<Part> = Vec::with_capacity(2);
    let off = MIRROR_STEPS * dice.mirror;
    // From the middle outwards: of each face the ray nearest to the middle stands for it.
    for number in 0..rays.len() {
        let aside = number.div_ceil(2);
        let ray = if number % 2 == 0 { REACH + aside } else { REACH - aside };
        let hit = &rays[ray];
        let angle = (ray as f64 - REACH as f64 - off) * RAY_STEP;
        let within = angle.abs() / (SPOT_MM / hit.range_mm + SPOT_PER_MM) * 2.0;
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
        parts.push(part(view, &rays[REACH], 1.0));
    }
    parts
}

fn part<'a>(view: &'a View, hit: &Hit, weight: f64) -> Part<'a> {
    Part { face: view.face(hit), hit: *hit, weight }
}

/// The truth of a spot of `parts`.
fn met(parts: &[Part]) -> Met {
    let kinds = || parts.iter().map(Part::kind);
    let since_ns = parts.iter().map(|part| part.hit.since_ns).max().unwrap_or(0);
    let youngest = kinds().filter_map(|kind| match kind {
        Kind::Box { since_ns } => Some(since_ns),
        _ => None,
    });
    let is_box = |kind| matches!(kind, Kind::Box { .. });
    if kinds().all(|kind| kind == Kind::Static) {
        Met::Static { since_ns }
    } else if kinds().all(|kind| kind == Kind::Person) {
        Met::Person
    } else if kinds().all(is_box) {
        Met::Box { since_ns: youngest.max().unwrap_or(0) }
    } else {
        Met::Grazed
    }
}

/// What a face sends back from `range_mm`.
fn signal(face: &Face, range_mm: f64, angle_mdeg: i32) -> f64 {
    let white = match face.surface {
        Surface::Plain | Surface::Faint => 0.5,
        Surface::Dark => 0.02,
        // A mirror of glass, a reflector: always enough.
        Surface::Reflector | Surface::Glass => return f64::INFINITY,
    };
    let (left, ahead) = (f64::from(angle_mdeg) / 1000.0).to_radians().sin_cos();
    let square = match face.shape {
        Shape::Wall { .. } => face.shape.squareness((-left, ahead)),
        // The spot on a post has always a part that it falls on squarely.
        Shape::Post { .. } => 1.0,
    };
    white * square / (range_mm / 1000.0).powi(2)
}

/// Diameter of the spot at the window, and what it grows with each millimetre of range.
const SPOT_MM: f64 = 10.0;
const SPOT_PER_MM: f64 = 0.0045;
/// Standard deviation of a beam's direction, in rays: 0.0025 degrees. The value between two surfaces then has a standard
/// deviation of about 0.01 of their distance, without the other layers. In recordings of scanners that stand, it is 0.004
/// to 0.03 in total.
const MIRROR_STEPS: f64 = 0.04;
/// Surfaces nearer to each other than this are one to the sensor, such as the two sides of a corner.
const CONTINUOUS_MM: f64 = 40.0;
/// Maximum distance of two surfaces whose echoes the scanner takes for one. It separates the echoes of surfaces that are
/// farther apart, or loses them. Recordings have hardly any value between for edges deeper than 1.25 m, and hardly any lost
/// beam for edges below 1 m.
const MERGED_MM: f64 = 1_000.0;
/// How much brighter a reflector is than other surfaces: in recordings beams that only touch one tell its range.
const OUTSHINES: f64 = 100.0;
/// A surface with less than this share of the light is never told.
const CLEAR: f64 = 0.17;
/// Share of the beams on a faint surface that come back.
const FAINT_RETURNS: f64 = 0.15;
/// Share of the readings between two surfaces that are values between. In recordings of an LMS 200, 203 of 205 at beams that
/// have one at all.
const MIXED: f64 = 0.98;

#[cfg(test)]
mod tests {
    use super::*;

    const DICE: BeamRng = BeamRng::CENTRE;

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
    fn a_single_surface_is_told_as_it_is_however_oblique() {
        let view = view(&[(wall(-9_000.0, 9_000.0, 500.0), Surface::Plain, Kind::Static)]);
        for angle_deg in -80..80 {
            let cos = f64::from(angle_deg).to_radians().cos();
            let echo = echo(&view, 1_000 * angle_deg, true, &DICE);
            assert!((echo.range_mm - 500.0 / cos).abs() < 1e-6 && !echo.torn, "{angle_deg}: {echo:?}");
        }
    }

    /// A person whose right edge is `edge_x` to the right of the beam at 0 degrees, 3 m ahead, before a wall at `far_y`.
    fn edge(edge_x: f64, far_y: f64) -> View {
        view(&[
            (wall(-2_000.0, edge_x, 3_000.0), Surface::Plain, Kind::Person),
            (wall(-2_000.0, 2_000.0, far_y), Surface::Plain, Kind::Static),
        ])
    }

    #[test]
    fn an_edge_reports_one_the_other_or_a_value_between_and_is_grazed_if_a_person_makes_it() {
        let range = |far_y, surface, between| {
            let echo = echo(&edge(1.0, far_y), 0, true, &BeamRng { surface, between, ..DICE });
            assert!(echo.torn == (far_y > 4_000.0) && echo.met == Met::Grazed, "{echo:?}");
            echo.range_mm.round()
        };
        assert_eq!((range(3_990.0, 0.1, MIXED), range(3_990.0, 0.9, MIXED)), (3_000.0, 3_990.0));
        assert!((3_100.0..3_900.0).contains(&range(3_990.0, 0.1, 0.0)));
        assert_eq!((range(4_010.0, 0.1, 0.0), range(4_010.0, 0.9, 0.0)), (3_000.0, 4_010.0));
        let view = edge(1.0, 4_000.0);
        assert_eq!(echo(&view, 0, false, &DICE).range_mm.round(), 3_000.0);
        assert_eq!(echo(&view, 2_000, true, &DICE).met, Met::Person);
        assert_eq!(echo(&view, -2_000, true, &DICE).met, Met::Static { since_ns: 0 });
    }

    #[test]
    fn the_value_between_follows_the_share_of_the_light_and_stays_in_place() {
        let range = |edge_x, mirror| {
            let dice = BeamRng { mirror, between: 0.0, ..DICE };
            echo(&edge(edge_x, 3_800.0), 0, true, &dice).range_mm
        };
        // Rays are 3.3 mm apart there.
        let ranges = [-9.0, -6.0, -2.0, 1.0, 4.0, 7.0, 10.0].map(|edge_x| range(edge_x, 0.0));
        assert!(ranges.windows(2).all(|pair| pair[0] >= pair[1]), "{ranges:?}");
        let is_between = |range: &&f64| (3_040.0..3_760.0).contains(*range);
        assert!(ranges.iter().filter(is_between).count() >= 2, "{ranges:?}");
        assert_eq!((ranges[0].round(), ranges[6].round()), (3_800.0, 3_000.0));
        let spread = (range(1.0, 1.0) - range(1.0, -1.0)).abs() / 2.0 / 800.0;
        assert!((0.006..0.018).contains(&spread), "{spread}");
    }

    #[test]
    fn a_strip_brightens_with_the_light_that_falls_on_it() {
        let view = view(&[
            (wall(-25.0, 25.0, 4_000.0), Surface::Reflector, Kind::Static),
            (wall(-900.0, 900.0, 4_010.0), Surface::Plain, Kind::Static),
        ]);
        let bright = |angle_mdeg| echo(&view, angle_mdeg, true, &DICE).bright;
        assert!(bright(0) > 0.95 && bright(500) > 0.0 && bright(500) < 0.5 && bright(1_000) == 0.0);
    }

    #[test]
    fn dark_and_oblique_send_little_back() {
        let signal = |surface, angle_mdeg| {
            echo(&view(&[(wall(-9e3, 9e3, 2e3), surface, Kind::Static)]), angle_mdeg, true, &DICE).signal
        };
        assert!((signal(Surface::Plain, 0) - 0.125).abs() < 1e-9);
        assert!(signal(Surface::Dark, 0) < 0.1 * signal(Surface::Plain, 0));
        assert!(signal(Surface::Plain, -70_000) < 0.1 * signal(Surface::Plain, 0));
    }
}
