//! Robot for tests: a machine with simulated sensors, a hub and gateways.

use super::{Machine, Program, TestEnv, is_class};

const STREAM_FLAGS: [&str; 2] = ["--seed=61", "--baud=500000"];

/// Machine number 1 with a running hub.
pub(crate) struct Robot {
    pub(crate) machine: Machine,
    pub(crate) env: TestEnv,
    pub(crate) hub: Option<Program>,
    links: Vec<String>,
    _simulator: Program,
}

impl Robot {
    /// Creates the machine, and starts a simulator and a hub for these sensors.
    pub(crate) fn new(sensors: &[&str]) -> Robot {
        let machine = Machine::new(1);
        let env = TestEnv::on(&machine);
        let simulator = env.simulator(sensors, &STREAM_FLAGS);
        let links = sensors.iter().map(|sensor| env.link(sensor)).collect();
        let mut robot = Robot { machine, env, hub: None, links, _simulator: simulator };
        robot.start();
        robot
    }

    /// Starts the hub, and waits until it is ready.
    pub(crate) fn start(&mut self) {
        self.hub = Some(self.env.hub(&self.links));
    }

    /// Returns the hub, so that the test can end it.
    pub(crate) fn take_hub(&mut self) -> Program {
        self.hub.take().expect("the hub was started")
    }

    /// Starts a gateway that sends on the machine's cable, and waits for its line of class `gateway`.
    pub(crate) fn gateway<S: AsRef<str>>(&self, flags: &[S]) -> Program {
        let flags = flags.iter().map(|flag| flag.as_ref().to_owned());
        let flags: Vec<String> = flags.chain(["--interface=eth0".to_owned()]).collect();
        let mut gateway = self.env.start_gateway(&flags);
        let begin = gateway.await_line("line of class gateway", is_class("gateway"));
        assert_eq!(begin["interface"], "eth0");
        gateway
    }
}
