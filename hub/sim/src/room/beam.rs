//! A room seen beam by beam, each at its own time and angle, all around: what a head that turns measures. Knows neither
//! packets nor the order of beams.

use schema::Nanos;

use super::{Room, Sight, told};
use crate::layers::{Dice, Layers};
use crate::spot::echo;
use crate::view::View;

/// A room, and what the last beam met.
#[derive(Clone, Debug)]
pub(crate) struct Beams {
    room: Room,
    /// The things around the beam, to be drawn over.
    view: Option<View>,
    /// Those of a series of rooms, each seen so.
    rooms: Vec<Beams>,
}

/// What a beam tells.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Look {
    /// What it measures, in millimetres; nothing if nothing comes back, or not enough.
    pub(crate) range_mm: Option<f64>,
    /// What lies there, without noise; nothing if nothing does.
    pub(crate) exact_mm: Option<f64>,
    /// How much comes back, 0 to 255.
    pub(crate) intensity: u8,
    /// The same beside a white surface at 1 m; without end where a world has no noise at all.
    pub(crate) signal: f64,
}

impl Beams {
    pub(crate) fn new(room: Room) -> Beams {
        let rooms = match &room.sight {
            Sight::Series(series, _) => series.rooms().map(|room| Beams::new(room.clone())).collect(),
            _ => Vec::new(),
        };
        Beams { room, view: None, rooms }
    }

    /// Looks at `angle_deg` (0 ahead, counter-clockwise, -180 to 180) at `at_ns`.
    pub(crate) fn look(&mut self, at_ns: Nanos, angle_deg: f64) -> Look {
        if let Sight::Series(series, changes) = &self.room.sight {
            return self.rooms[series.number(changes, at_ns)].look(at_ns, angle_deg);
        }
        let mut random = fastrand::Rng::with_seed(self.room.seed ^ at_ns.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let dice = Dice::throw(&mut random);
        let all = |range_mm: Option<f64>| Look {
            range_mm,
            exact_mm: range_mm,
            intensity: PLAIN as u8,
            signal: f64::INFINITY,
        };
        let stage = match &self.room.sight {
            Sight::Scene(stage) => stage,
            Sight::Empty | Sight::Series(..) => return Look { intensity: 0, ..all(None) },
            Sight::Value(value) => return all(Some(f64::from(*value))),
            Sight::Random => return all(Some(f64::from(random.u16(..12_000)))),
        };
        let view = self.view.get_or_insert_with(|| stage.still().clone());
        stage.look_along(view, angle_deg, at_ns);
        let angle_mdeg = (angle_deg * 1e3) as i32;
        let echo = echo(view, angle_mdeg, stage.layers.spot, &dice);
        let (ray_mm, exact_mm) = view.exact(angle_deg);
        // Beams lie between the rays; what is told of one surface is told of where the beam meets it.
        let is_one = echo.range_mm == ray_mm;
        let off_mm = exact_mm.filter(|_| is_one).map_or(0.0, |exact_mm| exact_mm - ray_mm);
        let time_s = at_ns as f64 / 1e9;
        let sun = stage.suns.iter().map(|sun| sun.share(angle_mdeg, time_s)).fold(0.0, f64::max);
        let range_mm = told(stage, &echo, sun, &dice).ok().map(|range_mm| range_mm + off_mm);
        let plain = PLAIN * echo.signal.min(1.0).powf(0.25);
        let intensity = if echo.bright > 0.0 { plain.max(REFLECTOR * echo.bright) } else { plain };
        let signal = if stage.layers != Layers::NONE { echo.signal } else { f64::INFINITY };
        Look { range_mm, exact_mm, intensity: range_mm.map_or(0, |_| intensity as u8), signal }
    }
}

/// Counts of a plain surface nearby, and of a reflector: the manual of the LD06 has 228 to 233 at 0.2 m.
const PLAIN: f64 = 230.0;
const REFLECTOR: f64 = 255.0;
