//! A world as data: which objects are where, from when until when, and how they move. All in the world's frame, in
//! millimetres and seconds. Knows neither files nor beams.

use crate::layers::Layers;
use crate::mount::Mount;
use crate::people::Plan;
use crate::shape::Heights;
use crate::shape::{Pose, Shape};

/// A world that was read.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The sensors that look at it.
    pub(crate) sensors: Vec<Sensor>,
    pub(crate) layers: Layers,
    pub(crate) things: Vec<Thing>,
    pub(crate) people: Vec<Plan>,
    pub(crate) suns: Vec<Sun>,
}

/// A sensor that looks at a world.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Sensor {
    /// The beam ahead looks where the pose is turned to: 0 is along x. That of its mount, if it has one.
    pub(crate) pose: Pose,
    /// What tilts it. Without one it measures level, and sees everything whatever its height.
    pub(crate) mount: Option<Mount>,
}

/// How a surface answers to the beam.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Surface {
    Plain,
    Dark,
    Reflector,
    /// Glass: the beam goes through, but where it falls squarely.
    Glass,
    /// So glossy or so oblique to the eye that few beams come back; of the others nothing does.
    Faint,
}

/// A wall, a piece of furniture, a box, a door.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Thing {
    /// In its own frame.
    pub(crate) shapes: Vec<Shape>,
    /// For tilted sensors.
    pub(crate) heights: Heights,
    /// Its shapes are the four sides of a box.
    pub(crate) is_box: bool,
    pub(crate) pose: Pose,
    pub(crate) surface: Surface,
    pub(crate) from_s: f64,
    pub(crate) until_s: f64,
    /// In the order of time, while the thing is there; each is over before the next begins.
    pub(crate) moves: Vec<Move>,
    /// The most by which the seed moves it.
    pub(crate) jitter_mm: f64,
}

/// A thing is moved, evenly from one time to another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Move {
    pub(crate) from_s: f64,
    pub(crate) until_s: f64,
    pub(crate) by: Pose,
}

/// The sun dazzles a sector of a sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Sun {
    /// Angles of the sensor.
    pub(crate) from_deg: f64,
    pub(crate) to_deg: f64,
    pub(crate) from_s: f64,
    pub(crate) until_s: f64,
    /// How many of its beams are dazzled, 0 to 1.
    pub(crate) share: f64,
}

/// Where a thing stands or stood, and since when it does or no longer does.
pub(crate) struct Spell {
    pub(crate) pose: Pose,
    pub(crate) since_s: f64,
}

impl Thing {
    /// Whether it never changes.
    pub(crate) fn is_still(&self) -> bool {
        self.from_s <= 0.0 && self.until_s.is_infinite() && self.moves.is_empty()
    }

    /// Where it stands at `time_s`, if it is there, and since when: 0 if since ever, the time itself while it moves.
    pub(crate) fn at(&self, time_s: f64) -> Option<Spell> {
        (self.from_s..self.until_s).contains(&time_s).then(|| {
            let begun = self.moves.iter().filter(|way| way.from_s <= time_s);
            begun.fold(Spell { pose: self.pose, since_s: self.from_s.max(0.0) }, |spell, way| Spell {
                pose: moved(spell.pose, way, time_s),
                since_s: way.until_s.min(time_s),
            })
        })
    }

    /// Where it stood before `time_s` and does not stand any more.
    pub(crate) fn left(&self, time_s: f64) -> Vec<Spell> {
        let mut left = Vec::new();
        let mut pose = self.pose;
        for way in self.moves.iter().filter(|way| way.from_s <= time_s) {
            left.push(Spell { pose, since_s: way.until_s.min(time_s) });
            pose = moved(pose, way, time_s);
        }
        if self.until_s <= time_s {
            left.push(Spell { pose, since_s: self.until_s });
        }
        left
    }
}

/// Where `way` has brought what stood at `pose` until `time_s`.
fn moved(pose: Pose, way: &Move, time_s: f64) -> Pose {
    let lasts_s = way.until_s - way.from_s;
    let share = if lasts_s > 0.0 { ((time_s - way.from_s) / lasts_s).clamp(0.0, 1.0) } else { 1.0 };
    Pose {
        x_mm: pose.x_mm + share * way.by.x_mm,
        y_mm: pose.y_mm + share * way.by.y_mm,
        turn_deg: pose.turn_deg + share * way.by.turn_deg,
    }
}

impl Sun {
    /// Share of the beams at `angle_mdeg` that it dazzles at `time_s`.
    pub(crate) fn share(&self, angle_mdeg: i32, time_s: f64) -> f64 {
        let angle_deg = f64::from(angle_mdeg) / 1000.0;
        let shines = (self.from_s..self.until_s).contains(&time_s);
        let meets = (self.from_deg..=self.to_deg).contains(&angle_deg);
        if shines && meets { self.share } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HERE: Pose = Pose { x_mm: 100.0, y_mm: 200.0, turn_deg: 0.0 };

    fn thing(from_s: f64, until_s: f64, moves: &[Move]) -> Thing {
        let shapes = vec![Shape::Post { centre: (0.0, 0.0), radius: 10.0 }];
        let moves = moves.to_vec();
        let (heights, is_box) = (Heights::ALL, false);
        Thing {
            shapes,
            heights,
            is_box,
            pose: HERE,
            surface: Surface::Plain,
            from_s,
            until_s,
            moves,
            jitter_mm: 0.0,
        }
    }

    #[test]
    fn a_box_comes_and_goes() {
        let thing = thing(15.0, 20.0, &[]);
        assert!(thing.at(14.9).is_none() && thing.left(14.9).is_empty() && !thing.is_still());
        assert_eq!(thing.at(16.0).map(|spell| spell.since_s), Some(15.0));
        assert!(thing.at(20.0).is_none());
        assert_eq!(thing.left(30.0).iter().map(|spell| spell.since_s).collect::<Vec<_>>(), [20.0]);
    }

    #[test]
    fn a_door_turns_and_leaves_the_place_where_it_was() {
        let by = Pose { x_mm: 0.0, y_mm: 0.0, turn_deg: 90.0 };
        let thing = thing(0.0, f64::INFINITY, &[Move { from_s: 10.0, until_s: 12.0, by }]);
        let state = |time_s| thing.at(time_s).map(|spell| (spell.pose.turn_deg, spell.since_s));
        assert_eq!(state(9.0), Some((0.0, 0.0)));
        assert_eq!(state(11.0), Some((45.0, 11.0)));
        assert_eq!(state(20.0), Some((90.0, 12.0)));
        assert!(thing.left(9.0).is_empty());
        assert_eq!(thing.left(20.0).iter().map(|s| (s.pose, s.since_s)).collect::<Vec<_>>(), [(HERE, 12.0)]);
    }
}
