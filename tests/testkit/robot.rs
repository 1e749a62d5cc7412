//! A machine that carries sensors, with its hub and what its gateway sends.

use super::{Machine, Program, TestEnv, is_class};

const STREAM_FLAGS: [&str; 2] = ["--seed=61", "--baud=500000"];

/// Machine number 1, on which a hub streams.
pub(crate) struct Robot {
    pub(crate) machine: Machine,
    pub(crate) env: TestEnv,
    pub(crate) hub: Option<Program>,
    links: Vec<String>,
    _simulator: Program,
}

impl Robot {
    /// With these sensors.
    pub(crate) fn new(sensors: &[&str]) -> Robot {
        let machine = Machine::new(1);
        let env = TestEnv::on(&machine);
        let simulator = env.simulator(sensors, &STREAM_FLAGS);
        let links = sensors.iter().map(|sensor| env.link(sensor)).collect();
        let mut robot = Robot { machine, env, hub: None, links, _simulator: simulator };
        robot.start();
        robot
    }

    /// Starts its hub.
    pub(crate) fn start(&mut self) {
        self.hub = Some(self.env.hub(&self.links));
    }

    /// Its hub, to be ended.
    pub(crate) fn take_hub(&mut self) -> Program {
        self.hub.take().expect("it was started")
    }

    /// A gateway that has begun, on the cable.
    pub(crate) fn gateway<S: AsRef<str>>(&self, flags: &[S]) -> Program {
        let flags = flags.iter().map(|flag| flag.as_ref().to_owned());
        let flags: Vec<String> = flags.chain(["--interface=eth0".to_owned()]).collect();
        let mut gateway = self.env.start_gateway(&flags);
        let begin = gateway.await_line("its begin", is_class("gateway"));
        assert_eq!(begin["interface"], "eth0");
        gateway
    }
}
