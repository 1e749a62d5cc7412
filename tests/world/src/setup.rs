//! What a world begins with, as its seed has it: the sensors and the state in which they are found, the hub's configuration,
//! whether a service manager keeps ports, the consumers. Refuses to know what happens later.

use std::rc::Rc;

use config::{Config, Sources};
use schema::{Failure, Topic};
use sim::series::Changes;

use crate::consumer::Habit;
use crate::family::{self, Family};
use crate::plan::Plan;
use crate::sensor::Sensor;

/// How a world begins.
pub(crate) struct Setup {
    /// The sensors, and what their links ask for.
    pub(crate) sensors: Vec<Rc<dyn Family>>,
    /// A service manager keeps the ports of a killed hub.
    pub(crate) keeps_ports: bool,
    /// Scans in a row that violate a circle.
    pub(crate) min_scans: u64,
    /// What consumers are there from the start: of which sensor and topic, how they behave, how many samples they hold.
    pub(crate) cast: Vec<(usize, Topic, Habit, usize)>,
}

impl Setup {
    pub(crate) fn of_plan(plan: &Plan) -> Setup {
        let mut random = fastrand::Rng::with_seed(plan.seed);
        let sensors = match &plan.model {
            Some(model) => family::named(model, &mut random).into_iter().collect(),
            None => family::draw(&mut random),
        };
        let mut cast = Vec::new();
        for sensor in 0..sensors.len() {
            cast.extend(Topic::OF_LINKS.map(|topic| (sensor, topic, Habit::Prompt, 0)));
            cast.push((sensor, Topic::Zones, Habit::Robot, 0));
            let every_ms = random.u64(5..400);
            cast.push((sensor, Topic::Scan, Habit::Slow { every_ms }, random.usize(0..=4)));
        }
        let (keeps_ports, min_scans) = (random.bool(), random.u64(1..=2));
        let sensors = if plan.is_auto { half_auto(sensors, plan) } else { sensors };
        Setup { sensors, keeps_ports, min_scans, cast }
    }

    /// The sensors' names in topics.
    pub(crate) fn name(sensor: usize) -> String {
        format!("s{sensor}")
    }

    /// The configuration; the second of `edition` 1 differs in what is made of scans, and that of 2 is refused.
    pub(crate) fn config(&self, edition: u64) -> Result<Config, Failure> {
        let mut set = vec![format!("zones.min_scans={}", self.min_scans)];
        let mut links = Vec::new();
        for (number, sensor) in self.sensors.iter().enumerate() {
            let name = Setup::name(number);
            links.push(format!("{name}=/dev/world/{number}"));
            set.extend(sensor.keys().into_iter().map(|key| format!("link.{name}.{key}")));
        }
        match edition {
            0 => {}
            1 => set.extend(["zones.radii=[1.2,0.6]", "background.threshold_mm=70"].map(str::to_owned)),
            _ => set.push("zones.radii=[0.6,1.2]".to_owned()),
        }
        Config::load(&Sources { files: Vec::new(), set, links })
    }

    /// The sensors as they are found, whose view changes as `changes` say.
    pub(crate) fn sensors(&self, mut changes: impl FnMut(usize) -> Changes) -> Vec<Sensor> {
        let sensor = |(number, of): (usize, &Rc<dyn Family>)| Sensor::new(of.found(changes(number)));
        self.sensors.iter().enumerate().map(sensor).collect()
    }
}

/// Removes the family from the link of the only sensor of `plan`, or from half of the links.
fn half_auto(sensors: Vec<Rc<dyn Family>>, plan: &Plan) -> Vec<Rc<dyn Family>> {
    // Its own random numbers: everything else is as in the world in which all links have a family.
    let mut random = fastrand::Rng::with_seed(plan.seed ^ 0xA070_0000_0000_0000);
    let mut is_auto = || plan.model.is_some() || random.bool();
    sensors.into_iter().map(|sensor| if is_auto() { sensor.auto() } else { sensor }).collect()
}
