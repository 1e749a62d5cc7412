//! Participants of a demonstration: its world, its sensors with their families and poses, and the settings of the hub.

use scanhub_perception::track::Site;
use scanhub_schema::{Failure, Family, Kind};

/// Simulated sensor.
#[derive(Clone, Debug)]
pub(crate) struct Sensor {
    pub(crate) name: String,
    pub(crate) family: Family,
    /// Pose in the world: x and y in meters, yaw in radians.
    pub(crate) pose: [f64; 3],
}

/// World of a demonstration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum World {
    /// Robot in a hall.
    Robot,
    /// Two rooms and a corridor, in which people are tracked.
    House,
    /// Hall that a sensor on a tilting mount sees.
    Tilt,
}

impl World {
    /// Names of the worlds, on the command line and in the simulator.
    pub(crate) const NAMES: [&str; 3] = ["demo", "house", "tilt"];

    /// Returns the world with this `name`, if it is one of [`NAMES`](Self::NAMES).
    pub(crate) fn parse(name: &str) -> Option<World> {
        [World::Robot, World::House, World::Tilt].into_iter().find(|world| world.name() == name)
    }

    /// Returns the name of the world.
    pub(crate) fn name(self) -> &'static str {
        World::NAMES[self as usize]
    }

    /// Returns the site file for the people tracker, if the world has one.
    pub(crate) fn site(self) -> Option<&'static str> {
        (self == World::House).then_some(HOUSE_SITE)
    }

    /// Returns a topic that is interesting to print.
    pub(crate) fn topic(self) -> &'static str {
        match self {
            World::Robot => "front/scan",
            World::House => "people/events",
            World::Tilt => "hall/obstacles",
        }
    }

    /// Returns settings of the hub. The house has no robot, so the circle of its zone is small and outside the walls.
    /// The background is learned fast, so that users need not wait long for people.
    pub(crate) fn settings(self) -> &'static [&'static str] {
        match self {
            World::Robot | World::Tilt => &[],
            World::House => &["zones.radii=[0.1]", "background.scans=60"],
        }
    }

    /// Returns the sensors of the world.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Usage`] for mixed families in the house, because each family's simulator would begin with the
    /// same sensor. Also returns [`Kind::Usage`] in the world with a mount, for a family whose simulator does not
    /// support a mount.
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
                let hint = format!("all sensors of the house have the same family: {}", names.join(", "));
                Err(Failure::new(Kind::Usage, "--world house with --family mixed", hint))
            }
        }
    }
}

/// Families of the sensors.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Families {
    /// One family for all sensors.
    One(Family),
    /// One sensor of each family.
    Mixed,
}

impl Families {
    /// Returns the values on the command line: the names of the families, and `mixed`.
    pub(crate) fn names() -> impl Iterator<Item = &'static str> {
        Family::ALL.into_iter().map(Family::name).chain([MIXED])
    }

    /// Returns the families for this `name`, if it is one of [`names`](Self::names).
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
            // Each family has its own simulator, whose first sensor is at the front, so all sensors have the same pose.
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

/// Returns the sensors of the site, in the order of the simulated world.
fn house_sensors(family: Family) -> Result<Vec<Sensor>, Failure> {
    let sensors = Site::parse("house.toml", HOUSE_SITE)?.sensors.into_iter();
    let sensors = sensors.map(|sensor| {
        let [x, y] = sensor.position;
        Sensor { name: sensor.name, family, pose: [x, y, sensor.yaw_rad] }
    });
    Ok(sensors.collect())
}

/// Family whose simulator supports a mount.
const TILTED_FAMILY: Family = Family::ALL[0];
const MIXED: &str = "mixed";
/// Pose of the front sensor, as in `tests/worlds/demo.toml`.
const FRONT_POSE: [f64; 3] = [0.3, 0.0, 0.0];
const REAR_POSE: [f64; 3] = [-0.3, 0.0, std::f64::consts::PI];
/// Pose of the sensor on the mount, as in `tests/worlds/tilt.toml`.
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
