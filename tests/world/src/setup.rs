//! Setup of a world, drawn from its seed. It contains the scanners with their states at the start, the hub's
//! configuration, whether a service manager keeps ports, and the permanent subscribers.

use std::rc::Rc;

use scanhub_config::{Config, Sources};
use scanhub_schema::{Failure, Topic};
use scanhub_sim::room::Changes;

use crate::actions::topics_without_constant_subscriber;
use crate::family::{self, Family};
use crate::scenario::Scenario;
use crate::sensor::Sensor;
use crate::subscriber::Behavior;

/// Setup of a world.
pub(crate) struct Setup {
    /// The scanners with their links.
    pub(crate) sensors: Vec<Rc<dyn Family>>,
    /// For each sensor, the rates that its port does not support.
    pub(crate) unsupported_rates: Vec<Vec<u32>>,
    /// Whether a service manager keeps the ports of a killed hub.
    pub(crate) keeps_ports: bool,
    /// Number of consecutive scans with an object in a zone after which the zone is violated.
    pub(crate) min_scans: u64,
    /// Sensor, topic, behavior, and maximum number of held samples of each permanent subscriber.
    pub(crate) subscribers: Vec<(usize, Topic, Behavior, usize)>,
}

impl Setup {
    pub(crate) fn from_scenario(scenario: &Scenario) -> Setup {
        let mut random = fastrand::Rng::with_seed(scenario.seed);
        let sensors = match &scenario.model {
            Some(model) => family::from_name(model, &mut random).into_iter().collect(),
            None => family::draw(&mut random),
        };
        let mut subscribers = Vec::new();
        let unsubscribed = topics_without_constant_subscriber(&scenario.actions, scenario.seed);
        for sensor in 0..sensors.len() {
            let topics = Topic::OF_LINKS.into_iter().filter(|topic| !unsubscribed.contains(topic));
            subscribers.extend(topics.map(|topic| (sensor, topic, Behavior::Prompt, 0)));
            subscribers.push((sensor, Topic::Zones, Behavior::Robot, 0));
            let every_ms = random.u64(5..400);
            subscribers.push((sensor, Topic::Scan, Behavior::Slow { every_ms }, random.usize(0..=4)));
        }
        let (keeps_ports, min_scans) = (random.bool(), random.u64(1..=2));
        let all_named = || (sensors.clone(), vec![Vec::new(); sensors.len()]);
        let (sensors, unsupported_rates) =
            if scenario.is_auto { half_auto(&sensors, scenario) } else { all_named() };
        Setup { sensors, unsupported_rates, keeps_ports, min_scans, subscribers }
    }

    /// Returns the name of a sensor in topics.
    pub(crate) fn name(sensor: usize) -> String {
        format!("s{sensor}")
    }

    /// Returns an edition of the configuration. Edition 0 is the first one, edition 1 has other settings of processors,
    /// and edition 2 is invalid.
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

    /// Returns the sensors in the states in which the hub finds them. `changes` returns the changes of a sensor's
    /// scene.
    pub(crate) fn sensors(&self, mut changes: impl FnMut(usize) -> Changes) -> Vec<Sensor> {
        let sensor =
            |(number, of): (usize, &Rc<dyn Family>)| Sensor::new(of.initial_scanner(changes(number)));
        self.sensors.iter().enumerate().map(sensor).collect()
    }
}

/// Removes the family from half of the links, or from the only link if `scenario` has a model. At some of the links
/// without a family, an exchange connects a scanner of another family. Some ports of these links do not support all
/// rates of the search. Returns the sensors, and the rates that each port does not support.
fn half_auto(sensors: &[Rc<dyn Family>], scenario: &Scenario) -> (Vec<Rc<dyn Family>>, Vec<Vec<u32>>) {
    // The random numbers are separate, so that everything else is the same as in a world in which all links have a
    // family.
    let mut random = fastrand::Rng::with_seed(scenario.seed ^ 0xA070_0000_0000_0000);
    let of = |sensor: &Rc<dyn Family>| {
        let mut random = random.fork();
        if scenario.model.is_none() && random.bool() {
            return (sensor.clone(), Vec::new());
        }
        let sensor = sensor.auto();
        let sensor = if random.u8(..3) == 0 { family::either(sensor, &mut random) } else { sensor };
        let needed = sensor.baud_rates();
        let lacks_rates = random.u8(..3) == 0;
        let is_impossible = |rate: &u32| lacks_rates && !needed.contains(rate) && random.bool();
        let impossible = SEARCH_RATES.into_iter().filter(is_impossible).collect();
        (sensor, impossible)
    };
    sensors.iter().map(of).unzip()
}

/// Rates of the search, in bits per second. The slowest rate is missing, because every port supports it.
const SEARCH_RATES: [u32; 9] =
    [19_200, 38_400, 115_200, 230_400, 256_000, 460_800, 500_000, 921_600, 1_000_000];
