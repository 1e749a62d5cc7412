//! A robot that follows the zones of remote sensors, with the client library's own rules. Refuses to know how they came.

use scanhub_client::Robot;
use scanhub_client::streams::ZonesState;
use scanhub_schema::datagram::Packed;
use scanhub_schema::{Nanos, Topic, Verdict, Zones};

use super::Terms;
use super::topics::{Memory, Published};
use crate::event::Event;
use crate::planted::Defect;
use crate::setup::Setup;
use crate::shared::Shared;

/// Who consumes all topics of all remote sensors.
pub(super) struct RemoteRobot {
    robot: Robot,
    /// The sensors' names, what is known of their zones, and what was believed last.
    sensors: Vec<(String, ZonesState, Verdict)>,
}

impl RemoteRobot {
    pub(super) fn new(terms: &Terms, sensors: usize) -> RemoteRobot {
        let mut robot = Robot::default();
        let mut follow = |number| {
            let name = format!("{GATEWAY}.{}", Setup::name(number));
            robot.expect(&name);
            (name, ZonesState::new(terms.moment(0)), Verdict::Unknown)
        };
        let sensors = (0..sensors).map(&mut follow).collect();
        RemoteRobot { robot, sensors }
    }

    /// When a verdict is too old, if nothing comes.
    pub(super) fn next_ns(&self, terms: &Terms, now: Nanos) -> Nanos {
        let left = self.sensors.iter().filter_map(|(_, state, _)| state.left(terms.moment(now)));
        left.min().map_or(Nanos::MAX, |left| now.saturating_add(left.as_nanos() as Nanos))
    }

    /// Takes what waits, and sees what does not come.
    pub(super) fn run(&mut self, shared: &Shared, terms: &Terms, memory: &Memory, now: Nanos) {
        let moment = terms.moment(now);
        for (sensor, (name, state, believed)) in self.sensors.iter_mut().enumerate() {
            for Published { topic, header, mut payload } in memory.take(name) {
                if shared.planted.strikes(Defect::RemoteAltered, 100) {
                    payload[0] ^= 1;
                }
                let republished = Event::Republished { sensor, topic, header: &header, payload: &payload };
                shared.log.tell(now, &republished);
                let mut zones = Zones::default();
                if topic == Topic::Zones && zones.unpack(&payload) {
                    self.robot.hear(sensor, state.take(&header, &zones, 0, moment).zones);
                    believe(shared, now, sensor, believed, &self.robot);
                }
            }
            if let Some(silence) = state.silence(moment)
                && !shared.planted.is(Defect::RemoteSurvivingVerdict)
            {
                self.robot.hear(sensor, silence.zones);
                believe(shared, now, sensor, believed, &self.robot);
            }
        }
    }
}

fn believe(shared: &Shared, now: Nanos, sensor: usize, believed: &mut Verdict, robot: &Robot) {
    let verdict = robot.sensors().nth(sensor).map_or(Verdict::Unknown, |(_, verdict)| verdict);
    if std::mem::replace(believed, verdict) != verdict {
        shared.log.tell(now, &Event::RemoteBelieves { sensor, verdict });
    }
}

/// What the gateway is called where the listener is.
pub(super) const GATEWAY: &str = "robot1";
