//! Two machines with the same content in their state directories, for example after a disk was copied. Their gateways
//! use the same ID and epoch. A listener accepts one of the gateways and reports the conflict. The listener never takes
//! a sample of one gateway for a sample of the other gateway.

use crate::testkit::{INT, Machine, Outcome, Program, TERM, TestEnv, in_a_network, is_class, number};
use serde_json::{Value, json};

/// Machine with a hub and a directory for the state of its gateway. The hub's sensor has a given number of beams.
struct Robot {
    env: TestEnv,
    _simulator: Program,
    _hub: Program,
    _machine: Machine,
}

impl Robot {
    fn new(number: u8, beams: u32) -> Robot {
        let machine = Machine::new(number);
        let env = TestEnv::on(&machine);
        let simulator = env.simulator(&["front"], &["--seed=61", "--baud=500000"]);
        let resolution = format!("--set=link.front.resolution={}", 180.0 / f64::from(beams - 1));
        let hub = env.hub(&[env.link("front"), resolution]);
        env.await_info("front", |info| info["state"] == "streaming");
        Robot { env, _simulator: simulator, _hub: hub, _machine: machine }
    }

    /// Starts a gateway from the state that both machines have. The saved epoch is far in the future, so that the times
    /// at which the gateways start do not affect the next epoch.
    fn gateway(&self) -> Program {
        let domain = self.env.domain().name().to_owned();
        let state = self.env.path("state/scanhub");
        std::fs::create_dir_all(&state).expect("a state directory");
        let file = state.join(format!("gateway-{domain}-eth0-1"));
        std::fs::write(file, "5f3a12bc00d1e2f3 4000000000\n").expect("can be written");
        let mut gateway =
            self.env.start_gateway(&["--interface=eth0", "--topic=front/scan", "--topic=front/status"]);
        let begin = gateway.await_line("line of class gateway", is_class("gateway"));
        assert_eq!((&begin["hub"], number(&begin, "epoch")), (&json!("5f3a12bc00d1e2f3"), 4_000_000_001));
        gateway
    }
}

fn reports_two_gateways(line: &Value) -> bool {
    line["message"].as_str().is_some_and(|text| text.contains("two gateways send as 5f3a12bc00d1e2f3"))
}

/// Returns the numbers of beams of all scans in order, without repetitions of the number before.
fn beam_counts(outcome: &Outcome) -> Vec<usize> {
    let scans = outcome.of_class("scan");
    let mut beams: Vec<_> = scans.iter().map(|line| line["ranges"].as_array().map_or(0, Vec::len)).collect();
    beams.dedup();
    beams
}

#[test]
fn reports_two_machines_with_one_id_without_mixing() {
    in_a_network("listen_twins::reports_two_machines_with_one_id_without_mixing", || {
        let (one, other) = (Robot::new(1, 361), Robot::new(2, 181));
        // The test environment is connected to both machines, and runs the listeners.
        let env = TestEnv::new();
        let mut listener = env.start(&["listen", "--json"]).ready();
        let mut publisher = env.start(&["listen", "--json", "--publish"]).ready();
        let first = one.gateway();
        listener.await_lines(10, "scans of the first machine", is_class("scan"));
        publisher.await_line("a sensor", |line| line["kind"] == "published");
        let mut echo = env.echo(&["5f3a12bc00d1e2f3.front/scan"]);
        let second = other.gateway();
        listener.await_line("report of two gateways", reports_two_gateways);
        echo.await_lines(100, "scans of the first machine", is_class("scan"));
        let echoed = echo.end(INT);
        assert_eq!(beam_counts(&echoed), [361], "{echoed}");
        assert_eq!(echoed.of_class("summary")[0]["missed"], 0, "{echoed}");
        // A listener that starts while both gateways send receives one of them, but never both.
        let mut late = env.start(&["listen", "--json"]).ready();
        late.await_line("report of two gateways", reports_two_gateways);
        late.await_lines(10, "scans", is_class("scan"));
        let late = late.end(INT);
        assert!(beam_counts(&late) == [361] || beam_counts(&late) == [181], "{:?}", beam_counts(&late));
        // After the first gateway has exited, the listeners that already run do not accept the other gateway. They have
        // refused its datagrams for more than 3 s.
        assert_eq!(first.end(TERM).exit_code, Some(0));
        let mut other = env.start(&["listen", "--json"]).ready();
        other.await_lines(200, "scans of the second machine", is_class("scan"));
        assert_eq!(beam_counts(&other.end(INT)), [181], "a new listener must receive the remaining gateway");
        assert_eq!(second.end(TERM).exit_code, Some(0));
        let (listener, publisher) = (listener.end(INT), publisher.end(INT));
        assert_eq!(beam_counts(&listener), [361], "only the first gateway must be received");
        for outcome in [&listener, &publisher] {
            let notices = outcome.of_class("notice").iter().filter(|line| reports_two_gateways(line)).count();
            assert_eq!(notices, 1, "{outcome}");
            assert!(number(&outcome.of_class("lan_refused")[0], "twin") > 10, "{outcome}");
            assert!(outcome.of_class("lan").iter().all(|line| line["lost"] == 0), "{outcome}");
        }
    });
}
