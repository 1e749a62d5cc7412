//! What a world begins with, as its seed has it: the sensors and the state in which they are found, the hub's
//! configuration, whether a service manager keeps ports, the consumers. Refuses to know what happens later.

use std::rc::Rc;

use scanhub_config::{Config, Sources};
use scanhub_schema::{Failure, Topic};
use scanhub_sim::room::Changes;

use crate::actions::lonely_topics;
use crate::consumer::Habit;
use crate::family::{self, Family};
use crate::plan::Plan;
use crate::sensor::Sensor;

/// How a world begins.
pub(crate) struct Setup {
    /// The sensors, and what their links ask for.
    pub(crate) sensors: Vec<Rc<dyn Family>>,
    /// Rates that the port of each sensor cannot have.
    pub(crate) impossible: Vec<Vec<u32>>,
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
        let lonely = lonely_topics(&plan.actions, plan.seed);
        for sensor in 0..sensors.len() {
            let topics = Topic::OF_LINKS.into_iter().filter(|topic| !lonely.contains(topic));
            cast.extend(topics.map(|topic| (sensor, topic, Habit::Prompt, 0)));
            cast.push((sensor, Topic::Zones, Habit::Robot, 0));
            let every_ms = random.u64(5..400);
            cast.push((sensor, Topic::Scan, Habit::Slow { every_ms }, random.usize(0..=4)));
        }
        let (keeps_ports, min_scans) = (random.bool(), random.u64(1..=2));
        let all_named = || (sensors.clone(), vec![Vec::new(); sensors.len()]);
        let (sensors, impossible) = if plan.is_auto { half_auto(&sensors, plan) } else { all_named() };
        Setup { sensors, impossible, keeps_ports, min_scans, cast }
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

/// Removes the family from the link of the only sensor of `plan`, or from half of the links. At some of these links, an
/// exchange connects a scanner of another family, and some of their ports cannot have all rates of the search. Returns
/// the sensors, and the rates that each port cannot have.
fn half_auto(sensors: &[Rc<dyn Family>], plan: &Plan) -> (Vec<Rc<dyn Family>>, Vec<Vec<u32>>) {
    // Its own random numbers: everything else is as in the world in which all links have a family.
    let mut random = fastrand::Rng::with_seed(plan.seed ^ 0xA070_0000_0000_0000);
    let of = |sensor: &Rc<dyn Family>| {
        let mut random = random.fork();
        if plan.model.is_none() && random.bool() {
            return (sensor.clone(), Vec::new());
        }
        let sensor = sensor.auto();
        let sensor = if random.u8(..3) == 0 { family::either(sensor, &mut random) } else { sensor };
        let needed = sensor.rates();
        let lacks_rates = random.u8(..3) == 0;
        let is_impossible = |rate: &u32| lacks_rates && !needed.contains(rate) && random.bool();
        let impossible = SEARCHED.into_iter().filter(is_impossible).collect();
        (sensor, impossible)
    };
    sensors.iter().map(of).unzip()
}

/// Rates of the search, in bits per second, except the slowest, which every port can have.
const SEARCHED: [u32; 9] = [19_200, 38_400, 115_200, 230_400, 256_000, 460_800, 500_000, 921_600, 1_000_000];
