//! Who takes part in a demonstration: which sensors there are, of which families, where they sit, and what follows them. Refuses
//! to know how they are started.

use scanhub_perception::track::Site;
use scanhub_schema::{Failure, Family, Kind};

/// A simulated sensor.
#[derive(Clone, Debug)]
pub(crate) struct Sensor {
    pub(crate) name: String,
    pub(crate) family: Family,
    /// Where it sits, as its world has it: x and y in metres, yaw in radians.
    pub(crate) pose: [f64; 3],
}

/// Where a demonstration takes place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum World {
    /// A robot in a hall.
    Robot,
    /// Two rooms and a corridor, in which people are followed.
    House,
    /// A hall, seen by a sensor on a mount that tilts it.
    Tilt,
}

impl World {
    /// The names in all input: of the simulator's worlds.
    pub(crate) const NAMES: [&str; 3] = ["demo", "house", "tilt"];

    /// The world that `name` says, if it is one of [`NAMES`](Self::NAMES).
    pub(crate) fn parse(name: &str) -> Option<World> {
        [World::Robot, World::House, World::Tilt].into_iter().find(|world| world.name() == name)
    }

    /// What the simulator calls it.
    pub(crate) fn name(self) -> &'static str {
        World::NAMES[self as usize]
    }

    /// The site file that people are followed by, if there is one.
    pub(crate) fn site(self) -> Option<&'static str> {
        (self == World::House).then_some(HOUSE_SITE)
    }

    /// A topic that is worth to look at.
    pub(crate) fn topic(self) -> &'static str {
        match self {
            World::Robot => "front/scan",
            World::House => "people/events",
            World::Tilt => "hall/obstacles",
        }
    }

    /// Keys of the hub. Nobody drives in the house: its circle is small, and lies outside of the walls. Whoever looks shall not
    /// wait for long until the background is known.
    pub(crate) fn settings(self) -> &'static [&'static str] {
        match self {
            World::Robot | World::Tilt => &[],
            World::House => &["zones.radii=[0.1]", "background.scans=60"],
        }
    }

    /// Its sensors.
    ///
    /// [`Kind::Usage`] for different families in the house, where each one's simulator would begin with the same sensor, and
    /// on the mount for one that has no simulated heights.
    pub(crate) fn sensors(self, families: Families) -> Result<Vec<Sensor>, Failure> {
        match (self, families) {
            (World::Robot, families) => Ok(families.robot_sensors()),
            (World::House, Families::One(family)) => house_sensors(family),
            (World::Tilt, Families::One(family)) if family == TILTED_FAMILY => {
                Ok(vec![sensor("front", family, MOUNT_POSE)])
            }
            (World::Tilt, families) => {
                let hint = format!("only an {} is simulated on a mount", TILTED_FAMILY.name());
                Err(Failure::new(
                    Kind::Usage,
                    format!("--world tilt with --family {}", families.name()),
                    hint,
                ))
            }
            (World::House, Families::Mixed) => {
                let names: Vec<_> = Family::ALL.into_iter().map(Family::name).collect();
                let hint = format!("all sensors of the house are of one family: {}", names.join(", "));
                Err(Failure::new(Kind::Usage, "--world house with --family mixed", hint))
            }
        }
    }
}

/// Of which families the sensors are.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Families {
    /// All of one.
    One(Family),
    /// One of each.
    Mixed,
}

impl Families {
    /// The names in all input: of the families, and `mixed`.
    pub(crate) fn names() -> impl Iterator<Item = &'static str> {
        Family::ALL.into_iter().map(Family::name).chain([MIXED])
    }

    /// The families that `name` says, if it is one of [`names`](Self::names).
    pub(crate) fn parse(name: &str) -> Option<Families> {
        if name == MIXED { Some(Families::Mixed) } else { Family::parse(name).map(Families::One) }
    }

    fn name(self) -> &'static str {
        match self {
            Families::One(family) => family.name(),
            Families::Mixed => MIXED,
        }
    }

    fn robot_sensors(self) -> Vec<Sensor> {
        match self {
            Families::One(family) => {
                vec![sensor("front", family, FRONT_POSE), sensor("rear", family, REAR_POSE)]
            }
            // Each family has a simulator of its own, and its first sensor sits in front: one above the other.
            Families::Mixed => ["front", "side", "top"]
                .into_iter()
                .zip(Family::ALL)
                .map(|(name, family)| sensor(name, family, FRONT_POSE))
                .collect(),
        }
    }
}

fn sensor(name: &str, family: Family, pose: [f64; 3]) -> Sensor {
    Sensor { name: name.to_owned(), family, pose }
}

/// The sensors of the site, in the order in which the simulated world has them.
fn house_sensors(family: Family) -> Result<Vec<Sensor>, Failure> {
    let sensors = Site::parse("house.toml", HOUSE_SITE)?.sensors.into_iter();
    let sensors = sensors.map(|sensor| {
        let [x, y] = sensor.position;
        Sensor { name: sensor.name, family, pose: [x, y, sensor.yaw_rad] }
    });
    Ok(sensors.collect())
}

/// Whose simulator knows heights.
const TILTED_FAMILY: Family = Family::ALL[0];
const MIXED: &str = "mixed";
/// As `tests/worlds/demo.toml` has them.
const FRONT_POSE: [f64; 3] = [0.3, 0.0, 0.0];
const REAR_POSE: [f64; 3] = [-0.3, 0.0, std::f64::consts::PI];
/// As `tests/worlds/tilt.toml` has it.
const MOUNT_POSE: [f64; 3] = [0.06, 0.0, 0.0];
const HOUSE_SITE: &str = include_str!("house.toml");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn house_sensor_poses_match_the_simulated_world() {
        let world = include_str!("../../tests/worlds/house.toml");
        let poses =
            world.lines().skip_while(|line| *line != "[[sensor]]").take_while(|line| *line != "[noise]");
        let poses: Vec<[f64; 3]> = poses
            .filter_map(|line| line.strip_prefix("pose = [")?.strip_suffix(']'))
            .map(|pose| pose.split(", ").map(|value| value.parse().expect("a number")).collect::<Vec<f64>>())
            .map(|pose| [pose[0] / 1000.0, pose[1] / 1000.0, pose[2].to_radians()])
            .collect();
        let sensors = World::House.sensors(Families::One(Family::ALL[0])).expect("the site is right");
        assert_eq!((sensors.len(), poses.len()), (4, 4));
        for (sensor, pose) in sensors.iter().zip(poses) {
            let off = sensor.pose.iter().zip(pose).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off < 1e-3, "{sensor:?} and {pose:?}");
        }
        assert!(World::House.sensors(Families::Mixed).is_err());
        assert!(
            World::NAMES.into_iter().all(|name| World::parse(name).is_some_and(|world| world.name() == name))
        );
    }
}
